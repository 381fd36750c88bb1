"""What compiling promises: once per structure, any precision, little memory."""

from dataclasses import replace
from functools import partial

import jax
import jax.monitoring
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.lanes.choice import lane_mode
from jaxrod.methods.consistent import Consistent
from jaxrod.methods.laws import IN_SPACE
from jaxrod.structure import pytree
from physics.rods import arm, difference

COMPILED = "/jax/core/compile/backend_compile_duration"


@pytest.fixture
def compilations():
    """A list that grows by one whenever anything at all is compiled."""
    seen = []

    def listen(event, duration, **kwargs):
        if event == COMPILED:
            seen.append(kwargs)

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield seen
    jax.monitoring.unregister_event_duration_listener(listen)


def whole_scene(seed, dtype=jnp.float64, n=5):
    """An arm with every effect, all its numbers drawn at random."""
    random = np.random.default_rng(seed)
    number = lambda low, high: float(random.uniform(low, high))
    rod, state = arm(
        n,
        dtype,
        length=number(0.9, 1.1),
        radius=number(0.04, 0.06),
        density=number(900, 1100),
        youngs_modulus=number(1e6, 2e6),
        poisson_ratio=number(0.3, 0.5),
    )
    scene = jaxrod.make_scene(
        rod,
        jaxrod.gravity(random.normal(size=3)),
        jaxrod.end_load(random.normal(size=3), random.normal(size=3)),
        jaxrod.uniform_load(random.normal(size=3), random.normal(size=3)),
        jaxrod.actuation.ElementCouples(jnp.asarray(random.normal(size=(3, n)))),
        jaxrod.clamp(state),
        jaxrod.exponential_damping(number(0, 5), number(0, 5)),
    )
    return scene, state, number(1e-4, 2e-4)


def test_changing_numbers_compiles_nothing(compilations):
    step = jax.jit(jaxrod.step)
    health = jax.jit(jaxrod.health)

    def use(seed):
        scene, state, dt = whole_scene(seed)
        before = len(compilations)
        results = (
            step(scene, state, dt),
            jaxrod.advance(scene, state, dt, 5 + seed),
            jaxrod.rollout(scene, state, dt, 10, 5),
            jaxrod.stable_dt(scene, 0.5 + 0.1 * seed),
            health(scene, state, dt),
        )
        return len(compilations) - before, jax.tree.leaves(results)

    first, reference = use(0)
    assert first > 0, "the listener hears nothing"
    for seed in (1, 2, 3):
        compiled, results = use(seed)
        assert compiled == 0
        assert not np.array_equal(results[0], reference[0])


@pytree
class Falling:
    """The least that is a stepper: quick to compile, which is not what is tested."""

    steps_of_end = 1
    dt: jax.Array
    fall: jax.Array

    def begin(self, state):
        return state

    def cycle(self, state):
        return replace(state, positions=state.positions - self.dt * self.fall**2)

    end = cycle


@pytree
class Fall(jaxrod.extend.Effect):
    """Makes scenes of these tests their own kind: programs are kept by kind."""

    rate: jax.Array

    def energy(self, rod, state):
        return 0.0


TRANSFORMATIONS = {
    "grad": jax.grad,
    "value_and_grad": jax.value_and_grad,
    "jacfwd": jax.jacfwd,
    "jvp": lambda f: lambda rate: jax.jvp(f, (rate,), (rate,)),
    "vmap": lambda f: lambda rate: jax.vmap(f)(jnp.stack([rate, 2 * rate])),
}


RUNS = {
    "step": (jaxrod.step, ()),
    "advance": (jaxrod.advance, (100,)),
    "advance, traced count": (jaxrod.advance, (jnp.asarray(100),)),
    "rollout": (jaxrod.rollout, (4, 2)),
}


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    ("run", "kind"),
    [
        (run, kind)
        for run in RUNS
        for kind in TRANSFORMATIONS
        # A traced number of steps has no gradient in reverse mode.
        if not ("traced" in run and "grad" in kind)
    ],
)
def test_a_transformation_by_itself_compiles_once(kind, run, compilations, monkeypatch):
    """As users write it, without jit around it: the second call runs what is there."""
    run, steps = RUNS[run]
    made = lambda method, scene, state, dt: Falling(dt, scene.effects[0].rate)
    monkeypatch.setattr(Consistent, "stepper", made)
    rod, state = arm(3)

    def height(rate):
        scene = jaxrod.make_scene(rod, Fall(rate))
        return jnp.sum(run(scene, state, jnp.asarray(1e-4), *steps).tip)

    first = TRANSFORMATIONS[kind](height)(jnp.asarray(2.0))
    before = len(compilations)
    second = TRANSFORMATIONS[kind](height)(jnp.asarray(3.0))
    assert len(compilations) == before
    assert difference(first, second) != 0


@pytest.mark.parametrize("plane", [None, "xy"])
def test_a_scene_that_a_jitted_function_closes_over(plane):
    """Nothing in it is traced, yet nothing in it can be looked at."""
    rod, state = arm(3, direction=(1.0, 0.0, 0.0))
    scene = jaxrod.make_scene(
        rod, jaxrod.clamp(state), method=plane and jaxrod.planar(plane)
    )
    for run in (
        lambda: jaxrod.step(scene, state, 1e-4),
        lambda: jaxrod.advance(scene, state, 1e-4, 2),
        lambda: jaxrod.rollout(scene, state, 1e-4, 2),
        lambda: jaxrod.scale_inertia(scene, 1e-4).scene,
    ):
        assert jax.eval_shape(run)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    ("kind", "mode"),
    [("float64", "consistent"), ("float32", "consistent"), ("float32", "pyelastica")],
)
def test_the_precision_asked_for_is_kept(kind, mode):
    scene, state, dt = whole_scene(0, jnp.dtype(kind))
    scene = replace(scene, method=IN_SPACE[mode])
    results = (
        jaxrod.advance(scene, state, dt, 3),
        jaxrod.rollout(scene, state, dt, 2),
        jaxrod.stable_dt(scene).dt,
        scene.total_energy(state),
        jaxrod.strains(scene.rod, state),
    )
    for leaf in jax.tree.leaves((scene, state, results)):
        assert leaf.dtype == kind


def entry(batch, i):
    return jax.tree.map(lambda leaf: leaf[i], batch)


def test_a_batch_is_a_loop():
    members = [whole_scene(seed) for seed in range(4)]
    scenes, states, dts = jax.tree.map(lambda *leaves: jnp.stack(leaves), *members)
    together = jax.jit(jax.vmap(lambda *m: jaxrod.advance(*m, 50)))(scenes, states, dts)
    for i, member in enumerate(members):
        alone = jaxrod.advance(*member, 50)
        assert difference(entry(together, i), alone) < 1e-13


def test_many_steps_are_one_step_many_times():
    scene, state, dt = whole_scene(0)
    step = jax.jit(jaxrod.step)
    one_by_one = [state]
    for _ in range(12):
        one_by_one.append(step(scene, one_by_one[-1], dt))
    recorded = jaxrod.rollout(scene, state, dt, 12, 3)
    for i in range(1, 5):
        assert difference(entry(recorded, i), one_by_one[3 * i]) < 1e-13
    assert difference(jaxrod.advance(scene, state, dt, 12), one_by_one[-1]) < 1e-13
    inside = jax.jit(lambda s: jaxrod.advance(scene, s, dt, 12))(state)
    assert difference(inside, one_by_one[-1]) < 1e-13
    np.testing.assert_allclose(
        jaxrod.rollout_times(dt, 12, 3), dt * np.array([0, 3, 6, 9, 12])
    )


def test_no_steps_change_nothing():
    scene, state, dt = whole_scene(0)
    assert difference(jaxrod.advance(scene, state, dt, 0), state) == 0
    assert difference(entry(jaxrod.rollout(scene, state, dt, 0), 0), state) == 0


@pytest.mark.slow
def test_single_precision_follows_double_precision(record):
    """The arm swings under its weight for two seconds, undamped."""
    tips = []
    for dtype in (jnp.float32, jnp.float64):
        rod, state = arm(20, dtype, direction=(1.0, 0.0, 0.0))
        scene = jaxrod.make_scene(rod, jaxrod.clamp(state), jaxrod.gravity())
        tips.append(np.float64(jaxrod.advance(scene, state, 2e-4, 10_000).tip))
    assert np.linalg.norm(tips[1] - [1.0, 0.0, 0.0]) > 0.01
    record(
        "Tip of the arm swinging 2 s under its weight in float32 [m]",
        "float64",
        np.linalg.norm(tips[0] - tips[1]),
        at_most=5e-5,
    )


@pytest.mark.slow
@pytest.mark.parametrize("batch", [1, pytest.param(16, marks=pytest.mark.slow)])
def test_memory_of_the_gradient_of_a_thousand_steps(batch, record):
    rod, state = arm(20)
    wall = jaxrod.clamp(state)

    def loss(couples):
        scene = jaxrod.make_scene(rod, wall, jaxrod.actuation.ElementCouples(couples))
        return jnp.sum(jaxrod.rollout(scene, state, 2e-4, 1000, 50).positions ** 2)

    gradient = jax.jit(jax.vmap(jax.grad(loss))).lower(jnp.zeros((batch, 3, 20)))
    # Which optimisations LLVM makes does not change where XLA keeps what.
    program = gradient.compile({"xla_backend_optimization_level": 0})
    taken = program.memory_analysis().temp_size_in_bytes / batch
    record(
        f"Memory of the gradient through 1000 steps, n = 20, {batch} at once [MB each]",
        "compiled program",
        taken / 1e6,
        at_most=5.0,
    )


@pytree
class Nothing(jaxrod.extend.Effect):
    """An effect that overrides no hook that a step calls."""

    def energy(self, rod, state):
        return 0.0


@pytest.mark.slow
@pytest.mark.usefixtures("compiled_for_cpus")
def test_an_effect_costs_only_what_it_does(record, request):
    # XLA counts its own operations, not those of kernels.
    request.addfinalizer(partial(jaxrod.use_lanes, lane_mode()))
    jaxrod.use_lanes("never")
    rod, state = arm(20)

    def flops(*effects):
        scene = jaxrod.make_scene(rod, *effects)
        lowered = jax.jit(jaxrod.step).lower(scene, state, 1e-4)
        return lowered.compile().cost_analysis()["flops"]

    bare = flops()
    record(
        "Cost of an effect that does nothing [flops per step]",
        f"{bare:.0f} flops without it",
        flops(Nothing()) - bare,
        at_most=0,
    )
    assert flops(jaxrod.gravity()) > bare


@pytest.mark.usefixtures("compiled_for_cpus")
@pytest.mark.parametrize(
    ("kind", "figure"),
    [("consistent", 7872), ("compensated", 8181), ("pyelastica", 6947), ("xy", 1711)],
)
def test_a_bare_rod_costs_what_it_did_before_there_were_other_features(kind, figure):
    """Operations of one step of 20 elements, as written, before XLA has seen them.

    The figures are those of a scene without effects when this was first measured. A
    feature that raises them is paid for by everyone who does not use it.

    Since then the last step of a run is a cycle like the others, so that it is compiled
    once. Its drift is half as long, so each step chooses its time: 3 operations. The
    angle that it turns elements by per spin is no constant any more. This takes one
    product for each element and axis: 40 in space, 20 in a plane. PyElastica's law has
    none. The choice saves half of what is compiled.
    """
    rod, state = arm(20, dtype=jnp.float32)
    if kind == "compensated":
        state = jaxrod.compensated(state)
    methods = {"pyelastica": jaxrod.pyelastica(), "xy": jaxrod.planar("xy")}
    scene = jaxrod.make_scene(rod, method=methods.get(kind))
    integrator = scene.method.stepper(scene, state, jnp.asarray(1e-4, jnp.float32))
    run = integrator.counted(5)
    cycle = jax.jit(run.cycle).lower(run.begin(state))
    assert cycle.cost_analysis()["flops"] <= figure

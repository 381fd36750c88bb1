"""First calls: programs and equations are counted, so that they cannot creep back."""

from dataclasses import replace
from typing import ClassVar

import jax
import jax.monitoring
import jax.numpy as jnp
import pytest

import jaxrod
from jaxrod import control, envs, training
from jaxrod.control.local_coordinates import tangent_map
from jaxrod.jax_internals.equations import program_of, programs_within
from jaxrod.structure import pytree
from jaxrod.systems.stepping.runs import stable_system_dt
from jaxrod.training.algorithms.ppo import PPO
from jaxrod.training.runs.hosts import device_mesh, trace_updates
from physics.rods import arm

COMPILED = "/jax/core/compile/backend_compile_duration"


@pytest.fixture
def compiled():
    """A list that grows by one for each program that XLA compiles."""
    seen = []

    def listen(event, duration, **kwargs):
        if event == COMPILED:
            seen.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield seen
    jax.monitoring.unregister_event_duration_listener(listen)


def equations_of(program):
    """All equations that are left to XLA; a kernel counts as one."""
    for equation in program_of(program).jaxpr.eqns:
        yield equation
        for inner in programs_within(equation):
            yield from equations_of(inner)


def count_of(function, *arrays):
    return sum(1 for _ in equations_of(jax.make_jaxpr(function)(*arrays)))


def held_arm(**options):
    rod, state = arm(4, jnp.float64)
    return jaxrod.make_scene(
        rod, jaxrod.clamp(state), jaxrod.gravity(), **options
    ), state


def test_implicit_steps_leave_little_to_xla():
    scene, state = held_arm(method=jaxrod.implicit(0.8))
    count = count_of(lambda n: jaxrod.advance(scene, state, 1e-3, n), jnp.int32(2))
    assert count < 100  # 5327 without kernels, 1080 if XLA runs Newton's method


def test_derivatives_of_equilibria_leave_little_to_xla():
    scene, state = held_arm()

    def tip(height):
        load = jaxrod.end_load(jnp.array([0.0, 0.0, 1.0]) * height)
        return jaxrod.equilibrium(scene.with_effect(load), state).state.tip

    whole = count_of(tip, 0.1)
    both = count_of(jax.jacfwd(tip), 0.1)
    assert both - whole < 1300  # 7867 without kernels
    assert whole < 500  # 7010 without kernels, 2400 if XLA runs the search


def test_a_scan_of_short_runs_keeps_each_state_once():
    """XLA compiles a program for each array that a scan keeps for its derivative."""
    scene, state = held_arm()

    def tip(dt, n_steps=4):
        def later(state, _):
            return jaxrod.advance(scene, state, dt, n_steps), None

        return jax.lax.scan(later, state, length=3)[0].tip[2]

    kept = max(
        len(equation.outvars)
        for equation in equations_of(jax.make_jaxpr(jax.grad(tip))(1e-4))
        if equation.primitive.name == "scan"
    )
    assert kept < 50  # 86 with the carry beside its checkpoints
    # Nothing is kept for a traced number of steps.
    _, expected = jax.jvp(lambda dt: tip(dt, jnp.int32(4)), (1e-4,), (1.0,))
    _, forward = jax.jvp(tip, (1e-4,), (1.0,))
    assert float(forward) == pytest.approx(float(expected), rel=1e-12)
    assert float(jax.grad(tip)(1e-4)) == pytest.approx(float(expected), rel=1e-12)


def kernels_of(function, *arrays):
    """Programs of kernels, one for each time that one runs."""
    return [
        id(equation.params["spec"].body)
        for equation in equations_of(jax.make_jaxpr(function)(*arrays))
        if equation.primitive.name.startswith("jaxrod_")
    ]


def sticking_rod():
    rod, state = arm(4, jnp.float64)
    floor = jaxrod.shapes.plane((0.0, 0.0, -0.0199), (0.0, 0.0, 1.0))
    touch = jaxrod.contact(floor, stiffness=1e4, damping=1.0, friction=0.3)
    sticks = jaxrod.sticking_contact(touch, rod, state)
    return jaxrod.make_scene(rod, jaxrod.gravity(), sticks), state


def test_what_sticks_is_searched_and_judged_by_one_kernel():
    """Stability is judged with the springs of friction that hold at rest."""
    scene, state = sticking_rod()
    rest = lambda state: jaxrod.equilibrium(scene, state)
    kernels = kernels_of(rest, state)
    # The search, then the held components and the state, then a search of no steps.
    assert len(kernels) == 4 and kernels[0] == kernels[3]
    assert len(set(kernels)) == 3
    assert count_of(rest, state) < 300


def test_a_system_at_rest_leaves_little_to_xla():
    scene, state = sticking_rod()
    system = jaxrod.make_system({"rod": scene}, state={"rod": state})
    rest = lambda state: jaxrod.equilibrium(system, {"rod": state})
    kernels = kernels_of(rest, state)
    # What sticks has a beginning and a place of its own, by the kernels of the search.
    assert len(kernels) > len(set(kernels)) == 11
    assert count_of(rest, state) < 1500


@pytree
class Pulled(jaxrod.extend.Effect):
    """A pull on every node towards the tip, which may reach any distance."""

    def loads(self, rod, motion):
        pull = tuple(0.01 * (c[-1] - c) for c in motion.position)
        return jaxrod.extend.Loads(forces=pull)


def test_a_search_that_no_kernel_runs_whole_has_kernels_for_its_parts():
    """Dense matrices are solved by LAPACK, which kernels cannot call."""
    scene, state = held_arm()
    scene = scene.with_effect(Pulled())
    rest = lambda height: (
        jaxrod.equilibrium(
            scene.with_effect(jaxrod.end_load(jnp.array([0.0, 0.0, 1.0]) * height)),
            state,
        ).state.tip
    )
    # 4859 if parts are traced as in one kernel, 6814 without kernels.
    assert count_of(rest, 0.1) < 2000


@pytree
class Counted(jaxrod.extend.Effect):
    """An effect that counts how often its loads are traced."""

    traces: ClassVar[list[int]] = []
    push: jax.Array

    def loads(self, rod, motion):
        self.traces.append(1)
        x, y, z = motion.position
        return jaxrod.extend.Loads(forces=(self.push - x, 0 * y, 0 * z))


def test_runs_and_their_derivatives_trace_a_step_once():
    rod, state = arm(4, jnp.float64)
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state), Counted(jnp.asarray(1.0)))

    def tip(dt, n):
        return jaxrod.advance(scene, state, dt, n).tip[0]

    Counted.traces.clear()
    jax.make_jaxpr(tip)(1e-4, jnp.int32(5))
    before = len(Counted.traces)
    assert before == 1  # 2 if the last step of a run is a program of its own
    jax.make_jaxpr(lambda dt: tip(dt, 5))(1e-4)
    jax.make_jaxpr(jax.grad(lambda dt: tip(dt, 7)))(1e-4)
    jax.make_jaxpr(jax.vmap(lambda dt: tip(dt, 7)))(jnp.full(3, 1e-4))
    assert len(Counted.traces) == before


def test_an_update_is_traced_once_for_its_shapes_and_its_loop():
    env = envs.make("trivial")
    traces = []

    def update(state):
        traces.append(state)
        return PPO.update(state)

    learner = replace(PPO, update=update, partition=None)
    config = training.PPOConfig(num_envs=2, rollout_steps=4, minibatches=2, epochs=1)
    start = lambda key: learner.init(key, env, config, env.default_params(), 16)
    state = jax.eval_shape(start, jax.random.key(0))
    trace_updates(learner, state, 2, device_mesh(jax.devices()[:1]))
    assert len(traces) == 1


def test_the_columns_of_a_linear_model_are_no_batch():
    """A batch would have kernels of lanes, whose code grows with the rod."""
    scene, state = held_arm()
    model = lambda dt: tangent_map(scene, state, dt, 2, 0, None, None)[1]
    runs = [
        equation.params["spec"]
        for equation in equations_of(jax.make_jaxpr(model)(1e-4))
        if equation.primitive.name.startswith("jaxrod_")
    ]
    assert len(runs) >= 3
    assert all(spec.batch is None for spec in runs)


def test_a_fit_is_one_program_and_compiled_once(compiled):
    x = jnp.arange(5.0)
    line = lambda p: p["slope"] * x
    seen = jnp.array([0.1, 2.9, 6.1, 9.0, 11.9])
    first = control.fit(line, seen, {"slope": 1.0}, noise=0.1)
    assert 0 < len(compiled) < 30  # 90 if the search is not one program
    twice = 2 * seen
    compiled.clear()
    second = control.fit(line, twice, {"slope": 1.5}, noise=0.2)
    assert not compiled
    assert float(second.values["slope"]) == pytest.approx(
        2 * float(first.values["slope"]), rel=1e-5
    )


def test_the_stable_step_of_a_system_is_one_program_for_all_who_ask():
    scene, state = held_arm()
    system = jaxrod.make_system({"only": scene}, state={"only": state})
    before = stable_system_dt._cache_size()
    dt = jaxrod.stable_dt(system).dt
    system.step_warning(dt, {"only": state})
    assert stable_system_dt._cache_size() == before + 1


def test_numbers_of_contact_are_one_program(compiled):
    rod, state = arm(7, jnp.float64)
    ground = jaxrod.contact(
        jaxrod.shapes.plane((0.0, 0.0, -0.5), (0.0, 0.0, 1.0)), friction=0.3
    )
    compiled.clear()
    jaxrod.make_scene(rod, jaxrod.clamp(state), ground)
    assert len(compiled) < 12  # 75 if the bounds of contact are computed one by one


def test_numbers_of_contact_between_members_are_one_program(compiled):
    rod, _ = arm(7, jnp.float64)
    links = {name: jaxrod.make_scene(rod) for name in ("left", "right")}
    pair = jaxrod.systems.rod_contact("left", "right", friction=0.2)
    compiled.clear()
    jaxrod.make_system(links, pair)
    assert len(compiled) < 12  # 34 if the bounds of contact are computed one by one


def test_health_is_one_program(compiled):
    scene, state = held_arm()
    compiled.clear()
    jaxrod.health(scene, state, 1e-4)
    assert len(compiled) < 8  # 81 if each flag is computed for itself


def test_counting_neighbours_takes_few_programs(compiled):
    rod, state = arm(7, jnp.float64)
    itself = jaxrod.systems.rod_contact(
        "rope",
        stiffness=1e3,
        self_contact=True,
        lists=jaxrod.systems.neighbour_lists(),
    )
    scene = jaxrod.make_scene(rod)
    compiled.clear()
    jaxrod.make_system({"rope": scene}, itself, state={"rope": state})
    assert len(compiled) < 18  # 44 if contact is prepared operation by operation

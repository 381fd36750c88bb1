"""The implicit integrator: order, stability, damping, conservation, gradients."""

from dataclasses import fields, replace
from itertools import pairwise

import jax
import jax.monitoring
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.effects.base import Effect
from jaxrod.geometry import vectors
from jaxrod.loaded_rod import damping_rates
from jaxrod.rods.elasticity import elastic_law
from jaxrod.rods.motion import Loads, motion_of
from jaxrod.statics.residual import Increment, LoadBalance
from jaxrod.structure import pytree
from physics.rods import arm, deformed, difference, largest, random_rod

N = 6
# The programs run a few times: LLVM need not optimise them.
HURRY = {"xla_backend_optimization_level": 0}


def loaded(load=1.0, damping=0.0, radius=0.5, n=N, dtype=jnp.float64, **settings):
    """A clamped arm with every kind of load, and its rest state."""
    rod, rest = arm(n, dtype, youngs_modulus=1e6)
    scene = jaxrod.make_scene(
        rod,
        jaxrod.clamp(rest),
        jaxrod.gravity(load * np.array([1.0, 2.0, -9.0])),
        jaxrod.end_load(load * np.array([2.0, 0.0, 1.0]), (0.3 * load, 0.2 * load, 0)),
        jaxrod.actuation.ElementCouples(jnp.full((3, n), 0.5 * load)),
        jaxrod.exponential_damping(damping, 2 * damping),
        method=jaxrod.implicit(radius, **settings),
    )
    return scene, rest


def free(radius):
    rod, _ = arm(N, youngs_modulus=1e6)
    return jaxrod.make_scene(rod, method=jaxrod.implicit(radius))


def moving(scene):
    return deformed(scene.rod, 8, largest_angle=0.4, largest_strain=0.02, speed=0.5)


def explicit_limit(scene):
    return float(jaxrod.stable_dt(replace(scene, method=jaxrod.consistent()), 1.0).dt)


SLOW = pytest.mark.slow


@pytest.mark.slow
@pytest.mark.parametrize("radius", [pytest.param(0.0, marks=SLOW), 0.5, 1.0])
@pytest.mark.parametrize(
    "name",
    [
        pytest.param("free, spinning", marks=pytest.mark.slow),
        "clamped, loaded, damped",
    ],
)
def test_the_implicit_step_is_of_second_order_in_dt(name, radius, record):
    scene = free(radius) if name.startswith("free") else loaded(1.0, 40.0, radius)[0]
    state = moving(scene)
    dt = 0.1 * explicit_limit(scene)
    ends = [jaxrod.advance(scene, state, dt / 2**k, 40 * 2**k) for k in range(4)]
    for field in fields(state):
        if getattr(state, field.name) is None:
            continue
        values = [np.asarray(getattr(end, field.name)) for end in ends]
        gaps = [np.max(np.abs(b - a)) for a, b in pairwise(values)]
        record(
            f"Order in dt, implicit, spectral radius {radius:g}, of "
            f"{field.name.replace('_', ' ')}: rod {name}",
            "2",
            np.log2(gaps[-2] / gaps[-1]),
            between=(1.9, 2.1),
        )


@pytest.mark.slow
def test_implicit_and_explicit_steps_agree_as_dt_goes_to_zero(record):
    """Each extrapolated to dt = 0 from its own two smallest steps."""
    scene, _ = loaded(1.0, 1.0)
    state = moving(scene)
    dt = 0.05 * explicit_limit(scene)

    def extrapolated(scene):
        coarse = jaxrod.advance(scene, state, dt, 64)
        fine = jaxrod.advance(scene, state, dt / 2, 128)
        return jax.tree.map(lambda a, b: b + (b - a) / 3, coarse, fine)

    ends = [
        extrapolated(s) for s in (scene, replace(scene, method=jaxrod.consistent()))
    ]
    moved = difference(ends[0].positions, state.positions)
    record(
        "Implicit against explicit steps, both extrapolated to dt = 0 [of the way]",
        "equal",
        difference(ends[0].positions, ends[1].positions) / moved,
        at_most=1e-6,
    )


def amplification(z, radius):
    """The method's factor for a mode of frequency omega, z = i omega dt."""
    gamma = 0.5 / (1 + np.sqrt(0.5 * (1 + radius)))
    top = 1 + (1 - 2 * gamma) * z + (0.5 - 2 * gamma + gamma**2) * z**2
    return top / (1 - gamma * z) ** 2


@pytest.mark.parametrize("radius", [0.0, 0.3, 0.8, 1.0])
def test_a_stiff_mode_decays_as_selected(radius, record):
    """The fastest stretching mode, at a thousand times the explicit limit."""
    scene, rest = loaded(load=0.0, radius=radius)
    rod = scene.rod
    wave = np.sqrt(float(rod.shear_stretch_stiffness[2, 0] / rod.linear_density[0]))
    frequency = 2 * wave * N * np.sin((2 * N - 1) * np.pi / (4 * N))
    shape = np.sin((2 * N - 1) * np.pi * np.arange(N + 1) / (2 * N))
    dt, size = 1000 * explicit_limit(scene), 1e-6
    state = replace(rest, positions=rest.positions.at[2].add(size * shape))
    after = jaxrod.advance(scene, state, dt, 1)
    stretch = (after.positions[2] - rest.positions[2]) / (size * shape + (shape == 0))
    speed = after.velocities[2] / (size * frequency * shape + (shape == 0))
    amplitude = float(jnp.hypot(stretch, speed)[1:].mean())
    assert amplitude == pytest.approx(
        abs(amplification(1j * frequency * dt, radius)), abs=1e-6
    )
    record(
        "Remaining amplitude of a stiff mode after one step as long as 1000 stable "
        "steps, spectral "
        f"radius {radius:g}",
        f"{radius:g}",
        amplitude,
        between=(radius - 0.02, radius + 0.02),
    )


@pytest.mark.parametrize(("radius", "factor"), [(0.0, 100), (0.5, 100), (1.0, 10)])
def test_large_motion_is_stable_far_above_the_explicit_limit(radius, factor):
    """A strongly and irregularly bent arm let go, undamped: no energy appears.

    Without numerical damping all of it stays, in motion too fast to follow.
    """
    scene, _ = loaded(load=0.0, radius=radius)
    state = deformed(scene.rod, 3, largest_angle=0.5, largest_strain=0.05)
    before = float(scene.total_energy(state))
    after = jaxrod.advance(scene, state, factor * explicit_limit(scene), 300)
    left = float(scene.total_energy(after)) / before
    assert (0.9 < left < 1.1) if radius == 1 else (left < 0.1)


def test_no_damping_keeps_the_energy_of_small_motion(record):
    scene, rest = loaded(load=0.0, radius=1.0)
    arc = np.linspace(0, 1, N + 1)
    state = replace(rest, velocities=rest.velocities.at[0].set(1e-4 * arc**2))
    energies = [
        float(scene.total_energy(jaxrod.advance(scene, state, 5e-3, steps)))
        for steps in (0, 700, 1000)
    ]
    record(
        "Energy drift of small swings, spectral radius 1, 1000 steps",
        "0",
        abs(energies[2] / energies[0] - 1) + abs(energies[1] / energies[0] - 1),
        at_most=1e-6,
    )


@pytest.mark.slow
def test_momentum_and_angular_momentum_of_a_free_rod(record):
    dt = 2 * explicit_limit(free(1.0))
    state = moving(free(1.0))

    def drifts(radius, dt, steps):
        scene = free(radius)
        after = jaxrod.advance(scene, state, dt, steps)
        return [
            float(
                jnp.linalg.norm(law(scene.rod, after) - law(scene.rod, state))
                / jnp.linalg.norm(law(scene.rod, state))
            )
            for law in (jaxrod.Rod.momentum, jaxrod.Rod.angular_momentum)
        ]

    for radius in (0.5, 1.0):
        record(
            f"Momentum drift, implicit, spectral radius {radius:g}, 100 steps",
            "0",
            drifts(radius, dt, 100)[0],
            at_most=1e-11,
        )
    record(
        "Angular momentum drift, implicit, spectral radius 1, 100 steps",
        "0",
        drifts(1.0, dt, 100)[1],
        at_most=1e-10,
    )
    coarse, fine = drifts(0.5, dt / 4, 100)[1], drifts(0.5, dt / 8, 200)[1]
    record(
        "Order in dt of the angular momentum drift, spectral radius 0.5",
        "3",
        np.log2(coarse / fine),
        between=(2.5, 3.5),
    )


@pytree
class Spring(Effect):
    """Holds neighbouring nodes together, and drags on them: of no closed form."""

    reach = "neighbours"
    stiffness: jax.Array
    drag: jax.Array

    def loads(self, rod, motion):
        pull = vectors.scale(self.stiffness, motion.edges)
        drag = vectors.scale(-self.drag, motion.velocity)
        turned = vectors.cross(motion.edges, motion.spin)
        return Loads(vectors.add(vectors.difference(pull), drag), turned)


@pytree
class Belt(Effect):
    """Pulls the second node after the last, and turns the first element with it."""

    stiffness: jax.Array

    def loads(self, rod, motion):
        pull = [self.stiffness * jnp.sin(c[-1] - c[1]) for c in motion.position]
        slip = [u[-1] - v[0] for u, v in zip(motion.velocity, motion.spin, strict=True)]
        return Loads(
            tuple(
                jnp.zeros_like(c).at[1].set(f)
                for c, f in zip(motion.position, pull, strict=True)
            ),
            tuple(
                jnp.zeros_like(c).at[0].set(f)
                for c, f in zip(motion.spin, slip, strict=True)
            ),
        )


@pytest.mark.slow
@pytest.mark.parametrize("distant", [False, True])
def test_the_tangent_is_the_derivative_of_the_residual(distant, record):
    rod, _ = random_rod(3, N)
    state = deformed(rod, 1, largest_angle=1.5, speed=0.5)
    scene = jaxrod.make_scene(
        rod,
        jaxrod.gravity(),
        jaxrod.end_load((3.0, 5.0, -2.0), (1.0, -2.0, 0.5)),
        jaxrod.end_load((0.0, 0.0, 1.0), (1.0, 1.0, 0.5), follower=True),
        jaxrod.uniform_load((2.0, 0.0, 1.0), (0.5, 1.0, -1.0)),
        jaxrod.actuation.ElementCouples(
            jnp.asarray(np.sin(np.arange(3 * N).reshape(3, N)))
        ),
        jaxrod.clamp(state),
        jaxrod.fixed_end(state, "tip"),
        Spring(jnp.asarray(7.0), jnp.asarray(0.3)),
        jaxrod.exponential_damping(0.7, 1.9),
        *([Belt(jnp.asarray(5.0))] if distant else []),
    )
    law, rates = elastic_law(rod), damping_rates(scene)
    start = LoadBalance(scene, law, motion_of(state), jnp.asarray(0.0), rates)
    random = np.random.default_rng(0)
    draw = lambda size, n: tuple(jnp.asarray(size * random.normal(size=(3, n))))
    moves = Increment(draw(0.02, N + 1), draw(0.3, N))

    # Operation by operation: as one program it would take minutes to compile.
    def derivative(balance, moves, direction):
        def residual(step):
            return balance.residual(balance.retract(moves, step))

        return jax.jvp(residual, (jnp.zeros_like(direction),), (direction,))[1]

    @jax.jit(compiler_options=HURRY)
    def product(balance, moves, direction):
        return balance.tangent(moves).multiply(direction)

    worst = 0.0
    for pace in (0.0, 1.0, 300.0):
        balance = replace(start, pace=jnp.asarray(pace))
        # What is held does not move.
        direction = balance.free * random.normal(size=(N + 1, 6))
        expected = derivative(balance, moves, direction)
        got = product(balance, moves, direction)
        worst = max(worst, difference(expected, got) / largest(expected))
    record(
        "Tangent of the balance of loads in closed form, all effects"
        + ", and one that couples distant elements" * distant,
        "automatic differentiation of the residual",
        worst,
        at_most=1e-13,
    )


@pytest.mark.slow
def test_a_step_that_does_not_converge_is_not_finite():
    scene, _ = loaded(max_iterations=1)
    step = jax.jit(jaxrod.step, compiler_options=HURRY)
    after = step(scene, moving(scene), 1e-2)
    assert not any(np.any(np.isfinite(leaf[:, 1:])) for leaf in jax.tree.leaves(after))
    assert not bool(jaxrod.health(scene, after, 1e-2).finite)


def test_changing_numbers_compiles_nothing():
    compiled = []

    def listen(event, duration, **_):
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(duration)

    def use(seed):
        scene, rest = loaded(0.1 * seed, 0.2 * seed, 0.3 * seed)
        before = len(compiled)
        jaxrod.advance(scene, rest, 1e-3 * (1 + seed), 2 + seed)
        return len(compiled) - before

    use(0)
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        jax.jit(lambda x: x + 1.2345)(0.0)
        assert compiled, "the listener hears nothing"
        assert [use(seed) for seed in (1, 2, 3)] == [0, 0, 0]
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


@pytest.mark.slow
@pytest.mark.parametrize(
    "dtype", ["float32", pytest.param("float64", marks=pytest.mark.slow)]
)
def test_a_batch_steps_as_one_by_one(dtype):
    """Members that need different numbers of iterations do not disturb each other."""
    dtype = jnp.dtype(dtype)
    several = []
    for load in (0.0, 1.0, 4.0):
        scene, rest = loaded(load, 0.1, n=3, dtype=dtype)
        several.append((scene, rest, jnp.asarray(0.01 * (1 + load), dtype)))
    steps = lambda *numbers: jaxrod.advance(*numbers, jnp.asarray(3))
    run = jax.jit(steps, compiler_options=HURRY)
    one_by_one = [run(*each) for each in several]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *several)
    together = jax.jit(jax.vmap(steps), compiler_options=HURRY)(*batch)
    bar = 100 * float(jnp.finfo(dtype).eps)
    for index, alone in enumerate(one_by_one):
        assert all(leaf.dtype == dtype for leaf in jax.tree.leaves(alone))
        member = jax.tree.map(lambda leaf, i=index: leaf[i], together)
        assert difference(member, alone) < bar * largest(alone)


@pytest.mark.slow  # Half a minute of compiling.
def test_gradients_through_implicit_steps_agree_with_differences(record):
    scene, _ = loaded(1.0, 2.0, n=3)
    state = deformed(scene.rod, 2, largest_angle=0.2, largest_strain=0.02, speed=0.3)

    @jax.jit(compiler_options=HURRY)
    @jax.value_and_grad
    def loss(numbers):
        end = jaxrod.advance(*numbers, 3)
        weighed = replace(end, angular_momenta=1e3 * end.angular_momenta)
        return sum(
            jnp.vdot(leaf, jnp.cos(1.0 + jnp.arange(leaf.size)).reshape(leaf.shape))
            for leaf in jax.tree.leaves(weighed)
        )

    numbers = (scene, state, jnp.asarray(0.02))
    value, gradient = loss(numbers)
    leaves, structure = jax.tree.flatten(numbers)
    slopes = jax.tree.leaves(gradient)
    assert all(np.all(np.isfinite(slope)) for slope in slopes)
    random, size, worst, seen = np.random.default_rng(0), 1e-5, 0.0, 0
    for index, (leaf, slope) in enumerate(zip(leaves, slopes, strict=True)):
        push = (largest(leaf) or 1.0) * jnp.asarray(random.normal(size=leaf.shape))

        def at(sign, index=index, leaf=leaf, push=push):
            moved = [*leaves]
            moved[index] = leaf + sign * size * push
            return float(loss(structure.unflatten(moved))[0])

        expected = (at(1) - at(-1)) / (2 * size)
        got = float(jnp.vdot(slope, push))
        noise = 1e-9 * max(1.0, abs(float(value)))
        worst = max(worst, abs(got - expected) / max(abs(expected), noise / 1e-6))
        seen += abs(got) > noise
    assert seen >= 10, "too few numbers have an influence"
    record(
        "Gradient through three implicit steps: all parameters, loads, state, dt",
        "central differences",
        worst,
        at_most=1e-6,
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"spectral_radius": 1.5}, "spectral_radius must be at most 1, got 1.5"),
        ({"spectral_radius": -0.1}, "spectral_radius must be non-negative"),
        ({"tolerance": 0.0}, "tolerance must be positive"),
        ({"max_iterations": 0}, "max_iterations must be at least 1"),
    ],
)
def test_bad_settings_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        jaxrod.implicit(**arguments)


@pytest.mark.slow
def test_loads_that_change_in_time_are_taken_at_the_times_of_the_stages():
    """Velocity of a free rod in a field that grows and fades: second order in dt."""
    rod, state = jaxrod.straight_rod(
        3,
        length=1.0,
        radius=0.05,
        density=1000.0,
        youngs_modulus=1e6,
        dtype=jnp.float64,
    )
    duration, period, phase = 0.3, 0.5, 0.1
    field = jaxrod.schedules.sine((1.0, 0.0, 0.0), period, phase=phase)
    scene = jaxrod.make_scene(rod, jaxrod.gravity(field), method=jaxrod.implicit())
    turn = 2 * np.pi / period
    ends = np.cos(turn * np.array([0, duration]) + 2 * np.pi * phase)
    exact = (ends[0] - ends[1]) / turn
    errors = [
        abs(
            float(jaxrod.advance(scene, state, duration / n, n).velocities[0, 1])
            - exact
        )
        for n in (20, 40)
    ]
    assert errors[0] < 0.05 * abs(exact)
    assert 3.5 < errors[0] / errors[1] < 4.5

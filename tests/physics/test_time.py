"""Effects that depend on time: right to second order, exact clocks, nothing unsaid."""

from dataclasses import replace
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod

METHODS = {
    "consistent": jaxrod.consistent(),
    "pyelastica": jaxrod.pyelastica(),
    "planar": jaxrod.planar("zx"),
    "planar pyelastica": jaxrod.planar("zx", jaxrod.pyelastica()),
    "torsion-free": jaxrod.torsion_free(),
    "implicit": jaxrod.implicit(),
}
PERIOD, FORCE = 0.05, 2.0


@pytest.fixture(scope="module")
def rod_and_state():
    return jaxrod.straight_rod(
        4, length=1.0, radius=0.02, density=1000.0, youngs_modulus=1e6
    )


def shaken(rod, method=None, amplitude=FORCE, period=PERIOD):
    """A free rod under a force that is a sine of time, along x."""
    size = jnp.asarray([amplitude, 0.0, 0.0])
    return jaxrod.make_scene(
        rod, jaxrod.uniform_load(jaxrod.schedules.sine(size, period)), method=method
    )


def mean_position(rod, state):
    return jnp.sum(rod.node_masses[None] * state.positions, axis=1) / jnp.sum(
        rod.node_masses
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_a_rod_under_a_sine_moves_as_it_should_to_second_order(name, rod_and_state):
    rod, state = rod_and_state
    scene = shaken(rod, METHODS[name])
    omega, end = 2 * np.pi / PERIOD, 0.1
    mass = float(jnp.sum(rod.node_masses))
    exact = FORCE / mass * (end / omega - np.sin(omega * end) / omega**2)
    errors = []
    for n in (400, 800):
        after = jaxrod.advance(scene, state, end / n, n)
        moved = mean_position(rod, after) - mean_position(rod, state)
        errors.append(abs(float(moved[0]) / exact - 1))
    assert errors[1] < 2e-5
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.05)


@pytest.mark.slow
def test_pieces_that_say_where_they_begin_are_one_run(rod_and_state):
    rod, state = rod_and_state
    scene = shaken(rod)
    dt = jaxrod.stable_dt(scene).dt
    whole = jaxrod.rollout(scene, state, dt, 60, 10, first=5)
    piece = state
    for k in range(6):
        piece = jaxrod.rollout(scene, piece, dt, 10, 10, first=5 + 10 * k)
        piece = jax.tree.map(lambda a: a[-1], piece)
        record = jax.tree.map(lambda a, k=k: a[k + 1], whole)
        for one, other in zip(*map(jax.tree.leaves, (piece, record)), strict=True):
            np.testing.assert_allclose(one, other, rtol=0, atol=1e-15)
    other = jaxrod.advance(scene, state, dt, 60)
    assert not np.allclose(other.tip, piece.tip, rtol=0, atol=1e-9)


def test_one_step_at_a_time_is_advance(rod_and_state):
    rod, state = rod_and_state
    scene = shaken(rod)
    dt = jaxrod.stable_dt(scene).dt
    one = state
    for k in range(5):
        one = jaxrod.step(scene, one, dt, first=7 + k)
    many = jaxrod.advance(scene, state, dt, 5, first=7)
    np.testing.assert_allclose(one.positions, many.positions, rtol=0, atol=1e-15)


@pytest.mark.slow
def test_gradients_by_a_schedule_are_those_of_differences(rod_and_state):
    rod, state = rod_and_state

    def tip(numbers):
        scene = shaken(rod, None, numbers[0], numbers[1])
        return jaxrod.advance(scene, state, 1e-3, 40, first=3).tip[0]

    point = jnp.asarray([FORCE, PERIOD])
    found = jax.grad(tip)(point)
    for k in range(2):
        h = jnp.zeros(2).at[k].set(1e-5 * point[k])
        by_differences = (tip(point + h) - tip(point - h)) / (2 * h[k])
        assert found[k] == pytest.approx(float(by_differences), rel=1e-7)


@pytest.mark.slow
def test_a_batch_is_a_loop_with_starts_of_their_own(rod_and_state):
    rod, state = rod_and_state
    forces, firsts = jnp.asarray([0.5, 1.0, 2.0]), jnp.asarray([0, 10, 30])

    def tip(force, first):
        scene = shaken(rod, None, force)
        return jaxrod.advance(scene, state, 1e-3, 20, first=first).tip

    batch = jax.vmap(tip)(forces, firsts)
    for k in range(3):
        np.testing.assert_allclose(
            batch[k], tip(forces[k], firsts[k]), rtol=0, atol=1e-14
        )


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_phases_stay_exact_for_a_hundred_million_steps(dtype):
    random = np.random.default_rng(0)
    clock_phase = jax.jit(
        lambda step, dt, period: jaxrod.schedules.Clock(
            step, jnp.asarray(0.5, dtype), dt
        ).phase(period)
    )
    worst = 0.0
    for _ in range(300):
        dt = dtype(10 ** random.uniform(-6, -2))
        period = dtype(dt * 10 ** random.uniform(0.6, 5))
        step = int(10 ** random.uniform(0, 8))
        turns = (Fraction(step) + Fraction(1, 2)) * Fraction(float(dt))
        turns /= Fraction(float(period))
        exact = float(turns - turns.numerator // turns.denominator)
        found = float(clock_phase(jnp.int32(step), dt, period))
        apart = abs(found - exact)
        worst = max(worst, min(apart, 1 - apart))
    assert worst < 5e-7


def test_ramps_and_tables_have_their_values():
    clock = jaxrod.schedules.Clock(jnp.int32(0), jnp.asarray(0.0), jnp.asarray(1.0))
    times = np.array([-1.0, 0.0, 0.5, 1.0, 2.0, 5.0])

    def values(schedule):
        return [float(schedule(clock.later(t))) for t in times]

    rise = jaxrod.schedules.ramp(1.0, 3.0, 2.0)
    np.testing.assert_allclose(values(rise), np.interp(times, [0, 2], [1, 3]))
    knots = ([0.0, 1.0, 4.0], [2.0, -1.0, 5.0])
    np.testing.assert_allclose(
        values(jaxrod.schedules.table(*knots)), np.interp(times, *knots)
    )
    assert float(jaxrod.schedules.table(*knots).largest) == 5.0


def test_a_scene_without_schedules_is_the_same_program_wherever_it_begins(
    rod_and_state,
):
    rod, state = rod_and_state
    scene = jaxrod.make_scene(rod, jaxrod.gravity())

    def program(**options):
        run = jax.jit(lambda s, x: jaxrod.advance(s, x, 1e-3, 10, **options))
        return run.lower(scene, state).as_text()

    assert program(first=77) == program()


@jaxrod.extend.pytree
class Spring(jaxrod.extend.Effect):
    """From the last node to the origin, of a stiffness that may be a schedule."""

    stiffness: jax.Array

    def loads(self, rod, motion):
        forces = tuple(
            jnp.zeros_like(p).at[-1].set(-self.stiffness * p[-1])
            for p in motion.position
        )
        return jaxrod.extend.Loads(forces=forces)

    def stability_bound(self, rod):
        nodes = jnp.zeros_like(rod.node_masses).at[-1].set(self.stiffness)
        return jaxrod.extend.StabilityBound(nodes=nodes)


def test_ones_own_effect_takes_schedules_and_is_bounded_by_the_largest(rod_and_state):
    rod, _ = rod_and_state
    schedule = jaxrod.schedules.ramp(0.0, 1e6, 1.0)
    scene = jaxrod.make_scene(rod, Spring(schedule))
    stiff = jaxrod.make_scene(rod, Spring(jnp.asarray(1e6)))
    assert float(jaxrod.stable_dt(scene).dt) == float(jaxrod.stable_dt(stiff).dt)
    half = scene.at(0.5)
    assert float(half.effects[0].stiffness) == 5e5


@pytest.mark.slow
def test_what_asks_about_one_moment_wants_to_know_which(rod_and_state):
    rod, state = rod_and_state
    scene = jaxrod.make_scene(
        rod,
        jaxrod.clamp(state),
        jaxrod.gravity(jaxrod.schedules.ramp((0.0,) * 3, (1.0,) * 3, 1)),
    )
    for ask in (
        lambda: scene.total_energy(state),
        lambda: jaxrod.health(scene, state, 1e-4),
        lambda: jaxrod.equilibrium(scene, state),
        lambda: jaxrod.natural_frequencies(scene, state),
        lambda: jaxrod.reactions(scene, state),
        lambda: jaxrod.highest_frequency(scene, state),
    ):
        with pytest.raises(ValueError, match=r"give scene\.at\(time\)"):
            ask()
    scene.at(0.5).total_energy(state)
    jaxrod.health(scene.at(0.5), state, 1e-4)
    assert jaxrod.equilibrium(scene.at(0.5), state).converged


def stiffening(name, state):
    """An effect with a schedule, by name, and a support with one."""
    growing = jaxrod.schedules.ramp(0.0, 400.0, 1.0)
    pull = jaxrod.schedules.ramp((0.0, 0.0, 0.0), (0.0, 0.0, 20.0), 1.0)
    turn = jaxrod.schedules.ramp(0.0, 1.0, 1.0)
    floor = jaxrod.contact(jaxrod.shapes.plane((0.0, 0.0, -0.1)), stiffness=1e4)
    return {
        "spring": lambda: Spring(growing),
        "follower load": lambda: jaxrod.end_load(pull, follower=True),
        "wall": lambda: jaxrod.driven(state, axis=(0.0, 1.0, 0.0), angle=turn),
        "floor": lambda: jaxrod.moving_contact(
            floor, displacement=jaxrod.schedules.ramp((0.0,) * 3, (0.0, 0.0, 0.1), 1.0)
        ),
    }[name]()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["spring", "follower load", "wall", "floor"])
def test_a_step_measured_with_a_schedule_is_stable_at_all_times(name, rod_and_state):
    rod, state = rod_and_state
    bent = replace(state, positions=state.positions.at[0].add(0.01 * jnp.arange(5)))
    scene = jaxrod.make_scene(rod, stiffening(name, state))
    always = float(jaxrod.stable_dt(scene, 1.0, state=bent).dt)
    measured = [
        float(jaxrod.stable_dt(scene.at(t), 1.0, state=bent).dt)
        for t in (0.0, 0.5, 1.0)
    ]
    assert always <= min(measured) * (1 + 1e-3)
    assert always > 0.7 * min(measured)


@pytest.mark.slow
def test_a_schedule_without_stiffness_leaves_the_measured_step(rod_and_state):
    rod, state = rod_and_state
    weight = jaxrod.schedules.ramp((0.0,) * 3, (0.0, 0.0, -9.81), 1.0)
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state), jaxrod.gravity(weight))
    still = replace(scene, effects=scene.effects[:1])
    found, expected = (jaxrod.stable_dt(one, state=state).dt for one in (scene, still))
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def timed_scene(rod, state):
    """A clamped rod with a weight, a shape and muscles that change with time."""
    table = jaxrod.schedules.table([0.0, 1.0], [[0.0, 0.0], [1.0, 0.5]])
    return jaxrod.make_scene(
        rod,
        jaxrod.clamp(state),
        jaxrod.gravity(jaxrod.schedules.ramp((0.0,) * 3, (0.0, 0.0, -9.81), 1.0)),
        jaxrod.actuation.active_shape(
            rod, curvature=jaxrod.schedules.ramp((0.0,) * 3, (1.0, 0.0, 0.0), 1.0)
        ),
        jaxrod.actuation.muscle(
            rod, (2.0, 3.0), offsets=((0.01, 0.0),) * 2, activation=table
        ),
    )


def test_resampling_and_a_moment_of_time_commute(rod_and_state):
    rod, state = rod_and_state
    scene = timed_scene(rod, state)
    finer, moved = jaxrod.resample(scene, state, 7)
    for t in (0.0, 0.3, 0.9):
        expected, its_state = jaxrod.resample(scene.at(t), state, 7)
        pairs = zip(
            jax.tree.leaves((finer.at(t), moved)),
            jax.tree.leaves((expected, its_state)),
            strict=True,
        )
        for now, then in pairs:
            np.testing.assert_allclose(now, then, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_schedules_of_numbers_along_the_rod_are_refused_by_name(rod_and_state):
    rod, state = rod_and_state
    rising = jaxrod.schedules.ramp(np.zeros((1, 4)), np.ones((1, 4)), 1.0)
    muscle = jaxrod.actuation.muscle(
        rod, 2.0, offsets=((0.01, 0.0),), activation=rising
    )
    spline = jaxrod.actuation.control_spline(4, rod.length)
    turning = jaxrod.schedules.ramp(np.zeros((3, 4)), np.ones((3, 4)), 1.0)
    couples = jaxrod.actuation.spline_couples(rod, spline, turning, 0.1)
    for effect in (muscle, couples):
        with pytest.raises(ValueError, match="a schedule of numbers along a rod"):
            jaxrod.resample(jaxrod.make_scene(rod, effect), state, 8)


def test_a_load_that_leaves_the_plane_later_is_refused_now(rod_and_state):
    rod, state = rod_and_state
    later = jaxrod.schedules.ramp((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 1.0)
    scene = jaxrod.make_scene(
        rod, jaxrod.uniform_load(later), method=jaxrod.planar("zx")
    )
    with pytest.raises(ValueError, match="forces of effects"):
        jaxrod.advance(scene, state, 1e-4, 1)


@jaxrod.extend.pytree
class Timeless(jaxrod.extend.Method):
    """A method of one's own that is not for what changes."""

    def check_evolving(self, scene):
        names = [type(effect).__name__ for effect in scene.evolving_effects]
        raise ValueError(f"Timeless is not for {names}")


def test_a_method_is_asked_about_what_evolves_and_about_nothing_else(rod_and_state):
    rod, state = rod_and_state
    still = jaxrod.clamp(state), jaxrod.gravity()
    jaxrod.make_scene(rod, *still, method=Timeless())
    later = jaxrod.end_load(force=jaxrod.schedules.ramp((0.0,) * 3, (1.0,) * 3, 1.0))
    with pytest.raises(ValueError, match=r"Timeless is not for \['EndLoad'\]"):
        jaxrod.make_scene(rod, *still, later, method=Timeless())


def test_a_wall_that_turns_is_refused_where_twist_is_dropped(rod_and_state):
    rod, state = rod_and_state
    frame = state.orientations[:, 0]
    turning = replace(
        jaxrod.clamp(state), orientation=jaxrod.schedules.ramp(frame, frame, 1.0)
    )
    with pytest.raises(ValueError, match="walls that stand still, got Clamp"):
        jaxrod.make_scene(rod, turning, method=jaxrod.torsion_free())


@jaxrod.extend.pytree
class Thinning(jaxrod.extend.Effect):
    """Damping of a rate that may be a schedule."""

    rate: jax.Array

    def damping_rates(self, rod):
        return self.rate, self.rate


def test_bad_schedules_are_refused_in_words(rod_and_state):
    rod, state = rod_and_state
    for make, words in (
        (
            lambda: jaxrod.gravity(jaxrod.schedules.ramp(0.0, 1.0, 1.0)),
            r"acceleration must have",
        ),
        (
            lambda: jaxrod.schedules.ramp(0.0, (1.0, 2.0), 1.0),
            "first and last must have the",
        ),
        (lambda: jaxrod.schedules.ramp(0.0, 1.0, 0.0), "duration must be positive"),
        (lambda: jaxrod.schedules.sine(1.0, -1.0), "period must be positive"),
        (lambda: jaxrod.schedules.table([0.0], [1.0]), "times must be at least two"),
        (lambda: jaxrod.schedules.table([0.0, 0.0], [1.0, 2.0]), "times must increase"),
        (
            lambda: jaxrod.schedules.table([0.0, 1.0], [1.0]),
            "for each of 2 times",
        ),
        (
            lambda: jaxrod.make_scene(
                rod, Thinning(jaxrod.schedules.ramp(0.0, 1.0, 1.0))
            ),
            "has damping rates, so it must",
        ),
        (
            lambda: jaxrod.advance(shaken(rod), state, 1e-4, 1, first=-1),
            "first must be at least 0",
        ),
        (
            lambda: jaxrod.advance(shaken(rod), state, 1e-4, 10, first=2**31 - 5),
            "first must be at most",
        ),
        (
            lambda: jaxrod.advance(shaken(rod), state, 1e-4, 1, first=1.5),
            "first must be an integer",
        ),
    ):
        with pytest.raises(ValueError, match=words):
            make()


@pytest.mark.slow
@pytest.mark.default_precision
def test_a_sine_stays_a_sine_in_single_precision():
    """After ten million steps a clock of float32 would be lost."""
    rod, state = jaxrod.straight_rod(
        2, length=1.0, radius=0.05, density=1000.0, youngs_modulus=1e5
    )
    scene = shaken(rod, None, 1.0, 0.0123)
    first = 10_000_000
    dt = np.float32(1e-3)
    moved = jaxrod.step(scene, state, dt, first=first).velocities[0, 0]
    time = (Fraction(first) + Fraction(1, 2)) * Fraction(float(dt))
    phase = float((time / Fraction(float(np.float32(0.0123)))) % 1)
    mass = float(jnp.sum(rod.node_masses))
    assert float(moved) == pytest.approx(
        float(dt) / mass * np.sin(2 * np.pi * phase), rel=1e-4, abs=1e-9
    )

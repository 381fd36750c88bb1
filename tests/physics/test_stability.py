"""The stable step against the true limit, where damped oscillations stop decaying."""

import warnings
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import jaxrod
from jaxrod.analysis.frequency import fastest_vibration, linearised, no_damping
from jaxrod.analysis.stability import compression
from jaxrod.envs.tasks.tracking import tracking
from jaxrod.methods.laws import IN_SPACE
from jaxrod.structure import pytree
from physics.rods import arm, deformed, random_rod
from physics.small_motions import (
    frequencies,
    held_freedoms,
    no_moves,
    perturb,
    unbalance,
)

# One program per count and kind of end, so few are compiled. True: clamped.
FEW = {2: True, 10: False}
MANY = {2: True, 3: False, 5: True, 8: False, 13: True, 20: False, 35: True, 60: False}


def drawn(seed, n, wall):
    """A random rod, tapered and curved, slender or stubby, damped or not.

    Returns the scene, the same without damping, the state at rest, the damping rates
    and the free freedoms.
    """
    rod, state = random_rod(seed, n)
    random = np.random.default_rng(seed)
    rates = np.zeros(2)
    if seed % 3:
        rates = 10 ** random.uniform(-3, 0.5, 2)
        rates *= float(jaxrod.stable_dt(jaxrod.make_scene(rod)).angular_frequency)
    bare = jaxrod.make_scene(rod, *([jaxrod.clamp(state)] if wall else []))
    damping = jaxrod.exponential_damping(*rates)
    scene = replace(bare, effects=(*bare.effects, damping))
    return scene, bare, state, rates, held_freedoms(rod, wall)


def highest(scene, stiffness, free, factors=(1.0, 1.0)):
    """Highest frequency if masses and rotary inertias were larger by two factors."""
    transverse, polar = scene.rod.inertias
    inertia = np.ravel([transverse, transverse, polar])
    masses = np.tile(scene.rod.node_masses, 3)
    root = np.sqrt(np.concatenate([factors[0] * masses, factors[1] * inertia]))
    matrix = (stiffness / root / root[:, None])[np.ix_(free, free)]
    return np.sqrt(np.linalg.eigvalsh((matrix + matrix.T) / 2)[-1])


def true_limit(scene, state, free, rates=(0.0, 0.0)):
    """The largest stable step of position Verlet for small motions [s].

    A motion that changes its sign in every step, with kicks that solve damping
    exactly, is possible where stiffness balances inertia times
    (2 / h^2) g h coth(g h / 2).
    """
    stiffness = np.asarray(unbalance(scene, state)[1])
    limit = 2 / highest(scene, stiffness, free)
    if not np.any(rates):
        return limit
    for _ in range(30):
        half = np.maximum(np.asarray(rates) * limit / 2, 1e-9)
        limit = 2 / highest(scene, stiffness, free, half / np.tanh(half))
    return limit


@jax.jit
def excursion(scene, state, dt):
    """How far a rod disturbed by 1e-8 gets from its rest shape in 2000 steps [m]."""
    noise = 1e-8 * jax.random.normal(jax.random.key(0), state.positions.shape)
    disturbed = replace(state, positions=state.positions + noise.at[:, 0].set(0))
    after = jaxrod.advance(scene, disturbed, dt, jnp.asarray(2000))
    return jnp.max(jnp.abs(after.positions - state.positions))


def examine(counts, seeds, record):
    """The bars of the stable step, on random rods."""
    ratios, excursions = [], []
    for index, seed in enumerate(seeds):
        n, wall = list(counts.items())[index % len(counts)]
        scene, bare, state, rates, free = drawn(seed, n, wall)
        bound = jaxrod.stable_dt(scene, 1.0).dt
        limit = true_limit(bare, state, free, rates)
        ratios.append(float(bound) / limit)
        excursions.append(float(excursion(scene, state, bound)))
        with pytest.warns(jaxrod.UnstableStepWarning):
            jaxrod.advance(scene, state, 1.05 * limit, 0)
    feature = f"Stable step divided by the true limit, {len(ratios)} random rods"
    reference = "2/omega_max, from the tangent stiffness"
    record(f"{feature}: largest", reference, max(ratios), at_most=1 + 1e-9)
    record(f"{feature}: mean", reference, np.mean(ratios), between=(0.9, 1.0))
    record(
        f"Largest excursion at that step in 2000 steps after noise of 1e-8 m, "
        f"{len(ratios)} random rods [m]",
        "bounded",
        max(excursions),
        at_most=1e-6,
    )


@pytest.mark.slow
def test_the_stable_step_is_safe_and_close(record):
    examine(FEW, range(18), record)


@pytest.mark.slow
def test_the_stable_step_is_safe_and_close_for_two_hundred_rods(record):
    examine(MANY, range(1000, 1208), record)


# Radius, Young's modulus, elements, and the true limit of the free rod [s].
TABLE = {
    "arm, n = 5": (0.05, 1e7, 5, 7.96e-4),
    "arm, n = 10": (0.05, 1e7, 10, 6.39e-4),
    "thin rope, n = 10": (0.002, 1e7, 10, 3.527e-5),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", TABLE)
def test_the_limit_of_well_known_rods(name, record):
    radius, modulus, n, published = TABLE[name]
    rod, state = arm(n, radius=radius, youngs_modulus=modulus)
    scene = jaxrod.make_scene(rod)
    limit = true_limit(scene, state, held_freedoms(rod, node=False))
    assert limit == pytest.approx(published, rel=5e-3)
    record(
        f"Stable step divided by the true limit: {name}",
        f"{limit:.3g} s",
        float(jaxrod.stable_dt(scene, 1.0).dt) / limit,
        between=(0.99, 1.0),
    )


# Damping, over the highest frequency. Where the law of PyElastica damps more than that
# in a step, the limit is not one number: the bound is below the first of several.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("mode", "rates"),
    [
        ("consistent", (0.0, 0.0)),
        ("consistent", (0.02, 1.0)),
        pytest.param("pyelastica", (0.0, 0.0), marks=pytest.mark.slow),
        pytest.param("pyelastica", (0.02, 0.3), marks=pytest.mark.slow),
    ],
)
def test_stable_below_the_measured_limit_and_not_above(mode, rates):
    rod, state = arm(5, radius=0.02)
    bare = jaxrod.make_scene(rod, method=IN_SPACE[mode])
    frequency = float(jaxrod.highest_frequency(bare, state))
    damping = jaxrod.exponential_damping(*(frequency * np.asarray(rates)))
    scene = jaxrod.make_scene(rod, damping, method=IN_SPACE[mode])
    limit = jaxrod.stable_dt(scene, 1.0, state=state).dt
    assert (limit > 1.1 * 2 / frequency) == any(rates)
    assert excursion(scene, state, 0.99 * limit) < 1e-6
    # Not a test for NaN: above the limit a rod may well thrash about with none.
    assert not excursion(scene, state, 1.03 * limit) < 1e-4


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("run", [jaxrod.advance, jaxrod.rollout])
def test_a_step_above_the_bound_is_warned_of(run):
    rod, state = arm(5)
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state))
    bound = float(jaxrod.stable_dt(scene, 1.0).dt)
    words = "shear and bending"
    with pytest.warns(jaxrod.UnstableStepWarning, match=words) as warned:
        run(scene, state, 1.01 * bound, 2)
    assert [one.filename for one in warned] == [__file__]
    with warnings.catch_warnings():
        warnings.simplefilter("error", jaxrod.UnstableStepWarning)
        run(scene, state, 0.99 * bound, 2)
        with pytest.raises(jaxrod.UnstableStepWarning, match="above the stability"):
            run(scene, state, 1.01 * bound, 2)


def squeezed(state, stretch):
    return replace(state, positions=stretch * state.positions)


@pytest.mark.slow
def test_the_guard_knows_that_compression_stiffens_pyelasticas_law():
    rod, state = arm(5)
    scene = jaxrod.make_scene(rod, method=jaxrod.pyelastica())
    dt = 0.9 * jaxrod.stable_dt(scene, 1.0).dt
    with pytest.warns(jaxrod.UnstableStepWarning, match="compressed to 0.5"):
        jaxrod.advance(scene, squeezed(state, 0.5), dt, 1)
    jaxrod.advance(
        replace(scene, method=jaxrod.consistent()), squeezed(state, 0.5), dt, 1
    )


EXTENTS = (0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98, 1.0, 1.05, 1.2)


def test_compression_raises_the_highest_frequency_as_the_guard_says(record):
    """By up to 0.6 of the compression, and by a tenth at the most."""
    errors, rises, slopes = [], [], []
    for radius in (0.05, 0.02, 0.005):
        rod, state = arm(5, radius=radius)
        scene = jaxrod.make_scene(rod)
        rest = float(jaxrod.highest_frequency(scene, state))
        for extent in EXTENTS:
            at = squeezed(state, extent)
            rise = float(jaxrod.highest_frequency(scene, at)) / rest
            factor, shortest = compression(scene, at)
            assert shortest == pytest.approx(extent)
            errors.append(abs(min(1 / rise, 1) / float(factor) - 1))
            rises.append(rise)
            if 0.9 <= extent < 1:
                slopes.append((rise - 1) / (1 - extent))
    record(
        "Reduction of the stability bound by compression, relative error",
        "highest frequency as measured",
        max(errors),
        at_most=2e-3,
    )
    record(
        "Highest frequency of rods compressed to 0.3 and less, divided by the "
        "frequency at rest",
        "measured; 1 / the safety factor that is always enough",
        max(rises),
        between=(1.05, 1 / 0.9),
    )
    assert max(slopes) < 0.6


@pytest.mark.slow
def test_a_shape_that_changes_in_time_is_checked_near_the_bound():
    """A ramp of curvature is what its larger end is, with a warning above the bound."""
    rod, state = arm(n_elements=4)
    ends = jnp.zeros(3), jnp.asarray([3.0, 0.0, 0.0])
    ramp = jaxrod.schedules.Ramp(
        *ends, start=jnp.asarray(0.0), duration=jnp.asarray(1.0)
    )
    made = [
        jaxrod.make_scene(rod, jaxrod.actuation.active_shape(rod, curvature=c))
        for c in (ramp, ends[1])
    ]
    near = 0.98 * jaxrod.stable_dt(made[0], 1.0).dt
    after = jaxrod.advance(made[0], state, near, 2)
    assert jnp.all(jnp.isfinite(after.positions))
    found, expected = (compression(scene, state) for scene in made)
    np.testing.assert_array_equal(found, expected)
    with pytest.warns(jaxrod.UnstableStepWarning):
        jaxrod.advance(made[0], state, 1.1 * near, 2)


def soft_swing(safety):
    """A soft arm that swings under its weight, compressed by 5 % now and then."""
    rod, state = arm(10, youngs_modulus=1e6, direction=(1.0, 0.0, 0.0))
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state), jaxrod.gravity())
    return scene, state, jaxrod.stable_dt(scene, safety).dt


@pytest.mark.slow
def test_a_step_near_the_bound_is_warned_of_once_the_rod_is_compressed():
    """Before anything is wrong where `advance` gets to see it, else afterwards."""
    scene, state, dt = soft_swing(0.999)
    with pytest.warns(jaxrod.UnstableStepWarning, match=r"compressed to 0\.9"):
        for _ in range(10):
            state = jaxrod.advance(scene, state, dt, 100)
    assert abs(scene.total_energy(state)) < 0.01
    scene, state, dt = soft_swing(0.999)
    with pytest.warns(jaxrod.UnstableStepWarning, match="compressed to"):
        after = jaxrod.advance(scene, state, dt, 8000)
    assert scene.total_energy(after) > 1e6
    assert jaxrod.health(scene, after, dt).flagged


@pytest.mark.slow
def test_a_safety_factor_of_nine_tenths_covers_compression():
    scene, state, dt = soft_swing(0.9)
    after = jaxrod.advance(scene, state, dt, 8000)
    assert abs(scene.total_energy(after)) < 0.5
    assert not jaxrod.health(scene, after, dt).flagged


@pytest.mark.slow
@pytest.mark.parametrize(("safety", "sound"), [(0.65, True), (0.8, False)])
def test_violent_vibrations_of_single_elements_need_a_smaller_step(safety, sound):
    """Strains of a tenth and a radian from each element to the next, undamped."""
    rod, _ = arm(20)
    scene = jaxrod.make_scene(rod)
    dt = jaxrod.stable_dt(scene, safety).dt
    for seed in range(4):
        state = deformed(rod, seed, largest_angle=1.0, largest_strain=0.1)
        after = jaxrod.advance(scene, state, dt, 4000)
        before = scene.total_energy(state)
        kept = scene.total_energy(after) < 1.3 * before
        report = jaxrod.health(scene, after, dt, energy_before=before, n_steps=4000)
        assert kept or report.energy
        if not kept:
            assert not sound
            return
    assert sound


@pytest.mark.slow
def test_the_limiting_motion_is_named():
    slender, state = arm(5, radius=0.005)
    assert (
        "shear and bending"
        in jaxrod.stable_dt(jaxrod.make_scene(slender)).limiting_mode
    )
    rod, _ = arm(5)
    stiff = rod.shear_stretch_stiffness.at[2, 3].mul(100)
    stretchy = jaxrod.make_scene(replace(rod, shear_stretch_stiffness=stiff))
    twist = rod.bend_twist_stiffness.at[2].mul(100)
    twisty = jaxrod.make_scene(replace(rod, bend_twist_stiffness=twist))
    for measured in (None, state):
        named = jaxrod.stable_dt(stretchy, state=measured).limiting_mode
        assert named == "stretch of element 3"
        named = jaxrod.stable_dt(twisty, state=measured).limiting_mode
        assert "twist" in named


@pytest.mark.slow
def test_the_published_tracking_arms_limit_knows_of_its_explicit_drag():
    env = tracking("paper", n_elements=10)
    with jax.enable_x64(True):
        arm = env.default_params().arm
        scene = arm.scene()
        stable = jaxrod.stable_dt(scene, 1.0)
        without = 2 / stable.angular_frequency
        assert stable.dt < 0.95 * without
        assert excursion(scene, arm.rest, 0.99 * stable.dt) < 1e-6
        measured = jaxrod.stable_dt(scene, 1.0, state=arm.rest).dt
        assert measured == pytest.approx(float(stable.dt), rel=0.05)
        assert not excursion(scene, arm.rest, 1.03 * measured) < 1e-4


@pytest.mark.slow
def test_deformed_rods_stay_within_the_safety_factor(record):
    """The bound is for the unstressed rod; the default factor covers the rest."""
    worst = 0.0
    for seed in range(6):
        rod, _ = arm(5, radius=(0.01, 0.05)[seed % 2])
        scene = jaxrod.make_scene(rod)
        bent = deformed(rod, seed, largest_angle=0.8, largest_strain=0.3)
        default = float(jaxrod.stable_dt(scene).dt)
        measured = jaxrod.stable_dt(scene, 1.0, state=bent).dt
        worst = max(worst, default / measured)
    record(
        "Default step over the true limit of strongly deformed rods, largest",
        "2/omega_max, measured at the deformation",
        worst,
        at_most=1.0,
    )


@pytest.mark.slow
def test_the_highest_frequency_is_that_of_the_tangent_stiffness(record):
    n, errors = 10, []
    for seed in range(5):
        rod, state = random_rod(seed, n)
        scene = jaxrod.make_scene(rod)
        for at in (state, deformed(rod, seed, 0.8, 0.3)):
            exact = frequencies(scene, at)[-1]
            errors.append(float(jaxrod.highest_frequency(scene, at)) / exact - 1)
    record(
        f"Highest frequency by iteration, n = {n}, ten random rods at rest and bent",
        "eigenvalues of the tangent stiffness",
        np.max(np.abs(errors)),
        at_most=1e-3,
    )


@pytest.mark.slow
def test_the_fastest_vibration_is_an_eigenvector():
    n = 3
    rod, state = random_rod(2, n)
    scene, factors = jaxrod.make_scene(rod), no_damping(rod)
    found = fastest_vibration(scene, state, factors, 6 * n + 3)
    size = 6 * n + 3
    apply = linearised(scene, state, factors)
    matrix = np.asarray(jax.jit(jax.vmap(apply))(jnp.eye(size)))
    squares, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    shares = vectors[:, -1] ** 2
    assert float(found.angular_frequency) == pytest.approx(squares[-1] ** 0.5, rel=1e-3)
    # Directions across a rod that is nearly round mix, nodes and elements do not.
    nodes, elements = shares[: 3 * n + 3].reshape(3, -1), shares[3 * n + 3 :]
    for ours, exact in (
        (found.displacements, nodes),
        (found.turns, elements.reshape(3, -1)),
    ):
        np.testing.assert_allclose(
            np.sum(ours**2, axis=0), exact.sum(axis=0), atol=0.01
        )


def accelerations(scene, state, moves):
    """Scaled by the root of inertia, from one tiny step begun at rest."""
    dt = 1e-9
    after = jaxrod.step(scene, perturb(state, moves), dt)
    spins = jaxrod.angular_velocities(scene.rod, after)
    return after.velocities / dt, spins / dt


@pytest.mark.slow
@pytest.mark.parametrize("stretch", [0.5, pytest.param(0.1, marks=pytest.mark.slow)])
def test_pyelasticas_frequencies_grow_as_one_over_the_stretch(stretch):
    rod, state = arm(2, radius=0.02)
    scene = jaxrod.make_scene(rod, method=jaxrod.pyelastica())
    short = squeezed(state, stretch)
    moves, unravel = ravel_pytree(no_moves(state))
    tangent = jax.jacfwd(
        lambda flat: ravel_pytree(accelerations(scene, short, unravel(flat)))[0]
    )
    matrix = jax.jit(tangent)(moves)
    exact = np.sqrt(np.max(np.abs(np.linalg.eigvals(-np.asarray(matrix)))))
    measured = float(jaxrod.highest_frequency(scene, short))
    assert measured == pytest.approx(exact, rel=2e-3)
    rest = float(jaxrod.stable_dt(scene).angular_frequency)
    assert measured <= rest / stretch * (1 + 1e-3)
    consistent = replace(scene, method=jaxrod.consistent())
    assert float(jaxrod.highest_frequency(consistent, short)) <= 1.1 * rest


@pytree
class Springs(jaxrod.extend.Effect):
    """Every node tied to where it was, every element to how it was, with drag."""

    origin: jax.Array
    stiffness: jax.Array
    drag: jax.Array

    def loads(self, rod, motion):
        return jaxrod.extend.Loads(
            forces=tuple(
                -self.stiffness * (now - then) - self.drag * speed
                for now, then, speed in zip(
                    motion.position, self.origin, motion.velocity, strict=True
                )
            )
        )

    def stability_bound(self, rod):
        return jaxrod.extend.StabilityBound(nodes=self.stiffness, node_drag=self.drag)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.01, 1.0, 100.0])
def test_an_effects_own_stiffness_and_drag_are_in_the_bound(share):
    rod, state = random_rod(3, 5)
    bare = jaxrod.stable_dt(jaxrod.make_scene(rod), 1.0)
    mass = jnp.min(rod.node_masses)
    stiffness = share * bare.angular_frequency**2 * mass
    drag = 0.3 * bare.angular_frequency * mass
    scene = jaxrod.make_scene(rod, Springs(state.positions, stiffness, drag))
    bound = jaxrod.stable_dt(scene, 1.0).dt
    measured = jaxrod.stable_dt(scene, 1.0, state=state).dt
    assert bound <= measured * (1 + 1e-3)
    assert bound > 0.5 * measured
    assert excursion(scene, state, 0.99 * measured) < 1e-6
    assert not excursion(scene, state, 1.03 * measured) < 1e-4


def test_a_rod_sheared_at_rest_is_bounded_too():
    for seed in range(3):
        rod, _ = arm(5, radius=(0.02, 0.05, 0.1)[seed])
        odd = deformed(rod, seed, 0.5, 0.3)
        scene = jaxrod.make_scene(jaxrod.unstressed(rod, odd))
        ratio = jaxrod.stable_dt(scene, 1.0).dt / true_limit(
            scene, odd, held_freedoms(rod, node=False)
        )
        assert 0.6 < ratio <= 1


@pytest.mark.slow
def test_measuring_works_inside_jit_and_vmap():
    rod, state = arm(5, dtype=jnp.float32)
    scene = jaxrod.make_scene(rod)
    stretches = jnp.asarray([0.5, 1.0, 1.5], jnp.float32)

    def measure(stretch):
        return jaxrod.stable_dt(scene, state=squeezed(state, stretch)).dt

    together = jax.jit(jax.vmap(measure))(stretches)
    assert together.dtype == jnp.float32
    alone = [measure(stretch) for stretch in stretches]
    np.testing.assert_allclose(together, alone, rtol=1e-3)


@pytest.mark.parametrize(
    "measured", [False, pytest.param(True, marks=pytest.mark.slow)]
)
def test_steps_of_small_stiff_rods_are_those_of_large_soft_ones_in_float32(measured):
    """Squares of their squared frequencies are beyond float32."""

    def step(length, youngs_modulus):
        rod, state = jaxrod.straight_rod(
            10,
            length=length,
            radius=0.05 * length,
            density=1000.0,
            youngs_modulus=youngs_modulus,
            dtype=jnp.float32,
        )
        scene = jaxrod.make_scene(rod, jaxrod.clamp(state))
        return float(jaxrod.stable_dt(scene, state=state if measured else None).dt)

    for length, youngs_modulus in [(1e-6, 1e11), (1e-5, 1e9), (1e3, 1.0)]:
        scale = length * np.sqrt(1e7 / youngs_modulus)
        assert step(length, youngs_modulus) == pytest.approx(
            scale * step(1.0, 1e7), rel=1e-2 if measured else 1e-5
        )

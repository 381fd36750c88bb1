"""The stable step against the true limit, 2 over the highest frequency of the rod."""

import warnings
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from physics.rods import arm, deformed, random_rod
from physics.small_motions import frequencies, held_freedoms

COUNTS = (2, 5, 10, 20)  # Few sizes, so that few programs are compiled.
SEEDS = range(40)


def drawn(seed, wall):
    """A random rod, tapered and curved, slender or stubby; and its free freedoms."""
    rod, state = random_rod(seed, COUNTS[seed % len(COUNTS)])
    if wall:
        scene = jaxrod.make_scene(rod, jaxrod.clamp(state))
        return scene, state, held_freedoms(rod)
    return jaxrod.make_scene(rod), state, None


def true_limit(scene, state, free=None):
    """The largest stable step of position Verlet for small motions [s]."""
    return 2 / frequencies(scene, state, free)[-1]


def test_the_stable_step_is_never_above_the_true_limit(record):
    ratios = []
    for seed in SEEDS:
        scene, state, free = drawn(seed, wall=seed // 4 % 2)
        bound = float(jaxrod.stable_dt(scene, 1.0).dt)
        ratios.append(bound / true_limit(scene, state, free))
    feature = f"Stable step over the true limit, {len(ratios)} random rods"
    reference = "2/omega_max, from the tangent stiffness"
    record(f"{feature}: largest", reference, max(ratios), at_most=1 + 1e-9)
    record(f"{feature}: mean", reference, np.mean(ratios), between=(0.8, 1.0))


# Radius, Young's modulus, elements, and the true limit of the free rod [s].
TABLE = {
    "arm, n = 5": (0.05, 1e7, 5, 7.96e-4),
    "arm, n = 10": (0.05, 1e7, 10, 6.39e-4),
    "arm, n = 20": (0.05, 1e7, 20, 4.21e-4),
    "thin rope, n = 20": (0.002, 1e7, 20, 3.516e-5),
}


@pytest.mark.parametrize("name", TABLE)
def test_the_limit_of_well_known_rods(name, record):
    radius, modulus, n, published = TABLE[name]
    rod, state = arm(n, radius=radius, youngs_modulus=modulus)
    scene = jaxrod.make_scene(rod)
    limit = true_limit(scene, state)
    assert limit == pytest.approx(published, rel=5e-3)
    record(
        f"Stable step over the true limit: {name}",
        f"{limit:.3g} s",
        float(jaxrod.stable_dt(scene, 1.0).dt) / limit,
        between=(0.85, 1.0),
    )


@jax.jit
def excursion(scene, state, dt):
    """How far a slightly disturbed rod gets from its rest shape in 2000 steps [m]."""
    noise = 1e-8 * jax.random.normal(jax.random.key(0), state.positions.shape)
    disturbed = replace(state, positions=state.positions + noise.at[:, 0].set(0))
    after = jaxrod.advance(scene, disturbed, dt, jnp.asarray(2000))
    return jnp.max(jnp.abs(after.positions - state.positions))


@pytest.mark.parametrize("mode", ["consistent", "pyelastica"])
@pytest.mark.parametrize("radius", [0.005, 0.05, 0.2])
def test_stable_below_the_true_limit_and_not_above(mode, radius):
    rod, state = arm(5, radius=radius)
    scene = jaxrod.make_scene(rod, mode=mode)
    limit = true_limit(scene, state)
    assert excursion(scene, state, 0.95 * limit) < 1e-6
    # Not a test for NaN: above the limit a rod may well thrash about with none.
    assert not excursion(scene, state, 1.05 * limit) < 1e-4


@pytest.mark.parametrize("run", [jaxrod.advance, jaxrod.rollout])
def test_a_step_above_the_bound_is_warned_of(run):
    rod, state = arm(5)
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state))
    bound = float(jaxrod.stable_dt(scene, 1.0).dt)
    with pytest.warns(jaxrod.UnstableStepWarning, match="shear and bending"):
        run(scene, state, 1.01 * bound, 2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run(scene, state, 0.99 * bound, 2)


def test_the_limiting_motion_is_named():
    slender = jaxrod.make_scene(arm(5, radius=0.005)[0])
    assert "shear and bending" in jaxrod.stable_dt(slender).limiting_mode
    rod, _ = arm(5)
    stiff = rod.shear_stretch_stiffness.at[2, 3].mul(100)
    stretchy = replace(rod, shear_stretch_stiffness=stiff)
    named = jaxrod.stable_dt(jaxrod.make_scene(stretchy)).limiting_mode
    assert named == "stretch of element 3"
    twisty = replace(rod, bend_twist_stiffness=rod.bend_twist_stiffness.at[2].mul(100))
    assert "twist" in jaxrod.stable_dt(jaxrod.make_scene(twisty)).limiting_mode


def test_deformed_rods_stay_within_the_safety_factor(record):
    """The bound is for the straight rod; the default factor covers the rest."""
    worst = 0.0
    for seed in range(6):
        rod, _ = arm(10, radius=(0.01, 0.05)[seed % 2])
        scene = jaxrod.make_scene(rod)
        bent = deformed(rod, seed, largest_angle=0.8, largest_strain=0.3)
        default = float(jaxrod.stable_dt(scene).dt)
        worst = max(worst, default / true_limit(scene, bent))
    record(
        "Default step over the true limit of strongly deformed rods, largest",
        "2/omega_max, from the tangent stiffness",
        worst,
        at_most=1.0,
    )

"""A few pairs of equivalent programs; `pairs.py` draws as many as one likes."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from extremes.pair_cases import (
    ALLOWED,
    ROUNDING,
    STRUCTURES,
    Structure,
    differences,
)
from extremes.pair_kinds import Kind
from extremes.pair_scenes import rod_in
from extremes.views import View, of_matrix, product, random_turn

# Scenes and systems whose programs are small. Tens of warnings of thick rods say
# nothing here.
pytestmark = pytest.mark.filterwarnings("ignore")


def apart(case):
    return [
        f"{kind}: {apart:.1e} at {where}, {ratio / ALLOWED:.1e} of what is allowed"
        for kind, ratio, apart, where in case.results
        if not ratio <= ALLOWED
    ]


def check(what, seed, pairs, record, kind=None):
    made = STRUCTURES[what](seed) if kind is None else Structure.of_kind(kind, seed)
    case = made.examined(0, pairs)
    assert not apart(case)
    kinds = [r for r in case.results if not r[0].startswith("stable_dt")]
    named = what if kind is None else " ".join((what, "of", kind.method, *kind.effects))
    record(
        f"A random {named} (seed {seed}) and {len(kinds)} equivalent ones",
        "the same, over what rounding explains a hundredfold",
        max(ratio for _, ratio, *_ in kinds) / ALLOWED,
        at_most=1.0,
    )


@pytest.mark.slow
@pytest.mark.parametrize("seed", [117])
def test_a_scene_is_the_same_in_every_view(seed, record):
    """Moved, turned, in other units, in two runs."""
    check("scene", seed, "numbers", record)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(201, 207))
def test_more_scenes(seed, record):
    """Reversed or reordered too, as one batch, and recorded."""
    check("scene", seed, "all", record)


MOVING = (
    ("consistent", ("gravity", "moving contact", "moving sticking contact")),
    ("pyelastica", ("gravity", "moving contact of many")),
    ("planar", ("gravity", "moving contact", "moving contact of many")),
    ("torsion free", ("gravity", "moving contact of many")),
    ("implicit", ("gravity", "moving contact")),
)


@pytest.mark.slow
@pytest.mark.parametrize(("method", "effects"), MOVING)
def test_bodies_that_move_are_the_same_in_every_view(method, effects, record):
    """Far away, turned, in other units, one of a batch, two at once in any order."""
    kind = Kind(method, "none", effects, 4, True, "round", "none", False)
    check("scene", 5, "all", record, kind)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2, 6))
def test_systems_are_the_same_in_every_view(seed, record):
    check("system", seed, "all", record)


def test_views_keep_what_they_should():
    """A rod from its other end, far away, turned and in other units is that rod."""
    random = np.random.default_rng(0)
    turn, other = random_turn(random), random_turn(random)
    quaternions = of_matrix(turn), of_matrix(other)
    both = of_matrix(turn @ other)
    assert abs(abs(product(*quaternions) @ both) - 1) < 1e-14
    view = View(turn, np.array([3.0, 1.0, -2.0]), (10.0, 3.0, 0.2), reversed=True)
    nodes = random.normal(size=(3, 5))
    seen = view.along(view.place(nodes))
    back = turn.T @ (seen / 10.0) - turn.T @ view.shift[:, None]
    np.testing.assert_allclose(view.along(back), nodes, atol=1e-14)
    np.testing.assert_allclose(view.number(1.0, "kg m s^-2"), 3.0 * 10 / 0.04)
    given = {"radius": 0.01, "density": 1e3, "youngs_modulus": 1e6}
    turned, state = rod_in(view, nodes, (0.3, 0.1, 1.0), False, given)
    strained = jaxrod.stored_energy(turned, state)
    assert float(strained) < ROUNDING * float(jnp.max(turned.shear_stretch_stiffness))


def test_a_difference_is_seen():
    """The comparison sees a difference where there is one."""
    one = {"rod.spin": np.zeros((3, 2))}
    assert differences(one, {"rod.spin": np.full((3, 2), 1e-9)}) == {"rod.spin": 1e-9}


def pulled_arm(**section):
    """A clamped arm, pulled by tendons from a place of the world, and moving."""
    rod, state = jaxrod.straight_rod(
        6, length=0.5, density=1e3, youngs_modulus=1e6, dtype=jnp.float64, **section
    )
    pulled = jaxrod.actuation.tendon(
        rod,
        [[0.01, 0.002], [-0.008, 0.01]],
        tension=(3.0, 1.0),
        anchor=(0.1, 0.05, -0.1),
    )
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state), pulled)
    spins = np.random.default_rng(0).normal(size=(3, 6))
    return scene, jaxrod.with_angular_velocities(rod, state, spins)


def apart_in_two_runs(scene, state, share):
    """Angular momenta after 120 steps of half the limit, in one call or in two."""
    dt = 0.5 * jaxrod.stable_dt(scene, 1.0).dt / share
    one = jaxrod.advance(scene, state, dt, 120 * share)
    two = jaxrod.advance(scene, state, dt, 70 * share)
    two = jaxrod.advance(scene, two, dt, 50 * share)
    gap = jnp.max(jnp.abs(one.angular_momenta - two.angular_momenta))
    return float(gap / jnp.max(jnp.abs(one.angular_momenta)))


@pytest.mark.slow
def test_two_calls_are_one_to_rounding_or_to_second_order(record):
    """To second order where sections are not round."""
    record(
        "A clamped round arm pulled by tendons, 120 steps in one call and in two",
        "the same angular momenta, over the largest",
        apart_in_two_runs(*pulled_arm(radius=0.015), 1),
        at_most=1e-12,
    )
    flat = pulled_arm(section=jaxrod.rectangle(0.03, 0.02))
    coarse, fine = (apart_in_two_runs(*flat, share) for share in (1, 4))
    record(
        "The same of rectangular section, at a quarter of the step, over at the step",
        "a sixteenth or less",
        fine / coarse,
        at_most=0.12,
    )

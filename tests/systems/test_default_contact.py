"""Contact whose numbers are left out: what it carries, and what it costs in steps."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod

SLENDER = {"length": 1.0, "radius": 0.01, "density": 1000.0, "youngs_modulus": 1e6}
STIFF = {"length": 0.1, "radius": 5e-4, "density": 7000.0, "youngs_modulus": 1e9}
THICK = {"length": 0.4, "radius": 0.05, "density": 300.0, "youngs_modulus": 1e5}
SOFT = {"length": 1.0, "radius": 0.05, "density": 1000.0, "youngs_modulus": 3e3}
"""Soft enough that its own weight sets the stiffness."""
MATERIALS = {"slender": SLENDER, "stiff": STIFF, "thick": THICK, "soft": SOFT}


def lying(material, height=0.0, n=12):
    """A rod along x whose axis is at a height [m], and its state."""
    return jaxrod.straight_rod(
        n,
        start=(0.0, 0.0, height),
        direction=(1.0, 0.0, 0.0),
        dtype=jnp.float64,
        **material,
    )


def on_floor(material, overlap, **numbers):
    """A rod that is pressed into a floor, and the rod without the floor."""
    radius = material["radius"]
    rod, state = lying(material, (1 - overlap) * radius)
    floor = jaxrod.contact(jaxrod.shapes.plane(), **numbers)
    scene = jaxrod.make_scene(rod, jaxrod.gravity(), floor)
    return scene, state, jaxrod.make_scene(rod, jaxrod.gravity())


def weight(scene):
    """Weight of a rod [N]."""
    return 9.81 * float(jnp.sum(scene.rod.node_masses))


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("name", ["soft", "slender", "thick", "stiff"])
@pytest.mark.parametrize("friction", [0.3, 0.0])
def test_contact_at_most_halves_the_step_or_just_carries_the_weight(name, friction):
    scene, state, free = on_floor(MATERIALS[name], 0.01, friction=friction)
    ((_, forces),) = scene.contact_forces(state)
    carried = float(jnp.sum(forces[2])) / weight(scene)
    share = float(jaxrod.stable_dt(scene).dt / jaxrod.stable_dt(free).dt)
    assert carried >= 1 - 1e-9
    assert share < 0.7
    if name == "soft":
        assert carried == pytest.approx(1.0, rel=1e-9)
    else:
        assert share > 0.5 - 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("law", ["crossing_contact", "rod_contact"])
@pytest.mark.parametrize("name", ["slender", "soft"])
def test_contact_between_rods_carries_a_rod(law, name):
    """Side by side by the line law, on one crossing by the other."""
    material = MATERIALS[name]
    radius = material["radius"]
    lower, of_lower = lying(material)
    upper, of_upper = lying(material, 1.99 * radius)
    scenes = {"lower": jaxrod.make_scene(lower), "upper": jaxrod.make_scene(upper)}
    state = {"lower": of_lower, "upper": of_upper}
    touch = getattr(jaxrod.systems, law)("lower", "upper", friction=0.2)
    system = jaxrod.make_system(scenes, touch, state=state)
    law_found = system.couplings[0]
    assert float(law_found.damping) > 0 and float(law_found.friction_drag) > 0
    forces = dict(system.contact_forces(state))
    carried = float(jnp.sum(forces["upper"][2])) / weight(scenes["upper"])
    assert carried >= 1 - 1e-6
    free = jaxrod.stable_dt(jaxrod.make_system(scenes)).dt
    share = float(jaxrod.stable_dt(system).dt / free)
    assert share < 0.7
    if carried > 1 + 1e-6:
        assert share > 0.5 - 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("name", MATERIALS)
def test_a_rod_at_rest_sinks_in_by_a_hundredth_of_its_radius_or_less(name):
    """It is dropped from a radius above the floor, and settles."""
    scene, state, _ = on_floor(MATERIALS[name], -1.0)
    rest = jaxrod.systems.settled(scene, state).state
    radius = MATERIALS[name]["radius"]
    depth = 1 - float(jnp.min(rest.positions[2])) / radius
    # Contact begins half the onset width, 0.005 radii, before surfaces touch.
    assert -0.005 < depth < 0.01 + 1e-6


def test_given_numbers_stay():
    scene, _, _ = on_floor(SLENDER, 0.0, stiffness=3e4)
    floor = scene.effects[-1]
    assert float(floor.stiffness) == 3e4 and floor.damping is None
    scene, _, _ = on_floor(SLENDER, 0.0, damping=2.0, friction=0.1)
    floor = scene.effects[-1]
    assert float(floor.damping) == 2.0 and float(floor.friction_drag) == 2.0
    assert math.isfinite(float(floor.stiffness))


def test_contact_with_and_without_numbers_in_one_system():
    """Contact of rigid bodies has no default: it stays as it is beside others."""
    rod, state = lying(SLENDER, 0.1)
    ball, _ = jaxrod.systems.rigid_body(
        jaxrod.shapes.sphere((1.2, 0, 0), 0.05), density=1e3, dtype=jnp.float64
    )
    members = {"rod": jaxrod.make_scene(rod, jaxrod.clamp(state)), "ball": ball}
    floor = jaxrod.systems.rigid_contact(
        "ball", fixed=jaxrod.shapes.plane((0, 0, -0.15)), stiffness=1e4
    )
    free = jaxrod.systems.body_contact("rod", "ball")
    for couplings in ((free, floor), (floor, free)):
        system = jaxrod.make_system(members, *couplings)
        numbers = {type(c).__name__: c.stiffness for c in system.couplings}
        assert numbers["RigidContact"] == 1e4
        assert numbers["BodyContact"] > 0


@pytest.mark.slow
def test_numbers_are_traced():
    """Under `vmap` they are those of a loop, and have derivatives."""

    def stiffness(modulus):
        material = {**SLENDER, "youngs_modulus": modulus}
        return on_floor(material, 0.0, friction=0.2)[0].effects[-1].stiffness

    moduli = jnp.array([1e6, 4e6], jnp.float64)
    many = jax.vmap(stiffness)(moduli)
    np.testing.assert_allclose(many, [stiffness(m) for m in moduli], rtol=1e-12)
    # Frequencies squared, and so stiffness, are in proportion to the modulus.
    np.testing.assert_allclose(many[1], 4 * many[0], rtol=1e-9)
    slope = jax.grad(stiffness)(1e6)
    np.testing.assert_allclose(slope, many[0] / 1e6, rtol=1e-6)


@pytest.mark.slow
def test_contact_that_no_scene_has_completed_has_no_force():
    """It is NaN, not a number that looks right."""
    rod, state = lying(SLENDER)
    bare = jaxrod.contact(jaxrod.shapes.plane())
    assert bare.lacks_numbers
    assert math.isnan(float(bare.energy(rod, state)))
    rough = jaxrod.contact(jaxrod.shapes.plane(), friction=0.3)
    assert math.isnan(
        float(jaxrod.sticking_contact(rough, rod, lying(SLENDER)[1]).stick_stiffness)
    )


@pytest.mark.slow
def test_an_effect_that_is_added_later_gets_its_numbers():
    floor = jaxrod.contact(jaxrod.shapes.plane())
    rod, _ = lying(SLENDER)
    whole = jaxrod.make_scene(rod, jaxrod.gravity(), floor)
    later = jaxrod.make_scene(rod, jaxrod.gravity()).with_effect(floor)
    for one, two in zip(jax.tree.leaves(whole), jax.tree.leaves(later), strict=True):
        np.testing.assert_array_equal(one, two)


def test_chosen_numbers_are_known_inside_jit():
    rod, _ = jaxrod.straight_rod(
        4, length=1.0, radius=0.02, density=1e3, youngs_modulus=1e6
    )
    chosen = lambda: jaxrod.make_scene(rod, jaxrod.contact(jaxrod.shapes.plane()))
    inside = jax.jit(lambda x: x + float(chosen().effects[0].stiffness))(0.0)
    np.testing.assert_allclose(inside, chosen().effects[0].stiffness, rtol=1e-5)


@pytest.mark.slow
def test_numbers_are_chosen_in_the_precision_of_the_rod():
    kinds = jnp.float32, jnp.float64
    size = {"length": 1.0, "radius": 0.02, "density": 1e3, "youngs_modulus": 1e6}
    rods = [jaxrod.straight_rod(4, dtype=kind, **size)[0] for kind in kinds]
    floor = jaxrod.contact(jaxrod.shapes.plane(), friction=0.3)
    single, double = (jaxrod.make_scene(rod, floor).effects[0] for rod in rods)
    assert single.stiffness.dtype == single.friction_drag.dtype == jnp.float32
    np.testing.assert_allclose(single.stiffness, double.stiffness, rtol=1e-4)

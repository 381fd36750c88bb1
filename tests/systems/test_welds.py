"""A weld is half an element of each rod in series, whatever describes the two."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxrod
from jaxrod.systems.members.rods import parts_of

N = 2


def turned(state, rotation, about):
    """A state turned as a whole about a point."""
    matrix = rotation.as_matrix()
    own = Rotation.from_quat(np.asarray(state.orientations).T, scalar_first=True)
    quaternions = (rotation * own).as_quat(scalar_first=True).T
    about = np.asarray(about)[:, None]
    return replace(
        state,
        positions=jnp.asarray(about + matrix @ (state.positions - about)),
        orientations=jnp.asarray(quaternions),
    )


def drawn(seed):
    """Two rods with rectangular sections that meet in a point, in random frames."""
    random = np.random.default_rng(seed)
    members, state, sections = {}, {}, {}
    for name, length in (("a", 0.3), ("b", 0.2)):
        sides = 10 ** random.uniform(-3, -1.5, 2)
        rod, straight = jaxrod.straight_rod(
            N,
            length=length,
            section=jaxrod.rectangle(*sides),
            density=1000.0,
            youngs_modulus=10 ** random.uniform(5, 9),
            start=(0.0, 0.0, -length if name == "a" else 0.0),
            direction=(0.0, 0.0, 1.0),
        )
        way = Rotation.random(random_state=int(random.integers(2**31)))
        members[name] = jaxrod.make_scene(rod)
        state[name] = turned(straight, way, (0, 0, 0))
        sections[name] = (
            0.5 * length / N / np.asarray(rod.bend_twist_stiffness)[:, 0],
            Rotation.from_quat(
                np.asarray(state[name].orientations)[:, 0], scalar_first=True
            ),
        )
    small = Rotation.from_rotvec(random.normal(size=3) * 0.1)
    bent = {**state, "b": turned(state["b"], small, (0, 0, 0))}
    # In the world frame: the compliances of both halves, each about its own axes.
    compliance = sum(
        own.as_matrix() @ np.diag(halves) @ own.as_matrix().T
        for halves, own in sections.values()
    )
    angles = small.as_rotvec()
    return members, state, bent, 0.5 * angles @ np.linalg.solve(compliance, angles)


PLACES = (("a", "tip"), ("b", "base"))


@cache
def evaluated():
    """Energy, and its gradient by the second rod's orientations, compiled once."""

    def energy(system, state):
        return system.potential_energy(state)

    return jax.jit(jax.value_and_grad(energy, argnums=1))


@pytest.mark.fast_sets(6)
@pytest.mark.parametrize("seed", range(12))
def test_two_halves_are_two_springs_in_series(seed):
    members, state, bent, expected = drawn(seed)
    found = []
    for places in (PLACES, PLACES[::-1]):
        system = jaxrod.make_system(
            members, jaxrod.systems.weld(*places, state), state=state
        )
        assert abs(system.potential_energy(state)) < 1e-20
        found.append(evaluated()(system, bent))
    energies = [energy for energy, _ in found]
    np.testing.assert_allclose(energies, expected, rtol=1e-12)
    slopes = [gradient["b"].orientations for _, gradient in found]
    scale = np.abs(slopes[0]).max()
    np.testing.assert_allclose(slopes[1], slopes[0], rtol=0, atol=1e-12 * scale)


def test_a_weld_does_not_depend_on_how_sections_are_described():
    """A square section turned by 45 degrees, and sides exchanged with the axes."""
    material = dict(length=0.2, density=1000.0, youngs_modulus=1e7)
    energies = []
    for normal, sides in (((1, 0, 0), (0.04, 0.004)), ((0, 1, 0), (0.004, 0.04))):
        a, of_a = jaxrod.straight_rod(
            N, section=jaxrod.rectangle(0.04, 0.004), normal=(1, 0, 0), **material
        )
        b, of_b = jaxrod.straight_rod(
            N,
            start=of_a.tip,
            section=jaxrod.rectangle(*sides),
            normal=normal,
            **material,
        )
        state = {"a": of_a, "b": of_b}
        members = {"a": jaxrod.make_scene(a), "b": jaxrod.make_scene(b)}
        system = jaxrod.make_system(
            members, jaxrod.systems.weld(*PLACES, state), state=state
        )
        small = Rotation.from_rotvec([0.05, -0.02, 0.03])
        bent = {**state, "b": turned(of_b, small, of_a.tip)}
        energies.append(float(evaluated()(system, bent)[0]))
    assert energies[1] == pytest.approx(energies[0], rel=1e-12)


def test_the_bound_on_the_step_holds_what_a_turned_strip_is_stiff_in():
    """The joint's frequency about its stiffest axis, wherever that axis points."""
    bounds = []
    for angle in np.linspace(0, np.pi / 2, 5):
        normal = (np.cos(angle), np.sin(angle), 0)
        a, of_a = jaxrod.straight_rod(
            N, length=0.2, section=jaxrod.rectangle(0.04, 0.004), density=1000.0,
            youngs_modulus=1e7, normal=normal,
        )  # fmt: skip
        b, of_b = jaxrod.straight_rod(
            N, length=0.2, section=jaxrod.rectangle(0.04, 0.004), density=1000.0,
            youngs_modulus=1e7, start=of_a.tip,
        )  # fmt: skip
        state = {"a": of_a, "b": of_b}
        members = {"a": jaxrod.make_scene(a), "b": jaxrod.make_scene(b)}
        _, joint = jaxrod.systems.weld(*PLACES, state)
        parts = {name: parts_of(scene.rod) for name, scene in members.items()}
        joint = joint.prepared(parts)
        k = np.diag(joint.stiffness[:, 0])
        for which, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
            k[i, j] = k[j, i] = joint.mixed_stiffness[which, 0]
        largest = np.linalg.eigvalsh(k)[-1]
        bound = joint.stability_bounds(parts)["b"].elements[0]
        bounds.append(float(bound / (2 * largest)))
    assert 1 - 1e-12 <= min(bounds) and max(bounds) < np.sqrt(3)


@pytest.mark.slow
def test_a_corner_converges_in_second_order():
    """The tip of an L of two flat strips under a dead load, against a fine grid."""

    def tip(n):
        material = dict(
            length=0.5, density=1000.0, youngs_modulus=1e6,
            section=jaxrod.rectangle(0.04, 0.02),
        )  # fmt: skip
        a, of_a = jaxrod.straight_rod(
            n, direction=(1, 0, 0), normal=(0, 0, 1), **material
        )
        b, of_b = jaxrod.straight_rod(
            n, start=of_a.tip, direction=(0, 1, 0), normal=(1, 0, 0), **material
        )
        state = {"a": of_a, "b": of_b}
        damping = jaxrod.exponential_damping(10.0)
        members = {
            "a": jaxrod.make_scene(a, jaxrod.clamp(of_a), damping),
            "b": jaxrod.make_scene(b, jaxrod.end_load((0.02, 0.0, 0.03)), damping),
        }
        system = jaxrod.make_system(
            members, jaxrod.systems.weld(*PLACES, state), state=state
        )
        dt = float(jaxrod.stable_dt(system).dt)
        return np.asarray(jaxrod.advance(system, state, dt, int(6.0 / dt))["b"].tip)

    coarse, middle, fine = (tip(n) for n in (4, 8, 16))
    ratio = np.linalg.norm(coarse - middle) / np.linalg.norm(middle - fine)
    assert 3.3 < ratio < 4.7

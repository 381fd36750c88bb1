"""Members that leave something out: exact beside others, and what they reject."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from benchmarks.planar_systems.scenes import SCENES, gripper
from jaxrod import systems
from systems.couplings_in_plane import made

SOFT = {"radius": 0.008, "density": 1000.0, "youngs_modulus": 1e6}


def places(state):
    return {name: own.positions for name, own in state.items()}


def apart(one, other):
    gaps = jax.tree.map(
        lambda a, b: jnp.max(jnp.abs(a - b)), places(one), places(other)
    )
    return max(map(float, gaps.values()))


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_planar_systems_are_those_in_space(name, record):
    """Rods of 12 cm with chambers, contact, friction, a spring, welds."""
    ends = []
    for method in (jaxrod.consistent(), jaxrod.planar("zx")):
        system, state = SCENES[name](method)
        ends.append(jaxrod.advance(system, state, 1e-4, 1000))
    moved = apart(ends[0], state)
    assert moved > 0.01 * 0.12
    record(
        f"Planar {name}, after 1000 steps [lengths of a rod]",
        "the same in space",
        apart(*ends) / 0.12,
        at_most=1e-12,
    )


@pytest.mark.slow
def test_what_leaves_the_plane_is_rejected():
    flat = jaxrod.planar("zx")
    with pytest.raises(ValueError, match="node positions of 'ball' in it"):
        gripper(flat, height=0.01)
    with pytest.raises(ValueError, match="forces of Gravity of 'ball' in it"):
        gripper(flat, weight=(0.0, 1.0, -9.81))
    system, state = gripper(flat)
    spinning = jnp.asarray([[0.0], [0.0], [1.0]])
    state = {**state, "ball": replace(state["ball"], angular_velocities=spinning)}
    with pytest.raises(ValueError, match="angular velocities of 'ball' in it"):
        jaxrod.advance(system, state, 1e-5, 1)
    with pytest.raises(ValueError, match="'left': a scene in the xy plane needs"):
        gripper(jaxrod.planar("xy"))


def two_rods(*methods, at=None):
    """Two rods end to end along x, held together by a spring between points."""
    rods = [
        jaxrod.straight_rod(
            4,
            length=0.1,
            start=(0.2 * k, 0.0, 0.0),
            direction=(1.0, 0.0, 0.0),
            dtype=jnp.float64,
            **SOFT,
        )
        for k in range(2)
    ]
    state = dict(zip("ab", [own for _, own in rods], strict=True))
    scenes = {
        name: jaxrod.make_scene(rod, method=method)
        for name, (rod, _), method in zip("ab", rods, methods, strict=True)
    }
    band = systems.spring(("a", "tip"), ("b", "base"), state, stiffness=10.0, at=at)
    return jaxrod.make_system(scenes, band, state=state), state


def test_coupled_planar_rods_have_one_plane():
    with pytest.raises(ValueError, match="must move in one plane, got a and b"):
        two_rods(jaxrod.planar("xy"), jaxrod.planar("zx"))


@pytest.mark.slow
def test_a_spring_beside_the_axis_leaves_the_plane_and_twists():
    aside = ((0.1, 0.0, 0.005), (0.2, 0.0, 0.0))
    with pytest.raises(ValueError, match="of Springs of 'a' in it"):
        two_rods(jaxrod.planar("xy"), jaxrod.consistent(), at=aside)
    with pytest.raises(ValueError, match="'a' has no twist, and Springs"):
        two_rods(jaxrod.torsion_free(), jaxrod.consistent(), at=aside)


@jaxrod.extend.pytree
class Wind(jaxrod.extend.Coupling):
    """A user-defined coupling with couples about the axes of elements."""

    size: jax.Array

    def loads(self, seen):
        turn = self.size * jnp.ones_like(seen["a"].motion.spin[0])
        return {"a": jaxrod.extend.Loads(couples=(0 * turn, 0 * turn, turn))}


@pytest.mark.slow
def test_a_coupling_of_ones_own_is_tested_too():
    system, state = two_rods(jaxrod.torsion_free(), jaxrod.torsion_free())
    winding = (*system.couplings, Wind(jnp.asarray(1.0)))
    with pytest.raises(ValueError, match="'a' has no twist, and Wind"):
        jaxrod.make_system(system.members, *winding, state=state)
    # Without a state it is found when the system runs.
    made_without = jaxrod.make_system(system.members, *winding)
    with pytest.raises(ValueError, match="'a' has no twist, and Wind"):
        jaxrod.advance(made_without, state, 1e-5, 1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "share"), [(jaxrod.planar("zx"), 0.5), (jaxrod.torsion_free(), 1.0)]
)
def test_rest_and_frequencies_are_those_in_space(method, share):
    """A plane has half of the frequencies; statics know twist in every method."""

    def found(method):
        system, state = made("tie", method)
        held = [
            jaxrod.clamp(state["one"]),
            jaxrod.gravity((0.0, 0.0, -9.81)),
        ]
        one = replace(system.members["one"], effects=tuple(held))
        members = {**system.members, "one": one}
        members.pop("ball")
        system = jaxrod.make_system(members, *system.couplings)
        state = {name: state[name] for name in members}
        rest = jaxrod.equilibrium(system, state)
        assert rest.converged
        return rest.state, jaxrod.natural_frequencies(system, rest.state)

    rest, frequencies = found(jaxrod.consistent())
    own, fewer = found(method)
    assert apart(rest, own) < 1e-9
    assert len(fewer) == share * len(frequencies)
    for frequency in fewer[fewer > 1e-3 * fewer[-1]]:
        assert np.min(np.abs(frequencies / frequency - 1)) < 1e-6


@pytest.mark.slow
def test_reductions_of_a_system_are_found():
    system, state = two_rods(jaxrod.consistent(), jaxrod.consistent())
    found = jaxrod.tradeoff.reductions(system, state)
    exact = [one for one in found if one.exact]
    assert {one.name for one in exact} == {"planar('xy')", "planar('zx')"}
    assert all(one.members == ("a", "b") and one.saving > 0.4 for one in exact)
    assert {"torsion_free()"} <= {one.name for one in found}
    reduced = exact[0].model
    after = jaxrod.advance(reduced, state, 1e-5, 5)
    assert apart(after, jaxrod.advance(system, state, 1e-5, 5)) < 1e-14

"""Contact between rods leaves out what a joint holds together."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod import systems

LINK = {"length": 0.3, "radius": 0.01, "density": 1e3, "youngs_modulus": 1e6}
ENDS = ("left", "tip"), ("right", "base")
JOINTS = {
    "tie": lambda state: systems.tie(*ENDS, state),
    "weld": lambda state: systems.weld(*ENDS, state),
    "ball": lambda state: systems.ball_joint(*ENDS, state, stiffness=100.0),
    "hinge": lambda state: systems.hinge_joint(
        *ENDS, state, axis=(0, 1, 0), stiffness=100.0, axis_stiffness=0.1
    ),
    "fixed": lambda state: systems.fixed_joint(
        *ENDS, state, stiffness=100.0, turning_stiffness=0.1
    ),
    "tie and hinge": lambda state: (
        systems.tie(*ENDS, state),
        *systems.hinge_joint(
            *ENDS, state, axis=(0, 1, 0), stiffness=100.0, axis_stiffness=0.1
        ),
    ),
}
CONTACTS = {
    "line law": lambda: systems.rod_contact("left", "right"),
    "crossings": lambda: systems.crossing_contact("left", "right"),
}


def links(angle, n=10):
    """Two links whose ends meet at the origin, at an angle from the straight line."""
    left, of_left = jaxrod.straight_rod(
        n, **LINK, start=(-0.3, 0.0, 0.0), direction=(1, 0, 0)
    )
    turned = (np.cos(angle), 0.0, np.sin(angle))
    right, of_right = jaxrod.straight_rod(n, **LINK, direction=turned)
    scenes = {"left": jaxrod.make_scene(left), "right": jaxrod.make_scene(right)}
    return scenes, {"left": of_left, "right": of_right}


def energy(joint, contact, angle):
    scenes, state = links(angle)
    couplings = JOINTS[joint](state), CONTACTS[contact]()
    system = jaxrod.make_system(scenes, *couplings, state=state)
    return float(system.potential_energy(state))


@pytest.mark.parametrize("contact", CONTACTS)
@pytest.mark.parametrize("joint", JOINTS)
def test_contact_does_not_push_at_a_joint(joint, contact):
    for angle in (0.0, 1.0, 1.57):
        assert energy(joint, contact, angle) == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize("contact", CONTACTS)
def test_contact_is_equal_for_ties_and_for_joints_where_links_are_folded(contact):
    angle = np.pi - 0.03
    expected = energy("tie", contact, angle)
    assert expected > 1e-6
    for joint in ("ball", "hinge", "tie and hinge"):
        assert energy(joint, contact, angle) == pytest.approx(expected, rel=1e-9)


def test_an_anchor_away_from_its_rod_leaves_contact_in():
    scenes, state = links(np.pi - 0.01)
    joint = systems.ball_joint(*ENDS, state, stiffness=100.0, at=(0.05, 0.0, 0.0))
    contact = systems.rod_contact("left", "right", stiffness=1e4)
    near = systems.ball_joint(*ENDS, state, stiffness=100.0)
    far, close = (
        jaxrod.make_system(scenes, one, contact, state=state).potential_energy(state)
        for one in (joint, near)
    )
    assert float(far) > 1.05 * float(close) > 0


def test_hinged_links_move_alike_with_and_without_contact():
    scenes, state = links(0.3)
    scenes["left"] = jaxrod.make_scene(
        scenes["left"].rod, jaxrod.clamp(state["left"]), jaxrod.gravity()
    )
    scenes["right"] = scenes["right"].with_effect(jaxrod.gravity())
    tips = []
    for more in ((), (systems.rod_contact("left", "right"),)):
        system = jaxrod.make_system(scenes, *JOINTS["hinge"](state), *more, state=state)
        after = jaxrod.advance(system, state, 1e-4, 500)
        tips.append(after["right"].tip)
        assert not jaxrod.health(system, after, 1e-4).flagged
    np.testing.assert_allclose(tips[0], tips[1], rtol=0, atol=1e-12)
    assert abs(tips[0] - jnp.asarray(state["right"].tip)).max() > 1e-3

"""Joints whose stiffness is left out: `make_system` takes one that the step affords."""

import jax
import numpy as np
import pytest

import jaxrod
from jaxrod import shapes, systems

LINK = {"length": 0.3, "radius": 0.01, "density": 1e3, "youngs_modulus": 1e6}
ENDS = ("left", "tip"), ("right", "base")
JOINTS = {
    "ball": systems.ball_joint,
    "hinge": lambda *given, **more: systems.hinge_joint(*given, axis=(0, 1, 0), **more),
    "fixed": systems.fixed_joint,
}


def links(modulus=1e6):
    link = LINK | {"youngs_modulus": modulus, "direction": (1, 0, 0)}
    left, of_left = jaxrod.straight_rod(10, **link, start=(-0.3, 0.0, 0.0))
    right, of_right = jaxrod.straight_rod(10, **link)
    weight = jaxrod.gravity()
    scenes = {
        "left": jaxrod.make_scene(left, jaxrod.clamp(of_left), weight),
        "right": jaxrod.make_scene(right, weight),
    }
    return scenes, {"left": of_left, "right": of_right}


@pytest.mark.parametrize("joint", JOINTS)
def test_a_default_joint_holds_and_costs_a_fifth_of_the_step(joint):
    scenes, state = links()
    alone = jaxrod.stable_dt(jaxrod.make_system(scenes, state=state)).dt
    system = jaxrod.make_system(scenes, JOINTS[joint](*ENDS, state), state=state)
    dt = float(jaxrod.stable_dt(system).dt)
    # A hinge has two kinds of springs.
    share = {"ball": 0.81, "hinge": 0.70, "fixed": 0.81}[joint]
    assert share * float(alone) <= dt <= 0.9 * float(alone)
    after = jaxrod.advance(system, state, dt, round(0.3 / dt))
    found = jaxrod.health(system, after, dt)
    assert not found.flagged
    gap = np.linalg.norm(after["left"].tip - after["right"].positions[:, 0])
    assert gap < 0.02 * LINK["radius"]
    assert float(after["right"].tip[2]) < -0.05


def test_a_default_hinge_keeps_its_axis():
    scenes, state = links()
    # Pushed sideways, the right link would turn about z at a ball joint.
    push = jaxrod.end_load((0.0, 0.5, 0.0))
    scenes["right"] = scenes["right"].with_effect(push)
    angles = {}
    for joint in ("ball", "hinge"):
        system = jaxrod.make_system(scenes, JOINTS[joint](*ENDS, state), state=state)
        dt = float(jaxrod.stable_dt(system).dt)
        after = jaxrod.advance(system, state, dt, round(0.1 / dt))
        one, two = (
            # The axis is y at the start, and turns with the element.
            np.asarray(after[name].directors[..., k]).T
            @ np.asarray(state[name].directors[..., k])
            @ np.array([0.0, 1.0, 0.0])
            for name, k in (("left", -1), ("right", 0))
        )
        angles[joint] = np.arccos(min(1.0, one @ two))
    assert angles["hinge"] < 0.02 < 0.1 < angles["ball"]


@pytest.mark.parametrize("joint", JOINTS)
def test_stiffness_that_is_given_is_kept(joint):
    scenes, state = links()
    system = jaxrod.make_system(
        scenes, JOINTS[joint](*ENDS, state, stiffness=123.0), state=state
    )
    assert float(system.couplings[0].stiffness) == 123.0


def test_the_default_follows_the_rods_and_can_be_differentiated():
    @jax.jit
    def stiffness(modulus):
        scenes, state = links(modulus)
        joint = systems.ball_joint(*ENDS, state)
        return jaxrod.make_system(scenes, joint, state=state).couplings[0].stiffness

    soft, stiff = stiffness(1e6), stiffness(4e6)
    assert float(stiff / soft) == pytest.approx(4.0, rel=1e-6)
    slope = jax.grad(lambda e: stiffness(e))(1e6)
    assert float(slope) == pytest.approx(float(soft) / 1e6, rel=1e-6)


def test_a_body_on_a_rod_needs_no_stiffness_and_two_bodies_do():
    rod, hanging = jaxrod.straight_rod(10, **LINK, direction=(0, 0, -1))
    arm = jaxrod.make_scene(rod, jaxrod.clamp(hanging), jaxrod.gravity())
    weight = jaxrod.gravity()
    balls = [
        systems.rigid_body(
            shapes.sphere((0.0, 0.0, z), 0.03), density=500.0, effects=(weight,)
        )
        for z in (-0.33, -0.4)
    ]
    state = {"arm": hanging, "one": balls[0][1], "two": balls[1][1]}
    members = {"arm": arm, "one": balls[0][0], "two": balls[1][0]}
    joint = systems.ball_joint(("arm", "tip"), ("one",), state)
    system = jaxrod.make_system(members, joint, state=state)
    dt = jaxrod.stable_dt(system).dt
    after = jaxrod.advance(system, state, dt, 2000)
    assert not jaxrod.health(system, after, dt).flagged
    for name, number in (("ball", "stiffness"), ("hinge", "axis_stiffness")):
        given = {} if name == "ball" else {"stiffness": 100.0}
        between = JOINTS[name](("one",), ("two",), state, **given)
        with pytest.raises(ValueError, match=rf"'one' and 'two' needs .* {number} \["):
            jaxrod.make_system(members, between, state=state)

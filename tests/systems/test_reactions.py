"""Reactions in systems: weights at rest, pairs of forces, and rates of momenta."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from systems.members import free_system, rod

G = 9.81


def hanging(turning=False):
    """Two rods and a ball hang from each other, stretched by their weights.

    Returns the system, its state, and the weights of the second rod and of the ball.
    """
    weight = jaxrod.gravity((0.0, 0.0, -G))
    one, of_one = rod(3, 0.3, (0, 0, 0), (0, 0, -1))
    two, of_two = rod(2, 0.2, (0, 0, -0.3), (0, 0, -1), density=3000.0)
    ball, of_ball = jaxrod.systems.rigid_body(
        jaxrod.shapes.sphere((0.0, 0.0, -0.55), 0.05),
        density=800.0,
        effects=(weight,),
        dtype=jnp.float64,
    )
    state = {"one": of_one, "two": of_two, "ball": of_ball}
    joints = (
        jaxrod.systems.weld(("one", "tip"), ("two", "base"), state),
        jaxrod.systems.attach(("two", "tip"), ("ball",), state, turning=turning),
    )
    below, down = float(ball.masses[0]) * G, 0.0
    weights = [below]
    for name, made in (("two", two), ("one", one)):
        masses = np.asarray(made.node_masses) * G
        pulls = below + np.cumsum(masses[::-1])[:-1][::-1]
        stiffness = np.asarray(made.shear_stretch_stiffness[2])
        longer = pulls / stiffness * np.asarray(made.rest_lengths)
        state[name] = replace(
            state[name],
            positions=state[name]
            .positions.at[2]
            .add(-jnp.concatenate([jnp.zeros(1), jnp.cumsum(jnp.asarray(longer))])),
        )
        below += float(np.sum(masses))
        weights.append(float(np.sum(masses)))
    down = float(state["one"].positions[2, -1]) + 0.3
    state["two"] = replace(
        state["two"], positions=state["two"].positions.at[2].add(down)
    )
    lower = float(state["two"].positions[2, -1]) + 0.5
    state["ball"] = replace(of_ball, positions=of_ball.positions.at[2].add(lower))
    members = {
        "one": jaxrod.make_scene(one, weight, jaxrod.clamp(of_one)),
        "two": jaxrod.make_scene(two, weight),
        "ball": ball,
    }
    return jaxrod.make_system(members, *joints, state=state), state, weights


def test_reactions_at_rest_are_the_weights_of_what_hangs_below():
    system, state, (ball, two, one) = hanging()
    found = jaxrod.reactions(system, state)
    up = np.array([0.0, 0.0, 1.0])
    near = {"rtol": 1e-10, "atol": 1e-12}
    nothing, wall = found.supports["one"]
    assert nothing is None
    np.testing.assert_allclose(wall.force, (ball + two + one) * up, **near)
    np.testing.assert_allclose(found.force, wall.force, **near)
    np.testing.assert_allclose(found.on("one", "tip").force, -(ball + two) * up, **near)
    np.testing.assert_allclose(found.on("two", "base").force, (ball + two) * up, **near)
    np.testing.assert_allclose(found.on("two", "tip").force, -ball * up, **near)
    np.testing.assert_allclose(found.on("ball").force, ball * up, **near)
    np.testing.assert_allclose(found.on("ball").couple, 0, atol=1e-12)
    with pytest.raises(ValueError, match="'ball' is not one"):
        jaxrod.systems.free_body(system, state, "ball")
    with pytest.raises(ValueError, match="no member is called 'three'"):
        found.on("three", "tip")


@pytest.mark.slow
def test_sensors_read_a_member_that_is_cut_free():
    system, state, (ball, two, _) = hanging()
    sensors = jaxrod.sensors
    cut = jaxrod.systems.free_body(system, state, "two")
    felt = sensors.accelerometer([0.02, 0.1, 0.18]).read(*cut)
    np.testing.assert_allclose(np.linalg.norm(felt, axis=0), G, rtol=1e-9)
    held = jaxrod.systems.free_body(system, state, "one")
    force = sensors.support_force().read(*held)
    np.testing.assert_allclose(
        force, jaxrod.reactions(system, state).supports["one"][1].force, rtol=1e-12
    )
    assert float(force[2]) > ball + two


@pytest.mark.slow
def test_a_wall_bears_the_bending_of_a_frame():
    """A post and a beam welded to it, under a load at its end: statics by hand."""
    post, of_post = rod(6, 0.3, (0, 0, 0), (0, 0, 1))
    beam, of_beam = rod(6, 0.3, (0, 0, 0.3), (1, 0, 0))
    state = {"post": of_post, "beam": of_beam}
    system = jaxrod.make_system(
        {
            "post": jaxrod.make_scene(post, jaxrod.clamp(of_post)),
            "beam": jaxrod.make_scene(beam, jaxrod.end_load((0.01, 0.02, -0.05))),
        },
        jaxrod.systems.weld(("post", "tip"), ("beam", "base"), state),
        state=state,
    )
    rest = jaxrod.equilibrium(system, state)
    assert rest.converged
    found = jaxrod.reactions(system, rest.state)
    wall, push = found.supports["post"][0], np.array([0.01, 0.02, -0.05])
    np.testing.assert_allclose(wall.force, -push, atol=1e-9)
    # The wall's couple acts on the first element, whose nodes have loads, too.
    tip = np.asarray(rest.state["beam"].tip)
    np.testing.assert_allclose(wall.couple, -np.cross(tip, push), atol=1e-8)
    corner = found.on("beam", "base")
    np.testing.assert_allclose(corner.force, -push, atol=1e-9)
    np.testing.assert_allclose(
        found.on("post", "tip").couple, -corner.couple, atol=1e-9
    )


def momenta(system, state):
    """Momentum, and angular momentum about the origin, of each member."""
    members = system.interfaces()
    return {
        name: jnp.concatenate(
            [own.momentum(state[name]), own.angular_momentum(state[name])]
        )
        for name, own in members.items()
    }


@pytest.mark.slow
def test_loads_of_couplings_are_the_rates_of_momentum_of_each_member():
    """Rods welded and tied, a body that carries a node, a hinged ball."""
    system, state = free_system()
    state = jaxrod.advance(system, state, jaxrod.stable_dt(system).dt, 40)
    found = jaxrod.reactions(system, state)
    # Forces change with the stretch by 1e-6 of their size in a thousand such steps.
    dt = 1e-10
    after = jaxrod.advance(system, state, dt, 1)
    was, now = momenta(system, state), momenta(system, after)
    for name in system.members:
        rate = np.asarray(now[name] - was[name]) / dt
        force, turn = np.zeros((3, 1)), np.zeros(3)
        for loads in found.couplings:
            if name not in loads:
                continue
            force = force + np.asarray(loads[name].forces)
            turn += np.sum(loads[name].couples, axis=1)
        turn += np.sum(np.cross(state[name].positions, force, axis=0), axis=1)
        total = np.concatenate([np.sum(force, axis=1), turn])
        scale = np.max(np.abs(total)) + 1e-3
        assert scale > 1e-2, name
        np.testing.assert_allclose(rate, total, atol=1e-4 * scale, err_msg=name)
    # All forces are in pairs.
    np.testing.assert_allclose(found.force, 0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("axes", ["xyz", "xz"])
def test_a_support_of_a_tied_node_bears_the_others(axes):
    """A node that a pin holds is tied to two loaded rods."""
    weight = jaxrod.gravity((1.0, 2.0, -G))
    made = [rod(3, 0.3, (0, 0, 0), d) for d in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]
    names = ("a", "b", "c")
    state = {name: own for name, (_, own) in zip(names, made, strict=True)}
    members = {
        name: jaxrod.make_scene(r, weight)
        for name, (r, _) in zip(names, made, strict=True)
    }
    pin = jaxrod.pin_support(state["b"], "base", axes=axes)
    members["b"] = members["b"].with_effect(pin)
    bases = [(name, "base") for name in names]
    tie = jaxrod.systems.tie(bases[:2], bases[1:], state)
    system = jaxrod.make_system(members, tie, state=state)
    found = jaxrod.reactions(system, state)
    # At rest without strain, elements push nothing: each node falls by itself.
    masses = [float(r.node_masses[0]) for r, _ in made]
    held = np.array([axis in axes for axis in "xyz"], float)
    expected = -sum(masses) * np.array([1.0, 2.0, -G]) * held
    np.testing.assert_allclose(
        found.supports["b"][1].force, expected, rtol=1e-10, atol=1e-12
    )
    np.testing.assert_allclose(
        found.on("a", "base").force,
        -masses[0] * np.array([1.0, 2.0, -G]) * held,
        rtol=1e-10,
        atol=1e-12,
    )
    total = found.couplings[0]
    np.testing.assert_allclose(
        sum(np.sum(own.forces, axis=1) for own in total.values()), 0, atol=1e-12
    )


@pytest.mark.slow
def test_reactions_of_equal_rods_have_an_axis_and_a_gradient():
    made, own = rod(3, 0.3)
    states = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), own)
    states = replace(states, positions=states.positions.at[1, 1].add(0.5))

    def wall(force):
        scene = jaxrod.make_scene(made, jaxrod.clamp(own))
        scenes = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), scene)
        clamps = replace(scenes.effects[0], position=states.positions[:, :, 0])
        scenes = replace(scenes, effects=(clamps,))
        band = jaxrod.systems.spring(
            ("rods", 0, "base"), ("rods", 1, "base"), {"rods": states}, stiffness=force
        )
        system = jaxrod.make_system({"rods": scenes}, band)
        apart = replace(states, positions=states.positions.at[1, 1].add(0.1))
        held = jaxrod.reactions(system, {"rods": apart}).supports["rods"][0]
        return held.force

    found = wall(20.0)
    assert found.shape == (2, 3)
    np.testing.assert_allclose(found[:, 1], (-2.0, 2.0), rtol=1e-12)
    slope = jax.grad(lambda k: wall(k)[1, 1])(20.0)
    np.testing.assert_allclose(slope, 0.1, rtol=1e-12)


def test_what_reactions_cannot_tell_is_refused():
    made, own = rod(3, 0.3)
    lifted = jaxrod.driven(
        own, displacement=jaxrod.schedules.sine((0.0, 0.0, 0.1), period=1.0)
    )
    moving = jaxrod.make_system({"arm": jaxrod.make_scene(made, lifted)})
    with pytest.raises(ValueError, match="schedule"):
        jaxrod.reactions(moving, {"arm": own})
    old = jaxrod.make_scene(made, method=jaxrod.pyelastica())
    with pytest.raises(ValueError, match="consistent law"):
        jaxrod.reactions(jaxrod.make_system({"arm": old}), {"arm": own})

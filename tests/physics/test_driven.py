"""Driven ends: gradients through them, statics and vibrations of one moment."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod

MOMENT = 0.13


def along_x():
    return jaxrod.straight_rod(
        4,
        length=0.5,
        radius=0.02,
        density=1000.0,
        youngs_modulus=2e6,
        direction=(1.0, 0.0, 0.0),
        normal=(0.0, 0.0, 1.0),
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "dt"),
    [(jaxrod.implicit(), 5e-3), (jaxrod.pyelastica(), 5e-4)],
    ids=["implicit", "pyelastica"],
)
@pytest.mark.parametrize("turn", [True, False], ids=["wall", "free to turn"])
def test_gradients_through_driven_ends_agree_with_differences(method, dt, turn, record):
    rod, state = along_x()

    def after(numbers):
        side, up, angle, period = numbers
        shake = jaxrod.schedules.sine(
            jnp.stack([0 * side, side, up]), period, mean=(0.0,) * 3
        )
        wall = {"free_to_turn": True}
        if turn:
            wall = {
                "axis": (0.0, 1.0, 1.0),
                "angle": jaxrod.schedules.sine(angle, period),
            }
        driven = jaxrod.driven(state, displacement=shake, **wall)
        scene = jaxrod.make_scene(rod, driven, jaxrod.gravity(), method=method)
        end = jaxrod.advance(scene, state, dt, 10)
        # Every node: it takes a while until the free end hears of it.
        weights = jnp.cos(jnp.arange(end.positions.size)).reshape(end.positions.shape)
        return jnp.sum(weights * (end.positions + 1e-3 * end.velocities))

    program = jax.jit(jax.value_and_grad(after))
    numbers = jnp.asarray([0.01, 0.02, 0.3, 0.11])
    gradient = np.asarray(program(numbers)[1])
    differences = []
    for k, step in enumerate(1e-4 * np.asarray(numbers)):
        ahead, behind = (
            float(program(numbers.at[k].add(way))[0]) for way in (step, -step)
        )
        differences.append((ahead - behind) / (2 * step))
    used = slice(None) if turn else [0, 1, 3]
    assert np.all(gradient[used] != 0)
    record(
        f"Gradient through a driven end, {type(method).__name__}, "
        f"{'wall' if turn else 'free to turn'}",
        "central differences",
        np.max(np.abs(gradient - differences)) / np.max(np.abs(gradient)),
        at_most=1e-6,
    )


@pytest.mark.slow
def test_a_gripped_inner_node_moves_and_bears_the_rod():
    """A rod is gripped a quarter along: the grip bears its weight, and more if lifted.

    The rod falls freely otherwise, so nothing is strained.
    """
    rod, state = along_x()
    n = rod.n_elements
    node = n // 4
    weight = (0.0, 0.0, -9.81)
    lift = jaxrod.schedules.sine((0.0, 0.0, 0.3), period=2.0)
    grip = jaxrod.driven(state, node, displacement=lift, free_to_turn=True)
    assert grip.held(rod)[0].node == node and grip.held(rod)[0].element is None
    scene = jaxrod.make_scene(rod, grip, jaxrod.gravity(weight))
    moment = scene.at(MOMENT)
    place = moment.effects[0].place
    held = jaxrod.reactions(moment, state)[0]
    # Unstrained, elements push nothing: the grip accelerates its node alone.
    mass = rod.node_masses[node]
    expected = mass * (np.asarray(place.acceleration) - np.asarray(weight))
    np.testing.assert_allclose(held.force, expected, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(held.power, held.force @ place.velocity, rtol=1e-12)
    dt = 1e-5
    after = jaxrod.advance(scene, state, dt, 50)
    there = scene.at(50 * dt).effects[0].place
    np.testing.assert_allclose(after.positions[:, node], there.position, atol=1e-12)
    np.testing.assert_allclose(after.velocities[:, node], there.velocity, atol=1e-12)
    finer = grip.resampled(
        rod, jaxrod.resample(jaxrod.make_scene(rod), state, 3 * n)[0].rod
    )
    assert finer.end == 3 * node
    for end in (0, n):
        with pytest.raises(ValueError, match="the number of an inner node, 1 to"):
            jaxrod.driven(state, end, free_to_turn=True)
    with pytest.raises(ValueError, match="end must be from 0"):
        jaxrod.driven(state, n + 1, free_to_turn=True)
    with pytest.raises(ValueError, match="free_to_turn=True"):
        jaxrod.driven(state, node)


def driven_and_standing(held):
    """A scene with a driven end at a moment, and what stands where it is then."""
    rod, state = along_x()
    shake = jaxrod.schedules.sine((0.03, 0.01, 0.02), 0.4)
    others = (jaxrod.uniform_load((0.0, 0.05, -0.3)),)
    if held != "node":
        turns = {"axis": (0.0, 1.0, 1.0), "angle": jaxrod.schedules.sine(0.4, 0.3)}
        turns["holds_element"] = held == "element"
        driven = jaxrod.driven(state, displacement=shake, **turns)
    else:
        driven = jaxrod.driven(state, displacement=shake, axes="xz", free_to_turn=True)
        others += (
            jaxrod.pin_support(state, "tip", axes="yz"),
            jaxrod.pin_support(state, axes="y"),
        )
    moment = jaxrod.make_scene(rod, driven, *others).at(MOMENT)
    place = moment.effects[0].place.position
    moved = replace(state, positions=state.positions.at[:, 0].set(place))
    if held != "node":
        frame = moment.effects[0].turn.orientation
        like = jaxrod.clamp if held == "wall" else jaxrod.fixed_end
        standing = replace(like(moved), orientation=frame)
    else:
        moved = replace(moved, positions=moved.positions.at[1, 0].set(0.0))
        standing = jaxrod.pin_support(moved, axes="xz")
    return moment, state, jaxrod.make_scene(rod, standing, *others), moved


@pytest.mark.slow
@pytest.mark.parametrize("held", ["wall", "element", "node"])
def test_a_driven_end_at_a_moment_is_a_support_that_stands_there(held):
    moment, state, standing, moved = driven_and_standing(held)
    # From where the end is driven, and from elsewhere.
    expected = jaxrod.equilibrium(standing, moved)
    assert expected.converged
    for start in (moved, state):
        found = jaxrod.equilibrium(moment, start)
        assert found.converged
        np.testing.assert_allclose(
            found.state.positions, expected.state.positions, rtol=0, atol=1e-9
        )
    for ask in (jaxrod.natural_frequencies, jaxrod.highest_frequency):
        one, other = (ask(scene, expected.state) for scene in (moment, standing))
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-3)
    one, other = (
        jaxrod.reactions(scene, expected.state)[0] for scene in (moment, standing)
    )
    expected = np.asarray(other.couple)
    if held == "element":
        # What turns faster and faster takes a couple; the axis is across the rod.
        turn, across = moment.effects[0].turn, moment.rod.principal_inertias[0, 0]
        faster = across * np.asarray(turn.angular_acceleration)
        assert np.max(np.abs(faster)) > 1e-4
        expected = expected + faster
    np.testing.assert_allclose(one.couple, expected, rtol=0, atol=1e-9)


def test_an_end_that_is_driven_faster_takes_its_mass_times_acceleration():
    """An unstressed rod is held along the axes of the path alone."""
    rod, state = along_x()
    size, period = np.array([0.03, 0.01, 0.02]), 0.4
    driven = jaxrod.driven(
        state,
        displacement=jaxrod.schedules.sine(size, period),
        axes="xz",
        free_to_turn=True,
    )
    moment = jaxrod.make_scene(rod, driven).at(MOMENT)
    place = moment.effects[0].place
    moved = state.positions + (place.position - state.positions[:, 0])[:, None]
    (reaction,) = jaxrod.reactions(moment, replace(state, positions=moved))
    rate = 2 * np.pi / period
    faster = -size * rate**2 * np.sin(rate * MOMENT)
    expected = float(rod.node_masses[0]) * faster * np.array([1, 0, 1])
    np.testing.assert_allclose(reaction.force, expected, rtol=1e-9, atol=1e-9)
    velocity = size * rate * np.cos(rate * MOMENT)
    assert float(reaction.power) == pytest.approx(expected @ velocity, rel=1e-9)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("turns", [0.3, 0.9, 1.1, 2.5, -7.2])
def test_a_wall_turns_more_than_once(turns):
    _, state = along_x()
    wall = jaxrod.driven(
        state,
        axis=(1.0, 0.0, 0.0),
        angle=jaxrod.schedules.ramp(0.0, 2 * np.pi * turns, 1.0),
    )
    angle = 2 * np.pi * turns
    for share in (0.5, 1.0):
        scene = jaxrod.make_scene(along_x()[0], wall).at(share)
        w, x, y, z = np.asarray(scene.effects[0].turn.orientation)
        start = np.asarray(state.orientations[:, 0])
        turn = np.array([np.cos(share * angle / 2), np.sin(share * angle / 2)])
        expected = [
            turn[0] * start[0] - turn[1] * start[1],
            turn[0] * start[1] + turn[1] * start[0],
            turn[0] * start[2] - turn[1] * start[3],
            turn[0] * start[3] + turn[1] * start[2],
        ]
        np.testing.assert_allclose([w, x, y, z], expected, atol=1e-12)


@pytest.mark.slow
def test_a_wall_winds_a_rod_up():
    rod, state = along_x()
    wall = jaxrod.driven(
        state,
        "tip",
        axis=(1.0, 0.0, 0.0),
        angle=jaxrod.schedules.ramp(0.0, 2 * np.pi * 1.5, 1.0),
    )
    damping = jaxrod.exponential_damping(10.0)
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state), wall, damping)
    dt = 0.8 * float(jaxrod.stable_dt(scene).dt)
    wound = jaxrod.advance(scene, state, dt, int(2.0 / dt))
    # Half an element at either end is the walls'.
    np.testing.assert_allclose(jaxrod.topology.twist(wound), 1.5 * 3 / 4, rtol=1e-4)

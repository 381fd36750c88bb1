"""A rod without twist moves as one with twist, but for its polar inertia."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.effects.directions import angle_over_sine, frame_along, smallest_rotation
from jaxrod.geometry.rotations import directors
from physics.torsion_free import free, largest_gap, swinging, with_twist

# What holds at one end holds at the other: the longer run looks at both.
ENDS = ["base", pytest.param("tip", marks=pytest.mark.slow)]


@pytest.mark.slow
@pytest.mark.parametrize("end", ENDS)
def test_in_a_plane_it_is_the_scene_with_twist_and_the_planar_one(end, record):
    scene, state = swinging(end=end)
    flat = replace(with_twist(scene), method=jaxrod.planar("zx"))
    bare, full, flat = (
        jaxrod.rollout(each, state, 2e-4, 1500, 100)
        for each in (scene, with_twist(scene), flat)
    )
    assert float(jnp.max(jnp.abs(full.positions - state.positions[None]))) > 0.1
    what = f"Without twist, motion in a plane, clamped at the {end}, 1500 steps: "
    record(
        what + "whole state, relative to its largest component",
        "the planar scene",
        largest_gap(bare, flat),
        at_most=1e-11,
    )
    without_spins = [replace(s, angular_momenta=s.positions) for s in (bare, full)]
    record(
        what
        + "positions, orientations, velocities, relative to their largest component",
        "the scene with twist",
        largest_gap(*without_spins),
        at_most=1e-11,
    )
    # Angular momenta are small; their round-off with twist is that against planar.
    assert largest_gap(bare, full) < 2 * max(largest_gap(full, flat), 1e-11)


@pytest.mark.slow
def test_out_of_a_plane_it_differs_by_the_polar_inertia(record):
    scene, state = swinging(n=6, sideways=6.0)

    def tips(polar):
        """Without and with twist, after steps that twist is stable with."""
        inertia = scene.rod.rotary_inertia.at[1].mul(polar)
        rod = replace(scene.rod, rotary_inertia=inertia)
        return [
            np.asarray(jaxrod.advance(replace(each, rod=rod), *run).tip)
            for each in (scene, with_twist(scene))
        ]

    run = (state, 1e-4, 2000)
    bare, full = tips(1.0)
    assert abs(full[1]) > 0.1, "the arm has to leave its plane"
    whole, less = np.max(np.abs(full - bare)), np.max(np.abs(np.subtract(*tips(1 / 8))))
    record(
        "Without twist, arm pushed sideways: tip after 0.2 s [lengths]",
        "the same scene with twist",
        whole,
        at_most=1e-3,
    )
    record(
        "Without twist: that difference with an eighth of the polar inertia, relative "
        "to the first",
        "1/8",
        less / whole,
        between=(0.06, 0.25),
    )


def test_momenta_are_kept_and_energy_does_not_drift(record):
    scene, state = free()
    dt = 0.1 * float(jaxrod.stable_dt(scene).dt)
    states = jaxrod.rollout(scene, state, dt, 4000, 100)
    of_all = lambda f: jax.vmap(lambda s: f(scene, s))(states)
    for name, function in (
        ("momentum", jaxrod.Scene.momentum),
        ("angular momentum", jaxrod.Scene.angular_momentum),
    ):
        values = np.asarray(of_all(function))
        record(
            f"Without twist, free rod, 4000 steps: {name}, relative to its start",
            "conserved",
            np.max(np.abs(values - values[0])) / np.max(np.abs(values[0])),
            at_most=1e-12,
        )
    energy = np.asarray(jax.vmap(lambda s: scene.total_energy(s))(states))
    early, late = np.mean(energy[1:14]), np.mean(energy[-13:])
    record(
        "Without twist, free rod, 4000 steps: drift of energy between first and last "
        "third, relative to the energy",
        "none",
        abs(late - early) / energy[0],
        at_most=1e-3,
    )


@pytest.mark.slow
def test_it_is_of_second_order_in_time(record):
    scene, state = free()
    span = 8 * float(jaxrod.stable_dt(scene).dt)
    ends = [jaxrod.advance(scene, state, span / n, n) for n in (40, 80, 160)]
    size = lambda a, b, part: float(jnp.max(jnp.abs(part(a) - part(b))))
    for name in ("positions", "velocities", "angular_momenta"):
        part = lambda s, name=name: getattr(s, name)
        ratio = size(ends[0], ends[1], part) / size(ends[1], ends[2], part)
        record(
            f"Without twist, free rod: order in time of {name}",
            "2",
            np.log2(ratio),
            between=(1.9, 2.1),
        )


@pytest.mark.slow
def test_loads_are_minus_the_gradient_of_the_energy(record):
    """For motions of nodes and turns of elements across their axes."""
    scene, state = free()
    scene = replace(scene, effects=(jaxrod.clamp(state),))
    n = scene.rod.n_elements
    one = jnp.ones(())
    integrator = scene.method.stepper(scene, state, one)
    inside = integrator.enter(state)

    def energy(moves):
        nodes, turns = moves
        moved = replace(
            inside,
            position=tuple(a + b for a, b in zip(inside.position, nodes, strict=True)),
            direction=_turned(inside.direction, turns),
        )
        return scene.potential_energy(integrator.leave(moved))

    zero = (jnp.zeros((3, n + 1)), jnp.zeros((3, n)))
    force, couple = jax.grad(energy)(zero)
    kicked = integrator.kick(inside)
    change = jnp.stack(kicked.spin) - jnp.stack(inside.spin)
    np.testing.assert_allclose(change, -couple, atol=1e-10 * jnp.max(jnp.abs(couple)))
    pushes = (jnp.stack(kicked.velocity) - jnp.stack(inside.velocity))[:, 1:]
    expected = -force[:, 1:] / scene.rod.node_masses[None, 1:]
    worst = float(jnp.max(jnp.abs(pushes - expected)) / jnp.max(jnp.abs(expected)))
    record(
        "Without twist: internal loads",
        "minus the gradient of the energy",
        worst,
        at_most=1e-12,
    )


def _turned(direction, turns):
    """Directions turned by small rotation vectors in the world frame."""
    x, y, z = direction
    a, b, c = turns
    x, y, z = x + b * z - c * y, y + c * x - a * z, z + a * y - b * x
    size = jnp.sqrt(x * x + y * y + z * z)
    return x / size, y / size, z / size


@pytest.mark.slow
@pytest.mark.parametrize("at_rest", [pytest.param(True, marks=pytest.mark.slow), False])
def test_gradients_agree_with_finite_differences(at_rest, record):
    scene, state = swinging(n=4, sideways=0.0 if at_rest else 2.0)
    if not at_rest:
        state = jaxrod.advance(scene, state, 2e-4, 100)

    @jax.jit
    def tip(size):
        rod = replace(
            scene.rod, bend_twist_stiffness=scene.rod.bend_twist_stiffness * size[0]
        )
        load = replace(scene.effects[3], force=scene.effects[3].force + size[1])
        changed = replace(scene, rod=rod, effects=(*scene.effects[:3], load))
        start = replace(
            state,
            velocities=state.velocities + size[2],
            angular_momenta=state.angular_momenta + 1e-3 * size[3],
        )
        return jnp.sum(jaxrod.advance(changed, start, 2e-4, 60).positions[:, -1])

    at = jnp.array([1.0, 0.0, 0.0, 0.0])
    exact = np.asarray(jax.jit(jax.grad(tip))(at))
    step = 1e-4
    moves = step * np.eye(4)
    measured = [float(tip(at + m) - tip(at - m)) / (2 * step) for m in moves]
    assert np.all(np.isfinite(exact))
    record(
        f"Without twist: gradient of the tip, {'at rest' if at_rest else 'moving'}",
        "finite differences",
        np.max(np.abs(exact - measured)) / np.max(np.abs(measured)),
        at_most=1e-6,
    )


@pytest.mark.slow
@pytest.mark.parametrize("end", ENDS)
def test_an_end_held_fast_stays(end):
    scene, state = swinging(n=6, end=end, sideways=1.0)
    held = jaxrod.make_scene(
        scene.rod,
        jaxrod.fixed_end(state, end),
        *scene.effects[1:3],
        method=jaxrod.torsion_free(),
    )
    bare = jaxrod.advance(held, state, 2e-4, 300)
    index = 0 if end == "base" else -1
    for field in ("positions", "orientations"):
        before, after = getattr(state, field), getattr(bare, field)
        np.testing.assert_allclose(after[:, index], before[:, index], atol=1e-14)
    full = jaxrod.advance(with_twist(held), state, 2e-4, 300)
    np.testing.assert_allclose(bare.positions, full.positions, atol=1e-4)


@pytest.mark.slow
def test_the_angle_between_directions_is_exact(dtype, record):
    angles = np.concatenate([[0.0], np.geomspace(1e-8, 3.14, 60)])
    a = (jnp.asarray(np.ones_like(angles), dtype), *[jnp.zeros(angles.size, dtype)] * 2)
    b = tuple(
        jnp.asarray(c, dtype) for c in (np.cos(angles), np.sin(angles), 0 * angles)
    )
    got = np.asarray(angle_over_sine(a, b) * b[1], np.float64)
    tolerance = {"float32": 1e-6, "float64": 1e-14}[str(dtype)]
    # Near pi a rounded unit vector does not have the angle to full precision.
    room = tolerance * (1 + 1 / np.abs(np.cos(angles / 2)))
    assert np.all(np.abs(got - angles) <= room * angles)
    opposite = jax.grad(
        lambda x: angle_over_sine((x, x * 0, x * 0), (-x, x * 0, x * 0))
    )
    assert np.isfinite(opposite(jnp.ones((), dtype)))


@pytest.mark.slow
def test_frames_have_their_direction_as_third_axis():
    random = np.random.default_rng(0).normal(size=(3, 50))
    random[:, :6] = np.concatenate([np.eye(3), -np.eye(3)], axis=1)
    d = tuple(jnp.asarray(random / np.linalg.norm(random, axis=0)))
    np.testing.assert_allclose(directors(frame_along(d))[2], d, atol=1e-15)
    north = (jnp.ones(50), jnp.zeros(50), jnp.zeros(50))
    q = smallest_rotation(north, d)
    turned = directors(q)
    np.testing.assert_allclose(
        [c[:3] for c in turned[0]], [c[:3] for c in d], atol=1e-15
    )

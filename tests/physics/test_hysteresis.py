"""Hysteresis of bending: its loop, independence of speed and direction, and loss."""

from dataclasses import replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from physics.bending import moments_along, straight

STIFFNESS, SLIP = 0.8, 0.2


def wires(rod, stiffness=STIFFNESS, slip=SLIP, into=None):
    return jaxrod.materials.bending_hysteresis(
        rod, stiffness=stiffness, slip_moment=slip, into=into
    )


def cycles(largest, count, steps):
    """Curvatures of a zigzag from zero, between plus and minus `largest`."""
    phase = np.arange(count * steps + 1) / steps
    return largest * (2 * np.abs(2 * ((phase + 0.25) % 1) - 1) - 1) * -1


def followed(rod, state, curvatures, about=(0.0, 1.0)):
    """Moments along an axis of bending, for curvatures about that axis."""
    path = np.asarray(curvatures)[:, None] * np.asarray(about)[None, :]
    moments, _ = moments_along(wires(rod), rod, state, jnp.asarray(path))
    return np.asarray(moments)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("steps", [4, 100])
@pytest.mark.parametrize("largest", [0.1, 0.5])
def test_loops_have_the_closed_form(largest, steps, record):
    """The ends, the area and the slopes of a loop: for steps of any size."""
    rod, state = straight(3)
    curvatures = cycles(largest, 20, steps)
    moments = followed(rod, state, curvatures)[:, 1]
    reach = STIFFNESS * largest / SLIP
    end = SLIP * np.tanh(reach)
    last = slice(-steps - 1, None)
    found, path = moments[last], curvatures[last]
    error = abs(np.max(found) / end - 1)
    if steps == 4:
        assert error < 1e-9
        return
    record(
        f"Moment at the end of a loop to {largest:g}/m",
        "m_c tanh x",
        error,
        at_most=1e-9,
    )
    area = abs(np.sum(0.5 * (found[1:] + found[:-1]) * np.diff(path)))
    exact = 4 * SLIP * largest * (1 - np.tanh(reach) / reach)
    name = f"Area of a loop to {largest:g}/m, by the trapezoidal rule"
    record(name, "4 m k (1 - tanh x / x)", abs(area / exact - 1), at_most=0.01)
    # After turning back, wires that slip the other way stick twice as well.
    turn = int(np.argmax(path))
    slope = (found[turn + 1] - found[turn]) / (path[turn + 1] - path[turn])
    fall = 4 * reach / steps
    exact = STIFFNESS * (1 + np.tanh(reach)) * (1 - np.exp(-fall)) / fall
    error = abs(slope / exact - 1)
    record(f"Slope of a loop to {largest:g}/m after it turns", "s (1 + m/m_c)", error,
           at_most=1e-9)  # fmt: skip


def test_first_bending_is_that_of_dahl():
    rod, state = straight(3)
    curvatures = np.linspace(0, 1.5, 40)
    exact = SLIP * -np.expm1(-STIFFNESS * curvatures / SLIP)
    found = followed(rod, state, curvatures)[:, 1]
    np.testing.assert_allclose(found, exact, atol=1e-12)


def test_speed_does_not_matter():
    """The same path, in other numbers of steps and of other sizes: the same moment."""
    rod, state = straight(3)
    turns = [0.0, 0.7, -0.4, 0.2, 0.1, 0.6]
    coarse = followed(rod, state, turns)
    fine = np.concatenate([np.linspace(a, b, 33)[:-1] for a, b in pairwise(turns)])
    slowly = followed(rod, state, [*fine, turns[-1]])
    np.testing.assert_allclose(slowly[::32], coarse, atol=1e-12)


def test_no_direction_is_preferred():
    """Bending in a plane at an angle is bending in a plane."""
    rod, state = straight(3)
    path = cycles(0.4, 2, 12)
    flat = followed(rod, state, path)[:, 1]
    tilted = followed(rod, state, path, about=(0.6, 0.8))
    np.testing.assert_allclose(tilted, flat[:, None] * [[0.6, 0.8]], atol=1e-12)


def test_turning_the_plane_never_exceeds_the_slip_moment():
    """A curvature that goes round in a circle: the moment follows it, rotated."""
    rod, state = straight(3)
    angle = np.linspace(0, 12 * np.pi, 1500)
    path = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    _, after = moments_along(wires(rod), rod, state, jnp.asarray(path))
    size = np.linalg.norm(after.moment[:, :, 1], axis=1)
    assert np.all(size < SLIP)
    # In the steady state the moment m turns with the curvature k: with x = s k/m_c,
    # m' = s (k' - m |k'|/m_c) has the solution |m| = m_c x / sqrt(1 + x^2).
    reach = STIFFNESS * 1.0 / SLIP
    assert size[-1] == pytest.approx(SLIP * reach / np.hypot(1, reach), rel=1e-3)


def test_energy_lost_is_that_of_friction(record):
    """In motion: what a rod loses is m^2 |dk|/m_c per length, of all its joints."""
    rod, state = straight(3)
    wall = jaxrod.clamp(state)
    scene = jaxrod.make_scene(rod, wall, wires(rod, 10.0, 1.0, into=wall))
    kick = jnp.asarray([[0.0, 0.3, 0.5]]).T * jnp.linspace(0, 1, 4)[None, :] ** 2
    begun = jaxrod.with_memory(scene, replace(state, velocities=kick))
    dt = 0.4 * jaxrod.stable_dt(scene).dt
    states = jaxrod.rollout(scene, begun, dt, 2000, 1)
    totals = jax.jit(jax.vmap(scene.total_energy))(states)
    memory = states.memory[1]
    moment = 0.5 * (memory["moment"][1:] + memory["moment"][:-1])
    path = np.linalg.norm(np.diff(memory["curvature"], axis=0), axis=1)
    lengths = np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6])[None, :]
    loss = np.sum(np.sum(np.asarray(moment) ** 2, axis=1) * path * lengths)
    assert loss > 0.3 * totals[0]
    error = abs(totals[0] - totals[-1] - loss) / loss
    record(
        "Energy lost, compared with the work of friction",
        "m^2 dk/m_c along the path",
        error,
        at_most=0.01,
    )

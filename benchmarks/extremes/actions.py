"""Extreme actions on the benchmark's arm in free space, and what becomes of it.

Actuation as in Cases 3 and 4: 50 elements, steps of 1e-4 s, actions every 1.4 ms,
75 N m on every element times a spline through two control points, at 0.4 and 0.9 of
the length, about d1 and d2. A third of the episodes hold one corner of the action
space throughout, a third jump between corners every 0.14 s on average, a third draw a
new action every time. In half of each the controls are rate-limited as published, in
half they jump.
"""

from __future__ import annotations

import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from jaxrod.effects.loads import ExponentialDamping
from jaxrod.envs.arm.soft_arm import TORQUE_PER_ELEMENT, VISCOSITY, clean_rod
from jaxrod.geometry import vectors
from jaxrod.methods.laws import IN_SPACE
from jaxrod.rods.elasticity import joint_rotations
from jaxrod.structure import pytree

N_ELEMENTS, DT, SUBSTEPS = 50, 1e-4, 14
CONTROL_POINTS = (0.4, 0.9)
LARGEST_CHANGE = 0.01 * SUBSTEPS
KINDS = ("held", "switched", "random")
FLAGS = (
    "not_finite",
    "stretch",
    "joint_angle",
    "speed",
    "spin",
    "norm",
    "violation",
)


@pytree
class Outcome:
    """Record of an episode."""

    flagged: jax.Array
    """A health flag rose; from then on the arm is frozen."""
    flags: jax.Array
    """The flags that rose, in the order of `FLAGS`."""
    smallest_stretch: jax.Array
    largest_stretch: jax.Array
    largest_joint_angle: jax.Array
    largest_speed: jax.Array
    excess: jax.Array
    """Largest energy beyond the work done so far, over the largest energy [1]."""


def turned(before, after):
    """Rotation of each element, material frame [rad]."""
    pairs = jnp.stack([before.orientations, after.orientations], axis=2)

    def one(pair):
        rotation, _ = joint_rotations((pair[0], pair[1], pair[2], pair[3]))
        return vectors.join(rotation)[:, 0]

    return jax.vmap(one, in_axes=1, out_axes=1)(pairs)


def episode(index, key, mode, dtype, control_steps):
    """One episode; pure."""
    rod, rest = clean_rod(N_ELEMENTS, (0.0, 0.0, 0.0), "z")
    rod, rest = jax.tree.map(lambda leaf: leaf.astype(dtype), (rod, rest))
    hold = jaxrod.clamp if mode == "consistent" else jaxrod.fixed_end
    transverse = rod.rotary_inertia[0, 0]
    effects = (
        hold(rest),
        ExponentialDamping(
            jnp.asarray(VISCOSITY, dtype) / rod.linear_density[0],
            jnp.asarray(VISCOSITY, dtype) / transverse,
        ),
    )
    spline = jaxrod.actuation.control_spline(CONTROL_POINTS, 1.0, dtype)
    kind = index % len(KINDS)
    change = jnp.where(index // len(KINDS) % 2 == 0, LARGEST_CHANGE, 2.0)
    dt = jnp.asarray(DT, dtype)

    def corner(key):
        return jax.random.rademacher(key, (2, 2)).astype(dtype)

    def control_step(carry, k):
        state, applied, wanted, work, outcome = carry
        key_now = jax.random.fold_in(key, k)
        switch, draw = jax.random.split(key_now)
        jump = jax.random.uniform(switch) < 0.01
        drawn = jax.random.uniform(draw, (2, 2), dtype, -1.0, 1.0)
        switched = jnp.where(jump, corner(draw), wanted)
        wanted = jnp.where(kind == 0, wanted, jnp.where(kind == 1, switched, drawn))
        applied = jaxrod.actuation.limit_rate(applied, wanted, change)
        controls = jnp.concatenate([applied, jnp.zeros_like(applied[:1])])
        couples = TORQUE_PER_ELEMENT * spline(controls, rod.arc_length_midpoints)
        scene = jaxrod.make_scene(
            rod,
            *effects,
            jaxrod.actuation.ElementCouples(couples),
            method=IN_SPACE[mode],
        )
        after = jaxrod.advance(scene, state, dt, SUBSTEPS)
        report = jaxrod.health(scene, after, dt)
        work = work + jnp.sum(couples * turned(state, after))
        found = [getattr(report, flag) for flag in FLAGS[1:]]
        flags = jnp.stack([~report.finite, *found])
        energy = scene.total_energy(after)
        sound = ~outcome.flagged
        excess = (energy - work) / (jnp.abs(work) + 1)

        def kept(extreme, before, now, count=sound):
            return jnp.where(count, extreme(before, now), before)

        outcome = Outcome(
            flagged=outcome.flagged | report.flagged,
            flags=jnp.where(sound, flags, outcome.flags),
            smallest_stretch=kept(
                jnp.fmin, outcome.smallest_stretch, report.smallest_stretch
            ),
            largest_stretch=kept(
                jnp.fmax, outcome.largest_stretch, report.largest_stretch
            ),
            largest_joint_angle=kept(
                jnp.fmax, outcome.largest_joint_angle, report.largest_joint_angle
            ),
            largest_speed=kept(jnp.fmax, outcome.largest_speed, report.largest_speed),
            excess=kept(jnp.fmax, outcome.excess, excess, sound & ~report.flagged),
        )
        state = jaxrod.freeze(outcome.flagged, state, after)
        return (state, applied, wanted, work, outcome), None

    zero = jnp.zeros((), dtype)
    nothing = Outcome(
        flagged=jnp.zeros((), bool),
        flags=jnp.zeros(len(FLAGS), bool),
        smallest_stretch=zero + 1,
        largest_stretch=zero + 1,
        largest_joint_angle=zero,
        largest_speed=zero,
        excess=zero,
    )
    start = (
        rest,
        jnp.zeros((2, 2), dtype),
        corner(jax.random.fold_in(key, control_steps)),
        zero,
        nothing,
    )
    (state, _, _, _, outcome), _ = jax.lax.scan(
        control_step, start, jnp.arange(control_steps)
    )
    return outcome, jnp.all(jnp.isfinite(state.positions))


@partial(jax.jit, static_argnames=("mode", "dtype", "control_steps"))
def episodes(indices, mode, dtype, control_steps):
    """A batch of numbered episodes; each has its own randomness."""
    keys = jax.vmap(lambda i: jax.random.fold_in(jax.random.key(2024), i))(indices)
    return jax.vmap(lambda i, k: episode(i, k, mode, dtype, control_steps))(
        indices, keys
    )


def run(count, seconds, mode="consistent", dtype="float32", batch=64, offset=0):
    """Runs episodes from number `offset` on; returns all outcomes."""
    control_steps = round(seconds / (DT * SUBSTEPS))
    begin = time.perf_counter()
    parts = []
    for first in range(offset, offset + count, batch):
        indices = jnp.arange(first, first + batch)
        parts.append(
            jax.tree.map(np.asarray, episodes(indices, mode, dtype, control_steps))
        )
    outcome, finite = jax.tree.map(
        lambda *leaves: np.concatenate(leaves)[:count], *parts
    )
    kinds = np.arange(offset, offset + count) % len(KINDS)
    return {
        "mode": mode,
        "dtype": dtype,
        "episodes": count,
        "seconds": seconds,
        "episodes_flagged": int(outcome.flagged.sum()),
        "flagged_by_kind": {
            kind: int(outcome.flagged[kinds == k].sum()) for k, kind in enumerate(KINDS)
        },
        "flags": dict(zip(FLAGS, outcome.flags.sum(axis=0).tolist(), strict=True)),
        "states_not_finite_after_freezing": int((~finite).sum()),
        "smallest_stretch": float(outcome.smallest_stretch.min()),
        "largest_stretch": float(outcome.largest_stretch.max()),
        "largest_joint_angle": float(outcome.largest_joint_angle.max()),
        "largest_speed": float(outcome.largest_speed.max()),
        "energy_beyond_work": float(outcome.excess.max()),
        "wall_seconds": time.perf_counter() - begin,
    }

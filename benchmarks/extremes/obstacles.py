"""Extreme actions among obstacles, in the library's physics, and their outcomes.

The tasks are Case 3 ("structured") or Case 4 ("unstructured") in the variant "clean",
in float32. A third of the episodes hold one corner of the action space throughout, a
third jump between corners every 0.14 s on average, a third draw a new action every
time. Overlap of arm and obstacles is tested after every step of the simulation, at the
nodes and halfway between them.
"""

from __future__ import annotations

import operator
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from jaxrod.envs import make
from jaxrod.geometry import vectors
from jaxrod.structure import pytree

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
    penetration: jax.Array
    """Deepest overlap with an obstacle, over the arm's radius [1]."""
    smallest_stretch: jax.Array
    largest_stretch: jax.Array
    largest_speed: jax.Array


def penetration(arm, state):
    """Largest depth of an arm in an obstacle, over its radius [1]."""
    nodes = state.positions
    points = jnp.concatenate([nodes, 0.5 * (nodes[:, 1:] + nodes[:, :-1])], axis=1)
    (touch,) = arm.obstacles
    nearest = jnp.inf
    for k in range(touch.n_bodies):
        body = jax.tree.map(operator.itemgetter(k), touch.body)
        nearest = jnp.minimum(nearest, body.surface(vectors.split(points))[0])
    return 1 - jnp.min(nearest) / arm.rod.radii[0]


def episode(index, key, task, params, control_steps):
    """One episode; pure."""
    arm, size = params.arm, task.action_size
    kind = index % len(KINDS)

    def corner(key):
        return jax.random.rademacher(key, (size,)).astype(params.dt.dtype)

    def control_step(carry, k):
        state, muscles, wanted, outcome = carry
        switch, draw = jax.random.split(jax.random.fold_in(key, k))
        jump = jax.random.uniform(switch) < 0.01
        drawn = jax.random.uniform(draw, (size,), params.dt.dtype, -1.0, 1.0)
        switched = jnp.where(jump, corner(draw), wanted)
        wanted = jnp.where(kind == 0, wanted, jnp.where(kind == 1, switched, drawn))
        values = jnp.reshape(wanted, (task.n_directions, task.n_controls))
        controls = jnp.pad(values, ((0, 3 - task.n_directions), (0, 0)))
        muscles = jaxrod.actuation.limit_rate(muscles, controls, arm.largest_change)
        scene = arm.scene(muscles, state)

        def step(_, passed):
            state, depth = passed
            state = jaxrod.advance(scene, state, params.dt, 1)
            return state, jnp.fmax(depth, penetration(arm, state))

        begin = state, jnp.zeros_like(params.dt)
        after, depth = jax.lax.fori_loop(0, task.substeps, step, begin)
        report = jaxrod.health(scene, after, params.dt, limits=arm.limits)
        flags = [~report.finite, *(getattr(report, flag) for flag in FLAGS[1:])]
        sound = ~outcome.flagged
        shortest = jnp.fmin(outcome.smallest_stretch, report.smallest_stretch)

        def largest(before, now):
            return jnp.where(sound, jnp.fmax(before, now), before)

        outcome = Outcome(
            flagged=outcome.flagged | report.flagged,
            flags=jnp.where(sound, jnp.stack(flags), outcome.flags),
            penetration=largest(outcome.penetration, depth),
            smallest_stretch=jnp.where(sound, shortest, outcome.smallest_stretch),
            largest_stretch=largest(outcome.largest_stretch, report.largest_stretch),
            largest_speed=largest(outcome.largest_speed, report.largest_speed),
        )
        state = jaxrod.freeze(outcome.flagged, state, after)
        return (state, muscles, wanted, outcome), None

    zero = jnp.zeros_like(params.dt)
    no = jnp.zeros((), bool)
    flags = jnp.zeros(len(FLAGS), bool)
    nothing = Outcome(no, flags, zero, zero + 1, zero, zero)
    first = corner(jax.random.fold_in(key, control_steps))
    start = (arm.rest, arm.relaxed(), first, nothing)
    (state, _, _, outcome), _ = jax.lax.scan(
        control_step, start, jnp.arange(control_steps)
    )
    return outcome, jnp.all(jnp.isfinite(state.positions))


@partial(jax.jit, static_argnames=("task", "control_steps"))
def episodes(indices, task, params, control_steps):
    """A batch of episodes, numbered; each has randomness of its own."""
    keys = jax.vmap(lambda i: jax.random.fold_in(jax.random.key(2024), i))(indices)
    return jax.vmap(lambda i, k: episode(i, k, task, params, control_steps))(
        indices, keys
    )


def run(name, count, seconds, batch=24, offset=0):
    """Runs episodes from number `offset` on; returns what became of them all."""
    task = make(name, variant="clean")
    params = task.default_params()
    control_steps = round(seconds / task.control_period)
    begin = time.perf_counter()
    parts = []
    for first in range(offset, offset + count, batch):
        indices = jnp.arange(first, first + batch)
        found = episodes(indices, task, params, control_steps)
        parts.append(jax.tree.map(np.asarray, found))
    outcome, finite = jax.tree.map(
        lambda *leaves: np.concatenate(leaves)[:count], *parts
    )
    kinds = np.arange(offset, offset + count) % len(KINDS)
    return {
        "task": name,
        "episodes": count,
        "seconds": seconds,
        "episodes_flagged": int(outcome.flagged.sum()),
        "flagged_by_kind": {
            kind: int(outcome.flagged[kinds == k].sum()) for k, kind in enumerate(KINDS)
        },
        "flags": dict(zip(FLAGS, outcome.flags.sum(axis=0).tolist(), strict=True)),
        "states_not_finite_after_freezing": int((~finite).sum()),
        "deepest_penetration_over_radius": float(outcome.penetration.max()),
        "smallest_stretch": float(outcome.smallest_stretch.min()),
        "largest_stretch": float(outcome.largest_stretch.max()),
        "largest_speed": float(outcome.largest_speed.max()),
        "wall_seconds": time.perf_counter() - begin,
    }

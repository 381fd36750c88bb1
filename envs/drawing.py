"""Conversion of a task's snapshots into a replay or a still picture."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeGuard

import jax
import numpy as np
from jaxtyping import Float, UInt8

from jaxrod.envs.protocol import Drawable, Environment, Snapshot
from jaxrod.viz import Cylinder, Replay, Sphere, frame


def drawable(env: Environment) -> TypeGuard[Drawable]:
    """Whether an environment can be drawn: has `snapshot` and `control_period`."""
    return not missing(env)


def missing(env: Environment) -> str:
    """Sentence that lists what an environment lacks for drawing; empty if nothing."""
    lacks = []
    if not callable(getattr(env, "snapshot", None)):
        lacks.append("no method snapshot(state, params)")
    if not hasattr(env, "control_period"):
        lacks.append("no control_period [s]")
    if not lacks:
        return ""
    return f"{env.name} does not say what to draw: it has {' and '.join(lacks)}"


def snapshots(env: Drawable, states: Any, params: Any) -> Snapshot:
    """Snapshots of many states, stacked along the first axis of every leaf.

    `env.snapshot` is not compiled here, so that every number equals that of a single
    state's snapshot.

    Raises:
        ValueError: The environment returns something other than a `Snapshot`.
    """

    def one(state: Any) -> Snapshot:
        seen: Any = env.snapshot(state, params)
        if not isinstance(seen, Snapshot):
            raise ValueError(
                f"snapshot of {env.name} must return a jaxrod.envs.Snapshot, "
                f"got {type(seen).__name__}"
            )
        return seen

    return jax.vmap(one)(states)


def replay(
    seen: Snapshot,
    times: Float[np.ndarray, " frames"],
    readouts: Mapping[str, Any] | None = None,
    title: str = "",
) -> Replay:
    """Makes a replay from the snapshots of all frames.

    Args:
        seen: Snapshots of the frames, stacked along the first axis of every leaf.
        times: Times of the frames [s].
        readouts: Additional numbers of every frame, shown before those of the
            snapshots.
        title: Heading of the replay.

    Raises:
        ValueError: A number is not valid, or a radius or a cylinder changes.
    """
    seen = jax.tree.map(np.asarray, seen)
    return Replay.from_rollout(
        seen.positions,
        _lasting("radii", seen.radii),
        times,
        spheres=[
            Sphere(centre, float(_lasting("the radius of a sphere", radius)))
            for centre, radius in seen.spheres
        ],
        cylinders=[
            Cylinder(
                _lasting("an end of a cylinder", start),
                _lasting("an end of a cylinder", end),
                float(_lasting("the radius of a cylinder", radius)),
            )
            for start, end, radius in seen.cylinders
        ],
        readouts={**(readouts or {}), **seen.readouts},
        title=title,
        up=seen.up,
    )


def edge_lengths(env: Drawable, params: Any) -> Float[np.ndarray, "rods n"]:
    """Element lengths of all rods at the start of an episode [m]."""
    _, start = env.reset(jax.random.key(0), params)
    nodes = _nodes(env.snapshot(start, params))
    return np.linalg.norm(nodes[..., 1:] - nodes[..., :-1], axis=1)


def picture(
    seen: Snapshot, lengths: Float[np.ndarray, "rods n"], seconds: float
) -> UInt8[np.ndarray, "480 640 3"]:
    """RGB picture of one snapshot, always from the same viewpoint.

    Args:
        seen: Snapshot of the moment.
        lengths: Element lengths, as `edge_lengths` returns them for the environment.
        seconds: Time since the episode began [s].
    """
    nodes = _nodes(seen)
    # The view must contain everything that straight rods can reach, so that it never
    # moves. So the frames before the drawn one show the rods straight along every axis.
    arcs = np.cumsum(np.pad(lengths, ((0, 0), (1, 0))), axis=1)
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    reach = nodes[None, :, :, :1] + axes[:, None, :, None] * arcs[None, :, None, :]
    positions = np.concatenate([reach, nodes[None]])
    radii: Any = np.broadcast_to(seen.radii, lengths.shape)
    still = dataclasses.replace(seen, radii=radii, readouts={})
    moments: Any = jax.tree.map(
        lambda leaf: np.repeat(np.asarray(leaf)[None], len(positions), axis=0), still
    )
    moments = dataclasses.replace(moments, positions=positions)
    return frame(replay(moments, np.arange(-len(reach), 1) + seconds), -1)


def _nodes(seen: Snapshot) -> Float[np.ndarray, "rods 3 n+1"]:
    """Node positions of a snapshot [m]; a single rod gets a leading axis."""
    nodes = np.asarray(seen.positions, float)
    return nodes if nodes.ndim == 3 else nodes[None]


def _lasting(name: str, values: Any) -> np.ndarray:
    """First of the values of all frames; raises a ValueError unless all are equal.

    `name` is the name of the values in the message.
    """
    if not np.array_equal(values, np.broadcast_to(values[:1], values.shape)):
        raise ValueError(f"{name} of a snapshot must not change during an episode")
    return values[0]

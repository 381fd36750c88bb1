"""A made-up motion to look at: a bending, tapering arm that chases a target."""

from __future__ import annotations

import numpy as np

from jaxrod.viz import Cylinder, Replay, Sphere


def swinging_arm(
    num_frames: int = 601, duration: float = 10.0, n: int = 20, num_rods: int = 1
) -> Replay:
    """An arm of length 1 m along +y that bends with a travelling wave."""
    times = np.linspace(0.0, duration, num_frames)
    s = (np.arange(n) + 0.5) / n
    rods = np.arange(num_rods)
    t = times[:, None, None] + 0.35 * rods[:, None]
    bend = (0.9 * s + 0.9 * s**2) * np.sin(1.7 * t - 1.2 * s)
    swing = 1.1 * np.sin(0.63 * t + 0.4 * s)
    tangents = np.stack(
        [np.sin(bend) * np.cos(swing), np.cos(bend), np.sin(bend) * np.sin(swing)], -1
    )
    nodes = np.concatenate(
        [np.zeros((num_frames, num_rods, 1, 3)), np.cumsum(tangents / n, axis=2)], 2
    )
    nodes[..., 0] += 0.35 * (rods[:, None] - (num_rods - 1) / 2)
    lagged = np.clip(np.arange(num_frames) - 12, 0, None)
    wobble = 0.08 * np.sin(2.3 * times)[:, None] * np.array([1.0, 0.4, -0.6])
    target = nodes[lagged, 0, -1] * 0.92 + wobble
    distance = np.linalg.norm(nodes[:, 0, -1] - target, axis=-1)
    return Replay.from_nodes(
        nodes,
        np.linspace(0.05, 0.03, n),
        times,
        spheres=[Sphere(target, 0.05)],
        cylinders=[Cylinder((0.45, 0.0, -0.4), (0.45, 0.9, -0.4), 0.05)],
        readouts={"distance [m]": distance, "reward": -(distance**2)},
        title="Swinging arm",
        up="y",
    )

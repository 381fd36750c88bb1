"""Problems as `flex.py` wants them, and the other interpreter that runs it."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.mujoco_rods import scenes
from benchmarks.mujoco_rods.problem import Problem, Run

SHORT_EDGE = 1e-4
"""Length of an edge within the wall, over that of an element [1]."""


class Setting(NamedTuple):
    """Ways in which MuJoCo holds edges together and steps."""

    edges: str
    """"held" or "springs"; see `flex.py`."""
    dt: float
    """Time step [s]."""
    short_edge: bool = False
    """Whether a short edge within the wall is the clamp, instead of the first."""

    @property
    def words(self) -> str:
        """The setting in the table."""
        edges = {"held": "edges held, `discrete`", "springs": "edges springs, `Euler`"}
        clamp = ", short edge in the wall" if self.short_edge else ""
        return f"{edges[self.edges]}{clamp}"


def job(problem: Problem, setting: Setting) -> dict[str, Any]:
    """The fields of `flex.Job`.

    Edges that are held do not stretch. Where it is known how the rod is stretched, as
    in the swinging cable, they are as long as it stretches them.
    """
    scene = problem.scene
    rest, start = problem.rest, problem.start
    if scene is scenes.SWINGING and setting.edges == "held":
        rest = scenes.hung(scene)
    each = scene.weight / scenes.GRAVITY * scene.length / scene.n
    masses = np.full(scene.n + 1, each)
    masses[[0, -1]] /= 2
    held = [0, 1] if problem.clamped else list(problem.pinned)
    if setting.short_edge:
        before = rest[0] - SHORT_EDGE * (rest[1] - rest[0])
        rest, start = np.vstack([before, rest]), np.vstack([before, start])
        masses = np.append(0.0, masses)
    return {
        "rest": rest.tolist(),
        "start": start.tolist(),
        "held": held,
        "radius": scene.radius,
        "youngs_modulus": scene.youngs_modulus,
        "shear_modulus": scene.youngs_modulus / 3,
        "masses": masses.tolist(),
        "gravity": problem.gravity,
        "force": [0.0, 0.0, problem.force],
        "damping": scene.damping,
        "edges": setting.edges,
        "dt": setting.dt,
        "steps": round(problem.interval / setting.dt),
        "looks": problem.looks,
    }


def run_all(
    python: str, problems: list[tuple[Problem, Setting]]
) -> tuple[str, list[Run]]:
    """MuJoCo's version, and the runs of all problems.

    Args:
        python: An interpreter with MuJoCo 4 and NumPy.
        problems: Problems and their settings.

    Raises:
        ValueError: If that interpreter cannot run them.
    """
    jobs = [job(*one) for one in problems]
    script = Path(__file__).with_name("flex.py")
    try:
        done = subprocess.run(
            [python, str(script)],
            input=json.dumps(jobs),
            capture_output=True,
            text=True,
        )
    except OSError as error:
        raise ValueError(f"--mujoco {python}: {error.strerror}") from None
    if done.returncode or not done.stdout:
        last = done.stderr.strip().rpartition("\n")[2] or "it said nothing"
        raise ValueError(f"--mujoco {python} could not run its rods: {last}")
    found = json.loads(done.stdout.splitlines()[-1])
    runs = [
        Run(
            np.asarray(one["tips"]),
            np.asarray(one["nodes"]),
            one["speed"],
            setting.dt,
            one["first"],
            one["second"],
        )
        for one, (_, setting) in zip(found["runs"], problems, strict=True)
    ]
    return found["version"], runs

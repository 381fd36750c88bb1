"""The published results, and what of them a run compares with."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from jaxrod.viz import ReferenceScore

CASES = {
    "tracking": "Case1",
    "reaching": "Case2",
    "structured": "Case3",
    "unstructured": "Case4",
}
"""The paper's names of the tasks."""

_FILE = Path(__file__).with_name("published.csv")
_COMPARABLE = ("variant", "controls")
"""Options of a task with which its scores compare with the paper's."""


@dataclasses.dataclass(frozen=True)
class PaperResult:
    """Result of one algorithm on one case in the paper.

    The paper is "Elastica: A compliant mechanics environment for soft robotic
    control" (Naughton et al. 2021); the numbers were recomputed from its published
    training logs, see benchmarks/paper/README.md.
    """

    case: str
    """Name of the case in the paper, "Case1" to "Case4"."""
    algorithm: str
    """Name of the algorithm in the paper, for example "PPO"."""
    configuration: str
    """Setting that the paper varied, for example "batch=32000"."""
    in_figure: bool
    """Whether the paper's figures show this configuration."""
    seeds: int
    """Number of independent runs."""
    timesteps: int
    """Number of control steps per run."""
    final_mean: float
    """Final episode return, mean over seeds."""
    final_std: float
    """Final episode return, standard deviation over seeds."""
    best: float
    """Highest rolling mean of the episode return."""
    unstable_fraction: float
    """Share of episodes in which the simulation blew up."""
    wall_hours: float
    """Mean duration of a run [h]."""
    steps_per_s: float
    """Control steps per second of a run [1/s]."""

    @property
    def reference(self) -> ReferenceScore:
        """The score, to draw learning curves against."""
        return ReferenceScore(
            f"paper, {self.algorithm}", self.final_mean, self.final_std, self.wall_hours
        )


def paper_result(
    case: str, algorithm: str, configuration: str | None = None
) -> PaperResult:
    """Returns a result of the paper, by default the one in its figures.

    Args:
        case: "Case1" to "Case4" (or a variant such as "Case3-ctrlpts").
        algorithm: "PPO", "TRPO", "SAC", "TD3" or "DDPG", in upper or lower case.
        configuration: One of the settings that the paper varied.

    Raises:
        ValueError: The paper has no such result, or several.
    """
    key = (case.lower(), algorithm.lower())
    tried = [r for r in _results() if (r.case.lower(), r.algorithm.lower()) == key]
    if configuration is None:
        found = [r for r in tried if r.in_figure]
        asked = "shown in its figures"
    else:
        found = [r for r in tried if r.configuration == configuration]
        asked = f"with configuration {configuration!r}"
    if len(found) != 1:
        known = ", ".join(repr(r.configuration) for r in tried) or "none"
        raise ValueError(
            f"the paper has {len(found) or 'no'} results for case {case!r}, algorithm "
            f"{algorithm!r} {asked}; configurations it tried: {known}"
        )
    return found[0]


@cache
def _results() -> tuple[PaperResult, ...]:
    rows = csv.DictReader(_FILE.read_text("utf-8").splitlines())
    return tuple(
        PaperResult(
            case=row["case"],
            algorithm=row["algorithm"],
            configuration=row["configuration"],
            in_figure=row["in_figure"] == "1",
            seeds=int(row["seeds"]),
            timesteps=int(row["timesteps"]),
            final_mean=float(row["final_mean"]),
            final_std=float(row["final_std"]),
            best=float(row["best"]),
            unstable_fraction=float(row["unstable_fraction"]),
            wall_hours=float(row["wall_hours"]),
            steps_per_s=float(row["steps_per_s"]),
        )
        for row in rows
    )


def result_of_run(config: Mapping[str, Any]) -> PaperResult | None:
    """The paper's result for the task of a run; None if scores do not compare.

    Args:
        config: Configuration, as in `config.json`.
    """
    options = config["env_options"] or {}
    options = {name: value for name, value in options.items() if value is not None}
    if config.get("variant") != "paper" or config["task"] not in CASES:
        return None
    if not set(options) <= set(_COMPARABLE):
        return None
    case, configuration = CASES[config["task"]], None
    if "controls" in options:
        case = f"{case}-ctrlpts"
        configuration = f"batch=16000,n_ctrl={options['controls']}"
    try:
        return paper_result(case, config["algorithm"], configuration)
    except ValueError:
        return None

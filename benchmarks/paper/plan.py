"""The cells of a grid: a case, an algorithm, a seed, and how each is trained."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.paper.published import CASES, PaperResult, result_of_run
from benchmarks.paper.settings import GRID, planned
from jaxrod.cli.settings import word_of


@dataclasses.dataclass(frozen=True)
class Cell:
    """One run of the grid."""

    task: str
    """Name of the task, such as "tracking"."""
    algorithm: str
    """Name of the learner, such as "ppo"."""
    variant: str | None
    """Variant of the task; None where it has none."""
    seed: int
    """Seed of all randomness."""
    steps: int
    """Control steps, whole updates."""
    changed: tuple[str, ...]
    """Settings that differ from the learner's defaults, as NAME=VALUE."""
    settings: Mapping[str, Any]
    """All settings, as `config.json` keeps them."""

    @property
    def case(self) -> str:
        """The paper's name of the case; the task's own where it is not the paper's."""
        return CASES.get(self.task, self.task)

    @property
    def name(self) -> str:
        """Name of its files, such as "Case1-PPO-0"."""
        variant = () if self.variant in (None, "paper") else (self.variant,)
        return "-".join((self.case, self.algorithm.upper(), *variant, str(self.seed)))

    @property
    def config(self) -> dict[str, Any]:
        """Settings that decide how it ends, as in `config.json`."""
        return {
            "task": self.task,
            "variant": self.variant,
            "env_options": {"variant": self.variant} if self.variant else {},
            "algorithm": self.algorithm,
            "steps": self.steps,
            "seed": self.seed,
            "settings": dict(self.settings),
        }

    @property
    def paper(self) -> PaperResult | None:
        """Score of the paper; None where scores do not compare."""
        return result_of_run(self.config)

    @property
    def beside(self) -> str:
        """The paper's score as text; empty if there is none."""
        return f"  paper {self.paper.final_mean:,.0f}" if self.paper else ""

    def command(self, out: Path) -> list[str]:
        """The words that run it, after `jaxrod`."""
        words = ["train", self.task, "--algorithm", self.algorithm]
        if self.variant:
            words += ["--variant", self.variant]
        words += ["--steps", str(self.steps), "--seed", str(self.seed)]
        for word in self.changed:
            words += ["--set", word]
        return [*words, "--out", str(out)]


def plan(
    cases: Sequence[str],
    algorithms: Sequence[str],
    seeds: Sequence[int],
    *,
    variant: str | None = None,
    steps: int | None = None,
    fraction: float | None = None,
) -> list[Cell]:
    """Lays out a grid, in the order in which it is run: all cells of a seed first.

    Args:
        cases: names of tasks, or what the paper calls them; all of the paper's if
            empty.
        algorithms: names of learners; all if empty.
        seeds: seeds of every pair of them.
        variant: of the tasks, None for their own.
        steps: control steps of every cell, instead of the planned ones.
        fraction: share of the planned control steps.

    Raises:
        ValueError: something is not known or makes no sense.
    """
    from jaxrod.validation import check_seed

    tasks = _unique([_task(case) for case in cases] or list(CASES))
    known = [*GRID["tracking"]]
    chosen = _unique([word.lower() for word in algorithms] or known)
    for word in chosen:
        if word not in known:
            raise ValueError(f"algorithm must be one of {', '.join(known)}; got {word}")
    if not seeds:
        raise ValueError("seeds must hold at least one seed, got none")
    for seed in seeds:
        check_seed(seed, "seeds")
    if fraction is not None and not 0 < fraction <= 1:
        raise ValueError(f"steps-fraction must be in (0, 1], got {fraction}")
    return [
        _cell(task, algorithm, seed, variant, steps, fraction)
        for seed in _unique(seeds)
        for task in tasks
        for algorithm in chosen
    ]


def _cell(
    task: str,
    algorithm: str,
    seed: int,
    variant: str | None,
    steps: int | None,
    fraction: float | None,
) -> Cell:
    from jaxrod.envs import make
    from jaxrod.training import find_algorithm
    from jaxrod.training.runs.recorded_settings import recorded

    env = make(task, variant=variant) if variant else make(task)
    variant = getattr(env, "variant", None)
    learner = find_algorithm(algorithm)
    cell_plan = planned(task, algorithm, variant)
    wanted = steps if steps is not None else int(cell_plan.steps * (fraction or 1.0))
    different: dict[str, Any] = dict(cell_plan.settings)
    if "short_steps" in different and wanted < cell_plan.steps:
        # The same part of a shorter run: an episode must have time to be complete.
        different["short_steps"] *= wanted / cell_plan.steps
    config = dataclasses.replace(learner.config_type(), **different)
    learner.validate(config, 1)
    cell = Cell(
        task=task,
        algorithm=algorithm,
        variant=variant,
        seed=seed,
        steps=cell_plan.steps,
        changed=tuple(f"{name}={word_of(value)}" for name, value in different.items()),
        settings=recorded(config),
    )
    per_update = learner.steps_per_update(config)
    if steps is None and cell.paper is not None:
        # The paper's number or fewer: its runs ended a little before the round one.
        wanted = min(wanted, cell.paper.timesteps)
    if wanted < per_update:
        raise ValueError(
            f"{cell.name} needs at least one update, {per_update} control steps, "
            f"got {wanted}"
        )
    return dataclasses.replace(cell, steps=wanted // per_update * per_update)


def _task(word: str) -> str:
    """The task of that name, its own or the paper's."""
    papers = {case.lower(): task for task, case in CASES.items()}
    task = papers.get(word.lower(), word)
    if task not in GRID:
        known = ", ".join((*GRID, *CASES.values()))
        raise ValueError(f"case must be one of {known}; got {word!r}")
    return task


def _unique(values: Sequence[Any]) -> list[Any]:
    return list(dict.fromkeys(values))

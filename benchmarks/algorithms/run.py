"""Settings of the learners compared with the reference's: docs/algorithms.md.

`reference.csv` has the settings of the reference and the reasons for ours. Our values
come from the code: the defaults of the learners, and `benchmarks.paper.settings` for
each case. A setting that `reference.csv` lacks or states wrongly is an error.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from benchmarks.paper.settings import CLEAN, GRID, Planned
from benchmarks.shared.files import ROOT
from jaxrod.files import write_atomically
from jaxrod.training import LearnerConfig, find_algorithm

REFERENCE = Path(__file__).with_name("reference.csv")
PAGE = ROOT / "docs" / "algorithms.md"
CASES = tuple(case for case in GRID if case != "trivial")
LEARNERS = tuple(sorted(GRID["tracking"]))
"""Those of the published grid: the others have no reference."""
OTHERS = ("dagger", "shac")

BEGINNING = """\
# Algorithms and their settings

Written by `python -m benchmarks algorithms` from the settings in the code and
`benchmarks/algorithms/reference.csv`; do not edit.

This page lists the settings of the five learners of the published benchmark, and of two
learners that differentiate the simulation. All learners are compiled programs: the
simulation, the stored transitions and the gradient steps stay on the device. The
reference is the implementation of the published benchmark. It used Stable Baselines
2.10.1 with one environment and default settings, except for those that it names. Its
on-policy PPO is `PPO1`.

`jaxrod train TASK --algorithm NAME --set help` lists all settings. The docstrings of
`jaxrod.training.PPOConfig`, `TRPOConfig`, `SACConfig`, `TD3Config` and `DDPGConfig`
explain them. Those of `LearnerConfig`, `OnPolicyConfig` and `OffPolicyConfig` explain
the settings that several learners share. The first two tables list every setting with
its default. The first and the third list every setting of the grid, which is all
combinations of a task (a case of the paper) and a learner.

In a decision the policy chooses an action. The action is held for `action_repeat`
control steps, by default one, and their rewards are summed. All numbers of steps on
this page are control steps, unless stated otherwise. An exported policy contains its
`action_repeat`; evaluations and replays use it.

Off-policy learners (SAC, TD3 and DDPG) alternate between `num_envs * rollout_steps`
decisions and `gradient_steps` gradient steps. By default there are 1024 control steps,
and 64 gradient steps on 256 transitions each. That is one gradient step for every 16
control steps, and each transition is used 16 times. The reference makes one
gradient step for each control step (DDPG: one for two) on 64 (SAC) or 128 transitions,
so it uses each transition 64 to 128 times. A gradient step takes as much time as dozens
of control steps of an arm. If control steps are scarce and time is not, first increase
the number of gradient steps per control step. Then reduce `num_envs`, because the first
episodes end only after `num_envs` times the episode length.

## Differences from the reference

The table lists every difference between our settings and those of the paper. The
settings in a row for a single case replace those in the row for all cases.
`jaxrod reproduce` runs every case with these settings (`benchmarks/paper/settings.py`).
All seeds use the same settings. Each run makes as many whole updates as fit into its
control steps. [Reproducing the benchmark](reproduce.md) explains the reasons. We chose
the settings by [these runs](../benchmarks/paper/tried.md), and the page of
[results](../benchmarks/paper/records/results.md) has the returns. If a cell has several
values, a semicolon separates them, in the order of the algorithms of the row.
"""
IN_OUR_PHYSICS = """\
## Differences in the `clean` obstacle tasks

Two tasks have obstacles: `structured` and `unstructured`. In their variant `clean` a
control step takes less time to compute ([how fast the tasks are](environments.md)), and
no published number of control steps limits a run. Runs therefore use more environments,
two to six million control steps, and actions held for 4 or 7 ms. For these cases
`jaxrod reproduce --variant clean` uses the settings below instead of those above. We
did not try TRPO and DDPG in `clean`: they use the settings above.
"""

BY_GRADIENTS = """\
## Learners that use gradients of the simulation

`dagger` fits a network to the actions of a planner
([DAgger](https://arxiv.org/abs/1011.0686)). The policy acts, and at every decision the
planner computes a better action. It simulates `lookahead` control steps with the
policy's action, and takes one Gauss-Newton step on the task's residuals at their end.
A least-squares fit then adapts the network to all improved actions so far. `dagger`
needs a task with `predict` and `residuals` ([planning](planning.md)) and uses no
reward. [Learning by gradients](first_order.md) compares it with PPO. In `progress.csv`
the column `model_steps` counts the control steps that the planner simulates. The steps
of the run do not include them. The table below omits settings that all learners share
(`jaxrod.training.LearnerConfig`). `dagger` rejects two of these, `discount` and
`reward_scale`.

`shac` ([short-horizon actor-critic](https://arxiv.org/abs/2204.07137)) maximises the
return of a short window plus the value of its final state, by gradients through the
simulation. With `critic=false` there is no such value, and the learner is the analytic
policy gradient (APG). By default the reward is minus the task's smooth cost. With
`objective=reward` it is the task's reward, whose bonuses have no gradient. `shac` skips
an update if the gradient is not finite, and the column `skipped` of `progress.csv`
counts these updates.

`jaxrod.training.warm_start(PPO, policy)` is PPO that starts from a trained policy, for
example one from `dagger`. Its configuration needs the policy's `hidden_sizes` and
`action_repeat`, and a small `initial_log_std`. With `gru_units` the policy becomes
recurrent. `python -m benchmarks best_learners TASK` trains in this way for
`tracking` and `reaching`. The page [Optimum](optimum.md) has the results.
"""


@dataclasses.dataclass(frozen=True)
class Row:
    """One row of `reference.csv`."""

    algorithms: str
    """Names of learners, or "all"."""
    cases: str
    """Names of tasks, or "all"."""
    setting: str
    """Name of a setting; "steps"; empty for what is no setting."""
    reference: str
    """The reference's value, or what it does."""
    ours: str
    """Choice made here; empty where the code says it."""
    why: str
    """Why ours differs; empty where it does not."""

    def named(self) -> list[str]:
        """The learners that the row describes."""
        return _listed(self.algorithms, LEARNERS)

    def value(self) -> Any:
        """Our value of the setting, the same for all learners of the row.

        Raises:
            ValueError: The learners have different values.
        """
        values = [
            _default(name, self.setting)
            if self.cases == "all"
            else _planned(GRID[case][name], self.setting)
            for case in _listed(self.cases, CASES)
            for name in self.named()
        ]
        if any(value != values[0] for value in values):
            raise ValueError(f"{self} has several values: {values}")
        return values[0]


def page(rows: Iterable[Row]) -> str:
    """The document.

    Raises:
        ValueError: The rows do not match the settings.
    """
    rows = list(rows)
    check(rows)
    different = [row for row in rows if row.why]
    same = [row for row in rows if not row.why]
    heads = ("Algorithm", "Case", "Setting", "Reference", "Ours", "Why")
    lines = [BEGINNING, *_table(heads, map(_told, different)), ""]
    lines += ["## Settings as in the reference", ""]
    cells = ((row.algorithms, f"`{row.setting}`", row.reference) for row in same)
    lines += [*_table(("Algorithm", "Setting", "Value"), cells), "", IN_OUR_PHYSICS]
    lines += _table(("Cases", "Algorithms", "Setting", "Value"), _grouped(CLEAN))
    lines += ["", BY_GRADIENTS]
    lines += _table(("Algorithm", "Setting", "Default"), _of_others())
    return "\n".join(lines) + "\n"


def check(rows: list[Row]) -> None:
    """Raises ValueError unless every setting is listed once, with its true value."""
    for name in LEARNERS:
        fields = dataclasses.fields(find_algorithm(name).config_type())
        _once(name, (field.name for field in fields), rows, name, "all")
        for case in CASES:
            settings = GRID[case][name].settings
            _once(f"{name} in {case}", settings, rows, name, case)
    for row in rows:
        if row.cases == "all" and row.setting:
            as_there = _same(row.reference, row.value())
            if as_there and row.why:
                raise ValueError(f"{row} gives a reason, but it is as in the reference")
            if not as_there and not row.why:
                raise ValueError(f"{row} is {row.value()} now: why?")


def _once(
    what: str, settings: Iterable[str], rows: list[Row], name: str, case: str
) -> None:
    """Raises ValueError unless the rows of a learner list each setting once."""
    told = Counter(
        row.setting
        for row in rows
        if row.setting not in ("", "steps")
        and name in row.named()
        and (row.cases == "all" if case == "all" else case in row.cases.split(", "))
    )
    wanted = Counter(list(settings))
    if told != wanted:
        wrong = sorted((told - wanted) + (wanted - told))
        raise ValueError(
            f"{REFERENCE.name} must tell each setting of {what} once: "
            f"{', '.join(wrong)}"
        )


def _told(row: Row) -> tuple[str, ...]:
    """A row of the page."""
    setting, reference, ours = f"`{row.setting}`", row.reference, row.ours
    if row.setting == "steps":
        setting, reference = "—", f"{reference} control steps"
        ours = f"{row.value():,}"
    elif row.setting:
        ours = _shown(row.value())
    else:
        setting = "—"
    return row.algorithms, row.cases, setting, reference, ours, row.why


def _grouped(grid: Mapping[str, Mapping[str, Planned]]) -> Iterator[tuple[str, ...]]:
    """Rows (cases, algorithms, setting, value) of a grid, as few as possible."""
    users: dict[tuple[str, str], dict[str, list[str]]] = {}
    for case, plans in grid.items():
        for name, plan in plans.items():
            for setting, value in plan.settings.items():
                by_case = users.setdefault((setting, _shown(value)), {})
                by_case.setdefault(case, []).append(name)
    for (setting, shown), by_case in users.items():
        for names in dict.fromkeys(", ".join(names) for names in by_case.values()):
            cases = [case for case, some in by_case.items() if ", ".join(some) == names]
            yield ", ".join(cases), names, f"`{setting}`", shown


def _of_others() -> Iterator[tuple[str, ...]]:
    """Rows (algorithm, setting, default) of what is not in the published grid."""
    usual = LearnerConfig()
    for name in OTHERS:
        config = find_algorithm(name).config_type()
        for field in dataclasses.fields(config):
            value = getattr(config, field.name)
            if value != getattr(usual, field.name, None):
                yield name, f"`{field.name}`", _shown(value)


def _listed(words: str, everything: Iterable[str]) -> list[str]:
    return list(everything) if words == "all" else words.split(", ")


def _default(algorithm: str, setting: str) -> Any:
    return getattr(find_algorithm(algorithm).config_type(), setting)


def _planned(plan: Planned, setting: str) -> Any:
    return plan.steps if setting == "steps" else plan.settings[setting]


def _shown(value: Any) -> str:
    """A value in a table."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return ", ".join(map(str, value))
    if not isinstance(value, int | float):
        return str(value)
    return f"{value:,.0f}" if value >= 10_000 else f"{value:g}"


def _same(reference: str, value: Any) -> bool:
    """Whether a cell states this value, as text or as a number."""
    try:
        return float(reference.replace(",", "")) == value
    except ValueError:
        return reference == _shown(value)


def _table(heads: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> list[str]:
    rule = "|---" * len(heads) + "|"
    cells = [f"| {' | '.join(row)} |" for row in (heads, *rows)]
    return [cells[0], rule, *cells[1:]]


def read(file: Path = REFERENCE) -> list[Row]:
    """The rows of `reference.csv`."""
    with file.open(newline="", encoding="utf-8") as stream:
        return [Row(**row) for row in csv.DictReader(stream)]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Takes no arguments."""


def run(args: argparse.Namespace) -> int:
    """Writes the document."""
    write_atomically(PAGE, page(read()).encode())
    return 0

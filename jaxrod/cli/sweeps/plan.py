"""Planning of a sweep: all combinations of tasks, algorithms, settings and seeds."""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from jaxrod.cli import runs, settings
from jaxrod.cli.settings import word_of
from jaxrod.cli.train import short_name
from jaxrod.envs import Environment, check_environment, names
from jaxrod.envs.importing import canonical_path
from jaxrod.installation.backend import devices_that_fit
from jaxrod.training import RunFolder
from jaxrod.training.runs.contract import resolve, updates_of
from jaxrod.training.runs.folder import differences
from jaxrod.training.runs.loop import request
from jaxrod.training.runs.recorded_settings import recorded
from jaxrod.training.settings import check_steps
from jaxrod.validation import check_count, check_seed

_LONGEST = 200
"""Largest length of a run's name. File systems allow 255 characters, of which some are
needed for endings."""
_UNASKED = ("score_window",)
"""Entries of a configuration in which a started run may differ from its plan."""


class Planned(Protocol):
    """A run that is planned: its properties before it is trained."""

    @property
    def name(self) -> str:
        """Name of the folder of the run."""

    @property
    def steps(self) -> int:
        """Number of control steps of the run."""

    @property
    def config(self) -> dict[str, Any]:
        """Contents that `config.json` of the run will have."""

    @property
    def beside(self) -> str:
        """Text to show after the score of the run, with a separator; may be empty."""

    def command(self, out: Path) -> list[str]:
        """Words after `jaxrod` of the command that trains the run in folder `out`."""


def differs(
    planned: Planned, folder: RunFolder, stored: Mapping[str, Any] | None = None
) -> list[str]:
    """Differences between a started run and its plan, one phrase per entry.

    Args:
        planned: The planned run.
        folder: Folder of the run; a run that was not started has no differences.
        stored: Stored configuration; None to read it from the folder.
    """
    if stored is None:
        stored = folder.config() if folder.exists else planned.config
    return differences(stored, planned.config, _UNASKED)


@dataclasses.dataclass(frozen=True)
class SweepRun:
    """One run of a sweep."""

    task: str
    """Name or import path of the task."""
    variant: str | None
    """Variant of the task; None if it has none."""
    algorithm: str
    """Name or import path of the learner."""
    seed: int
    """Seed of all random numbers."""
    steps: int
    """Number of control steps of the run."""
    chosen: Mapping[str, str]
    """Values of the settings that the sweep sets, as text, by name."""
    config: dict[str, Any]
    """Contents that `config.json` of the run will have."""
    options: tuple[str, ...] = ()
    """Words of the command that all runs of the sweep share, such as the variant."""
    devices: int | None = None
    """Number of CPU devices for the environments; None for as many as fit."""

    beside = ""

    @property
    def group(self) -> str:
        """Algorithm and settings as text, equal in runs that differ only in seed."""
        settings = (f"{name}={word}" for name, word in sorted(self.chosen.items()))
        return " ".join((self.algorithm, *settings))

    @property
    def subject(self) -> str:
        """Task and variant as text: equal in runs whose returns can be compared."""
        return _for_files(*filter(None, (short_name(self.task), self.variant)))

    @property
    def name(self) -> str:
        """Name of the folder, such as "tracking-clean-ppo-learning_rate=0.001-0"."""
        return _for_files(self.subject, *self.group.split(" "), str(self.seed))

    def command(self, out: Path) -> list[str]:
        """Words after `jaxrod` of the command that trains the run in folder `out`."""
        words = ["train", self.task, "--algorithm", self.algorithm, *self.options]
        words += ["--steps", str(self.steps), "--seed", str(self.seed)]
        if self.devices is not None:
            words += ["--devices", str(self.devices)]
        for name, word in sorted(self.chosen.items()):
            words += ["--set", f"{name}={word}"]
        return [*words, "--out", str(out)]


def plan(
    tasks: Sequence[str],
    algorithms: Sequence[str],
    seeds: Sequence[int],
    *,
    steps: int,
    variant: str | None = None,
    options: Sequence[str] = (),
    sets: Sequence[str] = (),
    cores: int | None = None,
) -> list[SweepRun]:
    """Plans a sweep in the order of execution: all runs of a seed first.

    Args:
        tasks: Names or import paths of tasks.
        algorithms: Names or import paths of learners.
        seeds: Seeds of every combination.
        steps: Number of control steps of every run.
        variant: Variant of the tasks, None for their own defaults.
        options: Options of the tasks, as NAME=VALUE.
        sets: Settings as NAME=VALUE,VALUE,..., for one algorithm as
            ALGORITHM.NAME=VALUE. Several entries of one name are alternatives, too. For
            a tuple this is the only way to give alternatives.
        cores: Number of cores of every run; None for all cores that its process finds.

    Raises:
        ValueError: A name is unknown or a value is invalid.
        ImportError: A user's own task or learner cannot be imported.
    """
    check_count("steps", steps, 1)
    seeds = [check_seed(seed, "seeds") for seed in dict.fromkeys(seeds)]
    made, words = settings.options(options), []
    for option in options:
        words += ["--option", option]
    if variant is not None:
        made["variant"] = variant
        words += ["--variant", variant]
    envs = {canonical_path(task): _env(task, made) for task in tasks}
    learners = {
        name: _configurations(name, _meant(name, sets, algorithms), steps, cores)
        for name in dict.fromkeys(algorithms)
    }
    found = [
        SweepRun(
            task=task,
            variant=getattr(env, "variant", None),
            algorithm=name,
            seed=seed,
            steps=steps,
            chosen=chosen,
            config=request(
                env, name, recorded(config), steps, seed, runs.score_window(task)
            ),
            options=tuple(words),
            devices=devices,
        )
        for seed in seeds
        for task, env in envs.items()
        for name, configurations in learners.items()
        for chosen, config, devices in configurations
    ]
    _check_names(found)
    return found


def _env(task: str, options: Mapping[str, Any]) -> Environment:
    env = runs.make_task(task, options)
    if task not in names():
        check_environment(env)
    return env


def _configurations(
    name: str, sets: Sequence[str], steps: int, cores: int | None
) -> list[tuple[dict[str, str], Any, int | None]]:
    """All combinations of the alternatives of one learner's settings.

    Args:
        name: Name of the learner.
        sets: Alternatives as NAME=VALUE,VALUE,...
        steps: Number of control steps of every run, for a check.
        cores: Number of cores of every run; None if not known.

    Returns:
        For every combination the values as text by name, the learner's settings, and
        the number of devices (None if `cores` is None).
    """
    learner, defaults = resolve(name, None)
    found: list[tuple[dict[str, str], Any, int | None]] = []
    try:
        values = _alternatives(defaults, sets)
        for combination in itertools.product(*values.values()):
            chosen = dict(zip(values, combination, strict=True))
            words = [f"{setting}={text}" for setting, text in chosen.items()]
            config = settings.configure(defaults, {}, words)
            spread = getattr(config, "num_envs", 1) if learner.partition else 1
            devices = None if cores is None else devices_that_fit(spread, None, cores)
            learner.validate(config, devices or 1)
            check_steps(steps, updates_of(learner, config))
            found.append((chosen, config, devices))
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error
    return found


def _meant(name: str, sets: Sequence[str], algorithms: Sequence[str]) -> list[str]:
    """Words of `--set` that apply to an algorithm, without the prefix "ALGORITHM."."""
    found = []
    for word in sets:
        owner, dot, _ = word.partition("=")[0].rpartition(".")
        if dot and owner not in algorithms:
            raise ValueError(f"{owner} of {word} must be one of the sweep's algorithms")
        if not dot or owner == name:
            found.append(word[len(owner) + 1 :] if dot else word)
    return found


def _alternatives(defaults: Any, sets: Sequence[str]) -> dict[str, dict[str, None]]:
    """Returns the distinct values of each setting as text, by name of the setting.

    They are the keys of a dict, in order. `sets` contains words NAME=VALUE,VALUE,... of
    the command line.
    """
    values: dict[str, dict[str, None]] = {}
    for word in sets:
        setting, equals, text = word.partition("=")
        # The commas of a tuple separate its entries.
        whole = isinstance(getattr(defaults, setting, None), tuple)
        for part in [text] if whole or not equals else text.split(","):
            one = f"{setting}{equals}{part}"
            value = getattr(settings.configure(defaults, {}, [one]), setting)
            shown = part if callable(value) or value is None else word_of(value)
            values.setdefault(setting, {})[shown] = None
    return values


def _check_names(found: Sequence[SweepRun]) -> None:
    """Raises ValueError unless the names of all runs differ and are short enough."""
    for name, count in Counter(run.name for run in found).items():
        if count > 1:
            raise ValueError(f"{count} of the runs would have the same folder, {name}")
        if len(name) > _LONGEST:
            raise ValueError(f"{name} is too long for the name of a folder")


def _for_files(*words: str) -> str:
    """Words joined by "-" into a name that is valid on every file system."""
    return re.sub(r"[^\w.=,+-]", "-", "-".join(words))

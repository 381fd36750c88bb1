"""Opening of stored runs for the commands, with errors that name the cause."""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxrod.cli import settings
from jaxrod.files import UntrustedError, read_json, reading, with_tuples

if TYPE_CHECKING:
    from jaxrod.envs import Environment
    from jaxrod.training import Policy
    from jaxrod.training.runs.owned_folder import OwnedFolder

_SCORE_WINDOWS = {"structured": 10, "unstructured": 10}
_SCORE_WINDOW = 50


def score_window(task: str) -> int:
    """Number of final training episodes whose mean return is the score of a run.

    As in the paper, it is 10 for `structured` and `unstructured` (Cases 3 and 4). It is
    50 for all other tasks.
    """
    return _SCORE_WINDOWS.get(task, _SCORE_WINDOW)


@dataclasses.dataclass(frozen=True)
class StoredRun:
    """A run on disk, finished or not.

    Attributes:
        path: Folder of the run.
        config: Contents of `config.json`: task, algorithm, settings, seed.
        env: The environment of the run.
        trust: Modules that may be imported because the run names them.
    """

    path: Path
    config: dict[str, Any]
    env: Environment
    trust: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """Short description of the run, see `describe`."""
        return describe(self.config)

    def policy(self) -> Policy:
        """Reads the deterministic policy.

        Raises:
            ValueError: There is no policy yet, or it is damaged or of another run.
            UntrustedError: The run names an untrusted algorithm or network of a user.
        """
        from jaxrod.training import MLPPolicy, restore_policy
        from jaxrod.training.runs.folder import renamed

        folder = self.path / "policy"
        if not (folder / "policy.json").exists():
            raise ValueError(
                f"{self.path} holds no policy yet (no policy/policy.json): it is "
                "saved with the first checkpoint and at the end of training"
            )
        policy = restore_policy(self.path, self.env, trust=self.trust)
        file = folder / "policy.json"
        others = [
            f"{name} is {value!r}"
            for name, value in renamed(read_json(file).get("about", {})).items()
            if name in self.config and value != self.config[name]
        ]
        if others:
            raise ValueError(
                f"{file} belongs to another run than {self.path / 'config.json'}: "
                f"they differ in {', '.join(others)}"
            )
        if not isinstance(policy, MLPPolicy):
            return policy  # Its structure follows from the task and the settings.
        sizes = policy.layers[0][0].shape[0], policy.layers[-1][1].shape[0]
        wanted = self.env.observation_size, self.env.action_size
        if sizes != wanted:
            raise ValueError(
                f"{folder} maps {sizes[0]} observations to {sizes[1]} actions, but "
                f"{self.env.name} has {wanted[0]} and {wanted[1]}"
            )
        return policy


def add_run(parser: argparse.ArgumentParser) -> None:
    """Declares RUN, the folder of a run, `--task` and `--trust`."""
    parser.add_argument(
        "run_folder", type=settings.path, metavar="RUN", help="folder of a run"
    )
    parser.add_argument(
        "--task",
        metavar="TASK",
        help="callable that makes the task of RUN, such as my_task.py:MyTask, if RUN "
        "does not name it or its file has moved",
    )
    add_trust(parser)


def add_trust(parser: argparse.ArgumentParser) -> None:
    """Declares `--trust`, for commands that open a run."""
    parser.add_argument(
        "--trust",
        action="append",
        default=[],
        metavar="MODULE",
        help="module (full name) or .py file that may be imported because RUN names "
        "it; may be given several times. Without it only built-in code runs, "
        "because the folder of a run may come from anyone (docs/runs.md)",
    )


def open_run(
    path: Path, trust: Collection[str] = (), task: str | None = None
) -> StoredRun:
    """Reads the configuration of a run and makes its environment.

    Args:
        path: The folder.
        trust: Modules that may be imported because the run names them, see
            `jaxrod.envs.importing.check_trusted`.
        task: Task that the user typed, to be made with the options of the run; None
            for the task that the run names.

    Raises:
        ValueError: There is no run, or its `config.json` is damaged.
        UntrustedError: The task of the run is a user's own, and not trusted.
    """
    from jaxrod import envs

    config, file = read_config(path), path / "config.json"
    options = config["env_options"]
    if task is not None:
        env = make_task(task, options or {})
        return StoredRun(path, config, env, tuple(trust))
    task = config["task"]
    if options is None:
        raise ValueError(
            f"{file} does not say what makes its environment, which was made in "
            f"Python: {config.get('environment', task)}. Name its class, or a function "
            "that returns it, by --task FILE.py:NAME"
        )
    if task not in envs.names():
        env = _made_again(file, task, options, trust)
        return StoredRun(path, config, env, tuple(trust))
    with reading(file):
        env = make_task(task, options)
        if env.name != task:
            raise ValueError(f"its 'env_options' make {env.name!r}, not {task!r}")
        if config.get("variant") != getattr(env, "variant", None):
            raise ValueError(
                f"'variant' is {config.get('variant')!r}, but its 'env_options' "
                f"give {getattr(env, 'variant', None)!r}"
            )
    return StoredRun(path, config, env, tuple(trust))


def _made_again(
    file: Path, task: str, options: Mapping[str, Any], trust: Collection[str]
) -> Environment:
    """Makes the environment of a user's own task again, from a run's `config.json`.

    Errors name the file.
    """
    from jaxrod.envs.importing import NotThereError

    try:
        return make_task(task, options, trust)
    except UntrustedError as error:
        raise UntrustedError(f"the task of {file}: {error}") from error
    except NotThereError as error:
        raise ValueError(
            f"the task of {file} cannot be made again: {error}. If it has moved, give "
            "--task FILE.py:NAME"
        ) from error
    except ValueError as error:
        raise ValueError(f"the task of {file} cannot be made again: {error}") from error


def read_config(path: Path) -> dict[str, Any]:
    """Reads `config.json` of a run.

    Raises:
        ValueError: There is no run, or the file is damaged.
    """
    from jaxrod.training import RunFolder

    if path.exists() and not path.is_dir():
        raise ValueError(f"{path} is a file, not the folder of a run")
    if not (path / "config.json").exists():
        what = "holds no run (no config.json)" if path.is_dir() else "does not exist"
        raise ValueError(
            f"{path} {what}; make a run with: jaxrod train TASK --out {path}"
        )
    return RunFolder(path).config()


def make_task(
    task: str, options: Mapping[str, Any], trust: Collection[str] | None = None
) -> Environment:
    """Makes the environment of a task; a user's own may be in the current folder.

    Args:
        task: Task, as for `jaxrod.envs.make`.
        options: Options of the task. Lists, JSON's only sequences, become tuples,
            because an environment has to be hashable.
        trust: Trusted modules if the task was read from a file, see `open_run`; None if
            the user typed it.

    Raises:
        ValueError: There is no such task, or it does not take these options.
        UntrustedError: The task was read from a file and is not trusted.
    """
    from jaxrod import envs
    from jaxrod.envs.importing import check_trusted, import_callable

    own = ":" in task
    if own and trust is not None:
        # The trust is checked before modules can be imported from this folder.
        check_trusted(task, trust)
    if own:
        _search_here()
    if own and trust is not None:
        import_callable(task, trust)
    return envs.make(task, **{k: with_tuples(value) for k, value in options.items()})


def options_of_task(task: str) -> str:
    """Lines that explain the options of a task that the user typed.

    Raises:
        ValueError: There is no such task.
    """
    from jaxrod import envs

    if ":" in task:
        _search_here()
    return settings.listing_of_options(envs.registry.factory_of(task))


def _search_here() -> None:
    """Lets Python search for modules in the current folder, as `python -m` does."""
    here = os.getcwd()
    if here not in sys.path:
        sys.path.insert(0, here)


def describe(config: Mapping[str, Any]) -> str:
    """Short description of a run, such as "tracking (paper), ppo, seed 0"."""
    options = config.get("env_options") or {}
    what = [config["variant"]] if config.get("variant") else []
    named = ("variant", "randomise")
    chosen = {k: v for k, v in options.items() if k not in named and v is not None}
    what += [f"{name} = {value}" for name, value in chosen.items()]
    what += ["randomised"] if options.get("randomise") else []
    name = config["task"]
    file, colon, made_by = name.rpartition(":")
    if file.endswith(".py"):
        name = Path(file).name + colon + made_by
    task = name + (f" ({', '.join(what)})" if what else "")
    return printable(f"{task}, {config['algorithm']}, seed {config['seed']}")


def printable(text: str) -> str:
    """Text as one line that is safe to print: control characters become escapes."""
    line = " ".join(text.split("\n"))
    return "".join(
        sign if sign.isprintable() else sign.encode("unicode_escape").decode()
        for sign in line
    )


def add_out(parser: argparse.ArgumentParser, default: str) -> None:
    """Declares `--out` and `--overwrite`, for commands that write a result."""
    parser.add_argument(
        "--out",
        type=settings.path,
        default=Path(default),
        metavar="DIR",
        help=f"folder for the result (default: {default})",
    )
    parser.add_argument(
        "--overwrite", action="store_true", help="replace the result in DIR"
    )


def check_folder(folder: OwnedFolder, overwrite: bool) -> None:
    """Checks that a command may write its result into a folder.

    Raises:
        ValueError: The folder holds other files, or a result and `overwrite` is False.
    """
    folder.check_replaceable()
    if folder.exists and not overwrite:
        raise ValueError(
            f"{folder.path} holds a result already: replace it with --overwrite, or "
            "choose another folder with --out"
        )

"""The command line: `jaxrod COMMAND ...`.

Each command is a module of this package, named after the command, or a program in the
folder `benchmarks` of a checkout. Those programs run the published grid and compare
with other simulators; they are not installed. A module has

- a docstring: a description of the command, shown by `jaxrod COMMAND --help`;
- `add_arguments(parser)`: declares the arguments of the command, and may set
  `parser.epilog` to worked examples;
- `run(args) -> int`: executes the command and returns the exit code.

Only the module of the requested command is imported.

Exit codes: 0 done; 1 done, but with a bad result (such as a machine that fails `jaxrod
doctor`), or the release of JAX is unsound, or the command needs a checkout; 2 the
request is impossible; 70 a fault of jaxrod (with its traceback); 130 interrupted; 141
the output's reader has closed its pipe.
"""

from __future__ import annotations

import argparse
import difflib
import importlib
import importlib.util
import os
import shlex
import sys
import traceback
import warnings
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import TextIO

import jaxrod
from jaxrod.cli.runs import printable
from jaxrod.installation.jax_version import UnsoundJaxError
from jaxrod.installation.program_cache import asked_for, silence_false_alarms

COMMANDS = {
    "train": "train a policy on a task",
    "sweep": "train many policies: tasks, algorithms, settings, seeds",
    "evaluate": "measure the policy of a finished run",
    "render": "draw the learning curve and a replay of a run",
    "export": "write the policy of a run for a controller: C, ONNX",
    "identify": "estimate the parameters of a real arm from recordings",
    "optimise": "find actuation by gradients through the simulation",
    "completion": "print a completion script for bash or zsh",
    "doctor": "check that this machine computes correctly",
    "reproduce": "run the published benchmark: cases, algorithms, seeds *",
    "tradeoff": "measure what accuracy costs, and find the cheapest setting *",
    "benchmark": "measure rod-steps per second on this machine *",
}

EXTRAS = {
    "flax": "rl",
    "optax": "rl",
    "matplotlib": "viz",
    "gymnasium": "gym",
    "brax": "brax",
    "ray": "ray",
    "tensorboardX": "tensorboard",
    "onnx": "onnx",
    "shtab": "shell",
}

PROGRAMS = {
    "reproduce": "benchmarks.paper.run",
    "tradeoff": "benchmarks.tradeoff.run",
    "benchmark": "benchmarks.rod_steps.run",
}
"""Modules of the commands that are programs of a checkout, by command."""

BROKEN = 70
"""Exit code after an unexpected error, which is a fault of jaxrod."""

EPILOG = """\
* in a checkout of the repository, installed with `pip install -e .`

a first run:
  jaxrod doctor
  jaxrod train tracking --variant paper --algorithm ppo --out runs/first
  jaxrod evaluate runs/first
  jaxrod render runs/first

`jaxrod COMMAND --help` explains each command with examples.
JAXROD_TRACEBACK=1 shows where an error was raised. jaxrod keeps compiled programs for
the next call, unless JAXROD_CACHE=0 (docs/compiling.md).
"""


class NoCheckoutError(ImportError):
    """The package is not installed from a checkout."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; turns errors into messages on stderr and exit codes.

    Args:
        argv: Words after `jaxrod`; None for those of this process.

    Returns:
        The exit code.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    command = "jaxrod"
    if asked_for() is not False:
        silence_false_alarms()
    try:
        parser, chosen = _parser(arguments)
        command = parser.prog if chosen is None else f"jaxrod {chosen}"
        args = parser.parse_args(arguments)
        with _warnings_as_sentences(command):
            code = int(args.run(args))
        # A closed pipe has to raise here, not while the interpreter shuts down.
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        print(f"{command}: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except (ValueError, OSError, ImportError) as error:
        if os.environ.get("JAXROD_TRACEBACK"):
            raise
        print(f"{command}: {printable(_sentence(error))}", file=sys.stderr)
        unfit = isinstance(error, UnsoundJaxError | NoCheckoutError)
        return 1 if unfit else 2
    except Exception as error:
        if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
            print(
                f"{command}: out of memory: use smaller networks, fewer environments "
                "(--num-envs) or fewer elements "
                f"({printable(str(error)[:200])})",
                file=sys.stderr,
            )
            return 2
        # The contents of a run's files are checked when they are read. So this is a
        # fault of jaxrod, and only the traceback explains it.
        traceback.print_exc()
        words = printable(shlex.join(["jaxrod", *arguments]))
        print(
            f"{command}: {type(error).__name__}: {printable(str(error))} (a fault of "
            f"jaxrod: please report the lines above; the command was {words})",
            file=sys.stderr,
        )
        return BROKEN


@contextmanager
def _warnings_as_sentences(command: str) -> Iterator[None]:
    """Context in which a warning is one line on stderr, without its source line."""

    def show(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        print(f"{command}: warning: {printable(str(message))}", file=sys.stderr)

    before, warnings.showwarning = warnings.showwarning, show
    try:
        yield
    finally:
        warnings.showwarning = before


def _parser(
    arguments: Sequence[str],
) -> tuple[argparse.ArgumentParser, str | None]:
    """Builds the parser; returns it with the name of the chosen command.

    Only the chosen command gets its arguments, because only its module is imported. The
    name is None if there is no such command.
    """
    chosen = next((word for word in arguments if not word.startswith("-")), None)
    known = chosen if chosen in COMMANDS else None
    parser = _parser_of([] if known is None else [known])
    if chosen and known is None and chosen == arguments[0]:
        nearest = difflib.get_close_matches(chosen, COMMANDS, 1)
        meant = f"it must be one of {', '.join(COMMANDS)}"
        if nearest:
            meant = f"did you mean {nearest[0]!r}?"
        parser.error(f"there is no command {chosen!r}: {meant}")
    return parser, known


def whole_parser() -> argparse.ArgumentParser:
    """Returns a parser with the arguments of every command that is installed."""
    installed = []
    for name in COMMANDS:
        with suppress(NoCheckoutError):
            module_of(name)
            installed.append(name)
    return _parser_of(installed)


def _parser_of(described: Collection[str]) -> argparse.ArgumentParser:
    """Builds the parser; only the commands in `described` get their arguments."""
    parser = argparse.ArgumentParser(
        prog="jaxrod",
        description="Soft, slender rods on JAX: simulate, differentiate, train.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--version", action="version", version=f"jaxrod {jaxrod.__version__}"
    )
    commands = parser.add_subparsers(
        title="commands", metavar="COMMAND", required=True, dest="command"
    )
    for name, summary in COMMANDS.items():
        subparser = commands.add_parser(
            name, help=summary, formatter_class=argparse.RawDescriptionHelpFormatter
        )
        if name in described:
            module = module_of(name)
            subparser.description = (module.__doc__ or summary).strip()
            module.add_arguments(subparser)
            subparser.set_defaults(run=module.run)
    return parser


def module_of(command: str) -> ModuleType:
    """Imports the module of a command.

    Raises:
        NoCheckoutError: The command needs a checkout, and there is none.
    """
    if command in PROGRAMS:
        return _program(command)
    return importlib.import_module(f"jaxrod.cli.{command}")


def _program(command: str) -> ModuleType:
    """Imports the module of a command in the checkout that contains the package."""
    root = Path(jaxrod.__file__).resolve().parents[1]
    name = PROGRAMS[command]
    if not root.joinpath(*name.split(".")).with_suffix(".py").is_file():
        raise NoCheckoutError(
            f"`jaxrod {command}` is a program of the folder benchmarks/ of jaxrod's "
            "repository, which is not installed: clone the repository, and run "
            "`pip install -e .` in it"
        )
    package, _, _ = name.partition(".")
    if package not in sys.modules:
        # Imported by its path: the current folder may have its own `benchmarks`.
        place = root / package / "__init__.py"
        spec = importlib.util.spec_from_file_location(package, place)
        assert spec is not None and spec.loader is not None
        sys.modules[package] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[package])
    return importlib.import_module(name)


def _sentence(error: ValueError | OSError | ImportError) -> str:
    """Error message for the user, naming the file or package concerned."""
    if isinstance(error, ModuleNotFoundError) and error.name:
        package = error.name.partition(".")[0]
        if package in EXTRAS:
            return (
                f"{package} is needed and not installed. Install it with: "
                f'pip install "jaxrod[{EXTRAS[package]}]"'
            )
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return str(error)

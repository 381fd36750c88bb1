"""Print a completion script for bash or zsh.

With it the Tab key completes commands, options, tasks, algorithms and files. The script
describes the installed version, so write it again after an update.
"""

from __future__ import annotations

import argparse
import errno
import os

from jaxrod.cli import settings
from jaxrod.files import write_atomically

EXAMPLES = """\
examples:
  jaxrod completion bash > ~/.local/share/bash-completion/completions/jaxrod
  jaxrod completion zsh > ~/.zfunc/_jaxrod       with ~/.zfunc in fpath
  jaxrod completion bash --out jaxrod.sh         then: source jaxrod.sh
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of `jaxrod completion`."""
    parser.epilog = EXAMPLES
    parser.add_argument("shell", choices=["bash", "zsh"], help="shell to complete in")
    parser.add_argument(
        "--out",
        type=settings.path,
        metavar="FILE",
        help="new file to write (default: standard output)",
    )


def run(args: argparse.Namespace) -> int:
    """Prints or writes the script."""
    import shtab

    from jaxrod.cli import whole_parser
    from jaxrod.envs import names
    from jaxrod.training import algorithm_names

    if args.out is not None and args.out.exists():
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(args.out))
    tasks, algorithms = names(), algorithm_names()
    choices = {
        "task": tasks,
        "tasks": tasks,
        "algorithm": algorithms,
        "algorithms": algorithms,
    }
    parser = whole_parser()
    for action in _actions(parser):
        # Tasks and learners of the user's own are not known here.
        if action.dest in choices and action.choices is None:
            action.choices = choices[action.dest]
        if action.type is settings.path:
            # An attribute that shtab reads and argparse does not declare.
            action.complete = shtab.FILE  # type: ignore[attr-defined]
        if args.shell == "zsh" and ":" in (action.metavar or ""):
            # A colon would end the name of the value (HOST:PORT).
            action.metavar = str(action.metavar).replace(":", "\\:")
    script = shtab.complete(parser, shell=args.shell)
    # In zsh, shtab completes only the first of several words: "*" is for all.
    script = script.replace('"(*):', '"*:')
    if args.out is None:
        print(script)
        return 0
    write_atomically(args.out, script.encode())
    return 0


def _actions(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    """All arguments of a parser and of its commands."""
    found = list(parser._actions)
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            found += [a for sub in action.choices.values() for a in sub._actions]
    return found

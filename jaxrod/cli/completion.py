"""Print a completion script for bash or zsh.

With it the Tab key completes commands, options, tasks, algorithms and files. The script
describes the installed version, so write it again after an update.
"""

from __future__ import annotations

import argparse

from jaxrod.cli import settings

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

    words = {"task": names(), "algorithm": algorithm_names()}
    words |= {f"{name}s": known for name, known in words.items()}
    parser = whole_parser()
    for action in _actions(parser):
        # Imports of a user's own tasks and learners are words too, but not known.
        if action.dest in words and action.choices is None:
            action.choices = words[action.dest]
        if action.type is settings.path:
            action.complete = shtab.FILE  # type: ignore[attr-defined]
    script = shtab.complete(parser, shell=args.shell)
    if args.out is None:
        print(script)
        return 0
    with args.out.open("x") as file:
        file.write(script)
    return 0


def _actions(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    """All arguments of a parser and of its commands."""
    found = list(parser._actions)
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            found += [a for sub in action.choices.values() for a in sub._actions]
    return found

"""Every command explains itself with examples that it understands."""

import argparse
import re
import shlex
from pathlib import Path

import pytest

from jaxrod import cli

NAMES = list(cli.COMMANDS)


@pytest.mark.parametrize("name", NAMES)
def test_help_explains_and_gives_examples(name, run):
    code, out, err = run(name, "--help")
    assert (code, err) == (0, "")
    assert "examples:" in out
    assert cli.module_of(name).__doc__.splitlines()[0] in out


@pytest.mark.parametrize("name", NAMES)
def test_the_examples_parse(name):
    module = cli.module_of(name)
    examples = [
        line.partition("jaxrod ")[2].partition("   ")[0].partition(" >")[0]
        for line in module.EXAMPLES.splitlines()
        if f"jaxrod {name}" in line
    ]
    assert len(examples) >= 3
    for example in examples:
        words = shlex.split(example)
        cli._parser(words)[0].parse_args(words)


PAGE = Path(__file__).parents[2] / "docs" / "commands.md"
TABLES = dict(re.findall(r"### `jaxrod (\w+)`\n\n((?:\|.*\n)+)", PAGE.read_text()))


def rows(name, options):
    """Rows of a table of options, in the words of `--help`."""
    parser = cli._parser([name])[0]
    (commands,) = (a for a in parser._actions if a.dest == "command")
    known, words = (
        commands.choices[name]._option_string_actions,
        argparse.HelpFormatter(""),
    )
    for option in options:
        action = known[option]
        usual = words._get_default_metavar_for_optional(action)
        typed = f"{option} {words._format_args(action, usual)}".strip()
        yield f"| `{typed}` | {action.help} |"


@pytest.mark.parametrize("name", TABLES)
def test_the_page_of_commands_says_what_help_says(name):
    head = "| option | meaning |\n|---|---|\n"
    table = re.sub(r"\[([^\]]+)\]\([^)]+\)", r"\1", TABLES[name])
    options = re.findall(r"^\| `(--[\w-]+)", table, re.MULTILINE)
    assert len(options) >= 3
    assert table == head + "".join(f"{row}\n" for row in rows(name, options))


def test_the_page_of_commands_has_tables():
    assert {"train", "evaluate", "render", "export", "sweep"} <= set(TABLES)
    assert set(re.findall(r"^\| `jaxrod (\w+)", PAGE.read_text(), re.M)) == set(NAMES)

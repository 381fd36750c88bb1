"""Every command explains itself with examples that it understands."""

import shlex

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

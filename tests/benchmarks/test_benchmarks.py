"""`python -m benchmarks`: a folder for each, and documents name what is there."""

import argparse
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import __main__ as benchmarks
from benchmarks.training import run as training

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "benchmarks"
SHARED = "shared"
"""The folder that is no benchmark."""
COMMAND = re.compile(r"python3?\s+-m\s+benchmarks(?: |\s*\n\s*)?(?! )([^`\n]*)")
SCRIPT = re.compile(r"python3?\s+benchmarks/[\w/]+(?:\.py)?")
PATH = re.compile(r"\bbenchmarks/[\w./-]*")
OUTPUT = re.compile(r"--out\s+benchmarks/\S*")
"""A folder that a command makes need not be there."""


def documents():
    """Texts that people read: pages, notebooks, and texts of programs and tests."""
    ours = ["*.md", "docs/*.md", "notebooks/*.ipynb", "tests/extremes/*.md"]
    ours += ["benchmarks/*.md", "benchmarks/*/*.md", "benchmarks/*/*.py"]
    ours += ["benchmarks/mujoco_rods/records/*.md", "examples/*.py"]
    return [page for pattern in ours for page in sorted(ROOT.glob(pattern))]


def missing(text):
    """Commands and paths of a text that are not there."""
    # A command may be broken over two lines of a paragraph.
    for found in COMMAND.finditer(text):
        name, *_ = [*re.split(r"[^\w.]", found[1].strip()), ""]
        if name and name != "NAME" and name not in benchmarks.names():
            yield f"python -m benchmarks {name}"
    for found in SCRIPT.finditer(text):
        yield found[0]
    for found in PATH.finditer(OUTPUT.sub("", text)):
        path = found[0].rstrip(".")
        # Tables of contents leave the suffix out.
        places = (ROOT / path, ROOT / f"{path}.md", ROOT / "tests" / path)
        if not any(place.exists() for place in places):
            yield path


def calls(text):
    """Commands whose arguments stand for nothing else, so that they can be parsed."""
    for found in COMMAND.finditer(text):
        line = re.split(r"  +|\)|\.\.\.|[,;]", found[1])[0].strip()
        if " " in line and not re.search(r"[\[\]{}|<]|[A-Z]{2}|\bS\b|\\$", line):
            yield shlex.split(line, comments=True)


def test_what_documents_name_is_there():
    found = {page: list(missing(page.read_text())) for page in documents()}
    assert len(found) > 150
    assert {str(page): names for page, names in found.items() if names} == {}


def test_wrong_names_are_seen():
    text = """`python -m
    benchmarks lane speed`, `python -m benchmarks.lanes`, `python benchmarks/costs.py`,
    [these](../benchmarks/lanes/record.md), benchmarks/costs/run.py. `python -m
    benchmarks lanes` and `python -m benchmarks NAME --out benchmarks/lanes/mine`"""
    assert list(missing(text)) == [
        "python -m benchmarks lane",
        "python -m benchmarks .lanes",
        "python benchmarks/costs.py",
        "benchmarks/costs.py",
        "benchmarks/lanes/record.md",
    ]


def test_documented_calls_are_understood(capsys):
    pages = [page.read_text() for page in documents() if page.suffix == ".md"]
    known = {tuple(call) for page in pages for call in calls(page)}
    assert len(known) > 25
    wrong = []
    for name, *words in sorted(known):
        try:
            benchmarks.parser_of(name).parse_args(words)
        except SystemExit as stopped:
            if stopped.code:
                wrong.append((name, *words, capsys.readouterr().err.splitlines()[-1]))
    assert wrong == []


def test_every_folder_is_a_benchmark_and_is_listed(capsys):
    folders = {path.name for path in FOLDER.iterdir() if any(path.glob("[!_]*"))}
    assert folders - {SHARED} == set(benchmarks.names())
    assert benchmarks.main([]) == 0
    _, _, *lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == benchmarks.names()
    for line in lines:
        assert len(line.split()) > 3 and line.endswith(".") and len(line) < 100


@pytest.mark.parametrize("name", benchmarks.names())
def test_a_benchmark_can_be_imported_and_takes_arguments(name, capsys):
    with pytest.raises(SystemExit) as ended:
        benchmarks.parser_of(name).parse_args(["--help"])
    assert ended.value.code == 0
    assert f"python -m benchmarks {name}" in capsys.readouterr().out


@pytest.mark.parametrize("name", benchmarks.names())
def test_a_readme_has_the_question_and_the_command(name):
    text = (FOLDER / name / "README.md").read_text()
    assert f"python -m benchmarks {name}" in text
    assert "?" in text and "**Writes**" in text and "**Takes**" in text
    assert f"({name}/README.md)" in (FOLDER / "README.md").read_text()


def test_a_wrong_name_is_answered_with_the_nearest():
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks", "lane"],
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert "no benchmark 'lane'; the nearest name is 'lanes'" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("task", training.TASKS)
def test_training_repeats_the_recorded_runs(task):
    from jaxrod.cli import train

    parser = argparse.ArgumentParser()
    train.add_arguments(parser)
    for words in training.commands(task, [], training.RECORDS):
        args = parser.parse_args(words[1:])
        config = json.loads((args.out / "config.json").read_text())
        for name in ("task", "steps", "seed"):
            assert getattr(args, name) == config[name]
        assert (args.variant or "clean") == config["variant"]
        assert (args.algorithm or "ppo") == config["algorithm"]
        for setting, _, value in (word.partition("=") for word in args.set):
            assert config["settings"][setting] == json.loads(value)

"""Docstrings and the strings under fields keep the rules of `plain_english.toml`."""

import ast
import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
RULES = tomllib.loads((ROOT / "tests" / "plain_english.toml").read_text())
OPENING = re.compile(rf"\s*({'|'.join(RULES['openings'])})\b")
WORD = re.compile(
    "|".join(rf"\b{word}\b".replace(" ", r"\s+") for word in RULES["words"])
)
FOLDERS = ("jaxrod", "envs", "training")


def strings(source):
    """Lines and texts of all strings that are statements of their own."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            if isinstance(node.value.value, str):
                yield node.lineno, node.value.value


def entries(text):
    """The text, and the entries of its `Args:`, without their names."""
    yield text
    yield from re.findall(r"^ +[a-z_*]+(?: \(.*?\))?: (\S.*)$", text, re.MULTILINE)


def faults(source):
    """Lines and what is wrong there."""
    for line, text in strings(source):
        for entry in entries(text):
            if found := OPENING.match(entry):
                yield line, f"begins with {found[1]!r}: {entry.split(chr(10))[0]!r}"
        for found in WORD.finditer(text):
            yield line, f"{found[0]!r}"


@pytest.mark.parametrize("folder", FOLDERS)
def test_docstrings_are_in_plain_english(folder):
    found = [
        f"{path.relative_to(ROOT)}:{line}: {what}"
        for path in sorted((ROOT / folder).rglob("*.py"))
        for line, what in faults(path.read_text())
    ]
    assert not found, "\n".join(found)


def test_faults_are_seen():
    source = '''
class Pair:
    """Two rods that are told of anew."""

    radius: float
    """Of the first [m]."""

    def force(self, k):
        """Force of a pair.

        Args:
            k: Which pair.
        """
'''
    assert [what.split(":")[0] for _, what in faults(source)] == [
        "'told of'",
        "'anew'",
        "begins with 'Of'",
        "begins with 'Which'",
    ]

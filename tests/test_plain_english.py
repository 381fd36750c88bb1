"""Rules of `plain_english.toml`, applied to everything that users read."""

import ast
import re
import tomllib
from pathlib import Path
from statistics import median

import pytest

import prose

ROOT = Path(__file__).resolve().parent.parent
RULES = tomllib.loads((ROOT / "tests" / "plain_english.toml").read_text())
OPENING = re.compile(rf"\s*({'|'.join(RULES['openings'])})\b")
WORD = re.compile(
    "|".join(rf"\b{word}\b".replace(" ", r"\s+") for word in RULES["words"]),
    re.IGNORECASE,
)
FOLDERS = ("jaxrod", "envs", "training", "examples", "benchmarks")
PAGES = (
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "benchmarks/README.md")),
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "notebooks").glob("*.ipynb")),
)
STATEMENTS = (ast.stmt, ast.excepthandler, ast.match_case)


def texts(source):
    """Lines, texts, and whether they document: docstrings, messages and help texts."""
    # Help texts lie in expressions, all others in statements, which are far fewer.
    inside = ast.AST if "help=" in source else STATEMENTS
    nodes = [ast.parse(source)]
    for node in nodes:
        match node:
            case ast.Expr(ast.Constant(str(text))):
                yield node.lineno, text, True
            case ast.Raise(exc=ast.expr() as error):
                yield node.lineno, text_of(error), False
            case ast.keyword(arg="help" | "description" | "epilog"):
                yield node.value.lineno, text_of(node.value), False
        nodes += [n for n in ast.iter_child_nodes(node) if isinstance(n, inside)]


def text_of(node):
    """The text of the strings in an expression."""
    parts = [part.value for part in ast.walk(node) if isinstance(part, ast.Constant)]
    return " ".join(part for part in parts if isinstance(part, str))


def entries(text):
    """The text, and the entries of its `Args:`, without their names."""
    yield text
    yield from re.findall(r"^ +[a-z_*]+(?: \(.*?\))?: (\S.*)$", text, re.MULTILINE)


def faults(source):
    """Lines and what is wrong there, in Python."""
    for line, text, documents in texts(source):
        for entry in entries(text) if documents else ():
            if found := OPENING.match(entry):
                yield line, f"begins with {found[1]!r}: {entry.split(chr(10))[0]!r}"
        for found in WORD.finditer(text):
            yield line, f"{found[0]!r}"


def faults_of_page(page):
    """Lines and what is wrong there, in Markdown."""
    lengths = []
    for line, paragraph in prose.paragraphs(page):
        for found in WORD.finditer(paragraph):
            yield line, f"{found[0]!r}"
        for sentence in prose.sentences(paragraph):
            lengths.append(prose.length(sentence))
            if lengths[-1] > RULES["sentences"]["longest"]:
                yield line, f"{lengths[-1]} words: {sentence[:60]!r}"
            if sentence.startswith("What ") and not sentence.endswith("?"):
                yield line, f"begins with 'What': {sentence[:60]!r}"
    if lengths and median(lengths) > RULES["sentences"]["median"]:
        yield 1, f"half of the sentences have {median(lengths)} words or more"


@pytest.mark.parametrize("folder", FOLDERS)
def test_python_is_in_plain_english(folder):
    found = [
        f"{path.relative_to(ROOT)}:{line}: {what}"
        for path in sorted((ROOT / folder).rglob("*.py"))
        for line, what in faults(path.read_text())
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_pages_are_in_plain_english(page):
    found = [
        f"{page.name}:{line}: {what}"
        for line, what in faults_of_page(prose.markdown(page))
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
        parser.add_argument("--pair", help="likewise")
        raise ValueError(f"{k} is no pair, "
            "which nobody is told")
'''
    assert sorted(what.split(":")[0] for _, what in faults(source)) == [
        "'anew'",
        "'are told'",
        "'is told'",
        "'likewise'",
        "begins with 'Of'",
        "begins with 'Which'",
    ]


def test_faults_of_pages_are_seen():
    page = """# A heading anew

What is left is *likewise* in [a
link](page.md#besides). What is it?

- `besides`, 1.5 times, e.g. a list
  that earns a fault.

| a table | anew |
|---|---|

```text
anew
```
"""
    assert list(faults_of_page(page)) == [
        (3, "'likewise'"),
        (3, "begins with 'What': 'What is left is *likewise* in a link.'"),
        (6, "'earns'"),
    ]
    long = " ".join(["word"] * 46) + "."
    assert list(faults_of_page(f"{long} Short. Short. Shorter {long}"[:-1])) == [
        (1, f"46 words: {long[:60]!r}"),
        (1, f"47 words: {'Shorter ' + long[:52]!r}"),
        (1, "half of the sentences have 23.5 words or more"),
    ]

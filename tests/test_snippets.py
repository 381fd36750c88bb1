"""The Python that README and docs print runs as printed, and prints what they say."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

# `run_json` and `run`, which it takes, are fixtures: tests name them as arguments.
from commands import run, run_json  # noqa: F401

ROOT = Path(__file__).parents[1]
# The gallery shows lines of the examples; tests/examples/test_gallery.py compares them.
PAGES = [
    ROOT / "README.md",
    *(page for page in sorted((ROOT / "docs").glob("*.md")) if page.stem != "gallery"),
]
BLOCK = re.compile(r"^```python\n(.*?)^```\n+(?:prints `([^`]*)`)?", re.S | re.M)


def programs(page):
    """A page's blocks: README's are one program, those of other pages one each."""
    blocks = BLOCK.findall(page.read_text())
    if page.name == "README.md":
        return [("\n\n".join(code for code, _ in blocks), "")] if blocks else []
    return blocks


def printed_by(program, tmp_path):
    # Compiling is most of it, and twice as fast without LLVM's optimisations.
    environment = {**os.environ, "XLA_FLAGS": "--xla_backend_optimization_level=0"}
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=environment,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def test_no_program_is_left_out():
    fences = re.compile(r"^\s*(?:```|~~~)\s*\{?(?:i?py|code)", re.M)
    pages = [ROOT / "CONTRIBUTING.md", *(ROOT / "benchmarks").rglob("*.md"), *PAGES]
    left_out = {}
    for page in pages:
        executed = len(BLOCK.findall(page.read_text())) if page in PAGES else 0
        left_out[str(page)] = len(fences.findall(page.read_text())) - executed
    assert not {name: count for name, count in left_out.items() if count}


def test_readme_prints_what_it_says(tmp_path):
    ((program, _),) = programs(PAGES[0])
    said = re.findall(r"^```text\n(.*?)^```", PAGES[0].read_text(), re.S | re.M)
    number = re.compile(r"-?\d+\.\d*(?:e[-+]\d+)?")
    expected = [float(x) for x in number.findall("".join(said))]
    out = printed_by(program, tmp_path)
    printed = [float(x) for x in number.findall(out)]
    assert len(expected) == 6
    assert out.splitlines()[-1] == said[-1].splitlines()[-1] == "()"
    assert printed == pytest.approx(expected, rel=1e-3)


TASK = ROOT / "docs" / "extending.md"


def own_task(page):
    """The program `reach.py` of a page."""
    (program,) = (
        code for code in re.findall(BLOCK, page.read_text()) if "class Reach" in code[0]
    )
    return program[0]


def test_readme_and_docs_show_the_same_task():
    assert own_task(PAGES[0]) == own_task(TASK)
    lines = [line for line in own_task(TASK).splitlines() if line]
    assert len(lines) <= 20


# The argument is the fixture imported above.
@pytest.mark.slow
@pytest.mark.default_precision
def test_the_task_of_the_readme_learns_what_is_said(tmp_path, run_json, monkeypatch):  # noqa: F811
    monkeypatch.chdir(tmp_path)
    Path("reach.py").write_text(own_task(PAGES[0]))
    words = re.search(r"^jaxrod (train reach.py.*)", PAGES[0].read_text(), re.M)[1]
    found = run_json(*words.split(), "--json")
    words = " ".join(PAGES[0].read_text().split())
    pattern = r"episodes from (-[\d.]+) to (-[\d.]+)\. Without .* it is (-[\d.]+), and"
    first, final, said = map(float, re.search(pattern, words).groups())
    assert found["first_score"] == pytest.approx(first, abs=0.7)
    assert found["final_score"] == pytest.approx(final, abs=0.15)
    assert found["evaluation_score"] == pytest.approx(said, abs=0.15)
    assert Path("runs/reach/replay.html").exists()
    trust = ("--trust", "reach.py")
    assert run_json("evaluate", "runs/reach", "--json", *trust)["score"] > 1.2 * said


@pytest.mark.slow
@pytest.mark.parametrize(
    ("program", "says"),
    [
        pytest.param(*pair, id=f"{page.name}-{k}")
        for page in PAGES[1:]
        for k, pair in enumerate(programs(page))
    ],
)
def test_pages_run_as_printed(program, says, tmp_path):
    printed = printed_by(program, tmp_path)
    if says:
        assert printed.splitlines()[-1] == says

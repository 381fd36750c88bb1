"""The page of supported versions says what the code, the pins and the programs say."""

import re
import tomllib
from pathlib import Path

import pytest

from jaxrod.installation import jax_version

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs/supported_versions.md").read_text()
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
FAULTS = ROOT / "benchmarks/jax_faults"
PROGRAMS = sorted(set(FAULTS.glob("*.py")) - {FAULTS / "run.py"})


def table(heading):
    """Cells of the first table under a heading, without its head."""
    rows = re.search(rf"^## {heading}\n.*?((?:^\|[^\n]*\n)+)", PAGE, re.S | re.M)[1]
    return [
        [cell.strip() for cell in row.strip("|").split("|")]
        for row in rows.splitlines()[2:]
    ]


def number(version):
    return tuple(map(int, version.split(".")))


def pins(name):
    """Version that constraints.txt pins, for Python 3.11 and for newer ones."""
    found = re.findall(
        rf"^{name}==([\d.]+)(?: ; python_version (<|>=) .*)?$",
        (ROOT / "constraints.txt").read_text(),
        re.M,
    )
    old = next(version for version, side in found if side != ">=")
    new = next(version for version, side in found if side != "<")
    return old, new


def test_page_refuses_the_releases_that_the_code_and_the_requirements_refuse():
    refused = {number(row[0]) for row in table("Refused releases of JAX")}
    assert refused == set(jax_version.UNSOUND)
    (need,) = (line for line in PROJECT["dependencies"] if line.startswith("jax>"))
    assert refused == {number(version) for version in re.findall(r"!=([\d.]+)", need)}


def test_constraints_pin_no_refused_release():
    for package in ("jax", "jaxlib"):
        for version in pins(package):
            assert jax_version.fault(package, version) is None


def test_page_lists_the_pythons_of_the_classifiers_with_what_is_pinned():
    rows = {row[0]: row[2] for row in table("Python and JAX")}
    kind = "Programming Language :: Python :: 3."
    classifiers = [line for line in PROJECT["classifiers"] if line.startswith(kind)]
    assert list(rows) == [line.rpartition(" ")[2] for line in classifiers]
    assert PROJECT["requires-python"] == f">={next(iter(rows))}"
    for python, said in rows.items():
        jax, numpy, flax = (
            pins(name)[python != "3.11"] for name in ("jax", "numpy", "flax")
        )
        assert said == f"JAX {jax}, NumPy {numpy}, flax {flax}"


@pytest.mark.parametrize(
    ("package", "row"),
    [
        ("optax", "optax"),
        ("gymnasium", "Gymnasium"),
        ("brax", "brax"),
        ("stable_baselines3", "Stable Baselines 3 and sb3-contrib"),
        ("sb3_contrib", "Stable Baselines 3 and sb3-contrib"),
        ("torch", "PyTorch"),
        ("llvmlite", "llvmlite"),
        ("trimesh", "trimesh"),
        ("rosbags", "rosbags"),
        ("ray", "Ray"),
    ],
)
def test_page_names_the_pinned_release_of_an_optional_package(package, row):
    said = {name: pinned for _, name, pinned, *_ in table("Optional packages")}
    assert pins(package) == (said[row],) * 2


@pytest.mark.parametrize("program", PROGRAMS, ids=lambda program: program.stem)
def test_page_prints_the_programs_as_they_are(program):
    _, code = program.read_text().split('"""\n\n', 1)
    assert f"```python\n{code}```" in PAGE


def test_every_program_stands_for_a_refused_release():
    shown = {row[3].strip("`") for row in table("Refused releases of JAX")}
    assert {program.name for program in PROGRAMS} <= shown

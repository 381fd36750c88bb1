"""What is installed, under which names, and what importing it loads."""

import json
import os
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
RECIPE = (ROOT / "conda" / "meta.yaml").read_text()
FOLDERS = PROJECT["tool"]["setuptools"]["package-dir"]


def import_name(folder: Path) -> str:
    """The import name of a folder of the repository."""
    parts = folder.relative_to(ROOT).parts
    for name, top in FOLDERS.items():
        if parts[0] == top:
            return ".".join((name, *parts[1:]))
    raise AssertionError(f"{folder} belongs to no package")


def files() -> list[Path]:
    """Everything that belongs in the wheel."""
    return [
        file
        for top in FOLDERS.values()
        for file in sorted((ROOT / top).rglob("*"))
        if file.is_file() and "__pycache__" not in file.parts
    ]


def test_every_folder_with_files_is_installed():
    folders = {import_name(file.parent) for file in files()}
    assert folders == set(PROJECT["tool"]["setuptools"]["packages"])


def test_core_depends_on_jax_numpy_and_jaxtyping_alone():
    names = {
        re.split(r"[^\w-]", need)[0] for need in PROJECT["project"]["dependencies"]
    }
    assert names == {"jax", "numpy", "jaxtyping"}


def test_requirements_and_run_time_refuse_the_same_releases():
    from jaxrod.installation import jax_version

    (need,) = (n for n in PROJECT["project"]["dependencies"] if n.startswith("jax>"))
    refused = {
        tuple(map(int, number.split("."))) for number in re.findall(r"!=([\d.]+)", need)
    }
    assert refused == set(jax_version.UNSOUND)
    assert f">={'.'.join(map(str, jax_version.OLDEST))}" in need
    assert need in jax_version.remedy()
    extras = PROJECT["project"]["optional-dependencies"]
    for name in ("cuda12", "cuda13"):
        assert extras[name] == [need.replace("jax>", f"jax[{name}]>")]
        assert name not in extras["all"][0]


def test_all_places_name_the_same_version():
    from jaxrod import __version__

    changes = (ROOT / "CHANGELOG.md").read_text()
    places = {
        "pyproject.toml": PROJECT["project"]["version"],
        "CITATION.cff": re.search(
            r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE
        )[1],
        "CHANGELOG.md": re.search(r"^## ([\d.]+)", changes, re.MULTILINE)[1],
        "conda/meta.yaml": re.search(r'version: "(.*)"', RECIPE)[1],
    }
    assert places == dict.fromkeys(places, __version__)


def test_classifiers_name_the_supported_pythons():
    named = set(
        re.findall(r"Python :: (3\.\d+)", str(PROJECT["project"]["classifiers"]))
    )
    assert named == {"3.11", "3.12", "3.13"}
    assert PROJECT["project"]["requires-python"] == ">=3.11"


def test_the_conda_recipe_needs_what_the_wheel_needs():
    run = RECIPE.partition("  run:\n")[2].partition("\n\n")[0]
    needs = [line.strip(" -").replace(" ", "") for line in run.splitlines()]
    python = f"python{PROJECT['project']['requires-python']}"
    assert needs == [python, *PROJECT["project"]["dependencies"]]
    (script,) = PROJECT["project"]["scripts"].items()
    assert " = ".join(script) in RECIPE


def test_constraints_pin_one_version_for_each_supported_python():
    pins: dict[str, list[str]] = {}
    for line in (ROOT / "constraints.txt").read_text().splitlines():
        if not line.startswith("#"):
            match = re.fullmatch(
                r'([\w.-]+)==[\w.]+( ; python_version (<|>=) "3\.12")?', line
            )
            assert match, line
            pins.setdefault(match[1].lower(), []).append(match[3] or "all")
    for name, scopes in pins.items():
        assert scopes in (["all"], ["<", ">="], [">="], ["<"]), name
    assert {"jax", "jaxlib", "flax", "numpy", "pyelastica"} <= set(pins)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """A freshly built wheel."""
    out = tmp_path_factory.mktemp("wheel")
    # Built from a copy, so that nothing is left in the repository, and without an
    # isolated environment, so that nothing is downloaded.
    source = out / "source"
    alone = [ROOT / name for name in ("pyproject.toml", "README.md", "LICENSE")]
    for file in files() + alone:
        copy = source / file.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(file.read_bytes())
    program = (
        f"from setuptools import build_meta\nbuild_meta.build_wheel({str(out)!r})\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=source, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    (built,) = out.glob("*.whl")
    with zipfile.ZipFile(built) as archive:
        yield archive


def test_wheel_installs_one_top_level_name(wheel):
    tops = {name.partition("/")[0] for name in wheel.namelist()}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"jaxrod"}


def test_wheel_holds_every_file_of_the_packages(wheel):
    expected = {
        f"{import_name(file.parent).replace('.', '/')}/{file.name}" for file in files()
    }
    missing = expected - set(wheel.namelist())
    assert not missing


@pytest.mark.slow
def test_a_wheel_of_the_source_distribution_is_that_of_the_checkout(wheel, tmp_path):
    """Built from committed files, in a copy, without anything from the network."""
    source, out = tmp_path / "source", tmp_path / "out"
    tracked = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    for name in filter(None, tracked.stdout.split("\0")):
        if (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())

    def build(kind, folder):
        program = (
            f"from setuptools import build_meta as b\nb.build_{kind}({str(out)!r})"
        )
        command = [sys.executable, "-c", program]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr

    build("sdist", source)
    (packed,) = out.glob("*.tar.gz")
    with tarfile.open(packed) as archive:
        archive.extractall(tmp_path / "unpacked", filter="data")
    (unpacked,) = (tmp_path / "unpacked").iterdir()
    build("wheel", unpacked)
    (again,) = out.glob("*.whl")
    with zipfile.ZipFile(again) as archive:
        assert set(archive.namelist()) == set(wheel.namelist())


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("command", ["reproduce", "tradeoff", "benchmark"])
def test_wheel_says_where_the_programs_of_a_checkout_are(command, wheel, tmp_path):
    wheel.extractall(tmp_path / "site")
    # Somebody's own are not taken for ours.
    (tmp_path / "benchmarks" / "paper").mkdir(parents=True)
    for words in ([], ["--dry-run", "--json"], ["--help"]):
        done = subprocess.run(
            [sys.executable, "-m", "jaxrod", command, *words],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(tmp_path / "site")},
            capture_output=True,
            text=True,
        )
        assert (done.returncode, done.stdout) == (1, "")
        assert f"`jaxrod {command}` is a program of the folder benchmarks/" in (
            done.stderr
        )
        assert done.stderr.count("\n") == 1


@pytest.mark.slow
def test_importing_jaxrod_loads_only_what_jax_numpy_and_jaxtyping_load():
    loaded = modules_after("import jax, numpy, jaxtyping")
    with_jaxrod = modules_after("import jax, numpy, jaxtyping, jaxrod")
    assert with_jaxrod - loaded == {"jaxrod"}


@pytest.mark.slow
def test_importing_the_tasks_needs_no_optional_package():
    assert not modules_after("import jaxrod.envs") & {
        "brax", "flax", "gymnasium", "matplotlib", "optax", "orbax",
        "sb3_contrib", "stable_baselines3", "torch",
    }  # fmt: skip


def modules_after(statement: str) -> set[str]:
    """The top-level modules that a statement loads, the standard library left out."""
    program = f"{statement}\nimport json, sys\nprint(json.dumps(sorted(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    tops = {name.partition(".")[0] for name in json.loads(done.stdout)}
    return {t for t in tops - sys.stdlib_module_names if not t.startswith("_")}


@pytest.mark.parametrize("name", ["envs", "training"])
def test_the_bare_names_say_what_to_import_instead(name):
    done = subprocess.run(
        [sys.executable, "-c", f"import {name}"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode != 0
    assert f"jaxrod.{name}" in done.stderr.splitlines()[-1]

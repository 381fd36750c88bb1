"""`import jaxrod` is instant, and every name it promises is there when asked for."""

import collections
import importlib
import inspect
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest

import jaxrod
from public_names import NAMESPACES

ROOT = Path(__file__).parents[1]

# Stands in for an environment with a release of jax that is refused.
REFUSED_JAX = """
from importlib import metadata
real = metadata.version
metadata.version = lambda name: "0.10.2" if name in ("jax", "jaxlib") else real(name)
"""


def python(program, *words):
    """Runs a program in a fresh interpreter."""
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", program, *words],
        capture_output=True,
        text=True,
    )


@pytest.mark.parametrize("name", jaxrod.__all__)
def test_every_name_resolves_to_what_its_module_defines(name):
    module = importlib.import_module(jaxrod._MODULE_OF[name])
    assert getattr(jaxrod, name) is getattr(module, name)
    assert getattr(jaxrod, name).__module__ == module.__name__
    assert name in dir(jaxrod)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("name", sorted(jaxrod._NAMESPACES))
def test_namespaces_are_attributes_of_a_plain_import(name):
    done = python(f"import jaxrod; print(jaxrod.{name}.__name__)")
    assert done.stdout.strip() == f"jaxrod.{name}", done.stderr


def test_no_name_is_in_two_namespaces():
    """`jaxrod.extend` may repeat: it lists what a subclass needs in one place."""
    places = collections.Counter(name for space in NAMESPACES for name in space.__all__)
    assert {name for name, count in places.items() if count > 1} == set()


def test_the_names_of_the_root_are_few_and_each_is_shown_to_users():
    """In a page or an example; the reference lists all names anyway."""
    assert len(jaxrod.__all__) <= 100
    shown = [*ROOT.glob("docs/*.md"), *ROOT.glob("examples/*.py"), ROOT / "README.md"]
    text = "\n".join(file.read_text() for file in shown)
    words = set(re.findall(r"\w+", text))
    assert set(jaxrod.__all__) - words == set()


def test_no_name_is_also_a_module():
    """Importing such a module would put it in the place of what was promised."""
    for space in NAMESPACES:
        paths = getattr(space, "__path__", [])
        modules = {module.name for module in pkgutil.iter_modules(paths)}
        assert not modules & set(space.__all__), space.__name__


def test_star_import_and_help_see_every_name():
    namespace: dict[str, object] = {}
    exec("from jaxrod import *", namespace)
    assert set(jaxrod.__all__) <= set(namespace)
    assert set(jaxrod.__all__) <= {name for name, _ in inspect.getmembers(jaxrod)}


def test_unknown_names_are_attribute_and_import_errors():
    with pytest.raises(AttributeError, match="no attribute 'advnace'"):
        _ = jaxrod.advnace
    with pytest.raises(ImportError, match="advnace"):
        exec("from jaxrod import advnace")


def test_a_name_of_a_namespace_is_found_by_its_message():
    with pytest.raises(AttributeError, match=r"it is jaxrod\.actuation\.muscle$"):
        _ = jaxrod.muscle
    with pytest.raises(AttributeError, match=r"it is jaxrod\.shapes\.sphere$"):
        _ = jaxrod.sphere


@pytest.mark.slow
def test_a_submodule_that_lacks_an_optional_package_is_no_attribute():
    program = (
        "import sys; sys.modules['optax'] = None\n"
        "import jaxrod, inspect\n"
        "assert not hasattr(jaxrod, 'training')\n"
        "assert len(inspect.getmembers(jaxrod)) > 40\n"
        "try: from jaxrod import training\n"
        "except ModuleNotFoundError as error:\n"
        "    assert error.name == 'optax'\n"
        "    assert 'pip install \"jaxrod[rl]\"' in str(error)\n"
        "else: raise AssertionError\n"
    )
    done = python(program)
    assert done.returncode == 0, done.stderr


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    "words", [["--help"], ["--version"], ["train", "--help"], ["benchmark", "--help"]]
)
def test_the_command_line_answers_without_loading_jax(words):
    program = (
        "import sys\n"
        "from jaxrod import cli\n"
        "try: cli.main(sys.argv[1:])\n"
        "except SystemExit as stopped: assert stopped.code == 0\n"
        "else: raise AssertionError\n"
        "assert not {'jax', 'numpy', 'matplotlib'} & set(sys.modules)\n"
    )
    done = python(program, *words)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_the_doctor_reports_on_a_jax_that_is_refused():
    program = REFUSED_JAX + (
        "import sys\nfrom jaxrod import cli\nsys.exit(cli.main(['doctor']))"
    )
    done = python(program)
    assert done.returncode == 1
    assert "WRONG  versions" in done.stdout
    assert "jax 0.10.2 is refused" in done.stdout
    assert "pip install" in done.stdout
    assert "compensated sum" in done.stdout
    assert done.stderr == ""


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    "use", ["jaxrod.advance", "jaxrod.configure_cpu", "jaxrod.envs", "jaxrod.training"]
)
def test_nothing_else_runs_on_a_jax_that_is_refused(use):
    done = python(f"{REFUSED_JAX}import jaxrod; {use}")
    assert done.returncode != 0
    assert "UnsoundJaxError: jax 0.10.2 is refused" in done.stderr

"""`import jaxrod` is instant, and every name it promises is there when asked for."""

import ast
import importlib
import inspect
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

import jaxrod

STUB = Path(jaxrod.__file__).with_suffix(".pyi")

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


def names_in_stub():
    """Every name of the stub, and the module it comes from."""
    return {
        name.asname: node.module
        for node in ast.parse(STUB.read_text()).body
        if isinstance(node, ast.ImportFrom)
        for name in node.names
    }


def test_the_stub_promises_the_same_names_from_the_same_modules():
    table = {name: f"jaxrod.{module}" for name, module in jaxrod._MODULE_OF.items()}
    submodules = {
        name: f"jaxrod.{module}".rpartition(".")[0]
        for name, module in jaxrod._SUBMODULES.items()
    }
    assert names_in_stub() == table | submodules


@pytest.mark.parametrize("name", jaxrod.__all__)
def test_every_name_resolves_to_what_its_module_defines(name):
    module = importlib.import_module(f"jaxrod.{jaxrod._MODULE_OF[name]}")
    assert getattr(jaxrod, name) is getattr(module, name)
    assert getattr(jaxrod, name).__module__ == module.__name__
    assert name in dir(jaxrod)


@pytest.mark.parametrize("name", jaxrod._SUBMODULES)
def test_submodules_are_attributes_of_a_plain_import(name):
    done = python(f"import jaxrod; print(jaxrod.{name}.__name__)")
    assert done.stdout.strip() == f"jaxrod.{jaxrod._SUBMODULES[name]}", done.stderr


def test_no_name_is_also_a_module():
    """Importing such a module would put it in the place of what was promised."""
    modules = {module.name for module in pkgutil.iter_modules(jaxrod.__path__)}
    assert not modules & set(jaxrod.__all__)


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


@pytest.mark.parametrize(
    "use", ["jaxrod.advance", "jaxrod.configure_cpu", "jaxrod.envs", "jaxrod.training"]
)
def test_nothing_else_runs_on_a_jax_that_is_refused(use):
    done = python(f"{REFUSED_JAX}import jaxrod; {use}")
    assert done.returncode != 0
    assert "UnsoundJaxError: jax 0.10.2 is refused" in done.stderr

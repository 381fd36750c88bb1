"""All examples: short, on public names alone."""

import ast
import json
import subprocess
import sys

import pytest

import jaxrod
from examples.loading import FOLDER
from public_names import NAMESPACES

PUBLIC = {
    space.__name__: space
    for space in (
        *NAMESPACES,
        jaxrod.envs,
        jaxrod.extend,
        jaxrod.training,
        jaxrod.viz,
    )
}


@pytest.mark.parametrize("file", sorted(FOLDER.glob("*.py")), ids=lambda f: f.stem)
def test_examples_are_short_and_use_public_names_only(file):
    source = file.read_text()
    longer = {"gallery": 210, "hardware_in_the_loop": 100}
    assert len(source.splitlines()) <= longer.get(file.stem, 80)
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.module.startswith("jaxrod"):
            public = {*PUBLIC[node.module].__all__}
            # Modules of public names are public themselves.
            public |= {name.rpartition(".")[2] for name in PUBLIC if "." in name}
            assert {name.name for name in node.names} <= public
        if isinstance(node, ast.Import):
            names = {n.name for n in node.names if n.name.startswith("jaxrod")}
            assert names <= set(PUBLIC)
        if isinstance(node, ast.Attribute):
            assert not node.attr.startswith("_")


RUNNABLE = [f for f in sorted(FOLDER.glob("*.py")) if "__main__" in f.read_text()]


@pytest.mark.parametrize("file", RUNNABLE, ids=lambda f: f.stem)
def test_examples_set_up_the_cpu_before_they_compute(file):
    """By themselves, or by what shows all scenes; derivatives are slow without."""
    tree = ast.parse(file.read_text())
    (main,) = [one for one in tree.body if isinstance(one, ast.If)]
    first = ast.unparse(main.body[0])
    if first == "main()":
        (function,) = [one for one in tree.body if getattr(one, "name", "") == "main"]
        first = ast.unparse(function.body[0])
    assert first == "jaxrod.configure_cpu()" or first.startswith("gallery.show(")


@pytest.mark.slow
def test_nothing_is_computed_while_examples_are_imported():
    """Else their settings of the CPU come too late, which is a warning."""
    names = ", ".join(file.stem for file in sorted(FOLDER.glob("*.py")))
    program = f"import jaxrod, {names}; gallery.jaxrod.configure_cpu(1)"
    subprocess.run(
        [sys.executable, "-W", "error::UserWarning", "-c", program],
        cwd=FOLDER,
        check=True,
    )


@pytest.mark.parametrize(
    "file", sorted((FOLDER.parent / "notebooks").glob("*.ipynb")), ids=lambda f: f.stem
)
def test_notebooks_set_up_the_cpu_in_their_first_cell(file):
    cells = json.loads(file.read_text())["cells"]
    first = next(cell for cell in cells if cell["cell_type"] == "code")
    assert "\njaxrod.configure_cpu(" in "".join(first["source"])

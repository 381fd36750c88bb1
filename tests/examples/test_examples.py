"""All examples: short, on public names alone."""

import ast

import pytest

import jaxrod
from examples.loading import FOLDER

PUBLIC = {
    "jaxrod": jaxrod,
    "jaxrod.envs": jaxrod.envs,
    "jaxrod.training": jaxrod.training,
    "jaxrod.viz": jaxrod.viz,
}


@pytest.mark.parametrize("file", sorted(FOLDER.glob("*.py")), ids=lambda f: f.stem)
def test_examples_are_short_and_use_public_names_only(file):
    source = file.read_text()
    assert len(source.splitlines()) <= (120 if file.stem == "gallery" else 80)
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.module.startswith("jaxrod"):
            assert {name.name for name in node.names} <= set(
                PUBLIC[node.module].__all__
            )
        if isinstance(node, ast.Import):
            names = {n.name for n in node.names if n.name.startswith("jaxrod")}
            assert names <= set(PUBLIC)
        if isinstance(node, ast.Attribute):
            assert not node.attr.startswith("_")

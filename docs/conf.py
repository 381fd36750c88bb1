"""Sphinx's settings: the pages of docs/, the notebooks, and a reference of all names.

`make docs` builds the site into build/site, offline, with warnings as errors. Sources
are read where they are: the root of the repository is Sphinx's source folder, so that
links between pages hold in the repository and on the site alike.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "docs"))

from reference_pages import write_reference  # noqa: E402

import jaxrod  # noqa: E402

project = "jaxrod"
author = "jaxrod authors"
copyright = "jaxrod authors"  # noqa: A001
version = release = jaxrod.__version__

root_doc = "docs/index"
include_patterns = [
    "README.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "docs/**",
    "notebooks/*.ipynb",
    "benchmarks/*.md",
    "benchmarks/**/*.md",
]
exclude_patterns = ["docs/conf.py", "docs/reference_pages.py"]

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
]
# The notebooks are executed by the tests, and hold what they made.
nb_execution_mode = "off"
myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence"]
myst_heading_anchors = 4
suppress_warnings = ["myst.header"]

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_mock_imports: list[str] = []
napoleon_google_docstring = True
napoleon_numpy_docstring = False
default_role = "code"

html_theme = "sphinx_book_theme"
html_title = "jaxrod"
html_static_path: list[str] = []
html_extra_path = ["site"]
html_theme_options = {
    "show_navbar_depth": 1,
    "use_download_button": False,
    "home_page_in_toc": True,
}


def math_in_docstrings(
    app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]
) -> None:
    """Makes `$x$` in a docstring a formula, as it is in the pages."""
    text = "\n".join(lines)

    def block(found: re.Match[str]) -> str:
        formula = " ".join(found[1].split())
        indent = re.match(r" *", found.string[found.string.rfind("\n", 0, found.start()) + 1 :])
        space = indent[0] if indent else ""
        return f"\n\n{space}.. math:: {formula}\n\n{space}"

    text = re.sub(r"\$\$(.+?)\$\$", block, text, flags=re.DOTALL)
    text = re.sub(
        r"(?<![\\$`])\$([^$`]+?)\$",
        lambda found: ":math:`" + " ".join(found[1].split()) + "`",
        text,
    )
    lines[:] = text.split("\n")


def setup(app: Any) -> None:
    """Writes the pages of the reference before anything is read."""
    write_reference(ROOT / "docs" / "reference")
    app.connect("autodoc-process-docstring", math_in_docstrings, priority=100)

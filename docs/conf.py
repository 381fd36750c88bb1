"""Sphinx's settings: the pages of docs/, the notebooks, and a reference of all names.

`make docs` builds the site into build/site, offline, with warnings as errors. Sources
are read where they are: the root of the repository is Sphinx's source folder, so that
links between pages hold in the repository and on the site alike.
"""

from __future__ import annotations

import dataclasses
import inspect
import json
import re
import shutil
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx import addnodes
from sphinx.ext.napoleon import Config, GoogleDocstring
from sphinx.util.inspect import stringify_signature

import jaxrod
from jaxrod.viz.page import page_of

ROOT = Path(__file__).resolve().parent.parent
TYPES = "docs/types"
"""Page that explains the types of signatures."""

sys.path.insert(0, str(ROOT / "docs"))
from reference_pages import (  # noqa: E402
    explained_types,
    linked_types,
    readable,
    shown_arguments,
    write_reference,
)

project = "jaxrod"
author = "jaxrod authors"
copyright = "jaxrod authors"
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
exclude_patterns = ["docs/*.py", "docs/static/**"]

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.viewcode",
]
# The notebooks are executed by the tests, and hold what they made.
nb_execution_mode = "off"
myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence"]
myst_heading_anchors = 4
suppress_warnings = ["myst.header"]

# Adapters for libraries that take gigabytes are read without them.
autodoc_mock_imports = [
    name for name in ("stable_baselines3", "torch") if find_spec(name) is None
]
# A longer one has a line for each argument.
maximum_signature_line_length = 250
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
# Overloads are evaluated; these names stay as they are.
autodoc_type_aliases = {name: name for name in ("ArrayLike", "Numbers", "TimeStep")}
default_role = "code"

html_theme = "sphinx_book_theme"
html_title = "jaxrod"
html_math_renderer = "mathml"
html_extra_path = ["site"]
html_static_path = ["static"]
html_css_files = ["site.css"]
html_js_files = ["site.js"]
html_context = {"default_mode": "auto"}
html_theme_options = {
    "show_navbar_depth": 1,
    "use_download_button": False,
}


def signature_as_written(
    app: Any, what: str, name: str, thing: Any, options: Any, given: Any, returns: Any
) -> tuple[str, str] | None:
    """A signature with the types of the source, where `Numbers` is one word.

    Sphinx would evaluate them, and print what an alias stands for.
    """
    if what not in ("function", "method", "class"):
        return None
    try:
        signature = inspect.signature(thing)
    except (TypeError, ValueError):  # Python itself has none for some classes.
        return None
    if what == "method":
        kept = [p for name, p in signature.parameters.items() if name != "self"]
        signature = signature.replace(parameters=kept)
    if what == "class":
        signature = signature.replace(return_annotation=signature.empty)
    if dataclasses.is_dataclass(thing):  # Its fields follow with their types.
        kept = [p.replace(annotation=p.empty) for p in signature.parameters.values()]
        signature = signature.replace(parameters=kept)
    whole = stringify_signature(signature, unqualified_typehints=True)
    bare = signature.replace(return_annotation=signature.empty)
    arguments = stringify_signature(bare, unqualified_typehints=True)
    result = whole.removeprefix(arguments).removeprefix(" -> ")
    shown = shown_arguments(readable(arguments), dataclasses.is_dataclass(thing))
    return shown, readable(result)


def readable_fields(app: Any, document: nodes.document) -> None:
    """Types of fields as those of arguments are, where Sphinx evaluates them."""
    for annotation in document.findall(addnodes.desc_annotation):
        text = annotation.astext()
        name = readable(text)
        if name != text:
            annotation.children = []
            for piece in re.split(r"(\bNumber\b)", name):
                annotation += (
                    type_link(piece) if piece == "Number" else nodes.Text(piece)
                )


def type_link(name: str) -> addnodes.pending_xref:
    """Reference to a type, which is resolved as those in arguments are."""
    return addnodes.pending_xref(
        "", nodes.Text(name), refdomain="py", reftype="class", reftarget=name
    )


def anchors_of_types(app: Any, document: nodes.document) -> None:
    """Makes the rows of the page of types places that signatures can link to."""
    if app.env.docname == TYPES:
        for row in document.findall(nodes.row):
            first = next(row.findall(nodes.entry))
            names = {name.astext() for name in first.findall(nodes.literal)}
            row["ids"] += [f"type-{name}" for name in sorted(names & explained_types())]


def link_to_type(app: Any, env: Any, node: Any, content: Any) -> nodes.Node | None:
    """Links a type that is no class to its row in the page of types."""
    name = node.get("reftarget", "").rpartition(".")[2]
    if node.get("refdomain") != "py" or name not in linked_types():
        return None
    place = app.builder.get_relative_uri(node["refdoc"], TYPES)
    uri = f"{place}#type-{name}"
    return nodes.reference("", "", content, internal=True, refuri=uri)


def google_docstring(
    app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]
) -> None:
    """Reads sections of a docstring; one of a field is plain text, colons included."""
    if what == "data" and type(thing).__module__ == "builtins":
        lines.clear()  # Sphinx takes that of `dict` or `str`
    if what not in ("attribute", "data", "property"):
        lines[:] = GoogleDocstring(
            lines, Config(napoleon_use_rtype=False), app, what, name, thing, options
        ).lines()


def math_in_docstrings(
    app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]
) -> None:
    """Makes `$x$` in a docstring a formula, as it is in the pages."""
    text = "\n".join(lines)
    text = re.sub(
        r"\$\$(.+?)\$\$",
        lambda found: "\n\n.. math:: " + " ".join(found[1].split()) + "\n\n",
        text,
        flags=re.DOTALL,
    )
    text = re.sub(
        r"(?<![\\$`])\$([^$`]+?)\$",
        lambda found: ":math:`" + " ".join(found[1].split()) + "`",
        text,
    )
    lines[:] = text.split("\n")


def mathml(formula: str, as_block: bool) -> str:
    """MathML of a formula, read as TeX reads it."""
    from formulas import spelled_out, tightened

    return tightened(str(tex2mathml(spelled_out(formula), as_block=as_block)))


def inline_math(translator: Any, node: nodes.Element) -> None:
    """A formula in a line, as MathML: browsers draw it without a script."""
    translator.body.append(mathml(node.astext(), as_block=False))
    raise nodes.SkipNode


def display_math(translator: Any, node: nodes.Element) -> None:
    """A formula of its own."""
    formula = mathml(node.astext(), as_block=True)
    translator.body.append(f'<div class="formula">{formula}</div>')
    raise nodes.SkipNode


def table_cell(translator: Any, node: nodes.Element) -> None:
    """A cell of a table. One without words names no column, so it is no header."""
    type(translator).visit_entry(translator, node)
    if not node.astext():
        translator.body[-1] = translator.body[-1].replace("<th", "<td", 1)
        translator.context[-1] = translator.context[-1].replace("</th", "</td", 1)


def end_of_cell(translator: Any, node: nodes.Element) -> None:
    """Ends a cell of a table."""
    type(translator).depart_entry(translator, node)


def back_links(app: Any, page: str, template: str, context: Any, tree: Any) -> None:
    """Corrects links from a source to the docstrings of names.

    `viewcode` takes it that a file has names of one package. Files with names of
    several would lead to names that are on no page.
    """

    def known(found: re.Match[str]) -> str:
        page, words = found[1], found[2].split(".")
        home = page.lstrip("./").removesuffix(".html")
        names = [n for n, o in objects.items() if o.docname == home]
        tails = [".".join(["", *words[k:]]) for k in range(1, len(words))]
        ours = [n for tail in tails for n in names if n.endswith(tail)]
        return found[0] if found[2] in objects or not ours else f'"{page}#{ours[0]}"'

    if page.startswith("_modules/") and "body" in context:
        objects = app.env.domaindata["py"]["objects"]
        context["body"] = re.sub(r'"([^"#]+)#(jaxrod[\w.]+)"', known, context["body"])


def pictures_that_play(app: Any, page: str, source: list[str]) -> None:
    """Makes each large picture of the gallery a place for its replay."""
    if page == "docs/gallery":
        source[0] = re.sub(
            r"^!\[(.*)\]\(gallery/(\w+)\.png\)$",
            r'<a class="replay" href="gallery/\2.html" title="Open the replay alone">'
            r'<img src="gallery/\2.png" alt="\1"></a>',
            source[0],
            flags=re.MULTILINE,
        )


def players(app: Any, failure: Exception | None) -> None:
    """Writes the players of the gallery, and the pictures beside them."""
    folder = Path(app.outdir) / "docs" / "gallery"
    if failure is None and app.builder.format == "html":
        folder.mkdir(parents=True, exist_ok=True)
        for path in sorted((ROOT / "docs" / "gallery").glob("*.png")):
            shutil.copy(path, folder)
            recording = json.loads(path.with_suffix(".json").read_text())
            (folder / f"{path.stem}.html").write_text(page_of(**recording))


def setup(app: Any) -> None:
    """Writes the pages of the reference before anything is read."""
    write_reference(ROOT / "docs" / "reference")
    app.add_node(nodes.entry, override=True, html=(table_cell, end_of_cell))
    app.connect("source-read", pictures_that_play)
    app.connect("build-finished", players)
    app.connect("html-page-context", back_links)
    app.add_html_math_renderer("mathml", (inline_math, None), (display_math, None))
    app.connect("autodoc-process-signature", signature_as_written)
    app.connect("autodoc-process-docstring", google_docstring)
    app.connect("autodoc-process-docstring", math_in_docstrings, priority=900)
    app.connect("doctree-read", readable_fields)
    app.connect("doctree-read", anchors_of_types)
    app.connect("missing-reference", link_to_type)

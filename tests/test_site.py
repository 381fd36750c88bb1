"""The documentation site: its left bar, its pages, and the types it explains."""

import importlib.util
import inspect
import json
import re
import runpy
import sys
from pathlib import Path

import pytest

import jaxrod
from public_names import NAMESPACES

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"


def program(name):
    """A program of docs/, as a module."""
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


formulas, reference_pages = program("formulas"), program("reference_pages")
TOCTREE = re.compile(r"^```\{toctree\}\n(.*?)^```", re.S | re.M)
INCLUDE = re.compile(r"^```\{include\} (\S+)\n(.*?)^```", re.S | re.M)


def toctrees(page):
    """Options and entries of each list of pages in a page."""
    for (text,) in ((found,) for found in TOCTREE.findall(page.read_text())):
        lines = [line for line in text.splitlines() if line]
        options = [line for line in lines if line.startswith(":")]
        entries = [re.sub(r".*<(.*)>", r"\1", x) for x in lines if x not in options]
        yield options, entries


def pages_under(page, seen):
    """All pages that the lists of a page lead to."""
    seen.add(page)
    for _, entries in toctrees(page):
        for entry in entries:
            for child in page.parent.glob(f"{entry}.md"):
                if child.resolve() not in seen:
                    pages_under(child.resolve(), seen)
    return seen


def test_the_left_bar_is_short():
    bar = list(toctrees(DOCS / "index.md"))
    entries = [entry for _, entries in bar for entry in entries]
    assert 4 <= len(bar) <= 6
    assert 20 <= len(entries) <= 30
    assert all(any(x.startswith(":caption:") for x in options) for options, _ in bar)
    assert all(":maxdepth: 1" in options for options, _ in bar)


def test_every_page_is_in_a_list_of_pages():
    reached = pages_under((DOCS / "index.md").resolve(), set())
    # The generator writes the list of the reference, `types` included.
    reached.add(DOCS / "types.md")
    assert {*DOCS.glob("*.md")} - reached == set()


def test_entries_of_the_lists_exist():
    for page in DOCS.glob("*.md"):
        for _, entries in toctrees(page):
            for entry in entries:
                known = entry.startswith("reference/")
                assert known or [*page.parent.glob(f"{entry}.*")], (page.name, entry)


def test_the_front_page_takes_its_numbers_from_the_readme():
    page = (DOCS / "index.md").read_text()
    for file, options in INCLUDE.findall(page):
        text = (DOCS / file).read_text()
        start, end = re.findall(r'"(<!-- .* -->)"', options)
        assert text.count(start) == text.count(end) == 1
        assert text.index(start) < text.index(end)
    readme = (ROOT / "README.md").read_text()
    start, end = "<!-- numbers -->", "<!-- end of numbers -->"
    numbers = readme[readme.index(start) : readme.index(end)]
    assert numbers.count("\n| ") >= 4
    prose = re.sub(r"^```.*?^```", "", page, flags=re.S | re.M)
    sentences = [one.strip() for one in re.findall(r"[^.|\n]{40,}", prose)]
    assert [one for one in sentences if one in readme] == [], "said twice"


def pictures(text):
    """Alternative texts of the pictures in Markdown; of those in HTML, too."""
    yield from re.findall(r"!\[([^\]]*)\]", text)
    for tag in re.findall(r"<img\b[^>]*>", text):
        yield "".join(re.findall(r'\balt="([^"]*)"', tag))


def drawn(cells):
    """Pictures that cells of a notebook made, with the texts in their metadata."""
    for cell in cells:
        alt = cell["metadata"].get("mystnb", {}).get("image", {}).get("alt", "")
        for output in cell.get("outputs", ()):
            if "image/png" in output.get("data", {}):
                yield f"![{alt}](cell.png)"


def test_every_picture_has_a_text_for_those_who_cannot_see_it():
    pages = {page.name: page.read_text() for page in DOCS.glob("*.md")}
    pages |= {name: (ROOT / name).read_text() for name in ("README.md", "CHANGELOG.md")}
    for page in (ROOT / "benchmarks").rglob("*.md"):
        pages[str(page.relative_to(ROOT))] = page.read_text()
    for page in (ROOT / "notebooks").glob("*.ipynb"):
        cells = json.loads(page.read_text())["cells"]
        texts = ["".join(c["source"]) for c in cells if c["cell_type"] == "markdown"]
        pages[page.name] = "\n".join([*texts, *drawn(cells)])
    described = [(name, alt) for name in pages for alt in pictures(pages[name])]
    assert len(described) > 30
    assert [pair for pair in described if len(pair[1].split()) < 3] == []


def test_pictures_without_a_text_are_seen():
    text = '![](a.png) ![An arm](b.png) <img src="c.png"> <img alt="d" src="d.png">'
    assert list(pictures(text)) == ["", "An arm", "", "d"]
    plot = {"metadata": {}, "outputs": [{"data": {"image/png": ""}}]}
    assert list(pictures("\n".join(drawn([plot])))) == [""]


def test_types_of_signatures_are_explained():
    """Names of types that are no classes, in signatures of public functions."""
    first_cells = re.findall(r"^\|(.*?)\|", (DOCS / "types.md").read_text(), re.M)
    explained = set(re.findall(r"`(\w+)", " ".join(first_cells)))
    used = set()
    for space in (*NAMESPACES, jaxrod.control):
        for name in space.__all__:
            thing = getattr(space, name)
            if not inspect.isfunction(thing):
                continue
            module = vars(sys.modules[thing.__module__])
            for written in thing.__annotations__.values():
                for word in re.findall(r"[A-Za-z]\w*", re.sub('"[^"]*"', "", written)):
                    alias = module.get(word)
                    if alias is not None and not inspect.isclass(alias):
                        used.add(word)
    used -= {"Any", "Callable", "Literal", "np", "os", "jax"}
    assert {"Numbers", "Timed", "State"} <= used, "signatures were not understood"
    assert used - explained == set()


def test_the_reference_has_a_summary_of_every_public_name(tmp_path):
    reference_pages.write_reference(tmp_path)
    text = "\n".join(page.read_text() for page in tmp_path.glob("*.md"))
    summaries = dict(re.findall(r"^\| \{py:obj\}`\w+ <(.*)>` \| (.*) \|$", text, re.M))
    names = {f"jaxrod.{name}" for name in jaxrod.__all__}
    spaces = {
        f"jaxrod.{name}" for name in jaxrod._NAMESPACES - {"geometry", "validation"}
    }
    assert names <= set(summaries)
    assert {name.rpartition(".")[0] for name in summaries} >= spaces
    assert [name for name, said in summaries.items() if not said] == []


@pytest.mark.parametrize(
    ("short", "spelled"),
    [
        (r"\tfrac12\rho", r"\tfrac{1}{2}\rho"),
        (r"\frac12 \Big(\frac2h\Big)", r"\frac{1}{2} \Bigl(\frac{2}h\Bigl)"),
        (r"\frac 12 k", r"\frac{1}{2} k"),
        (r"\frac{n}23", r"\frac{n}{2}3"),
        (r"\frac\pi23", r"\frac\pi{2}3"),
        (r"\frac n23", r"\frac n{2}3"),
        (r"\frac1{12}", r"\frac{1}{12}"),
        (r"\frac{1}{12}", r"\frac{1}{12}"),
        (r"x_12y^{12}z^12", r"x_{1}2y^{12}z^{1}2"),
        (r"\sqrt12x", r"\sqrt{1}2x"),
        (r"4.5^2 - 10^{-5}", r"4.5^{2} - 10^{-5}"),
        (r"\dot w_\parallel^2", r"{\dot w{}}_\parallel^{2}"),
        (r"\hat{m}_k + \dot\theta_i", r"{\hat{m}{}}_k + {\dot\theta{}}_i"),
        (r"\hat m^2 + \sum_k", r"\hat m^{2} + \sum_k"),
    ],
)
def test_formulas_are_spelled_out_as_tex_reads_them(short, spelled):
    """A digit alone is an argument, and an index belongs beside its letter."""
    assert formulas.spelled_out(short) == spelled
    assert formulas.spelled_out(spelled) == spelled


def test_bars_are_close_to_what_is_between_them():
    bar = '<mo stretchy="false">|</mo>'
    tight = '<mo stretchy="false" lspace="0" rspace="0">|</mo>'
    assert formulas.tightened(f"{bar}<mi>w</mi>{bar}") == f"{tight}<mi>w</mi>{tight}"
    assert formulas.tightened("<mo>+</mo>") == "<mo>+</mo>"


def test_records_have_a_group_and_a_title_of_their_own():
    page = (DOCS / "records.md").read_text()
    listed = [line for text in TOCTREE.findall(page) for line in text.splitlines()]
    titles = {}
    for line in filter(re.compile("[^:]").match, listed):
        title, path = re.fullmatch(r"(?:(.*) <)?(.*?)>?", line).groups()
        text = (DOCS / f"{path}.md").resolve()
        titles[text] = title or re.search("^# (.*)", text.read_text(), re.M)[1]
    assert set(titles) == set((ROOT / "benchmarks").rglob("*.md"))
    assert len(set(titles.values())) == len(titles)
    assert page.count("\n## ") == 4


def test_styles_and_scripts_of_the_site_exist():
    """Sphinx says nothing about those that are missing."""
    settings = (DOCS / "conf.py").read_text()
    named = re.findall(r'^html_(?:css|js)_files = \["(.*)"\]$', settings, re.M)
    assert {*named} == {path.name for path in (DOCS / "static").iterdir()}


def test_every_module_with_public_names_is_in_the_reference():
    """Packages of the inside of a room, such as a compiler, have names of their own."""
    pages = runpy.run_path(str(DOCS / "reference_pages.py"))
    known = {"jaxrod", *pages["PACKAGES"]}
    with_names = set()
    for folder in ("jaxrod", "envs", "training"):
        for path in (ROOT / folder).rglob("*.py"):
            if re.search(r"^__all__ = ", path.read_text(), re.M):
                parts = path.relative_to(ROOT).with_suffix("").parts
                home = () if folder == "jaxrod" else ("jaxrod",)
                name = ".".join((*home, *parts)).removesuffix(".__init__")
                with_names.add(name)
    inside = {"jaxrod.lanes.jaxpr", "jaxrod.lanes.rows"}
    assert with_names - inside - known == set()


def test_adapters_are_in_the_reference_without_their_libraries():
    pages = runpy.run_path(str(DOCS / "reference_pages.py"))
    found = pages["public"]("jaxrod.envs.torch_env")
    assert {*found} == {"RslRlVecEnv", "SkrlEnv", "TorchBatch"}
    assert found["TorchBatch"].__doc__.startswith("`jaxrod.envs.VectorEnvironment`")
    assert found["TorchBatch"].elapsed.__doc__.startswith("Control steps of every")


def test_hooks_are_described_once():
    """The bases in `jaxrod.extend` describe them, unless a class has an example."""
    pages = runpy.run_path(str(DOCS / "reference_pages.py"))
    tendon = jaxrod.actuation.Tendon
    assert {*pages["bases_of"](tendon)} == {"jaxrod.extend.Effect"}
    hooks = pages["hooks_of"](tendon)
    assert {"energy", "loads", "stability_bound"} <= {*hooks}
    assert not {"cable_lengths", "tension"} & {*hooks}
    assert pages["hooks_of"](jaxrod.extend.Effect) == []
    assert "kinetic_energy" not in pages["hooks_of"](jaxrod.systems.RigidBodies)
    assert "in_own_type" in pages["hooks_of"](jaxrod.systems.RigidBodies)


def test_long_pages_have_headings(tmp_path):
    pages = runpy.run_path(str(DOCS / "reference_pages.py"))
    pages["write_reference"](tmp_path)
    for page in pages["PAGES"]:
        text = (tmp_path / f"{pages['_file'](page)}.md").read_text()
        headings = re.findall("^## (.*)", text, re.M)
        assert headings == [title for title, _ in page.headings]
        parts = re.split("^## ", text, flags=re.M)
        assert all(".. auto" in part for part in parts[1:]), "a heading of nothing"
    assert "## Joints" in (tmp_path / "systems_of_rods_and_bodies.md").read_text()


def test_types_are_readable_and_long_lists_of_fields_are_not_said_twice():
    pages = runpy.run_path(str(DOCS / "reference_pages.py"))
    assert pages["readable"](": float | Float[Array, '']") == ": Number"
    assert pages["readable"]("(dt: Float[Array, '3'])") == "(dt: Float[Array, '3'])"
    assert pages["shown_arguments"]("(a, b)", True) == "(a, b)"
    long = f"({', '.join(['number=1'] * 40)})"
    assert pages["shown_arguments"](long, True) == ""
    assert pages["shown_arguments"](long, False) == long
    linked = pages["linked_types"]()
    assert {"Numbers", "ArrayLike", "Vec3", "AllSeen", "Place", "Timed"} <= linked
    # Also the name of a class, of which signatures may speak.
    assert "Body" not in linked


UNIT = r"\b[a-zA-Z]+(?:/[a-z]+\^\d|\^\d/[a-z]+)"


def test_powers_in_public_docstrings_are_formulas():
    """Units apart, which stay plain text."""
    pages = runpy.run_path(str(DOCS / "reference_pages.py"))
    found = []
    for package in ("jaxrod", *pages["PACKAGES"]):
        for name, thing in pages["public"](package).items():
            parts = vars(thing) if inspect.isclass(thing) else {}
            for part in (thing, *(p for n, p in parts.items() if n[0] != "_")):
                text = part.__doc__ if isinstance(part.__doc__, str) else ""
                prose = re.sub(r"^ *(>>>|\.\.\.).*", "", text, flags=re.M)
                prose = re.sub(r"\$\$[^$]*\$\$|\$[^$]*\$|`[^`]*`|\[[^\]]*\]", "", prose)
                prose = re.sub(UNIT, "", prose)
                found += [
                    f"{package}.{name}: {x}" for x in re.findall(r".*\^.*", prose)
                ]
    assert sorted({*found}) == []

"""Pages of the reference: every public name and its docstring, a page a room."""

from __future__ import annotations

import ast
import functools
import importlib
import importlib.util
import inspect
import itertools
import re
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import jaxrod


class Page(NamedTuple):
    """A page of the reference."""

    title: str
    about: str
    """One sentence."""
    rooms: tuple[str, ...] = ()
    """Rooms whose names are in `jaxrod` itself."""
    packages: tuple[str, ...] = ()
    """Packages with all their names."""
    headings: tuple[tuple[str, tuple[str, ...]], ...] = ()
    """Headings of a long page, each with the modules, or folders of modules, whose
    names are under it. Other names come first."""


ADAPTERS = (
    "jaxrod.envs.gym",
    "jaxrod.envs.goal_env",
    "jaxrod.envs.stable_baselines",
    "jaxrod.envs.brax_env",
    "jaxrod.envs.gymnax_env",
    "jaxrod.envs.torch_env",
)
"""Modules whose libraries may be missing: they are read, and never imported."""
LONGEST = 160
"""Length up to which the arguments of a class are shown beside its fields."""
EXTEND = "jaxrod.extend"
"""Package of the bases whose docstrings describe hooks."""

PAGES = (
    Page("Rods", "Makes rods and states, and measures strain and energy.", ("rods",)),
    Page("Scenes", "Joins a rod, effects and a method into one model.", ("scene",)),
    Page("Stepping", "Moves a scene or a system through time.", ("stepping",)),
    Page(
        "Effects",
        "Loads, supports and damping that act on a rod.",
        ("effects",),
    ),
    Page(
        "Damping",
        "Damping of the material and of short waves.",
        ("damping",),
    ),
    Page(
        "Contact with bodies", "A rod touches bodies that stand still.", ("contacts",)
    ),
    Page(
        "Methods",
        "The elastic law, its reductions, and the integration in time.",
        ("methods",),
    ),
    Page("Equilibria", "Finds shapes in which all loads balance.", ("statics",)),
    Page(
        "Analysis",
        "Stable steps, natural frequencies, reactions and health of a state.",
        ("analysis",),
    ),
    Page(
        "Lanes",
        "Chooses the compiler of batches and single scenes.",
        ("lanes",),
    ),
    Page(
        "Saving",
        "Keeps scenes, systems and states in files, and changes their precision.",
        ("saving", "validation"),
    ),
    Page(
        "Installation", "Sets up the processor before JAX computes.", ("installation",)
    ),
    Page(
        "Systems of rods and bodies",
        "Bodies, joints and contact between members.",
        ("systems",),
        ("jaxrod.systems",),
        (
            ("Bodies", ("jaxrod.systems.members",)),
            ("Joints", ("jaxrod.systems.joints",)),
            ("Contact", ("jaxrod.systems.contact", "jaxrod.systems.neighbour_counts")),
            (
                "Health, reactions and settling",
                (
                    "jaxrod.systems.health",
                    "jaxrod.systems.reactions",
                    "jaxrod.systems.settling",
                ),
            ),
        ),
    ),
    Page(
        "Assemblies of rods",
        "Makes whole systems of many rods by one call.",
        packages=("jaxrod.assemblies",),
    ),
    Page(
        "Actuation",
        "Muscles, tendons, chambers, magnets and waves.",
        packages=("jaxrod.actuation",),
    ),
    Page(
        "Materials",
        "Relaxation, hysteresis and plastic set.",
        packages=("jaxrod.materials",),
    ),
    Page("Fluids", "Drag, flow, buoyancy and added mass.", packages=("jaxrod.fluids",)),
    Page(
        "Shapes", "Shapes of obstacles and rigid bodies.", packages=("jaxrod.shapes",)
    ),
    Page(
        "Schedules",
        "Numbers of effects that change with time.",
        packages=("jaxrod.schedules",),
    ),
    Page(
        "Sensors",
        "Readings of a state, and their noise.",
        packages=("jaxrod.sensors",),
    ),
    Page(
        "Twist, writhe, link",
        "Topology of curves, and rods that passed through each other.",
        packages=("jaxrod.topology",),
    ),
    Page(
        "Speed for accuracy",
        "Finds the cheapest setting within an allowed error, and what can be left out.",
        ("tradeoff",),
        ("jaxrod.tradeoff",),
    ),
    Page(
        "Extending",
        "Bases of effects, couplings, methods and members of your own.",
        packages=("jaxrod.extend",),
    ),
    Page(
        "Control",
        "Optimises, plans and identifies by gradients.",
        packages=("jaxrod.control",),
    ),
    Page(
        "Estimation of states",
        "Filters that follow a state from sensor readings.",
        packages=("jaxrod.control.estimation",),
    ),
    Page(
        "Twins from recordings",
        "Fits an arm to recordings of a real one.",
        packages=("jaxrod.twin",),
    ),
    Page(
        "Environments",
        "Makes tasks, batches them and rolls them out.",
        packages=("jaxrod.envs",),
    ),
    Page(
        "Adapters for other libraries",
        "Gives tasks to learners of Gymnasium, Stable Baselines 3, brax, gymnax, and "
        "PyTorch.",
        packages=ADAPTERS,
    ),
    Page(
        "Learners",
        "Trains, evaluates and exports policies.",
        packages=("jaxrod.training",),
        headings=(
            ("Runs", ("jaxrod.training.runs", "jaxrod.training.evaluation")),
            (
                "Algorithms and their settings",
                (
                    "jaxrod.training.algorithm",
                    "jaxrod.training.algorithms",
                    "jaxrod.training.settings",
                ),
            ),
            ("Policies", ("jaxrod.training.policy", "jaxrod.training.networks")),
            ("Export", ("jaxrod.training.exporting",)),
        ),
    ),
    Page("Drawing", "Replays, stills and films.", packages=("jaxrod.viz",)),
)

PACKAGES = tuple(package for page in PAGES for package in page.packages)

ASSUMED = """\
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from jaxrod import actuation, assemblies, extend, fluids, schedules
from jaxrod import control, envs, sensors, training, twin, viz
from jaxrod import materials, shapes, systems, topology, tradeoff
from jaxrod.control import estimation

rod, state = jaxrod.straight_rod(
    10,
    length=1.0,
    radius=0.02,
    density=1000.0,
    youngs_modulus=1e6,
    direction=(1.0, 0.0, 0.0),
)
scene = jaxrod.make_scene(
    rod, jaxrod.clamp(state), jaxrod.gravity(), jaxrod.exponential_damping(2.0)
)
motion = scene.as_member().motion(state)  # what effects see of the state
"""
"""Program that examples in docstrings go on from; a test runs them after it."""


def write_reference(folder: Path) -> None:
    """Writes all pages and their list; removes pages that are no longer there."""
    folder.mkdir(exist_ok=True)
    of_rooms: dict[str, list[str]] = {}
    for name in jaxrod.__all__:
        room = getattr(jaxrod, name).__module__.split(".")[1]
        of_rooms.setdefault(room, []).append(name)
    homes: dict[int, str] = {}
    files = [_file(page) for page in PAGES]
    for page, file in zip(PAGES, files, strict=True):
        names = [("jaxrod", name) for room in page.rooms for name in of_rooms.pop(room)]
        for package in page.packages:
            names += [(package, name) for name in public(package)]
        _write(folder / f"{file}.md", _page(page, names, homes))
    if of_rooms:
        raise ValueError(f"no page of the reference has the rooms {sorted(of_rooms)}")
    lines = [
        f"| [{page.title}]({file}.md) | {page.about} |"
        for page, file in zip(PAGES, files, strict=True)
    ]
    listed = "\n".join(files)
    _write(
        folder / "index.md",
        "# Reference\n\nEvery public name has its docstring here. The page "
        "[types](../types.md) explains the types in signatures. Examples go on from "
        f"this program:\n\n```python\n{ASSUMED}```\n\n"
        "| page | contents |\n|---|---|\n" + "\n".join(lines) + "\n\n"
        f"```{{toctree}}\n:maxdepth: 1\n:hidden:\n\n../types\n{listed}\n```\n",
    )
    for old in {*folder.glob("*.md")} - {folder / f"{f}.md" for f in (*files, "index")}:
        old.unlink()


def _file(page: Page) -> str:
    return "".join(c if c.isalnum() else "_" for c in page.title.lower())


def _page(page: Page, names: list[tuple[str, str]], homes: dict[int, str]) -> str:
    """A page: what it is about, a table of names, and their docstrings.

    Args:
        page: Title and rooms.
        names: Packages and names of what it has.
        homes: Full name under which each object is in the index, by its id; a second
            place of the same object refers to the first.
    """
    rows: list[str] = []
    parts: dict[str, list[str]] = {"": [], **{title: [] for title, _ in page.headings}}
    for package, name in names:
        thing = public(package)[name]
        if inspect.ismodule(thing):
            continue
        entries = parts[_heading(page, thing)]
        full = f"{package}.{name}"
        home = homes.setdefault(id(thing), full)
        doc = docstring(package, name)
        rows.append(f"| {{py:obj}}`{name} <{home}>` | {summary(doc)} |")
        entries += ["", f".. currentmodule:: {package}", ""]
        if inspect.isclass(thing):
            entries += [f".. autoclass:: {name}", "   :members:"]
            hooks = hooks_of(thing)
            if hooks:
                entries += [f"   :exclude-members: {', '.join(hooks)}"]
        elif callable(thing):
            entries += [f".. autofunction:: {name}"]
        else:
            entries += [f".. py:data:: {name}"]
        entries += ["   :no-index:"] if home != full else []
        entries += [] if callable(thing) else ["", f"   {summary(doc)}."]
        bases = ", ".join(f":py:obj:`{base}`" for base in bases_of(thing))
        entries += ["", f"   Hooks are described in {bases}."] if bases else []
    table = "\n".join(["| name | summary |", "|---|---|", *rows])
    head = f"{page.about} Examples go on from [this program](index.md)."
    written = [f"# {page.title}\n\n{head}\n\n{table}\n"]
    for title, entries in parts.items():
        written += [f"## {title}\n"] if title else []
        written += (
            ["\n".join(["```{eval-rst}", *entries, "```", ""])] if entries else []
        )
    return "\n".join(written)


def _heading(page: Page, thing: Any) -> str:
    """Heading under which a thing stands; empty for the beginning of the page."""
    module = getattr(thing, "__module__", "")
    for title, places in page.headings:
        if any(f"{module}.".startswith(f"{place}.") for place in places):
            return title
    return ""


def bases_of(thing: Any) -> dict[str, type]:
    """Bases of a class that are in the reference and describe hooks, by full name."""
    listed = {f"jaxrod.extend.{name}": one for name, one in public(EXTEND).items()}
    return {
        name: base
        for name, base in listed.items()
        if inspect.isclass(thing) and inspect.isclass(base)
        if base is not thing and base in thing.__mro__ and _hooks(base)
    }


def hooks_of(thing: type) -> list[str]:
    """Hooks that a class overrides, without those whose docstring has an example.

    The docstring of the base describes them.
    """
    of_bases = {name for base in bases_of(thing).values() for name in _hooks(base)}
    return sorted(
        name
        for name, part in vars(thing).items()
        if name in of_bases and ">>>" not in (getattr(part, "__doc__", None) or "")
    )


def _hooks(base: type) -> set[str]:
    """Public methods and properties that a class defines itself."""
    return {
        name
        for name, part in vars(base).items()
        if name[0] != "_" and (inspect.isfunction(part) or isinstance(part, property))
    }


@functools.cache
def public(package: str) -> dict[str, Any]:
    """Public things of a package by name, sorted.

    Those of an adapter are stand-ins: classes and functions with the docstrings of its
    source.
    """
    if package in ADAPTERS:
        return _from_source(package)
    module = importlib.import_module(package)
    return {name: getattr(module, name) for name in sorted(module.__all__)}


def _from_source(package: str) -> dict[str, Any]:
    spec = importlib.util.find_spec(package)
    assert spec is not None and spec.origin is not None
    body = ast.parse(Path(spec.origin).read_text()).body
    found = {
        node.name: _stand_in(node)
        for node in body
        if isinstance(node, ast.ClassDef | ast.FunctionDef)
    }
    (names,) = (
        ast.literal_eval(node.value)
        for node in body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__"
    )
    return {name: found[name] for name in sorted(names)}


def _stand_in(node: ast.ClassDef | ast.FunctionDef) -> Any:
    parts: dict[str, Any] = {"__doc__": ast.get_docstring(node)}
    if isinstance(node, ast.ClassDef):
        inner = [part for part in node.body if isinstance(part, ast.FunctionDef)]
        # The getter of a property comes before its setter.
        methods = {part.name: _stand_in(part) for part in reversed(inner)}
        return type(node.name, (), parts | methods)
    made = lambda: None
    made.__doc__ = parts["__doc__"]
    return made


def docstring(package: str, name: str) -> str:
    """Docstring of a public name; a constant has the string below its assignment."""
    thing = public(package)[name]
    if callable(thing):
        return inspect.getdoc(thing) or ""
    return _below_assignment(importlib.import_module(package), name)


def _below_assignment(module: ModuleType, name: str) -> str:
    body = ast.parse(inspect.getsource(module)).body
    body += [inner for node in body if isinstance(node, ast.Try) for inner in node.body]
    for node, below in itertools.pairwise([*body, ast.Pass()]):
        if isinstance(node, ast.ImportFrom) and name in {n.name for n in node.names}:
            return _below_assignment(importlib.import_module(str(node.module)), name)
        match node, below:
            case (
                (
                    ast.Assign(targets=[ast.Name(id=target)])
                    | ast.AnnAssign(target=ast.Name(id=target))
                ),
                ast.Expr(value=ast.Constant(value=str(text))),
            ) if target == name:
                return inspect.cleandoc(text)
    return ""


def summary(doc: str) -> str:
    """First sentence of a docstring, as a cell of a table."""
    first = " ".join(doc.partition("\n\n")[0].split())
    return first.partition(". ")[0].rstrip(".:").replace("|", r"\|")


@functools.cache
def explained_types() -> set[str]:
    """Names of the types that docs/types.md explains, in first cells of its tables."""
    page = Path(__file__).with_name("types.md").read_text()
    cells = re.findall(r"^\|(.*?)\|", page, re.MULTILINE)
    return set(re.findall(r"`(\w+)`", " ".join(cells)))


@functools.cache
def linked_types() -> set[str]:
    """Types that signatures link to; not those with the name of a public class."""
    return explained_types().difference(*map(public, ("jaxrod", *PACKAGES)))


def readable(written: str) -> str:
    """A type as the page of types names it: a number is `Number`."""
    number = r"float \| Float\[Array, (''|\"\")\]|Float\[Array, (''|\"\")\] \| float"
    return re.sub(number, "Number", written)


def shown_arguments(arguments: str, has_fields: bool) -> str:
    """Arguments of a signature; none of a class with so many fields that follow."""
    return "" if has_fields and len(arguments) > LONGEST else arguments


def _write(path: Path, text: str) -> None:
    """Only where it changes, so that Sphinx reads again only what did."""
    if not path.exists() or path.read_text() != text:
        path.write_text(text)

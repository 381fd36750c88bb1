"""Pages of the reference: every public name and its docstring, a page a room."""

from __future__ import annotations

import importlib
import inspect
from pathlib import Path

import jaxrod

TITLES = {
    "analysis": "Questions to ask: stability, frequencies, health",
    "contacts": "Contact with bodies",
    "damping": "Damping",
    "effects": "Effects",
    "installation": "Installation",
    "lanes": "Lanes",
    "loaded_rod": "Methods",
    "methods": "Methods",
    "rods": "Rods",
    "saving": "Saved files and precision",
    "scene": "Scenes",
    "statics": "Equilibria",
    "stepping": "Stepping",
    "systems": "Systems of rods and bodies",
    "tradeoff": "Speed for accuracy",
    "validation": "Saved files and precision",
}
PACKAGES = {
    "jaxrod.actuation": "Actuation",
    "jaxrod.assemblies": "Assemblies of rods",
    "jaxrod.control": "Control",
    "jaxrod.control.estimation": "Estimation of states",
    "jaxrod.envs": "Environments",
    "jaxrod.extend": "Effects, couplings, methods and members of your own",
    "jaxrod.fluids": "Fluids",
    "jaxrod.schedules": "Schedules",
    "jaxrod.sensors": "Sensors",
    "jaxrod.shapes": "Shapes",
    "jaxrod.systems": "Systems of rods and bodies",
    "jaxrod.topology": "Twist, writhe, link",
    "jaxrod.tradeoff": "Speed for accuracy",
    "jaxrod.training": "Learners",
    "jaxrod.twin": "Twins from recordings",
    "jaxrod.viz": "Drawing",
}


def write_reference(folder: Path) -> None:
    """Writes a page for each room and each package, and their list."""
    folder.mkdir(exist_ok=True)
    rooms: dict[str, list[tuple[str, str]]] = {}
    for name in jaxrod.__all__:
        room = getattr(jaxrod, name).__module__.split(".")[1]
        rooms.setdefault(TITLES[room], []).append(("jaxrod", name))
    for package, title in PACKAGES.items():
        names = importlib.import_module(package).__all__
        rooms.setdefault(title, []).extend((package, name) for name in sorted(names))
    pages: list[str] = []
    seen: set[int] = set()
    for title, names in sorted(rooms.items()):
        page = "".join(c if c.isalnum() else "_" for c in title.lower())
        pages.append(page)
        _write(folder / f"{page}.md", f"# {title}\n\n" + _entries(names, seen))
    listed = "\n".join(pages)
    _write(
        folder / "index.md",
        "# Reference\n\nEvery public name, from the docstrings.\n\n"
        f"```{{toctree}}\n:maxdepth: 1\n\n{listed}\n```\n",
    )


def _entries(names: list[tuple[str, str]], seen: set[int]) -> str:
    """Directives for all names; what another page has is not in the index twice."""
    lines = ["```{eval-rst}"]
    for package, name in names:
        thing = getattr(importlib.import_module(package), name)
        if inspect.ismodule(thing):
            continue
        lines += ["", f".. currentmodule:: {package}", ""]
        if inspect.isclass(thing):
            lines += [f".. autoclass:: {name}", "   :members:"]
        elif callable(thing):
            lines += [f".. autofunction:: {name}"]
        else:
            lines += [f".. autodata:: {name}", "   :no-value:"]
        lines += ["   :no-index:"] if id(thing) in seen else []
        seen.add(id(thing))
    return "\n".join([*lines, "```", ""])


def _write(path: Path, text: str) -> None:
    """Only where it changes, so that Sphinx reads again only what did."""
    if not path.exists() or path.read_text() != text:
        path.write_text(text)

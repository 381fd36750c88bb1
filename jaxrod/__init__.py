"""jaxrod: soft, slender rods as differentiable, batchable JAX functions.

A rod is a pytree, a step is a pure function, a thousand arms are `jax.vmap` of one.

    rod, state = jaxrod.straight_rod(20, length=1.0, radius=0.05, density=1000.0,
                                     youngs_modulus=1e7)
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state), jaxrod.gravity())
    dt = jaxrod.stable_dt(scene).dt
    state = jaxrod.advance(scene, state, dt, 1000)

Names of one subject are in namespaces: `jaxrod.actuation`, `fluids`, `materials`,
`schedules`, `sensors`, `shapes`, `systems`, `topology` and `extend`, for effects,
couplings and methods of your own. Environments are in `jaxrod.envs`, learners in
`jaxrod.training`, trajectory optimisation, planning and identification in
`jaxrod.control`, drawing in `jaxrod.viz`.

`import jaxrod` loads nothing: every name is imported from its module when it is
first used. The command line therefore answers at once, and `jaxrod doctor` can report
on a JAX that jaxrod refuses to run on. The names and their modules are those of
`__init__.pyi`, which type checkers read.
"""

from __future__ import annotations

import ast
import importlib
from pathlib import Path
from typing import Any

from jaxrod.installation.jax_version import require_sound_jax
from jaxrod.spelling import nearest

__version__ = "0.3.0"


def _module_of_each_name() -> dict[str, str]:
    """Maps each public name to its module, as read from the stub `__init__.pyi`."""
    stub = ast.parse(Path(__file__).with_suffix(".pyi").read_text())
    return {
        alias.name: node.module or ""
        for node in stub.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


_MODULE_OF = _module_of_each_name()
_NAMESPACES = {name for name, module in _MODULE_OF.items() if module == "jaxrod"}

__all__ = sorted({*_MODULE_OF} - _NAMESPACES)

_GUESSES = {
    **dict.fromkeys(
        ("CosseratRod", "make_rod", "rod"),
        "jaxrod.straight_rod and jaxrod.rod_along make a rod and its state",
    ),
    **dict.fromkeys(
        ("PositionVerlet", "integrate", "run", "simulate"),
        "jaxrod.advance computes a later state, jaxrod.rollout also those on the way",
    ),
    **dict.fromkeys(
        ("BaseSystemCollection", "MjModel", "Simulator"),
        "jaxrod.make_scene joins a rod and effects, jaxrod.make_system several rods",
    ),
    **dict.fromkeys(
        ("OneEndFixedBC", "fix", "fixed"),
        "jaxrod.clamp holds an end, and jaxrod.fixed_end holds it as in PyElastica",
    ),
    **dict.fromkeys(
        ("pin", "pinned", "simple_support"),
        "jaxrod.pin_support holds an end and lets it turn",
    ),
    **dict.fromkeys(
        ("AnalyticalLinearDamper", "damper"),
        "it is jaxrod.exponential_damping, or jaxrod.internal_damping of the material",
    ),
    **dict.fromkeys(
        ("plot", "render", "show", "view", "viewer"),
        "jaxrod.viz.show plays states, and jaxrod.viz.live simulates in real time",
    ),
    **dict.fromkeys(("get_environment", "make", "make_env"), "it is jaxrod.envs.make"),
    **dict.fromkeys(("floor", "ground"), "it is jaxrod.contact(jaxrod.shapes.plane())"),
    "EndpointForces": "it is jaxrod.end_load",
    "GravityForces": "it is jaxrod.gravity",
    "MjData": "it is the state that jaxrod.straight_rod returns with a rod",
    "MuscleTorques": "it is jaxrod.actuation.muscle_torques",
    "UniformForces": "it is jaxrod.uniform_load",
    "friction": "it is an argument of jaxrod.contact",
    "hinge": "jaxrod.hinge_support holds an end, jaxrod.systems.hinge_joint joins rods",
    "mj_step": "jaxrod.step computes one step, and jaxrod.advance many",
}
"""Hints for names that users of other tools guess, by the guess."""


def __getattr__(name: str) -> Any:
    """Imports a public name, or a namespace, when it is first used."""
    if name in _NAMESPACES:
        return _namespace(name)
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'jaxrod' has no attribute {name!r}{_hint(name)}")
    require_sound_jax()
    globals()[name] = getattr(importlib.import_module(_MODULE_OF[name]), name)
    return globals()[name]


def _hint(name: str) -> str:
    """Hint ": it is jaxrod.SPACE.NAME" for a name in a namespace, or for a guess.

    Files are searched as text, because nothing may be imported here.
    """
    if name in _GUESSES:
        return f": {_GUESSES[name]}"
    here = Path(__file__).parent
    for space in sorted(_NAMESPACES):
        for file in (here / f"{space}.py", here / space / "__init__.py"):
            if file.exists() and f'\n    "{name}",\n' in file.read_text():
                return f": it is jaxrod.{space}.{name}"
    meant = nearest(name, _MODULE_OF)
    return f": did you mean jaxrod.{meant}?" if meant else ""


def _namespace(name: str) -> Any:
    try:
        return importlib.import_module(f"jaxrod.{name}")
    except ModuleNotFoundError as error:
        # An optional package is missing. Attribute look-up must raise AttributeError,
        # or help(jaxrod) and hasattr would fail.
        raise AttributeError(f"jaxrod.{name} cannot be imported: {error}") from error


def __dir__() -> list[str]:
    return sorted({*_MODULE_OF, *(name for name in globals() if name[:2] == "__")})

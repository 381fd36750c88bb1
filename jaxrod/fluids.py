"""Fluids around a rod: drag, flows, buoyancy and added mass."""

from functools import partial
from typing import TYPE_CHECKING

import jaxrod.spelling
from jaxrod.effects.fluids import (
    Buoyancy,
    FlowField,
    QuadraticDrag,
    SlenderBodyDrag,
    StokesDrag,
    UniformFlow,
    buoyancy,
    flow_field,
    quadratic_drag,
    slender_body_drag,
    slender_cylinder,
    stokes_drag,
    with_added_mass,
)
from jaxrod.rods.drag import Drag, drag_loads

__all__ = [
    "Buoyancy",
    "Drag",
    "FlowField",
    "QuadraticDrag",
    "SlenderBodyDrag",
    "StokesDrag",
    "UniformFlow",
    "buoyancy",
    "drag_loads",
    "flow_field",
    "quadratic_drag",
    "slender_body_drag",
    "slender_cylinder",
    "stokes_drag",
    "with_added_mass",
]

if not TYPE_CHECKING:
    __getattr__ = partial(jaxrod.spelling.no_such_name, __name__)

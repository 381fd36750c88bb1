"""Fluids around a rod: drag, flows, buoyancy and added mass."""

from jaxrod.effects.flows import FlowField, UniformFlow, flow_field
from jaxrod.effects.fluids import (
    QuadraticDrag,
    StokesDrag,
    quadratic_drag,
    slender_cylinder,
    stokes_drag,
)
from jaxrod.effects.immersion import Buoyancy, buoyancy, with_added_mass
from jaxrod.effects.slender_body import SlenderBodyDrag, slender_body_drag
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

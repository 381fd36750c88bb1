"""Jaxprs as programs of single numbers; importing this package registers all rules."""

from jaxrod.lanes.jaxpr import (
    arithmetic,
    control_flow,
    indexing,
    reductions,
    shape_ops,
)

__all__ = ["arithmetic", "control_flow", "indexing", "reductions", "shape_ops"]

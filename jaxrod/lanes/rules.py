"""The unroller with all of its rules: importing this module registers them."""

from jaxrod.lanes import (
    arithmetic,
    control_flow,
    indexing,
    rearranging,
    reductions,
)
from jaxrod.lanes.unroll import Unroller, supported

__all__ = [
    "Unroller",
    "arithmetic",
    "control_flow",
    "indexing",
    "rearranging",
    "reductions",
    "supported",
]

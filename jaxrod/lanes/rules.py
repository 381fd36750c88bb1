"""All rules of unrolling, known once this is imported."""

from jaxrod.lanes import (
    arithmetic,
    control_flow,
    indexing,
    rearranging,
    reductions,
)
from jaxrod.lanes.unroll import RULES

__all__ = ["RULES", "arithmetic", "control_flow", "indexing", "rearranging", "reductions"]

"""Translation of jaxprs to operations on single numbers (unrolling).

Importing this package registers the rules of all primitives.
"""

from jaxrod.lanes.jaxpr import arithmetic, indexing, reductions

__all__ = ["arithmetic", "indexing", "reductions"]

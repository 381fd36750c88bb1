"""Kernels of rows: one scene at a time, its elements side by side in vector registers.

Importing this package registers the translation rules of all primitives.
"""

from jaxrod.lanes.rows import listing, row_indexing, row_unroller, sorting

__all__ = ["listing", "row_indexing", "row_unroller", "sorting"]

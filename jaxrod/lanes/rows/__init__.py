"""Rows: one scene at a time, its elements side by side in the vector registers.

Importing this package registers all rules of rows.
"""

from jaxrod.lanes.rows import row_indexing, row_unroller

__all__ = ["row_indexing", "row_unroller"]

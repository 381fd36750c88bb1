"""Rows: one scene at a time, its elements side by side in the vector registers."""

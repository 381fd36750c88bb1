"""Soft bodies of the tasks outside the benchmark, what acts on them, and a hand."""

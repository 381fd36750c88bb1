"""Soft bodies of the tasks outside the benchmark, and the effects on them."""

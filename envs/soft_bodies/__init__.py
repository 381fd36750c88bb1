"""Bodies of the tasks other than the benchmark: materials, and effects on them."""

"""Bodies of the tasks other than the arms: their material and what acts on them."""

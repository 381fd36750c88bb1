"""Bodies of the tasks other than the arms: their materials, and the effects on them."""

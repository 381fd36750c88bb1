"""Bodies of the tasks beside the arms: what they are made of and what acts on them."""

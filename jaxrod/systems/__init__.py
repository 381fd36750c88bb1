"""Several rods and rigid bodies, and what ties and couples them."""

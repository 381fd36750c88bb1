"""Systems of rods and rigid bodies, with the couplings between them."""

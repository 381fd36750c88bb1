"""Contact couplings: rods with rods, rods with rigid bodies, and rigid bodies."""

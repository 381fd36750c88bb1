"""Contact between members: rods, bodies, lists of neighbours."""

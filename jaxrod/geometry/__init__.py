"""Vectors, rotations, matrices and frames as tuples of component arrays."""

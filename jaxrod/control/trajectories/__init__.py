"""Trajectory optimisation: optimal control problems and their solvers."""

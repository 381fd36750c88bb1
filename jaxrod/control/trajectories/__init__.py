"""Trajectory optimisation: problems of control and solvers."""

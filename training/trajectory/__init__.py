"""Optimisation of trajectories by gradients through the simulation."""

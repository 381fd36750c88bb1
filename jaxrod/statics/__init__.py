"""Equilibria, and the linear systems of equilibria and implicit steps."""

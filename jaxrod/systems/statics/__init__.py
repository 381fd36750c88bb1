"""Statics of systems: equilibria, and small motions about them."""

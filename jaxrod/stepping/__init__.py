"""Stepping a scene through time."""

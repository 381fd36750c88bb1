"""Damping solved separately after the kick: of the material, and of short waves."""

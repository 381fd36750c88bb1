"""Damping that is solved by itself after the kick: of the material, of short waves."""

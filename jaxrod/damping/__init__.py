"""Damping that is solved after the loads of a step: of material, and of short waves."""

"""Actuation as stress of the section: waves, muscles, tendons, chambers, magnets."""

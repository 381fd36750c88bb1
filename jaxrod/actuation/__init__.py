"""Actuation as stress in the section: waves, muscles, tendons, chambers, magnets."""

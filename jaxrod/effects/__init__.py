"""Influences on a rod: loads, damping, held ends, actuation."""

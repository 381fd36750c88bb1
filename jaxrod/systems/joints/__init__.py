"""Joints between members, such as welds and springs, and places where they act."""

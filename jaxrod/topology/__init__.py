"""Topology of curves and ribbons: twist, writhe, link, and what passed through what."""

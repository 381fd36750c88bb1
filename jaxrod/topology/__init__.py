"""Topology of curves and ribbons: twist, writhe, link, and passages through curves."""

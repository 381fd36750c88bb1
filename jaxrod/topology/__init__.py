"""Topology of curves and ribbons: twist, writhe, link, and passages through curves."""

from jaxrod.topology.passages import crossed, crossings
from jaxrod.topology.winding import link, linking_number, twist, writhe

__all__ = [
    "crossed",
    "crossings",
    "link",
    "linking_number",
    "twist",
    "writhe",
]

"""Topology of curves and ribbons: twist, writhe, link, and passages through curves."""

from functools import partial
from typing import TYPE_CHECKING

import jaxrod.spelling
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

if not TYPE_CHECKING:
    __getattr__ = partial(jaxrod.spelling.no_such_name, __name__)

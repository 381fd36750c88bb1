"""Systems of many rods, built by one call: each returns a system and its state."""

from functools import partial
from typing import TYPE_CHECKING

import jaxrod.spelling
from jaxrod.assemblies.branched_rods import octopus, tree
from jaxrod.assemblies.nests import nest
from jaxrod.assemblies.parallel_rods import bundle, cilia, hexagonal_places
from jaxrod.assemblies.woven_rods import braid, net

__all__ = [
    "braid",
    "bundle",
    "cilia",
    "hexagonal_places",
    "nest",
    "net",
    "octopus",
    "tree",
]

if not TYPE_CHECKING:
    __getattr__ = partial(jaxrod.spelling.no_such_name, __name__)

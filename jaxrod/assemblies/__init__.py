"""Systems of many rods, built by one call: each returns a system and its state."""

from jaxrod.assemblies.nests import nest as nest
from jaxrod.assemblies.octopods import octopus as octopus
from jaxrod.assemblies.parallel_rods import bundle as bundle
from jaxrod.assemblies.parallel_rods import cilia as cilia
from jaxrod.assemblies.parallel_rods import hexagonal_places as hexagonal_places
from jaxrod.assemblies.trees import tree as tree
from jaxrod.assemblies.woven_rods import braid as braid
from jaxrod.assemblies.woven_rods import net as net

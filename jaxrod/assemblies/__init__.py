"""Systems of many rods, built by one call: each returns a system and its state."""

from jaxrod.assemblies.braids import braid as braid
from jaxrod.assemblies.bundles import bundle as bundle
from jaxrod.assemblies.bundles import hexagonal_places as hexagonal_places
from jaxrod.assemblies.carpets import cilia as cilia
from jaxrod.assemblies.nests import nest as nest
from jaxrod.assemblies.nets import net as net
from jaxrod.assemblies.octopods import octopus as octopus
from jaxrod.assemblies.trees import tree as tree

"""Method in space for each elastic law, by the law's name."""

from __future__ import annotations

from jaxrod.methods.consistent import Consistent
from jaxrod.methods.pyelastica import PyElastica
from jaxrod.scene import Law

IN_SPACE: dict[Law, Consistent | PyElastica] = {
    "consistent": Consistent(),
    "pyelastica": PyElastica(),
}

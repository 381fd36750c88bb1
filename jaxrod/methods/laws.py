"""Method in three dimensions for each elastic law, by the law's name."""

from __future__ import annotations

from typing import Literal

from jaxrod.methods.consistent import Consistent
from jaxrod.methods.pyelastica import PyElastica

Law = Literal["consistent", "pyelastica"]
"""Elastic laws: loads from a stored energy, and those of PyElastica 1.0."""

IN_SPACE: dict[Law, Consistent | PyElastica] = {
    "consistent": Consistent(),
    "pyelastica": PyElastica(),
}

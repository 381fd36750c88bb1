"""Materials with memory: relaxation, hysteresis and plastic set, as effects."""

from functools import partial
from typing import TYPE_CHECKING

import jaxrod.spelling
from jaxrod.materials.hysteresis import BendingHysteresis, bending_hysteresis
from jaxrod.materials.plasticity import PlasticBending, plastic_bending
from jaxrod.materials.relaxation import StandardLinearSolid, standard_linear_solid

__all__ = [
    "BendingHysteresis",
    "PlasticBending",
    "StandardLinearSolid",
    "bending_hysteresis",
    "plastic_bending",
    "standard_linear_solid",
]

if not TYPE_CHECKING:
    __getattr__ = partial(jaxrod.spelling.no_such_name, __name__)

"""Actuation: muscles, tendons, chambers, magnets, waves, and couples from splines."""

from functools import partial
from typing import TYPE_CHECKING

import jaxrod.spelling
from jaxrod.actuation.active_shapes import ActiveShape, active_shape
from jaxrod.actuation.chambers import Chamber, WoundChamber, chamber, wound_chamber
from jaxrod.actuation.fibre_path import helical_offsets
from jaxrod.actuation.magnets import (
    LinearField,
    MagneticField,
    Magnetisation,
    linear_field,
    magnetisation,
)
from jaxrod.actuation.muscles import (
    Muscle,
    constant_force,
    cubic_force,
    gaussian_force,
    muscle,
)
from jaxrod.actuation.section_load import SectionLoad, SectionStrains, SectionStress
from jaxrod.actuation.tendons import Tendon, tendon
from jaxrod.actuation.waves import (
    TravellingWave,
    WorldWave,
    muscle_torques,
    travelling_wave,
)
from jaxrod.effects.actuation import (
    ControlSpline,
    ElementAverages,
    ElementCouples,
    control_spline,
    limit_rate,
    spline_couples,
)

__all__ = [
    "ActiveShape",
    "Chamber",
    "ControlSpline",
    "ElementAverages",
    "ElementCouples",
    "LinearField",
    "MagneticField",
    "Magnetisation",
    "Muscle",
    "SectionLoad",
    "SectionStrains",
    "SectionStress",
    "Tendon",
    "TravellingWave",
    "WorldWave",
    "WoundChamber",
    "active_shape",
    "chamber",
    "constant_force",
    "control_spline",
    "cubic_force",
    "gaussian_force",
    "helical_offsets",
    "limit_rate",
    "linear_field",
    "magnetisation",
    "muscle",
    "muscle_torques",
    "spline_couples",
    "tendon",
    "travelling_wave",
    "wound_chamber",
]

if not TYPE_CHECKING:
    __getattr__ = partial(jaxrod.spelling.no_such_name, __name__)

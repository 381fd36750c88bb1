"""Differentiable control: problems, solvers, linear models, identification, filters."""

from functools import partial
from typing import TYPE_CHECKING

import jaxrod.spelling
from jaxrod.control import estimation
from jaxrod.control.identification.fit import fit
from jaxrod.control.identification.match_shape import ShapeMatch, match_shape
from jaxrod.control.identification.parameters import Parameters, make_parameters
from jaxrod.control.identification.result import Fit, Forecast
from jaxrod.control.identification.windows import MultipleShooting, shots, windows
from jaxrod.control.least_squares import LeastSquares, least_squares
from jaxrod.control.linearisation import Linearisation, linearise
from jaxrod.control.local_coordinates import (
    LocalCoordinates,
    local_coordinates,
)
from jaxrod.control.mpc import PlanningPolicy, mpc
from jaxrod.control.trajectories.adam import adam
from jaxrod.control.trajectories.ilqr import ilqr
from jaxrod.control.trajectories.levenberg_marquardt import (
    codesign,
    levenberg_marquardt,
)
from jaxrod.control.trajectories.problem import (
    Problem,
    RolledOut,
    make_problem,
    rolled_out,
)
from jaxrod.control.trajectories.reach import (
    ActuatedArm,
    Reach,
    UnreachableTargetWarning,
    reach,
)
from jaxrod.control.trajectories.sampling import cross_entropy, mppi
from jaxrod.control.trajectories.solution import Solution

__all__ = [
    "ActuatedArm",
    "Fit",
    "Forecast",
    "LeastSquares",
    "Linearisation",
    "LocalCoordinates",
    "MultipleShooting",
    "Parameters",
    "PlanningPolicy",
    "Problem",
    "Reach",
    "RolledOut",
    "ShapeMatch",
    "Solution",
    "UnreachableTargetWarning",
    "adam",
    "codesign",
    "cross_entropy",
    "estimation",
    "fit",
    "ilqr",
    "least_squares",
    "levenberg_marquardt",
    "linearise",
    "local_coordinates",
    "make_parameters",
    "make_problem",
    "match_shape",
    "mpc",
    "mppi",
    "reach",
    "rolled_out",
    "shots",
    "windows",
]

if not TYPE_CHECKING:
    __getattr__ = partial(jaxrod.spelling.no_such_name, __name__)

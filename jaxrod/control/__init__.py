"""Differentiable control: problems, and solvers by gradients and by sampling."""

from jaxrod.control.adam import adam
from jaxrod.control.arm import ActuatedArm
from jaxrod.control.codesign import codesign
from jaxrod.control.fit import Fit, Forecast
from jaxrod.control.identify import identify
from jaxrod.control.identify_continuous import identify_continuous
from jaxrod.control.identify_shots import identify_shots
from jaxrod.control.ilqr import ilqr
from jaxrod.control.least_squares import LeastSquares, least_squares
from jaxrod.control.levenberg_marquardt import levenberg_marquardt
from jaxrod.control.match_shape import ShapeMatch, match_shape
from jaxrod.control.mpc import mpc
from jaxrod.control.parameters import Parameters, make_parameters
from jaxrod.control.planning_policy import PlanningPolicy
from jaxrod.control.problem import Problem, make_problem
from jaxrod.control.reach import Reach, UnreachableTargetWarning, reach
from jaxrod.control.rolled_out import RolledOut, rolled_out
from jaxrod.control.sampling import cross_entropy, mppi
from jaxrod.control.shots import shots, windows
from jaxrod.control.solution import Solution

__all__ = [
    "ActuatedArm",
    "Fit",
    "Forecast",
    "LeastSquares",
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
    "identify",
    "identify_continuous",
    "identify_shots",
    "ilqr",
    "least_squares",
    "levenberg_marquardt",
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

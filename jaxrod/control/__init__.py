"""Differentiable control: problems, and solvers by gradients and by sampling."""

from jaxrod.control.identification.fit import Fit, Forecast
from jaxrod.control.identification.identify import identify
from jaxrod.control.identification.identify_continuous import identify_continuous
from jaxrod.control.identification.identify_shots import identify_shots
from jaxrod.control.identification.match_shape import ShapeMatch, match_shape
from jaxrod.control.identification.parameters import Parameters, make_parameters
from jaxrod.control.identification.shots import shots, windows
from jaxrod.control.least_squares import LeastSquares, least_squares
from jaxrod.control.planning.mpc import mpc
from jaxrod.control.planning.policy import PlanningPolicy
from jaxrod.control.trajectories.adam import adam
from jaxrod.control.trajectories.arm import ActuatedArm
from jaxrod.control.trajectories.codesign import codesign
from jaxrod.control.trajectories.ilqr import ilqr
from jaxrod.control.trajectories.levenberg_marquardt import levenberg_marquardt
from jaxrod.control.trajectories.problem import Problem, make_problem
from jaxrod.control.trajectories.reach import Reach, UnreachableTargetWarning, reach
from jaxrod.control.trajectories.rolled_out import RolledOut, rolled_out
from jaxrod.control.trajectories.sampling import cross_entropy, mppi
from jaxrod.control.trajectories.solution import Solution

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

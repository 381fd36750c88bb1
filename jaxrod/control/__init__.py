"""Differentiable control: problems, and solvers by gradients and by sampling."""

from jaxrod.control.least_squares import LeastSquares, least_squares
from jaxrod.control.mpc import mpc
from jaxrod.control.planning_policy import PlanningPolicy
from jaxrod.control.problem import Problem, make_problem

__all__ = [
    "LeastSquares",
    "PlanningPolicy",
    "Problem",
    "least_squares",
    "make_problem",
    "mpc",
]

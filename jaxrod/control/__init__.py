"""Differentiable control: problems, and solvers by gradients and by sampling."""

from jaxrod.control.least_squares import LeastSquares, least_squares
from jaxrod.control.problem import Problem, make_problem

__all__ = [
    "LeastSquares",
    "Problem",
    "least_squares",
    "make_problem",
]

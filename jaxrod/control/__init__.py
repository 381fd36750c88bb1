"""Differentiable control: problems, and solvers by gradients and by sampling."""

from jaxrod.control.fit import Fit, Forecast
from jaxrod.control.identify import identify
from jaxrod.control.least_squares import LeastSquares, least_squares
from jaxrod.control.match_shape import ShapeMatch, match_shape
from jaxrod.control.parameters import Parameters, make_parameters
from jaxrod.control.problem import Problem, make_problem
from jaxrod.control.shots import shots, windows

__all__ = [
    "Fit",
    "Forecast",
    "LeastSquares",
    "Parameters",
    "Problem",
    "ShapeMatch",
    "identify",
    "least_squares",
    "make_parameters",
    "make_problem",
    "match_shape",
    "shots",
    "windows",
]

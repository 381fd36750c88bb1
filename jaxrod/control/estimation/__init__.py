"""State estimation: an extended Kalman filter and a moving-horizon estimator."""

from functools import partial
from typing import TYPE_CHECKING

import jaxrod.spelling
from jaxrod.control.estimation.horizon import Horizon, moving_horizon
from jaxrod.control.estimation.kalman import Update, predict, update
from jaxrod.control.estimation.process import (
    Estimate,
    Process,
    first_estimate,
    make_process,
)

__all__ = [
    "Estimate",
    "Horizon",
    "Process",
    "Update",
    "first_estimate",
    "make_process",
    "moving_horizon",
    "predict",
    "update",
]

if not TYPE_CHECKING:
    __getattr__ = partial(jaxrod.spelling.no_such_name, __name__)

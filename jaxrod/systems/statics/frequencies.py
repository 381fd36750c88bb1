"""Frequencies of small motions of a system about a state at rest."""

from __future__ import annotations

import jax
import numpy as np

from jaxrod.systems.statics.problem import Linear, static_problem
from jaxrod.systems.stepping.assembly import Assembly, SystemState


def squared_frequencies(system: Assembly, state: SystemState) -> np.ndarray:
    """Squares of all angular frequencies, increasing [rad^2/s^2].

    They are computed in a basis of the rates that supports, ties and attachments allow.

    Raises:
        ValueError: If a number is traced.
    """
    here = _linear(system, state)
    projection = np.asarray(here.projection, np.float64)
    left, shares, _ = np.linalg.svd(projection)
    basis = left[:, : round(float(np.trace(projection)))]
    assert np.all(shares[: basis.shape[1]] > 0.5)
    stiffness = basis.T @ np.asarray(here.stiffness, np.float64) @ basis
    mass = basis.T @ np.asarray(here.mass, np.float64) @ basis
    inverse = np.linalg.inv(np.linalg.cholesky(0.5 * (mass + mass.T)))
    squares = inverse @ (0.5 * (stiffness + stiffness.T)) @ inverse.T
    found: np.ndarray = np.linalg.eigvalsh(0.5 * (squares + squares.T))
    return found


@jax.jit
def _linear(system: Assembly, state: SystemState) -> Linear:
    problem, start = static_problem(system, state)
    return problem.linear(start)

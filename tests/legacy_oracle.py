"""The published arm in plain NumPy, written from its description, to compare with.

Directors are matrices, vectors are rows of arrays, the spline is SciPy's: nothing is
shared with the library.
"""

from __future__ import annotations

import itertools

import numpy as np
from scipy.interpolate import make_interp_spline

N = 20
LENGTH, RADIUS, DENSITY, YOUNG, VISCOSITY, TORQUE = 1.0, 0.05, 1e3, 1e7, 30.0, 75.0
SHEAR = YOUNG / 1.5
AREA = np.pi * RADIUS**2
SECOND_MOMENT = AREA**2 / (4 * np.pi)
REST = LENGTH / N
S = np.array([4 / 3 * SHEAR * AREA, 4 / 3 * SHEAR * AREA, YOUNG * AREA])
B = np.array([YOUNG, YOUNG, 2 * SHEAR]) * SECOND_MOMENT
J = DENSITY * REST * SECOND_MOMENT * np.array([1.0, 1.0, 2.0])
MASS = np.full(N + 1, DENSITY * AREA * REST)
MASS[[0, -1]] /= 2


class LegacyArm:
    """The arm of Cases 1 and 2: along +y from the origin, d1 along +z."""

    def __init__(self):
        self.x = np.linspace([0, 0, 0], [0, LENGTH, 0], N + 1)
        self.frame0 = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
        self.Q = np.repeat(self.frame0[None], N, axis=0)
        self.v = np.zeros((N + 1, 3))
        self.w = np.zeros((N, 3))

    def control_step(self, action, dt=2e-4, substeps=7):
        """Applies an action of 12 control values for one control period."""
        couples = None
        for _ in range(substeps):
            self._drift(dt / 2)
            if couples is None:
                couples = self._muscles(action)
            self._kick(dt, couples)
            self._drift(dt / 2)

    def _lengths(self):
        return np.linalg.norm(np.diff(self.x, axis=0), axis=1)

    def _muscles(self, action):
        knots = np.arange(8) / 7 * LENGTH
        far_ends = np.cumsum(self._lengths())
        couples = np.zeros((N, 3))
        for axis, values in enumerate(np.reshape(action, (2, 6))):
            spline = make_interp_spline(knots, np.concatenate([[0], values, [0]]))
            couples[:, axis] = TORQUE * spline(far_ends)
        return couples

    def _drift(self, h):
        self.x = self.x + h * self.v
        self.Q = np.stack(
            [_turn(-h * w) @ Q for w, Q in zip(self.w, self.Q, strict=True)]
        )
        self.x[0] = 0.0
        self.Q[0] = self.frame0

    def _kick(self, h, couples):
        edges = np.diff(self.x, axis=0)
        lengths = self._lengths()
        e = (lengths / REST)[:, None]
        tangents = edges / lengths[:, None]
        local = np.einsum("kij,kj->ki", self.Q, tangents)
        sigma = e * local - [0, 0, 1]
        n = S * sigma
        force = np.einsum("kji,kj->ki", self.Q, n) / e
        eps = ((lengths[1:] + lengths[:-1]) / 2 / REST)[:, None]
        kappa = np.stack([_log(b @ a.T) / REST for a, b in itertools.pairwise(self.Q)])
        tau = B * kappa
        zero = np.zeros((1, 3))
        bend = np.diff(np.concatenate([zero, tau / eps**3, zero]), axis=0)
        half = np.cross(kappa, tau) * REST / eps**3
        bend += (np.concatenate([zero, half]) + np.concatenate([half, zero])) / 2
        stretch = np.cross(local, n) * REST
        rates = np.diff(self.v, axis=0)
        e_rate = (np.sum(edges * rates, axis=1) / (lengths * REST))[:, None]
        spin = J * self.w / e
        gyro = np.cross(spin, self.w) + spin * e_rate / e
        drag = -VISCOSITY * (self.v[1:] + self.v[:-1]) / 2 * lengths[:, None]
        turn_drag = -VISCOSITY * self.w * lengths[:, None]

        nodal = np.diff(np.concatenate([zero, force, zero]), axis=0)
        nodal += (np.concatenate([zero, drag]) + np.concatenate([drag, zero])) / 2
        torque = bend + stretch + gyro + turn_drag + couples
        self.v = self.v + h * nodal / MASS[:, None]
        self.w = self.w + h * e * torque / J
        self.v[0] = 0.0
        self.w[0] = 0.0


def _turn(vector):
    """The matrix exp([vector]x)."""
    angle = np.linalg.norm(vector)
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def _log(matrix):
    """The vector phi for which the matrix is exp(-[phi]x)."""
    angle = np.arccos(np.clip((np.trace(matrix) - 1) / 2, -1, 1))
    if angle < 1e-12:
        return np.zeros(3)
    skew = np.array(
        [
            matrix[2, 1] - matrix[1, 2],
            matrix[0, 2] - matrix[2, 0],
            matrix[1, 0] - matrix[0, 1],
        ]
    )
    return -angle / (2 * np.sin(angle)) * skew

"""The published arm in plain NumPy, written from its description, to compare with.

Directors are matrices, vectors are rows of arrays, the spline is SciPy's, contact is
two loops: nothing is shared with the library.
"""

from __future__ import annotations

import itertools

import numpy as np
from scipy.interpolate import make_interp_spline

LENGTH, RADIUS, DENSITY, YOUNG, VISCOSITY, TORQUE = 1.0, 0.05, 1e3, 1e7, 30.0, 75.0
SHEAR = YOUNG / 1.5
AREA = np.pi * RADIUS**2
SECOND_MOMENT = AREA**2 / (4 * np.pi)
S = np.array([4 / 3 * SHEAR * AREA, 4 / 3 * SHEAR * AREA, YOUNG * AREA])
B = np.array([YOUNG, YOUNG, 2 * SHEAR]) * SECOND_MOMENT

UPRIGHT = ([0.0, 0, 1], [1, 0, 0], [0, 1, 0])
"""Rows d1, d2, d3 in Cases 1 and 2."""
ALONG_Z = ([0.0, 1, 0], [-1, 0, 0], [0, 0, 1])
"""Rows d1, d2, d3 in Cases 3 and 4."""


class OracleArm:
    """The arm of a case, by default that of Cases 1 and 2."""

    def __init__(
        self,
        n=20,
        base=(0.0, 0.0, 0.0),
        frame=UPRIGHT,
        knots=np.arange(1, 7) / 7,
        rate=np.inf,
        obstacles=(),
    ):
        self.n, self.rate, self.obstacles = n, rate, obstacles
        self.rest = LENGTH / n
        self.knots = np.concatenate([[0], knots, [LENGTH]])
        self.inertia = DENSITY * self.rest * SECOND_MOMENT * np.array([1.0, 1.0, 2.0])
        self.mass = np.full(n + 1, DENSITY * AREA * self.rest)
        self.mass[[0, -1]] /= 2
        self.base, self.frame0 = np.asarray(base), np.asarray(frame, float)
        self.x = self.base + np.linspace(0, LENGTH, n + 1)[:, None] * self.frame0[2]
        self.Q = np.repeat(self.frame0[None], n, axis=0)
        self.v = np.zeros((n + 1, 3))
        self.w = np.zeros((n, 3))
        self.applied = np.zeros((3, len(knots)))
        self.couples = np.zeros((n, 3))

    def control_step(self, action, dt=2e-4, substeps=7):
        """Applies control values, d1's first, for one control period."""
        rows = np.reshape(action, (-1, self.applied.shape[1]))
        commanded = np.zeros_like(self.applied)
        commanded[: len(rows)] = rows
        for _ in range(substeps):
            self._drift(dt / 2)
            self._contract(commanded)
            self._kick(dt)
            self._drift(dt / 2)

    def _lengths(self):
        return np.linalg.norm(np.diff(self.x, axis=0), axis=1)

    def _contract(self, commanded):
        far_ends = np.cumsum(self._lengths())
        for axis, (now, wanted) in enumerate(zip(self.applied, commanded, strict=True)):
            if np.array_equal(now, wanted):
                continue
            missing = wanted - now
            now += np.sign(missing) * np.minimum(self.rate, np.abs(missing))
            values = make_interp_spline(self.knots, np.concatenate([[0], now, [0]]))
            self.couples[:, axis] = TORQUE * values(far_ends)

    def _drift(self, h):
        self.x = self.x + h * self.v
        self.Q = np.stack(
            [_turn(-h * w) @ Q for w, Q in zip(self.w, self.Q, strict=True)]
        )
        self.x[0] = self.base
        self.Q[0] = self.frame0

    def _kick(self, h):
        edges = np.diff(self.x, axis=0)
        lengths = self._lengths()
        e = (lengths / self.rest)[:, None]
        tangents = edges / lengths[:, None]
        local = np.einsum("kij,kj->ki", self.Q, tangents)
        sigma = e * local - [0, 0, 1]
        n = S * sigma
        force = np.einsum("kji,kj->ki", self.Q, n) / e
        eps = ((lengths[1:] + lengths[:-1]) / 2 / self.rest)[:, None]
        pairs = itertools.pairwise(self.Q)
        kappa = np.stack([_log(b @ a.T) / self.rest for a, b in pairs])
        tau = B * kappa
        zero = np.zeros((1, 3))
        bend = np.diff(np.concatenate([zero, tau / eps**3, zero]), axis=0)
        half = np.cross(kappa, tau) * self.rest / eps**3
        bend += (np.concatenate([zero, half]) + np.concatenate([half, zero])) / 2
        stretch = np.cross(local, n) * self.rest
        rates = np.diff(self.v, axis=0)
        e_rate = (np.sum(edges * rates, axis=1) / (lengths * self.rest))[:, None]
        spin = self.inertia * self.w / e
        gyro = np.cross(spin, self.w) + spin * e_rate / e
        drag = -VISCOSITY * (self.v[1:] + self.v[:-1]) / 2 * lengths[:, None]
        turn_drag = -VISCOSITY * self.w * lengths[:, None]

        nodal = np.diff(np.concatenate([zero, force, zero]), axis=0)
        nodal += (np.concatenate([zero, drag]) + np.concatenate([drag, zero])) / 2
        radii = RADIUS * np.sqrt(self.rest / lengths)
        for obstacle in self.obstacles:
            obstacle.push(self.x, self.v, radii, nodal)
        torque = bend + stretch + gyro + turn_drag + self.couples
        self.v = self.v + h * nodal / self.mass[:, None]
        self.w = self.w + h * e * torque / self.inertia
        self.v[0] = 0.0
        self.w[0] = 0.0


class Obstacle:
    """One fixed cylinder and the published law of contact with it."""

    def __init__(self, start, direction, normal, length, radius, k=8e4, nu=4.0):
        self.start = np.asarray(start, float)
        self.direction = np.asarray(direction, float)
        self.edge = length * self.direction
        normal = np.asarray(normal, float)
        frame = [normal, np.cross(self.direction, normal), self.direction]
        self.half_box = np.abs(np.array([radius, radius, length / 2]) @ frame)
        self.length, self.radius, self.k, self.nu = length, radius, k, nu

    def push(self, x, v, radii, forces):
        """Changes the forces on the nodes."""
        edges = np.diff(x, axis=0)
        lengths = np.linalg.norm(edges, axis=1)
        margin = radii.max() + lengths.max()
        centre = self.start + self.edge / 2
        if np.any(centre + self.half_box < x.min(axis=0) - margin) or np.any(
            centre - self.half_box > x.max(axis=0) + margin
        ):
            return
        taken = np.zeros(3)
        for i, edge in enumerate(edges):
            reach = radii[i] + self.radius
            if np.linalg.norm(x[i] - self.start) >= reach + lengths[i] + self.length:
                continue
            apart = shortest(x[i], edge, self.start, self.edge)
            distance = np.linalg.norm(apart)
            normal = apart / distance
            overlap = reach - distance
            if overlap < -1e-5:
                continue
            pressing = (forces[i] + forces[i + 1]) / 2 - taken
            force = max(0.0, pressing @ normal)
            if overlap > 0:
                speed = (v[i] + v[i + 1]) / 2 @ normal
                force += (self.k * overlap + self.nu * speed) / 2
            share = 0.5 if i == 0 else 1.0
            forces[i] -= share * force * normal
            forces[i + 1] -= force * normal
            taken += (1 + share) * force * normal


def shortest(x1, e1, x2, e2):
    """The shortest vector from segment x1 + t e1 to segment x2 + s e2, 0 <= s, t <= 1.

    Where both lines are closest, if that is within both; else at one of the four ends.
    """
    system = np.array([[e1 @ e1, -(e1 @ e2)], [-(e1 @ e2), e2 @ e2]])
    offset = x2 - x1
    candidates = []
    if np.linalg.det(system) > 1e-12 * system[0, 0] * system[1, 1]:
        candidates.append(np.linalg.solve(system, [offset @ e1, -(offset @ e2)]))
    for t in (0.0, 1.0):
        candidates.append([t, (t * e1 - offset) @ e2 / (e2 @ e2)])
    for s in (0.0, 1.0):
        candidates.append([(offset + s * e2) @ e1 / (e1 @ e1), s])
    clipped = np.clip(candidates, 0, 1)
    vectors = offset + clipped[:, 1:] * e2 - clipped[:, :1] * e1
    return vectors[np.argmin(np.linalg.norm(vectors, axis=1))]


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

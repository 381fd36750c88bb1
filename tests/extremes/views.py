"""Views of one scene: moved, turned, in other units, from the other end, reordered.

A scene is made from numbers in SI units as seen in a view. Whatever the view, what it
does is the same: `told` says in SI units and in the first frame what came out of it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import jax.numpy as jnp
import numpy as np

import jaxrod

UNITS = {"m": (1, 0, 0), "kg": (0, 1, 0), "s": (0, 0, 1), "N": (1, 1, -2)}
UNITS |= {"Pa": (-1, 1, -2), "T": (0, 1, -2), "A": (0, 0, 0), "1": (0, 0, 0)}
"""Exponents of length, mass and time; electric current keeps its unit."""
Draws = tuple[np.random.Generator, np.random.Generator]
"""Two generators: of all static choices, and of numbers."""
HALF_TURN = np.array([1.0, -1.0, -1.0])
"""A half turn about d1: what the frame of an element is from the rod's other end."""


@dataclass(frozen=True)
class View:
    """A way to look at a scene."""

    turn: np.ndarray = field(default_factory=lambda: np.eye(3))
    """Rotation from the first frame to this one."""
    shift: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """Place of the first frame's origin [m]."""
    units: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Numbers that a metre, a kilogram and a second are."""
    shuffled: int | None = None
    """Seed of another order of effects, members and couplings."""
    exchanged: bool = False
    """Whether the two sides of a coupling change places."""
    halved: bool = False
    """Whether what can be is two of half its strength."""
    crowded: bool = False
    """Whether a rod far away is there too."""
    reversed: bool = False
    """Whether the first rod runs from its last node to its first."""

    def number(self, value: Any, unit: str = "1") -> Any:
        """A number of a unit such as "kg m^-3"."""
        return np.asarray(value, float) * self._size(unit)

    def _size(self, unit: str) -> float:
        size = 1.0
        for word in unit.split():
            name, _, power = word.partition("^")
            for own, exponent in zip(self.units, UNITS[name], strict=True):
                size *= own ** (exponent * int(power or 1))
        return size

    def vector(self, value: Any, unit: str = "1") -> np.ndarray:
        """A vector of the world `(3,)` or `(3, n)`."""
        return self.turn @ self.number(value, unit)

    def place(self, value: Any) -> np.ndarray:
        """A point of the world [m], `(3,)` or `(3, n)`."""
        shift = self.shift if np.ndim(value) == 1 else self.shift[:, None]
        return self.number(self.turn @ np.asarray(value, float) + shift, "m")

    def quaternion(self, value: Any) -> np.ndarray:
        """An orientation."""
        return product(of_matrix(self.turn), np.asarray(value, float))

    def end(self, name: str) -> str:
        """An end of the first rod."""
        return {"base": "tip", "tip": "base"}[name] if self.reversed else name

    def node(self, number: int, n: int) -> int:
        """A node of the first rod, which has `n` elements."""
        return n - number if self.reversed else number

    def along(self, values: Any) -> np.ndarray:
        """Values along the first rod, its last axis."""
        values = np.asarray(values, float)
        return values[..., ::-1].copy() if self.reversed else values

    def material(self, vector: Any, unit: str = "1") -> np.ndarray:
        """A vector in the frame of elements of the first rod."""
        vector = self.number(vector, unit)
        if not self.reversed:
            return vector
        return HALF_TURN.reshape((3,) + (1,) * (vector.ndim - 1)) * vector

    def bent(self, strain: Any, unit: str = "m^-1") -> np.ndarray:
        """A curvature and twist, or shear and stretch, of the first rod."""
        return (
            -self.material(strain, unit) if self.reversed else self.number(strain, unit)
        )

    def offsets(self, values: Any) -> np.ndarray:
        """Offsets along d1 and d2 of the first rod `(..., 2)` [m]."""
        values = self.number(values, "m")
        return values * np.array([1.0, -1.0]) if self.reversed else values

    def order(self, things: list[Any]) -> list[Any]:
        """Things, perhaps in another order."""
        if self.shuffled is None:
            return things
        random = np.random.default_rng([self.shuffled, len(things)])
        return [things[k] for k in random.permutation(len(things))]


def draws_of(seed: int, draw: int) -> Draws:
    """Generators of a structure of a seed, and of one of its sets of numbers."""
    return np.random.default_rng([seed, 2]), np.random.default_rng([seed, 3, draw])


def of_matrix(matrix: Any) -> np.ndarray:
    """Quaternion of a rotation, by the row that loses nothing."""
    m = np.asarray(matrix)
    k = np.array(
        [
            [
                m[0, 0] + m[1, 1] + m[2, 2],
                m[2, 1] - m[1, 2],
                m[0, 2] - m[2, 0],
                m[1, 0] - m[0, 1],
            ],
            [0, m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
            [0, 0, m[1, 1] - m[0, 0] - m[2, 2], m[1, 2] + m[2, 1]],
            [0, 0, 0, m[2, 2] - m[0, 0] - m[1, 1]],
        ]
    )
    values, vectors = np.linalg.eigh(k + np.triu(k, 1).T)
    return vectors[:, np.argmax(values)]


def product(a: Any, b: Any) -> np.ndarray:
    """Product of quaternions."""
    p, q = np.asarray(a), np.asarray(b)
    scalar = p[0] * q[0] - p[1:] @ q[1:]
    return np.concatenate(
        [[scalar], p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])]
    )


def random_turn(random: np.random.Generator) -> np.ndarray:
    """A rotation, all alike likely."""
    q, r = np.linalg.qr(random.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def about_axis(axis: int, angle: float) -> np.ndarray:
    """A rotation about an axis of the world."""
    turn = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    turn[i, i] = turn[j, j] = np.cos(angle)
    turn[i, j], turn[j, i] = -np.sin(angle), np.sin(angle)
    return turn


def told(
    view: View, before: Any, after: Any, *, first: bool, twists: bool = True
) -> dict[str, np.ndarray]:
    """A member's state after a run in SI units and the first frame.

    Args:
        view: The view in which it ran.
        before: The state before.
        after: The state after.
        first: Whether it is the first rod, which may run the other way.
        twists: Whether frames mean something but for their last direction.
    """
    back = view.turn.T
    flip = view.along if first else np.asarray
    places = np.asarray(after.positions) / view._size("m") - view.shift[:, None]
    frames = [np.moveaxis(np.asarray(s.directors), 2, 0) for s in (before, after)]
    # Directors are rows; what turns the one frame into the other, in the world.
    turned = np.einsum("kij,kil->jlk", frames[1], frames[0])
    turned = np.einsum("ij,jlk,lm->imk", back, turned, view.turn)
    if not twists:
        sign = -1.0 if view.reversed else 1.0
        turned = sign * back @ frames[1][:, 2].T
    found = {
        "positions": flip(back @ places),
        "velocities": flip(back @ np.asarray(after.velocities) / view._size("m s^-1")),
        "turned": flip(turned),
    }
    if isinstance(after, jaxrod.RodState):
        spin = np.asarray(after.angular_momenta) / view._size("kg m^2 s^-1")
    else:
        spin = np.asarray(after.angular_velocities) / view._size("s^-1")
    return found | {"spin": flip(back @ spin)}


def shaken(state: Any, size: float, extent: float, random: Any) -> Any:
    """A state in which all is off by a share of what it is, of places of an extent."""

    def moved(leaf: Any, scale: float) -> Any:
        values = np.asarray(leaf)
        return jnp.asarray(values + size * scale * random.normal(size=values.shape))

    def one(own: Any) -> Any:
        new = {"positions": moved(own.positions, extent)}
        turned = np.asarray(moved(own.orientations, 1.0))
        new["orientations"] = jnp.asarray(turned / np.linalg.norm(turned, axis=0))
        for name in ("velocities", "angular_momenta", "angular_velocities"):
            if hasattr(own, name):
                values = getattr(own, name)
                new[name] = moved(values, float(np.max(np.abs(values))))
        return replace(own, **new)

    if isinstance(state, dict):
        return {
            name: one(own) if hasattr(own, "positions") else own
            for name, own in state.items()
        }
    return one(state)

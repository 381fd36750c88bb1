r"""The ends of a rod in contact: the same law on every grid.

An end has a face, and a force there has nothing beside it to share it. With the half
spacing that the trapezoidal rule gives it, an end that is pushed along the rod would be
the softer the finer the grid. So the length that a free end stands for depends on how
the rod meets the surface. With the penetration $p$ of the end, the spacing $h$ of the
points, the radius $a$, and the rise $m = d\phi/ds \ge 0$ of the distance $\phi$ from
the end along the rod, the sine of its angle to a plane, it is

$$\ell = \frac{h}{2}\,\frac{p}{\sqrt[4]{p^4 + (3hm/2)^4}} + 2 a m^2.$$

- A rod that lies on a plane, $m = 0$, is counted by the trapezoidal rule and rests at
  a penetration of $W/kL$. The power keeps it stable there: with squares the energy
  would fall where a limp rod tilts.
- One that stands or leans, $m > 0$, is pushed with $k(2 a m^2 p + p^2/2m)$ on every
  grid. Its face counts as much length as the rod is thick; the rest is of its side.

The energy has this length in it. Its derivative by $m$ is a pair of forces along the
normals at the end and at a place beside it, between which the rise is taken: an element
or a radius away, whichever is more, but no more than half the rod.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.structure import pytree

MOST_RATIO = 1e6
"""Rise over an end's own length, over its penetration; its fourth power is finite in
single precision, and no side is left to count long before [1]."""


@pytree
class Ends:
    """Both ends of each of some rods, whose contact points stand in one row."""

    half_spacings: Float[Array, " ends"]
    """Lengths that the trapezoidal rule gives them [m]."""
    radii: Float[Array, " ends"]
    """Radii of the faces [m]."""
    free: Float[Array, " ends"]
    """One where the end is free, zero where the rod goes on in another [1]."""
    reaches: Float[Array, " ends"]
    """Rest lengths to the places beside them [m]."""
    shares: Float[Array, "rods 2 points"]
    """Shares of the points of a rod in the places beside its ends [1]."""

    def of_points(self, field: Array) -> Float[Array, " ends"]:
        """A field on the points, at the ends."""
        rods = field.reshape(len(self.shares), -1)
        return jnp.concatenate([rods[:, :1], rods[:, -1:]], axis=1).reshape(-1)

    def beside(self, field: Vec3) -> Vec3:
        """A field of vectors on the points, at the places beside the ends."""

        def one(component: Array) -> Array:
            rods = component.reshape(len(self.shares), 1, -1)
            return jnp.sum(self.shares * rods, axis=2).reshape(-1)

        return one(field[0]), one(field[1]), one(field[2])

    def to_points(self, values: Float[Array, " ends"]) -> Array:
        """Numbers at the ends, in a row that is zero elsewhere."""
        rods, others = values.reshape(-1, 2), self.shares.shape[2] - 1
        first = vectors.pad(rods[:, :1], 0, others)
        return (first + vectors.pad(rods[:, 1:], others, 0)).reshape(-1)

    def from_beside(self, values: Float[Array, " ends"]) -> Array:
        """A component of forces at the places beside the ends, on the points."""
        return jnp.sum(self.shares * values.reshape(-1, 2, 1), axis=1).reshape(-1)

    def counted(
        self,
        own: Float[Array, " ends"],
        beside: Float[Array, " ends"],
        depth: Callable[[Array], Array],
    ) -> Float[Array, " ends"]:
        """Lengths that the ends stand for at a surface [m]; see the module.

        Args:
            own: Distances of the ends from the surface [m].
            beside: Distances of the places beside them [m].
            depth: Penetrations by distances; positive, whatever it is where there is
                none [m].
        """
        depths = depth(own)
        rise = jnp.maximum((beside - own) / self.reaches, 0)
        ratio = jnp.minimum(3 * self.half_spacings * rise / depths, MOST_RATIO)
        square = ratio * ratio
        line = jax.lax.rsqrt(jnp.sqrt(1 + square * square))
        counted = self.half_spacings * line + 2 * self.radii * rise * rise
        return self.free * counted + (1 - self.free) * self.half_spacings

    def counted_and_changes(
        self,
        own: Float[Array, " ends"],
        beside: Float[Array, " ends"],
        depth: Callable[[Array], Array],
        density: Float[Array, " ends"],
    ) -> tuple[Array, Array, Array]:
        """Lengths of the ends [m], and the forces by which they change.

        Args:
            own: As for `counted`.
            beside: As for `counted`.
            depth: As for `counted`.
            density: Energy per length at the ends [J/m].

        Returns:
            The lengths, and forces along the normals at the ends and beside them [N].
        """
        counted, pulled = jax.vjp(
            lambda own, beside: self.counted(own, beside, depth), own, beside
        )
        by_own, by_beside = pulled(density)
        return counted, -by_own, -by_beside

    def longest(self) -> Array:
        """Largest lengths that the ends stand for, in a row of the points [m]."""
        return self.to_points(self.half_spacings + 2 * self.free * self.radii)

    def bound(self) -> Array:
        """Lengths in an upper bound of the stiffness, in a row of the points [m].

        For penetrations up to a quarter of the radius, which is a share c of the way to
        the place beside. The Hessian of the energy over the stiffness is at most 1.3
        and .43 half spacings, of the end and of the place beside it, and 1 + 6c + 2c^2
        and 2c + 2c^2 times the thickness.
        """
        c = 0.25 * self.radii / self.reaches
        thickness = 2 * self.radii
        own = 1.3 * self.half_spacings + (1 + 6 * c + 2 * c * c) * thickness
        own = self.free * own + (1 - self.free) * self.half_spacings
        beside = 0.43 * self.half_spacings + 2 * (c + c * c) * thickness
        beside = self.free * beside
        return self.to_points(own) + self.from_beside(beside)


def ends_of(
    rest_lengths: Float[Array, " n"],
    radii: Float[Array, " n"],
    per_element: int,
    free: Float[Array, "2"] | None = None,
) -> Ends:
    """The ends of a rod among its nodes.

    Args:
        rest_lengths: Of the elements [m].
        radii: Of the elements [m].
        per_element: Contact points per element.
        free: One for the first and the last end if it is free, zero where the rod goes
            on in another; both are free by default.
    """

    def at_start(lengths: Array, radius: Array) -> tuple[Array, Array]:
        """Rest length to the place beside the first end, and shares of the nodes."""
        reach = jnp.maximum(lengths[0], jnp.minimum(radius, 0.5 * jnp.sum(lengths)))
        before = jnp.cumsum(lengths) - lengths
        passed = jnp.clip((reach - before) / lengths, 0, 1)
        whole = vectors.pad(jnp.ones_like(lengths[:1]), 0, len(lengths))
        return reach, whole + vectors.pad(passed, 1, 0) - vectors.pad(passed, 0, 1)

    first, shares_of_first = at_start(rest_lengths, radii[0])
    last, shares_of_last = at_start(rest_lengths[::-1], radii[-1])
    outer = jnp.stack([rest_lengths[0], rest_lengths[-1]])
    return Ends(
        half_spacings=outer / (2 * per_element),
        radii=jnp.stack([radii[0], radii[-1]]),
        free=jnp.ones_like(outer) if free is None else free,
        reaches=jnp.stack([first, last]),
        shares=jnp.stack([shares_of_first, shares_of_last[::-1]])[None],
    )

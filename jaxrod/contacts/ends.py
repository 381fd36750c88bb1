r"""The ends of a rod in contact: the same law on every grid.

The end face takes forces that no neighbouring point shares. If an end counted only half
a spacing (the trapezoidal rule), then finer grids would make it softer under a push
along the rod. So the length that a free end stands for depends on how the rod meets the
surface. Let $p$ be the penetration of the end, $h$ the spacing of the points, $a$ the
radius, and $m = d\phi/ds \ge 0$ the rise of the distance $\phi$ from the end along the
rod, which is the sine of the rod's angle to a plane. The length is

$$\ell = \frac{h}{2}\,\frac{p}{\sqrt[4]{p^4 + (3hm/2)^4}} + 2 a m^2.$$

- A rod that lies on a plane, $m = 0$, is counted by the trapezoidal rule and rests at
  a penetration of $W/kL$. The fourth power keeps it stable there: with squares the
  energy of a limp rod would fall as it tilts.
- A rod that stands or leans, $m > 0$, is pushed with $k(2 a m^2 p + p^2/2m)$ on every
  grid. Its face counts as much length as the rod is thick; the rest comes from its
  side.

Friction is at most its coefficient times this force. At a constant m it is the force at
the point itself, k l p, and the energy per length times dl/dp (`Ends.deepened`).

The energy is proportional to this length. Its derivative with respect to $m$ is a pair
of forces along the normals at the end and at a point beside it, between which the rise
is measured. This point is one element away, or a radius but at most half the rod,
whichever is farther.
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
"""Upper bound of the ratio 3hm/2p, with the spacing h of contact points, the slope m of
the distance along the rod and the penetration p [1]. Its fourth power is finite in
single precision. Even at much smaller ratios the side of the rod hardly counts."""


@pytree
class Ends:
    """Ends of one or several rods, in the order: first and last end of each rod."""

    half_spacings: Float[Array, " ends"]
    """Half the spacing of contact points at each end: its length by the trapezoidal
    rule [m]."""
    radii: Float[Array, " ends"]
    """Radius of each end face [m]."""
    free: Float[Array, " ends"]
    """Flags: 1 where the end is free, 0 where the rod continues in another rod [1]."""
    reaches: Float[Array, " ends"]
    """Rest length from each end to the point beside it. The slope of the rod to a
    surface is measured between both [m]."""
    shares: Float[Array, "rods 2 points"]
    """Weights by which a rod's contact points are interpolated at the points beside
    both of its ends [1]."""

    def of_points(self, field: Array) -> Float[Array, " ends"]:
        """Values at the ends of a field on the contact points."""
        rods = field.reshape(len(self.shares), -1)
        return jnp.concatenate([rods[:, :1], rods[:, -1:]], axis=1).reshape(-1)

    def beside(self, field: Vec3) -> Vec3:
        """Vector field at the point beside each end, from values at contact points."""

        def one(component: Array) -> Array:
            rods = component.reshape(len(self.shares), 1, -1)
            return jnp.sum(self.shares * rods, axis=2).reshape(-1)

        return one(field[0]), one(field[1]), one(field[2])

    def to_points(self, values: Float[Array, " ends"]) -> Array:
        """Values at the ends, scattered to the contact points; zero elsewhere."""
        rods, others = values.reshape(-1, 2), self.shares.shape[2] - 1
        first = vectors.pad(rods[:, :1], 0, others)
        return (first + vectors.pad(rods[:, 1:], others, 0)).reshape(-1)

    def from_beside(self, values: Float[Array, " ends"]) -> Array:
        """Forces beside the ends, divided among points: the transpose of `beside`."""
        return jnp.sum(self.shares * values.reshape(-1, 2, 1), axis=1).reshape(-1)

    def counted(
        self,
        own: Float[Array, " ends"],
        beside: Float[Array, " ends"],
        depth: Callable[[Array], Array],
    ) -> Float[Array, " ends"]:
        """Length of rod that multiplies the contact force per length at each end [m].

        It is (h/2) / (1 + (3 h m / (2 p))^4)^(1/4) + 2 a m^2 with the spacing h of the
        contact points, the penetration p, the radius a, and the slope m of the
        distance from the surface, from the end to the point beside it. At an end that
        continues in another rod it is h/2.

        Args:
            own: Distances of the ends from the surface [m].
            beside: Distances of the points beside the ends from the surface [m].
            depth: Function from distances to penetrations [m]. Its values must be
                positive; without contact any positive value will do.
        """
        side, face, _ = self._side_and_face(own, beside, depth(own))
        return self.free * (side + face) + (1 - self.free) * self.half_spacings

    def deepened(
        self,
        own: Float[Array, " ends"],
        beside: Float[Array, " ends"],
        depth: Callable[[Array], Array],
    ) -> Float[Array, " ends"]:
        """Derivative of the logarithm of `counted` by the penetration [1/m].

        The slope of the rod to the surface is constant. Times the energy per length it
        is the force per counted length by which an end presses more than its points do:
        a deeper end has more of its side in contact.

        Args:
            own: Distances of the ends from the surface [m].
            beside: Distances of the points beside the ends from the surface [m].
            depth: Function from distances to penetrations, as for `counted` [m].
        """
        depths = depth(own)
        side, face, fourth = self._side_and_face(own, beside, depths)
        # Both terms of the second factor are at most one: no overflow.
        grows = side / (side + face) * (fourth / (1 + fourth))
        return self.free * grows / depths

    def _side_and_face(
        self, own: Array, beside: Array, depths: Array
    ) -> tuple[Array, Array, Array]:
        """Lengths of side and face of free ends [m], and (3 h m / (2 p))^4 [1]."""
        rise = jnp.maximum((beside - own) / self.reaches, 0)
        ratio = jnp.minimum(3 * self.half_spacings * rise / depths, MOST_RATIO)
        square = ratio * ratio
        fourth = square * square
        line = jax.lax.rsqrt(jnp.sqrt(1 + fourth))
        return self.half_spacings * line, 2 * self.radii * rise * rise, fourth

    def counted_and_changes(
        self,
        own: Float[Array, " ends"],
        beside: Float[Array, " ends"],
        depth: Callable[[Array], Array],
        density: Float[Array, " ends"],
    ) -> tuple[Array, Array, Array]:
        """Lengths of the ends [m], and the forces that changes of the lengths cause.

        Args:
            own: Distances of the ends from the surface [m].
            beside: Distances of the points beside the ends from the surface [m].
            depth: Function from distances to penetrations, as for `counted` [m].
            density: Energy per length at the ends [J/m].

        Returns:
            The lengths, and forces along the normals at the ends and beside them:
            -density times the derivative of the length with respect to the distance
            there [N].
        """
        counted, pulled = jax.vjp(
            lambda own, beside: self.counted(own, beside, depth), own, beside
        )
        by_own, by_beside = pulled(density)
        return counted, -by_own, -by_beside

    def longest(self) -> Array:
        """Largest lengths that ends can stand for, scattered to contact points [m].

        It is half the spacing, plus the diameter for free ends.
        """
        return self.to_points(self.half_spacings + 2 * self.free * self.radii)

    def bound(self) -> Array:
        """Lengths at contact points that bound the stiffness of the ends [m].

        The stiffness is at most these lengths times the stiffness per length. The bound
        holds for penetrations up to a quarter of the radius. This quarter is a fraction
        c of the distance to the point beside the end. The Hessian of the energy over
        the stiffness has two parts. Its part from the half spacing is at most 1.3 half
        spacings for the end and 0.43 half spacings for the point beside it. Its part
        from the thickness is at most 1 + 6c + 2c^2 thicknesses for the end and 2c +
        2c^2 thicknesses for the point beside it.
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
    """Both ends of one rod, whose contact points are its nodes.

    Args:
        rest_lengths: Rest lengths of the elements [m].
        radii: Radii of the elements [m].
        per_element: Number of contact points per element.
        free: Flags of the first and the last end: 1 if the end is free, 0 where the rod
            continues in another rod. Both are free by default.
    """

    def at_start(lengths: Array, radius: Array) -> tuple[Array, Array]:
        """Rest length from the first end to the point beside it; its nodal weights."""
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

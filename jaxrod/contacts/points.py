"""Contact points along a rod, and the transfer of their loads to the rod.

Contact acts per length of rod. Its integral is a sum over points, each weighted by the
length it stands for (the trapezoidal rule), so loads do not depend on the number of
elements. The ends follow a separate law (`jaxrod.contacts.ends`). The points are the
nodes: the tip is one of them, and a force there is a force on a node. Long elements
have more points between their nodes; both nodes share the forces there by the lever
rule. The transfer of loads to the rod is the transpose of the interpolation of its
motion at the points, so no momentum and no power is lost.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from jaxtyping import Array, Float

from jaxrod.contacts.ends import Ends, ends_of
from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.rod import Rod
from jaxrod.structure import pytree
from jaxrod.validation import is_traced, warn


class Points(Protocol):
    """Interface of contact points of a rod: interpolation to them and its transpose."""

    @property
    def lengths(self) -> Array:
        """Rest length of rod that each point stands for, zero at the ends [m]."""

    @property
    def ends(self) -> Ends | None:
        """Ends of the rod, if they are among the points; else `None`."""

    def of_nodes(self, field: Vec3) -> Vec3:
        """Nodal vector field, interpolated at the points."""

    def of_elements(self, field: Array) -> Array:
        """Element field, interpolated at the points."""

    def to_nodes(self, field: Vec3) -> Vec3:
        """Forces at the points, divided between nodes: the transpose of `of_nodes`."""

    def to_elements(self, field: Array) -> Array:
        """Component of couples at points, on elements: transpose of `of_elements`."""


@pytree
class AtNodes:
    """Nodes of a rod as contact points; element fields are averaged by length."""

    lengths: Array
    """Rest length of rod that each point stands for, zero at the ends [m]."""
    ends: Ends
    """Both ends of the rod."""
    share_of_first: Array
    """Weight of each element in the average at its first node [1]."""
    share_of_last: Array
    """Weight of each element in the average at its last node [1]."""

    def of_nodes(self, field: Vec3) -> Vec3:
        """The nodal field unchanged: the points are the nodes."""
        return field

    def of_elements(self, field: Array) -> Array:
        """Averages of an element field at the nodes, weighted by rest length."""
        first, last = self.share_of_first * field, self.share_of_last * field
        return vectors.pad(first, 0, 1) + vectors.pad(last, 1, 0)

    def to_nodes(self, field: Vec3) -> Vec3:
        """The forces unchanged: the points are the nodes."""
        return field

    def to_elements(self, field: Array) -> Array:
        """Couples at the nodes, divided between the elements next to them."""
        return self.share_of_first * field[:-1] + self.share_of_last * field[1:]


@pytree
class BetweenNodes:
    """One point in each element, at the same fraction of every element."""

    lengths: Array
    """Rest length of rod that each point stands for [m]."""
    fraction: Array
    """Fraction along each element, from first to last node, of its point [1]."""
    ends: None = None

    def of_nodes(self, field: Vec3) -> Vec3:
        """Nodal vector field, interpolated at the point of each element."""
        way = vectors.scale(self.fraction, vectors.inner_difference(field))
        x, y, z = (component[:-1] for component in field)
        return vectors.add((x, y, z), way)

    def of_elements(self, field: Array) -> Array:
        """The element field unchanged: each element has one point."""
        return field

    def to_nodes(self, field: Vec3) -> Vec3:
        """Forces shared by the element's nodes; the nearer node takes more."""
        last = vectors.scale(self.fraction, field)
        first = vectors.subtract(field, last)
        x, y, z = (
            vectors.pad(a, 0, 1) + vectors.pad(b, 1, 0)
            for a, b in zip(first, last, strict=True)
        )
        return x, y, z

    def to_elements(self, field: Array) -> Array:
        """The couples unchanged: each element has one point."""
        return field


def contact_points(
    rod: Rod, per_element: int, free_ends: Float[Array, "2"] | None = None
) -> list[Points]:
    """The nodes, and `per_element - 1` equidistant points in every element.

    Points at the same fraction of all elements are one entry of the list.

    Args:
        rod: The rod.
        per_element: Contact points per element.
        free_ends: Flags of the first and the last end: 1 if the end is free, 0 where
            the rod continues in another rod. Both are free by default.
    """
    lengths = rod.rest_lengths
    spacing = lengths / per_element
    around = vectors.pad(lengths, 0, 1) + vectors.pad(lengths, 1, 0)
    points: list[Points] = [
        AtNodes(
            lengths=vectors.pad(0.5 * (spacing[:-1] + spacing[1:]), 1, 1),
            ends=ends_of(lengths, rod.radii, per_element, free_ends),
            share_of_first=lengths / around[:-1],
            share_of_last=lengths / around[1:],
        )
    ]
    for k in range(1, per_element):
        points.append(BetweenNodes(spacing, spacing.dtype.type(k / per_element)))
    return points


class ThinBodyWarning(UserWarning):
    """Warning that a body fits between neighbouring contact points of a rod."""


def fewer_points(per_element: int, share: float) -> int:
    """A share of the contact points per element, at least one."""
    return max(1, round(share * per_element))


def check_spacing(inradius: Array | None, rod: Rod, per_element: int) -> None:
    """Warns where points are farther apart than rod radius plus body inradius.

    Args:
        inradius: Radius of the largest ball in each body; `None` if it is not known
            [m].
        rod: The rod.
        per_element: Contact points per element.
    """
    if inradius is None or is_traced(inradius, rod):
        return
    body, radii = float(np.min(inradius)), np.ravel(rod.radii)
    lengths = np.ravel(rod.rest_lengths)
    needed = lengths / (radii + body)
    worst = int(np.argmax(needed))
    if needed[worst] <= per_element * (1 + 1e-5):
        return
    warn(
        f"contact points are {lengths[worst] / per_element:.2g} m apart along a rod "
        f"of radius {radii[worst]:.2g} m: a body of radius {body:.2g} m can slip "
        f"between them. Use points_per_element={math.ceil(needed[worst] - 1e-5)}, "
        'or more elements; warnings.simplefilter("error", jaxrod.ThinBodyWarning) '
        "makes this an error.",
        ThinBodyWarning,
    )

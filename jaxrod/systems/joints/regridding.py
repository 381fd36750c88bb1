"""Places of joints on rods that get another number of elements.

A joint at a node stays at the same point of the rod, so the new grid must have a node
there. The element that turns with the node becomes shorter or longer. If the rod is
curved at rest, the middle of the new element is turned relative to that of the old one,
and what is fixed in the element is turned back.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import (
    Quaternion,
    conjugate,
    directors,
    rotation_exp,
    to_world,
)

_NEAR = 1e-6
"""Largest distance of a node of the new grid from the node that it replaces, in new
elements [1]."""


@dataclass(frozen=True)
class Regridding:
    """Rods with their old and their new numbers of elements, by name of the member."""

    old: Mapping[str, Any]
    """Each `Rod` before; of equal rods with a leading axis."""
    new: Mapping[str, Any]
    """Each `Rod` after, with the same names. Members that are not listed stay."""

    def changes(self, member: str) -> bool:
        """Whether a member has another number of elements."""
        return member in self.new

    def _counts(self, member: str) -> tuple[int, int]:
        return self.old[member].n_elements, self.new[member].n_elements

    def points_per_element(self, member: str, count: int) -> int:
        """Contact points per new element, of which old ones have `count`."""
        if not self.changes(member):
            return count
        before, after = self._counts(member)
        return -(-count * before // after)

    def nodes(self, member: str, nodes: np.ndarray) -> np.ndarray:
        """Indices of nodes on the new grid, over all rods of the member.

        Raises:
            ValueError: If the new grid has no node at one of these points.
        """
        before, after = self._counts(member)
        rod, node = np.divmod(nodes, before + 1)
        lengths = np.atleast_2d(np.asarray(self.old[member].rest_lengths, np.float64))
        places = np.pad(np.cumsum(lengths, axis=1), ((0, 0), (1, 0)))
        share = places[rod, node] / places[rod, -1] * after
        found = np.rint(share).astype(int)
        for k in np.flatnonzero(np.abs(share - found) > _NEAR):
            raise ValueError(
                f"something is joined to node {node[k]} of {member!r}, at "
                f"{places[rod[k], node[k]]:.4g} m along the rod, where {after} "
                "elements have no node: choose a number of elements that has one there"
            )
        return rod * (after + 1) + found

    def elements(self, member: str, nodes: np.ndarray) -> np.ndarray:
        """Indices of the elements that turn with nodes of the new grid."""
        _, after = self._counts(member)
        rod, node = np.divmod(nodes, after + 1)
        return rod * after + np.minimum(node, after - 1)

    def lengths(self, points: Any) -> tuple[np.ndarray, np.ndarray]:
        """Rest lengths of the old and of the new elements of `points` [m].

        They are zero for a member that stays.
        """
        if not self.changes(points.member):
            none = np.zeros(len(points.nodes))
            return none, none
        new = self.elements(
            points.member, self.nodes(points.member, points.nodes.values)
        )
        old = points.elements.values
        return tuple(
            np.asarray(rods[points.member].rest_lengths, np.float64).reshape(-1)[index]
            for rods, index in ((self.old, old), (self.new, new))
        )

    def turns(self, points: Any) -> Quaternion:
        """Rotations from the frames of old elements of `points` to those of new ones.

        They are carried along the rest curvature at the joint next to the node.
        """
        one = jnp.ones(len(points.nodes))
        if not self.changes(points.member):
            return one, 0 * one, 0 * one, 0 * one
        old = self.old[points.member]
        before, _ = self._counts(points.member)
        was, now = self.lengths(points)
        rod, element = np.divmod(points.elements.values, before)
        node = points.nodes.values - rod * (before + 1)
        # The last element of a rod ends at its node, all others begin there.
        way = np.where(node == before, -0.5, 0.5) * (now - was)
        joint = np.clip(np.where(way < 0, element - 1, element), 0, before - 2)
        curvatures = np.asarray(old.rest_curvatures, np.float64)
        curvatures = curvatures.reshape(-1, 3, before - 1)[rod, :, joint]
        x, y, z = jnp.asarray(way * curvatures.T)
        return rotation_exp((x, y, z))

    def turned_back(
        self, points: Any, vector: Float[Array, "3 k"]
    ) -> Float[Array, "3 k"]:
        """Vectors fixed in the old elements of `points`, in the frames of new ones."""
        if not self.changes(points.member):
            return vector
        frame = directors(conjugate(self.turns(points)))
        turned = vectors.join(to_world(frame, vectors.split(vector)))
        return turned.astype(vector.dtype)


@dataclass(frozen=True)
class AskedNodes(Regridding):
    """Unchanged rods; it records the nodes that couplings ask for."""

    asked: dict[str, set[int]] = field(default_factory=dict)
    """Nodes by member, counted in each rod."""

    def nodes(self, member: str, nodes: np.ndarray) -> np.ndarray:
        """The given nodes."""
        _, node = np.divmod(nodes, self.new[member].n_elements + 1)
        self.asked.setdefault(member, set()).update(node.tolist())
        return nodes

r"""Paths of fibres inside a rod, and the lengths of the fibres.

At each node a fibre has the offset $x$ from the centreline, in the section. The fibre's
segment around a node covers half of each neighbouring element. Over each half the
offset changes by half of its change $\delta$ over the element. The segment turns with
the joint at the node:

$$u = \tfrac12(\epsilon_{k-1} + \epsilon_k) + \phi\times x + \tfrac12(\delta_{k-1} +
  \delta_k),$$

which is the strain $\sigma + e_3 + \kappa\times x + x'$ of the fibre times the rest
length around the node. At the ends it covers half an element.
"""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.actuation.section_load import (
    SectionStrains,
    at_nodes,
    cross_bound,
    fibre_bound,
    section_bound,
    together,
    transport_bound,
)
from jaxrod.effects.base import StabilityBound
from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.rod import Rod, node_places, resampled_along
from jaxrod.structure import pytree
from jaxrod.validation import Numbers, as_array, numeric


@pytree
class FibrePath:
    """Offsets of fibres from the centreline, along d1 and d2."""

    offsets: Float[Array, "k 2 m"]
    """Offsets of each fibre at every node, or one (m = 1) for the whole rod [m]."""

    @property
    def count(self) -> int:
        """Number of fibres."""
        return self.offsets.shape[0]

    def segments(self, strains: SectionStrains) -> Vec3:
        """Vector along the part of each fibre around each node, material frame [m]."""
        x, y = self.offsets[:, 0], self.offsets[:, 1]
        a, b, c = (part[None, :] for part in strains.rotations)
        e1, e2, e3 = (at_nodes(part)[None, :] for part in strains.edges)
        dx, dy = _half_steps(x), _half_steps(y)
        return e1 - c * y + dx, e2 + c * x + dy, e3 + (a * y - b * x)

    def rest_segments(self, rod: Rod) -> Vec3:
        """Vector along the part of each fibre around each node, at rest [m]."""
        edges = vectors.scale(
            rod.rest_lengths, _along_axis(vectors.split(rod.rest_strains))
        )
        x, y, z = vectors.split(rod.rest_curvatures * rod.joint_lengths[None, :])
        turns = vectors.pad(x, 1, 1), vectors.pad(y, 1, 1), vectors.pad(z, 1, 1)
        return self.segments(SectionStrains(edges, turns))

    def bound(
        self, rod: Rod, force: Array, slope: Array, *, pulls: bool
    ) -> StabilityBound:
        """Stability bound of forces along the fibres, about the straight rod.

        Args:
            rod: The rod.
            force: Bound on the force of each fibre around each node `(k, n + 1)` [N].
            slope: Bound on the derivative of that force with respect to the fibre's
                length, same shape [N/m].
            pulls: Whether all fibres pull; then they add no stiffness against shear.
        """
        span = self.rest_segments(rod)
        length = vectors.safe_norm(span)
        t1, t2, t3 = vectors.scale(1 / length, span)
        across = jnp.sqrt(t1 * t1 + t2 * t2)
        x, y = self.offsets[:, 0], self.offsets[:, 1]
        offset = jnp.sqrt(x * x + y * y)
        m1, m2, m3 = vectors.cross((x, y, jnp.zeros_like(x)), (t1, t2, t3))
        lever = jnp.sqrt(m1 * m1 + m2 * m2 + m3 * m3)
        tense = force / length
        sideways = _size(_sum(force * t1), _sum(force * t2))
        axial = _sum(tense)
        axial = 0.5 * (axial[1:] + axial[:-1])
        one = jnp.ones_like(length)
        string = {"stretch": axial} if pulls else {"shear": axial}
        return together(
            fibre_bound(rod, slope, t3, across, lever),
            section_bound(rod, **string),
            # Inclined fibres resist transverse displacement, offset fibres resist
            # rotation.
            fibre_bound(rod, 2 * tense * across**2, one, one, 0 * one),
            section_bound(rod, turning=_sum(tense * offset**2)),
            cross_bound(rod, _size(_sum(tense * x), _sum(tense * y))),
            transport_bound(
                rod,
                jnp.maximum(sideways[1:], sideways[:-1]),
                _size(_sum(force * m1), _sum(force * m2), _sum(force * m3)),
            ),
        )

    def resampled(self, rod: Rod, new_rod: Rod) -> FibrePath:
        """The same path at the nodes of `new_rod`, interpolated along the rod."""
        old, new = node_places(rod), node_places(new_rod)
        return replace(self, offsets=resampled_along(self.offsets, old, new))


def _half_steps(values: Array) -> Array:
    """Change of each fibre's offset over the halves of elements next to every node [m].

    It is half the difference of the next and the previous entry of `values` `(k, m)`;
    at an end the end entry itself stands in for the missing one.
    """
    padded = jnp.pad(values, ((0, 0), (1, 1)), mode="edge")
    return 0.5 * (padded[:, 2:] - padded[:, :-2])


def _along_axis(strain: Vec3) -> Vec3:
    return strain[0], strain[1], 1 + strain[2]


def _sum(of_fibres: Array) -> Array:
    return jnp.sum(of_fibres, axis=0)


def _size(*components: Array) -> Array:
    squares = [part * part for part in components]
    return jnp.sqrt(sum(squares[1:], squares[0]))


def fibre_path(rod: Rod, offsets: Numbers | None) -> FibrePath:
    """Validates offsets, and makes a `FibrePath` from them.

    Args:
        rod: The rod.
        offsets: Offsets along d1 and d2 `(2,)`; one per fibre `(k, 2)`; or also per
            node `(k, 2, n + 1)` [m]. `None` is the centreline.

    Raises:
        ValueError: If they have the wrong shape or are not finite.
    """
    if offsets is None:
        return FibrePath(jnp.zeros((1, 2, 1), rod.rest_lengths.dtype))
    given = numeric("offsets", offsets, "m")
    count = given.shape[0] if given.ndim > 1 else 1
    nodes = rod.n_elements + 1
    shapes = [(2,), (count, 2), (count, 2, nodes)]
    kind = rod.rest_lengths.dtype
    found = as_array("offsets", given, "m", shapes, dtype=kind)
    if found.ndim < 3:
        found = found.reshape(-1, 2, 1)
    return FibrePath(found)


def helical_offsets(
    rod: Rod, radius: Numbers, turns: Numbers, angles: Numbers = (0.0,)
) -> Float[Array, "k 2 n+1"]:
    """Offsets of fibres that wind around a rod, for `muscle` and `chamber`.

    Args:
        rod: The rod.
        radius: Distance from the centreline, one number, or one per node [m].
        turns: Number of turns from the base of the rod to its tip, right-handed if
            positive, at most 100 in size.
        angles: Angle of each fibre at the base, from d1 towards d2, at most 1000 in
            size `(k,)` [rad].

    Raises:
        ValueError: If an argument is of the wrong shape or out of range.

    Example:
        >>> offsets = actuation.helical_offsets(rod, 0.01, turns=1.0)
        >>> offsets.shape, round(float(offsets[0, 0, 5]), 3)  # half a turn from d1
        ((1, 2, 11), -0.01)
        >>> twister = actuation.muscle(rod, 2.0, offsets=offsets)
        >>> twister.path.count
        1
    """
    kind = rod.rest_lengths.dtype
    places = node_places(rod)
    wide = as_array(
        "radius", radius, "m", [(), places.shape], non_negative=True, dtype=kind
    )
    whole = numeric("turns", turns)
    # More turns would lose precision in float32.
    as_array("size of turns", abs(whole), "", at_most=100.0)
    whole = as_array("turns", whole, "", dtype=kind)
    first = numeric("angles", angles, "rad")
    as_array("size of angles", abs(first), "rad", [(first.size,)], at_most=1000.0)
    first = as_array("angles", first, "rad", [(first.size,)], dtype=kind)
    share = jnp.asarray(places / places[-1], kind)
    angle = first[:, None] + 2 * jnp.pi * (whole * share)[None, :]
    wide = jnp.broadcast_to(wide, places.shape)[None, :]
    return jnp.stack([wide * jnp.cos(angle), wide * jnp.sin(angle)], axis=1)

r"""Bounds on the stiffness of actuators inside a rod, for the stability bound.

With $s$ the stretch of an element, $\gamma = e_\perp - \ell\theta$ its shear (the move
of its nodes across the rod less its own turn), and $\phi$ the turn of a joint, all in
small motions about the straight rod, an actuator adds at most
$\sum k_s s^2 + k_\gamma \gamma^2 + k_\phi \phi^2$ to twice the energy. Each part is
shared between nodes and elements by Young's inequality,
$(a + b)^2 \le (1 + w)\,a^2 + (1 + 1/w)\,b^2$, with the weight that makes the squared
frequencies alike. The part with $k_\gamma$ is then exactly what shear stiffness has in
`jaxrod.analysis.stability`.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.actuation.section_load import at_nodes
from jaxrod.effects.base import StabilityBound
from jaxrod.rods.rod import Rod


def section_bound(
    rod: Rod,
    stretch: Array | None = None,
    shear: Array | None = None,
    turning: Array | None = None,
) -> StabilityBound:
    r"""Of stiffness against stretch, shear, bending and twist.

    Args:
        rod: The rod.
        stretch: $k_s$ of each element; of moves across the rod, too `(n,)` [N/m].
        shear: $k_\gamma$ of each element `(n,)` [N/m].
        turning: $k_\phi$ of the joint at each node `(n + 1,)` [N m].
    """
    nodes = jnp.zeros_like(rod.node_masses)
    elements = jnp.zeros_like(rod.rest_lengths)
    if stretch is not None:
        nodes = nodes + 4 * at_nodes(stretch)
    if shear is not None:
        weight = _moves(rod) / _rocking(rod)
        nodes = nodes + 4 * at_nodes(shear * (1 + 1 / weight))
        elements = elements + shear * (1 + weight) * rod.rest_lengths**2
    if turning is not None:
        elements = elements + 2 * (turning[1:] + turning[:-1])
    return StabilityBound(nodes=nodes, elements=elements)


def transport_bound(
    rod: Rod, force: Array | None = None, moment: Array | None = None
) -> StabilityBound:
    """Of a stress that does not change in its material frame: it turns with it.

    Args:
        rod: The rod.
        force: Bound on the size of the force, per element [N].
        moment: On that of the moment, per node [N m].
    """
    bounds = []
    if force is not None:
        pushed = jnp.abs(force) / rod.rest_lengths
        bounds.append(section_bound(rod, shear=pushed))
    if moment is not None:
        size = jnp.abs(moment)
        bounds.append(StabilityBound(elements=size[1:] + size[:-1]))
    return together(*bounds)


def fibre_bound(
    rod: Rod,
    stiffness: Array,
    along: Array,
    across: Array,
    lever: Array,
) -> StabilityBound:
    """Of springs along fibres, which stretch, shear and bend the rod at once.

    Args:
        rod: The rod.
        stiffness: Of each fibre around each node `(k, n + 1)` [N/m].
        along: Component of the fibre along the rod, likewise [1].
        across: Component across it [1].
        lever: Elongation per turn of the joint [m].
    """
    # Weights, of which any make it a bound: from either end of a rod the same.
    moves, rocking, inertia = (
        _at_each_node(values)[None, :]
        for values in (_moves(rod), _rocking(rod), jnp.min(rod.inertias, axis=0))
    )
    parts = along**2 * moves, across**2 * (moves + rocking), 4 * lever**2 / inertia
    whole = parts[0] + parts[1] + parts[2]
    directions = along**2, across**2, lever**2
    stretch, shear, turning = (
        jnp.sum(stiffness * size * _ratio(whole, part), axis=0)
        for size, part in zip(directions, parts, strict=True)
    )
    return section_bound(rod, _of_elements(stretch), _of_elements(shear), turning)


def cross_bound(rod: Rod, coupling: Array) -> StabilityBound:
    """Of a coupling of shear and twist, `2 coupling gamma phi` at the nodes [N]."""
    inertia = jnp.min(rod.inertias, axis=0)
    rate = jnp.sqrt(4 / inertia / (_moves(rod) + _rocking(rod)))
    # The shear of both elements beside a node counts for its twist.
    turned = coupling / jnp.minimum(*_beside_nodes(rate))
    return section_bound(rod, shear=_of_elements(coupling) * rate, turning=turned)


def together(*bounds: StabilityBound) -> StabilityBound:
    """Several bounds added up."""

    def total(name: str) -> Array | None:
        parts = [getattr(bound, name) for bound in bounds]
        found = [part for part in parts if part is not None]
        return sum(found[1:], found[0]) if found else None

    return StabilityBound(nodes=total("nodes"), elements=total("elements"))


def _at_each_node(values: Array) -> Array:
    """Means of the values of the elements beside every node."""
    before, after = _beside_nodes(values)
    return 0.5 * (before + after)


def _beside_nodes(values: Array) -> tuple[Array, Array]:
    """Values of the elements before and after every node; at ends of the one."""
    padded = jnp.pad(values, (1, 1), mode="edge")
    return padded[:-1], padded[1:]


def _moves(rod: Rod) -> Array:
    """Squared frequency of moving nodes per stiffness of elements [1/kg]."""
    inverse = 1 / rod.node_masses
    return 2 * (inverse[1:] + inverse[:-1])


def _rocking(rod: Rod) -> Array:
    """The same of turning elements between nodes that stay [1/kg]."""
    return rod.rest_lengths**2 / jnp.min(rod.inertias, axis=0)


def _of_elements(at_nodes: Array) -> Array:
    """What joints do to the mean of their elements, at most."""
    return 0.5 * (at_nodes[1:] + at_nodes[:-1])


def _ratio(whole: Array, part: Array) -> Array:
    """Over a part; zero where that is none."""
    return jnp.where(part > 0, whole / jnp.where(part > 0, part, 1), 0)

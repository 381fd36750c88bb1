r"""Bounds on the stiffness of actuators inside a rod, for the stability bound.

In small motions about the straight rod, $s$ is the stretch of an element,
$\gamma = e_\perp - \ell\theta$ its shear (the displacement of its nodes across the rod
minus that of its own rotation), and $\phi$ the rotation of a joint. An actuator adds at
most $\sum k_s s^2 + k_\gamma \gamma^2 + k_\phi \phi^2$ to twice the energy. Each part
is split between nodes and elements by Young's inequality,
$(a + b)^2 \le (1 + w)\,a^2 + (1 + 1/w)\,b^2$, with the weight that makes the squared
frequencies equal. The part with $k_\gamma$ is then exactly that of the shear stiffness
in `jaxrod.analysis.stability`.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.actuation.section_load import at_nodes
from jaxrod.effects.base import StabilityBound
from jaxrod.rods.rod import Rod

_LEAST_WEIGHT = 1e-6
"""Weight of a part of a fibre's elongation beside those of all [1]."""


def section_bound(
    rod: Rod,
    stretch: Array | None = None,
    shear: Array | None = None,
    turning: Array | None = None,
) -> StabilityBound:
    r"""Bound of stiffness against stretch, shear, bending and twist.

    Args:
        rod: The rod.
        stretch: $k_s$ of each element, also for displacement across the rod `(n,)`
            [N/m].
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
    """Bound of a stress that is constant in the material frame and turns with it.

    Args:
        rod: The rod.
        force: Bound on the size of the force, per element [N].
        moment: Bound on the size of the moment, per node [N m].
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
    """Bound of springs along fibres, which stretch, shear and bend the rod together.

    Args:
        rod: The rod.
        stiffness: Stiffness of each fibre around each node `(k, n + 1)` [N/m].
        along: Component of the fibre along the rod, same shape [1].
        across: Component of the fibre across the rod [1].
        lever: Elongation per rotation of the joint [m].
    """
    # Any weights give a bound; these do not change if the rod's ends are swapped.
    moves, rocking, inertia = (
        _at_each_node(values)[None, :]
        for values in (_moves(rod), _rocking(rod), jnp.min(rod.inertias, axis=0))
    )
    parts = along**2 * moves, across**2 * (moves + rocking), 4 * lever**2 / inertia
    whole = parts[0] + parts[1] + parts[2]
    directions = along**2, across**2, lever**2
    stretch, shear, turning = (
        jnp.sum(stiffness * size * _share(whole, part), axis=0)
        for size, part in zip(directions, parts, strict=True)
    )
    return section_bound(rod, _of_elements(stretch), _of_elements(shear), turning)


def cross_bound(rod: Rod, coupling: Array) -> StabilityBound:
    """Bound of a coupling of shear and twist, `2 coupling gamma phi` at nodes [N]."""
    inertia = jnp.min(rod.inertias, axis=0)
    rate = jnp.sqrt(4 / inertia / (_moves(rod) + _rocking(rod)))
    # The shear of both elements next to a node counts for its twist.
    turned = coupling / jnp.minimum(*_beside_nodes(rate))
    return section_bound(rod, shear=_of_elements(coupling) * rate, turning=turned)


def together(*bounds: StabilityBound) -> StabilityBound:
    """Sum of several bounds."""

    def total(name: str) -> Array | None:
        parts = [getattr(bound, name) for bound in bounds]
        found = [part for part in parts if part is not None]
        return sum(found[1:], found[0]) if found else None

    return StabilityBound(nodes=total("nodes"), elements=total("elements"))


def _at_each_node(values: Array) -> Array:
    """Mean of the values of the elements next to every node."""
    before, after = _beside_nodes(values)
    return 0.5 * (before + after)


def _beside_nodes(values: Array) -> tuple[Array, Array]:
    """Values of the elements before and after every node, repeated at the ends."""
    padded = jnp.pad(values, (1, 1), mode="edge")
    return padded[:-1], padded[1:]


def _moves(rod: Rod) -> Array:
    """Squared frequency of displaced nodes per stiffness of elements [1/kg]."""
    inverse = 1 / rod.node_masses
    return 2 * (inverse[1:] + inverse[:-1])


def _rocking(rod: Rod) -> Array:
    """Squared frequency of elements rotating between fixed nodes, same unit [1/kg]."""
    return rod.rest_lengths**2 / jnp.min(rod.inertias, axis=0)


def _of_elements(at_nodes: Array) -> Array:
    """Mean over each element's two nodes, a bound on the effect of both joints."""
    return 0.5 * (at_nodes[1:] + at_nodes[:-1])


def _share(whole: Array, part: Array) -> Array:
    """Inverse weight of one of three parts, for a bound on the square of their sum."""
    # In proportion to the part, and a little for each: so what rounding leaves of a
    # part that is zero adds nothing.
    weight = part + _LEAST_WEIGHT * whole
    there = weight > 0
    most = (1 + 3 * _LEAST_WEIGHT) * whole
    return jnp.where(there, most / jnp.where(there, weight, 1), 0)

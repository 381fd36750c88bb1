r"""Bounds on the stiffness of actuators inside a rod, for the stability bound.

A spring of stiffness $k$ on an elongation $\delta = \sum_i g_i u_i$ has by Cauchy and
Schwarz $k\delta^2 \le \omega^2 \sum_i M_i |u_i|^2$ with
$\omega^2 = k \sum_i |g_i|^2/M_i$: nothing that it touches gets faster by more. Moves of
nodes and turns of elements are bounded one by one, each with twice its share.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.actuation.section_load import at_nodes
from jaxrod.effects.base import StabilityBound
from jaxrod.rods.rod import Rod


def transport_bound(
    rod: Rod, force: Array | None = None, moment: Array | None = None
) -> StabilityBound:
    """Of a stress that does not change in its material frame: it turns with it.

    Args:
        rod: The rod.
        force: Bound on the size of the force, per element [N].
        moment: On that of the moment, per node [N m].
    """
    elements = jnp.zeros_like(rod.rest_lengths)
    nodes = None
    if force is not None:
        size = jnp.abs(force)
        elements = elements + 2 * size * rod.rest_lengths
        nodes = 4 * at_nodes(size / rod.rest_lengths)
    if moment is not None:
        size = jnp.abs(moment)
        elements = elements + size[1:] + size[:-1]
    return StabilityBound(nodes=nodes, elements=elements)


def spring_bound(
    rod: Rod, stiffness: Array, lever: Array, reach: Array | float = 0.5
) -> StabilityBound:
    """Of springs at the nodes, stretched by neighbouring nodes and elements.

    Args:
        rod: The rod.
        stiffness: Of the spring at each node `(n + 1,)` [N/m].
        lever: Elongation per turn of either element beside it `(n + 1,)` [m].
        reach: Elongation per move of either neighbouring node [1].
    """
    masses, inertia = rod.node_masses, jnp.min(rod.inertias, axis=0)
    inverse = 1 / masses
    # What moves the spring at an inner node are both its neighbours; at an end, the
    # end and its neighbour.
    around = jnp.concatenate([inverse[:1], inverse, inverse[-1:]])
    moves = reach**2 * (around[2:] + around[:-2])
    turning = 1 / inertia
    none = jnp.zeros_like(turning[:1])
    turns = jnp.concatenate([turning, none]) + jnp.concatenate([none, turning])
    by_moves = 2 * stiffness * moves
    by_turns = 2 * stiffness * lever**2 * turns
    nothing = jnp.zeros_like(by_moves[:1])
    spread = jnp.concatenate([nothing, by_moves, nothing])
    return StabilityBound(
        nodes=masses * (spread[:-2] + spread[1:-1] + spread[2:]),
        elements=inertia * (by_turns[1:] + by_turns[:-1]),
    )


def together(*bounds: StabilityBound) -> StabilityBound:
    """Several bounds added up."""

    def total(name: str) -> Array | None:
        parts = [getattr(bound, name) for bound in bounds]
        found = [part for part in parts if part is not None]
        return sum(found[1:], found[0]) if found else None

    return StabilityBound(nodes=total("nodes"), elements=total("elements"))

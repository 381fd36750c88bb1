r"""Smooth axes: curves along rods that are as smooth at nodes as between them.

A polyline is nearer to the far lines of a bent rod in the middle of an element than at
a node, so that a load that slides along it goes up and down, and rests at nodes. A
curve through the nodes still does. On each element here is the cubic with places $y_i$
and tangents $m_i$ at both its nodes (Hermite's), where with the nodes' central
differences $\mu\delta, \delta^2, \ldots$ along the rod

$$y = x + \tfrac1{24} \delta^2 x - 0.041\, \delta^4 x, \qquad
  m = \mu\delta x - 0.136\, \mu\delta^3 x.$$

The first number sets how far the curve is inside the nodes of a bend: so much that the
work of a load on a limp rope is that on a smooth one. The others were fitted so that
the work of a load on a straight rope under tension, where it has slid to, is the same
all along an element: to 4e-5 of load, angle and length of an element for a limp one,
where a polyline has 6e-2, and less for a stiff one. Straight rods stay as they are,
and places of a rod that turns turn with it: a force on the curve has the same moment on
the nodes.

Ends are continued as in a mirror, and those of closed rods by the other end.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import numpy as np
from jaxtyping import Array

INWARDS, FLAT, TANGENT = 1 / 24, -0.041, -0.136
"""What second and fourth differences change places by, and third ones tangents."""
FARTHEST = 1.165
"""Most that a place on a curve moves by where no node moves by more than one."""
_ALIKE = 12
"""Elements of a rod that has all kinds of neighbourhoods."""


Longer = Callable[[Array], Array]
"""A field on nodes as a row for each rod, with two nodes more at both ends."""


def smooth_nodes(longer: Longer, nodes: Array) -> tuple[Array, Array]:
    """Places and tangents at nodes, from a field on them; all of one shape.

    Args:
        longer: How rods go on beyond their ends.
        nodes: One component of positions or velocities.
    """
    x = longer(nodes)
    second = x[:, 2:] - 2 * x[:, 1:-1] + x[:, :-2]
    fourth = second[:, 2:] - 2 * second[:, 1:-1] + second[:, :-2]
    place = x[:, 2:-2] + INWARDS * second[:, 1:-1] + FLAT * fourth
    tangent = 0.5 * (x[:, 3:-1] - x[:, 1:-3])
    tangent = tangent + 0.5 * TANGENT * (second[:, 2:] - second[:, :-2])
    return place.reshape(-1), tangent.reshape(-1)


def from_smooth_nodes(longer: Longer, places: Array, tangents: Array) -> Array:
    """Forces on nodes, from those on places and on tangents at them."""
    back = jax.linear_transpose(lambda nodes: smooth_nodes(longer, nodes), places)
    (nodes,) = back((places, tangents))
    return nodes


@functools.cache
def stiffest(n_elements: int) -> np.ndarray:
    """Largest stiffness at each node of springs of one, of which each element has one.

    Of the rows of the stiffness, sums of what is in them, each spring at its worst.
    """
    n = min(n_elements, _ALIKE)
    nodes = np.eye(n + 1)
    before, after = 2 * nodes[:1], 2 * nodes[-1:]
    far = nodes[[2, 1]] if n > 1 else np.stack([2 * nodes[1] - nodes[0], nodes[1]])
    back = nodes[[-2, -3]] if n > 1 else np.stack([nodes[0], 2 * nodes[0] - nodes[1]])
    x = np.concatenate([before - far, nodes, after - back])
    second = np.diff(x, n=2, axis=0)
    place = nodes + INWARDS * second[1:-1] + FLAT * np.diff(second, n=2, axis=0)
    tangent = 0.5 * (x[3:-1] - x[1:-3]) + 0.5 * TANGENT * (second[2:] - second[:-2])
    s = np.linspace(0, 1, 101)[:, None, None]
    weights = np.abs(
        (1 - s) ** 2 * (1 + 2 * s) * place[:-1]
        + s**2 * (3 - 2 * s) * place[1:]
        + s * (1 - s) ** 2 * tangent[:-1]
        - s**2 * (1 - s) * tangent[1:]
    )
    worst = np.max(weights * np.sum(weights, axis=2, keepdims=True), axis=0)
    found = np.sum(worst, axis=0)
    half = found.size // 2
    most = np.full(n_elements + 1 - found.size, found[half])
    return np.concatenate([found[:half], most, found[half:]])

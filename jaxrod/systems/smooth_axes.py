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

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

INWARDS, FLAT, TANGENT = 1 / 24, -0.041, -0.136
"""Factors of second and fourth differences in places, and of third ones in tangents."""
FARTHEST = 1.165
"""Most that a place on a curve moves by where no node moves by more than one."""
_ALIKE = 12
"""Elements of a rod that has all kinds of neighbourhoods."""


def smooth_nodes(nodes: Array, closed: np.ndarray) -> tuple[Array, Array]:
    """Places and tangents at nodes, from a field on them; all of one shape.

    Args:
        nodes: Positions or velocities, a row for each rod.
        closed: Whether each rod is, `(rods, 1)`.
    """
    tangent, second = _differences(nodes, closed)
    third, fourth = _differences(second, closed)
    return nodes + INWARDS * second + FLAT * fourth, tangent + TANGENT * third


def from_smooth_nodes(places: Array, tangents: Array, closed: np.ndarray) -> Array:
    """Forces on nodes, from those on places and on tangents at them."""
    back = jax.linear_transpose(lambda nodes: smooth_nodes(nodes, closed), places)
    (nodes,) = back((places, tangents))
    return nodes


def _differences(nodes: Array, closed: np.ndarray) -> tuple[Array, Array]:
    """Central first and second differences along rods."""
    edges = nodes[:, 1:] - nodes[:, :-1]
    before = jnp.pad(edges, ((0, 0), (1, 0)))
    after = jnp.pad(edges, ((0, 0), (0, 1)))
    n = edges.shape[1]
    if closed.any():
        around = np.where(closed, 1, 0)
        before = before + around * jnp.pad(edges[:, -1:], ((0, 0), (0, n)))
        after = after + around * jnp.pad(edges[:, :1], ((0, 0), (n, 0)))
    at_end = np.pad(np.zeros(n - 1), 1, constant_values=1)[None, :] * ~closed
    half = jnp.asarray(0.5 + 0.5 * at_end, nodes.dtype)
    return half * (before + after), jnp.asarray(1 - at_end, nodes.dtype) * (
        after - before
    )


@functools.cache
def stiffest(n_elements: int) -> np.ndarray:
    """Largest stiffness at each node of springs of one, of which each element has one.

    Of the rows of the stiffness, sums of what is in them, each spring at its worst.
    """
    n = min(n_elements, _ALIKE)
    with jax.ensure_compile_time_eval():
        open_rods = np.zeros((n + 1, 1), bool)
        both = smooth_nodes(jnp.eye(n + 1), open_rods)
    # Of a node that moves by one, what all nodes do: a column of the weights.
    place, tangent = (np.asarray(field, float).T for field in both)
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

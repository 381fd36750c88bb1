r"""Smooth axes: curves along rods that are as smooth at nodes as between them.

Where a polyline bends, its nodes stick out and its elements' midpoints lie inside.
So a load that slides along the polyline goes up and down, and rests at nodes. A curve
through the nodes still has this fault. Here each element has the cubic Hermite curve
with positions $y_i$ and tangents $m_i$ at its nodes. With the central differences
$\mu\delta, \delta^2, \ldots$ of the nodes along the rod they are

$$y = x + \tfrac1{24} \delta^2 x - 0.041\, \delta^4 x, \qquad
  m = \mu\delta x - 0.136\, \mu\delta^3 x.$$

The first number sets how far the curve runs inside the nodes of a bend. It is chosen so
that a load on a limp rope does the same work as on a smooth rope. The other two were
fitted so that the work of a load on a straight rope under tension is the same wherever
along an element the load has slid to. For a limp rope it varies by 4e-5 of the load
times the angle times the length of an element; for a polyline by 6e-2. For a stiff rope
it varies less. Straight rods stay straight. When a rod rotates, its curve rotates with
it, so a force on the curve has the same moment as its forces on the nodes.

Open rods are continued beyond their ends by point reflection, closed rods by the
elements at the other end.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

INWARDS, FLAT, TANGENT = 1 / 24, -0.041, -0.136
"""Coefficients of the second and fourth differences in positions, and of the third
difference in tangents [1]."""
FARTHEST = 1.165
"""Largest displacement of a point on a smooth axis divided by the largest displacement
of a node [1]."""
_ALIKE = 12
"""Elements of the longest rod for which `stiffest` is computed. Longer rods repeat the
value of its middle node."""


def smooth_nodes(nodes: Array, closed: np.ndarray) -> tuple[Array, Array]:
    """Positions y and tangents m of smooth axes at the nodes, from nodal positions x.

    With the central differences d1, ..., d4 of x along the rod, y = x + d2/24 - 0.041
    d4 and m = d1 - 0.136 d3. Both are linear in x, so velocities are transformed in the
    same way.

    Args:
        nodes: One component of positions or velocities `(rods, nodes)`.
        closed: Whether each rod is closed, `(rods, 1)`.
    """
    tangent, second = _differences(nodes, closed)
    third, fourth = _differences(second, closed)
    return nodes + INWARDS * second + FLAT * fourth, tangent + TANGENT * third


def from_smooth_nodes(places: Array, tangents: Array, closed: np.ndarray) -> Array:
    """Transpose of `smooth_nodes`: nodal forces, from those on axes and tangents."""
    back = jax.linear_transpose(lambda nodes: smooth_nodes(nodes, closed), places)
    (nodes,) = back((places, tangents))
    return nodes


def _differences(nodes: Array, closed: np.ndarray) -> tuple[Array, Array]:
    """Central first and second differences at the nodes of each rod, ends included."""
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
    """Bound on each node's stiffness if every element has one spring of unit stiffness.

    It is the sum of the absolute entries in the node's row of the stiffness matrix of
    smooth axes. Each spring acts at the point of its element where it adds most.
    """
    n = min(n_elements, _ALIKE)
    with jax.ensure_compile_time_eval():
        open_rods = np.zeros((n + 1, 1), bool)
        both = smooth_nodes(jnp.eye(n + 1), open_rods)
    # Response of all positions and tangents to a unit displacement of each node.
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

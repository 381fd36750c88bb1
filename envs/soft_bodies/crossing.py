"""Whether a line of nodes in a plane crosses itself."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float


def crosses_itself(nodes: Float[Array, "2 n+1"]) -> Bool[Array, ""]:
    """Whether two non-neighbouring segments cross in their interiors.

    Args:
        nodes: Nodes of the line [m].
    """
    starts, ends = nodes[:, :-1], nodes[:, 1:]
    n = starts.shape[1]
    # Row i, column j: side of segment i on which segment j starts and ends.
    edge = ends - starts
    start_side = _side(edge, starts, starts)
    end_side = _side(edge, starts, ends)
    parted = start_side * end_side < 0
    apart = np.abs(np.arange(n)[:, None] - np.arange(n)[None, :]) > 1
    return jnp.any(parted & parted.T & apart)


def _side(
    edge: Float[Array, "2 n"], start: Float[Array, "2 n"], point: Float[Array, "2 m"]
) -> Float[Array, "n m"]:
    """Signed area: above 0 for a point left of a segment, below 0 right of it."""
    x = point[0][None, :] - start[0][:, None]
    y = point[1][None, :] - start[1][:, None]
    return edge[0][:, None] * y - edge[1][:, None] * x

r"""The damped Gauss-Newton step where the Jacobian has the shape of an arrow.

Part $w$ has residuals $r_w(p, s_w)$: $p$ is shared, $s_w$ its own. A damped step is
found part by part: with $S_w = \partial r_w / \partial s_w$ and the damping below it,

$$\begin{pmatrix} S_w \\ \sqrt{\mu D_w} \end{pmatrix} = Q_w R_w, \qquad
\min_d \sum_w \Big\| (I - Q_w Q_w^T) \begin{pmatrix} r_w + P_w d \\ 0 \end{pmatrix}
\Big\|^2 + \mu \| D^{1/2} d \|^2,$$

$P_w = \partial r_w / \partial p$; own unknowns follow from $R_w$. The cost is that of
one part's unknowns for all parts, not of all unknowns. What is left of $P_w$ after the
projection (without damping) is the Jacobian of the shared unknowns when the own ones
always are at their best: its singular values say how surely $p$ is known.

Source: G. H. Golub, V. Pereyra, The differentiation of pseudo-inverses and nonlinear
least squares problems whose variables separate, 1973; B. Triggs et al., Bundle
adjustment, 2000, section 6.1.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array


def in_order_of_leaves(like: Any) -> Callable[[Array], Array]:
    """Makes rows of parts into one, leaf after leaf of what is stacked."""
    sizes = [leaf.size for leaf in jax.tree.leaves(like)]

    def ordered(rows: Array) -> Array:
        made, at = [], 0
        for size in sizes:
            made.append(jnp.ravel(rows[:, at : at + size]))
            at += size
        return jnp.concatenate(made)

    return ordered


def projected(slopes: Array, mu: Any, shares: int) -> tuple[Array, Array, Array]:
    """Shared columns less what own ones make good, and Q and R of those, damped."""
    ours, mine = slopes[:, :shares], slopes[:, shares:]
    squares = jnp.sum(mine**2, axis=0)
    none = squares <= jnp.finfo(slopes.dtype).tiny
    roots = jnp.sqrt(mu * jnp.where(none, 1, squares))
    q, r = jnp.linalg.qr(jnp.concatenate([mine, jnp.diag(roots)]))
    top = q[: mine.shape[0]]
    return ours - top @ (top.T @ ours), q, r


def arrow_step(
    jacobian: Array, residuals: Array, mu: Array, point: Array, low: Array, high: Array
) -> tuple[Array, Array]:
    """The damped Gauss-Newton step of shared and own unknowns.

    Args:
        jacobian: Of every part, `(part, residuals, shared + own)`.
        residuals: Of every part.
        mu: The damping, a share of the diagonal [1].
        point: The shared unknowns.
        low: Their smallest values.
        high: Their largest ones.

    Returns:
        The step of the shared unknowns, zero where a bound holds them, and those of the
        own ones, stacked in front by part.
    """
    shares, dtype = point.size, jacobian.dtype

    def eliminated(slopes: Array, values: Array) -> tuple[Array, ...]:
        _, q, r = projected(slopes, mu, shares)
        none = jnp.zeros((q.shape[0] - values.size, shares + 1), dtype)
        both = jnp.concatenate([slopes[:, :shares], values[:, None]], axis=1)
        both = jnp.concatenate([both, none])
        along = q.T @ both
        return both - q @ along, along, r

    rest, along, r = jax.vmap(eliminated)(jacobian, residuals)
    rows = jnp.reshape(rest, (-1, shares + 1))
    ours, values = rows[:, :shares], rows[:, shares]
    slope = ours.T @ values
    held = ((point <= low) & (slope > 0)) | ((point >= high) & (slope < 0))
    free = jnp.where(held, 0, 1).astype(dtype)
    ours = ours * free[None]
    squares = jnp.sum(jacobian[..., :shares] ** 2, axis=(0, 1)) * free
    none = squares <= jnp.finfo(dtype).tiny
    roots = jnp.sqrt(mu * jnp.where(none, 1, squares))
    triangle = jnp.linalg.qr(
        jnp.concatenate(
            [
                jnp.concatenate([ours, values[:, None]], axis=1),
                jnp.concatenate([jnp.diag(roots), jnp.zeros((shares, 1), dtype)], 1),
            ]
        ),
        mode="r",
    )
    step = -solve_triangular(triangle[:shares, :shares], triangle[:shares, shares])
    step = step * free
    sides = -(along[..., shares] + along[..., :shares] @ step)
    return step, jax.vmap(solve_triangular)(r, sides)

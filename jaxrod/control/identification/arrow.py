r"""The damped Gauss-Newton step for a Jacobian with an arrow structure.

Part $w$ has residuals $r_w(p, s_w)$ of shared unknowns $p$ and its own unknowns $s_w$.
The own unknowns are eliminated part by part (variable projection): with
$S_w = \partial r_w / \partial s_w$ and the damping in rows below it,

$$\begin{pmatrix} S_w \\ \sqrt{\mu D_w} \end{pmatrix} = Q_w R_w, \qquad
\min_d \sum_w \Big\| (I - Q_w Q_w^T) \begin{pmatrix} r_w + P_w d \\ 0 \end{pmatrix}
\Big\|^2 + \mu \| D^{1/2} d \|^2,$$

where $P_w = \partial r_w / \partial p$. The own unknowns follow from $R_w$ by back
substitution. The cost is that of one small solve per part, not of one solve of all
unknowns. The projected $P_w$ (without damping) is the Jacobian of the shared unknowns
if the own ones always take their optimum: its singular values show how well the data
determine $p$.

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
    """Returns a function that joins the rows of all parts, leaf after leaf of `like`.

    Its result has the order of a flattened tree whose leaves are stacked by part.
    """
    sizes = [leaf.size for leaf in jax.tree.leaves(like)]

    def ordered(rows: Array) -> Array:
        made, at = [], 0
        for size in sizes:
            made.append(jnp.ravel(rows[:, at : at + size]))
            at += size
        return jnp.concatenate(made)

    return ordered


def projected(slopes: Array, mu: Any, shares: int) -> tuple[Array, Array, Array]:
    """Projects the shared columns orthogonally to a part's own, damped columns.

    Returns the projected columns, and the Q and R factors of the damped own columns.
    """
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
    """Returns the damped Gauss-Newton step of shared and own unknowns.

    Args:
        jacobian: Jacobians of all parts, `(part, residuals, shared + own)`.
        residuals: Residuals of all parts, `(part, residuals)`.
        mu: Damping, as a fraction of the diagonal [1].
        point: Shared unknowns.
        low: Lower bounds of the shared unknowns.
        high: Upper bounds of the shared unknowns.

    Returns:
        The step of the shared unknowns, zero where a bound holds them, and the steps of
        the own unknowns, stacked by part on the leading axis.
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

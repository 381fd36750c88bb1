r"""The backward pass of iLQR in square-root form.

Along a trajectory states change by $\delta x_{k+1} = A_k \delta x_k + B_k \delta u_k$
and residuals by their derivatives. What is still to come costs $|S_k \delta x_k +
s_k|^2$ at least, plus a number: with the residuals $r_k + C_k \delta x_{k+1} + D_k
\delta u_k$ and damping $\mu$, the QR decomposition of

$$\begin{pmatrix} S_{k+1} B_k & S_{k+1} A_k & s_{k+1} \\
C_k B_k + D_k & C_k A_k & r_k \\ \sqrt\mu & 0 & 0 \end{pmatrix}$$

has the gains in its first rows and $S_k, s_k$ in the next. No square is formed, so that
single precision will do for stiff rods. Controls at a bound are moved there and have no
gains.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

from jaxrod.control.box_step import box_step
from jaxrod.structure import pytree


@pytree
class Linear:
    """Derivatives along a trajectory."""

    states: Float[Array, "intervals n n"]
    """Of the next state, by the state."""
    controls: Float[Array, "intervals n m"]
    """Of the next state, by the control."""
    residuals: Float[Array, "intervals r"]
    """Of every interval."""
    by_states: Float[Array, "intervals r n"]
    """Of them, by the state after it."""
    by_controls: Float[Array, "intervals r m"]
    """Of them, by the control."""
    final: Float[Array, " f"]
    """Residuals of the end."""
    final_by_state: Float[Array, "f n"]
    """Of them, by the last state."""


def backward(
    linear: Linear,
    controls: Float[Array, "intervals m"],
    lower: Float[Array, " m"],
    upper: Float[Array, " m"],
    damping: Float[Array, " m"],
) -> tuple[Float[Array, "intervals m"], Float[Array, "intervals m n"]]:
    """Changes of the controls, and their gains by changes of the states.

    Args:
        linear: Derivatives along the trajectory.
        controls: Its controls.
        lower: Smallest controls.
        upper: Largest ones.
        damping: Cost of the squared change of each control.
    """
    n, m = linear.controls.shape[1:]
    roots = jnp.sqrt(damping)

    def one(
        to_come: tuple[Array, Array], given: tuple[Array, ...]
    ) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        square, right = to_come
        a, b, r, c, d, u = given
        by_control = jnp.concatenate([square @ b, c @ b + d, jnp.diag(roots)])
        by_state = jnp.concatenate([square @ a, c @ a, jnp.zeros((m, n), a.dtype)])
        rest = jnp.concatenate([right, r, jnp.zeros((m,), a.dtype)])
        change, held = box_step(by_control, rest, lower - u, upper - u)
        # Held controls are moved, and then no longer unknowns: a row of their own keeps
        # the decomposition regular.
        moved = rest + by_control @ jnp.where(held, change, 0)
        free = jnp.where(held[None], 0, by_control)
        own = jnp.diag(jnp.where(held, 1, 0).astype(a.dtype))
        free = free.at[-m:].add(own)
        rows = jnp.concatenate([free, by_state, moved[:, None]], axis=1)
        upper_rows = jnp.linalg.qr(rows, mode="r")
        corner = upper_rows[:m, :m]
        gains = -solve_triangular(corner, upper_rows[:m, m : m + n])
        gains = jnp.where(held[:, None], 0, gains)
        next_square = upper_rows[m : m + n, m : m + n]
        return (next_square, upper_rows[m : m + n, m + n]), (change, gains)

    _, (changes, gains) = lax.scan(
        one,
        _square(linear.final_by_state, linear.final),
        (
            linear.states,
            linear.controls,
            linear.residuals,
            linear.by_states,
            linear.by_controls,
            controls,
        ),
        reverse=True,
    )
    return changes, gains


def _square(matrix: Array, right: Array) -> tuple[Array, Array]:
    """The same squares of as many rows as columns."""
    n = matrix.shape[1]
    rows = jnp.concatenate([matrix, right[:, None]], axis=1)
    missing = max(n - rows.shape[0], 0)
    rows = jnp.concatenate([rows, jnp.zeros((missing, n + 1), matrix.dtype)])
    if rows.shape[0] > n:
        rows = jnp.linalg.qr(rows, mode="r")[:n]
    return rows[:, :n], rows[:, n]

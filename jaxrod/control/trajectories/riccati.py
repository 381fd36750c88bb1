r"""The backward pass of iLQR in square-root form.

Along a trajectory states change by $\delta x_{k+1} = A_k \delta x_k + B_k \delta u_k$,
and residuals are $r_k + C_k \delta x_{k+1} + D_k \delta u_k$. The optimal cost-to-go is
$|S_k \delta x_k + s_k|^2$ plus a constant. With damping $\mu$, the QR decomposition of

$$\begin{pmatrix} S_{k+1} B_k & S_{k+1} A_k & s_{k+1} \\
C_k B_k + D_k & C_k A_k & r_k \\ \sqrt\mu & 0 & 0 \end{pmatrix}$$

has the gains in its first rows and $S_k, s_k$ in the next. No squares of matrices are
formed, so that single precision suffices for stiff rods. Controls held at a bound are
moved to it and have no gains.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

from jaxrod.control.trajectories.box_step import box_step
from jaxrod.structure import pytree


@pytree
class Linear:
    """Linearisation along a trajectory."""

    states: Float[Array, "intervals n n"]
    """Derivatives $A_k$ of the next state by the state."""
    controls: Float[Array, "intervals n m"]
    """Derivatives $B_k$ of the next state by the control."""
    residuals: Float[Array, "intervals r"]
    """Residuals $r_k$ of every interval."""
    by_states: Float[Array, "intervals r n"]
    """Derivatives $C_k$ of the residuals by the state after the interval."""
    by_controls: Float[Array, "intervals r m"]
    """Derivatives $D_k$ of the residuals by the control."""
    final: Float[Array, " f"]
    """Residuals of the last state."""
    final_by_state: Float[Array, "f n"]
    """Derivatives of the final residuals by the last state."""


def backward(
    linear: Linear,
    controls: Float[Array, "intervals m"],
    lower: Float[Array, " m"],
    upper: Float[Array, " m"],
    damping: Float[Array, " m"],
) -> tuple[Float[Array, "intervals m"], Float[Array, "intervals m n"]]:
    """Returns changes of the controls, and their feedback gains on state changes.

    Args:
        linear: Linearisation along the trajectory.
        controls: Controls of the trajectory.
        lower: Lower bounds of the controls.
        upper: Upper bounds of the controls.
        damping: Weight of the squared change of each control.
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
        # Held controls are moved first, and are then no longer unknowns. A row of their
        # own keeps the decomposition regular.
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
    """Reduces or pads a least-squares system to as many rows as columns.

    Its sum of squares stays the same up to a constant.
    """
    n = matrix.shape[1]
    rows = jnp.concatenate([matrix, right[:, None]], axis=1)
    missing = max(n - rows.shape[0], 0)
    rows = jnp.concatenate([rows, jnp.zeros((missing, n + 1), matrix.dtype)])
    if rows.shape[0] > n:
        rows = jnp.linalg.qr(rows, mode="r")[:n]
    return rows[:, :n], rows[:, n]

r"""Derivatives of the windows of a trajectory, propagated from window to window.

Window $w$ has residuals $r_w(p, x_w)$ and an end state $e_w(p, x_w)$, both functions of
its initial state $x_w$. The first state is a function of unknowns $s$,
$x_1 = b(p, s)$. Later initial states are iterates that may leave gaps,
$g_{w+1} = e_w - x_{w+1}$. To first order

$$\delta x_{w+1} = \frac{\partial e_w}{\partial x} \delta x_w
+ \frac{\partial e_w}{\partial p} \delta p + g_{w+1}
= A_{w+1} \begin{pmatrix} \delta p \\ \delta s \end{pmatrix} + c_{w+1},$$

which is propagated in forward mode, with a column for each unknown and one for the
gaps. The cost is that of one run with as many tangents, whatever the size of a state.

Source: H. G. Bock, Recent advances in parameter identification techniques for O.D.E.,
1983; J. Albersmeyer, M. Diehl, The lifted Newton method and its application in
optimization, 2010.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from jaxrod.structure import pytree


@pytree
class JoinedPoint:
    """Unknowns, and initial states of windows, stacked on the leading axis."""

    shared: Array
    own: Array
    states: Array


@pytree
class JoinedSlopes:
    """Residuals of each window, and derivatives of residuals and initial states."""

    residuals: Array
    jacobian: Array
    closing: Array
    """Change of the residuals when all gaps so far are closed, to first order."""
    jump: Array
    """Change of the residuals due to the gap at the window's own start alone."""
    ways: Array
    """Derivatives of each window's initial state by the unknowns."""
    shift: Array
    """Change of each window's initial state when the gaps are closed."""

    @property
    def closed(self) -> Array:
        """Residuals after the gaps are closed, to first order."""
        return self.residuals + self.closing


def follow_windows(
    opening: Callable[[Array, Array, Any], Array],
    window: Callable[[Array, Array, Any], tuple[Array, Array]],
) -> Callable[[JoinedPoint, Any], tuple[Array, JoinedSlopes]]:
    """Returns a function that evaluates one trajectory, window after window.

    Args:
        opening: Takes shared unknowns, own unknowns and the known data of the first
            window; returns its initial state.
        window: Takes shared unknowns, an initial state and the known data of the
            window; returns the residuals and the state at the end.

    Returns:
        `point, known -> states, slopes`, all stacked by window on the leading axis. The
        first of the states is the one that follows from the unknowns.
    """

    def one(point: JoinedPoint, known: Any) -> tuple[Array, JoinedSlopes]:
        shared, shares, dtype = point.shared, point.shared.size, point.shared.dtype
        unknowns = jnp.concatenate([shared, point.own])
        at_first = jax.tree.map(lambda leaf: leaf[0], known)

        def opened(unknowns: Array) -> Array:
            return opening(unknowns[:shares], unknowns[shares:], at_first)

        eye = jnp.eye(unknowns.size, dtype=dtype)
        state, ways = jax.vmap(
            lambda way: jax.jvp(opened, (unknowns,), (way,)), out_axes=(None, 1)
        )(eye)
        states = point.states.at[0].set(state)
        # Columns: the unknowns, all gaps so far, and the last gap alone.
        shared_ways = jnp.concatenate(
            [eye[:shares], jnp.zeros((shares, 2), dtype)], axis=1
        )

        def next_window(carry: tuple[Array, ...], given: Any) -> Any:
            ways, shift, gap = carry
            state, following, knowing = given

            def run(shared: Array, state: Array) -> tuple[Array, Array]:
                return window(shared, state, knowing)

            def column(by_shared: Array, by_state: Array) -> Any:
                return jax.jvp(run, (shared, state), (by_shared, by_state))

            columns = jnp.concatenate([ways, shift[:, None], gap[:, None]], axis=1)
            (values, end), (rows, ends) = jax.vmap(
                column, in_axes=(1, 1), out_axes=(None, 1)
            )(shared_ways, columns)
            opens = end - following
            slopes = JoinedSlopes(
                values, rows[:, :-2], rows[:, -2], rows[:, -1], ways, shift
            )
            return (ends[:, :-2], ends[:, -2] + opens, opens), slopes

        nothing = jnp.zeros_like(state)
        following = jnp.roll(states, -1, axis=0)
        _, slopes = lax.scan(
            next_window, (ways, nothing, nothing), (states, following, known)
        )
        return states, slopes

    return one

r"""What windows of a trajectory depend on, followed from one to the next.

Window $w$ has residuals $r_w(p, x_w)$ and end $e_w(p, x_w)$ from its initial state
$x_w$; the first state is made of unknowns $s$, $x_1 = b(p, s)$, later ones are iterates
that may leave gaps, $g_{w+1} = e_w - x_{w+1}$. To first order

$$\delta x_{w+1} = \frac{\partial e_w}{\partial x} \delta x_w
+ \frac{\partial e_w}{\partial p} \delta p + g_{w+1}
= A_{w+1} \begin{pmatrix} \delta p \\ \delta s \end{pmatrix} + c_{w+1},$$

which is carried on by forward mode, a column for each unknown and one for the gaps: the
cost is that of one run with as many tangents, whatever the size of a state.

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
    """Unknowns, and states at the starts of windows, stacked in front."""

    shared: Array
    own: Array
    states: Array


@pytree
class JoinedSlopes:
    """Residuals by window, and what they and states depend on."""

    residuals: Array
    jacobian: Array
    closing: Array
    """What closing the gaps adds to residuals."""
    jump: Array
    """What the gap at a window's own start adds."""
    ways: Array
    """Of the state at the start of each window, by unknowns."""
    shift: Array
    """What closing the gaps adds to it."""

    @property
    def closed(self) -> Array:
        """Residuals as they are when gaps are closed, to first order."""
        return self.residuals + self.closing


def follow_windows(
    opening: Callable[[Array, Array, Any], Array],
    window: Callable[[Array, Array, Any], tuple[Array, Array]],
) -> Callable[[JoinedPoint, Any], tuple[Array, JoinedSlopes]]:
    """Makes states and slopes of one trajectory, window after window.

    Args:
        opening: Takes shared and own unknowns and what is known of the first window;
            makes the state there.
        window: Takes shared unknowns, a state and what is known of the window; makes
            residuals and the state at the end.

    Returns:
        `point, known -> states, slopes`, all stacked in front by window; the states
        with the first as the unknowns have it.
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
        # Columns: the unknowns, all gaps so far, and the last one alone.
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

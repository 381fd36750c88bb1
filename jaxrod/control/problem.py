r"""A problem of control: a start, what controls do, and what of that costs.

Time is cut into equal intervals. In interval $k$ the control $u_k$ is held and takes
the state $x_k$ to $x_{k+1} = f(x_k, u_k, k)$. What costs is a sum of squares,

$$L = \sum_k |r(x_{k+1}, u_k, k)|^2 + |r_N(x_N)|^2,$$

so that each solver can take it: those that follow a gradient, those that use the
residuals' derivatives (Gauss-Newton, iLQR), and those that only look at the cost.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxrod.structure import pytree, static
from jaxrod.validation import check_count

Move = Callable[[Any, Any, Array, Array], Any]
"""`(data, state, control, interval) -> state`, after one interval."""
Running = Callable[[Any, Any, Array, Array], Any]
"""`(data, state, control, interval) -> residuals`, of the state after it."""
Final = Callable[[Any, Any], Any]
"""`(data, state) -> residuals`, of the last state."""


@pytree
class Problem:
    """A problem of control; see the module. Make one with `make_problem`.

    Numbers are traced: other numbers, another start, another target are solved by the
    program that is there. A batch of problems is a `jax.vmap` over its leaves.
    """

    start: Any
    """State at time zero, any pytree."""
    data: Any
    """All that the functions read: a scene, a target, weights. Any pytree."""
    lower: Float[Array, " controls"]
    """Smallest controls."""
    upper: Float[Array, " controls"]
    """Largest controls."""
    interval: Float[Array, ""]
    """Duration of an interval [s]."""
    move: Move = static()
    """What an interval makes of a state."""
    running: Running | None = static()
    """Residuals of every interval."""
    final: Final | None = static()
    """Residuals of the end."""
    n_intervals: int = static()
    """Their number."""

    @property
    def n_controls(self) -> int:
        """Numbers of one control."""
        return int(self.lower.shape[-1])


def make_problem(
    start: Any,
    move: Move,
    *,
    n_intervals: int,
    interval: float,
    n_controls: int,
    running: Running | None = None,
    final: Final | None = None,
    data: Any = None,
    lower: Any = -1.0,
    upper: Any = 1.0,
) -> Problem:
    """A problem of control, checked.

    Functions are structure: a program is compiled for each. Write them at the top of a
    module and hand numbers on in `data`, rather than making new ones for new numbers.

    Args:
        start: State at time zero, any pytree of arrays.
        move: `(data, state, control, k) -> state` after interval `k`.
        n_intervals: Number of intervals.
        interval: Duration of one [s].
        n_controls: Numbers of one control.
        running: `(data, state, control, k) -> residuals`, of the state after interval
            `k` and the control in it; any pytree of floats.
        final: `(data, state) -> residuals`, of the last state.
        data: What the functions read, any pytree.
        lower: Smallest controls, a number or one each.
        upper: Largest controls.

    Raises:
        ValueError: an argument is out of range, `move` makes something else than a
            state, or nothing costs.
    """
    n_intervals = check_count("n_intervals", n_intervals, 1)
    n_controls = check_count("n_controls", n_controls, 1)
    if running is None and final is None:
        raise ValueError("running or final must be given: nothing costs otherwise")
    if not float(interval) > 0:
        raise ValueError(f"interval must be positive, got {interval!r} s")
    start = jax.tree.map(jnp.asarray, start)
    dtype = jnp.result_type(*_floats(start), jnp.float32)
    low, high = (
        jnp.broadcast_to(jnp.asarray(bound, dtype), (n_controls,))
        for bound in (lower, upper)
    )
    if not np.all(np.asarray(low) < np.asarray(high)):
        raise ValueError(f"lower must be below upper, got {lower!r} and {upper!r}")
    problem = Problem(
        start=start,
        data=data,
        lower=low,
        upper=high,
        interval=jnp.asarray(interval, dtype),
        move=move,
        running=running,
        final=final,
        n_intervals=n_intervals,
    )
    after = jax.eval_shape(
        lambda p: p.move(p.data, p.start, p.lower, jnp.zeros((), jnp.int32)), problem
    )
    before = jax.eval_shape(lambda state: state, start)
    if not _alike(before, after):
        raise ValueError(
            "move must make a state of the same shapes and types as the start: "
            f"{before} became {after}"
        )
    return problem


def trajectory(problem: Problem, controls: Float[Array, "intervals controls"]) -> Any:
    """States at the start and after each interval, stacked in front."""

    def one(state: Any, given: tuple[Array, Array]) -> tuple[Any, Any]:
        after = problem.move(problem.data, state, *given)
        return after, after

    _, states = lax.scan(one, problem.start, (controls, numbers(problem)))
    return jax.tree.map(
        lambda first, rest: jnp.concatenate([first[None], rest]), problem.start, states
    )


def residuals(problem: Problem, controls: Float[Array, "intervals controls"]) -> Any:
    """Residuals of all intervals, stacked in front, and of the end.

    In reverse mode one state per interval is kept and the steps of one interval at a
    time.
    """
    along, last = run(problem, controls)
    end = None if problem.final is None else problem.final(problem.data, last)
    return along, end


def run(
    problem: Problem, controls: Float[Array, "intervals controls"]
) -> tuple[Any, Any]:
    """Residuals of all intervals, stacked in front, and the last state."""

    def one(state: Any, given: tuple[Array, Array]) -> tuple[Any, Any]:
        after = problem.move(problem.data, state, *given)
        if problem.running is None:
            return after, None
        return after, problem.running(problem.data, after, *given)

    kept = jax.checkpoint(one, prevent_cse=False)
    last, along = lax.scan(kept, problem.start, (controls, numbers(problem)))
    return along, last


def cost(
    problem: Problem, controls: Float[Array, "intervals controls"]
) -> Float[Array, ""]:
    """Sum of the squares of all residuals; differentiable."""
    return squares(residuals(problem, controls))


def squares(made: Any) -> Float[Array, ""]:
    """Sum of the squares of all numbers of a pytree that has some."""
    first, *rest = (jnp.sum(leaf**2) for leaf in jax.tree.leaves(made))
    return sum(rest, first)


def over_time(
    knots: Float[Array, "knots controls"], n_intervals: int
) -> Float[Array, "intervals controls"]:
    """Controls in the middle of every interval, linear between knots.

    Knots are equally spaced from the start to the end; a single one is held.
    """
    last = knots.shape[0] - 1
    place = (np.arange(n_intervals) + 0.5) * (last / n_intervals)
    before = np.clip(np.floor(place).astype(int), 0, max(last - 1, 0))
    share = jnp.asarray(place - before, knots.dtype)[:, None]
    after = np.minimum(before + 1, last)
    return (1 - share) * knots[before] + share * knots[after]


def numbers(problem: Problem) -> Int[Array, " intervals"]:
    """Of the intervals, from 0."""
    return jnp.arange(problem.n_intervals, dtype=jnp.int32)


def _alike(before: Any, after: Any) -> bool:
    """Whether two trees have the same structure, shapes and types."""
    trees: list[Any] = [jax.tree.structure(state) for state in (before, after)]
    kinds = [
        [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(state)]
        for state in (before, after)
    ]
    return bool(trees[0] == trees[1]) and kinds[0] == kinds[1]


def _floats(tree: Any) -> list[Array]:
    return [
        leaf
        for leaf in jax.tree.leaves(tree)
        if jnp.issubdtype(jnp.asarray(leaf).dtype, jnp.floating)
    ]

r"""An optimal control problem: an initial state, dynamics under controls, and a cost.

Time is divided into equal intervals. In interval $k$ the control $u_k$ is constant, and
the state moves from $x_k$ to $x_{k+1} = f(x_k, u_k, k)$. The cost is a sum of squares,

$$L = \sum_k |r(x_{k+1}, u_k, k)|^2 + |r_N(x_N)|^2,$$

so that every kind of solver applies: gradient descent, solvers that use the
derivatives of residuals (Gauss-Newton, iLQR), and solvers that only use the cost.
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
from jaxrod.validation import check_array, check_count, check_kind, check_seed

Move = Callable[[Any, Any, Array, Array], Any]
"""`(data, state, control, interval) -> state`: the state after one interval."""
Running = Callable[[Any, Any, Array, Array], Any]
"""`(data, state, control, interval) -> residuals`, with the state after the interval.
"""
Final = Callable[[Any, Any], Any]
"""`(data, state) -> residuals`, for the last state."""
Policy = Callable[[Any, Array], Array]
"""`(state, interval) -> control`, called at the beginning of the interval."""
Disturbance = Callable[[Any, Array], Any]
"""`(state, interval) -> state`, applied before the policy is called."""


@pytree
class Problem:
    """An optimal control problem: start, dynamics, residuals, bounds (`make_problem`).

    Arrays are traced: the same compiled program solves problems with another initial
    state, target or bounds, and `jax.vmap` solves a batch of problems.

    Example:
        >>> problem = control.make_problem(
        ...     jnp.zeros(1),
        ...     lambda goal, place, push, k: place + 0.1 * push,
        ...     final=lambda goal, place: place - goal,
        ...     data=jnp.array([0.5]),
        ...     n_intervals=10, interval=0.1, n_controls=1,
        ... )
        >>> problem.n_controls, problem.at_the_end(jnp.array([0.25])).tolist()
        (1, [-0.25])
    """

    start: Any
    """State at time zero, any pytree."""
    data: Any
    """Data that the functions read: a scene, a target, weights. Any pytree."""
    lower: Float[Array, " controls"]
    """Lower bounds of the controls."""
    upper: Float[Array, " controls"]
    """Upper bounds of the controls."""
    interval: Float[Array, ""]
    """Duration of an interval [s]."""
    move: Move = static()
    """Function that simulates one interval, see `Move`."""
    running: Running | None = static()
    """Function that returns the residuals of an interval, see `Running`; or `None`."""
    final: Final | None = static()
    """Function that returns the residuals of the last state, see `Final`; or `None`."""
    n_intervals: int = static()
    """Number of intervals."""

    @property
    def n_controls(self) -> int:
        """Number of values in one control vector."""
        return int(self.lower.shape[-1])

    def step(self, state: Any, control: Array, interval: Array) -> tuple[Any, Any]:
        """Returns the state after interval number `interval`, and its residuals."""
        after = self.move(self.data, state, control, interval)
        return after, self.on_the_way(after, control, interval)

    def on_the_way(self, after: Any, control: Array, interval: Array) -> Any:
        """Returns the residuals of an interval, computed by `running`.

        `after` is the state after the interval. Returns `None` if the problem has no
        `running`.
        """
        if self.running is None:
            return None
        return self.running(self.data, after, control, interval)

    def at_the_end(self, last: Any) -> Any:
        """Returns the residuals of the last state; `None` without `final`."""
        return None if self.final is None else self.final(self.data, last)


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
    """Makes an optimal control problem, with validated arguments.

    Functions are static: a program is compiled for each. Define them at module level
    and pass numbers in `data`, rather than making new functions for new numbers.

    Args:
        start: State at time zero, any pytree of arrays.
        move: `(data, state, control, k) -> state` after interval `k`.
        n_intervals: Number of intervals.
        interval: Duration of an interval [s].
        n_controls: Number of values in one control vector.
        running: `(data, state, control, k) -> residuals` of the state after interval
            `k` and the control in it; any pytree of floats.
        final: `(data, state) -> residuals` of the last state.
        data: Data that the functions read, any pytree.
        lower: Lower bounds of the controls: one number, or one per control.
        upper: Upper bounds of the controls: one number, or one per control.

    Raises:
        ValueError: An argument is out of range, `move` does not return a state like
            `start`, or neither `running` nor `final` is given.

    Example:
        >>> problem = control.make_problem(
        ...     jnp.zeros(1),
        ...     lambda goal, place, push, k: place + 0.1 * push,
        ...     final=lambda goal, place: place - goal,
        ...     data=jnp.array([0.5]),
        ...     n_intervals=10, interval=0.1, n_controls=1,
        ... )
        >>> after, _ = problem.step(problem.start, jnp.array([1.0]), 0)
        >>> print(after)
        [0.1]
    """
    n_intervals = check_count("n_intervals", n_intervals, 1)
    n_controls = check_count("n_controls", n_controls, 1)
    if running is None and final is None:
        raise ValueError("running or final must be given: there is no cost otherwise")
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
    """Simulates controls; returns the states at the start and after each interval."""

    def one(state: Any, given: tuple[Array, Array]) -> tuple[Any, Any]:
        after = problem.move(problem.data, state, *given)
        return after, after

    _, states = lax.scan(one, problem.start, (controls, numbers(problem)))
    return jax.tree.map(
        lambda first, rest: jnp.concatenate([first[None], rest]), problem.start, states
    )


def residuals(problem: Problem, controls: Float[Array, "intervals controls"]) -> Any:
    """Returns the residuals of all intervals, stacked, and those of the last state.

    In reverse mode, one state per interval is stored, and the steps of only one
    interval at a time (checkpointing).
    """

    def one(state: Any, given: tuple[Array, Array]) -> tuple[Any, Any]:
        return problem.step(state, *given)

    kept = jax.checkpoint(one, prevent_cse=False)
    last, along = lax.scan(kept, problem.start, (controls, numbers(problem)))
    return along, problem.at_the_end(last)


def cost(
    problem: Problem, controls: Float[Array, "intervals controls"]
) -> Float[Array, ""]:
    """Cost of controls: the sum of the squares of all residuals; differentiable."""
    return squares(residuals(problem, controls))


def squares(made: Any) -> Float[Array, ""]:
    """Sum of the squares of all numbers of a non-empty pytree."""
    first, *rest = (jnp.sum(leaf**2) for leaf in jax.tree.leaves(made))
    return sum(rest, first)


def over_time(
    knots: Float[Array, "knots controls"], n_intervals: int
) -> Float[Array, "intervals controls"]:
    """Interpolates controls linearly between knots, at the middle of every interval.

    Knots are equally spaced from the start to the end; a single knot is held.
    """
    last = knots.shape[0] - 1
    place = (np.arange(n_intervals) + 0.5) * (last / n_intervals)
    before = np.clip(np.floor(place).astype(int), 0, max(last - 1, 0))
    share = jnp.asarray(place - before, knots.dtype)[:, None]
    after = np.minimum(before + 1, last)
    return (1 - share) * knots[before] + share * knots[after]


def numbers(problem: Problem) -> Int[Array, " intervals"]:
    """Indices of the intervals, from 0."""
    return jnp.arange(problem.n_intervals, dtype=jnp.int32)


def _alike(before: Any, after: Any) -> bool:
    """Whether two trees have the same structure, shapes and types.

    Used to check that a state after an interval is like the one before.
    """
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


@pytree
class RolledOut:
    """Motion under a policy, simulated by `rolled_out`.

    Example:
        >>> problem = control.make_problem(
        ...     jnp.zeros(1),
        ...     lambda goal, place, push, k: place + 0.1 * push,
        ...     final=lambda goal, place: place - goal,
        ...     data=jnp.array([0.5]),
        ...     n_intervals=10, interval=0.1, n_controls=1,
        ... )
        >>> done = control.rolled_out(problem, lambda place, k: 0.0 * place)
        >>> done.states.shape, done.controls.shape, float(done.cost)
        ((11, 1), (10, 1), 0.25)
    """

    states: Any
    """States at the start and after each interval, stacked on the leading axis."""
    controls: Float[Array, "intervals controls"]
    """Control of each interval: the policy's, clipped to the bounds."""
    cost: Float[Array, ""]
    """Cost of the motion: sum of the squares of all residuals."""


def rolled_out(
    problem: Problem, policy: Policy, disturbance: Disturbance | None = None
) -> RolledOut:
    """Simulates the motion of a problem under a policy. Pure; traceable.

    Args:
        problem: The problem.
        policy: `(state, interval) -> control`: `solution.policy` with feedback,
            `solution.open_loop` without feedback, or any other.
        disturbance: `(state, interval) -> state`, a change of the state before each
            interval; none by default.

    Raises:
        TypeError: `problem` is not a `Problem`.

    Example:
        >>> problem = control.make_problem(
        ...     jnp.zeros(1),
        ...     lambda goal, place, push, k: place + 0.1 * push,
        ...     final=lambda goal, place: place - goal,
        ...     data=jnp.array([0.5]),
        ...     n_intervals=10, interval=0.1, n_controls=1,
        ... )
        >>> done = control.rolled_out(problem, lambda place, k: 2.0 * (0.5 - place))
        >>> [round(float(place), 2) for place in done.states[:4, 0]]
        [0.0, 0.1, 0.18, 0.24]
    """
    check_problem(problem)

    def one(state: Any, k: Array) -> tuple[Any, Any]:
        met = state if disturbance is None else disturbance(state, k)
        control = jnp.clip(policy(met, k), problem.lower, problem.upper)
        after, made = problem.step(met, control, k)
        return after, (after, control, made)

    last, (states, controls, made) = lax.scan(one, problem.start, numbers(problem))
    return RolledOut(
        states=jax.tree.map(
            lambda first, rest: jnp.concatenate([first[None], rest]),
            problem.start,
            states,
        ),
        controls=controls,
        cost=squares((made, problem.at_the_end(last))),
    )


SPREAD = 1e-3
"""Standard deviation of the random initial knots, as a fraction of half the range
between the bounds [1]. It breaks the symmetry of a straight rod, whose gradient may
vanish."""
MOST_KNOTS = 100_000


def check_problem(problem: Any) -> None:
    """Raises a TypeError unless `problem` is a `Problem`."""
    check_kind("problem", problem, Problem)


def half_widths(problem: Problem) -> Float[Array, " controls"]:
    """Half the range between the bounds of each control; 1 if it has no bounds."""
    half = 0.5 * (problem.upper - problem.lower)
    return jnp.where(jnp.isfinite(half), half, 1)


def first_knots(
    problem: Problem, n_knots: int, given: Any, seed: int, spread: float = SPREAD
) -> Float[Array, "knots controls"]:
    """Returns the initial knots: the given ones, or small random ones about zero.

    Args:
        problem: The problem.
        n_knots: Number of knots.
        given: Given knots `(n_knots, n_controls)`, or `None` for random ones.
        seed: Seed of the random knots.
        spread: Standard deviation of the random knots, as a fraction of half the range
            between the bounds [1].

    Raises:
        ValueError: The given knots have the wrong shape or exceed the bounds.
    """
    n_knots = check_count("n_knots", n_knots, 1, MOST_KNOTS)
    shape = (n_knots, problem.n_controls)
    if given is not None:
        return within_bounds(problem, "initial_knots", given, shape)
    noise = jax.random.normal(
        jax.random.key(check_seed(seed)), shape, problem.lower.dtype
    )
    return jnp.clip(
        spread * half_widths(problem)[None] * noise,
        problem.lower[None],
        problem.upper[None],
    )


def within_bounds(
    problem: Problem, name: str, given: Any, shape: tuple[int, ...]
) -> Array:
    """Validates controls and returns them in the dtype of the problem.

    `shape` is the required shape, `name` the name of the controls in error messages.

    Raises:
        ValueError: They have the wrong shape, are not finite or exceed the bounds.
    """
    values = np.asarray(check_array(name, given, [shape], ""))
    low, high = np.asarray(problem.lower), np.asarray(problem.upper)
    beyond = (values < low - 1e-6 * np.abs(low)) | (values > high + 1e-6 * np.abs(high))
    if beyond.any():
        raise ValueError(
            f"{name} must be within the bounds of the problem, got "
            f"{values[beyond].flat[0]:g}"
        )
    dtype = problem.lower.dtype
    # Clip again after rounding to the dtype of the problem and of the bounds.
    return jnp.clip(
        jnp.asarray(values, dtype), problem.lower[None], problem.upper[None]
    )

"""The solution of an optimal control problem, and the cache of compiled solvers."""

from __future__ import annotations

import dataclasses
import time
from collections import OrderedDict
from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from jaxrod.control.trajectories.problem import Problem
from jaxrod.lanes.choice import lane_mode
from jaxrod.rods.rod import RodState

MOST_PROGRAMS = 64
"""Largest number of compiled programs in the cache, one per structure of arguments; the
least recently used one is dropped first."""

_kept: OrderedDict[Any, Any] = OrderedDict()


@dataclasses.dataclass(frozen=True, eq=False)
class Solution:
    """Best controls that a solver found, their motion, and a record of the search.

    Example:
        >>> problem = control.make_problem(
        ...     jnp.zeros(1),
        ...     lambda goal, place, push, k: place + 0.1 * push,
        ...     final=lambda goal, place: place - goal,
        ...     data=jnp.array([0.5]),
        ...     n_intervals=10, interval=0.1, n_controls=1,
        ... )
        >>> found = control.levenberg_marquardt(problem, n_knots=2)
        >>> found.converged, found.controls.shape, found.states.shape
        (True, (10, 1), (11, 1))
    """

    problem: Problem
    """The problem that was solved; with a `design`, its data describe that design."""
    solver: str
    """Name of the solver function, such as "ilqr"."""
    controls: Float[Array, "intervals controls"]
    """Controls of all intervals."""
    states: Any
    """The motion: states at the start and after each interval, on the leading axis."""
    cost: float
    """Cost of the motion: the problem's sum of squares, without a solver's ridge."""
    history: dict[str, np.ndarray]
    """Values per iteration by name. "cost" is the cost with the solver's ridge, and
    begins with that of the initial guess for `ilqr`, `levenberg_marquardt` and
    `codesign`."""
    converged: bool
    """Whether the search met its criterion: a small last change, or for `adam` the cost
    `enough`. Always false for `mppi` and `cross_entropy`."""
    reason: str
    """Reason why the solver stopped, as text."""
    iterations: int
    """Number of iterations made."""
    compile_s: float
    """Compile time [s]; 0 if the program was already compiled."""
    run_s: float
    """Time of running the compiled program [s]."""
    interrupted: bool = False
    """Whether Ctrl-C ended the search."""
    knots: Float[Array, "knots controls"] | None = None
    """Controls at equally spaced times, with linear interpolation; `None` for solvers
    without knots."""
    gains: Float[Array, "intervals controls numbers"] | None = None
    """Feedback gains of `ilqr`: derivatives of each interval's control with respect to
    the state at its beginning, flattened leaf by leaf; `None` for other solvers."""
    design: Any = None
    """Design of the body found by `codesign`; `None` for other solvers."""

    @property
    def times(self) -> Float[np.ndarray, " intervals+1"]:
        """Times of `states`: 0 and the ends of the intervals [s]."""
        count = self.problem.n_intervals
        return np.arange(count + 1) * float(self.problem.interval)

    def open_loop(self, state: Any, interval: Int[Array, ""]) -> Array:
        """Policy without feedback: the control of an interval, whatever the state."""
        del state
        return self.controls[interval]

    def policy(self, state: Any, interval: Int[Array, ""]) -> Array:
        """Policy with feedback: u_k + K_k (x - x_k), clipped to the bounds.

        Here x_k, u_k and K_k are `states`, `controls` and `gains`. Pure; traceable.

        Args:
            state: State at the beginning of the interval.
            interval: Index of the interval.

        Raises:
            ValueError: The solver gives no feedback.
        """
        if self.gains is None:
            raise ValueError(
                f"a solution of {self.solver} has no feedback: use "
                "jaxrod.control.ilqr, or open_loop, which is a policy without feedback"
            )
        planned = jax.tree.map(lambda leaf: leaf[interval], self.states)
        away = ravel_pytree(state)[0] - ravel_pytree(planned)[0]
        control = self.controls[interval] + self.gains[interval] @ away
        return jnp.clip(control, self.problem.lower, self.problem.upper)

    @property
    def readouts(self) -> dict[str, np.ndarray]:
        """Values over time by name, from `problem.data.readouts` (empty without it)."""
        readouts = getattr(self.problem.data, "readouts", None)
        if readouts is None:
            return {}
        made = jax.vmap(readouts)(self.states)
        return {name: np.asarray(numbers) for name, numbers in made.items()}

    def replay(
        self, title: str = "Optimal trajectory", up: Literal["x", "y", "z"] = "y"
    ) -> Any:
        """Makes a `jaxrod.viz.Replay` of the motion, with the target if there is one.

        Args:
            title: Heading of the player.
            up: World axis that is drawn upwards.

        Raises:
            ValueError: The states are not those of a rod whose scene is in the data.
        """
        from jaxrod.viz import Replay, Sphere

        data = self.problem.data
        scene = getattr(data, "scene", None)
        if scene is None or not isinstance(self.states, RodState):
            raise ValueError(
                "a replay needs states of a rod and data that have its scene, got "
                f"{type(self.states).__name__} and {type(data).__name__}: "
                "jaxrod.viz.Replay.from_states shows a rod out of a larger state"
            )
        target = getattr(data, "target", None)
        spheres = [] if target is None else [Sphere(np.asarray(target, float), 0.02)]
        return Replay.from_states(
            scene,
            self.states,
            self.times,
            spheres=spheres,
            readouts=self.readouts,
            title=title,
            up=up,
        )

    def __repr__(self) -> str:
        """Summarises result, reason for stopping, and times in a few lines."""
        ends = [f"{n}: {v[-1]:.4g}" for n, v in self.readouts.items() if v.ndim == 1]
        lines = [
            f"Solution by {self.solver}: cost {self.cost:.4g} after {self.iterations} "
            f"iterations, {'' if self.converged else 'not '}converged: {self.reason}",
            *([f"at the end {', '.join(ends)}"] if ends else []),
            f"{self.problem.n_intervals} intervals of "
            f"{float(self.problem.interval):.4g} s, {self.problem.n_controls} controls"
            + ("" if self.knots is None else f", {len(self.knots)} knots")
            + ("" if self.gains is None else ", with feedback"),
            f"compiled in {self.compile_s:.2f} s, run in {self.run_s:.2f} s",
        ]
        return "\n    ".join(lines)


def reason_to_stop(converged: bool, tried: int, iterations: int, gained: str) -> str:
    """Reason why a damped search stopped, as text.

    It is the text `gained` if the search converged. Otherwise `tried`, the number of
    steps tried, may have reached the limit `iterations`, or no step lowers the cost.
    """
    if converged:
        return gained
    if tried >= iterations:
        return f"{iterations} iterations were made"
    return "no step makes the cost smaller"


def timed(
    function: Callable[..., Any], *arguments: Any, **structure: Any
) -> tuple[Any, float, float]:
    """Runs a function of pytrees of arrays, compiled and cached, and times it.

    Args:
        function: Pure function, defined at module level because it is part of the
            cache's key.
        *arguments: Traced arguments.
        **structure: Static, hashable arguments.

    Returns:
        The result; the time of compiling [s], 0 if the program was in the cache; and
        the time of running [s].
    """
    began = time.perf_counter()
    leaves, tree = jax.tree.flatten(arguments)
    kinds = tuple(jax.typeof(leaf) for leaf in leaves)
    # A program also depends on the precision and on `lane_mode`.
    setting = (lane_mode(), jax.config.read("jax_enable_x64"))
    key = (function, tuple(sorted(structure.items())), tree, kinds, setting)
    program = _kept.pop(key, None)
    compile_s = 0.0
    if program is None:
        compiled = jax.jit(partial(function, **structure)).lower(*arguments)
        program = compiled.compile()
        compile_s = time.perf_counter() - began
    _kept[key] = program
    while len(_kept) > MOST_PROGRAMS:
        _kept.popitem(last=False)
    ready = time.perf_counter()
    result = jax.block_until_ready(program(*arguments))
    return result, compile_s, time.perf_counter() - ready

"""The solution of a problem of control: controls, motion, cost, how it was found."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from jaxrod.control.problem import Problem
from jaxrod.rods.rod import RodState


@dataclasses.dataclass(frozen=True, eq=False)
class Solution:
    """The best controls that a solver found, and how it found them."""

    problem: Problem
    """The problem that was solved."""
    solver: str
    """The solver's name."""
    controls: Float[Array, "intervals controls"]
    """Control of every interval."""
    states: Any
    """The motion: states at the start and after each interval, stacked in front."""
    cost: float
    """Cost of the problem, the sum of its squares; no ridge of a solver is in it."""
    history: dict[str, np.ndarray]
    """By name, one number for each iteration; "cost" is what the solver made less."""
    converged: bool
    """Whether the solver stopped because there was no more to gain."""
    reason: str
    """Why it stopped, in words."""
    iterations: int
    """Steps tried."""
    compile_s: float
    """Time that compiling took [s]; 0 if the program was there."""
    run_s: float
    """Time that running took [s]."""
    interrupted: bool = False
    """Whether Ctrl-C ended it."""
    knots: Float[Array, "knots controls"] | None = None
    """Controls at equally spaced times, linear between, of solvers that use knots."""
    gains: Float[Array, "intervals controls numbers"] | None = None
    """Feedback of solvers that give it: change of the control per change of the state,
    whose numbers are those of its leaves one after the other."""
    design: Any = None
    """The numbers of the body, if it was found with the controls."""

    @property
    def times(self) -> Float[np.ndarray, " intervals+1"]:
        """Ends of the intervals, from 0 [s]."""
        count = self.problem.n_intervals
        return np.arange(count + 1) * float(self.problem.interval)

    def open_loop(self, state: Any, interval: Int[Array, ""]) -> Array:
        """The control of an interval, whatever the state is: a policy."""
        del state
        return self.controls[interval]

    def policy(self, state: Any, interval: Int[Array, ""]) -> Array:
        """The control of an interval, with feedback of where the state is.

        Pure; traceable.

        Args:
            state: At the beginning of the interval.
            interval: Its number.

        Raises:
            ValueError: the solver gives no feedback.
        """
        if self.gains is None:
            raise ValueError(
                f"a solution of {self.solver} has no feedback: jaxrod.control.ilqr "
                "gives it, and open_loop is a policy without"
            )
        planned = jax.tree.map(lambda leaf: leaf[interval], self.states)
        away = ravel_pytree(state)[0] - ravel_pytree(planned)[0]
        control = self.controls[interval] + self.gains[interval] @ away
        return jnp.clip(control, self.problem.lower, self.problem.upper)

    @property
    def readouts(self) -> dict[str, np.ndarray]:
        """What the problem's data say of the states, by name with a unit."""
        readouts = getattr(self.problem.data, "readouts", None)
        if readouts is None:
            return {}
        made = jax.vmap(readouts)(self.states)
        return {name: np.asarray(numbers) for name, numbers in made.items()}

    def replay(
        self, title: str = "Optimal trajectory", up: Literal["x", "y", "z"] = "y"
    ) -> Any:
        """The motion as a `jaxrod.viz.Replay`, with the target if there is one.

        Args:
            title: Heading of the player.
            up: The world axis drawn upwards.

        Raises:
            ValueError: the states are not those of a rod whose scene is in the data.
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
        """What was reached, why it ended and what it took, in a few lines."""
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

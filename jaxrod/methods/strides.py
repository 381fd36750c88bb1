"""Steppers whose last step is a cycle of the loop, so that a step is compiled once."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from jaxrod.structure import pytree


class Strides(ABC):
    """Base class of steppers whose last step differs from the others in its length.

    Position Verlet's last kick is followed by half a drift. A run counts its steps
    (`Counted`), so that its last step is one more cycle of the loop. As a program of
    its own it would double what is traced and compiled.
    """

    steps_of_end: ClassVar[int] = 1

    @abstractmethod
    def stride(self, carry: Any, last: bool | Bool[Array, ""]) -> Any:
        """Carry in the middle of the next step, or at the end of the last one."""

    @abstractmethod
    def finished(self, carry: Any) -> Any:
        """Final state, from the carry at the end of the last step."""

    def cycle(self, carry: Any) -> Any:
        """Loop carry in the middle of the next step: a kick, then a whole drift."""
        return self.stride(carry, False)

    def end(self, carry: Any) -> Any:
        """State at the end of the last step, from the carry in the middle of it."""
        return self.finished(self.stride(carry, True))

    def counted(self, n_steps: int | Int[Array, ""]) -> Counted:
        """Stepper of a run of `n_steps` steps, which are all cycles."""
        return Counted(self, jnp.asarray(n_steps, jnp.int32))


def drift_time(dt: Array, last: bool | Bool[Array, ""]) -> Array:
    """Time of the drift after a kick [s]: a whole step, or half of the last one."""
    return jnp.where(last, 0.5 * dt, dt)


@pytree
class Counted:
    """A run of a stepper with strides: every step, the last one too, is a cycle."""

    steps_of_end: ClassVar[int] = 0
    stepper: Any
    n_steps: Int[Array, ""]
    """Number of steps, at least 1."""

    def begin(self, state: Any) -> tuple[Any, Array]:
        """Carry of the stepper in the middle of the first step, and the steps left."""
        return self.stepper.begin(state), self.n_steps

    def cycle(self, carry: tuple[Any, Array]) -> tuple[Any, Array]:
        """Carry after the next stride, and the steps left."""
        inner, left = carry
        return self.stepper.stride(inner, left == 1), left - 1

    def end(self, carry: tuple[Any, Array]) -> Any:
        """Final state."""
        return self.stepper.finished(carry[0])

    def searched(self, carry: tuple[Any, Array]) -> Counted:
        """Run of the steps until the next search, for systems with neighbour lists."""
        return Counted(self.stepper.searched(carry[0]), self.n_steps)

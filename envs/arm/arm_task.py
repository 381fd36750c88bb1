"""Common parts of the benchmark's tasks: timing, observations, rewards, options."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxrod import ExponentialDamping, Rod, RodState
from jaxrod.structure import pytree
from jaxrod.validation import check_count

CONTROL_PERIOD = 1.4e-3
"""Time between actions in every task [s]."""

OBSERVED_NODES = 11
"""Number of observed points of the arm, including base and tip."""


class Arm(Protocol):
    """Interface between an arm and its task, for both variants."""

    @property
    def rod(self) -> Rod:
        """The arm's parameters."""

    @property
    def rest(self) -> RodState:
        """The arm at the start of an episode."""

    def relaxed(self) -> Any:
        """Memory of the muscles at the start of an episode."""

    def advance(
        self,
        state: RodState,
        muscles: Any,
        controls: Float[Array, "3 n_controls"],
        dt: Array,
        n_steps: int,
    ) -> tuple[RodState, Any, Bool[Array, ""]]:
        """Advances the arm by simulation steps under one action.

        Args:
            state: The arm.
            muscles: Memory of its muscles.
            controls: Commanded values [1] about d1, d2 and d3.
            dt: Time step [s].
            n_steps: Number of steps, at least 1.

        Returns:
            The arm, the memory of its muscles, and whether it crashed.
        """


@pytree
class Bonus:
    """Distances within which the two bonuses of the reward are paid, inclusive."""

    near: Float[Array, ""]
    """Distance within which the first bonus is paid [m]."""
    touching: Float[Array, ""]
    """Distance within which the second bonus is paid as well [m]."""


def distance_reward(distance_squared: Array, bonus: Bonus) -> Array:
    """Minus the squared distance, plus 0.5 nearby, plus 1.5 more when touching.

    Args:
        distance_squared: Squared distance of the tip from the target [m^2].
        bonus: Distances within which the bonuses are paid.
    """
    return (
        -distance_squared
        + 0.5 * (distance_squared <= bonus.near**2)
        + 1.5 * (distance_squared <= bonus.touching**2)
    )


def shown_distance(arm: RodState, target: Float[Array, "3"]) -> Array:
    """Distance of the tip from the target as a step reports it [m].

    Args:
        arm: Last sound arm; after a crash, the arm before it. Nothing is known about a
            crashed arm, and zero would be the best possible distance.
        target: Position of the target [m].
    """
    squared = jnp.sum((arm.tip - target) ** 2)
    return jnp.sqrt(jnp.maximum(squared, 1e-12))


def observed_points(arm: RodState) -> Float[Array, "33"]:
    """X coordinates of eleven equidistant nodes, then y, then z [m]."""
    n_elements = arm.positions.shape[-1] - 1
    return jnp.ravel(arm.positions[:, :: n_elements // (OBSERVED_NODES - 1)])


def speed_and_direction(velocity: Float[Array, "3"]) -> Float[Array, "4"]:
    """Speed [m/s] and direction of a velocity; zeros at rest."""
    squared = jnp.sum(velocity**2)
    moving = squared > 0
    speed = jnp.where(moving, jnp.sqrt(jnp.where(moving, squared, 1)), 0)
    direction = velocity / jnp.where(moving, speed, 1)
    return jnp.concatenate([speed[None], direction])


def viscous_damping(rod: Rod, viscosity: Array) -> ExponentialDamping:
    """The published drag as decay rates, per rest length, equal about all axes."""
    return ExponentialDamping(
        translational_rate=viscosity / jnp.mean(rod.linear_density),
        rotational_rate=viscosity / jnp.mean(rod.rotary_inertia[0]),
    )


def check_variant(variant: str, variants: Sequence[str]) -> None:
    """Raises a ValueError unless the variant is one of the known ones."""
    if variant not in variants:
        known = ", ".join(variants)
        raise ValueError(f"variant must be one of {known}; got {variant!r}")


def check_sizes(n_elements: int, substeps: int, episode_length: int) -> None:
    """Raises a ValueError unless elements, substeps and episode length are valid."""
    check_count("n_elements", n_elements, OBSERVED_NODES - 1)
    if n_elements % (OBSERVED_NODES - 1):
        raise ValueError(f"n_elements must be a multiple of 10, got {n_elements}")
    check_count("substeps", substeps, 1)
    check_count("episode_length", episode_length, 1)

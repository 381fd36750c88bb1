"""Check that effects can act on rigid bodies, made before the first step.

A body is one node and one element. Bodies support four hooks of an effect: `loads`,
`energy`, `damping_rates` and `stability_bound`. They have masses, but no lengths and no
radii. Effects that ask for these, or that return loads for the nodes of a rod, are
refused.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jaxrod.effects.base import Effect
from jaxrod.effects.memory import remembers
from jaxrod.effects.own_classes import check_own_class
from jaxrod.effects.time import at_clock, clock_at, depends_on_time
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import split_quaternion
from jaxrod.rods.motion import Motion
from jaxrod.systems.members.rigid_stepper import BodyState
from jaxrod.validation import check_kind

_OF_RODS = (
    "loads_after",
    "constrain",
    "constrain_rates",
    "dissipate",
    "after_step",
    "drag",
)
"""Hooks of effects that act on a rod but would do nothing to a body."""


def check_body_effects(name: str, bodies: Any) -> None:
    """Checks that all effects on bodies can act on them.

    Args:
        name: Name of the member, for messages.
        bodies: The `RigidBodies`.

    Raises:
        ValueError: If an effect does not act on bodies; the message names member and
            effect.
        TypeError: If an effect is not an instance of `Effect`.
    """
    for effect in bodies.effects:
        check_kind(f"member {name!r}: effect", effect, Effect)
        check_own_class(effect, Effect, "an effect")
        kind = type(effect)
        for hook in _OF_RODS:
            if getattr(kind, hook) is not getattr(Effect, hook):
                raise _unfit(name, effect, f"it has {hook}, which bodies have not")
        if remembers((effect,)):
            raise _unfit(
                name, effect, "it has memory, which effects on bodies cannot have"
            )
        if kind.damping_rates is not Effect.damping_rates and depends_on_time(effect):
            raise ValueError(
                f"member {name!r}: damping rates are computed once, but "
                f"{kind.__name__}, which has some, depends on time"
            )
        _try(name, effect, bodies)


def _try(name: str, effect: Effect, bodies: Any) -> None:
    """Raises a ValueError unless all four hooks of an effect work for bodies.

    The hooks are traced, not computed. They must raise no error and return one number,
    or one per body.
    """
    count, dtype = bodies.n_elements, bodies.masses.dtype

    def asked(bodies: Any) -> Any:
        own = at_clock(effect, clock_at(0.0, dtype))
        rows = jnp.zeros((3, count), dtype)
        turns = jnp.concatenate([rows[:1] + 1, rows])
        zero = vectors.split(rows)
        motion = Motion(zero, split_quaternion(turns), zero, zero)
        state: Any = BodyState(rows, turns, rows, rows)
        return (
            own.loads(bodies, motion),
            own.energy(bodies, state),
            own.damping_rates(bodies),
            own.stability_bound(bodies),
        )

    try:
        loads, energy, rates, bound = jax.eval_shape(asked, bodies)
    except Exception as error:
        # Any exception counts: an effect may use any attribute of a rod.
        raise _unfit(name, effect, f"{type(error).__name__}: {error}") from error
    for what, found in (("forces", loads.forces), ("couples", loads.couples)):
        shapes = {jnp.shape(component) for component in found or ()}
        if shapes - {(count,), ()}:
            raise _unfit(
                name,
                effect,
                f"its {what} are of shape {max(shapes)}, and there are {count} bodies",
            )
    if jnp.shape(energy) != ():
        raise _unfit(name, effect, f"its energy is of shape {jnp.shape(energy)}")
    for rate in rates or ():
        if jnp.shape(rate) not in ((), (count,)):
            raise _unfit(name, effect, f"its rates are of shape {jnp.shape(rate)}")
    for part in jax.tree.leaves(bound):
        if jnp.shape(part) not in ((), (count,)):
            raise _unfit(name, effect, f"its bounds are of shape {jnp.shape(part)}")


def _unfit(name: str, effect: Effect, why: str) -> ValueError:
    return ValueError(
        f"member {name!r}: {type(effect).__name__} does not act on rigid bodies "
        f"({why}); gravity and exponential_damping do"
    )

"""The hand that pulls on a model in the live page: a spring to a point in space."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxrod
from jaxrod.model import Model

FIRMNESS = 10.0
"""Stiffness of the hand relative to that of the member at its end [1]."""
_G = 9.81  # [m/s^2]


@jaxrod.extend.pytree
class Hand(jaxrod.extend.Effect):
    """A spring of zero rest length between one node and a point: F = k (p - x)."""

    reach = "neighbours"

    grip: Float[Array, " nodes"]
    """1 at the node that is held, else 0 [1]."""
    point: Float[Array, "3"]
    """Point to which the node is pulled, world frame [m]."""
    stiffness: Float[Array, ""]
    """Force per distance [N/m]."""

    def loads(self, rod: Any, motion: jaxrod.extend.Motion) -> jaxrod.extend.Loads:
        """Force on the node that is held."""
        k = self.stiffness * self.grip
        x, y, z = motion.position
        p = self.point
        return jaxrod.extend.Loads(
            forces=(k * (p[0] - x), k * (p[1] - y), k * (p[2] - z))
        )

    def turning_tangent(self, rod: Any, motion: jaxrod.extend.Motion) -> None:
        """Returns `None`: there are no couples."""

    def stability_bound(self, rod: Any) -> jaxrod.extend.StabilityBound:
        """Stiffness of the spring, on whichever node is held."""
        return jaxrod.extend.StabilityBound(nodes=self.stiffness)

    def energy(self, rod: Any, state: Any) -> Array:
        """Elastic energy, k |p - x|^2 / 2 [J]."""
        gap = self.point[:, None] - state.positions
        return 0.5 * self.stiffness * jnp.sum(self.grip * jnp.sum(gap * gap, axis=0))


def movable(model: Model) -> dict[str, jaxrod.extend.Member]:
    """Members on which one can pull, by name: rods, and rigid bodies that are drawn.

    The rods come first, as in a replay.
    """
    members = model.interfaces()
    rods = {name: own for name, own in members.items() if own.rod is not None}
    bodies = {
        name: own
        for name, own in members.items()
        if own.rod is None and own.parts().shape is not None
    }
    return rods | bodies


def stiffnesses(model: Model, size: float) -> dict[str, Array]:
    """Stiffness of the hand for each member [N/m].

    It is ten times that of a cantilever at its tip, 3 EI / L^3, plus ten times the
    weight over the length, which matters for ropes. For bodies it is ten times the
    weight over `size`.

    Args:
        model: The scene or system.
        size: Diagonal of the box around the model [m].
    """
    found = {}
    for name, member in movable(model).items():
        parts = member.parts()
        weight = _G * float(jnp.sum(parts.node_masses)) / parts.count
        if parts.rest_lengths is None or parts.bend_twist_stiffness is None:
            k = weight / size
        else:
            length = float(jnp.sum(parts.rest_lengths)) / parts.count
            bending = float(jnp.mean(parts.bend_twist_stiffness[:2]))
            k = 3 * bending / length**3 + weight / length
        found[name] = jnp.asarray(FIRMNESS * k, member.dtype)
    return found


def no_grip(model: Model) -> dict[str, Array]:
    """Zeros for each node of each movable member: nothing is held."""
    return {
        name: jnp.zeros(_shape(member), member.dtype)
        for name, member in movable(model).items()
    }


def grip_at(model: Model, name: str, index: int) -> dict[str, Array]:
    """`no_grip`, but 1 at the node `index` of all nodes of the member `name`."""
    held = no_grip(model)
    flat = np.zeros(held[name].size)
    flat[index] = 1.0
    shape, dtype = held[name].shape, held[name].dtype
    return held | {name: jnp.asarray(flat.reshape(shape), dtype)}


def with_hand(
    model: Model,
    grips: Mapping[str, Array],
    point: Array,
    stiffness: Mapping[str, Array],
) -> Model:
    """The model with a hand on each movable member; those with zero grips do nothing.

    Args:
        model: The scene or system.
        grips: Grips by member, as `grip_at` returns them [1].
        point: Point to which the held node is pulled, world frame (3,) [m].
        stiffness: Stiffness of the hand, by member [N/m].
    """
    changed = {}
    for name, member in movable(model).items():

        def held(entry: Any, grip: Array, name: str = name) -> Any:
            hand = Hand(grip, point.astype(grip.dtype), stiffness[name])
            return entry.with_effect(hand)

        changed[name] = member.each(held, grips[name])
    return model.with_members(changed)


def with_memory_of(model: Model, state: Any) -> Any:
    """Copy of a state whose memory has one entry for each effect of a model.

    Entries of the model's last effects are removed or added. Added ones are empty: a
    hand has no memory.
    """
    members, changed = model.interfaces(), {}
    for name, own in model.states_by_name(state).items():
        memory = getattr(own, "memory", None)
        if memory is not None:
            count = len(members[name].effects)
            memory = (*memory, *[{}] * (count - len(memory)))[:count]
            changed[name] = replace(own, memory=memory)
    return model.with_states(state, changed)


def _shape(member: jaxrod.extend.Member) -> tuple[int, ...]:
    """Shape of one number per node: `(nodes,)`, or `(rods, nodes)` for equal rods."""
    if member.rod is None:
        return (member.parts().n_nodes,)
    *rods, elements = member.rod.rest_lengths.shape
    return (*rods, elements + 1)

"""The largest stable step of a system: its members, with the bounds of couplings."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxrod.analysis.stability import StableStep, stable_dt
from jaxrod.effects.base import Effect, StabilityBound
from jaxrod.rods.rod import Rod
from jaxrod.scene import Scene
from jaxrod.structure import pytree, static
from jaxrod.systems.joints.elastic_joints import added_bounds
from jaxrod.systems.members.parts import in_rows
from jaxrod.systems.members.rigid_bodies import RigidBodies
from jaxrod.systems.stepping.assembly import Assembly


@pytree
class StableSystemStep:
    """A time step of a system and what limits it."""

    dt: Float[Array, ""]
    """The largest safe step [s]."""
    members: tuple[Float[Array, ""], ...]
    """The largest safe step of each member [s]; infinite where nothing limits it."""
    steps: tuple[StableStep | None, ...]
    """Stable steps of rods and their limits, with a leading axis for equal rods; `None`
    for rigid bodies."""
    names: tuple[str, ...] = static()
    """Names of the members."""

    @property
    def limiting_mode(self) -> str:
        """The limiting motion in words, for concrete values only."""
        which = min(range(len(self.names)), key=lambda k: float(self.members[k]))
        name, step = self.names[which], self.steps[which]
        if step is None:
            return f"the couplings of body {name!r}"
        if step.dt.ndim == 0:
            return f"{step.limiting_mode} of {name!r}"
        rod = int(jnp.argmin(step.dt))
        one = jax.tree.map(lambda leaf: leaf[rod], step)
        return f"{one.limiting_mode} of rod {rod} of {name!r}"


@pytree
class CouplingBounds(Effect):
    """Stiffness and drag that couplings add to a rod: a bound without loads."""

    bound: StabilityBound
    """The bound."""

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """The given bound."""
        return self.bound


@jax.jit
def stable_system_dt(system: Assembly, safety: ArrayLike = 0.8) -> StableSystemStep:
    """The largest step at which a system is stable, times a safety factor.

    Args:
        system: The system; its schedules count with the bounds on their size.
        safety: Fraction of the limit to use, in (0, 1].
    """
    system = system.at_largest
    parts = system.parts()
    bounds: dict[str, StabilityBound] = {}
    for coupling in system.couplings:
        prepared = coupling.prepared(parts)
        for name, bound in prepared.stability_bounds(parts).items():
            bounds[name] = added_bounds(bounds.get(name), bound)
    limits: list[Array] = []
    steps: list[StableStep | None] = []
    for name, member in system.members.items():
        bound = bounds.get(name, StabilityBound())
        if isinstance(member, RigidBodies):
            limits.append(jnp.asarray(safety) * _of_bodies(member, bound))
            steps.append(None)
            continue
        step = _of_rods(member, bound, safety)
        limits.append(jnp.min(step.dt))
        steps.append(step)
    return StableSystemStep(
        jnp.min(jnp.stack(limits)), tuple(limits), tuple(steps), tuple(system.members)
    )


def _of_rods(member: Scene, bound: StabilityBound, safety: ArrayLike) -> StableStep:
    def one(scene: Scene, own: StabilityBound) -> StableStep:
        effects = (*scene.effects, CouplingBounds(own))
        return stable_dt(replace(scene, effects=effects), safety)

    if member.rod.rest_lengths.ndim == 1:
        return one(member, bound)
    count = member.rod.rest_lengths.shape[0]
    step: Any = jax.vmap(one)(member, in_rows(bound, count))
    return step


def _of_bodies(bodies: RigidBodies, bound: StabilityBound) -> Array:
    """Largest step at which explicit springs and dashpots on bodies are stable [s]."""
    least = jnp.min(bodies.principal_inertias, axis=0)
    moving = _limit(bodies.masses, bound.nodes, bound.node_drag)
    turning = _limit(least, bound.elements, bound.element_drag)
    return jnp.min(jnp.minimum(moving, turning))


def _limit(inertia: Array, stiffness: Array | None, drag: Array | None) -> Array:
    """Positive root h of `k h^2 + 2 c h = 4 m`."""
    zero = jnp.zeros_like(inertia)
    k = zero if stiffness is None else stiffness
    c = zero if drag is None else drag
    below = c + jnp.sqrt(c * c + 4 * k * inertia)
    free = below <= 0
    return jnp.where(free, jnp.inf, 4 * inertia / jnp.where(free, 1, below))

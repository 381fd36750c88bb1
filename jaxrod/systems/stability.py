"""The largest stable step of a system, from its members and the bounds of couplings."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxrod.analysis.stability import StableStep
from jaxrod.effects.base import StabilityBound, added_bounds
from jaxrod.structure import pytree, static
from jaxrod.systems.stepping.assembly import Assembly


@pytree
class StableSystemStep:
    """Largest stable step of a system, and what limits it."""

    dt: Float[Array, ""]
    """Largest stable step times the safety factor: the least of `members` [s]."""
    members: tuple[Float[Array, ""], ...]
    """Largest stable step of each member times the safety factor [s], in the order of
    `names`; infinite where nothing limits it."""
    steps: tuple[StableStep | None, ...]
    """`StableStep` of each member made of rods, with a leading axis for equal rods;
    `None` for rigid bodies. The order is that of `names`."""
    names: tuple[str, ...] = static()
    """Names of the members."""

    @property
    def limiting_mode(self) -> str:
        """Description of the motion that limits the step; needs concrete values."""
        which = min(range(len(self.names)), key=lambda k: float(self.members[k]))
        name, step = self.names[which], self.steps[which]
        if step is None:
            return f"what acts on {name!r}"
        if step.dt.ndim == 0:
            return f"{step.limiting_mode} of {name!r}"
        rod = int(jnp.argmin(step.dt))
        one = jax.tree.map(lambda leaf: leaf[rod], step)
        return f"{one.limiting_mode} of rod {rod} of {name!r}"


@jax.jit
def stable_system_dt(system: Assembly, safety: ArrayLike = 0.8) -> StableSystemStep:
    """The largest step at which a system is stable, times a safety factor.

    Args:
        system: The system; schedules are replaced by the bounds on their size.
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
    for name, member in system.interfaces().items():
        bound = bounds.get(name, StabilityBound())
        limit, step = member.stable_step(bound, safety)
        limits.append(limit)
        steps.append(step)
    return StableSystemStep(
        jnp.min(jnp.stack(limits)), tuple(limits), tuple(steps), tuple(system.members)
    )

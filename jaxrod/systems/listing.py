"""Steps of a system that looks for neighbours every so often.

Lists are carried from step to step beside the motions, and so is how many steps ago
they were made. That count depends on no number of the system: under `jax.vmap` it is
the same for all, and the search stays a branch that is taken once in a while.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxrod.structure import pytree, static
from jaxrod.systems.assembly import Assembly
from jaxrod.systems.coupling import Coupling
from jaxrod.systems.evolving import EvolvingSystem
from jaxrod.systems.neighbour_lists import RECORD, NeighbourRecord
from jaxrod.systems.stepper import Motions, SystemStepper


def refresh_every(couplings: Sequence[Coupling]) -> int | None:
    """Steps between searches: those of the coupling that asks for the fewest."""
    asked = [c.refresh_every for c in couplings if c.refresh_every is not None]
    return min(asked) if asked else None


def lists_neighbours(system: Assembly) -> bool:
    """Whether a system has couplings that look for neighbours."""
    return refresh_every(system.couplings) is not None


def with_found(
    couplings: Sequence[Coupling], found: Sequence[Any]
) -> tuple[Coupling, ...]:
    """Couplings with what they have found, in their field `found`."""
    left = iter(found)
    # A coupling that searches is a dataclass by its decorator, with such a field.
    return tuple(
        c if c.refresh_every is None else replace(c, found=next(left))  # type: ignore[type-var]
        for c in couplings
    )


def searched(couplings: Sequence[Coupling], seen: Any) -> tuple[Any, ...]:
    """What the couplings that look for neighbours find."""
    return tuple(c.search(seen) for c in couplings if c.refresh_every is not None)


@pytree
class Listing:
    """Motions of a system, and the lists of what is near."""

    motions: Any
    """What the system's own stepper carries."""
    found: tuple[Any, ...]
    """Lists of each coupling that has some."""
    age: Int[Array, ""]
    """Steps since they were made."""
    record: NeighbourRecord
    """What they may have missed."""


@pytree
class ListingSystem:
    """Position Verlet of a system with lists of neighbours."""

    steps_of_end: ClassVar[int] = 1
    one_by_one: ClassVar[bool] = True
    """A batch goes one after the other: branches by what lists hold stay branches."""
    stepper: SystemStepper | EvolvingSystem
    """The system's stepper, with couplings without lists."""
    every: int = static()
    """Steps between searches."""

    def begin(self, state: Mapping[str, Any]) -> Listing:
        """To the middle of the first step, where neighbours are looked for."""
        motions = self.stepper.begin(state)
        found = searched(self.stepper.couplings, self._seen(motions))
        return Listing(motions, found, jnp.zeros((), jnp.int32), state[RECORD])

    def cycle(self, carry: Listing) -> Listing:
        """From the middle of a step to the middle of the next."""
        carry = self._looked(carry)
        moved = self._listed(carry).cycle(carry.motions)
        return replace(carry, motions=moved, age=carry.age + 1)

    def end(self, carry: Listing) -> dict[str, Any]:
        """From the middle of the last step to its end."""
        carry = self._looked(carry)
        state = self._listed(carry).end(carry.motions)
        return {**state, RECORD: carry.record}

    def _looked(self, carry: Listing) -> Listing:
        """With lists that are young enough, and what they may have missed."""

        def anew(_: Any) -> tuple[Any, ...]:
            return searched(self.stepper.couplings, self._seen(carry.motions))

        old = carry.age >= self.every
        found = jax.lax.cond(old, anew, lambda have: have, carry.found)
        carry = replace(carry, found=found, age=jnp.where(old, 0, carry.age))
        return replace(carry, record=self._recorded(carry))

    def _recorded(self, carry: Listing) -> NeighbourRecord:
        record, seen = carry.record, self._seen(carry.motions)
        missed, moved, used = record.missed, record.moved, record.used
        for coupling in self._listed(carry).couplings:
            if coupling.refresh_every is None:
                continue
            found: Any = coupling
            missed = jnp.maximum(missed, found.found.missed)
            used = jnp.maximum(used, jnp.max(found.found.used))
            moved = jnp.maximum(moved, coupling.moved(seen))
        return NeighbourRecord(missed, moved, used)

    def _listed(self, carry: Listing) -> SystemStepper | EvolvingSystem:
        """The system's stepper with lists."""
        couplings = with_found(self.stepper.couplings, carry.found)
        return replace(self.stepper, couplings=couplings)

    def _seen(self, motions: Any) -> Any:
        """Members as couplings see them."""
        if isinstance(self.stepper, EvolvingSystem):
            own: Motions = motions[0]
            return self.stepper.stepper.seen(own)
        return self.stepper.seen(motions)

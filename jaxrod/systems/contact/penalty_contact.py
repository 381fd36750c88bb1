"""Base of couplings with the penalty law of contact, and checks of its numbers."""

from __future__ import annotations

from typing import Any

from jaxtyping import Array, Float

from jaxrod.contacts.contact_law import PenaltyLaw
from jaxrod.structure import pytree
from jaxrod.systems.sites.coupling import Coupling
from jaxrod.validation import Numbers, as_array


@pytree
class PenaltyContact(Coupling):
    """Contact by springs, dashpots and friction, per length of contact or for each."""

    stiffness: Float[Array, ""]
    """Force per penetration: [N/m^2] per length of contact, or [N/m]."""
    onset: Float[Array, ""]
    """Width of the smooth onset, over a radius or the size of the smaller body [1]."""
    damping: Float[Array, ""] | None = None
    """Force per speed along the normal: [kg/(m s)] per length, or [kg/s]."""
    friction: Float[Array, ""] | None = None
    """Coefficient of Coulomb friction [1]."""
    friction_drag: Float[Array, ""] | None = None
    """Largest friction per slip speed: [kg/(m s)] per length, or [kg/s]."""

    @property
    def law(self) -> PenaltyLaw:
        """Numbers of the law."""
        return PenaltyLaw(
            self.stiffness, self.damping, self.friction, self.friction_drag
        )


def law_numbers(
    stiffness: Numbers,
    damping: Numbers | None,
    friction: Numbers | None,
    friction_drag: Numbers | None,
    onset: Numbers,
    *,
    per_length: bool,
) -> dict[str, Any]:
    """Checked fields of the law.

    Args:
        stiffness: Force per penetration.
        damping: Force per normal speed.
        friction: Coefficient of Coulomb friction.
        friction_drag: Largest friction per slip speed; by default the damping.
        onset: Width of the onset.
        per_length: Whether the law is per length of contact.

    Raises:
        ValueError: If a number is out of range, or friction has no drag.
    """
    rigidity, rate = ("N/m^2", "kg/(m s)") if per_length else ("N/m", "kg/s")
    drag = damping if friction_drag is None else friction_drag
    if friction is not None and drag is None:
        raise ValueError(
            f"friction needs friction_drag > 0 {rate}, its resistance per "
            f"{'length and ' if per_length else ''}speed at the onset of slip (by "
            "default the damping), got none"
        )

    def number(name: str, value: Numbers | None, unit: str) -> Array | None:
        return None if value is None else as_array(name, value, unit, positive=True)

    return {
        "stiffness": as_array("stiffness", stiffness, rigidity, positive=True),
        "onset": as_array("onset", onset, "", positive=True),
        "damping": number("damping", damping, rate),
        "friction": number("friction", friction, ""),
        "friction_drag": number(
            "friction_drag", None if friction is None else drag, rate
        ),
    }


def check_members(members: tuple[str, ...]) -> None:
    """Raises TypeError or ValueError unless all members are named once, by strings."""
    for name in members:
        if not isinstance(name, str):
            raise TypeError(f"members are named by strings, got {name!r}")
    if not members or len(set(members)) < len(members):
        raise ValueError(f"members must be named once each, got {list(members)}")

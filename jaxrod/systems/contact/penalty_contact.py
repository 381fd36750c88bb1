"""Base class of couplings with penalty contact, and checks of their parameters."""

from __future__ import annotations

from typing import Any

from jaxtyping import Array, Float

from jaxrod.contacts.contact_law import PenaltyLaw
from jaxrod.structure import pytree
from jaxrod.systems.sites.coupling import Coupling
from jaxrod.validation import Numbers, as_array


@pytree
class PenaltyContact(Coupling):
    """Base of penalty-contact couplings: springs, dashpots and Coulomb friction."""

    stiffness: Float[Array, ""]
    """Normal force per penetration: [N/m^2] if per length of contact, else [N/m]."""
    onset: Float[Array, ""]
    """Width of the smooth onset of contact, over a radius or body size [1]."""
    damping: Float[Array, ""] | None = None
    """Dashpot force per normal speed: [kg/(m s)] if per length, else [kg/s]."""
    friction: Float[Array, ""] | None = None
    """Coefficient of Coulomb friction [1]."""
    friction_drag: Float[Array, ""] | None = None
    """Largest friction force per slip speed: [kg/(m s)] if per length, else [kg/s]."""

    @property
    def law(self) -> PenaltyLaw:
        """Stiffness, damping and friction as a `PenaltyLaw`, which computes forces."""
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
    """Checks the parameters of the law; returns them as fields of `PenaltyContact`.

    Args:
        stiffness: Normal force per penetration [N/m^2] or [N/m].
        damping: Dashpot force per normal speed [kg/(m s)] or [kg/s].
        friction: Coefficient of Coulomb friction [1].
        friction_drag: Largest friction per slip speed [kg/(m s)] or [kg/s]; by default
            the damping.
        onset: Width of the smooth onset over a radius or a body size [1].
        per_length: Whether the law is per length of contact: the first of both units.

    Raises:
        ValueError: If a number is out of range, or friction is given without drag.
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
    """Raises unless members are one or more strings, no two of them equal."""
    for name in members:
        if not isinstance(name, str):
            raise TypeError(f"members are named by strings, got {name!r}")
    if not members or len(set(members)) < len(members):
        raise ValueError(f"members must be named once each, got {list(members)}")

r"""Default numbers of contact: stiffness, damping and friction drag from the step.

Contact whose stiffness is left out gets numbers that a scene can afford. With the
largest stable step $h$ without this contact, and the bounds of `stable_dt` on the
squared frequency $\omega_c^2$ and the rate $d$ that the contact adds,

$$\omega_c^2 = \frac12 \Big(\frac2h\Big)^2, \qquad d = 2.5/h.$$

The step that `stable_dt` allows with the contact is then half of $h$: with $x$ for the
ratio of both steps, $4 x^2 (1 + 1/2) = 4 (1 - 1.25\,x)$. Where damping or friction is
slower than stiffness, it is a little more than half.

A rod that hits something at the speed $v$ sinks in by about $v \sqrt{m/k}$, with the
mass $m$ and the stiffness $k$ per length. If $h$ is so long that a rod would sink in by
more than a hundredth of its radius under its own weight, then the stiffness that
carries this weight is taken, and the step is shorter.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, TypeVar

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from jaxrod.effects.base import StabilityBound

C = TypeVar("C")

SHARE = 0.5
"""Squared frequency of default contact, divided by that of the fastest motion without
contact [1]."""
DECAY = 2.5 / (2 * SHARE**0.5)
"""Rate of default damping and of default friction, divided by the frequency of contact
[1]."""
OVERLAP = 0.01
"""Largest overlap by which default contact carries a rod's own weight, divided by the
radius of the rod [1]."""
GRAVITY = 9.81
"""Acceleration that makes the weight, with or without gravity in the scene [m/s^2]."""

LEFT_OUT = "stiffness", "damping", "friction_drag"
"""Numbers that can be left out."""


def left_out(
    stiffness: Any, damping: Any, friction: Any, friction_drag: Any
) -> tuple[str, ...]:
    """Names of the numbers to choose; none if a stiffness is given.

    Friction has the drag of the damping, if that is given.
    """
    if stiffness is not None:
        return ()
    drag = damping if friction_drag is None else friction_drag
    missing = {
        "stiffness": True,
        "damping": damping is None,
        "friction_drag": friction is not None and drag is None,
    }
    return tuple(name for name in LEFT_OUT if missing[name])


def with_default_law(
    contact: C,
    step: Array,
    least: Array,
    fastest: Callable[[C], tuple[Array, Array]],
) -> C:
    """The contact with numbers in place of those that are left out.

    Args:
        contact: Contact with the fields of `LEFT_OUT`, `friction` and `left_out`.
        step: Largest stable step without this contact [s].
        least: Smallest stiffness, which carries the weight.
        fastest: Function from contact to its bounds of squared frequency [rad^2/s^2]
            and of rate [1/s].
    """
    law: Any = contact
    if not law.left_out:
        return contact
    one = jnp.ones_like(law.stiffness)
    bare = replace(law, stiffness=one, damping=None, friction=None, friction_drag=None)
    square = fastest(bare)[0]
    affordable = affordable_stiffness(step, square).astype(one.dtype)
    stiffness = jnp.maximum(affordable, least.astype(one.dtype))
    rate = DECAY * jnp.sqrt(stiffness * square)
    chosen = {"stiffness": stiffness}
    for name, probe in (
        ("damping", replace(bare, damping=one)),
        ("friction_drag", replace(bare, friction=law.friction, friction_drag=one)),
    ):
        if name in law.left_out:
            chosen[name] = (rate / fastest(probe)[1]).astype(one.dtype)
    found: C = replace(law, left_out=(), **chosen)
    return found


def affordable_stiffness(step: Array, square: Array) -> Array:
    r"""Stiffness of springs that add half of the largest squared frequency.

    Without damping the stable step is then at least $\sqrt{2/3} = 0.82$ times as long.

    Args:
        step: Largest stable step without these springs [s].
        square: Squared frequency that they add, for a stiffness of one [rad^2/s^2].
    """
    return SHARE * (2 / step) ** 2 / square


def largest_rates(
    bounds: Mapping[str, StabilityBound], parts: Mapping[str, Any]
) -> tuple[Array, Array]:
    """Largest squared frequency and rate of all members [rad^2/s^2], [1/s].

    Args:
        bounds: Stiffness and drag that a coupling adds, by member.
        parts: Constants of the members.
    """
    found = [
        added_rates(bound, parts[k].node_masses, jnp.min(parts[k].inertias, axis=0))
        for k, bound in bounds.items()
    ]
    squares, rates = (jnp.stack(each) for each in zip(*found, strict=True))
    return jnp.max(squares), jnp.max(rates)


def softened_law(contact: C, share: ArrayLike) -> C:
    """The contact with a share of its stiffness, and with rates that fit.

    Damping and friction drag get the square root of the share: the fraction of the
    energy that a collision takes is then the same.
    """
    law: Any = contact
    numbers: tuple[tuple[str, ArrayLike], ...] = (
        ("stiffness", share),
        ("damping", jnp.sqrt(share)),
        ("friction_drag", jnp.sqrt(share)),
    )
    given = {name: getattr(law, name) for name, _ in numbers}
    changed = {
        name: (given[name] * factor).astype(given[name].dtype)
        for name, factor in numbers
        if given[name] is not None
    }
    softer: C = replace(law, **changed)
    return softer


def added_rates(
    bound: StabilityBound, masses: Array, inertias: Array
) -> tuple[Array, Array]:
    """Largest squared frequency and rate that a bound allows [rad^2/s^2], [1/s].

    Args:
        bound: Stiffness and drag that contact adds.
        masses: Masses of the nodes [kg].
        inertias: Smallest moments of inertia of the elements [kg m^2].
    """

    def most(part: Array | None, inertia: Array) -> Array:
        return jnp.zeros(()) if part is None else jnp.max(part / inertia)

    # Friction at the surface moves and turns the rod: both rates count in full.
    slip = most(bound.slip_drag, masses) + most(bound.slip_couple, inertias)
    return (
        jnp.maximum(most(bound.nodes, masses), most(bound.elements, inertias)),
        jnp.maximum(
            jnp.maximum(most(bound.node_drag, masses), slip),
            most(bound.element_drag, inertias),
        ),
    )

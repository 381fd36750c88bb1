"""Nests: rods poured into a pot, held together by contact and friction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.assemblies.groups import MOST_RODS, equal_rods, scenes
from jaxrod.contacts.bodies import plane, signed_distance
from jaxrod.contacts.contact import contact
from jaxrod.effects.base import Effect
from jaxrod.systems.contact.rod_contact import rod_contact
from jaxrod.systems.system import System, make_system
from jaxrod.validation import Numbers, as_array, check_count, check_seed


def inside_of_pot(point: Array, radius: Array) -> Array:
    """Distance from the wall of an upright round pot, positive inside [m].

    Args:
        point: Position `(3,)` [m].
        radius: Radius of the pot [m].
    """
    x, y = point[0], point[1]
    # Smoothed at the axis, where the direction to the wall is not defined.
    return radius - jnp.sqrt(x * x + y * y + (1e-6 * radius) ** 2)


def nest(
    n_rods: int,
    n_elements: int,
    *,
    length: float,
    radius: float,
    pot_radius: float,
    stiffness: Numbers,
    damping: Numbers,
    friction: Numbers | None = None,
    seed: int = 0,
    points_per_element: int | None = None,
    max_contacts: int = 6,
    effects: Sequence[Effect] = (),
    **rod: Any,
) -> tuple[System, dict[str, Any]]:
    """Straight rods above one another in an upright pot, at random angles.

    The rods are horizontal and do not touch. With `jaxrod.gravity()` among the effects
    they fall on one another. The system has one member, "rods".

    Args:
        n_rods: Number of rods.
        n_elements: Elements of each rod.
        length: Length of the rods, less than the width of the pot [m].
        radius: Radius of the rods [m].
        pot_radius: Radius of the pot [m]. Its floor is the plane z = 0 and its axis is
            the z axis.
        stiffness: Force of all contacts per length and penetration [N/m^2].
        damping: Damping of all contacts [kg/(m s)].
        friction: Coefficient of Coulomb friction [1].
        seed: Seed of the random angles and positions.
        points_per_element: Contact points per element, as in
            `jaxrod.systems.rod_contact`.
        max_contacts: Number of rods that may touch a rod at one place and time, for
            `stable_dt`.
        effects: Effects on every rod, in addition to contact with the pot.
        **rod: Material, passed to `jaxrod.straight_rod`.

    Returns:
        The system and its state.

    Raises:
        ValueError: If an argument is out of range.

    Example:
        >>> law = dict(stiffness=1e4, damping=1.0)
        >>> material = dict(radius=0.002, density=1000.0, youngs_modulus=1e6)
        >>> system, states = assemblies.nest(
        ...     3, n_elements=4, length=0.1, pot_radius=0.06, **law, **material
        ... )
        >>> states["rods"].positions.shape
        (3, 3, 5)
    """
    check_count("n_rods", n_rods, 2, MOST_RODS)
    extent = float(as_array("length", length, "m", positive=True))
    thick = float(as_array("radius", radius, "m", positive=True))
    wide = float(as_array("pot_radius", pot_radius, "m", positive=True))
    room = (wide - 1.1 * thick) ** 2 - (0.5 * extent) ** 2
    if room <= 0:
        raise ValueError(
            "length must be below the width of the pot, "
            f"{2 * wide - 2.2 * thick:.3g} m, got {extent:g} m"
        )
    random = np.random.default_rng(check_seed(seed))
    angles = random.uniform(0, np.pi, n_rods)
    ways = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    # Offset of the middle from the axis, across the rod, such that both ends fit
    # inside.
    off = random.uniform(-1, 1, n_rods) * (room**0.5)
    off = np.clip(off, -0.5 * wide, 0.5 * wide)
    half = np.sqrt((wide - 1.1 * thick) ** 2 - off**2) - 0.5 * extent
    along = random.uniform(-1, 1, n_rods) * np.maximum(half, 0)
    middles = off[:, None] * np.cross([0, 0, 1.0], ways) + along[:, None] * ways
    middles[:, 2] = thick * (1.2 + 2.2 * np.arange(n_rods))
    starts = middles - 0.5 * extent * ways

    rods, states = equal_rods(
        n_elements,
        {"start": starts, "direction": ways},
        length=extent,
        radius=thick,
        normal=(0.0, 0.0, 1.0),
        **rod,
    )
    law: dict[str, Any] = {"stiffness": stiffness, "damping": damping}
    if friction is not None:
        law["friction"] = friction
    pot = [
        contact(body, points_per_element=2, **law)
        for body in (plane(), signed_distance(inside_of_pot, wide))
    ]
    members = {"rods": scenes(rods, states, [*effects, *pot])}
    touch = rod_contact(
        "rods", points_per_element=points_per_element, max_contacts=max_contacts, **law
    )
    state = {"rods": states}
    return make_system(members, touch, state=state), state

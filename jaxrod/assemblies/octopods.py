"""An octopus: soft tapered arms around a rigid head."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxrod.assemblies.groups import equal_rods, scenes
from jaxrod.contacts.bodies import sphere
from jaxrod.effects.base import Effect
from jaxrod.systems.joints.welds import attach
from jaxrod.systems.members.rigid_bodies import rigid_body
from jaxrod.systems.system import System, make_system
from jaxrod.validation import Numbers, as_array, check_count


def octopus(
    arms: int = 8,
    n_elements: int = 12,
    *,
    length: float = 0.2,
    radius: Numbers = (0.012, 0.003),
    head_radius: float = 0.03,
    density: float = 1050.0,
    youngs_modulus: float = 2e4,
    effects: Sequence[Effect] = (),
    head_effects: Sequence[Effect] = (),
    **rod: Any,
) -> tuple[System, dict[str, Any]]:
    """Arms that leave a round head sideways, at equal angles in the plane z = 0.

    The members are "arms", equal rods whose director d1 points upwards, and "head". The
    first nodes of the arms are attached to the head.

    Args:
        arms: Number of arms.
        n_elements: Elements of each arm.
        length: Length of the arms [m].
        radius: Radii of the arms at base and tip, or one number for both [m].
        head_radius: Radius of the head [m].
        density: Density of the arms and the head [kg/m^3].
        youngs_modulus: Young's modulus of the arms [Pa].
        effects: Effects on every arm.
        head_effects: Effects on the head, such as `gravity()` or `exponential_damping`.
        **rod: Further arguments for the arms, passed to `jaxrod.straight_rod`.

    Returns:
        The system and its state at rest.

    Raises:
        ValueError: If an argument is out of range.

    Example:
        >>> system, states = assemblies.octopus(arms=4, n_elements=4)
        >>> sorted(states), states["arms"].positions.shape
        (['arms', 'head'], (4, 3, 5))
    """
    check_count("arms", arms, 1, 1000)
    size = float(as_array("head_radius", head_radius, "m", positive=True))
    angles = 2 * np.pi * np.arange(arms) / arms
    outwards = jnp.asarray(
        np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    )

    rods, states = equal_rods(
        n_elements,
        {"start": size * outwards, "direction": outwards},
        length=length,
        radius=radius,
        density=density,
        youngs_modulus=youngs_modulus,
        normal=(0.0, 0.0, 1.0),
        **rod,
    )
    head, of_head = rigid_body(
        sphere((0.0, 0.0, 0.0), size),
        density=density,
        effects=tuple(head_effects),
        dtype=states.positions.dtype,
    )
    state = {"arms": states, "head": of_head}
    roots = [("arms", k, "base") for k in range(arms)]
    together = attach(roots, ("head",), state)
    members: dict[str, Any] = {"arms": scenes(rods, states, effects), "head": head}
    return make_system(members, together, state=state), state

"""Branched assemblies: trees of welded rods, and octopuses of arms around a head."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxrod.assemblies.groups import MOST_RODS, equal_rods, scenes
from jaxrod.contacts.bodies import sphere
from jaxrod.effects.base import Effect
from jaxrod.effects.clamps import clamp
from jaxrod.rods.factories import straight_rod
from jaxrod.scene import make_scene
from jaxrod.systems.joints.welds import attach, weld
from jaxrod.systems.members.rigid_bodies import rigid_body
from jaxrod.systems.system import System, make_system
from jaxrod.validation import Numbers, as_array, check_count


def tree(
    levels: int,
    branches: int = 2,
    n_elements: int = 6,
    *,
    length: float,
    radius: float,
    angle: float = 0.5,
    length_ratio: float = 0.7,
    radius_ratio: float | None = None,
    effects: Sequence[Effect] = (),
    **rod: Any,
) -> tuple[System, dict[str, Any]]:
    """A trunk clamped at the ground, with levels of branches.

    The members are "trunk", "level 1", "level 2" and so on. A level consists of equal
    rods; rod `k` grows from rod `k // branches` of the level below. All joints are
    welds.

    Args:
        levels: Levels of branches.
        branches: Number of branches at the end of the trunk and of every branch below
            the last level.
        n_elements: Elements of each rod.
        length: Length of the trunk [m].
        radius: Radius of the trunk [m].
        angle: Angle between a branch and its parent [rad].
        length_ratio: Length of a branch divided by the length of its parent [1].
        radius_ratio: Radius of a branch divided by the radius of its parent [1]. By
            default the cross-sections of all branches at a fork add up to that of their
            parent (Leonardo's rule).
        effects: Effects on every rod.
        **rod: Material, passed to `jaxrod.straight_rod`.

    Returns:
        The system and its state at rest.

    Raises:
        ValueError: If an argument is out of range.

    Example:
        >>> material = dict(density=700.0, youngs_modulus=1e8)
        >>> system, states = assemblies.tree(
        ...     2, branches=2, n_elements=3, length=1.0, radius=0.05, **material
        ... )
        >>> {name: own.positions.shape for name, own in states.items()}
        {'trunk': (3, 4), 'level 1': (2, 3, 4), 'level 2': (4, 3, 4)}
    """
    check_count("levels", levels, 1, 20)
    check_count("branches", branches, 1, 100)
    if branches**levels > MOST_RODS:
        raise ValueError(
            f"branches ** levels must be at most {MOST_RODS}, got {branches**levels}"
        )
    lean = float(as_array("angle", angle, "rad", non_negative=True))
    shorter = float(as_array("length_ratio", length_ratio, "", positive=True))
    thinner = branches**-0.5
    if radius_ratio is not None:
        thinner = float(as_array("radius_ratio", radius_ratio, "", positive=True))
    trunk, of_trunk = straight_rod(
        n_elements, length=length, radius=radius, normal=(1.0, 0.0, 0.0), **rod
    )
    members: dict[str, Any] = {"trunk": make_scene(trunk, clamp(of_trunk), *effects)}
    state: dict[str, Any] = {"trunk": of_trunk}
    tips, frames = np.array([[0.0, 0.0, length]]), np.eye(3)[None]
    joints, before, extent, thick = [], "trunk", float(length), float(radius)
    for level in range(1, levels + 1):
        extent, thick = extent * shorter, thick * thinner
        starts, axes, normals, parents = [], [], [], []
        for parent, (tip, frame) in enumerate(zip(tips, frames, strict=True)):
            for k in range(branches):
                turn = 2 * np.pi * k / branches
                side = np.cos(turn) * frame[0] + np.sin(turn) * frame[1]
                axes.append(np.cos(lean) * frame[2] + np.sin(lean) * side)
                # The plane of the next fork is perpendicular to the plane of this one.
                normals.append(np.cross(frame[2], side))
                starts.append(tip)
                parents.append(parent)
        name = f"level {level}"

        own = {"start": starts, "direction": axes, "normal": normals}
        rods, states = equal_rods(
            n_elements,
            {key: np.array(rows) for key, rows in own.items()},
            length=extent,
            radius=thick,
            **rod,
        )
        members[name], state[name] = scenes(rods, states, effects), states
        ends = [
            (before, "tip") if before == "trunk" else (before, parent, "tip")
            for parent in parents
        ]
        roots = [(name, k, "base") for k in range(len(starts))]
        joints.append(weld(ends, roots, state))
        tips = np.array(starts) + extent * np.array(axes)
        frames = np.stack([normals, np.cross(axes, normals), axes], axis=1)
        before = name
    return make_system(members, *joints, state=state), state


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
    """Arms that extend from a round head, at equal angles in the plane z = 0.

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

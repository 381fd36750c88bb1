"""Factory of contact with fixed bodies: runs on the host, validates, takes SI units."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.contacts.bodies import Body
from jaxrod.contacts.contact import Contact
from jaxrod.validation import Numbers, as_array, check_array, check_count, is_traced

MOST_POINTS = 1000
"""Largest number of contact points per element. Each of them is in the compiled
program; more are taken for a mistake."""


def contact(
    bodies: Body | Sequence[Body],
    *,
    stiffness: Numbers,
    damping: Numbers = 0.0,
    friction: Numbers = 0.0,
    friction_drag: Numbers | None = None,
    stick_ratio: Numbers = 1.0,
    onset: Numbers = 0.01,
    points_per_element: int = 1,
) -> Contact:
    """Contact of the rod with a fixed body, or with several of one kind.

    All loads are per length of rod: a rod of weight `W` and length `L` rests on a
    plane at a penetration of `W / (stiffness L)`, however many elements it has. The
    face of an end that meets a surface at an angle counts as much length as the rod is
    thick, times the square of the angle's sine: a rod that stands on an end sinks in by
    about `W / (2 stiffness radius)` (`jaxrod.contacts.ends`).
    `stable_dt` counts stiffness, damping and friction drag as if all of the rod
    touched: a stiffness well below `linear_density * frequency^2` of the rod's fastest
    motion costs next to nothing. The stiffness that prevents tunnelling grows with the
    square of the impact speed.

    Args:
        bodies: A body from `jaxrod.shapes.sphere`, `capsule`, `cylinder`, `plane`,
            `box` or `signed_distance`. Several of the same kind are given as a
            sequence, or as one body whose numbers have a leading axis (from `jax.vmap`
            of a factory). Each adds to the compiled program; a dozen bodies cost more
            than the rod itself, and then `jaxrod.near_contact` helps.
        stiffness: Force per length of rod and penetration [N/m^2].
        damping: Force per length of rod and normal speed [kg/(m s)].
        friction: Coefficient of Coulomb friction, or three coefficients, such as those
            of scales and bristles: for slip forward (along d3, from the first node to
            the last), backward and sideways [1].
        friction_drag: Largest friction per length of rod and slip speed [kg/(m s)]; by
            default equal to `damping`. A sticking contact creeps at (tangential load
            per length) / friction_drag, divided by the root of 1 - (load / limit)^2
            with limit = friction * normal force: the closer to slipping, the faster.
        stick_ratio: Factor by which friction grows as slip vanishes, at least 1;
            `friction` is that of sliding. Because friction sets in smoothly, a rod
            holds on a little less than by this factor: up to 1.18, 1.49 or 2 times
            sliding friction with a ratio of 1.5, 2 or 2.8. With a ratio above 1,
            friction falls with speed once a rod slips faster than it creeps; this makes
            rods stick and slip [1].
        onset: Width of the smooth onset of contact over the rod's radius [1]. The
            force starts half a width before rod and body touch and is linear beyond
            half a width of penetration.
        points_per_element: Contact points per element: 1 for the nodes alone, 2 for
            nodes and middles, and so on. Neighbouring points should be nearer to each
            other than the sum of the radii of rod and body; from one and a half times
            this sum on, bodies slip through between the points. `make_scene` warns
            where the points are too far apart.

    Returns:
        An effect to list in a scene.

    Raises:
        ValueError: If a number is out of range, or if friction has no drag.
        TypeError: If the bodies are not bodies, or not all of one kind.
    """
    body, n_bodies = _gathered(bodies)
    damps = _or_none("damping", damping, "kg/(m s)")
    rubs = _or_none("friction", friction, "", [(), (3,)])
    sticks = None
    if is_traced(stick_ratio) or np.any(np.asarray(stick_ratio) != 1.0):
        sticks = as_array("stick_ratio", stick_ratio, "", non_negative=True)
        if not is_traced(sticks) and float(sticks) < 1:
            raise ValueError(f"stick_ratio must be at least 1, got {float(sticks):g}")
        if rubs is not None and rubs.ndim == 0:
            rubs = jnp.stack([rubs, rubs, rubs])
    drag = damping if friction_drag is None else friction_drag
    drags = _or_none("friction_drag", drag, "kg/(m s)")
    if rubs is not None and drags is None:
        raise ValueError(
            "friction needs friction_drag > 0 kg/(m s), what it resists per length "
            "and speed at the onset of slip (by default the damping), got 0"
        )
    return Contact(
        body=body,
        stiffness=as_array("stiffness", stiffness, "N/m^2", positive=True),
        onset=as_array("onset", onset, "", positive=True),
        damping=damps,
        friction=rubs,
        friction_drag=None if rubs is None else drags,
        stick_ratio=None if rubs is None else sticks,
        n_bodies=n_bodies,
        points_per_element=check_count(
            "points_per_element", points_per_element, 1, MOST_POINTS
        ),
    )


def _or_none(
    name: str, value: Numbers, unit: str, shapes: Sequence[tuple[int, ...]] = ((),)
) -> Array | None:
    """One or several numbers as an array, or `None` where they are known to be zero."""
    dtype = jnp.result_type(float)
    checked = check_array(name, value, shapes, unit, non_negative=True, dtype=dtype)
    known_zero = not is_traced(checked) and not np.any(checked)
    return None if known_zero else jnp.asarray(checked, dtype)


def _gathered(bodies: Body | Sequence[Body]) -> tuple[Body, int | None]:
    """Bodies as one, with a leading axis if there are several, and their number."""
    if isinstance(bodies, Body):
        return bodies, bodies.count
    if not isinstance(bodies, Sequence):
        raise TypeError(
            "bodies must be a jaxrod body or a sequence of them, got "
            f"{type(bodies).__name__}"
        )
    listed = list(bodies)
    if not listed:
        raise ValueError("bodies must be at least one, got none")
    kinds: list[Any] = [jax.tree.structure(body) for body in listed]
    for body, kind in zip(listed, kinds, strict=True):
        if not isinstance(body, Body):
            raise TypeError(f"bodies must be jaxrod bodies, got {type(body).__name__}")
        if kind != kinds[0]:
            raise TypeError(
                "bodies of one contact must be of a kind, got "
                f"{type(listed[0]).__name__} and {type(body).__name__}; list a "
                "contact for each kind in the scene"
            )
        if body.count is not None:
            raise TypeError("bodies in a sequence must be single ones")
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *listed), len(listed)

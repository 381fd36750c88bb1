"""Welds: rods joined to rods, and to rigid bodies, at a fixed relative angle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp

from jaxrod.geometry.rotations import (
    conjugate,
    join_quaternion,
    multiply_quaternions,
)
from jaxrod.systems.joints.attachments import attachment
from jaxrod.systems.joints.elastic_joints import ElasticJoint
from jaxrod.systems.joints.ties import pairs, tie
from jaxrod.systems.sites.coupling import Coupling
from jaxrod.systems.sites.places import (
    Place,
    layouts_of,
    points_of,
    position_of,
    resolved,
)


def weld(
    a: Place | Sequence[Place], b: Place | Sequence[Place], state: Mapping[str, Any]
) -> tuple[Coupling, ...]:
    """Joins rods: nodes become one, and an elastic joint connects their elements.

    The joint is half an element of each rod, as two springs in series that are at rest
    in `state`, each about the axes of its own section. The order of `a` and `b` does
    not matter. Two halves of a rod welded end to end make the whole rod. If the
    elements at the weld differ, as in a tapered rod, they do so only with
    `joint_mean="series"`.

    Args:
        a: A place, `("trunk", "tip")` or `("arms", 2, 7)`; or several.
        b: The place to which `a` is joined; or one for each place of `a`.
        state: State of the system at rest.

    Returns:
        Couplings for `make_system`.

    Raises:
        ValueError: If there is no such place, or two joined nodes are apart.
        TypeError: If a place is not a sequence such as `("arm", "tip")`.

    Example:
        >>> left = replace(state, positions=state.positions.at[0].add(-1.0))
        >>> states = {"left": left, "right": state}  # end to end
        >>> joint = systems.weld(("left", "tip"), ("right", "base"), states)
        >>> loose = jaxrod.make_scene(rod)
        >>> system = jaxrod.make_system({"left": loose, "right": loose}, joint)
        >>> len(system.couplings)  # one for the shared node, one for the angle
        2
    """
    first, second = pairs(a, b)
    joints = elastic_joints(first, second, state)
    return (tie(first, second, state), *joints)


def attach(
    a: Place | Sequence[Place],
    b: Place | Sequence[Place],
    state: Mapping[str, Any],
    *,
    turning: bool = False,
) -> tuple[Coupling, ...]:
    """Makes nodes of rods part of a rigid body, at their places in `state`.

    The attachment is exact and does not limit the time step: the body has the nodes'
    masses. The element is held at its angle to the body as by a clamp, unless it may
    turn.

    Args:
        a: A place on a rod, `("arm", "base")`; or several of one member.
        b: A body, `("head",)`; or one for each place of `a`.
        state: State of the system at rest.
        turning: Whether the elements turn freely about their nodes.

    Returns:
        Couplings for `make_system`.

    Raises:
        ValueError: If there is no such place.
        TypeError: If a place is not a sequence such as `("arm", "tip")`.

    Example:
        >>> shape = shapes.sphere((1.0, 0.0, 0.0), radius=0.1)
        >>> ball, there = systems.rigid_body(shape, density=1000.0)
        >>> states = {"arm": state, "ball": there}
        >>> held = systems.attach(("arm", "tip"), ("ball",), states)
        >>> system = jaxrod.make_system({"arm": scene, "ball": ball}, held)
        >>> list(system.couplings[0].joined_nodes())  # the tip is part of the ball
        [('arm', 10)]
    """
    first = pairs(a, a)[0]
    second = pairs(b, b)[0]
    if len(second) == 1:
        second = second * len(first)
    first, second = pairs(first, second)
    fixed = attachment(first, second, state)
    if turning:
        return (fixed,)
    return (fixed, *elastic_joints(second, first, state))


def elastic_joints(
    a: Sequence[Place], b: Sequence[Place], state: Mapping[str, Any]
) -> list[ElasticJoint]:
    """Elastic joints at rest in a state, one `ElasticJoint` per pair of members."""
    layouts = layouts_of(state)
    sorted_pairs: dict[tuple[str, str], list[int]] = {}
    ends = [
        (resolved("a", one, layouts), resolved("b", two, layouts))
        for one, two in zip(a, b, strict=True)
    ]
    for k, (one, two) in enumerate(ends):
        sorted_pairs.setdefault((one[0], two[0]), []).append(k)
    joints = []
    for which in sorted_pairs.values():
        frames = jnp.stack(
            [
                join_quaternion(
                    multiply_quaternions(
                        conjugate(position_of("a", a[k], state).orientation),
                        position_of("b", b[k], state).orientation,
                    )
                )
                for k in which
            ],
            axis=1,
        )
        joints.append(
            ElasticJoint(
                a=points_of("a", [ends[k][0] for k in which]),
                b=points_of("b", [ends[k][1] for k in which]),
                rest_frames=frames,
                rest_rotations=jnp.zeros_like(frames[1:]),
            )
        )
    return joints

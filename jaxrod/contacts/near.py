"""Contact with the nearest bodies only, for a rod among many bodies.

Contact with a dozen bodies costs several times as much as the rod itself, though a
section touches one or two at a time. The nearest bodies change slowly. Choose them from
time to time, say once per control step; the steps in between compute contact with these
bodies only.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxrod.contacts.bodies import Body
from jaxrod.contacts.contact import Contact
from jaxrod.contacts.points import contact_points
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import motion_of
from jaxrod.rods.rod import Rod, RodState, check_state
from jaxrod.structure import pytree
from jaxrod.validation import check_count, check_kind


@pytree
class OneForEach(Body):
    """A separate body for each contact point, along a trailing axis of the arrays."""

    body: Body
    """All bodies, of one kind, as one body. Its arrays have a trailing axis over
    points, and a leading axis if there are several bodies at each point."""

    def of_ends(self) -> OneForEach:
        """The bodies for the first and the last contact point only."""

        def ends(leaf: Array) -> Array:
            return jnp.concatenate([leaf[..., :1], leaf[..., -1:]], axis=-1)

        return OneForEach(jax.tree.map(ends, self.body))

    def surface(self, points: Vec3) -> tuple[Array, Vec3]:
        """Distance of each point from its own body, and the normal there.

        Raises:
            ValueError: If the bodies were chosen for another number of points.
        """

        def of_one(body: Body, *point: Array) -> tuple[Array, Vec3]:
            x, y, z = (component[None] for component in point)
            return body.surface((x, y, z))

        own = jax.tree.leaves(self.body)[0].shape[-1]
        if own != len(points[0]):
            raise ValueError(
                f"near_contact chose bodies for {own} points of a rod, got "
                f"{len(points[0])}: choose them for this rod"
            )
        each = jax.vmap(of_one, in_axes=-1, out_axes=-1)(self.body, *points)
        distance, (x, y, z) = jax.tree.map(lambda leaf: leaf[0], each)
        return distance, (x, y, z)


def near_contact(contact: Contact, rod: Rod, state: RodState, count: int) -> Contact:
    """The same contact, but each point is tested against its nearest bodies only.

    This is exact as long as every body that a point touches is among its `count`
    nearest ones. Choose them again before a point can reach another body. `stable_dt`
    counts `count` bodies at each point instead of all. Forces do not jump when bodies
    are chosen again, since the bodies left out do not touch.

    Args:
        contact: Contact with several bodies.
        rod: The rod.
        state: State of the rod, at which the nearest bodies are chosen.
        count: Number of nearest bodies to test at each point, at most all.

    Returns:
        An effect to list in a scene in place of `contact`, for this rod.

    Raises:
        ValueError: If `count` is not between 1 and the number of bodies.
        TypeError: If `contact`, `rod` or `state` is something else.

    Example:
        >>> centres = jnp.linspace(jnp.array([0, 0, -1.0]), jnp.array([0, 0, -0.1]), 12)
        >>> balls = jax.vmap(lambda centre: shapes.sphere(centre, 0.05))(centres)
        >>> all_balls = jaxrod.contact(balls, stiffness=1e4)
        >>> near = jaxrod.near_contact(all_balls, rod, state, count=2)
        >>> all_balls.n_bodies, near.n_near
        (12, 2)
    """
    check_kind("contact", contact, Contact)
    check_state(rod, state)
    bodies = contact.n_bodies or 1
    if check_count("count", count, 1) > bodies:
        raise ValueError(f"count must be at most the {bodies} bodies, got {count}")
    if count == bodies:
        return dataclasses.replace(contact, near=None, n_near=None)
    position = motion_of(state).position

    def nearest(place: Vec3) -> Body:
        distances = jax.vmap(lambda body: body.surface(place)[0])(contact.body)
        chosen = _smallest(distances, count)
        return jax.tree.map(
            lambda leaf: jnp.moveaxis(leaf[chosen], 1, -1), OneForEach(contact.body)
        )

    points = contact_points(rod, contact.points_per_element)
    near = tuple(nearest(some.of_nodes(position)) for some in points)
    return dataclasses.replace(contact, near=near, n_near=count)


def _smallest(
    values: Float[Array, "bodies points"], count: int
) -> Int[Array, "count points"]:
    """Indices of the `count` smallest values at each point, the smallest first.

    They are searched one after another: for a few out of a dozen that is faster than
    sorting.
    """
    numbers = jnp.arange(len(values))[:, None]
    chosen = []
    for _ in range(count):
        chosen.append(jnp.argmin(values, axis=0))
        values = jnp.where(numbers == chosen[-1][None], jnp.inf, values)
    return jnp.stack(chosen)

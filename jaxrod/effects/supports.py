"""Supports that do not move: nodes held along world axes, and hinges.

Walls that clamp an end are in `jaxrod.effects.clamps`, moving supports in
`jaxrod.effects.driven`.
"""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.effects.base import Effect, Reaction, StabilityBound
from jaxrod.effects.ends import (
    ALL_AXES,
    Axes,
    End,
    Held,
    at_end,
    check_end,
    check_made_for,
    held_end,
    made_again_for,
    only_at_end,
    place,
)
from jaxrod.geometry import vectors
from jaxrod.geometry.material_frames import unit_vector
from jaxrod.geometry.rotations import (
    directors,
    split_quaternion,
    to_material,
    to_world,
)
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads, Motion
from jaxrod.rods.rod import Rod, RodState, check_one, node_places
from jaxrod.structure import pytree, static
from jaxrod.validation import Numbers, check_kind


def end_node(rod: Rod, end: End | int) -> int:
    """Index of the node at an end of a rod; the given one if `end` is a number."""
    ends: dict[End | int, int] = {"base": 0, "tip": rod.n_elements}
    return int(ends.get(end, end))


def node_of(state: RodState, node: End | int, name: str = "node") -> int:
    """Index of a node of a state, from an end or a number; messages call it `name`.

    Raises:
        ValueError: If there is no such node.
    """
    nodes = state.positions.shape[-1]
    if isinstance(node, str):
        return 0 if check_end(node) == "base" else nodes - 1
    if isinstance(node, bool) or not isinstance(node, int | np.integer):
        raise ValueError(f'{name} must be "base", "tip" or a number, got {node!r}')
    if not 0 <= node < nodes:
        raise ValueError(f"{name} must be from 0 to {nodes - 1}, got {node}")
    return int(node)


def node_on(new_rod: Rod, node: int, rod: Rod) -> int:
    """Index of the node of `new_rod` at the same rest arc length as a node of `rod`.

    Raises:
        ValueError: If there is none.
    """
    share = node_places(rod)[node] / node_places(rod)[-1]
    places = node_places(new_rod) / node_places(new_rod)[-1]
    found = int(np.argmin(np.abs(places - share)))
    if abs(float(places[found] - share)) * new_rod.n_elements > 1e-6:
        raise ValueError(
            f"a rod of {new_rod.n_elements} elements has no node at the place of the "
            f"support of node {node}: choose another number of elements"
        )
    return found


def at_node(field: Vec3, value: Array, node: int, axes: Axes) -> Vec3:
    """Vector field over nodes, set to `value` at one node along the flagged axes."""
    here = np.arange(field[0].shape[0]) == node
    x, y, z = (
        jnp.where(here, value[k], component) if axes[k] else component
        for k, component in enumerate(field)
    )
    return x, y, z


def distance_from(
    place: Array, node: int, axes: Axes, rod: Rod, state: RodState
) -> Array:
    """Distance of a node from the point `place`, divided by the radius there [1].

    Only components along the flagged axes count.
    """
    apart = (state.positions[:, node] - place) * jnp.asarray(axes, place.dtype)
    return (
        vectors.safe_norm(vectors.split(apart))
        / rod.radii[min(node, rod.n_elements - 1)]
    )


def force_at(needed: Loads, node: int, axes: Axes) -> Vec3:
    """Force needed at a node along the flagged axes, zero along others, world [N]."""
    assert needed.forces is not None
    x, y, z = (
        component[node] if held else jnp.zeros_like(component[node])
        for component, held in zip(needed.forces, axes, strict=True)
    )
    return x, y, z


def own_couple(effect: Effect, rod: Rod, motion: Motion, end: End) -> Vec3:
    """Couple of an effect on the element at one end, world frame [N m]."""
    couples = effect.loads(rod, motion).couples
    assert couples is not None
    index = 0 if end == "base" else -1
    x, y, z = (component[index] for component in couples)
    return to_world(directors(at_end(motion.orientation, end)), (x, y, z))


def axes_named(axes: str) -> Axes:
    """Flags of the axes named in a string such as "xz"."""
    if not isinstance(axes, str) or not axes or not set(axes) <= set("xyz"):
        raise ValueError(f'axes must be some of "xyz", got {axes!r}')
    return "x" in axes, "y" in axes, "z" in axes


def check_straight_end(rod: Rod, end: End) -> None:
    """Raises ValueError if the joint next to an end has curvature or twist at rest."""
    index = 0 if end == "base" else -1
    if np.any(np.asarray(rod.rest_curvatures[:, index]) != 0):
        raise ValueError(
            "a support of an end that is curved at rest cannot be resampled: make a "
            "new support for the new rod"
        )


@pytree
class Pin(Effect):
    """A node held in place along world axes; elements rotate freely."""

    position: Float[Array, "3"]
    """Position at which the node is held, world frame [m]; unused along other axes."""
    node: int = static(default=0)
    """Index of the node."""
    axes: Axes = static(default=(True, True, True))
    """Flags of the world axes x, y, z along which the node is held."""
    made_for: int | None = static(default=None)
    """Number of elements that the rod must have, see `check`; `None` for any number."""

    def constrain_rates(self, rod: Rod, motion: Motion) -> Motion:
        """Sets the velocity of the node to zero along the held axes."""
        still = jnp.zeros_like(self.position)
        velocity = at_node(motion.velocity, still, self.node, self.axes)
        return replace(motion, velocity=velocity)

    def violation(self, rod: Rod, state: RodState) -> Array:
        """Distance from the held position along the held axes, over the radius [1]."""
        return distance_from(self.position, self.node, self.axes, rod, state)

    def reaction(self, rod: Rod, motion: Motion, needed: Loads) -> Reaction:
        """Force that keeps the node in place along the held axes."""
        return Reaction.of(force_at(needed, self.node, self.axes))

    def held(self, rod: Rod) -> tuple[Held, ...]:
        """The node, along its held axes."""
        return (Held(self.node, self.axes),)

    def check(self, rod: Rod) -> None:
        """Raises ValueError if the node is missing or `made_for` does not fit."""
        check_made_for("pin", self.made_for, rod)
        if not 0 <= self.node <= rod.n_elements:
            raise ValueError(
                f"node must be from 0 to {rod.n_elements}, got {self.node}"
            )

    def resampled(self, rod: Rod, new_rod: Rod) -> Pin:
        """Pin at the same point of `new_rod`; raises if that has no node there."""
        made_for = made_again_for(self.made_for, new_rod)
        node = node_on(new_rod, self.node, rod)
        return replace(self, node=node, made_for=made_for)


@pytree
class Hinge(Effect):
    r"""An end node held in place, whose element turns about one axis only.

    The hinge is half an element away from the middle of the end element, as the wall of
    a `Clamp` is. The couple $k\, e \times a$ pulls a material axis $e$ of the element
    towards the hinge's axis $a$. $k$ is the bending stiffness of the element divided by
    that half length.
    """

    position: Float[Array, "3"]
    """Position at which the end node is held, world frame [m]."""
    axis: Float[Array, "3"]
    """Unit vector $a$ along the hinge, world frame."""
    own_axis: Float[Array, "3"]
    """Unit vector $e$ of the end element along the hinge at rest, material frame."""
    end: End = static(default="base")
    """End of the rod that is held, "base" or "tip"."""
    made_for: int | None = static(default=None)
    """Number of elements that the rod must have, see `check`; `None` for any number."""

    def check(self, rod: Rod) -> None:
        """Raises ValueError if the rod does not have `made_for` elements."""
        check_made_for("hinge", self.made_for, rod)

    def _stiffness(self, rod: Rod) -> Array:
        """Larger of both bending stiffnesses over half the element length [N m]."""
        index = 0 if self.end == "base" else -1
        return jnp.max(rod.bend_twist_stiffness[:2, index]) / (
            0.5 * rod.rest_lengths[index]
        )

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        r"""Couple $k\, e \times a$ of the joint on the end element."""
        frame = directors(at_end(motion.orientation, self.end))
        axis = to_material(frame, vectors.split(self.axis))
        pull = vectors.cross(vectors.split(self.own_axis), axis)
        couple = vectors.scale(self._stiffness(rod), pull)
        return Loads(couples=only_at_end(couple, rod.n_elements, self.end))

    def energy(self, rod: Rod, state: RodState) -> Array:
        """Elastic energy of the joint, $k |e - a|^2 / 2$ [J]."""
        frame = directors(at_end(split_quaternion(state.orientations), self.end))
        own = to_world(frame, vectors.split(self.own_axis))
        apart = vectors.subtract(own, vectors.split(self.axis))
        return 0.5 * self._stiffness(rod) * vectors.dot(apart, apart)

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Stiffness of the joint against rotation of the end element."""
        return StabilityBound(
            elements=place(self._stiffness(rod), rod.n_elements, self.end)
        )

    def constrain_rates(self, rod: Rod, motion: Motion) -> Motion:
        """Sets the velocity of the end node to zero."""
        node = end_node(rod, self.end)
        still = jnp.zeros_like(self.position)
        return replace(motion, velocity=at_node(motion.velocity, still, node, ALL_AXES))

    def violation(self, rod: Rod, state: RodState) -> Array:
        """Larger of two ratios: distance over radius, and $|e - a|$ [1].

        The distance is that of the end node from its held position. $|e - a|$ is twice
        sin(tilt / 2), with the tilt of the element from the hinge.
        """
        frame = directors(at_end(split_quaternion(state.orientations), self.end))
        own = to_world(frame, vectors.split(self.own_axis))
        tilt = vectors.safe_norm(vectors.subtract(own, vectors.split(self.axis)))
        node = end_node(rod, self.end)
        return jnp.maximum(
            distance_from(self.position, node, ALL_AXES, rod, state), tilt
        )

    def held(self, rod: Rod) -> tuple[Held, ...]:
        """End node along all axes, and the end element, which turns about one axis."""
        return (held_end(self.end),)

    def resampled(self, rod: Rod, new_rod: Rod) -> Hinge:
        """The same hinge for `new_rod`; raises if the end is curved at rest."""
        check_straight_end(rod, self.end)
        return replace(self, made_for=made_again_for(self.made_for, new_rod))

    def reaction(self, rod: Rod, motion: Motion, needed: Loads) -> Reaction:
        """Force that keeps the node in place, and couple of the joint."""
        force = force_at(needed, end_node(rod, self.end), ALL_AXES)
        return Reaction.of(force, own_couple(self, rod, motion, self.end))


def pin_support(state: RodState, node: End | int = "base", *, axes: str = "xyz") -> Pin:
    """Holds a node along world axes at its position in a state; elements may turn.

    Args:
        state: The state of the rod.
        node: "base", "tip", or the index of a node, from 0.
        axes: World axes along which it is held: "xyz" for a pin, "z" for a smooth
            floor, "yz" for a rail along x.

    Raises:
        ValueError: If there is no such node, or no such axes.
        TypeError: If `state` is not a `RodState`.

    Example:
        >>> rail = jaxrod.pin_support(state, "tip", axes="z")  # free along x and y
        >>> beam = jaxrod.make_scene(rod, jaxrod.pin_support(state), rail)
        >>> moving = replace(state, velocities=jnp.ones_like(state.velocities))
        >>> after = jaxrod.step(beam, moving, 1e-4)
        >>> [round(float(x), 5) for x in after.tip - state.tip]
        [0.0001, 0.0001, 0.0]
    """
    check_kind("state", state, RodState)
    check_one(state)
    which, nodes = node_of(state, node), state.positions.shape[-1]
    return Pin(state.positions[:, which], which, axes_named(axes), nodes - 1)


def hinge_support(state: RodState, axis: Numbers, end: End = "base") -> Hinge:
    """Holds an end node at its position in a state; its element turns about one axis.

    Args:
        state: The state of the rod, in which the hinge is at rest.
        axis: Direction of the hinge, world frame, of any length `(3,)`.
        end: The end that is held.

    Raises:
        ValueError: If an argument is out of range.
        TypeError: If `state` is not a `RodState`.

    Example:
        >>> hinge = jaxrod.hinge_support(state, axis=(0.0, 2.0, 0.0))
        >>> hinge.axis.tolist()
        [0.0, 1.0, 0.0]
        >>> pendulum = jaxrod.make_scene(rod, hinge, jaxrod.gravity())
        >>> after = jaxrod.step(pendulum, state, 1e-4)
        >>> after.positions[:, 0].tolist(), bool(after.tip[2] < 0)
        ([0.0, 0.0, 0.0], True)
    """
    check_kind("state", state, RodState)
    check_one(state)
    index = 0 if check_end(end) == "base" else -1
    along = jnp.asarray(unit_vector("axis", axis), state.positions.dtype)
    frame = directors(at_end(split_quaternion(state.orientations), end))
    own = vectors.join(to_material(frame, vectors.split(along)))
    made_for = state.positions.shape[-1] - 1
    return Hinge(state.positions[:, index], along, own, end, made_for)

"""What a scene may have to be simulated without twist: checks, in words."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod import vectors
from jaxrod._contact import Contact
from jaxrod._validation import is_traced
from jaxrod.actuation import ElementCouples
from jaxrod.clamps import Clamp, FixedEnd
from jaxrod.directions import frame_along
from jaxrod.effects import Effect, EndLoad
from jaxrod.motion import Motion
from jaxrod.rod import Rod
from jaxrod.rotations import Quaternion, directors, multiply_quaternions
from jaxrod.scene import Scene
from jaxrod.vectors import Vec3


def held_end(scene: Scene) -> Clamp | FixedEnd | None:
    """The effect that holds an end of the rod, if there is one."""
    for effect in scene.effects:
        if isinstance(effect, (Clamp, FixedEnd)):
            return effect
    return None


def check_structure(scene: Scene) -> None:
    """Checks, whether traced or not, that no effect is of a kind that twists.

    Raises:
        ValueError: If one is.
    """
    held = 0
    for effect in scene.effects:
        held += isinstance(effect, (Clamp, FixedEnd))
        if isinstance(effect, ElementCouples):
            _refuse("loads that do not turn with the elements", "ElementCouples")
        if isinstance(effect, EndLoad) and effect.follower:
            _refuse(
                "loads that do not turn with the elements",
                "an EndLoad with follower=True",
            )
        if isinstance(effect, Contact) and effect.friction is not None:
            _refuse("loads without couples about d3", "a Contact with friction")
    if held > 1:
        _refuse("at most one held end, because two store twist", f"{held} of them")


def check_torsion_free(scene: Scene) -> None:
    """Checks that nothing would twist the rod of a scene but its own inertia.

    Where values are traced, or of many rods at once, the structure alone is checked.

    Raises:
        ValueError: If the rod is curved or sheared at rest, if its sections differ
            about d1 and d2, or if a load depends on how elements are turned about d3
            or turns them about it.
    """
    check_structure(scene)
    rod = scene.rod
    if is_traced(scene) or rod.rest_lengths.ndim > 1:
        return
    tolerance = float(np.sqrt(np.finfo(np.asarray(rod.radii).dtype).eps))
    bend = np.asarray(rod.bend_twist_stiffness, np.float64)
    shear = np.asarray(rod.shear_stretch_stiffness, np.float64)
    turns = np.asarray(rod.rest_curvatures, np.float64) * float(rod.length)
    problems = {
        "equal bending stiffness about d1 and d2": bend[0] / bend[1] - 1,
        "equal shear stiffness along d1 and d2": shear[0] / shear[1] - 1,
        "a rod that is straight at rest": turns,
        "a rod without shear at rest": np.asarray(rod.rest_strains[:2]),
    }
    for demand, values in problems.items():
        worst = np.max(np.abs(values))
        if not worst <= tolerance:
            _refuse(demand, f"{worst:.2g} off")
    if not scene.effects:
        return
    shares = np.asarray(_twisting_shares(rod, scene.effects))
    for effect, (turning, about_axis) in zip(scene.effects, shares, strict=True):
        name = type(effect).__name__
        if not turning <= tolerance:
            _refuse(
                "loads that do not turn with the elements",
                f"{name}, which does by {turning:.2g} of its size",
            )
        if not about_axis <= tolerance:
            _refuse(
                "loads without couples about d3",
                f"{name} with {about_axis:.2g} of its couples about it",
            )


def _refuse(demand: str, found: str) -> None:
    raise ValueError(
        f"torsion_free() needs {demand}, got {found}; another method has no such needs"
    )


@jax.jit
def _twisting_shares(rod: Rod, effects: tuple[Effect, ...]) -> Array:
    """How much of each effect's loads turns with the elements, how much twists.

    Looked at on a rod of no particular shape, before and after its elements are
    turned about their axes. A wall's twist is known to be none: it is left out.
    """
    k = jnp.arange(rod.n_elements, dtype=rod.rest_lengths.dtype)
    x, y, z = jnp.cos(1.1 * k + 0.3), jnp.sin(1.7 * k + 0.7), jnp.cos(0.6 * k - 0.5)
    direction = vectors.scale(1 / jnp.sqrt(x * x + y * y + z * z), (x, y, z))
    position = _summed(vectors.scale(rod.rest_lengths, direction))
    spin = vectors.cross(direction, vectors.scale(rod.inertias[0], (y, z, x)))
    orientation = frame_along(direction)
    zero = jnp.zeros_like(k)
    turn = (jnp.cos(k + 0.4), zero, zero, jnp.sin(k + 0.4))
    before, after = (
        Motion(position, frame, (position[1], position[2], position[0]), spin)
        for frame in (orientation, multiply_quaternions(orientation, turn))
    )

    def of(effect: Effect) -> Array:
        if isinstance(effect, Clamp):
            return jnp.zeros(2, k.dtype)
        one, other = effect.loads(rod, before), effect.loads(rod, after)
        turning, about_axis = jnp.zeros((), k.dtype), jnp.zeros((), k.dtype)
        if one.forces is not None and other.forces is not None:
            turning = _gap(one.forces, other.forces)
        if one.couples is not None and other.couples is not None:
            first = _across(before.orientation, one.couples)
            gap = _gap(first, _across(after.orientation, other.couples))
            turning = jnp.maximum(turning, gap)
            about_axis = _share(jnp.abs(one.couples[2]), one.couples)
        return jnp.stack([turning, about_axis])

    return jnp.stack([of(effect) for effect in effects])


def _summed(edges: Vec3) -> Vec3:
    x, y, z = (vectors.pad(jnp.cumsum(c), 1, 0) for c in edges)
    return x, y, z


def _across(orientation: Quaternion, couples: Vec3) -> Vec3:
    """The part of couples perpendicular to d3, in the world frame."""
    d1, d2, _ = directors(orientation)
    return vectors.add(vectors.scale(couples[0], d1), vectors.scale(couples[1], d2))


def _gap(one: Vec3, other: Vec3) -> Array:
    """The largest change of a component."""
    x, y, z = vectors.subtract(one, other)
    return _share(jnp.maximum(jnp.maximum(jnp.abs(x), jnp.abs(y)), jnp.abs(z)), one)


def _share(part: Array, whole: Vec3) -> Array:
    """The largest of parts, of the largest component of the whole; zero of nothing."""
    size = jnp.max(jnp.abs(vectors.join(whole)))
    return jnp.max(part) / jnp.where(size > 0, size, 1)

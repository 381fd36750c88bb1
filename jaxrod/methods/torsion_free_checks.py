"""Checks of what a scene without twist may contain."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.effects.base import Effect
from jaxrod.effects.ends import Wall
from jaxrod.effects.time import at_largest
from jaxrod.effects.trial_motion import trial_motion
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import Quaternion, directors, multiply_quaternions
from jaxrod.geometry.vectors import Vec3
from jaxrod.loaded_rod import LoadedRod
from jaxrod.rods.motion import Motion
from jaxrod.rods.rod import Rod
from jaxrod.validation import is_traced


def wall_of(scene: LoadedRod) -> Wall | None:
    """The wall that holds the orientation at an end of the rod, if there is one."""
    for effect in scene.effects:
        wall = effect.wall(scene.rod)
        if wall is not None:
            return wall
    return None


def has_elastic_wall(effect: Effect, rod: Rod) -> bool:
    """Whether an effect's only loads are those of an elastic joint to a wall."""
    wall = effect.wall(rod)
    return wall is not None and wall.stiffness is not None


def check_structure(scene: LoadedRod) -> None:
    """Checks, also for traced scenes, that no effect is of a kind that twists.

    Raises:
        ValueError: If an effect is.
    """
    held = 0
    for effect in scene.effects:
        if effect.twists is not None:
            _refuse(
                "loads that neither turn with the elements nor twist them",
                f"{type(effect).__name__} with {effect.twists}",
            )
        has_wall = effect.wall(scene.rod) is not None
        held += has_wall
        if not has_wall and _holds_elements(effect, scene.rod):
            _refuse(
                "effects that hold elements to say which and how by `Effect.wall`",
                type(effect).__name__,
            )
    if held > 1:
        _refuse("at most one held end, because two store twist", f"{held} of them")


def check_walls_stand(scene: LoadedRod) -> None:
    """Checks that no wall depends on time or has memory.

    Raises:
        ValueError: If a wall does: the frames of elements are taken from it once.
    """
    for effect in scene.evolving_effects:
        if at_largest(effect).wall(scene.rod) is not None:
            _refuse(
                "walls that stand still",
                f"{type(effect).__name__}, which depends on time or remembers",
            )


def _holds_elements(effect: Effect, rod: Rod) -> bool:
    """Whether an effect constrains orientations or spins of elements.

    For batches of rods it is not known: each rod is checked when it steps.
    """
    if rod.batch_shape:
        return False
    touched = []

    def look(motion: Motion) -> None:
        placed, paced = (
            effect.constrain(rod, motion),
            effect.constrain_rates(rod, motion),
        )
        pairs = (
            *zip(placed.orientation, motion.orientation, strict=True),
            *zip(paced.spin, motion.spin, strict=True),
        )
        touched.append(any(one is not other for one, other in pairs))

    jax.eval_shape(lambda: look(trial_motion(rod)))
    return touched[0]


def check_torsion_free(scene: LoadedRod) -> None:
    """Checks that only its own inertia could twist the rod of a scene.

    If values are traced or belong to batches of rods, only the structure is checked.

    Raises:
        ValueError: If the rod is curved or sheared at rest, if its sections differ
            about d1 and d2, or if a load depends on the rotation of elements about d3
            or turns them about it.
    """
    check_structure(scene)
    rod = scene.rod
    if not rod.is_round:
        _refuse("round sections", "rotary inertia about d1, d2 and d3")
    if is_traced(scene) or rod.batch_shape:
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
    """Fractions of each effect's loads that turn with the elements or twist them.

    Computed on a generic rod, before and after its elements are rotated about their
    axes. A wall is known not to twist, so it is left out.
    """
    before = trial_motion(rod)
    k = jnp.arange(rod.n_elements, dtype=rod.rest_lengths.dtype)
    zero = jnp.zeros_like(k)
    turn = (jnp.cos(k + 0.4), zero, zero, jnp.sin(k + 0.4))
    turned = multiply_quaternions(before.orientation, turn)
    after = replace(before, orientation=turned)

    def of(effect: Effect) -> Array:
        if has_elastic_wall(effect, rod):
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


def _across(orientation: Quaternion, couples: Vec3) -> Vec3:
    """Component of couples perpendicular to d3, in the world frame."""
    d1, d2, _ = directors(orientation)
    return vectors.add(vectors.scale(couples[0], d1), vectors.scale(couples[1], d2))


def _gap(one: Vec3, other: Vec3) -> Array:
    """Largest change of a component, relative to the largest component."""
    x, y, z = vectors.subtract(one, other)
    return _share(jnp.maximum(jnp.maximum(jnp.abs(x), jnp.abs(y)), jnp.abs(z)), one)


def _share(part: Array, whole: Vec3) -> Array:
    """Largest of parts, over the largest component of the whole; zero if that is."""
    size = jnp.max(jnp.abs(vectors.join(whole)))
    return jnp.max(part) / jnp.where(size > 0, size, 1)

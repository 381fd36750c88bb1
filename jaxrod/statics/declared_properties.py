"""Checks of effects' declared properties, on which implicit steps and equilibria rely.

Implicit steps and equilibria take the derivative of an effect's loads from its
declarations, and find the components that it holds by a few trials. A false declaration
would silently give a wrong derivative, or hold a rod where it is free.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.effects.base import Effect, Reach
from jaxrod.effects.own_classes import trial_motion
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import (
    directors,
    multiply_quaternions,
    rotation_exp,
    to_world,
)
from jaxrod.loaded_rod import LoadedRod, Method, free_velocity_mask
from jaxrod.rods.motion import Motion
from jaxrod.rods.rod import Rod
from jaxrod.statics.block_matrices import BlockTridiagonal, of_five_bands
from jaxrod.statics.degrees_of_freedom import (
    free_position_mask,
    stack_dofs,
    unstack_dofs,
)
from jaxrod.statics.effect_tangents import bands_by_colouring, has_closed_form
from jaxrod.validation import is_traced


def check_declared_properties(scene: LoadedRod) -> None:
    """Raises unless custom effects behave as they declare.

    Effects are tested on a generic rod, and on the same rod shrunk to almost a point.
    Deviations that occur only elsewhere are not detected. A scene that is traced or
    batched is not tested, nor are jaxrod's own effects.

    Raises:
        ValueError: If loads do not change as an effect's `turning_tangent` or `reach`
            declares, or if the effect holds components only partly or couples some to
            others.
    """
    if is_traced(scene) or scene.rod.batch_shape:
        return
    # The library's own effects have tests.
    others = [e for e in scene.effects if not type(e).__module__.startswith("jaxrod.")]
    doubtful = tuple(e for e in others if _says(e) or _holds(e))
    if not doubtful:
        return
    tolerance = float(np.sqrt(np.finfo(scene.rod.radii.dtype).eps))
    tried = _tried(scene.rod, doubtful)
    for effect, (gap, mixing) in zip(doubtful, tried, strict=True):
        name = type(effect).__name__
        if not gap <= tolerance:
            says = "turning_tangent" if has_closed_form(effect) else "reach"
            raise ValueError(
                "an effect's loads must change with the configuration as it declares, "
                f"but {name}.{says} is off by {float(gap):.2g} of their size; "
                "without this declaration jaxrod differentiates them automatically"
            )
        if not mixing <= tolerance:
            raise ValueError(
                "implicit steps and equilibria need effects to hold whole components "
                "of positions and velocities and whole orientations, but "
                f"{name} holds some only partly or couples some to others"
            )


def _says(effect: Effect) -> bool:
    """Whether an effect declares a tangent or reach of its loads, to be checked."""
    if type(effect).loads is Effect.loads:
        return False
    return has_closed_form(effect) or effect.actual_reach != "any"


def _holds(effect: Effect) -> bool:
    """Whether an effect constrains positions, orientations or rates."""
    kind = type(effect)
    return (
        kind.constrain is not Effect.constrain
        or kind.constrain_rates is not Effect.constrain_rates
    )


@jax.jit
def _tried(rod: Rod, effects: tuple[Effect, ...]) -> list[tuple[Array, Array]]:
    """Relative errors of the declared loads and of the supports, for each effect.

    The first is the error of the declared tangent or reach, relative to the derivative
    of the loads. The second is the part of the motion that supports hold only partly.
    Each is zero if nothing is declared or held.
    """
    zero = jnp.zeros((), rod.rest_lengths.dtype)
    return [
        (
            _gap_of_tangent(effect, rod) if _says(effect) else zero,
            _mixing(effect, rod) if _holds(effect) else zero,
        )
        for effect in effects
    ]


def _gap_of_tangent(effect: Effect, rod: Rod) -> Array:
    """Difference of true and declared change of loads, relative to the loads [1]."""
    step = _any_step(rod)
    nodes, turns = unstack_dofs(step)
    transverse, polar = rod.inertias
    shape = trial_motion(rod)

    def gap(size: Array, moved: Array) -> Array:
        """Relative error of the declared change of loads, for a rod scaled by `size`.

        Configurations change if `moved` is 1, rates if it is 0.
        """
        motion = replace(shape, position=vectors.scale(size, shape.position))

        def loads(motion: Motion) -> Array:
            found = effect.loads(rod, motion)
            forces, couples = jax.tree.map(jnp.zeros_like, (nodes, turns))
            if found.forces is not None:
                forces = found.forces
            if found.couples is not None:
                couples = to_world(directors(motion.orientation), found.couples)
            return stack_dofs(forces, couples)

        now, change = jax.linearize(loads, motion)

        def push(step: Array) -> Array:
            nodes, turns = unstack_dofs(step)
            half = vectors.scale(0.5 * moved, turns)
            turned = (jnp.zeros_like(half[0]), *half)
            spins = vectors.multiply((transverse, transverse, polar), turns)
            return change(
                replace(
                    jax.tree.map(jnp.zeros_like, motion),
                    position=vectors.scale(moved, nodes),
                    orientation=multiply_quaternions(turned, motion.orientation),
                    velocity=vectors.scale(1 - moved, nodes),
                    spin=vectors.scale(1 - moved, spins),
                )
            )

        true = push(step)
        if has_closed_form(effect):
            said = jnp.zeros_like(true)
            tangent = effect.turning_tangent(rod, motion)
            if tangent is not None:
                x, y, z = (-moved * vectors.dot(row, turns) for row in tangent)
                said = stack_dofs(jax.tree.map(jnp.zeros_like, nodes), (x, y, z))
        else:
            said = _times_coloured(push, step, effect.actual_reach)
        sizes = jnp.abs(jnp.stack([true - said, true, said, now]))
        # Forces and couples have different units.
        off, *whole = jnp.max(sizes.reshape(4, -1, 2, 3), axis=(1, 3))
        return jnp.max(_share(off, jnp.max(jnp.stack(whole), axis=0)))

    trials = jnp.asarray([[1, 1, 1e-3, 1e-3], [1, 0, 1, 0]], step.dtype)
    return jnp.max(jax.vmap(gap)(*trials))


def _times_coloured(push: Callable[[Array], Array], step: Array, reach: Reach) -> Array:
    """Product of a step and the matrix of `push` that colouring with a reach finds.

    It equals `push(step)` if the loads have that reach.
    """
    if reach == "neighbours":
        return BlockTridiagonal(*bands_by_colouring(push, step, 1)).multiply(step)
    bands = bands_by_colouring(push, step, 2)
    return of_five_bands(bands, spare=0.0).multiply(step)


def _mixing(effect: Effect, rod: Rod) -> Array:
    """Relative error of assuming that components are held fully or not at all [1]."""
    alone, motion = LoadedRod(rod, (effect,), Method()), trial_motion(rod)
    nodes, turns = unstack_dofs(_any_step(rod))

    def with_rates(size: float) -> Motion:
        velocity, spin = jax.tree.map(lambda a: size * a, (nodes, turns))
        return effect.constrain_rates(
            rod, replace(motion, velocity=velocity, spin=spin)
        )

    still, moving = with_rates(0.0), with_rates(1.0)
    free = free_velocity_mask(alone, motion)
    pairs = [
        *_expected(free[0], still.velocity, nodes, moving.velocity),
        *_expected(free[1], still.spin, turns, moving.spin),
    ]
    placed = free_position_mask(alone, motion)
    if placed is not None:
        here = effect.constrain(rod, motion)
        moved = replace(
            motion,
            position=vectors.add(motion.position, nodes),
            orientation=multiply_quaternions(motion.orientation, rotation_exp(turns)),
        )
        there = effect.constrain(rod, moved)
        frames = [placed[1][0]] * 4
        pairs += _expected(placed[0], here.position, moved.position, there.position)
        pairs += _expected(
            frames, here.orientation, moved.orientation, there.orientation
        )
    gaps = [_share(jnp.max(jnp.abs(a - b)), jnp.max(jnp.abs(b))) for a, b in pairs]
    return jnp.max(jnp.stack(gaps))


def _expected(
    free: Sequence[Array],
    held: Sequence[Array],
    given: Sequence[Array],
    found: Sequence[Array],
) -> list[tuple[Array, Array]]:
    """Pairs of components: after a constraint is applied, and as its flags predict.

    The prediction is `given` where a component is free (1), and `held` elsewhere.
    """
    parts = zip(free, held, given, found, strict=True)
    return [(d, jnp.where(a == 1, c, b)) for a, b, c, d in parts]


def _any_step(rod: Rod) -> Float[Array, "n+1 6"]:
    """Arbitrary displacements about as large as the rod, and rotations."""
    random = np.random.default_rng(0).normal(size=(rod.n_elements + 1, 6))
    length = jnp.sum(rod.rest_lengths)
    units = jnp.stack([length] * 3 + [jnp.ones_like(length)] * 3)
    return jnp.asarray(random, length.dtype) * units[None]


def _share(part: Array, whole: Array) -> Array:
    return part / jnp.where(whole > 0, whole, 1)

"""What a scene needs to be simulated in a plane: checks, in words."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.planar import PlanarStepper
from jaxrod.rod import RodState
from jaxrod.scene import PLANES, Scene

_PARTS = (
    "node positions",
    "velocities",
    "the directions of elements",
    "angular momenta",
    "twist between elements",
    "rest curvatures",
    "rest strains",
    "bending stiffness",
    "shear stiffness",
    "forces of effects",
    "couples of effects",
    "the surfaces of bodies",
)


def check_planar(scene: Scene, state: RodState) -> None:
    """Checks that a rod is in the scene's plane and that nothing takes it out.

    Args:
        scene: A scene with a plane.
        state: Its concrete state.

    Raises:
        ValueError: If positions, velocities, orientations, spins, rest shape or loads
            have parts out of the plane, or if bending about the normal is not
            bending about one principal axis.
    """
    shares = np.asarray(_shares_outside(scene, state))
    tolerance = np.sqrt(np.finfo(shares.dtype).eps)
    for what, share in zip(_PARTS, shares, strict=True):
        if not share <= tolerance:
            raise ValueError(
                f"a scene in the {scene.plane} plane needs {what} in that plane, got "
                f"{share:.2g} of their size out of it; leave out plane={scene.plane!r} "
                "for a motion in space"
            )


# Compiled: operation by operation, this takes longer than thousands of steps.
@jax.jit
def _shares_outside(scene: Scene, state: RodState) -> Float[Array, " parts"]:
    """How far out of the plane each of `_PARTS` is, relative to its own scale."""
    assert scene.plane is not None
    a, b, out = PLANES[scene.plane]
    rod = scene.rod
    frame = state.directors
    n1, n2, n3 = frame[0, out], frame[1, out], frame[2, out]
    oblique = n1 * n2
    length = jnp.sum(rod.rest_lengths)
    bend, shear = rod.bend_twist_stiffness, rod.shear_stretch_stiffness
    rest = rod.rest_curvatures
    bent = jnp.stack([n2[1:] * rest[0] - n1[1:] * rest[1], rest[2]]) * length
    heights = state.positions[out]
    spins = state.angular_momenta
    force, couple, tilt = _shares_of_effects(scene, state, n1, n2)
    shares = {
        "node positions": _largest(heights - heights[0]) / length,
        "velocities": _share(state.velocities[out], state.velocities),
        "the directions of elements": _largest(n3),
        "angular momenta": _share(jnp.stack([spins[a], spins[b]]), spins),
        "twist between elements": jnp.maximum(
            _largest(jnp.diff(n1)), _largest(jnp.diff(n2))
        ),
        "rest curvatures": _largest(bent),
        "rest strains": _largest(n1 * rod.rest_strains[0] + n2 * rod.rest_strains[1]),
        "bending stiffness": _share(oblique * (bend[0] - bend[1]), bend),
        "shear stiffness": _share(oblique * (shear[0] - shear[1]), shear),
        "forces of effects": force,
        "couples of effects": couple,
        "the surfaces of bodies": tilt,
    }
    return jnp.stack([shares[part] for part in _PARTS])


def _shares_of_effects(
    scene: Scene, state: RodState, n1: Array, n2: Array
) -> tuple[Array, Array, Array]:
    """What leaves the plane of forces, couples, and unit vectors of forces to come."""
    assert scene.plane is not None
    rod = scene.rod
    out = PLANES[scene.plane][2]
    stepper = PlanarStepper.create(scene, state, jnp.ones_like(rod.rest_lengths[0]))
    motion = stepper.in_space(stepper.enter(state))
    zero = jnp.zeros_like(rod.rest_lengths[0])
    force = force_outside = couple = couple_outside = tilt = zero
    for effect in scene.effects:
        loads = effect.loads(rod, motion)
        if loads.forces is not None:
            force = jnp.maximum(force, _largest(*loads.forces))
            force_outside = jnp.maximum(force_outside, _largest(loads.forces[out]))
        if loads.couples is not None:
            c1, c2, c3 = loads.couples
            couple = jnp.maximum(couple, _largest(c1, c2, c3))
            couple_outside = jnp.maximum(
                couple_outside, _largest(n2 * c1 - n1 * c2, c3)
            )
        directions = effect.directions(rod, motion)
        if directions is not None:
            tilt = jnp.maximum(tilt, _largest(directions[out]))
    # An element that is held feels couples from the rounding of its own angle.
    roundings = 16 * jnp.sqrt(jnp.finfo(zero.dtype).eps)
    bend = jnp.max(rod.bend_twist_stiffness)
    least_couple = roundings * bend / jnp.min(rod.rest_lengths)
    # Forces that could not bend the rod by a millionth of a radian count for nothing.
    least_force = 1e-6 * bend / jnp.sum(rod.rest_lengths) ** 2
    return (
        force_outside / jnp.maximum(force, least_force),
        couple_outside / jnp.maximum(couple, least_couple),
        tilt,
    )


def _largest(*components: Array) -> Array:
    return jnp.max(jnp.stack([jnp.max(jnp.abs(c)) for c in components]))


def _share(part: Array, whole: Array) -> Array:
    """The largest magnitude of a part, relative to that of the whole if not zero."""
    scale = _largest(whole)
    return _largest(part) / jnp.where(scale == 0, 1, scale)

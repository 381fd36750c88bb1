"""A scene: one rod, the effects that act on it, and the law it follows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod import vectors
from jaxrod._pytree import pytree, static
from jaxrod.effects import Effect
from jaxrod.elasticity import stored_energy
from jaxrod.motion import Loads, Motion, accumulate
from jaxrod.rod import Rod, RodState, angular_velocities
from jaxrod.vectors import Vec3

if TYPE_CHECKING:
    from jaxrod._implicit import Implicit

Mode = Literal["consistent", "pyelastica"]
MODES: tuple[Mode, ...] = ("consistent", "pyelastica")

Plane = Literal["xy", "yz", "zx"]
PLANES: dict[Plane, tuple[int, int, int]] = {
    "xy": (0, 1, 2),
    "yz": (1, 2, 0),
    "zx": (2, 0, 1),
}
"""The planes a scene can be reduced to: indices of their two axes and their normal."""


@pytree
class Scene:
    """What is simulated. Its structure is static, its numbers are traced.

    What is not in `effects` is not in the compiled program. Build one with
    `make_scene`; change numbers with `dataclasses.replace`.
    """

    rod: Rod
    """The rod's parameters."""
    effects: tuple[Effect, ...] = ()
    """What acts on the rod, in the order in which it is applied."""
    mode: Mode = static(default="consistent")
    """"consistent": loads from a stored energy, angular momentum as state, second
    order. "pyelastica": PyElastica 1.0's law and stepping order, to round-off."""
    plane: Plane | None = static(default=None)
    """The plane in which everything happens: a cheaper program, the same result."""
    implicit: Implicit | None = None
    """Settings of the implicit integrator; `None` for explicit steps."""
    twist: bool = static(default=True)
    """Whether elements turn about their axes; without, an element is a direction."""


def make_scene(
    rod: Rod,
    *effects: Effect,
    mode: Mode = "consistent",
    plane: Plane | None = None,
    implicit: Implicit | None = None,
    twist: bool = True,
) -> Scene:
    """Composes a scene from a rod and its effects.

    Floating-point numbers of effects and settings are converted to the rod's type.

    Args:
        rod: The rod.
        *effects: What acts on it.
        mode: "consistent" (default) or "pyelastica"; see `Scene`.
        plane: "xy", "yz" or "zx" if the rod and all that acts on it stay in a plane
            parallel to that one: several times cheaper, for the same result. The
            state is the same as in space. Consistent mode only.
        implicit: `jaxrod.implicit(...)` to step implicitly: any step size is stable.
            Consistent mode, in space, only.
        twist: `False` to leave twist out of a naturally straight rod with sections
            alike in all directions, under loads that do not twist it: half the
            arithmetic, for what the polar inertia changes. Couples about the axis
            that cannot be seen here (traced ones), and spin about it in a state, are
            dropped. Explicit steps in consistent mode, in space, only.

    Raises:
        ValueError: If the mode or the plane is unknown, the choices exclude each
            other, `twist` is `False` where the rod or an effect has to do with it,
            or an effect is not what implicit steps take it for.
        TypeError: If an effect is not an `Effect` or the rod is not a `Rod`.
    """
    if mode not in MODES:
        raise ValueError(f"mode must be one of {', '.join(MODES)}, got {mode!r}")
    if plane is not None:
        if plane not in PLANES:
            raise ValueError(f"plane must be one of {', '.join(PLANES)}, got {plane!r}")
        if mode != "consistent":
            raise ValueError(f"a plane needs mode='consistent', got mode={mode!r}")
    if implicit is not None:
        if mode != "consistent":
            raise ValueError(
                f"implicit steps need mode='consistent', got mode={mode!r}"
            )
        if plane is not None:
            raise ValueError(f"implicit steps are in space only, got plane={plane!r}")
    if not twist and (
        mode != "consistent" or plane is not None or implicit is not None
    ):
        raise ValueError(
            "twist=False needs mode='consistent', no plane and explicit steps, got "
            f"mode={mode!r}, plane={plane!r}, implicit={implicit!r}"
        )
    if not isinstance(rod, Rod):
        raise TypeError(
            f"rod must be a jaxrod.Rod, got {type(rod).__name__} "
            "(factories return the pair rod, state)"
        )
    for effect in effects:
        if not isinstance(effect, Effect):
            raise TypeError(
                f"effects must be jaxrod effects, got {type(effect).__name__}"
            )
    dtype = rod.rest_lengths.dtype

    def cast(leaf: Array) -> Array:
        leaf = jnp.asarray(leaf)
        return leaf.astype(dtype) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf

    listed = jax.tree.map(cast, tuple(effects))
    scene = Scene(rod, listed, mode, plane, jax.tree.map(cast, implicit), bool(twist))
    if not twist:
        # Imported when asked for: it builds on scenes.
        from jaxrod.untwisted_scenes import check_untwisted

        check_untwisted(scene)
    if implicit is not None:
        from jaxrod.effect_promises import check_promises

        check_promises(scene)
    return scene


def external_loads(scene: Scene, motion: Motion, forces: Vec3, couples: Vec3) -> Loads:
    """Adds the loads of all effects to given forces and couples."""
    for effect in scene.effects:
        loads = effect.loads(scene.rod, motion)
        forces = accumulate(forces, loads.forces)
        couples = accumulate(couples, loads.couples)
    return Loads(forces, couples)


def hold(scene: Scene, motion: Motion) -> Motion:
    """Applies all constraints on configuration."""
    for effect in scene.effects:
        motion = effect.hold(scene.rod, motion)
    return motion


def hold_rates(scene: Scene, motion: Motion) -> Motion:
    """Applies all constraints on rates."""
    for effect in scene.effects:
        motion = effect.hold_rates(scene.rod, motion)
    return motion


def damping_rates(scene: Scene) -> tuple[Array, Array] | None:
    """Total decay rates [1/s] of velocities and of spins; `None` without damping."""
    total: tuple[Array, Array] | None = None
    for effect in scene.effects:
        rates = effect.damping_rates(scene.rod)
        if rates is not None:
            if total is not None:
                rates = (total[0] + rates[0], total[1] + rates[1])
            total = rates
    return total


def kinetic_energy(rod: Rod, state: RodState) -> Float[Array, ""]:
    """Kinetic energy of translation and rotation [J]."""
    translation = 0.5 * jnp.sum(rod.node_masses[None, :] * state.velocities**2)
    spin = angular_velocities(rod, state)
    transverse, polar = rod.inertias
    inertia = jnp.stack([transverse, transverse, polar])
    return translation + 0.5 * jnp.sum(inertia * spin**2)


def potential_energy(scene: Scene, state: RodState) -> Float[Array, ""]:
    """Stored elastic energy plus the potential of all effects [J]."""
    total = stored_energy(scene.rod, state)
    for effect in scene.effects:
        total = total + effect.energy(scene.rod, state)
    return total


def total_energy(scene: Scene, state: RodState) -> Float[Array, ""]:
    """Kinetic plus potential energy [J]."""
    return kinetic_energy(scene.rod, state) + potential_energy(scene, state)


def momentum(rod: Rod, state: RodState) -> Float[Array, "3"]:
    """Linear momentum, world frame [kg m/s]."""
    return jnp.sum(rod.node_masses[None, :] * state.velocities, axis=1)


def angular_momentum(rod: Rod, state: RodState) -> Float[Array, "3"]:
    """Angular momentum about the origin, world frame [kg m^2/s]."""
    position = vectors.split(state.positions)
    velocity = vectors.split(state.velocities)
    orbital = vectors.join(vectors.cross(position, velocity))
    return jnp.sum(rod.node_masses[None, :] * orbital, axis=1) + jnp.sum(
        state.angular_momenta, axis=1
    )

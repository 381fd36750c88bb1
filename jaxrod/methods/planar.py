"""The method for motion in a plane, and checks of its requirements."""

from __future__ import annotations

import itertools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxrod.effects.base import Effect
from jaxrod.effects.own_classes import trial_motion
from jaxrod.effects.time import at_clock, clock_at
from jaxrod.loaded_rod import LoadedRod, Method, constrain, constrain_rates
from jaxrod.methods.consistent import Consistent
from jaxrod.methods.planar_laws import PlanarConsistentStepper, PlanarPyElasticaStepper
from jaxrod.methods.planar_verlet import PLANES, PlanarVerlet, PlaneName
from jaxrod.methods.pyelastica import PyElastica
from jaxrod.rods.motion import Loads, Motion, motion_of, state_of
from jaxrod.rods.rod import Rod, RodState
from jaxrod.structure import pytree, static

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
    "rotary inertia",
    "forces of effects",
    "couples of effects",
    "the surfaces of bodies",
)


@pytree
class Planar(Method):
    """Method for motion in a plane, with either elastic law; see `planar`."""

    steps_in_systems = True

    plane: PlaneName = static()
    """The plane of motion."""
    of: Consistent | PyElastica
    """The elastic law, given as its method in three dimensions."""

    @property
    def in_space(self) -> Consistent | PyElastica:
        """The law's method in three dimensions."""
        return self.of

    @property
    def has_energy(self) -> bool:
        """Whether loads of the law are the gradient of an energy."""
        return self.of.has_energy

    @property
    def normal_axis(self) -> int:
        """World axis along which rods do not move, 0 for x."""
        return PLANES[self.plane][2]

    @property
    def solves_damping(self) -> bool:
        """Whether the law's method integrates damping together with the loads."""
        return self.of.solves_damping

    @property
    def couples_masses(self) -> bool:
        """Whether the law's method takes mass matrices that are not lumped."""
        return self.of.couples_masses

    @property
    def solves_drag(self) -> bool:
        """Whether the law's method integrates drag together with the loads."""
        return self.of.solves_drag

    def stepper(self, scene: LoadedRod, state: RodState, dt: Array) -> PlanarVerlet:
        """Stepper in the plane for a scene, a first state and steps of `dt` [s]."""
        return self._stepper(scene, state, dt, seen=bool(scene.effects))

    def stepper_in_system(
        self, scene: LoadedRod, state: RodState, dt: Array
    ) -> PlanarVerlet:
        """Stepper in the plane of a rod that couplings may look at."""
        return self._stepper(scene, state, dt, seen=True)

    def _stepper(
        self, scene: LoadedRod, state: RodState, dt: Array, *, seen: bool
    ) -> PlanarVerlet:
        kind = (
            PlanarPyElasticaStepper
            if isinstance(self.of, PyElastica)
            else PlanarConsistentStepper
        )
        return kind.create(scene, self.plane, state, dt, seen=seen)

    def loads(self, scene: LoadedRod, motion: Motion) -> Loads:
        """All loads, computed by the law's method in three dimensions."""
        return self.of.loads(scene, motion)

    def check_evolving(self, scene: LoadedRod) -> None:
        """Raises ValueError if a moving support holds nodes along the normal."""
        for effect in scene.evolving_effects:
            if _places_across(effect, scene.rod, self.plane):
                axes = "".join(sorted(self.plane))
                raise ValueError(
                    f"a scene in the {self.plane} plane needs driven ends that are "
                    f"free along its normal, but {type(effect).__name__} holds all "
                    "axes: "
                    f'give it axes="{axes}"'
                )

    def check_state(self, scene: LoadedRod, state: RodState) -> None:
        """Raises ValueError if the rod or a load leaves the plane: `check_planar`."""
        check_planar(scene, self, state)


def planar(plane: PlaneName, law: Consistent | PyElastica | None = None) -> Planar:
    """Motion in a plane: several times cheaper, with the same result to round-off.

    The rod and all loads on it stay in a plane parallel to the named one. The state
    is the same as in space; zero components out of the plane stay exactly zero.

    Args:
        plane: "xy", "yz" or "zx".
        law: `consistent()` (default) or `pyelastica()`.

    Returns:
        The method, for `make_scene(..., method=...)`.

    Raises:
        ValueError: If the plane is unknown.
        TypeError: If the law is another method, which exists in space only.

    Example:
        >>> flat = jaxrod.make_scene(rod, *scene.effects, method=jaxrod.planar("zx"))
        >>> after = jaxrod.step(flat, state, 1e-4)
        >>> bool((after.positions[1] == 0).all()), bool(after.tip[2] < 0)
        (True, True)
    """
    if not isinstance(plane, str) or plane not in PLANES:
        raise ValueError(f"plane must be one of {', '.join(PLANES)}, got {plane!r}")
    law = Consistent() if law is None else law
    if not isinstance(law, Consistent | PyElastica):
        raise TypeError(
            "law must be consistent() or pyelastica(), the methods that have a planar "
            f"step, got {law!r}"
        )
    return Planar(plane, law)


def _places_across(effect: Effect, rod: Rod, plane: PlaneName) -> bool:
    """Whether an effect prescribes node positions along a plane's normal."""
    out = PLANES[plane][2]
    touched = []

    def look() -> None:
        motion = trial_motion(rod)
        now = at_clock(effect, clock_at(0.0, rod.rest_lengths.dtype))
        placed = now.constrain(rod, motion).position[out]
        touched.append(placed is not motion.position[out])

    jax.eval_shape(look)
    return touched[0]


def check_planar(scene: LoadedRod, method: Planar, state: RodState) -> None:
    """Checks that a rod is in the scene's plane and that nothing moves it out of it.

    Args:
        scene: The scene.
        method: The method, which has the plane.
        state: Its concrete state.

    Raises:
        ValueError: If positions, velocities, orientations, spins, rest shape or loads
            have components out of the plane, or if bending about the normal is not
            bending about one principal axis.
    """
    shares = np.asarray(_shares_outside(scene, method, state))
    tolerance = np.sqrt(np.finfo(shares.dtype).eps)
    for what, share in zip(_PARTS, shares, strict=True):
        if not share <= tolerance:
            raise ValueError(
                f"a scene in the {method.plane} plane needs {what} in that plane, got "
                f"{share:.2g} of their size out of it; leave out "
                f"planar({method.plane!r}) for a motion in space"
            )


# Compiled, because operation by operation it takes longer than thousands of steps.
@jax.jit
def _shares_outside(
    scene: LoadedRod, method: Planar, state: RodState
) -> Float[Array, " parts"]:
    """Largest out-of-plane fractions of state, rest shape and loads: `_PARTS` [1]."""
    out = PLANES[method.plane][2]
    rod = scene.rod
    frame = state.directors
    n1, n2 = frame[0, out], frame[1, out]
    oblique = n1 * n2
    length = jnp.sum(rod.rest_lengths)
    bend, shear = rod.bend_twist_stiffness, rod.shear_stretch_stiffness
    rest = rod.rest_curvatures
    bent = jnp.stack([n2[1:] * rest[0] - n1[1:] * rest[1], rest[2]]) * length
    given = motion_of(state)
    held = constrain_rates(scene, constrain(scene, given))
    motion = _shares_of_state(scene.rod, method, state)
    if held is not given:
        others = _shares_of_state(scene.rod, method, state_of(held))
        motion = jax.tree.map(jnp.maximum, motion, others)
    force, couple, tilt = _shares_of_effects(scene, method, state, n1, n2)
    shares = {
        **motion,
        "rest curvatures": _largest(bent),
        "rest strains": _largest(n1 * rod.rest_strains[0] + n2 * rod.rest_strains[1]),
        "bending stiffness": _share(oblique * (bend[0] - bend[1]), bend, 0),
        "shear stiffness": _share(oblique * (shear[0] - shear[1]), shear, 0),
        "rotary inertia": _oblique_inertia(rod, oblique),
        "forces of effects": force,
        "couples of effects": couple,
        "the surfaces of bodies": tilt,
    }
    return jnp.stack([shares[part] for part in _PARTS])


def _oblique_inertia(rod: Rod, oblique: Array) -> Array:
    """Largest coupling of rotation about the normal to others, n1 n2 (J1 - J2) / J [1].

    `oblique` is n1 n2, of the normal's components along d1 and d2.
    """
    if rod.is_round:
        return jnp.zeros_like(oblique[0])
    inertia = rod.principal_inertias
    return _share(oblique * (inertia[0] - inertia[1]), inertia, 0)


def _shares_of_state(rod: Rod, method: Planar, state: RodState) -> dict[str, Array]:
    """Largest out-of-plane fraction of positions, velocities and so on, by name."""
    a, b, out = PLANES[method.plane]
    n1, n2, n3 = (axis[out] for axis in state.directors)
    length = jnp.sum(rod.rest_lengths)
    heights = state.positions[out]
    spins = state.angular_momenta
    # Velocities below 1e-6 of the wave speed are round-off.
    wave_speed = jnp.sqrt(
        jnp.max(rod.shear_stretch_stiffness[2]) / jnp.min(rod.linear_density)
    )
    still = 1e-6 * wave_speed
    return {
        "node positions": _largest(heights - heights[0]) / length,
        "velocities": _share(state.velocities[out], state.velocities, still),
        "the directions of elements": _largest(n3),
        "angular momenta": _share(
            jnp.stack([spins[a], spins[b]]),
            spins,
            jnp.max(rod.inertias) * still / length,
        ),
        "twist between elements": jnp.maximum(
            _largest(jnp.diff(n1)), _largest(jnp.diff(n2))
        ),
    }


def _shares_of_effects(
    scene: LoadedRod, method: Planar, state: RodState, n1: Array, n2: Array
) -> tuple[Array, Array, Array]:
    """Largest out-of-plane fractions of forces, couples and force directions [1].

    The directions are those in which effects may push later. Loads are computed for the
    rod as it is and for a bent one. `n1` and `n2` are the components of the plane's
    normal along d1 and d2 of the elements.
    """
    rod = scene.rod
    out = PLANES[method.plane][2]
    stepper = method.stepper(scene, state, jnp.ones_like(rod.rest_lengths[0]))
    entered = stepper.enter(state)
    motion = stepper.view(entered)
    # Loads in the plane at rest may leave it when the rod bends in the plane.
    odd = 0.4 * jnp.cos(
        1.1 * jnp.arange(rod.n_elements, dtype=state.positions.dtype) + 0.3
    )
    bent = stepper.view(entered.turned(odd))
    zero = jnp.zeros_like(rod.rest_lengths[0])
    # The round-off of a held element's angle causes couples.
    roundings = 16 * jnp.sqrt(jnp.finfo(zero.dtype).eps)
    rounding = roundings * jnp.max(rod.bend_twist_stiffness) / jnp.min(rod.rest_lengths)
    force = couple = tilt = zero
    still = jnp.zeros_like(motion.position[0]), jnp.zeros_like(rod.rest_lengths)
    nothing = Loads(forces=(still[0],) * 3, couples=(still[1],) * 3)
    for effect, seen in itertools.product(scene.effects, (motion, bent)):
        # One effect at a time: a large load must not hide a small one.
        loads = effect.loads_after(rod, seen, nothing)
        if loads.forces is not None:
            share = _share(loads.forces[out], jnp.stack(loads.forces), 0)
            force = jnp.maximum(force, share)
        if loads.couples is not None:
            c1, c2, c3 = loads.couples
            outside = jnp.stack([n2 * c1 - n1 * c2, c3])
            share = _share(outside, jnp.stack(loads.couples), rounding)
            couple = jnp.maximum(couple, share)
    for effect in scene.effects:
        tilt = jnp.maximum(tilt, _tilt(effect, scene, motion, out))
    return force, couple, tilt


def _tilt(effect: Effect, scene: LoadedRod, motion: Motion, out: int) -> Array:
    """Largest out-of-plane component of an effect's possible force directions [1].

    Directions are computed for the rod displaced to 25 positions in the plane, because
    they may lie in the plane at one position only, as on an oblique cylinder. `out` is
    the index of the normal's axis.
    """
    rod = scene.rod
    length = jnp.sum(rod.rest_lengths)
    if effect.force_directions(rod, motion) is None:
        return jnp.zeros_like(length)
    a, b = (k for k in range(3) if k != out)
    # Irregular numbers, which are unlikely to hit the middle of a body.
    turns = 0.07 + jnp.arange(8) * (jnp.pi / 4)
    reaches = jnp.repeat(jnp.asarray([0.097, 0.31, 1.03]), 8) * length
    steps_a = jnp.append(reaches * jnp.tile(jnp.cos(turns), 3), 0)
    steps_b = jnp.append(reaches * jnp.tile(jnp.sin(turns), 3), 0)

    def seen_from(step_a: Array, step_b: Array) -> Array:
        place = list(motion.position)
        place[a], place[b] = place[a] + step_a, place[b] + step_b
        moved = replace(motion, position=(place[0], place[1], place[2]))
        directions = effect.force_directions(rod, moved)
        assert directions is not None
        return _largest(directions[out])

    kind = length.dtype
    return jnp.max(jax.vmap(seen_from)(steps_a.astype(kind), steps_b.astype(kind)))


def _largest(values: Array) -> Array:
    return jnp.max(jnp.abs(values))


def _share(part: Array, whole: Array, least: ArrayLike) -> Array:
    """Ratio of the largest magnitude in `part` to that in `whole` [1].

    Args:
        part: Components that should be zero.
        whole: All components.
        least: Smallest denominator.
    """
    scale = jnp.maximum(_largest(whole), least)
    return _largest(part) / jnp.where(scale == 0, 1, scale)

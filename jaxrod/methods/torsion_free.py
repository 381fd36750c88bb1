r"""The method without twist: an element is a direction, not a frame.

In a naturally straight rod with isotropic sections, under loads that do not twist it,
twist is a fast motion without consequence: only the small polar inertia drives it.
Without it, an element is a unit vector $d$ with an angular momentum $P$ perpendicular
to it. With edge $\Delta x$, rest length $\hat\ell$ and $\theta$ the angle between
neighbours,

$$W = \tfrac12 \sum \hat\ell\,
    [S_1 |\Delta x/\hat\ell - a d|^2 + S_3 (a - 1)^2]
    + \tfrac12 \sum B_1\, \theta^2/\hat D, \qquad a = d\cdot\Delta x/\hat\ell,$$

which is the minimum of the consistent law over all twists. Between kicks elements turn
along great circles, at $\dot d = P/J_1 \times d$; couples are world vectors. The method
is symplectic, of second order, and conserves momentum and angular momentum. It is the
limit of `jaxrod.methods.consistent` for vanishing polar inertia.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from jaxrod.effects.base import Effect
from jaxrod.effects.directions import (
    angle_over_sine,
    frame_along,
    transported,
    turned_to,
)
from jaxrod.effects.ends import End, Wall, at_end
from jaxrod.effects.own_classes import trial_motion
from jaxrod.effects.time import at_largest
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import (
    Quaternion,
    directors,
    multiply_quaternions,
    sine_ratio_and_cosine,
    split_quaternion,
    to_material,
)
from jaxrod.geometry.vectors import Vec3
from jaxrod.loaded_rod import (
    LoadedRod,
    MassCoupling,
    Method,
    constrain,
    constrain_rates,
    damping_rates,
    dissipate,
    dissipates,
)
from jaxrod.methods.consistent import Consistent
from jaxrod.methods.drag_kick import drag_kick, without_drag
from jaxrod.methods.verlet import Kick, Verlet
from jaxrod.rods.motion import Loads, Motion, motion_of, state_of
from jaxrod.rods.rod import Rod, RodState
from jaxrod.structure import pytree, static
from jaxrod.validation import is_traced


def wall_of(scene: LoadedRod) -> Wall | None:
    """The wall that holds the orientation at an end of the rod, if there is one."""
    for effect in scene.effects:
        wall = effect.wall(scene.rod)
        if wall is not None:
            return wall
    return None


def has_elastic_wall(effect: Effect, rod: Rod) -> bool:
    """Whether an effect is an elastic joint between a wall and an end of the rod."""
    wall = effect.wall(rod)
    return wall is not None and wall.stiffness is not None


def check_structure(scene: LoadedRod) -> None:
    """Checks the kinds of effects: none may twist the rod. Scenes may be traced.

    Raises:
        ValueError: If an effect twists, holds elements without a `wall`, or if there
            is more than one wall.
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
    """Checks that no wall that holds an orientation depends on time or has memory.

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

    False for batches of rods: each of their rods is checked when it steps.
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

    # Shapes alone: this is asked at each call of `advance`, whose numbers play no part.
    dtype = rod.rest_lengths.dtype
    node: Any = (jax.ShapeDtypeStruct((rod.n_elements + 1,), dtype),) * 3
    element: Any = (jax.ShapeDtypeStruct((rod.n_elements,), dtype),) * 3
    orientation = (*element, element[0])
    jax.eval_shape(look, Motion(node, orientation, node, element))
    return touched[0]


def check_torsion_free(scene: LoadedRod) -> None:
    """Checks that nothing but its own inertia could twist the rod of a scene.

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
        f"torsion_free() needs {demand}, got {found}; other methods do not need this"
    )


@jax.jit
def _twisting_shares(rod: Rod, effects: tuple[Effect, ...]) -> Array:
    """Fractions of each effect's loads that turn with the elements and that twist them.

    Both are computed on a generic rod, before and after its elements are rotated about
    their axes. They are zero for elastic walls, which are known not to twist. Shape
    (effects, 2).
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
            first = _couples_across(before.orientation, one.couples)
            gap = _gap(first, _couples_across(after.orientation, other.couples))
            turning = jnp.maximum(turning, gap)
            about_axis = _share(jnp.abs(one.couples[2]), one.couples)
        return jnp.stack([turning, about_axis])

    return jnp.stack([of(effect) for effect in effects])


def _couples_across(orientation: Quaternion, couples: Vec3) -> Vec3:
    """World components of couples given in material frames, without those about d3."""
    d1, d2, _ = directors(orientation)
    return vectors.add(vectors.scale(couples[0], d1), vectors.scale(couples[1], d2))


def _gap(one: Vec3, other: Vec3) -> Array:
    """Largest change of a component from `one` to `other`, relative to `one` [1]."""
    x, y, z = vectors.subtract(one, other)
    return _share(jnp.maximum(jnp.maximum(jnp.abs(x), jnp.abs(y)), jnp.abs(z)), one)


def _share(part: Array, whole: Vec3) -> Array:
    """Largest entry of `part` over the largest magnitude of a component of `whole` [1].

    `part` is not negative. The result is max(`part`) if `whole` is zero.
    """
    size = jnp.max(jnp.abs(vectors.join(whole)))
    return jnp.max(part) / jnp.where(size > 0, size, 1)


@pytree
class TorsionFreeMotion:
    """A rod without twist, as used inside a step."""

    position: Vec3
    """Node positions, world frame [m]."""
    direction: Vec3
    """Unit vectors d3 of the elements, world frame."""
    velocity: Vec3
    """Node velocities, world frame [m/s]."""
    spin: Vec3
    """Angular momentum of the elements, perpendicular to d3 [kg m^2/s]."""
    remainder: Vec3 | None = None
    """Accumulated round-off of the positions (Kahan) [m]; `None` without
    compensation."""

    @property
    def view(self) -> Motion:
        """Motion in the form that effects take, with untwisted frames.

        The compiler drops fields that no effect reads.
        """
        return Motion(
            position=self.position,
            orientation=frame_along(self.direction),
            velocity=self.velocity,
            spin=self.spin,
            remainder=self.remainder,
        )


@pytree
class TorsionFreeStepper(Verlet):
    """Constants of the step without twist, for one scene and one step size."""

    start: RodState
    """State at the start of the run. Without a wall, d1 and d2 continue from its first
    element."""
    inverse_lengths: Array
    """Inverse rest lengths of the elements [1/m]."""
    stiffness: tuple[Array, Array]
    """Shear and axial stiffness [N]."""
    rest_stretch: Array
    """Unstressed over reference length of an element, 1 + axial rest strain [1]."""
    joint: Array
    """Bending stiffness over joint length, including wall joints [N m]."""
    inverse_inertia: Array
    """Inverse transverse rotary inertia [1/(kg m^2)]."""
    velocity_kick: Kick
    spin_kick: Kick
    mass_coupling: MassCoupling | None
    """Coupling of the nodes by a mass matrix that is not lumped."""
    walls: tuple[Vec3 | None, Vec3 | None]
    """Directions d3 of the elastic walls at the rod's base and tip; `None` without such
    a wall."""
    root: End = static(default="base")
    """End from which frames are carried along the rod without twist."""

    @staticmethod
    def create(scene: LoadedRod, state: RodState, dt: Array) -> TorsionFreeStepper:
        """Computes the constants for a scene, a first state and a step `dt` [s]."""
        check_structure(scene)
        rod = scene.rod
        shear, _, axial = vectors.split(rod.shear_stretch_stiffness)
        transverse, _ = rod.inertias
        rates = damping_rates(scene) or (None, None)
        wall = wall_of(scene)
        joint = rod.joint_stiffness[0] / rod.joint_lengths
        walls: list[Vec3 | None] = [None, None]
        if wall is not None and wall.stiffness is not None:
            part = 0 if wall.end == "base" else 1
            walls[part] = directors(split_quaternion(wall.orientation))[2]
            joints = [joint, joint]
            joints[part] = wall.stiffness[:1]
            joint = jnp.concatenate(joints)
        return TorsionFreeStepper(
            scene=scene,
            dt=dt,
            start=state,
            inverse_lengths=1 / rod.rest_lengths,
            stiffness=(shear, axial),
            rest_stretch=1 + rod.rest_strains[2],
            joint=joint,
            inverse_inertia=1 / transverse,
            velocity_kick=Kick.create(1 / rod.node_masses, rates[0], dt),
            spin_kick=Kick.create(None, rates[1], dt),
            mass_coupling=MassCoupling.of(rod),
            walls=(walls[0], walls[1]),
            root="base" if wall is None else wall.end,
        )

    def enter(self, state: RodState) -> TorsionFreeMotion:
        """Unpacks a state; only d3 is kept, and the spin perpendicular to it."""
        motion = constrain_rates(self.scene, constrain(self.scene, motion_of(state)))
        direction = directors(motion.orientation)[2]
        return TorsionFreeMotion(
            position=motion.position,
            direction=direction,
            velocity=motion.velocity,
            spin=_across(motion.spin, direction),
            remainder=motion.remainder,
        )

    def leave(self, motion: TorsionFreeMotion) -> RodState:
        """Packs a motion into a state, with frames that are not twisted."""
        direction = motion.direction
        wall = wall_of(self.scene)
        if wall is None:
            root = at_end(split_quaternion(self.start.orientations), self.root)
        else:
            root = split_quaternion(wall.orientation)
        index = 0 if self.root == "base" else -1
        x, y, z = direction
        root = turned_to(root, (x[index], y[index], z[index]))
        orientation = transported(root, direction, self.root)
        spin = _across(motion.spin, direction)
        return state_of(replace(motion.view, orientation=orientation, spin=spin))

    def drift(self, motion: TorsionFreeMotion, dt: Array) -> TorsionFreeMotion:
        """Moves nodes and rotates elements freely for a time `dt` [s]."""
        d = motion.direction
        turn = vectors.scale(dt * self.inverse_inertia, motion.spin)
        sine_ratio, cosine = sine_ratio_and_cosine(vectors.dot(turn, turn))
        turned = vectors.add(
            vectors.scale(cosine, d), vectors.scale(sine_ratio, vectors.cross(turn, d))
        )
        # One step of Newton's method towards unit length.
        length = 1.5 - 0.5 * vectors.dot(turned, turned)
        nodes = motion.view.moved(dt)
        return self.constrain(
            replace(
                motion,
                position=nodes.position,
                direction=vectors.scale(length, turned),
                remainder=nodes.remainder,
            )
        )

    def view(self, motion: TorsionFreeMotion) -> Motion:
        """Motion in the form that effects take, with untwisted frames."""
        return motion.view

    def kick(
        self, motion: TorsionFreeMotion, others: Loads | None = None
    ) -> TorsionFreeMotion:
        """Changes velocities and angular momenta by all loads over one step.

        `others` are loads from outside the scene, if any.
        """
        d = motion.direction
        edges = motion.view.edges
        shear, axial = self.stiffness
        along = vectors.dot(d, edges) * self.inverse_lengths
        # Shear stiffness times the whole edge, plus the difference along the element.
        excess = axial * (along - self.rest_stretch) - shear * along
        whole = vectors.scale(shear * self.inverse_lengths, edges)
        forces = vectors.difference(vectors.add(whole, vectors.scale(excess, d)))
        couples = vectors.add(
            vectors.scale(excess, vectors.cross(edges, d)), self.bending_couples(d)
        )
        dry = replace(self, scene=without_drag(self.scene))
        forces, couples = dry.add_loads(motion, forces, couples, others)
        if self.mass_coupling is not None:
            forces = self.mass_coupling.forces(self.scene, motion.view, forces)
        rates = drag_kick(self.scene, motion.view, forces, couples, self.dt)
        if rates is None:
            rates = (
                vectors.apply(self.velocity_kick, motion.velocity, forces),
                vectors.apply(self.spin_kick, motion.spin, couples),
            )
        kicked = replace(motion, velocity=rates[0], spin=rates[1])
        return self.constrain_rates(self.dissipate(kicked))

    def dissipate(self, motion: TorsionFreeMotion) -> TorsionFreeMotion:
        """Applies the hook `dissipate` of all effects, for one step."""
        if not dissipates(self.scene):
            return motion
        slowed = dissipate(self.scene, motion.view, self.dt)
        spin = _across(slowed.spin, motion.direction)
        return replace(motion, velocity=slowed.velocity, spin=spin)

    def constrain_rates(self, motion: TorsionFreeMotion) -> TorsionFreeMotion:
        """Applies the constraints of all effects on velocities and spins."""
        held = constrain_rates(self.scene, motion.view)
        return replace(motion, velocity=held.velocity, spin=held.spin)

    def bending_couples(self, direction: Vec3) -> Vec3:
        """Couples of the joints on the elements, world frame [N m].

        A joint of stiffness k between directions a and b has the couple k angle (a x b)
        / sin(angle).
        """
        start, finish = (int(wall is not None) for wall in self.walls)

        def ends(c: Array, k: int) -> tuple[Array, Array]:
            """Component `k` of the directions before and after every joint.

            `c` is that component of the elements' directions; directions of walls are
            added.
            """
            for wall, where in zip(self.walls, ((1, 0, 0), (0, 1, 0)), strict=True):
                if wall is not None:
                    c = lax.pad(c, wall[k], [where])
            return c[:-1], c[1:]

        x, y, z = (ends(c, k) for k, c in enumerate(direction))
        before, after = (x[0], y[0], z[0]), (x[1], y[1], z[1])
        factor = self.joint * angle_over_sine(before, after)
        moment = vectors.scale(factor, vectors.cross(before, after))

        def on_elements(m: Array) -> Array:
            following = vectors.pad(m, -start, 1 - finish)
            return following - vectors.pad(m, 1 - start, -finish)

        return on_elements(moment[0]), on_elements(moment[1]), on_elements(moment[2])

    def add_loads(
        self,
        motion: TorsionFreeMotion,
        forces: Vec3,
        couples: Vec3,
        others: Loads | None,
    ) -> tuple[Vec3, Vec3]:
        """Adds all loads to the given forces and couples, world frame.

        They are those of effects, and `others` from outside the scene. Couples about d3
        are ignored. Elastic walls are left out, because `bending_couples` includes
        them.
        """
        in_space = motion.view
        frame = directors(in_space.orientation)

        def added(forces: Vec3, couples: Vec3, loads: Loads) -> tuple[Vec3, Vec3]:
            if loads.forces is not None:
                forces = vectors.add(forces, loads.forces)
            if loads.couples is not None:
                d1, d2, _ = frame
                first, second, _ = loads.couples
                couples = vectors.add(couples, vectors.scale(first, d1))
                couples = vectors.add(couples, vectors.scale(second, d2))
            return forces, couples

        if others is not None:
            forces, couples = added(forces, couples, others)
        for effect in self.scene.effects:
            if has_elastic_wall(effect, self.scene.rod):
                continue
            before = Loads(forces, to_material(frame, couples))
            loads = effect.loads_after(self.scene.rod, in_space, before)
            forces, couples = added(forces, couples, loads)
        return forces, couples

    def constrain(self, motion: TorsionFreeMotion) -> TorsionFreeMotion:
        """Applies the constraints of all effects on positions and orientations."""
        free = motion.view
        held = constrain(self.scene, free)
        if held is free:
            return motion
        direction = motion.direction
        if held.orientation is not free.orientation:
            direction = directors(held.orientation)[2]
        return replace(
            motion,
            position=held.position,
            direction=direction,
            remainder=held.remainder,
        )


def _across(vector: Vec3, direction: Vec3) -> Vec3:
    """Component of a vector perpendicular to a direction."""
    along = vectors.dot(vector, direction)
    return vectors.subtract(vector, vectors.scale(along, direction))


@pytree
class TorsionFree(Method):
    """The consistent law without twist; see `torsion_free`."""

    twist: ClassVar[bool] = False
    steps_in_systems = True

    @property
    def couples_masses(self) -> bool:
        """True: forces are passed on along elements before the kick."""
        return True

    @property
    def solves_drag(self) -> bool:
        """True: drag is solved together with the loads of every kick."""
        return True

    def stepper(
        self, scene: LoadedRod, state: RodState, dt: Array
    ) -> TorsionFreeStepper:
        """Stepper for a scene, a first state and steps of `dt` [s]."""
        return TorsionFreeStepper.create(scene, state, dt)

    @property
    def in_space(self) -> Consistent:
        """The consistent law, of which this is another method."""
        return Consistent()

    def check(self, scene: LoadedRod) -> None:
        """Raises ValueError if the rod or an effect needs twist."""
        check_torsion_free(scene)

    def check_evolving(self, scene: LoadedRod) -> None:
        """Raises ValueError if a wall that holds an orientation changes with time."""
        check_walls_stand(scene)

    def check_state(self, scene: LoadedRod, state: RodState) -> None:
        """Repeats `check`, because a scene may have changed since it was made."""
        check_torsion_free(scene)


def torsion_free() -> TorsionFree:
    """Method without twist, with half the arithmetic; it neglects polar inertia.

    For a naturally straight rod with isotropic sections, under loads that do not twist
    it. Couples about the axis whose values are not known on the host (traced ones) and
    spin about the axis in a state are dropped.

    The directions d1 and d2 have no meaning here. If no wall holds an end, every call
    turns those of the first element by the smallest rotation that follows its d3. So
    they depend on how a run is divided into calls and records.

    Returns:
        The method, for `make_scene(..., method=...)`.

    Example:
        >>> method = jaxrod.torsion_free()
        >>> untwisted = jaxrod.make_scene(rod, *scene.effects, method=method)
        >>> untwisted.method.twist, scene.method.twist
        (False, True)
        >>> twisting = jaxrod.end_load(couple=(0.1, 0.0, 0.0))  # about the rod's axis
        >>> jaxrod.make_scene(rod, twisting, method=method)
        Traceback (most recent call last):
            ...
        ValueError: torsion_free() needs loads without couples about d3, got EndLoad ...
    """
    return TorsionFree()

r"""The implicit method: steps as large as the motion allows, however stiff the rod.

It has two stages of a singly diagonally implicit Runge-Kutta method of second order,
with coefficient $\gamma$, at $\gamma h$ and $(1 - \gamma) h$, with equal weights. Each
stage is a backward Euler step of $\gamma h$ from its own base: the balance of loads of
`jaxrod.statics.residual`, solved by Newton's method on block-tridiagonal systems.
Rotations are composed as rotations, so the method works on the rotation group itself.

The method is stable at any step size, for nonlinear motion too (it is algebraically
stable for $\gamma \ge 1/4$). An infinitely stiff mode loses the factor

$$\rho = \frac{1/2 - 2\gamma + \gamma^2}{\gamma^2}$$

of its amplitude per step: the spectral radius, chosen between 0 and 1. With
$\rho = 1$ it is two implicit midpoint half steps, symmetric in time: no numerical
damping at all, and angular momentum conserved to the tolerance of the solver.

In a system, couplings act in the middle of a step. There the rod is seen where its
rates have carried it from the beginning of the step, at $x_n + \frac h2 v_n$. The
loads of couplings on that configuration are constant in the implicit step of the rod,
which ends at $x_{n+1}, v_{n+1}$. So the rod's own stiffness does not limit the step,
while that of couplings does, as in position Verlet. The step remains of second order.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Float, Int

from jaxrod.effects.base import Effect
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import (
    directors,
    multiply_quaternions,
    normalise,
    rotation_exp,
    to_material,
    to_world,
)
from jaxrod.geometry.vectors import Vec3
from jaxrod.lanes.steps import by_kernel
from jaxrod.loaded_rod import (
    LoadedRod,
    Method,
    Now,
    constrain,
    constrain_rates,
    damping_rates,
    dissipate,
    memory_in,
    remembering,
    scene_at,
)
from jaxrod.methods.consistent import Consistent
from jaxrod.rods.elasticity import ElasticLaw, elastic_law
from jaxrod.rods.motion import Loads, Motion, motion_of, state_of
from jaxrod.rods.rod import Rod, RodState
from jaxrod.statics.declared_properties import check_declared_properties
from jaxrod.statics.degrees_of_freedom import free_position_mask, stack_dofs
from jaxrod.statics.newton import default_tolerance, newton
from jaxrod.statics.residual import (
    Increment,
    LoadBalance,
    displaced,
    implicit_solution,
)
from jaxrod.structure import pytree, static
from jaxrod.validation import Numbers, as_array, check_count


@pytree
class Implicit(Method):
    """Implicit steps and their settings; see `implicit`."""

    explicit: ClassVar[bool] = False
    steps_in_systems = True

    spectral_radius: Float[Array, ""]
    """Fraction of an infinitely stiff motion left after a step [1]."""
    tolerance: Float[Array, ""] | None = None
    """Newton's method ends after a correction below this many element lengths and
    radians [1]; the remaining error is about its square. `None`: set by precision."""
    max_iterations: int = static(default=20)
    """Largest number of corrections per stage. A step that needs more gives NaN."""

    @property
    def in_space(self) -> Consistent:
        """The consistent law, of which this is another method."""
        return Consistent()

    def check(self, scene: LoadedRod) -> None:
        """Raises ValueError if an effect's declared `reach` or tangent proves wrong."""
        check_declared_properties(scene)

    def stepper(self, scene: LoadedRod, state: RodState, dt: Array) -> ImplicitStepper:
        """Stepper with the constants for a scene and a step size `dt` [s]."""
        return ImplicitStepper.create(scene, self, dt)

    def stepper_in_system(
        self, scene: LoadedRod, state: RodState, dt: Array
    ) -> PartitionedStepper:
        """Stepper of a member of a system, for steps of `dt` [s]."""
        return PartitionedStepper.create(self.stepper(scene, state, dt))


def implicit(
    spectral_radius: Numbers = 0.5,
    *,
    tolerance: Numbers | None = None,
    max_iterations: int = 20,
) -> Implicit:
    """Steps implicitly: any step size is stable; only accuracy limits it.

    For stiff or slender rods whose relevant motion is slow. A step costs about as much
    as a hundred explicit ones. It pays off if the stable step is about a thousand times
    shorter than the motion requires. A step that does not converge yields NaN, which
    `jaxrod.health` reports.

    Args:
        spectral_radius: Fraction of an infinitely stiff motion that numerical damping
            leaves after one step, from 0 (nothing) to 1 (everything: no damping). Slow
            motion is followed to second order with any value.
        tolerance: Newton's method ends after a correction below this many element
            lengths and radians; by default 1e-7, or 3e-4 in single precision.
        max_iterations: Corrections allowed per stage.

    Returns:
        The method, for `make_scene(..., method=...)`.

    Raises:
        ValueError: If an argument is out of range.

    Example:
        >>> slow = jaxrod.make_scene(rod, jaxrod.clamp(state), method=jaxrod.implicit())
        >>> slow.method.explicit, scene.method.explicit
        (False, True)
    """
    radius = as_array(
        "spectral_radius", spectral_radius, "", non_negative=True, at_most=1
    )
    bound = None
    if tolerance is not None:
        bound = as_array("tolerance", tolerance, "", positive=True)
    return Implicit(
        spectral_radius=radius,
        tolerance=bound,
        max_iterations=check_count("max_iterations", max_iterations, 1),
    )


@pytree
class Base:
    """Start of an implicit stage: a configuration, and rates that inertia maintains."""

    motion: Motion
    rates: tuple[Vec3, Vec3]
    """Velocities and angular velocities for the stage's initial guess, world frame."""


@pytree
class Increments:
    """Changes of configuration and rates in a stage, from its base."""

    displacement: Vec3
    turn: Vec3
    velocity: Vec3
    spin: Vec3


@pytree
class ImplicitStepper:
    """Constants of the implicit step for one scene and one step size."""

    steps_of_end: ClassVar[int] = 0
    iterates: ClassVar[bool] = True
    scene: LoadedRod
    settings: Implicit
    law: ElasticLaw
    coefficient: Float[Array, ""]
    """Coefficient gamma of the Runge-Kutta method [1]."""
    duration: Float[Array, ""]
    """Duration of a stage, gamma dt [s]."""
    dt: Float[Array, ""]
    """Step size [s]."""
    damping: tuple[Array, Array] | None

    @staticmethod
    def create(scene: LoadedRod, settings: Implicit, dt: Array) -> ImplicitStepper:
        """Computes the constants for a scene and a step size `dt` [s]."""
        coefficient = 0.5 / (1 + jnp.sqrt(0.5 * (1 + settings.spectral_radius)))
        return ImplicitStepper(
            scene=scene,
            settings=settings,
            law=elastic_law(scene.rod),
            coefficient=coefficient,
            duration=coefficient * dt,
            dt=dt,
            damping=damping_rates(scene),
        )

    def begin(self, state: RodState) -> Motion:
        """Unpacks a state and makes it satisfy the scene's constraints."""
        return constrain_rates(self.scene, constrain(self.scene, motion_of(state)))

    def end(self, motion: Motion) -> RodState:
        """Packs a motion into a state."""
        return state_of(motion)

    def cycle(self, motion: Motion) -> Motion:
        """Motion after one step of two stages."""
        added = self.increments(motion)
        ended: Motion = by_kernel(self, "ended", (motion, added))
        return ended

    def stepped(self, motion: Motion) -> Motion:
        """Motion after one step, before constraints and separate damping."""
        return self.summed(motion, self.increments(motion))

    def increments(self, motion: Motion) -> Increments:
        """Increments of the two stages of a step, along a leading axis."""
        # Stage 2 starts at h (1 - 2 gamma) k1, here in units of stage 1's increment.
        second = 1 / self.coefficient - 2

        def stage(base: Base, _: None) -> tuple[Base, Increments]:
            added = self.stage(base)
            return by_kernel(self, "base_after", (motion, added, second)), added

        first = Base(motion, self.rates(motion))
        _, added = lax.scan(stage, first, length=2)
        return added

    def evolving(self, scene: LoadedRod, first: Array) -> EvolvingImplicit:
        """Stepper for a scene with schedules or memory, from step number `first` on."""
        return EvolvingImplicit(self, scene, first)

    def summed(self, motion: Motion, added: Increments) -> Motion:
        """Motion at the end of a step, from the increments of its two stages.

        `added` has the increments of both stages along its leading axis.
        """
        share = 0.5 / self.coefficient
        one, two = (jax.tree.map(lambda a, i=i: share * a[i], added) for i in (0, 1))
        return _add(_add(motion, one), two)

    def slowed(self, motion: Motion) -> Motion:
        """Motion after separate damping for one step, and constraints on rates."""
        return constrain_rates(self.scene, dissipate(self.scene, motion, self.dt))

    def rates(self, motion: Motion) -> tuple[Vec3, Vec3]:
        """Velocities [m/s] and angular velocities [rad/s] of a motion, world frame."""
        one, two, three = self.scene.rod.principal_inertias
        frame = directors(motion.orientation)
        a, b, c = to_material(frame, motion.spin)
        spin = to_world(frame, (a / one, b / two, c / three))
        return motion.velocity, spin

    # Methods for kernels: each takes one argument.

    def ended(self, given: tuple[Motion, Increments]) -> Motion:
        """Motion at the end of a step, from the motion before and the increments."""
        return self.slowed(constrain(self.scene, self.summed(*given)))

    def base_after(self, given: tuple[Motion, Increments, Array]) -> Base:
        """Base of the second stage, see `second_base`."""
        return self.second_base(*given)

    def guess(self, base: Base) -> Float[Array, "n+1 6"]:
        """Initial guess of a stage's step from its base, zero for held nodes."""
        guess = self.duration * stack_dofs(*base.rates)
        placed = free_position_mask(self.scene, base.motion)
        return guess if placed is None else guess * stack_dofs(*placed)

    def reached(self, given: tuple[LoadBalance, Increment]) -> Increments:
        """Changes of configuration and rates by an increment, for a balance."""
        balance, increment = given
        reached, base = balance.motion(increment), balance.base
        return Increments(
            displacement=increment.displacement,
            turn=increment.turn,
            velocity=vectors.subtract(reached.velocity, base.velocity),
            spin=vectors.subtract(reached.spin, base.spin),
        )

    def second_base(self, motion: Motion, added: Increments, factor: Array) -> Base:
        """Base of the second stage: `motion` plus `factor` times increments `added`.

        These are the increments of the first stage. The guessed rates are those at its
        end.
        """
        base = _add(motion, jax.tree.map(lambda a: factor * a, added))
        moved = _add(motion, added)
        rates = self.rates(moved)
        return Base(base, rates)

    def stage(self, base: Base) -> Increments:
        """Increments of a backward Euler step of the size gamma `dt`, from a base.

        They are NaN where Newton's method does not converge.
        """
        balance = LoadBalance(
            self.scene, self.law, base.motion, 1 / self.duration, self.damping
        )
        guess = by_kernel(self, "guess", base)
        tolerance = self.settings.tolerance
        if tolerance is None:
            tolerance = jnp.asarray(default_tolerance(guess.dtype), guess.dtype)
        found = newton(
            *lax.stop_gradient((balance, guess, tolerance)),
            self.settings.max_iterations,
        )
        # Components with a prescribed rate get the derivative of that rate.
        held = by_kernel(balance, "with_held_components", (guess, found.increment))
        increment = implicit_solution(balance, held)
        # Failure is data: not finite, for health to find.
        increment = jax.tree.map(
            lambda a: jnp.where(found.converged, a, jnp.nan), increment
        )
        added: Increments = by_kernel(self, "reached", (balance, increment))
        return added


@pytree
class EvolvingImplicit:
    """Implicit steps of a scene that depends on time or has memory.

    Each stage has the loads and the positions of driven supports at its own time.
    """

    steps_of_end: ClassVar[int] = 0
    iterates: ClassVar[bool] = True
    implicit: ImplicitStepper
    """Stepper of the scene in its initial form, whose `scene` is replaced in each
    stage."""
    scene: LoadedRod
    """The scene with its schedules."""
    first: Int[Array, ""]
    """Number of the first step, counted from time zero."""

    def begin(self, state: RodState) -> tuple[Motion, Now]:
        """Motion that satisfies all constraints, with step number and memory."""
        now = Now(self.first, memory_in(self.scene, state))
        return self._at(now, 0.0).begin(state), now

    def cycle(self, carry: tuple[Motion, Now]) -> tuple[Motion, Now]:
        """Motion, step number and memory (`carry`) after one step of two stages."""
        motion, now = carry
        coefficient = self.implicit.coefficient
        second = 1 / coefficient - 2

        def stage(base: Base, fraction: Array) -> tuple[Base, Increments]:
            present = self._at(now, fraction)
            placed = constrain(present.scene, base.motion)
            placed = constrain_rates(present.scene, placed)
            added = present.stage(replace(base, motion=placed))
            return present.second_base(motion, added, second), added

        first = Base(motion, self.implicit.rates(motion))
        fractions = jnp.stack([coefficient, 1 - coefficient])
        _, added = lax.scan(stage, first, fractions)
        last = self._at(now, 1.0)
        after = last.slowed(constrain(last.scene, last.summed(motion, added)))
        middle = _add(
            motion, jax.tree.map(lambda a: 0.25 / coefficient * (a[0] + a[1]), added)
        )
        halfway = self._at(now, 0.5).scene
        return after, remembering(halfway, middle, self.implicit.dt, now)

    def end(self, carry: tuple[Motion, Now]) -> RodState:
        """Packs a motion and the memory of effects into a state."""
        motion, now = carry
        state = state_of(motion)
        return replace(state, memory=now.memory) if any(now.memory) else state

    def _at(self, now: Now, fraction: ArrayLike) -> ImplicitStepper:
        """Stepper whose scene is at the time `(now.step + fraction) * dt`."""
        scene = scene_at(self.scene, now, fraction, self.implicit.dt)
        return replace(self.implicit, scene=scene)


@pytree
class OutsideLoads(Effect):
    """Forces and couples of couplings, constant in the world frame for a step."""

    reach = "neighbours"
    forces: Vec3
    """Forces on the nodes, world frame [N]."""
    couples: Vec3
    """Couples on the elements, world frame [N m]."""

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """The forces, and the couples in the material frames."""
        frame = directors(motion.orientation)
        return Loads(self.forces, to_material(frame, self.couples))

    def turning_tangent(self, rod: Rod, motion: Motion) -> None:
        """None: the couples are constant in the world frame."""


@pytree
class Ahead:
    """A rod at the end of an implicit step, seen at another time."""

    motion: Motion
    """Motion at the end of the last step."""
    lead: Array
    """Time at which the rod is seen, after the end of the last step [s]."""


@pytree
class PartitionedStepper:
    """Implicit steps of a scene whose couplings act in the middle of a step."""

    scene: LoadedRod
    """Scene that is stepped."""
    implicit: ImplicitStepper
    """Stepper of the scene, whose `scene` is replaced in every step."""
    dt: Array
    """Step size [s]."""

    @staticmethod
    def create(implicit: ImplicitStepper) -> PartitionedStepper:
        """Stepper within a system, from that of the scene alone."""
        return PartitionedStepper(implicit.scene, implicit, implicit.dt)

    def enter(self, state: RodState) -> Ahead:
        """Unpacks a state and makes it satisfy the scene's constraints."""
        begin = replace(self.implicit, scene=self.scene).begin(state)
        return Ahead(begin, jnp.zeros_like(self.dt))

    def leave(self, ahead: Ahead) -> RodState:
        """Packs the motion at the end of a step into a state."""
        return state_of(ahead.motion)

    def drift(self, ahead: Ahead, dt: Array) -> Ahead:
        """The rod seen a time `dt` [s] later, where supports have put it."""
        later = replace(ahead, lead=ahead.lead + dt)
        seen = self.view(later)
        placed = constrain(self.scene, seen)
        return later if placed is seen else self.moved_as(later, placed)

    def kick(self, ahead: Ahead, others: Loads | None = None) -> Ahead:
        """The rod at the end of the next step, seen at the same time.

        `others` are the loads of couplings on the rod as it is seen.
        """
        scene, motion = self.scene, ahead.motion
        if others is not None:
            frame = directors(self.view(ahead).orientation)
            none = jax.tree.map(jnp.zeros_like, (motion.velocity, motion.spin))
            couples = others.couples
            outside = OutsideLoads(
                none[0] if others.forces is None else others.forces,
                none[1] if couples is None else to_world(frame, couples),
            )
            scene = replace(scene, effects=(*scene.effects, outside))
        present = replace(self.implicit, scene=scene)
        after = present.slowed(present.stepped(motion))
        return Ahead(after, ahead.lead - self.dt)

    def view(self, ahead: Ahead) -> Motion:
        """Motion in the form that effects and couplings take."""
        return self._later(ahead.motion, ahead.lead)

    def moved_as(self, ahead: Ahead, seen: Motion) -> Ahead:
        """The rod whose view is `seen`, in which supports have changed it."""
        return replace(ahead, motion=self._later(seen, -ahead.lead))

    def constrain_rates(self, ahead: Ahead) -> Ahead:
        """Applies the constraints of all effects on velocities and spins."""
        held = constrain_rates(self.scene, ahead.motion)
        return replace(ahead, motion=held)

    def _later(self, motion: Motion, time: Array) -> Motion:
        """Motion after a time [s] at the same velocities and angular velocities."""
        turn = vectors.scale(time, motion.angular_velocities(self.scene.rod))
        orientation = multiply_quaternions(rotation_exp(turn), motion.orientation)
        return replace(motion, orientation=normalise(orientation)).moved(time)


def _add(motion: Motion, added: Increments) -> Motion:
    """Motion with increments added; rotations are composed as quaternions."""
    turned = multiply_quaternions(motion.orientation, rotation_exp(added.turn))
    return replace(
        displaced(motion, added.displacement),
        orientation=normalise(turned),
        velocity=vectors.add(motion.velocity, added.velocity),
        spin=vectors.add(motion.spin, added.spin),
    )

"""A scene: one rod, the effects on it and its method, as a model; and its factory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxrod.analysis.dynamics import scene_reactions
from jaxrod.analysis.frequency import squared_frequencies
from jaxrod.analysis.health import Health, HealthLimits, scene_health
from jaxrod.analysis.stability import (
    StableStep,
    scene_stable_step,
    scene_step_warning,
)
from jaxrod.effects.base import Effect, Reaction, memory_fields, memory_of
from jaxrod.effects.ends import check_held_once
from jaxrod.effects.own_classes import (
    advice_for,
    check_own_class,
    check_own_hooks,
    check_own_loads,
)
from jaxrod.effects.time import Clock, at_clock, clock_at, depends_on_time
from jaxrod.effects.unlikely import warn_of_softness, warn_of_thickness
from jaxrod.geometry.vectors import Vec3
from jaxrod.loaded_rod import (
    Evolvable,
    LoadedRod,
    Method,
    angular_momentum_of,
    check_masses,
    check_scene,
    check_scene_and_state,
    kinetic_energy_of,
    scene_of,
)
from jaxrod.methods.consistent import Consistent
from jaxrod.methods.drag_kick import check_drag
from jaxrod.model import GUESSES, Model, Stepper, TimeStep
from jaxrod.rods.elasticity import stored_energy
from jaxrod.rods.rod import Rod, RodState
from jaxrod.statics.equilibrium import Equilibrium, scene_equilibrium
from jaxrod.structure import Hinted, pytree
from jaxrod.systems.members.member import Member
from jaxrod.systems.members.rods import member_of_rod
from jaxrod.validation import (
    as_time_step,
    check_kind,
    compiled,
    in_type,
    is_traced,
    knows_constants,
)


@pytree
class Scene(LoadedRod, Model, Hinted):
    """One rod, its effects and a method. Structure is static, numbers are traced.

    Only the listed `effects` are in the compiled program. Make a scene with
    `make_scene`; change numbers with `dataclasses.replace`.

    Example:
        >>> scene.rod.n_elements, len(scene.effects), scene.method
        (10, 3, Consistent())
        >>> bent = jaxrod.advance(scene, state, 1e-4, 1000)
        >>> bool(scene.total_energy(bent) < scene.total_energy(state))  # damping
        True
    """

    _hints = GUESSES

    def __repr__(self) -> str:
        """One line: the rod, the effects by their classes, the method."""
        return LoadedRod.__repr__(self)

    def with_memory(self, state: Any) -> RodState:
        """State, with the initial memory of all effects if it has none.

        Example:
            >>> scene.remembers, scene.with_memory(state).memory is None
            (False, True)
        """
        check_scene(self)
        check_kind("state", state, RodState)
        rod_state: RodState = state
        if rod_state.memory is not None or not self.remembers:
            return rod_state
        return replace(rod_state, memory=memory_of(self.effects))

    def as_member(self) -> Member:
        """The rod as a member of a system; equal rods if it is a batch of scenes."""
        return member_of_rod(self)

    def interfaces(self) -> dict[str, Member]:
        """Dict of the rod as the only member, whose name is ""."""
        return {"": self.as_member()}

    def states_by_name(self, state: Any) -> Mapping[str, Any]:
        """Dict {"": state}: a scene has one member, whose name is ""."""
        return {"": state}

    def with_states(self, state: Any, changed: Mapping[str, Any]) -> Any:
        """The state named "" in `changed` if there is one, otherwise `state`."""
        return changed.get("", state)

    def with_members(self, changed: Mapping[str, Any]) -> Scene:
        """The scene named "" in `changed` if there is one, otherwise this one."""
        scene: Scene = changed.get("", self)
        return scene

    def softened(self, share: ArrayLike) -> Scene:
        """The scene whose contacts have a share of their stiffness."""
        return replace(self, effects=tuple(e.softened(share) for e in self.effects))

    def thinned(self, share: float) -> Scene:
        """The scene whose contacts have a share of their points, at least one each."""
        return replace(self, effects=tuple(e.thinned(share) for e in self.effects))

    def contact_forces(self, state: Any) -> list[tuple[str, Vec3]]:
        """Contact forces of fixed bodies on the nodes [N], one entry per effect."""
        return [("", forces) for forces in self.as_member().contact_forces(state)]

    def with_effect(self, effect: Effect) -> Scene:
        """The scene with one more effect.

        Example:
            >>> loaded = scene.with_effect(jaxrod.end_load(force=(0.0, 0.0, -1.0)))
            >>> len(scene.effects), len(loaded.effects)
            (3, 4)
        """
        _check_effect(effect)
        listed = (*self.effects, effect)
        if effect.lacks_numbers:
            listed = _with_numbers(self.rod, listed, self.method)
        return replace(self, effects=listed)

    def check_state(self, state: Any) -> None:
        """Raises unless this is one scene, no batch, and a state fits its rod."""
        check_scene_and_state(self, state)

    def check_run(self, state: Any, dt: TimeStep, first: Array | None) -> Array:
        """Validates the arguments of a run; returns the step [s] in the rod's dtype."""
        check_scene_and_state(self, state)
        check_masses(self)
        dtype = self.rod.rest_lengths.dtype
        step = as_time_step(dt, dtype)
        if state.positions.dtype != dtype:
            raise ValueError(
                f"state must be {dtype}, as the scene's rod is, got "
                f"{state.positions.dtype}"
            )
        for field in ("orientations", "velocities", "angular_momenta", "remainders"):
            own = getattr(state, field)
            kind = getattr(own, "dtype", type(own).__name__)
            if own is not None and kind != dtype:
                raise ValueError(
                    f"{field} of the state must be {dtype}, as the scene's rod is, got "
                    f"{kind}"
                )
        # Within jit the step is traced, and so is whatever is computed there.
        if not is_traced(self, state, step, first):
            now = self.recalling(state)
            if first is not None:
                now = _at(now, Clock(first, jnp.zeros_like(step), step))
            self.method.check_state(now, state)
            if self.evolves:
                # Values that are zero now may leave the plane or act about the axis
                # later.
                self.method.check_state(self.stirred, state)
        return step

    def run_stepper(self, state: Any, dt: Array, first: Array | None) -> Stepper:
        """Integrator of a run; the number `first` of its first step sets the time."""
        if first is None:
            return self.method.stepper(self, state, dt)
        start = self.at(Clock(first, jnp.zeros_like(dt), dt))
        constants = self.method.stepper(start, state, dt)
        if not isinstance(constants, Evolvable):
            raise ValueError(
                f"{type(self.method).__name__} has no steps for a scene that depends "
                "on time or has memory: its stepper needs a method `evolving`"
            )
        return constants.evolving(self, first)

    def step_warning(self, dt: Array, state: Any) -> tuple[str | None, bool]:
        """Tests whether a concrete step is stable.

        Returns the text of a warning, or `None` if the step is stable; and whether the
        step may become unstable if the rod is compressed further.
        """
        return scene_step_warning(self, dt, state)

    def stable_step(self, safety: ArrayLike, *, state: Any = None) -> StableStep:
        """Result of `jaxrod.stable_dt`: `safety` times the largest stable step."""
        return scene_stable_step(self, safety, state=state)

    def health(
        self,
        state: Any,
        dt: TimeStep,
        *,
        limits: HealthLimits | None = None,
        energy_before: ArrayLike | None = None,
        work_input: ArrayLike = 0.0,
        n_steps: ArrayLike = 1000,
        before: Any = None,
    ) -> Health:
        """Result of `jaxrod.health`: flags of a state, and the values behind them."""
        return scene_health(
            self,
            state,
            dt,
            limits=limits,
            energy_before=energy_before,
            work_input=work_input,
            n_steps=n_steps,
            before=before,
        )

    def reactions(self, state: Any) -> tuple[Reaction | None, ...]:
        """Result of `jaxrod.reactions`: loads of all supports."""
        return scene_reactions(self, state)

    def equilibrium(
        self,
        state: Any,
        *,
        tolerance: ArrayLike | None = None,
        max_iterations: int = 400,
    ) -> Equilibrium:
        """Result of `jaxrod.equilibrium`: a configuration whose loads balance."""
        return scene_equilibrium(
            self, state, tolerance=tolerance, max_iterations=max_iterations
        )

    def squared_frequencies(self, state: Any) -> np.ndarray:
        """Squares of all angular frequencies about a state at rest [rad^2/s^2]."""
        return squared_frequencies(self, state)

    def kinetic_energy(self, state: Any) -> Float[Array, ""]:
        """Kinetic energy of translation and rotation [J].

        Example:
            >>> moving = replace(state, velocities=2.0 * jnp.ones((3, 11)))
            >>> round(float(scene.kinetic_energy(moving)), 3)
            7.54
        """
        return kinetic_energy_of(self, state)

    def potential_energy(self, state: Any) -> Float[Array, ""]:
        """Stored elastic energy plus the potential of all effects [J].

        Example:
            >>> lifted = replace(state, positions=state.positions + 1.0)
            >>> more = scene.potential_energy(lifted) - scene.potential_energy(state)
            >>> round(float(more), 2)  # m g h
            12.32
        """
        scene = scene_of(self, state)
        total = stored_energy(scene.rod, state)
        for effect in scene.effects:
            total = total + effect.energy(scene.rod, state)
        return total

    def momentum(self, state: Any) -> Float[Array, "3"]:
        """Linear momentum, world frame [kg m/s].

        Example:
            >>> moving = replace(state, velocities=2.0 * jnp.ones((3, 11)))
            >>> print(scene.momentum(moving).round(3))
            [2.513 2.513 2.513]
        """
        return self.rod.momentum(state)

    def angular_momentum(self, state: Any) -> Float[Array, "3"]:
        """Angular momentum about the origin, world frame [kg m^2/s].

        Example:
            >>> lifting = jnp.zeros((3, 11)).at[2].set(1.0)  # along z [m/s]
            >>> moving = replace(state, velocities=lifting)
            >>> print(scene.angular_momentum(moving).round(3))
            [ 0.    -0.628  0.   ]
        """
        return angular_momentum_of(self, state)


@knows_constants
def make_scene(rod: Rod, *effects: Effect, method: Method | None = None) -> Scene:
    """Makes a scene: a rod, the effects on it, and a method.

    Floating-point numbers of effects and of the method are converted to the rod's
    dtype.

    Args:
        rod: The rod.
        *effects: Effects on it, in the order in which they are applied.
        method: Method that steps it; by default `consistent()`. Others are
            `planar("xy")`, `torsion_free()`, `implicit()`, `pyelastica()` and
            `planar("xy", pyelastica())`.

    Raises:
        ValueError: If the method cannot step the scene, two effects hold the same node
            along the same axis, or the same element, or the loads of an effect have
            the wrong shape.
        TypeError: If an effect is not an `Effect`, the rod is not a `Rod`, or the
            method is not a `Method`. Also if the class of an effect is not a pytree,
            defines no hook, or has a method whose name is nearly that of a hook.

    Example:
        >>> jaxrod.make_scene(rod, jaxrod.clamp(state), jaxrod.gravity())
        Scene(Rod(...), Clamp, Gravity, Consistent)
        >>> jaxrod.make_scene(rod, method=jaxrod.planar("zx")).method
        Planar(plane='zx', of=Consistent())
    """
    check_kind("rod", rod, Rod)
    for effect in effects:
        _check_effect(effect)
    dtype = rod.rest_lengths.dtype
    listed = in_type(dtype, "effects", effects)
    # Only now: a number that the dtype cannot hold must raise before any warning.
    warn_of_thickness(rod)
    held = []
    for effect in effects:
        now = at_clock(effect, clock_at(0.0, dtype))
        now.check(rod)
        held += [(type(effect).__name__, part) for part in now.held(rod)]
    check_held_once(held, rod.n_elements)
    if method is None:
        method = Consistent()
    if not isinstance(method, Method):
        raise TypeError(
            "method must be one such as jaxrod.consistent() or jaxrod.planar('xy'), "
            f"got {method!r}"
        )
    method = in_type(dtype, "method", method)
    if any(effect.lacks_numbers for effect in listed):
        listed = _with_numbers(rod, listed, method)
    scene = Scene(rod, listed, method)
    begins = scene.at(0.0).effects
    for effect in begins:
        check_own_loads(effect, rod)
        check_own_hooks(effect, rod)
    _warn_of_softness(rod, begins)
    _check_evolution(scene)
    check_masses(scene)
    check_drag(scene)
    method.check(scene.at(0.0))
    if scene.evolves:
        # Values that are zero now may leave the plane or act about the axis later.
        method.check(scene.stirred)
    return scene


def _check_effect(given: Any) -> None:
    """Raises a TypeError unless a thing is an effect whose class is sound."""
    if not isinstance(given, Effect):
        raise TypeError(
            f"effects must be jaxrod effects, got {type(given).__name__}"
            + advice_for(given, "effect")
        )
    check_own_class(given, Effect, "an effect")


def _warn_of_softness(rod: Rod, effects: tuple[Effect, ...]) -> None:
    """Warns of contact that is too soft to carry the rod where gravity acts."""
    fields = [effect.gravitational_field for effect in effects]
    bearings = [effect.bearing for effect in effects]
    for field in (field for field in fields if field is not None):
        for stiffness in (own for own in bearings if own is not None):
            warn_of_softness(rod, field, stiffness)


@compiled
def _with_numbers(rod: Rod, effects: Any, method: Method) -> Any:
    """Effects with the numbers that they lack, from the step that the others allow."""
    # Compiled, because the bounds of contact take a hundred operations.
    others = tuple(effect for effect in effects if not effect.lacks_numbers)
    step = scene_stable_step(Scene(rod, others, method), 1.0).dt
    return tuple(effect.with_numbers(rod, step) for effect in effects)


@jax.jit
def _at(scene: Scene, clock: Clock) -> Scene:
    # Compiled, because schedules of waves take a hundred operations.
    return scene.at(clock)


def _check_evolution(scene: Scene) -> None:
    """Raises ValueError for schedules or memory where numbers must be constant."""
    for effect in scene.evolving_effects:
        name = type(effect).__name__
        memories = [getattr(effect, field) for field in memory_fields(effect)]
        if depends_on_time(memories):
            raise ValueError(
                f"the memory of {name} must begin with a number, not with a schedule"
            )
        if type(effect).damping_rates is not Effect.damping_rates:
            raise ValueError(
                f"{name} has damping rates, so it must neither depend on time nor "
                "have memory: a run computes them once"
            )
    if scene.evolves:
        scene.method.check_evolving(scene)

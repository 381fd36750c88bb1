"""A loaded rod: one rod, the effects on it, and the method that steps it.

`jaxrod.scene.Scene` is a loaded rod that is also a model: it can be stepped and asked
for its energies. Methods, statics and analyses do not import that file; they take
loaded rods. In a run of a loaded rod that depends on time or has memory, `Now` is the
step number and the memory.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar, Protocol, Self, TypeVar, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Int

from jaxrod.effects.base import Effect, Memory, memory_of, recalled, remembers
from jaxrod.effects.time import Clock, at_clock, at_largest, clock_at, depends_on_time
from jaxrod.geometry.vectors import Vec3, add, join, mapped, multiply, scale, subtract
from jaxrod.model import Stepper
from jaxrod.rods.elasticity import elastic_law, internal_loads
from jaxrod.rods.mass_matrix import coupled
from jaxrod.rods.motion import Loads, Motion, accumulate, motion_of
from jaxrod.rods.repr import repr_or_class_name, scene_repr
from jaxrod.rods.rod import (
    Rod,
    RodState,
    angular_momentum,
    check_state,
    kinetic_energy,
)
from jaxrod.structure import pytree

AnyScene = TypeVar("AnyScene", bound="LoadedRod")


@runtime_checkable
class Evolvable(Protocol):
    """A stepper that also supports scenes that depend on time or have memory."""

    def evolving(self, scene: LoadedRod, first: Array) -> Stepper:
        """Stepper that evaluates the scene's schedules and memory at every step.

        Args:
            scene: The scene with its schedules. This stepper itself was made from a
                copy of the scene, in which schedules are replaced by their values at
                the first step.
            first: Number of the first step, counted from time zero.
        """


@pytree
class Method:
    """Method of stepping a scene: an elastic law, its simplifications, an integrator.

    `jaxrod.consistent()`, `planar()` and others return one. Decorate a subclass of your
    own with `extend.pytree`.

    Example:
        >>> scene.method, isinstance(scene.method, extend.Method)
        (Consistent(), True)
        >>> jaxrod.implicit().explicit, jaxrod.torsion_free().twist
        (False, False)
    """

    twist: ClassVar[bool] = True
    """Whether elements rotate about their axes."""
    explicit: ClassVar[bool] = True
    """Whether steps are explicit, so that they are stable only below `stable_dt`."""
    steps_in_systems: ClassVar[bool] = False
    """Whether rods with this method can be members of a system. Its stepper must then
    have `enter`, `leave`, `drift`, `constrain_rates`, and a `kick` that takes the loads
    of couplings. `view` turns its form of motion into a `Motion`, and `moved_as` takes
    positions and velocities of nodes from one."""

    @property
    def in_space(self) -> Method:
        """Method of the same law in three dimensions and with explicit steps.

        Statics of systems use it. By default it is the method itself.
        """
        return self

    @property
    def has_energy(self) -> bool:
        """Whether internal loads are the gradient of the stored energy."""
        return True

    @property
    def normal_axis(self) -> int | None:
        """World axis along which rods do not move, 0 for x; `None` in space."""
        return None

    @property
    def solves_damping(self) -> bool:
        """Whether damping rates and loads are integrated together in each kick.

        Otherwise the rates of motion are multiplied by a decay factor after the kick.
        """
        return True

    @property
    def solves_drag(self) -> bool:
        """Whether `Effect.drag` and loads are integrated together in each kick.

        Otherwise drag is one of the loads.
        """
        return False

    @property
    def couples_masses(self) -> bool:
        """Whether steps take rods with `mass_matrix="higher_order"`."""
        return False

    def stepper(self, scene: LoadedRod, state: RodState, dt: Array) -> Stepper:
        """Integrator of a scene for steps of `dt` [s], with its constants computed.

        Some constants depend on `state`, the first state of the run.
        """
        # Not abstract: checks of single effects make scenes that are never stepped.
        raise NotImplementedError

    def stepper_in_system(self, scene: LoadedRod, state: RodState, dt: Array) -> Any:
        """Integrator of a member of a system, for steps of `dt` [s].

        By default it is `stepper(scene, state, dt)`.
        """
        return self.stepper(scene, state, dt)

    def loads(self, scene: LoadedRod, motion: Motion) -> Loads:
        """Sum of internal and external loads, for analyses such as `stable_dt`.

        Forces on nodes are in the world frame [N], couples on elements in the material
        frame [N m]. Couples are scaled so that, divided by the rotary inertia of the
        unstretched element, they are angular accelerations.
        """
        internal = internal_loads(elastic_law(scene.rod), motion)
        assert internal.forces is not None and internal.couples is not None
        return external_loads(scene, motion, internal.forces, internal.couples)

    def check(self, scene: LoadedRod) -> None:
        """Raises ValueError if this method cannot step the scene from any state.

        Traced values are not checked.
        """

    def check_evolving(self, scene: LoadedRod) -> None:
        """Raises ValueError if this method forbids an effect to change with time.

        It is called with the scene that has schedules or memory.
        """

    def check_state(self, scene: LoadedRod, state: RodState) -> None:
        """Raises ValueError if this method cannot step the scene from this state.

        The values of the state are known, not traced.
        """


@pytree
class LoadedRod:
    """Base class of `Scene`: rod, effects and method, without energies and runs.

    Only the listed `effects` are in the compiled program.

    Example:
        >>> isinstance(scene, extend.LoadedRod), scene.depends_on_time, scene.remembers
        (True, False, False)
    """

    rod: Rod
    """The rod's parameters."""
    effects: tuple[Effect, ...]
    """Effects on the rod, in the order in which they are applied."""
    method: Method
    """Method that steps the rod."""

    def __repr__(self) -> str:
        """One line: the rod, the effects by their classes, the method."""
        return repr_or_class_name(scene_repr, self)

    @property
    def depends_on_time(self) -> bool:
        """Whether a parameter of an effect is a schedule."""
        return depends_on_time(self.effects)

    @property
    def remembers(self) -> bool:
        """Whether an effect has memory from step to step."""
        return remembers(self.effects)

    def at(self, time: ArrayLike | Clock) -> Self:
        """Scene at a time [s], in which schedules are replaced by their values.

        It is needed for functions of one moment: energies, health, equilibrium,
        frequencies.

        Example:
            >>> growing = schedules.ramp((0, 0, 0), (0, 0, 2.0), duration=1.0)
            >>> pushed = jaxrod.make_scene(rod, jaxrod.end_load(force=growing))
            >>> pushed.at(0.5).effects[0].force.tolist()
            [0.0, 0.0, 1.0]
        """
        if not self.depends_on_time:
            return self
        clock = clock_at(time, self.rod.rest_lengths.dtype)
        return replace(self, effects=at_clock(self.effects, clock))

    @property
    def at_largest(self) -> Self:
        """Scene in which every schedule is replaced by the bound on its magnitude."""
        if not self.depends_on_time:
            return self
        return replace(self, effects=at_largest(self.effects))

    @property
    def stirred(self) -> Self:
        """Scene with arbitrary memory, and schedules at the bounds on their magnitudes.

        For checks of effects: a load that is zero now may leave the plane or twist
        later.
        """
        effects = tuple(effect.stirred for effect in self.effects)
        return replace(self, effects=effects).at_largest

    @property
    def evolves(self) -> bool:
        """Whether the scene depends on time or has memory."""
        return self.depends_on_time or self.remembers

    @property
    def evolving_effects(self) -> tuple[Effect, ...]:
        """Effects that depend on time or have memory."""
        return tuple(
            effect
            for effect in self.effects
            if depends_on_time(effect) or remembers((effect,))
        )

    def check_moment(self) -> None:
        """Raises a `ValueError` if the scene depends on time: `at` is needed first."""
        if self.depends_on_time:
            raise ValueError(
                "this is defined at one moment, but an effect of the scene has a "
                "schedule: give scene.at(time)"
            )

    def recalling(self, state: Any) -> Self:
        """Copy of the scene whose effects have the memory that a state stores."""
        if state.memory is None or not self.remembers:
            return self
        return replace(self, effects=recalled(self.effects, state.memory))

    @property
    def without_slip(self) -> Self:
        """Copy whose static friction holds; the scene itself if it has none."""
        effects = tuple(effect.without_slip for effect in self.effects)
        same = all(a is b for a, b in zip(effects, self.effects, strict=True))
        return self if same else replace(self, effects=effects)


def check_scene(scene: Any) -> None:
    """Raises unless an argument is a single scene, neither a system nor a batch.

    Raises:
        TypeError: If it is not a scene.
        ValueError: If it is a batch of scenes.
    """
    if not isinstance(scene, LoadedRod):
        raise TypeError(
            f"scene must be a jaxrod.Scene, got {type(scene).__name__}: this is "
            "available for one rod only, not for a system. A system can be stepped "
            "(advance, rollout) and has stable_dt, health and energies; "
            "jaxrod.systems.settled finds its state of rest"
        )
    shape = scene.rod.batch_shape
    if shape:
        raise ValueError(
            f"scene must be one scene, got a batch of shape {shape}: use jax.vmap, as "
            "in jax.vmap(jaxrod.stable_dt)(scenes)"
        )


def scene_of(scene: AnyScene, state: RodState) -> AnyScene:
    """Scene whose effects have the memory in a state, for functions of one moment.

    Raises:
        TypeError: If the arguments are not a scene and a state.
        ValueError: If the state does not match the scene's rod, or the scene depends on
            time.
    """
    check_scene_and_state(scene, state)
    scene.check_moment()
    return scene.recalling(state)


def check_memory(scene: LoadedRod, state: RodState, name: str = "state") -> None:
    """Raises a `ValueError` if a state's memory does not match the scene's effects.

    `name` is the name of the state in the message.
    """
    if state.memory is None:
        return
    given, own = map(_described, (state.memory, memory_of(scene.effects)))
    if not scene.remembers or given != own:
        raise ValueError(
            f"{name}.memory must be of the effects of this scene: "
            "dataclasses.replace(state, memory=None) starts again"
        )


def _described(memory: Any) -> Any:
    """Tree structure and shapes of the memory of effects, to compare two memories."""
    leaves, structure = jax.tree.flatten(memory)
    return structure, [jnp.shape(leaf) for leaf in leaves]


def check_scene_and_state(scene: LoadedRod, state: RodState) -> None:
    """Raises unless the arguments are a single scene and a state that matches it.

    Raises:
        TypeError: If either has the wrong type.
        ValueError: If the numbers of elements or nodes differ, the state's memory does
            not match the effects, or either is a batch.
    """
    check_scene(scene)
    check_state(scene.rod, state)
    check_memory(scene, state)


def external_loads(
    scene: LoadedRod, motion: Motion, forces: Vec3, couples: Vec3
) -> Loads:
    """Adds all effects' loads to `forces` [N] and `couples` [N m].

    Forces are in the world frame, couples in the material frame.
    """
    for effect in scene.effects:
        loads = effect.loads_after(scene.rod, motion, Loads(forces, couples))
        forces = accumulate(forces, loads.forces)
        couples = accumulate(couples, loads.couples)
    return Loads(forces, couples)


def constrain(scene: LoadedRod, motion: Motion) -> Motion:
    """Applies the constraints of all effects on positions and orientations."""
    for effect in scene.effects:
        motion = effect.constrain(scene.rod, motion)
    return motion


def constrain_rates(scene: LoadedRod, motion: Motion) -> Motion:
    """Applies the constraints of all effects on velocities and spins."""
    for effect in scene.effects:
        motion = effect.constrain_rates(scene.rod, motion)
    return motion


def free_velocity_mask(scene: LoadedRod, motion: Motion) -> tuple[Vec3, Vec3]:
    """Flags of velocities and spins: 1 if free under `constrain_rates`, 0 if held."""
    return free_under(lambda moving: constrain_rates(scene, moving), motion)


def free_under(
    supported: Callable[[Motion], Motion], motion: Motion
) -> tuple[Vec3, Vec3]:
    """Flags of velocities and spins: 1 if free under `supported`, 0 if held.

    Args:
        supported: Function from a motion to the motion with the rates that supports
            impose, in which each rate is either kept or replaced.
        motion: Configuration of the rod, or of another member of a system.
    """
    rates = (motion.velocity, motion.spin)

    def held(rate: float) -> Motion:
        velocity, spin = jax.tree.map(lambda a: jnp.full_like(a, rate), rates)
        return supported(replace(motion, velocity=velocity, spin=spin))

    moving, still = held(1.0), held(0.0)
    return (
        subtract(moving.velocity, still.velocity),
        subtract(moving.spin, still.spin),
    )


@pytree
class MassCoupling:
    """Coupling of a rod's nodes by its higher-order mass matrix."""

    inverse_masses: Array
    """Inverse masses of the nodes [1/kg]."""
    element_masses: Array
    """Masses of the elements [kg]."""

    @staticmethod
    def of(rod: Rod) -> MassCoupling | None:
        """Coupling of the nodes of a rod; `None` if its masses are lumped."""
        if rod.mass_matrix == "lumped":
            return None
        return MassCoupling(1 / rod.node_masses, rod.element_masses)

    def forces(self, scene: LoadedRod, motion: Motion, forces: Vec3) -> Vec3:
        """Forces that give lumped masses the accelerations of the mass matrix [N].

        Supports give the nodes that they hold their own accelerations.

        Args:
            scene: The scene, whose supports hold nodes.
            motion: Configuration and rates.
            forces: All forces on the nodes, world frame [N].
        """
        change: Motion = jax.tree.map(jnp.zeros_like, motion)
        change = replace(change, velocity=scale(self.inverse_masses, forces))
        for effect in scene.effects:
            change = effect.constrain_accelerations(scene.rod, motion, change)
        return self.added(forces, change.velocity)

    def added(self, forces: Vec3, accelerations: Vec3) -> Vec3:
        """Sum of the forces and of those that couple the nodes [N].

        Args:
            forces: Forces on the nodes [N].
            accelerations: Accelerations under these forces by lumped masses [m/s^2];
                those of supports at nodes that they hold.
        """
        return add(
            forces, mapped(lambda a: coupled(self.element_masses, a), accelerations)
        )

    def slowed(self, scene: LoadedRod, before: Motion, after: Motion) -> Motion:
        """Motion after impulses that have changed each node by its own mass alone.

        The impulses are passed on along elements like forces, so that those in
        equilibrium keep angular momentum.

        Args:
            scene: The scene, whose supports hold nodes.
            before: The motion before the impulses.
            after: The motion that they would give lumped masses.
        """
        free, _ = free_velocity_mask(scene, before)
        change = multiply(free, subtract(after.velocity, before.velocity))
        none = scale(0.0, change)
        passed = scale(self.inverse_masses, self.added(none, change))
        return replace(after, velocity=add(after.velocity, passed))


def check_masses(scene: LoadedRod) -> None:
    """Raises ValueError if the method moves each node by its own mass alone."""
    if scene.rod.mass_matrix != "lumped" and not scene.method.couples_masses:
        raise ValueError(
            f"mass_matrix={scene.rod.mass_matrix!r} couples the masses of neighbouring "
            f"nodes, but {scene.method!r} divides the force on each node by the mass "
            "of that node alone: use consistent(), planar() or torsion_free(), or "
            'mass_matrix="lumped"'
        )


def kinetic_energy_of(scene: LoadedRod, state: RodState) -> Array:
    """Kinetic energy of a scene's rod, with its supports [J]."""
    check_state(scene.rod, state)
    return kinetic_energy(scene.rod, state, free_components(scene, state))


def angular_momentum_of(scene: LoadedRod, state: RodState) -> Array:
    """Angular momentum of a scene's rod about the origin [kg m^2/s]."""
    check_state(scene.rod, state)
    return angular_momentum(scene.rod, state, free_components(scene, state))


def free_components(scene: LoadedRod, state: RodState) -> Array | None:
    """Flags `(3, n + 1)`: 1 if no support holds a velocity; `None` with lumped masses.

    They are the same at all times.
    """
    if scene.rod.mass_matrix == "lumped" or not scene.effects:
        return None
    return _free_components(scene.at(0.0), state)


@jax.jit
def _free_components(scene: LoadedRod, state: RodState) -> Array:
    return join(free_velocity_mask(scene, motion_of(state))[0])


def dissipates(scene: LoadedRod) -> bool:
    """Whether an effect defines `dissipate`, damping that is applied after loads."""
    return any(type(e).dissipate is not Effect.dissipate for e in scene.effects)


def without_dissipation(scene: LoadedRod) -> LoadedRod:
    """Scene without the effects that define `dissipate` and no other hook."""
    hooks = [name for name in vars(Effect) if not name.startswith("_")]

    def only_dissipates(effect: Effect) -> bool:
        own = [n for n in hooks if getattr(type(effect), n) is not getattr(Effect, n)]
        return own == ["dissipate"]

    left = tuple(e for e in scene.effects if not only_dissipates(e))
    return replace(scene, effects=left)


def dissipate(scene: LoadedRod, motion: Motion, dt: Array) -> Motion:
    """Applies all effects' `Effect.dissipate` to velocities and spins, for `dt` [s]."""
    coupling = MassCoupling.of(scene.rod)
    for effect in scene.effects:
        if type(effect).dissipate is not Effect.dissipate:
            # The kick has given held components a rate, which is removed first.
            held = constrain_rates(scene, motion)
            motion = effect.dissipate(scene, held, dt)
            if coupling is not None:
                motion = coupling.slowed(scene, held, motion)
    return motion


def damping_rates(scene: LoadedRod) -> tuple[Array, Array] | None:
    """Total decay rates [1/s] of velocities and of spins; `None` without damping."""
    total: tuple[Array, Array] | None = None
    for effect in scene.effects:
        rates = effect.damping_rates(scene.rod)
        if rates is not None:
            if total is not None:
                rates = (total[0] + rates[0], total[1] + rates[1])
            total = rates
    return total


@pytree
class Now:
    """Step number and memory of effects, which integrators carry from step to step."""

    step: Int[Array, ""]
    """Number of completed steps since time zero."""
    memory: Memory
    """Current memory of the effects."""


def scene_at(scene: LoadedRod, now: Now, fraction: ArrayLike, dt: Array) -> LoadedRod:
    """Scene at the time `(now.step + fraction) * dt`, with the memory in `now`."""
    passed = jnp.asarray(fraction, dt.dtype)
    effects = recalled(scene.effects, now.memory)
    effects = at_clock(effects, Clock(now.step, passed, dt))
    within = tuple(effect.during_step(passed * dt) for effect in effects)
    return replace(scene, effects=within)


def memory_in(scene: LoadedRod, state: RodState) -> Memory:
    """Memory that a state has, or the initial memory of the effects if it has none."""
    return memory_of(scene.effects) if state.memory is None else state.memory


def remembering(scene: LoadedRod, motion: Motion, dt: Array, now: Now) -> Now:
    """`now` with the next step number and the memory after `Effect.after_step`."""
    effects = tuple(e.after_step(scene.rod, motion, dt) for e in scene.effects)
    for before, after in zip(scene.effects, effects, strict=True):
        if type(after) is not type(before):
            raise TypeError(
                f"{type(before).__name__}.after_step must return an effect of its own "
                f"class, got {type(after).__name__}"
            )
    return Now(now.step + 1, _alike(memory_of(effects), now.memory))


def remembering_rest(scene: LoadedRod, state: RodState) -> RodState:
    """State at rest, with the memory that a step of zero leaves in the effects.

    The scene has the memory that its effects had before they came to rest.
    """
    if not scene.remembers:
        return state
    nothing = jnp.zeros((), scene.rod.rest_lengths.dtype)
    now = Now(jnp.zeros((), jnp.int32), memory_of(scene.effects))
    after = remembering(scene, motion_of(state), nothing, now)
    return replace(state, memory=after.memory)


def _alike(new: Memory, old: Memory) -> Memory:
    """New memory, converted to the dtypes of the old one.

    Raises:
        TypeError: If shapes differ, or integers have become floating-point numbers.
    """
    before, after = jax.tree.leaves_with_path(old), jax.tree.leaves_with_path(new)
    if [path for path, _ in before] != [path for path, _ in after]:
        raise TypeError("after_step must keep the structure of the memory")
    for (path, was), (_, is_now) in zip(before, after, strict=True):
        name = path[1].key
        if was.shape != is_now.shape:
            raise TypeError(
                f"after_step must keep the shape of {name}, which was {was.shape}, got "
                f"{is_now.shape}"
            )
        whole = not jnp.issubdtype(was.dtype, jnp.floating)
        if whole and jnp.issubdtype(is_now.dtype, jnp.floating):
            raise TypeError(
                f"after_step makes a number of {name}, which began as {was.dtype}: "
                "begin with 0.0"
            )
    return jax.tree.map(lambda was, is_now: is_now.astype(was.dtype), old, new)

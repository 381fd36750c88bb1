"""Base class of all effects on a rod, the hooks they may override, and their memory.

An effect is a frozen pytree whose numbers are traced leaves. Hooks that it does not
override cost nothing in the compiled step. An effect remembers the values of fields
declared with `memory()` from step to step. They are part of the state,
`RodState.memory`; the scene holds their initial values.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any, ClassVar, Literal, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxrod.effects.ends import Held, Wall
from jaxrod.geometry import vectors
from jaxrod.geometry.matrices import Matrix
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.drag import Drag
from jaxrod.rods.motion import Loads, Motion
from jaxrod.rods.rod import Rod, RodState
from jaxrod.structure import pytree

Reach = Literal["neighbours", "second neighbours", "any"]
"""Range along the rod over which the loads of an effect depend on the state; see
`Effect.reach`."""


@pytree
class StabilityBound:
    """Upper bounds of an effect's contribution to the stiffness and drag of a rod.

    Each field is one number, or one per node or element; `None` if the effect
    contributes nothing to it. `stable_dt` adds up the bounds of all effects.

    Example:
        >>> magnet = actuation.magnetisation(rod, (0.0, 0.0, 0.1), (0.0, 0.0, 0.5))
        >>> bound = magnet.stability_bound(rod)
        >>> round(float(bound.elements[0]), 4), bound.nodes is None  # 0.1 * 0.5 * 0.1 m
        (0.005, True)
    """

    nodes: Array | None = None
    """Stiffness against displacement of each node [N/m]."""
    elements: Array | None = None
    """Stiffness against rotation of each element [N m]."""
    node_drag: Array | None = None
    """Drag force per speed on each node, if `loads` contains it (explicit drag)
    [kg/s]."""
    element_drag: Array | None = None
    """Drag couple per angular velocity on each element, if `loads` contains it
    [N m s]."""
    slip_drag: Array | None = None
    """Friction force at each node per slip speed of the rod's surface [kg/s]. The
    surface slips when the rod translates and when it rotates, so `drags` weights both.
    Friction is perpendicular to the drag of `node_drag`."""
    slip_couple: Array | None = None
    """Friction couple per angular velocity on each element, slip drag times squared
    lever arm [N m s]."""

    def drags(self, moving: Array, turning: Array) -> tuple[Array | None, Array | None]:
        """Bounds of the drag on nodes [kg/s] and on elements [N m s], with friction.

        The slip speed is a velocity `v` plus a lever arm times an angular velocity, `l
        w`. By Young's inequality `(v + l w)^2` is at most `(1 + moving) v^2 + (1 +
        turning) (l w)^2`, if the product of `moving` and `turning` is one. So the bound
        of nodes is the larger of `node_drag` and `(1 + moving) slip_drag`, and that of
        elements is `element_drag + (1 + turning) slip_couple`.
        """
        nodes, elements = self.node_drag, self.element_drag
        if self.slip_drag is not None:
            slip = (1 + moving) * self.slip_drag
            nodes = slip if nodes is None else jnp.maximum(slip, nodes)
        if self.slip_couple is not None:
            slip = (1 + turning) * self.slip_couple
            elements = slip if elements is None else slip + elements
        return nodes, elements


def added_bounds(a: StabilityBound | None, b: StabilityBound) -> StabilityBound:
    """Sum of two stability bounds; a part that is `None` counts as zero."""
    if a is None:
        return b

    def one(x: Array | None, y: Array | None) -> Array | None:
        if x is None or y is None:
            return y if x is None else x
        return x + y

    # Slip drag of `a` may act in the direction of node drag of `b`: both are added.
    even = jnp.asarray(1.0)
    drags = [
        one(*sides)
        for sides in zip(a.drags(even, even), b.drags(even, even), strict=True)
    ]
    return StabilityBound(
        nodes=one(a.nodes, b.nodes),
        elements=one(a.elements, b.elements),
        node_drag=drags[0],
        element_drag=drags[1],
    )


@pytree
class Reaction:
    """Force and couple of a support on a rod, and the power that they put into it.

    Example:
        >>> wall = jaxrod.reactions(scene, state)[0]
        >>> wall.force.shape, wall.couple.shape, float(wall.power)
        ((3,), (3,), 0.0)
    """

    force: Float[Array, "3"]
    """Force of the support on the node that it holds, world frame [N]."""
    couple: Float[Array, "3"]
    """Couple of the support on the element that it holds, world frame [N m]."""
    power: Float[Array, ""]
    """Power that the support puts into the rod [W]; zero if the support does not
    move."""

    @staticmethod
    def of(force: Vec3, couple: Vec3 | None = None, power: Any = None) -> Reaction:
        """Reaction from `force` [N], couple [N m] and power [W]; `None` means zero."""
        none = jnp.zeros_like(force[0])
        turn = (none, none, none) if couple is None else couple
        return Reaction(
            vectors.join(force), vectors.join(turn), none if power is None else power
        )


class Effect:
    """Base class of all effects on a rod: every hook does nothing.

    Hooks are pure functions. `loads` is called at the configuration in the middle of a
    step, `constrain_rates` and `dissipate` after all loads have changed the rates, and
    `constrain` after every change of configuration. A support overrides
    `constrain_rates`. A support that moves overrides `constrain` too.

    `reach`, `turning_tangent`, `twists` and `wall` describe `loads` to methods that
    need to know more than its values. Without them every method gives correct results
    or refuses the effect. With them implicit steps and equilibria cost less, and a
    method without twist knows how the rod is held. A subclass that overrides `loads`
    does not inherit these four, and one that overrides constraints does not inherit
    `held`.

    Example:
        >>> @extend.pytree
        ... class Spring(extend.Effect):
        ...     stiffness: extend.Leaf  # between the tip and the plane x = 0 [N/m]
        ...
        ...     def loads(self, rod, motion):
        ...         x = motion.position[0]
        ...         pull = jnp.zeros_like(x).at[-1].set(-self.stiffness * x[-1])
        ...         return extend.Loads(forces=(pull, 0 * pull, 0 * pull))
        >>> pulled = jaxrod.make_scene(rod, jaxrod.clamp(state), Spring(3.0))
        >>> round(float(pulled.effects[1].loads(rod, motion).forces[0][-1]), 3)
        -3.0
    """

    misplaced: ClassVar[str] = (
        ": an effect acts on one member, so give it to jaxrod.make_scene, or as "
        "effects=... to rigid_body"
    )
    """Advice in the error of a system that got an effect as a coupling."""
    reach: ClassVar[Reach] = "any"
    """Range along the rod over which `loads` depend on the state.

    "neighbours" promises that the force on node `k` and the couple on element `k`
    depend on nodes and elements `k - 1`, `k` and `k + 1` alone, "second neighbours"
    that they depend on `k - 2` to `k + 2` alone. The linear systems of implicit steps
    and of `equilibrium` then take work in proportion to the number of elements; with
    "any" they are dense. A false promise would give a wrong derivative. Both methods
    therefore test the effect numerically and refuse it if the promise does not hold.
    """

    @property
    def actual_reach(self) -> Reach:
        """Range of `loads` for the numbers of this instance; `reach` by default."""
        return self.reach

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Resets inherited hooks that no longer describe what a subclass overrides.

        `reach`, `turning_tangent`, `twists` and `wall` describe `loads`; `held`
        describes `constrain` and `constrain_rates`.
        """
        super().__init_subclass__(**kwargs)
        if cls.reach not in get_args(Reach):
            raise ValueError(
                f"reach must be one of {', '.join(get_args(Reach))}, got {cls.reach!r} "
                f"in {cls.__name__}"
            )
        for name in ("reach", "turning_tangent", "twists", "wall"):
            if _says_of_others(cls, name, ("loads",)):
                setattr(cls, name, vars(Effect)[name])
        if _says_of_others(cls, "held", ("constrain", "constrain_rates")):
            # The class must declare `held` itself. Type checkers take this assignment
            # for a mistake; it restores the hook of the base class.
            cls.held = Effect.held  # type: ignore[method-assign]

    @property
    def bearing(self) -> Array | None:
        """Stiffness of contact that can carry the rod [N/m^2]; `None` without."""
        return None

    @property
    def obstacle(self) -> tuple[Any, int | None] | None:
        """Fixed `Body` that the rod may touch, drawn in replays; `None` without one.

        The second entry is the number of bodies that are stacked along a leading axis
        of the body's numbers, or `None` for a single body.
        """
        return None

    @property
    def obstacle_pose(self) -> tuple[Array, Array] | None:
        """Displacement of the obstacle's origin [m] and its rotation, a quaternion.

        `None` if the obstacle stands still.
        """
        return None

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Forces on nodes and couples on elements at this configuration and rates."""
        return Loads()

    def loads_after(self, rod: Rod, motion: Motion, before: Loads) -> Loads:
        """Loads of an effect that reacts to the loads already acting on the rod.

        Args:
            rod: The rod.
            motion: Its configuration and rates.
            before: Internal loads and those of the effects listed earlier. Components
                that are not used cost nothing.
        """
        return self.loads(rod, motion)

    def constrain(self, rod: Rod, motion: Motion) -> Motion:
        """Motion with positions and orientations that satisfy the constraint.

        Define `constrain_rates` too. Without it the rates of what is held are
        undefined: explicit steps let loads change them, implicit steps do not, and
        friction, dashpots and drag read them.
        """
        return motion

    def constrain_rates(self, rod: Rod, motion: Motion) -> Motion:
        """Motion with velocities and spins that the constraint of the effect allows.

        Spins are angular momenta or angular velocities, see `Motion.spin`.
        """
        return motion

    def constrain_accelerations(
        self, rod: Rod, motion: Motion, change: Motion
    ) -> Motion:
        """Time derivative of the motion, with accelerations that the constraint allows.

        By default this is the derivative of `constrain_rates` with the effect's numbers
        fixed. A support whose velocity depends on time must override it; otherwise
        accelerometers measure no acceleration of the support.

        Args:
            rod: The rod.
            motion: Its configuration and rates; spins are angular momenta.
            change: Time derivative of each part of `motion`, from all loads.
        """
        if type(self).constrain_rates is Effect.constrain_rates:
            return change
        _, held = jax.jvp(partial(self.constrain_rates, rod), (motion,), (change,))
        return held

    @property
    def gravitational_field(self) -> Array | None:
        """Acceleration of free fall, world frame [m/s^2]; `None` except for gravity.

        Accelerometers subtract it from the acceleration.
        """
        return None

    def dissipate(self, scene: Any, motion: Motion, dt: Array) -> Motion:
        """Motion whose rates have decayed for one step at fixed configuration.

        This hook is for damping that is solved separately, so that it does not limit
        the step. It is called after loads and `damping_rates` have changed the rates
        and after `constrain_rates`, which is called once more afterwards.

        Args:
            scene: The scene, with all effects.
            motion: Configuration and rates of the rod.
            dt: Step size [s].
        """
        return motion

    def during_step(self, elapsed: Array) -> Effect:
        """Effect within a step, for loads that change between two memories.

        Every method calls it before `loads`. Energies, `health` and `equilibrium` refer
        to the beginning of a step and do not call it.

        Args:
            elapsed: Time since the beginning of the step, whose memory the effect has
                [s].
        """
        return self

    def after_step(self, rod: Rod, motion: Motion, dt: Array) -> Effect:
        """Effect with its memory fields updated by one step.

        Only changes of fields declared with `jaxrod.extend.memory()` are kept. The hook
        is called once a step, at the configuration in its middle. Explicit steps give
        the rates after the loads have changed them, implicit steps those of the middle.
        `equilibrium` calls it once, at the shape that it has found, with a step of
        zero.

        Args:
            rod: The rod.
            motion: Its configuration and rates.
            dt: Step size [s].
        """
        return self

    @property
    def stirred(self) -> Effect:
        """Effect with other memory, to test which loads may appear later.

        By default 0.739 is added to real numbers. An effect whose memory stays in the
        plane, or free of twist, as long as the rod does returns itself.
        """
        return recalled((self,), stirred(memory_of((self,))))[0]

    @property
    def without_slip(self) -> Effect:
        """Effect whose static friction holds whatever it takes; here itself.

        Small motions about a state at rest are those of what sticks.
        """
        return self

    def damping_rates(self, rod: Rod) -> tuple[Array, Array] | None:
        """Decay rates of velocities and spins [1/s]; `None` without damping.

        Each rate is one number, or one per node or element.
        """
        return None

    def drag(self, rod: Rod, motion: Motion) -> Drag | None:
        """Decay rates along and across the rod, relative to the surrounding fluid.

        `None` without drag. `consistent()`, `planar()` and `torsion_free()` solve drag
        together with the loads, so that it never limits the step. `implicit()` and
        `pyelastica()` take the drag from `loads`, which must be
        `jaxrod.fluids.drag_loads` of these rates. An effect with drag then needs a
        `stability_bound`, and it has no other loads.
        """
        return None

    @property
    def lacks_numbers(self) -> bool:
        """Whether `make_scene` must choose some of its numbers."""
        return False

    def with_numbers(self, rod: Rod, step: Array) -> Effect:
        """Copy with the numbers that it lacks.

        Args:
            rod: The rod.
            step: Largest stable step of the scene without such effects [s].
        """
        return self

    def stability_bound(self, rod: Rod) -> StabilityBound | None:
        """Upper bounds of the stiffness and drag in `loads`, for `stable_dt`.

        An effect whose loads depend on the rod's configuration or rates must override
        this hook, or `stable_dt` does not account for it. Constant loads need no bound.
        """
        return None

    def energy(self, rod: Rod, state: RodState) -> Array | float:
        """Potential energy of the effect [J]; zero by default."""
        return 0.0

    def violation(self, rod: Rod, state: RodState) -> Array | None:
        """Deviation of a state from the constraint of the effect [1].

        It is zero where the constraint is met. A valid simulation stays below one;
        `health` flags states above. `None` for an effect that constrains no position or
        orientation.
        """
        return None

    def passages(self, rod: Rod, before: RodState, after: RodState) -> Array | None:
        """Number of points of the rod that went through a body between two states.

        `None` for an effect without bodies. `health` calls it with an earlier state.
        """
        return None

    def reaction(self, rod: Rod, motion: Motion, needed: Loads) -> Reaction | None:
        """Force, couple and power of a support on the rod; `None` if it holds nothing.

        Args:
            rod: The rod.
            motion: Its configuration and rates.
            needed: Loads that would balance all other loads, so that no node and no
                element accelerates.
        """
        return None

    def held(self, rod: Rod) -> tuple[Held, ...]:
        """Degrees of freedom that the effect holds, regardless of its traced numbers.

        `make_scene` refuses two effects that hold the same degree of freedom. It cannot
        check effects without this hook.
        """
        return ()

    def check(self, rod: Rod) -> None:
        """Warns or raises if the effect does not fit the rod; called by `make_scene`.

        Values of traced numbers cannot be checked.
        """

    def force_directions(self, rod: Rod, motion: Motion) -> Vec3 | None:
        """Unit vectors of forces that may act later but are not in `loads` yet.

        Scenes of planar motion check that these directions are in their plane.
        """
        return None

    def resampled(self, rod: Rod, new_rod: Rod) -> Effect:
        """The same effect for `new_rod`: the rod `rod` with another number of elements.

        An effect with numbers per node or element must override this hook.
        """
        return self

    def softened(self, share: ArrayLike) -> Effect:
        """The same effect, if it is contact with a share of its stiffness.

        `tune` searches for the softest contact that is accurate enough. Dashpots and
        friction get the square root of the share, so that a rod bounces as before.
        """
        return self

    def thinned(self, share: float) -> Effect:
        """The same effect, if it is contact with a share of its points, for `tune`."""
        return self

    def with_free_ends(self, free: Float[Array, "2"]) -> Effect:
        """The same effect for a rod whose ends may be tied to other rods.

        `make_system` calls it where ends are tied, for effects that treat a free end
        differently from the rest of the rod.

        Args:
            free: One number for each end: 1 if it is free, 0 if it is tied. For equal
                rods there is a leading axis.
        """
        return self

    def turning_tangent(self, rod: Rod, motion: Motion) -> Matrix | None:
        """Negative derivative of couples with respect to rotations, world frame [N m].

        The rotations are those of the elements. This hook is for effects with constant
        forces, whose couple on an element depends on the rotation of that element
        alone. `None` states that the couples in the world frame are constant, too. An
        effect without this hook is differentiated automatically.
        """
        # Not `return None`, which means that the couples are constant.
        raise NotImplementedError

    @property
    def twists(self) -> str | None:
        """Name, for error messages, of loads that twist a rod or turn with its frame.

        A method without twist refuses an effect that returns a name, regardless of its
        numbers. `None` by default; twisting couples in the values of `loads` need no
        declaration.
        """
        return None

    def wall(self, rod: Rod) -> Wall | None:
        """Wall that holds the orientation of the rod at one end; `None` without one.

        A method without twist takes the frames of elements from this wall. `loads` must
        then contain nothing but the couple of the wall's elastic joint.
        """
        return None


def _says_of_others(kind: type, name: str, hooks: tuple[str, ...]) -> bool:
    """Whether the class `kind` overrides one of `hooks` without declaring `name`.

    `name` is an attribute that describes the hooks. Its inherited value then describes
    the hooks of a base class.
    """
    for base in kind.__mro__:
        if name in vars(base):
            return False
        if any(hook in vars(base) for hook in hooks):
            return True
    return False


Memory = tuple[dict[str, Any], ...]
"""Values of fields declared with `memory()`, by name, for each effect of a scene."""


def memory_fields(effect: Effect) -> list[str]:
    """Names of the fields of an effect that are declared with `memory()`."""
    fields: tuple[dataclasses.Field[Any], ...] = ()
    if dataclasses.is_dataclass(type(effect)):
        # An effect is a dataclass by its decorator, but its type does not show that.
        fields = dataclasses.fields(type(effect))  # type: ignore[arg-type]
    return [field.name for field in fields if field.metadata.get("memory")]


def remembers(effects: tuple[Effect, ...]) -> bool:
    """Whether any effect has a field declared with `memory()`."""
    return any(map(memory_fields, effects))


def memory_of(effects: tuple[Effect, ...]) -> Memory:
    """Present values of the memory fields of all effects, as arrays."""
    return tuple(
        {
            name: jax.tree.map(jnp.asarray, getattr(effect, name))
            for name in memory_fields(effect)
        }
        for effect in effects
    )


def recalled(effects: tuple[Effect, ...], memory: Memory) -> tuple[Effect, ...]:
    """Effects with the values of their memory fields set to `memory`."""
    # An effect with memory is a dataclass, but its type does not show that.
    return tuple(
        dataclasses.replace(effect, **values) if values else effect  # type: ignore[type-var]
        for effect, values in zip(effects, memory, strict=True)
    )


def stirred(memory: Memory) -> Memory:
    """Memory with 0.739 added to real numbers, to test which effects depend on it."""

    def other(leaf: Any) -> Any:
        inexact = jnp.issubdtype(leaf.dtype, jnp.floating)
        return leaf + jnp.asarray(0.739, leaf.dtype) if inexact else leaf

    return jax.tree.map(other, memory)

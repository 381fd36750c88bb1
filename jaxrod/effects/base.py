"""The base of every influence on a rod, and the hooks it may have.

An effect is a frozen pytree whose numbers are traced leaves. It overrides the hooks
it needs; the others cost nothing in the compiled step.
"""

from __future__ import annotations

from functools import partial
from typing import Any, ClassVar, Literal, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.effects.ends import Wall
from jaxrod.effects.held import Held
from jaxrod.geometry import vectors
from jaxrod.geometry.matrices import Matrix
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.drag import Drag
from jaxrod.rods.motion import Loads, Motion
from jaxrod.rods.rod import Rod, RodState
from jaxrod.structure import pytree

Reach = Literal["neighbours", "second neighbours", "any"]
"""Range along the rod over which the loads of an effect may depend on the state."""


@pytree
class StabilityBound:
    """Upper bounds of an effect's contribution to the stiffness and drag of a rod.

    Each is one number, or one per node or element, or `None` if there is none.
    `stable_dt` adds them up.

    Example:
        >>> magnet = actuation.magnetisation(rod, (0.0, 0.0, 0.1), (0.0, 0.0, 0.5))
        >>> bound = magnet.stability_bound(rod)
        >>> round(float(bound.elements[0]), 4), bound.nodes is None  # 0.1 * 0.5 * 0.1 m
        (0.005, True)
    """

    nodes: Array | None = None
    """Stiffness against displacement of a node [N/m]."""
    elements: Array | None = None
    """Stiffness against rotation of an element [N m]."""
    node_drag: Array | None = None
    """Drag force on a node per speed, if `loads` contains it (explicit drag) [kg/s]."""
    element_drag: Array | None = None
    """Drag couple on an element per angular velocity, if in `loads` [N m s]."""
    slip_drag: Array | None = None
    """Friction on the surface at a node per speed of slip, perpendicular to what
    `node_drag` drags [kg/s]. It acts on both translation and rotation; `drags` divides
    it between them by inertia, damping included."""
    slip_couple: Array | None = None
    """Friction about the axes of an element: drag times lever squared [N m s]."""

    def drags(self, moving: Array, turning: Array) -> tuple[Array | None, Array | None]:
        """Drag on nodes and on elements, slip included.

        Slip is the sum of a velocity and of a spin times a lever. By Young's inequality
        its square is at most `1 + moving` times the square of the first and
        `1 + turning` times that of the second, if the product of both numbers is one.
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
    """Sum of two bounds; either may lack some parts."""
    if a is None:
        return b

    def one(x: Array | None, y: Array | None) -> Array | None:
        if x is None or y is None:
            return y if x is None else x
        return x + y

    # The slip of one may be in the direction of the other's drag, so they are added.
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
    """Force, couple and power of a support on a rod.

    Example:
        >>> wall = jaxrod.reactions(scene, state)[0]
        >>> wall.force.shape, wall.couple.shape, float(wall.power)
        ((3,), (3,), 0.0)
    """

    force: Float[Array, "3"]
    """Force on the node it holds, world frame [N]."""
    couple: Float[Array, "3"]
    """Couple on the element it holds, world frame [N m]."""
    power: Float[Array, ""]
    """Power put into the rod; zero for a support that does not move [W]."""

    @staticmethod
    def of(force: Vec3, couple: Vec3 | None = None, power: Any = None) -> Reaction:
        """Makes a reaction from components; those not given are zero."""
        none = jnp.zeros_like(force[0])
        turn = (none, none, none) if couple is None else couple
        return Reaction(
            vectors.join(force), vectors.join(turn), none if power is None else power
        )


class Effect:
    """Base of all effects: every hook does nothing.

    Hooks are pure. `loads` is called at the configuration in the middle of a step;
    `constrain_rates` and `dissipate` after all loads have changed the rates;
    `constrain` after every change of configuration. A support has both constraints.

    `reach`, `turning_tangent`, `twists` and `wall` describe `loads` to methods that
    need to know more than its values. Without them every method gives correct results
    or refuses the effect. With them implicit steps and equilibria cost less, and a
    scene without twist knows how the rod is held. A subclass that overrides `loads`
    does not inherit them, and one that overrides constraints does not inherit `held`.

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

    reach: ClassVar[Reach] = "any"
    """Range along the rod over which `loads` depend on the state.

    "neighbours" promises that the force on node `k` and the couple on element `k`
    depend on nodes and elements `k - 1`, `k` and `k + 1` alone, "second neighbours"
    that they depend on `k - 2` to `k + 2` alone. Then the work of the linear systems of
    implicit steps and of `equilibrium` is in proportion to the number of elements; with
    "any" they are dense. A false promise would give a wrong derivative. Both methods
    therefore test the effect numerically and refuse it if the promise does not hold.
    """

    @property
    def actual_reach(self) -> Reach:
        """Range of the loads with the numbers of this effect; `reach` by default."""
        return self.reach

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Drops inherited declarations about hooks that this class overrides."""
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
            # The class must declare itself what it holds. Type checkers take this
            # assignment for a mistake; it restores the hook of the base class.
            cls.held = Effect.held  # type: ignore[method-assign]

    @property
    def obstacle(self) -> tuple[Any, int | None] | None:
        """A fixed `Body` that the rod may touch, for replays; `None` without one.

        The second entry is the number of bodies, if the body's numbers have a leading
        axis.
        """
        return None

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Forces and couples at this moment."""
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
        """Constrains positions and orientations."""
        return motion

    def constrain_rates(self, rod: Rod, motion: Motion) -> Motion:
        """Constrains velocities and spins."""
        return motion

    def constrain_accelerations(
        self, rod: Rod, motion: Motion, change: Motion
    ) -> Motion:
        """Derivative of the motion by time, with the accelerations of what is held.

        By default it is the derivative of `constrain_rates` with the numbers of the
        effect fixed. A support that moves, with velocities that depend on time, must
        have this, or accelerometers see no acceleration there.

        Args:
            rod: The rod.
            motion: Its configuration and rates; spins are angular momenta.
            change: Derivative of each of its parts by time, from all loads.
        """
        if type(self).constrain_rates is Effect.constrain_rates:
            return change
        _, held = jax.jvp(partial(self.constrain_rates, rod), (motion,), (change,))
        return held

    @property
    def gravitational_field(self) -> Array | None:
        """Acceleration of free fall, world frame [m/s^2]; `None` if it has none.

        It is what an accelerometer does not see.
        """
        return None

    def dissipate(self, scene: Any, motion: Motion, dt: Array) -> Motion:
        """Motion after rates have decayed for one step, at this configuration.

        For damping that is solved separately, so that it does not limit the step. It is
        called after loads and `damping_rates` have changed the rates and after
        `constrain_rates`, which is called once more afterwards.

        Args:
            scene: The scene, with all effects.
            motion: Configuration and rates of the rod.
            dt: Step size [s].
        """
        return motion

    def after_step(self, rod: Rod, motion: Motion, dt: Array) -> Effect:
        """The effect with its memory one step later.

        Only changes of fields declared with `jaxrod.extend.memory()` are kept. Called
        once a step, at the configuration where loads act, with the rates that follow
        from them. In implicit steps it is called at the end of the step.

        Args:
            rod: The rod.
            motion: Its configuration and rates.
            dt: Step size [s].
        """
        return self

    def damping_rates(self, rod: Rod) -> tuple[Array, Array] | None:
        """Decay rates [1/s] of velocities and spins; scalars or one per entry."""
        return None

    def drag(self, rod: Rod, motion: Motion) -> Drag | None:
        """Decay rates along and across the rod, relative to the surrounding fluid.

        Explicit steps of the consistent law solve drag together with the loads, so that
        it never limits the step. Other methods take the drag from `loads`, which must
        be `jaxrod.fluids.drag_loads` of it, with their `stability_bound`. An effect
        with drag has no other loads.
        """
        return None

    def stability_bound(self, rod: Rod) -> StabilityBound | None:
        """Bounds on the derivatives of `loads`, for the stability bound.

        An effect whose loads depend on the rod's configuration or rates must have
        this hook, or `stable_dt` does not account for it. Constant loads need nothing.
        """
        return None

    def energy(self, rod: Rod, state: RodState) -> Array | float:
        """Potential energy of the effect [J]; zero by default."""
        return 0.0

    def violation(self, rod: Rod, state: RodState) -> Array | None:
        """Deviation of a state from the constraint of the effect [1].

        It is zero where the constraint is met. A valid simulation stays below one;
        `health` flags states above. `None` for an effect that does not tie the rod to a
        place or orientation.
        """
        return None

    def reaction(self, rod: Rod, motion: Motion, needed: Loads) -> Reaction | None:
        """Force, couple and power that hold the rod; `None` if nothing is held.

        Args:
            rod: The rod.
            motion: Its configuration and rates.
            needed: The loads that would balance all others, so that no node and no
                element accelerates.
        """
        return None

    def held(self, rod: Rod) -> tuple[Held, ...]:
        """Nodes and elements that the effect holds, by structure alone.

        `make_scene` refuses two effects that hold the same one. It cannot check effects
        without this hook.
        """
        return ()

    def check(self, rod: Rod) -> None:
        """Warns or raises if the effect does not fit the rod; called by `make_scene`.

        Numbers may be traced; their values cannot be checked then.
        """

    def force_directions(self, rod: Rod, motion: Motion) -> Vec3 | None:
        """Unit vectors of forces that may act later but are not in `loads` yet.

        Used to check that they are in the plane of a planar scene.
        """
        return None

    def resampled(self, rod: Rod, new_rod: Rod) -> Effect:
        """The same influence on the rod with another number of elements.

        An effect with numbers per node or element must override this hook.
        """
        return self

    def with_free_ends(self, free: Float[Array, "2"]) -> Effect:
        """The same influence on a rod whose ends may be tied to other rods.

        `make_system` calls it where ends are tied, for effects that treat a free end
        differently from the rest of the rod.

        Args:
            free: One number for each end: 1 if it is free, 0 if it is tied. For equal
                rods there is a leading axis.
        """
        return self

    def turning_tangent(self, rod: Rod, motion: Motion) -> Matrix | None:
        """Negative derivative of the couples by the elements' rotations, world frame.

        For effects whose loads depend on nothing else: their forces are constant, and
        the couple on an element changes with the element's own rotation only. `None`
        if the couples in the world frame are constant, too. An effect without this hook
        is differentiated automatically.
        """
        # Not `return None`, which means that the couples are constant.
        raise NotImplementedError

    @property
    def twists(self) -> str | None:
        """Name of the part that twists a rod, or turns with it about its axis.

        A scene without twist refuses such an effect for any of its numbers. Twisting
        that shows in the values of `loads` need not be declared.
        """
        return None

    def wall(self, rod: Rod) -> Wall | None:
        """The wall that holds the orientation at an end, if this effect has one.

        A scene without twist takes the frames of elements from there. `loads` must then
        contain nothing but the couple of the wall's elastic joint.
        """
        return None


def _says_of_others(kind: type, name: str, hooks: tuple[str, ...]) -> bool:
    """Whether the inherited declaration `name` was made for hooks that were overridden.

    That is the case if a class overrides one of the hooks without declaring `name`.
    """
    for base in kind.__mro__:
        if name in vars(base):
            return False
        if any(hook in vars(base) for hook in hooks):
            return True
    return False

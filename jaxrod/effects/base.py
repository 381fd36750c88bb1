"""The base of every influence on a rod, and the hooks it may have.

An effect is a frozen pytree whose numbers are traced leaves. It overrides the hooks
it needs; the ones it leaves alone cost nothing in the compiled step.
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal, get_args

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

Reach = Literal["neighbours", "any"]
"""How far along the rod the loads of an effect may see."""


@pytree
class StabilityBound:
    """Upper bounds of what an effect adds to the stiffness and drag of a rod.

    Each is one number, or one per node or element, or `None` where there is none.
    `stable_dt` adds them up.
    """

    nodes: Array | None = None
    """Stiffness against moving a node [N/m]."""
    elements: Array | None = None
    """Stiffness against turning an element [N m]."""
    node_drag: Array | None = None
    """Force on a node per speed, where `loads` has it (explicit drag) [kg/s]."""
    element_drag: Array | None = None
    """Couple on an element per angular velocity, likewise [N m s]."""


@pytree
class Reaction:
    """Force, couple and power of a support on a rod."""

    force: Float[Array, "3"]
    """On the node it holds, world frame [N]."""
    couple: Float[Array, "3"]
    """On the element it holds, world frame [N m]."""
    power: Float[Array, ""]
    """Work per time on the rod; zero for one that stands still [W]."""

    @staticmethod
    def of(force: Vec3, couple: Vec3 | None = None, power: Any = None) -> Reaction:
        """From components; what is not given is zero."""
        none = jnp.zeros_like(force[0])
        turn = (none, none, none) if couple is None else couple
        return Reaction(
            vectors.join(force), vectors.join(turn), none if power is None else power
        )


class Effect:
    """Base of all effects: every hook does nothing.

    Hooks are pure. `loads` is called at the configuration in the middle of a step;
    `constrain_rates` and `dissipate` after the rates were changed by all loads;
    `constrain` after every change of configuration. What holds something has both.

    `reach`, `turning_tangent`, `twists` and `wall` describe `loads` to methods that
    need to know more than their values. Without them every method is right or refuses
    the effect; with them implicit steps and equilibria cost less, and a scene without
    twist knows how the rod is held. A subclass that has loads of its own does not
    inherit them, and one that has constraints of its own does not inherit `held`.
    """

    reach: ClassVar[Reach] = "any"
    """How far along the rod `loads` see.

    "neighbours" promises that the force on node `k` and the couple on element `k`
    depend on nodes and elements `k - 1`, `k` and `k + 1` alone. Then the linear systems
    of implicit steps and of `equilibrium` stay block-tridiagonal, with work in
    proportion to the number of elements; with "any" they are dense. A broken promise
    would be a wrong derivative: both try the effect out and refuse it if they can tell.
    """

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Forgets what a base says of hooks that this class replaces."""
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
            # A class of its own says what it holds, or nothing. Checkers take what is
            # assigned to a class for a mistake; here it is the inherited hook again.
            cls.held = Effect.held  # type: ignore[method-assign]

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Forces and couples at this moment."""
        return Loads()

    def loads_after(self, rod: Rod, motion: Motion, before: Loads) -> Loads:
        """`loads`, for an effect that answers what acts on the rod already.

        Args:
            rod: The rod.
            motion: Where it is and how it moves.
            before: Internal loads and those of the effects listed earlier. What is not
                looked at costs nothing.
        """
        return self.loads(rod, motion)

    def constrain(self, rod: Rod, motion: Motion) -> Motion:
        """Constrains positions and orientations."""
        return motion

    def constrain_rates(self, rod: Rod, motion: Motion) -> Motion:
        """Constrains velocities and spins."""
        return motion

    def dissipate(self, scene: Any, motion: Motion, dt: Array) -> Motion:
        """The motion after rates have decayed for a step, at this configuration.

        For damping that is solved by itself, so that it has no bound on the step. After
        loads and `damping_rates` have changed the rates and `constrain_rates` has held
        what is held, which it does once more afterwards.

        Args:
            scene: The scene, with all effects.
            motion: Where the rod is and how it moves.
            dt: Step size [s].
        """
        return motion

    def after_step(self, rod: Rod, motion: Motion, dt: Array) -> Effect:
        """Itself with what it remembers one step later.

        For fields declared with `jaxrod.memory()`; other changes are not kept. Called
        once a step, where loads act, with the rates that follow from them (in implicit
        steps at their end).

        Args:
            rod: The rod.
            motion: Where it is and how it moves.
            dt: Step size [s].
        """
        return self

    def damping_rates(self, rod: Rod) -> tuple[Array, Array] | None:
        """Decay rates [1/s] of velocities and spins; scalars or one per entry."""
        return None

    def drag(self, rod: Rod, motion: Motion) -> Drag | None:
        """Decay rates along and across the rod, relative to what surrounds it.

        Explicit steps of the consistent law solve drag with the loads, so that it never
        limits the step. Other methods take the same from `loads`, as
        `jaxrod.rods.drag.drag_loads` makes them, with the `stability_bound` of these;
        an effect with drag has no loads but those.
        """
        return None

    def stability_bound(self, rod: Rod) -> StabilityBound | None:
        """Bounds on how steeply `loads` change, for the stability bound.

        An effect whose loads depend on where the rod is or how it moves must have
        this, or `stable_dt` does not know of it. Constant loads need nothing.
        """
        return None

    def energy(self, rod: Rod, state: RodState) -> Array | float:
        """Potential energy of the effect [J], zero where there is none."""
        return 0.0

    def violation(self, rod: Rod, state: RodState) -> Array | None:
        """How far a state is from what the effect ties the rod to [1].

        Zero where that is kept, above one where no sound simulation gets: then
        `health` flags the state. `None` for an effect that is the same wherever the
        rod is.
        """
        return None

    def reaction(self, rod: Rod, motion: Motion, needed: Loads) -> Reaction | None:
        """Force, couple and power that hold the rod; `None` if the effect does not.

        Args:
            rod: The rod.
            motion: Where it is and how it moves.
            needed: The loads that would balance all others, so that no node and no
                element accelerates.
        """
        return None

    def held(self, rod: Rod) -> tuple[Held, ...]:
        """Nodes and elements that the effect holds, by structure alone.

        `make_scene` refuses two effects that hold the same one. Of an effect without
        this hook it knows nothing.
        """
        return ()

    def check(self, rod: Rod) -> None:
        """Warns or raises where the effect does not fit the rod; for `make_scene`.

        Numbers may be traced, and then cannot be looked at.
        """

    def force_directions(self, rod: Rod, motion: Motion) -> Vec3 | None:
        """Unit vectors along which forces may act that `loads` does not have yet.

        For checking that they are in the plane of a planar scene.
        """
        return None

    def resampled(self, rod: Rod, new_rod: Rod) -> Effect:
        """The same influence on the rod with another number of elements.

        An effect that holds numbers per node or element must have this.
        """
        return self

    def with_free_ends(self, free: Float[Array, "2"]) -> Effect:
        """The same influence on a rod with ends that may go on in other rods.

        `make_system` calls it where ends are tied, for effects to which a free end is
        something else than the rest of the rod.

        Args:
            free: One for the first and the last end if it is free, zero where it is
                tied; of equal rods with a leading axis.
        """
        return self

    def turning_tangent(self, rod: Rod, motion: Motion) -> Matrix | None:
        """Derivative of minus the couples by the elements' own turns, world frame.

        For effects whose loads change with nothing else: forces are constant, and so
        are couples in the world frame but for this. `None` if they are constant, too.
        An effect without this hook is differentiated automatically.
        """
        # Not `return None`, which says that the couples are constant.
        raise NotImplementedError

    @property
    def twists(self) -> str | None:
        """The part that twists a rod or turns with it about its axis, in words.

        A scene without twist refuses such an effect whatever its numbers; what it can
        find out by calling `loads` needs not be said.
        """
        return None

    def wall(self, rod: Rod) -> Wall | None:
        """The wall that holds the orientation at an end, if this effect holds one.

        A scene without twist takes the frames of elements from there. The couple of an
        elastic joint has to be all there is to `loads`.
        """
        return None


def _says_of_others(kind: type, name: str, hooks: tuple[str, ...]) -> bool:
    """Whether what a class inherits by a name was said of hooks that it replaced."""
    for base in kind.__mro__:
        if name in vars(base):
            return False
        if any(hook in vars(base) for hook in hooks):
            return True
    return False

"""Physical influences on a rod: loads and damping. A scene lists the ones it has.

An effect is a frozen pytree whose numbers are traced leaves. It overrides the hooks
it needs; the ones it leaves alone cost nothing in the compiled step. Held ends are in
`jaxrod.clamps`, actuation in `jaxrod.actuation`.
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal, get_args

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod import vectors
from jaxrod._pytree import pytree, static
from jaxrod._validation import Numbers, as_array
from jaxrod.ends import End, Wall, at_end, check_end, only_at_end
from jaxrod.motion import Loads, Motion
from jaxrod.rod import Rod, RodState
from jaxrod.rotations import directors, to_material, to_world
from jaxrod.tangents import Matrix, skew
from jaxrod.vectors import Vec3

Reach = Literal["neighbours", "any"]
"""How far along the rod the loads of an effect may see."""


@pytree
class Resistance:
    """What an effect may add to the stiffness and drag of a rod: upper bounds.

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


class Effect:
    """Base of all effects: every hook does nothing.

    Hooks are pure. `loads` is called at the configuration in the middle of a step;
    `hold_rates` after the rates were changed by all loads and by damping; `hold`
    after every change of configuration. What holds something has both.

    `reach`, `turning_tangent`, `twists` and `wall` describe `loads` to methods that
    need to know more than their values. Without them every method is right or refuses
    the effect; with them implicit steps and equilibria cost less, and a scene without
    twist knows how the rod is held. A subclass that has loads of its own does not
    inherit them.
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
        """Forgets what a base says of loads that this class replaces."""
        super().__init_subclass__(**kwargs)
        if cls.reach not in get_args(Reach):
            raise ValueError(
                f"reach must be one of {', '.join(get_args(Reach))}, got {cls.reach!r} "
                f"in {cls.__name__}"
            )
        for name in ("reach", "turning_tangent", "twists", "wall"):
            if _says_of_other_loads(cls, name):
                setattr(cls, name, vars(Effect)[name])

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

    def hold(self, rod: Rod, motion: Motion) -> Motion:
        """Constrains positions and orientations."""
        return motion

    def hold_rates(self, rod: Rod, motion: Motion) -> Motion:
        """Constrains velocities and spins."""
        return motion

    def damping_rates(self, rod: Rod) -> tuple[Array, Array] | None:
        """Decay rates [1/s] of velocities and spins; scalars or one per entry."""
        return None

    def resistance(self, rod: Rod) -> Resistance | None:
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

    def check(self, rod: Rod) -> None:
        """Warns or raises where the effect does not fit the rod; for `make_scene`.

        Numbers may be traced, and then cannot be looked at.
        """

    def directions(self, rod: Rod, motion: Motion) -> Vec3 | None:
        """Unit vectors along which forces may act that `loads` does not have yet.

        For checking that they are in the plane of a planar scene.
        """
        return None

    def resampled(self, rod: Rod, new_rod: Rod) -> Effect:
        """The same influence on the rod with another number of elements.

        An effect that holds numbers per node or element must have this.
        """
        return self

    def turning_tangent(self, rod: Rod, motion: Motion) -> Matrix | None:
        """Derivative of minus the couples by the elements' own turns, world frame.

        For effects whose loads change with nothing else: forces are constant, and so
        are couples in the world frame but for this. `None` if they are constant, too.
        An effect without this hook is differentiated automatically.
        """
        raise NotImplementedError

    @property
    def twists(self) -> str | None:
        """What of this effect twists a rod or turns with it about its axis, in words.

        A scene without twist refuses such an effect whatever its numbers; what it can
        find out by calling `loads` needs not be said.
        """
        return None

    def wall(self, rod: Rod) -> Wall | None:
        """What the orientation at an end is held by, if this effect holds one.

        A scene without twist takes the frames of elements from there. The couple of an
        elastic joint has to be all there is to `loads`.
        """
        return None


def _says_of_other_loads(kind: type, name: str) -> bool:
    """Whether what a class inherits by a name was said of loads that it replaced."""
    for base in kind.__mro__:
        if name in vars(base):
            return False
        if "loads" in vars(base):
            return True
    return False


@pytree
class Gravity(Effect):
    """Uniform gravity: force `m g` on every node."""

    acceleration: Float[Array, "3"]
    """Gravitational acceleration, world frame [m/s^2]."""

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Weight of the nodes."""
        masses = rod.node_masses
        g = self.acceleration
        return Loads(forces=(masses * g[0], masses * g[1], masses * g[2]))

    def turning_tangent(self, rod: Rod, motion: Motion) -> None:
        """None: the weight is constant."""

    def energy(self, rod: Rod, state: RodState) -> Array:
        """Minus the work of gravity from the origin [J]."""
        heights = jnp.sum(self.acceleration[:, None] * state.positions, axis=0)
        return -jnp.sum(rod.node_masses * heights)


@pytree
class EndLoad(Effect):
    """A constant force and couple on one end of the rod (dead loads)."""

    force: Float[Array, "3"]
    """On the end node, world frame [N]."""
    couple: Float[Array, "3"]
    """On the end element, world frame, or material frame if `follower` [N m]."""
    end: End = static(default="finish")
    """Which end."""
    follower: bool = static(default=False)
    """Whether the couple turns with the end element."""

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """The force and the couple."""
        couple = vectors.split(self.couple)
        if not self.follower:
            couple = to_material(
                directors(at_end(motion.orientation, self.end)), couple
            )
        return Loads(
            forces=only_at_end(vectors.split(self.force), rod.n_elements + 1, self.end),
            couples=only_at_end(couple, rod.n_elements, self.end),
        )

    def turning_tangent(self, rod: Rod, motion: Motion) -> Matrix | None:
        """Of the couple, if it turns with the element."""
        if not self.follower:
            return None
        frame = directors(at_end(motion.orientation, self.end))
        rows = skew(to_world(frame, vectors.split(self.couple)))
        x, y, z = (only_at_end(row, rod.n_elements, self.end) for row in rows)
        return x, y, z

    @property
    def twists(self) -> str | None:
        """The couple, if it turns with the element."""
        return "follower=True" if self.follower else None


@pytree
class UniformLoad(Effect):
    """A constant force and couple per rest length all along the rod (dead loads)."""

    force_per_length: Float[Array, "3"]
    """World frame [N/m]."""
    couple_per_length: Float[Array, "3"]
    """World frame [N m/m]."""

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Forces shared half and half by an element's nodes; couples on elements."""
        lengths = rod.rest_lengths
        f, c = self.force_per_length, self.couple_per_length
        forces = (0.5 * lengths * f[0], 0.5 * lengths * f[1], 0.5 * lengths * f[2])
        couples = (lengths * c[0], lengths * c[1], lengths * c[2])
        return Loads(
            forces=vectors.pair_sum(forces),
            couples=to_material(directors(motion.orientation), couples),
        )

    def turning_tangent(self, rod: Rod, motion: Motion) -> None:
        """None: the couples are constant in the world frame."""


@pytree
class ExponentialDamping(Effect):
    r"""Linear damping: rates decay exponentially when nothing else acts.

    $\dot v = f/m - g_t v$ and $\dot P = c - g_r P$. In consistent mode a kick solves
    these exactly for the loads held constant over the step: second order, stable
    and with the right terminal velocity however large the rates are. In PyElastica
    mode rates are multiplied by $e^{-g h}$ after the kick, as its
    `AnalyticalLinearDamper` does.
    """

    translational_rate: Float[Array, ""]
    """Of velocities [1/s]."""
    rotational_rate: Float[Array, ""]
    """Of spins [1/s]."""

    def damping_rates(self, rod: Rod) -> tuple[Array, Array]:
        """The two rates [1/s]."""
        return self.translational_rate, self.rotational_rate


# Factories: what users call. They check their arguments and say what is wrong.


def gravity(acceleration: Numbers = (0.0, 0.0, -9.80665)) -> Gravity:
    """Uniform gravity.

    Args:
        acceleration: World frame `(3,)` [m/s^2].
    """
    return Gravity(as_array("acceleration", acceleration, "m/s^2", [(3,)]))


def end_load(
    force: Numbers = (0.0, 0.0, 0.0),
    couple: Numbers = (0.0, 0.0, 0.0),
    *,
    end: End = "finish",
    follower: bool = False,
) -> EndLoad:
    """A constant force and couple on one end.

    Args:
        force: On the end node, world frame `(3,)` [N].
        couple: On the end element `(3,)` [N m]; world frame, or material frame if
            `follower`.
        end: "start" or "finish".
        follower: Whether the couple turns with the end element.
    """
    return EndLoad(
        force=as_array("force", force, "N", [(3,)]),
        couple=as_array("couple", couple, "N m", [(3,)]),
        end=check_end(end),
        follower=bool(follower),
    )


def uniform_load(
    force_per_length: Numbers = (0.0, 0.0, 0.0),
    couple_per_length: Numbers = (0.0, 0.0, 0.0),
) -> UniformLoad:
    """A constant force and couple per rest length.

    Args:
        force_per_length: World frame `(3,)` [N/m].
        couple_per_length: World frame `(3,)` [N m/m].
    """
    return UniformLoad(
        as_array("force_per_length", force_per_length, "N/m", [(3,)]),
        as_array("couple_per_length", couple_per_length, "N m/m", [(3,)]),
    )


def exponential_damping(
    translational_rate: Numbers, rotational_rate: Numbers | None = None
) -> ExponentialDamping:
    """Exponential decay of all rates.

    Args:
        translational_rate: Of velocities, at least 0 [1/s].
        rotational_rate: Of spins, at least 0 [1/s]; the same by default.
    """
    if rotational_rate is None:
        rotational_rate = translational_rate
    return ExponentialDamping(
        as_array("translational_rate", translational_rate, "1/s", non_negative=True),
        as_array("rotational_rate", rotational_rate, "1/s", non_negative=True),
    )

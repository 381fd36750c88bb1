"""Physical influences on a rod: loads, damping, clamps. A scene lists the ones it has.

An effect is a frozen pytree whose numbers are traced leaves. It overrides the hooks
it needs; the ones it leaves alone cost nothing in the compiled step. Actuation is in
`jaxrod.actuation`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod import vectors
from jaxrod._pytree import pytree, static
from jaxrod._validation import Numbers, check_array
from jaxrod.elasticity import joint_couples
from jaxrod.motion import Loads, Motion
from jaxrod.rod import Rod, RodState
from jaxrod.rotations import (
    Quaternion,
    conjugate,
    directors,
    join_quaternion,
    multiply_quaternions,
    rotation_exp,
    rotation_log_and_coupling,
    split_quaternion,
    to_material,
)
from jaxrod.vectors import Vec3

End = Literal["start", "finish"]


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
    after every change of configuration.
    """

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Forces and couples at this moment."""
        return Loads()

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

    def resampled(self, rod: Rod, new_rod: Rod) -> Effect:
        """The same influence on the rod with another number of elements.

        An effect that holds numbers per node or element must have this.
        """
        return self


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
                directors(_at_end(motion.orientation, self.end)), couple
            )
        return Loads(
            forces=_only_at_end(
                vectors.split(self.force), rod.n_elements + 1, self.end
            ),
            couples=_only_at_end(couple, rod.n_elements, self.end),
        )


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


@pytree
class Clamp(Effect):
    """A wall: the end node held in place, the end element joined to the wall's frame.

    Between wall and end element lies half an element, so the wall acts through an
    elastic joint of that length, with the end element's own bending stiffness. The
    static error is then second order in the number of elements: +0.5/n^2 for a
    cantilever, against -1.5/n when the end element itself is held.
    """

    orientation: Float[Array, "4"]
    """The wall's frame, as the end element's would be at rest (w, x, y, z)."""
    end: End = static(default="start")
    """Which end is clamped."""

    def _joint(self, rod: Rod, orientation: Quaternion) -> tuple[Vec3, Array, Vec3]:
        """Rotation from the wall to the end element, coupling, and moment [N m]."""
        wall = conjugate(split_quaternion(self.orientation))
        rotation, coupling = rotation_log_and_coupling(
            multiply_quaternions(wall, orientation)
        )
        index = 0 if self.end == "start" else -1
        stiffness = rod.bend_twist_stiffness[:, index] / (0.5 * rod.rest_lengths[index])
        return rotation, coupling, vectors.multiply(vectors.split(stiffness), rotation)

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """The wall joint's couple on the end element."""
        orientation = _at_end(motion.orientation, self.end)
        rotation, coupling, moment = self._joint(rod, orientation)
        odd, even = joint_couples(rotation, coupling, moment)
        return Loads(
            couples=_only_at_end(vectors.subtract(even, odd), rod.n_elements, self.end)
        )

    def hold_rates(self, rod: Rod, motion: Motion) -> Motion:
        """Stops the end node."""
        return replace(motion, velocity=_zero_at_end(motion.velocity, self.end))

    def resistance(self, rod: Rod) -> Resistance:
        """The stiffness of the wall joint, on the end element."""
        index = 0 if self.end == "start" else -1
        bend_twist = rod.bend_twist_stiffness[:, index]
        stiffness = jnp.max(bend_twist) / (0.5 * rod.rest_lengths[index])
        return Resistance(elements=_place(stiffness, rod.n_elements, self.end))

    def resampled(self, rod: Rod, new_rod: Rod) -> Clamp:
        """Held by the middle of the new end element, which a curved rod turns."""
        frame = _frame_at_new_middle(self.orientation, rod, new_rod, self.end)
        return replace(self, orientation=frame)

    def energy(self, rod: Rod, state: RodState) -> Array:
        """Elastic energy of the wall joint [J]."""
        orientation = _at_end(split_quaternion(state.orientations), self.end)
        rotation, _, moment = self._joint(rod, orientation)
        return 0.5 * vectors.dot(rotation, moment)


@pytree
class FixedEnd(Effect):
    """The end node and the whole end element held: PyElastica's `OneEndFixedBC`.

    First order in the number of elements (see `Clamp`); for comparisons.
    """

    position: Float[Array, "3"]
    """Where the end node is held [m]."""
    orientation: Float[Array, "4"]
    """How the end element is held (w, x, y, z)."""
    end: End = static(default="start")
    """Which end is held."""

    def resampled(self, rod: Rod, new_rod: Rod) -> FixedEnd:
        """Held by the middle of the new end element, which a curved rod turns."""
        frame = _frame_at_new_middle(self.orientation, rod, new_rod, self.end)
        return replace(self, orientation=frame)

    def hold(self, rod: Rod, motion: Motion) -> Motion:
        """Puts the end node and end element back."""
        x, y, z = (
            _replace_end(a, b, self.end)
            for a, b in zip(motion.position, self.position, strict=True)
        )
        q0, q1, q2, q3 = (
            _replace_end(a, b, self.end)
            for a, b in zip(motion.orientation, self.orientation, strict=True)
        )
        return replace(motion, position=(x, y, z), orientation=(q0, q1, q2, q3))

    def hold_rates(self, rod: Rod, motion: Motion) -> Motion:
        """Stops the end node and the end element."""
        return replace(
            motion,
            velocity=_zero_at_end(motion.velocity, self.end),
            spin=_zero_at_end(motion.spin, self.end),
        )


def _frame_at_new_middle(orientation: Array, rod: Rod, new_rod: Rod, end: End) -> Array:
    """An end element's frame, carried along the rest curvature to another middle."""
    index, sign = (0, 1) if end == "start" else (-1, -1)
    way = sign * 0.5 * (new_rod.rest_lengths[index] - rod.rest_lengths[index])
    turn = vectors.split(way * rod.rest_curvatures[:, index])
    carried = multiply_quaternions(split_quaternion(orientation), rotation_exp(turn))
    return join_quaternion(carried)


def _zero_one_end(field: Array, end: End) -> Array:
    """The field with zero at one end."""
    if end == "start":
        return vectors.pad(field[1:], 1, 0)
    return vectors.pad(field[:-1], 0, 1)


def _replace_end(field: Array, value: Array, end: End) -> Array:
    return _zero_one_end(field, end) + _place(value, field.shape[0], end)


def _zero_at_end(field: Vec3, end: End) -> Vec3:
    a, b, c = (_zero_one_end(component, end) for component in field)
    return a, b, c


def _at_end(field: Quaternion, end: End) -> Quaternion:
    index = 0 if end == "start" else -1
    w, x, y, z = (component[index] for component in field)
    return w, x, y, z


def _place(value: Array, size: int, end: End) -> Array:
    """A field that is zero but for one end."""
    before, after = (0, size - 1) if end == "start" else (size - 1, 0)
    return vectors.pad(value[None], before, after)


def _only_at_end(value: Vec3, size: int, end: End) -> Vec3:
    a, b, c = (_place(component, size, end) for component in value)
    return a, b, c


# Factories: what users call. They check their arguments and say what is wrong.


def gravity(acceleration: Numbers = (0.0, 0.0, -9.80665)) -> Gravity:
    """Uniform gravity.

    Args:
        acceleration: World frame `(3,)` [m/s^2].
    """
    value = check_array("acceleration", acceleration, [(3,)], "m/s^2")
    return Gravity(jnp.asarray(value, jnp.result_type(float)))


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
        force=_vector("force", force, "N"),
        couple=_vector("couple", couple, "N m"),
        end=_check_end(end),
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
        _vector("force_per_length", force_per_length, "N/m"),
        _vector("couple_per_length", couple_per_length, "N m/m"),
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
    rates = [
        check_array(name, value, [()], "1/s", non_negative=True)
        for name, value in (
            ("translational_rate", translational_rate),
            ("rotational_rate", rotational_rate),
        )
    ]
    dtype = jnp.result_type(float)
    return ExponentialDamping(
        jnp.asarray(rates[0], dtype), jnp.asarray(rates[1], dtype)
    )


def clamp(state: RodState, end: End = "start") -> Clamp:
    """A wall at one end of a rod, where the given state has it.

    The wall's frame is the end element's orientation in `state`.
    """
    index = 0 if _check_end(end) == "start" else -1
    return Clamp(state.orientations[:, index], end)


def fixed_end(state: RodState, end: End = "start") -> FixedEnd:
    """Holds one end node and end element where the given state has them."""
    index = 0 if _check_end(end) == "start" else -1
    return FixedEnd(state.positions[:, index], state.orientations[:, index], end)


def _vector(name: str, value: Numbers, unit: str) -> Array:
    checked = check_array(name, value, [(3,)], unit)
    return jnp.asarray(checked, jnp.result_type(float))


def _check_end(end: End) -> End:
    if end not in ("start", "finish"):
        raise ValueError(f'end must be "start" or "finish", got {end!r}')
    return end

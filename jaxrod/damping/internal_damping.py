r"""Internal damping: viscosity of the rod's own material (Kelvin-Voigt).

It adds $\tau S\,\dot\sigma$ and $\tau B\,\dot\kappa$ to the elastic stress and moment,
with one relaxation time $\tau$. Rigid-body motion is not damped, and a mode of angular
frequency $\omega$ decays at the rate $\tau\omega^2/2$.

With $M$ the inertia, $G$ the derivatives of the strain rates by the rates $r$ and $D$
their drag, each kick is followed by a backward Euler step of the damping alone, at
fixed configuration. It solves for the impulses $p$ of the pair forces and couples:

$$(1 + h D\,G M^{-1} G^T)\,p = -h D\,G\,r, \qquad M\,\Delta r = G^T p.$$

This is one block-tridiagonal system. Impulses in pairs keep momentum and angular
momentum to round-off, whatever the accuracy of $p$. The step only adds inertia to that
in the bound of `stable_dt`, $M + h G^T D G$: $\tau$ has no bound. The error is of first
order in $h\tau\omega^2$, which is small for all motion that lasts more than a few
steps.
"""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.effects.base import Effect
from jaxrod.effects.directions import frame_along
from jaxrod.geometry import vectors
from jaxrod.geometry.matrices import stacked, turned_diagonal
from jaxrod.geometry.rotations import (
    Quaternion,
    directors,
    normalise,
    to_material,
)
from jaxrod.loaded_rod import LoadedRod
from jaxrod.rods.motion import Motion
from jaxrod.statics.block_matrices import BlockTridiagonal
from jaxrod.statics.degrees_of_freedom import (
    free_velocity_mask,
    stack_dofs,
    unstack_dofs,
)
from jaxrod.structure import pytree
from jaxrod.validation import Numbers, as_array


@pytree
class InternalDamping(Effect):
    """Viscosity of the material; see the module."""

    relaxation_time: Float[Array, ""]
    """Viscous over elastic stiffness [s]."""

    def dissipate(self, scene: LoadedRod, motion: Motion, dt: Array) -> Motion:
        """Motion after strain rates have decayed for a step."""
        rod = scene.rod
        frame = directors(motion.orientation)
        rates = stack_dofs(motion.velocity, motion.angular_velocities(rod))
        pairs = _pairs(scene, motion, self.relaxation_time * dt)
        mobility = _mobility(scene, motion)
        pushes, turns = unstack_dofs(pairs.impulses(mobility, rates))
        inverse_masses = 1 / rod.node_masses
        if motion.spin_is_velocity:
            inertia = vectors.split(rod.principal_inertias)
            a, b, c = to_material(frame, turns)
            turns = a / inertia[0], b / inertia[1], c / inertia[2]
        return replace(
            motion,
            velocity=vectors.add(
                motion.velocity, vectors.scale(inverse_masses, pushes)
            ),
            spin=vectors.add(motion.spin, turns),
        )


@pytree
class _Pairs:
    """Strain rates as sums over neighbouring blocks of rates, and their drag.

    There are six per interval: three of an element's strain, three of the joint after
    it.
    """

    own: Float[Array, "n 6 6"]
    """Derivatives of the strain rates (rows) by the rates of the first block."""
    next: Float[Array, "n 6 6"]
    """Derivatives of the strain rates by the rates of the second block."""
    drag: Float[Array, "n 6"]
    """Impulse of a step per strain rate [N s^2/m or N m s]."""

    def impulses(
        self, mobility: Float[Array, "n+1 6 6"], rates: Float[Array, "n+1 6"]
    ) -> Float[Array, "n+1 6"]:
        """Impulses of a step on nodes and elements, world frame."""
        # A wall before the first element is a block that does not move.
        extra = self.own.shape[0] + 1 - rates.shape[0]
        rates = jnp.pad(rates, ((extra, 0), (0, 0)))
        mobility = jnp.pad(mobility, ((extra, 0), (0, 0), (0, 0)))
        first, second = mobility[:-1], mobility[1:]
        moved_own, moved_next = _product(self.own, first), _product(self.next, second)
        weight = self.drag[:, :, None]
        diagonal = _times_transposed(moved_own, self.own)
        diagonal += _times_transposed(moved_next, self.next)
        upper = _times_transposed(moved_next[:-1], self.own[1:])
        lower = weight[1:] * jnp.swapaxes(upper, 1, 2)
        pad = ((0, 0), (0, 0))
        system = BlockTridiagonal(
            lower=jnp.pad(lower, ((1, 0), *pad)),
            diagonal=jnp.eye(6, dtype=weight.dtype)[None] + weight * diagonal,
            upper=jnp.pad(weight[:-1] * upper, ((0, 1), *pad)),
        )
        strain_rates = _times(self.own, rates[:-1]) + _times(self.next, rates[1:])
        each = system.solve(-self.drag * strain_rates)[:, :, None]
        own = jnp.sum(each * self.own, axis=1)
        following = jnp.sum(each * self.next, axis=1)
        total = jnp.pad(own, ((0, 1), (0, 0))) + jnp.pad(following, ((1, 0), (0, 0)))
        return total[extra:]


def _pairs(scene: LoadedRod, motion: Motion, duration: Array) -> _Pairs:
    """Pairs for a configuration; `duration` is relaxation time times step [s^2].

    A fixed wall is joined to an end element by the joint after the last interval's
    element, or by the joint of an interval before the first.
    """
    rod = scene.rod
    frame = directors(motion.orientation)
    zero = jnp.zeros_like(rod.rest_lengths)
    none = (zero, zero, zero)
    rows = []
    for axis in frame:
        # The rate along d is d . dv plus the angular velocity times d x edge.
        lever = vectors.cross(axis, motion.edges)
        rows.append(((*vectors.scale(-1, axis), *lever), (*axis, *none)))
    joints = jnp.pad(rod.joint_stiffness / rod.joint_lengths[None, :], ((0, 0), (0, 1)))
    walls = [w for e in scene.effects if (w := e.wall(rod)) is not None]
    walls = [wall for wall in walls if wall.stiffness is not None]
    for k, axis in enumerate(directors(_between(scene, motion.orientation))):
        x, y, z = (vectors.pad(c, 0, 1) for c in axis)
        # After the last element the joint is to a wall, about the element's own axes.
        both = zip((x, y, z), frame[k], strict=True)
        back_x, back_y, back_z = (-c.at[-1].set(d[-1]) for c, d in both)
        rows.append(((*none, back_x, back_y, back_z), (*none, x, y, z)))
    own, following = (
        jnp.stack([jnp.stack(row[k], axis=-1) for row in rows], axis=1) for k in (0, 1)
    )
    drag = jnp.concatenate(
        [rod.shear_stretch_stiffness / rod.rest_lengths[None, :], joints]
    ).T
    for wall in walls:
        assert wall.stiffness is not None
        if wall.end == "tip":
            drag = drag.at[-1, 3:].add(wall.stiffness)
            continue
        axes = jnp.stack([jnp.stack([c[0] for c in axis]) for axis in frame])
        drag = jnp.pad(drag, ((1, 0), (0, 0))).at[0, 3:].set(wall.stiffness)
        own = jnp.pad(own, ((1, 0), (0, 0), (0, 0)))
        following = jnp.pad(following, ((1, 0), (0, 0), (0, 0)))
        following = following.at[0, 3:, 3:].set(axes)
    return _Pairs(own, following, duration * drag)


def _mobility(scene: LoadedRod, motion: Motion) -> Float[Array, "n+1 6 6"]:
    """Inverse masses and rotary inertias, world frame; zero for held components."""
    rod = scene.rod
    frame = directors(motion.orientation)
    matrices = turned_diagonal(frame, vectors.split(1 / rod.principal_inertias))
    turning = jnp.pad(stacked(matrices), ((0, 1), (3, 0), (3, 0)))
    identity = jnp.eye(3, dtype=turning.dtype)[None]
    moving = (1 / rod.node_masses)[:, None, None] * identity
    free = (stack_dofs(*free_velocity_mask(scene, motion)) != 0).astype(turning.dtype)
    both = free[:, :, None] * free[:, None, :]
    return both * (jnp.pad(moving, ((0, 0), (0, 3), (0, 3))) + turning)


def _product(a: Array, b: Array) -> Array:
    """Matrix products, as sums."""
    return jnp.sum(a[:, :, :, None] * b[:, None, :, :], axis=2)


def _times_transposed(a: Array, b: Array) -> Array:
    """Products with transposed matrices."""
    return jnp.sum(a[:, :, None, :] * b[:, None, :, :], axis=3)


def _times(rows: Array, vector: Array) -> Array:
    """Products of matrices and vectors."""
    return jnp.sum(rows * vector[:, None, :], axis=2)


def _between(scene: LoadedRod, q: Quaternion) -> Quaternion:
    """Orientations of the joints."""
    if scene.method.twist:
        return _middle(q)
    # The d1 and d2 of an element are unrelated to those of the next.
    x, y, z = (c[:-1] + c[1:] for c in directors(q)[2])
    length = jnp.maximum(vectors.safe_norm((x, y, z)), 1e-6)
    return frame_along((x / length, y / length, z / length))


def _middle(q: Quaternion) -> Quaternion:
    """Orientations halfway between neighbours."""
    before, after = [c[:-1] for c in q], [c[1:] for c in q]
    cosine = sum(a * b for a, b in zip(before, after, strict=True))
    way = jnp.where(cosine < 0, -1, 1)
    w, x, y, z = (a + way * b for a, b in zip(before, after, strict=True))
    return normalise((w, x, y, z))


def internal_damping(relaxation_time: Numbers) -> InternalDamping:
    """Viscosity of the rod's material: strain rates decay, rigid motion does not.

    The amplitude of a mode of angular frequency w decays at the rate
    `relaxation_time w^2 / 2`. It is stable at any relaxation time. The wall joint of
    `clamp` is damped as the rod is, as if its wall did not move.

    A step costs about as much as an implicit one: see the module.

    Args:
        relaxation_time: Viscous over elastic stiffness [s].

    Raises:
        ValueError: If it is not a number, or negative.
    """
    return InternalDamping(
        as_array("relaxation_time", relaxation_time, "s", non_negative=True)
    )

r"""The law of contact at a point: normal force, friction, energy, all per length.

These are pure functions of the penetration $p$, the separation speed $v_n$, the slip
velocity and the parameters of the contact; `jaxrod.contacts.contact` computes $p$,
$v_n$ and the slip. Along the normal a spring and a dashpot act. Their force never
pulls, and its slope is continuous at $v_n = 0$:

$$F_n = k\,\langle p\rangle - c\,s\,v_n \ (v_n < 0), \qquad
  F_n = \frac{(k\langle p\rangle)^2}{k\langle p\rangle + c\,s\,v_n} \ (v_n > 0).$$

The dashpot never resists by more than $c\,|v_n|$, which is its part of the stability
bound. Within the onset its force also grows with the depth, at the rate $c\,|v_n|/w$. A
point of that speed crosses the onset in the time $w/|v_n|$, so this needs no smaller
step.

The onset is smooth over a width $w$: $\langle p\rangle$ rises from zero at $p = -w/2$
as $(p + w/2)^2/2w$ and meets $p$ at $p = w/2$; $s = d\langle p\rangle/dp$ goes from 0
to 1. Friction along the surface is, if it is isotropic,

$$F_t = -\frac{\mu F_n u_t}{\sqrt{|u_t|^2 + u_s^2}}, \qquad u_s = \frac{\mu F_n}{c_t},$$

or, with separate coefficients along an axis, forwards and backwards, and across it,

$$F_a = -\frac{\mu_a F_n u_a}{\sqrt{|u_t|^2 + u_s^2}}, \quad
  F_b = -\frac{\mu_b F_n u_b}{\sqrt{|u_t|^2 + u_s^2}}, \quad
  \mu_a = \frac{\mu_+ + \mu_-}2
    + \frac{\mu_+ - \mu_-}2 \frac{u_a}{\sqrt{u_a^2 + u_s^2}},$$

where $u_s$ is taken with the largest of the three coefficients. With a stick ratio
$\sigma$ all coefficients are those of sliding. They grow as slip vanishes by the factor
$1 + (\sigma - 1)\,e^{-|u_t|^2/(3 u_s)^2}$ (Stribeck), and $u_s$ is taken with the
largest sticking friction.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.structure import pytree

STRIBECK = 3.0
"""Slip speed at which sticking friction fades, divided by the onset speed u_s, at which
the drag of friction would reach its limit [1]."""
_ALONG_THE_NORMAL = 1e-6
"""Sine of the angle between axis and normal below which the projection of the axis on
the surface fades to zero [1]."""


def normal_force(
    depth: Array,
    leaving: Array,
    width: Array,
    stiffness: Array,
    damping: Array | None = None,
) -> Array:
    """Normal force per length of a spring and a dashpot, which never pull [N/m].

    Args:
        depth: Penetration [m].
        leaving: Separation speed, positive when the point leaves the surface [m/s].
        width: Width of the smooth onset of contact [m].
        stiffness: Force per length and penetration [N/m^2].
        damping: Force per length and speed [kg/(m s)].
    """
    touches, depth = _started(depth, width)
    full = depth >= width
    over_width = 1 / width
    onset = (0.5 * depth) * (depth * over_width)
    spring = jnp.where(full, depth - 0.5 * width, onset)
    force = stiffness * spring
    if damping is not None:
        share = jnp.where(full, 1, depth * over_width)
        # Spring depth divided by the dashpot's share. The ratio of spring force to
        # dashpot force is this length over the distance moved in the time damping /
        # stiffness.
        ratio = jnp.where(full, depth - 0.5 * width, 0.5 * depth)
        way = damping / stiffness * jnp.maximum(leaving, 0)
        resisting = damping * share * jnp.minimum(leaving, 0)
        force = force * (ratio / (ratio + way)) - resisting
    return jnp.where(touches, force, 0)


def energy_density(depth: Array, width: Array, stiffness: Array) -> Array:
    """Energy per length of the spring of `normal_force` [J/m].

    It is k (p^2/2 + w^2/24) at penetrations p beyond w/2, with the stiffness k and the
    width w of the onset.
    """
    touches, depth = _started(depth, width)
    over = depth - 0.5 * width
    full = 0.5 * over * over + width * width / 24
    partial = depth * depth * depth / (6 * width)
    energy = jnp.where(depth >= width, full, partial)
    return jnp.where(touches, stiffness * energy, 0)


def friction_force(push: Array, slip: Vec3, friction: Array, drag: Array) -> Vec3:
    """Friction force per length, against the slip, at most `friction * push` [N/m].

    Args:
        push: Normal force per length [N/m].
        slip: Slip velocity, along the surface [m/s].
        friction: Coefficient of friction [1].
        drag: Largest friction per length and speed [kg/(m s)].
    """
    limit = friction * push
    rubs = limit > 0
    excess = vectors.scale(drag / jnp.where(rubs, limit, 1), slip)
    drag = drag * jax.lax.rsqrt(1 + vectors.dot(excess, excess))
    return vectors.scale(jnp.where(rubs, -drag, 0), slip)


@pytree
class PenaltyLaw:
    """Parameters of the law with isotropic friction, per length or per contact."""

    stiffness: Array
    """Normal force per penetration: [N/m^2] if per length, else [N/m]."""
    damping: Array | None
    """Dashpot force per normal speed: [kg/(m s)] if per length, else [kg/s]; `None`
    without damping."""
    friction: Array | None
    """Coefficient of Coulomb friction [1]; `None` without friction."""
    friction_drag: Array | None
    """Largest friction per slip speed: [kg/(m s)] if per length, else [kg/s]; `None`
    without friction."""

    @property
    def has_rates(self) -> bool:
        """Whether forces depend on velocities."""
        return self.damping is not None or self.friction is not None

    @property
    def largest_drag(self) -> Array | None:
        """Larger of `damping` and `friction_drag`; `None` if both are missing."""
        if self.damping is None or self.friction_drag is None:
            return self.friction_drag if self.damping is None else self.damping
        return jnp.maximum(self.damping, self.friction_drag)

    def energy(self, depth: Array, width: Array) -> Array:
        """Spring energy at a penetration [m], with an onset of the given width [m].

        It is per length [J/m] for contact of rods, per contact [J] otherwise; see
        `energy_density`.
        """
        return energy_density(depth, width, self.stiffness)

    def spring(self, depth: Array, width: Array) -> Array:
        """Spring force at the penetration `depth`, with onset `width`: [N/m] or [N]."""
        return normal_force(depth, jnp.zeros_like(depth), width, self.stiffness)

    def forces(
        self,
        depth: Array,
        width: Array,
        normal: Vec3,
        rate: Vec3 | None,
        turning: Vec3 | None = None,
        more: Array | float = 0.0,
    ) -> tuple[Array, Vec3 | None]:
        """Size of the normal force, and vector of friction (`None` without friction).

        Args:
            depth: Penetration [m].
            width: Width of the smooth onset of contact [m].
            normal: Unit vector along which the normal force pushes.
            rate: Relative velocity [m/s]; `None` if `has_rates` is false.
            turning: Slip velocity along the surface from the spins of the bodies, added
                to that of `rate` [m/s].
            more: Further normal force that limits friction, not part of the result:
                [N/m] or [N].
        """
        leaving = jnp.zeros_like(depth) if rate is None else vectors.dot(rate, normal)
        push = normal_force(depth, leaving, width, self.stiffness, self.damping)
        if self.friction is None:
            return push, None
        assert rate is not None and self.friction_drag is not None
        slip = vectors.subtract(rate, vectors.scale(leaving, normal))
        if turning is not None:
            slip = vectors.add(slip, turning)
        presses = push + more
        return push, friction_force(presses, slip, self.friction, self.friction_drag)


def directional_friction_force(
    push: Array,
    slip: Vec3,
    axis: Vec3,
    friction: Float[Array, "3"],
    drag: Array,
    stick_ratio: Array | None = None,
) -> Vec3:
    """Friction force per length, with coefficients along an axis and across it [N/m].

    Args:
        push: Normal force per length [N/m].
        slip: Slip velocity, along the surface [m/s].
        axis: Unit vector along the surface, or zero where it has no direction; there
            all of the slip counts as sideways.
        friction: Coefficients of sliding: along the axis, against it, across it [1].
        drag: Largest friction per length and speed [kg/(m s)].
        stick_ratio: Coefficients of sticking over those of sliding, at least 1 [1].
    """
    forward, backward, sideways = friction
    most = jnp.maximum(jnp.maximum(forward, backward), sideways)
    sticking = most if stick_ratio is None else most * stick_ratio
    limit = sticking * push
    rubs = limit > 0
    # All speeds are in units of the onset speed u_s.
    slip = vectors.scale(drag / jnp.where(rubs, limit, 1), slip)
    along = vectors.dot(axis, slip)
    square = vectors.dot(slip, slip)
    lean = along * jax.lax.rsqrt(1 + along * along)
    of_axis = 0.5 * (forward + backward) + 0.5 * (forward - backward) * lean
    if stick_ratio is not None:
        push = push * (1 + (stick_ratio - 1) * jnp.exp(-square / STRIBECK**2))
    size = jnp.where(rubs, -push * jax.lax.rsqrt(1 + square), 0)
    across = vectors.scale(size * sideways, slip)
    return vectors.add(across, vectors.scale(size * (of_axis - sideways) * along, axis))


def along_surface(axis: Vec3, normal: Vec3) -> Vec3:
    """Unit vectors along a surface: normalised projections of given unit vectors.

    They go smoothly to zero where the given vectors are parallel to the normal.
    """
    upright = vectors.dot(axis, normal)
    flat = vectors.subtract(axis, vectors.scale(upright, normal))
    rounded = vectors.dot(flat, flat) + _ALONG_THE_NORMAL**2
    return vectors.scale(jax.lax.rsqrt(rounded), flat)


def depth_from_onset(depth: Array, width: Array) -> Array:
    """Penetration plus half the onset width, positive; `width` without contact [m]."""
    return _started(depth, width)[1]


def _started(depth: Array, width: Array) -> tuple[Array, Array]:
    """Whether there is contact, and the penetration plus half the onset width [m].

    The latter is `width` without contact. Depths within round-off of the onset count as
    no contact, because ratios of vanishing numbers would have no gradient.
    """
    inside = depth + 0.5 * width
    touches = inside > float(jnp.finfo(width.dtype).eps) ** 0.5 * width
    return touches, jnp.where(touches, inside, width)

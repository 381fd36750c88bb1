r"""A soft arm whose rest curvature is commanded, segment by segment.

The arm is the benchmark's (1 m, 5 cm, 10 MPa, 1000 kg/m^3). It stands upright on the
ground and is subject to gravity. Each of its five equal segments has an angle about
both transverse axes: the angle by which the segment would bend if it were free. These
angles set the rest curvature (`jaxrod.actuation.ActiveShape`). Within a control step it
changes linearly in time from its old to its commanded value.

Damping is exponential, at 4/s. The lowest mode, at 8.8 rad/s without the weight, has a
damping ratio of 0.23. The numerical damping of backward Euler steps of 50 ms is about
as large at this frequency (a ratio of 0.21). Transverse rotary inertia is scaled up
(`jaxrod.scale_inertia`), at most by a factor of two, which changes the position of the
tip by less than 1 mm.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxrod import (
    Gravity,
    HealthLimits,
    Rod,
    RodState,
    Scene,
    advance,
    clamp,
    consistent,
    exponential_damping,
    freeze,
    gravity,
    health,
    scale_inertia,
)
from jaxrod.actuation import active_shape
from jaxrod.effects.clamps import Clamp
from jaxrod.effects.loads import ExponentialDamping
from jaxrod.envs.arm.soft_arm import LENGTH, clean_rod
from jaxrod.schedules import Ramp
from jaxrod.structure import pytree

N_SEGMENTS = 5
"""Number of equal segments, each with an angle about each transverse axis."""
GRAVITY = 9.8
"""Gravitational acceleration [m/s^2]."""
DAMPING = 4.0
"""Damping rate of translation and rotation [1/s]."""
MOST_ANGLE = 2.0
"""Largest angle of a segment about an axis [rad]."""


@pytree
class CurvedArm:
    """Parameters of the arm and of everything that acts on it."""

    rod: Rod
    """Geometry and material of the arm, with scaled transverse rotary inertia."""
    rest: RodState
    """State of the arm upright, straight and at rest."""
    held: Clamp
    """Clamp of the arm's base at the ground."""
    weight: Gravity
    """Gravity, downwards."""
    damping: ExponentialDamping
    """Exponential damping of translation and rotation."""
    shares: Float[Array, "n+1 segments"]
    """Rest curvature at each node's joint per angle of each segment [1/m per rad]."""
    most_angle: Float[Array, ""]
    """Largest angle of a segment about an axis, either way [rad]."""
    largest_change: Float[Array, ""]
    """Change of an angle in a control step for a control value of one [rad]."""
    limits: HealthLimits = dataclasses.field(default_factory=HealthLimits)
    """Health limits beyond which the arm is frozen."""

    def advance(
        self,
        state: RodState,
        before: Float[Array, "2 segments"],
        after: Float[Array, "2 segments"],
        dt: Array,
        n_steps: int,
    ) -> tuple[RodState, Bool[Array, ""]]:
        """Advances the arm by the simulation steps of one control step.

        Args:
            state: State of the arm.
            before: Angles of the segments about d1 and d2 as the control step begins
                [rad].
            after: Angles as it ends; linear in time in between [rad].
            dt: Time step [s].
            n_steps: Number of steps, at least 1.

        Returns:
            The state of the arm, and whether a health flag rose; if so, the state is
            unchanged.
        """
        curvature = Ramp(
            first=self.curvatures(before),
            last=self.curvatures(after),
            start=jnp.zeros_like(dt),
            duration=n_steps * dt,
        )
        moved = advance(self._acting(curvature), state, dt, n_steps)
        flagged = health(self.scene(after), moved, dt, limits=self.limits).flagged
        return freeze(flagged, state, moved), flagged

    def turned(
        self, angles: Float[Array, "2 segments"], action: Float[Array, " action"]
    ) -> Float[Array, "2 segments"]:
        """Angles after an action: angles + largest_change action, clipped [rad].

        Args:
            angles: Angles before the action [rad].
            action: Changes about d1, then about d2, as shares of the largest change;
                clipped to [-1, 1].
        """
        change = self.largest_change * jnp.reshape(jnp.clip(action, -1, 1), (2, -1))
        return jnp.clip(angles + change, -self.most_angle, self.most_angle)

    def curvatures(self, angles: Float[Array, "2 segments"]) -> Float[Array, "3 n+1"]:
        """Rest curvature at each node's joint about d1 and d2; no twist [1/m]."""
        about = jnp.sum(self.shares[None] * angles[:, None, :], axis=-1)
        return jnp.concatenate([about, jnp.zeros_like(about[:1])])

    def scene(self, angles: Float[Array, "2 segments"]) -> Scene:
        """Scene of the arm whose segments keep these angles [rad]."""
        return self._acting(self.curvatures(angles))

    def _acting(self, curvature: Array | Ramp) -> Scene:
        shape = active_shape(self.rod, curvature=curvature, into=self.held)
        effects = (self.held, self.weight, self.damping, shape)
        return Scene(self.rod, effects, consistent())


def curved_arm(n_elements: int, largest_change: float) -> CurvedArm:
    """Makes the arm, upright and at rest, in JAX's default precision.

    Args:
        n_elements: Number of elements.
        largest_change: Largest change of an angle in a control step [rad].
    """
    rod, rest = clean_rod(n_elements, (0.0, 0.0, 0.0), "z")

    def number(value: float) -> Array:
        return jnp.asarray(value, rod.radii.dtype)

    arm = CurvedArm(
        rod=rod,
        rest=rest,
        held=clamp(rest),
        weight=gravity((0.0, 0.0, -GRAVITY)),
        damping=exponential_damping(DAMPING),
        shares=jnp.asarray(_shares(n_elements), rod.radii.dtype),
        most_angle=number(MOST_ANGLE),
        largest_change=number(largest_change),
        limits=jax.tree.map(number, HealthLimits()),
    )
    straight = arm.scene(jnp.zeros((2, N_SEGMENTS), rod.radii.dtype))
    return dataclasses.replace(arm, rod=scale_inertia(straight).scene.rod)


def _shares(n_elements: int) -> np.ndarray:
    """Curvature at each node's joint per angle of each segment (n+1, segments) [1/m].

    A segment of length L with a unit angle has curvature 1/L. A joint reaches from
    midpoint to midpoint of adjacent elements, and gets the mean over this length.
    """
    nodes = np.linspace(0.0, 1.0, n_elements + 1)
    middles = 0.5 * (nodes[1:] + nodes[:-1])
    starts, ends = np.append(0.0, middles), np.append(middles, 1.0)
    edges = np.linspace(0.0, 1.0, N_SEGMENTS + 1)
    overlap = np.minimum(ends[:, None], edges[1:]) - np.maximum(
        starts[:, None], edges[:-1]
    )
    size = LENGTH / N_SEGMENTS
    return np.maximum(overlap, 0.0) / (ends - starts)[:, None] / size

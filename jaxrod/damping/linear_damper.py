r"""PyElastica's `AnalyticalLinearDamper`, for `method=pyelastica()`.

After the loads have changed them, velocities and angular velocities are multiplied by
factors. With the step $h$, the stretch $e$ and the moments of inertia $J_i$ they are

$$e^{-\gamma_t h/m}, \quad \left(e^{-\gamma_r h/J_i}\right)^e
  \qquad\text{or}\qquad
  e^{-g h}, \quad \left(e^{-g h M/J_i}\right)^e,$$

the first pair with PyElastica's constants of translation and rotation, the second with
its single `damping_constant`. $M$ is the mean of an element's node masses (plus half of
the end node's at either end). Held components stay held; PyElastica's damper also slows
down driven ends.
"""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.effects.base import Effect
from jaxrod.geometry import vectors
from jaxrod.loaded_rod import LoadedRod
from jaxrod.rods.motion import Motion
from jaxrod.rods.rod import Rod
from jaxrod.structure import pytree
from jaxrod.validation import Numbers, as_array


@pytree
class LinearDamper(Effect):
    """PyElastica's linear damper with one constant or two; see the module."""

    translational: Float[Array, ""]
    r"""Decay rate $g$ of velocities [1/s] if `rotational` is `None`; otherwise the drag
    coefficient $\gamma_t$ of every node [kg/s]."""
    rotational: Float[Array, ""] | None = None
    r"""Rotational drag coefficient $\gamma_r$ of every element [N m s]; `None` with a
    single constant."""

    def dissipate(self, scene: LoadedRod, motion: Motion, dt: Array) -> Motion:
        """Motion with velocities and spins multiplied by the factors of the module."""
        if not motion.spin_is_velocity:
            raise ValueError(
                "linear_damper is PyElastica's, for method=pyelastica(): "
                "exponential_damping(rate, rotational_rate) is for the other methods"
            )
        rod: Rod = scene.rod
        if self.rotational is None:
            slowing, turning = self.translational, self.translational * _masses(rod)
        else:
            slowing, turning = self.translational / rod.node_masses, self.rotational
        over = turning * dt * motion.lengths / rod.rest_lengths
        a, b, c = (
            spin * jnp.exp(-over / inertia)
            for spin, inertia in zip(motion.spin, rod.principal_inertias, strict=True)
        )
        velocity = vectors.scale(jnp.exp(-slowing * dt), motion.velocity)
        return replace(motion, velocity=velocity, spin=(a, b, c))


def _masses(rod: Rod) -> Array:
    """Masses of elements from node masses, as PyElastica's damper computes them [kg].

    Each is the mean of two node masses, plus half of the end node's at an end.
    """
    nodes = rod.node_masses
    mean = 0.5 * (nodes[1:] + nodes[:-1])
    return mean.at[0].add(0.5 * nodes[0]).at[-1].add(0.5 * nodes[-1])


def linear_damper(
    damping_constant: Numbers | None = None,
    *,
    translational: Numbers | None = None,
    rotational: Numbers | None = None,
) -> LinearDamper:
    """PyElastica's `AnalyticalLinearDamper`, for `method=pyelastica()`.

    It takes PyElastica's `damping_constant`, or its two physical constants.
    PyElastica's `uniform_damping_constant` is `exponential_damping` here. Other methods
    refuse this damper when they step.

    Args:
        damping_constant: Decay rate of velocities [1/s]. The decay rate of spins is
            this times an element's mass over its inertia, in SI units.
        translational: Drag coefficient of every node [kg/s].
        rotational: Rotational drag coefficient of every element [N m s].

    Raises:
        ValueError: If a number is out of range, or neither the single constant nor both
            others are given.

    Example:
        >>> moving = replace(state, velocities=jnp.ones_like(state.velocities))
        >>> scene = jaxrod.make_scene(
        ...     rod, jaxrod.linear_damper(200.0), method=jaxrod.pyelastica()
        ... )
        >>> after = jaxrod.step(scene, moving, 5e-4)
        >>> round(float(after.velocities[0, 0]), 3)  # exp(-200 * 5e-4)
        0.905
    """
    one, two = damping_constant is not None, translational is not None
    if one == two or two != (rotational is not None):
        raise ValueError(
            "linear_damper takes damping_constant [1/s] alone, or translational [kg/s] "
            "and rotational [N m s]"
        )
    if one:
        rate = as_array("damping_constant", damping_constant, "1/s", non_negative=True)
        return LinearDamper(rate)
    assert translational is not None and rotational is not None
    return LinearDamper(
        as_array("translational", translational, "kg/s", non_negative=True),
        as_array("rotational", rotational, "N m s", non_negative=True),
    )

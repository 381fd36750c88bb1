r"""Muscles: fibres in a rod that contract, along themselves or across the rod.

A fibre of full force $F_0 = \sigma_\max A_0$ and activation $a$ has around each node
the energy

$$E = a F_0 \Lambda_0\, F(\Lambda/\Lambda_0), \qquad
  E = 2 a F_0 \Lambda_0\, F\big((\Lambda/\Lambda_0)^{-1/2}\big) \text{ across,}$$

where $\Lambda$ is its length there (`FibrePath.segments`), $\Lambda_0$ that at rest,
and $F$ the integral of its force-length curve. So it pulls with
$a F_0 f(\Lambda/\Lambda_0)$. Muscles across the rod make it thinner in two directions,
hence longer.

With a largest speed of shortening $v$, in rest lengths per time, the force is
multiplied by a factor that depends on the speed of shortening (Hill, Proc. R. Soc. B
126 (1938) 136). With $u$ that speed over $v$, the factor is Hill's hyperbola for
shortening, and for lengthening a hyperbola that has the same slope at zero speed,

$$g(u) = \frac{1 - u}{1 + u/h} \ (0 < u < 1), \qquad
  g(u) = 1 + (b - 1)\,\frac{-u}{c - u} \ (u < 0), \quad c = (b - 1)\,\frac{h}{1 + h}.$$

It is zero beyond $u = 1$ and at most $b$ during lengthening. At zero speed it is one.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.actuation.along_rod import middle_places, resampled_along
from jaxrod.actuation.fibre_path import FibrePath, fibre_path
from jaxrod.actuation.force_length import CubicForce, ForceLength
from jaxrod.actuation.section_load import (
    SectionLoad,
    SectionStrains,
    Walls,
    lengths_at_nodes,
    walls_of,
)
from jaxrod.effects.base import StabilityBound
from jaxrod.effects.clamps import Clamp
from jaxrod.effects.time import Schedule, Timed, as_timed
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import Quaternion, multiply_quaternions
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Motion
from jaxrod.rods.rod import Rod
from jaxrod.structure import pytree, static
from jaxrod.validation import Numbers, as_array, check_kind

HYPERBOLA = 0.25
"""Constant `h` of Hill's hyperbola: the smaller, the stronger its curvature [1]."""
DRAWN_OUT = 1.5
"""Constant `b`: largest force during lengthening, over that at zero speed [1]."""


@pytree
class Muscle(SectionLoad):
    """One or several muscle fibres; see `muscle`."""

    path: FibrePath
    """Path of the fibres."""
    force: Float[Array, "k n"]
    """Full force, per element; or one for the whole rod (n = 1) [N]."""
    activation: Array | Schedule
    """Fraction of the full force [1]: one number, one per fibre `(k,)`, or `(k, n)`."""
    curve: ForceLength
    """Force fraction as a function of stretch."""
    fastest: Float[Array, ""] | None = None
    """Largest speed of shortening, in rest lengths per time [1/s]; `None`: no limit."""
    slowed: Float[Array, "k n+1"] | None = None
    """Factor of the force at the current speed, at nodes; see `at_speed` [1]."""
    walls: Walls = ()
    """Walls into which the fibres continue."""
    across: bool = static(default=False)
    """Whether the fibres contract across the rod."""

    def at_speed(self, rod: Rod, motion: Motion) -> Muscle:
        """The muscle with the force factor for its current speed of shortening."""
        if self.fastest is None:
            return self
        share = force_at_speed(self._shortening(rod, motion) / self.fastest)
        return replace(self, slowed=share)

    def _shortening(self, rod: Rod, motion: Motion) -> Array:
        """Speed of shortening around each node, in rest lengths `(k, n + 1)` [1/s]."""
        rest = vectors.safe_norm(self.path.rest_segments(rod))

        def stretch(position: Vec3, orientation: Quaternion) -> Array:
            there = replace(motion, position=position, orientation=orientation)
            strains, _ = self._strains(there)
            along = vectors.safe_norm(self.path.segments(strains)) / rest
            return along**-0.5 if self.across else along

        x, y, z = motion.angular_velocities(rod)
        turning = multiply_quaternions(
            (0 * x, 0.5 * x, 0.5 * y, 0.5 * z), motion.orientation
        )
        here = motion.position, motion.orientation
        return -jax.jvp(stretch, here, (motion.velocity, turning))[1]

    def stored(self, rod: Rod, strains: SectionStrains) -> Array:
        """Energy of the fibres [J]."""
        rest = vectors.safe_norm(self.path.rest_segments(rod))
        stretch = vectors.safe_norm(self.path.segments(strains)) / rest
        pull = self._pull(rod)
        if self.across:
            return 2 * jnp.sum(pull * rest * self.curve.energy(stretch**-0.5))
        return jnp.sum(pull * rest * self.curve.energy(stretch))

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Bound of the forces and their derivatives near the unstressed shape."""
        largest, steepest = self.curve.largest, self.curve.steepest
        if self.across:
            steepest = 0.5 * steepest + 1.5 * largest
        pull = jnp.abs(self._pull(rod))
        rest = vectors.safe_norm(self.path.rest_segments(rod))
        slope = steepest * pull / rest
        most = 1.0 if self.fastest is None else DRAWN_OUT
        bound = self.path.bound(
            rod, most * largest * pull, most * slope, pulls=not self.across
        )
        if self.fastest is None:
            return bound
        # The slope is largest at zero speed; fibres across have half the rod's speed.
        steep = (1 + 1 / HYPERBOLA) * largest * pull / self.fastest
        steep = 0.5 * steep if self.across else steep
        drag = self.path.bound(rod, 0 * pull, steep / rest, pulls=not self.across)
        return replace(bound, node_drag=drag.nodes, element_drag=drag.elements)

    def resampled(self, rod: Rod, new_rod: Rod) -> Muscle:
        """The same muscles on a rod with another number of elements."""
        old, new = middle_places(rod), middle_places(new_rod)
        activation = self.activation
        if isinstance(activation, Array) and activation.ndim == 2:
            activation = resampled_along(activation, old, new)
        return replace(
            self,
            path=self.path.resampled(rod, new_rod),
            force=resampled_along(self.force, old, new),
            activation=activation,
        )

    def _pull(self, rod: Rod) -> Array:
        """Active force at rest length, times the speed factor `(k, n + 1)` [N]."""
        assert not isinstance(self.activation, Schedule)
        active = self.activation
        if active.ndim < 2:
            active = active.reshape(-1, 1)
        shape = (self.path.count, rod.n_elements)
        pull = jnp.broadcast_to(active * self.force, shape) * rod.rest_lengths[None, :]
        x = jnp.pad(0.5 * pull, ((0, 0), (0, 1))) + jnp.pad(
            0.5 * pull, ((0, 0), (1, 0))
        )
        at_nodes = x / lengths_at_nodes(rod)[None, :]
        return at_nodes if self.slowed is None else self.slowed * at_nodes


def force_at_speed(speed: Array) -> Array:
    """Factor of a muscle's force that depends on its speed, by Hill's hyperbola [1].

    Args:
        speed: Speed of shortening, over the largest; negative for lengthening [1].
    """
    shorter = jnp.minimum(jnp.where(speed > 0, speed, 0), 1)
    longer = jnp.where(speed > 0, 0, -speed)
    slow = (DRAWN_OUT - 1) * HYPERBOLA / (1 + HYPERBOLA)
    drawn_out = 1 + (DRAWN_OUT - 1) * longer / (slow + longer)
    return jnp.where(speed > 0, (1 - shorter) / (1 + shorter / HYPERBOLA), drawn_out)


def muscle(
    rod: Rod,
    force: Numbers,
    activation: Timed = 1.0,
    *,
    offsets: Numbers | None = None,
    curve: ForceLength | None = None,
    across: bool = False,
    fastest: Numbers | None = None,
    into: Clamp | tuple[Clamp, ...] | None = None,
) -> Muscle:
    """Muscle fibres in a rod: longitudinal, helical, or across it.

    Args:
        rod: The rod.
        force: Full force, the stress of the muscle times its area at rest, at least 0:
            one number; one per fibre `(k,)`; or also per element `(k, n)` [N].
        activation: Fraction of the full force: one number; one per fibre `(k,)`; or
            also per element `(k, n)`; or a schedule of any of these [1].
        offsets: Offsets from the centreline along d1 and d2 `(2,)`; one per fibre
            `(k, 2)`; or also per node `(k, 2, n + 1)`, as from `helical_offsets` [m].
            On the centreline by default.
        curve: Force fraction as a function of stretch: `cubic_force()` by default, or
            `gaussian_force()`, `constant_force()`.
        across: Whether the fibres contract across the rod, which makes it thinner and
            longer.
        fastest: Largest speed of shortening, in rest lengths per time [1/s]. Fibres
            pull less the faster they shorten, not at all at this speed, and up to half
            as much again while they lengthen. By default speed does not matter.
        into: The `clamp` of an end, or a tuple of two, into whose wall the fibres
            continue.

    Raises:
        ValueError: If an argument is out of range or of the wrong shape.
        TypeError: If `rod`, `curve` or `into` is of another type.
    """
    check_kind("rod", rod, Rod)
    path = fibre_path(rod, offsets)
    curve = CubicForce() if curve is None else curve
    if not isinstance(curve, ForceLength):
        raise TypeError(
            "curve must be one such as jaxrod.actuation.cubic_force(), got "
            f"{type(curve).__name__}"
        )
    kind = rod.rest_lengths.dtype
    count = path.count
    shapes: list[tuple[int, ...]] = [(), (count,), (count, rod.n_elements)]
    full = as_array("force", force, "N", shapes, non_negative=True, dtype=kind)
    if full.ndim < 2:
        full = jnp.broadcast_to(full, (count,))[:, None]
    return Muscle(
        path=path,
        force=full,
        activation=as_timed("activation", activation, "", *shapes),
        curve=curve,
        fastest=(
            None
            if fastest is None
            else as_array("fastest", fastest, "1/s", positive=True, dtype=kind)
        ),
        walls=walls_of(into),
        across=bool(across),
    )

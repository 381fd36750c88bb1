r"""Magnetised rods in a magnetic field, with the energy $-m\cdot B$.

An element with the magnetic moment $m$, which turns with the element, experiences in
the flux density $B(x)$ the couple $m\times B$ and the force $(\nabla B)^T m$ at its
middle.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.actuation.section_load import at_nodes
from jaxrod.effects.base import Effect, Reach, StabilityBound
from jaxrod.effects.time import Timed, as_timed_vector
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import directors, to_material, to_world
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.motion import Loads, Motion, motion_of
from jaxrod.rods.rod import Rod, RodState, middle_places, resampled_along
from jaxrod.structure import pytree
from jaxrod.validation import Numbers, as_array, check_kind


class MagneticField(ABC):
    """Base class of magnetic fields that vary in space; a subclass is a pytree.

    Its numbers may be schedules.

    Example:
        >>> @extend.pytree
        ... class Wire(actuation.MagneticField):
        ...     strength: jax.Array  # [T m]; the wire is along y, 1 m below the origin
        ...
        ...     def __call__(self, place):
        ...         x, y, z = place
        ...         size = self.strength / (x**2 + (z + 1.0) ** 2)
        ...         return (z + 1.0) * size, 0 * size, -x * size
        ...
        ...     @property
        ...     def largest(self):  # bounds at distances of 1 m and more
        ...         return self.strength, 2 * self.strength, 6 * self.strength
        >>> magnet = actuation.magnetisation(rod, (0.0, 0.0, 0.1), Wire(0.5))
        >>> [float(part) for part in magnet.field((0.0, 0.0, 0.0))]
        [0.5, 0.0, -0.0]
    """

    @abstractmethod
    def __call__(self, place: Vec3) -> Vec3:
        """Flux density at given points, world frame [T]."""

    @property
    @abstractmethod
    def largest(self) -> Any:
        """Bounds of flux density [T], its first [T/m] and second derivative [T/m^2]."""


@pytree
class LinearField(MagneticField):
    """A magnetic field that varies linearly in space.

    Example:
        >>> gradient = jnp.diag(jnp.array([1.0, 1.0, -2.0]))  # [T/m], trace zero
        >>> field = actuation.linear_field((0.0, 0.0, 0.5), gradient, extent=2.0)
        >>> x, y, z = field((1.0, 0.0, 0.25))
        >>> float(x), float(z)  # flux density [T]
        (1.0, 0.0)
    """

    flux_density: Any
    """Flux density at the origin, world frame `(3,)` [T]."""
    gradient: Any
    """Derivative of component i of the flux density along axis j `(3, 3)` [T/m]."""
    extent: Float[Array, ""]
    """Distance from the origin within which the rod stays [m]."""

    def __call__(self, place: Vec3) -> Vec3:
        """Flux density at given points, world frame [T]."""
        x, y, z = (
            self.flux_density[i]
            + self.gradient[i, 0] * place[0]
            + self.gradient[i, 1] * place[1]
            + self.gradient[i, 2] * place[2]
            for i in range(3)
        )
        return x, y, z

    @property
    def largest(self) -> tuple[Array, Array, Array]:
        """Bounds within the extent: `|B| + |gradient| extent`, `|gradient|`, and zero.

        B is the flux density at the origin.
        """
        slope = jnp.sqrt(jnp.sum(self.gradient**2))
        size = jnp.sqrt(jnp.sum(self.flux_density**2)) + slope * self.extent
        return size, slope, jnp.zeros_like(slope)


@pytree
class Magnetisation(Effect):
    """Magnetic moments that turn with the elements; see `magnetisation`.

    Example:
        >>> magnet = actuation.magnetisation(rod, (0.0, 0.0, 0.1), (0.0, 0.0, 0.5))
        >>> about_d1, about_d2, about_d3 = magnet.loads(rod, motion).couples
        >>> round(abs(float(about_d1.sum())), 3)  # 0.1 A m, 0.5 T, 1 m [N m]
        0.05
    """

    moment_per_length: Float[Array, "3 m"]
    """Magnetic moment per length, material frame, of each element or of all (m = 1)
    [A m]."""
    field: Any
    """Flux density, world frame `(3,)` [T], or a `MagneticField`."""

    reach: ClassVar[Reach] = "neighbours"

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Couples on elements, and forces on nodes if the field varies in space."""
        frame = directors(motion.orientation)
        own = self._moments(rod)
        if not isinstance(self.field, MagneticField):
            flux = vectors.split(self.field[:, None])
            return Loads(couples=vectors.cross(own, to_material(frame, flux)))
        moment = to_world(frame, own)
        flux, back = jax.vjp(self.field.__call__, _middles(motion))
        ((x, y, z),) = back(moment)
        return Loads(
            forces=(at_nodes(x), at_nodes(y), at_nodes(z)),
            couples=vectors.cross(own, to_material(frame, flux)),
        )

    def energy(self, rod: Rod, state: RodState) -> Array:
        """Energy: minus the sum of magnetic moment times flux density [J]."""
        motion = motion_of(state)
        moment = to_world(directors(motion.orientation), self._moments(rod))
        if isinstance(self.field, MagneticField):
            flux = self.field(_middles(motion))
        else:
            flux = vectors.split(self.field[:, None])
        return -jnp.sum(vectors.dot(moment, flux))

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Bound on the stiffness that turning couples and a varying field add."""
        moment = vectors.safe_norm(self._moments(rod))
        if not isinstance(self.field, MagneticField):
            size = jnp.sqrt(jnp.sum(self.field**2))
            return StabilityBound(elements=moment * size)
        size, slope, curved = self.field.largest
        # Displacement and rotation are coupled; Young's inequality with the element's
        # length as weight splits the coupling.
        return StabilityBound(
            nodes=at_nodes(moment * (curved + slope / rod.rest_lengths)),
            elements=moment * (size + slope * rod.rest_lengths),
        )

    @property
    def twists(self) -> str | None:
        """Always `None`: not every magnetisation twists a rod.

        `make_scene` tests the values of `loads` instead.
        """
        return None

    def resampled(self, rod: Rod, new_rod: Rod) -> Magnetisation:
        """The same magnetic moments per length in `new_rod`, interpolated along it."""
        old, new = middle_places(rod), middle_places(new_rod)
        moments = resampled_along(self.moment_per_length, old, new)
        return replace(self, moment_per_length=moments)

    def _moments(self, rod: Rod) -> Vec3:
        """Magnetic moments of the elements, material frame [A m^2]."""
        x, y, z = vectors.split(self.moment_per_length)
        lengths = rod.rest_lengths
        return x * lengths, y * lengths, z * lengths


def _middles(motion: Motion) -> Vec3:
    """Midpoints of the elements, world frame [m]."""
    x, y, z = (0.5 * (part[1:] + part[:-1]) for part in motion.position)
    return x, y, z


def magnetisation(
    rod: Rod, moment_per_length: Numbers, field: Timed | MagneticField
) -> Magnetisation:
    """Magnetises a rod that is in a magnetic field.

    Args:
        rod: The rod.
        moment_per_length: Magnetisation times the area of the section, material frame:
            `(3,)`, or one vector per element `(3, n)` [A m].
        field: Flux density, world frame `(3,)`, or a schedule of it [T]; or a
            `MagneticField`, such as `linear_field` makes.

    Raises:
        ValueError: If an argument is not finite or of the wrong shape.
        TypeError: If `rod` is not a `Rod`.

    Example:
        >>> field = schedules.sine((0.5, 0.0, 0.0), period=2.0)
        >>> magnet = actuation.magnetisation(rod, (0.0, 0.0, 0.1), field)
        >>> crest = jaxrod.make_scene(rod, magnet).at(0.5).effects[0]
        >>> round(float(crest.energy(rod, state)), 3)  # - moment times flux density [J]
        -0.05
    """
    check_kind("rod", rod, Rod)
    shapes = [(3,), (3, rod.n_elements)]
    moments = as_array(
        "moment_per_length",
        moment_per_length,
        "A m",
        shapes,
        dtype=rod.rest_lengths.dtype,
    )
    if moments.ndim == 1:
        moments = moments[:, None]
    if not isinstance(field, MagneticField):
        field = as_timed_vector("field", field, "T", (3,))
    return Magnetisation(moments, field)


def linear_field(
    flux_density: Timed, gradient: Timed, *, extent: Numbers
) -> LinearField:
    """A magnetic field that varies linearly in space.

    Args:
        flux_density: Flux density at the origin `(3,)`, or a schedule of it [T].
        gradient: Derivative of component i along axis j `(3, 3)`, or a schedule of it
            [T/m]. Maxwell's equations require it to be symmetric and trace-free, which
            is not checked.
        extent: Distance from the origin within which the rod stays, above 0 [m]. The
            stability bound needs it.

    Raises:
        ValueError: If an argument is out of range or of the wrong shape.

    Example:
        >>> gradient = jnp.diag(jnp.array([1.0, 1.0, -2.0]))  # [T/m]
        >>> field = actuation.linear_field((0.0, 0.0, 0.5), gradient, extent=2.0)
        >>> magnet = actuation.magnetisation(rod, (0.0, 0.0, 0.1), field)
        >>> [round(float(part.sum()), 3) for part in magnet.loads(rod, motion).forces]
        [0.1, 0.0, 0.0]
    """
    return LinearField(
        as_timed_vector("flux_density", flux_density, "T", (3,)),
        as_timed_vector("gradient", gradient, "T/m", (3, 3)),
        as_array("extent", extent, "m", positive=True),
    )

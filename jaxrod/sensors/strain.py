r"""Sensors of the strain of a section, and of what it transmits.

With the strains of the rod $\sigma, \kappa$ at a station, a fibre at the offset $p$ in
the section is stretched to $u = e_3 + \sigma + \kappa\times p$ per unit length, and

$$\epsilon = |u| / |u_0| - 1$$

with $u_0$ of the unstressed shape. In pure bending that is $\kappa_1 p_2 - \kappa_2
p_1$: a fibre on the inner side is compressed. The section transmits the force
$S(\sigma - \sigma_0)$ and the moment $B(\kappa - \kappa_0)$ of the rod's own material.
"""

from __future__ import annotations

from typing import ClassVar

from jaxtyping import Array, Float

from jaxrod.geometry import vectors
from jaxrod.geometry.vectors import Vec3
from jaxrod.loaded_rod import LoadedRod
from jaxrod.rods.elasticity import elastic_law, joint_rotations, shear_stretch
from jaxrod.rods.motion import motion_of
from jaxrod.rods.rod import RodState
from jaxrod.sensors.sensor import (
    Stations,
    StationSensor,
    as_offsets,
    as_stations,
    in_section,
    stations_of,
)
from jaxrod.structure import pytree, static
from jaxrod.validation import Numbers


def _strains(scene: LoadedRod, state: RodState) -> tuple[Vec3, Vec3]:
    """Strain of each element [1] and curvature of each joint [1/m]."""
    motion, rod = motion_of(state), scene.rod
    strain = shear_stretch(motion.edges, motion.orientation, 1 / rod.rest_lengths)
    rotation, _ = joint_rotations(motion.orientation)
    return strain, vectors.scale(1 / rod.joint_lengths, rotation)


@pytree
class StrainGauge(StationSensor):
    """Strain along fibres; see `strain_gauge`.

    Example:
        >>> rosette = sensors.strain_gauge([0.5, 0.5], [[0.02, 0.0], [0.0, 0.02]])
        >>> rosette.shape(scene), rosette.unit
        ((2,), '1')
    """

    unit: ClassVar[str] = "1"
    offsets: Float[Array, "2 _"]
    """Offsets of the fibres along d1 and d2 [m]."""
    name: str = static(default="strain gauge")

    def measure(self, scene: LoadedRod, state: RodState) -> Float[Array, "*k"]:
        """Elongation of the fibres over their length in the unstressed rod."""
        stations = stations_of(scene.rod, self.arc_length)
        strain, curvature = _strains(scene, state)
        rest = (
            vectors.split(scene.rod.rest_strains),
            vectors.split(scene.rod.rest_curvatures),
        )
        now = self._stretch(stations, strain, curvature)
        ratio = now / self._stretch(stations, *rest)
        return (ratio - 1).reshape(self.arc_length.shape)

    def _stretch(self, stations: Stations, strain: Vec3, curvature: Vec3) -> Array:
        """Length of the fibres per length of the rod [1]."""
        x, y, z = stations.elements.of_vectors(strain)
        bend = stations.joints.of_vectors(curvature)
        offset = in_section(self.offsets, x)
        return vectors.safe_norm(
            vectors.add((x, y, 1 + z), vectors.cross(bend, offset))
        )


@pytree
class SectionCurvature(StationSensor):
    """Curvature and twist at stations; see `section_curvature`.

    Example:
        >>> bends = sensors.section_curvature([0.25, 0.5, 0.75])
        >>> bends.shape(scene), bends.unit
        ((3, 3), '1/m')
    """

    unit: ClassVar[str] = "1/m"
    name: str = static(default="curvature")

    def measure(self, scene: LoadedRod, state: RodState) -> Float[Array, "3 *k"]:
        """Curvature about d1 and d2, and twist, material frame."""
        stations = stations_of(scene.rod, self.arc_length)
        _, curvature = _strains(scene, state)
        return self.placed(stations.joints.of_vectors(curvature))


@pytree
class SectionForce(StationSensor):
    """Force through sections; see `section_force`.

    Example:
        >>> cell = sensors.section_force([0.25, 0.75])
        >>> cell.shape(scene), cell.unit
        ((3, 2), 'N')
    """

    unit: ClassVar[str] = "N"
    name: str = static(default="section force")

    def measure(self, scene: LoadedRod, state: RodState) -> Float[Array, "3 *k"]:
        """Shear forces along d1 and d2, and tension, material frame."""
        stations = stations_of(scene.rod, self.arc_length)
        law = elastic_law(scene.rod)
        strain, _ = _strains(scene, state)
        stress = vectors.multiply(
            law.shear_stretch, vectors.subtract(strain, law.rest_strains)
        )
        return self.placed(stations.elements.of_vectors(stress))


@pytree
class SectionMoment(StationSensor):
    """Moment through sections; see `section_moment`.

    Example:
        >>> cell = sensors.section_moment([0.25, 0.75])
        >>> cell.shape(scene), cell.unit
        ((3, 2), 'N m')
    """

    unit: ClassVar[str] = "N m"
    name: str = static(default="section moment")

    def measure(self, scene: LoadedRod, state: RodState) -> Float[Array, "3 *k"]:
        """Bending moments about d1 and d2, and torque, material frame."""
        stations = stations_of(scene.rod, self.arc_length)
        rod = scene.rod
        _, curvature = _strains(scene, state)
        bent = vectors.subtract(curvature, vectors.split(rod.rest_curvatures))
        moment = vectors.multiply(vectors.split(rod.joint_stiffness), bent)
        return self.placed(stations.joints.of_vectors(moment))


def strain_gauge(arc_length: Numbers, offsets: Numbers = (0.0, 0.0)) -> StrainGauge:
    """Strain of a fibre glued to a rod: a strain gauge, or a fibre Bragg grating.

    It is positive where the fibre is longer than in the unstressed rod. The fibre keeps
    its offset in the section, so it follows twist.

    Args:
        arc_length: Arc length of the station in the unstressed rod, one number or
            `(k,)` [m].
        offsets: Offset from the centreline along d1 and d2 `(2,)`, or one per station
            `(k, 2)` [m].

    Returns:
        A sensor that reads one number per station [1].

    Raises:
        ValueError: If a number is out of range or of the wrong shape.

    Example:
        >>> longer = replace(state, positions=1.01 * state.positions)  # by 1 %
        >>> round(float(sensors.strain_gauge(0.5, (0.02, 0.0)).read(scene, longer)), 4)
        0.01
    """
    stations = as_stations(arc_length)
    return StrainGauge(stations, as_offsets(offsets, stations))


def section_curvature(arc_length: Numbers) -> SectionCurvature:
    """Curvature and twist of the section, as `jaxrod.strains` gives them at joints.

    Args:
        arc_length: Arc length of the station, one number or `(k,)` [m].

    Returns:
        A sensor that reads three components per station, material frame [1/m].

    Raises:
        ValueError: If a number is out of range or of the wrong shape.

    Example:
        >>> angle = jnp.linspace(0.0, 1.0, 11)  # an arc of radius 1 m
        >>> arc = jnp.stack([jnp.sin(angle), 0.0 * angle, jnp.cos(angle)])
        >>> _, bent = jaxrod.rod_along(arc, radius=0.02, density=1, youngs_modulus=1)
        >>> curvature = sensors.section_curvature(0.5).read(scene, bent)
        >>> round(float(jnp.linalg.norm(curvature)), 2)  # one over the radius [1/m]
        1.0
    """
    return SectionCurvature(as_stations(arc_length))


def section_force(arc_length: Numbers) -> SectionForce:
    """Force that the material of a rod transmits through a section.

    The part beyond the section pulls with it on the part before; tension is positive.
    Stress of actuators inside the rod (muscles, chambers) and of internal damping is
    not in it.

    Args:
        arc_length: Arc length of the section, one number or `(k,)` [m].

    Returns:
        A sensor that reads three components per station, material frame [N].

    Raises:
        ValueError: If a number is out of range or of the wrong shape.

    Example:
        >>> longer = replace(state, positions=1.01 * state.positions)  # by 1 %
        >>> force = sensors.section_force(0.5).read(scene, longer)
        >>> round(float(force[2]), 1)  # tension: 1 % of E A [N]
        12.6
    """
    return SectionForce(as_stations(arc_length))


def section_moment(arc_length: Numbers) -> SectionMoment:
    """Moment that the material transmits through a section, as in `section_force`.

    Args:
        arc_length: Arc length of the section, one number or `(k,)` [m].

    Returns:
        A sensor that reads three components per station, material frame [N m].

    Raises:
        ValueError: If a number is out of range or of the wrong shape.

    Example:
        >>> angle = jnp.linspace(0.0, 1.0, 11)  # an arc of radius 1 m
        >>> arc = jnp.stack([jnp.sin(angle), 0.0 * angle, jnp.cos(angle)])
        >>> _, bent = jaxrod.rod_along(arc, radius=0.02, density=1, youngs_modulus=1)
        >>> moment = sensors.section_moment(0.5).read(scene, bent)
        >>> round(float(jnp.linalg.norm(moment)), 3)  # E I over the radius [N m]
        0.126
    """
    return SectionMoment(as_stations(arc_length))

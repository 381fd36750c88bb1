r"""Sensors of the strain of a section, and of the force and moment it transmits.

With strain $\sigma$ and curvature $\kappa$ of the rod at a station, a unit length of
fibre at the offset $p$ in the section becomes $u = e_3 + \sigma + \kappa\times p$. Its
strain is

$$\epsilon = |u| / |u_0| - 1$$

with $u_0$ in the unstressed shape. In pure bending it is $\kappa_1 p_2 - \kappa_2
p_1$: a fibre on the inner side is compressed. The elastic material transmits the force
$S(\sigma - \sigma_0)$ and the moment $B(\kappa - \kappa_0)$, with stiffnesses $S$, $B$
and rest values $\sigma_0$, $\kappa_0$.
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
    """Shear and stretch of elements [1], and curvature and twist of joints [1/m]."""
    motion, rod = motion_of(state), scene.rod
    strain = shear_stretch(motion.edges, motion.orientation, 1 / rod.rest_lengths)
    rotation, _ = joint_rotations(motion.orientation)
    return strain, vectors.scale(1 / rod.joint_lengths, rotation)


@pytree
class StrainGauge(StationSensor):
    """Sensor of the strain along fibres at stations, made by `strain_gauge`.

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
        """Strain `|u| / |u_0| - 1` of the fibres relative to the unstressed rod [1]."""
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
        """Length `|u|` of the fibres per length of the unstressed centreline [1].

        u = e_3 + strain + curvature x offset, with `strain` of the elements and
        `curvature` of the joints interpolated to the stations.
        """
        x, y, z = stations.elements.of_vectors(strain)
        bend = stations.joints.of_vectors(curvature)
        offset = in_section(self.offsets, x)
        return vectors.safe_norm(
            vectors.add((x, y, 1 + z), vectors.cross(bend, offset))
        )


@pytree
class SectionCurvature(StationSensor):
    """Sensor of curvature and twist at stations, made by `section_curvature`.

    Example:
        >>> bends = sensors.section_curvature([0.25, 0.5, 0.75])
        >>> bends.shape(scene), bends.unit
        ((3, 3), '1/m')
    """

    unit: ClassVar[str] = "1/m"
    name: str = static(default="curvature")

    def measure(self, scene: LoadedRod, state: RodState) -> Float[Array, "3 *k"]:
        """Curvatures about d1 and d2, and twist about d3, material frame [1/m]."""
        stations = stations_of(scene.rod, self.arc_length)
        _, curvature = _strains(scene, state)
        return self.placed(stations.joints.of_vectors(curvature))


@pytree
class SectionForce(StationSensor):
    """Sensor of the elastic force through sections, made by `section_force`.

    Example:
        >>> cell = sensors.section_force([0.25, 0.75])
        >>> cell.shape(scene), cell.unit
        ((3, 2), 'N')
    """

    unit: ClassVar[str] = "N"
    name: str = static(default="section force")

    def measure(self, scene: LoadedRod, state: RodState) -> Float[Array, "3 *k"]:
        """Shear forces along d1 and d2, and tension along d3, material frame [N]."""
        stations = stations_of(scene.rod, self.arc_length)
        law = elastic_law(scene.rod)
        strain, _ = _strains(scene, state)
        stress = vectors.multiply(
            law.shear_stretch, vectors.subtract(strain, law.rest_strains)
        )
        return self.placed(stations.elements.of_vectors(stress))


@pytree
class SectionMoment(StationSensor):
    """Sensor of the elastic moment through sections, made by `section_moment`.

    Example:
        >>> cell = sensors.section_moment([0.25, 0.75])
        >>> cell.shape(scene), cell.unit
        ((3, 2), 'N m')
    """

    unit: ClassVar[str] = "N m"
    name: str = static(default="section moment")

    def measure(self, scene: LoadedRod, state: RodState) -> Float[Array, "3 *k"]:
        """Bending moments about d1 and d2, torque about d3, material frame [N m]."""
        stations = stations_of(scene.rod, self.arc_length)
        rod = scene.rod
        _, curvature = _strains(scene, state)
        bent = vectors.subtract(curvature, vectors.split(rod.rest_curvatures))
        moment = vectors.multiply(vectors.split(rod.joint_stiffness), bent)
        return self.placed(stations.joints.of_vectors(moment))


def strain_gauge(arc_length: Numbers, offsets: Numbers = (0.0, 0.0)) -> StrainGauge:
    """Makes a sensor of the strain of a fibre glued to a rod, such as a strain gauge.

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
    """Makes a sensor of curvature and twist, interpolated from `jaxrod.strains`.

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
    """Makes a sensor of the elastic force that a rod transmits through a section.

    It is the force of the part beyond the section on the part before it; tension is
    positive. It does not include actuators inside the rod (muscles, chambers) or
    internal damping.

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
    """Makes a sensor of the elastic moment that a rod transmits through a section.

    It is the moment of the part beyond the section on the part before it. It does not
    include actuators inside the rod (muscles, chambers) or internal damping.

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

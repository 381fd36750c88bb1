"""Drawing of a real arm: its design, its uncertain numbers, and its simulated scene.

The drawing is a TOML file (`read_arm`, docs/twin.md): a rod, its tendons, its markers,
the frame of the camera, and a standard deviation for every number that is not known
exactly (the unknowns).
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.actuation import tendon
from jaxrod.effects.base import Reach
from jaxrod.effects.clamps import clamp
from jaxrod.effects.loads import exponential_damping, gravity
from jaxrod.extend import Effect, Loads, Motion, pytree, rotations, vectors
from jaxrod.files import reading
from jaxrod.rods.factories import straight_rod
from jaxrod.rods.rod import Rod, RodState
from jaxrod.scene import Scene, make_scene
from jaxrod.sensors import markers
from jaxrod.validation import check_array, check_count

LOGARITHMIC = (
    "damping",
    "density",
    "eyelet_distance",
    "tension",
    "youngs_modulus",
)
"""Unknowns that are found by their logarithms; their standard deviations are those of
the logarithms."""

UNKNOWNS = {
    "damping": "decay rate of velocities, of motions alone [1/s]",
    "delay": "time by which the arm lags behind the recorded inputs [s]",
    "density": "mass per volume [kg/m^3]",
    "eyelet_distance": "factor of the distances of the eyelets from the axis [1]",
    "eyelet_slope": "further change of these distances with arc length [1]",
    "friction": "coefficient of friction at the eyelets [1]",
    "marker_masses": "mass of each marker [kg]",
    "modulus_slope": "logarithm of the modulus at the tip over that at the base [1]",
    "poisson_ratio": "Poisson's ratio [1]",
    "rest_curvature": "curvatures about d1 and d2 without loads [1/m]",
    "shift": "place of the arm in the registered frame of the camera [m]",
    "tendon_angles": "change of the angle of each tendon around the axis [rad]",
    "tension": "factor of all tensions [1]",
    "turn": "rotation of the arm in that frame, as a vector [rad]",
    "youngs_modulus": "Young's modulus, halfway along the arm [Pa]",
}
"""Meaning and unit of every number that may be unknown and found by a fit."""


@dataclass(frozen=True)
class TendonDrawing:
    """Design of one tendon: the recorded input that pulls it, and its path.

    Example:
        >>> drawn = twin.TendonDrawing("motor", np.pi / 2, 0.01, pulley_radius=0.02)
        >>> drawn.input, drawn.until is None  # it ends at the tip
        ('motor', True)
    """

    input: str
    """Name of the recorded input that pulls the tendon."""
    angle: float
    """Angle of the tendon around the axis, from d1 towards d2 [rad]."""
    distance: Any
    """Distance of the tendon from the axis: a number, or pairs of arc length and
    distance [m]."""
    pulley_radius: float | None = None
    """Radius of the pulley [m], if the input is a torque (tension = torque / radius);
    `None` if the input is the tension."""
    until: float | None = None
    """Arc length at which the tendon ends [m]; `None` for the tip."""


@dataclass(frozen=True)
class Marker:
    """A point, seen by the camera, that is fixed to a section of the arm.

    Example:
        >>> middle = twin.Marker("middle", at=0.15, offset=(0.0, 0.02, 0.0))
        >>> middle.name, middle.at
        ('middle', 0.15)
    """

    name: str
    """Name of the marker; recordings have columns `NAME_x`, `NAME_y`, `NAME_z`."""
    at: float
    """Arc length of the section [m]."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Offset from the axis along d1, d2, d3 [m]."""


@dataclass(frozen=True)
class Frame:
    """Frame and unit of the recorded coordinates of markers.

    Raises:
        ValueError: If a number is out of range, or an origin is given without axes.

    Example:
        >>> frame = twin.Frame(axes=[[0, 1, 0], [-1, 0, 0], [0, 0, 1]], scale=1e-3)
        >>> frame.scale, frame.origin is None  # millimetres; the base is not known
        (0.001, True)
    """

    axes: Any = None
    """Rotation matrix from the recorded frame to the arm's frame `(3, 3)`; `None` if it
    is not known."""
    origin: str | tuple[float, float, float] | None = None
    """Recorded coordinates of the base of the arm, in recorded units; or the name of a
    marker that never moves from its position on the straight arm; `None` if neither is
    known."""
    scale: float = 1.0
    """Length of a recorded unit [m]."""

    def __post_init__(self) -> None:
        """Validates the ranges of all fields."""
        check_array("scale of the frame", self.scale, [()], "m", positive=True)
        if self.axes is not None:
            axes = np.asarray(
                check_array("axes of the frame", self.axes, [(3, 3)], ""), float
            )
            products = np.sum(axes[:, None] * axes[None], axis=-1)
            if not np.allclose(products, np.eye(3), atol=1e-3):
                raise ValueError(
                    "axes of the frame must be three unit vectors at right angles, got "
                    f"{self.axes!r}"
                )
            if np.linalg.det(axes) < 0:
                raise ValueError(
                    "axes of the frame must be right-handed, but these are not: "
                    f"{self.axes!r}"
                )
        if self.origin is not None and not isinstance(self.origin, str):
            check_array("origin of the frame", self.origin, [(3,)], "recorded units")
            if self.axes is None:
                raise ValueError(
                    "an origin of the frame needs its axes, unless it is a marker"
                )


@dataclass(frozen=True, eq=False)
class Arm:
    """Design of a real arm, with standard deviations of its unknowns; see `read_arm`.

    Methods take values of the unknowns as a dict by name.

    Example:
        >>> drawn = twin.Arm(
        ...     elements=4,
        ...     length=0.3,
        ...     radius=0.01,
        ...     density=1100.0,
        ...     youngs_modulus=4e5,
        ...     poisson_ratio=0.45,
        ...     direction=(0.0, 0.0, -1.0),
        ...     normal=(0.0, 1.0, 0.0),
        ...     gravity=(0.0, 0.0, -9.81),
        ...     tendons=(twin.TendonDrawing("pull", angle=0.0, distance=0.008),),
        ...     markers=(twin.Marker("tip", at=0.3),),
        ...     unknown={"youngs_modulus": 0.5},
        ... )
        >>> drawn.inputs, float(drawn.start["youngs_modulus"])
        (('pull',), 400000.0)
    """

    elements: int
    """Number of elements of the rod, at least 3."""
    length: float
    """Length of the rod [m]."""
    radius: Any
    """Radius of the rod: a number, or pairs of arc length and radius [m]."""
    density: float
    """Mass per volume [kg/m^3]."""
    youngs_modulus: float
    """Young's modulus [Pa]."""
    poisson_ratio: float
    """Poisson's ratio [1]."""
    direction: tuple[float, float, float]
    """Direction from base to tip of the straight arm, in the arm's frame."""
    normal: tuple[float, float, float]
    """Direction of d1 of the straight arm, in the arm's frame."""
    gravity: tuple[float, float, float]
    """Gravitational acceleration in the arm's frame [m/s^2]."""
    tendons: tuple[TendonDrawing, ...]
    markers: tuple[Marker, ...]
    unknown: Mapping[str, float]
    """Standard deviation of each unknown in the drawing, before measurements: of its
    logarithm if it is in `LOGARITHMIC`, else in the unit of the unknown."""
    damping: float = 1.0
    """Decay rate of velocities by damping [1/s]."""
    friction: float = 0.0
    """Coefficient of friction between tendons and eyelets [1]."""
    frame: Frame = field(default_factory=Frame)
    topics: Mapping[str, str] = field(default_factory=dict)
    """Topic and field of each input and marker in bags, "TOPIC:FIELD" by name; see
    `read_recording`."""

    def __post_init__(self) -> None:
        """Validates the ranges of all fields, and names of unknowns and markers.

        Raises:
            ValueError: If a number is out of range, or a name is not known.
        """
        check_count("elements", self.elements, 3)
        for name in ("length", "density", "youngs_modulus"):
            check_array(name, getattr(self, name), [()], "", positive=True)
        for name in ("damping", "friction"):
            check_array(name, getattr(self, name), [()], "", non_negative=True)
        for name in ("direction", "normal", "gravity"):
            check_array(name, getattr(self, name), [(3,)], "")
        self._along("radius", self.radius)
        if not self.markers:
            raise ValueError("an arm needs at least one marker")
        if not -1 < self.poisson_ratio <= 0.5:
            raise ValueError(
                f"poisson_ratio must be above -1 and at most 0.5, got "
                f"{self.poisson_ratio!r}"
            )
        if "damping" in self.unknown and self.damping == 0:
            raise ValueError("damping is unknown: it must be above 0 1/s, got 0.0 1/s")
        names = [marker.name for marker in self.markers]
        if not all(isinstance(name, str) and name for name in names):
            raise ValueError(f"names of markers must be text, got {names}")
        if len(set(names)) < len(names):
            raise ValueError(f"markers must have different names, got {names}")
        for marker in self.markers:
            self._check_place(f"marker {marker.name!r}: at", marker.at)
            check_array(f"marker {marker.name!r}: offset", marker.offset, [(3,)], "m")
        for tendon_ in self.tendons:
            self._along("distance of a tendon", tendon_.distance)
            if tendon_.pulley_radius is not None:
                radius = tendon_.pulley_radius
                check_array("pulley_radius", radius, [()], "m", positive=True)
            if tendon_.until is not None:
                self._check_place("until of a tendon", tendon_.until)
        for name, sd in self.unknown.items():
            if name not in UNKNOWNS:
                raise ValueError(
                    f"unknown {name!r} is not one of {', '.join(sorted(UNKNOWNS))}"
                )
            check_array(f"standard deviation of {name}", sd, [()], "", positive=True)
        origin = self.frame.origin
        if isinstance(origin, str) and origin not in names:
            raise ValueError(
                f"origin of the frame must be a point or a marker, got {origin!r}"
            )
        if not isinstance(self.topics, Mapping):
            raise ValueError(f"topics must be a table, got {self.topics!r}")
        for name, topic in self.topics.items():
            if not isinstance(topic, str):
                raise ValueError(f"the topic of {name!r} must be text, got {topic!r}")

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the recorded inputs that pull the tendons, without repetition."""
        return tuple(dict.fromkeys(t.input for t in self.tendons))

    @property
    def start(self) -> dict[str, Array]:
        """Value of every possible unknown according to the drawing, by name."""
        numbers = {
            "damping": self.damping,
            "delay": 0.0,
            "density": self.density,
            "eyelet_distance": 1.0,
            "eyelet_slope": 0.0,
            "friction": self.friction,
            "marker_masses": np.zeros(len(self.markers)),
            "modulus_slope": 0.0,
            "poisson_ratio": self.poisson_ratio,
            "rest_curvature": np.zeros(2),
            "shift": np.zeros(3),
            "tendon_angles": np.zeros(len(self.tendons)),
            "tension": 1.0,
            "turn": np.zeros(3),
            "youngs_modulus": self.youngs_modulus,
        }
        return {name: jnp.asarray(value, float) for name, value in numbers.items()}

    @property
    def origin(self) -> int | None:
        """Index of the marker that is the origin of the frame; `None` if none is."""
        names = [marker.name for marker in self.markers]
        given = self.frame.origin
        return names.index(given) if isinstance(given, str) else None

    def scene(
        self, values: Mapping[str, Any], tensions: Callable[..., Any]
    ) -> tuple[Scene, RodState]:
        """Makes the arm's scene, with gravity and tendons, and its straight state.

        Args:
            values: Values of all unknowns by name, as in `start`.
            tensions: Takes an array of indices of tendons; returns their tensions, or a
                schedule of them [N].
        """
        middles = self._middles
        rod, state = straight_rod(
            self.elements,
            length=self.length,
            radius=self._along("radius", self.radius),
            density=values["density"],
            youngs_modulus=values["youngs_modulus"]
            * jnp.exp(values["modulus_slope"] * (middles / self.length - 0.5)),
            poisson_ratio=values["poisson_ratio"],
            direction=self.direction,
            normal=self.normal,
        )
        bent = jnp.pad(values["rest_curvature"], (0, 1))[:, None]
        masses = values["marker_masses"] @ self._placed
        rod = replace(
            rod,
            rest_curvatures=rod.rest_curvatures + bent,
            linear_density=rod.linear_density + masses / rod.rest_lengths,
        )
        pull = jnp.asarray(self.gravity, rod.rest_lengths.dtype)
        effects: list[Any] = [clamp(state), gravity(pull)]
        effects.append(exponential_damping(values["damping"]))
        if "marker_masses" in self.unknown:
            effects.append(self._weights(values["marker_masses"], pull))
        ends = [self._last_eyelet(drawn) for drawn in self.tendons]
        for last in sorted(set(ends)):
            alike = [k for k, end in enumerate(ends) if end == last]
            effects.append(self._tendons(rod, alike, last, values, tensions))
        return make_scene(rod, *effects), state

    def points(
        self, scene: Scene, state: RodState, values: Mapping[str, Any]
    ) -> Float[Array, "markers 3"]:
        """Positions of the markers in the registered frame of the camera [m].

        They are R x + s with the positions x in the arm's frame, the rotation R by the
        vector `turn` [rad] and the displacement s, `shift` [m], both in `values`.
        """
        places = [marker.at for marker in self.markers]
        sensor = markers(places, [marker.offset for marker in self.markers])
        turn = rotations.rotation_exp(vectors.split(values["turn"]))
        seen = vectors.split(sensor.measure(scene, state))
        x, y, z = rotations.to_world(rotations.directors(turn), seen)
        return jnp.stack([x, y, z], axis=1) + values["shift"][None]

    @property
    def straight(self) -> Float[np.ndarray, "markers 3"]:
        """Positions of the markers of the straight arm, as drawn [m]."""
        scene, state = self.scene(self.start, lambda numbers: jnp.zeros(len(numbers)))
        return np.asarray(self.points(scene, state, self.start))

    @property
    def shift(self) -> np.ndarray | None:
        """Position of the recorded zero point in the arm's frame [m].

        It is `None` if the frame's axes or origin are not known, or the origin is a
        marker.
        """
        axes, origin = self.frame.axes, self.frame.origin
        if axes is None or origin is None or self.origin is not None:
            return None
        point = self.frame.scale * np.asarray(origin, float)
        return -np.sum(np.asarray(axes, float) * point, axis=-1)

    def tensions(self, values: Mapping[str, Any], inputs: Any) -> Any:
        """Tensions of the tendons `(..., tendons)` [N], from the recorded inputs.

        A tension is its input, divided by the radius if there is a pulley, times the
        unknown `tension` in `values`. `inputs` is `(..., inputs)`.
        """
        if not self.tendons:
            return jnp.zeros((*inputs.shape[:-1], 0))
        columns = [self.inputs.index(t.input) for t in self.tendons]
        given = [t.pulley_radius for t in self.tendons]
        radii = [1.0 if radius is None else radius for radius in given]
        drawn = jnp.stack(
            [inputs[..., k] / radius for k, radius in zip(columns, radii, strict=True)],
            axis=-1,
        )
        return values["tension"] * drawn

    def _last_eyelet(self, drawn: TendonDrawing) -> int:
        """Index of the last element along which the tendon `drawn` runs."""
        end = self.length if drawn.until is None else drawn.until
        return max(1, int(np.sum(self._middles < end)) - 1)

    def _tendons(
        self,
        rod: Rod,
        numbers: list[int],
        last: int,
        values: Mapping[str, Any],
        tensions: Callable[..., Any],
    ) -> Effect:
        """Makes the effect of tendons that end at element `last`.

        `numbers` are the indices of the tendons, `values` the values of the unknowns,
        and `tensions` is a function as in `scene`.
        """
        drawn = [self.tendons[k] for k in numbers]
        distances = [self._along("distance of a tendon", t.distance) for t in drawn]
        distance = values["eyelet_distance"] * np.stack(distances)[:, : last + 1]
        distance += values["eyelet_slope"] * self._middles[None, : last + 1]
        angles = np.array([t.angle for t in drawn])
        angles = (angles + values["tendon_angles"][np.array(numbers)])[:, None]
        offsets = [jnp.cos(angles) * distance, jnp.sin(angles) * distance]
        rubs = self.friction > 0 or "friction" in self.unknown
        return tendon(
            rod,
            jnp.stack(offsets, axis=1),
            tension=tensions(np.array(numbers)),
            elements=(0, last),
            friction=values["friction"] if rubs else None,
            friction_at_rest=1.0 if rubs else None,
        )

    def _weights(self, masses: Array, pull: Array) -> MarkerWeights:
        """Builds the couples of the markers' weights about the element midpoints.

        `masses` are the masses of the markers [kg], `pull` is the gravitational
        acceleration [m/s^2].
        """
        offsets = np.array([marker.offset for marker in self.markers], float)
        ahead = (np.array(self._places[1]) - 0.5) * self.length / self.elements
        offsets[:, 2] += ahead
        placed = jnp.asarray(self._placed, pull.dtype)
        return MarkerWeights(masses[:, None] * offsets, pull, placed)

    @property
    def _middles(self) -> np.ndarray:
        """Arc-length positions of the element midpoints [m]."""
        return (np.arange(self.elements) + 0.5) * self.length / self.elements

    @property
    def _places(self) -> tuple[list[int], list[float]]:
        """Element of each marker, and position on it from 0 to 1 along its length."""
        along = [m.at / self.length * self.elements for m in self.markers]
        elements = [min(int(x), self.elements - 1) for x in along]
        return elements, [x - k for x, k in zip(along, elements, strict=True)]

    @property
    def _placed(self) -> np.ndarray:
        """Matrix: one where a marker (row) is on an element (column), else zero."""
        return np.eye(self.elements)[self._places[0]]

    def _along(self, name: str, given: Any) -> np.ndarray:
        """Validates a quantity, and returns its values at the element midpoints.

        `given` is a positive number, or pairs of arc length [m] and number, between
        which it interpolates linearly. `name` is the quantity's name in error messages.
        """
        table = np.asarray(given, float)
        if table.ndim == 0:
            table = np.array([[0.0, float(table)]])
        if table.ndim != 2 or table.shape[1] != 2 or not np.isfinite(table).all():
            raise ValueError(
                f"{name} must be a number, or pairs of arc length and number in m, got "
                f"{given!r}"
            )
        if not np.all(np.diff(table[:, 0]) > 0):
            raise ValueError(f"arc lengths of {name} must increase, got {given!r}")
        if not np.all(table[:, 1] > 0):
            raise ValueError(f"{name} must be positive everywhere, got {given!r}")
        return np.interp(self._middles, table[:, 0], table[:, 1])

    def _check_place(self, name: str, value: float) -> None:
        check_array(name, value, [()], "m", non_negative=True)
        if value > self.length:
            raise ValueError(
                f"{name} must be on the arm of {self.length} m, got {value} m"
            )


@pytree
class MarkerWeights(Effect):
    """Couples of the weights of markers about the midpoints of their elements.

    The masses of the markers are part of the mass of the elements, whose weights are
    those of `gravity`.
    """

    reach: ClassVar[Reach] = "neighbours"

    levers: Float[Array, "markers 3"]
    """Mass of each marker times its offset from its element's midpoint, along d1, d2
    and d3 [kg m]."""
    acceleration: Float[Array, "3"]
    """Gravitational acceleration [m/s^2]."""
    placed: Float[Array, "markers n"]
    """Matrix: one where a marker (row) is on an element (column), else zero."""

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Couples on the elements, lever cross gravity, material frame [N m]."""
        x, y, z = (jnp.sum(self.placed * row[:, None], 0) for row in self.levers.T)
        n = rod.n_elements
        pull = vectors.split(jnp.broadcast_to(self.acceleration[:, None], (3, n)))
        turned = rotations.to_material(rotations.directors(motion.orientation), pull)
        return Loads(couples=vectors.cross((x, y, z), turned))

    def energy(self, rod: Rod, state: RodState) -> Array:
        """Potential energy of the couples [J].

        It is the energy of the weights at the markers, minus the energy of the same
        weights at the element midpoints.
        """
        x, y, z = (jnp.sum(self.placed * row[:, None], 0) for row in self.levers.T)
        frame = rotations.directors(rotations.split_quaternion(state.orientations))
        moved = rotations.to_world(frame, (x, y, z))
        places = jnp.stack([jnp.sum(part) for part in moved])
        return -jnp.sum(self.acceleration * places)


def read_arm(path: str | Path) -> Arm:
    """Reads the drawing of an arm from a TOML file.

    Args:
        path: Path of the file; docs/twin.md shows one with all entries.

    Raises:
        DamagedFileError: If the file is not TOML, lacks an entry, has one that is not
            allowed, or a number is out of range; the message names the file.
        OSError: If the file cannot be opened.

    Example:
        >>> from pathlib import Path
        >>> size = Path("arm.toml").write_text('''
        ... [rod]
        ... elements = 6
        ... length = 0.3
        ... radius = [[0, 0.015], [0.3, 0.008]]
        ... density = 1100
        ... youngs_modulus = 4e5
        ... poisson_ratio = 0.45
        ... direction = [0, 0, -1]
        ... normal = [0, 1, 0]
        ... [[markers]]
        ... name = "tip"
        ... at = 0.3
        ... [unknown]
        ... youngs_modulus = 0.5
        ... ''')
        >>> arm = twin.read_arm("arm.toml")
        >>> arm.length, arm.markers[0].name, arm.unknown
        (0.3, 'tip', {'youngs_modulus': 0.5})
    """
    file = Path(path)
    with reading(file):
        content = tomllib.loads(file.read_text(encoding="utf-8"))
        return _arm(content)


def _arm(content: dict[str, Any]) -> Arm:
    rod = _taken(
        content.get("rod", {}),
        "rod",
        needed=(
            "elements", "length", "radius", "density", "youngs_modulus",
            "poisson_ratio", "direction", "normal",
        ),
        allowed=("damping", "friction", "gravity"),
    )  # fmt: skip
    rod.setdefault("gravity", (0.0, 0.0, -9.81))
    for name in ("tendons", "markers"):
        if not isinstance(content.get(name, []), list):
            raise ValueError(f"{name} must be a list of tables: write [[{name}]]")
    tendons = []
    for entry in content.get("tendons", []):
        made = _taken(
            entry, "tendons", ("input", "angle", "distance"), ("pulley_radius", "until")
        )
        made["angle"] = float(np.radians(made["angle"]))
        tendons.append(TendonDrawing(**made))
    seen = [
        Marker(**_taken(entry, "markers", ("name", "at"), ("offset",)))
        for entry in content.get("markers", [])
    ]
    frame = _taken(content.get("frame", {}), "frame", (), ("axes", "origin", "scale"))
    allowed = ("tendons", "frame", "topics")
    _taken(content, "the file", ("rod", "markers", "unknown"), allowed)
    return Arm(
        **rod,
        tendons=tuple(tendons),
        markers=tuple(seen),
        unknown=dict(content["unknown"]),
        frame=Frame(**frame),
        topics=content.get("topics", {}),
    )


def _taken(
    content: Mapping[str, Any],
    where: str,
    needed: tuple[str, ...],
    allowed: tuple[str, ...],
) -> dict[str, Any]:
    """Validates the names in the TOML table `content`, and returns its entries.

    `where` is the name of the table in error messages.
    """
    if not isinstance(content, Mapping):
        raise ValueError(f"{where} must be a table, got {content!r}")
    for name in needed:
        if name not in content:
            raise ValueError(f"{where} has no {name!r}")
    for name in content:
        if name not in needed + allowed:
            raise ValueError(
                f"{where} has {name!r}, which is not one of "
                f"{', '.join(sorted(needed + allowed))}"
            )
    return dict(content)

"""Robot arms from URDF or MJCF files: differentiable kinematics that drive rod ends."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.effects.driven import Driven
from jaxrod.effects.ends import End
from jaxrod.effects.paths import Placed, Turned, place_and_rates, schedule_of
from jaxrod.effects.supports import axes_named, node_of
from jaxrod.effects.time import Clock, Schedule, clock_at
from jaxrod.geometry import vectors
from jaxrod.geometry.material_frames import unit_vector
from jaxrod.geometry.rotations import (
    Quaternion,
    conjugate,
    directors,
    join_quaternion,
    multiply_quaternions,
    normalise,
    split_quaternion,
    to_material,
    to_world,
)
from jaxrod.geometry.vectors import Vec3
from jaxrod.rods.rod import RodState, check_one
from jaxrod.structure import pytree, static
from jaxrod.validation import Numbers, as_array, check_kind

_TELLING = 0.739
"""Coordinates that look like no others, in checks that motion stays in a plane."""


@pytree
class RobotArm:
    r"""A chain of rigid links from a base to one link, the hand.

    With the coordinates $q$, the frame of the hand is the product of fixed
    displacements $F_k$ and joint displacements $J_k(q_k)$,

    $$T(q) = F_0 J_0(q_0) F_1 J_1(q_1) \cdots F_n.$$

    A hinge turns by $q_k$ minus its reference about its axis, and a slide shifts along
    it. All numbers are traced, so derivatives with respect to the geometry work too.

    Example:
        >>> arm = jaxrod.RobotArm(
        ...     places=jnp.array([[0.0, 0.0, 0.5], [0.25, 0.0, 0.0]]),
        ...     turns=jnp.array([[1.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]]),
        ...     axes=jnp.array([[0.0, 0.0, 1.0]]),
        ...     references=jnp.zeros(1),
        ...     lower=jnp.array([-2.0]),
        ...     upper=jnp.array([2.0]),
        ...     joints=("shoulder",),
        ...     slides=(False,),
        ... )
        >>> position, orientation = arm.pose(jnp.array([jnp.pi / 2]))
        >>> position.round(3).tolist()
        [0.0, 0.25, 0.5]
    """

    places: Float[Array, "joints+1 3"]
    """Place of each joint, and at last of the hand, in the frame before it [m]."""
    turns: Float[Array, "joints+1 4"]
    """Orientations of these frames in the ones before, unit quaternions (w, x, y,
    z)."""
    axes: Float[Array, "joints 3"]
    """Unit vector along each joint, in its own frame."""
    references: Float[Array, " joints"]
    """Coordinates at which the joints do nothing [rad, m]."""
    lower: Float[Array, " joints"]
    """Smallest coordinates; minus infinity without a limit [rad, m]."""
    upper: Float[Array, " joints"]
    """Largest coordinates; infinity without a limit [rad, m]."""
    joints: tuple[str, ...] = static()
    """Names of the joints, from the base to the hand."""
    slides: tuple[bool, ...] = static()
    """Whether each joint is a slide; the others are hinges."""

    def pose(
        self, coordinates: Float[Array, " joints"]
    ) -> tuple[Float[Array, "3"], Float[Array, "4"]]:
        """Position and orientation of the hand.

        Args:
            coordinates: Coordinates of the joints [rad, m].

        Returns:
            Its position in the world [m], and the unit quaternion (w, x, y, z) from its
            frame to the world.

        Example:
            >>> with open("crane.xml", "w") as file:
            ...     _ = file.write('''<mujoco><worldbody><body name="hook">
            ...         <joint name="lift" type="slide" axis="0 0 1"/>
            ...     </body></worldbody></mujoco>''')
            >>> arm = jaxrod.robot_arm("crane.xml", "hook")
            >>> arm.pose(jnp.array([0.25]))[0].tolist()
            [0.0, 0.0, 0.25]
        """
        moves = jnp.asarray(coordinates) - self.references
        zero, one = jnp.zeros_like(self.places[0, 0]), jnp.ones_like(self.places[0, 0])
        place: Vec3 = (zero, zero, zero)
        turn: Quaternion = (one, zero, zero, zero)
        for k in range(len(self.joints) + 1):
            step = vectors.split(self.places[k])
            place = vectors.add(place, to_world(directors(turn), step))
            turn = multiply_quaternions(turn, split_quaternion(self.turns[k]))
            if k == len(self.joints):
                break
            axis = vectors.split(self.axes[k])
            if self.slides[k]:
                way = vectors.scale(moves[k], axis)
                place = vectors.add(place, to_world(directors(turn), way))
            else:
                half = 0.5 * moves[k]
                x, y, z = vectors.scale(jnp.sin(half), axis)
                turn = multiply_quaternions(turn, (jnp.cos(half), x, y, z))
        return vectors.join(place), join_quaternion(turn)

    def hold(
        self,
        state: RodState,
        coordinates: Schedule | Numbers,
        end: End | int = "base",
        *,
        axes: str = "xyz",
        free_to_turn: bool = False,
        holds_element: bool = False,
    ) -> Driven:
        """Drives an end of a rod with the hand, as if they were glued together.

        The grip is that of `state` at time zero: the end keeps its place in the frame
        of the hand. `jaxrod.reactions` gives the force, couple and power of the hand.

        Args:
            state: The state of the rod at time zero.
            coordinates: Coordinates of the joints `(joints,)`, or a schedule of them
                [rad, m].
            end: The end that is held; or the index of an inner node, as in `driven`.
            axes: World axes along which it is driven; along the others it is free.
            free_to_turn: Whether the end element turns freely, as on a ball joint.
            holds_element: Whether the hand holds the end element itself, as
                `jaxrod.fixed_end` does, and not through an elastic joint, as
                `jaxrod.clamp` does.

        Raises:
            ValueError: If an argument is out of range.
            TypeError: If `state` is not a `RodState`.

        Example:
            >>> with open("crane.xml", "w") as file:
            ...     _ = file.write('''<mujoco><worldbody><body name="hook">
            ...         <joint name="lift" type="slide" axis="0 0 1"/>
            ...     </body></worldbody></mujoco>''')
            >>> arm = jaxrod.robot_arm("crane.xml", "hook")
            >>> up = schedules.ramp(jnp.zeros(1), jnp.array([0.25]), duration=2.0)
            >>> scene = jaxrod.make_scene(rod, arm.hold(state, up))
            >>> scene.at(2.0).effects[0].place.position.tolist()
            [0.0, 0.0, 0.25]
        """
        check_kind("state", state, RodState)
        check_one(state)
        index, last = node_of(state, end, "end"), state.positions.shape[-1] - 1
        if end not in ("base", "tip") and not free_to_turn:
            raise ValueError(
                f"node {index} is inside the rod, where no hand holds an element: give "
                "free_to_turn=True"
            )
        shape = (len(self.joints),)
        moves = schedule_of("coordinates", coordinates, "rad or m", shape)
        begun = moves(clock_at(0.0, state.positions.dtype))
        place, turn = self.pose(begun)
        hand = split_quaternion(turn)
        away = vectors.split(state.positions[:, index] - place)
        grip = vectors.join(to_material(directors(hand), away))
        carried = CarriedPlace(self, moves, grip)
        along = axes_named(axes)
        if free_to_turn:
            return Driven(carried, None, end, along, made_for=last)
        element = split_quaternion(state.orientations[:, min(index, last - 1)])
        held = join_quaternion(multiply_quaternions(conjugate(hand), element))
        wall = CarriedTurn(self, moves, held)
        return Driven(carried, wall, end, along, bool(holds_element), last)


@pytree
class CarriedPlace(Schedule):
    """Schedule of a position that a hand carries."""

    arm: RobotArm
    coordinates: Any
    """Schedule of the coordinates of the joints [rad, m]."""
    grip: Float[Array, "3"]
    """Position in the frame of the hand [m]."""

    def __call__(self, clock: Clock) -> Placed:
        """Position, velocity and acceleration at the time of a clock."""
        hand = _moving(self.arm, place_and_rates(self.coordinates, clock))
        end = hand.beside(vectors.split(self.grip))
        return Placed(*map(vectors.join, (end.place, end.velocity, end.acceleration)))

    @property
    def largest(self) -> Placed:
        """Position for checks that motion stays in a plane, see `Turning.largest`."""
        place, turn = self.arm.pose(_telling(self.coordinates))
        frame = directors(split_quaternion(turn))
        away = vectors.join(to_world(frame, vectors.split(self.grip)))
        still = jnp.zeros_like(place)
        return Placed(place + away, still, still)


@pytree
class CarriedTurn(Schedule):
    """Schedule of an orientation that a hand carries."""

    arm: RobotArm
    coordinates: Any
    """Schedule of the coordinates of the joints [rad, m]."""
    grip: Float[Array, "4"]
    """Orientation in the frame of the hand, unit quaternion (w, x, y, z)."""

    def __call__(self, clock: Clock) -> Turned:
        """Orientation, angular velocity and acceleration at the time of a clock."""
        hand = _moving(self.arm, place_and_rates(self.coordinates, clock))
        spin, faster = vectors.join(hand.spin), vectors.join(hand.faster)
        return Turned(self._held(hand.turn), spin, faster)

    @property
    def largest(self) -> Turned:
        """Orientation for checks that motion stays in a plane; the rates are zero."""
        turn = split_quaternion(self.arm.pose(_telling(self.coordinates))[1])
        still = jnp.zeros_like(self.grip[:3])
        return Turned(self._held(turn), still, still)

    def _held(self, hand: Quaternion) -> Array:
        held = multiply_quaternions(hand, split_quaternion(self.grip))
        return join_quaternion(normalise(held))


class _Frame(NamedTuple):
    """A frame that moves: world components of its place, its turn and their rates."""

    place: Vec3
    turn: Quaternion
    velocity: Vec3
    spin: Vec3
    acceleration: Vec3
    faster: Vec3

    def beside(self, offset: Vec3) -> _Frame:
        """The same frame at another of its points."""
        way = to_world(directors(self.turn), offset)
        across = vectors.cross(self.spin, way)
        inward = vectors.cross(self.spin, across)
        bent = vectors.add(vectors.cross(self.faster, way), inward)
        return self._replace(
            place=vectors.add(self.place, way),
            velocity=vectors.add(self.velocity, across),
            acceleration=vectors.add(self.acceleration, bent),
        )

    def swung(self, axis: Vec3, angle: Array, rate: Array, faster: Array) -> _Frame:
        """The frame behind a hinge."""
        along = to_world(directors(self.turn), axis)
        half = 0.5 * angle
        x, y, z = vectors.scale(jnp.sin(half), axis)
        carried = vectors.cross(self.spin, vectors.scale(rate, along))
        own = vectors.add(vectors.scale(faster, along), carried)
        return self._replace(
            turn=multiply_quaternions(self.turn, (jnp.cos(half), x, y, z)),
            spin=vectors.add(self.spin, vectors.scale(rate, along)),
            faster=vectors.add(self.faster, own),
        )

    def slid(self, axis: Vec3, way: Array, rate: Array, faster: Array) -> _Frame:
        """The frame behind a slide."""
        there = self.beside(vectors.scale(way, axis))
        along = to_world(directors(self.turn), axis)
        # Coriolis: the slide turns with the frame while it moves.
        carried = vectors.scale(2 * rate, vectors.cross(self.spin, along))
        own = vectors.add(vectors.scale(faster, along), carried)
        return there._replace(
            velocity=vectors.add(there.velocity, vectors.scale(rate, along)),
            acceleration=vectors.add(there.acceleration, own),
        )


def _moving(arm: RobotArm, joints: Placed) -> _Frame:
    """Frame of the hand with its rates, from the base outwards.

    It equals derivatives of `RobotArm.pose`, with a fraction of their arithmetic.

    Args:
        arm: The arm.
        joints: Coordinates of the joints with their two time derivatives.
    """
    zero, one = jnp.zeros_like(arm.places[0, 0]), jnp.ones_like(arm.places[0, 0])
    none = zero, zero, zero
    frame = _Frame(none, (one, zero, zero, zero), none, none, none, none)
    for k in range(len(arm.joints) + 1):
        frame = frame.beside(vectors.split(arm.places[k]))
        fixed = split_quaternion(arm.turns[k])
        frame = frame._replace(turn=multiply_quaternions(frame.turn, fixed))
        if k < len(arm.joints):
            axis = vectors.split(arm.axes[k])
            way = joints.position[k] - arm.references[k]
            by = frame.slid if arm.slides[k] else frame.swung
            frame = by(axis, way, joints.velocity[k], joints.acceleration[k])
    return frame


def _telling(coordinates: Any) -> Array:
    """Coordinates that look like no others, and zero where they always are."""
    largest = coordinates.largest
    some = _TELLING * (1 + 0.1 * np.arange(largest.shape[-1]))
    return jnp.where(largest == 0, 0, jnp.asarray(some, largest.dtype))


def robot_arm(
    file: str | Path,
    hand: str,
    *,
    position: Numbers = (0.0, 0.0, 0.0),
    orientation: Numbers = (1.0, 0.0, 0.0, 0.0),
    dtype: Any = None,
) -> RobotArm:
    """Reads the arm of a robot from a URDF or MJCF file: kinematics alone.

    MuJoCo reads the file. Meshes are not read, masses and motors do not matter: joints
    follow the coordinates that they are given. Other branches of the robot are left
    out. It needs the extra `robot`: `pip install "jaxrod[robot]"`.

    Args:
        file: Path of the file.
        hand: Name of a link (URDF), or of a body or site (MJCF).
        position: Position of the robot's base in the world `(3,)` [m].
        orientation: Orientation of the base, quaternion (w, x, y, z) of any length
            `(4,)`.
        dtype: Floating-point dtype; by default JAX's default.

    Raises:
        ImportError: If MuJoCo is not installed.
        OSError: If the file cannot be read.
        ValueError: If it is no robot, has no such link, or if a joint on the way to it
            has more than one coordinate or follows another joint.

    Example:
        >>> with open("crane.xml", "w") as file:
        ...     _ = file.write('''<mujoco><worldbody><body name="hook">
        ...         <joint name="lift" type="slide" axis="0 0 1" range="0 0.5"/>
        ...     </body></worldbody></mujoco>''')
        >>> arm = jaxrod.robot_arm("crane.xml", "hook", position=(0.0, 0.0, 1.0))
        >>> arm.joints, arm.upper.tolist(), arm.pose(jnp.array([0.25]))[0].tolist()
        (('lift',), [0.5], [0.0, 0.0, 1.25])
    """
    kind = dtype or jnp.result_type(float)
    base = as_array("position", position, "m", [(3,)], dtype=kind)
    facing = unit_vector("orientation", orientation, 4)
    model = _read(Path(file))
    place, turn = np.zeros(3), _NO_TURN
    places: list[np.ndarray] = []
    turns: list[np.ndarray] = []
    joints, bodies = [], _way_to(model, hand, file)
    for number in bodies:
        place = place + _turned(turn, model.body_pos[number])
        turn = _product(turn, model.body_quat[number])
        first = int(model.body_jntadr[number])
        for joint in range(first, first + int(model.body_jntnum[number])):
            # The frame of a joint lies on its axis: at its anchor.
            anchor = model.jnt_pos[joint]
            places.append(place + _turned(turn, anchor))
            turns.append(turn)
            place, turn = -anchor, _NO_TURN
            joints.append(joint)
    site = _site(model, hand)
    if site is not None:
        place = place + _turned(turn, model.site_pos[site])
        turn = _product(turn, model.site_quat[site])
    _check_joints(model, joints, file)
    limited = model.jnt_limited[joints].astype(bool)

    def made(values: Any) -> Array:
        return jnp.asarray(np.asarray(values), kind)

    stand = split_quaternion(jnp.asarray(facing, kind))
    nearest = vectors.split(made([*places, place][0]))
    there = base + vectors.join(to_world(directors(stand), nearest))
    turned = multiply_quaternions(stand, split_quaternion(made([*turns, turn][0])))
    return RobotArm(
        places=made([*places, place]).at[0].set(there),
        turns=made([*turns, turn]).at[0].set(join_quaternion(turned)),
        axes=made(model.jnt_axis[joints].reshape(-1, 3)),
        references=made(model.qpos0[model.jnt_qposadr[joints]]),
        lower=made(np.where(limited, model.jnt_range[joints, 0], -np.inf)),
        upper=made(np.where(limited, model.jnt_range[joints, 1], np.inf)),
        joints=tuple(model.joint(k).name for k in joints),
        slides=tuple(bool(kind == _SLIDE) for kind in model.jnt_type[joints]),
    )


_NO_TURN = np.array([1.0, 0.0, 0.0, 0.0])
_SLIDE, _HINGE = 2, 3
"""Types of joints in MuJoCo's models."""


def _read(file: Path) -> Any:
    """MuJoCo's model of the robot in a file, without meshes and masses."""
    try:
        import mujoco  # noqa: TID251 - it only reads files here
    except ImportError as error:
        raise ImportError(
            'robot_arm needs MuJoCo to read robots: pip install "jaxrod[robot]"'
        ) from error
    file.read_bytes()
    try:
        robot = mujoco.MjSpec.from_file(str(file))
        # Fixed links stay links of their own, and massless ones are allowed.
        robot.compiler.fusestatic = False
        robot.compiler.boundmass = robot.compiler.boundinertia = 1.0
        for kind in ("geoms", "pairs", "skins", "meshes", "hfields", "materials"):
            for one in list(getattr(robot, kind)):
                robot.delete(one)
        return robot.compile()
    except ValueError as error:
        raise ValueError(f"MuJoCo cannot read {file} as a robot: {error}") from error


def _site(model: Any, name: str) -> int | None:
    """Number of the site with a name, unless a body has it."""
    names = [model.site(k).name for k in range(model.nsite)]
    bodies = [model.body(k).name for k in range(model.nbody)]
    return names.index(name) if name in names and name not in bodies else None


def _way_to(model: Any, name: str, file: Any) -> list[int]:
    """Numbers of the bodies from the base to the one of the hand."""
    bodies = [model.body(k).name for k in range(model.nbody)]
    site = _site(model, name)
    if site is None and name not in bodies[1:]:
        sites = [model.site(k).name for k in range(model.nsite)]
        known = ", ".join(one for one in [*bodies[1:], *sites] if one)
        raise ValueError(f"{file} has no link {name!r}, it has {known}")
    number = bodies.index(name) if site is None else int(model.site_bodyid[site])
    way: list[int] = []
    while number:
        way.insert(0, number)
        number = int(model.body_parentid[number])
    return way


def _check_joints(model: Any, joints: list[int], file: Any) -> None:
    """Raises ValueError unless each joint has one coordinate of its own."""
    for joint in joints:
        name = model.joint(joint).name
        if model.jnt_type[joint] not in (_SLIDE, _HINGE):
            raise ValueError(
                f"joint {name!r} of {file} must be a hinge or a slide: it has more "
                "than one coordinate"
            )
        for k in range(model.neq):
            # Type 2 of an equality: a coordinate is a function of another one.
            if model.eq_type[k] == 2 and model.eq_obj1id[k] == joint:
                raise ValueError(
                    f"joint {name!r} of {file} follows another joint; jaxrod supports "
                    "only independent joints"
                )


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Product of two quaternions (w, x, y, z)."""
    w, x, y, z = a
    return np.array(
        [
            w * b[0] - x * b[1] - y * b[2] - z * b[3],
            w * b[1] + x * b[0] + y * b[3] - z * b[2],
            w * b[2] - x * b[3] + y * b[0] + z * b[1],
            w * b[3] + x * b[2] - y * b[1] + z * b[0],
        ]
    )


def _turned(turn: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """A vector turned by a unit quaternion (w, x, y, z)."""
    inner = np.cross(turn[1:], vector)
    return vector + 2 * (turn[0] * inner + np.cross(turn[1:], inner))

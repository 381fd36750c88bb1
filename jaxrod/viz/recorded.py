"""Conversion of states of a scene or a system into a replay's shapes and fields.

Fixed bodies that rods touch, and rigid bodies that move, become triangles.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.contacts.bodies import Body
from jaxrod.geometry import surfaces
from jaxrod.geometry.surfaces import Triangles
from jaxrod.model import Model
from jaxrod.rods.elasticity import strains
from jaxrod.rods.rod import RodState
from jaxrod.systems.coupling import Parts
from jaxrod.viz.colours import FIXED
from jaxrod.viz.recording import extent
from jaxrod.viz.rods import Rods, checked_rods
from jaxrod.viz.shapes import Arrows, Mesh, checked_arrows, checked_mesh

_ONLY = "rod"
"""Key of a scene's only rod in `fields` and `colours`."""


class Recorded(NamedTuple):
    """Shapes that `recorded` makes from the states of a scene or a system."""

    rods: tuple[Rods, ...]
    meshes: tuple[Mesh, ...]
    arrows: tuple[Arrows, ...]
    floor: float | None
    """Height of a level plane that a rod may touch [m]; None if there is none."""


def recorded(
    model: Model,
    states: Any,
    times: np.ndarray,
    fields: Mapping[str, Any],
    forces: bool,
    colours: Mapping[str, str],
    up: str,
) -> Recorded:
    """Makes the shapes of all members over all frames.

    Arguments are those of `Replay.from_states`.

    Raises:
        ValueError: An argument has the wrong shape or an impossible value.
        TypeError: `model` is neither a scene nor a system.
    """
    if not isinstance(model, Model):
        raise TypeError(
            f"model must be a scene or a system, got {type(model).__name__}"
        )
    by_name = model.states_by_name(states)
    members = model.interfaces()
    names = [name or _ONLY for name in members]
    for name in colours:
        if name not in names:
            raise ValueError(
                f"colours: there is no member {name!r}; there are "
                + ", ".join(map(repr, names))
            )
    for name in members:
        shape = np.shape(by_name[name].positions)
        if len(shape) < 3:
            raise ValueError(
                "states must have a leading axis of times, as jaxrod.rollout returns "
                f"them, got positions of shape {shape}: a single state"
            )
    # The record of a run's neighbour lists is not drawn.
    states = model.with_states({}, by_name)
    values = _field_values(model, states, times, fields)
    rods: list[Rods] = []
    meshes: list[Mesh] = []
    for name, member in members.items():
        own, colour = by_name[name], colours.get(name or _ONLY, "")
        if member.rod is not None:
            rods.append(
                checked_rods(
                    np.moveaxis(np.asarray(own.positions), -2, -1),
                    np.asarray(member.rod.radii),
                    times,
                    name=name,
                    colour=colour,
                    fields=values[name],
                )
            )
            continue
        parts = member.parts()
        if parts.shape is not None:
            mesh = _of_bodies(name, parts, own, colour)
            meshes.append(checked_mesh(len(meshes), mesh, times))
    fixed, floor = _ground(model, times, *extent(rods, meshes), up)
    meshes += [checked_mesh(k, mesh, times) for k, mesh in enumerate(fixed)]
    arrows = _contact_forces(model, states, times) if forces else ()
    return Recorded(tuple(rods), tuple(meshes), arrows, floor)


def _of_bodies(name: str, bodies: Parts, states: Any, colour: str) -> Mesh:
    return Mesh(
        *mesh_of(bodies),
        np.moveaxis(np.asarray(states.positions), -2, -1),
        np.moveaxis(np.asarray(states.orientations), -2, -1),
        name,
        colour,
    )


def _rods(model: Model) -> dict[str, Any]:
    """Members of a model that are rods, by name."""
    members = model.interfaces().items()
    return {name: member for name, member in members if member.rod is not None}


def _field_values(
    model: Model, states: Any, times: np.ndarray, fields: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """Values of all fields: by member, then by label; functions are evaluated.

    The axes of a value are frames, then equal rods if any, then nodes, elements or
    joints.
    """
    names = {name or _ONLY: name for name in _rods(model)}
    values: dict[str, dict[str, Any]] = {name: {} for name in names.values()}
    for label, given in fields.items():
        each = given if isinstance(given, Mapping) else dict.fromkeys(names, given)
        unknown = set(each) - set(names)
        if unknown:
            raise ValueError(
                f"fields[{label!r}] names {sorted(unknown)}, which are not its rods: "
                f"those are {sorted(names)}"
            )
        for shown, field in each.items():
            name = names[shown]
            if callable(field):
                field = _measured(model, states, times, name, field)
            values[name][label] = field
    return values


def _measured(
    model: Model,
    states: Any,
    times: np.ndarray,
    name: str,
    field: Callable[[Any, Any], Any],
) -> np.ndarray:
    def at_frame(given: Model, frame: tuple[Any, Any]) -> Any:
        state, time = frame
        member = given.at(time).recalling(state).interfaces()[name]
        own = given.states_by_name(state)[name]
        return member.each(lambda *now: jnp.asarray(field(*now)), own)

    member = model.interfaces()[name]
    clock = jnp.asarray(times, member.dtype)
    measured = np.asarray(_over_frames(at_frame, model, (states, clock)))
    # One number for a whole rod.
    single = measured.ndim == 1 + len(member.rod.batch_shape)
    return measured[..., None] if single else measured


def _ground(
    model: Model, times: np.ndarray, low: np.ndarray, high: np.ndarray, up: str
) -> tuple[list[Mesh], float | None]:
    """Meshes of the fixed bodies that rods may touch, and the height of a level plane.

    A plane that faces upwards has no mesh; its height along the axis `up` is returned
    [m], None if there is no such plane. Other planes, and bodies without triangles, are
    drawn only near the box from `low` to `high`.
    """
    fixed: dict[Any, Body] = {}
    meshes: list[Mesh] = []
    for name, member in _rods(model.at(times[0])).items():
        stacked = len(member.rod.batch_shape)
        for k, effect in enumerate(member.effects):
            if effect.obstacle is None:
                continue
            body, count = effect.obstacle
            if _pose(effect, stacked) is not None:
                poses = _poses(model, times, name, k)
                for one, at in zip(
                    _split(body, stacked), _split(poses, stacked), strict=True
                ):
                    meshes += _moving(one, count, at, low, high)
                continue
            for one in _split(body, stacked + int(count is not None)):
                leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(one)]
                key = (type(one), *(leaf.tobytes() for leaf in leaves))
                fixed.setdefault(key, one)
    floor, axis = None, "xyz".find(up)
    for body in fixed.values():
        if not body.is_half_space:
            meshes.append(solid_mesh(body, low, high))
            continue
        plane: Any = body
        normal = np.asarray(plane.normal, float)
        if normal[axis] > 0.9999 * np.linalg.norm(normal):
            floor = float(plane.point[axis])
        else:
            leaning = leaning_plane(plane, low, high)
            meshes += [] if leaning is None else [leaning]
    return meshes, floor


def _split(tree: Any, axes: int) -> list[Any]:
    """Splits a body or an effect whose arrays have leading axes into single ones."""
    found = [tree]
    for _ in range(axes):
        found = [
            jax.tree.map(lambda leaf, k=k: leaf[k], one)
            for one in found
            for k in range(jax.tree.leaves(one)[0].shape[0])
        ]
    return found


def _pose(effect: Any, stacked: int) -> Any:
    """Pose of an effect's bodies, with leading axes for `stacked` axes of rods."""

    def one(effect: Any) -> Any:
        return effect.obstacle_pose

    for _ in range(stacked):
        one = jax.vmap(one)
    return one(effect)


def _poses(model: Model, times: np.ndarray, name: str, index: int) -> Any:
    """Displacements and rotations of an effect's bodies at all times.

    The times are the last but one axis, after those of equal rods.
    """

    def pose(time: Array) -> Any:
        member = _rods(model.at(time))[name]
        return _pose(member.effects[index], len(member.rod.batch_shape))

    clock = jnp.asarray(times, model.interfaces()[name].dtype)
    found = jax.jit(jax.vmap(pose))(clock)
    return jax.tree.map(lambda leaf: np.moveaxis(np.asarray(leaf), 0, -2), found)


def _moving(
    body: Any, count: int | None, poses: Any, low: np.ndarray, high: np.ndarray
) -> list[Mesh]:
    """Meshes of bodies of one effect, of which `poses` are those at all times."""
    shifts, turns = poses
    meshes = []
    for one in _split(body, int(count is not None)):
        still = leaning_plane if one.is_half_space else solid_mesh
        mesh = still(one, low, high)
        if mesh is not None:
            meshes.append(replace(mesh, positions=shifts, orientations=turns))
    return meshes


def _contact_forces(model: Model, states: Any, times: np.ndarray) -> tuple[Arrows, ...]:
    """Arrows of the contact forces on all rods, summed at each node [N]."""
    rods = _rods(model)

    def at_frame(given: Model, frame: tuple[Any, Any]) -> list[dict[str, Any]]:
        state, time = frame
        found = given.at(time).recalling(state).contact_forces(state)
        return [{name: forces} for name, forces in found if name in rods]

    clock = jnp.asarray(times, next(iter(model.interfaces().values())).dtype)
    by_name = model.states_by_name(states)
    total = {name: np.zeros_like(by_name[name].positions) for name in rods}
    # The forces are added outside of the program: inside it, XLA would recompute a
    # contact for every component of its forces.
    for one in _over_frames(at_frame, model, (states, clock)):
        for name, forces in one.items():
            row = np.stack([np.asarray(part) for part in forces], axis=-2)
            if row.ndim < total[name].ndim:  # Equal rods follow one after another.
                split = row.reshape(*row.shape[:-1], *total[name].shape[1::2])
                row = np.moveaxis(split, -2, 1)
            total[name] += row
    flat = lambda x: np.moveaxis(np.asarray(x), -2, -1).reshape(len(times), -1, 3)
    origins = np.concatenate([flat(by_name[name].positions) for name in rods], axis=1)
    vectors = np.concatenate([flat(total[name]) for name in rods], axis=1)
    arrows = Arrows(origins, vectors, "contact force [N]")
    return (checked_arrows(0, arrows, times),)


def _over_frames(at_frame: Callable[[Any, Any], Any], model: Any, frames: Any) -> Any:
    """Evaluates `at_frame(model, frame)` for every frame in one compiled program.

    The model is an argument of the program, as in simulations, not a constant.
    """
    return jax.jit(lambda m, x: jax.lax.map(lambda one: at_frame(m, one), x))(
        model, frames
    )


# Functions of a scene and a state for the `fields` of `Replay.from_states`.


def speed(scene: Any, state: RodState) -> Float[Array, " n+1"]:
    """Speed of the nodes [m/s].

    Args:
        scene: The scene of the rod.
        state: A state of the rod.

    Example:
        >>> falling = replace(state, velocities=state.velocities.at[2].set(-2.0))
        >>> viz.speed(scene, falling)[:3].tolist()
        [2.0, 2.0, 2.0]
    """
    return jnp.sqrt(jnp.sum(state.velocities**2, axis=0))


def stretch(scene: Any, state: RodState) -> Float[Array, " n"]:
    """Axial strain of the elements [1], positive in tension.

    Args:
        scene: The scene of the rod.
        state: A state of the rod.

    Example:
        >>> longer = replace(state, positions=1.01 * state.positions)  # by 1 %
        >>> print(viz.stretch(scene, longer)[:3].round(3))
        [0.01 0.01 0.01]
    """
    return (strains(scene.rod, state)[0] - scene.rod.rest_strains)[2]


def twist_rate(scene: Any, state: RodState) -> Float[Array, " n-1"]:
    """Twist per rest length at the joints, relative to the rest state [rad/m].

    Args:
        scene: The scene of the rod.
        state: A state of the rod.

    Example:
        >>> records = jax.tree.map(lambda leaf: leaf[None], state)  # one frame
        >>> fields = {"twist [rad/m]": viz.twist_rate}
        >>> viz.Replay.from_states(scene, records, [0.0], fields=fields).fields
        ('twist [rad/m]',)
    """
    return (strains(scene.rod, state)[1] - scene.rod.rest_curvatures)[2]


def bending(scene: Any, state: RodState) -> Float[Array, " n-1"]:
    """Curvature at the joints, relative to the rest state [1/m].

    Args:
        scene: The scene of the rod.
        state: A state of the rod.

    Example:
        >>> angle = jnp.linspace(0.0, 1.0, 11)  # an arc of radius 1 m
        >>> arc = jnp.stack([jnp.sin(angle), 0.0 * angle, jnp.cos(angle)])
        >>> _, bent = jaxrod.rod_along(arc, radius=0.02, density=1, youngs_modulus=1)
        >>> print(viz.bending(scene, bent).round(2))
        [1. 1. 1. 1. 1. 1. 1. 1. 1.]
    """
    first, second, _ = strains(scene.rod, state)[1] - scene.rod.rest_curvatures
    return jnp.hypot(first, second)


_DOUBLINGS = 6


def mesh_of(bodies: Parts) -> Triangles:
    """Triangles of the surface of rigid bodies, in the body frame.

    If only the signed distance of a body is known, its surface is searched in a cube
    around the ellipsoid with its mass and inertia. The cube is doubled until the body
    fits inside.

    Raises:
        ValueError: No surface is found.
    """
    assert bodies.shape is not None
    known = bodies.shape.mesh()
    if known is not None:
        return known
    mass = float(bodies.node_masses[0])
    a, b, c = (float(x) for x in bodies.inertias[:, 0])
    axes = [2.5 * (p + q - r) / mass for p, q, r in ((b, c, a), (a, c, b), (a, b, c))]
    half = 1.2 * max(axes) ** 0.5
    for _ in range(_DOUBLINGS):
        cube = np.full(3, half)
        if not _touches(bodies.shape, half):
            return surfaces.of_distance(_surface(bodies.shape), -cube, cube)
        half *= 2
    raise ValueError("the surface of a rigid body must be closed to be drawn")


def _touches(shape: Body, half: float) -> bool:
    """Whether a body reaches a face of the cube from -half to half along each axis."""
    side = np.linspace(-half, half, 41)
    u, v = (x.ravel() for x in np.meshgrid(side, side))
    w = np.full_like(u, half)
    faces = [
        s * np.roll(np.stack([w, u, v]), k, axis=0) for k in range(3) for s in (1, -1)
    ]
    distance, _ = _surface(shape)(np.concatenate(faces, axis=1).T)
    return bool(np.any(np.asarray(distance) <= 0))


def solid_mesh(body: Body, low: np.ndarray, high: np.ndarray) -> Mesh:
    """Mesh of a fixed body, for drawing.

    A body that provides triangles is drawn completely. Any other body is drawn inside
    the box from `low` to `high`, widened by a quarter of its longest side.
    """
    known = body.mesh()
    if known is not None:
        return Mesh(*known, name="obstacle", colour=FIXED)
    margin = 0.25 * float(np.max(high - low))
    vertices, faces = surfaces.of_distance(
        _surface(body), low - margin, high + margin, cells=64
    )
    return Mesh(vertices, faces, name="obstacle", colour=FIXED)


def leaning_plane(body: Any, low: np.ndarray, high: np.ndarray) -> Mesh | None:
    """Mesh of a tilted plane inside the box from `low` to `high`; `None` if outside."""
    normal = np.asarray(body.normal, float)
    normal = normal / np.linalg.norm(normal)
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    middle = (low + high) / 2
    centre = middle - ((middle - np.asarray(body.point)) @ normal) * normal
    reach = 2 * float(np.linalg.norm(high - low))
    square = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    corners = [centre + reach * (a * first + b * second) for a, b in square]
    for axis in range(3):
        for sign, bound in ((1, high[axis]), (-1, -low[axis])):
            corners = _cut(corners, axis, sign, bound)
    if len(corners) < 3:
        return None
    faces = [(0, k, k + 1) for k in range(1, len(corners) - 1)]
    return Mesh(np.array(corners), np.array(faces), name="plane", colour=FIXED)


def _cut(
    corners: list[np.ndarray], axis: int, sign: int, bound: float
) -> list[np.ndarray]:
    """Clips a flat polygon at a plane: keeps points with sign x[axis] <= bound.

    `corners` are the polygon's corners in order, and so is the result.
    """
    kept = []
    for here, after in zip(corners, corners[1:] + corners[:1], strict=True):
        a, b = sign * here[axis] - bound, sign * after[axis] - bound
        if a <= 0:
            kept.append(here)
        if a * b < 0:
            kept.append(here + a / (a - b) * (after - here))
    return kept


def _surface(body: Body) -> Any:
    """Function from points (N, 3) to signed distances (N,) and normals (N, 3)."""

    def at(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, y, z = jnp.asarray(points).T
        distance, normal = body.surface((x, y, z))
        return np.asarray(distance), np.stack([np.asarray(n) for n in normal], axis=-1)

    return at

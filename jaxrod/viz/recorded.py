"""States of a scene or a system as the shapes of a replay, and as its fields."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.contacts.bodies import Body, Plane
from jaxrod.contacts.contact import Contact
from jaxrod.rods.elasticity import strains
from jaxrod.rods.motion import motion_of
from jaxrod.rods.rod import RodState
from jaxrod.scene import Scene
from jaxrod.systems.contact.body_contact import BodyContact
from jaxrod.systems.contact.neighbour_lists import RECORD
from jaxrod.systems.contact.touching_rods import TouchingRods
from jaxrod.systems.energies import seen_at_rest
from jaxrod.systems.members.rigid_bodies import RigidBodies
from jaxrod.systems.system import System
from jaxrod.viz.bodies import leaning_plane, mesh_of, solid_mesh
from jaxrod.viz.meshes import Mesh, checked_mesh
from jaxrod.viz.recording import extent
from jaxrod.viz.rods import Rods, checked_rods
from jaxrod.viz.shapes import Arrows, checked_arrows

_ONLY = "rod"
"""Name of the rod of a scene."""


class Recorded(NamedTuple):
    """Shapes of a scene or a system for drawing."""

    rods: tuple[Rods, ...]
    meshes: tuple[Mesh, ...]
    arrows: tuple[Arrows, ...]
    floor: float | None
    """Height of a level plane that a rod may touch [m]."""


def recorded(
    model: Scene | System,
    states: Any,
    times: np.ndarray,
    fields: Mapping[str, Any],
    forces: bool,
    colours: Mapping[str, str],
    up: str,
) -> Recorded:
    """Shapes of the members of a scene or a system; see `Replay.from_states`.

    Raises:
        ValueError: An argument has the wrong shape or an impossible value.
        TypeError: `model` is neither a scene nor a system.
    """
    if isinstance(model, Scene):
        system, by_member = System({_ONLY: model}), {_ONLY: states}
    elif isinstance(model, System):
        # The record of a run's neighbour lists is not a member.
        members = {name: own for name, own in states.items() if name != RECORD}
        system, by_member = model, members
        if set(by_member) != set(system.members):
            raise ValueError(
                f"states must have the members {sorted(system.members)}, got "
                f"{sorted(by_member)}"
            )
    else:
        raise TypeError(
            f"model must be a scene or a system, got {type(model).__name__}"
        )
    values = _field_values(system, by_member, times, fields)
    rods: list[Rods] = []
    meshes: list[Mesh] = []
    for name, own in by_member.items():
        member, colour = system.members[name], colours.get(name, "")
        if not isinstance(member, RigidBodies):
            rods.append(
                checked_rods(
                    np.moveaxis(np.asarray(own.positions), -2, -1),
                    np.asarray(member.rod.radii),
                    times,
                    name="" if isinstance(model, Scene) else name,
                    colour=colour,
                    fields=values[name],
                )
            )
        elif member.shape is not None:
            mesh = _of_bodies(name, member, own, colour)
            meshes.append(checked_mesh(len(meshes), mesh, times))
    fixed, floor = _ground(system, *extent(rods, meshes), up)
    meshes += [checked_mesh(k, mesh, times) for k, mesh in enumerate(fixed)]
    arrows = _contact_forces(system, by_member, times) if forces else ()
    return Recorded(tuple(rods), tuple(meshes), arrows, floor)


def _of_bodies(name: str, bodies: RigidBodies, states: Any, colour: str) -> Mesh:
    return Mesh(
        *mesh_of(bodies),
        np.moveaxis(np.asarray(states.positions), -2, -1),
        np.moveaxis(np.asarray(states.orientations), -2, -1),
        name,
        colour,
    )


def _field_values(
    system: System, states: dict[str, Any], times: np.ndarray, fields: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """Numbers by member and label, for each frame, rod and place along it."""
    rods = {k: m for k, m in system.members.items() if isinstance(m, Scene)}
    values: dict[str, dict[str, Any]] = {name: {} for name in rods}
    for label, given in fields.items():
        each = given if isinstance(given, Mapping) else dict.fromkeys(rods, given)
        unknown = set(each) - set(rods)
        if unknown:
            raise ValueError(
                f"fields[{label!r}] names {sorted(unknown)}, which are no rods of it: "
                f"those are {sorted(rods)}"
            )
        for name, field in each.items():
            if callable(field):
                field = _measured(system, states, times, name, field)
            values[name][label] = field
    return values


def _measured(
    system: System,
    states: dict[str, Any],
    times: np.ndarray,
    name: str,
    field: Callable[[Any, Any], Any],
) -> np.ndarray:
    group = jnp.ndim(system.members[name].rod.rest_lengths) > 1  # type: ignore[union-attr]

    def at_frame(given: System, frame: tuple[Any, Any]) -> Any:
        state, time = frame
        member = given.at(time).recalling(state).members[name]
        measure = jax.vmap(field) if group else field
        return jnp.asarray(measure(member, state[name]))

    clock = jnp.asarray(times, system.dtype)
    measured = np.asarray(_over_frames(at_frame, system, (states, clock)))
    # One number for a whole rod.
    return measured[..., None] if measured.ndim == 1 + group else measured


def _ground(
    system: System, low: np.ndarray, high: np.ndarray, up: str
) -> tuple[list[Mesh], float | None]:
    """The fixed bodies that rods may touch, and the height of a level plane [m]."""
    fixed: dict[Any, Body] = {}
    for member in system.members.values():
        if isinstance(member, Scene):
            group = member.rod.rest_lengths.ndim > 1
            for effect in member.effects:
                if isinstance(effect, Contact):
                    for body in _single(effect.body, effect.n_bodies, group):
                        leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(body)]
                        key = (type(body), *(leaf.tobytes() for leaf in leaves))
                        fixed.setdefault(key, body)
    meshes: list[Mesh] = []
    floor, axis = None, "xyz".find(up)
    for body in fixed.values():
        if not isinstance(body, Plane):
            meshes.append(solid_mesh(body, low, high))
            continue
        normal = np.asarray(body.normal, float)
        if normal[axis] > 0.9999 * np.linalg.norm(normal):
            floor = float(body.point[axis])
        else:
            leaning = leaning_plane(body, low, high)
            meshes += [] if leaning is None else [leaning]
    return meshes, floor


def _single(body: Body, count: int | None, group: bool) -> list[Body]:
    """Single bodies, from those of one rod or of equal rods."""
    axes = int(group) + int(count is not None)
    bodies = [body]
    for _ in range(axes):
        bodies = [
            jax.tree.map(lambda leaf, k=k: leaf[k], one)
            for one in bodies
            for k in range(jax.tree.leaves(one)[0].shape[0])
        ]
    return bodies


def _contact_forces(
    system: System, states: dict[str, Any], times: np.ndarray
) -> tuple[Arrows, ...]:
    """Contact forces at the nodes of all rods [N]."""
    rods = [k for k, m in system.members.items() if isinstance(m, Scene)]

    def at_frame(given: System, frame: tuple[Any, Any]) -> list[dict[str, Any]]:
        state, time = frame
        now = given.at(time).recalling(state)
        assert isinstance(now, System)
        found = []
        for name in rods:
            member = now.members[name]
            assert isinstance(member, Scene)
            several = member.rod.rest_lengths.ndim > 1
            on_rods = jax.vmap(_on_rod) if several else _on_rod
            found += [{name: force} for force in on_rods(member, state[name])]
        seen, couplings = seen_at_rest(now, state)
        for coupling in couplings:
            if isinstance(coupling, BodyContact | TouchingRods):
                found += [
                    {name: loads.forces}
                    for name, loads in coupling.loads(seen).items()
                    if name in rods and loads.forces is not None
                ]
        return found

    clock = jnp.asarray(times, system.dtype)
    total = {name: np.zeros_like(states[name].positions) for name in rods}
    # Added up here: in one program with the stacking and adding, XLA recomputes a
    # contact for every component of its forces.
    for one in _over_frames(at_frame, system, (states, clock)):
        for name, forces in one.items():
            row = np.stack([np.asarray(part) for part in forces], axis=-2)
            if row.ndim < total[name].ndim:  # Of equal rods one after the other.
                split = row.reshape(*row.shape[:-1], *total[name].shape[1::2])
                row = np.moveaxis(split, -2, 1)
            total[name] += row
    flat = lambda x: np.moveaxis(np.asarray(x), -2, -1).reshape(len(times), -1, 3)
    origins = np.concatenate([flat(states[name].positions) for name in rods], axis=1)
    vectors = np.concatenate([flat(total[name]) for name in rods], axis=1)
    arrows = Arrows(origins, vectors, "contact force [N]")
    return (checked_arrows(0, arrows, times),)


def _over_frames(at_frame: Callable[[Any, Any], Any], model: Any, frames: Any) -> Any:
    """Results of a function of a model and a frame, at every frame.

    The model is an argument of the program, as in runs, not a constant in it.
    """
    return jax.jit(lambda m, x: jax.lax.map(lambda one: at_frame(m, one), x))(
        model, frames
    )


def _on_rod(scene: Scene, state: Any) -> list[Any]:
    """Contact forces of fixed bodies on a rod's nodes, for each effect."""
    found = [
        effect.loads(scene.rod, motion_of(state)).forces
        for effect in scene.effects
        if isinstance(effect, Contact)
    ]
    return [forces for forces in found if forces is not None]


# Functions of a scene and a state for the `fields` of `Replay.from_states`.


def speed(scene: Any, state: RodState) -> Float[Array, " n+1"]:
    """Speed of the nodes [m/s]."""
    return jnp.sqrt(jnp.sum(state.velocities**2, axis=0))


def stretch(scene: Any, state: RodState) -> Float[Array, " n"]:
    """Axial strain of the elements [1], positive in tension."""
    return (strains(scene.rod, state)[0] - scene.rod.rest_strains)[2]


def twist_rate(scene: Any, state: RodState) -> Float[Array, " n-1"]:
    """Twist per rest length at the joints, relative to the rest state [rad/m]."""
    return (strains(scene.rod, state)[1] - scene.rod.rest_curvatures)[2]


def bending(scene: Any, state: RodState) -> Float[Array, " n-1"]:
    """Curvature at the joints, relative to the rest state [1/m]."""
    first, second, _ = strains(scene.rod, state)[1] - scene.rod.rest_curvatures
    return jnp.hypot(first, second)

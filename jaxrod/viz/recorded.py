"""A replay of a scene or a system: what its states look like."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrod.contacts.bodies import Body, Plane
from jaxrod.contacts.contact import Contact
from jaxrod.rods.motion import motion_of
from jaxrod.scene import Scene
from jaxrod.systems.body_contact import BodyContact
from jaxrod.systems.energies import seen_at_rest
from jaxrod.systems.parts import in_rows
from jaxrod.systems.rigid_bodies import RigidBodies
from jaxrod.systems.rod_contact import RodContact
from jaxrod.systems.system import System
from jaxrod.viz.arrows import Arrows, checked_arrows
from jaxrod.viz.bodies import leaning_plane, mesh_of, solid_mesh
from jaxrod.viz.meshes import Mesh, checked_mesh
from jaxrod.viz.replay import Axis, Replay

_ONLY = "rod"
"""Name of the rod of a scene."""


def recorded(
    model: Scene | System,
    states: Any,
    times: Any,
    *,
    fields: Mapping[str, Any] | None = None,
    forces: bool = False,
    colours: Mapping[str, str] | None = None,
    readouts: Mapping[str, Any] | None = None,
    spheres: Any = (),
    cylinders: Any = (),
    title: str = "",
    up: Axis = "z",
    floor: float | None = None,
) -> Replay:
    """A replay of a scene or a system.

    Args:
        model: the scene or the system.
        states: its states with a leading axis of T.
        times: time of each frame [s], shape (T,).
        fields: label with a unit -> what to colour rods by: a function of a scene (as
            it is at the time of the frame) and a state of its rod that gives a number
            for each of n elements, n+1 nodes or n-1 joints, or one for all; or such
            numbers, with leading axes for frames and equal rods; or a dict of either
            by member, for some members. `jaxrod.viz.speed`, `stretch` and `twist_rate`
            are such functions.
        forces: whether to show the contact forces on rods as arrows, those at each
            node added up.
        colours: member -> "#rrggbb".
        readouts: name -> one number per frame, shape (T,).
        spheres: spheres to show, such as targets.
        cylinders: cylinders to show.
        title: heading of the player.
        up: the world axis drawn upwards.
        floor: height of the ground along it [m]; by default that of a level plane
            which a rod may touch.

    Raises:
        ValueError: an argument has the wrong shape or an impossible value.
        TypeError: `model` is neither.
    """
    if isinstance(model, Scene):
        system, by_member = System({_ONLY: model}), {_ONLY: states}
    elif isinstance(model, System):
        system, by_member = model, dict(states)
        if set(by_member) != set(system.members):
            raise ValueError(
                f"states must have the members {sorted(system.members)}, got "
                f"{sorted(by_member)}"
            )
    else:
        raise TypeError(
            f"model must be a scene or a system, got {type(model).__name__}"
        )
    clock = np.asarray(times, float)
    values = _field_values(system, by_member, clock, fields or {})
    parts = []
    for name in by_member:
        member, own = system.members[name], by_member[name]
        colour = (colours or {}).get(name, "")
        if isinstance(member, RigidBodies):
            parts.append(_of_bodies(name, member, own, clock, colour, up))
        else:
            parts.append(
                Replay.from_rollout(
                    own.positions,
                    np.asarray(member.rod.radii),
                    clock,
                    fields=values.get(name, {}),
                    name="" if isinstance(model, Scene) else name,
                    colour=colour,
                    up=up,
                )
            )
    around = Replay.of(
        clock,
        spheres=spheres,
        cylinders=cylinders,
        readouts=readouts,
        title=title,
        up=up,
        floor=floor,
    )
    whole = around.together(*parts)
    whole = _with_ground(whole, system)
    if forces:
        whole = replace(whole, arrows=_contact_forces(system, by_member, whole.times))
    return whole


def _of_bodies(
    name: str,
    bodies: RigidBodies,
    states: Any,
    times: np.ndarray,
    colour: str,
    up: Axis,
) -> Replay:
    meshes: list[Mesh] = []
    if bodies.shape is not None:
        vertices, faces = mesh_of(bodies)
        mesh = Mesh(
            vertices,
            faces,
            np.moveaxis(np.asarray(states.positions), -2, -1),
            np.moveaxis(np.asarray(states.orientations), -2, -1),
            name,
            colour,
        )
        meshes.append(mesh)
    return Replay.of(times, meshes=meshes, up=up)


def _field_values(
    system: System, states: dict[str, Any], times: np.ndarray, fields: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """Of each member and label numbers by frame, rod and place along it."""
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

    def at_frame(frame: tuple[Any, Any]) -> Any:
        state, time = frame
        member = system.at(time).recalling(state).members[name]
        measure = jax.vmap(field) if group else field
        return jnp.asarray(measure(member, state[name]))

    clock = jnp.asarray(times, system.dtype)
    measured = np.asarray(jax.jit(lambda x: jax.lax.map(at_frame, x))((states, clock)))
    # One number for all of a rod.
    return measured[..., None] if measured.ndim == 1 + group else measured


def _with_ground(replay: Replay, system: System) -> Replay:
    """With the fixed bodies that rods may touch; a level plane is the floor."""
    fixed: dict[Any, Body] = {}
    for member in system.members.values():
        if isinstance(member, Scene):
            for effect in member.effects:
                if isinstance(effect, Contact):
                    group = member.rod.rest_lengths.ndim > 1
                    for body in _single(effect.body, effect.n_bodies, group):
                        leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(body)]
                        key = (type(body), *(leaf.tobytes() for leaf in leaves))
                        fixed.setdefault(key, body)
    if not fixed:
        return replay
    low, high = replay.bounds()
    meshes: list[Mesh] = []
    for body in fixed.values():
        if isinstance(body, Plane):
            normal = np.asarray(body.normal, float)
            axis = "xyz".index(replay.up)
            if normal[axis] > 0.9999 * np.linalg.norm(normal):
                if replay.floor is None:
                    replay = replace(replay, floor=float(body.point[axis]))
                continue
            leaning = leaning_plane(body, low, high)
            meshes += [] if leaning is None else [leaning]
        else:
            meshes.append(solid_mesh(body, low, high))
    checked = [checked_mesh(k, mesh, replay.times) for k, mesh in enumerate(meshes)]
    return replace(replay, meshes=(*replay.meshes, *checked))


def _single(body: Body, count: int | None, group: bool) -> list[Body]:
    """Bodies one by one, of one rod or of equal rods."""
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
    """Forces of contact at the nodes of all rods [N]."""
    rods = [k for k, m in system.members.items() if isinstance(m, Scene)]

    def at_frame(frame: tuple[Any, Any]) -> dict[str, Any]:
        state, time = frame
        now = system.at(time).recalling(state)
        assert isinstance(now, System)
        total = {name: jnp.zeros_like(state[name].positions) for name in rods}
        for name in rods:
            member = now.members[name]
            assert isinstance(member, Scene)
            one = _on_rod
            if member.rod.rest_lengths.ndim > 1:
                total[name] = total[name] + jax.vmap(one)(member, state[name])
            else:
                total[name] = total[name] + one(member, state[name])
        seen, couplings = seen_at_rest(now, state)
        for coupling in couplings:
            if isinstance(coupling, BodyContact | RodContact):
                for name, loads in coupling.loads(seen).items():
                    if name in rods and loads.forces is not None:
                        force = jnp.stack(loads.forces)
                        if total[name].ndim == 3:
                            force = in_rows(force, total[name].shape[0])
                        total[name] = total[name] + force
        return total

    clock = jnp.asarray(times, system.dtype)
    found = jax.jit(lambda x: jax.lax.map(at_frame, x))((states, clock))
    flat = lambda x: np.moveaxis(np.asarray(x), -2, -1).reshape(len(times), -1, 3)
    origins = np.concatenate([flat(states[name].positions) for name in rods], axis=1)
    vectors = np.concatenate([flat(found[name]) for name in rods], axis=1)
    arrows = Arrows(origins, vectors, "contact force [N]")
    return (checked_arrows(0, arrows, times),)


def _on_rod(scene: Scene, state: Any) -> Any:
    """Forces of contact with fixed bodies on a rod's nodes."""
    total = jnp.zeros_like(state.positions)
    for effect in scene.effects:
        if isinstance(effect, Contact):
            forces = effect.loads(scene.rod, motion_of(state)).forces
            if forces is not None:
                total = total + jnp.stack(forces)
    return total

"""C programs of jaxrod's laws: their compilation, and the numbers they are given."""

from __future__ import annotations

import ctypes
import subprocess
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxrod.loaded_rod import external_loads
from jaxrod.methods.consistent import ConsistentStepper
from jaxrod.rods.motion import motion_of
from jaxrod.systems.contact.neighbour_lists import RECORD
from jaxrod.systems.stepping.stepper import stepper_at

FLAGS = (
    "-O3 -march=native -fno-math-errno -fno-trapping-math -ffinite-math-only "
    "-fno-signed-zeros -ffp-contract=fast"
)
FIELDS = ("positions", "velocities", "orientations", "angular_momenta")
RECORDED = ("missed", "moved", "used")
"""Numbers that are recorded of neighbour lists, by jaxrod and by C programs."""


class Program:
    """A C program, compiled for the sizes of a scene."""

    def __init__(
        self, source: str, settings: Mapping[str, Any], bits: int, folder: Path
    ) -> None:
        """Compiles the program for some settings, with vectors of `bits` bits."""
        name = "_".join([Path(source).stem, *map(str, settings.values()), str(bits)])
        library = folder / f"{name}.so"
        given = [f"-D{key}={value}" for key, value in settings.items()]
        subprocess.run(
            [
                "cc",
                *FLAGS.split(),
                f"-mprefer-vector-width={bits}",
                *given,
                *("-shared", "-fPIC", str(Path(__file__).with_name(source))),
                *("-o", str(library), "-lm"),
            ],
            check=True,
        )
        self._advance = ctypes.CDLL(str(library)).advance
        self._advance.restype = None
        self._advance.argtypes = (
            ctypes.c_void_p,
            ctypes.c_void_p,
            ctypes.c_double,
            ctypes.c_int,
        )

    def __call__(
        self, state: np.ndarray, constants: np.ndarray, dt: float, steps: int
    ) -> np.ndarray:
        """State after some steps."""
        now = state.copy()
        self._advance(now.ctypes.data, constants.ctypes.data, dt, steps)
        return now


def kind(dtype: str) -> str:
    """Name of a type in C."""
    return {"float32": "float", "float64": "double"}[dtype]


def settings_of_lists(contact: Any) -> dict[str, int]:
    """Numbers that a C program of contact with neighbour lists is compiled for."""
    lists = contact.lists
    # One number of pairs holds for all lists.
    room = np.sum(np.broadcast_to(lists.pairs, np.shape(lists.candidates)))
    settings = {"ROOM": int(room), "EVERY": lists.refresh_every}
    if contact.has_contact_points:
        settings["POINTS"] = contact.points_per_element[0]
    return settings


def numbers_of_state(state: Any, names: Sequence[str]) -> np.ndarray:
    """Numbers of the state of a rod or of several, in the order of C programs.

    `names` are the members of a system, one after another; none for a single rod.
    """
    each = [state[name] for name in names] or [state]
    return np.concatenate(
        [np.asarray(getattr(one, field)).ravel() for one in each for field in FIELDS]
    )


def recorded(state: Any, names: Sequence[str]) -> list[float]:
    """Record of neighbour lists in a state; empty if there are none.

    `names` are the members of a system; none for a single rod.
    """
    if not names or RECORD not in state:
        return []
    return [float(getattr(state[RECORD], name)) for name in RECORDED]


def flat(fields: Iterable[Any], dtype: str) -> np.ndarray:
    """Numbers of some fields, one after another."""
    return np.concatenate([np.asarray(field, dtype).ravel() for field in fields])


def numbers_of_rod(stepper: Any, state: Any) -> Iterator[Any]:
    """Constants of a rod in the order of the struct `Rod`, without those at rest."""
    scene, law = stepper.scene, stepper.law
    n, dtype = scene.rod.n_elements, np.asarray(stepper.dt).dtype
    walls = [wall for effect in scene.effects if (wall := effect.wall(scene.rod))]
    stiffness, orientation = np.zeros(3), np.array([1.0, 0, 0, 0])
    if walls:
        (wall,) = walls
        stiffness, orientation = np.asarray(wall.stiffness), wall.orientation
    spread = lambda x, k: np.broadcast_to(0.0 if x is None else np.asarray(x), (k,))
    forces = 3 * (jnp.zeros(n + 1, dtype),)
    couples = 3 * (jnp.zeros(n, dtype),)
    loads = external_loads(scene, motion_of(state), forces, couples)
    yield law.inverse_lengths
    yield np.stack(law.shear_stretch)
    yield _behind(stiffness, law.joint)
    yield orientation
    yield np.stack(loads.forces)
    yield spread(stepper.velocity_kick.gain, n + 1)
    yield spread(stepper.velocity_kick.loss, n + 1)
    yield spread(stepper.spin_kick.gain, n)
    yield spread(stepper.spin_kick.loss, n)
    yield stepper.inverse_inertia
    yield stepper.inertia_contrast
    yield 0.0 if walls else 1.0


def _behind(first: np.ndarray, joints: Any) -> np.ndarray:
    """Numbers of the joints of a rod behind those of the joint with a wall."""
    return np.concatenate([first[:, None], np.stack(joints)], axis=1)


def constants_of_scene(scene: Any, state: Any, dt: float, dtype: str) -> np.ndarray:
    """Constants of a single rod, for `rod.c`."""
    stepper = ConsistentStepper.create(scene, jnp.asarray(dt, dtype))
    return flat(numbers_of_rod(stepper, state), dtype)


def constants_of_joint(system: Any, state: Any, dt: float, dtype: str) -> np.ndarray:
    """Constants of two rods whose nodes are tied, for `joint.c`."""
    stepper = stepper_at(system, state, jnp.asarray(dt, dtype))
    one, two = (stepper.members[name].verlet for name in ("one", "two"))
    last, first = one.scene.rod.node_masses[-1], two.scene.rod.node_masses[0]
    share = first / (last + first)
    rods = [numbers_of_rod(one, state["one"]), numbers_of_rod(two, state["two"])]
    return flat([*rods[0], *rods[1], share], dtype)


def constants_of_contact(system: Any, state: Any, dt: float, dtype: str) -> np.ndarray:
    """Constants of rods that touch, for `crossing.c` and `line.c`.

    A single rod that touches itself is bent at rest.
    """
    stepper = stepper_at(system, state, jnp.asarray(dt, dtype))
    (contact,) = stepper.couplings
    fields: list[Any] = []
    for name in contact.members:
        own = stepper.members[name].verlet
        fields += numbers_of_rod(own, state[name])
        if len(contact.members) == 1:
            fields.append(np.stack(own.law.rest_strains))
            fields.append(_behind(np.zeros(3), own.law.rest_rotations))
    segments = contact.segments
    largest = max(float(np.max(s.radii)) for s in segments)
    joined = lambda name: np.concatenate([getattr(s, name) for s in segments])
    fields += [contact.stiffness, contact.damping, contact.onset]
    fields += [contact.lists.skin * largest]
    fields += map(joined, ("radii", "starts", "rest_lengths"))
    fields.append(np.concatenate([~s.is_end for s in segments]))
    fields += map(joined, ("first_radii", "first_lengths", "is_last"))
    return flat(fields, dtype)

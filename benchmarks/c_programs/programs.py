"""C programs of jaxrod's laws: their compilation, and the numbers they are given."""

from __future__ import annotations

import ctypes
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxrod.loaded_rod import external_loads
from jaxrod.methods.drag_kick import without_drag
from jaxrod.methods.consistent import ConsistentStepper
from jaxrod.rods.motion import motion_of
from jaxrod.systems.stepping.assembly import held_parts
from jaxrod.systems.stepping.stepper import stepper_at

FLAGS = (
    "-O3 -march=native -fno-math-errno -fno-trapping-math -ffinite-math-only "
    "-fno-signed-zeros -ffp-contract=fast -fopenmp-simd"
)
FIELDS = ("positions", "velocities", "orientations", "angular_momenta")
RECORDED = ("missed", "moved", "used")
"""Numbers that are recorded of neighbour lists, by jaxrod and by C programs."""


class Program:
    """A compiled C program with the constants of a scene."""

    def __init__(
        self, source: str, settings: Mapping[str, Any], bits: int, folder: Path
    ) -> None:
        """Compiles the program for some settings and vectors of `bits` bits."""
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


def numbers_of_state(state: Any, names: tuple[str, ...] = ()) -> np.ndarray:
    """Numbers of a rod's state, or of the states of several, as C programs order them.

    `names` are the members of a system, one after another; none for a single rod.
    """
    each = [state[name] for name in names] or [state]
    return np.concatenate(
        [np.asarray(getattr(one, field)).ravel() for one in each for field in FIELDS]
    )


def numbers_of_rod(
    stepper: ConsistentStepper, state: Any, *, bent: bool
) -> Iterator[Any]:
    """Constants of a rod in the order of the struct `Rod`."""
    scene, law = stepper.scene, stepper.law
    n, dtype = scene.rod.n_elements, np.asarray(stepper.dt).dtype
    walls = [wall for effect in scene.effects if (wall := effect.wall(scene.rod))]
    stiffness, orientation = np.zeros(3), np.array([1.0, 0, 0, 0])
    if walls:
        (wall,) = walls
        stiffness, orientation = np.asarray(wall.stiffness), wall.orientation
    before = lambda x, first: np.concatenate([first[:, None], np.stack(x)], axis=1)
    spread = lambda x, k: np.broadcast_to(0.0 if x is None else np.asarray(x), (k,))
    motion = motion_of(state)
    forces = 3 * (jnp.zeros(n + 1, dtype),)
    couples = 3 * (jnp.zeros(n, dtype),)
    loads = external_loads(without_drag(scene), motion, forces, couples)
    yield law.inverse_lengths
    yield np.stack(law.shear_stretch)
    yield before(law.joint, stiffness)
    yield orientation
    yield np.stack(loads.forces)
    yield spread(stepper.velocity_kick.gain, n + 1)
    yield spread(stepper.velocity_kick.loss, n + 1)
    yield spread(stepper.spin_kick.gain, n)
    yield spread(stepper.spin_kick.loss, n)
    yield stepper.inverse_inertia
    yield stepper.inertia_contrast
    yield 0.0 if walls else 1.0
    if bent:
        yield np.stack(law.rest_strains)
        yield before(law.rest_rotations, np.zeros(3))


def flat(fields: Iterator[Any], dtype: str) -> np.ndarray:
    """Numbers of some fields, one after another."""
    return np.concatenate([np.asarray(field, dtype).ravel() for field in fields])


def numbers_of_contact(contact: Any) -> Iterator[Any]:
    """Constants of contact between rods in the order of the struct `Law`."""
    segments = contact.segments
    joined = lambda name: np.concatenate([getattr(s, name) for s in segments])
    yield contact.stiffness
    yield contact.damping
    yield contact.onset
    yield contact._skin()
    yield joined("radii")
    yield joined("starts")
    yield joined("rest_lengths")
    yield np.concatenate([~s.is_end for s in segments])
    yield joined("first_radii")
    yield joined("first_lengths")
    yield joined("is_last")


def numbers_of_system(
    system: Any, state: Any, dt: Any, dtype: str, *, bent: bool
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Constants of a system for its C program, and its members in their order there."""
    stepper = stepper_at(system, state, jnp.asarray(dt, dtype))
    (coupling,) = stepper.couplings
    tied = bool(coupling.joined_nodes())
    names = tuple(sorted(system.members)) if tied else coupling.members
    fields: list[Any] = []
    for name in names:
        own = stepper.members[name].verlet
        fields += list(numbers_of_rod(own, state[name], bent=bent))
    if tied:
        one, two = (held_parts(system, state)[name].node_masses for name in names)
        fields.append(two[0] / (one[-1] + two[0]))
    else:
        fields += list(numbers_of_contact(coupling))
    return flat(iter(fields), dtype), names

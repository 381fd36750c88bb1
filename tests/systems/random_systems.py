"""Random systems in float32: nothing blows up, and energy is where it was or less.

    PYTHONPATH=tests python tests/systems/random_systems.py --structures 50 --each 20

Two to six rods and bodies in a random tree of joints of all kinds, which move, fall,
hit each other, and have drag and dashpots or not. All systems of a structure, whose
numbers are drawn one by one, run as one batch for 400 steps of the length that
`stable_dt` gives, and as long at half of it. Exits with 1 if one system fails: if a
number is not finite and `health` does not flag it.

With `--wide`, densities and moduli are drawn over so many decades that members differ
by up to 1e6 in mass and in stiffness. `--safety 1` steps at the bound itself instead of
0.8 of it. `--dtype float64` casts the same systems, and `--compensated` sums positions
with compensation, so that what is left is not round-off. `--record FILE` adds a line of
JSON for each structure and leaves out those that have one.

Rods that are stretched or bent so far that `health` flags them have left what the
bound is for: it is that of unstressed shapes, and the moment of a joint jumps at half a
turn. They are counted separately.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from jaxrod.systems.stepping.assembly import seen_at_rest
from jaxrod.validation import astype

ROD_JOINTS = ("tie", "weld", "ball", "hinge", "rigid", "spring")
BODY_JOINTS = ("attach", "attach turning", "ball", "hinge", "rigid", "spring")
SHAPES = ("sphere", "box", "capsule", "cylinder")
LOSSES = ("none", "damping", "stokes", "quadratic", "internal")
SAMPLES = 40
"""Moments at which energy is looked at, by default."""
STEPS = 10
"""Steps from one to the next, at the step of `stable_dt`."""


@dataclass(frozen=True)
class Ranges:
    """Decades from which numbers are drawn, and the share of the bound in a step."""

    density: tuple[float, float] = (2.5, 3.5)
    youngs_modulus: tuple[float, float] = (5.5, 7.0)
    safety: float = 0.8

    def drawn(self, name: str, random: np.random.Generator) -> float:
        """A number that is as likely in each decade."""
        return float(10 ** random.uniform(*getattr(self, name)))


USUAL = Ranges()
WIDE = Ranges(density=(1.0, 7.0), youngs_modulus=(4.0, 10.0))


@dataclass(frozen=True)
class Structure:
    """All of a random system that is not a number."""

    kinds: tuple[Any, ...]
    """Of each member: a rod's number of elements, or the shape of a body."""
    parents: tuple[int, ...]
    """Of every member but the first: the rod that it is joined to."""
    nodes: tuple[int, ...]
    """And the node."""
    joints: tuple[str, ...]
    losses: tuple[str, ...]
    """Of each member."""
    dashpots: bool
    touches: bool
    rubs: bool
    held: bool
    falls: bool

    @property
    def loses(self) -> bool:
        """Whether anything takes energy away."""
        return self.dashpots or any(loss != "none" for loss in self.losses)


def random_structure(random: np.random.Generator) -> Structure:
    """Structure of a system of two to six members, the first of them a rod."""
    count = int(random.integers(2, 7))
    kinds: list[Any] = [int(random.integers(3, 7))]
    parents, nodes, joints = [], [], []
    lossy = random.random() < 0.5
    for _ in range(count - 1):
        taken = set(zip(parents, nodes, strict=True))
        free = [
            (k, node)
            for k, kind in enumerate(kinds)
            for node in range(1, kind + 1 if isinstance(kind, int) else 1)
            if (k, node) not in taken
        ]
        if not free:
            break
        parent, node = free[random.integers(len(free))]
        parents.append(parent)
        nodes.append(node)
        is_rod = random.random() < 0.6
        kinds.append(int(random.integers(3, 7)) if is_rod else random.choice(SHAPES))
        joints.append(str(random.choice(ROD_JOINTS if is_rod else BODY_JOINTS)))
    losses = [
        str(random.choice(LOSSES if isinstance(kind, int) else LOSSES[:2]))
        if lossy
        else "none"
        for kind in kinds
    ]
    touches = sum(isinstance(kind, int) for kind in kinds) > 1
    return Structure(
        tuple(kinds),
        tuple(parents),
        tuple(nodes),
        tuple(joints),
        tuple(losses),
        dashpots=lossy and random.random() < 0.5,
        touches=touches and random.random() < 0.7,
        rubs=lossy and random.random() < 0.5,
        held=random.random() < 0.4,
        falls=random.random() < 0.6,
    )


def unit(random: np.random.Generator) -> np.ndarray:
    """A direction, all alike likely."""
    vector = random.normal(size=3)
    return vector / np.linalg.norm(vector)


def loss_of(kind: str, random: np.random.Generator) -> list[Any]:
    """The effect that takes energy from a member."""
    size = 10 ** random.uniform(-1, 1)
    return {
        "none": lambda: [],
        "damping": lambda: [jaxrod.exponential_damping(size)],
        "stokes": lambda: [jaxrod.fluids.stokes_drag(0.3 * size, size, 1e-4 * size)],
        "quadratic": lambda: [jaxrod.fluids.quadratic_drag(100.0 * size)],
        "internal": lambda: [jaxrod.internal_damping(1e-3 * size)],
    }[kind]()


def places(
    structure: Structure, random: np.random.Generator
) -> tuple[list[np.ndarray], list[np.ndarray], list[float]]:
    """Starts, directions and lengths of members that are clear of each other.

    Raises:
        RuntimeError: If none are found.
    """
    for _ in range(1000):
        starts, ways, lengths = [np.zeros(3)], [unit(random)], []
        lengths.append(random.uniform(0.3, 0.6))
        for parent, node in zip(structure.parents, structure.nodes, strict=True):
            along = lengths[parent] * node / structure.kinds[parent]
            starts.append(starts[parent] + along * ways[parent])
            ways.append(unit(random))
            lengths.append(random.uniform(0.3, 0.6))
        if _clear(structure, starts, ways, lengths):
            return starts, ways, lengths
    raise RuntimeError("no room for these members")


def _clear(structure: Structure, starts: Any, ways: Any, lengths: Any) -> bool:
    """Whether no two members are near each other but at their joints."""
    share = np.linspace(0, 1, 25)[:, None]
    lines = [
        s + share * (length if isinstance(kind, int) else 0.12) * w
        for s, w, length, kind in zip(
            starts, ways, lengths, structure.kinds, strict=True
        )
    ]
    for a in range(len(lines)):
        for b in range(a):
            own, one = lines[a], lines[b]
            apart = np.linalg.norm(own[:, None] - one[None], axis=2)
            if structure.parents[a - 1] == b:
                # Members that share a joint part from it at an angle.
                far = [np.linalg.norm(x - starts[a], axis=1) > 0.1 for x in (own, one)]
                if np.min(apart[far[0]][:, far[1]], initial=1) < 0.07:
                    return False
            elif np.min(apart) < 0.045:
                return False
    return True


def shape_at(kind: str, start: np.ndarray, way: np.ndarray) -> Any:
    """A body of some 5 cm that begins at a point and extends in a direction."""
    centre = start + 0.04 * way
    if kind == "sphere":
        return jaxrod.shapes.sphere(centre, 0.04)
    if kind == "box":
        return jaxrod.shapes.box(centre, (0.04, 0.03, 0.02))
    make = jaxrod.shapes.capsule if kind == "capsule" else jaxrod.shapes.cylinder
    return make(start, start + 0.08 * way, 0.025)


def build(
    structure: Structure, random: np.random.Generator, ranges: Ranges = USUAL
) -> tuple[Any, Any]:
    """A system of a structure, with random numbers, and its state."""
    starts, ways, lengths = places(structure, random)
    names = [f"m{k}" for k in range(len(starts))]
    members: dict[str, Any] = {}
    rest: dict[str, Any] = {}
    moving: dict[str, Any] = {}
    for k, name in enumerate(names):
        kind = structure.kinds[k]
        effects = loss_of(structure.losses[k], random)
        if structure.falls:
            effects.append(jaxrod.gravity((0.0, 0.0, -9.81)))
        if isinstance(kind, int):
            rod, state = jaxrod.straight_rod(
                kind,
                length=lengths[k],
                radius=random.uniform(0.008, 0.02),
                density=ranges.drawn("density", random),
                youngs_modulus=ranges.drawn("youngs_modulus", random),
                start=starts[k],
                direction=ways[k],
                dtype=jnp.float32,
            )
            if k == 0 and structure.held:
                effects.append(jaxrod.clamp(state))
            members[name] = jaxrod.make_scene(rod, *effects)
            along = np.linspace(0, 2, kind + 1)[None, :]
            a, b = random.normal(size=(2, 3, 1)) * 0.3
            speeds = jnp.asarray(a * np.sin(along) + b * np.cos(along), jnp.float32)
            moving[name] = replace(state, velocities=speeds)
        else:
            members[name], state = jaxrod.systems.rigid_body(
                shape_at(kind, starts[k], ways[k]),
                density=ranges.drawn("density", random),
                effects=tuple(effects),
                velocity=0.3 * random.normal(size=3),
                angular_velocity=3 * random.normal(size=3),
                dtype=jnp.float32,
            )
            moving[name] = state
        rest[name] = state
    couplings = [
        joint_of(structure, k, names, rest, starts, random)
        for k in range(len(structure.joints))
    ]
    couplings += contacts_of(structure, names, random)
    system = jaxrod.make_system(members, *couplings, state=rest)
    # A step of no length: what is tied has one velocity from then on.
    return system, jaxrod.advance(system, moving, 1e-9, 1)


def joint_of(
    structure: Structure,
    k: int,
    names: list[str],
    state: Any,
    starts: Any,
    random: np.random.Generator,
) -> Any:
    """The joint between the member after the k-th and its parent."""
    parent, kind = structure.kinds[structure.parents[k]], structure.kinds[k + 1]
    a = (names[structure.parents[k]], structure.nodes[k])
    is_rod = isinstance(kind, int)
    b: Any = (names[k + 1], "base") if is_rod else (names[k + 1],)
    assert parent >= structure.nodes[k]
    stiff = 10 ** random.uniform(2, 3.5)
    turn = 10 ** random.uniform(-1, 0.5)
    drag = {"damping": 0.3 * stiff**0.5 * 0.1} if structure.dashpots else {}
    turning = {"turning_damping": 1e-3 * turn} if structure.dashpots else {}
    kinds = {
        "tie": lambda: jaxrod.systems.tie(a, b, state),
        "weld": lambda: jaxrod.systems.weld(a, b, state),
        "attach": lambda: jaxrod.systems.attach(a, b, state),
        "attach turning": lambda: jaxrod.systems.attach(a, b, state, turning=True),
        "ball": lambda: jaxrod.systems.ball_joint(a, b, state, stiffness=stiff, **drag),
        "hinge": lambda: jaxrod.systems.hinge_joint(
            a,
            b,
            state,
            axis=unit(random),
            stiffness=stiff,
            axis_stiffness=turn,
            at=starts[k + 1],
            **drag,
        ),
        "rigid": lambda: jaxrod.systems.fixed_joint(
            a, b, state, stiffness=stiff, turning_stiffness=turn, **drag, **turning
        ),
        "spring": lambda: jaxrod.systems.spring(
            a,
            b,
            state,
            stiffness=stiff,
            at=(starts[k + 1], starts[k + 1] + 0.03 * unit(random)),
            **drag,
        ),
    }
    return kinds[structure.joints[k]]()


def contacts_of(
    structure: Structure, names: list[str], random: np.random.Generator
) -> list[Any]:
    """Contact of all rods, and of rods with bodies that they are not joined to."""
    if not structure.touches:
        return []
    given: dict[str, Any] = {"stiffness": 10 ** random.uniform(3, 4.5)}
    if structure.rubs:
        given |= {"damping": 1.0, "friction": random.uniform(0.1, 1.0)}
    rods = [k for k, kind in enumerate(structure.kinds) if isinstance(kind, int)]
    made = [
        jaxrod.systems.rod_contact(
            *(names[k] for k in rods), points_per_element=6, **given
        )
    ]
    for k, kind in enumerate(structure.kinds):
        others = [rod for rod in rods if k > 0 and rod != structure.parents[k - 1]]
        if not isinstance(kind, int) and others:
            made.append(
                jaxrod.systems.body_contact(
                    names[others[0]], names[k], points_per_element=6, **given
                )
            )
    return made


@jax.jit
def _limits(systems: Any, safety: Any) -> Any:
    return jax.vmap(lambda system: jaxrod.stable_dt(system, safety).dt)(systems)


@jax.jit
@jax.vmap
def _flags(system: Any, state: Any, dt: Any, before: Any, n_steps: Any) -> Any:
    seen = jaxrod.health(system, state, dt, energy_before=before, n_steps=n_steps)
    return {"any": seen.flagged, "energy": seen.energy, "joints": seen.joints}


def energies(system: Any, state: Any) -> Any:
    """Kinetic and total energy [J]."""
    return system.kinetic_energy(state), system.total_energy(state)


def strained(system: Any, state: Any, dt: Any) -> Any:
    """Whether a rod is stretched or bent so far that `health` flags it."""
    limits = jaxrod.HealthLimits()
    rods = [
        own.health(state[name], dt, limits)
        for name, own in system.interfaces().items()
        if own.rod is not None
    ]
    return jnp.any(jnp.stack([own.stretch | own.joint_angle for own in rods]))


def turned(system: Any, state: Any) -> Any:
    """Whether a joint between members is turned so far that `health` flags it."""
    seen, couplings = seen_at_rest(system, state)
    turns = [coupling.joint_angle(seen) for coupling in couplings]
    known = [turn for turn in turns if turn is not None]
    limit = jaxrod.HealthLimits().largest_joint_angle
    return jnp.any(jnp.stack([jnp.zeros(()), *known]) > limit)


def faults(system: Any, state: Any, dt: Any) -> Any:
    """Whether rods are strained too far, and whether joints are turned too far."""
    return jnp.stack([strained(system, state, dt), turned(system, state)])


@jax.jit
@jax.vmap
def _started(system: Any, state: Any, dt: Any) -> Any:
    return *energies(system, state), faults(system, state, dt)


@jax.jit
@jax.vmap
def _later(system: Any, state: Any, dt: Any) -> Any:
    after = jaxrod.advance(system, state, dt, STEPS)
    return after, (*energies(system, after), faults(system, after, dt))


def run(systems: Any, states: Any, dt: Any, share: int, samples: int) -> Any:
    """Energies [J] of a batch of systems, kinetic and total, `(systems, samples)`.

    One program for steps of `dt` and of a `share` of it. Also returns whether rods are
    strained, and whether joints are turned, beyond the limits of `health`, `(systems,
    samples, 2)`, and the last states.
    """
    seen = [_started(systems, states, dt / share)]
    for sample in range(samples * share):
        states, energy = _later(systems, states, dt / share)
        if (sample + 1) % share == 0:
            seen.append(energy)
    return *jax.tree.map(lambda *leaves: np.stack(leaves, axis=1), *seen), states


def examined(
    structure: Structure,
    each: int,
    seed: int,
    ranges: Ranges = USUAL,
    samples: int = SAMPLES,
    dtype: str = "float32",
    compensated: bool = False,
) -> dict[str, np.ndarray]:
    """What becomes of systems of a structure.

    Returns:
        Of each system: `finite`, `drift` of the energy over the largest kinetic energy
        at the step of `stable_dt`, `finer` at half of it, `gain` of energy where it
        must fall; which flags `health` raises at the end; and whether it flagged the
        `strains` of a rod, or a joint that is `turned`, on the way.
    """
    random = np.random.default_rng(seed)
    with jax.enable_x64(False):
        made = [build(structure, random, ranges) for _ in range(each)]
    systems, states = jax.tree.map(lambda *leaves: jnp.stack(leaves), *made)
    systems, states = astype((systems, states), dtype)
    if compensated:
        states = {
            k: jax.vmap(jaxrod.compensated)(own) if own.layout.is_rod else own
            for k, own in states.items()
        }
    dt = _limits(systems, ranges.safety)
    found = {}
    for name, share in (("drift", 1), ("finer", 2)):
        kinetic, total, beyond, last = run(systems, states, dt, share, samples)
        steps = jnp.full(each, float(samples * STEPS * share), dt.dtype)
        flags = _flags(systems, last, dt / share, total[:, 0], steps)
        found |= {f"{k} flagged at {name}": np.asarray(v) for k, v in flags.items()}
        size = np.max(kinetic, axis=1)
        for k, flag in enumerate(("strains", "turned")):
            found[f"{flag} flagged at {name}"] = np.any(beyond[:, :, k], axis=1)
        found[f"finite at {name}"] = np.all(np.isfinite(total), axis=1)
        rise = np.maximum.accumulate(total[:, ::-1], axis=1)[:, ::-1] - total
        found[f"{name} gain"] = np.max(rise, axis=1) / size
        found[name] = np.max(np.abs(total - total[:, :1]), axis=1) / size
    return found


def main() -> int:
    """Draws structures and examines systems of each; prints and counts failures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--structures", type=int, default=50)
    parser.add_argument("--each", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=SAMPLES * STEPS)
    parser.add_argument("--safety", type=float, default=USUAL.safety)
    parser.add_argument("--wide", action="store_true", help="members differ by 1e6")
    parser.add_argument("--dtype", default="float32", choices=("float32", "float64"))
    parser.add_argument("--compensated", action="store_true", help="sums of positions")
    parser.add_argument("--record", type=Path, metavar="FILE", help="lines of JSON")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", options.dtype == "float64")
    ranges = replace(WIDE if options.wide else USUAL, safety=options.safety)
    rows = _recorded(options.record)
    done = {(row["seed"], row["number"]) for row in rows}
    for k in range(options.structures):
        if (options.seed, k) in done:
            continue
        structure = random_structure(np.random.default_rng([options.seed, k]))
        try:
            found = examined(
                structure,
                options.each,
                k,
                ranges,
                max(options.steps // STEPS, 1),
                options.dtype,
                options.compensated,
            )
        except RuntimeError as crowded:
            print(f"{k}: {crowded}")
            continue
        row = {"seed": options.seed, "number": k, **_row(structure, found, ranges)}
        rows.append(row)
        print(json.dumps(row), flush=True)
        if options.record is not None:
            with options.record.open("a") as file:
                file.write(json.dumps(row) + "\n")
    silent = sum(row["not finite without a flag"] for row in rows)
    print(
        f"{sum(row['systems'] for row in rows)} systems, "
        f"{sum(row['not finite'] for row in rows)} not finite, {silent} of them "
        f"without a flag; energy off by at most {max(r['finer'] for r in rows):.1e} of "
        "the largest kinetic energy at half the step, and by at most "
        f"{max(r['drift'] for r in rows):.1e} at the step"
    )
    return 1 if silent else 0


def _recorded(file: Path | None) -> list[dict[str, Any]]:
    """Rows that a file has; none if there is no file."""
    if file is None or not file.exists():
        return []
    return [json.loads(line) for line in file.read_text().splitlines()]


def _row(
    structure: Structure, found: dict[str, np.ndarray], ranges: Ranges
) -> dict[str, Any]:
    """Counts and largest figures of the systems of a structure, for JSON."""
    words = " gain" if structure.loses else ""
    row: dict[str, Any] = {"systems": len(found["drift"])}
    bad = {name: ~found[f"finite at {name}"] for name in ("drift", "finer")}
    row["not finite"] = int(np.sum(bad["drift"] | bad["finer"]))
    row["not finite without a flag"] = int(
        sum(np.sum(bad[k] & ~found[f"any flagged at {k}"]) for k in bad)
    )
    for name in bad:
        values = np.where(bad[name], np.inf, found[f"{name}{words}"])
        row[name] = float(np.max(values))
        row[f"median {name}"] = float(np.median(values))
        row[f"above 1e-3 at {name}"] = int(np.sum(values > 1e-3))
        sound = ~found[f"strains flagged at {name}"]
        row[f"above 1e-3 at {name}, strains not flagged"] = [
            f"{j}: {values[j]:.2g}" for j in np.flatnonzero(sound & (values > 1e-3))
        ]
        off = np.flatnonzero(values > 1e-3)
        row[f"above 1e-3 at {name}, turned"] = [
            int(j) for j in off if found[f"turned flagged at {name}"][j]
        ]
        for flag in ("any", "energy", "joints", "strains", "turned"):
            row[f"{flag} flagged at {name}"] = int(
                np.sum(found[f"{flag} flagged at {name}"])
            )
    return row | {"ranges": asdict(ranges), "structure": str(structure)}


if __name__ == "__main__":
    sys.exit(main())

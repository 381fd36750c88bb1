"""Steps of systems and scenes with contact, compared with PyElastica.

Each scene has the same rods and numbers of elements in both libraries. PyElastica runs
in float64, and jaxrod in float64 or, on request, in float32. Prints for both the
processor time of a step, the step size (PyElastica's is that of its examples, ours is
`stable_dt`), and seconds of motion per second of processor time. jaxrod runs one scene,
and 64 under `jax.vmap`, on one core. Windows of all programs alternate, and the
shortest of five counts, because the machine may be busy with other work.
"""

from __future__ import annotations

import argparse
import functools
import os
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from benchmarks.shared.arguments import add_names

BATCH = 64


class Scene(NamedTuple):
    """One scene in both libraries."""

    model: Any
    state: Any
    dt: float
    step: Callable[[], None]
    """Steps PyElastica's once."""
    their_dt: float
    their_rods: tuple[Any, ...] = ()


def simulator(*features: str) -> Any:
    """An empty simulator of PyElastica with some of its features."""
    import elastica as ea

    bases = (ea.BaseSystemCollection, *(getattr(ea, name) for name in features))
    return type("Simulator", bases, {})()


def stepping(collection: Any, dt: float) -> Callable[[], None]:
    """Repeated steps of PyElastica."""
    import elastica as ea

    collection.finalize()
    stepper, clock = ea.PositionVerlet(), [np.float64(0.0)]

    def step() -> None:
        clock[0] = stepper.step(collection, clock[0], np.float64(dt))

    return step


def snake(n: int = 50, their_dt: float = 1e-4) -> Scene:
    """The continuum snake: a wave of couples, anisotropic friction of the ground."""
    import elastica as ea

    length, period, froude, gravity = 0.35, 2.0, 0.1, 9.80665
    radius, density = 0.011 * length, 1000.0
    sizes = 1e-3 * np.asarray([3.4, 3.3, 4.2, 2.6, 3.6, 3.5])
    unit = length / (period**2 * gravity * froude)
    mass = np.pi * radius**2 * density
    rod, state = jaxrod.straight_rod(
        n,
        length=length,
        radius=radius,
        density=density,
        youngs_modulus=1e6,
        direction=(1.0, 0.0, 0.0),
        normal=(0.0, 0.0, 1.0),
        start=(0.0, 0.0, 0.95 * radius),
    )
    scene = jaxrod.make_scene(
        rod,
        jaxrod.gravity((0.0, 0.0, -gravity)),
        jaxrod.actuation.muscle_torques(
            rod,
            sizes,
            period=period,
            wave_number=2 * np.pi,
            direction=(0.0, 0.0, 1.0),
            ramp_up_time=period,
        ),
        jaxrod.contact(
            jaxrod.shapes.plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
            stiffness=mass * gravity / (0.05 * radius),
            damping=300.0 * mass,
            friction=unit * np.asarray([1.0, 1.5, 2.0]),
            friction_drag=1000.0 * mass,
        ),
        jaxrod.exponential_damping(2e-3, 8e-3 / radius**2),
    )
    theirs = simulator("Forcing", "Damping", "Contact")
    up = np.asarray([0.0, 0.0, 1.0])
    their_rod = ea.CosseratRod.straight_rod(
        n,
        np.asarray([0.0, 0.0, radius]),
        np.asarray([1.0, 0.0, 0.0]),
        up,
        length,
        radius,
        density,
        youngs_modulus=1e6,
        shear_modulus=1e6 / 1.5,
    )
    ground = ea.Plane(np.zeros(3), up)
    theirs.append(their_rod)
    theirs.append(ground)
    theirs.add_forcing_to(their_rod).using(ea.GravityForces, acc_gravity=-gravity * up)
    theirs.add_forcing_to(their_rod).using(
        ea.MuscleTorques,
        base_length=length,
        b_coeff=sizes,
        period=period,
        wave_number=2 * np.pi,
        phase_shift=0.0,
        rest_lengths=their_rod.rest_lengths,
        ramp_up_time=period,
        direction=up,
        with_spline=True,
    )
    friction = unit * np.asarray([1.0, 1.5, 2.0])
    theirs.detect_contact_between(their_rod, ground).using(
        ea.RodPlaneContactWithAnisotropicFriction,
        k=1.0,
        nu=1e-6,
        slip_velocity_tol=1e-8,
        static_mu_array=np.zeros(3),
        kinetic_mu_array=friction,
    )
    theirs.dampen(their_rod).using(
        ea.AnalyticalLinearDamper, damping_constant=2e-3, time_step=their_dt
    )
    dt = float(jaxrod.stable_dt(scene).dt)
    step = stepping(theirs, their_dt)
    return Scene(scene, state, dt, step, their_dt, (their_rod,))


def joint(n: int = 10, their_dt: float = 1e-5) -> Scene:
    """Two rods, the first clamped, that share a node and turn freely there."""
    import elastica as ea

    numbers = {"density": 1750.0, "youngs_modulus": 3e7, "shear_modulus": 1e7}
    length, radius = 0.2, 0.007

    def rod(start: float) -> Any:
        return jaxrod.straight_rod(
            n,
            length=length,
            radius=radius,
            start=(0.0, 0.0, start),
            normal=(0.0, 1.0, 0.0),
            **numbers,
        )

    (one, of_one), (two, of_two) = rod(0.0), rod(length)
    state = {"one": of_one, "two": of_two}
    system = jaxrod.make_system(
        {
            "one": jaxrod.make_scene(
                one, jaxrod.clamp(of_one), jaxrod.exponential_damping(4.0)
            ),
            "two": jaxrod.make_scene(
                two,
                jaxrod.end_load((0.05, 0.0, 0.0)),
                jaxrod.exponential_damping(4.0),
            ),
        },
        jaxrod.systems.tie(("one", "tip"), ("two", "base"), state),
        state=state,
    )
    theirs = simulator("Constraints", "Connections", "Forcing", "Damping")
    rods = []
    for start in (0.0, length):
        rods.append(
            ea.CosseratRod.straight_rod(
                n,
                np.asarray([0.0, 0.0, start]),
                np.asarray([0.0, 0.0, 1.0]),
                np.asarray([0.0, 1.0, 0.0]),
                length,
                radius,
                **numbers,
            )
        )
        theirs.append(rods[-1])
        theirs.dampen(rods[-1]).using(
            ea.AnalyticalLinearDamper,
            uniform_damping_constant=4.0,
            time_step=their_dt,
        )
    theirs.constrain(rods[0]).using(
        ea.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,)
    )
    theirs.connect(
        first_rod=rods[0],
        second_rod=rods[1],
        first_connect_idx=-1,
        second_connect_idx=0,
    ).using(ea.FreeJoint, k=1e5, nu=0)
    theirs.add_forcing_to(rods[1]).using(
        ea.EndpointForces, np.zeros(3), np.asarray([0.05, 0.0, 0.0]), ramp_up_time=1e-9
    )
    dt = float(jaxrod.stable_dt(system).dt)
    step = stepping(theirs, their_dt)
    return Scene(system, state, dt, step, their_dt, tuple(rods))


def plectoneme(n: int = 150) -> Scene:
    """A rod wound around itself, two strands in a double helix that touch all along."""
    import elastica as ea

    length, radius = 1.0, 0.004
    numbers = {"density": 1000.0, "youngs_modulus": 1e6, "shear_modulus": 4e5}
    positions = wound(n, length, radius)
    lists = jaxrod.systems.neighbour_lists(refresh_every=64)
    rod, state = jaxrod.rod_along(positions, radius=radius, **numbers)
    state = {"rope": state}
    touch = jaxrod.systems.rod_contact(
        "rope", stiffness=1e4, damping=1.0, self_contact=True, lists=lists
    )
    scene = jaxrod.make_scene(rod, jaxrod.exponential_damping(4.0))
    system = jaxrod.make_system({"rope": scene}, touch, state=state)
    theirs = simulator("Damping", "Contact")
    their_rod = ea.CosseratRod.straight_rod(
        n,
        positions[:, 0],
        np.asarray([1.0, 0.0, 0.0]),
        np.asarray([0.0, 0.0, 1.0]),
        length,
        radius,
        position=positions,
        directors=np.asarray(state["rope"].directors),
        **numbers,
    )
    # At rest as it is wound, as ours.
    their_rod.compute_internal_forces_and_torques(np.float64(0.0))
    their_rod.rest_sigma[:] = their_rod.sigma
    their_rod.rest_kappa[:] = their_rod.kappa
    theirs.append(their_rod)
    theirs.dampen(their_rod).using(
        ea.AnalyticalLinearDamper, uniform_damping_constant=4.0, time_step=1e-5
    )
    theirs.detect_contact_between(their_rod, their_rod).using(
        ea.RodSelfContact, k=1e4 * length / n, nu=1.0 * length / n
    )
    dt = float(jaxrod.stable_dt(system).dt)
    return Scene(system, state, dt, stepping(theirs, 1e-5), 1e-5)


def muscular() -> Scene:
    """PyElastica's muscular snake: nine rods, eight of them glued to the first."""
    import elastica as ea

    from benchmarks.muscular_snake.scene import STEP, ours, theirs

    system, state = ours()
    simulator, _ = theirs()
    stepper, clock = ea.PositionVerlet(), [np.float64(0.0)]

    def step() -> None:
        clock[0] = stepper.step(simulator, clock[0], np.float64(STEP))

    return Scene(system, state, float(jaxrod.stable_dt(system).dt), step, STEP)


def wound(n: int, length: float, radius: float) -> np.ndarray:
    """Nodes of a rod that turns back at its middle and winds around itself [m]."""
    apart, pitch = 0.99 * radius, 8 * radius
    loop = np.pi * apart
    each = 0.5 * (length - loop)
    rise = each / np.hypot(1, 2 * np.pi * apart / pitch)
    s = np.linspace(0, length, 4001)
    along = np.where(s < each, s, np.where(s > length - each, length - s, each))
    height = along / each * rise
    round_it = np.clip((s - each) / loop, 0, 1) * np.pi
    angle = 2 * np.pi * height / pitch + round_it
    bulge = apart * np.sin(round_it)
    line = np.stack([height + bulge, apart * np.cos(angle), apart * np.sin(angle)])
    way = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line), axis=0))])
    even = np.linspace(0, way[-1], n + 1)
    return np.stack([np.interp(even, way, x) for x in line])


SCENES: dict[str, Callable[[], Scene]] = {
    "snake": snake,
    "joint": joint,
    "plectoneme": plectoneme,
    "muscular": muscular,
}


def processor(run: Callable[[], Any]) -> float:
    """Processor time of a call [s]."""
    begin = time.process_time()
    run()
    return time.process_time() - begin


def measure(name: str, seconds: float) -> None:
    """Prints the lines of a scene."""
    scene = SCENES[name]()
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf] * BATCH), scene.state)

    @functools.partial(jax.jit, static_argnums=1)
    def many(states: Any, steps: int) -> Any:
        one = lambda state: jaxrod.advance(scene.model, state, scene.dt, steps)
        return jax.vmap(one)(states)

    runs: dict[str, tuple[Callable[[int], Any], float, int]] = {
        "PyElastica": (
            lambda steps: [scene.step() for _ in range(steps)],
            scene.their_dt,
            1,
        ),
        "one": (
            lambda steps: jax.block_until_ready(
                jaxrod.advance(scene.model, scene.state, scene.dt, steps)
            ),
            scene.dt,
            1,
        ),
        f"one of {BATCH}": (
            lambda steps: jax.block_until_ready(many(batch, steps)),
            scene.dt,
            BATCH,
        ),
    }
    counts, least = {}, {}
    for label, (run, _, _) in runs.items():
        steps = 64
        run(steps)
        spent = processor(lambda run=run, steps=steps: run(steps))
        counts[label] = 64 * max(1, round(seconds / spent))
        run(counts[label])
        least[label] = np.inf
    for _ in range(5):
        for label, (run, _, width) in runs.items():
            steps = counts[label]
            spent = processor(lambda run=run, steps=steps: run(steps))
            least[label] = min(least[label], spent / steps / width)
    theirs = least["PyElastica"] / scene.their_dt
    for label, (_, dt, _) in runs.items():
        print(
            f"{name:10s} {label:10s}: {1e6 * least[label]:9.2f} us a step "
            f"({least['PyElastica'] / least[label]:6.1f} x), dt {1e6 * dt:7.2f} us, "
            f"{dt / least[label]:9.3f} s of motion per second of processor time "
            f"({theirs / (least[label] / dt):6.1f} x)",
            flush=True,
        )


def on_one_core(*, double: bool = True) -> None:
    """Keeps this process on one core, in float64 or float32."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    jax.config.update("jax_enable_x64", double)
    jaxrod.configure_cpu(devices=1)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the scenes."""
    add_names(parser, "scenes", SCENES, "SCENE")
    parser.add_argument("--seconds", type=float, default=2.0, help="of a window")
    parser.add_argument("--float32", action="store_true", help="ours in float32")


def run(args: argparse.Namespace) -> int:
    """Measures the scenes that are named, or all."""
    on_one_core(double=not args.float32)
    for name in args.scenes:
        measure(name, args.seconds)
    return 0

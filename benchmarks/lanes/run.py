"""Lanes, rows and XLA compared on one core: docs/performance.md.

The tables are `speed` (rod-steps per second of scenes of many kinds, in a batch of
256), `gradient` (value and gradient of 1000 steps, in a batch of 64), `length` (5 to
1000 elements), `batch` (1 to 65536 rods), `many` (64 systems with contact), `single`
(one scene or system, without a batch) and `single_gradient` (its gradient). The default
is all. Tables that are not measured do not change.

Both programs compile first. Then windows of both alternate, and the shortest of five
counts for each. Times are processor time of one core, and the first calls, which
compile, are listed separately.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from benchmarks.shared.arguments import add_names
from benchmarks.shared.files import ROOT, example
from benchmarks.shared.page_tables import measured_table
from jaxrod.envs import make

PAGE = ROOT / "docs" / "performance.md"
WINDOWS = 5
MODES = ("auto", "never")
SINGLE_MODES = ("auto", "never")
FORWARD = (
    "lanes [million rod-steps/s] | XLA [million rod-steps/s] | speed ratio "
    "| first call, lanes [s] | first call, XLA [s] |\n|---|---:|---:|---:|---:|---:|"
)
HEADS = {
    "speed": f"| scene, batch of 256 | {FORWARD}",
    "gradient": (
        "| value and gradient of 1000 steps, batch of 64 | lanes [us per rod-step] "
        "| XLA [us per rod-step] | speed ratio | lanes: gradient / forward pass "
        "| first call, lanes [s] | first call, XLA [s] |\n"
        "|---|---:|---:|---:|---:|---:|---:|"
    ),
    "length": f"| elements, batch of 256 | {FORWARD}",
    "batch": f"| rods of 20 elements | {FORWARD}",
    "many": (
        "| batch of 64 systems | kernel | kernel [us per step of one system] "
        "| XLA [us per step of one system] | speed ratio | first call, kernel [s] "
        "| first call, XLA [s] |\n|---|---|---:|---:|---:|---:|---:|"
    ),
    "single": (
        "| one scene or system | rows [us per step] | XLA [us per step] | speed ratio "
        "| first call, rows [s] | first call, XLA [s] |\n"
        "|---|---:|---:|---:|---:|---:|"
    ),
    "single_gradient": (
        "| value and gradient of 200 steps | rows [us per step] | XLA [us per step] "
        "| speed ratio | rows: gradient / forward pass | first call, rows [s] "
        "| first call, XLA [s] |\n|---|---:|---:|---:|---:|---:|---:|"
    ),
}

Program = Callable[[], Any]


def arm(n: int, *, dtype: str = "float32", **how: Any) -> tuple[Any, Any, Any]:
    """A clamped, damped arm under gravity with couples on its elements."""
    rod, state = jaxrod.straight_rod(
        n,
        length=1.0,
        radius=0.05,
        density=1000.0,
        youngs_modulus=1e7,
        direction=(1.0, 0.0, 0.0),
        normal=(0.0, 0.0, 1.0),
        dtype=dtype,
    )
    effects = [
        jaxrod.clamp(state),
        jaxrod.exponential_damping(4.0),
        jaxrod.gravity((0.0, -9.81, 0.0)),
    ]
    if "method" not in how:
        couples = jnp.zeros((3, n), state.positions.dtype).at[0].set(0.3)
        effects.append(jaxrod.actuation.ElementCouples(couples))
    scene = jaxrod.make_scene(rod, *effects, **how)
    return scene, state, 0.5 * jaxrod.stable_dt(scene).dt


def of_task(name: str) -> tuple[Any, Any, Any]:
    """The scene of a task under some action, as an environment steps it."""
    env = make(name, variant="clean")
    params = env.default_params()
    _, state = env.reset(jax.random.key(0), params)
    turning = {"tracking": 2, "reaching": 3, "structured": 1, "unstructured": 2}[name]
    random = np.random.default_rng(0)
    n_controls = params.arm.spline.n_controls
    controls = random.uniform(-0.3, 0.3, (3, n_controls))
    controls[turning:] = 0
    scene = params.arm.scene(jnp.asarray(controls), state.arm)

    return in_single_precision((scene, state.arm, params.dt))


def in_single_precision(tree: Any) -> Any:
    """The same numbers in float32."""

    def single(leaf: Any) -> Any:
        floating = jnp.issubdtype(jnp.result_type(leaf), jnp.floating)
        return jnp.asarray(leaf, jnp.float32) if floating else leaf

    return jax.tree.map(single, tree)


SPEED: dict[str, Callable[[], tuple[Any, Any, Any]]] = {
    "n = 20, clamped, damped, actuated": lambda: arm(20),
    "n = 10": lambda: arm(10),
    "n = 50": lambda: arm(50),
    "n = 100": lambda: arm(100),
    "n = 20, float64": lambda: arm(20, dtype="float64"),
    "n = 20, planar": lambda: _planar(20),
    "n = 20, without twist": lambda: arm(20, method=jaxrod.torsion_free()),
    "`tracking`, clean, n = 30": lambda: of_task("tracking"),
    "`reaching`, clean, n = 20": lambda: of_task("reaching"),
    "`structured`, clean, n = 40, contact": lambda: of_task("structured"),
    "`unstructured`, clean, n = 40, contact": lambda: of_task("unstructured"),
}


def _planar(n: int) -> tuple[Any, Any, Any]:
    scene, state, _ = arm(n)
    effects = (
        *scene.effects[:3],
        jaxrod.actuation.ElementCouples(jnp.zeros((3, n), jnp.float32).at[2].set(0.3)),
    )
    flat = jaxrod.make_scene(scene.rod, *effects, method=jaxrod.planar("xy"))
    return flat, state, 0.5 * jaxrod.stable_dt(flat).dt


def joined() -> tuple[Any, Any, Any]:
    """The system of docs/systems.md without contact: two rods and a ball."""
    rods, states = {}, {}
    for name, n, length, radius, start, direction in (
        ("trunk", 20, 1.0, 0.02, (0, 0, 0), (1, 0, 0)),
        ("branch", 8, 0.4, 0.01, (0.5, 0, 0), (0, 0, 1)),
    ):
        rods[name], states[name] = jaxrod.straight_rod(
            n,
            length=length,
            radius=radius,
            density=1000.0,
            youngs_modulus=1e6,
            start=start,
            direction=direction,
            dtype="float32",
        )
    sphere = jaxrod.shapes.sphere((1.05, 0, 0), 0.05)
    ball, states["ball"] = jaxrod.systems.rigid_body(
        sphere, density=300.0, dtype="float32"
    )
    clamp, gravity = jaxrod.clamp(states["trunk"]), jaxrod.gravity()
    members = {
        "trunk": jaxrod.make_scene(rods["trunk"], clamp, gravity),
        "branch": jaxrod.make_scene(rods["branch"], gravity),
        "ball": ball,
    }
    weld = jaxrod.systems.weld(("trunk", 10), ("branch", "base"), states)
    attached = jaxrod.systems.attach(("trunk", "tip"), ("ball",), states)
    system = jaxrod.make_system(members, weld, attached, state=states)
    return system, states, 1e-5


def crossing(law: str, n: int = 51, dtype: str = "float32") -> tuple[Any, Any, Any]:
    """Two ropes of `n` elements that cross, with lists of 32 pairs."""
    rods, states = {}, {}
    for name, start, direction in (
        ("one", (-0.5, 0, 0), (1, 0, 0)),
        ("other", (0, -0.5, 0.0195), (0, 1, 0)),
    ):
        rods[name], states[name] = jaxrod.straight_rod(
            n,
            length=1.0,
            radius=0.01,
            density=1000.0,
            youngs_modulus=1e6,
            start=start,
            direction=direction,
            dtype=dtype,
        )
    lists = jaxrod.systems.neighbour_lists(pairs=32)
    touch = getattr(jaxrod.systems, law)
    contact = touch("one", "other", stiffness=1e3, damping=0.1, lists=lists)
    scenes = {k: jaxrod.make_scene(rod, jaxrod.gravity()) for k, rod in rods.items()}
    return jaxrod.make_system(scenes, contact, state=states), states, 1e-5


SINGLE: dict[str, Callable[[], tuple[Any, Any, Any]]] = {
    "a rod of 20 elements": lambda: arm(20),
    "50": lambda: arm(50),
    "200": lambda: arm(200),
    "1000": lambda: arm(1000),
    "20, float64": lambda: arm(20, dtype="float64"),
    "200, float64": lambda: arm(200, dtype="float64"),
    "two rods and a ball, welded and attached": joined,
    "two ropes, `crossing_contact`, lists": lambda: crossing("crossing_contact"),
    "two ropes, `rod_contact`, lists": lambda: crossing("rod_contact"),
    "`knot.py`: a rod of 100 elements touches itself": lambda: example("knot").build(),
    "`plectoneme.py`": lambda: example("plectoneme").build(),
    "`nest.py`, 50 rods": lambda: example("nest").nest(50),
}


def single_row(label: str, model: tuple[Any, Any, Any], window: float) -> str:
    """One row of steps of a scene or system without a batch."""
    scene, state, dt = model
    run = lambda state, n: jaxrod.advance(scene, state, dt, n)
    # Examples take long; for the others the overhead of a call is not to count.
    steps = 200 if label.startswith("`") else 5000
    programs, first = compiled(run, (state, jnp.int32(steps)), SINGLE_MODES)
    per = {k: 1e6 * t / steps for k, t in timed(programs, window).items()}
    rows, xla = per["auto"], per["never"]
    return (
        f"| {label} | {rows:.3g} | {xla:.3g} | {xla / rows:.1f} | "
        f"{first['auto']:.1f} | {first['never']:.1f} |"
    )


def many_row(label: str, model: tuple[Any, Any, Any], window: float) -> str:
    """One row of steps of 64 equal systems at once."""
    scene, state, dt = model
    rods, steps = 64, 40

    def run(states: Any, n: Any) -> Any:
        return jax.vmap(lambda state: jaxrod.advance(scene, state, dt, n))(states)

    programs, first = compiled(run, (batch_of(state, rods), jnp.int32(steps)))
    made = jaxrod.lane_choices()[-1].why.partition(" of ")[0]
    per = {k: 1e6 * t / (steps * rods) for k, t in timed(programs, window).items()}
    kernel, xla = per["auto"], per["never"]
    return (
        f"| {label} | {made} | {kernel:.3g} | {xla:.3g} | {xla / kernel:.1f} | "
        f"{first['auto']:.1f} | {first['never']:.1f} |"
    )


def single_gradient_row(label: str, model: tuple[Any, Any, Any], window: float) -> str:
    """One row of values and gradients to all numbers of a scene or system."""
    scene, state, dt = model
    steps = 200

    def final(scene: Any) -> Any:
        moved = jaxrod.advance(scene, state, dt, steps)
        floats = [x for x in jax.tree.leaves(moved) if x.dtype == jnp.float32]
        return sum(jnp.sum(x**2) for x in floats)

    forward, _ = compiled(final, (scene,), SINGLE_MODES[:1])
    both = jax.value_and_grad(final, allow_int=True)
    programs, first = compiled(both, (scene,), SINGLE_MODES)
    ahead = 1e6 * timed(forward, window)["auto"] / steps
    per = {k: 1e6 * t / steps for k, t in timed(programs, window).items()}
    rows, xla = per["auto"], per["never"]
    return (
        f"| {label} | {rows:.3g} | {xla:.3g} | {xla / rows:.1f} | {rows / ahead:.1f} | "
        f"{first['auto']:.1f} | {first['never']:.1f} |"
    )


def batch_of(state: Any, rods: int) -> Any:
    """Equal states of many rods."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (rods, *leaf.shape)), state)


def compiled(
    function: Callable[..., Any],
    arguments: Iterable[Any],
    modes: Iterable[str] = MODES,
) -> tuple[dict[str, Program], dict[str, float]]:
    """Programs of a function in some modes, and the times of their first calls [s]."""
    programs, seconds = {}, {}
    for mode in modes:
        jaxrod.use_lanes(mode)
        program = jax.jit(lambda *a: function(*a))
        given = tuple(arguments)
        begin = time.perf_counter()
        jax.block_until_ready(program(*given))
        seconds[mode] = time.perf_counter() - begin
        programs[mode] = lambda p=program, g=given: jax.block_until_ready(p(*g))
    return programs, seconds


def timed(programs: dict[str, Program], window: float) -> dict[str, float]:
    """Processor time of a call of each [s], the least of windows that alternate."""
    calls = {}
    for name, program in programs.items():
        begin = time.process_time()
        program()
        once = time.process_time() - begin
        calls[name] = max(1, round(window / max(once, 1e-6)))
    found: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(WINDOWS):
        for name, program in programs.items():
            begin = time.process_time()
            for _ in range(calls[name]):
                program()
            found[name].append((time.process_time() - begin) / calls[name])
    return {name: min(times) for name, times in found.items()}


def forward_row(
    label: str, model: tuple[Any, Any, Any], rods: int, window: float
) -> str:
    """One row of steps per second."""
    scene, state, dt = model
    steps = max(20, min(1000, 400_000 // (rods * scene.rod.n_elements)))

    def run(states: Any, n: Any) -> Any:
        one = lambda state: jaxrod.advance(scene, state, dt, n)
        return jax.vmap(one)(states)

    programs, first = compiled(run, (batch_of(state, rods), jnp.int32(steps)))
    per = {k: t / (steps * rods) for k, t in timed(programs, window).items()}
    lanes, xla = 1e-6 / per["auto"], 1e-6 / per["never"]
    return (
        f"| {label} | {lanes:.3g} | {xla:.3g} | {lanes / xla:.1f} | "
        f"{first['auto']:.1f} | {first['never']:.1f} |"
    )


def gradient_row(label: str, model: tuple[Any, Any, Any], window: float) -> str:
    """One row of values and gradients."""
    scene, state, dt = model
    rods, steps, n = 64, 1000, scene.rod.n_elements

    def final(couples: Any) -> Any:
        effects = (*scene.effects[:-1], replace(scene.effects[-1], couples=couples))
        moved = jaxrod.advance(replace(scene, effects=effects), state, dt, steps)
        return jnp.sum(moved.positions[:, -1] ** 2)

    couples = 0.1 * jnp.ones((rods, 3, n), state.positions.dtype)
    forward, _ = compiled(jax.vmap(final), (couples,))
    both, first = compiled(jax.vmap(jax.value_and_grad(final)), (couples,))
    ahead = timed(forward, window)["auto"] / (rods * steps)
    per = {k: t / (steps * rods) for k, t in timed(both, window).items()}
    lanes, xla = 1e6 * per["auto"], 1e6 * per["never"]
    return (
        f"| {label} | {lanes:.3g} | {xla:.3g} | {xla / lanes:.1f} | "
        f"{per['auto'] / ahead:.1f} | {first['auto']:.1f} | {first['never']:.1f} |"
    )


def rows(table: str, window: float) -> Iterable[str]:
    """The rows of a table, as they are measured."""
    if table == "speed":
        for label, model in SPEED.items():
            yield forward_row(label, model(), 256, window)
    elif table == "gradient":
        yield gradient_row("n = 20", arm(20), window)
        yield gradient_row("n = 20, float64", arm(20, dtype="float64"), window)
    elif table == "length":
        for n in (5, 10, 20, 50, 100, 200, 500, 1000):
            yield forward_row(f"{n}", arm(n), 256, window)
    elif table == "many":
        twisted = example("plectoneme").build()
        yield many_row("`plectoneme.py`", in_single_precision(twisted), window)
        yield many_row("`plectoneme.py`, float64", twisted, window)
        ropes = crossing("crossing_contact")
        yield many_row("two ropes, `crossing_contact`, lists", ropes, window)
        ropes = crossing("rod_contact")
        yield many_row("two ropes, `rod_contact`, lists", ropes, window)
    elif table == "single":
        for label, model in SINGLE.items():
            yield single_row(label, model(), window)
    elif table == "single_gradient":
        yield single_gradient_row("a rod of 20 elements", arm(20), window)
        label = "two rods and a ball, welded and attached"
        yield single_gradient_row(label, joined(), window)
    else:
        for rods in (1, 2, 4, 8, 16, 64, 256, 1024, 8192, 65536):
            yield forward_row(f"{rods}", arm(20), rods, window)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the tables."""
    add_names(parser, "tables", HEADS, "TABLE")
    parser.add_argument("--seconds", type=float, default=1.0, help="of a window")
    parser.add_argument("--dry", action="store_true", help="write nothing")


def run(args: argparse.Namespace) -> int:
    """Measures, prints and writes."""
    jax.config.update("jax_enable_x64", True)
    jaxrod.configure_cpu(1)
    for table in args.tables:
        measured_table(
            PAGE,
            table,
            HEADS[table],
            partial(rows, table, args.seconds),
            dry=args.dry,
        )
    return 0

r"""A report on derivatives through time: errors, cost, memory, and what remains.

A scene is run for a time that is cut into equal intervals. Controls are two couples per
interval, the same on all elements, and a stiffness by its logarithm; the loss is the
squared distance of the tip from a point. Measured are

- errors of derivatives in reverse and forward mode along a direction $d$ against
  central differences $(L(z + h d) - L(z - h d)) / 2h$ over step sizes $h$, in float64,
  and against float64 in float32;
- processor time of a gradient by that of the forward pass, of one rod and of a batch;
- memory that a compiled gradient works in, by the number of steps;
- singular values of the tip's derivative by the controls so far, $\partial x_k /
  \partial u_{1..k}$, by the horizon $k$.

Source: the measures are those of Mosaic (Pasteur Labs, arXiv 2606.27895), which looks
at solvers of fields.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxrod.analysis.stability import stable_dt
from jaxrod.contacts.contact import Contact
from jaxrod.effects.actuation import ElementCouples
from jaxrod.rods.rod import RodState
from jaxrod.scene import Scene
from jaxrod.stepping.runs import advance
from jaxrod.validation import check_array, check_count

STEP_SIZES = tuple(10.0 ** -np.arange(1, 10))
"""Of central differences."""
ROOM_STEPS = (1_000, 10_000)
"""Runs whose memory is looked at."""
WINDOWS = 5


@dataclasses.dataclass(frozen=True)
class GradientReport:
    """What was measured of the derivatives of one scene; plain numbers."""

    name: str
    n_elements: int
    steps: int
    """Of the run."""
    duration: float
    """Of the run [s]."""
    batch: int
    """Rods of a batch."""
    step_sizes: tuple[float, ...]
    """Of central differences, in units of the controls and the logarithm."""
    reverse_errors: tuple[float, ...]
    """Of reverse mode against central differences in float64, by step size [1]."""
    forward_errors: tuple[float, ...]
    """Of forward mode likewise [1]."""
    single_errors: tuple[float, ...]
    """Of float32's central differences against float64's derivative [1]."""
    single_reverse: float
    """Of the gradient in float32 against that in float64, by norms [1]."""
    single_forward: float
    """Of the directional derivative in float32 likewise [1]."""
    gradient_ratio: float
    """Time of value and gradient by that of the value, one rod, float32."""
    tangent_ratio: float
    """Time of value and one directional derivative by that of the value."""
    batch_ratio: float
    """Time of value and gradient by that of the value, a batch."""
    milliseconds: tuple[float, float, float, float]
    """Processor time of value and gradient, one rod and the batch [ms]."""
    room: dict[int, int]
    """Steps of a run to bytes that the gradient of one rod works in, float32."""
    horizons: tuple[float, ...]
    """Ends of the intervals [s]."""
    singular_values: tuple[tuple[float, ...], ...]
    """Of the tip's derivative by the controls so far, at each horizon [m]."""

    @property
    def error(self) -> float:
        """The least error of reverse mode over step sizes."""
        return min(self.reverse_errors)

    @property
    def best_step(self) -> float:
        """The step size at which it is."""
        return self.step_sizes[int(np.argmin(self.reverse_errors))]


def gradient_report(
    scene: Scene,
    state: RodState,
    *,
    duration: float,
    name: str = "scene",
    intervals: int = 10,
    couple: float | None = None,
    batch: int = 64,
    window: float = 0.2,
    memory: bool = True,
) -> GradientReport:
    """Measures the derivatives of a scene. Compiles some ten programs: a minute or so.

    Args:
        scene: The scene.
        state: Where it begins.
        duration: Simulated time [s].
        name: Of the scene, for tables.
        intervals: Into which time is cut.
        couple: On each element for a control of one [N m]; by default that which bends
            the rod by a radian over its length.
        batch: Rods of a batch.
        window: Processor time of a measurement [s].
        memory: Whether to look at memory, which takes programs of its own.

    Raises:
        ValueError: A number is out of range.
    """
    check_array("duration", duration, [()], "s", positive=True)
    intervals = check_count("intervals", intervals, 2)
    batch = check_count("batch", batch, 1)
    with jax.enable_x64(True):
        both: tuple[Scene, RodState] = (scene, state)
        double = jax.tree.map(lambda a: _typed(a, np.float64), both)
        single = jax.tree.map(lambda a: _typed(a, np.float32), both)
        dt = float(stable_dt(double[0]).dt)
        per = int(np.ceil(duration / intervals / dt))
        dt = duration / intervals / per
        if couple is None:
            couple = _bending(double[0])
        runs = {
            "float64": _Run(double[0], double[1], dt, per, intervals, couple),
            "float32": _Run(single[0], single[1], dt, per, intervals, couple),
        }
        programs = _programs(runs["float32"], batch)
        columns = _hurried(jax.jacfwd(runs["float64"].tips))(runs["float64"].start())
        sizes = [
            _three(np.reshape(columns["controls"][k, :, : k + 1], (3, -1)))
            for k in range(1, intervals)
        ]
        return GradientReport(
            name=name,
            n_elements=scene.rod.n_elements,
            steps=per * intervals,
            duration=duration,
            batch=batch,
            step_sizes=STEP_SIZES,
            **_errors(runs, columns, programs, batch),
            **_times(programs, window),
            room=_room(runs["float32"]) if memory else {},
            horizons=tuple(duration * (k + 1) / intervals for k in range(1, intervals)),
            singular_values=tuple(sizes),
        )


@dataclasses.dataclass(frozen=True)
class _Run:
    """A run in one precision, as a function of what acts on it."""

    scene: Scene
    state: RodState
    dt: float
    per: int
    intervals: int
    couple: float

    @property
    def dtype(self) -> Any:
        return self.state.positions.dtype

    def start(self) -> dict[str, jax.Array]:
        """Where derivatives are looked at: nowhere in particular."""
        controls = 0.3 * np.cos(np.arange(2 * self.intervals)).reshape(-1, 2)
        return {
            "controls": jnp.asarray(controls, self.dtype),
            "stiffness": jnp.zeros((), self.dtype),
        }

    def acted(self, stiffness: jax.Array, control: jax.Array) -> Scene:
        """The scene under a control."""
        rod, factor = self.scene.rod, jnp.exp(stiffness)
        rod = dataclasses.replace(
            rod,
            shear_stretch_stiffness=factor * rod.shear_stretch_stiffness,
            bend_twist_stiffness=factor * rod.bend_twist_stiffness,
        )
        shape = (1, rod.n_elements)
        rows = [jnp.broadcast_to(self.couple * c, shape) for c in control]
        couples = jnp.concatenate([*rows, jnp.zeros(shape, self.dtype)])
        effects = (*self.scene.effects, ElementCouples(couples))
        return dataclasses.replace(self.scene, rod=rod, effects=effects)

    def tips(self, numbers: dict[str, jax.Array]) -> jax.Array:
        """Tips at the ends of the intervals `(intervals, 3)`."""

        def one(state: RodState, control: jax.Array) -> tuple[RodState, jax.Array]:
            scene = self.acted(numbers["stiffness"], control)
            dt = jnp.asarray(self.dt, self.dtype)
            after = advance(scene, state, dt, self.per)
            return after, after.tip

        return lax.scan(one, self.state, numbers["controls"])[1]

    def loss(self, numbers: dict[str, jax.Array]) -> jax.Array:
        """Squared distance of the last tip from a point that it does not reach."""
        return jnp.sum(self.gap(self.tips(numbers)) ** 2)

    def gap(self, tips: jax.Array) -> jax.Array:
        """From there to the last tip."""
        length = np.sum(np.asarray(self.scene.rod.rest_lengths))
        return tips[-1] - jnp.asarray(np.array([0.3, -0.4, 0.2]) * length, self.dtype)


def without_contact(scene: Scene) -> Scene | None:
    """The scene with nothing to touch; `None` if there is nothing anyway."""
    left = tuple(e for e in scene.effects if not isinstance(e, Contact))
    if len(left) == len(scene.effects):
        return None
    return dataclasses.replace(scene, effects=left)


Program = tuple[Callable[..., Any], tuple[Any, ...]]
"""A compiled function and what it is given."""


def _hurried(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compiled quickly, because it is run once: LLVM need not optimise it."""
    options: Any = {"xla_backend_optimization_level": 0}
    return jax.jit(function, compiler_options=options)


def _direction(run: _Run) -> dict[str, jax.Array]:
    """A direction of length one among what the loss depends on."""
    random = np.random.default_rng(0)
    way = {
        "controls": random.normal(size=(run.intervals, 2)),
        "stiffness": random.normal(size=()),
    }
    size = np.sqrt(sum(np.sum(np.square(leaf)) for leaf in way.values()))
    return {k: jnp.asarray(v / size, run.dtype) for k, v in way.items()}


def _programs(run: _Run, batch: int) -> dict[str, Program]:
    """The forward pass and its derivatives, of one rod and of a batch."""
    start, way = run.start(), _direction(run)
    many = jax.tree.map(lambda a: jnp.broadcast_to(a[None], (batch, *a.shape)), start)
    both = jax.value_and_grad(run.loss)
    return {
        "value": (jax.jit(run.loss), (start,)),
        "tangent": (jax.jit(lambda z, d: jax.jvp(run.loss, (z,), (d,))), (start, way)),
        "gradient": (jax.jit(both), (start,)),
        "values": (jax.jit(jax.vmap(run.loss)), (many,)),
        "gradients": (jax.jit(jax.vmap(both)), (many,)),
    }


def _errors(
    runs: dict[str, _Run], columns: Any, programs: dict[str, Program], batch: int
) -> dict[str, Any]:
    """Errors of derivatives along a direction, and of whole gradients."""
    double, single = runs["float64"], runs["float32"]
    gradient = {
        "float64": _hurried(jax.grad(double.loss))(double.start()),
        "float32": programs["gradient"][0](*programs["gradient"][1])[1],
    }
    whole = {kind: _row(tree) for kind, tree in gradient.items()}
    way = _direction(double)
    reverse = float(np.vdot(whole["float64"], _row(way)))
    moved = sum(
        np.tensordot(np.asarray(columns[k])[-1], np.asarray(way[k]), np.ndim(way[k]))
        for k in way
    )
    forward = float(np.vdot(2 * double.gap(double.tips(double.start())), moved))
    forward_single = float(programs["tangent"][0](*programs["tangent"][1])[1])
    exact = _differences(double, _hurried(jax.vmap(double.loss)), 2 * len(STEP_SIZES))
    rough = _differences(single, programs["values"][0], batch)
    size = np.linalg.norm(whole["float64"])
    return {
        "reverse_errors": tuple(np.abs(reverse - exact) / np.abs(exact)),
        "forward_errors": tuple(np.abs(forward - exact) / np.abs(exact)),
        "single_errors": tuple(np.abs(rough - reverse) / np.abs(reverse)),
        "single_reverse": float(
            np.linalg.norm(whole["float32"] - whole["float64"]) / size
        ),
        "single_forward": abs(forward_single - forward) / abs(forward),
    }


def _row(tree: dict[str, Any]) -> np.ndarray:
    return np.concatenate([np.ravel(np.asarray(tree[k], float)) for k in sorted(tree)])


def _differences(run: _Run, losses: Callable[..., Any], rods: int) -> np.ndarray:
    """Central differences along the direction by step size, `rods` runs at a time."""
    start, way = run.start(), _direction(run)
    sizes = np.array([sign * h for h in STEP_SIZES for sign in (1, -1)])
    # The program is of a batch of its own size.
    padded = np.resize(sizes, -(-len(sizes) // rods) * rods).reshape(-1, rods)
    values = [
        losses(
            {
                k: start[k][None]
                + jnp.asarray(part.reshape(-1, *[1] * way[k].ndim), run.dtype)
                * way[k][None]
                for k in way
            }
        )
        for part in padded
    ]
    found = np.concatenate([np.asarray(v, float) for v in values])[: len(sizes)]
    pairs = found.reshape(-1, 2)
    return (pairs[:, 0] - pairs[:, 1]) / (2 * sizes[::2])


def _times(programs: dict[str, Program], window: float) -> dict[str, Any]:
    """Processor time of gradients by that of forward passes."""
    taken = _timed(programs, window)
    return {
        "gradient_ratio": taken["gradient"] / taken["value"],
        "tangent_ratio": taken["tangent"] / taken["value"],
        "batch_ratio": taken["gradients"] / taken["values"],
        "milliseconds": tuple(
            1e3 * taken[k] for k in ("value", "gradient", "values", "gradients")
        ),
    }


def _timed(programs: dict[str, Program], window: float) -> dict[str, float]:
    """Processor time of a call of each [s]: the least of windows that alternate."""
    calls = {}
    for name, (program, given) in programs.items():
        jax.block_until_ready(program(*given))
        begin = time.process_time()
        jax.block_until_ready(program(*given))
        once = time.process_time() - begin
        calls[name] = max(1, round(window / WINDOWS / max(once, 1e-6)))
    least = dict.fromkeys(programs, np.inf)
    for _ in range(WINDOWS):
        for name, (program, given) in programs.items():
            begin = time.process_time()
            for _ in range(calls[name]):
                jax.block_until_ready(program(*given))
            spent = (time.process_time() - begin) / calls[name]
            least[name] = min(least[name], spent)
    return least


def _room(run: _Run) -> dict[int, int]:
    """Bytes that compiled gradients of runs work in, beside arguments and results."""

    def end(control: jax.Array, stiffness: jax.Array, steps: int) -> jax.Array:
        scene = run.acted(stiffness, control)
        dt = jnp.asarray(run.dt, run.dtype)
        return jnp.sum(advance(scene, run.state, dt, steps).tip ** 2)

    found = {}
    start = run.start()
    for steps in ROOM_STEPS:
        program: Any = _hurried(
            jax.grad(lambda u, s, n=steps: end(u, s, n), argnums=(0, 1))
        )
        compiled = program.lower(start["controls"][0], start["stiffness"]).compile()
        analysis = compiled.memory_analysis()
        if analysis is not None:
            found[steps] = int(analysis.temp_size_in_bytes)
    return found


def _bending(scene: Scene) -> float:
    """The couple on each element under which a rod, held at an end, turns by one."""
    rod = scene.rod
    stiffness = float(np.mean(np.asarray(rod.bend_twist_stiffness)[0]))
    length = float(np.sum(np.asarray(rod.rest_lengths)))
    return 2 * stiffness / length / rod.n_elements


def _three(matrix: np.ndarray) -> tuple[float, float, float]:
    """Singular values of a matrix of three rows."""
    first, second, third = np.linalg.svd(matrix, compute_uv=False)
    return float(first), float(second), float(third)


def _typed(leaf: Any, dtype: Any) -> Any:
    array = jnp.asarray(leaf)
    if jnp.issubdtype(array.dtype, jnp.floating):
        return jnp.asarray(np.asarray(array), dtype)
    return array

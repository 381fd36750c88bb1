r"""A report on derivatives through time: errors, cost, memory, and singular values.

A scene is run for a time that is divided into equal intervals. The controls are two
couples per interval, the same on all elements, and the logarithm of a stiffness factor.
The loss is the squared distance of the tip from a point. The report has

- errors of derivatives in reverse and forward mode along a direction $d$, compared with
  central differences $(L(z + h d) - L(z - h d)) / 2h$ over step sizes $h$, in float64,
  and errors in float32 compared with float64;
- processor time of a gradient over that of the forward pass, for one rod and a batch;
- temporary memory of a compiled gradient, by the number of steps;
- singular values of the tip's derivative by the controls so far, $\partial x_k /
  \partial u_{1..k}$, by the horizon $k$.

Source: the measures are those of Mosaic (Pasteur Labs, arXiv 2606.27895), which applies
them to solvers of fields.
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
"""Step sizes of central differences."""
ROOM_STEPS = (1_000, 10_000)
"""Numbers of steps of the runs whose memory is measured."""
WINDOWS = 5


@dataclasses.dataclass(frozen=True)
class GradientReport:
    """Measured properties of the derivatives of one scene; plain numbers."""

    name: str
    n_elements: int
    steps: int
    """Number of steps of the run."""
    duration: float
    """Duration of the run [s]."""
    batch: int
    """Number of rods in a batch."""
    step_sizes: tuple[float, ...]
    """Step sizes of central differences, in units of the controls and the logarithm."""
    reverse_errors: tuple[float, ...]
    """Errors of reverse mode against central differences, float64, by step size [1]."""
    forward_errors: tuple[float, ...]
    """Errors of forward mode against central differences, float64, by step size [1]."""
    single_errors: tuple[float, ...]
    """Errors of central differences in float32 against float64's derivative [1]."""
    single_reverse: float
    """Error of the gradient in float32 against that in float64, by norms [1]."""
    single_forward: float
    """Error of the directional derivative in float32 against that in float64 [1]."""
    gradient_ratio: float
    """Time of value and gradient over that of the value, one rod, float32."""
    tangent_ratio: float
    """Time of value and one directional derivative over that of the value."""
    batch_ratio: float
    """Time of value and gradient over that of the value, for a batch."""
    milliseconds: tuple[float, float, float, float]
    """Processor time of value and of gradient, for one rod and for the batch [ms]."""
    room: dict[int, int]
    """Temporary bytes of the gradient of one rod, by number of steps, float32."""
    horizons: tuple[float, ...]
    """Times at the ends of the intervals [s]."""
    singular_values: tuple[tuple[float, ...], ...]
    """Singular values of the tip's derivative by past controls, at each horizon [m]."""

    @property
    def error(self) -> float:
        """Smallest error of reverse mode over all step sizes."""
        return min(self.reverse_errors)

    @property
    def best_step(self) -> float:
        """Step size with the smallest error."""
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
    """Measures the derivatives of a scene; it compiles some ten programs in a minute.

    Args:
        scene: The scene.
        state: Initial state.
        duration: Simulated time [s].
        name: Name of the scene, for tables.
        intervals: Number of intervals into which time is divided.
        couple: Couple on each element for a control of one [N m]; by default the one
            that bends the rod by a radian over its length.
        batch: Number of rods in a batch.
        window: Processor time of a measurement [s].
        memory: Whether to measure memory, which needs additional programs.

    Raises:
        ValueError: If a number is out of range.
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
    """A run in one precision, as a function of its controls."""

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
        """Arbitrary point at which derivatives are taken."""
        controls = 0.3 * np.cos(np.arange(2 * self.intervals)).reshape(-1, 2)
        return {
            "controls": jnp.asarray(controls, self.dtype),
            "stiffness": jnp.zeros((), self.dtype),
        }

    def acted(self, stiffness: jax.Array, control: jax.Array) -> Scene:
        """Scene with a control applied."""
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
        """Tip positions at the ends of the intervals `(intervals, 3)`."""

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
        """Vector from that point to the last tip."""
        length = np.sum(np.asarray(self.scene.rod.rest_lengths))
        return tips[-1] - jnp.asarray(np.array([0.3, -0.4, 0.2]) * length, self.dtype)


def without_contact(scene: Scene) -> Scene | None:
    """Scene without its contact; `None` if it has no contact."""
    left = tuple(e for e in scene.effects if not isinstance(e, Contact))
    if len(left) == len(scene.effects):
        return None
    return dataclasses.replace(scene, effects=left)


Program = tuple[Callable[..., Any], tuple[Any, ...]]
"""Compiled function and its arguments."""


def _hurried(function: Callable[..., Any]) -> Callable[..., Any]:
    """Function compiled quickly: it runs once, so LLVM does not optimise it."""
    options: Any = {"xla_backend_optimization_level": 0}
    return jax.jit(function, compiler_options=options)


def _direction(run: _Run) -> dict[str, jax.Array]:
    """Direction of unit length in the space of the loss's arguments."""
    random = np.random.default_rng(0)
    way = {
        "controls": random.normal(size=(run.intervals, 2)),
        "stiffness": random.normal(size=()),
    }
    size = np.sqrt(sum(np.sum(np.square(leaf)) for leaf in way.values()))
    return {k: jnp.asarray(v / size, run.dtype) for k, v in way.items()}


def _programs(run: _Run, batch: int) -> dict[str, Program]:
    """Forward pass and its derivatives, for one rod and for a batch."""
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
    # The program is compiled for a batch of fixed size.
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
    """Ratios of the processor times of gradients and forward passes."""
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
    """Processor time per call of each [s]: the minimum over interleaved windows."""
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
    """Temporary bytes of compiled gradients, without arguments and results."""

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
    """Couple on each element that turns the tip of a clamped rod by one radian."""
    rod = scene.rod
    stiffness = float(np.mean(np.asarray(rod.bend_twist_stiffness)[0]))
    length = float(np.sum(np.asarray(rod.rest_lengths)))
    return 2 * stiffness / length / rod.n_elements


def _three(matrix: np.ndarray) -> tuple[float, float, float]:
    """Singular values of a matrix with three rows."""
    first, second, third = np.linalg.svd(matrix, compute_uv=False)
    return float(first), float(second), float(third)


def _typed(leaf: Any, dtype: Any) -> Any:
    array = jnp.asarray(leaf)
    if jnp.issubdtype(array.dtype, jnp.floating):
        return jnp.asarray(np.asarray(array), dtype)
    return array

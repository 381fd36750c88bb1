r"""A twin: the arm whose numbers agree best with recordings, and how sure they are.

Recordings at rest are compared with equilibria, motions with runs that begin in the
equilibrium under the first inputs. With markers $m_k$ and the drawing's standard
deviations $\sigma_j$ of unknowns $x_j$, it minimises

$$\sum_k \rho\Big(\frac{|m_k(x) - \hat m_k|}{\sigma}\Big)
+ \sum_j \Big(\frac{x_j - x_{0j}}{\sigma_j}\Big)^2,$$

with $\rho(r) = r^2$, or $2 c^2 (\sqrt{1 + r^2/c^2} - 1)$ for a robust fit, in which
distances beyond $c$ standard deviations count linearly. The noise $\sigma$ of a
coordinate is what is left over: fits are repeated until it agrees with the residuals.
Labels and the frame of the camera follow from the drawing, then from the arm that was
found, until they stay.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxrod.analysis.stability import stable_dt
from jaxrod.control.identification.fit import FitProblem, fit_of
from jaxrod.control.identification.parameters import Parameters, make_parameters
from jaxrod.control.identification.result import Fit
from jaxrod.control.least_squares import (
    FASTER,
    MOST_DAMPING,
    SLOWER,
    default_tolerance,
)
from jaxrod.effects.time import table
from jaxrod.statics.equilibrium import equilibrium
from jaxrod.stepping.runs import rollout
from jaxrod.structure import pytree
from jaxrod.twin.arm import LOGARITHMIC, Arm
from jaxrod.twin.recordings import Recording
from jaxrod.twin.registration import Registration, register
from jaxrod.validation import check_array

RECORDS = 2e-3
"""Longest time between records of a run, interpolated at the frames [s]."""
LOWEST = {"friction": 0.0, "marker_masses": 0.0, "poisson_ratio": -0.9}
HIGHEST = {"friction": 2.0, "poisson_ratio": 0.5}
"""Bounds of unknowns, in their units."""
FITS = 6
"""Largest number of fits until the noise agrees with the residuals."""
REGISTRATIONS = 4
"""Largest number of times that labels are found, each followed by a fit."""
SMALL_PART = 0.2
"""Parts of a combination below this fraction of its largest are not named."""
SURE = 0.02
"""Relative change of the noise below which it agrees."""


@dataclass(frozen=True)
class Comparison:
    """Markers of a recording beside those of a twin."""

    recording: Recording
    predicted: Float[np.ndarray, "frames markers 3"]
    """Places of the markers [m]."""
    sd: Float[np.ndarray, "frames markers 3"]
    """Their standard deviations, due to those of the unknowns [m]."""

    @property
    def errors(self) -> Float[np.ndarray, " markers"]:
        """Root mean square distance of each marker [m]."""
        away = np.sum((self.predicted - self.recording.points) ** 2, axis=-1)
        return np.sqrt(np.nanmean(away, axis=0))


@dataclass(frozen=True)
class Twin:
    """An arm with the numbers that agree with its recordings; see `identify`."""

    arm: Arm
    fit: Fit
    """Unknowns with their standard deviations; print it."""
    noise: float
    """Standard deviation of a coordinate of a marker [m]."""
    registration: Registration
    recordings: tuple[Recording, ...]
    """The recordings of the fit, with labels and in the arm's frame."""

    @property
    def drawn_sds(self) -> dict[str, float]:
        """Standard deviations of the drawing, by the names of the fit's numbers."""
        return dict(
            zip(self.fit.names, _drawn(self.arm, self.fit.parameters), strict=True)
        )

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Combinations of which the recordings say less than the drawing, in words."""
        drawn = _drawn(self.arm, self.fit.parameters)
        ways = np.asarray(self.fit.directions) * drawn
        total = (ways.T * np.asarray(self.fit.singular_values) ** 2) @ ways
        said, ways = np.linalg.eigh(total - np.eye(len(drawn)))
        return tuple(
            _combination(self.fit.names, way)
            for known, way in zip(said, ways.T, strict=True)
            if known < 1
        )

    @property
    def values(self) -> dict[str, Array]:
        """All numbers of the arm, with those that were found."""
        return self.arm.start | self.fit.values

    def registered(self, recording: Recording) -> Recording:
        """A recording that was not fitted, with labels and in the arm's frame.

        Its labels are those with which it is nearest to the prediction of the twin.
        """
        return _registered(self.arm, self.values, [recording], self.registration)[0][0]

    def compare(self, recordings: Sequence[Recording]) -> list[Comparison]:
        """Predicts recordings; those that are not of the fit are registered first."""
        known = {id(one) for one in self.recordings}
        ready = [r if id(r) in known else self.registered(r) for r in recordings]
        # Along directions that the drawing alone knows, it says how far.
        ways = np.asarray(self.fit.directions)
        ways = ways / np.asarray(self.fit.singular_values)[:, None]
        point = self.fit.parameters.searched(self.fit.values)
        found = []
        for recording in ready:
            made, slopes = _evaluated(self.arm, point, _prepared(self.arm, recording))
            sd = np.sqrt(np.sum(np.tensordot(ways, slopes, 1) ** 2, axis=0))
            found.append(Comparison(recording, made, sd))
        return found

    def __str__(self) -> str:
        """A table of the unknowns, and what the recordings leave open."""
        fit, drawn = self.fit, self.drawn_sds
        values = np.asarray(fit.parameters.flat(fit.values))
        sds = np.asarray(fit.parameters.flat(fit.standard_deviations))
        own = np.sqrt(np.diagonal(np.asarray(fit.covariance)))
        width = max(map(len, fit.names))
        lines = [
            f"{'unknown':<{width}}  {'value':>12} {'sd':>10}  sd left of the drawing's"
        ]
        for name, value, sd, left in zip(fit.names, values, sds, own, strict=True):
            share = left / drawn[name]
            lines.append(f"{name:<{width}}  {value:>12.5g} {sd:>10.2g}  {share:.0%}")
        lines.append(f"noise of a coordinate: {1000 * self.noise:.2f} mm")
        if not bool(fit.converged):
            lines.append("NOT CONVERGED")
        lines += [
            f"{name} is at its bound"
            for name, held in zip(fit.names, np.asarray(fit.at_bound), strict=True)
            if held
        ]
        lines += [
            f"known from the drawing alone: {words}" for words in self.undetermined
        ]
        return "\n".join(lines)


def identify(
    arm: Arm,
    recordings: Sequence[Recording],
    *,
    noise: float | None = None,
    robust: float | None = None,
    iterations: int = 50,
) -> Twin:
    """Finds the unknowns of an arm from recordings, with their standard deviations.

    Compute in float64 (`jax.enable_x64`): equilibria of soft arms need it.

    Args:
        arm: The drawing, with a standard deviation of each unknown.
        recordings: Recordings as read; one that `is_at_rest` becomes one frame.
        noise: Standard deviation of a coordinate of a marker [m]. If `None`, it follows
            from the residuals, faults of the model included.
        robust: Distance in standard deviations beyond which a marker counts less, such
            as 3; by default all count alike.
        iterations: Largest number of iterations of each fit.

    Raises:
        ValueError: If an argument is out of range, a recording cannot be registered, or
            the arm has no unknowns.

    Example:
        See docs/twin.md.
    """
    if not recordings:
        raise ValueError("a twin needs at least one recording")
    if not arm.unknown:
        raise ValueError("the arm has no unknowns: there is nothing to find")
    if noise is not None:
        check_array("noise", noise, [()], "m", positive=True)
    if robust is not None:
        check_array("robust", robust, [()], "", positive=True)
    if not jax.config.jax_enable_x64:
        raise ValueError("identify needs float64: with jax.enable_x64(): ...")
    values = arm.start
    for _ in range(REGISTRATIONS):
        ready, registration = _registered(arm, values, recordings, None)
        found, sigma = _fitted(arm, ready, noise, robust, iterations)
        # The arm that was found predicts labels better than the drawing does.
        seen_as = {"shift": arm.start["shift"], "turn": arm.start["turn"]}
        values = arm.start | found.values | seen_as
        again = _registered(arm, values, recordings, None)[1]
        if np.array_equal(again.orders, registration.orders):
            break
    return Twin(arm, found, sigma, replace(registration, margin=again.margin), ready)


def _fitted(
    arm: Arm,
    recordings: Sequence[Recording],
    noise: float | None,
    robust: float | None,
    iterations: int,
) -> tuple[Fit, float]:
    """The fit to registered recordings, and the noise of a coordinate [m]."""
    data = [_prepared(arm, recording) for recording in recordings]
    problem = _problem(arm, data)
    drawn = _drawn(arm, problem.parameters)

    def residuals(point: np.ndarray, sigma: float) -> tuple[np.ndarray, np.ndarray]:
        rows, slopes = [point / drawn], [np.diag(1 / drawn)]
        for layout, group in data:
            made, moved = _evaluated(arm, point, (layout, group))
            there = np.isfinite(group.seen)
            away = np.where(there, made - np.where(there, group.seen, 0), 0)
            away, moved = _robust(away / sigma, moved * there / sigma, robust)
            rows.append(away[there])
            slopes.append(moved[:, there].T)
        return np.concatenate(rows), np.concatenate(slopes)

    def fitted(sigma: float, start: np.ndarray) -> Fit:
        found = _searched(
            lambda point: residuals(point, sigma), start, problem, iterations
        )
        return fit_of(problem, found)

    sigma = 0.01 * arm.length if noise is None else float(noise)
    found = fitted(sigma, np.zeros(len(problem.low)))
    for _ in range(FITS if noise is None else 0):
        before, sigma = sigma, _noise(arm, found, sigma, problem)
        found = fitted(sigma, np.asarray(found.parameters.searched(found.values)))
        if abs(sigma / before - 1) < SURE:
            break
    return found, sigma


class _Found(NamedTuple):
    """The best point of a search, as `fit_of` takes it."""

    solution: Array
    residuals: Array
    jacobian: Array
    iterations: Array


def _searched(
    evaluate: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    start: np.ndarray,
    problem: FitProblem,
    iterations: int,
) -> _Found:
    """Minimises a sum of squares by damped steps, one recording at a time.

    It is the search of `control.least_squares`, on the host: recordings of different
    shapes are programs of their own, and more of the same shape need no other.
    """
    low, high = np.asarray(problem.low), np.asarray(problem.high)
    point, damping, tried = start, 1e-3, 0
    rows, slopes = evaluate(point)
    if not np.all(np.isfinite(rows)):
        raise ValueError(
            "at the start of the search the arm has no equilibrium, or its run is not "
            "finite"
        )
    while tried < iterations and damping < MOST_DAMPING:
        pull = slopes.T @ rows
        free = ~(((point <= low) & (pull > 0)) | ((point >= high) & (pull < 0)))
        curved = slopes.T @ slopes
        curved[np.diag_indices_from(curved)] *= 1 + damping
        step = np.zeros_like(point)
        step[free] = -np.linalg.solve(curved[np.ix_(free, free)], pull[free])
        trial = np.clip(point + step, low, high)
        there, ways = evaluate(trial)
        tried += 1
        cost, cost_there = np.sum(rows**2), np.sum(there**2)
        if np.isfinite(cost_there) and cost_there < cost:
            point, rows, slopes = trial, there, ways
            damping /= FASTER
        else:
            damping *= SLOWER
        if abs(cost - cost_there) <= default_tolerance(float) * cost:
            break
    return _Found(*map(jnp.asarray, (point, rows, slopes, tried)))


def _problem(arm: Arm, data: Sequence[tuple[_Layout, _Group]]) -> FitProblem:
    """Names, scales and bounds of the unknowns, and what was seen."""
    first = {name: arm.start[name] for name in arm.unknown}
    logs = [name for name in first if name in LOGARITHMIC]
    scales = {name: sd for name, sd in arm.unknown.items() if name not in logs}
    parameters = make_parameters(first, logs, scales)
    seen = jnp.ones(sum(int(np.sum(np.isfinite(d.seen))) for _, d in data), bool)
    rows = {"drawing": jnp.ones(len(parameters.names), bool), "markers": seen}
    ones = jax.tree.map(lambda row: jnp.ones(row.shape), rows)
    limits = [
        {name: limit for name, limit in some.items() if name in first}
        for some in (LOWEST, HIGHEST)
    ]
    return FitProblem(
        parameters=parameters,
        target=ones,
        seen=rows,
        noise=ones,
        low=parameters.bound(limits[0], -1),
        high=parameters.bound(limits[1], 1),
        observations=jnp.asarray(seen.size + len(parameters.names)),
        noise_is_given=True,
    )


def _evaluated(
    arm: Arm, point: Any, prepared: tuple[_Layout, _Group]
) -> tuple[np.ndarray, np.ndarray]:
    """Markers of a recording, and their derivatives by each search variable [m]."""
    made, slopes = _markers(arm, prepared[0], jnp.asarray(point), prepared[1])
    return np.asarray(made), np.asarray(slopes)


@partial(jax.jit, static_argnums=(0, 1))
def _markers(
    arm: Arm, layout: _Layout, point: Array, data: _Group
) -> tuple[Array, Array]:
    parameters = _problem(arm, ()).parameters

    def made(point: Array) -> Array:
        return _made(arm, layout, arm.start | parameters.values(point), data)

    def along(way: Array) -> tuple[Array, Array]:
        return jax.jvp(made, (point,), (way,))

    return jax.vmap(along, out_axes=(None, 0))(jnp.eye(point.size))


def _noise(arm: Arm, found: Fit, sigma: float, problem: FitProblem) -> float:
    """Standard deviation of a coordinate that agrees with the residuals [m]."""
    count = problem.seen["markers"].size
    squares = count * float(found.residual_sd["markers"]) ** 2
    # An unknown that the drawing knows better than the recordings takes none away.
    drawn = _drawn(arm, found.parameters)
    kept = float(np.sum(np.diagonal(np.asarray(found.covariance)) / drawn**2))
    return sigma * float(np.sqrt(squares / max(count - len(drawn) + kept, 1.0)))


def _drawn(arm: Arm, parameters: Parameters) -> np.ndarray:
    """Standard deviation of the drawing, of each search variable."""
    return np.array([
        arm.unknown[name] if name in LOGARITHMIC else 1.0
        for name, shape in parameters.shapes
        for _ in np.ndindex(shape)
    ])  # fmt: skip


def _combination(names: Sequence[str], way: np.ndarray) -> str:
    """A direction in words: its larger parts, the largest first and positive."""
    shares = way / way[np.argmax(np.abs(way))]
    large = [k for k in np.argsort(-np.abs(shares)) if abs(shares[k]) > SMALL_PART]
    return ", ".join(f"{names[k]} {shares[k]:+.1f}" for k in large)


def _robust(
    away: np.ndarray, slopes: np.ndarray, limit: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """Differences whose squares grow linearly beyond a limit, and derivatives."""
    if limit is None:
        return away, slopes
    root = np.sqrt(1 + np.sum(away**2, axis=-1, keepdims=True) / limit**2)
    weight = np.sqrt(2 / (1 + root))
    along = np.sum(away * slopes, axis=-1, keepdims=True) / limit**2
    change = -weight / (2 * root * (1 + root)) * along
    return weight * away, weight * slopes + change * away


def _registered(
    arm: Arm,
    values: Mapping[str, Any],
    recordings: Sequence[Recording],
    known: Registration | None,
) -> tuple[tuple[Recording, ...], Registration]:
    """Recordings with labels and in the arm's frame."""
    ready = [r.averaged() if r.is_at_rest(arm.length) else r for r in recordings]
    parameters = _problem(arm, ()).parameters
    point = parameters.searched({name: values[name] for name in arm.unknown})
    made = []
    for recording in ready:
        made.append(np.array(_evaluated(arm, point, _prepared(arm, recording))[0]))
        if not np.all(np.isfinite(made[-1])):
            raise ValueError(
                f"{recording.name}: the arm as drawn has no equilibrium under these "
                "inputs, or its run is not finite: is a unit wrong?"
            )
    if arm.origin is not None:
        # It stays where it is drawn: neither the arm nor what is known of the camera
        # by now moves it.
        _, straight = arm.scene(arm.start, lambda numbers: jnp.zeros(len(numbers)))
        place = np.asarray(arm.points(straight, arm.start))[arm.origin]
        for points in made:
            points[:, arm.origin] = place
    axes = None if arm.frame.axes is None else np.asarray(arm.frame.axes, float)
    shift = None
    if axes is not None and arm.origin is None:
        shift = -np.sum(axes * np.asarray(arm.frame.origin, float), axis=-1)
    if known is not None:
        axes = known.rotation
        shift = known.shifts[0] if arm.origin is None else None
    found = register(ready, made, axes=axes, shift=shift, origin=arm.origin)
    return tuple(found.apply(r, k) for k, r in enumerate(ready)), found


class _Layout(NamedTuple):
    """Numbers of steps of a run; zero at rest."""

    every: int
    """Steps between records."""
    records: int


@pytree
class _Group:
    """A recording as arrays."""

    inputs: Float[Array, "frames inputs"]
    seen: Float[Array, "frames markers 3"]
    """Recorded places; NaN for the marker at the origin, and where none was seen."""
    dt: Float[Array, ""]
    """Step of the run [s]."""
    times: Float[Array, " frames"]
    """Times since the first frame [s]."""
    before: Int[Array, " frames"]
    """Number of the record before each frame."""
    share: Float[Array, " frames"]
    """Time since that record, over that between records [1]."""


def _prepared(arm: Arm, recording: Recording) -> tuple[_Layout, _Group]:
    """Arrays of a recording, and the numbers of steps of its run."""
    points = np.array(recording.points)
    if arm.origin is not None:
        points[:, arm.origin] = np.nan
    times = recording.times - recording.times[0]
    layout, dt = _Layout(0, 0), 1.0
    before, share = np.zeros(times.shape, int), np.zeros(times.shape)
    if len(times) > 1:
        layout, dt = _steps(arm, recording.inputs, float(times[-1]))
        records = times / (dt * layout.every)
        before = np.minimum(records.astype(int), layout.records - 1)
        share = records - before
    arrays = (recording.inputs, points, dt, times, before, share)
    return layout, _Group(*map(jnp.asarray, arrays))


def _made(arm: Arm, layout: _Layout, values: Mapping[str, Any], data: _Group) -> Array:
    """Markers of a recording `(frames, markers, 3)` [m]."""
    rest, points = _pose(arm, values, data.inputs[0])
    if layout.records == 0:
        return points[None]
    pulls = arm.tensions(values, data.inputs)
    late = data.times + values["delay"]
    scene, _ = arm.scene(values, lambda numbers: table(late, pulls[:, numbers]))
    steps = layout.records * layout.every
    states = rollout(scene, rest, data.dt, steps, layout.every)
    made = jax.vmap(lambda state: arm.points(state, values))(states)
    part = data.share[:, None, None]
    made = made[data.before] * (1 - part) + made[data.before + 1] * part
    return jnp.where(jnp.isfinite(points)[None], made, jnp.nan)


def _pose(arm: Arm, values: Mapping[str, Any], inputs: Array) -> tuple[Any, Array]:
    """Equilibrium under constant inputs, and its markers; NaN if there is none."""
    pulls = arm.tensions(values, inputs)
    scene, state = arm.scene(values, lambda numbers: pulls[numbers])
    found = equilibrium(scene, state)
    points = arm.points(found.state, values)
    return found.state, jnp.where(found.converged, points, jnp.nan)


def _steps(arm: Arm, inputs: np.ndarray, duration: float) -> tuple[_Layout, float]:
    """Numbers of steps, and a step that is stable for likely arms [s]."""
    start = arm.start
    stiff = dict(start)
    for name, sign in (("youngs_modulus", 3), ("density", -3), ("tension", 3)):
        stiff[name] = start[name] * np.exp(sign * arm.unknown.get(name, 0.0))
    pulls = jnp.max(arm.tensions(stiff, inputs), axis=0)
    scene, _ = arm.scene(stiff, lambda numbers: pulls[numbers])
    stable = float(stable_dt(scene).dt)
    every = max(1, int(RECORDS / stable))
    records = max(1, int(np.ceil(duration / (stable * every))))
    # A little less than the stable step, so that records end with the recording.
    dt = max(duration, stable) / (records * every)
    return _Layout(every, records), dt

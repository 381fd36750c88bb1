r"""Identification of an arm's unknowns from recordings, with standard deviations.

Recordings at rest are compared with equilibria. Motions are compared with simulations
that begin in the equilibrium under the first inputs. With predicted and recorded
markers $m_k$, $\hat m_k$, and the values $x_{0j}$ and standard deviations $\sigma_j$
of unknowns $x_j$ in the drawing, it minimises

$$\sum_k \rho\Big(\frac{|m_k(x) - \hat m_k|}{\sigma}\Big)
+ \sum_j \Big(\frac{x_j - x_{0j}}{\sigma_j}\Big)^2,$$

with $\rho(r) = r^2$, or $2 c^2 (\sqrt{1 + r^2/c^2} - 1)$ for a robust fit, in which
distances beyond $c$ standard deviations count linearly. The noise $\sigma$ of a
coordinate is estimated from the residuals: fits are repeated until both agree. The
order of the recorded markers (labels) and the frame of the camera are found with the
drawing, then with the fitted arm, until they do not change.
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
from jaxrod.extend import pytree
from jaxrod.statics.equilibrium import equilibrium
from jaxrod.stepping.runs import rollout
from jaxrod.twin.arm import LOGARITHMIC, Arm
from jaxrod.twin.recordings import Recording
from jaxrod.twin.registration import Registration, register
from jaxrod.validation import check_array

RECORDS = 2e-3
"""Longest time between stored states of a simulation, between which the markers are
interpolated to the recorded frames [s]."""
LOWEST = {"friction": 0.0, "marker_masses": 0.0, "poisson_ratio": -0.9}
HIGHEST = {"friction": 2.0, "poisson_ratio": 0.5}
"""Upper bounds of unknowns, in their units; `LOWEST` has the lower bounds."""
FITS = 6
"""Largest number of repetitions of a fit until the noise agrees with its residuals."""
REGISTRATIONS = 4
"""Largest number of times that marker labels are found, each followed by a fit."""
CERTAIN = 1.5
"""Labels count as certain if the distance with the second best labels is at least this
many times the distance with the best [1]."""
FINEST = 1e-6
"""Smallest estimate of the noise, as a fraction of the arm's length [1]."""
MOST_LENGTHS = 3.0
"""Largest accepted extent of recorded markers, in lengths of the arm [1]."""
SMALL_PART = 0.2
"""Components of a combination of unknowns up to this fraction of the largest are left
out of its description [1]."""
SURE = 0.02
"""Relative change of the estimated noise below which fits are not repeated [1]."""


@dataclass(frozen=True)
class Comparison:
    """Markers of a recording, with their prediction by a twin.

    Example:
        >>> points = np.zeros((1, 2, 3))  # one frame, two markers
        >>> pose = twin.Recording("pose", np.zeros(1), np.ones((1, 1)), points)
        >>> wrong = points + np.array([0.003, 0.004, 0.0])
        >>> beside = twin.Comparison(pose, predicted=wrong, sd=0.001 + points)
        >>> beside.errors.round(4).tolist()  # [m]
        [0.005, 0.005]
    """

    recording: Recording
    predicted: Float[np.ndarray, "frames markers 3"]
    """Predicted positions of the markers [m]."""
    sd: Float[np.ndarray, "frames markers 3"]
    """Standard deviations of `predicted`, due to those of the unknowns [m]."""
    origin: int | None = None
    """Index of the marker at the origin of the frame, whose position is exact and not
    predicted; `None` if there is none."""

    @property
    def errors(self) -> Float[np.ndarray, " markers"]:
        """Root mean square over frames of each marker's distance from prediction [m].

        It is NaN for markers that were never seen, and for the marker at the origin.
        """
        away = np.sum((self.predicted - self.recording.points) ** 2, axis=-1)
        if self.origin is not None:
            away[:, self.origin] = np.nan
        return root_mean_square(np.sqrt(away))


def root_mean_square(errors: Any) -> np.ndarray:
    """Root mean square of the finite errors over the first axis.

    It is NaN where there are no finite errors.
    """
    rows = np.asarray(errors)
    seen = np.isfinite(rows)
    sums = np.sum(np.where(seen, rows, 0) ** 2, axis=0)
    counts = np.sum(seen, axis=0)
    return np.where(counts > 0, np.sqrt(sums / np.maximum(counts, 1)), np.nan)


@dataclass(frozen=True)
class Twin:
    """An arm whose unknowns were fitted to recordings by `identify`.

    Example:
        >>> drawn = twin.Arm(
        ...     elements=4,
        ...     length=0.3,
        ...     radius=0.01,
        ...     density=1100.0,
        ...     youngs_modulus=4e5,
        ...     poisson_ratio=0.45,
        ...     direction=(0.0, 0.0, -1.0),
        ...     normal=(0.0, 1.0, 0.0),
        ...     gravity=(0.0, 0.0, -9.81),
        ...     tendons=(twin.TendonDrawing("pull", angle=0.0, distance=0.008),),
        ...     markers=(twin.Marker("tip", at=0.3),),
        ...     unknown={"youngs_modulus": 0.5},
        ...     frame=twin.Frame(axes=np.eye(3), origin=(0.0, 0.0, 0.0)),
        ... )
        >>> there = np.array([[[0.0, 0.05, -0.29]]])  # one frame, one marker [m]
        >>> pose = twin.Recording("pose", np.zeros(1), np.ones((1, 1)), there)
        >>> with jax.enable_x64(True):
        ...     found = twin.identify(drawn, [pose], noise=1e-3)
        >>> list(found.fit.names), found.undetermined
        (['youngs_modulus'], ())
    """

    arm: Arm
    fit: Fit
    """Fitted unknowns with their standard deviations, which `print` shows."""
    noise: float
    """Standard deviation of a coordinate of a marker, in a frame of a motion or in the
    median of a pose [m]."""
    registration: Registration
    recordings: tuple[Recording, ...]
    """Recordings of the fit, with markers in the arm's order and frame."""

    @property
    def drawn_sds(self) -> dict[str, float]:
        """Standard deviation of each search variable in the drawing, by name [1].

        For an unknown in `LOGARITHMIC` it is that of its logarithm. The search variable
        of any other unknown is in units of its standard deviation, which gives one.
        """
        return dict(
            zip(self.fit.names, _drawn(self.arm, self.fit.parameters), strict=True)
        )

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Combinations of unknowns that the drawing determines better than recordings.

        Each is described by its largest components, in standard deviations of the
        drawing.
        """
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
        """Values of all unknowns: those of the fit, and of the drawing for others."""
        return self.arm.start | self.fit.values

    def registered(self, recording: Recording) -> Recording:
        """Converts a recording that was not fitted to the arm's marker order and frame.

        The order chosen is the one closest to the twin's prediction.
        """
        return _registered(self.arm, self.values, [recording], self.registration)[0][0]

    def compare(self, recordings: Sequence[Recording]) -> list[Comparison]:
        """Predicts the markers of recordings.

        A recording that was not fitted is first converted by `registered`.

        Raises:
            ValueError: If a recording cannot be registered, the arm has no equilibrium
                under its inputs, or the precision is not float64.

        Example:
            >>> drawn = twin.Arm(
            ...     elements=4,
            ...     length=0.3,
            ...     radius=0.01,
            ...     density=1100.0,
            ...     youngs_modulus=4e5,
            ...     poisson_ratio=0.45,
            ...     direction=(0.0, 0.0, -1.0),
            ...     normal=(0.0, 1.0, 0.0),
            ...     gravity=(0.0, 0.0, -9.81),
            ...     tendons=(twin.TendonDrawing("pull", angle=0.0, distance=0.008),),
            ...     markers=(twin.Marker("tip", at=0.3),),
            ...     unknown={"youngs_modulus": 0.5},
            ...     frame=twin.Frame(axes=np.eye(3), origin=(0.0, 0.0, 0.0)),
            ... )
            >>> there = np.array([[[0.0, 0.05, -0.29]]])  # one frame, one marker [m]
            >>> pose = twin.Recording("pose", np.zeros(1), np.ones((1, 1)), there)
            >>> with jax.enable_x64(True):
            ...     found = twin.identify(drawn, [pose], noise=1e-3)
            ...     (seen,) = found.compare([pose])
            >>> seen.errors.shape, bool(seen.errors[0] < 0.01)
            ((1,), True)
        """
        _check_precision()
        known = {id(one) for one in self.recordings}
        ready = [r if id(r) in known else self.registered(r) for r in recordings]
        # Along directions that only the drawing determines, its deviations count.
        ways = np.asarray(self.fit.directions)
        ways = ways / np.asarray(self.fit.singular_values)[:, None]
        point = self.fit.parameters.searched(self.fit.values)
        found = []
        for recording in ready:
            made, slopes = _evaluated(self.arm, point, _prepared(self.arm, recording))
            sd = np.sqrt(np.sum(np.tensordot(ways, slopes, 1) ** 2, axis=0))
            found.append(Comparison(recording, made, sd, self.arm.origin))
        return found

    def __str__(self) -> str:
        """Table of the unknowns with standard deviations, followed by `remarks`."""
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
        return "\n".join([*lines, *self.remarks])

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences on convergence, bounds, labels and `undetermined` combinations."""
        held = zip(self.fit.names, np.asarray(self.fit.at_bound), strict=True)
        found = [] if bool(self.fit.converged) else ["NOT CONVERGED"]
        found += [f"{name} is at its bound" for name, at_bound in held if at_bound]
        margin = self.registration.margin
        if np.isfinite(margin):
            guessed = "; the labels are a guess" if margin < CERTAIN else ""
            found.append(
                f"labels: the second best order is {margin:.3g} times farther off"
                + guessed
            )
        found += [f"known from the drawing alone: {part}" for part in self.undetermined]
        return tuple(found)


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
        recordings: Recordings as read; one that `is_at_rest` is averaged to one frame.
        noise: Standard deviation of a coordinate of a marker [m], both in a frame of a
            motion and in the median of a pose. If `None`, it is estimated from the
            residuals, which include errors of the model.
        robust: Distance in standard deviations beyond which a marker has less weight,
            such as 3; by default all have equal weights.
        iterations: Largest number of iterations of each fit.

    Raises:
        ValueError: If an argument is out of range, a recording cannot be registered,
            the arm has no unknowns, the frame of the camera is not known and not among
            them, or there are fewer coordinates than unknowns to estimate noise from.

    Example:
        >>> drawn = twin.Arm(
        ...     elements=4,
        ...     length=0.3,
        ...     radius=0.01,
        ...     density=1100.0,
        ...     youngs_modulus=4e5,
        ...     poisson_ratio=0.45,
        ...     direction=(0.0, 0.0, -1.0),
        ...     normal=(0.0, 1.0, 0.0),
        ...     gravity=(0.0, 0.0, -9.81),
        ...     tendons=(twin.TendonDrawing("pull", angle=0.0, distance=0.008),),
        ...     markers=(twin.Marker("tip", at=0.3),),
        ...     unknown={"youngs_modulus": 0.5},
        ...     frame=twin.Frame(axes=np.eye(3), origin=(0.0, 0.0, 0.0)),
        ... )
        >>> there = np.array([[[0.0, 0.05, -0.29]]])  # one frame, one marker [m]
        >>> pose = twin.Recording("pose", np.zeros(1), np.ones((1, 1)), there)
        >>> with jax.enable_x64(True):
        ...     found = twin.identify(drawn, [pose], noise=1e-3)
        >>> print(found)
        unknown                value         sd  sd left of the drawing's
        youngs_modulus    2.1601e+05      4e+03  4%
        noise of a coordinate: 1.00 mm
    """
    if not recordings:
        raise ValueError("a twin needs at least one recording")
    if not arm.unknown:
        raise ValueError("the arm has no unknowns: there is nothing to identify")
    if noise is not None:
        check_array("noise", noise, [()], "m", positive=True)
    if robust is not None:
        check_array("robust", robust, [()], "", positive=True)
    _check_precision()
    # A frame found by registration absorbs errors of the drawing, so it stays unknown.
    frame = {"turn": arm.frame.axes is None}
    frame["shift"] = arm.shift is None and arm.origin is None
    for name, found_from_markers in frame.items():
        if found_from_markers and name not in arm.unknown:
            raise ValueError(
                f"the frame of the camera is not known, so {name} must be among the "
                "unknowns: a fixed frame would absorb errors of the drawing"
            )
    values = arm.start
    for _ in range(REGISTRATIONS):
        ready, registration = _registered(arm, values, recordings, None)
        found, sigma = _fitted(arm, ready, noise, robust, iterations)
        # The fitted arm predicts labels better than the drawing does.
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
    """Fits unknowns to registered recordings; returns the fit, and the noise [m].

    Registered recordings have their markers in the arm's order and frame. `noise`,
    `robust` and `iterations` are as in `identify`.
    """
    data = [_prepared(arm, recording) for recording in recordings]
    problem = _problem(arm, data)
    drawn = _drawn(arm, problem.parameters)

    count = problem.seen["markers"].size
    if count == 0:
        raise ValueError("no marker was seen in any recording")
    if noise is None and count <= len(drawn):
        raise ValueError(
            f"{count} coordinates are too few to estimate the noise and {len(drawn)} "
            "unknowns: give noise in m"
        )

    def residuals(point: np.ndarray, sigma: float) -> _Residuals:
        rows, slopes = [point / drawn], [np.diag(1 / drawn)]
        cost, bounded = np.sum(rows[0] ** 2), 0.0
        for layout, group in data:
            made, moved = _evaluated(arm, point, (layout, group))
            there = np.isfinite(group.seen)
            away = np.where(there, made - np.where(there, group.seen, 0), 0)
            weight, own_cost = _robust(away / sigma, robust)
            rows.append((weight * away / sigma)[there])
            slopes.append((weight * moved / sigma)[:, there].T)
            cost += own_cost
            bounded += float(np.sum((weight**2 * away / sigma) ** 2))
        return _Residuals(np.concatenate(rows), np.concatenate(slopes), cost, bounded)

    def fitted(sigma: float, start: np.ndarray) -> tuple[Fit, float]:
        found = _searched(
            lambda point: residuals(point, sigma), start, problem, iterations
        )
        return fit_of(problem, found), found.bounded

    sigma = 0.01 * arm.length if noise is None else float(noise)
    found, bounded = fitted(sigma, np.zeros(len(problem.low)))
    for _ in range(FITS if noise is None else 0):
        estimate = sigma * _noise(found, drawn, count, bounded / _mean_square(robust))
        before, sigma = sigma, max(estimate, FINEST * arm.length)
        start = np.asarray(found.parameters.searched(found.values))
        found, bounded = fitted(sigma, start)
        if abs(sigma / before - 1) < SURE:
            break
    return found, sigma


class _Residuals(NamedTuple):
    """Cost at a point, and residuals `rows` whose squares have the same gradient.

    A robust cost is not the sum of these squares, so it is stored separately.
    """

    rows: np.ndarray
    slopes: np.ndarray
    """Jacobian of the residuals `rows`, at constant robust weights."""
    cost: float
    bounded: float
    """Sum of (w r)^2 over the markers' coordinates, with residuals r in units of the
    noise and robust weights w, for the estimate of the noise."""


@pytree
class _Found:
    """Best point of a search, with the fields that `fit_of` needs."""

    solution: Array
    residuals: Array
    jacobian: Array
    iterations: Array
    bounded: float


def _searched(
    evaluate: Callable[[np.ndarray], _Residuals],
    start: np.ndarray,
    problem: FitProblem,
    iterations: int,
) -> _Found:
    """Minimises the cost of `evaluate` by damped steps from `start`, within bounds.

    It is the search of `control.least_squares` as a loop in Python, so that only the
    simulations of recordings are compiled, once for each shape.
    """
    low, high = np.asarray(problem.low), np.asarray(problem.high)
    point, damping, tried = start, 1e-3, 0
    here = evaluate(point)
    if not np.isfinite(here.cost):
        raise ValueError(
            "at the start of the search the arm has no equilibrium, or its run is not "
            "finite"
        )
    while tried < iterations and damping < MOST_DAMPING:
        pull = here.slopes.T @ here.rows
        free = ~(((point <= low) & (pull > 0)) | ((point >= high) & (pull < 0)))
        curved = here.slopes.T @ here.slopes
        curved[np.diag_indices_from(curved)] *= 1 + damping
        step = np.zeros_like(point)
        step[free] = -np.linalg.solve(curved[np.ix_(free, free)], pull[free])
        trial = np.clip(point + step, low, high)
        there = evaluate(trial)
        tried += 1
        change = abs(here.cost - there.cost)
        still = change <= default_tolerance(float) * here.cost
        if np.isfinite(there.cost) and there.cost < here.cost:
            point, here = trial, there
            damping /= FASTER
        else:
            damping *= SLOWER
        if still:
            break
    return _Found(
        solution=jnp.asarray(point),
        residuals=jnp.asarray(here.rows),
        jacobian=jnp.asarray(here.slopes),
        iterations=jnp.asarray(tried),
        bounded=here.bounded,
    )


def _problem(arm: Arm, data: Sequence[tuple[_Layout, _Group]]) -> FitProblem:
    """Makes the `FitProblem`: names, scales, bounds, and number of seen coordinates.

    `data` are the recordings, as `_prepared` returns them.
    """
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
    """Predicted markers of a recording [m], and derivatives for each search variable.

    `point` has the search variables, `prepared` the recording as `_prepared` returns
    it.
    """
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


def _noise(found: Fit, drawn: np.ndarray, count: int, squares: float) -> float:
    """Estimates the noise from the residuals, relative to the noise of the fit [1].

    It is the square root of `squares`, the sum of squares, over the degrees of freedom.
    These are `count`, the number of coordinates, minus the number of unknowns that the
    recordings determine. `drawn` has the standard deviations of the unknowns in the
    drawing.

    Source: P. J. Huber, Robust statistics, 1981, proposal 2.
    """
    # An unknown that only the drawing determines does not reduce degrees of freedom.
    kept = float(np.sum(np.diagonal(np.asarray(found.covariance)) / drawn**2))
    return float(np.sqrt(squares / (count - len(drawn) + kept)))


def _mean_square(limit: float | None) -> float:
    """Mean of (w r)^2 for a standard normal coordinate r with robust weight w [1].

    `limit` is c in the module's formula; without it the mean is one.
    """
    if limit is None:
        return 1.0
    distance = np.linspace(0, 12, 4001)
    density = distance**2 * np.exp(-0.5 * distance**2)
    bounded = distance / np.sqrt(1 + (distance / limit) ** 2)
    return float(np.sum(density * bounded**2) / np.sum(density) / 3)


def _drawn(arm: Arm, parameters: Parameters) -> np.ndarray:
    """Standard deviation of each search variable in the drawing [1].

    It is that of the logarithm for unknowns in `LOGARITHMIC`, and one for others, whose
    search variables are in units of their standard deviation.
    """
    return np.array([
        arm.unknown[name] if name in LOGARITHMIC else 1.0
        for name, shape in parameters.shapes
        for _ in np.ndindex(shape)
    ])  # fmt: skip


def _combination(names: Sequence[str], way: np.ndarray) -> str:
    """Text of a direction's larger components, the largest first, scaled to +1.

    `way` has the component of the direction for each unknown in `names`.
    """
    shares = way / way[np.argmax(np.abs(way))]
    large = [k for k in np.argsort(-np.abs(shares)) if abs(shares[k]) > SMALL_PART]
    return ", ".join(f"{names[k]} {shares[k]:+.1f}" for k in large)


def _robust(away: np.ndarray, limit: float | None) -> tuple[np.ndarray, float]:
    """Returns square roots of the robust weights of residuals, and their robust cost.

    `away` holds residuals in units of the noise. `limit` is c in the module's formula,
    or `None` for equal weights. The gradient of the cost is that of the weighted
    squares at constant weights.
    """
    squares = np.sum(away**2, axis=-1, keepdims=True)
    if limit is None:
        return np.ones_like(squares), float(np.sum(squares))
    root = np.sqrt(1 + squares / limit**2)
    return 1 / np.sqrt(root), float(2 * limit**2 * np.sum(root - 1))


def _check_precision() -> None:
    """Raises a ValueError unless JAX computes in float64."""
    if not jax.config.jax_enable_x64:
        raise ValueError("a twin needs float64: use `with jax.enable_x64():`")


def _registered(
    arm: Arm,
    values: Mapping[str, Any],
    recordings: Sequence[Recording],
    known: Registration | None,
) -> tuple[tuple[Recording, ...], Registration]:
    """Converts recordings to the arm's marker order and frame, by their predictions.

    Predictions are made with the unknowns `values`. `known` has the rotation and shift
    from an earlier registration, or is `None`.
    """
    ready = [r.averaged() if r.is_at_rest(arm.length) else r for r in recordings]
    parameters = _problem(arm, ()).parameters
    point = parameters.searched({name: values[name] for name in arm.unknown})
    made = []
    for recording in ready:
        made.append(np.array(_evaluated(arm, point, _prepared(arm, recording))[0]))
        if not np.all(np.isfinite(made[-1])):
            kind = "drawn" if known is None else "found"
            raise ValueError(
                f"{recording.name}: the arm as {kind} has no equilibrium under these "
                "inputs, or its run is not finite: is a unit wrong?"
            )
        seen = recording.points[np.isfinite(recording.points).all(axis=-1)]
        extent = np.max(np.ptp(seen, axis=0)) if len(seen) else 0.0
        if extent > MOST_LENGTHS * arm.length:
            raise ValueError(
                f"{recording.name}: markers are {extent:.3g} m apart on an arm of "
                f"{arm.length:.3g} m: is the scale of the frame wrong?"
            )
    if arm.origin is not None:
        # The marker at the origin does not move, so its prediction is exact.
        for points in made:
            points[:, arm.origin] = arm.straight[arm.origin]
    axes, shift = arm.frame.axes, arm.shift
    axes = None if axes is None else np.asarray(axes, float)
    if known is not None:
        axes = known.rotation
        shift = known.shifts[0] if arm.origin is None else None
    found = register(ready, made, axes=axes, shift=shift, origin=arm.origin)
    return tuple(found.apply(r, k) for k, r in enumerate(ready)), found


class _Layout(NamedTuple):
    """Numbers of steps of a recording's simulation: `records` times `every`.

    Both are zero for a recording at rest, which is compared with an equilibrium.
    """

    every: int
    """Number of time steps between stored states."""
    records: int


@pytree
class _Group:
    """A recording as arrays, with the time step of its simulation."""

    inputs: Float[Array, "frames inputs"]
    seen: Float[Array, "frames markers 3"]
    """Recorded positions [m]; NaN for the marker at the origin, and if not seen."""
    dt: Float[Array, ""]
    """Time step of the simulation [s]."""
    times: Float[Array, " frames"]
    """Times since the first frame [s]."""
    before: Int[Array, " frames"]
    """Index of the stored state before each frame."""
    share: Float[Array, " frames"]
    """Time of each frame between the stored states before and after it, from 0 to 1."""


def _prepared(arm: Arm, recording: Recording) -> tuple[_Layout, _Group]:
    """Converts a recording to arrays, and chooses the steps of its simulation."""
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
    """Predicts the markers of a recording `(frames, markers, 3)` [m].

    `data` and `layout` are the recording as `_prepared` returns it, `values` are the
    values of the unknowns.
    """
    rest, points = _pose(arm, values, data.inputs[0])
    if layout.records == 0:
        return points[None]
    pulls = arm.tensions(values, data.inputs)
    late = data.times + values["delay"]
    scene, _ = arm.scene(values, lambda numbers: table(late, pulls[:, numbers]))
    steps = layout.records * layout.every
    states = rollout(scene, rest, data.dt, steps, layout.every)
    made = jax.vmap(lambda state: arm.points(scene, state, values))(states)
    part = data.share[:, None, None]
    made = made[data.before] * (1 - part) + made[data.before + 1] * part
    return jnp.where(jnp.isfinite(points)[None], made, jnp.nan)


def _pose(arm: Arm, values: Mapping[str, Any], inputs: Array) -> tuple[Any, Array]:
    """Equilibrium under constant inputs, and its markers [m]; NaN if not found.

    `values` are the values of the unknowns.
    """
    pulls = arm.tensions(values, inputs)
    scene, state = arm.scene(values, lambda numbers: pulls[numbers])
    found = equilibrium(scene, state)
    points = arm.points(scene, found.state, values)
    return found.state, jnp.where(found.converged, points, jnp.nan)


def _steps(arm: Arm, inputs: np.ndarray, duration: float) -> tuple[_Layout, float]:
    """Numbers of steps of a simulation over `duration` [s], and its time step [s].

    The step is stable for the largest tensions of `inputs` `(frames, inputs)`, and for
    values of unknowns within three standard deviations.
    """
    start = arm.start
    stiff = dict(start)
    for name, sign in (("youngs_modulus", 3), ("density", -3), ("tension", 3)):
        stiff[name] = start[name] * np.exp(sign * arm.unknown.get(name, 0.0))
    # The modulus may be larger at either end.
    slope = 3 * arm.unknown.get("modulus_slope", 0.0)
    stiff["youngs_modulus"] = stiff["youngs_modulus"] * np.exp(0.5 * slope)
    pulls = jnp.max(arm.tensions(stiff, inputs), axis=0)
    scene, _ = arm.scene(stiff, lambda numbers: pulls[numbers])
    stable = float(stable_dt(scene).dt)
    every = max(1, int(RECORDS / stable))
    records = max(1, int(np.ceil(duration / (stable * every))))
    # Reduced so that a whole number of steps ends with the recording.
    dt = max(duration, stable) / (records * every)
    return _Layout(every, records), dt

"""Distributions of parameters, and faults of actuators and sensors, as plain values.

The values have the form of a TOML file and of `config.json`, so that a run can record
them. `jaxrod.envs.Randomised` applies them to an environment.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from jaxrod.control.identification.result import VAGUE, Fit
from jaxrod.validation import check_array, check_count

KINDS = ("uniform", "log_uniform", "normal", "log_normal")
"""Kinds of distributions."""


@dataclasses.dataclass(frozen=True)
class Randomisation:
    """Distributions of parameters, and faults of actuators and sensors.

    A range is one number, or (lowest, highest); a value is then drawn for every
    episode. Mappings and numbers have the form of a TOML file and of `config.json`
    (docs/randomisation.md).

    Raises:
        ValueError: A range is reversed, a number is negative or not finite, or an
            option is unknown. `Randomised` checks names and shapes.

    Example:
        >>> varied = envs.Randomisation(
        ...     parameters={"stride": {"uniform": (0.8, 1.2), "scaled": True}},
        ...     noise={"position": 0.01},
        ...     delay=(0, 2),
        ... )
        >>> env = envs.make("trivial", randomise=varied)
        >>> envs.Randomisation.from_record(varied.record()) == varied
        True
    """

    parameters: Mapping[str, Mapping[str, Any]] = dataclasses.field(
        default_factory=dict, hash=False
    )
    """Distributions by paths of parameters, such as "target.speed"; a draw is shared by
    several paths with commas between. A distribution has one of `uniform` (low, high),
    `log_uniform` (low, high), `normal` (mean, standard deviation) and `log_normal`
    (median, standard deviation of the logarithm). With `scaled` true the value is a
    factor of the nominal parameter, otherwise it replaces the parameter. Numbers draw
    one value for all entries of a parameter; arrays draw their entries
    independently."""
    noise: float | Mapping[str, float] = dataclasses.field(default=0.0, hash=False)
    """Standard deviation of the observation's noise, in the unit of each entry: one
    number, or numbers by channel. A key is the name of a channel of
    `observation_channels`, or the beginning of the name, or indices of entries such as
    "0, 4-7"."""
    dropout: float | Mapping[str, float] = dataclasses.field(default=0.0, hash=False)
    """Probability per control step that entries are not seen; their last seen values
    are then held. One number applies to every entry independently. With keys as in
    `noise`, all entries of a key drop out together."""
    flags: bool = False
    """Whether an entry per key of `dropout` is appended to the observation: 1 if it was
    seen, 0 if held."""
    delay: Any = dataclasses.field(default=0, hash=False)
    """Delay of the actions [control steps], an integer or a range of integers."""
    lag: Any = dataclasses.field(default=0.0, hash=False)
    """Time constant of the actuators' first-order lag [control steps]; a range."""
    lag_seconds: Any = dataclasses.field(default=0.0, hash=False)
    """Time constant of the lag [s], for tasks with a `control_period`; a range."""
    saturation: Any = dataclasses.field(default=1.0, hash=False)
    """Largest absolute action [1]; a range."""
    rate: Any = dataclasses.field(default=2.0, hash=False)
    """Largest change of an action per control step [1]; a range. The default of 2 means
    no limit."""
    past_actions: Any = dataclasses.field(default=(), hash=False)
    """Past actions that are appended to the observation, by the number of control steps
    ago at which they were chosen, such as (1, 9). They are clipped to [-1, 1], and zero
    before the first action."""
    correlation: Mapping[str, Any] = dataclasses.field(default_factory=dict, hash=False)
    """Correlation of `normal` and `log_normal` draws: `names`, a list of keys of
    `parameters`, and `matrix`."""
    widening: Mapping[str, Any] = dataclasses.field(default_factory=dict, hash=False)
    """Rule by which `training.train` widens the randomisation from the nominal task to
    its full size, as returns allow: `above` (required) and `below`, mean returns that
    widen and narrow it; `start`, the share of the full size at the start (0); `step`,
    the change of the share (0.1); `episodes`, the number of training episodes of a mean
    (64)."""

    def __post_init__(self) -> None:
        """Checks all numbers, and converts them to lists and floats."""

        def put(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        parameters = _mapping("parameters", self.parameters)
        rules = {_key(key): _distribution(key, parameters[key]) for key in parameters}
        for key in rules:
            if not all(key.split(", ")):
                raise ValueError(f"parameters has an empty path in {key!r}")
        if len(rules) < len(parameters):
            raise ValueError(
                "parameters has two distributions of one path: "
                f"{', '.join(map(repr, parameters))}"
            )
        put("parameters", dict(sorted(rules.items())))
        put("noise", _levels("noise", self.noise, math.inf))
        put("dropout", _levels("dropout", self.dropout, 1.0))
        if not isinstance(self.flags, bool):
            raise ValueError(f"flags must be true or false, got {self.flags!r:.60}")
        if self.flags and not self.dropout:
            raise ValueError("flags mark entries that drop out: dropout must be given")
        steps = "control steps"
        put("delay", _range("delay", self.delay, steps, whole=True))
        put("lag", _range("lag", self.lag, steps))
        put("lag_seconds", _range("lag_seconds", self.lag_seconds, "s"))
        if any(self.lag) and any(self.lag_seconds):
            raise ValueError("give either lag [control steps] or lag_seconds [s]")
        put("saturation", _range("saturation", self.saturation, "", at_most=1.0))
        put("rate", _range("rate", self.rate, "per control step"))
        put("past_actions", _steps_ago(self.past_actions))
        put("correlation", _correlation(self.correlation, self.parameters))
        put("widening", _widening(self.widening))

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Randomisation:
        """Builds a `Randomisation` from a TOML file's contents, or from `record()`.

        Raises:
            ValueError: An entry is unknown, or a value is invalid.

        Example:
            >>> varied = envs.Randomisation.from_record({"delay": [0, 2]})
            >>> varied.delay
            [0, 2]
        """
        known = [field.name for field in dataclasses.fields(cls)]
        for name in _mapping("randomise", record):
            if name not in known:
                raise ValueError(
                    f"there is no option {name!r} of a randomisation; there are "
                    f"{', '.join(known)}"
                )
        return cls(**record)

    def record(self) -> dict[str, Any]:
        """Options with non-default values, as plain values for JSON and TOML.

        Example:
            >>> varied = envs.Randomisation(noise={"position": 0.01}, delay=(0, 2))
            >>> varied.record()
            {'noise': {'position': 0.01}, 'delay': [0, 2]}
        """
        usual = type(self)()
        given = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return {k: v for k, v in given.items() if v != getattr(usual, k)}


def posterior(fit: Fit, paths: Mapping[str, str]) -> Randomisation:
    """Randomisation that draws parameters from the estimate of a fit.

    Draws have the fit's standard deviations and correlations. A parameter that was
    found by its logarithm becomes a log-normal factor of the nominal value in the task,
    which should be the fitted one. Other parameters are drawn as values, with a normal
    distribution.

    Args:
        fit: Result of `jaxrod.control.fit`, or `fit` of a `jaxrod.twin.Twin`.
        paths: Paths of the task's parameters, as in `Randomisation.parameters`, by
            names in `fit.names`.

    Raises:
        ValueError: The fit has no such parameter, the data do not determine it, or
            this is a batch of fits.

    Example:
        >>> x = jnp.arange(5.0)
        >>> line = lambda p: p["slope"] * x
        >>> found = control.fit(line, 3.0 * x, {"slope": 1.0}, noise=1.0)
        >>> drawn = envs.posterior(found, {"slope": "stride"})
        >>> env = envs.make("trivial", randomise=drawn)
    """
    if fit.covariance.ndim > 2:
        raise ValueError("posterior needs a single fit, and this is a batch of fits")
    names = list(fit.names)
    for name in paths:
        if name not in names:
            raise ValueError(
                f"the fit has no parameter {name!r}; it has {', '.join(names)}"
            )
    rows = [names.index(name) for name in paths]
    covariance = np.asarray(fit.covariance, float)[np.ix_(rows, rows)]
    sds = np.sqrt(np.diag(covariance))
    values, scales = (
        np.asarray(fit.parameters.flat(numbers), float)
        for numbers in (fit.values, fit.parameters.scales)
    )
    parameters = {}
    for row, sd, (name, path) in zip(rows, sds, paths.items(), strict=True):
        if not sd <= VAGUE:
            raise ValueError(
                f"the data of the fit do not determine {name!r}: its standard "
                f"deviation is {100 * sd:.3g} % of its value; give it a distribution "
                "of your own"
            )
        if path in parameters:
            raise ValueError(f"paths leads to {path!r} twice")
        parameters[path] = (
            {"log_normal": (1.0, sd), "scaled": True}
            if fit.parameters.by_log[row]
            else {"normal": (values[row], sd * scales[row])}
        )
    matrix = covariance / np.where(sds > 0, sds, 1) / np.where(sds > 0, sds, 1)[:, None]
    np.fill_diagonal(matrix, 1.0)
    correlation = {"names": list(parameters), "matrix": (matrix + matrix.T) / 2}
    return Randomisation(
        parameters=parameters, correlation=correlation if len(rows) > 1 else {}
    )


def kind_of(rule: Mapping[str, Any]) -> str:
    """Kind of a checked distribution, such as "uniform"."""
    return next(name for name in rule if name != "scaled")


def _key(key: Any) -> str:
    """Key of a distribution in its usual form: paths with ", " between."""
    return ", ".join(part.strip() for part in str(key).split(","))


def _mapping(name: str, value: Any) -> Mapping[str, Any]:
    if not isinstance(value, Mapping) or not all(isinstance(k, str) for k in value):
        raise ValueError(
            f"{name} must be a table of names and values, got {value!r:.60}"
        )
    return value


def _distribution(key: str, given: Any) -> dict[str, Any]:
    """Validates a distribution and returns it, with numbers as floats or lists."""
    rule = dict(_mapping(f"the distribution of {key!r}", given))
    scaled = rule.pop("scaled", False)
    kind = next(iter(rule), "")
    if len(rule) != 1 or kind not in KINDS or not isinstance(scaled, bool):
        raise ValueError(
            f"the distribution of {key!r} must be one of {', '.join(KINDS)} "
            f"with two numbers, and scaled true or false, got {given!r:.80}"
        )
    name, numbers = f"{kind} of {key!r}", rule[kind]
    pair = isinstance(numbers, Sequence | np.ndarray | jax.Array)
    if not pair or isinstance(numbers, str) or len(numbers) != 2:
        raise ValueError(f"{name} must have two numbers, got {numbers!r:.60}")
    unit = "times the nominal value" if scaled else "(in the parameter's unit)"
    first, second = (
        check_array(name, number, [np.shape(number)], unit) for number in numbers
    )
    try:
        low, high = np.broadcast_arrays(first, second)
    except ValueError:
        raise ValueError(
            f"{name} has numbers of shapes {first.shape} and {second.shape}"
        ) from None
    if "log" in kind and np.any(low <= 0):
        raise ValueError(f"{name} must be positive, got {np.min(low):g} {unit}")
    if "uniform" in kind and np.any(low > high):
        k = np.unravel_index(np.argmax(low > high), low.shape)
        raise ValueError(
            f"{name} must go from low to high, got {low[k]:g} to {high[k]:g} {unit}"
        )
    if "normal" in kind and np.any(high < 0):
        unit = "" if "log" in kind else f" {unit}"
        raise ValueError(
            f"the standard deviation of {name} must not be negative, got "
            f"{np.min(high):g}{unit}"
        )
    return {kind: [first.tolist(), second.tolist()]} | (
        {"scaled": True} if scaled else {}
    )


def _levels(name: str, given: Any, most: float) -> Any:
    """Validates noise or drop-out and returns it: a number, or numbers by key."""
    unit = "(in the unit of the entry)" if name == "noise" else "(a probability)"

    def checked(what: str, value: Any) -> float:
        return float(
            check_array(what, value, [()], unit, non_negative=True, at_most=most)
        )

    if isinstance(given, Mapping):
        table = _mapping(name, given)
        return {k: checked(f"{name} of {k!r}", table[k]) for k in table} or 0.0
    return checked(name, given)


def _range(
    name: str, given: Any, unit: str, *, at_most: float = math.inf, whole: bool = False
) -> list[Any]:
    """Validates a range and returns its lowest and highest number."""
    numbers = check_array(
        name, given, [(), (2,)], unit, non_negative=True, at_most=at_most
    )
    low, high = (float(number) for number in np.broadcast_to(numbers, (2,)))
    if low > high:
        raise ValueError(
            f"{name} must go from low to high, got {low:g} to {high:g} {unit}".rstrip()
        )
    if not whole:
        return [low, high]
    if not (low.is_integer() and high.is_integer()):
        raise ValueError(f"{name} must be whole {unit}, got {low:g} to {high:g} {unit}")
    return [int(low), int(high)]


def _steps_ago(given: Any) -> list[int]:
    """Validates numbers of control steps and returns them."""
    listed = isinstance(given, Sequence | np.ndarray) and not isinstance(given, str)
    if not listed:
        raise ValueError(
            f"past_actions must be a list of control steps, got {given!r:.60}"
        )
    steps = [check_count("each of past_actions", step, 1) for step in given]
    if len(set(steps)) < len(steps):
        raise ValueError(f"past_actions must be different control steps, got {steps}")
    return steps


def _correlation(given: Any, rules: Mapping[str, Any]) -> dict[str, Any]:
    """Validates a correlation and returns it: names of scalar draws, and the matrix."""
    if not _mapping("correlation", given):
        return {}
    if set(given) != {"names", "matrix"} or not isinstance(given["names"], Sequence):
        raise ValueError(f"correlation must have names and matrix, got {given!r:.60}")
    names = [_key(name) for name in given["names"]]
    for name in names:
        rule = rules.get(name, {"": [0]})
        if "normal" not in kind_of(rule) or np.ndim(rule[kind_of(rule)]) != 1:
            raise ValueError(
                f"correlation names {name!r}, which has no normal or log_normal "
                "distribution of one number"
            )
    size = len(names)
    matrix = check_array(
        "matrix of correlation",
        given["matrix"],
        [(size, size)],
        "",
        at_least=-1 - 1e-6,
        at_most=1 + 1e-6,
    )
    sound = np.allclose(matrix, matrix.T) and np.allclose(np.diag(matrix), 1)
    if len(set(names)) != size or not sound or np.linalg.eigvalsh(matrix)[0] < -1e-4:
        raise ValueError(
            "matrix of correlation must be symmetric, with ones on the diagonal and no "
            "negative eigenvalue, for distinct names"
        )
    return {"names": names, "matrix": matrix.tolist()}


def _widening(given: Any) -> dict[str, Any]:
    """Validates a rule of widening and returns it, with all of its numbers."""
    if not _mapping("widening", given):
        return {}
    for name in given:
        if name not in ("above", "below", "episodes", "start", "step"):
            raise ValueError(
                f"widening has no option {name!r}; it has above, below, episodes, "
                "start, step"
            )
    if "above" not in given:
        raise ValueError("widening needs above, the mean return that widens the ranges")
    rule = {
        name: float(check_array(f"{name} of widening", given[name], [()], ""))
        for name in ("above", "below")
        if name in given
    }
    if rule.get("below", -math.inf) >= rule["above"]:
        raise ValueError(
            f"below of widening must be less than above, got {rule['below']:g} and "
            f"{rule['above']:g}"
        )
    for name, usual in (("start", 0.0), ("step", 0.1)):
        number = given.get(name, usual)
        rule[name] = float(
            check_array(
                f"{name} of widening", number, [()], "", non_negative=True, at_most=1.0
            )
        )
    if rule["step"] == 0:
        raise ValueError("step of widening must be above 0, got 0")
    return rule | {
        "episodes": check_count("episodes of widening", given.get("episodes", 64), 1)
    }

r"""Environments whose parameters, actuators and sensors vary and fail, as real ones do.

At every reset a randomised environment draws parameters of its task, and it keeps them
until the episode ends. In every control step the action $a$ passes, in this order,

- a delay of a whole number of control steps,
- saturation: $u = \mathrm{clip}(a, -s, s)$,
- a first-order lag: $x' = u + e^{-1/\tau} (x - u)$, with $\tau$ in control steps,
- a rate limit: $|x' - x| \le r$.

Before the first action, all earlier actions were zero. The observation then gets
Gaussian noise, and entries that drop out keep their last seen values. Past actions may
be appended, as they were chosen. Reward, termination and `info` are those of the task,
without noise.

Randomness: the task receives the keys of `reset` and `step` unchanged; all other draws
come from `fold_in(key, 0x52414E44)`.

Source: J. Tobin et al., Domain Randomization for Transferring Deep Neural Networks from
Simulation to the Real World, IROS 2017; X. B. Peng et al., Sim-to-Real Transfer of
Robotic Control with Dynamics Randomization, ICRA 2018.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from jaxrod.envs.checking import action_of_size, by_path, check_key, dotted, nearest
from jaxrod.envs.protocol import Channel, Environment, Snapshot, Step
from jaxrod.envs.randomisation import Randomisation, kind_of
from jaxrod.envs.wrappers import EnvironmentWrapper
from jaxrod.structure import pytree

_OWN = 0x52414E44
"""Number that is folded into a key for the draws of the wrapper."""
_SHORTEST_LAG = 1e-3
"""Time constant below which there is no lag: exp(-1000) is 0 [control steps]."""
_FAULTLESS = {"delay": 0.0, "lag": 0.0, "rate": 2.0, "saturation": 1.0}
"""Numbers of an actuator without faults; the units are those of `Randomisation`."""
_FORWARDED = ("action_channels", "control_period", "variant")
"""Optional attributes that a randomised environment has if its task has them."""

_DISTRIBUTIONS: dict[str, Callable[[Array, Array, Array], Array]] = {
    "uniform": lambda u, low, high: low + (high - low) * u,
    "log_uniform": lambda u, low, high: low * jnp.exp(u * jnp.log(high / low)),
    "normal": lambda z, mean, sd: mean + sd * z,
    "log_normal": lambda z, median, sd: median * jnp.exp(sd * z),
}
"""Maps a draw, uniform in [0, 1) or standard normal, and two numbers to a value."""


@pytree
class RandomisedParams:
    """Parameters of a randomised environment: of its task, and of all distributions.

    Every number is a traced leaf, so a change of it recompiles nothing.

    Example:
        >>> varied = envs.Randomisation(parameters={"stride": {"uniform": (0.1, 0.3)}})
        >>> params = envs.make("trivial", randomise=varied).default_params()
        >>> params.ranges["stride"].shape, params.noise is None
        ((2,), True)
    """

    task: Any
    """Nominal parameters of the task."""
    ranges: dict[str, Float[Array, "2 ..."]]
    """Both numbers of each distribution, by key of `Randomisation.parameters`."""
    mixing: Float[Array, "n n"] | None
    """Square root of the correlation matrix; None without correlations."""
    actuator: dict[str, Float[Array, "2"]]
    """Ranges of `delay`, `lag`, `saturation` and `rate`, as far as given. A delay stays
    below the largest one that the environment was made with."""
    noise: Float[Array, " entries"] | None
    """Standard deviation of the noise of each entry; None without noise."""
    dropout: Float[Array, " keys"] | None
    """Probability of drop-out of each key; None without drop-out."""
    share: Float[Array, ""] | None = None
    """Share of the randomisation that episodes get: 0 is the nominal task, 1 the full
    randomisation. None without `Randomisation.widening`, which means 1."""


@pytree
class RandomisedState:
    """State of a randomised environment.

    Example:
        >>> env = envs.make("trivial", randomise={"delay": [2, 2]})
        >>> observation, start = env.reset(jax.random.key(0), env.default_params())
        >>> start.pending.shape, start.drawn, float(start.actuator["delay"])
        ((2, 1), {}, 2.0)
    """

    task: Any
    """State of the task."""
    drawn: dict[str, Array]
    """Values drawn for this episode, by key of `Randomisation.parameters`."""
    actuator: dict[str, Float[Array, ""]]
    """Values drawn for this episode of `delay`, `lag`, `saturation` and `rate`."""
    pending: Float[Array, "delay action"] | None
    """Last actions, newest first; None without a delay."""
    position: Float[Array, " action"] | None
    """Output of the actuators; None without lag and rate limit."""
    seen: Float[Array, " entries"] | None
    """Last seen value of every entry; None without drop-out."""
    clean: Float[Array, " entries"]
    """Observation of the task, without noise and drop-out."""
    share: Float[Array, ""] | None = None
    """Share of the randomisation in this episode; None without widening."""
    chosen: Float[Array, "steps action"] | None = None
    """Last actions as they were chosen, newest first; None if none is observed."""


@dataclasses.dataclass(frozen=True)
class Randomised(EnvironmentWrapper):
    """An environment that draws its parameters, and has faulty actuators and sensors.

    Its parameters are `RandomisedParams`. With ranges of zero width, without noise and
    faults, it equals the wrapped environment to the last bit.

    Raises:
        ValueError: The task has no such parameter or channel, a distribution has
            another shape than its parameter, or `lag_seconds` is given for a task
            without a `control_period`.

    Example:
        >>> varied = envs.Randomisation(parameters={"stride": {"uniform": (0.1, 0.3)}})
        >>> env = envs.Randomised(envs.make("trivial"), varied)
        >>> params = env.default_params()
        >>> observation, start = env.reset(jax.random.key(0), params)
        >>> drawn = env.task_params(start, params)
        >>> 0.1 <= float(drawn.stride) < 0.3, drawn.edge
        (True, 2.0)
    """

    env: Environment
    """The wrapped environment."""
    randomisation: Randomisation
    """Distributions and faults."""

    def __post_init__(self) -> None:
        """Checks names and shapes against the task."""
        if hasattr(getattr(self.env, "unwrapped", self.env), "randomisation"):
            raise ValueError(f"{self.env.name} is randomised already")
        leaves = by_path(self.env.default_params())
        drawn = set()
        for key, rule in self.randomisation.parameters.items():
            for path in key.split(", "):
                _check_parameter(path, rule, leaves)
                if path in drawn:
                    raise ValueError(f"{path!r} has two distributions")
                drawn.add(path)
        if any(self.randomisation.lag_seconds) and not hasattr(
            self.env, "control_period"
        ):
            raise ValueError(
                f"{self.env.name} has no control_period [s]: give lag [control steps] "
                "instead of lag_seconds"
            )
        for name, steps in (
            ("delay", self.randomisation.delay[1]),
            ("past_actions", self._memory),
        ):
            if steps > self.env.episode_length:
                raise ValueError(
                    f"{name} must be at most {self.env.episode_length} control steps, "
                    f"the length of an episode, got {steps:g}"
                )
        self._groups("noise")
        self._groups("dropout")

    def __getattr__(self, name: str) -> Any:
        """Optional attributes of the task that a wrapper does not change."""
        if name in _FORWARDED:
            return getattr(self.env, name)
        raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")

    @property
    def unwrapped(self) -> Environment:
        """This environment: the innermost one that has these states and parameters."""
        return self

    @property
    def observation_size(self) -> int:
        """Length of the observation vector, flags and past actions included."""
        past = len(self.randomisation.past_actions) * self.action_size
        return self.env.observation_size + self._n_flags + past

    @property
    def observation_channels(self) -> tuple[Channel, ...]:
        """Channels of the task, of the flags, and of past actions."""
        channels: Any = self.env
        seen = Channel(self._n_flags, "seen (1) or held (0), key by key", "1")
        past = [
            Channel(self.action_size, f"action {step} control steps ago", "1")
            for step in self.randomisation.past_actions
        ]
        flags = [seen] if self._n_flags else []
        return (*channels.observation_channels, *flags, *past)

    @property
    def _n_flags(self) -> int:
        return len(self._groups("dropout")[0]) if self.randomisation.flags else 0

    @property
    def _memory(self) -> int:
        """Number of past actions that are remembered for the observation."""
        return max(self.randomisation.past_actions, default=0)

    def default_params(self) -> RandomisedParams:
        """Default parameters of the task, and the numbers of the randomisation."""
        given, task = self.randomisation, self.env.default_params()
        leaves = by_path(task)
        ranges = {}
        for key, rule in given.parameters.items():
            dtype = jnp.result_type(leaves[key.split(", ")[0]])
            low, high = np.broadcast_arrays(*rule[kind_of(rule)])
            ranges[key] = jnp.asarray(np.stack([low, high]), dtype)
        lag = given.lag
        if any(given.lag_seconds):
            # Optional: `Environment` does not declare it. Checked when this was made.
            period = getattr(self.env, "control_period")  # noqa: B009
            lag = [seconds / period for seconds in given.lag_seconds]
        usual = Randomisation()
        actuator = {
            name: jnp.asarray(value, float)
            for name, value in (given.record() | {"lag": lag}).items()
            if name in ("delay", "lag", "rate", "saturation")
            and value != getattr(usual, name)
        }
        groups, levels = self._groups("noise")
        noise = np.sum(np.asarray(levels)[:, None] * groups, axis=0) if levels else None
        chances = self._groups("dropout")[1]
        mixing = given.correlation and _root(np.asarray(given.correlation["matrix"]))
        return RandomisedParams(
            task=task,
            ranges=ranges,
            mixing=jnp.asarray(mixing, float) if given.correlation else None,
            actuator=actuator,
            noise=None if noise is None else jnp.asarray(noise, float),
            dropout=jnp.asarray(chances, float) if chances else None,
            share=jnp.ones(()) if given.widening else None,
        )

    def reset(
        self, key: Key[Array, ""], params: RandomisedParams
    ) -> tuple[Float[Array, " observation"], RandomisedState]:
        """Draws the parameters and the actuators of an episode, and starts it."""
        check_key(key)
        own = jax.random.fold_in(key, _OWN)
        drawn, share = self._draw(jax.random.fold_in(own, 0), params), params.share
        observation, task = self.env.reset(key, self._with(drawn, params.task, share))
        actuator = {}
        uniform = jax.random.uniform(jax.random.fold_in(own, 1), (4,))
        for number, (name, (low, high)) in enumerate(sorted(params.actuator.items())):
            wide = high + 1 - low if name == "delay" else high - low
            actuator[name] = low + wide * uniform[number].astype(low.dtype)
        longest = self.randomisation.delay[1]
        if "delay" in actuator:
            # Rounding may have reached the end of the range.
            most = jnp.minimum(params.actuator["delay"][1], longest)
            actuator["delay"] = jnp.minimum(jnp.floor(actuator["delay"]), most)
        if share is not None:
            actuator = {k: _part(share, v, _FAULTLESS[k]) for k, v in actuator.items()}
        if "delay" in actuator:
            actuator["delay"] = jnp.floor(actuator["delay"])
        rest = jnp.zeros(self.action_size)
        clean = observation
        seen, observation = self._sensed(own, clean, params, None, share)
        chosen = jnp.zeros((self._memory, self.action_size), clean.dtype)
        state = RandomisedState(
            task=task,
            drawn=drawn,
            actuator=actuator,
            pending=jnp.zeros((longest, self.action_size))
            if "delay" in actuator
            else None,
            position=rest if {"lag", "rate"} & set(actuator) else None,
            seen=seen,
            clean=clean,
            share=share,
            chosen=chosen if self._memory else None,
        )
        return self._with_past_actions(observation, state), state

    def step(
        self,
        key: Key[Array, ""],
        state: RandomisedState,
        action: Float[Array, " action"],
        params: RandomisedParams,
    ) -> Step:
        """Advances one control step with the drawn parameters and actuators."""
        own = jax.random.fold_in(key, _OWN)
        command, state = self._actuated(state, action)
        clean, task, reward, terminated, truncated, info = self.env.step(
            key, state.task, command, self.task_params(state, params)
        )
        seen, observation = self._sensed(own, clean, params, state.seen, state.share)
        state = dataclasses.replace(state, task=task, seen=seen, clean=clean)
        told = self._with_past_actions(observation, state)
        return told, state, reward, terminated, truncated, info

    def task_params(self, state: RandomisedState, params: RandomisedParams) -> Any:
        """Parameters of the task in the running episode: the nominal and the drawn."""
        return self._with(state.drawn, params.task, state.share)

    def privileged_observation(
        self, state: RandomisedState, params: RandomisedParams
    ) -> Float[Array, " privileged"]:
        """Returns what sensors do not show, see `jaxrod.envs.Privileged`.

        It is the observation without noise and drop-out, all drawn values, the actions
        that are still on their way, and the share of the randomisation if it widens.
        """
        del params
        hidden = (
            state.drawn, state.actuator, state.pending, state.position, state.share
        )  # fmt: skip
        return jnp.concatenate(
            [
                jnp.ravel(leaf).astype(state.clean.dtype)
                for leaf in jax.tree.leaves((state.clean, hidden))
            ]
        )

    @property
    def snapshot(self) -> Callable[[RandomisedState, RandomisedParams], Snapshot]:
        """`snapshot` of the task, if it can be drawn."""
        seen = self._of_task("snapshot")
        return lambda state, params: seen(state.task, self.task_params(state, params))

    @property
    def cost(self) -> Callable[..., Array]:
        """`cost` of the task, if it is plannable."""
        return self._judged("cost")

    @property
    def residuals(self) -> Callable[..., Array]:
        """`residuals` of the task, if it has them."""
        return self._judged("residuals")

    @property
    def predict(self) -> Callable[..., RandomisedState]:
        """`predict` of the task, with the drawn parameters and actuators."""
        task = self._of_task("predict")

        def predict(
            state: RandomisedState,
            action: Array,
            params: RandomisedParams,
            control_steps: int = 1,
        ) -> RandomisedState:
            def again(state: RandomisedState, _: None) -> tuple[RandomisedState, None]:
                command, moved = self._actuated(state, action)
                after = task(state.task, command, self.task_params(state, params))
                return dataclasses.replace(moved, task=after), None

            return jax.lax.scan(again, state, length=control_steps)[0]

        return predict

    def _of_task(self, name: str) -> Callable[..., Any]:
        method: Callable[..., Any] = getattr(self.env, name)
        return method

    def _judged(self, name: str) -> Callable[..., Array]:
        method = self._of_task(name)

        def judged(
            state: RandomisedState,
            action: Array,
            params: RandomisedParams,
            *more: Any,
            **options: Any,
        ) -> Array:
            task = self.task_params(state, params)
            judgement: Array = method(state.task, action, task, *more, **options)
            return judgement

        return judged

    def _draw(self, key: Key[Array, ""], params: RandomisedParams) -> dict[str, Array]:
        """Draws a value of every distribution."""
        rules, sources = self.randomisation.parameters, {}
        for number, (name, rule) in enumerate(rules.items()):
            numbers = params.ranges[name]
            uniform = "uniform" in kind_of(rule)
            draw = jax.random.uniform if uniform else jax.random.normal
            sources[name] = draw(
                jax.random.fold_in(key, number), numbers.shape[1:], numbers.dtype
            )
        if params.mixing is not None:
            names = self.randomisation.correlation["names"]
            independent = jnp.stack([sources[name].astype(float) for name in names])
            for name, row in zip(names, params.mixing, strict=True):
                sources[name] = jnp.sum(row * independent).astype(sources[name].dtype)
        return {
            name: _DISTRIBUTIONS[kind_of(rule)](sources[name], *params.ranges[name])
            for name, rule in rules.items()
        }

    def _with(self, drawn: Mapping[str, Array], task: Any, share: Array | None) -> Any:
        """Parameters of the task, with the drawn ones scaled or replaced.

        With a `share`, they are that part of the way from the nominal ones.
        """
        rules = {
            path: (rule.get("scaled", False), drawn[key])
            for key, rule in self.randomisation.parameters.items()
            for path in key.split(", ")
        }

        def chosen(path: Any, leaf: Any) -> Any:
            scaled, value = rules.get(dotted(path), (None, None))
            if value is None:
                return leaf
            wide = jnp.broadcast_to(value, jnp.shape(leaf))
            wide = leaf * wide if scaled else wide
            wide = wide if share is None else _part(share, wide, leaf)
            return wide.astype(jnp.result_type(leaf))

        return jax.tree_util.tree_map_with_path(chosen, task)

    def _actuated(
        self, state: RandomisedState, action: Array
    ) -> tuple[Array, RandomisedState]:
        """Action that reaches the task, and the state with the actuators moved."""
        given = action_of_size(action, self.action_size)
        drawn, command = state.actuator, given
        pending, position, past = state.pending, state.position, state.chosen
        if past is not None:
            newest = jnp.clip(given, -1, 1).astype(past.dtype)
            past = jnp.concatenate([newest[None], past[:-1]])
        if pending is not None:
            recent = jnp.concatenate([command.astype(pending.dtype)[None], pending])
            # A comparison, because a read at a traced index can crash XLA on CPUs.
            chosen = jnp.arange(len(recent)) == drawn["delay"]
            command = jnp.sum(jnp.where(chosen[:, None], recent, 0), axis=0)
            pending = recent[:-1]
        if "saturation" in drawn:
            command = jnp.clip(command, -drawn["saturation"], drawn["saturation"])
        if position is not None:
            command = command.astype(position.dtype)
            if "lag" in drawn:
                lags = drawn["lag"] > _SHORTEST_LAG
                kept = jnp.exp(-1 / jnp.where(lags, drawn["lag"], 1))
                command = command + jnp.where(lags, kept, 0) * (position - command)
            if "rate" in drawn:
                rate = drawn["rate"]
                command = jnp.clip(command, position - rate, position + rate)
            position = command
        # The task computes in the type of the given action, as without the wrapper.
        command = command.astype(given.dtype)
        return command, dataclasses.replace(
            state, pending=pending, position=position, chosen=past
        )

    def _with_past_actions(self, observation: Array, state: RandomisedState) -> Array:
        """Observation with the past actions that belong to it."""
        if state.chosen is None:
            return observation
        past = [state.chosen[step - 1] for step in self.randomisation.past_actions]
        return jnp.concatenate([observation, *past])

    def _sensed(
        self,
        own: Key[Array, ""],
        observation: Array,
        params: RandomisedParams,
        last: Array | None,
        share: Array | None,
    ) -> tuple[Array | None, Array]:
        """Last seen entries, and the observation with noise, drop-out and flags.

        Args:
            own: Random key of the wrapper.
            observation: Observation of the task.
            params: Parameters.
            last: Last seen entries; None at the start, when everything is seen.
            share: Factor of noise and of probabilities of drop-out; None for 1.
        """
        dtype, part = observation.dtype, 1 if share is None else share
        if params.noise is not None:
            key = jax.random.fold_in(own, 2)
            drawn = jax.random.normal(key, observation.shape, dtype)
            observation = observation + (part * params.noise).astype(dtype) * drawn
        if params.dropout is None:
            return None, observation
        groups = self._groups("dropout")[0]
        chances = jax.random.uniform(jax.random.fold_in(own, 3), params.dropout.shape)
        lost = (chances < part * params.dropout) & (last is not None)
        if last is not None:
            held = jnp.any(jnp.asarray(groups) & lost[:, None], axis=0)
            observation = jnp.where(held, last, observation)
        if not self.randomisation.flags:
            return observation, observation
        flags = (~lost).astype(dtype)
        return observation, jnp.concatenate([observation, flags])

    def _groups(self, option: str) -> tuple[np.ndarray, list[float]]:
        """Mask of the entries of every key of `noise` or `dropout`, and their numbers.

        Raises:
            ValueError: There is no such channel or entry.
        """
        given = getattr(self.randomisation, option)
        size = self.env.observation_size
        if not isinstance(given, dict):
            return np.eye(size, dtype=bool), [given] * size if given else []
        channels = getattr(self.env, "observation_channels", ())
        masks = [_entries(option, key, size, channels) for key in given]
        if not masks:
            return np.zeros((0, size), bool), []
        if np.any(np.sum(masks, axis=0) > 1):
            twice = int(np.argmax(np.sum(masks, axis=0)))
            raise ValueError(f"{option} names entry {twice} of the observation twice")
        return np.stack(masks), list(given.values())


def _part(share: Array, value: Array, nominal: Any) -> Array:
    """Value that is `share` of the way from `nominal` to `value`; exact at 0 and 1."""
    return share * value + (1 - share) * nominal


def _root(matrix: np.ndarray) -> np.ndarray:
    """Symmetric square root of a correlation matrix."""
    values, vectors = np.linalg.eigh(matrix)
    root: np.ndarray = (vectors * np.sqrt(np.maximum(values, 0))) @ vectors.T
    return root


def _check_parameter(
    path: str, rule: Mapping[str, Any], leaves: Mapping[str, Any]
) -> None:
    """Raises unless a task has a parameter of floats that fits a distribution."""
    if path not in leaves:
        raise ValueError(
            f"there is no parameter {path!r}; the nearest are {nearest(path, leaves)}"
        )
    leaf = leaves[path]
    if not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
        raise ValueError(f"{path} must be a parameter of floats to be drawn")
    given = np.broadcast_shapes(*(np.shape(number) for number in rule[kind_of(rule)]))
    try:
        fits = np.broadcast_shapes(given, np.shape(leaf)) == np.shape(leaf)
    except ValueError:
        fits = False
    if not fits:
        raise ValueError(
            f"the distribution of {path!r} has numbers of shape {given}, the parameter "
            f"has {np.shape(leaf)}"
        )


def _entries(
    option: str, key: str, size: int, channels: Sequence[Channel]
) -> np.ndarray:
    """Mask `(size,)` of the observation's entries that `key` names.

    A key is the name of a channel, a prefix of only one channel's name, or indices
    such as "0, 4-7". `option` is the option that contains the key, such as "noise", and
    is used only in error messages.

    Raises:
        ValueError: If no channel or several channels match, or an index is out of
            range.
    """
    mask = np.zeros(size, bool)
    if re.fullmatch(r"\s*\d+(\s*-\s*\d+)?(\s*,\s*\d+(\s*-\s*\d+)?)*\s*", key):
        for part in key.split(","):
            first, _, last = part.partition("-")
            begin, end = int(first), int(last or first)
            if not begin <= end < size:
                raise ValueError(
                    f"{option} names the entries {part.strip()}, but an observation "
                    f"has entries from 0 to {size - 1}"
                )
            mask[begin : end + 1] = True
        return mask
    ends = np.cumsum([0, *(channel.size for channel in channels)])
    names = [channel.name for channel in channels]
    found = [k for k, name in enumerate(names) if name == key]
    found = found or [k for k, name in enumerate(names) if name.startswith(key)]
    if len(found) != 1:
        fault = "begins the names of several" if found else "is not one"
        raise ValueError(
            f"{option} names the channel {key!r}, which {fault}: there are "
            f"{', '.join(map(repr, names)) or 'none'}"
        )
    mask[ends[found[0]] : ends[found[0] + 1]] = True
    return mask

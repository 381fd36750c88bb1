"""Trained policies: pure functions from observations to actions, and their files.

A policy is a pytree. It is stored as two files without pickle, policy.json and
policy.npz. A multilayer perceptron (format 1) can be read by any program: the files
hold its layers, activation and normalisation. Any other policy (format 2) is stored as
arrays under their paths in the pytree. To read it, the code that trained it must make a
policy of the same structure, see `load_policy`.
"""

from __future__ import annotations

import dataclasses
import io
import json
import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from jaxrod.envs import held_for, remembering
from jaxrod.files import (
    OBJECT,
    check_entries,
    one_of,
    read_json,
    reading,
    whole,
    write_atomically,
)
from jaxrod.structure import pytree, static
from jaxrod.training.leaves import (
    differences_of_leaves,
    named_leaves,
    to_array,
    with_leaves,
)
from jaxrod.training.normalisation import RunningMoments, normalise
from jaxrod.validation import check_seed

ACTIVATIONS = {
    "tanh": jnp.tanh,
    "relu": lambda x: jnp.maximum(x, 0),
    "elu": lambda x: jnp.where(x > 0, x, jnp.expm1(jnp.minimum(x, 0))),
}
"""Activation functions of the hidden layers by name, in plain JAX."""
OUTPUTS = {"clip": lambda x: jnp.clip(x, -1, 1), "tanh": jnp.tanh}
"""Functions that bound actions to [-1, 1], by name."""
MEDIAN, MEAN = QUIET_ACTIONS = ("median", "mean")
"""Names of the actions without noise, see `OnPolicyConfig.quiet_action`."""
_NODES = np.linspace(-5, 5, 41)
"""Nodes of the trapezoidal rule for the mean over a standard normal number."""
_WEIGHTS = np.exp(-0.5 * _NODES**2) / np.sum(np.exp(-0.5 * _NODES**2))


def _mean_of_clip(
    mean: Float[Array, "*batch action"], std: Float[Array, "*batch action"]
) -> Float[Array, "*batch action"]:
    """Mean of clip(u, -1, 1) for a normal u, in closed form.

    clip(u, -1, 1) = max(u + 1, 0) - max(u - 1, 0) - 1, and the mean of max(x, 0) is
    m P(m/s) + s p(m/s), where P is the normal distribution and p its density.
    """
    safe = jnp.where(std > 0, std, 1)
    # Farther out the result is the bound, but the difference below would lose it.
    edge = 1 + 10 * std
    mean = jnp.minimum(jnp.maximum(mean, -edge), edge)

    def positive_part(mean: Array) -> Array:
        z = mean / safe
        density = jnp.exp(-0.5 * z * z) / math.sqrt(2 * math.pi)
        below = 0.5 * (1 + jax.lax.erf(z / math.sqrt(2)))
        return jnp.where(std > 0, mean * below + safe * density, jnp.maximum(mean, 0))

    return positive_part(mean + 1) - positive_part(mean - 1) - 1


def _mean_of_tanh(
    mean: Float[Array, "*batch action"], std: Float[Array, "*batch action"]
) -> Float[Array, "*batch action"]:
    """Mean of tanh(u) for a normal u, by the trapezoidal rule.

    The error is below 1e-5 for standard deviations of at most 3.
    """
    across = (len(_NODES),) + mean.ndim * (1,)
    nodes = jnp.asarray(_NODES, mean.dtype).reshape(across)
    weights = jnp.asarray(_WEIGHTS, mean.dtype).reshape(across)
    return jnp.sum(weights * jnp.tanh(mean[None] + nodes * std[None]), axis=0)


_MEANS = {"clip": _mean_of_clip, "tanh": _mean_of_tanh}
"""Functions (mean, std) -> mean of the bounded action, by the name of the bound."""


def check_quiet_action(name: str) -> None:
    """Raises ValueError unless there is a quiet action of this name."""
    if name not in QUIET_ACTIONS:
        raise ValueError(
            f"quiet_action must be one of {', '.join(map(repr, QUIET_ACTIONS))}, "
            f"got {name!r}"
        )


def bounded(
    policy: Any,
    action: Float[Array, "*batch action"],
    noise: Float[Array, "*batch action"] | None,
) -> Float[Array, "*batch action"]:
    """The action of a policy, bounded to [-1, 1].

    Args:
        policy: Policy with the fields `output`, `action_std` and `quiet_action`.
        action: Output of its network: the mean of the action before it is bounded.
        noise: Noise to add before the action is bounded; None for the action without
            noise.

    Raises:
        ValueError: The policy's `quiet_action` does not exist.
    """
    check_quiet_action(policy.quiet_action)
    if noise is not None:
        return OUTPUTS[policy.output](action + noise)
    if policy.quiet_action == MEDIAN or policy.action_std is None:
        return OUTPUTS[policy.output](action)
    std = jnp.broadcast_to(policy.action_std, action.shape).astype(action.dtype)
    return jnp.clip(_MEANS[policy.output](action, std), -1, 1)  # round-off


class Policy(Protocol):
    """Deterministic policy: observation -> action in [-1, 1].

    A callable pytree of plain arrays, made by an `Algorithm`. If it has an attribute
    `action_repeat`, evaluations and replays hold its actions for that number of control
    steps.

    Example:
        >>> env = envs.make("trivial")
        >>> policy = training.untrained_policy(env, seed=0)
        >>> policy(jnp.zeros((5, 1))).shape  # five observations at once
        (5, 1)
    """

    def __call__(
        self, observation: Float[Array, "*batch observation"]
    ) -> Float[Array, "*batch action"]:
        """Returns the action for one observation, or for a batch of them."""


@pytree
class MLPPolicy:
    """Deterministic policy: a multilayer perceptron on normalised observations.

    It needs no network library.

    Example:
        >>> policy = training.untrained_policy(envs.make("tracking"))
        >>> [kernel.shape for kernel, bias in policy.layers]
        [(44, 64), (64, 64), (64, 12)]
    """

    moments: RunningMoments
    """Mean and variance for normalising observations."""
    limit: Float[Array, ""]
    """Bound to which normalised observations are clipped, either way."""
    layers: tuple[tuple[Array, Array], ...]
    """Pairs (kernel, bias) of the layers, kernels of shape (inputs, outputs)."""
    activation: str = static(default="tanh")
    """Activation function between the layers, a name in `ACTIVATIONS`."""
    output: str = static(default="clip")
    """Function that bounds actions to [-1, 1], a name in `OUTPUTS`."""
    action_repeat: int = static(default=1)
    """Control steps for which an action is held, as in training."""
    action_std: Float[Array, " action"] | None = None
    """Standard deviation of the noise in training, which the policy itself lacks, see
    `with_noise`; None if the learner's noise was of another kind."""
    quiet_action: str = static(default=MEDIAN)
    """Action without noise, "median" or "mean", see `OnPolicyConfig.quiet_action`."""

    def __call__(
        self,
        observation: Float[Array, "*batch observation"],
        noise: Float[Array, "*batch action"] | None = None,
    ) -> Float[Array, "*batch action"]:
        """Returns the action for one observation, or for a batch of them.

        `noise` is added before the action is bounded.

        Example:
            >>> sizes = training.untrained_policy(envs.make("trivial"))
            >>> policy = jax.tree.map(lambda leaf: jnp.ones(leaf.shape), sizes)
            >>> policy(jnp.zeros((5, 1))).shape
            (5, 1)
        """
        hidden = normalise(self.moments, observation, self.limit)
        for i, (kernel, bias) in enumerate(self.layers):
            if i > 0:
                hidden = ACTIVATIONS[self.activation](hidden)
            bias = jnp.expand_dims(bias, tuple(range(hidden.ndim - 1)))
            hidden = hidden @ kernel + bias
        return bounded(self, hidden, noise)


@pytree
class NoisyPolicy:
    """Policy that acts with the noise of its training: a `jaxrod.envs.MemoryPolicy`.

    Its memory is that of the policy, and the random keys of the episodes.

    Example:
        >>> quiet = training.untrained_policy(envs.make("trivial"))
        >>> quiet = jax.tree.map(lambda leaf: jnp.ones(leaf.shape), quiet)
        >>> noisy = training.with_noise(quiet, seed=1)
        >>> seen = jnp.zeros((2, 1))
        >>> action, memory = noisy.act(noisy.init(seen, None), seen, None)
        >>> action.shape
        (2, 1)
    """

    policy: Any
    """The policy without noise."""
    key: Key[Array, ""]
    """Random key, from which each episode of a batch gets its own."""

    @property
    def action_repeat(self) -> int:
        """Control steps for which an action is held."""
        return held_for(self.policy)

    def init(self, observation: Float[Array, "batch observation"], state: Any) -> Any:
        """Initial memory of the policy, and a random key for each episode."""
        keys = jax.random.split(self.key, len(observation))
        return remembering(self.policy).init(observation, state), keys

    def act(
        self, memory: Any, observation: Float[Array, "batch observation"], state: Any
    ) -> tuple[Float[Array, "batch action"], Any]:
        """Returns the noisy actions, and the memory with the next keys."""
        remembered, keys = memory
        std = self.policy.action_std
        now, keys = jnp.swapaxes(jax.vmap(jax.random.split)(keys), 0, 1)
        draw = jax.vmap(lambda key: jax.random.normal(key, std.shape, std.dtype))
        noise = std[None] * draw(now)
        has_memory = remembering(self.policy) is self.policy
        if has_memory:
            action, remembered = self.policy.act(remembered, observation, state, noise)
        else:
            action = self.policy(observation, noise)
        return action, (remembered, keys)


def with_noise(policy: Any, seed: int = 0) -> NoisyPolicy:
    """Returns the policy as it acted at the end of its training, with noise.

    Every decision adds Gaussian noise of standard deviation `policy.action_std` before
    the action is bounded.

    Args:
        policy: Policy of PPO, TRPO or SHAC.
        seed: Seed of the noise.

    Raises:
        ValueError: The policy has no `action_std`.

    Example:
        >>> env = envs.make("trivial")
        >>> config = training.PPOConfig(num_envs=16, rollout_steps=16)
        >>> result = training.train(env, steps=16000, config=config, progress=False)
        >>> noisy = training.with_noise(result.policy)
        >>> training.evaluate(env, noisy).mean < result.evaluation.mean
        True
    """
    if getattr(policy, "action_std", None) is None:
        raise ValueError(
            "policy must have an action_std, as those of ppo, trpo and shac have, "
            f"got a {type(policy).__name__} without one"
        )
    return NoisyPolicy(policy, jax.random.key(check_seed(seed)))


PERCEPTRON, PYTREE = 1, 2
"""Format numbers in policy.json: a multilayer perceptron, and any other pytree."""

_ROOT = "policy"
_NOISE = "action_std"
_MAY_LACK = {
    "action_repeat": whole(1, 2**31 - 1),
    "quiet_action": one_of(*QUIET_ACTIONS),
    "about": OBJECT,
}


def save_policy(
    policy: Any, folder: str | Path, about: Mapping[str, Any] | None = None
) -> None:
    """Writes a policy as `policy.json` (description) and `policy.npz` (arrays).

    Args:
        policy: An `MLPPolicy`, or any other pytree of arrays.
        folder: Folder of the files; created if missing.
        about: Further facts for the JSON file, such as the task.

    Example:
        >>> from pathlib import Path
        >>> sizes = training.untrained_policy(envs.make("trivial"))
        >>> policy = jax.tree.map(lambda leaf: jnp.ones(leaf.shape), sizes)
        >>> training.save_policy(policy, "policy", about={"task": "trivial"})
        >>> sorted(file.name for file in Path("policy").iterdir())
        ['policy.json', 'policy.npz']
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    if isinstance(policy, MLPPolicy):
        description, arrays = _perceptron(policy)
    else:
        description, arrays = _pytree(policy)
    description |= {
        "action_repeat": held_for(policy),
        "quiet_action": getattr(policy, "quiet_action", MEDIAN),
        "about": dict(about or {}),
    }
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    write_atomically(folder / "policy.npz", buffer.getvalue())
    text = json.dumps(description, indent=2) + "\n"
    write_atomically(folder / "policy.json", text.encode())


def load_policy(folder: str | Path, like: Any = None) -> Any:
    """Reads a policy written by `save_policy`.

    Args:
        folder: Folder of the policy.
        like: A policy of the same structure, whose numbers do not matter; see
            `jaxrod.training.untrained_policy`. Only needed for policies other than
            `MLPPolicy`. `jaxrod.training.restore_policy` makes it from a run.

    Returns:
        An `MLPPolicy`, or a policy with the structure of `like`.

    Raises:
        ValueError: The folder holds no policy, or one of another format or structure;
            or a file is damaged or holds something that cannot be a policy. The message
            names the file.

    Example:
        >>> sizes = training.untrained_policy(envs.make("trivial"))
        >>> policy = jax.tree.map(lambda leaf: jnp.ones(leaf.shape), sizes)
        >>> training.save_policy(policy, "policy")
        >>> again = training.load_policy("policy")
        >>> bool((again(jnp.ones(1)) == policy(jnp.ones(1))).all())
        True
    """
    folder = Path(folder)
    texts, numbers = folder / "policy.json", folder / "policy.npz"
    for file in (texts, numbers):
        if not file.is_file():
            raise ValueError(
                f"{folder} must hold policy.json and policy.npz, but lacks {file.name}"
            )
    description = read_json(texts)
    with reading(texts):
        _check_description(description)
    perceptron = description["format"] == PERCEPTRON
    if not perceptron and like is None:
        raise ValueError(
            f"{folder} holds a policy that is not a multilayer perceptron: read it "
            "with like=, a policy of the same structure, or with "
            "jaxrod.training.restore_policy"
        )
    with reading(numbers):
        if not zipfile.is_zipfile(numbers):
            raise ValueError("it is torn")
        with np.load(numbers, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        if perceptron:
            _check_numbers(arrays, description)
    # Policies from before this entry existed acted with the median.
    quiet_action = description.get("quiet_action", MEDIAN)
    if not perceptron:
        policy = _put_into(like, numbers, arrays)
        if getattr(policy, "quiet_action", quiet_action) == quiet_action:
            return policy
        return dataclasses.replace(policy, quiet_action=quiet_action)
    found = {name: jnp.asarray(array) for name, array in arrays.items()}
    return MLPPolicy(
        moments=RunningMoments(
            found["observation_count"],
            found["observation_mean"],
            found["observation_variance"],
        ),
        limit=found["observation_limit"],
        layers=tuple(
            (found[f"kernel_{i}"], found[f"bias_{i}"])
            for i in range(description["layers"])
        ),
        activation=description["activation"],
        output=description["output"],
        # Policies from before this entry existed decided at every control step.
        action_repeat=description.get("action_repeat", 1),
        action_std=found.get(_NOISE),
        quiet_action=quiet_action,
    )


def needs_structure(folder: str | Path) -> bool:
    """Whether `load_policy` needs its argument `like` for the policy in a folder."""
    file = Path(folder) / "policy.json"
    return file.is_file() and read_json(file).get("format") == PYTREE


def _perceptron(policy: MLPPolicy) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Entries of policy.json and arrays of policy.npz for a multilayer perceptron."""
    arrays = {
        "observation_count": policy.moments.count,
        "observation_mean": policy.moments.mean,
        "observation_variance": policy.moments.variance,
        "observation_limit": policy.limit,
    }
    for i, (kernel, bias) in enumerate(policy.layers):
        arrays |= {f"kernel_{i}": kernel, f"bias_{i}": bias}
    if policy.action_std is not None:
        arrays[_NOISE] = policy.action_std
    description = {
        "format": PERCEPTRON,
        "activation": policy.activation,
        "output": policy.output,
        "layers": len(policy.layers),
        "observation_size": int(policy.layers[0][0].shape[0]),
        "action_size": int(policy.layers[-1][1].shape[0]),
    }
    return description, {name: np.asarray(array) for name, array in arrays.items()}


def _pytree(policy: Any) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Entries of policy.json and arrays of policy.npz for a policy of any structure."""
    leaves = named_leaves(jax.tree.map(jnp.asarray, policy), _ROOT)
    kinds = {name: str(leaf.dtype) for name, leaf in leaves.items()}
    arrays = {name: to_array(leaf) for name, leaf in leaves.items()}
    return {"format": PYTREE, "leaves": kinds}, arrays


def _put_into(like: Any, file: Path, arrays: dict[str, np.ndarray]) -> Any:
    """A policy with the structure of `like` and the arrays of a policy.npz.

    The arrays may have another floating-point precision than the leaves of `like`,
    because a policy may be evaluated in another precision than it was trained in.

    Args:
        like: Policy that gives the names, kinds and shapes of the leaves.
        file: File that held the arrays, for messages.
        arrays: Arrays by name of the leaf.

    Raises:
        ValueError: The names, kinds or shapes differ, or a number is NaN.
    """
    if f"{_ROOT}.{_NOISE}" not in arrays and getattr(like, _NOISE, None) is not None:
        # Policies from before this entry existed.
        like = dataclasses.replace(like, **{_NOISE: None})
    leaves = named_leaves(like, _ROOT)
    for name in leaves.keys() & arrays.keys():
        dtype = np.dtype(leaves[name].dtype)
        if dtype.kind == "V" and arrays[name].dtype == f"u{dtype.itemsize}":
            arrays[name] = arrays[name].view(dtype)
    apart = differences_of_leaves(
        {name: _kind(leaf) for name, leaf in leaves.items()},
        {name: _kind(array) for name, array in arrays.items()},
    )
    if apart:
        raise ValueError(
            f"{file} does not fit the algorithm and the settings of this run: it "
            f"{apart}"
        )
    with reading(file):
        for name, array in arrays.items():
            if np.isnan(array).any():
                raise ValueError(f"{name!r} holds a value that is not a number")
    # Leaves without elements hold nothing and are not stored.
    empty = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), like)
    found = {name: jnp.asarray(array) for name, array in arrays.items()}
    return with_leaves(empty, _ROOT, found)


def _kind(array: Any) -> str:
    """Kind and shape of an array without its precision, such as "float[3]"."""
    return f"{np.dtype(array.dtype).name.rstrip('0123456789')}{list(array.shape)}"


def _check_description(description: dict[str, Any]) -> None:
    """Raises ValueError unless the entries of policy.json describe a policy."""
    if description.get("format") == PYTREE:
        check_entries(description, {"leaves": OBJECT}, _MAY_LACK)
        return
    if description.get("format") != PERCEPTRON:
        raise ValueError(
            f"it is of format {description.get('format')!r}, but this version reads "
            f"formats {PERCEPTRON} and {PYTREE}"
        )
    check_entries(
        description,
        {
            "activation": one_of(*ACTIVATIONS),
            "output": one_of(*OUTPUTS),
            "layers": whole(1, 1000),
            "observation_size": whole(1),
            "action_size": whole(1),
        },
        _MAY_LACK,
    )


def _check_numbers(
    arrays: dict[str, np.ndarray], description: Mapping[str, Any]
) -> None:
    """Raises ValueError unless all arrays are finite and fit policy.json."""
    layers = range(description["layers"])
    names = {f"{part}_{i}" for i in layers for part in ("kernel", "bias")}
    names |= {f"observation_{part}" for part in ("count", "mean", "variance", "limit")}
    for name in sorted(names ^ (arrays.keys() - {_NOISE})):
        if name in names:
            raise ValueError(f"it lacks {name!r}, which follows from policy.json")
        raise ValueError(f"it has {name!r}, which does not follow from policy.json")
    sizes = [description["observation_size"]]
    sizes += [arrays[f"bias_{i}"].size for i in layers[:-1]]
    sizes += [description["action_size"]]
    shapes: dict[str, tuple[int, ...]] = {
        "observation_count": (),
        "observation_limit": (),
        "observation_mean": (sizes[0],),
        "observation_variance": (sizes[0],),
    }
    for i in layers:
        shapes |= {
            f"kernel_{i}": (sizes[i], sizes[i + 1]),
            f"bias_{i}": (sizes[i + 1],),
        }
    if _NOISE in arrays:
        shapes[_NOISE] = (sizes[-1],)
    for name, shape in shapes.items():
        array = arrays[name]
        if array.shape != shape:
            raise ValueError(
                f"{name!r} has the shape {array.shape}, not {shape}, which follows "
                "from policy.json"
            )
        if array.dtype.kind != "f" or not np.isfinite(array).all():
            raise ValueError(f"{name!r} must hold finite numbers")
    for name in ("observation_count", "observation_variance", _NOISE):
        if name in arrays and (arrays[name] < 0).any():
            raise ValueError(f"{name!r} must not be negative")
    if arrays["observation_limit"] <= 0:
        raise ValueError("'observation_limit' must be positive")

"""Checks that a user's algorithm keeps the contract stated in `Algorithm`."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec

from jaxrod.envs import Environment, EpisodeRecord, remembering
from jaxrod.training.algorithm import Algorithm, Metrics, find_algorithm
from jaxrod.validation import check_count


def resolve(
    algorithm: str | Algorithm, config: Any, trust: Collection[str] | None = None
) -> tuple[Algorithm, Any]:
    """Returns the algorithm of a name and its checked configuration.

    Args:
        algorithm: A name, an import path or an `Algorithm`.
        config: Configuration of the algorithm, None for its defaults.
        trust: Trusted modules if the name was read from a file, see `find_algorithm`.

    Raises:
        UntrustedError: The name was read from a file and its module is not trusted.
        ValueError: There is no such algorithm, the configuration belongs to another
            one, or either breaks the contract of `Algorithm`; the message names the
            fault.
    """
    if isinstance(algorithm, str):
        algorithm = find_algorithm(algorithm, trust)
    if not isinstance(algorithm, Algorithm):
        raise ValueError(
            "algorithm must be a name, an import path or a jaxrod.training.Algorithm, "
            f"got {algorithm!r:.80}"
        )
    name = algorithm.name
    if not isinstance(name, str) or not name:
        raise ValueError(f"an algorithm's name must be text, got {name!r}")
    for part in ("steps_per_update", "init", "update", "policy", "validate"):
        if not callable(getattr(algorithm, part)):
            raise ValueError(f"{part} of {name} must be a function")
    if algorithm.partition is not None and not callable(algorithm.partition):
        raise ValueError(f"partition of {name} must be a function or None")
    kind = algorithm.config_type
    if not isinstance(kind, type) or not dataclasses.is_dataclass(kind):
        raise ValueError(
            f"config_type of {name} must be a class made by jaxrod.extend.pytree"
        )
    config = algorithm.checked(config)
    for path, leaf in jax.tree.leaves_with_path(config):
        if leaf is config:
            raise ValueError(
                f"config_type of {name}, {kind.__name__}, must be made by "
                "jaxrod.extend.pytree"
            )
        if not isinstance(leaf, int | float | np.ndarray | np.generic | jax.Array):
            raise ValueError(
                f"{jax.tree_util.keystr(path)[1:]} of {kind.__name__} must be a "
                f"number, or declared as jaxrod.extend.static(), got {leaf!r:.80}"
            )
    return algorithm, config


def updates_of(algorithm: Algorithm, config: Any) -> int:
    """Number of control steps of one update, from `Algorithm.steps_per_update`.

    Raises:
        ValueError: The number is not an integer of at least 1.
    """
    steps = algorithm.steps_per_update(config)
    return check_count(f"steps_per_update of {algorithm.name}", steps, 1)


def check_update(algorithm: Algorithm, state: Any, after: Any) -> None:
    """Checks what `update` of an algorithm returns.

    Args:
        algorithm: The algorithm.
        state: Types of a train state.
        after: Types of what `update` returns for it.

    Raises:
        ValueError: `update` breaks the contract of `Algorithm`.
    """
    name = algorithm.name
    if not (isinstance(after, tuple) and len(after) == 2):
        raise ValueError(f"update of {name} must return (state, Metrics)")
    _check_same_form(name, state, after[0])
    _check_metrics(name, after[1])


def check_state(algorithm: Algorithm, state: Any, env: Environment) -> None:
    """Checks `policy` and `partition` of an algorithm on a train state.

    It traces `policy` and calls `partition`. `update` is checked by `check_update`
    while it is traced for the run.

    Args:
        algorithm: Algorithm that made the state.
        state: State as returned by `init`.
        env: The environment.

    Raises:
        ValueError: `policy` or `partition` breaks the contract of `Algorithm`.
    """
    name = algorithm.name
    _check_policy(name, jax.eval_shape(algorithm.policy, state), env)
    if algorithm.partition is not None:
        specs = algorithm.partition(state)
        try:
            jax.tree.map(
                lambda spec, part: None,
                specs,
                state,
                is_leaf=lambda leaf: isinstance(leaf, PartitionSpec),
            )
        except ValueError as error:
            raise ValueError(
                f"partition of {name} must return a tree prefix of the train state: "
                f"{error}"
            ) from None


def _check_same_form(name: str, before: Any, after: Any) -> None:
    """Raises ValueError unless two states agree in structure, shapes and dtypes.

    `name` is that of the algorithm, for the message.
    """
    forms = [
        {
            jax.tree_util.keystr(path): f"{leaf.dtype}{list(leaf.shape)}"
            for path, leaf in jax.tree.leaves_with_path(state)
        }
        for state in (before, after)
    ]
    for path in sorted(forms[0].keys() | forms[1].keys()):
        was, becomes = (form.get(path, "nothing") for form in forms)
        if was != becomes:
            raise ValueError(
                f"update of {name} must keep the form of the train state: state{path} "
                f"was {was} and becomes {becomes}"
            )
    structures: list[Any] = [jax.tree.structure(state) for state in (before, after)]
    if structures[0] != structures[1]:
        raise ValueError(f"update of {name} must keep the structure of the train state")


def _check_metrics(name: str, metrics: Any) -> None:
    """Raises ValueError unless `metrics` has the form that `Metrics` describes.

    `name` is that of the algorithm, for the message.
    """
    if not isinstance(metrics, Metrics):
        raise ValueError(
            f"update of {name} must return Metrics beside the state, got "
            f"{type(metrics).__name__}"
        )
    scalars = metrics.scalars
    if not isinstance(scalars, dict) or not all(
        isinstance(key, str) and getattr(value, "shape", None) == ()
        for key, value in scalars.items()
    ):
        raise ValueError(f"metrics.scalars of {name} must be single numbers by name")
    episodes = metrics.episodes
    shapes = {leaf.shape for leaf in jax.tree.leaves(episodes)}
    if (
        not isinstance(episodes, EpisodeRecord)
        or len(shapes) != 1
        or len(next(iter(shapes))) != 2
    ):
        raise ValueError(
            f"metrics.episodes of {name} must be an EpisodeRecord with arrays of shape "
            f"(steps, num_envs), as VectorEnvironment.step returns them"
        )


def _check_policy(name: str, policy: Any, env: Environment) -> None:
    """Raises ValueError unless a policy maps observations to actions, without a key.

    `name` is that of the algorithm, for the message.
    """
    has_memory = remembering(policy) is policy
    if not (callable(policy) or has_memory):
        raise ValueError(
            f"policy of {name} must return a callable, policy(observation), or a "
            f"jaxrod.envs.MemoryPolicy, got a {type(policy).__name__}"
        )
    if any(
        jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        for leaf in jax.tree.leaves(policy)
    ):
        raise ValueError(f"policy of {name} must be deterministic, it holds a key")
    size, actions = env.observation_size, env.action_size

    def first_action(policy: Any, observation: Any) -> Any:
        acting = remembering(policy)
        return acting.act(acting.init(observation, None), observation, None)[0]

    # The second batch size differs from every other dimension. A policy with memory
    # acts on batches alone.
    single: list[tuple[int, ...]] = [] if has_memory else [()]
    for leading in (*single, (size + actions + 1,)):
        observation = jax.ShapeDtypeStruct((*leading, size), jnp.result_type(float))
        demand = (
            f"policy of {name} must map observations of shape {observation.shape} to "
            f"actions of shape {(*leading, actions)}"
        )
        try:
            action = jax.eval_shape(first_action, policy, observation)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{demand}: {error}") from error
        if getattr(action, "shape", None) != (*leading, actions):
            shape = getattr(action, "shape", type(action).__name__)
            raise ValueError(f"{demand}, got {shape}")

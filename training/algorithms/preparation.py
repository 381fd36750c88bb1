"""Conversion of the numbers of a train state to definite dtypes."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, DTypeLike, Key

from jaxrod.envs import Environment


def canonicalise(
    key: Key[Array, ""], env: Environment, config: Any, env_params: Any
) -> tuple[Any, Any, Any]:
    """Converts settings and parameters to the dtype that is used for learning.

    Args:
        key: Any random key; nothing is drawn from it.
        env: The environment.
        config: Settings of a learner, their numbers floats or arrays.
        env_params: Parameters of the environment, None for its defaults.

    Returns:
        `(config, env_params, dtype)`; dtype is that of the observations.
    """
    if env_params is None:
        # Factories check the values of their numbers, which a trace would hide.
        with jax.ensure_compile_time_eval():
            env_params = env.default_params()
    dtype = jax.eval_shape(env.reset, key, env_params)[0].dtype
    env_params = strip_weak_types(env_params, dtype)
    # One dtype for all numbers, whether given as floats or as arrays.
    config = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), config)
    return config, env_params, dtype


def strip_weak_types(tree: Any, dtype: DTypeLike) -> Any:
    """Leaves with definite dtypes: a weak type could change during the run."""

    def one(leaf: Any) -> Array:
        leaf = jnp.asarray(leaf)
        if jax.typeof(leaf).weak_type:
            floating = jnp.issubdtype(leaf.dtype, jnp.floating)
            return jax.lax.convert_element_type(leaf, dtype if floating else leaf.dtype)
        return leaf

    return jax.tree.map(one, tree)

"""The tanh-Gaussian distribution of SAC's actions, in (-1, 1)."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

LOG_STD_LIMITS = (-20.0, 2.0)
"""Bounds of the logarithm of the standard deviation, as in the reference."""
LARGEST_ENTROPY = math.log(2)
"""Largest entropy of an action in [-1, 1], that of the uniform density."""


def split_output(
    output: Float[Array, "*batch outputs"],
) -> tuple[Float[Array, "*batch action"], Float[Array, "*batch action"]]:
    """Mean and bounded log standard deviation from the output of one network."""
    mean, log_std = jnp.split(output, 2, axis=-1)
    return mean, jnp.clip(log_std, *LOG_STD_LIMITS)


def tanh_gaussian(
    mean: Float[Array, "*batch action"],
    log_std: Float[Array, "*batch action"],
    noise: Float[Array, "*batch action"],
) -> tuple[Float[Array, "*batch action"], Float[Array, "*batch"]]:
    """The action a = tanh(u), u = mean + std z, and the log of its density.

    log p(a) = sum(log N(u) - log(1 - tanh(u)^2)). The last term is evaluated as 2 (log
    2 - u - softplus(-2 u)), which loses no digits where tanh is flat.

    Args:
        mean: Mean of u.
        log_std: Logarithm of the standard deviation of u.
        noise: Standard normal noise z.

    Source: Haarnoja et al., "Soft actor-critic algorithms and applications", 2018,
    appendix C.
    """
    raw = mean + jnp.exp(log_std) * noise
    normal = -0.5 * noise**2 - log_std - 0.5 * math.log(2 * math.pi)
    slope = 2 * (math.log(2) - raw - jax.nn.softplus(-2 * raw))
    return jnp.tanh(raw), jnp.sum(normal - slope, axis=-1)

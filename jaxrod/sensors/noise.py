"""Noise of sensor readings: bias, random error, quantisation, lost values."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.validation import Numbers, as_array


def noisy(
    key: Array,
    reading: Float[Array, "..."],
    *,
    deviation: Numbers = 0.0,
    bias: Numbers = 0.0,
    resolution: Numbers = 0.0,
    dropout: Numbers = 0.0,
) -> Float[Array, "..."]:
    r"""Adds noise to a reading: $r\,\mathrm{round}((y + b + s\,n)/r)$ with normal $n$.

    The noise of each number of the reading is independent. Derivatives ignore the
    rounding. `deviation`, `bias`, `resolution` and `dropout` are numbers, or arrays of
    the reading's shape.

    Args:
        key: Key of the random numbers, `jax.random.key(seed)`; a new one per reading.
        reading: The reading $y$.
        deviation: Standard deviation $s$ [unit of the reading].
        bias: Constant offset $b$ [unit of the reading].
        resolution: Step $r$ of the quantisation; zero for none [unit of the reading].
        dropout: Probability that a number is lost and becomes NaN, from 0 to 1 [1].

    Returns:
        The reading with noise, of the same shape and type.

    Raises:
        ValueError: If a number is out of range or of the wrong shape.

    Example:
        >>> reading = jnp.asarray(1.26)
        >>> float(sensors.noisy(jax.random.key(0), reading, resolution=0.5))
        1.5
    """
    value = jnp.asarray(reading)
    kind, shapes = value.dtype, [(), value.shape]
    spread = as_array("deviation", deviation, "", shapes, non_negative=True, dtype=kind)
    offset = as_array("bias", bias, "", shapes, dtype=kind)
    grain = as_array(
        "resolution", resolution, "", shapes, non_negative=True, dtype=kind
    )
    lost = as_array("dropout", dropout, "", shapes, non_negative=True, at_most=1.0)
    for_scatter, for_loss = jax.random.split(key)
    value = value + offset + spread * jax.random.normal(for_scatter, value.shape, kind)
    coarse = grain > 0
    step = jnp.where(coarse, grain, 1)
    rounded = jnp.where(coarse, step * jnp.round(value / step), value)
    # An exact zero that has the derivative of the value.
    passing = jnp.where(jnp.isfinite(value), value, 0)
    rounded = jax.lax.stop_gradient(rounded) + (
        passing - jax.lax.stop_gradient(passing)
    )
    return jnp.where(
        jax.random.bernoulli(for_loss, lost, value.shape), jnp.nan, rounded
    )

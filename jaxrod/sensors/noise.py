"""Noise of readings: bias, scatter, quantisation, loss."""

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
    r"""A reading with noise, $\mathrm{round}((y + b + s\,n)/r)\,r$ with normal $n$.

    Each number of the reading is disturbed independently. Derivatives pass through the
    rounding as if it were not there.

    Args:
        key: Key of the random numbers, `jax.random.key(seed)`; a new one per reading.
        reading: The reading, in its unit.
        deviation: Standard deviation, one number or one per number of the reading, as
            all that follow [unit of the reading].
        bias: Constant offset [unit of the reading].
        resolution: Step of the quantisation; zero for none [unit of the reading].
        dropout: Probability that a number is lost, from 0 to 1 [1]. It is NaN then.

    Returns:
        The disturbed reading, of the same shape and type.

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
    # The derivative of the value, added as an exact zero.
    passing = jnp.where(jnp.isfinite(value), value, 0)
    rounded = jax.lax.stop_gradient(rounded) + (
        passing - jax.lax.stop_gradient(passing)
    )
    return jnp.where(
        jax.random.bernoulli(for_loss, lost, value.shape), jnp.nan, rounded
    )

"""Running mean and variance of observations, merged batch by batch."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, DTypeLike, Float

from jaxrod.structure import pytree


@pytree
class RunningMoments:
    """Mean and variance of all samples so far, per component.

    The variance is stored instead of the sum of squares, which would grow with the
    length of a run and lose digits in float32. Before the first sample the mean is 0
    and the variance 1, so that normalising changes nothing.
    """

    count: Float[Array, ""]
    """Number of samples so far."""
    mean: Float[Array, " size"]
    """Mean of the samples."""
    variance: Float[Array, " size"]
    """Mean squared deviation of the samples from their mean."""


def no_moments(size: int, dtype: DTypeLike) -> RunningMoments:
    """Moments before any sample: mean 0, variance 1, so normalising changes nothing."""
    return RunningMoments(
        jnp.zeros((), dtype), jnp.zeros(size, dtype), jnp.ones(size, dtype)
    )


def batch_moments(
    samples: Float[Array, "count size"], axis_name: str | None = None
) -> RunningMoments:
    """Count, mean and variance of one batch of samples, per component.

    The first sample is subtracted before anything is summed, so that the variance loses
    no digits to a large mean.

    Args:
        samples: One sample per row.
        axis_name: Mapped device axis over which the batch is split; None for no split.
    """
    origin = samples[:1]
    shifted = samples - origin
    mean = jnp.mean(shifted, axis=0)
    variance = jnp.mean((shifted - mean[None]) ** 2, axis=0)
    moments = RunningMoments(
        jnp.asarray(samples.shape[0], samples.dtype), mean + origin[0], variance
    )
    if axis_name is None:
        return moments
    parts = jax.lax.all_gather(moments, axis_name)
    total = jax.tree.map(lambda leaf: leaf[0], parts)
    for i in range(1, parts.count.shape[0]):
        total = merge_moments(total, jax.tree.map(lambda leaf, i=i: leaf[i], parts))
    return total


def merge_moments(a: RunningMoments, b: RunningMoments) -> RunningMoments:
    """Moments of the union of two sets of samples.

    With w = n_b / (n_a + n_b) and d = mean_b - mean_a: mean = mean_a + w d and
    variance = (1 - w) var_a + w var_b + w (1 - w) d^2.

    Source: Chan, Golub & LeVeque, "Updating formulae and a pairwise algorithm
    for computing sample variances", 1979.
    """
    count = a.count + b.count
    weight = b.count / jnp.maximum(count, 1)
    difference = b.mean - a.mean
    return RunningMoments(
        count=count,
        mean=a.mean + weight * difference,
        variance=(1 - weight) * a.variance
        + weight * b.variance
        + weight * (1 - weight) * difference**2,
    )


def normalise(
    moments: RunningMoments,
    samples: Float[Array, "*batch size"],
    limit: float | Float[Array, ""],
) -> Float[Array, "*batch size"]:
    """Normalised samples: (x - mean) / sqrt(variance + 1e-8), clipped to +-`limit`.

    A component that never varied is always 0. Networks have not learned what it means,
    and the noise of a real sensor, divided by almost nothing, would drown all others.
    """
    leading = tuple(range(samples.ndim - 1))
    mean = jnp.expand_dims(moments.mean, leading)
    varied = moments.variance > 0
    scale = jnp.where(varied, jax.lax.rsqrt(moments.variance + 1e-8), 0)
    scale = jnp.expand_dims(scale, leading)
    return jnp.clip((samples - mean) * scale, -limit, limit)

"""A loop that fills an array, in quadratic time with jaxlib 0.11.1."""

import time

import jax
import jax.numpy as jnp


@jax.jit
def fill(a):
    """Writes one number in each turn."""
    return jax.lax.fori_loop(0, a.size, lambda i, a: a.at[i].set(a[i - 1] + 1), a)


for size in (20_000, 40_000, 80_000):
    fill(jnp.zeros(size)).block_until_ready()  # compiles
    start = time.perf_counter()
    fill(jnp.zeros(size)).block_until_ready()
    print(jax.__version__, size, f"{time.perf_counter() - start:.4f} s", flush=True)

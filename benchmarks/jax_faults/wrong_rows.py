"""A batch of 3 x 3 products whose last row comes out wrong with jaxlib 0.10.2."""

import jax
import jax.numpy as jnp
import numpy as np

rows = np.zeros((32_769, 3), np.float32)
rows[:, 0] = np.arange(32_769)
squares = jax.vmap(lambda row: jnp.sum((jnp.eye(3) @ row) ** 2))
got, exact = np.asarray(jax.jit(squares)(rows)), rows[:, 0] ** 2
print(jax.__version__, "wrong rows:", np.flatnonzero(got != exact))
print("last row:", got[-1], "exact:", exact[-1])

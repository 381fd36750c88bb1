"""A weighted sum over an array of seven axes that kills jaxlib 0.10.2 and 0.11.0."""

import jax
import jax.numpy as jnp
import numpy as np

print(jax.__version__, flush=True)
ones = np.ones((5,) * 7, np.float32)
weights = np.ones((5, 1, 1, 1, 1, 1, 1), np.float32)
summed = jax.jit(lambda w, a: jnp.sum(w * a, axis=0))(weights, ones)
print("sums:", np.unique(summed), "exact: [5.]")

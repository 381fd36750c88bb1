"""Whether standard deviations are those of many draws of the noise."""

import jax.numpy as jnp
import numpy as np


def assert_calibrated(fits, truth):
    """Of 200 draws the mean is known to 0.07 and the deviation to 0.05."""
    assert bool(jnp.all(fits.converged))
    np.testing.assert_allclose(jnp.mean(fits.misfit), 1, atol=0.1)
    for name, z in fits.z(truth).items():
        assert abs(float(jnp.mean(z))) < 0.3, name
        assert 0.8 < float(jnp.std(z)) < 1.2, name

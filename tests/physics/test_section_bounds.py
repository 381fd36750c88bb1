"""Bounds of actuators inside a rod on the step."""

import jax.numpy as jnp
import numpy as np

import jaxrod
from jaxrod.actuation.section_load import fibre_bound


def test_rounding_alone_makes_no_direction_count():
    """A fibre along the rod, exactly and but for rounding: the same bound."""
    rod, _ = jaxrod.straight_rod(
        3,
        length=0.4,
        radius=0.01,
        density=1e3,
        youngs_modulus=1e6,
        dtype=jnp.float64,
    )
    stiff, none = jnp.full((1, 4), 1e3), jnp.zeros((1, 4))
    for across, lever in ((1e-11, 0.0), (0.0, 1e-13)):
        exact, near = (
            fibre_bound(rod, stiff, none + 1, none + a, none + lay)
            for a, lay in ((0.0, 0.0), (across, lever))
        )
        np.testing.assert_allclose(near.nodes, exact.nodes, rtol=1e-9)
        np.testing.assert_allclose(near.elements, exact.elements, atol=1e-9)

"""Arms of other numbers of elements take steps that are stable by default."""

import jax
import jax.numpy as jnp
import pytest

import jaxrod
from jaxrod.envs import make


@pytest.mark.slow
@pytest.mark.parametrize("n", [20, 30, 60, 80])
@pytest.mark.parametrize("name", ["tracking", "reaching"])
def test_default_steps_are_stable_for_any_number_of_elements(name, n):
    env = make(name, variant="clean", n_elements=n)
    usual = make(name, variant="clean")
    assert env.substeps >= usual.substeps
    params = env.default_params()
    _, state = env.reset(jax.random.key(0), params)
    controls = jnp.zeros((3, params.arm.spline.n_controls), jnp.float32)
    bound = jaxrod.stable_dt(params.arm.scene(controls, state.arm), 1.0).dt
    assert float(params.dt) <= float(bound)


@pytest.mark.parametrize("name", ["structured", "unstructured"])
def test_arms_among_obstacles_take_as_many_more_steps(name):
    usual = make(name, variant="clean")
    finer = make(name, variant="clean", n_elements=2 * usual.n_elements)
    assert finer.substeps == 2 * usual.substeps
    assert make(name, variant="clean", n_elements=10).substeps == usual.substeps

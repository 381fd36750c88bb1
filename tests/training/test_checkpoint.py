"""Checkpoints give back what was saved."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.envs import make
from jaxrod.training.checkpoint import Checkpoints


@pytest.fixture
def checkpoints(tmp_path):
    found = Checkpoints(tmp_path)
    yield found
    found.close()


def test_keys_numbers_and_empty_arrays_come_back(checkpoints):
    state = {
        "key": jax.random.key(3),
        "nothing": jnp.zeros((0,)),
        "number": jnp.float32(0.1),
        "several": jnp.arange(6).reshape(2, 3),
    }
    checkpoints.save(1, state, {"steps": 7})
    template = jax.tree.map(jnp.zeros_like, state)
    restored, facts = checkpoints.restore(template)
    assert facts == {"steps": 7}
    assert jax.tree.structure(restored) == jax.tree.structure(state)
    for a, b in zip(*map(jax.tree.leaves, (state, restored)), strict=True):
        assert a.dtype == b.dtype and a.shape == b.shape
        if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(a, b)


def test_another_shape_is_refused(checkpoints):
    checkpoints.save(1, {"a": jnp.zeros(3)}, {})
    with pytest.raises(ValueError, match="checkpoint holds"):
        checkpoints.restore({"a": jnp.zeros(4)})


@pytest.mark.parametrize("variant", ["paper", "clean"])
@pytest.mark.parametrize("name", ["tracking", "reaching", "structured", "unstructured"])
def test_the_parameters_of_every_task_come_back(name, variant, checkpoints):
    """Two control points, as in Cases 3 and 4, have no breaks between them."""
    params = make(name, variant=variant).default_params()
    checkpoints.save(1, params, {})
    restored, _ = checkpoints.restore(jax.tree.map(jnp.zeros_like, params))
    for a, b in zip(*map(jax.tree.leaves, (params, restored)), strict=True):
        np.testing.assert_array_equal(a, b)

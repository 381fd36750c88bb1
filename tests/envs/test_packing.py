"""Packed trees are the trees, in few arrays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from jaxrod.envs.gym import GymnasiumEnv
from jaxrod.envs.gymnasium_batch import layout


def tree():
    return {
        "keys": jax.random.split(jax.random.key(3), 2),
        "old": jax.random.PRNGKey(1),
        "flags": jnp.array([True, False]),
        "numbers": (jnp.arange(6.0).reshape(2, 3), np.float32(4), jnp.zeros((0, 2))),
        "weak": 0.5,
        "counts": jnp.int32(7),
    }


def test_what_is_packed_comes_back():
    plan = layout(tree())
    for packed in (plan.pack(tree()), jax.jit(plan.pack)(tree())):
        back = plan.unpack(packed)
        assert jax.tree.structure(back) == jax.tree.structure(tree())
        for a, b in zip(jax.tree.leaves(tree()), jax.tree.leaves(back), strict=True):
            assert jnp.shape(a) == jnp.shape(b)
            assert jnp.asarray(a).dtype == jnp.asarray(b).dtype
            if jnp.issubdtype(jnp.asarray(a).dtype, jax.dtypes.prng_key):
                a, b = jax.random.key_data(a), jax.random.key_data(b)
            assert_array_equal(a, b)


def test_a_python_number_stays_weak():
    plan = layout(tree())
    half = jnp.zeros((), jnp.float16)
    mixed = jax.jit(lambda packed: half + plan.unpack(packed)["weak"])
    assert mixed(plan.pack(tree())).dtype == jnp.float16


def test_equal_trees_share_a_layout_and_others_are_refused():
    plan = layout(tree())
    assert plan == layout(tree()) and hash(plan) == hash(layout(tree()))
    with pytest.raises(ValueError, match="int32 of shape"):
        plan.pack(tree() | {"counts": jnp.float32(7)})
    with pytest.raises(ValueError, match="must be a PyTreeDef"):
        plan.pack({"counts": 1})


@pytest.mark.default_precision
def test_a_control_step_takes_and_gives_few_arrays():
    env = GymnasiumEnv("trivial")
    env.reset(seed=0)
    env.step(np.zeros(1, np.float32))
    batch = env._batch
    taken = jax.tree.leaves(batch.packed())
    program = batch._programs[0]
    given = program.outcome.dtypes
    # One for each type of numbers: the state has eight leaves, the results eleven.
    assert len(taken) == 4 and len(given) <= 3

"""What somebody's own environment lacks is one sentence that says what to write."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod import envs
from jaxrod.envs import check_environment
from jaxrod.envs.checking import check_key
from jaxrod.envs.trivial import Trivial


class Plain:
    """A state that JAX knows nothing of."""


class FiveParts(Trivial):
    def step(self, key, state, action, params):
        return super().step(key, state, action, params)[:5]


class Branching(Trivial):
    def step(self, key, state, action, params):
        if action[0] > 0:
            return super().step(key, state, action, params)
        return super().step(key, state, -action, params)


class WithNumpy(Trivial):
    def step(self, key, state, action, params):
        return super().step(key, state, np.tanh(np.asarray(action)), params)


class WithFloat(Trivial):
    def step(self, key, state, action, params):
        return super().step(key, state, jnp.full(1, float(action[0])), params)


class Undecorated(Trivial):
    def reset(self, key, params):
        return super().reset(key, params)[0], Plain()


class Swapped(Trivial):
    def reset(self, key, params):
        return super().reset(key, params)[::-1]


class FloatFlag(Trivial):
    def step(self, key, state, action, params):
        *before, truncated, info = super().step(key, state, action, params)
        return *before, jnp.float32(truncated), info


class Growing(Trivial):
    def reset(self, key, params):
        return jnp.zeros(1), {"time": jnp.int32(0)}

    def step(self, key, state, action, params):
        over = jnp.bool_(False)
        after = {"time": state["time"] + 0.1}
        return jnp.zeros(1), after, jnp.float32(0), over, over, {}


class VectorInfo(Trivial):
    def step(self, key, state, action, params):
        return *super().step(key, state, action, params)[:5], {"x": jnp.zeros(3)}


@dataclasses.dataclass
class Changing:
    """A dataclass that is not frozen has no hash."""

    name: str = "changing"
    observation_size: int = 1
    action_size: int = 1
    episode_length: int = 5
    default_params = reset = step = print


@pytest.mark.parametrize(
    ("env", "said"),
    [
        (FiveParts(), "must return (observation, state, reward, terminated, truncated"),
        (FiveParts(), "got a tuple of 5"),
        (Trivial(observation_size=9), "array of floats of shape (9,)"),
        (Branching(), "jnp.where and jax.lax.cond"),
        (WithNumpy(), "jax.numpy has the same functions"),
        (WithFloat(), "keep it an array"),
        (Undecorated(), "`@jaxrod.extend.pytree`"),
        (Swapped(), "observation of reset of trivial must be an array of floats"),
        (FloatFlag(), "truncated of trivial must be an array of bool of shape ()"),
        (Growing(), "state['time'] was int32 of shape (), and becomes float"),
        (VectorInfo(), "info['x'] of trivial must be an array of shape ()"),
        (Changing(), "changing must be hashable, for example a frozen dataclass"),
        (Trivial, "must be an object, got the class"),
        ({"n_elements": 20}, "got a dict without name, observation_size"),
        (Trivial(episode_length=0), "episode_length of trivial must be a positive"),
        (Trivial(name=None), "name of a Trivial must be text, got None"),
    ],
)
def test_a_mistake_is_a_sentence(env, said):
    with pytest.raises(ValueError) as raised:
        check_environment(env)
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)


def test_what_a_method_raised_is_the_cause():
    with pytest.raises(ValueError, match="step of trivial raised") as raised:
        check_environment(Branching())
    assert isinstance(raised.value.__cause__, jax.errors.TracerBoolConversionError)


def test_an_environment_is_let_pass():
    check_environment(Trivial())


@pytest.mark.parametrize("name", ["trivial", "tracking", "following"])
@pytest.mark.parametrize("key", [3, None, np.int64(3)])
def test_a_key_that_is_no_key_is_refused(name, key):
    env = envs.make(name)
    for reset in (
        lambda key: env.reset(key, None),
        lambda key: envs.VectorEnvironment(env).reset(key, 2, None),
    ):
        with pytest.raises(TypeError, match=r"key must be a random key, such as jax"):
            reset(key)


def test_old_keys_and_traced_keys_are_taken():
    env = envs.make("trivial")
    params = env.default_params()
    for key in (jax.random.key(0), jax.random.PRNGKey(0)):
        jax.eval_shape(env.reset, key, params)


def test_raw_keys_of_another_generator_are_keys():
    with jax.default_prng_impl("rbg"):
        check_key(jax.random.PRNGKey(0))
        check_key(jax.random.split(jax.random.PRNGKey(0), 3))
    with pytest.raises(TypeError, match="must be a random key"):
        check_key(np.zeros(3, np.uint32))

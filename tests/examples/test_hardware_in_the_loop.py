"""The example that has an exported policy act on the simulator over a socket."""

import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from examples.loading import load
from jaxrod.envs import make

pytestmark = pytest.mark.default_precision


def test_a_policy_acts_fifty_times_a_second():
    if shutil.which("cc") is None:
        pytest.skip("no C compiler is installed")
    env, example = make("trivial"), load("hardware_in_the_loop")
    acted = []
    policy = jax.tree_util.Partial(lambda seen: jnp.clip(-5 * seen, -1, 1))

    class Watched:
        """The task, and the actions that arrive."""

        def __getattr__(self, name):
            return getattr(env, name)

        def step(self, key, state, action, params):
            jax.debug.callback(
                lambda x, a: acted.append((x, a)), state.position, action
            )
            return env.step(key, state, action, params)

    latencies, delays = example.run(policy, Watched(), 1.0)
    jax.effects_barrier()
    assert len(latencies) == len(delays) == 50
    # One call is made before the loop, to compile.
    positions, actions = (np.array(x).ravel() for x in zip(*acted[1:], strict=True))
    np.testing.assert_allclose(actions, np.clip(-5 * positions, -1, 1), atol=1e-6)
    assert np.ptp(actions) > 0.5
    assert 0 < np.median(latencies) < 0.01
    assert -1e-6 < delays.min() and np.median(delays) < 0.01

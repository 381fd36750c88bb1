"""Tasks are the same by lanes: rewards, restarts, flags, observations."""

import dataclasses

import jax
import numpy as np
import pytest
from jax.sharding import AxisType, PartitionSpec

from jaxrod.envs import VectorEnvironment, make
from jaxrod.lanes import kernels
from jaxrod.lanes.choice import lane_choices, use_lanes

ARMS = [
    (task, variant)
    for task in ("tracking", "reaching", "structured", "unstructured")
    for variant in ("clean", "paper")
]
ENVIRONMENTS, STEPS, EPISODE = 9, 20, 7


def played(env, params, mode):
    """Steps of a batch under random actions, through restarts."""
    use_lanes(mode)
    batch = VectorEnvironment(env)

    def step(state, key):
        actions = jax.random.uniform(
            key, (ENVIRONMENTS, env.action_size), minval=-1.0, dtype="float64"
        )
        state, out = batch.step(state, actions, params)
        return state, out

    @jax.jit
    def run(key):
        state = batch.reset(key, ENVIRONMENTS, params, spread_phases=True)
        return jax.lax.scan(step, state, jax.random.split(key, STEPS))[1]

    return jax.device_get(run(jax.random.key(3)))


def same(taken, expected, tolerance):
    for name in ("terminated", "truncated", "episodes"):
        pairs = zip(
            jax.tree.leaves(getattr(taken, name)),
            jax.tree.leaves(getattr(expected, name)),
            strict=True,
        )
        for one, two in pairs:
            np.testing.assert_allclose(one, two, rtol=tolerance, atol=tolerance)
    for name in ("reward", "observation", "final_observation"):
        one, two = getattr(taken, name), getattr(expected, name)
        np.testing.assert_allclose(one, two, rtol=tolerance, atol=tolerance)
    np.testing.assert_array_equal(taken.info["flagged"], expected.info["flagged"])


@pytest.mark.slow
@pytest.mark.parametrize(("task", "variant"), ARMS)
def test_episodes_are_those_of_xla(task, variant):
    env = dataclasses.replace(make(task, variant=variant), episode_length=EPISODE)
    params = env.default_params()
    taken = played(env, params, "always")
    assert lane_choices()[-1].taken
    expected = played(env, params, "never")
    assert np.sum(expected.truncated | expected.terminated) >= ENVIRONMENTS
    # Places that are rounded in every step make published velocities coarser.
    same(taken, expected, 1e-9 if variant == "clean" else 1e-7)


@pytest.mark.slow
def test_arms_that_break_are_flagged_and_restart_alike():
    env = dataclasses.replace(make("tracking", variant="clean"), episode_length=50)
    params = env.default_params()
    params = dataclasses.replace(params, dt=3 * params.dt)
    taken = played(env, params, "always")
    expected = played(env, params, "never")
    assert np.any(expected.info["flagged"])
    assert np.all(np.isfinite(taken.observation))
    for name in ("truncated", "terminated"):
        np.testing.assert_array_equal(getattr(taken, name), getattr(expected, name))
    np.testing.assert_array_equal(taken.info["flagged"], expected.info["flagged"])


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    "task",
    [
        *("tracking", "reaching", "structured", "unstructured", "following", "snake"),
        pytest.param("lift", marks=pytest.mark.slow),
        pytest.param("insert", marks=pytest.mark.slow),
        pytest.param("catheter", marks=pytest.mark.slow),
        pytest.param("octopus", marks=pytest.mark.slow),
        pytest.param("gripper", marks=pytest.mark.slow),
    ],
)
def test_lanes_read_every_task_as_learners_step_it(task, monkeypatch):
    """On a device of a mesh, where types of arrays name it. Nothing is compiled."""

    def not_compiled(kernel):
        raise RuntimeError(f"read {kernel.operations} operations")

    monkeypatch.setattr(kernels, "registered", not_compiled)
    use_lanes("auto")
    env = make(task, variant="clean")
    batch, params = VectorEnvironment(env), env.default_params()
    state = jax.eval_shape(lambda: batch.reset(jax.random.key(0), ENVIRONMENTS, params))
    actions = jax.ShapeDtypeStruct((ENVIRONMENTS, env.action_size), "float64")
    spread, whole = PartitionSpec("i"), PartitionSpec()
    step = jax.shard_map(
        batch.step,
        mesh=jax.make_mesh((1,), ("i",), axis_types=(AxisType.Auto,)),
        in_specs=(spread, spread, whole),
        out_specs=spread,
        check_vma=False,
    )
    jax.jit(step).lower(state, actions, params)
    assert lane_choices()[-1].why.startswith("no kernel: RuntimeError: read ")

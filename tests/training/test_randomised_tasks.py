"""Randomised tasks: they train, resume bit for bit and are exported."""

import signal
from pathlib import Path

import jax
import numpy as np
import pytest

from exported import compiled
from jaxrod import envs
from jaxrod.training import PPOConfig, export_c, export_onnx, restore_policy, train

OWN = f"{Path(__file__).parents[2] / 'examples' / 'own_task.py'}:make_task"
CHANCE = {
    "delay": [0, 2],
    "lag": [0.0, 1.5],
    "saturation": [0.7, 1.0],
    "noise": 0.01,
    "dropout": 0.1,
}
"""Faults that every task can have; delay and lag in control steps."""
SMALL = PPOConfig(num_envs=2, rollout_steps=4, minibatches=1, epochs=1)
CHUNK, UPDATES = 8, 3


def stop_early(row):
    """Interrupts a run after its first update."""
    if row["env_steps"] == CHUNK:
        signal.raise_signal(signal.SIGINT)


@pytest.mark.slow
@pytest.mark.default_precision
@pytest.mark.parametrize("task", [*envs.names(), pytest.param(OWN, id="own_task")])
def test_a_randomised_task_trains_resumes_bit_by_bit_and_is_exported(task, tmp_path):
    import onnxruntime

    env = envs.make(task, randomise=CHANCE)
    run = {
        "steps": UPDATES * CHUNK,
        "config": SMALL,
        "chunk_steps": CHUNK,
        "evaluation_episodes": 0,
        "progress": False,
    }
    whole = train(env, out=tmp_path / "whole", **run)
    folder = tmp_path / "stopped"
    stopped = train(env, out=folder, log=stop_early, **run)
    assert stopped.summary["status"] == "interrupted"
    assert stopped.summary["env_steps"] == CHUNK
    resumed = train(env, out=folder, resume=True, **run)
    assert resumed.summary["env_steps"] == whole.summary["env_steps"]
    moved = False
    for a, b, c in zip(
        *(jax.tree.leaves(one.policy) for one in (whole, resumed, stopped)), strict=True
    ):
        np.testing.assert_array_equal(a, b)
        moved |= bool(np.any(np.asarray(a) != np.asarray(c)))
    assert moved, "nothing was learned after the interruption"
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(whole.policy))
    policy = restore_policy(folder, envs.make(task, randomise=CHANCE))
    export_c(policy, env, tmp_path / "policy.h")
    export_onnx(policy, env, tmp_path / "policy.onnx")
    session = onnxruntime.InferenceSession(str(tmp_path / "policy.onnx"))
    act = compiled(tmp_path / "policy.h")
    size = env.observation_size
    seen = np.random.default_rng(0).normal(size=(100, size)).astype(np.float32)
    wanted = np.clip(policy(seen), -1, 1)
    for one, action in zip(seen, wanted, strict=True):
        np.testing.assert_allclose(act(one), action, rtol=0, atol=1e-6)
        found = session.run(None, {"observation": one})[0]
        np.testing.assert_allclose(found, action, rtol=0, atol=1e-6)

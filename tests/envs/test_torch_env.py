"""PyTorch sees what the functional environments do, in the memory of JAX."""

import importlib

import jax
import numpy as np
import pytest

from jaxrod.envs.gym import GymnasiumVectorEnv
from missing import pretend_missing

torch = pytest.importorskip("torch", reason="PyTorch is not installed")
adapter = importlib.import_module("jaxrod.envs.torch_env")

pytestmark = pytest.mark.default_precision

HALF = -78.5
"""Return of 250 control steps of `tracking`, half way from that of random actions,
-105, to that of our PPO after 200,000 steps, -52."""


def leaning(steps, num_envs):
    """Random actions that lean one way, so that a point runs off its line."""
    drawn = np.random.default_rng(0).uniform(-0.5, 1.5, (steps, num_envs, 1))
    return np.clip(drawn, -1, 1).astype(np.float32)


def test_batch_is_that_of_gymnasium_to_the_last_bit():
    ours, theirs = adapter.TorchBatch("trivial", 3), GymnasiumVectorEnv("trivial", 3)
    np.testing.assert_array_equal(ours.reset(7), theirs.reset(seed=7)[0])
    ends = 0
    for actions in leaning(60, 3):
        step = ours.step(torch.from_numpy(actions))
        expected = theirs.step(actions)
        found = step.observation, step.reward, step.terminated, step.truncated
        for got, wanted in zip(found, expected, strict=False):
            np.testing.assert_array_equal(got, wanted)
        assert ours.observation is step.observation
        over = step.terminated | step.truncated
        if over.any():
            finals = np.stack(expected[-1]["final_obs"][over.numpy()])
            np.testing.assert_array_equal(step.final_observation[over], finals)
        ends += int(over.sum())
    assert ends > 3 and step.observation.dtype == torch.float32
    assert {v.dtype for v in step.info.values()} <= {torch.float32, torch.bool}


@pytest.fixture
def crossings(monkeypatch):
    """Pairs of addresses, before and after each array or tensor crosses over."""
    seen = {"in": [], "out": []}
    taken, given = jax.dlpack.from_dlpack, torch.from_dlpack

    def to_jax(tensor, *more):
        array = taken(tensor, *more)
        seen["in"].append((tensor.data_ptr(), array.unsafe_buffer_pointer()))
        return array

    def to_torch(array):
        tensor = given(array)
        seen["out"].append((array.unsafe_buffer_pointer(), tensor.data_ptr()))
        return tensor

    monkeypatch.setattr(jax.dlpack, "from_dlpack", to_jax)
    monkeypatch.setattr(torch, "from_dlpack", to_torch)
    return seen


def test_nothing_is_copied_on_the_way(crossings):
    batch = adapter.TorchBatch("trivial", 64)
    crossings["out"].clear()
    actions = torch.zeros(64, 1)
    step = batch.step(actions)
    assert crossings["in"] == [(actions.data_ptr(), actions.data_ptr())]
    # One tensor for each dtype, of which all results are views.
    assert 1 <= len(crossings["out"]) <= 3
    assert all(a == b for a, b in crossings["out"])
    storages = {b for _, b in crossings["out"]}
    leaves = [v for v in jax.tree.leaves(step) if isinstance(v, torch.Tensor)]
    assert len(leaves) > 6
    assert {v.untyped_storage().data_ptr() for v in leaves} == storages


def test_actions_that_jax_cannot_share_are_copied_with_the_same_result():
    results = []
    for make in (
        lambda: torch.full((4, 1), 0.25),
        lambda: torch.full((5, 1), 0.25)[1:],  # not at a multiple of 64 bytes
        lambda: torch.full((4, 2), 0.25)[:, :1],  # not contiguous
        lambda: torch.full((4, 1), 0.25, dtype=torch.float64),
        lambda: torch.full((4, 1), 0.25, requires_grad=True),
    ):
        batch = adapter.TorchBatch("trivial", 4, seed=3)
        results.append(batch.step(make()).observation)
    for result in results[1:]:
        np.testing.assert_array_equal(result, results[0])


def test_results_may_be_kept_and_written_and_actions_reused():
    batch, twin = (adapter.TorchBatch("trivial", 4, seed=1) for _ in range(2))
    actions, kept = torch.zeros(4, 1), []
    for number, drawn in enumerate(leaning(8, 4)):
        actions.copy_(torch.from_numpy(drawn))
        step = batch.step(actions)
        kept.append((step.observation, step.observation.clone()))
        expected = twin.step(torch.from_numpy(drawn.copy()))
        np.testing.assert_array_equal(step.observation, expected.observation)
        expected.observation.fill_(number)
        expected.reward.fill_(number)
    for now, then in kept:
        np.testing.assert_array_equal(now, then)


def test_clocks_can_be_set_and_end_episodes_early():
    batch = adapter.TorchBatch("trivial", 3, episode_length=5)
    assert batch.elapsed.tolist() == [0, 0, 0]
    batch.elapsed = torch.tensor([0, 3, 4])
    ends = []
    for _ in range(5):
        ends.append(batch.step(torch.zeros(3, 1)).truncated.tolist())
    assert np.array(ends).argmax(axis=0).tolist() == [4, 1, 0]
    assert batch.elapsed.tolist() == [0, 3, 4]


def test_view_of_skrl_has_columns():
    batch = adapter.TorchBatch("trivial", 3, episode_length=2)
    env = adapter.SkrlEnv(batch)
    first, nothing = env.reset()
    assert first is batch.observation and nothing == {}
    assert (env.num_envs, env.num_agents, env.state()) == (3, 1, None)
    assert env.action_space.shape == (1,) and env.observation_space.shape == (1,)
    for last in (False, True):
        seen, reward, terminated, truncated, info = env.step(torch.zeros(3, 1))
        assert seen is env.reset()[0]
        assert reward.shape == terminated.shape == truncated.shape == (3, 1)
        assert truncated.all() == last and not terminated.any()
    assert info["flagged"].shape == (3,)
    env.render()
    env.close()


def test_bad_input_is_refused_in_words():
    batch = adapter.TorchBatch("trivial", 3)
    with pytest.raises(ValueError, match=r"shape \(3, 1\), got \(3, 2\)"):
        batch.step(torch.zeros(3, 2))
    with pytest.raises(ValueError, match="num_envs must be at least 1, got 0"):
        adapter.TorchBatch("trivial", 0)


def test_without_pytorch_a_sentence_says_what_to_install(monkeypatch):
    pretend_missing(monkeypatch, "torch", "jaxrod.envs.torch_env")
    with pytest.raises(ModuleNotFoundError, match="pip install torch"):
        importlib.import_module("jaxrod.envs.torch_env")


def test_view_of_rsl_rl_clips_actions_and_names_time_limits():
    pytest.importorskip("tensordict", reason="RSL-RL is not installed")
    batch = adapter.TorchBatch("trivial", 3, seed=5, episode_length=4)
    env = adapter.RslRlVecEnv(batch)
    twin = adapter.TorchBatch("trivial", 3, seed=5, episode_length=4)
    assert (env.num_envs, env.num_actions, env.max_episode_length) == (3, 1, 4)
    np.testing.assert_array_equal(env.get_observations()["policy"], twin.observation)
    env.episode_length_buf = torch.randint_like(env.episode_length_buf, 1) + 2
    for number in range(2):
        seen, reward, done, extras = env.step(torch.full((3, 1), 7.0))
        expected = twin.step(torch.ones(3, 1))
        np.testing.assert_array_equal(reward, expected.reward)
        assert done.all() == extras["time_outs"].all() == (number == 1)
    assert seen.batch_size == (3,)
    np.testing.assert_array_equal(seen["policy"], batch.observation)
    assert extras["log"]["/flagged"] == 0


def recorded(view):
    """A view of `tracking` that keeps the mean reward of every step in `rewards`."""

    class Recorded(view):
        def step(self, actions):
            results = super().step(actions)
            self.rewards.append(results[1].mean().item())
            return results

    batch = adapter.TorchBatch("tracking", 64, variant="clean", episode_length=250)
    env = Recorded(batch)
    env.rewards = []
    return env


@pytest.mark.slow
def test_ppo_of_rsl_rl_improves_on_tracking_as_ours_does():
    runners = pytest.importorskip("rsl_rl.runners", reason="RSL-RL is not installed")
    torch.manual_seed(0)
    network = {
        "class_name": "MLPModel",
        "hidden_dims": [64, 64],
        "activation": "tanh",
        "obs_normalization": True,
    }
    noise = {"class_name": "GaussianDistribution", "init_std": 1.0}
    settings = {
        "num_steps_per_env": 64,
        "save_interval": 100,
        "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "actor": network | {"distribution_cfg": noise},
        "critic": network,
        "algorithm": {
            "class_name": "PPO",
            "learning_rate": 1e-3,
            "schedule": "fixed",
            "num_learning_epochs": 8,
            "num_mini_batches": 4,
            "gamma": 0.98,
            "entropy_coef": 0.0,
            "use_clipped_value_loss": False,
            "normalize_advantage_per_mini_batch": True,
            "max_grad_norm": 10.0,
        },
    }
    env = recorded(adapter.RslRlVecEnv)
    runners.OnPolicyRunner(env, settings).learn(48, init_at_random_ep_len=True)
    assert 250 * np.mean(env.rewards[-250:]) > HALF


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of tensorboard, for example
def test_ppo_of_skrl_improves_on_tracking_as_ours_does(tmp_path, monkeypatch):
    runner = pytest.importorskip(
        "skrl.utils.runner.torch", reason="skrl is not installed"
    )
    monkeypatch.chdir(tmp_path)  # skrl writes its runs here
    layers = {
        "name": "net",
        "input": "OBSERVATIONS",
        "layers": [64, 64],
        "activations": "tanh",
    }
    settings = {
        "seed": 0,
        "models": {
            "separate": True,
            "policy": {
                "class": "GaussianMixin",
                "network": [layers],
                "output": "ACTIONS",
            },
            "value": {
                "class": "DeterministicMixin",
                "network": [layers],
                "output": "ONE",
            },
        },
        "memory": {"class": "RandomMemory", "memory_size": -1},
        "agent": {
            "class": "PPO",
            "rollouts": 64,
            "learning_epochs": 8,
            "mini_batches": 4,
            "discount_factor": 0.98,
            "learning_rate": 1e-3,
            "time_limit_bootstrap": True,
            "observation_preprocessor": "RunningStandardScaler",
            "value_preprocessor": "RunningStandardScaler",
            "value_loss_scale": 1.0,
        },
        "trainer": {"class": "SequentialTrainer", "timesteps": 3072},
    }
    env = recorded(adapter.SkrlEnv)
    runner.Runner(env, settings).run("train")
    assert 250 * np.mean(env.rewards[-250:]) > HALF

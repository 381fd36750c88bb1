"""`jaxrod render`: the frames are the episode's, and the files are where it says."""

import dataclasses
import json
import re
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.cli import recording
from jaxrod.envs import Snapshot, make
from jaxrod.envs.drawing import drawable
from jaxrod.structure import pytree, static
from jaxrod.training import MLPPolicy, save_policy
from jaxrod.training.normalisation import no_moments


@pytree
class ClockState:
    steps: Any
    key: Any


@dataclasses.dataclass(frozen=True)
class Clock:
    """An arm whose nodes stand at x = number of control steps; reward is that too."""

    episode_length: int = 100
    ends: int = 10**6
    breaks: int = 10**6
    control_period: float = 0.005
    name: str = "clock"

    def default_params(self):
        return {"radii": jnp.full(2, 0.1), "radius": jnp.asarray(0.3)}

    def snapshot(self, state, params):
        x = jnp.where(state.steps >= self.breaks, jnp.nan, state.steps.astype(float))
        nodes = jnp.stack([jnp.full(3, x), *jnp.eye(3)[1:]])
        post = (jnp.zeros(3), jnp.ones(3), 0.2)
        return Snapshot(
            nodes,
            params["radii"],
            spheres=((jnp.zeros(3), params["radius"]),),
            cylinders=(post,),
            readouts={"steps": state.steps},
        )

    def reset(self, key, params):
        return jnp.zeros(1), ClockState(jnp.zeros((), int), key)

    def step(self, key, state, action, params):
        steps = state.steps + 1
        reward = steps.astype(float)
        ended = steps >= self.ends
        over = steps >= self.episode_length
        return jnp.zeros(1), ClockState(steps, key), reward, ended, over, {}


idle = jax.tree_util.Partial(jnp.zeros_like)


def test_frames_are_states_of_the_episode_at_no_more_than_60_hz():
    replay = recording.record(Clock(), idle)
    # 5 ms between control steps: every fourth is shown, 50 a second.
    np.testing.assert_allclose(replay.times, np.arange(26) * 0.02)
    np.testing.assert_array_equal(replay.positions[:, 0, 0, 0], np.arange(26) * 4)
    assert replay.spheres[0].radius == pytest.approx(0.3)
    np.testing.assert_allclose(replay.radii, 0.1)
    np.testing.assert_allclose(replay.readouts["reward"][:3], [0, 2.5, 6.5])
    assert replay.readouts["return"][-1] == pytest.approx(sum(range(101)))
    np.testing.assert_array_equal(replay.readouts["steps"], np.arange(26) * 4)
    assert (replay.cylinders[0].radius, replay.up) == (0.2, "z")


@dataclasses.dataclass(frozen=True)
class Echo(Clock):
    """A clock that shows how many steps it has done, and is paid its action."""

    def step(self, key, state, action, params):
        _, after, _, *rest = super().step(key, state, action, params)
        return 0.01 * after.steps[None].astype(float), after, action[0], *rest


def test_actions_are_held_as_the_policy_says():
    policy = MLPPolicy(
        moments=no_moments(1, jnp.float64),
        limit=jnp.asarray(10.0),
        layers=((jnp.ones((1, 1)), jnp.zeros(1)),),
        action_repeat=3,
    )
    replay = recording.record(Echo(), policy)
    acted = 0.01 * (np.arange(100) // 3 * 3)
    np.testing.assert_allclose(
        replay.readouts["reward"][1:], acted.reshape(25, 4).mean(axis=1)
    )


@pytree
class Counting:
    """Acts by how often it was asked, whatever it sees."""

    share: jax.Array
    action_repeat: int = static(default=1)

    def init(self, observation, state):
        return jnp.zeros(observation.shape[0])

    def act(self, memory, observation, state):
        assert state.steps.shape == observation.shape[:1]
        return self.share * memory[:, None], memory + 1


@pytest.mark.parametrize("held", [1, 3])
def test_policies_that_remember_are_recorded(held):
    replay = recording.record(Echo(), Counting(jnp.asarray(0.01), held))
    acted = 0.01 * (np.arange(100) // held)
    np.testing.assert_allclose(
        replay.readouts["reward"][1:], acted.reshape(25, 4).mean(axis=1)
    )


def test_seconds_shorten_the_recording():
    assert recording.record(Clock(), idle, seconds=0.1).times[-1] == pytest.approx(0.1)
    assert recording.record(Clock(), idle, seconds=99).times[-1] == pytest.approx(0.5)


def test_the_recording_ends_with_the_episode():
    replay = recording.record(Clock(ends=42), idle)
    # The last frame shows the end, not what would have come after it.
    assert replay.positions[-1, 0, 0, 0] == 42
    assert replay.num_frames == 12


def test_a_broken_arm_is_shown_until_it_breaks():
    replay = recording.record(Clock(breaks=42), idle)
    assert replay.positions[-1, 0, 0, 0] == 40


def test_what_does_not_say_what_to_draw_is_not_drawable():
    assert drawable(Clock())
    tasks = "tracking", "reaching", "structured", "unstructured", "snake", "gripper"
    for name in tasks:
        assert drawable(make(name))
    assert not drawable(make("trivial"))
    sentence = (
        r"trivial does not say what to draw: it has no method "
        r"snapshot\(state, params\) and no control_period"
    )
    with pytest.raises(ValueError, match=sentence):
        recording.record(make("trivial"), idle)


def test_two_rods_of_one_size_are_drawn_together():
    class Twins(Clock):
        def snapshot(self, state, params):
            one = super().snapshot(state, params)
            return Snapshot(jnp.stack([one.positions, 1 + one.positions]), one.radii)

    replay = recording.record(Twins(), idle)
    assert replay.num_rods == 2 and replay.spheres == ()
    np.testing.assert_array_equal(replay.positions[:, 1], 1 + replay.positions[:, 0])


def test_what_a_replay_cannot_show_is_refused_in_words():
    class Growing(Clock):
        def snapshot(self, state, params):
            one = super().snapshot(state, params)
            return dataclasses.replace(one, radii=one.radii + 0.1 * state.steps)

    class Wandering(Clock):
        def snapshot(self, state, params):
            one = super().snapshot(state, params)
            start, end, radius = one.cylinders[0]
            moved = ((start + 0.1 * state.steps, end, radius),)
            return dataclasses.replace(one, cylinders=moved)

    class Odd(Clock):
        def snapshot(self, state, params):
            return super().snapshot(state, params).positions

    for env, sentence in (
        (Growing(), "radii of a snapshot must not change during an episode"),
        (Wandering(), "an end of a cylinder of a snapshot must not change"),
        (Odd(), "snapshot of clock must return a jaxrod.envs.Snapshot, got"),
    ):
        with pytest.raises(ValueError, match=sentence):
            recording.record(env, idle)


@pytest.mark.slow
def test_obstacles_are_drawn_where_the_task_has_some():
    def seen(name):
        env = make(name)
        params = env.default_params()
        return env.snapshot(env.reset(jax.random.key(0), params)[1], params)

    assert seen("tracking").cylinders == ()
    first, *others = seen("structured").cylinders
    assert len(others) == 7
    np.testing.assert_allclose(first[0], [-0.6, 0.0, 0.12], rtol=1e-6)
    np.testing.assert_allclose(first[1], [-0.6, 1.0, 0.12], rtol=1e-6)
    assert first[2] == pytest.approx(0.1)


@pytest.fixture
def tracking_run(tmp_path):
    """A run of the tracking task as it looks while it trains: a policy, a table."""
    env = make("tracking")
    folder = tmp_path / "run"
    config = {
        "task": "tracking",
        "variant": "paper",
        "env_options": {"variant": "paper"},
        "algorithm": "ppo",
        "steps": 100,
        "seed": 0,
        "settings": {},
    }
    policy = MLPPolicy(
        no_moments(env.observation_size, jnp.result_type(float)),
        jnp.asarray(10.0),
        ((jnp.zeros((env.observation_size, env.action_size)), jnp.full(12, 0.5)),),
    )
    save_policy(policy, folder / "policy")
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "progress.csv").write_text(
        "env_steps,wall_s,episode_return_mean\n1000,1,\n2000,2,50.5\n3000,3,60\n"
    )
    return SimpleNamespace(folder=folder, env=env, policy=policy)


@pytest.mark.slow
def test_the_arm_of_the_tracking_task_is_drawn_as_it_moves(tracking_run):
    env, policy = tracking_run.env, tracking_run.policy
    replay = recording.record(env, policy, seconds=0.05)
    assert replay.num_frames == 4  # the start, and 36 control steps by twelve
    params = env.default_params()
    _, state = env.reset(jax.random.key(7), params)
    step = jax.jit(env.step)
    for _ in range(36):
        _, state, *_ = step(jax.random.key(0), state, jnp.full(12, 0.5), params)
    # The action is constant, so the arm's motion depends on no randomness.
    np.testing.assert_allclose(
        replay.positions[-1, 0].T, state.arm.positions, atol=1e-12
    )


@pytest.mark.slow
def test_render_writes_both_pictures_while_a_run_goes_on(tracking_run, run):
    folder = tracking_run.folder
    code, out, err = run("render", folder, "--seconds", "0.1")
    assert (code, err) == (0, "")
    curve, replay = folder / "learning_curve.png", folder / "replay.html"
    assert out.split() == [str(curve), str(replay)]
    assert curve.read_bytes().startswith(b"\x89PNG")
    page = replay.read_text()
    assert "tracking (paper), ppo, seed 0" in page
    assert not re.search(r"""(src|href)=["']?https?:|@import|fetch\(""", page)


def test_render_writes_where_it_is_told_to(tracking_run, run, tmp_path):
    out = tmp_path / "a new folder" / "episode.html"
    code, _, _ = run(
        "render", tracking_run.folder, "--seconds", "0.1", "--seed", "2", "--out", out
    )
    assert code == 0
    assert out.read_text().startswith("<!")
    assert not (tracking_run.folder / "replay.html").exists()


def test_a_folder_in_the_place_of_a_file_is_named(tracking_run, run, tmp_path):
    words = ("render", tracking_run.folder, "--seconds", "0.1", "--out", tmp_path)
    code, _, err = run(*words)
    assert code == 2
    assert err.endswith(f"{tmp_path}: Is a directory\n")


def test_a_task_that_shows_nothing_gets_its_curve_and_a_word(trained, run):
    code, out, err = run("render", trained[0])
    assert code == 0
    assert out.split() == [str(trained[0] / "learning_curve.png")]
    assert "no replay: trivial has no pictures" in err


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--seconds", "0"], "seconds must be positive and finite, got 0.0 s"),
        (["--seconds", "nan"], "seconds must be positive and finite, got nan s"),
        (["--seed", "-1"], "seed must be an integer from 0 to 4294967295, got -1"),
    ],
)
def test_impossible_numbers_are_named(words, sentence, trained, run):
    code, _, err = run("render", trained[0], *words)
    assert code == 2
    assert sentence in err

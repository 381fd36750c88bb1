"""Gymnasium sees what the functional environments do."""

import dataclasses
import functools
import importlib
import os
import re
import subprocess
import sys
import time

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from matplotlib import pyplot

from every_id import EVERY_ID
from jaxrod import straight_rod
from jaxrod.envs import Snapshot, VectorEnvironment, make
from jaxrod.envs.gym import GymnasiumEnv, GymnasiumVectorEnv, _Window, ids
from jaxrod.envs.gymnasium_batch import film_metadata
from jaxrod.envs.trivial import Trivial

pytestmark = pytest.mark.default_precision


@dataclasses.dataclass(frozen=True)
class Leaning(Trivial):
    """The point on a line drawn as the place of an arm; three steps an episode."""

    episode_length: int = 3
    control_period: float = 0.1

    def snapshot(self, state, params):
        rod, rest = straight_rod(
            4, length=1.0, radius=0.05, density=1e3, youngs_modulus=1e6
        )
        moved = rest.positions.at[0].add(state.position)
        target = jnp.array([0.0, 1.0, 0.0])
        return Snapshot(moved, rod.radii, spheres=((target, 0.1),), up="y")


@functools.partial(jax.jit, static_argnums=(0, 2))
def functional_reset(batch, key, num_envs, params):
    return batch.reset(key, num_envs, params)


@functools.partial(jax.jit, static_argnums=0)
def functional_step(batch, state, actions, params):
    return batch.step(state, actions, params)


def actions_for(envs, steps):
    """Random actions that lean one way, so that a point runs off its line."""
    shape = (steps, *envs.action_space.shape)
    drawn = np.random.default_rng(0).uniform(-1, 1, shape) + 0.5
    return np.clip(drawn, -1, 1).astype(np.float32)


def check_same(env, envs, steps, rounding=0.0):
    """A vector environment does what the functional interface does."""
    batch, params = VectorEnvironment(env), env.default_params()
    state = functional_reset(batch, jax.random.key(7), envs.num_envs, params)
    observation, infos = envs.reset(seed=7)
    np.testing.assert_array_equal(observation, state.observation)
    assert infos == {}
    terminated = truncated = 0
    for actions in actions_for(envs, steps):
        state, expected = functional_step(batch, state, actions, params)
        seen = envs.step(actions)
        assert seen[0] in envs.observation_space
        names = ("observation", "reward", "terminated", "truncated")
        for got, name in zip(seen, names, strict=False):
            wanted = np.asarray(getattr(expected, name), got.dtype)
            np.testing.assert_allclose(got, wanted, rtol=rounding, atol=rounding)
        ended = np.asarray(expected.terminated | expected.truncated)
        infos = seen[-1]
        assert ("final_obs" in infos) == ended.any()
        for i, over in enumerate(ended):
            scalars = infos["final_info"] if over else infos
            for name, value in expected.info.items():
                assert scalars[name][i] == pytest.approx(
                    value[i].item(), rel=rounding, abs=rounding
                )
                assert scalars[f"_{name}"][i]
            if over:
                assert infos["_final_obs"][i] and infos["_final_info"][i]
                final = infos["final_obs"][i]
                wanted = expected.final_observation[i]
                np.testing.assert_allclose(final, wanted, rtol=rounding, atol=rounding)
        terminated += np.asarray(expected.terminated).sum()
        truncated += np.asarray(expected.truncated).sum()
    return terminated, truncated


def check_one_is_a_batch_of_one(env, envs, steps):
    """Gymnasium's own batch of our environment is our batch of one."""
    sync = SyncVectorEnv([lambda: env], autoreset_mode=AutoresetMode.SAME_STEP)
    assert data_equivalence(sync.reset(seed=3), envs.reset(seed=3), exact=True)
    for actions in actions_for(envs, steps):
        ours, theirs = envs.step(actions), sync.step(actions)
        assert data_equivalence(ours, theirs, exact=True)


@pytest.mark.slow
def test_vector_environment_is_the_functional_one_to_the_last_bit():
    envs = GymnasiumVectorEnv("trivial", 3)
    terminated, truncated = check_same(make("trivial"), envs, 60)
    assert terminated > 0 and truncated > 0


def test_environment_is_a_batch_of_one_to_the_last_bit_over_many_episodes():
    check_one_is_a_batch_of_one(
        GymnasiumEnv("trivial"), GymnasiumVectorEnv("trivial", 1), 60
    )


@pytest.mark.parametrize(
    "envs", [GymnasiumEnv("trivial"), GymnasiumVectorEnv("trivial", 3)], ids=type
)
def test_seeds_repeat_and_none_is_fresh(envs):
    first, second = (
        [envs.reset(seed=5)[0], envs.reset()[0], envs.reset()[0]] for _ in range(2)
    )
    np.testing.assert_array_equal(first, second)
    large = [envs.reset(seed=seed)[0] for seed in (6, 2**32 + 5, 2**32 + 6, 2**70)]
    drawn = np.stack([*first, *large])
    assert len(np.unique(drawn)) == drawn.size
    assert not np.array_equal(type(envs)("trivial").reset()[0], first[0])
    np.testing.assert_array_equal(drawn[0].ravel()[0], observation_of_seed(5))


def observation_of_seed(seed):
    env = make("trivial")
    batch, params = VectorEnvironment(env), env.default_params()
    return functional_reset(batch, jax.random.key(seed), 1, params).observation[0, 0]


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED])
def test_episodes_begin_when_the_mode_says(mode):
    """Gymnasium's own batch of three environments ends and starts at the same steps."""
    length = 4
    ours = GymnasiumVectorEnv(
        "trivial", 3, episode_length=length, autoreset_mode=mode.value
    )
    theirs = SyncVectorEnv(
        [lambda: GymnasiumEnv("trivial", episode_length=length)] * 3,
        autoreset_mode=mode,
    )
    for envs in (ours, theirs):
        assert envs.metadata["autoreset_mode"] is mode
    seen, _ = ours.reset(seed=0)
    theirs.reset(seed=0)
    still = np.zeros((3, 1), np.float32)
    began = 0
    for _ in range(3 * length):
        after, reward, terminated, truncated, infos = ours.step(still)
        found = theirs.step(still)
        np.testing.assert_array_equal(terminated, found[2])
        np.testing.assert_array_equal(truncated, found[3])
        assert infos.keys() == found[4].keys()
        # An action of zero moves nothing: places change where an episode begins.
        begins = after[:, 0] != seen[:, 0]
        np.testing.assert_array_equal(begins, reward == 0)
        np.testing.assert_array_equal(reward == 0, found[1] == 0)
        began += begins.sum()
        seen = after
        if mode is AutoresetMode.DISABLED and truncated.any():
            with pytest.raises(gymnasium.error.ResetNeeded, match=r"\[0, 1, 2\]"):
                ours.step(still)
            mask = {"reset_mask": np.array([True, True, True])}
            seen, _ = ours.reset(options=dict(mask))
            theirs.reset(options=dict(mask))
            assert np.all(seen != after)
    assert began == (6 if mode is AutoresetMode.NEXT_STEP else 0)


def test_some_environments_begin_anew_and_others_go_on():
    envs = GymnasiumVectorEnv("trivial", 3, autoreset_mode="Disabled")
    before, _ = envs.reset(seed=0)
    mask = np.array([True, False, True])
    after, _ = envs.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(before[:, 0] != after[:, 0], mask)
    for wrong in (np.ones(2, bool), np.ones(3)):
        with pytest.raises(ValueError, match=r"booleans of shape \(3,\), got"):
            envs.reset(options={"reset_mask": wrong})
    with pytest.raises(ValueError, match=r"no options but reset_mask, got .*'x'"):
        envs.reset(options={"x": 1})
    with pytest.raises(ValueError, match="NextStep, SameStep, Disabled; got 'x'"):
        GymnasiumVectorEnv("trivial", 3, autoreset_mode="x")


# Gymnasium compares the bounds of two types as it makes the new space.
@pytest.mark.fast_sets(1)
@pytest.mark.filterwarnings("ignore:overflow encountered:RuntimeWarning")
@pytest.mark.parametrize(
    ("mode", "names"),
    [
        ("SameStep", ("RecordEpisodeStatistics", "NormalizeReward")),
        ("NextStep", ("RecordEpisodeStatistics", "NormalizeObservation", "Dtype")),
        ("Disabled", ("NormalizeReward", "Dtype")),
    ],
)
def test_wrappers_of_gymnasium_go_over_it(mode, names):
    wrappers = gymnasium.wrappers.vector
    envs = GymnasiumVectorEnv("trivial", 4, episode_length=5, autoreset_mode=mode)
    for name in names:
        if name == "Dtype":
            envs = wrappers.DtypeObservation(envs, np.float64)
        else:
            envs = getattr(wrappers, name)(envs)
    observation, _ = envs.reset(seed=0)
    rows = []
    for actions in actions_for(envs, 12):
        observation, _, terminated, truncated, _ = envs.step(actions)
        rows.append(observation)
        if mode == "Disabled" and (terminated | truncated).any():
            envs.reset(options={"reset_mask": terminated | truncated})
    assert np.isfinite(rows).all()
    assert observation.dtype == (np.float64 if "Dtype" in names else np.float32)
    if "NormalizeObservation" in names:
        assert 0.5 < np.std(rows) < 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("before", "flags", "holds"),
    [
        ("", "", "xla_cpu_use_multi_output_fusion"),
        ("", "--xla_cpu_enable_fast_math=false", "--xla_cpu_enable_fast_math=false"),
        ("import jax; jax.devices()", "", ""),
    ],
    ids=["nothing said", "flags of one's own", "too late"],
)
def test_an_adapter_has_xla_compile_for_rods_where_nobody_said_how(
    before, flags, holds
):
    program = (
        f"{before}\nimport os, jaxrod.envs.gym as gym; gym.GymnasiumEnv('trivial')\n"
        "print(os.environ.get('XLA_FLAGS', ''))"
    )
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", program],
        env=os.environ | {"XLA_FLAGS": flags},
        capture_output=True,
        text=True,
        check=True,
    )
    found = done.stdout.strip()
    assert found == holds if flags or before else holds in found


def test_record_video_makes_a_film(tmp_path):
    pytest.importorskip("moviepy")
    env = GymnasiumEnv(Leaning(), render_mode="rgb_array")
    filmed = gymnasium.wrappers.RecordVideo(env, str(tmp_path / "films"), fps=10)
    filmed.reset(seed=0)
    while not any(filmed.step(np.ones(1, np.float32))[2:4]):
        pass
    filmed.close()
    [film] = (tmp_path / "films").glob("*.mp4")
    assert b"ftyp" in film.read_bytes()[:16]


def test_what_is_returned_belongs_to_the_caller():
    envs = GymnasiumVectorEnv("trivial", 2)
    before, _ = envs.reset(seed=0)
    kept = before.copy()
    actions = np.full((2, 1), 0.5, np.float32)
    expected = envs.step(actions)[0]
    np.testing.assert_array_equal(before, kept)
    envs.reset(seed=0)[0][:] = 100
    np.testing.assert_array_equal(envs.step(actions)[0], expected)


def test_steps_and_pictures_without_an_episode_are_refused():
    needed = pytest.raises(gymnasium.error.ResetNeeded, match="reset")
    env, envs = GymnasiumEnv("trivial"), GymnasiumVectorEnv("trivial", 2)
    with needed:
        env.step(np.zeros(1, np.float32))
    with needed:
        envs.step(np.zeros((2, 1), np.float32))
    drawn = {"render_mode": "rgb_array"}
    with needed:
        GymnasiumEnv("tracking", **drawn).render()
    with needed:
        GymnasiumVectorEnv("tracking", 2, **drawn).render()
    env.reset(seed=0)
    while not any(env.step(np.ones(1, np.float32))[2:4]):
        pass
    with pytest.raises(gymnasium.error.ResetNeeded, match="has ended"):
        env.step(np.zeros(1, np.float32))


def test_bad_input_is_refused_in_words():
    env, envs = GymnasiumEnv("trivial"), GymnasiumVectorEnv("trivial", 2)
    env.reset(seed=0)
    envs.reset(seed=0)
    with pytest.raises(ValueError, match=r"shape \(1,\), got \(2,\)"):
        env.step(np.zeros(2, np.float32))
    with pytest.raises(ValueError, match=r"shape \(2, 1\), got \(1,\)"):
        envs.step(np.zeros(1, np.float32))
    for either in (env, envs):
        with pytest.raises(ValueError, match=r"no options, got .*reset_mask"):
            either.reset(options={"reset_mask": np.ones(2, bool)})
    with pytest.raises(ValueError, match="None for trivial; got 'rgb_array'"):
        GymnasiumEnv("trivial", render_mode="rgb_array")
    with pytest.raises(
        ValueError, match="None or 'human' or 'rgb_array' for tracking; got 'x'"
    ):
        GymnasiumEnv("tracking", render_mode="x")
    with pytest.raises(ValueError, match="None or 'rgb_array' for tracking; got 'hum"):
        GymnasiumVectorEnv("tracking", 2, render_mode="human")
    with pytest.raises(ValueError, match=r"no options, got .*variant"):
        GymnasiumEnv(make("trivial"), variant="clean")
    with pytest.raises(ValueError, match="num_envs must be at least 1, got 0"):
        GymnasiumVectorEnv("trivial", 0)
    with pytest.warns(UserWarning, match="rgb_array"):
        assert env.render() is None
    with pytest.warns(UserWarning, match="rgb_array"):
        assert envs.render() is None


def test_every_task_has_an_id_for_each_variant_and_takes_its_options():
    assert len(ids()) == len(set(ids())) == 15
    for name in ids():
        spec = gymnasium.spec(name)
        assert spec.kwargs["variant"] in name and spec.kwargs["task"] in name
    env = gymnasium.make("jaxrod.envs.gym:jaxrod/structured-clean-v0", controls=4)
    assert env.action_space.shape == (4,)
    assert env.spec.from_json(env.spec.to_json()).kwargs["controls"] == 4


def test_specs_tell_how_long_an_episode_is():
    name = "jaxrod/tracking-clean-v0"
    assert gymnasium.make(name).spec.max_episode_steps == 7142
    env = gymnasium.make(name, episode_length=9)
    assert env.spec.max_episode_steps == 9
    assert gymnasium.make(name, max_episode_steps=5).spec.max_episode_steps == 5
    again = gymnasium.make(env.spec)
    assert again.spec.max_episode_steps == again.unwrapped.spec.max_episode_steps == 9
    # The registered spec is not changed, so a longer episode has no hidden limit.
    assert gymnasium.spec(name).max_episode_steps is None
    limit = gymnasium.wrappers.TimeLimit
    longer = gymnasium.make(name, episode_length=8000)
    assert longer.spec.max_episode_steps == 8000
    while longer is not longer.unwrapped:
        assert not isinstance(longer, limit)
        longer = longer.env
    assert longer.unwrapped._batch.env.episode_length == 8000
    bare = GymnasiumEnv("trivial")
    assert bare.spec is None
    bare.spec = gymnasium.spec(name)
    assert gymnasium.spec(name).max_episode_steps is None


@pytest.mark.parametrize(
    ("given", "length"),
    [
        ({}, 7142),
        ({"max_episode_steps": 3}, 3),
        ({"episode_length": 4}, 4),
        ({"max_episode_steps": 3, "episode_length": 4}, 3),
        ({"max_episode_steps": 8000}, 8000),
    ],
)
def test_batches_take_the_limit_by_the_name_of_gymnasium(given, length):
    envs = gymnasium.make_vec("jaxrod/tracking-clean-v0", num_envs=2, **given)
    assert envs.spec.max_episode_steps == length
    assert envs._batch.env.episode_length == length


@pytest.mark.parametrize(
    ("period", "fps", "steps"),
    [(1.4e-3, 30, 24), (0.1, 10, 1), (0.05, 20, 1), (1 / 30, 30, 1), (3.0, 1, 1)],
)
def test_films_in_real_time_have_a_rate_that_players_show(period, fps, steps):
    found = film_metadata(period, ["rgb_array"])
    assert (found["render_fps"], found["steps_per_frame"]) == (fps, steps)
    if period < 1:
        assert found["render_fps"] * steps * period == pytest.approx(1, rel=0.01)


@pytest.mark.slow
def test_a_window_shows_the_pictures_of_a_film():
    env = GymnasiumEnv(Leaning(control_period=0.016), render_mode="human")
    twin = GymnasiumEnv(Leaning(control_period=0.016), render_mode="rgb_array")
    assert env.metadata["steps_per_frame"] == 3
    twin.reset(seed=0)
    pictures = [twin.render()]
    with pytest.warns(UserWarning, match="has no window here, its backend is '[Aa]gg'"):
        env.reset(seed=0)
    [number] = pyplot.get_fignums()
    shown = pyplot.figure(number).images[0]
    for _ in range(3):
        # A picture is due at the start and after three control steps.
        np.testing.assert_array_equal(shown.get_array(), pictures[0])
        env.step(np.ones(1, np.float32))
        twin.step(np.ones(1, np.float32))
        assert env.render() is None
    np.testing.assert_array_equal(shown.get_array(), twin.render())
    assert np.any(twin.render() != pictures[0])
    env.close()
    assert not pyplot.get_fignums()


@pytest.mark.filterwarnings("ignore:.*has no window here:UserWarning")
def test_a_window_waits_for_real_time():
    window, picture = _Window("tests"), np.zeros((10, 10, 3), np.uint8)
    window.show(picture, 0.5)
    began = time.monotonic()
    window.show(picture, 0.5)
    assert time.monotonic() - began > 0.4
    window.close()


def test_parameters_and_environments_may_be_ones_own():
    env = make("trivial", episode_length=3)
    params = type(env.default_params())(stride=0.0)
    envs = GymnasiumVectorEnv(env, 2, params=params)
    first, _ = envs.reset(seed=0)
    for step in range(3):
        *_, truncated, infos = envs.step(np.ones((2, 1), np.float32))
        assert truncated.tolist() == [step == 2] * 2
    np.testing.assert_array_equal(np.stack(infos["final_obs"]), first)


def test_without_gymnasium_a_sentence_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "jaxrod.envs.gym")
    with pytest.raises(ModuleNotFoundError, match=r'pip install "jaxrod\[gym\]"'):
        importlib.import_module("jaxrod.envs.gym")


@pytest.mark.slow
def test_the_checker_has_nothing_to_say_about_what_can_be_drawn():
    gymnasium.register("tests/Leaning-v0", GymnasiumEnv, kwargs={"task": Leaning()})
    try:
        with pytest.warns(UserWarning, match="has no window here"):
            check_env(gymnasium.make("tests/Leaning-v0").unwrapped)
    finally:
        del gymnasium.registry["tests/Leaning-v0"]


@pytest.mark.slow
def test_pictures_are_those_of_the_running_episode():
    env = GymnasiumEnv(Leaning(), render_mode="rgb_array")
    envs = GymnasiumVectorEnv(Leaning(), 2, render_mode="rgb_array")
    env.reset(seed=0)
    envs.reset(seed=0)
    pictures = []
    for _ in range(3):
        pictures.append(env.render())
        env.step(np.ones(1, np.float32))
    assert all(p.shape == (480, 640, 3) and p.dtype == np.uint8 for p in pictures)
    assert np.any(pictures[0] != pictures[1])
    # When the episode has ended its last moment but one is shown, not the next start.
    np.testing.assert_array_equal(env.render(), pictures[2])
    env.reset()
    assert np.any(env.render() != pictures[2])
    first, second = envs.render()
    np.testing.assert_array_equal(first, pictures[0])
    assert np.any(first != second)


# One program serves both tests of an id.
SHORT = {"episode_length": 4}


@pytest.mark.slow
@EVERY_ID
@pytest.mark.filterwarnings("ignore:.*has no window here")
def test_the_checker_has_nothing_to_say_about_any_id(name):
    check_env(gymnasium.make(name, **SHORT).unwrapped)


@pytest.mark.slow
@EVERY_ID
def test_every_id_is_the_functional_environment_to_rounding(name):
    env = gymnasium.make(name, **SHORT).unwrapped
    envs = gymnasium.make_vec(name, num_envs=1, **SHORT)
    assert envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    check_one_is_a_batch_of_one(env, envs, 10)
    task, variant = envs.spec.kwargs["task"], envs.spec.kwargs["variant"]
    # Packed, a program is fused otherwise: in most tasks to the same numbers.
    rounding = 5e-5
    _, truncated = check_same(make(task, variant=variant, **SHORT), envs, 6, rounding)
    assert truncated > 0


@pytest.mark.parametrize("shape", [(), (3,), (1, 1)])
def test_an_action_of_another_shape_is_refused_as_it_was_given(shape):
    one = GymnasiumEnv(Trivial())
    one.reset(seed=0)
    words = re.escape(f"action must have shape {one.action_space.shape}, got {shape}")
    with pytest.raises(ValueError, match=words):
        one.step(np.zeros(shape, np.float32))
    many = GymnasiumVectorEnv(Trivial(), num_envs=2)
    many.reset(seed=0)
    words = re.escape(f"actions must have shape {many.action_space.shape}, got {shape}")
    with pytest.raises(ValueError, match=words):
        many.step(np.zeros(shape, np.float32))

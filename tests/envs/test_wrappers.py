"""The contracts of the self-restarting batch."""

from __future__ import annotations

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.envs import VectorEnvironment, make
from jaxrod.envs.trivial import Trivial
from jaxrod.envs.wrappers import EnvironmentWrapper


def run(batch, state, actions, params):
    def step(state, action):
        return batch.step(state, action, params)

    return jax.jit(lambda s, a: jax.lax.scan(step, s, a))(state, actions)


def actions_for(steps, num_envs, scale=1.0):
    key = jax.random.key(7)
    return scale * jax.random.uniform(key, (steps, num_envs, 1), minval=-1, maxval=1)


@pytest.mark.parametrize("shape", [(1,), (3, 1), (4, 2), (4,)])
def test_actions_of_another_shape_are_refused_as_they_were_given(shape):
    batch = VectorEnvironment(Trivial())
    params = batch.env.default_params()
    state = batch.reset(jax.random.key(0), 4, params)
    words = re.escape(f"actions must have shape (4, 1), got {shape}")
    with pytest.raises(ValueError, match=words):
        jax.eval_shape(batch.step, state, jnp.zeros(shape), params)


@dataclasses.dataclass(frozen=True)
class Breaking(Trivial):
    """Returns not-a-number rewards and observations at its third step."""

    def step(self, key, state, action, params):
        observation, state, reward, terminated, truncated, info = super().step(
            key, state, action, params
        )
        broken = jnp.where(state.steps == 3, jnp.nan, 0.0)
        return (
            observation + broken,
            state,
            reward + broken,
            terminated,
            truncated,
            info,
        )


@pytest.mark.slow
def test_batch_equals_environments_run_one_by_one():
    env = Trivial(episode_length=6)
    params = env.default_params()
    batch = VectorEnvironment(env)
    actions = actions_for(20, 3)
    start = batch.reset(jax.random.key(0), 3, params)
    _, together = run(batch, start, actions, params)
    for i in range(3):
        one = jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], start)
        _, alone = run(batch, one, actions[:, i : i + 1], params)
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(a[:, i : i + 1], b, rtol=1e-6, atol=1e-7)


def test_restart_is_fresh_and_final_observation_is_the_one_before():
    env = Trivial(episode_length=5)
    params = env.default_params()
    batch = VectorEnvironment(env)
    state = batch.reset(jax.random.key(1), 4, params)
    first = state.observation
    _, steps = run(batch, state, jnp.ones((15, 4, 1)) * 0.5, params)
    ends = np.flatnonzero(np.asarray(steps.truncated[:, 0]))
    np.testing.assert_array_equal(ends, [4, 9, 14])
    starts = [np.asarray(first)] + [np.asarray(steps.observation[t]) for t in ends]
    for begin, end in zip(starts[:-1], ends, strict=True):
        # Five half strides from wherever the episode began.
        np.testing.assert_allclose(
            steps.final_observation[end], begin + 5 * 0.5 * 0.2, rtol=1e-5, atol=1e-6
        )
    drawn = np.concatenate(starts)
    assert len(np.unique(drawn)) == drawn.size
    between = ~np.asarray(steps.truncated)
    np.testing.assert_array_equal(
        np.asarray(steps.observation)[between],
        np.asarray(steps.final_observation)[between],
    )


def test_episode_records_hold_return_and_length():
    env = Trivial(episode_length=20)
    params = env.default_params()
    batch = VectorEnvironment(env)
    state = batch.reset(jax.random.key(2), 5, params)
    _, steps = run(batch, state, actions_for(60, 5) + 0.8, params)
    rewards = np.asarray(steps.reward)
    done = np.asarray(steps.terminated | steps.truncated)
    np.testing.assert_array_equal(np.asarray(steps.episodes.finished), done)
    assert np.asarray(steps.terminated).any()
    for i in range(5):
        begin = 0
        for end in np.flatnonzero(done[:, i]):
            assert steps.episodes.length[end, i] == end + 1 - begin
            np.testing.assert_allclose(
                steps.episodes.episode_return[end, i],
                rewards[begin : end + 1, i].sum(),
                rtol=1e-5,
                atol=1e-5,
            )
            begin = end + 1


@pytest.mark.slow
def test_spread_phases_end_early_once_and_do_not_count():
    env = Trivial(episode_length=10)
    params = env.default_params()
    batch = VectorEnvironment(env)
    state = batch.reset(jax.random.key(3), 200, params, spread_phases=True)
    phases = np.asarray(state.elapsed)
    assert set(phases) == set(range(10))
    _, steps = run(batch, state, jnp.zeros((20, 200, 1)), params)
    truncated = np.asarray(steps.truncated)
    finished = np.asarray(steps.episodes.finished)
    for i, phase in enumerate(phases):
        ends = np.flatnonzero(truncated[:, i])
        assert ends[0] == 10 - phase - 1
        assert np.all(np.diff(ends) == 10)
        counted = ends if phase == 0 else ends[1:]
        np.testing.assert_array_equal(np.flatnonzero(finished[:, i]), counted)
    assert np.all(np.asarray(steps.episodes.length)[finished] == 10)


def test_broken_numbers_are_flagged_truncated_and_do_not_spread():
    env = Breaking(episode_length=10)
    params = env.default_params()
    batch = VectorEnvironment(env)
    state = batch.reset(jax.random.key(4), 2, params)
    _, steps = run(batch, state, actions_for(6, 2), params)
    assert np.all(np.isfinite(steps.reward))
    assert np.all(np.isfinite(steps.observation))
    assert np.all(np.isfinite(steps.final_observation))
    expected = [[t % 3 == 2] * 2 for t in range(6)]
    np.testing.assert_array_equal(steps.episodes.flagged, expected)
    np.testing.assert_array_equal(steps.truncated, expected)
    assert not np.asarray(steps.terminated).any()


def test_restart_is_computed_only_when_an_episode_ends():
    calls = []

    @dataclasses.dataclass(frozen=True)
    class Counting(Trivial):
        def reset(self, key, params):
            jax.debug.callback(lambda: calls.append(1))
            return super().reset(key, params)

    env = Counting(episode_length=5)
    batch = VectorEnvironment(env)
    params = env.default_params()
    state = batch.reset(jax.random.key(0), 2, params)
    jax.effects_barrier()
    made = len(calls)
    state, _ = run(batch, state, jnp.zeros((4, 2, 1)), params)
    jax.effects_barrier()
    assert len(calls) == made
    run(batch, state, jnp.zeros((1, 2, 1)), params)
    jax.effects_barrier()
    assert len(calls) > made


def test_empty_batch_is_refused():
    env = Trivial()
    with pytest.raises(ValueError, match="num_envs must be at least 1, got 0"):
        VectorEnvironment(env).reset(jax.random.key(0), 0, env.default_params())


@pytest.mark.slow
@pytest.mark.parametrize(
    "task",
    [
        "tracking",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("reaching", "structured", "unstructured")
        ),
    ],
)
def test_a_bad_arm_in_4096_is_flagged_and_the_others_are_the_same_to_the_last_bit(task):
    bad, num_envs = 77, 4096
    env = make(task, variant="clean", episode_length=50)
    params = env.default_params()
    batch = VectorEnvironment(env)
    actions = jax.random.uniform(
        jax.random.key(1), (3, num_envs, env.action_size), minval=-1, maxval=1
    )

    @jax.jit
    def play(fast):
        state = batch.reset(jax.random.key(0), num_envs, params)
        velocities = state.states.arm.velocities.at[bad, 0, -1].set(fast)
        arm = dataclasses.replace(state.states.arm, velocities=velocities)
        states = dataclasses.replace(state.states, arm=arm)
        state = dataclasses.replace(state, states=states)
        return jax.lax.scan(lambda s, a: batch.step(s, a, params), state, actions)

    sound_end, sound = play(0.0)
    end, steps = play(2000.0)
    others = np.arange(num_envs) != bad
    assert not np.asarray(sound.info["flagged"]).any()
    np.testing.assert_array_equal(np.flatnonzero(steps.info["flagged"][0]), [bad])
    np.testing.assert_array_equal(np.flatnonzero(steps.truncated[0]), [bad])
    assert not np.asarray(steps.terminated).any()
    assert np.all(np.isfinite(steps.final_observation))
    keyless = [dataclasses.replace(s, keys=None) for s in (sound_end, end)]
    for a, b in zip(*map(jax.tree.leaves, keyless), strict=True):
        np.testing.assert_array_equal(a[others], b[others])
    for a, b in zip(jax.tree.leaves(sound), jax.tree.leaves(steps), strict=True):
        np.testing.assert_array_equal(a[:, others], b[:, others])


def test_what_an_environment_breaks_is_always_among_its_scalars():
    env = Breaking(episode_length=10)
    params = env.default_params()
    batch = VectorEnvironment(env)
    state = batch.reset(jax.random.key(4), 2, params)
    _, steps = run(batch, state, actions_for(6, 2), params)
    np.testing.assert_array_equal(steps.info["flagged"], steps.episodes.flagged)


def test_episodes_that_start_in_mid_course_end_earlier_and_do_not_count():
    env = Trivial(episode_length=10)
    batch, params = VectorEnvironment(env), env.default_params()
    still = jnp.zeros((2, env.action_size))
    state = batch.reset(jax.random.key(0), 2, params, phase=7)
    step = jax.jit(batch.step)
    lengths, phase, since = [], 6, 0
    for _ in range(3 + 4 + 10):
        state, outcome = step(state, still, params, restart_phase=phase)
        since += 1
        if bool(outcome.truncated[0]):
            lengths.append((since, bool(outcome.episodes.finished[0])))
            # What starts from now on is whole.
            since, phase = 0, 0 if len(lengths) else phase
    assert lengths == [(3, False), (4, False), (10, True)]


@pytest.mark.slow
def test_first_episodes_are_spread_over_what_is_left_of_them():
    env = Trivial(episode_length=10)
    state = VectorEnvironment(env).reset(
        jax.random.key(0), 64, env.default_params(), spread_phases=True, phase=7
    )
    assert set(np.asarray(state.elapsed).tolist()) == {7, 8, 9}
    assert np.asarray(state.partial).all()


STRIDES = jnp.array([0.1, 0.2, 0.3])


@pytest.mark.slow
def test_parameters_of_a_batch_equal_separate_batches():
    env = Trivial(episode_length=4)
    params = dataclasses.replace(env.default_params(), stride=STRIDES)
    batch = VectorEnvironment(env, batched=("stride",))
    actions = actions_for(9, 3)
    start = batch.reset(jax.random.key(0), 3, params)
    _, together = run(batch, start, actions, params)
    for i in range(3):
        one = jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], start)
        own = dataclasses.replace(params, stride=STRIDES[i])
        _, alone = run(VectorEnvironment(env), one, actions[:, i : i + 1], own)
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(a[:, i : i + 1], b, rtol=1e-6, atol=1e-7)


@pytest.mark.slow
def test_a_path_batches_everything_below_it():
    task = make("tracking")
    params = task.default_params()
    target = jax.tree.map(lambda leaf: jnp.stack([leaf, 2 * leaf]), params.target)
    batch = VectorEnvironment(task, batched=("target", "bonus.near"))
    near = dataclasses.replace(params.bonus, near=jnp.array([0.1, 0.2]))
    params = dataclasses.replace(params, target=target, bonus=near)
    state = batch.reset(jax.random.key(0), 2, params)
    speeds = jnp.linalg.norm(state.states.target.velocity, axis=-1)
    np.testing.assert_allclose(speeds, [0.5, 1.0], rtol=1e-6)


def test_a_batch_axis_that_was_not_named_is_refused_by_name():
    env = Trivial()
    params = dataclasses.replace(env.default_params(), stride=STRIDES)
    batch = VectorEnvironment(env)
    state = batch.reset(jax.random.key(0), 3, params)  # It does not use the stride.
    words = r"stride: .* first axis of 3, .*VectorEnvironment\(env, batched=\('stride',"
    with pytest.raises(ValueError, match=words):
        batch.step(state, jnp.zeros((3, 1)), params)
    tracking = make("tracking")
    params = tracking.default_params()
    wide = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), params.target)
    with pytest.raises(ValueError, match=r"target.lower, target.upper, .* axis of 3"):
        VectorEnvironment(tracking).reset(
            jax.random.key(0), 3, dataclasses.replace(params, target=wide)
        )


def test_batched_paths_are_a_sequence_of_strings():
    env = make("trivial")
    assert VectorEnvironment(env, batched=["stride"]).batched == ("stride",)
    with pytest.raises(ValueError, match=r"such as \('stride',\), got 'stride'"):
        VectorEnvironment(env, batched="stride")


def test_batched_parameters_that_do_not_fit_are_refused():
    env = Trivial()
    params = dataclasses.replace(env.default_params(), stride=STRIDES)
    with pytest.raises(ValueError, match=r"'stride', .* axis of 4 .*, got shape .3,"):
        VectorEnvironment(env, ("stride",)).reset(jax.random.key(0), 4, params)
    with pytest.raises(ValueError, match=r"names 'strid'; the nearest .* are stride"):
        VectorEnvironment(env, ("strid",)).reset(jax.random.key(0), 3, params)


@pytest.mark.parametrize("of", ["reward", "truncated", "info"])
def test_a_batch_axis_that_only_scalars_see_is_refused_by_name(of):
    @dataclasses.dataclass(frozen=True)
    class Scaled(EnvironmentWrapper):
        """The task with a parameter that acts on one of its scalars alone."""

        env: Trivial

        def default_params(self):
            return {"task": self.env.default_params(), "gain": jnp.ones(())}

        def reset(self, key, params):
            return self.env.reset(key, params["task"])

        def step(self, key, state, action, params):
            *made, info = self.env.step(key, state, action, params["task"])
            gain = params["gain"]
            made[2] = made[2] * (gain if of == "reward" else 1)
            made[4] = made[4] | ((gain > 2) if of == "truncated" else False)
            return (*made, info | ({"gain": gain} if of == "info" else {}))

    batch = VectorEnvironment(Scaled(Trivial()))
    params = batch.env.default_params() | {"gain": jnp.ones(3)}
    with pytest.raises(ValueError, match=r"gain: these parameters have a first axis"):
        state = batch.reset(jax.random.key(0), 3, params)
        batch.step(state, jnp.zeros((3, 1)), params)

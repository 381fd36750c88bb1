"""Randomised environments: parameters, actuators and sensors that vary and fail."""

import math
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxrod import control, envs
from jaxrod.envs import Channel
from jaxrod.envs.gym import GymnasiumEnv
from jaxrod.envs.registry import origin_of
from jaxrod.envs.trivial import Trivial

ZERO = {"dropout": 0.1, "delay": (0, 2), "lag": 1.0, "rate": 0.5, "saturation": 0.5}
"""Faults that `nothing` turns off again, so that their programs are compiled."""
SMALL = {
    "catheter": {},
    "following": {},
    "gripper": {},
    "insert": {},
    "lift": {},
    "octopus": {},
    "reaching": {"n_elements": 10, "substeps": 2},
    "snake": {},
    "structured": {"n_elements": 10, "substeps": 2},
    "tracking": {"n_elements": 10, "substeps": 2},
    "trivial": {},
    "unstructured": {"n_elements": 10, "substeps": 2},
}
DRAWS = 4096


@dataclass(frozen=True)
class Watched(Trivial):
    """The trivial task, whose observation also has eight entries that change."""

    observation_size: int = 9
    observation_channels = (
        Channel(1, "position", "m"),
        Channel(6, "markers: x of each, then y", "m"),
        Channel(2, "clock", "1"),
    )

    def observe(self, state):
        rest = jnp.sin(state.steps + jnp.arange(8.0))
        return jnp.concatenate([state.position[None], rest])

    def reset(self, key, params):
        _, state = super().reset(key, params)
        return self.observe(state), state

    def step(self, key, state, action, params):
        _, state, *rest = super().step(key, state, action, params)
        return self.observe(state), state, *rest


def nothing(params):
    """Parameters of the same structure, with ranges of zero width and no faults."""
    off = {"delay": 0.0, "lag": 0.0, "rate": 2.0, "saturation": 1.0}
    return replace(
        params,
        noise=None if params.noise is None else 0 * params.noise,
        dropout=None if params.dropout is None else 0 * params.dropout,
        actuator={k: jnp.full(2, off[k]) for k in params.actuator},
    )


def randomised(env=None, **options):
    env = envs.Randomised(env or Trivial(), envs.Randomisation(**options))
    return env, env.default_params()


@partial(jax.jit, static_argnums=0)
def played(env, key, params, actions):
    def step(state, now):
        observation, state, *rest = env.step(
            jax.random.fold_in(key, now[0]), state, now[1], params
        )
        return state, (observation, state, *rest)

    observation, state = env.reset(key, params)
    steps = jnp.arange(1, len(actions) + 1), actions
    return observation, jax.lax.scan(step, state, steps)[1]


def play(env, params, actions, seed=0):
    """All results of an episode: observations, states, rewards, flags, info."""
    return played(env, jax.random.key(seed), params, actions)


def actions_of(env, steps, seed=5):
    shape = (steps, env.action_size)
    return jax.random.uniform(jax.random.key(seed), shape, minval=-1.0)


def same(a, b):
    a, b = jax.tree.leaves(a), jax.tree.leaves(b)
    assert len(a) == len(b)
    for one, other in zip(a, b, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.slow
@pytest.mark.default_precision
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(
            name,
            marks=[] if name == "trivial" else pytest.mark.slow,
        )
        for name in envs.names()
    ],
)
def test_zero_randomisation_is_the_task_to_the_last_bit(name):
    plain = envs.make(name, **SMALL[name])
    nominal = plain.default_params()
    leaves = jax.tree.leaves_with_path(nominal)
    paths = [jax.tree_util.keystr(p, simple=True, separator=".") for p, _ in leaves]
    kinds = ({"uniform": (1, 1)}, {"log_uniform": (1, 1)}, {"normal": (1, 0)})
    rules = {p: kinds[k % 3] | {"scaled": True} for k, p in enumerate(paths)}
    env, params = randomised(plain, parameters=rules, noise=0.1, **ZERO)
    actions = actions_of(plain, 3)
    observation, (seen, states, *rest) = play(env, nothing(params), actions)
    start, (plainly, plain_states, *plain_rest) = play(plain, nominal, actions)
    same((observation, seen, rest), (start, plainly, plain_rest))
    same(states.task, plain_states)
    # The comparison has teeth: with the faults on, the results differ.
    assert np.any(np.asarray(play(env, params, actions)[1][0]) != plainly)


def test_past_actions_are_those_that_were_chosen_so_long_ago():
    """With a delay of as many steps, the last of them is the one that now acts."""
    env, params = randomised(
        Watched(), delay=(2, 2), saturation=(0.5, 0.5), past_actions=(1, 3)
    )
    actions = 2 * actions_of(env, 12)
    start, (seen, _, *rest) = play(env, params, actions)
    plain, plain_params = randomised(Watched(), delay=(2, 2), saturation=(0.5, 0.5))
    plain_start, (plainly, _, *plain_rest) = play(plain, plain_params, actions)
    same((seen[:, :9], rest), (plainly, plain_rest))
    np.testing.assert_array_equal(start, jnp.concatenate([plain_start, jnp.zeros(2)]))
    chosen = jnp.concatenate([jnp.zeros((2, 1)), jnp.clip(actions, -1, 1)])
    np.testing.assert_array_equal(seen[:, 9:10], chosen[2:])
    np.testing.assert_array_equal(seen[:, 10:], chosen[:-2])
    assert sum(c.size for c in env.observation_channels) == env.observation_size == 11


def test_a_delayed_action_is_a_shifted_one():
    env, params = randomised(Trivial(), delay=(3, 3))
    actions = actions_of(env, 12)
    _, (seen, _, reward, *_) = play(env, params, actions)
    shifted = jnp.concatenate([jnp.zeros((3, 1)), actions[:-3]])
    _, (plainly, _, plain_reward, *_) = play(env.env, params.task, shifted)
    same((seen, reward), (plainly, plain_reward))


@pytest.mark.slow
def test_delays_are_whole_uniform_and_at_most_the_largest():
    env, params = randomised(delay=(0, 3))
    keys = jax.random.split(jax.random.key(1), DRAWS)
    _, state = jax.vmap(env.reset, in_axes=(0, None))(keys, params)
    values, counts = np.unique(state.actuator["delay"], return_counts=True)
    np.testing.assert_array_equal(values, [0, 1, 2, 3])
    assert stats.chisquare(counts).pvalue > 1e-3
    beyond = replace(params, actuator={"delay": jnp.array([5.0, 9.0])})
    assert float(env.reset(keys[0], beyond)[1].actuator["delay"]) == 3


def test_the_lag_follows_the_exponential():
    env, params = randomised(lag=2.5)
    _, (_, states, *_) = play(env, params, jnp.ones((15, 1)))
    steps = np.arange(1, 16)
    np.testing.assert_allclose(states.position[:, 0], 1 - np.exp(-steps / 2.5))


def test_a_lag_in_seconds_is_one_in_control_steps():
    task = envs.make("tracking", **SMALL["tracking"])
    env, params = randomised(task, lag_seconds=(0.0014, 0.0028))
    np.testing.assert_allclose(params.actuator["lag"], [1.0, 2.0])
    assert env.control_period == task.control_period


def test_saturation_and_rate_bound_the_action():
    env, params = randomised(saturation=0.8, rate=0.3)
    _, (_, states, *_) = play(env, params, jnp.ones((4, 1)))
    np.testing.assert_allclose(states.position[:, 0], [0.3, 0.6, 0.8, 0.8])
    env, params = randomised(saturation=0.8)
    _, (seen, states, *_) = play(env, params, jnp.ones((2, 1)))
    np.testing.assert_allclose(seen[1, 0] - seen[0, 0], 0.8 * 0.2)


LAWS = {
    "uniform": ((0.1, 0.3), stats.uniform(0.1, 0.2)),
    "log_uniform": ((0.05, 0.8), stats.loguniform(0.05, 0.8)),
    "normal": ((0.2, 0.03), stats.norm(0.2, 0.03)),
    "log_normal": ((0.2, 0.3), stats.lognorm(0.3, scale=0.2)),
}


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("kind", LAWS)
@pytest.mark.parametrize("scaled", [False, True])
def test_draws_have_the_stated_distribution(scaled, kind):
    numbers, law = LAWS[kind]
    env, params = randomised(parameters={"stride": {kind: numbers, "scaled": scaled}})

    def drawn(key):
        state = env.reset(key, params)[1]
        return env.task_params(state, params).stride

    keys = jax.random.split(jax.random.key(2), DRAWS)
    values = np.asarray(jax.jit(jax.vmap(drawn))(keys)) / (0.2 if scaled else 1)
    assert stats.kstest(values, law.cdf).pvalue > 1e-3
    assert abs(values.mean() - law.mean()) < 4 * law.std() / math.sqrt(DRAWS)
    assert abs(values.std() / law.std() - 1) < 0.06


def test_paths_share_a_draw_and_entries_of_arrays_have_their_own():
    task = envs.make("tracking", **SMALL["tracking"])
    rules = {
        "arm.rod.linear_density,arm.rod.rotary_inertia": {
            "uniform": (0.5, 2),
            "scaled": True,
        },
        "target.lower": {"uniform": ([-1, -2, -3], [0, 0, 0])},
    }
    env, params = randomised(task, parameters=rules)
    state = jax.jit(env.reset)(jax.random.key(0), params)[1]
    now, nominal = env.task_params(state, params), params.task
    factors = now.arm.rod.linear_density / nominal.arm.rod.linear_density
    inertias = now.arm.rod.rotary_inertia / nominal.arm.rod.rotary_inertia
    np.testing.assert_allclose(factors, factors[0], rtol=1e-6)
    np.testing.assert_allclose(inertias, factors[0], rtol=1e-6)
    assert len(set(np.asarray(now.target.lower / jnp.array([1, 2, 3])).tolist())) == 3


def test_draws_stay_during_an_episode_and_change_at_the_next():
    env = Trivial(episode_length=4)
    env, params = randomised(env, parameters={"stride": {"uniform": (0.1, 0.3)}})
    batch = envs.VectorEnvironment(env)
    state = batch.reset(jax.random.key(0), 2, params)
    step, strides = jax.jit(batch.step), []
    for _ in range(8):
        strides.append(np.asarray(state.states.drawn["stride"]))
        state, _ = step(state, jnp.zeros((2, 1)), params)
    first, second = np.split(np.stack(strides), 2)
    assert np.all(first == first[0]) and np.all(second == second[0])
    assert len({*first[0], *second[0]}) == 4


def test_noise_is_unbiased_and_has_the_stated_deviation():
    levels = {"markers": 0.02, "clock": 0.1, "0": 0.3}
    env, params = randomised(Watched(), noise=levels)

    def error(key):
        observation, state = env.reset(key, params)
        return observation - env.env.observe(state.task)

    keys = jax.random.split(jax.random.key(3), DRAWS)
    errors = np.asarray(jax.jit(jax.vmap(error))(keys))
    sds = np.repeat([0.3, 0.02, 0.1], [1, 6, 2])
    assert np.all(np.abs(errors.mean(0)) <= 5 * sds / math.sqrt(DRAWS))
    np.testing.assert_allclose(errors.std(0), sds, rtol=0.06)
    assert np.all(np.abs(np.corrcoef(errors.T) - np.eye(9)) < 0.07)
    for column in (0, 3, 8):
        assert stats.kstest(errors[:, column] / sds[column], "norm").pvalue > 1e-3


def test_noise_of_a_step_is_independent_of_that_of_the_last():
    env, params = randomised(Watched(episode_length=DRAWS), noise=0.1)
    _, (seen, states, *_) = play(env, params, jnp.zeros((1000, 1)))
    errors = np.asarray(seen - jax.vmap(env.env.observe)(states.task))
    np.testing.assert_allclose(errors.std(0), 0.1, rtol=0.1)
    assert abs(np.corrcoef(errors[1:, 0], errors[:-1, 0])[0, 1]) < 0.13


def test_dropped_entries_hold_what_was_last_seen():
    dropout = {"1, 4-5": 0.5, "clock": 0.3}
    env, params = randomised(Watched(), dropout=dropout, flags=True)
    assert env.observation_size == 9 + 2
    assert sum(c.size for c in env.observation_channels) == env.observation_size
    envs.check_environment(env)
    steps = 400
    start, (seen, states, *_) = play(env, params, jnp.zeros((steps, 1)))
    true = jax.vmap(env.env.observe)(states.task)
    shown = np.concatenate([np.asarray(start)[None], seen])
    assert np.all(shown[0, 9:] == 1)
    flags = shown[1:, 9:].astype(bool)
    keys = np.array([2, 0, 2, 2, 0, 0, 2, 1, 1])
    mask = np.concatenate([flags, np.ones((steps, 1), bool)], axis=1)[:, keys]
    expected = np.where(mask, true, shown[:-1, :9])
    np.testing.assert_allclose(shown[1:, :9], expected, rtol=1e-6, atol=1e-7)
    for key, chance in enumerate(dropout.values()):
        lost = steps - flags[:, key].sum()
        assert stats.binomtest(int(lost), steps, chance).pvalue > 1e-3
    together = np.mean(flags[:, 0] & flags[:, 1])
    assert abs(together - 0.5 * 0.7) < 0.1


def test_one_chance_drops_every_entry_independently():
    env, params = randomised(Watched(), dropout=0.5, flags=True)
    assert env.observation_size == 2 * 9
    _, (seen, *_) = play(env, params, jnp.zeros((400, 1)))
    flags = np.asarray(seen[:, 9:])
    assert abs(flags.mean() - 0.5) < 0.05
    assert np.all(np.abs(np.corrcoef(flags.T) - np.eye(9)) < 0.25)


EVERYTHING = {
    "parameters": {"stride": {"log_uniform": (0.5, 2), "scaled": True}},
    "noise": 0.01,
    "dropout": 0.2,
    "delay": (0, 2),
    "lag": (0, 2),
    "saturation": (0.8, 1),
    "rate": (0.5, 1),
}


@pytest.mark.slow
def test_a_batch_equals_a_loop():
    env, params = randomised(**EVERYTHING)
    actions = actions_of(env, 12)
    keys = jax.random.split(jax.random.key(0), 3)
    together = jax.vmap(lambda key: played(env, key, params, actions))(keys)
    for i, key in enumerate(keys):
        alone = played(env, key, params, actions)
        for a, b in zip(*map(jax.tree.leaves, (together, alone)), strict=True):
            np.testing.assert_allclose(a[i], b, rtol=1e-6, atol=1e-7)


def test_other_numbers_recompile_nothing():
    env, params = randomised(**EVERYTHING)
    traced = []

    @jax.jit
    def run(key, params):
        traced.append(1)
        _, state = env.reset(key, params)
        return env.step(key, state, jnp.ones(1), params)[0]

    first = run(jax.random.key(0), params)
    other = jax.tree.map(lambda leaf: 1.1 * leaf, params)
    assert run(jax.random.key(0), other) != first
    assert len(traced) == 1


@pytest.mark.default_precision
def test_gradients_through_a_rollout_are_finite_and_right():
    # No rate limit and drop-out, whose clips have kinks near any point.
    options = {k: v for k, v in EVERYTHING.items() if k not in ("rate", "dropout")}
    env, params = randomised(Trivial(episode_length=9), **options)

    def score(params, gain):
        start = env.reset(jax.random.key(4), params)
        return envs.rollout(env, start, lambda x: -gain * x, params, 8).reward.sum()

    with jax.enable_x64(True):
        params = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), params)
        slopes, by_gain = jax.jit(jax.grad(score, (0, 1)))(params, 1.2)
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(slopes))
        assert np.any(slopes.ranges["stride"]) and np.any(slopes.actuator["lag"])
        value = jax.jit(score)
        ends = [float(value(params, 1.2 + h)) for h in (-1e-6, 1e-6)]
        assert float(by_gain) == pytest.approx((ends[1] - ends[0]) / 2e-6, rel=1e-5)
    # A lag that vanishes has no infinite slope.
    env, params = randomised(lag=(0, 1))
    off = replace(params, actuator={"lag": jnp.zeros(2)})
    slope = jax.jit(jax.grad(score))(off, 1.2)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(slope))


def test_privileged_is_what_sensors_do_not_show():
    env, params = randomised(
        parameters={"stride": {"uniform": (0.1, 0.3)}},
        noise=0.5,
        dropout=0.3,
        delay=(1, 2),
        lag=0.7,
    )
    observation, state = env.reset(jax.random.key(0), params)
    actions = jnp.linspace(-1, 1, 6)[:, None]
    for key, action in zip(
        jax.random.split(jax.random.key(1), 6), actions, strict=True
    ):
        observation, state, *_ = env.step(key, state, action, params)
        hidden = env.privileged_observation(state, params)
        np.testing.assert_array_equal(hidden[0], state.task.position)
        assert hidden[0] != observation[0]
        np.testing.assert_array_equal(hidden[1], state.drawn["stride"])
        np.testing.assert_array_equal(hidden[2], state.actuator["delay"])
        np.testing.assert_array_equal(hidden[4], action[0])
        np.testing.assert_array_equal(hidden[6:], state.position)
    plain, params = randomised()
    observation, state = plain.reset(jax.random.key(0), params)
    hidden = plain.privileged_observation(state, params)
    np.testing.assert_array_equal(hidden, observation)


def test_a_planner_sees_the_drawn_parameters_and_the_delay():
    env, params = randomised(
        parameters={"stride": {"uniform": (0.1, 0.3)}},
        delay=(1, 1),
        lag=0.7,
        past_actions=[2],
    )
    _, state = env.reset(jax.random.key(0), params)
    action, moved = jnp.array([0.8]), state
    for _ in range(3):
        _, moved, *_ = env.step(jax.random.key(1), moved, action, params)
    foreseen = env.predict(state, action, params, 3)
    moved = replace(moved, clean=foreseen.clean)  # What is predicted is not observed.
    for a, b in zip(*map(jax.tree.leaves, (foreseen, moved)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)
    residuals = env.residuals(foreseen, action, params)
    assert float(env.cost(foreseen, action, params)) == float(jnp.sum(residuals**2))


def test_what_the_task_lacks_the_wrapper_lacks():
    env, _ = randomised(delay=1)
    assert not hasattr(env, "control_period") and not hasattr(env, "snapshot")
    assert not hasattr(env, "variant") and hasattr(env, "predict")
    task = envs.make("tracking", **SMALL["tracking"])
    env, params = randomised(
        task, parameters={"arm.rod.radii": {"uniform": (2, 2), "scaled": True}}
    )
    state = jax.jit(env.reset)(jax.random.key(0), params)[1]
    seen, plain = env.snapshot(state, params), task.snapshot(state.task, params.task)
    np.testing.assert_array_equal(seen.radii, 2 * plain.radii)
    assert env.variant == "paper" and env.action_channels == task.action_channels


MESSAGES = [
    ({"delay": -1}, "delay must be non-negative, got -1 control steps"),
    ({"delay": (3, 1)}, "delay must go from low to high, got 3 to 1 control steps"),
    ({"delay": 1.5}, "delay must be whole control steps, got 1.5 to 1.5"),
    ({"lag_seconds": -0.2}, "lag_seconds must be non-negative, got -0.2 s"),
    ({"lag_seconds": 0.2}, "trivial has no control_period .s.: give lag"),
    ({"lag": 1, "lag_seconds": 1}, "give either lag"),
    ({"noise": -0.1}, "noise must be non-negative, got -0.1"),
    ({"noise": {"position": -0.1}}, "noise of 'position' must be non-neg.*unit of"),
    ({"noise": {"velocity": 1}}, "the channel 'velocity', .* there are 'position'"),
    ({"noise": {"3": 1}}, "noise names the entries 3, but an observation"),
    ({"noise": {"pos": 1, "0": 1}}, "noise names entry 0 of the observation twice"),
    ({"dropout": 1.5}, "dropout must be at most 1, got 1.5 .a probability"),
    ({"flags": True}, "dropout must be given"),
    ({"saturation": 1.5}, "saturation must be at most 1, got 1.5"),
    ({"past_actions": 1}, "past_actions must be a list of control steps, got 1"),
    ({"past_actions": [0]}, "each of past_actions must be at least 1, got 0"),
    ({"past_actions": [2, 2]}, r"must be different control steps, got \[2, 2\]"),
    ({"past_actions": [999]}, "past_actions must be at most .* an episode"),
    ({"speed": 1}, "there is no option 'speed' of a randomisation; there are param"),
    ({"parameters": {"strid": {"uniform": (1, 2)}}}, "'strid'; the nearest are stride"),
    ({"parameters": {"stride": 3}}, "'stride' must be a table"),
    ({"parameters": {"stride": {"even": (1, 2)}}}, "one of uniform, log_uniform"),
    ({"parameters": {"stride": {"uniform": 2}}}, "must have two numbers, got 2"),
    ({"parameters": {"stride": {"uniform": {1: 1, 2: 2}}}}, "must have two numbers"),
    ({"parameters": {"stride, ": {"uniform": (1, 2)}}}, "an empty path in 'stride, '"),
    ({"parameters": {"stride": {"uniform": (2, 1)}}}, "from low to high, got 2 to 1"),
    ({"parameters": {"stride": {"normal": (2, -1)}}}, "not be negative, got -1"),
    ({"parameters": {"stride": {"log_uniform": (0, 1)}}}, "must be positive, got 0"),
    ({"parameters": {"stride": {"uniform": ([1, 1], 2)}}}, "shape .2,., the parameter"),
    (
        {"parameters": {p: {"uniform": (1, 2)} for p in ("edge", "stride, edge")}},
        "'edge' has two distributions",
    ),
    (
        {"correlation": {"names": ["edge"], "matrix": [[1]]}},
        "'edge', which has no normal",
    ),
]


@pytest.mark.parametrize(("options", "words"), MESSAGES)
def test_bad_numbers_and_names_are_refused(options, words):
    with pytest.raises(ValueError, match=words):
        envs.make("trivial", randomise=options)


def test_only_one_randomisation_and_only_of_floats():
    env, _ = randomised(delay=1)
    for wrapped in (env, envs.ActionRepeat(env, 2)):
        with pytest.raises(ValueError, match="trivial is randomised already"):
            randomised(wrapped, delay=1)


def test_what_make_records_makes_the_same_environment():
    given = EVERYTHING | {"delay": 2}
    env = envs.make("trivial", randomise=given)
    record = origin_of(env).options["randomise"]
    assert envs.make("trivial", randomise=record) == env
    assert hash(envs.make("trivial", randomise=record)) == hash(env)
    assert envs.Randomisation.from_record(record).record() == record
    other = envs.make("trivial", randomise=given | {"noise": 0.02})
    assert other != env and other != envs.make("trivial")


def test_correlated_draws_have_the_stated_correlation():
    rules = {"stride": {"normal": (0.2, 0.01)}, "edge": {"log_normal": (2, 0.1)}}
    matrix = [[1, -0.8], [-0.8, 1]]
    env, params = randomised(
        parameters=rules, correlation={"names": ["stride", "edge"], "matrix": matrix}
    )
    keys = jax.random.split(jax.random.key(2), DRAWS)
    drawn = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))(keys, params)[1].drawn
    stride, edge = np.asarray(drawn["stride"]), np.log(np.asarray(drawn["edge"]))
    assert np.corrcoef(stride, edge)[0, 1] == pytest.approx(-0.8, abs=0.03)
    assert stats.kstest(stride, stats.norm(0.2, 0.01).cdf).pvalue > 1e-3
    assert stats.kstest(edge, stats.norm(math.log(2), 0.1).cdf).pvalue > 1e-3


@pytest.mark.slow
def test_a_posterior_draws_with_the_mean_and_covariance_of_the_fit():
    times = jnp.linspace(0.0, 1.0, 20)

    def line(p):
        return p["stride"] * times + p["edge"]

    truth = {"stride": 0.2, "edge": 2.0}
    fit = control.fit(
        line,
        line(truth),
        {"stride": 0.1, "edge": 1.0},
        noise=0.05,
        logarithmic=["edge"],
    )
    varied = envs.posterior(fit, {"stride": "stride", "edge": "edge"})
    env = envs.make("trivial", randomise=varied)
    params = env.default_params()

    def drawn(key):
        found = env.task_params(env.reset(key, params)[1], params)
        return jnp.stack([jnp.log(found.edge / 2.0), (found.stride - 0.2) / 0.1])

    keys = jax.random.split(jax.random.key(2), DRAWS)
    points = np.asarray(jax.jit(jax.vmap(drawn))(keys))
    assert fit.names == ("edge", "stride")
    np.testing.assert_allclose(
        np.cov(points.T),
        fit.covariance,
        rtol=0.1,
        atol=1e-6 * float(fit.covariance.max()),
    )
    sds = np.sqrt(np.diag(fit.covariance))
    assert np.all(np.abs(points.mean(0)) < 4 * sds / math.sqrt(DRAWS))
    with pytest.raises(ValueError, match="no parameter 'mass'; it has edge, stride"):
        envs.posterior(fit, {"mass": "stride"})
    vague = control.fit(line, line(truth), truth, noise=50.0)
    with pytest.raises(ValueError, match=r"do not determine 'stride'.* % of its value"):
        envs.posterior(vague, {"stride": "stride"})


@pytest.mark.default_precision
def test_gymnasium_takes_a_randomisation():
    adapted = GymnasiumEnv("trivial", randomise=EVERYTHING)
    env = envs.make("trivial", randomise=EVERYTHING)
    batch, params = envs.VectorEnvironment(env), env.default_params()
    state = jax.jit(batch.reset, static_argnums=1)(jax.random.key(3), 1, params)
    np.testing.assert_allclose(adapted.reset(seed=3)[0], state.observation[0])
    step = jax.jit(batch.step)
    for _ in range(4):
        state, outcome = step(state, jnp.full((1, 1), 0.7), params)
        observation, reward, *_ = adapted.step(np.full(1, 0.7, np.float32))
        np.testing.assert_allclose(observation, outcome.observation[0], rtol=1e-6)
        np.testing.assert_allclose(reward, outcome.reward[0], rtol=1e-6)


def test_a_delay_longer_than_an_episode_is_refused():
    with pytest.raises(ValueError, match="delay must be at most 20 control steps"):
        envs.make("trivial", randomise={"delay": [0, 1000]})


def test_a_path_has_one_distribution_however_it_is_written():
    one, two = {"normal": (0, 1)}, {"normal": (5, 1)}
    with pytest.raises(ValueError, match="two distributions of one path"):
        envs.Randomisation(parameters={"a,b": one, "a, b": two})

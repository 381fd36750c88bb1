"""Model-predictive control: good plans that know nothing of the future."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxrod.control import mpc
from jaxrod.control.plans import (
    PlanCost,
    by_gradient,
    piece_weights,
    quadratic_step,
    shift_weights,
    weights_at,
)
from jaxrod.envs import VectorEnvironment, make, rollout
from jaxrod.envs.memory_policy import MemoryPolicy, OneEpisode
from jaxrod.envs.tasks.tracking import HEADING_STEPS
from jaxrod.envs.wrappers import repeating
from jaxrod.training import evaluate

SMALL = {"horizon": 4, "knots": 2, "hold": 1, "effort": 1e-4, "smoothness": 1e-4}


def small(method="gauss-newton", **options):
    more = {"mppi": {"iterations": 4, "samples": 64}, "gradient": {"iterations": 6}}
    return mpc(
        make("trivial"),
        method=method,
        **{**SMALL, **more.get(method, {}), "replan": 1, **options},
    )


class Bowl:
    """A cost of knots, least at `LEAST` and steeper in one knot than in the other."""

    @staticmethod
    def total(now, knots, state, *, sloped=False):
        return jnp.sum(jnp.array([1.0, 30.0])[:, None] * (knots - LEAST) ** 2)


LEAST = jnp.array([[0.5], [-0.3]])


def test_gradient_steps_are_those_of_adam():
    knots, rate = jnp.zeros((2, 1)), 0.02
    adam = optax.adam(rate, b1=0.8, b2=0.95, eps=1e-8)
    wanted, memory = knots, adam.init(knots)
    for _ in range(7):
        slope = jax.grad(lambda z: Bowl.total(None, z, None))(wanted)
        change, memory = adam.update(slope, memory)
        wanted = optax.apply_updates(wanted, change)
    found, least = by_gradient(Bowl(), None, knots, None, jnp.int32(7), rate)
    np.testing.assert_allclose(found, wanted, rtol=1e-6)
    np.testing.assert_allclose(least, Bowl.total(None, wanted, None), rtol=1e-6)


def test_a_plan_costs_the_same_whether_its_states_are_stored_or_not():
    cost = small(horizon=12, knots=2, hold=2, replan=2).cost
    now, knots = jnp.array([0.2]), jnp.array([[0.7], [-0.4]])
    _, state = cost.env.reset(jax.random.key(0), cost.env.default_params())
    for method in (cost.residuals, cost.total):
        stored = method(now, knots, state, sloped=True)
        np.testing.assert_allclose(method(now, knots, state), stored, rtol=1e-6)
        slope = jax.jacrev(lambda z, f=method: f(now, z, state, sloped=True))(knots)
        nested = jax.jacfwd(lambda z, f=method: f(now, z, state))(knots)
        np.testing.assert_allclose(slope, nested, rtol=1e-5, atol=1e-7)


def test_lines_between_knots():
    # Value now 1, knots 3 and 7 at times 4 and 8.
    corners = np.array([1.0, 3.0, 7.0])
    np.testing.assert_allclose(weights_at([0, 1, 4, 6, 8, 99], 2, 4).sum(1), 1)
    np.testing.assert_allclose(
        weights_at([0, 1, 4, 6, 8, 99], 2, 4) @ corners, [1, 1.5, 3, 5, 7, 7]
    )
    np.testing.assert_allclose(piece_weights(2, 4, 2) @ corners, [1.5, 2.5, 4, 6])
    np.testing.assert_allclose(shift_weights(2, 4, 4) @ corners, [3, 7, 7])
    np.testing.assert_allclose(shift_weights(2, 4, 2) @ corners, [2, 5, 7])


def test_steps_from_knot_to_knot():
    # Value now 1, knots 3 and 7: 3 until time 4, 7 from then on.
    corners = np.array([1.0, 3.0, 7.0])
    np.testing.assert_allclose(
        weights_at([0, 1, 4, 4.5, 8, 99], 2, 4, "steps") @ corners, [1, 3, 3, 7, 7, 7]
    )
    np.testing.assert_allclose(piece_weights(2, 4, 2, "steps") @ corners, [3, 3, 7, 7])
    np.testing.assert_allclose(shift_weights(2, 4, 4, "steps") @ corners, [3, 7, 7])
    # Half a step later: what is acted now, and of the mixed step its later half.
    np.testing.assert_allclose(shift_weights(2, 4, 2, "steps") @ corners, [3, 7, 7])
    np.testing.assert_allclose(shift_weights(1, 4, 2, "steps") @ [1, 3], [3, 3])


@pytest.mark.slow
def test_a_plan_of_one_step_is_the_best_action_that_is_held():
    env = make("trivial")
    params, effort, hold = env.default_params(), 1e-4, 2
    policy = mpc(
        env,
        shape="steps",
        horizon=hold,
        knots=1,
        hold=hold,
        effort=effort,
        smoothness=0.0,
    )
    seen, states = jax.vmap(env.reset, (0, None))(
        jax.random.split(jax.random.key(0), 20), params
    )
    action, memory = jax.jit(policy.act)(policy.init(seen, states), seen, states)
    # min (x + 2 s u)^2 + e u^2, by hand; damping of a step leaves a thousandth.
    stride = hold * params.stride
    best = jnp.clip(-states.position * stride / (stride**2 + effort), -1, 1)
    np.testing.assert_allclose(action[:, 0], best, atol=1e-3)
    left = (states.position + stride * action[:, 0]) ** 2 + effort * action[:, 0] ** 2
    np.testing.assert_allclose(memory.cost, left, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["gauss-newton", "gradient", "mppi"])
def test_the_best_policy_is_found_by_every_method(method):
    """The best action is clip(-x / stride, -1, 1)."""
    env, policy = make("trivial"), small(method)
    assert isinstance(policy, MemoryPolicy)
    best = evaluate(env, lambda seen: jnp.clip(-seen / 0.2, -1, 1), episodes=16).returns
    still = evaluate(env, lambda seen: 0 * seen, episodes=16).returns
    found = evaluate(env, policy, episodes=16).returns
    lost = np.mean(best - found) / np.mean(best - still)
    # Lines begin at the action before: a first move is not at once a full one.
    assert -1e-6 < lost < 0.1


@pytest.mark.slow
def test_evaluate_earns_what_a_loop_by_hand_does():
    env, policy, episodes = make("trivial"), small(hold=2, replan=2), 5
    found = evaluate(env, policy, episodes=episodes, seed=3)
    batch, params = VectorEnvironment(repeating(env, 2)), env.default_params()
    state = batch.reset(jax.random.key(3), episodes, params)
    memory, total = policy.init(state.observation, state.states), 0
    act, step = jax.jit(policy.act), jax.jit(batch.step)
    for _ in range(env.episode_length // 2):
        action, memory = act(memory, state.observation, state.states)
        state, outcome = step(state, action, params)
        total = total + outcome.reward
    assert bool(outcome.episodes.finished.all())
    np.testing.assert_allclose(found.returns, total, rtol=1e-6)
    np.testing.assert_array_equal(found.lengths, env.episode_length)


@pytest.mark.slow
def test_a_batch_plans_as_each_by_itself():
    env, policy = make("trivial"), small()
    params = env.default_params()
    observations, states = jax.vmap(env.reset, (0, None))(
        jax.random.split(jax.random.key(0), 3), params
    )
    together, _ = policy.act(policy.init(observations, states), observations, states)
    alone = OneEpisode(policy)
    for index in range(3):
        one = jax.tree.map(lambda leaf, i=index: leaf[i], (observations, states))
        action, _ = alone.act(alone.init(*one), *one)
        np.testing.assert_allclose(action, together[index], atol=1e-6)


@pytest.mark.slow
def test_plans_are_made_only_when_they_are_due():
    """Between plans the state is not looked at: a wrong one changes nothing."""
    env, policy = make("trivial"), small(horizon=8, knots=2, hold=1, replan=4)
    params = env.default_params()
    observation, state = jax.tree.map(
        lambda leaf: leaf[None], env.reset(jax.random.key(0), params)
    )
    wrong = jax.tree.map(lambda leaf: leaf + 5, state)
    act = jax.jit(policy.act)
    memory = policy.init(observation, state)
    _, memory = act(memory, observation, state)
    for call in range(1, 5):
        right, kept = act(memory, observation, state)
        other, _ = act(memory, observation, wrong)
        assert (float(right[0, 0]) == float(other[0, 0])) == (call < 4)
        if call == 4:
            # The new plan begins where the old one has led to.
            cost = policy.cost
            shift = shift_weights(cost.knots, cost.spacing, 4, cost.shape)
            begun = shift[0] @ np.asarray(memory.values[0])
            np.testing.assert_allclose(kept.values[0, 0], begun, atol=1e-6)
            assert np.max(np.abs(kept.values[0, -1] - begun)) > 1e-3
        memory = kept


def test_a_quadratic_problem_is_solved_within_its_bounds():
    rng = np.random.default_rng(0)
    knots, size, rows = 3, 2, 4
    cost = PlanCost(
        params=None,
        effort=jnp.asarray(1e-3),
        smoothness=jnp.asarray(1e-2),
        env=None,
        knots=knots,
        spacing=1,
        hold=1,
    )
    jacobian = jnp.asarray(rng.normal(size=(rows, knots, size)))
    values = jnp.asarray(2.0 * rng.normal(size=rows))
    now = jnp.asarray(rng.uniform(-1, 1, size))
    begin = jnp.asarray(rng.uniform(-1, 1, (knots, size)))

    def quadratic(z):
        along = values + jnp.sum(jacobian * (z - begin)[None], axis=(1, 2))
        return (
            jnp.sum(along**2)
            + cost.regular(now, z)
            + 1e-3 / knots * jnp.sum((z - begin) ** 2)
        )

    def descend(z, _):
        return jnp.clip(z - 0.01 * jax.grad(quadratic)(z), -1, 1), None

    best, _ = jax.lax.scan(descend, begin, length=20_000)
    found = jax.jit(quadratic_step)(cost, values, jacobian, now, begin)
    assert float(jnp.abs(best).max()) == 1.0  # bounds do hold some
    assert float(jnp.abs(found).max()) <= 1.0
    found, best, first = quadratic(found), quadratic(best), quadratic(begin)
    gained = (first - found) / (first - best)
    assert 0.98 < float(gained) <= 1 + 1e-9


def test_what_cannot_be_planned_with_is_refused():
    @dataclasses.dataclass(frozen=True)
    class Blind:
        action_size: int = 1

    with pytest.raises(ValueError, match=r"Blind cannot be planned with.*no predict"):
        mpc(Blind())
    env = make("trivial")
    for wrong, words in [
        ({"method": "magic"}, "method must be one of"),
        ({"shape": "curves"}, "shape must be one of lines, steps"),
        ({"horizon": 7}, "multiple of knots times hold"),
        ({"replan": 3, "hold": 2, "horizon": 12}, "replan must be a multiple of hold"),
        ({"replan": 400}, "replan must be a multiple of hold"),
        ({"effort": -1.0}, "effort must be finite"),
        ({"effort": 0.0}, "effort must be positive"),
        ({"rate": 0.0}, "rate must be positive"),
    ]:
        with pytest.raises(ValueError, match=words):
            mpc(env, **{"horizon": 12, "knots": 3, "hold": 1, **wrong})


@pytest.mark.slow
def test_headings_to_come_are_not_known_to_a_plan():
    """Two futures of one past: the same actions until the target turns."""
    env = make("tracking", variant="clean", n_elements=10, substeps=2)
    params = env.default_params()
    policy = mpc(env, horizon=8, knots=2, hold=4)
    observation, state = env.reset(jax.random.key(0), params)
    # Eight control steps before a turn, with plans that reach as far and further.
    state = dataclasses.replace(state, steps=jnp.asarray(HEADING_STEPS - 8, jnp.int32))

    @jax.jit
    def played(key):
        return rollout(
            env,
            (observation, state),
            policy,
            params,
            16,
            key=key,
            collect=lambda s: (s.arm.positions, s.target.velocity),
        ).collected

    arms, targets = played(jax.random.key(1))
    others, differently = played(jax.random.key(2))
    # The plan that is made at the turn, in the eighth step, is the first to differ.
    np.testing.assert_array_equal(targets[:7], differently[:7])
    assert float(jnp.abs(targets[7:] - differently[7:]).max()) > 0.01
    np.testing.assert_array_equal(arms[:8], others[:8])
    assert float(jnp.abs(arms[8:] - others[8:]).max()) > 1e-6


@pytest.mark.slow
def test_an_arm_reaches_its_goal():
    env = make("reaching", variant="clean", n_elements=10, episode_length=160)
    policy = mpc(env, horizon=48, knots=3, hold=4)
    found = evaluate(env, policy, episodes=4)
    assert not found.flagged.any()
    # Six in each step from the first 0.11 s on; standing still pays nothing. One goal
    # in four may be out of a short plan's reach, and rounding decides which.
    assert sorted(found.returns)[1] > 6 * 80

"""Tasks of one scene: the base class against steps by hand, and its refusals."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod import envs
from jaxrod.control import mpc
from jaxrod.training import evaluate, untrained_policy

LINK = {"length": 0.3, "radius": 0.01, "density": 1e3, "youngs_modulus": 1e6}


class Bend(envs.SceneTask):
    action_size, episode_length, control_period, dt = 2, 10, 0.01, 2e-4

    def build(self):
        rod, start = jaxrod.straight_rod(6, **LINK)
        effects = jaxrod.clamp(start), jaxrod.exponential_damping(10.0)
        return jaxrod.make_scene(rod, *effects), start

    def act(self, scene, action):
        couple = jnp.append(0.2 * action, 0.0)
        return scene.with_effect(jaxrod.uniform_load((0, 0, 0), couple))

    def goal(self, key):
        return jax.random.uniform(key, (3,), minval=0.1, maxval=0.2)

    def observe(self, state, goal):
        return jnp.concatenate([state.tip, goal])

    def reward(self, state, goal):
        return -jnp.sum((state.tip - goal) ** 2)

    def spheres(self, state, goal):
        return [(goal, 0.01)]


class Links(Bend):
    """Two links with a ball joint, over a floor that they touch."""

    name = "two links"

    def build(self):
        link = LINK | {"direction": (1, 0, 0)}
        upper, of_upper = jaxrod.straight_rod(6, **link)
        lower, of_lower = jaxrod.straight_rod(6, start=(0.3, 0.0, 0.0), **link)
        start = {"upper": of_upper, "lower": of_lower}
        floor = jaxrod.contact(jaxrod.shapes.plane((0.0, 0.0, -0.1)))
        system = jaxrod.make_system(
            {
                "upper": jaxrod.make_scene(
                    upper, jaxrod.clamp(of_upper), jaxrod.gravity()
                ),
                "lower": jaxrod.make_scene(lower, jaxrod.gravity(), floor),
            },
            jaxrod.systems.tie(("upper", "tip"), ("lower", "base"), start),
            jaxrod.systems.rod_contact("upper", "lower"),
            state=start,
        )
        return system, start

    def act(self, scene, action):
        upper = super().act(scene.members["upper"], action)
        return scene.with_members({"upper": upper})

    def observe(self, state, goal):
        return state["lower"].tip

    def reward(self, state, goal):
        return state["lower"].tip[2]


class Unequal(Links):
    def build(self):
        short, of_short = jaxrod.straight_rod(3, **LINK)
        system, start = super().build()
        members = dict(system.members) | {"short": jaxrod.make_scene(short)}
        start = start | {"short": of_short}
        return jaxrod.make_system(members, state=start), start


def begun(env, seed=0):
    params = env.default_params()
    return params, *env.reset(jax.random.key(seed), params)


def test_a_step_advances_the_scene_on_which_the_action_acts():
    env = Bend()
    params, seen, state = begun(env)
    action = jnp.array([0.5, -1.0])
    observed, after, reward, terminated, truncated, info = env.step(
        None, state, action, params
    )
    scene, start = env.build()
    load = jaxrod.uniform_load((0, 0, 0), jnp.array([0.1, -0.2, 0.0]))
    moved = jaxrod.advance(scene.with_effect(load), start, 2e-4, 50)
    np.testing.assert_array_equal(after.body.positions, moved.positions)
    np.testing.assert_array_equal(observed, [*moved.tip, *state.goal])
    assert float(reward) == float(-jnp.sum((moved.tip - state.goal) ** 2))
    assert not terminated and not truncated and not info["flagged"]
    np.testing.assert_array_equal(seen, [0, 0, 0.3, *state.goal])
    # A planner predicts the same, also over several control steps.
    twice = env.step(None, after, action, params)[1]
    predicted = env.predict(state, action, params, control_steps=2)
    np.testing.assert_allclose(predicted.body.tip, twice.body.tip, rtol=1e-12)
    assert float(env.cost(after, action, params)) == -float(reward)


def test_goals_are_drawn_for_each_episode():
    env = Bend()
    goals = [begun(env, seed)[2].goal for seed in (0, 0, 1)]
    np.testing.assert_array_equal(goals[0], goals[1])
    assert abs(goals[0] - goals[2]).max() > 1e-3


def test_a_goal_may_move():
    class Circling(Bend):
        def goal(self, key):
            return jax.random.uniform(key, maxval=2 * jnp.pi)

        def moved_goal(self, goal):
            return goal + 0.1

        def target(self, goal):
            return jnp.array([0.1 * jnp.cos(goal), 0.1 * jnp.sin(goal), 0.25])

        def observe(self, state, goal):
            return jnp.concatenate([state.tip, self.target(goal)])

        def reward(self, state, goal):
            return -jnp.sum((state.tip - self.target(goal)) ** 2)

        def spheres(self, state, goal):
            return [(self.target(goal), 0.01)]

    env = Circling()
    params, _, state = begun(env)
    seen, after, reward, *_ = env.step(None, state, jnp.zeros(2), params)
    assert float(after.goal) == pytest.approx(float(state.goal) + 0.1)
    np.testing.assert_array_equal(seen[3:], env.target(after.goal))
    assert float(reward) == float(env.reward(after.body, after.goal))
    predicted = env.predict(state, jnp.zeros(2), params, control_steps=3)
    assert float(predicted.goal) == pytest.approx(float(state.goal) + 0.3)
    envs.check_environment(env)


@pytest.mark.parametrize(
    "env",
    [
        pytest.param(Bend(), id="scene"),
        pytest.param(Links(), id="system", marks=pytest.mark.slow),
    ],
)
def test_tasks_of_scenes_and_of_systems_keep_the_protocol(env):
    envs.check_environment(env)
    params, _, state = begun(env)
    actions = jnp.ones((3, 2))
    found = jax.jit(
        lambda: envs.rollout(env, env.reset(jax.random.key(0), params), actions, params)
    )()
    assert found.running.all() and np.isfinite(found.reward).all()
    drawn = env.snapshot(found.state, params)
    rods = {"bend": (), "two links": (2,)}[env.name]
    assert drawn.positions.shape == (*rods, 3, 7) and drawn.radii.shape == (*rods, 6)
    np.testing.assert_array_equal(drawn.spheres[0][0], state.goal)


def test_rods_of_different_sizes_are_drawn_by_the_user_alone():
    env = Unequal()
    params, _, state = begun(env)
    with pytest.raises(ValueError, match=r"must define snapshot.* elements: \[3, 6\]"):
        env.snapshot(state, params)


def test_equal_tasks_share_programs_and_options_make_a_difference():
    @dataclasses.dataclass(frozen=True)
    class Softer(Bend):
        stiffness: float = 1e6

    traced = []

    @jax.jit
    def reward(params, env):
        traced.append(env)
        state = env.reset(jax.random.key(0), params)[1]
        return env.step(None, state, jnp.ones(2), params)[2]

    reward = jax.jit(reward.__wrapped__, static_argnums=1)
    for env in (Bend(), Bend()):
        reward(env.default_params(), env)
    assert len(traced) == 1 and Bend() == Bend() and hash(Bend()) == hash(Bend())
    assert Softer() != Bend() and Softer(2e6) != Softer() and Softer(1e6) == Softer()
    assert Softer().name == "softer"
    for env in (Bend(), Softer()):
        with pytest.raises(dataclasses.FrozenInstanceError, match="dt"):
            env.dt = 1e-3
    with pytest.raises(dataclasses.FrozenInstanceError):
        Softer().stiffness = 1e3


def test_the_scene_keeps_its_last_sound_state_after_a_flag():
    class Strict(Bend):
        limits = jaxrod.HealthLimits(largest_joint_angle=1e-3)

    env = Strict()
    params, seen, state = begun(env)
    found = env.step(None, state, jnp.ones(2), params)
    observed, after, reward, terminated, truncated, info = found
    assert info["flagged"] and truncated and not terminated
    np.testing.assert_array_equal(after.body.positions, state.body.positions)
    np.testing.assert_array_equal(observed, seen)
    assert float(reward) == float(-jnp.sum((state.body.tip - state.goal) ** 2))
    too_much = dataclasses.replace(
        state.body, velocities=jnp.full_like(state.body.velocities, jnp.inf)
    )
    lost = dataclasses.replace(state, body=too_much)
    assert Bend().step(None, lost, jnp.ones(2), params)[4]


def test_a_task_may_end():
    class Lowered(Bend):
        def ended(self, state, goal):
            return state.tip[2] < 0.2999

    env = Lowered()
    start = begun(env)
    found = envs.rollout(env, start[1:], jnp.ones((10, 2)), start[0])
    ends = int(np.argmin(found.running))
    assert 0 < ends < 9 and not found.running[-1]
    assert float(found.state.body.tip[2]) < 0.2999


def test_effects_with_memory_keep_the_structure_of_the_state():
    class Sticky(Bend):
        def build(self):
            rod, start = jaxrod.straight_rod(6, **LINK, direction=(1, 0, 0))
            floor = jaxrod.shapes.plane((0.0, 0.0, -0.01))
            rough = jaxrod.contact(floor, friction=0.5)
            ground = jaxrod.sticking_contact(rough, rod, start)
            return jaxrod.make_scene(rod, ground, jaxrod.gravity()), start

    env = Sticky()
    envs.check_environment(env)
    assert env.build()[1].memory is None
    assert env.default_params().start.memory is not None


def test_gradients_of_rewards_equal_differences():
    env = Bend()
    params, seen, state = begun(env)

    def score(strength):
        actions = strength * jnp.ones((3, 2))
        return jnp.sum(envs.rollout(env, (seen, state), actions, params).reward)

    slope = jax.jit(jax.grad(score))(0.5)
    high, low = jax.jit(score)(0.5 + 1e-5), jax.jit(score)(0.5 - 1e-5)
    assert float(slope) == pytest.approx(float(high - low) / 2e-5, rel=1e-6)


def test_sizes_are_known_inside_jit():
    class Fresh(Links):
        """Its sizes were not asked for before."""

    assert jax.jit(lambda: jnp.zeros(Fresh().observation_size))().shape == (3,)


@pytest.mark.slow
def test_a_planner_takes_the_tip_to_its_goal():
    class Near(Bend):
        episode_length = 40

        def goal(self, key):
            return jnp.array([0.1, 0.0, 0.27])

    env = Near()
    planner = mpc(env, horizon=12, knots=3, hold=1, method="gradient")
    untrained = evaluate(env, untrained_policy(env, seed=0), episodes=2).mean
    assert evaluate(env, planner, episodes=2).mean > 0.4 * untrained


def without(name):
    """The task `Bend` without one of its attributes or methods."""
    own = {key: value for key, value in vars(Bend).items() if key[:2] != "__"}
    del own[name]
    return type("Less", (envs.SceneTask,), own)


@pytest.mark.parametrize("name", ["build", "act", "observe", "reward"])
def test_a_method_that_is_missing_is_named(name):
    with pytest.raises(TypeError, match=name):
        without(name)()


@pytest.mark.parametrize("name", ["action_size", "episode_length", "dt"])
def test_an_attribute_that_is_missing_is_named(name):
    with pytest.raises(ValueError, match=name):
        envs.check_environment(without(name)())


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"dt": 3e-4}, r"whole multiple of dt, got 0.01 s and 0.0003 s"),
        ({"dt": 0.0}, r"dt of odd must be above 0, got 0.0 s"),
        ({"dt": float("nan")}, r"dt of odd must be above 0, got nan s"),
        ({"control_period": 1e-5}, r"whole multiple of dt, got 1e-05 s"),
        ({"control_period": float("inf")}, r"whole multiple of dt, got inf s"),
        ({"episode_length": 0}, r"episode_length of odd must be a positive integer"),
        ({"observe": lambda self, state, goal: goal[0]}, r"vector, got .* shape \(\)"),
        ({"observe": lambda self, state, goal: [1.0]}, r"vector, got list"),
        ({"observe": lambda self, x, goal: x.top}, r"no first observation: .*top"),
        ({"reward": lambda self, state, goal: goal}, r"the reward of odd must be"),
        ({"act": lambda self, scene, action: None}, r"odd"),
        ({"build": lambda self: None}, r"build of odd must return .*, got NoneType"),
    ],
)  # fmt: skip
def test_mistakes_are_answered_in_a_sentence(changes, words):
    odd = type("Odd", (Bend,), changes)()
    with pytest.raises(ValueError, match=words):
        envs.check_environment(odd)


def test_actions_of_another_size_are_refused():
    env = Bend()
    params, _, state = begun(env)
    with pytest.raises(ValueError, match=r"action must have shape|\(2,\)"):
        env.step(None, state, jnp.ones(3), params)

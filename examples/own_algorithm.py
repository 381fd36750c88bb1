"""A custom algorithm: random search that keeps the best eighth of its samples."""

import jax
import jax.numpy as jnp

from jaxrod.envs import Environment, VectorEnvironment
from jaxrod.extend import pytree, static
from jaxrod.training import Algorithm, Metrics


@pytree
class Config:
    population: int = static(default=64)
    episode_steps: int = static(default=20)
    spread: float = 0.5


@pytree
class State:  # all there is: with it a run continues bit by bit
    env: Environment = static()
    config: Config
    env_params: object
    key: jax.Array
    weights: jax.Array


def act(weights, observation):
    return jnp.tanh(observation @ weights)


def init(key, env, config, env_params, total_steps):
    weights = jnp.zeros((env.observation_size, env.action_size))
    return State(env, config, env_params, key, weights)


def update(state):
    config, params, batch = state.config, state.env_params, VectorEnvironment(state.env)
    key, draw, start = jax.random.split(state.key, 3)
    noise = jax.random.normal(draw, (config.population, *state.weights.shape))
    tried = state.weights[None] + config.spread * noise

    def step(running, _):
        action = jax.vmap(act)(tried, running.observation)
        running, seen = batch.step(running, action, params)
        return running, (seen.reward, seen.episodes)

    running = batch.reset(start, config.population, params)
    _, (reward, episodes) = jax.lax.scan(step, running, length=config.episode_steps)
    elite = tried[jnp.argsort(reward.sum(0))[-config.population // 8 :]]
    return State(state.env, config, params, key, elite.mean(0)), Metrics({}, episodes)


RANDOM_SEARCH = Algorithm(
    name="random_search",
    config_type=Config,
    steps_per_update=lambda config: config.population * config.episode_steps,
    init=init,
    update=update,
    policy=lambda state: jax.tree_util.Partial(act, state.weights),
)

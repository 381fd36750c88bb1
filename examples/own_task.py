"""An arm bends to a given height: `jaxrod train examples/own_task.py:make_task`."""

import dataclasses

import jax
import jax.numpy as jnp

import jaxrod
from jaxrod.envs import Snapshot


@jaxrod.extend.pytree
class State:
    rod: jaxrod.RodState
    goal: jax.Array  # height to reach [m]
    steps: jax.Array  # control steps since reset


@dataclasses.dataclass(frozen=True)
class Lift:
    height: float  # the highest goal, and the lowest below zero [m]
    name, observation_size, action_size = "lift", 5, 1
    episode_length, control_period = 100, 0.02  # control steps, [s]

    def default_params(self):
        size = {"length": 0.5, "radius": 0.02, "density": 1e3, "youngs_modulus": 1e7}
        rod, start = jaxrod.straight_rod(6, direction=(1, 0, 0), **size)
        effects = jaxrod.clamp(start), jaxrod.exponential_damping(5.0)
        scene = jaxrod.make_scene(rod, *effects, method=jaxrod.planar("xy"))
        return {"scene": scene, "start": start, "strength": 10.0}  # [N m/m]

    def reset(self, key, params):
        goal = jax.random.uniform(key, minval=-self.height, maxval=self.height)
        return self.seen(State(params["start"], goal, jnp.zeros((), int)))

    def step(self, key, state, action, params):
        couple = jnp.zeros(3).at[2].set(params["strength"] * action[0])
        scene = params["scene"].with_effect(jaxrod.uniform_load((0, 0, 0), couple))
        rod = jaxrod.advance(scene, state.rod, self.control_period / 100, 100)
        observation, state = self.seen(State(rod, state.goal, state.steps + 1))
        reward = -jnp.abs(rod.tip[1] - state.goal)
        return observation, state, reward, False, state.steps >= self.episode_length, {}

    def seen(self, state):
        tip = jnp.concatenate([state.rod.tip[:2], state.rod.velocities[:2, -1]])
        return jnp.append(tip, state.goal), state

    def snapshot(self, state, params):
        goal = jnp.array([0.4, 0, 0]).at[1].set(state.goal)
        nodes, radii = state.rod.positions, params["scene"].rod.radii
        return Snapshot(nodes, radii, spheres=((goal, 0.02),), up="y")


def make_task(height: float = 0.3):
    """Makes the task.

    Args:
        height: The highest goal, and the lowest below zero [m].
    """
    return Lift(height)

"""A hand pushes the tip of a soft cable into a leaning socket, by planning.

It is the built-in task `insert`. No policy is trained: every 0.3 s the hand improves a
plan for the next 1.2 s by a Gauss-Newton step through the cable and its contact. After
6 s it keeps still. Run it with `python examples/insert.py`.
"""

from dataclasses import replace

import gallery
import jax
import jax.numpy as jnp
import numpy as np

import jaxrod

SEED, LEAN, G = 5, 0.2, 9.81  # [1], [1], [m/s^2]
NUMBER = "upward force of hand and socket at the end, and weight of the cable [N]"
LOOK = {"frame": (0, 90), "azimuth": -60, "elevation": 15}
TOWARDS_VIEWER = np.array([0.5, -0.87, 0.0])


def task():
    """The task, and its parameters with sockets that lean by up to LEAN."""
    env = jaxrod.envs.make("insert", episode_length=100)
    params = env.default_params()
    return env, replace(params, lean=jnp.full(2, LEAN))


def build():
    """The cable that the hand holds, its state and the time step."""
    _, params = task()
    return params.body.scene, params.body.rest, float(params.dt)


def inserted(steps):
    """States of the task at the start, while the hand plans, and for 3 s at rest."""
    env, params = task()
    plan = {"horizon": 12, "knots": 4, "hold": 3, "replan": 3}
    planner = jaxrod.control.mpc(env, params, **plan)

    @jax.jit
    def play(start):
        moves = {"params": params, "collect": lambda state: state}
        found = jaxrod.envs.rollout(env, start, planner, steps=steps, **moves)
        then, still = (found.observation, found.state), jnp.zeros((30, 3))
        return found.collected, jaxrod.envs.rollout(env, then, still, **moves).collected

    start = env.reset(jax.random.key(SEED), params)
    begun = jax.tree.map(lambda leaf: leaf[None], start[1])
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), begun, *play(start))


def run(share=1.0):
    """A replay, the force of hand and socket at the end, and the cable's weight."""
    _, params = task()
    states = inserted(int(60 * share))
    mouth, last = states.mouth[0], jax.tree.map(lambda leaf: leaf[-1], states.body)
    scene = params.body.above(mouth, states.inwards[0]).scene.at(0.0)
    times = 0.1 * jnp.arange(len(states.steps))
    hand = jaxrod.viz.Sphere(states.body.positions[:, :, 0], 0.014, "hand")
    replay = jaxrod.viz.Replay.from_states(
        scene, states.body, times, forces=True, spheres=[hand], title="Insert"
    )
    # Drawn without the half of the socket that hides the tip.
    (socket,) = replay.meshes
    near = (socket.vertices - np.asarray(mouth)) @ TOWARDS_VIEWER
    behind = socket.faces[np.max(near[socket.faces], axis=1) < 1e-6]
    cut = replace(socket, faces=behind, name="socket")
    force = jaxrod.reactions(scene, last)[0].force[2]  # of the hand
    force += replay.arrows[0].vectors[-1, :, 2].sum()  # and of the socket
    weight = G * jnp.sum(scene.rod.node_masses)
    return replace(replay, meshes=(cut,)), float(force), float(weight)


if __name__ == "__main__":
    gallery.show(__file__, run, NUMBER, LOOK)

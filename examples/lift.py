"""A hand lifts the free end of a rope from the floor to a target, by planning.

It is the built-in task `lift`. No policy is trained: every 0.3 s the hand improves a
plan for the next 1.2 s, with gradients through the rope and its friction on the floor.
After 6 s it keeps still. Run it with `python examples/lift.py`.
"""

from dataclasses import replace

import gallery
import jax
import jax.numpy as jnp

import jaxrod

SEED, G = 1, 9.81  # [1], [m/s^2]
NUMBER = "force of the hand at the end, and weight of the rope [N]"
LOOK = {"frame": (0, 6, 9, 12, 60), "azimuth": -140, "elevation": 15, "zoom": 0.95}


def task():
    """The task and its parameters, with the gravity of this module."""
    env = jaxrod.envs.make("lift", episode_length=90)
    params = env.default_params()
    scene = params.body.scene
    hand, _, *others = scene.effects
    acting = hand, jaxrod.gravity((0.0, 0.0, -G)), *others
    body = replace(params.body, scene=replace(scene, effects=acting))
    return env, replace(params, body=body)


def build():
    """The rope that the hand holds, its state on the floor and the time step."""
    _, params = task()
    return params.body.scene, params.body.rest, float(params.dt)


def lifted(steps):
    """States of the task at the start, while the hand plans, and for 3 s at rest."""
    env, params = task()
    plan = {"horizon": 12, "knots": 4, "hold": 3, "replan": 3, "iterations": 8}
    planner = jaxrod.control.mpc(env, params, method="gradient", **plan)

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
    """A replay, the force of the hand at the end and the weight of the rope."""
    scene, _, _ = build()
    states = lifted(int(60 * share))
    ropes, target = states.body, states.target
    nodes, ball = jnp.swapaxes(ropes.positions, 1, 2), jaxrod.viz.Sphere
    away = jnp.linalg.norm(nodes[:, -1] - target, axis=1)
    replay = jaxrod.viz.Replay.from_nodes(
        nodes,
        scene.rod.radii,
        0.1 * jnp.arange(len(nodes)),
        spheres=[ball(target, 0.025, "target"), ball(nodes[:, 0], 0.025, "hand")],
        readouts={"distance to target [m]": away},
        floor=0.0,
        title="Lift",
    )
    last = jax.tree.map(lambda leaf: leaf[-1], ropes)
    hand = jaxrod.reactions(scene.at(0.0), last)[0]
    weight = G * jnp.sum(scene.rod.node_masses)
    return replay, float(hand.force[2]), float(weight)


if __name__ == "__main__":
    gallery.show(__file__, run, NUMBER, LOOK)

"""Share of episodes in which policies of `gripper` lift the ball.

Plays the task's script and each policy for 64 episodes in which the wrist starts at its
highest position, and for 64 in which it starts anywhere on its way down, as in
training. Prints the mean return, and the share of episodes that end with the ball at
least 0.07 m above its first position. All play the same episodes, in single precision,
as in training.
"""

from __future__ import annotations

import argparse
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

import jaxrod
from jaxrod.envs import make
from jaxrod.envs.tasks.gripper import LIFT
from jaxrod.training import load_policy

EPISODES = 64


def played(env: Any, policy: Any) -> tuple[Array, Array, Array]:
    """Return, height of the ball at the end [m] and whether a flag rose, by episode."""
    params = env.default_params()

    def episode(key: Array) -> tuple[Array, Array, Array]:
        def step(carry: Any, _: None) -> tuple[Any, tuple[Array, Array, Array]]:
            observation, state = carry
            if policy is None:
                action = env.scripted_action(state, params)
            else:
                action = policy(observation)
            observation, state, reward, _, _, info = env.step(
                key, state, action, params
            )
            return (observation, state), (reward, info["height"], info["flagged"])

        _, (rewards, heights, flagged) = jax.lax.scan(
            step, env.reset(key, params), length=env.episode_length
        )
        return jnp.sum(rewards), heights[-1], jnp.any(flagged)

    return jax.jit(jax.vmap(episode))(jax.random.split(jax.random.key(1), EPISODES))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the policies."""
    parser.add_argument("policies", nargs="*", metavar="RUN/policy")


def run(args: argparse.Namespace) -> int:
    """Prints a line for each policy and start."""
    jaxrod.configure_cpu()
    named = ((name, load_policy(name)) for name in args.policies)
    policies = [("scripted", None), *named]
    for lowered in (0.0, 1.0):
        env = make("gripper", lowered=lowered)
        for name, policy in policies:
            returns, heights, flagged = played(env, policy)
            print(
                f"{name}, lowered={lowered:g}: return {float(jnp.mean(returns)):.1f} ± "
                f"{float(jnp.std(returns)):.1f}, least {float(jnp.min(returns)):.1f}, "
                f"lifted {float(jnp.mean(heights >= LIFT)):.0%}, "
                f"flagged {float(jnp.mean(flagged)):.0%}",
                flush=True,
            )
    return 0

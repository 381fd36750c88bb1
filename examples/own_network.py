"""A custom network: PPO with layer normalisation and a skip connection.

In this folder: jaxrod train trivial --set network=own_network:residual
"""

import flax.linen as nn
import jax

import jaxrod
from jaxrod.envs import make
from jaxrod.training import PPOConfig, evaluate, restore_policy, train


class Residual(nn.Module):
    outputs: int
    output_scale: float
    width: int = 32

    @nn.compact
    def __call__(self, inputs: jax.Array) -> jax.Array:
        hidden = nn.tanh(nn.Dense(self.width)(inputs))
        hidden = hidden + nn.tanh(nn.LayerNorm()(nn.Dense(self.width)(hidden)))
        scale = nn.initializers.orthogonal(self.output_scale)
        return nn.Dense(self.outputs, kernel_init=scale)(hidden)


def residual(role: str, outputs: int) -> nn.Module:
    """The network of a role. A policy's first actions are near 0."""
    return Residual(outputs, output_scale=0.01 if role == "policy" else 1.0)


def main() -> None:
    jaxrod.configure_cpu()
    env, folder = make("trivial"), "runs/own_network"
    config = PPOConfig(num_envs=32, rollout_steps=64, network=residual)
    train(env, "ppo", steps=100_000, config=config, out=folder, overwrite=True)
    # The run names this file, which is imported because you say that you trust it.
    policy = restore_policy(folder, env, trust=("own_network",))
    print(f"mean return {evaluate(env, policy, episodes=100).mean:.2f}")


if __name__ == "__main__":
    main()

"""A custom effect with memory and a schedule: a muscle that tires.

A bending muscle along the arm follows a command slowly, and weakens as it works.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp

import jaxrod
from jaxrod import extend, schedules


@extend.pytree
class TiringMuscle(extend.Effect):
    """Equal couples about d1 on all elements: strength x freshness x activation."""

    command: jax.Array | schedules.Schedule  # wanted activation [1]; may be a schedule
    strength: jax.Array  # couple on every element [N m]
    rise_time: jax.Array  # of the activation [s]
    activation: jax.Array = extend.memory(default=0.0)  # [1]
    freshness: jax.Array = extend.memory(default=1.0)  # [1]

    def loads(self, rod, motion):
        """Couples in the material frame: they turn with the elements."""
        couple = self.strength * self.freshness * self.activation
        along = jnp.full_like(rod.rest_lengths, couple)
        none = jnp.zeros_like(along)
        return extend.Loads(couples=(along, none, none))

    def after_step(self, rod, motion, dt):
        """Activation follows the command, and work reduces freshness."""
        kept = jnp.exp(-dt / self.rise_time)
        activation = self.command + kept * (self.activation - self.command)
        tired = jnp.exp(-dt * self.activation**2)
        return replace(self, activation=activation, freshness=self.freshness * tired)


def simulate(strength=0.05, seconds=1.0):
    """The arm's tip over time [m], and the muscle's final freshness [1]."""
    rod, state = jaxrod.straight_rod(
        12, length=0.3, radius=0.01, density=1000.0, youngs_modulus=1e6
    )
    muscle = TiringMuscle(schedules.sine(1.0, period=0.4), strength, rise_time=0.05)
    damping = jaxrod.exponential_damping(5.0)
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state), damping, muscle)
    dt = jaxrod.stable_dt(scene).dt
    steps = int(seconds / dt) // 50 * 50
    records = jaxrod.rollout(scene, state, dt, steps, every=steps // 50)
    return records.tip, records.memory[-1]["freshness"][-1]


if __name__ == "__main__":
    jaxrod.configure_cpu()
    tips, freshness = simulate()
    print(f"largest swing {float(jnp.max(jnp.abs(tips[:, :2]))):.3f} m")
    print(f"freshness after a second {float(freshness):.3f}")
    slope = jax.grad(lambda s: simulate(s, 0.1)[0][-1, 1])(0.05)
    print(f"d(tip y) / d(strength) after 0.1 s: {float(slope):.3f} 1/N")

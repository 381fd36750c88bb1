"""A robot arm, read from a URDF file, swings a cable that hangs from its hand.

Waist, shoulder and elbow follow a schedule. The energy of the cable changes by the work
of the hand. Needs MuJoCo, which reads the file: pip install "jaxrod[robot]".
"""

from pathlib import Path

import jax
import jax.numpy as jnp

import jaxrod
from jaxrod import schedules

FILE = Path(__file__).with_name("robot_arm.urdf")
SECONDS = 1.0
START, END = (0.0, 0.3, 1.2), (1.2, 0.6, 0.7)  # waist, shoulder, elbow [rad]


def smooth(arm):
    """Schedule of the joints from START to END, at rest at both ends."""
    start, end = jnp.asarray(START), jnp.asarray(END)
    inside = jnp.all((arm.lower <= end) & (end <= arm.upper))
    assert inside, "a joint would leave its range"
    # Half a period of a cosine.
    middle, half = (start + end) / 2, (start - end) / 2
    return schedules.sine(half, 2 * SECONDS, phase=0.25, mean=middle)


def build():
    """Arm, cable and scene, the state at the start, and the time step."""
    arm = jaxrod.robot_arm(FILE, "hand")
    hand, _ = arm.pose(jnp.asarray(START))
    rod, state = jaxrod.straight_rod(
        10,
        length=0.4,
        radius=0.006,
        density=1200.0,
        youngs_modulus=2e6,
        start=hand,
        direction=(0.0, 0.0, -1.0),
    )
    held = arm.hold(state, smooth(arm))
    scene = jaxrod.make_scene(rod, held, jaxrod.gravity())
    return arm, scene, state, float(jaxrod.stable_dt(scene).dt)


def swing():
    """Tip over time, largest force of the hand, growth of the energy, and work."""
    _, scene, state, dt = build()
    n = int(SECONDS / dt) + 1
    dt = SECONDS / n
    states = jaxrod.rollout(scene, state, dt, n)

    def measured(state, time):
        now = scene.at(time)
        hand = jaxrod.reactions(now, state)[0]
        return jnp.linalg.norm(hand.force), now.total_energy(state), hand.power

    times = jaxrod.rollout_times(dt, n)
    force, energy, power = jax.jit(jax.vmap(measured))(states, times)
    work = dt * jnp.sum(power[1:] + power[:-1]) / 2
    return states.tip, jnp.max(force), energy[-1] - energy[0], work


if __name__ == "__main__":
    jaxrod.configure_cpu()
    arm, scene, state, _ = build()
    tips, force, growth, work = swing()
    print("joints:", ", ".join(arm.joints))
    print("hand from", arm.pose(jnp.asarray(START))[0].round(3), "m")
    print("       to", arm.pose(jnp.asarray(END))[0].round(3), "m")
    print("tip from ", tips[0].round(3), "to", tips[-1].round(3), "m")
    print(f"force of the hand: at most {force:.2f} N")
    print(f"energy grows by {growth:.4f} J, work of the hand: {work:.4f} J")

"""A soft pendulum swings up and stands: iLQR, and its feedback against a push.

A rod hangs from a pivot whose couple is too weak to lift it straight up, and bends as
it swings. iLQR finds the couple over time, and feedback of the whole rod. After a push
near the top the rod still stands with feedback, and falls without it. Run it with
`python examples/soft_pendulum.py`.
"""

import dataclasses

import jax.numpy as jnp

import jaxrod

LENGTH, LIMIT, PUSH = 0.5, 2.3, 0.4  # [m], [N m], [m/s]
SECONDS, INTERVAL, PERIOD, STEPS = 1.8, 0.03, 1.2, 40  # [s], [s], [s], [1]
N_INTERVALS = round(SECONDS / INTERVAL)


def move(data, state, couple, k):
    """The rod after an interval under a couple about y on its first element."""
    motor = jaxrod.EndLoad(jnp.zeros(3), couple * jnp.array([0.0, 1.0, 0.0]), "base")
    effects = (*data["scene"].effects, motor)
    scene = dataclasses.replace(data["scene"], effects=effects)
    return jaxrod.advance(scene, state, INTERVAL / STEPS, STEPS)


def running(data, state, couple, k):
    """Running residuals: distance from standing, speed, and effort."""
    return state.positions + data["hanging"], 0.05 * state.velocities, 0.05 * couple


def final(data, state):
    """Final residuals: the same without effort."""
    return 4 * (state.positions + data["hanging"]), 0.5 * state.velocities


def pendulum():
    """The swing-up problem for a rod that hangs straight and at rest."""
    size = {"length": LENGTH, "radius": 0.03, "density": 1000.0}
    rod, state = jaxrod.straight_rod(
        4, **size, youngs_modulus=2.2e6, direction=(0, 0, -1), normal=(0, 1, 0)
    )
    loads = jaxrod.gravity(), jaxrod.exponential_damping(0.2)
    plane = jaxrod.planar("zx")
    scene = jaxrod.make_scene(rod, jaxrod.pin_support(state), *loads, method=plane)
    time = {"n_intervals": N_INTERVALS, "interval": INTERVAL}
    return jaxrod.control.make_problem(
        state,
        move,
        **time,
        n_controls=1,
        running=running,
        final=final,
        data={"scene": scene, "hanging": state.positions},
        lower=-LIMIT,
        upper=LIMIT,
    )


def swing_up():
    """The solution; its first guess oscillates at the pace of small swings."""
    phases = 2 * jnp.pi * INTERVAL / PERIOD * jnp.arange(N_INTERVALS)
    first = 0.6 * LIMIT * jnp.sin(phases)[:, None]
    return jaxrod.control.ilqr(pendulum(), initial_controls=first, tolerance=1e-3)


def pushed(state, k):
    """A push that gives the whole rod a speed along x, 0.6 s before the end."""
    push = jnp.where(k == N_INTERVALS - round(0.6 / INTERVAL), PUSH, 0.0)
    return dataclasses.replace(state, velocities=state.velocities.at[0, 1:].add(push))


if __name__ == "__main__":
    jaxrod.configure_cpu()
    found = swing_up()
    for name, policy in (("gains", found.policy), ("plan alone", found.open_loop)):
        motion = jaxrod.control.rolled_out(found.problem, policy, pushed)
        print(f"pushed, {name}: the tip ends at {motion.states.tip[-1]} m")

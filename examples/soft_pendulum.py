"""A soft pendulum swings up and stands: iLQR, and its feedback against a push.

A rod hangs from a pivot whose couple is too weak to lift it straight up. iLQR finds the
couple over time, and feedback of the whole rod, which catches a push near the top.
"""

import dataclasses

import gallery
import jax.numpy as jnp

import jaxrod

LENGTH, LIMIT, PUSH = 0.5, 2.3, 0.4  # [m], [N m], [m/s]
N_INTERVALS, INTERVAL, PERIOD, STEPS = 60, 0.03, 1.2, 40  # [1], [s], [s], [1]
NUMBER = "height of the tip at the end, and the length of the rod [m]"
LOOK = {"frame": (10, 18, 22, 26, 31, -1), "azimuth": -90, "elevation": 8}


def move(data, state, couple, k):
    """The rod after an interval under a couple about y on its first element."""
    motor = jaxrod.EndLoad(jnp.zeros(3), couple * jnp.array([0.0, 1.0, 0.0]), "base")
    scene = dataclasses.replace(data["scene"], effects=(*data["scene"].effects, motor))
    return jaxrod.advance(scene, state, INTERVAL / STEPS, STEPS)


def running(data, state, couple, k):
    """Residuals: distance from standing, speed, and effort."""
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
    loads = jaxrod.pin_support(state), jaxrod.gravity(), jaxrod.exponential_damping(0.2)
    scene = jaxrod.make_scene(rod, *loads, method=jaxrod.planar("zx"))
    data = {"scene": scene, "hanging": state.positions}
    costs = {"running": running, "final": final, "lower": -LIMIT, "upper": LIMIT}
    time = {"n_intervals": N_INTERVALS, "interval": INTERVAL, "n_controls": 1}
    return jaxrod.control.make_problem(state, move, data=data, **costs, **time)


def swing_up():
    """The solution; its first guess oscillates at the pace of small swings."""
    times = INTERVAL * jnp.arange(N_INTERVALS)[:, None]
    first = 0.6 * LIMIT * jnp.sin(2 * jnp.pi / PERIOD * times)
    return jaxrod.control.ilqr(pendulum(), initial_controls=first, tolerance=1e-3)


def pushed(state, k):
    """A push that gives the whole rod a speed along x, 0.6 s before the end."""
    push = jnp.where(k == N_INTERVALS - round(0.6 / INTERVAL), PUSH, 0.0)
    return dataclasses.replace(state, velocities=state.velocities.at[0, 1:].add(push))


def build():
    """The hanging rod, its state and the time step."""
    problem = pendulum()
    return problem.data["scene"], problem.start, INTERVAL / STEPS


def run(share=1.0):
    """A replay of the pushed rod, the final height of its tip, and its length."""
    found = swing_up()
    states = jaxrod.control.rolled_out(found.problem, found.policy, pushed).states
    times, model = INTERVAL * jnp.arange(N_INTERVALS + 1), found.problem.data["scene"]
    replay = jaxrod.viz.Replay.from_states(model, states, times, title="Soft pendulum")
    return replay, float(states.tip[-1, 2]), LENGTH


if __name__ == "__main__":
    gallery.show(__file__, run, NUMBER, LOOK)

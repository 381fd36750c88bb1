"""A soft pole swings up on a cart and stands: iLQR, and its feedback against a push.

A rod hangs from a cart that accelerates along a rail. In the cart's frame this is
exactly a gravity. Run it with `python examples/soft_cart_pole.py`.
"""

import dataclasses

import jax.numpy as jnp

import jaxrod

LENGTH, LIMIT, PUSH = 0.5, 10.0, 0.4  # [m], [m/s^2], [m/s]
SECONDS, INTERVAL, PERIOD, STEPS = 1.8, 0.03, 1.2, 40  # [s], [s], [s], [1]
N_INTERVALS = round(SECONDS / INTERVAL)


def move(data, state, acceleration, k):
    """The rod in the cart's frame, and the cart's position and speed [m], [m/s]."""
    scene, a, (x, v) = data["scene"], acceleration[0], state["cart"]
    felt = jnp.array([0.0, 0.0, -9.81]).at[0].set(-a)
    scene = dataclasses.replace(scene, effects=(*scene.effects, jaxrod.Gravity(felt)))
    rod = jaxrod.advance(scene, state["rod"], INTERVAL / STEPS, STEPS)
    x, v = x + INTERVAL * v + 0.5 * INTERVAL**2 * a, v + INTERVAL * a
    return {"rod": rod, "cart": jnp.stack([x, v])}


def running(data, state, acceleration, k):
    """Running residuals: distance of nodes and cart, speed, and effort."""
    rod, others = state["rod"], (0.3 * state["cart"], 0.01 * acceleration)
    return rod.positions + data["hanging"], 0.05 * rod.velocities, others


def final(data, state):
    """Final residuals: the same without effort."""
    place = state["rod"].positions + data["hanging"]
    return 4 * place, 0.5 * state["rod"].velocities, state["cart"]


def cart_pole():
    """The swing-up problem for a rod that hangs straight and at rest."""
    size = {"length": LENGTH, "radius": 0.03, "density": 1000.0}
    rod, state = jaxrod.straight_rod(
        4, **size, youngs_modulus=2.2e6, direction=(0, 0, -1), normal=(0, 1, 0)
    )
    effects = jaxrod.pin_support(state), jaxrod.exponential_damping(0.2)
    scene = jaxrod.make_scene(rod, *effects, method=jaxrod.planar("zx"))
    sizes = {"n_intervals": N_INTERVALS, "interval": INTERVAL, "n_controls": 1}
    return jaxrod.control.make_problem(
        {"rod": state, "cart": jnp.zeros(2)},
        move,
        **sizes,
        running=running,
        final=final,
        data={"scene": scene, "hanging": state.positions},
        lower=-LIMIT,
        upper=LIMIT,
    )


def swing_up():
    """The solution; the first guess moves the cart at the pace of small swings."""
    phases = 2 * jnp.pi * INTERVAL / PERIOD * jnp.arange(N_INTERVALS)
    first = 0.6 * LIMIT * jnp.sin(phases)[:, None]
    return jaxrod.control.ilqr(cart_pole(), initial_controls=first, tolerance=1e-3)


def pushed(state, k):
    """A push that gives the whole rod a speed along x, 0.6 s before the end."""
    push = jnp.where(k == N_INTERVALS - round(0.6 / INTERVAL), PUSH, 0.0)
    velocities = state["rod"].velocities.at[0, 1:].add(push)
    return {**state, "rod": dataclasses.replace(state["rod"], velocities=velocities)}


if __name__ == "__main__":
    jaxrod.configure_cpu()
    found = swing_up()
    for name, policy in (("gains", found.policy), ("plan alone", found.open_loop)):
        motion = jaxrod.control.rolled_out(found.problem, policy, pushed)
        print(f"pushed, {name}: tip at {motion.states['rod'].tip[-1]} m")

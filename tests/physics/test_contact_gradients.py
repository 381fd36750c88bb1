"""Contact is differentiable, finite wherever a rod may get, and compiled once."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.stepping.runs import _traced_compiled
from physics.rods import RADIUS, arm
from physics.touching import contact_loads, rubbing

# Few elements, hence long ones: what a ball does between two nodes is not the point.
pytestmark = pytest.mark.filterwarnings("ignore::jaxrod.ThinBodyWarning")


def struck(n=4, dtype=jnp.float64):
    """An arm that is held at one end and swings onto a sphere, and its scene."""
    rod, state = arm(n, dtype)
    scene = jaxrod.make_scene(
        rod,
        jaxrod.clamp(state),
        jaxrod.contact(
            jaxrod.shapes.sphere((0.01, -0.152, 0.7), 0.1),
            stiffness=1e5,
            damping=100.0,
            friction=0.4,
        ),
    )
    swing = state.velocities.at[1].set(-2 * state.positions[2])
    return scene, replace(state, velocities=swing.at[0].set(0.3 * state.positions[2]))


@pytest.mark.slow
def test_gradients_through_contact_are_those_of_finite_differences(record):
    """With respect to every number: body, contact law, rod, and the way it starts."""
    scene, state = struck()
    dt = 0.8 * jaxrod.stable_dt(scene).dt

    @jax.jit
    @jax.value_and_grad
    def landing(numbers):
        scene, state = numbers
        after = jaxrod.advance(scene, state, dt, 50)
        return jnp.sum(after.tip * jnp.asarray([1.0, 2.0, 3.0]))

    start = jax.tree.map(np.asarray, (scene, state))
    slopes = jax.tree.map(np.asarray, landing(start)[1])
    assert abs(slopes[0].effects[1].stiffness * start[0].effects[1].stiffness) > 1e-5
    random = np.random.default_rng(0)
    worst = 0.0
    for _ in range(3):
        towards = jax.tree.map(
            lambda leaf: random.normal(size=leaf.shape) * leaf, start
        )

        def at(share, towards=towards):
            numbers = jax.tree.map(lambda a, b: a + share * b, start, towards)
            return float(landing(numbers)[0])

        found = (at(1e-6) - at(-1e-6)) / 2e-6
        products = jax.tree.map(lambda a, b: np.sum(a * b), slopes, towards)
        worst = max(worst, abs(sum(jax.tree.leaves(products)) / found - 1))
    record(
        "Gradient of 50 steps through contact with friction, with respect to every "
        "number",
        "finite differences",
        worst,
        at_most=1e-5,
    )


@pytest.mark.slow
def test_an_arm_is_shot_through_bodies_and_all_stays_finite_and_is_compiled_once():
    scene, state = struck()
    shot = replace(
        state,
        positions=state.positions.at[1].set(0.2),
        velocities=jnp.zeros_like(state.velocities).at[1].set(-100.0),
    )
    sizes = []
    for radius, stiffness in ((0.1, 2e4), (0.02, 3e4), (1e-4, 1e4)):
        body = jaxrod.shapes.sphere((0.0, 0.0, 0.5), radius)
        soft = replace(scene.effects[1], body=body, stiffness=jnp.asarray(stiffness))
        free = replace(scene, effects=(scene.effects[0], soft))
        at = shot
        for _ in range(20):
            at = jaxrod.advance(free, at, 1e-5, 20)
            assert all(jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(at))
        assert at.positions[1, 2] < -0.15
        sizes.append(_traced_compiled._cache_size())
    assert len(set(sizes)) == 1


def test_loads_have_finite_gradients_at_every_turning_point():
    """At a centre, where contact begins, where it is full, and where nothing slips."""
    dtype = jnp.float32
    rod, state = arm(6, dtype)
    width, touching = 0.01 * RADIUS, 0.1 + RADIUS
    heights = touching + width * np.array([0.5, 0.5 - 1e-3, 0.0, -0.5, -1.0, 0.0])
    heights = jnp.asarray(np.append(heights, 0.0), dtype)
    state = replace(state, positions=jnp.zeros_like(state.positions).at[1].set(heights))
    contact = jax.tree.map(
        lambda leaf: leaf.astype(dtype),
        rubbing(jaxrod.shapes.sphere((0.0, 0.0, 0.0), 0.1), onset=0.01),
    )

    @jax.jit
    def slopes(contact, state):
        def total(contact, state):
            return sum(jnp.sum(load) for load in contact_loads(contact, rod, state))

        return jax.grad(total, argnums=(0, 1))(contact, state)

    for speed in (0.0, 1.0, -1.0):
        moving = replace(state, velocities=state.velocities + speed)
        found = jax.tree.leaves(slopes(contact, moving))
        assert all(jnp.all(jnp.isfinite(leaf)) for leaf in found)

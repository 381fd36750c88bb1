"""Gradients through time are finite and right, at rest, in motion, for every number."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.methods.laws import IN_SPACE
from physics.rods import arm, largest, turn

# Reverse mode of every parameter in both modes: minutes of compiling.
pytestmark = pytest.mark.slow

N, STEPS = 4, 20
# The programs run a hundred times at most: LLVM need not optimise them.
HURRY = {"xla_backend_optimization_level": 0}


def scene_and_state(mode, moving):
    """A straight clamped arm with every effect: at rest and unloaded, or in motion."""
    rod, state = arm(N, youngs_modulus=1e6)
    size = 1.0 if moving else 0.0
    wave = np.sin(np.arange(3 * N).reshape(3, N))
    wall = jaxrod.clamp(state) if mode == "consistent" else jaxrod.fixed_end(state)
    scene = jaxrod.make_scene(
        rod,
        jaxrod.gravity(size * np.array([1.0, -2.0, -9.0])),
        jaxrod.end_load(size * np.array([3.0, 5.0, -2.0]), (size, -size, size)),
        jaxrod.uniform_load((size, 0.0, size), (0.0, size, -size)),
        jaxrod.actuation.ElementCouples(jnp.asarray(size * wave)),
        wall,
        jaxrod.exponential_damping(2.0 * size, 5.0 * size),
        method=IN_SPACE[mode],
    )
    if moving:
        turns = 0.1 * np.cos(np.arange(3 * N).reshape(3, N))
        speeds = 0.3 * np.sin(np.arange(3 * N + 3).reshape(3, N + 1))
        state = replace(
            state,
            orientations=turn(state.orientations, turns),
            velocities=jnp.asarray(speeds),
        )
        state = jaxrod.with_angular_velocities(rod, state, jnp.asarray(10 * wave))
    return scene, state


RUNS = {
    "step": jaxrod.step,
    "advance": partial(jaxrod.advance, n_steps=STEPS),
    "rollout": partial(jaxrod.rollout, n_steps=STEPS, every=5),
}


def mixture(tree):
    """A number that depends on every entry of every leaf."""
    return sum(
        jnp.vdot(leaf, jnp.cos(1.0 + jnp.arange(leaf.size)).reshape(leaf.shape))
        for leaf in jax.tree.leaves(tree)
    )


def loss_of(run):
    def loss(numbers):
        scene, state, dt = numbers
        end = run(scene, state, dt)
        # Angular momenta are small numbers: weigh them like the others.
        return mixture(replace(end, angular_momenta=1e3 * end.angular_momenta))

    return loss


def directions(numbers):
    """For every leaf a random direction of its own size that changes it alone."""
    leaves, structure = jax.tree.flatten(numbers)
    random = np.random.default_rng(0)
    for i, leaf in enumerate(leaves):
        size = largest(leaf) or 1.0
        push = jnp.asarray(size * random.normal(size=np.shape(leaf)))
        only = [jnp.zeros_like(other) for other in leaves]
        yield structure.unflatten([*only[:i], push, *only[i + 1 :]])


def inner(a, b):
    return sum(
        jnp.vdot(x, y) for x, y in zip(*map(jax.tree.leaves, (a, b)), strict=True)
    )


@cache
def differentiated(name):
    """Loss and gradient of a kind of run, compiled once per mode."""
    return jax.jit(jax.value_and_grad(loss_of(RUNS[name])), compiler_options=HURRY)


@pytest.mark.parametrize("moving", [False, True], ids=["at rest", "moving"])
@pytest.mark.parametrize(
    ("name", "mode"),
    [
        ("step", "consistent"),
        ("step", "pyelastica"),
        ("advance", "consistent"),
        ("advance", "pyelastica"),
        ("rollout", "consistent"),
    ],
)
def test_gradients_agree_with_differences(name, mode, moving, record):
    numbers = (*scene_and_state(mode, moving), jnp.asarray(2e-4))
    evaluate = differentiated(name)
    value, gradient = evaluate(numbers)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))
    size, worst, seen = 1e-5, 0.0, 0
    for direction in directions(numbers):
        there, back = (
            evaluate(
                jax.tree.map(lambda x, d, s=s: x + s * size * d, numbers, direction)
            )[0]
            for s in (1, -1)
        )
        expected = float(there - back) / (2 * size)
        got = float(inner(gradient, direction))
        # A number that has no influence leaves only round-off to compare.
        noise = 1e-9 * max(1.0, abs(float(value)))
        worst = max(worst, abs(got - expected) / max(abs(expected), noise / 1e-6))
        seen += abs(got) > noise
    assert seen >= (10 if moving else 5), "too few numbers have an influence"
    record(
        f"Gradient through {name}, {mode}, {'moving' if moving else 'at rest'}: "
        "all parameters, loads, state, dt",
        "central differences",
        worst,
        at_most=1e-6,
    )


def test_forward_and_reverse_mode_are_transposes(record):
    """<w, J u> = <J^T w, u>, for the last of several differentiated steps."""
    numbers = (*scene_and_state("consistent", moving=True), jnp.asarray(2e-4))

    def run(numbers):
        return RUNS["advance"](*numbers)

    hurry = jax.jit(compiler_options=HURRY)
    ahead = hurry(lambda numbers, u: jax.jvp(run, (numbers,), (u,))[1])
    back = hurry(lambda numbers, w: jax.vjp(run, numbers)[1](w)[0])

    random = np.random.default_rng(1)
    like = lambda leaf: jnp.asarray(
        (largest(leaf) or 1.0) * random.normal(size=np.shape(leaf))
    )
    u = jax.tree.map(like, numbers)
    w = jax.tree.map(like, numbers[1])
    forward, reverse = inner(w, ahead(numbers, u)), inner(back(numbers, w), u)
    record(
        "Forward against reverse mode through 20 steps",
        "<w, J u> = <J^T w, u>",
        abs(float(forward / reverse) - 1),
        at_most=1e-12,
    )


def test_forward_mode_through_a_traced_number_of_steps():
    scene, state = scene_and_state("consistent", moving=True)

    def height(dt, scene, state, n_steps):
        return jaxrod.advance(scene, state, dt, n_steps).tip[2]

    hurry = jax.jit(compiler_options=HURRY)
    forward = hurry(jax.jacfwd(height))
    reverse = hurry(jax.grad(lambda *args: height(*args, STEPS)))
    dt = jnp.asarray(2e-4)
    expected = float(reverse(dt, scene, state))
    assert abs(expected) > 0.1
    got = forward(dt, scene, state, jnp.asarray(STEPS))
    assert float(got) == pytest.approx(expected, rel=1e-10)


def test_the_gradient_of_a_static_deflection_is_the_analytical_one(record):
    """Bent a little, a settled cantilever's tip is proportional to 1/E."""
    rod, state = arm(2, youngs_modulus=1e5)
    wall = jaxrod.clamp(state)

    @jax.jit
    @jax.value_and_grad
    def deflection(log_modulus):
        factor = jnp.exp(log_modulus)
        stiffer = replace(
            rod,
            bend_twist_stiffness=factor * rod.bend_twist_stiffness,
            shear_stretch_stiffness=factor * rod.shear_stretch_stiffness,
        )
        load = jaxrod.end_load((1e-5, 0.0, 0.0))
        damping = jaxrod.exponential_damping(1.3)
        scene = jaxrod.make_scene(stiffer, wall, load, damping)
        return jaxrod.advance(scene, state, 6e-3, 6000).tip[0]

    value, slope = deflection(0.0)
    record(
        "Sensitivity E dw/dE of a settled cantilever's deflection w",
        "-w",
        abs(float(slope / value) + 1),
        at_most=1e-6,
    )

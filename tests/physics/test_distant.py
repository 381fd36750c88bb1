"""Effects that couple distant elements: tangents, Newton's method, derivatives."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from physics.distant import Repulsion, Tendon
from physics.rods import arm

# The programs run a few times: LLVM need not optimise them.
HURRY = {"xla_backend_optimization_level": 0}
N = 7

# Stiffness of a spring, tension and stiffness of a tendon, strength of a repulsion; and
# where the spring's ends are.
CASES = {
    "a spring from the wall to the tip": ((0.2, 0, 0, 0), (0, N)),
    "a spring from node 3 to the last": ((2.0, 0, 0, 0), (3, N)),
    "a spring from node 1 to node 5": ((2.0, 0, 0, 0), (1, 5)),
    "a tendon through five eyelets, under tension": ((0, 0.3, 0, 0), (0, N)),
    "an elastic tendon through five eyelets": ((0, 0, 3.0, 0), (0, N)),
    "a force between all distant pairs": ((0, 0, 0, 0.02), (0, N)),
    "all of them": ((1.0, 0.2, 1.0, 0.01), (2, 6)),
}


def entangled(numbers, ends, method=None):
    """A cantilever with all of them, of given strengths, material and load.

    Every effect is there in every case: it is one program.
    """
    spring, tension, tendon, repulsion, modulus, load = numbers
    rod, state = arm(N, radius=0.02, youngs_modulus=1e6)
    rod = replace(
        rod,
        bend_twist_stiffness=modulus * rod.bend_twist_stiffness,
        shear_stretch_stiffness=modulus * rod.shear_stretch_stiffness,
    )
    zero = jnp.zeros(())
    eyelets = jnp.asarray([0, 2, 3, 5, N])
    force = load * jnp.asarray([0.05, 0.02, -0.01])
    scene = jaxrod.make_scene(
        rod,
        jaxrod.clamp(state),
        jaxrod.end_load(force, (0.0, 0.0, 0.01)),
        jaxrod.exponential_damping(0.5),
        Tendon(zero, spring, zero + 0.2, ends),
        Tendon(tension, tendon, zero + 0.8, eyelets),
        Repulsion(repulsion, zero + 0.3),
        method=method,
    )
    return scene, state


def mixture(state):
    """A number that depends on every position and orientation."""
    return sum(
        jnp.vdot(part, jnp.cos(1.0 + jnp.arange(part.size)).reshape(part.shape))
        for part in (state.positions, state.orientations)
    )


def check_gradient(value_and_gradient, numbers, what, record):
    """Against central differences, each number that is not zero."""
    numbers = jnp.asarray(numbers)
    gradient = value_and_gradient(numbers)[1]
    worst = 0.0
    for k in np.flatnonzero(numbers):
        step = 1e-4 * numbers[k] * jnp.eye(len(numbers))[k]
        low, high = (value_and_gradient(numbers + s * step)[0] for s in (-1, 1))
        expected = float(high - low) / float(2 * step[k])
        worst = max(worst, abs(float(gradient[k]) / expected - 1))
    record(
        f"Gradient of {what}: strength, material, load",
        "central differences",
        worst,
        at_most=1e-6,
    )


@partial(jax.jit, compiler_options=HURRY)
def balanced(numbers, ends, tolerance):
    """The mixture in equilibrium, its gradient, and how it was found."""

    def value(numbers):
        scene, state = entangled(numbers, ends)
        found = jaxrod.equilibrium(scene, state, tolerance=tolerance)
        return mixture(found.state), found

    (value, found), gradient = jax.value_and_grad(value, has_aux=True)(numbers)
    return value, gradient, found


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_an_equilibrium_depends_on_every_number_as_differences_say(name, record):
    strengths, ends = CASES[name]
    numbers, ends = jnp.asarray([*strengths, 1.0, 1.0]), jnp.asarray(ends)
    rough, exact = (balanced(numbers, ends, bound)[2] for bound in (1e-3, 1e-10))
    assert bool(exact.converged) and bool(exact.stable) and not bool(exact.loose)
    assert int(exact.iterations) <= int(rough.iterations) + 2, "not quadratic"
    check_gradient(
        lambda x: balanced(x, ends, 1e-10)[:2],
        numbers,
        f"an equilibrium with {name}",
        record,
    )


@pytest.mark.slow
def test_a_spring_that_buckles_a_column_makes_it_unstable():
    numbers = jnp.asarray([2.0, 0, 0, 0, 1.0, 0.0])
    found = balanced(numbers, jnp.asarray([0, N]), 1e-10)[2]
    assert bool(found.converged) and not bool(found.stable)


@partial(jax.jit, compiler_options=HURRY)
def stepped(numbers, ends):
    """The mixture after three implicit steps, and its gradient."""

    def value(numbers):
        exact = jaxrod.implicit(0.8, tolerance=1e-11)
        scene, state = entangled(numbers, ends, exact)
        return mixture(jaxrod.advance(scene, state, 0.05, 3))

    return jax.value_and_grad(value)(numbers)


@pytest.mark.slow  # Half a minute of compiling.
@pytest.mark.parametrize("name", CASES)
def test_implicit_steps_depend_on_every_number_as_differences_say(name, record):
    strengths, ends = CASES[name]
    ends = jnp.asarray(ends)
    check_gradient(
        lambda x: stepped(x, ends),
        (*strengths, 1.0, 1.0),
        f"three implicit steps with {name}",
        record,
    )

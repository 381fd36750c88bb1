"""What a scene that leaves something out must keep: one program, and lower costs."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from physics.rods import arm


def check_one_program(scene, state, rtol):
    """Batches and other numbers compile nothing and compute what one rod computes."""
    runs = 0

    def height(scene, state, dt, n_steps):
        nonlocal runs
        runs += 1
        return jaxrod.advance(scene, state, dt, n_steps).tip[1]

    compiled = jax.jit(height)
    alone = [float(compiled(scene, state, dt, 40)) for dt in (1e-4, 2e-4)]
    stiffness = 2 * scene.rod.bend_twist_stiffness
    stiffer = replace(scene, rod=replace(scene.rod, bend_twist_stiffness=stiffness))
    assert float(compiled(stiffer, state, 1e-4, 41)) != alone[0]
    assert runs == 1
    together = jax.jit(jax.vmap(height, in_axes=(None, None, 0, None)))(
        scene, state, jnp.array([1e-4, 2e-4]), 40
    )
    np.testing.assert_allclose(together, alone, rtol=rtol)


def arithmetic_left(**changes):
    """Flops of a step of a damped, hanging arm with changes, over those without."""
    rod, state = arm(20)
    scene = jaxrod.make_scene(
        rod, jaxrod.clamp(state), jaxrod.gravity(), jaxrod.exponential_damping(1.0)
    )

    def flops(scene):
        """Of one step within many."""
        integrator = scene.method.stepper(scene, state, jnp.asarray(1e-4))
        carry = integrator.begin(state)
        return jax.jit(integrator.cycle).lower(carry).compile().cost_analysis()["flops"]

    return flops(replace(scene, **changes)) / flops(scene)

"""Rods and bodies that several laws are tested on."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp

import jaxrod

SOFT = {"radius": 0.02, "density": 1000.0, "youngs_modulus": 1e6}


def rod(n_elements=6, length=0.5, start=(0, 0, 0), direction=(1, 0, 0), **changes):
    return jaxrod.straight_rod(
        n_elements,
        length=length,
        start=start,
        direction=direction,
        dtype=jnp.float64,
        **SOFT | changes,
    )


def stirred(state, seed=0, speed=0.3):
    """A state whose nodes move smoothly, in no plane."""
    key = jax.random.key(seed)
    along = jnp.linspace(0, 1, state.positions.shape[1])
    a, b = jax.random.normal(key, (2, 3, 1))
    along = along[None, :]
    return replace(
        state, velocities=speed * (a * jnp.sin(3 * along) + b * jnp.cos(2 * along))
    )


def free_system():
    """Two rods welded at an angle, tied to a third, a body on it, another on a ball.

    Nothing holds it; all joints have dashpots but the exact ones.
    """
    one, of_one = rod()
    two, of_two = rod(4, 0.3, (0.5, 0, 0), (0, 0.6, 0.8))
    three, of_three = rod(5, 0.4, (0.5, 0, 0), (0, -1, 0))
    head, of_head = jaxrod.systems.rigid_body(
        jaxrod.shapes.box((-0.05, 0.01, 0.0), (0.05, 0.03, 0.02)),
        density=2000.0,
        angular_velocity=(2.0, -1.0, 3.0),
        dtype=jnp.float64,
    )
    ball, of_ball = jaxrod.systems.rigid_body(
        jaxrod.shapes.sphere((0.5, -0.43, 0.0), 0.03),
        density=900.0,
        velocity=(0.1, 0.0, -0.2),
        dtype=jnp.float64,
    )
    rest = {
        "one": of_one,
        "two": of_two,
        "three": of_three,
        "head": of_head,
        "ball": of_ball,
    }
    hinged = jaxrod.systems.hinge_joint(
        ("three", "tip"),
        ("ball",),
        rest,
        axis=(1.0, 0.2, 0.1),
        stiffness=500.0,
        damping=0.05,
        axis_stiffness=0.05,
        axis_damping=1e-5,
    )
    system = jaxrod.make_system(
        {
            "one": jaxrod.make_scene(one),
            "two": jaxrod.make_scene(two),
            "three": jaxrod.make_scene(three),
            "head": head,
            "ball": ball,
        },
        jaxrod.systems.weld(("one", "tip"), ("two", "base"), rest),
        jaxrod.systems.tie(("two", "base"), ("three", "base"), rest),
        jaxrod.systems.attach(("one", "base"), ("head",), rest),
        hinged,
        state=rest,
    )
    state = {
        **rest,
        "one": stirred(of_one, 1),
        "two": stirred(of_two, 2),
        "three": stirred(of_three, 3),
    }
    # Once through a step of no length: all ties are kept.
    return system, jaxrod.advance(system, state, 1e-12, 1)

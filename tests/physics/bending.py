"""Rods bent to circular arcs, for laws of materials that depend on history."""

from dataclasses import replace

import jax
import jax.numpy as jnp

import jaxrod

rotations = jaxrod.extend.rotations


def straight(n_elements=4, length=1.0, radius=0.05, **given):
    """A rod of 1 MPa along x, whose d1 is along z."""
    return jaxrod.straight_rod(
        n_elements,
        length=length,
        radius=radius,
        density=1000.0,
        youngs_modulus=1e6,
        direction=(1.0, 0.0, 0.0),
        normal=(0.0, 0.0, 1.0),
        **given,
    )


def arc(rod, state, curvature):
    """State of a straight rod at the same curvature `(2,)` about d1 and d2 everywhere.

    It begins like `state`, and no element is stretched.
    """
    lengths = jnp.pad(rod.joint_lengths, (1, 0))
    turns = [part * jnp.cumsum(lengths) for part in (*curvature, 0.0)]
    start = rotations.split_quaternion(state.orientations[:, :1])
    turned = rotations.multiply_quaternions(start, rotations.rotation_exp(turns))
    edges = rod.rest_lengths[None, :] * jnp.stack(rotations.directors(turned)[2])
    positions = state.positions[:, :1] + jnp.pad(
        jnp.cumsum(edges, axis=1), ((0, 0), (1, 0))
    )
    return replace(
        state, positions=positions, orientations=rotations.join_quaternion(turned)
    )


def moments_along(effect, rod, state, curvatures, dt=1e-3):
    """Moments `(steps, 2)` about d1 and d2 of an effect, in the middles of steps.

    `curvatures` are those of the whole rod there, `(steps, 2)`; `state` is straight.
    Also the effect after each step.
    """
    member = jaxrod.make_scene(rod).as_member()

    def one(effect, curvature):
        motion = member.motion(arc(rod, state, curvature))
        couples = effect.during_step(0.5 * dt).loads(rod, motion).couples
        after = effect.after_step(rod, motion, dt)
        return after, (jnp.stack([couples[0][0], couples[1][0]]), after)

    return jax.jit(lambda effect: jax.lax.scan(one, effect, curvatures)[1])(effect)

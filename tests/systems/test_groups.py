"""Equal rods in one member are the same rods as members of their own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from systems.members import rod, stirred

STEPS = 300


def arm(start, seed):
    """A rod that hangs from a wall, stirred, above the ground."""
    body, state = rod(6, 0.5, start)
    state = stirred(state, seed)
    scene = jaxrod.make_scene(
        body,
        jaxrod.clamp(state),
        jaxrod.gravity(),
        jaxrod.exponential_damping(0.5),
        jaxrod.contact(jaxrod.shapes.plane((0, 0, -0.05), (0, 0, 1)), stiffness=1e4),
    )
    return scene, state


@pytest.mark.slow
def test_a_stack_of_rods_is_each_of_them_as_a_member(record):
    """To one rounding of orientations: XLA contracts sums of a stack in its own way."""
    starts = jnp.array([[0.0, 0.0, 0.0], [0.1, 0.3, 0.02], [0.0, 0.6, -0.01]])
    made = [arm(start, seed) for seed, start in enumerate(starts)]
    stack = jax.tree.map(lambda *leaves: jnp.stack(leaves), *made)
    group = jaxrod.make_system({"arms": stack[0]})
    names = [f"arm {k}" for k in range(len(made))]
    members = {name: scene for name, (scene, _) in zip(names, made, strict=True)}
    single = jaxrod.make_system(members)
    state = {name: own for name, (_, own) in zip(names, made, strict=True)}
    dt = jaxrod.stable_dt(single).dt
    assert float(jaxrod.stable_dt(group).dt) == float(dt)
    together = jaxrod.advance(group, {"arms": stack[1]}, dt, STEPS)["arms"]
    alone = jaxrod.advance(single, state, dt, STEPS)
    alone = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(alone[n] for n in names))
    assert float(jnp.max(jnp.abs(alone.positions - stack[1].positions))) > 1e-2
    for field in ("positions", "orientations", "velocities", "angular_momenta"):
        one, other = (np.asarray(getattr(x, field)) for x in (together, alone))
        record(
            f"three rods in one member after {STEPS} steps: {field}, relative",
            "the same as three members",
            np.max(np.abs(one - other)) / np.max(np.abs(other)),
            at_most=1e-14,
        )

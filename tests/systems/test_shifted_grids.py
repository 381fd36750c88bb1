"""Contact between rods knows nothing of where their nodes lie."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.systems.stepping.assembly import seen_at_rest
from systems.members import SOFT, rod

STIFFNESS, LENGTH, N, M = 1e4, 0.5, 7, 20
RADIUS = SOFT["radius"]
DEPTH = 0.3 * RADIUS
SHIFTS = np.linspace(0.05, 0.95, 7)
"""Of the inner nodes of one rod, in its elements."""


@jax.jit
def loads_of(system, state):
    seen, (contact,) = seen_at_rest(system, state)
    return {name: jnp.stack(on.forces) for name, on in contact.loads(seen).items()}


def of_other(shift, law, depths):
    """Force on a rod, and its moment about its middle, whose grid is shifted.

    Args:
        shift: Of the inner nodes.
        law: Contact of rods "one" and "two".
        depths: Penetration at its start and at its finish [m].
    """
    along = np.concatenate([[0.0], (np.arange(M) + shift) / M, [1.0]]) * LENGTH
    away = 2 * RADIUS - np.interp(along, [0, LENGTH], depths)
    two, of_two = jaxrod.rod_along(
        np.stack([along, away, 0 * along]), **SOFT, dtype=jnp.float64
    )
    one, of_one = rod(N, LENGTH)
    state = {"one": of_one, "two": of_two}
    system = jaxrod.make_system(
        {"one": jaxrod.make_scene(one), "two": jaxrod.make_scene(two)}, law
    )
    push = np.asarray(loads_of(system, state)["two"][1])
    return np.sum(push), np.sum(push * (along - LENGTH / 2))


@pytest.mark.slow
def test_force_and_moment_of_parallel_rods_on_shifted_grids(record):
    law = jaxrod.systems.rod_contact("one", "two", stiffness=STIFFNESS)
    found = np.array([of_other(shift, law, (DEPTH, DEPTH)) for shift in SHIFTS])
    force = STIFFNESS * DEPTH * LENGTH
    record(
        "parallel rods on shifted grids: force",
        "stiffness times depth times length",
        np.max(np.abs(found[:, 0] / force - 1)),
        at_most=1e-12,
    )
    record(
        "parallel rods on shifted grids: moment over force times length",
        "0",
        np.max(np.abs(found[:, 1])) / (force * LENGTH),
        at_most=1e-12,
    )


@pytest.mark.slow
def test_force_and_moment_of_inclined_rods_on_shifted_grids(record):
    """Deeper at one end than at the other: integrals of the line law."""
    law = jaxrod.systems.rod_contact("one", "two", stiffness=STIFFNESS)
    deep = 1.5 * DEPTH, 0.5 * DEPTH
    found = np.array([of_other(shift, law, deep) for shift in SHIFTS])
    force = STIFFNESS * DEPTH * LENGTH
    moment = -STIFFNESS * (deep[0] - deep[1]) * LENGTH**2 / 12
    for name, one, whole in (
        ("force", found[:, 0], force),
        ("moment", found[:, 1], moment),
    ):
        record(
            f"inclined rods on shifted grids: {name}",
            "the integral of stiffness times depth",
            np.max(np.abs(one / whole - 1)),
            at_most=1e-2,
        )
        record(
            f"inclined rods on shifted grids: {name}, spread over all shifts",
            "0",
            np.ptp(one) / abs(whole),
            at_most=1e-3,
        )

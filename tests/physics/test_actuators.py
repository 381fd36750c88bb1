"""Laws of every actuator: energy, momentum, bounds, gradients, batches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.geometry import vectors
from jaxrod.rods.motion import motion_of
from physics.actuators import actuators, at_once, uneven_rod
from physics.rods import no_moves, perturb

NAMES = tuple(actuators(*uneven_rod()[:2]))


@pytest.fixture(scope="module")
def looked_at():
    """Loads, slopes of energies, totals of every actuator, from one program."""
    rod, rest, state = uneven_rod()
    effects = at_once(tuple(actuators(rod, rest).values()))

    @jax.jit
    def look(effects, rod, state):
        found = []
        for effect in effects:
            slopes = jax.grad(
                lambda moves, effect=effect: effect.energy(rod, perturb(state, moves))
            )(no_moves(state))
            loads = effect.loads(rod, motion_of(state))
            still = jnp.zeros_like(state.positions)
            forces = still if loads.forces is None else vectors.join(loads.forces)
            couples = vectors.join(loads.couples)
            found.append((forces, couples, *slopes))
        return found

    found = look(effects, rod, state)
    return dict(zip(NAMES, jax.tree.map(np.asarray, found), strict=True)), state


@pytest.mark.parametrize("name", NAMES)
def test_loads_are_minus_the_gradient_of_the_energy(looked_at, name, record):
    forces, couples, by_place, by_turn = looked_at[0][name]
    size = max(np.max(np.abs(forces)), np.max(np.abs(couples)))
    assert size > 1e-6
    gap = max(np.max(np.abs(forces + by_place)), np.max(np.abs(couples + by_turn)))
    record(
        f"Loads against minus the gradient of the energy: {name}",
        "automatic differentiation",
        gap / size,
        at_most=1e-12,
    )

"""What ten elements are worth: as right as a fine rod, at a fifth of the usual cost."""

import jax
import jax.numpy as jnp
import pytest

import jaxrod
from physics.rods import arm

FEW, USUAL, MANY = 10, 20, 160
USUAL_STEP = 2e-4


def clamped(n, *loads):
    rod, state = arm(n)
    return jaxrod.make_scene(rod, jaxrod.clamp(state), *loads), state


LOADS = {
    "a load at its tip": (jaxrod.end_load(force=(1e-3, 0.0, 0.0)), 6e-3),
    "its own weight": (jaxrod.gravity((1e-3, 0.0, 0.0)), 0.011),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", LOADS)
def test_the_sag_of_ten_elements(name, record):
    load, bar = LOADS[name]
    sags = []
    for n in (FEW, MANY):
        scene, state = clamped(n, load)
        found = jaxrod.equilibrium(scene, state)
        assert found.converged
        sags.append(float(found.state.tip[0]))
    record(
        f"Sag of the clamped arm under {name}, n = 10",
        "n = 160",
        abs(sags[0] / sags[1] - 1),
        at_most=bar,
    )


@pytest.mark.slow
def test_the_first_frequency_of_ten_elements(record):
    few, many = (
        jaxrod.natural_frequencies(*clamped(n), n_modes=1)[0] for n in (FEW, MANY)
    )
    record(
        "First bending frequency of the clamped arm, n = 10",
        "n = 160",
        abs(float(few / many) - 1),
        at_most=0.01,
    )


@pytest.mark.slow
@pytest.mark.usefixtures("compiled_for_cpus")
def test_the_cost_of_ten_elements(record):
    def cost(n, dt):
        """Operations per simulated second."""
        scene, state = clamped(n)
        integrator = scene.method.stepper(scene, state, jnp.asarray(dt))
        cycle = jax.jit(integrator.cycle).lower(integrator.begin(state))
        return cycle.cost_analysis()["flops"] / dt

    dt = float(jaxrod.stable_dt(clamped(FEW)[0], 0.9).dt)
    assert dt == pytest.approx(5.7e-4, rel=0.02)
    record(
        "Operations per simulated second, n = 10 at 0.9 of the stable step",
        "n = 20 at 0.2 ms",
        cost(FEW, dt) / cost(USUAL, USUAL_STEP),
        at_most=0.2,
    )

"""Travelling waves of couples beside PyElastica's `MuscleTorques`."""

from dataclasses import replace

import elastica
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from pyelastica import reference, scenes
from pyelastica.test_side_by_side import same_scene

COEFFICIENTS = np.array([0.0, 17.4, 48.5, 5.4, 14.7, 0.0])
PERIOD, WAVES, SHIFT, RAMP = 2e-2, 2 * np.pi / 0.7, 0.4, 4e-4
DIRECTION = np.array([0.3, 1.1, -0.4])


@pytest.fixture(scope="module")
def drawn():
    """A free rod, tapered, curved and uneven, that nothing else acts on."""
    nothing = reference.Loads(element_couples=np.zeros((3, 9)))
    one = scenes.random_scene(3, n_elements=9)
    still = replace(one, velocities=0 * one.velocities, loads=nothing)
    return replace(
        still,
        angular_velocities=0 * one.angular_velocities,
        clamped=False,
        damping_rate=0.0,
        deprecated_damping=0.0,
    )


@pytest.mark.slow
@pytest.mark.parametrize("steps", [1, 100])
def test_waves_of_couples_are_those_of_pyelastica(drawn, steps, record, monkeypatch):
    scene, state = same_scene(drawn)
    size = float(np.max(scene.rod.bend_twist_stiffness)) / 20
    wave = jaxrod.actuation.muscle_torques(
        scene.rod,
        size * COEFFICIENTS,
        period=PERIOD,
        wave_number=WAVES,
        direction=DIRECTION,
        phase_shift=SHIFT,
        ramp_up_time=RAMP,
    )
    scene = jaxrod.make_scene(scene.rod, wave, method=jaxrod.pyelastica())

    def add_muscles(simulator, rod, loads):
        simulator.add_forcing_to(rod).using(
            elastica.MuscleTorques,
            base_length=float(np.sum(rod.rest_lengths)),
            b_coeff=size * COEFFICIENTS,
            period=PERIOD,
            wave_number=WAVES,
            phase_shift=SHIFT,
            direction=DIRECTION,
            rest_lengths=rod.rest_lengths,
            ramp_up_time=RAMP,
            with_spline=True,
        )

    monkeypatch.setattr(reference, "_add_loads", add_muscles)
    dt = 1e-4 if steps == 1 else float(jaxrod.stable_dt(scene, 0.5).dt)
    theirs = reference.simulate(**(vars(drawn) | {"dt": dt}), steps=steps)
    ours = jaxrod.advance(scene, state, dt, jnp.asarray(steps))
    spin = jaxrod.angular_velocities(scene.rod, ours)
    assert np.max(np.abs(spin)) > 1e-3, "at rest without the wave"
    # Positions of the first step do not know of its kick.
    moved = theirs.positions[-1] - drawn.spec.positions
    name, mine, other = "angular velocities", spin, theirs.angular_velocities[-1]
    if steps > 1:
        name, mine, other = "displacements", ours.positions - state.positions, moved
    record(
        f"Travelling wave of couples after {steps} step(s), {name}, relative",
        "PyElastica 1.0, MuscleTorques",
        np.max(np.abs(mine - other)) / np.max(np.abs(other)),
        at_most=1e-12,
    )

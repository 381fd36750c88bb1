"""Times PyElastica on the arm that `jaxrod benchmark` times.

The arm: 1 m long, 5 cm in radius, E = 10 MPa, 1000 kg/m^3, clamped at its base, bent by
a constant couple on every element, damped. Both programs do the same work in every
step: internal loads, actuation, clamp and damping.
"""

from __future__ import annotations

import statistics
import time
from typing import Any

import numpy as np

TIME_STEP = 2e-4
DAMPING_RATE = 3.8
ELEMENT_COUPLE = 1.0


def pyelastica_steps_per_s(n_elements: int = 20, seconds: float = 2.0) -> float:
    """Measures how many steps per second one PyElastica process makes.

    Compiling is not counted. The time is divided into windows of a tenth of it, and
    the median window counts, so that a short disturbance does not.

    Args:
        n_elements: elements of the arm.
        seconds: time to measure [s].

    Returns:
        Steps of one rod per second [1/s].

    Raises:
        ModuleNotFoundError: if PyElastica is not installed.
        ValueError: if `seconds` is not positive or there are fewer than 2 elements.
    """
    if not seconds > 0:
        raise ValueError(f"seconds must be positive, got {seconds} s")
    if n_elements < 2:
        raise ValueError(f"n_elements must be at least 2, got {n_elements}")
    import elastica

    simulator = _arm(n_elements)
    stepper = elastica.PositionVerlet()
    clock, dt = np.float64(0.0), np.float64(TIME_STEP)

    def run(steps: int) -> float:
        nonlocal clock
        start = time.perf_counter()
        for _ in range(steps):
            clock = stepper.step(simulator, clock, dt)
        return time.perf_counter() - start

    run(100)  # compiles
    window = max(1, int(100 * seconds / 10 / run(100)))
    rates: list[float] = []
    end = time.perf_counter() + seconds
    while not rates or time.perf_counter() < end:
        rates.append(window / run(window))
    return statistics.median(rates)


def _arm(n_elements: int) -> Any:
    """Builds the clamped, actuated, damped arm, ready to step."""
    import elastica

    class Actuation(elastica.NoForces):
        """A constant couple about d1 on every element [N m], material frame."""

        couples = np.outer([ELEMENT_COUPLE, 0.0, 0.0], np.ones(n_elements))

        def apply_torques(self, system: Any, time: Any = 0.0) -> None:
            """Adds the couples."""
            system.external_torques += self.couples

    class Simulator(
        elastica.BaseSystemCollection,
        elastica.Constraints,
        elastica.Forcing,
        elastica.Damping,
    ):
        """The features that the arm needs."""

    rod = elastica.CosseratRod.straight_rod(
        n_elements,
        np.zeros(3),
        np.array([0.0, 0.0, 1.0]),
        np.array([1.0, 0.0, 0.0]),
        base_length=1.0,
        base_radius=0.05,
        density=1000.0,
        youngs_modulus=1e7,
        shear_modulus=1e7 / 3,
    )
    simulator = Simulator()
    simulator.append(rod)
    simulator.add_forcing_to(rod).using(Actuation)
    simulator.constrain(rod).using(
        elastica.OneEndFixedBC,
        constrained_position_idx=(0,),
        constrained_director_idx=(0,),
    )
    simulator.dampen(rod).using(
        elastica.AnalyticalLinearDamper,
        uniform_damping_constant=DAMPING_RATE,
        time_step=TIME_STEP,
    )
    simulator.finalize()
    return simulator

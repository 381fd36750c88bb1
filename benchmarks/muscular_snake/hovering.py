"""Rest of a rod above a plane: PyElastica's plane carries a rod in the air.

The body of the muscular snake without muscles, straight and free, on its plane: heights
of the centre of mass after a release at a height, and after a vertical wave along the
body without momentum. Both libraries take about ten seconds of processor time.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from benchmarks.muscular_snake import scene

STEP, SECONDS = 2e-5, 0.3
HEIGHTS = 0.0, 0.05e-3, 0.09e-3, 0.2e-3
"""Heights at which the body is released [m]."""
SPEEDS = 1e-3, 1e-2, 1e-1
"""Largest speeds of the wave [m/s]."""
WAVES = 5
SINKS = 0.001
"""Depth of ours in the ground at rest, over the radius: 0.025 mm."""


def waves(speed: float) -> np.ndarray:
    """Vertical speeds of the nodes [m/s]; those of their masses sum to zero."""
    place = np.arange(scene.N_BODY + 1) / scene.N_BODY
    speeds: np.ndarray = speed * np.cos(2 * np.pi * WAVES * place)
    return speeds


def theirs(height: float, speed: float) -> tuple[float, float]:
    """Height of the centre of mass at the end, and on the average of the last half."""
    import elastica as ea

    class Simulator(ea.BaseSystemCollection, ea.Forcing, ea.Damping, ea.Contact):
        pass

    simulator = Simulator()
    body = ea.CosseratRod.straight_rod(
        scene.N_BODY,
        np.array([0.0, 0.0, scene.RADIUS + height]),
        np.array([1.0, 0.0, 0.0]),
        np.array([0.0, 0.0, 1.0]),
        scene.LENGTH,
        scene.RADIUS,
        scene.DENSITY,
        youngs_modulus=scene.YOUNG,
        shear_modulus=0.75 * scene.YOUNG,
    )
    body.velocity_collection[2] = waves(speed)
    plane = ea.Plane(np.zeros(3), np.array([0.0, 0.0, 1.0]))
    for each in (body, plane):
        simulator.append(each)
    simulator.dampen(body).using(
        ea.AnalyticalLinearDamper,
        damping_constant=scene.BODY_DAMPING + scene.MUSCLE_DAMPING,
        time_step=STEP,
    )
    simulator.add_forcing_to(body).using(
        ea.GravityForces, acc_gravity=np.array([0.0, 0.0, -scene.G])
    )
    simulator.detect_contact_between(body, plane).using(
        ea.RodPlaneContactWithAnisotropicFriction,
        k=10.0,
        nu=40.0,
        slip_velocity_tol=1e-8,
        static_mu_array=2 * scene.FRICTION,
        kinetic_mu_array=scene.FRICTION,
    )
    simulator.finalize()
    stepper, time, found = ea.PositionVerlet(), np.float64(0.0), []
    for _ in range(round(SECONDS / STEP)):
        time = stepper.step(simulator, time, np.float64(STEP))
        found.append(body.position_collection[2] @ body.mass / np.sum(body.mass))
    late = np.array(found[len(found) // 2 :]) - scene.RADIUS
    return float(late[-1]), float(np.mean(late))


def ours(height: float, speed: float) -> tuple[float, float]:
    """The same here, over where the body lies at rest."""
    body, state = jaxrod.straight_rod(
        scene.N_BODY,
        length=scene.LENGTH,
        radius=scene.RADIUS,
        density=scene.DENSITY,
        youngs_modulus=scene.YOUNG,
        shear_modulus=0.75 * scene.YOUNG,
        start=(0.0, 0.0, scene.RADIUS + height),
        direction=(1.0, 0.0, 0.0),
        normal=(0.0, 0.0, 1.0),
        dtype=jnp.float64,
    )
    line, depth = float(body.linear_density[0]), SINKS * scene.RADIUS
    ground = jaxrod.contact(
        jaxrod.shapes.plane((0.0, 0.0, depth), (0.0, 0.0, 1.0)),
        stiffness=line * scene.G / depth,
        damping=300.0 * line,
        friction=scene.FRICTION,
        friction_drag=1000.0 * line,
    )
    made = jaxrod.make_scene(
        body,
        jaxrod.gravity((0.0, 0.0, -scene.G)),
        ground,
        jaxrod.exponential_damping(scene.BODY_DAMPING + scene.MUSCLE_DAMPING),
    )
    speeds = jnp.zeros((3, scene.N_BODY + 1)).at[2].set(waves(speed))
    state = replace(state, velocities=speeds)
    every = 50
    found: Any = jaxrod.rollout(made, state, STEP, round(SECONDS / STEP), every)
    height_of = found.positions[:, 2] @ body.node_masses / jnp.sum(body.node_masses)
    late = height_of[len(height_of) // 2 :] - scene.RADIUS
    return float(late[-1]), float(jnp.mean(late))


def hover() -> None:
    """Prints heights in mm."""
    jax.config.update("jax_enable_x64", True)
    print("| let go at [mm] | wave [mm/s] | PyElastica: end, mean [mm] | ours |")
    print("|---|---|---|---|")
    rows = [(height, 0.0) for height in HEIGHTS] + [(0.0, speed) for speed in SPEEDS]
    for height, speed in rows:
        a, b = (1e3 * np.array(each(height, speed)) for each in (theirs, ours))
        print(
            f"| {1e3 * height:g} | {1e3 * speed:g} | {a[0]:.3f}, {a[1]:.3f} | "
            f"{b[0]:.3f}, {b[1]:.3f} |",
            flush=True,
        )

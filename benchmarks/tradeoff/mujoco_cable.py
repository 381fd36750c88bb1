"""The same problems simulated by MuJoCo's cable, for the comparison.

A cable is a chain of rigid cylinders on ball joints with elastic couples between them
(MuJoCo's elasticity plugin): it bends and twists, and neither stretches nor shears. Its
first cylinder is welded to the wall.
"""

from __future__ import annotations

import time
from typing import Any

import jax
import numpy as np

from benchmarks.tradeoff.pyelastica import uniform_radius
from jaxrod.effects.clamps import Clamp, FixedEnd
from jaxrod.effects.loads import ExponentialDamping, Gravity
from jaxrod.rods.rod import Rod, RodState
from jaxrod.scene import Scene
from jaxrod.tradeoff.measure import Measurement, Reference, Setting, tip_error
from jaxrod.tradeoff.workload import Workload

SUBSTEPS = tuple(m * 2**k for k in range(12) for m in (2, 3))
"""Steps per control period that are tried in turn."""
SAME = 1.1
"""Ratio of errors within which a smaller step is taken to change nothing."""


def measure_mujoco(
    problem: Workload,
    n_elements: int,
    exact: Reference,
    *,
    batches: tuple[int, ...] = (1,),
) -> Measurement:
    """Measures error and cost of MuJoCo's cable, in one thread.

    It uses the largest step that a smaller one does not improve. Many cables cost it
    as much each as one does. Damping is exact: velocities shrink after every step.

    Args:
        problem: The problem; its rod has to be straight and uniform, under gravity
            and damping that slows translation and rotation alike.
        n_elements: Number of cylinders.
        exact: The problem's reference.
        batches: The batch sizes to state the cost for.

    Raises:
        ModuleNotFoundError: If MuJoCo is not installed.
        ValueError: If the problem has something the cable has not.
    """
    with jax.enable_x64(True):
        scene, state = problem.build(n_elements, "consistent")
        if problem.controls.shape[1]:
            raise ValueError("MuJoCo's cable is compared without controls")
        gravity, rate = _loads(scene)
        model = _model(scene.rod, state, gravity)
    found: Measurement | None = None
    for substeps in SUBSTEPS:
        dt = model.opt.timestep = problem.period / substeps
        tips, wall = _simulate(model, np.exp(-rate * dt), substeps, problem)
        error = tip_error(tips, exact.tips, exact.length)
        if found is not None and found.error <= SAME * error:
            break
        setting = Setting(n_elements, dt, "float64")
        costs = dict.fromkeys(batches, wall / problem.duration)
        found = Measurement(setting, error, costs) if np.isfinite(error) else None
    if found is None:
        raise ValueError(f"MuJoCo's cable of {n_elements} elements is never stable")
    return found


def _loads(scene: Scene) -> tuple[np.ndarray, float]:
    """Gravitational acceleration [m/s^2] and rate of damping [1/s] of a scene."""
    gravity, rate = np.zeros(3), 0.0
    for effect in scene.effects:
        if isinstance(effect, Gravity):
            gravity = np.asarray(effect.acceleration, np.float64)
        elif isinstance(effect, ExponentialDamping):
            rate = float(effect.translational_rate)
            if not np.isclose(rate, float(effect.rotational_rate)):
                raise ValueError("MuJoCo's cable is compared under uniform damping")
        elif not isinstance(effect, (Clamp, FixedEnd)):
            raise ValueError(
                f"MuJoCo's cable is compared without {type(effect).__name__}"
            )
    return gravity, rate


def _model(rod: Rod, state: RodState, gravity: np.ndarray) -> Any:
    """The cable."""
    import mujoco

    radius = uniform_radius(rod)
    area = np.pi * radius**2
    density = float(rod.linear_density[0]) / area
    # The plugin multiplies moduli by the second moments of the section.
    bend = float(rod.bend_twist_stiffness[0, 0]) / (area * radius**2 / 4)
    twist = float(rod.bend_twist_stiffness[2, 0]) / (area * radius**2 / 2)
    nodes = " ".join(f"{x:.17g}" for x in np.asarray(state.positions).T.ravel())
    down = " ".join(f"{x:.17g}" for x in gravity)
    plugin = "mujoco.elasticity.cable"
    return mujoco.MjModel.from_xml_string(f"""
        <mujoco>
          <option gravity="{down}" integrator="Euler">
            <flag contact="disable" autoreset="disable"/>
          </option>
          <extension><plugin plugin="{plugin}"/></extension>
          <worldbody>
            <composite prefix="rod" type="cable" vertex="{nodes}" initial="none">
              <plugin plugin="{plugin}">
                <config key="bend" value="{bend:.17g}"/>
                <config key="twist" value="{twist:.17g}"/>
              </plugin>
              <joint kind="main" damping="0"/>
              <geom type="cylinder" size="{radius:.17g}" density="{density:.17g}"/>
            </composite>
          </worldbody>
        </mujoco>""")


def _simulate(
    model: Any, decay: float, substeps: int, problem: Workload
) -> tuple[np.ndarray, float]:
    """Tip at the end of every control period [m], and the time it took [s]."""
    import mujoco

    # Steps that are too large are part of the search, not worth a word or a log file.
    mujoco.set_mju_user_warning(lambda message: None)
    data = mujoco.MjData(model)
    tips = np.full((len(problem.controls), 3), np.nan)
    start = time.perf_counter()
    for period in range(len(tips)):
        for _ in range(substeps):
            mujoco.mj_step(model, data)
            data.qvel *= decay
        if any(warning.number for warning in data.warning):
            break
        # The sites at the ends follow the step that comes next.
        mujoco.mj_kinematics(model, data)
        tips[period] = data.site("rodS_last").xpos
    return tips, time.perf_counter() - start

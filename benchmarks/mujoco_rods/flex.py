"""Runs rods of MuJoCo 4 in an interpreter of their own; needs mujoco and numpy only.

    PYTHON benchmarks/mujoco_rods/flex.py < jobs.json > runs.json

A rod is a flex of one dimension: point masses joined by edges, with the couples of a
discrete elastic rod between edges and a joint for the twist of each. Flexes have no
stretch. Two ways of holding edges together are known here:

- "held": the constraint on lengths of edges that MuJoCo's documentation advises, as
  stiff as it may be (time constant of two steps), with the `discrete` integrator.
- "springs": edges with the stiffness EA of the rod, which MuJoCo integrates by `Euler`
  only, explicitly.

The standard input is a list of objects with the fields of `Job`; what is printed is
`{"version": ..., "runs": [...]}` with the fields of `Run`.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any, NamedTuple

# MuJoCo is imported late everywhere else, because it is optional. This program is run
# by an interpreter of its own, which has MuJoCo 4 and no jaxrod.
import mujoco  # noqa: TID253
import numpy as np


class Job(NamedTuple):
    """One rod, its loads and its start."""

    rest: list[list[float]]
    """Nodes without load, on a straight line [m]."""
    start: list[list[float]]
    """Nodes where it is released, at rest [m]."""
    held: list[int]
    """Nodes that stay where they start; the first two together are a clamp."""
    radius: float
    """Radius [m]."""
    youngs_modulus: float
    """Young's modulus [Pa]."""
    shear_modulus: float
    """Shear modulus [Pa]."""
    masses: list[float]
    """Masses of the nodes [kg]."""
    gravity: float
    """Gravitational acceleration, downwards [m/s^2]."""
    force: list[float]
    """Force on the last node [N]."""
    damping: float
    """Rate at which velocities decay [1/s]."""
    edges: str
    """"held" or "springs"."""
    dt: float
    """Time step [s]."""
    steps: int
    """Steps between two looks at the tip."""
    looks: int
    """Looks at the tip after the one at the start."""


class Run(NamedTuple):
    """The motion of one rod, and its cost."""

    tips: list[list[float]]
    """Positions of the last node, one for each look [m]."""
    nodes: list[list[float]]
    """Nodes at the end [m]."""
    speed: float
    """Largest speed of a node at the end [m/s]."""
    first: float
    """Processor time of building and running it [s]."""
    second: float
    """Processor time of running it again [s]."""


def xml(job: Job) -> str:
    """The model, with its rod along its line of rest."""
    points = " ".join(f"{x:.17g}" for node in job.rest for x in node)
    edges = " ".join(f"{i} {i + 1}" for i in range(len(job.rest) - 1))
    if job.edges == "held":
        integrator = "discrete"
        edge = f'equality="true" solref="{2 * job.dt:.17g} 1"'
    else:
        integrator = "Euler"
        area = np.pi * job.radius**2
        length = float(np.linalg.norm(np.subtract(job.rest[-1], job.rest[-2])))
        edge = f'stiffness="{job.youngs_modulus * area / length:.17g}"'
    return f"""
        <mujoco>
          <option timestep="{job.dt:.17g}" integrator="{integrator}"
                  gravity="0 0 {-job.gravity:.17g}">
            <flag contact="disable"/>
          </option>
          <worldbody>
            <flexcomp name="rod" type="direct" dim="1" point="{points}"
                      element="{edges}" radius="{job.radius:.17g}"
                      mass="{sum(job.masses):.17g}">
              <edge {edge}/>
              <elasticity young="{job.youngs_modulus:.17g}"
                          shear="{job.shear_modulus:.17g}"/>
              <contact selfcollide="none"/>
              <pin id="{" ".join(map(str, job.held))}"/>
            </flexcomp>
          </worldbody>
        </mujoco>"""


def build(job: Job) -> tuple[Any, Any]:
    """The model and its data, where the rod is released."""
    model = mujoco.MjModel.from_xml_string(xml(job))
    data = mujoco.MjData(model)
    free = [i for i in range(len(job.rest)) if i not in job.held]
    # All nodes weigh alike until here, those at the ends twice what they should.
    for node in free:
        model.body(f"rod_{node}").mass[:] = job.masses[node]
    mujoco.mj_setConst(model, data)
    for joint in range(model.njnt):
        body = model.jnt_bodyid[joint]
        slides = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
        inertia = model.body_mass[body] if slides else max(model.body_inertia[body])
        model.dof_damping[model.jnt_dofadr[joint]] = job.damping * inertia
    for node in free:
        body = model.body(f"rod_{node}")
        first = model.jnt_qposadr[model.body_jntadr[body.id]]
        data.qpos[first : first + 3] = np.subtract(job.start[node], job.rest[node])
    # A node that is held belongs to the world, and may be moved without bending what
    # the rod is at rest.
    for node in job.held:
        model.flex_vert[node] = job.start[node]
    if len(job.rest) - 1 in free:
        last = model.body(f"rod_{len(job.rest) - 1}").id
        data.xfrc_applied[last, :3] = job.force
    return model, data


def nodes(model: Any, data: Any) -> np.ndarray:
    """Nodes where the rod is now [m]."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_flex(model, data)
    return np.array(data.flexvert_xpos)


def move(job: Job, model: Any, data: Any) -> list[list[float]]:
    """Tips after none, one, two ... times as many steps as between looks [m]."""
    tips = [nodes(model, data)[-1].tolist()]
    for _ in range(job.looks):
        mujoco.mj_step(model, data, nstep=job.steps)
        tips.append(nodes(model, data)[-1].tolist())
    return tips


def run(job: Job) -> Run:
    """Runs a rod twice, and measures both."""
    began = time.process_time()
    move(job, *build(job))
    first = time.process_time() - began
    model, data = build(job)
    began = time.process_time()
    tips = move(job, model, data)
    second = time.process_time() - began
    if any(warning.number for warning in data.warning):
        raise RuntimeError(f"unstable with steps of {job.dt} s")
    before = nodes(model, data)
    mujoco.mj_step(model, data)
    speed = np.max(np.linalg.norm(nodes(model, data) - before, axis=1)) / job.dt
    return Run(tips, before.tolist(), float(speed), first, second)


def main() -> int:
    """Runs the rods of the standard input."""
    jobs = [Job(**fields) for fields in json.load(sys.stdin)]
    runs = [run(job)._asdict() for job in jobs]
    print(json.dumps({"version": mujoco.__version__, "runs": runs}))
    return 0


if __name__ == "__main__":
    sys.exit(main())

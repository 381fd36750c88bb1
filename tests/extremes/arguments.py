"""Functions of the library with good values for all their arguments."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod

ROBOT = Path(__file__).parents[2] / "examples" / "robot_arm.urdf"


class Known(str):
    """Name of one of `things`, where it is not the argument's own."""


MATERIAL = {
    "radius": 0.05,
    "density": 1e3,
    "youngs_modulus": 1e6,
    "shear_modulus": 4e5,
    "poisson_ratio": 0.4,
    "shear_correction": 0.9,
}
BENT = [[0.0, 0.1, 0.1, 0.3], [0.0, 0.0, 1.0, 1.2], [0.0, 1.0, 1.1, 2.0]]

LENS = {
    "position": [0.1, -2.0, 0.3],
    "target": [0.2, 0.1, 0.4],
    "focal_length": 100.0,
    "principal_point": [30.0, 40.0],
}

MAY_BE_NONE = {
    ("straight_rod", "shear_modulus"),
    ("straight_rod", "shear_correction"),
    ("rod_along", "shear_correction"),
    ("straight_rod", "normal"),
    ("rod_along", "shear_modulus"),
    ("rod_along", "normal"),
    ("rod_along", "directors"),
    ("exponential_damping", "rotational_rate"),
    ("contact", "stiffness"),
    ("contact", "damping"),
    ("contact", "friction_drag"),
    ("sticking_contact", "stick_stiffness"),
    ("implicit", "tolerance"),
    ("scale_inertia", "dt"),
    ("signed_distance", "parameters"),
    ("from_mesh", "spacing"),
    ("from_mesh", "margin"),
    ("equilibrium", "tolerance"),
    ("sine", "mean"),
    ("driven", "axis"),
    ("driven", "about"),
    ("moving_contact", "axis"),
    ("travelling_wave", "ramp_up"),
    ("muscle_torques", "ramp_up_time"),
    ("muscle", "offsets"),
    ("chamber", "offsets"),
    ("wound_chamber", "offsets"),
    ("tendon", "anchor"),
    ("tendon", "friction"),
    ("tendon", "friction_at_rest"),
    ("active_shape", "curvature"),
    ("active_shape", "strain"),
    ("rigid_body", "position"),
    ("rigid_body", "orientation"),
    ("spring", "damping"),
    ("ball_joint", "stiffness"),
    ("ball_joint", "damping"),
    ("ball_joint", "at"),
    ("hinge_joint", "stiffness"),
    ("hinge_joint", "axis_stiffness"),
    ("hinge_joint", "damping"),
    ("hinge_joint", "axis_damping"),
    ("hinge_joint", "motor"),
    ("fixed_joint", "stiffness"),
    ("fixed_joint", "turning_stiffness"),
    ("fixed_joint", "damping"),
    ("fixed_joint", "turning_damping"),
    ("rod_contact", "stiffness"),
    ("rod_contact", "damping"),
    ("rod_contact", "friction"),
    ("rod_contact", "friction_drag"),
    ("body_contact", "stiffness"),
    ("body_contact", "damping"),
    ("body_contact", "friction"),
    ("body_contact", "friction_drag"),
    ("depth_image", "max_range"),
}

MAY_BE_WILD = {("limit_rate", "applied"), ("limit_rate", "commanded")}
"""What is not finite is data there, as a policy may give it."""

ALSO_NAMED = {
    "length": ("element length", "elements are", "controls must increase"),
    "positions": ("distance between neighbouring nodes", "element length"),
    "start": ("end - start",),
    "end": ("end - start",),
    "poisson_ratio": ("shear_modulus",),
    "damping": ("friction_drag",),
    "bodies": ("body",),
    "faces": ("the mesh",),
    "vertices": ("the mesh", "corner must be"),
    "margin": ("spacing",),
    "position": ("corner must be",),
    "n_elements": ("element length",),
}
"""Other words by which a message may name an argument."""


def beside(point: Any, numbers: Any) -> Any:
    """Signed distance from a plane across x."""
    return point[0] - sum(jax.tree.leaves(numbers))


@functools.cache
def things(dtype: Any) -> dict[str, Any]:
    """What other arguments need, made in the precision that is in force."""
    assert dtype == jnp.result_type(float)
    rod, state = jaxrod.straight_rod(3, length=1.2, **MATERIAL)
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state))
    balls = [jaxrod.shapes.sphere((2.0, 0.0, k), 0.1) for k in (0.0, 1.0)]
    return {
        "rod": rod,
        "state": state,
        "scene": scene,
        "bodies": balls,
        "contact": jaxrod.contact(balls, stiffness=1.0, damping=1.0, friction=0.5),
        "spline": jaxrod.actuation.control_spline(2, 1.2),
        "scaling": jaxrod.scale_inertia(scene),
        "function": beside,
        "shape": jaxrod.shapes.box((-0.1, -0.2, -0.3), (0.1, 0.2, 0.3)),
        "pair of states": {"one": state, "two": state},
        "camera": jaxrod.sensors.camera(**LENS),
        "robot": ROBOT,
    }


NUMERIC: dict[str, dict[str, Any]] = {
    "sticking_contact": {
        "contact": ...,
        "rod": ...,
        "state": ...,
        "stick_stiffness": 10.0,
    },
    "straight_rod": {
        "n_elements": 3,
        "length": 1.2,
        "start": [0.1, 0.2, 0.3],
        "direction": [1.0, -2.0, 0.5],
        "normal": [0.3, 0.2, 2.0],
        **MATERIAL,
    },
    "rod_along": {"positions": BENT, "normal": [0.0, 1.0, 0.2], **MATERIAL},
    "gravity": {"acceleration": [1.0, 2.0, 3.0]},
    "end_load": {"force": [1.0, 2.0, 3.0], "couple": [4.0, 5.0, 6.0]},
    "uniform_load": {
        "force_per_length": [1.0, 2.0, 3.0],
        "couple_per_length": [4.0, 5.0, 6.0],
    },
    "exponential_damping": {"translational_rate": 3.0, "rotational_rate": 2.0},
    "ramp": {
        "first": [1.0, 2.0],
        "last": [3.0, 4.0],
        "duration": 2.0,
        "start": 0.5,
    },
    "sine": {"amplitude": 2.0, "period": 0.3, "mean": 1.0, "phase": 0.2},
    "table": {"times": [0.0, 1.0], "values": [1.0, 2.0]},
    "hinge_support": {"state": ..., "axis": [0.0, 2.0, 1.0]},
    "driven": {
        "state": ...,
        "displacement": [0.0, 0.1, 0.0],
        "axis": [0.0, 2.0, 1.0],
        "angle": 0.3,
        "about": [0.1, 0.2, 0.0],
    },
    "robot_arm": {
        "file": Known("robot"),
        "hand": "hand",
        "position": [0.1, 0.2, 0.3],
        "orientation": [1.0, 0.5, 0.0, 0.2],
    },
    "moving_contact": {
        "contact": ...,
        "displacement": [0.0, 0.1, 0.0],
        "axis": [0.0, 2.0, 1.0],
        "angle": 0.3,
        "about": [0.1, 0.2, 0.0],
    },
    "sphere": {"centre": [1.0, 2.0, 3.0], "radius": 0.5},
    "capsule": {"start": [1.0, 2.0, 3.0], "end": [0.0, 0.0, 1.0], "radius": 0.5},
    "cylinder": {"start": [1.0, 2.0, 3.0], "end": [0.0, 0.0, 1.0], "radius": 0.5},
    "pipe": {
        "start": [1.0, 2.0, 3.0],
        "end": [0.0, 0.0, 1.0],
        "radius": 0.5,
        "thickness": 0.1,
    },
    "plane": {"point": [1.0, 2.0, 3.0], "normal": [0.0, 0.5, 1.0]},
    "box": {
        "centre": [1.0, 2.0, 3.0],
        "half_lengths": [1.0, 2.0, 3.0],
        "orientation": [1.0, 0.5, 0.0, 0.0],
    },
    "signed_distance": {"function": ..., "parameters": 1.0},
    "signed_distance_grid": {
        "values": [
            [[0.1 * (i + j + k) for i in range(3)] for j in range(3)] for k in range(3)
        ],
        "spacing": 0.1,
        "corner": [1.0, 2.0, 3.0],
        "orientation": [1.0, 0.5, 0.0, 0.0],
    },
    "from_mesh": {
        "vertices": [
            [0.5, 0.0, 0.0],
            [1.0, 0.0, 0.0],
            [0.0, 1.0, 0.0],
            [0.0, 0.0, 1.0],
        ],
        "faces": [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
        "spacing": 0.25,
        "margin": 0.5,
        "position": [1.0, 2.0, 3.0],
        "orientation": [1.0, 0.5, 0.0, 0.0],
    },
    "contact": {
        "bodies": ...,
        "stiffness": 1e3,
        "damping": 2.0,
        "friction": 0.3,
        "friction_drag": 4.0,
        "onset": 0.02,
    },
    "implicit": {"spectral_radius": 0.5, "tolerance": 1e-4},
    "control_spline": {"controls": [0.2, 0.4, 0.7, 1.0], "length": 1.2},
    "spline_couples": {
        "rod": ...,
        "spline": ...,
        "controls": [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]],
        "couple_density": [1.0, 2.0, 3.0],
    },
    "limit_rate": {
        "applied": [1.0, 2.0],
        "commanded": [1.5, -3.0],
        "largest_change": 0.5,
    },
    "rollout_times": {"dt": 1e-3, "n_steps": 4, "every": 2},
    "stable_dt": {"scene": ..., "safety": 0.5},
    "circle": {"radius": 0.1},
    "tube": {"outer_radius": 0.1, "inner_radius": 0.05},
    "rectangle": {"width": 0.1, "height": 0.05},
    "ellipse": {"half_width": 0.1, "half_height": 0.05},
    "helical_offsets": {"rod": ..., "radius": 0.02, "turns": 1.5, "angles": [0.3, 1.0]},
    "travelling_wave": {
        "rod": ...,
        "amplitude": 0.3,
        "period": 0.5,
        "wavelength": 0.9,
        "axis": [1.0, 0.5, 0.0],
        "phase": 0.3,
        "ramp_up": 0.2,
    },
    "muscle_torques": {
        "rod": ...,
        "amplitude": 0.2,
        "period": 0.5,
        "wave_number": 4.0,
        "direction": [0.0, 0.5, 1.0],
        "phase_shift": 0.3,
        "ramp_up_time": 0.2,
    },
    "muscle": {
        "rod": ...,
        "force": 2.0,
        "activation": 0.5,
        "offsets": [0.01, 0.02],
    },
    "gaussian_force": {"width": 0.25},
    "tendon": {
        "rod": ...,
        "offsets": [0.01, 0.02],
        "tension": 2.0,
        "anchor": [-0.1, 0.0, 0.1],
        "friction": 0.2,
        "slip_speed": 0.01,
        "friction_at_rest": 0.5,
    },
    "chamber": {"rod": ..., "pressure": 1e4, "area": 1e-4, "offsets": [0.01, 0.02]},
    "wound_chamber": {
        "rod": ...,
        "pressure": 1e4,
        "radius": 0.01,
        "angle": 0.7,
        "offsets": [0.01, 0.02],
    },
    "magnetisation": {
        "rod": ...,
        "moment_per_length": [1.0, 0.0, 2.0],
        "field": [0.0, 0.1, 0.2],
    },
    "linear_field": {
        "flux_density": [0.1, 0.0, 0.2],
        "gradient": [[0.1, 0.2, 0.3], [0.2, 0.1, 0.4], [0.3, 0.4, -0.2]],
        "extent": 2.0,
    },
    "active_shape": {
        "rod": ...,
        "curvature": [0.1, 0.2, 0.3],
        "strain": [0.0, 0.1, 0.2],
    },
    "standard_linear_solid": {
        "rod": ...,
        "stiffness_ratio": 1.5,
        "relaxation_time": 0.1,
    },
    "bending_hysteresis": {"rod": ..., "stiffness": 2.0, "slip_moment": 0.1},
    "plastic_bending": {"rod": ..., "yield_moment": 0.5, "hardening": 0.1},
    "stokes_drag": {"along": 1.0, "across": 2.0, "turning": 0.1},
    "quadratic_drag": {"density": 1e3, "across": 1.1, "along": 0.1},
    "slender_cylinder": {"viscosity": 1.0, "length": 2.0, "radius": 0.01},
    "slender_body_drag": {"viscosity": 1.0},
    "buoyancy": {
        "density": 1e3,
        "acceleration": [0.0, 0.1, -9.0],
        "added_mass": 0.5,
    },
    "with_added_mass": {"rod": ..., "density": 1e3, "coefficient": 1.0},
    "internal_damping": {"relaxation_time": 0.1},
    "short_wave_damping": {"rate": 10.0},
    "rigid_body": {
        "mass": 2.0,
        "inertia": [1.0, 1.5, 2.0],
        "position": [0.1, 0.2, 0.3],
        "orientation": [1.0, 0.5, 0.0, 0.2],
        "velocity": [0.0, 1.0, 2.0],
        "angular_velocity": [3.0, 2.0, 1.0],
    },
    "spring": {
        "a": ("one", "tip"),
        "b": ("two", "base"),
        "state": Known("pair of states"),
        "stiffness": 100.0,
        "damping": 2.0,
    },
    "ball_joint": {
        "a": ("one", "tip"),
        "b": ("two", "tip"),
        "state": Known("pair of states"),
        "stiffness": 100.0,
        "damping": 2.0,
        "at": [1.0, 0.0, 0.3],
    },
    "hinge_joint": {
        "a": ("one", "tip"),
        "b": ("two", "tip"),
        "state": Known("pair of states"),
        "axis": [0.0, 2.0, 1.0],
        "stiffness": 100.0,
        "axis_stiffness": 3.0,
        "damping": 2.0,
        "axis_damping": 0.1,
        "motor": 0.2,
    },
    "fixed_joint": {
        "a": ("one", "tip"),
        "b": ("two", "tip"),
        "state": Known("pair of states"),
        "stiffness": 100.0,
        "turning_stiffness": 3.0,
        "damping": 2.0,
        "turning_damping": 0.1,
    },
    "rod_contact": {
        "members": ("one", "two"),
        "stiffness": 1e3,
        "damping": 2.0,
        "friction": 0.3,
        "friction_drag": 4.0,
        "onset": 0.02,
    },
    "body_contact": {
        "rod": "one",
        "body": "two",
        "stiffness": 1e3,
        "damping": 2.0,
        "friction": 0.3,
        "friction_drag": 4.0,
        "onset": 0.02,
    },
    "scale_inertia": {"scene": ..., "dt": 1e-3},
    "strain_gauge": {"arc_length": 0.3, "offsets": [0.01, 0.02]},
    "markers": {"arc_length": 0.3, "offsets": [0.01, 0.02]},
    "section_curvature": {"arc_length": [0.3, 0.4]},
    "section_force": {"arc_length": [0.3, 0.4]},
    "section_moment": {"arc_length": [0.3, 0.4]},
    "accelerometer": {
        "arc_length": 0.3,
        "offsets": [0.01, 0.02],
        "orientation": [1.0, 0.2, 0.3, 0.4],
    },
    "gyroscope": {"arc_length": 0.3, "orientation": [1.0, 0.2, 0.3, 0.4]},
    "camera": {**LENS, "up": [0.1, 0.2, 1.0]},
    "image_markers": {"camera": ..., "arc_length": 0.3, "offsets": [0.01, 0.02]},
    "depth_image": {"camera": ..., "rows": 2, "columns": 3, "max_range": 4.0},
}
"""Functions of numbers, with good values; `...` stands for what `things` has."""

RUNS: dict[str, dict[str, Any]] = {
    "step": {"scene": ..., "state": ..., "dt": 1e-4},
    "advance": {"scene": ..., "state": ..., "dt": 1e-4, "n_steps": 2},
    "rollout": {"scene": ..., "state": ..., "dt": 1e-4, "n_steps": 2, "every": 1},
    "equilibrium": {
        "scene": ...,
        "state": ...,
        "tolerance": 1e-4,
        "max_iterations": 5,
    },
}
"""Runs of the simulation: of what they are given, only what is wrong is tried."""

COUNTED: dict[str, dict[str, Any]] = {
    "straight_rod": {"n_elements": ..., "length": 1.0, **MATERIAL},
    "contact": {"bodies": ..., "stiffness": 1.0, "points_per_element": ...},
    "implicit": {"max_iterations": ...},
    "control_spline": {"controls": ...},
    "near_contact": {"contact": ..., "rod": ..., "state": ..., "count": ...},
    "depth_image": {"camera": ..., "rows": ..., "columns": ...},
    "tendon_length": {"effect": ...},
    "tendon_tension": {"effect": ...},
    "chamber_pressure": {"effect": ...},
    "highest_frequency": {"scene": ..., "state": ..., "size": ...},
    "natural_frequencies": {"scene": ..., "state": ..., "n_modes": ...},
    "resample": {"scene": ..., "state": ..., "n_elements": ...},
    "frequency_changes": {"scaling": ..., "state": ..., "n_modes": ...},
    "rollout_times": {"dt": 1e-3, "n_steps": ..., "every": ...},
    "step": {"scene": ..., "state": ..., "dt": 1e-4, "first": ...},
    "advance": {
        "scene": ...,
        "state": ...,
        "dt": 1e-4,
        "n_steps": ...,
        "first": ...,
    },
    "rollout": {
        "scene": ...,
        "state": ...,
        "dt": 1e-4,
        "n_steps": ...,
        "every": ...,
        "first": ...,
    },
    "equilibrium": {"scene": ..., "state": ..., "max_iterations": ...},
    "configure_cpu": {"devices": ...},
    "laplacian_filter": {"order": ...},
    "short_wave_damping": {"rate": 10.0, "order": ...},
    "rod_contact": {
        "members": ("one", "two"),
        "stiffness": 1.0,
        "points_per_element": ...,
        "max_contacts": ...,
    },
}
COUNT_NAMES = {
    "n_elements",
    "points_per_element",
    "max_iterations",
    "count",
    "size",
    "n_modes",
    "n_steps",
    "every",
    "first",
    "devices",
    "order",
    "max_contacts",
    "rows",
    "columns",
    "effect",
}

OF_KINDS: dict[str, dict[str, Any]] = {
    "clamp": {"state": ...},
    "fixed_end": {"state": ...},
    "pin_support": {"state": ...},
    "hinge_support": {"state": ..., "axis": (0.0, 1.0, 0.0)},
    "driven": {"state": ...},
    "reactions": {"scene": ..., "state": ...},
    "image_markers": {"camera": ..., "arc_length": 0.3},
    "depth_image": {"camera": ..., "rows": 2, "columns": 3},
    "compensated": {"state": ...},
    "make_scene": {"rod": ...},
    "muscle": {"rod": ..., "force": 1.0},
    "tendon": {"rod": ..., "offsets": [0.01, 0.02], "tension": 1.0},
    "chamber": {"rod": ..., "pressure": 1.0, "area": 1e-4},
    "magnetisation": {
        "rod": ...,
        "moment_per_length": [1.0, 0.0, 2.0],
        "field": [0.0, 0.1, 0.2],
    },
    "active_shape": {"rod": ..., "curvature": [0.1, 0.2, 0.3]},
    "travelling_wave": {
        "rod": ...,
        "amplitude": 0.3,
        "period": 0.5,
        "wavelength": 0.9,
    },
    "with_added_mass": {"rod": ..., "density": 1e3},
    "unstressed": {"rod": ..., "state": ...},
    "strains": {"rod": ..., "state": ...},
    "stored_energy": {"rod": ..., "state": ...},
    "angular_velocities": {"rod": ..., "state": ...},
    "with_angular_velocities": {
        "rod": ...,
        "state": ...,
        "angular_velocities": np.zeros((3, 3)),
    },
    "moving_contact": {"contact": ...},
    "near_contact": {"contact": ..., "rod": ..., "state": ..., "count": 1},
    "sticking_contact": {
        "contact": ...,
        "rod": ...,
        "state": ...,
        "stick_stiffness": 10.0,
    },
    "contact": {"bodies": ..., "stiffness": 1.0},
    "spline_couples": {
        "rod": ...,
        "spline": ...,
        "controls": np.zeros((3, 2)),
        "couple_density": 1.0,
    },
    "stable_dt": {"scene": ...},
    "highest_frequency": {"scene": ..., "state": ...},
    "natural_frequencies": {"scene": ..., "state": ...},
    "resample": {"scene": ..., "state": ..., "n_elements": 5},
    "scale_inertia": {"scene": ...},
    "frequency_changes": {"scaling": ..., "state": ...},
    **RUNS,
}

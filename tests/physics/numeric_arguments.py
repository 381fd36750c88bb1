"""Arguments of every public factory that takes numbers, one set or several of each."""

from dataclasses import replace
from pathlib import Path

import numpy as np

import jaxrod

MATERIAL = {
    "radius": 0.05,
    "density": 1e3,
    "youngs_modulus": 1e6,
    "shear_modulus": 4e5,
    "shear_correction": 0.9,
}
ROD, STATE = jaxrod.straight_rod(3, length=1.2, **MATERIAL)
SCENE = jaxrod.make_scene(ROD, jaxrod.clamp(STATE))
BENT = ((0.0, 0.1, 0.1, 0.3), (0.0, 0.0, 1.0, 1.2), (0.0, 1.0, 1.1, 2.0))
FRAMES = np.asarray(jaxrod.rod_along(BENT, **MATERIAL)[1].directors).tolist()
SIDES = ((1.0, 0.5, 0.2), (0.3, 1.0, 0.1), (0.2, 0.1, 1.0))
ROBOT = Path(__file__).parents[2] / "examples" / "robot_arm.urdf"
BALL = jaxrod.shapes.sphere((0.0, 0.0, 0.0), 0.1)

HEAD, OF_HEAD = jaxrod.systems.rigid_body(
    jaxrod.shapes.sphere((0.0, 0.1, 1.3), 0.1), density=1e3
)
TOGETHER = {"rod": STATE, "head": OF_HEAD}
JOINED = {"a": ("rod", "tip"), "b": ("head",), "state": TOGETHER}
FELLOW = replace(STATE, positions=STATE.positions + 0.02)
TOUCH = {
    "stiffness": 1e3,
    "damping": 2.0,
    "friction": 0.3,
    "friction_drag": 4.0,
    "onset": 0.02,
}

STATION = {"arc_length": (0.2, 0.5), "offsets": ((0.01, 0.02), (0.03, -0.01))}
LENS = {
    "position": (0.1, -2.0, 0.3),
    "target": (0.2, 0.1, 0.4),
    "focal_length": 100.0,
    "principal_point": (30.0, 40.0),
    "up": (0.1, 0.2, 1.0),
}
EYE = jaxrod.sensors.camera(**LENS)

FACTORIES = {
    **{
        name: [{"arc_length": (0.2, 0.5)}]
        for name in ("section_curvature", "section_force", "section_moment")
    },
    "strain_gauge": [STATION],
    "markers": [STATION],
    "accelerometer": [{**STATION, "orientation": (1.0, 0.2, 0.3, 0.4)}],
    "gyroscope": [{"arc_length": 0.3, "orientation": (1.0, 0.2, 0.3, 0.4)}],
    "camera": [LENS],
    "image_markers": [{"camera": EYE, **STATION}],
    "depth_image": [{"camera": EYE, "rows": 2, "columns": 3, "max_range": 4.0}],
    "straight_rod": [
        {
            "n_elements": 3,
            "length": 1.2,
            "start": (0.1, 0.2, 0.3),
            "direction": (1.0, -2.0, 0.5),
            "normal": (0.3, 0.2, 2.0),
            **MATERIAL,
        },
        {
            "n_elements": 3,
            "length": 1.2,
            "direction": (1.0, -2.0, 0.5),
            **MATERIAL,
            "radius": (0.06, 0.03),
            "shear_modulus": None,
            "poisson_ratio": (0.1, 0.2, 0.3),
        },
    ],
    "rod_along": [
        {"positions": BENT, "normal": (0.0, 1.0, 0.2), **MATERIAL},
        {
            "positions": BENT,
            **MATERIAL,
            "shear_modulus": None,
            "poisson_ratio": 0.3,
        },
        {"positions": BENT, "directors": FRAMES, **MATERIAL},
    ],
    "robot_arm": [
        {
            "file": ROBOT,
            "hand": "hand",
            "position": (0.1, 0.2, 0.3),
            "orientation": (1.0, 0.5, 0.1, 0.2),
        }
    ],
    "gravity": [{"acceleration": (1.0, 2.0, 3.0)}],
    "end_load": [{"force": (1.0, 2.0, 3.0), "couple": (4.0, 5.0, 6.0)}],
    "uniform_load": [
        {"force_per_length": (1.0, 2.0, 3.0), "couple_per_length": (4.0, 5.0, 6.0)}
    ],
    "exponential_damping": [
        {"translational_rate": 3.0, "rotational_rate": 2.0},
        {"translational_rate": 3.0},
    ],
    "internal_damping": [{"relaxation_time": 0.1}],
    "short_wave_damping": [{"rate": 10.0}],
    "circle": [{"radius": 0.1}],
    "tube": [{"outer_radius": 0.1, "inner_radius": 0.05}],
    "rectangle": [{"width": 0.1, "height": 0.05}],
    "ellipse": [{"half_width": 0.1, "half_height": 0.05}],
    "ramp": [{"first": (1.0, 2.0), "last": (3.0, 4.0), "duration": 2.0, "start": 0.5}],
    "sine": [{"amplitude": 2.0, "period": 0.3, "mean": 1.0, "phase": 0.2}],
    "table": [{"times": (0.0, 1.0), "values": ((1.0, 2.0), (3.0, 4.0))}],
    "hinge_support": [{"state": STATE, "axis": (0.0, 2.0, 1.0)}],
    "driven": [
        {
            "state": STATE,
            "displacement": (0.0, 0.1, 0.0),
            "axis": (0.0, 2.0, 1.0),
            "angle": 0.3,
            "about": (0.1, 0.2, 0.0),
        }
    ],
    "moving_contact": [
        {
            "contact": jaxrod.contact(
                jaxrod.shapes.plane(), stiffness=10.0, damping=1.0, friction=0.5
            ),
            "displacement": (0.0, 0.1, 0.0),
            "axis": (0.0, 2.0, 1.0),
            "angle": 0.3,
            "about": (0.1, 0.2, 0.0),
        }
    ],
    "sphere": [{"centre": (1.0, 2.0, 3.0), "radius": 0.5}],
    "capsule": [{"start": (1.0, 2.0, 3.0), "end": (0.0, 0.0, 1.0), "radius": 0.5}],
    "cylinder": [{"start": (1.0, 2.0, 3.0), "end": (0.0, 0.0, 1.0), "radius": 0.5}],
    "sticking_contact": [
        {
            "contact": jaxrod.contact(
                jaxrod.shapes.plane(), stiffness=10.0, damping=1.0, friction=0.5
            ),
            "rod": ROD,
            "state": STATE,
            "stick_stiffness": 3.0,
        }
    ],
    "pipe": [
        {
            "start": (1.0, 2.0, 3.0),
            "end": (0.0, 0.0, 1.0),
            "radius": 0.5,
            "thickness": 0.1,
        }
    ],
    "plane": [{"point": (1.0, 2.0, 3.0), "normal": (0.0, 0.5, 1.0)}],
    "box": [
        {
            "centre": (1.0, 2.0, 3.0),
            "half_lengths": (1.0, 2.0, 3.0),
            "orientation": (1.0, 0.5, 0.0, 0.0),
        }
    ],
    "signed_distance_grid": [
        {
            "values": tuple(
                ((0.1, 0.2, 0.4), (0.3, 0.5, 0.2), (0.1, 0.4, 0.6)) for _ in range(3)
            ),
            "spacing": 0.1,
            "corner": (1.0, 2.0, 3.0),
            "orientation": (1.0, 0.5, 0.0, 0.0),
        }
    ],
    "from_mesh": [
        {
            "vertices": ((0.5, 0, 0), (1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0)),
            "faces": ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)),
            "spacing": 0.25,
            "position": (1.0, 2.0, 3.0),
            "orientation": (1.0, 0.5, 0.0, 0.0),
        }
    ],
    "contact": [
        {
            "bodies": BALL,
            "stiffness": 1e3,
            "damping": 2.0,
            "friction": 0.3,
            "friction_drag": 4.0,
            "onset": 0.02,
        },
        {
            "bodies": BALL,
            "stiffness": 1e3,
            "friction": (0.3, 0.2, 0.4),
            "friction_drag": 4.0,
            "stick_ratio": 1.5,
        },
    ],
    "implicit": [{"spectral_radius": 0.5, "tolerance": 1e-4}],
    "control_spline": [
        {"controls": 4, "length": 1.2},
        {"controls": (0.2, 0.4, 0.7, 1.0), "length": 1.2},
    ],
    "spline_couples": [
        {
            "rod": ROD,
            "spline": jaxrod.actuation.control_spline(2, 1.2),
            "controls": ((1.0, 2.0), (3.0, 4.0), (5.0, 6.0)),
            "couple_density": (1.0, 2.0, 3.0),
        }
    ],
    "travelling_wave": [
        {
            "rod": ROD,
            "amplitude": amplitude,
            "period": 0.3,
            "wavelength": 0.7,
            "axis": (1.0, 2.0, 0.5),
            "phase": 0.2,
            "ramp_up": 0.4,
        }
        for amplitude in (2.0, (0.0, 1.0, 2.0, 0.5))
    ],
    "muscle_torques": [
        {
            "rod": ROD,
            "amplitude": (0.1, 1.0, 2.0, 0.5),
            "period": 0.3,
            "wave_number": 7.0,
            "direction": (1.0, 2.0, 0.5),
            "phase_shift": 0.2,
            "ramp_up_time": 0.4,
        }
    ],
    "muscle": [
        {
            "rod": ROD,
            "force": (3.0, 4.0),
            "activation": 0.5,
            "offsets": ((0.01, 0.0), (0.0, 0.02)),
            "fastest": 5.0,
        }
    ],
    "gaussian_force": [{"width": 0.3}],
    "helical_offsets": [
        {"rod": ROD, "radius": 0.03, "turns": 1.5, "angles": (0.2, 1.0)}
    ],
    "chamber": [{"rod": ROD, "pressure": 1e4, "area": 1e-4, "offsets": (0.01, 0.02)}],
    "wound_chamber": [
        {
            "rod": ROD,
            "pressure": 1e4,
            "radius": 0.02,
            "angle": -0.7,
            "offsets": (0.01, 0.02),
        }
    ],
    "tendon": [
        {
            "rod": ROD,
            "offsets": (0.01, 0.02),
            "tension": 3.0,
            "anchor": (0.0, 0.1, -0.2),
            "friction": 0.3,
            "slip_speed": 0.02,
            "friction_at_rest": 0.5,
        },
        {
            "rod": ROD,
            "offsets": (0.01, 0.02),
            "length": 0.7,
            "stiffness": 100.0,
            "onset": 0.01,
        },
    ],
    "active_shape": [
        {"rod": ROD, "curvature": (1.0, 2.0, 0.5), "strain": (0.1, 0.2, 0.3)}
    ],
    "standard_linear_solid": [
        {"rod": ROD, "stiffness_ratio": 1.5, "relaxation_time": 0.1}
    ],
    "bending_hysteresis": [{"rod": ROD, "stiffness": 2.0, "slip_moment": 0.1}],
    "plastic_bending": [{"rod": ROD, "yield_moment": 0.5, "hardening": 0.1}],
    "magnetisation": [
        {"rod": ROD, "moment_per_length": (1.0, 2.0, 0.5), "field": (0.1, 0.2, 0.3)}
    ],
    "linear_field": [
        {
            "flux_density": (0.1, 0.2, 0.3),
            "gradient": ((1.0, 0.2, 0.1), (0.2, 1.0, 0.3), (0.1, 0.3, -2.0)),
            "extent": 2.0,
        }
    ],
    "stokes_drag": [
        {"along": 1.0, "across": 2.0, "turning": 0.1, "flow": (0.1, 0.2, 0.3)}
    ],
    "quadratic_drag": [
        {"density": 1e3, "across": 1.1, "along": 0.1, "flow": (0.1, 0.2, 0.3)}
    ],
    "slender_cylinder": [{"viscosity": 1.1, "length": 2.0, "radius": 0.1}],
    "slender_body_drag": [{"viscosity": 1.1}],
    "buoyancy": [{"density": 1e3, "acceleration": (0.1, 0.2, -9.0), "added_mass": 0.5}],
    "with_added_mass": [{"rod": ROD, "density": 1e3, "coefficient": 0.9}],
    "rigid_body": [
        {
            "mass": 2.0,
            "inertia": (1.0, 1.1, 1.2),
            "position": (1.0, 2.0, 3.0),
            "orientation": (1.0, 0.2, 0.3, 0.1),
            "velocity": (1.0, 2.0, 3.0),
            "angular_velocity": (1.0, 2.0, 3.0),
        },
        {"shape": BALL, "density": 1e3},
    ],
    "spring": [
        {
            **JOINED,
            "stiffness": 10.0,
            "damping": 1.0,
            "at": ((0.0, 0.01, 1.2), (0.0, 0.1, 1.25)),
        }
    ],
    "ball_joint": [
        {**JOINED, "stiffness": 10.0, "damping": 1.0, "at": (0.1, 0.2, 1.1)}
    ],
    "hinge_joint": [
        {
            **JOINED,
            "axis": (0.1, 0.2, 0.9),
            "stiffness": 10.0,
            "axis_stiffness": 1.0,
            "damping": 0.1,
            "axis_damping": 0.2,
            "motor": 0.3,
            "at": (0.1, 0.2, 1.1),
        }
    ],
    "fixed_joint": [
        {
            **JOINED,
            "stiffness": 10.0,
            "turning_stiffness": 1.0,
            "damping": 0.1,
            "turning_damping": 0.2,
            "at": (0.1, 0.2, 1.1),
        }
    ],
    "body_contact": [{"rod": "rod", "body": "head", "touching": 0.1, **TOUCH}],
    "linear_damper": [
        {"damping_constant": 3.0},
        {"translational": 0.1, "rotational": 1e-4},
    ],
    "rod_contact": [{"members": ("one", "two"), **TOUCH}],
    "crossing_contact": [{"members": ("one", "two"), **TOUCH}],
    "rigid_contact": [
        {
            "members": ("one", "two"),
            "points": {"one": ((0.1, 0.2), (0.3, 0.4), (0.5, 0.6))},
            **TOUCH,
        }
    ],
    "glue": [
        {
            "a": "rod",
            "b": "fellow",
            "state": {"rod": STATE, "fellow": FELLOW},
            "stiffness": 10.0,
            "turning_stiffness": 1.0,
            "damping": 0.1,
            "turning_damping": 0.2,
        }
    ],
    "pose_spring": [
        {
            "place": JOINED["a"],
            "state": JOINED["state"],
            "stiffness": 10.0,
            "damping": 0.1,
            "turning_stiffness": 1.0,
            "turning_damping": 0.2,
            "position": (0.1, 0.2, 0.3),
            "orientation": (1.0, 0.2, 0.3, 0.1),
            "displacement": (0.1, 0.2, 0.1),
            "axis": (0.1, 0.2, 0.9),
            "angle": 0.3,
            "at": (0.1, 0.2, 1.1),
        }
    ],
    "neighbour_lists": [{"skin": 0.5}],
    "limit_rate": [
        {"applied": (1.0, 2.0), "commanded": (1.5, -3.0), "largest_change": (1.0, 0.5)}
    ],
    "with_angular_velocities": [
        {
            "rod": ROD,
            "state": STATE,
            "angular_velocities": ((1.0, 2.0, 3.0), (1.0, 0.0, 0.0), (0.0, 2.0, 0.0)),
        }
    ],
    "rollout_times": [{"dt": 1e-3, "n_steps": 4, "every": 2}],
    "stable_dt": [{"scene": SCENE, "safety": 0.5}],
    "scale_inertia": [{"scene": SCENE, "dt": 1e-3}],
    "twist": [{"curve": BENT, "normals": SIDES}],
    "writhe": [{"curve": BENT, "ends": "next_tangent", "extension": 2.0}],
    "link": [
        {
            "curve": BENT,
            "normals": SIDES,
            "offset": 0.1,
            "ends": "next_tangent",
            "extension": 2.0,
        }
    ],
}

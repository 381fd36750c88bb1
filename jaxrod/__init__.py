"""jaxrod: soft, slender rods as differentiable, batchable JAX functions.

A rod is a pytree, a step is a pure function, a thousand arms are `jax.vmap` of one.

    rod, state = jaxrod.straight_rod(20, length=1.0, radius=0.05, density=1000.0,
                                     youngs_modulus=1e7)
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state), jaxrod.gravity())
    dt = jaxrod.stable_dt(scene).dt
    state = jaxrod.advance(scene, state, dt, 1000)

Environments are in `jaxrod.envs`, learners and optimisers in `jaxrod.training`,
drawing in `jaxrod.viz`.

`import jaxrod` loads nothing: every name is imported from its module when it is
first used. The command line therefore answers at once, and `jaxrod doctor` can report
on a JAX that jaxrod refuses to run on. Type checkers read `__init__.pyi`.
"""

from __future__ import annotations

import importlib
from typing import Any

from jaxrod.installation.jax_version import require_sound_jax

__version__ = "0.1.0"

_NAMES = {
    "actuation.active_shape": ("ActiveShape", "active_shape"),
    "actuation.chambers": ("Chamber", "WoundChamber", "chamber", "wound_chamber"),
    "actuation.fibre_path": ("helical_offsets",),
    "actuation.magnets": (
        "LinearField",
        "MagneticField",
        "Magnetisation",
        "linear_field",
        "magnetisation",
    ),
    "actuation.muscles": (
        "Muscle",
        "constant_force",
        "cubic_force",
        "gaussian_force",
        "muscle",
    ),
    "actuation.section_load": ("SectionLoad", "SectionStrains", "SectionStress"),
    "actuation.tendons": ("Tendon", "tendon"),
    "actuation.waves": (
        "TravellingWave",
        "WorldWave",
        "muscle_torques",
        "travelling_wave",
    ),
    "analysis.frequency": ("highest_frequency",),
    "analysis.health": ("Health", "HealthLimits", "freeze", "health"),
    "analysis.inertia_scaling": (
        "InertiaScaling",
        "frequency_changes",
        "scale_inertia",
    ),
    "analysis.modes": ("natural_frequencies",),
    "analysis.reactions": ("reactions",),
    "analysis.stability": ("StableStep", "stable_dt"),
    "composition": ("make_scene",),
    "contacts.bodies": (
        "Body",
        "Box",
        "Capsule",
        "Cylinder",
        "Plane",
        "SignedDistance",
        "Sphere",
        "box",
        "capsule",
        "cylinder",
        "plane",
        "signed_distance",
        "sphere",
    ),
    "contacts.contact": ("Contact", "contact"),
    "contacts.near": ("near_contact",),
    "contacts.points": ("ThinBodyWarning",),
    "damping.filters": (
        "LaplacianFilter",
        "ShortWaveDamping",
        "laplacian_filter",
        "short_wave_damping",
    ),
    "damping.internal_damping": ("InternalDamping", "internal_damping"),
    "damping.linear_damper": ("LinearDamper", "linear_damper"),
    "effects.actuation": (
        "ControlSpline",
        "ElementAverages",
        "ElementCouples",
        "control_spline",
        "limit_rate",
        "spline_couples",
    ),
    "effects.base": ("Effect", "Reaction", "StabilityBound"),
    "effects.clamps": ("Clamp", "FixedEnd", "clamp", "fixed_end"),
    "effects.driven": ("Driven", "driven"),
    "effects.fluids": (
        "FlowField",
        "QuadraticDrag",
        "SlenderBodyDrag",
        "StokesDrag",
        "UniformFlow",
        "flow_field",
        "quadratic_drag",
        "slender_body_drag",
        "slender_cylinder",
        "stokes_drag",
    ),
    "effects.held": ("Held",),
    "effects.immersion": ("Buoyancy", "buoyancy", "with_added_mass"),
    "effects.loads": (
        "EndLoad",
        "ExponentialDamping",
        "FollowerEndLoad",
        "FollowerLoad",
        "Gravity",
        "UniformLoad",
        "end_load",
        "exponential_damping",
        "gravity",
        "uniform_load",
    ),
    "effects.supports": ("Hinge", "Pin", "hinge", "pin"),
    "effects.time": (
        "Clock",
        "Ramp",
        "Schedule",
        "Sine",
        "Table",
        "ramp",
        "sine",
        "table",
        "time",
    ),
    "effects.unlikely": ("UnlikelyWarning",),
    "installation.backend": ("configure_cpu",),
    "lanes.choice": ("LaneChoice", "lane_choices", "use_lanes"),
    "methods.consistent": ("Consistent", "consistent"),
    "methods.implicit": ("Implicit", "implicit"),
    "methods.planar": ("Planar", "planar"),
    "methods.pyelastica": ("PyElastica", "pyelastica"),
    "methods.torsion_free": ("TorsionFree", "torsion_free"),
    "rods.drag": ("Drag", "drag_loads"),
    "rods.elasticity": ("stored_energy", "strains"),
    "rods.factories": ("rod_along", "straight_rod", "unstressed"),
    "rods.motion": ("Loads", "Motion"),
    "rods.rod": (
        "Rod",
        "RodState",
        "angular_velocities",
        "compensated",
        "with_angular_velocities",
    ),
    "rods.sections": ("Section", "circle", "ellipse", "rectangle", "tube"),
    "scene": (
        "Method",
        "Scene",
        "angular_momentum",
        "kinetic_energy",
        "momentum",
        "potential_energy",
        "total_energy",
    ),
    "statics.equilibrium": ("Equilibrium", "equilibrium"),
    "stepping.checks": ("UnstableStepWarning",),
    "stepping.memory": ("with_memory",),
    "stepping.runs": ("advance", "rollout", "rollout_times", "step"),
    "structure": ("Leaf", "memory", "pytree", "static"),
    "systems.contact.body_contact": ("BodyContact", "body_contact"),
    "systems.contact.crossing_contact": ("CrossingContact", "crossing_contact"),
    "systems.contact.neighbour_lists": (
        "NeighbourLists",
        "NeighbourRecord",
        "neighbour_lists",
    ),
    "systems.contact.rigid_contact": ("RigidContact", "rigid_contact"),
    "systems.contact.rod_contact": ("RodContact", "rod_contact"),
    "systems.joints.glue": ("Glue", "glue"),
    "systems.joints.hinges": ("hinge_joint", "rigid_joint"),
    "systems.joints.pose_springs": (
        "PoseSpring",
        "pose_spring",
        "pose_spring_reactions",
    ),
    "systems.joints.rings": ("ring",),
    "systems.joints.springs": ("ball_joint", "spring"),
    "systems.joints.ties": ("tie",),
    "systems.joints.welds": ("attach", "weld"),
    "systems.members.rigid_bodies": (
        "BodyState",
        "RigidBodies",
        "rigid_body",
        "stacked_bodies",
    ),
    "systems.neighbours": ("Neighbours", "neighbours"),
    "systems.settled": ("Settled", "settled"),
    "systems.sites.coupling": ("Coupling",),
    "systems.system": ("System", "make_system"),
    "topology.crossings": ("crossed", "crossings"),
    "topology.twist": ("twist",),
    "topology.winding": ("link", "linking_number", "writhe"),
    "tradeoff.tuning": ("Tuned", "tune"),
}
_MODULE_OF = {name: module for module, names in _NAMES.items() for name in names}
_SUBMODULES = {
    "assemblies": "assemblies",
    "control": "control",
    "envs": "envs",
    "extend": "extend",
    "geometry": "geometry",
    "rotations": "geometry.rotations",
    "tradeoff": "tradeoff",
    "training": "training",
    "validation": "validation",
    "vectors": "geometry.vectors",
    "viz": "viz",
}

__all__ = sorted(_MODULE_OF)


def __getattr__(name: str) -> Any:
    """Imports a public name, or a submodule, when it is first used."""
    if name in _MODULE_OF:
        require_sound_jax()
        module = importlib.import_module(f"jaxrod.{_MODULE_OF[name]}")
        globals()[name] = getattr(module, name)
        return globals()[name]
    if name in _SUBMODULES:
        return _submodule(name)
    raise AttributeError(f"module 'jaxrod' has no attribute {name!r}")


def _submodule(name: str) -> Any:
    try:
        return importlib.import_module(f"jaxrod.{_SUBMODULES[name]}")
    except ModuleNotFoundError as error:
        # An optional package is missing. Attribute look-up must raise AttributeError,
        # or help(jaxrod) and hasattr would fail.
        raise AttributeError(f"jaxrod.{name} cannot be imported: {error}") from error


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_SUBMODULES})

"""Hints for attributes of rods and states that users of other tools guess."""

from __future__ import annotations

OF_RODS = {
    **dict.fromkeys(
        ("position", "position_collection", "positions", "tip", "x", "xpos"),
        "it is state.positions, because a rod has no state of its own",
    ),
    **dict.fromkeys(
        ("v", "velocities", "velocity", "velocity_collection"),
        "it is state.velocities, because a rod has no state of its own",
    ),
    **dict.fromkeys(
        ("curvature", "kappa", "sigma", "strains"), "it is jaxrod.strains(rod, state)"
    ),
    **dict.fromkeys(("mass", "masses"), "it is rod.node_masses"),
    "density": "it is rod.linear_density, the mass per length",
    "director_collection": "it is state.directors",
    "n_elems": "it is rod.n_elements",
    "omega_collection": "it is jaxrod.angular_velocities(rod, state)",
    "radius": "it is rod.radii",
}
"""Hints at what a `Rod` has, or its state, by the guess."""

OF_STATES = {
    **dict.fromkeys(
        ("pos", "position", "position_collection", "q", "qpos", "x", "xpos"),
        "it is state.positions",
    ),
    **dict.fromkeys(
        ("qd", "qvel", "v", "vel", "velocity", "velocity_collection"),
        "it is state.velocities",
    ),
    **dict.fromkeys(
        ("orientation", "quat", "quaternions", "rot", "xquat"),
        "it is state.orientations",
    ),
    **dict.fromkeys(
        ("ang", "angular_velocities", "omega", "omega_collection"),
        "it is jaxrod.angular_velocities(rod, state)",
    ),
    **dict.fromkeys(
        ("curvature", "kappa", "sigma", "strains"), "it is jaxrod.strains(rod, state)"
    ),
    **dict.fromkeys(
        ("t", "time"), "jaxrod.rollout_times computes the times of a rollout"
    ),
    "director_collection": "it is state.directors",
}
"""Hints at what a `RodState` has, or a function computes, by the guess."""

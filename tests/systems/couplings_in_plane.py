"""A system for every coupling, in the zx plane: two rods and a ball.

The first rod lies along x. Where the second one and the ball are, each coupling says.
All nodes move in the plane.
"""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

import jaxrod
from jaxrod import systems

N, LENGTH, RADIUS = 4, 1.0, 0.05
MATERIAL = {"radius": RADIUS, "density": 1000.0, "youngs_modulus": 1e6}
MIDDLE, BASE = ("one", 2), ("two", "base")
FRICTION = {"damping": 5.0, "friction": 0.3}


def along(start, direction, n=N, length=LENGTH):
    return jaxrod.straight_rod(
        n,
        length=length,
        start=start,
        direction=direction,
        normal=(0.0, 1.0, 0.0),
        dtype=jnp.float64,
        **MATERIAL,
    )


def from_middle():
    """The second rod begins at the middle of the first."""
    return along((0.5, 0.0, 0.0), (0.0, 0.0, 1.0))


def beside():
    """The second rod lies on the first, and presses on it."""
    return along((0.1, 0.0, 1.9 * RADIUS), (1.0, 0.0, 0.0))


def away():
    """The second rod touches nothing."""
    return along((0.0, 0.0, 1.0), (1.0, 0.0, 0.0))


def hairpin():
    """The second rod is bent until its ends press on each other; straight at rest."""
    angles = np.linspace(0.0, 1.05 * np.pi, 5)
    turn = np.stack([0.06 * np.sin(angles), 0 * angles, 1.0 - 0.06 * np.cos(angles)])
    first = np.stack([np.linspace(-0.4, -0.1, 4), np.zeros(4), np.full(4, 0.94)])
    last = np.stack(
        [np.linspace(-0.1, -0.4, 4), np.zeros(4), np.linspace(1.05, 1.02, 4)]
    )
    path = np.concatenate([first, turn, last], axis=1)
    rod, state = jaxrod.rod_along(
        path, normal=(0.0, 1.0, 0.0), dtype=jnp.float64, **MATERIAL
    )
    straight = jnp.zeros_like(rod.rest_curvatures)
    return replace(rod, rest_curvatures=straight), state


def ball_at(x, z):
    return systems.rigid_body(
        systems_ball(x, z), density=500.0, velocity=(0.1, 0.0, 0.2), dtype=jnp.float64
    )


def systems_ball(x, z):
    return jaxrod.shapes.sphere((x, 0.0, z), 0.1)


FAR = (0.0, -3.0)
ON_THE_FIRST = (0.5, -0.13)
AT_THE_TIP = (1.1, 0.0)


def of(second, ball, join):
    return second, ball, join


COUPLINGS = {
    "none": of(away, FAR, lambda s: ()),
    "tie": of(from_middle, FAR, lambda s: systems.tie(MIDDLE, BASE, s)),
    "weld": of(from_middle, FAR, lambda s: systems.weld(MIDDLE, BASE, s)),
    "ball_joint": of(
        from_middle,
        FAR,
        lambda s: systems.ball_joint(MIDDLE, BASE, s, stiffness=1e4, damping=5.0),
    ),
    "hinge_joint": of(
        from_middle,
        FAR,
        lambda s: systems.hinge_joint(
            MIDDLE, BASE, s, axis=(0.0, 1.0, 0.0), stiffness=1e4, axis_stiffness=50.0
        ),
    ),
    "fixed_joint": of(
        from_middle,
        FAR,
        lambda s: systems.fixed_joint(
            MIDDLE, BASE, s, stiffness=1e4, turning_stiffness=50.0
        ),
    ),
    "spring": of(away, FAR, lambda s: systems.spring(MIDDLE, BASE, s, stiffness=1e3)),
    "spring with a dashpot": of(
        away,
        FAR,
        lambda s: systems.spring(MIDDLE, BASE, s, stiffness=1e3, damping=10.0),
    ),
    "glue": of(beside, FAR, lambda s: systems.glue("one", "two", s, stiffness=1e5)),
    "pose_spring": of(
        away, FAR, lambda s: systems.pose_spring(MIDDLE, s, stiffness=1e3, damping=5.0)
    ),
    "pose_spring that turns": of(
        away,
        FAR,
        lambda s: systems.pose_spring(
            MIDDLE,
            s,
            stiffness=1e3,
            turning_stiffness=50.0,
            axis=(0.0, 1.0, 0.0),
            angle=0.3,
        ),
    ),
    "attach": of(away, AT_THE_TIP, lambda s: systems.attach(("one", 2), ("ball",), s)),
    "attach that turns": of(
        away,
        AT_THE_TIP,
        lambda s: systems.attach(("one", 2), ("ball",), s, turning=True),
    ),
    "rod_contact": of(
        beside, FAR, lambda s: systems.rod_contact("one", "two", stiffness=1e5)
    ),
    "rod_contact with friction": of(
        beside,
        FAR,
        lambda s: systems.rod_contact("one", "two", stiffness=1e5, **FRICTION),
    ),
    "rod_contact with lists": of(
        beside,
        FAR,
        lambda s: systems.rod_contact(
            "one",
            "two",
            stiffness=1e5,
            lists=systems.neighbour_lists(refresh_every=8),
        ),
    ),
    "self contact": of(
        hairpin,
        FAR,
        lambda s: systems.rod_contact(
            "two", stiffness=1e5, self_contact=True, points_per_element=3
        ),
    ),
    "crossing_contact": of(
        beside, FAR, lambda s: systems.crossing_contact("one", "two", stiffness=1e3)
    ),
    "body_contact": of(
        away,
        ON_THE_FIRST,
        lambda s: systems.body_contact("one", "ball", stiffness=1e5),
    ),
    "body_contact with friction": of(
        away,
        ON_THE_FIRST,
        lambda s: systems.body_contact("one", "ball", stiffness=1e5, **FRICTION),
    ),
    "rigid_contact": of(
        away,
        ON_THE_FIRST,
        lambda s: systems.rigid_contact(
            "ball",
            fixed=jaxrod.shapes.plane((0.0, 0.0, -0.22), (0.0, 0.0, 1.0)),
            stiffness=1e5,
            **FRICTION,
        ),
    ),
}
"""For each coupling the second rod, the place of the ball, and the coupling itself."""


def moving(rod, state, seed):
    """State whose nodes and elements move in the plane."""
    s = jnp.linspace(0, 1, state.positions.shape[1])
    speed = [jnp.sin(3 * s + seed), jnp.zeros_like(s), jnp.cos(2 * s - seed)]
    state = replace(state, velocities=0.5 * jnp.stack(speed))
    turning = jnp.zeros_like(state.orientations[:3]).at[1].set(5.0)
    return jaxrod.with_angular_velocities(rod, state, to_material(state, turning))


def to_material(state, turning):
    return jnp.sum(state.directors * turning[None], axis=1)


def made(name, method, effects=(), change=lambda scene: scene):
    """System with a coupling, and its moving state.

    Args:
        name: Name of the coupling.
        method: Method of both rods.
        effects: Effects on the first rod.
        change: Applied to the scenes of both rods.
    """
    second, place, join = COUPLINGS[name]
    (one, of_one), (two, of_two) = along((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)), second()
    ball, of_ball = ball_at(*place)
    rest = {"one": of_one, "two": of_two, "ball": of_ball}
    scenes = {
        "one": change(jaxrod.make_scene(one, *effects, method=method)),
        "two": change(jaxrod.make_scene(two, method=method)),
    }
    system = jaxrod.make_system({**scenes, "ball": ball}, join(rest), state=rest)
    state = {**rest, "one": moving(one, of_one, 0.0), "two": moving(two, of_two, 1.0)}
    return system, state

"""A winch: a drum that turns winds up a rope and lifts a weight.

The base of the rope is fixed on the drum. Static friction holds the rope on the drum.
The length on the drum is the angle times the sum of the radii of drum and rope.
"""

import argparse

import numpy as np

import jaxrod
from jaxrod import schedules, shapes

DRUM, ROPE, LENGTH = 0.05, 0.003, 0.5  # [m]
TURN, SECONDS, WEIGHT = -5.0, 1.5, 1.0  # [rad], [s], [N]
AXIS = np.array([0.0, 1.0, 0.0])


def build(turn=TURN):
    """The rope on its drum, and its state."""
    rod, state = jaxrod.straight_rod(
        60,
        length=LENGTH,
        radius=ROPE,
        density=1000.0,
        youngs_modulus=3e6,
        start=(DRUM + ROPE, 0.0, 0.0),
        direction=(0.0, 0.0, -1.0),
        normal=AXIS,
    )
    # From rest to rest within half a period.
    angle = schedules.sine(turn / 2, 2 * SECONDS, mean=turn / 2, phase=-0.25)
    turns = {"axis": AXIS, "angle": angle, "about": (0.0, 0.0, 0.0)}
    drum = shapes.cylinder(-0.03 * AXIS, 0.03 * AXIS, DRUM)
    rough = jaxrod.contact(drum, stiffness=3e5, damping=10.0, friction=0.3)
    scene = jaxrod.make_scene(
        rod,
        jaxrod.driven(state, axes="xz", **turns),
        jaxrod.moving_contact(jaxrod.sticking_contact(rough, rod, state), **turns),
        jaxrod.end_load((0.0, 0.0, -WEIGHT)),
        jaxrod.gravity(),
        jaxrod.internal_damping(2e-3),
        method=jaxrod.planar("zx"),
    )
    return scene, state


def run(frames=60):
    """A replay, and the height to which the weight is lifted [m]."""
    scene, state = build()
    every = int(SECONDS / float(jaxrod.stable_dt(scene).dt) / frames) + 1
    dt = SECONDS / (every * frames)
    states = jaxrod.rollout(scene, state, dt, every * frames, every)
    times = jaxrod.rollout_times(dt, every * frames, every)
    replay = jaxrod.viz.Replay.from_states(scene, states, times, title="Winch")
    # Before, the rope hangs stretched.
    stretched = LENGTH * (1 + WEIGHT / float(scene.rod.shear_stretch_stiffness[2, 0]))
    lifted = states.tip[-1, 2] + stretched
    return replay, float(lifted)


if __name__ == "__main__":
    jaxrod.configure_cpu()
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--picture", help="write a picture to this PNG file")
    given = parser.parse_args()
    replay, lifted = run()
    print(f"lifted {lifted:.4f} m; radius times angle {-TURN * (DRUM + ROPE):.4f} m")
    if given.picture:
        look = {"azimuth": -65, "elevation": 18, "width": 720, "height": 560}
        jaxrod.viz.picture(replay, -1, given.picture, small=True, **look)

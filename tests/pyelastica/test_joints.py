"""Joints of two rods beside PyElastica 1.0's: where the laws are one, and where not.

One rod is held in space at its far end or at the joint, the other is pulled at its tip.
The laws are the same, to round-off, of a spherical joint without dashpot and of a fixed
joint without one of distances. They differ in

- dashpots of distances: ours acts at one point, with the couples that keep the angular
  momentum, theirs at the two nodes. What differs goes with the gap, and so falls with
  the stiffness;
- hinges: ours are carried by both rods and hold their axes together; theirs holds the
  tangent of the second rod across an axis fixed in space, and leaves it free to turn
  about that tangent. Where the first rod is held and nothing twists the second, they
  are one but for the angle by which the axis gives way.
"""

import elastica
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod

N, LENGTH, RADIUS, DENSITY, YOUNG = 10, 0.2, 0.007, 1750.0, 3e7
STIFFNESS, TURNING, DT, STEPS = 1e5, 10.0, 5e-5, 1000
PULL = np.array([1.0, 0.6, 0.3])
DIRECTION, NORMAL = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])


class Simulator(
    elastica.BaseSystemCollection,
    elastica.Constraints,
    elastica.Connections,
    elastica.Forcing,
    elastica.Damping,
):
    """What joints need of PyElastica."""


class EndTwist(elastica.NoForces):
    """A couple about the last element's own axis."""

    def __init__(self, size):
        self.size = size

    def apply_torques(self, system, time=0.0):
        """Adds it."""
        system.external_torques[2, -1] += self.size


def theirs(
    joint,
    *,
    held="base",
    pull=PULL,
    steps=STEPS,
    dt=DT,
    twist=0.0,
    damping=0.0,
    **numbers,
):
    """Node positions of both of PyElastica's rods at the end [m]."""
    simulator, rods = Simulator(), []
    for number in range(2):
        rod = elastica.CosseratRod.straight_rod(
            N,
            number * LENGTH * DIRECTION,
            DIRECTION,
            NORMAL,
            LENGTH,
            RADIUS,
            DENSITY,
            youngs_modulus=YOUNG,
            shear_modulus=YOUNG / 3,
        )
        simulator.append(rod)
        rods.append(rod)
    place = 0 if held == "base" else -1
    simulator.constrain(rods[0]).using(
        elastica.FixedConstraint,
        constrained_position_idx=(place,),
        constrained_director_idx=(place,),
    )
    simulator.add_forcing_to(rods[1]).using(
        elastica.EndpointForces, np.zeros(3), np.array(pull), ramp_up_time=1e-300
    )
    simulator.add_forcing_to(rods[1]).using(EndTwist, twist)
    if damping:
        for rod in rods:
            simulator.dampen(rod).using(
                elastica.AnalyticalLinearDamper,
                uniform_damping_constant=damping,
                time_step=dt,
            )
    simulator.connect(
        first_rod=rods[0],
        second_rod=rods[1],
        first_connect_idx=-1,
        second_connect_idx=0,
    ).using(joint, **numbers)
    simulator.finalize()
    stepper, time = elastica.PositionVerlet(), np.float64(0.0)
    for _ in range(steps):
        time = stepper.step(simulator, time, np.float64(dt))
    return np.stack([rod.position_collection for rod in rods])


def ours(join, *, held="base", pull=PULL, steps=STEPS, dt=DT, twist=0.0, damping=0.0):
    """The same of jaxrod's, joined by what `join(a, b, state)` makes."""
    rods, state = {}, {}
    for number, name in enumerate(("one", "two")):
        rods[name], state[name] = jaxrod.straight_rod(
            N,
            length=LENGTH,
            radius=RADIUS,
            density=DENSITY,
            youngs_modulus=YOUNG,
            shear_modulus=YOUNG / 3,
            start=number * LENGTH * DIRECTION,
            direction=DIRECTION,
            normal=NORMAL,
            dtype=jnp.float64,
        )
    slow = jaxrod.exponential_damping(damping)
    loads = (
        jaxrod.end_load(pull),
        jaxrod.end_load(couple=(0.0, 0.0, twist), follower=True),
    )
    law = {"method": jaxrod.pyelastica()}
    fixed = jaxrod.fixed_end(state["one"], end=held)
    system = jaxrod.make_system(
        {
            "one": jaxrod.make_scene(rods["one"], fixed, slow, **law),
            "two": jaxrod.make_scene(rods["two"], *loads, slow, **law),
        },
        join(("one", "tip"), ("two", "base"), state),
        state=state,
    )
    end = jaxrod.advance(system, state, dt, steps)
    return np.stack([end[name].positions for name in rods])


def ball(a, b, state):
    return jaxrod.systems.ball_joint(a, b, state, stiffness=STIFFNESS)


def same(name, mine, other, record, at_most=1e-12):
    """Records how far two ends are apart, which have moved and do not coincide."""
    assert np.max(np.abs(other[1, :2, -1])) > 0.01, "the second rod has not moved"
    record(
        f"{name}: positions [m]",
        "PyElastica 1.0",
        np.max(np.abs(mine - other)),
        at_most=at_most,
    )


@pytest.mark.slow
def test_a_spherical_joint_is_theirs(record):
    other = theirs(elastica.FreeJoint, k=STIFFNESS, nu=0.0)
    gap = np.linalg.norm(other[1, :, 0] - other[0, :, -1])
    assert gap > 1e-6
    same(f"Spherical joint, {STEPS} steps", ours(ball), other, record)


@pytest.mark.slow
@pytest.mark.parametrize("damping", [0.0, 1e-4])
def test_a_fixed_joint_is_theirs(damping, record):
    def fixed(a, b, state):
        return jaxrod.systems.fixed_joint(
            a,
            b,
            state,
            stiffness=STIFFNESS,
            turning_stiffness=TURNING,
            turning_damping=damping or None,
        )

    numbers = {"k": STIFFNESS, "nu": 0.0, "kt": TURNING, "nut": damping}
    other = theirs(elastica.FixedJoint, **numbers)
    name = f"Fixed joint, dashpot of {damping:g} N m s, {STEPS} steps"
    same(name, ours(fixed), other, record)


@pytest.mark.slow
def test_a_dashpot_of_distances_differs_by_the_gap(record):
    """The time step has to follow the stiffness."""
    apart = []
    for factor in (1, 4):
        stiffness, steps, dt = STIFFNESS * factor, 400 * factor, DT / factor

        def damped(a, b, state, stiffness=stiffness):
            return jaxrod.systems.ball_joint(
                a, b, state, stiffness=stiffness, damping=0.5
            )

        numbers = {"k": stiffness, "nu": 0.5, "steps": steps, "dt": dt}
        other = theirs(elastica.FreeJoint, **numbers)
        apart.append(np.max(np.abs(ours(damped, steps=steps, dt=dt) - other)))
    record(
        "Spherical joint with dashpot, 0.02 s: positions [m]",
        "PyElastica 1.0",
        apart[0],
        at_most=1e-9,
    )
    record(
        "That difference at four times the stiffness, relative to the first",
        "0.25 or less",
        apart[1] / apart[0],
        at_most=0.25,
    )


def hinged(pull, stiffness, factor):
    """Positions of both libraries' rods on a hinge after 0.05 s."""

    def hinge(a, b, state):
        numbers = {"stiffness": STIFFNESS, "axis_stiffness": stiffness}
        return jaxrod.systems.hinge_joint(a, b, state, axis=NORMAL, **numbers)

    how = {"held": "tip", "steps": factor * STEPS, "dt": DT / factor, "pull": pull}
    numbers = {"k": STIFFNESS, "nu": 0.0, "kt": stiffness, "normal_direction": NORMAL}
    return ours(hinge, **how), theirs(elastica.HingeJoint, **numbers, **how)


@pytest.mark.slow
def test_a_hinge_that_swings_freely_is_theirs(record):
    mine, other = hinged(np.array([1.0, 0.0, 0.3]), TURNING, 1)
    same("Hinge that swings about its axis, 1000 steps", mine, other, record)


@pytest.mark.slow
def test_a_hinge_is_theirs_as_its_axis_gets_stiffer(record):
    """The first rod's end is held, so that its axis is one of space."""
    apart = []
    for stiffness, factor in ((2.5, 1), (10.0, 2)):
        mine, other = hinged(0.6 * NORMAL, stiffness, factor)
        apart.append(np.max(np.abs(mine - other)))
    assert np.max(np.abs(other[1, 1])) > 0.01
    record(
        "Hinge pulled along its axis, 0.05 s: positions [m]",
        "PyElastica 1.0",
        apart[0],
        at_most=1e-4,
    )
    record(
        "That difference at four times the axis's stiffness, relative to the first",
        "0.25 or less",
        apart[1] / apart[0],
        at_most=0.25,
    )


@pytest.mark.slow
def test_a_hinge_pulled_obliquely_twists_in_theirs(record):
    """Theirs lets the second rod turn about its tangent; ours has a hinge's axis."""
    mine, other = hinged(PULL, TURNING, 2)
    record(
        "Hinge pulled obliquely, 0.05 s: positions [m]",
        "PyElastica 1.0, free to twist",
        np.max(np.abs(mine - other)),
        at_most=1e-5,
    )


TWIST, LONG, DAMPING = 0.02, 200_000, 2.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Spherical", "Fixed", "Hinge"])
def test_joints_are_theirs_for_ten_seconds(name, record):
    """Pulled, and twisted where the joint holds that, until they are nearly at rest."""
    held, pull, twist = "base", PULL, 0.0
    if name == "Spherical":
        kind, numbers, join = elastica.FreeJoint, {}, ball
    elif name == "Fixed":
        twist = TWIST
        kind, numbers = elastica.FixedJoint, {"kt": TURNING, "nut": 0.0}

        def join(a, b, state):
            return jaxrod.systems.fixed_joint(
                a, b, state, stiffness=STIFFNESS, turning_stiffness=TURNING
            )
    else:
        held, pull = "tip", np.array([1.0, 0.0, 0.3])
        kind = elastica.HingeJoint
        numbers = {"kt": TURNING, "normal_direction": NORMAL}

        def join(a, b, state):
            return jaxrod.systems.hinge_joint(
                a,
                b,
                state,
                axis=NORMAL,
                stiffness=STIFFNESS,
                axis_stiffness=TURNING,
            )

    how = {
        "held": held,
        "pull": pull,
        "twist": twist,
        "damping": DAMPING,
        "steps": LONG,
    }
    other = theirs(kind, k=STIFFNESS, nu=0.0, **numbers, **how)
    same(f"{name} joint, 10 s, damped", ours(join, **how), other, record, 1e-9)

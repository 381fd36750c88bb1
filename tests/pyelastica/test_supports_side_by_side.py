"""Supports of PyElastica's library beside their counterparts here, to round-off."""

from dataclasses import replace

import elastica
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod

N, LENGTH, RADIUS, DENSITY, YOUNG = 10, 1.0, 0.03, 1000.0, 1e6
DT, STEPS = 2e-4, 1000
TWISTING = 500 * DT
PUSH = (0.02, 0.5, 0.1)
"""On the last node [N]; along the rod so little that a slide shows inertia alone."""


class Simulator(elastica.BaseSystemCollection, elastica.Constraints, elastica.Forcing):
    """What supports need of PyElastica."""


def theirs(direction, normal, velocities, constraint, numbers, push=PUSH):
    """Node positions and directors of PyElastica's rod at the end."""
    simulator = Simulator()
    rod = elastica.CosseratRod.straight_rod(
        N,
        np.zeros(3),
        np.array(direction),
        np.array(normal),
        LENGTH,
        RADIUS,
        DENSITY,
        youngs_modulus=YOUNG,
        shear_modulus=YOUNG / 3,
    )
    simulator.append(rod)
    simulator.constrain(rod).using(constraint, **numbers)
    simulator.add_forcing_to(rod).using(
        elastica.EndpointForces, np.zeros(3), np.array(push), ramp_up_time=1e-300
    )
    simulator.finalize()
    moving = rod.velocity_collection
    moving[:, 1:-1] = velocities[:, 1:-1]
    stepper, time = elastica.PositionVerlet(), np.float64(0.0)
    for _ in range(STEPS):
        time = stepper.step(simulator, time, np.float64(DT))
    return rod.position_collection, rod.director_collection


def ours(direction, normal, velocities, supports, push=PUSH):
    """The same of jaxrod's, held by what `supports(state)` makes."""
    rod, state = jaxrod.straight_rod(
        N,
        length=LENGTH,
        radius=RADIUS,
        density=DENSITY,
        youngs_modulus=YOUNG,
        shear_modulus=YOUNG / 3,
        direction=direction,
        normal=normal,
        dtype=jnp.float64,
    )
    scene = jaxrod.make_scene(
        rod, *supports(state), jaxrod.end_load(push), method=jaxrod.pyelastica()
    )
    moving = state.velocities.at[:, 1:-1].set(velocities[:, 1:-1])
    end = jaxrod.advance(scene, replace(state, velocities=moving), DT, STEPS)
    return end.positions, end.directors


def same(name, mine, other, record):
    """Records how far two ends are apart."""
    for what, one, two in zip(("positions [m]", "directors"), mine, other, strict=True):
        record(
            f"{name}, {STEPS} steps: {what}",
            "PyElastica 1.0",
            np.max(np.abs(one - two)),
            at_most=1e-11,
        )


def stirred(axes):
    """Velocities of the nodes along some axes [m/s]."""
    s = np.linspace(0, 1, N + 1)
    waves = np.stack([0.3 * np.sin(3 * s), np.sin(5 * s), 0.7 * np.sin(4 * s + 1)])
    return 0.3 * waves * np.reshape(axes, (3, 1))


@pytest.mark.slow
def test_ends_that_are_twisted_and_pushed_together(record):
    """HelicalBucklingBC, along z: elsewhere theirs turns ends about another axis."""
    turns, slack, speeds = 0.8, 0.06, stirred((1, 1, 1))

    def supports(state):
        for end, way in (("base", 1), ("tip", -1)):
            yield jaxrod.driven(
                state,
                end,
                displacement=jaxrod.schedules.ramp(
                    (0, 0, 0), (0, 0, way * slack / 2), TWISTING
                ),
                axis=(0, 0, 1),
                angle=jaxrod.schedules.ramp(0.0, way * np.pi * turns, TWISTING),
                holds_element=True,
            )

    along = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), speeds
    numbers = {
        "constrained_position_idx": (0, -1),
        "constrained_director_idx": (0, -1),
        "twisting_time": TWISTING,
        "slack": slack,
        "number_of_rotations": turns,
    }
    other = theirs(*along, elastica.HelicalBucklingBC, numbers)
    assert np.max(np.abs(other[0][:2])) > 0.05, "it has not buckled"
    same("HelicalBucklingBC", ours(*along, supports), other, record)


HELD = {
    "two axes of a node": (
        {
            "constrained_position_idx": (3,),
            "translational_constraint_selector": np.array([True, False, True]),
        },
        lambda state: [jaxrod.pin_support(state, 3, axes="xz")],
        (1, 1, 1),
        PUSH,
    ),
    "an end that slides and does not turn": (
        {
            "constrained_position_idx": (0,),
            "constrained_director_idx": (0,),
            "translational_constraint_selector": np.array([False, True, True]),
        },
        lambda state: [jaxrod.driven(state, axes="yz", holds_element=True)],
        (1, 1, 1),
        PUSH,
    ),
    "an end that turns about z alone": (
        {
            "constrained_position_idx": (0,),
            "constrained_director_idx": (0,),
            "rotational_constraint_selector": np.array([True, True, False]),
        },
        # Theirs holds rates and ours the axis: one where nothing tilts it.
        lambda state: [jaxrod.hinge_support(state, (0, 0, 1))],
        (1, 1, 0),
        (0.02, 0.5, 0.0),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", HELD)
def test_what_a_general_constraint_holds(name, record):
    numbers, supports, axes, push = HELD[name]
    along = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), stirred(axes)
    other = theirs(*along, elastica.GeneralConstraint, numbers, push)
    assert np.max(np.abs(other[0][1])) > 0.01, "it has not moved"
    mine = ours(*along, supports, push)
    same(f"GeneralConstraint of {name}", mine, other, record)

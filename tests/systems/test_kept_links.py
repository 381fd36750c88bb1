"""What contact keeps: the link of a ribbon and of rings that move and press."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from systems.members import stirred

RADIUS, THICK, YOUNG = 0.5, 0.02, 1e7


def made(n, effects, **options):
    """A ring: its scene, state and what closes it."""
    rod, state, closure = jaxrod.systems.ring(
        n,
        length=2 * np.pi * RADIUS,
        radius=THICK,
        density=1000.0,
        youngs_modulus=YOUNG,
        shear_modulus=YOUNG / 3,
        dtype=jnp.float64,
        **options,
    )
    return jaxrod.make_scene(rod, *effects), state, closure


@pytest.mark.slow
def test_link_is_twist_and_writhe_while_a_twisted_ring_buckles(record):
    """Turns put into a ring go into writhe, and it comes to lie on itself."""
    turns = 5.0
    scene, state, closure = made(
        24, (jaxrod.exponential_damping(2.0),), turns=turns, straight_at_rest=True
    )
    contact = jaxrod.systems.crossing_contact(
        "ring", self_contact=True, stiffness=1e5, damping=10.0
    )
    start = {"ring": stirred(state, speed=0.01)}
    system = jaxrod.make_system({"ring": scene}, closure, contact, state=start)
    dt = float(jaxrod.stable_dt(system).dt)
    step = jax.jit(jaxrod.advance, static_argnums=3)

    @jax.jit
    def parts(ring):
        return (
            jaxrod.topology.link(ring, ends="joined"),
            jaxrod.topology.twist(ring, ends="joined"),
            jaxrod.topology.writhe(ring, ends="joined"),
        )

    state, found = start, [parts(start["ring"])]
    for _ in range(50):
        state = step(system, state, dt, int(0.1 / dt))
        found.append(parts(state["ring"]))
    assert not jaxrod.health(system, state, dt).flagged
    link, twist, writhe = np.asarray(found).T
    assert abs(twist[0]) == pytest.approx(turns, abs=1e-3)
    assert np.max(np.abs(writhe)) > 1.5
    record(
        "twisted ring that buckles onto itself: link minus twist minus writhe",
        "0, at 50 instants",
        np.max(np.abs(link - twist - writhe)),
        at_most=1e-10,
    )
    record(
        "twisted ring that buckles onto itself: link",
        "the imposed turns, at 50 instants",
        np.max(np.abs(np.abs(link) - turns)),
        at_most=1e-10,
    )


@pytest.mark.slow
def test_linked_rings_that_are_pulled_apart_stay_linked(record):
    """And press each other until their pull is carried by contact."""
    members, start, couplings = {}, {}, []
    for name, side in (("left", -1.0), ("right", 1.0)):
        pull = jaxrod.gravity((side * 5.0, 0.0, 0.0))
        members[name], start[name], closure = made(
            16,
            (pull, jaxrod.exponential_damping(5.0)),
            centre=(side * (RADIUS - 0.1), 0.0, 0.0),
            normal=(0.0, 0.0, 1.0) if name == "left" else (0.0, 1.0, 0.0),
            name=name,
        )
        couplings.append(closure)
    contact = jaxrod.systems.crossing_contact(*members, stiffness=1e5, damping=10.0)
    system = jaxrod.make_system(members, *couplings, contact, state=start)
    dt = float(jaxrod.stable_dt(system).dt)
    step = jax.jit(jaxrod.advance, static_argnums=3)
    state, found = start, []
    for _ in range(20):
        state = step(system, state, dt, int(0.1 / dt))
        left, right = state["left"], state["right"]
        found.append(float(jaxrod.topology.linking_number(left, right)))
    assert not jaxrod.health(system, state, dt).flagged
    # They hang in each other: longer than they were, and at rest.
    assert np.ptp(np.asarray(left.positions[0])) > 2.1 * RADIUS
    assert float(jaxrod.health(system, state, dt).largest_violation) > 1e-3
    record(
        "linked rings that press each other: linking number, at 20 instants",
        "1 in magnitude, as at the beginning",
        np.max(np.abs(np.asarray(found) - found[0])) + abs(abs(found[0]) - 1),
        at_most=1e-10,
    )

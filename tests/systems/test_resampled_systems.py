"""Systems of finer and coarser rods: the same joints, energies and momenta."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.geometry import rotations
from systems.members import SOFT, rod


def frame_of_rods(n, bent=0.0, speed=0.0):
    """A post, a beam welded to its middle, a head on the beam, a band, contact.

    Args:
        n: Elements of the post; an even number. The beam has one more half of it.
        bent: Size of a smooth displacement of all nodes [m].
        speed: Size of smooth velocities [m/s].
    """
    post, of_post = rod(n, 0.4, (0, 0, 0), (0, 0, 1))
    beam, of_beam = rod(n, 0.3, (0, 0, 0.2), (1, 0, 0))
    head, of_head = jaxrod.systems.rigid_body(
        jaxrod.shapes.sphere((0.33, 0, 0.2), 0.03), density=1e3, dtype=jnp.float64
    )
    state = {"post": of_post, "beam": of_beam, "head": of_head}
    members = {
        "post": jaxrod.make_scene(post, jaxrod.clamp(of_post), jaxrod.gravity()),
        "beam": jaxrod.make_scene(beam, jaxrod.end_load((0.0, 0.0, -0.1))),
        "head": head,
    }
    joints = (
        jaxrod.systems.weld(("post", n // 2), ("beam", "base"), state),
        jaxrod.systems.attach(("beam", "tip"), ("head",), state),
        jaxrod.systems.spring(("post", "tip"), ("beam", n // 2), state, stiffness=50.0),
        jaxrod.systems.hinge_joint(
            ("post", "tip"),
            ("head",),
            state,
            axis=(0.0, 1.0, 0.3),
            stiffness=1.0,
            axis_stiffness=0.1,
        ),
        jaxrod.systems.rod_contact("post", "beam", stiffness=1e3),
    )
    system = jaxrod.make_system(members, joints, state=state)
    return system, {name: moved(own, bent, speed) for name, own in state.items()}


def moved(own, bent, speed):
    """A state along a smooth displacement, whose frames turn smoothly about y."""
    x, z = own.positions[0], own.positions[2]
    way = bent * jnp.stack([jnp.sin(5 * z), jnp.sin(4 * x), jnp.cos(3 * x + z)])
    rate = speed * jnp.stack([jnp.cos(4 * z), jnp.sin(3 * x), jnp.cos(5 * x - z)])
    changed = replace(own, positions=own.positions + way).with_rates(rate, own.rates[1])
    if not own.layout.is_rod:
        return changed
    middle = 0.5 * (x + z)[1:] + 0.5 * (x + z)[:-1]
    # Zero at the clamp and at the head, neither of which turns.
    half = 2.5 * bent * jnp.sin(4 * jnp.pi * middle)
    none = jnp.zeros_like(half)
    turn = (jnp.cos(half), none, jnp.sin(half), none)
    frames = rotations.multiply_quaternions(turn, tuple(own.orientations))
    return replace(changed, orientations=jnp.stack(frames))


@pytest.mark.slow
def test_a_resampled_system_is_the_one_that_is_built_so():
    """Straight rods: every number of members, couplings and state, to round-off."""
    coarse, state = frame_of_rods(4)
    fine, expected = frame_of_rods(8)
    made, found = jaxrod.resample(coarse, state, 8)
    for ours, theirs in (
        (made.couplings, fine.couplings),
        (made.members, fine.members),
        (found, expected),
    ):
        assert jax.tree.structure(ours) == jax.tree.structure(theirs)
        for one, other in zip(
            jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True
        ):
            np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-14)
    assert jaxrod.resample(made, found, {"beam": 8})[0] is made


@pytest.mark.slow
def test_there_and_back_is_the_same():
    system, state = frame_of_rods(4, bent=0.02, speed=0.3)
    there, finer = jaxrod.resample(system, state, {"post": 12, "beam": 8})
    counts = {k: own.layout.n_elements for k, own in finer.items()}
    assert counts == {"post": 12, "beam": 8, "head": 1}
    _, again = jaxrod.resample(there, finer, 4)
    for name in ("post", "beam"):
        for field in ("positions", "velocities"):
            one, other = getattr(again[name], field), getattr(state[name], field)
            np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-14)
    mass = lambda own: float(jnp.sum(own.members["post"].rod.node_masses))
    np.testing.assert_allclose(mass(there), mass(system), rtol=1e-13)
    # Joints are closed: tied nodes are at one place before and after.
    tips = finer["post"].positions[:, 6], finer["beam"].positions[:, 0]
    np.testing.assert_allclose(
        tips[0] - tips[1],
        state["post"].positions[:, 2] - state["beam"].positions[:, 0],
        atol=1e-15,
    )


@pytest.mark.slow
def test_energy_and_momentum_are_kept_to_second_order():
    def change(n):
        system, state = frame_of_rods(n, bent=0.01, speed=0.3)
        finer, moved = jaxrod.resample(system, state, 2 * n)
        energy = float(finer.kinetic_energy(moved)) / float(
            system.kinetic_energy(state)
        )
        stored = system.potential_energy(state), finer.potential_energy(moved)
        # Momentum of nodes with lumped masses is kept exactly.
        push = finer.momentum(moved) - system.momentum(state)
        np.testing.assert_allclose(push, 0, atol=1e-14)
        return np.abs([energy - 1, float(stored[1] / stored[0]) - 1])

    coarse, fine = change(16), change(32)
    assert np.all(fine < 0.02)
    np.testing.assert_allclose(coarse / fine, 4, rtol=0.3)


@pytest.mark.slow
def test_a_ring_stays_closed_and_bent_as_it_was_at_rest():
    def made(n):
        hoop, state, closure = jaxrod.systems.ring(
            n, length=1.0, turns=1.5, dtype=jnp.float64, **SOFT
        )
        scenes = {"ring": jaxrod.make_scene(hoop)}
        return jaxrod.make_system(scenes, closure), {"ring": state}

    system, state = made(12)
    ours, theirs = jaxrod.resample(system, state, 24)[0], made(24)[0]
    for one, other in zip(ours.couplings, theirs.couplings, strict=True):
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
            # A quaternion and its negative are one rotation.
            np.testing.assert_allclose(abs(a), abs(b), atol=1e-9)
    # At rest the energy of the joint is that of every other joint: none.
    flat, rest, closure = jaxrod.systems.ring(12, length=1.0, dtype=jnp.float64, **SOFT)
    round_ring = jaxrod.make_system({"ring": jaxrod.make_scene(flat)}, closure)
    finer, after = jaxrod.resample(round_ring, {"ring": rest}, 36)
    seen = jaxrod.make_system({"ring": finer.members["ring"]})
    both = finer.potential_energy(after), seen.potential_energy(after)
    assert abs(float(both[0] - both[1])) < 0.1 * float(both[1]) + 1e-9


@pytest.mark.slow
def test_equal_rods_and_lists_are_resampled():
    made, own = rod(4, 0.4)
    states = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), own)
    up = jnp.arange(3.0)[:, None] * 0.039
    states = replace(states, positions=states.positions.at[:, 1].add(up))
    scenes = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), jaxrod.make_scene(made))
    lists = jaxrod.systems.neighbour_lists(refresh_every=4)
    law = jaxrod.systems.rod_contact("rods", stiffness=1e3, lists=lists)
    held = jaxrod.systems.ball_joint(
        ("rods", 1, 2), ("rods", 2, 2), {"rods": states}, stiffness=10.0
    )
    state = {"rods": states}
    system = jaxrod.make_system({"rods": scenes}, law, held, state=state)
    finer, moved = jaxrod.resample(system, state, 12)
    assert moved["rods"].positions.shape == (3, 3, 13)
    before, after = system.potential_energy(state), finer.potential_energy(moved)
    np.testing.assert_allclose(after, before, rtol=1e-9)
    dt = jaxrod.stable_dt(finer).dt
    stepped = jaxrod.advance(finer, moved, dt, 10)
    assert not jaxrod.health(finer, stepped, dt).overflow


def test_what_has_no_place_on_the_new_grid_is_refused():
    system, state = frame_of_rods(4)
    with pytest.raises(ValueError, match=r"node 2 of 'post', at 0\.2 m"):
        jaxrod.resample(system, state, {"post": 5})
    with pytest.raises(ValueError, match="no rod is called 'head'"):
        jaxrod.resample(system, state, {"head": 5})
    with pytest.raises(ValueError, match="n_elements of 'post' must be at least 2"):
        jaxrod.resample(system, state, {"post": 1})
    one, below = rod(4)
    _, beside = rod(4, start=(0, 0.04, 0))
    pair = {"one": below, "two": beside}
    glue = jaxrod.systems.glue("one", "two", pair, stiffness=1e4)
    scene = jaxrod.make_scene(one)
    glued = jaxrod.make_system({"one": scene, "two": scene}, glue)
    with pytest.raises(ValueError, match="glue joins certain elements of 'one'"):
        jaxrod.resample(glued, pair, 8)

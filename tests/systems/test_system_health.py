"""Health of a system: energy, joints pulled apart, rods passed through each other."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.geometry.rotations import (
    join_quaternion,
    multiply_quaternions,
    split_quaternion,
)
from systems.members import free_system, rod

DT = 1e-4


def crossing(height, **contact):
    """One rod lies across another, `height` above it [m], with contact."""
    one, below = rod(5)
    two, above = rod(4, 0.4, (0.25, -0.2, height), (0, 1, 0))
    state = {"one": below, "two": above}
    members = {"one": jaxrod.make_scene(one), "two": jaxrod.make_scene(two)}
    law = jaxrod.systems.crossing_contact("one", "two", stiffness=1e3, **contact)
    return jaxrod.make_system(members, law, state=state), state


def lowered(state, way):
    """The second rod lower by `way` [m]."""
    moved = state["two"].positions.at[2].add(-way)
    return {**state, "two": replace(state["two"], positions=moved)}


def faster(state, factor):
    """All velocities and spins of rods and bodies times a factor."""

    def one(own):
        velocities, spins = own.rates
        return own.with_rates(factor * velocities, factor * spins)

    return {name: one(own) for name, own in state.items()}


@pytest.mark.slow
def test_energy_of_members_joints_and_bodies_together_is_examined():
    """A run is not flagged; a fifth more of the speed is, and as work it is not."""
    system, state = free_system()
    dt = jaxrod.stable_dt(system).dt
    before = system.total_energy(state)
    after = jaxrod.advance(system, state, dt, 200)
    given = {"energy_before": before, "n_steps": 200}
    seen = jaxrod.health(system, after, dt, **given)
    assert not seen.flagged and seen.faults == ()
    np.testing.assert_allclose(
        seen.energy_growth, system.total_energy(after) - before, atol=1e-12
    )
    more = faster(after, 1.2)
    wrong = jaxrod.health(system, more, dt, **given)
    assert wrong.energy and wrong.flagged and not wrong.members["one"].flagged
    assert [fault[:11] for fault in wrong.faults] == ["energy grew"]
    gained = system.total_energy(more) - before
    assert not jaxrod.health(system, more, dt, work_input=gained, **given).flagged


@pytest.mark.slow
def test_energy_that_a_system_may_gain_does_not_depend_on_its_mean_motion():
    system, state = free_system()
    flying = {}
    for name, own in state.items():
        velocities, spins = own.rates
        flying[name] = own.with_rates(velocities + 30.0, spins)
    slow, fast = (
        jaxrod.health(system, one, DT, energy_before=system.total_energy(one))
        for one in (state, flying)
    )
    np.testing.assert_allclose(slow.energy_allowed, fast.energy_allowed, rtol=1e-6)
    # What is held has no mean motion of its own.
    held = jaxrod.systems.pose_spring(("ball",), state, stiffness=1e-9)
    system = jaxrod.make_system(system.members, *system.couplings, held)
    energy = system.total_energy(flying)
    kept = jaxrod.health(system, flying, DT, energy_before=energy)
    assert kept.energy_allowed > 100 * fast.energy_allowed


@pytest.mark.slow
def test_energy_of_couplings_counts_and_so_does_their_round_off():
    """Far from the origin, in float32, springs between rods are shaken by rounding."""
    one, left = rod(4)
    two, right = rod(4, start=(0.5, 0, 0))
    joint = {"stiffness": 1e5}
    allowed = []
    for far in (0.0, 1e3):
        state = {
            name: replace(own, positions=own.positions + far)
            for name, own in (("left", left), ("right", right))
        }
        members = {"left": jaxrod.make_scene(one), "right": jaxrod.make_scene(two)}
        ends = ("left", "tip"), ("right", "base")
        coupled = jaxrod.systems.ball_joint(*ends, state, **joint)
        for couplings in ((), coupled):
            system, own = jaxrod.astype(
                (jaxrod.make_system(members, couplings), state), jnp.float32
            )
            seen = jaxrod.health(system, own, DT, energy_before=0.0)
            allowed.append(float(seen.energy_allowed))
    assert allowed[1] > allowed[0] and allowed[3] - allowed[2] > 1e-3
    spacing = float(jnp.spacing(jnp.float32(1e3)))
    # Twice a node's mass over its share: both ends of a spring of equal rods.
    expected = 1000 * 1e5 * 2 * 2 * 3 * spacing**2 / 12
    np.testing.assert_allclose(allowed[3] - allowed[2], expected, rtol=0.5)


def joints():
    """Joints of springs between two rods end to end, by name."""
    given = {"stiffness": 1e3}
    axis = {"axis": (0.0, 0.0, 1.0), "axis_stiffness": 1.0}
    return {
        "ball": lambda *ends: jaxrod.systems.ball_joint(*ends, **given),
        "hinge": lambda *ends: jaxrod.systems.hinge_joint(*ends, **given, **axis),
        "fixed": lambda *ends: jaxrod.systems.fixed_joint(
            *ends, **given, turning_stiffness=1.0
        ),
    }


@pytest.mark.slow
@pytest.mark.parametrize("kind", joints())
def test_a_joint_that_is_pulled_apart_is_flagged_and_named(kind):
    one, left = rod(4)
    two, right = rod(4, start=(0.5, 0, 0), radius=0.01)
    state = {"left": left, "right": right}
    made = joints()[kind](("left", "tip"), ("right", "base"), state)
    members = {"left": jaxrod.make_scene(one), "right": jaxrod.make_scene(two)}
    system = jaxrod.make_system(members, made)
    assert jaxrod.health(system, state, DT).largest_gap < 1e-100
    for gap, wrong in ((0.9, False), (1.1, True)):
        # In radii of the thinner rod.
        moved = right.positions.at[1].add(0.01 * gap)
        apart = {**state, "right": replace(right, positions=moved)}
        seen = jaxrod.health(system, apart, DT)
        np.testing.assert_allclose(seen.largest_gap, gap, rtol=1e-12)
        assert bool(seen.joints) == wrong == bool(seen.flagged)
    assert seen.faults == ("Springs of 'left' and 'right': apart by 1.1 radii",)
    # Energy of the spring alone has grown; the kinetic energy is zero.
    energy = system.total_energy(state)
    wrong = jaxrod.health(system, apart, DT, energy_before=energy)
    stored = 0.5 * 1e3 * (1.1 * 0.01) ** 2
    np.testing.assert_allclose(wrong.energy_growth, stored, rtol=1e-9)
    assert wrong.energy and wrong.faults[-1].startswith("energy grew by 0.0605 J")
    paid = jaxrod.health(system, apart, DT, energy_before=energy, work_input=stored)
    assert not paid.energy


def elastic():
    """Couplings with elastic joints between two rods that cross at a node, by name."""
    made = jaxrod.systems
    ends = ("one", 2), ("two", 2)
    stiff = {"stiffness": 1e3, "turning_stiffness": 1.0}
    return {
        "weld": lambda state: made.weld(*ends, state),
        "fixed_joint": lambda state: made.fixed_joint(*ends, state, **stiff),
        "glue": lambda state: made.glue("one", "two", state, **stiff),
    }


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("kind", elastic())
def test_a_joint_that_is_turned_too_far_is_flagged_and_named(kind):
    """A turn of 2.4 rad is not flagged; beyond half a turn the angle is the rest."""
    (one, first), (two, second) = rod(4), rod(4)
    state = {"one": first, "two": second}
    members = {"one": jaxrod.make_scene(one), "two": jaxrod.make_scene(two)}
    system = jaxrod.make_system(members, elastic()[kind](state))
    for angle, wrong in ((0.0, False), (2.4, False), (2.6, True), (3.6, True)):
        # About z: elements by quaternions, nodes about the middle.
        c, s = np.cos(angle), np.sin(angle)
        turn = jnp.asarray([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        middle = second.positions[:, 2:3]
        half = [jnp.asarray(x) for x in (np.cos(angle / 2), 0, 0, np.sin(angle / 2))]
        turned = multiply_quaternions(half, split_quaternion(second.orientations))
        moved = replace(
            second,
            positions=middle + turn @ (second.positions - middle),
            orientations=join_quaternion(turned),
        )
        seen = jaxrod.health(system, {**state, "two": moved}, DT)
        found = min(angle, 2 * np.pi - angle)
        np.testing.assert_allclose(seen.largest_joint_angle, found, atol=1e-9)
        assert bool(seen.joint_angle) == wrong
        assert seen.flagged or not wrong
        words = f"turned by {found:.3g} rad"
        assert any(words in fault for fault in seen.faults) == wrong


@pytest.mark.slow
def test_glue_that_is_pulled_apart_and_a_ball_off_its_joint_are_flagged():
    _, below = rod(4)
    one, beside = rod(4, start=(0, 0.04, 0))
    ball, there = jaxrod.systems.rigid_body(
        jaxrod.shapes.sphere((0.5, 0.04, 0.0), 0.05), density=1e3, dtype=jnp.float64
    )
    state = {"below": below, "beside": beside, "ball": there}
    scene = jaxrod.make_scene(one)
    system = jaxrod.make_system(
        {"below": scene, "beside": scene, "ball": ball},
        jaxrod.systems.glue("below", "beside", state, stiffness=1e4),
        jaxrod.systems.ball_joint(("beside", "tip"), ("ball",), state, stiffness=1e3),
    )
    assert not jaxrod.health(system, state, DT).flagged
    up = replace(below, positions=below.positions.at[2].add(0.05))
    seen = jaxrod.health(system, {**state, "below": up}, DT)
    np.testing.assert_allclose(seen.gaps, (2.5, 0.0), rtol=1e-12, atol=1e-99)
    assert seen.faults == ("Glue of 'below' and 'beside': apart by 2.5 radii",)
    off = replace(there, positions=there.positions.at[2].add(0.03))
    seen = jaxrod.health(system, {**state, "ball": off}, DT)
    # The rod is thinner than the ball's radius of gyration, 0.05 sqrt(2/5).
    np.testing.assert_allclose(seen.gaps, (0.0, 1.5), rtol=1e-12, atol=1e-99)


def test_a_rod_that_passed_through_another_is_flagged():
    height = 0.05
    system, state = crossing(height)
    for way, wrong in ((0.5 * height, False), (1.5 * height, True)):
        seen = jaxrod.health(system, lowered(state, way), DT, before=state)
        assert bool(seen.passed) == wrong
        count = seen.passages["'one' and 'two'"]
        np.testing.assert_allclose(count, float(wrong), atol=1e-9)
    # There and back is not seen.
    there = lowered(state, 1.5 * height)
    assert not jaxrod.health(system, state, DT, before=state).flagged
    words = "'one' and 'two' passed through each other: 1"
    assert words in jaxrod.health(system, there, DT, before=state).faults
    lost = state["two"].velocities.at[1, 2].set(jnp.nan)
    broken = {**state, "two": replace(state["two"], velocities=lost)}
    seen = jaxrod.health(system, broken, DT, before=state)
    assert not seen.finite and "'two': not finite" in seen.faults
    assert not any("'one'" in fault[:5] for fault in seen.faults)


@pytest.mark.slow
def test_equal_rods_pass_through_each_other_and_no_rod_through_the_gap_between_two():
    _, one = rod(4, 0.4, (0, 0, 0))
    _, across = rod(4, 0.4, (0.2, -0.2, 0.1), (0, 1, 0))
    _, aside = rod(4, 0.4, (2.0, 0.0, 0.1), (0, 0, 1))
    rods = [one, across, aside]
    states = {"rods": jax.tree.map(lambda *leaves: jnp.stack(leaves), *rods)}
    made, _ = rod(4, 0.4)
    scenes = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), jaxrod.make_scene(made))
    law = jaxrod.systems.rod_contact("rods", stiffness=1e3)
    system = jaxrod.make_system({"rods": scenes}, law, state=states)

    def moved(number, way):
        changed = states["rods"].positions.at[number, 2].add(way)
        return {"rods": replace(states["rods"], positions=changed)}

    down = jaxrod.health(system, moved(1, -0.2), DT, before=states)
    assert down.passed
    # Two nodes meet, and each of four pairs of elements has a share.
    np.testing.assert_allclose(down.passages["'rods'"], 1.0, atol=1e-9)
    # The row of nodes jumps from the tip of the second rod to the base of the third;
    # the third passes through this jump, and through no rod.
    assert not jaxrod.health(system, moved(2, -0.4), DT, before=states).passed


@pytest.mark.slow
def test_a_rod_with_self_contact_passes_through_itself():
    share = np.linspace(0.0, 2.0 * np.pi * 0.98, 17)
    loop = np.stack([0.2 * np.sin(share), 0.2 * np.cos(share), 0.02 * share])
    # The last stretch crosses the first from above.
    loop[:, -1] = (0.05, 0.3, 0.13)
    loop[:, -2] = (0.03, 0.1, 0.13)
    made, state = jaxrod.rod_along(
        loop, radius=0.01, density=1e3, youngs_modulus=1e6, dtype=jnp.float64
    )
    found = []
    for itself in (True, False):
        law = jaxrod.systems.rod_contact(
            "loop", "post", stiffness=1e3, self_contact=itself
        )
        post, far = rod(3, start=(5, 0, 0))
        states = {"loop": state, "post": far}
        members = {"loop": jaxrod.make_scene(made), "post": jaxrod.make_scene(post)}
        system = jaxrod.make_system(members, law, state=states)
        sunk = replace(state, positions=state.positions.at[2, -2:].add(-0.3))
        seen = jaxrod.health(system, {**states, "loop": sunk}, DT, before=states)
        found.append(bool(seen.passed))
    assert found == [True, False]


@pytest.mark.slow
def test_flags_of_a_batch_of_states_are_their_own():
    system, state = crossing(0.1)
    there = lowered(state, 0.15)
    pair = jax.tree.map(lambda *leaves: jnp.stack(leaves), state, there)
    asked = jax.jit(
        jax.vmap(lambda own: jaxrod.health(system, own, DT, before=state).flagged)
    )
    np.testing.assert_array_equal(asked(pair), [False, True])


@pytest.mark.slow
def test_bad_arguments_are_refused():
    system, state = crossing(0.1)
    with pytest.raises(ValueError, match="n_steps"):
        jaxrod.health(system, state, DT, n_steps=0)
    with pytest.raises(ValueError, match="state must have the members"):
        jaxrod.health(system, state, DT, before={"one": state["one"]})

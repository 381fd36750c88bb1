"""Settings of systems: their numbers of elements, softer contact, and stated errors."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from benchmarks.tuned_systems.run import measured
from benchmarks.tuned_systems.scenes import SCENES
from jaxrod import shapes
from jaxrod.tradeoff import Setting, prepare, workload_of
from jaxrod.tradeoff.measure import members_for, reference, tip_error, tips_of
from jaxrod.tradeoff.workload import Numbers, ends_and_middles
from physics.validation import record as record
from systems.members import rod

X = (1.0, 0.0, 0.0)


def frame(n=8):
    """A post, held at its base, and a shorter beam welded to the post's middle."""
    post, of_post = rod(n, 0.4, (0, 0, 0), (0, 0, 1))
    beam, of_beam = rod(n // 2, 0.3, (0, 0, 0.2), (1, 0, 0))
    state = {"post": of_post, "beam": of_beam}
    members = {
        "post": jaxrod.make_scene(post, jaxrod.clamp(of_post), jaxrod.gravity()),
        "beam": jaxrod.make_scene(beam, jaxrod.gravity()),
    }
    weld = jaxrod.systems.weld(("post", n // 2), ("beam", "base"), state)
    return jaxrod.make_system(members, weld, state=state), state


def frame_in(units=(1.0, 1.0, 1.0), shift=0.0, turned=False):
    """A post, a beam welded to its middle and a floor under the beam.

    `units` are the numbers that a metre, a kilogram and a second are, `shift` is the
    height of all [m]. If `turned`, the members and the sides of the weld change places.
    """
    m, kg, s = units

    def part(n, length, height, way):
        return jaxrod.straight_rod(
            n,
            length=length * m,
            radius=0.01 * m,
            density=1000.0 * kg / m**3,
            youngs_modulus=1e6 * kg / (m * s**2),
            start=(0.0, 0.0, (height + shift) * m),
            direction=way,
            dtype=jnp.float64,
        )

    (post, of_post), (beam, of_beam) = part(8, 0.4, 0, (0, 0, 1)), part(4, 0.3, 0.2, X)
    down = jaxrod.gravity((0.0, 0.0, -9.81 * m / s**2))
    floor = jaxrod.contact(
        shapes.plane((0.0, 0.0, (0.185 + shift) * m)),
        stiffness=3e3 * kg / (m * s**2),
        damping=3.0 * kg / (m * s),
    )
    members = {
        "post": jaxrod.make_scene(post, jaxrod.clamp(of_post), down),
        "beam": jaxrod.make_scene(beam, down, floor),
    }
    state = {"post": of_post, "beam": of_beam}
    sides = [("post", 4), ("beam", "base")]
    if turned:
        members, state = (dict(reversed(own.items())) for own in (members, state))
        sides.reverse()
    weld = jaxrod.systems.weld(*sides, state)
    return jaxrod.make_system(members, weld, state=state), state


def points_in(units=(1.0, 1.0, 1.0), shift=0.0, turned=False):
    """Steps of a period, and the path of both rods seen from the floor [m]."""
    system, state = frame_in(units, shift, turned)
    work = workload_of(system, state, duration=0.1 * units[2], periods=5)
    ready = prepare(work, Setting(8, dtype="float64"))
    # Members are sorted by name, so that points are in the same order.
    return ready, tips_of(work, ready) / units[0] - np.array([0.0, 0.0, shift])


@pytest.mark.slow
def test_settings_are_measured_alike_far_away_in_other_units_and_in_any_order():
    """The steps that `stable_dt` allows, and the path, are the same."""
    ready, path = points_in()
    assert np.ptp(path[:, -1, 2]) > 1e-3
    views = {
        "far away": ({"shift": 300.0}, 1e-9),
        "millimetres, grams, milliseconds": ({"units": (1e3, 1e3, 1e3)}, 1e-12),
        "another order": ({"turned": True}, 1e-12),
    }
    for name, (view, allowed) in views.items():
        own, found = points_in(**view)
        assert own.substeps == ready.substeps, name
        second = view.get("units", (1.0,) * 3)[2]
        np.testing.assert_allclose(own.setting.dt / second, ready.setting.dt)
        np.testing.assert_allclose(found, path, atol=allowed, err_msg=name)


def test_rods_keep_their_proportion_and_have_nodes_at_joints():
    system, _ = frame()
    assert system.joined_nodes() == {"post": {4}, "beam": {0}}
    numbers = Numbers.of(system)
    for n in (2, 5, 12, 160):
        found = numbers.by_name(n)
        assert found["post"] == numbers.fitting(n) and found["post"] % 2 == 0
        assert abs(found["post"] - n) <= 1
        assert abs(found["beam"] - n / 2) <= 1 and found["beam"] >= 2


def test_softer_contact_is_slower_and_damped_as_before():
    """Frequencies and rates fall alike, so a collision takes the same energy."""
    arm, _ = rod()
    law = {"stiffness": 1e4, "damping": 8.0, "friction": 0.5, "friction_drag": 6.0}
    floor = jaxrod.contact(shapes.plane((0, 0, -0.03)), **law)
    both = jaxrod.systems.rod_contact("a", "b", **law)
    scene = jaxrod.make_scene(arm, floor, jaxrod.gravity())
    system = jaxrod.make_system({"a": scene, "b": scene}, both)
    soft = system.softened(0.25)
    pairs = [(system.couplings[0], soft.couplings[0])]
    pairs += [
        (system.members[k].effects[0], soft.members[k].effects[0]) for k in ("a", "b")
    ]
    for stiff, softer in pairs:
        for name, share in (
            ("stiffness", 0.25),
            ("damping", 0.5),
            ("friction_drag", 0.5),
            ("friction", 1.0),
        ):
            before, after = getattr(stiff, name), getattr(softer, name)
            np.testing.assert_allclose(after, share * before, rtol=1e-12)
            assert after.dtype == before.dtype
    assert scene.softened(0.25).effects[1] is scene.effects[1]


def test_fewer_contact_points_are_a_share_and_at_least_one():
    arm, _ = rod()
    floor = jaxrod.contact(
        shapes.plane((0, 0, -0.03)), stiffness=1e4, points_per_element=6
    )
    scene = jaxrod.make_scene(arm, floor, jaxrod.gravity())
    contact = jaxrod.systems.rod_contact("a", "b", stiffness=1e4, points_per_element=3)
    system = jaxrod.make_system({"a": scene, "b": scene}, contact)
    half, none = system.thinned(0.5), system.thinned(0.01)
    assert half.members["a"].effects[0].points_per_element == 3
    assert half.couplings[0].points_per_element == (2, 2)
    assert none.members["b"].effects[0].points_per_element == 1
    assert none.couplings[0].points_per_element == (1, 1)


def test_the_middle_of_a_rod_is_on_a_smooth_curve():
    """With an odd number of elements it is between nodes, exact for cubics."""

    made, state = rod(7, 1.0)
    x = state.positions[0]
    places = jnp.stack([x, x**3 - x, 2 * x**2])
    state = dataclasses.replace(state, positions=places)
    found = ends_and_middles(jaxrod.make_scene(made), state)
    expected = [[0, 0, 0], [0.5, -0.375, 0.5], [1, 0, 2]]
    np.testing.assert_allclose(found, expected, atol=1e-14)


def test_points_are_nan_where_contact_was_missed():
    """Lists that were too short make an error infinite instead of wrong."""
    arm, state = rod()
    scenes = {"a": jaxrod.make_scene(arm)}
    system = jaxrod.make_system(scenes)
    for missed, finite in ((0.0, True), (2.0, False)):
        record = jaxrod.systems.NeighbourRecord(
            missed=jnp.array(missed), moved=jnp.array(0.0), used=jnp.array(5.0)
        )
        points = ends_and_middles(system, {"a": state, "neighbours": record})
        assert bool(jnp.all(jnp.isfinite(points))) is finite


def test_a_system_without_rods_cannot_be_tuned():
    ball, state = jaxrod.systems.rigid_body(
        shapes.sphere((0, 0, 0), 0.1), density=100.0, dtype=jnp.float64
    )
    system = jaxrod.make_system({"ball": ball})
    with pytest.raises(ValueError, match="give a scene, or a system that has a rod"):
        jaxrod.tune(system, {"ball": state})
    with pytest.raises(ValueError, match="state must be given"):
        jaxrod.tune(system)
    with pytest.raises(ValueError, match="state must have the members"):
        jaxrod.tune(system, {})


@pytest.mark.slow
def test_a_system_of_one_rod_is_measured_as_its_scene():
    arm, state = rod(8)
    scene = jaxrod.make_scene(arm, jaxrod.clamp(state), jaxrod.gravity())
    alone = workload_of(scene, state, duration=0.1, periods=5)
    system = jaxrod.make_system({"arm": scene})
    member = workload_of(system, {"arm": state}, duration=0.1, periods=5)
    assert alone.plane == member.plane == "zx"
    for reductions in ((), ("planar",), ("inertia",), ("compensated",)):
        setting = Setting(6, dtype="float64", reductions=reductions)
        one, other = (prepare(work, setting) for work in (alone, member))
        assert one.substeps == other.substeps
        np.testing.assert_allclose(
            tips_of(alone, one), tips_of(member, other), atol=1e-12
        )
    coarse, again = reference(alone, 16), reference(member, 16)
    assert coarse.length == again.length == pytest.approx(0.5)
    np.testing.assert_allclose(coarse.error, again.error, rtol=1e-6)


@pytest.mark.slow
def test_the_error_of_a_reference_follows_from_its_measured_order():
    system, state = frame()
    work = workload_of(system, state, duration=0.1, periods=5)
    assert members_for(work, "planar") == ("beam", "post")
    exact = reference(work, 32)
    assert 1 <= exact.order <= 2
    finer = tips_of(work, prepare(work, Setting(128, dtype="float64", safety=0.05)))
    assert 0.5 < tip_error(exact.tips, finer, exact.length) / exact.error < 2.0
    few = reference(work, 128, enough=0.01)
    assert few.error <= 0.01 and few.n_elements < 128


@pytest.mark.slow
def test_contact_is_softened_where_that_permits_larger_steps():
    """A rope falls on a floor that is far stiffer than the motion needs."""
    rope, state = rod(8, 0.5, (0, 0, 0.04), youngs_modulus=1e5)
    floor = jaxrod.contact(shapes.plane((0, 0, 0)), stiffness=1e8, damping=300.0)
    scene = jaxrod.make_scene(rope, floor, jaxrod.gravity())
    found = jaxrod.tune(
        jaxrod.make_system({"rope": scene}),
        {"rope": state},
        max_error=0.05,
        duration=0.1,
        elements=(4, 6),
        seconds=0.01,
    )
    assert found.met and found.setting.contact < 1
    assert "times as stiff" in str(found)
    stiff = found.prepared.scene.members["rope"].effects[0].stiffness
    np.testing.assert_allclose(stiff, 1e8 * found.setting.contact, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(SCENES))
def test_the_stated_error_is_the_true_one(name, record):
    found = measured(name, 0.02, 120, elements=(6, 8, 10, 14, 20, 28, 40), seconds=0.05)
    assert found["met"]
    record(
        f"Stated error of {name}, tuned, over the true one, less one",
        "120 elements, a twentieth of the stable step",
        abs(found["ratio"] - 1),
        at_most=0.3,
    )

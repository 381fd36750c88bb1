"""Every health flag is raised just beyond its limit, and no other with it."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.effects.clamps import Clamp
from jaxrod.structure import pytree
from physics.rods import arm, deformed, turn

DT = 1e-4
FLAGS = ("stretch", "joint_angle", "speed", "spin", "norm", "energy")


def raised(report):
    flags = {name for name in FLAGS if getattr(report, name)}
    return flags if report.finite else flags | {"finite"}


def scaled(state, factor):
    return replace(state, positions=factor * state.positions)


def bent(state, angle):
    """The last element turned about d1, its length kept."""
    turns = jnp.zeros((3, 5)).at[0, 4].set(angle)
    turned = replace(state, orientations=turn(state.orientations, turns))
    edge = jnp.linalg.norm(state.positions[:, -1] - state.positions[:, -2])
    tip = state.positions[:, -2] + edge * turned.directors[2, :, -1]
    return replace(turned, positions=state.positions.at[:, -1].set(tip))


def of_norm(state, norm):
    return replace(state, orientations=state.orientations.at[:, 2].mul(norm))


def moving(state, speed):
    """Two nodes against each other."""
    velocities = state.velocities.at[1, 2].set(speed).at[1, 3].set(-speed)
    return replace(state, velocities=velocities)


def spinning(state, rate):
    spins = jnp.zeros((3, 5)).at[2, 2].set(rate)
    return jaxrod.with_angular_velocities(arm(5)[0], state, spins)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    ("change", "wrong", "fine", "flag"),
    [
        (scaled, 0.29, 0.31, "stretch"),
        (scaled, 2.51, 2.49, "stretch"),
        (bent, 2.55, 2.45, "joint_angle"),
        (moving, 255.0, 245.0, "speed"),
        (spinning, 10_100.0, 9_900.0, "spin"),
        (of_norm, 1.0006, 1.0004, "norm"),
        (of_norm, 0.9994, 0.9996, "norm"),
    ],
)
def test_each_flag_is_raised_just_beyond_its_limit(change, wrong, fine, flag):
    rod, state = arm(5)
    scene = jaxrod.make_scene(rod)
    report = jaxrod.health(scene, change(state, wrong), DT)
    assert raised(report) == {flag}
    assert bool(report.flagged)
    report = jaxrod.health(scene, change(state, fine), DT)
    assert raised(report) == set()
    assert not bool(report.flagged)


def test_the_values_behind_the_flags():
    rod, state = arm(5)
    state = moving(spinning(bent(scaled(state, 1.2), 1.5), 70.0), 3.0)
    report = jaxrod.health(jaxrod.make_scene(rod), state, DT)
    np.testing.assert_allclose(report.smallest_stretch, 1.2)
    np.testing.assert_allclose(report.largest_stretch, 1.2)
    np.testing.assert_allclose(report.largest_joint_angle, 1.5)
    np.testing.assert_allclose(report.largest_speed, 3.0)
    np.testing.assert_allclose(report.largest_spin, 70.0)
    np.testing.assert_allclose(report.largest_norm_error, 0.0, atol=1e-15)


def test_speed_is_relative_to_the_rods_own_motion_unless_something_holds_it():
    rod, state = arm(5)
    wind = jnp.array([[300.0], [0.0], [400.0]])
    fast = replace(moving(state, 3.0), velocities=moving(state, 3.0).velocities + wind)
    report = jaxrod.health(jaxrod.make_scene(rod), fast, DT)
    np.testing.assert_allclose(report.largest_speed, 3.0)
    assert raised(report) == set()
    for tie in (
        jaxrod.clamp(state),
        jaxrod.fixed_end(state),
        jaxrod.contact(jaxrod.shapes.sphere((5.0, 0.0, 0.0), 1.0), stiffness=1e5),
    ):
        report = jaxrod.health(jaxrod.make_scene(rod, tie), fast, DT)
        np.testing.assert_allclose(report.largest_speed, np.hypot(500, 3))
        assert raised(report) == {"speed"}


@pytest.mark.parametrize("bad", [0.0, -1e-4, np.nan, np.inf])
def test_a_step_that_is_none_is_refused_and_flagged_where_it_is_traced(bad):
    rod, state = arm(5)
    scene = jaxrod.make_scene(rod)
    with pytest.raises(ValueError, match="dt must be"):
        jaxrod.health(scene, state, bad)
    report = jax.jit(jaxrod.health)(scene, state, bad)
    assert raised(report) == {"speed", "spin"}
    assert bool(report.flagged)


@pytest.mark.parametrize("hold", [jaxrod.clamp, jaxrod.fixed_end])
@pytest.mark.parametrize("end", ["base", "tip"])
def test_an_end_is_flagged_a_radius_from_where_it_is_held(hold, end):
    rod, state = arm(5)
    scene = jaxrod.make_scene(rod, hold(state, end))
    for distance, wrong in ((0.051, True), (0.049, False)):
        moved = replace(state, positions=state.positions + distance / 3**0.5)
        report = jaxrod.health(scene, moved, DT)
        np.testing.assert_allclose(report.largest_violation, distance / 0.05)
        assert bool(report.violation) == bool(report.flagged) == wrong
    bare = jaxrod.make_scene(rod, Clamp(state.orientations[:, 0]))
    assert not jaxrod.health(bare, moved, DT).flagged


@pytest.mark.parametrize("end", ["base", "tip"])
def test_a_hinge_is_told_its_way_from_its_place_or_how_far_its_axis_is_turned(end):
    rod, state = arm(5)
    scene = jaxrod.make_scene(rod, jaxrod.hinge_support(state, (0.6, 0.0, 0.8), end))
    assert float(jaxrod.health(scene, state, DT).largest_violation) < 1e-12
    moved = replace(state, positions=state.positions + 0.02 / 3**0.5)
    report = jaxrod.health(scene, moved, DT)
    np.testing.assert_allclose(report.largest_violation, 0.02 / 0.05)
    # About the rod's own axis: the part of the hinge's axis across it moves.
    twisted = turn(state.orientations, jnp.zeros((3, 5)).at[2].set(0.3))
    report = jaxrod.health(scene, replace(state, orientations=twisted), DT)
    expected = 0.6 * 2 * np.sin(0.15)
    np.testing.assert_allclose(report.largest_violation, expected, rtol=1e-9)


def test_a_rod_is_flagged_where_its_centreline_is_in_one_of_several_bodies():
    rod, state = arm(5)
    centres = jnp.asarray([[0.6, 0.0, 0.4], [0.2, 0.0, 2.0]])
    balls = jax.vmap(lambda centre: jaxrod.shapes.sphere(centre, 0.5))(centres)
    touch = jaxrod.contact(balls, stiffness=1e5)
    near = jaxrod.near_contact(touch, rod, state, 1)
    for contact in (touch, near):
        scene = jaxrod.make_scene(rod, contact)
        for shift, depth in ((0.0, 0.0), (0.09, 0.8), (0.11, 1.2)):
            moved = replace(state, positions=state.positions.at[0].add(shift))
            report = jaxrod.health(scene, moved, DT)
            expected = max(0.0, 1 - (0.1 - shift) / 0.05) if depth else 0.0
            np.testing.assert_allclose(report.largest_violation, expected, atol=1e-9)
            assert bool(report.violation) == (expected > 1)


@pytree
class Fence(jaxrod.extend.Effect):
    """A user's own: the tip below a height."""

    height: jax.Array

    def violation(self, rod, state):
        return jnp.maximum(state.tip[2] - self.height, 0) / rod.length


def test_what_an_effect_of_ones_own_is_violated_by_is_flagged():
    rod, state = arm(5)
    for height, wrong in ((0.5, False), (-0.5, True)):
        scene = jaxrod.make_scene(rod, Fence(jnp.asarray(height)))
        report = jaxrod.health(scene, state, DT)
        np.testing.assert_allclose(report.largest_violation, 1 - height)
        assert bool(report.flagged) == wrong


def test_limits_are_the_callers():
    rod, state = arm(5)
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state))
    moved = replace(state, positions=state.positions.at[0].add(0.1))
    assert jaxrod.health(scene, moved, DT).flagged
    wide = jaxrod.HealthLimits(largest_violation=3.0)
    assert not jaxrod.health(scene, moved, DT, limits=wide).flagged


def test_energy_from_nowhere_is_flagged_and_work_is_not():
    rod, state = arm(5)
    scene = jaxrod.make_scene(rod)
    before = scene.total_energy(moving(state, 1.0))
    after = moving(state, 2.0)
    gained = float(scene.total_energy(after) - before)
    assert raised(jaxrod.health(scene, after, DT, energy_before=before)) == {"energy"}
    report = jaxrod.health(scene, after, DT, energy_before=before, work_input=gained)
    assert raised(report) == set()


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    "field", ["positions", "orientations", "velocities", "angular_momenta"]
)
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_is_flagged(field, bad):
    rod, state = arm(5)
    broken = getattr(state, field).at[1, 2].set(bad)
    scene = jaxrod.make_scene(rod)
    report = jaxrod.health(
        scene, replace(state, **{field: broken}), DT, energy_before=1.0
    )
    assert "finite" in raised(report)
    assert bool(report.flagged)


def test_nan_everywhere_raises_every_flag():
    rod, state = arm(5)
    nothing = jax.tree.map(lambda leaf: leaf * jnp.nan, state)
    report = jaxrod.health(jaxrod.make_scene(rod), nothing, DT, energy_before=1.0)
    assert raised(report) == {*FLAGS, "finite"}


def test_one_bad_rod_in_a_batch_leaves_the_others_alone():
    rod, _ = arm(5)
    scene = jaxrod.make_scene(rod)
    states = [deformed(rod, seed, 0.3, 0.02, speed=0.1) for seed in range(4)]
    broken = replace(states[2], velocities=states[2].velocities * jnp.nan)
    run = jax.jit(jax.vmap(lambda s: jaxrod.advance(scene, s, DT, 20)))
    good = run(jax.tree.map(lambda *leaves: jnp.stack(leaves), *states))
    mixed = [*states[:2], broken, states[3]]
    bad = run(jax.tree.map(lambda *leaves: jnp.stack(leaves), *mixed))
    flags = jax.vmap(lambda s: jaxrod.health(scene, s, DT).flagged)(bad)
    np.testing.assert_array_equal(flags, [False, False, True, False])
    for i in (0, 1, 3):
        np.testing.assert_array_equal(good.positions[i], bad.positions[i])


@pytest.mark.slow
def test_a_flagged_rod_is_frozen_and_the_others_go_on_to_the_last_bit():
    """Of 4096 rods one gets a not-a-number load after a while; in float32."""
    bad, steps, fails = 1234, 6, 3
    rod, state = arm(5, dtype=jnp.float32)
    random = np.random.default_rng(0)
    couples = random.uniform(-50, 50, (4096, 3, 5)).astype(np.float32)

    def control_step(carry, k):
        rods, frozen, broken = carry
        load = jnp.where(broken & (k >= fails), jnp.nan, couples)

        def one(rod_state, load):
            scene = jaxrod.make_scene(
                rod, jaxrod.clamp(state), jaxrod.actuation.ElementCouples(load)
            )
            after = jaxrod.advance(scene, rod_state, 2e-4, 3)
            return after, jaxrod.health(scene, after, 2e-4).flagged

        after, flagged = jax.vmap(one)(rods, load)
        frozen = frozen | flagged
        rods = jaxrod.freeze(frozen, rods, after)
        return (rods, frozen, broken), rods

    @jax.jit
    def run(broken):
        rods = jax.tree.map(lambda leaf: jnp.repeat(leaf[None], 4096, axis=0), state)
        start = rods, jnp.zeros(4096, bool), broken
        (_, frozen, _), history = jax.lax.scan(control_step, start, jnp.arange(steps))
        return frozen, history

    nobody = jnp.zeros((4096, 1, 1), bool)
    none_frozen, sound = run(nobody)
    one_frozen, with_bad = run(nobody.at[bad].set(True))
    assert not np.any(none_frozen)
    np.testing.assert_array_equal(np.flatnonzero(one_frozen), [bad])
    others = np.arange(4096) != bad
    for good, mixed in zip(
        jax.tree.leaves(sound), jax.tree.leaves(with_bad), strict=True
    ):
        np.testing.assert_array_equal(good[:, others], mixed[:, others])
        # The last sound state is the one before the load broke, and it stays.
        for later in range(fails, steps):
            np.testing.assert_array_equal(mixed[later, bad], good[fails - 1, bad])


def around(radius):
    """A rod, and a body whose function holds its radius instead of taking it."""
    rod, state = arm(4, jnp.float64)
    away = lambda p, offset: jnp.sqrt(sum(x * x for x in p) + offset) - radius
    body = jaxrod.shapes.signed_distance(away, 1e-9)
    return jaxrod.make_scene(rod, jaxrod.contact(body, stiffness=1e4)), state


def test_functions_of_bodies_may_hold_traced_numbers():
    """No kernel takes them."""
    deepest = lambda r: jaxrod.health(*around(r), 1e-4).largest_violation
    found = jax.jit(deepest)(0.1)
    np.testing.assert_allclose(found, deepest(0.1), rtol=1e-9)


@pytest.mark.slow
def test_functions_of_bodies_may_hold_traced_numbers_under_all_transforms():
    deepest = lambda r: jaxrod.health(*around(r), 1e-4).largest_violation
    moved = lambda r: jaxrod.advance(*around(r), 1e-4, 2).positions[0, -1]
    for value in (deepest, moved):
        both = [value(0.1), value(0.2)]
        np.testing.assert_allclose(jax.jit(value)(0.1), both[0], rtol=1e-9)
        many = jax.vmap(value)(jnp.array([0.1, 0.2]))
        np.testing.assert_allclose(many, both, rtol=1e-9)
    assert np.isfinite(jax.grad(deepest)(0.1))


@pytest.mark.parametrize("limits", [2.0, {"largest_stretch": 2.0}, jaxrod.HealthLimits])
def test_limits_and_states_of_another_kind_are_refused(limits):
    rod, state = arm(4, jnp.float64)
    scene = jaxrod.make_scene(rod)
    with pytest.raises(TypeError, match="limits must be"):
        jaxrod.health(scene, state, 1e-4, limits=limits)
    with pytest.raises(TypeError, match="before must be"):
        jaxrod.health(scene, state, 1e-4, before="x")
    with pytest.raises(TypeError, match="state must be"):
        jaxrod.health(scene, None, 1e-4)

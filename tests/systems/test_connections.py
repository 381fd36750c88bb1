"""Welds, ties, attachments and joints against closed forms and one another."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.geometry.rotations import directors, rotation_log, to_material
from jaxrod.rods.motion import Loads, Motion
from jaxrod.systems.coupling import Carried
from jaxrod.systems.joints.welds import Attachment
from jaxrod.systems.members.rigid_stepper import RigidStepper
from jaxrod.systems.stepping.assembly import seen_at_rest
from systems.members import free_system, rod


@pytest.mark.slow
def test_two_halves_are_the_whole(record):
    whole, of_whole = rod(20, 1.0)
    left, of_left = rod(10, 0.5)
    right, of_right = rod(10, 0.5, (0.5, 0, 0))
    gravity = jaxrod.gravity()
    state = {"left": of_left, "right": of_right}
    halves = jaxrod.make_system(
        {
            "left": jaxrod.make_scene(left, jaxrod.clamp(of_left), gravity),
            "right": jaxrod.make_scene(right, gravity),
        },
        jaxrod.systems.weld(("left", "tip"), ("right", "base"), state),
        state=state,
    )
    scene = jaxrod.make_scene(whole, jaxrod.clamp(of_whole), gravity)
    dt = jaxrod.stable_dt(scene).dt
    assert jaxrod.stable_dt(halves).dt == pytest.approx(float(dt), rel=1e-12)
    together = jaxrod.advance(halves, state, dt, 1000)
    alone = jaxrod.advance(scene, of_whole, dt, 1000)
    assert alone.tip[2] < -0.4
    apart = np.hstack(
        [
            together["left"].positions - alone.positions[:, :11],
            together["right"].positions - alone.positions[:, 10:],
        ]
    )
    record(
        "two welded halves, 1000 steps",
        "one rod",
        np.max(np.abs(apart)),
        at_most=1e-12,
    )


@pytest.mark.slow
def test_damped_steps_lead_a_system_to_its_equilibrium(record):
    """Of two halves of a rod: where one solve finds the whole rod's."""
    whole, of_whole = rod(8, 0.4)
    left, of_left = rod(4, 0.2)
    right, of_right = rod(4, 0.2, (0.2, 0, 0))
    held, gravity = jaxrod.clamp(of_left), jaxrod.gravity()
    scene = jaxrod.make_scene(whole, jaxrod.clamp(of_whole), gravity)
    expected = jaxrod.equilibrium(scene, of_whole)
    assert expected.converged and expected.state.tip[2] < -0.05
    slowest = float(jaxrod.natural_frequencies(scene, expected.state, n_modes=1)[0])
    damping = jaxrod.exponential_damping(2 * slowest)
    state = {"left": of_left, "right": of_right}
    halves = jaxrod.make_system(
        {
            "left": jaxrod.make_scene(left, held, gravity, damping),
            "right": jaxrod.make_scene(right, gravity, damping),
        },
        jaxrod.systems.weld(("left", "tip"), ("right", "base"), state),
        state=state,
    )
    dt = float(jaxrod.stable_dt(halves).dt)
    found = jaxrod.advance(halves, state, dt, int(30 / slowest / dt))
    record(
        "two welded halves that sag, critically damped steps [m]",
        "equilibrium of one rod",
        np.max(np.abs(found["right"].tip - expected.state.tip)),
        at_most=1e-9,
    )


@pytest.mark.slow
def test_equal_rods_in_one_leaf_are_separate_rods():
    """And two of them welded are what two members welded are."""
    starts = jnp.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
    rods, states = jax.vmap(lambda start: rod(6, 0.5, start))(starts)
    scenes = jax.vmap(lambda r: jaxrod.make_scene(r, jaxrod.gravity()))(rods)
    singles = [jax.tree.map(lambda leaf, k=k: leaf[k], states) for k in (0, 1)]
    alone = {"a": singles[0], "b": singles[1]}
    group = jaxrod.make_system(
        {"rods": scenes},
        jaxrod.systems.weld(("rods", 0, "tip"), ("rods", 1, "base"), {"rods": states}),
    )
    pair = jaxrod.make_system(
        {
            name: jax.tree.map(lambda leaf, k=k: leaf[k], scenes)
            for k, name in enumerate("ab")
        },
        jaxrod.systems.weld(("a", "tip"), ("b", "base"), alone),
    )
    kicked = jnp.zeros((3, 7)).at[1, 0].set(1.0)
    states = replace(states, velocities=states.velocities.at[0].set(kicked))
    alone["a"] = replace(alone["a"], velocities=kicked)
    dt = jaxrod.stable_dt(pair).dt
    assert jaxrod.stable_dt(group).dt == pytest.approx(float(dt), rel=1e-12)
    one = jaxrod.advance(group, {"rods": states}, dt, 200)["rods"]
    two = jaxrod.advance(pair, alone, dt, 200)
    assert np.max(np.abs(two["b"].velocities)) > 0.1
    for k, name in enumerate("ab"):
        np.testing.assert_allclose(
            one.positions[k], two[name].positions, rtol=0, atol=1e-13
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("share", "root"), [(0.5, 1.4200), (1.0, 1.2479), (2.0, 1.0762)]
)
def test_cantilever_with_a_tip_mass(share, root, record):
    """First frequency of a clamped beam with a mass at its end, by the beam's roots."""
    n, radius = 20, 0.004
    body, state = rod(n, 1.0, radius=radius, youngs_modulus=1e8)
    mass = float(jnp.sum(body.element_masses))
    weight, of_weight = jaxrod.systems.rigid_body(
        mass=share * mass,
        inertia=(1e-9, 1e-9, 1e-9),
        position=(1.0, 0.0, 0.0),
        dtype=jnp.float64,
    )
    rest = {"beam": state, "weight": of_weight}
    system = jaxrod.make_system(
        {"beam": jaxrod.make_scene(body, jaxrod.clamp(state)), "weight": weight},
        jaxrod.systems.attach(("beam", "tip"), ("weight",), rest, turning=True),
    )
    bending, density = float(body.bend_twist_stiffness[0, 0]), mass
    expected = root**2 * np.sqrt(bending / density)
    x = np.linspace(0, 1, n + 1)
    shape = x**2 * (3 - x) / 2
    start = {
        "beam": replace(state, velocities=state.velocities.at[1].set(1e-3 * shape)),
        "weight": replace(of_weight, velocities=of_weight.velocities.at[1].set(1e-3)),
    }
    dt = jaxrod.stable_dt(system).dt
    periods = 6
    steps = int(periods * 2 * np.pi / expected / dt)
    every = max(steps // 2000, 1)
    steps -= steps % every
    path = jaxrod.rollout(system, start, dt, steps, every)
    tip = np.asarray(path["weight"].positions[:, 1, 0])
    times = np.asarray(jaxrod.rollout_times(dt, steps, every))
    up = np.flatnonzero((tip[:-1] < 0) & (tip[1:] >= 0))
    crossings = times[up] - tip[up] * np.diff(times)[0] / (tip[up + 1] - tip[up])
    period = (crossings[-1] - crossings[0]) / (len(crossings) - 1)
    record(
        f"frequency of a cantilever with a tip mass of {share:g} of its mass",
        "root of the beam's equation",
        abs(2 * np.pi / period / expected - 1),
        at_most=3e-3,
    )


@pytest.mark.slow
def test_supports_that_move_are_looked_at_where_they_begin():
    """`state` says where everything is; what a path holds it holds from the start."""
    above, of_above = rod(4, start=(0, 0, 0))
    below, of_below = rod(4, start=(-0.5, 0, 0))
    state = {"above": of_above, "below": of_below}
    zero = jnp.zeros(3)

    def system(displacement):
        moved = jaxrod.driven(of_above, "tip", displacement=displacement)
        return jaxrod.make_system(
            {
                "above": jaxrod.make_scene(above, moved),
                "below": jaxrod.make_scene(below),
            },
            jaxrod.systems.weld(("below", "tip"), ("above", "base"), state),
            state=state,
        )

    still, moving = system(zero), system(jaxrod.schedules.ramp(zero, zero + 0.1, 1.0))
    assert jaxrod.stable_dt(moving).dt == jaxrod.stable_dt(still).dt
    dt = 0.9 * float(jaxrod.stable_dt(moving).dt)
    end = jaxrod.advance(moving, state, dt, 100)
    moved = end["above"].positions[:, -1] - of_above.positions[:, -1]
    np.testing.assert_allclose(moved, 0.1 * 100 * dt, rtol=1e-9)


def test_a_hinge_turns_about_its_axis_alone(record):
    """A motor's couple c on a body of inertia J about it: c t^2 / 2 J."""
    base, of_base = jaxrod.systems.rigid_body(
        mass=1e9, inertia=(1e9, 1e9, 1e9), dtype=jnp.float64
    )
    arm, of_arm = jaxrod.systems.rigid_body(
        mass=1.0, inertia=(0.1, 0.2, 0.3 - 1e-9), dtype=jnp.float64
    )
    rest = {"base": of_base, "arm": of_arm}
    system = jaxrod.make_system(
        {"base": base, "arm": arm},
        jaxrod.systems.hinge_joint(
            ("base",),
            ("arm",),
            rest,
            axis=(0, 0, 1),
            stiffness=1e3,
            axis_stiffness=50.0,
            motor=0.2,
        ),
    )
    dt = 0.2 * jaxrod.stable_dt(system).dt
    steps = int(2.0 / dt)
    after = jaxrod.advance(system, rest, dt, steps)["arm"]
    time = steps * float(dt)
    w, x, y, z = np.asarray(after.orientations[:, 0])
    angle = 2 * np.arctan2(z, w)
    expected = 0.2 * time**2 / (2 * 0.3)
    record(
        "angle of a hinge with a motor",
        "c t^2 / 2 J",
        abs(angle / expected - 1),
        at_most=1e-6,
    )
    assert max(abs(x), abs(y)) < 1e-12


def test_a_joints_dashpot_acts_on_one_and_reacts_on_the_other():
    """Minus its number times how fast the one turns against the other, in space."""
    drag = 0.3
    one, of_one = rod(2)
    two, of_two = rod(3, 0.3, (0.5, 0, 0), (0, 0.6, 0.8))
    rest = {"one": of_one, "two": of_two}
    joint = jaxrod.systems.fixed_joint(
        ("one", "tip"),
        ("two", "base"),
        rest,
        stiffness=10.0,
        turning_stiffness=2.0,
        turning_damping=drag,
    )
    system = jaxrod.make_system(
        {"one": jaxrod.make_scene(one), "two": jaxrod.make_scene(two)}, joint
    )
    draws = np.random.default_rng(4)
    spins = {"one": draws.normal(size=(3, 2)), "two": draws.normal(size=(3, 3))}
    moving = {
        name: jaxrod.with_angular_velocities(
            system.members[name].rod, rest[name], jnp.asarray(spin)
        )
        for name, spin in spins.items()
    }
    seen, (_, turning) = seen_at_rest(system, moving)
    loads = turning.loads(seen)

    def world(name, own, element):
        return np.asarray(rest[name].directors)[:, :, element].T @ own[:, element]

    apart = world("two", spins["two"], 0) - world("one", spins["one"], -1)
    for name, element, sign in (("one", -1, 1), ("two", 0, -1)):
        found = world(name, np.stack(loads[name].couples), element)
        np.testing.assert_allclose(found, sign * drag * apart, atol=1e-12)


def test_a_body_has_the_inertia_of_what_it_carries_about_the_common_centre():
    """Point masses and the body itself, each by the parallel axis theorem."""
    draws = np.random.default_rng(5)
    mass, own = 2.0, np.array([0.1, 0.2, 0.25])
    masses, places = draws.uniform(0.5, 1.5, 3), draws.normal(size=(3, 3))
    body, _ = jaxrod.systems.rigid_body(mass=mass, inertia=own, dtype=jnp.float64)
    outer = np.einsum("n,in,jn->ij", masses, places, places)
    carried = Carried(
        jnp.asarray(masses.sum())[None],
        tuple(jnp.asarray(places @ masses)[:, None]),
        tuple(tuple(row) for row in jnp.asarray(outer)[:, :, None]),
    )
    stepper = RigidStepper.create(body, carried, jnp.asarray(1e-3))
    total = mass + masses.sum()
    centre = places @ masses / total

    def about_centre(m, place):
        arm = place - centre
        return m * (arm @ arm * np.eye(3) - np.outer(arm, arm))

    expected = np.diag(own) + about_centre(mass, np.zeros(3))
    expected += sum(about_centre(m, p) for m, p in zip(masses, places.T, strict=True))
    np.testing.assert_allclose(stepper.mass, [total])
    np.testing.assert_allclose(np.stack(stepper.centre)[:, 0], centre, rtol=1e-12)
    found, inverse = (
        np.array(matrix)[..., 0]
        for matrix in (stepper.inertia, stepper.inverse_inertia)
    )
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    np.testing.assert_allclose(inverse @ expected, np.eye(3), atol=1e-12)

    # It turns as fast as that inertia says: by differences of a short drift each way.
    momentum = draws.normal(size=3)
    zeros = (jnp.zeros(1),) * 3
    motion = Motion(
        position=zeros,
        orientation=(jnp.ones(1), *zeros),
        velocity=zeros,
        spin=tuple(jnp.asarray(momentum)[:, None]),
    )
    short = 1e-5
    ends = [stepper.drift(motion, jnp.asarray(dt)) for dt in (-short, short)]
    turns = [np.array(rotation_log(end.orientation))[:, 0] for end in ends]
    rate = (turns[1] - turns[0]) / (2 * short)
    np.testing.assert_allclose(rate, np.linalg.solve(expected, momentum), rtol=1e-8)


def on_a_box(*effects):
    """A rod attached to a box off its centre, both moving; and effects on the box."""
    one, of_one = rod(2)
    box, of_box = jaxrod.systems.rigid_body(
        jaxrod.shapes.box((-0.05, 0.01, 0.0), (0.05, 0.03, 0.02)),
        density=500.0,
        velocity=(0.3, -0.2, 0.5),
        angular_velocity=(2.0, -1.0, 3.0),
        effects=effects,
        dtype=jnp.float64,
    )
    state = {"rod": of_one, "box": of_box}
    scenes = {"rod": jaxrod.make_scene(one), "box": box}
    joint = jaxrod.systems.attach(("rod", "base"), ("box",), state)
    return scenes, joint, state


@pytest.mark.slow
def test_what_is_damped_at_one_rate_loses_momentum_at_that_rate():
    """Also where the nodes of a rod are part of a body: each is damped once."""
    rate, dt = 3.0, 0.1
    damping = jaxrod.exponential_damping(rate)
    scenes, joint, state = on_a_box(damping)
    scenes["rod"] = scenes["rod"].with_effect(damping)
    system = jaxrod.make_system(scenes, joint)

    @jax.jit
    def momenta(state):
        stepper = system.stepper(state, jnp.float64(dt))
        before = stepper.enter(state)
        return [
            sum(scenes[name].momentum(own) for name, own in at.items())
            for at in map(stepper.leave, (before, stepper.kick(before)))
        ]

    before, after = momenta(state)
    np.testing.assert_allclose(after, np.exp(-rate * dt) * before, rtol=1e-12)


@jaxrod.extend.pytree
class Drag(jaxrod.extend.Effect):
    """The loads of exponential damping on bodies: minus a rate times momentum."""

    rate: jax.Array

    def loads(self, bodies, motion):
        forces = tuple(-self.rate * bodies.masses * v for v in motion.velocity)
        frame = directors(motion.orientation)
        couples = to_material(frame, tuple(-self.rate * p for p in motion.spin))
        return jaxrod.extend.Loads(forces, couples)


def test_a_body_is_damped_by_its_own_momenta_whatever_it_carries():
    """In a short step a decay of its rates is a drag in proportion to its momenta."""
    rate, dt, changes = 5.0, 1e-7, []
    for effect in (jaxrod.exponential_damping(rate), Drag(jnp.float64(rate))):
        scenes, joint, state = on_a_box(effect)
        system = jaxrod.make_system(scenes, joint)
        box = system.stepper(state, jnp.float64(dt)).members["box"]
        at_rest, before = box.enter(state["box"]).at_rest, box.enter(state["box"])
        assert np.max(np.abs(box.kick(at_rest, Loads()).velocity)) == 0
        after = box.kick(before, Loads())
        changes += [
            np.stack(new) - np.stack(old)
            for new, old in (
                (after.velocity, before.velocity),
                (after.spin, before.spin),
            )
        ]
    np.testing.assert_allclose(changes[0], changes[2], rtol=1e-5)
    np.testing.assert_allclose(changes[1], changes[3], rtol=1e-5)
    mass, carried = scenes["box"].masses[0], scenes["rod"].rod.node_masses[0]
    speed = np.asarray(state["box"].velocities)
    expected = -rate * dt * mass / (mass + carried) * speed
    np.testing.assert_allclose(changes[0], expected, rtol=1e-5)


@pytest.mark.slow
def test_tie_to_a_held_node_follows_the_support():
    one, of_one = rod()
    two, of_two = rod(6, 0.5, (0.5, 0, 0), (0, 1, 0))
    rest = {"one": of_one, "two": of_two}
    held = jaxrod.make_scene(one, jaxrod.clamp(of_one, "tip"))
    system = jaxrod.make_system(
        {"one": held, "two": jaxrod.make_scene(two, jaxrod.gravity())},
        jaxrod.systems.tie(("one", "tip"), ("two", "base"), rest),
    )
    after = jaxrod.advance(system, rest, jaxrod.stable_dt(system).dt, 500)
    np.testing.assert_array_equal(after["two"].positions[:, 0], of_two.positions[:, 0])
    assert after["two"].tip[2] < -0.01


@pytest.mark.slow
def test_gradients_through_connections_match_differences():
    system, state = free_system()
    dt = 0.5 * float(jaxrod.stable_dt(system).dt)

    def reach(scales):
        members = dict(system.members)
        one = members["one"].rod
        stiffer = replace(
            one, bend_twist_stiffness=scales[0] * one.bend_twist_stiffness
        )
        members["one"] = replace(members["one"], rod=stiffer)
        members["head"] = replace(
            members["head"], masses=scales[1] * members["head"].masses
        )
        start = dict(state)
        start["ball"] = replace(
            start["ball"], velocities=scales[2] * start["ball"].velocities
        )
        after = jaxrod.advance(replace(system, members=members), start, dt, 60)
        return jnp.sum(after["ball"].positions[1]) + after["two"].tip[2]

    here = jnp.ones(3)
    gradient = jax.jit(jax.grad(reach))(here)
    step = 1e-5
    function = jax.jit(reach)
    differences = [
        (function(here.at[k].add(step)) - function(here.at[k].add(-step))) / (2 * step)
        for k in range(3)
    ]
    scale = np.max(np.abs(differences))
    np.testing.assert_allclose(gradient, differences, rtol=0, atol=1e-6 * scale)
    assert np.all(np.abs(gradient) > 1e-6 * scale)


@pytest.mark.slow
def test_a_batch_of_systems_is_a_loop_over_them():
    one, of_one = rod()
    two, of_two = rod(4, 0.3, (0.5, 0, 0), (0, 0.6, 0.8))
    rest = {"one": of_one, "two": of_two}

    def build(acceleration):
        falls = jaxrod.gravity((0.0, 0.0, acceleration))
        return jaxrod.make_system(
            {
                "one": jaxrod.make_scene(one, jaxrod.clamp(of_one), falls),
                "two": jaxrod.make_scene(two, falls),
            },
            jaxrod.systems.weld(("one", "tip"), ("two", "base"), rest),
        )

    pulls = jnp.array([-9.81, -3.0, 4.0])
    systems = jax.vmap(build)(pulls)
    dt = 0.8 * float(jaxrod.stable_dt(build(-9.81)).dt)
    batch = jax.vmap(jaxrod.advance, in_axes=(0, None, None, None))(
        systems, rest, dt, 100
    )
    for k, pull in enumerate(pulls):
        alone = jaxrod.advance(build(pull), rest, dt, 100)
        np.testing.assert_allclose(
            batch["two"].positions[k], alone["two"].positions, rtol=0, atol=1e-13
        )


@pytest.mark.slow
def test_members_that_depend_on_time():
    """Two halves under a swinging load are one rod, wherever time begins."""
    whole, of_whole = rod(12, 1.0)
    left, of_left = rod(6, 0.5)
    right, of_right = rod(6, 0.5, (0.5, 0, 0))
    state = {"left": of_left, "right": of_right}
    load = jaxrod.uniform_load(jaxrod.schedules.sine((0.0, 1.0, 0.0), 0.2))
    halves = jaxrod.make_system(
        {
            "left": jaxrod.make_scene(left, jaxrod.clamp(of_left), load),
            "right": jaxrod.make_scene(right, load),
        },
        jaxrod.systems.weld(("left", "tip"), ("right", "base"), state),
    )
    scene = jaxrod.make_scene(whole, jaxrod.clamp(of_whole), load)
    dt = jaxrod.stable_dt(scene).dt
    together = jaxrod.advance(halves, state, dt, 400, first=7)
    alone = jaxrod.advance(scene, of_whole, dt, 400, first=7)
    assert abs(alone.tip[1]) > 1e-3
    np.testing.assert_allclose(together["right"].tip, alone.tip, rtol=0, atol=1e-12)


def ladder():
    """Two rails and twelve rungs between them, welded at 24 places."""
    rails, of_rails = jax.vmap(lambda y: rod(24, 2.4, jnp.stack([0 * y, y, 0 * y])))(
        jnp.array([0.0, 0.5])
    )
    rungs, of_rungs = jax.vmap(
        lambda x: rod(4, 0.5, jnp.stack([x, 0 * x, 0 * x]), (0, 1, 0))
    )(0.2 * jnp.arange(12))
    state = {"rails": of_rails, "rungs": of_rungs}
    ends = ("base", "tip")
    system = jaxrod.make_system(
        {
            name: jax.vmap(lambda r: jaxrod.make_scene(r, jaxrod.gravity()))(rods)
            for name, rods in (("rails", rails), ("rungs", rungs))
        },
        jaxrod.systems.weld(
            [("rails", r, 2 * k) for k in range(12) for r in (0, 1)],
            [("rungs", k, ends[r]) for k in range(12) for r in (0, 1)],
            state,
        ),
        state=state,
    )
    return system, state


@pytest.mark.slow
def test_gradients_through_many_ties():
    """More places than are compared one by one: programs of another kind."""
    system, state = ladder()
    dt = float(jaxrod.stable_dt(system).dt)

    def reach(push):
        rails = replace(state["rails"], velocities=state["rails"].velocities + push)
        after = jaxrod.advance(system, {**state, "rails": rails}, dt, 20)
        return (
            after["rungs"].positions[3, 1, 2] + after["rails"].positions[1, 0, 5] ** 2
        )

    slope = float(jax.jit(jax.grad(reach))(0.1))
    function, h = jax.jit(reach), 1e-5
    difference = float((function(0.1 + h) - function(0.1 - h)) / (2 * h))
    assert slope == pytest.approx(difference, rel=1e-6)


@pytest.mark.slow
def test_tied_nodes_stay_together_for_long_in_single_precision():
    """Equal velocities leave the rounding of positions, which adds up."""
    made = [
        jaxrod.straight_rod(
            4,
            length=0.3,
            radius=0.02,
            density=1e3,
            youngs_modulus=1e6,
            start=start,
            direction=direction,
            dtype=jnp.float32,
        )
        for start, direction in (
            ((7.0, 3.0, -2.0), (1, 0, 0)),
            ((7.3, 3.0, -2.0), (0, 0.6, 0.8)),
        )
    ]
    state = {"one": made[0][1], "two": jaxrod.compensated(made[1][1])}
    falls = jaxrod.gravity((0.3, 0.1, -1.0))
    system = jaxrod.make_system(
        {
            "one": jaxrod.make_scene(made[0][0], jaxrod.clamp(made[0][1]), falls),
            "two": jaxrod.make_scene(made[1][0], falls),
        },
        jaxrod.systems.tie(("one", "tip"), ("two", "base"), state),
    )
    dt = jaxrod.stable_dt(system).dt
    after = jaxrod.advance(system, state, dt, 20_000)
    assert np.all(np.isfinite(after["two"].positions))
    np.testing.assert_array_equal(
        after["one"].positions[:, -1], after["two"].positions[:, 0]
    )


@jaxrod.extend.pytree
class Push(jaxrod.extend.Coupling):
    """Pushes all nodes along z that no support held when the run began."""

    free: jax.Array | None = None

    def prepared(self, parts):
        held = parts["one"].held
        free = jnp.ones_like(parts["one"].node_masses) if held is None else 1 - held[2]
        return replace(self, free=free)

    def loads(self, seen):
        nodes = jnp.zeros_like(self.free)
        couples = jnp.zeros(nodes.shape[0] - 1)
        force = self.free / jnp.sum(self.free)
        return {"one": jaxrod.extend.Loads((nodes, nodes, force), (couples,) * 3)}


@pytest.mark.slow
def test_couplings_know_what_is_held_in_systems_that_depend_on_time():
    """A schedule of a load that vanishes changes nothing."""
    one, state = rod(2, 0.3)
    ends = []
    for more in (
        (),
        (jaxrod.gravity(jaxrod.schedules.ramp((0, 0, 0), (0, 0, 0), 1.0)),),
    ):
        scene = jaxrod.make_scene(one, jaxrod.pin_support(state, 0), *more)
        system = jaxrod.make_system({"one": scene}, Push())
        ends.append(jaxrod.advance(system, {"one": state}, 1e-4, 5)["one"].positions)
    np.testing.assert_allclose(ends[0], ends[1], rtol=0, atol=1e-15)
    assert float(jnp.max(jnp.abs(ends[0][2]))) > 0


def test_what_an_attachment_is_apart_is_counted_in_radii():
    apart = 0.003
    one, rest = rod()
    ball, place = jaxrod.systems.rigid_body(
        jaxrod.shapes.sphere(rest.positions[:, -1], 0.05),
        density=500.0,
        dtype=jnp.float64,
    )
    states = {"one": rest, "ball": place}
    attached = jaxrod.systems.attach(("one", "tip"), ("ball",), states)
    system = jaxrod.make_system({"one": jaxrod.make_scene(one), "ball": ball}, attached)
    moved = {
        **states,
        "ball": replace(place, positions=place.positions + apart * np.eye(3)[:, 1:2]),
    }
    for given, expected in ((states, 0.0), (moved, apart / 0.02)):
        seen, couplings = seen_at_rest(system, given)
        (fitted,) = (c for c in couplings if isinstance(c, Attachment))
        assert float(fitted.violation(seen)) == pytest.approx(expected, rel=1e-9)


def test_several_nodes_are_attached_to_one_body():
    one, rest = rod()
    ball, place = jaxrod.systems.rigid_body(
        jaxrod.shapes.sphere(rest.positions[:, 1], 0.05),
        density=500.0,
        dtype=jnp.float64,
    )
    states = {"one": rest, "ball": place}
    nodes = [("one", 0), ("one", 2)]
    both = jaxrod.systems.attach(nodes, ("ball",), states)
    system = jaxrod.make_system({"one": jaxrod.make_scene(one), "ball": ball}, both)
    moved = {**states, "ball": replace(place, velocities=place.velocities + 0.1)}
    after = jaxrod.advance(system, moved, 1e-5, 3)
    was, found = (np.asarray(s["one"].positions)[:, [0, 2]] for s in (states, after))
    moved = np.asarray(after["ball"].positions - place.positions)
    assert np.all(moved > 1e-8)
    np.testing.assert_allclose(found - was, np.tile(moved, 2), rtol=0.05)

"""Contact of rigid bodies with one another, with the ground and with walls."""

import itertools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.systems.contact.sphere_cloud import spheres_of
from jaxrod.systems.stepping.assembly import seen_at_rest
from systems.rigid_pairs import SHAPES, G, alone, body, moved, pressed


@pytest.mark.parametrize("points", [2, 5])
def test_a_box_may_lie_on_all_points_of_a_face(points):
    """So many springs the bound on the step counts."""
    box = jaxrod.shapes.box((0.1, 0.2, -0.3), (0.2, 0.3, 0.5))
    cloud = spheres_of(box, 1, points)
    top = np.max(np.asarray(cloud.offsets[0]))
    assert cloud.at_once == np.sum(np.isclose(cloud.offsets[0], top))
    assert cloud.count == 12 * (points - 2) + 8


@pytest.mark.parametrize("max_contacts", [None, 1])
def test_the_bound_on_balls_is_that_of_springs_between_all_or_to_the_worst(
    max_contacts,
):
    """k (1/m_a + 1/m_b) of each, times the mass of the one."""
    stiffness, radii = 1e4, {"a": 0.1, "b": 0.05, "c": 0.2}
    parts = {
        name: body(jaxrod.shapes.sphere((0, 0, 0), r))[0].parts()
        for name, r in radii.items()
    }
    contact = jaxrod.systems.rigid_contact(
        *radii, stiffness=stiffness, max_contacts=max_contacts
    )
    bounds = contact.fitted(parts, ()).prepared(parts).stability_bounds(parts)
    mass = {name: 500 * 4 / 3 * np.pi * r**3 for name, r in radii.items()}
    for one in radii:
        each = [1 / mass[one] + 1 / mass[other] for other in radii if other != one]
        worst = sum(each) if max_contacts is None else max(each)
        expected = stiffness * worst * mass[one]
        np.testing.assert_allclose(bounds[one].nodes, [expected], rtol=1e-6)
        assert bounds[one].elements is None


@pytest.mark.slow
def test_a_body_that_touches_several_feels_what_each_would_do_to_it():
    """Three balls that touch each other and the ground: sums of pairs of them."""
    centres = {"a": (0.0, 0.0, 0.09), "b": (0.18, 0.0, 0.095), "c": (0.07, 0.16, 0.09)}
    made = {name: body(jaxrod.shapes.sphere(c, 0.1)) for name, c in centres.items()}
    ground = jaxrod.shapes.plane((0, 0, 0), (0, 0, 1))

    def forces(names, fixed):
        contact = jaxrod.systems.rigid_contact(*names, stiffness=1e4, fixed=fixed)
        system = jaxrod.make_system({n: made[n][0] for n in names}, contact)
        seen, (own,) = seen_at_rest(system, {n: made[n][1] for n in names})
        loads = own.loads(seen)
        return {n: np.stack(loads[n].forces)[:, 0] for n in names}

    together = forces("abc", (ground,))
    apart = {name: np.zeros(3) for name in centres}
    pairs = [*itertools.combinations("abc", 2), *"abc"]
    for names in pairs:
        fixed = (ground,) if len(names) == 1 else ()
        for name, force in forces(names, fixed).items():
            assert np.linalg.norm(force) > 1
            apart[name] += force
    for name in centres:
        np.testing.assert_allclose(together[name], apart[name], rtol=1e-10)


@pytest.mark.slow
def test_a_ball_at_rest_sinks_in_by_its_weight(record):
    system, state = alone(jaxrod.shapes.sphere((0, 0, 0.1), 0.1), stiffness=2e4)
    dt = jaxrod.stable_dt(system).dt
    after = jaxrod.advance(system, state, dt, 2000)["body"]
    mass = float(system.members["body"].masses[0])
    depth = 0.1 - float(after.positions[2, 0])
    record(
        "ball at rest on the ground: penetration",
        "m g / k",
        abs(depth / (mass * G / 2e4) - 1),
        at_most=1e-9,
    )
    assert not jaxrod.health(system, {"body": after}, dt).flagged


@pytest.mark.slow
@pytest.mark.parametrize(
    ("slope", "friction", "rolls"),
    [(0.3, 0.5, True), (0.55, 0.2, True), (0.65, 0.2, False)],
)
def test_a_ball_on_a_slope_rolls_or_slips(slope, friction, rolls, record):
    """It slips where the slope's tangent is above 7/2 of the friction: 0.611 rad."""
    system, state = alone(
        jaxrod.shapes.sphere((0, 0, 0.1), 0.1),
        slope=slope,
        stiffness=1e6,
        friction=friction,
        friction_drag=4e3,
    )
    assert rolls == (np.tan(slope) < 3.5 * friction)
    state = pressed(system, state, slope)
    dt = jaxrod.stable_dt(system).dt
    steps = int(0.3 / dt)
    half = jaxrod.advance(system, state, dt, steps)
    after = jaxrod.advance(system, half, dt, steps)["body"]
    gained = (after.velocities - half["body"].velocities)[0, 0] / (steps * float(dt))
    expected = 5 / 7 * G * np.sin(slope)
    if not rolls:
        expected = G * (np.sin(slope) - friction * np.cos(slope))
    record(
        f"ball on a slope of {slope:g} rad with friction {friction:g}: acceleration",
        "5/7 g sin a" if rolls else "g (sin a - mu cos a)",
        abs(float(gained) / expected - 1),
        at_most=0.01,
    )
    slip = float(after.velocities[0, 0] - 0.1 * after.angular_velocities[1, 0])
    assert (slip < 0.02) == rolls


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "expected", "options"),
    [
        ("box", "mu g", {}),
        ("cylinder", "mu g", {}),
        ("cylinder", "2/3 g sin a", {"orientation": (1.0, 1.0, 0.0, 0.0)}),
        ("capsule", "rolls", {"orientation": (1.0, 1.0, 0.0, 0.0)}),
    ],
)
def test_boxes_slide_and_cylinders_roll(shape, expected, options, record):
    height = {"box": 0.12, "cylinder": 0.12, "capsule": 0.07}[shape]
    lying = bool(options)
    slope = 0.2 if lying else 0.0
    if lying and shape == "cylinder":
        height = 0.08
    system, state = alone(
        SHAPES[shape](),
        slope=slope,
        stiffness=1e6,
        friction=0.3,
        friction_drag=1e4,
        body_options={"position": (0, 0, height), **options},
    )
    bodies = system.members["body"]
    contacts = {"box": 4, "cylinder": 4, "capsule": 4}[shape]
    if lying and shape == "cylinder":
        contacts = 2 + 2
    state = pressed(system, state, slope, contacts)
    if not lying:
        state = moved(state, velocities=jnp.array([[1.0], [0.0], [0.0]]))
    dt = jaxrod.stable_dt(system).dt
    steps = int(0.1 / dt)
    half = jaxrod.advance(system, state, dt, steps)
    after = jaxrod.advance(system, half, dt, steps)["body"]
    gained = (after.velocities - half["body"].velocities)[0, 0] / (steps * float(dt))
    wanted = -0.3 * G
    if lying:
        # About the axis, which lies across the slope.
        inertia = float(bodies.principal_inertias[2, 0])
        ratio = inertia / float(bodies.masses[0]) / height**2
        wanted = G * np.sin(slope) / (1 + ratio)
        if shape == "cylinder":
            assert wanted == pytest.approx(2 / 3 * G * np.sin(slope))
    record(
        f"{shape} that {'rolls' if lying else 'slides'}: acceleration",
        expected if expected != "rolls" else "g sin a / (1 + J / m r^2)",
        abs(float(gained) / wanted - 1),
        at_most=0.01,
    )


@pytest.mark.slow
def test_balls_settle_in_a_corner():
    """Five balls fall into a pit, come to rest, and the pit carries them."""
    rng = np.random.default_rng(0)
    balls, of_balls = jaxrod.systems.stacked_bodies(
        *(
            body(
                jaxrod.shapes.sphere(
                    (*rng.uniform(0.12, 0.24, 2), 0.12 + 0.21 * k), 0.1
                ),
                effects=(jaxrod.gravity((0, 0, -G)),),
            )
            for k in range(5)
        )
    )
    walls = [
        jaxrod.shapes.plane((0, 0, 0), normal)
        for normal in ((0, 0, 1), (1, 0, 0), (0, 1, 0))
    ] + [
        jaxrod.shapes.plane((0.36, 0.36, 0), normal)
        for normal in ((-1, 0, 0), (0, -1, 0))
    ]
    contact = jaxrod.systems.rigid_contact(
        "balls",
        fixed=walls,
        stiffness=2e4,
        damping=60.0,
        friction=0.4,
        max_contacts=12,
    )
    system = jaxrod.make_system({"balls": balls}, contact)
    state = {"balls": of_balls}
    dt = jaxrod.stable_dt(system).dt
    after = jaxrod.advance(system, state, dt, int(4 / dt))
    assert system.kinetic_energy(after) < 1e-6
    assert not jaxrod.health(system, after, dt).flagged
    assert np.all(after["balls"].positions[:2] > 0.09)
    assert np.all(after["balls"].positions[:2] < 0.27)
    places = np.asarray(after["balls"].positions)
    for i, j in itertools.combinations(range(5), 2):
        assert np.linalg.norm(places[:, i] - places[:, j]) > 0.195
    seen, (prepared,) = seen_at_rest(system, after)
    forces = np.stack(prepared.loads(seen)["balls"].forces)
    weights = np.zeros((3, 5))
    weights[2] = G * np.asarray(balls.masses)
    np.testing.assert_allclose(forces, weights, atol=1e-3 * weights[2, 0])


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["sphere", "box"])
def test_the_stability_bound_is_safe_and_not_far_off(shape, record):
    """Bodies pressed so hard to the ground that they never leave it."""
    system, state = alone(
        SHAPES[shape](),
        damping=None,
        stiffness=2e4,
        body_options={"position": (0, 0, 0.1 if shape == "sphere" else 0.12)},
    )
    heavy = replace(
        system.members["body"], effects=(jaxrod.gravity((0.0, 0.0, -5 * G)),)
    )
    system = jaxrod.make_system({"body": heavy}, *system.couplings)
    contacts = 1 if shape == "sphere" else 4
    depth = 5 * G * float(heavy.masses[0]) / 2e4 / contacts
    down = state["body"].positions.at[2].add(-1.001 * depth)
    spin = jnp.array([[0.01], [0.02], [0.0]])
    state = moved(state, positions=down, angular_velocities=spin)
    bound = float(jaxrod.stable_dt(system, 1.0).dt)

    @jax.jit
    def is_stable(dt):
        quiet = jaxrod.advance(system, state, dt, 3000)
        moves = jnp.sum(quiet["body"].velocities ** 2)
        return moves + jnp.sum(0.01 * quiet["body"].angular_velocities ** 2) < 1e-3

    # A traced step is not warned about.
    ratios = 0.99 + 0.05 * np.arange(42)
    fine = [bool(is_stable(bound * ratio)) for ratio in ratios]
    assert fine[0]
    limit = ratios[fine.index(False) - 1]
    record(
        f"{shape} on the ground: largest stable step divided by the bound",
        "at least 1 (safe), and not much more",
        limit,
        between=(0.99, 3.0),
    )


@pytest.mark.slow
def test_bodies_of_any_shape_touch_with_given_points():
    def round_one(point, radius):
        return jnp.sqrt(jnp.sum(point * point) + 1e-12) - radius

    shape = jaxrod.shapes.signed_distance(round_one, 0.1)
    way = np.random.default_rng(0).normal(size=(3, 400))
    way[:, 0] = (0, 0, -1)
    points = 0.1 * way / np.linalg.norm(way, axis=0)
    rock, of_rock = jaxrod.systems.rigid_body(
        shape,
        mass=2.0,
        inertia=(0.008, 0.008, 0.008),
        position=(0, 0, 0.0995),
        dtype=jnp.float64,
    )
    on_ground = jaxrod.systems.rigid_contact(
        "rock", fixed=jaxrod.shapes.plane(), stiffness=2e4, points={"rock": points}
    )
    system = jaxrod.make_system({"rock": rock}, on_ground)
    seen, (contact,) = seen_at_rest(system, {"rock": of_rock})
    deep = np.sum(np.clip(0.0005 - (points[2] + 0.1), 0, None))
    assert float(contact.loads(seen)["rock"].forces[2][0]) == pytest.approx(
        2e4 * deep, rel=0.3
    )
    with pytest.raises(ValueError, match=r"cannot find where 'rock' and fixed\[0\]"):
        jaxrod.make_system(
            {"rock": rock},
            jaxrod.systems.rigid_contact(
                "rock", fixed=jaxrod.shapes.plane(), stiffness=2e4
            ),
        )


@pytest.mark.slow
def test_gradients_and_batches():
    """Of a ball that strikes a box on the ground, by where it comes from."""
    ball, of_ball = body(
        jaxrod.shapes.sphere((-0.25, 0.01, 0.15), 0.05), velocity=(2.0, 0.0, -0.1)
    )
    crate, of_crate = body(jaxrod.shapes.box((0, 0, 0.0995), (0.1, 0.1, 0.1)))
    system = jaxrod.make_system(
        {"ball": ball, "crate": crate},
        jaxrod.systems.rigid_contact(
            "ball",
            "crate",
            fixed=jaxrod.shapes.plane(),
            stiffness=2e4,
            damping=20.0,
            friction=0.4,
        ),
    )
    dt = 0.3 * float(jaxrod.stable_dt(system).dt)

    def after(push):
        start = replace(of_ball, velocities=of_ball.velocities.at[:, 0].add(push))
        state = jaxrod.advance(
            system, {"ball": start, "crate": of_crate}, dt, int(0.12 / dt)
        )
        crate = state["crate"]
        return crate.velocities[0, 0] + 0.1 * crate.angular_velocities[1, 0]

    function = jax.jit(after)
    none, h = jnp.zeros(3), 1e-6
    gradient = np.asarray(jax.jit(jax.grad(after))(none))
    steps = h * np.eye(3)
    differences = np.array([(function(s) - function(-s)) / (2 * h) for s in steps])
    size = np.abs(differences).max()
    assert size > 0.1
    np.testing.assert_allclose(gradient, differences, atol=1e-6 * size)
    batch = jax.jit(jax.vmap(after))(jnp.asarray(1e3 * steps))
    np.testing.assert_allclose(batch, [function(1e3 * s) for s in steps], atol=1e-12)


@pytest.mark.parametrize(
    ("names", "options", "words"),
    [
        (("ball", "none"), {}, "no member is called 'none'"),
        (("ball", "rod"), {}, "'rod' is a rod: use body_contact"),
        (("ball", "point"), {}, "'point' has no shape"),
        (("ball",), {}, "nothing to touch"),
        (("ball", "ball"), {}, "named once each"),
        (("ball", "pole"), {}, r"'pole', 8 m long.*balls_per_axis"),
        (("ball",), {"stiffness": -1.0}, "stiffness must be positive, got -1 N/m"),
        (("ball",), {"friction": 0.3}, "friction needs friction_drag > 0 kg/s"),
        (("ball",), {"points": {"box": [[0], [0], [0]]}}, "not among the members"),
        (("ball",), {"points": {"ball": [0, 0, 1]}}, r"'ball' must have shape \(3, k"),
        (("ball",), {"points_per_edge": 1}, "points_per_edge must be at least 2"),
    ],
)
def test_bad_input(names, options, words):
    thread, _ = jaxrod.straight_rod(
        4,
        length=0.3,
        radius=0.02,
        density=1e3,
        youngs_modulus=1e6,
        dtype=jnp.float64,
    )
    members = {
        "rod": jaxrod.make_scene(thread),
        "ball": body(SHAPES["sphere"]())[0],
        "point": jaxrod.systems.rigid_body(
            mass=1.0, inertia=(1, 1, 1), dtype=jnp.float64
        )[0],
        "pole": body(jaxrod.shapes.capsule((0, 0, 0), (0, 0, 8), 0.02))[0],
    }
    with pytest.raises(ValueError, match=words):
        jaxrod.make_system(
            members,
            jaxrod.systems.rigid_contact(*names, **{"stiffness": 1.0} | options),
        )

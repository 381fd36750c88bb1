"""Equilibria of systems, their derivatives and small motions about them."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod import shapes, systems
from systems.members import rod
from systems.test_settled import two_halves

G = 9.81


def pendulum(n=4, mass=0.3, size=0.02):
    """A rod clamped at one end with a ball at the other, under gravity; and its state.

    The ball is attached at its middle, so it pulls like a force.
    """
    arm, of_arm = rod(n, 0.4)
    tip = tuple(np.asarray(of_arm.tip))
    ball, of_ball = systems.rigid_body(
        shapes.sphere(tip, size),
        mass=mass,
        effects=(jaxrod.gravity((0.0, 0.0, -G)),),
    )
    state = {"arm": of_arm, "ball": of_ball}
    system = jaxrod.make_system(
        {"arm": jaxrod.make_scene(arm, jaxrod.clamp(of_arm)), "ball": ball},
        systems.attach(("arm", "tip"), ("ball",), state, turning=True),
        state=state,
    )
    return system, state


def by_ball_and_by_force():
    """Tip of a rod with a ball, and of one under its weight, by the ball's mass."""
    system, state = pendulum()
    arm = system.members["arm"]

    def of_ball(mass):
        ball = replace(system.members["ball"], masses=mass[None])
        heavy = replace(system, members={**system.members, "ball": ball})
        found = jaxrod.equilibrium(heavy, state)
        return found.state["arm"].tip, found

    def of_force(mass):
        weight = jnp.stack([jnp.zeros(()), jnp.zeros(()), -G * mass])
        scene = jaxrod.make_scene(arm.rod, *arm.effects, jaxrod.end_load(weight))
        found = jaxrod.equilibrium(scene, state["arm"])
        return found.state.tip, found

    return of_ball, of_force


@pytest.mark.slow
def test_a_ball_at_the_tip_pulls_like_its_weight(record):
    of_ball, of_force = by_ball_and_by_force()
    mass = jnp.asarray(0.3)
    (tip, found), (wanted, single) = of_ball(mass), of_force(mass)
    assert found.converged and found.stable and single.converged
    # A ball that turns about its middle: nothing resists that.
    assert found.loose and not single.loose
    assert abs(wanted[2]) > 0.1
    record(
        "a ball at the tip of a rod, equilibrium of the system [lengths]",
        "equilibrium of the rod under its weight",
        np.max(np.abs(tip - wanted)) / 0.4,
        at_most=1e-12,
    )
    assert found.force_residual < 1e-9 and found.couple_residual < 1e-10
    np.testing.assert_allclose(found.state["ball"].positions[:, 0], tip, atol=1e-15)
    for name, own in found.state.items():
        assert all(np.all(np.asarray(rate) == 0) for rate in own.rates), name


@pytest.mark.slow
def test_what_a_heavier_ball_changes_is_what_a_larger_force_changes(record):
    of_ball, of_force = by_ball_and_by_force()
    mass, one = jnp.asarray(0.3), jnp.ones(())
    _, slope, _ = jax.jvp(of_ball, (mass,), (one,), has_aux=True)
    _, steep, _ = jax.jvp(of_force, (mass,), (one,), has_aux=True)
    record(
        "derivative of an equilibrium by the mass of a ball at the tip, relative",
        "that of the rod's equilibrium by its load",
        np.max(np.abs(slope - steep)) / np.max(np.abs(steep)),
        at_most=1e-10,
    )


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_two_welded_halves_are_where_the_whole_is(dtype, record):
    """Two loads in one batch, and the gradient in reverse mode."""
    system, state, scene, of_whole = two_halves()
    system, state, scene, of_whole = jax.tree.map(
        lambda a: a.astype(dtype) if jnp.issubdtype(a.dtype, jnp.floating) else a,
        (system, state, scene, of_whole),
    )

    def loaded(force):
        own = system.members["right"]
        own = jaxrod.make_scene(own.rod, *own.effects, jaxrod.end_load(force))
        heavy = replace(system, members={**system.members, "right": own})
        found = jaxrod.equilibrium(heavy, state)
        return jnp.sum(found.state["right"].tip), found

    def alone(force):
        own = jaxrod.make_scene(scene.rod, *scene.effects, jaxrod.end_load(force))
        found = jaxrod.equilibrium(own, of_whole)
        return jnp.sum(found.state.tip), found

    forces = jnp.asarray([[0.0, 0.03, -0.12], [0.1, 0.0, 0.3]], dtype)
    slopes, found = jax.jit(jax.vmap(jax.grad(loaded, has_aux=True)))(forces)
    wanted, single = jax.vmap(jax.grad(alone, has_aux=True))(forces)
    assert np.all(found.converged) and np.all(found.stable)
    assert not np.any(found.loose)
    fine = dtype == jnp.float64
    record(
        f"two welded halves under end loads, {jnp.dtype(dtype).name} [lengths]",
        "equilibrium of one rod",
        np.max(np.abs(found.state["right"].tip - single.state.tip)) / 0.4,
        at_most=1e-11 if fine else 1e-3,
    )
    record(
        f"gradient by the load, reverse mode, {jnp.dtype(dtype).name}, relative",
        "that of one rod",
        np.max(np.abs(slopes - wanted)) / np.max(np.abs(wanted)),
        at_most=1e-9 if fine else 1e-2,
    )


@pytest.mark.slow
def test_derivatives_of_derivatives_are_those_of_differences():
    system, state = pendulum(2)

    def height(mass):
        ball = replace(system.members["ball"], masses=mass[None])
        heavy = replace(system, members={**system.members, "ball": ball})
        return jaxrod.equilibrium(heavy, state, tolerance=1e-10).state["arm"].tip[2]

    slope = jax.jit(jax.jacfwd(height))
    mass, h = jnp.asarray(0.3), 1e-4
    curve = jax.jit(jax.jacfwd(jax.jacfwd(height)))(mass)
    finite = (slope(mass + h) - slope(mass - h)) / (2 * h)
    np.testing.assert_allclose(curve, finite, rtol=1e-6)


@pytest.mark.slow
def test_a_column_that_buckles_goes_where_it_is_pushed():
    """Twice Euler's load: straight is an equilibrium, not a stable one."""
    system, state, scene, of_whole = two_halves()
    rigid = float(scene.rod.bend_twist_stiffness[0, 0])
    euler = (np.pi / 2) ** 2 * rigid / 0.4**2

    def loaded(aside):
        force = jnp.asarray([-2 * euler, 0.0, aside])
        own = system.members["right"]
        own = jaxrod.make_scene(own.rod, *own.effects, jaxrod.end_load(force))
        heavy = replace(system, members={**system.members, "right": own})
        return jaxrod.equilibrium(heavy, state)

    straight, bent = loaded(0.0), loaded(1e-3 * euler)
    assert straight.converged and not straight.stable
    assert bent.converged and bent.stable
    own = jaxrod.make_scene(
        scene.rod,
        *scene.effects,
        jaxrod.end_load(jnp.asarray([-2 * euler, 0.0, 1e-3 * euler])),
    )
    from_there = replace(
        of_whole,
        positions=jnp.concatenate(
            [bent.state["left"].positions, bent.state["right"].positions[:, 1:]], axis=1
        ),
        orientations=jnp.concatenate(
            [bent.state["left"].orientations, bent.state["right"].orientations], axis=1
        ),
    )
    single = jaxrod.equilibrium(own, from_there)
    assert single.converged and single.stable and single.iterations <= 2
    np.testing.assert_allclose(bent.state["right"].tip, single.state.tip, atol=1e-10)


@pytest.mark.slow
def test_an_octopus_that_nothing_holds_rests_where_it_does_not_drift():
    """Its arms sag alike about a head that floats; the whole stays where it was."""
    load = jaxrod.end_load((0.0, 0.0, -2e-4))
    system, state = jaxrod.assemblies.octopus(4, 4, effects=(load,))
    # Forces on tips down and on the head up add up to nothing.
    head = system.members["head"]
    lift = jaxrod.gravity((0.0, 0.0, float(4 * 2e-4 / head.masses[0])))
    head = replace(head, effects=(lift,))
    system = replace(system, members={**system.members, "head": head})
    found = jaxrod.equilibrium(system, state)
    assert found.converged and found.stable and found.loose
    tips = found.state["arms"].tip
    np.testing.assert_allclose(tips[:, 2], tips[0, 2], atol=1e-9)
    assert tips[0, 2] - found.state["head"].positions[2, 0] < -0.004
    settled = systems.settled(system, state, max_steps=400_000)
    assert settled.converged
    np.testing.assert_allclose(
        tips[:, 2] - found.state["head"].positions[2, 0],
        settled.state["arms"].tip[:, 2] - settled.state["head"].positions[2, 0],
        atol=1e-6,
    )


@pytest.mark.slow
def test_ropes_that_cross_rest_where_two_elasticae_do(record):
    """With lists of neighbours, from ropes that do not touch."""
    from systems.resting_ropes import LENGTH, nodes_of, resting_ropes, two_elasticae

    found, _ = two_elasticae()
    shapes_at = {}
    for n in (16, 32):
        rest = nodes_of(found, n)
        contact = systems.crossing_contact(
            *rest, stiffness=1e3, damping=0.1, lists=systems.neighbour_lists()
        )
        system, state = resting_ropes(n, rest, contact)
        there = jaxrod.equilibrium(system.at(0.0), state)
        assert there.converged and there.stable
        shapes_at[n] = max(
            np.max(np.abs(np.asarray(there.state[name].positions) - rest[name]))
            for name in rest
        )
    record(
        "ropes of 32 elements that cross, equilibrium: shape [lengths]",
        "two elasticae with a load in the middle",
        shapes_at[32] / LENGTH,
        at_most=1.5e-3,
    )
    assert shapes_at[32] < 0.5 * shapes_at[16]


@pytest.mark.slow
def test_frequencies_of_two_halves_are_those_of_the_whole(record):
    system, state, scene, of_whole = two_halves()
    found = jaxrod.natural_frequencies(system, state)
    wanted = jaxrod.natural_frequencies(scene, of_whole)
    assert found.shape == wanted.shape
    record(
        "all frequencies of two welded halves, relative",
        "those of one rod",
        np.max(np.abs(found / wanted - 1)),
        at_most=1e-10,
    )
    np.testing.assert_array_equal(
        jaxrod.natural_frequencies(system, state, 3), found[:3]
    )
    with pytest.raises(ValueError, match=f"at most {found.size}"):
        jaxrod.natural_frequencies(system, state, found.size + 1)


@pytest.mark.slow
def test_frequencies_of_a_ball_on_a_spring_are_its_own():
    """The ball carries the mass of the node that is attached to it."""
    system, state = pendulum(2, mass=5.0)
    ball, arm = system.members["ball"], system.members["arm"]
    still = replace(ball, effects=())
    system = replace(system, members={**system.members, "ball": still})
    slowest = jaxrod.natural_frequencies(system, state)
    free = np.sum(slowest < 1e-3)
    assert free == 3
    bending = float(arm.rod.bend_twist_stiffness[0, 0])
    stiffness = 3 * bending / 0.4**3
    expected = np.sqrt(stiffness / 5.0)
    # Two elements, and a mass far above that of the rod.
    np.testing.assert_allclose(slowest[3:5], expected, rtol=0.1)
    np.testing.assert_allclose(slowest[3], slowest[4], rtol=1e-9)


def test_bad_input():
    system, state = pendulum(2)
    for words, options in {
        "tolerance must be positive, got 0": {"tolerance": 0.0},
        "max_iterations must be at least 1, got 0": {"max_iterations": 0},
    }.items():
        with pytest.raises(ValueError, match=words):
            jaxrod.equilibrium(system, state, **options)
    with pytest.raises(ValueError, match="state must have the members"):
        jaxrod.equilibrium(system, {"arm": state["arm"]})
    arm = system.members["arm"]
    published = replace(arm, method=jaxrod.pyelastica())
    other = jaxrod.make_system({"arm": published})
    of_arm = {"arm": state["arm"]}
    for function in (jaxrod.equilibrium, jaxrod.natural_frequencies):
        with pytest.raises(ValueError, match="'arm': statics need the consistent law"):
            function(other, of_arm)
    swing = jaxrod.schedules.sine((0.0, 0.0, 1.0), 1.0)
    moving = jaxrod.make_scene(arm.rod, *arm.effects, jaxrod.end_load(swing))
    with pytest.raises(ValueError, match=r"a schedule: give system\.at"):
        jaxrod.equilibrium(jaxrod.make_system({"arm": moving}), of_arm)
    with pytest.raises(ValueError, match=r"traced by jax\.jit"):
        jax.jit(jaxrod.natural_frequencies, static_argnums=2)(system, state, 1)


@pytest.mark.slow
def test_nothing_balances_the_weight_of_a_ball_that_nothing_holds():
    ball, of_ball = systems.rigid_body(
        shapes.sphere((0, 0, 0), 0.1), density=1000.0, effects=(jaxrod.gravity(),)
    )
    found = jaxrod.equilibrium(
        jaxrod.make_system({"ball": ball}), {"ball": of_ball}, max_iterations=5
    )
    assert not found.converged and found.loose


@pytest.mark.slow
def test_the_whole_of_a_free_system_stays_where_it_was():
    """Rods that are curved at rest, on a heavy ball: nothing pushes the whole."""
    arm, of_arm = rod(4, 0.3)
    ball, of_ball = systems.rigid_body(shapes.sphere((-0.05, 0, 0), 0.05), mass=50.0)
    state = {"arm": of_arm, "ball": of_ball}
    joined = systems.attach(("arm", "base"), ("ball",), state)

    def at_rest(curvature):
        curved = jnp.zeros((3, 3)).at[1].set(curvature)
        bent = replace(arm, rest_curvatures=curved)
        system = jaxrod.make_system(
            {"arm": jaxrod.make_scene(bent), "ball": ball}, joined
        )
        return jaxrod.equilibrium(system, state, tolerance=1e-10)

    def middle(found):
        masses = arm.node_masses
        own = jnp.sum(masses[None, :] * found["arm"].positions, axis=1)
        return (own + 50.0 * found["ball"].positions[:, 0]) / (50.0 + jnp.sum(masses))

    found = at_rest(4.0)
    assert found.converged and found.stable and found.loose
    assert np.max(np.abs(found.state["arm"].positions - of_arm.positions)) > 0.1
    np.testing.assert_allclose(middle(found.state), middle(state), atol=1e-12)
    slope = jax.jacfwd(lambda c: middle(at_rest(c).state))(4.0)
    np.testing.assert_allclose(slope, 0, atol=1e-12)


@pytest.mark.slow
def test_what_falls_is_not_at_rest_however_light_it_is():
    """Beside a rod so stiff that the weight is nothing to it."""
    arm, of_arm = rod(2, 1.0, youngs_modulus=2e11)
    dust, of_dust = systems.rigid_body(
        shapes.sphere((0, 0, 1), 1e-3), mass=1e-6, effects=(jaxrod.gravity(),)
    )
    system = jaxrod.make_system(
        {"arm": jaxrod.make_scene(arm, jaxrod.clamp(of_arm)), "dust": dust}
    )
    state = {"arm": of_arm, "dust": of_dust}
    found = jaxrod.equilibrium(system, state, max_iterations=5)
    assert found.loose and not found.converged and not found.stable


@pytest.mark.slow
def test_a_light_body_that_carries_a_heavy_node_turns_like_both():
    arm, of_arm = rod(4, 0.4)
    beside = (0.43, 0.0, 0.0)
    load = jaxrod.end_load((0.0, 0.0, -0.8))
    single = jaxrod.equilibrium(
        jaxrod.make_scene(arm, jaxrod.clamp(of_arm), load), of_arm
    )
    light, of_light = systems.rigid_body(shapes.sphere(beside, 3e-3), mass=1e-4)
    state = {"arm": of_arm, "body": of_light}
    system = jaxrod.make_system(
        {"arm": jaxrod.make_scene(arm, jaxrod.clamp(of_arm), load), "body": light},
        systems.attach(("arm", "tip"), ("body",), state),
    )
    found = jaxrod.equilibrium(system, state)
    assert found.converged and found.stable and found.iterations <= 10
    np.testing.assert_allclose(found.state["arm"].tip, single.state.tip, atol=1e-10)


def corner(turn, names, exchanged, unit):
    """Tip of a loaded corner of two rods, seen otherwise, back in metres and unturned.

    Args:
        turn: Rotation matrix of the whole.
        names: Names of both rods, which put them in order.
        exchanged: Whether the weld names the second rod first.
        unit: Units of length in a metre; newtons become kilograms times units.
    """
    material = {
        "radius": 0.02 * unit,
        "density": 1000.0 / unit**3,
        "youngs_modulus": 1e6 / unit,
        "normal": tuple(turn @ (0.0, 1.0, 0.0)),
    }
    ways, starts = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0)), (np.zeros(3), (0.0, 0.0, 0.3))
    rods, state = {}, {}
    for name, way, start in zip(names, ways, starts, strict=True):
        rods[name], state[name] = rod(
            4,
            0.3 * unit,
            tuple(unit * (turn @ start)),
            tuple(turn @ way),
            **material,
        )
    post, beam = names
    ends = ((post, "tip"), (beam, "base"))
    joint = systems.weld(*(ends[::-1] if exchanged else ends), state)
    load = jaxrod.end_load(unit * (turn @ (0.0, 0.05, -0.1)))
    members = {
        post: jaxrod.make_scene(rods[post], jaxrod.clamp(state[post])),
        beam: jaxrod.make_scene(rods[beam], load),
    }
    found = jaxrod.equilibrium(jaxrod.make_system(members, joint), state)
    assert found.converged and found.stable and not found.loose
    return turn.T @ np.asarray(found.state[beam].tip) / unit


@pytest.mark.slow
def test_it_is_the_same_turned_in_other_units_and_in_another_order():
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    wanted = corner(np.eye(3), ("a", "b"), False, 1.0)
    assert np.linalg.norm(wanted - (0.3, 0.0, 0.3)) > 0.03
    found = corner(turn, ("b", "a"), True, 1e3)
    np.testing.assert_allclose(found, wanted, atol=1e-10)


@pytest.mark.slow
def test_loose_turns_are_found_far_from_the_origin():
    """A free rod that was bent straight takes its curved shape again."""

    def shape(start):
        left, of_left = rod(3, 0.2, start)
        right, of_right = rod(3, 0.2, (start[0] + 0.2, *start[1:]))
        curved = jnp.zeros((3, 2)).at[1].set(2.0)
        state = {"left": of_left, "right": of_right}
        system = jaxrod.make_system(
            {
                "left": jaxrod.make_scene(replace(left, rest_curvatures=curved)),
                "right": jaxrod.make_scene(replace(right, rest_curvatures=curved)),
            },
            systems.weld(("left", "tip"), ("right", "base"), state),
        )
        found = jaxrod.equilibrium(system, state)
        assert found.converged and found.stable and found.loose
        return found.state["right"].tip - jnp.asarray(start)

    near = shape((0.0, 0.0, 0.0))
    np.testing.assert_allclose(shape((100.0, 50.0, 20.0)), near, atol=1e-8)


@pytest.mark.slow
def test_lists_without_room_are_not_at_rest():
    """Two rods, one of which is pushed through the other that is not in its list."""
    lower, of_lower = rod(4, 0.4)
    upper, of_upper = rod(4, 0.4, (0.2, -0.2, 0.041), (0, 1, 0))
    state = {"lower": of_lower, "upper": of_upper}
    members = {
        "lower": jaxrod.make_scene(lower, jaxrod.clamp(of_lower)),
        "upper": jaxrod.make_scene(
            upper, jaxrod.clamp(of_upper), jaxrod.end_load((0.0, 0.0, -0.3))
        ),
    }

    def at_rest(lists):
        contact = systems.rod_contact("lower", "upper", stiffness=1e4, lists=lists)
        system = jaxrod.make_system(members, contact, state=state)
        return jaxrod.equilibrium(system, state | jaxrod.with_memory(system, state))

    enough = at_rest(systems.neighbour_lists())
    assert enough.converged and not enough.state["neighbours"].overflow
    few = at_rest(systems.neighbour_lists(pairs=1, candidates=1, cell_slots=0))
    assert few.state["neighbours"].overflow and not few.converged


def ropes_in_a_cross(law, n, heavy=1.0):
    """Two straight ropes that touch in their middles, a heavy one on a light one."""
    rope = {"length": 1.0, "radius": 0.005, "density": 1e3, "youngs_modulus": 1e6}
    members, state = {}, {}
    for name, start, direction, weight in (
        ("below", (-0.5, 0.0, -0.0101), (1, 0, 0), 2.0),
        ("above", (0.0, -0.5, 0.0), (0, 1, 0), 10.0 * heavy),
    ):
        made, state[name] = jaxrod.straight_rod(
            n, start=start, direction=direction, dtype=jnp.float64, **rope
        )
        held = (
            jaxrod.pin_support(state[name], 0),
            jaxrod.pin_support(state[name], n),
        )
        down = jnp.asarray([0.0, 0.0, -1.0]) * weight
        members[name] = jaxrod.make_scene(made, *held, jaxrod.gravity(down))
    contact = law("below", "above")
    return jaxrod.make_system(members, contact, state=state), state


LAWS = {
    "rod_contact": lambda *rods: systems.rod_contact(*rods, stiffness=1e6),
    "crossing_contact": lambda *rods: systems.crossing_contact(*rods, stiffness=1e3),
}


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS)
def test_ropes_from_straight_rest_on_each_other_and_not_on_the_other_side(law, record):
    """Without the test for passages a correction takes one rope through the other."""
    system, state = ropes_in_a_cross(LAWS[law], 20)
    found = jaxrod.equilibrium(system, state)
    assert found.converged
    health = jaxrod.health(system, found.state, 1e-4, before=state)
    assert not health.passed and not health.violation
    if law == "crossing_contact":
        # It has no ripples that hold the ropes in their middles: they slip aside.
        return

    def middle(which, heavy):
        pressed, _ = ropes_in_a_cross(LAWS[law], 20, heavy)
        return jaxrod.equilibrium(pressed, state).state[which].positions[2, 10]

    apart = float(middle("above", 1.0) - middle("below", 1.0))
    record(
        f"Ropes that cross, equilibrium from straight by `{law}`: distance [radii]",
        "below 2, by the depth of contact",
        apart / 0.005,
        between=(1.5, 2.0),
    )
    slope = float(jax.grad(lambda heavy: middle("above", heavy))(1.0))
    change = 1e-4
    difference = float(middle("above", 1 + change) - middle("above", 1 - change))
    record(
        f"Ropes that cross, equilibrium by `{law}`: gradient of the height by the "
        "weight, over differences",
        "1",
        abs(slope / (difference / (2 * change)) - 1),
        at_most=1e-6,
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["cylinder", "sphere", "plane"])
def test_a_rod_that_starts_just_touching_a_rough_body_comes_to_rest(kind):
    """Like the scene alone, though hardly anything resists that it rolls on a cylinder.

    There loads of the size of round-off ask for corrections above the tolerance.
    """
    body = {
        "cylinder": shapes.cylinder((0.0, -1.0, 0.0), (0.0, 1.0, 0.0), 0.1),
        "sphere": shapes.sphere((0.0, 0.0, 0.0), 0.1),
        "plane": shapes.plane((0.0, 0.0, 0.1)),
    }[kind]
    made, state = jaxrod.straight_rod(
        10,
        length=1.0,
        radius=0.02,
        density=1000.0,
        youngs_modulus=1e6,
        start=(-0.5, 0.0, 0.12),
        direction=(1.0, 0.0, 0.0),
    )
    touch = jaxrod.contact(
        body, stiffness=1e5, damping=10.0, friction=0.5, points_per_element=2
    )
    grip = jaxrod.sticking_contact(touch, made, state)
    scene = jaxrod.make_scene(made, jaxrod.gravity(), grip)
    found = jaxrod.equilibrium(jaxrod.make_system({"rod": scene}), {"rod": state})
    assert found.converged and found.iterations < 30
    alone = jaxrod.equilibrium(scene, state)
    lowest = [s.positions[2].min() for s in (found.state["rod"], alone.state)]
    # On the cylinder it may have rolled a little on the way: a tenth of a radius.
    np.testing.assert_allclose(*lowest, atol=2e-3)


def laid_over(kind, friction, dtype=jnp.float64, sticks=False):
    """A soft rod that just touches the top of a body with its middle, and its scene."""
    radius, top = 0.005, -0.105 + 1e-5
    made, state = jaxrod.straight_rod(
        10,
        length=0.3,
        radius=radius,
        density=1e3,
        youngs_modulus=1e6,
        start=(-0.15, 0.0, 0.0),
        direction=(1.0, 0.0, 0.0),
        dtype=dtype,
    )
    body = {
        "cylinder": lambda: shapes.cylinder((0.0, -1.0, top), (0.0, 1.0, top), 0.1),
        "capsule": lambda: shapes.capsule((0.0, -0.2, top), (0.0, 0.2, top), 0.1),
        "sphere": lambda: shapes.sphere((0.0, 0.0, top), 0.1),
        "plane": lambda: shapes.plane((0.0, 0.0, 1e-5 - radius)),
    }[kind]()
    touch = jaxrod.contact(
        body, stiffness=1e5, damping=10.0, friction=friction, points_per_element=2
    )
    if sticks:
        touch = jaxrod.sticking_contact(touch, made, state)
    return jaxrod.make_scene(made, touch, jaxrod.gravity()), state


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["cylinder", "sphere", "capsule", "plane"])
def test_friction_that_does_not_stick_balances_alike_alone_and_in_a_system(kind):
    """On top of a round body nothing else holds the rod: it balances, and may slide."""
    scene, state = laid_over(kind, 0.5)
    alone = jaxrod.equilibrium(scene, state)
    system = jaxrod.make_system({"rod": scene})
    member = jaxrod.equilibrium(system, {"rod": state})
    for found in (alone, member):
        assert found.converged and found.loose
        assert bool(found.stable) == (kind == "plane")
    apart = alone.state.positions - member.state["rod"].positions
    # Along the cylinder, y, nothing decides on the place.
    assert float(jnp.max(jnp.abs(apart[jnp.array([0, 2])]))) < 1e-10
    single = jaxrod.equilibrium(*laid_over(kind, 0.5, jnp.float32))
    assert single.converged and bool(single.stable) == (kind == "plane")
    if kind == "cylinder":
        aside = replace(state, positions=state.positions.at[0].add(0.02))
        assert not jaxrod.equilibrium(scene, aside).converged


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["cylinder", "sphere"])
def test_what_sticks_is_stable_where_a_push_dies_out(kind, record):
    """A soft rod hangs on a rough cylinder, but rolls off a rough ball sideways."""
    scene, state = laid_over(kind, 0.5, sticks=True)
    found = jaxrod.equilibrium(scene, state)
    system = jaxrod.make_system({"rod": scene})
    member = jaxrod.equilibrium(system, {"rod": state})
    holds = kind == "cylinder"
    assert found.converged and member.converged
    assert bool(found.stable) == bool(member.stable) == holds
    # The rod can roll along the cylinder, which hardly anything resists.
    second = (
        float(jaxrod.natural_frequencies(scene, found.state, 2)[1]),
        float(jaxrod.natural_frequencies(system, member.state, 2)[1]),
    )
    np.testing.assert_allclose(*second, rtol=1e-3)
    assert not holds or second[0] > 10
    push = 1e-5 * np.random.default_rng(0).normal(size=state.velocities.shape)
    dt = jaxrod.stable_dt(scene, state=found.state).dt
    pushed = replace(found.state, velocities=jnp.asarray(push))
    after = jaxrod.advance(scene, pushed, dt, int(2 / dt))
    moved = float(jnp.max(jnp.abs(after.positions - found.state.positions)))
    assert (moved < 1e-3) == holds
    if holds:
        record(
            "Rod that hangs on a rough cylinder, two seconds after a push of 1e-5 m/s: "
            "displacement [m]",
            "below the push times the time",
            moved,
            at_most=2e-5,
        )

"""Where systems come to rest: against equilibria of one rod and closed forms."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from systems.members import rod
from systems.test_ropes import LIFTED, MATERIAL, SPAN, STIFFNESS, THICK, two_elasticae


def two_halves(*effects, length=0.4, n=3):
    """A clamped rod in two welded halves and in one: system, states, scene, state."""
    whole, of_whole = rod(2 * n, length)
    left, of_left = rod(n, length / 2)
    right, of_right = rod(n, length / 2, (length / 2, 0, 0))
    state = {"left": of_left, "right": of_right}
    system = jaxrod.make_system(
        {
            "left": jaxrod.make_scene(left, jaxrod.clamp(of_left), *effects),
            "right": jaxrod.make_scene(right, *effects),
        },
        jaxrod.systems.weld(("left", "tip"), ("right", "base"), state),
        state=state,
    )
    scene = jaxrod.make_scene(whole, jaxrod.clamp(of_whole), *effects)
    return system, state, scene, of_whole


@pytest.mark.slow
def test_two_halves_settle_where_the_whole_is_in_equilibrium(record):
    """Under an end load, several at once: a batch is a loop over its systems."""
    system, state, scene, of_whole = two_halves()

    def loaded(model, member, force):
        own = model if member is None else model.members[member]
        own = jaxrod.make_scene(own.rod, *own.effects, jaxrod.end_load(force))
        if member is None:
            return own
        others = {**model.members, member: own}
        return jaxrod.make_system(others, *model.couplings)

    forces = jnp.array([[0.0, 0.03, -0.12], [0.1, 0.0, 0.3]])
    settle = lambda force: jaxrod.systems.settled(loaded(system, "right", force), state)
    batch = jax.jit(jax.vmap(settle))(forces)
    assert np.all(batch.converged)
    for k, force in enumerate(forces):
        expected = jaxrod.equilibrium(loaded(scene, None, force), of_whole)
        assert expected.converged and abs(expected.state.tip[2]) > 0.02
        alone = settle(force)
        assert alone.converged and alone.steps == batch.steps[k] < 20_000
        tip = alone.state["right"].tip
        np.testing.assert_allclose(batch.state["right"].tip[k], tip, atol=1e-12)
        record(
            f"two welded halves under an end load {k}, settled [lengths]",
            "equilibrium of one rod",
            np.max(np.abs(tip - expected.state.tip)) / 0.4,
            at_most=1e-6,
        )
    own = loaded(scene, None, forces[0])
    single = jaxrod.systems.settled(own, of_whole)
    assert single.converged
    expected = jaxrod.equilibrium(own, of_whole).state.tip
    np.testing.assert_allclose(single.state.tip, expected, atol=4e-7)
    # A looser bound is reached sooner, and what it says is what is left.
    loose = jaxrod.systems.settled(
        own, of_whole, force_tolerance=1e-3, couple_tolerance=1e-4
    )
    assert loose.converged and loose.steps < single.steps
    assert single.force_residual < loose.force_residual <= 1e-3
    few = jaxrod.systems.settled(own, of_whole, max_steps=100)
    assert not few.converged and few.steps == 112
    assert np.all(few.state.velocities == 0)


@pytest.mark.slow
def test_a_frame_bends_in_both_its_rods(record):
    """A column with a beam welded on top, loaded at its end: by unit loads."""
    high, wide, load = 0.3, 0.4, 1e-3
    column, of_column = rod(8, high, (0, 0, 0), (0, 0, 1))
    beam, of_beam = rod(8, wide, (0, 0, high))
    state = {"column": of_column, "beam": of_beam}
    system = jaxrod.make_system(
        {
            "column": jaxrod.make_scene(column, jaxrod.clamp(of_column)),
            "beam": jaxrod.make_scene(beam, jaxrod.end_load((0.0, 0.0, -load))),
        },
        jaxrod.systems.weld(("column", "tip"), ("beam", "base"), state),
        state=state,
    )
    found = jaxrod.systems.settled(system, state)
    assert found.converged
    moved = np.asarray(found.state["beam"].tip - of_beam.tip)
    bending = float(column.bend_twist_stiffness[0, 0])
    shear, stretch = np.asarray(column.shear_stretch_stiffness)[[0, 2], 0]
    down = (wide**2 * high + wide**3 / 3) / bending + wide / shear + high / stretch
    aside = wide * high**2 / (2 * bending)
    for words, way, expected in (("down", -moved[2], down), ("aside", moved[0], aside)):
        record(
            f"frame of two rods of 8 elements: end of the beam, {words}",
            "unit loads: bending of both, shear, stretch",
            abs(way / (load * expected) - 1),
            at_most=0.01,
        )


@pytest.mark.slow
def test_a_rod_is_lowered_on_a_cylinder(record):
    """In two halves, both of which may touch it."""
    pull = jaxrod.gravity((0.0, 0.0, -2.5))
    post = jaxrod.shapes.cylinder((0.25, -0.1, -0.06), (0.25, 0.1, -0.06), 0.03)
    touch = jaxrod.contact(post, stiffness=1e4, damping=1.0, points_per_element=2)
    system, state, scene, of_whole = two_halves(pull, touch)
    expected = jaxrod.equilibrium(scene, of_whole)
    found = jaxrod.systems.settled(system, state)
    assert expected.converged and found.converged
    free = two_halves(pull)
    alone = jaxrod.equilibrium(free[2], free[3]).state.tip
    assert float(expected.state.tip[2] - alone[2]) > 0.02
    record(
        "two welded halves lowered on a cylinder, settled [lengths]",
        "equilibrium of one rod with contact",
        np.max(np.abs(found.state["right"].tip - expected.state.tip)) / 0.4,
        at_most=1e-6,
    )


@pytest.mark.slow
def test_two_ropes_that_cross_settle(record):
    """Both sag between pins, and the upper rests on the lower."""
    n, members, state = 20, {}, {}
    for name, way, height in (
        ("lower", (1.0, 0.0, 0.0), 0.0),
        ("upper", (0.0, 1.0, 0.0), LIFTED),
    ):
        start = (0, 0, height) - 0.5 * SPAN * np.asarray(way)
        made, state[name] = jaxrod.straight_rod(
            n, length=SPAN, radius=THICK, start=start, direction=way, **MATERIAL
        )
        pins = [jaxrod.pin_support(state[name], end) for end in ("base", "tip")]
        pull = jaxrod.gravity((0.0, 0.0, -9.81))
        members[name] = jaxrod.make_scene(made, *pins, pull)
    contact = jaxrod.systems.crossing_contact(*members, stiffness=STIFFNESS, onset=1e-3)
    found = jaxrod.systems.settled(jaxrod.make_system(members, contact), state)
    assert found.converged
    heights = [float(found.state[k].positions[2, n // 2]) for k in members]
    lifted = two_elasticae(made) - two_elasticae(made, touching=False)
    errors = (np.array(heights) - two_elasticae(made)) / lifted
    record(
        "two ropes that cross, 20 elements, settled: heights, relative to the lift "
        "by contact",
        "two elasticae and their contact, as a boundary value problem",
        np.max(np.abs(errors)),
        at_most=0.02,
    )


def ball_on_the_floor():
    ball, state = jaxrod.systems.rigid_body(
        jaxrod.shapes.sphere((0.0, 0.0, 0.051), 0.05),
        density=1000.0,
        effects=(jaxrod.gravity((0.0, 0.0, -9.81)),),
        dtype=jnp.float64,
    )
    floor = jaxrod.systems.rigid_contact(
        "ball", fixed=jaxrod.shapes.plane(), stiffness=1e4, damping=1.0
    )
    return jaxrod.make_system({"ball": ball}, floor), {"ball": state}, ball


@pytest.mark.slow
def test_a_ball_comes_to_rest_and_what_falls_does_not(record):
    system, state, ball = ball_on_the_floor()
    bounds = {"force_tolerance": 1e-8, "couple_tolerance": 1e-9}
    with pytest.raises(ValueError, match="force_tolerance must be given, in N"):
        jaxrod.systems.settled(system, state)
    found = jaxrod.systems.settled(system, state, **bounds)
    assert found.converged
    depth = 0.05 - float(found.state["ball"].positions[2, 0])
    record(
        "ball that settles on the ground: penetration",
        "m g / k",
        abs(depth / (float(ball.masses[0]) * 9.81 / 1e4) - 1),
        at_most=1e-6,
    )
    falling = jaxrod.make_system({"ball": ball})
    dropped = jaxrod.systems.settled(falling, state, dt=1e-3, max_steps=320, **bounds)
    weight = float(ball.masses[0]) * 9.81
    assert not dropped.converged and dropped.steps == 320
    assert float(dropped.force_residual) == pytest.approx(weight, rel=1e-9)


@pytest.mark.slow
def test_a_beam_settles_within_a_few_of_its_periods():
    """It is damped by the rate at which it swings, found on the way."""
    arm, straight = jaxrod.straight_rod(
        3, length=0.5, radius=0.05, density=1000.0, youngs_modulus=1e5
    )
    scene = jaxrod.make_scene(
        arm, jaxrod.clamp(straight), jaxrod.gravity((0.0, 0.0, -1.0))
    )
    dt = float(jaxrod.stable_dt(scene).dt)
    period = 2 * np.pi / float(jaxrod.natural_frequencies(scene, straight, 1)[0])
    found = jaxrod.systems.settled(scene, straight, max_steps=round(6 * period / dt))
    assert found.converged


def test_bad_input():
    system, state, scene, of_whole = two_halves()
    for options, words in (
        ({"dt": -1.0}, "dt must be positive, got -1 s"),
        ({"dt": 1e-5, "force_tolerance": 0.0}, "force_tolerance must be.* N"),
        ({"dt": 1e-5, "every": 0}, "every must be at least 1, got 0"),
        ({"dt": 1e-5, "max_steps": 0}, "max_steps must be at least 1, got 0"),
    ):
        with pytest.raises(ValueError, match=words):
            jaxrod.systems.settled(scene, of_whole, **options)
    pull = jaxrod.gravity(jaxrod.schedules.sine((0.0, 0.0, 1.0), 2.0))
    for model, own in (
        (jaxrod.make_scene(scene.rod, pull), of_whole),
        (
            jaxrod.make_system({"left": jaxrod.make_scene(scene.rod, pull)}),
            {"left": of_whole},
        ),
    ):
        with pytest.raises(ValueError, match=r"one moment.*\.at\(time\)"):
            jaxrod.systems.settled(model, own)
    with pytest.raises(ValueError, match="must have the members"):
        jaxrod.systems.settled(system, {"left": state["left"]})


@jaxrod.extend.pytree
class Slackens(jaxrod.extend.Effect):
    """Pulls the tip up, the less the longer it has pulled."""

    rate: jax.Array
    pull: jax.Array = jaxrod.extend.memory()

    def loads(self, rod, motion):
        up = jnp.zeros_like(motion.position[0]).at[-1].set(self.pull)
        return jaxrod.extend.Loads(forces=(0 * up, 0 * up, up))

    def after_step(self, rod, motion, dt):
        return replace(self, pull=self.pull * jnp.exp(-dt * self.rate))


@pytest.mark.slow
def test_equal_rods_that_remember_settle():
    """What they remember goes on with the steps, and is in the state that is found."""

    def made(pull):
        one, state = rod(5, 0.4)
        effects = jaxrod.gravity((0.0, 0.0, -2.0)), Slackens(jnp.array(200.0), pull)
        return jaxrod.make_scene(one, jaxrod.clamp(state), *effects), state

    scenes, states = jax.vmap(made)(jnp.array([0.1, 0.3]))
    system = jaxrod.make_system({"rods": scenes}, state={"rods": states})
    found = jaxrod.systems.settled(system, {"rods": states})
    assert found.converged and system.remembers
    after = found.state["rods"]
    assert len(after.memory) == 3 and np.max(np.abs(after.memory[2]["pull"])) < 1e-6
    scene, state = jax.tree.map(lambda leaf: leaf[0], (scenes, states))
    alone = jaxrod.make_scene(scene.rod, *scene.effects[:2])
    expected = jaxrod.equilibrium(alone, state)
    assert expected.converged and expected.state.tip[2] < -0.02
    for positions in after.positions:
        np.testing.assert_allclose(positions, expected.state.positions, atol=4e-7)


@pytest.mark.slow
def test_step_and_tolerances_may_be_traced():
    """Looser tolerances are met sooner, by one program."""
    rod, state = jaxrod.straight_rod(
        3, length=0.4, radius=0.02, density=1e3, youngs_modulus=1e6, dtype=jnp.float64
    )
    hanging = jaxrod.gravity((9.81, 0.0, 0.0))
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state), hanging)

    @jax.jit
    def rest(dt, force, couple):
        tolerances = {"force_tolerance": force, "couple_tolerance": couple}
        return jaxrod.systems.settled(scene, state, dt=dt, **tolerances)

    dt = jaxrod.stable_dt(scene).dt
    coarse, fine = (rest(dt, bound, 0.4 * bound) for bound in (1e-2, 1e-7))
    assert coarse.converged and fine.converged
    assert coarse.steps < fine.steps
    assert rest._cache_size() == 1

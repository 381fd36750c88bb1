"""A planar scene is the three-dimensional one, for less."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.extend import Effect, Loads
from jaxrod.geometry.rotations import directors, to_material
from jaxrod.methods.laws import IN_SPACE
from jaxrod.rods.elasticity import joint_rotations
from jaxrod.rods.motion import motion_of
from physics.reductions import arithmetic_left, check_one_program
from physics.rods import arm, difference, turn

AXES = {"xy": (0, 1), "yz": (1, 2), "zx": (2, 0)}
MODES = ("consistent", "pyelastica")


def swinging(plane, aligned=True, dtype=jnp.float64, n=12, mode="consistent"):
    """A tapered, pre-curved, loaded arm that moves in a plane; planar scene, state."""
    a, b = AXES[plane]
    out = 3 - a - b
    axis = lambda i, size=1.0: size * np.eye(3)[i]
    s = np.linspace(0, 1, n + 1)
    nodes = np.zeros((3, n + 1))
    nodes[a], nodes[b], nodes[out] = s, 0.2 * s**2, 0.3
    normal = axis(out) if aligned else axis(out) + axis(b)
    rod, state = jaxrod.rod_along(
        nodes,
        radius=(0.05, 0.03),
        density=1000.0,
        youngs_modulus=1e7,
        normal=normal,
        dtype=dtype,
    )
    # Bending about d1 differs from bending about d2 where they lie in the plane.
    if aligned:
        stiffness = rod.bend_twist_stiffness.at[1].mul(3.0)
        shear = rod.shear_stretch_stiffness.at[0].mul(0.7)
        rod = replace(
            rod, bend_twist_stiffness=stiffness, shear_stretch_stiffness=shear
        )
    # A couple about the normal, in the material frame of every element.
    about = np.asarray(state.directors)[:, out] * 20 * np.sin(3 * s[1:])
    effects = (
        jaxrod.clamp(state),
        jaxrod.gravity(axis(a, 2.0) + axis(b, -9.81)),
        jaxrod.exponential_damping(0.5, 3.0),
        jaxrod.end_load(axis(b, 3.0), axis(out, 2.0)),
        jaxrod.uniform_load(axis(a, 1.0), axis(out, 5.0)),
        jaxrod.actuation.ElementCouples(jnp.asarray(about)),
    )
    spin = jnp.zeros((3, n)).at[out].set(1e-3)
    state = replace(state, angular_momenta=spin.astype(dtype))
    method = jaxrod.planar(plane, IN_SPACE[mode])
    return jaxrod.make_scene(rod, *effects, method=method), state


def checked(scene, state):
    scene.method.check_state(scene, state)


def in_space(scene):
    return replace(scene, method=scene.method.of)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plane", "mode"),
    [
        ("xy", "consistent"),
        pytest.param("yz", "consistent", marks=pytest.mark.slow),
        pytest.param("zx", "consistent", marks=pytest.mark.slow),
        pytest.param("zx", "pyelastica", marks=pytest.mark.slow),
    ],
)
def test_a_planar_scene_is_the_one_in_space(plane, mode, record):
    """To rounding, and what rounding comes to in 2000 steps is measured, not guessed:
    a rod whose positions differ in their last bit goes as far astray."""
    scene, state = swinging(plane, mode=mode)
    dt = float(jaxrod.stable_dt(scene).dt)
    flat = jaxrod.rollout(scene, state, dt, 2000, 100)
    full = jaxrod.rollout(in_space(scene), state, dt, 2000, 100)
    beside = jaxrod.rollout(in_space(scene), last_bit_moved(state), dt, 2000, 100)
    travel = np.max(np.abs(full.positions - full.positions[:1]))
    assert travel > 0.3, "the arm has to move for the comparison to say something"

    def worst(states):
        return max(
            float(jnp.max(jnp.abs(a - b)) / jnp.max(jnp.abs(b)))
            for a, b in zip(jax.tree.leaves(states), jax.tree.leaves(full), strict=True)
        )

    rounding = worst(beside)
    assert rounding < 1e-11, "the motion has to be one that rounding leaves alone"
    record(
        f"Planar scene ({plane}, {mode} mode), n = 12, 2000 steps: difference of the "
        "states, in units of the effect of one last bit of the first positions",
        "the same scene in space",
        worst(flat) / rounding,
        at_most=4.0,
    )


def last_bit_moved(state):
    """The state with every position the next number up or down, in turn."""
    positions = np.asarray(state.positions)
    ways = np.where(np.arange(positions.size) % 2, np.inf, -np.inf)
    moved = np.nextafter(positions, ways.reshape(positions.shape))
    return replace(state, positions=jnp.asarray(moved))


@pytest.mark.slow
def test_principal_axes_may_lie_obliquely_where_all_axes_are_alike():
    scene, state = swinging("yz", aligned=False)
    flat = jaxrod.advance(scene, state, 2e-4, 200)
    full = jaxrod.advance(in_space(scene), state, 2e-4, 200)
    np.testing.assert_allclose(flat.positions, full.positions, atol=1e-13)
    np.testing.assert_allclose(flat.orientations, full.orientations, atol=1e-13)


class Watch(Effect):
    """Keeps the motions that it sees."""

    def __init__(self):
        self.motions = []

    def loads(self, rod, motion):
        self.motions.append(motion)
        return Loads()


@pytest.mark.parametrize("aligned", [True, False])
def test_frames_and_strains_that_effects_get_are_those_of_the_quaternions(aligned):
    scene, state = swinging("zx", aligned=aligned)
    stepper = scene.method.stepper_in_system(scene, state, jnp.asarray(0.01))
    motion = stepper.enter(state)
    motion = motion.turned(jnp.linspace(-1.0, 1.5, scene.rod.n_elements))
    watch, none = Watch(), jnp.zeros_like(motion.position[0])
    stepper = replace(stepper, scene=replace(scene, effects=(watch,)))
    stepper.add_loads(motion, (none, none), jnp.zeros_like(motion.turn), None)
    (seen,) = watch.motions
    frame = directors(seen.orientation)
    rotations, _ = joint_rotations(seen.orientation)
    expected = frame, to_material(frame, seen.edges), rotations
    known = seen.sections
    found = known.frame, known.edges, known.rotations
    assert difference(jax.tree.leaves(found), jax.tree.leaves(expected)) < 1e-14
    # What turns the rod does not take them along.
    turned = replace(seen, orientation=seen.orientation[1:] + seen.orientation[:1])
    assert turned.sections is None


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("plane", AXES)
def test_actuators_in_sections_act_as_in_space(plane, mode):
    """A chamber, which goes into the wall, and a tendon, both beside the axis."""
    scene, state = swinging(plane, aligned=False, mode=mode)
    out = 3 - sum(AXES[plane])
    n1, n2, _ = np.asarray(state.directors)[:, out, 0]
    beside = 0.02 * np.array([n2, -n1])
    rod, wall = scene.rod, scene.effects[0]
    inside = (
        jaxrod.actuation.chamber(rod, 3e5, 5e-4, offsets=beside, into=wall),
        jaxrod.actuation.tendon(rod, -beside, tension=20.0),
    )
    scene = replace(scene, effects=(*scene.effects, *inside))
    dt = float(jaxrod.stable_dt(scene).dt)
    flat = jaxrod.advance(scene, state, dt, 1000)
    full = jaxrod.advance(in_space(scene), state, dt, 1000)
    without = replace(scene, effects=scene.effects[:-2])
    bare = jaxrod.advance(without, state, dt, 1000)
    assert float(jnp.max(jnp.abs(full.positions - bare.positions))) > 0.01
    np.testing.assert_allclose(flat.positions, full.positions, atol=1e-12)
    np.testing.assert_allclose(flat.orientations, full.orientations, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
def test_gradients_are_those_in_space(mode):
    scene, state = swinging("zx", mode=mode)
    state = replace(state, velocities=state.velocities.at[0].set(0.1))

    def height(scene, state, dt):
        return jaxrod.advance(scene, state, dt, 30).tip[0]

    gradient = jax.jit(jax.grad(height, argnums=(0, 1, 2)))
    flat = gradient(scene, state, 2e-4)
    full = gradient(in_space(scene), state, 2e-4)
    # What points out of the plane has no influence on what a planar scene is.
    for one, other in (
        (flat[2], full[2]),
        (flat[0].rod.linear_density, full[0].rod.linear_density),
        (flat[0].rod.rest_lengths, full[0].rod.rest_lengths),
        (flat[0].rod.bend_twist_stiffness[0], full[0].rod.bend_twist_stiffness[0]),
        (flat[0].effects[1].acceleration[::2], full[0].effects[1].acceleration[::2]),
        (flat[1].positions[::2], full[1].positions[::2]),
        (flat[1].velocities[::2], full[1].velocities[::2]),
        (flat[1].angular_momenta[1], full[1].angular_momenta[1]),
    ):
        assert float(jnp.max(jnp.abs(other))) > 0
        np.testing.assert_allclose(
            one, other, rtol=1e-9, atol=1e-11 * float(jnp.max(jnp.abs(other)))
        )


@pytest.mark.slow
def test_batches_and_numbers_do_not_recompile():
    check_one_program(*swinging("xy"), rtol=1e-13)


def test_orientations_of_a_bare_rod_come_from_its_angles():
    """A member of a system carries them along; both are equal after whole turns."""
    rod, state = arm(3, direction=(1.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0))
    spins = state.angular_momenta.at[2].set(rod.inertias[0])
    state = replace(state, angular_momenta=spins)
    method = jaxrod.planar("xy")
    scene = jaxrod.make_scene(rod, method=method)
    twice = (method.stepper, False), (method.stepper_in_system, True)

    @jax.jit
    def ends(state):
        orientations = []
        for make, carried in twice:
            stepper = make(scene, state, jnp.asarray(0.4))
            motion = stepper.enter(state)
            assert (motion.half is not None) == carried
            drifted = lambda _, motion, own=stepper: own.drift(motion, own.dt)
            motion = jax.lax.fori_loop(0, 40, drifted, motion)
            orientations.append(stepper.leave(motion).orientations)
        return orientations

    # Two whole turns leave the sign of a quaternion as it is.
    turned = turn(state.orientations, (16.0 - 4 * np.pi) * state.directors[:, 2])
    for end in ends(state):
        assert difference(end, turned) < 1e-14 * 16


@pytest.mark.slow
def test_it_costs_less_than_two_fifths_of_the_arithmetic(record):
    record(
        "Arithmetic of a planar step, divided by that of a step in space",
        "compiled programs",
        arithmetic_left(method=jaxrod.planar("zx")),
        at_most=0.4,
    )


@pytest.mark.fast_sets(2)
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_what_is_zero_out_of_the_plane_stays_zero(mode, dtype):
    """Exactly, call after call; the normal turns by no more than its own rounding."""
    scene, state = swinging("zx", dtype=dtype, mode=mode)
    start = state
    dt = float(jaxrod.stable_dt(scene).dt)
    for _ in range(300):
        state = jaxrod.advance(scene, state, dt, 3)
    assert float(jnp.max(jnp.abs(state.positions - start.positions))) > 0.1
    np.testing.assert_array_equal(state.positions[1], start.positions[1])
    np.testing.assert_array_equal(state.velocities[1], 0)
    np.testing.assert_array_equal(state.angular_momenta[::2], 0)
    tilts = np.asarray(state.directors)[2, 1]
    np.testing.assert_array_less(np.abs(tilts), 4 * np.finfo(dtype).eps)


@pytest.mark.slow
@pytest.mark.parametrize(
    "plane",
    ["xy", *(pytest.param(p, marks=pytest.mark.slow) for p in ("yz", "zx"))],
)
def test_an_end_held_fast_is_put_back_as_in_space(plane):
    """Displaced and turned within the plane, and held by an effect that has both."""
    scene, state = swinging(plane)
    a, b = AXES[plane]
    turned = turn(state.orientations, 0.1 * state.directors[:, 3 - a - b])
    off = replace(
        state,
        positions=state.positions.at[a, 0].add(0.02).at[b, 0].add(-0.01),
        orientations=turned,
    )
    held = (jaxrod.fixed_end(state), *scene.effects[1:])
    scene = replace(scene, effects=held)
    flat = jaxrod.advance(scene, off, 1e-4, 200)
    full = jaxrod.advance(in_space(scene), off, 1e-4, 200)
    np.testing.assert_allclose(flat.positions[:, 0], state.positions[:, 0], atol=1e-15)
    for field in ("positions", "orientations", "velocities"):
        expected = getattr(full, field)
        np.testing.assert_allclose(getattr(flat, field), expected, atol=1e-10)


def test_an_end_held_out_of_the_plane_is_refused():
    scene, state = swinging("xy")
    lifted = replace(state, positions=state.positions + 0.1)
    held = replace(scene, effects=(jaxrod.fixed_end(lifted),))
    with pytest.raises(ValueError, match="xy plane needs node positions"):
        jaxrod.advance(held, state, 1e-4, 5)


@pytest.mark.slow
@pytest.mark.parametrize("plane", ["yz"])
def test_effects_see_what_rounding_has_added_to_the_positions(plane):
    scene, state = swinging(plane, dtype=jnp.float32)
    remainders = 1e-8 * jnp.cos(jnp.arange(39.0, dtype=jnp.float32)).reshape(3, 13)
    state = replace(state, remainders=remainders)
    integrator = scene.method.stepper(scene, state, jnp.asarray(1e-4, jnp.float32))
    seen = integrator.view(integrator.enter(state))
    assert difference(seen.edges, motion_of(state).edges) == 0
    assert difference(seen.edges, motion_of(replace(state, remainders=None)).edges) > 0
    after = integrator.leave(integrator.enter(state))
    assert difference(after.remainders, state.remainders) == 0


@pytest.mark.fast_sets(3)
@pytest.mark.parametrize(
    ("spoil", "word"),
    [
        (
            lambda c, s: (c, replace(s, positions=s.positions.at[2, 4].add(0.01))),
            "posi",
        ),
        (
            lambda c, s: (c, replace(s, velocities=s.velocities.at[2, 4].add(1))),
            "veloc",
        ),
        (
            lambda c, s: (
                c,
                replace(s, angular_momenta=s.angular_momenta.at[0, 3].add(1e-3)),
            ),
            "angular momenta",
        ),
        (
            lambda c, s: (
                replace(c, effects=(*c.effects, jaxrod.gravity((0.0, 0.0, -9.81)))),
                s,
            ),
            "forces",
        ),
        (
            lambda c, s: (
                replace(c, effects=(*c.effects, jaxrod.end_load(couple=(1.0, 0, 0)))),
                s,
            ),
            "couples",
        ),
        (
            lambda c, s: (
                replace(
                    c,
                    rod=replace(
                        c.rod, rest_curvatures=c.rod.rest_curvatures.at[2, 3].add(1.0)
                    ),
                ),
                s,
            ),
            "rest curvatures",
        ),
    ],
)
def test_what_leaves_the_plane_is_refused(spoil, word):
    scene, state = spoil(*swinging("xy"))
    with pytest.raises(ValueError, match=rf"xy plane needs.*{word}"):
        jaxrod.advance(scene, state, 1e-4, 5)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_small_parts_out_of_the_plane_do_not_hide(dtype):
    """Neither behind large ones, nor where the rod is small, nor seen end-on."""
    rod, state = arm(10, dtype, direction=(1.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0))
    post = jaxrod.shapes.cylinder((1.3, -1.0, -1.0), (1.3, 1.0, 1.0), 0.1)
    ahead = jaxrod.contact(post, stiffness=1e5)
    pulled = jaxrod.end_load((1e5, 0.0, 0.0)), jaxrod.end_load((0.0, 0.0, 1.0))
    for effects, word in [((ahead,), "surfaces of bodies"), (pulled, "forces")]:
        with pytest.raises(ValueError, match=word):
            checked(jaxrod.make_scene(rod, *effects, method=jaxrod.planar("xy")), state)
    tiny, resting = jaxrod.straight_rod(
        10,
        length=1e-6,
        radius=1e-7,
        density=7800.0,
        youngs_modulus=1e11,
        direction=(1.0, 0.0, 0.0),
        normal=(0.0, 0.0, 1.0),
        dtype=dtype,
    )
    falling = jaxrod.make_scene(
        tiny, jaxrod.gravity((0.0, 0.0, -9.81)), method=jaxrod.planar("xy")
    )
    with pytest.raises(ValueError, match="forces"):
        checked(falling, resting)


@pytest.mark.slow
def test_what_rounding_leaves_out_of_the_plane_is_accepted():
    """A rod that came to rest in space, and one that hangs in front of a short post."""
    rod, state = arm(10, direction=(1.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0))
    noise = 1e-13 * np.random.default_rng(0).normal(size=(3, 11))
    settled = replace(state, velocities=state.velocities + noise)
    post = jaxrod.shapes.cylinder((0.7, -0.3, -0.1), (0.7, -0.3, 0.1), 0.2)
    contact = jaxrod.contact(post, stiffness=1e5)
    scene = jaxrod.make_scene(
        rod, jaxrod.clamp(state), contact, method=jaxrod.planar("xy")
    )
    checked(scene, settled)


@pytest.mark.parametrize("other", ["implicit", "torsion_free"])
def test_methods_without_a_planar_step_are_refused(other):
    with pytest.raises(TypeError, match="methods that have a planar step"):
        jaxrod.planar("xy", getattr(jaxrod, other)())

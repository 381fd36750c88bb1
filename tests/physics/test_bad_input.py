"""Bad arguments are refused in words: which argument, what it was, in which unit."""

import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from physics.rods import difference

NAN = float("nan")
PROPERTIES = {
    "length": 1.0,
    "radius": 0.05,
    "density": 1e3,
    "youngs_modulus": 1e7,
    "dtype": jnp.float64,
}
ROD, STATE = jaxrod.straight_rod(5, **PROPERTIES)
_, OTHER = jaxrod.straight_rod(7, **PROPERTIES)
SCENE = jaxrod.make_scene(ROD)
SINGLE = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), STATE)
SPLINE = jaxrod.actuation.control_spline(6)


def straight(n=5, **changes):
    return jaxrod.straight_rod(n, **PROPERTIES | changes)


def along(positions, **changes):
    material = {"radius": 0.05, "density": 1e3, "youngs_modulus": 1e7}
    return jaxrod.rod_along(np.array(positions).T, **material | changes)


BENT = [(0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 1.0)]
FRAMES = np.repeat(np.eye(3)[:, :, None], 2, axis=2)

CASES = {
    # Rods.
    "radius must be positive, got -0.01 m": lambda: straight(radius=-0.01),
    "radius must have shape () or (2,) or (5,), got (4,)": lambda: straight(
        radius=[0.1] * 4
    ),
    "radius must be positive, got 0 m at index [3]": lambda: straight(
        radius=[0.1, 0.1, 0.1, 0.0, 0.1]
    ),
    "n_elements must be at least 2, got 0": lambda: straight(0),
    "n_elements must be an integer, got 2.5": lambda: straight(2.5),
    "youngs_modulus must be finite, got nan Pa": lambda: straight(youngs_modulus=NAN),
    "shear_modulus must be positive, got -1 Pa": lambda: straight(shear_modulus=-1.0),
    "density must be positive, got 0 kg/m^3": lambda: straight(density=0.0),
    "length must be finite, got inf m": lambda: straight(length=np.inf),
    "poisson_ratio must be in (-1, 0.5], got 0.6": lambda: straight(poisson_ratio=0.6),
    "shear_correction must be positive, got 0": lambda: straight(shear_correction=0.0),
    "start must have shape (3,), got (2,)": lambda: straight(start=(0.0, 0.0)),
    "direction must not be the zero vector": lambda: straight(direction=(0, 0, 0)),
    "normal must not be parallel to the rod": lambda: straight(normal=(0, 0, 2.0)),
    "density must be real numbers in kg/m^3, got 'lead'": lambda: straight(
        density="lead"
    ),
    "dtype must be float32 or float64, got int32": lambda: straight(dtype=jnp.int32),
    "positions must have shape (3, n + 1) with n >= 2, in metres": lambda: along(
        BENT[:2]
    ),
    "positions must be finite, got nan m": lambda: along(np.multiply(BENT, NAN)),
    "distance between neighbouring nodes must be positive": lambda: along(
        [BENT[0], BENT[1], BENT[1]]
    ),
    "positions must not turn back on themselves": lambda: along(
        [BENT[0], BENT[1], BENT[0]]
    ),
    "directors must be orthonormal": lambda: along(BENT, directors=2 * FRAMES),
    "directors must be right-handed": lambda: along(BENT, directors=-FRAMES),
    "d3 along the rod, but that of element 1 is 90 deg": lambda: along(
        BENT, directors=FRAMES
    ),
    "effects[0].acceleration must be between": lambda: jaxrod.make_scene(
        straight(dtype=jnp.float32)[0], jaxrod.gravity((0.0, 0.0, 1e40))
    ),
    "method.tolerance must be between": lambda: jaxrod.make_scene(
        straight(dtype=jnp.float32)[0], method=jaxrod.implicit(tolerance=1e-50)
    ),
    # Effects and actuation.
    "acceleration must have shape (3,), got ()": lambda: jaxrod.gravity(-9.8),
    "acceleration must be finite, got nan m/s^2": lambda: jaxrod.gravity((0, 0, NAN)),
    "force must have shape (3,), got (2,)": lambda: jaxrod.end_load((1.0, 2.0)),
    "couple must be finite, got inf N m": lambda: jaxrod.end_load(
        couple=(np.inf, 0, 0)
    ),
    "force_per_length must be finite, got nan N/m": lambda: jaxrod.uniform_load(
        (NAN, 0, 0)
    ),
    "couple_per_length must be finite, got nan N m/m": lambda: jaxrod.uniform_load(
        couple_per_length=(NAN, 0, 0)
    ),
    "translational_rate must be non-negative, got -1 1/s": (
        lambda: jaxrod.exponential_damping(-1.0)
    ),
    "rotational_rate must be non-negative, got -2 1/s": (
        lambda: jaxrod.exponential_damping(1.0, -2.0)
    ),
    """end must be "base" or "tip", got 'finish'""": lambda: jaxrod.clamp(
        STATE, "finish"
    ),
    """end must be "base" or "tip", got 'start'""": (
        lambda: jaxrod.fixed_end(STATE, "start")
    ),
    "controls must be at least 2, got 1": lambda: jaxrod.actuation.control_spline(1),
    "controls must increase strictly inside 0 m to 1 m": lambda: (
        jaxrod.actuation.control_spline([0.5, 0.2])
    ),
    "controls must be real numbers in m, got 'six'": lambda: (
        jaxrod.actuation.control_spline("six")
    ),
    "length must be positive, got -1 m": lambda: jaxrod.actuation.control_spline(
        6, -1.0
    ),
    "controls must have shape (3, 6), got (3, 5)": lambda: (
        jaxrod.actuation.spline_couples(ROD, SPLINE, jnp.zeros((3, 5)), 1.0)
    ),
    "couple_density must be finite, got nan N m/m": lambda: (
        jaxrod.actuation.spline_couples(ROD, SPLINE, jnp.zeros((3, 6)), NAN)
    ),
    "largest_change must be non-negative, got -1": lambda: jaxrod.actuation.limit_rate(
        jnp.zeros(3), jnp.ones(3), -1.0
    ),
    # Scenes and steps.
    "acceleration must have shape (3,), got (); its unit is m/s^2": lambda: (
        jaxrod.gravity(9.81)
    ),
    "jaxrod.schedules has ramp, sine and table": lambda: jaxrod.end_load(print),
    "plane must be one of xy, yz, zx, got 'xz'": lambda: jaxrod.planar("xz"),
    "safety must be positive, got 0": lambda: jaxrod.stable_dt(SCENE, 0.0),
    "safety must be at most 1, got 2": lambda: jaxrod.stable_dt(SCENE, 2.0),
    "n_steps must be a multiple of every, got 5 and 2": lambda: jaxrod.rollout(
        SCENE, STATE, 1e-4, 5, 2
    ),
    "every must be at least 1, got 0": lambda: jaxrod.rollout(SCENE, STATE, 1e-4, 4, 0),
    "devices must be at least 1, got 0": lambda: jaxrod.configure_cpu(0),
}


@pytest.mark.parametrize("message", CASES)
def test_bad_arguments_are_refused(message):
    with pytest.raises(ValueError, match=re.escape(message)):
        CASES[message]()


@pytest.mark.parametrize("run", [jaxrod.step, jaxrod.advance, jaxrod.rollout])
@pytest.mark.parametrize(
    ("state", "dt", "message"),
    [
        (STATE, 0.0, "dt must be positive, got 0 s"),
        (STATE, -1e-4, "dt must be positive, got -0.0001 s"),
        (STATE, NAN, "dt must be finite, got nan s"),
        (STATE, np.ones(3), "dt must have shape (), got (3,)"),
        (STATE, "soon", "dt must be real numbers in s, got 'soon'"),
        (
            OTHER,
            1e-4,
            "state must have 5 elements, as the scene's rod has, got 7",
        ),
        (SINGLE, 1e-4, "state must be float64, as the scene's rod is, got float32"),
    ],
)
def test_no_step_is_made_with_bad_arguments(run, state, dt, message):
    steps = () if run is jaxrod.step else (4,)
    with pytest.raises(ValueError, match=re.escape(message)):
        run(SCENE, state, dt, *steps)


@pytest.mark.parametrize(
    "ask",
    [
        lambda state: jaxrod.stable_dt(SCENE, state=state),
        lambda state: jaxrod.highest_frequency(SCENE, state),
        lambda state: jaxrod.health(SCENE, state, 1e-4),
        lambda state: jaxrod.advance(SCENE, state, 1e-4, 1),
    ],
)
def test_a_state_of_another_size_is_refused(ask):
    with pytest.raises(ValueError, match="state must have 5 elements, as the scene's"):
        ask(OTHER)
    short = replace(STATE, positions=STATE.positions[:, :-1])
    with pytest.raises(ValueError, match="state must have 6 nodes, one more than"):
        ask(short)


@pytest.mark.parametrize(
    ("field", "given", "message"),
    [
        (
            "velocities",
            STATE.velocities.T,
            "velocities of the state [m/s] must have shape (3, 6), got (6, 3)",
        ),
        (
            "velocities",
            jnp.zeros(3),
            "velocities of the state [m/s] must have shape (3, 6), got (3,)",
        ),
        (
            "orientations",
            STATE.orientations[:3],
            "orientations of the state [1] must have shape (4, 5), got (3, 5)",
        ),
        (
            "angular_momenta",
            STATE.velocities,
            "angular_momenta of the state [kg m^2/s] must have shape (3, 5), got (3,",
        ),
        (
            "velocities",
            jnp.zeros((3, 6), int),
            "velocities of the state must be float64, as the scene's rod is, got int64",
        ),
    ],
)
def test_every_field_of_a_state_fits(field, given, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        jaxrod.advance(SCENE, replace(STATE, **{field: given}), 1e-4, 1)


@pytest.mark.parametrize("run", [jaxrod.advance, jaxrod.rollout])
@pytest.mark.parametrize(
    ("steps", "message"),
    [
        (-1, "n_steps must be at least 0, got -1"),
        (2.0, "n_steps must be an integer, got 2.0"),
        (True, "n_steps must be an integer, got True"),
    ],
)
def test_the_number_of_steps_is_a_count(run, steps, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        run(SCENE, STATE, 1e-4, steps)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (
            lambda: jaxrod.make_scene((ROD, STATE)),
            "rod must be a jaxrod Rod, got tuple",
        ),
        (lambda: jaxrod.make_scene(ROD, 3), "effects must be jaxrod effects, got int"),
        (
            lambda: jaxrod.make_scene(ROD, jaxrod.gravity),
            "got function: call gravity(...), which returns an effect",
        ),
        (
            lambda: jaxrod.make_scene(ROD, jaxrod.systems.rod_contact("a")),
            "got RodContact: a coupling acts in a system, so give it to jaxrod.make_s",
        ),
        (
            lambda: jaxrod.make_system({"a": SCENE}, jaxrod.gravity()),
            "got Gravity: an effect acts on one member, so give it to jaxrod.make_sc",
        ),
        (
            lambda: jaxrod.make_system({"a": SCENE}, jaxrod.systems.tie),
            "got function: call tie(...), which returns a coupling",
        ),
        (
            lambda: SCENE.with_effect(jaxrod.gravity),
            "got function: call gravity(...), which returns an effect",
        ),
        (
            lambda: jaxrod.systems.rigid_body(
                jaxrod.shapes.sphere((0, 0, 0), 0.1), mass=1, effects=jaxrod.gravity()
            ),
            "such as (jaxrod.gravity(),), got Gravity",
        ),
        (
            lambda: jaxrod.save(SCENE, "scene.jaxrod"),
            "path must be the path of a file, got Scene: give the path first",
        ),
        (
            lambda: jaxrod.make_system({"a": (ROD, STATE)}),
            "got tuple (factories return a pair: the member, and its state)",
        ),
        (
            lambda: jaxrod.make_scene(ROD, [jaxrod.gravity()]),
            "effects must be jaxrod effects, got list: write *effects",
        ),
        (
            lambda: jaxrod.make_scene(ROD, jaxrod.gravity),
            "effects must be jaxrod effects, got function",
        ),
        (
            lambda: jaxrod.advance(SCENE, (ROD, STATE), 1e-4, 1),
            "state must be a jaxrod RodState, got tuple",
        ),
    ],
)
def test_the_wrong_kind_of_thing_is_refused(build, message):
    with pytest.raises(TypeError, match=re.escape(message)):
        build()


def test_traced_values_pass_where_concrete_ones_are_checked():
    """Inside jit a value cannot be looked at: shapes are checked, values are not."""

    @jax.jit
    def built(radius, dt):
        rod, state = straight(radius=radius)
        return jaxrod.advance(jaxrod.make_scene(rod), state, dt, 2).tip

    np.testing.assert_allclose(built(0.05, 1e-5), [0, 0, 1])
    with pytest.raises(ValueError, match="radius must have shape"):
        built(jnp.ones(4), 1e-5)


@pytest.mark.parametrize("size", [1e-300, 1e-20, 1.0, 1e20, 1e300])
def test_a_direction_may_have_any_length(size):
    direction, normal = np.array([[2.0, 1.0, 0.0], [0.0, 1.0, 3.0]])
    rod, state = straight(direction=size * direction, normal=normal / size)
    expected = straight(direction=direction, normal=normal)
    assert difference((rod, state), expected) < 1e-15


def test_two_numbers_are_a_taper_from_base_to_tip():
    rod, _ = straight(radius=(0.06, 0.01))
    np.testing.assert_allclose(rod.radii, [0.055, 0.045, 0.035, 0.025, 0.015])


def test_two_numbers_are_not_a_taper_of_two_elements():
    """They could be those of the elements: one silent reading of two is a trap."""
    with pytest.raises(ValueError, match="radius must be one number for a rod of 2"):
        straight(2, radius=(0.06, 0.01))


def test_effects_take_the_type_of_the_rod():
    single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), ROD)
    scene = jaxrod.make_scene(single, jaxrod.gravity(), jaxrod.exponential_damping(1.0))
    assert {leaf.dtype for leaf in jax.tree.leaves(scene)} == {jnp.dtype("float32")}
    again = replace(scene, method=jaxrod.pyelastica())
    assert again.rod is scene.rod

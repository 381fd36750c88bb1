"""Mistakes in systems are named: the member, the argument, the value, the unit."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import pytest

import jaxrod
from jaxrod.systems.contact.touching_rods import TouchingRods
from systems.members import rod


@pytest.fixture(scope="module")
def given():
    """Members and a state: two rods that meet, one that does not, a ball."""
    one, of_one = rod(4, 0.3)
    two, of_two = rod(4, 0.3, (0.3, 0, 0), (0, 1, 0))
    far, of_far = rod(4, 0.3, (0, 0, 5.0))
    ball, of_ball = jaxrod.systems.rigid_body(
        jaxrod.shapes.sphere((0, 0, 0.1), 0.05), density=100.0, dtype=jnp.float64
    )
    members = {
        "one": jaxrod.make_scene(one, jaxrod.clamp(of_one, "tip")),
        "two": jaxrod.make_scene(two),
        "far": jaxrod.make_scene(far),
        "ball": ball,
    }
    return members, {"one": of_one, "two": of_two, "far": of_far, "ball": of_ball}


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    ("couple", "words"),
    [
        (
            lambda s: jaxrod.systems.tie(("none", 0), ("two", 0), s),
            "no member is called 'none'",
        ),
        (lambda s: jaxrod.systems.tie(("one", 9), ("two", 0), s), "node of 'one'"),
        (
            lambda s: jaxrod.systems.tie(("one", "end"), ("two", 0), s),
            '"base" or "tip"',
        ),
        (lambda s: jaxrod.systems.tie(("one", "base"), ("far", 0), s), "5 m apart"),
        (lambda s: jaxrod.systems.weld(("one", 4), ("two", 2), s), "m apart"),
        (
            lambda s: jaxrod.systems.tie([("one", 4), ("one", 0)], [("two", 0)], s),
            "2 and 1",
        ),
        (
            lambda s: jaxrod.systems.attach(("ball",), ("ball",), s),
            "attach joins rods to a rigid body",
        ),
        (
            lambda s: jaxrod.systems.attach(("one", "tip"), ("ball",), s),
            "held by a support and attached",
        ),
        (
            lambda s: [
                jaxrod.systems.attach(("two", 1), ("ball",), s),
                jaxrod.systems.attach(("two", 1), ("ball",), s),
            ],
            "follow one body only",
        ),
        (
            lambda s: [
                jaxrod.systems.attach(("two", 0), ("ball",), s),
                jaxrod.systems.tie(("one", 4), ("two", 0), s),
            ],
            "tied and attached",
        ),
        (
            lambda s: jaxrod.systems.ball_joint(
                ("one", 4), ("ball",), s, stiffness=-1.0
            ),
            "stiffness must be positive, got -1 N/m",
        ),
        (
            lambda s: jaxrod.systems.ball_joint(
                ("one", 0), ("far", 4), s, stiffness=1.0
            ),
            r"\('one', 0\) and \('far', 4\) are 5.* m apart.*0.075 m.*give at",
        ),
        (
            lambda s: jaxrod.systems.fixed_joint(
                ("one", 0), ("far", 0), s, stiffness=1.0, turning_stiffness=1.0
            ),
            "are 5 m apart",
        ),
        (
            lambda s: jaxrod.systems.hinge_joint(
                ("one", 0),
                ("far", 0),
                s,
                axis=(0, 0, 1),
                stiffness=1.0,
                axis_stiffness=1.0,
            ),
            "are 5 m apart",
        ),
        (
            lambda s: jaxrod.systems.weld(("one", "base"), ("nobody", 0), s),
            "b: no member is called 'nobody'",
        ),
        (
            lambda s: jaxrod.systems.attach(("two", 0), ("bell",), s),
            "no member is called 'bell'",
        ),
        (
            lambda s: jaxrod.systems.spring(("two", 0), ("bell",), s, stiffness=1.0),
            "b: no member is called 'bell'",
        ),
        (
            lambda s: jaxrod.systems.pose_spring(("bell",), s, stiffness=1.0),
            "place: no member is called 'bell'",
        ),
        (
            lambda s: jaxrod.systems.body_contact("two", "bell", stiffness=1.0),
            "no member is called 'bell'",
        ),
        (
            lambda s: jaxrod.systems.attach(("two", -6), ("ball",), s),
            "node of 'two' must be at least 0, got -1",
        ),
        (
            lambda s: jaxrod.systems.spring(("two", 7), ("ball",), s, stiffness=1.0),
            "a: node of 'two' must be at most 4, got 7",
        ),
        (
            lambda s: jaxrod.systems.spring(("two", 3, 0), ("ball",), s, stiffness=1.0),
            "the number of 'two' must be at most 0, got 3",
        ),
        (
            lambda s: jaxrod.systems.pose_spring(("ball", 2), s, stiffness=1.0),
            "the number of 'ball' must be at most 0, got 2",
        ),
        (
            lambda s: jaxrod.systems.attach(("two", 0.5), ("ball",), s),
            "node of 'two' must be an integer, got 0.5",
        ),
        (
            lambda s: jaxrod.systems.hinge_joint(
                ("one", 4), ("ball",), s, axis=(0, 0, 0), stiffness=1, axis_stiffness=1
            ),
            "axis",
        ),
    ],
)
def test_couplings_that_do_not_fit(given, couple, words):
    members, state = given
    with pytest.raises(ValueError, match=words):
        jaxrod.make_system(members, couple(state), state=state)


@jaxrod.extend.pytree
class Alone(jaxrod.extend.Method):
    """A method without steps in a system."""


def test_members_of_other_kinds_and_types(given):
    members, state = given
    single, _ = jaxrod.straight_rod(
        4, length=0.3, radius=0.02, density=1e3, youngs_modulus=1e6, dtype=jnp.float32
    )
    with pytest.raises(ValueError, match="must all be of one type"):
        jaxrod.make_system({**members, "single": jaxrod.make_scene(single)})
    with pytest.raises(ValueError, match="no steps in a system"):
        jaxrod.make_system({"a": jaxrod.make_scene(members["two"].rod, method=Alone())})
    with pytest.raises(TypeError, match=r"'a' must be a scene \(jaxrod.make_scene\)"):
        jaxrod.make_system({"a": members["two"].rod})
    with pytest.raises(TypeError, match="couplings must be"):
        jaxrod.make_system(members, "weld")
    held = jaxrod.systems.attach(("one", "tip"), ("two", "base"), state)
    with pytest.raises(ValueError, match="'one' and 'two'; weld and tie join rods"):
        jaxrod.make_system(members, held)
    with pytest.raises(TypeError, match="dict"):
        jaxrod.make_system([members["two"]])


def test_a_system_is_made_with_the_states_of_its_members_alone(given):
    members, state = given
    missing = {name: own for name, own in state.items() if name != "two"}
    with pytest.raises(ValueError, match="add the state of 'two'"):
        jaxrod.make_system(members, state=missing)
    short = jax.tree.map(lambda leaf: leaf[..., :-1], state["one"])
    with pytest.raises(ValueError, match=r"positions of 'one' must have shape \(3, "):
        jaxrod.make_system(members, state={**state, "one": short})
    turned = replace(state["one"], velocities=state["one"].velocities.T)
    with pytest.raises(ValueError, match=r"velocities of 'one' must have shape \(3, "):
        jaxrod.make_system(members, state={**state, "one": turned})
    with pytest.raises(TypeError, match="state must be a dict of the states"):
        jaxrod.make_system(members, state=state["one"])


def test_states_that_do_not_fit(given):
    members, state = given
    system = jaxrod.make_system(members)
    with pytest.raises(ValueError, match="must have the members"):
        jaxrod.advance(system, {"one": state["one"]}, 1e-4, 1)
    with pytest.raises(ValueError, match=r"add .*'ball'.* and leave out 'other'"):
        jaxrod.advance(system, {"one": state["one"], "other": 1}, 1e-4, 1)
    with pytest.raises(TypeError, match="state of 'ball' must be a jaxrod"):
        jaxrod.advance(system, {**state, "ball": state["one"]}, 1e-4, 1)
    short = replace(state["one"], positions=state["one"].positions[:, :3])
    with pytest.raises(ValueError, match="positions of 'one'"):
        jaxrod.advance(system, {**state, "one": short}, 1e-4, 1)
    half = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), state)
    with pytest.raises(
        ValueError, match=r"state of 'far' must be float64.* got float32"
    ):
        jaxrod.advance(system, {**state, "far": half["far"]}, 1e-4, 1)
    for name, field in (("far", "velocities"), ("ball", "angular_velocities")):
        mixed = replace(state[name], **{field: getattr(half[name], field)})
        words = f"{field} of '{name}' must be float64, as the system is, got float32"
        with pytest.raises(ValueError, match=words):
            jaxrod.advance(system, {**state, name: mixed}, 1e-4, 1)
    with pytest.raises(ValueError, match="dt must be"):
        jaxrod.advance(system, state, -1e-4, 1)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "density .* or a mass"),
        ({"mass": 1.0}, "inertia .* is needed"),
        ({"density": 1.0}, "density needs a sphere"),
        ({"mass": 0.0, "inertia": (1, 1, 1)}, "mass must be positive, got 0 kg"),
        ({"mass": 1.0, "inertia": (1, 0, 1)}, "inertia must be positive.* kg m"),
        (
            {"shape": jaxrod.shapes.sphere((0, 0, 0), 0.1), "density": 0.0},
            "density must be positive, got 0 kg/m",
        ),
        ({"mass": 1.0, "inertia": (1, 1, 3)}, "no moment above the sum"),
        ({"mass": 1.0, "inertia": (1, 1)}, "inertia"),
    ],
)
def test_bodies_that_are_none(options, words):
    with pytest.raises(ValueError, match=words):
        jaxrod.systems.rigid_body(**options)


def test_rods_without_mass():
    with pytest.raises(ValueError, match=r"density must be positive, got 0 kg/m\^3"):
        rod(4, 0.3, density=0.0)


@pytest.mark.slow
def test_a_batch_of_systems_is_no_system_of_groups(given):
    """Nothing numeric in a tie says so: it would be enforced in the first one alone."""
    members, state = given
    system = jaxrod.make_system(
        {"one": members["one"], "two": members["two"]},
        jaxrod.systems.tie(("one", "tip"), ("two", "base"), state),
    )
    pair = {name: state[name] for name in ("one", "two")}
    systems, states = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), (system, pair))
    with pytest.raises(ValueError, match=r"use jax\.vmap"):
        jaxrod.advance(systems, states, 1e-4, 1)
    with pytest.raises(ValueError, match=r"use jax\.vmap"):
        jaxrod.stable_dt(systems)
    steps = jax.vmap(lambda one: jaxrod.stable_dt(one).dt)(systems)
    assert steps == pytest.approx(float(jaxrod.stable_dt(system).dt))


@pytest.mark.parametrize(
    ("effect", "words"),
    [
        (jaxrod.uniform_load((0.0, 0.0, 1.0)), "'ball': UniformLoad.*rest_lengths"),
        (jaxrod.end_load((0.0, 0.0, 1.0)), r"'ball': EndLoad.*shape \(2,\)"),
        (jaxrod.fluids.stokes_drag(0.1, 0.2), "'ball': StokesDrag.*bodies do not use"),
        (
            jaxrod.contact(jaxrod.shapes.plane(), stiffness=1.0),
            "'ball': Contact",
        ),
        (jaxrod.internal_damping(1e-3), "'ball': InternalDamping"),
    ],
)
def test_effects_that_do_not_act_on_bodies(given, effect, words):
    ball = replace(given[0]["ball"], effects=(jaxrod.gravity(), effect))
    with pytest.raises(ValueError, match=words):
        jaxrod.make_system({"ball": ball})


@jaxrod.extend.pytree
class Fading(jaxrod.extend.Effect):
    """Damping of a rate that may be a schedule."""

    rate: jax.Array

    def damping_rates(self, bodies):
        return self.rate, self.rate


def test_a_schedule_of_damping_of_bodies_is_refused(given):
    """Rates are worked out once: the first one would be kept in silence."""
    fading = Fading(jaxrod.schedules.ramp(0.5, 0.0, 1.0))
    ball = replace(given[0]["ball"], effects=(fading,))
    with pytest.raises(ValueError, match=r"'ball': .* has damping rates"):
        jaxrod.make_system({"ball": ball})


def test_effects_on_bodies_take_their_type():
    """Of a body in single precision where numbers are double by default."""
    ball, state = jaxrod.systems.rigid_body(
        jaxrod.shapes.sphere((0, 0, 0), 0.05),
        density=100.0,
        effects=(jaxrod.gravity(), jaxrod.exponential_damping(0.5)),
        dtype=jnp.float32,
    )
    system = jaxrod.make_system({"ball": ball})
    after = jaxrod.advance(system, {"ball": state}, 0.01, 3)["ball"]
    assert {leaf.dtype for leaf in jax.tree.leaves((system, after))} == {
        jnp.dtype("float32")
    }
    assert after.velocities[2, 0] == pytest.approx(-0.292, abs=1e-3)


@pytest.mark.parametrize(
    "function",
    [
        jaxrod.System.potential_energy,
        jaxrod.System.total_energy,
        lambda system, state: jaxrod.health(system, state, 1e-3),
    ],
)
def test_what_asks_about_one_moment(given, function):
    members, state = given
    pull = jaxrod.gravity(jaxrod.schedules.sine((0.0, 0.0, 1.0), 2.0))
    ball = replace(members["ball"], effects=(pull,))
    system = jaxrod.make_system({"ball": ball})
    with pytest.raises(ValueError, match=r"one moment.*give system\.at\(time\)"):
        function(system, {"ball": state["ball"]})
    function(system.at(0.3), {"ball": state["ball"]})


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("group", [False, True])
def test_a_driven_member_is_checked_against_a_state(group):
    def driven(height):
        one, state = rod(start=jnp.stack([0 * height, 0 * height, height]))
        path = jaxrod.schedules.ramp((0.0, 0.0, 0.0), (0.0, 0.0, 0.1), 1.0)
        return jaxrod.make_scene(one, jaxrod.driven(state, displacement=path)), state

    made = jax.vmap(driven)(jnp.arange(2.0)) if group else driven(jnp.zeros(()))
    scene, state = {"rod": made[0]}, {"rod": made[1]}
    system = jaxrod.make_system(scene, state=state)
    assert system.depends_on_time


@pytest.mark.parametrize(
    ("hook", "arguments"),
    [
        ("allowed", 4),
        ("bounding_radii", 1),
        ("weights", 4),
        ("scales", 2),
        ("contact_pairs", 3),
        ("pair_loads", 3),
        ("bound", 2),
    ],
)
def test_a_law_of_contact_without_a_hook_is_named(hook, arguments):
    """What a law of one's own forgot is said where it is asked for."""

    @jaxrod.extend.pytree
    class Sticky(TouchingRods):
        """A law without anything."""

    law = Sticky(jnp.ones(()), jnp.ones(()))
    with pytest.raises(NotImplementedError, match=f"Sticky has no {hook}: a law of"):
        getattr(law, hook)(*range(arguments))


def test_what_is_known_of_one_rod_alone_says_so(given):
    members, state = given
    system = jaxrod.make_system(members)
    with pytest.raises(
        TypeError, match="got System: this is available for one rod only"
    ):
        jaxrod.highest_frequency(system, state)


@jaxrod.extend.pytree
class Wearing(jaxrod.extend.Effect):
    """An effect with memory."""

    worn: jax.Array = jaxrod.extend.memory()

    def loads(self, rod, motion):
        return jaxrod.extend.Loads()

    def after_step(self, rod, motion, dt):
        return replace(self, worn=self.worn + dt)


@pytest.mark.parametrize("group", [False, True])
def test_a_memory_of_other_effects_is_refused(group):
    """The message is that of a scene."""
    own, state = rod(2, 0.3)

    def made(own):
        return jaxrod.make_scene(own, Wearing(jnp.zeros(2)))

    scene, mistaken = made(own), replace(state, memory=((jnp.zeros(3),),))
    words = r"memory must be of the effects of this scene"
    if not group:
        with pytest.raises(ValueError, match=words):
            jaxrod.advance(scene, mistaken, 1e-4, 1)
    else:
        own, mistaken = jax.tree.map(lambda leaf: leaf[None], (own, mistaken))
        scene = jax.vmap(made)(own)
    system = jaxrod.make_system({"one": scene})
    with pytest.raises(ValueError, match=rf"'one'.*{words}"):
        jaxrod.advance(system, {"one": mistaken}, 1e-4, 1)


@pytest.mark.parametrize(("stiffness", "words"), [(1e-50, "1e-50"), (1e50, "1e\\+50")])
def test_numbers_that_the_type_cannot_hold_are_refused(stiffness, words):
    """They were zero or infinite in silence."""
    given = {"length": 0.3, "radius": 0.02, "density": 1e3, "youngs_modulus": 1e6}
    one, of_one = jaxrod.straight_rod(2, **given, dtype=jnp.float32)
    two, of_two = jaxrod.straight_rod(2, **given, dtype=jnp.float32)
    rest = {"one": of_one, "two": of_two}
    members = {"one": jaxrod.make_scene(one), "two": jaxrod.make_scene(two)}
    for couple in (
        lambda: jaxrod.systems.spring(
            ("one", 0), ("two", 2), rest, stiffness=stiffness
        ),
        lambda: jaxrod.systems.ball_joint(
            ("one", 0), ("two", 0), rest, stiffness=stiffness
        ),
        lambda: jaxrod.systems.rod_contact("one", "two", stiffness=stiffness),
    ):
        with pytest.raises(ValueError, match=rf"stiffness.*in float32.*{words}"):
            jaxrod.make_system(members, couple(), state=rest)


def test_bodies_that_the_type_cannot_hold_are_refused():
    ball, _ = jaxrod.systems.rigid_body(
        jaxrod.shapes.sphere((0, 0, 0), 0.1),
        density=1e3,
        effects=(jaxrod.exponential_damping(1e-50),),
        dtype=jnp.float32,
    )
    with pytest.raises(ValueError, match=r"effects of 'ball'.*in size in float32"):
        jaxrod.make_system({"ball": ball})
    for radius in (1e-9, 1e-50):
        with pytest.raises(ValueError, match=r"in size in float32"):
            jaxrod.systems.rigid_body(
                jaxrod.shapes.sphere((0, 0, 0), radius), density=1e3, dtype=jnp.float32
            )
    with pytest.raises(ValueError, match=r"inertia.*in size in float32"):
        jaxrod.systems.rigid_body(mass=1.0, inertia=(1e-50,) * 3, dtype=jnp.float32)


def test_members_with_two_leading_axes_are_named(given):
    """Both shapes are told: the given one and the expected one."""
    scene = given[0]["two"]
    twice = jax.tree.map(lambda leaf: jnp.stack([jnp.stack([leaf] * 3)] * 2), scene)
    with pytest.raises(ValueError, match=r"'two'.*\(rods, elements\).*\(2, 3, 4\)"):
        jaxrod.make_system({"two": twice})
    balls = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), given[0]["ball"])
    with pytest.raises(ValueError, match=r"'ball'.*\(bodies\).*\(2, 1\)"):
        jaxrod.make_system({"ball": balls})

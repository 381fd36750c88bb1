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
    ball, of_ball = jaxrod.rigid_body(
        jaxrod.sphere((0, 0, 0.1), 0.05), density=100.0, dtype=jnp.float64
    )
    members = {
        "one": jaxrod.make_scene(one, jaxrod.clamp(of_one, "finish")),
        "two": jaxrod.make_scene(two),
        "far": jaxrod.make_scene(far),
        "ball": ball,
    }
    return members, {"one": of_one, "two": of_two, "far": of_far, "ball": of_ball}


@pytest.mark.parametrize(
    ("couple", "words"),
    [
        (
            lambda s: jaxrod.tie(("none", 0), ("two", 0), s),
            "no member is called 'none'",
        ),
        (lambda s: jaxrod.tie(("one", 9), ("two", 0), s), "node of 'one'"),
        (lambda s: jaxrod.tie(("one", "end"), ("two", 0), s), '"start" or "finish"'),
        (lambda s: jaxrod.tie(("one", "start"), ("far", 0), s), "5 m apart"),
        (lambda s: jaxrod.weld(("one", 4), ("two", 2), s), "m apart"),
        (lambda s: jaxrod.tie([("one", 4), ("one", 0)], [("two", 0)], s), "2 and 1"),
        (lambda s: jaxrod.attach(("ball",), ("ball",), s), "nodes of rods"),
        (
            lambda s: jaxrod.attach(("one", "finish"), ("ball",), s),
            "held by a support and attached",
        ),
        (
            lambda s: [
                jaxrod.attach(("two", 1), ("ball",), s),
                jaxrod.attach(("two", 1), ("ball",), s),
            ],
            "follow one body only",
        ),
        (
            lambda s: [
                jaxrod.attach(("two", 0), ("ball",), s),
                jaxrod.tie(("one", 4), ("two", 0), s),
            ],
            "tied and attached",
        ),
        (
            lambda s: jaxrod.ball_joint(("one", 4), ("ball",), s, stiffness=-1.0),
            "stiffness must be positive, got -1 N/m",
        ),
        (
            lambda s: jaxrod.ball_joint(("one", 0), ("far", 4), s, stiffness=1.0),
            r"\('one', 0\) and \('far', 4\) are 5.* m apart.*0.075 m.*give at",
        ),
        (
            lambda s: jaxrod.rigid_joint(
                ("one", 0), ("far", 0), s, stiffness=1.0, turning_stiffness=1.0
            ),
            "are 5 m apart",
        ),
        (
            lambda s: jaxrod.hinge_joint(
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
            lambda s: jaxrod.weld(("one", "start"), ("nobody", 0), s),
            "b: no member is called 'nobody'",
        ),
        (
            lambda s: jaxrod.attach(("two", 0), ("bell",), s),
            "no member is called 'bell'",
        ),
        (
            lambda s: jaxrod.spring(("two", 0), ("bell",), s, stiffness=1.0),
            "b: no member is called 'bell'",
        ),
        (
            lambda s: jaxrod.pose_spring(("bell",), s, stiffness=1.0),
            "place: no member is called 'bell'",
        ),
        (
            lambda s: jaxrod.body_contact("two", "bell", stiffness=1.0),
            "no member is called 'bell'",
        ),
        (
            lambda s: jaxrod.attach(("two", -6), ("ball",), s),
            "node of 'two' must be at least 0, got -1",
        ),
        (
            lambda s: jaxrod.spring(("two", 7), ("ball",), s, stiffness=1.0),
            "a: node of 'two' must be at most 4, got 7",
        ),
        (
            lambda s: jaxrod.spring(("two", 3, 0), ("ball",), s, stiffness=1.0),
            "the number of 'two' must be at most 0, got 3",
        ),
        (
            lambda s: jaxrod.pose_spring(("ball", 2), s, stiffness=1.0),
            "the number of 'ball' must be at most 0, got 2",
        ),
        (
            lambda s: jaxrod.attach(("two", 0.5), ("ball",), s),
            "node of 'two' must be an integer, got 0.5",
        ),
        (
            lambda s: jaxrod.hinge_joint(
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


def test_members_of_other_kinds_and_types(given):
    members, _ = given
    single, _ = jaxrod.straight_rod(
        4, length=0.3, radius=0.02, density=1e3, youngs_modulus=1e6, dtype=jnp.float32
    )
    with pytest.raises(ValueError, match="must all be of one type"):
        jaxrod.make_system({**members, "single": jaxrod.make_scene(single)})
    with pytest.raises(ValueError, match="no steps in a system"):
        jaxrod.make_system(
            {"a": jaxrod.make_scene(members["two"].rod, method=jaxrod.implicit())}
        )
    with pytest.raises(TypeError, match="member 'a'"):
        jaxrod.make_system({"a": members["two"].rod})
    with pytest.raises(TypeError, match="couplings must be"):
        jaxrod.make_system(members, "weld")
    with pytest.raises(TypeError, match="dict"):
        jaxrod.make_system([members["two"]])


def test_states_that_do_not_fit(given):
    members, state = given
    system = jaxrod.make_system(members)
    with pytest.raises(ValueError, match="must have the members"):
        jaxrod.advance(system, {"one": state["one"]}, 1e-4, 1)
    with pytest.raises(TypeError, match="state of 'ball' must be a BodyState"):
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
            {"shape": jaxrod.sphere((0, 0, 0), 0.1), "density": 0.0},
            "density must be positive, got 0 kg/m",
        ),
        ({"mass": 1.0, "inertia": (1, 1, 3)}, "no moment above the sum"),
        ({"mass": 1.0, "inertia": (1, 1)}, "inertia"),
    ],
)
def test_bodies_that_are_none(options, words):
    with pytest.raises(ValueError, match=words):
        jaxrod.rigid_body(**options)


def test_rods_without_mass():
    with pytest.raises(ValueError, match=r"density must be positive, got 0 kg/m\^3"):
        rod(4, 0.3, density=0.0)


def test_a_batch_of_systems_is_no_system_of_groups(given):
    """Nothing numeric in a tie says so: it would be enforced in the first one alone."""
    members, state = given
    system = jaxrod.make_system(
        {"one": members["one"], "two": members["two"]},
        jaxrod.tie(("one", "finish"), ("two", "start"), state),
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
        (jaxrod.stokes_drag(0.1, 0.2), "'ball': StokesDrag.*bodies have not"),
        (
            jaxrod.contact(jaxrod.plane(), stiffness=1.0),
            "'ball': Contact.*stability_bound",
        ),
        (jaxrod.internal_damping(1e-3), "'ball': InternalDamping"),
    ],
)
def test_effects_that_do_not_act_on_bodies(given, effect, words):
    ball = replace(given[0]["ball"], effects=(jaxrod.gravity(), effect))
    with pytest.raises(ValueError, match=words):
        jaxrod.make_system({"ball": ball})


@jaxrod.pytree
class Fading(jaxrod.Effect):
    """Damping of a rate that may be a schedule."""

    rate: jax.Array

    def damping_rates(self, bodies):
        return self.rate, self.rate


def test_a_schedule_of_damping_of_bodies_is_refused(given):
    """Rates are worked out once: the first one would be kept in silence."""
    fading = Fading(jaxrod.ramp(0.5, 0.0, 1.0))
    ball = replace(given[0]["ball"], effects=(fading,))
    with pytest.raises(ValueError, match=r"'ball': damping rates are worked out once"):
        jaxrod.make_system({"ball": ball})


def test_effects_on_bodies_take_their_type():
    """Of a body in single precision where numbers are double by default."""
    ball, state = jaxrod.rigid_body(
        jaxrod.sphere((0, 0, 0), 0.05),
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
        jaxrod.potential_energy,
        jaxrod.total_energy,
        lambda system, state: jaxrod.health(system, state, 1e-3),
    ],
)
def test_what_asks_about_one_moment(given, function):
    members, state = given
    pull = jaxrod.gravity(jaxrod.sine((0.0, 0.0, 1.0), 2.0))
    ball = replace(members["ball"], effects=(pull,))
    system = jaxrod.make_system({"ball": ball})
    with pytest.raises(ValueError, match=r"one moment.*give system\.at\(time\)"):
        function(system, {"ball": state["ball"]})
    function(system.at(0.3), {"ball": state["ball"]})


@pytest.mark.parametrize("group", [False, True])
def test_a_driven_member_is_checked_against_a_state(group):
    def driven(height):
        one, state = rod(start=jnp.stack([0 * height, 0 * height, height]))
        path = jaxrod.ramp((0.0, 0.0, 0.0), (0.0, 0.0, 0.1), 1.0)
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

    @jaxrod.pytree
    class Sticky(TouchingRods):
        """A law without anything."""

    law = Sticky(jnp.ones(()), jnp.ones(()))
    with pytest.raises(NotImplementedError, match=f"Sticky has no {hook}: a law of"):
        getattr(law, hook)(*range(arguments))


@pytest.mark.parametrize(
    "function",
    [jaxrod.equilibrium, jaxrod.natural_frequencies, jaxrod.reactions],
)
def test_what_is_known_of_one_rod_alone_says_so(given, function):
    members, state = given
    system = jaxrod.make_system(members)
    with pytest.raises(TypeError, match="got System: this is known of one rod alone"):
        function(system, state)

"""Rods glued side by side: the composite beam, momenta, energy, the bound."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.systems.stepping.assembly import seen_at_rest
from physics.rods import turn
from systems.members import rod, stirred

RADIUS, YOUNG, LENGTH = 0.02, 1e7, 1.0


def two(n=20, gap=2 * RADIUS, effects=None, **law):
    """Two equal rods side by side along x, the second above the first."""
    one, of_one = rod(n, LENGTH, youngs_modulus=YOUNG)
    other, of_other = rod(n, LENGTH, (0, 0, gap), youngs_modulus=YOUNG)
    state = {"low": of_one, "high": of_other}
    listed = (lambda state: ()) if effects is None else effects
    system = jaxrod.make_system(
        {
            "low": jaxrod.make_scene(one, *listed(of_one)),
            "high": jaxrod.make_scene(other, *listed(of_other)),
        },
        jaxrod.systems.glue("low", "high", state, **{"stiffness": 1e5} | law),
    )
    return system, state


def moving(state):
    return {
        "low": stirred(state["low"], 1, 0.2),
        "high": stirred(state["high"], 2, 0.2),
    }


def deflection(load, bending, axial, gap, stiffness):
    """Of a cantilever of two rods with a shear bond, loaded at its end.

    N'' = a^2 N - k d M / B, a^2 = k (d^2 / B + 2 / S): N the axial force between the
    two, B the sum of their bending stiffnesses, S the axial one of each.
    """
    apart = 2 * bending
    together = apart + axial * gap**2 / 2
    square = stiffness * (gap**2 / apart + 2 / axial)
    a = np.sqrt(square)
    share = (gap / apart) / (gap**2 / apart + 2 / axial)
    slip = gap * share / (apart * a**3) * (a * LENGTH - np.tanh(a * LENGTH))
    return load * (LENGTH**3 / (3 * together) + slip), (apart, together)


@pytest.mark.parametrize(("thin", "turning"), [(0.25, None), (1.0, None), (1.0, 30.0)])
def test_glue_is_between_the_surfaces(thin, turning):
    """A rod that turns about its axis pulls on the glue with its own radius.

    Turning stiffness adds the energy of a torsional spring.
    """
    gap = 0.3 * RADIUS
    apart = RADIUS + thin * RADIUS + gap
    one, of_one = rod(4, LENGTH)
    other, of_other = rod(4, LENGTH, (0, 0, apart), radius=thin * RADIUS)
    state = {"low": of_one, "high": of_other}
    system = jaxrod.make_system(
        {"low": jaxrod.make_scene(one), "high": jaxrod.make_scene(other)},
        jaxrod.systems.glue(
            "low", "high", state, stiffness=1e5, turning_stiffness=turning
        ),
    )
    angle = 0.01
    twisted = 0.5 * (turning or 0.0) * LENGTH * angle**2
    about = jnp.asarray([angle] * 4)[None, :] * jnp.asarray([[0.0], [0.0], [1.0]])
    for name, radius in (("low", RADIUS), ("high", thin * RADIUS)):
        own = state[name]
        turned = replace(own, orientations=turn(own.orientations, about))
        energy = system.potential_energy(state | {name: turned})
        moved = 2 * (radius + 0.5 * gap) * np.sin(angle / 2)
        sheared = 0.5 * 1e5 * LENGTH * moved**2
        tolerance = 1e-9 if turning is None else 1e-4
        assert float(energy) == pytest.approx(sheared + twisted, rel=tolerance)


@pytest.mark.slow
@pytest.mark.parametrize("stiffness", [2e4, 1e5, 1e7])
def test_two_glued_rods_bend_as_a_composite_beam(stiffness, record):
    load = 0.05

    def effects(state):
        return (
            jaxrod.clamp(state),
            jaxrod.end_load((0.0, 0.0, -0.5 * load)),
            jaxrod.exponential_damping(12.0),
        )

    system, state = two(20, effects=effects, stiffness=stiffness)
    dt = float(jaxrod.stable_dt(system).dt)
    # Overdamped at about the slowest frequency.
    after = jaxrod.advance(system, state, dt, int(6.0 / dt))
    assert system.kinetic_energy(after) < 1e-12
    beam = system.members["low"].rod
    wanted, (apart, together) = deflection(
        load,
        float(beam.bend_twist_stiffness[0, 0]),
        float(beam.shear_stretch_stiffness[2, 0]),
        2 * RADIUS,
        stiffness,
    )
    found = float(state["low"].tip[2] - after["low"].tip[2])
    assert load / (3 * together) < wanted < load / (3 * apart)
    record(
        f"two glued rods, {stiffness:g} N/m^2: deflection",
        "composite beam with a shear bond",
        abs(found / wanted - 1),
        at_most=0.01,
    )


@pytest.mark.slow
def test_glue_keeps_momenta(record):
    system, rest = two(
        8, stiffness=1e5, damping=50.0, turning_stiffness=20.0, turning_damping=0.01
    )
    state = moving(rest)
    dt = 0.5 * float(jaxrod.stable_dt(system).dt)
    after = jaxrod.advance(system, state, dt, 400)
    assert system.total_energy(after) < system.total_energy(state)
    mass = 2 * float(jnp.sum(system.members["low"].rod.node_masses))
    for function, bar in (
        (jaxrod.System.momentum, 1e-14),
        (jaxrod.System.angular_momentum, 1e-13),
    ):
        change = np.linalg.norm(function(system, after) - function(system, state))
        record(
            f"glued rods with dashpots: {function.__name__.replace('_', ' ')}",
            "as before",
            float(change) / (mass * 0.2),
            at_most=bar,
        )


def test_the_dashpots_couple_is_that_of_the_length_of_each_element():
    """One rod turns evenly about its axis beside one that is still."""
    stiffness, damping, rate, n = 30.0, 0.2, 3.0, 4
    system, rest = two(n, turning_stiffness=stiffness, turning_damping=damping)
    spin = jnp.zeros((3, n)).at[2].set(rate)
    turning = jaxrod.with_angular_velocities(
        system.members["high"].rod, rest["high"], spin
    )
    seen, (bond,) = seen_at_rest(system, rest | {"high": turning})
    loads = bond.loads(seen)
    expected = np.zeros((3, n))
    expected[2] = damping * LENGTH / n * rate
    for name, sign in (("low", 1), ("high", -1)):
        couples = np.stack(loads[name].couples)
        np.testing.assert_allclose(couples, sign * expected, atol=1e-12)


@pytest.mark.slow
def test_loads_are_minus_the_gradient_of_the_energy():
    system, rest = two(4, turning_stiffness=30.0)
    state = jaxrod.advance(system, moving(rest), 1e-4, 60)

    @jax.jit
    def both(state):
        def energy(places):
            moved = {
                name: replace(own, positions=places[name])
                for name, own in state.items()
            }
            seen, (bond,) = seen_at_rest(system, moved)
            return bond.energy(seen)

        seen, (bond,) = seen_at_rest(system, state)
        places = {name: own.positions for name, own in state.items()}
        return jax.grad(energy)(places), bond.loads(seen)

    slopes, loads = both(state)
    for name, slope in slopes.items():
        assert np.max(np.abs(slope)) > 1e-2
        np.testing.assert_allclose(
            np.stack(loads[name].forces), -slope, atol=1e-12 * np.abs(slope).max()
        )


@pytest.mark.slow
def test_energy_is_kept_to_second_order():
    system, rest = two(8, turning_stiffness=30.0)
    state = moving(rest)
    before = float(system.total_energy(state))
    dt = 0.5 * float(jaxrod.stable_dt(system).dt)
    drifts = []
    for parts in (1, 2):
        path = jaxrod.rollout(system, state, dt / parts, 400 * parts, 10 * parts)
        energies = jax.vmap(lambda s: system.total_energy(s))(path)
        drifts.append(float(jnp.max(jnp.abs(energies - before))) / before)
    assert drifts[0] < 0.03
    assert 3.0 < drifts[0] / drifts[1] < 5.5


@pytest.mark.slow
def test_the_bound_is_safe_and_not_far_off(record):
    """Of glue much stiffer than the rods."""
    system, rest = two(6, stiffness=1e8, turning_stiffness=1e4)
    state = moving(rest)
    bound = float(jaxrod.stable_dt(system, 1.0).dt)

    @jax.jit
    def is_stable(dt):
        after = jaxrod.advance(system, state, dt, 2000)
        return system.kinetic_energy(after) < 1.0

    ratios = 0.99 + 0.05 * np.arange(42)
    fine = [bool(is_stable(bound * ratio)) for ratio in ratios]
    assert fine[0]
    record(
        "glue: largest stable step divided by the bound",
        "safe, and sharp within a factor of 2",
        ratios[fine.index(False) - 1],
        between=(0.99, 2.0),
    )


@pytest.mark.slow
def test_gradients_match_differences():
    system, rest = two(4, turning_stiffness=30.0, damping=5.0)
    state = moving(rest)
    dt = 0.5 * float(jaxrod.stable_dt(system).dt)

    def reach(scales):
        (bond,) = system.couplings
        bond = replace(
            bond,
            stiffness=scales[0] * bond.stiffness,
            turning_stiffness=scales[1] * bond.turning_stiffness,
            damping=scales[2] * bond.damping,
        )
        after = jaxrod.advance(replace(system, couplings=(bond,)), state, dt, 40)
        return jnp.sum(after["high"].tip)

    here, h = jnp.ones(3), 1e-4
    gradient = jax.jit(jax.grad(reach))(here)
    function = jax.jit(reach)
    differences = np.array(
        [
            (function(here.at[k].add(h)) - function(here.at[k].add(-h))) / (2 * h)
            for k in range(3)
        ]
    )
    size = np.abs(differences).max()
    np.testing.assert_allclose(gradient, differences, atol=1e-6 * size)
    assert np.all(np.abs(differences) > 1e-5 * size)


@pytest.mark.slow
def test_one_glue_for_several_rods_with_numbers_of_their_own_is_that_of_each():
    """The first two of three rods, each with other elements and a stiff end."""
    one, of_one = rod(8, LENGTH, youngs_modulus=YOUNG)
    members, state = {"low": jaxrod.make_scene(one)}, {"low": stirred(of_one, 1, 0.2)}

    def other(start):
        made, of_made = rod(4, 0.5 * LENGTH, start, youngs_modulus=YOUNG)
        return jaxrod.make_scene(made), of_made

    starts = ((0, 0, 0.05), (0.4, 0, 0.05))
    each = [other(start) for start in starts]
    members["high"], state["high"] = jax.tree.map(lambda *x: jnp.stack(x), *each)
    numbers = {
        "stiffness": np.array([1e5, 1e5, 1e4, 2e4]),
        "turning_stiffness": np.array([1.0, 2.0, 1.0, 2.0]),
        "damping": np.array([3.0, 4.0, 5.0, 6.0]),
        "turning_damping": np.array([0.1, 0.1, 0.2, 0.3]),
    }
    listed = [([0, 1], [0, 1]), ([4, 7], [1, 3])]
    rods = [("high", 0), ("high", 1)]
    together = jaxrod.systems.glue(["low"] * 2, rods, state, elements=listed, **numbers)
    apart = [
        jaxrod.systems.glue(
            "low",
            rods[k],
            state,
            elements=([listed[k][0][j]], [listed[k][1][j]]),
            **{name: row[2 * k + j] for name, row in numbers.items()},
        )
        for k in range(2)
        for j in range(2)
    ]
    moving = state | {"high": jax.vmap(lambda s: stirred(s, 2, 0.2))(state["high"])}
    systems = [
        jaxrod.make_system(members, *glues, state=state)
        for glues in ([together], apart)
    ]
    a, b = (jaxrod.advance(s, moving, 1e-6, 20) for s in systems)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-12), a, b)
    energies = [float(s.potential_energy(a)) for s in systems]
    assert energies[0] == pytest.approx(energies[1], rel=1e-12)
    none = jaxrod.make_system(members, state=state)
    assert energies[0] > 1.01 * float(none.potential_energy(a))
    steps = [float(jaxrod.stable_dt(s).dt) for s in systems]
    assert steps[0] == pytest.approx(steps[1], rel=1e-12)


@pytest.mark.parametrize("listed", [None, [(jnp.array([0, 1]), range(2))]])
def test_glue_of_equal_rods_may_be_made_where_its_numbers_are_traced(listed):
    one, of_one = rod(2, LENGTH)
    scene = jaxrod.make_scene(one)
    members, state = {"low": scene}, {"low": of_one}
    each = [rod(2, LENGTH, start) for start in ((0, 0, 0.05), (0, 0.05, 0))]
    scenes = [(jaxrod.make_scene(made), of_made) for made, of_made in each]
    members["high"], state["high"] = jax.tree.map(lambda *x: jnp.stack(x), *scenes)
    # Its last node alone: the first element stays where it is glued.
    lifted = state["low"].positions.at[2, 2].add(0.01)
    moved = state | {"low": replace(state["low"], positions=lifted)}

    def energy(stiffness):
        made = jaxrod.systems.glue(
            "low", ("high", 1), state, stiffness=stiffness, elements=listed
        )
        return jaxrod.make_system(members, made).potential_energy(moved)

    row = jnp.array([1e3, 2e3])
    slope = jax.jit(jax.grad(energy))(row)
    # Half the length of glue times the square of its gap, half of what the node moved.
    np.testing.assert_allclose(slope, [0, 0.5 * 0.5 * LENGTH * 0.005**2], rtol=1e-9)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    ("names", "options", "words"),
    [
        (("low", "none"), {}, "no member is called 'none'"),
        (("low", "ball"), {}, "'ball' is rigid"),
        (("low", "short"), {}, "4 and 3 elements: say which"),
        (
            ("low", "high"),
            {"elements": ([0], [0, 1])},
            "the same number for both rods, got 1 and 2",
        ),
        (
            ("low", "high"),
            {"elements": ([4], [0])},
            "elements of .*low.* must be at most",
        ),
        (("low", "low"), {}, "glued to itself"),
        (
            ("low", "high"),
            {"stiffness": 0.0},
            r"stiffness must be positive, got 0 N/m\^2",
        ),
        (("low", "high"), {"damping": [1.0, 2.0]}, "damping must"),
        (("low", "high"), {"turning_damping": 1.0}, "turning_stiffness .* is needed"),
        (
            (["low"], ["high"]),
            {"elements": [([0], [0]), ([1], [1])]},
            "elements must be a list .* for each of 1 rods",
        ),
        (
            ("low", "high"),
            {"elements": ([], [])},
            "the same number for both rods, got 0 and 0",
        ),
        (("low", "high"), {"elements": []}, "elements must be a list of .* got"),
        (("low", "high"), {"elements": 3}, "elements must be a list of .* got 3"),
        (("low", "high"), {"elements": [0, 1]}, "elements must be a list of"),
        (("low", "high"), {"elements": ([0], 3)}, "elements must be a list of"),
        (("low", "high"), {"elements": ([0.5], [1])}, "must be an integer, got 0.5"),
    ],
)
def test_bad_input(names, options, words):
    _, state = two(4)
    _, short = rod(3, 0.5)
    _, ball = jaxrod.systems.rigid_body(mass=1.0, inertia=(1, 1, 1), dtype=jnp.float64)
    state = {**state, "short": short, "ball": ball}
    with pytest.raises(ValueError, match=words):
        jaxrod.systems.glue(*names, state, **{"stiffness": 1.0} | options)

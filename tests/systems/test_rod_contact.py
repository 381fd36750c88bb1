"""Contact between rods by the line law: counted once, momentum exact, smooth."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.systems.members.rods import parts_of
from jaxrod.systems.stepping.assembly import seen_at_rest
from systems.members import rod

STIFFNESS = 1e4
RADIUS = 0.02


def touching(a, b, **law):
    """A system of two rods with contact, and its loads in a state."""
    (one, of_one), (two, of_two) = a, b
    system = jaxrod.make_system(
        {"one": jaxrod.make_scene(one), "two": jaxrod.make_scene(two)},
        jaxrod.systems.rod_contact("one", "two", stiffness=STIFFNESS, **law),
    )
    return system, {"one": of_one, "two": of_two}


@jax.jit
def loads_of(system, state):
    seen, (contact,) = seen_at_rest(system, state)
    return contact.loads(seen), contact.energy(seen)


def test_the_bounds_of_springs_and_dashpots_are_those_of_as_much_length():
    """Each node's own, for as many partners, and twice for both rods that move."""
    parts = {"one": parts_of(rod(5, 0.5)[0]), "two": parts_of(rod(8, 0.5)[0])}
    contact = jaxrod.systems.rod_contact(
        "one", "two", stiffness=STIFFNESS, damping=7.0, max_contacts=3
    )
    bounds = contact.fitted(parts, ()).prepared(parts).stability_bounds(parts)
    for name, n in (("one", 5), ("two", 8)):
        lengths = np.full(n + 1, 0.5 / n)
        lengths[[0, -1]] /= 2
        np.testing.assert_allclose(bounds[name].nodes, 6 * STIFFNESS * lengths)
        np.testing.assert_allclose(bounds[name].node_drag, 6 * 7.0 * lengths)
        assert bounds[name].element_drag is None


@pytest.mark.slow
@pytest.mark.parametrize(("n", "m"), [(7, 20), (20, 53)])
def test_parallel_rods_press_alike_on_any_grids(n, m, record):
    """The force is stiffness times depth times length, spread as the grid is."""
    depth = 0.3 * RADIUS
    system, state = touching(rod(n, 0.5), rod(m, 0.5, (0.0, 2 * RADIUS - depth, 0.0)))
    loads, _ = loads_of(system, state)
    force = np.asarray(loads["two"].forces[1])
    other = np.asarray(loads["one"].forces[1])
    assert np.sum(force) == pytest.approx(-np.sum(other), rel=1e-13)
    record(
        f"parallel rods of {n} and {m} elements, force",
        "stiffness times depth times length",
        abs(np.sum(force) / (STIFFNESS * depth * 0.5) - 1),
        at_most=1e-12,
    )
    # Every node takes the load of its own length, to what points between nodes give.
    inner = force[1:-1] / (STIFFNESS * depth * 0.5 / m)
    assert np.max(np.abs(inner - 1)) < 0.08


@pytest.mark.slow
def test_a_crossing_is_counted_once_wherever_it_is(record):
    """Energy of two rods that cross, as one slides along the other over an element."""
    gap = 0.95 * 2 * RADIUS
    energies = []
    system = None
    for shift in np.linspace(0, 0.05, 21):
        system, state = touching(
            rod(10, 0.5),
            rod(10, 0.5, (0.2 + shift, -0.25 + 0.3 * shift, gap), (0, 1, 0)),
        )
        energies.append(float(loads_of(system, state)[1]))
    # The integral over one of the lines of the energy per length.
    along = np.linspace(-0.1, 0.1, 200001)
    distance = np.sqrt(gap**2 + along**2)
    depth = np.maximum(2 * RADIUS - distance, 0)
    expected = np.trapezoid(0.5 * STIFFNESS * depth**2, along)
    energies = np.array(energies) / expected
    record(
        "energy of rods that cross, sliding over an element: ripple",
        "the integral over one line",
        np.ptp(energies) / 2,
        at_most=0.03,
    )
    assert abs(np.mean(energies) - 1) < 0.06


@pytest.mark.slow
def test_collision_keeps_momenta(record):
    """Two rods that spin collide off their middles, with damping and friction."""
    one, of_one = rod(8, 0.4)
    two, of_two = rod(6, 0.3, (0.12, -0.2, 0.041), (0.3, 1, 0.1))
    spin = np.zeros((3, 6))
    spin[2] = 20.0
    of_two = jaxrod.with_angular_velocities(
        two,
        replace(of_two, velocities=of_two.velocities.at[2].set(-0.5)),
        spin,
    )
    system, state = touching(
        (one, of_one), (two, of_two), damping=5.0, friction=0.4, points_per_element=4
    )
    dt = 0.5 * jaxrod.stable_dt(system).dt
    after = jaxrod.advance(system, state, dt, 400)
    force = np.max(np.abs(after["one"].velocities))
    assert force > 0.01
    sizes = {
        jaxrod.System.momentum: np.sum(two.node_masses) * 0.5,
        jaxrod.System.angular_momentum: np.sum(two.node_masses) * 0.5 * 0.3,
    }
    for function, bar in (
        (jaxrod.System.momentum, 1e-14),
        (jaxrod.System.angular_momentum, 1e-13),
    ):
        change = np.linalg.norm(function(system, after) - function(system, state))
        record(
            "collision of two rods with friction and damping",
            function.__name__.replace("_", " "),
            change / sizes[function],
            at_most=bar,
        )


@pytest.mark.slow
def test_contact_of_three_rods_is_that_of_every_two():
    """Of as many elements as differ, so that no load may go to another's segment."""
    made = {
        "one": rod(3, 0.3),
        "two": rod(4, 0.3, (0.1, -0.1, 0.0), (0.1, 1, 0.2)),
        "three": rod(5, 0.3, (0, 0.015, 0.03), (1, 0.1, -0.02)),
    }
    state = {
        name: replace(own, velocities=own.velocities.at[:, 1:].add(0.1 * k))
        for k, (name, (_, own)) in enumerate(made.items())
    }
    law = {"damping": 1.0, "friction": 0.4, "points_per_element": 3}

    def of(*names):
        system = jaxrod.make_system(
            {name: jaxrod.make_scene(made[name][0]) for name in names},
            jaxrod.systems.rod_contact(*names, stiffness=STIFFNESS, **law),
        )
        return loads_of(system, {name: state[name] for name in names})

    loads, energy = of("one", "two", "three")
    pairs = [of("one", "two"), of("one", "three"), of("two", "three")]
    np.testing.assert_allclose(energy, sum(e for _, e in pairs), rtol=1e-13)
    for name, own in loads.items():
        parts = [each[name] for each, _ in pairs if name in each]
        assert len(parts) == 2
        for field in ("forces", "couples"):
            alone = [np.stack(getattr(part, field)) for part in parts]
            assert min(np.max(np.abs(part)) for part in alone) > 1e-6, (name, field)
            np.testing.assert_allclose(
                np.stack(getattr(own, field)), sum(alone), rtol=0, atol=1e-12
            )


@pytest.mark.slow
def test_loads_are_minus_the_gradient_of_the_energy():
    system, state = touching(
        rod(5, 0.3), rod(4, 0.3, (0.1, -0.1, 0.01), (0.1, 1, 0.2)), points_per_element=2
    )

    @jax.jit
    def both(state):
        def energy(positions):
            moved = {
                name: replace(state[name], positions=positions[name]) for name in state
            }
            seen, (contact,) = seen_at_rest(system, moved)
            return contact.energy(seen)

        positions = {name: own.positions for name, own in state.items()}
        return jax.grad(energy)(positions), loads_of(system, state)[0]

    gradient, loads = both(state)
    for name, own in loads.items():
        force = np.stack(own.forces)
        assert np.max(np.abs(force)) > 1e-3
        np.testing.assert_allclose(
            force, -gradient[name], rtol=0, atol=1e-12 * np.max(np.abs(force))
        )


@pytest.mark.slow
def test_gradients_at_first_touch_and_where_centrelines_meet():
    one, of_one = rod(5, 0.3)
    for height in (2 * RADIUS, 0.03, 0.0):
        two, of_two = rod(4, 0.3, (0.1, -0.15, height), (0, 1, 0))
        system, state = touching(
            (one, of_one), (two, of_two), damping=1.0, friction=0.3
        )

        def pushed(lift, system=system, state=state):
            moved = dict(state)
            shift = jnp.zeros((3, 5)).at[2].set(lift)
            moved["two"] = replace(
                state["two"], positions=state["two"].positions + shift
            )
            seen, (contact,) = seen_at_rest(system, moved)
            return contact.loads(seen)["one"].forces[2].sum()

        slope = float(jax.jit(jax.grad(pushed))(0.0))
        assert np.isfinite(slope)
        if height:
            h = 1e-6
            ahead, back = jax.jit(pushed)(h), jax.jit(pushed)(-h)
            scale = STIFFNESS * RADIUS
            assert slope == pytest.approx(
                float((ahead - back) / (2 * h)), rel=1e-4, abs=1e-6 * scale
            )


@pytest.mark.slow
def test_a_loop_pressed_on_itself_does_not_pass_through():
    """A rod bent into a U by its own contact: parts near along the rod see nothing."""
    straight, of_straight = rod(20, 0.5)
    system = jaxrod.make_system(
        {"one": jaxrod.make_scene(straight)},
        jaxrod.systems.rod_contact("one", stiffness=STIFFNESS, self_contact=True),
    )
    loads, energy = loads_of(system, {"one": of_straight})
    assert float(energy) == 0.0
    assert np.max(np.abs(np.stack(loads["one"].forces))) == 0.0
    # A hairpin: two legs 1.8 radii apart, joined by a half circle.
    arc = np.linspace(0, np.pi, 9)
    r = 0.9 * RADIUS
    legs = np.linspace(0.15, 0, 6)[:-1]
    x = np.concatenate([legs, -r * np.sin(arc), legs[::-1]])
    y = np.concatenate([np.full(5, r), r * np.cos(arc), np.full(5, -r)])
    nodes = np.stack([x, y, np.zeros_like(x)])
    hairpin, of_hairpin = jaxrod.rod_along(
        nodes, radius=RADIUS, density=1000.0, youngs_modulus=1e6, dtype=jnp.float64
    )
    bent = jaxrod.make_system(
        {"one": jaxrod.make_scene(hairpin)},
        jaxrod.systems.rod_contact("one", stiffness=STIFFNESS, self_contact=True),
    )
    loads, _ = loads_of(bent, {"one": of_hairpin})
    force = np.stack(loads["one"].forces)
    depth = 2 * RADIUS - 2 * r
    # The tips of the legs push each other apart with the force of the line law.
    assert force[1, 1] / (STIFFNESS * depth * 0.03) == pytest.approx(1, rel=0.02)
    assert np.abs(force.sum(axis=1)).max() < 1e-12 * np.abs(force).max()
    assert force[1, 1] > 0 > force[1, -2]


@pytest.mark.parametrize(
    ("members", "options", "words"),
    [
        (("one", "none"), {}, "no member is called 'none'"),
        (("one",), {}, "nothing to touch but itself"),
        (("one", "one"), {}, "named once"),
        (("one", "two"), {"friction": 0.2}, "friction_drag"),
        (("one", "two"), {"stiffness": -1.0}, "stiffness"),
        (("one", "ball"), {}, "is rigid"),
    ],
)
def test_bad_input(members, options, words):
    one, _ = rod(4, 0.3)
    ball, _ = jaxrod.systems.rigid_body(
        jaxrod.shapes.sphere((0, 0, 1), 0.1), density=1.0, dtype=jnp.float64
    )
    scene = jaxrod.make_scene(one)
    with pytest.raises(ValueError, match=words):
        jaxrod.make_system(
            {"one": scene, "two": scene, "ball": ball},
            jaxrod.systems.rod_contact(*members, **{"stiffness": 1.0} | options),
        )

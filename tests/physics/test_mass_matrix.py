"""Rods whose masses are coupled along elements: smaller errors, the same laws."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import jn_zeros

import jaxrod
from jaxrod import systems
from jaxrod.lanes.choice import lane_mode
from jaxrod.structure import pytree
from physics.rods import arm, deformed, difference, largest, random_rod
from physics.small_motions import held_freedoms, unbalance

G = 9.81  # [m/s^2]
SPEED = np.sqrt(1e7 / 1000.0)  # of waves of stretch in the arm [m/s]


def coupled(rod):
    """The rod with the higher-order mass matrix."""
    return replace(rod, mass_matrix="higher_order")


def uneven(seed, n):
    """A random rod with coupled masses, and its rest state."""
    rod, state = random_rod(seed, n)
    return coupled(rod), state


def mobility(rod):
    """Matrix W from nodal forces to accelerations, written out node by node."""
    masses, n = np.asarray(rod.element_masses), rod.n_elements
    inverse = np.diag(1 / np.asarray(rod.node_masses))
    pairs = np.zeros((n + 1, n + 1))
    for k, mass in enumerate(masses):
        pairs[k : k + 2, k : k + 2] += mass / 12 * np.array([[1, -1], [-1, 1]])
    return inverse + inverse @ pairs @ inverse


def test_masses_of_nodes_do_not_depend_on_direction_or_units():
    rod, _ = uneven(5, 7)
    turned = replace(
        rod,
        linear_density=rod.linear_density[::-1],
        rest_lengths=rod.rest_lengths[::-1],
    )
    np.testing.assert_allclose(turned.node_masses, rod.node_masses[::-1], rtol=1e-14)
    small = replace(rod, rest_lengths=1e-3 * rod.rest_lengths)
    np.testing.assert_allclose(small.node_masses, 1e-3 * rod.node_masses, rtol=1e-14)
    np.testing.assert_allclose(
        rod.node_masses.sum(), rod.element_masses.sum(), rtol=1e-14
    )


def moments(masses, places, pairs=None):
    """Mass, its first moment and its moment of inertia about the origin."""
    inertia = np.sum(masses * places**2)
    if pairs is not None:
        inertia -= np.sum(pairs * np.diff(places) ** 2) / 12
    return np.sum(masses), np.sum(masses * places), inertia


def test_kinetic_energy_is_that_of_the_matrix_written_out():
    rod, state = uneven(3, 4)
    rates = np.random.default_rng(0).normal(size=(3, 5))
    moving = replace(state, velocities=jnp.asarray(rates))
    inverse = mobility(rod)
    free = 0.5 * np.sum(rates * np.linalg.solve(inverse, rates.T).T)
    np.testing.assert_allclose(rod.kinetic_energy(moving), free, rtol=1e-12)
    rates[:, 0] = 0.0
    held = replace(state, velocities=jnp.asarray(rates))
    scene = jaxrod.make_scene(rod, jaxrod.pin_support(state, 0))
    momenta = np.linalg.solve(inverse[1:, 1:], rates[:, 1:].T).T
    expected = 0.5 * np.sum(rates[:, 1:] * momenta)
    np.testing.assert_allclose(scene.kinetic_energy(held), expected, rtol=1e-12)


def test_nodes_at_the_ends_are_lighter_and_their_neighbours_heavier():
    rod, _ = arm(6, mass_matrix="higher_order")
    shares = np.asarray(rod.node_masses / rod.element_masses[0])
    expected = [11 / 24, 25 / 24, 1, 1, 1, 25 / 24, 11 / 24]
    np.testing.assert_allclose(shares, expected, rtol=1e-14)
    stacked = jax.tree.map(lambda a: jnp.stack([a, a]), rod)
    np.testing.assert_array_equal(stacked.node_masses[1], rod.node_masses)


@pytest.mark.parametrize("seed", [1, 2])
def test_mass_and_centre_of_mass_are_those_of_the_elements(seed):
    rod, _ = uneven(seed, 12)
    lengths, masses = np.asarray(rod.rest_lengths), np.asarray(rod.element_masses)
    places = np.concatenate([[0.0], np.cumsum(lengths)])
    whole, first, _ = moments(np.asarray(rod.node_masses), places)
    assert whole == pytest.approx(np.sum(masses), rel=1e-14)
    middles = 0.5 * (places[1:] + places[:-1])
    assert first == pytest.approx(np.sum(masses * middles), rel=1e-14)


def test_moment_of_inertia_of_a_straight_rod_is_right_to_third_order(record):
    errors = []
    for n in (10, 20):
        rod, state = arm(n, mass_matrix="higher_order")
        places = np.asarray(state.positions[2])
        pairs = np.asarray(rod.element_masses)
        mass, _, inertia = moments(np.asarray(rod.node_masses), places, pairs)
        errors.append(inertia / (mass / 3) - 1)
    lumped, _ = arm(10)
    before = moments(np.asarray(lumped.node_masses), np.linspace(0, 1, 11))[2]
    record(
        "Moment of inertia of a straight rod, higher-order masses, n doubled: ratio",
        "8",
        errors[0] / errors[1],
        between=(7.9, 8.1),
    )
    assert abs(errors[0]) < 0.06 * abs(before / mass * 3 - 1)


def stretch(n, kind):
    """Relative error of the first frequency of stretch of a rod pinned at its base."""
    rod, _ = arm(n, mass_matrix=kind)
    springs = np.asarray(rod.shear_stretch_stiffness[2] / rod.rest_lengths)
    apart = np.diff(np.eye(n + 1), axis=0)
    stiffness = apart.T @ np.diag(springs) @ apart
    moved = mobility(rod) if kind != "lumped" else np.diag(1 / rod.node_masses)
    squares = np.linalg.eigvals(moved[1:, 1:] @ stiffness[1:, 1:]).real
    return abs(np.sqrt(np.min(squares)) / (0.5 * np.pi * SPEED) - 1)


def swing(n, kind):
    """Relative error of the first frequency of a chain that hangs from its base."""
    rod, _ = arm(n, mass_matrix=kind)
    masses = np.asarray(rod.node_masses)
    tensions = G * np.cumsum(masses[::-1])[::-1][1:]
    apart = np.diff(np.eye(n + 1), axis=0)
    stiffness = apart.T @ np.diag(tensions * n) @ apart
    moved = mobility(rod) if kind != "lumped" else np.diag(1 / masses)
    squares = np.linalg.eigvals(moved[1:, 1:] @ stiffness[1:, 1:]).real
    return abs(np.sqrt(np.min(squares)) / (0.5 * jn_zeros(0, 1)[0] * np.sqrt(G)) - 1)


def test_the_swing_of_a_chain_converges_faster_than_with_lumped_masses(record):
    lumped, coarse, fine = (
        swing(n, kind)
        for n, kind in ((25, "lumped"), (25, "higher_order"), (50, "higher_order"))
    )
    record(
        "First frequency of a hanging chain, n = 25, ratio of the errors with "
        "higher-order and lumped masses",
        "Bernoulli's chain",
        coarse / lumped,
        at_most=0.03,
    )
    record(
        "First frequency of a hanging chain, higher-order masses, n doubled: ratio",
        "8",
        coarse / fine,
        between=(7, 9),
    )


@pytest.mark.slow
@pytest.mark.parametrize("clamped", [False, True], ids=["free", "clamped"])
def test_bending_has_smaller_errors_than_with_lumped_masses(clamped, record):
    def first(n, kind):
        rod, state = arm(n, radius=0.02, mass_matrix=kind)
        walls = [jaxrod.clamp(state)] if clamped else []
        scene = jaxrod.make_scene(rod, *walls)
        return jaxrod.natural_frequencies(scene, state, 8)[0 if clamped else 6]

    coarse, fine = first(30, "lumped"), first(60, "lumped")
    exact = fine + (fine - coarse) / 3
    for kind, bar in (("lumped", 0.05), ("higher_order", 0.011)):
        record(
            f"First bending of a {'clamped' if clamped else 'free'} rod, n = 10, "
            f"{kind.replace('_', '-')} masses: frequency",
            "extrapolated from n = 30 and 60",
            abs(first(10, kind) / exact - 1),
            at_most=bar,
        )


def test_waves_of_stretch_converge_faster_than_with_lumped_masses(record):
    lumped, coarse, fine = (
        stretch(n, kind)
        for n, kind in ((8, "lumped"), (8, "higher_order"), (16, "higher_order"))
    )
    record(
        "First frequency of stretch, n = 8, ratio of the errors with higher-order "
        "and lumped masses",
        "0",
        coarse / lumped,
        at_most=0.02,
    )
    assert coarse / fine > 7.5


@pytest.mark.slow
def test_natural_frequencies_are_those_of_the_matrix_written_out():
    rod, state = uneven(3, 5)
    scene = jaxrod.make_scene(rod, jaxrod.pin_support(state, 0))
    lumped = jaxrod.make_scene(
        replace(rod, mass_matrix="lumped"), jaxrod.pin_support(state, 0)
    )
    assert scene.rod.node_masses[0] != lumped.rod.node_masses[0]
    nodes, elements = 3 * 6, 3 * 5
    inertia = np.ravel(rod.principal_inertias)
    matrix = np.zeros((nodes + elements,) * 2)
    for axis in range(3):
        here = slice(6 * axis, 6 * axis + 6)
        matrix[here, here] = mobility(rod)
    matrix[nodes:, nodes:] = np.diag(1 / inertia)
    stiffness = np.asarray(unbalance(scene, state)[1])
    free = held_freedoms(rod)
    product = matrix[np.ix_(free, free)] @ stiffness[np.ix_(free, free)]
    expected = np.sqrt(np.maximum(np.sort(np.linalg.eigvals(product).real), 0))
    found = jaxrod.natural_frequencies(scene, state)
    np.testing.assert_allclose(found[3:], expected[3:], rtol=1e-6)
    fastest = jaxrod.highest_frequency(scene, state)
    assert float(fastest) == pytest.approx(expected[-1], rel=1e-2)


@pytest.mark.parametrize(
    "method",
    ["consistent", pytest.param("torsion_free", marks=pytest.mark.slow)],
)
def test_a_free_rod_keeps_momentum_and_angular_momentum(method):
    if method == "consistent":
        rod, _ = uneven(5, 8)
    else:
        rod, _ = arm(8, mass_matrix="higher_order")
    scene = jaxrod.make_scene(rod, method=getattr(jaxrod, method)())
    state = deformed(rod, 5, largest_angle=0.3, largest_strain=0.05, speed=0.3)
    dt = jaxrod.stable_dt(scene, 0.5).dt
    state = jaxrod.advance(scene, state, dt, 1)
    after = jaxrod.advance(scene, state, dt, 2000)
    assert largest(after.positions - state.positions) > 0.1
    for quantity in (scene.momentum, scene.angular_momentum):
        before = quantity(state)
        size = float(jnp.linalg.norm(before))
        assert largest(quantity(after) - before) < 1e-12 * size
    # With lumped masses angular momentum would not be constant.
    plain = replace(rod, mass_matrix="lumped")
    if method == "consistent":
        before, now = plain.angular_momentum(state), plain.angular_momentum(after)
        assert largest(now - before) > 1e-6 * largest(before)


@pytest.mark.parametrize(
    "damping",
    [
        jaxrod.internal_damping(0.01),
        pytest.param(jaxrod.short_wave_damping(1e4), marks=pytest.mark.slow),
    ],
)
def test_damping_of_deformation_keeps_momenta_and_never_adds_energy(damping):
    rod, _ = uneven(5, 6)
    scene = jaxrod.make_scene(rod, damping)
    state = deformed(rod, 5, largest_angle=0.3, largest_strain=0.05, speed=0.3)
    after = jaxrod.step(scene, state, 1e-3 * float(jaxrod.stable_dt(scene).dt))
    for quantity in (scene.momentum, scene.angular_momentum):
        before = quantity(state)
        assert largest(quantity(after) - before) < 1e-13 * largest(before)
    noise = replace(state, velocities=jnp.sin(jnp.arange(21.0) ** 2).reshape(3, 7))
    dt = jaxrod.stable_dt(scene, 0.5).dt
    after = jaxrod.step(scene, noise, dt)
    assert scene.total_energy(after) < scene.total_energy(noise)


@pytest.mark.slow
@pytest.mark.parametrize("wall", [False, True])
def test_energy_varies_with_the_square_of_the_step_and_has_no_trend(wall):
    rod, rest = uneven(5, 6)
    supports = [jaxrod.clamp(rest)] if wall else []
    scene = jaxrod.make_scene(rod, *supports)
    free = jaxrod.make_scene(rod, *supports)
    state = replace(
        rest,
        velocities=0.3 * jnp.sin(jnp.arange(21.0)).reshape(3, 7).at[:, 0].set(0),
    )
    dt = float(jaxrod.stable_dt(free, 0.5).dt)
    worst = []
    for parts in (1, 2):
        states = jaxrod.rollout(scene, state, dt / parts, 4000 * parts, 40 * parts)
        energies = np.asarray(jax.vmap(scene.total_energy)(states))
        change = energies / float(scene.total_energy(state)) - 1
        worst.append(np.max(np.abs(change)))
        slope = np.polyfit(np.linspace(0, 1, change.size), change, 1)[0]
        assert abs(slope) < 0.5 * worst[-1]
    assert worst[0] < 0.1
    assert 3 < worst[0] / worst[1] < 5


def excursion(scene, state, dt):
    """Largest displacement after noise of 1e-8 and 1500 steps [m]."""
    noise = 1e-8 * jax.random.normal(jax.random.key(0), state.positions.shape)
    disturbed = replace(state, positions=state.positions + noise.at[:, 0].set(0))
    after = jaxrod.advance(scene, disturbed, dt, 1500)
    return largest(after.positions - state.positions)


# A step above the bound is one of the two that are compared.
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::jaxrod.UnstableStepWarning")
@pytest.mark.parametrize("radius", [0.01, 0.05, 0.3])
def test_the_stable_step_is_a_bound_and_nearly_the_limit(radius):
    rod, state = arm(12, radius=radius, mass_matrix="higher_order")
    scene = jaxrod.make_scene(rod, jaxrod.pin_support(state, 0))
    bound = jaxrod.stable_dt(scene, 1.0)
    true = float(jaxrod.natural_frequencies(scene, state)[-1])
    assert 0.97 < true / float(bound.angular_frequency) <= 1 + 1e-9
    assert excursion(scene, state, bound.dt) < 1e-6
    blown = excursion(scene, state, 1.1 * 2 / true)
    assert not blown < 1e-2
    lumped = jaxrod.stable_dt(replace(scene, rod=replace(rod, mass_matrix="lumped")), 1)
    assert 0.865 < float(bound.dt / lumped.dt) < 1


@pytest.mark.slow
def test_the_stable_step_is_a_bound_on_random_rods(record):
    ratios = []
    for seed in range(12):
        rod, state = uneven(seed, (2, 7, 20)[seed % 3])
        scene = jaxrod.make_scene(rod)
        true = jaxrod.natural_frequencies(scene, state)[-1]
        ratios.append(float(true / jaxrod.stable_dt(scene, 1.0).angular_frequency))
        assert excursion(scene, state, jaxrod.stable_dt(scene, 1.0).dt) < 1e-6
    record(
        "Highest frequency over its bound, higher-order masses, 12 random rods",
        "1",
        max(ratios),
        at_most=1 + 1e-9,
    )
    assert min(ratios) > 0.85


@pytree
class Slowing(jaxrod.extend.Effect):
    """Drag in proportion to the velocity of each node, as a load."""

    drag_of_nodes: jax.Array  # [kg/s]

    def loads(self, rod, motion):
        """The force of each node."""
        return jaxrod.extend.Loads(
            tuple(-self.drag_of_nodes * one for one in motion.velocity)
        )

    def stability_bound(self, rod):
        """The same drag at all nodes."""
        drag = jnp.full(rod.n_elements + 1, self.drag_of_nodes)
        return jaxrod.extend.StabilityBound(node_drag=drag)


def test_the_stable_step_is_a_bound_with_drag_among_the_loads():
    rod, state = arm(6, mass_matrix="higher_order", youngs_modulus=1e3)
    scene = jaxrod.make_scene(rod, Slowing(jnp.asarray(1e3)))
    zigzag = replace(state, velocities=state.velocities.at[1, ::2].set(1e-9))
    after = jaxrod.advance(scene, zigzag, 0.99 * jaxrod.stable_dt(scene, 1.0).dt, 100)
    assert largest(after.velocities) < 1e-9


def swinging(method, mass_matrix="higher_order", *more):
    """A rod in a vertical plane, pinned, under gravity, released aside."""
    rod, _ = jaxrod.straight_rod(
        8, length=1.0, radius=0.01, density=1e3, youngs_modulus=1e6,
        direction=(1.0, 0.0, 0.0), mass_matrix=mass_matrix, dtype=jnp.float64,
    )  # fmt: skip
    bent = np.stack(
        [np.linspace(0, 0.9, 9), np.zeros(9), -(np.linspace(0, 0.6, 9) ** 2)]
    )
    _, state = jaxrod.rod_along(
        bent, radius=0.01, density=1e3, youngs_modulus=1e6, dtype=jnp.float64
    )
    effects = (jaxrod.pin_support(state, 0), jaxrod.gravity(), *more)
    return jaxrod.make_scene(rod, *effects, method=method), state


@pytest.mark.slow
def test_methods_agree_on_a_rod_in_a_plane():
    damping, drag = (
        jaxrod.exponential_damping(0.5),
        jaxrod.fluids.stokes_drag(0.05, 0.1),
    )
    ends = []
    for method in (jaxrod.consistent(), jaxrod.planar("zx"), jaxrod.torsion_free()):
        scene, state = swinging(method, "higher_order", damping, drag)
        dt = float(jaxrod.stable_dt(scene, 0.5).dt)
        ends.append(jaxrod.advance(scene, state, dt, 500))
    scene, state = swinging(jaxrod.consistent(), "lumped", damping, drag)
    lumped = jaxrod.advance(scene, state, dt, 500)
    assert difference(ends[1].positions, ends[0].positions) < 1e-11
    assert difference(ends[2].positions, ends[0].positions) < 1e-9
    assert difference(lumped.positions, ends[0].positions) > 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("method", [jaxrod.consistent(), jaxrod.planar("zx")])
def test_a_rod_in_free_fall_falls_as_one(method):
    rod, state = uneven(2, 6) if method == jaxrod.consistent() else arm(
        6, mass_matrix="higher_order"
    )  # fmt: skip
    scene = jaxrod.make_scene(rod, jaxrod.gravity((3.0, 0.0, -9.0)), method=method)
    dt = float(jaxrod.stable_dt(scene).dt)
    after = jaxrod.advance(scene, state, dt, 50)
    expected = np.array([3.0, 0.0, -9.0])[:, None] * 50 * dt * np.ones((3, 7))
    np.testing.assert_allclose(after.velocities, expected, atol=1e-9)


@pytree
class Fall(jaxrod.schedules.Schedule):
    """Free fall from rest."""

    def __call__(self, clock):
        zero = jnp.zeros_like(clock.time)
        return jnp.stack([zero, zero, -4.5 * clock.time**2])

    @property
    def largest(self):
        return jnp.ones(3)


def test_a_driven_end_passes_its_own_acceleration_on():
    """A rod whose end is driven as the rod falls does not notice the drive."""
    rod, state = arm(6, mass_matrix="higher_order")
    scene = jaxrod.make_scene(
        rod,
        jaxrod.gravity((0.0, 0.0, -9.0)),
        jaxrod.driven(state, displacement=Fall(), free_to_turn=True),
    )
    after = jaxrod.advance(scene, state, 1e-4, 200)
    np.testing.assert_allclose(after.velocities[2], -9.0 * 0.02, rtol=1e-4)


@pytest.mark.slow
def test_reactions_balance_the_change_of_momentum():
    scene, state = swinging(jaxrod.consistent())
    dt = 1e-5
    moving = jaxrod.advance(scene, state, 1e-4, 300)
    later = jaxrod.advance(scene, moving, dt, 1)
    change = (scene.momentum(later) - scene.momentum(moving)) / dt
    weight = jnp.array([0.0, 0.0, -9.80665]) * jnp.sum(scene.rod.node_masses)
    before, after = (jaxrod.reactions(scene, s)[0].force for s in (moving, later))
    np.testing.assert_allclose(change, weight + 0.5 * (before + after), atol=1e-4)


@pytest.mark.slow
def test_the_gradient_is_that_of_differences():
    scene, state = swinging(jaxrod.planar("zx"))
    dt = 0.5 * float(jaxrod.stable_dt(scene).dt)

    def reach(factor):
        rod = replace(scene.rod, linear_density=factor * scene.rod.linear_density)
        after = jaxrod.advance(replace(scene, rod=rod), state, dt, 100)
        return after.tip[0] + scene.kinetic_energy(after)

    factors = jnp.linspace(1.0, 1.1, 8)
    way = jnp.cos(jnp.arange(8.0))
    slope = jnp.sum(jax.jit(jax.grad(reach))(factors) * way)
    one, other = (jax.jit(reach)(factors + h * way) for h in (1e-5, -1e-5))
    assert float(slope) == pytest.approx(float((one - other) / 2e-5), rel=1e-6)


def test_what_divides_forces_by_single_masses_refuses_coupled_ones():
    rod, state = arm(3, mass_matrix="higher_order")
    for method in (
        jaxrod.pyelastica(),
        jaxrod.implicit(),
        jaxrod.planar("zx", jaxrod.pyelastica()),
    ):
        with pytest.raises(ValueError, match="divides the force on each node"):
            jaxrod.make_scene(rod, method=method)
    scene = jaxrod.make_scene(rod)
    late = replace(scene, method=jaxrod.pyelastica())
    with pytest.raises(ValueError, match="divides the force on each node"):
        jaxrod.advance(late, state, 1e-6, 1)
    with pytest.raises(ValueError, match=r"member 'a': .*divides the force"):
        jaxrod.make_system({"a": late})
    with pytest.raises(ValueError, match='mass_matrix must be "lumped" or'):
        arm(3, mass_matrix="consistent")


def test_joints_that_hold_exactly_refuse_coupled_masses():
    rod, state = arm(3, mass_matrix="higher_order")
    scene, plain = jaxrod.make_scene(rod), jaxrod.make_scene(arm(3)[0])
    states = {"a": state, "b": state, "c": state}
    joint = systems.tie(("a", "tip"), ("b", "tip"), states)
    with pytest.raises(ValueError, match=r"Tie holds nodes exactly.*'b'"):
        jaxrod.make_system({"a": plain, "b": scene, "c": plain}, joint)
    # Other rods of the system are nothing to the joint.
    jaxrod.make_system({"a": plain, "b": plain, "c": scene}, joint)


@pytest.mark.slow
def test_rods_in_a_system_exchange_momentum_and_lose_none():
    rod, state = arm(5, mass_matrix="higher_order")
    scene = jaxrod.make_scene(rod)
    moving = replace(state, velocities=state.velocities.at[0].add(0.3))
    states = {
        "one": moving,
        "other": replace(state, positions=state.positions.at[0].add(0.1)),
    }
    spring = systems.spring(("one", "tip"), ("other", "tip"), states, stiffness=1e3)
    system = jaxrod.make_system({"one": scene, "other": scene}, spring)
    dt = jaxrod.stable_dt(system, 0.5).dt
    after = jaxrod.advance(system, states, dt, 300)
    assert largest(after["other"].velocities) > 1e-2
    for quantity in (system.momentum, system.angular_momentum):
        assert difference(quantity(after), quantity(states)) < 1e-12
    energies = [float(system.total_energy(s)) for s in (states, after)]
    assert energies[1] == pytest.approx(energies[0], rel=1e-2)


@pytest.mark.slow
def test_kernels_step_coupled_masses_like_xla(request):
    request.addfinalizer(partial(jaxrod.use_lanes, lane_mode()))
    scene, state = swinging(jaxrod.planar("zx"))
    ends = []
    for mode in ("never", "rows", "always", "loops"):
        jaxrod.use_lanes(mode)
        ends.append(jaxrod.advance(scene, state, 1e-4, 200))
        assert mode == "never" or jaxrod.lane_choices()[-1].taken
    assert all(difference(ends[0], end) < 1e-12 for end in ends[1:])


@pytest.mark.slow
def test_resampled_rods_keep_their_mass_matrix():
    scene, state = swinging(jaxrod.consistent())
    finer, _ = jaxrod.resample(scene, state, 12)
    assert finer.rod.mass_matrix == "higher_order"


@pytest.mark.slow
def test_tune_finds_fewer_elements_for_a_swing():
    """A rope: the coupled masses need no more elements than lumped ones."""
    counts = []
    for kind in ("lumped", "higher_order"):
        rod, state = jaxrod.straight_rod(
            20, length=1.0, radius=0.01, density=1000.0, youngs_modulus=1e6,
            direction=(1.0, 0.0, 0.0), mass_matrix=kind,
        )  # fmt: skip
        scene = jaxrod.make_scene(rod, jaxrod.clamp(state), jaxrod.gravity())
        found = jaxrod.tune(scene, state, duration=0.2, max_error=1e-3)
        assert found.prepared.scene.rod.mass_matrix == kind
        counts.append(found.prepared.scene.rod.n_elements)
    assert counts[1] <= counts[0]

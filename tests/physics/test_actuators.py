"""Laws of every actuator: energy, momentum, bounds, gradients, batches."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.actuation.section_load import cross_bound, fibre_bound, transport_bound
from jaxrod.effects.time import Clock
from jaxrod.geometry import vectors
from jaxrod.lanes.jaxpr.unroll import supported
from jaxrod.rods.motion import motion_of
from physics.actuators import N, actuators, at_once, strained, uneven_rod
from physics.rods import (
    AREA,
    RADIUS,
    YOUNG,
    arm,
    difference,
    largest,
    no_moves,
    perturb,
)

NAMES = (
    "wave of bending",
    "longitudinal muscles",
    "helical muscles",
    "muscle across",
    "chambers",
    "wound chambers",
    "tendon pulled with a force",
    "tendon on a winch",
    "active shape",
    "magnet in a uniform field",
    "magnet in a nonuniform field",
)
QUICK = ("longitudinal muscles", "tendon on a winch", "magnet in a nonuniform field")


def look(effects, rod, state):
    """Loads of effects and the slopes of their energies."""
    found = []
    for effect in effects:
        slopes = jax.grad(
            lambda moves, effect=effect: effect.energy(rod, perturb(state, moves))
        )(no_moves(state))
        loads = effect.loads(rod, motion_of(state))
        still = jnp.zeros_like(state.positions)
        forces = still if loads.forces is None else vectors.join(loads.forces)
        found.append((forces, vectors.join(loads.couples), *slopes))
    return found


def check_energy(names, record):
    """The bar of loads against energies; one program for all of them."""
    rod, rest, state = uneven_rod()
    every = actuators(rod, rest)
    assert tuple(every) == NAMES
    effects = at_once(tuple(every[name] for name in names))
    quickly = {"xla_backend_optimization_level": 0}
    found = jax.jit(look, compiler_options=quickly)(effects, rod, state)
    for name, arrays in zip(names, found, strict=True):
        forces, couples, by_place, by_turn = map(np.asarray, arrays)
        size = max(np.max(np.abs(forces)), np.max(np.abs(couples)))
        assert size > 1e-6
        gaps = np.max(np.abs(forces + by_place)), np.max(np.abs(couples + by_turn))
        record(
            f"Loads, compared with minus the gradient of the energy: {name}",
            "automatic differentiation",
            max(gaps) / size,
            at_most=1e-12,
        )


def test_loads_are_minus_the_gradient_of_the_energy(record):
    check_energy(QUICK, record)


@pytest.mark.slow
def test_loads_of_all_are_minus_the_gradient_of_the_energy(record):
    check_energy([name for name in NAMES if name not in QUICK], record)


@pytest.mark.slow
def test_actuators_keep_momentum_and_angular_momentum(record):
    """All of them at once in a free rod, wave and schedules of time included."""
    rod, rest, state = uneven_rod()
    inner = [
        replace(effect, walls=()) if hasattr(effect, "walls") else effect
        for name, effect in actuators(rod, rest).items()
        if not name.startswith("magnet")
    ]
    inner = [replace(e, anchors=None) if hasattr(e, "anchors") else e for e in inner]
    friction = jaxrod.actuation.tendon(
        rod, (0.02, 0.01), tension=10.0, friction=0.3, slip_speed=0.1
    )
    couples = jaxrod.actuation.muscle_torques(
        rod, 5.0, period=0.1, wave_number=6.0, direction=(0.0, 1.0, 0.0)
    )
    scene = jaxrod.make_scene(rod, *inner, friction, couples)
    before = np.concatenate(totals(rod, state))
    after = jaxrod.advance(scene, state, 1e-5, 1000)
    change = np.concatenate(totals(rod, after)) - before
    moved = np.max(np.abs(after.angular_momenta - state.angular_momenta))
    size = max(np.max(np.abs(before)), moved)
    assert jnp.all(jnp.isfinite(after.positions)) and moved > 0
    record(
        "Momentum and angular momentum of a free rod, all actuators, 1000 steps",
        "constant",
        np.max(np.abs(change)) / size,
        at_most=1e-12,
    )


def totals(rod, state):
    """Momentum and angular momentum."""
    return rod.momentum(state), rod.angular_momentum(state)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_the_stable_step_knows_of_them(name, record):
    rod, rest, state = uneven_rod()
    effect = at_once(actuators(rod, rest)[name])
    scene = jaxrod.make_scene(rod, effect)
    bound = float(jaxrod.stable_dt(scene, 1.0).dt)
    limit = 2 / float(jaxrod.highest_frequency(scene, rest))
    record(
        f"Stable step divided by the true limit: {name}",
        "2/omega_max, measured",
        bound / limit,
        between=(0.25, 1.0),
    )
    # Deformed by a radian at joints and a fifth in length: within the safety factor.
    assert 0.8 * bound * float(jaxrod.highest_frequency(scene, state)) < 2


def test_bounds_of_fibres_are_those_from_the_other_end():
    """A rod whose elements differ has all values the other way round."""
    rod, *_ = uneven_rod()
    random = np.random.default_rng(0)
    size = random.uniform(0.5, 1, (4, 2, N + 1))
    flip = lambda tree: jax.tree.map(lambda leaf: leaf[..., ::-1], tree)
    for bound, arguments in (fibre_bound, size), (cross_bound, size[:1, 0]):
        one = bound(rod, *jnp.asarray(arguments))
        two = bound(flip(rod), *jnp.asarray(arguments[..., ::-1]))
        assert difference(flip(two), one) < 1e-13 * largest(one)


def test_moments_that_turn_with_a_rod_are_bounded_by_those_of_both_joints():
    """Sizes of the moments at both ends of each element add up."""
    rod, *_ = uneven_rod()
    moments = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, N + 1))
    bound = transport_bound(rod, moment=moments)
    for i in range(N):
        largest_moment = abs(moments[i]) + abs(moments[i + 1])
        np.testing.assert_allclose(bound.elements[i], largest_moment, rtol=1e-12)
    assert bound.nodes is None


@pytest.mark.slow
def test_muscles_that_have_shortened_are_stiffer_and_the_bound_knows(record):
    """The curve is steepest at a stretch of 0.6."""
    rod, _ = arm(8)
    pull = 0.1 * YOUNG * AREA
    muscles = jaxrod.actuation.muscle(
        rod, pull, offsets=0.6 * RADIUS * np.array([[1.0, 0.0], [-1.0, 0.0]])
    )
    scene = jaxrod.make_scene(rod, muscles)
    short = strained(rod, (0.0, 0.0, 0.0), -0.35)
    limit = 2 / float(jaxrod.highest_frequency(scene, short))
    record(
        "Stable step divided by the true limit: two muscles, shortened by 0.35",
        "2/omega_max, measured",
        float(jaxrod.stable_dt(scene, 1.0).dt) / limit,
        between=(0.5, 1.0),
    )


def numbered(drive):
    """A scene in which four actuators are as strong as four numbers say."""
    rod, state = arm(4, youngs_modulus=1e6)
    wall = jaxrod.clamp(state)
    pull, area = 0.02 * 1e6 * AREA, 0.1 * AREA
    return state, jaxrod.make_scene(
        rod,
        wall,
        jaxrod.actuation.muscle(
            rod, pull, drive[0], offsets=(0.6 * RADIUS, 0.0), into=wall
        ),
        jaxrod.actuation.tendon(
            rod, (0.0, RADIUS), tension=pull * drive[1], friction=0.1
        ),
        jaxrod.actuation.chamber(
            rod, pull / area * drive[2], area, offsets=(0.0, -0.5 * RADIUS)
        ),
        jaxrod.actuation.magnetisation(
            rod, (0.0, 0.0, pull), (0.3 * drive[3], 0.0, 0.0)
        ),
        jaxrod.actuation.travelling_wave(
            rod, 0.1 * pull * drive[0] * np.ones(5), period=0.1, wavelength=0.5
        ),
    )


DRIVE = jnp.asarray([0.7, 0.6, 0.4, 1.0])


def tip_in_motion(drive):
    """A mixture of the tip's coordinates after some steps."""
    state, scene = numbered(drive)
    tip = jaxrod.advance(scene, state, 2e-4, 40).tip
    return tip[0] + 2 * tip[1] - tip[2]


def tip_at_rest(drive):
    """The same in equilibrium, where less will do."""
    state, scene = numbered(0.1 * drive)
    tip = jaxrod.equilibrium(scene.at(0.03), state, tolerance=1e-12).state.tip
    return tip[0] + 2 * tip[1] - tip[2]


@pytest.mark.slow
@pytest.mark.parametrize("of", [tip_in_motion, tip_at_rest])
def test_gradients_by_what_drives_them_agree_with_differences(of, record):
    run, slope = jax.jit(of), jax.jit(jax.grad(of))(DRIVE)
    step = 1e-5
    moves = step * jnp.eye(4)
    differences = [
        float(run(DRIVE + move) - run(DRIVE - move)) / (2 * step) for move in moves
    ]
    assert np.min(np.abs(differences)) > 1e-7
    gap = np.max(np.abs(np.asarray(slope) - differences))
    record(
        f"Gradient with respect to activation, tension, pressure, field: {of.__name__}",
        "central differences",
        gap / np.max(np.abs(differences)),
        at_most=1e-6,
    )


@pytest.mark.slow
def test_a_batch_is_a_loop():
    drives = DRIVE[None, :] * jnp.asarray([[0.5], [1.0], [1.5]])
    run = jax.jit(tip_in_motion)
    together = jax.vmap(tip_in_motion)(drives)
    one_by_one = jnp.stack([run(drive) for drive in drives])
    np.testing.assert_allclose(together, one_by_one, rtol=1e-11, atol=1e-14)


def test_a_wave_keeps_its_phase_for_millions_of_periods():
    """In single precision, where time itself has lost it."""
    rod, _ = arm(4, jnp.float32)
    wave = jaxrod.actuation.travelling_wave(rod, 1.0, period=1.25e-2, wavelength=0.7)
    step = 2_000_000_007
    then = wave.moments(Clock(jnp.int32(step), jnp.float32(0.5), jnp.float32(1e-3)))
    turns = (step + 0.5) * float(np.float32(1e-3)) / float(np.float32(1.25e-2))
    exact = np.sin(2 * np.pi * (turns % 1 - np.arange(5) / 4 / 0.7))
    np.testing.assert_allclose(then, exact, atol=1e-4)


@pytest.mark.slow
def test_friction_holds_tension_back_by_eulers_law():
    """A bent rod whose tendon is drawn in: the tension behind is exp(-mu theta)."""
    rod, _ = arm(6)
    state = strained(rod, (0.0, 1.5, 0.0), 0.0)
    # Everything shrinks towards the first element: the cable slips to its base.
    moving = replace(state, velocities=-(state.positions - state.positions[:, :1]))
    cable = jaxrod.actuation.tendon(
        rod, (0.0, 0.0), tension=10.0, friction=0.4, slip_speed=1e-9
    )
    motion = motion_of(moving)
    forces = vectors.join(cable.loads(rod, motion).forces)
    # The last element is pulled by the last piece alone: half of it at each node.
    last = 2 * np.linalg.norm(forces[:, -1])
    turned = 4 * 1.5 / 6
    assert last == pytest.approx(10.0 * np.exp(-0.4 * turned), rel=1e-12)
    np.testing.assert_allclose(np.sum(forces, axis=1), 0, atol=1e-12)


def test_a_slack_tendon_pulls_nothing():
    rod, state = arm(4)
    motion = motion_of(state)
    for length, pull in ((0.7, 5.0), (0.8, 0.0)):
        cable = jaxrod.actuation.tendon(
            rod, (0.01, 0.0), length=length, stiffness=100.0, onset=1e-3
        )
        forces = cable.loads(rod, motion).forces
        # Eyelets at middles: the cable is 0.75 m long.
        assert float(jnp.sum(jnp.abs(forces[2]))) == pytest.approx(2 * pull, abs=1e-9)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_the_gaussian_curve_and_its_slopes(dtype):
    """Force and slope have their closed forms, and programs that kernels can run."""
    width = 0.2
    curve = jaxrod.actuation.gaussian_force(width)
    curve = replace(curve, width=curve.width.astype(dtype))
    force = jax.grad(curve.energy)
    slope = jax.grad(force)
    values = jax.jit(jax.vmap(lambda s: (curve.energy(s), force(s), slope(s))))
    stretch = np.linspace(0.3, 1.9, 17, dtype=dtype)
    found = values(stretch)
    assert {one.dtype for one in found} == {jnp.dtype(dtype)}
    away = (np.linspace(0.3, 1.9, 17) - 1) / width
    gaussian = np.exp(-(away**2) / 2)
    eps = float(jnp.finfo(dtype).eps)
    np.testing.assert_allclose(found[1], gaussian, rtol=20 * eps, atol=20 * eps)
    np.testing.assert_allclose(found[2], -away / width * gaussian, atol=200 * eps)
    if dtype == jnp.float64:
        up, down = values(stretch + 1e-4), values(stretch - 1e-4)
        for i in (0, 1):
            differences = np.subtract(up[i], down[i]) / 2e-4
            np.testing.assert_allclose(found[i + 1], differences, atol=2e-6)
    assert supported(jax.make_jaxpr(slope)(stretch[0])) is None


@pytest.mark.slow
def test_curves_of_muscles_are_smooth_and_integrate_their_slope():
    single = jnp.float32(0.9)
    assert jaxrod.actuation.cubic_force().energy(single).dtype == single.dtype
    stretch = jnp.linspace(0.3, 2.2, 4001)
    for curve in (jaxrod.actuation.cubic_force(), jaxrod.actuation.gaussian_force(0.2)):
        share = jax.vmap(jax.grad(curve.energy))(stretch)
        slope = np.diff(share) / np.diff(stretch)
        assert np.max(np.abs(slope)) <= float(curve.steepest) * (1 + 1e-3)
        assert 0.98 < np.max(share) <= float(curve.largest) + 1e-6
        # No kink: the slope changes by little from each place to the next.
        assert np.max(np.abs(np.diff(slope))) < 0.1
        assert np.min(share) >= 0
        total = np.trapezoid(share, stretch)
        change = curve.energy(stretch[-1]) - curve.energy(stretch[0])
        assert total == pytest.approx(float(change), rel=1e-5)
    cubic = jax.grad(jaxrod.actuation.cubic_force().energy)(0.9)
    assert float(cubic) == pytest.approx(np.polyval([3.06, -13.64, 18.01, -6.44], 0.9))


BAD = {
    "amplitude must be one number, or 4": lambda r: jaxrod.actuation.travelling_wave(
        r, (1.0, 2.0), period=1.0, wavelength=1.0
    ),
    "period must be positive": lambda r: jaxrod.actuation.travelling_wave(
        r, 1.0, period=0.0, wavelength=1.0
    ),
    "axis must not be the zero vector": lambda r: jaxrod.actuation.travelling_wave(
        r, 1.0, period=1.0, wavelength=1.0, axis=(0.0, 0.0, 0.0)
    ),
    "offsets must have shape": lambda r: jaxrod.actuation.muscle(
        r, 1.0, offsets=np.ones((2, 3))
    ),
    "force must be non-negative": lambda r: jaxrod.actuation.muscle(r, -1.0),
    "activation must have values of shape": lambda r: jaxrod.actuation.muscle(
        r, 1.0, jaxrod.schedules.sine(np.ones(3), 1.0), offsets=np.ones((2, 2))
    ),
    "area must be positive": lambda r: jaxrod.actuation.chamber(r, 1.0, 0.0),
    "angle must be at most": lambda r: jaxrod.actuation.wound_chamber(r, 1.0, 0.1, 2.0),
    "size of angle must be positive": lambda r: jaxrod.actuation.wound_chamber(
        r, 1.0, 0.1, 0.0
    ),
    "a tension in N or a length in m": lambda r: jaxrod.actuation.tendon(r, (0.1, 0.0)),
    "needs a stiffness in N/m": lambda r: jaxrod.actuation.tendon(
        r, (0.1, 0.0), length=1.0
    ),
    "last element must be at most 3": lambda r: jaxrod.actuation.tendon(
        r, (0.1, 0.0), tension=1.0, elements=(0, 4)
    ),
    "needs two eyelets": lambda r: jaxrod.actuation.tendon(
        r, (0.1, 0.0), tension=1.0, elements=(2, 2)
    ),
    "moment_per_length must have shape": lambda r: jaxrod.actuation.magnetisation(
        r, 1.0, (0.0, 0.0, 1.0)
    ),
    "needs a curvature in 1/m": jaxrod.actuation.active_shape,
}


@pytest.mark.parametrize("words", BAD)
def test_bad_arguments_are_refused_in_words(words):
    rod, _ = arm(4)
    with pytest.raises(ValueError, match=words):
        BAD[words](rod)


def test_other_things_than_clamps_and_curves_are_refused():
    rod, state = arm(4)
    with pytest.raises(TypeError, match=r"into must be a jaxrod Clamp"):
        jaxrod.actuation.muscle(rod, 1.0, into=state)
    with pytest.raises(TypeError, match="curve must be a force curve, such as"):
        jaxrod.actuation.muscle(rod, 1.0, curve=np.exp)
    with pytest.raises(ValueError, match="into must be clamps at different ends"):
        jaxrod.actuation.muscle(rod, 1.0, into=(jaxrod.clamp(state),) * 2)
    with pytest.raises(TypeError, match=r"rod must be a jaxrod Rod"):
        jaxrod.actuation.chamber(state, 1.0, 1.0)


def test_stress_of_the_section_is_refused_without_twist():
    rod, _ = arm(4)
    free = jaxrod.torsion_free()
    magnet = jaxrod.actuation.magnetisation(rod, (0.0, 0.0, 1.0), (0.3, 0.1, 0.2))
    jaxrod.make_scene(rod, magnet, method=free)
    with pytest.raises(ValueError, match="stress in the material frame"):
        jaxrod.make_scene(rod, jaxrod.actuation.muscle(rod, 1.0), method=free)


def test_actuators_are_the_same_on_another_grid():
    """What they do to an even state does not depend on the number of elements."""
    coarse, fine = arm(4)[0], arm(8)[0]
    winding = jaxrod.actuation.helical_offsets(coarse, 0.01, 0.1)
    muscle = jaxrod.actuation.muscle(coarse, np.full((1, 4), 2.0), offsets=winding)
    wave = jaxrod.actuation.travelling_wave(coarse, 1.0, period=1.0, wavelength=0.5)
    shape = jaxrod.actuation.active_shape(coarse, curvature=np.ones((3, 5)))
    assert muscle.resampled(coarse, fine).path.offsets.shape == (1, 2, 9)
    assert muscle.resampled(coarse, fine).force.shape == (1, 8)
    finer = jaxrod.actuation.travelling_wave(fine, 1.0, period=1.0, wavelength=0.5)
    np.testing.assert_allclose(
        wave.resampled(coarse, fine).moments.phases, finer.moments.phases, atol=1e-12
    )
    np.testing.assert_allclose(shape.resampled(coarse, fine).curvature, 1.0)
    with pytest.raises(ValueError, match="eyelets belong to certain elements"):
        jaxrod.actuation.tendon(coarse, (0.0, 0.0), tension=1.0).resampled(coarse, fine)


@pytest.mark.slow
def test_methods_agree_on_actuators_in_a_plane():
    """The planar step to round-off, implicit steps to their order."""
    rod, state = arm(4, youngs_modulus=1e6)
    wall = jaxrod.clamp(state)
    pull = 0.05 * 1e6 * AREA
    effects = (
        wall,
        jaxrod.actuation.muscle(rod, pull, 0.5, offsets=(0.6 * RADIUS, 0.0), into=wall),
        jaxrod.actuation.tendon(rod, (-RADIUS, 0.0), tension=0.3 * pull),
        jaxrod.actuation.travelling_wave(
            rod, 0.5, period=0.1, wavelength=0.5, axis=(0.0, 1.0, 0.0)
        ),
    )

    def tip(method, dt, steps):
        scene = jaxrod.make_scene(rod, *effects, method=method)
        return jaxrod.advance(scene, state, dt, steps).tip

    space = tip(jaxrod.consistent(), 2e-4, 100)
    assert float(jnp.linalg.norm(space - state.tip)) > 1e-3
    np.testing.assert_allclose(tip(jaxrod.planar("zx"), 2e-4, 100), space, atol=1e-12)
    implicit = tip(jaxrod.implicit(1.0), 2e-4, 100)
    np.testing.assert_allclose(implicit, space, atol=2e-5)
    theirs = tip(jaxrod.pyelastica(), 2e-4, 100)
    np.testing.assert_allclose(theirs, space, atol=2e-3)


def test_a_rod_that_has_the_strain_it_is_told_to_have_stores_nothing():
    """Half the stiffness times the square of what strain is missing, per length."""
    length, strain = 0.8, 0.1
    rod, state = jaxrod.straight_rod(
        5,
        length=length,
        radius=0.02,
        density=1000.0,
        youngs_modulus=1e6,
        dtype=jnp.float64,
    )
    shape = jaxrod.actuation.active_shape(rod, strain=(0.0, 0.0, strain))
    scene = jaxrod.make_scene(rod, shape)
    stiffness = float(rod.shear_stretch_stiffness[2, 0])
    for own in (0.0, 0.5 * strain, strain):
        stretched = replace(state, positions=(1 + own) * state.positions)
        stored = float(scene.potential_energy(stretched))
        missing = 0.5 * stiffness * length * (own - strain) ** 2
        assert stored == pytest.approx(missing, abs=1e-12 * stiffness)

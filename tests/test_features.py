"""Every feature that docs/features.md names is compiled and run, in seconds.

Other tests ask whether features are right to many digits; these ask of each whether it
runs at all and does what its name says. A program is compiled for what a scene lists,
not for its numbers: so a scene here lists many effects, all but one of strength zero.
"""

import math
import re
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.geometry import surfaces
from jaxrod.tradeoff import tuning
from jaxrod.tradeoff.measure import Reference, Setting, prepare, tips_of
from physics.bending import arc
from public_names import PUBLIC

ROOT = Path(__file__).parents[1]
G = 9.81
ZERO = (0.0, 0.0, 0.0)
RADIUS = 0.05
AREA = math.pi * RADIUS**2
RUN = {}


def runs(*names):
    """Says which public names a test runs."""

    def add(test):
        for name in names:
            RUN.setdefault(name, []).append(test)
        return test

    return add


def named(text):
    """Public names of the package that stand in backticks in a text."""
    quoted = " ".join(re.findall(r"`([^`]*)`", text))
    return set(re.findall(r"[A-Za-z_]\w*", quoted)) & set(PUBLIC)


def test_each_feature_in_the_docs_is_run_by_a_fast_test_here():
    features = named((ROOT / "docs" / "features.md").read_text())
    page = (ROOT / "docs" / "systems.md").read_text()
    rows = [line for line in page.splitlines() if line.startswith("|")]
    systems = named("\n".join(rows))
    assert len(features) > 35 and len(systems) > 15, "the pages were not understood"
    missing = (features | systems) - set(RUN)
    assert not missing, f"no test of this file runs {sorted(missing)}"
    here = Path(__file__).read_text()
    for name, tests in RUN.items():
        said = re.search(rf"\bjaxrod\.(\w+\.)?{name}\b", here)
        assert said, f"{name} does not stand in this file"
        for test in tests:
            marks = [mark.name for mark in getattr(test, "pytestmark", ())]
            assert "slow" not in marks, f"{test.__name__} is left out of fast runs"


@pytest.mark.parametrize(
    "page",
    ["features.md", "commands.md", "tasks.md", "clients.md", "environments.md"],
)
def test_every_page_that_lists_the_tasks_lists_all_of_them(page):
    text = (ROOT / "docs" / page).read_text()
    rows = [line for line in text.splitlines() if line.startswith("|")]
    # On two pages a sentence lists the tasks.
    listed = text if page in ("clients.md", "commands.md") else "\n".join(rows)
    missing = {*jaxrod.envs.names()} - {"trivial", *re.findall(r"\w+", listed)}
    assert not missing


def straight(n=4, length=1.0, radius=RADIUS, **changes):
    """A rod along x, its first director up, and its state at rest."""
    shape = {"direction": (1, 0, 0), "normal": (0, 0, 1), "dtype": jnp.float64}
    material = {"density": 1000.0, "youngs_modulus": 1e6}
    return jaxrod.straight_rod(
        n, length=length, radius=radius, **material | shape | changes
    )


def thrown(state, velocity):
    """The state, faster by one velocity everywhere."""
    velocity = jnp.asarray(velocity, state.velocities.dtype)[:, None]
    return replace(state, velocities=state.velocities + velocity)


def close(found, wanted, rtol=1e-9, atol=1e-11):
    wanted = np.broadcast_to(wanted, np.shape(found))
    np.testing.assert_allclose(found, wanted, rtol=rtol, atol=atol)


# A free rod with everything that can act on one. All is off but what a test turns on.

ROD, REST = straight()
MASS = float(jnp.sum(ROD.node_masses))
ABOUT_D2 = np.array([[0.0] * 3, [1.0] * 3, [0.0] * 3])
SPLINE = jaxrod.actuation.control_spline(3, 1.0, dtype=jnp.float64)
UPPER_SIDE = (0.02, 0.0)
# As good as constant: a quarter of a period on, longer than all there is.
STANDING = {"period": 1e9, "wavelength": 1e9, "axis": (0, 1, 0), "phase": 0.25}


@jaxrod.extend.pytree
class Tiring(jaxrod.extend.Effect):
    """A force up on every node, half as strong after each step."""

    force: jax.Array
    left: jax.Array = jaxrod.extend.memory(default=1.0)

    def loads(self, rod, motion):
        up = jnp.full_like(rod.node_masses, self.force * self.left)
        return jaxrod.extend.Loads(forces=(0 * up, 0 * up, up))

    def after_step(self, rod, motion, dt):
        return replace(self, left=0.5 * self.left)


def everything(
    weight=(ZERO, ZERO, 1.0),
    push=(ZERO, 1.0, 0.0),
    twist=ZERO,
    load=((0.0, 1.0), (ZERO, ZERO)),
    couple=ZERO,
    controls=0.0,
    fluid=1e-30,
    damping=0.0,
    drag=0.0,
    wave=0.0,
    activation=0.0,
    tension=0.0,
    pressure=0.0,
    magnet=0.0,
    curvature=0.0,
    tiring=0.0,
):
    """The free rod and all effects, at rest but for those given."""
    force, period, phase = push
    return jaxrod.make_scene(
        ROD,
        jaxrod.gravity(jaxrod.schedules.ramp(*weight)),
        jaxrod.end_load(jaxrod.schedules.sine(force, period, phase=phase), twist),
        jaxrod.uniform_load(jaxrod.schedules.table(*load), couple),
        jaxrod.actuation.spline_couples(ROD, SPLINE, controls * ABOUT_D2, 1.0),
        jaxrod.fluids.buoyancy(fluid, (0.0, 0.0, -G)),
        jaxrod.exponential_damping(damping),
        jaxrod.fluids.stokes_drag(drag, 2 * drag),
        jaxrod.actuation.travelling_wave(ROD, wave, **STANDING),
        jaxrod.actuation.muscle(ROD, 10.0, activation, offsets=UPPER_SIDE),
        jaxrod.actuation.tendon(ROD, UPPER_SIDE, tension=tension),
        jaxrod.actuation.chamber(ROD, pressure, 1e-4, offsets=UPPER_SIDE),
        jaxrod.actuation.magnetisation(ROD, (0.0, 0.0, magnet), (0.0, 0.0, 1.0)),
        jaxrod.actuation.active_shape(ROD, curvature=curvature * ABOUT_D2[:, 0]),
        Tiring(tiring),
    )


def acted_on(state=REST, dt=1e-3, steps=20, **on):
    """Momentum, angular momentum about the middle, and the state of the free rod."""
    scene = everything(**on)
    state = jaxrod.advance(scene, state, dt, steps)
    momentum = ROD.momentum(state)
    middle = jnp.asarray([0.5, 0.0, 0.0])
    spin = ROD.angular_momentum(state) - jnp.cross(middle, momentum)
    return momentum, spin, state


def test_with_everything_turned_off_a_free_rod_stays_as_it_is():
    momentum, spin, state = acted_on()
    close(momentum, ZERO)
    close(spin, ZERO)
    close(state.positions, REST.positions)


@runs("gravity", "ramp", "make_scene", "RodState", "advance")
def test_gravity_accelerates_the_centre_of_mass():
    down = (0.0, 0.0, -G)
    momentum, spin, state = acted_on(weight=(down, down, 1.0))
    assert isinstance(state, jaxrod.RodState)
    close(momentum, (0, 0, -G * 0.02 * MASS))
    close(spin, ZERO)
    close(state.positions[2], -G * 0.02**2 / 2)
    # Half as much where it rises evenly from nothing.
    momentum, _, _ = acted_on(weight=(ZERO, down, 0.02))
    close(momentum, (0, 0, -G * 0.01 * MASS))


def test_coupled_masses_turn_with_the_moment_of_inertia_of_the_rod():
    rod, state = straight(10, mass_matrix="higher_order")
    turning = state.velocities.at[2].set(2.0 * (state.positions[0] - 0.5))
    energy = rod.kinetic_energy(replace(state, velocities=turning))
    # With lumped masses it is two per cent too large.
    close(energy, 0.5 * MASS / 12 * 2.0**2, rtol=2e-3)


@runs("end_load", "sine")
def test_an_end_load_pushes_and_turns_its_own_end():
    # A quarter of a period on, a sine of a very long period is constant.
    momentum, spin, _ = acted_on(push=((0.0, 0.0, 3.0), 1e9, 0.25))
    close(momentum, (0, 0, 3 * 0.02))
    close(spin, (0, -0.5 * 3 * 0.02, 0), rtol=1e-3, atol=1e-6)
    # Half a wave of a sine holds 1 / pi of its period.
    momentum, _, _ = acted_on(push=((0.0, 0.0, 3.0), 0.04, 0.0))
    close(momentum, (0, 0, 3 * 0.04 / math.pi), rtol=3e-3)
    momentum, spin, _ = acted_on(twist=(0.2, 0.0, 0.3))
    close(momentum, ZERO)
    close(spin, (0.2 * 0.02, 0, 0.3 * 0.02))


@runs("uniform_load", "table")
def test_a_uniform_load_pushes_and_turns_all_of_the_rod():
    momentum, spin, state = acted_on(load=((0.0, 1.0), ((0, 2, 0), (0, 2, 0))))
    close(momentum, (0, 2 * 0.02, 0))
    close(spin, ZERO)
    close(state.velocities[1], 2 * 0.02 / MASS)
    momentum, _, _ = acted_on(load=((0.0, 0.02), (ZERO, (0, 2, 0))))
    close(momentum, (0, 2 * 0.01, 0))
    momentum, spin, _ = acted_on(couple=(0.0, 0.0, 0.3))
    close(momentum, ZERO)
    close(spin, (0, 0, 0.3 * 0.02))


@runs("spline_couples")
def test_couples_along_a_spline_turn_the_rod_about_their_direction():
    momentum, spin, _ = acted_on(dt=1e-5, steps=5, controls=0.3)
    close(momentum, ZERO)
    couple = spin / 5e-5
    # About d2, which is minus y; the spline is one in the middle and zero at the ends.
    assert -0.3 < couple[1] < -0.7 * 0.3
    close(couple[::2], (0, 0))
    _, twice, _ = acted_on(dt=1e-5, steps=5, controls=0.6)
    close(twice, 2 * spin, rtol=1e-6)


@runs("buoyancy")
def test_buoyancy_is_the_weight_of_the_fluid_that_makes_way():
    momentum, _, _ = acted_on(fluid=900.0)
    close(momentum, (0, 0, 900 * AREA * G * 0.02))


@runs("exponential_damping")
def test_damping_takes_speed_at_its_rate():
    momentum, _, _ = acted_on(thrown(REST, (0, 1, 2)), damping=30.0)
    close(momentum, MASS * math.exp(-30 * 0.02) * np.array([0, 1, 2]))


@runs("stokes_drag")
def test_drag_takes_energy_twice_as_fast_across_as_along():
    first = thrown(REST, (1, 0, 1))
    momentum, _, state = acted_on(first, drag=100.0)
    decay = math.exp(-100 * 0.02 / MASS)
    close(momentum, MASS * np.array([decay, 0, decay**2]), rtol=1e-6)
    left = ROD.kinetic_energy(state) / ROD.kinetic_energy(first)
    close(left, (decay**2 + decay**4) / 2, rtol=1e-6)


def ends_after(pull, arm):
    """Checks what an actuator has done to the ends of the rod, and to nothing else.

    Args:
        pull: The force with which it draws the ends together.
        arm: The moment with which it bends the rod towards its upper side.
    """

    def check(**on):
        time = 5e-5
        momentum, spin, state = acted_on(dt=time / 5, steps=5, **on)
        close(momentum, ZERO)
        close(spin, ZERO)
        along = ROD.node_masses * state.velocities[0] / time
        close(along[:2].sum(), pull, rtol=1e-3, atol=1e-6)
        close(along[-2:].sum(), -pull, rtol=1e-3, atol=1e-6)
        # Both ends are turned up, the far one about minus y.
        turned = state.angular_momenta / time
        close(turned[1], [arm, 0, 0, -arm], rtol=2e-3, atol=1e-4)
        close(turned[::2], np.zeros((2, 4)))

    return check


@runs("travelling_wave")
def test_a_wave_of_moment_bends_the_rod_and_leaves_it_where_it_is():
    ends_after(pull=0.0, arm=0.2)(wave=0.2)


@runs("muscle")
def test_a_muscle_shortens_the_rod_and_bends_it_to_its_side():
    # The curve of an octopus' muscle gives 0.99 of the full force at rest.
    ends_after(pull=4.95, arm=4.95 * 0.02)(activation=0.5)


@runs("tendon")
def test_a_tendon_shortens_the_rod_and_bends_it_to_its_side():
    ends_after(pull=5.0, arm=5.0 * 0.02)(tension=5.0)


@runs("chamber")
def test_a_chamber_lengthens_the_rod_and_bends_it_away_from_its_side():
    ends_after(pull=-5.0, arm=-5.0 * 0.02)(pressure=5e4)


@runs("active_shape")
def test_a_rod_bends_to_its_active_curvature():
    bending = 1e6 * math.pi * RADIUS**4 / 4
    ends_after(pull=0.0, arm=0.04 * bending)(curvature=0.04)


@runs("magnetisation")
def test_a_magnet_turns_into_the_field():
    momentum, spin, _ = acted_on(magnet=0.3)
    close(momentum, ZERO)
    # Along x in a field along z: the couple is about minus y.
    close(spin, (0, -0.3 * 0.02, 0), rtol=1e-4)


@runs("standard_linear_solid", "bending_hysteresis", "plastic_bending")
def test_materials_with_memory_add_their_moments():
    """In the first moment of a bend beyond the limits of wires and metal."""
    bending, curvature = 1e6 * math.pi * RADIUS**4 / 4, 0.2
    scene = jaxrod.make_scene(
        ROD,
        jaxrod.materials.standard_linear_solid(
            ROD, stiffness_ratio=1.5, relaxation_time=1.0
        ),
        jaxrod.materials.bending_hysteresis(ROD, stiffness=3.0, slip_moment=0.2),
        jaxrod.materials.plastic_bending(ROD, yield_moment=0.5, hardening=0.1),
    )
    state = jaxrod.advance(scene, arc(ROD, REST, (0.0, curvature)), 1e-6, 1)
    elastic, friction = bending * curvature, 0.2 * -math.expm1(-3.0 * curvature / 0.2)
    couple = 2.5 * elastic + friction - 0.9 * (elastic - 0.5)
    # Bending about d2, which is minus y where the rod begins.
    close(state.angular_momenta[:, 0], (0, -couple * 1e-6, 0), rtol=1e-4)
    left = 0.9 * (curvature - 0.5 / bending)
    close(state.memory[2]["set"][1, 1:-1], left, rtol=1e-4)


@runs("Effect", "memory")
def test_an_effect_of_ones_own_acts_and_remembers():
    momentum, _, state = acted_on(tiring=3.0)
    halves = sum(0.5**k for k in range(20))
    close(momentum, (0, 0, 5 * 3 * 1e-3 * halves))
    close(state.memory[-1]["left"], 0.5**20)


@runs("quadratic_drag")
def test_drag_with_the_square_of_the_speed_slows_a_rod_by_its_law():
    scene = jaxrod.make_scene(ROD, jaxrod.fluids.quadratic_drag(1000.0, across=1.2))
    state = jaxrod.advance(scene, thrown(REST, (0, 0, 2)), 1e-3, 20)
    rate = 0.5 * 1000 * 2 * RADIUS * 1.2 / MASS
    close(state.velocities[2], 2 / (1 + 2 * rate * 0.02))


# Supports


@runs("fixed_end", "pin_support")
def test_an_end_and_a_node_are_held_and_the_rest_moves():
    scene = jaxrod.make_scene(
        ROD,
        jaxrod.fixed_end(REST),
        jaxrod.pin_support(REST, "tip", axes="z"),
        jaxrod.uniform_load((0.0, 50.0, 50.0)),
    )
    state = jaxrod.advance(scene, REST, 1e-3, 20)
    change = np.asarray(state.positions - REST.positions)
    close(change[:, 0], ZERO)
    close(state.orientations[:, 0], REST.orientations[:, 0])
    close(change[2, -1], 0)
    # As a rod that nothing holds, along y and where nothing holds it along z.
    fallen = 50 / MASS * 0.02**2 / 2
    close((change[1, -1], change[2, 2]), fallen, rtol=0.05)


@runs("hinge_support")
def test_a_hinge_turns_about_its_axis_alone():
    rod, rest = straight(youngs_modulus=1e8)
    scene = jaxrod.make_scene(
        rod,
        jaxrod.hinge_support(rest, (0, 1, 0)),
        jaxrod.uniform_load((0.0, 4.0, 4.0)),
    )
    state = jaxrod.advance(scene, rest, 2e-4, 1000)
    close(state.positions[:, 0], ZERO)
    # A bar that turns about its end: the couple of the load over its inertia.
    inertia = rod.node_masses @ rest.positions[0] ** 2
    _, across, up = state.positions[:, -1]
    close(up, 0.5 * 4 / inertia * 0.2**2 / 2, rtol=0.02)
    assert 0 < across < 0.2 * up


@runs("driven", "reactions")
def test_a_driven_end_is_where_its_schedule_says_and_takes_power():
    scene = jaxrod.make_scene(
        ROD,
        jaxrod.driven(
            REST,
            displacement=jaxrod.schedules.ramp(ZERO, (0.0, 0.0, 0.04), 0.04),
            axis=(0, 1, 0),
            angle=jaxrod.schedules.ramp(0.0, 0.2, 0.04),
            holds_element=True,
        ),
    )
    state = jaxrod.advance(scene, REST, 1e-3, 20)
    close(state.positions[:, 0], (0, 0, 0.02))
    half = jnp.vdot(state.orientations[:, 0], REST.orientations[:, 0])
    close(2 * jnp.arccos(jnp.abs(half)), 0.1, rtol=1e-6)
    (taken,) = jaxrod.reactions(scene.at(0.02), state)
    assert abs(taken.power) > 0.1
    close(taken.power, taken.force[2] * 1.0 + taken.couple[1] * 5.0, rtol=1e-6)


@runs("robot_arm")
def test_a_hand_of_a_robot_drives_an_end():
    robot = jaxrod.robot_arm(ROOT / "examples" / "robot_arm.urdf", "hand")
    turn = jaxrod.schedules.ramp(np.zeros(3), np.array([0.2, 0.0, 0.0]), 0.04)
    scene = jaxrod.make_scene(ROD, jax.jit(robot.hold)(REST, turn))
    hand = jax.jit(lambda: scene.at(0.02).effects[0])()
    x, y, z = REST.positions[:, 0]
    # The waist turns by 0.1 rad, and what is on its axis stays there.
    c, s = math.cos(0.1), math.sin(0.1)
    close(hand.place.position, (c * x - s * y, s * x + c * y, z))
    close(hand.turn.angular_velocity, (0, 0, 5.0))


# One arm, bent by its weight, by every method


def arm(method=None, radius=RADIUS):
    """A clamped arm along x under its weight, and its state at rest."""
    rod, state = straight(radius=radius, youngs_modulus=1e8)
    effects = jaxrod.clamp(state), jaxrod.gravity((0.0, 0.0, -G))
    return jaxrod.make_scene(rod, *effects, method=method), state


def sagged(method=None):
    """Its nodes after three hundredths of a second, an eighth of its first period."""
    scene, state = arm(method)
    return np.asarray(jaxrod.advance(scene, state, 2e-4, 150).positions)


@runs("clamp", "planar", "torsion_free")
def test_fewer_freedoms_give_the_same_motion_in_a_plane():
    plain = sagged()
    fall = -G * 0.03**2 / 2
    # The clamped end is held, and its element with it.
    close(plain[:, 0], ZERO)
    assert fall < plain[2, 2] < 0.3 * fall
    assert 0.5 * fall < plain[2, 1] < 0
    close(sagged(jaxrod.planar("zx")), plain)
    close(sagged(jaxrod.torsion_free()), plain)


@runs("pyelastica")
def test_the_law_of_pyelastica_is_nearly_the_same_at_small_strains():
    plain, other = sagged(), sagged(jaxrod.pyelastica())
    close(other[2], plain[2], rtol=1e-3)
    assert np.max(np.abs(other - plain)) > 1e-12


@runs("implicit")
def test_implicit_steps_are_close_to_explicit_ones():
    plain, other = sagged(), sagged(jaxrod.implicit())
    close(other[2, 1:], plain[2, 1:], rtol=0.05)
    assert np.max(np.abs(other - plain)) > 0


@runs("compensated")
def test_compensated_positions_keep_steps_below_rounding():
    rod, state = straight(start=(0, 0, 100), dtype=jnp.float32)
    scene = jaxrod.make_scene(rod)
    state = thrown(state, (0, 0, 1e-3))
    plain = jaxrod.advance(scene, state, 1e-3, 20)
    assert np.all(plain.positions[2] == 100)
    kept = jaxrod.advance(scene, jaxrod.compensated(state), 1e-3, 20)
    up = np.asarray(kept.positions, float) - np.asarray(kept.remainders, float)
    close(up[2] - 100, 1e-3 * 20e-3, rtol=1e-3)


@runs("scale_inertia", "frequency_changes")
def test_enlarged_inertia_allows_larger_steps_and_hardly_changes_the_motion():
    scene, state = arm(radius=0.005)
    scaled = jaxrod.scale_inertia(scene)
    assert scaled.dt > 2 * scaled.dt_before
    dt = 0.5 * float(scaled.dt)
    found = jaxrod.advance(scaled.scene, state, dt, 1000)
    parts = math.ceil(dt / float(0.5 * scaled.dt_before))
    plain = jaxrod.advance(scene, state, dt / parts, 1000 * parts)
    assert plain.tip[2] < -0.1
    close(found.tip, plain.tip, rtol=0, atol=0.03)
    lowest, *_ = jaxrod.frequency_changes(scaled, state, 2)
    assert 0 < abs(lowest) < 0.02


@runs("stable_dt", "highest_frequency", "natural_frequencies")
def test_the_highest_frequency_limits_the_step():
    scene, state = arm()
    frequencies = jaxrod.natural_frequencies(scene, state)
    highest = float(jaxrod.highest_frequency(scene, state))
    close(highest, frequencies[-1], rtol=0.01)
    # The first is that of a cantilever, as well as four elements have it.
    bending = 1e8 * math.pi * RADIUS**4 / 4
    close(frequencies[0], 3.516 * math.sqrt(bending / MASS), rtol=0.08)
    bound = float(jaxrod.stable_dt(scene).dt)
    measured = float(jaxrod.stable_dt(scene, state=state).dt)
    close(measured, 0.8 * 2 / highest, rtol=0.01)
    assert 0.5 * measured < bound <= 1.01 * measured


@runs("health", "freeze")
def test_health_flags_what_a_step_too_long_has_broken_and_freeze_keeps_the_rest():
    scene, state = arm()
    good, bad = 2e-4, 3 * float(jaxrod.stable_dt(scene).dt)
    sound = jaxrod.advance(scene, state, good, 20)
    assert not jaxrod.health(scene, sound, good).flagged
    with pytest.warns(jaxrod.UnstableStepWarning):
        broken = jaxrod.advance(scene, state, bad, 200)
    flagged = jaxrod.health(scene, broken, bad).flagged
    assert flagged
    kept = jaxrod.freeze(flagged, sound, broken)
    np.testing.assert_array_equal(kept.positions, sound.positions)
    kept = jaxrod.freeze(~flagged, state, sound)
    np.testing.assert_array_equal(kept.positions, sound.positions)


@runs("equilibrium", "reactions", "resample", "settled", "make_system")
def test_an_arm_rests_where_its_loads_balance():
    scene, state = arm()
    rest = jaxrod.equilibrium(scene, state)
    assert rest.converged and rest.stable
    weight = MASS * G
    assert rest.force_residual < 1e-6 * weight
    wall, _ = jaxrod.reactions(scene, rest.state)
    close(wall.force, (0, 0, weight), rtol=1e-6, atol=1e-6)
    centre = rest.state.positions @ ROD.node_masses / MASS
    close(wall.couple, (0, -weight * centre[0], 0), rtol=1e-4, atol=1e-4)
    finer, fine = jaxrod.resample(scene, state, 8)
    close(jaxrod.equilibrium(finer, fine).state.tip[2], rest.state.tip[2], rtol=0.1)
    # The same arm as a system, followed until it rests.
    system = jaxrod.make_system({"arm": scene})
    fallen = jaxrod.systems.settled(system, {"arm": state}, max_steps=20000)
    assert fallen.converged
    tip = rest.state.positions[:, -1]
    bending = 1e8 * math.pi * RADIUS**4 / 4
    close(tip[2], -weight / (8 * bending), rtol=0.1)
    close(fallen.state["arm"].positions[:, -1], tip, rtol=1e-4, atol=1e-4)
    assert np.max(np.abs(fallen.state["arm"].velocities)) < 1e-3


@runs("save", "load", "astype")
def test_a_saved_arm_takes_the_same_step(tmp_path):
    scene, state = arm()
    jaxrod.save(tmp_path / "arm.jaxrod", (scene, state))
    found, start = jaxrod.load(tmp_path / "arm.jaxrod")
    wanted = jaxrod.advance(scene, state, 2e-4, 20)
    kept = jaxrod.advance(found, start, 2e-4, 20)
    np.testing.assert_array_equal(kept.positions, wanted.positions)
    single = jaxrod.astype(kept, jnp.float32)
    assert single.velocities.dtype == jnp.float32
    close(single.positions, wanted.positions, rtol=1e-6, atol=1e-7)


@runs("tune")
def test_tune_states_the_error_of_the_worst_point(monkeypatch):
    scene, state = arm()
    ball, of_ball = jaxrod.systems.rigid_body(
        jaxrod.shapes.sphere((2.0, 0.5, 0), 0.1), density=100.0, dtype=jnp.float64
    )
    system = jaxrod.make_system({"arm": scene, "ball": ball})

    def shifted(problem, *, enough):
        """The motion itself, but for the ball, which is the last point."""
        setting = Setting(scene.rod.n_elements, dtype="float64")
        tips = tips_of(problem, prepare(problem, setting))
        away = np.zeros(tips.shape)
        away[:, -1, 1] = 0.02
        return Reference(tips + away, 1.0, 1e-3, 8, 1e-3)

    monkeypatch.setattr(tuning, "reference", shifted)
    monkeypatch.setattr(tuning, "_kinds", lambda workload, n_elements: [()])
    found = jaxrod.tune(
        system,
        {"arm": state, "ball": of_ball},
        max_error=0.03,
        duration=0.02,
        elements=(scene.rod.n_elements,),
        seconds=0.001,
    )
    assert found.met
    close(found.error, 0.02, rtol=1e-3)
    assert found.wall_s_per_sim_s > 0


# Contact with bodies that stand still: all far below but the one that a test lifts.

STIFF, DEEP, FAR = 1e4, 0.005, -100.0
FRICTION = {"damping": 10.0, "friction": (0.1, 0.3, 0.4), "friction_drag": 1e3}


def below(point, height):
    """Distance from the ground at a height [m]."""
    return point[2] - height


BRICK = surfaces.box(np.array([1.0, 0.2, 0.2]))

# Each of a shape whose top is as high as it is told; flat, or a ridge along the rod.
ROOM = {
    "sphere": lambda top: jaxrod.shapes.sphere((0.5, 0, top - 0.2), 0.2),
    "capsule": lambda top: jaxrod.shapes.capsule(
        (-1, 0, top - 0.2), (2, 0, top - 0.2), 0.2
    ),
    "cylinder": lambda top: jaxrod.shapes.cylinder(
        (-1, 0, top - 0.2), (2, 0, top - 0.2), 0.2
    ),
    "pipe": lambda top: jaxrod.shapes.pipe(
        (-1, 0, top - 0.2), (2, 0, top - 0.2), 0.1, thickness=0.1
    ),
    "plane": lambda top: jaxrod.shapes.plane((0, 0, top)),
    "box": lambda top: jaxrod.shapes.box((0.5, 0, top - 0.2), (1.0, 0.2, 0.2)),
    "signed_distance": lambda top: jaxrod.shapes.signed_distance(below, top),
    "from_mesh": lambda top: jaxrod.shapes.from_mesh(
        *BRICK, spacing=0.05, position=(0.5, 0, top - 0.2)
    ),
}


def spheres(top):
    places = np.linspace(0.1, 0.9, 5)
    return [jaxrod.shapes.sphere((x, 0, top - 0.1), 0.1) for x in places]


def laid_on(kind, state=REST, dt=1e-5, steps=5):
    """The force on the rod that lies in a body, the state after, and the scene."""
    top = dict.fromkeys((*ROOM, "many", "near"), FAR) | {kind: DEEP - RADIUS}
    effects = [
        jaxrod.contact(
            body(top[name]), stiffness=STIFF, **FRICTION if name == "plane" else {}
        )
        for name, body in ROOM.items()
    ]
    many, near = (
        jaxrod.contact(spheres(top[name]), stiffness=STIFF, points_per_element=2)
        for name in ("many", "near")
    )
    few = jaxrod.near_contact(near, ROD, REST, 2)
    scene = jaxrod.make_scene(ROD, *effects, many, few)
    state = jaxrod.advance(scene, state, dt, steps)
    return state.velocities @ ROD.node_masses / (dt * steps), state, scene


@runs("contact", *ROOM)
@pytest.mark.parametrize("kind", ROOM)
def test_a_body_pushes_a_rod_out_by_its_stiffness(kind):
    force, _, _ = laid_on(kind)
    if kind == "sphere":
        assert 0 < force[2] < 0.9 * STIFF * DEEP
    else:
        close(force[2], STIFF * DEEP, rtol=1e-3)
    close(force[:2], (0, 0), atol=1e-6)


def test_a_rod_does_not_fall_through_the_ground():
    falling = thrown(REST, (0, 0, -0.5))
    _, state, _ = laid_on("plane", falling, dt=1e-3, steps=60)
    assert np.all(state.positions[2] > -0.06)
    assert np.all(state.velocities[2] > 0)


def test_friction_has_directions():
    steady = {"dt": 1e-5, "steps": 5}
    for velocity, share in (((1, 0, 0), 0.1), ((-1, 0, 0), 0.3)):
        start = thrown(REST, velocity)
        _, state, _ = laid_on("plane", start, **steady)
        change = (state.velocities - start.velocities) @ ROD.node_masses / 5e-5
        close(change[0], -velocity[0] * share * STIFF * DEEP, rtol=0.02)


@runs("near_contact")
def test_contact_with_the_nearest_bodies_is_contact_with_all():
    force, all_of_them, _ = laid_on("many", steps=20, dt=1e-3)
    assert force[2] > 1.0
    _, nearest, _ = laid_on("near", steps=20, dt=1e-3)
    close(nearest.positions, all_of_them.positions, rtol=1e-13)


@runs("sticking_contact")
def test_what_sticks_stays_within_the_elongation_of_its_springs():
    line = ROD.node_masses.sum() / ROD.length
    top = 9.81 * line / 1e5 - RADIUS
    ground = jaxrod.contact(ROOM["plane"](top), stiffness=1e5, damping=500, friction=1)
    holds = jaxrod.sticking_contact(ground, ROD, REST)
    pull = jaxrod.gravity((2.0, 0, -9.81))
    scene = jaxrod.make_scene(ROD, pull, holds)
    state = jaxrod.advance(scene, REST, 1e-3, 1000)
    close(state.positions[0] - REST.positions[0], 2.0 * line / 5e4, rtol=0.1)
    close(state.velocities, 0, atol=1e-6)


@runs("moving_contact")
def test_a_plate_that_moves_takes_a_rod_along():
    top = 9.81 * ROD.node_masses.sum() / ROD.length / 1e5 - RADIUS
    plate = jaxrod.contact(ROOM["plane"](top), stiffness=1e5, damping=500, friction=1)
    way = jaxrod.schedules.sine((0.02, 0, 0.01), 1.0, mean=(0.02, 0, 0.01), phase=-0.25)
    holds = jaxrod.moving_contact(
        jaxrod.sticking_contact(plate, ROD, REST), displacement=way
    )
    scene = jaxrod.make_scene(ROD, jaxrod.gravity(), holds)
    state = jaxrod.advance(scene, REST, 1e-3, 500)
    moved = state.positions - REST.positions
    close(moved[0], 0.04, atol=5e-4)
    close(moved[2], 0.02, atol=5e-4)


# Systems. Equal rods are one member, so that their number does not matter.


def laid_out(starts, ways, radius=RADIUS, **changes):
    """Equal rods that begin here and go there, as one member, and their state."""

    def one(start, way):
        shape = {"start": start, "direction": way, "normal": None}
        rod, state = straight(3, radius=radius, **shape | changes)
        return jaxrod.make_scene(rod), state

    return jax.vmap(one)(jnp.asarray(starts, float), jnp.asarray(ways, float))


def turning_about(state, k, place, rate):
    """A rod of several turns about a place at a rate about z [rad/s]."""
    arm = state.positions[k] - jnp.asarray(place, float)[:, None]
    speed = rate * jnp.stack([-arm[1], arm[0], 0 * arm[2]])
    return replace(state, velocities=state.velocities.at[k].add(speed))


def angle(a, b):
    return math.acos(np.dot(a, b) / np.linalg.norm(a) / np.linalg.norm(b))


@runs("tie", "weld", "attach", "rigid_body", "BodyState", "box")
def test_exact_joints_hold_and_keep_momentum():
    x, y = np.eye(3)[:2]
    starts = [0 * x, x, x, -0.2 * y]
    rods, of_rods = laid_out(starts, [x, y, -y, -x], youngs_modulus=1e8)
    of_rods = turning_about(of_rods, 1, x, 2.0)
    of_rods = turning_about(of_rods, 2, x, -2.0)
    head, of_head = jaxrod.systems.rigid_body(
        jaxrod.shapes.box((-0.1, -0.1, 0), (0.1, 0.1, 0.1)),
        density=1000.0,
        effects=(jaxrod.exponential_damping(0.0),),
        angular_velocity=(0.0, 0.0, 1.0),
        dtype=jnp.float64,
    )
    assert isinstance(of_head, jaxrod.systems.BodyState)
    start = {"rods": of_rods, "head": of_head}
    system = jaxrod.make_system(
        {"rods": rods, "head": head},
        jaxrod.systems.weld(("rods", 0, "tip"), ("rods", 1, "base"), start),
        jaxrod.systems.tie(("rods", 0, "tip"), ("rods", 2, "base"), start),
        jaxrod.systems.attach(("rods", 0, "base"), ("head",), start),
        jaxrod.systems.attach(("rods", 3, "base"), ("head",), start, turning=True),
        state=start,
    )
    # Once through a step of no length: all ties are kept.
    first = jaxrod.advance(system, start, 1e-12, 1)
    state = jaxrod.advance(system, first, 2e-4, 100)
    for what in (jaxrod.System.momentum, jaxrod.System.angular_momentum):
        close(what(system, state), what(system, first), rtol=1e-11)
    energies = [float(system.total_energy(one)) for one in (first, state)]
    close(energies[1], energies[0], rtol=1e-3)
    nodes = state["rods"].positions
    for other in (1, 2):
        close(nodes[other, :, 0], nodes[0, :, -1])
    for k in (0, 3):
        lever = nodes[k, :, 0] - state["head"].positions[:, 0]
        before = of_rods.positions[k, :, 0] - of_head.positions[:, 0]
        close(np.linalg.norm(lever), np.linalg.norm(before))
    welded, tied = (nodes[k, :, 1] - nodes[k, :, 0] for k in (1, 2))
    bar = nodes[0, :, -1] - nodes[0, :, -2]
    # The tie turns freely where the weld resists.
    free = abs(angle(bar, tied) - math.pi / 2)
    assert free > 0.02
    assert abs(angle(bar, welded) - math.pi / 2) < 0.7 * free


@runs(
    "spring",
    "ball_joint",
    "fixed_joint",
    "hinge_joint",
    "glue",
    "pose_spring",
    "pose_spring_reactions",
)
def test_each_joint_pulls_two_rods_together_by_its_stiffness():
    """Pairs of rods, the second of each shifted by 1 mm and turned about its axis."""
    x, y = np.eye(3)[:2]
    pairs = ["spring", "ball", "rigid", "hinge", "glue", "pose"]
    starts = [
        2.0 * k * y
        + second * (0.2 if pair == "glue" else 0) * y
        + second * (1.1 if pair == "spring" else 1.0) * (pair != "glue") * x
        for k, pair in enumerate(pairs)
        for second in (0, 1)
    ]
    rods, rest = laid_out(starts, [x] * 12)
    at_rest = {"rods": rest}

    def ends(k):
        return ("rods", 2 * k, "tip"), ("rods", 2 * k + 1, "base")

    system = jaxrod.make_system(
        {"rods": rods},
        jaxrod.systems.spring(*ends(0), at_rest, stiffness=100.0),
        jaxrod.systems.ball_joint(*ends(1), at_rest, stiffness=200.0),
        jaxrod.systems.fixed_joint(
            *ends(2), at_rest, stiffness=300.0, turning_stiffness=7.0
        ),
        jaxrod.systems.hinge_joint(
            *ends(3),
            at_rest,
            axis=(1, 0, 0),
            stiffness=400.0,
            axis_stiffness=5.0,
            motor=0.3,
        ),
        jaxrod.systems.glue(
            ("rods", 8),
            ("rods", 9),
            at_rest,
            stiffness=500.0,
            turning_stiffness=3.0,
        ),
        jaxrod.systems.pose_spring(
            ("rods", 10, "tip"),
            at_rest,
            stiffness=600.0,
            displacement=(1e-3, 0.0, 0.0),
        ),
        state=at_rest,
    )
    second = jnp.arange(12) % 2
    shift = 1e-3 * second[:, None, None] * jnp.asarray(x)[None, :, None]
    half = jnp.broadcast_to(0.5 * 0.02 * second[:, None], (12, 3))
    turn = jnp.cos(half), jnp.sin(half), 0 * half, 0 * half
    before = tuple(rest.orientations[:, k] for k in range(4))
    turned = jnp.stack(
        jaxrod.geometry.rotations.multiply_quaternions(turn, before), axis=1
    )
    start = replace(rest, positions=rest.positions + shift, orientations=turned)
    time = 5e-5
    state = jaxrod.advance(system, {"rods": start}, time / 5, 5)["rods"]
    masses = rods.rod.node_masses[0]
    force = np.asarray(state.velocities @ masses / time)
    wanted = 1e-3 * np.array([100, 200, 300, 400, 500, 0])
    close(force[::2, 0], wanted + np.eye(6)[5] * 0.6, rtol=2e-3, atol=1e-6)
    close(force[1::2, 0], -wanted, rtol=2e-3, atol=1e-6)
    couple = np.asarray(jnp.sum(state.angular_momenta, axis=-1) / time)[:, 0]
    turned_back = np.array([0, 0, 7 * 0.02, -0.3, 3 * 0.02, 0])
    # Glue is halfway between: it is sheared as well where one of two rods turns.
    sheared = np.array([0, 0, 0, 0, 500 * 0.02 * 0.1**2, 0])
    close(couple[::2], turned_back - sheared, rtol=2e-3, atol=1e-6)
    close(couple[1::2], -turned_back - sheared, rtol=2e-3, atol=1e-6)
    (pulled,) = jaxrod.systems.pose_spring_reactions(system.at(0.0), {"rods": start})
    close(pulled.force, (0.6, 0, 0))
    close(pulled.power, 0)


@runs("free_body", "HealthLimits")
def test_a_rod_cut_free_has_the_force_of_its_joint_and_a_gap_is_flagged():
    rod, of_one = straight(2)
    _, of_two = straight(2, start=(1, 0, 0))
    rest, ends = {"one": of_one, "two": of_two}, (("one", "tip"), ("two", "base"))
    joint = jaxrod.systems.ball_joint(*ends, rest, stiffness=200.0)
    loose = jaxrod.make_scene(rod)
    system = jaxrod.make_system({"one": loose, "two": loose}, joint)
    apart = replace(of_two, positions=of_two.positions.at[1].add(0.5 * RADIUS))
    state = {**rest, "two": apart}
    cut, own = jaxrod.systems.free_body(system, state, "one")
    forces = cut.effects[-1].loads(cut.rod, cut.as_member().motion(own)).forces
    close(np.stack(forces)[:, -1], (0, 200.0 * 0.5 * RADIUS, 0))
    for largest, wrong in ((0.4, True), (0.6, False)):
        limits = jaxrod.HealthLimits(largest_gap=jnp.asarray(largest))
        seen = jaxrod.health(system, state, 1e-5, limits=limits)
        assert bool(seen.joints) == bool(seen.flagged) == wrong


TOUCHING = ("rods", "crossing", "body", "bodies")


def touching(stiff, gap, way=(1, 0, 0)):
    """Two rods and two balls, with every law of contact; one has a stiffness.

    Args:
        stiff: Which.
        gap: From the surface of one rod to that of the other; below 0 they touch.
        way: Along which the other lies, above the first one.
    """
    way = np.asarray(way, float)
    one, of_one = straight(3)
    middle = np.array([0.5, 0, 2 * RADIUS + gap])
    other, of_other = straight(
        3, start=middle - 0.5 * way, direction=way, normal=(0, 0, 1)
    )
    balls = [
        jaxrod.systems.rigid_body(
            jaxrod.shapes.sphere(place, 0.1), density=1000.0, dtype=jnp.float64
        )
        for place in (
            (0.5, 0, -0.1 - RADIUS + DEEP),
            (0.5, 0, -0.3 - RADIUS + 2 * DEEP),
        )
    ]
    balls, of_balls = jaxrod.systems.stacked_bodies(*balls)
    state = {"one": of_one, "other": of_other, "balls": of_balls}
    k = dict.fromkeys(TOUCHING, 1e-30) | {stiff: STIFF}
    ground = jaxrod.shapes.plane((0, 0, -0.4 - RADIUS + 3 * DEEP))
    system = jaxrod.make_system(
        {
            "one": jaxrod.make_scene(one),
            "other": jaxrod.make_scene(other),
            "balls": balls,
        },
        jaxrod.systems.rod_contact("one", "other", stiffness=k["rods"]),
        jaxrod.systems.crossing_contact("one", "other", stiffness=k["crossing"]),
        jaxrod.systems.body_contact("one", "balls", stiffness=k["body"]),
        jaxrod.systems.rigid_contact("balls", fixed=ground, stiffness=k["bodies"]),
        state=state,
    )
    time = 5e-5
    state = jaxrod.advance(system, state, time / 5, 5)
    rods = [
        state[name].velocities @ one.node_masses / time for name in ("one", "other")
    ]
    pushed = state["balls"].velocities * balls.masses[None] / time
    return (*np.asarray(rods), *np.asarray(pushed).T)


@runs("rod_contact")
def test_rods_side_by_side_press_by_their_length():
    one, other, *balls = touching("rods", -DEEP)
    close(other[2], STIFF * DEEP, rtol=1e-3)
    close(one, -other, atol=1e-9)
    close(balls, np.zeros((2, 3)), atol=1e-9)


@runs("crossing_contact")
def test_rods_that_cross_press_as_one_spring():
    one, other, *_ = touching("crossing", -DEEP, (0, 1, 0))
    close(other[2], STIFF * DEEP, rtol=1e-3)
    close(one, -other, atol=1e-9)


@runs("body_contact", "stacked_bodies")
def test_a_rod_presses_on_a_ball_and_the_ball_on_the_rod():
    one, other, ball, ground = touching("body", 1.0)
    assert one[2] > 0.01 * STIFF * DEEP
    close(ball, -one, atol=1e-9)
    close([other, ground], np.zeros((2, 3)), atol=1e-9)


@runs("rigid_contact", "plane")
def test_balls_press_on_each_other_and_on_the_ground():
    one, _, upper, lower = touching("bodies", 1.0)
    close(one, ZERO, atol=1e-9)
    close(upper, (0, 0, STIFF * DEEP), rtol=1e-3, atol=1e-9)
    # The ball above and the ground below push alike.
    close(lower, ZERO, atol=1e-3 * STIFF * DEEP)


@runs("ring")
def test_a_ring_stays_closed_and_keeps_momentum():
    material = {"radius": RADIUS, "density": 1000.0, "youngs_modulus": 1e6}
    rod, rest, closure = jaxrod.systems.ring(
        6, length=1.0, **material, dtype=jnp.float64
    )
    system = jaxrod.make_system({"ring": jaxrod.make_scene(rod)}, closure)
    kick = jnp.asarray([1.0, 0, 0, 0, 0, 0, 1.0])
    start = {"ring": replace(rest, velocities=rest.velocities.at[0].add(kick))}
    state = jaxrod.advance(system, start, 1e-4, 20)
    close(system.momentum(state), system.momentum(start))
    nodes = state["ring"].positions
    close(nodes[:, 0], nodes[:, -1])
    assert nodes[0, 0] - rest.positions[0, 0] > 5e-4
    # Its neighbours follow only because the ring is one piece on both sides.
    both = state["ring"].velocities[0, jnp.asarray([1, -2])]
    assert both[0] > 0.01
    close(both[0], both[1], rtol=1e-6)


@runs("crossed")
def test_what_went_through_is_told_from_what_did_not():
    one = REST.positions
    over = jnp.stack([0.5 + 0 * one[0], one[0] - 0.5, 0 * one[0] + 0.1])
    under = over.at[2].add(-0.2)
    assert jaxrod.topology.crossed(one, one, over, under)
    assert not jaxrod.topology.crossed(one, one, over, over.at[2].add(-0.05))


# Lists of neighbours: both laws in one system, on rods of their own


def heaps(listed, skin=0.5):
    """Rods that fly at each other, by either law; and the state."""
    x, y, z = np.eye(3)
    r = 0.02
    high = 1.95 * r * z
    starts = [-0.5 * x, -0.5 * y + high, -0.5 * x + 2 * high]
    rods, state = laid_out(starts, [x, y, x], radius=r)
    speeds = (
        jnp.asarray([0.3, 0.0, -0.3])[:, None, None] * jnp.asarray(z)[None, :, None]
    )
    state = replace(state, velocities=state.velocities + speeds)
    state = {"line": state, "crossing": state}
    lists = None
    if listed:
        lists = jaxrod.systems.neighbour_lists(
            refresh_every=4, skin=skin, pairs=30, candidates=60
        )
    line = jaxrod.systems.rod_contact(
        "line", stiffness=1e4, points_per_element=4, lists=lists
    )
    crossing = jaxrod.systems.crossing_contact("crossing", stiffness=1e3, lists=lists)
    members = dict.fromkeys(state, rods)
    return jaxrod.make_system(members, line, crossing, state=state), state


STEP, STEPS = 2e-4, 10
LAWS = pytest.mark.parametrize("law", ["line", "crossing"])


@pytest.fixture(scope="module")
def listed():
    """The system with lists, its state, and the state some steps on, by `jax.jit`."""
    system, state = heaps(listed=True)
    advance = jax.jit(jaxrod.advance, static_argnums=3)
    return system, state, advance(system, state, STEP, STEPS)


@pytest.fixture(scope="module")
def unlisted():
    """The same without lists, some steps on."""
    return jaxrod.advance(*heaps(listed=False), STEP, STEPS)


@LAWS
@runs("neighbour_lists", "rod_contact", "crossing_contact")
def test_lists_of_neighbours_change_nothing(law, listed, unlisted):
    system, start, state = listed
    assert set(state) == {*start, "neighbours"} and set(unlisted) == set(start)
    for name in ("positions", "velocities", "angular_momenta"):
        found, wanted = (getattr(one[law], name) for one in (state, unlisted))
        close(found, wanted, rtol=1e-12, atol=1e-13)
    # They have pressed each other apart, and kept what momentum there was.
    change = (state[law].velocities - start[law].velocities)[:, 2].mean(axis=-1)
    assert change[0] < -1e-3 and change[2] > 1e-3
    close(system.momentum(state), ZERO)


@runs("neighbours", "health")
def test_lists_are_counted_and_say_that_nothing_was_missed(listed):
    system, start, state = listed
    health = jaxrod.health(system, state, STEP)
    assert not health.overflow and not health.stale and not health.flagged
    for near in jaxrod.systems.neighbours(system, start):
        # Two crossings of three elements by three: the middles, at least.
        assert near.pairs[0] >= 2
        assert near.candidates[0] >= near.pairs[0]
        assert 0 < near.occupancy < 1


def test_lists_that_are_too_old_are_flagged():
    system, start = heaps(listed=True, skin=1e-3)
    state = jaxrod.advance(system, start, STEP, STEPS)
    assert jaxrod.health(system, state, STEP).stale


def faster(start, factor):
    """The state with speeds so many times as large."""
    return {
        name: replace(state, velocities=factor * state.velocities)
        for name, state in start.items()
    }


def went(system, start, factor=1.0):
    """The state some steps on, begun so many times as fast, without the record."""
    state = jaxrod.advance(system, faster(start, factor), STEP, STEPS)
    return {name: state[name] for name in start}


@pytest.mark.slow
def test_systems_with_lists_run_within_vmap(listed):
    system, start, state = listed
    factors = jnp.asarray([1.0, 0.5])
    found = jax.vmap(went, (None, None, 0))(system, start, factors)
    for k, wanted in enumerate((state, went(system, start, 0.5))):
        for law in start:
            close(found[law].positions[k], wanted[law].positions, rtol=1e-13)
            close(found[law].velocities[k], wanted[law].velocities, rtol=1e-11)


@pytest.mark.slow
def test_systems_with_lists_run_within_grad(listed):
    """The gradient of each law is that of differences."""
    system, start, _ = listed

    def heights(factors):
        fast = {
            name: replace(state, velocities=factors[name] * state.velocities)
            for name, state in start.items()
        }
        state = jaxrod.advance(system, fast, STEP, STEPS)
        return {name: jnp.sum(state[name].velocities[:, 2] ** 2) for name in start}

    one = dict.fromkeys(start, 1.0)
    # By itself, without jit, it takes longer to compile.
    slope = jax.jit(jax.grad(lambda factors: sum(heights(factors).values())))(one)
    h = 1e-5
    ahead, back = (heights(dict.fromkeys(start, 1 + k * h)) for k in (1, -1))
    for law in start:
        close(slope[law], (ahead[law] - back[law]) / (2 * h), rtol=1e-5)

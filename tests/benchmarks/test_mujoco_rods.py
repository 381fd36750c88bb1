"""Three rods beside MuJoCo 4's: the references are right, and the jobs are complete."""

import sys

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.special import j0, jn_zeros

from benchmarks.mujoco_rods import errors, flex_jobs, problem, references, scenes
from benchmarks.mujoco_rods.flex_jobs import Setting

G = scenes.GRAVITY


def found(tips, nodes=None, speed=0.0):
    return problem.Run(np.asarray(tips), np.asarray(nodes), speed, 1e-3, 1.0, 0.5)


def test_small_deflections_are_linear():
    bending, force, shearing = 0.2, 1e-6, 30.0
    linear = force * 2.0**3 / (3 * bending)
    assert references.tip_deflection(2.0, bending, force) == pytest.approx(linear, 1e-9)
    sheared = references.tip_deflection(2.0, bending, force, shearing=shearing)
    assert sheared == pytest.approx(linear + force * 2.0 / shearing, 1e-9)


@pytest.mark.parametrize(
    "load, deflection", [(1, 0.3017207739), (2, 0.4934574804), (10, 0.8106090249)]
)
def test_large_deflections_are_those_of_elliptic_integrals(load, deflection):
    """Mattiasson (1981), numbers of a cantilever with F L^2 / EI = load."""
    assert references.tip_deflection(1.0, 1.0, load) == pytest.approx(deflection, 1e-9)


def test_a_rod_that_shears_and_stretches_is_found_by_shooting_too():
    bending, force, stretching, shearing = 1.0, 1.5, 40.0, 15.0

    def slopes(place, state):
        _, angle, moment = state
        along = 1 + force * np.sin(angle) / stretching
        across = force * np.cos(angle) / shearing
        x = along * np.cos(angle) - across * np.sin(angle)
        return [
            along * np.sin(angle) + across * np.cos(angle),
            moment / bending,
            -force * x,
        ]

    def end(moment):
        shot = solve_ivp(slopes, (0, 1), [0, 0, moment], rtol=1e-11, atol=1e-12)
        return shot.y[:, -1]

    moment = brentq(lambda guess: end(guess)[2], 0.1, 3.0, xtol=1e-13)
    expected = references.tip_deflection(1.0, bending, force, stretching, shearing)
    assert end(moment)[0] == pytest.approx(expected, 1e-8)


def test_without_bending_the_cable_is_bernoullis_chain():
    zero = jn_zeros(0, 1)[0]
    swing = references.swing(0.7, 1e-12, 0.3, np.inf, G, 100)
    assert swing.frequency == pytest.approx(zero / 2 * np.sqrt(G / 0.7), 1e-8)
    s = np.linspace(0, 0.7, 29)
    assert swing.shape(s) == pytest.approx(j0(zero * np.sqrt(1 - s / 0.7)), abs=1e-6)


def test_bending_makes_the_swing_faster_by_its_energy():
    """To first order in EI: Rayleigh's quotient with the chain's own mode."""
    weight, bending = 0.3, 1e-6
    chain = references.swing(1.0, 1e-14, weight, np.inf, G)
    bent = references.swing(1.0, bending, weight, np.inf, G)
    s = np.linspace(0, 1, 20001)
    stored = bending * np.trapezoid(chain.shape(s, 2) ** 2, s)
    moved = weight / G * np.trapezoid(chain.shape(s) ** 2, s)
    gained = bent.frequency**2 - chain.frequency**2
    assert gained == pytest.approx(stored / moved, 0.05)


def test_the_swing_has_converged():
    rod = scenes.SWINGING
    numbers = (rod.length, rod.bending, rod.weight, rod.stretching, G)
    coarse, fine = (references.swing(*numbers, n).frequency for n in (50, 200))
    assert coarse == pytest.approx(fine, 1e-7)
    assert errors.swing().frequency == fine


@pytest.mark.parametrize("stretching", [np.inf, 5.0])
def test_the_catenary_hangs_from_its_pins_in_balance(stretching):
    span, length, weight = 0.8, 1.1, 0.7
    cable = references.catenary(span, length, weight, stretching)
    ends = cable.places(np.asarray([0.0, length]))
    assert ends == pytest.approx(np.asarray([[0, 0], [span, 0]]), abs=1e-13)
    s = np.linspace(0, length, 12)
    slopes = (cable.places(s + 1e-5) - cable.places(s - 1e-5)) / 2e-5
    lift = weight * (s - length / 2)
    tension = np.hypot(cable.pull, lift)
    assert np.hypot(*slopes.T) == pytest.approx(1 + tension / stretching, 1e-8)
    assert slopes[:, 1] / slopes[:, 0] == pytest.approx(lift / cable.pull, 1e-8)


def test_a_cable_that_does_not_stretch_is_the_textbook_catenary():
    span, length, weight = 0.8, 1.0, 0.7
    scale = brentq(lambda a: 2 * a * np.sinh(span / (2 * a)) - length, 0.1, 2.0)
    cable = references.catenary(span, length, weight, np.inf)
    assert cable.pull == pytest.approx(weight * scale, 1e-10)
    x, z = cable.places(np.linspace(0, length, 9)).T
    curve = scale * (np.cosh((x - span / 2) / scale) - np.cosh(span / (2 * scale)))
    assert z == pytest.approx(curve, abs=1e-12)
    yielding = references.catenary(span, length, weight, 1e9)
    assert yielding.pull == pytest.approx(cable.pull, 1e-8)


def test_a_cable_that_hardly_bends_is_a_catenary():
    rod, cable = scenes.HANGING, errors.catenary()
    exact = cable.places(rod.places)
    apart = []
    for bending in (rod.bending, rod.bending / 100):
        bent = references.bent_cable(cable, bending, 1e9, rod.places)
        assert bent[0] == pytest.approx([0, 0], abs=1e-10)
        assert bent[-1] == pytest.approx([scenes.SPAN, 0], abs=1e-10)
        apart.append(np.max(np.abs(bent - exact)))
    assert apart[1] < 0.02 * apart[0] < 2e-5


def test_rods_start_as_long_as_they_are_said_to_be():
    rod = scenes.SWINGING
    lengths = np.linalg.norm(np.diff(scenes.swung_aside(rod), axis=0), axis=1)
    assert lengths == pytest.approx(-np.diff(scenes.hung(rod)[:, 2]), 1e-12)
    assert scenes.swung_aside(rod)[-1, 0] == pytest.approx(scenes.AMPLITUDE)
    middle = rod.weight * rod.length / 2 / rod.stretching
    assert np.sum(lengths) == pytest.approx(rod.length * (1 + middle), 1e-12)
    bow = scenes.arc(scenes.HANGING)
    assert bow[[0, -1]] == pytest.approx(
        np.asarray([[0, 0, 0], [scenes.SPAN, 0, 0]]), abs=1e-12
    )
    chords = np.linalg.norm(np.diff(bow, axis=0), axis=1)
    assert np.sum(chords) == pytest.approx(1.0, 1e-3) and np.ptp(chords) < 1e-12
    assert np.min(bow[:, 2]) < -0.2


def test_errors_of_the_references_themselves_are_zero():
    times = np.linspace(0, scenes.SWINGING.seconds, 501)
    turned = errors.swing().frequency * (1 + 1e-4) * times
    x = 1e-3 + 0.02 * np.cos(turned + 0.3)
    swung = found(np.stack([x, 0 * x, 0 * x], axis=1))
    assert errors.measure_period(swung)[0] == pytest.approx(-1e-4, 1e-3)
    exact = errors.deflections()
    apart = errors.measure_deflection(found([[0, 0, exact.sheared]]))
    assert apart[1] == 0 and apart[0] == pytest.approx(9.3e-4, 0.01)
    places = errors.catenary().places(scenes.HANGING.places)
    nodes = np.stack([places[:, 0], 0 * places[:, 0], places[:, 1]], axis=1)
    assert errors.measure_shape(found(nodes[-1:], nodes))[:2] == pytest.approx([0, 0])
    with pytest.raises(ValueError, match=r"still moves, by 0\.001 m/s"):
        errors.measure_shape(found(nodes[-1:], nodes, speed=1e-3))


def test_a_job_says_all_that_a_rod_needs():
    pytest.importorskip("mujoco")
    from benchmarks.mujoco_rods import flex

    clamped = flex_jobs.job(
        problem.cantilever(), Setting("held", 1e-3, short_edge=True)
    )
    swung = flex_jobs.job(problem.swinging(), Setting("held", 1e-4))
    sprung = flex_jobs.job(problem.swinging(), Setting("springs", 1e-4))
    for job in (clamped, swung, sprung):
        read = flex.Job(**job)
        assert len(read.rest) == len(read.start) == len(read.masses)
        whole = 1000 * np.pi * read.radius**2
        assert sum(read.masses) == pytest.approx(whole, 1e-12)
        assert f'timestep="{read.dt:.17g}"' in flex.xml(read)
    assert clamped["held"] == [0, 1] and len(clamped["rest"]) == 22
    assert swung["held"] == [0] and swung["steps"] * swung["looks"] == 50_000
    # What is held is as long as it hangs, what has springs stretches by itself.
    assert swung["rest"][-1][2] == pytest.approx(scenes.hung(scenes.SWINGING)[-1, 2])
    assert sprung["rest"][-1] == [0, 0, -1]


def test_a_python_without_mujoco_is_named_with_its_reason(tmp_path):
    with pytest.raises(ValueError, match=r"--mujoco .*nowhere: No such file"):
        flex_jobs.run_all(str(tmp_path / "nowhere"), [])
    bare = tmp_path / "bare"
    bare.write_text(f'#!/bin/sh\nexec {sys.executable} -S -E "$@"\n')
    bare.chmod(0o755)
    with pytest.raises(ValueError, match=r"could not run its rods: ModuleNotFound"):
        flex_jobs.run_all(str(bare), [])


@pytest.mark.slow
def test_the_rods_are_near_their_references_in_jaxrod():
    from benchmarks.mujoco_rods import ours

    plane = ours.METHODS["in a plane"]
    bent = ours.run(problem.cantilever(), plane)
    assert abs(errors.measure_deflection(bent)[1]) < 1.5e-3
    assert abs(errors.measure_period(ours.run(problem.swinging(), plane))[0]) < 2e-4
    coupled = ours.run(problem.swinging(), plane, "higher_order")
    assert 2e-5 < errors.measure_period(coupled)[0] < 3e-5
    shape, sag, rest = errors.measure_shape(ours.run(problem.hanging(), plane))
    assert shape < 6e-4 and abs(sag) < 3e-4 and rest < 1e-4

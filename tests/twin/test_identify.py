"""Twins of made-up arms have the true numbers, within their standard deviations."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxrod
from jaxrod import twin
from jaxrod.geometry import rotations, vectors
from jaxrod.rods.motion import motion_of
from jaxrod.twin.arm import LOGARITHMIC
from jaxrod.twin.identification import _mean_square, _robust
from twin.made_up import a_camera, drawing, drawn_values, filmed, pose, swing

POSES = ((0.0, 0.0), (1.5, 0.0), (0.0, 1.5), (3.0, 0.5), (0.5, 3.0))


@pytest.fixture(autouse=True)
def in_float64():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def arm():
    """One arm for all tests: its program is compiled once."""
    return drawing(
        axes=None, youngs_modulus=0.3, density=0.3, tension=0.3, tendon_angles=0.05,
        eyelet_distance=0.05, shift=0.05, turn=0.2,
    )  # fmt: skip


def scores(found, values):
    """Errors of all unknowns in standard deviations."""
    z = found.fit.z({name: jnp.asarray(values[name]) for name in found.arm.unknown})
    return np.concatenate([np.ravel(value) for value in z.values()])


@pytest.mark.slow
def test_poses_without_noise_give_the_numbers_back(arm):
    """All but the scale of all forces, which poses never show."""
    truth = drawn_values(arm, np.random.default_rng(1), tension=1.0)
    films = [filmed(arm, truth, pose(*pulls)) for pulls in POSES]
    found = twin.identify(arm, films, noise=1e-6)
    assert bool(found.fit.converged)
    values, pull = found.values, float(found.values["tension"])
    for name in ("youngs_modulus", "density"):
        assert np.isclose(values[name] / pull, truth[name], rtol=1e-5)
    assert np.allclose(values["tendon_angles"], truth["tendon_angles"], atol=1e-5)
    assert np.isclose(values["eyelet_distance"], truth["eyelet_distance"], rtol=1e-4)
    assert all(np.max(one.errors) < 1e-6 for one in found.compare(found.recordings))


@pytest.mark.slow
def test_the_scale_of_all_forces_is_left_open(arm):
    """Stiffness, density and tension, all doubled, leave every pose as it is."""
    films = [filmed(arm, arm.start, pose(*pulls)) for pulls in POSES]
    found = twin.identify(arm, films, noise=1e-4)
    (words,) = found.undetermined
    assert all(
        f"{name} +1.0" in words for name in ("youngs_modulus", "density", "tension")
    )
    # Of three standard deviations of 0.3 that of their mean is left.
    sds = dict(
        zip(found.fit.names, np.diagonal(found.fit.covariance) ** 0.5, strict=True)
    )
    assert np.isclose(sds["density"], 0.3 / np.sqrt(3), rtol=0.02)
    assert "known from the drawing alone: " + words in str(found)


@pytest.mark.slow
def test_couples_of_weights_of_markers_are_those_of_their_energy():
    arm = drawing(marker_masses=0.01)
    masses = jnp.asarray([0.004, 0.008, 0.002, 0.006])
    values = arm.start | {"marker_masses": masses}
    scene, state = arm.scene(values, lambda numbers: jnp.ones(len(numbers)))
    (weights,) = (e for e in scene.effects if isinstance(e, twin.arm.MarkerWeights))

    def turned(state, turns):
        q = rotations.split_quaternion(state.orientations)
        small = rotations.rotation_exp(vectors.split(turns))
        both = rotations.multiply_quaternions(q, small)
        return replace(state, orientations=rotations.join_quaternion(both))

    @jax.jit
    def found(turns):
        state_there = turned(state, turns)
        slopes = jax.grad(
            lambda more: weights.energy(scene.rod, turned(state_there, more))
        )(0 * turns)
        return weights.loads(scene.rod, motion_of(state_there)).couples, slopes

    any_turn = 0.5 * np.random.default_rng(0).standard_normal((3, arm.elements))
    couples, slopes = found(jnp.asarray(any_turn))
    assert np.allclose(slopes, -np.stack(couples), atol=1e-12)
    assert np.max(np.abs(slopes)) > 1e-4


def test_markers_pull_at_their_places():
    """About the base, a straight arm feels their weights where the markers are."""
    tilted = {"direction": (0.6, 0.0, -0.8), "normal": (0.0, 1.0, 0.0)}
    arm = replace(drawing(marker_masses=0.01), **tilted)
    masses = np.array([0.004, 0.008, 0.002, 0.006])
    pull = np.array([0.0, 0.0, -9.81])

    @jax.jit
    def felt(given):
        """Moment of all loads about the base [N m], and the mass [kg]."""
        values = arm.start | {"marker_masses": given}
        scene, state = arm.scene(values, lambda numbers: jnp.zeros(len(numbers)))
        moment = jnp.zeros(3)
        for effect in scene.effects:
            loads = effect.loads(scene.rod, motion_of(state))
            if loads.forces is not None:
                forces = jnp.stack(loads.forces)
                moment += jnp.sum(jnp.cross(state.positions, forces, axis=0), axis=1)
            if isinstance(effect, twin.arm.MarkerWeights):
                couples = jnp.stack(loads.couples)
                moment += jnp.sum(state.directors * couples[:, None], axis=(0, 2))
        return moment, jnp.sum(scene.rod.node_masses)

    moments, total = zip(felt(masses), felt(0 * masses), strict=True)
    d3, d1 = np.array(tilted["direction"]), np.array(tilted["normal"])
    frame = np.stack([d1, np.cross(d3, d1), d3])
    places = [m.at * d3 + np.asarray(m.offset) @ frame for m in arm.markers]
    wanted = np.sum(masses[:, None] * np.cross(places, pull), axis=0)
    assert np.allclose(moments[0] - moments[1], wanted, atol=1e-12)
    assert np.linalg.norm(wanted) > 1e-3
    assert np.isclose(total[0] - total[1], masses.sum())


@pytest.mark.slow
def test_a_marker_that_jumps_spoils_a_plain_fit_and_not_a_robust_one(arm):
    films = [filmed(arm, arm.start, pose(*pulls)) for pulls in POSES]
    films[1].points[:, 2] += 0.05
    plain = twin.identify(arm, films, noise=1e-3)
    robust = twin.identify(arm, films, noise=1e-3, robust=2.0)

    def off(found):
        """Errors of the arm's own numbers: the marker moves the camera's frame, too."""
        z = found.fit.z({name: arm.start[name] for name in arm.unknown})
        own = [z[name] for name in z if name not in ("shift", "turn")]
        return float(np.sqrt(np.mean(np.concatenate([np.ravel(x) for x in own]) ** 2)))

    assert off(robust) < 0.3 * off(plain) and off(robust) < 1.5


@pytest.mark.parametrize("limit", [None, 1.0, 3.0])
def test_noise_that_is_normal_is_estimated_without_bias(limit):
    away = np.random.default_rng(0).standard_normal((200_000, 3))
    weight, cost = _robust(away, limit)
    mean = np.mean((weight**2 * away) ** 2)
    assert np.isclose(mean, _mean_square(limit), rtol=5e-3)
    # The gradient of the cost is that of the squares at constant weights.
    more = _robust(1.0001 * away, limit)[1] - _robust(0.9999 * away, limit)[1]
    assert np.isclose(more / 2e-4, 2 * np.sum((weight * away) ** 2), rtol=1e-6)
    assert cost <= np.sum(away**2) + 1e-6


@pytest.mark.slow
def test_a_robust_fit_estimates_the_noise_in_spite_of_a_marker_that_jumps(arm):
    films = [filmed(arm, arm.start, pose(*pulls, frames=1)) for pulls in POSES]
    rng = np.random.default_rng(0)
    for film in films:
        film.points[:] += 1e-3 * rng.standard_normal(film.points.shape)
    films[1].points[:, 2] += 0.05
    robust = twin.identify(arm, films, robust=2.0)
    assert bool(robust.fit.converged) and 0.7e-3 < robust.noise < 1.5e-3
    assert twin.identify(arm, films).noise > 4e-3


def found_in_draw(arm, seed, made, **late):
    """The twin of one made-up log: its z-scores, and whether all labels are right."""
    rng = np.random.default_rng(seed)
    values = drawn_values(arm, rng, shift=np.zeros(3), turn=np.zeros(3), **late)
    camera = a_camera(rng)
    films, orders = zip(*[
        filmed(arm, values, one, noise=5e-4, missing=0.05, camera=camera, rng=rng)
        for one in made
    ], strict=True)  # fmt: skip
    found = twin.identify(arm, films)
    right = all(
        np.array_equal(np.argsort(order), given)
        for order, given in zip(orders, found.registration.orders, strict=True)
    )
    # The registered frame is off by a turn and a shift, which are unknowns.
    turn = found.registration.rotation @ camera[0].T
    vector = Rotation.from_matrix(turn).as_rotvec()
    shift = found.registration.shifts[0] - np.sum(turn * camera[1], axis=-1)
    truth = values | {"turn": vector, "shift": shift}
    return found, scores(found, truth), right


@pytest.mark.slow
def test_a_shuffled_log_of_poses_is_found(arm):
    found, z, right = found_in_draw(arm, 0, [pose(*pulls) for pulls in POSES])
    assert right and bool(found.fit.converged)
    assert 0.3 < np.sqrt(np.mean(z**2)) < 2
    # The median of 40 frames with half a millimetre of noise.
    assert 3e-5 < found.noise < 2e-4
    (one,) = found.compare([found.recordings[1]])
    assert np.max(one.errors) < 1e-3 and np.all(one.sd < 1e-3)


@pytest.mark.slow
def test_a_recording_read_again_is_compared_as_in_the_fit():
    """Registered with the twin or with the drawing, its frame is the same."""
    arm = drawing(youngs_modulus=0.3, shift=0.01, turn=0.1)
    still = (twin.Marker("base", 0.0, (0.03, 0.0, 0.0)), *arm.markers)
    arm = replace(arm, markers=still, frame=replace(arm.frame, origin="base"))
    rng = np.random.default_rng(2)
    truth = arm.start | {
        "shift": jnp.asarray([0.004, -0.003, 0.002]), "turn": jnp.full(3, 0.05)
    }  # fmt: skip
    films = []
    for pulls in POSES:
        film = filmed(arm, truth, replace(pose(*pulls), points=np.zeros((40, 5, 3))))
        film.points[:, 0] = arm.straight[0]
        moved = film.points + rng.uniform(-1, 1, 3)
        order = rng.permutation(5)
        films.append(replace(film, points=moved[:, order], labelled=False))
    found = twin.identify(arm, films[:4], noise=1e-4)
    for one in found.compare(films):
        assert np.isnan(one.errors[0]) and np.nanmax(one.errors) < 1e-6


@pytest.mark.slow
def test_a_pose_is_that_of_an_arm_made_by_hand():
    """Rod, tendon, markers and frame from their definitions, without `Arm`."""
    n, length, pulley, torque, angle = 6, 0.3, 0.02, 0.05, np.radians(40)
    turn = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
    middles = (np.arange(n) + 0.5) * length / n
    rod, state = jaxrod.straight_rod(
        n, length=length, radius=0.015 - 0.02 * middles, density=1100.0,
        youngs_modulus=4e5, poisson_ratio=0.45, direction=(0.0, 0.0, -1.0),
        normal=(0.0, 1.0, 0.0),
    )  # fmt: skip
    distance = 0.012 - 0.02 * middles[:5]
    eyelets = np.stack([np.cos(angle) * distance, np.sin(angle) * distance])
    cable = jaxrod.actuation.tendon(
        rod, eyelets[None], tension=np.array([torque / pulley]), elements=(0, 4)
    )
    scene = jaxrod.make_scene(
        rod, jaxrod.clamp(state), jaxrod.gravity((0.0, 0.0, -9.81)), cable
    )
    found = jaxrod.equilibrium(scene, state)
    assert bool(found.converged)
    seen = []
    for k, offset in ((2, (0.02, -0.01, 0.005)), (4, (0.0, 0.03, 0.0))):
        centre = 0.5 * (found.state.positions[:, k] + found.state.positions[:, k + 1])
        seen.append(centre + np.asarray(offset) @ found.state.directors[:, :, k])
    origin = np.array([500.0, -300.0, 200.0])
    recorded = np.array(seen) @ turn / 1e-3 + origin
    arm = twin.Arm(
        elements=n, length=length, radius=[[0.0, 0.015], [0.3, 0.009]], density=1100.0,
        youngs_modulus=4e5, poisson_ratio=0.45, direction=(0.0, 0.0, -1.0),
        normal=(0.0, 1.0, 0.0), gravity=(0.0, 0.0, -9.81),
        tendons=(
            twin.TendonDrawing("motor", angle, [[0.0, 0.012], [0.3, 0.006]], pulley,
                               0.25),
        ),
        markers=(
            twin.Marker("a", middles[2], (0.02, -0.01, 0.005)),
            twin.Marker("b", middles[4], (0.0, 0.03, 0.0)),
        ),
        unknown={"youngs_modulus": 0.1},
        frame=twin.Frame(turn, tuple(origin), 1e-3),
    )  # fmt: skip
    inputs, points = np.array([[torque]]), 1e-3 * recorded[None]
    film = twin.Recording("by hand", np.zeros(1), inputs, points)
    fit = twin.identify(arm, [film], noise=1e-3, iterations=0)
    (one,) = fit.compare(fit.recordings)
    assert np.max(one.errors) < 1e-9
    assert np.linalg.norm(np.array(seen)[1] - arm.straight[1]) > 0.02


@pytest.mark.slow
def test_an_arm_lags_behind_its_inputs_by_the_delay():
    """Inputs that come six frames late are those of a delay of six frames."""
    arm, film = drawing(delay=0.05), swing(frames=40)
    late = np.concatenate([np.repeat(film.inputs[:1], 6, 0), film.inputs[:-6]])
    by_inputs = filmed(arm, arm.start, replace(film, inputs=late))
    by_delay = filmed(arm, arm.start | {"delay": jnp.asarray(0.1)}, film)
    at_once = filmed(arm, arm.start, film)
    assert np.max(np.abs(by_inputs.points - by_delay.points)) < 1e-9
    assert np.max(np.abs(at_once.points - by_delay.points)) > 5e-3


@pytest.mark.slow
def test_an_arm_without_tendons_is_found_from_its_sag():
    arm = replace(
        drawing(youngs_modulus=0.3), tendons=(), direction=(1.0, 0.0, 0.0),
        normal=(0.0, 1.0, 0.0),
    )  # fmt: skip
    still = twin.Recording("sag", np.zeros(1), np.zeros((1, 0)), np.zeros((1, 4, 3)))
    film = filmed(arm, arm.start | {"youngs_modulus": jnp.asarray(6e5)}, still)
    found = twin.identify(arm, [film], noise=1e-5)
    assert np.isclose(found.values["youngs_modulus"], 6e5, rtol=1e-4)


@pytest.mark.slow
def test_twenty_logs_with_motions_are_calibrated():
    arm = drawing(
        axes=None, youngs_modulus=0.3, density=0.1, tendon_angles=0.05, shift=0.05,
        eyelet_distance=0.05, turn=0.2, delay=0.05, damping=0.5,
    )  # fmt: skip
    made = [*(pose(*pulls) for pulls in POSES), swing()]
    every = [found_in_draw(arm, seed, made, delay=0.03) for seed in range(20)]
    assert all(right for *_, right in every)
    assert all(bool(found.fit.converged) for found, *_ in every)
    rms = float(np.sqrt(np.mean(np.concatenate([z for _, z, _ in every]) ** 2)))
    assert 0.8 < rms < 1.25


@pytest.mark.slow
def test_too_few_coordinates_show_no_noise(arm):
    film = filmed(arm, arm.start, pose(1.5, 0.0))
    with pytest.raises(ValueError, match="12 coordinates are too few"):
        twin.identify(arm, [film])
    film.points[:] *= 1000
    with pytest.raises(ValueError, match="is the scale of the frame wrong"):
        twin.identify(arm, [film])


def test_a_frame_that_is_not_known_must_be_among_the_unknowns():
    film = pose(1.0, 0.0)
    for arm, name in (
        (drawing(axes=None, youngs_modulus=0.3, shift=0.1), "turn"),
        (drawing(axes=None, youngs_modulus=0.3, turn=0.1), "shift"),
        (replace(drawing(youngs_modulus=0.3), frame=twin.Frame(np.eye(3))), "shift"),
    ):
        with pytest.raises(ValueError, match=f"not known, so {name} must be among"):
            twin.identify(arm, [film])


def test_bad_frames_are_refused_in_words():
    with pytest.raises(ValueError, match="unit vectors at right angles"):
        twin.Frame(2 * np.eye(3))
    with pytest.raises(ValueError, match="axes of the frame must be right-handed"):
        twin.Frame(np.diag([1.0, 1.0, -1.0]))
    with pytest.raises(ValueError, match="scale of the frame must be positive"):
        twin.Frame(scale=0.0)
    with pytest.raises(ValueError, match="an origin of the frame needs its axes"):
        twin.Frame(origin=(0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="of the frame must be a point or a marker"):
        replace(drawing(), frame=twin.Frame(np.eye(3), "base"))
    quarter = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    arm = replace(drawing(), frame=twin.Frame(quarter, (100.0, 20.0, 3.0), 1e-3))
    # The base of the arm is where the camera has its origin.
    assert np.allclose(quarter @ [0.1, 0.02, 0.003] + arm.shift, 0)


def test_bad_input_is_refused_in_words(tmp_path):
    arm, film = drawing(youngs_modulus=0.3), pose(1.0, 0.0)
    with pytest.raises(ValueError, match="at least one recording"):
        twin.identify(arm, [])
    with pytest.raises(ValueError, match="noise must be positive"):
        twin.identify(arm, [film], noise=-1.0)
    with pytest.raises(ValueError, match="no unknowns"):
        twin.identify(replace(arm, unknown={}), [film])
    with pytest.raises(ValueError, match="unknown 'stiffness' is not one of"):
        replace(arm, unknown={"stiffness": 1.0})
    with pytest.raises(ValueError, match=r"must be on the arm of 0\.3 m, got 0\.4 m"):
        replace(arm, markers=(twin.Marker("far", 0.4),))
    with pytest.raises(ValueError, match="arc lengths of radius must increase"):
        replace(arm, radius=[[0.3, 0.01], [0.0, 0.02]])
    with pytest.raises(ValueError, match="poisson_ratio must be above -1"):
        replace(arm, poisson_ratio=0.6)
    with pytest.raises(ValueError, match="damping is unknown: it must be above 0"):
        replace(arm, damping=0.0, unknown={"damping": 0.1})
    with pytest.raises(ValueError, match="names of markers must be text"):
        replace(arm, markers=(twin.Marker(1, 0.1),))
    loose = replace(arm.tendons[0], pulley_radius=0.0)
    with pytest.raises(ValueError, match="pulley_radius must be positive"):
        replace(arm, tendons=(loose,))
    bare = replace(arm, tendons=())
    assert bare.tensions(bare.start, np.zeros((5, 0))).shape == (5, 0)
    with jax.enable_x64(False), pytest.raises(ValueError, match="a twin needs float64"):
        twin.identify(arm, [film])
    assert set(LOGARITHMIC) <= set(twin.UNKNOWNS) == set(arm.start)

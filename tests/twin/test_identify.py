"""Twins of made-up arms have the true numbers, within their standard deviations."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxrod import twin
from jaxrod.geometry import rotations, vectors
from jaxrod.rods.motion import motion_of
from jaxrod.twin.arm import LOGARITHMIC
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


def test_weights_of_markers_are_those_of_their_energy():
    arm = drawing(marker_masses=0.01)
    masses = jnp.asarray([0.004, 0.008, 0.002, 0.006])
    values = arm.start | {"marker_masses": masses}
    scene, state = arm.scene(values, lambda numbers: jnp.ones(len(numbers)))
    bare, _ = arm.scene(arm.start, lambda numbers: jnp.ones(len(numbers)))
    (weights,) = (e for e in scene.effects if isinstance(e, twin.arm.MarkerWeights))
    any_turn = 0.5 * np.random.default_rng(0).standard_normal((3, arm.elements))
    turned = rotations.multiply_quaternions(
        rotations.split_quaternion(state.orientations),
        rotations.rotation_exp(vectors.split(jnp.asarray(any_turn))),
    )
    rest = replace(state, orientations=rotations.join_quaternion(turned))

    def height(state):
        return 9.81 * jnp.sum(masses * arm.points(state, arm.start)[:, 2])

    own = weights.loads(scene.rod, motion_of(rest)).couples
    q = rotations.split_quaternion(rest.orientations)
    for element in {int(m.at / 0.3 * 8 - 1e-9) for m in arm.markers}:
        for axis in range(3):
            heights = []
            for angle in (1e-6, -1e-6):
                turn = np.zeros((3, arm.elements))
                turn[axis, element] = angle
                small = rotations.rotation_exp(vectors.split(jnp.asarray(turn)))
                turned = rotations.multiply_quaternions(q, small)
                moved = replace(rest, orientations=rotations.join_quaternion(turned))
                heights.append(float(height(moved)))
            slope = (heights[0] - heights[1]) / 2e-6
            assert np.isclose(-slope, own[axis][element], atol=1e-9, rtol=1e-6)
    onto_axis = [replace(marker, offset=(0.0, 0.0, 0.0)) for marker in arm.markers]
    axis = replace(arm, markers=tuple(onto_axis)).points(rest, arm.start)[:, 2]
    both = float(height(rest)) - 9.81 * float(jnp.sum(masses * axis))
    assert np.isclose(float(weights.energy(scene.rod, rest)), both, rtol=1e-9)
    added = scene.rod.element_masses - bare.rod.element_masses
    assert np.isclose(jnp.sum(added), jnp.sum(masses))


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
    _, straight = arm.scene(arm.start, lambda numbers: jnp.zeros(len(numbers)))
    films = []
    for pulls in POSES:
        film = filmed(arm, truth, replace(pose(*pulls), points=np.zeros((40, 5, 3))))
        film.points[:, 0] = arm.points(straight, arm.start)[0]
        moved = film.points + rng.uniform(-1, 1, 3)
        order = rng.permutation(5)
        films.append(replace(film, points=moved[:, order], labelled=False))
    found = twin.identify(arm, films[:4], noise=1e-4)
    for one in found.compare(films):
        assert np.max(one.errors[1:]) < 1e-6


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
    with pytest.raises(ValueError, match="arc lengths of radius must rise"):
        replace(arm, radius=[[0.3, 0.01], [0.0, 0.02]])
    with jax.enable_x64(False), pytest.raises(ValueError, match="float64"):
        twin.identify(arm, [film])
    assert set(LOGARITHMIC) <= set(twin.UNKNOWNS) == set(arm.start)

"""Rotations are exact from no angle at all to half a turn, and smooth at zero."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.geometry.rotations import (
    conjugate,
    directors_from_orientations,
    join_quaternion,
    multiply_quaternions,
    rotation_exp,
    rotation_log,
    rotation_log_and_coupling,
)

SMALL = np.concatenate([[0.0], np.geomspace(1e-8, 1e-2, 13)])
NEARLY_PI = np.pi - np.geomspace(1e-2, 1e-6, 9)
ANGLES = np.concatenate([SMALL, np.linspace(0.1, 3.1, 61), NEARLY_PI])
TOLERANCE = {"float32": 1e-6, "float64": 1e-14}


def axes(count):
    random = np.random.default_rng(0).normal(size=(3, count))
    return random / np.linalg.norm(random, axis=0)


def quaternions(dtype):
    """Quaternions of all angles as stored in `dtype`, from extended precision."""
    half = np.longdouble(ANGLES) / 2
    vector = np.sin(half) * axes(len(half))
    return np.concatenate([np.cos(half)[None], vector]).astype(dtype)


def exact_log(quaternion):
    """The rotation vector of quaternions in extended precision."""
    w, v = np.longdouble(quaternion[0]), np.longdouble(quaternion[1:])
    length = np.sqrt(np.sum(v * v, axis=0))
    safe = np.where(length > 0, length, 1)
    return np.where(length > 0, 2 * np.arctan2(length, w) / safe, 2) * v


def worst(got, expected):
    """Largest error over all angles, relative to each angle."""
    gap = np.linalg.norm(np.float64(got - expected), axis=0)
    length = np.linalg.norm(np.float64(expected), axis=0)
    return np.max(gap / np.where(length > 0, length, 1))


@pytest.mark.fast_sets(1)
def test_the_logarithm_of_every_angle(dtype, record):
    q = quaternions(dtype)
    got = np.stack(rotation_log(tuple(jnp.asarray(q))))
    assert got.dtype == dtype
    record(
        f"Joint rotation from 1e-8 to pi - 1e-6, {dtype}",
        "exact logarithm, extended precision",
        worst(np.longdouble(got), exact_log(q)),
        at_most=TOLERANCE[str(dtype)],
    )


def test_both_quaternions_of_a_rotation_have_the_same_logarithm(dtype):
    q = jnp.asarray(quaternions(dtype))
    for sign in (q, -q):
        np.testing.assert_array_equal(
            np.stack(rotation_log(tuple(sign))), np.stack(rotation_log(tuple(q)))
        )


def test_exponential_and_logarithm_undo_each_other(dtype, record):
    rotation = (ANGLES * axes(len(ANGLES))).astype(dtype)
    back = np.stack(rotation_log(rotation_exp(tuple(jnp.asarray(rotation)))))
    record(
        f"log(exp(phi)) from 1e-8 to pi - 1e-6, {dtype}",
        "phi",
        worst(back, rotation),
        at_most=TOLERANCE[str(dtype)],
    )


def test_the_exponential_is_a_rotation_about_its_axis(dtype):
    rotation = (ANGLES * axes(len(ANGLES))).astype(dtype)
    q = rotation_exp(tuple(jnp.asarray(rotation)))
    matrix = np.asarray(directors_from_orientations(join_quaternion(q)))
    eye = np.eye(3)[:, :, None]
    tolerance = 4 * TOLERANCE[str(dtype)]
    gram = np.einsum("ikm,jkm->ijm", matrix, matrix)
    np.testing.assert_allclose(gram, np.broadcast_to(eye, gram.shape), atol=tolerance)
    # Trace and axis determine a rotation: 1 + 2 cos, and a vector left as it is.
    np.testing.assert_allclose(
        np.einsum("iim->m", matrix), 1 + 2 * np.cos(ANGLES), atol=tolerance
    )
    kept = np.einsum("ijm,im->jm", matrix, rotation)
    np.testing.assert_allclose(kept, rotation, atol=4 * tolerance)


def test_a_quarter_turn_about_z_takes_d1_to_y():
    q = rotation_exp((jnp.zeros(1), jnp.zeros(1), jnp.full(1, np.pi / 2)))
    frame = directors_from_orientations(join_quaternion(q))[:, :, 0]
    expected = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
    np.testing.assert_allclose(frame, expected, atol=1e-15)


def test_the_inverse_undoes_a_rotation():
    q = tuple(jnp.asarray(quaternions("float64")))
    w, *vector = multiply_quaternions(conjugate(q), q)
    np.testing.assert_allclose(w, 1, atol=1e-15)
    np.testing.assert_allclose(np.stack(vector), 0, atol=1e-15)


def test_the_coupling_coefficient(dtype):
    """(1 - (t/2) cot(t/2)) / t^2, by its series below a tenth."""
    _, got = rotation_log_and_coupling(tuple(jnp.asarray(quaternions(dtype))))
    t = np.longdouble(np.where(ANGLES < 0.1, 1, ANGLES))
    closed = (1 - t / 2 / np.tan(t / 2)) / t**2
    s = np.longdouble(ANGLES) ** 2
    series = 1 / np.longdouble(12) + s / 720 + s**2 / 30240 + s**3 / 1209600
    exact = np.float64(np.where(ANGLES < 0.1, series, closed))
    np.testing.assert_allclose(got, exact, rtol=2 * TOLERANCE[str(dtype)])


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("differentiate", [jax.jacfwd, jax.jacrev])
def test_derivatives_at_zero_are_finite_and_right(differentiate, dtype):
    back = lambda v: jnp.stack(rotation_log(rotation_exp((v[0], v[1], v[2]))))
    zero = jnp.zeros(3, dtype)
    np.testing.assert_allclose(jax.jit(differentiate(back))(zero), np.eye(3), atol=1e-6)
    second = jax.jit(differentiate(jax.jacfwd(back)))(zero)
    np.testing.assert_allclose(second, 0, atol=1e-6)
    half = lambda v: jnp.stack(rotation_exp((v[0], v[1], v[2])))
    expected = np.concatenate([np.zeros((1, 3)), np.eye(3) / 2])
    np.testing.assert_allclose(jax.jit(differentiate(half))(zero), expected, atol=1e-6)


def test_beyond_half_a_turn_the_rotation_the_short_way_round_is_meant():
    angle = np.pi + 0.1
    x, y, z = rotation_log(
        rotation_exp((jnp.full(1, angle), jnp.zeros(1), jnp.zeros(1)))
    )
    np.testing.assert_allclose(x, angle - 2 * np.pi, rtol=1e-13)
    np.testing.assert_allclose((y, z), 0)

"""Filters against the truth of simulations, and against Kalman's filter in numpy."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod import control
from jaxrod.control import estimation

KIND = {"dtype": jnp.float64}
ROD = {"length": 0.5, "radius": 0.02, "density": 1000.0, "youngs_modulus": 2e5, **KIND}
NOISE = 1e-3
DT, STEPS = 1e-3, 10
"""A hundred measurements in a second."""
PULL = jaxrod.gravity()


def arm(n, *effects, method=None):
    rod, state = jaxrod.straight_rod(
        n, direction=(1.0, 0.0, 0.0), normal=(0.0, 1.0, 0.0), **ROD
    )
    damping = jaxrod.exponential_damping(1.0, rotational_rate=20.0)
    scene = jaxrod.make_scene(
        rod, jaxrod.clamp(state), damping, *effects, method=method
    )
    return scene, state


def markers(model, state):
    """Three nodes."""
    n = state.positions.shape[1] - 1
    return state.positions[:, np.array([n // 3, 2 * n // 3, n])]


def some_markers(system, state):
    """Three nodes of two rods."""
    one, two = state["one"].positions, state["two"].positions
    return jnp.stack([one[:, 2], one[:, -1], two[:, -1]], axis=1)


def pushed(model, force):
    return model.with_effect(jaxrod.uniform_load(force))


def flexed(scene, value):
    n = scene.rod.n_elements
    couple = jnp.concatenate([jnp.tile(value, (1, n)), jnp.zeros((2, n))])
    return scene.with_effect(jaxrod.actuation.ElementCouples(couple))


def floor_of(coordinates):
    """Variances that no motion of first order gives: of twist, and along the rod."""
    return (
        coordinates.filled(
            displacement=1e-5, rotation=1e-4, velocity=1e-3, angular_velocity=1e-2
        )
        ** 2
    )


def swinging(n=5):
    """An arm that was let go, which way and how fast is not known, under gravity."""
    scene, state = arm(n, PULL)
    near = control.local_coordinates(scene, state, DT)
    process = estimation.make_process(
        scene,
        state,
        DT,
        STEPS,
        measure=markers,
        noise=NOISE,
        state_noise=0.01 * floor_of(near),
    )
    # Velocities that grow along the arm as those of a rotation about its base.
    along = np.linspace(0, 1, n + 1)[1:]
    names = np.array(near.names)
    modes = np.zeros((near.size, 2))
    half = near.size // 2
    for column, axis in enumerate("yz"):
        velocity = [k for k, name in enumerate(names) if name.endswith(f"along {axis}")]
        modes[half + np.array(velocity), column] = 0.3 * along
    covariance = modes @ modes.T + np.diag(floor_of(near))
    return process, state, covariance, None


def driven(n=5):
    """An arm in a plane, moved by couples that are known to 2 mN m an element."""
    flat = jaxrod.planar("zx")
    scene, state = arm(n, PULL, method=flat)
    process = estimation.make_process(
        scene,
        state,
        DT,
        STEPS,
        measure=markers,
        noise=NOISE,
        with_control=flexed,
        control_noise=jnp.array([[2e-3]]),
    )
    process = dataclasses.replace(
        process,
        state_root=jnp.diag(0.1 * jnp.sqrt(floor_of(process.coordinates))),
    )
    return process, state, floor_of(process.coordinates), 0.01


def blown(n=4):
    """Two rods, tied, in a wind that nobody knows."""
    one, first = arm(n, PULL)
    rod, second = jaxrod.straight_rod(
        3, direction=(1.0, 0.0, 0.0), start=(0.5, 0.0, 0.0), **ROD
    )
    damping = jaxrod.exponential_damping(1.0, rotational_rate=20.0)
    state = {"one": first, "two": second}
    system = jaxrod.make_system(
        {"one": one, "two": jaxrod.make_scene(rod, PULL, damping)},
        jaxrod.systems.weld(("one", "tip"), ("two", "base"), state),
    )
    near = control.local_coordinates(system, state, DT)
    process = estimation.make_process(
        system,
        state,
        DT,
        STEPS,
        measure=some_markers,
        noise=NOISE,
        state_noise=0.01 * floor_of(near),
        with_control=pushed,
        control_noise=jnp.array([0.2, 0.5, 0.5]),
    )
    return process, state, floor_of(near), None


def controls_of(process, size, periods):
    """Known controls of all periods, or None."""
    if size is None:
        return None
    phase = jnp.arange(periods) / 15
    shape = process.control_noise.shape
    return size * jnp.sin(phase).reshape(-1, *(1,) * len(shape)) * jnp.ones((1, *shape))


def moved(process, state, change):
    return process.coordinates.retract(state, change)


def truth_and_measurements(process, estimate, key, periods, controls):
    """A motion that is a draw of the process, and what sensors see of it."""
    first, *keys = jax.random.split(key, periods + 1)
    size = process.coordinates.size
    start = moved(
        process, estimate.state, estimate.root @ jax.random.normal(first, (size,))
    )

    def one(state, given):
        key, known = given
        force, push, seen = jax.random.split(key, 3)
        model = process.model
        if process.control_noise is not None:
            known = process.control(known)
            more = jax.random.normal(force, known.shape) * process.control_noise
            model = process.with_control(model, known + more)
        after = jaxrod.advance(model, state, process.dt, process.n_steps)
        if process.state_root is not None:
            drawn = jax.random.normal(push, (size,))
            after = moved(process, after, process.state_root @ drawn)
        shown = process.measure(model, after)
        shown = shown + process.noise * jax.random.normal(seen, shown.shape)
        return after, (after, shown)

    return jax.lax.scan(one, start, (jnp.stack(keys), controls))[1]


def filtered(process, estimate, observed, controls):
    """Updates of all periods."""

    def one(estimate, given):
        seen, known = given
        predicted = estimation.predict(process, estimate, known)
        found = estimation.update(process, predicted, seen)
        return found.estimate, found

    return jax.lax.scan(one, estimate, (observed, controls))[1]


def normalised_errors(process, start, key, periods, size):
    """Errors over their standard deviations, and squares of innovations per number."""
    controls = controls_of(process, size, periods)
    true, observed = truth_and_measurements(process, start, key, periods, controls)
    found = filtered(process, start, observed, controls)
    misses = jax.vmap(process.coordinates.difference)(found.estimate.state, true)
    return misses / found.estimate.deviations, found.square / found.count


def spread(make, seeds, periods):
    process, state, covariance, size = make()
    start = estimation.first_estimate(process, state, covariance)
    run = jax.jit(
        jax.vmap(lambda key: normalised_errors(process, start, key, periods, size))
    )
    errors, squares = run(jax.random.split(jax.random.key(0), seeds))
    errors = np.asarray(errors)
    print(
        make.__name__,
        f"rms {np.sqrt(np.mean(errors**2)):.3f}",
        "by seed",
        np.round(np.sqrt(np.mean(errors**2, axis=(1, 2))), 2),
        f"innovations {np.mean(squares):.3f}",
    )
    return np.sqrt(np.mean(errors**2)), np.mean(squares)


@pytest.mark.slow
@pytest.mark.parametrize("make", [driven, swinging, blown])
def test_errors_are_as_large_as_the_filter_says(make):
    error, innovation = spread(make, 20, 60)
    assert 0.8 < error < 1.25
    assert 0.9 < innovation < 1.1


def plain_kalman(process, estimate, observed):
    """The filter in numpy, with covariances and gains as in textbooks."""
    state, covariance = estimate.state, np.asarray(estimate.covariance)
    near, means, spreads = process.coordinates, [], []
    for seen in np.asarray(observed):
        linear = control.linearise(
            process.model,
            state,
            DT,
            STEPS,
            control=process.control(None),
            with_control=process.with_control,
            coordinates=near,
        )
        a, b = np.asarray(linear.state_matrix), np.asarray(linear.input_matrix)
        unknown = b * np.ravel(process.control_noise)[None]
        covariance = a @ covariance @ a.T + unknown @ unknown.T
        covariance = covariance + np.asarray(process.state_root) ** 2
        after = control.linearise(
            process.model,
            linear.state,
            DT,
            STEPS,
            control=process.control(None),
            with_control=process.with_control,
            measure=process.measure,
            coordinates=near,
        )
        c = np.asarray(after.output_matrix)
        innovation = np.ravel(seen) - np.ravel(after.measured)
        gain = np.linalg.solve(
            c @ covariance @ c.T + NOISE**2 * np.eye(len(c)), c @ covariance
        ).T
        state = near.retract(linear.state, jnp.asarray(gain @ innovation))
        rest = np.eye(near.size) - gain @ c
        covariance = rest @ covariance @ rest.T + NOISE**2 * gain @ gain.T
        means.append(state)
        spreads.append(covariance)
    return means, spreads


@pytest.fixture(scope="module")
def small():
    """An arm in a plane, its first estimate and measurements."""
    process, state, covariance, _ = driven(3)
    start = estimation.first_estimate(process, state, covariance)
    return process, start


@pytest.mark.slow
def test_the_filter_is_kalmans_and_its_errors_are_as_large_as_it_says(small):
    process, start = small

    @jax.jit
    @jax.vmap
    def run(key):
        controls = controls_of(process, 0.0, 25)
        true, seen = truth_and_measurements(process, start, key, 25, controls)
        found = filtered(process, start, seen, controls)
        away = jax.vmap(process.coordinates.difference)(found.estimate.state, true)
        return found, away / found.estimate.deviations, seen

    found, errors, observed = run(jax.random.split(jax.random.key(1), 8))
    assert 0.7 < np.sqrt(np.mean(errors**2)) < 1.4
    assert 0.8 < np.mean(found.square / found.count) < 1.25
    means, spreads = plain_kalman(process, start, observed[0, :4])
    for k, (mean, spread) in enumerate(zip(means, spreads, strict=True)):
        one = jax.tree.map(lambda leaf, k=k: leaf[0, k], found.estimate)
        away = process.coordinates.difference(one.state, mean)
        deviations = np.sqrt(np.diagonal(spread))
        np.testing.assert_allclose(away / deviations, 0, atol=1e-8)
        correlation = one.covariance / deviations[:, None] / deviations[None]
        wanted = spread / deviations[:, None] / deviations[None]
        np.testing.assert_allclose(correlation, wanted, rtol=0, atol=1e-8)


@pytest.mark.slow
def test_numbers_that_are_missing_say_nothing(small):
    process, start = small
    seen = np.array(process.measure(process.model, start.state))
    none = estimation.update(process, start, np.full_like(seen, np.nan))
    assert none.count == 0 and none.square == 0
    np.testing.assert_allclose(
        none.estimate.covariance, start.covariance, rtol=1e-12, atol=1e-20
    )
    seen[:, :2] = np.nan
    seen[2, 2] += 2e-3
    part = estimation.update(process, start, seen)
    assert part.count == 3 and part.square > 0
    assert np.all(np.isfinite(part.estimate.root))
    # The same as measurements without value.
    loose = dataclasses.replace(process, noise=process.noise.at[:, :2].set(1e6 * NOISE))
    seen[:, :2] = 0.1
    other = estimation.update(loose, start, seen)
    np.testing.assert_allclose(
        other.estimate.state.positions, part.estimate.state.positions, atol=1e-9
    )


def hidden_markers(model, state):
    """A camera has such numbers: markers that are behind it."""
    return markers(model, state).at[:, 1].set(jnp.nan)


@pytest.mark.slow
def test_what_is_expected_nowhere_is_not_compared(small):
    process, start = small
    seen = np.array(process.measure(process.model, start.state)) + 1e-3
    behind = dataclasses.replace(process, measure=hidden_markers)
    found = estimation.update(behind, start, seen)
    seen[:, 1] = np.nan
    same = estimation.update(process, start, seen)
    assert found.count == same.count == seen.size - 3
    np.testing.assert_array_equal(
        found.estimate.state.positions, same.estimate.state.positions
    )


def test_a_covariance_stays_one_whatever_the_rounding(small):
    process, start = small
    exact = dataclasses.replace(process, noise=1e-12 * jnp.ones_like(process.noise))
    seen = process.measure(process.model, start.state)
    found = start
    for _ in range(4):
        found = estimation.update(exact, found, seen).estimate
    values = np.linalg.eigvalsh(found.covariance)
    assert values[0] >= -1e-14 * values[-1]
    assert np.all(found.deviations <= start.deviations * (1 + 1e-12))


def test_what_does_not_fit_is_said(small):
    process, start = small
    size = process.coordinates.size
    state = start.state
    with pytest.raises(ValueError, match=r"covariance must be non-negative, got -1"):
        estimation.first_estimate(process, state, -np.ones(size))
    with pytest.raises(ValueError, match="semidefinite, got an eigenvalue of -1"):
        estimation.first_estimate(process, state, np.diag([-1.0] + [1.0] * (size - 1)))
    with pytest.raises(ValueError, match="covariance must be symmetric"):
        estimation.first_estimate(process, state, np.triu(np.ones((size, size))))
    with pytest.raises(
        ValueError, match=rf"\({size},\) or \({size}, {size}\), got \(3, 3\)"
    ):
        estimation.first_estimate(process, state, np.eye(3))
    with pytest.raises(
        ValueError, match=r"observed must have shape \(3, 3\).*got \(9,\)"
    ):
        estimation.update(process, start, np.zeros(9))
    with pytest.raises(
        ValueError, match=r"control must have shape \(1, 1\), got \(2,\)"
    ):
        estimation.predict(process, start, np.zeros(2))
    with pytest.raises(ValueError, match=rf"\({size}, {size}\).*got \(2, 2\)"):
        small_root = dataclasses.replace(start, root=jnp.eye(2))
        estimation.predict(process, small_root)
    with pytest.raises(TypeError, match="process must be"):
        estimation.predict(start, start)


@pytest.mark.slow
def test_a_window_finds_what_the_filter_finds(small):
    """The same where motions are nearly linear; the likeliest motion everywhere."""
    process, start = small
    controls = controls_of(process, 0.0, 8)
    true, observed = truth_and_measurements(
        process, start, jax.random.key(3), 8, controls
    )
    observed = observed.at[3, :, 1].set(jnp.nan)
    found = filtered(process, start, observed, controls).estimate
    last = jax.tree.map(lambda leaf: leaf[-1], found)
    window = estimation.moving_horizon(process, start, observed)
    assert window.converged
    away = process.coordinates.difference(last.state, window.estimate.state)
    np.testing.assert_allclose(away / last.deviations, 0, atol=0.05)
    np.testing.assert_allclose(window.estimate.deviations, last.deviations, rtol=0.02)
    end = jax.tree.map(lambda leaf: leaf[-1], true)
    error = process.coordinates.difference(window.estimate.state, end)
    assert np.sqrt(np.mean((error / window.estimate.deviations) ** 2)) < 2

"""Linear models of a period: central differences, frequencies, two periods in one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod import control

N = 4
KIND = {"dtype": jnp.float64}
ROD = {"length": 0.4, "radius": 0.02, "density": 1000.0, "youngs_modulus": 1e6, **KIND}
SPLINE = jaxrod.actuation.control_spline(2, 0.4, dtype=jnp.float64)
DT = 4e-4


def clamped(*effects, method=None, direction=(0.0, 1.0, 0.0)):
    rod, state = jaxrod.straight_rod(N, direction=direction, **ROD)
    damping = jaxrod.exponential_damping(1.0)
    scene = jaxrod.make_scene(
        rod, jaxrod.clamp(state), damping, *effects, method=method
    )
    return scene, state


def flexed(scene, values):
    couples = jaxrod.actuation.spline_couples(scene.rod, SPLINE, values, 0.5)
    return scene.with_effect(couples)


def pushed(model, force):
    return model.with_effect(jaxrod.uniform_load(force))


def muscled():
    scene, state = clamped(jaxrod.gravity((3.0, -9.81, 2.0)))
    return scene, state, flexed, jnp.array([[0.5, -0.2], [0.1, 0.3], [0.2, 0.0]])


def touching():
    ball = jaxrod.shapes.sphere((0.3, 0.0, -0.075), 0.05)
    touch = jaxrod.contact([ball], stiffness=5e3, damping=5.0, points_per_element=2)
    scene, state = clamped(touch, jaxrod.gravity(), direction=(1.0, 0.0, 0.0))
    return scene, state, pushed, jnp.array([0.0, 0.3, -3.0])


def planar():
    pull = jaxrod.gravity((3.0, -9.81, 0.0))
    scene, state = clamped(pull, method=jaxrod.planar("xy"))
    return scene, state, pushed, jnp.array([0.3, 0.1, 0.0])


def torsion_free():
    pull = jaxrod.gravity((3.0, -9.81, 2.0))
    scene, state = clamped(pull, method=jaxrod.torsion_free())
    return scene, state, pushed, jnp.array([0.3, 0.1, -0.5])


def welded():
    pull = jaxrod.gravity((3.0, -9.81, 2.0))
    one, first = clamped(pull)
    rod, second = jaxrod.straight_rod(
        3, direction=(1.0, 0.0, 0.0), start=(0.0, 0.4, 0.0), **ROD
    )
    state = {"one": first, "two": second}
    joint = jaxrod.systems.weld(("one", "tip"), ("two", "base"), state)
    members = {"one": one, "two": jaxrod.make_scene(rod, pull)}
    return jaxrod.make_system(members, *joint), state, pushed, jnp.array([0.3, 0, -0.5])


def weighted():
    scene, first = clamped(jaxrod.gravity((3.0, -9.81, 2.0)))
    ball = jaxrod.shapes.sphere((0.0, 0.43, 0.0), 0.03)
    body, second = jaxrod.systems.rigid_body(ball, density=1000.0, dtype=jnp.float64)
    state = {"arm": first, "ball": second}
    joint = jaxrod.systems.attach(("arm", "tip"), ("ball",), state)
    system = jaxrod.make_system({"arm": scene, "ball": body}, *joint)
    return system, state, None, None


SIZES = {
    muscled: 12 * N,
    touching: 12 * N,
    planar: 6 * N,
    torsion_free: 10 * N,
    welded: 12 * N + 36,
    weighted: 12 * N + 6,
}
"""Free components and their rates: of a body that carries the tip, its own alone."""


def moving(make):
    """A model, a moving state of it, and a control."""
    model, state, with_control, value = make()
    driven = model if value is None else with_control(model, value)
    return model, jaxrod.advance(driven, state, DT, 400), with_control, value


def heights(model, state):
    """Nodes, and how fast they fall."""
    own = model.states_by_name(state)
    return jnp.concatenate(
        [jnp.ravel(s.positions**2) + jnp.ravel(s.velocities) for s in own.values()]
    )


def slopes(function, size, h):
    """Derivatives by central differences of fourth order."""

    def column(way):
        near = function(h * way) - function(-h * way)
        far = function(2 * h * way) - function(-2 * h * way)
        return (8 * near - far) / (12 * h)

    return jax.jit(jax.vmap(column, out_axes=1))(jnp.eye(size))


def close(found, wanted, at_most):
    scale = np.max(np.abs(wanted))
    np.testing.assert_allclose(found, wanted, rtol=0, atol=at_most * scale)


@pytest.mark.slow
@pytest.mark.parametrize("make", [welded, muscled, touching, planar, torsion_free])
def test_matrices_are_those_of_central_differences(make):
    model, state, with_control, value = moving(make)
    k = 20
    found = control.linearise(
        model,
        state,
        DT,
        k,
        control=value,
        with_control=with_control,
        measure=heights,
    )
    near = found.coordinates
    assert near.size == SIZES[make] and 2 * len(near.names) == near.size
    ways = near.directions(state)

    def run(z, u):
        start = near.moved(state, ways, z)
        after = jaxrod.advance(with_control(model, u), start, DT, k)
        return near.difference(found.state, after)

    none = jnp.zeros(near.size)
    by_state = slopes(lambda z: run(z, value), near.size, 1e-5)
    by_control = slopes(
        lambda u: run(none, value + u.reshape(value.shape)), value.size, 1e-4
    )
    seen = slopes(lambda z: heights(model, near.moved(state, ways, z)), near.size, 1e-5)
    close(found.state_matrix, by_state, 1e-6)
    close(found.input_matrix, by_control, 1e-6)
    close(found.output_matrix, seen, 1e-6)
    np.testing.assert_allclose(found.measured, heights(model, state))
    if make is touching:
        (_, forces), *_ = model.contact_forces(state)
        assert np.max(forces[2]) > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("make", [torsion_free, welded, weighted])
def test_two_periods_are_one_of_twice_the_length(make):
    """Directions change from period to period if components follow others."""
    model, state, _, _ = moving(make)
    first = control.linearise(model, state, DT, 50)
    near = first.coordinates
    assert near.size == SIZES[make] and near.follow
    second = control.linearise(model, first.state, DT, 50, coordinates=near)
    whole = control.linearise(model, state, DT, 100, coordinates=near)
    close(second.state_matrix @ first.state_matrix, whole.state_matrix, 1e-6)


def free_arm():
    rod, state = jaxrod.straight_rod(N, direction=(1.0, 0.4, -0.3), **ROD)
    return jaxrod.make_scene(rod, jaxrod.clamp(state)), state


@pytest.mark.slow
def test_eigenvalues_are_those_of_natural_frequencies():
    """A Verlet step turns a motion of frequency w by 2 asin(w dt / 2)."""
    scene, state = free_arm()
    found = control.linearise(scene, state, DT)
    angles = np.sort(np.abs(np.angle(np.linalg.eigvals(found.state_matrix))))[::2]
    frequencies = jaxrod.natural_frequencies(scene, state)
    np.testing.assert_allclose(angles, 2 * np.arcsin(frequencies * DT / 2), rtol=1e-6)


@pytest.mark.slow
def test_a_compiled_program_has_the_same_matrices():
    scene, state, with_control, value = muscled()
    given = {"control": value, "with_control": with_control}
    found = control.linearise(scene, state, DT, 5, **given)

    @jax.jit
    def again(scene, dt):
        near = found.coordinates
        return control.linearise(scene, state, dt, 5, coordinates=near, **given)

    made = again(scene, jnp.asarray(DT))
    close(made.state_matrix, found.state_matrix, 1e-12)
    close(made.input_matrix, found.input_matrix, 1e-12)


@pytest.mark.slow
def test_states_and_coordinates_are_each_others_inverses():
    scene, state = free_arm()
    near = control.local_coordinates(scene, state, DT)
    assert near.names[0] == "node 1 along x"
    assert near.names[-1] == f"element {N - 1} about d3"
    there = 0.3 * jax.random.normal(jax.random.key(0), (near.size,))
    other = near.retract(state, there)
    np.testing.assert_allclose(near.difference(state, other), there, atol=1e-14)
    norms = jnp.sum(other.orientations**2, axis=0)
    np.testing.assert_allclose(norms, 1, atol=1e-14)
    kinds = near.filled(displacement=1, rotation=2, velocity=3, angular_velocity=4)
    assert [int(jnp.sum(kinds == k)) for k in (1, 2, 3, 4)] == [3 * N] * 4


@pytest.mark.slow
def test_what_does_not_fit_is_said():
    scene, state = free_arm()
    near = control.local_coordinates(scene, state, DT)
    with pytest.raises(ValueError, match=r"traced by jax\.jit"):
        jax.jit(lambda dt: control.linearise(scene, state, dt).state_matrix)(DT)
    with pytest.raises(ValueError, match="with_control is None"):
        control.linearise(scene, state, DT, control=jnp.zeros(3))
    with pytest.raises(ValueError, match=rf"\({12 * N},\).*got \(5,\)"):
        near.retract(state, jnp.zeros(5))
    with pytest.raises(ValueError, match="n_steps must be at least 1, got 0"):
        control.linearise(scene, state, DT, 0)
    with pytest.raises(TypeError, match="scene must be"):
        control.linearise("scene", state, DT)

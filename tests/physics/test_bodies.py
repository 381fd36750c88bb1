"""Bodies: their distances and normals, right and finite everywhere."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.geometry import vectors
from physics.rods import difference
from physics.shapes import BODIES, rotated, turned


@pytest.fixture(params=BODIES)
def body(request):
    return BODIES[request.param]()


def nowhere_special(count=200):
    """Random points in and around the bodies."""
    points = np.random.default_rng(0).normal(scale=0.25, size=(3, count))
    return jnp.asarray(points)


def special(body):
    """Points where something about a body is not unique: centres, axes, corners."""
    zero = jnp.zeros(3)
    starts = [getattr(body, name, zero) for name in ("centre", "start", "end", "point")]
    middle = 0.5 * (getattr(body, "start", zero) + getattr(body, "end", zero))
    corner = getattr(body, "half_lengths", zero)
    at_corner = getattr(body, "centre", zero) + corner
    on_face = getattr(body, "centre", zero) + corner * jnp.asarray([1.0, 0.0, 0.0])
    return jnp.stack([*starts, middle, at_corner, on_face, zero], axis=1)


@jax.jit
def surface(body, points):
    distance, normal = body.surface(vectors.split(points))
    return distance, vectors.join(normal)


@jax.jit
def slope(body, points):
    """The gradient of the distance by differentiating it."""

    def distance(point):
        return body.surface(vectors.split(point[:, None]))[0][0]

    return jax.vmap(jax.grad(distance), in_axes=1, out_axes=1)(points)


def test_normals_are_the_gradients_of_distances_and_unit_vectors(body):
    points = nowhere_special()
    _, normals = surface(body, points)
    assert difference(normals, slope(body, points)) < 1e-12
    if not isinstance(body, jaxrod.shapes.SignedDistance):
        lengths = jnp.sqrt(jnp.sum(normals**2, axis=0))
        assert difference(lengths, jnp.ones_like(lengths)) < 1e-9


def test_a_step_along_the_normal_by_the_distance_ends_on_the_surface(body):
    points = nowhere_special()
    distances, normals = surface(body, points)
    # From outside; inside a corner's bisector the nearest face may be another.
    outside = distances > 0
    ends, _ = surface(body, points - distances[None] * normals)
    assert difference(jnp.where(outside, ends, 0), jnp.zeros_like(ends)) < 1e-6
    assert jnp.sum(outside) > 20


def nearest(body, samples):
    """Distances from far more samples of the surface than needed, by brute force."""
    points = nowhere_special(20)
    gaps = points[:, :, None] - samples[:, None, :]
    exact = jnp.min(jnp.sqrt(jnp.sum(gaps**2, axis=0)), axis=1)
    return difference(jnp.abs(surface(body, points)[0]), exact)


@pytest.mark.slow
def test_distances_are_those_of_the_nearest_of_many_points_of_the_surface():
    grid = np.linspace(-1, 1, 101)
    first, second = (jnp.asarray(a.ravel()) for a in np.meshgrid(grid, grid))
    body = jaxrod.shapes.box((0.1, 0.0, -0.05), (0.1, 0.2, 0.3))
    sides = [
        jnp.stack(
            jnp.roll(jnp.stack([sign * jnp.ones_like(first), first, second]), k, 0)
        )
        for k in range(3)
        for sign in (-1, 1)
    ]
    samples = jnp.concatenate(sides, axis=1) * body.half_lengths[:, None]
    assert nearest(body, samples + body.centre[:, None]) < 2e-3

    body = jaxrod.shapes.cylinder((0.0, 0.0, -0.3), (0.0, 0.0, 0.3), 0.15)
    angle, share = jnp.pi * first, 0.5 * (1 + second)
    around = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    mantle = jnp.concatenate([0.15 * around, 0.3 * second[None]])
    lids = [
        jnp.concatenate([0.15 * share[None] * around, jnp.full_like(first, z)[None]])
        for z in (-0.3, 0.3)
    ]
    assert nearest(body, jnp.concatenate([mantle, *lids], axis=1)) < 2e-3

    body = jaxrod.shapes.pipe((0.0, 0.0, -0.3), (0.0, 0.0, 0.3), 0.15, thickness=0.05)
    walls = [jnp.concatenate([r * around, 0.3 * second[None]]) for r in (0.15, 0.2)]
    rims = [
        jnp.concatenate(
            [(0.15 + 0.05 * share)[None] * around, jnp.full_like(first, z)[None]]
        )
        for z in (-0.3, 0.3)
    ]
    assert nearest(body, jnp.concatenate([*walls, *rims], axis=1)) < 2e-3


@pytest.mark.fast_sets(1)
def test_everything_is_finite_everywhere(body, dtype):
    """Values, and their gradients with respect to places and numbers."""
    body = jax.tree.map(lambda leaf: leaf.astype(dtype), body)
    points = jnp.concatenate([special(body), nowhere_special(5)], axis=1).astype(dtype)

    def total(body, points):
        distance, normal = body.surface(vectors.split(points))
        return sum(jnp.sum(w * c) for w, c in enumerate((*normal, distance)))

    both = jax.jit(jax.value_and_grad(total, argnums=(0, 1)))(body, points)
    for leaf in jax.tree.leaves(both):
        assert jnp.all(jnp.isfinite(leaf))


def test_a_body_that_is_moved_is_the_same_body_elsewhere(body):
    rotation, shift = jnp.asarray([0.3, -1.2, 0.7]), jnp.asarray([1.0, -2.0, 0.5])
    points = nowhere_special()
    there = rotated(rotation, points) + shift[:, None]
    distance, normal = surface(body, points)
    found, pointing = surface(turned(body, rotation, shift), there)
    assert difference(found, distance) < 1e-14
    assert difference(pointing, rotated(rotation, normal)) < 1e-12


def test_many_of_a_kind_are_each_of_them():
    centres = nowhere_special(3).T
    radii = jnp.asarray([0.1, 0.2, 0.3])
    many = jax.vmap(jaxrod.shapes.sphere)(centres, radii)
    assert many.count == 3 and jaxrod.shapes.sphere(centres[0], 0.1).count is None
    points = nowhere_special(5)
    together, _ = jax.vmap(lambda one: surface(one, points))(many)
    for k in range(3):
        alone, _ = surface(jaxrod.shapes.sphere(centres[k], radii[k]), points)
        assert difference(together[k], alone) < 1e-15


def test_many_bodies_of_any_shape_are_made_by_vmap_too():
    """Their numbers alone do not tell how many: the factory remembers their ranks."""

    def ball(point, numbers):
        centre, radius = numbers
        return jnp.sqrt(jnp.sum((point - centre) ** 2)) - radius

    centres = jnp.asarray(np.random.default_rng(5).normal(0, 1, (3, 3)))
    radii = jnp.asarray([0.1, 0.2, 0.3])
    one = lambda centre, radius: jaxrod.shapes.signed_distance(ball, (centre, radius))
    assert one(centres[0], 0.1).count is None
    assert jaxrod.shapes.signed_distance(lambda x, _: x[0]).count is None
    many = jax.vmap(one)(centres, radii)
    assert many.count == 3
    assert jaxrod.contact(many, stiffness=1e5).n_bodies == 3
    with pytest.raises(ValueError, match="the same leading axis"):
        uneven = dataclasses.replace(many, parameters=(centres, radii[0]))
        jaxrod.contact(uneven, stiffness=1e5)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: jaxrod.shapes.sphere((0, 0), 1), r"centre must have shape \(3,\)"),
        (
            lambda: jaxrod.shapes.sphere((0, 0, 0), -1),
            "radius must be positive, got -1 m",
        ),
        (
            lambda: jaxrod.shapes.capsule((0, 0, 1), (0, 0, 1), 1),
            "start and end must differ",
        ),
        (
            lambda: jaxrod.shapes.cylinder((0, 0, 1), (0, 0, 1), 1),
            "start and end must differ",
        ),
        (lambda: jaxrod.shapes.plane(normal=(0, 0, 0)), "normal must have a length"),
        (
            lambda: jaxrod.shapes.plane(normal=(0, 0, 1e-160)),
            "normal must have a length",
        ),
        (
            lambda: jaxrod.shapes.plane(normal=(0, 1e160, 0)),
            "normal must have a length",
        ),
        (
            lambda: jaxrod.shapes.capsule((0, 0, 0), (0, 0, 1e-160), 1),
            "start must have a len",
        ),
        (
            lambda: jaxrod.shapes.box((0, 0, 0), (1, 0, 1)),
            "half_lengths must be positive",
        ),
        (
            lambda: jaxrod.shapes.box((0, 0, 0), (1, 1, 1), (0, 0, 0, 0)),
            "orientation must",
        ),
        (
            lambda: jaxrod.shapes.signed_distance(lambda x, _: x),
            "function must return one distance",
        ),
    ],
)
def test_bad_numbers_are_refused_in_words(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_structures_of_different_classes_with_the_same_numbers_differ():
    """Or a program compiled for one body might be run for another."""
    capsule = jaxrod.shapes.capsule((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 0.1)
    cylinder = jaxrod.shapes.cylinder((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 0.1)
    assert jax.tree.structure(capsule) != jax.tree.structure(cylinder)
    assert jax.tree.structure(capsule) == jax.tree.structure(
        jax.tree.map(jnp.square, capsule)
    )


def held(number):
    """Height of the tip after it fell on a floor that holds a number as parameter."""
    return fallen(jaxrod.shapes.signed_distance(lambda x, top: x[2] - top, number))


def holding(number):
    """The same with a floor whose function holds the number itself."""
    return fallen(jaxrod.shapes.signed_distance(lambda x, _: x[2] - number))


def fallen(floor):
    rod, state = jaxrod.straight_rod(
        4, length=0.4, radius=0.02, density=1e3, youngs_modulus=1e5, direction=(1, 0, 0)
    )
    contact = jaxrod.contact(floor, stiffness=1e4, damping=1.0, onset=0.5)
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state), jaxrod.gravity(), contact)
    return jaxrod.advance(scene, state, 2e-4, 600).tip[2]


def test_traced_numbers_that_a_function_holds_become_parameters():
    """A run sees by them that it is differentiated, and fixes its number of steps."""
    plain = jaxrod.shapes.signed_distance(lambda x, top: x[2] - top, 1.0)
    assert jax.tree.leaves(plain.parameters) == [1.0]

    def distances(size, add):
        body = jaxrod.shapes.signed_distance(lambda x, top: size * x[2] - top, add)
        assert len(jax.tree.leaves(body.parameters)) == 2
        return surface(body, jnp.asarray([[0.0], [0.0], [3.0]]))[0][0]

    slopes = jax.grad(distances, argnums=(0, 1))(2.0, 0.5)
    assert [float(slope) for slope in slopes] == [3.0, -1.0]

    def blown(size):
        flow = jaxrod.fluids.flow_field(lambda x, _: size * x)
        return flow.at((jnp.ones(1), jnp.ones(1), jnp.ones(1)))[0][0]

    assert float(jax.grad(blown)(2.0)) == 1.0


@pytest.mark.slow
def test_a_run_with_a_function_that_holds_a_traced_number_is_differentiated():
    """It is the one with the number as a parameter, in both modes and batches."""
    top = -0.04
    expected = jax.grad(held)(top)
    assert abs(expected) > 0.1
    np.testing.assert_allclose(jax.grad(holding)(top), expected, rtol=1e-9)
    np.testing.assert_allclose(jax.jacfwd(holding)(top), expected, rtol=1e-9)
    tops = jnp.asarray([top, -0.05])
    np.testing.assert_allclose(
        jax.vmap(jax.grad(holding))(tops), jax.vmap(jax.grad(held))(tops), rtol=1e-9
    )

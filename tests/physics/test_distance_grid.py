"""Bodies from meshes and grids: distances, gradients and contact as in closed form."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod import shapes
from jaxrod.geometry import mesh_distance, surfaces, vectors
from jaxrod.geometry.rotations import directors, to_material
from physics import meshes
from physics.rods import difference

HALF = (0.1, 0.06, 0.15)
BOX = surfaces.box(np.array(HALF))


@pytest.fixture(scope="module")
def ring():
    return shapes.from_mesh(*meshes.torus(), spacing=0.01, margin=0.06)


@pytest.fixture(scope="module")
def block():
    return shapes.from_mesh(*BOX, spacing=0.01, margin=0.05)


@jax.jit
def surface(body, points):
    distance, normal = body.surface(vectors.split(points))
    return distance, vectors.join(normal)


def around(distances, count=300, seed=0):
    """Random points at the given distances from the ring, and the normals there."""
    draw = np.random.default_rng(seed)
    a, b = draw.uniform(0, 2 * np.pi, (2, count))
    normal = [np.cos(b) * np.cos(a), np.cos(b) * np.sin(a), np.sin(b)]
    ring = 0.15 * np.stack([np.cos(a), np.sin(a), 0 * a])
    return ring + (0.05 + draw.uniform(*distances, count)) * np.stack(normal), normal


def test_grid_distances_of_a_block_are_those_of_its_closed_form():
    """At its faces, edges and corners, inside and outside; for any spacing."""
    draw = np.random.default_rng(1)
    for counts in ((5, 17, 9), (33, 2, 12)):
        low, spacing = draw.uniform(-0.3, -0.2, 3), draw.uniform(0.02, 0.04)
        closed = mesh_distance.closed_surface(*BOX)
        found = mesh_distance.grid_distances(closed, low, spacing, counts)
        points = low[:, None] + spacing * np.indices(counts).reshape(3, -1)
        exact = meshes.from_box(points, HALF)
        assert np.abs(found.reshape(-1) - exact).max() < 1e-15


def test_signs_are_right_at_acute_edges_and_corners():
    """At these points the normal of one face alone has the wrong sign."""
    corners = np.array([[0, 0, 0], [1, 0.1, 0], [1, 0, 0.1], [1, -0.1, -0.1]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    closed = mesh_distance.closed_surface(corners, faces)
    low, counts = np.array([-0.5, -0.4, -0.4]), (33, 17, 17)
    found = mesh_distance.grid_distances(closed, low, 0.05, counts)
    points = low + 0.05 * np.indices(counts).reshape(3, -1).T
    inside = np.ones(len(points), bool)
    for a, b, c in closed[0][closed[1]]:
        inside &= (points - a) @ np.cross(b - a, c - a) < -1e-12
    assert np.array_equal(found.reshape(-1) < -1e-12, inside)


@pytest.mark.slow
def test_ten_thousand_triangles_have_the_distances_of_the_smooth_ring(ring, record):
    points, _ = around((-0.035, 0.055))
    exact, outward = meshes.from_torus(points)
    found, normal = surface(ring, points)
    error = float(np.abs(found - exact).max()) / 0.4
    tilt = float(np.abs(np.linalg.norm(normal - outward, axis=0)).max())
    record(
        "distance from a ring of 10,000 triangles, grid 0.01 m, of its size 0.4 m",
        "closed form",
        error,
        at_most=1e-3,
    )
    # The sides of its section are tilted by up to 0.063.
    record("normal of this ring", "closed form", tilt, at_most=0.063)


@pytest.mark.slow
def test_the_normal_is_the_gradient_everywhere(ring, block):
    """JAX and differences agree inside the grid, outside, and for the complement."""
    points = np.random.default_rng(2).uniform(-0.4, 0.4, (3, 200))
    for body in (ring, block, ring.complement()):
        distance = lambda x, body=body: body.surface(vectors.split(x[:, None]))[0][0]
        slope = jax.vmap(jax.grad(distance), 1, 1)(points)
        _, normal = surface(body, points)
        assert difference(normal, slope) < 1e-12
        step = 1e-6
        for axis in np.eye(3):
            ahead, behind = (
                surface(body, points + s * step * axis[:, None])[0] for s in (1, -1)
            )
            assert difference(axis @ normal, (ahead - behind) / (2 * step)) < 1e-7


def test_the_gradient_is_continuous_from_cell_to_cell(ring):
    """Linear interpolation between grid points jumps by several percent."""
    corner, spacing = np.asarray(ring.corner), float(ring.spacing)
    cells = np.random.default_rng(3).integers(5, 20, (3, 200))
    faces = corner[:, None] + spacing * cells
    for shift in (0.0, 0.5):
        at = faces + shift * spacing
        one, two = (surface(ring, at + s * 1e-9)[1] for s in (1, -1))
        assert difference(one, two) < 1e-6


@pytest.mark.slow
def test_the_spline_has_the_given_distances_and_any_linear_one():
    values = np.random.default_rng(4).normal(size=(5, 3, 7))
    body = shapes.signed_distance_grid(values, 0.1, (0.2, 0.3, -0.1))
    assert difference(body.values, values) < 1e-13
    points = np.array([0.2, 0.3, -0.1])[:, None] + 0.1 * np.indices((5, 3, 7)).reshape(
        3, -1
    )
    assert difference(surface(body, points)[0], values.reshape(-1)) < 1e-13
    x, y, z = np.indices((4, 4, 4)) * 0.1
    flat = shapes.signed_distance_grid(0.36 * x + 0.48 * y + 0.8 * z, 0.1)
    points = np.random.default_rng(5).uniform(0, 0.3, (3, 50))
    slope = np.array([0.36, 0.48, 0.8])
    found, normal = surface(flat, points)
    assert difference(found, slope @ points) < 1e-15
    assert difference(normal, np.broadcast_to(slope[:, None], (3, 50))) < 1e-14


@pytest.mark.slow
def test_outside_the_grid_the_distance_grows_with_that_from_the_grid(block):
    """It is never less than the true one, and never less than that from the grid."""
    points = np.random.default_rng(6).uniform(-2, 2, (3, 300))
    high = np.asarray(block.corner) + 0.01 * (np.array(block.values.shape) - 1)
    nearest = np.clip(points, np.asarray(block.corner)[:, None], high[:, None])
    apart = np.linalg.norm(points - nearest, axis=0)
    found, _ = surface(block, points)
    assert np.all(found >= meshes.from_box(points, HALF) - 1e-3)
    assert difference(found, surface(block, nearest)[0] + apart) < 1e-13
    inside_out, _ = surface(block.complement(), points)
    assert difference(inside_out, -found) == 0
    # The ground goes on straight.
    height = np.broadcast_to(np.linspace(-0.1, 0.1, 5), (3, 3, 5))
    ground = shapes.signed_distance_grid(height, 0.05)
    assert float(ground.beyond) == 0
    far = jnp.asarray([[3.0], [-2.0], [0.15]])
    found, normal = surface(ground, far)
    assert difference(found, 0.05) < 1e-15
    assert difference(normal[:, 0], jnp.asarray([0.0, 0.0, 1.0])) < 1e-14


def test_a_body_that_is_moved_is_the_same_body_elsewhere(block):
    turn, shift = np.array([0.8, 0.2, -0.4, 0.4]), np.array([1.0, -2.0, 0.5])
    w, x, y, z = turn / np.linalg.norm(turn)
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    points = np.random.default_rng(7).uniform(-0.3, 0.3, (3, 100))
    there = matrix @ points + shift[:, None]
    size = {"spacing": 0.01, "margin": 0.05}
    moved = shapes.from_mesh(*BOX, **size, position=shift, orientation=turn)
    distance, normal = surface(block, points)
    found, pointing = surface(moved, there)
    assert difference(found, distance) < 1e-14
    assert difference(pointing, matrix @ normal) < 1e-12
    shifted = shapes.from_mesh(BOX[0] + shift, BOX[1], **size)
    assert difference(surface(shifted, points + shift[:, None])[0], distance) < 1e-13


def fallen(body, steps=400, **touch):
    """A rod above a body, after it has fallen and rubs on it."""
    rod, state = jaxrod.straight_rod(
        10,
        length=0.16,
        radius=0.01,
        density=1e3,
        youngs_modulus=1e6,
        start=(-0.08, 0.0, 0.1605),
        direction=(1.0, 0.1, 0.0),
    )
    thrown = jnp.broadcast_to(jnp.asarray([[0.1], [0.0], [-0.2]]), (3, 11))
    state = dataclasses.replace(state, velocities=thrown)
    touch = {"stiffness": 1e4, "damping": 1.0, "friction": 0.3} | touch
    scene = jaxrod.make_scene(
        rod, jaxrod.gravity((0.0, 0.0, -9.81)), jaxrod.contact(body, **touch)
    )
    return scene, state, jaxrod.advance(scene, state, 1e-4, steps)


@pytest.mark.slow
def test_a_rod_on_a_mesh_moves_as_on_a_plane():
    """The distance above the middle of a face is linear, which the spline keeps."""
    table = surfaces.box(np.array([0.3, 0.3, 0.15]))
    body = shapes.from_mesh(*table, spacing=0.01, margin=0.05)
    _, start, on_mesh = fallen(body)
    _, _, on_plane = fallen(shapes.plane((0.0, 0.0, 0.15)))
    assert difference(on_plane.positions, start.positions) > 0.003
    assert difference(on_mesh.positions, on_plane.positions) < 1e-9
    assert difference(on_mesh.velocities, on_plane.velocities) < 1e-7


def wall(point, radius):
    """Distance of a point inside a tube about x from the tube's wall [m]."""
    return radius - jnp.sqrt(point[1] ** 2 + point[2] ** 2 + 1e-12)


def in_tube(body):
    rod, state = jaxrod.straight_rod(
        20,
        length=0.4,
        radius=0.004,
        density=1e3,
        youngs_modulus=1e6,
        start=(-0.2, 0.0, 0.0),
        direction=(1.0, 0.05, 0.02),
    )
    touch = jaxrod.contact(body, stiffness=3e3, damping=1.0, friction=0.2)
    fall = jaxrod.gravity((0.0, -6.0, -8.0)), jaxrod.exponential_damping(50.0)
    scene = jaxrod.make_scene(rod, *fall, touch)
    return scene, jaxrod.advance(scene, state, 1e-4, 3000)


@pytest.mark.slow
def test_a_rod_inside_a_tube_of_triangles_rests_as_in_the_round_tube():
    """The chords of the mesh's 80 sides are 0.02 mm inside the circle."""
    angle = 2 * np.pi * np.arange(80) / 80
    # In the middle between corners and middles of sides.
    size = 0.03 * (1 + 0.25 * (np.pi / 80) ** 2)
    circle = [0 * angle, size * np.cos(angle), size * np.sin(angle)]
    circle = np.stack(circle, axis=-1)
    ends = [circle + np.array([x, 0, 0]) for x in (-0.25, 0.25)]
    corners = np.concatenate([*ends, [[-0.25, 0, 0], [0.25, 0, 0]]])
    one, two = np.arange(80), (np.arange(80) + 1) % 80
    sides = [(one, two, two + 80), (one, two + 80, one + 80)]
    lids = [(0 * one + 160, two, one), (0 * one + 161, one + 80, two + 80)]
    faces = np.concatenate([np.stack(three, -1) for three in (*sides, *lids)])
    tube = shapes.from_mesh(corners, faces, spacing=0.003, margin=0.01)
    scene, inside_mesh = in_tube(tube.complement())
    _, inside_round = in_tube(shapes.signed_distance(wall, 0.03))
    assert difference(inside_mesh.positions, inside_round.positions) < 1e-4
    depth = jnp.hypot(inside_mesh.positions[1], inside_mesh.positions[2])
    assert 0.025 < depth.min() and depth.max() < 0.0265
    assert jaxrod.health(scene, inside_mesh, 1e-4).largest_violation < 0.2


@pytest.mark.slow
def test_energy_is_conserved_on_a_curved_mesh(ring):
    """A force along the gradient of the spline has an energy."""

    def swung(dt, steps):
        rod, state = jaxrod.straight_rod(
            6,
            length=0.1,
            radius=0.012,
            density=1e3,
            youngs_modulus=1e5,
            start=(0.1, -0.05, 0.065),
            direction=(0.2, 1.0, 0.1),
        )
        fall = jaxrod.gravity((0.0, 0.0, -9.81))
        touch = jaxrod.contact(ring, stiffness=2e3, onset=0.3)
        scene = jaxrod.make_scene(rod, fall, touch)
        after = jaxrod.advance(scene, state, dt, steps)
        bounced = difference(after.positions, state.positions)
        change = scene.total_energy(after) - scene.total_energy(state)
        return abs(float(change)), bounced

    coarse, bounced = swung(1e-4, 1500)
    fine, _ = swung(5e-5, 3000)
    assert bounced > 0.02
    assert coarse < 2e-5 and fine < 0.4 * coarse


@pytest.mark.slow
def test_positions_follow_the_place_of_the_body():
    """Reverse mode through contact, against differences."""
    base = shapes.from_mesh(*BOX, spacing=0.015, margin=0.05)

    @jax.jit
    def height(lift):
        body = dataclasses.replace(base, corner=base.corner + jnp.asarray([0, 0, lift]))
        return jnp.mean(fallen(body, 150)[2].positions[2])

    slope, step = float(jax.grad(height)(0.0)), 1e-8
    by_difference = float(height(step) - height(-step)) / (2 * step)
    assert abs(slope - by_difference) < 1e-5 and abs(slope) > 0.01


@pytest.mark.slow
def test_a_batch_is_its_members_and_numbers_change_without_compiling(block):
    points = np.random.default_rng(8).uniform(-0.3, 0.3, (3, 50))
    factors = jnp.asarray([1.0, 1.1, 0.9])
    bodies = [
        shapes.signed_distance_grid(f * block.values, block.spacing, block.corner)
        for f in factors
    ]
    many = jax.vmap(
        lambda f: shapes.signed_distance_grid(
            f * block.values, block.spacing, block.corner
        )
    )(factors)
    assert many.count == 3 and block.count is None
    together, _ = jax.vmap(lambda one: surface(one, points))(many)
    traced = []

    @jax.jit
    def alone(body):
        traced.append(1)
        return body.surface(vectors.split(points))[0]

    for found, body in zip(together, bodies, strict=True):
        assert difference(found, alone(body)) < 1e-13
    assert len(traced) == 1
    near = jaxrod.contact(bodies, stiffness=1e4)
    assert near.n_bodies == 3


@pytest.mark.slow
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_everything_is_finite_everywhere(block, kind):
    body = jaxrod.astype(block, kind)
    special = list(itertools.product((0.0, 0.1, 0.16, 0.5, 1e6), repeat=3))
    points = jnp.asarray(np.array(special).T, kind)

    def total(body, points):
        distance, normal = body.surface(vectors.split(points))
        return sum(jnp.sum(w * c) for w, c in enumerate((*normal, distance)))

    both = jax.jit(jax.value_and_grad(total, argnums=(0, 1)))(body, points)
    assert both[0].dtype == kind
    for leaf in jax.tree.leaves(both):
        assert jnp.all(jnp.isfinite(leaf))
    nowhere = body.surface(vectors.split(jnp.full((3, 1), jnp.nan, kind)))[0]
    assert bool(jnp.isnan(nowhere[0]))
    near = points[:, jnp.max(points, axis=0) < 1]
    single, double = surface(body, near)[0], surface(block, near.astype(float))[0]
    assert difference(single, double) < 1e-6


@pytest.mark.slow
def test_volume_and_inertia_are_those_of_the_closed_form(ring, block):
    exact = shapes.box((0, 0, 0), HALF).solid()
    solid = block.solid()
    assert abs(solid.volume / exact.volume - 1) < 0.01
    got, wanted = np.sort(solid.gyration), np.sort(exact.gyration)
    assert np.abs(got / wanted - 1).max() < 0.02
    assert abs(ring.solid().volume / (2 * np.pi**2 * 0.15 * 0.05**2) - 1) < 0.01
    across, along = 5 / 8 * 0.05**2 + 0.5 * 0.15**2, 0.75 * 0.05**2 + 0.15**2
    wanted = np.array([across, across, along])
    assert np.abs(np.sort(ring.solid().gyration) / wanted - 1).max() < 0.02
    assert abs(ring.inradius - 0.05) < 1e-3 and not ring.is_convex
    assert abs(block.bounding_radius - np.linalg.norm(HALF)) < 0.03
    # The shape in its principal axes is at the place of the body.
    turn = (0.8, 0.2, -0.4, 0.4)
    size = {"spacing": 0.015, "position": (0.3, 0.1, 0.2), "orientation": turn}
    body = shapes.from_mesh(BOX[0] + [0.1, 0.0, 0.2], BOX[1], **size)
    member, state = jaxrod.systems.rigid_body(body, density=500.0)
    points = np.random.default_rng(9).uniform(0.0, 0.6, (3, 40))
    frame = directors(tuple(state.orientations[:, 0]))
    away = vectors.subtract(
        vectors.split(jnp.asarray(points)), vectors.split(state.positions[:, 0])
    )
    own = jnp.stack(to_material(frame, away))
    here, _ = surface(member.shape, own)
    assert difference(here, surface(body, points)[0]) < 1e-12
    with pytest.raises(ValueError, match="extends beyond its grid cannot be a moving"):
        block.complement().solid()


@pytest.mark.slow
def test_a_rod_touches_a_moving_mesh_as_it_touches_the_box(block):
    """Contact with a rigid body conserves momentum, and both fly apart alike."""

    def hit(shape):
        body, of_body = jaxrod.systems.rigid_body(
            shape, mass=1.0, inertia=(0.01, 0.02, 0.02)
        )
        rod, of_rod = jaxrod.straight_rod(
            6,
            length=0.1,
            radius=0.01,
            density=1e3,
            youngs_modulus=1e6,
            start=(-0.05, 0.0, 0.165),
            direction=(1.0, 0.0, 0.0),
        )
        falling = jnp.broadcast_to(jnp.asarray([[0.0], [0.0], [-1.0]]), (3, 7))
        of_rod = dataclasses.replace(of_rod, velocities=falling)
        system = jaxrod.make_system(
            {"rod": jaxrod.make_scene(rod), "body": body},
            jaxrod.systems.body_contact("rod", "body", stiffness=1e5),
        )
        state = {"rod": of_rod, "body": of_body}
        assert jaxrod.stable_dt(system).dt > 1e-5
        return system, state, jaxrod.advance(system, state, 1e-5, 2000)

    centred = shapes.from_mesh(*BOX, spacing=0.01, margin=0.05)
    system, before, after = hit(centred)
    _, _, of_box = hit(shapes.box((0, 0, 0), HALF))
    assert difference(system.momentum(after), system.momentum(before)) < 1e-12
    assert of_box["body"].velocities[2, 0] < -0.01
    assert difference(after["body"].velocities, of_box["body"].velocities) < 1e-3


@pytest.mark.slow
def test_a_mesh_is_drawn_where_it_is():
    body = shapes.from_mesh(*BOX, spacing=0.02, position=(1.0, 2.0, 3.0))
    corners, faces = body.mesh()
    apart = meshes.from_box(corners.T - np.array([[1.0], [2.0], [3.0]]), HALF)
    assert np.abs(apart).max() < 5e-3 and len(faces) > 100
    inner, _ = body.complement().mesh()
    assert inner.shape == corners.shape


def opened(mesh):
    return mesh[0], mesh[1][:-1]


def one_turned(mesh):
    return mesh[0], np.concatenate([mesh[1][:-1], mesh[1][-1:, ::-1]])


def two_that_share_an_edge(mesh):
    corners = np.concatenate([mesh[0], mesh[0] + [0.2, 0.12, 0.0]])
    return corners, np.concatenate([mesh[1], mesh[1] + len(mesh[0])])


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    ("mesh", "options", "words"),
    [
        (
            opened(BOX),
            {},
            "not closed: 3 edges have a face on one side only, the first ",
        ),
        (one_turned(BOX), {}, "the mesh is not oriented: .*fix_normals"),
        (two_that_share_an_edge(BOX), {}, "edges of more than two faces"),
        ((BOX[0] * [1, 1, 0], BOX[1]), {}, "must enclose a volume|no face|more than"),
        ((0 * BOX[0] + 1, BOX[1]), {}, "no face of the mesh has an area: all 12 are"),
        (BOX, {"spacing": 0.1}, "at most half the shortest side .* got 0.1 m"),
        (BOX, {"spacing": 1e-4}, "makes 1.7e.10 grid points, more than 1.7e.07"),
        (BOX, {"spacing": -1.0}, "spacing must be positive, got -1 m"),
        (BOX, {"margin": 0.0}, "margin must be positive, got 0 m"),
        (BOX, {"orientation": (0, 0, 0, 0)}, "orientation must have a length"),
        ((BOX[0][:, :2], BOX[1]), {}, r"vertices must have shape \(v, 3\) \[m\]"),
        ((BOX[0], BOX[1] + 1), {}, "indices of vertices, from 0 to 7, got 8"),
        ((BOX[0], BOX[1] + 0.5), {}, "indices of vertices, from 0 to 7, got 0.5"),
        ((BOX[0], BOX[1][:0]), {}, "at least four triangles, got none"),
        ((np.nan * BOX[0], BOX[1]), {}, "vertices must be finite"),
    ],
)
def test_bad_meshes_are_refused_in_words(mesh, options, words):
    with pytest.raises(ValueError, match=words):
        shapes.from_mesh(*mesh, **options)


def test_inside_out_and_repeated_corners_are_put_right(block):
    """An STL file repeats the corners of each face, and some faces are points."""
    corners = BOX[0][BOX[1][:, ::-1]].reshape(-1, 3)
    faces = np.arange(len(corners)).reshape(-1, 3)
    faces = np.concatenate([faces, [[0, 0, 0], [1, 1, 2]]])
    same = shapes.from_mesh(corners, faces, spacing=0.01, margin=0.05)
    assert difference(same.coefficients, block.coefficients) < 1e-14


def test_a_grid_that_does_not_fit_the_rod_is_pointed_out(block):
    thin, _ = jaxrod.straight_rod(
        200, length=0.5, radius=0.002, density=1e3, youngs_modulus=1e6
    )
    with pytest.warns(shapes.CoarseGridWarning, match="0.01 m apart, more than the"):
        jaxrod.make_scene(thin, jaxrod.contact(block, stiffness=1e4))
    thick, _ = jaxrod.straight_rod(
        20, length=0.5, radius=0.06, density=1e3, youngs_modulus=1e6
    )
    with pytest.warns(shapes.CoarseGridWarning, match="ends 0.05 m from .* 0.06 m"):
        jaxrod.make_scene(thick, jaxrod.contact(block, stiffness=1e4))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: shapes.signed_distance_grid(np.zeros((2, 3, 4)), 0.1), "at least 3"),
        (lambda: shapes.signed_distance_grid(np.zeros((3, 3)), 0.1), "shape"),
        (lambda: shapes.signed_distance_grid(np.zeros((3, 3, 3)), 0.0), "spacing must"),
        (
            lambda: jax.jit(lambda v: shapes.from_mesh(v, BOX[1]))(BOX[0]),
            "vertices must be known numbers",
        ),
        (
            lambda: jax.jit(lambda h: shapes.from_mesh(*BOX, spacing=h))(0.01),
            "spacing must be a known number",
        ),
    ],
)
def test_bad_grids_are_refused_in_words(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def stl_text(corners, faces):
    lines = ["solid block"]
    for three in corners[faces]:
        lines += ["facet normal 0 0 0", "outer loop"]
        lines += [f"vertex {x} {y} {z}" for x, y, z in three]
        lines += ["endloop", "endfacet"]
    return "\n".join([*lines, "endsolid block", ""])


def stl_bytes(corners, faces):
    kind = [("numbers", "<f4", (12,)), ("more", "<u2")]
    rows = np.zeros(len(faces), kind)
    rows["numbers"][:, 3:] = corners[faces].reshape(-1, 9)
    return b"\0" * 80 + np.uint32(len(faces)).tobytes() + rows.tobytes()


def obj_text(corners, faces):
    lines = [f"v {x} {y} {z}" for x, y, z in corners]
    return "\n".join(lines + [f"f {a} {b} {c}" for a, b, c in faces + 1]) + "\n"


def test_files_of_three_kinds_have_the_same_surface(tmp_path, block):
    in_mm = 1e3 * BOX[0], BOX[1]
    (tmp_path / "text.stl").write_text(stl_text(*in_mm))
    (tmp_path / "binary.stl").write_bytes(stl_bytes(*in_mm))
    (tmp_path / "text.obj").write_text(obj_text(*in_mm))
    for name in ("text.stl", "binary.stl", "text.obj"):
        vertices, faces = shapes.load_mesh(tmp_path / name, unit=1e-3)
        body = shapes.from_mesh(vertices, faces, spacing=0.01, margin=0.05)
        assert difference(body.coefficients, block.coefficients) < 1e-8
    (tmp_path / "empty.obj").write_text("v 0 0 0\n")
    with pytest.raises(ValueError, match="has no triangles"):
        shapes.load_mesh(tmp_path / "empty.obj")


def test_a_body_is_saved_and_loaded(tmp_path, block):
    jaxrod.save(tmp_path / "block", block)
    again = jaxrod.load(tmp_path / "block")
    assert difference(again.coefficients, block.coefficients) == 0

"""Twist, writhe and link of curves whose values are known, and what passed through."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from physics.rods import arm, turn

writhe = jax.jit(jaxrod.topology.writhe, static_argnames="ends")
twist = jax.jit(jaxrod.topology.twist, static_argnames="ends")
link = jax.jit(jaxrod.topology.link, static_argnames="ends")
linking_number = jax.jit(jaxrod.topology.linking_number, static_argnames="ends")
crossings = jax.jit(jaxrod.topology.crossings)
crossed = jax.jit(jaxrod.topology.crossed)

POINTS = 100
ANGLE = np.arange(POINTS) * 2 * np.pi / POINTS
CIRCLE = np.stack([np.cos(ANGLE), np.sin(ANGLE), 0 * ANGLE])
TREFOIL = np.stack(
    [
        np.sin(ANGLE) + 2 * np.sin(2 * ANGLE),
        np.cos(ANGLE) - 2 * np.cos(2 * ANGLE),
        -np.sin(3 * ANGLE),
    ]
)


def shut(nodes):
    """The ring with its first node once more at its end, as a welded rod has it."""
    return np.concatenate([nodes, nodes[:, :1]], axis=1)


def ring(seed):
    """A random smooth closed ribbon: nodes, the last on the first, and normals."""
    random = np.random.default_rng(seed)
    waves = np.stack([f(k * ANGLE) for k in (1, 2, 3) for f in (np.cos, np.sin)])
    nodes = random.normal(size=(3, 6)) @ (waves / np.array([1, 1, 2, 2, 3, 3])[:, None])
    normals = random.normal(size=(3, 6)) @ waves + random.normal(size=(3, 1))
    return shut(nodes), normals


def test_a_plane_curve_does_not_writhe(record):
    eight = np.stack([np.sin(2 * ANGLE), np.sin(ANGLE), 0 * ANGLE])
    values = [
        float(writhe(c, ends="joined"))
        for c in (CIRCLE, eight, TREFOIL * [[1], [1], [0]])
    ]
    record(
        "Writhe of plane curves, with and without crossings",
        "0",
        max(map(abs, values)),
        at_most=0,
    )


def test_the_writhe_of_a_trefoil(record):
    """The same closed by a repeated node or by a segment, and of the mirror image."""
    value = writhe(TREFOIL, ends="joined")
    assert abs(writhe(shut(TREFOIL), ends="joined") - value) < 1e-14
    mirrored = writhe(TREFOIL * [[1], [1], [-1]], ends="joined")
    assert abs(mirrored + value) < 1e-13
    record(
        "Writhe of a trefoil knot of 100 segments, off by",
        "-3.3542250",
        abs(value + 3.3542250),
        at_most=1e-7,
    )


@pytest.mark.parametrize("pitch", [0.3, 0.8])
def test_the_writhe_of_a_helix(pitch, record):
    """Right-handed: positive, and per turn 1 - sin of the pitch angle when long."""
    angle = np.linspace(0, 24 * np.pi, 12 * 40 + 1)
    helix = np.stack([np.cos(angle), np.sin(angle), np.tan(pitch) * angle])
    measured = float(writhe(helix, ends="next_tangent")) / 12
    record(
        f"Writhe per turn of a helix of 12 turns, pitch angle {pitch} rad, off by",
        "1 - sin(pitch angle)",
        abs(measured - (1 - np.sin(pitch))),
        at_most=2e-3,
    )


def test_the_links_of_rings(record):
    """Two rings are linked once whichever is named first, apart not at all."""
    other = CIRCLE[[0, 2, 1]] + np.array([[1.0], [0.0], [0.0]])
    values = [
        abs(linking_number(CIRCLE, other)) - 1,
        linking_number(CIRCLE, other) - linking_number(shut(other), CIRCLE),
        linking_number(CIRCLE, other[:, ::-1]) + linking_number(CIRCLE, other),
        linking_number(CIRCLE, other + np.array([[3.0], [0.0], [0.0]])),
    ]
    record(
        "Linking number of two linked rings, reversed, apart, off by",
        "1, -1, 0",
        max(map(abs, values)),
        at_most=1e-14,
    )


def test_the_link_of_a_ribbon_on_a_circle(record):
    """Right-handed turns count as positive."""
    middle = ANGLE + np.pi / POINTS
    outwards = np.stack([np.cos(middle), np.sin(middle), 0 * middle])
    worst = 0.0
    for turns in (0, 1, -3, 5):
        up = np.array([[0.0], [0.0], [1.0]])
        normals = np.cos(turns * middle) * outwards - np.sin(turns * middle) * up
        for value in (
            link(shut(CIRCLE), normals, ends="joined"),
            twist(shut(CIRCLE), normals, ends="joined"),
        ):
            worst = max(worst, abs(float(value) - turns))
    record(
        "Link and twist of ribbons on a circle with 0, 1, -3, 5 turns, off by",
        "their turns",
        worst,
        at_most=1e-13,
    )


def test_link_is_twist_plus_writhe(record):
    """Of random closed ribbons; link is a whole number, of two lines by themselves."""
    worst = whole = 0.0
    for seed in range(8):
        nodes, normals = ring(seed)
        total = link(nodes, normals, offset=1e-4, ends="joined")
        parts = twist(nodes, normals, ends="joined") + writhe(nodes, ends="joined")
        worst = max(worst, abs(float(total - parts)))
        whole = max(whole, abs(float(total - jnp.round(total))))
    assert whole < 1e-10
    record(
        "Link minus twist minus writhe of random closed ribbons",
        "0",
        worst,
        at_most=1e-10,
    )


def test_a_gap_is_bridged():
    """A ring of n nodes and one whose last node is there twice are the same."""
    nodes, normals = ring(3)
    gapped, kept = nodes[:, :-1], normals[:, :-1]
    total = link(gapped, kept, offset=1e-4, ends="joined")
    parts = twist(gapped, kept, ends="joined") + writhe(gapped, ends="joined")
    np.testing.assert_allclose(total, parts, atol=1e-10)
    np.testing.assert_allclose(
        writhe(gapped, ends="joined"), writhe(nodes, ends="joined"), atol=1e-13
    )


def test_a_ring_closed_up_to_rounding_is_a_ring():
    """A last piece as short as rounding has no direction that means anything."""
    nodes, normals = map(jnp.asarray, ring(3))
    gap = 1e-14 * jnp.asarray([0.3, -1.0, 0.5])
    nearly = nodes.at[:, -1].set(nodes[:, 0] + gap)
    for quantity in (writhe, lambda x, **ends: twist(x, normals, **ends)):
        found, exact = (quantity(x, ends="joined") for x in (nearly, nodes))
        np.testing.assert_allclose(found, exact, atol=1e-12)


def test_twist_of_a_state():
    """A straight rod twisted by 0.9 turns from end to end, and any way it lies."""
    _, state = arm(POINTS)
    angles = jnp.linspace(0, 1.8 * jnp.pi, POINTS)
    zero = jnp.zeros(POINTS)
    orientations = turn(state.orientations, (zero, zero, angles))
    twisted = jaxrod.RodState(
        state.positions, orientations, state.velocities, state.angular_momenta
    )
    np.testing.assert_allclose(twist(twisted), 0.9, rtol=1e-13)
    assert float(writhe(twisted)) == 0.0


@jax.jit
@jax.value_and_grad
def both(nodes, normals):
    """Link and twist of a ring: one program for everything about gradients."""
    total = jaxrod.topology.link(nodes, normals, offset=0.01, ends="joined")
    lengthened = jaxrod.topology.writhe(nodes, ends="net_tangent")
    return (
        total + lengthened + 0.3 * jaxrod.topology.twist(nodes, normals, ends="joined")
    )


@pytest.mark.slow
def test_gradients_are_those_of_differences():
    """The link of a ribbon that is cut open is no whole number."""
    nodes, normals = ring(1)
    nodes = nodes + np.linspace(0, 0.5, POINTS + 1)
    move = np.random.default_rng(0).normal(size=nodes.shape)
    _, slope = both(nodes, normals)
    h = 1e-6
    ahead, behind = (both(nodes + s * move, normals)[0] for s in (h, -h))
    numeric = (ahead - behind) / (2 * h)
    assert abs(numeric) > 1e-3
    np.testing.assert_allclose(jnp.sum(slope * move), numeric, rtol=1e-6, atol=1e-7)


@pytest.mark.slow
def test_values_and_gradients_are_finite_everywhere():
    """In line, folded back onto itself, in one point, in a right angle, crossing."""
    line = np.linspace(0.0, 1.0, POINTS + 1)
    zero = 0 * line
    folded = np.abs(line - 0.5)
    cases = (
        (line, zero, zero),
        (folded, zero, zero),
        (zero, zero, zero),
        (np.minimum(line, 0.5), np.maximum(line, 0.5), zero),
        (np.cos(9 * line), np.sin(18 * line), zero),
        (np.round(8 * line) % 2, np.round(4 * line) % 2, zero),
    )
    normals = np.stack([zero + 0.2, zero + 1, zero + 2])[:, 1:]
    for case in cases:
        value, slope = both(np.stack(case), normals)
        assert jnp.isfinite(value)
        assert jnp.all(jnp.isfinite(slope))


def test_single_precision():
    nodes, normals = ring(2)
    single = jnp.asarray(nodes, jnp.float32)
    value = link(single, jnp.asarray(normals, jnp.float32), ends="joined")
    assert value.dtype == jnp.float32
    # At an offset of 1e-3 the lines are nearly one to float32.
    np.testing.assert_allclose(value, link(nodes, normals, ends="joined"), atol=1e-3)


def needle(height, n=7):
    """An open curve across the x axis at x = 0.05, at a height."""
    s = np.linspace(-1.0, 1.0, n + 1) + 0.1
    return np.stack([0 * s + 0.05, s, 0 * s + height])


def test_what_passed_through():
    """One pair, once, and the Gauss integral of closed curves jumps by as much."""
    rod = needle(0.0, 8)[[1, 0, 2]]
    counts = crossings(rod, rod, needle(0.2), needle(-0.1))
    assert np.abs(counts - jnp.round(counts)).max() < 1e-14
    assert np.abs(counts).sum() == pytest.approx(1, abs=1e-13)
    there_and_back = crossings(rod, rod, needle(-0.1), needle(0.2))
    np.testing.assert_allclose(there_and_back, -counts, atol=1e-14)
    assert not crossed(rod, rod, needle(0.2), needle(0.1))
    # Touching at one of the moments is a half, and found from either side.
    assert crossed(rod, rod, needle(0.2), needle(0.0))
    assert crossed(rod, rod, needle(0.0), needle(-0.1))


def test_the_invariant_jumps_by_what_passed_through(record):
    """Random closed curves, moved at random; seams are where rings are welded."""
    worst, passed = 0.0, 0
    for seed in range(4):
        (one, _), (one_later, _) = ring(seed), ring(seed + 10)
        (two, _), (two_later, _) = ring(seed + 20), ring(seed + 30)
        counts = crossings(one, one_later, two, two_later)
        jump = linking_number(one_later, two_later) - linking_number(one, two)
        worst = max(worst, abs(float(jnp.sum(counts) - jump)))
        passed += float(jnp.sum(jnp.abs(counts)))
    assert passed > 10, "the curves should pass through each other"
    record(
        "Passages of random rings, their sum minus the jump of the linking number",
        "0",
        worst,
        at_most=1e-10,
    )


def test_a_curve_through_itself():
    """Writhe jumps by two where one passes, and turning is not passing."""
    trefoil = shut(TREFOIL)
    # The strand that is below at one of the three crossings, pushed above.
    pushed = trefoil.copy()
    pushed[2] += 3.0 * np.exp(-(((np.arange(POINTS + 1) - 35) / 4.0) ** 2))
    counts = crossings(trefoil, pushed)
    passed = float(jnp.sum(counts)) / 2
    assert abs(passed) == pytest.approx(1, abs=1e-12)
    fine = [trefoil + s * (pushed - trefoil) for s in np.linspace(0, 1, 41)]
    values = [float(writhe(x, ends="joined")) for x in fine]
    jumps = np.round(np.diff(values) / 2)
    assert jumps.sum() == round(passed)
    assert np.abs(np.diff(values) - 2 * jumps).max() < 0.5
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert np.abs(crossings(trefoil, quarter @ trefoil + 5.0)).max() < 1e-13


@pytest.mark.slow
def test_frames_of_a_batch_are_those_of_a_loop():
    frames = jnp.stack([jnp.asarray(ring(seed)[0]) for seed in range(3)])
    together = jax.jit(jax.vmap(lambda x: writhe(x, ends="joined")))(frames)
    alone = [writhe(frame, ends="joined") for frame in frames]
    np.testing.assert_allclose(together, jnp.stack(alone), rtol=1e-12)
    passed = jax.jit(jax.vmap(jaxrod.topology.crossings))(frames[:-1], frames[1:])
    alone = [crossings(a, b) for a, b in itertools.pairwise(frames)]
    np.testing.assert_allclose(passed, jnp.stack(alone), atol=1e-12)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: jaxrod.topology.writhe(np.zeros((2, 5))), "nodes \\(3, n \\+ 1\\)"),
        (lambda: jaxrod.topology.writhe(np.zeros((4, 3, 5))), "use jax.vmap"),
        (
            lambda: jaxrod.topology.writhe(CIRCLE, ends="tied"),
            "ends must be one of open",
        ),
        (lambda: jaxrod.topology.writhe(CIRCLE, extension=1.0), "leave out extension"),
        (
            lambda: jaxrod.topology.writhe(CIRCLE, ends="end_to_end", extension=-1.0),
            "extension must be positive, got -1 m",
        ),
        (lambda: jaxrod.topology.twist(CIRCLE), "normals \\(3, n\\)"),
        (lambda: jaxrod.topology.twist(CIRCLE, CIRCLE), "normals must have shape"),
        (
            lambda: jaxrod.topology.twist(CIRCLE, CIRCLE[:, 1:], ends="net_tangent"),
            "one of open, joined",
        ),
        (
            lambda: jaxrod.topology.link(CIRCLE, CIRCLE[:, 1:], offset=0.0),
            "offset must be positive",
        ),
        (
            lambda: jaxrod.topology.linking_number(CIRCLE, CIRCLE, ends="next_tangent"),
            "one of joined, open",
        ),
        (
            lambda: jaxrod.topology.crossings(CIRCLE, CIRCLE[:, 1:]),
            "as many nodes as before",
        ),
        (
            lambda: jaxrod.topology.crossed(CIRCLE, CIRCLE, CIRCLE),
            "must be given together",
        ),
    ],
)
def test_what_is_no_curve_is_refused(call, words):
    with pytest.raises(ValueError, match=words):
        call()

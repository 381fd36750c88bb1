"""Builders of systems: what they build is at rest, and moves as it should."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod import assemblies

SOFT = {"density": 1000.0, "youngs_modulus": 1e6, "dtype": jnp.float64}

BUILT = {
    "bundle": lambda: assemblies.bundle(
        assemblies.hexagonal_places(1, 0.02),
        6,
        length=0.3,
        radius=0.01,
        stiffness=1e5,
        turning_stiffness=10.0,
        **SOFT,
    ),
    "net": lambda: assemblies.net(3, 4, spacing=0.1, radius=0.003, **SOFT),
    "octopus": lambda: assemblies.octopus(dtype=jnp.float64),
    "cilia": lambda: assemblies.cilia(
        3, 2, 5, spacing=0.02, length=0.1, radius=(0.003, 0.001), **SOFT
    ),
    "tree": lambda: assemblies.tree(2, 3, 4, length=0.5, radius=0.02, **SOFT),
    "braid": lambda: assemblies.braid(
        3, 24, radius=0.05, length=0.2, turns=1.0, thickness=0.002, **SOFT
    ),
    "free braid": lambda: assemblies.braid(
        3,
        24,
        radius=0.05,
        length=0.2,
        turns=1.0,
        thickness=0.002,
        joined="free",
        **SOFT,
    ),
}


@pytest.mark.parametrize("way", [(2, 0, 0), (0, 3, 0), (0, 0, 1), (1, 1, 1)])
def test_cilia_stand_as_they_are_told(way):
    """Their d1 is the part of the world's x, or of y where they stand along x."""
    _, state = assemblies.cilia(
        2, 1, 2, spacing=0.02, length=0.1, radius=0.003, direction=way, **SOFT
    )
    unit = np.array(way) / np.linalg.norm(way)
    frames = np.asarray(jax.tree.map(lambda leaf: leaf[0], state["cilia"]).directors)
    np.testing.assert_allclose(frames[2, :, 0], unit, atol=1e-12)
    across = np.eye(3)[1 if way[0] == 2 else 0]
    d1 = across - unit * (unit @ across)
    np.testing.assert_allclose(frames[0, :, 0], d1 / np.linalg.norm(d1), atol=1e-12)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("arms", [1, 5, 8])
def test_arms_of_an_octopus_are_evenly_spread_around_its_head(arms):
    _, state = assemblies.octopus(arms, 3, head_radius=0.1, length=0.4, **SOFT)
    angles = 2 * np.pi * np.arange(arms) / arms
    ways = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    nodes = np.asarray(state["arms"].positions)
    for node, distance in ((0, 0.1), (3, 0.5)):
        np.testing.assert_allclose(nodes[:, :, node], distance * ways, atol=1e-12)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("branches", [1, 3, 5])
def test_branches_of_a_fork_lean_alike_and_are_evenly_spread(branches):
    _, state = assemblies.tree(
        1, branches, 2, length=0.5, radius=0.02, angle=0.4, **SOFT
    )
    ways = []
    for k in range(branches):
        one = jax.tree.map(lambda leaf, k=k: leaf[k], state["level 1"])
        ways.append(np.asarray(one.directors)[2, :, 0])
    x, y, z = np.array(ways).T
    np.testing.assert_allclose(z, np.cos(0.4), atol=1e-12)
    turns = np.unwrap(np.arctan2(y, x))
    np.testing.assert_allclose(
        turns - turns[0], 2 * np.pi * np.arange(branches) / branches, atol=1e-12
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", BUILT)
def test_what_is_built_is_at_rest(name):
    system, state = BUILT[name]()
    dt = jaxrod.stable_dt(system).dt
    after = jaxrod.advance(system, state, dt, 10)
    assert not jaxrod.health(system, after, dt).flagged
    for member, own in state.items():
        np.testing.assert_allclose(after[member].positions, own.positions, atol=1e-13)


def length_along(curve):
    return np.sum(np.linalg.norm(np.diff(curve, axis=-1), axis=-2), axis=-1)


def pulled(system, state, *springs):
    """The system with pose springs besides, stepped for a while with damping."""
    members = dict(system.members)
    return jaxrod.make_system(members, *system.couplings, *springs, state=state)


@pytest.mark.slow
def test_a_pinned_net_is_pulled_to_a_diamond(record):
    """Two cells wide, of stiff rods: diagonals with D^2 + d^2 = 4 (side)^2."""
    damp = jaxrod.exponential_damping(8.0)
    system, state = assemblies.net(
        3,
        3,
        spacing=0.1,
        radius=0.004,
        joined="tie",
        effects=(damp,),
        density=1000.0,
        youngs_modulus=1e7,
        dtype=jnp.float64,
    )
    far = 0.02
    corners = [("rows", 0, "base"), ("rows", 2, "tip")]
    springs = [
        jaxrod.systems.pose_spring(
            place,
            state,
            stiffness=20.0,
            damping=0.2,
            displacement=jaxrod.schedules.ramp(
                (0.0, 0.0, 0.0), (sign * far, sign * far, 0.0), 0.4
            ),
        )
        for place, sign in zip(corners, (-1, 1), strict=True)
    ]
    system = pulled(system, state, *springs)
    dt = float(jaxrod.stable_dt(system).dt)
    after = jaxrod.advance(system, state, dt, int(1.5 / dt))
    rows = np.asarray(after["rows"].positions)
    long = np.linalg.norm(rows[2, :, -1] - rows[0, :, 0])
    short = np.linalg.norm(rows[2, :, 0] - rows[0, :, -1])
    assert long > 0.33 and short < 0.23
    record(
        "pinned net pulled along its diagonal: the other diagonal",
        "sqrt(4 a^2 - D^2)",
        abs(short / np.sqrt(4 * 0.2**2 - long**2) - 1),
        at_most=0.01,
    )


@pytest.mark.slow
def test_a_braid_that_is_pressed_grows_wider(record):
    """The strands of a McKibben muscle: L^2 + (2 pi N R)^2 = b^2, in its middle."""
    damp = jaxrod.exponential_damping(8.0)
    system, state = assemblies.braid(
        4,
        32,
        radius=0.03,
        length=0.3,
        turns=1.0,
        thickness=0.001,
        effects=(damp,),
        density=1000.0,
        youngs_modulus=1e7,
        dtype=jnp.float64,
    )
    springs = [
        jaxrod.systems.pose_spring(
            (plate,),
            state,
            stiffness=50.0,
            damping=2.0,
            turning_stiffness=0.1,
            turning_damping=1e-3,
            displacement=jaxrod.schedules.ramp((0.0, 0.0, 0.0), (0.0, 0.0, way), 0.4),
        )
        for plate, way in (("bottom", 0.01), ("top", -0.01))
    ]
    before = np.asarray(state["left"].positions)
    system = pulled(system, state, *springs)
    dt = float(jaxrod.stable_dt(system).dt)
    after = np.asarray(
        jaxrod.advance(system, state, dt, int(0.8 / dt))["left"].positions
    )
    middle = slice(12, 21)
    strand, rest = after[:, :, middle], before[:, :, middle]
    radii = np.linalg.norm(strand[:, :2], axis=1)
    angle = np.unwrap(np.arctan2(strand[:, 1], strand[:, 0]), axis=1)
    around = np.mean(radii, axis=1) * (angle[:, -1] - angle[:, 0])
    along = strand[:, 2, -1] - strand[:, 2, 0]
    squares = along**2 + around**2
    assert np.mean(radii) > 1.03 * 0.03
    assert np.mean(along) < 0.97 * np.mean(rest[:, 2, -1] - rest[:, 2, 0])
    record(
        "braid pressed together: length of a strand in its middle",
        "L^2 + (2 pi N R)^2 = b^2",
        float(np.max(np.abs(np.sqrt(squares) / length_along(rest) - 1))),
        at_most=0.01,
    )


@pytest.mark.slow
def test_a_nest_comes_to_lie_in_its_pot():
    system, state = assemblies.nest(
        4,
        4,
        length=0.2,
        radius=0.012,
        pot_radius=0.15,
        stiffness=2e4,
        damping=8.0,
        friction=0.3,
        points_per_element=4,
        effects=(jaxrod.gravity(), jaxrod.exponential_damping(3.0)),
        **SOFT,
    )
    dt = float(jaxrod.stable_dt(system).dt)
    start = float(system.total_energy(state))
    after = jaxrod.advance(system, state, dt, int(0.5 / dt))
    assert system.total_energy(after) < start
    assert not jaxrod.health(system, after, dt).flagged
    places = np.asarray(after["rods"].positions)
    assert np.max(np.linalg.norm(places[:, :2], axis=1)) < 0.15
    assert np.min(places[:, 2]) > 0.006
    assert np.max(places[:, 2]) < np.max(np.asarray(state["rods"].positions)[:, 2])


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (
            lambda: assemblies.bundle(
                [[0, 0.01], [0, 0]], 4, length=1, radius=0.01, stiffness=1, **SOFT
            ),
            "rods of radius 0.01 m overlap: places are 0.01 m apart",
        ),
        (
            lambda: assemblies.bundle(
                [[0, 0.1], [0, 0]], 4, length=1, radius=0.01, stiffness=1, **SOFT
            ),
            "no rods of radius 0.01 m touch",
        ),
        (
            lambda: assemblies.net(1, 3, spacing=0.1, radius=0.01, **SOFT),
            "rows must be at least 2, got 1",
        ),
        (
            lambda: assemblies.net(2, 3, spacing=-0.1, radius=0.01, **SOFT),
            "spacing must be positive, got -0.1 m",
        ),
        (
            lambda: assemblies.net(
                2, 3, spacing=0.1, radius=0.01, joined="glue", **SOFT
            ),
            'joined must be "weld" or "tie"',
        ),
        (lambda: assemblies.octopus(0), "arms must be at least 1, got 0"),
        (
            lambda: assemblies.cilia(
                2, 2, 4, spacing=0.01, length=0.1, radius=0.01, **SOFT
            ),
            "spacing must be at least the diameter, 0.02 m, got 0.01 m",
        ),
        (
            lambda: assemblies.nest(
                3,
                4,
                length=1.0,
                radius=0.01,
                pot_radius=0.2,
                stiffness=1,
                damping=1,
                **SOFT,
            ),
            "length must be below the width of the pot, 0.378 m, got 1 m",
        ),
        (
            lambda: assemblies.tree(40, 3, 4, length=1.0, radius=0.01, **SOFT),
            "levels must be at most 20, got 40",
        ),
        (
            lambda: assemblies.braid(
                3, 20, radius=0.05, length=0.2, turns=1, thickness=0.002, **SOFT
            ),
            "a whole number, got 6, and n_elements a multiple of it, got 20",
        ),
    ],
)
def test_bad_input(build, words):
    with pytest.raises(ValueError, match=words):
        build()


@pytest.mark.parametrize("rings", [1, 2, 3])
def test_hexagonal_places_fill_a_hexagon(rings):
    places = jaxrod.assemblies.parallel_rods.hexagonal_places(rings, 0.1)
    assert places.shape == (2, 3 * rings * (rings + 1) + 1)
    away = np.linalg.norm(places, axis=0)
    assert np.sum(np.isclose(away, 0.1 * rings)) >= 6
    assert np.max(away) == pytest.approx(0.1 * rings)
    between = np.linalg.norm(places[:, :, None] - places[:, None], axis=0)
    assert np.min(between + np.eye(len(away))) == pytest.approx(0.1)

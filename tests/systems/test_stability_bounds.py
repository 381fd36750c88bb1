"""The step that couplings allow against the linearised step's own limit.

Couplings are much stiffer than what they couple, so that they alone limit the step.
"""

import time
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
import jaxrod.extend
from benchmarks.plectoneme.element_contact import element_contact
from jaxrod.effects.base import StabilityBound, added_bounds
from jaxrod.lanes.choice import lane_mode, use_lanes
from jaxrod.systems.contact.collision_bodies import surface_mobility
from systems.members import SOFT, rod

RADIUS, N = SOFT["radius"], 3
STIFF = {"stiffness": 1e8}
"""Of springs [N/m] that are a hundred times stiffer than rods."""
PRESSED = {"stiffness": 1e10, "onset": 1e-3}
"""Of contact [N/m^2]; depths are of the order of the onset, so that forces are not."""
DEEP = 1e-2 * RADIUS


def limit_over_bound(system, state):
    """The largest step at which nothing swings up, over that of `stable_dt`.

    A step that is too long multiplies some motion by less than -1.
    """
    bound = float(jaxrod.stable_dt(system, 1.0).dt)
    step = jax.jit(lambda moved, dt: jaxrod.advance(system, moved, dt, 1))
    leaves, structure = jax.tree.flatten(jax.tree.map(np.asarray, state))
    names = [str(path[-1]) for path, _ in jax.tree.leaves_with_path(state)]
    ends = np.cumsum([leaf.size for leaf in leaves])

    def after(flat, dt):
        parts = np.split(flat, ends[:-1])
        moved = [
            part.reshape(leaf.shape) for part, leaf in zip(parts, leaves, strict=True)
        ]
        return flattened(step(jax.tree.unflatten(structure, moved), dt))

    def flattened(tree):
        return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(tree)])

    flat = flattened(state)
    # Of rates so much that places change alike.
    sizes = [1e-9 / bound if "veloc" in name else 1e-9 for name in names]
    sizes = np.repeat(sizes, [leaf.size for leaf in leaves])

    def swings_up(ratio):
        # By differences: a compiled step that puts its results in one row is slow.
        dt, moves = ratio * bound, np.diag(sizes)
        changes = [after(flat + one, dt) - after(flat - one, dt) for one in moves]
        factors = np.linalg.eigvals(np.stack(changes, axis=1) / (2 * sizes))
        return np.any((factors.real < 0) & (np.abs(factors) > 1 + 1e-3))

    low, high = 0.5, 8.0
    assert not swings_up(low) and swings_up(high)
    while high - low > 2e-3:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if swings_up(middle) else (middle, high)
    return low


def compared(name, build, far, record):
    """Compares the bound, and the step measured at the state, with that limit."""
    system, state = build()
    limit = limit_over_bound(system, state)
    record(
        f"{name}: limit of the linearised step, divided by the bound",
        "at least 1 (safe), and not much more",
        limit,
        between=(0.99, far),
    )
    bound = jaxrod.stable_dt(system, 1.0).dt
    measured = jaxrod.stable_dt(system, 1.0, state=state).dt
    record(
        f"{name}: step measured at the state over that limit",
        "1",
        float(measured / bound) / limit,
        between=(0.99, 1.01),
    )


def rods(*starts, direction=(1, 0, 0), length=0.3):
    """Scenes and states of rods beside each other, one member each."""
    made = {f"rod {k}": rod(N, length, s, direction) for k, s in enumerate(starts)}
    scenes = {name: jaxrod.make_scene(one) for name, (one, _) in made.items()}
    return scenes, {name: state for name, (_, state) in made.items()}


def stacked(count, law, **numbers):
    """Rods on top of each other, touching all along."""
    gap = 2 * RADIUS - DEEP
    scenes, state = rods(*((0.0, 0.0, k * gap) for k in range(count)))
    return jaxrod.make_system(scenes, law(*scenes, **PRESSED | numbers)), state


def on_body(shape, density, **numbers):
    """A rod that lies on a body."""
    scenes, state = rods((-0.15, 0.0, RADIUS - DEEP))
    body, of_body = jaxrod.systems.rigid_body(shape, density=density, dtype=jnp.float64)
    law = jaxrod.systems.body_contact("rod 0", "body", **PRESSED | numbers)
    return jaxrod.make_system({**scenes, "body": body}, law), {**state, "body": of_body}


def joined(joint, body=None):
    """A rod's end joined to the start of another, or to a point of a body."""
    starts = [(0.0, 0.0, 0.0), (0.3, 0.0, 0.0)][: 2 if body is None else 1]
    scenes, state = rods(*starts)
    if body is not None:
        shape = jaxrod.shapes.box((0.35, 0.0, 0.0), (0.05, 0.05, 0.1))
        scenes["body"], state["body"] = jaxrod.systems.rigid_body(
            shape, density=body, dtype=jnp.float64
        )
    other = ("rod 1", "base") if body is None else ("body",)
    coupling = joint(("rod 0", "tip"), other, state)
    return jaxrod.make_system(scenes, coupling), state


def hinged(a, b, state):
    """A hinge whose axis springs are what is stiff."""
    return jaxrod.systems.hinge_joint(
        a, b, state, axis=(0, 1, 0), stiffness=10.0, axis_stiffness=1e5
    )


def turned(a, b, state):
    """A joint whose springs against turning are what is stiff."""
    return jaxrod.systems.fixed_joint(
        a, b, state, stiffness=10.0, turning_stiffness=1e5
    )


def ball(a, b, state, **numbers):
    """A ball joint."""
    return jaxrod.systems.ball_joint(a, b, state, **STIFF | numbers)


def sprung(a, b, state):
    """A spring between nodes that are an element apart."""
    return jaxrod.systems.spring((a[0], "base"), b, state, **STIFF)


def paired(count, **numbers):
    """Two rods side by side by PyElastica's law, without an onset."""
    scenes, state = rods(*((0.0, 0.0, k * (2 * RADIUS - DEEP)) for k in range(count)))
    law = element_contact(*scenes, **{"stiffness": 1e9} | numbers)
    return jaxrod.make_system(scenes, law), state


def glued(damping):
    """Two rods glued side by side."""
    scenes, state = rods((0.0, 0.0, 0.0), (0.0, 0.0, 2 * RADIUS))
    law = jaxrod.systems.glue(*scenes, state, damping=damping, **STIFF)
    return jaxrod.make_system(scenes, law), state


LINE, CROSSING = jaxrod.systems.rod_contact, jaxrod.systems.crossing_contact
SLAB, BALL = (
    jaxrod.shapes.box((0, 0, -0.2), (0.2,) * 3),
    jaxrod.shapes.sphere((0, 0, -0.3), 0.3),
)
POINT = 0.3 / N / 5
"""Length that one point of a rod stands for [m]."""
FRICTION = {"stiffness": 1e8, "damping": 1e6, "friction": 0.5}
# Scene, and how far above the bound the limit may be. Bounds of contact count all of a
# rod as touching as many as there may be: they are sharp where it does.
SHARP, SAFE = 1.02, 2.2
CASES = {
    "rod_contact of two rods, max_contacts=1": (
        lambda: stacked(2, LINE, max_contacts=1),
        SHARP,
    ),
    "rod_contact of two rods": (lambda: stacked(2, LINE), SAFE),
    "rod_contact of three rods": (lambda: stacked(3, LINE), SAFE),
    "rod_contact of two rods, dashpots and friction": (
        lambda: stacked(2, LINE, max_contacts=1, **FRICTION),
        SAFE,
    ),
    "rod_contact of two rods, friction far above all springs": (
        lambda: stacked(2, LINE, max_contacts=1, **FRICTION | {"damping": 3e4}),
        SHARP,
    ),
    "rod_contact of two rods, friction and springs alike": (
        # Friction drags along surfaces that springs act across: the golden ratio.
        lambda: stacked(2, LINE, max_contacts=1, **FRICTION | {"damping": 1e3}),
        1.62,
    ),
    "crossing_contact of two rods, max_contacts=1": (
        lambda: stacked(2, CROSSING, max_contacts=1, stiffness=1e9),
        SAFE,
    ),
    "crossing_contact of three rods": (
        # Nodes share each spring; the bound has all at their worst places.
        lambda: stacked(3, CROSSING, stiffness=1e9),
        2.5,
    ),
    "element_contact of two rods, pairs=3": (lambda: paired(2, pairs=3), SAFE),
    "element_contact of two rods, dashpots": (
        # As far off as stiffness is, squared: rates of drag limit steps themselves.
        lambda: paired(2, pairs=3, stiffness=1e7, damping=1e6),
        SAFE**2,
    ),
    "body_contact of a rod all along a heavy box": (lambda: on_body(SLAB, 1e5), SAFE),
    "body_contact of a rod all along a light box": (lambda: on_body(SLAB, 10.0), SAFE),
    "body_contact of the same with dashpots and friction": (
        lambda: on_body(SLAB, 1e5, **FRICTION),
        SAFE,
    ),
    # As if all of the rod touched, as it does where it is wound around.
    "body_contact of one point of a rod on a heavy ball": (
        lambda: on_body(BALL, 1e5),
        3.3,
    ),
    "body_contact of one point of a rod on a light ball": (
        lambda: on_body(BALL, 10.0),
        6.0,
    ),
    "body_contact of one point of a rod on a heavy ball, touching given": (
        lambda: on_body(BALL, 1e5, touching=POINT),
        SAFE,
    ),
    "body_contact of one point of a rod on a light ball, touching given": (
        lambda: on_body(BALL, 10.0, touching=POINT),
        SAFE,
    ),
    "glue of two rods": (lambda: glued(1.0), SAFE),
    "glue of two rods, dashpots far above all springs": (lambda: glued(1e5), SAFE),
    "ball_joint of two rods, springs and dashpots alike": (
        lambda: joined(lambda *ends: ball(*ends, damping=1e2)),
        SHARP,
    ),
    "ball_joint of two rods": (lambda: joined(ball), SHARP),
    "ball_joint of a rod and a light body": (lambda: joined(ball, 10.0), SHARP),
    "dashpot of a ball_joint": (
        lambda: joined(lambda *ends: ball(*ends, stiffness=10.0, damping=1e4)),
        SHARP,
    ),
    "axis of a hinge_joint of two rods": (lambda: joined(hinged), SHARP),
    "axis of a hinge_joint of a rod and a light body": (
        lambda: joined(hinged, 10.0),
        SHARP,
    ),
    "turning of a fixed_joint": (lambda: joined(turned), SHARP),
    "spring between rods": (lambda: joined(sprung), SHARP),
    "spring between a rod and a light body": (lambda: joined(sprung, 10.0), SHARP),
}


def bodies(*made):
    """Members and states of rigid bodies, from arguments of `rigid_body`."""
    pairs = [jaxrod.systems.rigid_body(dtype=jnp.float64, **one) for one in made]
    names = [f"body {k}" for k in range(len(pairs))]
    return (
        {name: body for name, (body, _) in zip(names, pairs, strict=True)},
        {name: state for name, (_, state) in zip(names, pairs, strict=True)},
    )


def far_apart(**numbers):
    """A spring between two bodies of small inertia, a metre apart."""
    body = {"mass": 1.0, "inertia": (1e-3,) * 3}
    members, state = bodies(body, body | {"position": (1.0, 0.0, 0.0)})
    spring = jaxrod.systems.spring(("body 0",), ("body 1",), state, **numbers)
    return jaxrod.make_system(members, spring), state


def bar_on_its_end():
    """A ball joint at the end of a slender bar, which hardly resists turning about d3.

    The other body is the same bar.
    """
    bar = {"mass": 1.0, "inertia": (1e-1, 1e-1, 1e-4)}
    members, state = bodies(bar, bar | {"position": (0.0, 0.0, 2.0)})
    joint = jaxrod.systems.ball_joint(
        ("body 0",), ("body 1",), state, stiffness=1.0, at=(0.0, 0.0, 1.0)
    )
    return jaxrod.make_system(members, joint), state


def test_the_couple_of_a_motor_that_turns_with_its_hinge_counts():
    """Its stiffness, from changes of the rates of both bodies in a short step."""
    body = {"mass": 1.0, "inertia": (0.5,) * 3}
    members, state = bodies(body, body | {"position": (1.0, 0.0, 0.0)})
    hinge = jaxrod.systems.hinge_joint(
        ("body 0",),
        ("body 1",),
        state,
        axis=(0, 0, 1),
        stiffness=1e-6,
        axis_stiffness=1.0,
        motor=3.0,
    )
    system, short = jaxrod.make_system(members, hinge), 1e-6

    def gained(turns):
        turned = {}
        for (name, one), half in zip(state.items(), 0.5 * turns, strict=True):
            quaternion = jnp.asarray([1.0, *half])[:, None]
            turned[name] = replace(one, orientations=quaternion)
        after = jaxrod.advance(system, turned, short, 1)
        rates = [np.ravel(one.angular_velocities) for one in after.values()]
        return np.concatenate(rates) / short

    tiny = 1e-5 * np.eye(6).reshape(6, 2, 3)
    columns = [(gained(-move) - gained(move)) / 2e-5 for move in tiny]
    stiffness = np.stack(columns, axis=1)
    fastest = np.linalg.eigvalsh(0.5 * (stiffness + stiffness.T))[-1]
    dt = float(jaxrod.stable_dt(system, 1.0).dt)
    assert 4 * 0.99 < dt**2 * fastest < 4 * (1 + 1e-4)


def cone(point, size):
    """Distance from a cone with its centre of mass at the origin, not exact outside."""
    height, radius = size
    from_axis = jnp.sqrt(point[0] ** 2 + point[1] ** 2 + 1e-24)
    below = point[2] - 0.75 * height
    slope = jnp.sqrt(height**2 + radius**2)
    side = (from_axis * height + below * radius) / slope
    return jnp.maximum(side, -point[2] - 0.25 * height)


def tip_of_a_cone():
    """A cone that a heavy ball touches near its tip."""
    height, radius, heavy = 1.0, 0.5, 0.3
    across = 3 / 20 * radius**2 + 3 / 80 * height**2
    shape = jaxrod.shapes.signed_distance(cone, jnp.asarray([height, radius]))
    inertia = (across, across, 0.3 * radius**2)
    normal = np.array([height, 0, radius]) / np.hypot(height, radius)
    touched = np.array([0.01 * radius, 0, 0.75 * height - 0.01 * height])
    beside = jaxrod.shapes.sphere(touched + (heavy - 1e-6) * normal, heavy)
    members, state = bodies(
        {"shape": shape, "mass": 1.0, "inertia": inertia},
        {"shape": beside, "mass": 1e3},
    )
    contact = jaxrod.systems.rigid_contact(
        "body 0", "body 1", stiffness=1e3, onset=1e-9
    )
    return jaxrod.make_system(members, contact), state


LEVERS = {
    "spring with a dashpot halfway between two bodies far apart": (
        lambda: far_apart(stiffness=1e-3, damping=1.0),
        SHARP,
    ),
    "ball_joint of two slender bars, end to end": (bar_on_its_end, SHARP),
    "rigid_contact of a ball with the tip of a signed_distance cone": (
        tip_of_a_cone,
        SAFE,
    ),
}


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("name", LEVERS)
def test_bounds_of_long_levers_are_safe_and_not_far_off(name, record):
    compared(name, *LEVERS[name], record)


@pytest.mark.slow
def test_without_kernels_the_measured_step_is_the_same():
    """XLA must not fuse the whole response: it would compile for minutes."""
    system, state = far_apart(stiffness=1e-3, damping=1.0)
    before, measured = lane_mode(), []
    try:
        for mode in ("auto", "never"):
            use_lanes(mode)
            # Compiled programs keep the mode with which they were compiled.
            jax.clear_caches()
            begun = time.process_time()
            measured.append(float(jaxrod.stable_dt(system, state=state).dt))
            assert time.process_time() - begun < 60
    finally:
        use_lanes(before)
    assert measured[1] == pytest.approx(measured[0], rel=1e-6)


SHAPES = {
    "sphere": jaxrod.shapes.sphere((0, 0, 0), 0.2),
    "capsule": jaxrod.shapes.capsule((0, 0, -1), (0, 0, 1), 0.1),
    "cylinder": jaxrod.shapes.cylinder((0, 0, -1), (0, 0, 1), 0.1),
    "disc": jaxrod.shapes.cylinder((0, 0, -0.01), (0, 0, 0.01), 0.3),
    "box": jaxrod.shapes.box((0, 0, 0), (0.1, 0.5, 0.02)),
}


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("density", [{"density": 1e3}, {"mass": 2.0}])
def test_no_point_of_a_surface_moves_more_easily_than_the_bound(name, density):
    """Points of the mesh, pushed in any direction or along the normal."""
    own = {"inertia": (0.3, 0.2, 0.4)} if "mass" in density else {}
    body, _ = jaxrod.systems.rigid_body(
        SHAPES[name], dtype=jnp.float64, **density, **own
    )
    points = np.asarray(body.shape.mesh()[0])
    turns = np.zeros((len(points), 3, 3))
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        # The lever arm times a force, as a matrix on the force.
        turns[:, k, j], turns[:, k, i] = points[:, i], -points[:, j]
    easy = 1 / np.asarray(body.principal_inertias[:, 0])
    matrices = np.einsum("nki,k,nkj->nij", turns, easy, turns)
    normals = np.stack(
        body.shape.surface(tuple(jnp.asarray(1.0001 * points.T)))[1], axis=-1
    )
    mass = float(body.masses[0])
    any_way = np.max(np.linalg.eigvalsh(matrices)) + 1 / mass
    normal = np.max(np.einsum("ni,nij,nj->n", normals, matrices, normals)) + 1 / mass
    rubbed, pushed = (
        float(surface_mobility(body.parts(), rubs=rubs)[0]) for rubs in (True, False)
    )
    assert (1 - 1e-3) * any_way <= rubbed <= 2.5 * any_way
    # At an edge the normals of the mesh are not the worst.
    assert (1 - 1e-3) * normal <= pushed <= rubbed


@jaxrod.extend.pytree
class OwnBall(jaxrod.shapes.Body):
    """A ball about the origin, as a shape of the user's own."""

    radius: jax.Array

    def surface(self, points):
        """Distance from the origin minus the radius, and its gradient."""
        length = jaxrod.extend.vectors.safe_norm(points)
        normal = jaxrod.extend.vectors.scale(1 / length, points)
        return length - self.radius, normal

    @property
    def bounding_radius(self):
        """Radius of the ball [m]."""
        return self.radius


def test_the_bounding_radius_of_a_shape_of_ones_own_counts():
    """The step is that of a sphere, however small the moments of inertia are."""

    def step(shape):
        members, _ = bodies(
            {"shape": shape, "mass": 1.0, "inertia": (1e-4,) * 3},
            {"shape": jaxrod.shapes.sphere((0.5, 0, 0), 0.2), "mass": 1.0},
        )
        contact = jaxrod.systems.rigid_contact(
            *members, stiffness=1e-9, friction=0.5, friction_drag=1.0
        )
        return float(jaxrod.stable_dt(jaxrod.make_system(members, contact)).dt)

    own, known = OwnBall(jnp.float64(0.3)), jaxrod.shapes.sphere((0, 0, 0), 0.3)
    assert step(own) == pytest.approx(step(known), rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_bounds_of_couplings_are_safe_and_not_far_off(name, record):
    compared(name, *CASES[name], record)


def test_the_step_of_a_system_with_a_free_body_has_a_gradient():
    """Nothing limits the step of a body on which nothing acts."""
    scenes, _ = rods((0.0, 0.0, 0.0))
    ball, _ = jaxrod.systems.rigid_body(
        jaxrod.shapes.sphere((0.0, 0.0, 1.0), 0.05), density=100.0, dtype=jnp.float64
    )
    system = jaxrod.make_system(scenes | {"ball": ball})

    def step(system):
        return jaxrod.stable_dt(system).dt

    for leaf in jax.tree.leaves(jax.grad(step, allow_int=True)(system)):
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            assert jnp.all(jnp.isfinite(leaf))


@jaxrod.extend.pytree
class Tethers(jaxrod.extend.Coupling):
    """Bounds of springs: one number for all nodes of a member, or one for each."""

    stiffness: jax.Array

    def stability_bounds(self, parts):
        return {"ropes": jaxrod.extend.StabilityBound(nodes=self.stiffness)}


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("count", [1, 3])
def test_one_bound_for_all_nodes_is_that_of_each(count):
    made = [rod(N, 0.3, (0.0, 0.2 * k, 0.0))[0] for k in range(count)]
    ropes = jax.tree.map(lambda *rods: jnp.stack(rods), *made)
    scenes = jax.vmap(jaxrod.make_scene)(ropes)
    steps = [
        jaxrod.stable_dt(jaxrod.make_system({"ropes": scenes}, Tethers(stiffness))).dt
        for stiffness in (jnp.float64(1e8), jnp.full(count * (N + 1), 1e8))
    ]
    assert steps[0] == pytest.approx(float(steps[1]), rel=1e-12)


def test_slip_counts_in_the_sum_of_bounds():
    """Bounds that are added allow no longer step than the dashpots of both."""
    slip = StabilityBound(slip_drag=jnp.float64(2.0), slip_couple=jnp.float64(3.0))
    even = jnp.float64(1.0)
    for total in (added_bounds(slip, slip), added_bounds(slip, StabilityBound())):
        assert total.drags(even, even)[0] >= 4.0
        assert total.drags(even, even)[1] >= 6.0
    dragged = StabilityBound(node_drag=jnp.float64(4.0))
    assert added_bounds(slip, dragged).drags(even, even)[0] >= 8.0
    alone = StabilityBound(slip_drag=jnp.float64(2.0))
    assert alone.drags(even, even)[0] >= 4.0


@jaxrod.extend.pytree
class Anchor(jaxrod.extend.Effect):
    """A spring from the centre of a body to the origin."""

    stiffness: jax.Array

    def loads(self, bodies, motion):
        return jaxrod.extend.Loads(tuple(-self.stiffness * x for x in motion.position))

    def stability_bound(self, bodies):
        return jaxrod.extend.StabilityBound(nodes=self.stiffness)


def test_effects_on_bodies_have_bounds():
    """A body on springs, one of them a schedule: the step is that of an oscillator."""
    body, _ = jaxrod.systems.rigid_body(
        mass=2.0,
        inertia=(1.0, 1.0, 1.0),
        effects=(
            Anchor(jnp.float64(300.0)),
            Anchor(jaxrod.schedules.ramp(0.0, jnp.float64(500.0), 1.0)),
        ),
        dtype=jnp.float64,
    )
    found = jaxrod.stable_dt(jaxrod.make_system({"body": body}), 1.0)
    assert float(found.dt) == pytest.approx(2 * (2.0 / 800.0) ** 0.5, rel=1e-12)
    assert found.limiting_mode == "what acts on 'body'"


@pytest.mark.parametrize("speed", [0.005, 0.05, 0.5])
def test_a_dashpot_that_sets_in_needs_no_smaller_step(speed, record):
    """Within the onset its force grows with the depth, but never beyond the dashpot's.

    A ball comes to the ground at the bound of the step. It is within the onset for a
    hundred steps, for ten, for one. The slope of the dashpot's force by the depth is
    50, 500 and 5000 times the spring's there.
    """
    ball, state = jaxrod.systems.rigid_body(
        jaxrod.shapes.sphere((0, 0, 0.106), 0.1),
        mass=1.0,
        velocity=(0.0, 0.0, -speed),
        dtype=jnp.float64,
    )
    ground = jaxrod.systems.rigid_contact(
        "ball", fixed=jaxrod.shapes.plane(), stiffness=1.0, damping=100.0, onset=0.1
    )
    system = jaxrod.make_system({"ball": ball}, ground)
    dt = jaxrod.stable_dt(system, 1.0).dt
    states = jaxrod.rollout(system, {"ball": state}, dt, 200)
    speeds = jnp.linalg.norm(states["ball"].velocities[:, :, 0], axis=1)
    record(
        f"A ball that hits the ground with {speed:g} m/s, at the bound: largest speed "
        "over the first",
        "none is gained",
        float(jnp.max(speeds)) / speed,
        at_most=1 + 1e-9,
    )

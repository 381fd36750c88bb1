"""Two scenes of ropes in contact, by the library's default numbers.

`crossing`: two ropes of 1 m hang at a right angle, each from two pins .8 m apart. The
pins of the upper rope are .1 m lower, so its middle rests on that of the lower rope.
There is no friction. They start 1 cm too far apart and come to rest in 8 s. The
reference does not use either library. Half of each rope is a plane rod with bending,
stretch, shear and weight, under half a point load at its middle. The two-point problem
is solved by collocation to a tolerance of 1e-8. The load is the one at which the axes
are one diameter apart. Errors are the largest distance of a node from its place, over
the length, and the error of the upper rope's height in the middle, over the height by
which the other rope lifts it.

`heap`: a rope of 1.5 m hangs from a clamp, its end 2 cm above a floor. The clamp moves
down at .4 m/s until it is 15 cm above the floor; then all rests for a second. Friction
is .3 everywhere. There is no reference. Printed are the greatest overlaps of the rope
with the floor and with itself, in radii, over the run and at its end.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_bvp
from scipy.optimize import brentq

import jaxrod
from benchmarks.system_speed.run import processor, simulator, stepping

GRAVITY, DENSITY, MODULUS, DAMPING = 9.81, 1000.0, 1e6, 2.0
SPAN, LOWER, APART, SECONDS = 0.8, 0.1, 0.01, 8.0
"""Distance of the pins, drop to the second pins, gap at the start [m]; time [s]."""
LENGTH, RADIUS = 1.0, 5e-3
LONG, THIN, SPEED, END, GAP = 1.5, 2.5e-3, 0.4, 0.15, 0.02
FRICTION = 0.3
MATERIAL: dict[str, Any] = {
    "density": DENSITY,
    "youngs_modulus": MODULUS,
    "shear_modulus": MODULUS / 3,
}


class Touching(NamedTuple):
    """Both ropes in contact: half of each, as functions of arc length."""

    ropes: tuple[Any, Any]
    lifted: float
    """Height by which the middle of the second rope is lifted [m]."""


def half_rope(push: float) -> Any:
    """Half of a rope under the load `push` at its middle [N]: x, z, angle, moment."""
    area = np.pi * RADIUS**2
    bending, stretch = MODULUS * np.pi * RADIUS**4 / 4, MODULUS * area
    shear, weight = 27 / 28 * MODULUS / 3 * area, DENSITY * area * GRAVITY
    half = LENGTH / 2

    def slopes(s: np.ndarray, y: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        across, down = numbers[0], -(push / 2 + weight * (half - s))
        c, d = np.cos(y[2]), np.sin(y[2])
        along = 1 + (across * c + down * d) / stretch
        aside = (down * c - across * d) / shear
        x, z = along * c - aside * d, along * d + aside * c
        return np.stack([x, z, y[3] / bending, across * z - down * x])

    def ends(start: np.ndarray, middle: np.ndarray, _: np.ndarray) -> np.ndarray:
        return np.array([start[0], start[1], start[3], middle[0] - SPAN / 2, middle[2]])

    s = np.linspace(0, half, 200)
    guess = np.zeros((4, s.size))
    guess[0], guess[1] = 0.8 * s, -0.27 * np.sin(np.pi * s)
    guess[2] = -1 + s / half
    found = solve_bvp(slopes, ends, s, guess, [0.3], tol=1e-8, max_nodes=100_000)
    assert found.success
    return found


def touching(gap: float) -> Touching:
    """Both ropes when their axes are `gap` apart in the middle [m]."""

    def missing(push: float) -> float:
        first, second = half_rope(push), half_rope(-push)
        return float(second.y[1, -1] - LOWER - first.y[1, -1] - gap)

    push = brentq(missing, 0.1, 0.5, xtol=1e-9)
    ropes = half_rope(push), half_rope(-push)
    return Touching(ropes, float(ropes[1].y[1, -1] - half_rope(0.0).y[1, -1]))


def graded(n: int, ratio: float) -> np.ndarray:
    """Arc lengths of nodes of elements that shrink towards the middle [m].

    The longest element, at the ends, is `ratio` times the shortest.
    """
    from_middle = np.abs(np.arange(n) - 0.5 * (n - 1))
    away = (from_middle - from_middle.min()) / (from_middle.max() - from_middle.min())
    s = np.append(0, np.cumsum(ratio**away))
    return LENGTH * s / s[-1]


def nodes_of(both: Touching, s: np.ndarray) -> list[np.ndarray]:
    """Nodes of both ropes in space, at arc lengths `s` [m]."""
    found = []
    for axis, rope in enumerate(both.ropes):
        x, z = rope.sol(np.minimum(s, LENGTH - s))[:2]
        places = np.zeros((3, len(s)))
        places[axis] = np.where(s <= LENGTH / 2, x - SPAN / 2, SPAN / 2 - x)
        places[2] = z - axis * LOWER
        found.append(places)
    return found


def crossing_errors(
    nodes: list[np.ndarray], exact: Touching, s: np.ndarray
) -> tuple[float, float]:
    """Shape over length, and lift, relative [1]."""
    there = nodes_of(exact, s)
    away = [one - other for one, other in zip(nodes, there, strict=True)]
    shape = max(np.max(np.linalg.norm(each, axis=0)) for each in away)
    middle = away[1].shape[1] // 2
    return float(shape) / LENGTH, abs(float(away[1][2, middle])) / exact.lifted


def our_rope(places: np.ndarray, radius: float, s: np.ndarray) -> tuple[Any, Any]:
    """A rope that is straight at rest, and its state along `places` [m]."""
    straight = jnp.stack([jnp.asarray(s), jnp.zeros(len(s)), jnp.zeros(len(s))])
    rod, _ = jaxrod.rod_along(straight, radius=radius, **MATERIAL)
    return rod, jaxrod.rod_along(jnp.asarray(places), radius=radius, **MATERIAL)[1]


def our_crossing(s: np.ndarray, start: Touching, exact: Touching) -> tuple[Any, Any]:
    """The two ropes with nodes at arc lengths `s`, and their state, apart."""
    scenes, state, lists_at = {}, {}, {}
    for name, apart, near in zip(
        ("first", "second"), nodes_of(start, s), nodes_of(exact, s), strict=True
    ):
        rod, state[name] = our_rope(apart, RADIUS, s)
        lists_at[name] = our_rope(near, RADIUS, s)[1]
        scenes[name] = jaxrod.make_scene(
            rod,
            jaxrod.pin_support(state[name], "base"),
            jaxrod.pin_support(state[name], "tip"),
            jaxrod.gravity(),
            jaxrod.exponential_damping(DAMPING),
        )
    touch = jaxrod.systems.crossing_contact(
        "first", "second", lists=jaxrod.systems.neighbour_lists(refresh_every=16)
    )
    return jaxrod.make_system(scenes, touch, state=lists_at), state


def held() -> Any:
    """PyElastica's constraint of nodes that move in a given way, and of elements."""
    import elastica as ea

    class Held(ea.ConstraintBase):
        """Nodes at places, which move down at a speed until a time."""

        def __init__(
            self,
            *there: Any,
            nodes: Any,
            elements: Any = (),
            speed: float = 0.0,
            until: float = 0.0,
            **options: Any,
        ) -> None:
            super().__init__(**options)
            self.nodes, self.elements = list(nodes), list(elements)
            system = self._system
            self.places = system.position_collection[:, self.nodes].copy()
            self.frames = system.director_collection[..., self.elements].copy()
            self.speed, self.until = speed, until

        def constrain_values(self, system: Any, time: Any) -> None:
            """Puts the nodes where they belong."""
            system.position_collection[:, self.nodes] = self.places
            system.position_collection[2, self.nodes] -= self.speed * min(
                float(time), self.until
            )
            system.director_collection[..., self.elements] = self.frames

        def constrain_rates(self, system: Any, time: Any) -> None:
            """Gives the nodes their speed."""
            system.velocity_collection[:, self.nodes] = 0.0
            if time < self.until:
                system.velocity_collection[2, self.nodes] = -self.speed
            system.omega_collection[:, self.elements] = 0.0

    return Held


def their_rope(collection: Any, state: Any, radius: float, dt: float) -> Any:
    """PyElastica's rope, in the state of ours, with weight and damping."""
    import elastica as ea

    places = np.asarray(state.positions)
    n, length = places.shape[1] - 1, LENGTH if radius == RADIUS else LONG
    rod = ea.CosseratRod.straight_rod(
        n,
        places[:, 0],
        np.asarray([1.0, 0.0, 0.0]),
        np.asarray([0.0, 0.0, 1.0]),
        length,
        radius,
        **MATERIAL,
    )
    rod.position_collection[:] = places
    rod.director_collection[:] = np.asarray(state.directors)
    collection.append(rod)
    collection.add_forcing_to(rod).using(
        ea.GravityForces, acc_gravity=np.asarray([0.0, 0.0, -GRAVITY])
    )
    collection.dampen(rod).using(
        ea.AnalyticalLinearDamper, uniform_damping_constant=DAMPING, time_step=dt
    )
    return rod


def repeated(step: Callable[[], None], steps: int) -> None:
    """Calls a function repeatedly."""
    for _ in range(steps):
        step()


def crossing(
    sizes: tuple[int, ...],
    their_sizes: tuple[int, ...],
    ratios: tuple[float, ...] = (1.0,),
) -> None:
    """Prints the table of the ropes that cross.

    `ratios` are those of the longest to the shortest element of our ropes.
    """
    import elastica as ea

    start, exact = touching(2 * RADIUS + APART), touching(2 * RADIUS)
    print("## crossing: 8 s\n")
    print(
        "| | n | longest / shortest | step [us] | shape / L | lift | "
        "processor time [s] |"
    )
    print("|---|---:|---:|---:|---:|---:|---:|")
    for n, ratio in itertools.product(sizes, ratios):
        s = graded(n, ratio)
        system, state = our_crossing(s, start, exact)
        dt = float(jaxrod.stable_dt(system).dt)
        steps = int(np.ceil(SECONDS / dt))
        after: dict[str, Any] = {}

        def move(
            system: Any = system,
            state: Any = state,
            dt: float = dt,
            steps: int = steps,
            after: dict[str, Any] = after,
        ) -> None:
            after.update(jaxrod.advance(system, state, dt, jnp.asarray(steps)))
            after["first"].positions.block_until_ready()

        jaxrod.advance(system, state, dt, jnp.asarray(1))
        seconds = processor(move)
        nodes = [np.asarray(after[name].positions) for name in ("first", "second")]
        assert not after["neighbours"].overflow and not after["neighbours"].stale
        shape, lift = crossing_errors(nodes, exact, s)
        print(
            f"| jaxrod | {n} | {ratio:g} | {1e6 * dt:.1f} | {shape:.2e} | {lift:.2e} | "
            f"{seconds:.2f} |",
            flush=True,
        )
    for n in their_sizes:
        s = graded(n, 1.0)
        _, state = our_crossing(s, start, exact)
        dt, rods = 1e-4, []
        collection = simulator("Constraints", "Forcing", "Damping", "Contact")
        for name in ("first", "second"):
            rods.append(their_rope(collection, state[name], RADIUS, dt))
            collection.constrain(rods[-1]).using(
                held(), nodes=(0, n), constrained_position_idx=(0, -1)
            )
        collection.detect_contact_between(*rods).using(ea.RodRodContact, k=1e4, nu=0.5)
        step = stepping(collection, dt)
        step()
        seconds = processor(functools.partial(repeated, step, round(SECONDS / dt)))
        nodes = [rod.position_collection for rod in rods]
        shape, lift = crossing_errors(nodes, exact, s)
        print(
            f"| PyElastica | {n} | 1 | {1e6 * dt:.1f} | {shape:.2e} | {lift:.2e} | "
            f"{seconds:.2f} |",
            flush=True,
        )


def our_heap(n: int, stiffness: float | None) -> tuple[Any, Any, float]:
    """The rope over the floor, its state, and the time at which the clamp stops [s].

    `stiffness` is that of the floor [N/m^2]; `None` for the default.
    """
    s = np.linspace(0, LONG, n + 1)
    stretched = s + DENSITY * GRAVITY * (LONG * s - s * s / 2) / MODULUS
    top = GAP + THIN + stretched[-1]
    bow = 1e-3 * LONG
    places = np.stack(
        [
            bow * np.sin(np.pi * s / LONG) ** 2,
            0.5 * bow * s / LONG * np.sin(2 * np.pi * s / LONG),
            top - stretched,
        ]
    )
    rod, state = our_rope(places, THIN, s)
    until = (top - END) / SPEED
    down = jaxrod.schedules.ramp((0.0, 0.0, 0.0), (0.0, 0.0, END - top), until)
    mass = DENSITY * np.pi * THIN**2
    given: dict[str, Any] = {}
    if stiffness is not None:
        slow = float(np.sqrt(stiffness * mass))
        given = {"stiffness": stiffness, "damping": slow, "friction_drag": slow / 4}
    floor = jaxrod.contact(jaxrod.shapes.plane(), friction=FRICTION, **given)
    scene = jaxrod.make_scene(
        rod,
        jaxrod.driven(state, "base", displacement=down),
        jaxrod.gravity(),
        jaxrod.exponential_damping(DAMPING),
        floor,
    )
    itself = jaxrod.systems.rod_contact(
        "rope",
        self_contact=True,
        friction=FRICTION,
        lists=jaxrod.systems.neighbour_lists(
            refresh_every=8, pairs=20 * n, candidates=40 * n, cell_slots=0
        ),
    )
    system = jaxrod.make_system({"rope": scene}, itself, state={"rope": state})
    return system, {"rope": state}, until


def overlaps(nodes: np.ndarray) -> np.ndarray:
    """Overlap of the rope with the floor and with itself, in radii; negative for gaps.

    Places an eighth of an element apart are tested against all elements that are more
    than an element and pi radii away along the rope.
    """
    n = nodes.shape[1] - 1
    each, parts = LONG / n, np.arange(8) / 8
    first, edges = nodes[:, :-1], np.diff(nodes)
    points = (first[:, :, None] + edges[:, :, None] * parts).reshape(3, -1)
    along = (np.arange(n)[:, None] + parts).ravel() * each
    begins = np.arange(n) * each
    away = points[:, :, None] - first[:, None]
    share = np.sum(away * edges[:, None], axis=0) / np.sum(edges**2, axis=0)
    away = away - np.clip(share, 0, 1) * edges[:, None]
    gap = np.maximum(begins - along[:, None], along[:, None] - begins - each)
    distance = np.linalg.norm(away, axis=0)[gap > each + np.pi * THIN]
    return np.asarray([THIN - np.min(nodes[2]), 2 * THIN - np.min(distance)]) / THIN


def heap(n: int, their_share: float, floors: tuple[float, ...] = (1.5e7,)) -> None:
    """Prints the table of the heap.

    `floors` are stiffnesses of the floor, next to the default one [N/m^2].
    """
    import elastica as ea

    print(f"## heap: n = {n}, overlaps with the floor; with itself [radii]\n")
    print("| | step [us] | floor: greatest; last | itself | processor time [s] |")
    print("|---|---:|---:|---:|---:|")
    for stiffness in (None, *floors):
        system, state, until = our_heap(n, stiffness)
        floor = float(system.members["rope"].effects[-1].stiffness)
        label = f"jaxrod, floor of {floor:.2g} N/m^2"
        dt = float(jaxrod.stable_dt(system).dt)
        looks, every = 400, int(np.ceil((until + 1) / dt / 400))
        paths: list[np.ndarray] = []

        def move(
            system: Any = system,
            now: Any = state,
            dt: float = dt,
            every: int = every,
            paths: list[np.ndarray] = paths,
            looks: int = looks,
        ) -> None:
            for k in range(looks):
                first = jnp.asarray(k * every)
                now = jaxrod.advance(system, now, dt, jnp.asarray(every), first=first)
                paths.append(np.asarray(now["rope"].positions))
            record = now["neighbours"]
            assert not record.overflow and not record.stale

        jaxrod.advance(system, state, dt, jnp.asarray(1), first=jnp.asarray(0))
        seconds = processor(move)
        found = np.asarray([overlaps(nodes) for nodes in paths])
        most, last = np.max(found, axis=0), found[-1]
        print(
            f"| {label} | {1e6 * dt:.1f} | {most[0]:.4f}; {last[0]:.4f} | "
            f"{most[1]:.4f}; {last[1]:.4f} | {seconds:.1f} |",
            flush=True,
        )
    system, state, until = our_heap(n, None)
    dt = 5e-5
    collection = simulator("Constraints", "Forcing", "Damping", "Contact")
    rod = their_rope(collection, state["rope"], THIN, dt)
    collection.constrain(rod).using(
        held(),
        nodes=(0,),
        elements=(0,),
        speed=SPEED,
        until=until,
        constrained_position_idx=(0,),
        constrained_director_idx=(0,),
    )
    floor = ea.Plane(np.zeros(3), np.asarray([0.0, 0.0, 1.0]))
    collection.append(floor)
    # Theirs is per element: the numbers of our default, times the length of one.
    k = float(system.couplings[0].stiffness) * LONG / n
    nu = float(system.couplings[0].damping) * LONG / n
    collection.detect_contact_between(rod, floor).using(
        ea.RodPlaneContactWithAnisotropicFriction,
        k=k,
        nu=nu,
        slip_velocity_tol=1e-3,
        static_mu_array=np.full(3, FRICTION),
        kinetic_mu_array=np.full(3, FRICTION),
    )
    collection.detect_contact_between(rod, rod).using(ea.RodSelfContact, k=k, nu=nu)
    step = stepping(collection, dt)
    step()
    all_steps = (until + 1) / dt
    steps, their_paths = int(their_share * all_steps / 20), []

    def move_theirs() -> None:
        for _ in range(20):
            repeated(step, steps)
            their_paths.append(rod.position_collection.copy())

    seconds = processor(move_theirs) * all_steps / (20 * steps)
    found = np.asarray([overlaps(nodes) for nodes in their_paths])
    most, last = np.max(found, axis=0), found[-1]
    what = "" if their_share == 1 else f", cost from {their_share:.0%} of the run"
    print(
        f"| PyElastica{what} | {1e6 * dt:.1f} | {most[0]:.4f}; {last[0]:.4f} | "
        f"{most[1]:.4f}; {last[1]:.4f} | {seconds:.1f} |",
        flush=True,
    )

"""Random systems of rods and bodies with couplings of all kinds, in any view."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

import jaxrod
from extremes.pair_scenes import material, rod_in
from extremes.pair_system_kinds import Kind
from extremes.views import Draws, View, draws_of

SIZE = 0.03
"""Sizes of bodies [m]."""
ROOM = {"pairs": 400, "candidates": 400, "cell_slots": 0}
"""Room of lists of neighbours for all there may be: the same program in every view."""


def unit(random: np.random.Generator) -> np.ndarray:
    """A direction, all alike likely."""
    vector = random.normal(size=3)
    return vector / np.linalg.norm(vector)


class Maker:
    """Makes a system in a view, drawing the same numbers in every view."""

    def __init__(self, view: View, kind: Kind, draws: Draws):
        self.view, self.kind, self.draws = view, kind, draws
        self.plain = replace(view, reversed=False)
        self.choices, self.random = draws
        count = len(kind.members)
        ranks = view.order(list(range(count)))
        self.names = [
            f"m{ranks[k]}{k}" if view.shuffled else f"m{k}" for k in range(count)
        ]
        self.lines: list[Any] = []
        """Start, direction and length of each member [m]."""
        self.towards: list[np.ndarray] = []
        """Velocity of each, towards what it is beside [m/s]."""
        self.joint_at: list[np.ndarray] = []
        self._place()
        self.members: dict[str, Any] = {}
        self.rest: dict[str, Any] = {}
        self.moving: dict[str, Any] = {}
        for k in range(count):
            self._member(k)

    def view_of(self, k: int) -> View:
        """The view of a member."""
        return self.view if k == 0 else self.plain

    def _place(self) -> None:
        random, kind = self.random, self.kind
        self.radii = [random.uniform(0.01, 0.015) for _ in kind.members]
        self.lines.append((np.zeros(3), unit(random), random.uniform(0.3, 0.6)))
        self.towards.append(np.zeros(3))
        for k, (how, parent, node) in enumerate(kind.relations, 1):
            start, way, length = self.lines[parent]
            is_rod = isinstance(kind.members[k], int)
            own = unit(random)
            own_length = random.uniform(0.3, 0.6) if is_rod else SIZE
            shift, gap = random.uniform(0.3, 0.7), random.uniform(1e-4, 6e-4)
            at = start + length * node / kind.members[parent] * way
            self.joint_at.append(at)
            across = np.cross(way, own)
            across /= np.linalg.norm(across)
            speed = random.uniform(1, 2)
            if how == "glue":
                own, own_length = way, length
                begin = start + (self.radii[parent] + self.radii[k] + gap) * across
                towards = np.zeros(3)
            elif how == "beside":
                spot = start + length * (node - 0.37) / kind.members[parent] * way
                if is_rod:
                    far = self.radii[parent] + self.radii[k] + gap
                    begin = spot + far * across - shift * own_length * own
                else:
                    # By its corner or its flank: near enough to be hit.
                    own = across
                    begin = spot + (self.radii[parent] + gap + 0.2 * SIZE) * across
                towards = -speed * across
            else:
                begin, towards = at, np.zeros(3)
            self.lines.append((begin, own, own_length))
            self.towards.append(towards)

    def _member(self, k: int) -> None:
        kind, random, view = self.kind, self.random, self.view_of(k)
        name, (start, way, length) = self.names[k], self.lines[k]
        size = 10 ** random.uniform(-1, 1)
        effects: list[Any] = []
        loss = kind.losses[k]
        damping = lambda: jaxrod.exponential_damping(view.number(size, "s^-1"))
        if isinstance(kind.members[k], int):
            n = kind.members[k]
            speeds, spins = (
                random.normal(size=(2, 3, 1)) * 0.3,
                random.normal(size=(3, 1)),
            )
            turned = random.normal(size=3)
            rod_number = sum(isinstance(m, int) for m in kind.members[:k])
            section = kind.sections[rod_number]
            given = material(self.draws, view, section, n)
            if section == "round":
                given["radius"] = view.number(self.radii[k], "m")
            nodes = start[:, None] + length * way[:, None] * np.linspace(0, 1, n + 1)
            rod, state = rod_in(view, nodes, turned, True, given)
            if k == 0 and kind.held == "clamp":
                effects.append(
                    jaxrod.clamp(state, view.end("base"))
                    if kind.method == "consistent"
                    else jaxrod.fixed_end(state, view.end("base"))
                )
            if k == 0 and kind.held == "pin":
                effects.append(jaxrod.pin_support(state, view.node(0, n)))
            losses: dict[str, Callable[[], list[Any]]] = {
                "none": lambda: [],
                "damping": lambda: [damping()],
                "stokes": lambda: [
                    jaxrod.fluids.stokes_drag(
                        view.number(0.3 * size, "N s m^-2"),
                        view.number(size, "N s m^-2"),
                        view.number(1e-4 * size, "N s"),
                    )
                ],
                "internal": lambda: [
                    jaxrod.internal_damping(view.number(1e-3 * size, "s"))
                ],
            }
            effects += losses[loss]() + self._gravity()
            made = {"consistent": jaxrod.consistent, "pyelastica": jaxrod.pyelastica}
            self.members[name] = jaxrod.make_scene(
                rod, *view.order(effects), method=made[kind.method]()
            )
            s = np.linspace(0, 2, n + 1)[None]
            moves = speeds[0] * np.sin(s) + speeds[1] * np.cos(s)
            moves = moves + self.towards[k][:, None]
            world = view.vector(spins * np.ones((1, n)), "s^-1")
            own = np.einsum("ijn,jn->in", np.asarray(state.directors), world)
            state = jaxrod.with_angular_velocities(rod, state, own)
            speeds_seen = view.along(view.vector(moves, "m s^-1"))
            self.rest[name] = replace(
                state, angular_momenta=jnp.zeros_like(state.angular_momenta)
            )
            self.moving[name] = replace(state, velocities=jnp.asarray(speeds_seen))
            return
        if loss == "damping":
            effects.append(damping())
        effects += self._gravity()
        before = random.bit_generator.state
        _, first = jaxrod.systems.rigid_body(
            self._shape(View(), kind.members[k], start, way), density=1.0
        )
        random.bit_generator.state = before
        # What is round has its own axes anywhere: they are to be the same ones.
        self.members[name], self.moving[name] = jaxrod.systems.rigid_body(
            self._shape(view, kind.members[k], start, way),
            orientation=view.quaternion(first.orientations[:, 0]),
            density=view.number(10 ** random.uniform(2.5, 3.5), "kg m^-3"),
            effects=tuple(view.order(effects)),
            velocity=view.vector(
                0.2 * random.normal(size=3) + self.towards[k], "m s^-1"
            ),
            angular_velocity=view.vector(3 * random.normal(size=3), "s^-1"),
        )
        self.rest[name] = self.moving[name]

    def _gravity(self) -> list[Any]:
        g = self.view.vector((0.0, 3.0, -9.0), "m s^-2")
        return [jaxrod.gravity(g)] if self.kind.falls else []

    def _shape(self, view: View, kind: str, start: np.ndarray, way: np.ndarray) -> Any:
        random = self.random
        quaternion = random.normal(size=4)
        quaternion /= np.linalg.norm(quaternion)
        side = unit(random)
        centre = start + 0.8 * SIZE * way
        m = lambda x: view.number(x, "m")
        if kind == "sphere":
            return jaxrod.shapes.sphere(view.place(centre), m(0.8 * SIZE))
        if kind == "box":
            sides = m(np.array([0.9, 0.7, 0.5]) * SIZE)
            return jaxrod.shapes.box(
                view.place(centre), sides, view.quaternion(quaternion)
            )
        make = jaxrod.shapes.capsule if kind == "capsule" else jaxrod.shapes.cylinder
        ends = [view.place(centre + sign * 0.5 * SIZE * side) for sign in (-1, 1)]
        return make(*ends, m(0.7 * SIZE))

    def couplings(self) -> list[Any]:
        """All couplings, in the view's order."""
        drawn = [self._joint(k) for k in range(1, len(self.kind.members))]
        drawn += [self._rods(), self._bodies(), self._rigid(), self._pose()]
        made = []
        for make, can_be_halved in drawn:
            halves = 2 if self.view.halved and can_be_halved else 1
            made += [make(1 / halves) for _ in range(halves)]
        return self.view.order([m for m in made if m != ()])

    def _touch(self, power: float, size: float, unit: str) -> Callable[[float], Any]:
        """Numbers of a contact, by share; a unit is what a spring has."""
        view, random = self.view, self.random
        stiff, drag = size * random.uniform(0.5, 2), 10 ** random.uniform(-1, power)
        friction = random.uniform(0.1, 1)
        slow = "N s m^-2" if unit == "N m^-2" else "N s m^-1"

        def numbers(share: float) -> dict[str, Any]:
            own = {"stiffness": view.number(share * stiff, unit)}
            if self.kind.rubs:
                own["damping"] = view.number(share * drag, slow)
                own["friction"] = friction
            return own

        return numbers

    def _rods(self) -> tuple[Callable[[float], Any], bool]:
        kind = self.kind
        across, beside = self._touch(0, 3e3, "N m^-1"), self._touch(0.5, 1e5, "N m^-2")
        rods = [
            name
            for name, member in zip(self.names, kind.members, strict=True)
            if isinstance(member, int)
        ]
        # Programs grow with the pairs of members: with many, contact stays as it is.
        few = len(rods) == 2
        rods = self.view.order(rods + ["far"] * (self.view.crowded and few))
        lists = jaxrod.systems.neighbour_lists(refresh_every=8, skin=1.0, **ROOM)
        listed = {"lists": lists if kind.contact.endswith("lists") else None}

        def make(share: float) -> Any:
            if kind.contact == "none":
                return ()
            if kind.contact.startswith("rods"):
                more = {**beside(share), "points_per_element": 4, **listed}
                return jaxrod.systems.rod_contact(*rods, **more)
            return jaxrod.systems.crossing_contact(*rods, **across(share), **listed)

        return make, few

    def _bodies(self) -> tuple[Callable[[float], Any], bool]:
        touch = self._touch(0.5, 5e4, "N m^-2")

        def make(share: float) -> Any:
            return [
                jaxrod.systems.body_contact(
                    self.names[relation[1]],
                    self.names[k],
                    points_per_element=4,
                    **touch(share),
                )
                for k, relation in enumerate(self.kind.relations, 1)
                if relation[0] == "beside" and isinstance(self.kind.members[k], str)
            ]

        return make, True

    def _rigid(self) -> tuple[Callable[[float], Any], bool]:
        view, random = self.view, self.random
        touch = self._touch(0, 3e3, "N m^-1")
        way, bodies = unit(random), []
        for k, member in enumerate(self.kind.members):
            if isinstance(member, str):
                bodies.append((k, self.names[k]))
        fixed: Any = ()
        if self.kind.rigid == "ground" and bodies:
            start, towards, _ = self.lines[bodies[0][0]]
            point = start + 0.8 * SIZE * towards + 0.9 * SIZE * way
            fixed = (jaxrod.shapes.plane(view.place(point), -view.vector(way)),)

        def make(share: float) -> Any:
            if self.kind.rigid == "none" or len(bodies) + len(fixed) < 2:
                return ()
            names = view.order([name for _, name in bodies])
            return jaxrod.systems.rigid_contact(*names, fixed=fixed, **touch(share))

        return make, True

    def _pose(self) -> tuple[Callable[[float], Any], bool]:
        view, random, kind = self.view, self.random, self.kind
        k = int(self.choices.integers(len(kind.members)))
        axis, path = unit(random), 0.02 * unit(random)
        seen, member = self.view_of(k), kind.members[k]
        place = (self.names[k],)
        if isinstance(member, int):
            place += (seen.node(member, member),)
        move = view.vector(path, "m")

        def make(share: float) -> Any:
            if not kind.posed:
                return ()
            return jaxrod.systems.pose_spring(
                place,
                self.rest,
                stiffness=view.number(share * 100, "N m^-1"),
                damping=view.number(share * 0.1, "N s m^-1"),
                turning_stiffness=view.number(share * 0.5, "N m"),
                turning_damping=view.number(share * 1e-5, "N m s"),
                displacement=jaxrod.schedules.ramp(
                    0 * move, move, view.number(0.02, "s")
                ),
                axis=view.vector(axis),
                angle=0.1,
            )

        return make, True

    def _joint(self, k: int) -> tuple[Callable[[float], Any], bool]:
        kind, random, view = self.kind, self.random, self.view
        how, parent, node = kind.relations[k - 1]
        stiff = 10 ** random.uniform(2, 3)
        turn = 10 ** random.uniform(-1, 0.5)
        axis, arm, motor = unit(random), 0.02 * unit(random), 0.01 * random.normal()
        is_rod = isinstance(kind.members[k], int)
        n = kind.members[parent]
        seen = self.view_of(parent)
        at = view.place(self.joint_at[k - 1])
        rest = self.rest
        a: Any = (self.names[parent], seen.node(node, n))
        b: Any = (self.names[k], "base") if is_rod else (self.names[k],)
        ends = at, view.place(self.joint_at[k - 1] + arm)
        sign = 1.0
        if view.exchanged and not how.startswith("attach"):
            a, b, ends, sign = b, a, ends[::-1], -1.0

        def make(share: float) -> Any:
            force = lambda x, unit: view.number(share * x, unit)
            spring = {
                "stiffness": force(stiff, "N m^-1"),
                "damping": force(0.02 * stiff**0.5, "N s m^-1"),
            }
            kinds: dict[str, Callable[[], Any]] = {
                "beside": lambda: (),
                "glue": lambda: self._glue(k, share, stiff, turn),
                "tie": lambda: jaxrod.systems.tie(a, b, rest),
                "weld": lambda: jaxrod.systems.weld(a, b, rest),
                "attach": lambda: jaxrod.systems.attach(a, b, rest),
                "attach turning": lambda: jaxrod.systems.attach(
                    a, b, rest, turning=True
                ),
                "ball": lambda: jaxrod.systems.ball_joint(a, b, rest, at=at, **spring),
                "spring": lambda: jaxrod.systems.spring(a, b, rest, at=ends, **spring),
                "hinge": lambda: jaxrod.systems.hinge_joint(
                    a,
                    b,
                    rest,
                    axis=view.vector(axis),
                    axis_stiffness=force(turn, "N m"),
                    axis_damping=force(1e-5 * turn, "N m s"),
                    motor=force(sign * motor, "N m"),
                    at=at,
                    **spring,
                ),
                "rigid": lambda: jaxrod.systems.fixed_joint(
                    a,
                    b,
                    rest,
                    turning_stiffness=force(turn, "N m"),
                    turning_damping=force(1e-5 * turn, "N m s"),
                    at=at,
                    **spring,
                ),
            }
            return kinds[how]()

        return make, how not in ("tie", "weld", "attach", "attach turning")

    def _glue(self, k: int, share: float, stiff: float, turn: float) -> Any:
        view, parent = self.view, self.kind.relations[k - 1][1]
        n = self.kind.members[k]
        numbers = list(range(n))
        pairs = (numbers[::-1] if parent == 0 and view.reversed else numbers, numbers)
        a, b = self.names[parent], self.names[k]
        if view.exchanged:
            a, b, pairs = b, a, pairs[::-1]
        return jaxrod.systems.glue(
            a,
            b,
            self.rest,
            stiffness=view.number(share * 10 * stiff, "N m^-2"),
            damping=view.number(share * 0.1, "N s m^-2"),
            turning_stiffness=view.number(share * turn, "N"),
            turning_damping=view.number(share * 1e-5 * turn, "N s"),
            elements=pairs,
        )


def system_in(view: View, kind: Kind, seed: int, draw: int = 0) -> Any:
    """A system of a kind in a view, its state, and the names of its members."""
    maker = Maker(view, kind, draws_of(seed, draw))
    members, rest, moving = maker.members, maker.rest, maker.moving
    couplings = maker.couplings()
    if view.crowded:
        # So heavy and soft that it never limits the step.
        start = view.place(np.array([40.0, 25.0, -30.0]))
        rod, state = jaxrod.straight_rod(
            3,
            length=view.number(1.5, "m"),
            radius=view.number(0.02, "m"),
            density=view.number(1e5, "kg m^-3"),
            youngs_modulus=view.number(1e4, "Pa"),
            start=start,
        )
        members["far"], rest["far"], moving["far"] = (
            jaxrod.make_scene(rod),
            state,
            state,
        )
    given = list(members) if view.shuffled is None else view.order(list(members))
    members = {name: members[name] for name in given}
    system = jaxrod.make_system(members, *couplings, state=rest)
    return system, moving, {f"m{k}": name for k, name in enumerate(maker.names)}

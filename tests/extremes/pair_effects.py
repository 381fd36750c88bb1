"""Supports and effects of random scenes, made from the same numbers in any view."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

import jaxrod
from extremes.pair_kinds import DISSIPATING, DRAGS, Kind
from extremes.views import Draws, View


def flow_at(point: Any, parameters: Any) -> Any:
    """A flow that changes in proportion to the place."""
    velocity, gradient, centre = parameters
    return velocity + jnp.sum(gradient * (point - centre)[None, :], axis=1)


class Maker:
    """Makes the effects of a scene in a view, of the same numbers in every view.

    `choices` draws what is static in the scene, `random` its numbers.
    """

    def __init__(self, draws: Draws, view: View, kind: Kind, rod: Any, state: Any):
        self.choices, self.random = draws
        self.view, self.kind = view, kind
        self.rod, self.state, self.n = rod, state, rod.n_elements
        self.weight = 1.0
        # In SI units whatever the view, so that strengths fit the rod.
        self.stretch = float(rod.shear_stretch_stiffness[2].min() / view._size("N"))
        self.bend = float(rod.bend_twist_stiffness[:2].min() / view._size("N m^2"))
        self.radius = float(rod.radii.min() / view._size("m"))
        self.length = float(rod.length / view._size("m"))
        mass = float(rod.node_masses.sum() / view._size("kg"))
        self.density = mass / self.length

    def uniform(self, a: float, b: float, size: Any = None) -> Any:
        """Evenly distributed numbers."""
        return self.random.uniform(a, b, size)

    def vector(self, size: float, *, couple: bool = False) -> np.ndarray:
        """A vector, in the plane if there is one; a couple across it."""
        drawn = self.random.normal(size=3) * size
        if self.kind.flat:
            drawn *= [0, 0, 1] if couple else [1, 1, 0]
        if self.kind.method == "torsion free" and couple:
            drawn *= 0
        return drawn

    def timed(self, value: Any, first: Any = None) -> Any:
        """A number of the view or, where there are schedules, one of several."""
        which, period = self.choices.integers(4), self.uniform(0.01, 0.1)
        period = self.view.number(period, "s")
        if not self.kind.schedules or which == 0:
            return value
        low = 0.5 * value if first is None else first
        if which == 1:
            return jaxrod.schedules.ramp(low, value, period)
        if which == 2:
            return jaxrod.schedules.sine(
                0.4 * value, period, mean=0.6 * value, phase=0.2
            )
        times = period * np.array([0.0, 0.3, 0.5, 1.0])
        return jaxrod.schedules.table(times, np.stack([low, value, 0.7 * value, value]))

    def support(self) -> list[Any]:
        """Supports of the rod."""
        view, end = (
            self.view,
            self.view.end(str(self.choices.choice(("base", "tip")))),
        )
        node = view.node(int(self.choices.integers(0, self.n + 1)), self.n)
        axis = self.random.normal(size=3) * ([0, 0, 1] if self.kind.flat else 1)
        path, angle = view.vector(self.vector(0.02), "m"), self.uniform(-0.3, 0.3)
        ramp = lambda last: jaxrod.schedules.ramp(
            0 * last, last, view.number(0.03, "s")
        )
        kinds: dict[str, Callable[[], list[Any]]] = {
            "none": lambda: [],
            "clamp": lambda: [jaxrod.clamp(self.state, end)],
            "fixed end": lambda: [jaxrod.fixed_end(self.state, end)],
            "pin": lambda: [jaxrod.pin_support(self.state, node)],
            "hinge": lambda: [jaxrod.hinge_support(self.state, view.vector(axis), end)],
            "driven": lambda: [
                jaxrod.driven(
                    self.state,
                    end,
                    displacement=ramp(path),
                    axes="xy" if self.kind.flat else "xyz",
                    axis=view.vector(axis),
                    angle=ramp(np.array(angle)),
                    holds_element=self.kind.method.endswith("pyelastica"),
                )
            ],
            "two clamps": lambda: [
                jaxrod.clamp(self.state, e) for e in ("base", "tip")
            ],
        }
        return kinds[self.kind.support]()

    def flow(self) -> Any:
        """A flow, in the fluids that flow."""
        view = self.view
        velocity, place = self.vector(0.3), self.vector(0.1)
        gradient = self.random.normal(size=(3, 3))
        if self.kind.flat:
            gradient[2], gradient[:, 2] = 0.0, 0.0
        if self.kind.flow == "none":
            return None
        if self.kind.flow == "even":
            return self.timed(view.vector(velocity, "m s^-1"))
        turned = view.turn @ gradient @ view.turn.T
        return jaxrod.fluids.flow_field(
            flow_at,
            (
                self.timed(view.vector(velocity, "m s^-1")),
                view.number(turned, "s^-1"),
                view.place(place),
            ),
        )

    def effects(self) -> list[list[Any]]:
        """Effects, those that can be halved in halves."""
        made = []
        for name in self.kind.effects:
            draws = self.choices.bit_generator, self.random.bit_generator
            before = [generator.state for generator in draws]
            halves = 2 if self.view.halved and name in HALVED else 1
            own = []
            for _ in range(halves):
                for generator, state in zip(draws, before, strict=True):
                    generator.state = state
                self.weight = 1 / halves
                own.append(MAKERS[name](self))
            made += own
        return made


def _contact(self: Maker, many: int = 0, *, sticks: bool = False) -> Any:
    view = self.view
    nodes = np.asarray(self.state.positions) / view._size("m") - view.shift[:, None]
    nodes = view.turn.T @ view.along(nodes)
    balls = []
    shape = str(self.choices.choice(("sphere", "capsule", "cylinder", "box", "plane")))
    stiffness = self.uniform(0.5, 2) * 3e4
    for _ in range(many or 1):
        node = nodes[:, self.random.integers(self.n + 1)]
        way, along = self.vector(1.0), self.vector(0.05)
        way /= np.linalg.norm(way)
        r = 0.05
        centre = node + (r + self.radius - self.uniform(-0.001, 0.0015)) * way
        quaternion = self.random.normal(size=4)
        if self.kind.flat:
            quaternion *= [1, 0, 0, 1]
        quaternion /= np.linalg.norm(quaternion)
        if many or shape == "sphere":
            balls.append(jaxrod.shapes.sphere(view.place(centre), view.number(r, "m")))
        elif shape in ("capsule", "cylinder"):
            make = (
                jaxrod.shapes.capsule if shape == "capsule" else jaxrod.shapes.cylinder
            )
            if self.kind.flat:
                along = np.array([0.0, 0.0, 0.08])
            ends = view.place(centre - along), view.place(centre + along)
            balls.append(make(*ends, view.number(r, "m")))
        elif shape == "box":
            sides = view.number((r, 0.8 * r, 0.9 * r), "m")
            balls.append(
                jaxrod.shapes.box(
                    view.place(centre), sides, view.quaternion(quaternion)
                )
            )
        else:
            balls.append(
                jaxrod.shapes.plane(view.place(centre - r * way), -view.vector(way))
            )
    per_length = self.weight * stiffness
    return jaxrod.contact(
        balls,
        stiffness=view.number(per_length, "N m^-2"),
        damping=view.number(self.weight * self.uniform(0.5, 5), "N s m^-2"),
        friction=self.uniform(0.1, 0.8) * (self.kind.method != "torsion free"),
        points_per_element=2,
        stick_ratio=1.0 if sticks else self.uniform(1, 2),
    )


def _near(self: Maker) -> Any:
    touch = _contact(self, 3)
    return jaxrod.near_contact(touch, self.rod, self.state, 2)


def _sticking(self: Maker) -> Any:
    """Contact with one shape that the rod touches or nearly touches, with static
    friction."""
    touch = _contact(self, sticks=True)
    return jaxrod.sticking_contact(touch, self.rod, self.state)


def _moving(self: Maker, many: int = 0, *, sticks: bool = False) -> Any:
    """Contact with bodies that move and turn about a point near them."""
    view, kind = self.view, self.kind
    touch = _sticking(self) if sticks else _contact(self, many)
    way, axis = self.vector(0.02), self.random.normal(size=3)
    if kind.flat:
        axis *= [0, 0, 1]
    about, angle = self.vector(0.2), self.uniform(-0.5, 0.5)
    period = view.number(self.uniform(0.02, 0.1), "s")
    # From zero on: where the bodies are at first is where the rod touches them.
    start = lambda value: jaxrod.schedules.sine(value, period, mean=value, phase=-0.25)
    return jaxrod.moving_contact(
        touch,
        displacement=start(view.vector(way, "m")),
        axis=view.vector(axis),
        angle=start(np.array(angle)),
        about=view.place(about),
    )


def _muscle(self: Maker, **more: Any) -> Any:
    view = self.view
    offsets = self.uniform(-1, 1, (2, 2)) * self.radius
    shares = self.uniform(0.2, 1.0, 2)
    activation = self.timed(shares[0] if more.get("across") else shares)
    pull = view.number(0.1 * self.weight * self.stretch, "N")
    curves = (
        jaxrod.actuation.cubic_force,
        jaxrod.actuation.gaussian_force,
        jaxrod.actuation.constant_force,
    )
    shape = curves[self.choices.integers(3)]()
    return jaxrod.actuation.muscle(
        self.rod,
        pull,
        activation,
        **{"offsets": view.offsets(offsets), "curve": shape, **more},
    )


def _helical(self: Maker) -> Any:
    radius = self.view.number(0.7 * self.radius, "m")
    turns = self.uniform(-1, 1)
    return _muscle(
        self,
        offsets=jaxrod.actuation.helical_offsets(self.rod, radius, turns, (0.3, 2.0)),
    )


def _chamber(self: Maker) -> Any:
    view = self.view
    offsets = self.uniform(-0.5, 0.5, (2, 2)) * self.radius
    area = 0.1 * self.radius**2
    pressure = 0.1 * self.stretch / area * self.uniform(-1, 1, 2)
    return jaxrod.actuation.chamber(
        self.rod,
        self.timed(view.number(self.weight * pressure, "Pa")),
        view.number(area, "m^2"),
        offsets=view.offsets(offsets),
    )


def _wound(self: Maker) -> Any:
    view = self.view
    radius = 0.4 * self.radius
    pressure = 0.03 * self.stretch / radius**2 * self.uniform(0.3, 1)
    return jaxrod.actuation.wound_chamber(
        self.rod,
        self.timed(view.number(self.weight * pressure, "Pa")),
        view.number(radius, "m"),
        (0.7, -1.1),
        offsets=view.offsets(self.uniform(-0.5, 0.5, (2, 2)) * self.radius),
    )


def _tendon(self: Maker, kind: str = "") -> Any:
    view = self.view
    offsets = view.offsets(self.uniform(-1, 1, (2, 2)) * self.radius)
    pull = 0.05 * self.stretch * self.uniform(0.2, 1, 2)
    first = np.asarray(self.state.positions)[:, 0] / view._size("m") - view.shift
    anchor = view.place(view.turn.T @ first + self.random.normal(size=3) * 0.1)
    given: dict[str, Any] = {
        "tension": self.timed(view.number(self.weight * pull, "N"))
    }
    if kind == "anchored":
        given |= {"anchor": anchor, "elements": (1, self.n - 1)}
    elif kind == "wound up":
        length = view.number(0.95 * (1 - 1 / self.n) * self.length, "m")
        given = {"length": self.timed(length, length * 1.01)}
        given["stiffness"] = view.number(self.weight * self.stretch, "N m^-1")
        given["onset"] = view.number(0.02 * self.length, "m")
    elif kind == "rubbing":
        given |= {"friction": 0.3, "slip_speed": view.number(0.05, "m s^-1")}
        given |= {"friction_at_rest": 0.4}
    return jaxrod.actuation.tendon(self.rod, offsets, **given)


def _spline(self: Maker) -> Any:
    view = self.view
    spline = jaxrod.actuation.control_spline(3, view.number(self.length, "m"))
    controls = self.timed(self.random.normal(size=(3, 3)))
    density = view.number(self.weight * self.bend / self.length**2, "N")
    return jaxrod.actuation.spline_couples(self.rod, spline, controls, density)


def _gradient(self: Maker) -> Any:
    view = self.view
    field, slope = self.random.normal(size=3), self.random.normal(size=(3, 3))
    slope = slope + slope.T
    slope -= np.eye(3) * np.trace(slope) / 3
    moment = self.weight * self.bend * self.random.normal(size=(3, self.n))
    turned = view.turn @ slope @ view.turn.T
    there = view.vector(field) - turned @ view.shift
    return jaxrod.actuation.magnetisation(
        self.rod,
        view.along(view.material(moment, "A m")),
        jaxrod.actuation.linear_field(
            view.number(there, "T"),
            view.number(turned, "T m^-1"),
            extent=view.number(2.0, "m"),
        ),
    )


def _wave(self: Maker) -> Any:
    view = self.view
    axis = self.random.normal(size=3)
    # A joint's moment about d1 has the other sign from the other end, as curvature.
    own = -view.material(axis) if view.reversed else axis
    return jaxrod.actuation.travelling_wave(
        self.rod,
        view.number(self.weight * self.bend * self.random.normal(size=5), "N m"),
        period=view.number(self.uniform(0.05, 0.3), "s"),
        wavelength=view.number(self.uniform(0.2, 0.8), "m"),
        axis=own,
        phase=self.uniform(0, 1),
        head=view.end("base"),
    )


def _world_wave(self: Maker) -> Any:
    view = self.view
    return jaxrod.actuation.muscle_torques(
        self.rod,
        view.number(self.weight * self.bend * self.random.normal(size=5), "N m"),
        period=view.number(self.uniform(0.05, 0.3), "s"),
        wave_number=self.uniform(3, 7),
        direction=view.vector(self.random.normal(size=3)),
        phase_shift=self.uniform(0, 1),
    )


def _stokes(self: Maker) -> Any:
    size = 10 ** self.uniform(-1, 1)
    view = self.view
    sizes = view.along(size * self.uniform(0.5, 1, self.n))
    turning = 0.0 if self.kind.method == "torsion free" else 1e-4 * size
    return jaxrod.fluids.stokes_drag(
        view.number(0.4 * sizes, "N s m^-2"),
        view.number(sizes, "N s m^-2"),
        view.number(turning, "N s"),
        flow=self.flow(),
    )


def _end_load(self: Maker, *, follower: bool = False) -> Any:
    view, w = self.view, self.weight
    force = w * self.vector(0.02 * self.bend / self.length**2 + 0.1)
    couple = w * self.vector(0.3 * self.bend / self.length, couple=True)
    turned = view.material if follower else view.vector
    return jaxrod.end_load(
        self.timed(turned(force, "N")),
        self.timed(turned(couple, "N m")),
        end=view.end(str(self.choices.choice(("base", "tip")))),
        follower=follower,
    )


def _uniform_load(self: Maker, *, follower: bool = False) -> Any:
    view, w = self.view, self.weight
    turned = view.material if follower else view.vector
    return jaxrod.uniform_load(
        self.timed(turned(w * self.vector(3 * self.density), "N m^-1")),
        self.timed(turned(w * self.vector(self.bend, couple=True), "N")),
        follower=follower,
    )


def _relaxing(self: Maker) -> Any:
    return jaxrod.materials.standard_linear_solid(
        self.rod,
        stiffness_ratio=self.weight * self.uniform(0.2, 2),
        relaxation_time=self.view.number(10 ** self.uniform(-3, -1), "s"),
    )


def _wires(self: Maker) -> Any:
    view, w = self.view, self.weight
    return jaxrod.materials.bending_hysteresis(
        self.rod,
        stiffness=view.number(w * self.uniform(0.2, 2) * self.bend, "N m^2"),
        slip_moment=view.number(w * 0.1 * self.bend / self.length, "N m"),
    )


def _plastic(self: Maker) -> Any:
    return jaxrod.materials.plastic_bending(
        self.rod,
        yield_moment=self.view.number(0.1 * self.bend / self.length, "N m"),
        hardening=self.uniform(0, 0.9),
    )


MAKERS: dict[str, Callable[[Maker], Any]] = {
    "gravity": lambda m: jaxrod.gravity(
        m.timed(m.view.vector(m.weight * m.vector(9), "m s^-2"))
    ),
    "end load": _end_load,
    "follower": lambda m: _end_load(m, follower=True),
    "uniform load": _uniform_load,
    "follower load": lambda m: _uniform_load(m, follower=True),
    "exponential damping": lambda m: jaxrod.exponential_damping(
        m.view.number(m.weight * m.uniform(0.5, 5), "s^-1"),
        m.view.number(m.weight * m.uniform(0.5, 5), "s^-1"),
    ),
    "stokes": _stokes,
    "quadratic": lambda m: jaxrod.fluids.quadratic_drag(
        m.view.number(10 ** m.uniform(1, 3), "kg m^-3"), along=0.1, flow=m.flow()
    ),
    "slender body": lambda m: jaxrod.fluids.slender_body_drag(
        m.view.number(m.weight * m.uniform(0.1, 1), "Pa s")
    ),
    "buoyancy": lambda m: jaxrod.fluids.buoyancy(
        m.view.number(m.weight * m.uniform(100, 1000), "kg m^-3"),
        m.timed(m.view.vector(m.vector(9), "m s^-2")),
    ),
    "internal damping": lambda m: jaxrod.internal_damping(
        m.view.number(10 ** m.uniform(-4, -2), "s")
    ),
    "short waves": lambda m: jaxrod.short_wave_damping(
        m.view.number(10 ** m.uniform(0, 2), "s^-1")
    ),
    "laplacian filter": lambda m: jaxrod.laplacian_filter(3),
    "linear damper": lambda m: jaxrod.linear_damper(
        translational=m.view.number(1e-2 * m.density, "kg s^-1"),
        rotational=m.view.number(1e-5 * m.density, "N m s"),
    ),
    "contact": _contact,
    "contact of many": lambda m: _contact(m, 2),
    "near contact": _near,
    "sticking contact": _sticking,
    "moving contact": _moving,
    "moving contact of many": lambda m: _moving(m, 2),
    "moving sticking contact": lambda m: _moving(m, sticks=True),
    "muscle": _muscle,
    "helical muscle": _helical,
    "muscle across": lambda m: _muscle(m, across=True, offsets=None),
    "fast muscle": lambda m: _muscle(m, fastest=m.view.number(5.0, "s^-1")),
    "chamber": _chamber,
    "wound chamber": _wound,
    "tendon": _tendon,
    "anchored tendon": lambda m: _tendon(m, "anchored"),
    "wound up tendon": lambda m: _tendon(m, "wound up"),
    "rubbing tendon": lambda m: _tendon(m, "rubbing"),
    "wave": _wave,
    "world wave": _world_wave,
    "active shape": lambda m: jaxrod.actuation.active_shape(
        m.rod,
        curvature=m.timed(m.view.bent(m.weight * m.random.normal(size=3))),
        strain=m.timed(m.view.bent(m.weight * m.vector(0.03), "1")),
    ),
    "magnet": lambda m: jaxrod.actuation.magnetisation(
        m.rod,
        m.view.along(
            m.view.material(m.weight * m.bend * m.random.normal(size=(3, m.n)), "A m")
        ),
        m.timed(m.view.vector(m.random.normal(size=3), "T")),
    ),
    "magnet in a gradient": _gradient,
    "spline couples": _spline,
    "relaxing solid": _relaxing,
    "wires that slip": _wires,
    "plastic bending": _plastic,
}
HALVED = set(MAKERS) - DISSIPATING - DRAGS - {"plastic bending"}

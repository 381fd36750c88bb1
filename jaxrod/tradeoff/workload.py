"""Workloads: scenes of any number of elements with their controls, and named ones.

The trade-off of speed and accuracy is measured on them.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from importlib import resources
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrod.contacts.bodies import cylinder
from jaxrod.contacts.contact import contact
from jaxrod.effects.actuation import control_spline, spline_couples
from jaxrod.effects.base import Effect
from jaxrod.effects.clamps import clamp, fixed_end
from jaxrod.effects.loads import exponential_damping, gravity
from jaxrod.methods.consistent import Consistent
from jaxrod.methods.laws import IN_SPACE, Law
from jaxrod.methods.planar_verlet import PlaneName
from jaxrod.model import Model, check_model
from jaxrod.rods.factories import straight_rod
from jaxrod.rods.rod import Rod, RodState
from jaxrod.scene import Scene, make_scene
from jaxrod.tradeoff.reductions import allowed, planar_by, planes_of
from jaxrod.tradeoff.resampling import resample
from jaxrod.validation import astype, check_array

Build = Callable[[int, Law], tuple[Any, Any]]
Act = Callable[[Any], Callable[[jax.Array], Any]]


def _unchanged(scene: Model) -> Callable[[jax.Array], Model]:
    return lambda control: scene


def _same(n_elements: int) -> int:
    return n_elements


def _tip(scene: Model, state: Any) -> jax.Array:
    tip: jax.Array = state.tip
    return tip


@dataclasses.dataclass(frozen=True, eq=False)
class Workload:
    """Simulation on which the error and the cost of settings are measured.

    Time is divided into control periods of a whole number of steps. `act` gives the
    scene during each period. At the end of each period the tip's position is recorded,
    or the points that `watch` gives.

    Example:
        >>> work = tradeoff.swing()
        >>> work.name, work.plane, len(work.controls), round(work.duration, 3)
        ('swing', 'xy', 100, 1.0)
    """

    name: str
    """Name of the workload."""
    build: Build
    """`(n_elements, law) -> (scene, state)`: the scene or system without controls and
    its initial state, in float64."""
    period: float
    """Length of a control period [s]."""
    controls: np.ndarray
    """Controls of each period `(periods, controls)`; `(periods, 0)` for none."""
    act: Act = _unchanged
    """`scene -> (controls -> scene)`: called once with the scene, it returns a function
    from a period's controls to the scene during that period."""
    plane: PlaneName | None = None
    """Plane of all motion and loads, or of those of some members of a system; `None` if
    the motion is spatial."""
    fits: Callable[[int], int] = _same
    """`n -> n_elements`: the nearest number of elements that it can be built with. In a
    system this is the number of the rod that has most."""
    watch: Callable[[Any, Any], jax.Array] = _tip
    """`(scene, state) -> points`: positions that are recorded, `(3,)` or `(points, 3)`
    [m]. By default it is the tip."""

    @property
    def duration(self) -> float:
        """Simulated time: number of periods times `period` [s]."""
        return self.period * len(self.controls)


def workload_of(
    scene: Model,
    state: Any,
    *,
    duration: float = 1.0,
    periods: int = 50,
    name: str = "scene",
) -> Workload:
    """Makes a workload, on which `tune` measures, from a scene or a system.

    It records the ends and the middle of each rod, and the position of each body. The
    rods of a system have numbers of elements in the proportion of the given ones, and
    nodes where something is joined to them.

    Args:
        scene: The scene or the system, without controls. It is resampled to other
            numbers of elements, so numbers that vary along a rod are interpolated.
        state: Initial state of it.
        duration: Simulated time [s].
        periods: Number of periods, at whose ends points are recorded; no step is longer
            than a period.
        name: Name of the workload.

    Raises:
        ValueError: If `duration` is not positive, a rod has PyElastica's law, there is
            no rod, `state` does not match or is not finite, or a part leaves the plane
            of a planar rod.
        TypeError: If `scene` is not a scene or a system, or `state` not a state.

    Example:
        >>> work = tradeoff.workload_of(scene, state, duration=0.5, periods=10)
        >>> len(work.controls), round(work.period, 6)
        (10, 0.05)
    """
    check_model(scene)
    scene.check_state(state)
    if not all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(state)):
        raise ValueError("state must be finite")
    check_array("duration", duration, [()], "s", positive=True)
    rods = {k: own for k, own in scene.interfaces().items() if own.rod is not None}
    if not rods:
        raise ValueError(
            "nothing is divided into elements here: give a scene, or a system that has "
            "a rod"
        )
    for own in rods.values():
        if not own.method.has_energy:
            raise ValueError(
                "a scene of PyElastica's law cannot be tuned: the errors of its clamp "
                "and its law are larger than those of its steps"
            )
    scene.check_run(state, 1.0, jnp.int32(0) if scene.evolves else None)
    with jax.enable_x64(True):
        scene, state = astype((scene, state), jnp.float64)
        plain = scene.with_members(
            {
                k: own.with_method(lambda law: Consistent())
                for k, own in scene.interfaces().items()
                if k in rods
            }
        )
        numbers = Numbers.of(plain)
        plane = None
        for one in planes_of(plain, state):
            if allowed(plain, state, planar_by(one)):
                plane = one
                break

    @functools.cache
    def build(n_elements: int, law: Law) -> tuple[Any, Any]:
        if law != "consistent":
            raise ValueError("a scene must have the consistent law to be tuned")
        return resample(plain, state, numbers.by_name(n_elements))

    controls = np.zeros((periods, 0))
    return Workload(
        name,
        build,
        duration / periods,
        controls,
        plane=plane,
        fits=numbers.fitting,
        watch=ends_and_middles,
    )


@dataclasses.dataclass(frozen=True)
class Numbers:
    """Numbers of elements of rods, in proportion, with nodes where they are joined."""

    given: dict[str, int]
    """Present number of each rod."""
    units: dict[str, int]
    """Number of which each rod must have a multiple."""

    @staticmethod
    def of(model: Model) -> Numbers:
        """Numbers of a model's rods, and the units that its joints ask for."""
        rods = {k: own.rod for k, own in model.interfaces().items()}
        rods = {k: rod for k, rod in rods.items() if rod is not None}
        given = {k: rod.n_elements for k, rod in rods.items()}
        joined = model.joined_nodes()
        units = {k: n // math.gcd(n, *joined.get(k, ())) for k, n in given.items()}
        return Numbers(given, units)

    def by_name(self, n_elements: int) -> dict[str, int]:
        """Number of each rod, if that of the rod with most is about `n_elements`."""
        most = max(self.given.values())
        return {
            k: self._multiple(k, n_elements * own / most)
            for k, own in self.given.items()
        }

    def fitting(self, n_elements: int) -> int:
        """Nearest number that the rod with most elements can have."""
        most = max(self.given, key=lambda name: self.given[name])
        return self._multiple(most, n_elements)

    def _multiple(self, name: str, wanted: float) -> int:
        unit = self.units[name]
        return unit * max(round(wanted / unit), -(-2 // unit))


def ends_and_middles(scene: Model, state: Any) -> jax.Array:
    """Positions of the ends and the middle of all rods, and of all bodies [m].

    They are `(points, 3)`. Between two nodes the middle is on a cubic curve. They are
    NaN if contact may have been missed, because neighbour lists were too short.
    """
    found = []
    for own in scene.states_by_name(state).values():
        x = own.positions
        if own.layout.is_rod:
            half = own.layout.n_elements // 2
            middle = x[..., half]
            if own.layout.n_elements % 2:
                near = x[..., half] + x[..., half + 1]
                far = x[..., half - 1] + x[..., half + 2]
                middle = (9 * near - far) / 16
            x = jnp.stack([x[..., 0], middle, x[..., -1]], axis=-1)
        found.append(jnp.moveaxis(x, -2, 0).reshape(3, -1))
    points = jnp.concatenate(found, axis=1).T
    return jnp.where(scene.missed_contact(state), jnp.nan, points)


N_CONTROLS = 6
COUPLE_DENSITY = 1500.0
"""Couple per unit length at a control value of one, as in the tracking task [N m/m]."""
VISCOSITY = 30.0
"""Viscous force per unit length and speed on the tracking task's arm [kg/(m s)]."""


def swing() -> Workload:
    """Arm released from a horizontal position: it swings under its weight for 1 s.

    The arm is 1 m long, 5 cm in radius, with Young's modulus 10 MPa, clamped and
    lightly damped. Its motion stays in a plane.

    Example:
        >>> ready = tradeoff.prepare(tradeoff.swing(), tradeoff.Setting(8))
        >>> ready.scene.rod.n_elements, ready.state.tip.round(3).tolist()
        (8, [1.0, 0.0, 0.0])
    """
    return _released("swing", 100, 0.05, 0.5)


def rope() -> Workload:
    """Rope, 4 mm thick and 1 m long, released from a horizontal position: 0.3 s.

    Its elements are much longer than thick, so enlarged inertia and implicit steps are
    useful.

    Example:
        >>> work = tradeoff.rope()
        >>> work.name, round(work.duration, 3)
        ('rope', 0.3)
    """
    return _released("rope", 30, 0.002, 1.0)


def slam() -> Workload:
    """Arm of `swing` released above a post, which it hits and bends over: 0.6 s.

    The post is a cylinder of 15 cm radius, perpendicular to the plane of motion, below
    a point at two thirds of the arm's length. Contact is soft, so that few elements
    resolve it.

    Example:
        >>> ready = tradeoff.prepare(tradeoff.slam(), tradeoff.Setting(8))
        >>> [type(effect).__name__ for effect in ready.scene.effects]
        ['Clamp', 'ExponentialDamping', 'Gravity', 'Contact']
    """

    def post() -> Effect:
        body = cylinder((0.65, -0.3, -0.5), (0.65, -0.3, 0.5), radius=0.15)
        return contact(body, stiffness=3e5, damping=300.0, points_per_element=2)

    return _released("slam", 60, 0.05, 0.5, post)


def tracking_arm() -> Workload:
    """Arm of the tracking task, 1 s under recorded actions of a trained policy.

    Twelve control values change every 1.4 ms and shape the bending couples along the
    arm. They are at their limits a third of the time. The arm is damped as in the
    published task.

    Example:
        >>> work = tradeoff.tracking_arm()
        >>> work.controls.shape, round(work.period, 6)
        ((714, 12), 0.0014)
    """
    name = "tracking_actions.npy"
    with resources.as_file(resources.files("jaxrod.data") / name) as path:
        actions = np.load(path) / 127

    def build(n_elements: int, law: Law) -> tuple[Scene, RodState]:
        rod, state = _arm(n_elements, 0.05, (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        # One viscosity for translation and rotation, converted to rates.
        rates = (
            VISCOSITY / float(rod.linear_density[0]),
            VISCOSITY / float(rod.rotary_inertia[0, 0]),
        )
        return _clamped(rod, state, law, exponential_damping(*rates)), state

    def act(scene: Scene) -> Callable[[jax.Array], Scene]:
        spline = control_spline(N_CONTROLS, 1.0, scene.rod.rest_lengths.dtype)
        averages = spline.averaged(scene.rod)

        def during(control: jax.Array) -> Scene:
            bends = jnp.reshape(control, (2, N_CONTROLS))
            controls = jnp.concatenate([bends, jnp.zeros_like(bends[:1])])
            couples = spline_couples(scene.rod, averages, controls, COUPLE_DENSITY)
            return dataclasses.replace(scene, effects=(*scene.effects, couples))

        return during

    return Workload("tracking", build, 1.4e-3, actions[:714], act)


SCENES: dict[str, Callable[[], Workload]] = {
    "swing": swing,
    "tracking": tracking_arm,
    "rope": rope,
    "slam": slam,
}
"""Functions that make the workloads, by name."""


def _arm(
    n_elements: int,
    radius: float,
    direction: tuple[float, float, float],
    normal: tuple[float, float, float],
) -> tuple[Rod, RodState]:
    """Makes a straight rod, 1 m long, of Young's modulus 10 MPa and 1000 kg/m^3.

    It extends from the origin along `direction`, with d1 along `normal`.
    """
    return straight_rod(
        n_elements,
        length=1.0,
        radius=radius,
        density=1000.0,
        youngs_modulus=1e7,
        direction=direction,
        normal=normal,
        dtype=jnp.float64,
    )


def _clamped(rod: Rod, state: RodState, law: Law, *effects: Effect) -> Scene:
    held = clamp(state) if law == "consistent" else fixed_end(state)
    return make_scene(rod, held, *effects, method=IN_SPACE[law])


def _released(
    name: str,
    periods: int,
    radius: float,
    damping_rate: float,
    *others: Callable[[], Effect],
) -> Workload:
    """Makes a workload of `_arm` released from a horizontal position, clamped, damped.

    Its control periods are 10 ms. `radius` is the radius of the rod [m], `damping_rate`
    the decay rate of velocities [1/s], and `others` are functions that make further
    effects.
    """

    def build(n_elements: int, law: Law) -> tuple[Scene, RodState]:
        rod, state = _arm(n_elements, radius, (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
        effects = exponential_damping(damping_rate), gravity((0.0, -9.81, 0.0))
        own = [effect() for effect in others]
        return _clamped(rod, state, law, *effects, *own), state

    return Workload(name, build, 0.01, np.zeros((periods, 0)), plane="xy")

"""Workloads: scenes of any number of elements with their controls, and named ones.

The trade-off of speed and accuracy is measured on them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from importlib import resources

import jax
import jax.numpy as jnp
import numpy as np

from jaxrod.contacts.bodies import cylinder
from jaxrod.contacts.contact import contact
from jaxrod.effects.actuation import control_spline, spline_couples
from jaxrod.effects.base import Effect
from jaxrod.effects.clamps import clamp, fixed_end
from jaxrod.effects.loads import exponential_damping, gravity
from jaxrod.loaded_rod import check_scene_and_state
from jaxrod.methods.consistent import Consistent
from jaxrod.methods.laws import IN_SPACE, Law
from jaxrod.methods.planar_verlet import PlaneName
from jaxrod.rods.factories import straight_rod
from jaxrod.rods.rod import Rod, RodState
from jaxrod.scene import Scene, make_scene
from jaxrod.tradeoff.resampling import resample
from jaxrod.validation import check_array

Build = Callable[[int, Law], tuple[Scene, RodState]]
Act = Callable[[Scene], Callable[[jax.Array], Scene]]


def _unchanged(scene: Scene) -> Callable[[jax.Array], Scene]:
    return lambda control: scene


@dataclasses.dataclass(frozen=True, eq=False)
class Workload:
    """Simulation on which the error and the cost of settings are measured.

    Time is divided into control periods of a whole number of steps. `act` gives the
    scene during each period. At the end of each period the tip's position is recorded.

    Example:
        >>> work = tradeoff.swing()
        >>> work.name, work.plane, len(work.controls), round(work.duration, 3)
        ('swing', 'xy', 100, 1.0)
    """

    name: str
    """Name of the workload."""
    build: Build
    """`(n_elements, law) -> (scene, state)`: the scene without controls and its initial
    state, in float64."""
    period: float
    """Length of a control period [s]."""
    controls: np.ndarray
    """Controls of each period `(periods, controls)`; `(periods, 0)` for none."""
    act: Act = _unchanged
    """`scene -> (controls -> scene)`: called once with the scene, it returns a function
    from a period's controls to the scene during that period."""
    plane: PlaneName | None = None
    """Plane of all motion and loads; `None` if the motion is spatial."""

    @property
    def duration(self) -> float:
        """Simulated time: number of periods times `period` [s]."""
        return self.period * len(self.controls)


def workload_of(
    scene: Scene,
    state: RodState,
    *,
    duration: float = 1.0,
    periods: int = 50,
    name: str = "scene",
) -> Workload:
    """Makes a workload, on which `tune` measures, from a scene without controls.

    Args:
        scene: The scene; it is resampled to other numbers of elements, so numbers
            that vary along the rod are interpolated.
        state: Initial state of the rod of the scene.
        duration: Simulated time [s].
        periods: Number of periods, at whose ends the tip is recorded; no step is longer
            than a period.
        name: Name of the workload.

    Raises:
        ValueError: If `duration` is not positive, `scene` has PyElastica's law, `state`
            does not match its rod or is not finite, or a part leaves the plane of a
            planar scene.
        TypeError: If `scene` is not a scene or `state` not a state.

    Example:
        >>> work = tradeoff.workload_of(scene, state, duration=0.5, periods=10)
        >>> len(work.controls), round(work.period, 6)
        (10, 0.05)
    """
    check_scene_and_state(scene, state)
    if not all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(state)):
        raise ValueError("state must be finite")
    check_array("duration", duration, [()], "s", positive=True)
    if not scene.method.has_energy:
        raise ValueError(
            "a scene of PyElastica's law cannot be tuned: the errors of its clamp and "
            "its law are larger than those of its steps"
        )
    scene.method.check_state(scene, state)
    with jax.enable_x64(True):
        scene, state = jax.tree.map(_double, (scene, state))
        plain = dataclasses.replace(scene, method=Consistent())

    def build(n_elements: int, law: Law) -> tuple[Scene, RodState]:
        if law != "consistent":
            raise ValueError("a scene must have the consistent law to be tuned")
        return resample(plain, state, n_elements)

    controls = np.zeros((periods, 0))
    plane = getattr(scene.method, "plane", None)
    return Workload(name, build, duration / periods, controls, plane=plane)


def _double(leaf: jax.Array) -> jax.Array:
    return jax.numpy.asarray(np.asarray(leaf, np.float64))


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
    """Arm of the tracking task under recorded actions of a trained policy: 1 s.

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

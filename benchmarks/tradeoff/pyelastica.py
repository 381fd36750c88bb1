"""The same problems simulated by PyElastica, for the comparison."""

from __future__ import annotations

import time
import warnings
from typing import Any

import jax
import numpy as np

from jaxrod.effects.actuation import ElementCouples
from jaxrod.effects.base import Effect
from jaxrod.effects.clamps import FixedEnd
from jaxrod.effects.loads import ExponentialDamping, Gravity
from jaxrod.rods.rod import Rod, RodState
from jaxrod.scene import Scene
from jaxrod.tradeoff.measure import Measurement, Reference, Setting, prepare, tip_error
from jaxrod.tradeoff.workload import Workload


def measure_pyelastica(
    problem: Workload,
    n_elements: int,
    exact: Reference,
    *,
    batches: tuple[int, ...] = (1,),
    safety: float = 0.9,
) -> Measurement:
    """Measures error and cost of PyElastica, in one process on one core.

    The cost per rod does not depend on their number.

    Args:
        problem: The problem; its rod has to be straight and uniform, with effects
            that PyElastica has too.
        n_elements: Number of elements.
        exact: The problem's reference.
        batches: The batch sizes to state the cost for.
        safety: Fraction of the stability limit to use as step.

    Raises:
        ModuleNotFoundError: If PyElastica is not installed.
        ValueError: If the problem has something PyElastica has not.
    """
    setting = Setting(n_elements, None, "float64", "pyelastica", safety=safety)
    prepared = prepare(problem, setting)
    dt, substeps = prepared.setting.dt, prepared.substeps
    assert dt is not None
    couples = _couples(problem, prepared.scene)

    def simulate(periods: int) -> tuple[np.ndarray, float]:
        acting = np.zeros_like(couples[0])
        simulator, rod, stepper = _simulator(prepared.scene, prepared.state, dt, acting)
        tips = np.empty((periods, 3))
        clock, step = np.float64(0.0), np.float64(dt)
        start = time.perf_counter()
        for period in range(periods):
            acting[:] = couples[period]
            for _ in range(substeps):
                clock = stepper.step(simulator, clock, step)
            tips[period] = rod.position_collection[:, -1]
        return tips, time.perf_counter() - start

    # Numbers that overflow are what the error says: no need to warn as well.
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        simulate(1)  # compiles
        tips, wall = simulate(len(problem.controls))
    error = tip_error(tips, exact.tips, exact.length)
    per_second = wall / problem.duration
    return Measurement(prepared.setting, error, dict.fromkeys(batches, per_second))


def _couples(problem: Workload, scene: Scene) -> np.ndarray:
    """Couples on the elements during every period `(periods, 3, n)` [N m]."""
    n = scene.rod.n_elements
    with jax.enable_x64(True):
        act = problem.act(scene)
        first = act(jax.numpy.asarray(problem.controls[0]))
        added = first.effects[len(scene.effects) :]
        if not added:
            return np.zeros((len(problem.controls), 3, n))
        if len(added) != 1 or not isinstance(added[0], ElementCouples):
            raise ValueError("PyElastica is driven by couples on elements only")

        def couples(control: jax.Array) -> jax.Array:
            effect = act(control).effects[-1]
            assert isinstance(effect, ElementCouples)
            return effect.couples

        every = jax.jit(jax.vmap(couples))
        return np.asarray(every(jax.numpy.asarray(problem.controls)))


def _simulator(
    scene: Scene, state: RodState, dt: float, couples: np.ndarray
) -> tuple[Any, Any, Any]:
    """PyElastica's simulator, rod and stepper; `couples` may change later."""
    import elastica

    class Actuation(elastica.NoForces):
        """The present couples in the material frame [N m]."""

        def apply_torques(self, system: Any, time: Any = 0.0) -> None:
            """Adds the couples."""
            system.external_torques += couples

    class Simulator(
        elastica.BaseSystemCollection,
        elastica.Constraints,
        elastica.Forcing,
        elastica.Damping,
    ):
        """The features that the problems need."""

    rod = _straight_rod(elastica, scene.rod, state)
    simulator = Simulator()
    simulator.append(rod)
    for effect in scene.effects:
        _add(elastica, simulator, rod, scene.rod, effect, dt)
    simulator.add_forcing_to(rod).using(Actuation)
    simulator.finalize()
    return simulator, rod, elastica.PositionVerlet()


def uniform_radius(rod: Rod) -> float:
    """Radius of a uniform rod [m]; others raise `ValueError`."""
    leaves = (rod.rest_lengths, rod.radii, rod.linear_density)
    if any(np.ptp(np.asarray(leaf)) > 1e-12 * np.max(leaf) for leaf in leaves):
        raise ValueError("simulators are compared on uniform rods only")
    return float(rod.radii[0])


def _straight_rod(elastica: Any, rod: Rod, state: RodState) -> Any:
    """The same uniform, straight rod in PyElastica."""
    radius = uniform_radius(rod)
    area = np.pi * radius**2
    nodes = np.asarray(state.positions, np.float64)
    length = float(np.sum(np.asarray(rod.rest_lengths)))
    direction = nodes[:, -1] - nodes[:, 0]
    with jax.enable_x64(True):
        # PyElastica normalises it in place.
        normal = np.array(state.directors[0, :, 0], np.float64)
    return elastica.CosseratRod.straight_rod(
        rod.n_elements,
        nodes[:, 0],
        direction / np.linalg.norm(direction),
        normal,
        base_length=length,
        base_radius=radius,
        density=float(rod.linear_density[0]) / area,
        youngs_modulus=float(rod.shear_stretch_stiffness[2, 0]) / area,
        shear_modulus=float(rod.bend_twist_stiffness[2, 0]) / (area**2 / (2 * np.pi)),
    )


def _add(
    elastica: Any, simulator: Any, system: Any, rod: Rod, effect: Effect, dt: float
) -> None:
    """Adds PyElastica's version of an effect."""
    if isinstance(effect, FixedEnd):
        simulator.constrain(system).using(
            elastica.OneEndFixedBC,
            constrained_position_idx=(0,),
            constrained_director_idx=(0,),
        )
    elif isinstance(effect, Gravity):
        simulator.add_forcing_to(system).using(
            elastica.GravityForces,
            acc_gravity=np.asarray(effect.acceleration, np.float64),
        )
    elif isinstance(effect, ExponentialDamping):
        rates = float(effect.translational_rate), float(effect.rotational_rate)
        simulator.dampen(system).using(_damper(elastica, *rates, dt))
    else:
        raise ValueError(
            f"PyElastica has no effect of the same law as {type(effect).__name__}"
        )


def _damper(elastica: Any, rate: float, spin_rate: float, dt: float) -> Any:
    """PyElastica's exponential damping, with any two rates.

    PyElastica's dampers take one rate, or the two rates of a viscosity. There the
    second depends on the stretch, which would be a different physical problem.
    """
    decay, spin_decay = np.exp(-rate * dt), np.exp(-spin_rate * dt)

    class Damper(elastica.DamperBase):
        """Multiplies rates after every kick, as PyElastica's dampers do."""

        def dampen_rates(self, system: Any, time: Any) -> None:
            """Slows the system for one step."""
            system.velocity_collection *= decay
            system.omega_collection *= spin_decay

    return Damper

"""PyElastica 1.0 simulations from plain arrays, to compare jaxrod with.

What PyElastica 1.0.0 does, as read in its source and asserted in test_reference.py.
x, v: nodes (3, n+1), world frame; Q: elements (3, 3, n), rows are directors d1 d2 d3;
w: angular velocity of elements (3, n), material frame; h: time step.

One `PositionVerlet.step` from t to t + h:

 1. x += h/2 v;  Q <- R(h/2 w) Q;  t += h/2          (old v and w)
 2. constraints on values: the clamp resets x[0] and Q[0]
 3. internal forces and torques from the mid-step x and Q and the old v and w (v enters
    the dilatation rate, w the two gyroscopic terms); this also stores the dilatation e
 4. forcing is *added* to the external forces and torques, in the order of registration,
    at mid-step time and state; per forcing object apply_forces, then apply_torques
 5. a = (f + f_ext) / m;  alpha = e J^-1 (c + c_ext);  v += h a;  w += h alpha
 6. constraints on rates: the clamp sets v[0] = w[0] = 0
 7. dampers, after all constraints; "physical" and deprecated ones use the e of step 3
 8. x += h/2 v;  Q <- R(h/2 w) Q;  t += h/2          (new v and w)
 9. constraints on values again
10. callbacks; then external forces and torques are set to zero

So a load never sees the state that a callback records, and a constant load in the
world frame is turned into the material frame with the mid-step directors.

`finalize()` applies constraints on values and then on rates once, at t = 0. With the
usual order of base classes (Constraints before Damping) the dampers are registered by
then, and "on rates" includes them: initial velocities are damped by one time step
before the first step, with or without a constraint. Here velocities are set after
`finalize()`, so that the first step starts from exactly what was asked for.

Rest state of `straight_rod(position=..., directors=...)`: rest lengths, joint lengths,
masses and inertias follow the given shape, but rest_sigma and rest_kappa are zero
unless passed: a curved shape is *not* stress-free by default. `reference_rod` passes
the curvatures of the given shape unless told otherwise.

Radii and densities may differ between elements; the moduli are single numbers. With
A = pi r^2, I1 = I2 = A^2 / 4 pi, I3 = 2 I1, l the rest length of an element:

- node mass: half of rho A l of each neighbouring element;
- J = rho l diag(I1, I2, I3);  S = diag(27/28 G A, 27/28 G A, E A);
- rest length of a joint (Voronoi domain): D = (l[j] + l[j+1]) / 2;
- bend matrix of a joint: that of the two elements, diag(E I1, E I2, G I3), averaged
  with their rest lengths as weights: (B[j] l[j] + B[j+1] l[j+1]) / (l[j] + l[j+1]).

Dampers: uniform multiplies v and w by exp(-g h). The deprecated one multiplies v by
exp(-g h) and w[i] by exp(-g h M / J_i)^e, where M is made from node masses:
M = (m[k] + m[k+1]) / 2, plus half of the end node's mass at either end. For a uniform
rod that is the element's mass; for a tapered one it is a blend of neighbours, with
weights 1/4, 1/2, 1/4 (3/4, 1/4 at the ends).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import elastica
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RodSpec:
    """A rod as PyElastica takes it; the given shape is the rest shape.

    Attributes:
        positions: rest (and initial) node positions [m], shape (3, n+1).
        directors: rest (and initial) directors, rows d1 d2 d3, shape (3, 3, n); d3 has
            to be the tangent of the element.
        radii: radius of each element [m], shape (n,).
        density: density of each element [kg/m^3], shape (n,), or one number.
        youngs_modulus: E [Pa].
        shear_modulus: G [Pa].
        rest_curvatures: rest_kappa [1/m], shape (3, n-1); None makes the given shape
            stress-free, zeros reproduce PyElastica's default.
    """

    positions: Array
    directors: Array
    radii: Array
    density: Array | float
    youngs_modulus: float
    shear_modulus: float
    rest_curvatures: Array | None = None

    @property
    def n_elements(self) -> int:
        """Number of elements."""
        return len(self.radii)


def _zero3() -> Array:
    return np.zeros(3)


@dataclass(frozen=True)
class Loads:
    """Constant loads, applied in this order at every step from the first on.

    Attributes:
        gravity: acceleration [m/s^2], world frame: every node gets m * gravity.
        end_force: on the last node [N], world frame.
        uniform_force: total force [N], world frame, 1/n of it on every inner node and
            1/2n on the two end nodes, whatever the lengths of the elements.
        end_couple: on the last element [N m], world frame: c_ext[-1] += Q[-1] couple.
        element_couples: on every element [N m], material frame, shape (3, n).
    """

    gravity: Array = field(default_factory=_zero3)
    end_force: Array = field(default_factory=_zero3)
    uniform_force: Array = field(default_factory=_zero3)
    end_couple: Array = field(default_factory=_zero3)
    element_couples: Array | None = None


@dataclass(frozen=True)
class Motion:
    """Recorded states, one per recorded step.

    Attributes:
        times: [s], shape (records,).
        positions: [m], shape (records, 3, n+1).
        directors: rows d1 d2 d3, shape (records, 3, 3, n).
        velocities: [m/s], shape (records, 3, n+1).
        angular_velocities: material frame [rad/s], shape (records, 3, n).
    """

    times: Array
    positions: Array
    directors: Array
    velocities: Array
    angular_velocities: Array


class EndCouple(elastica.NoForces):
    """A constant couple in the world frame on the last element."""

    def __init__(self, couple: Array) -> None:
        self.couple = couple

    def apply_torques(self, system: Any, time: Any = 0.0) -> None:
        """Adds the couple, turned into the material frame."""
        directors = system.director_collection[..., -1]
        system.external_torques[..., -1] += directors @ self.couple


class ElementCouples(elastica.NoForces):
    """Constant couples in the material frame on all elements."""

    def __init__(self, couples: Array) -> None:
        self.couples = couples

    def apply_torques(self, system: Any, time: Any = 0.0) -> None:
        """Adds the couples as they are."""
        system.external_torques += self.couples


class Simulator(
    elastica.BaseSystemCollection,
    elastica.Constraints,
    elastica.Forcing,
    elastica.Damping,
):
    """The features of PyElastica that the comparison uses."""


def reference_rod(spec: RodSpec) -> Any:
    """Makes the PyElastica rod of a specification, at rest."""
    n = spec.n_elements
    edges = np.diff(spec.positions, axis=1)

    def make(**strains: Array) -> Any:
        # Copies throughout: PyElastica writes into what it is given.
        return elastica.CosseratRod.straight_rod(
            n,
            spec.positions[:, 0].copy(),
            edges[:, 0] / np.linalg.norm(edges[:, 0]),
            spec.directors[0, :, 0].copy(),
            float(np.sum(np.linalg.norm(edges, axis=0))),
            np.array(spec.radii, np.float64),
            np.broadcast_to(np.float64(spec.density), (n,)).copy(),
            youngs_modulus=spec.youngs_modulus,
            shear_modulus=spec.shear_modulus,
            position=spec.positions.copy(),
            directors=spec.directors.copy(),
            **strains,
        )

    curvatures = spec.rest_curvatures
    if curvatures is None:
        curvatures = make().kappa
    return make(rest_kappa=np.array(curvatures, np.float64))


def simulate(
    spec: RodSpec,
    *,
    dt: float,
    steps: int,
    loads: Loads | None = None,
    clamped: bool = False,
    damping_rate: float = 0.0,
    deprecated_damping: float = 0.0,
    velocities: Array | None = None,
    angular_velocities: Array | None = None,
    every: int | None = None,
) -> Motion:
    """Steps a rod with PyElastica's PositionVerlet.

    Args:
        spec: the rod and its initial shape.
        dt: time step [s].
        steps: number of steps.
        loads: constant loads; none by default.
        clamped: holds node 0 and element 0 (OneEndFixedBC); free otherwise.
        damping_rate: `uniform_damping_constant` of AnalyticalLinearDamper [1/s].
        deprecated_damping: its `damping_constant`; see the top of this file.
        velocities: initial node velocities [m/s], shape (3, n+1); zero by default. A
            clamped node starts at rest whatever is given.
        angular_velocities: initial angular velocities [rad/s], material frame,
            shape (3, n); likewise.
        every: records every so many steps; by default only the end.

    Returns:
        The recorded states, the initial one not included.
    """
    every = steps if every is None else every
    loads = Loads() if loads is None else loads
    simulator = Simulator()
    rod = reference_rod(spec)
    simulator.append(rod)
    _add_loads(simulator, rod, loads)
    if clamped:
        simulator.constrain(rod).using(
            elastica.OneEndFixedBC,
            constrained_position_idx=(0,),
            constrained_director_idx=(0,),
        )
    if damping_rate:
        simulator.dampen(rod).using(
            elastica.AnalyticalLinearDamper,
            uniform_damping_constant=damping_rate,
            time_step=dt,
        )
    if deprecated_damping:
        simulator.dampen(rod).using(
            elastica.AnalyticalLinearDamper,
            damping_constant=deprecated_damping,
            time_step=dt,
        )
    simulator.finalize()
    if velocities is not None:
        rod.velocity_collection[...] = velocities
    if angular_velocities is not None:
        rod.omega_collection[...] = angular_velocities
    if clamped:
        rod.velocity_collection[:, 0] = 0.0
        rod.omega_collection[:, 0] = 0.0

    stepper = elastica.PositionVerlet()
    time = np.float64(0.0)
    times, records = [], []
    for step in range(1, steps + 1):
        time = stepper.step(simulator, time, np.float64(dt))
        if step % every == 0:
            times.append(time)
            records.append(
                (
                    rod.position_collection.copy(),
                    rod.director_collection.copy(),
                    rod.velocity_collection.copy(),
                    rod.omega_collection.copy(),
                )
            )
    return Motion(
        np.array(times), *(np.stack(kind) for kind in zip(*records, strict=True))
    )


def _add_loads(simulator: Simulator, rod: Any, loads: Loads) -> None:
    """Registers the loads that are not zero, in the documented order."""
    n = rod.n_elems
    if np.any(loads.gravity):
        simulator.add_forcing_to(rod).using(
            elastica.GravityForces, acc_gravity=np.array(loads.gravity)
        )
    if np.any(loads.end_force):
        simulator.add_forcing_to(rod).using(
            elastica.EndpointForces,
            np.zeros(3),
            np.array(loads.end_force),
            # The factor is min(1, t / ramp) and the ramp has to be positive; the first
            # force is taken at t = dt/2, so this is the full load from the first step.
            ramp_up_time=1e-300,
        )
    if np.any(loads.uniform_force):
        size = float(np.linalg.norm(loads.uniform_force))
        simulator.add_forcing_to(rod).using(
            elastica.UniformForces, size, np.array(loads.uniform_force) / size
        )
    if np.any(loads.end_couple):
        simulator.add_forcing_to(rod).using(EndCouple, np.array(loads.end_couple))
    if loads.element_couples is not None:
        couples = np.array(loads.element_couples)
        if couples.shape != (3, n):
            raise ValueError(f"element_couples must be (3, {n}), got {couples.shape}")
        simulator.add_forcing_to(rod).using(ElementCouples, couples)

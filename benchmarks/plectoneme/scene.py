"""PyElastica's plectoneme, in both libraries: a rod whose one end is turned ten times.

The end slides along the line of the rod while it is turned, in 50 s. A small force
across at the middle chooses the side to which the rod buckles.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from benchmarks.plectoneme.element_contact import element_contact
from jaxrod.structure import pytree

LENGTH, RADIUS, MASS, YOUNG = 1.0, 0.025, 1.0, 1e6
TURNS, TWISTING = 10.0, 50.0
DAMPING = 2.0
"""Damping rate of velocities [1/s]; PyElastica multiplies it by m / J for spins."""
CONTACT, DASHPOT = 1e4, 10.0
"""Stiffness and damping of touching elements, PyElastica [N/m], [N s/m]."""
KICK = 0.04
"""Force across at the middle [N]: 1e-4 m/s in each of PyElastica's steps."""
DENSITY = MASS / (np.pi * RADIUS**2 * LENGTH)
EXTENSION = 10.0
"""Extension of the ends, for the writhe [m]."""


def time_step(n: int) -> float:
    """PyElastica's step [s]."""
    return 0.0025 * LENGTH / n


@pytree
class TurnedEnd(jaxrod.extend.Effect):
    """The last element turned about its axis, its node sliding along y until then."""

    orientation: jax.Array
    time: Any

    def constrain(self, rod: Any, motion: Any) -> Any:
        """Puts the end on its line and the element at its angle."""
        angle = 2 * jnp.pi * TURNS * jnp.clip(self.time / TWISTING, 0, 1)
        half = jnp.cos(angle / 2), jnp.sin(angle / 2)
        w, x, y, z = self.orientation
        # About d3: the product with (cos, 0, 0, sin).
        turned = (
            half[0] * w - half[1] * z,
            half[0] * x + half[1] * y,
            half[0] * y - half[1] * x,
            half[0] * z + half[1] * w,
        )
        orientation = tuple(
            _with_last(component, value)
            for component, value in zip(motion.orientation, turned, strict=True)
        )
        a, b, c = motion.position
        position = _with_last(a, 0.0), b, _with_last(c, 0.0)
        return replace(motion, position=position, orientation=orientation)

    def constrain_rates(self, rod: Any, motion: Any) -> Any:
        """Gives them their rates (PyElastica's law: spins in the material frame)."""
        turning = self.time <= TWISTING
        a, b, c = motion.velocity
        velocity = (
            _with_last(a, 0.0),
            jnp.where(turning, b, _with_last(b, 0.0)),
            _with_last(c, 0.0),
        )
        rate = jnp.where(turning, 2 * jnp.pi * TURNS / TWISTING, 0.0)
        p, q, r = motion.spin
        spin = _with_last(p, 0.0), _with_last(q, 0.0), _with_last(r, rate)
        return replace(motion, velocity=velocity, spin=spin)


@pytree
class Push(jaxrod.extend.Effect):
    """A force along -z on the middle node while the end is turned."""

    time: Any

    def loads(self, rod: Any, motion: Any) -> Any:
        """The force."""
        here = np.arange(rod.n_elements + 1) == rod.n_elements // 2
        size = jnp.where(self.time <= TWISTING, -KICK, 0.0)
        none = jnp.zeros_like(motion.position[0])
        return jaxrod.extend.Loads(forces=(none, none, jnp.where(here, size, none)))


def _with_last(row: Any, value: Any) -> Any:
    last = np.arange(row.shape[0]) == row.shape[0] - 1
    return jnp.where(last, value, row)


def ours(n: int, count: float | None = 1.0) -> tuple[Any, Any]:
    """The system and its state, in PyElastica's law, with jaxrod's own contact.

    Args:
        n: Number of elements.
        count: Pairs of elements by which PyElastica counts rods that lie side by side,
            per element; see `pairs_counted`. `None`: with PyElastica's law of contact.
    """
    rod, state = jaxrod.straight_rod(
        n,
        length=LENGTH,
        radius=RADIUS,
        density=DENSITY,
        youngs_modulus=YOUNG,
        shear_modulus=YOUNG / 1.5,
        direction=(0.0, 1.0, 0.0),
        normal=(0.0, 0.0, 1.0),
        dtype=jnp.float64,
    )
    scene = jaxrod.make_scene(
        rod,
        jaxrod.fixed_end(state),
        TurnedEnd(state.orientations[:, -1], jaxrod.schedules.time()),
        Push(jaxrod.schedules.time()),
        jaxrod.linear_damper(DAMPING),
        method=jaxrod.pyelastica(),
    )
    if count is None:
        theirs = element_contact("rod", stiffness=CONTACT, damping=DASHPOT)
        return jaxrod.make_system({"rod": scene}, theirs), {"rod": state}
    per_length = n / LENGTH
    touch = jaxrod.systems.rod_contact(
        "rod",
        self_contact=True,
        stiffness=count * CONTACT * per_length,
        damping=count * DASHPOT * per_length,
        points_per_element=1,
    )
    return jaxrod.make_system({"rod": scene}, touch), {"rod": state}


def theirs(n: int, shipped: bool = False) -> tuple[Any, Any]:
    """PyElastica's simulator and rod.

    Args:
        n: Number of elements.
        shipped: Whether it is the example as it is. PyElastica's dampers act after its
            constraints and slow down the end that is turned, by the step and the
            elements: to 0.899 of its rate in the example. By default it gets it back.
    """
    import elastica as ea

    class Simulator(ea.BaseSystemCollection, ea.Constraints, ea.Contact, ea.Damping):
        pass

    class Held(ea.DamperBase):
        """Turn of the end, applied once more after it has been damped."""

        def __init__(self, time_step: float, **given: Any) -> None:
            super().__init__(**given)

        def dampen_rates(self, system: Any, time: Any) -> None:
            """Gives the last element its rate."""
            if time <= TWISTING:
                system.omega_collection[2, -1] = 2 * np.pi * TURNS / TWISTING

    class Turned(ea.ConstraintBase):
        def __init__(self, start: Any, _: Any, first: Any, last: Any, **given: Any):
            super().__init__(**given)
            self.start, self.first, self.last = start, first, last

        def constrain_values(self, system: Any, time: Any) -> None:
            if time > TWISTING:
                system.position_collection[..., 0] = self.start
                system.position_collection[0, -1] = 0.0
                system.position_collection[2, -1] = 0.0
                system.director_collection[..., 0] = self.first
                system.director_collection[..., -1] = self.last

        def constrain_rates(self, system: Any, time: Any) -> None:
            system.velocity_collection[..., 0] = 0.0
            system.omega_collection[..., 0] = 0.0
            system.velocity_collection[0, -1] = 0.0
            system.velocity_collection[2, -1] = 0.0
            system.omega_collection[..., -1] = 0.0
            if time > TWISTING:
                system.velocity_collection[1, -1] = 0.0
            else:
                system.omega_collection[2, -1] = 2 * np.pi * TURNS / TWISTING
                system.velocity_collection[2, n // 2] -= 1e-4

    simulator = Simulator()
    rod = ea.CosseratRod.straight_rod(
        n,
        np.zeros(3),
        np.array([0.0, 1.0, 0.0]),
        np.array([0.0, 0.0, 1.0]),
        LENGTH,
        RADIUS,
        DENSITY,
        youngs_modulus=YOUNG,
        shear_modulus=YOUNG / 1.5,
    )
    simulator.append(rod)
    simulator.dampen(rod).using(
        ea.AnalyticalLinearDamper, damping_constant=DAMPING, time_step=time_step(n)
    )
    if not shipped:
        simulator.dampen(rod).using(Held, time_step=time_step(n))
    simulator.constrain(rod).using(
        Turned,
        constrained_position_idx=(0, -1),
        constrained_director_idx=(0, -1),
    )
    simulator.detect_contact_between(rod, rod).using(
        ea.RodSelfContact, k=CONTACT, nu=DASHPOT
    )
    simulator.finalize()
    return simulator, rod


def pairs_counted(n: int, depth: float) -> float:
    """Pairs of elements that PyElastica counts of rods side by side, per element.

    Their force per length and penetration over that of one pair per element, measured
    on two straight pieces of a rod, the mean over how their nodes face each other.

    Args:
        n: Elements of the whole rod.
        depth: Penetration over the sum of the radii.
    """
    from elastica._contact_functions import _calculate_contact_forces_self_rod

    size, away = LENGTH / n, 2 * RADIUS * (1 - depth)
    m = 8 + 2 * int(np.ceil(4 * RADIUS / size))
    along, bridge = np.arange(m + 1) * size, np.linspace(0, 1, 12)
    found = []
    for shift in np.arange(8) / 8 * size:
        there = np.stack([along, 0 * along, 0 * along])
        back = np.stack([along[::-1] + shift, away + 0 * along, 0 * along])
        between = np.stack([along[-1] + 5 + 0 * bridge, away * bridge, 5 + bridge])
        nodes = np.concatenate([there, between, back], axis=1)
        edges = np.diff(nodes, axis=1)
        lengths = np.linalg.norm(edges, axis=0)
        forces = np.zeros_like(nodes)
        _calculate_contact_forces_self_rod(
            nodes[:, :-1].copy(),
            np.full(len(lengths), RADIUS),
            lengths,
            edges / lengths,
            np.zeros_like(nodes),
            forces,
            CONTACT,
            0.0,
        )
        inside = (m - 8) // 2
        middle = forces[1, len(lengths) + 1 - m - 1 :][inside : inside + 8]
        found.append(np.mean(middle) / CONTACT / (2 * RADIUS * depth))
    return float(np.mean(found))


@dataclass(frozen=True)
class Shape:
    """Measurements of a state."""

    twist: float
    writhe: float
    positions: np.ndarray


@jax.jit
def _topology(positions: Any, normals: Any) -> tuple[Any, Any]:
    writhe = jaxrod.topology.writhe(positions, ends="next_tangent", extension=EXTENSION)
    return jaxrod.topology.twist(positions, normals), writhe


def shape(positions: Any, normals: Any) -> Shape:
    """Twist and writhe of nodes and first directors."""
    twist, writhe = _topology(jnp.asarray(positions), jnp.asarray(normals))
    return Shape(float(twist), float(writhe), np.asarray(positions))

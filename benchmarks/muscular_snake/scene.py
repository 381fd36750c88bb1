"""PyElastica's muscular snake, in both libraries: a body with eight muscles.

Zhang et al., Nat. Commun. 10 (2019) 4825: nine rods of 100, 39 and 33 elements. Each
muscle is a soft belly between two tendons, glued along the body; it pulls as a delayed
sine, in turns with the one on the other side. The body lies on a plane with directional
friction. The numbers are those of PyElastica's example as it is: shear moduli of
`E / 2 * (0.5 + 1)`, and the body damped twice.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from benchmarks.muscular_snake.surface_joint import surface_joint
from jaxrod.structure import pytree

N_BODY, LENGTH, RADIUS, DENSITY, YOUNG = 100, 1.0, 0.025, 1000.0, 1e7
ELEMENT = LENGTH / N_BODY
TENDON, BELLY, MUSCLE_DENSITY, MUSCLE_YOUNG = 0.003, 0.006, 2000.0, 1e4
HARDER = 50_000.0
"""Shear and stretch stiffness of tendons over that of their material."""
FIRST, LAST = 12, 27
"""Elements of a muscle that pull."""
STARTS = (4, 4, 33, 33, 23, 23, 61, 61)
"""First elements of the body to which the muscles are glued."""
TORQUES = (13.7, 13.7, 9.51, 9.51, 20.95, 20.95, 22.96, 22.96)
ARM = RADIUS + TENDON
PERIOD, G, FROUDE = 1.0, 9.81, 0.1
DELAYS = tuple(start / 101.76 for start in reversed(STARTS))
BODY_DAMPING = 4e-3 / DENSITY / (np.pi * RADIUS**2)
MUSCLE_DAMPING = 4e-3 / (MUSCLE_DENSITY * np.pi * TENDON**2)
"""Damping rate of velocities [1/s]; the body has both."""
FRICTION = LENGTH / (PERIOD**2 * G * FROUDE) * np.array([1.0, 1.5, 2.0])
STEP = 5e-6
"""PyElastica's [s]."""
SIZES = {"long": 39, "short": 33}
"""Elements of the first four muscles, and of the others."""


@dataclass(frozen=True)
class MuscleNumbers:
    """Numbers of one muscle."""

    n: int
    start: tuple[float, float, float]
    radii: np.ndarray
    amplitude: float
    delay: float
    side: float


def muscle_numbers(number: int) -> MuscleNumbers:
    """Numbers of one of the eight muscles."""
    n = SIZES["long" if number < 4 else "short"]
    radii = np.full(n, TENDON)
    radii[FIRST:LAST] = BELLY
    side = 1.0 if number % 2 == 0 else -1.0
    return MuscleNumbers(
        n=n,
        start=(STARTS[number] * ELEMENT, -side * ARM, RADIUS),
        radii=radii,
        amplitude=TORQUES[number] / 2 / ARM,
        delay=DELAYS[number],
        side=side,
    )


def glue_stiffness(radius: float, scale: float) -> float:
    """Stiffness of the joint of one element of a muscle and the body's [N/m]."""
    together = RADIUS + radius
    return RADIUS * radius / together**2 * ELEMENT * YOUNG * scale


TENDON_GLUE, BELLY_GLUE = glue_stiffness(TENDON, 2.0), glue_stiffness(BELLY, 0.05)
JOINT_DAMPING = 1e-4
"""Damping of PyElastica's joints [N s/m]."""
REPULSION = 20.0
"""Stiffness that pushes apart rods that are too near, over the joint's unscaled one."""


@pytree
class Pulse(jaxrod.schedules.Schedule):
    """Force of a muscle [N]: a delayed sine from zero on, ramped up in a second."""

    amplitude: jax.Array
    delay: jax.Array
    side: jax.Array

    def __call__(self, clock: jaxrod.schedules.Clock) -> Any:
        """The force at a time."""
        late = clock.time - self.delay
        wave = 0.5 + 0.5 * self.side * jnp.sin(2 * jnp.pi * late / PERIOD)
        return self.amplitude * jnp.clip(late, 0, 1) * wave

    @property
    def largest(self) -> Any:
        """The amplitude."""
        return jnp.abs(self.amplitude)


@pytree
class Belly(jaxrod.actuation.SectionLoad):
    """A force along the elements of the belly, on the nodes at both ends of each."""

    force: Any

    def stress(self, rod: Any, strains: Any) -> Any:
        """Tension along the tangent."""
        n = rod.n_elements
        pulls = (np.arange(n) >= FIRST) & (np.arange(n) < LAST)
        size = jnp.where(pulls, self.force, 0)
        x, y, z = strains.edges
        over = size / jnp.sqrt(x * x + y * y + z * z)
        return jaxrod.actuation.SectionStress(force=(over * x, over * y, over * z))

    def stability_bound(self, rod: Any) -> Any:
        """Tension makes a string of the belly."""
        half = jnp.abs(self.force) / rod.rest_lengths
        around = jnp.pad(half, (0, 1)) + jnp.pad(half, (1, 0))
        return jaxrod.extend.StabilityBound(nodes=2 * around)


@pytree
class MuscleDamping(jaxrod.extend.Effect):
    """Decay of velocities, and of each element's spin by its mass over its inertia."""

    rate: jax.Array

    def damping_rates(self, rod: Any) -> Any:
        """The two rates [1/s]."""
        return self.rate, self.rate * 4 / rod.radii**2


def _method(theirs: Collection[str]) -> Any:
    """Method of the rods."""
    return jaxrod.pyelastica() if "rods" in theirs else jaxrod.consistent()


def _damping(rate: float, theirs: Collection[str]) -> Any:
    """Damping of a rod."""
    if "damping" in theirs:
        return jaxrod.linear_damper(rate)
    return MuscleDamping(jnp.asarray(rate))


def _muscle(
    theirs: Any, n: int, start: Any, amplitude: Any, delay: Any, side: Any
) -> Any:
    """Scene and state of one muscle."""
    radii = np.full(n, TENDON)
    radii[FIRST:LAST] = BELLY
    rod, state = jaxrod.straight_rod(
        n,
        length=n * ELEMENT,
        radius=radii,
        density=MUSCLE_DENSITY,
        youngs_modulus=MUSCLE_YOUNG,
        shear_modulus=0.75 * MUSCLE_YOUNG,
        start=start,
        direction=(1.0, 0.0, 0.0),
        normal=(0.0, 0.0, 1.0),
    )
    harder = np.where(radii == TENDON, HARDER, 1.0)
    stiff = rod.shear_stretch_stiffness * harder[None, :]
    rod = replace(rod, shear_stretch_stiffness=stiff)
    scene = jaxrod.make_scene(
        rod,
        Belly(Pulse(amplitude, delay, side)),
        _damping(MUSCLE_DAMPING, theirs),
        method=_method(theirs),
    )
    return scene, state


def _muscles(group: str, theirs: Any) -> Any:
    """Scenes and states of four muscles as one member."""
    numbers = range(4) if group == "long" else range(4, 8)
    given = [muscle_numbers(number) for number in numbers]
    rows = [
        jnp.asarray([getattr(one, name) for one in given])
        for name in ("start", "amplitude", "delay", "side")
    ]
    return jax.vmap(lambda *row: _muscle(theirs, SIZES[group], *row))(*rows)


def body_on_ground(sinks: float, drag: float) -> tuple[Any, Any, Any]:
    """Our body, its state, and the effect of the ground."""
    body, of_body = jaxrod.straight_rod(
        N_BODY,
        length=LENGTH,
        radius=RADIUS,
        density=DENSITY,
        youngs_modulus=YOUNG,
        shear_modulus=0.75 * YOUNG,
        start=(0.0, 0.0, RADIUS),
        direction=(1.0, 0.0, 0.0),
        normal=(0.0, 0.0, 1.0),
    )
    line, depth = float(body.linear_density[0]), sinks * RADIUS
    # The plane is so high that the body rests on it where it is.
    ground = jaxrod.contact(
        jaxrod.shapes.plane((0.0, 0.0, depth), (0.0, 0.0, 1.0)),
        stiffness=line * G / depth,
        damping=300.0 * line,
        friction=FRICTION,
        friction_drag=drag * line,
    )
    return body, of_body, ground


def ours(
    sinks: float = 0.02, drag: float = 1000.0, *, theirs: Collection[str] = ()
) -> tuple[Any, Any]:
    """The system and its state.

    Args:
        sinks: Depth of the body in the ground at rest, over its radius.
        drag: Drag of friction at the onset of slip, over the mass per length [1/s]:
            from speeds of about mu g / drag on, friction is that of sliding.
        theirs: Parts with PyElastica's law: "rods", "joints", "damping" (with "rods").
    """
    unknown = set(theirs) - {"rods", "joints", "damping"}
    if unknown or ("damping" in theirs and "rods" not in theirs):
        raise ValueError(
            f"theirs must be of rods, joints, and damping with rods, got {theirs}"
        )
    body, of_body, ground = body_on_ground(sinks, drag)
    rate = BODY_DAMPING + MUSCLE_DAMPING
    members = {
        "body": jaxrod.make_scene(
            body,
            jaxrod.gravity((0.0, 0.0, -G)),
            ground,
            _damping(rate, theirs),
            method=_method(theirs),
        )
    }
    state = {"body": of_body}
    for group in SIZES:
        members[group], state[group] = _muscles(group, theirs)
    glues = []
    for first, group in ((0, "long"), (4, "short")):
        n = SIZES[group]
        stiffness = np.full(n, TENDON_GLUE)
        stiffness[FIRST:LAST] = BELLY_GLUE
        starts = STARTS[first : first + 4]
        glues.append(
            jaxrod.systems.glue(
                ["body"] * 4,
                [(group, k) for k in range(4)],
                state,
                stiffness=np.tile(stiffness, 4) / ELEMENT,
                damping=JOINT_DAMPING / ELEMENT if "joints" in theirs else None,
                elements=[(range(start, start + n), range(n)) for start in starts],
            )
        )
    if "joints" in theirs:
        glues = [surface_joint(glue) for glue in glues]
    return jaxrod.make_system(members, *glues, state=state), state


def theirs(
    repulsion: float = REPULSION,
    holds: float = 2.0,
    ground: Callable[[Any], None] | None = None,
) -> tuple[Any, list[Any]]:
    """PyElastica's simulator and its nine rods, the body first.

    Joints are those of its experimental module, whose constructor fails in 1.0, one
    object for all elements of a muscle: its loops over them are compiled.

    Args:
        repulsion: Stiffness of joints under pressure, over their unscaled stiffness.
            It never acts, as PyElastica takes one norm of all distances of an object.
        holds: Static friction over that of sliding; ours is 1.
        ground: Adds the ground that replaces PyElastica's plane under the body.
    """
    import elastica as ea
    from elastica._calculus import difference_kernel
    from elastica.experimental.connection_contact_joint import parallel_connection as pc

    class Simulator(
        ea.BaseSystemCollection, ea.Connections, ea.Forcing, ea.Damping, ea.Contact
    ):
        pass

    class SideJoint(pc.SurfaceJointSideBySide):
        def __init__(self, **numbers: Any) -> None:
            for name, value in numbers.items():
                setattr(self, name, value)

        def apply_forces(self, *given: Any, **named: Any) -> None:
            """Applies forces, with the time that PyElastica leaves out."""
            super().apply_forces(*given, **{"time": 0.0} | named)

        def apply_torques(self, *given: Any, **named: Any) -> None:
            """Applies torques, with the time that PyElastica leaves out."""
            super().apply_torques(*given, **{"time": 0.0} | named)

    class MuscleForces(ea.NoForces):
        def __init__(self, amplitude: float, delay: float, side: float) -> None:
            self.amplitude, self.delay, self.side = amplitude, delay, side

        def apply_forces(self, system: Any, time: Any = 0.0) -> None:
            """Differences of the tension of the belly."""
            late = time - self.delay
            wave = 0.5 + 0.5 * self.side * np.sin(2 * np.pi * late / PERIOD)
            size = self.amplitude * min(max(late, 0.0), 1.0) * wave
            pull = size * system.tangents[:, FIRST:LAST]
            system.external_forces[:, FIRST : LAST + 1] += difference_kernel(pull)

    class OtherGround(ea.NoForces):
        def __init__(self, act: Callable[[Any], None]) -> None:
            self.act = act

        def apply_forces(self, system: Any, time: Any = 0.0) -> None:
            """Loads of the ground, with its couples."""
            self.act(system)

    def rod(n: int, start: Any, radii: Any, density: float, young: float) -> Any:
        return ea.CosseratRod.straight_rod(
            n,
            np.array(start),
            np.array([1.0, 0.0, 0.0]),
            np.array([0.0, 0.0, 1.0]),
            n * ELEMENT,
            radii,
            density,
            youngs_modulus=young,
            shear_modulus=0.75 * young,
        )

    simulator = Simulator()
    body = rod(N_BODY, (0.0, 0.0, RADIUS), RADIUS, DENSITY, YOUNG)
    rods, given = [body], [muscle_numbers(number) for number in range(8)]
    for one in given:
        muscle = rod(one.n, one.start, one.radii, MUSCLE_DENSITY, MUSCLE_YOUNG)
        muscle.shear_matrix[..., :FIRST] *= HARDER
        muscle.shear_matrix[..., LAST:] *= HARDER
        rods.append(muscle)
    plane = ea.Plane(np.zeros(3), np.array([0.0, 0.0, 1.0]))
    for each in (*rods, plane):
        simulator.append(each)
    for each, rate in zip(
        rods, (BODY_DAMPING + MUSCLE_DAMPING, *[MUSCLE_DAMPING] * 8), strict=True
    ):
        simulator.dampen(each).using(
            ea.AnalyticalLinearDamper, damping_constant=rate, time_step=STEP
        )
    for number, (one, muscle) in enumerate(zip(given, rods[1:], strict=True)):
        simulator.add_forcing_to(muscle).using(
            MuscleForces, amplitude=one.amplitude, delay=one.delay, side=one.side
        )
        start = STARTS[number]
        ways = pc.get_connection_vector_straight_straight_rod(
            body, muscle, (start, start + one.n), (0, one.n)
        )
        scales = np.full(one.n, 2.0)
        scales[FIRST:LAST] = 0.05
        stiffness = np.array([glue_stiffness(r, 1.0) for r in one.radii])
        simulator.connect(
            first_rod=body,
            second_rod=muscle,
            first_connect_idx=start + np.arange(one.n),
            second_connect_idx=np.arange(one.n),
        ).using(
            SideJoint,
            k=stiffness * scales,
            nu=JOINT_DAMPING,
            k_repulsive=stiffness * repulsion,
            rod_one_direction_vec_in_material_frame=ways[0],
            rod_two_direction_vec_in_material_frame=ways[1],
            offset_btw_rods=ways[2],
        )
    simulator.add_forcing_to(body).using(
        ea.GravityForces, acc_gravity=np.array([0.0, 0.0, -G])
    )
    if ground is None:
        simulator.detect_contact_between(body, plane).using(
            ea.RodPlaneContactWithAnisotropicFriction,
            k=10.0,
            nu=40.0,
            slip_velocity_tol=1e-8,
            static_mu_array=holds * FRICTION,
            kinetic_mu_array=FRICTION,
        )
    else:
        simulator.add_forcing_to(body).using(OtherGround, act=ground)
    simulator.finalize()
    return simulator, rods

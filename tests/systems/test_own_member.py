"""A kind of member of one's own: a point mass on a spring to a place in the world."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod import extend
from jaxrod.geometry import vectors

OMEGA = 10.0
"""Angular frequency of the point on its spring [rad/s]."""


@extend.pytree
class PointState:
    """Place and velocity of one point."""

    positions: object  # (3, 1) [m]
    velocities: object  # (3, 1) [m/s]

    layout = extend.Layout(1)

    @property
    def orientations(self):
        one = jnp.zeros_like(self.positions[:1])
        return jnp.concatenate([one + 1, one, one, one])

    @property
    def rates(self):
        return self.velocities, jnp.zeros_like(self.velocities)

    def with_rates(self, velocities, spins):
        return PointState(self.positions, velocities)


def seen_motion(state):
    """The point as couplings see it: it never turns."""
    zero = jnp.zeros_like(state.positions)
    return extend.Motion(
        vectors.split(state.positions),
        tuple(state.orientations),
        vectors.split(state.velocities),
        vectors.split(zero),
    )


@extend.pytree
class Point(extend.Member):
    """One point mass on a spring to the origin."""

    mass: object  # (1,) [kg]
    stiffness: object  # [N/m]

    @property
    def dtype(self):
        return self.mass.dtype

    @property
    def array_shape(self):
        return jnp.shape(self.mass)

    def parts(self):
        return extend.Parts(
            node_masses=self.mass,
            inertias=jnp.ones((3, 1), self.dtype),
            is_rod=False,
        )

    def check_state(self, name, state, dtype):
        if state.positions.shape != (3, 1):
            raise ValueError(f"positions of {name!r} must have shape (3, 1)")

    def motion(self, state):
        return seen_motion(state)

    def stepper(self, state, parts, carried, dt):
        return PointStepper(self, parts, dt)

    def stable_step(self, bound, safety):
        stiffness = self.stiffness + (0 if bound.nodes is None else bound.nodes)
        return safety * jnp.min(2 * jnp.sqrt(self.mass / stiffness)), None

    def health(self, state, dt, limits):
        return PointHealth(~jnp.all(jnp.isfinite(state.positions)))

    def momenta(self, state):
        return self.mass[None] * state.velocities, jnp.zeros_like(state.velocities)

    def kinetic_energy(self, state):
        return 0.5 * jnp.sum(self.mass[None] * state.velocities**2)

    def potential_energy(self, state):
        return 0.5 * self.stiffness * jnp.sum(state.positions**2)

    def momentum(self, state):
        return jnp.sum(self.mass[None] * state.velocities, axis=1)

    def angular_momentum(self, state):
        turning = jnp.cross(state.positions, state.velocities, axis=0)
        return jnp.sum(self.mass[None] * turning, axis=1)


@extend.pytree
class PointHealth:
    """Whether the point is somewhere."""

    flagged: object


@extend.pytree
class PointStepper(extend.MemberStepper):
    """Position Verlet of the point."""

    point: object
    parts: object
    dt: object

    def enter(self, state):
        return seen_motion(state)

    def leave(self, motion):
        return PointState(vectors.join(motion.position), vectors.join(motion.velocity))

    def drift(self, motion, dt):
        return motion.moved(dt)

    def kick(self, motion, loads):
        force = vectors.scale(-self.point.stiffness, motion.position)
        if loads.forces is not None:
            force = vectors.add(force, loads.forces)
        gain = vectors.scale(self.dt / self.point.mass, force)
        return extend.Motion(
            motion.position,
            motion.orientation,
            vectors.add(motion.velocity, gain),
            motion.spin,
        )

    def seen(self, motion):
        return extend.Seen(self.parts, motion)


def made():
    """A point of 2 kg that starts 0.1 m from where its spring is slack."""
    mass = jnp.asarray([2.0])
    start = jnp.asarray([[0.1], [0.0], [0.0]])
    return Point(mass, mass[0] * OMEGA**2), PointState(start, jnp.zeros((3, 1)))


def test_a_point_on_a_spring_oscillates():
    point, start = made()
    system, state = jaxrod.make_system({"point": point}), {"point": start}
    dt = 1e-3
    after = jaxrod.advance(system, state, dt, 200)
    there = 0.1 * np.cos(OMEGA * 0.2)
    assert after["point"].positions[0, 0] == pytest.approx(there, abs=1e-5)
    energy = system.total_energy(state)
    assert system.total_energy(after) == pytest.approx(float(energy), rel=1e-4)
    # Position Verlet with step 2 / omega is at the edge of stability.
    assert jaxrod.stable_dt(system, 1.0).dt == pytest.approx(2 / OMEGA)
    assert not bool(jaxrod.health(system, after, dt).flagged)
    assert "'point'" in jaxrod.stable_dt(system).limiting_mode


@pytest.mark.slow
def test_a_point_hangs_on_a_rod_by_a_spring():
    point, start = made()
    rod, arm = jaxrod.straight_rod(
        4, length=0.4, radius=0.02, density=1000.0, youngs_modulus=1e6
    )
    members = {"rod": jaxrod.make_scene(rod), "point": point}
    state = {"rod": arm, "point": start}
    coupled = jaxrod.make_system(
        members, Pull("rod", "point", jnp.asarray(100.0)), state=state
    )
    dt = 0.5 * float(jaxrod.stable_dt(coupled).dt)
    after = jaxrod.advance(coupled, state, dt, 50)
    # The spring of the coupling has been at work on both.
    assert float(jnp.max(jnp.abs(after["rod"].velocities))) > 1e-3
    assert after["point"].positions[0, 0] < 0.1
    energies = [float(coupled.total_energy(one)) for one in (state, after)]
    assert energies[1] == pytest.approx(energies[0], rel=1e-3)


@extend.pytree
class Pull(extend.Coupling):
    """A spring between the first node of a rod and a point."""

    rod: str = extend.static()
    point: str = extend.static()
    stiffness: object = 0.0

    def _way(self, seen):
        start = [c[0] for c in seen[self.rod].motion.position]
        there = [c[0] for c in seen[self.point].motion.position]
        return [b - a for a, b in zip(start, there, strict=True)]

    def loads(self, seen):
        size = seen[self.rod].parts.n_nodes
        force = [self.stiffness * w for w in self._way(seen)]
        on_rod = tuple(jnp.zeros(size).at[0].set(f) for f in force)
        on_point = tuple(jnp.full(1, -f) for f in force)
        return {
            self.rod: extend.Loads(on_rod),
            self.point: extend.Loads(on_point),
        }

    def energy(self, seen):
        return 0.5 * self.stiffness * sum(w * w for w in self._way(seen))


def test_a_point_rests_where_its_spring_is_slack():
    point, state = made()
    system = jaxrod.make_system({"point": point})
    found = jaxrod.equilibrium(system, {"point": state})
    assert found.converged and found.stable and not found.loose
    np.testing.assert_allclose(found.state["point"].positions, 0, atol=1e-15)
    frequencies = jaxrod.natural_frequencies(system, found.state)
    np.testing.assert_allclose(frequencies, OMEGA, rtol=1e-12)


def test_what_needs_a_rod_or_a_body_refuses_a_point():
    point, start = made()
    rod, arm = jaxrod.straight_rod(
        4, length=0.4, radius=0.02, density=1000.0, youngs_modulus=1e6
    )
    members = {"rod": jaxrod.make_scene(rod), "point": point}
    state = {"rod": arm, "point": start}
    with pytest.raises(ValueError, match="rigid"):
        jaxrod.make_system(
            members, jaxrod.systems.attach(("rod", "base"), ("point",), state)
        )
    with pytest.raises(ValueError, match="rigid"):
        jaxrod.make_system(
            members, jaxrod.systems.body_contact("rod", "point", stiffness=1e3)
        )
    with pytest.raises(TypeError, match="must be a scene"):
        jaxrod.make_system({"point": start})


def test_a_batch_of_points_is_a_loop():
    point, start = made()
    masses = jnp.asarray([[1.0], [2.0], [3.0]])
    run = lambda mass: (
        jaxrod.advance(
            jaxrod.make_system({"point": Point(mass, point.stiffness)}),
            {"point": start},
            1e-3,
            10,
        )["point"].positions
    )
    each = [run(mass) for mass in masses]
    np.testing.assert_allclose(jax.vmap(run)(masses), jnp.stack(each), rtol=1e-6)

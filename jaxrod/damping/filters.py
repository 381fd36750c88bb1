r"""Damping of short waves: filters of velocities and spins along the rod.

With $D$ the differences of neighbours, $M$ the inertia, $r$ the velocities of nodes or
the angular velocities of elements, $g$ the decay rate, $h$ the step and $p$ the order,

$$B = M^{-1} D^T w D, \qquad r \mathrel{-}= (1 - e^{-gh})\,B^p\,r.$$

$w$ is a quarter of the mass between two nodes, or of the smaller inertia of two
elements, so that no eigenvalue of $B$ is above one. A wave of wave number $k$ on a
uniform rod with elements of length $\ell$ has the eigenvalue $\sin^2(k\ell/2)$. The
wave that alternates from node to node decays at the rate $g$; long waves decay at a
fraction of that rate, proportional to $k^{2p}$. The rigid-body motion of the rod is
removed before and restored afterwards. Momentum, angular momentum and rigid motion
therefore do not change, and energy only falls.
"""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.effects.base import Effect
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import directors, to_material, to_world
from jaxrod.geometry.vectors import Vec3
from jaxrod.loaded_rod import LoadedRod
from jaxrod.rods.motion import Motion
from jaxrod.rods.rod import Rod
from jaxrod.structure import pytree, static
from jaxrod.validation import Numbers, as_array, check_count


@pytree
class ShortWaveDamping(Effect):
    """Filter of short waves that conserves momentum; see `short_wave_damping`."""

    rate: Float[Array, ""]
    """Decay rate $g$ of motion that alternates from node to node [1/s]."""
    order: int = static(default=2)
    """Order $p$: long waves of wave number $k$ decay at rates proportional to
    $k^{2p}$."""

    def dissipate(self, scene: LoadedRod, motion: Motion, dt: Array) -> Motion:
        """Motion with filtered velocities and spins.

        Velocities and angular velocities r become r - (1 - exp(-rate dt)) B^order r,
        with the matrix B of scaled second differences along the rod. Rigid-body motion
        does not change.
        """
        body = _Body(scene.rod, motion)
        turning = motion.angular_velocities(scene.rod)
        velocity, spin = body.deforming(motion.velocity, turning)
        for _ in range(self.order):
            velocity, spin = body.roughness(velocity, spin)
        lost = body.deforming(velocity, spin)
        share = -jnp.expm1(-self.rate * dt)
        change = vectors.scale(share, lost[1])
        frame = directors(motion.orientation)
        local = to_material(frame, change)
        if not motion.spin_is_velocity:
            inertia = vectors.split(scene.rod.principal_inertias)
            local = to_world(frame, vectors.multiply(inertia, local))
        return replace(
            motion,
            velocity=vectors.subtract(motion.velocity, vectors.scale(share, lost[0])),
            spin=vectors.subtract(motion.spin, local),
        )


class _Body:
    """Inertia and geometry of a rod, to separate rigid-body from other motion."""

    def __init__(self, rod: Rod, motion: Motion) -> None:
        self.masses = rod.node_masses
        self.element_masses = rod.element_masses
        self.inertia = vectors.split(rod.principal_inertias)
        self.frame = directors(motion.orientation)
        total = jnp.sum(self.masses)
        x = motion.position
        a, b, c = (p - jnp.sum(self.masses * p) / total for p in x)
        self.places: Vec3 = (a, b, c)
        self.total = total

    def deforming(self, velocity: Vec3, turning: Vec3) -> tuple[Vec3, Vec3]:
        """Velocities and angular velocities minus those of the mean rigid motion.

        That motion has the same momentum and angular momentum.
        """
        m, r = self.masses, self.places
        a, b, c = (speed - jnp.sum(m * speed) / self.total for speed in velocity)
        orbital = vectors.scale(m, vectors.cross(r, (a, b, c)))
        spin = self._momentum(turning)
        x, y, z = (
            jnp.sum(one) + jnp.sum(two) for one, two in zip(orbital, spin, strict=True)
        )
        whole = self._turning_of((x, y, z))
        around = vectors.cross(whole, r)
        return vectors.subtract((a, b, c), around), vectors.subtract(turning, whole)

    def _momentum(self, turning: Vec3) -> Vec3:
        local = to_material(self.frame, turning)
        return to_world(self.frame, vectors.multiply(self.inertia, local))

    def _turning_of(self, momentum: Vec3) -> Vec3:
        """Angular velocity of a rigid rod with the given angular momentum [rad/s]."""
        m, r = self.masses, self.places
        squared = vectors.dot(r, r)
        rows = []
        for i in range(3):
            row = [jnp.sum(m * ((i == j) * squared - r[i] * r[j])) for j in range(3)]
            for axis, inertia in zip(self.frame, self.inertia, strict=True):
                row = [
                    c + jnp.sum(inertia * axis[i] * axis[j]) for j, c in enumerate(row)
                ]
            rows.append((row[0], row[1], row[2]))
        one, two, three = rows
        # Cramer's rule; the matrix is symmetric and positive.
        first = vectors.cross(two, three)
        second = vectors.cross(three, one)
        third = vectors.cross(one, two)
        determinant = vectors.dot(one, first)
        a, b, c = momentum
        turned = vectors.add(
            vectors.add(vectors.scale(a, first), vectors.scale(b, second)),
            vectors.scale(c, third),
        )
        return vectors.scale(1 / determinant, turned)

    def roughness(self, velocity: Vec3, turning: Vec3) -> tuple[Vec3, Vec3]:
        """Product B r = M^-1 D^T w D r, with the velocities and angular velocities r.

        M is the inertia (world frame), D takes differences of neighbours, w are weights
        along the rod.
        """
        flux = vectors.scale(
            0.25 * self.element_masses, vectors.inner_difference(velocity)
        )
        rough = vectors.scale(-1 / self.masses, vectors.difference(flux))
        least = jnp.minimum(
            jnp.minimum(self.inertia[0], self.inertia[1]), self.inertia[2]
        )
        weight = 0.25 * jnp.minimum(least[1:], least[:-1])
        flux = vectors.scale(weight, vectors.inner_difference(turning))
        a, b, c = to_material(self.frame, vectors.difference(flux))
        one, two, three = self.inertia
        return rough, to_world(self.frame, (-a / one, -b / two, -c / three))


@pytree
class LaplacianFilter(Effect):
    """PyElastica's filter of velocities and spins; see `laplacian_filter`."""

    order: int = static()
    """Number of times that the Laplacian is applied."""

    def dissipate(self, scene: LoadedRod, motion: Motion, dt: Array) -> Motion:
        """Motion with filtered velocities and spins; see `laplacian_filter`."""
        if not motion.spin_is_velocity:
            raise ValueError(
                "laplacian_filter works with method=pyelastica() only: use "
                "short_wave_damping(rate) with other methods"
            )

        def filtered(rates: Vec3) -> Vec3:
            a, b, c = (rate - self._rough(rate) for rate in rates)
            return a, b, c

        return replace(
            motion, velocity=filtered(motion.velocity), spin=filtered(motion.spin)
        )

    def _rough(self, rate: Array) -> Array:
        for _ in range(self.order):
            inner = 0.25 * (2 * rate[1:-1] - rate[2:] - rate[:-2])
            rate = vectors.pad(inner, 1, 1)
        return rate


def short_wave_damping(rate: Numbers, *, order: int = 2) -> ShortWaveDamping:
    """Damps variation from node to node, but not momenta, rigid motion or long waves.

    Steps are stable at any rate. Unlike a filter of fixed strength, this damping has
    the same effect at any step size.

    Args:
        rate: Rate at which motion that alternates from node to node decays [1/s].
        order: A wave of wave number k decays at `rate sin(k l / 2)^(2 order)` on
            elements of length l.

    Raises:
        ValueError: If an argument is out of range.

    Example:
        >>> zigzag = replace(state, velocities=state.velocities.at[2, ::2].set(1.0))
        >>> scene = jaxrod.make_scene(rod, jaxrod.short_wave_damping(1000.0))
        >>> after = jaxrod.step(scene, zigzag, 1e-4)
        >>> bool(scene.kinetic_energy(after) < 0.95 * scene.kinetic_energy(zigzag))
        True
        >>> bool(jnp.allclose(scene.momentum(after), scene.momentum(zigzag), rtol=1e-4))
        True
    """
    return ShortWaveDamping(
        as_array("rate", rate, "1/s", non_negative=True),
        check_count("order", order, 1),
    )


def laplacian_filter(order: int) -> LaplacianFilter:
    """PyElastica's `LaplaceDissipationFilter`, for `method=pyelastica()`.

    The second difference along the rod, divided by -4 and set to zero at both ends, is
    applied `order` times to each component of velocities and angular velocities. Every
    step subtracts the result. The strength per step does not depend on the step size,
    and momentum is lost near the ends. Other methods reject this filter when they step:
    use `short_wave_damping`, which has a rate, with them.

    Args:
        order: Number of times that the Laplacian is applied; 3 to 7 are usual in
            PyElastica.

    Raises:
        ValueError: If it is not a positive integer.

    Example:
        >>> filtered = jaxrod.make_scene(
        ...     rod, jaxrod.laplacian_filter(5), method=jaxrod.pyelastica()
        ... )
        >>> zigzag = replace(state, velocities=state.velocities.at[2, ::2].set(1.0))
        >>> after = jaxrod.step(filtered, zigzag, 1e-6)
        >>> zigzag.velocities[2, 4:7].tolist()
        [1.0, 0.0, 1.0]
        >>> after.velocities[2, 4:7].round(2).tolist()  # only the mean is left
        [0.5, 0.5, 0.5]
    """
    return LaplacianFilter(check_count("order", order, 1))

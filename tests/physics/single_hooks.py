"""Effects that use one hook alone, all of them in the zx plane, for contracts.

What a hook puts somewhere also stands still there: rates of what `constrain` holds are
those of `constrain_rates`.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp

import jaxrod
from jaxrod.effects.ends import Wall
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import directors, to_material
from jaxrod.structure import pytree


@pytree
class Forces(jaxrod.extend.Effect):
    """Ties nodes to the origin."""

    size: jax.Array

    def loads(self, rod, motion):
        return jaxrod.extend.Loads(
            forces=vectors.scale(-3e3 * self.size, motion.position)
        )


@pytree
class Couples(jaxrod.extend.Effect):
    """Turns elements towards the z axis."""

    size: jax.Array

    def loads(self, rod, motion):
        d1, d2, _ = directors(motion.orientation)
        across = vectors.scale(300 * self.size, (-d2[2], d1[2], 0 * d1[2]))
        return jaxrod.extend.Loads(couples=across)


@pytree
class Drag(jaxrod.extend.Effect):
    """Resists the motion of nodes."""

    size: jax.Array

    def loads(self, rod, motion):
        return jaxrod.extend.Loads(
            forces=vectors.scale(-100 * self.size, motion.velocity)
        )


@pytree
class Friction(jaxrod.extend.Effect):
    """Resists the turning of elements."""

    size: jax.Array

    def loads(self, rod, motion):
        turning = motion.angular_velocities(rod)
        couples = to_material(directors(motion.orientation), turning)
        return jaxrod.extend.Loads(couples=vectors.scale(-0.5 * self.size, couples))


@pytree
class Strings(jaxrod.extend.Effect):
    """Tightens edges, which in a compensated state are not those of its positions."""

    size: jax.Array

    def loads(self, rod, motion):
        pull = vectors.scale(1e4 * self.size, motion.edges)
        return jaxrod.extend.Loads(forces=vectors.difference(pull))


@pytree
class Place(jaxrod.extend.Effect):
    """Puts the last node somewhere."""

    size: jax.Array

    def constrain(self, rod, motion):
        x, y, z = motion.position
        put = lambda c, to: c.at[-1].set(jnp.where(self.size > 0, to, c[-1]))
        return replace(motion, position=(put(x, 1 + 2e-3 * self.size), y, put(z, 2e-3)))

    def constrain_rates(self, rod, motion):
        x, y, z = motion.velocity
        stop = lambda c: c.at[-1].set(jnp.where(self.size > 0, 0, c[-1]))
        return replace(motion, velocity=(stop(x), y, stop(z)))


@pytree
class Frame(jaxrod.extend.Effect):
    """Turns the first element somewhere."""

    size: jax.Array

    def wall(self, rod):
        # About the y axis, from a frame of quaternion (1, 1, 1, 1) / 2.
        angle = 0.01 * self.size
        less, more = jnp.cos(angle) - jnp.sin(angle), jnp.cos(angle) + jnp.sin(angle)
        return Wall(0.5 * jnp.stack([less, more, more, less]))

    def constrain(self, rod, motion):
        put = lambda c, to: c.at[0].set(jnp.where(self.size > 0, to, c[0]))
        w, x, y, z = map(put, motion.orientation, self.wall(rod).orientation)
        return replace(motion, orientation=(w, x, y, z))

    def constrain_rates(self, rod, motion):
        stop = lambda c: c.at[0].set(jnp.where(self.size > 0, 0, c[0]))
        return replace(motion, spin=tuple(map(stop, motion.spin)))


@pytree
class Pace(jaxrod.extend.Effect):
    """Moves a node at a given velocity."""

    size: jax.Array

    def constrain_rates(self, rod, motion):
        x, y, z = motion.velocity
        put = lambda c, to: c.at[1].set(jnp.where(self.size > 0, to, c[1]))
        return replace(motion, velocity=(put(x, self.size), y, put(z, 0.5)))


@pytree
class Damping(jaxrod.extend.Effect):
    """Lets rates decay."""

    size: jax.Array

    def damping_rates(self, rod):
        return 100 * self.size, 50 * self.size


@pytree
class Viscous(jaxrod.extend.Effect):
    """Slows nodes along the rod, and faster across it."""

    reach = "neighbours"
    size: jax.Array

    def drag(self, rod, motion):
        return jaxrod.fluids.Drag(along=50 * self.size, across=200 * self.size)

    def loads(self, rod, motion):
        return jaxrod.fluids.drag_loads(rod, motion, self.drag(rod, motion))


@pytree
class Slowing(jaxrod.extend.Effect):
    """Lets rates decay by itself."""

    size: jax.Array

    def dissipate(self, scene, motion, dt):
        velocity = vectors.scale(1 - 100 * self.size * dt, motion.velocity)
        spin = vectors.scale(1 - 50 * self.size * dt, motion.spin)
        return replace(motion, velocity=velocity, spin=spin)


HOOKS = (
    Forces,
    Couples,
    Drag,
    Friction,
    Strings,
    Place,
    Frame,
    Pace,
    Damping,
    Viscous,
    Slowing,
)

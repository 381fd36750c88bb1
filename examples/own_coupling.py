"""A custom coupling: a tether, slack within its length and elastic beyond.

A ball is tied to the tip of an arm and dropped: it falls, is caught, and bounces.
"""

import jax.numpy as jnp

import jaxrod
from jaxrod import extend, shapes, systems
from jaxrod.extend import vectors


@extend.pytree
class Tether(extend.Coupling):
    """Pulls two points together if their distance exceeds its length."""

    a: extend.Anchors
    b: extend.Anchors
    length: extend.Leaf  # [m]
    stiffness: extend.Leaf  # [N/m]

    def gap(self, seen):
        """Vector between the anchors, and the elongation [m]."""
        ends = [end.positions(seen[end.points.member]) for end in (self.a, self.b)]
        gap = vectors.subtract(ends[1], ends[0])
        return gap, jnp.maximum(vectors.safe_norm(gap) - self.length, 0.0)

    def loads(self, seen):
        """A force on each end, along the line between them."""
        gap, stretch = self.gap(seen)
        force = vectors.scale(self.stiffness * stretch / (self.length + stretch), gap)
        given = []
        for end, push in ((self.a, force), (self.b, vectors.scale(-1.0, force))):
            view = seen[end.points.member]
            given.append((end.points, end.loads(view, push, end.positions(view))))
        return extend.sum_of_loads(*given, seen=seen)

    def energy(self, seen):
        """Elastic energy [J]."""
        return jnp.sum(0.5 * self.stiffness * self.gap(seen)[1] ** 2)

    def stability_bounds(self, parts):
        """Bounds of a spring that is always taut."""
        return extend.spring_bounds(self.a, self.b, parts, self.stiffness)


def dropped(slack=0.1):
    """A system of an arm and a ball tied to its tip, and its state."""
    x, material = (1.0, 0.0, 0.0), {"density": 1000.0, "youngs_modulus": 1e7}
    rod, arm = jaxrod.straight_rod(10, length=0.5, radius=0.01, direction=x, **material)
    fall, shape = (jaxrod.gravity(),), shapes.sphere((0.5, 0.0, -0.05), 0.02)
    ball, still = systems.rigid_body(shape, density=500.0, effects=fall)
    state = {"arm": arm, "ball": still}
    ends = [extend.anchors([place], state) for place in (("arm", "tip"), ("ball",))]
    tether = Tether(*ends, length=0.05 + slack, stiffness=200.0)
    members = {"arm": jaxrod.make_scene(rod, jaxrod.clamp(arm)), "ball": ball}
    return jaxrod.make_system(members, tether, state=state), state

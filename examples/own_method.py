"""A custom method: symplectic Euler steps of the consistent law.

Position Verlet drifts half a step, kicks, and drifts half a step. Symplectic Euler
kicks and drifts a whole step. It is as stable, but of first order.
"""

import jax.numpy as jnp

import jaxrod
from jaxrod import extend

CONSISTENT = jaxrod.consistent()


@extend.pytree
class EulerStepper:
    """The step that a run repeats in its loop."""

    verlet: object  # the stepper of the consistent law
    dt: object  # step [s]
    steps_of_end = 0  # steps that `end` finishes

    def begin(self, state):
        """The motion of a state."""
        return self.verlet.enter(state)

    def cycle(self, motion):
        """One step."""
        return self.verlet.drift(self.verlet.kick(motion), self.dt)

    def end(self, motion):
        """The state of a motion."""
        return self.verlet.leave(motion)


@extend.pytree
class SymplecticEuler(extend.Method):
    """Kick, then drift; drag is solved with the kick."""

    solves_drag = True

    def stepper(self, scene, state, dt):
        """The stepper of a run, with its constants."""
        return EulerStepper(CONSISTENT.stepper(scene, state, dt), dt)


def swing(method, steps, seconds=0.1):
    """Position of the tip of a released arm after some steps [m]."""
    material = {"radius": 0.01, "density": 1000.0, "youngs_modulus": 1e6}
    rod, state = jaxrod.straight_rod(8, length=0.3, **material)
    effects = jaxrod.clamp(state), jaxrod.gravity((0.0, -9.81, 0.0))
    scene = jaxrod.make_scene(rod, *effects, method=method)
    return jaxrod.advance(scene, state, seconds / steps, steps).tip


if __name__ == "__main__":
    jaxrod.configure_cpu()
    for steps in (500, 1000):
        apart = swing(SymplecticEuler(), steps) - swing(CONSISTENT, steps)
        print(f"{steps} steps: {float(jnp.linalg.norm(apart)):.1e} m from Verlet's")

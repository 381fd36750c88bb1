"""A network learns what a model lacks, through equilibria and through a motion.

The true rod stiffens as it bends. The model is linear, and a small network adds an
energy of bending to it. It learns from four poses under loads and from one swing.
"""

import jax
import jax.numpy as jnp

import jaxrod
from jaxrod import actuation, extend

SCALE, WIDEST, UNITS = 0.01, 20.0, 3  # energy [J/m], curvature [1/m], hidden units
TAUGHT, NEW, NOISE = (0.02, 0.05, 0.1, 0.2), (0.0, 0.035, 0.15), 1e-4  # loads [N]; [m]


@extend.pytree
class Truth(actuation.SectionLoad):
    """The missing part: an energy per length of the squared curvature."""

    def stored(self, rod, strains):
        """Stored energy [J] of the inner joints; without `walls` ends do not bend."""
        one, two, _ = (angle[1:-1] for angle in strains.rotations)
        bend = (one**2 + two**2) / (WIDEST * rod.joint_lengths) ** 2
        return SCALE * jnp.sum(rod.joint_lengths * self.density(bend))

    def density(self, bend):
        """Energy per length, over SCALE, at squared curvatures over WIDEST^2."""
        return bend**2


@extend.pytree
class Learned(Truth):
    """A network with one hidden layer: w2 . (tanh(w1 bend + b) - tanh(b))."""

    weights: extend.Leaf  # rows w1, b, w2

    def density(self, bend):
        """The same by the network; zero for a straight rod."""
        w1, b, w2 = self.weights[..., None]
        return jnp.sum(w2 * (jnp.tanh(w1 * bend[None] + b) - jnp.tanh(b)), axis=0)


def scene_of(extra, load):
    """A clamped rod with an extra energy and a load at its tip, and its state."""
    sizes = {"length": 0.3, "radius": 0.006, "direction": (1.0, 0.0, 0.0)}
    rod, state = jaxrod.straight_rod(8, density=1100.0, youngs_modulus=5e5, **sizes)
    effects = (jaxrod.gravity(), jaxrod.end_load(force=(0.0, 0.0, -load)), extra)
    return jaxrod.make_scene(rod, jaxrod.clamp(state), *effects), state


def seen(extra, loads=TAUGHT, steps=600):
    """Nodes at rest under each load, and the tip in a swing without a load [m]."""
    rest = lambda load: jaxrod.equilibrium(*scene_of(extra, load)).state.positions
    swing = jaxrod.rollout(*scene_of(extra, 0.0), 2e-4, steps, steps // 20).tip
    return {"poses": jax.vmap(rest)(jnp.asarray(loads)), "swing": swing}


def learn():
    """Weights that agree with what is seen of the truth, with a prior at the start."""
    rows = jnp.linspace(0.5, 2.0, UNITS), jnp.linspace(-1.0, 1.0, UNITS)
    start = {"weights": jnp.stack([*rows, jnp.zeros(UNITS)])}
    noise = {"poses": NOISE, "swing": NOISE, "weights": 1.0}
    made = lambda p: seen(Learned(**p)) | p
    data = seen(Truth()) | start
    return jaxrod.control.fit(made, data, start, noise=noise, logarithmic=False).values


def errors(weights):
    """Largest distances from the truth in new poses and in a longer swing [m]."""
    made, true = (seen(extra, NEW, 1200) for extra in (Learned(weights), Truth()))
    return {name: float(jnp.max(jnp.abs(made[name] - true[name]))) for name in made}


if __name__ == "__main__":
    jaxrod.configure_cpu()
    with jax.enable_x64(True):
        learned = learn()["weights"]
        for name, weights in (("without", 0 * learned), ("with", learned)):
            print(f"{name} the network: at most", errors(weights), "m off")

"""A network learns what a model lacks, through equilibria and through a motion.

The true rod stiffens as it bends. The model is linear, and a small network adds an
energy of bending to it. It learns from four poses under loads and from one swing.
"""

import jax
import jax.numpy as jnp

import jaxrod
from jaxrod import actuation, control, extend

SCALE, WIDEST, UNITS = 0.01, 20.0, 4  # energy [J/m], curvature [1/m], hidden units
TAUGHT, NEW = (0.02, 0.05, 0.1, 0.2), (0.0, 0.035, 0.15)  # tip loads [N]
NOISE = 1e-4  # of measured points [m]


class Bending(actuation.SectionLoad):
    """Energy per length [J/m] of the squared curvature over WIDEST^2."""

    def stored(self, rod, strains):
        """Stored energy [J]."""
        one, two, _ = (angle[1:-1] for angle in strains.rotations)
        bend = (one**2 + two**2) / (WIDEST * rod.joint_lengths) ** 2
        return SCALE * jnp.sum(rod.joint_lengths * self.density(bend))


@extend.pytree
class Truth(Bending):
    """The stiffening that the model lacks."""

    def density(self, bend):
        """Energy per length, over SCALE."""
        return bend**2


@extend.pytree
class Learned(Bending):
    """A network of one hidden layer: w2 . (tanh(w1 bend + b) - tanh(b))."""

    weights: extend.Leaf  # rows w1, b, w2

    def density(self, bend):
        """Energy per length, over SCALE; zero for a straight rod."""
        w1, b, w2 = self.weights[..., None]
        return jnp.sum(w2 * (jnp.tanh(w1 * bend + b) - jnp.tanh(b)), axis=0)


def scene_of(extra, load):
    """A clamped rod with an extra energy and a load at its tip, and its state."""
    material = {"radius": 0.006, "density": 1100.0, "youngs_modulus": 5e5}
    rod, state = jaxrod.straight_rod(
        12, length=0.3, direction=(1.0, 0.0, 0.0), **material
    )
    effects = (jaxrod.gravity(), jaxrod.end_load(force=(0.0, 0.0, -load)), extra)
    return jaxrod.make_scene(rod, jaxrod.clamp(state), *effects), state


def poses(extra, loads):
    """Nodes at rest under each load, shape (loads, 13, 3) [m]."""
    rest = lambda load: jaxrod.equilibrium(*scene_of(extra, load)).state.positions
    return jax.vmap(rest)(jnp.asarray(loads))


def swing(extra, steps=1000, every=50):
    """Tip over time [m], from straight and without a load."""
    return jaxrod.rollout(*scene_of(extra, 0.0), 1e-4, steps, every).tip


def learn(loads=TAUGHT):
    """Weights that agree with the true poses and swing, with a prior about zero."""

    def seen(p):
        net = Learned(p["weights"])
        return {"poses": poses(net, loads), "swing": swing(net), "prior": p["weights"]}

    w1, b = jnp.linspace(0.5, 2.0, UNITS), jnp.linspace(-1.0, 1.0, UNITS)
    start = jnp.stack([w1, b, jnp.zeros(UNITS)])
    truth = {"poses": poses(Truth(), loads), "swing": swing(Truth()), "prior": start}
    noise = {"poses": NOISE, "swing": NOISE, "prior": 1.0}
    found = control.fit(seen, truth, {"weights": start}, noise=noise, logarithmic=False)
    return found.values["weights"]


if __name__ == "__main__":
    with jax.enable_x64(True):
        true, bare = poses(Truth(), NEW), Learned(jnp.zeros((3, UNITS)))
        for name, extra in (("without", bare), ("with", Learned(learn()))):
            off = 1000 * float(jnp.max(jnp.abs(poses(extra, NEW) - true)))
            print(f"new poses are at most {off:.3f} mm off {name} the network")

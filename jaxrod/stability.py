r"""The largest safe time step of a scene, and which mode of motion sets it.

Position Verlet is stable while $h\,\omega_{\max} < 2$. The highest frequency is
bounded element by element (Irons' bound: the highest frequency of an assembly is not
above the highest of its parts), which holds for any taper and any stiffness:

$$\Omega_k^2 = \frac{4\alpha_c GA}{\rho A\,\hat\ell^2}
  + \frac{\alpha_c GA + 4 EI/\hat\ell^2}{\rho I},\qquad
  \frac{4 EA}{\rho A\,\hat\ell^2},\qquad \frac{4 GJ}{\rho J\,\hat\ell^2}$$

for shear with bending, for stretch, and for twist; $h = 2S/\max_k\Omega_k$. The bound
is for the straight rod; under the consistent law no deformed state exceeds it by more
than a tenth, which the default safety factor covers, while under PyElastica's law
frequencies grow as one over the stretch when the rod is compressed.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int

from jaxrod import vectors
from jaxrod._pytree import pytree
from jaxrod._validation import check_array
from jaxrod.rod import Rod
from jaxrod.scene import Scene

MODE_NAMES = ("shear and bending", "stretch", "twist")


@pytree
class StableStep:
    """A time step and what limits it."""

    dt: Float[Array, ""]
    """The largest safe step [s]."""
    element: Int[Array, ""]
    """The element with the highest frequency."""
    mode: Int[Array, ""]
    """Index into `MODE_NAMES` of the limiting motion."""
    angular_frequency: Float[Array, ""]
    """Bound on the highest angular frequency [rad/s]."""

    @property
    def limiting_mode(self) -> str:
        """The limiting motion in words; for concrete values only."""
        return f"{MODE_NAMES[int(self.mode)]} of element {int(self.element)}"


def stable_dt(scene: Scene, safety: ArrayLike = 0.8) -> StableStep:
    """The largest step at which a scene is stable, times a safety factor.

    Args:
        scene: The scene.
        safety: Fraction of the bound to use, in (0, 1]: 0.5 is cautious, 0.9 fast.

    Returns:
        The step, and which element and motion limit it.

    Raises:
        ValueError: If `safety` is not in (0, 1].
    """
    factor = check_array("safety", safety, [()], "", positive=True)
    if not isinstance(factor, jax.core.Tracer) and factor > 1:
        raise ValueError(f"safety must be at most 1, got {factor:g}")
    return _stable_dt(scene, jnp.asarray(factor, scene.rod.rest_lengths.dtype))


@jax.jit
def _stable_dt(scene: Scene, safety: Array) -> StableStep:
    squares = squared_frequencies(scene)
    flat = jnp.argmax(squares)
    mode, element = jnp.divmod(flat, squares.shape[1])
    frequency = jnp.sqrt(jnp.max(squares))
    return StableStep(2 * safety / frequency, element, mode, frequency)


def squared_frequencies(scene: Scene) -> Float[Array, "3 n"]:
    """Bounds on the squared angular frequencies [rad^2/s^2].

    One row per entry of `MODE_NAMES`, one column per element.
    """
    rod = scene.rod
    transverse, polar = rod.rotary_inertia
    shear = jnp.max(rod.shear_stretch_stiffness[:2], axis=0)
    four = 4 / rod.rest_lengths**2
    bend = jnp.maximum(
        _largest_joint_frequency(rod, rod.joint_stiffness[0], transverse),
        _largest_joint_frequency(rod, rod.joint_stiffness[1], transverse),
    )
    twist = _largest_joint_frequency(rod, rod.joint_stiffness[2], polar)
    # A wall acts on an end element through half a length: as stiff as its own joint.
    bend = jnp.maximum(
        bend, four * jnp.max(rod.bend_twist_stiffness[:2], axis=0) / transverse
    )
    twist = jnp.maximum(twist, four * rod.bend_twist_stiffness[2] / polar)
    return jnp.stack(
        [
            (four / rod.linear_density + 1 / transverse) * shear + bend,
            four * rod.shear_stretch_stiffness[2] / rod.linear_density,
            twist,
        ]
    )


def _largest_joint_frequency(rod: Rod, stiffness: Array, inertia: Array) -> Array:
    """Squared frequency of each element's stiffer joint, with half its inertia."""
    halves = 2 / (inertia * rod.rest_lengths)
    squares = stiffness / rod.joint_lengths * (halves[1:] + halves[:-1])
    return jnp.maximum(vectors.pad(squares, 0, 1), vectors.pad(squares, 1, 0))

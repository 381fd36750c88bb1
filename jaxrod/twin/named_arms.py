"""Arms that exist, with the numbers of their makers, and those fitted to recordings."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxrod.actuation.tendons import tendon
from jaxrod.effects.clamps import clamp
from jaxrod.effects.loads import exponential_damping, gravity
from jaxrod.effects.time import Timed, as_timed
from jaxrod.rods.factories import straight_rod
from jaxrod.rods.rod import RodState
from jaxrod.scene import Scene, make_scene
from jaxrod.validation import Numbers, as_array, check_count

_LENGTH = 0.36
_RADII = (0.0, 0.305, 0.36), (0.01541, 0.00642, 0.0048)
"""Arc lengths, and radii there [m]."""
_UNTIL = 0.305
"""Arc length where the tendons end [m]."""
_POISSON_RATIO = 0.45
# From the drawing: 11.4 mm at the base, less 0.0295 s at arc length s; 30 and 150
# degrees. Fitted: a factor, a slope and two angles.
_DISTANCE, _SLOPE = 1.00553 * 0.0114, 0.00690 - 1.00553 * 0.0295
_ANGLES = np.radians([30.0, 150.0]) + np.array([-0.07882, 0.00524])
_YOUNGS_MODULUS, _DENSITY = 5.610e5, 1000.0


def tentacle(
    tension: Timed = (0.0, 0.0),
    *,
    n_elements: int = 36,
    damping: Numbers = 5.0,
    dtype: Any = None,
) -> tuple[Scene, RodState]:
    """A tapered silicone arm of 36 cm that hangs from a clamp and has two tendons.

    It is a real arm, of which poses under tensions up to 7.7 N have been recorded.
    Length, radii, Poisson's ratio and the course of the tendons are those of its
    makers. `python -m benchmarks tentacle FOLDER` has fitted Young's modulus (561 kPa),
    density (1000 kg/m^3), and the distances and angles of the tendons to eight of the
    recorded poses. Nothing is known of the damping.

    The model is 13 mm off at the tip in these eight poses, and 16 mm in nine others
    (root mean square). The model of the makers is 36 mm off in the eight.

    Args:
        tension: Tensions of the tendons `(2,)`, or a schedule of them, at least 0 [N].
        n_elements: Number of elements, at least 4.
        damping: Decay rate of velocities, at least 0 [1/s].
        dtype: Floating-point dtype; by default JAX's default.

    Returns:
        The scene and its straight state. The base is at the origin, the arm hangs along
        -z, and d1 is along y. The effects are clamp, gravity, tendons and damping.

    Raises:
        ValueError: A number is out of range or of the wrong shape.

    Source:
        Geometry and poses: repository tud-phi/soromox on GitHub (MIT licence, SoRoMoX
        contributors), folder paper_results/secVa_system_identification.

    Example:
        >>> scene, hanging = twin.tentacle((3.0, 0.0))
        >>> scene.rod.n_elements, round(float(hanging.tip[2]), 3)
        (36, -0.36)
    """
    n = check_count("n_elements", n_elements, 4)
    pull = as_timed("tension", tension, "N", (2,))
    middles = (np.arange(n) + 0.5) * _LENGTH / n
    rod, state = straight_rod(
        n,
        length=_LENGTH,
        radius=np.interp(middles, *_RADII),
        density=_DENSITY,
        youngs_modulus=_YOUNGS_MODULUS,
        poisson_ratio=_POISSON_RATIO,
        direction=(0.0, 0.0, -1.0),
        normal=(0.0, 1.0, 0.0),
        dtype=dtype,
    )
    last = int(np.sum(middles < _UNTIL)) - 1
    distance = _DISTANCE + _SLOPE * middles[: last + 1]
    across = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
    tendons = tendon(
        rod,
        jnp.asarray(across[:, :, None] * distance, rod.rest_lengths.dtype),
        tension=pull,
        elements=(0, last),
    )
    effects = clamp(state), gravity((0.0, 0.0, -9.81)), tendons
    return make_scene(rod, *effects, exponential_damping(damping)), state


_BACKBONE = 0.25
"""Length of the backbone of the robot with disks [m]."""
_HOLES = (0.00700 + 0.00717 + 0.00717) / 3
"""Mean distance of the three holes of a disk from its centre [m]."""


def disk_robot(
    pull: Numbers = (0.0, 0.0, 0.0),
    *,
    distance: Numbers = _HOLES,
    youngs_modulus: Numbers = 6e10,
    n_elements: int = 40,
    damping: Numbers = 5.0,
    dtype: Any = None,
) -> tuple[Scene, RodState]:
    r"""A tendon-driven continuum robot: a backbone of 25 cm, disks and three tendons.

    It is a real robot, and a motor pulls each tendon in by a given length $q$. If the
    backbone is not compressed, it bends to the angle $q / r$ with tendons at the
    distance $r$ from the axis. The height of the tip is then $L \sin(q/r) / (q/r)$.

    The makers publish the length, the course of the tendons, and the height of the tip
    for pulls of 5 and 10 mm. Their model is 14.0 mm off in these six heights (root mean
    square), with tendons at 6 mm from the axis. The holes in their drawing of a disk
    are at 7.00, 7.17 and 7.17 mm. We take the mean, and fit nothing.

    We found no numbers of the tube, the stiffness of the tendons, the weight or the
    damping in the texts of the makers. We assume a solid rod of 1 mm, a modulus of
    60 GPa, tendons that hardly stretch, and no gravity. The tip at rest hardly depends
    on the modulus. Forces and motions do: do not trust them.

    Args:
        pull: Lengths by which the tendons are pulled in `(3,)` [m]. A tendon with zero
            is slack.
        distance: Distance of the tendons from the axis, above 0 [m].
        youngs_modulus: Young's modulus of the assumed rod, above 0 [Pa].
        n_elements: Number of elements, at least 4.
        damping: Decay rate of velocities, at least 0 [1/s].
        dtype: Floating-point dtype; by default JAX's default.

    Returns:
        The scene and its straight state. The base is at the origin, the robot stands
        along z, and d1 is along x. The tendons are at 0, 120 and 240 degrees from d1.
        The effects are clamp, tendons and damping.

    Raises:
        ValueError: A number is out of range or of the wrong shape.

    Source:
        Repository mohamad-nouredeen/tdcr-cosserat-robot-platform on GitHub, by Mohamad
        Nour Edeen: README.md, mechanical/README.md (the disk) and
        experiments/README.md (the heights).

    Example:
        >>> scene, straight = twin.disk_robot((0.005, 0.0, 0.0))
        >>> scene.rod.n_elements, round(float(straight.tip[2]), 3)
        (40, 0.25)
    """
    n = check_count("n_elements", n_elements, 4)
    rod, state = straight_rod(
        n,
        length=_BACKBONE,
        radius=0.0005,
        density=6450.0,
        youngs_modulus=youngs_modulus,
        poisson_ratio=0.3,
        direction=(0.0, 0.0, 1.0),
        normal=(1.0, 0.0, 0.0),
        dtype=dtype,
    )
    kind = rod.rest_lengths.dtype
    pulled = as_array("pull", pull, "m", [(3,)], non_negative=True, dtype=kind)
    apart = as_array("distance", distance, "m", positive=True, dtype=kind)
    angles = np.radians([0.0, 120.0, 240.0])
    across = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    # Cables reach from the middle of the first element to that of the last.
    straight = _BACKBONE * (n - 1) / n
    tendons = tendon(
        rod,
        apart * jnp.asarray(across, kind),
        length=jnp.where(pulled > 0.0, straight - pulled, 2.0 * straight),
        stiffness=1e5,
        onset=1e-5,
    )
    return make_scene(rod, clamp(state), tendons, exponential_damping(damping)), state

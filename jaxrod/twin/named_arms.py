"""Arms and rods that exist, with numbers of their makers or fitted to recordings."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxrod.actuation.tendons import tendon
from jaxrod.effects.clamps import clamp
from jaxrod.effects.loads import end_load, exponential_damping, gravity
from jaxrod.effects.time import Timed, as_timed
from jaxrod.rods.factories import straight_rod
from jaxrod.rods.rod import RodState
from jaxrod.rods.sections import CIRCLE, Section
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

_BACKBONE = 0.25
"""Length of the backbone of the robot with disks [m]."""
_HOLES = (0.00700 + 0.00717 + 0.00717) / 3
"""Mean distance of the three holes of a disk from its centre [m]."""

_INCH = 0.0254
_FREE = 74 * _INCH
"""Length of the fly rod in front of the handle [m]."""
_STATIONS = _INCH * np.array([*range(0, 81, 5), 84])
"""Distances from the tip [m]."""
_WIDTHS = 1e-3 * _INCH * np.array([
    75, 77, 85, 102, 120, 133, 143, 161, 182,
    203, 220, 225, 245, 262, 274, 295, 306, 302,
])  # fmt: skip
"""Widths across flats there [m]."""


def tentacle(
    tension: Timed = (0.0, 0.0),
    *,
    n_elements: int = 36,
    damping: Numbers = 5.0,
    dtype: Any = None,
) -> tuple[Scene, RodState]:
    """A tapered silicone arm of 36 cm that hangs from a clamp and has two tendons.

    It is a real arm. Its makers have recorded poses under tensions up to 7.7 N.
    Length, radii, Poisson's ratio and the course of the tendons are those of its
    makers. `python -m benchmarks tentacle FOLDER` has fitted Young's modulus (561 kPa),
    density (1000 kg/m^3), and the distances and angles of the tendons to eight of the
    recorded poses. The real damping is unknown.

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
        pull: Lengths by which the tendons are pulled in `(3,)`, at most the length of a
            tendon, 0.25 (n - 1) / n [m]. A tendon with zero is slack.
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
    apart = as_array("distance", distance, "m", positive=True, dtype=kind)
    angles = np.radians([0.0, 120.0, 240.0])
    across = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    # Cables reach from the middle of the first element to that of the last.
    straight = _BACKBONE * (n - 1) / n
    pulled = as_array(
        "pull", pull, "m", [(3,)], at_least=0.0, at_most=straight, dtype=kind
    )
    tendons = tendon(
        rod,
        apart * jnp.asarray(across, kind),
        length=jnp.where(pulled > 0.0, straight - pulled, 2.0 * straight),
        stiffness=1e5,
        onset=1e-5,
    )
    return make_scene(rod, clamp(state), tendons, exponential_damping(damping)), state


def fly_rod(
    force: Timed = (0.0, 0.0, 0.0),
    *,
    youngs_modulus: Numbers = 4.826e10,
    density: Numbers = 961.0,
    n_elements: int = 37,
    damping: Numbers = 1.0,
    dtype: Any = None,
) -> tuple[Scene, RodState]:
    """A tapered bamboo fly rod, 1.88 m long, that its handle holds level.

    It is a real rod. Its maker measured the width of the hexagonal sections at 18
    stations, and how far five stations sink under weights up to 40.6 g at the tip. He
    did so in four series, the last two with the guides on top of the rod. Young's
    modulus, 7e6 psi, is his estimate, made with such measurements. So is the density,
    60 lb/ft^3: the bamboo barely floated in water.

    With these numbers the rod differs from the mean of the four series by 4.6 mm (root
    mean square). The means of the first two and of the last two series differ by
    6.1 mm. Under the largest weight the tip sinks by 464 mm.

    Widths are taken across flats, as is usual for such rods. Varnish and guides are
    left out. Nothing is known of the damping and of Poisson's ratio. The ratio is set
    to 0.3: bending hardly depends on it, but twist does.

    Args:
        force: Force on the tip `(3,)`, or a schedule of it [N].
        youngs_modulus: Young's modulus [Pa].
        density: Mass density [kg/m^3].
        n_elements: Number of elements, at least 4. With multiples of 37 the measured
            stations are nodes.
        damping: Decay rate of velocities, at least 0 [1/s].
        dtype: Floating-point dtype; by default JAX's default.

    Returns:
        The scene and its straight state. The base is at the origin and the rod points
        along x. The effects are clamp, gravity along -z, the force and damping.

    Raises:
        ValueError: A number is out of range or of the wrong shape.

    Source:
        Geometry and measurements: repository RHexMan/RHex on GitHub, file
        SpecFiles_Rod/CattanachSirD7ft4wt_RM.txt, by Rich Miller (2017).

    Example:
        >>> scene, level = twin.fly_rod((0.0, 0.0, -0.4))
        >>> bent = jaxrod.equilibrium(scene, level).state
        >>> round(float(bent.tip[2]), 2)
        -0.48
    """
    n = check_count("n_elements", n_elements, 4)
    middles = (np.arange(n) + 0.5) * _FREE / n
    width = np.interp(_FREE - middles, _STATIONS, _WIDTHS)
    area, moment = 3**0.5 / 2 * width**2, 5 * 3**0.5 / 144 * width**4
    hexagon = Section(
        area,
        (moment, moment),
        0.115 * width**4,
        (CIRCLE, CIRCLE),
        np.sqrt(area / np.pi),
        is_round=True,
    )
    rod, state = straight_rod(
        n,
        length=_FREE,
        section=hexagon,
        density=density,
        youngs_modulus=youngs_modulus,
        poisson_ratio=0.3,
        direction=(1.0, 0.0, 0.0),
        normal=(0.0, 1.0, 0.0),
        dtype=dtype,
    )
    effects = clamp(state), gravity((0.0, 0.0, -9.81)), end_load(force)
    return make_scene(rod, *effects, exponential_damping(damping)), state

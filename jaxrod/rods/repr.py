"""One-line descriptions of rods, states and scenes, for notebooks and debuggers."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

_PREFIXES = {9: "G", 6: "M", 3: "k", 0: ""}


def rod_repr(rod: Any) -> str:
    """Describes a rod by its elements, sizes and material, as far as they are known.

    Nothing is computed on a device. Traced numbers, and leaves that are not arrays (JAX
    makes such rods while it transforms them), are left out. For batches and for rods
    that vary along their length the range is given. Young's modulus and density are
    those of a solid round section with the same axial stiffness and mass.
    """
    lengths, radii = _known(rod.rest_lengths), _known(rod.radii)
    words = [_elements(rod.rest_lengths)]
    with np.errstate(all="ignore"):
        if lengths is not None:
            words.append(_range(lengths.sum(axis=-1), "m"))
        if radii is not None:
            words.append(f"radius {_range(radii, 'm')}")
            area = np.pi * radii**2
            stiffness = _known(rod.shear_stretch_stiffness)
            mass = _known(rod.linear_density)
            if stiffness is not None:
                words.append(f"E {_range(stiffness[..., 2, :] / area, 'Pa')}")
            if mass is not None:
                words.append(f"{_range(mass / area, 'kg/m^3', prefixed=False)}")
    return f"Rod({', '.join([*words, *_kind(rod.rest_lengths, 1)])})"


def state_repr(state: Any) -> str:
    """Describes a state by its elements, tip position and largest speed of a node."""
    positions, velocities = _known(state.positions), _known(state.velocities)
    words = [_elements(state.orientations)]
    if positions is not None and positions.ndim == 2:
        tip = ", ".join(f"{x:.3g}" for x in positions[:, -1])
        words.append(f"tip at ({tip}) m")
    if velocities is not None:
        speeds = np.sqrt(np.sum(velocities.astype(float) ** 2, axis=-2))
        words.append("at rest" if not speeds.any() else f"up to {speeds.max():.3g} m/s")
    return f"RodState({', '.join([*words, *_kind(state.positions, 2)])})"


def scene_repr(scene: Any) -> str:
    """Describes a scene by its rod, the classes of its effects, and its method."""
    names = [type(effect).__name__ for effect in _listed(scene.effects)]
    shown = [
        f"{names.count(name)} {name}" if names.count(name) > 1 else name
        for name in dict.fromkeys(names)
    ]
    if len(shown) > 6:
        shown[5:] = [f"{len(shown) - 5} more kinds"]
    parts = [repr(scene.rod), *shown, type(scene.method).__name__]
    return f"Scene({', '.join(parts)})"


def step_repr(step: Any) -> str:
    """Describes a stable step by its size, or sizes of a batch, and what limits it."""
    sizes = _known(step.dt)
    if sizes is None:
        raise ValueError("the step is traced")
    shown = f"dt {_range(sizes, 's', prefixed=False)}"
    if sizes.ndim == 0:
        shown += f", limited by {step.limiting_mode}"
    return f"{type(step).__name__}({shown})"


def repr_or_class_name(words: Any, thing: Any) -> str:
    """Description `words(thing)`, or only the class name of `thing` if that fails."""
    try:
        return words(thing)
    except Exception:
        # Pytrees are often printed when something is already wrong.
        return f"{type(thing).__name__}(...)"


def _listed(effects: Any) -> tuple[Any, ...]:
    return tuple(effects) if isinstance(effects, (tuple, list)) else (effects,)


def _known(leaf: Any) -> np.ndarray | None:
    """Values of a leaf; `None` if it is traced or cannot be read on this host."""
    import jax

    if isinstance(leaf, jax.core.Tracer) or not isinstance(
        leaf, (jax.Array, np.ndarray)
    ):
        return None
    if isinstance(leaf, jax.Array) and (
        leaf.is_deleted() or not leaf.is_fully_addressable
    ):
        return None
    values = np.asarray(leaf)
    return values if values.size and values.dtype.kind in "fiu" else None


def _elements(leaf: Any) -> str:
    shape = getattr(leaf, "shape", ())
    return f"{shape[-1]} elements" if shape else "? elements"


def _kind(leaf: Any, axes: int) -> list[str]:
    """Batch shape, dtype and "traced" of a leaf, as far as they apply, as text.

    Its last `axes` axes are those of a single rod; axes before them are the batch's.
    """
    import jax

    words = []
    shape = getattr(leaf, "shape", ())
    if len(shape) > axes:
        words.append(f"batch {'x'.join(map(str, shape[: len(shape) - axes]))}")
    if hasattr(leaf, "dtype"):
        words.append(str(leaf.dtype))
    if isinstance(leaf, jax.core.Tracer):
        words.append("traced")
    return words


def _range(values: np.ndarray, unit: str, prefixed: bool = True) -> str:
    """Smallest and largest value as text, "1 to 2 MPa"; one value if both look alike.

    If `prefixed`, units other than m get the prefix k, M or G.
    """
    low, high = float(np.min(values)), float(np.max(values))
    if not (math.isfinite(low) and math.isfinite(high)):
        return f"not finite {unit}"
    size = max(abs(low), abs(high))
    power = 0
    if prefixed and unit != "m" and size >= 1e3:
        power = min(9, 3 * (int(math.log10(size)) // 3))
    low, high = low / 10**power, high / 10**power
    first, last = (f"{x:.3g}" if abs(x) < 1e3 else f"{x:.0f}" for x in (low, high))
    unit = f"{_PREFIXES[power]}{unit}"
    return f"{first} {unit}" if first == last else f"{first} to {last} {unit}"

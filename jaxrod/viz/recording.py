"""A recorded motion of rods and bodies, as arrays that are ready to be drawn."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal, Self

import numpy as np
from jaxtyping import Float

from jaxrod.viz.rods import Rods
from jaxrod.viz.shapes import Arrows, Cylinder, Mesh, Sphere

Axis = Literal["x", "y", "z"]
_EVERY = 8
"""Stride of the frames whose mesh corners are included in the bounding box."""


@dataclasses.dataclass(frozen=True, eq=False)
class Recording:
    """A recorded motion of rods and bodies over T frames, as NumPy arrays."""

    times: Float[np.ndarray, "num_frames"]
    """Time of each frame [s], increasing, shape (T,)."""
    rods: tuple[Rods, ...] = ()
    """Groups of rods; all rods of a group have the same number of elements."""
    spheres: tuple[Sphere, ...] = ()
    """Spheres shown with the rods, with positions of shape (T, 3)."""
    cylinders: tuple[Cylinder, ...] = ()
    """Cylinders shown with the rods."""
    meshes: tuple[Mesh, ...] = ()
    """Rigid bodies shown with the rods."""
    arrows: tuple[Arrows, ...] = ()
    """Groups of arrows shown with the rods, such as forces."""
    readouts: Mapping[str, Float[np.ndarray, "num_frames"]] = dataclasses.field(
        default_factory=dict
    )
    """Map from names to one number per frame, shape (T,), for example the reward."""
    title: str = ""
    """Heading of the player."""
    up: Axis = "z"
    """World axis that is drawn upwards."""
    floor: float | None = None
    """Height of the drawn ground along the upward axis [m]; `None` for the lowest point
    of all rods and bodies."""

    @property
    def positions(self) -> Float[np.ndarray, "num_frames num_rods num_nodes 3"]:
        """Node positions [m], shape (T, R, n+1, 3); requires a single group of rods."""
        return self._alike().positions

    @property
    def radii(self) -> Float[np.ndarray, "num_rods num_elements"]:
        """Element radii [m], shape (R, n); requires a single group of rods."""
        return self._alike().radii

    @property
    def rod_names(self) -> tuple[str, ...]:
        """Names of the R rods, or empty; requires a single group of rods."""
        return self._alike().names

    def _alike(self) -> Rods:
        if len(self.rods) != 1:
            raise ValueError(
                f"this replay has rods of {len(self.rods)} kinds: ask each of its rods"
            )
        return self.rods[0]

    @property
    def num_frames(self) -> int:
        """Number of recorded frames, T."""
        return len(self.times)

    @property
    def num_rods(self) -> int:
        """Number of rods in all groups, R."""
        return sum(rods.num_rods for rods in self.rods)

    @property
    def fields(self) -> tuple[str, ...]:
        """Labels of the fields that can colour the rods."""
        return tuple(
            dict.fromkeys(label for rods in self.rods for label in rods.fields)
        )

    def field_range(self, label: str) -> tuple[float, float]:
        """Values of a field at the two ends of the colour map.

        They exclude the lowest and the highest 0.5 % of all values. The range starts at
        zero if the lowest value is near zero, and is symmetric about zero if both signs
        occur.
        """
        every = [rods.fields[label] for rods in self.rods if label in rods.fields]
        values = np.concatenate([np.ravel(numbers) for numbers in every])
        values = values[np.isfinite(values)]
        if not values.size:
            return 0.0, 1.0
        low, high = (float(np.percentile(values, share)) for share in (0.5, 99.5))
        if low < 0 < high and -low > 0.02 * high:
            low, high = -max(-low, high), max(-low, high)
        elif 0 <= low < 0.3 * high or -0.02 * high <= low < 0:
            low = 0.0
        return (low, high) if high > low else (low - 0.5, low + 0.5)

    def thinned(self, frames_per_second: float) -> Self:
        """Drops frames so that at most `frames_per_second` [Hz] remain.

        The first and the last frame are kept. Kept frames are unchanged.

        Raises:
            ValueError: `frames_per_second` is not positive.
        """
        if not frames_per_second > 0:
            raise ValueError(
                f"frames_per_second must be positive, got {frames_per_second} Hz"
            )
        first, last = self.times[0], self.times[-1]
        if self.num_frames <= (last - first) * frames_per_second * 1.001 + 1:
            return self
        wanted = np.arange(first, last, 1 / frames_per_second)
        nearest = np.searchsorted((self.times[1:] + self.times[:-1]) / 2, wanted)
        keep = np.unique(np.append(nearest, self.num_frames - 1))
        return dataclasses.replace(
            self,
            times=self.times[keep],
            rods=tuple(rods.at_frames(keep) for rods in self.rods),
            meshes=tuple(mesh.at_frames(keep) for mesh in self.meshes),
            arrows=tuple(arrows.at_frames(keep) for arrows in self.arrows),
            spheres=tuple(
                dataclasses.replace(s, positions=s.positions[keep])
                for s in self.spheres
            ),
            readouts={name: values[keep] for name, values in self.readouts.items()},
        )

    def bounds(self) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """Lowest and highest corner of the box around all rods, bodies and the floor.

        It contains them in all frames [m], but not the arrows; see `extent`.
        """
        low, high = extent(self.rods, self.meshes, self.spheres, self.cylinders)
        if self.floor is not None:
            axis = "xyz".index(self.up)
            low[axis] = min(low[axis], self.floor)
        return low, high

    def __repr__(self) -> str:
        """One line that describes the recording, without the numbers."""
        duration = float(self.times[-1] - self.times[0])
        return (
            f"{type(self).__name__}({self.title!r}: {self.num_rods} rods, "
            f"{self.num_frames} frames, {duration:.3g} s)"
        )


def extent(
    rods: Sequence[Rods],
    meshes: Sequence[Mesh] = (),
    spheres: Sequence[Sphere] = (),
    cylinders: Sequence[Cylinder] = (),
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Lowest and highest corner of a box that contains the shapes in all frames [m].

    Corners of meshes are checked only in every eighth frame and in the last one.
    """
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for some in rods:
        margin = float(some.radii.max())
        low = np.minimum(low, some.positions.min(axis=(0, 1, 2)) - margin)
        high = np.maximum(high, some.positions.max(axis=(0, 1, 2)) + margin)
    for mesh in meshes:
        last = len(mesh.positions) - 1
        for frame in {0, *range(0, last, _EVERY), last}:
            for body in range(mesh.count):
                corners = mesh.placed(frame, body)
                low = np.minimum(low, corners.min(axis=0))
                high = np.maximum(high, corners.max(axis=0))
    for sphere in spheres:
        low = np.minimum(low, sphere.positions.min(axis=0) - sphere.radius)
        high = np.maximum(high, sphere.positions.max(axis=0) + sphere.radius)
    for cylinder in cylinders:
        for end in (cylinder.start, cylinder.end):
            low = np.minimum(low, end - cylinder.radius)
            high = np.maximum(high, end + cylinder.radius)
    if not np.isfinite(low).all():
        return -np.ones(3), np.ones(3)
    return low, high

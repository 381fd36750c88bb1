"""A recorded motion as colours and pages see it, whatever made it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from jaxrod.viz.arrows import Arrows
from jaxrod.viz.meshes import Mesh
from jaxrod.viz.rods import Rods
from jaxrod.viz.shapes import Cylinder, Sphere


class Recording(Protocol):
    """The parts of `jaxrod.viz.Replay` that are drawn."""

    @property
    def times(self) -> np.ndarray:
        """Time of each frame [s]."""

    @property
    def num_frames(self) -> int:
        """Number of frames."""

    @property
    def rods(self) -> Sequence[Rods]:
        """Rods, grouped by their number of elements."""

    @property
    def spheres(self) -> Sequence[Sphere]:
        """Spheres."""

    @property
    def cylinders(self) -> Sequence[Cylinder]:
        """Cylinders."""

    @property
    def meshes(self) -> Sequence[Mesh]:
        """Bodies made of triangles."""

    @property
    def arrows(self) -> Sequence[Arrows]:
        """Arrows."""

    @property
    def readouts(self) -> Mapping[str, np.ndarray]:
        """Numbers over time, by their labels."""

    @property
    def fields(self) -> Sequence[str]:
        """Labels of the fields that can colour the rods."""

    @property
    def title(self) -> str:
        """Heading."""

    @property
    def up(self) -> str:
        """World axis drawn upwards."""

    @property
    def floor(self) -> float | None:
        """Height of a level plane [m]."""

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners of the box that contains everything [m]."""

    def field_range(self, label: str) -> tuple[float, float]:
        """Range of a field that the colours resolve."""

    def thinned(self, frames_per_second: float) -> Recording:
        """With at most so many frames per second [Hz]."""

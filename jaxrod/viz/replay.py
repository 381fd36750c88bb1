"""A recorded motion of one or more rods, ready to be looked at."""

from __future__ import annotations

import dataclasses
import html as markup
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from jaxrod.viz.arrays import numbers, require_finite
from jaxrod.viz.shapes import Cylinder, Sphere, checked_cylinder, checked_sphere

Axis = Literal["x", "y", "z"]


@dataclasses.dataclass(frozen=True, eq=False)
class Replay:
    """A recorded motion of R rods of n elements over T frames, as NumPy arrays.

    Make one with `Replay.from_rollout` (the component-first arrays the simulator
    returns) or `Replay.from_nodes` (one xyz triple per node): they check and convert.
    In a notebook a replay shows itself as a 3-D player.
    """

    times: Float[np.ndarray, "num_frames"]
    """Time of each frame [s], increasing, shape (T,)."""
    positions: Float[np.ndarray, "num_frames num_rods num_nodes 3"]
    """Node positions [m], shape (T, R, n+1, 3)."""
    radii: Float[np.ndarray, "num_rods num_elements"]
    """Element radii [m], shape (R, n)."""
    spheres: tuple[Sphere, ...] = ()
    """Spheres shown with the rods, their positions of shape (T, 3)."""
    cylinders: tuple[Cylinder, ...] = ()
    """Cylinders shown with the rods."""
    readouts: Mapping[str, Float[np.ndarray, "num_frames"]] = dataclasses.field(
        default_factory=dict
    )
    """Name -> one number per frame, shape (T,), for example the reward."""
    rod_names: tuple[str, ...] = ()
    """Names of the rods in the legend; empty, or R names."""
    title: str = ""
    """Heading of the player."""
    up: Axis = "z"
    """The world axis drawn upwards."""

    @classmethod
    def from_rollout(
        cls, positions: Any, radii: Any, times: Any, **more: Any
    ) -> Replay:
        """Makes a replay from component-first arrays, as a rollout returns them.

        Args:
            positions: node positions [m], (T, 3, n+1) for one rod or
                (T, R, 3, n+1) for R rods shown together.
            radii: element radii [m], (n,) or (R, n), or one number for all.
            times: time of each frame [s], shape (T,).
            **more: the remaining arguments of `from_nodes`.

        Raises:
            ValueError: an argument has the wrong shape or an impossible value.
        """
        nodes = numbers("positions", positions, "m")
        if nodes.ndim not in (3, 4) or nodes.shape[-2] != 3:
            raise ValueError(
                "positions must have shape (T, 3, n+1) or (T, R, 3, n+1) [m], "
                f"got {nodes.shape}"
            )
        return cls.from_nodes(np.swapaxes(nodes, -1, -2), radii, times, **more)

    @classmethod
    def from_nodes(
        cls,
        positions: Any,
        radii: Any,
        times: Any,
        *,
        spheres: Sequence[Sphere] = (),
        cylinders: Sequence[Cylinder] = (),
        readouts: Mapping[str, Any] | None = None,
        rod_names: Sequence[str] = (),
        title: str = "",
        up: Axis = "z",
    ) -> Replay:
        """Makes a replay from one xyz triple per node.

        Args:
            positions: node positions [m], (T, n+1, 3) for one rod or
                (T, R, n+1, 3) for R rods shown together.
            radii: element radii [m], (n,) or (R, n), or one number for all.
            times: time of each frame [s], increasing, shape (T,).
            spheres: spheres to show; positions (3,) or (T, 3).
            cylinders: cylinders to show.
            readouts: name -> one number per frame, shape (T,).
            rod_names: names of the rods in the legend; empty, or R names.
            title: heading of the player.
            up: the world axis drawn upwards: "x", "y" or "z".

        Raises:
            ValueError: an argument has the wrong shape or an impossible value.
        """
        nodes = numbers("positions", positions, "m")
        if nodes.ndim == 3:
            nodes = nodes[:, None]
        if nodes.ndim != 4 or nodes.shape[-1] != 3 or nodes.shape[2] < 2:
            raise ValueError(
                "positions must have shape (T, n+1, 3) or (T, R, n+1, 3) [m] with "
                f"at least 2 nodes, got {np.shape(positions)}"
            )
        num_frames, num_rods, num_nodes, _ = nodes.shape
        if num_frames == 0 or num_rods == 0:
            raise ValueError(
                f"positions must hold at least one frame and one rod, got {nodes.shape}"
            )
        clock = _times(times, num_frames)
        require_finite("positions", nodes, "m", clock)
        if up not in ("x", "y", "z"):
            raise ValueError(f'up must be "x", "y" or "z", got {up!r}')
        if rod_names and len(rod_names) != num_rods:
            raise ValueError(
                f"rod_names must be empty or hold {num_rods} names, "
                f"got {len(rod_names)}"
            )
        return cls(
            times=clock,
            positions=nodes,
            radii=_radii(radii, num_rods, num_nodes - 1),
            spheres=tuple(checked_sphere(i, s, clock) for i, s in enumerate(spheres)),
            cylinders=tuple(checked_cylinder(i, c) for i, c in enumerate(cylinders)),
            readouts={
                str(name): _readout(str(name), values, num_frames)
                for name, values in (readouts or {}).items()
            },
            rod_names=tuple(str(name) for name in rod_names),
            title=str(title),
            up=up,
        )

    @property
    def num_frames(self) -> int:
        """Number of recorded frames, T."""
        return len(self.times)

    @property
    def num_rods(self) -> int:
        """Number of rods, R."""
        return self.positions.shape[1]

    def thinned(self, frames_per_second: float) -> Replay:
        """Drops frames so that at most `frames_per_second` [Hz] remain.

        The first and the last frame are kept; kept frames are not altered.

        Raises:
            ValueError: frames_per_second is not positive.
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
            positions=self.positions[keep],
            spheres=tuple(
                dataclasses.replace(s, positions=s.positions[keep])
                for s in self.spheres
            ),
            readouts={name: values[keep] for name, values in self.readouts.items()},
        )

    def bounds(self) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """Corners of the box that holds everything in every frame [m]."""
        margin = float(self.radii.max())
        low = self.positions.min(axis=(0, 1, 2)) - margin
        high = self.positions.max(axis=(0, 1, 2)) + margin
        for sphere in self.spheres:
            low = np.minimum(low, sphere.positions.min(axis=0) - sphere.radius)
            high = np.maximum(high, sphere.positions.max(axis=0) + sphere.radius)
        for cylinder in self.cylinders:
            for end in (cylinder.start, cylinder.end):
                low = np.minimum(low, end - cylinder.radius)
                high = np.maximum(high, end + cylinder.radius)
        return low, high

    def __repr__(self) -> str:
        """One line on what was recorded, without the numbers."""
        duration = float(self.times[-1] - self.times[0])
        return (
            f"Replay({self.title!r}: {self.num_rods} rods, {self.num_frames} frames, "
            f"{duration:.3g} s)"
        )

    def _repr_html_(self) -> str:
        """The 3-D player in a frame of its own, for notebooks."""
        from jaxrod.viz.page import html

        page = markup.escape(html(self), quote=True)
        return (
            f'<iframe srcdoc="{page}" title="3-D replay" allowfullscreen '
            'style="width:100%;height:520px;border:0;border-radius:8px"></iframe>'
        )


def _times(times: Any, num_frames: int) -> np.ndarray:
    clock = numbers("times", times, "s")
    if clock.shape != (num_frames,):
        raise ValueError(
            f"times must have shape ({num_frames},) [s], one per frame, "
            f"got {clock.shape}"
        )
    require_finite("times", clock, "s")
    backward = np.flatnonzero(np.diff(clock) <= 0)
    if backward.size:
        k = int(backward[0])
        raise ValueError(
            f"times must increase, got {clock[k]:g} s then {clock[k + 1]:g} s "
            f"at index {k + 1}"
        )
    return clock


def _radii(radii: Any, num_rods: int, num_elements: int) -> np.ndarray:
    values = numbers("radii", radii, "m")
    if values.shape not in ((), (num_elements,), (num_rods, num_elements)):
        raise ValueError(
            f"radii must have shape ({num_elements},) or ({num_rods}, {num_elements}) "
            f"[m], got {values.shape}"
        )
    require_finite("radii", values, "m")
    if values.min() <= 0:
        raise ValueError(f"radii must be positive, got {values.min():g} m")
    return np.broadcast_to(values, (num_rods, num_elements)).copy()


def _readout(name: str, values: Any, num_frames: int) -> np.ndarray:
    series = numbers(f"readouts[{name!r}]", values, "-")
    if series.shape != (num_frames,):
        raise ValueError(
            f"readouts[{name!r}] must have shape ({num_frames},), one number per "
            f"frame, got {series.shape}"
        )
    return series

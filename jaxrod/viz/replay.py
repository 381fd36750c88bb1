"""A recorded motion of rods and bodies, ready for viewing."""

from __future__ import annotations

import dataclasses
import html as markup
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from jaxrod.viz.arrays import checked_times, numbers, require_finite
from jaxrod.viz.arrows import Arrows, checked_arrows
from jaxrod.viz.extent import extent
from jaxrod.viz.meshes import Mesh, checked_mesh
from jaxrod.viz.rods import Rods, checked_rods
from jaxrod.viz.shapes import Cylinder, Sphere, checked_cylinder, checked_sphere

Axis = Literal["x", "y", "z"]


@dataclasses.dataclass(frozen=True, eq=False)
class Replay:
    """A recorded motion of rods and bodies over T frames, as NumPy arrays.

    Make one with `Replay.from_states` (a scene or a system and its states),
    `Replay.from_rollout` (component-first arrays) or `Replay.from_nodes` (one xyz
    triple per node): they check and convert. `together` combines several in one view.
    In a notebook a replay shows itself as a 3-D player; `jaxrod.viz.picture` and
    `jaxrod.viz.film` write files.
    """

    times: Float[np.ndarray, "num_frames"]
    """Time of each frame [s], increasing, shape (T,)."""
    rods: tuple[Rods, ...] = ()
    """Rods, grouped by their number of elements."""
    spheres: tuple[Sphere, ...] = ()
    """Spheres shown with the rods, their positions of shape (T, 3)."""
    cylinders: tuple[Cylinder, ...] = ()
    """Cylinders shown with the rods."""
    meshes: tuple[Mesh, ...] = ()
    """Rigid bodies shown with the rods."""
    arrows: tuple[Arrows, ...] = ()
    """Arrows, such as forces."""
    readouts: Mapping[str, Float[np.ndarray, "num_frames"]] = dataclasses.field(
        default_factory=dict
    )
    """Map from names to one number per frame, shape (T,), for example the reward."""
    title: str = ""
    """Heading of the player."""
    up: Axis = "z"
    """World axis that is drawn upwards."""
    floor: float | None = None
    """Height of the ground along the upward axis [m]; `None` for below everything."""

    @classmethod
    def from_rollout(
        cls, positions: Any, radii: Any, times: Any, **more: Any
    ) -> Replay:
        """Makes a replay from component-first arrays, as a rollout returns them.

        Args:
            positions: Node positions [m], (T, 3, n+1) for one rod or
                (T, R, 3, n+1) for R rods shown together.
            radii: Element radii [m], (n,) or (R, n), or one number for all.
            times: Time of each frame [s], shape (T,).
            **more: The remaining arguments of `from_nodes`.

        Raises:
            ValueError: An argument has the wrong shape or an impossible value.
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
        meshes: Sequence[Mesh] = (),
        arrows: Sequence[Arrows] = (),
        readouts: Mapping[str, Any] | None = None,
        fields: Mapping[str, Any] | None = None,
        rod_names: Sequence[str] = (),
        name: str = "",
        colour: str = "",
        title: str = "",
        up: Axis = "z",
        floor: float | None = None,
    ) -> Replay:
        """Makes a replay from one xyz triple per node.

        Args:
            positions: Node positions [m], (T, n+1, 3) for one rod or
                (T, R, n+1, 3) for R rods shown together.
            radii: Element radii [m], (n,) or (R, n), or one number for all.
            times: Time of each frame [s], increasing, shape (T,).
            spheres: Spheres to show; positions (3,) or (T, 3).
            cylinders: Cylinders to show.
            meshes: Rigid bodies to show.
            arrows: Arrows to show, such as forces.
            readouts: Map from names to one number per frame, shape (T,).
            fields: Map from labels with units to numbers that colour the rods,
                broadcastable to (T, R, n) with n for elements, n+1 for nodes or n-1 for
                joints.
            rod_names: Names of the rods in the legend; empty, or R names.
            name: Common name of the rods.
            colour: Colour of all rods, as "#rrggbb"; empty for a different one for
                each.
            title: Heading of the player.
            up: World axis that is drawn upwards: "x", "y" or "z".
            floor: Height of the ground along it [m]; `None` for below everything.

        Raises:
            ValueError: An argument has the wrong shape or an impossible value.
        """
        nodes = numbers("positions", positions, "m")
        clock = checked_times(times, nodes.shape[:1])
        rods = checked_rods(
            positions,
            radii,
            clock,
            names=rod_names,
            name=name,
            colour=colour,
            fields=fields,
        )
        return cls.of(
            clock,
            (rods,),
            spheres=spheres,
            cylinders=cylinders,
            meshes=meshes,
            arrows=arrows,
            readouts=readouts,
            title=title,
            up=up,
            floor=floor,
        )

    @classmethod
    def of(
        cls,
        times: Any,
        rods: Sequence[Rods] = (),
        *,
        spheres: Sequence[Sphere] = (),
        cylinders: Sequence[Cylinder] = (),
        meshes: Sequence[Mesh] = (),
        arrows: Sequence[Arrows] = (),
        readouts: Mapping[str, Any] | None = None,
        title: str = "",
        up: Axis = "z",
        floor: float | None = None,
    ) -> Replay:
        """Makes a replay of rods that are already checked, and of other shapes.

        Args:
            times: Time of each frame [s], increasing, shape (T,).
            rods: Rods, grouped by their number of elements.
            spheres: Spheres to show; this and the others as in `from_nodes`.
            cylinders: Cylinders to show.
            meshes: Rigid bodies to show.
            arrows: Arrows to show, such as forces.
            readouts: Map from names to one number per frame, shape (T,).
            title: Heading of the player.
            up: World axis that is drawn upwards.
            floor: Height of the ground along it [m].

        Raises:
            ValueError: An argument has the wrong shape or an impossible value.
        """
        clock = checked_times(times, (np.size(times),))
        if up not in ("x", "y", "z"):
            raise ValueError(f'up must be "x", "y" or "z", got {up!r}')
        if floor is not None:
            floor = float(floor)
            require_finite("floor", np.array([floor]), "m")
        return cls(
            times=clock,
            rods=tuple(rods),
            spheres=tuple(checked_sphere(i, s, clock) for i, s in enumerate(spheres)),
            cylinders=tuple(checked_cylinder(i, c) for i, c in enumerate(cylinders)),
            meshes=tuple(checked_mesh(i, m, clock) for i, m in enumerate(meshes)),
            arrows=tuple(checked_arrows(i, a, clock) for i, a in enumerate(arrows)),
            readouts={
                str(name): _readout(str(name), values, len(clock))
                for name, values in (readouts or {}).items()
            },
            title=str(title),
            up=up,
            floor=floor,
        )

    @classmethod
    def from_states(
        cls,
        model: Any,
        states: Any,
        times: Any,
        *,
        fields: Mapping[str, Any] | None = None,
        forces: bool = False,
        colours: Mapping[str, str] | None = None,
        spheres: Sequence[Sphere] = (),
        cylinders: Sequence[Cylinder] = (),
        readouts: Mapping[str, Any] | None = None,
        title: str = "",
        up: Axis = "z",
        floor: float | None = None,
    ) -> Replay:
        """Makes a replay of a scene or a system from the states of a rollout.

        Rods, rigid bodies and the fixed bodies that rods may touch are shown. Each
        member is labelled with its name.

        Args:
            model: The scene or the system.
            states: Its states with a leading axis of T, as `jaxrod.rollout` returns
                them; for a system, a dict by member.
            times: Time of each frame [s], shape (T,).
            fields: Map from labels with units to what colours the rods. This is either
                a function of a scene (at the time of the frame) and a state of its rod,
                which returns a number for each of n elements, n+1 nodes or n-1 joints,
                or one for the whole rod; or such numbers, with leading axes for frames
                and equal rods; or a dict of either by member, for some members.
                `jaxrod.viz.speed`, `stretch`, `bending` and `twist_rate` are such
                functions.
            forces: Whether to show the contact forces on rods as arrows, summed at each
                node.
            colours: Map from members to "#rrggbb".
            spheres: Spheres to show, such as targets.
            cylinders: Cylinders to show.
            readouts: Map from names to one number per frame, shape (T,).
            title: Heading of the player.
            up: World axis that is drawn upwards.
            floor: Height of the ground along it [m]; by default that of a level plane
                that a rod may touch.

        Raises:
            ValueError: An argument has the wrong shape or an impossible value.
            TypeError: `model` is neither a scene nor a system.
        """
        from jaxrod.viz.recorded import recorded

        clock = checked_times(times, (np.size(times),))
        seen = recorded(model, states, clock, fields or {}, forces, colours or {}, up)
        return cls.of(
            clock,
            seen.rods,
            meshes=seen.meshes,
            arrows=seen.arrows,
            spheres=spheres,
            cylinders=cylinders,
            readouts=readouts,
            title=title,
            up=up,
            floor=seen.floor if floor is None else floor,
        )

    def together(self, *others: Replay) -> Replay:
        """Combines this replay and others with the same times.

        Raises:
            ValueError: Their times or their upward axes differ.
        """
        for other in others:
            if not np.array_equal(self.times, other.times) or other.up != self.up:
                raise ValueError("replays put together must have the same times and up")
        every = (self, *others)
        floors = [replay.floor for replay in every if replay.floor is not None]
        return dataclasses.replace(
            self,
            rods=sum((replay.rods for replay in every), ()),
            spheres=sum((replay.spheres for replay in every), ()),
            cylinders=sum((replay.cylinders for replay in every), ()),
            meshes=sum((replay.meshes for replay in every), ()),
            arrows=sum((replay.arrows for replay in every), ()),
            readouts={k: v for replay in every for k, v in replay.readouts.items()},
            floor=floors[0] if floors else None,
        )

    @property
    def positions(self) -> Float[np.ndarray, "num_frames num_rods num_nodes 3"]:
        """Node positions [m], shape (T, R, n+1, 3), if all rods are alike."""
        return self._alike().positions

    @property
    def radii(self) -> Float[np.ndarray, "num_rods num_elements"]:
        """Element radii [m], shape (R, n), if all rods are alike."""
        return self._alike().radii

    @property
    def rod_names(self) -> tuple[str, ...]:
        """Names of the rods, if all rods are alike; empty, or R names."""
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
        """Number of rods, R."""
        return sum(rods.num_rods for rods in self.rods)

    @property
    def fields(self) -> tuple[str, ...]:
        """Labels of the fields that can colour the rods."""
        return tuple(
            dict.fromkeys(label for rods in self.rods for label in rods.fields)
        )

    def field_range(self, label: str) -> tuple[float, float]:
        """Range of a field that the colours resolve.

        It excludes the lowest and the highest 0.5 %. It starts at zero if zero is near,
        and is symmetric about zero if both signs occur.
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

    def thinned(self, frames_per_second: float) -> Replay:
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
        """Corners of the box that contains everything in every frame [m]."""
        low, high = extent(self.rods, self.meshes, self.spheres, self.cylinders)
        if self.floor is not None:
            axis = "xyz".index(self.up)
            low[axis] = min(low[axis], self.floor)
        return low, high

    def __repr__(self) -> str:
        """One line that describes the recording, without the numbers."""
        duration = float(self.times[-1] - self.times[0])
        return (
            f"Replay({self.title!r}: {self.num_rods} rods, {self.num_frames} frames, "
            f"{duration:.3g} s)"
        )

    def _repr_html_(self) -> str:
        """The 3-D player in its own frame, for notebooks."""
        from jaxrod.viz.page import html

        page = markup.escape(html(self), quote=True)
        return (
            f'<iframe srcdoc="{page}" title="3-D replay" allowfullscreen '
            'style="width:100%;height:520px;border:0;border-radius:8px"></iframe>'
        )


def _readout(name: str, values: Any, num_frames: int) -> np.ndarray:
    series = numbers(f"readouts[{name!r}]", values, "-")
    if series.shape != (num_frames,):
        raise ValueError(
            f"readouts[{name!r}] must have shape ({num_frames},), one number per "
            f"frame, got {series.shape}"
        )
    return series

"""Replays: recorded motions, made from states or arrays, to show and to draw."""

from __future__ import annotations

import dataclasses
import html as markup
import os
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxrod.viz.page import html, save_html
from jaxrod.viz.recording import Axis, Recording
from jaxrod.viz.rods import Rods, checked_rods
from jaxrod.viz.shapes import (
    Arrows,
    Cylinder,
    Mesh,
    Sphere,
    checked_arrows,
    checked_cylinder,
    checked_mesh,
    checked_sphere,
    checked_times,
    numbers,
    require_finite,
)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Replay(Recording):
    """A recorded motion of rods and bodies over T frames, as NumPy arrays.

    Make one with `Replay.from_states` (a scene or a system and its states),
    `Replay.from_rollout` (component-first arrays), `Replay.from_nodes` (one xyz
    triple per node) or `Replay.of` (rods of several kinds, or none): they check and
    convert. `together` combines several in one view. In a notebook a replay shows
    itself as a 3-D player; `jaxrod.viz.picture` and `jaxrod.viz.film` write files.

    Example:
        >>> longer = replace(state, positions=1.01 * state.positions)
        >>> records = jax.tree.map(lambda *leaves: jnp.stack(leaves), state, longer)
        >>> replay = viz.Replay.from_states(scene, records, [0.0, 0.1], title="My arm")
        >>> replay.num_frames, replay.num_rods, replay.positions.shape
        (2, 1, (2, 1, 11, 3))
    """

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

        Example:
            >>> positions = np.stack([state.positions, state.positions + 0.1])
            >>> replay = viz.Replay.from_rollout(positions, rod.radii, [0.0, 0.1])
            >>> replay.num_frames, replay.positions.shape
            (2, (2, 1, 11, 3))
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
        fields: Mapping[str, Any] | None = None,
        rod_names: Sequence[str] = (),
        name: str = "",
        colour: str = "",
        **more: Any,
    ) -> Replay:
        """Makes a replay from one xyz triple per node.

        Args:
            positions: Node positions [m], (T, n+1, 3) for one rod or
                (T, R, n+1, 3) for R rods shown together.
            radii: Element radii [m], (n,) or (R, n), or one number for all.
            times: Time of each frame [s], increasing, shape (T,).
            fields: Map from labels with units to numbers that colour the rods,
                broadcastable to (T, R, n) with n for elements, n+1 for nodes or n-1 for
                joints.
            rod_names: Names of the rods in the legend; empty, or R names.
            name: Common name of the rods.
            colour: Colour of all rods, as "#rrggbb"; if empty, each rod gets a
                different colour.
            **more: Title and other things to show, as `of` takes them.

        Raises:
            ValueError: An argument has the wrong shape or an impossible value.

        Example:
            >>> nodes = np.linspace([0, 0, 0], [1, 0, 0], 11)  # (11, 3)
            >>> swinging = np.stack([nodes, nodes + 0.1])
            >>> replay = viz.Replay.from_nodes(swinging, 0.02, [0.0, 0.1])
            >>> replay.num_frames, replay.num_rods
            (2, 1)
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
        return cls.of(clock, (rods,), **more)

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
        """Makes a replay from existing groups of rods, and of other shapes.

        Args:
            times: Time of each frame [s], increasing, shape (T,).
            rods: Groups of rods; all rods of a group have the same number of elements.
            spheres: Spheres to show, such as targets; positions (3,) or (T, 3).
            cylinders: Cylinders to show.
            meshes: Rigid bodies to show.
            arrows: Arrows to show, such as forces.
            readouts: Map from names to one number per frame, shape (T,).
            title: Heading of the player.
            up: World axis that is drawn upwards: "x", "y" or "z".
            floor: Height of the ground along this axis [m]; `None` for the lowest point
                of all rods and bodies.

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
        up: Axis = "z",
        floor: float | None = None,
        meshes: Sequence[Mesh] = (),
        arrows: Sequence[Arrows] = (),
        **more: Any,
    ) -> Replay:
        """Makes a replay of a scene or a system from the states of a rollout.

        Rods, rigid bodies and the fixed bodies that rods may touch are shown. Each
        member is labelled with its name.

        Args:
            model: The scene or the system.
            states: Its states with a leading axis of T, as `jaxrod.rollout` returns
                them; for a system, a dict by member.
            times: Time of each frame [s], shape (T,).
            fields: Fields that can colour the rods, by label with unit. A field is a
                function of a scene (at the time of the frame) and a state of its rod,
                such as `jaxrod.viz.speed`, `stretch`, `bending` and `twist_rate`. It
                returns a number for each of n elements, n+1 nodes or n-1 joints, or one
                for the whole rod. Instead of a function a field may be an array of such
                numbers, with leading axes for frames and equal rods; or a dict of
                functions or arrays by member, for some members.
            forces: Whether to show the contact forces on rods as arrows, summed at each
                node.
            colours: Colour of some members as "#rrggbb", by name of the member.
            up: World axis that is drawn upwards.
            floor: Height of the ground along this axis [m]; by default the height of a
                level plane that a rod may touch.
            meshes: Other bodies to show.
            arrows: Other arrows to show.
            **more: Title and other things to show, as `of` takes them.

        Raises:
            ValueError: An argument has the wrong shape or an impossible value.
            TypeError: `model` is neither a scene nor a system.

        Example:
            >>> records = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), state)
            >>> replay = viz.Replay.from_states(
            ...     scene, records, [0.0, 0.1], fields={"speed [m/s]": viz.speed}
            ... )
            >>> replay.num_frames, list(replay.rods[0].fields)
            (2, ['speed [m/s]'])
        """
        from jaxrod.viz.recorded import recorded

        clock = checked_times(times, (np.size(times),))
        seen = recorded(model, states, clock, fields or {}, forces, colours or {}, up)
        return cls.of(
            clock,
            seen.rods,
            meshes=(*seen.meshes, *meshes),
            arrows=(*seen.arrows, *arrows),
            up=up,
            floor=seen.floor if floor is None else floor,
            **more,
        )

    def together(self, *others: Replay) -> Replay:
        """Combines this replay and others with the same times in one view.

        The title and the upward axis are those of this replay.

        Raises:
            ValueError: The times or the upward axes of the replays differ.

        Example:
            >>> nodes = np.linspace([0, 0, 0], [1, 0, 0], 11)  # (11, 3)
            >>> one = viz.Replay.from_nodes(nodes[None], 0.02, [0.0], name="one")
            >>> two = viz.Replay.from_nodes(nodes[None] + 0.1, 0.02, [0.0], name="two")
            >>> one.together(two).num_rods
            2
        """
        for other in others:
            if not np.array_equal(self.times, other.times) or other.up != self.up:
                raise ValueError(
                    "joined replays must have the same times and the same up"
                )
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

    def _repr_html_(self) -> str:
        """HTML of the 3-D player in an iframe, which notebooks display."""
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


def show(
    model: Any,
    states: Any,
    times: Any,
    path: str | os.PathLike[str] | None = None,
    **more: Any,
) -> Replay:
    """Shows the states of a rollout with all the bodies of their scene or system.

    In a notebook the replay is returned; as the last value of a cell it shows the
    player. In a script the player is written to `replay.html`, and the name is printed.

    Args:
        model: The scene or the system.
        states: Its states, as `jaxrod.rollout` returns them.
        times: Time of each record [s], as `jaxrod.rollout_times` returns them; or the
            time between records.
        path: File to write, also in a notebook.
        **more: The remaining arguments of `Replay.from_states`.

    Raises:
        ValueError: An argument has the wrong shape or an impossible value.
        TypeError: `model` is neither a scene nor a system.
        OSError: The file cannot be written.

    Example:
        >>> records = jax.tree.map(lambda leaf: leaf[None], state)  # as from `rollout`
        >>> replay = viz.show(scene, records, times=[0.0])
        replay.html
        >>> replay.num_frames
        1
    """
    import jax

    times = getattr(times, "dt", times)  # the result of `stable_dt` has one
    if np.ndim(times) == 0:
        first = jax.tree.leaves(states)[0]
        times = np.arange(np.shape(first)[0]) * float(times)
    replay = Replay.from_states(model, states, times, **more)
    if path is None and not _in_notebook():
        path = "replay.html"
    if path is not None:
        save_html(replay, path)
        print(os.fspath(path))
    return replay


def _in_notebook() -> bool:
    """Whether the code runs in a notebook, which displays the last value of a cell."""
    interactive = sys.modules.get("IPython")
    shell = interactive.get_ipython() if interactive else None
    return getattr(shell, "kernel", None) is not None

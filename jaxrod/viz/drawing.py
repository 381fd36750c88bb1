"""Still pictures and animations of a replay with matplotlib, without a display."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import UInt8

from jaxrod.viz.matplotlib_needed import need_matplotlib
from jaxrod.viz.page import nodal_radii
from jaxrod.viz.replay import Replay

if TYPE_CHECKING:
    from matplotlib.animation import FuncAnimation
    from matplotlib.figure import Figure

_ROD_COLOURS = ("#2f7fd6", "#e0653a", "#2a9d74", "#b45cc4", "#c9a227", "#5b6ee1")
_SPHERE_COLOURS = ("#f59e0b", "#10a37f", "#d64570", "#7c5cd6")
_CYLINDER_COLOUR = "#9aa3b0"
_SIDES = 20


def frame(
    replay: Replay,
    index: int,
    *,
    width: int = 640,
    height: int = 480,
    azimuth: float = 35.0,
    elevation: float = 20.0,
) -> UInt8[np.ndarray, "height width 3"]:
    """Draws one frame of a replay as an RGB picture.

    Args:
        replay: the replay to draw.
        index: which frame, 0 to T-1; negative counts from the end.
        width: width of the picture [pixels].
        height: height of the picture [pixels].
        azimuth: angle of the view around the upward axis [degrees].
        elevation: angle of the view above the floor [degrees].

    Raises:
        ValueError: the size is not positive.
        IndexError: there is no such frame.
    """
    scene = _Scene(replay, width, height, azimuth, elevation)
    scene.show(range(replay.num_frames)[index])
    return scene.pixels()


def animation(
    replay: Replay,
    *,
    frames_per_second: float = 20.0,
    width: int = 640,
    height: int = 480,
    azimuth: float = 35.0,
    elevation: float = 20.0,
) -> FuncAnimation:
    """Returns a matplotlib animation, for `to_jshtml`, `save` and the like.

    For looking at a motion prefer `html`: it is smaller, smoother and turns.

    Args:
        replay: the replay to draw; frames beyond `frames_per_second` are thinned out.
        frames_per_second: pictures per second of simulated time [Hz].
        width: width of the picture [pixels].
        height: height of the picture [pixels].
        azimuth: angle of the view around the upward axis [degrees].
        elevation: angle of the view above the floor [degrees].

    Raises:
        ValueError: the size or the rate is not positive.
    """
    need_matplotlib()
    from matplotlib.animation import FuncAnimation

    thin = replay.thinned(frames_per_second)
    scene = _Scene(thin, width, height, azimuth, elevation)
    return FuncAnimation(
        scene.figure,
        scene.show,
        frames=thin.num_frames,
        init_func=list,
        interval=1000 / frames_per_second,
        cache_frame_data=False,
    )


class _Scene:
    """A figure whose moving parts are redrawn for each frame."""

    figure: Figure

    def __init__(
        self, replay: Replay, width: int, height: int, azimuth: float, elevation: float
    ) -> None:
        need_matplotlib()
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.colors import LightSource
        from matplotlib.figure import Figure

        for name, pixels in (("width", width), ("height", height)):
            if pixels < 1:
                raise ValueError(f"{name} must be positive, got {pixels} pixels")
        self.replay = replay
        self.light = LightSource(azdeg=315, altdeg=50)
        self.figure = Figure(figsize=(width / 100, height / 100), dpi=100)
        self.canvas = FigureCanvasAgg(self.figure)
        box = (0, 0, 1, 0.96)
        axes: Any = self.figure.add_axes(box, projection="3d")
        self.axes = axes
        self.axes.view_init(elev=elevation, azim=azimuth, vertical_axis=replay.up)
        low, high = replay.bounds()
        self.axes.set(
            xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2])
        )
        self.axes.set_box_aspect(high - low, zoom=1.02)
        for axis in "xyz":
            getattr(self.axes, f"set_{axis}label")(f"{axis} [m]")
            getattr(self.axes, f"{axis}axis").set_major_locator(_ticks())
        self.axes.tick_params(labelsize=7, colors="#5a6676")
        for cylinder in replay.cylinders:
            ends = np.stack([cylinder.start, cylinder.end])
            self._surface(_tube(ends, np.full(2, cylinder.radius)), _CYLINDER_COLOUR)
        self.radii = nodal_radii(replay.radii)
        self.moving: list[Any] = []

    def show(self, index: int) -> list[Any]:
        """Redraws the rods and spheres of one frame."""
        for artist in self.moving:
            artist.remove()
        replay = self.replay
        self.moving = [
            self._surface(
                _tube(replay.positions[index, rod], self.radii[rod]),
                _ROD_COLOURS[rod % len(_ROD_COLOURS)],
            )
            for rod in range(replay.num_rods)
        ]
        for k, sphere in enumerate(replay.spheres):
            colour = _SPHERE_COLOURS[k % len(_SPHERE_COLOURS)]
            ball = _ball(sphere.positions[index], sphere.radius)
            self.moving.append(self._surface(ball, colour))
        heading = f"{replay.title}   " if replay.title else ""
        self.figure.suptitle(
            f"{heading}t = {replay.times[index]:.2f} s",
            x=0.02,
            y=0.98,
            ha="left",
            fontsize=10,
        )
        return self.moving

    def pixels(self) -> np.ndarray:
        self.canvas.draw()
        return np.asarray(self.canvas.buffer_rgba())[..., :3].copy()

    def _surface(self, mesh: np.ndarray, colour: str) -> Any:
        return self.axes.plot_surface(
            *np.moveaxis(mesh, -1, 0),
            color=colour,
            lightsource=self.light,
            rcount=len(mesh),
            ccount=mesh.shape[1],
            linewidth=0,
            antialiased=False,
        )


def _ticks() -> Any:
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(4)


def _tube(nodes: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Surface of a tube with closed ends around a line of nodes, (n+3, sides, 3)."""
    tangents = np.gradient(nodes, axis=0)
    tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-300)
    # Carry one normal along the line without turning it about the tangent.
    normal = np.cross(tangents[0], np.eye(3)[np.argmin(np.abs(tangents[0]))])
    normals = np.empty_like(nodes)
    for i, tangent in enumerate(tangents):
        normal = normal - (normal @ tangent) * tangent
        normal = normal / max(float(np.linalg.norm(normal)), 1e-300)
        normals[i] = normal
    binormals = np.cross(tangents, normals)
    angle = np.linspace(0, 2 * np.pi, _SIDES + 1)[:, None]
    rings = nodes[:, None] + radii[:, None, None] * (
        np.cos(angle) * normals[:, None] + np.sin(angle) * binormals[:, None]
    )
    ends = [np.broadcast_to(nodes[k], (1, _SIDES + 1, 3)) for k in (0, -1)]
    return np.concatenate([ends[0], rings, ends[1]])


def _ball(centre: np.ndarray, radius: float) -> np.ndarray:
    """Surface of a sphere, (10, 17, 3)."""
    polar = np.linspace(0, np.pi, 10)[:, None]
    around = np.linspace(0, 2 * np.pi, 17)[None]
    directions = np.stack(
        [
            np.sin(polar) * np.cos(around),
            np.sin(polar) * np.sin(around),
            np.cos(polar) * np.ones_like(around),
        ],
        axis=-1,
    )
    return centre + radius * directions

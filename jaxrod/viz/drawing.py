"""Pictures and films of a replay, without a display or a browser."""

from __future__ import annotations

import io
import itertools
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import UInt8

from jaxrod.files import write_atomically
from jaxrod.viz.colours import RAMP, linear, other_legend, rod_legend
from jaxrod.viz.curves import need_matplotlib
from jaxrod.viz.geometry import Shapes, Triangles
from jaxrod.viz.light import Ground, rendered, view_of
from jaxrod.viz.recording import Recording

if TYPE_CHECKING:
    from matplotlib.animation import FuncAnimation

_PALE = linear("#eef2f7")


def frame(
    replay: Recording,
    index: int,
    *,
    width: int = 640,
    height: int = 480,
    azimuth: float = 35.0,
    elevation: float = 20.0,
) -> UInt8[np.ndarray, "height width 3"]:
    """Draws one frame of a replay as an RGB picture.

    The view is the same for all frames and contains the rods and bodies of all of them,
    so that successive pictures match.

    Args:
        replay: The replay to draw.
        index: Index of the frame, 0 to T-1; negative counts from the end.
        width: Width of the picture [pixels].
        height: Height of the picture [pixels].
        azimuth: Angle of the view around the upward axis [degrees].
        elevation: Angle of the view above the floor [degrees].

    Raises:
        ValueError: The size is not positive.
        IndexError: There is no such frame.
        TypeError: `replay` is no replay.

    Example:
        >>> replay = viz.Replay.from_rollout(state.positions[None], 0.02, times=[0.0])
        >>> viz.frame(replay, 0, width=320, height=240).shape
        (240, 320, 3)
    """
    frames = _checked(replay, [index])
    painter = _Painter(replay, (width, height), azimuth, elevation, fine=1)
    return painter.paint(frames)


def _checked(replay: Recording, frames: Sequence[int]) -> list[int]:
    """Indices of frames, counted from the start."""
    try:
        every = range(replay.num_frames)
    except AttributeError:
        raise TypeError(
            "replay must be a jaxrod.viz.Replay, as jaxrod.viz.show returns it, got a "
            f"{type(replay).__name__}"
        ) from None
    return [every[int(k)] for k in frames]


def picture(
    replay: Recording,
    frame: int | Sequence[int],
    path: str | os.PathLike[str],
    *,
    width: int = 960,
    height: int = 640,
    azimuth: float = 35.0,
    elevation: float = 20.0,
    zoom: float = 1.0,
    field: str | None = None,
    captions: bool = True,
    small: bool = False,
) -> None:
    """Writes a still of one frame, or of several in one, as a PNG file.

    The view contains everything drawn. The file appears complete or not at all.

    Args:
        replay: The replay to draw.
        frame: Index of the frame, 0 to T-1; negative counts from the end. Of several
            frames the last is drawn in full colour, the earlier ones paler.
        path: The file to write; its folder must exist.
        width: Width of the picture [pixels].
        height: Height of the picture [pixels].
        azimuth: Angle of the view around the upward axis [degrees].
        elevation: Angle of the view above the floor [degrees].
        zoom: Zoom factor; above one, closer than the view that contains everything.
        field: Label of the field that colours the rods; `None` for their own colours.
        captions: Whether to write title, time and legend on it.
        small: Whether to keep only 256 colours, which makes the file less than half as
            large.

    Raises:
        ValueError: A number is not positive, or there is no such field.
        IndexError: There is no such frame.
        TypeError: `replay` is no replay.

    Example:
        >>> replay = viz.Replay.from_rollout(state.positions[None], 0.02, times=[0.0])
        >>> viz.picture(replay, 0, "arm.png", width=320, height=240)
        >>> from matplotlib.image import imread
        >>> imread("arm.png").shape
        (240, 320, 3)
    """
    frames = [frame] if isinstance(frame, int | np.integer) else list(frame)
    frames = _checked(replay, frames)
    size = (width, height)
    painter = _Painter(replay, size, azimuth, elevation, zoom, field, frames, captions)
    _save_png(painter.paint(frames), path, small)


def film(
    replay: Recording,
    path: str | os.PathLike[str],
    *,
    frames_per_second: float = 20.0,
    speed: float = 1.0,
    width: int = 640,
    height: int = 480,
    azimuth: float = 35.0,
    elevation: float = 20.0,
    zoom: float = 1.0,
    field: str | None = None,
    captions: bool = True,
) -> None:
    """Writes the motion as a GIF, or as an MP4 if ffmpeg is installed.

    Args:
        replay: The replay to draw.
        path: The file to write, ending in .gif or .mp4; its folder must exist.
        frames_per_second: Pictures per second of the film [Hz]. Additional frames of
            the replay are dropped; none are interpolated.
        speed: Seconds of the replay per second of the film [1].
        width: Width of the picture [pixels]; even for MP4.
        height: Height of the picture [pixels]; even for MP4.
        azimuth: Angle of the view around the upward axis [degrees].
        elevation: Angle of the view above the floor [degrees].
        zoom: Zoom factor; above one, closer than the view that contains everything.
        field: Label of the field that colours the rods; `None` for their own colours.
        captions: Whether to write title, time and legend on it.

    Raises:
        ValueError: The file has another ending, or a number is not positive.
        FileNotFoundError: An MP4 is requested, but ffmpeg is not installed.

    Example:
        >>> path = np.stack([state.positions, 1.01 * state.positions])
        >>> replay = viz.Replay.from_rollout(path, 0.02, times=[0.0, 0.1])
        >>> viz.film(replay, "arm.gif", width=320, height=240)
        >>> from PIL import Image
        >>> with Image.open("arm.gif") as made:
        ...     made.n_frames, made.size
        (2, (320, 240))
    """
    ending = Path(path).suffix.lower()
    if ending not in (".gif", ".mp4"):
        raise ValueError(f"a film's file must end in .gif or .mp4, got {ending!r}")
    if not speed > 0:
        raise ValueError(f"speed must be positive, got {speed}")
    thin = replay.thinned(frames_per_second / speed)
    painter = _Painter(
        thin, (width, height), azimuth, elevation, zoom, field, None, captions
    )
    pictures = (painter.paint([k]) for k in range(thin.num_frames))
    # If the recorded frames are sparser, each is shown for longer.
    span = float(thin.times[-1] - thin.times[0]) / speed
    rate = (thin.num_frames - 1) / span if span else frames_per_second
    save = _save_gif if ending == ".gif" else _save_mp4
    save(pictures, rate, path)


def animation(
    replay: Recording,
    *,
    frames_per_second: float = 20.0,
    width: int = 640,
    height: int = 480,
    azimuth: float = 35.0,
    elevation: float = 20.0,
) -> FuncAnimation:
    """Returns a matplotlib animation, for `to_jshtml`, `save` and the like.

    For viewing a motion prefer `html`: it is smaller and smoother, and can be rotated.

    Args:
        replay: The replay to draw; frames beyond `frames_per_second` are thinned out.
        frames_per_second: Pictures per second of simulated time [Hz].
        width: Width of the picture [pixels].
        height: Height of the picture [pixels].
        azimuth: Angle of the view around the upward axis [degrees].
        elevation: Angle of the view above the floor [degrees].

    Raises:
        ValueError: The size or the rate is not positive.

    Example:
        >>> path = np.stack([state.positions, 1.01 * state.positions])
        >>> replay = viz.Replay.from_rollout(path, 0.02, times=[0.0, 0.1])
        >>> moving = viz.animation(replay, frames_per_second=10.0)
        >>> moving.save("arm.gif", writer="pillow")
        >>> type(moving).__name__
        'FuncAnimation'
    """
    need_matplotlib()
    from matplotlib.animation import FuncAnimation
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    thin = replay.thinned(frames_per_second)
    painter = _Painter(thin, (width, height), azimuth, elevation, fine=1)
    figure = Figure(figsize=(width / 100, height / 100), dpi=100)
    FigureCanvasAgg(figure)
    axes: Any = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    image = axes.imshow(painter.paint([0]))

    def show(index: int) -> list[Any]:
        image.set_data(painter.paint([index]))
        return [image]

    return FuncAnimation(
        figure,
        show,
        frames=thin.num_frames,
        init_func=list,
        interval=1000 / frames_per_second,
        cache_frame_data=False,
    )


class _Painter:
    """Renderer of a replay's frames as RGB pictures, all from the same viewpoint."""

    def __init__(
        self,
        replay: Recording,
        size: tuple[int, int],
        azimuth: float,
        elevation: float,
        zoom: float = 1.0,
        field: str | None = None,
        frames: Sequence[int] | None = None,
        captions: bool = True,
        fine: int = 2,
    ) -> None:
        need_matplotlib()
        for name, pixels in zip(("width", "height"), size, strict=True):
            if pixels < 1:
                raise ValueError(f"{name} must be positive, got {pixels} pixels")
        if not zoom > 0:
            raise ValueError(f"zoom must be positive, got {zoom}")
        if field is not None and field not in replay.fields:
            raise ValueError(
                f"field must be one of {list(replay.fields)}, got {field!r}"
            )
        self.replay, self.size, self.field = replay, size, field
        self.captions = captions
        self.shapes = Shapes(replay, field)
        low, high = replay.bounds()
        up = "xyz".index(replay.up)
        if frames is None:
            points = np.array(list(itertools.product(*zip(low, high, strict=True))))
        else:
            every = [self.shapes.at(k).corners.reshape(-1, 3) for k in frames]
            points = np.concatenate(every)
        floor = float(low[up]) if replay.floor is None else replay.floor
        wide = size[0] / size[1]
        room = 0.86 if captions else 0.93
        view = view_of(points, up, azimuth, elevation, (0.93 * wide, room), zoom)
        span = float(np.max(np.ptp(points, axis=0)))
        self.step = _round_step(span / 4)
        centre = (points.min(axis=0) + points.max(axis=0)) / 2
        self.ground = Ground(view, floor, self.step, size, centre, span)
        self.fine = fine

    def paint(self, frames: Sequence[int]) -> UInt8[np.ndarray, "height width 3"]:
        """Draws frames into one picture: the last in full colour, the others paler."""
        parts = []
        for order, index in enumerate(frames):
            part = self.shapes.at(index)
            share = (1 - (order + 1) / len(frames)) * 0.75
            pale = part.colours * (1 - share) + _PALE * share
            parts.append(part._replace(colours=pale))
        whole = Triangles(*(np.concatenate(some) for some in zip(*parts, strict=True)))
        light = rendered(whole, self.ground, self.fine)
        pixels = np.rint(255 * np.clip(light, 0, 1) ** (1 / 2.2)).astype(np.uint8)
        if not self.captions:
            return pixels
        return captioned(pixels, self.replay, frames[-1], self.field, self.step)


def _round_step(x: float) -> float:
    """The smallest of 1, 2, 5 times a power of ten that is not below x."""
    power = 10.0 ** np.floor(np.log10(max(x, 1e-12)))
    return float(next(m * power for m in (1, 2, 5, 10) if m * power >= 0.999 * x))


def _save_png(pixels: np.ndarray, path: Any, small: bool) -> None:
    from PIL import Image

    file, image = io.BytesIO(), Image.fromarray(pixels)
    if small:
        palette = Image.fromarray(_colourful(pixels)).quantize(256, kmeans=3)
        image = image.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG)
    image.save(file, format="png", optimize=True)
    write_atomically(path, file.getvalue())


def _colourful(pixels: np.ndarray) -> np.ndarray:
    """Sample of pixels for choosing a palette: all coloured ones, a sixth of the grey.

    Grey fills most pictures, and would otherwise take most of the palette.
    """
    flat = pixels.reshape(-1, 3)
    grey = np.ptp(flat.astype(int), axis=1) <= 24
    chosen = np.concatenate([flat[~grey], flat[grey][::6]])
    side = int(len(chosen) ** 0.5)
    return chosen[: side * side].reshape(side, side, 3)


def _save_gif(pictures: Iterator[np.ndarray], rate: float, path: Any) -> None:
    from PIL import Image

    # Maximum coverage keeps every colour close to the original. A palette of the most
    # frequent colours would drop the colour of a small target.
    first, *others = (
        Image.fromarray(pixels).quantize(
            160, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE
        )
        for pixels in pictures
    )
    file = io.BytesIO()
    first.save(
        file,
        format="gif",
        save_all=True,
        append_images=others,
        duration=max(20, round(1000 / rate)),
        loop=0,
        optimize=True,
    )
    write_atomically(path, file.getvalue())


def _save_mp4(pictures: Iterator[np.ndarray], rate: float, path: Any) -> None:
    program = shutil.which("ffmpeg")
    if program is None:
        raise FileNotFoundError("an MP4 needs ffmpeg, which is not installed: use .gif")
    first = next(pictures)
    height, width = first.shape[:2]
    source = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {rate:g} -i -"
    coded = "-c:v libx264 -pix_fmt yuv420p -crf 20"
    command = [program, "-y", "-loglevel", "error", *source.split(), *coded.split()]
    # Its own folder, so that no link can take the place of the unfinished film.
    with tempfile.TemporaryDirectory(dir=Path(path).parent) as folder:
        half = Path(folder) / "half.mp4"
        with subprocess.Popen([*command, half], stdin=subprocess.PIPE) as process:
            assert process.stdin is not None
            for pixels in (first, *pictures):
                process.stdin.write(pixels.tobytes())
            process.stdin.close()
        if process.returncode:
            raise OSError(f"ffmpeg could not write {path}")
        os.replace(half, path)


_INK, _QUIET = "#1c2430", "#5a6676"


def captioned(
    pixels: np.ndarray, replay: Recording, frame: int, field: str | None, step: float
) -> np.ndarray:
    """Writes title, time and grid spacing at the top of a picture, the legend below.

    `field` is the label of the field that colours the rods, or `None`; `step` is the
    grid spacing [m].
    """
    from PIL import Image, ImageDraw

    image = Image.fromarray(pixels)
    pen = ImageDraw.Draw(image)
    width, height = image.size
    unit = max(9, round(min(width, height) / 34))
    title, plain = _font(1.15 * unit, bold=True), _font(unit)
    edge = round(0.9 * unit)
    across = edge
    if replay.title:
        pen.text((edge, edge), replay.title, _INK, title)
        across += round(pen.textlength(replay.title, title)) + unit
    if replay.num_frames > 1:
        time = f"t = {replay.times[frame]:.3g} s"
        pen.text((across, edge + 0.15 * unit), time, _QUIET, plain)
    grid = f"lines every {step:g} m"
    pen.text((width - edge - pen.textlength(grid, plain), edge), grid, _QUIET, plain)
    entries = ([] if field else rod_legend(replay)) + other_legend(replay)
    if field:
        low, high = replay.field_range(field)
        words = f"{field}  " + f"{low:.3g} – {high:.3g}".replace("-", "−")
        entries = [("", words, "field"), *entries]
    place, line = float(edge), height - edge - 1.1 * unit
    for fill, words, kind in entries:
        wide = (5 if kind else 0.85) * unit
        need = wide + 0.5 * unit + pen.textlength(words, plain) + 1.2 * unit
        if place + need > width and place > edge:
            break
        colours = list(RAMP) if kind == "field" else re.findall("#[0-9a-f]{6}", fill)
        _swatch(pen, (place, line + 0.2 * unit), (wide, 0.85 * unit), colours)
        pen.text((place + wide + 0.5 * unit, line), words, _INK, plain)
        place += need
    return np.asarray(image)


def _swatch(
    pen: Any, place: tuple[float, float], size: tuple[float, float], colours: list[str]
) -> None:
    (x, y), (wide, tall) = place, size
    if len(colours) == 1:
        pen.ellipse((x, y, x + wide, y + tall), fill=colours[0])
        return
    stops = np.array([[int(c[k : k + 2], 16) for k in (1, 3, 5)] for c in colours])
    for k in range(round(wide)):
        at = k / max(wide - 1, 1) * (len(stops) - 1)
        mixed = [np.interp(at, range(len(stops)), stops[:, c]) for c in range(3)]
        pen.line((x + k, y, x + k, y + tall), fill=tuple(round(c) for c in mixed))


def _font(size: float, *, bold: bool = False) -> Any:
    import matplotlib
    from PIL import ImageFont

    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    folder = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    return ImageFont.truetype(str(folder / name), round(size))

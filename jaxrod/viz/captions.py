"""Captions of a picture: title, time, legend of the colours."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxrod.viz.colours import RAMP, other_legend, rod_legend

if TYPE_CHECKING:
    from jaxrod.viz.replay import Replay

_INK, _QUIET = "#1c2430", "#5a6676"


def captioned(
    pixels: np.ndarray, replay: Replay, frame: int, field: str | None, step: float
) -> np.ndarray:
    """A picture with its title and time above, and its legend below."""
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

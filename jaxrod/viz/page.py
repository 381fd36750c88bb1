"""The replay as one HTML page that plays anywhere, without a network.

The page holds its data and its program: about 60 kB of program, and two bytes per
coordinate before compression. Coordinates are rounded to 65536 steps of the range
each axis covers, that is to within range / 131070 (8 micrometres for 1 m).
"""

from __future__ import annotations

import base64
import html as markup
import json
import os
import re
import zlib
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxrod.files import write_atomically

if TYPE_CHECKING:
    from jaxrod.viz.replay import Replay

# In this order, because later ones use what earlier ones define.
_SCRIPTS = (
    "vectors",
    "recording",
    "shaders",
    "renderer",
    "camera",
    "labels",
    "colours",
    "readout",
    "player",
)
_STEPS = 65535


def html(
    replay: Replay, *, frames_per_second: float = 60.0, autoplay: bool = True
) -> str:
    """Returns a self-contained page that plays the replay in 3-D.

    Args:
        replay: the replay to show.
        frames_per_second: frames recorded more often than this [Hz] are thinned out;
            the page interpolates between frames.
        autoplay: start playing on opening, unless the reader asked their system for
            less motion.

    Raises:
        ValueError: frames_per_second is not positive.
    """
    header, data = encode(replay.thinned(frames_per_second))
    header["autoplay"] = bool(autoplay)
    program = "\n".join(_asset(f"{name}.js") for name in _SCRIPTS)
    parts = {
        "TITLE": markup.escape(replay.title or "Rod replay"),
        "STYLE": _asset("page.css"),
        # "</script" would end the surrounding element, "<!--<script" hide its end.
        "HEADER": json.dumps(header).replace("<", "\\u003c"),
        "DATA": base64.b64encode(data).decode("ascii"),
        "PROGRAM": f'(() => {{\n"use strict";\n{program}\n}})();',
    }
    return re.sub(r"%%([A-Z]+)%%", lambda m: parts[m[1]], _asset("page.html"))


def save_html(
    replay: Replay,
    path: str | os.PathLike[str],
    *,
    frames_per_second: float = 60.0,
    autoplay: bool = True,
) -> None:
    """Writes the page of `html` to a file, which appears whole or not at all.

    Args:
        replay: the replay to show.
        path: file to write; its folder must exist.
        frames_per_second: as in `html` [Hz].
        autoplay: as in `html`.
    """
    page = html(replay, frames_per_second=frames_per_second, autoplay=autoplay)
    write_atomically(path, page.encode("utf-8"))


def encode(replay: Replay) -> tuple[dict[str, Any], bytes]:
    """Packs a replay into a JSON header and compressed bytes.

    The bytes are zlib over, in order, little-endian float32: times since the first
    frame (T), nodal radii (R, n+1), readouts (K, T); then the coordinates of all
    P = R (n+1) + S points as unsigned 16-bit integers, series by series
    (P, 3, T), as zigzag differences in time, low bytes first, then high bytes.
    """
    num_frames, num_rods, num_nodes, _ = replay.positions.shape
    points = np.concatenate(
        [replay.positions.reshape(num_frames, -1, 3)]
        + [sphere.positions[:, None] for sphere in replay.spheres],
        axis=1,
    )
    low, high = points.min(axis=(0, 1)), points.max(axis=(0, 1))
    step = np.where(high > low, (high - low) / _STEPS, 1.0)
    levels = np.rint((points - low) / step).astype(np.int32).transpose(1, 2, 0)
    change = np.diff(levels, axis=-1, prepend=0)
    change = (change + 32768) % 65536 - 32768
    zigzag = ((change << 1) ^ (change >> 31)).astype(np.uint16)
    low_byte, high_byte = zigzag & 0xFF, zigzag >> 8
    floats = [replay.times - replay.times[0], nodal_radii(replay.radii)]
    floats += list(replay.readouts.values())
    data = b"".join(
        [np.asarray(part, "<f4").tobytes() for part in floats]
        + [part.astype(np.uint8).tobytes() for part in (low_byte, high_byte)]
    )
    box_low, box_high = replay.bounds()
    header = {
        "frames": num_frames,
        "rods": num_rods,
        "nodes": num_nodes,
        "start": float(replay.times[0]),
        "title": replay.title,
        "up": replay.up,
        "rodNames": list(replay.rod_names),
        "readouts": list(replay.readouts),
        "spheres": [{"radius": s.radius, "name": s.name} for s in replay.spheres],
        "cylinders": [
            {
                "start": c.start.tolist(),
                "end": c.end.tolist(),
                "radius": c.radius,
                "name": c.name,
            }
            for c in replay.cylinders
        ],
        "low": low.tolist(),
        "step": step.tolist(),
        "box": [box_low.tolist(), box_high.tolist()],
    }
    return header, zlib.compress(data, 9)


def nodal_radii(radii: np.ndarray) -> np.ndarray:
    """Radius of the drawn tube at the nodes [m]: (R, n) per element to (R, n+1)."""
    padded = np.pad(radii, ((0, 0), (1, 1)), mode="edge")
    return (padded[:, 1:] + padded[:, :-1]) / 2


@cache
def _asset(name: str) -> str:
    return resources.files("jaxrod.viz").joinpath("assets", name).read_text("utf-8")

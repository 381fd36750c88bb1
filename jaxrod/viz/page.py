"""Export of a replay as one HTML page that plays anywhere, without a network.

The page contains data and program: about 70 kB of program, and two bytes per
coordinate before compression. Coordinates are rounded to 65536 levels of each axis's
range, that is to within range / 131070 (8 micrometres for 1 m).

The program uses no library. The smallest bundle of three.js with orbit controls would
add 572 kB to every page. It does not draw tubes that bend between nodes, nor read the
recording.
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
from typing import Any

import numpy as np

from jaxrod.files import write_atomically
from jaxrod.viz import colours
from jaxrod.viz.recording import Recording
from jaxrod.viz.rods import at_nodes
from jaxrod.viz.shapes import shaded

# The order matters, because later scripts use the definitions of earlier ones.
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
"""Scripts of every page; those that start one come after them."""
_STEPS = 65535


def html(
    replay: Recording, *, frames_per_second: float = 60.0, autoplay: bool = True
) -> str:
    """Returns a self-contained page that plays the replay in 3-D.

    Args:
        replay: The replay to show.
        frames_per_second: Largest frame rate [Hz]; more frequent frames are thinned
            out. The page interpolates between frames.
        autoplay: Whether to start playing on opening, unless the reader's system
            requests reduced motion.

    Raises:
        ValueError: `frames_per_second` is not positive.

    Example:
        >>> path = state.positions[None]  # one frame
        >>> replay = viz.Replay.from_rollout(path, 0.02, [0.0], title="My arm")
        >>> "<title>My arm" in viz.html(replay)
        True
    """
    header, data = encode(replay.thinned(frames_per_second))
    header["autoplay"] = bool(autoplay)
    return page_of(json.dumps(header), base64.b64encode(data).decode("ascii"))


def page_of(header: str, data: str) -> str:
    """Returns the page that plays a recording.

    Args:
        header: The header of `encode` as JSON, with `autoplay`.
        data: The bytes of `encode` in base64.
    """
    return _filled("replay", "start", "", header, data)


def live_page(header: dict[str, Any], data: bytes) -> str:
    """Returns the page of a simulation, which asks its own server for pictures.

    Args:
        header: The header of `encode`, with what `live.js` reads.
        data: The bytes of `encode`.
    """
    packed = base64.b64encode(data).decode("ascii")
    return _filled("live", "live", "; connect-src 'self'", json.dumps(header), packed)


def _filled(controls: str, start: str, connect: str, header: str, data: str) -> str:
    """The frame with its controls; `connect` is added to its security policy."""
    program = "\n".join(_asset(f"{name}.js") for name in (*_SCRIPTS, start))
    parts = {
        "TITLE": markup.escape(json.loads(header)["title"] or "Rod replay"),
        "STYLE": _asset("page.css"),
        "CONNECT": connect,
        "CONTROLS": _asset(f"{controls}.html"),
        # "</script" would end the surrounding element, and "<!--<script" would hide its
        # end.
        "HEADER": header.replace("<", "\\u003c"),
        "DATA": data,
        "PROGRAM": f'(() => {{\n"use strict";\n{program}\n}})();',
    }
    return re.sub(r"%%([A-Z]+)%%", lambda m: parts[m[1]], _asset("frame.html"))


def save_html(
    replay: Recording,
    path: str | os.PathLike[str],
    *,
    frames_per_second: float = 60.0,
    autoplay: bool = True,
) -> None:
    """Writes the page of `html` to a file, which appears complete or not at all.

    Args:
        replay: The replay to show.
        path: File to write; its folder must exist.
        frames_per_second: Largest frame rate [Hz]; see `html`.
        autoplay: Whether to start playing on opening; see `html`.

    Example:
        >>> replay = viz.Replay.from_rollout(state.positions[None], 0.02, times=[0.0])
        >>> viz.save_html(replay, "arm.html")
        >>> from pathlib import Path
        >>> Path("arm.html").read_text()[:15]
        '<!DOCTYPE html>'
    """
    page = html(replay, frames_per_second=frames_per_second, autoplay=autoplay)
    write_atomically(path, page.encode("utf-8"))


def encode(replay: Recording) -> tuple[dict[str, Any], bytes]:
    """Packs a replay into a JSON header and compressed bytes.

    The bytes are zlib-compressed. They hold, in this order:

    - little-endian float32: times since the first frame (T), radii of the nodes of all
      rods, readouts (K, T), and position and normal of the corners of every triangle of
      every mesh (3 M, 6);
    - unsigned 16-bit levels over time, as zigzag differences between frames, first all
      low bytes, then all high bytes: coordinates of all points (P, 3, T), which are
      nodes, centres of spheres, origins of bodies and of arrows; orientations of bodies
      (B, 4, T); and arrows (A, 3, T);
    - fields at all nodes (F, N, T) as differences between frames of 8-bit levels, 255
      where a field has no value.
    """
    series, scales, count = _series(replay)
    change = np.diff(series, axis=-1, prepend=0)
    change = (change + 32768) % 65536 - 32768
    zigzag = ((change << 1) ^ (change >> 31)).astype(np.uint16)
    low_byte, high_byte = zigzag & 0xFF, zigzag >> 8
    floats = [replay.times - replay.times[0]]
    floats += [at_nodes(rods.radii) for rods in replay.rods]
    floats += list(replay.readouts.values())
    triangles = [np.concatenate(shaded(mesh), axis=-1) for mesh in replay.meshes]
    levels = [_levels(replay, label) for label in replay.fields]
    data = b"".join(
        [np.asarray(part, "<f4").tobytes() for part in floats + triangles]
        + [part.astype(np.uint8).tobytes() for part in (low_byte, high_byte)]
        + [
            np.diff(part, axis=-1, prepend=0).astype(np.uint8).tobytes()
            for part in levels
        ]
    )
    box_low, box_high = replay.bounds()
    header = {
        "frames": replay.num_frames,
        "nodes": [r.num_nodes for r in replay.rods for _ in range(r.num_rods)],
        "start": float(replay.times[0]),
        "title": replay.title,
        "up": replay.up,
        "floor": replay.floor,
        "rodColours": colours.rod_colours(replay),
        "rodLegend": colours.rod_legend(replay),
        "otherLegend": colours.other_legend(replay),
        "ramp": list(colours.RAMP),
        "readouts": list(replay.readouts),
        "fields": [
            {"label": label, "range": replay.field_range(label)}
            for label in replay.fields
        ],
        "spheres": [
            {"radius": s.radius, "colour": colours.SPHERES[k % len(colours.SPHERES)]}
            for k, s in enumerate(replay.spheres)
        ],
        "cylinders": [
            {
                "start": c.start.tolist(),
                "end": c.end.tolist(),
                "radius": c.radius,
                "colour": colours.FIXED,
            }
            for c in replay.cylinders
        ],
        "meshes": [
            {"corners": 3 * len(m.faces), "count": m.count, "colour": colour}
            for m, colour in zip(
                replay.meshes, colours.mesh_colours(replay), strict=True
            )
        ],
        "arrows": [
            {"count": a.vectors.shape[1], "colour": a.colour} for a in replay.arrows
        ],
        "points": count,
        "scales": scales,
        "box": [box_low.tolist(), box_high.tolist()],
    }
    return header, zlib.compress(data, 9)


def _series(replay: Recording) -> tuple[np.ndarray, list[Any], int]:
    """Quantises points, orientations and arrows to 16-bit levels over the frames.

    Returns:
        Levels (S, T), one row per coordinate; offset and step of the levels for points,
        orientations and arrows; and the number of points.
    """
    frames = replay.num_frames
    points = [r.positions.reshape(frames, -1, 3) for r in replay.rods]
    points += [sphere.positions[:, None] for sphere in replay.spheres]
    points += [mesh.positions for mesh in replay.meshes]
    points += [arrows.origins for arrows in replay.arrows]
    size = float(np.linalg.norm(np.subtract(*replay.bounds())))
    turns = [mesh.orientations for mesh in replay.meshes]
    ways = [arrows.drawn(size)[0] for arrows in replay.arrows]
    series, scales = [], []
    for parts, width in ((points, 3), (turns, 4), (ways, 3)):
        whole = np.concatenate([*parts, np.zeros((frames, 0, width))], axis=1)
        low, high = np.zeros(width), np.zeros(width)
        if whole.size:
            low, high = whole.min(axis=(0, 1)), whole.max(axis=(0, 1))
        step = np.where(high > low, (high - low) / _STEPS, 1.0)
        levels = np.rint((whole - low) / step).astype(np.int32)
        series.append(levels.transpose(1, 2, 0).reshape(-1, frames))
        scales.append({"low": low.tolist(), "step": step.tolist()})
    return np.concatenate(series), scales, len(series[0]) // 3


def _levels(replay: Recording, label: str) -> np.ndarray:
    """8-bit levels of a field at all nodes (N, T): 0 to 254, or 255 without a value."""
    low, high = replay.field_range(label)
    parts = []
    for rods in replay.rods:
        shape = rods.positions.shape[:3]
        values = rods.fields.get(label, np.full(shape, np.nan))
        known = np.isfinite(values)
        share = (np.where(known, values, low) - low) / (high - low)
        level = np.where(known, np.rint(254 * np.clip(share, 0, 1)), 255)
        parts.append(level.reshape(replay.num_frames, -1).T.astype(np.int32))
    return np.concatenate(parts)


@cache
def _asset(name: str) -> str:
    return resources.files("jaxrod.viz").joinpath("assets", name).read_text("utf-8")

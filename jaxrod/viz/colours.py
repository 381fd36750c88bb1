"""Colours of rods, bodies and fields, and the entries of the legend."""

from __future__ import annotations

import colorsys

import numpy as np

from jaxrod.viz.recording import Recording

RAMP = ("#3b4cc0", "#3fa0c8", "#5ec27a", "#f2c14e", "#d1402f")
"""Colour map of fields, from the lowest value to the highest."""
RODS = (
    "#2f7fd6",
    "#e0653a",
    "#2a9d74",
    "#b45cc4",
    "#c9a227",
    "#5b6ee1",
    "#d64570",
    "#4aa3a2",
)
SPHERES = ("#f59e0b", "#10a37f", "#d64570", "#7c5cd6")
BODIES = ("#e8b04a", "#8a97a8", "#7fa88f", "#b08968")
FIXED = "#9aa3b0"
"""Colour of cylinders and other bodies at rest."""

Entry = tuple[str, str, str]
"""Legend entry: CSS fill of the swatch, text, and "ramp" for a gradient, else ""."""


def rod_colours(replay: Recording) -> list[str]:
    """Colour of every rod as "#rrggbb", in the order of `replay.rods`.

    With a single group of rods each rod has a different colour; beyond eight rods the
    hue varies along the group. With several groups each group has a different colour.
    A group's `colour` takes precedence.
    """
    colours: list[str] = []
    free = 0
    for rods in replay.rods:
        if rods.colour:
            colours += [rods.colour] * rods.num_rods
        elif len(replay.rods) == 1:
            colours += [_one_of(k, rods.num_rods) for k in range(rods.num_rods)]
        else:
            colours += [RODS[free % len(RODS)]] * rods.num_rods
            free += 1
    return colours


def _one_of(rod: int, rods: int) -> str:
    if rods <= len(RODS):
        return RODS[rod]
    hue = (200 + 200 * rod / (rods - 1)) % 360 / 360
    red, green, blue = colorsys.hls_to_rgb(hue, 0.56, 0.55)
    return "#" + "".join(f"{round(255 * c):02x}" for c in (red, green, blue))


def mesh_colours(replay: Recording) -> list[str]:
    """Colour of every mesh as "#rrggbb": the mesh's `colour`, or one of `BODIES`."""
    return [
        mesh.colour or BODIES[k % len(BODIES)] for k, mesh in enumerate(replay.meshes)
    ]


def rod_legend(replay: Recording) -> list[Entry]:
    """Legend entries of the rods, for pictures in which no field colours them."""
    colours = rod_colours(replay)
    if not replay.rods:
        return []
    if len(replay.rods) > 1:
        entries, first = [], 0
        for rods in replay.rods:
            words = rods.name or "rod"
            words = f"{words} × {rods.num_rods}" if rods.num_rods > 1 else words
            entries.append((colours[first], words, ""))
            first += rods.num_rods
        return entries
    (rods,) = replay.rods
    if rods.names and rods.num_rods <= len(RODS):
        return [(colours[k], name, "") for k, name in enumerate(rods.names)]
    if rods.num_rods == 1 or rods.colour:
        words = rods.name or "rod"
        words = f"{words} × {rods.num_rods}" if rods.num_rods > 1 else words
        return [(colours[0], words, "")]
    some = [colours[round(k * (rods.num_rods - 1) / 5)] for k in range(6)]
    words = f"{rods.name} × {rods.num_rods}" if rods.name else f"{rods.num_rods} rods"
    return [(f"linear-gradient(90deg, {', '.join(some)})", words, "ramp")]


def other_legend(replay: Recording) -> list[Entry]:
    """Legend entries of spheres, cylinders, meshes and arrows."""
    entries = [
        (SPHERES[k % len(SPHERES)], sphere.name, "")
        for k, sphere in enumerate(replay.spheres)
    ]
    counts: dict[tuple[str, str], int] = {}
    for cylinder in replay.cylinders:
        key = (FIXED, cylinder.name)
        counts[key] = counts.get(key, 0) + 1
    for mesh, colour in zip(replay.meshes, mesh_colours(replay), strict=True):
        if mesh.name:
            counts[(colour, mesh.name)] = (
                counts.get((colour, mesh.name), 0) + mesh.count
            )
    entries += [
        (colour, f"{name} × {count}" if count > 1 else name, "")
        for (colour, name), count in counts.items()
    ]
    for arrows in replay.arrows:
        if arrows.largest > 0:
            words = f"{arrows.name}, largest {arrows.largest:.3g}"
            entries.append((arrows.colour, words, ""))
    return entries


def linear(colour: str) -> np.ndarray:
    """Linear red, green and blue of "#rrggbb", from 0 to 1, by a gamma of 2.2."""
    return (np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255) ** 2.2


def ramp(levels: np.ndarray) -> np.ndarray:
    """Linear red, green and blue (..., 3) of the colour map `RAMP` at levels 0 to 1."""
    stops = np.array([linear(colour) for colour in RAMP])
    place = np.clip(levels, 0, 1) * (len(RAMP) - 1)
    first = np.minimum(place.astype(int), len(RAMP) - 2)
    share = (place - first)[..., None]
    return stops[first] * (1 - share) + stops[first + 1] * share

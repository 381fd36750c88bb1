"""Report on a twin: an HTML page of its unknowns, errors and pictures of markers."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from jaxrod.files import write_atomically
from jaxrod.twin.arm import UNKNOWNS
from jaxrod.twin.identification import Comparison, Twin, root_mean_square

STYLE = """\
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto;
  padding: 0 1rem; color: #1a1a1a; background: #fff; }
table { border-collapse: collapse; margin: 1rem 0; }
th, td { padding: .2rem .8rem .2rem 0; text-align: right; }
th:first-child, td:first-child, td.words { text-align: left; }
tr { border-bottom: 1px solid #ccc; }
figure { display: inline-block; margin: .5rem 1rem .5rem 0; }
.seen { fill: none; stroke: #0072b2; stroke-width: 2; }
.made { stroke: #d55e00; stroke-width: 2; }
.gap { stroke: #888; stroke-width: 1; }
@media (prefers-color-scheme: dark) {
  body { color: #eee; background: #161616; } tr { border-color: #444; } }
"""
"""Style sheet of the page; its colours can be distinguished by colour-blind readers."""

WIDTH, HEIGHT = 220, 260
"""Width and height of a picture of the markers [pixels]."""
VIEWS = ((0, 2, "x", "z"), (1, 2, "y", "z"))
"""Coordinates of each picture: indices to the right and upwards, and their names."""


def save_report(
    path: str | Path,
    twin: Twin,
    forecasts: Sequence[Comparison] = (),
) -> None:
    """Writes an HTML report on a twin: unknowns, errors of recordings, and pictures.

    Args:
        path: Path of the file to write; an existing file is replaced atomically.
        twin: The twin.
        forecasts: Comparisons with recordings that were not fitted, from
            `Twin.compare`.

    Raises:
        OSError: If the file cannot be written.
    """
    fitted = twin.compare(twin.recordings)
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8>",
        "<meta name=viewport content='width=device-width'>",
        "<title>Twin of an arm</title>",
        f"<style>{STYLE}</style>",
        "<h1>Twin of an arm</h1>",
        f"<p>{len(fitted)} recordings were fitted, {len(forecasts)} forecast. Noise of "
        f"a coordinate: {1000 * twin.noise:.2f} mm.</p><h2>Unknowns</h2>",
        _unknowns(twin),
        *[f"<p>{escape(remark)}.</p>" for remark in twin.remarks],
        "<h2>Fitted recordings</h2>",
        _errors(twin, fitted),
        *([] if not forecasts else ["<h2>Forecasts</h2>", _errors(twin, forecasts)]),
        "<h2>Pictures</h2><p>Circles: recorded. Crosses: the twin. Last frame of each "
        "recording, seen from two sides.</p>",
        *[_pictures(one) for one in [*fitted, *forecasts]],
        "</html>",
    ]
    write_atomically(path, "\n".join(parts).encode())


def _unknowns(twin: Twin) -> str:
    """HTML table of the unknowns, with values and standard deviations."""
    fit = twin.fit
    values = np.asarray(fit.parameters.flat(fit.values))
    sds = np.asarray(fit.parameters.flat(fit.standard_deviations))
    left = np.sqrt(np.diagonal(np.asarray(fit.covariance)))
    rows = ["<tr><th>unknown<th>value<th>sd<th>sd left of the drawing's<th>"]
    for k, (name, drawn) in enumerate(twin.drawn_sds.items()):
        words = UNKNOWNS[name.partition("[")[0]]
        rows.append(
            f"<tr><td>{escape(name)}<td>{values[k]:.5g}<td>{sds[k]:.2g}"
            f"<td>{left[k] / drawn:.0%}<td class=words>{escape(words)}"
        )
    return f"<table>{''.join(rows)}</table>"


def _errors(twin: Twin, comparisons: Sequence[Comparison]) -> str:
    """HTML table of root mean square distances of markers from predictions [mm]."""
    names = [escape(marker.name) for marker in twin.arm.markers]
    rows = [f"<tr><th>distance [mm]<th>{'<th>'.join(names)}"]
    for one in comparisons:
        cells = _millimetres(one.errors)
        rows.append(f"<tr><td>{escape(one.recording.name)}<td>{'<td>'.join(cells)}")
    cells = _millimetres(root_mean_square([one.errors for one in comparisons]))
    rows.append(f"<tr><td>root mean square<td>{'<td>'.join(cells)}")
    return f"<table>{''.join(rows)}</table>"


def _millimetres(errors: np.ndarray) -> list[str]:
    """Formats errors in metres as text in millimetres; a dash if not finite."""
    return [f"{1000 * e:.1f}" if np.isfinite(e) else "-" for e in errors]


def _pictures(one: Comparison) -> str:
    """SVG pictures of the last frame: recorded and predicted markers in two views."""
    seen, made = one.recording.points[-1], one.predicted[-1]
    every = np.concatenate([seen[np.all(np.isfinite(seen), axis=1)], made])
    low, high = every.min(axis=0), every.max(axis=0)
    scale = 0.8 * min(WIDTH, HEIGHT) / max(float(np.max(high - low)), 1e-9)
    middle = (low + high) / 2
    figures = []
    for across, up, x_name, y_name in VIEWS:

        def at(
            p: np.ndarray, across: int = across, up: int = up
        ) -> tuple[float, float]:
            x = WIDTH / 2 + scale * (p[across] - middle[across])
            return x, HEIGHT / 2 - scale * (p[up] - middle[up])

        drawn = []
        for p, q in zip(seen, made, strict=True):
            u, v = at(q)
            if np.all(np.isfinite(p)):
                x, y = at(p)
                drawn.append(
                    f"<line class=gap x1={x:.1f} y1={y:.1f} x2={u:.1f} y2={v:.1f} />"
                    f"<circle class=seen cx={x:.1f} cy={y:.1f} r=5 />"
                )
            drawn.append(
                f"<path class=made d='M{u - 4:.1f} {v - 4:.1f}l8 8m0 -8l-8 8' />"
            )
        label = f"{one.recording.name}: markers and twin in {x_name} and {y_name}"
        figures.append(
            f"<svg width={WIDTH} height={HEIGHT} role=img aria-label='{escape(label)}'>"
            f"{''.join(drawn)}</svg>"
        )
    name = escape(one.recording.name)
    return f"<figure>{''.join(figures)}<figcaption>{name}</figcaption></figure>"

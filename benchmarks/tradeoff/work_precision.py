"""Work-precision diagrams: error against cost, and the best settings."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from jaxrod.files import write_atomically
from jaxrod.viz import style
from jaxrod.viz.curves import need_matplotlib

if TYPE_CHECKING:
    from benchmarks.tradeoff.grid import Row
    from jaxrod.viz.curves import FilePath

_QUIET = style.QUIET


@dataclass(frozen=True)
class Words:
    """Words at the axes of a picture."""

    error: str = "error of the tip, RMS over time [lengths]"
    """Label of the axis of errors."""
    cost: str = "wall-clock time per simulated second and rod [s]"
    """Label of the axis of costs."""
    single: str = "one rod"
    """Heading of the panel for a single model."""
    line: str = "1 % of the length"
    """Name of the line at an error of 0.01."""


_KINDS = (
    # simulator, mode, integrator: label, colour, marker
    (("pyelastica", "pyelastica", "explicit"), "PyElastica", style.ORANGE, "s"),
    (("mujoco", "consistent", "explicit"), "MuJoCo's cable", style.PURPLE, "v"),
    (("jaxrod", "pyelastica", "explicit"), "PyElastica's law", style.INK, "^"),
    (("jaxrod", "consistent", "implicit"), "implicit", style.GREEN, "D"),
    (("jaxrod", "consistent", "explicit"), "explicit", style.BLUE, "o"),
)


def work_precision(
    rows: Sequence[Row],
    out: FilePath,
    *,
    title: str = "",
    floor: float = 0.0,
    words: Words | None = None,
) -> None:
    """Draws error against cost into a PNG file, one panel for every batch size.

    Every setting is a point; the line joins settings that no other beats in both.
    Settings that did not stay finite are left out. The file appears complete or not at
    all.

    Args:
        rows: Measurements, from `jaxrod.tradeoff`.
        out: The PNG file to write; its folder must exist.
        title: Heading of the picture.
        floor: Error of the reference, below which errors mean nothing; shaded.
        words: Words at the axes; by default those of rods and their tips.

    Raises:
        ValueError: If no row has a finite error.
    """
    finite = [row for row in rows if row.error < 10]
    if not finite:
        raise ValueError("rows must hold a setting with a finite error, got none")
    write_atomically(out, _draw(finite, title, floor, words or Words()))


def _draw(rows: list[Row], title: str, floor: float, words: Words) -> bytes:
    need_matplotlib()
    batches = sorted({row.batch for row in rows})
    # Below each other, so that a column of text shows letters at their size.
    figure, panels = style.charts(7.2, 2.9 * len(batches) + 1.5, rows=len(batches))
    for axes in panels[1:, 0]:
        axes.sharex(panels[0][0])
        axes.sharey(panels[0][0])
    for axes, batch in zip(panels[:, 0], batches, strict=True):
        _panel(axes, [row for row in rows if row.batch == batch], floor, words)
        many = words.single if batch == 1 else f"{batch:,} rods at once"
        axes.set_title(many, fontsize=10, color=_QUIET)
    figure.supylabel(words.error, fontsize=10)
    # Below the panels: within, there is no corner that no simulator's points reach.
    named: dict[str, Any] = {}
    for axes in panels[:, 0]:
        handles, labels = axes.get_legend_handles_labels()
        named |= dict(zip(labels, handles, strict=True))
    figure.legend(
        named.values(),
        named.keys(),
        loc="outside lower center",
        ncols=3,
        frameon=False,
        fontsize=9,
    )
    panels[-1, 0].set_xlabel(words.cost)
    if title:
        figure.suptitle(title, fontsize=12, fontweight="bold")
    picture = io.BytesIO()
    figure.savefig(picture, format="png", metadata={"Description": title})
    return picture.getvalue()


def _panel(axes: Any, rows: list[Row], floor: float, words: Words) -> None:
    from benchmarks.tradeoff.grid import pareto

    for key, label, colour, marker in _KINDS:
        ours = [
            row
            for row in rows
            if (row.simulator, row.setting.mode, row.setting.integrator) == key
        ]
        for dtype, filled in (("float32", True), ("float64", False)):
            some = [row for row in ours if row.setting.dtype == dtype]
            if not some:
                continue
            axes.plot(
                [row.wall_s_per_sim_s for row in some],
                [row.error for row in some],
                linestyle="none",
                marker=marker,
                markersize=5,
                color=colour,
                markerfacecolor=colour if filled else "white",
                label=f"{label}, {dtype}",
            )
    front = pareto([row for row in rows if row.simulator == "jaxrod"])
    axes.plot(
        [row.wall_s_per_sim_s for row in front],
        [row.error for row in front],
        color=style.BLUE,
        linewidth=1.2,
        alpha=0.6,
        label="best of jaxrod",
    )
    axes.set_xscale("log")
    axes.set_yscale("log")
    if floor > 0:
        axes.axhspan(
            floor / 10,
            floor,
            color=_QUIET,
            alpha=0.12,
            linewidth=0,
            label="uncertainty of the reference",
        )
    axes.axhline(
        0.01,
        color=_QUIET,
        linewidth=0.7,
        linestyle=(0, (4, 3)),
        label=words.line,
    )
    axes.tick_params(labelsize=9)

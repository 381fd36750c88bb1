"""One style of all charts: colours that colour-blind readers tell apart, quiet axes."""

from __future__ import annotations

from typing import Any

BLUE, ORANGE, GREEN, PURPLE = "#0072b2", "#d55e00", "#009e73", "#8e1c63"
GREY = "#7a8594"
"""Colours of curves, after Okabe and Ito; the last two are darker than theirs."""
INK, QUIET, GRID = "#1c2430", "#5a6676", "#d5dbe4"
"""Colours of text and references, of secondary text, and of grid lines."""
COLOURS = (BLUE, ORANGE, GREEN, PURPLE, GREY, INK)
"""Colours of several curves of one chart, in this order."""


def charts(width: float, height: float, rows: int = 1, columns: int = 1) -> Any:
    """Makes a figure of `rows` by `columns` charts that is drawn without a window.

    Args:
        width: Width [inches].
        height: Height [inches].
        rows: Number of rows.
        columns: Number of columns.

    Returns:
        The figure, and its axes as an array of `rows` by `columns`.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # White on every page, whatever the reader's settings: curves are chosen for it.
    figure = Figure((width, height), dpi=130, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(rows, columns, squeeze=False)
    for axes in panels.flat:
        axes.set_prop_cycle(color=COLOURS)
        axes.grid(color=GRID, linewidth=0.6)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(colors=QUIET, labelcolor="black")
    return figure, panels

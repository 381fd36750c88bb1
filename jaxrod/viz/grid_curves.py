"""Learning curves of groups of runs: means and spreads."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxrod.files import write_atomically
from jaxrod.viz.curves import FilePath, ReferenceScore, common_steps, read_curve
from jaxrod.viz.matplotlib_needed import need_matplotlib

_COLOURS = {
    "PPO": "#2563c9",
    "TRPO": "#b45309",
    "SAC": "#15803d",
    "TD3": "#a21caf",
    "DDPG": "#5a6676",
}


def grid_curves(
    curves: Mapping[str, Sequence[FilePath]],
    references: Mapping[str, ReferenceScore | None],
    out: FilePath,
    *,
    title: str = "",
) -> None:
    """Draws groups of runs of a task into a PNG file: return against steps and time.

    Left: return over control steps, as the mean over seeds with its standard deviation
    shaded. Reference scores are dashed lines, in bands of their spread over seeds.
    Right: the same over wall-clock time, with the references at their hours.

    Args:
        curves: For every group, such as "PPO", the curve of every seed: a CSV file with
            the columns env_steps, wall_s [s] and episode_return_mean.
        references: Score to compare each group with; None or missing if there is none.
        out: The PNG file to write; its folder must exist.
        title: Heading of the picture.

    Raises:
        ValueError: A file lacks the columns or has no finished episode.
    """
    need_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import (
        EngFormatter,
        LogLocator,
        NullFormatter,
        StrMethodFormatter,
    )

    figure = Figure(figsize=(11, 4.8), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    steps_axes, clock_axes = np.ravel(
        np.asarray(figure.subplots(1, 2, sharey=True), dtype=object)
    )
    runs = {
        name: [read_curve(Path(f)) for f in files] for name, files in curves.items()
    }
    last = max(run.steps[-1] for some in runs.values() for run in some)
    for k, (name, some) in enumerate(runs.items()):
        colour = _COLOURS.get(name, f"C{k % 10}")
        steps = common_steps(some)
        values = np.array([np.interp(steps, r.steps, r.returns) for r in some])
        wall = np.mean([np.interp(steps, r.steps, r.wall) for r in some], axis=0)
        mean, spread = values.mean(0), values.std(0)
        for axes, across in ((steps_axes, steps), (clock_axes, wall / 3600)):
            axes.plot(across, mean, color=colour, linewidth=2, label=name)
            axes.fill_between(
                across, mean - spread, mean + spread, color=colour, alpha=0.18, lw=0
            )
        reference = references.get(name)
        if reference is not None:
            score, error = reference.mean, reference.spread
            steps_axes.axhspan(score - error, score + error, color=colour, alpha=0.08)
            steps_axes.axhline(score, color=colour, linewidth=1, linestyle="--")
            if reference.wall_hours is not None:
                hours = reference.wall_hours
                clock_axes.errorbar(
                    hours, score, error, color=colour, marker="D", capsize=3
                )
    steps_axes.set_xlim(0, last)
    dashed = " (dashed: references)" if any(references.values()) else ""
    steps_axes.set_xlabel(f"control steps{dashed}")
    steps_axes.set_ylabel("episode return")
    steps_axes.xaxis.set_major_formatter(EngFormatter(sep=" "))
    clock_axes.set_xscale("log")
    clock_axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    clock_axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    clock_axes.xaxis.set_minor_formatter(NullFormatter())
    clock_axes.set_xlabel("wall-clock time [h]")
    for axes in (steps_axes, clock_axes):
        axes.grid(color="#d5dbe4", linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
    steps_axes.legend(loc="best", frameon=True, edgecolor="none", fontsize=8)
    if title:
        figure.suptitle(title, fontsize=12, fontweight="bold")
    picture = io.BytesIO()
    figure.savefig(picture, format="png", metadata={"Description": title})
    write_atomically(out, picture.getvalue())

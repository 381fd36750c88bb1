"""Learning curves: the return of training runs over time, alone and in groups."""

from __future__ import annotations

import dataclasses
import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxrod.files import read_csv, reading, write_atomically
from jaxrod.viz import style

_COLUMNS = ("env_steps", "wall_s", "episode_return_mean")
RETURN = "episode return"
REWARD = "mean reward of an action (no episode has ended)"
_GROUP_COLOURS = {
    "PPO": style.BLUE,
    "TRPO": style.ORANGE,
    "SAC": style.GREEN,
    "TD3": style.PURPLE,
    "DDPG": style.GREY,
}
"""Colours of curves by name of their group; other groups get those of the style."""
_RUN_COLOUR, _REFERENCE_COLOUR, _QUIET = style.BLUE, style.ORANGE, style.QUIET

_LABEL = 0.06
"""Smallest distance of two labels of the clock, as a fraction of the axis [1]."""

FilePath = str | os.PathLike[str]


class Curve(NamedTuple):
    """Learning curve of a run: episode returns over control steps and wall time [s]."""

    steps: np.ndarray
    wall: np.ndarray
    returns: np.ndarray
    quantity: str = RETURN
    """Name of the quantity in `returns`: `RETURN`, or `REWARD` if no episode ended."""


@dataclasses.dataclass(frozen=True)
class ReferenceScore:
    """Score of a reference, drawn as a line to compare learning curves with.

    Example:
        >>> published = viz.ReferenceScore("the paper's PPO", mean=25.0, spread=3.0)
        >>> published.label, published.mean
        ("the paper's PPO", 25.0)
    """

    label: str
    """Name in the legend."""
    mean: float
    """Final episode return of the reference, mean over seeds."""
    spread: float = 0.0
    """Standard deviation of the final return over seeds."""
    wall_hours: float | None = None
    """Wall-clock duration of a run [h]; None if not known."""


def learning_curve(
    progress: FilePath | Sequence[FilePath],
    out: FilePath,
    *,
    reference: ReferenceScore | None = None,
    title: str = "",
    label: str = "jaxrod",
) -> None:
    """Draws the episode return of one or more training runs into a PNG file.

    The lower axis is control steps, the upper axis the wall-clock time of the run. A
    reference score is a dashed line, in a band of its spread over seeds. Several runs
    are drawn as thin lines, with their mean on top. If no episode has ended in the
    runs, the mean reward of an action is drawn instead. The file appears complete or
    not at all.

    Args:
        progress: File progress.csv of each run, with the columns env_steps, wall_s [s]
            and episode_return_mean; rows without a return are skipped. If there are no
            returns at all, reward_mean is drawn.
        out: The PNG file to write; its folder must exist.
        reference: A score to compare with.
        title: Heading of the picture.
        label: Name of the runs in the legend.

    Raises:
        ValueError: A file lacks the columns, or has neither a finished episode nor
            rewards; or some runs have only episodes and others only rewards.

    Example:
        >>> names = "env_steps,wall_s,episode_return_mean"
        >>> rows = [[10_000, 5.0, 1.0], [20_000, 10.0, 2.5]]
        >>> np.savetxt("progress.csv", rows, delimiter=",", header=names, comments="")
        >>> viz.learning_curve("progress.csv", "curve.png", title="First run")
        >>> from pathlib import Path
        >>> Path("curve.png").exists()
        True
    """
    paths = [progress] if isinstance(progress, (str, os.PathLike)) else list(progress)
    if not paths:
        raise ValueError("progress must name at least one progress.csv, got none")
    runs = [read_curve(Path(path)) for path in paths]
    if len({run.quantity for run in runs}) > 1:
        raise ValueError(
            "progress must not mix runs with finished episodes and runs without"
        )
    if runs[0].quantity == REWARD:
        reference = None  # It is a return.
    write_atomically(out, _draw(runs, reference, title, label))


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
    from matplotlib.ticker import (
        EngFormatter,
        LogLocator,
        NullFormatter,
        StrMethodFormatter,
    )

    figure, ((steps_axes, clock_axes),) = style.charts(11, 4.8, columns=2)
    clock_axes.sharey(steps_axes)
    clock_axes.tick_params(labelleft=False)
    runs = {
        name: [read_curve(Path(f)) for f in files] for name, files in curves.items()
    }
    last = max(run.steps[-1] for some in runs.values() for run in some)
    for k, (name, some) in enumerate(runs.items()):
        colour = _GROUP_COLOURS.get(name, style.COLOURS[k % len(style.COLOURS)])
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
    steps_axes.legend(loc="best", frameon=True, edgecolor="none", fontsize=8)
    if title:
        figure.suptitle(title, fontsize=12, fontweight="bold")
    picture = io.BytesIO()
    figure.savefig(picture, format="png", metadata={"Description": title})
    write_atomically(out, picture.getvalue())


def read_curve(path: Path) -> Curve:
    """Reads a learning curve from progress.csv; rows without a return are skipped.

    If no row has a return, the curve shows the mean rewards.

    Raises:
        DamagedFileError: The file is not a table, or lacks the columns.
        ValueError: The file has neither finished episodes nor rewards.
    """
    columns, rows = read_csv(path)
    with reading(path):
        missing = [name for name in _COLUMNS if name not in columns]
        if missing and (columns or rows):
            raise ValueError(f"it must have the columns {_COLUMNS}, lacks {missing}")
        names = (*_COLUMNS, *(name for name in ("reward_mean",) if name in columns))
        places = [columns.index(name) for name in names if not missing]
        table = [[_number(row[place]) for place in places] for row in rows]
    every = np.array(table, dtype=float).reshape(len(table), -1)
    values, quantity = _finite(every[:, :3]), RETURN
    if not len(values) and every.shape[1] > 3:
        values, quantity = _finite(every[:, [0, 1, 3]]), REWARD
    if not len(values):
        raise ValueError(f"{path} must hold an episode_return_mean, got none")
    # A resumed run may repeat rows: the last one counts.
    steps, last = np.unique(values[::-1, 0], return_index=True)
    _, wall, returns = values[::-1][last].T
    return Curve(steps, wall, returns, quantity)


def _finite(table: np.ndarray) -> np.ndarray:
    return table[np.isfinite(table).all(axis=1)].reshape(-1, 3)


def _number(text: str) -> float:
    return float(text) if text else float("nan")


def _draw(
    runs: list[Curve], reference: ReferenceScore | None, title: str, label: str
) -> bytes:
    need_matplotlib()
    picture = io.BytesIO()
    _figure(runs, reference, title, label).savefig(
        picture, format="png", metadata={"Description": _alt(runs, reference)}
    )
    return picture.getvalue()


def _figure(
    runs: list[Curve], reference: ReferenceScore | None, title: str, label: str
) -> Any:
    from matplotlib.ticker import EngFormatter, FuncFormatter

    figure, ((axes,),) = style.charts(8, 4.8)
    last_step = max(run.steps[-1] for run in runs)

    if reference is not None:
        low, high = (reference.mean + s * reference.spread for s in (-1, 1))
        axes.axhspan(low, high, color=_REFERENCE_COLOUR, alpha=0.13, linewidth=0)
        axes.axhline(
            reference.mean,
            color=_REFERENCE_COLOUR,
            linewidth=1.4,
            linestyle=(0, (5, 2)),
            label=_reference_label(reference),
        )
    several = len(runs) > 1
    for run in runs:
        axes.plot(
            run.steps,
            run.returns,
            color=_RUN_COLOUR,
            linewidth=0.8 if several else 2.0,
            alpha=0.4 if several else 1.0,
            # A line through a single point is invisible. The point may lie at an edge.
            marker="o" if len(run.steps) == 1 else None,
            clip_on=len(run.steps) > 1,
            label=None if several else _run_label(label, runs),
        )
    if several:
        steps = common_steps(runs)
        mean = np.mean([np.interp(steps, r.steps, r.returns) for r in runs], axis=0)
        axes.plot(
            steps, mean, color=_RUN_COLOUR, linewidth=2.2, label=_run_label(label, runs)
        )

    axes.set_xlim(0, max(last_step, 1))
    axes.set_xlabel("control steps")
    axes.set_ylabel(runs[0].quantity)
    axes.xaxis.set_major_formatter(EngFormatter(sep=" "))
    axes.yaxis.set_major_formatter(
        FuncFormatter(lambda y, _: _evenly(y, axes.get_yticks()))
    )
    axes.legend(loc="best", frameon=True, framealpha=0.9, edgecolor="none", fontsize=9)
    _clock(axes, runs, last_step)
    if title:
        figure.suptitle(title, fontsize=12, fontweight="bold")
    return figure


def _evenly(value: float, ticks: np.ndarray) -> str:
    """Text of a tick's `value`, with as many decimals as all `ticks` need."""
    spacing = abs(ticks[1] - ticks[0]) if len(ticks) > 1 else 1.0
    decimals = next(
        count
        for count in range(16)
        if np.allclose(ticks, np.round(ticks, count), rtol=0, atol=1e-6 * spacing)
        or count == 15
    )
    return f"{value + 0.0:,.{decimals}f}".replace("-", "−")


def _clock(axes: Any, runs: list[Curve], last_step: float) -> None:
    """Adds an upper axis to `axes`: wall-clock time at each step, mean over `runs`.

    The lower axis has control steps, up to `last_step`.
    """
    steps = np.linspace(0, last_step, 400)
    # Runs start at step 0, time 0; a run that stopped early is extrapolated.
    pace = [np.interp(steps, [0, *r.steps], [0, *r.wall]) for r in runs]
    for run, wall in zip(runs, pace, strict=True):
        beyond = steps > run.steps[-1]
        wall[beyond] *= steps[beyond] / max(run.steps[-1], 1)
    wall = np.mean(pace, axis=0)
    unit, seconds = next(
        (u, s)
        for u, s in (("h", 3600), ("min", 60), ("s", 1))
        if wall[-1] >= s or s == 1
    )
    top = axes.secondary_xaxis("top")
    first = np.interp(min(run.steps[0] for run in runs), steps, wall)
    ticks = _times(first / seconds, wall[-1] / seconds)
    places = np.interp(ticks * seconds, wall, steps)
    # Before the first row much time passes in few steps, because jaxrod compiles:
    # labels that would overlap are left out.
    kept = [0]
    for k in range(1, len(ticks)):
        if places[k] - places[kept[-1]] >= _LABEL * last_step:
            kept.append(k)
    top.set_xticks(places[kept], [f"{t:g}" for t in ticks[kept]])
    which = "mean of the runs" if len(runs) > 1 else "this run"
    top.set_xlabel(f"wall-clock time, {which} [{unit}]", color=_QUIET, fontsize=9)
    top.tick_params(colors=_QUIET, labelsize=8)
    top.spines["top"].set_color(_QUIET)


def _times(first: float, last: float) -> np.ndarray:
    """Round times from zero to `last`; at least three of them are after `first`."""
    from matplotlib.ticker import MaxNLocator

    ticks = np.zeros(0)
    for low in (0.0, first):
        ticks = np.asarray(MaxNLocator(7).tick_values(low, last))
        ticks = ticks[(ticks >= low) & (ticks <= last)]
        if np.sum(ticks >= first) >= 3 or first == last:
            break
    return np.union1d([0.0], ticks)


def common_steps(runs: list[Curve]) -> np.ndarray:
    """400 equidistant control steps within the range that all runs cover."""
    first = max(run.steps[0] for run in runs)
    last = min(run.steps[-1] for run in runs)
    return np.linspace(first, max(first, last), 400)


def _run_label(label: str, runs: list[Curve]) -> str:
    wall = float(np.mean([run.wall[-1] for run in runs]))
    took = f"{wall:.0f} s" if wall < 120 else f"{wall / 60:.1f} min"
    if wall >= 7200:
        took = f"{wall / 3600:.1f} h"
    what = f"{label}, mean of {len(runs)} runs" if len(runs) > 1 else label
    end = float(np.mean([run.returns[-1] for run in runs]))
    return f"{what}: {_shown(end)} after {took}"


def _shown(value: float) -> str:
    """Text of a return or a reward, with three digits or all before the point."""
    return f"{value:,.0f}" if abs(value) >= 999.5 else f"{value:.3g}"


def _reference_label(reference: ReferenceScore) -> str:
    text = f"{reference.label}: {reference.mean:,.0f} ± {reference.spread:,.0f}"
    hours = reference.wall_hours
    return text if hours is None else f"{text} after {hours:.1f} h"


def _alt(runs: list[Curve], reference: ReferenceScore | None) -> str:
    parts = [_run_label("run", runs)]
    return "; ".join(parts + ([_reference_label(reference)] if reference else []))


def need_matplotlib() -> None:
    """Raises unless matplotlib is installed.

    Raises:
        ModuleNotFoundError: It is not; the message gives the command that installs it.
    """
    try:
        # Imported only to check that it is installed.
        import matplotlib  # noqa: F401
    except ModuleNotFoundError as missing:
        if missing.name != "matplotlib":
            raise
        raise ModuleNotFoundError(
            'pictures need matplotlib; install it with: pip install "jaxrod[viz]"',
            name="matplotlib",
        ) from missing

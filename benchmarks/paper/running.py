"""Running the cells of a grid, a few at a time, and recording how each ended."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TextIO

from benchmarks.paper.cell_records import Record, Records
from benchmarks.paper.figures import draw_figures
from benchmarks.paper.plan import Cell
from benchmarks.paper.report import write_report
from jaxrod.cli.sweeps.plan import differs
from jaxrod.cli.sweeps.running import (
    Ended,
    RunsView,
    ThisMachine,
    last_row,
    log_of,
    train_all,
    wait_for,
)
from jaxrod.files import refuse_link, write_atomically
from jaxrod.installation.machine import processor
from jaxrod.training import RunFolder, algorithm_names, find_algorithm
from jaxrod.training.runs.interruption import Interruption
from jaxrod.training.runs.owned_folder import only_process
from jaxrod.training.runs.recorded_settings import recorded

CHECKPOINT_SECONDS = 300
"""Time between checkpoints [s]: off-policy learners save all that they remember."""
DIVERGED = 1
"""Exit code of `jaxrod train` when learning diverged."""


def run_grid(
    cells: list[Cell],
    records: Records,
    *,
    overwrite: bool,
    stream: TextIO,
    jobs: int = 1,
) -> int:
    """Runs what has not ended yet.

    Args:
        cells: in the order in which to run them.
        records: what has ended before; gets what ends now.
        overwrite: whether to run again what was run otherwise than now asked.
        stream: where to show progress.
        jobs: how many cells run in parallel, each on its share of the cores.

    Returns:
        Exit code: 0 all cells came to their end, 1 some failed, 130 interrupted.

    Raises:
        ValueError: a cell ran with other settings, or another grid runs here.
    """
    changed = {cell.name: changed_since(cell, records) for cell in cells}
    if not overwrite:
        for name, how in changed.items():
            if how:
                raise ValueError(
                    f"{name} in {records.out} ran with other settings: "
                    f"{', '.join(how)}; repeat such cells with --overwrite, or choose "
                    "another folder with --out"
                )
    view = RunsView(cells, stream)
    refuse_link(records.out / "runs")
    for cell in cells:
        refuse_link(_folder(cell, records).path)
    with only_process(records.out / "runs"):
        write_atomically(records.out / "runs" / ".gitignore", b"*\n")
        waiting = []
        for cell in cells:
            record = records.get(cell)
            if record is None or changed[cell.name]:
                waiting.append(cell)
            else:
                _show(view, cell, record, quiet=True)
        failed = [c for c in cells if (r := records.get(c)) and r["error"]]
        broken = [cell for cell in failed if cell not in waiting]
        folders = {cell.name: _folder(cell, records) for cell in waiting}
        wait_for(folders.values(), view.say)
        for cell in list(waiting):
            folder = folders[cell.name]
            if _ready(cell, folder):
                waiting.remove(cell)
                _record(cell, folder, records, folder.summary(), None)
                _show(view, cell, folder.summary())

        def ended(cell: Cell, how: Ended) -> None:
            stopped = interruption.requested
            if not _ended(cell, folders[cell.name], how, records, view, stopped):
                broken.append(cell)

        with Interruption(view.say) as interruption:
            train_all(
                waiting,
                lambda cell: folders[cell.name],
                ThisMachine(jobs),
                view,
                interruption,
                ended,
                ["--checkpoint-seconds", str(CHECKPOINT_SECONDS), "--no-replay"],
            )
        if interruption.requested:
            view.say("stopped; the same command continues")
            return 130
    return 1 if broken else 0


def changed_since(cell: Cell, records: Records) -> list[str]:
    """Differences between the run of a cell so far and the request."""
    record = records.get(cell)
    folder = _folder(cell, records)
    if record is not None:
        return differs(cell, folder, _completed(record["config"]))
    return differs(cell, folder)


def _completed(config: Mapping[str, Any]) -> dict[str, Any]:
    """A recorded configuration with the settings that learners got since then.

    A new setting's default is what was done before there was a choice.
    """
    name = config["algorithm"]
    if name not in algorithm_names():
        raise ValueError(
            f"a record names the algorithm {name!r:.80}, a grid has those of jaxrod "
            f"alone: {', '.join(algorithm_names())}"
        )
    default = find_algorithm(name).config_type()
    return {**config, "settings": {**recorded(default), **config["settings"]}}


def _ready(cell: Cell, folder: RunFolder) -> bool:
    """Whether it has run to its end before, but was not recorded."""
    if differs(cell, folder):
        # Otherwise the summary of the run before could be taken for this one's.
        folder.clear()
    return folder.finished


def _ended(
    cell: Cell,
    folder: RunFolder,
    ended: Ended,
    records: Records,
    view: RunsView,
    stopped: bool,
) -> bool:
    """Records a cell whose process has ended; whether the cell is not broken."""
    row = last_row(folder)
    if folder.finished:
        _record(cell, folder, records, folder.summary(), None)
    elif ended.code == DIVERGED and not stopped:
        _record(cell, folder, records, _so_far(row or {}), ended.said)
    elif stopped:
        view.stopped(cell, row)
        return True
    else:
        # Not recorded: the next call tries again, from the last checkpoint.
        view.failed(cell, f"{ended.said} (see {log_of(folder)})")
        return False
    record = records.get(cell)
    assert record is not None
    _show(view, cell, record)
    return not record["error"]


def _folder(cell: Cell, records: Records) -> RunFolder:
    """Folder in which a cell is trained."""
    return RunFolder(records.out / "runs" / cell.name)


def _record(
    cell: Cell,
    folder: RunFolder,
    records: Records,
    summary: Mapping[str, Any],
    error: str | None,
) -> None:
    """Keeps how a cell ended, then frees what was needed to go on."""
    names = ("env_steps", "final_score", "wall_s", "flagged_fraction")
    more = ("score_window", "episodes", "evaluation_score", "jax_version", "device")
    record: Record = {
        "name": cell.name,
        "case": cell.case,
        "algorithm": cell.algorithm.upper(),
        "variant": cell.variant,
        "seed": cell.seed,
        **{name: summary[name] for name in names},
        "status": "failed" if error else "finished",
        "error": error,
        "command": shlex.join(cell.command(Path(cell.name))),
        "changed": list(cell.changed),
        "config": cell.config,
        "processor": processor(),
        **{name: summary.get(name) for name in more},
    }
    records.add(cell.name, record, folder.progress.read())
    write_report(records, records.out)
    draw_figures(records)
    shutil.rmtree(folder.checkpoints, ignore_errors=True)


def _so_far(row: Mapping[str, str]) -> dict[str, Any]:
    """Last row of the progress of a run that diverged."""
    return {
        "env_steps": int(row.get("env_steps", 0)),
        "final_score": None,
        "wall_s": float(row.get("wall_s", 0.0)),
        "flagged_fraction": float(row.get("flagged_fraction", 0.0)),
    }


def _show(view: RunsView, cell: Cell, record: Record, quiet: bool = False) -> None:
    if record.get("error"):
        view.failed(cell, record["error"], quiet)
    else:
        view.done(cell, record, quiet)

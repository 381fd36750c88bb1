"""Running the cells of a grid, one after the other, and recording how each ended."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TextIO

from jaxrod.cli import _grid_process
from jaxrod.cli._grid import CHECKPOINT_SECONDS, Cell
from jaxrod.cli._grid_records import Record, Records
from jaxrod.cli._grid_report import draw_figures, write_report
from jaxrod.cli._grid_view import GridView
from jaxrod.cli._machine import processor
from jaxrod.training.interruption import Interruption
from jaxrod.training.run_folder import RunFolder, differences

DIVERGED = 1
"""Exit code of `jaxrod train` when learning diverged."""

_UNASKED = ("score_window",)


def run_grid(
    cells: list[Cell], records: Records, *, overwrite: bool, stream: TextIO
) -> int:
    """Runs what has not ended yet.

    Args:
        cells: in the order in which to run them.
        records: what has ended before; gets what ends now.
        overwrite: whether to run again what was run otherwise than now asked.
        stream: where to show progress.

    Returns:
        Exit code: 0 all cells have a score, 1 some failed, 130 interrupted.

    Raises:
        ValueError: a cell was run otherwise, or another grid runs here.
    """
    changed = {cell.name: _changed(cell, records) for cell in cells}
    if not overwrite:
        for name, how in changed.items():
            if how:
                raise ValueError(
                    f"{name} in {records.out} was run otherwise: {', '.join(how)}; "
                    "run such cells again with --overwrite, or choose another folder "
                    "with --out"
                )
    runs = records.out / "runs"
    view = GridView(cells, stream)
    with _grid_process.only_one(runs, view.say) as lock:
        (runs / ".gitignore").write_text("*\n")
        waiting = []
        for cell in cells:
            record = records.get(cell)
            if record is None or changed[cell.name]:
                waiting.append(cell)
            else:
                _show(view, cell, record, quiet=True)
        failed = [c for c in cells if (r := records.get(c)) and r["error"]]
        broken = [cell for cell in failed if cell not in waiting]
        with Interruption(view.say) as interruption:
            for cell in waiting:
                if interruption.asked:
                    break
                good = _run(cell, records, view, lock, interruption)
                if not good:
                    broken.append(cell)
        if interruption.asked:
            view.say("stopped; the same command goes on")
            return 130
    return 1 if broken else 0


def _changed(cell: Cell, records: Records) -> list[str]:
    """How what was run of a cell, to its end or not, differs from what is asked."""
    record = records.get(cell)
    folder = RunFolder(records.out / "runs" / cell.name)
    found = differences(record["config"], cell.config, _UNASKED) if record else []
    if not found and record is None and folder.exists:
        found = differences(folder.config(), cell.config, _UNASKED)
    return found


def _run(
    cell: Cell,
    records: Records,
    view: GridView,
    lock: int,
    interruption: Interruption,
) -> bool:
    """Runs a cell to its end, from wherever it is; whether it is not broken."""
    folder = RunFolder(records.out / "runs" / cell.name)
    if folder.exists and differences(folder.config(), cell.config, _UNASKED):
        # Otherwise the summary of the run before could be taken for this one's.
        folder.clear()
    log = folder.path.with_suffix(".log")
    code = 0
    if not folder.finished:
        row = _grid_process.last_row(folder.progress.path)
        view.start(cell, int(row["env_steps"]) if row and folder.exists else 0)
        words = cell.command(folder.path)
        words += ["--checkpoint-seconds", str(CHECKPOINT_SECONDS), "--no-replay"]
        if folder.exists:
            words.append("--resume")

        def look() -> None:
            row = _grid_process.last_row(folder.progress.path)
            if row:
                score = row["episode_return_mean"]
                done = int(row["env_steps"])
                view.running(cell, done, float(score) if score else None)

        code = _grid_process.run_process(
            words, log, lock=lock, interruption=interruption, look=look
        )
    if folder.finished:
        _record(cell, folder, records, folder.summary(), None)
    elif code == DIVERGED and not interruption.asked:
        row = _grid_process.last_row(folder.progress.path) or {}
        _record(cell, folder, records, _so_far(row), _grid_process.last_words(log))
    elif interruption.asked:
        row = _grid_process.last_row(folder.progress.path)
        view.stopped(cell, int(row["env_steps"]) if row else 0)
        return True
    else:
        # Not recorded: the next call tries again, from the last checkpoint.
        how = f"killed by signal {-code}" if code < 0 else _grid_process.last_words(log)
        view.failed(cell, f"{how} (see {log})")
        return False
    record = records.get(cell)
    assert record is not None
    _show(view, cell, record)
    return not record["error"]


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
    """What is known of a run that diverged: the last row of its progress."""
    return {
        "env_steps": int(row.get("env_steps", 0)),
        "final_score": None,
        "wall_s": float(row.get("wall_s", 0.0)),
        "flagged_fraction": float(row.get("flagged_fraction", 0.0)),
    }


def _show(view: GridView, cell: Cell, record: Record, quiet: bool = False) -> None:
    if record["error"]:
        view.failed(cell, record["error"], quiet)
    else:
        view.done(cell, record["final_score"], record["wall_s"], quiet)

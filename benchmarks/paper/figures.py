"""The figures of a grid: learning curves of a case, beside the paper's results."""

from __future__ import annotations

from collections import defaultdict

from benchmarks.paper.cell_records import Record, Records
from benchmarks.paper.published import result_of_run
from jaxrod.viz import ReferenceScore
from jaxrod.viz.curves import grid_curves


def draw_figures(records: Records) -> None:
    """Draws a picture per case and variant: `OUT/Case1.png`, ...

    Cells without a complete episode are left out; nothing is drawn without matplotlib.
    """
    figures: dict[str, dict[str, list[Record]]] = defaultdict(lambda: defaultdict(list))
    for record in records:
        if record["final_score"] is not None:
            variant = record["variant"]
            suffix = "" if variant in (None, "paper") else f"-{variant}"
            figures[record["case"] + suffix][record["algorithm"]].append(record)
    for name, groups in figures.items():
        try:
            grid_curves(
                {k: [records.curve(r["name"]) for r in v] for k, v in groups.items()},
                {k: _reference(v[0]) for k, v in groups.items()},
                records.out / f"{name}.png",
                title=name,
            )
        except ModuleNotFoundError as missing:
            if missing.name != "matplotlib":
                raise


def _reference(record: Record) -> ReferenceScore | None:
    result = result_of_run(record["config"])
    return None if result is None else result.reference

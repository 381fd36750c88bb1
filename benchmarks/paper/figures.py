"""The figures of a grid: learning curves of a case, beside the paper's results."""

from __future__ import annotations

from collections import defaultdict

from benchmarks.paper.records import Record, Records
from jaxrod.cli.runs import paper_result
from jaxrod.viz.grid_curves import grid_curves


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
                {k: paper_result(v[0]["config"]) for k, v in groups.items()},
                records.out / f"{name}.png",
                title=name,
            )
        except ModuleNotFoundError as missing:
            if missing.name != "matplotlib":
                raise

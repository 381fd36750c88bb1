"""The records of a grid as a page: OUT/results.md."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import fmean

from benchmarks.paper.cell_records import Record
from benchmarks.paper.published import result_of_run
from jaxrod.files import write_atomically
from jaxrod.training.progress import duration

_HEADS = (
    "cell",
    "control steps",
    "mean",
    "every seed",
    "paper",
    "above",
    "wall-clock",
    "paper [h]",
    "ratio",
    "flagged",
    "without noise",
)


def report(records: Iterable[Record]) -> str:
    """The results as Markdown: a row per case, algorithm and variant."""
    groups: dict[tuple[str, str, str], list[Record]] = defaultdict(list)
    for record in records:
        key = record["case"], record["variant"] or "", record["algorithm"]
        groups[key].append(record)
    ordered = [groups[key] for key in sorted(groups)]
    everything = [record for group in ordered for record in group]
    lines = [
        "# Results of the grid",
        "",
        "Written by `jaxrod reproduce` from the records in cells. Scores are mean "
        "returns of the last training episodes of a seed, 50 in Cases 1 and 2 and 10 "
        "in Cases 3 and 4 as in the paper; the paper's are mean and standard "
        "deviation over its seeds. Wall-clock is the mean of a run, compiling "
        "included; the ratio says how many times longer the paper's run took. "
        "Without noise: mean return of the policy that a run leaves, which is "
        "deterministic, in episodes of their own.",
        "",
        *_table([_HEADS, *map(_line, ordered)]),
        "",
    ]
    failed = [record for record in everything if record["status"] == "failed"]
    if failed:
        lines += ["Failed:", ""]
        lines += [f"- {_name(r)}, seed {r['seed']}: {r['error']}" for r in failed]
        lines += [""]
    lines += ["Settings that differ from the learners' defaults:", ""]
    lines += [_settings(group) for group in ordered]
    lines += ["", "Run on:", ""]
    machines = defaultdict(list)
    for record in everything:
        where = (
            f"{record['processor']}, {record['device']}, jax {record['jax_version']}"
        )
        machines[where].append(record)
    lines += [f"- {where}: {len(records)} runs" for where, records in machines.items()]
    lines += ["", "Commands:", "", "```"]
    lines += [f"jaxrod {record['command']}" for record in everything]
    return "\n".join([*lines, "```"]) + "\n"


def write_report(records: Iterable[Record], out: Path) -> None:
    """Writes `results.md` into a folder."""
    write_atomically(out / "results.md", report(records).encode())


def _line(group: Sequence[Record]) -> tuple[str, ...]:
    group = sorted(group, key=lambda record: record["seed"])
    scores = [record["final_score"] for record in group]
    failed = any(record["status"] == "failed" for record in group)
    mean = None if None in scores else fmean(scores)
    wall = fmean(record["wall_s"] for record in group)
    paper = result_of_run(group[0]["config"])
    return (
        _name(group[0]),
        " / ".join(sorted({f"{record['env_steps']:,}" for record in group})),
        _score(mean, failed),
        _every_seed(group, "final_score"),
        f"{paper.final_mean:,.0f} ± {paper.final_std:,.0f}" if paper else "",
        f"{mean - paper.final_mean:+,.0f}" if paper and mean is not None else "",
        duration(wall),
        f"{paper.wall_hours:.1f}" if paper else "",
        f"{3600 * paper.wall_hours / wall:,.0f}" if paper else "",
        f"{fmean(record['flagged_fraction'] for record in group):.2%}",
        _every_seed(group, "evaluation_score"),
    )


def _name(record: Record) -> str:
    variant = f" ({record['variant']})" if record["variant"] else ""
    return f"{record['case']} {record['algorithm']}{variant}"


def _every_seed(group: Sequence[Record], what: str) -> str:
    return ", ".join(
        f"{r['seed']}: {_score(r.get(what), r['status'] == 'failed')}" for r in group
    )


def _score(score: float | None, failed: bool) -> str:
    if score is None:
        return "failed" if failed else "no episode"
    return f"{score:,.0f}"


def _settings(group: Sequence[Record]) -> str:
    changed = dict.fromkeys(", ".join(record["changed"]) for record in group)
    return f"- {_name(group[0])}: {' / '.join(text or 'none' for text in changed)}"


def _table(rows: Sequence[Sequence[str]]) -> list[str]:
    rule = ["---", *["---:" if 0 < k != 3 else "---" for k in range(1, len(rows[0]))]]
    return [f"| {' | '.join(row)} |" for row in (rows[0], rule, *rows[1:])]

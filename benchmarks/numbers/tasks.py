"""Quotes of records of the tasks: trained policies, and an arm with faults."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from benchmarks.numbers.quoting import Quote
from benchmarks.numbers.records import digits, mean, read, whole

TASKS = "docs/tasks.md"
FAULTS = "docs/randomisation.md"
SOLVED = "benchmarks/solved/records"
TRAINED = "benchmarks/training/records"


def quotes() -> Iterator[Quote]:
    """All quotes of this file."""
    yield from trained()
    yield from solved()
    yield from faults()


def trained() -> Iterator[Quote]:
    """Returns of trained policies in the episodes after their training."""
    firsts = {
        "snake": "from rest | 64.1 |",
        "octopus": "rowing | 15.9 |",
    }
    for task, first in firsts.items():
        runs = [read(f"{TRAINED}/{task}/ppo-{seed}/summary.json") for seed in range(3)]
        rows = " ".join(
            f"| PPO, seed {seed}, without noise | {{}} |" for seed in (0, 1, 2)
        )
        scores = tuple(f"{run['evaluation_score']:.1f}" for run in runs)
        yield Quote(TASKS, f"{first} {rows}", scores)
    for seed in (20, 21, 22):
        run = read(f"{TRAINED}/gripper/ppo-{seed}/summary.json")
        yield Quote(
            TASKS,
            f"| PPO, seed {seed}, without noise | {{}} ± {{}} |",
            (f"{run['evaluation_score']:.1f}", f"{run['evaluation_std']:.1f}"),
        )


def score(record: dict[str, Any]) -> tuple[str, str]:
    """Mean and standard deviation of a return."""
    return f"{record['mean_return']:.1f}", f"{record['std_return']:.1f}"


def share(record: dict[str, Any]) -> str:
    """Share of starts that are solved, in per cent, with a decimal if it has one."""
    return f"{100 * record['solved']:.1f}".removesuffix(".0")


def solved() -> Iterator[Quote]:
    """Starts that policies and planners solve."""
    rope = {who: read(f"{SOLVED}/lift-{who}.json") for who in ("random", "planner")}
    yield Quote(
        TASKS,
        "| random actions | {} ± {} | {} % | {} | "
        "| planner: plans of 1.2 s, improved by Adam with gradients through the rope "
        "| {} ± {} | {} % | {} |",
        (
            *score(rope["random"]),
            share(rope["random"]),
            str(rope["random"]["starts"]),
            *score(rope["planner"]),
            whole(100 * rope["planner"]["solved"]),
            str(rope["planner"]["starts"]),
        ),
    )
    learned = [read(f"{SOLVED}/lift-ppo-{seed}.json") for seed in range(3)]
    yield Quote(
        TASKS,
        "each of three seeds | {} ± {}, {} ± {}, {} ± {} | {} % | {} |",
        (
            *(number for one in learned for number in score(one)),
            share(min(learned, key=lambda one: one["solved"])),
            str(learned[0]["starts"]),
        ),
    )
    cable = read(f"{SOLVED}/insert-planner.json")
    yield Quote(
        TASKS,
        "with derivatives through the cable | {} ± {} | {} % | {} |",
        (*score(cable), whole(100 * cable["solved"]), str(cable["starts"])),
    )
    for task in ("insert", "catheter"):
        # Three rows together, because rows of other tasks begin alike.
        found = [read(f"{SOLVED}/{task}-ppo-{seed}.json") for seed in range(3)]
        row = "| PPO, seed {}, without noise | {{}} ± {{}} | {{}} % | {{}} |"
        text = " ".join(row.format(seed) for seed in range(3))
        shown: list[str] = []
        for one in found:
            percent = f"{100 * one['solved']:.1f}" if task == "insert" else share(one)
            shown += [*score(one), percent, str(one["starts"])]
        before = read(f"{SOLVED}/{task}-random.json")
        starts = str(before["starts"])
        if task == "catheter":
            text = f"| random actions | {{}} ± {{}} | {{}} % | {{}} | {text}"
            shown = [*score(before), share(before), starts, *shown]
        else:
            text = f"derivatives through the cable | 68.7 ± 22.9 | 88 % | 16 | {text}"
        yield Quote(TASKS, text, tuple(shown))


def run_of(learner: str, seed: int, million: int) -> dict[str, Any]:
    """The record of a learner on the arm with faults."""
    name = f"{learner}-{seed}-{million}000000"
    return dict(read(f"benchmarks/reality/records/{name}.json"))


def faults() -> Iterator[Quote]:
    """Learners on an arm that is as bad as a real one."""
    three = {
        "PPO without memory, on the task without these faults": "ideal",
        "PPO without memory": "mlp",
        "recurrent PPO": "recurrent",
        "DAgger without memory": "imitator",
        "DAgger, then recurrent PPO": "recurrent-imitated",
    }
    for words, name in three.items():
        runs = [run_of(name, seed, 1 if name == "imitator" else 4) for seed in range(3)]
        text, shown = f"| {words} | {{}}, {{}}, {{}} |", [_return(run) for run in runs]
        if name != "ideal":
            text += " {}; {} |"
            shown += [whole(mean(run["outside"][n] for run in runs)) for n in (0, 1)]
        yield Quote(FAULTS, text, tuple(shown))
    one = {
        "| PPO without memory, with a critic that sees everything |": (
            "mlp-privileged",
            4,
        ),
        "| recurrent PPO, with a critic that sees everything |": (
            "recurrent-privileged",
            4,
        ),
        "| recurrent PPO | 20 million |": ("recurrent", 20),
        "| PPO without memory | 20 million |": ("mlp", 20),
        "| recurrent PPO | 60 million |": ("recurrent", 60),
    }
    for words, (name, million) in one.items():
        run = run_of(name, 0, million)
        shown = [_return(run), *map(whole, run["outside"])]
        yield Quote(FAULTS, f"{words} {{}} | {{}}; {{}} |", tuple(shown))
    delayed = run_of("mlp-delay", 0, 4)
    yield Quote(FAULTS, "with the delay as the only fault | {} |", (_return(delayed),))
    for side in ("softer", "stiffer"):
        runs = [run_of(f"ideal-{side}", seed, 4) for seed in range(3)]
        place = 0 if side == "softer" else 1
        returns = tuple(whole(run["outside"][place]) for run in runs)
        before = "PPO reaches" if side == "softer" else "stiffer arm it reaches"
        yield Quote(FAULTS, f"{before} {{}}, {{}} and {{}}", returns)
    memory, without, ideal = (
        mean(run_of(name, seed, 4)["return_without_noise"] for seed in range(3))
        for name in ("recurrent", "mlp", "ideal")
    )
    yield Quote(
        FAULTS,
        "recurrent PPO reaches {} % of the return of PPO without the faults, and {} "
        "times that of PPO without memory",
        (whole(100 * memory / ideal), digits(memory / without)),
    )
    found = run_of("faults", 0, 4)
    alone = found["without_learning"]
    rows = {
        "none": found["return_without_noise"],
        "stiffness of ±30 %": alone["stiffness"],
        "noise of 5 mm": alone["noise"],
        "half of the markers missing": alone["dropout"],
        "delay of 1 control step (1.4 ms)": alone["delay of 1"],
        "delay of 2 control steps (2.8 ms)": alone["delay of 2"],
        "delay of 4 control steps (5.6 ms)": alone["delay of 4"],
        "delay of 7 control steps (9.8 ms)": alone["delay of 7"],
        "delay of 14 control steps (19.6 ms)": alone["delay of 14"],
    }
    for words, value in rows.items():
        yield Quote(FAULTS, f"| {words} | {{}} |", (f"{value:,.0f}",))
    yield Quote(
        FAULTS,
        "It reaches a return of {} without delay, and of {} with a delay of 14",
        (
            whole(alone["planner"]),
            whole(alone["planner, delay of 14"]),
        ),
    )
    longer = run_of("imitator", 0, 3)
    yield Quote(
        FAULTS,
        "the imitator reaches {}. On the softer and on the stiffer arm it reaches "
        "{} and {}",
        (_return(longer), *map(whole, longer["outside"])),
    )


def _return(run: dict[str, Any]) -> str:
    return whole(run["return_without_noise"])

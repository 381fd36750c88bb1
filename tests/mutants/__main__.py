"""Plants faults one by one in a copy of the tree and says which fast test sees each.

python -m tests.mutants            # the named ones, then 60 drawn with a seed
python -m tests.mutants --resume   # goes on from the record
python -m tests.mutants --only m01 d07 --record /tmp/some.md
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from .copies import Copy, Run
from .drawing import drawn
from .equivalent import REASONS
from .named import NAMED
from .record import Row, counts, read, write
from .tests_for import Likely

ROOT = Path(__file__).parents[2]
RECORD = Path(__file__).with_name("record.md")
SEED, COUNT = 2026, 60


class Trial:
    """One fault to be planted."""

    def __init__(self, name, file, line, change, source, tests=()):
        self.name, self.file, self.change = name, file, change
        self.place = f"{file}:{line}"
        self.source = source
        self.tests = list(tests)


def trials(root: Path, count: int, seed: int) -> list[Trial]:
    """The named faults, then the drawn ones.

    Raises:
        ValueError: The text of a named one is not there, or not once.
    """
    found = []
    for own in NAMED:
        text = (root / own.file).read_text()
        if text.count(own.old) != 1:
            raise ValueError(
                f"{own.name}, {own.about}: its text stands {text.count(own.old)} times "
                f"in {own.file}, not once: {own.old!r}"
            )
        line = text.count("\n", 0, text.index(own.old)) + 1
        source = text.replace(own.old, own.new)
        found.append(Trial(own.name, own.file, line, own.about, source, own.tests))
    for one in drawn(root, count, seed):
        text = (root / one.file).read_text()
        source, line = one.fault.planted(text), one.fault.line(text)
        change = f"{one.fault.kind}: {one.fault.words(text)}"
        found.append(Trial(one.name, one.file, line, change, source))
    return found


def tried(trial: Trial, copy: Copy, likely: Likely, sound: dict, options) -> Row:
    """The outcome of one fault."""
    reason = REASONS.get((trial.file, trial.change))
    if reason is not None:
        return Row(trial.name, trial.place, trial.change, "equivalent", reason)
    first = [*options.tests, *trial.tests]
    first += [t for t in likely.first(trial.file, options.first) if t not in first]
    others = likely.rest(trial.file, first, options.files)
    late = []
    with copy.planted(trial.file, trial.source):
        for tests, limit in ((first, options.limit), (others, options.long_limit)):
            left = list(tests)
            while left:
                run = copy.run(left, limit)
                if run.outcome == "no end":
                    late.append(f"{limit:g} s")
                    if ends_without(left, limit / 3, trial, copy):
                        why = f"no end of {left[0]} in {limit:g} s"
                        return Row(trial.name, trial.place, trial.change, "killed", why)
                if run.outcome != "failed":
                    break
                if passes_without(run, trial, copy, sound):
                    return Row(
                        trial.name, trial.place, trial.change, "killed", f"`{run.test}`"
                    )
                # Fails here in any case: what else its files say counts.
                left = [t for t in left if not run.test.startswith(t)]
    why = f"nothing in {len(first) + len(others)} files"
    why += f", not all within {late[-1]}" if late else ""
    return Row(trial.name, trial.place, trial.change, "survived", why)


def passes_without(run: Run, trial: Trial, copy: Copy, sound: dict) -> bool:
    """Whether a test passes in the tree as it is; asked once for each."""
    if "::" not in run.test and not run.test.endswith(".py"):
        return True
    if run.test not in sound:
        with copy.planted(trial.file, (ROOT / trial.file).read_text()):
            sound[run.test] = copy.run([run.test], 600).outcome == "passed"
    return sound[run.test]


def ends_without(tests: list[str], limit: float, trial: Trial, copy: Copy) -> bool:
    """Whether tests that do not end with a fault soon pass without it."""
    with copy.planted(trial.file, (ROOT / trial.file).read_text()):
        return copy.run(tests, limit).outcome == "passed"


def main() -> int:
    """Runs the faults that were asked for."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants")
    parser.add_argument("--only", nargs="*", help="names, m01 or d07")
    parser.add_argument("--tests", nargs="*", default=[], help="files to try first")
    parser.add_argument("--drawn", type=int, default=COUNT, help="how many are drawn")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--resume", action="store_true", help="go on from the record")
    parser.add_argument("--again", action="store_true", help="what survived, too")
    parser.add_argument("--record", type=Path, default=RECORD)
    parser.add_argument("--limit", type=float, default=240, help="seconds, first files")
    parser.add_argument("--long-limit", type=float, default=420, help="for the others")
    parser.add_argument("--first", type=int, default=5, help="first files")
    parser.add_argument("--files", type=int, default=12, help="others, at most")
    options = parser.parse_args()
    try:
        every = trials(ROOT, options.drawn, options.seed)
    except ValueError as error:
        print(error, file=sys.stderr)
        return 1
    rows = {row.name: row for row in read(options.record)} if options.resume else {}
    places = {trial.name: (trial.place, trial.change) for trial in every}
    # A record of other sources or of another seed is no record of these.
    rows = {
        name: row
        for name, row in rows.items()
        if places.get(name) == (row.place, row.change)
    }
    if options.again:
        rows = {n: row for n, row in rows.items() if row.outcome != "survived"}
    if options.only:
        rows = {n: row for n, row in rows.items() if n not in options.only}
    wanted = [t for t in every if t.name not in rows]
    if options.only:
        wanted = [t for t in wanted if t.name in options.only]
    likely, copy, sound = Likely(ROOT), Copy(ROOT), {}
    try:
        if not copy.imports_itself():
            print("the copy imports what is installed, not itself", file=sys.stderr)
            return 1
        for trial in wanted:
            began = time.perf_counter()
            row = tried(trial, copy, likely, sound, options)
            rows[row.name] = row
            write(options.record, list(rows.values()), options.seed, options.drawn)
            spent = time.perf_counter() - began
            print(f"{row.name} {row.place} {row.outcome}: {row.by} ({spent:.0f} s)")
            sys.stdout.flush()
    finally:
        copy.close()
    print(counts(list(rows.values())))
    return 0


if __name__ == "__main__":
    sys.exit(main())

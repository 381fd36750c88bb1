"""Pairs of equivalent programs: random scenes and systems seen in several views.

    PYTHONPATH=tests python tests/extremes/pairs.py --scenes 200 --systems 200

Each is run for tens of steps in float64: as it is; 1.3 km away; turned; in other units;
turned and in other units; in two runs one after the other; from the last record of
`rollout`; three of them as one batch; with its effects, members and couplings in
another order, the sides of couplings exchanged, what can be halved as two halves, and a
member far away; and its first rod from the other end. What comes out is the same to
rounding. How much of that is left at the end, in chaotic scenes and others, is measured
by a run that is disturbed: a hundredfold of that is allowed. `stable_dt` of the views
is compared as well.

Structures take turns, a scene and a system. Each is compiled once and run with several
sets of numbers (`--draws`). Exits with 1 and lists the pairs that differ; the counts
are printed at the end, after `--minutes`, and when it is stopped (SIGTERM).
"""

from __future__ import annotations

import argparse
import collections
import itertools
import signal
import sys
import time
import warnings
from typing import Any

import jax
import jax.monitoring

import jaxrod
from extremes.pair_cases import ALLOWED, STRUCTURES, recorded, run, run_batch


class Counts:
    """All that was tried, and how it came out."""

    def __init__(self) -> None:
        """Nothing was tried."""
        self.tried: collections.Counter[str] = collections.Counter()
        self.failed: collections.Counter[str] = collections.Counter()
        self.worst: dict[str, float] = {}
        self.compiled = 0
        jax.monitoring.register_event_duration_secs_listener(self._listen)

    def _listen(self, event: str, _: float, **__: Any) -> None:
        self.compiled += event == "/jax/core/compile/backend_compile_duration"

    def examine(self, what: str, seed: int, draws: int, pairs: str) -> None:
        """Compares the views of one structure, with several sets of numbers."""
        structure = STRUCTURES[what](seed)
        print(f"{what} {seed}: {structure.kind}")
        for draw in range(draws):
            begun, compiled = time.time(), self.compiled
            try:
                case = structure.examined(draw, pairs)
            except (ValueError, FloatingPointError) as refused:
                self.tried[f"{what}s refused"] += 1
                words = " ".join(str(refused).split())[:150]
                print(f"{what} {seed}/{draw}: refused: {words}", flush=True)
                if isinstance(refused, ValueError):
                    return
                continue
            self.tried[f"{what}s"] += 1
            self.tried[f"structures of {what}s"] += draw == 0
            bad = self._note(what, case.results)
            print(
                f"{what} {seed}/{draw}: {time.time() - begun:.1f} s, "
                f"{self.compiled - compiled} compiled, noise "
                f"{max(case.noise.values()):.0e}, {case.steps} steps of {case.dt:.1e} s"
                + "".join(f"\n    DIFFERS {b}" for b in bad),
                flush=True,
            )

    def _note(self, what: str, results: Any) -> list[str]:
        bad = []
        for name, ratio, apart, where in results:
            name = f"{what}: {name}"
            self.tried[name] += 1
            self.worst[name] = max(self.worst.get(name, 0.0), ratio / ALLOWED)
            if not ratio <= ALLOWED:
                self.failed[name] += 1
                bad.append(f"{name} {apart:.1e} ({ratio / ALLOWED:.0e}) {where}")
        return bad

    def show(self) -> None:
        """Prints all counts."""
        for name in sorted(self.tried):
            print(
                f"{name}: {self.tried[name]} tried, {self.failed[name]} failed, at "
                f"most {self.worst.get(name, 0):.1e} of what is allowed",
                flush=True,
            )


def stopped(*_: Any) -> None:
    """Ends the comparisons."""
    raise KeyboardInterrupt


def main() -> int:
    """Draws scenes and systems, compares their views, prints and counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--systems", type=int, default=200)
    parser.add_argument("--draws", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=float("inf"))
    parser.add_argument("--pairs", default="all", choices=("all", "numbers"))
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, stopped)
    jaxrod.configure_cpu(1)
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    wanted = {"scene": options.scenes, "system": options.systems}
    counts, end = Counts(), time.time() + 60 * options.minutes
    try:
        for seed in itertools.count(options.seed + 1):
            left = {w: n - counts.tried[f"{w}s"] for w, n in wanted.items()}
            if max(left.values()) <= 0 or time.time() > end:
                break
            for what, missing in left.items():
                counts.examine(what, seed, min(options.draws, missing), options.pairs)
            for program in (run, run_batch, recorded):
                program.clear_cache()
            if seed % 10 == 0:
                jax.clear_caches()
    except KeyboardInterrupt:
        print("stopped")
    counts.show()
    return 1 if counts.failed else 0


if __name__ == "__main__":
    sys.exit(main())

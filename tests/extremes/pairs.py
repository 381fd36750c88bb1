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

Exits with 1 and lists the pairs that differ.
"""

from __future__ import annotations

import argparse
import collections
import sys
import time
import warnings

import jax

import jaxrod
from extremes.pair_cases import ALLOWED, examined


def main() -> int:
    """Draws scenes and systems, compares their views, prints and counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--systems", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--pairs", default="all", choices=("all", "numbers"))
    options = parser.parse_args()
    jaxrod.configure_cpu(1)
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    tried: collections.Counter[str] = collections.Counter()
    failed: collections.Counter[str] = collections.Counter()
    worst: dict[str, float] = {}
    try:
        for what, count in (("scene", options.scenes), ("system", options.systems)):
            done, seed = 0, options.seed
            while done < count:
                begun = time.time()
                seed += 1
                try:
                    kind, case = examined(what, seed, options.pairs)
                except (ValueError, FloatingPointError) as refused:
                    tried[f"{what}s refused"] += 1
                    words = " ".join(str(refused).split())[:150]
                    print(f"{what} {seed}: refused: {words}")
                    continue
                done += 1
                tried[f"{what}s"] += 1
                bad = []
                for name, ratio, apart, where in case.results:
                    name = f"{what}: {name}"
                    tried[name] += 1
                    worst[name] = max(worst.get(name, 0.0), ratio / ALLOWED)
                    if not ratio <= ALLOWED:
                        failed[name] += 1
                        bad.append(
                            f"{name} {apart:.1e} ({ratio / ALLOWED:.0e}) {where}"
                        )
                noise = max(case.noise.values())
                print(
                    f"{what} {seed}: {time.time() - begun:.1f} s, noise {noise:.0e}, "
                    f"{case.steps} steps of {case.dt:.1e} s, {kind}"
                    + "".join(f"\n    DIFFERS {b}" for b in bad),
                    flush=True,
                )
                if (tried["scenes"] + tried["systems"]) % 20 == 0:
                    jax.clear_caches()
    except KeyboardInterrupt:
        print("stopped")
    for name in sorted(tried):
        print(
            f"{name}: {tried[name]} tried, {failed[name]} failed, at most "
            f"{worst.get(name, 0):.1e} of what is allowed"
        )
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())

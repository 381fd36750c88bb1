"""Order of convergence in the step, for every method, support, effect and coupling.

    PYTHONPATH=tests python tests/extremes/orders.py

Each effect acts alone on a random rod, in every method that takes it; each support,
joint and contact likewise. The same time is run in N, 2N, 4N and 8N steps in float64.
Where the last two differences between neighbours have a ratio of four, the order is
two; 2.8 is asked for (order 1.5), unless the differences are rounding. `KNOWN` lists
what is of lower order, with the reason.

Exits with 1 and lists what falls short without a reason.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import warnings
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from extremes import pair_kinds, pair_system_kinds
from extremes.pair_cases import differences, limit, members_of, run
from extremes.pair_scenes import scene_in
from extremes.pair_systems import system_in
from extremes.views import View

METHODS = tuple(dict.fromkeys(pair_kinds.METHODS))
ASKED = 2.8
ROUNDING = 1e-11
"""Share of a result below which differences are rounding."""
STEPS = 24
"""Steps of the coarsest run."""
SPEEDS = "its loads take the speeds before the kick: first order in them"
ALONE = "damping that is solved by itself, after the kick: first order"
KNOWN = {
    "laplacian filter": "a filter is applied once a step, however long the step is",
    "pyelastica": "PyElastica damps after each step: first order by definition",
    "internal damping": ALONE,
    "short waves": ALONE,
    "contact": SPEEDS,
    "friction": SPEEDS,
    "fast muscle": SPEEDS,
    # Joints have dashpots here; without them their order is two.
    "ball of": SPEEDS,
    "hinge of": SPEEDS,
    "rigid of": SPEEDS,
    "spring of": SPEEDS,
    "on the ground": SPEEDS,
    "pose spring": SPEEDS,
}


def scene_kinds() -> Iterator[tuple[str, Any]]:
    """A name and a kind of scene for every method with every support and effect."""
    for method in METHODS:
        base = pair_kinds.Kind(
            method, "clamp", (), 6, True, "round", "none", schedules=False
        )
        for support in pair_kinds.SUPPORTS:
            yield f"{method}, {support}", replace(base, support=support)
        for effect in pair_kinds.EFFECTS:
            yield f"{method}, {effect}", replace(base, effects=(effect,))
        for section in pair_kinds.SECTIONS:
            free = replace(base, support="none", section=section)
            yield f"{method}, {section} section", free
        flowing = replace(base, effects=("stokes",), flow="field", schedules=True)
        yield f"{method}, stokes in a changing flow", flowing


def system_kinds() -> Iterator[tuple[str, Any]]:
    """A name and a kind of system for every coupling, in both methods."""
    for method in ("consistent", "pyelastica"):
        base = pair_system_kinds.Kind(
            members=(4, 5),
            relations=(("ball", 0, 4),),
            sections=("round", "round"),
            losses=("none", "none"),
            contact="none",
            rigid="none",
            rubs=False,
            falls=True,
            held="clamp",
            posed=False,
            method=method,
        )
        for how in (*pair_system_kinds.ROD_JOINTS, "glue"):
            members = (4, 4) if how == "glue" else (4, 5)
            relation = (how, 0, 4)
            kind = replace(base, members=members, relations=(relation,))
            yield f"{method}, {how} of rods", kind
        for how in pair_system_kinds.BODY_JOINTS:
            kind = replace(
                base,
                members=(4, "box"),
                sections=("round",),
                relations=((how, 0, 4),),
            )
            yield f"{method}, {how} of a body", kind
        for contact in pair_system_kinds.CONTACTS[1:]:
            for rubs in (False, True):
                kind = replace(
                    base, relations=(("beside", 0, 2),), contact=contact, rubs=rubs
                )
                yield f"{method}, {contact}{' with friction' * rubs}", kind
        for shape in pair_system_kinds.SHAPES:
            kind = replace(
                base,
                members=(4, shape),
                sections=("round",),
                relations=(("beside", 0, 2),),
                rubs=True,
            )
            yield f"{method}, contact with a {shape}", kind
        grounded = replace(
            base,
            members=(4, "sphere"),
            sections=("round",),
            relations=(("spring", 0, 4),),
            rigid="ground",
        )
        yield f"{method}, a sphere on the ground", grounded
        yield f"{method}, pose spring", replace(base, posed=True)


def observed(model: Any, state: Any, kind: Any) -> tuple[float, float]:
    """Ratio of the last two differences, and the last over the size of the result."""
    state = jaxrod.with_memory(model, state)
    dt = 0.2 * float(limit(model))
    ends = []
    for k in range(4):
        n = STEPS * 2**k
        after = run(model, state, dt / 2**k, jnp.asarray(n), jnp.asarray(0))
        ends.append(
            {
                f"{name}.{what}": np.asarray(getattr(own, what))
                for name, own in members_of(after).items()
                for what in ("positions", "velocities")
            }
        )
    ratios, shares = [], []
    apart = [differences(one, other) for one, other in itertools.pairwise(ends)]
    for name, last in apart[-1].items():
        size = max(float(np.ptp(ends[-1][name])), 1e-300)
        shares.append(last / size)
        if last > ROUNDING * size:
            ratios.append(apart[-2][name] / last)
    if not np.all(np.isfinite(shares)):
        raise FloatingPointError("not finite")
    return min(ratios, default=np.inf), max(shares)


def reason(name: str) -> str | None:
    """Why a case is known to be of lower order."""
    return next((why for part, why in KNOWN.items() if part in name), None)


def main() -> int:
    """Runs all cases, prints each, and counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="part of a name")
    parser.add_argument("--what", default="all", choices=("all", "scene", "system"))
    parser.add_argument("--seed", type=int, default=3)
    options = parser.parse_args()
    jaxrod.configure_cpu(1)
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    tried = short = known = refused = 0
    kinds = [("scene", *one) for one in scene_kinds()]
    kinds += [("system", *one) for one in system_kinds()]
    for number, (what, name, kind) in enumerate(kinds):
        if options.only not in name or options.what not in ("all", what):
            continue
        try:
            made = scene_in if what == "scene" else system_in
            model, state = made(View(), kind, options.seed)[:2]
            ratio, share = observed(model, state, kind)
        except (ValueError, TypeError, FloatingPointError) as why:
            refused += 1
            print(f"{name}: refused: {' '.join(str(why).split())[:120]}", flush=True)
            continue
        tried += 1
        note = ""
        if ratio < ASKED:
            because = reason(name)
            known, short = known + bool(because), short + (not because)
            note = f"   known: {because}" if because else "   SHORT"
        print(f"{name}: ratio {ratio:.2f}, {share:.0e}{note}", flush=True)
        if number % 25 == 24:
            jax.clear_caches()
    print(
        f"{tried} tried, {known} of lower order and known, {short} short, "
        f"{refused} not made"
    )
    return 1 if short else 0


if __name__ == "__main__":
    sys.exit(main())

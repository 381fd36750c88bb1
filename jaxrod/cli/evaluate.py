"""Measure the policy of a run.

Plays complete episodes of the deterministic policy in parallel, with random numbers
that training never used, and reports their returns. With --noisy the policy acts with
the noise that it had at the end of training.
"""

from __future__ import annotations

import argparse
import json
import time
from typing import Any

from jaxrod.cli import runs

EXAMPLES = """\
examples:
  jaxrod evaluate runs/first
  jaxrod evaluate runs/first --episodes 100 --seed 7
  jaxrod evaluate runs/first --noisy             as it acted in training
  jaxrod evaluate runs/first --json              for a script: score, returns, ...
  jaxrod evaluate runs/arm --trust my_module     a run of your own task or learner
  jaxrod evaluate runs/arm --task my_task.py:MyTask   if the file of the task has moved
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of `jaxrod evaluate`."""
    parser.epilog = EXAMPLES
    runs.add_run(parser)
    parser.add_argument(
        "--episodes",
        type=int,
        default=32,
        metavar="N",
        help="number of episodes (default: 32)",
    )
    parser.add_argument(
        "--seed", type=int, default=1, help="seed of the episodes (default: 1)"
    )
    parser.add_argument(
        "--noisy",
        action="store_true",
        help="act with the noise of training (ppo, trpo, shac)",
    )
    parser.add_argument(
        "--json", action="store_true", help="print one JSON object instead of text"
    )


def run(args: argparse.Namespace) -> int:
    """Plays the episodes and prints their returns."""
    import jaxrod
    from jaxrod.validation import check_seed

    if args.episodes < 1:
        raise ValueError(f"episodes must be at least 1, got {args.episodes}")
    check_seed(args.seed)
    jaxrod.configure_cpu()
    stored = runs.open_run(args.run_folder, args.trust, args.task)
    policy: Any = stored.policy()
    from jaxrod.training import evaluate, with_noise

    if args.noisy:
        policy = with_noise(policy, args.seed)
    began = time.perf_counter()
    found = evaluate(stored.env, policy, episodes=args.episodes, seed=args.seed)
    wall = time.perf_counter() - began
    if args.json:
        result = {
            "run": str(stored.path),
            "task": stored.config["task"],
            "variant": stored.config.get("variant"),
            "algorithm": stored.config["algorithm"],
            "episodes": args.episodes,
            "seed": args.seed,
            "noisy": args.noisy,
            "score": found.mean,
            "score_std": found.standard_deviation,
            "flagged_fraction": found.flagged_fraction,
            "returns": found.returns.tolist(),
            "lengths": found.lengths.tolist(),
            "wall_s": wall,
        }
        print(json.dumps(result, indent=2))
        return 0
    kind = "policy with noise" if args.noisy else "deterministic policy"
    print(f"{stored.title}: {args.episodes} episodes of the {kind}")
    print(
        f"return    {found.mean:,.1f} ± {found.standard_deviation:,.1f} "
        f"({found.returns.min():,.1f} to {found.returns.max():,.1f})"
    )
    print(f"flagged   {found.flagged_fraction:.1%} of the episodes")
    print(f"took      {wall:.1f} s, compiling included")
    return 0

"""Check that this machine computes correctly.

Runs small programs with known answers on every kind of device that JAX sees, and
reports the versions and settings that change results. Exits with 0 if all answers are
correct. Otherwise it exits with 1, and reports the fault and its remedy.
"""

from __future__ import annotations

import argparse
import dataclasses
import json

EXAMPLES = """\
examples:
  jaxrod doctor                   a line for every check
  jaxrod doctor --json            the same, for a script
  JAX_PLATFORMS=cpu jaxrod doctor   leave the accelerator out
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of `jaxrod doctor`."""
    parser.epilog = EXAMPLES
    parser.add_argument(
        "--json", action="store_true", help="print one JSON object instead of text"
    )


def run(args: argparse.Namespace) -> int:
    """Runs the checks and prints their results."""
    from jaxrod.installation.doctor import run_checks

    checks = run_checks()
    failed = sum(not check.ok for check in checks)
    if args.json:
        report = [dataclasses.asdict(check) for check in checks]
        print(json.dumps({"sound": failed == 0, "checks": report}, indent=2))
        return int(failed > 0)
    width = max(len(check.name) for check in checks)
    for check in checks:
        mark = "ok   " if check.ok else "WRONG"
        print(f"{mark}  {check.name:<{width}}  {check.detail}")
        if check.advice:
            print(f"{'':7}{'':<{width}}  -> {check.advice}")
    if failed:
        print(f"\nThis machine is not sound: {failed} of {len(checks)} checks failed.")
    else:
        print("\nThis machine is sound.")
    return int(failed > 0)

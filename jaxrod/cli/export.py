"""Write the policy of a run for a controller.

--c writes a C99 header that needs only math.h, and --onnx writes a model for ONNX
runtimes. Each FILE gets a contract beside it, FILE.json, with the entries and units of
observation and action, the rate, the normalisation, the initial memory and the SHA-256
of FILE.
"""

from __future__ import annotations

import argparse
import json

from jaxrod.cli import runs, settings

EXAMPLES = """\
examples:
  jaxrod export runs/first --c policy.h          declares policy_act
  jaxrod export runs/first --onnx policy.onnx    needs pip install "jaxrod[onnx]"
  jaxrod export runs/first --c arm.h --onnx arm.onnx --overwrite
  jaxrod export runs/arm --c arm.h --trust my_module   a run of your own task
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of `jaxrod export`."""
    parser.epilog = EXAMPLES
    runs.add_run(parser)
    parser.add_argument(
        "--c", type=settings.path, metavar="FILE", help="header to write, in C99"
    )
    parser.add_argument(
        "--onnx", type=settings.path, metavar="FILE", help="ONNX model to write"
    )
    parser.add_argument(
        "--overwrite", action="store_true", help="replace earlier files"
    )
    parser.add_argument(
        "--json", action="store_true", help="print the contracts instead of the paths"
    )


def run(args: argparse.Namespace) -> int:
    """Writes the files and prints their names."""
    import jaxrod

    if args.c is None and args.onnx is None:
        raise ValueError("nothing to write: give --c FILE, --onnx FILE or both")
    if args.c == args.onnx:
        raise ValueError(f"--c and --onnx must be different files, got {args.c} twice")
    jaxrod.configure_cpu()
    stored = runs.open_run(args.run_folder, args.trust, args.task)
    policy = stored.policy()
    from jaxrod.training import export_c, export_onnx

    names = ("task", "variant", "env_options", "algorithm", "seed", "steps")
    about = {name: stored.config.get(name) for name in names}
    contracts = [
        write(policy, stored.env, file, about=about, overwrite=args.overwrite)
        for write, file in ((export_c, args.c), (export_onnx, args.onnx))
        if file is not None
    ]
    if args.json:
        print(json.dumps(contracts, indent=2))
        return 0
    for file in (args.c, args.onnx):
        if file is not None:
            print(file, f"{file}.json", sep="\n")
    return 0

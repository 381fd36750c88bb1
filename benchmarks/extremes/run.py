"""Episodes of extreme actions: an arm that is driven at its limits.

`actions` drives the benchmark's arm in free space, and `obstacles` runs Case 3 or 4 in
the library's physics. A third of the episodes hold one corner of the action space, a
third jump between corners every 0.14 s on average, and a third draw a new action in
every control step. Prints one JSON object.
"""

from __future__ import annotations

import argparse
import json

import jaxrod
from benchmarks.extremes import actions, obstacles


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the scenes and their episodes."""
    scenes = parser.add_subparsers(dest="scene", metavar="SCENE", required=True)
    free = scenes.add_parser("actions", help="the arm in free space")
    free.add_argument("--mode", default="consistent", help="or pyelastica")
    free.add_argument("--dtype", default="float32", help="or float64")
    among = scenes.add_parser("obstacles", help="the arm among obstacles")
    among.add_argument("--task", default="unstructured", help="or structured")
    for scene, episodes in ((free, 10_000), (among, 192)):
        scene.add_argument("--episodes", type=int, default=episodes, metavar="N")
        scene.add_argument(
            "--offset", type=int, default=0, metavar="N", help="number of the first"
        )
        scene.add_argument("--seconds", type=float, default=5.0, help="of an episode")


def run(args: argparse.Namespace) -> int:
    """Plays and prints."""
    jaxrod.configure_cpu(1)
    given = (args.episodes, args.seconds)
    if args.scene == "actions":
        result = actions.run(*given, args.mode, args.dtype, offset=args.offset)
    else:
        result = obstacles.run(args.task, *given, offset=args.offset)
    print(json.dumps(result, indent=2))
    return 0

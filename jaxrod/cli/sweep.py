"""Train many policies: every combination of tasks, algorithms, settings and seeds.

Each combination is one run, as with `jaxrod train`, in its own process and its own
folder under DIR. By default they run on this machine, one after another on all cores.
With --jobs several run in parallel, each on its share of the cores. With --ray they run
on the machines of a Ray cluster (docs/sweeps.md). Ctrl-C saves and stops. The same
command continues, also after a kill, and skips finished runs. If a run fails, the
command reports it and continues with the others. The next call tries it again from its
last checkpoint.

`--set NAME=VALUE,VALUE` gives alternatives of a setting. Give alternatives of a tuple
one by one: `--set hidden_sizes=64,64 hidden_sizes=128,128`. If a setting is for one of
the algorithms only, begin with its name: `--set ppo.learning_rate=1e-3,3e-4`.

DIR gets results.csv (a row per run), a picture per task (means and spreads over seeds),
and a folder and a log for every run, named after its combination.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from jaxrod.cli import settings
from jaxrod.cli.runs import add_trust
from jaxrod.cli.train import STEPS

if TYPE_CHECKING:
    from jaxrod.cli.sweeps.plan import SweepRun
    from jaxrod.cli.sweeps.running import Ended, Place
    from jaxrod.training import RunFolder

EXAMPLES = """\
examples:
  jaxrod sweep tracking reaching --algorithms ppo sac --out runs/grid --dry-run
  jaxrod sweep tracking --variant clean --seeds 0 1 2 3 4 --steps 5M --out runs/five
  jaxrod sweep tracking --set learning_rate=1e-3,3e-4 num_envs=64,256 --out runs/rates
  jaxrod sweep trivial --steps 20k --set num_envs=8 --jobs 2 --out runs/small
  jaxrod sweep mypackage.mymodule:make_task --option height=0.6 --out runs/mine
  jaxrod sweep tracking --seeds 0 1 2 --out /shared/grid --ray 10.0.0.1:6379 --cpus 4
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of `jaxrod sweep`."""
    parser.epilog = EXAMPLES
    parser.add_argument("tasks", metavar="TASK", nargs="+", help="as in `jaxrod train`")
    parser.add_argument(
        "--algorithms",
        nargs="+",
        default=["ppo"],
        metavar="NAME",
        help="learners, as for `jaxrod train` (default: ppo)",
    )
    parser.add_argument(
        "--seeds",
        type=int,
        nargs="+",
        default=[0, 1, 2],
        metavar="N",
        help="random seeds (default: 0 1 2)",
    )
    parser.add_argument(
        "--set",
        action="extend",
        nargs="+",
        default=[],
        metavar="NAME=VALUE,...",
        help="alternatives of a setting; for one algorithm only: "
        "ALGORITHM.NAME=VALUE,...",
    )
    parser.add_argument(
        "--variant", help="variant of the tasks (default: the first of each task)"
    )
    parser.add_argument(
        "--option",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="an option of all the tasks; may be given several times",
    )
    parser.add_argument(
        "--steps",
        type=settings.count,
        default=STEPS,
        metavar="N",
        help="control steps of every run, such as 500k or 10M (default: 10M)",
    )
    parser.add_argument(
        "--out",
        type=settings.path,
        required=True,
        metavar="DIR",
        help="folder of the sweep; with --ray on a file system that all nodes share",
    )
    add_trust(parser)
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--jobs",
        type=settings.count,
        default=1,
        metavar="N",
        help="runs in parallel, each on its share of the cores (default: 1)",
    )
    where.add_argument(
        "--ray",
        metavar="ADDRESS",
        help="train on the Ray cluster whose head is at HOST:PORT, or auto on one of "
        'its nodes; needs pip install "jaxrod[ray]" on all nodes',
    )
    parser.add_argument(
        "--cpus",
        type=settings.count,
        metavar="N",
        help="with --ray: processor cores of every run (default: 1)",
    )
    parser.add_argument(
        "--gpus",
        type=float,
        metavar="N",
        help="with --ray: GPUs of every run, such as 1 or 0.25 (default: 0)",
    )
    parser.add_argument(
        "--checkpoint-seconds",
        type=float,
        default=60.0,
        metavar="S",
        help="time between checkpoints of a run (default: 60)",
    )
    parser.add_argument(
        "--dry-run", action="store_true", help="list the runs, and train nothing"
    )
    parser.add_argument(
        "--json", action="store_true", help="print the rows of results.csv as JSON"
    )


def run(args: argparse.Namespace) -> int:
    """Trains the unfinished runs, or lists them."""
    import jax

    from jaxrod.cli.sweeps.plan import plan
    from jaxrod.cli.sweeps.results import Results
    from jaxrod.installation.backend import given_options

    given_options()  # Mistakes in them are reported before JAX starts.
    # Runs are planned here and trained elsewhere, so this process takes no GPU memory.
    jax.config.update("jax_platforms", "cpu")
    if args.ray is None and (args.cpus, args.gpus) != (None, None):
        raise ValueError("--cpus and --gpus need --ray")
    if args.cpus is not None and args.cpus < 1:
        raise ValueError(f"cpus must be at least 1, got {args.cpus}")
    if args.gpus is not None and not args.gpus >= 0:
        raise ValueError(f"gpus must not be negative, got {args.gpus}")
    if not args.checkpoint_seconds >= 0:
        raise ValueError(
            f"checkpoint-seconds must not be negative, got {args.checkpoint_seconds} s"
        )
    cores = None if args.ray is None or args.gpus else args.cpus or 1
    runs = plan(
        args.tasks,
        args.algorithms,
        args.seeds,
        steps=args.steps,
        variant=args.variant,
        options=args.option,
        sets=args.set,
        cores=cores,
    )
    out = args.out.resolve()
    _check_folders(runs, out)
    if args.dry_run:
        results, code, drawn = Results(runs, out), 0, []
    else:
        with _place(args, len(runs)) as place:
            words = ["--checkpoint-seconds", str(args.checkpoint_seconds)]
            words += [word for one in args.trust for word in ("--trust", one)]
            code = _train(runs, out, place, [*words, "--no-replay"])
        results = Results(runs, out)
        drawn = results.draw()
    if args.json:
        rows = [
            {k: None if v != v else v for k, v in row.items()} for row in results.rows
        ]
        print(json.dumps(rows, indent=2))
    elif args.dry_run:
        for row in results.rows:
            print(f"{row['state']:<10}  {row['run']}")
    else:
        for file in (out / "results.csv", *drawn):
            print(file)
    return code


@contextmanager
def _place(args: argparse.Namespace, number: int) -> Iterator[Place]:
    """Yields the machine or Ray cluster that trains the runs, chosen by the arguments.

    `number` is the number of runs.
    """
    if args.ray is None:
        from jaxrod.cli.sweeps.running import ThisMachine

        yield ThisMachine(args.jobs)
    else:
        from jaxrod.cli.sweeps.on_ray import cluster

        with cluster(args.ray, number, args.cpus or 1, args.gpus or 0.0) as connected:
            yield connected


def _check_folders(runs: Sequence[SweepRun], out: Path) -> None:
    """Raises ValueError if a run can be neither started nor continued."""
    from jaxrod.cli.sweeps.plan import differs
    from jaxrod.cli.sweeps.running import log_of
    from jaxrod.files import refuse_link

    if out.exists() and not out.is_dir():
        raise ValueError(f"out must be a folder, but {out} is a file")
    for run in runs:
        folder = _folder(run, out)
        refuse_link(folder.path)
        refuse_link(log_of(folder))
        folder.check_replaceable()
        how = differs(run, folder)
        if how:
            raise ValueError(
                f"{folder.path} holds a different run: {', '.join(how)}; remove it, or "
                "choose another folder with --out"
            )


def _train(runs: Sequence[SweepRun], out: Path, place: Place, more: list[str]) -> int:
    """Trains the unfinished runs of a sweep and writes results.csv.

    Args:
        runs: All runs of the sweep.
        out: Folder of the sweep.
        place: Machine or cluster that trains the runs.
        more: Words that are added to the commands of all runs.

    Returns:
        Exit code: 0 if all runs finished, 1 if some failed, 130 if interrupted.
    """
    from jaxrod.cli.sweeps.results import Results
    from jaxrod.cli.sweeps.running import (
        RunsView,
        last_row,
        log_of,
        train_all,
        wait_for,
    )
    from jaxrod.training.runs.interruption import Interruption
    from jaxrod.training.runs.owned_folder import only_process

    folders = {run.name: _folder(run, out) for run in runs}
    with only_process(out):
        view = RunsView(runs, sys.stderr)
        wait_for(folders.values(), view.say)
        results = Results(runs, out)
        results.write()
        waiting: list[SweepRun] = []
        failed: list[SweepRun] = []
        for run, row in zip(runs, results.rows, strict=True):
            if row["state"] == "finished":
                view.done(run, folders[run.name].summary(), quiet=True)
            else:
                waiting.append(run)

        def ended(run: SweepRun, how: Ended) -> None:
            folder = folders[run.name]
            if folder.finished:
                results.update(run)
                view.done(run, folder.summary(), quiet=False)
            elif interruption.requested:
                results.update(run)
                view.stopped(run, last_row(folder))
            else:
                failed.append(run)
                results.update(run, how.said or f"exit code {how.code}")
                view.failed(run, f"{how.said} (see {log_of(folder)})")

        with Interruption(view.say) as interruption:
            train_all(
                waiting,
                lambda run: folders[run.name],
                place,
                view,
                interruption,
                ended,
                more,
            )
    if interruption.requested:
        view.say("stopped; the same command continues")
        return 130
    return 1 if failed else 0


def _folder(run: SweepRun, out: Path) -> RunFolder:
    from jaxrod.training import RunFolder

    return RunFolder(out / run.name)

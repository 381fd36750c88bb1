"""The arguments of `jaxrod train`."""

from __future__ import annotations

import argparse

from jaxrod.cli import runs, settings

STEPS = 10_000_000
"""Default number of control steps: the published budget."""

EXAMPLES = """\
examples:
  jaxrod train tracking                                    the paper's, a few minutes
  jaxrod train tracking --variant clean --steps 5M --seed 1 --out runs/clean
  jaxrod train tracking --resume --out runs/clean          go on after a stop
  jaxrod train tracking --like runs/clean --seed 2 --out runs/clean-2
  jaxrod train trivial --steps 200k --num-envs 32 --set rollout_steps=64
  jaxrod train tracking --set learning_rate=3e-4 --set hidden_sizes=128,128
  jaxrod train tracking --algorithm sac --steps 2M --set gradient_steps=128
  jaxrod train structured --algorithm trpo --steps 500k --option controls=4
  jaxrod train unstructured --option nest=7 --steps 1M
  jaxrod train mypackage.mymodule:make_task --option height=0.6 --steps 100k
  jaxrod train tracking --algorithm my_module:MY_ALGORITHM        your own learner
  jaxrod train tracking --set network=my_module:my_network        your own network
  jaxrod train tracking --resume --out runs/mine --trust my_module   ... continued
  jaxrod train tracking --log tensorboard                  and: tensorboard --logdir .
  jaxrod train tracking --json > result.json               for a script: summary.json

`--set help` lists the settings of the algorithm, their defaults and what they mean.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of `jaxrod train`."""
    from jaxrod.installation.processes import JOINED_WITHIN

    parser.epilog = EXAMPLES
    parser.add_argument("task", metavar="TASK", help="see above")
    parser.add_argument(
        "--option",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="an option of the task, such as n_elements=20; may be given several times",
    )
    parser.add_argument("--variant", help="paper or clean (default: the first it has)")
    parser.add_argument(
        "--algorithm",
        metavar="NAME",
        help="ppo, trpo, sac, td3, ddpg, dagger, shac, or your own: "
        "module:NAME (default: ppo)",
    )
    parser.add_argument(
        "--steps",
        type=settings.count,
        metavar="N",
        help="control steps, such as 500k or 10M (default: 10M)",
    )
    parser.add_argument("--seed", type=int, help="of all randomness (default: 0)")
    parser.add_argument(
        "--out",
        type=settings.path,
        metavar="DIR",
        help="folder of the run (default: runs/TASK-VARIANT-ALGORITHM-SEED)",
    )
    existing = parser.add_mutually_exclusive_group()
    existing.add_argument(
        "--resume",
        action="store_true",
        help="continue the run in DIR; what is not given is as it was",
    )
    existing.add_argument(
        "--overwrite", action="store_true", help="replace the run in DIR"
    )
    parser.add_argument(
        "--like",
        type=settings.path,
        metavar="RUN",
        help="begin a new run with the options, settings, steps and seed of the run in "
        "the folder RUN; what is given besides counts instead",
    )
    runs.add_trust(parser)
    parser.add_argument(
        "--num-envs",
        type=int,
        metavar="N",
        help="environments side by side; short for --set num_envs=N",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a setting of the algorithm; may be given several times",
    )
    parser.add_argument(
        "--devices",
        type=int,
        metavar="N",
        help="devices to spread the environments over, of each process "
        "(default: as many as fit)",
    )
    parser.add_argument(
        "--distributed",
        action="store_true",
        help="this is one of several processes that train together: SLURM, Open MPI "
        "or Kubernetes say which, or the three options below (docs/cluster.md)",
    )
    parser.add_argument(
        "--coordinator", metavar="HOST:PORT", help="address of the first process"
    )
    parser.add_argument(
        "--processes", type=int, metavar="N", help="number of processes"
    )
    parser.add_argument(
        "--process-id", type=int, metavar="I", help="number of this one, from 0"
    )
    parser.add_argument(
        "--cache",
        action="store_true",
        help="keep compiled programs on disk for the next run, as JAXROD_CACHE=1 does "
        "(docs/compiling.md)",
    )
    parser.add_argument(
        "--join-seconds",
        type=int,
        metavar="S",
        help="with --distributed: time in which all processes have to come "
        f"(default: {JOINED_WITHIN})",
    )
    parser.add_argument(
        "--checkpoint-seconds",
        type=float,
        default=60.0,
        metavar="S",
        help="time between checkpoints (default: 60)",
    )
    parser.add_argument(
        "--log",
        choices=("tensorboard", "none"),
        help="tensorboard: keep the rows of progress.csv in DIR/tensorboard, too, "
        "where TensorBoard shows them as they come (default: none; with --resume as "
        'it was); needs pip install "jaxrod[tensorboard]"',
    )
    parser.add_argument(
        "--no-replay", action="store_true", help="do not write replay.html"
    )
    parser.add_argument(
        "--json", action="store_true", help="print summary.json instead of text"
    )

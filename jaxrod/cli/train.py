"""Train a policy on a task.

TASK is `tracking` (a soft arm follows a moving target), `reaching` (it reaches a point
with an orientation), `structured` (a planar arm in a maze), `unstructured` (an arm in a
nest), `following` (an arm with commanded curvatures follows a moving target), `snake`
or `octopus` (they crawl along a heading), `gripper` (three fingers lift a ball), `lift`
(a hand lifts a rope), `insert` (a hand pushes a cable into a socket), `catheter` (its
tip enters a branch of a vessel) or `trivial` (learned in seconds, for trials).
The first four have the variants `paper`, whose scores you can compare with the
published ones, and `clean`. `trivial` has no variants, and the others have only
`clean`. TASK may also be your own: `mypackage.mymodule:make_task` or
`folder/file.py:make_task` names the callable that makes it. jaxrod also searches the
current folder for modules (docs/extending.md).

The run folder gets config.json, progress.csv (env_steps, wall_s,
episode_return_mean, ...), episodes.csv, checkpoints/, policy/, summary.json,
learning_curve.png and replay.html. Ctrl-C saves and stops. --resume continues the run,
and the result is the same as without the interruption. While a process trains in a
folder, no other process can. Even with --overwrite, jaxrod does not touch files there
that it has not written.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from jaxrod.cli import runs, settings
from jaxrod.cli.render import draw_learning_curve, print_paths, write_replay
from jaxrod.files import reading

STEPS = 10_000_000
"""Default number of control steps: the published budget."""

EXAMPLES = """\
examples:
  jaxrod train tracking                                    the paper's task, in minutes
  jaxrod train tracking --variant clean --steps 5M --seed 1 --out runs/clean
  jaxrod train tracking --resume --out runs/clean          continue after a stop
  jaxrod train tracking --like runs/clean --seed 2 --out runs/clean-2
  jaxrod train trivial --steps 200k --num-envs 32 --set rollout_steps=64
  jaxrod train tracking --set learning_rate=3e-4 --set hidden_sizes=128,128
  jaxrod train tracking --algorithm sac --steps 2M --set gradient_steps=128
  jaxrod train structured --algorithm trpo --steps 500k --option controls=4
  jaxrod train unstructured --option nest=7 --steps 1M
  jaxrod train tracking --randomise reality.toml           docs/randomisation.md
  jaxrod train mypackage.mymodule:make_task --option height=0.6 --steps 100k
  jaxrod train tracking --algorithm my_module:MY_ALGORITHM        your own learner
  jaxrod train tracking --set network=my_module:my_network        your own network
  jaxrod train tracking --resume --out runs/mine --trust my_module   ... continued
  jaxrod train tracking --log tensorboard                  then: tensorboard --logdir .
  jaxrod train tracking --json > result.json               for a script: summary.json

`--set help` lists the settings of the algorithm, `--option help` the options of the
task: names, defaults, meanings and units.
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
    parser.add_argument(
        "--randomise",
        type=settings.path,
        metavar="FILE",
        help="distributions of parameters, noise, delays and faults: a TOML file "
        "(docs/randomisation.md), whose content config.json keeps",
    )
    parser.add_argument("--variant", help="paper or clean (default: the task's first)")
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
        help="control steps, such as 500k or 10M, rounded up to whole updates "
        "(default: 10M)",
    )
    parser.add_argument("--seed", type=int, help="random seed (default: 0)")
    parser.add_argument(
        "--out",
        type=settings.path,
        metavar="DIR",
        help="folder of the run (default: runs/TASK-VARIANT-OPTIONS-ALGORITHM-SEED)",
    )
    existing = parser.add_mutually_exclusive_group()
    existing.add_argument(
        "--resume",
        action="store_true",
        help="continue the run in DIR; options that are not given keep their values",
    )
    existing.add_argument(
        "--overwrite", action="store_true", help="replace the run in DIR"
    )
    parser.add_argument(
        "--like",
        type=settings.path,
        metavar="RUN",
        help="begin a new run with the options, settings, steps and seed of the run in "
        "the folder RUN; options that are given here take precedence",
    )
    runs.add_trust(parser)
    parser.add_argument(
        "--num-envs",
        type=int,
        metavar="N",
        help="parallel environments; short for --set num_envs=N",
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
        help="devices per process for the environments (default: as many as fit)",
    )
    parser.add_argument(
        "--distributed",
        action="store_true",
        help="this is one of several processes that train together: SLURM, Open MPI, "
        "Kubernetes or the three options below describe them (docs/cluster.md)",
    )
    parser.add_argument(
        "--coordinator", metavar="HOST:PORT", help="address of the first process"
    )
    parser.add_argument(
        "--processes", type=int, metavar="N", help="number of processes"
    )
    parser.add_argument(
        "--process-id", type=int, metavar="I", help="index of this process, from 0"
    )
    parser.add_argument(
        "--join-seconds",
        type=int,
        metavar="S",
        help="with --distributed: time within which all processes must join "
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
        help="tensorboard: also write the rows of progress.csv to DIR/tensorboard, "
        "for TensorBoard (default: none; with --resume that of the run); "
        'needs pip install "jaxrod[tensorboard]"',
    )
    parser.add_argument(
        "--no-replay", action="store_true", help="do not write replay.html"
    )
    parser.add_argument(
        "--json", action="store_true", help="print summary.json instead of text"
    )


def run(args: argparse.Namespace) -> int:
    """Trains a policy, draws its pictures, and prints the result."""
    import jaxrod
    from jaxrod.envs import check_environment, names
    from jaxrod.envs.importing import canonical_path
    from jaxrod.installation.backend import devices_that_fit, first_of_each
    from jaxrod.installation.processes import JOINED_WITHIN, join_processes
    from jaxrod.training import RunFolder, train
    from jaxrod.training.runs.contract import resolve, updates_of
    from jaxrod.training.runs.hosts import LostProcessError
    from jaxrod.training.settings import check_steps
    from jaxrod.validation import check_seed

    if "help" in args.option:
        print(runs.options_of_task(args.task))
        return 0
    stored = None
    if args.resume and args.like:
        raise ValueError("give --like to begin a new run, or --resume, but not both")
    source = args.like or (_folder(args, None) if args.resume else None)
    if source:
        stored = runs.read_config(source)
        if stored["env_options"] is None:
            raise ValueError(
                f"{source / 'config.json'} does not say what makes its environment, "
                "which was made in Python; continue the run there, by "
                "jaxrod.training.train(..., resume=True)"
            )
        if stored["task"] != canonical_path(args.task):
            raise ValueError(
                f"{source / 'config.json'}: the run trains {stored['task']}, not "
                f"{args.task}"
            )
        if args.algorithm in (None, stored["algorithm"]):
            with reading(source / "config.json"):
                resolve(stored["algorithm"], None, _trust(args))
    if args.like:
        assert stored
        # The folder is named after the task, algorithm and seed that are trained.
        args.algorithm = args.algorithm or stored["algorithm"]
        args.seed = stored["seed"] if args.seed is None else args.seed
    algorithm = _chosen(args.algorithm, stored, "algorithm", "ppo")
    learner, config = resolve(algorithm, None, _trust(args))
    if "help" in args.set:
        print(settings.listing(config))
        return 0
    words = list(args.set)
    if args.num_envs is not None:
        words.append(f"num_envs={args.num_envs}")
    said = settings.configure(config, {}, words)
    # Anything that the user has just typed is trusted, also under other names.
    trust = _trust(args, said)
    if stored and algorithm == stored["algorithm"]:
        assert source
        given = {word.partition("=")[0] for word in words}
        kept = {k: v for k, v in stored["settings"].items() if k not in given}
        with reading(source / "config.json"):
            config = settings.configure(config, kept, [], trust)
            if not given:
                # Otherwise these are not yet the settings of the run, and `train`
                # checks them.
                learner.validate(config, 1)
                check_steps(stored["steps"], updates_of(learner, config))
    config = settings.configure(config, {}, words)
    wanted = getattr(config, "num_envs", 1) if learner.partition else 1
    # This comes before a user's own task is imported, which may start computing at
    # once.
    jaxrod.configure_cpu(devices_that_fit(wanted, args.devices, available=None))
    processes = (args.coordinator, args.processes, args.process_id)
    if args.distributed:
        within = JOINED_WITHIN if args.join_seconds is None else args.join_seconds
        join_processes(*processes, within=within)
    elif any(one is not None for one in (*processes, args.join_seconds)):
        raise ValueError(
            "--coordinator, --processes, --process-id and --join-seconds need "
            "--distributed"
        )
    if source:
        runs.open_run(source, trust)
    options = dict(stored["env_options"]) if stored else {}
    if args.variant is not None:
        options["variant"] = args.variant
    if args.randomise is not None:
        options["randomise"] = settings.randomisation(args.randomise)
    env = runs.make_task(args.task, options | settings.options(args.option))
    seed = check_seed(_chosen(args.seed, stored, "seed", 0))
    out = _folder(args, getattr(env, "variant", None))
    # With several processes only the first checks, in `train`, because it may already
    # have begun.
    if not args.resume and not args.distributed:
        RunFolder(out).check_replaceable()
        if RunFolder(out).exists and not args.overwrite:
            raise ValueError(
                f"{out} holds a run already: continue it with --resume, replace it "
                "with --overwrite, or choose another folder with --out"
            )
    import jax

    if args.task not in names():
        check_environment(env)
    devices = jax.devices()
    if args.distributed:
        devices = first_of_each(devices, args.devices)
    else:
        share = devices_that_fit(wanted, args.devices, len(devices))
        if share > len(devices):
            raise ValueError(
                f"devices must be at most the {len(devices)} available, got {share}"
            )
        devices = devices[:share]
    try:
        result = train(
            env,
            algorithm,
            steps=_chosen(args.steps, stored, "steps", STEPS),
            seed=seed,
            out=out,
            config=config,
            score_window=_chosen(
                None, stored, "score_window", runs.score_window(args.task)
            ),
            resume=args.resume,
            overwrite=args.overwrite,
            checkpoint_seconds=args.checkpoint_seconds,
            devices=devices,
            log="tensorboard" if _logs(args, out) else None,
        )
    except FloatingPointError as error:
        print(f"jaxrod train: {error}", file=sys.stderr)
        return 1
    except LostProcessError as error:
        print(f"jaxrod train: {error}", file=sys.stderr, flush=True)
        # A regular exit would wait for the lost process, and then abort.
        os._exit(1)
    if args.distributed:
        # Shut down here, which all processes reach: only the first does the rest.
        try:
            jax.distributed.shutdown()
        except jax.errors.JaxRuntimeError:
            print(
                "jaxrod train: another process was lost at the very end; "
                "the result is complete",
                file=sys.stderr,
            )
    summary = result.summary
    if result.folder is None:
        return 130 if summary["status"] == "interrupted" else 0
    if summary["status"] == "interrupted":
        needed = "".join(f" --trust {one}" for one in _modules(algorithm, config))
        print(
            f"continue with: jaxrod train {args.task} --resume --out {out}{needed}",
            file=sys.stderr,
        )
        return 130
    pictures = _draw(out, result.policy, trust, replay=not args.no_replay)
    if args.json:
        print(json.dumps({**summary, "run": str(out)}, indent=2))
        return 0
    for line in _lines(summary, runs.read_config(out)):
        print(line)
    print_paths(*pictures)
    return 0


def _trust(args: argparse.Namespace, said: Any = None) -> tuple[str, ...]:
    """Modules and import paths that may be imported if a file names them.

    Args:
        args: Arguments of the command: modules of `--trust`, task and algorithm.
        said: Settings that the user typed; their functions are trusted.
    """
    from jaxrod.envs.importing import canonical_path

    typed = (args.task, canonical_path(args.task), args.algorithm or "")
    # The name of a built-in does not make a module of the same name trusted.
    paths = [word for word in typed if ":" in word]
    return (*args.trust, *paths, *_functions(said))


def _modules(algorithm: str, config: Any) -> list[str]:
    """Modules that `--trust` must name to resume a run, apart from the task's."""
    paths = [algorithm, *_functions(config)]
    usual = () if config is None else _functions(type(config)())
    named = {path.rpartition(":")[0] for path in paths if path not in usual}
    return sorted(filter(None, named))


def _functions(settings: Any) -> list[str]:
    """Import paths of those settings that are functions; `settings` may be None."""
    from jaxrod.envs.importing import import_path

    fields = () if settings is None else dataclasses.fields(settings)
    values = [getattr(settings, field.name) for field in fields]
    return [path for one in values if callable(one) and (path := import_path(one))]


def _logs(args: argparse.Namespace, out: Path) -> bool:
    """Whether to write an event file, according to --log or else the resumed run."""
    from jaxrod.training import RunFolder

    if args.log is None and args.resume:
        return RunFolder(out).tensorboard.is_dir()
    return bool(args.log == "tensorboard")


def _draw(
    out: Path, policy: Any, trust: Collection[str], replay: bool
) -> list[Path | None]:
    """Draws the learning curve, and the replay if wanted; returns the paths."""
    stored = runs.open_run(out, trust)
    drawn = [draw_learning_curve(out, stored.config)]
    if replay:
        drawn.append(write_replay(stored, policy))
    return drawn


def _lines(summary: Mapping[str, Any], config: Mapping[str, Any]) -> list[str]:
    """Summary of a finished run as lines of text."""
    lines = [
        f"{runs.describe(config)}: {summary['env_steps']:,} control steps in "
        f"{summary['wall_s']:.0f} s, {summary['steps_per_s']:,.0f} steps/s with "
        "compiling",
        f"first score   {_score(summary, 'first')}",
        f"final score   {_score(summary, 'final')}",
    ]
    if "evaluation_score" in summary:
        lines.append(
            f"evaluation    {summary['evaluation_score']:,.1f} ± "
            f"{summary['evaluation_std']:,.1f}, "
            f"{summary['evaluation_episodes']} episodes of the deterministic policy"
        )
    lines.append(
        f"flagged       {summary['flagged_fraction']:.1%} of the training episodes"
    )
    return lines


def _score(summary: Mapping[str, Any], which: str) -> str:
    """Words on the mean return of the first or of the final training episodes."""
    score = summary[f"{which}_score"]
    if score is None:
        return "none, because no training episode ended in these steps"
    episodes = min(summary["score_window"], summary["episodes"])
    place = {"first": "first", "final": "last"}[which]
    return f"{score:,.1f}, mean return of the {place} {episodes} training episodes"


def _folder(args: argparse.Namespace, variant: str | None) -> Path:
    """Folder of the run: `--out`, or runs/TASK-VARIANT-OPTIONS-ALGORITHM-SEED."""
    from jaxrod import envs

    if args.out is not None:
        return args.out
    # An import path is not a valid folder name on every system.
    algorithm = (args.algorithm or "ppo").replace(":", "-")
    words = [short_name(args.task), variant, algorithm, str(args.seed or 0)]
    if args.task not in envs.names():
        words[1] = args.variant
    elif args.resume and variant is None:
        words[1] = args.variant or _default_variant(args.task)
    if args.task in envs.names():
        chosen = settings.options(args.option).items()
        words[2:2] = [f"{k}-{v}" for k, v in chosen if isinstance(v, int | float)]
    if args.randomise is not None:
        words[-2:-2] = ["randomised"]
    return Path("runs") / "-".join(word for word in words if word)


def short_name(task: str) -> str:
    """Name of a task for folders, such as "arm-make" for "tasks/arm.py:make"."""
    place, colon, name = task.rpartition(":")
    return f"{Path(place.removesuffix('.py')).name}-{name}" if colon else task


def _default_variant(task: str) -> str | None:
    return getattr(runs.make_task(task, {}), "variant", None)


def _chosen(
    given: Any, stored: Mapping[str, Any] | None, name: str, default: Any
) -> Any:
    """The value given on the command line, else the stored run's, else the default."""
    if given is not None:
        return given
    return stored.get(name, default) if stored else default

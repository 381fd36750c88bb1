"""A sweep on two simulated nodes of Ray, one of which is killed in mid-run."""

import os
import re
import subprocess
import sys
import time

import numpy as np
import pytest

from jaxrod.training.runs.checkpoint import Checkpoints
from jaxrod.training.runs.folder import RunFolder

OWN = """
from jaxrod.envs.trivial import Trivial

def make_task(length: int = 20):
    return Trivial(episode_length=length)
"""
WORDS = [
    *("own_task:make_task", "--option", "length=10"),
    *("--set", "num_envs=8", "hidden_sizes=8", "learning_rate=1e-3,3e-4"),
    *(
        "--seeds",
        "0",
        "1",
        "2",
        "3",
        "4",
        "5",
        "--steps",
        "100k",
        "--checkpoint-seconds",
        "0",
    ),
]


def command(out, *words):
    return [sys.executable, "-m", "jaxrod", "sweep", *WORDS, "--out", str(out), *words]


def last_checkpoint(folder):
    checkpoints = Checkpoints(folder.checkpoints)
    with np.load(checkpoints.path(checkpoints.steps()[0])) as stored:
        return {name: stored[name] for name in stored.files if name != "about"}


@pytest.mark.slow
def test_all_runs_end_as_on_one_machine_when_a_node_dies(tmp_path):
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    (tmp_path / "own_task.py").write_text(OWN)
    # Two processes that share what was compiled could read what is half written.
    environment = {k: v for k, v in os.environ.items() if "COMPILATION_CACHE" not in k}
    node = {"num_cpus": 1, "object_store_memory": 10**8}
    cluster = Cluster(
        initialize_head=True, head_node_args={**node, "include_dashboard": False}
    )
    there, here = tmp_path / "there", tmp_path / "here"
    try:
        victim = cluster.add_node(**node)
        with subprocess.Popen(
            command(there, "--ray", cluster.address),
            cwd=tmp_path,
            env=environment,
            stderr=subprocess.PIPE,
            text=True,
        ) as sweep:
            cut = begun_on(victim.node_id, there, sweep)
            cluster.remove_node(victim, allow_graceful=False)
            _, said = sweep.communicate(timeout=900)
        assert sweep.returncode == 0, said
    finally:
        cluster.shutdown()
    log = (there / f"{cut}.log").read_text()
    assert len(set(re.findall("node ([0-9a-f]{56})", log))) == 2, "tried on the other"
    assert log.count("--resume") == 1
    subprocess.run(
        command(here, "--jobs", "2"),
        cwd=tmp_path,
        env=environment,
        check=True,
        capture_output=True,
    )
    names = sorted(path.name for path in here.iterdir() if path.is_dir())
    assert len(names) == 12
    for name in names:
        left, right = RunFolder(there / name), RunFolder(here / name)
        assert left.finished and right.finished
        assert left.episodes.path.read_bytes() == right.episodes.path.read_bytes()
        a, b = last_checkpoint(left), last_checkpoint(right)
        assert a.keys() == b.keys()
        for key, array in a.items():
            np.testing.assert_array_equal(array, b[key], err_msg=f"{name} {key}")


def begun_on(node, out, sweep):
    """Waits for a run of a node that has a checkpoint and has not ended; its name."""
    until = time.monotonic() + 300
    while time.monotonic() < until and sweep.poll() is None:
        for log in out.glob("*.log"):
            folder = RunFolder(out / log.stem)
            if node in log.read_text() and not folder.summary_file.exists():
                if Checkpoints(folder.checkpoints).steps():
                    return log.stem
        time.sleep(0.02)
    pytest.fail(f"no run got that far: {sweep.poll()}")

"""One run in two processes: what is equal, what is told, who writes."""

import json
import os
import signal
import socket
import subprocess
import sys
import time

import jax
import numpy as np
import pytest

from jaxrod.installation.processes import join_processes
from jaxrod.training.runs.checkpoint import Checkpoints
from jaxrod.training.runs.folder import RunFolder
from jaxrod.training.runs.hosts import Hosts, packed, unpacked

RUN = """
import json, sys, time
asked = json.loads(sys.argv[1])
import jax
jax.config.update("jax_num_cpu_devices", asked["devices"])
jax.config.update("jax_numpy_rank_promotion", "raise")
if asked["processes"] > 1:
    from jaxrod.installation.processes import join_processes
    join_processes(asked["coordinator"], asked["processes"], int(sys.argv[2]))
from jaxrod.envs.trivial import Trivial
from jaxrod.training import find_algorithm, train
type_ = find_algorithm(asked["algorithm"]).config_type
config = type_(num_envs=8, hidden_sizes=(8,), **asked["settings"])
try:
    result = train(
        Trivial(), asked["algorithm"], steps=asked["steps"], config=config,
        chunk_steps=256, out=asked["out"], progress=False, evaluation_episodes=2,
        checkpoint_seconds=asked.get("checkpoint_seconds", 60),
        resume=asked.get("resume", False),
        log=lambda row: time.sleep(asked.get("pause", 0)),
    )
except ValueError as error:
    print(json.dumps({"refused": str(error)}))
    sys.exit(0)
print(json.dumps({
    "score": result.summary["final_score"],
    "evaluation": result.summary["evaluation_score"],
    "episodes": len(result.episodes),
    "wrote": result.folder is not None,
}))
"""
SETTINGS = {
    "ppo": {"rollout_steps": 16, "epochs": 2, "minibatches": 2},
    "sac": {"batch_size": 32, "gradient_steps": 2, "buffer_size": 1024},
}


def asked(out, algorithm="ppo", **other):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    return {
        "algorithm": algorithm,
        "settings": SETTINGS[algorithm],
        "out": str(out),
        "steps": 128 * 8,
        "devices": 1,
        "processes": 2,
        "coordinator": f"127.0.0.1:{port}",
        **other,
    }


def start(request):
    return [
        subprocess.Popen(
            [sys.executable, "-c", RUN, json.dumps(request), str(index)],
            stdout=subprocess.PIPE,
            text=True,
        )
        for index in range(request["processes"])
    ]


def said(processes):
    words = [process.communicate(timeout=300)[0] for process in processes]
    assert [process.returncode for process in processes] == [0] * len(processes)
    return [json.loads(word.splitlines()[-1]) for word in words]


def last_checkpoint(out):
    checkpoints = Checkpoints(RunFolder(out).checkpoints)
    with np.load(checkpoints.path(checkpoints.steps()[0])) as stored:
        return {name: stored[name] for name in stored.files if name != "about"}


def assert_equal_ends(left, right):
    a, b = last_checkpoint(left), last_checkpoint(right)
    assert a.keys() == b.keys()
    for name, array in a.items():
        np.testing.assert_array_equal(array, b[name], err_msg=name)
    assert (left / "episodes.csv").read_bytes() == (right / "episodes.csv").read_bytes()


@pytest.mark.slow
def test_two_processes_are_two_devices_bit_by_bit(tmp_path):
    whole, apart = tmp_path / "whole", tmp_path / "apart"
    (one,) = said(start(asked(whole, devices=2, processes=1)))
    first, second = said(start(asked(apart)))
    assert one == first == {**second, "wrote": True}
    assert not second["wrote"]
    assert_equal_ends(whole, apart)


@pytest.mark.slow
def test_what_the_first_refuses_all_refuse_in_the_same_words(tmp_path):
    (tmp_path / "config.json").write_text("{}")
    refused = said(start(asked(tmp_path)))
    assert str(tmp_path) in refused[0]["refused"]
    assert refused[0] == refused[1]


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_two_hundred_updates_are_equal(tmp_path, algorithm):
    whole, apart = tmp_path / "whole", tmp_path / "apart"
    said(start(asked(whole, algorithm, devices=2, processes=1, steps=128 * 200)))
    said(start(asked(apart, algorithm, steps=128 * 200)))
    assert_equal_ends(whole, apart)


@pytest.mark.slow
@pytest.mark.parametrize("victim", [0, 1])
def test_the_other_stops_when_one_is_killed_and_nothing_is_lost(tmp_path, victim):
    whole, apart = tmp_path / "whole", tmp_path / "apart"
    often = {"steps": 128 * 30, "checkpoint_seconds": 0}
    said(start(asked(whole, devices=2, processes=1, **often)))
    processes = start(asked(apart, pause=0.2, **often))
    deadline = time.monotonic() + 120
    while len(RunFolder(apart).progress.read()) < 5 and time.monotonic() < deadline:
        time.sleep(0.05)
    os.kill(processes[victim].pid, signal.SIGKILL)
    other = processes[1 - victim]
    other.communicate(timeout=60)
    assert other.returncode != 0
    processes[victim].communicate()
    said(start(asked(apart, resume=True, **often)))
    assert_equal_ends(whole, apart)


def test_one_process_exchanges_nothing():
    hosts = Hosts(jax.devices())
    assert not hosts.several
    assert hosts.writes
    assert hosts.from_writer(lambda: b"told") == b"told"
    assert hosts.agree(True, False) == (True, False)


def test_what_is_sent_is_what_arrives():
    arrays = {
        "state.a": np.array([[-0.0, np.nan]]),
        "state.b": np.arange(3, dtype="u4"),
    }
    found, about = unpacked(packed(arrays, [{"updates": 3}, []]))
    assert about == [{"updates": 3}, []]
    for name, array in arrays.items():
        assert found[name].tobytes() == array.tobytes()
        assert found[name].dtype == array.dtype


@pytest.mark.parametrize(
    ("given", "word"),
    [
        ((None, 2, 0), "together"),
        (("here", 2, 0), "address and a port"),
        (("127.0.0.1:1", 2, 2), "0 to 1"),
        (("127.0.0.1:1234", 0, 0), "count of processes must be at least 1, got 0"),
        (("127.0.0.1:0", 2, 0), "coordinator must be 1 to 65535, got 0"),
        (("127.0.0.1:65536", 2, 0), "coordinator must be 1 to 65535, got 65536"),
        (("127.0.0.1:999999", 2, 1), "coordinator must be 1 to 65535, got 999999"),
        (
            ("127.0.0.1:" + "9" * 5000, 2, 1),
            "coordinator must be 1 to 65535, got 9{20}",
        ),
    ],
)
def test_bad_processes_are_refused(given, word):
    with pytest.raises(ValueError, match=word):
        join_processes(*given)


def test_a_port_that_another_program_has_is_told_at_once():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        said = f"cannot listen on .* port {port} .*: choose another"
        with pytest.raises(ValueError, match=said):
            join_processes(f"127.0.0.1:{port}", 2, 0)
    assert not jax.distributed.is_initialized()

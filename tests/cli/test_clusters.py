"""The files of docs/cluster, and how JAX finds processes, as far as one machine goes.

Two processes here stand for those of a cluster. SLURM's `srun`, Open MPI's `mpirun` and
Kubernetes are not run: what they put into the environment of a process is set by hand.
"""

import json
import os
import random
import socket
import stat
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from jaxrod.installation.backend import first_of_each
from jaxrod.installation.processes import join_processes

CLUSTER = Path(__file__).parents[2] / "docs" / "cluster"
TRAIN = ["trivial", "--steps", "2k", "--num-envs", "8", "--set", "hidden_sizes=8"]
TRAIN += ["--set", "rollout_steps=16", "--no-replay", "--devices", "1"]
JOIN = """
from jaxrod.installation.processes import join_processes
join_processes()
import jax
print(jax.process_index(), jax.process_count(), jax.distributed.is_initialized())
jax.distributed.shutdown()
"""
SRUN = """#!{python}
import os, subprocess, sys
words = [word for word in sys.argv[1:] if not word.startswith("--kill-on-bad-exit")]
tasks = [
    subprocess.Popen(words, env=os.environ | {{
        "SLURM_PROCID": str(k), "SLURM_LOCALID": str(k), "SLURM_NTASKS": "2",
        "SLURM_STEP_NODELIST": "localhost", "SLURM_STEP_NUM_NODES": "1",
    }})
    for k in range(2)
]
sys.exit(max(task.wait() for task in tasks))
"""


def free_job():
    """A number of a job for which JAX chooses a port that is free."""
    for _ in range(100):
        number = random.randrange(1, 2**12)
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", 2**16 - 2**12 + number)):
                return number
    pytest.skip("no free port")


def slurm(job, k):
    return {
        "SLURM_JOB_ID": str(job),
        "SLURM_STEP_NODELIST": "localhost,node[002-003]",
        "SLURM_NTASKS": "2",
        "SLURM_PROCID": str(k),
        "SLURM_LOCALID": str(k),
    }


def open_mpi(job, k):
    return {
        "OMPI_MCA_orte_hnp_uri": f"{job * 2**12}.0;tcp://127.0.0.1,10.0.0.1:34911",
        "OMPI_COMM_WORLD_SIZE": "2",
        "OMPI_COMM_WORLD_RANK": str(k),
        "OMPI_COMM_WORLD_LOCAL_RANK": str(k),
    }


def both(commands, environments):
    """What two processes print that run at the same time."""
    processes = [
        subprocess.Popen(
            command,
            env=os.environ | environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for command, environment in zip(commands, environments, strict=True)
    ]
    ends = [process.communicate(timeout=300) for process in processes]
    assert [process.returncode for process in processes] == [0, 0], ends
    return ends


@pytest.mark.slow
@pytest.mark.parametrize("of", [slurm, open_mpi])
def test_processes_find_each_other_by_what_a_launcher_says(of):
    job = free_job()
    ends = both([[sys.executable, "-c", JOIN]] * 2, [of(job, k) for k in (0, 1)])
    assert [out.split() for out, _ in ends] == [
        ["0", "2", "True"],
        ["1", "2", "True"],
    ]


@pytest.mark.slow
def test_the_slurm_file_trains_and_goes_on(tmp_path):
    programs = tmp_path / "bin"
    programs.mkdir()
    (programs / "srun").write_text(SRUN.format(python=sys.executable))
    (programs / "srun").chmod(stat.S_IRWXU)
    run = tmp_path / "run"
    path = os.pathsep.join(
        [str(programs), str(Path(sys.executable).parent), os.environ["PATH"]]
    )
    for _ in range(2):  # The second finds a run and resumes it.
        environment = {"PATH": path, "RUN": str(run), "SLURM_JOB_ID": str(free_job())}
        batch = subprocess.run(
            ["bash", str(CLUSTER / "train.slurm"), *TRAIN],
            env=os.environ | environment,
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert batch.returncode == 0, batch.stderr
        summary = json.loads((run / "summary.json").read_text())
        assert summary["status"] == "finished"
        assert summary["device"].startswith("2 x")


def manifest():
    """The service, the job and the container of the manifest."""
    yaml = pytest.importorskip("yaml")
    content = (CLUSTER / "train.kubernetes.yaml").read_text()
    service, job = yaml.safe_load_all(content)
    (container,) = job["spec"]["template"]["spec"]["containers"]
    return service, job, container


def test_pods_of_the_manifest_find_the_first():
    service, job, container = manifest()
    assert (service["kind"], job["kind"]) == ("Service", "Job")
    assert service["spec"]["clusterIP"] == "None"
    assert service["spec"]["selector"] == {"job-name": job["metadata"]["name"]}
    spec, pod = job["spec"], job["spec"]["template"]["spec"]
    assert spec["completionMode"] == "Indexed"
    assert spec["completions"] == spec["parallelism"]
    assert pod["subdomain"] == service["metadata"]["name"]
    (script,) = container["args"]
    words = script.split()
    first = f"{job['metadata']['name']}-0.{pod['subdomain']}"
    assert words[words.index("--coordinator") + 1].rpartition(":")[0] == first
    assert int(words[words.index("--processes") + 1]) == spec["completions"]
    mounts = {mount["mountPath"] for mount in container["volumeMounts"]}
    (folder,) = (one["value"] for one in container["env"] if one["name"] == "RUN")
    assert str(Path(folder).parent) in mounts


@pytest.mark.slow
def test_the_command_of_the_manifest_trains(tmp_path):
    _, _, container = manifest()
    (script,) = container["args"]
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    for old, new in (
        ("jaxrod-0.jaxrod:8476", address),
        ("tracking --num-envs 2048 --steps 100M", " ".join(TRAIN)),
    ):
        assert old in script
        script = script.replace(old, new)
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    inside = {
        "PATH": path,
        "RUN": str(tmp_path / "run"),
        "KUBERNETES_SERVICE_HOST": "10.96.0.1",
    }
    ends = both(
        [[*container["command"], script]] * 2,
        [inside | {"JOB_COMPLETION_INDEX": str(k)} for k in (0, 1)],
    )
    # What the command says is enough: nobody is asked.
    assert not any("kubernetes" in err.lower() for _, err in ends)
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["device"].startswith("2 x")


def test_ray_reads_the_file_of_a_cluster():
    pytest.importorskip("ray")
    yaml = pytest.importorskip("yaml")
    from ray.autoscaler._private.util import prepare_config, validate_config

    config = yaml.safe_load((CLUSTER / "sweep.ray.yaml").read_text())
    validate_config(prepare_config(config))


ALONE = """
import os, sys
from jaxrod import cli
assert cli.main(["train", *sys.argv[1:]]) == 0
import jax
assert not jax.distributed.is_initialized()
import faulthandler
assert not faulthandler.is_enabled()
for name in ("ray", "mpi4py", "kubernetes"):
    assert name not in sys.modules, name
"""


@pytest.mark.slow
def test_a_run_in_one_process_has_nothing_to_do_with_clusters(tmp_path):
    said = {**slurm(1, 0), **open_mpi(1, 0)}  # As if within a job, yet not asked for.
    subprocess.run(
        [sys.executable, "-c", ALONE, *TRAIN, "--out", str(tmp_path / "run")],
        env=os.environ | said,
        check=True,
        timeout=300,
        stdout=subprocess.DEVNULL,
    )


class Device:
    def __init__(self, process, number):
        self.process_index, self.number = process, number

    def __repr__(self):
        return f"{self.process_index}.{self.number}"


def test_as_many_devices_of_each_process_as_asked_for():
    devices = [Device(process, number) for process in (0, 1) for number in range(4)]
    assert first_of_each(devices, None) == devices
    assert repr(first_of_each(devices, 2)) == "[0.0, 0.1, 1.0, 1.1]"
    with pytest.raises(ValueError, match="1 to 3"):
        first_of_each(devices[:-1], 4)


@pytest.mark.parametrize("within", [0, -3, 1.5, float("nan"), True, 10**14])
def test_a_time_to_join_in_that_makes_no_sense_is_refused(within):
    said = f"within must be a whole number of 1 to 604800 s, got {within} s"
    with pytest.raises(ValueError, match=said):
        join_processes("127.0.0.1:1", 1, 0, within=within)
    assert not jax.distributed.is_initialized()

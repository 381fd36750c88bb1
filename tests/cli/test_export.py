"""`jaxrod export`: files for a controller, and what is in the way of them."""

import hashlib
import json

import numpy as np
import pytest

from exported import compiled
from jaxrod.envs import make
from jaxrod.training import restore_policy

pytestmark = pytest.mark.default_precision


def test_a_run_becomes_a_header_and_a_model(trained, run, run_json, tmp_path):
    import onnxruntime

    header, model = tmp_path / "new" / "arm.h", tmp_path / "arm.onnx"
    code, out, err = run("export", trained[0], "--c", header, "--onnx", model)
    assert (code, err) == (0, "")
    assert out.split() == [
        f"{file}{end}" for file in (header, model) for end in ("", ".json")
    ]
    policy = restore_policy(trained[0], make("trivial"))
    seen = np.random.default_rng(0).normal(size=(10_000, 1)).astype(np.float32)
    wanted = np.clip(policy(seen), -1, 1)
    session = onnxruntime.InferenceSession(str(model))
    by_onnx = lambda one: session.run(None, {"observation": one})[0]
    for act in (compiled(header), by_onnx):
        found = np.stack([act(one) for one in seen])
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-6)
    for file in (header, model):
        told = json.loads(file.with_name(f"{file.name}.json").read_text())
        assert told["sha256"] == hashlib.sha256(file.read_bytes()).hexdigest()
        assert told["about"]["algorithm"] == "ppo" and told["about"]["seed"] == 3
        assert told["observation"]["entries"][0]["name"] == "position"
    words = ("export", trained[0], "--c", header)
    code, _, err = run(*words)
    assert code == 2 and "exported before: replace it with --overwrite" in err
    (again,) = run_json(*words, "--overwrite", "--json")
    assert again == json.loads((header.parent / "arm.h.json").read_text())


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ([], "nothing to write: give --c FILE, --onnx FILE or both"),
        (
            ["--c", "a.h", "--onnx", "a.h"],
            "--onnx must be different files, got a.h twice",
        ),
    ],
)
def test_impossible_requests_are_refused(words, sentence, trained, run):
    code, _, err = run("export", trained[0], *words)
    assert code == 2
    assert sentence in err


def test_what_is_no_run_is_refused(run, tmp_path):
    code, _, err = run("export", tmp_path, "--c", tmp_path / "policy.h")
    assert code == 2
    assert "holds no run (no config.json)" in err and err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_somebody_elses_file_stays(trained, run, tmp_path):
    file = tmp_path / "policy.h"
    file.write_text("mine")
    code, _, err = run("export", trained[0], "--c", file, "--overwrite")
    assert code == 2
    assert "does not replace it" in err and err.count("\n") == 1
    assert file.read_text() == "mine" and list(tmp_path.iterdir()) == [file]

"""`jaxrod identify`: what it writes, what it refuses, that it explains itself."""

import json
import re
import shlex
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxrod import cli, twin
from jaxrod.cli import identify
from twin.made_up import drawing, filmed, pose

PAGE = Path(__file__).parents[2] / "docs" / "twin.md"
ARM = re.search(r'file.write\("""\n(.*?)"""\)', PAGE.read_text(), re.S)[1]


@pytest.fixture
def arm_file(tmp_path):
    """The drawing of the page."""
    path = tmp_path / "arm.toml"
    path.write_text(ARM)
    return path


def written(path, recording, arm):
    """A recording as a CSV file, without the names of its markers."""
    columns = [f"{k}_{axis}" for k in range(len(arm.markers)) for axis in "xyz"]
    rows = [",".join(["time", *arm.inputs, *columns])]
    for time, inputs, points in zip(
        recording.times, recording.inputs, recording.points, strict=True
    ):
        numbers = [time, *inputs, *np.ravel(points)]
        rows.append(",".join("" if np.isnan(x) else repr(float(x)) for x in numbers))
    path.write_text("\n".join(rows) + "\n")
    return path


@pytest.mark.slow
def test_the_folder_holds_the_twin_and_its_report(run, tmp_path, arm_file):

    with jax.enable_x64(True):
        arm = twin.read_arm(arm_file)
        truth = arm.start | {"youngs_modulus": jax.numpy.asarray(3e5)}
        frames = np.full((2, 1), 1.5)
        films = [
            filmed(arm, truth, twin.Recording("x", np.arange(2.0), k * frames,
                                              np.zeros((2, 2, 3))))
            for k in (0.0, 1.0, 2.0)
        ]  # fmt: skip
    logs = [written(tmp_path / f"{k}.csv", film, arm) for k, film in enumerate(films)]
    words = ["identify", *logs[:2], "--arm", arm_file, "--forecast", logs[2]]
    code, out, err = run(*words, "--noise", "1e-4", "--out", tmp_path / "twin")
    assert code == 0, err
    content = json.loads((tmp_path / "twin" / "twin.json").read_text())
    assert content["values"]["youngs_modulus"] == pytest.approx(3e5, rel=1e-3)
    assert content["converged"] is True
    assert content["forecasts"]["root mean square [mm]"] < 0.1
    (forecast,) = content["forecasts"]["errors [mm]"]
    assert forecast["recording"] == "2" and len(forecast["errors"]) == 2
    assert content["recordings"]["markers"] == ["middle", "tip"]
    assert content["frame"]["rotation"] == np.eye(3).tolist()
    assert content["frame"]["shifts [m]"] == [[0.0] * 3] * 2
    assert content["frame"]["orders"] == [[0, 1]] * 2
    assert any("second best order" in remark for remark in content["remarks"])
    assert "youngs_modulus" in out and out.splitlines()[-1].endswith("report.html")
    page = (tmp_path / "twin" / "report.html").read_text()
    assert page.count("<svg") == 6 and "Young's modulus" in page.replace("&#x27;", "'")
    code, _, err = run(*words, "--out", tmp_path / "twin")
    assert code == 2 and "--overwrite" in err
    # A forecast that cannot be made leaves the fit, with its errors.
    films[2].points[:] *= 1000
    written(logs[2], films[2], arm)
    code, _, err = run(*words, "--noise", "1e-4", "--out", tmp_path / "fit")
    assert code == 2 and "2: markers are" in err
    content = json.loads((tmp_path / "fit" / "twin.json").read_text())
    assert content["converged"] is True and content["forecasts"] == {}
    assert (tmp_path / "fit" / "report.html").exists()


def test_files_that_do_not_fit_are_refused_by_name(run, tmp_path, arm_file):
    def refusal(text, drawn=None):
        log = tmp_path / "log.csv"
        log.write_text(text)
        if drawn is not None:
            arm_file.write_text(drawn)
        code, _, err = run("identify", log, "--arm", arm_file, "--out", tmp_path / "o")
        assert code == 2 and err.count("\n") == 1
        assert not (tmp_path / "o").exists()
        return err

    assert "log.csv: it has no column 'pull'" in refusal("time,a_x,a_y,a_z\n0,1,2,3\n")
    few = "time,pull,a_x,a_y,a_z\n0,1,1,2,3\n"
    assert "it has the markers a, and the arm has middle, tip" in refusal(few)
    both = "time,pull,a_x,a_y,a_z,b_x,b_y,b_z\n"
    assert "an input is not finite" in refusal(both + "0,,1,2,3,1,2,3\n")
    assert "times must increase" in refusal(both + "0,1,1,2,3,1,2,3\n0,1,1,2,3,1,2,3\n")
    assert "row 1 has 2 values for 8 columns" in refusal(both + "0,1\n")
    word = refusal(both + "0,1,1,2,3,1,far,3\n")
    assert "row 1 has 'far' in the column 'b_y', which is not a number" in word
    some = refusal(both.replace("b_", "tip_") + "0,1,1,2,3,1,2,3\n")
    assert "it has columns of the markers tip, and none of middle" in some
    good = both + "0,1,1,2,3,1,2,3\n"
    wrong = ARM.replace("length = 0.3", "length = -0.3")
    assert "arm.toml is damaged: length must be positive" in refusal(good, wrong)
    wrong = ARM.replace("[unknown]", "[unknown]\nstiffness = 1.0")
    assert "unknown 'stiffness' is not one of" in refusal(good, wrong)
    wrong = ARM.replace("elements = 6\n", "")
    assert "rod has no 'elements'" in refusal(good, wrong)
    wrong = ARM.replace("elements = 6", "elements = 6\ncolour = 3")
    assert "rod has 'colour', which is not one of" in refusal(good, wrong)
    wrong = ARM.replace("[[markers]]", "[markers]", 1)
    assert "arm.toml is damaged" in refusal(good, wrong)
    one = re.sub(r"\[\[markers\]\].*?(?=\[\[markers)", "", ARM, flags=re.S)
    one = one.replace("[[markers]]", "[markers]")
    assert "markers must be a list of tables: write [[markers]]" in refusal(good, one)
    assert "arm.toml is damaged" in refusal(good, "[rod")


def test_a_recording_is_read_in_the_order_of_the_arm(tmp_path, arm_file):
    arm = twin.read_arm(arm_file)
    log = tmp_path / "log.csv"
    log.write_text(
        "tip_x,tip_y,tip_z,pull,more,time,middle_z,middle_y,middle_x\n"
        "1,2,3,0.5,words,7,6,5,4\n1,,3,0.5,,8,6,nan,4\n"
    )
    found = twin.read_recording(log, arm)
    assert found.labelled and list(found.times) == [7, 8]
    assert np.array_equal(found.points[0], [[4, 5, 6], [1, 2, 3]])
    assert np.isnan(found.points[1]).sum() == 2
    assert np.array_equal(found.inputs, [[0.5], [0.5]])
    log.write_text("\ufeff" + log.read_text() + "\r\n\n")  # As spreadsheets do.
    again = twin.read_recording(log, arm)
    assert np.array_equal(again.points, found.points, equal_nan=True)


def test_an_arm_that_rests_is_told_from_one_that_moves():
    arm, frames = drawing(), np.zeros((30, 4, 3))
    still = pose(1.0, 0.0, frames=30)
    assert still.is_at_rest(arm.length) and len(still.averaged().times) == 1

    def moving(along, frames=frames):
        frames = frames.copy()
        frames[:, 2, 0] = along
        return twin.Recording("moved", still.times, still.inputs, frames)

    rng = np.random.default_rng(0)
    for _ in range(50):
        noise = 2e-3 * rng.standard_normal(30)
        assert moving(noise).is_at_rest(arm.length)
    jumps = noise + 0.1 * (np.arange(30) % 10 == 5)
    assert moving(jumps).is_at_rest(arm.length)
    for along in (np.linspace(0, 0.02, 30), np.linspace(0, 0.02, 30) + noise):
        assert not moving(along).is_at_rest(arm.length)
    # An arm that swings faster than the frames.
    assert not moving(0.02 * (-1.0) ** np.arange(30)).is_at_rest(arm.length)
    # A motor that holds an arm may tremble.
    pulls = np.linspace(0, 1, 60).reshape(30, 2)
    pulled = twin.Recording("pulled", still.times, pulls, np.zeros((30, 4, 3)))
    assert pulled.is_at_rest(arm.length)
    assert np.allclose(pulled.averaged().inputs, np.median(pulls, axis=0))


def test_help_explains_and_its_examples_parse(run):
    code, out, err = run("identify", "--help")
    assert (code, err) == (0, "") and "examples:" in out
    for line in identify.EXAMPLES.splitlines()[1:]:
        words = line.partition("jaxrod ")[2].partition("   ")[0]
        parsed = shlex.split(words)
        cli._parser(parsed)[0].parse_args(parsed)

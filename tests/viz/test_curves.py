"""Learning curves: the runs, their mean, and a score to compare with."""

from __future__ import annotations

import itertools
import os

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread

from jaxrod.viz import ReferenceScore, curves, learning_curve

REFERENCE = ReferenceScore("paper, PPO", 10652.0, 665.0, 10.9)


def write_progress(path, seed=0):
    rng = np.random.default_rng(seed)
    lines = ["update,env_steps,wall_s,episode_return_mean,loss"]
    for k in range(1, 40):
        value = "" if k < 3 else f"{12000 * np.tanh(k / 15) - 3000 + rng.normal() * 99}"
        lines.append(f"{k},{k * 256000},{5 + k * 4.2},{value},0.1")
    path.write_text("\n".join(lines) + "\n")
    return path


def text_of(png):
    """The description the picture carries, which repeats its legend."""
    return png.read_bytes().decode("latin-1")


def test_the_curve_holds_the_score_to_compare_with_its_spread_and_hours(tmp_path):
    out = tmp_path / "learning_curve.png"
    progress = write_progress(tmp_path / "progress.csv")
    learning_curve(progress, out, reference=REFERENCE, title="Tracking")
    assert "paper, PPO: 10,652 ± 665 after 10.9 h" in text_of(out)
    assert "after 2.8 min" in text_of(out)
    picture = imread(out)[..., :3]
    blue = (picture[..., 2] - picture[..., 0]) > 0.3
    assert blue.any(axis=0).mean() > 0.5
    brown = (picture[..., 0] - picture[..., 2]) > 0.4
    assert brown.any(axis=0).mean() > 0.5


def test_several_runs_share_one_picture(tmp_path):
    runs = [write_progress(tmp_path / f"{k}.csv", k) for k in range(3)]
    learning_curve(runs, tmp_path / "out.png")
    assert "mean of 3 runs" in text_of(tmp_path / "out.png")


def test_a_resumed_run_counts_its_last_row_for_a_step(tmp_path):
    progress = tmp_path / "progress.csv"
    rows = ["env_steps,wall_s,episode_return_mean", "10,1,5", "20,2,7", "20,3,8"]
    progress.write_text("\n".join(rows))
    learning_curve(progress, tmp_path / "out.png")
    assert "run: 8 after 3 s" in text_of(tmp_path / "out.png")


def test_before_any_episode_has_ended_the_rewards_are_drawn(tmp_path):
    progress = tmp_path / "progress.csv"
    rows = ["env_steps,wall_s,episode_return_mean,reward_mean", "10,1,,-1.04", "20,2,,"]
    progress.write_text("\n".join([*rows, "30,3,,-0.512"]))
    learning_curve(progress, tmp_path / "out.png", reference=REFERENCE)
    assert "run: -0.512 after 3 s" in text_of(tmp_path / "out.png")
    assert "paper" not in text_of(tmp_path / "out.png")
    ended = tmp_path / "ended.csv"
    ended.write_text("\n".join([*rows, "30,3,5,-0.512"]))
    learning_curve(ended, tmp_path / "out.png")
    assert "run: 5 after 3 s" in text_of(tmp_path / "out.png")
    with pytest.raises(ValueError, match="finished episodes and runs without"):
        learning_curve([progress, ended], tmp_path / "out.png")


def test_a_file_without_returns_is_refused_by_name(tmp_path):
    progress = tmp_path / "progress.csv"
    progress.write_text("env_steps,wall_s,episode_return_mean\n1,1,\n")
    with pytest.raises(ValueError, match=r"progress\.csv must hold an episode_return"):
        learning_curve(progress, tmp_path / "out.png")
    progress.write_text("env_steps,loss\n1,1\n")
    with pytest.raises(ValueError, match=r"lacks \['wall_s', 'episode_return_mean'\]"):
        learning_curve(progress, tmp_path / "out.png")


def test_a_failed_drawing_leaves_the_old_picture(tmp_path, monkeypatch):
    out = tmp_path / "out.png"
    out.write_bytes(b"old")
    progress = write_progress(tmp_path / "progress.csv")

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        learning_curve(progress, out)
    assert out.read_bytes() == b"old"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out.png", "progress.csv"]


def test_the_upper_axis_is_the_mean_clock_of_the_runs_from_zero():
    """One run stops early: its pace is kept up to the last step of the other."""
    axes = Figure().add_subplot()
    steps, wall = np.array([5.0, 10.0]), np.array([100.0, 200.0])
    runs = [
        curves.Curve(steps, wall, steps, "run"),
        curves.Curve(steps / 2, wall, steps, "run"),
    ]
    axes.set_xlim(0, 10)
    curves._clock(axes, runs, 10.0)
    (top,) = axes.child_axes
    # 20 and 40 s a step: 30 s, half a minute.
    shown = {
        text.get_text(): place
        for text, place in zip(top.get_xticklabels(), top.get_xticks(), strict=True)
    }
    # The whole clock: five minutes, from zero.
    assert "0" in shown and 4 < max(map(float, shown)) <= 5 and len(shown) >= 5
    for minutes, place in shown.items():
        np.testing.assert_allclose(place, 2 * float(minutes), rtol=1e-6, atol=1e-9)
    assert "wall-clock time, mean of the runs [min]" in top.get_xlabel()


SHORT = {
    "compiling takes most of the time": [
        (16384 * k, 19 + 0.14 * k, 19.8 - 0.6 / k) for k in range(1, 14)
    ],
    "three rows": [(2048, 20.0, 15.2), (4096, 20.3, 17.9), (6144, 20.55, 19.0)],
    "one row": [(2048, 20.5, 15.2)],
    "half a minute": [(16384 * k, 15 + 0.3 * k, -1.1 - 7.5 / k) for k in range(1, 62)],
    "a long run": [(256e3 * k, 4.2 * k, 9e3 - 12e3 / k) for k in range(1, 40)],
    "the same return": [(10.0 * k, 1.0 * k, -3.0) for k in range(1, 5)],
}


def drawn(rows):
    """The figure of one run, and its axes."""
    steps, wall, returns = np.array(rows).T
    figure = curves._figure([curves.Curve(steps, wall, returns)], None, "", "run")
    figure.draw_without_rendering()
    return figure, figure.axes[0]


@pytest.mark.parametrize("name", SHORT)
def test_labels_of_the_clock_do_not_overlap(name):
    _, axes = drawn(SHORT[name])
    (top,) = axes.child_axes
    labels = [label for label in top.get_xticklabels() if label.get_text()]
    boxes = sorted(
        (label.get_window_extent().x0, label.get_window_extent().x1) for label in labels
    )
    assert len(boxes) >= 3
    assert all(before[1] < after[0] - 3 for before, after in itertools.pairwise(boxes))
    if name != "one row":
        first = SHORT[name][0][1] / (60 if SHORT[name][-1][1] > 60 else 1)
        assert sum(float(label.get_text()) >= first for label in labels) >= 3


@pytest.mark.parametrize("name", SHORT)
def test_labels_of_the_returns_are_their_values(name):
    _, axes = drawn(SHORT[name])
    labels = [label.get_text() for label in axes.get_yticklabels()]
    values = [float(text.replace(",", "").replace("−", "-")) for text in labels]
    np.testing.assert_allclose(values, axes.get_yticks(), rtol=1e-9, atol=1e-9)
    assert len(set(labels)) == len(labels)


def test_a_run_of_one_row_is_a_point():
    _, axes = drawn(SHORT["one row"])
    (line,) = axes.lines
    assert line.get_marker() == "o" and not line.get_clip_on()
    (line,) = drawn(SHORT["three rows"])[1].lines
    assert line.get_marker() == "None"


def test_small_returns_have_three_digits(tmp_path):
    progress = tmp_path / "progress.csv"
    progress.write_text("env_steps,wall_s,episode_return_mean\n10,1,-8.6\n20,2,-1.123")
    learning_curve(progress, tmp_path / "out.png")
    assert "run: -1.12 after 2 s" in text_of(tmp_path / "out.png")

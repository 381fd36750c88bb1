"""A motion is shown in one call, with everything that its scene has."""

import sys
import types

import jax
import pytest

import jaxrod
from jaxrod import viz


@pytest.fixture(scope="module")
def swing():
    rod, start = jaxrod.straight_rod(
        4, length=0.4, radius=0.02, density=1e3, youngs_modulus=1e6
    )
    ball = jaxrod.contact(jaxrod.shapes.sphere((0.0, -0.5, 0.2), 0.1), stiffness=1e3)
    fall = jaxrod.gravity((0, -9.81, 0))
    scene = jaxrod.make_scene(rod, jaxrod.clamp(start), fall, ball)
    return scene, jaxrod.rollout(scene, start, 1e-4, 100, 20)


def test_a_single_state_is_refused(swing):
    scene, states = swing
    with pytest.raises(ValueError, match=r"leading axis .* shape \(3, 5\): a single"):
        viz.show(scene, jax.tree.map(lambda leaf: leaf[-1], states), 2e-3)


@pytest.mark.slow
def test_a_script_gets_a_page(swing, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    replay = viz.show(*swing, 2e-3, title="Swing")
    assert capsys.readouterr().out == "replay.html\n"
    assert "Swing" in (tmp_path / "replay.html").read_text()
    assert replay.num_frames == 6
    assert replay.times.tolist() == pytest.approx([0, 2e-3, 4e-3, 6e-3, 8e-3, 1e-2])
    # The ball that the rod may touch is there without being asked for.
    assert len(replay.meshes) == 1


def test_a_notebook_gets_the_replay_alone(swing, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shell = types.SimpleNamespace(kernel=object())
    module = types.SimpleNamespace(get_ipython=lambda: shell)
    monkeypatch.setitem(sys.modules, "IPython", module)
    times = jaxrod.rollout_times(1e-4, 100, 20)
    replay = viz.show(*swing, times)
    assert "<iframe" in replay._repr_html_()
    assert not list(tmp_path.iterdir())
    viz.show(*swing, times, tmp_path / "asked.html")
    assert (tmp_path / "asked.html").exists()
    assert "asked.html" in capsys.readouterr().out


def test_a_system_is_shown_too(swing, tmp_path):
    scene, states = swing
    system = jaxrod.make_system({"arm": scene})
    replay = viz.show(system, {"arm": states}, 2e-3, tmp_path / "two.html")
    assert [rods.name for rods in replay.rods] == ["arm"]


def test_times_that_do_not_fit_are_refused(swing):
    with pytest.raises(ValueError, match="times"):
        viz.show(*swing, 0.0)

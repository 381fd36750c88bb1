"""The Tab key completes what a command understands."""

import subprocess

import pytest

COMPLETE = """
source "$1"; shift
COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMPREPLY=()
function=$(complete -p jaxrod); function=${function##*-F }; ${function%% *} jaxrod
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.fixture(scope="module")
def script(tmp_path_factory):
    from jaxrod.cli import main

    file = tmp_path_factory.mktemp("completion") / "jaxrod.sh"
    assert main(["completion", "bash", "--out", str(file)]) == 0
    return file


@pytest.mark.parametrize(
    ("typed", "found"),
    [
        ("tra", ["train", "tradeoff"]),
        ("train tra", ["tracking"]),
        ("train --alg", ["--algorithm"]),
        ("train tracking --algorithm s", ["sac", "shac"]),
        ("evaluate --epi", ["--episodes"]),
        ("completion z", ["zsh"]),
        ("sweep trac", ["tracking"]),
    ],
)
def test_words_are_completed(script, typed, found):
    words = ["jaxrod", *typed.split()]
    done = subprocess.run(
        ["bash", "-c", COMPLETE, "bash", script, *words],
        capture_output=True,
        text=True,
        check=True,
    )
    assert sorted(done.stdout.split()) == sorted(found)


def test_files_are_completed(script, tmp_path):
    (tmp_path / "arm.toml").touch()
    words = [script, "jaxrod", "identify", "--arm", "ar"]
    done = subprocess.run(
        ["bash", "-c", COMPLETE, "bash", *words],
        capture_output=True,
        text=True,
        check=True,
        cwd=tmp_path,
    )
    assert done.stdout.split() == ["arm.toml"]


def test_a_file_that_is_there_is_kept(script, run):
    before = script.read_text()
    code, _, err = run("completion", "zsh", "--out", str(script))
    assert code == 2 and str(script) in err
    assert script.read_text() == before


def test_the_script_of_zsh_knows_the_tasks(run):
    code, out, err = run("completion", "zsh")
    assert (code, err) == (0, "")
    assert out.startswith("#compdef jaxrod") and " snake structured tracking " in out


def test_another_shell_is_refused(run):
    code, _, err = run("completion", "fish")
    assert code == 2 and "invalid choice: 'fish'" in err

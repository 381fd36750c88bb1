"""The Tab key completes what a command understands."""

import os
import pty
import shutil
import subprocess

import pytest

COMPLETE = """
source "$1"; shift
COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMPREPLY=()
function=$(complete -p jaxrod); function=${function##*-F }; ${function%% *} jaxrod
printf '%s\\n' "${COMPREPLY[@]}"
"""


ZSHRC = """
PS1="ready> "
fpath=($ZDOTDIR $fpath)
autoload -Uz compinit && compinit -u -D
compadd() {
  [[ ${@[1,(i)(-|--)]} == *-(O|A|D)\\ * ]] || {
    local -a found
    builtin compadd -A found "$@"
    print -rl -- $found >> $ZDOTDIR/found
  }
  builtin compadd "$@"
}
"""
"""Writes down whatever zsh offers."""
TYPED = [
    ("tra", ["train", "tradeoff"]),
    ("train tra", ["tracking"]),
    ("train --alg", ["--algorithm"]),
    ("train tracking --algorithm s", ["sac", "shac"]),
    ("evaluate --epi", ["--episodes"]),
    ("completion z", ["zsh"]),
    ("sweep trac", ["tracking"]),
    ("sweep tracking rea", ["reaching"]),
    ("train tracking --coordinator ", []),
]


@pytest.fixture(scope="module")
def script(tmp_path_factory):
    from jaxrod.cli import main

    file = tmp_path_factory.mktemp("completion") / "jaxrod.sh"
    assert main(["completion", "bash", "--out", str(file)]) == 0
    return file


@pytest.mark.parametrize(("typed", "found"), TYPED)
def test_words_are_completed(script, typed, found):
    words = ["jaxrod", *typed.split(" ")]
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


def test_words_are_completed_in_zsh(run, tmp_path):
    if not shutil.which("zsh"):
        pytest.skip("no zsh is installed")
    assert run("completion", "zsh", "--out", tmp_path / "_jaxrod")[0] == 0
    (tmp_path / ".zshrc").write_text(ZSHRC)
    ours, theirs = pty.openpty()
    with subprocess.Popen(
        ["zsh", "-d", "-i"],
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        cwd=tmp_path,
        env={**os.environ, "ZDOTDIR": str(tmp_path), "TERM": "dumb"},
        start_new_session=True,
    ):
        os.close(theirs)
        seen = b""
        while b"ready> " not in seen:
            seen += os.read(ours, 1024)
        for typed, _ in TYPED:
            # A tab, and then nothing of the line is left.
            next_line = "\x15print -r -- ---- >> $ZDOTDIR/found\n"
            os.write(ours, f"jaxrod {typed}\t{next_line}".encode())
        os.write(ours, b"exit\n")
        while True:
            try:
                seen += os.read(ours, 65536)
            except OSError:  # The shell has ended.
                break
    os.close(ours)
    assert b"command not found" not in seen
    blocks = (tmp_path / "found").read_text().split("----\n")
    offered = [sorted(block.split()) for block in blocks[:-1]]
    assert offered == [sorted(found) for _, found in TYPED]


def test_the_script_of_zsh_knows_the_tasks(run):
    code, out, err = run("completion", "zsh")
    assert (code, err) == (0, "")
    assert out.startswith("#compdef jaxrod") and " snake structured tracking " in out


def test_another_shell_is_refused(run):
    code, _, err = run("completion", "fish")
    assert code == 2 and "invalid choice: 'fish'" in err

"""The command line's manners: help that teaches, one sentence per error, exit codes."""

import os
import subprocess
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace

import pytest

from jaxrod import cli
from jaxrod.installation import jax_version


@pytest.fixture
def command(monkeypatch):
    """Replaces `jaxrod train` by a command that runs the given function."""

    def install(run):
        module = SimpleNamespace(
            __doc__="Train.",
            add_arguments=lambda parser: parser.add_argument("--steps", type=int),
            run=run,
        )
        monkeypatch.setitem(sys.modules, "jaxrod.cli.train", module)
        return lambda *args: cli.main(["train", *args])

    return install


def fail_with(error):
    def run(args):
        raise error

    return run


def test_help_lists_every_command_with_its_summary(capsys):
    with pytest.raises(SystemExit) as stopped:
        cli.main(["--help"])
    assert stopped.value.code == 0
    text = capsys.readouterr().out
    for name, summary in cli.COMMANDS.items():
        assert name in text
        assert summary in text


def test_programs_are_those_of_the_checkout_not_of_the_current_folder(tmp_path):
    other = tmp_path / "benchmarks" / "__init__.py"
    other.parent.mkdir()
    other.write_text("raise SystemExit('somebody else')")
    root = Path(cli.__file__).parents[2]
    done = subprocess.run(
        [sys.executable, "-m", "jaxrod", "benchmark", "--help"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "rod-steps per second" in done.stdout


def test_help_of_a_command_explains_it_with_examples(capsys):
    with pytest.raises(SystemExit) as stopped:
        cli.main(["doctor", "--help"])
    assert stopped.value.code == 0
    text = capsys.readouterr().out
    assert "examples:" in text
    assert "jaxrod doctor --json" in text


def test_the_result_of_a_command_is_the_exit_code(command):
    assert command(lambda args: 0)("--steps", "3") == 0
    assert command(lambda args: args.steps)("--steps", "1") == 1


@pytest.mark.parametrize("words", [[], ["fly"], ["doctor", "--fast"]])
def test_unknown_words_exit_with_two(words, capsys):
    with pytest.raises(SystemExit) as stopped:
        cli.main(words)
    assert stopped.value.code == 2
    assert capsys.readouterr().err


@pytest.mark.parametrize(
    ("typed", "sentence"),
    [
        ("trian", "jaxrod: error: there is no command 'trian': did you mean 'train'?"),
        ("evalute", "did you mean 'evaluate'?"),
        ("optimize", "did you mean 'optimise'?"),
        ("fly", "there is no command 'fly': it must be one of train, sweep, evaluate"),
    ],
)
def test_a_misspelt_command_is_answered_with_the_nearest(typed, sentence, capsys):
    with pytest.raises(SystemExit) as stopped:
        cli.main([typed, "tracking", "--steps", "1k"])
    assert stopped.value.code == 2
    assert sentence in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "sentence", "code"),
    [
        (ValueError("dt must be positive, got -1 s"), "dt must be positive", 2),
        (FileNotFoundError(2, "No such file", "runs/x"), "runs/x: No such file", 2),
        (ModuleNotFoundError("x", name="flax.linen"), 'pip install "jaxrod[rl]"', 2),
        (jax_version.UnsoundJaxError("jax 0.10.2 is refused"), "0.10.2", 1),
        (MemoryError("std::bad_alloc"), "fewer environments (--num-envs)", 2),
        (
            RuntimeError("RESOURCE_EXHAUSTED: Out of memory"),
            "out of memory: use smaller",
            2,
        ),
    ],
)
def test_an_error_is_one_sentence_on_stderr(error, sentence, code, command, capsys):
    assert command(fail_with(error))() == code
    streams = capsys.readouterr()
    assert streams.out == ""
    assert streams.err.startswith("jaxrod train: ")
    assert sentence in streams.err
    assert streams.err.count("\n") == 1


def test_a_fault_of_ours_keeps_its_traceback_and_names_the_request(command, capsys):
    assert command(fail_with(KeyError("leaf")))("--steps", "3") == cli.BROKEN
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("Traceback")
    assert lines[-1].startswith("jaxrod train: KeyError: 'leaf' (a fault of jaxrod")
    assert lines[-1].endswith("the command was jaxrod train --steps 3)")


def test_a_warning_is_a_sentence_without_the_line_that_gave_it(command, capsys):
    def run(args):
        with warnings.catch_warnings():
            warnings.simplefilter("always")
            warnings.warn("the target is far\x1b[2J", UserWarning, stacklevel=1)
        return 0

    before = warnings.showwarning
    assert command(run)() == 0
    assert capsys.readouterr().err == (
        "jaxrod train: warning: the target is far\\x1b[2J\n"
    )
    assert warnings.showwarning is before


def test_traceback_is_shown_when_asked_for(command, monkeypatch):
    monkeypatch.setenv("JAXROD_TRACEBACK", "1")
    with pytest.raises(ValueError, match="broken"):
        command(fail_with(ValueError("broken")))()


def test_interruption_exits_with_130(command):
    assert command(fail_with(KeyboardInterrupt()))() == 130


def test_a_reader_that_goes_away_is_not_an_error():
    """As in `jaxrod --help | head -1`."""
    program = (
        "import sys\n"
        "from types import SimpleNamespace\n"
        "from jaxrod import cli\n"
        "def run(args):\n"
        "    for _ in range(100000): print('a line that nobody reads')\n"
        "    return 0\n"
        "sys.modules['jaxrod.cli.train'] = SimpleNamespace(\n"
        "    __doc__='', add_arguments=lambda parser: None, run=run)\n"
        "sys.exit(cli.main(['train']))\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    with process:
        assert process.stdout is not None
        process.stdout.readline()
        process.stdout.close()
        assert process.stderr is not None
        assert process.stderr.read() == ""
    assert process.returncode == 141

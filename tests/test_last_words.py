"""A process that is aborted says why; one that ends in another way says nothing."""

import signal
import subprocess
import sys

import pytest

BEGIN = """
import os, signal
from jaxrod.installation.processes import LastWords
last_words = LastWords()
last_words("the first sentence")
last_words("the last sentence")
"""


def ended(how, *options):
    # A listener that hung would keep the pipe open.
    return subprocess.run(
        [sys.executable, *options, "-c", BEGIN + how],
        stderr=subprocess.PIPE,
        text=True,
        timeout=120,
    )


def test_an_aborted_process_says_its_last_sentence_alone():
    process = ended("os.abort()")
    assert process.returncode == -signal.SIGABRT
    assert process.stderr.strip() == "the last sentence"


@pytest.mark.parametrize(
    "how", ["pass", "os._exit(1)", "os.kill(os.getpid(), signal.SIGKILL)"]
)
def test_nothing_is_said_of_other_ends(how):
    assert ended(how).stderr == ""


def test_another_fault_is_shown_with_the_lines_that_it_met():
    said = ended("os.kill(os.getpid(), signal.SIGSEGV)").stderr
    assert "Segmentation fault" in said
    assert "line" in said
    assert "sentence" not in said


def test_who_has_faulthandler_on_keeps_it():
    said = ended("os.abort()", "-X", "faulthandler").stderr
    assert "Fatal Python error: Aborted" in said
    assert "sentence" not in said

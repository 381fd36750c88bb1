"""The progress bar says where a run is: how often, and how far."""

import io

from jaxrod.training.progress import ProgressBar


def test_a_log_has_a_line_for_every_tenth():
    stream = io.StringIO()
    bar = ProgressBar(200, "steps", stream=stream)
    lines = []
    for done in range(1, 201):
        bar.update(done, "reached")
        if len(stream.getvalue().splitlines()) > len(lines):
            lines = stream.getvalue().splitlines()
            assert done % 20 == 0
    assert len(lines) == 10

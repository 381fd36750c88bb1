"""Exported headers, compiled strictly and called from Python."""

import ctypes
import re
import shutil
import subprocess

import numpy as np
import pytest

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
SOURCE = """\
#include "{name}.h"
void act({memory}const float *o, float *a) {{ {prefix}_act({given}o, a); }}
{start}
"""


def compiled(header, *flags):
    """A function of an observation, and one that begins an episode if there is one."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler is installed")
    text = header.read_text()
    prefix = re.search(r"void (\w+)_act\(", text)[1]
    remembers = f"{prefix}_memory" in text
    source, library = header.with_suffix(".c"), header.with_suffix(".so")
    source.write_text(
        SOURCE.format(
            name=header.stem,
            prefix=prefix,
            memory=f"{prefix}_memory *m, " if remembers else "",
            given="m, " if remembers else "",
            start=f"void start({prefix}_memory *m, const float *o) "
            f"{{ {prefix}_start(m, o); }}"
            if remembers
            else "",
        )
    )
    words = [compiler, *STRICT, *(flags or ("-O2",)), "-shared", "-fPIC"]
    done = subprocess.run(
        [*words, "-o", library, source, "-lm"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-3000:]
    found = ctypes.CDLL(str(library))
    size = int(re.search(r"_ACTION_SIZE (\d+)", text)[1])
    memory = ctypes.create_string_buffer(1 << 16)
    first = (memory,) if remembers else ()

    def act(observation):
        seen = np.ascontiguousarray(observation, np.float32)
        action = np.full(size, np.nan, np.float32)
        found.act(*first, _pointer(seen), _pointer(action))
        return action

    def start(observation):
        found.start(memory, _pointer(np.ascontiguousarray(observation, np.float32)))

    act.start, act.library = start, found
    return act


def _pointer(array):
    return array.ctypes.data_as(ctypes.c_void_p)

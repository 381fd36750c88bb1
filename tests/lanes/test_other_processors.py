"""Kernels for other processors: older ones of this kind run here; of others, compiled.

A newer x86-64 processor runs code for older ones. So LLVM writes kernels for them, with
their vectors and without the instructions that they lack, and they run natively.
"""

import platform

import jax
import llvmlite.binding as llvm
import numpy as np
import pytest

import jaxrod
from jaxrod.lanes import kernels
from jaxrod.lanes.choice import lane_choices, use_lanes
from jaxrod.lanes.llvm import machine_code
from jaxrod.lanes.rows import kernels as row_kernels
from lanes.programs import difference
from lanes.scenes import shaken
from lanes.test_runs import ROUNDING, apart, hanging

OLDER = {
    "x86-64": ((), 16),
    "ivybridge": (("avx",), 32),
    "haswell": (("avx", "avx2", "fma"), 32),
    "skylake-avx512": (("avx", "avx2", "fma", "avx512f"), 64),
}
"""Processors: the vector features among their features, and bytes of a vector."""
OTHERS = {
    "aarch64-unknown-linux-gnu": ("generic", "neoverse-n1"),
    "x86_64-unknown-linux-gnu": ("x86-64", "znver4"),
}
"""Names of processors by target, for which kernels are compiled but not run."""
WAYS = pytest.mark.parametrize("way", ["always", "loops", "rows"])
CACHED = (
    *(machine_code.vector_bytes, machine_code.processor),
    *(kernels._run_kernel, kernels._steps_kernel),
    *(row_kernels.cycles_kernel, row_kernels.whole_run_kernel),
)
"""Functions that remember what this processor is, or kernels for it."""


def run_here():
    """Names of older processors whose code this one runs."""
    if platform.machine() not in ("x86_64", "AMD64"):
        return []
    own = llvm.get_host_cpu_features()
    return [name for name, (needs, _) in OLDER.items() if all(map(own.get, needs))]


@pytest.fixture
def as_on(monkeypatch):
    """Makes LLVM take this processor for another; returns texts of kernels made."""
    texts = []
    compile_text = machine_code.native_function

    def noted(text, name, **options):
        texts.append(text)
        return compile_text(text, name, **options)

    def pretend(name, features):
        host = llvm.FeatureMap(dict.fromkeys(features, True))
        monkeypatch.setattr(llvm, "get_host_cpu_name", lambda: name)
        monkeypatch.setattr(llvm, "get_host_cpu_features", lambda: host)
        monkeypatch.setattr(machine_code, "native_function", noted)
        for known in CACHED:
            known.cache_clear()
        return texts

    yield pretend
    monkeypatch.undo()
    for known in CACHED:
        known.cache_clear()


def moved(way):
    """States of a few rods after some steps, run in a way."""
    scene, state, dt = hanging(5)
    use_lanes(way)
    run = jax.jit(jax.vmap(lambda s: jaxrod.advance(scene, s, dt, 20)))
    return run(shaken(state, 5, 0))


@pytest.fixture(scope="module")
def expected():
    """The states by XLA."""
    return moved("never")


@pytest.mark.fast_sets(1)
@WAYS
@pytest.mark.parametrize("name", run_here())
def test_kernels_for_older_processors_give_the_same_numbers(name, way, expected, as_on):
    features, size = OLDER[name]
    texts = as_on(name, features)
    assert machine_code.vector_bytes() == size
    found = moved(way)
    assert lane_choices()[-1].taken
    assert f"of {size} bytes" in lane_choices()[-1].why
    assert any(f"<{size // 8} x double>" in text for text in texts)
    assert apart(found, expected) < ROUNDING


@pytest.mark.slow
@WAYS
def test_kernels_compile_for_other_processors(way, as_on):
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    texts = as_on(llvm.get_host_cpu_name(), ())
    moved(way)
    assert texts
    for triple, names in OTHERS.items():
        for name in names:
            target = llvm.Target.from_triple(triple)
            machine = target.create_target_machine(cpu=name, opt=2)
            for text in texts:
                module = llvm.parse_assembly(text)
                module.triple = triple
                module.data_layout = str(machine.target_data)
                module.verify()
                code = machine.emit_object(module)
                assert code[:4] == b"\x7fELF"
                number = int(np.frombuffer(code[18:20], "<u2")[0])
                assert number == {"a": 183, "x": 62}[triple[0]]


@pytest.mark.slow
@WAYS
@pytest.mark.parametrize("name", run_here())
def test_random_programs_are_the_same_on_older_processors(name, way, as_on):
    as_on(name, OLDER[name][0])
    for seed in range(3000, 3012):
        worst, why = difference(seed, way)
        assert worst is not None and worst <= 1, (seed, worst, why)

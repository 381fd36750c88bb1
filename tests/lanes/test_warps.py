"""Kernels of warps, in threads of the processor and as text for the driver."""

import ctypes
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import jaxrod
from jaxrod.jax_internals import foreign_call
from jaxrod.jax_internals.foreign_call import launcher_text
from jaxrod.lanes import kernels, primitives
from jaxrod.lanes.choice import lane_choices, slower, use_lanes
from jaxrod.lanes.llvm.machine_code import native_function
from jaxrod.lanes.primitives import cycles_p
from jaxrod.lanes.run_spec import LoopBody, RunSpec
from jaxrod.lanes.warps import cuda, warp_code
from jaxrod.lanes.warps.kernels import cycles_by_warps
from lanes import warp_machine
from lanes.scenes import SEEDS, random_scene
from lanes.test_runs import apart, hanging, shaken
from lanes.warp_machine import lowered_to_threads, taken

H100 = cuda.Device(architecture=90, processors=132, shared=232448)
POINTER = ctypes.c_void_p


@pytest.fixture
def threads(monkeypatch):
    """Runs what would be lanes in threads, as one warp."""
    monkeypatch.setattr(primitives, "lowered_by_lanes", lowered_to_threads)
    taken.clear()


def both(program, *given):
    """Results of a program in rows, and in threads if these are in use."""
    found = []
    for lowered in (kernels.lowered_by_lanes, lowered_to_threads):
        primitives.lowered_by_lanes = lowered
        use_lanes("rows")
        compiled = jax.jit(lambda *arguments: program(*arguments))
        found.append(jax.block_until_ready(compiled(*given)))
    return found


def repeated(cycle, *carry, times=2):
    """Results of a cycle in XLA, and in threads."""
    avals = [jax.ShapeDtypeStruct(c.shape[1:], c.dtype) for c in carry]
    spec = RunSpec(LoopBody(jax.make_jaxpr(cycle)(*avals), 0), None)

    def run(*arrays):
        return cycles_p.bind(jnp.int32(times), *arrays, spec=spec)

    found = []
    for mode in ("rows", "never"):
        use_lanes(mode)
        found.append(jax.jit(jax.vmap(lambda *arrays: run(*arrays)))(*carry))
    assert len(taken) == 1
    return found


def close(found, expected):
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_a_rod_longer_than_a_warp_moves_as_in_rows(threads):
    scene, state, dt = hanging(40)
    many = shaken(state, 3, 0)
    rows, warps = both(jax.vmap(lambda s: jaxrod.advance(scene, s, dt, 4)), many)
    assert taken == [("jaxrod_run", 3)]
    assert apart(warps, rows) < 1e-11


def slopes(cycle, gains, numbers):
    """Results of five cycles and their derivatives, in threads and in XLA."""
    avals = [jax.ShapeDtypeStruct(a.shape[1:], a.dtype) for a in (gains, numbers)]
    spec = RunSpec(LoopBody(jax.make_jaxpr(cycle)(*avals), 1), 5)

    def total(gain, x):
        (made,) = cycles_p.bind(jnp.int32(5), gain, x, spec=spec)
        return jnp.sum(made**3)

    found = []
    for mode in ("rows", "never"):
        use_lanes(mode)
        slope = jax.vmap(jax.value_and_grad(total, argnums=(0, 1)))
        made = jax.jit(lambda *given, slope=slope: slope(*given))(gains, numbers)
        found.append(jax.tree.leaves(made))
    assert {name for name, _ in taken} == {"jaxrod_cycles", "jaxrod_cycles_adjoint"}
    return found


@pytest.mark.slow
def test_derivatives_of_a_cycle_are_those_of_xla(threads):
    numbers = jnp.asarray(np.random.default_rng(4).normal(size=(2, 40)))
    cycle = lambda gain, x: [jnp.tanh(gain * x) + jnp.mean(x[::-1]) * x]
    close(*slopes(cycle, jnp.asarray([0.7, 0.4]), numbers))


@pytest.mark.slow
def test_gradients_are_those_of_rows(threads):
    scene, state, dt = hanging(9)

    def height(speed):
        begun = replace(state, velocities=state.velocities + speed)
        return jaxrod.advance(scene, begun, dt, 10).positions[1, -1]

    speeds = jnp.linspace(-0.5, 0.5, 2)
    rows, warps = both(jax.vmap(jax.grad(height)), speeds)
    assert {name for name, _ in taken} == {"jaxrod_cycles", "jaxrod_cycles_adjoint"}
    np.testing.assert_allclose(warps, rows, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_scenes_move_as_in_rows_and_their_gradients_are_the_same(threads, seed):
    scene, state, dt, name = random_scene(seed)
    many = shaken(state, 2, seed)
    rows, warps = both(jax.vmap(lambda s: jaxrod.advance(scene, s, dt, 5)), many)
    assert apart(warps, rows) < 1e-11, name

    def energy(speed):
        begun = replace(state, velocities=state.velocities + speed)
        ended = jaxrod.advance(scene, begun, dt, 5)
        return jnp.sum(ended.positions**2) + jnp.sum(ended.velocities**2)

    rows, warps = both(jax.vmap(jax.grad(energy)), jnp.linspace(-0.1, 0.1, 2))
    np.testing.assert_allclose(warps, rows, rtol=1e-9, atol=1e-12)


def test_sums_over_tables_wait_for_what_they_are_added_to(threads):
    table = np.random.default_rng(0).normal(size=(2, 7, 40))

    def cycle(x):
        along, across = jnp.sum(x, axis=0), jnp.sum(x, axis=1)
        whole = jnp.sum(x * x)
        return [0.1 * x + jnp.tanh(along)[None] + jnp.max(across) + jnp.cos(whole)]

    close(*repeated(cycle, jnp.asarray(table)))


def test_numbers_added_at_equal_places_are_all_counted(threads):
    rng = np.random.default_rng(1)
    numbers = jnp.asarray(rng.normal(size=(2, 100)))
    places = jnp.asarray(rng.integers(0, 9, size=(2, 100)), jnp.int32)

    def cycle(x, where):
        sums = jnp.zeros(9).at[where].add(x)
        return [0.5 * x + sums[where], (where + 1) % 9]

    close(*repeated(cycle, numbers, places))


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("shared", [0, 3_000, 232_448])
def test_warps_of_many_blocks_keep_to_their_own_memory(threads, monkeypatch, shared):
    """In workspace, one warp of a block in shared memory, and two."""
    monkeypatch.setattr(warp_machine, "GPU", [cuda.Device(90, 1, shared)])
    monkeypatch.setattr(cuda, "_RESIDENT", 2)
    numbers = jnp.asarray(np.random.default_rng(5).normal(size=(7, 60)))
    cycle = lambda gain, x: [gain * jnp.sin(x) + jnp.mean(x[::-1]) * x]
    close(*slopes(cycle, jnp.linspace(0.5, 0.9, 7), numbers))


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("n", [20, 31, 32, 33, 64, 65])
def test_memory_is_used_again_only_after_a_wait(threads, n):
    """A row of as many numbers as a warp has threads needs no loop."""
    numbers = jnp.asarray(np.random.default_rng(6).normal(size=(2, n + 1)))

    def cycle(x):
        s = 0.3
        for function in (jnp.tanh, jnp.cos, jnp.sin, jnp.tanh):
            y = function(x * s)
            change = 2 * y[1:] - y[:-1]
            s = jnp.sum(change**3)
        return [0.5 * x + s]

    close(*repeated(cycle, numbers))


def test_what_all_scenes_share_is_right_while_other_warps_begin(threads):
    rng = np.random.default_rng(7)
    shared = jnp.asarray(rng.normal(size=(60, 40)))
    places = jnp.asarray(rng.integers(0, 40, size=200), jnp.int32)
    parts = jnp.asarray(rng.normal(size=200))
    numbers = jnp.asarray(rng.normal(size=(8, 40)))

    def cycle(table, where, part, x):
        added = jnp.zeros(40).at[where].add(part)
        return [0.5 * x + jnp.sum(table, axis=0) + added]

    given = shared, places, parts, numbers[0]
    body = LoopBody(jax.make_jaxpr(cycle)(*given), 3)
    spec = RunSpec(body, None)
    found = []
    for mode in ("rows", "never"):
        use_lanes(mode)
        run = lambda x: cycles_p.bind(jnp.int32(3), shared, places, parts, x, spec=spec)
        found.append(jax.jit(jax.vmap(lambda x, run=run: run(x)))(numbers))
    assert taken == [("jaxrod_cycles", 8)]
    close(*found)


def test_copies_of_small_numbers_begin_anywhere(threads):
    truths = jnp.asarray(np.random.default_rng(8).integers(0, 2, (2, 13)), bool)
    places = jnp.asarray([[3, 5], [0, 7]], jnp.int32)

    def cycle(x, where):
        return [jnp.roll(jnp.tile(x[1:9].at[where].set(True), 2)[:13], 1), where]

    found, expected = repeated(cycle, truths, places)
    assert np.array_equal(found[0], expected[0])
    aval = jax.ShapeDtypeStruct((13,), bool), jax.ShapeDtypeStruct((2,), jnp.int32)
    kernel = cycles_by_warps(
        LoopBody(jax.make_jaxpr(cycle)(*aval), 0), (), checkpoints=False
    )
    lines = kernel.text.splitlines()
    odd = [line.split(" = ")[0] for line in lines if "ptr %now, i64 1" in line]
    copies = [line for line in lines if any(f"ptr {name}, i64" in line for name in odd)]
    assert any("@copy_8(" in line for line in copies)
    assert not any("@copy_32(" in line for line in copies)


def test_a_recurrence_longer_than_a_warp_is_the_same(threads):
    numbers = jnp.asarray(np.random.default_rng(2).normal(size=(2, 70)))

    def cycle(x):
        _, made = lax.scan(lambda c, r: (0.5 * c + r, c - r), x[0], x)
        return [jnp.tanh(made)]

    close(*repeated(cycle, numbers))


def test_a_missing_wait_is_seen(threads, monkeypatch):
    """The machine of the tests sees races; otherwise they would prove nothing."""
    monkeypatch.setattr(warp_code, "WAIT", "; nothing")
    cycles_by_warps.cache_clear()
    numbers = jnp.asarray(np.random.default_rng(3).normal(size=(2, 500)))
    shifted = [jnp.sin, jnp.cos, jnp.tanh, jnp.abs]

    def cycle(x):
        for function in shifted:
            x = function(x) + x[::-1]
        return [0.1 * x]

    found, expected = repeated(cycle, numbers, times=50)
    cycles_by_warps.cache_clear()
    assert not np.allclose(found[0], expected[0], rtol=1e-9)


def a_kernel(rows=40, dtype=jnp.float32):
    """A kernel with a sum, and an elementary function in it."""
    cycle = lambda x: [jnp.sin(x) + jnp.sum(x[::-1])]
    aval = jax.ShapeDtypeStruct((rows,), dtype)
    return cycles_by_warps(
        LoopBody(jax.make_jaxpr(cycle)(aval), 0), (), checkpoints=False
    )


@pytest.mark.parametrize("architecture", [70, 80, 90])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_ptx_is_written_for_every_architecture(monkeypatch, architecture, dtype):
    monkeypatch.setattr(cuda, "_libdevice", lambda: LIBDEVICE)
    for rows, shared in ((40, True), (40_000, False)):
        kernel = a_kernel(rows, dtype)
        launch = cuda.launch_for(kernel, 64, 0, H100)
        assert launch.in_shared == shared
        text = cuda.ptx(kernel, launch, architecture)
        assert ".visible .entry kernel" in text and f"sm_{architecture}" in text
        assert ("st.shared" in text) == shared
        assert "bar.warp.sync" in text and "shfl.sync.bfly" in text
        assert ".maxnreg 128" in text


LIBDEVICE = """
define float @__nv_sinf(float %x) { ret float %x }
define double @__nv_sin(double %x) { ret double %x }
"""


@pytest.fixture(autouse=True)
def text_for_bitcode(monkeypatch):
    """Reads libdevice as text, which the tests write themselves."""
    import llvmlite.binding as llvm

    monkeypatch.setattr(llvm, "parse_bitcode", llvm.parse_assembly)


def test_launches_have_memory_and_warps_for_every_batch():
    kernel = a_kernel()
    for rods in (1, 2, 3, 1000, 10**7):
        launch = cuda.launch_for(kernel, rods, 0, H100)
        assert 0 < launch.blocks <= -(-rods // launch.warps)
        assert launch.shared(kernel) <= H100.shared
        assert launch.workspace(kernel) >= kernel.uniform
    far = a_kernel(40_000)
    launch = cuda.launch_for(far, 10**6, 0, H100)
    warps = launch.blocks * launch.warps
    assert launch.shared(far) == 0 and launch.workspace(far) >= warps * far.room


def test_a_scene_too_large_for_a_warp_is_left_to_xla_in_words():
    short, long, far = a_kernel(), a_kernel(15_000), a_kernel(100_000)
    for rods in (1, 1000):
        launch = cuda.launch_for(short, rods, 0, H100)
        assert cuda.slower_than_xla(short, launch, rods, H100) is None
    launch = cuda.launch_for(long, 1, 0, H100)
    assert "32 threads" in cuda.slower_than_xla(long, launch, 1, H100)
    launch = cuda.launch_for(far, 1, 0, H100)
    assert "do not fit" in cuda.slower_than_xla(far, launch, 1, H100)


@pytest.fixture
def gpu(monkeypatch):
    """Makes the choice of kernels believe that there is a GPU."""
    registered = []
    monkeypatch.setattr(kernels, "no_warps_here", lambda: None)
    monkeypatch.setattr(kernels, "device", lambda: H100)

    def register(kernel, launch):
        registered.append((kernel, launch))
        return "jaxrod_warps_of_a_test"

    monkeypatch.setattr(kernels, "registered_on_gpu", register)
    return registered


def lowered_for_cuda(n, rods):
    scene, state, dt = hanging(n)
    many = shaken(state, rods, 0)
    run = jax.jit(jax.vmap(lambda s: jaxrod.advance(scene, s, dt, 3)))
    return run.trace(many).lower(lowering_platforms=("cuda",)).as_text()


def test_a_batch_on_a_gpu_is_one_call_of_a_kernel(gpu):
    use_lanes("auto")
    text = lowered_for_cuda(6, 1000)
    assert text.count("jaxrod_warps_of_a_test") == 1 and "while" not in text
    last = lane_choices()[-1]
    assert last.taken and last.rods == 1000 and "shared memory" in last.why
    ((kernel, launch),) = gpu
    assert launch.warps * launch.blocks == 1000 and kernel.needs == frozenset()


def test_a_gpu_in_mode_never_runs_xla(gpu):
    use_lanes("never")
    assert "jaxrod_warps" not in lowered_for_cuda(6, 1000)
    assert gpu == []


def test_a_kernel_that_the_driver_refuses_is_left_to_xla(gpu, monkeypatch):
    def refuse(kernel, launch):
        raise RuntimeError("CUDA did not compile a kernel: invalid PTX\nmore")

    monkeypatch.setattr(kernels, "registered_on_gpu", refuse)
    use_lanes("auto")
    assert "while" in lowered_for_cuda(6, 1000)
    last = lane_choices()[-1]
    assert not last.taken and last.why.endswith("invalid PTX")
    use_lanes("always")
    with pytest.raises(RuntimeError, match="invalid PTX"):
        lowered_for_cuda(6, 1001)


def test_without_a_driver_the_reason_is_given(monkeypatch):
    cuda.not_here.cache_clear()
    cuda._driver.cache_clear()
    cuda.device.cache_clear()

    def no_library(name):
        raise OSError(f"{name}: no such file")

    monkeypatch.setattr(ctypes, "CDLL", no_library)
    monkeypatch.setattr(jax, "local_devices", lambda backend: [GPU])
    assert "no GPU for CUDA: libcuda.so.1" in cuda.not_here()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    use_lanes("auto")
    assert "no GPU for CUDA" in slower()
    cuda.not_here.cache_clear()


class GPU:
    """A device of JAX."""

    local_hardware_id = 0


class Frame:
    """A call of a handler as XLA makes it."""

    LAUNCH = ctypes.CFUNCTYPE(
        ctypes.c_int,
        POINTER,
        *[ctypes.c_uint] * 7,
        POINTER,
        ctypes.POINTER(POINTER),
        POINTER,
    )

    def __init__(self, n_operands, n_results, status=0):
        self.launched, self.words = [], []
        self.arrays = [np.zeros(1) for _ in range(n_operands + n_results)]
        buffers = [
            (ctypes.c_uint64 * 6)(48, 0, 0, a.ctypes.data, 0, 0) for a in self.arrays
        ]
        self.kept = [buffers]
        operands = self._pointers(buffers[:n_operands])
        results = self._pointers(buffers[n_operands:])

        def launch(function, gx, gy, gz, bx, by, bz, shared, stream, given, extra):
            count = n_operands + n_results
            data = [
                ctypes.cast(given[i], ctypes.POINTER(POINTER))[0] for i in range(count)
            ]
            self.launched.append(((gx, gy, gz), (bx, by, bz), shared, stream, data))
            return status

        def create(error):
            text = ctypes.cast(error + 16, ctypes.POINTER(ctypes.c_char_p))[0]
            self.words.append(text.decode())
            return 4321

        def stream(asked):
            fields = ctypes.cast(asked, ctypes.POINTER(ctypes.c_uint64))
            assert fields[0] == 32 and fields[2] == 555
            fields[3] = 777
            return 0

        self.launch = self.LAUNCH(launch)
        one = ctypes.CFUNCTYPE(ctypes.c_uint64, ctypes.c_uint64)
        self.create, self.stream = one(create), one(stream)
        table = [0] * 20
        table[6] = ctypes.cast(self.create, POINTER).value
        table[10] = ctypes.cast(self.stream, POINTER).value
        api = (ctypes.c_uint64 * 20)(*table)
        frame = [0] * 16
        frame[2], frame[3], frame[4] = ctypes.addressof(api), 555, 3
        frame[7], frame[9] = n_operands, ctypes.addressof(operands)
        frame[12], frame[14] = n_results, ctypes.addressof(results)
        self.frame = (ctypes.c_uint64 * 16)(*frame)
        self.kept += [operands, results, api]

    def _pointers(self, buffers):
        return (ctypes.c_uint64 * len(buffers))(*map(ctypes.addressof, buffers))

    def call(self, n_operands, n_results):
        text = launcher_text(
            "jaxrod_warps_here",
            n_operands,
            n_results,
            launch=ctypes.cast(self.launch, POINTER).value,
            function=99,
            blocks=7,
            threads=64,
            shared=1000,
        )
        engine, address = native_function(text, "jaxrod_warps_here")
        handler = ctypes.CFUNCTYPE(ctypes.c_uint64, POINTER)(address)
        made = handler(ctypes.addressof(self.frame))
        del engine
        return made


def test_the_handler_launches_on_the_stream_of_the_call_with_all_buffers():
    frame = Frame(3, 2)
    assert frame.call(3, 2) == 0
    data = [a.ctypes.data for a in frame.arrays]
    assert frame.launched == [((7, 1, 1), (64, 1, 1), 1000, 777, data)]


def test_the_handler_refuses_other_buffers_and_reports_a_launch_that_failed():
    frame = Frame(3, 2)
    assert frame.call(4, 2) == 4321 and frame.launched == []
    assert "4 operands" in frame.words[0]
    frame = Frame(3, 2, status=701)
    assert frame.call(3, 2) == 4321
    assert frame.words == ["jaxrod: CUDA did not launch a kernel of 7 blocks"]


@pytest.mark.parametrize(
    ("known", "changed", "words"),
    [
        ("FIELD(XLA_FFI_Handler_Register);", "", "XLA_FFI_Api"),
        ("void* stream;", "void* other;", "XLA_FFI_Stream_Get_Args"),
    ],
)
def test_a_header_with_another_way_to_the_stream_is_refused(
    monkeypatch, known, changed, words
):
    text = foreign_call.header()
    assert text.count(known) == 1
    monkeypatch.setattr(foreign_call, "header", lambda: text.replace(known, changed))
    foreign_call.unknown_stream.cache_clear()
    assert words in foreign_call.unknown_stream()
    foreign_call.unknown_stream.cache_clear()

"""A machine for kernels of warps: threads of the processor, 32 for each warp.

The text is optimised as it is for a GPU, so that what LLVM moves across a wait is seen.
The warps of a block run at the same time.
"""

import ctypes
import threading

import jax
import llvmlite.binding as llvm
import numpy as np

from jaxrod.lanes.choice import NEVER, LaneChoice, lane_mode, note, refused
from jaxrod.lanes.jaxpr.unroll import NotUnrolled
from jaxrod.lanes.llvm.elementary import elementary_texts
from jaxrod.lanes.llvm.machine_code import not_here
from jaxrod.lanes.warps.cuda import WARPS, Device, entry_of, launch_for
from jaxrod.lanes.warps.kernels import kernel_of_warps
from jaxrod.lanes.warps.warp_code import THREADS

_library = ctypes.CDLL(None)
llvm.add_symbol(
    "pthread_barrier_wait",
    ctypes.cast(_library.pthread_barrier_wait, ctypes.c_void_p).value,
)
_BARRIERS = [ctypes.create_string_buffer(64) for _ in range(WARPS)]
_SLOTS = [ctypes.create_string_buffer(8 * THREADS) for _ in range(WARPS)]
"""Barriers, and places for numbers that are exchanged, of each warp of a block."""


def run_in_threads(kernel, results, arrays, counts):
    """Runs a kernel for a whole batch, one warp after the other.

    Args:
        kernel: A kernel of warps.
        results: Shapes and dtypes of its results, with a row for each scene.
        arrays: Its operands after the counts.
        counts: Steps, steps between checkpoints, scenes, checkpoints.
    """
    assert not_here() is None
    steps, every, rods, _ = counts
    launch = launch_for(kernel, rods, min(every, steps + 1), GPU[0])
    words = [np.asarray(counts, np.int32), *[np.ascontiguousarray(a) for a in arrays]]
    made = [np.full(r.shape, _poison(r.dtype), r.dtype) for r in results]
    work = np.full(launch.workspace(kernel) + 64, 0xFF, np.uint8)
    buffers = [b.ctypes.data for b in (*words, *made)] + [_aligned(work)]
    assert len(buffers) == kernel.n_operands + kernel.n_results
    table = (ctypes.c_void_p * len(buffers))(*buffers)
    own = [_compiled(_text(kernel, launch, warp)) for warp in range(launch.warps)]
    for block in range(launch.blocks):
        shared = np.full(launch.shared(kernel) + 128, 0xFF, np.uint8)
        given = block, launch.blocks, _aligned(shared), table
        threads = [
            threading.Thread(target=own[i // THREADS][1], args=(i, *given))
            for i in reversed(range(THREADS * launch.warps))
        ]
        for barrier in _BARRIERS:
            _library.pthread_barrier_init(barrier, None, ctypes.c_uint(THREADS))
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        for barrier in _BARRIERS:
            _library.pthread_barrier_destroy(barrier)
        outside = shared[_aligned(shared) - shared.ctypes.data :]
        assert np.all(outside[launch.shared(kernel) :] == 0xFF)
    assert np.all(work[_aligned(work) - work.ctypes.data :][len(work) - 128 :] == 0xFF)
    return made


def _compiled(text):
    """Returns an engine, and the function that a thread runs."""
    module = llvm.parse_assembly(text)
    module.verify()
    target = llvm.Target.from_default_triple().create_target_machine(opt=2)
    options = llvm.create_pipeline_tuning_options(3)
    builder = llvm.create_pass_builder(target, options)
    builder.getModulePassManager().run(module, builder)
    engine = llvm.create_mcjit_compiler(module, target)
    engine.finalize_object()
    types = [*[ctypes.c_uint32] * 3, ctypes.c_void_p, ctypes.c_void_p]
    address = engine.get_function_address("in_threads")
    return engine, ctypes.CFUNCTYPE(None, *types)(address)


GPU = [Device(architecture=90, processors=132, shared=232448)]
"""The GPU whose launches are run."""


def _poison(dtype):
    return np.nan if np.issubdtype(dtype, np.floating) else 77


def _aligned(array):
    return (array.ctypes.data + 63) // 64 * 64


def _text(kernel, launch, warp):
    functions, declared = elementary_texts(set(kernel.needs))
    n = kernel.n_operands + kernel.n_results
    loads = "\n".join(
        f"%p{i} = getelementptr ptr, ptr %table, i64 {i}\n%b{i} = load ptr, ptr %p{i}\n"
        f"%g{i} = addrspacecast ptr %b{i} to ptr addrspace(1)"
        for i in range(n)
    )
    passed = ", ".join(f"ptr addrspace(1) %g{i}" for i in range(n))
    entry = entry_of(kernel, launch).replace("ptx_kernel", "internal")
    entry = entry.replace("@kernel(", "@kernel(i32 %t, i32 %b, i32 %n, ptr %memory, ")
    for name, given in (("tid", "%t"), ("ctaid", "%b"), ("nctaid", "%n")):
        call = f"call i32 @llvm.nvvm.read.ptx.sreg.{name}.x()"
        assert call in entry
        entry = entry.replace(call, f"add i32 {given}, 0")
    entry = entry.replace("ptr addrspace(3) @memory", "ptr %memory")
    entry = entry.replace("addrspacecast ptr addrspace(3) %shared to ptr", _SAME)
    barrier, slots = (ctypes.addressof(a[warp]) for a in (_BARRIERS, _SLOTS))
    machine = f"""
declare i32 @pthread_barrier_wait(ptr)
define internal void @wait() noinline {{
%r = call i32 @pthread_barrier_wait(ptr inttoptr (i64 {barrier} to ptr))
ret void
}}
define internal i32 @exchange(i64 %thread, i32 %number, i32 %step) noinline {{
%slots = getelementptr i8, ptr inttoptr (i64 {slots} to ptr), i64 0
%own = getelementptr i64, ptr %slots, i64 %thread
store volatile i32 %number, ptr %own
call void @wait()
%wide = zext i32 %step to i64
%other = xor i64 %thread, %wide
%at = getelementptr i64, ptr %slots, i64 %other
%found = load volatile i32, ptr %at
call void @wait()
ret i32 %found
}}
define void @in_threads(i32 %t, i32 %b, i32 %n, ptr %memory, ptr %table) {{
{loads}
call void @kernel(i32 %t, i32 %b, i32 %n, ptr %memory, {passed})
ret void
}}
"""
    return "\n".join([*sorted(declared), *functions, kernel.text, entry, machine])


_SAME = "getelementptr i8, ptr %shared, i64 0"


def lowered_to_threads(name, spec, results):
    """Returns the program of a primitive by threads; stands in for lanes in tests."""
    if lane_mode() == NEVER:
        return None
    rods = spec.batch.size if spec.batch is not None else 1
    try:
        kernel = kernel_of_warps(name, spec)
    except NotUnrolled as reason:
        refused(str(reason), rods)
        return None
    note(LaneChoice(True, "threads", rods, kernel.operations))
    kept = spec.n_kept if spec.keeps else 0
    every = spec.every if kept else 2**31 - 1
    shapes = [jax.ShapeDtypeStruct(made.shape, made.dtype) for made in results]

    def program(steps, *arrays):
        def call(steps, *arrays):
            taken.append((name, rods))
            counts = int(steps), every, rods, kept
            return run_in_threads(kernel, shapes, arrays, counts)

        return jax.pure_callback(call, shapes, steps, *arrays)

    return program


taken = []
"""Primitive and scenes of each call."""

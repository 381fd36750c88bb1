"""CUDA: compilation of warp kernels for NVIDIA GPUs, and their call by XLA.

LLVM writes PTX, which the driver compiles for the GPU of this machine. Elementary
functions are those of NVIDIA's libdevice, which JAX's CUDA packages contain. XLA uses
the same functions.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib.util
import os
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import jax

from jaxrod.jax_internals.foreign_call import (
    launcher_text,
    unknown_layout,
    unknown_stream,
)
from jaxrod.jax_internals.primitives import unknown_rules
from jaxrod.lanes.graph import OPERATIONS
from jaxrod.lanes.llvm.elementary import lane_by_lane, vector_name
from jaxrod.lanes.llvm.machine_code import capsule, native_function
from jaxrod.lanes.llvm.vector_code import TYPES
from jaxrod.lanes.warps.kernels import WarpKernel
from jaxrod.lanes.warps.warp_code import THREADS

WARPS = 2
"""Warps in a thread block, if their memory fits; otherwise 1. They do not wait for each
other."""
REGISTERS = 128
"""Largest number of registers of a thread. With fewer, more warps run at once, but each
spills more values to memory."""
_NEWEST = 90
"""Newest GPU architecture (compute capability without its dot) for which PTX is
written; the driver adapts it to later ones."""
_OLDEST = 70
"""Oldest GPU architecture (compute capability without its dot) that kernels can run
on."""
_ROUND = 0.16e-6
"""Estimated time of one round of a loop in a warp [s]."""
_XLA_STEP, _XLA_RATE = 22e-6, 3.3e12
"""Estimated time of a step by XLA in small batches [s], and its operations per second
in large batches [1/s].

These two and `_ROUND` were measured on an H100 (docs/performance.md). They decide
between a kernel and XLA, so only their ratios matter.
"""
_BLOCKS, _RESIDENT = 32, 8
"""Largest number of thread blocks per multiprocessor: for kernels whose warps need no
memory in the workspace, and for others."""
_RESERVED = 1024
"""Shared memory of a block that CUDA itself uses [bytes]."""
_MAJOR, _MINOR, _PROCESSORS, _SHARED = 75, 76, 16, 97
"""CUDA's attribute numbers of a device: major and minor compute capability, number of
multiprocessors, largest shared memory of a block."""
_DYNAMIC_SHARED = 8
"""CUDA's attribute number of a kernel for its largest dynamic shared memory."""
_loaded: dict[str, Any] = {}
"""Loaded kernels by name, kept for the life of the process because XLA calls them."""
_lock = threading.Lock()


@dataclass(frozen=True)
class Device:
    """Properties of a GPU; for several GPUs, the smallest value of each property."""

    architecture: int
    """Compute capability without its dot, such as 90."""
    processors: int
    """Number of multiprocessors."""
    shared: int
    """Largest shared memory of a block [bytes]."""


@dataclass(frozen=True)
class Launch:
    """Number of thread blocks and use of memory in the launch of a kernel."""

    blocks: int
    warps: int
    """Number of warps in a block."""
    in_shared: bool
    """Whether the memory of a warp is shared memory of its block; otherwise it is part
    of the workspace."""
    every: int
    """Number of recomputed carries for which each warp has memory in the workspace: the
    steps between checkpoints, or 0."""

    def shared(self, kernel: WarpKernel) -> int:
        """Shared memory of a block [bytes]; 0 if its warps use the workspace."""
        return self.warps * kernel.room if self.in_shared else 0

    def workspace(self, kernel: WarpKernel) -> int:
        """Size of the workspace for all warps [bytes]."""
        own = kernel.kept * self.every + (0 if self.in_shared else kernel.room)
        return kernel.uniform + self.blocks * self.warps * own + 64


@cache
def not_here() -> str | None:
    """Returns the reason why kernels cannot run on a GPU here; `None` if they can."""
    if importlib.util.find_spec("llvmlite") is None:
        return "llvmlite is not installed (pip install 'jaxrod[lanes]')"
    words = unknown_rules() or unknown_layout() or unknown_stream()
    if words is not None:
        return words
    try:
        found = device()
    except Exception as error:
        # Any failure to query the GPU leaves the run to XLA.
        return f"there is no GPU for CUDA: {error}"
    if found.architecture < _OLDEST:
        return f"the GPU's architecture {found.architecture} is older than {_OLDEST}"
    return None


@cache
def _driver() -> Any:
    """Loads and starts CUDA's driver library.

    Raises:
        OSError: The driver is missing, does not start, or is older than CUDA 12.
    """
    driver = ctypes.CDLL("libcuda.so.1")
    driver.cuInit.argtypes = [ctypes.c_uint]
    if driver.cuInit(0) != 0:
        raise OSError("it does not start")
    try:
        _ = driver.cuLibraryLoadData, driver.cuLibraryGetKernel
        _ = driver.cuKernelSetAttribute
    except AttributeError as error:
        raise OSError(f"it is older than CUDA 12: {error}") from error
    return driver


def _check(status: int, action: str) -> None:
    if status:
        text = ctypes.c_char_p()
        _driver().cuGetErrorString(status, ctypes.byref(text))
        words = (text.value or b"unknown").decode()
        raise RuntimeError(f"CUDA did not {action}: {words}")


@cache
def device() -> Device:
    """Returns the properties of JAX's GPUs in this process, or their smallest values.

    Raises:
        OSError: There is no driver, or JAX uses no GPU.
    """
    found = [_attributes(number) for number in _device_numbers()]
    return Device(
        min(10 * major + minor for major, minor, _, _ in found),
        min(processors for _, _, processors, _ in found),
        min(shared for _, _, _, shared in found),
    )


def _device_numbers() -> list[int]:
    """Returns CUDA's device numbers of the GPUs that JAX uses in this process.

    Raises:
        OSError: JAX uses no GPU.
    """
    try:
        return [gpu.local_hardware_id or 0 for gpu in jax.local_devices(backend="gpu")]
    except RuntimeError as error:
        raise OSError(f"JAX uses no GPU: {error}") from error


def _attributes(number: int) -> list[int]:
    found = []
    for attribute in (_MAJOR, _MINOR, _PROCESSORS, _SHARED):
        value = ctypes.c_int()
        status = _driver().cuDeviceGetAttribute(ctypes.byref(value), attribute, number)
        if status:
            raise OSError(f"attribute {attribute} of GPU {number} is unknown")
        found.append(value.value)
    return found


def launch_for(kernel: WarpKernel, rods: int, every: int, gpu: Device) -> Launch:
    """Chooses the number of blocks and the memory to launch a kernel with.

    Args:
        kernel: The kernel.
        rods: Number of scenes.
        every: Steps between checkpoints if carries are recomputed, otherwise 0.
        gpu: The GPU.
    """
    most = gpu.shared - _RESERVED
    warps = WARPS if WARPS * kernel.room <= most else 1
    in_shared = warps * kernel.room <= most
    blocks = -(-rods // warps)
    # Only as many warps as can run at once get memory in the workspace.
    small = in_shared and not kernel.kept
    resident = gpu.processors * (_BLOCKS if small else _RESIDENT)
    return Launch(min(blocks, resident), warps, in_shared, every)


def slower_than_xla(
    kernel: WarpKernel, launch: Launch, rods: int, gpu: Device
) -> str | None:
    """Returns the reason why XLA is likely to be faster, or `None`.

    The estimated time of warps is the number of loop rounds times the time of a round,
    for each wave of scenes that fits on the GPU. The estimated time of XLA is the
    number of operations divided by its rate, but at least the time of a small step. A
    scene that does not fit into shared memory is left to XLA.

    Args:
        kernel: The kernel.
        launch: Blocks and memory of the kernel.
        rods: Number of scenes.
        gpu: The GPU.
    """
    if not launch.in_shared:
        return f"{kernel.room} bytes of a scene do not fit into shared memory"
    of_block = launch.shared(kernel) + _RESERVED
    fitting = (gpu.shared + _RESERVED) // of_block * launch.warps
    at_once = min(launch.blocks * launch.warps, gpu.processors * fitting)
    by_warps = -(-rods // at_once) * kernel.rounds * _ROUND
    by_xla = max(_XLA_STEP, rods * kernel.work / _XLA_RATE)
    if by_warps <= by_xla:
        return None
    return (
        f"a step of a scene is long for the 32 threads of a warp: about "
        f"{by_warps * 1e6:.0f} us, and {by_xla * 1e6:.0f} us by XLA"
    )


def registered(kernel: WarpKernel, launch: Launch) -> str:
    """Compiles and loads a kernel and registers it with XLA, unless done already.

    Returns:
        The kernel's name in XLA.

    Raises:
        RuntimeError: The driver refuses the kernel.
    """
    architecture = min(device().architecture, _NEWEST)
    digest = f"{architecture} {launch} {kernel.text}"
    name = f"jaxrod_warps_{hashlib.sha256(digest.encode()).hexdigest()[:24]}"
    with _lock:
        if name in _loaded:
            return name
        driver = _driver()
        library, function = ctypes.c_void_p(), ctypes.c_void_p()
        text = ptx(kernel, launch, architecture)
        code = ctypes.create_string_buffer(text.encode())
        none = ctypes.c_void_p()
        status = driver.cuLibraryLoadData(
            ctypes.byref(library), code, none, none, 0, none, none, 0
        )
        _check(status, "compile a kernel")
        status = driver.cuLibraryGetKernel(ctypes.byref(function), library, b"kernel")
        _check(status, "find a kernel")
        shared = launch.shared(kernel)
        for number in _device_numbers():
            status = driver.cuKernelSetAttribute(
                _DYNAMIC_SHARED, shared, function, number
            )
            _check(status, f"give a block {shared} bytes of shared memory")
        address = ctypes.cast(driver.cuLaunchKernel, ctypes.c_void_p).value
        handler = launcher_text(
            name,
            kernel.n_operands,
            kernel.n_results,
            launch=address or 0,
            function=function.value or 0,
            blocks=launch.blocks,
            threads=THREADS * launch.warps,
            shared=shared,
        )
        # The text has addresses of this process, so that no other can use the code.
        engine, entry = native_function(handler, name, keep=False)
        _loaded[name] = engine, library
        jax.ffi.register_ffi_target(name, capsule(entry), platform="CUDA")
    return name


def ptx(kernel: WarpKernel, launch: Launch, architecture: int) -> str:
    """Returns the PTX (assembly text of NVIDIA GPUs) of a kernel.

    Args:
        kernel: The kernel.
        launch: Blocks and memory of the kernel.
        architecture: Compute capability without its dot.

    Raises:
        RuntimeError: libdevice is needed and not found.
    """
    import llvmlite.binding as llvm

    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    target = llvm.Target.from_triple("nvptx64-nvidia-cuda")
    machine = target.create_target_machine(cpu=f"sm_{architecture}", opt=3)
    text = [kernel.text, _MACHINE, *_elementary(kernel.needs), entry_of(kernel, launch)]
    module = llvm.parse_assembly("\n".join(text))
    module.triple = "nvptx64-nvidia-cuda"
    module.data_layout = str(machine.target_data)
    module.verify()
    if kernel.needs:
        module.link_in(llvm.parse_bitcode(_libdevice()))
        for function in module.functions:
            if function.name.startswith("__nv") and not function.is_declaration:
                function.linkage = "internal"
    options = llvm.create_pipeline_tuning_options(3)
    builder = llvm.create_pass_builder(machine, options)
    builder.getModulePassManager().run(module, builder)
    return str(machine.emit_assembly(module))


_MACHINE = f"""
declare void @llvm.nvvm.bar.warp.sync(i32)
declare i32 @llvm.nvvm.shfl.sync.bfly.i32(i32, i32, i32, i32)
declare i32 @llvm.nvvm.read.ptx.sreg.tid.x()
declare i32 @llvm.nvvm.read.ptx.sreg.ctaid.x()
declare i32 @llvm.nvvm.read.ptx.sreg.nctaid.x()
@memory = external addrspace(3) global [0 x i8], align 64
define internal void @wait() alwaysinline convergent {{
call void @llvm.nvvm.bar.warp.sync(i32 -1)
ret void
}}
define internal i32 @exchange(i64 %thread, i32 %number, i32 %step)
    alwaysinline convergent {{
%found = call i32 @llvm.nvvm.shfl.sync.bfly.i32(i32 -1, i32 %number, i32 %step,
    i32 {THREADS - 1})
ret i32 %found
}}
"""
"""LLVM IR of the functions that need a GPU. `@wait` is a barrier for the threads of a
warp. `@exchange` returns the number that the thread with index `thread xor step`
passed."""


def entry_of(kernel: WarpKernel, launch: Launch) -> str:
    """Returns LLVM IR of the function that CUDA launches.

    It computes the indices of thread and warp and the address of the warp's memory, and
    calls `@run`.
    """
    ins = [f"%in{i}" for i in range(kernel.n_operands)]
    outs = [f"%out{i}" for i in range(kernel.n_results)]
    buffers = [*ins, *outs]
    given = ", ".join(
        f"ptr addrspace(1) {'noalias readonly ' if name in ins else ''}{name}g"
        for name in buffers
    )
    casts = "\n".join(
        f"{name} = addrspacecast ptr addrspace(1) {name}g to ptr" for name in buffers
    )
    passed = ", ".join(f"ptr {name}" for name in buffers)
    if launch.in_shared:
        room = f"""%place = mul i64 %inside, {kernel.room}
%shared = getelementptr i8, ptr addrspace(3) @memory, i64 %place
%room = addrspacecast ptr addrspace(3) %shared to ptr"""
        begin = kernel.uniform
    else:
        room = f"""%place = mul i64 %warp, {kernel.room}
%after = add i64 %place, {kernel.uniform}
%room = getelementptr i8, ptr {outs[-1]}, i64 %after"""
        begin = kernel.uniform + launch.blocks * launch.warps * kernel.room
    return f"""
define ptx_kernel void @kernel({given}) "nvvm.maxnreg"="{REGISTERS}" {{
%t32 = call i32 @llvm.nvvm.read.ptx.sreg.tid.x()
%b32 = call i32 @llvm.nvvm.read.ptx.sreg.ctaid.x()
%n32 = call i32 @llvm.nvvm.read.ptx.sreg.nctaid.x()
%of_block = zext i32 %t32 to i64
%block = zext i32 %b32 to i64
%blocks = zext i32 %n32 to i64
%thread = and i64 %of_block, {THREADS - 1}
%inside = udiv i64 %of_block, {THREADS}
%first = mul i64 %block, {launch.warps}
%warp = add i64 %first, %inside
%warps = mul i64 %blocks, {launch.warps}
{casts}
{room}
%offset = mul i64 %warp, {kernel.kept * launch.every}
%keep = add i64 %offset, {begin}
%kept0 = getelementptr i8, ptr {outs[-1]}, i64 %keep
call void @run(i64 %thread, i64 %warp, i64 %warps, ptr %room, ptr %kept0, {passed})
ret void
}}
"""


def _elementary(needs: frozenset[tuple[str, str, int]]) -> Iterator[str]:
    """Yields LLVM IR of elementary functions, as calls of NVIDIA's libdevice.

    `needs` has the operation, number type and lanes of each function.
    """
    for operation, kind in sorted({need[:2] for need in needs}):
        row, one = OPERATIONS[operation], TYPES[kind]
        name = f"@__nv_{row.symbol}{'f' if kind == 'f32' else ''}"
        names = ["%a", "%b"][: row.operands]
        given = ", ".join(f"{one} {n}" for n in names)
        function = vector_name(operation, kind, 1)
        yield f"declare {one} {name}({', '.join([one] * len(names))})\n"
        yield (
            f"define internal {one} {function}({given}) alwaysinline {{\n"
            f"%r = call {one} {name}({given})\nret {one} %r\n}}\n"
        )
    for operation, kind, width in sorted(needs):
        if width > 1:
            yield lane_by_lane(operation, kind, width, operation)


@cache
def _libdevice() -> bytes:
    """Returns NVIDIA's library of elementary functions, in LLVM bitcode.

    Raises:
        RuntimeError: The library is not found.
    """
    for folder in _cuda_folders():
        file = folder / "nvvm" / "libdevice" / "libdevice.10.bc"
        if file.is_file():
            return file.read_bytes()
    raise RuntimeError("NVIDIA's libdevice.10.bc is not found")


def _cuda_folders() -> Iterator[Path]:
    """Yields folders that may contain CUDA: Python packages first, then the system."""
    try:
        found = importlib.util.find_spec("nvidia")
    except ValueError:
        found = None
    for place in (found.submodule_search_locations or []) if found else []:
        for name in ("cuda_nvcc", "cu13", "cu12"):
            yield Path(place) / name
    for variable in ("CUDA_HOME", "CUDA_PATH"):
        if variable in os.environ:
            yield Path(os.environ[variable])
    yield Path("/usr/local/cuda")
    yield from sorted(Path("/usr/local").glob("cuda-*"), reverse=True)

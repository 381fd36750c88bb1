"""CUDA: kernels of warps compiled for NVIDIA's GPUs, and called by XLA.

LLVM writes PTX, which the driver compiles for the GPU at hand. Elementary functions are
those of NVIDIA's libdevice, which JAX's CUDA packages contain, so that they are XLA's.
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
from jaxrod.lanes.llvm.elementary import lane_by_lane, vector_name
from jaxrod.lanes.llvm.machine_code import capsule, native_function
from jaxrod.lanes.llvm.vector_code import TYPES
from jaxrod.lanes.operations import OPERATIONS
from jaxrod.lanes.warps.kernels import WarpKernel
from jaxrod.lanes.warps.warp_code import THREADS

WARPS = 2
"""Warps of a block. They do not wait for each other."""
REGISTERS = 128
"""Registers of a thread: with fewer, more warps run at once, but each stores more."""
_NEWEST = 90
"""Newest architecture that PTX is written for; the driver adapts it to later ones."""
_OLDEST = 70
"""Oldest architecture with the instructions that are used."""
_ROUND = 0.16e-6
"""Time of a round of a loop [s]."""
_XLA_STEP, _XLA_RATE = 22e-6, 3.3e12
"""Time of a step by XLA [s], and operations that it does per second in large batches.

These three were measured on an H100 (docs/performance.md). They decide between the two
programs, so that only their ratios matter."""
_BLOCKS, _RESIDENT = 32, 8
"""Blocks of a multiprocessor: the most there can be, and those with workspace."""
_RESERVED = 1024
"""Shared memory of a block that CUDA keeps for itself [bytes]."""
_MAJOR, _MINOR, _PROCESSORS, _SHARED = 75, 76, 16, 97
"""Numbers of attributes of a device: architecture, multiprocessors, shared memory."""
_DYNAMIC_SHARED = 8
"""Number of the attribute of a kernel that admits more shared memory."""
_loaded: dict[str, Any] = {}
"""Loaded programs by name, kept for the life of the process."""
_lock = threading.Lock()


@dataclass(frozen=True)
class Device:
    """A GPU, or the least that several have."""

    architecture: int
    """Compute capability without its dot."""
    processors: int
    """Number of multiprocessors."""
    shared: int
    """Largest shared memory of a block [bytes]."""


@dataclass(frozen=True)
class Launch:
    """The blocks and the memory of one call of a kernel."""

    blocks: int
    warps: int
    """Warps of a block."""
    in_shared: bool
    """Whether the memory of a warp is shared memory; otherwise it is workspace."""
    every: int
    """Number of carries that each warp keeps in the workspace."""

    def shared(self, kernel: WarpKernel) -> int:
        """Shared memory of a block [bytes]."""
        return self.warps * kernel.room if self.in_shared else 0

    def workspace(self, kernel: WarpKernel) -> int:
        """Size of the workspace [bytes]."""
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
        # Whatever is unknown about a GPU must leave the run to XLA.
        return f"there is no GPU for CUDA: {error}"
    if found.architecture < _OLDEST:
        return f"the GPU's architecture {found.architecture} is older than {_OLDEST}"
    return None


@cache
def _driver() -> Any:
    """Returns CUDA's driver.

    Raises:
        OSError: There is none.
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
    """Returns what all GPUs that JAX uses in this process can do.

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
    """Returns CUDA's numbers of the GPUs that JAX uses in this process."""
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
    """Returns how a kernel is launched for a batch.

    Args:
        kernel: The kernel.
        rods: Number of scenes.
        every: Number of carries that each warp keeps.
        gpu: The GPU.
    """
    most = gpu.shared - _RESERVED
    warps = WARPS if WARPS * kernel.room <= most else 1
    in_shared = warps * kernel.room <= most
    blocks = -(-rods // warps)
    # Warps that have memory of the workspace are no more than can run at once.
    small = in_shared and not kernel.kept
    resident = gpu.processors * (_BLOCKS if small else _RESIDENT)
    return Launch(min(blocks, resident), warps, in_shared, every)


def slower_than_xla(
    kernel: WarpKernel, launch: Launch, rods: int, gpu: Device
) -> str | None:
    """Returns the reason why XLA is likely to be faster; `None` if it is not.

    A warp is slow where a scene is large: 32 threads have to do all of it.

    Args:
        kernel: The kernel.
        launch: Its blocks and memory.
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
    """Compiles and loads a kernel, unless done before, and registers it with XLA.

    Returns:
        The kernel's name in XLA.

    Raises:
        RuntimeError: The driver refuses it.
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
    """Compiles a kernel to PTX.

    Args:
        kernel: The kernel.
        launch: Blocks and memory.
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
"""Functions of the machine."""


def entry_of(kernel: WarpKernel, launch: Launch) -> str:
    """Writes the entry of the kernel, which finds the thread and its memory."""
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
    """Writes the elementary functions, as calls of libdevice."""
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
    """Returns libdevice.

    Raises:
        RuntimeError: It is not found.
    """
    for folder in _cuda_folders():
        file = folder / "nvvm" / "libdevice" / "libdevice.10.bc"
        if file.is_file():
            return file.read_bytes()
    raise RuntimeError("NVIDIA's libdevice.10.bc is not found")


def _cuda_folders() -> Iterator[Path]:
    """Yields folders in which CUDA may be: packages of Python, then the system's."""
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

"""XLA's binary interface for calls of foreign functions (FFI), used by byte offsets.

XLA calls a handler with one pointer, to a call frame that refers to the buffers. The
layout of the frame is that of `xla/ffi/api/c_api.h`, which comes with jaxlib. The
offsets used here are valid only for the structures listed below. So the header file is
checked against this list before the first call.
"""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import jax

_EXTENSIONS = ("XLA_FFI_InternalExtension", "XLA_FFI_Extension_Base")
"""Names of the C structure with which extensions begin: in jaxlib since 0.11, and
before."""
_EXTENSION = ("struct_size", "type", "next")
_EXPECTED = {
    "XLA_FFI_Api_Version": (
        *("struct_size", "extension_start", "major_version", "minor_version"),
    ),
    "XLA_FFI_Error_Create_Args": ("struct_size", "extension_start", "message", "errc"),
    "XLA_FFI_Buffer": (
        *("struct_size", "extension_start", "dtype", "data", "rank", "dims"),
    ),
    "XLA_FFI_Args": ("struct_size", "extension_start", "size", "types", "args"),
    "XLA_FFI_Rets": ("struct_size", "extension_start", "size", "types", "rets"),
    "XLA_FFI_Metadata_Extension": ("extension_base", "metadata"),
}
"""All fields, in order, of other C structures that are read, by name of the
structure."""
_BEGINNINGS = {
    "XLA_FFI_CallFrame": (
        *("struct_size", "extension_start", "api", "ctx", "stage", "args", "rets"),
    ),
    "XLA_FFI_Metadata": ("struct_size", "api_version", "traits"),
    "XLA_FFI_Api": (
        *("struct_size", "extension_start", "api_version", "internal_api"),
        "_XLA_FFI_API_STRUCT_FIELD(XLA_FFI_Error_Create)",
    ),
}
"""First fields, in order, of C structures that may have further fields, by name."""
_STREAM_GET = "_XLA_FFI_API_STRUCT_FIELD(XLA_FFI_Stream_Get)"
"""Field with the function that returns the GPU stream of a call. It must be the
ninth field of `XLA_FFI_Api`, the fifth function."""
_STREAM = ("struct_size", "extension_start", "ctx", "stream")
"""Fields of the argument structure of the function that returns the GPU stream."""


@cache
def header() -> str:
    """Returns the text of XLA's FFI header without comments; empty if not found."""
    try:
        file = Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h"
        return re.sub(r"//[^\n]*", "", file.read_text())
    except (OSError, AttributeError):
        return ""


@cache
def unknown_layout() -> str | None:
    """Returns the reason why XLA's FFI lacks the expected layout, or `None`."""
    if not header():
        return "jaxlib's header of foreign functions is not found"
    if not any(_fields(name) == _EXTENSION for name in _EXTENSIONS):
        return f"jaxlib's {_EXTENSIONS[0]} has another layout than the one known"
    for name, expected in _EXPECTED.items():
        if _fields(name) != expected:
            return f"jaxlib's {name} has another layout than the one known"
    for name, expected in _BEGINNINGS.items():
        if _fields(name)[: len(expected)] != expected:
            return f"jaxlib's {name} has another layout than the one known"
    for constant in (
        "XLA_FFI_Extension_Metadata = 1",
        "XLA_FFI_ExecutionStage_EXECUTE = 3",
    ):
        if constant not in header():
            return f"jaxlib's header does not say {constant}"
    if None in api_version():
        return "jaxlib's header does not say its version"
    return None


@cache
def unknown_stream() -> str | None:
    """Returns the reason why the GPU stream of a call is unavailable, or `None`.

    XLA's FFI must have the function that returns the stream at its expected offset.
    """
    if _fields("XLA_FFI_Api")[8:9] != (_STREAM_GET,):
        return "jaxlib's XLA_FFI_Api has another layout than the one known"
    if _fields("XLA_FFI_Stream_Get_Args") != _STREAM:
        return "jaxlib's XLA_FFI_Stream_Get_Args has another layout than the one known"
    return None


def api_version() -> tuple[int | None, int | None]:
    """Returns the major and minor version of XLA's FFI, read from its header.

    A number that the header does not contain is `None`.
    """
    numbers: list[int | None] = []
    for word in ("MAJOR", "MINOR"):
        found = re.search(rf"#define XLA_FFI_API_{word} (\d+)", header())
        numbers.append(int(found.group(1)) if found else None)
    return numbers[0], numbers[1]


def handler_text(name: str, n_operands: int, n_results: int) -> str:
    """Returns LLVM IR of the function by which XLA calls a kernel on a CPU (handler).

    When it is registered, XLA asks the handler for its version. A call with another
    number of buffers than the kernel has is an error; any other call runs `@kernel`.
    """
    work = """
call void @kernel(ptr %operands, ptr %results)
ret ptr null
"""
    return _handler(name, n_operands, n_results, work)


def launcher_text(
    name: str,
    n_operands: int,
    n_results: int,
    *,
    launch: int,
    function: int,
    blocks: int,
    threads: int,
    shared: int,
) -> str:
    """Returns LLVM IR of a handler that launches a CUDA kernel on the stream of a call.

    Args:
        name: Name of the handler.
        n_operands: Number of operands of the kernel.
        n_results: Number of results of the kernel.
        launch: Address of CUDA's `cuLaunchKernel`.
        function: Address of the loaded kernel.
        blocks: Number of blocks.
        threads: Number of threads in a block.
        shared: Shared memory of a block [bytes].
    """
    n = n_operands + n_results
    lines = []
    for array, first, count in (
        ("operands", 0, n_operands),
        ("results", n_operands, n_results),
    ):
        for i in range(count):
            mark = f"%{array}{i}"
            lines.append(
                f"{mark}p = getelementptr ptr, ptr %{array}, i64 {i}\n"
                f"{mark}b = load ptr, ptr {mark}p\n"
                f"{mark}d = getelementptr i8, ptr {mark}b, i64 24\n"
                f"{mark}s = getelementptr ptr, ptr %given, i64 {first + i}\n"
                f"store ptr {mark}d, ptr {mark}s\n"
            )
    work = f"""
%asked_for = alloca [32 x i8], align 8
store i64 32, ptr %asked_for
%sx = getelementptr i8, ptr %asked_for, i64 8
store ptr null, ptr %sx
%pctx = getelementptr i8, ptr %frame, i64 24
%ctx = load ptr, ptr %pctx
%sc = getelementptr i8, ptr %asked_for, i64 16
store ptr %ctx, ptr %sc
%ss = getelementptr i8, ptr %asked_for, i64 24
store ptr null, ptr %ss
%wapi = getelementptr i8, ptr %frame, i64 16
%api_ = load ptr, ptr %wapi
%pget = getelementptr i8, ptr %api_, i64 80
%get = load ptr, ptr %pget
%trouble = call ptr %get(ptr %asked_for)
%fine = icmp eq ptr %trouble, null
br i1 %fine, label %go, label %no_stream
no_stream:
ret ptr %trouble
go:
%stream = load ptr, ptr %ss
%given = alloca [{n} x ptr], align 8
{"".join(lines)}
%status = call i32 inttoptr (i64 {launch} to ptr)(
    ptr inttoptr (i64 {function} to ptr), i32 {blocks}, i32 1, i32 1,
    i32 {threads}, i32 1, i32 1, i32 {shared}, ptr %stream, ptr %given, ptr null)
%launched = icmp eq i32 %status, 0
br i1 %launched, label %done, label %refuse
done:
ret ptr null
"""
    failed = f"jaxrod: CUDA did not launch a kernel of {blocks} blocks"
    return _handler(name, n_operands, n_results, work, failed)


def _handler(
    name: str, n_operands: int, n_results: int, work: str, failed: str = ""
) -> str:
    """Returns LLVM IR of a function by which XLA calls a kernel (handler).

    Args:
        name: Name of the handler.
        n_operands: Number of operands of the kernel.
        n_results: Number of results of the kernel.
        work: LLVM IR that runs if the number of buffers is right. It may branch to
            `%refuse`, which returns an error.
        failed: Message of that error; empty if `work` does not branch there.
    """
    major, minor = api_version()
    words = f"jaxrod: a kernel of {n_operands} operands was called with others"
    return f"""
@words = private constant [{len(words) + 1} x i8] c"{words}\\00"
@failed = private constant [{len(failed) + 1} x i8] c"{failed}\\00"
define ptr @{name}(ptr %frame) nounwind {{
entry:
%pe = getelementptr i8, ptr %frame, i64 8
%e = load ptr, ptr %pe
%none = icmp eq ptr %e, null
br i1 %none, label %check, label %asked
asked:
%pt = getelementptr i8, ptr %e, i64 8
%t = load i32, ptr %pt
%is = icmp eq i32 %t, 1
br i1 %is, label %answer, label %check
answer:
%pm = getelementptr i8, ptr %e, i64 24
%m = load ptr, ptr %pm
%pmajor = getelementptr i8, ptr %m, i64 24
store i32 {major}, ptr %pmajor
%pminor = getelementptr i8, ptr %m, i64 28
store i32 {minor}, ptr %pminor
ret ptr null
check:
%pstage = getelementptr i8, ptr %frame, i64 32
%stage = load i32, ptr %pstage
%pn = getelementptr i8, ptr %frame, i64 56
%n = load i64, ptr %pn
%pr = getelementptr i8, ptr %frame, i64 96
%r = load i64, ptr %pr
%a = icmp eq i32 %stage, 3
%b = icmp eq i64 %n, {n_operands}
%c = icmp eq i64 %r, {n_results}
%ab = and i1 %a, %b
%abc = and i1 %ab, %c
br i1 %abc, label %work, label %refuse
refuse:
%reason = phi ptr [@words, %check]{", [@failed, %go]" if failed else ""}
%error = alloca [32 x i8], align 8
store i64 32, ptr %error
%ee = getelementptr i8, ptr %error, i64 8
store ptr null, ptr %ee
%em = getelementptr i8, ptr %error, i64 16
store ptr %reason, ptr %em
%ec = getelementptr i8, ptr %error, i64 24
store i32 13, ptr %ec
%papi = getelementptr i8, ptr %frame, i64 16
%api = load ptr, ptr %papi
%pcreate = getelementptr i8, ptr %api, i64 48
%create = load ptr, ptr %pcreate
%made = call ptr %create(ptr %error)
ret ptr %made
work:
%poperands = getelementptr i8, ptr %frame, i64 72
%operands = load ptr, ptr %poperands
%presults = getelementptr i8, ptr %frame, i64 112
%results = load ptr, ptr %presults
{work}
}}
"""


def _fields(name: str) -> tuple[str, ...]:
    found = re.search(rf"struct {name} \{{(.*?)\n\}}", header(), re.S)
    if found is None:
        return ()
    parts = (part.strip() for part in found.group(1).split(";"))
    return tuple(re.split(r"[\s*]+", part)[-1] for part in parts if part)

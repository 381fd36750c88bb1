"""Kernels of warps: LLVM IR that runs all steps of a batch on a GPU.

A warp (32 threads) computes one scene after another. Values that change in a step are
kept in shared memory of the thread block, if they fit. Values that all scenes share are
computed by every warp, before its first scene, and stored by all at the same addresses.
The warps store the same numbers, so none has to wait for another.

The LLVM IR is the same for every machine with threads. `cuda.py` adds the functions
`@wait` and `@exchange` of a GPU.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from jaxrod.lanes.graph import FIXED, UNIFORM, VARYING
from jaxrod.lanes.jaxpr.unroll import kind_of
from jaxrod.lanes.llvm.kernel import backward_loops, forward_loops
from jaxrod.lanes.llvm.kernel_plan import counts_text
from jaxrod.lanes.llvm.vector_code import BYTES
from jaxrod.lanes.rows.kernels import RowPlan, next_carry
from jaxrod.lanes.rows.loop_code import RowWriter
from jaxrod.lanes.rows.schedule import Goal, Loop, Place, Schedule, hoisted
from jaxrod.lanes.run_spec import Ends, LoopBody, RunSpec
from jaxrod.lanes.warps.warp_code import (
    THREADS,
    WAIT,
    WarpWriter,
    copy_call,
    copy_text,
    warp_fill_text,
)

REGIONS = ("%scratch", "%uniform", "%own")
"""Names of the pointers that are the first arguments of all functions of a kernel,
after the thread."""


@dataclass(frozen=True)
class WarpKernel:
    """A kernel in LLVM IR for the threads of a warp, and the memory that it needs.

    Its operands and results are those of `jaxrod.lanes.llvm.kernel.Kernel`. The
    arguments of its function `@run` are the index of the thread, the index of the warp,
    the number of warps, a pointer to the memory of the warp, another to the carries
    that it recomputes, and all buffers.
    """

    text: str
    """LLVM IR without the functions of the GPU, `@wait` and `@exchange`."""
    needs: frozenset[tuple[str, str, int]]
    """Elementary functions that the kernel calls: operation, number type and number of
    lanes of each. The number of lanes is 1 for single numbers."""
    n_operands: int
    """Number of operands, including the first one, the array of counts."""
    n_results: int
    """Number of results, including the last one, the workspace."""
    room: int
    """Memory of a warp, without the carries that it recomputes [bytes]."""
    uniform: int
    """Memory at the beginning of the workspace for values that all scenes share
    [bytes]."""
    kept: int
    """Size of each carry that the reverse pass recomputes, in the workspace [bytes]; 0
    in kernels of the forward pass."""
    operations: int
    """Number of LLVM lines that compute a value."""
    rounds: int
    """Number of loop rounds that a thread runs in the longest function of the kernel,
    such as a step."""
    work: int
    """Number of operations on single numbers in the longest function of the kernel,
    such as a step of one scene."""


class WarpPlan(RowPlan):
    """A kernel with a warp for each scene, under construction: memory and functions."""

    alignment = 16
    """Alignment of arrays in memory [bytes]. It is smaller than for rows, because
    threads load single numbers, and less memory is lost."""
    packs = False
    splits = nests = False
    """Packed loops are not for warps: a list is made by one thread."""

    def __init__(self, body: LoopBody, batched: Sequence[bool]) -> None:
        """Translates a step; the arguments are those of `RowPlan`."""
        self.uniform = self.storage("%uniform")
        self.rounds = self.work = 0
        super().__init__(body, batched)
        self.fixed.pointer = "%own"
        self.buffers: list[str] = []

    def rate(self, which: int) -> int:
        """Returns the rate at which operand number `which` of the step changes.

        It is `UNIFORM` for a constant that all scenes share, `FIXED` for another
        constant, and `VARYING` for an array of the carry.
        """
        if which >= self.n_constants:
            return VARYING
        return FIXED if self.batched[which] else UNIFORM

    def places_of_constants(self) -> list[Place]:
        """Returns the locations of constants: buffers of XLA, which are not copied."""
        return [
            Place(f"%{'row' if batched else 'in'}{1 + i}", 0)
            for i, batched in enumerate(self.batched)
        ]

    def hoist(self, goals: Sequence[Goal]) -> None:
        """Writes `@shared` and `@fixed`, which compute values that all steps share.

        `@shared` computes the values that all scenes share too, `@fixed` those of one
        scene. Only values that the goals need are computed.
        """
        graph = self.graph
        self.know_data()
        nodes = hoisted(graph, [goal.node for goal in goals], self.ready)
        uniform = [node for node in nodes if self._is_written_alike(node)]
        own = [node for node in nodes if not self._is_written_alike(node)]
        for node in uniform:
            self.ready[node] = self.room_for(node, self.uniform)
        self.function("shared", [], [], uniform)
        for node in own:
            self.ready[node] = self.room_for(node, self.fixed)
        self.function("fixed", [], [], own)

    def _is_written_alike(self, node: int) -> bool:
        """Whether all warps may write a node to one address without waiting.

        Its value must be the same for all scenes. Sums that are accumulated in memory
        are excluded, because the memory holds partial sums in the meantime.
        """
        graph = self.graph
        if graph.rates[node] >= FIXED or graph.operations[node] == "scatter":
            return False
        if graph.operations[node] == "reduce":
            return len(graph.dims[graph.arguments[node][0]]) == 1
        return True

    def function(
        self,
        name: str,
        goals: Sequence[Goal],
        pointers: Sequence[str],
        stored: Sequence[int] = (),
    ) -> None:
        """Writes an LLVM function that computes nodes and stores their values.

        The arguments of this method are those of `RowPlan.function`. The LLVM function
        takes the arguments that `given(name)` lists, followed by `pointers`.
        """
        whole = [*REGIONS[1:], *self._buffers_of(name), *pointers]
        super().function(name, goals, whole, stored)

    def writer(self, schedule: Schedule) -> RowWriter:
        """Returns the writer of a function; updates the plan's `rounds` and `work`."""
        self.rounds = max(self.rounds, sum(map(self._rounds, schedule.loops)))
        self.work = max(self.work, sum(map(_work, schedule.loops)))
        return WarpWriter(self.graph, schedule, 4)

    def _rounds(self, loop: Loop) -> int:
        graph = self.graph
        if loop.scatters:
            return int(graph.extras[loop.scatters[0]][1])
        if loop.recurrence is not None:
            return int(graph.extras[loop.recurrence].length)
        if not loop.dims:
            return 1
        return math.prod(loop.dims[:-1]) * -(-loop.dims[-1] // THREADS)

    def call(self, name: str, *pointers: str) -> str:
        """Returns LLVM IR that calls a function of the kernel.

        Its arguments are those that `given` lists, followed by `pointers`.
        """
        given = [self.given(name), *(f"ptr {pointer}" for pointer in pointers)]
        return f"call void @{name}({', '.join(given)})\n"

    def given(self, name: str) -> str:
        """Returns the LLVM text of the first arguments of a function of the kernel.

        They are the thread, the regions of memory and the buffers of XLA.
        """
        pointers = (*REGIONS, *self._buffers_of(name))
        return ", ".join(["i64 %thread", *(f"ptr {pointer}" for pointer in pointers)])

    def _buffers_of(self, name: str) -> list[str]:
        """Returns the names of the XLA buffers that a function takes.

        `@shared` takes only constants that all scenes share.
        """
        if name != "shared":
            return self.buffers
        return [buffer for buffer in self.buffers if buffer.startswith("%in")]

    def name_buffers(self, n_given: int, n_made: int) -> None:
        """Sets the names of the XLA buffers that the functions read and write.

        Args:
            n_given: Number of operands of each scene, after the constants.
            n_made: Number of results that functions write directly.
        """
        self.buffers = [place.pointer for place in self.constant_places]
        first = 1 + self.n_constants
        self.buffers += [f"%row{first + i}" for i in range(n_given)]
        self.buffers += [f"%made{i}" for i in range(n_made)]

    def rows(self, given: Sequence[Any] = (), made: Sequence[Any] = ()) -> str:
        """Returns LLVM IR of pointers to one scene's part of each operand and result.

        `given` and `made` are the types of the operands after the constants, and of the
        results. Constants that all scenes share have no such pointer.
        """
        first = 1 + self.n_constants
        arrays = [
            (f"row{1 + i}", f"in{1 + i}", aval)
            for i, aval in enumerate(self.constants)
            if self.batched[i]
        ]
        arrays += [
            (f"row{first + i}", f"in{first + i}", aval) for i, aval in enumerate(given)
        ]
        arrays += [(f"made{i}", f"out{i}", aval) for i, aval in enumerate(made)]
        return "".join(row_text(row, whole, aval) for row, whole, aval in arrays)

    def fetch_row(self, to: str, place: Place, source: str, aval: Any) -> str:
        """Returns LLVM IR that copies an array into a region of the warp's memory.

        `source` points to the array, which has the type `aval`. `to` points to the
        region, in which the copy has the offset of `place`.
        """
        at = f"{to}_{place.offset}"
        return (
            f"{at} = getelementptr i8, ptr {to}, i64 {place.offset}\n"
            f"{copy_call(at, source, size_of(aval), 4)}\n"
        )

    def bring_row(self, to: str, region: str, place: Place, aval: Any) -> str:
        """Returns LLVM IR that copies an array out of a region of the warp's memory.

        `region` points to the region, in which the array of type `aval` has the offset
        of `place`. `to` points to the copy.
        """
        at = f"{to}_from"
        return (
            f"{at} = getelementptr i8, ptr {region}, i64 {place.offset}\n"
            f"{copy_call(to, at, size_of(aval), 4)}\n"
        )

    def finished(
        self,
        per_scene: str,
        n_operands: int,
        n_results: int,
        spaces: dict[str, int],
        kept: int = 0,
    ) -> WarpKernel:
        """Returns the kernel, whose function `@run` loops over the scenes of a warp.

        Args:
            per_scene: LLVM IR that runs for each scene.
            n_operands: Number of operands, with the counts.
            n_results: Number of results, with the workspace.
            spaces: Sizes of the regions of a warp's memory after `%own`, by name
                [bytes].
            kept: Size of each carry that the reverse pass recomputes [bytes].
        """
        fills = "\n".join(self.fill_calls("i64 %thread, "))
        sizes = {"scratch": self.scratch, "own": self.fixed.size, **spaces}
        start, lines = 0, []
        for name, size in sizes.items():
            lines.append(f"%{name} = getelementptr i8, ptr %room, i64 {start}\n")
            start += size
        ins = [f"%in{i}" for i in range(n_operands)]
        outs = [f"%out{i}" for i in range(n_results)]
        buffers = ", ".join(f"ptr {name}" for name in (*ins, *outs))
        main = f"""
define internal void @run(i64 %thread, i64 %warp, i64 %warps, ptr %room, ptr %kept0,
    {buffers}) alwaysinline {{
entry:
{counts_text()}
{"".join(lines)}
%uniform = getelementptr i8, ptr %out{n_results - 1}, i64 0
{self.call("shared")}
br label %scenes_test
scenes_test:
%scene = phi i64 [%warp, %entry], [%following, %scene_done]
%inside = icmp slt i64 %scene, %rods
br i1 %inside, label %scenes, label %done
scenes:
{per_scene.replace("{fills}", fills)}
{WAIT}
br label %scene_done
scene_done:
%following = add i64 %scene, %warps
br label %scenes_test
done:
ret void
}}
"""
        declared = {d for d in self.declared if "memcpy" not in d and "memset" not in d}
        texts = [
            *sorted(declared),
            copy_text(8),
            copy_text(32),
            *map(warp_fill_text, sorted(self.fills | {"i8", "i32"})),
            *self.texts,
            main,
        ]
        return WarpKernel(
            "\n".join(texts),
            frozenset(self.needs),
            n_operands,
            n_results,
            start,
            self.uniform.size,
            kept,
            self.lines,
            self.rounds,
            self.work,
        )


def _work(loop: Loop) -> int:
    return math.prod(loop.dims) * (len(loop.nodes) + len(loop.goals))


def row_text(row: str, whole: str, aval: Any, index: str = "%scene") -> str:
    """Returns LLVM IR of a pointer `row` to one row of the array `whole`.

    `aval` is the type of a row, and `index` its index along the leading axis.
    """
    return (
        f"%{row}_at = mul i64 {index}, {size_of(aval)}\n"
        f"%{row} = getelementptr i8, ptr %{whole}, i64 %{row}_at\n"
    )


def size_of(aval: Any) -> int:
    """Size of an array [bytes]."""
    return math.prod(aval.shape) * BYTES[kind_of(aval)]


@lru_cache(maxsize=64)
def cycles_by_warps(
    body: LoopBody, batched: tuple[bool, ...], *, checkpoints: bool
) -> WarpKernel:
    """Returns the GPU kernel that repeats a step, with a warp for each scene.

    Operands and results are those of `lanes.llvm.kernel.step_kernel`. `batched` tells
    which constants differ between scenes.
    """
    plan = WarpPlan(body, batched)
    n_carry, first = len(plan.carry), 1 + plan.n_constants
    plan.name_buffers(0, 0)
    goals = next_carry(plan)
    plan.hoist(goals)
    plan.function("step", goals, ["%now", "%then"])
    carry = list(zip(plan.carry, plan.carry_places, strict=True))
    fetches = "".join(
        plan.fetch_row("%now0", place, f"%row{first + i}", aval)
        for i, (aval, place) in enumerate(carry)
    )
    marks = ""
    if checkpoints:
        marks = f"{WAIT}\n%mark0 = mul i64 %scene, %kept\n%mark = add i64 %mark0, %j\n"
        for i, (aval, place) in enumerate(carry):
            marks += row_text(f"mark_row{i}", f"out{n_carry + i}", aval, "%mark")
            marks += plan.bring_row(f"%mark_row{i}", "%now1", place, aval)
    brings = "".join(
        plan.bring_row(f"%made{i}", "%now1", place, aval)
        for i, (aval, place) in enumerate(carry)
    )
    text = f"""{plan.rows(plan.carry, plan.carry)}
{plan.call("fixed")}{{fills}}
{fetches}
{WAIT}
{forward_loops("scenes", plan.given("step"), marks)}
{brings}"""
    n_results = n_carry * (2 if checkpoints else 1) + 1
    spaces = {"now0": plan.now.size, "then0": plan.now.size}
    return plan.finished(text, first + n_carry, n_results, spaces)


@lru_cache(maxsize=64)
def run_by_warps(body: LoopBody, ends: Ends, batched: tuple[bool, ...]) -> WarpKernel:
    """Returns the GPU kernel of a whole run, with a warp for each scene.

    Operands and results are those of `lanes.llvm.kernel.run_kernel`. `batched` tells
    which constants differ between scenes.
    """
    plan = WarpPlan(body, batched)
    n = plan.n_constants
    avals = ends.given[n:]
    first = n + len(plan.carry)
    arguments = [plan.input(first + i, aval, VARYING) for i, aval in enumerate(avals)]
    plan.stand(first, [Place(f"%row{1 + n + i}", 0) for i in range(len(avals))])
    plan.name_buffers(len(avals), len(ends.made))
    begun = plan.unroller.run(ends.begin, [*plan.inputs[:n], *arguments])
    ended = plan.unroller.run(ends.end, plan.inputs)
    step = next_carry(plan)
    start = [Place("%then", place.offset) for place in plan.carry_places]
    begin = plan.goals(begun, start)
    end = plan.goals(ended, [Place(f"%made{i}", 0) for i in range(len(ends.made))])
    plan.hoist([*step, *begin, *end])
    plan.function("step", step, ["%now", "%then"])
    plan.function("begin", begin, ["%then"])
    plan.function("end", end, ["%now"])
    text = f"""{plan.rows(avals, ends.made)}
{plan.call("fixed")}{{fills}}
{WAIT}
{plan.call("begin", "%now0")}
{forward_loops("scenes", plan.given("step"))}
{plan.call("end", "%now1")}"""
    spaces = {"now0": plan.now.size, "then0": plan.now.size}
    return plan.finished(text, 1 + n + len(avals), len(ends.made) + 1, spaces)


@lru_cache(maxsize=64)
def back_by_warps(
    body: LoopBody, moving: tuple[bool, ...], batched: tuple[bool, ...]
) -> WarpKernel:
    """Returns the GPU kernel of the reverse pass, with a warp for each scene.

    Operands and results are those of `lanes.looped.kernels.back_in_lanes`. `moving`
    tells which constants have tangents, `batched` which differ between scenes.
    """
    plan = WarpPlan(body, batched)
    n, n_carry = plan.n_constants, len(plan.carry)
    avals, n_seeds, before, before_places, step, back = plan.reverse(moving)
    plan.name_buffers(0, 0)
    plan.hoist([*step, *back])
    plan.function("step", step, ["%now", "%then"])
    plan.function("adjoint", back, ["%now", "%before", "%after"])
    first_mark, first_seed = 1 + n, 1 + n + n_carry
    marks = f"{WAIT}\n%mark0 = mul i64 %scene, %kept\n%mark = add i64 %mark0, %j\n"
    for i, (aval, place) in enumerate(zip(plan.carry, plan.carry_places, strict=True)):
        marks += row_text(f"mark_row{i}", f"in{first_mark + i}", aval, "%mark")
        marks += plan.fetch_row("%kept0", place, f"%mark_row{i}", aval)
    marks += WAIT
    seeds = "".join(
        row_text(f"seed{i}", f"in{first_seed + i}", aval)
        + plan.fetch_row("%back0", place, f"%seed{i}", aval)
        for i, (aval, place) in enumerate(
            zip(avals[:n_seeds], before_places[:n_seeds], strict=True)
        )
    )
    brings = "".join(
        plan.bring_row(f"%made{i}", "%back1", place, aval)
        for i, (aval, place) in enumerate(zip(avals, before_places, strict=True))
    )
    loops = backward_loops("scenes", plan.given("step"), plan.now.size, marks)
    text = f"""{plan.rows((), avals)}
{plan.call("fixed")}{{fills}}
call void @fill_i8(i64 %thread, ptr %back0, i64 0, i8 0, i64 {before.size}, i64 1,
    i64 0)
{WAIT}
{seeds}
{WAIT}
{loops}
{brings}"""
    spaces = {"back0": before.size, "other0": before.size}
    return plan.finished(
        text, first_seed + n_seeds, len(avals) + 1, spaces, plan.now.size
    )


def kernel_of_warps(name: str, spec: RunSpec) -> WarpKernel:
    """Returns the GPU kernel of a primitive, with a warp for each scene.

    Args:
        name: Name of the primitive.
        spec: Structure of the operation.

    Raises:
        NotUnrolled: A kernel cannot run the operation.
    """
    body = spec.body
    batched = (False,) * body.n_constants
    if spec.batch is not None:
        batched = tuple(spec.batch.rows[: body.n_constants])
    if spec.ends is not None:
        return run_by_warps(body, spec.ends, batched)
    if name == "jaxrod_cycles":
        return cycles_by_warps(body, batched, checkpoints=spec.keeps)
    return back_by_warps(body, spec.moving, batched)

"""Kernels of lanes in loops: LLVM IR that runs all steps, a vector of scenes at a time.

The kernels are those of rows, except that a stored row has a vector for each number.
Values that all scenes share are computed once, as in rows, and stored as single
numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

from jaxrod.lanes.graph import FIXED, UNIFORM, VARYING
from jaxrod.lanes.jaxpr.unroll import NotUnrolled, kind_of
from jaxrod.lanes.llvm.elementary import elementary_texts
from jaxrod.lanes.llvm.kernel import Kernel, backward_loops, forward_loops
from jaxrod.lanes.llvm.kernel_plan import entry_text
from jaxrod.lanes.llvm.machine_code import vector_bytes
from jaxrod.lanes.llvm.transpose import is_tiled, transpose_text
from jaxrod.lanes.llvm.vector_code import BYTES
from jaxrod.lanes.looped.lane_code import (
    LaneWriter,
    is_single,
    lane_fill_call,
    lane_fill_text,
    vector_literal,
)
from jaxrod.lanes.rows.functions import MOST_LINES, Storage
from jaxrod.lanes.rows.kernels import RowPlan, next_carry
from jaxrod.lanes.rows.loop_code import RowWriter, fill_text
from jaxrod.lanes.rows.schedule import Goal, Place, Schedule, fills_of, hoisted
from jaxrod.lanes.run_spec import Ends, LoopBody

REGIONS = "ptr %scratch, ptr %uniform, ptr %fixed"
"""LLVM text of the first arguments of all functions of a kernel."""


class LaneStorage(Storage):
    """A region in which each number has a vector.

    Sizes and offsets are those of one lane.
    """

    def __init__(self, pointer: str, lanes: int) -> None:
        """Creates an empty region; `pointer` is the name of its pointer."""
        super().__init__(pointer, 1)
        self.lanes = lanes

    def give(self, kind: str, count: int) -> Place:
        """Allocates `count` numbers of type `kind`; returns their location."""
        start = -(-self.size // BYTES[kind]) * BYTES[kind]
        self.size = start + spaced(count, self.lanes) * BYTES[kind]
        return Place(self.pointer, start)


class LaneSchedule(Schedule):
    """A schedule whose loops may run together, so that no memory is used twice."""

    lanes = 1
    """Number of lanes of a vector."""

    def _allocate(self) -> None:
        graph, storage = self.graph, LaneStorage("%scratch", self.lanes)
        for node in sorted(self._kept):
            if node in self.ready or node in self.places:
                continue
            more = 1 if graph.operations[node] == "scatter" else 0
            count = math.prod(graph.dims[node]) + more
            self.places[node] = storage.give(graph.kinds[node], count)
        self.size = storage.size


def spaced(count: int, lanes: int) -> int:
    """Returns the number of vectors in memory for `count` numbers.

    Transposed arrays fill whole tiles. The number is odd, so that entries of equal
    index in neighbouring rows are not in the same set of a cache.
    """
    if 2 * count < lanes:
        return count
    return (-(-count // lanes) * lanes) | 1


class LanePlan(RowPlan):
    """A kernel with a scene in each lane, under construction: memory and functions."""

    splits = False
    nests = False

    def __init__(self, body: LoopBody, batched: Sequence[bool], lanes: int) -> None:
        """Translates a step; the arguments are those of `RowPlan`.

        `lanes` is the number of lanes of a vector.
        """
        self.lanes = lanes
        self.uniform = Storage("%uniform")
        self.single_scratch = 0
        self.transposed: set[str] = set()
        self.n_transposes = 0
        super().__init__(body, batched)

    def storage(self, pointer: str) -> Storage:
        """Returns an empty region of the workspace, with the name of its pointer."""
        return LaneStorage(pointer, self.lanes)

    def rate(self, which: int) -> int:
        """Returns the rate at which operand number `which` of the step changes.

        It is `UNIFORM` for a constant that all scenes share, `FIXED` for another
        constant, and `VARYING` for an array of the carry.
        """
        if which >= self.n_constants:
            return VARYING
        return FIXED if self.batched[which] else UNIFORM

    def places_of_constants(self) -> list[Place]:
        """Allocates the constants, and returns their memory locations."""
        return [
            (self.fixed if batched else self.uniform).give(
                kind_of(aval), math.prod(aval.shape)
            )
            for aval, batched in zip(self.constants, self.batched, strict=True)
        ]

    def hoist(self, goals: Sequence[Goal]) -> None:
        """Writes `@shared` and `@fixed`, which compute values that all steps share.

        `@shared` computes the values that all scenes share too, as rows do, `@fixed`
        those of each scene. Only values that the goals need are computed.
        """
        graph = self.graph
        self.know_data()
        nodes = hoisted(graph, [goal.node for goal in goals], self.ready)
        shared = [node for node in nodes if graph.rates[node] < FIXED]
        own = [node for node in nodes if graph.rates[node] >= FIXED]
        for node in shared:
            self.ready[node] = self.room_for(node, self.uniform)
        schedule = Schedule(graph, [], self.ready, shared)
        writer = RowWriter(graph, schedule, vector_bytes())
        self.texts.append(writer.text("shared", ["%scratch", "%uniform"]))
        self.single_scratch = schedule.size
        self.single_fills = writer.fills
        self._count(writer)
        for node in own:
            self.ready[node] = self.room_for(node, self.fixed)
        self.function("fixed", [], [], own)

    def _count(self, writer: Any) -> None:
        self.declared |= writer.declared
        self.needs |= writer.needs
        self.lines += writer.count
        if self.lines > MOST_LINES:
            raise NotUnrolled(f"a program of more than {MOST_LINES} lines is too long")

    def function(
        self,
        name: str,
        goals: Sequence[Goal],
        pointers: Sequence[str],
        stored: Sequence[int] = (),
    ) -> None:
        """Writes an LLVM function that computes nodes for a vector of scenes.

        The arguments are those of `RowPlan.function`. `pointers` are the arguments of
        the LLVM function after those in `REGIONS`.

        Raises:
            NotUnrolled: The kernel is too long.
        """
        lasting = self.lasting_place if goals else None
        kind = type("LaneSchedule", (LaneSchedule,), {"lanes": self.lanes})
        schedule = kind(self.graph, goals, self.ready, stored, lasting)
        writer = LaneWriter(self.graph, schedule, self.lanes)
        whole = ["%scratch", "%uniform", "%fixed", *pointers]
        self.texts.append(writer.text(name, whole))
        self.scratch = max(self.scratch, schedule.size)
        self.fills |= writer.fills
        self._count(writer)

    def fill_calls(self, given: str) -> list[str]:
        """Returns LLVM calls that write constants to the gaps of assembled nodes."""
        del given
        graph, lines = self.graph, []
        for node, place in self.lasting.items():
            kind, value = graph.kinds[node], graph.value(graph.arguments[node][-1])
            number = vector_literal(value, kind, self.lanes)
            self.fills.add(kind)
            lines += [
                lane_fill_call(number, place, kind, fill, self.lanes)
                for fill in fills_of(graph, node)
            ]
        return lines

    def transpose(
        self,
        word: str,
        aval: Any,
        array: str,
        region: str,
        place: Place,
        copies: bool = False,
    ) -> str:
        """Returns LLVM IR that copies an array between rows of scenes and vectors.

        Args:
            word: `"fetch"` to load an operand, `"bring"` to store a result.
            aval: Type of the array, for one scene.
            array: Name of the pointer to the operand or result.
            region: Name of the pointer to the region with the vectors.
            place: Location in the region.
            copies: Whether each scene has `%kept` copies, of which copy `%j` is moved.
        """
        self.n_transposes += 1
        kind, size = kind_of(aval), math.prod(aval.shape)
        self.transposed.add(kind)
        mark, stride, offset = f"%t{self.n_transposes}", str(size), "0"
        text = f"{mark} = getelementptr i8, ptr {region}, i64 "
        text += f"{place.offset * self.lanes}\n"
        if copies:
            text += f"{mark}s = mul i64 %kept, {size}\n{mark}o = mul i64 %j, {size}\n"
            stride, offset = f"{mark}s", f"{mark}o"
        name = f"{word}_squares" if is_tiled(kind, size, self.lanes) else word
        return text + (
            f"call void @{name}_{kind}(ptr {array}, i64 {stride}, i64 {offset}, "
            f"i64 {size}, i64 %first, i64 %rods, ptr {mark})\n"
        )

    def transposes(
        self,
        word: str,
        avals: Sequence[Any],
        places: Sequence[Place],
        first: int,
        region: str,
        copies: bool = False,
    ) -> str:
        """Returns LLVM IR that copies arrays between rows of scenes and vectors.

        They are operands or results from number `first` on. The other arguments are
        those of `transpose`.
        """
        side = "%in" if word == "fetch" else "%out"
        return "".join(
            self.transpose(word, aval, f"{side}{first + i}", region, place, copies)
            for i, (aval, place) in enumerate(zip(avals, places, strict=True))
        )

    def pointers(self, **sizes: int) -> tuple[str, int]:
        """Returns LLVM IR of pointers to regions of given sizes that follow `%fixed`.

        The keywords are the names of the pointers, their values the sizes of one lane
        [bytes].

        Returns:
            The text, and the size of the workspace up to the last region [bytes].
        """
        start, lines = self._start(), []
        for name, size in sizes.items():
            lines.append(f"%{name} = getelementptr i8, ptr %room, i64 {start}\n")
            start += self.bytes(size)
        return "".join(lines), start

    def bytes(self, size: int) -> int:
        """Size of a region of `size` bytes in each lane, rounded up [bytes]."""
        return -(-size * self.lanes // 64) * 64

    def _scratch(self) -> int:
        return max(self.bytes(self.scratch), -(-self.single_scratch // 64) * 64)

    def _start(self) -> int:
        return self._scratch() + self.uniform.size + self.bytes(self.fixed.size)

    def module(self, per_scene: str, n_operands: int, n_results: int) -> str:
        """Returns the LLVM module of the kernel, without the handler that XLA calls.

        `per_scene` is the LLVM IR that runs for each vector of scenes, once its
        constants are loaded.
        """
        functions, more = elementary_texts(self.needs)
        texts, declared = [*functions, self.lasting_fills()], self.declared | more
        texts += [lane_fill_text(kind, self.lanes) for kind in self._filled()]
        texts += map(fill_text, sorted(self.single_fills))
        same = "".join(
            self.fetch(1 + i, aval, place, False)
            for i, (aval, place) in enumerate(
                zip(self.constants, self.constant_places, strict=True)
            )
            if is_single(place)
        )
        own = "".join(
            self.transpose("fetch", aval, f"%in{1 + i}", "%fixed", place)
            for i, (aval, place) in enumerate(
                zip(self.constants, self.constant_places, strict=True)
            )
            if not is_single(place)
        )
        for kind in sorted(self.transposed):
            text, more = transpose_text(kind, self.lanes)
            texts.append(text)
            declared |= more
        scratch, uniform = self._scratch(), self.uniform.size
        main = f"""
define void @kernel(ptr %operands, ptr %results) nounwind {{
entry:
{entry_text(n_operands, n_results)}
%raw = ptrtoint ptr %out{n_results - 1} to i64
%raised = add i64 %raw, 63
%aligned = and i64 %raised, -64
%room = inttoptr i64 %aligned to ptr
%scratch = getelementptr i8, ptr %room, i64 0
%uniform = getelementptr i8, ptr %room, i64 {scratch}
%fixed = getelementptr i8, ptr %room, i64 {scratch + uniform}
{same}
call void @shared(ptr %scratch, ptr %uniform)
br label %blocks_test
blocks_test:
%first = phi i64 [0, %entry], [%following, %block_done]
%inside = icmp slt i64 %first, %rods
br i1 %inside, label %blocks, label %done
blocks:
{own}
call void @fixed({REGIONS})
call void @fills(ptr %fixed)
{per_scene}
br label %block_done
block_done:
%following = add i64 %first, {self.lanes}
br label %blocks_test
done:
ret void
}}
"""
        return "\n".join([*sorted(declared), *texts, *self.texts, main])

    def _filled(self) -> list[str]:
        """Types of numbers with fill functions, one for each type in memory."""
        by_memory = {"u8": "i8", "b1": "i8", "u16": "i16", "u32": "i32", "u64": "i64"}
        return sorted({by_memory.get(kind, kind) for kind in self.fills})


@lru_cache(maxsize=64)
def cycles_in_lanes(
    body: LoopBody, batched: tuple[bool, ...], lanes: int, *, checkpoints: bool
) -> Kernel:
    """Returns the kernel that repeats a step, with a scene in each lane.

    Operands and results are those of `lanes.llvm.kernel.step_kernel`. `batched` tells
    which constants differ between scenes.
    """
    plan = LanePlan(body, batched, lanes)
    goals = next_carry(plan)
    plan.hoist(goals)
    plan.function("step", goals, ["%now", "%then"])
    n_carry, first = len(plan.carry), 1 + plan.n_constants
    carry = plan.carry, plan.carry_places
    regions, room = plan.pointers(now0=plan.now.size, then0=plan.now.size)
    marks = ""
    if checkpoints:
        marks = plan.transposes("bring", *carry, n_carry, "%now1", True)
    text = f"""{regions}
{plan.transposes("fetch", *carry, first, "%now0")}
{forward_loops("blocks", REGIONS, marks)}
{plan.transposes("bring", *carry, 0, "%now1")}"""
    n_results = n_carry * (2 if checkpoints else 1) + 1
    module = plan.module(text, first + n_carry, n_results)
    return Kernel(module, first + n_carry, n_results, room, 0, plan.lines)


@lru_cache(maxsize=64)
def run_in_lanes(
    body: LoopBody, ends: Ends, batched: tuple[bool, ...], lanes: int
) -> Kernel:
    """Returns the kernel of a whole run, with a scene in each lane.

    Operands and results are those of `lanes.llvm.kernel.run_kernel`. `batched` tells
    which constants differ between scenes.
    """
    plan = LanePlan(body, batched, lanes)
    n = plan.n_constants
    avals = ends.given[n:]
    given, made = plan.storage("%given"), plan.storage("%made")
    first = n + len(plan.carry)
    arguments = [plan.input(first + i, aval, VARYING) for i, aval in enumerate(avals)]
    given_places, made_places = given.all(avals), made.all(ends.made)
    plan.stand(first, given_places)
    begun = plan.unroller.run(ends.begin, [*plan.inputs[:n], *arguments])
    ended = plan.unroller.run(ends.end, plan.inputs)
    step = next_carry(plan)
    start = [Place("%then", place.offset) for place in plan.carry_places]
    begin, end = plan.goals(begun, start), plan.goals(ended, made_places)
    plan.hoist([*step, *begin, *end])
    plan.function("step", step, ["%now", "%then"])
    plan.function("begin", begin, ["%given", "%then"])
    plan.function("end", end, ["%now", "%made"])
    size = plan.now.size
    regions, room = plan.pointers(
        now0=size, then0=size, given=given.size, made=made.size
    )
    text = f"""{regions}
{plan.transposes("fetch", avals, given_places, 1 + n, "%given")}
call void @begin({REGIONS}, ptr %given, ptr %now0)
{forward_loops("blocks", REGIONS)}
call void @end({REGIONS}, ptr %now1, ptr %made)
{plan.transposes("bring", ends.made, made_places, 0, "%made")}"""
    n_operands, n_results = 1 + n + len(avals), len(ends.made) + 1
    module = plan.module(text, n_operands, n_results)
    return Kernel(module, n_operands, n_results, room, 0, plan.lines)


@lru_cache(maxsize=64)
def back_in_lanes(
    body: LoopBody, moving: tuple[bool, ...], batched: tuple[bool, ...], lanes: int
) -> Kernel:
    """Returns the kernel of the reverse pass, with a scene in each lane.

    Operands: counts, constants, checkpoints, cotangents of the last carry. Results:
    cotangents of the first carry and of constants; workspace.

    Args:
        body: The step.
        moving: Whether each constant has a tangent.
        batched: Whether each constant differs between scenes.
        lanes: Number of lanes of a vector.
    """
    plan = LanePlan(body, batched, lanes)
    n, n_carry = plan.n_constants, len(plan.carry)
    avals, n_seeds, before, before_places, step, back = plan.reverse(moving)
    plan.hoist([*step, *back])
    plan.function("step", step, ["%now", "%then"])
    plan.function("adjoint", back, ["%now", "%before", "%after"])
    first_mark, first_seed = 1 + n, 1 + n + n_carry
    regions, room = plan.pointers(back0=before.size, other0=before.size, kept0=0)
    size = plan.bytes(plan.now.size)
    carry = plan.carry, plan.carry_places
    marks = plan.transposes("fetch", *carry, first_mark, "%kept0", True)
    seeds = plan.transposes(
        "fetch", avals[:n_seeds], before_places[:n_seeds], first_seed, "%back0"
    )
    zeros = plan.bytes(before.size)
    text = f"""{regions}
call void @llvm.memset.p0.i64(ptr %back0, i8 0, i64 {zeros}, i1 false)
{seeds}
{backward_loops("blocks", REGIONS, size, marks)}
{plan.transposes("bring", avals, before_places, 0, "%back1")}"""
    n_operands, n_results = first_seed + n_seeds, len(avals) + 1
    module = plan.module(text, n_operands, n_results)
    return Kernel(module, n_operands, n_results, room, size, plan.lines)

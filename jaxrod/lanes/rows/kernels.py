"""Kernels of rows: LLVM IR that runs all steps of one scene after another.

The number of steps and of scenes are arguments, so one kernel serves any number of
them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

from jaxrod.jax_internals.equations import operand_types, result_types
from jaxrod.lanes.graph import FIXED, VARYING
from jaxrod.lanes.jaxpr.unroll import kind_of
from jaxrod.lanes.llvm.elementary import elementary_texts
from jaxrod.lanes.llvm.kernel import Kernel, backward_loops, forward_loops
from jaxrod.lanes.llvm.kernel_plan import entry_text
from jaxrod.lanes.llvm.vector_code import BYTES
from jaxrod.lanes.rows.functions import RowFunctions, Storage
from jaxrod.lanes.rows.loop_code import fill_text
from jaxrod.lanes.rows.nested import nested_loop
from jaxrod.lanes.rows.schedule import Goal, Place
from jaxrod.lanes.run_spec import Ends, LoopBody, RunSpec, adjoint_body

GIVEN = "ptr %scratch, ptr %fixed"
"""LLVM text of the first arguments of `@step` and `@adjoint`: pointers to scratch
memory, and to values that all steps share."""


class Reverse(NamedTuple):
    """A reversed step (vector-Jacobian product), and the memory of its cotangents."""

    avals: Sequence[Any]
    """Types of the cotangents: of the carry, then of the constants that have
    tangents."""
    n_seeds: int
    """Number of seeds, the given cotangents of the carry after the last step.
    Cotangents of constants are sums over the steps, which begin at zero."""
    before: Storage
    """Region of the cotangents after the step, which the reversed step reads."""
    places: list[Place]
    """Locations of the cotangents in `before`. The cotangents before the step have the
    same offsets, in another region."""
    step: list[Goal]
    """Nodes of the next carry, with the locations where they are written."""
    back: list[Goal]
    """Nodes of the cotangents before the step, with the locations where they are
    written."""


class RowPlan(RowFunctions):
    """A kernel for scenes one by one, under construction: memory and LLVM functions."""

    nests = True
    """Whether loops within a step may become functions of their own."""

    def __init__(self, body: LoopBody, batched: Sequence[bool]) -> None:
        """Translates a step to a graph, and allocates its constants and carry.

        Args:
            body: The step.
            batched: Whether each constant differs between scenes, and so has a leading
                axis.
        """
        super().__init__()
        if self.nests:
            self.unroller.nest = partial(nested_loop, self)
        self.body = body
        avals = operand_types(body.closed)
        n = self.n_constants = body.n_constants
        self.constants, self.carry = avals[:n], avals[n:]
        self.batched = list(batched)
        self.now = self.storage("%now")
        self.inputs = [
            self.input(i, aval, self.rate(i)) for i, aval in enumerate(avals)
        ]
        self.constant_places = self.places_of_constants()
        self.carry_places = self.now.all(self.carry)
        self.stand(0, [*self.constant_places, *self.carry_places])
        self.made = self.unroller.run(body.closed, self.inputs)

    def rate(self, which: int) -> int:
        """Returns the rate at which operand number `which` of the step changes.

        It is `FIXED` for a constant and `VARYING` for an array of the carry.
        """
        return FIXED if which < self.n_constants else VARYING

    def places_of_constants(self) -> list[Place]:
        """Allocates the constants, and returns their memory locations."""
        return self.fixed.all(self.constants)

    def reverse(self, moving: Sequence[bool]) -> Reverse:
        """Translates the vector-Jacobian product of the step.

        Args:
            moving: Whether each constant has a tangent.
        """
        closed = adjoint_body(RunSpec(self.body, 0, tuple(moving)))
        avals = result_types(closed)
        n_seeds = sum(self.body.floating)
        before, after = self.storage("%before"), self.storage("%after")
        first = self.n_constants + len(self.carry)
        given = [self.input(first + i, aval, VARYING) for i, aval in enumerate(avals)]
        places = before.all(avals)
        self.stand(first, places)
        made = self.unroller.run(closed, [*self.inputs, *given[:n_seeds]])
        totals = [
            self.unroller.each("add", old.kind, old, new)
            for old, new in zip(given[n_seeds:], made[n_seeds:], strict=True)
        ]
        back = self.goals([*made[:n_seeds], *totals], after.all(avals))
        return Reverse(avals, n_seeds, before, places, next_carry(self), back)

    def module(self, per_scene: str, n_operands: int, n_results: int) -> str:
        """Returns the LLVM module of the kernel, without the handler that XLA calls.

        `per_scene` is the LLVM IR that runs for each scene, once its constants are
        loaded.
        """
        functions, more = elementary_texts(self.needs)
        self.texts.append(self.lasting_fills())
        texts = [*map(fill_text, sorted(self.fills)), *functions, *self.texts]
        constants = "".join(
            self.fetch(1 + i, aval, place, self.batched[i])
            for i, (aval, place) in enumerate(
                zip(self.constants, self.constant_places, strict=True)
            )
        )
        main = f"""
define void @kernel(ptr %operands, ptr %results) nounwind {{
entry:
{entry_text(n_operands, n_results)}
%raw = ptrtoint ptr %out{n_results - 1} to i64
%raised = add i64 %raw, 63
%aligned = and i64 %raised, -64
%room = inttoptr i64 %aligned to ptr
%scratch = getelementptr i8, ptr %room, i64 0
%fixed = getelementptr i8, ptr %room, i64 {self.scratch}
br label %scenes_test
scenes_test:
%scene = phi i64 [0, %entry], [%following, %scene_done]
%inside = icmp slt i64 %scene, %rods
br i1 %inside, label %scenes, label %done
scenes:
{constants}
call void @fixed(ptr %scratch, ptr %fixed)
call void @fills(ptr %fixed)
{per_scene}
br label %scene_done
scene_done:
%following = add i64 %scene, 1
br label %scenes_test
done:
ret void
}}
"""
        return "\n".join([*sorted(self.declared | more), *texts, main])

    def fetch(
        self, operand: int, aval: Any, place: Place, batched: bool, row: str = "%scene"
    ) -> str:
        """Returns LLVM IR that copies operand number `operand` to the workspace.

        `aval` is its type for one scene, `place` the location of the copy. If the
        operand is batched, `row` is the index along its leading axis.
        """
        size = math.prod(aval.shape) * BYTES[kind_of(aval)]
        mark = f"%f{operand}"
        source = f"%in{operand}"
        text = ""
        if batched:
            text += f"{mark}r = mul i64 {row}, {size}\n"
            text += f"{mark}s = getelementptr i8, ptr {source}, i64 {mark}r\n"
            source = f"{mark}s"
        return text + (
            f"{mark}t = getelementptr i8, ptr {place.pointer}, i64 {place.offset}\n"
            f"call void @llvm.memcpy.p0.p0.i64(ptr {mark}t, ptr {source}, i64 {size}, "
            "i1 false)\n"
        )

    def bring(
        self, result: int, aval: Any, place: Place, region: str, row: str = "%scene"
    ) -> str:
        """Returns LLVM IR that copies an array of the workspace to a row of a result.

        The array has the type `aval`, and the offset of `place` in the region with
        pointer `region`. It becomes row `row` of result number `result`.
        """
        size = math.prod(aval.shape) * BYTES[kind_of(aval)]
        mark = f"%b{result}"
        return (
            f"{mark}r = mul i64 {row}, {size}\n"
            f"{mark}t = getelementptr i8, ptr %out{result}, i64 {mark}r\n"
            f"{mark}s = getelementptr i8, ptr {region}, i64 {place.offset}\n"
            f"call void @llvm.memcpy.p0.p0.i64(ptr {mark}t, ptr {mark}s, i64 {size}, "
            "i1 false)\n"
        )


@lru_cache(maxsize=64)
def cycles_kernel(
    body: LoopBody, batched: tuple[bool, ...], *, checkpoints: bool
) -> Kernel:
    """Returns the kernel that repeats a step, for one scene after another.

    Operands and results are those of `lanes.llvm.kernel.step_kernel`. `batched` tells
    which constants differ between scenes.
    """
    plan = RowPlan(body, batched)
    goals = next_carry(plan)
    plan.hoist(goals)
    plan.function("step", goals, ["%fixed", "%now", "%then"])
    n_carry, first = len(plan.carry), 1 + plan.n_constants
    regions, room = _pointers(plan, now0=plan.now.size, then0=plan.now.size)
    fetches = "".join(
        plan.fetch(first + i, aval, Place("%now0", place.offset), True)
        for i, (aval, place) in enumerate(
            zip(plan.carry, plan.carry_places, strict=True)
        )
    )
    marks = "".join(
        plan.bring(n_carry + i, aval, place, "%now1", "%mark")
        for i, (aval, place) in enumerate(
            zip(plan.carry, plan.carry_places, strict=True)
        )
    )
    if checkpoints:
        marks = f"%mark0 = mul i64 %scene, %kept\n%mark = add i64 %mark0, %j\n{marks}"
    brings = "".join(
        plan.bring(i, aval, place, "%now1")
        for i, (aval, place) in enumerate(
            zip(plan.carry, plan.carry_places, strict=True)
        )
    )
    loops = forward_loops("scenes", GIVEN, marks if checkpoints else "")
    text = f"{regions}{fetches}{loops}{brings}"
    n_results = n_carry * (2 if checkpoints else 1) + 1
    n_operands = first + n_carry
    module = plan.module(text, n_operands, n_results)
    return Kernel(module, n_operands, n_results, room, 0, plan.lines)


@lru_cache(maxsize=64)
def whole_run_kernel(body: LoopBody, ends: Ends, batched: tuple[bool, ...]) -> Kernel:
    """Returns the kernel of a whole run, for one scene after another.

    Operands and results are those of `lanes.llvm.kernel.run_kernel`. `batched` tells
    which constants differ between scenes.
    """
    plan = RowPlan(body, batched)
    n = plan.n_constants
    avals = ends.given[n:]
    given, made = Storage("%given"), Storage("%made")
    first_given = n + len(plan.carry)
    arguments = [
        plan.input(first_given + i, aval, VARYING) for i, aval in enumerate(avals)
    ]
    given_places, made_places = given.all(avals), made.all(ends.made)
    plan.stand(first_given, given_places)
    begun = plan.unroller.run(ends.begin, [*plan.inputs[:n], *arguments])
    ended = plan.unroller.run(ends.end, plan.inputs)
    step = next_carry(plan)
    start = [Place("%then", place.offset) for place in plan.carry_places]
    begin, end = plan.goals(begun, start), plan.goals(ended, made_places)
    plan.hoist([*step, *begin, *end])
    plan.function("step", step, ["%fixed", "%now", "%then"])
    plan.function("begin", begin, ["%fixed", "%given", "%then"])
    plan.function("end", end, ["%fixed", "%now", "%made"])
    regions, room = _pointers(
        plan, now0=plan.now.size, then0=plan.now.size, given=given.size, made=made.size
    )
    fetches = "".join(
        plan.fetch(1 + n + i, aval, place, True)
        for i, (aval, place) in enumerate(zip(avals, given_places, strict=True))
    )
    brings = "".join(
        plan.bring(i, aval, place, "%made")
        for i, (aval, place) in enumerate(zip(ends.made, made_places, strict=True))
    )
    text = f"""{regions}{fetches}
call void @begin(ptr %scratch, ptr %fixed, ptr %given, ptr %now0)
{forward_loops("scenes", GIVEN)}
call void @end(ptr %scratch, ptr %fixed, ptr %now1, ptr %made)
{brings}"""
    n_operands, n_results = 1 + n + len(avals), len(ends.made) + 1
    module = plan.module(text, n_operands, n_results)
    return Kernel(module, n_operands, n_results, room, 0, plan.lines)


@lru_cache(maxsize=64)
def back_kernel(
    body: LoopBody, moving: tuple[bool, ...], batched: tuple[bool, ...]
) -> Kernel:
    """Returns the kernel of the reverse pass, for one scene after another.

    Operands and results are those of `lanes.looped.kernels.back_in_lanes`. `moving`
    tells which constants have tangents, `batched` which differ between scenes.
    """
    plan = RowPlan(body, batched)
    n = plan.n_constants
    avals, n_seeds, before, before_places, step, back = plan.reverse(moving)
    plan.hoist([*step, *back])
    plan.function("step", step, ["%fixed", "%now", "%then"])
    plan.function("adjoint", back, ["%fixed", "%now", "%before", "%after"])
    size = plan.now.size
    regions, room = _pointers(plan, back0=before.size, other0=before.size, kept0=0)
    n_carry, first_mark = len(plan.carry), 1 + n
    marks = "%mark0 = mul i64 %scene, %kept\n%mark = add i64 %mark0, %j\n" + "".join(
        plan.fetch(first_mark + i, aval, Place("%kept0", p.offset), True, "%mark")
        for i, (aval, p) in enumerate(zip(plan.carry, plan.carry_places, strict=True))
    )
    first_seed = first_mark + n_carry
    seeds = "".join(
        plan.fetch(first_seed + i, aval, Place("%back0", p.offset), True)
        for i, (aval, p) in enumerate(
            zip(avals[:n_seeds], before_places[:n_seeds], strict=True)
        )
    )
    brings = "".join(
        plan.bring(i, aval, place, "%back1")
        for i, (aval, place) in enumerate(zip(avals, before_places, strict=True))
    )
    text = f"""{regions}
call void @llvm.memset.p0.i64(ptr %back0, i8 0, i64 {before.size}, i1 false)
{seeds}
{backward_loops("scenes", GIVEN, size, marks)}
{brings}"""
    n_operands, n_results = first_seed + n_seeds, len(avals) + 1
    module = plan.module(text, n_operands, n_results)
    return Kernel(module, n_operands, n_results, room, size, plan.lines)


def next_carry(plan: RowPlan) -> list[Goal]:
    """Returns the nodes of the next carry, each with its memory location."""
    then = [Place("%then", place.offset) for place in plan.carry_places]
    return plan.goals(plan.made, then)


def _pointers(plan: RowPlan, **sizes: int) -> tuple[str, int]:
    """Returns LLVM IR of pointers to regions of given sizes that follow `%fixed`.

    The keywords are the names of the pointers, their values the sizes [bytes].

    Returns:
        The text, and the size of the workspace up to the last region [bytes].
    """
    start, lines = plan.scratch + plan.fixed.size, []
    for name, size in sizes.items():
        lines.append(f"%{name} = getelementptr i8, ptr %room, i64 {start}\n")
        start += size
    return "".join(lines), start

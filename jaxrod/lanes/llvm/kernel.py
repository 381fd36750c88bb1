"""Kernels with a rod in each vector lane: LLVM IR of all steps of a batch.

A kernel loops over blocks of as many rods as a vector has lanes. For each block it
loads the rods' numbers, repeats the step, and stores the results. The number of steps
and of rods are arguments, so one kernel serves any number of them.
"""

from __future__ import annotations

from dataclasses import dataclass

from jaxrod.lanes.graph import EndNodes, Step
from jaxrod.lanes.llvm.kernel_plan import KernelPlan, Region, goals_in


@dataclass(frozen=True)
class Kernel:
    """A kernel in LLVM IR, and the sizes that its call needs.

    Its first operand holds four counts (`int32`): steps, steps between checkpoints,
    rods, checkpoints. The other operands are the arrays of the program. Its results are
    those of the program, followed by a workspace.
    """

    text: str
    """LLVM IR of the kernel."""
    n_operands: int
    """Number of operands, including the first one, the array of counts."""
    n_results: int
    """Number of results, including the last one, the workspace."""
    room: int
    """Size of the workspace [bytes], without the carries that the reverse pass
    recomputes between checkpoints."""
    kept: int
    """Size of each carry that the reverse pass recomputes [bytes]; 0 in kernels of the
    forward pass."""
    operations: int
    """Size of the program. Lanes: number of graph nodes, with inputs and constants.
    Rows: lines of LLVM IR that compute a value."""


def step_kernel(step: Step, width: int, *, checkpoints: bool) -> Kernel:
    """Returns the kernel that repeats a step, with a rod in each vector lane.

    Operands: counts, constants, carry. Results: carry after all steps, checkpoints,
    workspace. Checkpoints are the carries before steps 0, s, 2s, ..., where s is the
    number of steps between them.

    Args:
        step: The step.
        width: Lanes of a vector, one for each rod.
        checkpoints: Whether checkpoints are among the results.
    """
    plan = KernelPlan(step, width)
    now, then, places = plan.carry_buffers()
    plan.prepare([node for nodes in step.outputs for node in nodes])
    goals = goals_in(step.outputs, step.carry, then, places)
    plan.write_function("step", goals, [now, then])
    n_carry, first_carry = len(step.carry), 1 + len(step.constants)
    marks = "".join(
        plan.transpose(
            "bring", entries, f"%out{n_carry + i}", "%now1", place, "%kept", "%j"
        )
        for i, (entries, place) in enumerate(zip(step.carry, places, strict=True))
    )
    start = plan.regions()
    text = f"""
{plan.fetch_own()}
{plan.pointers(start, now0=now, then0=then)}
{plan.fetch_all(step.carry, places, first_carry, "%now0")}
call void @fixed(ptr %shared, ptr %own)
{forward_loops("blocks", "ptr %shared, ptr %own", marks if checkpoints else "")}
{plan.bring_all(step.carry, places, "%now1")}
br label %block_done
"""
    n_operands = first_carry + n_carry
    n_results = n_carry * (2 if checkpoints else 1) + 1
    module = plan.module(text, n_operands, n_results)
    room = start + now.room() + then.room()
    return Kernel(module, n_operands, n_results, room, 0, plan.operations)


def run_kernel(step: Step, ends: EndNodes, width: int) -> Kernel:
    """Returns the kernel of a whole run, with a rod in each vector lane.

    A run consists of its beginning, the steps and its end.

    Operands: counts, constants, arguments of the run. Results: those of the run, and
    the workspace.

    Args:
        step: The step.
        ends: Beginning and end of the run.
        width: Lanes of a vector, one for each rod.
    """
    plan = KernelPlan(step, width)
    now, then, places = plan.carry_buffers()
    given, made = Region("%given", width), Region("%made", width)
    given_places = [given.place(e.kind, e.size) for e in ends.given]
    made_places = [made.place(e.kind, e.size) for e in ends.made]
    first_given = len(step.constants) + len(step.carry)
    for i, place in enumerate(given_places):
        plan.memory.arrays[first_given + i] = given, place
    every_output = (*step.outputs, *ends.begun, *ends.ended)
    plan.prepare([node for nodes in every_output for node in nodes])
    goals = goals_in(step.outputs, step.carry, then, places)
    plan.write_function("step", goals, [now, then])
    goals = goals_in(ends.begun, step.carry, now, places)
    plan.write_function("begin", goals, [given, now])
    goals = goals_in(ends.ended, ends.made, made, made_places)
    plan.write_function("end", goals, [now, made])
    first = 1 + len(step.constants)
    start = plan.regions()
    text = f"""
{plan.fetch_own()}
{plan.pointers(start, now0=now, then0=then, given=given, made=made)}
{plan.fetch_all(ends.given, given_places, first, "%given")}
call void @fixed(ptr %shared, ptr %own)
call void @begin(ptr %shared, ptr %own, ptr %given, ptr %now0)
{forward_loops("blocks", "ptr %shared, ptr %own")}
call void @end(ptr %shared, ptr %own, ptr %now1, ptr %made)
{plan.bring_all(ends.made, made_places, "%made")}
br label %block_done
"""
    n_operands, n_results = first + len(ends.given), len(ends.made) + 1
    module = plan.module(text, n_operands, n_results)
    room = start + sum(region.room() for region in (now, then, given, made))
    return Kernel(module, n_operands, n_results, room, 0, plan.operations)


def forward_loops(entry: str, given: str, marks: str = "") -> str:
    """Returns LLVM IR that calls `@step` for all steps and stores checkpoints.

    `%now0` points to the first carry, and `%then0` to a second buffer. After the loops,
    `%now1` points to the last carry.

    Args:
        entry: Label of the block before the loops.
        given: Arguments of `@step` before the two carries.
        marks: LLVM IR that stores a checkpoint; empty without checkpoints.
    """
    return f"""
br label %segments
segments:
%j = phi i64 [0, %{entry}], [%j1, %segment_done]
%now1 = phi ptr [%now0, %{entry}], [%now2, %segment_done]
%then1 = phi ptr [%then0, %{entry}], [%then2, %segment_done]
%begun = mul i64 %j, %every
%rest = sub i64 %steps, %begun
%length = call i64 @llvm.smin.i64(i64 %rest, i64 %every)
%some = icmp sgt i64 %rest, 0
br i1 %some, label %segment, label %finished
segment:
{marks}
br label %steps_loop
steps_loop:
%i = phi i64 [0, %segment], [%i1, %steps_loop]
%now = phi ptr [%now1, %segment], [%then, %steps_loop]
%then = phi ptr [%then1, %segment], [%now, %steps_loop]
call void @step({given}, ptr %now, ptr %then)
%i1 = add i64 %i, 1
%more = icmp slt i64 %i1, %length
br i1 %more, label %steps_loop, label %segment_done
segment_done:
%now2 = phi ptr [%then, %steps_loop]
%then2 = phi ptr [%now, %steps_loop]
%j1 = add i64 %j, 1
br label %segments
finished:
"""


def backward_loops(entry: str, given: str, size: int, marks: str) -> str:
    """Returns LLVM IR of the reverse pass: `@step` and `@adjoint` for all steps.

    For each segment between checkpoints, from the last to the first, the carries are
    recomputed by `@step`; then `@adjoint` is called for each step, from the last. After
    the loops, `%back1` points to the cotangents of the first carry.

    Args:
        entry: Label of the block before the loops.
        given: First arguments of `@step` and `@adjoint`.
        size: Size of a carry [bytes].
        marks: LLVM IR that loads a checkpoint.
    """
    return f"""
%j0 = sub i64 %kept, 1
br label %segments
segments:
%j = phi i64 [%j0, %{entry}], [%j1, %segment_done]
%back1 = phi ptr [%back0, %{entry}], [%back2, %segment_done]
%other1 = phi ptr [%other0, %{entry}], [%other2, %segment_done]
%some = icmp sge i64 %j, 0
br i1 %some, label %segment, label %finished
segment:
%begun = mul i64 %j, %every
%rest = sub i64 %steps, %begun
%length = call i64 @llvm.smin.i64(i64 %rest, i64 %every)
{marks}
%last = sub i64 %length, 1
br label %again_test
again_test:
%i = phi i64 [0, %segment], [%i1, %again]
%now = phi ptr [%kept0, %segment], [%then, %again]
%left = icmp slt i64 %i, %last
br i1 %left, label %again, label %back
again:
%then = getelementptr i8, ptr %now, i64 {size}
call void @step({given}, ptr %now, ptr %then)
%i1 = add i64 %i, 1
br label %again_test
back:
%k = phi i64 [%last, %again_test], [%k1, %back]
%here = phi ptr [%now, %again_test], [%here1, %back]
%ct = phi ptr [%back1, %again_test], [%earlier, %back]
%earlier = phi ptr [%other1, %again_test], [%ct, %back]
call void @adjoint({given}, ptr %here, ptr %ct, ptr %earlier)
%here1 = getelementptr i8, ptr %here, i64 {-size}
%k1 = sub i64 %k, 1
%more = icmp sge i64 %k1, 0
br i1 %more, label %back, label %segment_done
segment_done:
%back2 = phi ptr [%earlier, %back]
%other2 = phi ptr [%ct, %back]
%j1 = sub i64 %j, 1
br label %segments
finished:
"""

"""Places in a source where a small fault can be planted, and the faults.

A fault changes one operator, comparison, sign, index or number, exchanges min and max,
or drops a term. Text and refusals are left out by rule, see `OUTSIDE`.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass

OUTSIDE = re.compile(r"^_?(check|validate|refuse)|^__|words|^_?describe|^_?parser$")
"""Functions that check, refuse or speak: their numbers are limits and text."""
CHECKS = re.compile(r"^_?check|^(as_array|as_timed\w*|optional_number|numeric|print)$")
"""Calls whose arguments are names, units and limits."""
LIMITS = re.compile(r"^_?(MOST|LEAST|FEWEST|LARGEST|SMALLEST|LIMIT|VERSION|__)")
"""Constants at the top of a file that are limits."""
NO_NUMBERS = {"repr.py", "text.py", "captions.py", "field_meanings.py", "__main__.py"}
"""Files of text alone."""

OPERATORS = {
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"),
    ast.Div: ("/", "*"),
}
COMPARISONS = {
    ast.Lt: ("<", (">=", "<=")),
    ast.LtE: ("<=", (">", "<")),
    ast.Gt: (">", ("<=", ">=")),
    ast.GtE: (">=", ("<", ">")),
    ast.Eq: ("==", ("!=",)),
    ast.NotEq: ("!=", ("==",)),
}
EXCHANGED = {
    "min": "max",
    "max": "min",
    "minimum": "maximum",
    "maximum": "minimum",
    "argmin": "argmax",
    "argmax": "argmin",
}


@dataclass(frozen=True)
class Fault:
    """One change of a source, between two places in its text."""

    start: int
    end: int
    new: str
    kind: str
    function: str
    """The innermost function around it; empty at the top of the file."""

    def planted(self, source: str) -> str:
        """The source with the fault."""
        return source[: self.start] + self.new + source[self.end :]

    def line(self, source: str) -> int:
        """Number of the line, from 1."""
        return source.count("\n", 0, self.start) + 1

    def words(self, source: str) -> str:
        """The change, on one line."""
        old, number = source[self.start : self.end], self.line(source)
        whole = source.splitlines()[number - 1].strip()
        return f"`{_short(old)}` -> `{_short(self.new)}` in `{_short(whole, 70)}`"


def _short(text: str, most: int = 40) -> str:
    text = " ".join(text.split()).replace("|", "¦").replace("`", "'")
    return text if len(text) <= most else text[: most - 3] + "..."


def faults(source: str) -> list[Fault]:
    """Every fault that the rules allow in a source, in the order of its text."""
    lines = source.splitlines(keepends=True)
    starts = [0]
    for line in lines:
        starts.append(starts[-1] + len(line))

    def place(line: int, column: int) -> int:
        # The columns of a syntax tree count bytes.
        return starts[line - 1] + len(lines[line - 1].encode()[:column].decode())

    tree = ast.parse(source)
    found = []
    for node, function, in_index in _reached(tree, "", False):
        start, end = (
            place(node.lineno, node.col_offset),
            place(node.end_lineno, node.end_col_offset),
        )
        for a, b, new, kind in _changes(node, source, place, in_index):
            assert start <= a <= b <= end
            found.append(Fault(a, b, new, kind, function))
    return sorted(set(found), key=lambda f: (f.start, f.end, f.new))


def _reached(
    node: ast.AST, function: str, in_index: bool
) -> Iterator[tuple[ast.expr, str, bool]]:
    """Expressions that are no text, no type, no refusal; with what is around them."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        if OUTSIDE.search(node.name):
            return
        for child in node.body:
            yield from _reached(child, node.name, False)
        return
    if isinstance(node, ast.ClassDef):
        # Numbers of its fields are choices, those of its functions are not.
        for child in node.body:
            if isinstance(child, ast.FunctionDef | ast.ClassDef):
                yield from _reached(child, function, False)
        return
    if isinstance(node, ast.Raise | ast.Assert | ast.JoinedStr | ast.Import):
        return
    if isinstance(node, ast.If) and _refuses(node):
        return
    if isinstance(node, ast.AnnAssign):
        if node.value is not None:
            yield from _reached(node.value, function, in_index)
        return
    if isinstance(node, ast.Assign) and any(
        isinstance(t, ast.Name) and LIMITS.search(t.id) for t in node.targets
    ):
        return
    if isinstance(node, ast.Call) and CHECKS.search(_called(node)):
        return
    if isinstance(node, ast.Lambda):
        yield from _reached(node.body, function, False)
        return
    if isinstance(node, ast.expr):
        yield node, function, in_index
    if isinstance(node, ast.Subscript):
        yield from _reached(node.value, function, False)
        yield from _reached(node.slice, function, True)
        return
    inner = in_index and isinstance(node, ast.Tuple | ast.Slice | ast.UnaryOp)
    for child in ast.iter_child_nodes(node):
        yield from _reached(child, function, inner)


def _refuses(node: ast.If) -> bool:
    """Whether a condition leads to a refusal, or is about types alone."""
    if "TYPE_CHECKING" in ast.dump(node.test):
        return True
    return not node.orelse and isinstance(node.body[-1], ast.Raise)


def _called(node: ast.Call) -> str:
    function = node.func
    if isinstance(function, ast.Attribute):
        return function.attr
    return function.id if isinstance(function, ast.Name) else ""


def _changes(
    node: ast.expr, source: str, place, in_index: bool
) -> Iterator[tuple[int, int, str, str]]:
    """Beginning, end, new text and kind of each fault of one expression."""

    def ends(inner: ast.expr) -> tuple[int, int]:
        return (
            place(inner.lineno, inner.col_offset),
            place(inner.end_lineno, inner.end_col_offset),
        )

    start, end = ends(node)
    if isinstance(node, ast.BinOp) and type(node.op) in OPERATORS:
        old, new = OPERATORS[type(node.op)]
        after, before = ends(node.left)[1], ends(node.right)[0]
        between = source[after:before]
        if "#" in between or _is_text(node.left) or _is_text(node.right):
            return
        at = after + between.index(old)
        yield at, at + len(old), new, "operator"
        if old in "+-":
            # The rest stays as it is, brackets too.
            yield at, end, "", "dropped term"
    elif isinstance(node, ast.Compare) and len(node.ops) == 1:
        if type(node.ops[0]) not in COMPARISONS:
            return
        if _is_text(node.comparators[0]) or _is_text(node.left):
            return
        old, others = COMPARISONS[type(node.ops[0])]
        after, before = ends(node.left)[1], ends(node.comparators[0])[0]
        if "#" in source[after:before]:
            return
        at = after + source[after:before].index(old)
        for new in others:
            yield at, at + len(old), new, "comparison"
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        if not (in_index and isinstance(node.operand, ast.Constant)):
            yield start, start + 1, "", "sign"
    elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
        text = source[start:end]
        if in_index:
            for step in (1, -1):
                yield start, end, f"({node.value + step})", "index"
        elif type(node.value) is int:
            yield start, end, str(node.value + 1), "number"
        elif node.value != 0:
            yield start, end, f"(2 * {text})", "number"
        else:
            yield start, end, "1.0", "number"
    elif isinstance(node, ast.Call):
        name = node.func
        if _called(node) in EXCHANGED:
            stop = ends(name)[1]
            old = _called(node)
            yield stop - len(old), stop, EXCHANGED[old], "min and max"
        elif (
            isinstance(name, ast.Attribute)
            and isinstance(name.value, ast.Name)
            and (name.value.id, name.attr)
            in {("vectors", "add"), ("vectors", "subtract")}
            and len(node.args) == 2
        ):
            other = {"add": "subtract", "subtract": "add"}[name.attr]
            stop = ends(name)[1]
            yield stop - len(name.attr), stop, other, "operator"
            first = ends(node.args[0])
            yield start, end, source[first[0] : first[1]], "dropped term"


def _is_text(node: ast.expr) -> bool:
    return isinstance(node, ast.JoinedStr) or (
        isinstance(node, ast.Constant) and isinstance(node.value, str)
    )

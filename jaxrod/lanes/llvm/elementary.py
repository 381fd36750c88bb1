r"""Elementary functions of vectors, as LLVM IR.

Sine and cosine reduce the argument to $|r| \le \pi/4$ by subtracting a multiple of
$\pi/2$, stored as a sum of two or three numbers, and then use a power series. The
exponential is $2^n e^r$ with $|r| \le \tfrac12\ln 2$ and a power series for $e^r$.
Beyond the range where sine and cosine are accurate, and for most other functions, each
lane calls the C library.
"""

from __future__ import annotations

import math

from jaxrod.lanes.graph import OPERATIONS
from jaxrod.lanes.llvm.vector_code import BYTES, TYPES, literal

_HALF_PI = (1.5707963267948966, 6.123233995736766e-17, -1.4973849048591698e-33)
"""Numbers whose sum is half of pi, each much smaller than the one before."""
_LN_2 = (0.6931471805599453, 2.3190468138462996e-17)
_LARGEST_ANGLE = {"f32": 1e9, "f64": 1e5}


def elementary_texts(needs: set[tuple[str, str, int]]) -> tuple[list[str], set[str]]:
    """Returns LLVM IR of the elementary functions that a kernel calls.

    Args:
        needs: Operation, number type and number of lanes of each function; the number
            of lanes is 1 for single numbers.

    Returns:
        The definitions of the functions, and the declarations that they need.
    """
    whole = set(needs)
    for operation, kind, width in needs:
        whole |= {(*other, width) for other in _needed_by(operation, kind)}
    texts, declared = [], set()
    for operation, kind in sorted({need[:2] for need in whole}):
        row = OPERATIONS[operation]
        given = ", ".join(["double"] * row.operands)
        declared.add(f"declare double @{row.symbol}({given})")
        texts.append(_of_one(operation, kind))
    for operation, kind, width in sorted(whole):
        if width > 1:
            text, more = _of_vector(operation, kind, width)
            texts.append(text)
            declared |= more
    return texts, declared


def vector_name(operation: str, kind: str, width: int) -> str:
    """Returns the name of an operation's LLVM function, such as `@exp_f32_8`.

    `kind` is the type of the numbers, `width` the number of lanes. Names of functions
    of single numbers (width 1) end in `_one`.
    """
    return f"@{operation}_{kind}_{'one' if width == 1 else width}"


def _of_vector(operation: str, kind: str, width: int) -> tuple[str, set[str]]:
    if operation in ("sin", "cos"):
        return _circular(operation, kind, width)
    if operation == "exp":
        return _exponential(kind, width)
    if (operation, kind) == ("tanh", "f32"):
        return _hyperbolic_tangent(width)
    return lane_by_lane(operation, kind, width, operation), set()


def _needed_by(operation: str, kind: str) -> set[tuple[str, str]]:
    """Returns operation and type of further vector functions that an operation needs.

    tanh in float32 needs exp in float64; other functions need none.
    """
    return {("exp", "f64")} if (operation, kind) == ("tanh", "f32") else set()


def _of_one(operation: str, kind: str) -> str:
    """Returns LLVM IR of an elementary function of one number.

    It calls the C library in float64, and rounds the result if the number is float32.
    """
    one = TYPES[kind]
    row = OPERATIONS[operation]
    names = ["%a", "%b"][: row.operands]
    lines, wide = [], []
    for name in names:
        if kind == "f32":
            lines.append(f"{name}w = fpext float {name} to double")
            wide.append(f"double {name}w")
        else:
            wide.append(f"double {name}")
    lines.append(f"%r = call double @{row.symbol}({', '.join(wide)})")
    if kind == "f32":
        lines += ["%s = fptrunc double %r to float", "ret float %s"]
    else:
        lines.append("ret double %r")
    given = ", ".join(f"{one} {name}" for name in names)
    body = "\n".join(lines)
    return f"define internal {one} @{operation}_{kind}_one({given}) {{\n{body}\n}}\n"


def lane_by_lane(operation: str, kind: str, width: int, name: str) -> str:
    """Returns LLVM IR of a vector function that calls a scalar function in each lane.

    Args:
        operation: The operation.
        kind: Type of the numbers, such as `"f32"`.
        width: Lanes of the vector.
        name: Name of the operation in the function's name, see `vector_name`.
    """
    one, many = TYPES[kind], f"<{width} x {TYPES[kind]}>"
    given = ["%x", "%y"][: OPERATIONS[operation].operands]
    lines, made = [], "poison"
    for lane in range(width):
        singles = []
        for vector in given:
            lines.append(f"{vector}{lane} = extractelement {many} {vector}, i64 {lane}")
            singles.append(f"{one} {vector}{lane}")
        call = f"call {one} @{operation}_{kind}_one({', '.join(singles)})"
        lines.append(f"%r{lane} = {call}")
        lines.append(
            f"%m{lane} = insertelement {many} {made}, {one} %r{lane}, i64 {lane}"
        )
        made = f"%m{lane}"
    lines.append(f"ret {many} {made}")
    arguments = ", ".join(f"{many} {vector}" for vector in given)
    body = "\n".join(lines)
    function = vector_name(name, kind, width)
    return f"define internal {many} {function}({arguments}) {{\n{body}\n}}\n"


class _Lines:
    """LLVM IR of a function of one vector, under construction."""

    def __init__(self, width: int) -> None:
        self.width = width
        self.lines: list[str] = []
        self.declared: set[str] = set()

    def type(self, kind: str) -> str:
        return f"<{self.width} x {TYPES[kind]}>"

    def splat(self, value: float, kind: str) -> str:
        entry = f"{TYPES[kind]} {literal(_rounded(value, kind), kind)}"
        return "<" + ", ".join([entry] * self.width) + ">"

    def new(self, text: str) -> str:
        name = f"%l{len(self.lines)}"
        self.lines.append(f"{name} = {text}")
        return name

    def intrinsic(self, name: str, kind: str, *given: str) -> str:
        many = self.type(kind)
        full = f"@llvm.{name}.v{self.width}{kind}"
        self.declared.add(f"declare {many} {full}({', '.join([many] * len(given))})")
        return self.new(
            f"call {many} {full}({', '.join(f'{many} {g}' for g in given)})"
        )

    def series(self, at: str, coefficients: list[float], kind: str) -> str:
        """Appends a polynomial of the vector `at`, and returns the name of its value.

        It is evaluated by Horner's rule; the coefficient of the lowest power is first.
        """
        total = self.splat(coefficients[-1], kind)
        for coefficient in reversed(coefficients[:-1]):
            other = self.splat(coefficient, kind)
            total = self.intrinsic("fma", kind, total, at, other)
        return total


def _rounded(value: float, kind: str) -> float:
    import numpy as np

    return float(np.float32(value)) if kind == "f32" else value


def _circular(operation: str, kind: str, width: int) -> tuple[str, set[str]]:
    code = _Lines(width)
    many = code.type(kind)
    truth = code.type("b1")
    size = code.intrinsic("fabs", kind, "%x")
    far = code.new(f"fcmp ogt {many} {size}, {code.splat(_LARGEST_ANGLE[kind], kind)}")
    reduce = f"@llvm.vector.reduce.or.v{width}i1"
    code.declared.add(f"declare i1 {reduce}({truth})")
    any_far = code.new(f"call i1 {reduce}({truth} {far})")
    code.lines.append(f"br i1 {any_far}, label %slow, label %fast")
    code.lines.append("slow:")
    slow = code.new(f"call {many} @{operation}_slow_{kind}_{width}({many} %x)")
    code.lines += [f"ret {many} {slow}", "fast:"]
    wide = code.type("f64")
    angle = "%x" if kind == "f64" else code.new(f"fpext {many} %x to {wide}")
    turns = code.new(f"fmul {wide} {angle}, {code.splat(2 / math.pi, 'f64')}")
    turns = code.intrinsic("roundeven", "f64", turns)
    rest = angle
    for part in _HALF_PI[: 2 if kind == "f32" else 3]:
        rest = code.intrinsic("fma", "f64", turns, code.splat(-part, "f64"), rest)
    # The conversion of NaN to an integer gives 0; the series then returns NaN.
    whole = code.type("i32")
    convert = f"@llvm.fptosi.sat.v{width}i32.v{width}f64"
    code.declared.add(f"declare {whole} {convert}({wide})")
    quarter = code.new(f"call {whole} {convert}({wide} {turns})")
    if operation == "cos":
        quarter = code.new(f"add {whole} {quarter}, {_whole(width, 1)}")
    if kind == "f32":
        rest = code.new(f"fptrunc {wide} {rest} to {many}")
    square = code.new(f"fmul {many} {rest}, {rest}")
    terms = 5 if kind == "f32" else 9
    odd = [(-1) ** k / math.factorial(2 * k + 1) for k in range(1, terms)]
    even = [(-1) ** k / math.factorial(2 * k) for k in range(1, terms + 1)]
    tail = code.new(f"fmul {many} {square}, {code.series(square, odd, kind)}")
    sine = code.intrinsic("fma", kind, rest, tail, rest)
    tail = code.series(square, even, kind)
    cosine = code.intrinsic("fma", kind, square, tail, code.splat(1.0, kind))
    bit = code.new(f"and {whole} {quarter}, {_whole(width, 1)}")
    swapped = code.new(f"icmp ne {whole} {bit}, {_whole(width, 0)}")
    made = code.new(f"select {truth} {swapped}, {many} {cosine}, {many} {sine}")
    bit = code.new(f"and {whole} {quarter}, {_whole(width, 2)}")
    turned = code.new(f"icmp ne {whole} {bit}, {_whole(width, 0)}")
    minus = code.new(f"fneg {many} {made}")
    result = code.new(f"select {truth} {turned}, {many} {minus}, {many} {made}")
    slow_text = lane_by_lane(operation, kind, width, f"{operation}_slow")
    text, declared = _finished(code, operation, kind, result)
    return slow_text + text, declared


def _exponential(kind: str, width: int) -> tuple[str, set[str]]:
    code = _Lines(width)
    many, truth = code.type(kind), code.type("b1")
    bits, bias = (23, 127) if kind == "f32" else (52, 1023)
    # Beyond these limits the result is zero or infinite.
    low, high = (-105.0, 90.0) if kind == "f32" else (-747.0, 711.0)
    number = "%x"
    for test, limit in (("olt", low), ("ogt", high)):
        edge = code.splat(limit, kind)
        outside = code.new(f"fcmp {test} {many} {number}, {edge}")
        number = code.new(f"select {truth} {outside}, {many} {edge}, {many} {number}")
    doublings = code.new(f"fmul {many} {number}, {code.splat(1 / math.log(2), kind)}")
    doublings = code.intrinsic("roundeven", kind, doublings)
    high_part = _rounded(_LN_2[0], kind)
    low_part = _LN_2[0] - high_part if kind == "f32" else _LN_2[1]
    rest = code.intrinsic("fma", kind, doublings, code.splat(-high_part, kind), number)
    rest = code.intrinsic("fma", kind, doublings, code.splat(-low_part, kind), rest)
    powers = 8 if kind == "f32" else 14
    series = [1 / math.factorial(k) for k in range(2, powers)]
    tail = code.series(rest, series, kind)
    square = code.new(f"fmul {many} {rest}, {rest}")
    tail = code.intrinsic("fma", kind, square, tail, rest)
    made = code.new(f"fadd {many} {tail}, {code.splat(1.0, kind)}")
    size = f"i{8 * BYTES[kind]}"
    whole = f"<{width} x {size}>"
    convert = f"@llvm.fptosi.sat.v{width}{size}.v{width}{kind}"
    code.declared.add(f"declare {whole} {convert}({many})")
    count = code.new(f"call {whole} {convert}({many} {doublings})")
    # The scaling is in two halves: neither over- or underflows unless the result does.
    half = code.new(f"ashr {whole} {count}, {_whole(width, 1, size)}")
    other = code.new(f"sub {whole} {count}, {half}")
    for part in (half, other):
        raised = code.new(f"add {whole} {part}, {_whole(width, bias, size)}")
        raised = code.new(f"shl {whole} {raised}, {_whole(width, bits, size)}")
        factor = code.new(f"bitcast {whole} {raised} to {many}")
        made = code.new(f"fmul {many} {made}, {factor}")
    return _finished(code, "exp", kind, made)


def _hyperbolic_tangent(width: int) -> tuple[str, set[str]]:
    """Returns LLVM IR of tanh in float32, computed from the exponential in float64.

    tanh |x| = (1 - exp(-2 |x|)) / (1 + exp(-2 |x|)). For |x| < 1e-5 the result is x.
    """
    code = _Lines(width)
    many, wide, truth = code.type("f32"), code.type("f64"), code.type("b1")
    number = code.new(f"fpext {many} %x to {wide}")
    size = code.intrinsic("fabs", "f64", number)
    twice = code.new(f"fmul {wide} {size}, {code.splat(-2.0, 'f64')}")
    decay = code.new(f"call {wide} @exp_f64_{width}({wide} {twice})")
    one = code.splat(1.0, "f64")
    above = code.new(f"fsub {wide} {one}, {decay}")
    below = code.new(f"fadd {wide} {one}, {decay}")
    ratio = code.new(f"fdiv {wide} {above}, {below}")
    ratio = code.intrinsic("copysign", "f64", ratio, number)
    result = code.new(f"fptrunc {wide} {ratio} to {many}")
    small = code.new(f"fcmp olt {wide} {size}, {code.splat(1e-5, 'f64')}")
    result = code.new(f"select {truth} {small}, {many} %x, {many} {result}")
    return _finished(code, "tanh", "f32", result)


def _whole(width: int, value: int, size: str = "i32") -> str:
    return "<" + ", ".join([f"{size} {value}"] * width) + ">"


def _finished(code: _Lines, name: str, kind: str, result: str) -> tuple[str, set[str]]:
    many = code.type(kind)
    body = "\n".join(["entry:", *code.lines, f"ret {many} {result}"])
    function = vector_name(name, kind, code.width)
    text = f"define internal {many} {function}({many} %x) {{\n{body}\n}}\n"
    return text, code.declared

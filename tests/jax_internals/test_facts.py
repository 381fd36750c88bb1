"""Facts about JAX's inside on which jaxrod relies, one test for each.

A test that fails on a new release says what has changed there.
"""

import re
import subprocess
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.sharding import AxisType, NamedSharding, PartitionSpec

import jaxrod
from jaxrod.jax_internals import equations, foreign_call
from jaxrod.jax_internals.primitives import (
    evaluate,
    no_kernels_in,
    unknown_rules,
)
from jaxrod.lanes import choice, steps
from jaxrod.lanes.choice import lane_choices, lane_mode, use_lanes
from jaxrod.lanes.jaxpr.unroll import RULES, supported
from jaxrod.lanes.rows.row_unroller import ROW_RULES
from jaxrod.training.exporting.walk import RULES as EXPORTED

X = jnp.arange(1.0, 13.0).reshape(3, 4)


def only(function, *arguments):
    """The one equation of a program."""
    (equation,) = jax.make_jaxpr(function)(*arguments).eqns
    return equation


@pytest.fixture
def mode():
    """Leaves the use of lanes as it was."""
    before = lane_mode()
    yield
    use_lanes(before)


# Equations ------------------------------------------------------------------------


def test_a_scan_says_how_many_operands_are_constants_and_carry():
    def program(x, rows):
        turn = lambda c, row: ((c[0] * x + row, c[1] + 1), None)
        return lax.scan(turn, (x, 1.0), rows)[0]

    scans = [
        equation
        for equation in jax.make_jaxpr(program)(X[0], X).eqns
        if equation.primitive.name == "scan"
    ]
    scan = equations.scan_of(scans[0])
    assert (scan.n_constants, scan.n_carry, scan.length) == (1, 2, 3)
    assert scan.backwards is False
    back = only(lambda r: lax.scan(lambda c, r: (c, r), 0.0, r, reverse=True), X)
    assert equations.scan_of(back).backwards is True


def test_a_while_says_which_operands_its_condition_and_its_body_hold():
    def program(x, y):
        return lax.while_loop(lambda c: c < x, lambda c: c + x * y, 0.0)

    loop = equations.while_of(only(program, 3.0, 1.0))
    assert (loop.n_condition, loop.n_body) == (1, 2)
    held = len(equations.operand_types(loop.condition))
    assert held == loop.n_condition + 1


@pytest.mark.parametrize(
    ("name", "function"),
    [
        ("jit", jax.jit(lambda x: jnp.sin(x) + 1)),
        ("remat2", jax.checkpoint(lambda x: jnp.sin(x) + 1)),
        ("custom_jvp_call", jax.nn.relu),
    ],
)
def test_a_call_holds_its_program(name, function):
    found = jax.make_jaxpr(function)(X)
    equation = found.eqns[0]
    assert equation.primitive.name == name
    made = evaluate(equations.called_program(equation), X)
    np.testing.assert_array_equal(made[0], function(X))


def test_a_program_and_its_constants_are_found_together_and_apart():
    held = np.arange(3.0)
    closed = jax.make_jaxpr(lambda x: x * held)(jnp.ones(3))
    jaxpr, constants = equations.program_of(closed)
    assert len(jaxpr.constvars) == len(constants)
    assert equations.result_types(closed)[0].shape == (3,)
    np.testing.assert_array_equal(evaluate(closed, jnp.full(3, 2.0))[0], 2 * held)


def test_a_program_with_its_results_as_carry_has_the_same_equations():
    closed = jax.make_jaxpr(lambda a, x, y: (a * x, x + y))(2.0, X, X)
    carried = equations.as_carry(closed, 1)
    before, after = (equations.program_of(c).jaxpr for c in (closed, carried))
    assert before.eqns == after.eqns
    made = evaluate(carried, 2.0, X, 2 * X, 0 * X, 0 * X)
    for one, expected in zip(made, (X, 2 * X, 2 * X, 3 * X), strict=True):
        np.testing.assert_array_equal(one, expected)


def test_a_literal_has_a_value_and_a_variable_has_none():
    equation = only(lambda x: x + 2.0, 1.0)
    assert [equations.is_literal(atom) for atom in equation.invars] == [False, True]


def test_a_parameter_that_is_not_listed_is_refused():
    known = only(lambda x: lax.slice(x, (0, 0), (1, 1)), X)
    assert equations.unknown_parameter(known) is None
    more = SimpleNamespace(
        primitive=known.primitive, params={**known.params, "wrap": True}
    )
    assert "the parameter 'wrap' of 'slice'" in equations.unknown_parameter(more)
    product = only(lambda x: x * x, X)
    wide = SimpleNamespace(
        primitive=product.primitive, params={"out_dtype": np.dtype("float16")}
    )
    assert "'mul' with out_dtype=float16" in equations.unknown_parameter(wide)


def test_a_sharding_that_divides_nothing_is_known_and_others_are_not():
    """Within `shard_map` broadcasts name the mesh; the learners step tasks there."""
    mesh = jax.make_mesh((1,), ("i",), axis_types=(AxisType.Auto,))
    each = PartitionSpec("i")

    def repeated(x):
        return jnp.broadcast_to(x[:, None], (*x.shape, 3)) * lax.iota(float, 3)[None]

    mapped = jax.shard_map(repeated, mesh=mesh, in_specs=each, out_specs=each)
    (equation,) = jax.make_jaxpr(mapped)(jnp.ones(4)).eqns
    inside = list(next(equations.programs_within(equation)).eqns)
    assert "broadcast_in_dim" in [each.primitive.name for each in inside]
    assert [equations.unknown_parameter(each) for each in inside] == [None] * len(
        inside
    )
    if hasattr(jax, "reshard"):
        whole = jax.sharding.NamedSharding(mesh, PartitionSpec(None))
        again = only(lambda x: jax.reshard(x, whole), jnp.ones(4))
        assert again.primitive.name == "reshard"
        assert equations.unknown_parameter(again) is None
        apart = jax.sharding.NamedSharding(mesh, each)
        again = SimpleNamespace(
            primitive=again.primitive, params={**again.params, "dst_sharding": apart}
        )
        assert "'reshard' with dst_sharding" in equations.unknown_parameter(again)
    product = only(lambda x: x * x, X)
    divided = SimpleNamespace(
        primitive=product.primitive,
        params={"out_sharding": NamedSharding(mesh, each)},
    )
    assert "'mul' with out_sharding=" in equations.unknown_parameter(divided)


def test_reductions_are_left_to_xla_and_not_to_a_library():
    """A library's take ten times as long in the batches of a task with obstacles."""

    def nearest(x):
        return jnp.min(jnp.sqrt(x * x + 1) - x, axis=1)

    compiled = jax.jit(nearest).lower(jnp.ones((256, 80))).compile().as_text()
    assert "reduce" in compiled and "ynn" not in compiled


def test_every_rule_belongs_to_a_primitive_with_known_parameters():
    """A listed primitive without a rule would be a name that no longer exists."""
    assert set(equations._PARAMETERS) <= set(RULES) | set(EXPORTED)


# Runs with equations that lanes do not know ---------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["primitive", "parameter", "lost parameter"])
def test_xla_takes_the_whole_run(kind, monkeypatch, mode):
    rod, start = jaxrod.straight_rod(
        4, length=1.0, radius=0.05, density=1000.0, youngs_modulus=1e6
    )
    scene = jaxrod.make_scene(rod, jaxrod.clamp(start), jaxrod.gravity())
    many = jax.tree.map(lambda leaf: jnp.stack([leaf] * 8), start)

    def run():
        jax.clear_caches()
        steps._programs.clear()
        return jax.vmap(lambda s: jaxrod.advance(scene, s, 1e-5, 3))(many)

    use_lanes("never")
    expected = run()
    use_lanes("auto")
    run()
    assert lane_choices()[-1].taken
    if kind == "primitive":
        monkeypatch.delitem(RULES, "sqrt")
        monkeypatch.delitem(ROW_RULES, "sqrt")
        words = "primitive 'sqrt'"
    elif kind == "parameter":
        monkeypatch.setitem(equations._PARAMETERS, "slice", "limit_indices strides")
        words = "'start_indices' of 'slice'"
    else:
        real = RULES["slice"]

        def without(unroller, equation, *arrays):
            bare = SimpleNamespace(primitive=equation.primitive, params={})
            return real(unroller, bare, *arrays)

        monkeypatch.setitem(RULES, "slice", without)
        monkeypatch.setitem(ROW_RULES, "slice", without)
        words = "'slice' is not as expected: KeyError"
    found = run()
    last = lane_choices()[-1]
    assert not last.taken and words in last.why and "\n" not in last.why
    jax.tree.map(np.testing.assert_array_equal, found, expected)


# Primitives and lowering ----------------------------------------------------------


def test_jax_takes_primitives_and_rules():
    assert unknown_rules() is None


def test_a_rule_that_is_gone_is_named(monkeypatch):
    from jax.interpreters import batching

    monkeypatch.delattr(batching, "primitive_batchers")
    words = unknown_rules.__wrapped__()
    assert words == "this JAX has no jax.interpreters.batching.primitive_batchers"


def test_a_context_of_lowering_says_platform_export_and_devices():
    seen = []
    from jax.interpreters import mlir

    from jaxrod.jax_internals.primitives import new_primitive

    primitive = new_primitive("jaxrod_test_context")
    primitive.def_abstract_eval(lambda x: [x])
    same = mlir.lower_fun(lambda x: [x], multiple_results=True)

    def rule(context, x):
        seen.append(no_kernels_in(context))
        assert context.module_context.platforms == ("cpu",)
        return same(context, x)

    mlir.register_lowering(primitive, rule, platform="cpu")
    jax.jit(lambda x: primitive.bind(x)).lower(X)
    jax.export.export(jax.jit(lambda x: primitive.bind(x)), platforms=["cpu"])(X)
    assert seen[0] is None and "exported" in seen[1]


def test_jax_says_whether_it_has_computed():
    command = (
        "import jax, jax.numpy as jnp\n"
        "from jaxrod.installation.backend import _backend_is_running as running\n"
        "assert not running(); jnp.ones(3); assert running()"
    )
    subprocess.run([sys.executable, "-c", command], check=True)


# The binary interface -------------------------------------------------------------


def test_the_header_of_this_jaxlib_is_the_one_known():
    assert foreign_call.unknown_layout() is None


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        (r"void\* data;", "void* elsewhere;", "XLA_FFI_Buffer"),
        (r"EXECUTE = 3", "EXECUTE = 4", "ExecutionStage_EXECUTE"),
        (
            r"XLA_FFI_InternalExtension|XLA_FFI_Extension_Base",
            "XLA_FFI_Link",
            "XLA_FFI_InternalExtension",
        ),
        (r"#define XLA_FFI_API_MINOR \d+", "", "version"),
    ],
)
def test_a_header_with_another_layout_is_not_used(old, new, named, monkeypatch):
    changed = re.sub(old, new, foreign_call.header())
    assert changed != foreign_call.header()
    monkeypatch.setattr(foreign_call, "header", lambda: changed)
    assert named in foreign_call.unknown_layout.__wrapped__()


UNKNOWN_HEADER = """
import re
from jaxrod.jax_internals import foreign_call
header = re.sub("void. data;", "void* elsewhere;", foreign_call.header())
foreign_call.header = lambda: header
"""


def with_unknown_header(program):
    """Runs a program on a jaxlib whose header describes another buffer."""
    return subprocess.run(
        [sys.executable, "-c", UNKNOWN_HEADER + program],
        capture_output=True,
        text=True,
    )


@pytest.mark.slow
def test_an_unknown_header_is_reported_in_one_line_and_xla_runs():
    done = with_unknown_header("""
import jax, jax.numpy as jnp, numpy as np
import jaxrod
from jaxrod import lanes
rod, start = jaxrod.straight_rod(
    4, length=1.0, radius=0.05, density=1000.0, youngs_modulus=1e6
)
scene = jaxrod.make_scene(rod, jaxrod.clamp(start), jaxrod.gravity())
many = jax.tree.map(lambda leaf: jnp.stack([leaf] * 8), start)
run = lambda: jax.vmap(lambda s: jaxrod.advance(scene, s, 1e-5, 3))(many).tip
found = [run(), run()]
jaxrod.use_lanes("never")
np.testing.assert_array_equal(found[1], run())
print(jaxrod.lane_choices()[-1].why)
""")
    assert done.returncode == 0, done.stderr
    # XLA may add lines of its own.
    (line,) = [line for line in done.stderr.splitlines() if "jaxrod" in line]
    assert "XLA_FFI_Buffer" in line and "a fifth as fast" in line
    assert "XLA_FFI_Buffer" in done.stdout


@pytest.mark.slow
def test_the_doctor_and_the_benchmark_say_why_batches_are_slower():
    done = with_unknown_header("""
from jaxrod import cli
from benchmarks.rod_steps import measuring
from benchmarks.rod_steps import run as command
assert cli.main(["doctor"]) == 0
report = measuring.Report((), ())
machine = dict(processor="x", devices="y", versions={}, load_average_before=0, cores=1)
print(command._table(report, machine))
""")
    assert done.returncode == 0, done.stderr
    lines = [line for line in done.stdout.splitlines() if "XLA_FFI_Buffer" in line]
    assert len(lines) == 2 and all("a fifth as fast" in line for line in lines)


def test_slower_says_nothing_where_lanes_run(monkeypatch, mode):
    monkeypatch.setattr(choice, "not_here", lambda: None)
    use_lanes("auto")
    assert choice.slower() is None
    use_lanes("never")
    assert "the mode is 'never'" in choice.slower()


def test_programs_without_names_known_to_lanes_are_left_to_xla():
    ranked = jax.make_jaxpr(lambda x: jax.lax.top_k(x, 1))(X)
    assert "primitive 'top_k'" in supported(ranked)

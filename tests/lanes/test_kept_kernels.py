"""Kernels found by their programs: equal programs alone, whole and by nobody else."""

import jax
import jax.numpy as jnp
import pytest

import jaxrod
from jaxrod.jax_internals.equations import NoDescriptionError, description
from jaxrod.lanes import kept_kernels, kernels, steps
from jaxrod.lanes.llvm.kernel import Kernel
from jaxrod.lanes.run_spec import Batch, LoopBody, RunSpec
from physics.rods import arm

X, TABLE = jnp.arange(4.0), jnp.array([1.0, 2.0])


def text(function, *arrays, rules=False):
    return description(jax.make_jaxpr(function)(*arrays), rules=rules)


def ruled(slope):
    """Twice a number, with a derivative of its own."""

    @jax.custom_jvp
    def twice(x):
        return 2 * x

    twice.defjvp(lambda primals, tangents: (twice(*primals), slope * tangents[0]))
    return twice


OTHERS = {
    "operation": lambda x: jnp.cos(x) * TABLE[0] + x[1:3].sum(),
    "literal": lambda x: jnp.sin(x) * TABLE[0] + x[1:3].sum() + 1.0,
    "slice": lambda x: jnp.sin(x) * TABLE[0] + x[0:2].sum(),
    "constant": lambda x: jnp.sin(x) * (2 * TABLE)[0] + x[1:3].sum(),
    "order": lambda x: TABLE[0] * jnp.sin(x) + x[1:3].sum(),
}


def program(x):
    return jnp.sin(x) * TABLE[0] + x[1:3].sum()


def test_equal_programs_have_equal_descriptions():
    again = lambda x: program(x)
    assert text(program, X) == text(again, X)
    assert text(jax.jit(program), X) == text(jax.jit(again), X)


@pytest.mark.parametrize("name", OTHERS)
def test_other_programs_have_other_descriptions(name):
    assert text(program, X) != text(OTHERS[name], X)


def test_types_are_described():
    assert text(jnp.sin, X) != text(jnp.sin, X[:3])
    assert text(jnp.sin, X) != text(jnp.sin, X.astype(jnp.float16))


def test_loops_and_branches_are_described_inside_out():
    def loop(step, length):
        return lambda x: jax.lax.scan(lambda c, _: (step(c), c), x, length=length)

    assert text(loop(jnp.sin, 3), X) == text(loop(jnp.sin, 3), X)
    assert text(loop(jnp.sin, 3), X) != text(loop(jnp.cos, 3), X)
    assert text(loop(jnp.sin, 3), X) != text(loop(jnp.sin, 4), X)


def test_rules_of_derivatives_count_only_for_derivatives():
    two, three = ruled(2.0), ruled(3.0)
    assert text(two, X) == text(three, X)
    assert text(two, X, rules=True) != text(three, X, rules=True)
    assert text(two, X, rules=True) == text(ruled(2.0), X, rules=True)
    inside = lambda f: jax.jit(lambda x: f(x) + 1)
    assert text(inside(two), X, rules=True) != text(inside(three), X, rules=True)


def test_what_is_not_understood_has_no_description():
    with pytest.raises(NoDescriptionError, match="random_bits"):
        text(lambda key: jax.random.uniform(key, (2,)), jax.random.key(0))


@pytest.fixture
def folder(tmp_path):
    """The folder for compiled programs, for one test."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "programs"))
    yield tmp_path / "programs"
    jax.config.update("jax_compilation_cache_dir", before)


def spec_of(function, **facts):
    closed = jax.make_jaxpr(function)(jnp.ones(2), X)
    return RunSpec(LoopBody(closed, facts.pop("n_constants", 1)), None, **facts)


def body(constant, x):
    return jnp.sin(x) * constant[0]


KERNEL = Kernel("text of a kernel", 3, 2, 128, 0, 7)


def made(spec, kind="rows", name="jaxrod_cycles", kernel=KERNEL):
    """A kernel from disk or made, and whether it was made."""
    calls = []
    found = kept_kernels.kept(
        kind, name, spec, lambda: calls.append(1) or (kernel, "" if kernel else "no")
    )
    return found, bool(calls)


def test_a_kernel_is_made_once_and_then_found(folder):
    assert made(spec_of(body)) == ((KERNEL, ""), True)
    assert made(spec_of(body)) == ((KERNEL, ""), False)
    again = spec_of(lambda constant, x: body(constant, x))
    assert made(again) == ((KERNEL, ""), False)


def test_a_refusal_is_found_too(folder):
    assert made(spec_of(body), kernel=None) == ((None, "no"), True)
    assert made(spec_of(body), kernel=None) == ((None, "no"), False)


@pytest.mark.parametrize(
    ("facts", "more"),
    [
        ({"n_constants": 0}, {}),
        ({"batch": Batch(4, (True, True))}, {}),
        ({"keeps": True}, {}),
        ({"moving": (True,)}, {}),
        ({}, {"kind": "lanes of at most 10"}),
        ({}, {"name": "jaxrod_cycles_adjoint"}),
    ],
    ids=str,
)
def test_all_that_a_kernel_depends_on_is_in_its_key(folder, facts, more):
    made(spec_of(body))
    assert made(spec_of(body, **facts), **more)[1]


def test_a_damaged_file_is_made_again(folder):
    made(spec_of(body))
    (file,) = folder.iterdir()
    file.write_bytes(file.read_bytes()[:-2])
    assert made(spec_of(body))[1]
    assert not made(spec_of(body))[1]


def test_nothing_is_kept_without_a_folder(folder):
    jax.config.update("jax_compilation_cache_dir", None)
    assert made(spec_of(body))[1]
    assert made(spec_of(body))[1]


def test_a_second_process_writes_no_kernel_for_a_gradient(folder, monkeypatch):
    """All that this process remembers is forgotten, and the writers are removed."""
    rod, state = arm(3, jnp.float64)
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state), jaxrod.gravity())

    def slope():
        tip = lambda dt: jaxrod.advance(scene, state, dt, 4).tip[2]
        return float(jax.grad(tip)(1e-5))

    def forget():
        jax.clear_caches()
        steps._programs.clear()

    forget()
    first = slope()
    assert jaxrod.lane_choices()[-1].taken and any(folder.iterdir())
    forget()

    def written(*given):
        raise AssertionError("a kernel is written again")

    for way in ("_written_out", "_in_loops", "_of_rows"):
        monkeypatch.setattr(kernels, way, written)
    assert slope() == first
    assert jaxrod.lane_choices()[-1].taken

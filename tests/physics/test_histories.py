"""Materials with memory in every method, in systems, in files and under derivatives."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from physics.bending import straight


def relaxing(rod, scale=1.0, **given):
    return jaxrod.materials.standard_linear_solid(
        rod, stiffness_ratio=1.5 * scale, relaxation_time=0.02, **given
    )


def slipping(rod, scale=1.0, **given):
    return jaxrod.materials.bending_hysteresis(
        rod, stiffness=4.0, slip_moment=0.2 * scale, **given
    )


def yielding(rod, scale=1.0, **given):
    return jaxrod.materials.plastic_bending(
        rod, yield_moment=0.2 * scale, hardening=0.1, **given
    )


LAWS = {"relaxing": relaxing, "slipping": slipping, "yielding": yielding}
every_law = pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)


def swinging(law, scale=1.0, method=None, dtype=None):
    """A clamped rod that falls in the zx plane: scene, state and step."""
    rod, state = straight(4, dtype=dtype)
    wall = jaxrod.clamp(state)
    effects = wall, jaxrod.gravity(), law(rod, scale, into=wall)
    scene = jaxrod.make_scene(rod, *effects, method=method)
    return scene, state, 0.8 * jaxrod.stable_dt(scene).dt


@pytest.mark.fast_sets(1)
@every_law
def test_loads_are_minus_the_gradient_of_the_energy(law):
    """This holds while nothing relaxes, slips or yields."""
    rod, state = straight(4)
    wall = jaxrod.clamp(state)
    effect = law(rod, 1e6, into=wall)
    if law is yielding:
        effect = replace(effect, set=jnp.full((3, 5), 0.3).at[2].set(0.0))
    rng = np.random.default_rng(1)
    moved = 0.01 * jnp.asarray(rng.normal(size=state.positions.shape))
    state = replace(state, positions=state.positions + moved)
    member = jaxrod.make_scene(rod).as_member()
    forces = effect.loads(rod, member.motion(state)).forces
    slope = jax.grad(
        lambda x: effect.energy(rod, replace(state, positions=x)) + 0.0 * jnp.sum(x)
    )(state.positions)
    found = 0 * slope if forces is None else jnp.stack(forces)
    np.testing.assert_allclose(found, -slope, atol=1e-9 * (1 + np.max(np.abs(slope))))


@pytest.mark.slow
@every_law
def test_runs_go_on_where_they_ended(law, tmp_path):
    """Half by half, through a file: as in one run."""
    scene, state, dt = swinging(law)
    whole = jaxrod.advance(scene, state, dt, 200)
    half = jaxrod.advance(scene, state, dt, 100)
    jaxrod.save(tmp_path / "half", {"scene": scene, "state": half})
    kept = jaxrod.load(tmp_path / "half")
    again = jaxrod.advance(kept["scene"], kept["state"], dt, 100)
    np.testing.assert_allclose(again.positions, whole.positions, atol=1e-13)
    for mine, other in zip(
        jax.tree.leaves(again.memory), jax.tree.leaves(whole.memory), strict=True
    ):
        np.testing.assert_allclose(mine, other, atol=1e-11)
    assert not jaxrod.health(scene, whole, dt).flagged


@pytest.mark.slow
@every_law
def test_in_the_plane_it_is_the_same(law):
    scene, state, dt = swinging(law)
    flat = replace(scene, method=jaxrod.planar("zx"))
    after = [jaxrod.advance(model, state, dt, 150) for model in (scene, flat)]
    np.testing.assert_allclose(after[0].positions, after[1].positions, atol=1e-11)
    for mine, other in zip(*(jax.tree.leaves(s.memory) for s in after), strict=True):
        np.testing.assert_allclose(mine, other, atol=1e-9)


@pytest.mark.slow
@every_law
def test_a_member_of_a_system_remembers(law):
    """A rod in a system is the rod alone; so are equal rods, each with its own past."""
    scene, state, dt = swinging(law)
    alone = jaxrod.advance(scene, state, dt, 100)
    both = jax.tree.map(lambda a: jnp.stack([a, a]), (scene, state))
    system = jaxrod.make_system({"one": scene, "two": both[0]})
    within = jaxrod.advance(system, {"one": state, "two": both[1]}, dt, 100)
    for mine, other in zip(
        jax.tree.leaves(within["one"]), jax.tree.leaves(alone), strict=True
    ):
        np.testing.assert_allclose(mine, other, atol=1e-11)
    np.testing.assert_allclose(within["two"].positions[1], alone.positions, atol=1e-12)


@pytest.mark.slow
@every_law
def test_gradients_agree_with_differences(law):
    _, state, dt = swinging(law)

    @jax.jit
    def tip(scale):
        other, _, _ = swinging(law, scale)
        return jaxrod.advance(other, state, dt, 120).tip[2]

    slope = float(jax.jit(jax.grad(tip))(1.0))
    step = 1e-5
    difference = float(tip(1 + step) - tip(1 - step)) / (2 * step)
    assert abs(slope) > 1e-6
    assert slope == pytest.approx(difference, rel=1e-5)


@pytest.mark.fast_sets(1)
@every_law
def test_new_numbers_do_not_compile_again(law):
    scene, state, dt = swinging(law)
    run = jax.jit(lambda scene, state: jaxrod.advance(scene, state, dt, 5))
    begun = jaxrod.with_memory(scene, state)
    after = run(scene, begun)
    rod = scene.rod
    other = law(rod, 1.3, into=scene.effects[0])
    run(replace(scene, effects=(*scene.effects[:2], other)), after)
    assert run._cache_size() == 1


@pytest.mark.slow
@every_law
@pytest.mark.default_precision
def test_single_precision_is_enough(law):
    scene, state, dt = swinging(law)
    single = jaxrod.advance(scene, state, dt, 200)
    assert single.memory[2].keys() and single.positions.dtype == jnp.float32
    with jax.enable_x64(True):
        scene, state, _ = swinging(law, dtype=jnp.float64)
        double = jaxrod.advance(scene, state, float(dt), 200)
    np.testing.assert_allclose(single.positions, double.positions, atol=2e-4)


@every_law
def test_methods_without_twist_refuse_them(law):
    with pytest.raises(ValueError, match="stress in the material frame"):
        swinging(law, method=jaxrod.torsion_free())


@pytest.mark.slow
@every_law
def test_implicit_steps_agree(law):
    scene, state, dt = swinging(law)
    explicit = jaxrod.advance(scene, state, 0.25 * dt, 800)
    stiff = replace(scene, method=jaxrod.implicit())
    implicit = jaxrod.advance(stiff, state, dt, 200)
    moved = np.max(np.abs(explicit.positions - state.positions))
    gap = np.max(np.abs(implicit.positions - explicit.positions))
    assert gap < 5e-3 * moved


@pytest.mark.parametrize(
    ("law", "given", "words"),
    [
        ("standard_linear_solid", {"stiffness_ratio": 0.0}, "stiffness_ratio must be"),
        ("standard_linear_solid", {"relaxation_time": -1.0}, "got -1 s"),
        ("bending_hysteresis", {"stiffness": -2.0}, "got -2 N m"),
        ("bending_hysteresis", {"slip_moment": 0.0}, "slip_moment must be positive"),
        ("plastic_bending", {"yield_moment": 0.0}, "yield_moment must be positive"),
        ("plastic_bending", {"hardening": 1.0}, "hardening must be at most"),
    ],
)
def test_numbers_are_checked(law, given, words):
    good = {
        "standard_linear_solid": {"stiffness_ratio": 1.0, "relaxation_time": 0.1},
        "bending_hysteresis": {"stiffness": 1.0, "slip_moment": 0.1},
        "plastic_bending": {"yield_moment": 1.0},
    }[law]
    rod, _ = straight(2)
    with pytest.raises(ValueError, match=words):
        getattr(jaxrod.materials, law)(rod, **(good | given))

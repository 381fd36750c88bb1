"""Effects that remember: their memory is part of the state, in every method."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod

METHODS = {
    "consistent": jaxrod.consistent(),
    "pyelastica": jaxrod.pyelastica(),
    "planar": jaxrod.planar("zx"),
    "torsion-free": jaxrod.torsion_free(),
    "implicit": jaxrod.implicit(),
}
RISE, DT = 0.02, 1e-4


@jaxrod.extend.pytree
class Muscle(jaxrod.extend.Effect):
    """Pulls the tip along x as strongly as it is activated, which takes time."""

    command: jax.Array
    strength: jax.Array
    activation: jax.Array = jaxrod.extend.memory(default=0.0)

    def loads(self, rod, motion):
        pull = jnp.zeros_like(motion.position[0])
        pull = pull.at[-1].set(self.strength * self.activation)
        return jaxrod.extend.Loads(forces=(pull, 0 * pull, 0 * pull))

    def after_step(self, rod, motion, dt):
        kept = jnp.exp(-dt / RISE)
        return replace(
            self, activation=self.command + kept * (self.activation - self.command)
        )


@pytest.fixture(scope="module")
def rod_and_state():
    return jaxrod.straight_rod(
        3, length=1.0, radius=0.02, density=1000.0, youngs_modulus=1e6
    )


def muscled(rod, state, method=None, command=0.8):
    return jaxrod.make_scene(
        rod,
        jaxrod.gravity((0.0, 0.0, 0.0)),
        Muscle(command, 0.3),
        method=method,
    )


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("name", METHODS)
def test_what_an_effect_remembers_goes_on_in_every_method(name, rod_and_state):
    rod, state = rod_and_state
    scene = muscled(rod, state, METHODS[name])
    after = jaxrod.advance(scene, state, DT, 150)
    nothing, memory = after.memory
    activation = memory["activation"]
    assert nothing == {}
    exact = 0.8 * (1 - np.exp(-150 * DT / RISE))
    assert float(activation) == pytest.approx(exact, rel=1e-12)
    # The impulse: of the middle of the first step nothing, of the last 149 steps' end.
    levels = 0.8 * (1 - np.exp(-np.arange(150) * DT / RISE))
    if name == "implicit":
        return
    impulse = float(jnp.sum(rod.node_masses * after.velocities[0]))
    assert impulse == pytest.approx(0.3 * DT * np.sum(levels), rel=1e-12)


def test_runs_go_on_where_they_ended(rod_and_state):
    rod, state = rod_and_state
    scene = muscled(rod, state)
    records = jaxrod.rollout(scene, state, DT, 40, 20)
    assert records.memory[1]["activation"].shape == (3,)
    half = jaxrod.advance(scene, state, DT, 20)
    whole = jaxrod.advance(scene, half, DT, 20)
    np.testing.assert_allclose(
        whole.positions, records.positions[-1], rtol=0, atol=1e-15
    )
    np.testing.assert_allclose(
        whole.memory[1]["activation"], records.memory[1]["activation"][-1]
    )
    # A command that changes between runs does not touch what is remembered.
    other = muscled(rod, state, command=0.0)
    relaxing = jaxrod.advance(other, half, DT, 20).memory[1]["activation"]
    kept = np.exp(-20 * DT / RISE)
    assert float(relaxing) == pytest.approx(
        kept * float(half.memory[1]["activation"]), rel=1e-12
    )


@pytest.mark.slow
def test_gradients_and_batches_go_through_memory(rod_and_state):
    rod, state = rod_and_state

    def tip(command):
        scene = muscled(rod, state, command=command)
        return jaxrod.advance(scene, state, 1e-3, 30).tip[0]

    slope = float(jax.grad(tip)(0.5))
    assert slope == pytest.approx(float(tip(1.0) - tip(0.0)), rel=1e-3)
    commands = jnp.asarray([0.1, 0.4])
    batch = jax.vmap(tip)(commands)
    for k in range(2):
        assert float(batch[k]) == pytest.approx(float(tip(commands[k])), abs=1e-14)


def test_memory_that_is_not_of_the_scene_is_refused(rod_and_state):
    rod, state = rod_and_state
    after = jaxrod.advance(muscled(rod, state), state, DT, 1)
    without = jaxrod.make_scene(rod, jaxrod.gravity())
    with pytest.raises(ValueError, match="memory must be of the effects"):
        jaxrod.advance(without, after, DT, 1)
    jaxrod.advance(without, replace(after, memory=None), DT, 1)


@pytest.mark.slow
def test_energies_and_health_see_what_is_remembered(rod_and_state):
    rod, state = rod_and_state

    @jaxrod.extend.pytree
    class Charge(jaxrod.extend.Effect):
        charge: jax.Array = jaxrod.extend.memory(default=1.0)

        def energy(self, rod, state):
            return self.charge

        def after_step(self, rod, motion, dt):
            return replace(self, charge=2 * self.charge)

    scene = jaxrod.make_scene(rod, Charge())
    after = jaxrod.advance(scene, state, DT, 3)
    assert float(scene.potential_energy(state)) == pytest.approx(1.0)
    assert float(scene.potential_energy(after)) == pytest.approx(8.0)


@jaxrod.extend.pytree
class Bender(jaxrod.extend.Effect):
    """Couples about a material axis that begin at zero."""

    axis: int = jaxrod.extend.static()
    activation: jax.Array = jaxrod.extend.memory(default=0.0)

    def loads(self, rod, motion):
        along = jnp.full_like(rod.rest_lengths, self.activation)
        couples = [jnp.zeros_like(along)] * 3
        couples[self.axis] = along
        return jaxrod.extend.Loads(couples=tuple(couples))

    def after_step(self, rod, motion, dt):
        return replace(self, activation=self.activation + dt)


@pytest.mark.slow
def test_what_is_zero_at_first_is_refused_where_it_may_not_become_something(
    rod_and_state,
):
    rod, state = rod_and_state
    with pytest.raises(ValueError, match="loads"):
        jaxrod.make_scene(rod, Bender(0), method=jaxrod.torsion_free())
    normal = int(np.argmax(np.abs(np.asarray(state.directors)[:, 1, 0])))
    other = 1 - normal
    fine = jaxrod.make_scene(rod, Bender(normal), method=jaxrod.planar("zx"))
    jaxrod.advance(fine, state, DT, 1)
    tilting = jaxrod.make_scene(rod, Bender(other), method=jaxrod.planar("zx"))
    with pytest.raises(ValueError, match="couples of effects"):
        jaxrod.advance(tilting, state, DT, 1)


@pytest.mark.parametrize(
    ("begin", "change", "words"),
    [
        (0, lambda x, dt: x + dt, "makes a number of value, which began as int"),
        (0.0, lambda x, dt: jnp.zeros(3), r"keep the shape of value"),
    ],
)
def test_memory_keeps_its_type_and_shape(rod_and_state, begin, change, words):
    @jaxrod.extend.pytree
    class Counter(jaxrod.extend.Effect):
        value: jax.Array = jaxrod.extend.memory(default=0.0)

        def after_step(self, rod, motion, dt):
            return replace(self, value=change(self.value, dt))

    rod, state = rod_and_state
    with pytest.raises(TypeError, match=words):
        jaxrod.advance(jaxrod.make_scene(rod, Counter(begin)), state, DT, 2)


def test_memory_is_not_taken_for_that_of_other_effects(rod_and_state):
    rod, state = rod_and_state
    after = jaxrod.advance(muscled(rod, state), state, DT, 1)

    @jaxrod.extend.pytree
    class Spring(jaxrod.extend.Effect):
        rest: jax.Array = jaxrod.extend.memory(default=0.0)

        def after_step(self, rod, motion, dt):
            return self

    other = jaxrod.make_scene(rod, jaxrod.gravity((0.0, 0.0, 0.0)), Spring())
    with pytest.raises(ValueError, match="memory must be of the effects"):
        jaxrod.advance(other, after, DT, 1)


def test_a_loop_of_ones_own_begins_with_memory(rod_and_state):
    rod, state = rod_and_state
    scene = muscled(rod, state)
    body = lambda s, _: (jaxrod.advance(scene, s, DT, 2), None)
    start = jaxrod.with_memory(scene, state)
    after, _ = jax.jit(lambda s: jax.lax.scan(body, s, length=3))(start)
    once = jaxrod.advance(scene, state, DT, 6)
    np.testing.assert_allclose(after.positions, once.positions, rtol=0, atol=1e-15)
    frozen = jaxrod.freeze(jnp.asarray(True), start, once)
    np.testing.assert_array_equal(frozen.positions, state.positions)


@pytest.mark.slow
def test_a_stiffness_that_has_grown_is_warned_of(rod_and_state):
    @jaxrod.extend.pytree
    class Stiffening(jaxrod.extend.Effect):
        stiffness: jax.Array = jaxrod.extend.memory(default=0.0)

        def stability_bound(self, rod):
            nodes = jnp.zeros_like(rod.node_masses).at[-1].set(self.stiffness)
            return jaxrod.extend.StabilityBound(nodes=nodes)

        def after_step(self, rod, motion, dt):
            return replace(self, stiffness=self.stiffness + 1e9)

    rod, state = rod_and_state
    scene = jaxrod.make_scene(rod, Stiffening())
    with pytest.warns(jaxrod.UnstableStepWarning):
        jaxrod.advance(scene, state, jaxrod.stable_dt(scene).dt, 1)


def test_two_of_a_kind_remember_each_its_own(rod_and_state):
    rod, state = rod_and_state
    muscles = Muscle(0.8, 0.0), jaxrod.gravity((0.0, 0.0, 0.0)), Muscle(-0.5, 0.0)
    after = jaxrod.advance(jaxrod.make_scene(rod, *muscles), state, DT, 50)
    share = 1 - np.exp(-50 * DT / RISE)
    first, nothing, second = after.memory
    assert float(first["activation"]) == pytest.approx(0.8 * share, rel=1e-12)
    assert float(second["activation"]) == pytest.approx(-0.5 * share, rel=1e-12)
    assert nothing == {}

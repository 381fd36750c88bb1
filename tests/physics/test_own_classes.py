"""Slips in classes that users write are refused by name when the scene is made."""

import jax
import jax.numpy as jnp
import pytest

import jaxrod
from jaxrod.structure import pytree
from physics.rods import arm


class Bare(jaxrod.extend.Effect):
    """Not a pytree."""

    def loads(self, rod, motion):
        return jaxrod.extend.Loads()


@pytree
class Misspelt(jaxrod.extend.Effect):
    """One letter short."""

    def load(self, rod, motion):
        return jaxrod.extend.Loads()


@pytree
class Idle(jaxrod.extend.Effect):
    """No hook at all."""

    def strength(self):
        return 1.0


@pytree
class Helped(jaxrod.extend.Effect):
    """A hook, and helpers, one of which is called nearly like it."""

    size: jax.Array

    def loads(self, rod, motion):
        return self.load(motion)

    def load(self, motion):
        x, y, z = motion.position
        return jaxrod.extend.Loads(forces=(self.size * x, 0 * y, 0 * z))

    def strength(self):
        return self.size


@pytree
class Undecorated(Helped):
    """A pytree whose subclass below is none."""


class Forgotten(Undecorated):
    """Without the decorator of its base."""


@pytree
class Returning(jaxrod.extend.Effect):
    """Returns what it is given for a rod of five elements."""

    what: str = jaxrod.structure.static()

    def loads(self, rod, motion):
        one, node = jnp.ones(5), jnp.ones(6)
        return {
            "array": jnp.ones((3, 6)),
            "tuple": (node, node, node),
            "few nodes": jaxrod.extend.Loads(forces=(one, one, one)),
            "two": jaxrod.extend.Loads(forces=(node, node)),
            "many elements": jaxrod.extend.Loads(couples=(node, node, node)),
            "fits": jaxrod.extend.Loads(
                forces=(node, node, node), couples=(one, one, one)
            ),
        }[self.what]


@pytest.mark.parametrize(
    ("effect", "words"),
    [
        (Bare(), "Bare is not a pytree: write @jaxrod.extend.pytree above"),
        (Forgotten(jnp.ones(())), "Forgotten is not a pytree"),
        (Misspelt(), "Misspelt.load is not a hook .* is loads meant"),
        (Idle(), "Idle defines no hook of an effect"),
    ],
)
def test_a_slip_in_a_class_is_refused_by_name(effect, words):
    rod, _ = arm(5)
    with pytest.raises(TypeError, match=words):
        jaxrod.make_scene(rod, effect)


@pytest.mark.parametrize(
    ("what", "error", "words"),
    [
        (
            "array",
            TypeError,
            r"must return jaxrod.extend.Loads.*array of shape \(3, 6\)",
        ),
        (
            "tuple",
            TypeError,
            r"must return jaxrod.extend.Loads.*3 of shapes \(6,\), \(6,\)",
        ),
        ("few nodes", ValueError, r"forces .*shape \(6,\).* 6 nodes, got 3 .*\(5,\)"),
        ("two", ValueError, r"forces .*shape \(6,\).*got 2 of shapes"),
        ("many elements", ValueError, r"couples .*shape \(5,\).* 5 elements, got 3"),
    ],
)
def test_loads_that_do_not_fit_are_refused_with_both_shapes(what, error, words):
    rod, _ = arm(5)
    with pytest.raises(error, match=rf"Returning.loads .*{words}"):
        jaxrod.make_scene(rod, Returning(what))


def test_helpers_and_loads_that_fit_are_taken():
    rod, _ = arm(5)
    jaxrod.make_scene(rod, Helped(jnp.ones(())), Returning("fits"))
    jax.jit(lambda rod: jaxrod.make_scene(rod, Returning("fits")))(rod)


class BareCoupling(jaxrod.extend.Coupling):
    """Not a pytree."""

    def loads(self, seen):
        return {}


@pytree
class MisspeltCoupling(jaxrod.extend.Coupling):
    """One letter too many."""

    def constrains(self, seen):
        return {}


@pytree
class IdleCoupling(jaxrod.extend.Coupling):
    """No hook at all."""


@pytest.mark.parametrize(
    ("coupling", "words"),
    [
        (BareCoupling(), "BareCoupling is not a pytree"),
        (MisspeltCoupling(), "MisspeltCoupling.constrains .* is constrain meant"),
        (IdleCoupling(), "IdleCoupling defines no hook of a coupling"),
    ],
)
def test_a_slip_in_a_coupling_is_refused_by_name(coupling, words):
    rod, _ = arm(5)
    with pytest.raises(TypeError, match=words):
        jaxrod.make_system({"one": jaxrod.make_scene(rod)}, coupling)


@pytree
class ReadingCoupling(jaxrod.extend.Coupling):
    """One hook, chosen when it is made, reads a number that is traced."""

    size: jaxrod.extend.Leaf
    hook: str = jaxrod.extend.static(default="")

    def _read(self, hook):
        return float(self.size) if hook == self.hook else self.size

    def loads(self, seen):
        position = seen["one"].motion.position
        forces = tuple(self._read("loads") * x for x in position)
        return {"one": jaxrod.extend.Loads(forces)}

    def energy(self, seen):
        return self._read("energy") * jnp.sum(seen["one"].motion.position[0])


@pytest.mark.parametrize("hook", ["loads", "energy"])
def test_a_hook_of_a_coupling_that_reads_a_traced_number_is_named(hook):
    rod, state = arm(3)
    members, states = {"one": jaxrod.make_scene(rod)}, {"one": state}
    assert jaxrod.make_system(members, ReadingCoupling(1.0), state=states).couplings
    words = rf"ReadingCoupling\.{hook} reads .* keep it an array"
    with pytest.raises(TypeError, match=words):
        jaxrod.make_system(members, ReadingCoupling(1.0, hook), state=states)


def test_a_run_without_a_checked_state_names_the_hook_too():
    rod, state = arm(3)
    coupling = ReadingCoupling(1.0, "loads")
    system = jaxrod.make_system({"one": jaxrod.make_scene(rod)}, coupling)
    with pytest.raises(TypeError, match=r"ReadingCoupling\.loads reads .* an array"):
        jaxrod.advance(system, {"one": state}, 1e-5, 1)


@pytree
class Reading(jaxrod.extend.Effect):
    """One hook, chosen when it is made, reads a number that is traced."""

    size: jaxrod.extend.Leaf
    hook: str = jaxrod.extend.static(default="")

    def _read(self, hook, number):
        return float(number) if hook == self.hook else number

    def loads(self, rod, motion):
        forces = tuple(self._read("loads", self.size) * x for x in motion.position)
        return jaxrod.extend.Loads(forces=forces)

    def constrain_rates(self, rod, motion):
        self._read("constrain_rates", self.size)
        return motion

    def energy(self, rod, state):
        return self._read("energy", self.size) * jnp.sum(state.positions)

    def stability_bound(self, rod):
        stiffness = self._read("stability_bound", self.size)
        return jaxrod.extend.StabilityBound(nodes=stiffness + 0 * rod.node_masses)


@pytest.mark.parametrize(
    "hook", ["loads", "constrain_rates", "energy", "stability_bound"]
)
def test_a_hook_that_reads_a_traced_number_is_named(hook):
    rod, _ = arm(3)
    assert jaxrod.make_scene(rod, Reading(1.0)).effects
    with pytest.raises(TypeError, match=rf"Reading\.{hook} reads .* keep it an array"):
        jaxrod.make_scene(rod, Reading(1.0, hook))


@pytree
class Listed(jaxrod.schedules.Schedule):
    """A schedule with a list as structure: changed later, it would keep its values."""

    values: list[float] = jaxrod.extend.static()

    def __call__(self, clock):
        return jnp.asarray(self.values)[jnp.clip(clock.step, 0, 1)]

    @property
    def largest(self):
        return jnp.max(jnp.asarray(self.values))


def test_a_list_as_structure_is_refused():
    rod, _ = arm(3)
    assert jaxrod.make_scene(rod, Helped(Listed((1.0, 2.0)))).effects
    with pytest.raises(TypeError, match=r"Listed\.values is static.*got list.*a tuple"):
        jaxrod.make_scene(rod, Helped(Listed([1.0, 2.0])))


@pytree
class Odd(Helped):
    """Hooks that return something else than they should, if they are asked to."""

    odd: str = jaxrod.extend.static(default="")

    def energy(self, rod, state):
        return state.positions[2] if self.odd == "energy" else state.positions[2, 0]

    def stability_bound(self, rod):
        bound = jaxrod.extend.StabilityBound(nodes=self.size + 0 * rod.node_masses)
        return self.size if self.odd == "stability_bound" else bound

    def damping_rates(self, rod):
        return self.size if self.odd == "damping_rates" else (self.size, self.size)

    def constrain_rates(self, rod, motion):
        return None if self.odd == "constrain_rates" else motion


@pytest.mark.parametrize(
    ("hook", "words"),
    [
        ("energy", r"one number \[J\], got an array of shape \(4,\)"),
        ("stability_bound", "a jaxrod.extend.StabilityBound, got an array of shape"),
        ("damping_rates", r"two rates, .* \[1/s\], got an array of shape"),
        ("constrain_rates", "the motion, .*, got NoneType"),
    ],
)
def test_what_a_hook_returns_is_checked(hook, words):
    rod, _ = arm(3)
    assert jaxrod.make_scene(rod, Odd(1.0)).effects
    with pytest.raises(TypeError, match=rf"Odd\.{hook} must return {words}"):
        jaxrod.make_scene(rod, Odd(1.0, hook))

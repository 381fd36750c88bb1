"""Drawn faults that change no number that anybody could see, each with its reason."""

from __future__ import annotations

REASONS: dict[tuple[str, str], str] = {
    (
        "envs/gym.py",
        "number: `2` -> `3` in "
        "`drawn = int(self.np_random.integers(2**32)) if seed is None else seed`",
    ): "seeds are drawn from more numbers, each as good as another",
    (
        "jaxrod/viz/colours.py",
        "number: `200` -> `201` in `hue = (200 + 200 * rod / (rods - 1)) % 360 / 360`",
    ): "a colour a degree further round the circle is as good",
    (
        "jaxrod/systems/contact/touching_rods.py",
        "index: `0` -> `(-1)` in "
        "`here = slice(start, start + elements[b].radii.shape[0])`",
    ): "radii have one axis: the first is the last",
    (
        "jaxrod/actuation/section_load.py",
        "number: `2` -> `3` in `return 2 * (inverse[1:] + inverse[:-1])`",
    ): "it only weighs the parts of a bound, and any weights give a bound",
    (
        "jaxrod/viz/shapes.py",
        "number: `1e-9` -> `(2 * 1e-9)` in "
        "`normals[f, c] = total / size if size > 1e-9 else face[f]`",
    ): "sums of unit normals are of size one or cancel to rounding",
    (
        "envs/soft_bodies/snake_body.py",
        "number: `1.0` -> `(2 * 1.0)` in `normal=(0.0, 0.0, 1.0),`",
    ): "a normal may be of any length: its direction is taken",
    (
        "jaxrod/tradeoff/workload.py",
        "index: `0` -> `(-1)` in `VISCOSITY / float(rod.linear_density[0]),`",
    ): "the arm is uniform: the first element is like the last",
    (
        "training/algorithms/td3.py",
        "index: `0` -> `(-1)` in `batch.noise[0],`",
    ): "TD3 draws one array of noise for a batch: the first is the last",
    (
        "jaxrod/cli/recording.py",
        "index: `0` -> `(1)` in `reward = jnp.zeros_like(frames.reward[0])`",
    ): "zeros like any row are the same",
    (
        "envs/brax_env.py",
        "number: `2` -> `3` in "
        "`observation, running = self._start(_key(rng, 2 * ticks))`",
    ): "the number of ticks is zero there",
    (
        "jaxrod/systems/stepping/runs.py",
        "number: `1` -> `2` in "
        "`return jnp.where(free, jnp.inf, 4 * inertia / jnp.where(free, 1, be...`",
    ): "it divides what `where` does not choose: it has to differ from zero",
    (
        "jaxrod/lanes/kernels.py",
        "number: `1` -> `2` in `[array.reshape(-1).tolist() for array in begun],`",
    ): "NumPy takes -2 for -1 in a new shape",
    (
        "jaxrod/viz/recording.py",
        "index: `0` -> `(-1)` in `return self.rods[0]`",
    ): "there is one kind of rods there: the first is the last",
    (
        "envs/soft_bodies/octopus_body.py",
        "number: `0.0` -> `1.0` in "
        "`jaxrod.shapes.plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),`",
    ): "any point of the floor gives the same floor",
    (
        "jaxrod/analysis/stability.py",
        "number: `0.5` -> `(2 * 0.5)` in "
        "`0.5 * (lower + upper), (lower, guess), (upper, -guess), (upper, -gu...`",
    ): "the search for a root begins elsewhere and finds the same root",
    (
        "jaxrod/methods/planar.py",
        "index: `0` -> `(1)` in "
        "`stepper = method.stepper(scene, state, jnp.ones_like(rod.rest_lengt...`",
    ): "ones like any element are the same",
    (
        "jaxrod/statics/effect_tangents.py",
        "number: `3` -> `4` in "
        "`moved = colour[None, None, :, None] == jnp.arange(3)[:, None, None,...`",
    ): "a fourth colour moves nothing, and nobody looks at it",
    (
        "envs/soft_bodies/snake_body.py",
        "index: `0` -> `(1)` in "
        "`drag = relaxation_time * rod.joint_stiffness[0] / rod.joint_lengths`",
    ): "sections are round: both bending stiffnesses are the same",
    (
        "jaxrod/systems/statics/rigid_motions.py",
        "dropped term: `+ matrix[1][1]` -> `` in "
        "`size = matrix[0][0] + matrix[1][1] + matrix[2][2]`",
    ): "the size only scales what is divided by it again",
    (
        "jaxrod/lanes/rows/schedule.py",
        "min and max: `min` -> `max` in `first = min(first, at)`",
    ): "gaps may be filled at any level before that of the first reader",
    (
        "jaxrod/systems/contact/neighbour_search.py",
        "sign: `-` -> `` in "
        "`pairs = jnp.stack([listed.own, listed.other], axis=-1)[place]`",
    ): "rows are stacked: the new last axis is axis 1",
    (
        "jaxrod/twin/identification.py",
        "number: `0` -> `1` in "
        "`away = np.where(there, made - np.where(there, group.seen, 0), 0)`",
    ): "it stands where nothing was seen, which is left out of the rows",
    (
        "jaxrod/lanes/rows/row_graph.py",
        "number: `1` -> `2` in `return at.reshape(-1)`",
    ): "NumPy takes any negative length for the one that is left",
}
"""Reasons by file and change."""

"""Windows of recordings: many short runs replace a long run (multiple shooting).

A long run that departs from the data at a bifurcation (buckling, contact) never returns
to them, and its sum of squares has many local minima. Short windows that start at the
data stay close to them.

Source: H. G. Bock, Recent advances in parameter identification techniques for O.D.E.,
1983.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrod.structure import pytree, static
from jaxrod.validation import check_count, is_traced


@pytree
class MultipleShooting:
    r"""Windows with unknown initial states, for `fit`.

    A recording has noisy positions and no velocities, so the initial state $x_w$ of
    each window is unknown. `fit` finds the parameters $p$ and the unknowns $s$ of
    initial states together. There are two kinds of windows:

    Independent windows (without `states`) minimise

    $$\sum_w \sum_k \left(\frac{y_{wk}(p, x_w) - \hat y_{wk}}{\sigma_{wk}}\right)^2,
    \qquad x_w = b(p, s_w).$$

    Errors of the initial states do not count as errors of the model, and the standard
    deviations of the parameters account for them. A window needs more observations than
    its initial state has unknowns. If an initial state has many unknowns, each observed
    only a few times, a search may end in a local minimum near the best one, where
    initial states compensate for wrong parameters. Neither the misfit nor the standard
    deviations show this (docs/identification.md has an example). Use the result as the
    initial guess for joined windows, or test the fit on simulated recordings.

    Joined windows (with `states`) follow each other along trajectories, and only the
    first state of each trajectory has unknowns,

    $$x_1 = b(p, s), \qquad x_{w+1} = e_w(p, x_w).$$

    The minimum, and its standard deviations, are those of one long run of each
    trajectory. During the search there may be gaps between windows, so that they follow
    the data across bifurcations, where a single long run would lose them. Joined
    windows need initial parameters within a few tens of per cent of the true ones, and
    initial states close to the observed ones. One evaluation costs about one run of all
    windows, one after another, with a tangent for each parameter and for each unknown
    of a first state.

    Example:
        >>> places = jnp.zeros((4, 3))  # first guesses for four windows [m]
        >>> shooting = control.MultipleShooting(unknowns={"place": places})
        >>> shooting.joined  # the windows are independent
        False
    """

    unknowns: Any
    """Initial guess of the unknowns of initial states: a pytree of floats, stacked on
    the leading axis by window, or by trajectory for joined windows;
    `jnp.zeros((trajectories, 0))` if there are none."""
    states: Any = None
    """Initial guess of the initial states of joined windows: a pytree of finite floats,
    stacked by trajectory and window on the leading axes. Those of first windows are
    ignored."""
    known: Any = ()
    """Known data of each window, such as its time, stacked like the observations."""
    initial_state: Callable[[dict[str, Any], Any, Any], Any] | None = static(
        default=None
    )
    """`(parameters, unknowns, known) -> state`, the initial state of a window, or of
    the first window of a trajectory; the unknowns themselves if `None`."""

    @property
    def joined(self) -> bool:
        """Whether windows follow each other along trajectories (`states` is given)."""
        return self.states is not None

    def state(self, parameters: dict[str, Any], unknowns: Any, known: Any) -> Any:
        """Returns the initial state of a window, computed by `initial_state`.

        Without `initial_state` it returns `unknowns`. Arguments are those of
        `initial_state`.
        """
        if self.initial_state is None:
            return unknowns
        return self.initial_state(parameters, unknowns, known)

    def simulation(
        self, run: Callable[[dict[str, Any], Any, Any], Any]
    ) -> Callable[[dict[str, Any]], Any]:
        """Makes a simulation of all windows, from the guesses of initial states.

        Args:
            run: Takes parameters, initial state and known data of a window; returns its
                observations and, for joined windows, its end state.
        """
        if self.joined:
            every = jax.vmap(jax.vmap(run, (None, 0, 0)), (None, 0, 0))
            return lambda values: every(values, self.states, self.known)[0]

        def one(values: dict[str, Any], unknowns: Any, known: Any) -> Any:
            return run(values, self.state(values, unknowns, known), known)

        return lambda values: jax.vmap(one, (None, 0, 0))(
            values, self.unknowns, self.known
        )

    def check(self, run: Any, observed: Any, start: Mapping[str, Any]) -> None:
        """Raises unless arrays are stacked alike and initial guesses are finite floats.

        Arguments are as in `fit`: the simulation of a window, observations, and the
        initial guess of the parameters.

        Raises:
            ValueError: Numbers of trajectories or windows differ; initial guesses are
                not finite floats; or the end state of `run` has a different structure
                or shape than its initial state.
        """
        count = count_windows("unknowns", self.unknowns)
        check_finite_floats("unknowns", self.unknowns)
        leaves = jax.tree.leaves((self.states, self.known, observed))
        if not self.joined:
            counts = {np.shape(leaf)[:1] for leaf in leaves}
            if counts != {(count,)}:
                raise ValueError(
                    f"observed and known must have a leading axis of {count} windows, "
                    f"as unknowns have, got {sorted(counts)}"
                )
            return
        counts = {np.shape(leaf)[:2] for leaf in leaves}
        if len(counts) != 1 or {(len(c), *c[:1]) for c in counts} != {(2, count)}:
            raise ValueError(
                "states, known and observed must have leading axes of trajectories "
                f"and windows, for {count} trajectories, got {sorted(counts)}"
            )
        later = jax.tree.map(lambda leaf: jnp.asarray(leaf)[:, 1:], self.states)
        check_finite_floats("states", later)
        values = {name: jnp.asarray(value) for name, value in start.items()}
        own = jax.tree.map(lambda leaf: leaf[0], self.unknowns)
        state, known = jax.tree.map(lambda leaf: leaf[0, 0], (self.states, self.known))
        wanted = jax.eval_shape(lambda: state)
        tree: Any = jax.tree.structure(wanted)
        for what, kind in (
            ("initial_state must make", jax.eval_shape(self.state, values, own, known)),
            (
                "simulate must end in",
                jax.eval_shape(lambda *given: run(*given)[1], values, state, known),
            ),
        ):
            if jax.tree.structure(kind) != tree or _shapes(kind) != _shapes(wanted):
                raise ValueError(
                    f"{what} a state like those in states, {_shapes(wanted)}, got "
                    f"{_shapes(kind)}"
                )


def _shapes(state: Any) -> list[tuple[int, ...]]:
    return [leaf.shape for leaf in jax.tree.leaves(state)]


def shots(
    run: Callable[[dict[str, Any], Any], Any], states: Any
) -> Callable[[dict[str, Any]], Any]:
    """Makes a simulation of all windows as one batch, for `fit`.

    Initial states are given, for example measured. If they are unknown, use
    `MultipleShooting`.

    Args:
        run: Takes parameters and the initial state of a window; returns the window's
            observations.
        states: Initial states of the windows, stacked on the leading axis.

    Returns:
        `parameters -> observations`, stacked by window on the leading axis.

    Raises:
        ValueError: The leaves of `states` do not all have the same number of windows.

    Example:
        >>> def run(parameters, start):
        ...     return start * jnp.exp(-parameters["rate"] * jnp.arange(1.0, 4.0))
        >>> simulate = control.shots(run, jnp.array([1.0, 2.0]))
        >>> simulate({"rate": 0.5}).shape  # windows, frames
        (2, 3)
    """
    count_windows("states", states)

    def simulate(parameters: dict[str, Any]) -> Any:
        return jax.vmap(lambda state: run(parameters, state))(states)

    return simulate


def count_windows(name: str, stacked: Any) -> int:
    """Counts the windows or trajectories: the length of the leading axis of all leaves.

    `name` is the name of the tree `stacked` in the error message.

    Raises:
        ValueError: The leaves have leading axes of different lengths.
    """
    sizes = {np.shape(leaf)[:1] for leaf in jax.tree.leaves(stacked)}
    if len(sizes) != 1 or () in sizes:
        raise ValueError(
            f"{name} must have a leading axis of the same length in every leaf, got "
            f"{sorted(sizes)}"
        )
    return sizes.pop()[0]


def check_finite_floats(name: str, tree: Any) -> None:
    """Raises a `ValueError` unless all leaves of `tree` are finite floats.

    `name` is the name of the tree in the error message.

    Raises:
        ValueError: A leaf is not floating point, or its value is known and not finite.
    """
    for leaf in map(jnp.asarray, jax.tree.leaves(tree)):
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            raise ValueError(f"{name} must be of floats, got {leaf.dtype}")
        if not is_traced(leaf) and not np.all(np.isfinite(np.asarray(leaf))):
            raise ValueError(
                f"{name} must be finite: unobserved values need a guess here"
            )


def windows(
    observed: Any,
    frames: int,
    every: int | None = None,
    *,
    with_starts: bool = False,
) -> Any:
    """Cuts a recording into windows, stacked on the leading axis.

    The start of window `k` is frame `k * every`. The window holds the frames after it,
    from frame `k * every + 1` on.

    Args:
        observed: A tree of arrays with the frames on the leading axis; the first frame
            is the start of the first window.
        frames: Number of frames in a window.
        every: Number of frames from one start to the next; `frames` by default.
        with_starts: Whether a window includes the frame of its start, as needed if
            initial states are unknown (`MultipleShooting`).

    Raises:
        ValueError: A count is out of range, or there are fewer frames than in a window.

    Example:
        >>> film = jnp.arange(7.0)
        >>> control.windows(film, frames=3).tolist()  # frame 0 is only a start
        [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    """
    frames = check_count("frames", frames, 1)
    every = check_count("every", frames if every is None else every, 1)
    lengths = {len(leaf) for leaf in jax.tree.leaves(observed)}
    skipped = 0 if with_starts else 1
    if len(lengths) != 1 or min(lengths) < frames + skipped:
        raise ValueError(
            f"observed must have at least {frames + skipped} frames, the same number "
            f"in every leaf, got {sorted(lengths)}"
        )
    first = range(skipped, min(lengths) - frames + 1, every)
    return jax.tree.map(
        lambda leaf: jnp.stack([leaf[k : k + frames] for k in first]), observed
    )

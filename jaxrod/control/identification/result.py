r"""A fit: parameters found from data, their uncertainty, and undetermined directions.

With residuals $r$ in units of their noise and their Jacobian $J$ with respect to the
search variables ($\log(p / p_0)$, or $(p - p_0) / s$ with scales $s$),

$$\mathrm{cov} = \sigma^2 (J^T J)^{-1} = \sigma^2 V \mathrm{diag}(d^{-2}) V^T,
\qquad J = U\, \mathrm{diag}(d)\, V^T,$$

which is the Cramér-Rao bound if the noise is Gaussian. $\sigma$ is one if the noise is
given; otherwise it is estimated from the residuals. The data do not determine a
direction $v_k$, a column of $V$, if $\sigma / d_k$ exceeds one (100 % of a value), or
if $d_k$ is round-off compared with the largest singular value.

Source: G. A. F. Seber, C. J. Wild, Nonlinear Regression, 1989, sections 2.1 and 3.4.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxrod.control.identification.parameters import Parameters
from jaxrod.structure import pytree
from jaxrod.validation import is_traced

VAGUE = 1.0
"""Standard deviation of the search variable along a direction above which the data do
not determine the direction [1]."""
NEAR = 0.1
"""Largest remaining step of a converged search, in standard deviations."""
PLAIN = 0.05
"""Components of a direction below this fraction of the largest are left out of its
description [1]."""


@pytree
class Forecast:
    """A fit's prediction of further observations.

    Example:
        >>> x = jnp.arange(5.0)
        >>> line = lambda p: p["slope"] * x
        >>> found = control.fit(line, 3.0 * x, {"slope": 1.0}, noise=0.1)
        >>> ahead = found.forecast(lambda p: p["slope"] * 10.0)
        >>> round(float(ahead.value), 2), round(float(ahead.sd), 2)
        (30.0, 0.18)
    """

    value: Any
    """Expected observations: the simulation at the fitted parameters."""
    sd: Any
    """Standard deviations due to the uncertainty of the parameters, without noise.
    Along directions that the data do not determine, parameters are taken to be
    uncertain by 100 % of their values."""


@pytree
class Fit:
    """Parameters found from data by `fit`; a batch of fits under `jax.vmap`.

    `print(fit)` shows a table, and describes what the data do not determine.

    Example:
        >>> x = jnp.arange(5.0)
        >>> line = lambda p: p["slope"] * x
        >>> found = control.fit(line, 3.0 * x, {"slope": 1.0}, noise=0.1)
        >>> round(float(found.values["slope"]), 3), bool(found.determined)
        (3.0, True)
        >>> round(float(found.standard_deviations["slope"]), 3)
        0.018
    """

    parameters: Parameters
    """Names, initial values and scales of the parameters."""
    values: dict[str, Any]
    """Parameters at the minimum of the sum of squares."""
    standard_deviations: dict[str, Any]
    """Standard deviations of the parameters, in their units; infinite if round-off
    hides them."""
    covariance: Float[Array, "p p"]
    """Covariance of the search variables, log(p / p_0) or (p - p_0) / scale."""
    singular_values: Float[Array, " p"]
    """Singular values of the Jacobian of the residuals (in units of the noise), the
    largest first."""
    directions: Float[Array, "p p"]
    """Right singular vectors of the Jacobian as rows: directions in the space of the
    search variables, in the order of `singular_values`."""
    residual_sd: Any
    """Root mean square of the residuals of each kind of observation, in its units."""
    misfit: Float[Array, ""]
    """Sum of squared residuals in units of the noise, divided by the degrees of
    freedom: about one if model and noise are right, exactly one if no noise was
    given."""
    remaining: Float[Array, ""]
    """Length of the Gauss-Newton step from `values` to the minimum, in standard
    deviations, along directions that the data determine."""
    converged: Bool[Array, ""]
    """Whether `remaining` is less than 0.1 and, with joined windows, their gaps are
    closed."""
    iterations: Int[Array, ""]
    """Number of points tried after the initial guess."""
    at_bound: Bool[Array, " p"]
    """Whether each parameter is at a bound, where its standard deviation is not
    reliable."""
    degrees_of_freedom: Int[Array, ""]
    """Degrees of freedom: number of observations minus number of unknowns [1]."""
    unknowns: Any = None
    """Fitted unknowns of initial states, with multiple shooting; else `None`."""
    states: Any = None
    """Fitted initial states of all windows, with multiple shooting; else `None`."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the scalar parameters, in the order of rows of `covariance`."""
        return self.parameters.names

    @property
    def correlation(self) -> Float[Array, "p p"]:
        """Correlation matrix of the search variables: cov_ij / (sd_i sd_j)."""
        sd = jnp.sqrt(jnp.diagonal(self.covariance, axis1=-2, axis2=-1))
        scale = jnp.where(sd > 0, sd, 1)
        return self.covariance / (scale[..., :, None] * scale[..., None, :])

    @property
    def vague(self) -> Bool[Array, " p"]:
        """Mask of the rows of `directions` that the data do not determine."""
        return vague_ways(self.singular_values)

    @property
    def determined(self) -> Bool[Array, ""]:
        """Whether the data determine every direction."""
        return ~jnp.any(self.vague, axis=-1)

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Directions that the data do not determine, each described by a sentence.

        Raises:
            ValueError: This is a batch of fits: select one, for example
                `jax.tree.map(lambda a: a[0], fit)`.

        Example:
            >>> x = jnp.arange(5.0)
            >>> line = lambda p: p["slope"] * x
            >>> found = control.fit(line, 3.0 * x, {"slope": 1.0}, noise=0.1)
            >>> found.undetermined
            ()
        """
        if self.covariance.ndim > 2:
            raise ValueError(
                "undetermined needs a single fit, and this is a batch of "
                f"{self.covariance.shape[:-2]}: select one, "
                "jax.tree.map(lambda leaf: leaf[0], fit)"
            )
        rows = zip(self.vague, self.directions, self.singular_values, strict=True)
        return tuple(
            _words(np.asarray(way), self.names, self.parameters.by_log)
            for hidden, way, _ in rows
            if bool(hidden)
        )

    def z(self, truth: Mapping[str, Any]) -> dict[str, Array]:
        """Returns the search variables' errors in standard deviations (z-scores).

        Args:
            truth: True parameters, with the names and shapes of `values`.

        Example:
            >>> x = jnp.arange(5.0)
            >>> line = lambda p: p["slope"] * x
            >>> found = control.fit(line, 3.0 * x, {"slope": 1.0}, noise=0.1)
            >>> round(float(found.z({"slope": 3.0})["slope"]), 1)
            0.0
        """
        if self.covariance.ndim > 2:
            return jax.vmap(lambda fit: fit.z(truth))(self)
        away = self.parameters.searched(self.values) - self.parameters.searched(truth)
        sd = jnp.sqrt(jnp.diagonal(self.covariance, axis1=-2, axis2=-1))
        return self.parameters.named(away / sd)

    def forecast(self, simulate: Callable[[dict[str, Any]], Any]) -> Forecast:
        """Predicts the result of another simulation, with its standard deviation.

        Args:
            simulate: Takes parameters and returns any pytree, for example for a longer
                time or under other loads.

        Example:
            >>> x = jnp.arange(5.0)
            >>> line = lambda p: p["slope"] * x
            >>> found = control.fit(line, 3.0 * x, {"slope": 1.0}, noise=0.1)
            >>> ahead = found.forecast(lambda p: p["slope"] * 10.0)
            >>> round(float(ahead.value), 2), round(float(ahead.sd), 2)
            (30.0, 0.18)
        """
        if self.covariance.ndim > 2:
            return jax.vmap(lambda fit: fit.forecast(simulate))(self)
        point = self.parameters.searched(self.values)

        def made(point: Array) -> Any:
            return simulate(self.parameters.values(point))

        sd = 1 / jnp.where(self.vague, 1 / VAGUE, self.singular_values)
        ways = sd[:, None] * self.directions

        def along(way: Array) -> tuple[Any, Any]:
            return jax.jvp(made, (point,), (way,))

        value, moved = jax.vmap(along, out_axes=(None, 0))(ways)
        spread = jax.tree.map(lambda m: jnp.sqrt(jnp.sum(m**2, axis=0)), moved)
        return Forecast(value, spread)

    def __repr__(self) -> str:
        """Returns a table of the parameters, with remarks on the fit."""
        if is_traced(self) or self.covariance.ndim > 2:
            return f"Fit of {', '.join(self.names)}, {self.covariance.shape[:-2]} fits"
        return "\n".join([*_table(self), *_remarks(self)])


def vague_ways(s: Array) -> Array:
    """Mask of the singular values `s` whose directions the data do not determine.

    They are below `1 / VAGUE`, round-off compared with the largest, or not finite.
    """
    hidden = s <= smallest_ratio(s.dtype) * s[..., :1]
    return hidden | (s * VAGUE < 1) | ~jnp.isfinite(s)


def smallest_ratio(dtype: Any) -> float:
    """Ratio to the largest singular value below which a singular value is round-off."""
    return float(jnp.finfo(dtype).eps) ** 0.5


def _words(way: np.ndarray, names: tuple[str, ...], by_log: tuple[bool, ...]) -> str:
    """Describes a direction that the data do not determine, as a sentence.

    `way` has the direction's component of each scalar parameter in `names`; `by_log`
    says which of them are found by their logarithm.
    """
    shares = way / way[np.argmax(np.abs(way))]
    part = [k for k in np.argsort(-np.abs(shares)) if abs(shares[k]) >= PLAIN]
    if len(part) == 1:
        return f"{names[part[0]]}: the data say next to nothing about it"
    changes = ", ".join(
        f"{names[k]} by {10 * shares[k]:+.2g} %"
        + ("" if by_log[k] else " of its scale")
        for k in sorted(part)
    )
    several = " and ".join(names[k] for k in sorted(part))
    return f"{several} each: changing {changes} together leaves the data as they are"


def _table(fit: Fit) -> list[str]:
    values = np.asarray(fit.parameters.flat(fit.values), float)
    sds = np.asarray(fit.parameters.flat(fit.standard_deviations), float)
    relative = np.sqrt(np.diag(np.asarray(fit.covariance, float)))
    width = max(len("parameter"), *map(len, fit.names))
    correlation = np.asarray(fit.correlation, float)
    few = len(fit.names) <= 8
    head = f"{'parameter':<{width}}  {'value':>12} {'sd':>12}"
    lines = [head + ("   correlations" if few and len(fit.names) > 1 else "")]
    for k, name in enumerate(fit.names):
        sure = np.isfinite(sds[k]) and relative[k] <= VAGUE
        sd = f"{sds[k]:>12.2g}" if sure else f"{'not known':>12}"
        row = f"{name:<{width}}  {values[k]:>12.5g} {sd}"
        if few:
            row += "  " + "".join(f" {correlation[k, j]:+.2f}" for j in range(k))
        lines.append(row.rstrip())
    return lines


def _remarks(fit: Fit) -> list[str]:
    if not np.isfinite(float(fit.misfit)):
        return [
            "NOTHING FOUND: the simulation at the start is not finite, or its "
            "derivatives are not (is the step stable there?)"
        ]
    kinds, _ = jax.tree_util.tree_flatten_with_path(fit.residual_sd)
    lines = []
    for path, rms in kinds:
        name = jax.tree_util.keystr(path, simple=True, separator=".") or "observations"
        lines.append(f"residual sd of {name}: {float(rms):.3g}")
    lines.append(
        f"misfit {float(fit.misfit):.3g} over {int(fit.degrees_of_freedom)} degrees of "
        f"freedom; {int(fit.iterations)} iterations"
        + (
            ""
            if bool(fit.converged)
            else f", NOT CONVERGED: {float(fit.remaining):.2g} standard deviations left"
        )
    )
    if float(fit.misfit) > 1 + 5 * np.sqrt(2 / max(int(fit.degrees_of_freedom), 1)):
        lines.append(
            "the misfit is more than noise: the model is wrong somewhere, the search "
            "has stopped short, or noise is too small; the standard deviations are too "
            "small then"
        )
    for k, name in enumerate(fit.names):
        if bool(fit.at_bound[k]):
            lines.append(f"{name} is at its bound")
    lines += [f"not determined: {words}" for words in fit.undetermined]
    return lines

"""Means and covariances of errors by bins of range and visible share, under a memory, drawn towards what all share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from copem_replay.core.tracks import Float, Int
from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.pipeline.fit.error_memory import Series, Shares, whitened
from copem_replay.pipeline.fit.errors_kernel import squared_correlations

EFFECTIVE_ROWS = 20
"""A bin holds at least so many independent rows (chosen)."""
MOST_BINS = 5
"""Of range (chosen)."""
_WHOLE = 0.95
"""From this visible share on an object counts as wholly visible (chosen)."""
_STRENGTHS = np.geomspace(4, 1e5, 60)
"""Degrees of freedom of the inverse Wishart that are tried; 3 or fewer have no mean."""
_RIDGE = 1e-3
"""Rows that every bin borrows from the mean of all, so that an empty one has it."""


@dataclass(frozen=True)
class Bin:
    """Where one covariance holds: from range to range, and of a visible share where that is told apart."""

    range_m: tuple[float, float]
    visible_share: tuple[float, float] | None = None

    @property
    def when(self) -> dict[str, Any]:
        """The condition of a couple."""
        when = {"range_m": list(self.range_m)}
        return when if self.visible_share is None else when | {"visible_share": list(self.visible_share)}


@dataclass(frozen=True)
class Moments:
    """By bin (B,): `mean_m (B, 2)`, `covariance_m2 (B, 2, 2)`, rows `n`, and what they are worth.

    `of_mean`: the mean's variance is the covariance times this. `freedom`: degrees of freedom of the covariance.
    """

    mean_m: Float
    covariance_m2: Float
    n: Int
    of_mean: Float
    freedom: Float

    def standardised(self, error_m: Float, bin_ix: Int) -> Float:
        """(n, 2) L⁻¹ (e − mean) of each row's bin."""
        first, below, second = _factors(self.covariance_m2)
        rest = error_m - self.mean_m[bin_ix]
        z = rest[:, 0] / first[bin_ix]
        return np.column_stack([z, (rest[:, 1] - below[bin_ix] * z) / second[bin_ix]])

    def log_determinant(self) -> Float:
        """(B,) ln |L|."""
        first, _, second = _factors(self.covariance_m2)
        log: Float = np.log(first * second)
        return log


def _factors(covariance: Float) -> tuple[Float, Float, Float]:
    """Cholesky of (B, 2, 2), as the replayed model has it."""
    first = np.sqrt(covariance[:, 0, 0])
    below = covariance[:, 0, 1] / first
    return first, below, np.sqrt(np.maximum(covariance[:, 1, 1] - below**2, 1e-12))


def range_bins(view: ViewGeometry, worth: float, edges_m: tuple[float, ...] | None = None) -> tuple[Bin, ...]:
    """Bins of range with about as many rows each, no emptier than `worth` (effective rows per row) lets them be."""
    far_m = float(np.ceil(10 * view.range_m.max()) / 10)
    if edges_m is None:
        count = int(np.clip(len(view.range_m) * worth / EFFECTIVE_ROWS, 1, MOST_BINS))
        inner = np.round(np.quantile(view.range_m, np.arange(1, count) / count), 1)
        edges_m = tuple(float(edge) for edge in inner)
    inside = [edge for edge in sorted(set(edges_m)) if 0 < edge < far_m]
    return tuple(Bin(pair) for pair in zip([0.0, *inside], [*inside, far_m], strict=True))


def share_bins(bins: tuple[Bin, ...], view: ViewGeometry, worth: float) -> tuple[Bin, ...]:
    """The same bins, split at the median visible share of what is partly hidden, where both halves hold enough."""
    hidden = view.visible_share[view.visible_share < _WHOLE]
    if len(hidden) * worth < EFFECTIVE_ROWS:
        return bins
    at = float(np.round(np.median(hidden), 2))
    out: list[Bin] = []
    bin_ix = bin_of(view, bins)
    for b, one in enumerate(bins):
        low = (view.visible_share[bin_ix == b] <= at).sum() * worth
        enough = min(low, (bin_ix == b).sum() * worth - low) >= EFFECTIVE_ROWS
        out += [Bin(one.range_m, (0.0, at)), Bin(one.range_m, (at, 1.0))] if enough else [one]
    return tuple(out)


def bin_of(view: ViewGeometry, bins: tuple[Bin, ...]) -> Int:
    """(P,) the first bin that holds each row, bounds included, as couples apply; else the last."""
    out = np.full(len(view.range_m), len(bins) - 1)
    for b in reversed(range(len(bins))):
        low, high = bins[b].range_m
        holds = (view.range_m >= low) & (view.range_m <= high)
        if (share := bins[b].visible_share) is not None:
            holds &= (view.visible_share >= share[0]) & (view.visible_share <= share[1])
        out[holds] = b
    return out


def fit_moments(error_m: Float, bin_ix: Int, bins: int, series: Series, shares: Shares) -> Moments:
    """Means by generalised least squares under a memory, covariances by moments, shrunk to the pooled one.

    A covariance is that of the residuals over what is left of their rows when the mean is known no better than it is;
    its degrees of freedom are (Σ 1)² / Σ ρ². It is drawn towards the pooled one as an inverse Wishart prior of that
    mean would, as strongly as makes all bins most probable: bins that are alike become one, others stay.
    """
    n = np.bincount(bin_ix, minlength=bins)
    design = (bin_ix[:, None] == np.arange(bins)).astype(float)
    centre = error_m.mean(axis=0)
    covariance = np.repeat(np.cov(error_m.T, bias=True)[None] + 1e-9 * np.eye(2), bins, axis=0)
    pairs = squared_correlations(series.decay(shares.tau_s), series.new, bin_ix, bins, shares.drift, shares.constant)
    for _ in range(2):
        plain = Moments(np.repeat(centre[None], bins, axis=0), covariance, n, pairs, pairs)
        out, _ = whitened(np.column_stack([plain.standardised(error_m, bin_ix), design]), series, shares)
        of_design = np.linalg.inv(out[:, 2:].T @ out[:, 2:] + _RIDGE * np.eye(bins))
        first, below, second = _factors(covariance)
        m = of_design @ (out[:, 2:].T @ out[:, :2])
        mean = centre + np.column_stack([first * m[:, 0], below * m[:, 0] + second * m[:, 1]])
        of_mean = np.minimum(np.diag(of_design), 0.9)
        rest = error_m - mean[bin_ix]
        left = np.maximum(n * (1 - of_mean), 1.0)
        freedom = np.maximum(n.astype(float) ** 2 / np.maximum(pairs, 1.0) * (1 - of_mean), 1e-3)
        moments = np.array([rest[bin_ix == b].T @ rest[bin_ix == b] for b in range(bins)]) / left[:, None, None]
        covariance, freedom = _shrunk(moments, freedom)
    return Moments(mean, covariance, n, of_mean, freedom)


def _shrunk(covariance: Float, freedom: Float) -> tuple[Float, Float]:
    from scipy.special import multigammaln

    pooled = (covariance * freedom[:, None, None]).sum(axis=0) / freedom.sum() + 1e-9 * np.eye(2)
    if len(freedom) == 1:
        return covariance + 1e-9 * np.eye(2), freedom
    scatter = covariance * freedom[:, None, None]

    def evidence(strength: float) -> float:
        prior = (strength - 3) * pooled
        both = strength + freedom
        gammas = multigammaln(both / 2, 2) - multigammaln(strength / 2, 2)
        dets = strength * np.log(np.linalg.det(prior)) - both * np.log(np.linalg.det(prior + scatter))
        return float((gammas + dets / 2).sum())

    strength = max(_STRENGTHS, key=evidence)
    shrunk = ((strength - 3) * pooled + scatter) / (strength - 3 + freedom)[:, None, None]
    return shrunk, np.minimum(freedom + strength, freedom.sum())

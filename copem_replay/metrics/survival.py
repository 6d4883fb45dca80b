"""Cumulative incidence of detection: curve, quantiles and restricted means over many rows, and why observation ended.

*Time to detection* T: seconds from the onset to the detection, negative where the object was known before.
Observation ends in one of three ways: the object is detected (`DETECTED`); it departs undetected (`LEFT`) and so is
never detected, T = ∞; or observation stops while the object is still there (`CENSORED`), and T is known only to be
later.
*Cumulative incidence* F(t): the probability that T ≤ t. Departure competes with detection, it does not
censor: F may stay below 1 for ever, and a quantile above its last value does not exist (None).
*Restricted mean* at a horizon h: the mean of min(T, h), in which never counts as h.
*Distance at detection*: far is good, so a row that was never detected ranks below every distance.
Intervals: metrics/limits.py. No function here draws a random number.

Letters of the shapes: n rows, M distinct times of detection, K clusters of rows, G instants.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.tracks import Bool, Float, Int

if TYPE_CHECKING:
    import pandas as pd

CENSORED = 0
"""The ego left or the log ended: the object was still there to be detected."""

DETECTED = 1
"""The object was detected."""

LEFT = 2
"""The object departed undetected: it is never detected."""

SHARE_TOLERANCE = 1e-12
"""A share this little below a quantile's level has reached it: 0.07 · 100 is 7, not 7.000000000000001."""


def cumulative_incidence(
    time_s: Float, ending: NDArray[np.integer[Any]], weight: Float | None = None, *, least: float = 1e-12
) -> tuple[Float, Float]:
    """Estimate the cumulative incidence of detection, departure competing: a right-continuous step function.

    `time_s (n,)`: seconds from the onset to the detection, or to the end of observation; finite, may be negative.
    `ending (n,)`: `DETECTED` (1), `LEFT` (2) or `CENSORED` (0). Of equal times, detections and departures come before
    censorings: a row that is censored at t was observed until t, t included.
    `weight (n,)`: how much each row counts, ≥ 0 (probabilities, multiplicities); None: all alike. `least`: the
    smallest share of all weight that still takes over the weight of the censored rows.

    Returns `times_s (M,)`, the distinct times of detection, ascending, and `incidence (M,)`, the value from
    each of them (included) to the next. Before the first it is 0, after the last it stays. Both are empty
    when nothing was detected.

    Raises ValueError for no rows, for shapes that differ, for times that are not finite, for another code.

    Source: O. O. Aalen, S. Johansen, "An empirical transition matrix for non-homogeneous Markov chains based
    on censored observations", Scand. J. Statist. 5 (1978) 141–150; one state, left for one of two others.

    >>> times_s, incidence = cr.cumulative_incidence(np.array([0.5, 0.5, 1.0, 2.0]), np.array([1, 1, 2, 1]))
    >>> times_s, incidence
    (array([0.5, 2. ]), array([0.5 , 0.75]))
    """
    weight = np.ones(len(time_s)) if weight is None else weight
    _check_rows(time_s, ending, weight)
    detected, censored = ending == DETECTED, ending == CENSORED
    # The estimator adds S(t−)·d/r at each time of detection: d of the r still looked at are detected, S is the
    # probability that nothing has happened yet. Between censorings r shrinks by exactly those to which something
    # happens, so the product S(t−) telescopes to r/n, times (r' + c)/r' for each earlier time at which c are censored
    # and r' > 0 remain. A detection thus weighs these factors over n: a censored row hands its weight on, in equal
    # parts, to all that remain. Without censoring the weights are 1 and the incidence is a ratio of whole numbers,
    # which a product over millions of times is not.
    times_s, detections = _total_weights(time_s[detected], weight[detected])
    lost_s, lost = _total_weights(time_s[censored], weight[censored])
    order = np.argsort(time_s, kind="stable")
    until = np.concatenate([[0.0], np.cumsum(weight[order])])
    total = until[-1]
    if total <= 0:
        raise ValueError("cumulative_incidence: expected a weight above 0")
    remaining = total - until[np.searchsorted(time_s[order], lost_s, side="right")]
    # Where no row remains, the weight is not handed on.
    remains = remaining >= least * total * (1 - 1e-9)
    factors = 1.0 + lost[remains] / remaining[remains]
    weights = np.append(1.0, np.cumprod(factors))
    handed = weights[np.minimum(np.searchsorted(lost_s, times_s, side="left"), len(factors))]
    incidence = np.cumsum(detections * handed) / total
    return times_s, np.minimum(incidence, 1.0)


def _check_rows(time_s: Float, ending: NDArray[np.integer[Any]], weight: Float) -> None:
    """Raise ValueError where the rows of `cumulative_incidence` have other shapes or impossible values."""
    for column in (ending, weight):
        if time_s.ndim != 1 or column.shape != time_s.shape:
            raise ValueError(f"expected two columns of equal length, found {time_s.shape} and {column.shape}")
    if len(time_s) == 0:
        raise ValueError("expected at least one row, found none")
    if not (weight >= 0).all():
        raise ValueError("expected weights of at least 0")
    if not np.isfinite(time_s).all():
        raise ValueError("cumulative_incidence: expected finite times")
    if not np.isin(ending, (DETECTED, LEFT, CENSORED)).all():
        raise ValueError("cumulative_incidence: expected endings DETECTED, LEFT or CENSORED")


def _total_weights(value: Float, weight: Float) -> tuple[Float, Float]:
    """Distinct values, ascending, and the weight on each."""
    distinct, place = np.unique(value, return_inverse=True)
    totals: Float = np.bincount(place, weights=weight, minlength=len(distinct)).astype(float)
    return distinct, totals


def quantile_time(times_s: Float, incidence: Float, q: float) -> float | None:
    """Find the smallest time at which the incidence is at least `q` (to 1e-12), seconds.

    None when it is never reached: the quantile falls among the never detected, or beyond the observed times.
    `times_s (M,)`, `incidence (M,)` as from `cumulative_incidence`, M may be 0; 0 < `q` ≤ 1.
    """
    first = int(np.searchsorted(incidence, q - SHARE_TOLERANCE, side="left"))
    return float(times_s[first]) if first < len(times_s) else None


def restricted_mean(times_s: Float, incidence: Float, horizon_s: float) -> float:
    """Average min(T, horizon), seconds; never detected counts as the horizon. The mean may be negative.

    `times_s (M,)`, `incidence (M,)` as from `cumulative_incidence`; M may be 0, the mean is then the horizon. With a =
    min(0, earliest time) it is a + ∫ₐʰ (1 − F(t)) dt. Beyond the last time at which any row was observed, F is not
    known, only held: a horizon there counts the last censored as never detected.
    """
    # F is 0 before its first step, so a drops out: what is left is h − ∫ F.
    before = times_s < horizon_s
    lengths_s = np.diff(np.append(times_s[before], horizon_s))
    return float(horizon_s - incidence[before] @ lengths_s)


@dataclass(frozen=True)
class _RestOfClusters:
    """Rows (n,) without those of each of K clusters, between the times at which rows are censored.

    Steps are weighted by what the earlier censored rows hand on. Times of censoring are few, one or less per object:
    between two of them sums over clusters are enough.
    """

    cluster: Int
    clusters: int
    span: Int  # (n,) the censoring that comes next: it is the row's own, or the row ends before it
    total: Float  # (K,) weight of the rows
    handed: Float  # (K, spans) weight of a row that ends in a span, over its own

    def sums(self, values: Float, part: Int, parts: int) -> Float:
        """(K, parts) sums of values (n,) by `part (n,)`, of all rows but those of each cluster."""
        sums = np.bincount(self.cluster * parts + part, values, self.clusters * parts).reshape(self.clusters, parts)
        rest: Float = sums.sum(axis=0) - sums
        return rest


def _leave_out_clusters(
    time_s: Float, ending: NDArray[np.integer[Any]], weight: Float, cluster: Int, clusters: int, least: float
) -> _RestOfClusters:
    """For each of K clusters, of the rows without it: weight (K,), and factors handed on by span (K, spans)."""
    censored = ending == CENSORED
    lost_s = np.unique(time_s[censored])
    span = np.searchsorted(lost_s, time_s, side="left")
    left_out = _RestOfClusters(cluster, clusters, span, np.empty(0), np.empty(0))
    span_weight = left_out.sums(weight, span, len(lost_s) + 1)
    total = span_weight.sum(axis=1)
    censored_weight = left_out.sums(np.where(censored, weight, 0.0), span, len(lost_s) + 1)[:, :-1]
    remaining = total[:, None] - np.cumsum(span_weight, axis=1)[:, :-1]
    has_remaining = remaining >= np.maximum(least * total * (1 - 1e-9), 1e-300)[:, None]
    factors = np.where(has_remaining, 1.0 + censored_weight / np.where(has_remaining, remaining, 1.0), 1.0)
    handed = np.concatenate([np.ones((clusters, 1)), np.cumprod(factors, axis=1)], axis=1)
    return replace(left_out, total=total, handed=handed)


def restricted_means_without(
    time_s: Float,
    ending: NDArray[np.integer[Any]],
    weight: Float,
    cluster: Int,
    clusters: int,
    horizon_s: float,
    *,
    least: float = 1e-12,
) -> Float:
    """(K,) restricted means at a horizon without the rows of each cluster, seconds; NaN where no row is left.

    Rows (n,) and `least` as for `cumulative_incidence`; `cluster (n,)`: 0 … K − 1.
    """
    left_out = _leave_out_clusters(time_s, ending, weight, cluster, clusters, least)
    gain = np.where(ending == DETECTED, weight * np.maximum(horizon_s - time_s, 0.0), 0.0)
    gained = left_out.sums(gain, left_out.span, left_out.handed.shape[1])
    with np.errstate(divide="ignore", invalid="ignore"):
        means: Float = horizon_s - (gained * left_out.handed).sum(axis=1) / left_out.total
    return np.where(left_out.total > 0, means, np.nan)


def incidences_without(
    time_s: Float,
    ending: NDArray[np.integer[Any]],
    weight: Float,
    cluster: Int,
    clusters: int,
    at_s: Float,
    *,
    least: float = 1e-12,
) -> Float:
    """(K, G) cumulative incidence at instants (G,), ascending, without the rows of each cluster; NaN: no row is left.

    Rows (n,) and `least` as for `cumulative_incidence`; `cluster (n,)`: 0 … K − 1.
    """
    left_out = _leave_out_clusters(time_s, ending, weight, cluster, clusters, least)
    # Detections between two instants and two censorings have the same weight handed on.
    spans, step = left_out.handed.shape[1], np.searchsorted(at_s, time_s, side="left")
    known, part = np.unique(step * spans + left_out.span, return_inverse=True)
    detections = left_out.sums(np.where(ending == DETECTED, weight, 0.0), part, len(known))
    gained = np.cumsum(detections * left_out.handed[:, known % spans], axis=1)
    until = np.searchsorted(known // spans, np.arange(len(at_s)), side="right")
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.concatenate([np.zeros((clusters, 1)), gained], axis=1)[:, until] / left_out.total[:, None]
    return np.where(left_out.total[:, None] > 0, np.minimum(shares, 1.0), np.nan)


def compute_unknown_s(time_s: Float, length_s: Float) -> Float:
    """(n,) seconds unknown: the time to detection, NaN for never, or the length of the episode; not below 0."""
    return np.maximum(np.fmin(time_s, length_s), 0.0)


def quantile_with_never(values: Float, detected: Bool, q: float, weight: Float | None = None) -> float | None:
    """Find the `q`-quantile of rows of which the never detected rank below every value; None: one of them.

    The inverse of the empirical distribution function: the smallest value v such that the share of rows at or
    below v, the never detected among them, is at least `q` (to 1e-12). So it is the value of some row.
    `values (n,)`, any unit, not read where not detected and NaN only there; `detected (n,)`; 0 < `q` ≤ 1;
    `weight (n,)`: how much each row counts, None: all alike.
    """
    weight = np.ones(len(values)) if weight is None else weight
    ranked_values = values[detected]
    order = np.argsort(ranked_values, kind="stable")
    below = np.concatenate([[weight[~detected].sum()], weight[~detected].sum() + np.cumsum(weight[detected][order])])
    place = int(np.searchsorted(below, (q - SHARE_TOLERANCE) * weight.sum(), side="left"))
    place = max(place, 0 if below[0] > 0 else 1)
    return float(ranked_values[order[min(place, len(ranked_values)) - 1]]) if place > 0 else None


# Why observation of an object ended: the column `ended_by`.


class EndReason(Enum):
    """Why observation of an object ended; the values are the texts of `ended_by`."""

    OBJECT_LEFT = "object_left"
    EGO_LEFT = "ego_left"
    LOG_END = "log_end"

    @property
    def censors(self) -> bool:
        """Whether the object could still have been detected. An object that leaves undetected is never detected."""
        return self is not EndReason.OBJECT_LEFT

    @property
    def label(self) -> str:
        """The reason in two words, for figures."""
        return _WORDS[self][0]

    @property
    def past(self) -> str:
        """A clause about the object, in the past tense."""
        return _WORDS[self][1]


_WORDS = {
    EndReason.OBJECT_LEFT: ("object leaves", "it left"),
    EndReason.EGO_LEFT: ("ego leaves", "the ego left"),
    EndReason.LOG_END: ("log ends", "the log ended"),
}
END_REASONS = tuple(EndReason)
"""`Episodes.ended_by` holds positions in this tuple."""
COMPETES = tuple(reason.value for reason in END_REASONS if not reason.censors)
"""Texts of the reasons that are competing risks, not censoring."""


def end_reason_texts(position: Int) -> np.ndarray:
    """(n,) texts of `ended_by` for positions (n,) in `END_REASONS`."""
    return np.array([reason.value for reason in END_REASONS], dtype=object)[position]


def is_competing(ended_by: pd.Series) -> Bool:
    """(n,) whether these texts of `ended_by` name a departure, not a censoring."""
    competing: Bool = ended_by.isin(COMPETES).to_numpy(dtype=bool)
    return competing

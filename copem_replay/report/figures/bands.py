"""Bands around curves of detection: 95 % by drawing whole clusters of rows with replacement.

Clusters are what hangs together: the runs of the one measured object; else logs, or objects, where there are at least
five; with fewer there is no band. Limits are, instant by instant, those of a share in `summary.csv`
(metrics/intervals.py): every configuration resamples the same clusters. Letters: n rows, K clusters, R resamples, G
instants.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from copem_replay.core.tracks import Float, Int
from copem_replay.metrics.intervals import Counts, effective_number, percentile_limits, resamples, widened
from copem_replay.metrics.survival import CENSORED, DETECTED

RESAMPLES = 400
"""Of a band (chosen: its limits are then off by about 1 % of what lies between them)."""
_SAME_S = 1e-9
"""Means this close are the same (chosen: times are whole nanoseconds)."""
_CELLS = 4_000_000
"""Resamples × rows held at a time (chosen: 32 MB a column)."""


def band(
    time_s: Float, ending: Int, cluster: Sequence[str], at_s: Float, seed: int, runs: Int | None = None
) -> tuple[Float, Float]:
    """Limits (G,) of the cumulative incidence at instants (G,).

    `time_s (n,)`, `ending (n,)` as in `statistics.cumulative_incidence`; `cluster (n,)`: the name of each row's;
    `runs (n,)`: how often it counts, None: once.
    """
    runs = np.ones(len(time_s), dtype=np.int64) if runs is None else runs
    names, of = np.unique(np.asarray(cluster, dtype=str), return_inverse=True)
    resampled = resamples([str(name) for name in names], seed, RESAMPLES)
    # Rows of one cluster that end alike at one time are one row that counts as often.
    order = np.lexsort((of, ending, time_s))
    keys = np.stack([time_s, ending, of])[:, order]
    first = np.flatnonzero(np.append(True, (np.diff(keys) != 0).any(axis=0)))
    alike = np.diff(np.append(0, np.cumsum(runs[order]))[np.append(first, len(order))])
    kept = order[first]

    def curves(count: Counts) -> Float:
        return resampled_incidence(time_s[kept], ending[kept], count[:, of[kept]].astype(np.int64) * alike, at_s)

    size = max(1, _CELLS // max(len(kept), len(at_s)))
    blocks = [curves(resampled.count[k : k + size]) for k in range(0, len(resampled.count), size)]
    share, n = curves(np.ones((1, len(names)), dtype=np.uint32))[0], effective_number(np.bincount(of, runs))
    limits = [percentile_limits(at, resampled) for at in np.concatenate(blocks).T]
    of_all = [widened(*one, n)[1:] for one in zip(limits, share.tolist(), strict=True)]
    low, high = np.array(of_all).reshape(-1, 2).T
    return low, high


def resampled_incidence(time_s: Float, ending: Int, count: Int, at_s: Float) -> Float:
    """(R, G) the cumulative incidence at instants (G,) of rows (n,), sorted by time, that count `count (R, n)` times.

    The estimator of `statistics.cumulative_incidence`, all resamples at once. NaN where a resample has no row.
    """
    until = np.concatenate([np.zeros((len(count), 1)), np.cumsum(count, axis=1)], axis=1)
    total = until[:, -1:]
    weight = np.where(ending == DETECTED, count, 0).astype(float)
    lost_s = np.unique(time_s[ending == CENSORED])
    if len(lost_s):
        lost = np.concatenate(
            [np.zeros((len(count), 1)), np.cumsum(np.where(ending == CENSORED, count, 0), axis=1)], axis=1
        )
        before, after = (np.searchsorted(time_s, lost_s, side=side) for side in ("left", "right"))
        gone, remaining = lost[:, after] - lost[:, before], total - until[:, after]
        # A censored row hands its weight on to all that remain; where none does, it is not handed on.
        factors = np.divide(gone, remaining, out=np.zeros_like(gone), where=remaining > 0) + 1.0
        handed = np.concatenate([np.ones((len(count), 1)), np.cumprod(factors, axis=1)], axis=1)
        weight *= handed[:, np.searchsorted(lost_s, time_s, side="left")]
    summed = np.concatenate([np.zeros((len(count), 1)), np.cumsum(weight, axis=1)], axis=1)
    with np.errstate(invalid="ignore"):  # a resample without a row: its clusters have none
        shares = summed[:, np.searchsorted(time_s, at_s, side="right")] / total
    result: Float = np.minimum(shares, 1.0)
    return result


def mean_limits(
    time_s: Float, ending: Int, cluster: Sequence[str], horizon_s: float, seed: int, runs: Int | None = None
) -> tuple[float, float] | None:
    """Limits of the restricted mean of times (n,) at a horizon; None: every resample has the same mean.

    Columns as of `band`. The same resamples as those of a share in `summary.csv`.
    """
    runs = np.ones(len(time_s), dtype=np.int64) if runs is None else runs
    names, of = np.unique(np.asarray(cluster, dtype=str), return_inverse=True)
    resampled = resamples([str(name) for name in names], seed)
    if not (ending == CENSORED).any():  # no weight is handed on: sums of clusters are enough
        counted_s = np.where(ending == DETECTED, np.minimum(time_s, horizon_s), horizon_s)
        sums = np.stack([np.bincount(of, counted_s * runs), np.bincount(of, runs)], axis=1)
        of_all = resampled.count.astype(float) @ sums
        return _apart(*percentile_limits(of_all[:, 0] / of_all[:, 1], resampled))
    order = np.lexsort((of, ending, time_s))
    time_s, ending, of, runs = time_s[order], ending[order], of[order], runs[order]
    at_s = np.unique(time_s[(ending == DETECTED) & (time_s < horizon_s)])
    lengths_s = np.diff(np.append(at_s, horizon_s))
    size = max(1, _CELLS // max(len(time_s), len(at_s), 1))
    means = [
        horizon_s
        - resampled_incidence(time_s, ending, resampled.count[k : k + size][:, of].astype(np.int64) * runs, at_s)
        @ lengths_s
        for k in range(0, len(resampled.count), size)
    ]  # fmt: skip
    return _apart(*percentile_limits(np.concatenate(means), resampled))


def _apart(low: float, high: float) -> tuple[float, float] | None:
    return (low, high) if high - low > _SAME_S else None

"""Bands around curves of detection: 95 % by drawing whole clusters of rows with replacement.

Clusters are what hangs together: the runs of the one measured object; else logs, or objects, where there are at least
five; with fewer there is no band. Draws are addressed, so that every configuration resamples the same clusters, and the
logs or objects are those of the intervals in `summary.csv`. Letters: n rows, K clusters, R resamples, G instants.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from copem_replay.chance import Address, Dice, object_words
from copem_replay.statistics import CENSORED, DETECTED
from copem_replay.tracks import Float, Int

RESAMPLES = 400
"""Of a band (chosen: its limits are then off by about 1 % of what lies between them)."""
_CELLS = 4_000_000
"""Resamples × rows held at a time (chosen: 32 MB a column)."""


def multiplicities(names: Sequence[str], seed: int, *, resamples: int = RESAMPLES) -> Int:
    """(R, K) how often each cluster is drawn in each resample: K draws with replacement."""
    none = np.zeros(len(names), dtype=np.int64)
    address = Address(("",), none, object_words(names), none)
    uniform = Dice(seed, "summary").uniform("bootstrap", address, np.arange(resamples))
    drawn = (uniform * len(names)).astype(np.int64) + len(names) * np.arange(resamples)[:, None]
    return np.bincount(drawn.ravel(), minlength=resamples * len(names)).reshape(resamples, len(names))


def band(
    time_s: Float, ending: Int, cluster: Sequence[str], at_s: Float, seed: int, *, confidence: float = 0.95
) -> tuple[Float, Float]:
    """Limits (G,) of the cumulative incidence at instants (G,).

    `time_s (n,)`, `ending (n,)` as in `statistics.cumulative_incidence`; `cluster (n,)`: the name of each row's.
    """
    names, of = np.unique(np.asarray(cluster, dtype=str), return_inverse=True)
    counts = multiplicities(list(names), seed)
    # Rows of one cluster that end alike at one time are one row that counts as often.
    order = np.lexsort((of, ending, time_s))
    keys = np.stack([time_s, ending, of])[:, order]
    first = np.flatnonzero(np.append(True, (np.diff(keys) != 0).any(axis=0)))
    alike = np.diff(np.append(first, len(order)))
    kept = order[first]
    size = max(1, _CELLS // max(len(kept), len(at_s)))
    curves = np.concatenate(
        [
            resampled_incidence(time_s[kept], ending[kept], counts[k : k + size, of[kept]] * alike, at_s)
            for k in range(0, len(counts), size)
        ]
    )
    low, high = np.quantile(curves, ((1 - confidence) / 2, (1 + confidence) / 2), axis=0)
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
        # Who is censored hands his weight on to all who remain; where nobody does, nobody takes it over.
        factors = np.divide(gone, remaining, out=np.zeros_like(gone), where=remaining > 0) + 1.0
        handed = np.concatenate([np.ones((len(count), 1)), np.cumprod(factors, axis=1)], axis=1)
        weight *= handed[:, np.searchsorted(lost_s, time_s, side="left")]
    summed = np.concatenate([np.zeros((len(count), 1)), np.cumsum(weight, axis=1)], axis=1)
    with np.errstate(invalid="ignore"):  # a resample without a row: its clusters have none
        shares = summed[:, np.searchsorted(time_s, at_s, side="right")] / total
    result: Float = np.minimum(shares, 1.0)
    return result

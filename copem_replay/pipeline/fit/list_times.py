"""When lists come: their period, how regular they are, and when there is none for a while."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import f

from copem_replay.pipeline.fit.durations import garwood
from copem_replay.pipeline.fit.estimate import Estimate, Note, digits, plain
from copem_replay.pipeline.fit.rows import FitLists

LONG = 2.5
"""A gap of more than so many medians is an outage."""
_FEWEST = 2
"""Outages below which none are fitted."""


@dataclass(frozen=True)
class ListTimesFit:
    """`period_s` and `jitter_s` (standard deviation of ordinary gaps); of outages both numbers, or why there are none.

    An outage is a state of the unit that is looked at once in a period, as in a replay: down at the next list with
    probability 1 − up, as long or as short as it was (a Markov chain). Of outages of one list only, which a late list
    looks like, there are as many as the longer ones tell.
    """

    period_s: Estimate
    jitter_s: Estimate
    down_share: Estimate
    lasts_s: Estimate

    def keys(self, note: Note = plain) -> dict[str, Any]:
        """A unit's `outages`; empty where there are none."""
        if self.down_share.why is not None:
            return {}
        two = {"down_share": self.down_share, "lasts_s": self.lasts_s}
        return {name: note(digits(one.value), one.words()) for name, one in two.items()}


def fit_list_times(lists: FitLists) -> ListTimesFit:
    """Fit the gaps between lists of the same log."""
    same = np.diff(lists.log) == 0
    gaps_s = np.diff(lists.captured_s)[same]
    if not len(gaps_s):
        none = Estimate(float("nan"), why=f"{len(lists.log)} lists")
        return ListTimesFit(none, none, none, none)
    period_s = float(np.median(gaps_s))
    ordinary, long = gaps_s[gaps_s <= LONG * period_s], gaps_s[gaps_s > LONG * period_s]
    n, spread_s = len(gaps_s), float(ordinary.std())
    aside = 1.2533 * 1.96 * spread_s / np.sqrt(len(ordinary))  # of a median
    period = Estimate(period_s, period_s - aside, period_s + aside, n, len(ordinary))
    far = 1.96 / np.sqrt(2 * len(ordinary))
    jitter = Estimate(spread_s, spread_s * (1 - far), spread_s * (1 + far), n, len(ordinary))
    if len(long) < _FEWEST:
        low, high = garwood(len(long))
        why = f"{len(long)} of {n} gaps are longer than {LONG:g} medians"
        untold = Estimate(0.0, 0.0, high * 3 * period_s / float(gaps_s.sum()), n, len(long), why)
        return ListTimesFit(period, jitter, untold, Estimate(float("nan"), n=n, why=why))
    missing = np.maximum(np.rint(long / period_s) - 1, 2)
    K = len(long)
    stays = float((missing - 2).sum() / ((missing - 2).sum() + K))  # longer than two lists: geometric
    stays = min(max(stays, 0.5 / (K + 1)), 1 - 1e-6)
    begins = K / stays / len(gaps_s)  # those of one list, too
    down = begins / (begins + 1 - stays)
    phi = max(stays - begins, 1e-3)
    lasts_s = -period_s / np.log(phi) / (1 - down)
    low, high = garwood(K)
    lasts = Estimate(lasts_s, lasts_s * K / high, lasts_s * K / low, n, K)
    odds = down / (1 - down)
    narrow, wide = f.ppf([0.025, 0.975], 2 * K, 2 * K)
    return ListTimesFit(
        period, jitter,
        Estimate(down, odds * narrow / (1 + odds * narrow), odds * wide / (1 + odds * wide), n, K), lasts,
    )  # fmt: skip

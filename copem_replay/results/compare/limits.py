"""Limits of a difference: over resamples, exact, or none and why."""

from __future__ import annotations

import math

import numpy as np

from copem_replay.metrics.fixed import NOTHING_DRAWN
from copem_replay.metrics.intervals import alike_limits, effective_number, percentile_limits
from copem_replay.results.compare.bootstrap import Draws, Names, clusters
from copem_replay.results.compare.differences import Figure

ALL_ALIKE = "all clusters alike"
"""Why there is no interval: no resample differs from another, for the difference is the same in every cluster.

Of a median it is enough that it is the same in nearly all.
"""
_SAME = 1e-9
"""Differences this close are the same (chosen: below what any of the metrics is measured with)."""


def limits(
    figure: Figure, difference: float, over: str, names: Names, draws: Draws, *, fixed: bool
) -> dict[str, object]:
    """The columns `low`, `high`, `interval` and `interval_over` of a difference, as far as there are any.

    `over`: what is resampled. `fixed`: the figure is the same in every run, on either side.
    """
    if not math.isfinite(difference):
        return {}
    if over == "runs" and fixed:
        return {"interval": NOTHING_DRAWN}
    drawn = clusters(figure.items, over, names)
    if drawn is None or not (figure.by_object or over != "objects"):
        return {}
    resampled = draws.of(drawn.names)
    low, high = percentile_limits(figure.resampled(drawn, resampled.count), resampled)
    kind = "bootstrap"
    if abs(high - low) <= _SAME:
        if "only" not in figure.items.columns:
            return {"interval": ALL_ALIKE}
        of = drawn.of(figure.items)
        rows = np.bincount(of[of >= 0], figure.items["n"][of >= 0], minlength=len(drawn.names))
        kind, (low, high) = "exact", alike_limits(difference, effective_number(rows))
    found = {"low": low, "high": high}
    return {name: limit if math.isfinite(limit) else None for name, limit in found.items()} | {
        "interval": kind,
        "interval_over": over,
    }

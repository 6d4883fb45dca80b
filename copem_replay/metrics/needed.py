"""How many logs, objects, passes or runs would decide a criterion that stays undecided, if further ones are alike.

Numbers are rough: with as many, four of five studies show it. They were simulated in .72 to 1.0 of cases.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from copem_replay.metrics.limits import CONFIDENCE, WITHIN_LOG, LimitedFigure

_POWER = 0.8
"""The share of studies that show what is so."""
_MARGIN = 1.15
"""Means need so many times as many as the formula says: the spread is known from few."""
_MOST = 10**6
"""More are not asked for."""
_SAME = 1e-9

# Formulas.


def count_for_share(share: float, bound: float, confidence: float = CONFIDENCE) -> float:
    """Independent objects needed to show on which side of `bound` a share is; infinite: it is at the bound.

    Without a single one on the other side: ln τ / ln B, exact; else by the normal approximation of exact limits.
    """
    if not 0.0 <= bound <= 1.0:
        return math.inf
    if share < bound:
        share, bound = 1.0 - share, 1.0 - bound
    tail = (1.0 - confidence) / 2
    if share - bound <= _SAME:
        return math.inf
    fewest = math.log(tail) / math.log(bound) if bound > 0 else 1.0
    if share >= 1.0 - _SAME:
        return fewest
    z, power = _quantiles(confidence)
    spread = z * math.sqrt(bound * (1.0 - bound)) + power * math.sqrt(share * (1.0 - share))
    return max(fewest, (spread / (share - bound)) ** 2 + 1.0 / (share - bound))


def count_for_mean(
    value: float, bound: float, bounds: tuple[float, float], spread: float, confidence: float = CONFIDENCE
) -> float:
    """Clusters needed to show on which side of `bound` a mean between `bounds` is; `spread`: of the clusters' means."""
    gap, reach = abs(bound - value), (bounds[1] - value if value < bound else value - bounds[0])
    (z, power), tail = _quantiles(confidence), (1.0 - confidence) / 2

    def is_enough(K: int) -> bool:
        seen = spread / math.sqrt(K)
        return math.hypot(reach * (1.0 - tail ** (1.0 / K)), z * seen) + power * seen <= gap

    if gap <= _SAME or not is_enough(_MOST):
        return math.inf
    low, high = 0, _MOST
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if is_enough(middle) else (middle, high)
    return high if spread <= _SAME else high * _MARGIN


def count_for_figure(
    value: float, bound: float, half_width: float, clusters: int, confidence: float = CONFIDENCE
) -> float:
    """Clusters needed to show on which side of `bound` a figure is, if so many `clusters` know it to ± `half_width`."""
    gap, (z, power) = abs(bound - value), _quantiles(confidence)
    return clusters * ((z + power) / z * half_width / gap) ** 2 if gap > _SAME else math.inf


def find_spread(low: float, high: float, clusters: int, confidence: float = CONFIDENCE) -> float:
    """The standard deviation of the clusters for which Student's t gives these limits."""
    from scipy.special import stdtrit

    return float((high - low) / 2 * math.sqrt(clusters) / -stdtrit(clusters - 1, (1.0 - confidence) / 2))


def _quantiles(confidence: float) -> tuple[float, float]:
    from scipy.special import ndtri

    return float(-ndtri((1.0 - confidence) / 2)), float(ndtri(_POWER))


# Of a criterion.

LEVELS = {"p5": 0.05, "median": 0.5, "p95": 0.95}
"""Levels of the quantiles among the metrics, by a part of their names."""


def find_level(metric: str) -> float | None:
    """The share of rows on the good side of the bound that a quantile metric requires; None: no quantile."""
    level = next((LEVELS[part] for part in metric.split("_") if part in LEVELS), None)
    return level if level is None or "dad" not in metric else 1.0 - level


class Known(NamedTuple):
    """The size of an interval's sample: `clusters` of `over`, about `units` units."""

    over: str
    clusters: int
    units: int


def count_deciding(
    metric: str,
    figure: LimitedFigure,
    bound: float,
    known: Known,
    confidence: float = CONFIDENCE,
    *,
    paired: bool = False,
) -> int | None:
    """The number of clusters that would decide a figure; None: no number would, as the figure is at its bound.

    `paired`: the figure is a difference.
    """
    value = figure.value if figure.value is not None else math.nan
    level = find_level(metric)
    if figure.share is not None and level is not None:
        count = count_in_logs(count_for_share(figure.share[1], level, confidence), known)
    elif figure.bounds is not None and not math.isnan(figure.spread):
        count = count_for_mean(value, bound, figure.bounds, figure.spread, confidence)
    elif "share" in metric and not paired:
        count = count_in_logs(count_for_share(value, bound, confidence), known)
    else:
        half = (figure.high - figure.low) / 2
        count = count_for_figure(value, bound, half, known.clusters, confidence)
    return None if math.isnan(count) or count > _MOST else math.ceil(round(count, 6))


def count_in_logs(objects: float, known: Known) -> float:
    """The number of clusters that say as much about a share as `objects` independent objects."""
    if known.over != "logs":
        return objects
    of_each = max(known.units / known.clusters, 1.0)
    return objects * (1.0 + WITHIN_LOG * (of_each - 1.0)) / of_each


_TO_HORIZON = ("ttd_rmst_s", "unknown_to_horizon_s", "conflict_ttd_rmst_s")


def count_at_best(
    metric: str, direction: str, bound: float, horizon_s: float, known: Known, confidence: float = CONFIDENCE
) -> int | None:
    """The least number that can meet a criterion if all rows are as good as possible; None: no more, or unknown."""
    level = find_level(metric)
    if level is not None:
        count = count_in_logs(count_for_share(1.0, level, confidence), known)
    elif "share" in metric:
        count = count_in_logs(count_for_share(float(direction == "at_least"), bound, confidence), known)
    elif metric.removesuffix("_exact") in _TO_HORIZON and direction == "at_most" and bound > 0:
        count = count_for_mean(0.0, bound, (0.0, horizon_s), 0.0, confidence)
    else:
        return None
    return None if count <= known.clusters or math.isinf(count) else math.ceil(round(count, 6))


def find_enough_horizon(metric: str, bound: float, known: Known, confidence: float = CONFIDENCE) -> float | None:
    """The horizon in seconds up to which so many can meet a bound on a mean, all being known at once; None: no mean."""
    if metric.removesuffix("_exact") not in _TO_HORIZON:
        return None
    tail = (1.0 - confidence) / 2
    return float(bound / (1.0 - tail ** (1.0 / known.clusters)))

"""Intervals: of shares over independent rows (Wilson), and over whole clusters of dependent rows: logs, objects or
runs.

*Resample*: as many clusters as there are, drawn with replacement. Below `DRAWN_FROM` clusters all resamples that differ
are enumerated, each counting as often as it would be drawn; else `RESAMPLES` are drawn, by random numbers that are
addressed by the clusters' names: all configurations and metrics resample the same clusters, at every call.
*Percentile limits*: quantiles of a figure over all resamples, widened for few clusters.
*Exact limits*: of k successes in n trials (Clopper–Pearson). Clusters count as n = (Σw)²/Σw² trials, w being their
numbers of rows (Kish's effective size), and k = share · n. A cluster is no more extreme than all or nothing, so the
limits are wide enough for any share in between; percentiles see no spread where all clusters are alike.
*Nothing drawn*: where no random number is behind a result it is equal in every run, and an interval over runs tells
nothing (`find_fixed_outcomes`).

Letters of the shapes: R resamples, K clusters.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations_with_replacement
from statistics import NormalDist
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from copem_replay.core.random import CounterRng, RandomKey, object_words
from copem_replay.core.tracks import TRUTH, Float, Int

Counts = NDArray[np.uint32]

RESAMPLES = 2000
"""Bootstrap resamples: the share beyond a 95 % limit is then off by .0035 (one standard error)."""
DRAWN_FROM = 8
"""From so many clusters on resamples are drawn: of seven there are 1,716 different ones, of eight 6,435."""
EXACT_BELOW = 100
"""Over fewer clusters, by effective size, a share's limits are never narrower than the exact ones (decision 19)."""
FEWEST_EACH = 10
"""Nor where fewer clusters than this, by effective size, succeed or fail: coverage by `tools/coverage.py`."""
FEWEST_CLUSTERS = 5
"""Fewer logs or objects are not resampled: coverage is measured from five clusters on (`tools/coverage.py`)."""
_CELLS = 4_000_000
"""Numbers held at a time, 32 MB: the size of blocks, which changes no result."""
_ROUNDING = 1e-9
"""Effective numbers of clusters that differ by rounding only are equal."""


@dataclass(frozen=True)
class Resamples:
    """`count (R, K)`: how often each resample has each cluster; `times (R,)`: how many resamples are like this one."""

    count: Counts
    times: Int


def choose_clusters(table: pd.DataFrame) -> tuple[str | None, pd.Series]:
    """The kind of cluster that is resampled (`runs`, `logs`, `objects`; None: too few), and each row's cluster (n,).

    Rows of a tally stand for several runs: where runs are resampled they form one cluster.
    """
    log = table["log"].astype(str)
    episode = log + "\n" + table["object_id"].astype(str)
    if episode.nunique() == 1:
        return "runs", table["run"].astype(str) if "run" in table else episode
    if log.nunique() >= FEWEST_CLUSTERS:
        return "logs", log
    return ("objects" if episode.nunique() >= FEWEST_CLUSTERS else None), episode


def draw_resamples(names: Sequence[str], seed: int, number: int = RESAMPLES) -> Resamples:
    """All resamples of the named clusters below `DRAWN_FROM` clusters, else `number` drawn ones."""
    if len(names) < DRAWN_FROM:
        return list_resamples(len(names))
    zeros = np.zeros(len(names), dtype=np.int64)
    random_key, rng = RandomKey(("",), zeros, object_words(names), zeros), CounterRng(seed, "summary")
    size = max(1, _CELLS // len(names))
    blocks = [np.arange(r, min(r + size, number)) for r in range(0, number, size)]
    count = np.concatenate([count_multiplicities(rng.uniform("bootstrap", random_key, block)) for block in blocks])
    return Resamples(count, np.ones(number, dtype=np.int64))


@cache
def list_resamples(clusters: int) -> Resamples:
    """All resamples of K clusters that differ, the order of drawing aside; `times` add up to K^K."""
    numbers = np.arange(clusters)
    drawn = np.array(list(combinations_with_replacement(range(clusters), clusters)))
    count = (drawn[:, :, None] == numbers).sum(axis=1).astype(np.uint32)
    factorial = np.array([math.factorial(k) for k in range(clusters + 1)])
    times = factorial[clusters] // factorial[count].prod(axis=1)
    count.flags.writeable = times.flags.writeable = False  # kept for the next call
    return Resamples(count, times)


def count_multiplicities(uniform: Float) -> Counts:
    """(R, K) how often each cluster is drawn: of `uniform (R, K)`, between 0 and 1, u draws cluster ⌊u·K⌋."""
    R, K = uniform.shape
    drawn = (uniform * K).astype(np.int64) + K * np.arange(R)[:, None]
    return np.bincount(drawn.ravel(), minlength=uniform.size).reshape(R, K).astype(np.uint32)


def percentile_limits(values: Float, resampled: Resamples, *, confidence: float = 0.95) -> tuple[float, float]:
    """Quantiles of a figure (R,) of each resample, linear between neighbours: (low, high).

    At the levels of a confidence, widened for few clusters (`expand_tail`). A resample that stands for several counts
    as often.

    Resamples without a figure, NaN, are left out; both limits are NaN where none is left. A limit that is infinite, or
    NaN between −∞ and ∞, does not exist.

    Source: B. Efron, "Nonparametric standard errors and confidence intervals", Canad. J. Statist. 9 (1981) 139–158
    (percentile method).
    """
    tail = expand_tail(confidence, resampled.count.shape[1])
    defined = ~np.isnan(values)
    if not defined.any():
        return math.nan, math.nan
    order = np.argsort(values[defined], kind="stable")
    ranked, until = values[defined][order], np.cumsum(resampled.times[defined][order])
    low, high = (_weighted_quantile(ranked, until, level) for level in (tail, 1.0 - tail))
    return low, high


def _weighted_quantile(ranked: Float, until: Int, level: float) -> float:
    """The quantile at `level` of values (R,), ascending; `until (R,)`: how many resamples they stand for up to each."""
    place = level * (int(until[-1]) - 1)
    first = math.floor(place)
    below, above = (
        float(ranked[np.searchsorted(until, min(k, until[-1] - 1), side="right")]) for k in (first, first + 1)
    )
    # Of two infinite neighbours the difference would be NaN.
    return below if below == above or place == first else below + (above - below) * (place - first)


def expand_tail(confidence: float, clusters: int) -> float:
    """The probability beyond each limit of a percentile interval over `clusters` clusters, at most (1 − confidence)/2.

    A resample of K clusters varies less than K fresh ones would, by √((K − 1)/K), and its quantiles are normal ones
    where Student's are due: with 5 clusters plain percentiles hold the truth 86 times of 100, not 95. The level is
    Φ(−t·√(K/(K − 1))), t the two-sided quantile of Student's distribution with K − 1 degrees of freedom. With one
    cluster nothing varies: the plain level.

    Source: T. C. Hesterberg, "What teachers should know about the bootstrap", Amer. Statist. 69 (2015) 371–386
    (expanded percentile interval).
    """
    from scipy.special import ndtr, stdtrit

    tail = (1.0 - confidence) / 2
    if clusters == 1:
        return tail
    return float(ndtr(stdtrit(clusters - 1, tail) * math.sqrt(clusters / (clusters - 1))))


def exact_limits(successes: float, n: float, *, confidence: float = 0.95) -> tuple[float, float]:
    """Bound the probability of success given `successes` of `n` independent trials exactly: (low, high), shares.

    The limits enclose all p with which so few successes, and so many, have a probability of at least
    (1 − confidence)/2. Neither number need be whole: the limits are quantiles of beta distributions.

    Source: C. J. Clopper, E. S. Pearson, "The use of confidence or fiducial limits illustrated in the case of the
    binomial", Biometrika 26 (1934) 404–413.
    """
    from scipy.special import betaincinv

    tail, failures = (1.0 - confidence) / 2, n - successes
    low = 0.0 if successes <= _ROUNDING else float(betaincinv(successes, max(failures, 0.0) + 1.0, tail))
    high = 1.0 if failures <= _ROUNDING else float(betaincinv(max(successes, 0.0) + 1.0, failures, 1.0 - tail))
    return low, high


def effective_number(weights: Float | Int) -> float:
    """The number of equal clusters that weights (K,) ≥ 0, one of them above 0, amount to: (Σw)²/Σw², from 1 to K.

    Source: L. Kish, "Survey Sampling", Wiley 1965, section 11.2.
    """
    weights = np.asarray(weights, dtype=float)
    return float(weights.sum() ** 2 / (weights @ weights))


def bootstrap_share(
    successes: Float | Int, totals: Float | Int, resampled: Resamples, *, confidence: float = 0.95
) -> tuple[float, float]:
    """Bound Σ successes / Σ totals by percentiles over resamples of whole clusters: (low, high), shares.

    `successes (K,)` of `totals (K,)` in each cluster, 0 ≤ successes ≤ totals; a total may be 0, and a resample without
    any is left out. The interval of the failures is the mirror image.
    """
    sums = np.empty((len(resampled.count), 2))
    columns = np.stack([successes, totals], axis=1).astype(float)
    size = max(1, _CELLS // len(columns))
    for r in range(0, len(sums), size):
        sums[r : r + size] = resampled.count[r : r + size].astype(float) @ columns
    with np.errstate(invalid="ignore"):  # a resample without a total has no share
        return percentile_limits(sums[:, 0] / sums[:, 1], resampled, confidence=confidence)


def share_limits(successes: Float | Int, totals: Float | Int, resampled: Resamples) -> tuple[str, float, float]:
    """Bound Σ successes / Σ totals: (kind, low, high).

    Kind `bootstrap`: the limits of `bootstrap_share`, over many clusters of which enough succeed and fail; else
    `bootstrap+exact`: on each side the wider of these and the exact limits.
    """
    limits = bootstrap_share(successes, totals, resampled)
    return widen_limits(limits, float(successes.sum()) / float(totals.sum()), effective_number(totals))


def widen_limits(limits: tuple[float, float], share: float, n: float) -> tuple[str, float, float]:
    """(kind, low, high) of a share over `n` clusters, as wide as the exact limits unless many succeed and many fail."""
    k = min(n * share, n)
    if min(n - EXACT_BELOW, k - FEWEST_EACH, n - k - FEWEST_EACH) >= -_ROUNDING:
        return "bootstrap", *limits
    least, most = exact_limits(k, n)
    return "bootstrap+exact", min(limits[0], least), max(limits[1], most)


def alike_limits(difference: float, n: float) -> tuple[float, float]:
    """Bound a difference of two shares, −1 … 1, that is the same in all of `n` clusters: (low, high).

    Exact on each side: as if |difference| · n of n clusters favoured the one and the rest neither; of the rest, any
    share that is possible where none of n does may favour the other. Five clusters at 0: [−.522, .522], at 1: [.478,
    1].
    """
    size = min(abs(difference), 1.0)
    low, high = exact_limits(size * n, n)
    low -= (1.0 - size) * exact_limits(0.0, n)[1]
    return (low, high) if difference >= 0 else (-high, -low)


def wilson_limits(successes: int, n: int, *, confidence: float = 0.95) -> tuple[float, float]:
    """Bound the probability of success given `successes` of `n` independent trials: (low, high), shares.

    All p for which |successes/n − p| ≤ z·√(p(1 − p)/n), z the two-sided normal quantile. Low is exactly 0
    without a success, high exactly 1 without a failure.

    Source: E. B. Wilson, "Probable inference, the law of succession, and statistical inference",
    J. Amer. Statist. Assoc. 22 (1927) 209–212.
    """
    z = -NormalDist().inv_cdf((1.0 - confidence) / 2)
    share, z2 = successes / n, z * z
    centre = (share + z2 / (2 * n)) / (1 + z2 / n)
    half = z * math.sqrt(share * (1 - share) / n + z2 / (4 * n * n)) / (1 + z2 / n)
    # At the ends the root of the equation is 0 or 1; the difference of two rounded terms need not be.
    low = 0.0 if successes == 0 else centre - half
    high = 1.0 if successes == n else centre + half
    return low, high


# Outcomes that are equal in every run.

NOTHING_DRAWN = "nothing drawn"
"""The kind of an interval that does not exist as all runs are equal."""


@dataclass(frozen=True)
class FixedOutcomes:
    """`lists`: configurations whose lists are equal in every run; `reaction`: whether the driver's delay is."""

    lists: frozenset[str] = frozenset()
    reaction: bool = False

    def known(self, configuration: str) -> bool:
        """Whether the configuration's detections are equal in every run."""
        return configuration in self.lists

    def passes(self, configuration: str) -> bool:
        """Whether the configuration's verdicts on braking are equal in every run."""
        return self.reaction and configuration in self.lists


def find_fixed_outcomes(experiment: Mapping[str, Any]) -> FixedOutcomes:
    """The outcomes that are equal in every run of an experiment, given as plain data with every default filled in.

    By kind of unit: lists of the truth and of recorded units are not drawn; those of a unit with a PEM are, and so are
    its carriers, even where probabilities are 0 or 1. A driver's delay is drawn, except with the `constant` reaction.
    Missing keys count as drawn.
    """
    units = _as_mapping(experiment.get("units"))
    links = _as_mapping(experiment.get("links"))
    recorded = {name for name, unit in units.items() if _as_mapping(unit).get("recorded")}
    lists = set()
    for name, configuration in _as_mapping(experiment.get("configurations")).items():
        settings = _as_mapping(configuration)
        undrawn = _is_undrawn(settings.get("units"), recorded) and not _is_link_random(settings.get("link"), links)
        if settings.get("recorded") or undrawn:
            lists.add(str(name))
    driver = _as_mapping(_as_mapping(experiment.get("braking")).get("driver"))
    reaction = driver.get("reaction")  # left out: no delay
    return FixedOutcomes(
        frozenset(lists), bool(driver) and (not reaction or _as_mapping(reaction).get("kind") == "constant")
    )


def _is_undrawn(units: Any, recorded: set[str]) -> bool:
    return units == TRUTH or (isinstance(units, list) and set(units) <= recorded)


def _is_link_random(link: Any, links: Mapping[str, Any]) -> bool:
    """Whether a configuration's link, or any of those by unit, delays or loses lists by chance."""
    by_unit = link.values() if isinstance(link, dict) and "kind" not in link else [link]
    for unit_link in by_unit:
        radio = _as_mapping(links.get(unit_link) if isinstance(unit_link, str) else unit_link)
        latency, reception = _as_mapping(radio.get("latency")), _as_mapping(radio.get("reception"))
        certain = latency.get("kind") == "constant" and reception == {"kind": "constant", "probability": 1.0}
        if radio.get("kind") == "radio" and not (certain and not radio.get("channel")):
            return True
    return False


def _as_mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, dict) else {}

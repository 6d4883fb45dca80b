"""How often intervals hold the truth, how often verdicts at the truth are wrong, and how often a table has a false `*`.

    nice -n 10 python tools/coverage.py                  # 2,000 studies a row: two to five minutes on one core
    python tools/coverage.py --csv --studies 10000       # every row of the table

A study is a drive, several drives, or passes of one object, drawn from a *design*; its limits are those of the package
(`metrics/limits.py`), its truth that of all such traffic. A criterion is *wrongly met* where it is met although the
truth is beyond its bound by a hair, *wrongly not met* where it is not met although the truth keeps it by a hair;
`at_least` for shares, else `at_most`. *Objects* of one drive have times up to the horizon of any distribution; *logs*
have objects of their own share detected and their own median time, unrelated to their number, or bad logs that are also
*busy*. *Followed* rows begin, leave and are censored, and go through the figures of a criterion, study by study
(`metrics/row_figures.py`): a quarter as many. *Rates* are of events in drives, each of which has its own. *Stars*: of
four configurations and a baseline that are all alike, eight metrics, one of them without limits; over the whole table
(Holm), and of one metric that is named before.

Gates: coverage of at least .93, at most .04 wrongly met, .06 of tables starred, with two standard errors. A *line* is a
row of the table in docs/reference/intervals.md; one beyond a gate is named there, in bold, else the exit code is 1.
"""

from __future__ import annotations

if __name__ == "coverage":  # numba looks for the package of that name, and within tools/ this file comes first
    raise ImportError("tools/coverage.py is a program, not the package")

import argparse
import math
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd
from scipy.special import ndtr, ndtri

from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.metrics.limits import (
    Clusters,
    limit_bounded_mean,
    limit_figure,
    limit_left_out,
    limit_rate,
    limit_share,
)
from copem_replay.metrics.row_figures import JUDGED, FigureRows
from copem_replay.metrics.summary import format_table
from copem_replay.results.compare.limits import find_stars

HORIZON_S: Final = 5.0
CLUSTERS: Final = (3, 4, 5, 8, 13, 20, 60)
COVERAGE, WRONG, STARRED = 0.93, 0.04, 0.06
"""The gates: the least coverage, the most that is wrongly met, the most tables with a false `*`."""
GUIDE: Final = Path(__file__).parents[1] / "docs" / "reference" / "intervals.md"
_ROUNDING: Final = 1e-9
Generator = np.random.Generator
Draw = Callable[[Float], Float]


class Row(NamedTuple):
    """The limits (S,) of studies, NaN: none, and the truth; `hair`: as far off it may be."""

    line: str
    design: str
    figure: str
    over: str
    clusters: int
    low: Float
    high: Float
    truth: float
    hair: float = _ROUNDING

    def tell(self, guide: str) -> dict[str, object]:
        """The row of the table, and whether it fails. A difference is judged by other limits than those printed."""
        given = ~np.isnan(self.low)
        low, high = self.low[given], self.high[given]
        above, below = high < self.truth - self.hair, low > self.truth + self.hair
        met, not_met = (below, above) if "share" in self.figure else (above, below)
        n, held, wrong = len(low), int((~above & ~below).sum()), float(met.mean())
        named = self.line if f"**{self.line}**" in guide else ""
        few = held / n < COVERAGE - allowance(COVERAGE, n) and not self.figure.endswith("at_most")
        often = wrong > WRONG + allowance(WRONG, n) and self.figure != "difference"
        return {
            "line": self.line, "design": self.design, "figure": self.figure, "over": self.over,
            "clusters": self.clusters, "held": held, "of": n, "wrongly met": wrong,
            "wrongly not met": float(not_met.mean()), "median width": float(np.median(high - low)), "named": named,
            "fails": (few or often) and not named,
        }  # fmt: skip


def allowance(gate: float, n: int) -> float:
    """What chance may add to a share of `n` studies: two standard errors."""
    return 2 * math.sqrt(gate * (1 - gate) / n)


def limit_means(values: Float, weights: Float, bounds: tuple[float, float] | None) -> tuple[Float, Float]:
    """Limits (S,) of means of clusters' `values (S, K)` with `weights`; between `bounds`, None: by Student's t."""
    n = weights.sum(axis=-1, keepdims=True)
    mean = (weights * values).sum(axis=-1, keepdims=True) / n
    without = (n * mean - weights * values) / (n - weights)
    if bounds is None:
        return limit_figure(mean[..., 0], without, weights)
    return limit_bounded_mean(mean[..., 0], without, weights, bounds)


# Objects of one drive: times up to the horizon, as quantile functions.


def mix(*parts: tuple[float, Draw | float]) -> Draw:
    """Quantiles of a mixture: shares, and of each a quantile function or a value."""
    ends = np.cumsum([share for share, _ in parts])

    def quantile(u: Float) -> Float:
        drawn = [
            np.full_like(u, of) if isinstance(of, float) else of(np.clip((u - end) / share + 1, 1e-12, 1 - 1e-12))
            for (share, of), end in zip(parts, ends, strict=True)
        ]
        return np.clip(np.select([u < end for end in ends], drawn, drawn[-1]), 0.0, HORIZON_S)

    return quantile


def lognormal(median: float, sigma: float) -> Draw:
    return lambda u: median * np.exp(sigma * ndtri(u))


def exponential(mean: float) -> Draw:
    return lambda u: -mean * np.log1p(-u)


def normal(mean: float, deviation: float) -> Draw:
    return lambda u: mean + deviation * ndtri(u)


def beta(a: float, b: float) -> Draw:
    from scipy.special import betaincinv

    return lambda u: HORIZON_S * betaincinv(a, b, u)


_SHARES: Final = (0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
OBJECTS: Final[Mapping[str, Draw]] = {
    **{f"two points: {c:g}, {q:g} never": mix((1 - q, c), (q, HORIZON_S)) for c in (0.0, 0.6, 2.0) for q in _SHARES},
    **{f"three points: 0, .6, {q:g} never": mix(((1 - q) / 2, 0.0), ((1 - q) / 2, 0.6), (q, HORIZON_S))
       for q in (0.02, 0.05, 0.1, 0.2, 0.4)},
    **{f"normal and never: .5 ± .1, {q:g} never": mix((1 - q, normal(0.5, 0.1)), (q, HORIZON_S))
       for q in (0.02, 0.05, 0.1, 0.2, 0.4)},
    **{f"beta: {a:g}, {b:g}": mix((1.0, beta(a, b)))
       for a, b in ((0.1, 0.9), (0.3, 2.0), (0.05, 1.0), (0.5, 0.5), (2.0, 8.0), (8.0, 2.0))},
    **{f"lognormal and never: σ {s:g}, {q:g} never": mix((1 - q, lognormal(0.6, math.hypot(s, 0.4))), (q, HORIZON_S))
       for s, q in ((1.0, 0.145), (1.5, 0.145), (0.5, 0.0595))},
    "zero and a tail: .7 at 0": mix((0.7, 0.0), (0.3, exponential(1.0))),
    "zero and a tail: .95 at 0": mix((0.95, 0.0), (0.05, exponential(2.0))),
    "cut at the horizon: lognormal": mix((1.0, lognormal(0.4, 2.0))),
    "cut at the horizon: 1/u": mix((1.0, lambda u: 0.2 / (1 - u))),
    "exponential": mix((1.0, exponential(1.0))),
    "normal": mix((1.0, normal(1.5, 0.4))),
    "uniform": mix((1.0, lambda u: 2.0 * u)),
}  # fmt: skip
_GRID: Final = (np.arange(200_000) + 0.5) / 200_000


def object_rows(rng: Generator, studies: int) -> Iterator[Row]:
    """Means of times up to the horizon of the objects of one drive."""
    for name, draw in OBJECTS.items():
        truth = float(draw(_GRID).mean())
        for K in CLUSTERS:
            limits = limit_means(draw(rng.random((studies, K))), np.ones((studies, K)), (0.0, HORIZON_S))
            yield Row("times, objects of one drive", name, "unknown_to_horizon_s", "objects", K, *limits, truth, 1e-4)


# Logs: objects that are detected with the share of their log, after times about its median.


class Logs(NamedTuple):
    """Logs of a kind (…): which are bad, the share detected, the median time in seconds; σ of its logarithm."""

    bad: Bool
    share: Float
    median_s: Float
    sigma: float

    def expected_s(self) -> Float:
        """(…) the mean of min(time, horizon) of each log."""
        far = (math.log(HORIZON_S) - np.log(self.median_s)) / self.sigma
        until = self.median_s * math.exp(self.sigma**2 / 2) * ndtr(far - self.sigma) + HORIZON_S * ndtr(-far)
        return self.share * until + (1 - self.share) * HORIZON_S


def draw_logs(kind: str, rng: Generator, shape: tuple[int, ...]) -> Logs:
    """Logs of a kind."""
    bad, known, soon = rng.random(shape) < 0.1, np.ones(shape), np.full(shape, 1e-9)
    if kind == "rare bad":
        return Logs(bad, np.where(bad, 0.2, 0.97), np.where(bad, 4.0, 0.6), 0.5)
    if kind == "all or nothing":
        return Logs(bad, np.where(bad, 0.0, 1.0), soon, 0.1)
    if kind == "zero and a tail":
        late = np.where(rng.random(shape) < 0.6, soon, rng.exponential(1.0, shape))
        return Logs(bad, 0.98 * known, late, 0.3)
    if kind == "alike":
        return Logs(bad, 0.97 * known, 0.6 * known, 0.5)
    bad = rng.random(shape) < 0.3
    if kind == "mild":
        return Logs(bad, rng.beta(8.1, 0.9, shape), rng.gamma(5.0, 0.16, shape), 1.0)
    if kind == "correlated by a half":
        return Logs(bad, rng.beta(0.8, 0.2, shape), 0.5 * rng.lognormal(0.0, 1.0, shape), 0.6)
    between, mean = map(float, kind.removeprefix("Beta ").split(" at "))
    return Logs(bad, rng.beta(between * mean, between * (1 - mean), shape), soon, 0.1)


KINDS: Final = (
    "rare bad", "mild", "correlated by a half", "all or nothing", "zero and a tail", "alike",
    *(f"Beta {between} at {mean}" for between in (2, 10, 40) for mean in (0.5, 0.9)),
)  # fmt: skip
SIZES: Final = ("5 each", "20 each", "unequal", "60 among 3")
BUSY: Final = KINDS[:4]
_FAR_APART: Final = ("rare bad", "correlated by a half", "all or nothing")


_MANY: Final = 500_000
"""Logs, or objects, of which a truth is the mean."""


def draw_sizes(size: str, bad: Bool, rng: Generator) -> Int:
    """(S, K) objects of each log."""
    if size == "unequal":
        return np.maximum(1, np.rint(6 * rng.lognormal(0.0, 1.2, bad.shape))).astype(np.int64)
    if size == "60 among 3":
        return np.where(np.arange(bad.shape[1]) == rng.integers(bad.shape[1], size=(len(bad), 1)), 60, 3)
    return np.where(bad, 25, 5) if size == "busy" else np.full(bad.shape, int(size.split()[0]))


def sum_objects(values: Float, w: Int) -> Float:
    """(S, K) sums of values of all objects (Σw,), log by log."""
    return np.add.reduceat(values, np.append(0, np.cumsum(w.ravel())[:-1])).reshape(w.shape)


def log_rows(rng: Generator, studies: int) -> Iterator[Row]:
    """Means of times and shares over logs."""
    for kind, size in [*((k, s) for k in KINDS for s in SIZES), *((k, "busy") for k in BUSY)]:
        many = draw_logs(kind, np.random.default_rng(5), (_MANY,))
        weight = np.where(many.bad & (size == "busy"), 25.0, 5.0)
        expected_s, share = (
            (many_of @ weight / weight.sum(), many_of.mean()) for many_of in (many.expected_s(), many.share)
        )
        design = f"{kind}: {size}"
        busy = ", bad logs that are busy" if size == "busy" else ""
        apart = busy or (", logs far apart" if kind in _FAR_APART else ", logs")
        for K in CLUSTERS:
            logs = draw_logs(kind, rng, (studies, K))
            w = draw_sizes(size, logs.bad, rng)
            known = rng.random(int(w.sum())) < np.repeat(logs.share, w.ravel())
            time_s = np.repeat(logs.median_s, w.ravel()) * np.exp(logs.sigma * rng.normal(size=len(known)))
            unknown_s = sum_objects(np.where(known, np.minimum(time_s, HORIZON_S), HORIZON_S), w) / w
            found = sum_objects(known.astype(float), w)
            row = partial(Row, over="logs", clusters=K, hair=0.003)
            limits = limit_means(unknown_s, w.astype(float), (0.0, HORIZON_S))
            yield row(f"times{busy or ', logs'}", design, "unknown_to_horizon_s", low=limits[0], high=limits[1],
                      truth=expected_s[0])  # fmt: skip
            limits = limit_share(found, w, w.sum(axis=-1))
            yield row(f"shares{apart}", design, "detected_share", low=limits[0], high=limits[1], truth=share[0])
            for what, figure, values, most, truth in (
                ("times", "unknown_to_horizon_s", unknown_s, HORIZON_S, expected_s[1]),
                ("shares", "detected_share", found / w, 1.0, share[1]),
            ):
                low, high = limit_means(values, np.ones(w.shape), (0.0, most))
                yield row(f"{what}, each drive once", design, figure, low=low, high=high, truth=truth)


# Figures without a bound: means of a part of the log and one of the object, correlated by .2 in a log, by Student's t.

_E: Final = math.e
UNBOUNDED: Final[Mapping[str, Callable[[Generator, Any], Float]]] = {
    "normal": lambda rng, n: rng.normal(0.0, 1.0, n),
    "uniform": lambda rng, n: rng.uniform(-math.sqrt(3), math.sqrt(3), n),
    "exponential": lambda rng, n: rng.exponential(1.0, n) - 1.0,
    "lognormal": lambda rng, n: (rng.lognormal(0.0, 1.0, n) - math.sqrt(_E)) / math.sqrt(_E * (_E - 1)),
    "zero in nine logs of ten": lambda rng, n: np.where(rng.random(n) < 0.9, 0.0, rng.exponential(5.0, n)) - 0.5,
    "one bad log in ten": lambda rng, n: np.where(rng.random(n) < 0.1, 5.0, 0.0) - 0.5,
}


def unbounded_rows(rng: Generator, studies: int) -> Iterator[Row]:
    """Means that have no bound."""
    for name, draw in UNBOUNDED.items():
        seldom = "ten" in name  # a tenth of the logs is otherwise, normal about that
        for size in ("1 each", "30 each", "unequal"):
            for K in CLUSTERS:
                w = draw_sizes(size, np.zeros((studies, K), dtype=bool), rng)
                parts = (1.0, 1.0) if seldom else (math.sqrt(0.2), math.sqrt(0.8))
                own = (rng.normal(0.0, 1.0, int(w.sum()))) if seldom else draw(rng, int(w.sum()))
                values = parts[0] * draw(rng, w.shape) + parts[1] * sum_objects(own, w) / w
                limits = limit_means(values, w.astype(float), None)
                yield Row(f"other figures, {name}", f"{name}: {size}", "nees", "logs", K, *limits, 0.0)


# Passes of one object, in several runs each.


PASSES: Final = (5, 8, 20)


def pass_rows(rng: Generator, studies: int) -> Iterator[Row]:
    """Shares and means over passes; of passes of one day what other days would have; of one object with many."""
    for share, P, runs, alike in product((0.9, 0.7), PASSES, (1, 20), (0.0, 0.3, 0.7, 1.0)):
        shape, other = (studies, P), (1 - alike) / alike if 0 < alike < 1 else 0.0
        q = np.full(shape, share) if alike == 0 else (rng.random(shape) < share) * 1.0
        q = rng.beta(share * other, (1 - share) * other, shape) if other else q
        found = rng.binomial(runs, q).astype(float)
        name = f"passes of {runs} runs: {share:g}, correlated by {alike:g}"
        rows = np.full(shape, float(runs))
        limits = limit_share(found, rows, np.full(studies, P))
        yield Row("shares, passes", name, "detected_share", "passes", P, *limits, share)
        limits = limit_means(HORIZON_S * (1 - found / runs), rows, (0.0, HORIZON_S))
        truth = HORIZON_S * (1 - share)
        yield Row("times, passes", name, "unknown_to_horizon_s", "passes", P, *limits, truth)
    for alike, P in product((0.1, 0.3, 0.5), PASSES):
        day, own = rng.normal(size=(studies, 1)), rng.normal(size=(studies, P))
        limits = limit_means(math.sqrt(alike) * day + math.sqrt(1 - alike) * own, np.ones((studies, P)), None)
        line = "other figures, passes of one day for other days"
        yield Row(line, f"one day: correlated by {alike:g}", "nees", "passes", P, *limits, 0.0)
        for k in range(1, P):
            own[:, k] = alike * own[:, k - 1] + math.sqrt(1 - alike**2) * own[:, k]
        limits = limit_means(own, np.ones((studies, P)), None)
        yield Row(line, f"one day: neighbours correlated by {alike:g}", "nees", "passes", P, *limits, 0.0)
    for K in CLUSTERS:
        rows = np.where(np.arange(K) == 0, 10.0, np.ones((studies, K)))
        limits = limit_means(rng.normal(size=rows.shape) + rng.normal(size=rows.shape) / np.sqrt(rows), rows, None)
        line = "other figures, one object with ten episodes"
        yield Row(line, "one object with ten episodes", "nees", "objects", K, *limits, 0.0)


# Rates: events of drives of half an hour to an hour and a half, whose own rates are gamma distributed.


def rate_rows(rng: Generator, studies: int) -> Iterator[Row]:
    """Needless brakes per hour, by the coefficient of variation of the rates between drives, and events a drive."""
    for cv, events, K in product((0.0, 0.5, 1.0, 2.0), (0.3, 2.0), CLUSTERS):
        hours = rng.uniform(0.5, 1.5, (studies, K))
        own = rng.gamma(1 / cv**2, cv**2, hours.shape) if cv else np.ones(hours.shape)
        found = rng.poisson(events * own * hours).astype(float)
        low, high = np.transpose([limit_rate(*drives) for drives in zip(found, hours, strict=True)])
        apart = {1.0: " that differ", 2.0: " far apart"}.get(cv, "")
        design = f"{events:g} a drive, coefficient of variation {cv:g}"
        yield Row(f"rates, drives{apart}", design, "needless_brakes_per_h", "logs", K, low, high, events)


# Differences of two configurations, pair by pair.


def two_sides(lost: tuple[float, float], noise: float, shift: float, sigma: float) -> Callable[..., Float]:
    """Differences of times: a common one, a share lost on either side, a shift of the first, noise on both."""

    def draw(rng: Generator, shape: tuple[int, int]) -> Float:
        common = 0.6 * np.exp(rng.normal(0, sigma, shape))
        sides = [np.where(rng.random(shape) < share, HORIZON_S,
                          np.minimum(common * np.exp(rng.normal(by, noise, shape)), HORIZON_S))
                 for share, by in zip(lost, (shift, 0.0), strict=True)]  # fmt: skip
        return sides[0] - sides[1]

    return draw


def lose(share: float, sign: float = 1.0) -> Callable[..., Float]:
    return lambda rng, shape: sign * np.where(rng.random(shape) < share, HORIZON_S, 0.0)


_LOSSES: Final = "one loses more"
DIFFERENCES: Final[Mapping[str, Callable[..., Float]]] = {
    "no difference: σ .4, .05 lost": two_sides((0.05, 0.05), 0.4, 0.0, 1.0),
    "no difference: σ .1, .01 lost": two_sides((0.01, 0.01), 0.1, 0.0, 0.5),
    "no difference: .05 lost": two_sides((0.05, 0.05), 0.0, 0.0, 0.5),
    "no difference: σ .4": two_sides((0.0, 0.0), 0.4, 0.0, 1.0),
    "later by 42 %: σ .4, .05 lost": two_sides((0.05, 0.05), 0.4, 0.35, 1.0),
    f"{_LOSSES}: .03, σ .1": two_sides((0.03, 0.0), 0.1, 0.0, 0.5),
    f"{_LOSSES}: .1, σ .4": two_sides((0.12, 0.02), 0.4, 0.0, 1.0),
    **{f"{_LOSSES}: {q:g}, else equal": lose(q) for q in (0.02, 0.05, 0.1, 0.3)},
    f"{_LOSSES}: .05 of the baseline": lose(0.05, -1.0),
    f"{_LOSSES}: .02, else sooner": lambda rng, n: np.where(
        rng.random(n) < 0.02, HORIZON_S - 0.6, rng.normal(-0.1, 0.05, n)
    ),
}


def difference_rows(rng: Generator, studies: int) -> Iterator[Row]:
    """Differences: their intervals, by Student's t; and criteria, that are met by limits between bounds."""
    for name, draw in DIFFERENCES.items():
        same = name.startswith("no difference")
        truth = 0.0 if same else float(np.mean([draw(np.random.default_rng(k), (1, 400_000)).mean() for k in range(8)]))
        for K in CLUSTERS:
            values, ones = draw(rng, (studies, K)), np.ones((studies, K))
            low, high = limit_means(values, ones, None)
            _, most = limit_means(values, ones, (-HORIZON_S, HORIZON_S))
            alike = np.ptp(values, axis=1) <= _ROUNDING  # no interval, and not met beyond the value itself
            row = partial(Row, design=name, over="objects", clusters=K, truth=truth, hair=0.003)
            given = [np.where(alike, np.nan, of) for of in (low, high)]
            line = f"differences, {_LOSSES}" if name.startswith(_LOSSES) else "differences"
            yield row(line, figure="difference", low=given[0], high=given[1])
            yield row("differences, at_most", figure="difference, at_most", low=low, high=most)


# Rows that are followed until the object leaves or the log ends, through the figures of criteria.


class Traffic(NamedTuple):
    """Rows (n,) of a study, with their logs or objects: times to detection, until departure, until the log ends."""

    cluster: Int
    time_s: Float
    leaves_s: Float
    ends_s: Float


def _objects(never: float, time: Callable[[Generator, int], Float], leaves: Any, ends: Any) -> Callable[..., Traffic]:
    def draw(rng: Generator, n: int) -> Traffic:
        time_s = np.where(rng.random(n) < never, np.inf, time(rng, n))
        return Traffic(np.arange(n), time_s, leaves(rng, n), ends(rng, n))

    return draw


def _uniform(low: float, high: float) -> Callable[[Generator, int], Float]:
    return lambda rng, n: rng.uniform(low, high, n)


def _about(median: float, sigma: float) -> Callable[[Generator, int], Float]:
    return lambda rng, n: median * rng.lognormal(0.0, sigma, n)


def _exponential(mean: float) -> Callable[[Generator, int], Float]:
    return lambda rng, n: rng.exponential(mean, n)


_LEAVES, _ENDS = _uniform(1, 14), _uniform(2, 16)
FOLLOWED_OBJECTS: Final[Mapping[str, Callable[..., Traffic]]] = {
    "followed: σ 1, .145 never": _objects(0.145, _about(0.6, math.hypot(1, 0.4)), _LEAVES, _ENDS),
    "followed: σ .5, .06 never": _objects(0.0595, _about(0.6, math.hypot(0.5, 0.4)), _LEAVES, _ENDS),
    "followed: .1 never, censored early": _objects(0.1, _uniform(0.1, 0.1), _uniform(1, 30), _uniform(0.2, 8)),
    "followed: exponential, half censored": _objects(0.0, _exponential(1.5), _uniform(2, 20), _exponential(1.5)),
    "followed: exponential, a quarter censored": _objects(0.0, _exponential(1.5), _uniform(2, 20), _exponential(4.5)),
    "followed: short and long": _objects(
        0.1, _about(0.5, 0.5),
        lambda rng, n: np.where(rng.random(n) < 0.1, rng.uniform(20, 60, n), rng.uniform(1, 6, n)), _uniform(99, 99)),
    "followed: zero and a tail": _objects(
        0.03, lambda rng, n: np.where(rng.random(n) < 0.7, 0.0, rng.exponential(1.0, n)), _LEAVES, _ENDS),
    "followed: .02 never, long": _objects(0.02, _about(0.4, 0.4), _about(5.0, 0.8), _uniform(300, 300)),
}  # fmt: skip


def _of_logs(kind: str, size: str, ends: Callable[[Generator, int], Float]) -> Callable[..., Traffic]:
    def draw(rng: Generator, K: int) -> Traffic:
        logs = draw_logs(kind, rng, (1, K))
        w = draw_sizes(size, logs.bad, rng)[0]
        log = np.repeat(np.arange(K), w)
        time_s = logs.median_s[0, log] * rng.lognormal(0.0, logs.sigma, len(log))
        time_s = np.where(rng.random(len(log)) > logs.share[0, log], np.inf, time_s)
        return Traffic(log, time_s, _LEAVES(rng, len(log)), ends(rng, len(log)))

    return draw


_HALF: Final = _exponential(4.0)
FOLLOWED_LOGS: Final[Mapping[str, Callable[..., Traffic]]] = {
    f"followed logs: {kind}, {size}{', half censored' if ends is _HALF else ''}": _of_logs(kind, size, ends)
    for kind, size, ends in (
        ("mild", "5 each", _ENDS), ("mild", "unequal", _HALF), ("rare bad", "5 each", _ENDS),
        ("rare bad", "unequal", _HALF), ("correlated by a half", "unequal", _ENDS),
        ("zero and a tail", "unequal", _HALF),
    )
}  # fmt: skip
FOLLOWED: Final = ("ttd_rmst_s", "unknown_s", "unknown_to_horizon_s", "detected_share")


def rows_of(traffic: Traffic) -> pd.DataFrame:
    """The rows of a study as the tally has them; objects are detected at tenths of a second."""
    time_s, leaves_s, ends_s = np.round(traffic.time_s, 1), traffic.leaves_s, traffic.ends_s
    ended_s = np.minimum(leaves_s, ends_s)
    return pd.DataFrame({
        "onset_s": 0.0, "ended_s": ended_s, "ended_by": np.where(leaves_s <= ends_s, "object_left", "log_end"),
        "time_to_detection_s": np.where(time_s <= ended_s, time_s, np.nan),
    })  # fmt: skip


def true_figures(table: pd.DataFrame, time_s: Float, leaves_s: Float) -> dict[str, float]:
    """The figures of very many rows. Of `ttd_rmst_s` as if none were censored: what is censored fares like the rest."""
    known = table["time_to_detection_s"].notna().to_numpy()
    unknown_s = np.where(known, table["time_to_detection_s"], table["ended_s"]).astype(float)
    time_s = np.round(time_s, 1)
    means = {
        "ttd_rmst_s": np.minimum(np.where(time_s <= leaves_s, time_s, np.inf), HORIZON_S),
        "unknown_s": unknown_s,
        "unknown_to_horizon_s": np.minimum(unknown_s, HORIZON_S),
        "detected_share": known,
    }
    return {name: float(of.mean()) for name, of in means.items()}


def followed_rows(rng: Generator, studies: int) -> Iterator[Row]:
    """Figures of rows that are followed, over objects and over logs."""
    named = [*((of, "objects") for of in FOLLOWED_OBJECTS.items()), *((of, "logs") for of in FOLLOWED_LOGS.items())]
    for (name, draw), over in named:
        many = draw(np.random.default_rng(5), 4 * _MANY if over == "objects" else _MANY)
        truth = true_figures(rows_of(many), many.time_s, many.leaves_s)
        for K in [K for K in CLUSTERS if K not in ((3, 4, 13) if over == "objects" else (5, 13))]:
            limits = np.full((len(FOLLOWED), 2, studies), np.nan)
            for k in range(studies):
                traffic = draw(rng, K)
                table = rows_of(traffic)
                clusters = Clusters(over, traffic.cluster, np.arange(len(table)))
                rows = FigureRows(table, np.ones(len(table)), clusters)
                for j, figure in enumerate(FOLLOWED):
                    found = JUDGED[figure].limit(rows, HORIZON_S, 0.95, math.nan)
                    limits[j, :, k] = found.low, found.high
            for j, figure in enumerate(FOLLOWED):
                line = f"{'shares' if figure == 'detected_share' else 'times'}, followed {over}"
                yield Row(line, name, figure, over, K, limits[j, 0], limits[j, 1], truth[figure], 0.005)


# Stars of tables of four configurations against a baseline, truly alike.

METRICS: Final = 8
"""Metrics of a table; of the last there are no limits."""
NULLS: Final = (
    ("mild", "5 each"),
    ("rare bad", "unequal"),
    ("correlated by a half", "busy"),
    ("zero and a tail", "unequal"),
)
Cell = tuple[Float, Float, Float]


def draw_table(kind: str, size: str, rng: Generator, shape: tuple[int, int]) -> list[list[Cell]]:
    """By configuration and metric: differences (S,), without each log (S, K), and weights."""
    logs = draw_logs(kind, rng, shape)
    w = draw_sizes(size, logs.bad, rng)
    of, frames = np.repeat(np.arange(w.size), w.ravel()), rng.integers(80, 200, shape).astype(float)
    common = logs.median_s.ravel()[of] * rng.lognormal(0.0, logs.sigma, len(of))
    never, end_s = rng.random(len(of)) > logs.share.ravel()[of], np.minimum(_LEAVES(rng, len(of)), _ENDS(rng, len(of)))
    hard, sides = rng.lognormal(0.0, 0.5, shape), []
    for _ in range(5):
        lost = never | (rng.random(len(of)) < 0.05)
        time_s = np.where(lost, np.inf, np.round(common * rng.lognormal(0.0, 0.4, len(of)), 1))
        square = rng.gamma(1.0, 0.5, len(of)) * hard.ravel()[of]
        ghosts = rng.poisson(frames / 100 * hard).astype(float)
        sides.append((time_s, time_s <= end_s, square, 2 * frames * hard * rng.gamma(20.0, 0.05, shape), ghosts))
    return [_cells(side, sides[0], end_s, w, frames) for side in sides[1:]]


def _cells(side: Any, baseline: Any, end_s: Float, w: Int, frames: Float) -> list[Cell]:
    both, size = side[1] & baseline[1], w.astype(float)
    known = sum_objects(both.astype(float), w)
    columns: list[tuple[Float, Float, Float]] = []  # sums of either side, and what they average over
    for values, n in (
        (lambda of: of[1].astype(float), size),
        (lambda of: np.minimum(of[0], HORIZON_S), size),
        (lambda of: np.where(of[1], of[0], end_s), size),
        (lambda of: np.where(both, of[0], 0.0), known),
        (lambda of: of[2], size),
    ):
        columns.append((*(sum_objects(values(of), w) for of in (side, baseline)), n))
    columns += [(side[k], baseline[k], frames) for k in (3, 4)]
    return [_leave_out(*column, root=k in (4, 5)) for k, column in enumerate(columns)]


def _leave_out(first: Float, second: Float, n: Float, *, root: bool) -> Cell:
    """A difference of means, or of their roots: of all logs, without each, and weights."""

    def figure(sums: Float, over: Float) -> Float:
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.sqrt(np.maximum(sums, 0.0) / over) if root else sums / over

    total, rest = (of.sum(axis=-1, keepdims=True) for of in (first, n))
    value = figure(total, rest) - figure(second.sum(axis=-1, keepdims=True), rest)
    without = figure(total - first, rest - n) - figure(second.sum(axis=-1, keepdims=True) - second, rest - n)
    return value[..., 0], without, n


def star_shares(rng: Generator, kind: str, size: str, K: int, tables: int) -> tuple[float, list[float], float]:
    """Shares of tables with a false star: held over the table, of each named metric, and by intervals alone."""
    cells = draw_table(kind, size, rng, (tables, K))
    alone = np.zeros((len(cells), METRICS, tables), dtype=bool)
    for c, row in enumerate(cells):
        for m, (value, without, weights) in enumerate(row):
            given = np.isfinite(without).all(axis=-1) & (weights > 0).all(axis=-1)
            given &= np.abs(without - value[..., None]).max(axis=-1) > _ROUNDING
            if given.any():
                low, high = limit_figure(value[given], without[given], weights[given])
                alone[c, m, given] = (low > _ROUNDING) | (high < -_ROUNDING)

    def limit(c: int, m: int, k: int, confidence: float) -> Mapping[str, object]:
        value, without, weights = cells[c][m]
        found = limit_left_out(float(value[k]), without[k], weights[k], confidence=confidence)
        return {"low": found.low, "high": found.high}

    starred, named = np.zeros(tables, dtype=bool), np.zeros((METRICS - 1, tables), dtype=bool)
    for k in np.flatnonzero(alone.any(axis=(0, 1))):
        may = np.argwhere(alone[:, :, k])
        starred[k] = bool(find_stars(4 * METRICS, [partial(limit, c, m, k) for c, m in may]))
        for of in range(METRICS - 1):
            named[of, k] = bool(find_stars(4, [partial(limit, c, m, k) for c, m in may if m == of]))
    return float(starred.mean()), named.mean(axis=1).tolist(), float(alone.any(axis=(0, 1)).mean())


def star_table(seed: int, tables: int) -> pd.DataFrame:
    """A row per design and number of logs: how many of the tables have a false star."""
    rows = []
    for number, (kind, size) in enumerate(NULLS):
        for K in (3, 4, 8, 20):
            whole, named, alone = star_shares(np.random.default_rng([seed, 90 + number, K]), kind, size, K, tables)
            fails = max(whole, *named) > STARRED + allowance(STARRED, tables)
            rows.append({
                "design": f"{kind}: {size}", "logs": K, "tables": tables, "by intervals alone": alone,
                "over the table": whole, "one named metric, most": max(named), "fails": fails,
            })  # fmt: skip
    return pd.DataFrame(rows)


PARTS: Final[tuple[Callable[[Generator, int], Iterator[Row]], ...]] = (
    object_rows, log_rows, unbounded_rows, pass_rows, difference_rows, followed_rows, rate_rows,
)  # fmt: skip


def coverage(studies: int, seed: int) -> pd.DataFrame:
    """The table: a row per design, figure and number of clusters."""
    guide = GUIDE.read_text(encoding="utf-8")
    rows = []
    for number, part in enumerate(PARTS):
        few = max(studies // 4, 1) if part is followed_rows else studies
        rows += [row.tell(guide) for row in part(np.random.default_rng([seed, number]), few)]
    return pd.DataFrame(rows)


def sum_up(table: pd.DataFrame) -> list[str]:
    """The lines of the page's table: of each number of clusters the least coverage, and the median of the widths."""
    kinds = list(dict.fromkeys(table["line"].str.partition(",")[0]))
    lines = sorted(table["line"].unique(), key=lambda line: kinds.index(line.partition(",")[0]))
    clusters = [str(K) for K in CLUSTERS]
    printed = [["held · width", *clusters, "wrongly met"], ["---"] * (len(CLUSTERS) + 2)]
    for line in lines:
        rows = table[table["line"] == line]
        cells = [f"**{line}**" if (rows["named"] != "").any() else line]
        for K in CLUSTERS:
            of = rows[rows["clusters"] == K]
            held = "– · " if "at_most" in line else f"{(of['held'] / of['of']).min():.3f} · ".lstrip("0")
            cells.append(f"{held}{of['median width'].median():.2g}" if len(of) else "")
        wrong = "" if (rows["figure"] == "difference").all() else f"{rows['wrongly met'].max():.3f}".lstrip("0")
        printed.append([*cells, wrong])
    return [f"| {' | '.join(cells)} |" for cells in printed]


def main() -> int:
    parser = argparse.ArgumentParser(description="Coverage, width, wrong verdicts and false * of intervals.")
    parser.add_argument("--studies", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--csv", action="store_true", help="every row, as CSV")
    asked = parser.parse_args()
    table, stars = coverage(asked.studies, asked.seed), star_table(asked.seed, asked.studies)
    if asked.csv:
        for of in (table.drop(columns="line"), stars):
            print(of.drop(columns="fails").to_csv(index=False, float_format="%.4g"))
    else:
        print(*sum_up(table), "", format_table(stars.drop(columns="fails").round(3)), sep="\n")
    failing = pd.concat([table[table["fails"]], stars[stars["fails"]]])
    print(f"{len(failing)} of {len(table) + len(stars)} rows are beyond a gate and not named", file=sys.stderr)
    if len(failing):
        print(failing.drop(columns="fails").to_csv(index=False, float_format="%.4g"), file=sys.stderr)
    return 1 if len(failing) else 0


if __name__ == "__main__":
    sys.exit(main())

"""How often intervals over logs hold the truth, how wide they are, and how often a `*` is false.

    nice -n 10 python tools/coverage.py            # all rows, 2,000 studies each: minutes on one core

A study has K logs with 1, 5 or 30 objects each, or unequal ones (lognormal, σ = 1, at least one), and its intervals are
those of the package (`metrics/limits.py`). *Shares*: of each log drawn from a Beta distribution of so much between
logs (a + b: 2, 10, 40) and mean .5 or .9, or .95, and .2 in one log of ten; of its objects so many are detected. *Other
figures*: means over objects of a part of the log and one of the object, both of the named distribution, variances 1 : 4
(a correlation of .2); where it is zero but for a tenth, or bad in one log of ten, the object's part is normal. *RMST*:
restricted means of exponential times at 3 times their mean, of which a sixth are censored, from logs whose mean
times are gamma distributed, with the limits of means between bounds. *False `*`*: of the difference of two such
configurations on the same logs, truly 0, how often the interval excludes 0: a difference of shares that all logs have
alike has exact limits.

*Wrong*: verdicts of a criterion whose bound is the truth (`results/verdicts.py`): how often it is met though the truth
is beyond the bound by a hair, or not met though it keeps it by a hair, the more frequent of both; of the figure, and of
the difference of two configurations, truly 0. At most 3.5 % and three standard errors for shares of Beta designs,
restricted means and for differences, which are symmetric, of shares and of normal and uniform figures; in other rows it
stands beside the coverage.

Gates are those of the guide, less two standard errors; a row beyond a gate makes the exit code 1.
"""

from __future__ import annotations

if __name__ == "coverage":  # numba looks for the package of that name, and within tools/ this file comes first
    raise ImportError("tools/coverage.py is a program, not the package")

import argparse
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import pandas as pd

from copem_replay.core.tracks import Float, Int
from copem_replay.metrics.limits import alike_limits, limit_bounded_mean, limit_figure, limit_share
from copem_replay.metrics.summary import format_table
from copem_replay.metrics.survival import (
    CENSORED,
    DETECTED,
    cumulative_incidence,
    restricted_mean,
    restricted_means_without,
)
from copem_replay.results.verdicts import MET, NOT_MET, judge_limits

LOGS: Final = (3, 4, 5, 8, 12, 20)
OBJECTS: Final = (1, 5, 30)
_SAME: Final = 1e-9


@dataclass(frozen=True)
class Design:
    """A kind of study: `study(rng, w)` gives sums over the objects (S, K) of logs with `w (S, K)` objects.

    `truth`: the mean over objects of all such logs. `gate(K)`: the least coverage; None: printed only.
    """

    name: str
    kind: str
    truth: float
    study: Callable[[np.random.Generator, Int], Float]
    gate: Callable[[int], float | None]


def draw_sizes(rng: np.random.Generator, studies: int, logs: int, objects: int, *, equal: bool) -> Int:
    """(S, K) objects of each log."""
    if equal:
        return np.full((studies, logs), objects)
    return np.maximum(1, np.rint(objects * rng.lognormal(0.0, 1.0, (studies, logs)))).astype(np.int64)


def sum_objects(values: Float, w: Int) -> Float:
    """(S, K) sums of values of all objects (Σw,), log by log."""
    return np.add.reduceat(values, np.append(0, np.cumsum(w.ravel())[:-1])).reshape(w.shape)


# Shares.


def _beta_share(mean: float, between: float) -> Design:
    def study(rng: np.random.Generator, w: Int) -> Float:
        p = rng.beta(between * mean, between * (1 - mean), w.shape)
        return rng.binomial(w, p).astype(float)

    return Design(f"Beta({between:g}) at {mean:g}", "share", mean, study, lambda logs: 0.93)


def _bad_share(rng: np.random.Generator, w: Int) -> Float:
    return rng.binomial(w, np.where(rng.random(w.shape) < 0.1, 0.2, 0.95)).astype(float)


# Other figures.


def _mean_of(
    name: str, draw: Callable[[np.random.Generator, tuple[int, ...]], Float], gate: Callable[[int], float | None]
) -> Design:
    """Means of objects with a part of the log and their own; `draw`: a distribution of mean 0 and variance 1."""

    def study(rng: np.random.Generator, w: Int) -> Float:
        own = sum_objects(draw(rng, (int(w.sum()),)), w)
        return math.sqrt(0.2) * w * draw(rng, w.shape) + math.sqrt(0.8) * own

    return Design(name, "mean", 0.0, study, gate)


def _seldom(name: str, draw: Callable[[np.random.Generator, tuple[int, ...]], Float]) -> Design:
    """Means of objects that are otherwise in a tenth of the logs, normal about that."""

    def study(rng: np.random.Generator, w: Int) -> Float:
        return w * draw(rng, w.shape) + sum_objects(rng.normal(0.0, 1.0, int(w.sum())), w)

    return Design(name, "mean", 0.0, study, lambda logs: None)


_E: Final = math.e
DESIGNS: Final = (
    *(_beta_share(mean, between) for between in (2, 10, 40) for mean in (0.5, 0.9)),
    Design("one bad log in ten", "share", 0.1 * 0.2 + 0.9 * 0.95, _bad_share, lambda logs: 0.93 if logs <= 8 else 0.85),
    _mean_of("normal", lambda rng, n: rng.normal(0.0, 1.0, n), lambda logs: 0.93),
    _mean_of("uniform", lambda rng, n: rng.uniform(-math.sqrt(3), math.sqrt(3), n), lambda logs: 0.93),
    _mean_of("exponential", lambda rng, n: rng.exponential(1.0, n) - 1.0, lambda logs: 0.90),
    _mean_of(
        "lognormal",
        lambda rng, n: (rng.lognormal(0.0, 1.0, n) - math.sqrt(_E)) / math.sqrt(_E * (_E - 1)),
        lambda logs: 0.85,
    ),
    _seldom("zero-inflated", lambda rng, n: np.where(rng.random(n) < 0.9, 0.0, rng.exponential(5.0, n)) - 0.5),
    _seldom("one bad log in ten", lambda rng, n: np.where(rng.random(n) < 0.1, 5.0, 0.0) - 0.5),
)
RMST: Final = "censored RMST"
HORIZON_S: Final = 3.0


def mean_limits(sums: Float, w: Int) -> tuple[Float, Float, Float]:
    """The mean of each study (S,), without each log (S, K), and its limits: (mean, low, high)."""
    total, n = sums.sum(axis=-1, keepdims=True), w.sum(axis=-1, keepdims=True)
    mean = (total / n)[..., 0]
    low, high = limit_figure(mean, (total - sums) / (n - w), w.astype(float))
    return mean, low, high


def difference_limits(sums: Float, w: Int) -> tuple[Float, Float]:
    """The interval of a mean difference of each study."""
    difference, low, high = mean_limits(sums, w)
    for k in np.flatnonzero(np.ptp(sums / w, axis=-1) <= _SAME):
        low[k], high[k] = alike_limits(float(difference[k]), w[k])
    return low, high


def wrong_verdicts(low: Float, high: Float, truth: float) -> float:
    """How often a criterion whose bound is the truth is met, or how often not met; the larger of both."""
    limits = zip(low.tolist(), high.tolist(), strict=True)
    words = [judge_limits(*one, truth, "at_most") for one in limits]
    return max(words.count(MET), words.count(NOT_MET)) / len(words)


def draw_times(rng: np.random.Generator, w: Int) -> tuple[Float, Int, Int]:
    """Times to detection of all objects of one study, how they end, and their logs; `w (K,)`."""
    log = np.repeat(np.arange(len(w)), w)
    time_s = rng.exponential(1.0, len(log)) * rng.gamma(5.0, 0.2, len(w))[log]
    ended_s = rng.uniform(0.3, 5.0, len(log))
    ending = np.where(time_s <= ended_s, DETECTED, CENSORED)
    return np.round(np.minimum(time_s, ended_s), 9), ending, log


def true_rmst_s() -> float:
    """The mean of min(T, h), E[m(1 − e^(−h/m))], by the midpoint rule over quantiles of the logs' mean times m."""
    from scipy.special import gammaincinv

    mean_s = 0.2 * gammaincinv(5.0, (np.arange(200_000) + 0.5) / 200_000)
    return float((mean_s * -np.expm1(-HORIZON_S / mean_s)).mean())


def rmst_of(times: tuple[Float, Int, Int], logs: int) -> tuple[float, Float]:
    """The restricted mean of a study, and without each log."""
    time_s, ending, log = times
    weight = np.ones(len(time_s))
    value = restricted_mean(*cumulative_incidence(time_s, ending, weight), HORIZON_S)
    return value, restricted_means_without(time_s, ending, weight, log, logs, HORIZON_S)


def rmst_row(rng: np.random.Generator, w: Int) -> tuple[tuple[Float, Float], tuple[Float, Float]]:
    """Limits (S,) of restricted means of studies, and those of differences."""
    studies, logs = w.shape
    value, without, followed = np.empty((2, studies)), np.empty((2, studies, logs)), np.empty(studies)
    for k in range(studies):
        for side in (0, 1):
            times = draw_times(rng, w[k])
            value[side, k], without[side, k] = rmst_of(times, logs)
            if side == 0:  # at least one row is: else there is no interval, and no study of one
                followed[k] = max(((times[1] == DETECTED) | (times[0] >= HORIZON_S)).mean(), 1 / len(times[0]))
    weights = w.astype(float)
    limits = limit_bounded_mean(value[0], without[0], weights, (0.0, HORIZON_S), followed)
    return limits, limit_figure(value[0] - value[1], without[0] - without[1], weights, (-HORIZON_S, HORIZON_S))


MOST_WRONG: Final = 0.035
"""Most verdicts that are wrong at the bound, beside three standard errors, in rows that are held to it."""


def describe_row(
    limits: tuple[Float, Float],
    of_difference: tuple[Float, Float],
    truth: float,
    gate: float | None,
    *,
    judged: bool,
    symmetric: bool,
) -> dict[str, object]:
    """Coverage, width, false `*` and wrong verdicts of a row of the table, its gate, and whether it fails.

    `judged`: verdicts of the figure are held to `MOST_WRONG`; `symmetric`: those of the difference are.
    """
    (low, high), (least_of, most_of) = limits, of_difference
    star = float(((least_of > _SAME) | (most_of < -_SAME)).mean())
    wrong, wrong_difference = wrong_verdicts(low, high, truth), wrong_verdicts(least_of, most_of, 0.0)
    most = MOST_WRONG + 3 * math.sqrt(MOST_WRONG * (1 - MOST_WRONG) / len(low))
    held = float(((low <= truth + _SAME) & (truth - _SAME <= high)).mean())
    least = None if gate is None else gate - 2 * math.sqrt(gate * (1 - gate) / len(low))
    return {
        "coverage": held,
        "width": float((high - low).mean()),
        "false *": star,
        "wrong": wrong,
        "wrong, difference": wrong_difference,
        "gate": gate,
        "fails": (least is not None and held < least)
        or (judged and wrong > most)
        or (symmetric and wrong_difference > most),
    }


def row_of(design: Design, rng: np.random.Generator, w: Int) -> dict[str, object]:
    """A row of the table, of studies whose logs have `w (S, K)` objects."""
    sums, others = design.study(rng, w), design.study(rng, w)
    limits = limit_share(sums, w, w.sum(axis=-1)) if design.kind == "share" else mean_limits(sums, w)[1:]
    beta, symmetric = design.name.startswith("Beta"), design.name in ("normal", "uniform")
    return describe_row(
        limits, difference_limits(sums - others, w), design.truth, design.gate(w.shape[1]),
        judged=beta, symmetric=beta or symmetric,
    )  # fmt: skip


def table_rows(logs: Sequence[int], objects: Sequence[int], studies: int, seed: int) -> Iterator[dict[str, object]]:
    """A row per design, number of logs and of objects, equal and unequal; random numbers by the row alone."""
    rmst_s = true_rmst_s()
    for number, name in enumerate([*range(len(DESIGNS)), RMST]):
        for equal in (True, False):
            for size in objects:
                for K in logs:
                    rng = np.random.default_rng([seed, number, equal, size, K])
                    w = draw_sizes(rng, studies, K, size, equal=equal)
                    row = {"kind": "mean", "design": RMST, "objects": size, "sizes": "equal" if equal else "unequal"}
                    if name == RMST:
                        found = describe_row(*rmst_row(rng, w), rmst_s, 0.93, judged=True, symmetric=False)
                    else:
                        design = DESIGNS[number]
                        row |= {"kind": design.kind, "design": design.name}
                        found = row_of(design, rng, w)
                    yield row | {"logs": K} | found


def coverage(
    logs: Sequence[int] = LOGS, objects: Sequence[int] = OBJECTS, studies: int = 2000, seed: int = 1
) -> pd.DataFrame:
    """The table: a row per design, number of logs and of objects, equal and unequal."""
    return pd.DataFrame(list(table_rows(logs, objects, studies, seed)))


def worst(table: pd.DataFrame) -> pd.DataFrame:
    """By design and number of logs: least coverage, mean width and most false `*` of all numbers of objects."""
    of = table.groupby(["kind", "design", "logs"], sort=False)
    columns = {
        "coverage, least": of["coverage"].min(),
        "width, mean": of["width"].mean(),
        "false *, most": of["false *"].max(),
        "wrong, most": of["wrong"].max(),
        "wrong, difference, most": of["wrong, difference"].max(),
    }
    return pd.DataFrame(columns).reset_index()


def main() -> int:
    parser = argparse.ArgumentParser(description="Coverage, width and false * of intervals over logs.")
    parser.add_argument("--studies", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--logs", type=int, nargs="+", default=list(LOGS))
    parser.add_argument("--objects", type=int, nargs="+", default=list(OBJECTS))
    asked = parser.parse_args()
    table = coverage(asked.logs, asked.objects, asked.studies, asked.seed)
    print(format_table(table.drop(columns="fails").round(3)))
    print("\nOver all numbers of objects:")
    print(format_table(worst(table).round(3)))
    failing = table[table["fails"]]
    print(f"\n{len(failing)} of {len(table)} rows are beyond a gate")
    if len(failing):
        print(format_table(failing.drop(columns="fails").round(3)))
    return 1 if len(failing) else 0


if __name__ == "__main__":
    sys.exit(main())

"""The other errors of a unit: its pose, classes, existence, ghosts, ids, and outages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from scipy.special import expit
from scipy.stats import beta, f

from copem_replay.core.tracks import CLASSES, Float, Int
from copem_replay.core.yaml import CommentedValue
from copem_replay.extras.fitting.error_memory import LastingPart, ResidualSeries, sum_correlations
from copem_replay.extras.fitting.errors import build_series
from copem_replay.extras.fitting.estimate import Estimate, maximise_likelihood, profile_limits, round_digits
from copem_replay.extras.fitting.false_positives import (
    GhostsFit,
    estimate_duration,
    fit_ghosts,
    garwood_interval,
    log_classes,
)
from copem_replay.extras.fitting.pose import PoseFit, fit_pose
from copem_replay.extras.fitting.rows import FitLists, FitRows, OtherEntries

# Classes: what objects are taken for, and how long such a mistake lasts.

_BOUNDS = ((-8.0, 8.0), (np.log(0.01), np.log(1e4)))
"""Of the log-odds of the share that lasts, and of ln τ (s)."""
_WORTH_IT = 2.996
"""Log-likelihood that memory must gain: half of the 95 % quantile of χ²₂."""


@dataclass(frozen=True)
class ClassesFit:
    """By true class and listed class the probability; the parts that last; or why the data do not tell."""

    confusion: Mapping[str, Mapping[str, Estimate]] = field(default_factory=dict)
    memory: tuple[LastingPart, ...] = ()
    untold: str | None = None

    def keys(self) -> dict[str, Any]:
        """A PEM's `classes`; empty where no class is mistaken."""
        rows = {}
        for true, row in self.confusion.items():
            shares = {name: round(one.value, 4) for name, one in row.items()}
            shares[true] = round(1 - sum(share for name, share in shares.items() if name != true), 4)
            if len(shares) > 1:
                words = "; ".join(f"{name} {one.words()}" for name, one in row.items())
                rows[true] = CommentedValue(shares, words)
        return {"confusion": rows} if rows else {}


def fit_classes(rows: FitRows, series: ResidualSeries) -> ClassesFit:
    """Fit the classes of listed rows. Each true class has a Dirichlet(½) prior over the classes it is listed as.

    A list uses a held uniform with probability `share`, which lasts τ: both by the likelihood of all listed classes,
    and counts are reduced to the effective number of such rows.
    """
    if not (rows.class_ix >= 0).any():
        return ClassesFit(untold="the lists have no classes")
    true, listed = rows.view.class_ix.astype(np.int64), rows.class_ix
    if (true == listed).all():
        high = float(beta.ppf(0.95, 0.5, len(true) + 0.5))
        return ClassesFit(
            untold=f"no class mistaken in {len(true)} entries (mistaken: < {high:.2g}, were they independent)"
        )
    counts = np.zeros((len(CLASSES), len(CLASSES)))
    np.add.at(counts, (true, listed), 1.0)
    possible = (counts > 0) | (np.eye(len(CLASSES), dtype=bool) & (counts.sum(axis=1) > 0)[:, None])
    smooth = np.where(possible, counts + 0.5, 0.0)
    shares = np.ascontiguousarray((smooth / np.maximum(smooth.sum(axis=1), 1)[:, None])[true])

    def of(x: Float) -> float:
        return float(log_classes(shares, listed, series.decay(float(np.exp(x[1]))), series.new, float(expit(x[0]))))

    best, value = maximise_likelihood(of, [(w, np.log(tau_s)) for w in (-1.0, 1.5) for tau_s in (0.3, 3.0)], _BOUNDS)
    log_fresh = float(log_classes(shares, listed, series.decay(1.0), series.new, 0.0))
    memory: tuple[LastingPart, ...] = ()
    share, tau_s = 0.0, 1.0
    if value - log_fresh > _WORTH_IT:
        share, tau_s = float(expit(best[0])), float(np.exp(best[1]))
        lasts = expit(profile_limits(of, best, value, 0, _BOUNDS)), np.exp(profile_limits(of, best, value, 1, _BOUNDS))
        n = len(true)
        memory = (
            LastingPart(
                *(Estimate(one, float(low), float(high), n, float(series.new.sum()))
                  for one, (low, high) in zip((share, tau_s), lasts, strict=True))
            ),
        )  # fmt: skip
    half = np.sqrt(series.decay(tau_s))
    _, pairs = sum_correlations(half, series.new, true, len(CLASSES), share, 0.0)
    confusion = {}
    for k in np.flatnonzero(counts.sum(axis=1)):
        n = int(counts[k].sum())
        worth = n * n / pairs[k]
        kinds = np.flatnonzero(possible[k])
        confusion[CLASSES[k]] = {CLASSES[j]: _estimate_probability(counts[k, j], n, worth, len(kinds)) for j in kinds}
    return ClassesFit(confusion, memory)


def _estimate_probability(count: float, n: int, worth: float, kinds: int) -> Estimate:
    """The probability of one of `kinds` classes, listed `count` times of `n` that are worth `worth`."""
    k = count * worth / n
    low, high = beta.ppf([0.025, 0.975], k + 0.5, worth - k + 0.5)
    value = (k + 0.5) / (worth + 0.5 * kinds)
    return Estimate(float(value), float(min(low, value)), float(max(high, value)), n, float(worth))


# Existence: what a unit claims of real objects and of others, and its calibration.

_FEWEST = 8
"""Entries below which no existence is fitted."""
_SHAPES = (0.1, 1000.0)
"""Shapes of a Beta that are tried."""


@dataclass(frozen=True)
class ExistenceFit:
    """Beta shapes (a, b) of matched entries and of others, None where the data do not tell; or one `number` for all."""

    real: tuple[Estimate, Estimate] | None = None
    ghost: tuple[Estimate, Estimate] | None = None
    number: Estimate | None = None
    untold: str | None = None

    def keys(self) -> dict[str, Any]:
        """The key `existence` of a couple; empty: nothing is fitted. Ghosts without a fit claim what objects do."""
        if self.number is not None:
            return {"existence": CommentedValue(round(self.number.value, 4), "the same of every entry")}
        if self.real is None:
            return {}
        shapes_of = {
            "real": ("", self.real),
            "ghost": ("", self.ghost) if self.ghost else ("chosen, as of objects: ", self.real),
        }
        shapes = {
            name: CommentedValue([round_digits(one.value) for one in two], more + "; ".join(one.words() for one in two))
            for name, (more, two) in shapes_of.items()
        }
        return {"existence": {"kind": "scores", **shapes}}


def fit_existence(real: Float, series_ix: Int, unmatched: Float | None) -> ExistenceFit:
    """Fit existence claims of matched entries (n,), by series, and of `unmatched` ones; None: the truth is partial."""
    finite = np.isfinite(real)
    claimed, series_ix = real[finite], series_ix[finite]
    if len(claimed) < _FEWEST:
        return ExistenceFit(untold="the lists have no existence" if not len(claimed) else f"{len(claimed)} entries")
    unmatched_claims = None if unmatched is None else unmatched[np.isfinite(unmatched)]
    if claimed.std() < 1e-6:
        mean = float(claimed.mean())
        return ExistenceFit(number=Estimate(mean, mean, mean, len(claimed), len(claimed)))
    ghost = None
    if unmatched_claims is not None and len(unmatched_claims) >= _FEWEST and unmatched_claims.std() > 1e-6:
        ghost = beta_shapes(unmatched_claims, np.arange(len(unmatched_claims)))
    real_shapes = beta_shapes(claimed, series_ix)
    if ghost is not None:
        real_shapes = _correct_for_ghosts(claimed, real_shapes, (ghost[0].value, ghost[1].value))
    return ExistenceFit(real_shapes, ghost)


def beta_shapes(values: Float, cluster: Int) -> tuple[Estimate, Estimate]:
    """(a, b) of a Beta by moments; intervals of their logarithms by a jackknife over clusters.

    With fewer than eight clusters it is over tenths of the rows, with more than 400 over 200 parts of them.
    """
    names, group = np.unique(cluster, return_inverse=True)
    if len(names) < 8 or len(names) > 400:
        group = np.arange(len(values)) * (10 if len(names) < 8 else 200) // len(values)
    groups = int(group.max()) + 1
    sums = np.array([np.bincount(group, weights, groups) for weights in (np.ones(len(values)), values, values**2)])
    shapes = _solve_shapes(sums.sum(axis=1))
    each = np.log([_solve_shapes(sums.sum(axis=1) - sums[:, g]) for g in range(groups)])
    error = np.sqrt((groups - 1) / groups * ((each - each.mean(axis=0)) ** 2).sum(axis=0))
    factor = np.exp(2.0 * error)
    one, two = (
        Estimate(
            a, float(a / f), float(a * f), len(values), groups,
            why=f"the claims hardly vary: {a:g} is the end of what is tried" if a in _SHAPES else None,
        )
        for a, f in zip(shapes, factor, strict=True)
    )  # fmt: skip
    return one, two


def _correct_for_ghosts(
    claimed: Float, shapes: tuple[Estimate, Estimate], ghost: tuple[float, float]
) -> tuple[Estimate, Estimate]:
    """The shapes (a, b) of Beta where some matched entries are ghosts near an object, from the likeliest mixture."""
    values = np.clip(claimed, 1e-6, 1 - 1e-6)
    ghost_density = beta.pdf(values, *ghost)

    def of(x: Float) -> float:
        share = float(expit(x[2]))
        return float(np.log((1 - share) * beta.pdf(values, *np.exp(x[:2])) + share * ghost_density + 1e-300).sum())

    start = [float(np.log(one.value)) for one in shapes]
    limits = (float(np.log(_SHAPES[0])), float(np.log(_SHAPES[1])))
    best, _ = maximise_likelihood(of, [(*start, -6.0), (*start, -3.0)], (limits, limits, (-9.0, 0.0)))
    factors = np.exp(best[:2]) / [one.value for one in shapes]
    one, two = (
        replace(old, value=old.value * by, low=old.low * by, high=old.high * by)
        for old, by in zip(shapes, factors.tolist(), strict=True)
    )
    return one, two


def _solve_shapes(sums: Float) -> tuple[float, float]:
    """(a, b) of a Beta by the moments Σ 1, Σ x, Σ x²."""
    n, first, second = sums
    mean = float(np.clip(first / n, 1e-4, 1 - 1e-4))
    variance = max(float(second / n - (first / n) ** 2), 1e-9)
    strength = max(mean * (1 - mean) / variance - 1, 1e-3)
    one, two = np.clip([mean * strength, (1 - mean) * strength], *_SHAPES).tolist()
    return one, two


# List times: their period, its jitter, and outages.

LONG = 2.5
"""Median gaps beyond which a gap is an outage: one list that is missing may be late."""
_FEWEST_GAPS = 2
"""Outages below which none are fitted."""


@dataclass(frozen=True)
class ListTimesFit:
    """`period_s` and `jitter_s` (standard deviation of ordinary gaps); of outages both numbers, or why none are fitted.

    As in a replay an outage is a state of the unit, a two-state Markov chain over periods. The number of outages of one
    list, which a late list looks like, is extrapolated from longer ones.
    """

    period_s: Estimate
    jitter_s: Estimate
    down_share: Estimate
    lasts_s: Estimate

    def keys(self) -> dict[str, Any]:
        """A unit's `outages`; empty where there are none."""
        if self.down_share.why is not None:
            return {}
        return {"down_share": self.down_share.written(), "lasts_s": self.lasts_s.written()}


def fit_list_times(lists: FitLists) -> ListTimesFit:
    """Fit the gaps between lists of the same log."""
    same = np.diff(lists.log) == 0
    gaps_s = np.diff(lists.captured_s)[same]
    period_s = float(np.median(gaps_s)) if len(gaps_s) else 0.0
    if not period_s:
        none = Estimate(float("nan"), why=f"{len(lists.log)} lists{', most of one time' if len(gaps_s) else ''}")
        return ListTimesFit(none, none, none, none)
    ordinary, long = gaps_s[gaps_s <= LONG * period_s], gaps_s[gaps_s > LONG * period_s]
    n, spread_s = len(gaps_s), float(ordinary.std())
    aside = 1.2533 * 1.96 * spread_s / np.sqrt(len(ordinary))  # of a median
    period = Estimate(period_s, period_s - aside, period_s + aside, n, len(ordinary))
    far = 1.96 / np.sqrt(2 * len(ordinary))
    jitter = Estimate(spread_s, spread_s * (1 - far), spread_s * (1 + far), n, len(ordinary))
    if len(long) < _FEWEST_GAPS:
        low, high = garwood_interval(len(long))
        why = f"{len(long)} of {n} gaps are longer than {LONG:g} medians"
        untold = Estimate(0.0, 0.0, high * 3 * period_s / float(gaps_s.sum()), n, len(long), why)
        return ListTimesFit(period, jitter, untold, Estimate(float("nan"), n=n, why=why))
    missing = np.maximum(np.rint(long / period_s) - 1, 2)
    K = len(long)
    p_stays = float((missing - 2).sum() / ((missing - 2).sum() + K))  # longer than two lists: geometric
    p_stays = min(max(p_stays, 0.5 / (K + 1)), 1 - 1e-6)
    begins = K / p_stays / len(gaps_s)  # those of one list, too
    down = begins / (begins + 1 - p_stays)
    phi = max(p_stays - begins, 1e-3)
    lasts_s = -period_s / np.log(phi) / (1 - down)
    low, high = garwood_interval(K)
    lasts = Estimate(lasts_s, lasts_s * K / high, lasts_s * K / low, n, K)
    odds = down / (1 - down)
    narrow, wide = f.ppf([0.025, 0.975], 2 * K, 2 * K)
    return ListTimesFit(
        period, jitter,
        Estimate(down, odds * narrow / (1 + odds * narrow), odds * wide / (1 + odds * wide), n, K), lasts,
    )  # fmt: skip


# All of it.


@dataclass(frozen=True)
class RestFit:
    """The fits of all other errors; `untold`: by key why one is not fitted. `ids_last_s`: None without track ids."""

    placed: PoseFit
    classes: ClassesFit
    existence: ExistenceFit
    ghosts: GhostsFit
    ids_last_s: Estimate | None
    list_times: ListTimesFit
    untold: dict[str, str]

    def pem_keys(self) -> dict[str, Any]:
        """The keys of a PEM beside its couples: `classes`, `ghosts`, `tracks`, and `memory` of the class."""
        ids, lasting = self.ids_last_s, [part.keys() for part in self.classes.memory]
        out: dict[str, Any] = {
            "classes": self.classes.keys(),
            "ghosts": [sort.keys() for sort in self.ghosts.sorts],
            "tracks": {} if ids is None or ids.why is not None else {"lasts_s": ids.written()},
            "memory": {"class": lasting} if lasting else {},
        }
        return {key: value for key, value in out.items() if value}

    def unit_keys(self) -> dict[str, Any]:
        """The keys of the unit: `placed`, `outages`."""
        out = {"placed": self.placed.keys(), "outages": self.list_times.keys()}
        return {key: value for key, value in out.items() if value}


def fit_rest(rows: FitRows, lists: FitLists, other: OtherEntries, *, truth: Literal["complete", "partial"]) -> RestFit:
    """Fit all other errors; ghosts and their existence only where the truth is `complete`."""
    listed = rows.take(rows.listed & np.isfinite(rows.along_m))
    series, complete = build_series(listed), truth == "complete"
    placed = fit_pose(listed, lists)
    classes = fit_classes(listed, series)
    existence = fit_existence(listed.existence, listed.pass_ix, other.existence if complete else None)
    partial = GhostsFit(untold="the truth is partial: entries about no true object may be other traffic")
    ghosts = fit_ghosts(rows, lists, other) if complete else partial
    ids = _fit_id_duration(listed)
    times = fit_list_times(lists)
    reasons = {
        "placed": placed.untold, "classes": classes.untold, "existence": existence.untold, "ghosts": ghosts.untold,
        "tracks": "the lists have no track ids" if ids is None else ids.why, "outages": times.down_share.why,
    }  # fmt: skip
    untold = {name: why for name, why in reasons.items() if why is not None}
    return RestFit(placed, classes, existence, ghosts, ids, times, untold)


def _fit_id_duration(rows: FitRows) -> Estimate | None:
    """The mean time between switches of the track id within passes; None: no ids."""
    with_id = rows.take(rows.track_id >= 0)
    if len(with_id.log) < 2:
        return None
    same_pass = np.diff(with_id.pass_ix) == 0
    gap_s, switched = np.diff(with_id.captured_s)[same_pass], np.diff(with_id.track_id)[same_pass] != 0
    return estimate_duration(gap_s[~switched], gap_s[switched], "switch of an id")

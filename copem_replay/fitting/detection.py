"""The detection model of a recorded unit: the tables that are replayed, and which share of detections lasts how long.

What lasts is fitted by the likelihood of the filter that gives exact times (`metrics/exact_survival.py`). Intervals are
those of the profile likelihood: all values at which it is within half of χ²'s 95 % quantile of its best.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import Any

import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.optimize import minimize
from scipy.special import expit, logit

from copem_replay.core.errors import count_noun
from copem_replay.core.tracks import CLASSES, Bool, Float, Int
from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.fitting.estimate import FEWEST_PASSES, Estimate, Rung, choose_by_bic, choose_rung, held_out_possible
from copem_replay.fitting.rows import (
    FitLists,
    FitRows,
    NodeWeights,
    PooledRows,
    choose_nodes,
    count_rows_per_effective,
    pool_rows,
    weigh_nodes,
)
from copem_replay.fitting.tables import estimate_nodes, fit_table
from copem_replay.metrics.exact_survival import Sequences
from copem_replay.perception.pem.condition import Condition
from copem_replay.perception.pem.detection import TableDetection

# Memory of detection.

LEVELS = 50
"""Probabilities are distinguished by steps of π/2 over this in the arcsine of their root: less than 3e-4 nats per list
are lost (docs/develop/decisions/0030-fitted-detection.md)."""
_SHARES = (0.01, 0.999)
"""Bounds of the share that lasts: log-odds have none at 0 and 1."""
_DROP = 1.9207294
"""Half of the 95 % quantile of χ² with one degree of freedom."""
_GRID = 9
_FINE = 601
"""Points along each axis of the grid of likelihoods, and of the spline through it."""


@dataclass(frozen=True)
class DetectionMemoryFit:
    """The `share` of lists that use a held number, and its `correlation_s`; ∞: the number is always the same.

    `gain`: log-likelihood per list above that without memory, on the passes it is fitted to.
    """

    share: Estimate
    correlation_s: Estimate
    gain: float


def pass_starts(pass_ix: Int) -> Int:
    """(N + 1,) where each pass begins; its rows lie together."""
    return np.flatnonzero(np.r_[True, pass_ix[1:] != pass_ix[:-1], True])


def build_sequences(listed: Bool, probability: Float, captured_s: Float, pass_ix: Int) -> Sequences:
    """Hits and misses of the passes, with a few dozen different probabilities: means of those close together."""
    level = np.rint(np.arcsin(np.sqrt(probability)) * (2 * LEVELS / np.pi)).astype(np.int64)
    count = np.maximum(np.bincount(level), 1)
    return Sequences.of(
        pass_starts(pass_ix), (np.bincount(level, probability) / count)[level], listed, captured_s
    )  # fmt: skip


def explain_no_memory(listed: Bool, pass_ix: Int) -> str | None:
    """Why the data do not tell how long detection lasts; None where they do."""
    passes = len(np.unique(pass_ix))
    for what, where in (("miss", ~listed), ("hit", listed)):
        if not where.any():
            return f"no {what} in {count_noun(len(listed), 'list')}"
    if passes < FEWEST_PASSES or len(listed) == passes:
        return f"{count_noun(passes, 'pass', 'passes')}: no correlation time of detection can be told"
    return None


def fit_detection_memory(seen: Sequences, *, intervals: bool = True) -> DetectionMemoryFit:
    """Share and correlation time of the greatest likelihood, given the probabilities of detection.

    Correlation times from a third of the period up to twenty of the longest pass are tried; the last is `always`.
    """
    length_s = np.add.reduceat(seen.gap_s, seen.start[:-1]).max()
    period_s = float(np.median(seen.gap_s[seen.gap_s > 0]))
    bounds = np.array([logit(_SHARES), np.log([period_s / 3, 20 * length_s])])

    def likelihood(at: Float) -> float:
        share, tau = np.clip(at, bounds[:, 0], bounds[:, 1])
        return float(seen.log_probability(expit(share), np.exp(tau)).sum())

    starts = [
        np.array([s, t])
        for s in logit([0.3, 0.7, 0.95])
        for t in bounds[1, 0] + np.array([0.2, 0.4, 0.6, 0.8]) * np.ptp(bounds[1])
    ]
    first = max(starts, key=likelihood)
    options = {"xatol": 0.01, "fatol": 0.005, "initial_simplex": first + np.array([[0, 0], [0.5, 0], [0, 0.5]])}
    optimum = minimize(lambda at: -likelihood(at), first, method="Nelder-Mead", options=options)
    best = np.clip(optimum.x, bounds[:, 0], bounds[:, 1])
    limits = _profile_limits(likelihood, best, bounds) if intervals else np.full((2, 2), np.nan)
    # Where the likelihood does not fall enough within bounds, the limit is the end of the range of values.
    open_ends = np.abs(limits - bounds) < 1e-6
    shares = np.where(open_ends[0], [0.0, 1.0], expit(limits[0]))
    taus = np.where(open_ends[1], [0.0, np.inf], np.exp(limits[1]))
    share, tau = float(expit(best[0])), float(np.exp(best[1]))
    n = len(seen.listed)
    effective = n / design_effect(share, tau, seen)
    always = best[1] > bounds[1, 1] - 0.01
    return DetectionMemoryFit(
        Estimate(share, float(shares[0]), float(shares[1]), n, effective),
        Estimate(np.inf if always else tau, float(taus[0]), float(taus[1]), n, effective),
        float(likelihood(best) - seen.log_probability(0.0, 1.0).sum()) / n,
    )


def design_effect(share: float, tau_s: float, seen: Sequences) -> float:
    """The factor by which the mean of the lists of a pass varies more than that of independent lists.

    1 + 2 Σ (1 − k/m) s²φᵏ over passes of m lists, for any gaps between them.
    """
    total = 0.0
    for a, b in zip(seen.start[:-1], seen.start[1:], strict=True):
        since_s = np.cumsum(seen.gap_s[a:b])
        ahead = 0.0
        for same in np.exp(-np.diff(since_s) / tau_s).tolist():
            ahead = same * (ahead + 1)
            total += ahead
    return 1 + 2 * share**2 * total / len(seen.listed)


def _profile_limits(likelihood: Callable[[Float], float], best: Float, bounds: Float) -> Float:
    """(2, 2) low and high limit of each number, by a spline through the likelihood on a grid about its best."""
    top = likelihood(best)
    bend = np.array([2 * top - likelihood(best + step) - likelihood(best - step) for step in 0.2 * np.eye(2)]) / 0.04
    half = np.clip(3 / np.sqrt(np.maximum(bend, 1e-9)), 0.1, 2)[:, None] * [-1.0, 1.0]  # how far the grid reaches
    for _ in range(6):
        ends = np.clip(best[:, None] + half, bounds[:, :1], bounds[:, 1:])
        axes = [np.linspace(low, high, _GRID) for low, high in ends.tolist()]
        grid = np.array([[likelihood(np.array([s, t])) for t in axes[1]] for s in axes[0]])
        fine = [np.linspace(low, high, _FINE) for low, high in ends.tolist()]
        spline = RectBivariateSpline(*axes, grid)(*fine)
        profiles = [spline.max(axis=1), spline.max(axis=0)]
        inside = [profile >= max(grid.max(), top) - _DROP for profile in profiles]
        wide = np.array([[keep[0], keep[-1]] for keep in inside]) & (np.abs(ends - bounds) > 1e-9)
        if not wide.any():
            break
        half = np.where(wide, 2 * half, half)
    return np.array([[axis[keep][0], axis[keep][-1]] for axis, keep in zip(fine, inside, strict=True)])


# Tables of detection.

LEAST_ROWS = 20
"""Effective rows that a node of an axis has at least: a share of ½ is then known to ± 0.22."""
_MOST_NODES = {"range": 6, "visible_share": 4}
_SECTORS = 4
"""Nodes of an axis and sectors of azimuth at most. More: finer tables where rows allow it, and longer fits."""
_WORDS = {"range": "range", "visible_share": "visible share", "azimuth": "azimuth", "class": "class"}
_NOTHING = "lists held out are no better predicted with a part that lasts"
_DECIMALS = {"range": 1, "visible_share": 2}
_KEEP_OFF = 1e-4
"""Distance from 0 and 1 that written probabilities keep."""


@dataclass(frozen=True)
class DetectionCouple:
    """The probability at each of `range_m` (I,) × `visible_share` (J,), and where it applies (None: all the rest)."""

    classes: tuple[str, ...] | None
    range_m: tuple[float, ...]
    visible_share: tuple[float, ...]
    probability: tuple[tuple[Estimate, ...], ...]
    azimuth_deg: tuple[float, float] | None = None

    @property
    def when(self) -> dict[str, Any]:
        """The condition as the experiment file has it."""
        conditions = {"classes": self.classes, "azimuth_deg": self.azimuth_deg}
        return {name: list(value) for name, value in conditions.items() if value is not None}

    def place_words(self, i: int, j: int) -> str:
        """Where the probability at range i and visible share j holds, in words."""
        parts = [f"at {self.range_m[i]:g} m"] if len(self.range_m) > 1 else ["within reach"]
        parts += [f"visible share {self.visible_share[j]:g}"] if len(self.visible_share) > 1 else []
        parts += [", ".join(self.classes)] if self.classes else []
        parts += ["azimuth {:g} to {:g}°".format(*self.azimuth_deg)] if self.azimuth_deg else []
        return ", ".join(parts)

    def detection(self) -> dict[str, Any]:
        """The detection model as the experiment file has it."""
        values = [[_round_probability(one.value) for one in row] for row in self.probability]
        if len(self.range_m) == len(self.visible_share) == 1:
            return {"kind": "constant", "probability": values[0][0]}
        axes = {"range_m": list(self.range_m), "visible_share": list(self.visible_share)}
        return {"kind": "table", **{k: v for k, v in axes.items() if len(v) > 1}, "probability": values}


def _round_probability(probability: float) -> float:
    return round(min(max(probability, _KEEP_OFF), 1 - _KEEP_OFF), 4)


@dataclass(frozen=True)
class DetectionFit:
    """A fitted detection model.

    `couples`: the first that applies is used. `memory`: `share` and `correlation_s` of what lasts; None: nothing lasts,
    for the reason `memory_why`. `ladder`: the models that were compared. `covariance (K, K)` of all probabilities,
    couple by couple, range by range. `rows_per_effective`: how many rows are worth one that is independent. `notes`: on
    the rows, a line each.
    """

    couples: tuple[DetectionCouple, ...]
    memory: Mapping[str, Estimate] | None
    memory_why: str | None
    ladder: tuple[Rung, ...]
    covariance: Float
    rows_per_effective: float
    notes: tuple[str, ...]

    def probability(self, view: ViewGeometry) -> Float:
        """(P,) the probability that each row is listed, regardless of memory."""
        out = np.zeros(len(view.range_m))
        couple_ix = _first_that_holds([couple.when for couple in self.couples], view)
        for k, couple in enumerate(self.couples):
            rows = np.flatnonzero(couple_ix == k)
            table = [[one.value for one in row] for row in couple.probability]
            model = TableDetection.model_validate(
                {"range_m": couple.range_m, "visible_share": couple.visible_share, "probability": table}
            )
            out[rows] = model.probability(view.take(rows))
        return out

    def yaml_detection(self) -> dict[str, Any]:
        """Plain data of a PEM: couples without errors, and the memory of detection."""
        couples = []
        for couple in self.couples:
            when = {"when": couple.when} if couple.when else {}
            couples.append({**when, "detection": couple.detection()})
        if self.memory is None:
            return {"couples": couples}
        tau_s = self.memory["correlation_s"].value
        lasts = "always" if np.isinf(tau_s) else float(f"{tau_s:.3g}")
        part = {"share": round(self.memory["share"].value, 3), "correlation_s": lasts}
        return {"couples": couples, "memory": {"detection": [part]}}


@dataclass(frozen=True)
class _Rung:
    """One model of the ladder: its axes, its conditions, and the rows (R,) in it."""

    name: str
    axes: tuple[Float, Float]
    when: list[dict[str, Any]]
    rows: NodeWeights
    entries: PooledRows


def fit_detection(
    rows: FitRows,
    lists: FitLists,
    *,
    monotone: bool = True,
    by: tuple[str, ...] = ("range", "visible_share"),
    simplest: bool = False,
    intervals: bool = True,
) -> DetectionFit:
    """Fit the detection model to rows of objects within reach.

    `by`: what the probability may depend on, of `range`, `visible_share`, `azimuth`, `class`. How many of them, from
    the first on, is chosen on passes held out, and then whether detection lasts. `monotone`: farther and more hidden is
    never better. `simplest`: always one constant. Without `intervals` limits are NaN.
    """
    _, pass_ix = np.unique(rows.pass_ix, return_inverse=True)
    worth = _rows_per_effective(rows, pass_ix, by, monotone)
    ladder = _build_ladder(rows, pass_ix, by, worth)
    rung, table, lasts, why = _choose_table(rows, pass_ix, ladder, worth, monotone, simplest)
    all_passes = np.ones(int(pass_ix.max()) + 1)
    fit = fit_table(rung.entries, all_passes, worth, monotone=monotone)
    memory = None
    seen = build_sequences(rows.listed, rung.rows.chances(fit.theta), rows.captured_s, pass_ix)
    if why is None:
        memory_fit = fit_detection_memory(seen, intervals=intervals)
        worth = design_effect(memory_fit.share.value, memory_fit.correlation_s.value, seen)
        fit = replace(fit, worth=worth)
        if lasts:
            memory = {"share": memory_fit.share, "correlation_s": memory_fit.correlation_s}
    values, covariance = estimate_nodes(rung.entries, rung.rows, fit, monotone=monotone, resampled=intervals)
    grid = np.array(values, dtype=object).reshape(rung.rows.shape)
    axes = tuple(tuple(axis.tolist()) for axis in rung.axes)
    couples = tuple(
        DetectionCouple(when.get("classes"), axes[0], axes[1], tuple(map(tuple, one)), when.get("azimuth_deg"))
        for when, one in zip(rung.when, grid.tolist(), strict=True)
    )
    return DetectionFit(
        couples, memory, why if why else (None if lasts else _NOTHING), table, covariance, worth, _note_rows(rows)
    )


def _choose_table(
    rows: FitRows, pass_ix: Int, ladder: list[_Rung], worth: float, monotone: bool, simplest: bool
) -> tuple[_Rung, tuple[Rung, ...], bool, str | None]:
    """The rung, the table of all, whether detection lasts, and why the data do not tell that (None: they do)."""
    names, why = [rung.name for rung in ladder], explain_no_memory(rows.listed, pass_ix)
    starts = pass_starts(pass_ix)
    if not held_out_possible(pass_ix, rows.fold):
        fits = [fit_table(rung.entries, np.ones(len(starts) - 1), worth, monotone=monotone) for rung in ladder]
        log_likelihoods = [_log_likelihood(rung, fit.theta).sum() for rung, fit in zip(ladder, fits, strict=True)]
        size, n = np.array([len(fit.theta) for fit in fits]), len(pass_ix)
        index, table = choose_by_bic(names, np.array(log_likelihoods), size, n, n / worth, simplest=simplest)
        return ladder[index], table, False, why or "all passes in one fold: none is held out to tell by"
    fold = rows.fold[starts[:-1]]
    scores = np.zeros((len(ladder) + 1, len(fold)))
    theta = {}
    for f, (k, rung) in product(np.unique(fold).tolist(), enumerate(ladder)):
        theta[f, k] = fit_table(rung.entries, (fold != f).astype(float), worth, monotone=monotone).theta
        scores[k, fold == f] = _log_likelihood(rung, theta[f, k])[fold == f]
    weights = np.diff(starts)
    index, table = choose_rung(names, scores[:-1], weights, simplest=simplest)
    if why is not None:
        return ladder[index], table, False, why
    for f in np.unique(fold).tolist():
        chances = ladder[index].rows.chances(theta[f, index])
        held_out = rows.fold == f
        inside, outside = (
            build_sequences(rows.listed[some], chances[some], rows.captured_s[some], pass_ix[some])
            for some in (~held_out, held_out)
        )
        memory_fit = fit_detection_memory(inside, intervals=False)
        given_past = outside.log_probability(memory_fit.share.value, memory_fit.correlation_s.value)
        scores[-1, fold == f] = np.add.reduceat(given_past, outside.start[:-1])
    pair = [index, len(ladder)]
    names.append(f"{names[index]} + memory")
    with_memory, _ = choose_rung([names[k] for k in pair], scores[pair], weights, simplest=simplest)
    _, table = choose_rung(names, scores, weights)
    return (
        ladder[index],
        tuple(replace(one, chosen=k == pair[with_memory]) for k, one in enumerate(table)),
        with_memory == 1,
        None,
    )


def _log_likelihood(rung: _Rung, theta: Float) -> Float:
    """(passes,) log-probability of the hits and misses of each pass."""
    p = rung.entries.placed.chances(theta)
    result: Float = rung.entries.count @ np.log(np.where(rung.entries.hit, p, 1 - p))
    return result


def _build_ladder(rows: FitRows, pass_ix: Int, by: tuple[str, ...], worth: float) -> list[_Rung]:
    """Models from one constant to all of `by`, without those that rows are too few to tell from the one before."""
    least, alone = LEAST_ROWS * worth, np.zeros(1)
    values = {"range": rows.view.range_m, "visible_share": rows.view.visible_share}
    both = values["range"], values["visible_share"]
    axes, when = (alone, alone), list[dict[str, Any]]([{}])
    ladder, used = [_build_rung("constant", axes, when, both, rows, pass_ix)], list[str]()
    for name in by:
        if name in values:
            k = list(values).index(name)
            most = int(min(len(pass_ix) / least, _MOST_NODES[name]))
            nodes = choose_nodes(both[k], most, least, _DECIMALS[name]) if most > 1 else alone
            nodes = nodes if len(nodes) > 1 else alone
            axes = (nodes, axes[1]) if k == 0 else (axes[0], nodes)
        else:
            when = _split_conditions(rows, when, name, least)
        rung = _build_rung(" × ".join([*used, _WORDS[name]]), axes, when, both, rows, pass_ix)
        if rung.rows.shape != ladder[-1].rows.shape:
            used.append(_WORDS[name])
            ladder.append(rung)
    return ladder


def _build_rung(
    name: str,
    axes: tuple[Float, Float],
    when: list[dict[str, Any]],
    values: tuple[Float, Float],
    rows: FitRows,
    pass_ix: Int,
) -> _Rung:
    where = weigh_nodes(axes, values, _first_that_holds(when, rows.view))
    return _Rung(name, axes, when, where, pool_rows(where, rows.listed, pass_ix))


def _split_conditions(rows: FitRows, when: list[dict[str, Any]], name: str, least: float) -> list[dict[str, Any]]:
    """Conditions split by class or azimuth where a part has `least` rows; all other rows are one more condition."""
    if name == "class":
        finer: list[dict[str, Any]] = [{"classes": (CLASSES[k],)} for k in np.unique(rows.view.class_ix)]
    else:
        degrees = np.rad2deg(rows.view.azimuth_rad)
        inner = np.round(np.quantile(degrees, np.arange(1, _SECTORS) / _SECTORS))
        edges = np.unique([np.floor(degrees.min()), *inner, np.ceil(degrees.max())]).tolist()
        finer = [{"azimuth_deg": pair} for pair in pairwise(edges)]
    parts = [one | other for one, other in product(when, finer)]
    size = np.bincount(_first_that_holds([*parts, {}], rows.view), minlength=len(parts) + 1)
    kept = [part for part, rows_there in zip(parts, size, strict=False) if rows_there >= least]
    if len(kept) + (size.sum() > size[: len(parts)][size[: len(parts)] >= least].sum()) < 2:
        return when
    rest_exists = (_first_that_holds([*kept, {}], rows.view) == len(kept)).any()
    return [*kept, {}] if rest_exists else kept


def _first_that_holds(when: list[dict[str, Any]], view: ViewGeometry) -> Int:
    """(P,) which of the conditions applies to each row, −1: none."""
    out = np.full(len(view.range_m), -1)
    for k, one in enumerate(when):
        out[(out < 0) & Condition(**one).holds(view)] = k
    return out


def _rows_per_effective(rows: FitRows, pass_ix: Int, by: tuple[str, ...], monotone: bool) -> float:
    """Rows per effective row, by the residuals of the richest model fitted as if rows were independent; else 1."""
    if rows.listed.all() or not rows.listed.any():
        return 1.0
    richest = _build_ladder(rows, pass_ix, by, 1.0)[-1]
    fit = fit_table(richest.entries, np.ones(int(pass_ix.max()) + 1), 1.0, monotone=monotone)
    return count_rows_per_effective(rows.listed - richest.rows.chances(fit.theta), pass_ix)


def _note_rows(rows: FitRows) -> tuple[str, ...]:
    if rows.listed.all() or not rows.listed.any():
        none = f"no {'miss' if rows.listed.all() else 'hit'} in {count_noun(len(rows.listed), 'list')}"
        return (f"{none}: intervals of detection take lists as independent, which cannot be told",)
    return ()

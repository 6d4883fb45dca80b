"""The detection model of a recorded unit: the tables that will be replayed, and what of its detections lasts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import Any

import numpy as np

from copem_replay.core.text import counted
from copem_replay.core.tracks import CLASSES, Float, Int
from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.perception.pem.condition import Condition
from copem_replay.perception.pem.detection import Table
from copem_replay.pipeline.fit.choice import Rung, choose, choose_by_bic, held_out_possible
from copem_replay.pipeline.fit.effective import rows_per_effective
from copem_replay.pipeline.fit.estimate import Estimate
from copem_replay.pipeline.fit.memory import design_effect, fit_memory, pass_starts, sequences_of, why_no_memory
from copem_replay.pipeline.fit.nodes import Entries, Placed, nodes_of, placed, put_together
from copem_replay.pipeline.fit.rows import FitLists, FitRows
from copem_replay.pipeline.fit.table_fit import estimates, fit_table

LEAST_ROWS = 20
"""Effective rows that a node of an axis has at least."""
_MOST_NODES = {"range": 6, "visible_share": 4}
_SECTORS = 4
_WORDS = {"range": "range", "visible_share": "visible share", "azimuth": "azimuth", "class": "class"}
_NOTHING = "lists held out are no better predicted with a part that lasts"
_DECIMALS = {"range": 1, "visible_share": 2}
_KEEP_OFF = 1e-4
"""No probability is written that is nearer to 0 or 1."""


@dataclass(frozen=True)
class DetectionCouple:
    """The probability at each of `range_m` (I,) × `visible_share` (J,), and where it applies (None: anywhere else)."""

    classes: tuple[str, ...] | None
    range_m: tuple[float, ...]
    visible_share: tuple[float, ...]
    probability: tuple[tuple[Estimate, ...], ...]
    azimuth_deg: tuple[float, float] | None = None

    @property
    def when(self) -> dict[str, Any]:
        """The condition as the experiment file has it."""
        found = {"classes": self.classes, "azimuth_deg": self.azimuth_deg}
        return {name: list(value) for name, value in found.items() if value is not None}

    def detection(self) -> dict[str, Any]:
        """The detection model as the experiment file has it."""
        values = [[_written(one.value) for one in row] for row in self.probability]
        if len(self.range_m) == len(self.visible_share) == 1:
            return {"kind": "constant", "probability": values[0][0]}
        axes = {"range_m": list(self.range_m), "visible_share": list(self.visible_share)}
        return {"kind": "table", **{k: v for k, v in axes.items() if len(v) > 1}, "probability": values}


def _written(probability: float) -> float:
    return round(min(max(probability, _KEEP_OFF), 1 - _KEEP_OFF), 4)


@dataclass(frozen=True)
class DetectionFit:
    """A fitted detection model.

    `couples`: the first that applies is used. `memory`: `share` and `correlation_s` of what lasts, None where nothing
    does, `memory_why` then says why. `ladder`: the models that were compared. `covariance (K, K)` of all probabilities,
    couple by couple, range by range. `rows_per_effective`: how many rows are worth one that is independent. `notes`:
    what else is to be said.
    """

    couples: tuple[DetectionCouple, ...]
    memory: Mapping[str, Estimate] | None
    memory_why: str | None
    ladder: tuple[Rung, ...]
    covariance: Float
    rows_per_effective: float
    notes: tuple[str, ...]

    def probability(self, view: ViewGeometry) -> Float:
        """(P,) with which probability each row is listed, memory or not."""
        out = np.zeros(len(view.range_m))
        couple_ix = _first_that_holds([couple.when for couple in self.couples], view)
        for k, couple in enumerate(self.couples):
            rows = np.flatnonzero(couple_ix == k)
            table = [[one.value for one in row] for row in couple.probability]
            model = Table.model_validate(
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
    rows: Placed
    entries: Entries


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

    `by`: what the probability may depend on, `range`, `visible_share`, `azimuth`, `class`, from the first to the last;
    how many of them it does depend on is chosen on passes held out, and then whether detection lasts. `monotone`:
    farther and more hidden is never better. `simplest`: one constant in any case. Without `intervals` limits are NaN.
    """
    _, pass_ix = np.unique(rows.pass_ix, return_inverse=True)
    worth = _rows_per_effective(rows, pass_ix, by, monotone)
    ladder = _ladder(rows, pass_ix, by, worth)
    chosen, table, lasts, why = _choice(rows, pass_ix, ladder, worth, monotone, simplest)
    every = np.ones(int(pass_ix.max()) + 1)
    fit = fit_table(chosen.entries, every, worth, monotone=monotone)
    memory = None
    seen = sequences_of(rows.listed, chosen.rows.chances(fit.theta), rows.captured_s, pass_ix)
    if why is None:
        found = fit_memory(seen, intervals=intervals)
        worth = design_effect(found.share.value, found.correlation_s.value, seen)
        fit = replace(fit, worth=worth)
        if lasts:
            memory = {"share": found.share, "correlation_s": found.correlation_s}
    values, covariance = estimates(chosen.entries, chosen.rows, fit, monotone=monotone, resampled=intervals)
    grid = np.array(values, dtype=object).reshape(chosen.rows.shape)
    axes = tuple(tuple(axis.tolist()) for axis in chosen.axes)
    couples = tuple(
        DetectionCouple(when.get("classes"), axes[0], axes[1], tuple(map(tuple, one)), when.get("azimuth_deg"))
        for when, one in zip(chosen.when, grid.tolist(), strict=True)
    )
    return DetectionFit(
        couples, memory, why if why else (None if lasts else _NOTHING), table, covariance, worth, _notes(rows)
    )


def _choice(
    rows: FitRows, pass_ix: Int, ladder: list[_Rung], worth: float, monotone: bool, simplest: bool
) -> tuple[_Rung, tuple[Rung, ...], bool, str | None]:
    """The rung, the table of all, whether detection lasts, and why that cannot be told."""
    names, why = [rung.name for rung in ladder], why_no_memory(rows.listed, pass_ix)
    starts = pass_starts(pass_ix)
    if not held_out_possible(pass_ix, rows.fold):
        fits = [fit_table(rung.entries, np.ones(len(starts) - 1), worth, monotone=monotone) for rung in ladder]
        likely = [_log_likelihood(rung, fit.theta).sum() for rung, fit in zip(ladder, fits, strict=True)]
        size, n = np.array([len(fit.theta) for fit in fits]), len(pass_ix)
        index, table = choose_by_bic(names, np.array(likely), size, n, n / worth, simplest=simplest)
        return ladder[index], table, False, why or "all passes in one fold: none is held out to tell by"
    fold = rows.fold[starts[:-1]]
    scores = np.zeros((len(ladder) + 1, len(fold)))
    theta = {}
    for f, (k, rung) in product(np.unique(fold).tolist(), enumerate(ladder)):
        theta[f, k] = fit_table(rung.entries, (fold != f).astype(float), worth, monotone=monotone).theta
        scores[k, fold == f] = _log_likelihood(rung, theta[f, k])[fold == f]
    weights = np.diff(starts)
    index, table = choose(names, scores[:-1], weights, simplest=simplest)
    if why is not None:
        return ladder[index], table, False, why
    for f in np.unique(fold).tolist():
        chances = ladder[index].rows.chances(theta[f, index])
        out = rows.fold == f
        inside, outside = (
            sequences_of(rows.listed[some], chances[some], rows.captured_s[some], pass_ix[some]) for some in (~out, out)
        )
        found = fit_memory(inside, intervals=False)
        given_past = outside.log_probability(found.share.value, found.correlation_s.value)
        scores[-1, fold == f] = np.add.reduceat(given_past, outside.start[:-1])
    pair = [index, len(ladder)]
    names.append(f"{names[index]} + memory")
    last, _ = choose([names[k] for k in pair], scores[pair], weights, simplest=simplest)
    _, table = choose(names, scores, weights)
    return ladder[index], tuple(replace(one, chosen=k == pair[last]) for k, one in enumerate(table)), last == 1, None


def _log_likelihood(rung: _Rung, theta: Float) -> Float:
    """(passes,) ln of the probability of what each pass shows, list by list."""
    p = rung.entries.placed.chances(theta)
    result: Float = rung.entries.count @ np.log(np.where(rung.entries.hit, p, 1 - p))
    return result


def _ladder(rows: FitRows, pass_ix: Int, by: tuple[str, ...], worth: float) -> list[_Rung]:
    """Models from one constant to all of `by`; where the rows do not tell more than the one before, it is left out."""
    least, alone = LEAST_ROWS * worth, np.zeros(1)
    values = {"range": rows.view.range_m, "visible_share": rows.view.visible_share}
    both = values["range"], values["visible_share"]
    axes, when = (alone, alone), list[dict[str, Any]]([{}])
    ladder, used = [_rung("constant", axes, when, both, rows, pass_ix)], list[str]()
    for name in by:
        if name in values:
            k = list(values).index(name)
            most = int(min(len(pass_ix) / least, _MOST_NODES[name]))
            nodes = nodes_of(both[k], most, least, _DECIMALS[name]) if most > 1 else alone
            nodes = nodes if len(nodes) > 1 else alone
            axes = (nodes, axes[1]) if k == 0 else (axes[0], nodes)
        else:
            when = _split(rows, when, name, least)
        rung = _rung(" × ".join([*used, _WORDS[name]]), axes, when, both, rows, pass_ix)
        if rung.rows.shape != ladder[-1].rows.shape:
            used.append(_WORDS[name])
            ladder.append(rung)
    return ladder


def _rung(
    name: str,
    axes: tuple[Float, Float],
    when: list[dict[str, Any]],
    values: tuple[Float, Float],
    rows: FitRows,
    pass_ix: Int,
) -> _Rung:
    where = placed(axes, values, _first_that_holds(when, rows.view))
    return _Rung(name, axes, when, where, put_together(where, rows.listed, pass_ix))


def _split(rows: FitRows, when: list[dict[str, Any]], name: str, least: float) -> list[dict[str, Any]]:
    """Conditions split up by class or by azimuth, as far as each part has `least` rows; the rest is one more."""
    if name == "class":
        found: list[dict[str, Any]] = [{"classes": (CLASSES[k],)} for k in np.unique(rows.view.class_ix)]
    else:
        degrees = np.rad2deg(rows.view.azimuth_rad)
        inner = np.round(np.quantile(degrees, np.arange(1, _SECTORS) / _SECTORS))
        edges = np.unique([np.floor(degrees.min()), *inner, np.ceil(degrees.max())]).tolist()
        found = [{"azimuth_deg": pair} for pair in pairwise(edges)]
    parts = [one | other for one, other in product(when, found)]
    size = np.bincount(_first_that_holds([*parts, {}], rows.view), minlength=len(parts) + 1)
    kept = [part for part, rows_there in zip(parts, size, strict=False) if rows_there >= least]
    if len(kept) + (size.sum() > size[: len(parts)][size[: len(parts)] >= least].sum()) < 2:
        return when
    left = (_first_that_holds([*kept, {}], rows.view) == len(kept)).any()
    return [*kept, {}] if left else kept


def _first_that_holds(when: list[dict[str, Any]], view: ViewGeometry) -> Int:
    """(P,) which of the conditions applies to each row, −1: none."""
    out = np.full(len(view.range_m), -1)
    for k, one in enumerate(when):
        out[(out < 0) & Condition(**one).holds(view)] = k
    return out


def _rows_per_effective(rows: FitRows, pass_ix: Int, by: tuple[str, ...], monotone: bool) -> float:
    """As what is left by the richest model says, fitted as if all rows were independent; 1 where it cannot be told."""
    if rows.listed.all() or not rows.listed.any():
        return 1.0
    richest = _ladder(rows, pass_ix, by, 1.0)[-1]
    fit = fit_table(richest.entries, np.ones(int(pass_ix.max()) + 1), 1.0, monotone=monotone)
    return rows_per_effective(rows.listed - richest.rows.chances(fit.theta), pass_ix)


def _notes(rows: FitRows) -> tuple[str, ...]:
    if rows.listed.all() or not rows.listed.any():
        none = f"no {'miss' if rows.listed.all() else 'hit'} in {counted(len(rows.listed), 'list')}"
        return (f"{none}: intervals of detection take lists as independent, which cannot be told",)
    return ()

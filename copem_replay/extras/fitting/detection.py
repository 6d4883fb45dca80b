"""The detection model of a recorded unit: the tables that are replayed, and which share of detections lasts how long.

What lasts is fitted by the likelihood of the filter that gives exact times (`metrics/exact_survival.py`). Intervals are
those of the profile likelihood: all values at which it is within half of χ²'s 95 % quantile of its best.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise, product
from typing import Any

import numpy as np
from scipy.special import expit, logit

from copem_replay.core.errors import count_noun
from copem_replay.core.tracks import CLASSES, Bool, Float, Int
from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.core.yaml import CommentedValue
from copem_replay.extras.fitting.estimate import (
    FEWEST_PASSES,
    Estimate,
    Rung,
    compare_models,
    maximise_likelihood,
    profile_limits,
)
from copem_replay.extras.fitting.rows import (
    FitRows,
    NodeWeights,
    PooledRows,
    choose_nodes,
    count_rows_per_effective,
    pool_rows,
    weigh_nodes,
)
from copem_replay.extras.fitting.tables import estimate_nodes, fit_table
from copem_replay.metrics.exact_survival import Sequences
from copem_replay.perception.pem.condition import Condition
from copem_replay.perception.pem.detection import TableDetection

# Memory of detection.

LEVELS = 50
"""Probabilities are distinguished by steps of π/2 over this in the arcsine of their root: less than 3e-4 nats per list
are lost (docs/develop/decisions/fitting.md)."""
_SHARES = (0.01, 0.999)
"""Bounds of the share that lasts: log-odds have none at 0 and 1."""


@dataclass(frozen=True)
class DetectionMemoryFit:
    """The `share` of lists that use a held number, and its `correlation_s`; ∞: the number is always the same.

    `gain`: log-likelihood per list above that without memory, on the passes it is fitted to. `common`: all objects of
    the unit share the number; `gains`: by `common` what either kind gains.
    """

    share: Estimate
    correlation_s: Estimate
    gain: float
    common: bool = False
    gains: Mapping[bool, float] = field(default_factory=dict)


def pass_starts(pass_ix: Int) -> Int:
    """(N + 1,) the first row of each pass, whose rows lie together, and the end."""
    return np.flatnonzero(np.r_[True, pass_ix[1:] != pass_ix[:-1], True])


def build_sequences(listed: Bool, probability: Float, captured_s: Float, pass_ix: Int) -> Sequences:
    """Hits and misses of the passes, with a few dozen distinct probabilities: means of close ones."""
    level = np.rint(np.arcsin(np.sqrt(probability)) * (2 * LEVELS / np.pi)).astype(np.int64)
    count = np.maximum(np.bincount(level), 1)
    return Sequences.of(
        pass_starts(pass_ix), (np.bincount(level, probability) / count)[level], listed, captured_s
    )  # fmt: skip


def build_common_sequences(rows: FitRows, probability: Float) -> Sequences:
    """Hits and misses of whole logs, list by list: all objects of a list share one number, as with `of: unit`."""
    order = np.lexsort((rows.list, rows.log))
    return build_sequences(rows.listed[order], probability[order], rows.captured_s[order], rows.log[order])


def explain_no_memory(listed: Bool, pass_ix: Int) -> str | None:
    """The reason why the data do not tell how long detection lasts; None: they do."""
    passes = len(np.unique(pass_ix))
    for what, where in (("miss", ~listed), ("hit", listed)):
        if not where.any():
            return f"no {what} in {count_noun(len(listed), 'list')}"
    if passes < FEWEST_PASSES or len(listed) == passes:
        return f"{count_noun(passes, 'pass', 'passes')}: no correlation time of detection can be told"
    return None


def fit_detection_memory(
    sequences: Sequences, *, intervals: bool = True, instead: Sequence[Sequences] = ()
) -> DetectionMemoryFit:
    """Share and correlation time of the greatest likelihood, given the probabilities of detection, or one of `instead`.
    Correlation times from a third of the period up to twenty of the longest pass are tried; the last is `always`.
    """
    length_s = np.add.reduceat(sequences.gap_s, sequences.start[:-1]).max()
    period_s = float(np.median(sequences.gap_s[sequences.gap_s > 0]))
    bounds = [tuple(logit(_SHARES).tolist()), tuple(np.log([period_s / 3, 20 * length_s]).tolist())]

    def likelihood(at: Float) -> float:
        share, tau_s = expit(at[0]), np.exp(at[1])
        return max(float(one.log_probability(share, tau_s).sum()) for one in (sequences, *instead))

    shortest, longest = bounds[1]
    starts = [
        np.array([logit(share), shortest + way * (longest - shortest)])
        for share, way in product((0.3, 0.7, 0.95), (0.2, 0.4, 0.6, 0.8))
    ]
    best, top = maximise_likelihood(likelihood, [max(starts, key=likelihood)], bounds)
    share, tau_s = float(expit(best[0])), float(np.exp(best[1]))
    n = len(sequences.listed)
    effective = n / design_effect(share, tau_s, sequences)

    def estimate(k: int, value: float, transform: Callable[[float], float], ends: tuple[float, float]) -> Estimate:
        """With its limits, or the `ends` of all values where the likelihood does not fall enough within bounds."""
        limits = profile_limits(likelihood, best, top, k, bounds) if intervals else (np.nan, np.nan)
        low, high = (
            end if limit == bound else float(transform(limit))
            for limit, bound, end in zip(limits, bounds[k], ends, strict=True)
        )
        return Estimate(value, low, high, n, effective)

    return DetectionMemoryFit(
        estimate(0, share, expit, (0.0, 1.0)),
        estimate(1, np.inf if best[1] > longest - 0.01 else tau_s, np.exp, (0.0, np.inf)),
        (top - float(sequences.log_probability(0.0, 1.0).sum())) / n,
    )


def design_effect(share: float, tau_s: float, sequences: Sequences) -> float:
    """The factor by which the mean of the lists of a pass varies more than that of independent lists. 1 + 2 Σ (1 − k/m)
    s²φᵏ over passes of m lists, for any gaps between them.
    """
    total = 0.0
    for a, b in zip(sequences.start[:-1], sequences.start[1:], strict=True):
        since_s = np.cumsum(sequences.gap_s[a:b])
        ahead = 0.0
        for same in np.exp(-np.diff(since_s) / tau_s).tolist():
            ahead = same * (ahead + 1)
            total += ahead
    return 1 + 2 * share**2 * total / len(sequences.listed)


# Tables of detection.

LEAST_ROWS = 20
"""Effective rows that a node of an axis has at least: a share of ½ is then known to ± 0.22."""
_MOST_NODES = {"range": 6, "visible_share": 4}
_SECTORS = 4
"""Nodes of an axis and sectors of azimuth at most. More: finer tables where rows allow it, and longer fits."""
_WORDS = {"range": "range", "visible_share": "visible share", "azimuth": "azimuth", "class": "class"}
_NOTHING = "hits and misses do not refuse that every list is new"
_SHIFTS = [by for by in np.linspace(-0.9, 0.9, 13).tolist() if abs(by) > 0.01]
"""Log-odds by which all probabilities are shifted where a number of all objects is fitted."""
BY = ("range", "visible_share", "class", "azimuth")
"""All that detection may depend on."""
WORTH_IT = 2.996
"""Log-likelihood that memory must gain: half of the 95 % quantile of χ²₂."""
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

    def model(self) -> dict[str, Any]:
        """The detection model as keys of the experiment: one probability, or a table by range and visible share."""
        values = [
            [CommentedValue(round(float(np.clip(one.value, _KEEP_OFF, 1 - _KEEP_OFF)), 4), one.words()) for one in row]
            for row in self.probability
        ]
        if len(self.range_m) == len(self.visible_share) == 1:
            return {"kind": "constant", "probability": values[0][0]}
        axes = {"range_m": self.range_m, "visible_share": self.visible_share}
        words = "nodes: chosen, at quantiles of the rows"
        nodes = {name: CommentedValue(list(axis), words) for name, axis in axes.items() if len(axis) > 1}
        return {"kind": "table", **nodes, "probability": values}


@dataclass(frozen=True)
class DetectionFit:
    """A fitted detection model.

    `couples`: the first that applies is used. `memory`: what lasts; None: nothing, for the reason `memory_why`.
    `ladder`: the models that were compared. `rows_per_effective`: how many rows are worth one that is independent.
    `notes`: a line each.
    """

    couples: tuple[DetectionCouple, ...]
    memory: DetectionMemoryFit | None
    memory_why: str | None
    ladder: tuple[Rung, ...]
    rows_per_effective: float
    notes: tuple[str, ...]

    def probability(self, view: ViewGeometry) -> Float:
        """(P,) the probability that each row is listed, without memory, from its couple's table; 0: no couple."""
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

    def memory_keys(self) -> dict[str, list[dict[str, Any]]]:
        """The key `memory` of detection as in the experiment file; empty: nothing lasts."""
        if self.memory is None:
            return {}
        share, tau_s = self.memory.share, self.memory.correlation_s
        part = {
            "share": CommentedValue(round(share.value, 3), share.words()),
            "correlation_s": CommentedValue("always", tau_s.words()) if np.isinf(tau_s.value) else tau_s.written(3),
        }
        of_all = (
            {"of": CommentedValue("unit", "all objects of a list: likelier than each")} if self.memory.common else {}
        )
        return {"detection": [part | of_all]}


@dataclass(frozen=True)
class _Rung:
    """One model of the ladder: its axes, its conditions, by what it is split, and the rows (R,) in it."""

    name: str
    axes: tuple[Float, Float]
    when: list[dict[str, Any]]
    rows: NodeWeights
    entries: PooledRows
    split: tuple[str, ...] = ()


def fit_detection(
    rows: FitRows,
    *,
    monotone: bool = True,
    by: tuple[str, ...] = BY,
    simplest: bool = False,
    intervals: bool = True,
) -> DetectionFit:
    """Fit the detection model to rows of objects within reach.

    `by`: what the probability may depend on, of `range`, `visible_share`, `azimuth`, `class`: of the first two as many
    as passes held out ask for, and then class and azimuth. What `by` does not name is scored, too, and noted where it
    explains more: what lasts is then told given that. `monotone`: farther and more hidden is never better. `simplest`:
    always one constant. Without `intervals` limits are NaN.
    """
    _, pass_ix = np.unique(rows.pass_ix, return_inverse=True)
    trial = _TableTrial(rows, pass_ix, _rows_per_effective(rows, pass_ix, monotone), monotone)
    ladder = trial.build_axes(by)
    first, table = trial.choose(ladder, simplest)
    rung, splits = ladder[first], trial.build_splits(ladder[first])
    allowed = [rung, *(one for one in splits if set(one.split) <= set(by))]
    chosen, more = trial.choose(allowed, simplest)
    rung, table = allowed[chosen], _join_rungs(table, more)
    explained_ix, others = trial.choose([rung, *(one for one in splits if one not in allowed)], simplest)
    notes = tuple(
        f"{one.name}: {others[0].below - one.below:+.3g} nats per list, but --by does not name it" for one in others[1:]
    )
    if rows.listed.all() or not rows.listed.any():
        none = f"no {'miss' if rows.listed.all() else 'hit'} in {count_noun(len(rows.listed), 'list')}"
        notes = (f"{none}: intervals of detection take lists as independent, which cannot be told", *notes)
    explained = [rung, *(one for one in splits if one not in allowed)][explained_ix]
    memory, why, tried = _choose_memory(rows, pass_ix, trial.chances(explained), simplest, intervals)
    fit = fit_table(rung.entries, np.ones(int(pass_ix.max()) + 1), trial.worth, monotone=monotone)
    fit = fit if tried is None else replace(fit, worth=tried)
    grid = np.array(estimate_nodes(rung.entries, rung.rows, fit), dtype=object).reshape(rung.rows.shape)
    axes = tuple(tuple(axis.tolist()) for axis in rung.axes)
    couples = tuple(
        DetectionCouple(when.get("classes"), axes[0], axes[1], tuple(map(tuple, one)), when.get("azimuth_deg"))
        for when, one in zip(rung.when, grid.tolist(), strict=True)
    )
    return DetectionFit(couples, memory, why, _add_gains(table, memory), fit.worth, notes)


def _choose_memory(
    rows: FitRows, pass_ix: Int, probability: Float, simplest: bool, intervals: bool
) -> tuple[DetectionMemoryFit | None, str | None, float | None]:
    """What lasts, or None and why; and rows per effective row (None: not known). Compares a number of each object with
    one that all objects of the unit share; the likelier is used, if it is much likelier than none.
    """
    if (why := explain_no_memory(rows.listed, pass_ix)) is not None:
        return None, why, None
    by_object = build_sequences(rows.listed, probability, rows.captured_s, pass_ix)
    sequences = {False: by_object}
    if (np.bincount(rows.list) > 1).any():
        sequences[True] = build_common_sequences(rows, probability)
    fits = {common: fit_detection_memory(seen, intervals=False) for common, seen in sequences.items()}
    common = max(fits, key=lambda one: fits[one].gain)
    # Few numbers of all objects leave the probability open, and on which side of it they are.
    odds = logit(np.clip(probability, _KEEP_OFF, 1 - _KEEP_OFF))
    instead = [build_common_sequences(rows, expit(odds + by)) for by in _SHIFTS] if common else []
    best = fit_detection_memory(sequences[common], intervals=intervals, instead=instead)
    worth = design_effect(best.share.value, best.correlation_s.value, sequences[common])
    if simplest or best.gain * len(rows.listed) <= WORTH_IT:
        return None, "the simplest model was asked for" if simplest else _NOTHING, worth
    return replace(best, common=common, gains={one: fit.gain for one, fit in fits.items()}), None, worth


def _join_rungs(table: tuple[Rung, ...], more: tuple[Rung, ...]) -> tuple[Rung, ...]:
    """One table of two, of which the second begins with what the first has chosen; `below` the best of all."""
    best = max(one.score for one in (*table, *more))
    both = (*(more[0] if one.chosen else one for one in table), *more[1:])
    return tuple(replace(one, below=best - one.score) for one in both)


def _add_gains(table: tuple[Rung, ...], memory: DetectionMemoryFit | None) -> tuple[Rung, ...]:
    """The tables, and what memory of either kind adds to the chosen one on the passes it is fitted to."""
    if memory is None:
        return table
    [chosen], most = [rung for rung in table if rung.chosen], max(memory.gains.values())
    names = {False: f"{chosen.name} + memory", True: f"{chosen.name} + memory of all objects"}
    memory_rungs = [
        Rung(names[common], chosen.score + gain, most - gain, 0.0, common == memory.common, "likelihood")
        for common, gain in memory.gains.items()
    ]
    return (*(replace(rung, below=rung.below + most, chosen=False) for rung in table), *memory_rungs)


@dataclass(frozen=True)
class _TableTrial:
    """Compares tables on passes they were not fitted to, or by BIC. `worth`: rows per effective row."""

    rows: FitRows
    pass_ix: Int
    worth: float
    monotone: bool

    def choose(self, ladder: list[_Rung], simplest: bool) -> tuple[int, tuple[Rung, ...]]:
        """The index of the chosen table in `ladder`, which goes from the simplest to the richest, and their scores."""
        starts = pass_starts(self.pass_ix)

        def score(k: int, held_out: Bool) -> Float:
            entries, theta = ladder[k].entries, self.fit(ladder[k], (~held_out).astype(float))
            p = entries.placed.chances(theta)
            result: Float = entries.count @ np.log(np.where(entries.hit, p, 1 - p))  # (passes,)
            return result

        names, size = [one.name for one in ladder], np.array([np.prod(one.rows.shape) for one in ladder])
        worth = len(self.pass_ix) / self.worth
        return compare_models(
            names, score, self.rows.fold[starts[:-1]], np.diff(starts), size, worth, simplest=simplest
        )

    def fit(self, rung: _Rung, times: Float) -> Float:
        """(K,) probabilities at the nodes; `times (passes,)`: how often each counts."""
        return fit_table(rung.entries, times, self.worth, monotone=self.monotone).theta

    def chances(self, rung: _Rung) -> Float:
        """(R,) the fitted probability of each row."""
        return rung.rows.chances(self.fit(rung, np.ones(int(self.pass_ix.max()) + 1)))

    def build_axes(self, by: tuple[str, ...]) -> list[_Rung]:
        """Tables from one constant to nodes on all axes of `by`; an axis with too few rows for two is left out."""
        rows_per_node, single_node = LEAST_ROWS * self.worth, np.zeros(1)
        values = {"range": self.rows.view.range_m, "visible_share": self.rows.view.visible_share}
        axes, used_names = (single_node, single_node), list[str]()
        ladder = [self._build("constant", axes, [{}])]
        for name in (one for one in by if one in values):
            k = list(values).index(name)
            most = int(min(len(self.pass_ix) / rows_per_node, _MOST_NODES[name]))
            nodes = choose_nodes(values[name], most, rows_per_node, _DECIMALS[name]) if most > 1 else single_node
            nodes = nodes if len(nodes) > 1 else single_node
            axes = (nodes, axes[1]) if k == 0 else (axes[0], nodes)
            rung = self._build(" × ".join([*used_names, _WORDS[name]]), axes, [{}])
            if rung.rows.shape != ladder[-1].rows.shape:
                used_names.append(_WORDS[name])
                ladder.append(rung)
        return ladder

    def build_splits(self, rung: _Rung) -> list[_Rung]:
        """The table split by class, by azimuth and by both, where rows allow it."""
        least, out = LEAST_ROWS * self.worth, list[_Rung]()
        for split in (("class",), ("azimuth",), ("class", "azimuth")):
            conditions = rung.when
            for name in split:
                conditions = _split_conditions(self.rows, conditions, name, least)
            if len(conditions) > max([len(rung.when), *(len(one.when) for one in out if len(split) > 1)]):
                words = [*([] if rung.name == "constant" else [rung.name]), *(_WORDS[name] for name in split)]
                out.append(self._build(" × ".join(words), rung.axes, conditions, split))
        return out

    def _build(
        self, name: str, axes: tuple[Float, Float], conditions: list[dict[str, Any]], split: tuple[str, ...] = ()
    ) -> _Rung:
        values = self.rows.view.range_m, self.rows.view.visible_share
        where = weigh_nodes(axes, values, _first_that_holds(conditions, self.rows.view))
        return _Rung(name, axes, conditions, where, pool_rows(where, self.rows.listed, self.pass_ix), split)


def _split_conditions(rows: FitRows, conditions: list[dict[str, Any]], name: str, least: float) -> list[dict[str, Any]]:
    """Conditions split by class or azimuth (`name`) where a part has `least` rows; other rows are one more, {}."""
    if name == "class":
        finer_conditions: list[dict[str, Any]] = [{"classes": (CLASSES[k],)} for k in np.unique(rows.view.class_ix)]
    else:
        degrees = np.rad2deg(rows.view.azimuth_rad)
        inner = np.round(np.quantile(degrees, np.arange(1, _SECTORS) / _SECTORS))
        edges = np.unique([np.floor(degrees.min()), *inner, np.ceil(degrees.max())]).tolist()
        finer_conditions = [{"azimuth_deg": pair} for pair in pairwise(edges)]
    parts = [one | other for one, other in product(conditions, finer_conditions)]
    size = np.bincount(_first_that_holds([*parts, {}], rows.view), minlength=len(parts) + 1)
    large_parts = [part for part, rows_there in zip(parts, size, strict=False) if rows_there >= least]
    if len(large_parts) + (size.sum() > size[: len(parts)][size[: len(parts)] >= least].sum()) < 2:
        return conditions
    rest_exists = (_first_that_holds([*large_parts, {}], rows.view) == len(large_parts)).any()
    return [*large_parts, {}] if rest_exists else large_parts


def _first_that_holds(when: list[dict[str, Any]], view: ViewGeometry) -> Int:
    """(P,) which of the conditions applies to each row, −1: none."""
    out = np.full(len(view.range_m), -1)
    for k, one in enumerate(when):
        out[(out < 0) & Condition(**one).holds(view)] = k
    return out


def _rows_per_effective(rows: FitRows, pass_ix: Int, monotone: bool) -> float:
    """Rows per effective row, by the residuals of the richest model fitted as if rows were independent; else 1."""
    if rows.listed.all() or not rows.listed.any():
        return 1.0
    trial = _TableTrial(rows, pass_ix, 1.0, monotone)
    axes = trial.build_axes(BY)[-1]
    richest = [axes, *trial.build_splits(axes)][-1]
    return count_rows_per_effective(rows.listed - trial.chances(richest), pass_ix)

"""Judging: criteria held against results by the intervals that `summary.csv` and `compare` print. Nothing is replayed.

A criterion asked of *such traffic* is judged over drives, or over the objects of a single one, as those intervals are;
one asked of *these logs* over the runs: what is random about these very recordings is the draws. Where nothing is
drawn, or a figure is exact, it is known. Rows are those of the tally; of runs, of accuracy and of own metrics they are
read log by log.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from copem_replay.core.components import ask_component
from copem_replay.core.errors import InputError, count_noun, unknown_name_message
from copem_replay.core.tracks import Bool, Float
from copem_replay.experiment.criteria import Criterion, choose_judged
from copem_replay.metrics.braking.driving import JUDGED_DRIVING, sum_drives
from copem_replay.metrics.config import BEGAN_BY, Slice, parse_slice
from copem_replay.metrics.limits import (
    ALL_ALIKE,
    BOUNDED,
    NOTHING_DRAWN,
    OBJECTS,
    Clusters,
    LimitedFigure,
    count_clusters,
    explain_no_clusters,
    find_clusters,
    format_limit,
    format_limits,
    weigh_rows,
)
from copem_replay.metrics.needed import Known, count_deciding, find_level, find_spread
from copem_replay.metrics.onset import select_counted
from copem_replay.metrics.row_figures import (
    JUDGED,
    PER_MINUTE,
    SUMMED,
    FigureRows,
    limit_sums,
)
from copem_replay.metrics.slices import Group, StudyRows, sum_episodes
from copem_replay.metrics.summary import CONFLICT, list_runs
from copem_replay.results.compare.compare import PairsAsked, compare_folders
from copem_replay.results.compare.labels import label_configurations
from copem_replay.results.read import Results
from copem_replay.results.slices import read_slices, read_study_rows
from copem_replay.results.verdicts import MET, NOT_MEASURED, NOT_MET, UNDECIDED, Judgement, Verdict, judge_limits

CLOSED_FORM = "closed form"
"""The kind of interval of a figure in closed form: exact for these logs."""
FEWEST_RUNS = 30
"""With fewer runs a figure over several objects has no interval."""


@dataclass(frozen=True)
class JudgedFigure:
    """A figure with its limits and what these are over: `clusters` of `over`, of `n` rows about so many `units`; `why`
    there are none. `shorter`: what a shorter horizon would show.
    """

    figure: LimitedFigure
    over: str | None = None
    clusters: int | None = None
    n: int = 0
    why: str = ""
    units: int = 0
    shorter: str = ""


_NO_ROW = JudgedFigure(LimitedFigure(None), why="no row")


def judge_results(results: Results, criteria: Mapping[str, Criterion], before: Results | None = None) -> Judgement:
    """The verdicts of criteria, in their order, by configuration and group.

    `before`: results that criteria are `against`. Raises InputError where a name does not exist in the results, where
    `before` is missing, or where it cannot be compared.
    """
    study = _JudgedStudy(results, before, criteria)
    verdicts: list[Verdict] = []
    notes: list[str] = []
    for name, criterion in criteria.items():
        groups = study.find_groups(name, criterion)
        if criterion.each is not None:
            notes.append(f"{name}: {count_noun(len(groups), 'group')} of {study.slice_of(name, criterion).label}")
        for configuration in choose_judged(criterion, results.experiment.configurations):
            for group in groups:
                found = study.measure(name, criterion, configuration, group)
                verdicts.append(_make_verdict(name, criterion, configuration, group.label, found))
    return Judgement(results.name, tuple(verdicts), tuple(notes))


def list_later(results: Results) -> list[str]:
    """The criteria of an experiment that are against results of before."""
    known = list(results.experiment.configurations)
    return [
        name
        for name, one in results.experiment.criteria.items()
        if one.against is not None and one.find_against("", known)[1]
    ]


def judge_own_criteria(results: Results) -> Judgement | None:
    """The verdicts of the experiment's own criteria but those against results of before; None: there are none."""
    later = list_later(results)
    criteria = {name: one for name, one in results.experiment.criteria.items() if name not in later}
    return judge_results(results, criteria) if criteria else None


def find_population(results: Results) -> str:
    """The population of `compare`'s intervals: these logs where they are over runs of one object, else such traffic."""
    clusters = find_clusters(results.known)
    return "these_logs" if clusters is not None and clusters.by_run else "such_traffic"


def _make_verdict(name: str, criterion: Criterion, configuration: str, group: str, item: JudgedFigure) -> Verdict:
    """The verdict on a criterion for one configuration and group, from the figure that was measured."""
    figure = item.figure
    word, why = _find_verdict(criterion, item)
    passes = word == MET or (word == UNDECIDED and criterion.passes_unless_refuted)
    other, of_before = criterion.find_against(configuration, (criterion.against or "",))
    return Verdict(
        criterion=name,
        configuration=configuration,
        group=group,
        metric=criterion.metric,
        against=criterion.against and (f"{other}@before" if of_before else other),
        direction=criterion.direction,
        bound=criterion.bound,
        confidence=criterion.confidence,
        population=criterion.population,
        estimate=_finite(figure.value),
        low=_finite(figure.low),
        high=_finite(figure.high),
        interval=figure.kind,
        over=item.over,
        clusters=item.clusters,
        n=item.n,
        verdict=word,
        passes=passes or (word == NOT_MEASURED and criterion.if_absent == "pass"),
        why=why,
    )


def _finite(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


def _find_verdict(criterion: Criterion, item: JudgedFigure) -> tuple[str, str]:
    """The verdict (met, not met, undecided, not measured) and a phrase on why."""
    figure, bound, direction = item.figure, criterion.bound, criterion.direction
    if figure.value is None:
        return NOT_MEASURED, item.why or "no row has a value"
    if figure.kind == ALL_ALIKE:
        value_is_good = judge_limits(figure.value, figure.value, bound, direction) == MET
        why = "the same throughout, so how it varies is not known"
        return (UNDECIDED if value_is_good else NOT_MET), why
    if figure.kind is None or math.isnan(figure.low) or math.isnan(figure.high):
        return NOT_MEASURED, item.why or "no interval"
    word = judge_limits(figure.low, figure.high, bound, direction)
    parts = [] if figure.share is None else [_describe_share(criterion, figure.share)]
    if word == UNDECIDED:
        parts.append(_describe_deciding(criterion, item))
    return word, "; ".join([*parts, *filter(None, [item.why, item.shorter if word == UNDECIDED else ""])])


_AT_BOUND = 1e-9
"""A figure this close to its bound is at it."""


def _describe_deciding(criterion: Criterion, item: JudgedFigure) -> str:
    """How many logs, objects, passes or runs would decide: `about 57 objects like these would decide, 13 now`."""
    over, number = item.over or "logs", item.clusters or 0
    known = Known(over, number, item.units)
    paired = criterion.against is not None
    needed = count_deciding(criterion.metric, item.figure, criterion.bound, known, criterion.confidence, paired=paired)
    if needed is None and abs((item.figure.value or 0.0) - criterion.bound) <= _AT_BOUND:
        return f"no number of {over} decides: it is at the bound ({number} now)"
    if needed is None:
        return f"more {over} would decide, how many is not known ({number} now)"
    return f"about {max(needed, number + 1)} {over} like these would decide ({number} now)"


def _describe_share(criterion: Criterion, share: tuple[float, float, float]) -> str:
    """What is known of the share that a quantile is held by: `93.1 … 97 % known by 0.5 s, 95 % wanted`."""
    limits = f"{100 * share[0]:.3g} … {100 * share[2]:.3g} %"
    by = f"at {criterion.bound:g} m or farther" if "dad" in criterion.metric else f"by {criterion.bound:g} s"
    return f"{limits} known {by}, {100 * (find_level(criterion.metric) or 0.0):g} % wanted"


# What is judged: rows of a study or of some of its episodes.


@dataclass(frozen=True, eq=False)
class _JudgedGroup:
    """Rows that a criterion is about. `label`: of the group of a slice, else empty.

    `episodes`: by log those that are kept, None: all of them; None: of all logs. `every`: they count however they
    began. `made`: tables and rows that were made of them.
    """

    label: str
    rows: StudyRows
    episodes: Mapping[str, frozenset[tuple[str, int]] | None] | None = None
    every: bool = False
    made: dict[Any, Any] = field(default_factory=dict)


class _JudgedStudy:
    """Results with their rows, each read once, and the pairs that criteria are against."""

    def __init__(self, results: Results, before: Results | None, criteria: Mapping[str, Criterion]) -> None:
        self.results, self.before, self.criteria = results, before, criteria
        self._groups: dict[Any, list[_JudgedGroup]] = {}
        self._pairs: dict[Any, pd.DataFrame] = {}

    @property
    def _of_rows(self) -> bool:
        """Whether a criterion needs more than the tally has."""
        known = (*JUDGED, *PER_MINUTE, *JUDGED_DRIVING)
        return any(one.against is None and one.metric not in known for one in self.criteria.values())

    @cached_property
    def traffic(self) -> StudyRows:
        """The rows of all runs together."""
        return read_study_rows(self.results, sums=self._of_rows)

    @cached_property
    def runs(self) -> StudyRows:
        """The study with one row by episode and run (column `run`), for criteria on single runs; read from all logs."""
        tables, sums = [], []
        metrics = self.traffic.settings.own
        for log in self.results.rows.logs:
            (rows,) = self.results.each(log=log, every=True)
            rows = rows.assign(log=log)
            tables.append(list_runs(rows))
            if self._of_rows:
                sums.append(sum_episodes(rows, metrics, self.traffic.settings.words, "run"))
        tally = pd.concat(tables, ignore_index=True) if tables else self.traffic.tally
        lists = self.traffic.lists
        if lists is not None:
            lists = self.results.frame("lists.parquet")
        summed = pd.concat(sums, ignore_index=True) if sums else self.traffic.sums
        return replace(self.traffic, tally=tally, sums=summed, lists=lists)

    # Which rows.

    def slice_of(self, name: str, criterion: Criterion) -> Slice:
        """The slice that a criterion names. Raises InputError where it cannot be of these results."""
        entry: Any = criterion.each if criterion.by is None else list(criterion.by)
        (by,) = read_slices(self.results, [parse_slice(entry).label], f"criteria.{name}")
        return by

    def find_groups(self, name: str, criterion: Criterion) -> list[_JudgedGroup]:
        """The rows that a criterion is about, in groups where it says `each`."""
        narrowed = criterion.model_dump_json(include={"objects", "logs", "by", "each", "population"})
        if narrowed not in self._groups:
            self._groups[narrowed] = self._make_groups(name, criterion)
        return self._groups[narrowed]

    def _make_groups(self, name: str, criterion: Criterion) -> list[_JudgedGroup]:
        """The groups of episodes that a criterion is judged on: all as one, one by its `by`, or each of a slice."""
        study = self.runs if criterion.of_runs else self.traffic
        episodes = study.episodes
        is_chosen, logs = self._choose_episodes(name, criterion, episodes)
        rows = study
        if criterion.objects is not None or criterion.logs is not None:
            rows = study.select(is_chosen, None if criterion.objects is not None else logs)
        if criterion.by is None and criterion.each is None:
            is_whole = rows is study
            return [_JudgedGroup("", rows, None if is_whole else _list_episodes(rows, whole=criterion.objects is None))]
        entry = self.slice_of(name, criterion)
        groups = rows.split(entry)
        if criterion.by is not None:
            groups = [self._find_group(name, criterion.by, entry, study, rows, groups)]
        every, is_whole = entry.names(BEGAN_BY), entry.of_logs and criterion.objects is None
        return [_JudgedGroup(one.label, one.rows, _list_episodes(one.rows, whole=is_whole), every) for one in groups]

    def _choose_episodes(self, name: str, criterion: Criterion, episodes: pd.DataFrame) -> tuple[Bool, set[str]]:
        """(E,) whether each episode is meant by a criterion, and the log names. Raises InputError: no such log."""
        logs = [log.name for log in self.results.provenance.logs]
        patterns = criterion.logs or ("*",)
        for k, pattern in enumerate(patterns):
            if not any(fnmatchcase(log, pattern) for log in logs):
                raise InputError(f"criteria.{name}.logs[{k}]: {unknown_name_message('log', pattern, logs)}")
        log_names = {log for log in logs if any(fnmatchcase(log, pattern) for pattern in patterns)}
        is_chosen = episodes["log"].isin(log_names).to_numpy(dtype=bool)
        if criterion.objects is not None:
            classes, ids = criterion.objects.expanded(), criterion.objects.ids or ()
            column, wanted = ("object_id", set(ids)) if classes is None else ("object_class", set(classes))
            is_chosen = is_chosen & episodes[column].astype(str).isin(wanted).to_numpy(dtype=bool)
        return is_chosen, log_names

    def _find_group(
        self,
        name: str,
        where: Mapping[str, str],
        cut: Slice,
        study: StudyRows,
        rows: StudyRows,
        groups: Sequence[Group],
    ) -> Group:
        """The group with the values of `where`; an empty one, if the chosen rows have none. InputError: unknown."""
        values = tuple(map(str, where.values()))
        if found := [one for one in groups if one.values == values]:
            return found[0]
        for k, (key, value) in enumerate(where.items()):
            known_values = sorted({one.values[k] for one in study.split(cut)})
            if value not in known_values and not key.startswith(("class", "began")):
                raise InputError(f"criteria.{name}.by.{key}: {unknown_name_message('group', value, known_values)}")
        nothing = rows.select(np.zeros(len(rows.episodes), dtype=bool))
        return Group(cut, values, nothing)

    # Figures.

    def measure(self, name: str, criterion: Criterion, configuration: str, group: _JudgedGroup) -> JudgedFigure:
        """The figure that a criterion judges, with its limits: of rows, lists, driving or sums, or a difference."""
        if criterion.against is not None:
            return self._measure_difference(name, criterion, configuration, group)
        metric = criterion.metric
        if metric in JUDGED:
            return self._measure_rows(criterion, configuration, group)
        if metric in PER_MINUTE:
            return self._measure_lists(criterion, configuration, group)
        if metric in JUDGED_DRIVING:
            return self._measure_driving(criterion, configuration, group)
        return self._measure_sums(criterion, configuration, group)

    def _measure_rows(self, criterion: Criterion, configuration: str, group: _JudgedGroup) -> JudgedFigure:
        """The figure of a metric of detection rows, with its limits; computed rows are cached in `group.made`."""
        judged, settings = JUDGED[criterion.metric], group.rows.settings
        kind = judged.rows
        weigh = criterion.weigh or settings.weigh
        key = kind, configuration, weigh
        if key not in group.made:
            group.made[key] = self._make_figure_rows(group, kind, configuration, weigh, of_runs=criterion.of_runs)
        cached: tuple[FigureRows | None, JudgedFigure] = group.made[key]
        rows, basis = cached
        if rows is None:
            return basis
        figure = judged.limit(rows, settings.horizon_s, criterion.confidence, criterion.bound)
        if basis.figure.kind is not None and figure.value is not None:  # it is known
            figure = LimitedFigure(figure.value, figure.value, figure.value, basis.figure.kind)
        shorter = _find_shorter_horizon(criterion, rows, settings.horizon_s) if figure.bounds is not None else ""
        return replace(basis, figure=figure, shorter=shorter)

    def _make_figure_rows(
        self, group: _JudgedGroup, kind: str, configuration: str, weigh: str, *, of_runs: bool
    ) -> tuple[FigureRows | None, JudgedFigure]:
        """The rows of `kind` with clusters (None: no rows), and the figure but for its value: n and clusters."""
        study, exact = group.rows, kind.startswith("exact")
        table = self._split_table(group, "exact" if exact else kind).get(configuration)
        if table is None or not len(table):
            return None, _NO_ROW
        if kind.endswith("braking"):
            table = table[table["conflict" if exact else "in_conflict"]]
        if not len(table):
            return None, replace(_NO_ROW, why="no object is in conflict")
        weight = weigh_rows(table, "probability" if exact else "runs", weigh)
        n = round(float(weight.sum()))
        facts = study.settings.facts[configuration]
        if of_runs and (exact or (facts.fixed_verdicts if kind == "braking" else facts.fixed)):
            certain = LimitedFigure(None, kind=CLOSED_FORM if exact else NOTHING_DRAWN)
            return FigureRows(table, weight, None), JudgedFigure(certain, n=n)
        clusters, why = find_judged_clusters(table, of_runs=of_runs, weigh=weigh)
        runs = float(self.results.provenance.runs)
        least_share = 1.0 / max(n * runs, 1.0) if exact else 1e-12
        basis = JudgedFigure(LimitedFigure(None), n=n, why=why)
        if clusters is not None:
            units = clusters.count if clusters.once else clusters.units
            basis = replace(basis, over=clusters.over, clusters=clusters.count, units=units)
        return FigureRows(table, weight, clusters, least_share, facts.least_s), basis

    def _split_table(self, group: _JudgedGroup, kind: str) -> dict[str, pd.DataFrame]:
        """By configuration the rows that count; `kind`: `braking`, `detected`, `conflict` or `exact`."""
        study = group.rows
        name = "detected" if kind == "braking" else kind
        if name not in group.made:
            if name == "exact":
                assert study.exact is not None
                table = select_counted(study.exact, study.settings.words)
                table = table[table["probability"] > 0]
            elif name == "conflict":
                table = study.counted[study.counted["event"] == CONFLICT]
            else:
                table = study.detections
            group.made[name] = {str(one): part for one, part in table.groupby("configuration", sort=False)}
        split: dict[str, pd.DataFrame] = group.made[name]
        return split

    def _measure_sums(self, criterion: Criterion, configuration: str, group: _JudgedGroup) -> JudgedFigure:
        """The figure of an accuracy metric, or a user's own, from sums by episode; or why there is none."""
        metric, sums = criterion.metric, group.rows.sums
        metrics = {one.name: one for one in group.rows.settings.own}
        names = [name for name in sums if name.startswith(f"{metric} ")]
        ratio = SUMMED.get(metric)
        denominator = "counted_rows" if ratio is None else ratio.over
        columns = names if ratio is None else [ratio.sum, ratio.over]
        if denominator not in sums:
            return replace(_NO_ROW, why="accuracy is not measured")
        sums = sums[(sums["configuration"] == configuration) & (sums[denominator] > 0)]
        if not len(sums):
            return replace(_NO_ROW, why="no row has it")

        def of_own(totals: Float) -> float:
            given = {name.partition(" ")[2]: float(total) for name, total in zip(names, totals, strict=True)}
            value = ask_component(metrics[metric], f"measure.metrics ({metric})", lambda: metrics[metric].value(given))
            return math.nan if value is None else float(value)

        compute = of_own if ratio is None else ratio.value_of
        least_value = -math.inf if ratio is None else ratio.least
        return self._limit_sums(criterion, configuration, sums, columns, compute, denominator, least_value)

    def _limit_sums(
        self, criterion: Criterion, configuration: str, rows: pd.DataFrame, columns: Sequence[str], compute: Any,
        denominator: str, least: float = 0.0,
    ) -> JudgedFigure:  # fmt: skip
        """The figure `compute` makes of summed `columns`, with limits over clusters; `denominator`: weighs rows."""
        clusters, why = None, ""
        fixed = criterion.of_runs and self.traffic.settings.facts[configuration].fixed
        if not fixed:
            clusters, why = find_judged_clusters(rows, of_runs=criterion.of_runs)
        values, weight = rows[list(columns)].to_numpy(dtype=float), rows[denominator].to_numpy(dtype=float)
        figure = limit_sums(values, compute, clusters, weight, criterion.confidence, least)
        if fixed and figure.value is not None:
            figure = LimitedFigure(figure.value, figure.value, figure.value, NOTHING_DRAWN)
        if clusters is None:
            return JudgedFigure(figure, n=len(rows), why=why)
        return JudgedFigure(figure, clusters.over, clusters.count, len(rows), why)

    def _measure_lists(self, criterion: Criterion, configuration: str, group: _JudgedGroup) -> JudgedFigure:
        """False entries per minute, which belong to whole logs."""
        lists = group.rows.lists
        if lists is None:
            why = "accuracy is not measured" if self.traffic.lists is None else "false entries belong to whole logs"
            return replace(_NO_ROW, why=why)
        lists = lists[lists["configuration"] == configuration].assign(object_id="")
        if not len(lists):
            return _NO_ROW
        columns = (PER_MINUTE[criterion.metric], "minutes")
        return self._limit_sums(criterion, configuration, lists, columns, lambda of: of[..., 0] / of[..., 1], "minutes")

    def _measure_driving(self, criterion: Criterion, configuration: str, group: _JudgedGroup) -> JudgedFigure:
        """The figure of needless braking; without a value for parts of a log, or where the ego does not drive."""
        lists = group.rows.lists
        if lists is None:
            why = "accuracy is not measured" if self.traffic.lists is None else "needless braking is of whole logs"
            return replace(_NO_ROW, why=why)
        drives = sum_drives(lists[lists["configuration"] == configuration], of_runs=criterion.of_runs)
        if drives is None or not drives.hours.sum() > 0:
            return replace(_NO_ROW, why="the ego does not drive")
        figure, number = drives.limit(criterion.metric, criterion.confidence), len(drives.hours)
        if drives.over == "runs" and not criterion.of_runs:
            return JudgedFigure(LimitedFigure(figure.value), n=number, why=_ONE_DRIVE)
        if drives.over is None:
            return JudgedFigure(LimitedFigure(figure.value), n=number, why=f"{count_noun(number, 'log')}; {_RATHER}")
        return JudgedFigure(figure, drives.over, number, number, units=number)

    # Differences.

    def _measure_difference(
        self, name: str, criterion: Criterion, configuration: str, group: _JudgedGroup
    ) -> JudgedFigure:
        """The figure of a difference, pair by pair, from another configuration here or in the --before folder."""
        configurations = list(self.results.experiment.configurations)
        other, of_before = criterion.find_against(configuration, configurations)
        if of_before and self.before is None:
            raise InputError(f"criteria.{name}.against: {criterion.against}: give the folder with --before")
        if of_before and self.before is not None and other not in self.before.facts:
            hint = unknown_name_message("configuration", other, self.before.facts)
            raise InputError(f"criteria.{name}.against: {self.before.place}: {hint}")
        key = id(group), other, of_before, criterion.of_runs, criterion.confidence, criterion.weigh
        if (table := self._pairs.get(key)) is None:
            table = self._pairs[key] = self._compare(criterion, other, group, of_before=of_before)
        rows = table[(table["configuration"] == configuration) & (table["metric"] == criterion.metric)]
        if not len(rows):
            return replace(_NO_ROW, why="nothing that both sides have")
        return _difference_of(rows.iloc[0], criterion)

    def _compare(self, criterion: Criterion, other: str, group: _JudgedGroup, *, of_before: bool) -> pd.DataFrame:
        """The overall rows against configuration `other`, in all metrics that such criteria ask of this group. The
        column `configuration` has names, not labels.
        """
        criteria = [
            one for one in self.criteria.values()
            if one.against is not None
            and (one.of_runs, one.confidence) == (criterion.of_runs, criterion.confidence)
            and one.weigh == criterion.weigh
        ]  # fmt: skip
        metrics = sorted({one.metric for one in criteria})
        folders = [self.results, *([self.before] if of_before and self.before is not None else [])]
        labelled = {(one.results, one.configuration): one.label for one in label_configurations(folders)}
        configurations = self.results.experiment.configurations
        names = dict.fromkeys(name for one in criteria for name in choose_judged(one, configurations))
        labels = {labelled[self.results, name]: name for name in names if (self.results, name) in labelled}
        baseline = labelled.get((folders[-1], other))
        if baseline is None or not (chosen := [label for label in labels if label != baseline]):
            return pd.DataFrame(columns=["configuration", "metric"])
        asked = PairsAsked(group.episodes, group.every, criterion.of_runs, criterion.confidence, criterion.weigh)
        comparison = compare_folders(
            folders, configurations=chosen, baseline=baseline, metrics=metrics, asked=asked
        )  # fmt: skip
        overall = comparison.overall
        return overall.assign(configuration=overall["configuration"].map(labels), horizon_s=comparison.horizon_s)


def _difference_of(row: pd.Series, criterion: Criterion) -> JudgedFigure:
    """The figure of one comparison row; where the bound can be met by limits from bounded values, with those limits."""
    n, of_runs = int(row["n"]), criterion.of_runs
    if pd.isna(row["difference"]):
        return replace(_NO_ROW, n=n, why="no pair has it")
    value, kind = float(row["difference"]), None if pd.isna(row["interval"]) else str(row["interval"])
    over = None if pd.isna(row["interval_over"]) else str(row["interval_over"])
    if kind == NOTHING_DRAWN and of_runs:
        return JudgedFigure(LimitedFigure(value, value, value, kind), n=n)
    if over == "runs" and not of_runs:
        return JudgedFigure(LimitedFigure(value), n=n, why=_ONE_OBJECT)
    met_by = "high_bounded" if criterion.direction == "at_most" else "low_bounded"
    bounded = None if pd.isna(row[met_by]) else float(row[met_by])
    if kind == ALL_ALIKE and bounded is None:
        return JudgedFigure(LimitedFigure(value, kind=kind), "runs" if of_runs else None, n=n)
    if kind is None or kind == NOTHING_DRAWN:
        return JudgedFigure(LimitedFigure(value), n=n, why=_TOO_FEW)
    alike = kind == ALL_ALIKE  # of no spread Student's t has the value itself as limits
    low = value if alike else -math.inf if pd.isna(row["low"]) else float(row["low"])
    high = value if alike else math.inf if pd.isna(row["high"]) else float(row["high"])
    if bounded is None:
        return JudgedFigure(LimitedFigure(value, low, high, kind), over, int(row["clusters"]), n)
    clusters, most = int(row["clusters"]), 1.0 if "share" in criterion.metric else float(row["horizon_s"])
    spread = find_spread(low, high, clusters, criterion.confidence)
    low, high = (low, bounded) if met_by == "high_bounded" else (bounded, high)
    return JudgedFigure(LimitedFigure(value, low, high, BOUNDED, None, (-most, most), spread), over, clusters, n)


_ONE_OBJECT = "one object tells nothing of other traffic; `population: these_logs` asks about this recording"
_ONE_DRIVE = "one drive tells nothing of other driving; `population: these_logs` asks about this recording"
_TOO_FEW = "too few logs, objects of one log, or runs have it for an interval"


_HORIZONS = (0.8, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1)
"""Shares of the horizon that are tried where a mean up to it is undecided."""


def _find_shorter_horizon(criterion: Criterion, rows: FigureRows, horizon_s: float) -> str:
    """The longest of some shorter horizons by which these very rows meet a bound on a mean; empty: none."""
    judged = JUDGED[criterion.metric]
    for part in _HORIZONS if criterion.direction == "at_most" and judged.to_horizon else ():
        figure = judged.limit(rows, part * horizon_s, criterion.confidence, criterion.bound)
        if figure.kind is not None and figure.high <= criterion.bound < part * horizon_s:
            limits = f"{format_limit(figure.value or 0.0)} {format_limits(figure.low, figure.high)}"
            return f"up to a horizon_s of {part * horizon_s:.3g} these meet it: {limits}"
    return ""


def _list_episodes(rows: StudyRows, *, whole: bool) -> dict[str, frozenset[tuple[str, int]] | None]:
    """By log the episodes of rows; None: the `whole` of it."""
    episodes_of: dict[str, frozenset[tuple[str, int]] | None] = {}
    for log, of_log in rows.episodes.groupby("log", sort=False):
        pairs = zip(of_log["object_id"].astype(str), of_log["episode"].astype(int), strict=True)
        episodes_of[str(log)] = None if whole else frozenset(pairs)
    return episodes_of


def find_judged_clusters(table: pd.DataFrame, *, of_runs: bool, weigh: str = OBJECTS) -> tuple[Clusters | None, str]:
    """The clusters of an interval of rows, or why there are none; `of_runs`: the runs, else by `choose_over`."""
    counts = count_clusters(table)
    if of_runs:
        runs = table["run"].nunique()
        if runs < FEWEST_RUNS and (counts[1] > 1 or runs < 2):
            return None, f"{count_noun(runs, 'run')}, fewer than {FEWEST_RUNS}: `runs: {FEWEST_RUNS}` or more"
        return find_clusters(table, of_runs=True), ""
    clusters = find_clusters(table, weigh=weigh)
    if clusters is None:
        return None, f"{explain_no_clusters(*counts)}; {_RATHER}"
    return (None, _ONE_OBJECT) if clusters.by_run else (clusters, "")


_RATHER = "more runs do not tell how drives differ; `population: these_logs` asks about these recordings"

"""The comparison of configurations with a baseline, on the same logs, objects and runs, within or across folders.

Folders are checked for what they must have in common: the recordings, the random numbers, and what is measured how.
Logs are read one by one, so that no rows are kept but their sums.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from copem_replay.core.errors import InputError, count_noun, unknown_name_message
from copem_replay.core.tracks import SAME_INSTANT_S
from copem_replay.metrics.columns import COMPARISON
from copem_replay.metrics.limits import (
    CONFIDENCE,
    DRIVES,
    FEWEST_CLUSTERS,
    FEWEST_LOGS,
    NOT_ENOUGH,
    OBJECTS,
    choose_over,
    explain_no_clusters,
)
from copem_replay.metrics.summary_metrics import COMPARED, OF_LISTS
from copem_replay.results.compare.groups import EpisodeGroups, without_limits_over_runs
from copem_replay.results.compare.labels import (
    LabelledConfiguration,
    check_comparable,
    check_log_names,
    choose_baseline,
    choose_configurations,
    find_remembering,
    label_configurations,
    notes_on_differences,
    notes_on_folders,
    notes_on_output_baseline,
    notes_on_remembering,
    rename_logs,
)
from copem_replay.results.compare.limits import (
    ALONE,
    STAR,
    ClusterNames,
    describe_difference,
    difference_limits,
    find_decisive_log,
    find_stars,
    is_off_zero,
    mcnemar_p_value,
)
from copem_replay.results.compare.metrics import (
    HELD_METRICS,
    GhostTotals,
    PairSettings,
    Regret,
    compute_regrets,
    explain_incomparable,
    find_operating_points,
    ghost_totals,
    list_tables,
    notes_on_equal_ghosts,
    total_counts,
)
from copem_replay.results.compare.pairing import (
    PairingGrid,
    PairSide,
    build_grid,
    lay_out_configuration,
)
from copem_replay.results.read import Results, open_results
from copem_replay.results.table_files import AGAIN

# The sums of a pair over its logs.


@dataclass
class AllLogs:
    """The sums of a pair, log by log: `alone`: rows that only one side has, (first, second); `differences`: by metric,
    of each log that has one.
    """

    alone: list[tuple[int, int]] = field(default_factory=list)
    differences: dict[str, list[float]] = field(default_factory=dict)
    _regrets: dict[str, list[Regret]] = field(default_factory=dict)

    def add(
        self,
        first: PairSide,
        second: PairSide,
        regrets: Sequence[Regret],
        *,
        more: bool,
        over_runs: bool = False,
    ) -> None:
        """Add a log with its regrets. `more`: there are other logs. `over_runs`: intervals are over runs."""
        self.alone.append((int((first.there & ~second.there).sum()), int((second.there & ~first.there).sum())))
        for regret in regrets:
            # Runs and passes stay apart for a single object: they are the clusters if no log has another.
            runs = over_runs or regret.counts[0][0] <= 1
            figure = regret.figure.condensed(runs=runs) if more else regret.figure
            self._regrets.setdefault(regret.metric, []).append(replace(regret, figure=figure))

    @property
    def counts(self) -> tuple[int, int, int]:
        """How many logs, objects and passes both sides have rows of."""
        of_logs = next(iter(self._regrets.values()), [])
        return total_counts(counts for regret in of_logs for counts in regret.counts)

    def count_better(self, metric: str) -> int:
        """The number of logs whose own difference is for the better."""
        return sum(COMPARED[metric].better * difference > 0 for difference in self.differences.get(metric, ()))

    def regrets(self, weigh: str | None) -> Iterator[Regret]:
        """The regret of every metric over all logs. `weigh`: `drives`: each log counts as much as another."""
        for of_logs in self._regrets.values():
            regret = Regret.joined(of_logs)
            once = weigh == DRIVES and len(of_logs) > 1 and COMPARED[regret.metric].part not in OF_LISTS
            yield replace(regret, figure=regret.figure.each_drive_once()) if once else regret


@dataclass(frozen=True)
class PairsAsked:
    """Of which rows differences are asked, and their intervals. `episodes`: by log the object and episode of each that
    is meant, or all of a log (None); no logs but these; None: all logs. `every`: all of these count, however they
    began. `over_runs`: intervals are over runs of the logs. `weigh`: what counts alike; None: as `measure.weigh`.
    """

    episodes: Mapping[str, Collection[tuple[str, int]] | None] | None = None
    every: bool = False
    over_runs: bool = False
    confidence: float = CONFIDENCE
    weigh: str | None = None

    def restrict(self, log: str, grid: PairingGrid, side: PairSide) -> PairSide:
        """A side of a pair with the cells that are asked for alone; ghosts belong to whole logs."""
        counted = (
            side.there & (side.rows["ended_s"] - side.rows["onset_s"] > SAME_INSTANT_S) if self.every else side.counted
        )
        if self.episodes is None or (kept := self.episodes.get(log, ())) is None:
            return replace(side, counted=counted)
        asked = np.repeat(np.array([episode in kept for episode in grid.episodes], dtype=bool), grid.runs)
        return replace(side, there=side.there & asked, counted=counted & asked, lists=None)


# The results folders of a comparison.


def read_folders(given: Sequence[Path | Results]) -> list[Results]:
    """Results folders; open ones are not read again. Raises InputError, a line for each folder that cannot be read or
    is given twice.
    """
    folders: list[Results] = []
    problems: list[str] = []
    seen: dict[str, Path] = {}
    for folder in given:
        path = folder.place if isinstance(folder, Results) else folder
        if (place := os.path.realpath(path)) in seen:
            problems.append(f"{path}: expected each folder once, found it twice ({seen[place]})")
            continue
        seen[place] = path
        try:
            folders.append(_read_folder(folder))
        except InputError as error:
            problems += error.problems
    if problems:
        raise InputError(problems)
    if not folders:
        raise InputError("compare: expected a results folder, found none")
    return folders


def _read_folder(folder: Path | Results) -> Results:
    results = folder if isinstance(folder, Results) else open_results(folder)
    results.source  # noqa: B018
    results.by_log  # noqa: B018  # damage is found here
    return results


# Notes on a comparison: what is left out, and why.


def notes_on_pairs(baseline: LabelledConfiguration, pairs: Mapping[LabelledConfiguration, AllLogs]) -> Iterator[str]:
    """Notes on rows without a partner."""
    for labelled, pair in pairs.items():
        counts = np.sum(pair.alone, axis=0).tolist()
        for (one_side, other), count in zip(((labelled, baseline), (baseline, labelled)), counts, strict=True):
            if count:
                yield f"{count_noun(count, 'row')} of {one_side.label} left out: {other.label} has no such object"


def notes_on_frames(table: pd.DataFrame) -> Iterator[str]:
    """A note on pairs without a frame from which on both sides have issued a list."""
    rows = table.loc[table["frames"] == 0, ["log", "configuration"]].drop_duplicates()
    for log, labels in rows.groupby("log", sort=False)["configuration"]:
        where = "" if log == ALL else f"log {log}: "
        yield f"{where}{', '.join(labels)}: no frame at which an object is measured and both sides have issued a list"


_FEW_HAVE_IT = (
    f"fewer than {FEWEST_LOGS} logs, {FEWEST_CLUSTERS} objects of one log, or passes or runs of one object, "
    "have it, or too few for its limits"
)


def notes_on_rows(table: pd.DataFrame, pairs: Iterable[AllLogs], asked: float | None) -> Iterator[str]:
    """Notes on missing intervals, on decisive logs, and on configurations with fewer ghosts than `asked` a minute."""
    counts = [of.counts for of in pairs]
    none = [count for count in counts if count[0] and choose_over(*count) is None]
    why = f"{explain_no_clusters(*none[0])}; {NOT_ENOUGH}" if none else None
    overall = table.drop_duplicates(["configuration", "metric"])
    without = overall[overall["difference"].notna() & overall["interval"].isna()]
    with_interval = set(overall.loc[overall["interval_over"].notna(), "configuration"])
    nameless = (without["metric"] == "false_positives_per_min") & without["configuration"].isin(with_interval)
    if nameless.any():
        yield (
            "no interval of false_positives_per_min: without accuracy.parquet it is not known which object a ghost is "
            "nearest to"
        )
    without = without[~nameless]
    if len(without):
        metrics = ", ".join(dict.fromkeys(without["metric"]))
        yield f"no interval of {metrics}: {why or _FEW_HAVE_IT}"
    decisive = overall[overall["hangs_on"].notna()]
    for log, rows in decisive.groupby("hangs_on", sort=False):
        listed = (f"{row.metric} of {row.configuration} {row.difference_without_it:+.3g}" for row in rows.itertuples())
        yield f"hangs on log {log}; without it: {', '.join(listed)}"
    ghosts = overall[overall["metric"] == "ttd_rmst_s_equal_ghosts"]
    fewer = ghosts[ghosts["ghosts_kept_per_min"] < asked * (1 - 1e-9)] if asked is not None else ghosts[:0]
    for rate, rows in fewer.groupby("ghosts_kept_per_min", sort=False):
        yield (
            f"{', '.join(rows['configuration'])}: all entries make only {rate:.4g} ghosts per minute: "
            "ttd_rmst_s_equal_ghosts is at that rate"
        )


ALL = "all"
"""The value of the column `log` for all logs together."""


@dataclass(frozen=True)
class Comparison:
    """Differences to a baseline: a row per log (`all`, and each where there are several), configuration and metric.

    What the columns of `table` mean: docs/reference/columns.md; null where there is none. Times are up to `horizon_s`,
    those at equal ghosts at `false_positives_per_min`. `baseline_why`: why it is the baseline, None if it was asked
    for. `notes`: what has to be said, a line each. `groups`: a row per group, configuration and metric, with `by` and
    `group` in place of the log; None: not asked for. `truths`: labels of the ground truth. `decide`: the one metric
    that was named to decide; None: all. `matters`: by metric the least difference that matters.

    >>> comparison = cr.compare("out/tc016d", baseline="PEM")
    >>> comparison.baseline, comparison.configurations
    ('PEM', ('GT', 'coPEM:0s', 'coPEM:0.5s', 'coPEM:1s', 'coPEM:1.5s'))
    """

    table: pd.DataFrame
    baseline: str
    baseline_why: str | None
    configurations: tuple[str, ...]
    horizon_s: float
    false_positives_per_min: float | None
    notes: tuple[str, ...]
    groups: pd.DataFrame | None = None
    truths: tuple[str, ...] = ()
    decide: str | None = None
    matters: Mapping[str, float] = field(default_factory=dict)

    @property
    def overall(self) -> pd.DataFrame:
        """The rows of all logs."""
        return self.table.drop_duplicates(["configuration", "metric"])  # they come first, and a log may be named `all`


def compare_folders(
    folders: Sequence[Path | Results],
    *,
    configurations: Sequence[str] | None = None,
    baseline: str | None = None,
    false_positives_per_min: float | None = None,
    metrics: Sequence[str] | None = None,
    by: Sequence[str] | None = None,
    asked: PairsAsked = PairsAsked(),
    decide: str | None = None,
    matters: Mapping[str, float] | None = None,
) -> Comparison:
    """Compare configurations (None: all) with a baseline, pair by pair, in some metrics (None: all).

    `by`: entries by which each group is compared for itself, too. `decide`: only this metric is to have a star.
    `matters`: by metric the least difference that matters, which gives each a word.

    `baseline`: None: the configuration named `ideal`, else the ideal fusion of the same inputs, else the first that is
    not the truth. `false_positives_per_min`: at which times to detection are compared once more; None: as many as the
    baseline has. Raises InputError, a line for every reason why something cannot be read or compared.
    """
    _check_rate(false_positives_per_min)
    _check_named(decide, matters or {})
    read = read_folders(folders)
    check_comparable(read)
    read, renames = rename_logs(read)
    known = label_configurations(read)
    against, *others = choose_configurations(known, configurations, baseline)
    check_log_names(against, others, renames)
    used = list(dict.fromkeys(labelled.results for labelled in (against, *others)))
    logs, runs = [log.name for log in read[0].provenance.logs], min(folder.provenance.runs for folder in read)
    own_rate = false_positives_per_min is None
    of_ghosts = not own_rate or "thresholds.parquet" in list_tables(metrics)
    totals = ghost_totals((against, *others), logs, runs) if of_ghosts else {}
    if own_rate and against in totals:
        false_positives_per_min = totals[against].per_min
    horizon_s, horizon_notes = _settle_horizon(used)
    setting = PairSettings(horizon_s, float(read[0].provenance.measure["gospa"]["power"]))
    settings, reasons = _settle_ghosts(setting, against, others, totals, false_positives_per_min, asked=not own_rate)
    groups = EpisodeGroups(read[0], by or ())
    asked = replace(asked, weigh=asked.weigh or read[0].provenance.measure.get("weigh", OBJECTS))
    names = ClusterNames(logs, [], runs)
    remembering = find_remembering(known, against, others) if baseline is None else {}
    stars = Stars(decide, matters or {})
    pairs, rows, of_groups = _compare_each_log(against, settings, names, metrics, groups, asked, remembering, stars)
    table = COMPARISON.frame(rows)
    return Comparison(
        table=table,
        baseline=against.label,
        baseline_why=choose_baseline(known)[1] if baseline is None else None,
        configurations=tuple(labelled.label for labelled in others),
        horizon_s=setting.horizon_s,
        false_positives_per_min=false_positives_per_min,
        groups=_tabulate_groups(against, remembering, of_groups, names, groups, stars, asked.weigh) if by else None,
        decide=decide,
        matters=matters or {},
        truths=tuple(labelled.label for labelled in (against, *others) if labelled.facts.truth),
        notes=(
            *notes_on_folders(used),
            *horizon_notes,
            *notes_on_differences(used, renames),
            *notes_on_pairs(against, pairs),
            *notes_on_output_baseline(against, others),
            *notes_on_remembering(remembering),
            *notes_on_frames(table),
            *notes_on_equal_ghosts(reasons),
            *notes_on_rows(table, pairs.values(), false_positives_per_min),
        ),
    )


def _check_rate(false_positives_per_min: float | None) -> None:
    """Raise InputError where the rate that the user asked for is no rate."""
    if false_positives_per_min is not None and not 0 <= false_positives_per_min < math.inf:
        raise InputError(
            f"--false-positives-per-min: expected a number of at least 0, found {false_positives_per_min:g}"
        )


def _check_named(decide: str | None, matters: Mapping[str, float]) -> None:
    """Raise InputError where a metric is not compared, or a least difference is none."""
    for option, name in (("--decide", decide), *(("--matters", name) for name in matters)):
        if name is not None and name not in COMPARED:
            raise InputError(f"{option}: {unknown_name_message('metric', name, COMPARED)}")
    for name, least in matters.items():
        if not 0 < least < math.inf:
            raise InputError(f"--matters: {name}: expected a number above 0, found {least:g}")


@dataclass(frozen=True)
class Stars:
    """How the stars of a table are held: over all its differences, or those of the metric that was named to `decide`.

    `matters`: by metric the least difference that matters.
    """

    decide: str | None
    matters: Mapping[str, float]

    def mark(self, rows: Sequence[dict[str, Any]], limit: Sequence[Callable[[float], Mapping[str, object]]]) -> None:
        """Give rows, of one table, the columns `star` and `word`; `limit`: of each its limits at a confidence."""
        asked = [k for k, row in enumerate(rows) if self.decide in (None, row["metric"])]
        number = sum(rows[k]["difference"] is not None for k in asked)
        alone = {k for k, row in enumerate(rows) if is_off_zero(row)}
        may = [k for k in asked if k in alone]
        held = {may[k] for k in find_stars(number, [limit[k] for k in may])}
        for k, row in enumerate(rows):
            row["star"] = STAR if k in held else ALONE if k in alone else None
            if row["metric"] in self.matters and row["difference"] is not None:
                row["word"] = describe_difference(row, COMPARED[row["metric"]].better, self.matters[row["metric"]])


def _settle_ghosts(
    setting: PairSettings,
    against: LabelledConfiguration,
    others: Sequence[LabelledConfiguration],
    totals: Mapping[LabelledConfiguration, GhostTotals],
    per_min: float | None,
    *,
    asked: bool,
) -> tuple[dict[LabelledConfiguration, PairSettings], dict[str, str | None]]:
    """The settings of each pair, with operating points at equal ghosts; by label why there are none, None: there are.

    `asked`: whether the user asked for the rate `per_min`; else it is that of the baseline.
    """
    settings, reasons = {}, {}
    for labelled in others:
        both = totals.get(labelled), totals.get(against)
        why = explain_incomparable(*both, per_min, asked=asked, truth=against.facts.truth)
        kept = None if why is not None else find_operating_points(*both, per_min)
        reasons[labelled.label], settings[labelled] = why, replace(setting, kept=kept)
    return settings, reasons


def _compare_each_log(
    against: LabelledConfiguration,
    settings: Mapping[LabelledConfiguration, PairSettings],
    names: ClusterNames,
    metrics: Sequence[str] | None,
    groups: EpisodeGroups,
    asked: PairsAsked,
    remembering: Remembering,
    stars: Stars,
) -> tuple[dict[LabelledConfiguration, AllLogs], list[dict[str, object]], GroupPairs]:
    """The sums of each pair over the logs of `names`; rows of all logs, then of each log where there are several; the
    sums of each group.

    The objects of the logs are appended to `names`.
    """
    logs, pairs, of_groups = names.logs, {labelled: AllLogs() for labelled in settings}, GroupPairs()
    rows: list[dict[str, object]] = []
    for k, log in enumerate(logs):
        tables = {
            results: results.rows_of(log, list_tables(metrics))
            for results in dict.fromkeys(labelled.results for labelled in (against, *pairs))
        }
        detections = (of_folder["detections.parquet"] for of_folder in tables.values())
        grid = build_grid(k, detections, names.runs, len(names.objects))
        names.objects.extend(f"{log}\n{name}" for name in grid.objects)
        second, *remembered = (
            asked.restrict(log, grid, lay_out_configuration(one, tables[one.results], grid))
            for one in (against, *remembering.values())
        )
        held_against = dict(zip(remembering, remembered, strict=True))
        for labelled, pair in pairs.items():
            first = asked.restrict(log, grid, lay_out_configuration(labelled, tables[labelled.results], grid))
            _check_same_episodes(labelled, first, against, second, log, grid)
            _check_same_frames(labelled, first, against, second, log)
            regrets = _compute_regrets(first, second, held_against.get(labelled), grid, settings[labelled], metrics)
            pair.add(first, second, regrets, more=len(logs) > 1, over_runs=asked.over_runs)
            for regret in regrets if len(logs) > 1 else ():
                values = regret.figure.values()
                pair.differences.setdefault(regret.metric, []).append(values[2])
                baseline = _baseline_of(regret.metric, labelled, against, remembering)
                rows.append({"log": log, **_make_row(regret, values, labelled, baseline, names, asked)})
            for group, kept in groups.select(log, grid):
                one, other = (groups.restrict(group, kept, side) for side in (first, second))
                held = held_against.get(labelled)
                held = None if held is None else groups.restrict(group, kept, held)
                regrets = _compute_regrets(one, other, held, grid, settings[labelled], metrics)
                of_pair = of_groups.setdefault(group, {}).setdefault(labelled, AllLogs())
                of_pair.add(one, other, regrets, more=len(logs) > 1)
    overall, limit = _overall_rows(against, remembering, pairs, names, asked)
    stars.mark(overall, limit)
    return pairs, [*overall, *rows], of_groups


Remembering = Mapping[LabelledConfiguration, LabelledConfiguration]
"""The ideal fusions with memory that accuracy is held against, by configuration."""


def _compute_regrets(
    first: PairSide,
    second: PairSide,
    remembered: PairSide | None,
    grid: PairingGrid,
    setting: PairSettings,
    metrics: Sequence[str] | None,
) -> list[Regret]:
    """The metrics of a log; what is held against what is `remembered`, None: as all others against the second side."""
    regrets = list(compute_regrets(first, second, grid, setting, metrics))
    if remembered is None:
        return regrets
    asked = [name for name in HELD_METRICS if metrics is None or name in metrics]
    held = {regret.metric: regret for regret in compute_regrets(first, remembered, grid, setting, asked)}
    return [held.get(regret.metric, regret) for regret in regrets]


def _baseline_of(
    metric: str, labelled: LabelledConfiguration, against: LabelledConfiguration, remembering: Remembering
) -> LabelledConfiguration:
    """What a configuration is held against in a metric."""
    return remembering.get(labelled, against) if metric in HELD_METRICS else against


GroupPairs = dict[int, dict[LabelledConfiguration, AllLogs]]
"""Sums of pairs by group."""


def _tabulate_groups(
    against: LabelledConfiguration,
    remembering: Remembering,
    of_groups: GroupPairs,
    names: ClusterNames,
    groups: EpisodeGroups,
    stars: Stars,
    weigh: str | None,
) -> pd.DataFrame:
    """The rows of `Comparison.groups`; those of an entry are one table."""
    rows: list[dict[str, Any]] = []
    limit: list[Callable[[float], Mapping[str, object]]] = []
    for k, (by, group) in enumerate(groups.named):
        found, of_found = _overall_rows(against, remembering, of_groups.get(k, {}), names, PairsAsked(weigh=weigh))
        rows += [{"by": by.label, "group": group, **without_limits_over_runs(row)} for row in found]
        limit += of_found
    for label in {row["by"] for row in rows}:
        of_entry = [k for k, row in enumerate(rows) if row["by"] == label]
        stars.mark([rows[k] for k in of_entry], [limit[k] for k in of_entry])
    table = COMPARISON.frame(rows).drop(columns="log")
    for place, name in enumerate(("by", "group")):
        table.insert(place, name, pd.Series([row[name] for row in rows], dtype=object))
    return table


def _overall_rows(
    against: LabelledConfiguration,
    remembering: Remembering,
    pairs: Mapping[LabelledConfiguration, AllLogs],
    names: ClusterNames,
    asked: PairsAsked,
) -> tuple[list[dict[str, Any]], list[Callable[[float], Mapping[str, object]]]]:
    """The rows of all logs, and of each its limits at a confidence.

    Of intervals over logs: how many logs are better, and on which the difference hangs.
    """
    rows: list[dict[str, Any]] = []
    limit: list[Callable[[float], Mapping[str, object]]] = []
    for labelled, pair in pairs.items():
        for regret in pair.regrets(asked.weigh):
            values = regret.figure.values()
            baseline = _baseline_of(regret.metric, labelled, against, remembering)
            row: dict[str, Any] = {"log": ALL, **_make_row(regret, values, labelled, baseline, names, asked)}
            if row.get("interval_over") == "logs":
                row["logs_better"] = pair.count_better(regret.metric)
                if (decisive := find_decisive_log(regret.figure, values[2], names)) is not None:
                    row["hangs_on"], row["difference_without_it"] = decisive[0], _number_or_none(decisive[1])
            rows.append(row)
            limit.append(partial(_limit_difference, regret, values[2], (labelled, baseline), names, asked))
    return rows, limit


def _limit_difference(
    regret: Regret, difference: float, sides: tuple[LabelledConfiguration, LabelledConfiguration], names: ClusterNames,
    asked: PairsAsked, confidence: float,
) -> dict[str, object]:  # fmt: skip
    """The columns of a difference's limits at a confidence; no limit is where the difference cannot be."""
    over = "runs" if asked.over_runs else regret.over
    what = "fixed_verdicts" if regret.metric == "pass_share" else "fixed"
    fixed = all(getattr(side.facts, what) for side in sides)
    limits = difference_limits(regret.figure, difference, over, names, fixed=fixed, confidence=confidence)
    sign = COMPARED[regret.metric].better * (_is_never_worse(*sides) - _is_never_worse(*sides[::-1]))
    if sign * difference < 0 or regret.metric not in _IN_TIME or not sign:
        return limits
    least, most = (0.0, math.inf) if sign > 0 else (-math.inf, 0.0)
    ends: dict[str, Any] = {name: limits.get(name) for name in ("low", "high", "low_bounded", "high_bounded")}
    return limits | {name: min(max(end, least), most) for name, end in ends.items() if end is not None}


_IN_TIME = ("detected_share", "ttd_rmst_s", "ttd_both_s", "unknown_to_horizon_s")
"""Metrics in which nothing is better than the truth, nor than ideal fusion of the same lists, row by row."""


def _is_never_worse(one: LabelledConfiguration, other: LabelledConfiguration) -> bool:
    """Whether one knows every object at the instant at which the other does, or before, whatever is drawn."""
    facts = other.facts
    of_inputs = one.results is other.results and (facts.ideal, facts.ideal_of) == (one.configuration, "inputs")
    return one.facts.truth or (of_inputs and not facts.recorded)


def _settle_horizon(folders: Sequence[Results]) -> tuple[float, list[str]]:
    """The horizon in seconds, the shortest that any folder has, and a note where they differ."""
    used_s = {str(folder.place): folder.provenance.horizon_used_s for folder in folders}
    horizon_s = min(used_s.values())
    if horizon_s == max(used_s.values()):
        return horizon_s, []
    has = ", ".join(f"{path} {one_s:.4g} s" for path, one_s in used_s.items())
    return horizon_s, [f"other horizons ({has}): times are up to {horizon_s:.4g} s"]


def _check_same_episodes(
    labelled: LabelledConfiguration,
    first: PairSide,
    against: LabelledConfiguration,
    second: PairSide,
    log: str,
    grid: PairingGrid,
) -> None:
    """Raise InputError where an episode begins or ends at another instant, so that its rows are no pair."""
    if labelled.results is against.results:
        return
    both = first.there & second.there
    for what in ("onset_s", "ended_s"):
        found, expected = first.rows[what], second.rows[what]
        other = np.flatnonzero(both & (np.abs(found - expected) > SAME_INSTANT_S))
        if len(other):
            name = grid.episodes[other[0] // grid.runs][0]
            raise InputError(
                f"{labelled.results.place}: log {log}: object {name}: expected {what} {expected[other[0]]:g} as in "
                f"{against.results.place}, found {found[other[0]]:g}: not the same ego, recording or units"
            )


def _check_same_frames(
    labelled: LabelledConfiguration,
    first: PairSide,
    against: LabelledConfiguration,
    second: PairSide,
    log: str,
) -> None:
    """Raise InputError where what is held is told at other frames, so that its values are no pairs."""
    both = first.there & second.there
    if first.accuracy is None or second.accuracy is None or not both.any():
        return
    found, expected = first.accuracy, second.accuracy
    same = len(found.frame_s) == len(expected.frame_s)
    same = same and bool((np.abs(found.frame_s - expected.frame_s) <= SAME_INSTANT_S).all())
    for name in ("first", "length"):
        same = same and np.array_equal(getattr(found, name)[both], getattr(expected, name)[both])
    if not same:
        raise InputError(
            f"{labelled.results.place}: log {log}: {labelled.configuration}: expected the frames of "
            f"{against.configuration} in {against.results.place}, found others; {AGAIN}"
        )


def _make_row(
    regret: Regret,
    values: tuple[float, float, float],
    labelled: LabelledConfiguration,
    against: LabelledConfiguration,
    names: ClusterNames,
    asked: PairsAsked,
) -> dict[str, object]:
    """The row of a regret with its `values`, of one log or all."""
    figure, (value, baseline_value, difference) = regret.figure, values
    row: dict[str, object] = {"configuration": labelled.label, "baseline": against.label, "metric": regret.metric}
    row |= {
        "value": _number_or_none(value),
        "baseline_value": _number_or_none(baseline_value),
        "n": int(figure.items["n"].sum()),
    }
    row |= {"difference": _number_or_none(difference), "star": None, "word": None}
    row |= _limit_difference(regret, difference, (labelled, against), names, asked, asked.confidence)
    if "only" in figure.items.columns:
        only = figure.items["only"].sum(axis=0)
        row |= {"only_configuration": int(only[0]), "only_baseline": int(only[1])}
    if figure.share and len(figure.items["n"]):
        row["p_value"] = mcnemar_p_value(*map(int, figure.items["only"].sum(axis=0)))
    if regret.held is not None:
        row |= regret.held.columns()
    if regret.kept is not None:
        for name, kept in zip(("", "baseline_"), regret.kept, strict=True):
            row[f"{name}existence"], row[f"{name}ghosts_kept_per_min"] = kept.existence, kept.false_positives_per_min
    return row


def _number_or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None

"""The comparison of configurations with a baseline, on the same logs, objects and runs, within or across folders.

Each configuration has its own baseline: one for all, or itself in an older folder.

Folders are checked for what they must have in common: the recordings, the random numbers, and what is measured how.
Logs are read one by one, so that no rows are kept but their sums.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from copem_replay.core.errors import InputError, count_noun, unknown_name_message
from copem_replay.core.tracks import SAME_INSTANT_S
from copem_replay.metrics.braking.driving import SHARE
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
    Pairs,
    check_comparable,
    check_log_names,
    find_baseline,
    find_remembering,
    label_configurations,
    name_folders,
    notes_on_differences,
    notes_on_folders,
    notes_on_missing,
    notes_on_output_baseline,
    notes_on_remembering,
    pair_configurations,
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
    of each log that has one. `same`: whether both sides have the same rows.
    """

    alone: list[tuple[int, int]] = field(default_factory=list)
    differences: dict[str, list[float]] = field(default_factory=dict)
    same: bool = True
    _regrets: dict[str, list[Regret]] = field(default_factory=dict)

    def add(
        self, first: PairSide, second: PairSide, regrets: Sequence[Regret], *, several: bool, over_runs: bool = False
    ) -> None:
        """Add a log with its regrets. `several`: there are other logs. `over_runs`: intervals are over runs."""
        self.alone.append((int((first.there & ~second.there).sum()), int((second.there & ~first.there).sum())))
        self.same = self.same and first.has_rows_of(second)
        for regret in regrets:
            # Runs and passes stay apart for a single object: they are the clusters if no log has another.
            runs = over_runs or regret.counts[0][0] <= 1
            figure = regret.figure.condensed(runs=runs) if several else regret.figure
            self._regrets.setdefault(regret.metric, []).append(replace(regret, figure=figure))

    @property
    def counts(self) -> tuple[int, int, int]:
        """The number of logs, objects and passes of which both sides have rows."""
        of_logs = next(iter(self._regrets.values()), [])
        return total_counts(counts for regret in of_logs for counts in regret.counts)

    def count_better(self, metric: str) -> int:
        """The number of logs in which the configuration is better."""
        return sum(COMPARED[metric].better * difference > 0 for difference in self.differences.get(metric, ()))

    def regrets(self, weigh: str | None) -> Iterator[Regret]:
        """The regret of every metric over all logs. `weigh`: `drives`: each log counts as much as another."""
        for of_logs in self._regrets.values():
            regret = Regret.joined(of_logs)
            once = weigh == DRIVES and len(of_logs) > 1 and COMPARED[regret.metric].part not in OF_LISTS
            yield replace(regret, figure=regret.figure.each_drive_once()) if once else regret


@dataclass(frozen=True)
class PairsAsked:
    """The rows and intervals of a comparison. `episodes`: by log the objects and episodes to compare, or all of a log
    (None); None: all logs. `every`: all of these count, however they began. `over_runs`: intervals are over runs of the
    logs. `weigh`: what counts alike; None: as `measure.weigh`. `by_log`: there are also rows of each log.
    """

    episodes: Mapping[str, Collection[tuple[str, int]] | None] | None = None
    every: bool = False
    over_runs: bool = False
    confidence: float = CONFIDENCE
    weigh: str | None = None
    by_log: bool = True

    def restrict(self, log: str, grid: PairingGrid, side: PairSide) -> PairSide:
        """A side of a pair with only the requested cells; ghosts belong to whole logs."""
        counted = side.counted_however_begun if self.every else side.counted
        if self.episodes is None or (kept := self.episodes.get(log, ())) is None:
            return replace(side, counted=counted)
        asked = np.repeat(np.array([episode in kept for episode in grid.episodes], dtype=bool), grid.runs)
        return replace(side, there=side.there & asked, counted=counted & asked, lists=None)


# The results folders of a comparison.


def read_folders(inputs: Sequence[Path | Results]) -> list[Results]:
    """Results folders; open ones are not read again. Raises InputError, a line per unreadable or repeated folder."""
    folders: list[Results] = []
    problems: list[str] = []
    first_path: dict[str, Path] = {}
    for folder in inputs:
        path = folder.place if isinstance(folder, Results) else folder
        if (place := os.path.realpath(path)) in first_path:
            problems.append(f"{path}: expected each folder once, found it twice ({first_path[place]})")
            continue
        first_path[place] = path
        try:
            results = folder if isinstance(folder, Results) else open_results(folder)
            folders.append(results)
            results.source, results.by_log  # noqa: B018  # damage is found here
        except InputError as error:
            problems += error.problems
    if problems:
        raise InputError(problems)
    if not folders:
        raise InputError("compare: expected a results folder, found none")
    return folders


# Notes on a comparison: what is left out, and why.


def notes_on_pairs(pairs: Pairs, sums: Mapping[LabelledConfiguration, AllLogs]) -> Iterator[str]:
    """Notes on rows without a partner."""
    for labelled, baseline in pairs.items():
        counts = np.sum(sums[labelled].alone, axis=0).tolist()
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


def notes_on_rows(table: pd.DataFrame, pairs: Iterable[AllLogs], per_min: float | None) -> Iterator[str]:
    """Notes on missing intervals, on decisive logs, and on configurations with fewer ghosts than `per_min` a minute.

    None: than their baselines.
    """
    counts = [of.counts for of in pairs]
    none = [count for count in counts if count[0] and choose_over(*count) is None]
    why = f"{explain_no_clusters(*none[0])}; {NOT_ENOUGH}" if none else None
    overall = table.drop_duplicates(["configuration", "metric"])
    no_interval = overall[overall["difference"].notna() & overall["interval"].isna()]
    with_interval = set(overall.loc[overall["interval_over"].notna(), "configuration"])
    nameless = (no_interval["metric"] == "false_positives_per_min") & no_interval["configuration"].isin(with_interval)
    if nameless.any():
        yield (
            "no interval of false_positives_per_min: without accuracy.parquet it is not known which object a ghost is "
            "nearest to"
        )
    no_interval = no_interval[~nameless]
    if len(no_interval):
        metrics = ", ".join(dict.fromkeys(no_interval["metric"]))
        yield f"no interval of {metrics}: {why or _FEW_HAVE_IT}"
    decisive = overall[overall["hangs_on"].notna()]
    for log, rows in decisive.groupby("hangs_on", sort=False):
        listed = (f"{row.metric} of {row.configuration} {row.difference_without_it:+.3g}" for row in rows.itertuples())
        yield f"hangs on log {log}; without it: {', '.join(listed)}"
    ghosts = overall[overall["metric"] == "ttd_rmst_s_equal_ghosts"]
    rates = ghosts["baseline_ghosts_kept_per_min"] if per_min is None else per_min
    fewer = ghosts[ghosts["ghosts_kept_per_min"] < rates * (1 - 1e-9)]
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

    Of several folders without a baseline that is asked for, each configuration is held against itself in the first
    one, whose name is `baseline`. `newer`: names of the others. `unchanged`: configurations whose rows are the same.

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
    newer: tuple[str, ...] = ()
    unchanged: tuple[str, ...] = ()

    @property
    def changed(self) -> Comparison:
        """The comparison without configurations that are unchanged."""
        names = tuple(name for name in self.configurations if name not in self.unchanged)
        table, groups = (of if of is None else of[of["configuration"].isin(names)] for of in (self.table, self.groups))
        return replace(self, configurations=names, table=table, groups=groups)

    @cached_property
    def overall(self) -> pd.DataFrame:
        """The rows of all logs."""
        return self.table.drop_duplicates(["configuration", "metric"])  # they come first, and a log may be named `all`


def compare_folders(
    folders: Sequence[Path | Results], *, configurations: Sequence[str] | None = None, baseline: str | None = None,
    false_positives_per_min: float | None = None, metrics: Sequence[str] | None = None,
    by: Sequence[str] | None = None, asked: PairsAsked = PairsAsked(), decide: str | None = None,
    matters: Mapping[str, float] | None = None,
) -> Comparison:  # fmt: skip
    """Compare configurations (None: all) with their baselines, pair by pair, in some metrics (None: all).

    The others as in `compare` of the API. Raises InputError, a line for every reason why something cannot be read or
    compared.
    """
    _check_rate(false_positives_per_min)
    _check_named(decide, matters or {})
    read = read_folders(folders)
    check_comparable(read)
    read, renames = rename_logs(read)
    pairs = pair_configurations(read, configurations, baseline)
    check_log_names(pairs, renames)
    older, *newer = name_folders(read) if baseline is None and len(read) > 1 else [""]
    if len(newer) == 1:  # the name alone says which one it is
        pairs = {replace(labelled, label=labelled.configuration): other for labelled, other in pairs.items()}
    sides = list(dict.fromkeys(labelled for pair in pairs.items() for labelled in reversed(pair)))  # baselines first
    used_results = list(dict.fromkeys(labelled.results for labelled in sides))
    logs, runs = [log.name for log in read[0].provenance.logs], min(folder.provenance.runs for folder in read)
    horizon_s, horizon_notes = _settle_horizon(used_results)
    setting = PairSettings(horizon_s, float(read[0].provenance.measure["gospa"]["power"]))
    of_ghosts = false_positives_per_min is not None or "thresholds.parquet" in list_tables(metrics)
    totals = ghost_totals(sides, logs, runs) if of_ghosts else {}
    settings, reasons = _settle_ghosts(setting, pairs, totals, false_positives_per_min)
    if false_positives_per_min is None and not newer and sides[0] in totals:
        false_positives_per_min = totals[sides[0]].per_min
    groups = EpisodeGroups(read[0], by or ())
    asked = replace(asked, weigh=asked.weigh or read[0].provenance.measure.get("weigh", OBJECTS))
    remembering = find_remembering(label_configurations(read), pairs) if baseline is None and not newer else {}
    pair_rows = PairRows(pairs, remembering, ClusterNames(logs, [], runs), asked)
    sums, of_logs, of_groups = _compare_each_log(pair_rows, settings, metrics, groups)
    rows, limit = pair_rows.of_all_logs(sums)
    moved = {row["configuration"] for row in rows if row["difference"]}
    unchanged = [one.label for one in pairs if newer and sums[one].same and one.label not in moved]
    stars = Stars(decide, matters or {}, unchanged)
    stars.mark(rows, limit)
    table = COMPARISON.frame([*rows, *of_logs])
    why = "each configuration against itself there" if newer else None
    if not newer and baseline is None:
        why = find_baseline(read[0].facts, [sides[0].configuration, *(one.configuration for one in pairs)]).why
    return Comparison(
        table=table,
        baseline=older or sides[0].label,
        baseline_why=why,
        configurations=tuple(labelled.label for labelled in pairs),
        horizon_s=setting.horizon_s,
        false_positives_per_min=false_positives_per_min,
        groups=_tabulate_groups(pair_rows, of_groups, groups, stars) if by else None,
        decide=decide,
        matters=matters or {},
        truths=tuple(labelled.label for labelled in sides if labelled.facts.truth),
        newer=tuple(newer),
        unchanged=tuple(unchanged),
        notes=(
            *notes_on_folders(used_results),
            *horizon_notes,
            *notes_on_differences(used_results, renames),
            *(notes_on_missing(read) if newer and configurations is None else ()),
            *notes_on_pairs(pairs, sums),
            *notes_on_output_baseline(pairs),
            *notes_on_remembering(remembering),
            *notes_on_frames(table),
            *notes_on_equal_ghosts(reasons),
            *notes_on_rows(table, sums.values(), false_positives_per_min),
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
    """How differences get a star: all of a table held together, or those of the one metric named to `decide`.

    `matters`: by metric the least difference that matters. `without`: configurations in which nothing can differ.
    """

    decide: str | None
    matters: Mapping[str, float]
    without: Sequence[str] = ()

    def mark(self, rows: Sequence[dict[str, Any]], limit: Sequence[Callable[[float], Mapping[str, object]]]) -> None:
        """Set `star` and `word` in each row of a table; `limit[k](confidence)` gives the interval columns of row k."""
        may_differ = (k for k, row in enumerate(rows) if row["configuration"] not in self.without)
        decided = [k for k in may_differ if self.decide in (None, rows[k]["metric"])]
        difference_count = sum(rows[k]["difference"] is not None for k in decided)
        off_zero = {k for k, row in enumerate(rows) if is_off_zero(row)}
        decided_off_zero = [k for k in decided if k in off_zero]
        starred = {decided_off_zero[k] for k in find_stars(difference_count, [limit[k] for k in decided_off_zero])}
        for k, row in enumerate(rows):
            row["star"] = STAR if k in starred else ALONE if k in off_zero else None
            if row["metric"] in self.matters and row["difference"] is not None:
                row["word"] = describe_difference(row, COMPARED[row["metric"]].better, self.matters[row["metric"]])


def _settle_ghosts(
    setting: PairSettings, pairs: Pairs, totals: Mapping[LabelledConfiguration, GhostTotals], requested: float | None
) -> tuple[dict[LabelledConfiguration, PairSettings], dict[str, str | None]]:
    """By pair its settings with the operating points at equal ghosts; by label why there are none (None: they exist).
    `requested`: ghosts per minute that the user set; None: the rate of each pair's baseline.
    """
    settings, reasons = {}, {}
    for labelled, baseline in pairs.items():
        both = totals.get(labelled), totals.get(baseline)
        per_min = both[1].per_min if requested is None and both[1] is not None else requested
        why = explain_incomparable(*both, per_min, by_user=requested is not None, truth=baseline.facts.truth)
        points = None if why is not None else find_operating_points(*both, per_min)
        reasons[labelled.label], settings[labelled] = why, replace(setting, kept=points)
    return settings, reasons


GroupPairs = dict[int, dict[LabelledConfiguration, AllLogs]]
"""Sums of pairs by group."""


def _compare_each_log(
    pair_rows: PairRows, settings: Mapping[LabelledConfiguration, PairSettings], metrics: Sequence[str] | None,
    groups: EpisodeGroups,
) -> tuple[dict[LabelledConfiguration, AllLogs], list[dict[str, object]], GroupPairs]:  # fmt: skip
    """The figures of each pair summed over logs; the rows of each log, where there are several; the sums by group.
    Appends the objects of each log to the names of clusters.
    """
    names, pairs_asked, pairs, remembering = pair_rows.names, pair_rows.asked, pair_rows.pairs, pair_rows.remembering
    logs, sums, group_sums = names.logs, {labelled: AllLogs() for labelled in pairs}, GroupPairs()
    rows: list[dict[str, object]] = []
    for k, log in enumerate(logs):
        tables = {
            results: results.rows_of(log, list_tables(metrics))
            for results in dict.fromkeys(labelled.results for labelled in (*pairs.values(), *pairs))
        }
        detections = (of_folder["detections.parquet"] for of_folder in tables.values())
        grid = build_grid(k, detections, names.runs, len(names.objects))
        names.objects.extend(f"{log}\n{name}" for name in grid.objects)

        def lay_out(one: LabelledConfiguration, log: str = log, grid: PairingGrid = grid, of: Any = tables) -> PairSide:
            return pairs_asked.restrict(log, grid, lay_out_configuration(one, of[one.results], grid))

        # What several are held against is laid out once, what one is held against is gone after it.
        lay_out_baseline = lru_cache(1 + len({*remembering.values()}))(lay_out)
        for labelled, baseline in pairs.items():
            second, first = lay_out_baseline(baseline), lay_out(labelled)
            remembered = lay_out_baseline(remembering[labelled]) if labelled in remembering else None
            _check_same_episodes(labelled, first, baseline, second, log, grid)
            _check_same_frames(labelled, first, baseline, second, log)
            regrets = _compute_regrets(first, second, remembered, grid, settings[labelled], metrics)
            sums[labelled].add(first, second, regrets, several=len(logs) > 1, over_runs=pairs_asked.over_runs)
            for regret in regrets if len(logs) > 1 and pairs_asked.by_log else ():
                values = regret.figure.values()
                sums[labelled].differences.setdefault(regret.metric, []).append(values[2])
                rows.append({"log": log, **pair_rows.make(labelled, regret, values)})
            for group, cells in groups.select(log, grid):
                first_group, second_group = (groups.restrict(group, cells, side) for side in (first, second))
                beside = None if remembered is None else groups.restrict(group, cells, remembered)
                regrets = _compute_regrets(first_group, second_group, beside, grid, settings[labelled], metrics)
                pair_sums = group_sums.setdefault(group, {}).setdefault(labelled, AllLogs())
                pair_sums.add(first_group, second_group, regrets, several=len(logs) > 1)
    return sums, rows, group_sums


def _compute_regrets(
    first: PairSide, second: PairSide, remembered: PairSide | None, grid: PairingGrid, setting: PairSettings,
    metrics: Sequence[str] | None,
) -> list[Regret]:  # fmt: skip
    """The metrics of a log; what is held against what is `remembered`, None: as all others against the second side."""
    regrets = list(compute_regrets(first, second, grid, setting, metrics))
    if remembered is None:
        return regrets
    asked = [name for name in HELD_METRICS if metrics is None or name in metrics]
    held = {regret.metric: regret for regret in compute_regrets(first, remembered, grid, setting, asked)}
    return [held.get(regret.metric, regret) for regret in regrets]


def _tabulate_groups(pair_rows: PairRows, of_groups: GroupPairs, groups: EpisodeGroups, stars: Stars) -> pd.DataFrame:
    """`Comparison.groups`: a row by group, pair and metric. Stars hold within the rows of one `by` entry."""
    rows: list[dict[str, Any]] = []
    limit: list[Callable[[float], Mapping[str, object]]] = []
    group_rows_maker = replace(pair_rows, asked=PairsAsked(weigh=pair_rows.asked.weigh))
    for k, (by, group) in enumerate(groups.named):
        group_rows, group_limits = group_rows_maker.of_all_logs(of_groups.get(k, {}))
        rows += [{"by": by.label, "group": group, **without_limits_over_runs(row)} for row in group_rows]
        limit += group_limits
    for label in {row["by"] for row in rows}:
        entry_rows = [k for k, row in enumerate(rows) if row["by"] == label]
        stars.mark([rows[k] for k in entry_rows], [limit[k] for k in entry_rows])
    table = COMPARISON.frame(rows).drop(columns="log")
    for place, name in enumerate(("by", "group")):
        table.insert(place, name, pd.Series([row[name] for row in rows], dtype=object))
    return table


@dataclass(frozen=True)
class PairRows:
    """The rows of pairs: the baseline of each configuration, and for accuracy its ideal with memory, `remembering`."""

    pairs: Pairs
    remembering: Pairs
    names: ClusterNames
    asked: PairsAsked

    def of_all_logs(
        self, sums: Mapping[LabelledConfiguration, AllLogs]
    ) -> tuple[list[dict[str, Any]], list[Callable[[float], Mapping[str, object]]]]:
        """The rows over all logs, and for each row a function from a confidence to its interval columns. With an
        interval over logs: also how many logs are better, and the one that decides the sign.
        """
        rows: list[dict[str, Any]] = []
        limit: list[Callable[[float], Mapping[str, object]]] = []
        for labelled, pair in sums.items():
            for regret in pair.regrets(self.asked.weigh):
                values = regret.figure.values()
                row: dict[str, Any] = {"log": ALL, **self.make(labelled, regret, values)}
                if row.get("interval_over") == "logs":
                    row["logs_better"] = pair.count_better(regret.metric)
                    if (decisive := find_decisive_log(regret.figure, values[2], self.names)) is not None:
                        row["hangs_on"], row["difference_without_it"] = decisive[0], _number_or_none(decisive[1])
                rows.append(row)
                limit.append(partial(self._limit, labelled, regret, values))
        return rows, limit

    def make(
        self, labelled: LabelledConfiguration, regret: Regret, values: tuple[float, float, float]
    ) -> dict[str, object]:
        """One row of the comparison table; `values`: of the configuration, of the baseline, and their difference."""
        figure, (value, baseline_value, difference) = regret.figure, map(_number_or_none, values)
        row: dict[str, object] = {
            "configuration": labelled.label, "baseline": self._baseline_of(labelled, regret.metric).label,
            "metric": regret.metric, "value": value, "baseline_value": baseline_value,
            "n": int(figure.items["n"].sum()), "difference": difference, "star": None, "word": None,
        }  # fmt: skip
        row |= self._limit(labelled, regret, values, self.asked.confidence)
        if "only" in figure.items.columns:
            only = figure.items["only"].sum(axis=0)
            row |= {"only_configuration": int(only[0]), "only_baseline": int(only[1])}
        if figure.share and len(figure.items["n"]):
            row["p_value"] = mcnemar_p_value(*map(int, figure.items["only"].sum(axis=0)))
        if regret.held is not None:
            row |= regret.held.columns()
        if regret.kept is not None:
            for name, kept in zip(("", "baseline_"), regret.kept, strict=True):
                row |= {f"{name}existence": kept.existence, f"{name}ghosts_kept_per_min": kept.false_positives_per_min}
        return row

    def _baseline_of(self, labelled: LabelledConfiguration, metric: str) -> LabelledConfiguration:
        """What a configuration is held against in a metric."""
        return self.remembering.get(labelled, self.pairs[labelled]) if metric in HELD_METRICS else self.pairs[labelled]

    def _limit(
        self, labelled: LabelledConfiguration, regret: Regret, values: tuple[float, float, float], confidence: float
    ) -> dict[str, object]:
        """The interval columns (`low`, `high`, …), cut at 0 where one side can never be worse than the other."""
        over, difference = "runs" if self.asked.over_runs else regret.over, values[2]
        sides = labelled, self._baseline_of(labelled, regret.metric)
        fact = "fixed_verdicts" if regret.metric == "pass_share" else "fixed"
        fixed = all(getattr(side.facts, fact) for side in sides)
        limits = difference_limits(regret.figure, difference, over, self.names, fixed=fixed, confidence=confidence)
        never_worse = [_is_never_worse(regret.metric, *of) for of in zip(sides, sides[::-1], values, strict=False)]
        sign = COMPARED[regret.metric].better * (never_worse[0] - never_worse[1])
        if sign * difference < 0 or not sign:
            return limits
        low_bound, high_bound = (0.0, math.inf) if sign > 0 else (-math.inf, 0.0)
        ends: dict[str, Any] = {name: limits.get(name) for name in ("low", "high", "low_bounded", "high_bounded")}
        return limits | {name: min(max(end, low_bound), high_bound) for name, end in ends.items() if end is not None}


def _number_or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None


_IN_TIME = ("detected_share", "ttd_rmst_s", "ttd_both_s", "unknown_to_horizon_s")
"""Metrics in which nothing is better than the truth, nor than ideal fusion of the same lists, row by row."""
_OF_ERRORS = ("position_rmse_held_m", "gospa_held_m", "false_positives_per_min", SHARE)
"""Metrics in which nothing is better than a truth without latency, which has 0."""


def _is_never_worse(metric: str, side: LabelledConfiguration, other: LabelledConfiguration, value: float) -> bool:
    """Whether one, which has a `value`, is as good as the other in every row, or better, whatever is drawn.

    What is fused by truth ids has no false positive.
    """
    facts = other.facts
    if metric not in _IN_TIME:
        by_id = side.facts.by_truth_id and metric == "false_positives_per_min"
        return value == 0 and metric in _OF_ERRORS and (side.facts.truth or by_id)
    of_inputs = side.results is other.results and (facts.ideal, facts.ideal_of) == (side.configuration, "inputs")
    return side.facts.truth or (of_inputs and not facts.recorded)


def _settle_horizon(folders: Sequence[Results]) -> tuple[float, list[str]]:
    """The horizon in seconds, the shortest that any folder has, and a note where they differ."""
    used_s = {str(folder.place): folder.provenance.horizon_used_s for folder in folders}
    horizon_s = min(used_s.values())
    if horizon_s == max(used_s.values()):
        return horizon_s, []
    has = ", ".join(f"{path} {one_s:.4g} s" for path, one_s in used_s.items())
    return horizon_s, [f"other horizons ({has}): times are up to {horizon_s:.4g} s"]


def _check_same_episodes(
    labelled: LabelledConfiguration, first: PairSide, baseline: LabelledConfiguration, second: PairSide, log: str,
    grid: PairingGrid,
) -> None:  # fmt: skip
    """Raise InputError where an episode begins or ends at different times in two folders: its rows cannot be paired."""
    if labelled.results is baseline.results:
        return
    in_both = first.there & second.there
    for column in ("onset_s", "ended_s"):
        actual, expected = first.rows[column], second.rows[column]
        off = np.flatnonzero(in_both & (np.abs(actual - expected) > SAME_INSTANT_S))
        if len(off):
            name = grid.episodes[off[0] // grid.runs][0]
            raise InputError(
                f"{labelled.results.place}: log {log}: object {name}: expected {column} {expected[off[0]]:g} as in "
                f"{baseline.results.place}, found {actual[off[0]]:g}: not the same ego, recording or units"
            )


def _check_same_frames(
    labelled: LabelledConfiguration, first: PairSide, baseline: LabelledConfiguration, second: PairSide, log: str
) -> None:
    """Raise InputError where the accuracy of a pair was measured at different frames, so that it is no pair."""
    in_both = first.there & second.there
    if first.accuracy is None or second.accuracy is None or not in_both.any():
        return
    actual, expected = first.accuracy, second.accuracy
    is_same = len(actual.frame_s) == len(expected.frame_s)
    is_same = is_same and bool((np.abs(actual.frame_s - expected.frame_s) <= SAME_INSTANT_S).all())
    for name in ("first", "length"):
        is_same = is_same and np.array_equal(getattr(actual, name)[in_both], getattr(expected, name)[in_both])
    if not is_same:
        raise InputError(
            f"{labelled.results.place}: log {log}: {labelled.configuration}: expected the frames of "
            f"{baseline.configuration} in {baseline.results.place}, found others; {AGAIN}"
        )

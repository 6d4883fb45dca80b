"""Slices: the rows of a study in groups, by drive, class, range at the onset, how an episode began, or a drive's tags.

An *entry* names what episodes are grouped by: `log`, `class`, `began`, `range_at_onset` (`range_at_onset:20:40` with
edges of one's own, in metres), `area`, `tags.NAME`; a *cross* of several, `[log, class]` or `log*class`, has a group
for each pair that occurs. A *group* is a set of episodes, of all configurations alike; its figures are those of
`summary.csv`, by the same functions, from its rows alone (`StudyRows`). What belongs to no episode has a figure only
where groups are of whole logs: false positives. What is of whole lists (GOSPA, OSPA, existence) has none.

Letters of the shapes: n rows, E episodes.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from copem_replay.core.errors import count_noun
from copem_replay.core.tracks import CLASSES, Bool, Float, Int
from copem_replay.metrics.accuracy.statistics import EXISTENCE, OBJECT, RUN, AccuracySettings, AccuracyTotal
from copem_replay.metrics.config import AREA, BEGAN_BY, CLASS, LOG, RANGE, TAGS, Dimension, Slice
from copem_replay.metrics.limits import CONFIDENCE, OBJECTS, TRAFFIC, choose_over, count_clusters, explain_no_clusters
from copem_replay.metrics.metric import (
    LINK,
    OUTPUT,
    Metric,
    MetricInputs,
    OwnSums,
    RowMetric,
    evaluate_metrics,
    own_metrics,
    own_statistics,
)
from copem_replay.metrics.onset import BEGAN, COUNTS_BY, is_counted, select_counted
from copem_replay.metrics.summary import CONFLICT, DETECTED, EPISODE, describe_followed
from copem_replay.metrics.summary_metrics import METRICS, estimate_detected_share

NO_TAG, NO_RANGE, NO_AREA = "(no tag)", "(no range)", "(no area)"
"""Groups of episodes whose log has no such tag, at whose onset there is no place to measure the range from, or that
begin in no area."""

# Groups.

Tags = Mapping[str, Mapping[str, str]]
"""By log its tags, by name."""


def find_unknown_tag(slices: Sequence[Slice], tags: Tags) -> str | None:
    """One line on the first tag that no log has; None: all are known."""
    known = sorted({name for of_log in tags.values() for name in of_log})
    for name in (name for by in slices for name in by.tags if name not in known):
        has = f"tags are {', '.join(known)}" if known else "logs have no tags"
        return f"{TAGS}{name}: expected a tag that some log has, found none; {has}"
    return None


def _name_values(table: pd.DataFrame, dimension: Dimension, tags: Tags) -> tuple[Int, list[str]]:
    """(n,) the value of each row as a position in a list of names, which is in the order in which groups are shown."""
    if dimension.name == LOG:
        position, logs = pd.factorize(table["log"])
        return position, [str(log) for log in logs]
    if dimension.name == RANGE:
        range_m, edges = table["distance_at_onset_m"].to_numpy(dtype=float), dimension.edges_m
        band = np.searchsorted(edges, range_m, side="right")
        words = [f"{low:g} … {high:g} m" for low, high in zip((0.0, *edges), edges, strict=False)]
        return np.where(np.isnan(range_m), len(edges) + 1, band), [*words, f"from {edges[-1]:g} m", NO_RANGE]
    if dimension.name.startswith(TAGS):
        values = table["log"].map({log: of.get(dimension.name.removeprefix(TAGS), NO_TAG) for log, of in tags.items()})
        values = values.fillna(NO_TAG)
        order = sorted(values.unique(), key=lambda value: (value == NO_TAG, value))
    elif dimension.name == AREA:
        values = table["area"].astype(object).where(table["area"].notna(), NO_AREA)
        order = sorted(values.unique(), key=lambda value: (value == NO_AREA, value))
    else:
        values = table["object_class" if dimension.name == CLASS else "began"]
        order = [*(CLASSES if dimension.name == CLASS else BEGAN)]
    return pd.Index(order).get_indexer(values), list(map(str, order))


def number_groups(table: pd.DataFrame, entry: Slice, tags: Tags) -> tuple[Int, list[tuple[str, ...]]]:
    """(n,) the number of each row's group, and the groups, each with its value of every dimension of the entry.

    `table`: rows with the columns that the entry is about: `log`, `object_class`, `began`, `distance_at_onset_m`,
    `area`.
    """
    number, columns = np.zeros(len(table), dtype=np.int64), []
    for dimension in entry.dimensions:
        position, words = _name_values(table, dimension, tags)
        number = number * len(words) + position
        columns.append(words)
    occurring, group = np.unique(number, return_inverse=True)
    names: list[tuple[str, ...]] = []
    for of_group in occurring.tolist():
        values: list[str] = []
        for words in reversed(columns):
            of_group, position = divmod(of_group, len(words))
            values.insert(0, words[position])
        names.append(tuple(values))
    return group, names


# Sums by episode, of what the tally does not count.

_SUMMED = ("pairs", "placed", "square_m2", "square_then_m2", "east_m", "north_m", "velocity_square_m2ps2", "nees",
           "age_of_information_s", "switches", "duplicates", "longest_gap_s")  # fmt: skip
_ROWS = ("rows", "matched_rows", "tracked_rows")
_COUNTED = "counted_rows"
"""Rows that own metrics are summed over."""
SUMMED_COLUMNS = (
    "configuration", "object_id", "episode", "matched_lists", "unplaced_lists", "position_rmse_m",
    "position_rmse_captured_m", "bias_east_m", "bias_north_m", "velocity_rmse_mps", "nees", "age_of_information_s",
    "identity_switches", "duplicates", "longest_gap_s",
)  # fmt: skip
"""Columns of `detections.parquet`, beside `log`, that `sum_episodes` needs without own metrics."""
KEYS = ("configuration", *EPISODE)
"""Columns that name an episode in a configuration."""


def sum_episodes(rows: pd.DataFrame, metrics: Sequence[RowMetric], words: Sequence[str], *keys: str) -> pd.DataFrame:
    """Sums of accuracy and of own metrics by configuration and episode, over the runs in rows of `detections.parquet`.

    `keys`: further columns to sum by.

    Columns: `KEYS`; with accuracy those of `AccuracyTotal.episodes` that rows tell, and how many rows are assessed,
    matched and tracked; for each statistic of an own metric its name and that of the statistic, over the rows that
    count by `words` (`measure.began`).
    """
    columns = _accuracy_columns(rows) if "matched_lists" in rows else {}
    counted = is_counted(rows, words) if metrics else np.zeros(0, dtype=bool)
    for name, values in _own_columns(rows[counted], metrics).items() if metrics else ():
        columns[name] = np.zeros(len(rows))
        columns[name][counted] = values
    if metrics:
        columns[_COUNTED] = counted.astype(float)
    summed = pd.DataFrame(columns, index=rows.index).groupby([rows[name] for name in (*KEYS, *keys)], sort=False).sum()
    return summed.reset_index()


def _accuracy_columns(rows: pd.DataFrame) -> dict[str, Any]:
    """Columns (n,) of each row, such as a count or a sum of squares, whose sums give the accuracy of many rows."""
    pairs = rows["matched_lists"].to_numpy(dtype=float)
    placed_lists = pairs - rows["unplaced_lists"].to_numpy(dtype=float)

    def times(name: str, number: Any, power: int = 1) -> Any:
        return np.nan_to_num(rows[name].to_numpy(dtype=float)) ** power * number

    gap_s, switches = (rows[name].to_numpy(dtype=float) for name in ("longest_gap_s", "identity_switches"))
    return {
        "pairs": pairs,
        "placed": placed_lists,
        "square_m2": times("position_rmse_m", placed_lists, 2),
        "square_then_m2": times("position_rmse_captured_m", pairs, 2),
        "east_m": times("bias_east_m", placed_lists),
        "north_m": times("bias_north_m", placed_lists),
        "velocity_square_m2ps2": times("velocity_rmse_mps", placed_lists, 2),
        "nees": times("nees", pairs),
        "age_of_information_s": times("age_of_information_s", pairs),
        "switches": np.nan_to_num(switches),
        "duplicates": rows["duplicates"].to_numpy(dtype=float),
        "longest_gap_s": np.nan_to_num(gap_s),
        "rows": (~np.isnan(gap_s)).astype(float),
        "matched_rows": (pairs > 0).astype(float),
        "tracked_rows": (~np.isnan(switches)).astype(float),
    }


def _own_columns(rows: pd.DataFrame, metrics: Sequence[RowMetric]) -> dict[str, Float]:
    """(n,) the statistics of own metrics, which are asked log by log and configuration by configuration."""
    columns: dict[str, Float] = {}
    for place in rows.groupby(["log", "configuration"], sort=False).indices.values():
        for metric, of_metric in own_statistics(metrics, rows.iloc[place]).items():
            for name, values in of_metric.items():
                columns.setdefault(f"{metric} {name}", np.zeros(len(rows)))[place] = values
    return columns


def sum_lists(rows: pd.DataFrame) -> pd.DataFrame:
    """Sums by log and configuration over the `runs` in rows of `lists.parquet`: `lists`, `minutes`, false entries, and
    needless braking; of `speed_lost_mps` the most.
    """
    rows = rows if "runs" in rows else rows.assign(runs=1)
    names = [name for name in ("runs", *_OF_LISTS, *OF_DRIVING) if name in rows]
    how = {name: "max" if name == "speed_lost_mps" else "sum" for name in names}
    return rows.groupby(["log", "configuration"], sort=False).agg(how).reset_index()


_OF_LISTS = ("lists", "minutes", "ghosts", "stale_ghosts", "duplicates")
OF_DRIVING = (
    "driving_s", "needless_brakes", "needless_s", "speed_lost_mps", "must_brake_s", "must_brake_missed_s",
)  # fmt: skip
LISTS_COLUMNS = ("log", "configuration", "run", *_OF_LISTS, *OF_DRIVING)
"""Columns of `lists.parquet` that figures are of."""

# Rows of a study, or of a group.


@dataclass(frozen=True)
class SliceSettings:
    """What figures are computed with: the horizon in seconds, `measure.began`, own metrics, settings of accuracy.

    `facts`: what configurations are, by name.
    """

    configurations: tuple[str, ...]
    horizon_s: float
    words: tuple[str, ...]
    own: tuple[RowMetric, ...] = ()
    accuracy: AccuracySettings | None = None
    conflicts: bool = False
    facts: Mapping[str, Any] = field(default_factory=dict)
    weigh: str = OBJECTS


@dataclass(frozen=True)
class StudyRows:
    """The rows from which a configuration's figures are computed: of a study, of a group, or of any episodes.

    `tally`, `exact`: rows of `tally.parquet` and `exact.parquet` (None: not asked for). `sums`: of `sum_episodes`.
    `lists`: of `sum_lists`; None: without accuracy, or episodes of parts of logs, to which no false entry belongs.
    `tags`: those of every log. Rows that do not count are among them; `inputs` leaves them out.
    """

    settings: SliceSettings
    tags: Tags
    tally: pd.DataFrame
    exact: pd.DataFrame | None
    sums: pd.DataFrame
    lists: pd.DataFrame | None

    @cached_property
    def episodes(self) -> pd.DataFrame:
        """The E episodes, in the order of the tally: `EPISODE`, class, range at the onset, began, from and to."""
        columns = [*EPISODE, "object_class", "distance_at_onset_m", *COUNTS_BY]
        columns += ["area"] if "area" in self.tally else []
        return self.tally[columns].drop_duplicates([*EPISODE]).reset_index(drop=True)

    @cached_property
    def counted(self) -> pd.DataFrame:
        """The rows of the tally that count for times, shares and distances, both events."""
        return select_counted(self.tally, self.settings.words)

    @cached_property
    def detections(self) -> pd.DataFrame:
        """The counted rows for detections, of all configurations."""
        return self.counted[self.counted["event"] == DETECTED]

    def _number_episodes(self, table: pd.DataFrame) -> Int:
        """(n,) the episode of each row, as a position in `episodes`."""
        index = pd.MultiIndex.from_frame(self.episodes[[*EPISODE]])
        number: Int = index.get_indexer(pd.MultiIndex.from_frame(table[[*EPISODE]]))
        return number

    @cached_property
    def _episode_of(self) -> dict[str, Int]:
        """By table the episode of each row."""
        tables = {"tally": self.tally, "exact": self.exact, "sums": self.sums}
        return {name: self._number_episodes(table) for name, table in tables.items() if table is not None}

    def select(self, is_kept: Bool, logs: Collection[str] | None = None) -> StudyRows:
        """The rows of the episodes in `is_kept (E,)`. `logs`: where these are all episodes of the logs; else None."""

        def rows_of(name: str) -> Any:
            table = getattr(self, name)
            return None if table is None else table[is_kept[self._episode_of[name]]]

        lists = None if logs is None or self.lists is None else self.lists[self.lists["log"].isin(logs)]
        return replace(self, tally=rows_of("tally"), exact=rows_of("exact"), sums=rows_of("sums"), lists=lists)

    def split(self, entry: Slice) -> list[Group]:
        """The groups of an entry that have an episode, in the order shown. By `began`, each counts its own ones."""
        number, names = number_groups(self.episodes, entry, self.tags)
        settings = replace(self.settings, words=BEGAN) if entry.names(BEGAN_BY) else self.settings
        logs_of: dict[tuple[str, ...], list[str]] = {}
        if entry.of_logs:
            logs = pd.DataFrame({"log": list(self.tags)})
            of_logs, names_of_logs = number_groups(logs, entry, self.tags)
            for log, k in zip(self.tags, of_logs.tolist(), strict=True):
                logs_of.setdefault(names_of_logs[k], []).append(log)
        return [
            Group(entry, values, replace(self.select(number == k, logs_of.get(values)), settings=settings))
            for k, values in enumerate(names)
        ]

    def inputs(self, configuration: str) -> MetricInputs:
        """The rows of a configuration in this group, from which the figures of `summary.csv` are computed."""
        settings, rows_of = self.settings, self._of(configuration)
        conflicts = rows_of(self.counted[self.counted["event"] == CONFLICT]) if settings.conflicts else None
        return MetricInputs(
            rows_of(self.detections),
            None,
            settings.horizon_s,
            facts=settings.facts.get(configuration),
            accuracy=None if settings.accuracy is None else self._total(configuration, settings.accuracy),
            exact=None if self.exact is None else rows_of(select_counted(self.exact, settings.words)),
            conflicts=conflicts,
            own=self._own_sums(rows_of(self.sums)),
            weigh=settings.weigh,
            driving=None if self.lists is None else rows_of(self.lists),
        )

    @staticmethod
    def _of(configuration: str) -> Callable[[pd.DataFrame], pd.DataFrame]:
        return lambda table: table[table["configuration"] == configuration]

    def _own_sums(self, sums: pd.DataFrame) -> dict[str, OwnSums]:
        sums_of: dict[str, OwnSums] = {}
        counted = _COUNTED in sums and bool(sums[_COUNTED].any())
        for name in sums.columns.difference([*KEYS, *_SUMMED, *_ROWS, _COUNTED], sort=False) if counted else ():
            metric, _, statistic = name.partition(" ")
            sums_of.setdefault(metric, {})[statistic] = float(sums[name].sum())
        return sums_of

    def _total(self, configuration: str, settings: AccuracySettings) -> AccuracyTotal:
        """The accuracy sums of a configuration, as far as the rows tell them; NaN: those they do not."""
        names = [*_SUMMED, *_ROWS]
        sums = dict(zip(names, self._of(configuration)(self.sums)[names].to_numpy().sum(axis=0), strict=True))
        episodes, runs, existence = (
            np.full(shape, np.nan, dtype=[(name, "f8") for name in of.names or ()])
            for of, shape in ((OBJECT, ()), (RUN, ()), (EXISTENCE, 1))
        )
        for name in _SUMMED:
            episodes[name] = sums[name]
        if self.lists is not None:
            lists = self._of(configuration)(self.lists)
            for name in _OF_LISTS[2:]:
                runs[name] = lists[name].sum()
            runs["time_s"] = 60 * lists["minutes"].sum()
        rows, matched, tracked = (int(sums[name]) for name in _ROWS)
        nothing = np.zeros(0, dtype=np.int64)
        return AccuracyTotal(settings, rows, matched, tracked, episodes, runs, nothing, nothing, nothing, existence)


@dataclass(frozen=True)
class Group:
    """A group of an entry: its value of each dimension, and its rows."""

    by: Slice
    values: tuple[str, ...]
    rows: StudyRows

    @property
    def label(self) -> str:
        """The values in words: `crossing, pedestrian`."""
        return ", ".join(self.values)


# Summaries of groups.

_NOT_OF_GROUPS = frozenset(metric.name for metric in (*OUTPUT, *LINK)) | {
    "list_rate_hz", "gospa_m", "gospa_localisation_m", "gospa_missed_m", "gospa_false_m", "ospa_m", "nees_expected",
    "nees_low", "nees_high", "beyond_gate_share", "existence_ece",
}  # fmt: skip
"""Columns of `summary.csv` that groups do not have: of whole lists, or of sums that no row tells."""


def summarise_groups(study: StudyRows, slices: Sequence[Slice]) -> pd.DataFrame:
    """The rows of `summary_by.csv`: of each entry, group and configuration the columns of `summary.csv`.

    Before them `by`, `group`, `configuration`, `logs` and `objects` that count, `apart` (whether the interval of
    `detected_share` excludes the share of all groups) and `note`: why there is no interval, or that few episodes last
    as long as the horizon. No interval is over the runs of one object: it tells of no group.
    """
    metrics = (*(metric for metric in METRICS if metric.name not in _NOT_OF_GROUPS), *own_metrics(study.settings.own))
    rows = list[dict[str, Any]]()
    for by in slices:
        groups = study.split(by)
        whole = replace(study, settings=groups[0].rows.settings) if groups else study
        shares = {name: estimate_detected_share(whole.inputs(name)).share for name in study.settings.configurations}
        for group in groups:
            rows += _summarise_group(group, shares, metrics)
    return pd.DataFrame(rows)


def _summarise_group(
    group: Group, shares: Mapping[str, float | None], metrics: Sequence[Metric]
) -> Iterator[dict[str, Any]]:
    """A group's rows of `summary_by.csv`. `shares`: by configuration the detected share in all groups."""
    rows = group.rows.detections
    followed_note = describe_followed(rows, group.rows.settings.horizon_s) if len(rows) else None
    for name, share in shares.items():
        inputs = group.rows.inputs(name)
        figures = evaluate_metrics(metrics, inputs)
        logs, objects, passes = count_clusters(inputs.rows)
        notes = _leave_out_limits(figures, "detected_share", "", (logs, objects, passes))
        if "pass_share" in figures:
            counts = count_clusters(inputs.rows[inputs.rows["in_conflict"]])
            notes += _leave_out_limits(figures, "pass_share", "pass_", counts)
        yield {
            "by": group.by.label,
            "group": group.label,
            "configuration": name,
            "logs": logs,
            "objects": objects,
            "apart": _is_apart(figures, share),
            "note": "; ".join([*notes, *filter(None, [followed_note])]) or None,
            **{column: None if value != value else value for column, value in figures.items()},
        }


def _leave_out_limits(figures: dict[str, Any], share: str, prefix: str, counts: tuple[int, int, int]) -> list[str]:
    """Leave out limits that are over runs, and say why. `counts`: logs, objects in them, passes of these."""
    if choose_over(*counts) in TRAFFIC:
        return []
    kinds = (f"{prefix}interval", f"{prefix}interval_over", f"{prefix}interval_clusters")
    figures |= dict.fromkeys((f"{share}_low", f"{share}_high", *kinds))
    return [f"no interval of {share}: {explain_no_clusters(*counts)}"] if counts[0] else []


def _is_apart(figures: Mapping[str, Any], share: float | None) -> bool | None:
    """Whether an interval excludes a share that is not 0 or 1, as no group stands out from these; None: no interval."""
    low, high = figures["detected_share_low"], figures["detected_share_high"]
    if low is None or share is None or share in (0.0, 1.0):
        return None
    return bool(not low <= share <= high)


def describe_chance(table: pd.DataFrame) -> list[str]:
    """One line per entry of `summary_by.csv`: number of groups, how many stand out, and how many would by chance."""
    lines = []
    for by, rows in table.groupby("by", sort=False):
        judged = rows["apart"].dropna().astype(bool)
        line = f"by {by}: {count_noun(rows['group'].nunique(), 'group')} looked at in "
        line += count_noun(rows["configuration"].nunique(), "configuration")
        if len(judged):
            line += (
                f"; of {count_noun(len(judged), 'interval')} of detected_share {int(judged.sum())} exclude the share "
                f"of all groups, by chance alone at least {(1 - CONFIDENCE) * len(judged):.2g} would"
            )
        lines.append(line)
    return lines

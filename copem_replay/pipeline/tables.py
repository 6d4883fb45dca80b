"""Tables: what logs give, in the order of configuration, run and object; by log, and of a whole study.

| table | rows |
|---|---|
| `accuracy` | as `detections`: position error and part of GOSPAᵖ by list of the stay, and as held by frame; ghosts |
| `instants` | log × configuration, and run where runs differ in them: when lists are available, which are held |
| `lists` | log × configuration × run: lists, ghosts, stale ones, and how many of the others from which existence on |
| `thresholds` | log × configuration × run × object × step: when it is detected if more existence is asked for |
| `bands` | configuration × distance, time (by log) or existence: from, to, and the figures in between |
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.metrics.accuracy.statistics import Accuracy, AccuracyTotal, join_totals, sum_accuracy
from copem_replay.metrics.detections_table import WAY, build_frame, concatenate_columns

if TYPE_CHECKING:
    from copem_replay.pipeline.replay import BlockOutcome
    from copem_replay.pipeline.scoring import ConfigurationScores


# Accuracy: columns of `detections`, and tables of their own.


def add_row_accuracy(*outcomes: BlockOutcome) -> dict[str, Any]:
    """The columns of `detections` with the figures of each row, block after block."""
    parts = [
        _row_columns(accuracy, outcome.assessed) for outcome in outcomes for _, _, accuracy in list_accuracies(outcome)
    ]
    columns = concatenate_columns([outcome.columns for outcome in outcomes])
    return columns | (concatenate_columns(parts) if parts else {})


def _spread(values: np.ndarray, assessed: Bool) -> np.ndarray:
    """(…, M) values (…, m) of the episodes that are assessed, 0 of the others."""
    if assessed.all():
        return values
    spread = np.zeros((*values.shape[:-1], len(assessed)), dtype=values.dtype)
    spread[..., assessed] = values
    return spread


def _row_columns(accuracy: Accuracy, assessed: Bool) -> dict[str, Any]:
    """The figures of each row, (S · M,) each; NaN where nothing was matched, or the object came back."""
    sums = _spread(accuracy.by_object, assessed).ravel()
    first = np.tile(assessed, len(accuracy.by_object))

    def mean(name: str, of: str = "pairs") -> Float:
        return np.where(sums[of] > 0, sums[name] / np.maximum(sums[of], 1), np.nan)

    return {
        "matched_lists": sums["pairs"],
        "unplaced_lists": sums["pairs"] - sums["placed"],
        "position_rmse_m": np.sqrt(mean("square_m2", "placed")),
        "position_rmse_captured_m": np.sqrt(mean("square_then_m2")),
        "bias_east_m": mean("east_m", "placed"),
        "bias_north_m": mean("north_m", "placed"),
        "velocity_rmse_mps": np.sqrt(mean("velocity_square_m2ps2", "placed")),
        "nees": mean("nees"),
        "age_of_information_s": mean("age_of_information_s"),
        "identity_switches": np.where(sums["tracked"] > 0, sums["switches"], np.nan),
        "duplicates": sums["duplicates"],
        "longest_gap_s": np.where(first, sums["longest_gap_s"], np.nan),
    }


def list_accuracies(outcome: BlockOutcome) -> Iterable[tuple[str, ConfigurationScores, Accuracy]]:
    """Name, scores and accuracy of each configuration whose accuracy is measured."""
    for name, scores in outcome.all_scores.items():
        if scores.accuracy is not None:
            yield name, scores, scores.accuracy


def total_by_log(logs: Iterable[LogTables]) -> dict[tuple[str, str], AccuracyTotal]:
    """By log and configuration the sums of accuracy over all runs."""
    return {(log.log, name): join_totals(nodes) for log in logs for name, nodes in log.totals.items()}


def total_over_logs(of_logs: Mapping[tuple[str, str], AccuracyTotal]) -> dict[str, AccuracyTotal]:
    """By configuration the sums over all runs and logs; empty without accuracy."""
    result: dict[str, AccuracyTotal] = {}
    for (_, name), total in of_logs.items():
        # Bands of time are of one log: they do not add up over several.
        total = replace(total, settings=replace(total.settings, time_edges_s=()), by_time=total.by_time[:0])
        result[name] = result[name] + total if name in result else total
    return result


@dataclass(frozen=True)
class AccuracyTables:
    """The tables of accuracy, in the order of `detections`. `instants` has a row per run where runs differ in them."""

    accuracy: pa.Table
    instants: pa.Table
    lists: pa.Table
    thresholds: pa.Table


def accuracy_tables(logs: Sequence[LogTables], rows: pd.DataFrame, *, same_instants: bool) -> AccuracyTables:
    """The tables of accuracy of several logs; `rows`: those of `detections`."""
    keys = pa.Table.from_pandas(rows[["log", "configuration", "run", "object_id", "episode"]], preserve_index=False)
    beside = pa.concat_tables([log.beside for log in logs if log.beside is not None])
    runs = pa.concat_tables([log.runs for log in logs if log.runs is not None])
    per_list = keys
    for name in _BY_LIST:
        per_list = per_list.append_column(name, beside[name])
    lengths = pc.list_value_length(beside["existence"]).to_numpy()
    thresholds = keys.take(pa.array(np.repeat(np.arange(len(lengths)), lengths)))
    thresholds = thresholds.append_column("existence", pc.list_flatten(beside["existence"]))
    thresholds = thresholds.append_column("detection_s", pc.list_flatten(beside["steps_s"]))
    lists = runs.drop_columns(list(_INSTANTS))
    return AccuracyTables(per_list, _build_instants(runs, same_instants), lists, thresholds)


def _build_instants(runs: pa.Table, same: bool) -> pa.Table:
    """`instants`: a row per configuration, and per run where runs do not have the same instants."""
    columns = runs.select(["log", "configuration", "run", *_INSTANTS])
    if same:
        return columns.filter(pc.equal(columns["run"], 0)).drop_columns("run")
    stated = np.flatnonzero(columns["available_s"].is_valid())
    rows = stated[np.searchsorted(stated, np.arange(len(columns)), side="right") - 1]  # as in the row before
    for k, name in enumerate(_INSTANTS, 3):
        columns = columns.set_column(k, name, columns[name].take(pa.array(rows)))
    return columns


def tabulate_bands(of_logs: Mapping[tuple[str, str], AccuracyTotal]) -> pd.DataFrame:
    """`bands`: the accuracy of lists by distance, over time and by existence."""
    rows: list[dict[str, Any]] = []
    for name, total in total_over_logs(of_logs).items():
        rows += _band_rows(name, "distance_m", total.settings.distance_edges_m, total.by_distance, None)
        edges = np.linspace(0.0, 1.0, len(total.by_existence) + 1)
        for k, sums in enumerate(total.by_existence):
            if sums["entries"]:
                rows.append(
                    {
                        "log": "all", "configuration": name, "by": "existence", "from": edges[k], "to": edges[k + 1],
                        "entries": int(sums["entries"]), "existence": sums["existence"] / sums["entries"],
                        "with_object_share": sums["with_object"] / sums["entries"],
                    }
                )  # fmt: skip
    for (log, name), total in of_logs.items():
        rows += _band_rows(name, "time_s", total.settings.time_edges_s, total.by_time, log)
    columns = ["log", "configuration", "by", "from", "to", "looked", "missed_share", "ghosts", "pairs",
               "position_rmse_m", "bias_east_m", "bias_north_m", "nees", "nees_expected", "entries", "existence",
               "with_object_share"]  # fmt: skip
    return pd.DataFrame(rows, columns=columns)


def _band_rows(name: str, by: str, edges: Sequence[float], sums: Any, log: str | None) -> list[dict[str, Any]]:
    rows = []
    for k, band in enumerate(sums):
        if not (band["looked"] or band["pairs"] or band["ghosts"]):
            continue
        pairs = int(band["pairs"])
        row = {
            "log": log or "all", "configuration": name, "by": by, "from": edges[k], "to": edges[k + 1],
            "looked": int(band["looked"]), "ghosts": int(band["ghosts"]), "pairs": pairs,
            "missed_share": band["missed"] / band["looked"] if band["looked"] else np.nan,
        }  # fmt: skip
        if placed := int(band["placed"]):
            row["position_rmse_m"] = np.sqrt(band["square_m2"] / placed)
            row |= {"bias_east_m": band["east_m"] / placed, "bias_north_m": band["north_m"] / placed}
        if pairs:
            row |= {"nees": band["nees"] / pairs, "nees_expected": band["nees_expected"] / pairs}
        rows.append(row)
    return rows


# The tables of one log.

RUNS = pa.schema(
    [
        ("log", pa.string()), ("configuration", pa.string()), ("run", pa.int64()), ("lists", pa.int64()),
        ("minutes", pa.float64()), ("ghosts", pa.int64()), ("stale_ghosts", pa.int64()), ("duplicates", pa.int64()),
        ("existence", pa.list_(pa.float64())), ("ghosts_at", pa.list_(pa.int64())), ("without_truth", pa.int64()),
        ("available_s", pa.list_(pa.float64())), ("frame_s", pa.list_(pa.float64())),
        ("held_list", pa.list_(pa.int64())),
    ]
)  # fmt: skip
_INSTANTS = ("available_s", "frame_s", "held_list")
"""Columns of `instants`; the others are those of `lists`."""

BESIDE = pa.schema(
    [
        ("first_list", pa.int64()), ("error_m", pa.large_list(pa.float32())), ("gospa_m2", pa.large_list(pa.float32())),
        ("ghosts", pa.int64()), ("first_frame", pa.int64()), ("error_held_m", pa.large_list(pa.float32())),
        ("age_held_s", pa.large_list(pa.float32())), ("gospa_held_m2", pa.large_list(pa.float32())),
        ("existence", pa.large_list(pa.float64())), ("steps_s", pa.large_list(pa.float64())),
    ]
)  # fmt: skip
_BY_LIST = tuple(name for name in BESIDE.names if name not in ("existence", "steps_s"))
"""Columns of `accuracy`; the others are those of `thresholds`."""


@dataclass(frozen=True)
class LogTables:
    """The tables of one log; `beside` and `runs` are None without accuracy.

    `beside` has the rows of `rows`: the columns of `accuracy.parquet`, and the steps `existence` and `steps_s` of
    `thresholds.parquet`. `runs` has a row per configuration and run: the columns of `lists.parquet`, and those of
    `instants.parquet`; null: as in the row before. `totals`: by configuration sums of accuracy, each with the number of
    neighbouring runs that it is over.
    """

    log: str
    rows: pd.DataFrame | pa.Table
    beside: pa.Table | None = None
    runs: pa.Table | None = None
    totals: dict[str, list[tuple[int, AccuracyTotal]]] = field(default_factory=dict)

    def of(self, configuration: str, *, way: bool) -> LogTables:
        """The tables of one configuration. `way`: whether it has the columns `WAY`, whatever others have."""
        assert isinstance(self.rows, pd.DataFrame)
        of_configuration = (self.rows["configuration"] == configuration).to_numpy()
        begin, count = int(of_configuration.argmax()) if len(of_configuration) else 0, int(of_configuration.sum())
        rows, beside, runs = self.rows.iloc[begin : begin + count], self.beside, self.runs
        return LogTables(
            self.log,
            rows if way else rows.drop(columns=list(WAY), errors="ignore"),
            None if beside is None else beside.slice(begin, count),
            None if runs is None else runs.filter(np.array(runs["configuration"].to_pylist()) == configuration),
            {name: nodes for name, nodes in self.totals.items() if name == configuration},
        )


def log_tables(log: str, outcomes: Sequence[BlockOutcome], names: Sequence[str], *, accuracy: bool) -> LogTables:
    """The tables of one log from blocks of any of its runs; `names`: its configurations, in order."""
    columns = add_row_accuracy(*outcomes)
    counts = [len(one.columns["run"]) // max(len(names), 1) for one in outcomes]  # rows of a configuration
    number = np.concatenate([np.repeat(np.arange(len(names)), count) for count in counts])
    order = np.lexsort((columns["run"], number))
    totals = {}
    for name in names:
        if parts := list(_split_by_runs(outcomes, name)):
            parts.sort(key=lambda part: part[0])
            totals[name] = [(sum(len(one.by_run) for _, one in parts), sum_accuracy([one for _, one in parts]))]
    ordered = build_frame({name: values[order] for name, values in columns.items()})
    if not accuracy or not names:
        return LogTables(log, ordered, totals=totals)
    return LogTables(log, ordered, _build_beside(outcomes).take(pa.array(order)), _build_runs(outcomes, names), totals)


def join_log_tables(log: str, parts: Sequence[LogTables]) -> LogTables:
    """The tables of one log from those of several configurations and ranges of runs, in this order."""
    totals: dict[str, list[tuple[int, AccuracyTotal]]] = {}
    for part in parts:
        for name, nodes in part.totals.items():
            totals.setdefault(name, []).extend(nodes)
    rows = pa.concat_tables([part.rows for part in parts], promote_options="permissive")
    beside, runs = ([t for part in parts if (t := getattr(part, name)) is not None] for name in ("beside", "runs"))
    return LogTables(
        log, rows, pa.concat_tables(beside) if beside else None, pa.concat_tables(runs) if runs else None, totals
    )


def _split_by_runs(outcomes: Iterable[BlockOutcome], name: str) -> Iterator[tuple[int, Accuracy]]:
    """Accuracy of one configuration with its first run; run by run where the runs of an outcome do not adjoin."""
    for outcome in outcomes:
        scores = outcome.all_scores.get(name)
        if scores is None or scores.accuracy is None:
            continue
        if (np.diff(outcome.runs) == 1).all():
            yield int(outcome.runs[0]), scores.accuracy
        else:
            yield from ((int(run), scores.accuracy.of_run(s)) for s, run in enumerate(outcome.runs))


def _build_beside(outcomes: Sequence[BlockOutcome]) -> pa.Table:
    """`LogTables.beside`, in the order of the outcomes' rows."""
    parts = []
    for outcome in outcomes:
        runs = len(outcome.runs)
        for _, scores, accuracy in list_accuracies(outcome):
            held, assessed = scores.held, outcome.assessed
            assert held is not None
            count, existence, steps_s = _count_steps(scores, runs)
            lists, frames = (np.tile(_spread(of.count, assessed), runs) for of in (accuracy, held))
            columns = {
                "first_list": np.tile(_spread(accuracy.first_list, assessed), runs),
                "error_m": (lists, accuracy.error_m.ravel()),
                "gospa_m2": (lists, accuracy.gospa.ravel()),
                "ghosts": _spread(accuracy.by_object["ghosts"], assessed).ravel(),
                "first_frame": np.tile(_spread(held.first, assessed), runs),
                "error_held_m": (frames, held.error_m.ravel()),
                "age_held_s": (frames, held.age_s.ravel()),
                "gospa_held_m2": (frames, held.gospa.ravel()),
                "existence": (count, existence),
                "steps_s": (count, steps_s),
            }
            parts.append(columns)
    return pa.table({one.name: _join_column(one.type, [part[one.name] for part in parts]) for one in BESIDE})


def _join_column(kind: pa.DataType, parts: Sequence[Any]) -> pa.Array:
    """A column of whole numbers (n,), or of lists given as (lengths (n,), their content)."""
    none = np.empty(0, dtype=np.int64)
    if not pa.types.is_large_list(kind):
        return pa.array(np.concatenate([none, *parts]))
    flat = np.concatenate([np.empty(0, dtype=kind.value_type.to_pandas_dtype()), *(part[1] for part in parts)])
    if flat.dtype == np.float32:  # to about a millimetre or millisecond: finer is noise, and takes twice the space
        flat = np.round(flat * np.float32(1024)) / np.float32(1024)
    offsets = np.cumsum(np.concatenate([np.zeros(1, dtype=np.int64), *(part[0] for part in parts)]))
    return pa.LargeListArray.from_arrays(pa.array(offsets, pa.int64()), pa.array(flat, mask=np.isnan(flat)))


def _count_steps(scores: ConfigurationScores, runs: int) -> tuple[Int, Float, Float]:
    """How many steps each row has, and their existences and times; one run of `scores` may stand for all."""
    steps, shape = scores.steps, scores.detections.detection_s.shape
    row = steps.run_ix * shape[1] + steps.episode_ix
    order = np.argsort(row, kind="stable")
    count, times = np.bincount(row, minlength=shape[0] * shape[1]), 1 if shape[0] == runs else runs
    return np.tile(count, times), np.tile(steps.existence[order], times), np.tile(steps.detection_s[order], times)


def _build_runs(outcomes: Sequence[BlockOutcome], names: Sequence[str]) -> pa.Table:
    """`LogTables.runs`, in the order of `names` and runs."""
    rows: list[dict[str, Any]] = []
    for outcome in outcomes:
        for name, scores, accuracy in list_accuracies(outcome):
            held = scores.held
            assert held is not None
            instants: dict[str, Any] = {"available_s": scores.issue_s, "frame_s": held.frame_s}
            instants["held_list"] = [k if k >= 0 else None for k in held.list_ix.tolist()]
            for s, run in enumerate(outcome.runs.tolist()):
                sums = accuracy.by_run[s]
                rows.append(
                    {
                        "log": outcome.log,
                        "configuration": name,
                        "run": run,
                        "lists": int(sums["lists"]),
                        "minutes": float(sums["time_s"]) / 60,
                        "ghosts": int(sums["ghosts"]),
                        "stale_ghosts": int(sums["stale_ghosts"]),
                        "duplicates": int(sums["duplicates"]),
                        "existence": list(accuracy.settings.existence_thresholds),
                        "ghosts_at": accuracy.ghosts_at[s].tolist(),
                        "without_truth": int(held.without_truth[s]),
                        **instants,
                    }
                )
    place = {name: k for k, name in enumerate(names)}
    rows.sort(key=lambda row: (place[row["configuration"]], row["run"]))
    before: dict[str, Any] = {}
    for row in rows:  # instants equal to those of the run before are null
        last, issue_s = before.get(row["configuration"]), row["available_s"]
        before[row["configuration"]] = issue_s
        if last is not None and (last is issue_s or np.array_equal(last, issue_s)):
            row |= dict.fromkeys(_INSTANTS)
    return pa.Table.from_pylist(rows, RUNS)


# The tables of a study.

HELD_BYTES = 1_000_000_000
"""Bytes of all logs that are held where they can be read again: five million rows without accuracy."""


class StudyTables:
    """The tables of a study, log by log: all in memory, or, where they are large and kept, those of one log at a time.

    `again`: reads the tables of a log that was added; None: all stay in memory. `way`: whether rows have `WAY`.
    """

    def __init__(self, again: Callable[[str], LogTables] | None = None, *, way: bool = False) -> None:
        self.counts: dict[str, int] = {}
        """Rows by log, in the order in which logs are added."""
        self._again, self._way = again, way
        self._held: dict[str, LogTables] = {}
        self._bytes = 0
        self._schema: pa.Schema | None = None  # of all rows; None: rows are pandas frames
        self._last: tuple[str, pd.DataFrame] | None = None

    def add(self, some: Sequence[LogTables]) -> pd.DataFrame:
        """The tables of more logs. Returns their rows."""
        for tables in some:
            self.counts[tables.log] = len(tables.rows)
            self._held[tables.log] = tables
            self._bytes += sum(one.nbytes for one in (tables.beside, tables.runs) if one is not None)
        arrow = [tables.rows for tables in some if isinstance(tables.rows, pa.Table)]
        if arrow:
            self._bytes += sum(rows.nbytes for rows in arrow)
            before = [] if self._schema is None else [self._schema]
            schemas = [*before, *(rows.schema.remove_metadata() for rows in arrow)]
            self._schema = pa.unify_schemas(schemas, promote_options="permissive")
        if self._again is not None and self._bytes > HELD_BYTES:
            self._held.clear()
        return self._frame([tables.rows for tables in some])

    @cached_property
    def whole(self) -> pd.DataFrame:
        """The rows of `detections.parquet` of all logs."""
        rows = self._frame([tables.rows for tables in self.each()])
        self._held = {log: replace(tables, rows=pd.DataFrame()) for log, tables in self._held.items()}
        return rows

    @property
    def many(self) -> bool:
        """Whether tables are read again log by log."""
        return len(self._held) < len(self.counts)

    def rows(self, log: str) -> pd.DataFrame:
        """The rows of `detections.parquet` of one log."""
        if not self.many:
            return self.whole[self.whole["log"] == log]
        if self._last is None or self._last[0] != log:
            self._last = log, self._frame([self._of(log).rows])
        return self._last[1]

    def each(self) -> Iterator[LogTables]:
        """The tables of each log; without rows where `whole` has them."""
        return map(self._of, self.counts)

    def parts(self) -> Iterator[tuple[pd.DataFrame, Sequence[LogTables]]]:
        """Rows and their tables in parts, one in memory at a time: all logs at once, or one log each."""
        if not self.many:
            yield self.whole, list(self.each())
        else:
            yield from ((self._frame([tables.rows]), [tables]) for tables in self.each())

    def _of(self, log: str) -> LogTables:
        if log in self._held:
            return self._held[log]
        assert self._again is not None
        return self._again(log)

    def _frame(self, rows: Sequence[pd.DataFrame | pa.Table]) -> pd.DataFrame:
        """The rows of some logs as one frame, with the same columns and types whether computed or read."""
        if self._schema is None:
            frame = pd.concat(rows, ignore_index=True).infer_objects()
        else:
            tables = [self._schema.empty_table(), *(one.replace_schema_metadata(None) for one in rows)]
            frame = pa.concat_tables(tables, promote_options="permissive").to_pandas()
        if "braking_pass" in frame:
            frame["braking_pass"] = pd.array(frame["braking_pass"], dtype="boolean")
        if not self._way:
            return frame
        # Columns that only some configurations have come last, in whatever order tables were added.
        return frame.reindex(columns=[*(name for name in frame if name not in WAY), *WAY])

"""Tables: what logs give, in the order of configuration, run and object: of parts, and of a whole study.

| table | rows |
|---|---|
| `accuracy` | as `detections`: position error and part of GOSPAᵖ by list of the stay, and as held by frame; ghosts |
| `instants` | log × configuration, and run where runs differ in them: when lists are available, which are held |
| `lists` | log × configuration × run: lists, ghosts, stale entries, and how many ghosts from which existence on |
| `false_tracks` | log × configuration × run × false track: when, where, how many entries, whose |
| `needless` | log × configuration × run × time that the driver brakes for nothing: when, how long, by whose entry |
| `thresholds` | log × configuration × run × object × step: when it is detected if more existence is asked for |
| `bands` | configuration × distance, time (by log) or existence: from, to, and the figures in between |
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import ipc

from copem_replay.core.files import parse_json
from copem_replay.core.tracks import CLASSES, Bool, Float, Int
from copem_replay.metrics.accuracy.statistics import (
    BAND,
    EXISTENCE,
    OBJECT,
    RUN,
    Accuracy,
    AccuracySettings,
    AccuracyTotal,
    sum_accuracy,
)
from copem_replay.metrics.columns import COMPARED_FILES, FALSE_TRACKS, NEEDLESS, TABLES
from copem_replay.metrics.detections_table import WAY, build_frame, concatenate_columns
from copem_replay.pipeline.false_tracks import SORTED

if TYPE_CHECKING:
    from copem_replay.experiment.schema import Experiment
    from copem_replay.metrics.braking.needless import NeedlessBraking
    from copem_replay.pipeline.replay import BlockOutcome
    from copem_replay.pipeline.scoring import ConfigurationScores


# Accuracy: columns of `detections`, and tables of their own.


def add_row_accuracy(*outcomes: BlockOutcome) -> dict[str, Any]:
    """The columns of `detections` with the figures of each row, block after block."""
    parts = [
        _row_columns(scores.accuracy, outcome.assessed)
        for outcome in outcomes
        for scores in outcome.all_scores.values()
        if scores.accuracy is not None
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
    """The accuracy figures of each row, (S · M,) each; NaN: nothing was matched, or it is a later episode."""
    sums = _spread(accuracy.by_object, assessed).ravel()
    is_first = np.tile(assessed, len(accuracy.by_object))

    def mean(name: str, count: str = "pairs") -> Float:
        return np.where(sums[count] > 0, sums[name] / np.maximum(sums[count], 1), np.nan)

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
        "longest_gap_s": np.where(is_first, sums["longest_gap_s"], np.nan),
    }


def total_over_logs(of_logs: Mapping[tuple[str, str], AccuracyTotal]) -> dict[str, AccuracyTotal]:
    """By configuration the sums over all runs and logs; empty without accuracy."""
    result: dict[str, AccuracyTotal] = {}
    for (_, name), total in of_logs.items():
        # Bands of time are of one log: they do not add up over several.
        total = replace(total, settings=replace(total.settings, time_edges_s=()), by_time=total.by_time[:0])
        result[name] = result[name] + total if name in result else total
    return result


def accuracy_tables(parts: Iterable[PartTables], rows: pd.DataFrame, *, same_instants: bool) -> dict[str, pa.Table]:
    """The tables of accuracy of some parts by the names of their files; `rows`: those of `detections.parquet`.

    `same_instants`: whether runs do not differ in their instants, which are then those of the first run.
    """
    parts = list(parts)
    keys = pa.Table.from_pandas(rows[list(_KEYS)], preserve_index=False)
    beside = pa.concat_tables([part.beside for part in parts if part.beside is not None])
    runs = pa.concat_tables([part.runs for part in parts if part.runs is not None])
    per_list = keys
    for column in _BY_LIST:
        per_list = per_list.append_column(column.name, beside[column.name])
    lengths = pc.list_value_length(beside["existence"]).to_numpy()
    thresholds = keys.take(pa.array(np.repeat(np.arange(len(lengths)), lengths)))
    for column in _STEPS:
        thresholds = thresholds.append_column(column.name, pc.list_flatten(beside[column.name]))
    instants, lists = _build_instants(runs, same_instants), runs.drop_columns(_INSTANTS)
    false = pa.concat_tables([part.false_tracks for part in parts if part.false_tracks is not None])
    needless = [part.needless for part in parts if part.needless is not None]
    lists = lists if needless else lists.drop_columns(_DRIVING)
    tables = dict(zip(COMPARED_FILES, (per_list, instants, lists, thresholds), strict=True)) | {FALSE_TRACKS: false}
    return tables | ({NEEDLESS: pa.concat_tables(needless)} if needless else {})


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
    return TABLES["bands.csv"].frame(rows)


def _band_rows(name: str, dimension: str, edges: Sequence[float], sums: Any, log: str | None) -> list[dict[str, Any]]:
    """Rows of `bands.csv`: sums by distance or time band as shares, RMSE and bias; empty bands are left out."""
    rows = []
    for k, band in enumerate(sums):
        if not (band["looked"] or band["pairs"] or band["ghosts"]):
            continue
        pairs = int(band["pairs"])
        row = {
            "log": log or "all", "configuration": name, "by": dimension, "from": edges[k], "to": edges[k + 1],
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


# The tables of a part.

_KEYS = ("log", "configuration", "run", "object_id", "episode")
_BY_LIST, _AT, _, _STEPS = (
    [column for column in TABLES[name].columns if column.name not in _KEYS] for name in COMPARED_FILES
)
_INSTANTS = [column.name for column in _AT]
_DRIVING = [column.name for column in TABLES["lists.parquet"].columns if column.when == "needless"]
_EVENTS, _FALSE = (
    pa.schema([(column.name, column.arrow) for column in TABLES[name].columns]) for name in (NEEDLESS, FALSE_TRACKS)
)
_RUNS = pa.schema([(column.name, column.arrow) for column in (*TABLES["lists.parquet"].columns, *_AT)])
_BESIDE = pa.schema([*((c.name, c.arrow) for c in _BY_LIST), *((c.name, pa.large_list(c.arrow)) for c in _STEPS)])


@dataclass(frozen=True)
class PartTables:
    """The tables of a part: of one log in one configuration in a block of runs.

    `beside` has the rows of `rows`: the columns of `accuracy.parquet`, and in lists the steps of
    `thresholds.parquet`. `runs` has a row per run: the columns of `lists.parquet`, and those of `instants.parquet`;
    null: as in the row before. `total`: sums of accuracy over the runs. `false_tracks`: rows of `false_tracks.parquet`.
    All four are None without accuracy. `needless`: rows of `needless.parquet`; None: not asked for. `again`: reads the
    part again where it is kept in a folder; None: it is not.
    """

    log: str
    configuration: str
    rows: pa.Table
    beside: pa.Table | None = None
    runs: pa.Table | None = None
    total: AccuracyTotal | None = None
    false_tracks: pa.Table | None = None
    needless: pa.Table | None = None
    again: Callable[[], PartTables] | None = field(default=None, compare=False, repr=False)

    @property
    def size_bytes(self) -> int:
        """Bytes of its tables in memory."""
        return sum(table.nbytes for table in self.tables if table is not None)

    @property
    def tables(self) -> tuple[pa.Table | None, ...]:
        """The tables of the part, the required ones first."""
        return self.rows, self.beside, self.runs, self.false_tracks, self.needless


def build_parts(log: str, outcomes: Sequence[BlockOutcome], experiment: Experiment) -> list[PartTables]:
    """The part of each configuration, in their order, from blocks of neighbouring runs of one log."""
    names, columns = list(experiment.configurations), add_row_accuracy(*outcomes)
    counts = [len(outcome.columns["run"]) // len(names) for outcome in outcomes]  # rows of a configuration
    number = np.concatenate([np.repeat(np.arange(len(names)), count) for count in counts])
    parts = []
    for k, name in enumerate(names):
        rows = np.flatnonzero(number == k)
        order = np.argsort(columns["run"][rows], kind="stable")
        without = () if experiment.has_way(name) else WAY
        frame = build_frame({n: values[rows[order]] for n, values in columns.items() if n not in without})
        part = PartTables(log, name, tabulate_rows(frame))
        if experiment.measure.accuracy:
            beside = _build_beside(outcomes, name).take(pa.array(order))
            runs = _build_runs(outcomes, name, experiment.needless is not None)
            accuracies = [accuracy for _, accuracy in sorted(_split_by_runs(outcomes, name), key=lambda pair: pair[0])]
            false = _tabulate_false_tracks(outcomes, name)
            part = replace(part, beside=beside, runs=runs, total=sum_accuracy(accuracies), false_tracks=false)
        if experiment.needless is not None:
            part = replace(part, needless=_tabulate_needless(outcomes, name))
        parts.append(part)
    return parts


def tabulate_rows(frame: pd.DataFrame) -> pa.Table:
    """A frame as Arrow, without what pandas notes of it."""
    return pa.Table.from_pandas(frame, preserve_index=False).replace_schema_metadata(None)


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


def _build_beside(outcomes: Sequence[BlockOutcome], name: str) -> pa.Table:
    """`PartTables.beside`: accuracy by list and frame of each row of a configuration, in the order of the rows."""
    parts = []
    for outcome in outcomes:
        scores, assessed, runs = outcome.all_scores[name], outcome.assessed, len(outcome.runs)
        accuracy, held = scores.accuracy, scores.held
        assert accuracy is not None
        assert held is not None
        count, existence, steps_s = _count_steps(scores, runs)
        lists, frames = (np.tile(_spread(result.count, assessed), runs) for result in (accuracy, held))
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
            "detection_s": (count, steps_s),
        }
        parts.append(columns)
    return pa.table({one.name: _join_column(one.type, [part[one.name] for part in parts]) for one in _BESIDE})


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


def _build_runs(outcomes: Sequence[BlockOutcome], name: str, needless: bool) -> pa.Table:
    """`PartTables.runs`: lists, ghosts and instants of a configuration by run; `needless`: with those columns."""
    rows: list[dict[str, Any]] = []
    for outcome in outcomes:
        scores = outcome.all_scores[name]
        accuracy, held = scores.accuracy, scores.held
        assert accuracy is not None
        assert held is not None
        existence = list(accuracy.settings.existence_thresholds)
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
                    "existence": existence,
                    "ghosts_at": accuracy.ghosts_at[s].tolist(),
                    "without_truth": int(held.without_truth[s]),
                    **(_driving_columns(scores.needless, s, len(existence)) if needless else {}),
                    **instants,
                }
            )
    rows.sort(key=lambda row: int(row["run"]))
    last: Any = None
    for row in rows:  # instants equal to those of the run before are null
        issue_s, before = row["available_s"], last
        last = issue_s
        if before is not None and (before is issue_s or np.array_equal(before, issue_s)):
            row |= dict.fromkeys(_INSTANTS)
    return pa.Table.from_pylist(rows, _RUNS)


def _driving_columns(needless: NeedlessBraking | None, s: int, levels: int) -> dict[str, Any]:
    """The columns of `lists.parquet` about needless braking in one run; 0 where there is no ego to drive."""
    if needless is None:
        return dict(zip(_DRIVING, (0.0, 0, 0.0, [0.0] * levels, 0.0, 0.0, 0.0), strict=True))
    values = (
        needless.driving_s, int(needless.brakes[s]), float(needless.needless_s[s]), needless.needless_s_at[s].tolist(),
        float(needless.speed_lost_mps[s]), needless.must_brake_s, float(needless.missed_s[s]),
    )  # fmt: skip
    return dict(zip(_DRIVING, values, strict=True))


def _tabulate_needless(outcomes: Sequence[BlockOutcome], name: str) -> pa.Table:
    """`PartTables.needless`: a configuration's events of needless braking, by run and begin."""
    parts = [_EVENTS.empty_table()]
    for outcome in outcomes:
        if (braking := outcome.all_scores[name].needless) is None:  # the log has no ego
            continue
        columns = {
            "run": outcome.runs[braking.run_ix],
            "begins_s": braking.begins_s,
            "lasts_s": braking.lasts_s,
            "speed_lost_mps": braking.lost_mps,
            "cause": braking.cause,
            "object_id": braking.object_id,
            "object_class": np.array(CLASSES, dtype=object)[braking.class_ix],
            "track_id": [str(k) if k >= 0 else None for k in braking.entries["track_id"].tolist()],
            "x_m": braking.entries["x_m"],
            "y_m": braking.entries["y_m"],
        }
        log, whose = [outcome.log] * len(braking.run_ix), [name] * len(braking.run_ix)
        parts.append(pa.table({"log": log, "configuration": whose, **columns}, schema=_EVENTS))
    return pa.concat_tables(parts).sort_by([("run", "ascending"), ("begins_s", "ascending")])


def _tabulate_false_tracks(outcomes: Sequence[BlockOutcome], name: str) -> pa.Table:
    """`PartTables.false_tracks` of a configuration."""
    parts = []
    for outcome in outcomes:
        found = outcome.all_scores[name].false_tracks
        assert found is not None
        whose = found.assign(log=outcome.log, configuration=name, run=outcome.runs[found["run"].to_numpy()])
        parts.append(pa.Table.from_pandas(whose, schema=_FALSE, preserve_index=False).replace_schema_metadata(None))
    return pa.concat_tables(parts).sort_by([(column, "ascending") for column in SORTED])


# Parts as bytes: streams of Arrow, one after the other.

_WHOSE = ("log", "configuration")
"""Columns that are not in the bytes of a part: a configuration may be renamed."""
_RECORDS = {"episodes": OBJECT, "runs": RUN, "ghosts_at": np.dtype("i8"), "by_distance": BAND, "by_time": BAND,
            "by_existence": EXISTENCE}  # fmt: skip


def pack_part(part: PartTables, about: str = "") -> bytes:
    """The tables of a part of a study as bytes. `about`: its recipe; `unpack_part` refuses bytes of another."""
    total = None if part.total is None else _total_as_json(part.total)
    metadata: dict[bytes, bytes] | None = {b"about": about.encode(), b"total": json.dumps(total).encode()}
    stream = pa.BufferOutputStream()
    for table in part.tables:
        if table is not None:
            table = table.drop_columns([name for name in _WHOSE if name in table.column_names]).combine_chunks()
            schema = table.schema.with_metadata(metadata)
            with ipc.new_stream(stream, schema, options=ipc.IpcWriteOptions(compression="zstd")) as writer:
                writer.write_table(table)
            metadata = None
    content: bytes = stream.getvalue().to_pybytes()
    return content


def unpack_part(content: bytes, log: str, configuration: str, recipe: str = "") -> PartTables:
    """The part in bytes of `pack_part`. Raises ValueError, KeyError, TypeError or OSError for other bytes or text."""
    reader, tables = pa.BufferReader(content), list[pa.Table]()
    while reader.tell() < reader.size():
        tables.append(ipc.open_stream(reader).read_all())
    metadata = tables[0].schema.metadata
    if metadata[b"about"] != recipe.encode():
        raise ValueError("another recipe")
    total = parse_json(metadata[b"total"])
    for k in (place for place in (0, 2, 3, 4) if place < len(tables)):
        for at, (name, value) in enumerate(zip(_WHOSE, (log, configuration), strict=True)):
            column = pa.repeat(pa.scalar(value, pa.string()), len(tables[k]))
            tables[k] = tables[k].replace_schema_metadata(None).add_column(at, name, column)
    rows, beside, runs, false, needless = (*tables, None, None, None, None)[:5]
    of_runs = None if total is None else _total_from_json(total)
    return PartTables(log, configuration, rows, beside, runs, of_runs, false, needless)


def _total_as_json(total: AccuracyTotal) -> dict[str, Any]:
    arrays = {name: np.ascontiguousarray(getattr(total, name)).tobytes().hex() for name in _RECORDS}
    return (
        {f.name: getattr(total, f.name) for f in fields(AccuracyTotal)} | {"settings": asdict(total.settings)} | arrays
    )


def _total_from_json(data: dict[str, Any]) -> AccuracyTotal:
    settings: dict[str, Any] = {n: _lists_to_tuples(v) for n, v in data["settings"].items()}
    arrays = {name: np.frombuffer(bytes.fromhex(data[name]), dtype=kind) for name, kind in _RECORDS.items()}
    scalars = {name: arrays[name].reshape(()) for name in ("episodes", "runs")}
    return AccuracyTotal(**data | {"settings": AccuracySettings(**settings)} | arrays | scalars)


def _lists_to_tuples(value: Any) -> Any:
    return tuple(map(_lists_to_tuples, value)) if isinstance(value, list) else value

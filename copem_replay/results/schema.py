"""The schema of a results folder: every column of every file once, how tables are read and written, its provenance.

A column states its kind, what it means, and what an experiment has to ask for so that it is there. Writers, readers,
`compare`, and the reference of the columns (`tools/column_reference.py`) go by it. Columns of the summary are the
metrics of `metrics/summary_metrics.py`. Units are in the names.
"""

from __future__ import annotations

import os
import platform
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Self
from urllib.parse import quote

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import parquet

from copem_replay.core.errors import InputError, RemoteFile
from copem_replay.core.files import avoid_device_name, parse_json
from copem_replay.experiment.file import relocate_settings
from copem_replay.experiment.schema import LogSettings
from copem_replay.experiment.validate import resolve_place
from copem_replay.io.open import File, first_recording
from copem_replay.io.recording import Recording
from copem_replay.metrics.config import Measure
from copem_replay.metrics.summary_metrics import METRIC, METRICS_OF
from copem_replay.pipeline.expansion import ConfigurationFacts
from copem_replay.pipeline.study_log import compute_log_digests
from copem_replay.results.folder import MARK

MANY_ROWS = 10_000_000
"""A table with more rows than this is a folder of its name, with a file per log: as a whole it takes half a GB."""


def table_file(table: Path, log: str) -> Path:
    """The file with the rows of a log, of a table that is a folder."""
    return table / avoid_device_name(f"{quote(log, safe=' ')}.parquet")


FORMAT = 4
"""The format of results folders: raised when columns, files or their meaning change so that readers have to know."""

AGAIN = "run the experiment again with --overwrite"
"""The way out for a table that is damaged or of an older version."""

# Columns.


@dataclass(frozen=True)
class Column:
    """A column of a file, or a key of `provenance.json`.

    `kind`: text, text or null, numbers, whole numbers, true or false, or lists of these. `when`: what an experiment
    has to ask for (`braking`, `conflict`, `accuracy`; `link`: a link, `ready` or `sends`; `fleet`: units that only some
    runs have); empty: it is always there. `compared`: whether comparisons read it.
    """

    name: str
    kind: str
    words: str
    when: str = ""
    compared: bool = False


@dataclass(frozen=True)
class Table:
    """A file of results: what a row of it is, and its columns in their order."""

    words: str
    columns: tuple[Column, ...]

    def kinds(self, *when: str, compared: bool = False) -> dict[str, str]:
        """The kinds of the columns that are always there, and of those that are there `when` this is asked for."""
        every = [column for column in self.columns if column.when in ("", *when)]
        return {column.name: column.kind for column in every if column.compared or not compared}


_CONFIGURATION = Column("configuration", "text", "name of the configuration, as in the experiment", compared=True)
_LOG = (Column("log", "text", "name of the recording", compared=True), _CONFIGURATION)
_RUN = Column("run", "whole numbers", "number of the run, from 0 on", compared=True)
_OBJECT = Column("object_id", "text", "id of the object in the truth", compared=True)
_CLASS = Column("object_class", "text", "class of the object in the truth")
_EPISODE = Column("episode", "whole numbers",
                  "which episode of the object, from 0 on; above 0 only with "
                  "[`again_after_s`](../guide/metrics.md#who-comes-back)", compared=True)  # fmt: skip
_ONSET = Column("onset_s", "numbers",
                "when the clock starts, in seconds since the log's start: the first frame at which the onset's "
                "condition holds while the ego is in the log. An object without onset has no row",
                compared=True)  # fmt: skip
_ONSET_RANGE = Column("distance_at_onset_m", "numbers",
                      "true horizontal distance to the ego at `onset_s`, centre to centre; null when there is none to "
                      "measure from")  # fmt: skip
_BEGAN = Column("began", "text",
                "how the episode began: `log_start`, `appeared` or `crossed`, "
                "[below](../guide/metrics.md#which-objects-count)", compared=True)  # fmt: skip
_ENDED = (
    Column("ended_s", "numbers", "the end of the episode; a list that arrives later does not count", compared=True),
    Column("ended_by", "text",
           "why the episode ended: the object's own last frame (`object_left`), the ego's (`ego_left`), the log's "
           "(`log_end`)", compared=True),
)  # fmt: skip
_DETECTION = Column("detection_s", "numbers", "when the list that confirmed it was available", compared=True)
_TIME = Column("time_to_detection_s", "numbers", "`detection_s − onset_s`. Negative only with `count_earlier: true`")
_DISTANCES = (
    Column("distance_at_detection_m", "numbers",
           "true horizontal distance to the ego at `detection_s`, centre to centre; null when the truth has a gap "
           "there. A larger distance means earlier only while the two approach each other: read it together with "
           "the time",
           compared=True),
    Column("gap_at_detection_m", "numbers", "the same from box to box"),
)  # fmt: skip
_IN_CONFLICT = Column("conflict", "true or false",
                      "in [conflict](../guide/metrics.md#would-it-have-braked-in-time). The columns from `brake_s` to "
                      "`required_deceleration_mps2` are null where it is not", "braking", compared=True)  # fmt: skip


def _as_in_summary(*names: str, kind: str = "numbers", when: str = "") -> tuple[Column, ...]:
    return tuple(Column(name, kind, METRIC[name].help, when) for name in names)


_SUMMARY = (
    _CONFIGURATION,
    *(Column(metric.name, metric.kind, metric.help, when) for when, of in METRICS_OF.items() for metric in of),
)
_SUMMARY_BY = (
    Column("by", "text", "what rows are grouped by, as on the command line: `class`, `log*class`"),
    Column("group", "text", "the group: its value, of a cross its values"),
    _CONFIGURATION,
    Column("logs", "whole numbers", "logs of the group, of the episodes that count"),
    Column("objects", "whole numbers", "objects of the group, of the episodes that count"),
    Column("apart", "true or false",
           "whether the interval of `detected_share` excludes the share of all groups together; null without one, or "
           "where that share is 0 or 1"),
    Column("note", "text or null", "why there is no interval; how few episodes last as long as the horizon"),
)  # fmt: skip
_DETECTIONS = (
    *_LOG, _RUN, _OBJECT, _CLASS, _EPISODE, _ONSET, _ONSET_RANGE, _BEGAN,
    Column("detected", "true or false", "whether the object was detected", compared=True),
    _DETECTION,
    Column("captured_s", "numbers", "newest capture that contributed to that list"),
    Column("in_sight_s", "numbers",
           "the first list, captured at or after the onset, of any of the configuration's units that has the object in "
           "sight: a visible share above 0, whatever range and field of view. Null if never, or not known (for the "
           "truth and with recorded units)"),
    _TIME, *_DISTANCES, *_ENDED,
    Column("first_unit", "text or null",
           "the unit whose list held the object first (earliest arrival, then the order of the experiment); `truth` "
           "for GT"),
    Column("conflict_detected", "true or false", "whether a fused list implied a collision", "conflict"),
    Column("conflict_detection_s", "numbers", "when the first list that implied one was available", "conflict"),
    Column("time_to_conflict_detection_s", "numbers", "`conflict_detection_s − onset_s`", "conflict"),
    Column("distance_at_conflict_detection_m", "numbers",
           "true horizontal distance to the ego then, centre to centre", "conflict"),
    _IN_CONFLICT,
    Column("brake_s", "numbers",
           "when braking begins: when the object is known (or at the onset, if it was known before), plus the reaction",
           "braking"),
    Column("braking_pass", "true or false", "more than the margin away throughout", "braking", compared=True),
    Column("min_distance_m", "numbers", "smallest distance from box to box", "braking"),
    Column("impact_s", "numbers", "when the boxes first touch; null when they don't", "braking"),
    Column("impact_speed_mps", "numbers", "the ego's speed then", "braking"),
    Column("required_deceleration_mps2", "numbers",
           "smallest constant deceleration from `brake_s` on with which the ego is never within the margin: 0 if "
           "keeping its speed is enough, infinite if none helps (the gap is used up, or the object comes from "
           "behind), null if not detected. Braking harder is not always better: a standing ego may be run into",
           "braking"),
    Column("matched_lists", "whole numbers", "lists of the stay with a match that counts as a pair", "accuracy"),
    Column("unplaced_lists", "whole numbers", "of these, lists that are available in a gap of the truth", "accuracy"),
    *_as_in_summary("position_rmse_m", "position_rmse_captured_m", "bias_east_m", "bias_north_m", "velocity_rmse_mps",
                    "nees", "age_of_information_s", "identity_switches", when="accuracy"),
    Column("duplicates", "whole numbers", "entries about the object beside its match, in lists from the onset on",
           "accuracy"),
    *_as_in_summary("longest_gap_s", when="accuracy"),
    Column("listed_s", "numbers",
           "the first list, captured at or after the onset, of any of the configuration's units that has the "
           "object, even if it was not sent or did not arrive", "link"),
    Column("sent_s", "numbers",
           "when the list captured at `captured_s` was ready to be sent: its capture plus `ready`, for a recorded list "
           "its stamp. If several units have a list of that capture: the last one that the receiver had by "
           "`detection_s`",
           "link"),
    Column("arrived_s", "numbers",
           "when that list arrived: `sent_s` plus the delay of its link (including the wait in a queue) and "
           "`latency_s`. With `issue_hz` the receiver takes it in at the next tick", "link"),
)  # fmt: skip
_TALLY = (
    *_LOG,
    Column("event", "text", "`detected`, or `conflict`: the first list that implied a collision"),
    _OBJECT, _CLASS, _EPISODE, _ONSET, _ONSET_RANGE, _BEGAN, *_ENDED, _DETECTION, _TIME, *_DISTANCES,
    Column("runs", "whole numbers", "in how many runs it is so"),
    Column("in_conflict", "true or false", "whether the ego is in conflict with the object", "braking"),
    Column("passed", "whole numbers", "in how many of these runs the ego passes", "braking"),
)  # fmt: skip
_EXACT = (
    *_LOG, _OBJECT, _CLASS, _EPISODE, _ONSET, _BEGAN, _DETECTION,
    Column("probability", "numbers", "of being detected at this instant; on the row for never, of missing"),
    Column("incidence", "numbers", "probability of being detected up to this instant"),
    Column("miss_log10", "numbers",
           "log₁₀ of the probability to miss the object, on the row for never; null where detection is certain"),
    *_as_in_summary("miss_per_logit", "miss_log10_half_odds"),
    _TIME, *_DISTANCES, *_ENDED, _IN_CONFLICT,
    Column("pass_probability", "numbers", "of passing if it is detected then, over the reaction's delay", "braking"),
    Column("fail_probability", "numbers", "of failing if it is detected then, over the reaction's delay", "braking"),
)  # fmt: skip
_ACCURACY = (
    *_LOG, _RUN, _OBJECT, _EPISODE,
    Column("first_list", "whole numbers",
           "index, in `available_s` of `instants.parquet`, of the first list of the object's stay"),
    Column("error_m", "lists of numbers", "position error by list of the stay; null without a placed pair"),
    Column("gospa_m2", "lists of numbers",
           "the object's part of GOSPA to its power, by list of the stay (m² where the power is 2); null where it "
           "is not looked at"),
    Column("ghosts", "whole numbers", "ghosts that this object is the nearest of", compared=True),
    Column("first_frame", "whole numbers",
           "index, in `frame_s` of `instants.parquet`, of the first frame of the object's episode", compared=True),
    Column("error_held_m", "lists of numbers",
           "position error of what is held, by frame of the episode; null where the object is not listed",
           compared=True),
    Column("age_held_s", "lists of numbers",
           "frame minus the newest capture of the entry that is held, by frame; null where the object is not listed",
           compared=True),
    Column("gospa_held_m2", "lists of numbers",
           "the object's part of GOSPA of what is held to its power, by frame (m² where the power is 2); null where "
           "the truth does not have it", compared=True),
)  # fmt: skip
_INSTANTS = (
    *_LOG, replace(_RUN, when="fleet"),
    Column("available_s", "lists of numbers", "when each fused list was available, seconds since the log's start",
           compared=True),
    Column("frame_s", "lists of numbers",
           "frames of the truth, thinned to ten a second, seconds since the log's start", compared=True),
    Column("held_list", "lists of whole numbers",
           "index, in `available_s`, of the list that is held at each frame; null where there is none, or where it is "
           "older than `max_age_s`", compared=True),
)  # fmt: skip
_LISTS = (
    *_LOG, _RUN,
    Column("lists", "whole numbers", "fused lists at which there is a place to measure distances from"),
    Column("minutes", "numbers", "minutes of log from the first of them to the last, while the ego is in the log",
           compared=True),
    Column("ghosts", "whole numbers", "entries of measured classes at no object", compared=True),
    Column("stale_ghosts", "whole numbers",
           "of these, entries that were about some object at the instant they tell of"),
    Column("duplicates", "whole numbers", "entries about a measured object beside its match"),
    Column("existence", "lists of numbers", "thresholds of existence", compared=True),
    Column("ghosts_at", "lists of whole numbers", "ghosts that are not stale, of at least that existence",
           compared=True),
    Column("without_truth", "whole numbers",
           "held entries, over all frames, whose measured object has no truth at the frame", compared=True),
)  # fmt: skip
_THRESHOLDS = (
    *_LOG, _RUN, _OBJECT, _EPISODE,
    Column("existence", "numbers", "up to which existence asked for the time holds, from that of the row before on",
           compared=True),
    Column("detection_s", "numbers", "when the object would be known if so much existence were asked for",
           compared=True),
)  # fmt: skip
_BANDS = (
    Column("log", "text", "name of the recording; `all` of distance and existence"), _CONFIGURATION,
    Column("by", "text", "`distance_m` from the ego, `time_s` of the log, or claimed `existence`"),
    Column("from", "numbers", "lower edge, in the band"),
    Column("to", "numbers", "upper edge, not in the band"),
    Column("looked", "numbers", "object × list pairs looked at"),
    Column("missed_share", "numbers", "share of them without a match"),
    Column("ghosts", "numbers", "entries at no object"),
    Column("pairs", "numbers", "matches that have an error"),
    *_as_in_summary("position_rmse_m", "bias_east_m", "bias_north_m", "nees", "nees_expected"),
    Column("entries", "numbers", "entries of measured classes"),
    Column("existence", "numbers", "their mean claimed existence"),
    Column("with_object_share", "numbers", "share of them that are of an object"),
)  # fmt: skip
_LOGS = (
    Column("log", "text", "name of the recording"),
    Column("path", "text", "path of the recording, from the folder of the results, or its URL"),
    Column("sha256", "text", "SHA-256 of the recording"),
    Column("episodes", "whole numbers", "measured objects with an onset"),
    Column("rows", "whole numbers", "rows of `detections.parquet`"),
    Column("state", "text", "`done`, or `skipped`: unreadable (`--skip-unreadable`)"),
    Column("reason", "text", "why it is skipped"),
)
_PROVENANCE = (
    Column("format", "whole number", "version of the folder's format"),
    Column("copem_replay", "text", "version of the package"),
    Column("python", "text", "version of Python"),
    Column("libraries", "by name", "version by library"),
    Column("seed", "whole number", "seed of the experiment"),
    Column("runs", "whole number", "runs of the experiment"),
    Column("logs", "list",
           "of each log: its name `log`, the `topic` of its truth, the file's `sha256`, `truth`, the SHA-256 of what "
           "was read of it, and its `tags`"),
    Column("logs_skipped", "list", "recordings that were left out: `log` and `reason`"),
    Column("visibility", "text", "how visible shares are worked out"),
    Column("max_gap_s", "number", "longest gap of the truth that is interpolated"),
    Column("window_s", "list", "what of each log is read"),
    Column("measure", "by name",
           "section `measure` with every default, and `horizon_used_s`, the horizon of mean times"),
    Column("braking", "by name", "section `braking` with every default"),
    Column("configurations", "by name",
           "what each configuration is: the `truth`, `recorded`, `by_truth_id`, `fixed` (equal in every run) and "
           "`fixed_verdicts`, `needs_visibility` (of its onset), and its `ideal`, ideal fusion of its inputs or units "
           "(`ideal_of`)"),
    Column("run_shown", "by name", "by log the number of the run in `replay.mcap`"),
    Column("runs_shown", "by name",
           "by log every run that is written: `file`, `run`, and `run_is`, why it is this one"),
    Column("notes", "list", "what `run` noted"),
    Column("files", "list", "names of the files that are the results', which `--overwrite` may replace"),
    Column("label", "text", "what the results are called in a history, with `run --label`", "label"),
)  # fmt: skip

_FAR_OFF = "[Definitions](../guide/metrics.md#how-far-off)"
TABLES = {
    "summary.csv": Table(
        "One row per configuration. A column is there where the experiment asks for it. "
        "[Definitions](../guide/metrics.md#one-row-of-summarycsv), [intervals](../guide/metrics.md#intervals). Own "
        "metrics come last.", _SUMMARY),
    "sweep.csv": Table(
        "One row per value of a sweep and configuration; other columns as in `summary.csv`. "
        "[Definitions](../guide/metrics.md#sweeps).",
        (Column("sweep", "text", "key that is swept"), Column("value", "numbers", "its value"), _CONFIGURATION)),
    "summary_by.csv": Table(
        "One row per entry of `measure: {by: …}`, group and configuration; other columns as in `summary.csv`. "
        "[Definitions](../guide/slices.md).", _SUMMARY_BY),
    "detections.parquet": Table(
        "One row per log, configuration, run and measured object. "
        "[Definitions](../guide/metrics.md#one-row-of-detectionsparquet), those of accuracy "
        "[here](../guide/metrics.md#how-far-off), of this object in this run.", _DETECTIONS),
    "tally.parquet": Table(
        "One row per log, configuration, event, object and instant at which it happens in any run, and one for never. "
        "[Definitions](../guide/metrics.md#one-row-of-tallyparquet).", _TALLY),
    "exact.parquet": Table(
        "One row per log, configuration, object and instant at which it may be detected, and one for never, without an "
        "instant. [Definitions](../guide/metrics.md#exactly-without-a-draw).", _EXACT),
    "accuracy.parquet": Table(f"One row per row of `detections.parquet`, in its order. {_FAR_OFF}.", _ACCURACY),
    "instants.parquet": Table(
        "One row per log and configuration, and per run where runs differ in their instants.", _INSTANTS),
    "lists.parquet": Table(f"One row per log, configuration and run. {_FAR_OFF}.", _LISTS),
    "thresholds.parquet": Table(
        f"One row per log, configuration, run, object and step of existence. {_FAR_OFF}.", _THRESHOLDS),
    "bands.csv": Table(
        f"One row per configuration and band; what a band's kind does not have is empty. {_FAR_OFF}.", _BANDS),
    "logs.csv": Table("One row per recording that the experiment names.", _LOGS),
    "provenance.json": Table(
        "What made the results, key by key. [Where it is used](../guide/results.md).", _PROVENANCE),
}  # fmt: skip
"""The files of a results folder, beside the experiment and the replays."""
COMPARED_FILES = ("accuracy.parquet", "instants.parquet", "lists.parquet", "thresholds.parquet")
"""Optional files that comparisons read."""


def read_csv(path: Path) -> pd.DataFrame:
    """A table from CSV: names are text, whatever they look like, and only empty cells are missing."""
    text = {"configuration": str, "sweep": str, "by": str, "group": str}
    table = pd.read_csv(path, dtype=text, na_values=[""], keep_default_na=False)
    return unquote_names(table.fillna({name: "" for name in text if name in table}), [n for n in text if n in table])


def read_frame(path: Path, reader: Callable[[Path], pd.DataFrame], kinds: Mapping[str, str]) -> pd.DataFrame:
    """A table with at least these columns. Raises InputError."""
    try:
        table = reader(path)
    except (OSError, ValueError) as error:  # what Arrow and pandas raise derives from these
        why = " ".join(str(error).split())
        raise InputError(f"{path}: expected a table that can be read, found damage: {why}; {AGAIN}") from None
    check_columns(path, kinds, table.columns)
    for name in (name for name, kind in kinds.items() if kind in ("numbers", "whole numbers")):
        if table[name].dtype.kind not in "iuf" and table[name].notna().any():
            raise InputError(f"{path}: column {name}: expected numbers, found {table[name].dtype}; {AGAIN}")
    return table


def check_columns(path: Path, expected: Iterable[str], found: Collection[str]) -> None:
    """Raise InputError where a column is missing, or there several times."""
    counts = Counter(list(found))
    for name in expected:
        if counts[name] != 1:
            raise InputError(f"{path}: expected the column {name}, found {counts[name] or 'none'}; {AGAIN}")


def check_kind(path: Path, name: str, kind: str, found: pa.DataType) -> None:
    """Raise InputError where a column is of another kind."""
    if not _is_kind(kind, found):
        raise InputError(f"{path}: column {name}: expected {kind}, found {found}; {AGAIN}")


def check_text(path: Path, name: str, column: pa.ChunkedArray) -> None:
    """Raise InputError where a name is missing."""
    if column.null_count:
        raise InputError(f"{path}: column {name}: expected text in every row, found none in some; {AGAIN}")


def _is_kind(kind: str, what: pa.DataType) -> bool:
    import pyarrow as pa

    types = pa.types
    if kind.startswith("lists of "):
        listed = types.is_list(what) or types.is_large_list(what)
        return bool(listed and _is_kind(kind.removeprefix("lists of "), what.value_type))
    if types.is_null(what):  # nothing but nulls
        return kind != "text"
    return bool(
        {
            "text": types.is_string(what) or types.is_large_string(what) or types.is_dictionary(what),
            "whole numbers": types.is_integer(what),
            "numbers": types.is_integer(what) or types.is_floating(what),
            "true or false": types.is_boolean(what),
        }[kind.removesuffix(" or null")]
    )


# The provenance of results: `provenance.json`, read back.


@dataclass(frozen=True)
class RecordedLog:
    """A recording that was replayed: its name in the tables, the topic of its truth, the SHA-256 of its content.

    `truth`: the SHA-256 of its truth, None in results of older versions. `tags`: by name.
    """

    name: str
    topic: str | None
    sha256: str
    truth: str | None = None
    tags: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Provenance:
    """`provenance.json`. `measure` has every default filled in. `data`: the whole file."""

    logs: tuple[RecordedLog, ...]
    seed: int
    runs: int
    visibility: str | None
    max_gap_s: float | None
    window_s: object
    measure: dict[str, Any]
    braking: dict[str, Any] | None
    horizon_used_s: float
    run_shown: dict[str, int]  # by log
    facts: dict[str, ConfigurationFacts]  # by configuration
    data: dict[str, Any]


def check_format(folder: Path) -> None:
    """Raise InputError, one line, where a folder has results of another format; without results nothing is raised."""
    if (folder / MARK).is_file():
        read_provenance(folder / MARK)


_SKIPPED = ("log", "reason")
"""Keys of each of `logs_skipped`."""


def read_provenance(path: Path) -> Provenance:
    """Read `provenance.json`. Raises InputError."""
    try:
        return parse_provenance(parse_json(path.read_text(encoding="utf-8")), path.parent)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        why = f"no {error}" if isinstance(error, KeyError) else " ".join(str(error).split())
        raise InputError(f"{path}: expected the provenance of results, found damage: {why}; {AGAIN}") from None


def parse_provenance(data: Any, place: Path) -> Provenance:
    """What `provenance.json` of the results at a place says. Raises InputError for another format."""
    if (found := dict(data).get("format", 1)) != FORMAT:
        raise InputError(f"{place}: expected results of format {FORMAT}, found format {found}; {AGAIN}")
    logs = tuple(
        RecordedLog(str(log["log"]), log.get("topic"), str(log["sha256"]), log.get("truth"), _parse_tags(log))
        for log in data["logs"]
    )
    notes = [*data.get("notes", []), *(log[name] for log in data.get("logs_skipped", []) for name in _SKIPPED)]
    if not all(isinstance(note, str) for note in notes):
        raise ValueError("expected text in notes and logs_skipped")
    # A missing key, from an older version, stands for its default.
    measure = Measure().model_dump(mode="json", by_alias=True) | dict(data["measure"])
    float(measure["gospa"]["power"])  # which comparisons take as it is
    braking, gap_s = data.get("braking"), data.get("max_gap_s")
    used_s, run_shown = float(measure.pop("horizon_used_s")), data.get("run_shown") or {}
    return Provenance(
        logs=logs,
        seed=int(data["seed"]),
        runs=int(data["runs"]),
        visibility=data.get("visibility"),
        max_gap_s=None if gap_s is None else float(gap_s),
        window_s=data.get("window_s"),
        measure=measure,
        braking=None if braking is None else dict(braking),
        horizon_used_s=used_s,
        run_shown={str(log): int(run) for log, run in run_shown.items() if run is not None},
        facts={str(name): ConfigurationFacts(**of) for name, of in dict(data["configurations"]).items()},
        data=data,
    )


def _parse_tags(log: Any) -> dict[str, str]:
    tags = dict(log.get("tags", {}))
    if not all(isinstance(text, str) for text in (*tags, *tags.values())):
        raise ValueError(f"expected text in tags of log {log['log']}")
    return tags


# Common to all kinds of results: recordings, versions, tables.

_LIBRARIES = (
    "foxglove-schemas-protobuf", "mcap", "numba", "numpy", "osi-python", "pandas", "protobuf", "pyarrow", "rerun-sdk",
    "scipy", "shapely",
)  # fmt: skip
ROWS_A_GROUP = 1 << 17
GROUP_BYTES = 1 << 26
"""Rows of a row group of Parquet, at most, and about their bytes: it is in memory as a whole, where it is written and
where it is compared."""


def log_entries(logs: Sequence[Any], recordings: Sequence[Recording], folder: Path) -> list[Any]:
    """`logs` of the folder's experiment: paths relative to the folder, with settings where logs have them."""

    def called(file: File) -> str:
        return recording_name(file, folder)

    settings = [entry for entry in logs if isinstance(entry, LogSettings)]
    if len(settings) < len(recordings):
        return [called(first_recording(recording.place)) for recording in recordings]
    moved = (relocate_settings(one, r.place, called) for one, r in zip(settings, recordings, strict=True))
    return [one.model_dump(mode="json", by_alias=True) for one in moved]


def recording_name(file: File, folder: Path) -> str:
    """The name of a recording in results: its path relative to the folder, or its URL without user and query."""
    return str(file) if isinstance(file, RemoteFile) else os.path.relpath(resolve_place(file), folder)


def list_versions() -> dict[str, object]:
    """Versions of this project, of Python, and of the libraries that results depend on."""
    return {
        "copem_replay": version("copem-replay"),
        "python": platform.python_version(),
        "libraries": {name: version(name) for name in _LIBRARIES},
    }


def describe_logs(recordings: Sequence[Recording]) -> list[dict[str, object]]:
    """Name, topic and content digests of each recording."""
    return [{"log": r.scene.log, "topic": r.topic, **compute_log_digests(r)} for r in recordings]


def write_parquet(table: Any, path: Path) -> None:
    """Write a table, of pandas or Arrow, as Parquet: NaN as null, text as `string` whatever type pandas has."""
    with TableFile(path) as file:
        file.add(table)


class TableFile:
    """A Parquet file written part by part; row groups do not depend on the parts, whose columns are equal."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._writer: parquet.ParquetWriter | None = None
        self._left: pa.Table | None = None  # rows of an incomplete group
        self._written = False  # whether any group

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if self._writer is not None and self._left is not None:
            if error[0] is None and (len(self._left) or not self._written):
                self._write(self._left)
            self._writer.close()

    def add(self, table: Any) -> None:
        """Add rows."""
        arrow = pa.Table.from_pandas(table, preserve_index=False) if isinstance(table, pd.DataFrame) else table
        fields = [pa.field(f.name, pa.string()) if pa.types.is_large_string(f.type) else f for f in arrow.schema]
        arrow = arrow.cast(pa.schema(fields, arrow.schema.metadata))
        if self._writer is None:
            self._writer = parquet.ParquetWriter(self._path, arrow.schema, compression="zstd")
        if self._left is not None:
            arrow = pa.concat_tables([self._left, arrow])
        while (count := _count_group_rows(arrow)) <= len(arrow):
            self._write(arrow.slice(0, count))
            arrow = arrow.slice(count)
        self._left = arrow

    def _write(self, rows: pa.Table) -> None:
        """Write a row group, as one chunk whatever the chunks of its rows."""
        assert self._writer is not None
        self._writer.write_table(rows.combine_chunks(), row_group_size=ROWS_A_GROUP)
        self._written = True


def _count_group_rows(table: pa.Table) -> int:
    """How many rows of a table are its first row group; one more than there are: no group is complete."""
    sizes = np.zeros(min(len(table), ROWS_A_GROUP), dtype=np.int64)
    for column in table.slice(0, ROWS_A_GROUP).columns:
        if pa.types.is_list(column.type) or pa.types.is_large_list(column.type):
            lengths = pc.fill_null(pc.list_value_length(column), 0).to_numpy()
            sizes += lengths * (column.type.value_type.bit_width // 8)
    return min(int(np.searchsorted(np.cumsum(sizes), GROUP_BYTES)) + 1, ROWS_A_GROUP)


# Names in CSV files. A name that begins with `=`, `+`, `-`, `@`, a tab or a line's end gets an apostrophe before it,
# which tells spreadsheets that it is text; so does one that begins with an apostrophe, so that taking one away gives
# every name back.

_QUOTE = "'"
_QUOTED = ("=", "+", "-", "@", "\t", "\r", "\n", _QUOTE)


def quote_formulas(table: pd.DataFrame) -> pd.DataFrame:
    """A table with an apostrophe before each text that a spreadsheet would take for a formula; numbers stay."""
    text = [name for name, column in table.items() if not pd.api.types.is_numeric_dtype(column)]
    return table.assign(**{name: table[name].map(_quote_cell) for name in text})


def unquote_names(table: pd.DataFrame, columns: Iterable[str]) -> pd.DataFrame:
    """A table with the names in `columns` as they were before `quote_formulas`."""
    return table.assign(**{name: table[name].map(_unquote_cell) for name in columns})


def _quote_cell(value: Any) -> Any:
    return _QUOTE + value if isinstance(value, str) and value.startswith(_QUOTED) else value


def _unquote_cell(value: Any) -> Any:
    return value.removeprefix(_QUOTE) if isinstance(value, str) else value

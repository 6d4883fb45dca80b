"""The columns of results: every column of every file of a results folder, and of a comparison, once.

A column states its kind, what it means, and what an experiment has to ask for so that it is there. What makes tables,
writers, readers, `compare`, and the reference of the columns (`tools/column_reference.py`) go by it. Columns of the
summary are the metrics of `metrics/summary_metrics.py`. Units are in the names, and in Parquet beside each column.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import pandas as pd
import pyarrow as pa

from copem_replay.metrics.config import CAUSES
from copem_replay.metrics.summary_metrics import METRIC, METRICS_OF

_IN_PANDAS = {"text": "object", "numbers": "float64", "whole numbers": "Int64", "true or false": "boolean"}
_IN_ARROW = {"text": pa.string(), "numbers": pa.float64(), "whole numbers": pa.int64(), "true or false": pa.bool_()}


_UNITS = {
    "deg": "deg", "hz": "Hz", "m": "m", "m2": "m²", "minutes": "min",
    "mps": "m/s", "mps2": "m/s²", "rad": "rad", "s": "s",
}  # fmt: skip


def find_unit(name: str) -> str | None:
    """The unit of a column, by the last word of its name; None: it counts, names, or is a share.

    >>> find_unit("required_deceleration_mps2")
    'm/s²'
    """
    return _UNITS.get(name.rpartition("_")[2])


@dataclass(frozen=True)
class Column:
    """A column of a file, or a key of `provenance.json`.

    `kind`: text, text or null, numbers, whole numbers, true or false, or lists of these. `when`: what an experiment
    has to ask for (`braking`, `conflict`, `needless`, `accuracy`, `areas`; `link`: also `issue_hz`, `ready`, `sends`;
    `fleet`: units that only some runs have); empty: it is always there. `compared`: comparisons read it. `single`: in
    single precision. `full`: no row is without it. `infinite`: numbers may be infinite. `among`: the words it may have;
    empty: any.
    """

    name: str
    kind: str
    words: str
    when: str = ""
    compared: bool = False
    single: bool = False
    full: bool = False
    infinite: bool = False
    among: tuple[str, ...] = ()

    @property
    def arrow(self) -> pa.DataType:
        """Its type in Arrow."""
        if self.single:  # so many that they want 64-bit offsets, too
            return pa.large_list(pa.float32())
        inner = _IN_ARROW[self.kind.removeprefix("lists of ").removesuffix(" or null")]
        return pa.list_(inner) if self.kind.startswith("lists of ") else inner


@dataclass(frozen=True)
class Table:
    """A file of results: what a row of it is, and its columns in their order."""

    words: str
    columns: tuple[Column, ...]
    keys: tuple[str, ...] = ()  # columns that no two rows have alike

    def kinds(self, *when: str, compared: bool = False) -> dict[str, str]:
        """The kinds of the columns that are always there, and of those that are there `when` this is asked for."""
        every = [column for column in self.columns if column.when in ("", *when)]
        return {column.name: column.kind for column in every if column.compared or not compared}

    def frame(self, rows: Sequence[Mapping[str, object]]) -> pd.DataFrame:
        """Rows as pandas, with all columns in their order and types; missing: null."""
        types = {name: _IN_PANDAS[kind.removesuffix(" or null")] for name, kind in self.kinds().items()}
        return pd.DataFrame(rows, columns=list(types)).astype(types)


_CONFIGURATION = Column("configuration", "text", "name of the configuration, as in the experiment", compared=True)
_LOG = (Column("log", "text", "name of the recording", compared=True), _CONFIGURATION)
_RUN = Column("run", "whole numbers", "number of the run, from 0 on", compared=True, full=True)
_OBJECT = Column("object_id", "text", "id of the object in the truth", compared=True)
_CLASS = Column("object_class", "text", "class of the object in the truth")
_EPISODE = Column("episode", "whole numbers",
                  "which episode of the object, from 0 on; above 0 only with "
                  "[`again_after_s`](../guide/metrics.md#who-comes-back)", compared=True, full=True)  # fmt: skip
_ONSET = Column("onset_s", "numbers",
                "when the clock starts, in seconds since the log's start: the first frame at which the onset's "
                "condition holds while the ego is in the log. An object without onset has no row",
                compared=True, full=True)  # fmt: skip
_ONSET_RANGE = Column("distance_at_onset_m", "numbers",
                      "true horizontal distance to the ego at `onset_s`, centre to centre; null when there is none to "
                      "measure from")  # fmt: skip
_BEGAN = Column("began", "text",
                "how the episode began: `log_start`, `appeared` or `crossed`, "
                "[below](../guide/metrics.md#which-objects-count)", compared=True)  # fmt: skip
_AREA = Column("area", "text or null",
               "the [area](../guide/place.md#only-what-happens-in-an-area) in which the object's centre is at "
               "`onset_s`: the first of one's own, else the kind of a map's; null in none", "areas")  # fmt: skip
_ENDED = (
    Column("ended_s", "numbers", "the end of the episode; a list that arrives later does not count", compared=True,
           full=True),
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
                      "`required_deceleration_mps2` are null where it is not", "braking", compared=True,
                      full=True)  # fmt: skip


def _as_in_summary(*names: str, kind: str = "numbers", when: str = "") -> tuple[Column, ...]:
    return tuple(Column(name, kind, METRIC[name].help, when, among=METRIC[name].among) for name in names)


_SUMMARY = (
    _CONFIGURATION,
    *(
        Column(metric.name, metric.kind, metric.help, when, among=metric.among)
        for when, of in METRICS_OF.items()
        for metric in of
    ),
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
    *_LOG, _RUN, _OBJECT, _CLASS, _EPISODE, _ONSET, _ONSET_RANGE, _BEGAN, _AREA,
    Column("detected", "true or false", "whether the object was detected", compared=True, full=True),
    _DETECTION,
    Column("captured_s", "numbers", "newest capture that contributed to that list"),
    Column("in_sight_s", "numbers",
           "the first list, captured at or after the onset, of any of the configuration's units that has the object in "
           "sight: within range and view, and not hidden. Null if never, or not known (for the truth, and with "
           "recorded units without `views`)"),
    Column("out_of_view_s", "numbers",
           "from the onset until a unit first lists the object, or the episode's end: seconds in which it is out of "
           "range or view of all of the configuration's units; null where `in_sight_s` is not known"),
    Column("hidden_s", "numbers", "seconds of that time in which it is hidden from all units that have it in view"),
    _TIME, *_DISTANCES, *_ENDED,
    Column("first_unit", "text or null",
           "the unit of the newest list that makes the object known (of lists captured together the first of the "
           "experiment); null for a stack's output, `truth` for GT"),
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
           "braking", infinite=True),
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
    _OBJECT, _CLASS, _EPISODE, _ONSET, _ONSET_RANGE, _BEGAN, _AREA, *_ENDED, _DETECTION, _TIME, *_DISTANCES,
    Column("runs", "whole numbers", "in how many runs it is so", full=True),
    Column("in_conflict", "true or false", "whether the ego is in conflict with the object", "braking", full=True),
    Column("passed", "whole numbers", "in how many of these runs the ego passes", "braking", full=True),
)  # fmt: skip
_EXACT = (
    *_LOG, _OBJECT, _CLASS, _EPISODE, _ONSET, _BEGAN, _DETECTION,
    Column("probability", "numbers", "of being detected at this instant; on the row for never, of missing", full=True),
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
    Column("error_m", "lists of numbers", "position error by list of the stay; null without a placed pair",
           single=True),
    Column("gospa_m2", "lists of numbers",
           "the object's part of GOSPA to its power, by list of the stay (m² where the power is 2); null where it "
           "is not looked at", single=True),
    Column("ghosts", "whole numbers", "ghosts that this object is the nearest of", compared=True),
    Column("first_frame", "whole numbers",
           "index, in `frame_s` of `instants.parquet`, of the first frame of the object's episode", compared=True),
    Column("error_held_m", "lists of numbers",
           "position error of what is held, by frame of the episode; null where the object is not listed",
           compared=True, single=True),
    Column("age_held_s", "lists of numbers",
           "frame minus the newest capture of the entry that is held, by frame; null where the object is not listed",
           compared=True, single=True),
    Column("gospa_held_m2", "lists of numbers",
           "the object's part of GOSPA of what is held to its power, by frame (m² where the power is 2); null where "
           "the truth does not have it", compared=True, single=True),
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
    Column("ghosts", "whole numbers", "entries of measured classes about nobody, then or now", compared=True),
    Column("stale_ghosts", "whole numbers", "beside these, entries about somebody who is elsewhere now"),
    Column("duplicates", "whole numbers", "entries about a measured object beside its match"),
    Column("existence", "lists of numbers", "thresholds of existence", compared=True),
    Column("ghosts_at", "lists of whole numbers", "ghosts of at least that existence",
           compared=True),
    Column("without_truth", "whole numbers",
           "held entries, over all frames, whose measured object has no truth at the frame", compared=True),
    Column("driving_s", "numbers", "seconds in which the ego drives, by its own frames: the same in all configurations",
           "needless", compared=True),
    Column("needless_brakes", "whole numbers",
           "how often the driver [brakes for nothing](../guide/metrics.md#braking-for-nothing)", "needless"),
    Column("needless_s", "numbers", "for how long, in all", "needless", compared=True),
    Column("needless_s_at", "lists of numbers", "the same with entries of at least that existence alone", "needless"),
    Column("speed_lost_mps", "numbers", "the most speed that braking for nothing takes at once", "needless"),
    Column("must_brake_s", "numbers", "seconds in which the driver must brake by the truth", "needless"),
    Column("must_brake_missed_s", "numbers", "of these, seconds in which he does not brake by the lists", "needless"),
)  # fmt: skip
_NEEDLESS = (
    *_LOG, _RUN,
    Column("begins_s", "numbers", "when it begins: the list for which the driver brakes is available", full=True),
    Column("lasts_s", "numbers", "how long it lasts, with pauses of `merge_s` or less"),
    Column("speed_lost_mps", "numbers", "the speed that the driver's deceleration takes in its needless time"),
    Column("cause", "text",
           "whose entry it is: `ghost`, at no object; `duplicate` of another entry; `late`: true at its capture; else "
           "`misplaced`", among=CAUSES),
    Column("object_id", "text or null", "id of the true object that the entry is about; null for none"),
    Column("object_class", "text", "class of the entry"),
    Column("track_id", "text or null", "track of the entry; null where the fusion names none"),
    Column("x_m", "numbers", "listed place of the entry, east"),
    Column("y_m", "numbers", "listed place of the entry, north"),
)  # fmt: skip
_FALSE_TRACKS = (
    *_LOG, _RUN,
    Column("begins_s", "numbers", "when its first list is available", full=True),
    Column("lasts_s", "numbers", "until when lists hold it, since then"),
    Column("entries", "whole numbers", "its entries: all together are the `ghosts` of `lists.parquet`"),
    Column("units", "text or null", "by whose entries, of the most first; null: the fusion does not say"),
    Column("object_class", "text", "class of its first entry"),
    Column("track_id", "text or null", "the fusion's track; null: it names none, and entries are linked"),
    Column("existence", "numbers", "its highest"),
    Column("x_m", "numbers", "listed place of its first entry, east"),
    Column("y_m", "numbers", "the same, north"),
    Column("to_x_m", "numbers", "listed place of its last entry, east"),
    Column("to_y_m", "numbers", "the same, north"),
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
    Column("ghosts", "numbers", "entries about nobody"),
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
_READ = (
    Column("log", "text", "name of the recording"),
    Column("topic", "text", "topic of its truth"),
    Column("frames", "whole numbers", "lists of the truth that are replayed"),
    Column("entries", "whole numbers", "object states of the truth and of recorded lists that are replayed"),
    Column("number", "whole numbers", "how many were left out or mended; 0: none was"),
    Column("what", "text", "what they are, why, and what was done"),
    Column("changes", "text", "`yes`: figures may depend on it"),
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
           "was read of it, its `tags`, and what was left out or mended of it, `read`: `number`, `what`, and whether "
           "it `changes` figures"),
    Column("logs_skipped", "list", "recordings that were left out: `log` and `reason`"),
    Column("visibility", "text", "how visible shares are worked out"),
    Column("max_gap_s", "number", "longest gap of the truth that is interpolated"),
    Column("window_s", "list", "what of each log is read"),
    Column("measure", "by name",
           "section `measure` with every default, and `horizon_used_s`, the horizon of mean times"),
    Column("braking", "by name", "section `braking` with every default"),
    Column("configurations", "by name",
           "what each configuration is: the `truth`, `recorded`, `by_truth_id`, `fixed` (equal in every run) and "
           "`fixed_verdicts`, `needs_visibility` (of its onset), its `ideal`, ideal fusion of its inputs or units "
           "(`ideal_of`), `remembering`, the one with memory that its accuracy is held against, `least_s`, below which "
           "no time to detection is"),
    Column("run_shown", "by name", "by log the number of the run in `replay.mcap`"),
    Column("runs_shown", "by name",
           "by log every run that is written: `file`, `run`, and `run_is`, why it is this one"),
    Column("notes", "list", "what `run` noted"),
    Column("files", "list", "names of the files that are the results', which `--overwrite` may replace"),
    Column("label", "text", "what the results are called in a history, with `run --label`", "label"),
    Column("sha256", "by name",
           "by file of the results its SHA-256, but of recordings for Rerun, whose bytes are others each time; of "
           "`provenance.json` that of the rest of its content"),
)  # fmt: skip

_FAR_OFF = "[Definitions](../guide/metrics.md#how-far-off)"
TABLES = {
    "summary.csv": Table(
        "One row per configuration. A column is there where the experiment asks for it. "
        "[Definitions](../guide/metrics.md#one-row-of-summarycsv), [intervals](../guide/metrics.md#intervals). Own "
        "metrics come last.", _SUMMARY, keys=("configuration",)),
    "sweep.csv": Table(
        "One row per value of a sweep and configuration; other columns as in `summary.csv`. "
        "[Definitions](../guide/metrics.md#sweeps).",
        (Column("sweep", "text", "key that is swept"), Column("value", "numbers", "its value"), _CONFIGURATION),
        keys=("sweep", "value", "configuration")),
    "summary_by.csv": Table(
        "One row per entry of `measure: {by: …}`, group and configuration; other columns as in `summary.csv`. "
        "[Definitions](../guide/slices.md).", _SUMMARY_BY, keys=("by", "group", "configuration")),
    "detections.parquet": Table(
        "One row per log, configuration, run and measured object. "
        "[Definitions](../guide/metrics.md#one-row-of-detectionsparquet), those of accuracy "
        "[here](../guide/metrics.md#how-far-off), of this object in this run.", _DETECTIONS),
    "tally.parquet": Table(
        "One row per log, configuration, event, object and instant at which it happens in any run, and one for never. "
        "[Definitions](../guide/metrics.md#one-row-of-tallyparquet).", _TALLY,
        keys=("log", "configuration", "event", "object_id", "episode", "detection_s")),
    "exact.parquet": Table(
        "One row per log, configuration, object and instant at which it may be detected, and one for never, without an "
        "instant. [Definitions](../guide/metrics.md#exactly-without-a-draw).", _EXACT,
        keys=("log", "configuration", "object_id", "episode", "detection_s")),
    "accuracy.parquet": Table(f"One row per row of `detections.parquet`, in its order. {_FAR_OFF}.", _ACCURACY),
    "instants.parquet": Table(
        "One row per log and configuration, and per run where runs differ in their instants.", _INSTANTS),
    "lists.parquet": Table(f"One row per log, configuration and run. {_FAR_OFF}.", _LISTS),
    "thresholds.parquet": Table(
        f"One row per log, configuration, run, object and step of existence. {_FAR_OFF}.", _THRESHOLDS),
    "false_tracks.parquet": Table(
        "One row per log, configuration, run and false track. [Definitions](../guide/metrics.md#false-tracks).",
        _FALSE_TRACKS),
    "needless.parquet": Table(
        "One row per log, configuration, run and time that the driver brakes for nothing. "
        "[Definitions](../guide/metrics.md#braking-for-nothing).", _NEEDLESS),
    "bands.csv": Table(
        f"One row per configuration and band; what a band's kind does not have is empty. {_FAR_OFF}.", _BANDS),
    "logs.csv": Table("One row per recording that the experiment names.", _LOGS),
    "read.csv": Table(
        "One row per kind of thing that was left out or mended when a recording was read; one for one without.", _READ),
    "provenance.json": Table(
        "What made the results, key by key. [Where it is used](../guide/results.md).", _PROVENANCE),
}  # fmt: skip
"""The files of a results folder, beside the experiment and the replays."""
COMPARED_FILES = ("accuracy.parquet", "instants.parquet", "lists.parquet", "thresholds.parquet")
"""Optional files that comparisons read."""
NEEDLESS, FALSE_TRACKS = "needless.parquet", "false_tracks.parquet"


def find_columns(name: str) -> dict[str, Column]:
    """By name the columns that a file may have, with those that it has as `summary.csv` has them."""
    shared = _SUMMARY if name in ("sweep.csv", "summary_by.csv") else ()
    return {column.name: column for column in (*shared, *TABLES[name].columns)}


COMPARISON = Table(
    "One row per log (`all`, and each where there are several), configuration and metric. "
    "[Definitions](../guide/metrics.md#compared).",
    (
        Column("log", "text", "name of the log; `all`: all logs together"),
        Column("configuration", "text", "the configuration; of several folders with that of the folder"),
        Column("baseline", "text", "what it is compared with"),
        Column("metric", "text", "what is compared"),
        Column("value", "numbers", "of the configuration, over what both have"),
        Column("baseline_value", "numbers", "of the baseline, over what both have"),
        Column("difference", "numbers", "configuration minus baseline"),
        Column("low", "numbers", "lower limit of the difference, 95 %"),
        Column("high", "numbers", "upper limit of the difference, 95 %"),
        Column("interval", "text or null",
               "kind of the limits, or why there are none, [here](../guide/metrics.md#intervals)"),
        Column("interval_over", "text or null",
               "what the limits are over: logs, objects of one log, passes or runs of one object"),
        Column("n", "whole numbers", "rows that both have and that count; of what is held, pairs or frames"),
        Column("p_value", "numbers", "of a share: McNemar's exact test"),
        Column("only_configuration", "whole numbers",
               "pairs of which only the configuration detects, passes or lists the object"),
        Column("only_baseline", "whole numbers", "pairs of which only the baseline does"),
        Column("existence", "numbers", "at equal ghosts: up to which threshold of existence entries are left out"),
        Column("baseline_existence", "numbers", "the same of the baseline"),
        Column("ghosts_kept_per_min", "numbers", "ghosts per minute that remain"),
        Column("baseline_ghosts_kept_per_min", "numbers", "the same of the baseline"),
        Column("clusters", "whole numbers", "how many logs, objects or runs the limits are over"),
        Column("logs_better", "whole numbers", "logs in which the configuration is better"),
        Column("hangs_on", "text or null", "the log on which the difference hangs"),
        Column("difference_without_it", "numbers", "the difference without that log"),
        Column("frames", "whole numbers", "frames at which what is held is compared"),
        Column("age_s", "numbers", "mean age of the entries in pairs"),
        Column("baseline_age_s", "numbers", "the same of the baseline"),
        Column("no_list_share", "numbers", "share of the frames without a list"),
        Column("baseline_no_list_share", "numbers", "the same of the baseline"),
        Column("without_truth", "whole numbers", "held entries whose object has no truth at the frame"),
        Column("baseline_without_truth", "whole numbers", "the same of the baseline"),
        Column("low_bounded", "numbers",
               "lower limit with one cluster that was not seen at the far end: a criterion is met by it alone"),
        Column("high_bounded", "numbers", "upper limit so"),
        Column("star", "text or null",
               "`*`: differs from 0 with the whole table held at 95 %; `°`: its own interval alone excludes 0"),
        Column("word", "text or null", "better, worse, alike or open, by the least difference that matters"),
    ),
)  # fmt: skip
"""The table of a comparison, which is in no folder."""

"""Status in words and lines: why a configuration knows an object or not; `pipeline/status.py` has the statuses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from copem_replay.communication.arrivals import fusion_schedule
from copem_replay.core.colours import Rgb
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import TRUTH, Bool, Float, Int, Scene, Tracks
from copem_replay.experiment.schema import Experiment
from copem_replay.perception.sight import HIDDEN, IN_SIGHT, OUT_OF_VIEW
from copem_replay.pipeline.prepare import Replay
from copem_replay.pipeline.sight import ABSENT, Sight, StatusSpan, name_bodies
from copem_replay.pipeline.status import (
    EARLY,
    KNOWN,
    LOST,
    NOT_SENT,
    STATUSES,
    TOO_LATE,
    UNCONFIRMED,
    UNDER_WAY,
    UNLISTED,
    UNMATCHED,
    Status,
    to_nanoseconds,
)
from copem_replay.viewer.camera import below_bodies
from copem_replay.viewer.sensors import unit_places
from copem_replay.viewer.sink import (
    HIDES,
    WORDS_COLOUR,
    RecordingSink,
    configuration_part,
    join_points,
    short_ids,
    stack_float32,
)

# Reasons in words why a configuration knows an object or not: a label in the picture, a sentence on selection.

OLD_S = 0.05
"""Greatest age that words leave out: less than the time from list to list."""


@dataclass(frozen=True)
class Reasons:
    """The label over an object and the sentence on its selection, for pairs (P,) of instant and object.

    `number`: equal for equal sentences.
    """

    labels: pa.Array
    sentences: pa.Array
    number: Int


def explain_status(
    scene: Scene, experiment: Experiment, sight: Sight, statuses: Status, rows: Int, column: Int
) -> Reasons:
    """Words for (P,) pairs; each distinct sentence is made once."""
    frame, status, unit = (
        np.maximum(statuses.frame[rows], 0),
        statuses.status[rows, column],
        statuses.unit_ix[rows, column],
    )
    hidden = np.flatnonzero(status == HIDDEN)
    by = unit[hidden], frame[hidden], column[hidden]
    share, body = np.zeros(len(rows)), np.zeros(len(rows), dtype=np.int64)
    share[hidden], body[hidden] = sight.share[by], sight.body_ix[by]
    time_s = np.nan_to_num(
        np.where(status >= EARLY, statuses.age_of_information_s[rows, column], statuses.until_s[rows, column])
    )
    near = sight.in_range[:, frame, column].any(axis=0)
    rounded = [np.rint(value).astype(np.int64) for value in (time_s * 10, share * 100)]
    columns = np.stack([column, status, unit, *rounded, body, near], axis=-1)
    keys, key_ix = _find_distinct_rows(columns)
    ids, units = short_ids(scene), [*experiment.units, TRUTH]  # index −1: the truth, or no unit
    bodies = name_bodies(scene, sight.solids, ids)
    details = [(ids[sight.object_ix[key[0]]], units[key[2]], bodies[key[5]], key) for key in keys.tolist()]
    take_ix = pa.array(key_ix)
    labels = [_format_label(name, unit, hider, key) for name, unit, hider, key in details]
    sentences = [_format_sentence(name, unit, hider, key) for name, unit, hider, key in details]
    return Reasons(pa.array(labels, pa.string()).take(take_ix), pa.array(sentences, pa.string()).take(take_ix), key_ix)


def _find_distinct_rows(columns: Int) -> tuple[Int, Int]:
    """The distinct rows (D, C), and the index (P,) of each row among them. Rows become numbers, which sort faster."""
    low = columns.min(axis=0, initial=0)
    span = columns.max(axis=0, initial=0) - low + 1
    packed = np.ravel_multi_index(tuple((columns - low).T), tuple(span.tolist()))
    _, first, which = np.unique(packed, return_index=True, return_inverse=True)
    return columns[first], which.reshape(-1)


def _format_label(name: str, unit: str, hider: str, key: list[int]) -> str:
    """The words at an object in the scene, such as “58 behind car 41”; of a known object its name alone."""
    _, status, _, _, _, _, near = key
    words = {
        KNOWN: "",
        EARLY: " listed",
        UNCONFIRMED: " not confirmed",
        TOO_LATE: " too late",
        UNDER_WAY: " on its way",
        UNMATCHED: " unmatched",
        LOST: " list lost",
        NOT_SENT: " not sent",
        UNLISTED: " not listed",
        IN_SIGHT: " not listed yet" if unit == TRUTH else " not listed",
        HIDDEN: f" behind {hider}",
    }
    return name + words.get(status, " no unit there" if unit == TRUTH else " out of view" if near else " out of range")


def _format_sentence(name: str, unit: str, hider: str, key: list[int]) -> str:
    """The status as a sentence, such as “58 hidden from ego by car 41 (share 0.21)”; `key`: numbers it depends on."""
    _, status, _, tenths, hundredths, _, near = key
    if status >= EARLY:
        age_text = "" if tenths * 0.1 <= OLD_S else f", {tenths / 10:.1f} s old"
        words_after = {EARLY: age_text, UNCONFIRMED: f"{age_text}, not confirmed yet", TOO_LATE: f" too late{age_text}"}
        return f"{name} known{age_text}" if status == KNOWN else f"{name} listed{words_after[status]}"
    if status == UNDER_WAY:
        return f"{name} listed by {unit}, arrives in {tenths / 10:.1f} s"
    if status == UNMATCHED:
        return f"{name} listed by {unit}, no entry matched"
    if status == LOST:
        return f"{name} listed by {unit}, list lost"
    if status == NOT_SENT:
        return f"{name} listed by {unit}, left out of its message"
    if status == IN_SIGHT:
        return f"{name} not listed yet" if unit == TRUTH else f"{name} seen by {unit}, not listed"
    if status == UNLISTED:
        return f"{name} not listed"
    if status == HIDDEN:
        return f"{name} hidden from {unit} by {hider} (share {hundredths / 100:.2f})"
    if unit == TRUTH:
        return f"{name}: no unit there"
    return f"{name} outside fields of view" if near else f"{name} out of range"


def lane_text(span: StatusSpan) -> str:
    """The text of a span in a lane or a story: “behind car 41 (from ego)”."""
    words = {
        HIDDEN: f"behind {span.body} (from {span.unit})",
        IN_SIGHT: f"seen by {span.unit}, not listed" if span.unit else "not listed yet",
        UNDER_WAY: f"on its way from {span.unit}" if span.unit else "on its way",
        OUT_OF_VIEW: STATUSES[OUT_OF_VIEW] if span.unit else "no unit there",
    }
    return words.get(span.status, STATUSES[span.status])


# Words below the shown objects, lines to hiding bodies, lines of sight of the units that listed objects first.

RAY_ALPHA = 110
"""Opacity of lines of sight, of 255: what is behind them stays visible."""


def write_status_words(
    out: RecordingSink,
    name: str,
    replay: Replay,
    experiment: Experiment,
    sight: Sight,
    statuses: Status,
    up_rad: Mapping[str, Float],
) -> None:
    """Write below the true place of each object “58 behind car 41”, and a sentence that selecting it shows.

    `up_rad`: for each entity with the words, what is up in the pictures that show it, to be broadcast to (K, M).
    """
    import rerun as rr

    rows, column = np.nonzero((statuses.status != ABSENT) & ~np.isnan(statuses.body["x_m"]))
    reasons = explain_status(replay.scene, experiment, sight, statuses, rows, column)
    counts = np.bincount(rows, minlength=len(statuses.elapsed_ns))
    numbers = np.full(statuses.status.shape, -1)
    numbers[rows, column] = reasons.number
    changes = np.append(True, (numbers[1:] != numbers[:-1]).any(axis=1))[: len(numbers)]
    # Words move with the boxes at frames of the truth; at other instants a row is needed only for a change.
    drawn = changes | np.isin(statuses.elapsed_ns, sight.elapsed_ns)
    drawn_rows = drawn[rows]
    # Sentences have rows only where one changes: the viewer shows the newest.
    told_then = reasons.sentences.filter(pa.array(changes[rows]))
    for entity, headings in up_rad.items():
        place = below_bodies(statuses.body, headings)[:, rows, column]
        columns = rr.Points3D.columns(
            positions=stack_float32(*place[:, drawn_rows]), labels=reasons.labels.filter(pa.array(drawn_rows))
        )
        path = ["world", configuration_part(name), entity]
        out.columns(path, statuses.elapsed_ns[drawn], columns.partition(counts[drawn]))
        no_dots = rr.Radius.ui_points(0.0)
        out.static(path, rr.Points3D.from_fields(colors=[WORDS_COLOUR], radii=no_dots, show_labels=True))
        sentences = rr.DynamicArchetype.columns(archetype="why", components={"why": told_then})
        out.columns(path, statuses.elapsed_ns[changes], sentences.partition(counts[changes]))


def write_hiding_lines(out: RecordingSink, name: str, sight: Sight, statuses: Status) -> None:
    """Write lines from the unit that sees most of a hidden object to the body that hides it."""
    import rerun as rr

    rows, column = np.nonzero(statuses.status == HIDDEN)
    if not len(rows):
        return
    by, frame = statuses.unit_ix[rows, column], statuses.frame[rows]
    lines = np.stack([sight.place_m[by, frame], sight.body_m[by, frame, column]], axis=1)
    counts = np.bincount(rows, minlength=len(statuses.elapsed_ns))
    instants = np.flatnonzero((counts > 0) | (np.append(0, counts[:-1]) > 0))  # one empty row ends the lines
    path = ["world", configuration_part(name), "hiding"]
    columns = rr.LineStrips3D.columns(strips=join_points(lines)).partition(counts[instants])
    out.columns(path, statuses.elapsed_ns[instants], columns)
    out.static(path, rr.LineStrips3D.from_fields(colors=[HIDES], radii=rr.Radius.ui_points(1.25)))


def write_listing_lines(
    out: RecordingSink, name: str, replay: Replay, experiment: Experiment, fused_tracks: FusedTracks, sight: Sight,
    colour: Rgb, first_unit: Mapping[int, str],
) -> None:  # fmt: skip
    """Write lines from a unit's place at capture to its entry of each shown object, for the unit that listed it first.

    `first_unit`: that unit by object, from the table; for other objects it is the unit whose list arrived first.
    """
    import rerun as rr

    if not len(sight.object_ix):
        return
    lists = fused_tracks.received
    schedule = fusion_schedule(lists, max_age_s=experiment.configurations[name].max_age_s)
    place = unit_places(replay, experiment, lists)
    row_of = np.full((len(lists.stamp_ns) + 1, len(sight.object_ix)), -1)  # the row more, index −1: no list
    rows = np.flatnonzero(np.isin(lists.row_object_ix, sight.object_ix) & lists.valid[0])
    column = (lists.row_object_ix[rows, None] == sight.object_ix).argmax(axis=1)
    rows, column = (part[_is_of_first_unit(lists, rows, column, sight, first_unit)] for part in (rows, column))
    row_of[lists.frame_ix[rows], column] = rows
    row_of[:-1][np.isnan(place[:, 0])] = -1
    k, u, m = np.nonzero(row_of[schedule.newest] >= 0)
    rows = row_of[schedule.newest[k, u], m]
    if not len(rows):
        return
    ends = stack_float32(lists.x_m[0, rows], lists.y_m[0, rows], lists.z_m[0, rows])
    lines = np.stack([place[lists.frame_ix[rows]].astype(np.float32), ends], axis=1)
    counts = np.bincount(k, minlength=len(schedule.issue_s))
    instants = np.flatnonzero((counts > 0) | (np.append(0, counts[:-1]) > 0))
    path = ["world", configuration_part(name), "listings"]
    out.columns(
        path,
        to_nanoseconds(schedule.issue_s[instants]),
        rr.LineStrips3D.columns(strips=join_points(lines)).partition(counts[instants]),
    )
    out.static(path, rr.LineStrips3D.from_fields(colors=[(*colour, RAY_ALPHA)], radii=rr.Radius.ui_points(0.75)))


def _is_of_first_unit(lists: Tracks, rows: Int, column: Int, sight: Sight, first_unit: Mapping[int, str]) -> Bool:
    """(P,) whether each row is of the unit that listed its object first (`first_unit`; else the first to arrive)."""
    unit = lists.frame_unit_ix[lists.frame_ix[rows]]
    is_first = np.zeros(len(rows), dtype=bool)
    for m, k in enumerate(sight.object_ix.tolist()):
        object_rows = np.flatnonzero(column == m)
        if not len(object_rows):
            continue
        name = first_unit.get(k)
        soonest = object_rows[np.argmin(lists.common_arrives_s[lists.frame_ix[rows[object_rows]]])]
        is_first[object_rows] = unit[object_rows] == (lists.units.index(name) if name in lists.units else unit[soonest])
    return is_first

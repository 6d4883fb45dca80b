"""Status of each shown object in a configuration, hidden, captured by a unit or known to the receiver; and its words.

An object is known from `detection_s` of the table on, and never before. The status at an instant is the last of these
that holds for the object and the units of the configuration:

| status | holds when |
|---|---|
| absent | the object is not in the log |
| not listed | it is; the lists of the units are recorded, so what they can see is unknown |
| out of range or view | no unit has it within the range and view of a couple, or there is no unit |
| hidden | units have, but would list it only if nothing hid it |
| visible | it is in sight of a unit, but no list under way holds it |
| lost | a unit's newest list holds it, and never arrives |
| captured | a list that holds it is under way |
| unmatched | a unit's newest list that arrived holds it, but no entry of the fused list is matched with it |
| listed before the onset | the receiver's newest list holds it, captured before the onset, which does not count |
| listed, not confirmed | the newest list counts, but `confirm` asks for more lists |
| listed too late | the newest list became available after the episode's end |
| known | the newest list holds it, at or after `detection_s` |
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
import pyarrow as pa

from copem_replay.communication.arrivals import fusion_schedule
from copem_replay.core.colours import Rgb
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.interpolation import interpolate_states
from copem_replay.core.tracks import SAME_INSTANT_NS, TRUTH, Bool, Float, Int, Scene, Tracks
from copem_replay.experiment.schema import Experiment
from copem_replay.perception.sight import HIDDEN as IS_HIDDEN
from copem_replay.perception.sight import IN_SIGHT, OUT_OF_VIEW
from copem_replay.pipeline.prepare import Replay
from copem_replay.pipeline.sight import Sight, name_bodies
from copem_replay.viewer.camera import below_bodies
from copem_replay.viewer.sensors import unit_places
from copem_replay.viewer.sink import (
    ABSENT,
    CAPTURED,
    EARLY,
    HIDDEN,
    HIDES,
    KNOWN,
    LOST,
    OUT,
    STATUSES,
    TOO_LATE,
    UNCONFIRMED,
    UNLISTED,
    UNMATCHED,
    VISIBLE,
    WORDS_COLOUR,
    RecordingSink,
    configuration_part,
    elapsed_ns,
    join_points,
    short_ids,
    stack_float32,
    to_nanoseconds,
)

NEVER_NS = np.iinfo(np.int64).max
BODY = ("x_m", "y_m", "z_m", "yaw_rad", "length_m", "width_m", "height_m")


@dataclass(frozen=True)
class EpisodeClocks:
    """Onset, detection in one configuration and end of each object's episode, (N + 1,) ns since the log's start.

    NEVER_NS if there is none. The last element is for entries without an object.
    """

    onset_ns: Int
    known_ns: Int
    ended_ns: Int


def read_episode_clocks(scene: Scene, table: pd.DataFrame, configuration: str) -> EpisodeClocks:
    """The clocks of all objects in a configuration; `table`: rows of one log and run."""
    numbers = table["object_id"].map(scene.object_number).to_numpy(dtype=np.int64)
    detected = ((table["configuration"] == configuration) & table["detected"]).to_numpy()
    clocks = []
    for name, rows in (("onset_s", slice(None)), ("detection_s", detected), ("ended_s", slice(None))):
        times_ns = np.full(len(scene.object_ids) + 1, NEVER_NS)
        times_ns[numbers[rows]] = to_nanoseconds(table[name].to_numpy()[rows])
        clocks.append(times_ns)
    return EpisodeClocks(*clocks)


@dataclass(frozen=True)
class Status:
    """Status in one configuration, (K, M): instants (K,) by objects of Sight (M,). −1 or NaN: does not apply."""

    elapsed_ns: Int  # (K,)
    frame: Int  # (K,), of Sight, −1 before the first
    status: Int  # index into STATUSES
    unit_ix: Int  # unit of the experiment that sees most of it, or has a list under way
    until_s: Float  # time until a list under way arrives
    age_of_information_s: Float  # of the entry in the newest list
    body: Mapping[str, Float]  # by name of `BODY`: true place and size, or the fused ones while absent


def compute_status(
    replay: Replay,
    experiment: Experiment,
    configuration: str,
    fused_tracks: FusedTracks,
    sight: Sight,
    clock: EpisodeClocks,
) -> Status:
    """The status of all shown objects at every instant at which one may change."""
    received, numbers = fused_tracks.received, {name: u for u, name in enumerate(experiment.units)}
    asked_configuration = experiment.configurations[configuration]
    of_truth = asked_configuration.units == TRUTH
    heard_of = (
        [TRUTH] if of_truth else [name for name in experiment.units_of(asked_configuration) if name in received.units]
    )
    sensing = [] if of_truth else experiment.list_sensing(heard_of)
    modelled = [numbers[name] for name in sensing if name in experiment.modelled]
    listed = [
        [_find_object_lists(received, received.units.index(name), k) for name in heard_of] for k in sight.object_ix
    ]
    instants = _find_instants(sight, fused_tracks.fused, listed, clock, replay.scene.end_ns - replay.scene.t0_ns)
    frame = np.searchsorted(sight.elapsed_ns, instants + SAME_INSTANT_NS, side="right") - 1
    shape = (len(instants), len(sight.object_ix))
    statuses = Status(
        instants, frame, np.full(shape, ABSENT), np.full(shape, -1), np.full(shape, np.nan), np.full(shape, np.nan),
        {name: np.full(shape, np.nan) for name in BODY},
    )  # fmt: skip
    for m, k in enumerate(sight.object_ix.tolist()):
        states, present = interpolate_states(
            replay.truth, np.full(len(instants), k), instants * np.float64(1e-9),
            t0_ns=replay.scene.t0_ns, max_gap_s=experiment.max_gap_s,
        )  # fmt: skip
        for part, values in statuses.body.items():
            values[:, m] = states[part]
        statuses.status[present, m] = VISIBLE if of_truth else OUT if modelled else UNLISTED
        if modelled and len(instants):
            _find_best_unit(sight, modelled, m, present & (frame >= 0), statuses)
        for name, (captured_ns, arrives_ns, stamps_ns) in zip(heard_of, listed[m], strict=True):
            _mark_under_way(captured_ns, arrives_ns, stamps_ns, numbers.get(name, -1), m, statuses)
        _mark_held(fused_tracks, k, m, clock, experiment.measure.count_earlier, statuses)
    return statuses


def _find_best_unit(sight: Sight, units: list[int], m: int, present: Bool, statuses: Status) -> None:
    """Fill column m of `statuses` with the best that any unit has of the object, and the unit; −1: none is there."""
    state, unit_ix = (values[np.maximum(statuses.frame, 0)] for values in sight.find_best(units, m))
    looked = present & (state >= OUT_OF_VIEW)
    words = {OUT_OF_VIEW: OUT, IS_HIDDEN: HIDDEN, IN_SIGHT: VISIBLE}
    statuses.status[looked, m] = [words[value] for value in state[looked].tolist()]
    statuses.unit_ix[looked, m] = unit_ix[looked]


def _find_object_lists(lists: Tracks, unit: int, object_ix: int) -> tuple[Int, Float, Int]:
    """Captures and arrivals (K,) of a unit's lists that hold an object, and captures (F,) of all its lists, in ns.

    In order of capture; the arrival of a lost list is inf.
    """
    rows = np.flatnonzero((lists.row_object_ix == object_ix) & (lists.row_unit_ix == unit) & lists.valid[0])
    frames = np.unique(lists.frame_ix[rows])
    frames = frames[np.argsort(lists.captured_s[frames], kind="stable")]
    arrives_s = lists.common_arrives_s[frames]
    arrives_ns = np.where(np.isfinite(arrives_s), np.rint(arrives_s * 1e9), np.inf)
    all_captured_ns = np.sort(to_nanoseconds(lists.captured_s[lists.frame_unit_ix == unit]))
    return to_nanoseconds(lists.captured_s[frames]), arrives_ns, all_captured_ns


def _find_instants(
    sight: Sight, fused: Tracks, listed: list[list[tuple[Int, Float, Int]]], clock: EpisodeClocks, end_ns: int
) -> Int:
    """(K,) instants of frames with a shown object and the next frames, captures, arrivals, onsets, detections."""
    captured = [captured_ns for of_object in listed for captured_ns, _, _ in of_object]
    rows = np.isin(fused.row_object_ix, sight.object_ix) & fused.valid[0]
    frames = np.unique(fused.frame_ix[rows])
    available = elapsed_ns(fused)[np.union1d(frames, np.minimum(frames + 1, len(fused.stamp_ns) - 1))]
    gone = sight.elapsed_ns[
        np.flatnonzero(np.diff(sight.elapsed_ns, append=0) > 1.5 * _frame_period_ns(sight.elapsed_ns))
    ]
    after = [gone + _frame_period_ns(sight.elapsed_ns), sight.elapsed_ns[-1:] + _frame_period_ns(sight.elapsed_ns)]
    after = [np.minimum(instant, end_ns) for instant in after]
    clocks_ns = np.concatenate([clock.onset_ns[sight.object_ix], clock.known_ns[sight.object_ix]])
    clocks_ns = clocks_ns[clocks_ns != NEVER_NS]
    return np.unique(np.concatenate([sight.elapsed_ns, *after, *captured, available, clocks_ns]).astype(np.int64))


def _frame_period_ns(elapsed_ns: Int) -> int:
    """The median time between frames, in ns; 0.1 s for a single frame."""
    return int(np.median(np.diff(elapsed_ns))) if len(elapsed_ns) > 1 else 100_000_000


def _mark_under_way(captured_ns: Int, arrives_ns: Float, stamps_ns: Int, unit: int, m: int, statuses: Status) -> None:
    """Fill column m of `statuses` where a list of one unit that holds the object is lost, under way or unmatched."""
    if not len(captured_ns):
        return
    now, status = statuses.elapsed_ns + SAME_INSTANT_NS, statuses.status[:, m]
    sent = np.searchsorted(captured_ns, now, side="right")
    newest = np.maximum(sent - 1, 0)
    # A lost list counts until the unit captures its next one.
    still = np.searchsorted(stamps_ns, now, "right") == np.searchsorted(stamps_ns, captured_ns[newest], "right")
    lost = (sent > 0) & still & np.isinf(arrives_ns[newest]) & (status < LOST)
    statuses.status[lost, m], statuses.unit_ix[lost, m] = LOST, unit
    travels = np.isfinite(arrives_ns)
    sent = np.searchsorted(captured_ns[travels], now, side="right")
    arrivals = np.sort(arrives_ns[travels])
    arrived = np.searchsorted(arrivals, now, side="right")
    left_s = (np.append(arrivals, np.inf)[arrived] - statuses.elapsed_ns) * 1e-9
    soonest = (sent > arrived) & ~(statuses.until_s[:, m] <= left_s)
    soonest &= statuses.status[:, m] < UNMATCHED
    statuses.status[soonest, m], statuses.unit_ix[soonest, m], statuses.until_s[soonest, m] = (
        CAPTURED,
        unit,
        left_s[soonest],
    )
    if travels.any():
        # An arrived list is the newest until a list captured later has been on its way for as long.
        newest = np.maximum(arrived - 1, 0)
        held_ns, took_ns = captured_ns[travels][newest], (arrives_ns - captured_ns)[travels][newest]
        newer = np.searchsorted(stamps_ns, now - took_ns, "right") > np.searchsorted(stamps_ns, held_ns, "right")
        unmatched = (arrived > 0) & ~newer & (statuses.status[:, m] != ABSENT)
        statuses.status[unmatched, m], statuses.unit_ix[unmatched, m] = UNMATCHED, unit


def _mark_held(
    fused_tracks: FusedTracks, object_ix: int, m: int, clock: EpisodeClocks, count_earlier: bool, statuses: Status
) -> None:
    """Fill column m of `statuses` where the receiver's newest list holds the object."""
    fused = fused_tracks.fused
    row_of = np.full(len(fused.stamp_ns) + 1, -1)  # the element more, index −1: no list yet
    rows = np.flatnonzero((fused.row_object_ix == object_ix) & fused.valid[0])
    row_of[fused.frame_ix[rows]] = rows
    row = row_of[np.searchsorted(elapsed_ns(fused), statuses.elapsed_ns + SAME_INSTANT_NS, side="right") - 1]
    held = np.flatnonzero(row >= 0)
    row = row[held]
    captured_s = fused_tracks.captured_s[0, row]
    statuses.age_of_information_s[held, m] = statuses.elapsed_ns[held] * 1e-9 - captured_s
    gone = np.isnan(statuses.body["x_m"][held, m])  # absent: the fused position is used
    for name, values in statuses.body.items():
        values[held[gone], m] = getattr(fused, name)[0, row[gone]]
    too_late = elapsed_ns(fused)[fused.frame_ix[row]] - SAME_INSTANT_NS > clock.ended_ns[object_ix]
    status = np.where(too_late, TOO_LATE, UNCONFIRMED)
    if not count_earlier:
        status[captured_s * 1e9 < clock.onset_ns[object_ix] - SAME_INSTANT_NS] = EARLY
    status[statuses.elapsed_ns[held] >= clock.known_ns[object_ix]] = KNOWN
    statuses.status[held, m] = status


# Reasons in words why a configuration knows an object or not: a label in the picture, a sentence on selection.

OLD_S = 0.05
"""Greatest age that words leave out: less than the time from list to list."""


@dataclass(frozen=True)
class Reasons:
    """Label over an object and sentence on its selection, for pairs (P,) of instant and object.

    `number`: equal for equal sentences.
    """

    labels: pa.Array
    sentences: pa.Array
    number: Int


def explain_status(
    scene: Scene, experiment: Experiment, sight: Sight, statuses: Status, rows: Int, column: Int, started: Bool
) -> Reasons:
    """Words for (P,) pairs; each distinct sentence is made once. `started` (P,): whether the onset has passed."""
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
    whole = [np.rint(value).astype(np.int64) for value in (time_s * 10, share * 100)]
    columns = np.stack([column, status, unit, *whole, body, near, started], axis=-1)
    keys, which = _find_distinct_rows(columns)
    ids, units = short_ids(scene), [*experiment.units, TRUTH]  # index −1: the truth, or no unit
    bodies = name_bodies(scene, sight.solids, ids)
    details = [(ids[sight.object_ix[key[0]]], units[key[2]], bodies[key[5]], key) for key in keys.tolist()]
    picked = pa.array(which)
    labels = [_format_label(name, unit, hider, key) for name, unit, hider, key in details]
    sentences = [_format_sentence(name, unit, hider, key) for name, unit, hider, key in details]
    return Reasons(pa.array(labels, pa.string()).take(picked), pa.array(sentences, pa.string()).take(picked), which)


def _find_distinct_rows(columns: Int) -> tuple[Int, Int]:
    """The distinct rows (D, C), and the index (P,) of each row among them. Rows become numbers, which sort faster."""
    low = columns.min(axis=0, initial=0)
    span = columns.max(axis=0, initial=0) - low + 1
    packed = np.ravel_multi_index(tuple((columns - low).T), tuple(span.tolist()))
    _, first, which = np.unique(packed, return_index=True, return_inverse=True)
    return columns[first], which.reshape(-1)


def _format_label(name: str, unit: str, hider: str, key: list[int]) -> str:
    """“58 behind car 41”; only the name of a known object."""
    _, status, _, _, _, _, near, started = key
    words = {
        KNOWN: "",
        EARLY: " only in old list" if started else " listed",
        UNCONFIRMED: " not confirmed",
        TOO_LATE: " too late",
        CAPTURED: " on its way",
        UNMATCHED: " unmatched",
        LOST: " list lost",
        UNLISTED: " not listed",
        VISIBLE: " not listed yet" if unit == TRUTH else " not listed",
        HIDDEN: f" behind {hider}",
    }
    return name + words.get(status, " no unit there" if unit == TRUTH else " out of view" if near else " out of range")


def _format_sentence(name: str, unit: str, hider: str, key: list[int]) -> str:
    """“58 hidden from ego by car 41 (share 0.21)”."""
    _, status, _, tenths, hundredths, _, near, started = key
    if status >= EARLY:
        old = "" if tenths * 0.1 <= OLD_S else f", {tenths / 10:.1f} s old"
        early = ", from before the onset" if started else ""
        after = {EARLY: f"{old}{early}", UNCONFIRMED: f"{old}, not confirmed yet", TOO_LATE: f" too late{old}"}
        return f"{name} known{old}" if status == KNOWN else f"{name} listed{after[status]}"
    if status == CAPTURED:
        return f"{name} listed by {unit}, arrives in {tenths / 10:.1f} s"
    if status == UNMATCHED:
        return f"{name} listed by {unit}, no entry matched"
    if status == LOST:
        return f"{name} listed by {unit}, list lost"
    if status == VISIBLE:
        return f"{name} not listed yet" if unit == TRUTH else f"{name} seen by {unit}, not listed"
    if status == UNLISTED:
        return f"{name} not listed"
    if status == HIDDEN:
        return f"{name} hidden from {unit} by {hider} (share {hundredths / 100:.2f})"
    if unit == TRUTH:
        return f"{name}: no unit there"
    return f"{name} outside fields of view" if near else f"{name} out of range"


def lane_text(status: int, unit: str, hider: str) -> str:
    """The text of a span in a lane: “behind car 41 (from ego)”."""
    if status == HIDDEN:
        return f"behind {hider} (from {unit})"
    if status == VISIBLE:
        return "not listed yet" if unit == TRUTH else f"seen by {unit}, not listed"
    if status == CAPTURED:
        return f"on its way from {unit}"
    if status == OUT and unit == TRUTH:
        return "no unit there"
    return "old list" if status == EARLY else STATUSES[status]


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
    clock: EpisodeClocks,
    up_rad: Mapping[str, Float],
) -> None:
    """Write below the true place of each object “58 behind car 41”, and a sentence that selecting it shows.

    `up_rad`: for each entity with the words, what is up in the pictures that show it, to be broadcast to (K, M).
    """
    import rerun as rr

    rows, column = np.nonzero((statuses.status != ABSENT) & ~np.isnan(statuses.body["x_m"]))
    started = statuses.elapsed_ns[rows] >= clock.onset_ns[sight.object_ix[column]]
    reasons = explain_status(replay.scene, experiment, sight, statuses, rows, column, started)
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
    """(P,) whether each row is of the unit that listed its object first."""
    unit = lists.frame_unit_ix[lists.frame_ix[rows]]
    kept = np.zeros(len(rows), dtype=bool)
    for m, k in enumerate(sight.object_ix.tolist()):
        object_rows = np.flatnonzero(column == m)
        if not len(object_rows):
            continue
        name = first_unit.get(k)
        soonest = object_rows[np.argmin(lists.common_arrives_s[lists.frame_ix[rows[object_rows]]])]
        kept[object_rows] = unit[object_rows] == (lists.units.index(name) if name in lists.units else unit[soonest])
    return kept

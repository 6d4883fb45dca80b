"""Status of each shown object in a configuration at every instant: one table of facts for lanes, words, films, stories.

Until an object is listed it is what `pipeline/sight.py` has of it; then it is what became of the lists that hold it. An
object is known from `detection_s` of the table on, and never before. The status at an instant is the last of these
that holds for the object and the units of the configuration:

| status | holds when |
|---|---|
| absent | the object is not in the log |
| not listed | it is; the lists of the units are recorded, and do not say where they look (`views`) |
| out of range or view | no unit has it within the range and view of a couple, or there is no unit |
| hidden | units have, but would list it only if nothing hid it |
| in sight | it is in sight of a unit, but no list under way holds it |
| not sent | a unit's newest list holds it, and `sends` leaves it out of the message |
| lost | a unit's newest list holds it, and never arrives |
| under way | a list that holds it is on its way, or waits for the next fused list |
| unmatched | a unit's newest list that arrived holds it, but no entry of the fused list is matched with it |
| listed before it counts | before the onset: the receiver's newest list holds it |
| listed, not confirmed | the newest list counts, but `confirm` asks for more lists |
| listed too late | the newest list became available after the episode's end |
| known | the newest list holds it, at or after `detection_s` |

From the onset on a list that was captured before it does not count, unless `count_earlier` says so.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.interpolation import interpolate_states
from copem_replay.core.tracks import SAME_INSTANT_NS, TRUTH, Bool, Float, Int, Scene, Tracks
from copem_replay.experiment.schema import Experiment
from copem_replay.perception.sight import IN_SIGHT, NO_UNIT, OUT_OF_VIEW
from copem_replay.pipeline.prepare import Replay
from copem_replay.pipeline.sight import ABSENT, Sight, SpanNames, StatusSpan, list_spans, name_bodies, within

STATUSES = (
    "absent", "not listed", "out of range or view", "hidden", "in sight", "not sent", "list lost", "on its way",
    "unmatched", "listed before it counts", "listed, not confirmed", "listed too late", "known",
)  # fmt: skip
UNLISTED = NO_UNIT
NOT_SENT, LOST, UNDER_WAY, UNMATCHED, EARLY, UNCONFIRMED, TOO_LATE, KNOWN = range(IN_SIGHT + 1, len(STATUSES))
"""What follows on `ABSENT` and the states of `perception/sight.py`."""

NEVER_NS = np.iinfo(np.int64).max
BODY = ("x_m", "y_m", "z_m", "yaw_rad", "length_m", "width_m", "height_m")


def to_nanoseconds(time_s: Any) -> Any:
    """Seconds as whole nanoseconds."""
    return np.rint(np.asarray(time_s) * 1e9).astype(np.int64)


def elapsed_ns(tracks: Tracks) -> Int:
    """(F,) when each list is available, ns since the log's start."""
    elapsed: Int = to_nanoseconds(tracks.common_arrives_s)
    return elapsed


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
    modelled = [numbers[name] for name in sensing if name in replay.sighted.modelled]
    issued_ns = np.append(elapsed_ns(fused_tracks.fused), np.inf)
    listed = [
        [_find_object_lists(received, received.units.index(name), k, issued_ns) for name in heard_of]
        for k in sight.object_ix
    ]
    left_out = None if fused_tracks.left_out is None else replace(received, valid=fused_tracks.left_out[None])
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
        statuses.status[present, m] = IN_SIGHT if of_truth else OUT_OF_VIEW if modelled else UNLISTED
        if modelled and len(instants):
            _find_best_unit(sight, modelled, m, present & (frame >= 0), statuses)
        counts_ns = -NEVER_NS if experiment.measure.count_earlier else clock.onset_ns[k] - SAME_INSTANT_NS
        for name, lists in zip(heard_of, listed[m], strict=True):
            for since_ns, rows in ((-NEVER_NS, instants < counts_ns), (counts_ns, instants >= counts_ns)):
                counting = lists[0] >= since_ns
                if left_out is not None:
                    held_ns, _, all_ns = _find_object_lists(left_out, received.units.index(name), k, issued_ns)
                    _mark_not_sent(held_ns[held_ns >= since_ns], all_ns, numbers[name], m, rows, statuses)
                _mark_under_way(
                    lists[0][counting], lists[1][counting], lists[2], numbers.get(name, -1), m, rows, statuses
                )
        _mark_held(fused_tracks, k, m, clock, counts_ns, statuses)
    return statuses


def _find_best_unit(sight: Sight, units: list[int], m: int, present: Bool, statuses: Status) -> None:
    """Fill column m of `statuses` with the best that any unit has of the object, and the unit; −1: none is there."""
    state, unit_ix = (values[np.maximum(statuses.frame, 0)] for values in sight.find_best(units, m))
    looked = present & (state >= OUT_OF_VIEW)
    statuses.status[looked, m], statuses.unit_ix[looked, m] = state[looked], unit_ix[looked]


def _find_object_lists(lists: Tracks, unit: int, object_ix: int, issued_ns: Float) -> tuple[Int, Float, Int]:
    """Captures of the unit's lists that hold the object, and when they are taken in (K,), by capture; captures (F,) of
    all. All in ns; a lost list is taken in at inf. `issued_ns`: instants of fused lists, and inf.
    """
    rows = np.flatnonzero((lists.row_object_ix == object_ix) & (lists.row_unit_ix == unit) & lists.valid[0])
    frames = np.unique(lists.frame_ix[rows])
    frames = frames[np.argsort(lists.captured_s[frames], kind="stable")]
    arrives_ns = lists.common_arrives_s[frames] * 1e9
    taken_ns = issued_ns[np.searchsorted(issued_ns, arrives_ns - SAME_INSTANT_NS)]
    taken_ns = np.where(np.isfinite(taken_ns), taken_ns, np.rint(arrives_ns))  # after the last fused list
    all_captured_ns = np.sort(to_nanoseconds(lists.captured_s[lists.frame_unit_ix == unit]))
    return to_nanoseconds(lists.captured_s[frames]), taken_ns, all_captured_ns


def _find_instants(
    sight: Sight, fused: Tracks, listed: list[list[tuple[Int, Float, Int]]], clock: EpisodeClocks, end_ns: int
) -> Int:
    """(K,) ascending instants (ns) at which a status may change: frames, captures, arrivals, onsets, detections."""
    captured = [captured_ns for of_object in listed for captured_ns, _, _ in of_object]
    rows = np.isin(fused.row_object_ix, sight.object_ix) & fused.valid[0]
    frames = np.unique(fused.frame_ix[rows])
    available = elapsed_ns(fused)[np.union1d(frames, np.minimum(frames + 1, len(fused.stamp_ns) - 1))]
    gone = sight.elapsed_ns[
        np.flatnonzero(np.diff(sight.elapsed_ns, append=0) > 1.5 * _frame_period_ns(sight.elapsed_ns))
    ]
    ends = [gone + _frame_period_ns(sight.elapsed_ns), sight.elapsed_ns[-1:] + _frame_period_ns(sight.elapsed_ns)]
    ends = [np.minimum(instant, end_ns) for instant in ends]
    clocks_ns = np.concatenate([clock.onset_ns[sight.object_ix], clock.known_ns[sight.object_ix]])
    clocks_ns = clocks_ns[clocks_ns != NEVER_NS]
    return np.unique(np.concatenate([sight.elapsed_ns, *ends, *captured, available, clocks_ns]).astype(np.int64))


def _frame_period_ns(elapsed_ns: Int) -> int:
    """The median time between frames, in ns; 0.1 s for a single frame."""
    return int(np.median(np.diff(elapsed_ns))) if len(elapsed_ns) > 1 else 100_000_000


def _mark_not_sent(captured_ns: Int, stamps_ns: Int, unit: int, m: int, rows: Bool, statuses: Status) -> None:
    """Fill `rows` of column m of `statuses` where a unit's newest list holds the object, and its message does not."""
    still, _ = _find_newest(captured_ns, stamps_ns, statuses)
    not_sent = rows & still & (statuses.status[:, m] < NOT_SENT)
    statuses.status[not_sent, m], statuses.unit_ix[not_sent, m] = NOT_SENT, unit


def _find_newest(captured_ns: Int, stamps_ns: Int, statuses: Status) -> tuple[Bool, Int]:
    """(K,) at each instant whether the newest list of a unit is one of these, and which of them is the last."""
    now = statuses.elapsed_ns + SAME_INSTANT_NS
    sent = np.searchsorted(captured_ns, now, side="right")
    newest = np.maximum(sent - 1, 0)
    if not len(captured_ns):
        return np.zeros(len(now), dtype=bool), newest
    still = np.searchsorted(stamps_ns, now, "right") == np.searchsorted(stamps_ns, captured_ns[newest], "right")
    return (sent > 0) & still, newest


def _mark_under_way(
    captured_ns: Int, arrives_ns: Float, stamps_ns: Int, unit: int, m: int, rows: Bool, statuses: Status
) -> None:
    """Fill `rows` of column m of `statuses` where a unit's list with the object is lost, under way or unmatched.
    `arrives_ns`: when it is taken in.
    """
    if not len(captured_ns):
        return
    now, status = statuses.elapsed_ns + SAME_INSTANT_NS, statuses.status[:, m]
    still, newest = _find_newest(captured_ns, stamps_ns, statuses)  # a lost list counts until the unit makes its next
    lost = rows & still & np.isinf(arrives_ns[newest]) & (status < LOST)
    statuses.status[lost, m], statuses.unit_ix[lost, m] = LOST, unit
    travels = np.isfinite(arrives_ns)
    sent = np.searchsorted(captured_ns[travels], now, side="right")
    arrivals = np.sort(arrives_ns[travels])
    arrived = np.searchsorted(arrivals, now, side="right")
    remaining_s = (np.append(arrivals, np.inf)[arrived] - statuses.elapsed_ns) * 1e-9
    is_soonest = rows & (sent > arrived) & ~(statuses.until_s[:, m] <= remaining_s)
    is_soonest &= statuses.status[:, m] < UNMATCHED
    statuses.status[is_soonest, m], statuses.unit_ix[is_soonest, m], statuses.until_s[is_soonest, m] = (
        UNDER_WAY,
        unit,
        remaining_s[is_soonest],
    )
    if travels.any():
        # An arrived list is the newest until a list captured later has been on its way for as long.
        newest = np.maximum(arrived - 1, 0)
        held_ns, took_ns = captured_ns[travels][newest], (arrives_ns - captured_ns)[travels][newest]
        newer = np.searchsorted(stamps_ns, now - took_ns, "right") > np.searchsorted(stamps_ns, held_ns, "right")
        unmatched = rows & (arrived > 0) & ~newer & (statuses.status[:, m] != ABSENT)
        statuses.status[unmatched, m], statuses.unit_ix[unmatched, m] = UNMATCHED, unit


def _mark_held(
    fused_tracks: FusedTracks, object_ix: int, m: int, clock: EpisodeClocks, counts_ns: int, statuses: Status
) -> None:
    """Fill column m of `statuses` where the newest list holds the object: early, unconfirmed, known or too late."""
    fused = fused_tracks.fused
    row_of = np.full(len(fused.stamp_ns) + 1, -1)  # the element more, index −1: no list yet
    rows = np.flatnonzero((fused.row_object_ix == object_ix) & fused.valid[0])
    row_of[fused.frame_ix[rows]] = rows
    row = row_of[np.searchsorted(elapsed_ns(fused), statuses.elapsed_ns + SAME_INSTANT_NS, side="right") - 1]
    held_at = np.flatnonzero(row >= 0)
    row = row[held_at]
    captured_s = fused_tracks.captured_s[0, row]
    statuses.age_of_information_s[held_at, m] = statuses.elapsed_ns[held_at] * 1e-9 - captured_s
    is_absent = np.isnan(statuses.body["x_m"][held_at, m])  # absent: the fused position is used
    for name, values in statuses.body.items():
        values[held_at[is_absent], m] = getattr(fused, name)[0, row[is_absent]]
    too_late = elapsed_ns(fused)[fused.frame_ix[row]] - SAME_INSTANT_NS > clock.ended_ns[object_ix]
    status = np.where(too_late, TOO_LATE, UNCONFIRMED)
    is_early = captured_s * 1e9 < counts_ns
    status[is_early] = EARLY
    status[statuses.elapsed_ns[held_at] >= clock.known_ns[object_ix]] = KNOWN
    counts = ~is_early | (statuses.elapsed_ns[held_at] < counts_ns) | (status == KNOWN)
    statuses.status[held_at[counts], m] = status[counts]


def list_status_spans(
    replay: Replay, sight: Sight, statuses: Status, m: int, from_s: float, until_s: float
) -> list[StatusSpan]:
    """The spans of object m between two instants, while it is in the log."""
    rows, elapsed = within(statuses.elapsed_ns, from_s, until_s), statuses.elapsed_ns
    if not len(rows):
        return []
    scene, units = replay.scene, [*replay.expanded.units]
    begins_ns: Int = np.maximum(elapsed[rows], round(from_s * 1e9))
    told = begins_ns, statuses.status[rows, m], statuses.unit_ix[rows, m], statuses.frame[rows]
    names = SpanNames(units, name_bodies(scene, sight.solids, scene.object_ids))
    spans = list_spans(sight, m, told, names, until_s)
    return [span for span in spans if span.status != ABSENT]

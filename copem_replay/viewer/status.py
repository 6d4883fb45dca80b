"""How far each shown object has come in a configuration: hidden, visible, captured by a unit, known to the receiver.

Known is what the table says: from `detection_s` on, and never before.

At an instant, of an object and the units of a configuration, the last of these that holds:

| status | holds when |
|---|---|
| absent | the object is not in the log then |
| not listed | it is; nothing is known of what the units can see: their lists are recorded |
| out of view | it is in no field of view of the units |
| hidden | of those in whose field it is, none sees more of it than `CLEAR_ABOVE` |
| visible | one does, but no list under way holds it |
| lost | a unit's newest list held it, and will never arrive |
| captured | a list that holds it is under way |
| unmatched | a unit's newest list that has arrived holds it; of the fused list no entry is matched with it |
| listed before the onset | the receiver's newest list holds it, as it was before the onset, which does not count |
| listed, not confirmed | it does, since the onset, or whenever counts; `confirm` asks for more |
| listed too late | it does, and was not there before the episode ended |
| known | it does, at or after `detection_s` |
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.interpolation import states_at
from copem_replay.core.tracks import SAME_INSTANT_NS, TRUTH, Bool, Float, Int, Scene, Tracks
from copem_replay.experiment.schema import Experiment
from copem_replay.pipeline.prepare import Replay
from copem_replay.viewer.line_of_sight import CLEAR_ABOVE, Sight
from copem_replay.viewer.sink import elapsed_ns, ns
from copem_replay.viewer.statuses import (
    ABSENT,
    CAPTURED,
    EARLY,
    HIDDEN,
    KNOWN,
    LOST,
    OUT,
    TOO_LATE,
    UNCONFIRMED,
    UNLISTED,
    UNMATCHED,
    VISIBLE,
)

NEVER_NS = np.iinfo(np.int64).max


@dataclass(frozen=True)
class Clock:
    """What the table says, by object (N + 1,), the last: no object. Never: NEVER_NS.

    Episodes are the same in all configurations, `known_ns` is of one.
    """

    onset_ns: Int
    known_ns: Int
    ended_ns: Int


def clock_of(scene: Scene, table: pd.DataFrame, configuration: str) -> Clock:
    """When each object's episode begins and ends, and when it is known; `table`: rows of one log and run."""
    known = table[(table["configuration"] == configuration) & table["detected"]]
    times = (table, "onset_s"), (known, "detection_s"), (table, "ended_s")
    made = []
    for part, name in times:
        of_each = np.full(len(scene.object_ids) + 1, NEVER_NS)
        of_each[part["object_id"].map(scene.object_number).to_numpy(dtype=np.int64)] = ns(part[name])
        made.append(of_each)
    return Clock(*made)


@dataclass(frozen=True)
class Status:
    """Of one configuration at instants (K,), of the objects of Sight (M,). All (K, M); what does not apply: −1, NaN."""

    elapsed_ns: Int  # (K,)
    frame: Int  # (K,) of Sight, −1: before the first
    status: Int  # index into STATUSES
    unit_ix: Int  # of the experiment: the unit that sees most of it, or has a list under way
    until_s: Float  # until a list under way arrives
    age_of_information_s: Float  # of what is listed
    x_m: Float  # where it truly is, or its fused position while absent
    y_m: Float
    top_m: Float


def status_of(
    replay: Replay, experiment: Experiment, configuration: str, fused_tracks: FusedTracks, seen: Sight, clock: Clock
) -> Status:
    """The status of all shown objects at every instant at which any of them may change."""
    heard, numbers = fused_tracks.heard, {name: u for u, name in enumerate(experiment.units)}
    asked = experiment.configurations[configuration]
    of_truth = asked.units == TRUTH
    heard_of = [TRUTH] if of_truth else [name for name in experiment.units_of(asked) if name in heard.units]
    modelled = [numbers[name] for name in heard_of if name in experiment.modelled]
    listed = [[_lists(heard, heard.units.index(name), k) for name in heard_of] for k in seen.object_ix]
    instants = _instants(seen, fused_tracks.fused, listed, clock, replay.scene.end_ns - replay.scene.t0_ns)
    frame = np.searchsorted(seen.elapsed_ns, instants + SAME_INSTANT_NS, side="right") - 1
    shape = (len(instants), len(seen.object_ix))
    made = Status(
        instants, frame, np.full(shape, ABSENT), np.full(shape, -1), *(np.full(shape, np.nan) for _ in range(5))
    )
    for m, k in enumerate(seen.object_ix.tolist()):
        at, there = states_at(
            replay.truth, np.full(len(instants), k), instants * np.float64(1e-9),
            t0_ns=replay.scene.t0_ns, max_gap_s=experiment.max_gap_s,
        )  # fmt: skip
        made.x_m[:, m], made.y_m[:, m], made.top_m[:, m] = at["x_m"], at["y_m"], at["z_m"] + at["height_m"] / 2
        made.status[there, m] = VISIBLE if of_truth else OUT if modelled else UNLISTED
        if modelled and len(instants):
            _measured(seen, modelled, m, there & (frame >= 0), made)
        for name, (captured_ns, arrives_ns, stamps_ns) in zip(heard_of, listed[m], strict=True):
            _under_way(captured_ns, arrives_ns, stamps_ns, numbers.get(name, -1), m, made)
        _held(fused_tracks, k, m, clock, experiment.measure.count_earlier, made)
    return made


def _measured(seen: Sight, units: list[int], m: int, there: Bool, made: Status) -> None:
    """Which of some units sees most of object m. Out: its column of `made`."""
    share = seen.share[units][:, np.maximum(made.frame, 0), m]
    best = np.argmax(np.nan_to_num(share, nan=-1.0), axis=0)
    most = share[best, np.arange(len(best))]
    looked = there & ~np.isnan(most)
    made.status[looked, m] = np.where(most[looked] > CLEAR_ABOVE, VISIBLE, HIDDEN)
    made.unit_ix[looked, m] = np.array(units)[best[looked]]


def _lists(heard: Tracks, unit: int, object_ix: int) -> tuple[Int, Float, Int]:
    """When a unit's lists that hold an object were captured and arrive (K,), in order; and when it captured any."""
    rows = np.flatnonzero((heard.row_object_ix == object_ix) & (heard.row_unit_ix == unit) & heard.valid[0])
    frames = np.unique(heard.frame_ix[rows])
    frames = frames[np.argsort(heard.captured_s[frames], kind="stable")]
    arrives_s = heard.common_arrives_s[frames]
    arrives_ns = np.where(np.isfinite(arrives_s), np.rint(arrives_s * 1e9), np.inf)
    every = np.sort(ns(heard.captured_s[heard.frame_unit_ix == unit]))
    return ns(heard.captured_s[frames]), arrives_ns, every


def _instants(seen: Sight, fused: Tracks, listed: list[list[tuple[Int, Float, Int]]], clock: Clock, end_ns: int) -> Int:
    """(K,) frames of the truth with a shown object and the one after, captures and arrivals of their lists, onsets."""
    captured = [captured_ns for of_object in listed for captured_ns, _, _ in of_object]
    rows = np.isin(fused.row_object_ix, seen.object_ix) & fused.valid[0]
    frames = np.unique(fused.frame_ix[rows])
    available = elapsed_ns(fused)[np.union1d(frames, np.minimum(frames + 1, len(fused.stamp_ns) - 1))]
    gone = seen.elapsed_ns[np.flatnonzero(np.diff(seen.elapsed_ns, append=0) > 1.5 * _period(seen.elapsed_ns))]
    after = [gone + _period(seen.elapsed_ns), seen.elapsed_ns[-1:] + _period(seen.elapsed_ns)]
    after = [np.minimum(instant, end_ns) for instant in after]
    told = np.concatenate([clock.onset_ns[seen.object_ix], clock.known_ns[seen.object_ix]])
    told = told[told != NEVER_NS]
    return np.unique(np.concatenate([seen.elapsed_ns, *after, *captured, available, told]).astype(np.int64))


def _period(elapsed_ns: Int) -> int:
    """Nanoseconds from one frame to the next, mostly."""
    return int(np.median(np.diff(elapsed_ns))) if len(elapsed_ns) > 1 else 100_000_000


def _under_way(captured_ns: Int, arrives_ns: Float, stamps_ns: Int, unit: int, m: int, made: Status) -> None:
    """Where a list of one unit that holds object m is under way, or was lost. Out: its column of `made`."""
    if not len(captured_ns):
        return
    now, status = made.elapsed_ns + SAME_INSTANT_NS, made.status[:, m]
    sent = np.searchsorted(captured_ns, now, side="right")
    newest = np.maximum(sent - 1, 0)
    # Until the unit captures its next list.
    still = np.searchsorted(stamps_ns, now, "right") == np.searchsorted(stamps_ns, captured_ns[newest], "right")
    lost = (sent > 0) & still & np.isinf(arrives_ns[newest]) & (status < LOST)
    made.status[lost, m], made.unit_ix[lost, m] = LOST, unit
    travels = np.isfinite(arrives_ns)
    sent = np.searchsorted(captured_ns[travels], now, side="right")
    arrivals = np.sort(arrives_ns[travels])
    arrived = np.searchsorted(arrivals, now, side="right")
    left_s = (np.append(arrivals, np.inf)[arrived] - made.elapsed_ns) * 1e-9
    soonest = (sent > arrived) & ~(made.until_s[:, m] <= left_s)
    soonest &= made.status[:, m] < UNMATCHED
    made.status[soonest, m], made.unit_ix[soonest, m], made.until_s[soonest, m] = CAPTURED, unit, left_s[soonest]
    if travels.any():
        # Gone by until a list that was captured later has been as long on its way.
        newest = np.maximum(arrived - 1, 0)
        held_ns, took_ns = captured_ns[travels][newest], (arrives_ns - captured_ns)[travels][newest]
        newer = np.searchsorted(stamps_ns, now - took_ns, "right") > np.searchsorted(stamps_ns, held_ns, "right")
        heard = (arrived > 0) & ~newer & (made.status[:, m] != ABSENT)
        made.status[heard, m], made.unit_ix[heard, m] = UNMATCHED, unit


def _held(fused_tracks: FusedTracks, object_ix: int, m: int, clock: Clock, count_earlier: bool, made: Status) -> None:
    """Where the receiver's newest list holds the object, and its fused position if it is gone. Out: as before."""
    fused = fused_tracks.fused
    row_of = np.full(len(fused.stamp_ns) + 1, -1)  # one more: there was no list yet
    rows = np.flatnonzero((fused.row_object_ix == object_ix) & fused.valid[0])
    row_of[fused.frame_ix[rows]] = rows
    row = row_of[np.searchsorted(elapsed_ns(fused), made.elapsed_ns + SAME_INSTANT_NS, side="right") - 1]
    held = np.flatnonzero(row >= 0)
    row = row[held]
    captured_s = fused_tracks.captured_s[0, row]
    made.age_of_information_s[held, m] = made.elapsed_ns[held] * 1e-9 - captured_s
    gone = np.isnan(made.x_m[held, m])  # whatever is under way
    top_m = fused.z_m[0] + fused.height_m[0] / 2
    for column, value in ((made.x_m, fused.x_m[0]), (made.y_m, fused.y_m[0]), (made.top_m, top_m)):
        column[held[gone], m] = value[row[gone]]
    too_late = elapsed_ns(fused)[fused.frame_ix[row]] - SAME_INSTANT_NS > clock.ended_ns[object_ix]
    status = np.where(too_late, TOO_LATE, UNCONFIRMED)
    if not count_earlier:
        status[captured_s * 1e9 < clock.onset_ns[object_ix] - SAME_INSTANT_NS] = EARLY
    status[made.elapsed_ns[held] >= clock.known_ns[object_ix]] = KNOWN
    made.status[held, m] = status

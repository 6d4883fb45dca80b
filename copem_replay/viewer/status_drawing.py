"""What a configuration knows of the shown objects, and why not: words at each, lines, and lanes over time."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pyarrow as pa

from copem_replay.communication.arrivals import fusion_schedule
from copem_replay.core.colours import Rgb
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import TRUTH, Bool, Int, Scene
from copem_replay.experiment.schema import Configuration, Experiment
from copem_replay.pipeline.prepare import Replay
from copem_replay.viewer.event_markers import ONSET
from copem_replay.viewer.line_of_sight import Sight
from copem_replay.viewer.sensors import unit_places
from copem_replay.viewer.sink import Out, f32, ns, object_labels, part_of, short_ids
from copem_replay.viewer.status import (
    ABSENT,
    CAPTURED,
    EARLY,
    HIDDEN,
    KNOWN,
    LOST,
    OUT,
    STATUSES,
    TOO_LATE,
    UNCONFIRMED,
    UNLISTED,
    UNMATCHED,
    VISIBLE,
    Clock,
    Status,
)

HIDES: Rgb = (255, 70, 60)
NOTICED: Rgb = (255, 255, 255)
WAITING: Rgb = (165, 165, 165)
"""Of words: hidden, known, all else. Not the configuration's colour, which some dark ones would make hard to read."""
OLD_S = 0.05
"""What is younger than this is not said to be old (chosen: less than a list)."""
ABOVE_M = 2.0
"""So far over an object is what is said of it (chosen)."""
LANES: Mapping[int, Rgb] = {
    ABSENT: (28, 28, 28),
    UNLISTED: (85, 85, 85),
    OUT: (60, 60, 60),
    HIDDEN: (130, 45, 40),
    VISIBLE: (115, 115, 115),
    LOST: (120, 50, 90),
    CAPTURED: (70, 80, 105),
    UNMATCHED: (120, 90, 30),
}
"""Of statuses in which the receiver has nothing; what is listed has the configuration's colour at half its strength,
what is known all of it."""
CLOCK = ("before the onset", "since the onset", "no longer looked at")
CLOCK_TINTS: tuple[Rgb, ...] = (LANES[ABSENT], ONSET, LANES[ABSENT])
"""Of a lane of its own under those of the configurations: the same for all of them."""


def words(out: Out, name: str, replay: Replay, experiment: Experiment, seen: Sight, made: Status, clock: Clock) -> None:
    """Over each object, where it truly is: “2 hidden from ego by 3 (share 0.12)”."""
    import rerun as rr

    rows, column = np.nonzero((made.status != ABSENT) & ~np.isnan(made.x_m))
    place = f32(*(getattr(made, n)[rows, column] for n in ("x_m", "y_m", "top_m")))
    place[:, 2] += ABOVE_M
    colours = np.full((len(rows), 3), WAITING, dtype=np.uint8)
    at = made.status[rows, column]
    colours[at == HIDDEN], colours[at == KNOWN] = HIDES, NOTICED
    started = made.elapsed_ns[rows] >= clock.onset_ns[seen.object_ix[column]]
    labels = _told(replay.scene, experiment, seen, made, rows, column, started)
    columns = rr.Points3D.columns(positions=place, labels=labels, colors=colours)
    path = ["world", part_of(name), "status"]
    out.columns(path, made.elapsed_ns, columns.partition(np.bincount(rows, minlength=len(made.elapsed_ns))))
    out.static(path, rr.Points3D.from_fields(radii=rr.Radius.ui_points(1.5), show_labels=True))


def _told(
    scene: Scene, experiment: Experiment, seen: Sight, made: Status, rows: Int, column: Int, started: Bool
) -> pa.Array:
    """(P,) in words; each sentence is made once. `started`: whether the object's clock runs."""
    frame, status, unit = np.maximum(made.frame[rows], 0), made.status[rows, column], made.unit_ix[rows, column]
    hidden = np.flatnonzero(status == HIDDEN)
    by = unit[hidden], frame[hidden], column[hidden]
    share, body = np.zeros(len(rows)), np.zeros(len(rows), dtype=np.int64)
    share[hidden], body[hidden] = seen.share[by], seen.body_ix[by]
    time_s = np.nan_to_num(
        np.where(status >= EARLY, made.age_of_information_s[rows, column], made.until_s[rows, column])
    )
    near = seen.in_range[:, frame, column].any(axis=0)
    whole = [np.rint(value).astype(np.int64) for value in (time_s * 10, share * 100)]
    columns = np.stack([column, status, unit, *whole, body, near, started], axis=-1)
    keys, which = np.unique(columns, axis=0, return_inverse=True)
    ids, units = short_ids(scene), [*experiment.units, TRUTH]  # −1: the truth, or nobody
    told = [_sentence(ids, ids[seen.object_ix[key[0]]], units[key[2]], key) for key in keys.tolist()]
    return pa.array(told, pa.string()).take(pa.array(which.reshape(-1)))


def _sentence(ids: tuple[str, ...], who: str, unit: str, key: list[int]) -> str:
    _, status, _, tenths, hundredths, body, near, started = key
    if status >= EARLY:
        old = "" if tenths * 0.1 <= OLD_S else f", {tenths / 10:.1f} s old"
        early = ", onset not known yet" if started else ""
        after = {EARLY: f"{old}{early}", UNCONFIRMED: f"{old}, not confirmed yet", TOO_LATE: f" too late{old}"}
        return f"{who} known{old}" if status == KNOWN else f"{who} listed{after[status]}"
    if status == CAPTURED:
        return f"{who} listed by {unit}, arrives in {tenths / 10:.1f} s"
    if status == UNMATCHED:
        return f"{who} listed by {unit}, no entry matched"
    if status == LOST:
        return f"{who} listed by {unit}, list lost"
    if status == VISIBLE:
        return f"{who} not listed yet" if unit == TRUTH else f"{who} seen by {unit}, not listed"
    if status == UNLISTED:
        return f"{who} not listed"
    if status == HIDDEN:
        what = ids[body] if body >= 0 else f"obstacle {-1 - body}"
        return f"{who} hidden from {unit} by {what} (share {hundredths / 100:.2f})"
    return f"{who} outside fields of view" if near else f"{who} out of range"


def hiding(out: Out, name: str, seen: Sight, made: Status) -> None:
    """Lines from the unit that sees most of a hidden object to what hides it."""
    import rerun as rr

    rows, column = np.nonzero(made.status == HIDDEN)
    if not len(rows):
        return
    by, frame = made.unit_ix[rows, column], made.frame[rows]
    lines = np.stack([seen.place_m[by, frame], seen.body_m[by, frame, column]], axis=1)
    counts = np.bincount(rows, minlength=len(made.elapsed_ns))
    told = np.flatnonzero((counts > 0) | (np.append(0, counts[:-1]) > 0))  # none: once is enough
    path = ["world", part_of(name), "hiding"]
    columns = rr.LineStrips3D.columns(strips=lines.astype(np.float32)).partition(counts[told])
    out.columns(path, made.elapsed_ns[told], columns)
    out.static(path, rr.LineStrips3D.from_fields(colors=[HIDES], radii=rr.Radius.ui_points(1.25)))


def listings(
    out: Out, name: str, replay: Replay, experiment: Experiment, asked: Configuration, fused_tracks: FusedTracks,
    seen: Sight, colour: Rgb,
) -> None:  # fmt: skip
    """Lines from each unit, where it was at capture, to where it listed the shown objects."""
    import rerun as rr

    if not len(seen.object_ix):
        return
    heard = fused_tracks.heard
    at = fusion_schedule(heard, max_age_s=asked.max_age_s)
    place = unit_places(replay, experiment, heard)
    row_of = np.full((len(heard.stamp_ns) + 1, len(seen.object_ix)), -1)  # one more: no list
    rows = np.flatnonzero(np.isin(heard.row_object_ix, seen.object_ix) & heard.valid[0])
    column = (heard.row_object_ix[rows, None] == seen.object_ix).argmax(axis=1)
    row_of[heard.frame_ix[rows], column] = rows
    row_of[:-1][np.isnan(place[:, 0])] = -1
    k, u, m = np.nonzero(row_of[at.newest] >= 0)
    rows = row_of[at.newest[k, u], m]
    if not len(rows):
        return
    ends = f32(heard.x_m[0, rows], heard.y_m[0, rows], heard.z_m[0, rows])
    lines = np.stack([place[heard.frame_ix[rows]].astype(np.float32), ends], axis=1)
    counts = np.bincount(k, minlength=len(at.issue_s))
    told = np.flatnonzero((counts > 0) | (np.append(0, counts[:-1]) > 0))
    path = ["world", part_of(name), "listings"]
    out.columns(path, ns(at.issue_s[told]), rr.LineStrips3D.columns(strips=lines).partition(counts[told]))
    out.static(path, rr.LineStrips3D.from_fields(colors=[colour], radii=rr.Radius.ui_points(0.5)))


def lanes(
    out: Out, scene: Scene, seen: Sight, made: Mapping[str, Status], colours: Mapping[str, Rgb], clock: Clock
) -> None:
    """Of each shown object a lane per configuration: what it is to it, over time; and one that marks the onset."""
    import rerun as rr

    if not made or not len(seen.object_ix):
        return
    texts = [*(f"{name} {status}" for name in colours for status in STATUSES), *CLOCK]
    tints = [*(_tint(status, colours[name]) for name in colours for status in range(len(STATUSES))), *CLOCK_TINTS]
    style = rr.StateConfiguration(values=texts, labels=texts, colors=tints)
    every = pa.array(texts, pa.string())
    ended = clock.ended_ns[seen.object_ix] + 1
    elapsed = np.unique(np.concatenate([ended, *(of.elapsed_ns for of in made.values())]))
    for m, k in enumerate(seen.object_ix.tolist()):
        columns = []
        for c, name in enumerate(colours):
            of = made[name]
            row = np.searchsorted(of.elapsed_ns, elapsed, side="right") - 1
            columns.append(np.where(row >= 0, of.status[np.maximum(row, 0), m], ABSENT) + c * len(STATUSES))
        columns.append(np.searchsorted([clock.onset_ns[k], ended[m]], elapsed, "right") + len(colours) * len(STATUSES))
        state = np.stack(columns, axis=-1)
        told = np.flatnonzero(np.append(True, (state[1:] != state[:-1]).any(axis=1)))
        values = every.take(pa.array(state[told].reshape(-1)))
        path = ["lanes", object_labels(scene)[k].as_py()]
        out.columns(path, elapsed[told], rr.StateChange.columns(state=values).partition([len(columns)] * len(told)))
        out.static(path, style)


def _tint(status: int, colour: Rgb) -> Rgb:
    if status < EARLY:
        return LANES[status]
    return colour if status == KNOWN else (colour[0] // 2, colour[1] // 2, colour[2] // 2)

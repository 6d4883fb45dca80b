"""Lists of stations (CPM, SDSM): brought from their station into the log, and their times.

A list is captured when most of its objects were measured, and arrives when it was logged: a station sends no time of
arrival. Objects that were measured at other times are moved to the capture along their velocity.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from copem_replay.core.errors import InputError, RecordingError, count_noun
from copem_replay.core.frame import Frame
from copem_replay.core.tracks import Bool, Int
from copem_replay.io.findings import VX, VY, find
from copem_replay.io.frames import SampledPoses, transform_rows
from copem_replay.io.ground_truth import take_messages
from copem_replay.io.schemas.object_lists import DecodedLists, Station
from copem_replay.io.stamps import SLACK_NS


def _take_lists(lists: DecodedLists, station: Station, kept: Bool) -> tuple[DecodedLists, Station]:
    """The lists `kept` (F,)."""
    rows = np.repeat(kept, lists.columns.rows)
    columns = {name: getattr(lists, name)[rows] for name in ("frame_code", "existence", "covariance_m2", "probability")}
    station = Station(station.place[kept], station.after_s[rows])
    return replace(lists, columns=take_messages(lists.columns, kept), station=station, **columns), station


def place_on_earth(
    lists: DecodedLists, station: Station, frame: Frame | None, path: Path, topic: str
) -> tuple[DecodedLists, Station]:
    """The lists in metres of the log, which has the `frame`; those whose station has no place are left out.

    Raises RecordingError, naming `path` and `topic`: the log has no frame, no list has a place, or one out of reach.
    """
    if frame is None:
        raise RecordingError(
            "its positions are relative to stations on earth, and the log does not say where it is: give "
            "`frame: {proj: …}` (docs/guide/place.md)",
            path=path,
            topic=topic,
        )
    known: Bool = np.all(np.abs(station.place) <= (90.0, 180.0), axis=1)
    if len(known) and not known.any():
        missing = count_noun(len(known), "message")
        raise RecordingError(f"none of its {missing} has the reference position of its station", path=path, topic=topic)
    lists, station = _take_lists(lists, station, known)
    notes = find("no station", int((~known).sum()))
    places, place = np.unique(station.place, axis=0, return_inverse=True)
    try:
        at_m = frame.from_wgs84(places)
    except InputError as error:
        raise RecordingError("; ".join(error.problems), path=path, topic=topic) from None
    half = np.array([np.deg2rad(frame.convergence_deg(*at)) - frame.yaw_rad for at in places]).reshape(-1) / 2
    zero = np.zeros(len(places))
    placed = SampledPoses(
        np.ones(len(places), dtype=bool),
        np.column_stack([at_m, zero]),
        np.stack([zero, zero, np.sin(half), np.cos(half)], axis=1),
    )
    scale = np.array([frame.scale(*at) for at in places]).reshape(-1)
    instant = np.repeat(place.reshape(-1), lists.columns.rows)
    values = lists.columns.values.copy()
    values[:, :2] *= scale[instant, None]
    values, covariance = transform_rows(values, lists.covariance_m2, placed, instant)
    columns = replace(lists.columns, values=values, notes=(*lists.columns.notes, *notes))
    return replace(lists, columns=columns, covariance_m2=covariance), station


def settle_measurements(
    lists: DecodedLists, station: Station, t0_ns: int, path: Path, topic: str
) -> tuple[DecodedLists, Int, Bool]:
    """The lists with their objects at one capture each, (F,) captures, and whether these are stated.

    Stamps are arrivals then. Where the stations' clock is not that of the times of logging, these are taken: captures
    are not stated then. Lists captured more than a second before `t0_ns` are left out. Raises RecordingError: all are.
    """
    columns, notes = lists.columns, list(lists.columns.notes)
    apart_ns = np.sort((columns.log_time_ns - columns.stamp_ns)[columns.stamped])
    median_ns = int(apart_ns[len(apart_ns) // 2]) if len(apart_ns) else 0
    said = columns.stamped & (abs(median_ns) <= SLACK_NS)
    notes += find("station clock", int((columns.stamped & ~said).sum()), apart=median_ns * 1e-9)
    captured_ns, after_s = np.where(said, columns.stamp_ns, columns.log_time_ns), np.zeros(len(columns.rows))
    ends = np.cumsum(columns.rows)
    for k in np.flatnonzero(columns.rows).tolist():
        measured_s = np.sort(station.after_s[ends[k] - columns.rows[k] : ends[k]])
        after_s[k] = measured_s[(len(measured_s) - 1) // 2]
    away_s = np.repeat(after_s, columns.rows) - station.after_s
    values = columns.values.copy()
    values[:, :2] += away_s[:, None] * np.nan_to_num(values[:, VX : VY + 1])
    notes += find("measured apart", int((away_s != 0).sum()), most=float(np.abs(away_s).max(initial=0.0)))
    captured_ns = captured_ns + np.rint(after_s * 1e9).astype(np.int64)
    kept = captured_ns >= t0_ns - SLACK_NS
    if len(kept) and not kept.any():
        missing, before_s = count_noun(len(kept), "message"), (t0_ns - captured_ns.max()) * 1e-9
        raise RecordingError(
            f"all of its {missing} are older than the log, the last one by {before_s:.3g} s", path=path, topic=topic
        )
    notes += find("older", int((~kept).sum()))
    arrived = replace(columns, values=values, stamp_ns=columns.log_time_ns, notes=tuple(notes))
    lists, _ = _take_lists(replace(lists, columns=arrived), station, kept)
    return lists, captured_ns[kept], said[kept]

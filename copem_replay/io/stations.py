"""Lists of stations (CPM, SDSM): brought from their station into the log, their times, and where sensors look.

A list is captured when most of its objects were measured, and arrives when it was logged: a station sends no time of
arrival. Objects that were measured at other times are moved to the capture along their velocity.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from copem_replay.core.errors import InputError, RecordingError, count_noun
from copem_replay.core.frame import Frame
from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.io.channel import DefinitionError, schema_name
from copem_replay.io.encodings import make_definition
from copem_replay.io.encodings.columns import shred_messages
from copem_replay.io.findings import VX, VY, find
from copem_replay.io.frames import SampledPoses, transform_rows
from copem_replay.io.ground_truth import take_messages
from copem_replay.io.log import Log, gather_messages
from copem_replay.io.schemas.object_lists import DecodedLists, Station
from copem_replay.io.schemas.v2x import CPM, PLACE_PATHS, SENSOR_PATHS, View, find_views
from copem_replay.io.stamps import SLACK_NS


def place_on_earth(lists: DecodedLists, station: Station, frame: Frame | None, path: Path, topic: str) -> DecodedLists:
    """The lists in metres of the log, which has the `frame`; those whose station has no place are left out.

    Raises RecordingError, naming `path` and `topic`: the log has no frame, no list has a place, or one out of reach.
    """
    if frame is None:
        why = "its positions are relative to stations on earth, and the log does not say where it is"
        raise RecordingError(f"{why}: give `frame: {{proj: …}}` (docs/guide/place.md)", path=path, topic=topic)
    known = _is_on_earth(station.place)
    if len(known) and not known.any():
        missing = count_noun(len(known), "message")
        raise RecordingError(f"none of its {missing} has the reference position of its station", path=path, topic=topic)
    lists = _take_messages(lists, known)
    places, place = np.unique(station.place[known], axis=0, return_inverse=True)
    try:
        at_m = frame.from_wgs84(places)
    except InputError as error:
        raise RecordingError("; ".join(error.problems), path=path, topic=topic) from None
    turns = [np.deg2rad(frame.convergence_deg(*degrees)) - frame.yaw_rad for degrees in places]
    half, zero = np.array(turns, dtype=float) / 2, np.zeros(len(places))
    rotation = np.stack([zero, zero, np.sin(half), np.cos(half)], axis=1)
    placed = SampledPoses(np.ones(len(places), dtype=bool), np.column_stack([at_m, zero]), rotation)
    instant, values = np.repeat(place.reshape(-1), lists.columns.rows), lists.columns.values.copy()
    values[:, :2] *= np.array([frame.scale(*degrees) for degrees in places], dtype=float)[instant, None]
    values, covariance = transform_rows(values, lists.covariance_m2, placed, instant)
    notes = (*lists.columns.notes, *find("no station", int((~known).sum())))
    return replace(lists, columns=replace(lists.columns, values=values, notes=notes), covariance_m2=covariance)


def _is_on_earth(place_deg: Float) -> Bool:
    """(F,) whether latitudes and longitudes (F, 2) are ones; others say that there is none."""
    known: Bool = np.all(np.abs(place_deg) <= (90.0, 180.0), axis=1)
    return known


def _take_messages(lists: DecodedLists, keep: Bool) -> DecodedLists:
    """The lists `keep` (F,)."""
    lists = lists.take_rows(np.repeat(keep, lists.columns.rows))
    return replace(lists, columns=take_messages(lists.columns, keep))


def settle_measurements(
    lists: DecodedLists, t0_ns: int, path: Path, topic: str
) -> tuple[DecodedLists, tuple[Int, Bool]]:
    """The lists of stations with their objects at one capture each, (F,) captures, and whether these are stated.

    Stamps are arrivals then. Where the stations' clock is not that of the times of logging, these are taken: captures
    are not stated then. Lists captured more than a second before `t0_ns` are left out. Raises RecordingError: all are.
    """
    columns, notes = lists.columns, list(lists.columns.notes)
    measured_s = np.zeros(0) if lists.station is None else lists.station.after_s
    apart_ns = np.sort((columns.log_time_ns - columns.stamp_ns)[columns.stamped])
    median_ns = int(apart_ns[len(apart_ns) // 2]) if len(apart_ns) else 0
    is_stated = columns.stamped & (abs(median_ns) <= SLACK_NS)
    notes += find("station clock", int((columns.stamped & ~is_stated).sum()), apart=median_ns * 1e-9)
    middles = (np.sort(of)[(len(of) - 1) // 2 :] for of in np.split(measured_s, np.cumsum(columns.rows)[:-1]))
    after_s = np.array([middle[0] if len(middle) else 0.0 for middle in middles])
    away_s = np.repeat(after_s, columns.rows) - measured_s
    values = columns.values.copy()
    values[:, :2] += away_s[:, None] * np.nan_to_num(values[:, VX : VY + 1])
    notes += find("measured apart", int((away_s != 0).sum()), most=float(np.abs(away_s).max(initial=0.0)))
    captured_ns = np.where(is_stated, columns.stamp_ns, columns.log_time_ns) + np.rint(after_s * 1e9).astype(np.int64)
    keep = captured_ns >= t0_ns - SLACK_NS
    if len(keep) and not keep.any():
        older = f"all of its {count_noun(len(keep), 'message')} are older than the log"
        before_s = (t0_ns - captured_ns.max()) * 1e-9
        raise RecordingError(f"{older}, the last one by {before_s:.3g} s", path=path, topic=topic)
    notes += find("older", int((~keep).sum()))
    arrived = replace(columns, values=values, stamp_ns=columns.log_time_ns, notes=tuple(notes))
    return _take_messages(replace(lists, columns=arrived), keep), (captured_ns[keep], is_stated[keep])


class StationViews(NamedTuple):
    """Where a station stands, latitude and longitude, and where its sensors look; `why` that is not known."""

    place_deg: tuple[float, float]
    views: tuple[View, ...]
    why: str


_STANDS_DEG = 2e-5
"""A station moves if its places differ by more: 2 m."""


def read_station_views(log: Log, topic: str) -> StationViews | None:
    """What the CPMs on a topic say of their station's sensors; None: nothing."""
    views, places, why = dict[View, None](), list[Float](), ""
    for channel in (c for c in log.channels if c.topic == topic and c.messages and schema_name(c) == CPM):
        payloads = gather_messages(log, frozenset({channel.number})).payloads[channel.number]
        with suppress(DefinitionError, KeyError):  # other fields than published ones, or too much memory
            found = shred_messages(make_definition(channel, payloads), payloads, [*SENSOR_PATHS, *PLACE_PATHS])
            seen, unread = find_views(found)
            views |= dict.fromkeys(seen)
            places.append(np.stack([found.levels[""].numbers[path] / 1e7 for path in PLACE_PATHS], axis=1))
            why = why or unread
    if not (views or why):
        return None
    at_deg = np.concatenate(places)
    at_deg = at_deg[_is_on_earth(at_deg)]
    if not len(at_deg):
        return None
    if (np.ptp(at_deg, axis=0) > _STANDS_DEG).any():
        why = "its messages are from several places; expected a station that stands"
    lat, lon = np.median(at_deg, axis=0).tolist()
    return StationViews((lat, lon), () if why else tuple(views), why)

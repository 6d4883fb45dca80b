"""Object lists as they were recorded: osi3.SensorData on one topic of a recording, as tracks of one unit.

A list is captured at its `last_measurement_time`, else at its time stamp, and arrives at its time stamp. Positions are
in the world where the message has no host location, else they are transformed from the virtual sensor's frame. What
this project wrote beside its own lists (`…/detail`) gives the full covariances back.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError

from copem_replay.core.errors import RecordingError
from copem_replay.core.interpolation import wrap
from copem_replay.core.tracks import CLASSES, UNCERTAINTIES, VALUES, Bool, Float, Int, Scene, Tracks
from copem_replay.io.log import BrokenIndexError, Log
from copem_replay.io.open import open_log
from copem_replay.io.schemas import osi_ground_truth as osi
from copem_replay.io.schemas.decoded import LAST_NS
from copem_replay.io.schemas.registry import known_lists
from copem_replay.io.together import Local
from copem_replay.io.window import Window
from copem_replay.io.write import detail_json as detail
from copem_replay.io.write import osi_sensor_data as sensor_data

_LARGEST_ID = 2**63 - 1
"""OSI's identifiers are unsigned: what is beyond the signed ones is brought among them."""


@dataclass
class _Rows:
    """Entries of all lists, in the order of the messages."""

    stamps: list[tuple[int, int]] = field(default_factory=list)  # captured, arrives
    frame: list[int] = field(default_factory=list)
    ident: list[int] = field(default_factory=list)  # ground truth id, −1: none
    track: list[int] = field(default_factory=list)  # −1: none
    values: list[tuple[float, ...]] = field(default_factory=list)
    variances: list[tuple[float, ...]] = field(default_factory=list)
    existence: list[float] = field(default_factory=list)  # NaN: not said
    likely: list[dict[int, float]] = field(default_factory=list)  # probability by class, as far as it is said
    spread_said: list[bool] = field(default_factory=list)
    capture_said: list[bool] = field(default_factory=list)  # of every list, as the next two
    stamped: list[bool] = field(default_factory=list)
    logged: list[int] = field(default_factory=list)


def read_lists(path: Local, topic: str, scene: Scene) -> Tracks:
    """The lists on `topic`, their objects told by the ids of `scene` (−1 where the list names no object of it).

    Raises RecordingError when there is no such topic of osi3.SensorData, or a message of it cannot be decoded.
    """
    return _tracks(*_all_rows(path, topic), topic, scene)


@dataclass(frozen=True)
class RecordedLists:
    """Lists as a unit made them. Every row of `tracks` is a track of its own, without truth id: (P,) each.

    `existence` is NaN where it is not said; `class_probability (P, C)` sums to 1. `spread_said`: whether the list gives
    the covariance of the position, else it is 0. `capture_said (F,)`: whether the list says when it was captured,
    `stamped (F,)` whether it has a time stamp, `logged_ns (F,)` when it was recorded.
    """

    tracks: Tracks
    existence: Float
    class_probability: Float
    track_id: Int
    spread_said: Bool
    capture_said: Bool
    stamped: Bool
    logged_ns: Int
    dropped: int  # entries that had no place


@np.errstate(over="ignore", invalid="ignore")
def read_recorded(path: Local, topic: str, scene: Scene, window: Window | None = None) -> RecordedLists:
    """The lists on `topic` with all they say, but ids of the truth. Raises RecordingError as `read_lists`."""
    rows, _ = _all_rows(path, topic, window)
    stamps = np.array(rows.stamps, dtype=np.int64).reshape(-1, 2)
    by_time, frame = in_time(stamps[:, 1], np.array(rows.frame, dtype=np.int64))
    values = np.array(rows.values, dtype=float).reshape(-1, len(VALUES))
    variances = np.array(rows.variances, dtype=float).reshape(-1, len(UNCERTAINTIES))
    placed = np.isfinite(values[:, :2]).all(axis=1)
    order = np.flatnonzero(placed)[np.argsort(frame[placed], kind="stable")]
    values, variances = np.nan_to_num(values[order]), np.nan_to_num(variances[order])
    probability = np.zeros((len(order), len(CLASSES)))
    for p, k in enumerate(order):
        for index, share in rows.likely[k].items():
            probability[p, index] += share
    none = probability.sum(axis=1) <= 0
    probability[none, osi.OTHER] = 1.0
    tracks = as_tracks(
        topic,
        scene,
        stamps[by_time],
        np.arange(len(order) + 1),
        np.full(len(order), -1),
        frame[order],
        values,
        variances,
    )
    return RecordedLists(
        tracks,
        np.array(rows.existence, dtype=float)[order],
        probability / probability.sum(axis=1, keepdims=True),
        np.array(rows.track, dtype=np.int64)[order],
        np.array(rows.spread_said, dtype=bool)[order],
        np.array(rows.capture_said, dtype=bool)[by_time],
        np.array(rows.stamped, dtype=bool)[by_time],
        np.array(rows.logged, dtype=np.int64)[by_time],
        int((~placed).sum()),
    )


def _all_rows(path: Local, topic: str, window: Window | None = None) -> tuple[_Rows, dict[int, dict[str, Any]]]:
    log = open_log(path).within(window)
    try:
        return _read(log, topic)
    except BrokenIndexError as error:
        return _read(log.from_start(error), topic)


def _no_lists(log: Log, topic: str) -> str:
    """That a topic holds no lists of a unit, and which ones do."""
    there = {c.topic for c in log.channels if c.schema == sensor_data.SCHEMA} | {
        c.topic for c in known_lists(log.channels)
    }
    schemas = sorted({c.schema or "no schema" for c in log.channels if c.topic == topic})
    found = f"topic {topic!r} holds {', '.join(schemas)}" if schemas else f"no topic {topic!r}"
    if not there:
        return f"{found}; no topic of this log holds lists of a unit"
    return f"{found}; lists of units are on {', '.join(sorted(there))}"


def _read(log: Log, topic: str) -> tuple[_Rows, dict[int, dict[str, Any]]]:
    chosen = {c.number: c for c in log.channels if c.topic == topic and c.schema == sensor_data.SCHEMA}
    if not chosen:
        raise RecordingError(_no_lists(log, topic), path=log.path)
    detail_topic = f"{topic.removesuffix('/objects')}/detail"
    beside = {c.number for c in log.channels if c.topic == detail_topic and c.schema == detail.SCHEMA}
    rows = _Rows()
    details: dict[int, dict[str, Any]] = {}
    for number, log_time_ns, payload in log.payloads(frozenset({*chosen, *beside})):
        if number in beside:
            content = json.loads(payload)
            details[content["available_ns"]] = {item["id"]: item for item in content["objects"]}
        else:
            try:
                message = sensor_data.message_class().FromString(payload)
            except DecodeError as error:
                raise RecordingError(f"a message cannot be decoded: {error}", path=log.path, topic=topic) from None
            _add(rows, message, log_time_ns)
            if chosen[number].ahead_ns:  # by the clock of the log times
                by_message = message.HasField("timestamp"), message.HasField("last_measurement_time")
                captured_ns, arrives_ns = rows.stamps[-1]
                captured_ns -= chosen[number].ahead_ns * any(by_message)
                rows.stamps[-1] = captured_ns, arrives_ns - chosen[number].ahead_ns * by_message[0]
            if max(map(abs, rows.stamps[-1])) > LAST_NS:
                raise RecordingError("a message has an impossible time stamp", path=log.path, topic=topic)
    return rows, details


def _add(rows: _Rows, message: Any, log_time_ns: int) -> None:
    stamp = message.timestamp
    arrives_ns = stamp.seconds * 10**9 + stamp.nanos if message.HasField("timestamp") else log_time_ns
    last = message.last_measurement_time
    captured_ns = last.seconds * 10**9 + last.nanos if message.HasField("last_measurement_time") else arrives_ns
    frame = len(rows.stamps)
    rows.stamps.append((captured_ns, arrives_ns))
    rows.capture_said.append(message.HasField("last_measurement_time"))
    rows.stamped.append(message.HasField("timestamp"))
    rows.logged.append(min(log_time_ns, LAST_NS))
    for item in [*message.moving_object, *message.stationary_object]:
        base, spread = item.base, item.base_rmse
        place, size, speed = base.position, base.dimension, getattr(base, "velocity", None)
        rows.frame.append(frame)
        truth = item.header.ground_truth_id
        rows.ident.append(truth[0].value if truth else -1)
        tracked = item.header.HasField("tracking_id")
        rows.track.append(item.header.tracking_id.value & _LARGEST_ID if tracked else -1)
        vx, vy = (speed.x, speed.y) if speed is not None else (0.0, 0.0)
        x, y, z, yaw, vx, vy = _in_world(message, place.x, place.y, place.z, base.orientation.yaw, vx, vy)
        if not base.HasField("position"):  # nowhere is not the origin
            x = y = np.nan
        rows.values.append((x, y, z, yaw, vx, vy, size.length, size.width, size.height))
        fast = spread.velocity.x if speed is not None else 0.0
        beside = (spread.orientation.yaw, spread.dimension.length, fast)
        along, across, turn = spread.position.x**2, spread.position.y**2, _turn(message)
        cos, sin = np.cos(turn), np.sin(turn)
        rows.variances.append(
            (
                float(cos * cos * along + sin * sin * across),
                float(cos * sin * (along - across)),
                float(sin * sin * along + cos * cos * across),
                *(s * s for s in beside),
            )
        )
        header = item.header
        said = header.HasField("existence_probability")
        rows.existence.append(header.existence_probability if said else np.nan)
        rows.likely.append(_likely(item))
        rows.spread_said.append(spread.position.HasField("x") and spread.position.HasField("y"))


def _likely(item: Any) -> dict[int, float]:
    """Probability by class of what a unit takes a moving object for; stationary ones have no class here."""
    likely: dict[int, float] = {}
    for candidate in getattr(item, "candidate", ()):
        if not hasattr(candidate, "vehicle_classification"):  # a stationary object's
            continue
        vehicle = candidate.vehicle_classification
        kind = osi.class_of(candidate.type, vehicle.type if candidate.HasField("vehicle_classification") else None)
        share = candidate.probability if candidate.HasField("probability") else 1.0
        likely[kind] = likely.get(kind, 0.0) + max(share, 0.0)
    return likely


def _turn(message: Any) -> float:
    """By how much the frame of the entries is turned against the world."""
    if not message.HasField("host_vehicle_location"):
        return 0.0
    return float(message.mounting_position.orientation.yaw + message.host_vehicle_location.orientation.yaw)


def _in_world(
    message: Any, x: float, y: float, z: float, yaw: float, vx: float, vy: float
) -> tuple[float, float, float, float, float, float]:
    """From the virtual sensor's frame, where the message says where its host is; else it is the world already."""
    if not message.HasField("host_vehicle_location"):
        return x, y, z, yaw, vx, vy
    for frame in (message.mounting_position, message.host_vehicle_location):
        cos, sin, turn = np.cos(frame.orientation.yaw), np.sin(frame.orientation.yaw), frame.orientation.yaw
        x, y, z = (
            cos * x - sin * y + frame.position.x,
            sin * x + cos * y + frame.position.y,
            z + frame.position.z,
        )
        vx, vy, yaw = cos * vx - sin * vy, sin * vx + cos * vy, yaw + turn
    return float(x), float(y), float(z), float(wrap(np.array(yaw))), float(vx), float(vy)


def _tracks(rows: _Rows, details: dict[int, dict[str, Any]], topic: str, scene: Scene) -> Tracks:
    stamps = np.array(rows.stamps, dtype=np.int64).reshape(-1, 2)
    by_time, frame = in_time(stamps[:, 1], np.array(rows.frame, dtype=np.int64))
    known = {sensor_data.osi_id(name): k for k, name in enumerate(scene.object_ids)}
    object_ix = np.array([known.get(i, -1) for i in rows.ident], dtype=np.int64)
    track = np.array(rows.track, dtype=np.int64)
    order = np.lexsort((frame, track, object_ix))
    new = np.ones(len(order), dtype=bool)
    new[1:] = (np.diff(object_ix[order]) != 0) | (np.diff(track[order]) != 0)
    first = np.flatnonzero(new)
    values = np.array(rows.values, dtype=float).reshape(-1, len(VALUES))[order]
    variances = np.array(rows.variances, dtype=float).reshape(-1, len(UNCERTAINTIES))[order]
    for p, (k, f) in enumerate(zip(object_ix[order].tolist(), frame[order].tolist(), strict=True)):
        item = details.get(int(stamps[by_time[f], 1]), {}).get(scene.object_ids[k]) if k >= 0 else None
        if item is not None:
            variances[p] = [np.nan if item[name] is None else item[name] for name in UNCERTAINTIES]
    start = np.append(first, len(order))
    return as_tracks(topic, scene, stamps[by_time], start, object_ix[order][first], frame[order], values, variances)


def in_time(stamps_ns: Int, frame: Int) -> tuple[Int, Int]:
    """Lists (F,) in order of time, and the places in that order of the lists of rows (P,)."""
    by_time = np.argsort(stamps_ns, kind="stable")
    place = np.empty_like(by_time)
    place[by_time] = np.arange(len(by_time))
    return by_time, place[frame]


def as_tracks(
    topic: str, scene: Scene, stamps: Int, start: Int, object_ix: Int, frame_ix: Int, values: Float, variances: Float
) -> Tracks:
    """Tracks of one unit: `stamps (F, 2)` captured and arriving, `start (E + 1,)`, `object_ix (E,)`, rows (P,)."""
    seconds = (stamps - scene.t0_ns) * np.float64(1e-9)
    return Tracks(
        units=(topic,),
        start=start,
        unit_ix=np.zeros(len(object_ix), dtype=np.int64),
        object_ix=object_ix,
        frame_ix=frame_ix,
        stamp_ns=stamps[:, 0],
        captured_s=seconds[:, 0],
        frame_unit_ix=np.zeros(len(stamps), dtype=np.int64),
        arrives_s=seconds[None, :, 1],
        valid=np.ones((1, len(frame_ix)), dtype=bool),
        **{name: values[None, :, k] for k, name in enumerate(VALUES)},
        **{name: variances[None, :, k] for k, name in enumerate(UNCERTAINTIES)},
    )

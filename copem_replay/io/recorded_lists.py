"""Object lists of a unit as they were recorded on one topic, in any format that is read, as tracks.

Of osi3.SensorData a list is captured at its `last_measurement_time`, else at its time stamp, and arrives at its time
stamp. Positions are in the world where the message has no host location, else they are transformed from the virtual
sensor's frame. Lists of other formats are captured and arrive at their stamps; `io/frames.py` brings them into the
world, `io/stations.py` those of stations.

`copem-replay` writes a topic `…/detail` beside its own lists: it holds what their messages have no fields for, such as
captures and full covariances, and these are taken from there.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError

from copem_replay.core.errors import RecordingError
from copem_replay.core.files import parse_json
from copem_replay.core.interpolation import wrap_angles
from copem_replay.core.tracks import CLASSES, UNCERTAINTIES, VALUES, Bool, Float, Int, Scene, Tracks
from copem_replay.io.channel import LAST_NS, DefinitionError, schema_name
from copem_replay.io.decoded_size import DecodeAllowance, OversizeError, check_objects
from copem_replay.io.encodings import make_definition
from copem_replay.io.encodings.columns import shred_messages
from copem_replay.io.findings import (
    MOST_SHARE,
    VX,
    VY,
    Finding,
    complete_entries,
    complete_sizes,
    find,
    sift_covariances,
    sift_shares,
    sift_states,
)
from copem_replay.io.frames import LogContext, read_decoded_lists, read_log_context, transform_to_world
from copem_replay.io.log import Log, gather_messages
from copem_replay.io.open import Local, open_log
from copem_replay.io.schemas import osi_ground_truth as osi
from copem_replay.io.schemas.object_lists import DecodedLists
from copem_replay.io.schemas.osi_ground_truth import SENSOR_DATA, check_osi, load_message_class, osi_id
from copem_replay.io.schemas.registry import DETAIL_SCHEMA, STRING, known_lists
from copem_replay.io.stamps import refuse_second_run, settle_stamps
from copem_replay.io.stations import place_on_earth, settle_measurements
from copem_replay.io.window import Window

Details = Mapping[int, Mapping[str, Any]]
"""What `…/detail` says beside lists, by the time in ns at which each was available."""
_LARGEST_ID = 2**63 - 1
"""OSI's identifiers are unsigned: the highest bit of larger ones is dropped, so that they fit signed integers."""


@dataclass
class _EntryRows:
    """Entries of all lists, in the order of the messages."""

    captured: list[int | None] = field(default_factory=list)  # in ns, None: not said; of every list, as the next four
    arrives: list[int | None] = field(default_factory=list)
    logged: list[int] = field(default_factory=list)
    still: list[set[int]] = field(default_factory=list)  # ground truth ids of stationary objects
    ahead: list[int] = field(default_factory=list)  # of the clock of the stamps against that of log times
    undecoded: int = 0
    impossible: int = 0  # stamps that are none
    rules: Counter[str] = field(default_factory=Counter)  # findings on entries, by rule
    frame: list[int] = field(default_factory=list)
    ident: list[int] = field(default_factory=list)  # ground truth id, −1: none
    track: list[int] = field(default_factory=list)  # −1: none
    values: list[tuple[float, ...]] = field(default_factory=list)
    variances: list[tuple[float, ...]] = field(default_factory=list)
    existence: list[float] = field(default_factory=list)  # NaN: not said
    likely: list[dict[int, float]] = field(default_factory=list)  # probability by class, as far as stated

    def add_details(self, details: Mapping[int, Sequence[Any]]) -> None:
        """Take the variances that a topic `…/detail` states, by the time in ns at which each list was available."""
        first = np.searchsorted(self.frame, np.arange(len(self.arrives) + 1)).tolist()
        for begin, end, stamp_ns, still in zip(first[:-1], first[1:], self.arrives, self.still, strict=True):
            items = [item for item in details.get(stamp_ns or 0, ()) if isinstance(item, dict)]
            items.sort(key=lambda item: osi_id(str(item.get("id"))) in still)  # stationary ones are last in messages
            for p, item in zip(range(begin, end), items if len(items) == end - begin else (), strict=False):
                stated = (item.get(name, of) for name, of in zip(UNCERTAINTIES, self.variances[p], strict=True))
                self.variances[p] = tuple(of if isinstance(of, int | float) else np.nan for of in stated)


@dataclass(frozen=True)
class _ListTimes:
    """When F lists were captured and arrive, in ns, and which of it they state."""

    stamps_ns: Int  # (F, 2)
    capture_said: Bool
    stamped: Bool
    logged_ns: Int


def _settle_times(rows: _EntryRows, findings: list[str]) -> _ListTimes:
    """Captures and arrivals of the lists; those that are not set are replaced by the time of logging."""
    logged_ns, ahead_ns = np.array(rows.logged, dtype=np.int64), np.array(rows.ahead, dtype=np.int64)
    findings += find("stamp impossible", rows.impossible)
    settled = list[tuple[Int, Bool]]()
    for stated in (rows.arrives, rows.captured):
        said = np.array([stamp is not None for stamp in stated], dtype=bool)
        moved_ns = np.array([log if stamp is None else stamp for stamp, log in zip(stated, rows.logged, strict=True)])
        moved_ns = moved_ns.astype(np.int64) - np.where(said, ahead_ns, 0)
        stamp_ns, known, _, found = settle_stamps(moved_ns, said, logged_ns, ahead_ns=ahead_ns, noted=rows.impossible)
        findings += [] if settled else found  # a capture that is not set is that of the stamp
        settled.append((stamp_ns, known))
    (arrives_ns, stamped), (captured_ns, capture_said) = settled
    captured_ns = np.where(capture_said, captured_ns, arrives_ns)
    return _ListTimes(np.stack([captured_ns, arrives_ns], axis=1), capture_said, stamped, logged_ns)


def read_sensor_data(path: Local, topic: str, scene: Scene) -> Tracks:
    """The lists on `topic`; each track has the index of its object in `scene`, −1 where the list names none of it.

    Raises RecordingError when there is no such topic of osi3.SensorData, or a message of it cannot be decoded.
    """
    return _make_tracks(_read_rows(path, topic), topic, scene)


@dataclass(frozen=True)
class RecordedLists:
    """Lists as a unit made them. Every row of `tracks` is a track of its own, without truth id: (P,) each.

    `existence` is NaN where the list does not state it; `class_probability (P, C)` sums to 1. `spread_said`: whether
    the list states the covariance of the position, else it is 0. `capture_said (F,)`: whether the list states its
    capture, `stamped (F,)`: whether it has a time stamp, `logged_ns (F,)`: the log time of its message.
    `velocity_said`: whether any entry states its velocity, else it is 0.
    """

    tracks: Tracks
    existence: Float
    class_probability: Float
    track_id: Int
    spread_said: Bool
    capture_said: Bool
    stamped: Bool
    logged_ns: Int
    velocity_said: bool
    notes: tuple[str, ...]  # entries that were left out or completed


@np.errstate(over="ignore", invalid="ignore")
def read_recorded(path: Local, topic: str, scene: Scene, window: Window | None = None) -> RecordedLists:
    """The lists of osi3.SensorData on `topic` with all that they state, except ids of the truth.

    Raises RecordingError: no such topic of osi3.SensorData, or a message of it cannot be decoded.
    """
    rows = _read_rows(path, topic, window)
    findings: list[str] = [*find("undecoded", rows.undecoded)]
    findings += [line for rule, number in sorted(rows.rules.items()) for line in find(rule, number)]
    times = _settle_times(rows, findings)
    probability = np.zeros((len(rows.frame), len(CLASSES)))
    for p, likely in enumerate(rows.likely):
        for index, share in likely.items():
            probability[p, index] += share
    probability[probability.sum(axis=1) <= 0, osi.OTHER] = 1.0
    entries = _Entries(
        np.array(rows.frame, dtype=np.int64),
        np.array(rows.values, dtype=float).reshape(-1, len(VALUES)),
        np.array(rows.variances, dtype=float).reshape(-1, len(UNCERTAINTIES)),
        np.array(rows.existence, dtype=float),
        probability / probability.sum(axis=1, keepdims=True),
        np.array(rows.track, dtype=np.int64),
    )
    return _make_recorded(entries, times, open_log(path).path, topic, scene, findings)


@dataclass(frozen=True)
class _Entries:
    """Entries (P,) of lists, in the order of the messages, with what is not stated, or none, as NaN."""

    frame: Int  # the list of each
    values: Float
    variances: Float  # (P, uncertainties)
    existence: Float
    probability: Float  # (P, C)
    track: Int


def _make_recorded(
    entries: _Entries, times: _ListTimes, path: Path, topic: str, scene: Scene, findings: list[str]
) -> RecordedLists:
    """The lists as tracks; `findings` get what is left out or completed. Raises RecordingError: a second run."""

    def list_contents() -> list[bytes]:
        ends = np.searchsorted(entries.frame, np.arange(1, len(times.logged_ns)))
        return [rows.tobytes() for rows in np.split(entries.values, ends)]

    refuse_second_run(times.stamps_ns[:, 1], times.logged_ns, list_contents, path, topic)
    by_time, frame = order_by_time(times.stamps_ns[:, 1], entries.frame)
    values, usable = sift_states(entries.values, np.ones(len(frame), dtype=bool), findings)
    order = np.flatnonzero(usable)[np.argsort(frame[usable], kind="stable")]
    values = complete_sizes(values[order], entries.probability[order].argmax(axis=1), None, findings)
    variances = entries.variances[order]
    variances[:, :3], spread_said = sift_covariances(variances[:, :3], findings)
    return RecordedLists(
        build_unit_tracks(
            topic, scene, times.stamps_ns[by_time], np.arange(len(order) + 1), np.full(len(order), -1), frame[order],
            complete_entries(values, findings), variances,
        ),
        sift_shares(entries.existence[order], "existence", findings),
        entries.probability[order],
        entries.track[order],
        spread_said,
        times.capture_said[by_time],
        times.stamped[by_time],
        times.logged_ns[by_time],
        bool(np.isfinite(values[:, VX : VY + 1]).any()),
        tuple(findings),
    )  # fmt: skip


def _read_rows(path: Local, topic: str, window: Window | None = None) -> _EntryRows:
    """Entries on `topic`, with the variances that a topic `…/detail` beside it states."""
    return open_log(path).within(window).attempt(lambda log: _read_messages(log, topic))


def _no_lists_message(log: Log, topic: str) -> str:
    """The error for a topic that holds no lists of a unit: what it holds, and which topics hold lists."""
    list_topics = {c.topic for c in log.channels if c.schema == SENSOR_DATA} | {
        c.topic for c in known_lists(log.channels)
    }
    schemas = sorted({c.schema or "no schema" for c in log.channels if c.topic == topic})
    content = f"topic {topic!r} holds {', '.join(schemas)}" if schemas else f"no topic {topic!r}"
    if not list_topics:
        return f"{content}; no topic of this log holds lists of a unit"
    return f"{content}; lists of units are on {', '.join(sorted(list_topics))}"


def _read_messages(log: Log, topic: str) -> _EntryRows:
    """The entries on a topic of osi3.SensorData, from an opened log. Raises RecordingError, BrokenIndexError."""
    list_channels = {c.number: c for c in log.channels if c.topic == topic and c.schema == SENSOR_DATA}
    if not list_channels:
        raise RecordingError(_no_lists_message(log, topic), path=log.path)
    detail_topic = f"{topic.removesuffix('/objects')}/detail"
    detail_channels = {c.number for c in log.channels if c.topic == detail_topic and c.schema == DETAIL_SCHEMA}
    rows, allowance = _EntryRows(), DecodeAllowance(log.file_bytes())
    details: dict[int, list[Any]] = {}
    for number, log_time_ns, payload in log.payloads(frozenset({*list_channels, *detail_channels})):
        if number in detail_channels:
            with suppress(ValueError, TypeError, KeyError):  # else not written by `copem-replay`
                content = parse_json(payload)
                details[content["available_ns"]] = [*content["objects"]]
        else:
            try:
                message_class = load_message_class(SENSOR_DATA)
                check_osi(message_class, payload)
                message = message_class.FromString(payload)
                check_objects(len(message.moving_object))
                allowance.spend(0, len(message.moving_object))
            except OversizeError as error:
                raise RecordingError(str(error), path=log.path, topic=topic) from None
            except DecodeError:
                rows.undecoded += 1
                continue
            _add_message(rows, message, log_time_ns, list_channels[number].ahead_ns)
    if rows.undecoded and not rows.logged:
        raise RecordingError(f"none of its {rows.undecoded} messages can be decoded", path=log.path, topic=topic)
    rows.add_details(details)
    return rows


def _add_message(rows: _EntryRows, message: Any, log_time_ns: int, ahead_ns: int) -> None:
    """Append one osi3.SensorData and its entries to `rows`; `ahead_ns`: how far its clock is ahead."""
    frame = len(rows.logged)
    rows.logged.append(min(log_time_ns, LAST_NS))
    rows.ahead.append(ahead_ns)
    rows.still.append({of.value for item in message.stationary_object for of in item.header.ground_truth_id})
    for name, times in (("timestamp", rows.arrives), ("last_measurement_time", rows.captured)):
        times.append(osi.osi_stamp_ns(getattr(message, name)) if message.HasField(name) else None)
        rows.impossible += message.HasField(name) and times[-1] is None
    for item in [*message.moving_object, *message.stationary_object]:
        base, base_rmse = item.base, item.base_rmse
        position, size, speed = base.position, base.dimension, getattr(base, "velocity", None)
        rows.frame.append(frame)
        truth_ids = item.header.ground_truth_id
        rows.ident.append(truth_ids[0].value if truth_ids else -1)
        tracked = item.header.HasField("tracking_id")
        rows.track.append(item.header.tracking_id.value & _LARGEST_ID if tracked else -1)
        pose = (position.x, position.y, position.z, base.orientation.yaw)
        state, rules = osi.check_zeros(base, pose if speed is None else (*pose, speed.x, speed.y))
        rows.rules.update(rules)
        x, y, z, yaw, vx, vy = _transform_entry(message, *state, *((0.0, 0.0) if speed is None else ()))
        rows.values.append((x, y, z, yaw, vx, vy, size.length, size.width, size.height))
        stated = [(base_rmse.orientation, "yaw"), (base_rmse.dimension, "length")]
        stated += [(base_rmse.velocity, "x")] if speed is not None else []
        deviations = [getattr(of, name) if of.HasField(name) else np.nan for of, name in stated]
        deviations += [0.0] if speed is None else []
        has_spread = base_rmse.position.HasField("x") and base_rmse.position.HasField("y")
        along, across = (each * each if has_spread else 0.0 for each in (base_rmse.position.x, base_rmse.position.y))
        yaw_rad = _frame_yaw(message)
        cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
        rows.variances.append(
            (
                float(cos * cos * along + sin * sin * across),
                float(cos * sin * (along - across)),
                float(sin * sin * along + cos * cos * across),
                *(s * s for s in deviations),
            )
        )
        header = item.header
        has_existence = header.HasField("existence_probability")
        rows.existence.append(header.existence_probability if has_existence else np.nan)
        rows.likely.append(_class_probabilities(item, rows))


def _class_probabilities(item: Any, rows: _EntryRows) -> dict[int, float]:
    """By index of class the probability that the unit states for a moving object; empty: a stationary one."""
    probability: dict[int, float] = {}
    for candidate in getattr(item, "candidate", ()):
        if not hasattr(candidate, "vehicle_classification"):  # a stationary object's
            continue
        vehicle = candidate.vehicle_classification if candidate.HasField("vehicle_classification") else None
        class_ix = osi.osi_class_index(candidate.type, None if vehicle is None else vehicle.type)
        messages = [candidate, *([vehicle] if class_ix == osi.VEHICLE and vehicle is not None else [])]
        rows.rules["class unsaid"] += not all(of.HasField("type") for of in messages)
        has_probability = candidate.HasField("probability")
        share = candidate.probability if has_probability else 1.0
        if not has_probability and any(other.HasField("probability") for other in item.candidate):
            rows.rules["class share"] += 1
        if not 0.0 <= share <= MOST_SHARE:
            rows.rules["class share"] += 1
            share = 0.0
        probability[class_ix] = probability.get(class_ix, 0.0) + share
    return probability


def _frame_yaw(message: Any) -> float:
    """Yaw in rad of the frame of the entries in the world."""
    if not message.HasField("host_vehicle_location"):
        return 0.0
    return float(message.mounting_position.orientation.yaw + message.host_vehicle_location.orientation.yaw)


def _transform_entry(
    message: Any, x: float, y: float, z: float, yaw: float, vx: float, vy: float
) -> tuple[float, float, float, float, float, float]:
    """A state in the world, from the virtual sensor's frame; unchanged without a host location."""
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
    return float(x), float(y), float(z), float(wrap_angles(np.array(yaw))), float(vx), float(vy)


def _make_tracks(rows: _EntryRows, topic: str, scene: Scene) -> Tracks:
    """The entries as tracks, one for each true object of `scene` and track id."""
    stamps = _settle_times(rows, []).stamps_ns
    by_time, frame = order_by_time(stamps[:, 1], np.array(rows.frame, dtype=np.int64))
    object_by_id = {osi_id(name): k for k, name in enumerate(scene.object_ids)}
    object_ix = np.array([object_by_id.get(i, -1) for i in rows.ident], dtype=np.int64)
    track = np.array(rows.track, dtype=np.int64)
    order = np.lexsort((frame, track, object_ix))
    new = np.ones(len(order), dtype=bool)
    new[1:] = (np.diff(object_ix[order]) != 0) | (np.diff(track[order]) != 0)
    first = np.flatnonzero(new)
    values = np.array(rows.values, dtype=float).reshape(-1, len(VALUES))[order]
    variances = np.array(rows.variances, dtype=float).reshape(-1, len(UNCERTAINTIES))[order]
    start = np.append(first, len(order))
    return build_unit_tracks(
        topic, scene, stamps[by_time], start, object_ix[order][first], frame[order], values, variances
    )


def order_by_time(stamps_ns: Int, frame: Int) -> tuple[Int, Int]:
    """(F,) order of the lists by time, and (P,) the place in that order of the list `frame` of each row."""
    by_time = np.argsort(stamps_ns, kind="stable")
    place = np.empty_like(by_time)
    place[by_time] = np.arange(len(by_time))
    return by_time, place[frame]


def build_unit_tracks(
    topic: str, scene: Scene, stamps: Int, start: Int, object_ix: Int, frame_ix: Int, values: Float, variances: Float
) -> Tracks:
    """Tracks of one unit: `stamps (F, 2)` of capture and arrival, `start (E + 1,)`, `object_ix (E,)`, rows (P,)."""
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


def read_unit_lists(
    path: Local, topic: str, scene: Scene, around: LogContext | None, window: Window | None = None
) -> RecordedLists:
    """The lists on `topic` in whatever format is read, with what their messages state. Raises RecordingError."""
    return read_described_lists(path, topic, scene, around, window) or read_recorded(path, topic, scene, window)


@np.errstate(over="ignore", invalid="ignore")
def read_described_lists(
    path: Local, topic: str, scene: Scene, context: LogContext | None, window: Window | None = None
) -> RecordedLists | None:
    """The lists on `topic` of a format other than OSI's, in the world of the truth; None: the topic has none.

    Raises RecordingError.
    """
    return open_log(path).within(window).attempt(lambda log: _read_described(log, topic, scene, context))


def _read_described(log: Log, topic: str, scene: Scene, context: LogContext | None) -> RecordedLists | None:
    """The lists on a topic of any schema but OSI's; None: no such topic. Raises RecordingError."""
    channels = [c for c in known_lists(log.channels) if c.topic == topic]
    if not channels:
        return None
    same_schema = [c for c in channels if c.schema == channels[0].schema]
    if log.window is not None and next(log.payloads(frozenset(c.number for c in same_schema)), None) is None:
        raise RecordingError("holds no list in the window", path=log.path, topic=topic)
    context = context or read_log_context(log, None, seek_ego=False)
    lists = read_decoded_lists(log, same_schema, None, context.classes)
    if lists.station is not None:
        lists = place_on_earth(lists, lists.station, scene.frame, log.path, topic)
        lists, captures = settle_measurements(lists, scene.t0_ns, log.path, topic)
        return _make_recorded_lists(lists, captures, {}, log.path, topic, scene)
    lists, details = transform_to_world(lists, context, log.path, topic), _read_details(log, topic)
    captures = _find_captures(lists.columns.stamp_ns, details)
    return _make_recorded_lists(lists, captures, details, log.path, topic, scene)


def _read_details(log: Log, topic: str) -> dict[int, dict[str, Any]]:
    """By time available (ns) the content of `…/detail` beside a topic, as this package writes it."""
    beside = f"{topic.removesuffix('/objects')}/detail"
    channels = [c for c in log.channels if c.topic == beside and c.messages and schema_name(c) == STRING]
    details: dict[int, dict[str, Any]] = {}
    for channel in channels:
        payloads = gather_messages(log, frozenset({channel.number})).payloads[channel.number]
        try:
            columns = shred_messages(make_definition(channel, payloads), payloads, texts=["data"])
        except (DefinitionError, KeyError):  # some other String
            continue
        for word in columns.levels[""].texts["data"].words:
            try:
                content = parse_json(word)
                details[int(content["available_ns"])] = {**content, "objects": list(content["objects"])}
            except (ValueError, TypeError, KeyError):  # not written by `copem-replay`
                continue
    return details


def _find_captures(stamps: Int, details: Details) -> tuple[Int, Bool]:
    """(F,) captures of the lists available at `stamps`, and whether `details` state them; else the stamp itself."""
    captured, is_stated = stamps.copy(), np.zeros(len(stamps), dtype=bool)
    for k, stamp in enumerate(stamps.tolist()):
        captured_ns = details.get(stamp, {}).get("captured_ns")
        if isinstance(captured_ns, int) and abs(captured_ns) <= LAST_NS:
            captured[k], is_stated[k] = captured_ns, True
    return captured, is_stated


def _add_details(lists: DecodedLists, details: Details) -> tuple[DecodedLists, Float]:
    """The lists with sizes and existence of `details`, and (P, uncertainties) variances; NaN: not stated."""
    columns = lists.columns
    values, existence = columns.values.copy(), lists.existence.copy()
    variances = np.full((len(values), len(UNCERTAINTIES)), np.nan)
    ends = np.cumsum(columns.rows)
    for stamp, number, end in zip(columns.stamp_ns.tolist(), columns.rows.tolist(), ends.tolist(), strict=True):
        items = details.get(stamp, {}).get("objects", ())
        if len(items) != number:  # objects without a place are left out
            continue
        for row, item in zip(range(end - number, end), items, strict=True):
            for name in ("length_m", "width_m"):
                values[row, VALUES.index(name)] = _get_number(item, name, values[row, VALUES.index(name)])
            existence[row] = _get_number(item, "existence", existence[row])
            variances[row] = [_get_number(item, name, np.nan) for name in UNCERTAINTIES]
    return replace(lists, columns=replace(columns, values=values), existence=existence), variances


def _get_number(item: Any, name: str, otherwise: float) -> float:
    value = item.get(name) if isinstance(item, dict) else None
    return float(value) if isinstance(value, float) else otherwise


def _make_recorded_lists(
    lists: DecodedLists, captures: tuple[Int, Bool], details: Details, path: Path, topic: str, scene: Scene
) -> RecordedLists:
    """The lists as tracks; `captures`: time of each list (ns), and whether it is stated."""
    captured, capture_said = captures
    lists, variances = _add_details(lists, details)
    columns, findings = lists.columns, list[str]()
    has_covariance = ~np.isnan(lists.covariance_m2).all(axis=1)
    variances[:, :3] = np.where(np.asarray(has_covariance)[:, None], lists.covariance_m2, 0.0)  # turned with its list
    entries = _Entries(
        np.repeat(np.arange(len(columns.rows)), columns.rows),
        columns.values,
        variances,
        lists.existence,
        lists.probability,
        columns.object_ix if lists.named else np.full(len(columns.object_ix), -1),
    )
    times = _ListTimes(
        np.stack([captured, columns.stamp_ns], axis=1), capture_said, columns.stamped, columns.log_time_ns
    )
    recorded = _make_recorded(entries, times, path, topic, scene, findings)
    return replace(recorded, notes=(*(n for n in columns.notes if isinstance(n, Finding)), *recorded.notes))

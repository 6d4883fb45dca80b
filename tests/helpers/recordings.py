"""Tiny recordings for tests, written message by message, with everything real ones get wrong.

`write_recording` writes one topic of truth; `write_mcap` any topics, from `Topic`s (`truth_topic` makes one).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer
from osi3.osi_groundtruth_pb2 import GroundTruth
from osi3.osi_sensorview_pb2 import SensorView

SHARED = Path(__file__).parents[2].parent / "shared" / "data"
"""Recordings of third parties: not part of the project, absent from most machines."""

VEHICLE, PEDESTRIAN, ANIMAL = 2, 3, 4  # osi3.MovingObject.Type
CAR = 4  # osi3.MovingObject.VehicleClassification.Type


@dataclass(frozen=True)
class Obj:
    """One object in one message. A value of None is a field that is not set."""

    id: int | None = 1
    x: float | None = 0.0  # None: no position at all
    y: float = 0.0
    z: float = 0.75
    yaw: float | None = 0.0  # None: no orientation at all
    vx: float | None = 0.0  # None: no velocity at all
    vy: float = 0.0
    length: float = 4.0
    width: float = 2.0
    height: float | None = 1.5
    type: int = VEHICLE
    vehicle: int | None = CAR  # None: no classification
    stationary: bool = False
    polygon: Sequence[tuple[float, float]] = ()  # corners of the base polygon


def pedestrian(id: int, x: float, y: float = 0.0, **more: Any) -> Obj:
    """A pedestrian 1.8 m high, standing on z = 0."""
    known = {"z": 0.9, "length": 0.5, "width": 0.6, "height": 1.8, "type": PEDESTRIAN, "vehicle": None}
    return Obj(id=id, x=x, y=y, **(known | more))


def ns(t_s: float) -> int:
    return round(t_s * 1e9)


def ground_truth(t_s: float | None, objects: Sequence[Obj] = (), host: int | None = None) -> GroundTruth:
    """A message; `t_s` None: without timestamp."""
    truth = GroundTruth()
    if t_s is not None:
        truth.timestamp.seconds, truth.timestamp.nanos = divmod(ns(t_s), 10**9)
    if host is not None:
        truth.host_vehicle_id.SetInParent()
        if host:  # 0 as some writers have it: a submessage with nothing in it
            truth.host_vehicle_id.value = host
    for obj in objects:
        _fill(truth.stationary_object.add() if obj.stationary else truth.moving_object.add(), obj)
    return truth


def sensor_view(t_s: float | None, truth: GroundTruth | None, host: int | None = None) -> SensorView:
    view = SensorView()
    if t_s is not None:
        view.timestamp.seconds, view.timestamp.nanos = divmod(ns(t_s), 10**9)
    if host is not None:
        view.host_vehicle_id.value = host
    if truth is not None:
        view.global_ground_truth.CopyFrom(truth)
    return view


def _fill(message: Any, obj: Obj) -> None:
    if obj.id is not None:
        message.id.value = obj.id
    base = message.base
    if obj.x is not None:
        base.position.x, base.position.y, base.position.z = obj.x, obj.y, obj.z
    base.dimension.length, base.dimension.width = obj.length, obj.width
    if obj.height is not None:
        base.dimension.height = obj.height
    for x, y in obj.polygon:
        base.base_polygon.add(x=x, y=y)
    if obj.yaw is not None:
        base.orientation.yaw = obj.yaw
    if obj.stationary:
        return
    if obj.vx is not None:
        base.velocity.x, base.velocity.y = obj.vx, obj.vy
    message.type = obj.type
    if obj.vehicle is not None:
        message.vehicle_classification.type = obj.vehicle


@dataclass(frozen=True)
class Topic:
    """A channel and its messages: (log time in ns, payload)."""

    name: str
    schema: str
    messages: Sequence[tuple[int, bytes]] = ()
    encoding: str = "protobuf"
    metadata: dict[str, str] = field(default_factory=dict)
    definition: tuple[str, bytes] | None = None  # encoding and text of the schema


def write_mcap(
    path: Path,
    topics: Sequence[Topic],
    *,
    by_time: bool = True,
    finish: bool = True,
    profile: str = "",
    compression: CompressionType = CompressionType.ZSTD,
    **writer: Any,
) -> Path:
    """Write an MCAP file; `by_time` False: topic after topic. `writer`: further options of mcap's Writer."""
    with path.open("wb") as file:
        out = Writer(file, compression=compression, **writer)
        out.start(profile=profile, library="tests")
        numbered = []
        for order, topic in enumerate(topics):
            encoding, text = topic.definition or (topic.encoding, b"")
            schema = out.register_schema(topic.schema, encoding, text) if topic.schema else 0
            channel = out.register_channel(topic.name, topic.encoding, schema, topic.metadata)
            numbered += [(log_ns, order, channel, data) for log_ns, data in topic.messages]
        if by_time:
            numbered.sort(key=lambda message: message[:2])
        for log_ns, _, channel, data in numbered:
            out.add_message(channel, log_time=log_ns, publish_time=log_ns, data=data)
        if finish:  # else as a recorder leaves it that is killed
            out.finish()
    return path


def truth_topic(
    frames: Sequence[tuple[float | None, Sequence[Obj]]],
    *,
    name: str = "truth",
    schema: str = "osi3.GroundTruth",
    host: int | None = None,
    view_host: int | None = None,
    log_s: Sequence[float] | None = None,
) -> Topic:
    """A topic of truth, from `(time, objects)` per message; `log_s`: log times where they are not the stamps.

    `host` is the ground truth's, `view_host` the sensor view's around it.
    """
    messages = []
    for k, (t_s, objects) in enumerate(frames):
        truth = ground_truth(t_s, objects, host)
        message = sensor_view(t_s, truth, view_host) if schema == "osi3.SensorView" else truth
        logged_s = log_s[k] if log_s is not None else t_s
        assert logged_s is not None, "a message without timestamp needs its log_s"
        messages.append((ns(logged_s), message.SerializeToString(deterministic=True)))
    return Topic(name, schema, messages)


def write_recording(
    path: Path,
    frames: Sequence[tuple[float | None, Sequence[Obj]]],
    *,
    topic: str = "truth",
    schema: str = "osi3.GroundTruth",
    host: int | None = None,
    view_host: int | None = None,
    log_s: Sequence[float] | None = None,
    more: Sequence[Topic] = (),
    **container: Any,
) -> Path:
    """Write a recording with one topic of truth, and `more` topics after it."""
    truth = truth_topic(frames, name=topic, schema=schema, host=host, view_host=view_host, log_s=log_s)
    return write_mcap(path, [truth, *more], **container)

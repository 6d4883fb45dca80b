"""The families of messages in which a replay is written: OSI's and ROS 2's, by the messages of its recording.

OSI: osi3.SensorData, foxglove.SceneUpdate (protobuf), and JSON, for all recordings but those of ROS 2. ROS 2: CDR only,
since a file of the profile `ros2` holds nothing else.
"""

from __future__ import annotations

import json
import struct
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from importlib import import_module
from importlib.metadata import version
from typing import Any, Protocol

import numpy as np

from copem_replay.core.colours import Rgb
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import TRUTH, Int, Scene
from copem_replay.io.encodings.cdr_bytes import HEAD, encode_cdr
from copem_replay.io.encodings.column_bytes import (
    Instants,
    RepeatedMessages,
    encode_messages,
)
from copem_replay.io.encodings.ros2_types import message_definition
from copem_replay.io.recording import Recording
from copem_replay.io.schemas.osi_ground_truth import SENSOR_DATA, load_message_class
from copem_replay.io.schemas.registry import DETAIL_SCHEMA, STRING
from copem_replay.io.write.detail import (
    DETAIL_JSON,
    STATUS_JSON,
    STATUS_SCHEMA,
    DetailWriter,
    Event,
    ReadyLists,
    Statuses,
    StatusWriter,
    UnitDetailWriter,
    encode_statuses,
)
from copem_replay.io.write.osi import OSI_VERSION, SensorDataWriter
from copem_replay.io.write.ros2 import DETECTED_OBJECTS, TRACKED_OBJECTS, ObjectsWriter
from copem_replay.io.write.scene import FRAME_ID, BoxWriter, Draw, Encode, UncertaintyWriter, draw_scenes
from copem_replay.io.write.source import OSI_CHANNEL, Catalogue

_NAMELESS = "map"  # name of the world frame where none is given, after REP 105

_FOREVER = "\n    sec: 9223372036\n    nsec: 854775807"
QOS = (
    f"- history: 1\n  depth: 10\n  reliability: 1\n  durability: 2\n  deadline:{_FOREVER}\n  lifespan:{_FOREVER}\n"
    f"  liveliness: 1\n  liveliness_lease_duration:{_FOREVER}\n  avoid_ros_namespace_conventions: false"
)
"""`offered_qos_profiles` as rosbag2 writes them: keep last 10, reliable, volatile; no deadline."""


class ListWriter(Protocol):
    """Turns the fused lists of one configuration into messages of one channel."""

    def messages(self, available_ns: Int) -> Iterator[bytes]:
        """The lists as they became available at these instants of the log's clock, (F,)."""


@dataclass(frozen=True)
class TruthWriter:
    """The channels of the truth, and how its scenes and the frame to follow become messages of the family."""

    scene: int
    static: int
    transform: int
    draw: Draw
    encode_transforms: Encode
    frame_id: str


Family = Callable[[Catalogue, Scene, Mapping[str, int]], "OpenedFamily"]
"""Puts a family's schemas into a file. The last argument: the number of each unit."""


def find_family(recording: Recording) -> Family:
    """The family of a recording, by the encoding of its truth."""
    if recording.encoding == "cdr":
        return partial(_Ros2Family, frame_id=recording.world or _NAMELESS)
    return partial(_OsiFamily, frame_id=recording.world or FRAME_ID)


def list_topics(configuration: str) -> list[str]:
    """The topics of a configuration's lists, in any family: objects, scene, detail."""
    return [f"copem/{configuration}/{kind}" for kind in ("objects", "scene", "detail")]


def list_extra_topics(configuration: str) -> list[str]:
    """The topics of a configuration for viewers: status, uncertainty."""
    return [f"copem/{configuration}/{kind}" for kind in ("status", "uncertainty")]


def list_unit_topics(unit: str) -> list[str]:
    """The topics of a unit's lists: objects, detail."""
    return [f"copem/units/{unit}/{kind}" for kind in ("objects", "detail")]


RUN_RECORD = "org.copem_replay.run"
"""The metadata record of this project: what made the file."""
TRUTH_TOPICS = [f"copem/{TRUTH}/{kind}" for kind in ("scene", "static", "transform")]
"""Topics of the truth's scene: moving objects, static ones, the ego's pose."""
EGO_FRAME, MIDDLE_FRAME = "copem_ego", "copem_middle"
"""Frames of reference to follow: one moves with the ego, the other, without an ego, stands in the middle of objects."""


class OpenedFamily(ABC):
    """A family whose schemas are in the file that is being written; `frame_id`: the frame of reference of scenes."""

    osi: bool
    """Whether osi3 messages are written."""

    def __init__(self, catalogue: Catalogue, scene: Scene, units: Mapping[str, int], frame_id: str = FRAME_ID) -> None:
        self._catalogue, self._scene, self._units, self._frame_id = catalogue, scene, units, frame_id
        self._draw: Draw = partial(draw_scenes, self._encoder("scene"), frame_id)
        for kind in ("objects", "scene", "detail"):
            self._schema(kind)

    @abstractmethod
    def _schema(self, kind: str, described: str = "") -> tuple[str, int, dict[str, str]]:
        """What a channel of a kind of message has: encoding, number of the schema, which is written, metadata."""

    @abstractmethod
    def _encoder(self, kind: str) -> Encode:
        """Makes messages of a kind, `scene` or `transform`."""

    @abstractmethod
    def _objects(self, fused_tracks: FusedTracks, events: Mapping[int, Sequence[Event]]) -> list[ListWriter]:
        """The writers of the lists, and of their details."""

    @abstractmethod
    def _unit_lists(self, unit: ReadyLists) -> list[ListWriter]:
        """The writers of a unit's lists, and of their details."""

    @staticmethod
    @abstractmethod
    def encode_statuses(available_ns: Int, objects: RepeatedMessages) -> list[bytes]:
        """Messages of the statuses at each instant."""

    def _channel(self, topic: str, kind: str, described: str = "") -> int:
        """The number of a channel."""
        return self._catalogue.channel(topic, *self._schema(kind, described))

    def channels(
        self, name: str, fused_tracks: FusedTracks, events: Mapping[int, Sequence[Event]], colour: Rgb
    ) -> dict[int, ListWriter]:
        """The channels of a configuration: `objects`, `scene`, `detail`, in this order."""
        objects, details = self._objects(fused_tracks, events)
        writers = objects, BoxWriter(self._scene, fused_tracks, name, colour, self._draw), details
        kinds = zip(list_topics(name), ("objects", "scene", "detail"), strict=True)
        described = f"fused object list of configuration {name}"
        return dict(zip((self._channel(topic, kind, described) for topic, kind in kinds), writers, strict=True))

    def unit_channels(self, unit: ReadyLists) -> dict[int, ListWriter]:
        """The channels of a unit's lists: `objects`, `detail`."""
        kinds = zip(list_unit_topics(unit.name), ("tracks" if unit.has_ids else "objects", "detail"), strict=True)
        described = f"object list of unit {unit.name}"
        numbers = (self._channel(topic, kind, described) for topic, kind in kinds)
        return dict(zip(numbers, self._unit_lists(unit), strict=True))

    def seen_besides(
        self, name: str, fused_tracks: FusedTracks, statuses: Statuses, colour: Rgb
    ) -> dict[int, ListWriter]:
        """The channels of a configuration for viewers: `status`, `uncertainty`."""
        status, uncertainty = list_extra_topics(name)
        ellipses = UncertaintyWriter(self._scene, fused_tracks, colour, self._draw)
        return {
            self._channel(status, "status"): StatusWriter(statuses, self.encode_statuses),
            self._channel(uncertainty, "scene"): ellipses,
        }

    def truth(self) -> TruthWriter:
        """The writer of the truth as a scene of its own."""
        self._schema("transform")
        kinds = zip(TRUTH_TOPICS, ("scene", "scene", "transform"), strict=True)
        scene, static, transform = (self._channel(topic, kind) for topic, kind in kinds)
        return TruthWriter(scene, static, transform, self._draw, self._encoder("transform"), self._frame_id)


class _OsiFamily(OpenedFamily):
    """osi3.SensorData; foxglove.SceneUpdate; details and statuses as JSON."""

    osi = True
    encode_statuses = staticmethod(encode_statuses)

    def _schema(self, kind: str, described: str = "") -> tuple[str, int, dict[str, str]]:
        if kind in ("detail", "status"):
            name, content = (DETAIL_SCHEMA, DETAIL_JSON) if kind == "detail" else (STATUS_SCHEMA, STATUS_JSON)
            return "json", self._catalogue.schema(name, "jsonschema", json.dumps(content).encode()), {}
        schema = _load_class(kind).DESCRIPTOR.full_name, "protobuf", _describe_class(_load_class(kind))
        metadata = {
            f"{OSI_CHANNEL}description": described,
            f"{OSI_CHANNEL}osi_version": OSI_VERSION,
            f"{OSI_CHANNEL}protobuf_version": version("protobuf"),
        }
        return "protobuf", self._catalogue.schema(*schema), metadata if kind in _OSI_LISTS else {}

    def _encoder(self, kind: str) -> Encode:
        return partial(encode_messages, _load_class(kind).DESCRIPTOR)

    def _objects(self, fused_tracks: FusedTracks, events: Mapping[int, Sequence[Event]]) -> list[ListWriter]:
        scene = self._scene
        return [SensorDataWriter(scene, fused_tracks, self._units), DetailWriter(scene, fused_tracks, events)]

    def _unit_lists(self, unit: ReadyLists) -> list[ListWriter]:
        areas, crossed = unit.draw_areas if unit.fields else None, unit.lists.fused.cov_en_m2
        beside = {} if crossed is None else {"cov_en_m2": crossed[0]}
        objects = SensorDataWriter(self._scene, unit.lists, self._units, areas)
        return [objects, UnitDetailWriter(self._scene, unit, beside)]


_OSI_LISTS = ("objects", "tracks")
OSI: Family = _OsiFamily
"""The family of all recordings but those of ROS 2."""


def _load_class(kind: str) -> Any:
    """The class of `objects`, `tracks`, `scene` or `transform` in protobuf, imported when first needed."""
    if kind in _OSI_LISTS:
        return load_message_class(SENSOR_DATA)
    name = "SceneUpdate" if kind == "scene" else "FrameTransform"
    return getattr(import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)


@cache
def _describe_class(message_class: Any) -> bytes:
    from mcap_protobuf.schema import build_file_descriptor_set

    described: bytes = build_file_descriptor_set(message_class).SerializeToString(deterministic=True)
    return described


_ROS2_TYPES = {
    "objects": DETECTED_OBJECTS,
    "tracks": TRACKED_OBJECTS,
    "scene": "foxglove_msgs/msg/SceneUpdate",
    "detail": STRING,
    "status": "copem_replay_msgs/msg/Status",
    "transform": "foxglove_msgs/msg/FrameTransform",
}


class _Ros2Family(OpenedFamily):
    """DetectedObjects and TrackedObjects of Autoware; foxglove_msgs/SceneUpdate; JSON of details as std_msgs/String."""

    osi = False

    def _schema(self, kind: str, described: str = "") -> tuple[str, int, dict[str, str]]:
        schema = _ROS2_TYPES[kind], "ros2msg", message_definition(_ROS2_TYPES[kind])
        return "cdr", self._catalogue.schema(*schema), {"offered_qos_profiles": QOS}

    def _encoder(self, kind: str) -> Encode:
        return partial(encode_cdr, _ROS2_TYPES[kind])

    def _objects(self, fused_tracks: FusedTracks, events: Mapping[int, Sequence[Event]]) -> list[ListWriter]:
        objects = ObjectsWriter(self._scene, fused_tracks, self._frame_id)
        return [objects, _StringWriter(DetailWriter(self._scene, fused_tracks, events, sizes_of=objects.round))]

    def _unit_lists(self, unit: ReadyLists) -> list[ListWriter]:
        objects, fused = ObjectsWriter(self._scene, unit.lists, self._frame_id, tracked=unit.has_ids), unit.lists.fused
        assert unit.lists.said is not None
        beside = {n: np.where(objects.round, getattr(fused, n)[0], 0.0) for n in ("length_m", "width_m")}
        beside["existence"] = unit.lists.said["existence"]  # of single precision in the messages
        return [objects, _StringWriter(UnitDetailWriter(self._scene, unit, beside))]

    @staticmethod
    def encode_statuses(available_ns: Int, objects: RepeatedMessages) -> list[bytes]:
        """Messages of copem_replay_msgs/Status."""
        return encode_cdr(
            _ROS2_TYPES["status"], {"stamp": Instants(available_ns), "objects": objects}, len(available_ns)
        )


class _StringWriter:
    """Messages of JSON as std_msgs/String."""

    def __init__(self, writer: ListWriter) -> None:
        self._writer = writer

    def messages(self, available_ns: Int) -> Iterator[bytes]:
        messages = self._writer.messages(available_ns)
        return (HEAD + struct.pack("<I", len(data) + 1) + data + b"\0" for data in messages)

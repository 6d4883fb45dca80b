"""In what messages a replay is written: those of the family its recording is of.

OSI: osi3.SensorData, foxglove.SceneUpdate (protobuf), and JSON; for all recordings but those of ROS 2. ROS 2: CDR
only, for a file of the profile `ros2` holds nothing else.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from typing import Any, Protocol

from copem_replay.core.colours import Rgb
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import TRUTH, Int, Scene
from copem_replay.io.recording import Recording
from copem_replay.io.write import (
    autoware_objects as detected_objects,
)
from copem_replay.io.write import (
    cdr_writer as cdr_write,
)
from copem_replay.io.write import (
    detail_json as detail,
)
from copem_replay.io.write import (
    foxglove_scene as foxglove,
)
from copem_replay.io.write import (
    foxglove_scene_ros2 as foxglove_ros2,
)
from copem_replay.io.write import (
    osi_sensor_data as sensor_data,
)
from copem_replay.io.write.detail_json_writer import DetailWriter
from copem_replay.io.write.drawing import Entity, Pose
from copem_replay.io.write.osi_sensor_data_writer import SensorDataWriter
from copem_replay.io.write.pass_through import Catalogue
from copem_replay.io.write.ros2_definitions import STATUS, STRING, TRANSFORM, definition
from copem_replay.io.write.status import JSON_SCHEMA as STATUS_JSON
from copem_replay.io.write.status import SCHEMA as STATUS_SCHEMA
from copem_replay.io.write.status import STATUSES, Statuses, StatusWriter
from copem_replay.io.write.uncertainty import Ellipses, UncertaintyWriter

OSI_CHANNEL = "net.asam.osi.trace.channel."
_NAMELESS = "map"  # chosen: the name of the world frame where none is given, as REP 105 has it

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


class Opened(Protocol):
    """A family whose schemas are in the file that is being written."""

    osi: bool
    """Whether osi3 messages are written."""

    def channels(
        self, name: str, fused_tracks: FusedTracks, events: Mapping[int, Sequence[detail.Event]], colour: Rgb
    ) -> dict[int, ListWriter]:
        """The channels of a configuration: `objects`, `scene`, `detail`, in this order."""

    def seen_besides(
        self, name: str, fused_tracks: FusedTracks, statuses: Statuses, colour: Rgb
    ) -> dict[int, ListWriter]:
        """The channels of a configuration that are only for looking at: `status`, `uncertainty`."""

    def truth(self) -> TruthWriter:
        """What puts the truth into the file as a scene of its own."""


@dataclass(frozen=True)
class TruthWriter:
    """The channels of the truth, and how its scenes and the frame to follow become messages of the family."""

    scene: int
    static: int
    transform: int
    drawn: Callable[[Sequence[Entity], int], bytes]
    followed: Callable[[Pose, int, str], bytes]


Family = Callable[[Catalogue, Scene, Mapping[str, int]], Opened]
"""Puts the schemas into a file; the last: the numbers by which units go."""


def family_of(recording: Recording) -> Family:
    """The family a recording is of, by how the truth is encoded."""
    if recording.encoding == "cdr":
        return partial(_Ros2, frame_id=recording.world or _NAMELESS)
    return partial(_Osi, frame_id=recording.world or foxglove.FRAME_ID)


def topics_of(configuration: str) -> list[str]:
    """The topics of a configuration, whatever the family."""
    return [f"copem/{configuration}/{kind}" for kind in ("objects", "scene", "detail")]


def more_topics_of(configuration: str) -> list[str]:
    """Its topics that are only for looking at."""
    return [f"copem/{configuration}/{kind}" for kind in ("status", "uncertainty")]


TRUTH_TOPICS = [f"copem/{TRUTH}/{kind}" for kind in ("scene", "static", "transform")]
"""The truth as a scene of its own: what moves, what does not, where the ego is."""
EGO_FRAME, MIDDLE_FRAME = "copem_ego", "copem_middle"
"""Frames of reference to follow: one moves with the ego, the other, without an ego, stands amid all objects."""


def osi_version() -> str:
    """Of OSI, what is written."""
    return ".".join(map(str, sensor_data.OSI_VERSION))


class _Osi:
    """osi3.SensorData; foxglove.SceneUpdate in the frame of reference `frame_id`; details as JSON."""

    osi = True

    def __init__(
        self, catalogue: Catalogue, scene: Scene, units: Mapping[str, int], frame_id: str = foxglove.FRAME_ID
    ) -> None:
        self._catalogue, self._scene, self._units, self._frame_id = catalogue, scene, units, frame_id
        self._objects = _protobuf(catalogue, sensor_data.message_class(), sensor_data.SCHEMA)
        self._scenes = _protobuf(catalogue, foxglove.message_class(), foxglove.SCHEMA)
        self._details = catalogue.schema(detail.SCHEMA, "jsonschema", json.dumps(detail.JSON_SCHEMA).encode())

    def channels(
        self, name: str, fused_tracks: FusedTracks, events: Mapping[int, Sequence[detail.Event]], colour: Rgb
    ) -> dict[int, ListWriter]:
        description = {
            f"{OSI_CHANNEL}description": f"fused object list of configuration {name}",
            f"{OSI_CHANNEL}osi_version": osi_version(),
            f"{OSI_CHANNEL}protobuf_version": version("protobuf"),
        }
        objects, scenes, details = topics_of(name)
        channel, scene = self._catalogue.channel, self._scene
        return {
            channel(objects, "protobuf", self._objects, description): SensorDataWriter(
                scene, fused_tracks, self._units
            ),
            channel(scenes, "protobuf", self._scenes, {}): foxglove.SceneWriter(
                scene, fused_tracks, name, colour, self._frame_id
            ),
            channel(details, "json", self._details, {}): DetailWriter(scene, fused_tracks, events),
        }

    def seen_besides(
        self, name: str, fused_tracks: FusedTracks, statuses: Statuses, colour: Rgb
    ) -> dict[int, ListWriter]:
        catalogue, (status, uncertainty) = self._catalogue, more_topics_of(name)
        said = catalogue.schema(STATUS_SCHEMA, "jsonschema", json.dumps(STATUS_JSON).encode())
        return {
            catalogue.channel(status, "json", said, {}): StatusWriter(statuses),
            catalogue.channel(uncertainty, "protobuf", self._scenes, {}): UncertaintyWriter(
                self._scene, fused_tracks, colour, partial(foxglove.ellipses, frame_id=self._frame_id)
            ),
        }

    def truth(self) -> TruthWriter:
        moves = _protobuf(self._catalogue, foxglove.transform_class(), "foxglove.FrameTransform")
        schemas = zip(TRUTH_TOPICS, (self._scenes, self._scenes, moves), strict=True)
        scene, static, ego = (self._catalogue.channel(topic, "protobuf", schema, {}) for topic, schema in schemas)
        placed = partial(foxglove.transform, self._frame_id)
        return TruthWriter(scene, static, ego, self.drawn, placed)

    def drawn(self, entities: Sequence[Entity], time_ns: int) -> bytes:
        return foxglove.drawn(entities, time_ns, self._frame_id)


class _Ros2:
    """autoware_perception_msgs/DetectedObjects and foxglove_msgs/SceneUpdate in the frame of reference `frame_id`; the
    JSON of the details as std_msgs/String.
    """

    osi = False

    def __init__(self, catalogue: Catalogue, scene: Scene, units: Mapping[str, int], frame_id: str) -> None:
        self._catalogue, self._scene, self._frame_id = catalogue, scene, frame_id
        self._schemas = [
            catalogue.schema(name, "ros2msg", definition(name))
            for name in (detected_objects.SCHEMA, foxglove_ros2.SCHEMA, STRING)
        ]

    def channels(
        self, name: str, fused_tracks: FusedTracks, events: Mapping[int, Sequence[detail.Event]], colour: Rgb
    ) -> dict[int, ListWriter]:
        scene, frame_id = self._scene, self._frame_id
        objects = detected_objects.DetectedObjectsWriter(scene, fused_tracks, frame_id)
        details = DetailWriter(scene, fused_tracks, events, sizes_of=objects.round)
        writers: list[ListWriter] = [
            _ListByList(objects.message),
            _ListByList(foxglove_ros2.SceneWriter(scene, fused_tracks, name, colour, frame_id).message),
            _AsString(details),
        ]
        numbers = [
            self._catalogue.channel(topic, "cdr", schema, {"offered_qos_profiles": QOS})
            for topic, schema in zip(topics_of(name), self._schemas, strict=True)
        ]
        return dict(zip(numbers, writers, strict=True))

    def seen_besides(
        self, name: str, fused_tracks: FusedTracks, statuses: Statuses, colour: Rgb
    ) -> dict[int, ListWriter]:
        schemas = self._catalogue.schema(STATUS, "ros2msg", definition(STATUS)), self._schemas[1]
        numbers = [self._channel(topic, schema) for topic, schema in zip(more_topics_of(name), schemas, strict=True)]
        uncertainty = UncertaintyWriter(self._scene, fused_tracks, colour, self._ellipses)
        writers: list[ListWriter] = [_AsStatus(statuses), uncertainty]
        return dict(zip(numbers, writers, strict=True))

    def truth(self) -> TruthWriter:
        moves = self._catalogue.schema(TRANSFORM, "ros2msg", definition(TRANSFORM))
        schemas = zip(TRUTH_TOPICS, (self._schemas[1], self._schemas[1], moves), strict=True)
        scene, static, ego = (self._channel(topic, schema) for topic, schema in schemas)
        placed = partial(foxglove_ros2.transform, self._frame_id)
        return TruthWriter(scene, static, ego, self.drawn, placed)

    def drawn(self, entities: Sequence[Entity], time_ns: int) -> bytes:
        return foxglove_ros2.drawn(entities, time_ns, self._frame_id)

    def _ellipses(self, ellipses: Ellipses, time_ns: Int, start: Int) -> Iterator[bytes]:
        every = ellipses.entities()
        for k, at_ns in enumerate(time_ns.tolist()):
            yield self.drawn(every[start[k] : start[k + 1]], at_ns)

    def _channel(self, topic: str, schema: int) -> int:
        return self._catalogue.channel(topic, "cdr", schema, {"offered_qos_profiles": QOS})


OSI: Family = _Osi
"""The family of all recordings but those of ROS 2."""


class _AsStatus:
    """Statuses as copem_replay_msgs/Status."""

    def __init__(self, statuses: Statuses) -> None:
        self._statuses = statuses

    def messages(self, available_ns: Int) -> Iterator[bytes]:
        status, age_s = self._statuses.at(available_ns)
        for time_ns, each, ages in zip(available_ns.tolist(), status.tolist(), age_s.tolist(), strict=True):
            out = cdr_write.Cdr()
            out.stamp(time_ns)
            out.add("I", len(each))
            for name, which, age in zip(self._statuses.names, each, ages, strict=True):
                out.text(name)
                out.text(STATUSES[which])
                out.add("d", age)
            yield out.message()


class _AsString:
    """A writer of JSON whose messages go as std_msgs/String."""

    def __init__(self, writer: ListWriter) -> None:
        self._writer = writer

    def messages(self, available_ns: Int) -> Iterator[bytes]:
        return (cdr_write.HEAD + cdr_write.text(data.decode()) for data in self._writer.messages(available_ns))


class _ListByList:
    """What makes one message at a time, of the number of its list and the instant."""

    def __init__(self, message: Callable[[int, int], bytes]) -> None:
        self._message = message

    def messages(self, available_ns: Int) -> Iterator[bytes]:
        return (self._message(frame, time_ns) for frame, time_ns in enumerate(available_ns.tolist()))


def _protobuf(catalogue: Catalogue, message_class: Any, name: str) -> int:
    from mcap_protobuf.schema import build_file_descriptor_set

    data = build_file_descriptor_set(message_class).SerializeToString(deterministic=True)
    return catalogue.schema(name, "protobuf", data)

"""Writing ASAM OSI: fused lists as osi3.SensorData, and multi-channel traces (MCAP) of converters.

Of a fused list, `timestamp` is the instant it is available, `last_measurement_time` the newest capture in it. Positions
are in the log's world frame, as an identity `mounting_position` without a host location says (OSI's own frame for this
message would be the virtual sensor's). What states no truth ids knows no stationary objects: all are moving ones.
`base_rmse` holds standard deviations, `ground_truth_id` the object's id in the
truth. A trace has neither a creation time nor any other clock: given content gives the same bytes each time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import osi3
from google.protobuf import __version__ as protobuf_version
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set
from osi3.osi_common_pb2 import BaseStationary
from osi3.osi_groundtruth_pb2 import GroundTruth
from osi3.osi_lane_pb2 import Lane as OsiLane
from osi3.osi_lane_pb2 import LaneBoundary
from osi3.osi_roadmarking_pb2 import RoadMarking

from copem_replay.core.files import atomic_file
from copem_replay.core.site_map import SiteMap, outline_crosswalks
from copem_replay.core.tracks import CLASSES, NO_CAPTURE_NS, Float, Int, Scene
from copem_replay.io.encodings.column_bytes import (
    Content,
    Instants,
    RepeatedMessages,
    encode_messages,
    expand_ranges,
    optional_message,
    split_into_blocks,
    start_offsets,
)
from copem_replay.io.schemas.osi_ground_truth import SENSOR_DATA, load_message_class, osi_id
from copem_replay.io.schemas.osi_lanes import SUBTYPES, ZEBRA

if TYPE_CHECKING:
    from copem_replay.core.fused_tracks import FusedTracks


# Multi-channel traces, as converters write them.

NANOS_PER_SECOND: Final = 1_000_000_000
_TRACE: Final = "net.asam.osi.trace"


@dataclass(frozen=True)
class OsiTrace:
    """The content of one trace."""

    description: str
    topics: Mapping[str, str]  # description by topic
    messages: Iterable[tuple[str, Any]]  # (topic, message), in the order of their `timestamp`
    source: str  # where the content comes from
    records: Mapping[str, Mapping[str, str]] = field(default_factory=dict)  # more metadata; read after the messages
    logged_after_ns: Mapping[str, int] = field(default_factory=dict)  # log time after the stamp, by topic; else 0


def empty_ground_truth(stamp_ns: int, host_id: int | None) -> GroundTruth:
    """A message without objects, with its time stamp, the version of OSI and the host's id."""
    osi = GroundTruth()
    parts = (int(part) for part in osi3.__version__.split(".")[:3])
    osi.version.version_major, osi.version.version_minor, osi.version.version_patch = parts
    osi.timestamp.seconds, osi.timestamp.nanos = divmod(stamp_ns, NANOS_PER_SECOND)
    if host_id is not None:
        osi.host_vehicle_id.value = host_id
    return osi


def add_road(osi: GroundTruth, lines: Iterable[Float], site: SiteMap) -> None:
    """Add boundaries: lines (K, 3) and the borders of lanes, once each; lanes by them; crosswalks as road markings.

    Each lane is stored as it is driven. Ids are those of the source where all are whole numbers.
    """
    numbers, lane_types = dict[bytes, int](), OsiLane.Classification
    for line in (*lines, *(line for lane in site.lanes for line in (lane.left_m, lane.right_m))):
        if (number := numbers.setdefault(line.tobytes(), len(numbers))) == len(osi.lane_boundary):
            boundary = osi.lane_boundary.add(id={"value": number})
            boundary.classification.type = LaneBoundary.Classification.TYPE_NO_LINE
            for x, y, z in line.tolist():
                boundary.boundary_line.add(position={"x": x, "y": y, "z": z})
    for lane, ident in zip(site.lanes, _number_ids([lane.id for lane in site.lanes]), strict=True):
        classification = osi.lane.add(id={"value": ident}).classification
        classification.type = lane_types.TYPE_DRIVING if lane.kind == "driving" else lane_types.TYPE_NONDRIVING
        classification.subtype, classification.centerline_is_driving_direction = SUBTYPES[lane.kind], True
        left, right = lane.across()
        for x, y, z in ((left + right) / 2).tolist():
            classification.centerline.add(x=x, y=y, z=z)
        classification.left_lane_boundary_id.add(value=numbers[lane.left_m.tobytes()])
        classification.right_lane_boundary_id.add(value=numbers[lane.right_m.tobytes()])
    outlines = list(outline_crosswalks(site.areas, site.lanes))
    names = [area.name.split()[-1] for area in site.areas if area.kind == "crosswalk"]
    for ring, ident in zip(outlines, _number_ids(names), strict=True):
        low, high = ring.min(axis=0), ring.max(axis=0)
        x, y, z = (low + high) / 2
        size = {"length": high[0] - low[0], "width": high[1] - low[1]}
        corners = [{"x": east, "y": north} for east, north, _ in (ring[:-1] - (x, y, z)).tolist()]
        marking = osi.road_marking.add(id={"value": ident})
        marking.base.CopyFrom(BaseStationary(position={"x": x, "y": y, "z": z}, dimension=size, base_polygon=corners))
        marking.classification.type = RoadMarking.Classification.TYPE_SYMBOLIC_TRAFFIC_SIGN
        marking.classification.traffic_main_sign_type = ZEBRA


def _number_ids(names: Sequence[str]) -> list[int]:
    whole = all(name.isascii() and name.isdecimal() and len(name) < 19 for name in names)
    return [int(name) for name in names] if whole else list(range(1, len(names) + 1))


def write_osi_trace(trace: OsiTrace, path: Path) -> None:
    """Write a trace; the file is complete, or not there. Raises OutputError, and what `messages` raises."""
    with atomic_file(path) as temporary, temporary.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start(profile="", library="copem_replay")
        _write_content(writer, trace)
        writer.finish()  # type: ignore[no-untyped-call]


def _write_content(writer: Writer, trace: OsiTrace) -> None:
    """Write metadata, channels and messages of an OSI trace, in an order and with bytes that do not vary."""
    osi_version = osi3.__version__
    trace_metadata = {
        **dict.fromkeys(("version", "min_osi_version", "max_osi_version"), osi_version),
        **dict.fromkeys(("min_protobuf_version", "max_protobuf_version"), protobuf_version),
        "description": trace.description,
        "authors": "copem_replay",
        "data_sources": trace.source,
    }  # neither creation_time nor zero_time: the first would be a clock, and the scene has no date
    writer.add_metadata(_TRACE, dict(sorted(trace_metadata.items())))
    prefix = f"{_TRACE}.channel."
    versions = {f"{prefix}osi_version": osi_version, f"{prefix}protobuf_version": protobuf_version}
    schema_ids: dict[str, int] = {}
    channel_ids: dict[str, int] = {}
    for topic, message in trace.messages:
        schema = message.DESCRIPTOR.full_name
        if schema not in schema_ids:
            files = build_file_descriptor_set(type(message)).SerializeToString(deterministic=True)
            schema_ids[schema] = writer.register_schema(schema, "protobuf", files)
        if topic not in channel_ids:
            metadata = {f"{prefix}description": trace.topics[topic]} | versions
            channel_ids[topic] = writer.register_channel(topic, "protobuf", schema_ids[schema], metadata)
        stamp_ns = message.timestamp.seconds * NANOS_PER_SECOND + message.timestamp.nanos
        data = message.SerializeToString(deterministic=True)
        logged_ns = stamp_ns + trace.logged_after_ns.get(topic, 0)
        writer.add_message(channel_ids[topic], logged_ns, data, publish_time=stamp_ns)
    for name, record in sorted(trace.records.items()):
        writer.add_metadata(name, dict(sorted(record.items())))


# Fused lists.

OSI_VERSION = "3.8.0"
"""The version of OSI that is written."""

# osi_object.proto: MovingObject.Type and MovingObject.VehicleClassification.Type by class; −1: not a vehicle
_OSI_TYPE = {"pedestrian": 3, "animal": 4, "other": 1}
_OSI_CAR = {"vehicle": 0, "car": 4, "van": 6, "truck": 7, "trailer": 9, "motorcycle": 10, "bicycle": 11, "bus": 12}
_TYPE = np.array([_OSI_TYPE.get(name, 2) for name in CLASSES])
_VEHICLE = np.array([_OSI_CAR.get(name, -1) for name in CLASSES])
_MEASURED, _STALE = 2, 1  # osi_detectedobject.proto: MEASUREMENT_STATE_MEASURED, _OTHER: from an older list only


class SensorDataWriter:
    """Turns the fused lists of one run (values (1, P)) into messages, many lists at once.

    `unit_numbers` are the numbers by which `sensor_id` names the units that contributed. `draw_areas`: the field of
    view, of a unit whose lists they are.
    """

    def __init__(
        self, scene: Scene, fused_tracks: FusedTracks, unit_numbers: Mapping[str, int],
        draw_areas: Callable[[int, int], RepeatedMessages] | None = None,
    ) -> None:  # fmt: skip
        self._scene, self._fused_tracks, self._draw_areas = scene, fused_tracks, draw_areas
        object_ix, claims, received = fused_tracks.fused.row_object_ix, fused_tracks.said, fused_tracks.received
        self._moving = np.where((object_ix >= 0) & (claims is None), scene.moving[object_ix], True)
        self._ids = np.array([osi_id(name) for name in scene.object_ids], dtype=np.uint64)
        numbers = np.array([unit_numbers[name] for name in received.units])
        if claims is None:
            self._unit = numbers[received.row_unit_ix[fused_tracks.used]]
            self._captured_ns = received.stamp_ns[received.frame_ix[fused_tracks.used]]
            self._used_start = fused_tracks.used_start
        else:  # of the contributing entries only the first unit and the newest capture are known
            has_unit = claims["unit_ix"] >= 0
            self._unit = numbers[claims["unit_ix"][has_unit]]
            self._captured_ns = scene.t0_ns + np.rint(claims["captured_s"][has_unit] * 1e9).astype(np.int64)
            self._used_start = np.concatenate([[0], np.cumsum(has_unit)])

    def messages(self, available_ns: Int) -> Iterator[bytes]:
        """The lists as osi3.SensorData, available at these instants (F,) of the log's clock (ns)."""
        rows, bounds = self._fused_tracks.listed_rows
        version = dict(
            zip(("version_major", "version_minor", "version_patch"), map(int, OSI_VERSION.split(".")), strict=True)
        )
        for first, last in split_into_blocks(bounds):
            listed, lists = rows[bounds[first] : bounds[last]], np.diff(bounds[first : last + 1])
            captured_ns = self._fused_tracks.fused.stamp_ns[first:last]
            content: dict[str, Any] = {
                "version": version,
                "timestamp": Instants(available_ns[first:last]),
                "mounting_position": {"position": {}, "orientation": {}},
                "last_measurement_time": optional_message(
                    captured_ns != NO_CAPTURE_NS, Instants(captured_ns[captured_ns != NO_CAPTURE_NS])
                ),
            }
            if self._draw_areas is not None:
                content["virtual_detection_area"] = {"polygon": self._draw_areas(first, last)}
            frame = np.repeat(np.arange(len(lists)), lists)
            for name, kind in (("moving_object", self._moving[listed]), ("stationary_object", ~self._moving[listed])):
                if not kind.any():
                    continue
                start = np.searchsorted(frame[kind], np.arange(len(lists) + 1))
                items = self._items(listed[kind], captured_ns[frame[kind]], name == "moving_object")
                content[name] = RepeatedMessages(start, items)
            yield from encode_messages(load_message_class(SENSOR_DATA).DESCRIPTOR, content, last - first)

    def _items(self, rows: Int, captured_ns: Int, moving: bool) -> Content:
        """The content of detected objects (`moving` or stationary); `captured_ns`: the newest capture of their list."""
        fused = self._fused_tracks.fused
        x, y, z, length, width, height, yaw, vx, vy = (
            getattr(fused, name)[0, rows]
            for name in ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad", "vx_mps", "vy_mps")
        )
        size_sd, v_sd = _standard_deviation(fused.size_var_m2, rows), _standard_deviation(fused.speed_var_m2ps2, rows)
        return {
            "header": self._header(rows, captured_ns),
            "base": {
                "position": {"x": x, "y": y, "z": z},
                "orientation": {"yaw": yaw},
                "dimension": {"length": length, "width": width, "height": height},
                **({"velocity": {"x": vx, "y": vy}} if moving else {}),
            },
            "base_rmse": {
                "position": {
                    "x": _standard_deviation(fused.cov_ee_m2, rows),
                    "y": _standard_deviation(fused.cov_nn_m2, rows),
                },
                "orientation": {"yaw": _standard_deviation(fused.yaw_var_rad2, rows)},
                "dimension": dict.fromkeys(("length", "width", "height"), size_sd),
                **({"velocity": {"x": v_sd, "y": v_sd}} if moving else {}),
            },
            **({"candidate": self._candidates(rows)} if moving else {}),
        }

    def _header(self, rows: Int, captured_ns: Int) -> Content:
        """The headers of detected objects; *measured* are those with an entry of the newest capture, `captured_ns`."""
        claims, object_ix = self._fused_tracks.said, self._fused_tracks.fused.row_object_ix[rows]
        true_id = self._ids[object_ix[object_ix >= 0]]
        track_id = None if claims is None else claims["track_id"][rows]
        start, entry_rows = expand_ranges(self._used_start, rows)
        new_entries = start_offsets(self._captured_ns[entry_rows] == np.repeat(captured_ns, np.diff(start)))
        return {
            "tracking_id": {"value": true_id}
            if track_id is None
            else optional_message(track_id >= 0, {"value": track_id[track_id >= 0]}),
            "ground_truth_id": optional_message(object_ix >= 0, {"value": true_id}),
            "existence_probability": 1.0 if claims is None else claims["existence"][rows],
            "measurement_state": np.where(np.diff(new_entries[start]) > 0, _MEASURED, _STALE),
            "sensor_id": RepeatedMessages(start, {"value": self._unit[entry_rows]}),
        }

    def _candidates(self, rows: Int) -> RepeatedMessages:
        """The candidates of the objects: the true class, or all classes that the fusion states."""
        claims = self._fused_tracks.said
        if claims is None:
            start, kind = np.arange(len(rows) + 1), self._fused_tracks.class_of(self._scene)[rows]
            share = np.ones(len(rows))
        else:
            shares = claims["class_probability"][rows]
            row, kind = np.nonzero(shares)
            start, share = np.searchsorted(row, np.arange(len(rows) + 1)), shares[row, kind]
        vehicle = _VEHICLE[kind]
        classified = optional_message(vehicle >= 0, {"type": vehicle[vehicle >= 0]})
        return RepeatedMessages(
            start, {"probability": share, "type": _TYPE[kind], "vehicle_classification": classified}
        )


def _standard_deviation(variance: Float | None, rows: Int) -> Float:
    """Standard deviations of `rows`, 0 where the state is exact."""
    result: Float = np.zeros(len(rows)) if variance is None else np.sqrt(np.nan_to_num(variance[0, rows]))
    return result

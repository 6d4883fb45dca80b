"""Fused lists as messages, one object and one field at a time, by the protobuf and JSON libraries alone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
import orjson
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from osi3.osi_sensordata_pb2 import SensorData
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import CLASSES, NO_CAPTURE_NS, UNCERTAINTIES, Scene
from copem_replay.io.encodings.ros2_types import message_definition
from copem_replay.io.schemas.osi_ground_truth import osi_id
from copem_replay.io.write.scene import Entity, Pose

OSI_TYPE: dict[str, tuple[int, int | None]] = {
    "pedestrian": (3, None), "animal": (4, None), "other": (1, None), "vehicle": (2, 0), "car": (2, 4), "van": (2, 6),
    "truck": (2, 7), "trailer": (2, 9), "motorcycle": (2, 10), "bicycle": (2, 11), "bus": (2, 12),
}  # fmt: skip


def rows_of(fused_tracks: FusedTracks, frame: int) -> list[int]:
    fused = fused_tracks.fused
    rows: list[int] = np.flatnonzero((fused.frame_ix == frame) & fused.valid[0]).tolist()
    return rows


def name_of(scene: Scene, fused_tracks: FusedTracks, row: int) -> str:
    fused, said = fused_tracks.fused, fused_tracks.said
    if fused.row_object_ix[row] >= 0:
        return scene.object_ids[fused.row_object_ix[row]]
    if said is not None and said["track_id"][row] >= 0:
        return f"track:{said['track_id'][row]}"
    return f"entry:{[p for p in range(len(fused.frame_ix)) if fused.frame_ix[p] == fused.frame_ix[row]].index(row)}"


def entries_of(fused_tracks: FusedTracks, row: int) -> list[int]:
    entries = fused_tracks.entries[fused_tracks.start[row] : fused_tracks.start[row + 1]].tolist()
    return [k for k in entries if fused_tracks.received.valid[0, k]]


def sensor_data(
    scene: Scene, fused_tracks: FusedTracks, numbers: Mapping[str, int], frame: int, available_ns: int
) -> bytes:
    """osi3.SensorData."""
    fused, said, received = fused_tracks.fused, fused_tracks.said, fused_tracks.received
    data = SensorData()
    data.version.version_major, data.version.version_minor, data.version.version_patch = 3, 8, 0
    data.timestamp.seconds, data.timestamp.nanos = divmod(available_ns, 10**9)
    captured_ns = int(fused.stamp_ns[frame])
    if captured_ns != NO_CAPTURE_NS:
        data.last_measurement_time.seconds, data.last_measurement_time.nanos = divmod(captured_ns, 10**9)
    data.mounting_position.position.SetInParent()
    data.mounting_position.orientation.SetInParent()
    for p in rows_of(fused_tracks, frame):
        number = int(fused.row_object_ix[p])
        moving = said is not None or number < 0 or bool(scene.moving[number])
        item = (data.moving_object if moving else data.stationary_object).add()
        if said is None:
            item.header.tracking_id.value = osi_id(scene.object_ids[number])
        elif said["track_id"][p] >= 0:
            item.header.tracking_id.value = int(said["track_id"][p])
        if number >= 0:
            item.header.ground_truth_id.add().value = osi_id(scene.object_ids[number])
        item.header.existence_probability = 1.0 if said is None else float(said["existence"][p])
        shares = {scene.object_class[number]: 1.0} if said is None else dict(enumerate(said["class_probability"][p]))
        for kind, share in shares.items():
            if moving and share != 0:
                candidate = item.candidate.add()
                candidate.probability = share
                candidate.type, vehicle = OSI_TYPE[CLASSES[kind]]
                if vehicle is not None:
                    candidate.vehicle_classification.type = vehicle
        if said is None:
            units = [
                (received.row_unit_ix[k], int(received.stamp_ns[received.frame_ix[k]]))
                for k in entries_of(fused_tracks, p)
            ]
        elif said["unit_ix"][p] >= 0:
            units = [(said["unit_ix"][p], scene.t0_ns + round(float(said["captured_s"][p]) * 1e9))]
        else:
            units = []
        for unit, _ in units:
            item.header.sensor_id.add().value = numbers[received.units[unit]]
        item.header.measurement_state = 2 if captured_ns in [stamp_ns for _, stamp_ns in units] else 1
        base, spread = item.base, item.base_rmse
        base.position.x, base.position.y, base.position.z = (a[0, p] for a in (fused.x_m, fused.y_m, fused.z_m))
        base.orientation.yaw = fused.yaw_rad[0, p]
        base.dimension.length, base.dimension.width = fused.length_m[0, p], fused.width_m[0, p]
        base.dimension.height = fused.height_m[0, p]

        def sigma(name: str, p: int = p) -> float:
            variance = getattr(fused, name)
            return 0.0 if variance is None or math.isnan(variance[0, p]) else math.sqrt(variance[0, p])

        spread.position.x, spread.position.y = sigma("cov_ee_m2"), sigma("cov_nn_m2")
        spread.orientation.yaw = sigma("yaw_var_rad2")
        around, fast = sigma("size_var_m2"), sigma("speed_var_m2ps2")
        spread.dimension.length = spread.dimension.width = spread.dimension.height = around
        if moving:
            base.velocity.x, base.velocity.y = fused.vx_mps[0, p], fused.vy_mps[0, p]
            spread.velocity.x = spread.velocity.y = fast
    return bytes(data.SerializeToString(deterministic=True))


def _update(available_ns: int) -> Any:
    update = SceneUpdate()
    deletion = update.deletions.add(type=SceneEntityDeletion.ALL)
    deletion.timestamp.FromNanoseconds(available_ns)
    return update


def scene_update(
    scene: Scene, fused_tracks: FusedTracks, configuration: str, colour: Sequence[int], frame_id: str, frame: int,
    available_ns: int,
) -> bytes:  # fmt: skip
    """foxglove.SceneUpdate: boxes."""
    fused, update = fused_tracks.fused, _update(available_ns)
    for p in rows_of(fused_tracks, frame):
        name = name_of(scene, fused_tracks, p)
        entity = update.entities.add(frame_id=frame_id, id=name)
        entity.timestamp.FromNanoseconds(available_ns)
        said = {"configuration": configuration, "class": CLASSES[fused_tracks.class_of(scene)[p]], "object": name}
        for key, value in said.items():
            entity.metadata.add(key=key, value=value)
        cube = entity.cubes.add()
        at, turn, size = cube.pose.position, cube.pose.orientation, cube.size
        at.x, at.y, at.z = (a[0, p] for a in (fused.x_m, fused.y_m, fused.z_m))
        size.x, size.y, size.z = (a[0, p] for a in (fused.length_m, fused.width_m, fused.height_m))
        turn.z, turn.w = math.sin(fused.yaw_rad[0, p] / 2), math.cos(fused.yaw_rad[0, p] / 2)
        cube.color.r, cube.color.g, cube.color.b = (c / 255 for c in colour)
        cube.color.a = 0.5
    return bytes(update.SerializeToString(deterministic=True))


def ellipses(
    scene: Scene, fused_tracks: FusedTracks, colour: Sequence[int], frame_id: str, axes: Any, frame: int,
    available_ns: int,
) -> bytes:  # fmt: skip
    """foxglove.SceneUpdate: 2σ ellipses with these axes, (P,) each, m, m and rad."""
    fused, update = fused_tracks.fused, _update(available_ns)
    for p in rows_of(fused_tracks, frame):
        major, minor, yaw_rad = (float(column[p]) for column in axes)
        if major < 0.01:
            continue
        entity = update.entities.add(frame_id=frame_id, id=name_of(scene, fused_tracks, p))
        entity.timestamp.FromNanoseconds(available_ns)
        age_s = max(0.0, (available_ns - scene.t0_ns) * 1e-9 - float(fused_tracks.captured_s[0, p]))
        if math.isfinite(age_s):
            entity.metadata.add(key="age_s", value=f"{age_s:.3f}")
        made = entity.cylinders.add(bottom_scale=1.0, top_scale=1.0)
        made.size.x, made.size.y, made.size.z = 4.0 * major, 4.0 * minor, 0.02
        at, turn = made.pose.position, made.pose.orientation
        at.x, at.y, at.z = fused.x_m[0, p], fused.y_m[0, p], fused.z_m[0, p] - fused.height_m[0, p] / 2
        turn.z, turn.w = math.sin(yaw_rad / 2), math.cos(yaw_rad / 2)
        made.color.r, made.color.g, made.color.b = (c / 255 for c in colour)
        made.color.a = 0.6 + (0.15 - 0.6) * min(age_s, 1.0)
    return bytes(update.SerializeToString(deterministic=True))


def drawn_scene(entities: Sequence[Entity], frame_id: str, available_ns: int) -> bytes:
    """foxglove.SceneUpdate: entities at their poses."""
    update = _update(available_ns)
    for each in entities:
        entity = update.entities.add(frame_id=frame_id, id=each.name)
        entity.timestamp.FromNanoseconds(available_ns)
        for key, value in each.says.items():
            entity.metadata.add(key=key, value=value)
        for ellipse in each.ellipses:
            made = entity.cylinders.add(bottom_scale=1.0, top_scale=1.0)
            made.size.x, made.size.y, made.size.z = ellipse.size
            _place(made, each.pose, ellipse.colour)
        for line in each.lines:
            made = entity.lines.add(thickness=line.width, scale_invariant=True)
            for x, y, z in line.points:
                made.points.add(x=x, y=y, z=z)
            _place(made, each.pose, line.colour)
        for text in each.texts:
            made = entity.texts.add(billboard=True, font_size=text.size, scale_invariant=True, text=text.text)
            over = Pose(each.pose.x_m, each.pose.y_m, sum(text.above_m, start=each.pose.z_m))
            _place(made, over, text.colour)
    return bytes(update.SerializeToString(deterministic=True))


def _place(primitive: Any, pose: Pose, colour: Sequence[float]) -> None:
    at, turn, shade = primitive.pose.position, primitive.pose.orientation, primitive.color
    at.x, at.y, at.z = pose.x_m, pose.y_m, pose.z_m
    turn.z, turn.w = math.sin(pose.yaw_rad / 2), math.cos(pose.yaw_rad / 2)
    shade.r, shade.g, shade.b, shade.a = colour


def content_of(message: Any, descriptor: Any) -> dict[str, Any]:
    """What all fields of a type in protobuf are in a message of it, or in one of the same fields in ROS 2."""
    found: dict[str, Any] = {}
    for field in descriptor.fields:
        value, inner = getattr(message, field.name), field.message_type
        if inner is not None and inner.full_name in ("google.protobuf.Timestamp", "google.protobuf.Duration"):
            names = ("seconds", "nanos") if hasattr(value, "seconds") else ("sec", "nanosec")
            found[field.name] = tuple(int(getattr(value, name)) for name in names)
        elif inner is not None:
            found[field.name] = (
                [content_of(item, inner) for item in value] if field.is_repeated else content_of(value, inner)
            )
        else:
            found[field.name] = list(value) if field.is_repeated or isinstance(value, bytes | np.ndarray) else value
    return found


@cache
def _store(name: str) -> Any:
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(message_definition(name).decode(), name))
    return store


def decode_ros2(name: str, data: bytes) -> Any:
    """A message of ROS 2 as rosbags reads it, which has to write the same bytes."""
    found = _store(name).deserialize_cdr(data, name)
    assert bytes(_store(name).serialize_cdr(found, name)) == data
    return found


def detail(
    scene: Scene, fused_tracks: FusedTracks, events: Sequence[Any], sized: Sequence[bool], frame: int, available_ns: int
) -> bytes:
    """copem_replay.ListDetail."""
    fused, said, received, view = fused_tracks.fused, fused_tracks.said, fused_tracks.received, fused_tracks.view
    objects = []
    for p in rows_of(fused_tracks, frame):
        one: dict[str, Any] = {"id": name_of(scene, fused_tracks, p)}
        if said is not None:
            one["existence"] = float(said["existence"][p])
        if sized[p]:
            one |= {"length_m": float(fused.length_m[0, p]), "width_m": float(fused.width_m[0, p])}
        for name in UNCERTAINTIES:
            one[name] = None if getattr(fused, name) is None else float(getattr(fused, name)[0, p])
        newest_s = float(fused_tracks.captured_s[0, p])
        one["newest_captured_ns"] = scene.t0_ns + round(newest_s * 1e9) if math.isfinite(newest_s) else None
        if fused_tracks.stated_s is not None:
            one["stated_captured_ns"] = scene.t0_ns + round(float(fused_tracks.stated_s[p]) * 1e9)
        used = entries_of(fused_tracks, p)
        one["units"] = [received.units[received.row_unit_ix[k]] for k in used]
        one["captured_ns"] = [int(received.stamp_ns[received.frame_ix[k]]) for k in used]
        one["range_m"] = [None if view is None else float(view.range_m[k]) for k in used]
        one["visible_share"] = [None if view is None else float(view.visible_share[k]) for k in used]
        objects.append(one)
    captured_ns = int(fused.stamp_ns[frame])
    return orjson.dumps(
        {
            "available_ns": available_ns,
            "captured_ns": None if captured_ns == NO_CAPTURE_NS else captured_ns,
            "objects": objects,
            "events": list(events),
        }
    )


def status(
    scene: Scene, fused_tracks: FusedTracks, known_ns: Mapping[int, int | None], frame: int, available_ns: int
) -> bytes:
    """copem_replay.Status; `known_ns`: by object from when on it is known, None: never."""
    said = []
    for number, since_ns in known_ns.items():
        rows = [p for p in rows_of(fused_tracks, frame) if fused_tracks.fused.row_object_ix[p] == number]
        age_s = None
        for p in rows:
            age_s = round(max(0.0, (available_ns - scene.t0_ns) * 1e-9 - float(fused_tracks.captured_s[0, p])), 6)
        known = since_ns is not None and available_ns >= since_ns - 1000
        text = "not listed" if not rows else "known" if known else "listed, not known"
        said.append({"id": scene.object_ids[number], "status": text, "age_s": age_s})
    return orjson.dumps({"available_ns": available_ns, "objects": said})

"""Scenes for Foxglove and Lichtblick: boxes of fused lists, ellipses of uncertainty, and the truth, in protobuf as
foxglove.SceneUpdate; their messages in ROS 2 are in `ros2.py`.

Every message deletes all that was on its topic and draws anew, so playback shows the right boxes after a seek and
nothing accumulates (entities replace by id and live until deleted).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np

from copem_replay.core.colours import Rgb
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import CLASSES, Float, Int, Scene
from copem_replay.io.encodings.column_bytes import (
    Content,
    RepeatedMessages,
    TextPool,
    encode_messages,
    expand_ranges,
    optional_message,
    repeat_text,
    split_into_blocks,
    start_offsets,
)

# Elements of scenes besides boxes, for any encoding.

Rgba: TypeAlias = tuple[float, float, float, float]
Place: TypeAlias = tuple[float, float, float]


@dataclass(frozen=True)
class Pose:
    """A place in the frame of reference, m, and a turn about the vertical, rad."""

    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.0
    yaw_rad: float = 0.0


@dataclass(frozen=True)
class Line:
    """A line through points (K, 3) of the entity's own frame; `width` in pixels."""

    points: Sequence[Place]
    colour: Rgba
    width: float = 1.5


@dataclass(frozen=True)
class Text:
    """A text that faces the camera, over the entity's pose by the heights `above_m` one after the other; `size` in
    pixels.
    """

    text: str
    colour: Rgba
    above_m: tuple[float, ...] = ()
    size: float = 14.0

    def place(self, pose: Pose) -> Pose:
        """Where it is when its entity has a pose."""
        return Pose(pose.x_m, pose.y_m, sum(self.above_m, start=pose.z_m))


@dataclass(frozen=True)
class Ellipse:
    """An upright elliptic cylinder with these diameters and this height, m."""

    size: Place
    colour: Rgba


@dataclass(frozen=True)
class Entity:
    """A named entity: its metadata, which a viewer shows for a selected entity, its elements, and its pose."""

    name: str
    says: Mapping[str, str] = field(default_factory=dict)
    lines: Sequence[Line] = ()
    texts: Sequence[Text] = ()
    ellipses: Sequence[Ellipse] = ()
    pose: Pose = field(default_factory=Pose)

    def placed(self, pose: Pose) -> Entity:
        """The entity with another pose."""
        return replace(self, pose=pose)


@dataclass(frozen=True)
class MovingEntities:
    """Entities in frames: frame f, at `time_ns[f]` of the log's clock, has the rows `start[f]:start[f + 1]` of (P,).

    `looks`: what entities look like; `look_ix (P,)`: which look a row has, at its pose.
    """

    looks: Sequence[Entity]
    time_ns: Int
    start: Int
    look_ix: Int
    x_m: Float
    y_m: Float
    z_m: Float
    yaw_rad: Float


@dataclass(frozen=True)
class TruthScene:
    """The truth as a scene: static entities, moving ones, and in each frame the pose of the frame `follow`, if any.

    `moving`: of some frames at a time, read once.
    """

    static: Sequence[Entity]
    moving: Iterable[MovingEntities]
    followed: Sequence[Pose | None]
    follow: str


# Uncertainty: 2σ ellipses of position, paler with the age of the entry.

SIGMAS = 2.0
FRESH_ALPHA, OLDEST_ALPHA, FADES_S = 0.6, 0.15, 1.0
"""Opacity of an ellipse: that of a fresh entry, the least, and the age of the least in s; only the picture changes."""
SMALLEST_M = 0.01
"""Smaller standard deviations are not drawn: their ellipses would be points."""


@dataclass(frozen=True)
class Ellipses:
    """Upright elliptic cylinders, (N,): names, ages of the entries (`""`: unknown), places, sizes, opacity."""

    names: list[str]
    ages: list[str]
    x_m: Float
    y_m: Float
    z_m: Float
    yaw_rad: Float
    length_m: Float
    width_m: Float
    alpha: Float
    colour: tuple[float, float, float]
    height_m: float = 0.02

    def entities(self) -> list[Entity]:
        """An entity for each ellipse."""
        numbers = (getattr(self, n).tolist() for n in ("x_m", "y_m", "z_m", "yaw_rad", "length_m", "width_m", "alpha"))
        return [
            Entity(
                name,
                {"age_s": age} if age else {},
                ellipses=[Ellipse((length, width, self.height_m), (*self.colour, alpha))],
                pose=Pose(x, y, z, yaw),
            )
            for name, age, x, y, z, yaw, length, width, alpha in zip(self.names, self.ages, *numbers, strict=True)
        ]


Encode = Callable[[Ellipses, Int, Int], Iterable[bytes]]
"""Makes K messages from all ellipses, the instants (K,), and the first ellipse of each instant (K + 1,)."""


class UncertaintyWriter:
    """Turns the fused lists of one run (values (1, P)) into scenes of ellipses, many lists at once."""

    def __init__(self, scene: Scene, fused_tracks: FusedTracks, colour: Rgb, encode: Encode) -> None:
        self._t0_ns, self._fused_tracks, self._encode = scene.t0_ns, fused_tracks, encode
        self._colour = colour[0] / 255, colour[1] / 255, colour[2] / 255
        fused, rows = fused_tracks.fused, len(fused_tracks.fused.frame_ix)
        ee, en, nn = (
            np.zeros(rows) if c is None else np.asarray(c[0], dtype=float)
            for c in (fused.cov_ee_m2, fused.cov_en_m2, fused.cov_nn_m2)
        )
        self._major, self._minor, self._yaw_rad = principal_axes(ee, en, nn)
        self._names, self._name = fused_tracks.names_of(scene)

    def messages(self, available_ns: Int) -> Iterator[bytes]:
        """The lists as they became available at these instants of the log's clock, (F,)."""
        rows, bounds = self._fused_tracks.listed_rows
        drawn = self._major[rows] >= SMALLEST_M  # neither the truth, nor lists that state no covariance
        rows, bounds = rows[drawn], np.concatenate([[0], np.cumsum(drawn)])[bounds]
        for first, last in split_into_blocks(bounds):
            time_ns, start = available_ns[first:last], bounds[first : last + 1] - bounds[first]
            available_s = np.repeat((time_ns - self._t0_ns) * 1e-9, np.diff(start))
            yield from self._encode(self._ellipses(rows[bounds[first] : bounds[last]], available_s), time_ns, start)

    def _ellipses(self, rows: Int, available_s: Float) -> Ellipses:
        fused = self._fused_tracks.fused
        age_s = np.fmax(0.0, available_s - self._fused_tracks.captured_s[0, rows])
        return Ellipses(
            names=[self._names[k] for k in self._name[rows].tolist()],
            ages=[f"{age:.3f}" if math.isfinite(age) else "" for age in age_s.tolist()],
            x_m=fused.x_m[0, rows],
            y_m=fused.y_m[0, rows],
            z_m=fused.z_m[0, rows] - fused.height_m[0, rows] / 2,  # on the ground
            yaw_rad=self._yaw_rad[rows],
            length_m=2 * SIGMAS * self._major[rows],
            width_m=2 * SIGMAS * self._minor[rows],
            alpha=FRESH_ALPHA + (OLDEST_ALPHA - FRESH_ALPHA) * np.minimum(age_s / FADES_S, 1.0),
            colour=self._colour,
        )


def principal_axes(ee: Float, en: Float, nn: Float) -> tuple[Float, Float, Float]:
    """(P,) standard deviations along the major and the minor axis, and the angle of the major one from east, rad."""
    middle, half = (ee + nn) / 2, np.hypot((ee - nn) / 2, en)
    return np.sqrt(middle + half), np.sqrt(np.maximum(middle - half, 0.0)), np.arctan2(2 * en, ee - nn) / 2


# Scenes in protobuf.

FOXGLOVE_SCENE_SCHEMA = "foxglove.SceneUpdate"
FRAME_ID = "global"
"""Name of the world frame in the OSI converters of these viewers."""
ALPHA = 0.5
"""Opacity of boxes: what is inside stays visible."""


def load_scene_class() -> Any:
    """The SceneUpdate class, imported when first needed."""
    from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

    return SceneUpdate


class FoxgloveSceneWriter:
    """Turns the fused lists of one run (values (1, P)) into messages, many lists at once."""

    def __init__(
        self, scene: Scene, fused_tracks: FusedTracks, configuration: str, colour: Rgb, frame_id: str = FRAME_ID
    ) -> None:
        self._fused, self._rows, self._frame_id = fused_tracks.fused, fused_tracks.listed_rows, frame_id
        names, self._name = fused_tracks.names_of(scene)
        self._names = TextPool.of([name.encode() for name in names])
        # The metadata of boxes are encoded once for every pair of name and class.
        keys, self._key = np.unique(self._name * len(CLASSES) + fused_tracks.class_of(scene), return_inverse=True)
        pairs = (divmod(key, len(CLASSES)) for key in keys.tolist())
        self._says = TextPool.of(
            [_encode_metadata(box_metadata(names[name], kind, configuration)) for name, kind in pairs]
        )
        shades = zip("rgb", colour, strict=True)
        self._colour: Content = {**{shade: c / 255 for shade, c in shades}, "a": ALPHA}

    def messages(self, available_ns: Int) -> Iterator[bytes]:
        """The lists as they became available at these instants of the log's clock, (F,)."""
        for first, last in split_into_blocks(self._rows[1]):
            bounds = self._rows[1][first : last + 1]
            rows = self._rows[0][bounds[0] : bounds[-1]]
            entities: Content = {
                "id": self._names.at(self._name[rows]),
                "metadata": self._says.at(self._key[rows]),
                "cubes": RepeatedMessages(np.arange(len(rows) + 1), self._cubes(rows)),
            }
            yield from encode_updates(available_ns[first:last], bounds - bounds[0], entities, self._frame_id)

    def _cubes(self, rows: Int) -> Content:
        x, y, z, length, width, height, yaw = (
            getattr(self._fused, name)[0, rows]
            for name in ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad")
        )
        pose: Content = {"position": {"x": x, "y": y, "z": z}, "orientation": encode_orientation(yaw)}
        return {"pose": pose, "size": {"x": length, "y": width, "z": height}, "color": self._colour}


def encode_orientation(yaw_rad: Float) -> Content:
    """The quaternion of a turn about the vertical."""
    return {"z": np.sin(yaw_rad / 2), "w": np.cos(yaw_rad / 2)}


def encode_updates(time_ns: Int, start: Int, entities: Content, frame_id: str) -> list[bytes]:
    """Messages that delete all on their topic; message k draws the entities `start[k]:start[k + 1]`."""
    rows = int(start[-1])
    deletion: Content = {"timestamp": _encode_stamp(time_ns), "type": 1}  # ALL
    drawn: Content = {
        "timestamp": _encode_stamp(np.repeat(time_ns, np.diff(start))),
        "frame_id": repeat_text(frame_id.encode(), rows),
        **entities,
    }
    content: Content = {
        "deletions": RepeatedMessages(np.arange(len(time_ns) + 1), deletion),
        "entities": RepeatedMessages(start, drawn),
    }
    return encode_messages(load_scene_class().DESCRIPTOR, content, len(time_ns))


def encode_ellipses(drawn: Ellipses, time_ns: Int, start: Int, frame_id: str) -> list[bytes]:
    """Messages of ellipses; message k draws the ellipses `start[k]:start[k + 1]`."""
    rows = np.arange(len(drawn.names) + 1)
    ages = [age.encode() for age in drawn.ages if age]
    age: Content = {"key": repeat_text(b"age_s", len(ages)), "value": TextPool.of(ages).at(np.arange(len(ages)))}
    red, green, blue = drawn.colour
    cylinder: Content = {
        "pose": {
            "position": {"x": drawn.x_m, "y": drawn.y_m, "z": drawn.z_m},
            "orientation": encode_orientation(drawn.yaw_rad),
        },
        "size": {"x": drawn.length_m, "y": drawn.width_m, "z": drawn.height_m},
        "bottom_scale": 1.0,
        "top_scale": 1.0,
        "color": {"r": red, "g": green, "b": blue, "a": drawn.alpha},
    }
    entities: Content = {
        "id": TextPool.of([name.encode() for name in drawn.names]).at(rows[:-1]),
        "metadata": optional_message(np.array([age != "" for age in drawn.ages], dtype=bool), age),
        "cylinders": RepeatedMessages(rows, cylinder),
    }
    return encode_updates(time_ns, start, entities, frame_id)


def _encode_stamp(time_ns: Int) -> Content:
    seconds, nanos = np.divmod(time_ns, 1_000_000_000)
    return {"seconds": seconds, "nanos": nanos}


def box_metadata(name: str, class_ix: int, configuration: str) -> dict[str, str]:
    """The metadata of a box, which a viewer shows for a selected box."""
    return {"configuration": configuration, "class": CLASSES[class_ix], "object": name}


def _encode_metadata(metadata: Mapping[str, str]) -> bytes:
    """Metadata as encoded fields of a SceneEntity."""
    from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity

    entity = SceneEntity()
    for key, text in metadata.items():
        entity.metadata.add(key=key, value=text)
    encoded: bytes = entity.SerializeToString(deterministic=True)
    return encoded


def encode_scene(entities: Sequence[Entity], time_ns: int, frame_id: str) -> bytes:
    """A message that deletes all on its topic and draws entities."""
    from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion

    update = load_scene_class()()
    deletion = update.deletions.add()
    deletion.type = SceneEntityDeletion.ALL
    deletion.timestamp.FromNanoseconds(time_ns)
    for each in entities:
        entity = update.entities.add(frame_id=frame_id, id=each.name)
        entity.timestamp.CopyFrom(deletion.timestamp)
        for key, value in each.says.items():
            entity.metadata.add(key=key, value=value)
        for ellipse in each.ellipses:
            element = entity.cylinders.add(bottom_scale=1.0, top_scale=1.0)
            element.size.x, element.size.y, element.size.z = ellipse.size
            _place_primitive(element, each.pose, ellipse.colour)
        for line in each.lines:
            element = entity.lines.add(thickness=line.width, scale_invariant=True)
            for x, y, z in line.points:
                element.points.add(x=x, y=y, z=z)
            _place_primitive(element, each.pose, line.colour)
        for text in each.texts:
            element = entity.texts.add(billboard=True, font_size=text.size, scale_invariant=True, text=text.text)
            _place_primitive(element, text.place(each.pose), text.colour)
    encoded: bytes = update.SerializeToString(deterministic=True)
    return encoded


def encode_moving(moving: MovingEntities, frame_id: str) -> Iterator[bytes]:
    """A message for each frame, as `encode_scene` gives it, many at once."""
    looks = _EncodedLooks(moving.looks)
    for first, last in split_into_blocks(moving.start):
        bounds = moving.start[first : last + 1]
        entities = looks.content(moving, slice(bounds[0], bounds[-1]))
        yield from encode_updates(moving.time_ns[first:last], bounds - bounds[0], entities, frame_id)


class _EncodedLooks:
    """What entities look like, encoded once; elements of all looks are numbered, (E,)."""

    def __init__(self, looks: Sequence[Entity]) -> None:
        self._names = TextPool.of([look.name.encode() for look in looks])
        self._says = TextPool.of([_encode_metadata(look.says) for look in looks])
        self._first = {
            kind: start_offsets(np.array([len(getattr(look, kind)) for look in looks], dtype=np.int64))
            for kind in _ELEMENTS
        }
        self._lines = [line for look in looks for line in look.lines]
        self._texts = [text for look in looks for text in look.texts]
        self._ellipses = [ellipse for look in looks for ellipse in look.ellipses]
        self._points = TextPool.of([_encode_points(line.points) for line in self._lines])
        self._words = TextPool.of([text.text.encode() for text in self._texts])

    def content(self, moving: MovingEntities, rows: slice) -> Content:
        """The entities of some rows (P,)."""
        look = moving.look_ix[rows]
        (lines, line, of_line), (texts, text, of_text), (ellipses, ellipse, of_ellipse) = (
            self._list_elements(kind, look) for kind in _ELEMENTS
        )
        columns = [getattr(moving, name)[rows] for name in ("x_m", "y_m", "z_m", "yaw_rad")]
        above = _column([each.above_m for each in self._texts])
        x, y, z, _ = (column[of_text] for column in columns)
        for step in range(above.shape[1]):
            z = z + above[text, step]
        size = _column([each.size for each in self._ellipses])
        return {
            "id": self._names.at(look),
            "metadata": self._says.at(look),
            "lines": RepeatedMessages(lines, {
                "pose": _encode_pose(*(column[of_line] for column in columns)),
                "thickness": _column([[each.width] for each in self._lines])[line, 0], "scale_invariant": 1,
                "points": self._points.at(line), "color": _encode_colours(self._lines, line),
            }),
            "texts": RepeatedMessages(texts, {
                "pose": _encode_pose(x, y, z, np.zeros(len(x))), "billboard": 1,
                "font_size": _column([[each.size] for each in self._texts])[text, 0], "scale_invariant": 1,
                "color": _encode_colours(self._texts, text), "text": self._words.at(text),
            }),
            "cylinders": RepeatedMessages(ellipses, {
                "pose": _encode_pose(*(column[of_ellipse] for column in columns)),
                "size": {axis: size[ellipse, k] for k, axis in enumerate("xyz")},
                "bottom_scale": 1.0, "top_scale": 1.0, "color": _encode_colours(self._ellipses, ellipse),
            }),
        }  # fmt: skip

    def _list_elements(self, kind: str, look: Int) -> tuple[Int, Int, Int]:
        """(P + 1,) the first element of each row, which elements these are, and of which row."""
        start, elements = expand_ranges(self._first[kind], look)
        return start, elements, np.repeat(np.arange(len(look)), np.diff(start))


_ELEMENTS = ("lines", "texts", "ellipses")


def _column(values: Sequence[Sequence[float]]) -> Float:
    """(E, K) numbers of elements, 0 where one has fewer."""
    table = np.zeros((len(values), max(map(len, values), default=3)))
    for k, numbers in enumerate(values):
        table[k, : len(numbers)] = numbers
    return table


def _encode_colours(elements: Sequence[Line | Text | Ellipse], which: Int) -> Content:
    colours = np.array([element.colour for element in elements], dtype=float).reshape(-1, 4)
    return {shade: colours[which, k] for k, shade in enumerate("rgba")}


def _encode_pose(x_m: Float, y_m: Float, z_m: Float, yaw_rad: Float) -> Content:
    return {"position": {"x": x_m, "y": y_m, "z": z_m}, "orientation": encode_orientation(yaw_rad)}


def _encode_points(points: Sequence[Place]) -> bytes:
    """The points of a line as encoded fields of a LinePrimitive."""
    from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive

    line = LinePrimitive()
    for x, y, z in points:
        line.points.add(x=x, y=y, z=z)
    encoded: bytes = line.SerializeToString(deterministic=True)
    return encoded


def load_transform_class() -> Any:
    """The FrameTransform class, imported when first needed."""
    from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform

    return FrameTransform


def encode_transform(parent: str, pose: Pose, time_ns: int, child: str) -> bytes:
    """The pose of the frame `child` in the frame `parent`: foxglove.FrameTransform."""
    transform = load_transform_class()(parent_frame_id=parent, child_frame_id=child)
    transform.timestamp.FromNanoseconds(time_ns)
    transform.translation.x, transform.translation.y, transform.translation.z = pose.x_m, pose.y_m, pose.z_m
    transform.rotation.z, transform.rotation.w = math.sin(pose.yaw_rad / 2), math.cos(pose.yaw_rad / 2)
    encoded: bytes = transform.SerializeToString(deterministic=True)
    return encoded


def _place_primitive(primitive: Any, pose: Pose, colour: tuple[float, float, float, float]) -> None:
    position, orientation, color = primitive.pose.position, primitive.pose.orientation, primitive.color
    position.x, position.y, position.z = pose.x_m, pose.y_m, pose.z_m
    orientation.z, orientation.w = math.sin(pose.yaw_rad / 2), math.cos(pose.yaw_rad / 2)
    color.r, color.g, color.b, color.a = colour

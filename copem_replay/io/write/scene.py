"""Scenes for Foxglove and Lichtblick: boxes of fused lists, ellipses of uncertainty, and the truth.

They are said once, as content of foxglove.SceneUpdate, whose fields protobuf and ROS 2 have in common; `Draw` makes
messages of a family of it. Every message deletes all that was on its topic and draws anew, so playback shows the right
boxes after a seek and nothing accumulates (entities replace by id and live until deleted).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Sized
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeAlias

import numpy as np

from copem_replay.core.colours import Rgb
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import CLASSES, Float, Int, Scene
from copem_replay.io.encodings.column_bytes import (
    Content,
    Instants,
    MessagePool,
    RepeatedMessages,
    TextPool,
    expand_ranges,
    optional_message,
    repeat_text,
    split_into_blocks,
    start_offsets,
)

# Elements of scenes besides boxes, for any encoding.

Rgba: TypeAlias = tuple[float, float, float, float]
Place: TypeAlias = tuple[float, float, float]


class Pose(NamedTuple):
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

    @classmethod
    def at(cls, time_ns: int, entities: Sequence[Entity]) -> MovingEntities:
        """One frame of entities at their poses."""
        poses = np.array([each.pose for each in entities]).reshape(-1, 4)
        rows = len(entities)
        return cls(entities, np.array([time_ns]), np.array([0, rows]), np.arange(rows), *poses.T)


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
DISC_M = 0.02
"""Height of an ellipse."""


class UncertaintyWriter:
    """Turns the fused lists of one run (values (1, P)) into scenes of ellipses, many lists at once."""

    def __init__(self, scene: Scene, fused_tracks: FusedTracks, colour: Rgb, draw: Draw) -> None:
        self._t0_ns, self._fused_tracks, self._draw, self._colour = scene.t0_ns, fused_tracks, draw, colour
        fused, rows = fused_tracks.fused, len(fused_tracks.fused.frame_ix)
        ee, en, nn = (
            np.zeros(rows) if c is None else np.asarray(c[0], dtype=float)
            for c in (fused.cov_ee_m2, fused.cov_en_m2, fused.cov_nn_m2)
        )
        self._major, self._minor, self._yaw_rad = principal_axes(ee, en, nn)
        names, self._name = fused_tracks.names_of(scene)
        self._names = TextPool.of(names)

    def messages(self, available_ns: Int) -> Iterator[bytes]:
        """The lists as they became available at these instants of the log's clock, (F,)."""
        rows, bounds = self._fused_tracks.listed_rows
        drawn = self._major[rows] >= SMALLEST_M  # neither the truth, nor lists that state no covariance
        rows, bounds = rows[drawn], np.concatenate([[0], np.cumsum(drawn)])[bounds]
        for first, last in split_into_blocks(bounds):
            time_ns, start = available_ns[first:last], bounds[first : last + 1] - bounds[first]
            available_s = np.repeat((time_ns - self._t0_ns) * 1e-9, np.diff(start))
            yield from self._draw(time_ns, start, self._ellipses(rows[bounds[first] : bounds[last]], available_s))

    def _ellipses(self, rows: Int, available_s: Float) -> Content:
        """Discs that show the uncertainty of entries, paler with age, as content of foxglove.SceneUpdate."""
        fused = self._fused_tracks.fused
        age_s = np.fmax(0.0, available_s - self._fused_tracks.captured_s[0, rows])
        has_age = np.isfinite(age_s)
        ages = TextPool.of([f"{age:.3f}" for age in age_s[has_age].tolist()])
        x, y, z, height = (getattr(fused, name)[0, rows] for name in ("x_m", "y_m", "z_m", "height_m"))
        alpha = FRESH_ALPHA + (OLDEST_ALPHA - FRESH_ALPHA) * np.minimum(age_s / FADES_S, 1.0)
        cylinder: Content = {
            "pose": pose_content(x, y, z - height / 2, self._yaw_rad[rows]),  # on the ground
            "size": {"x": 2 * SIGMAS * self._major[rows], "y": 2 * SIGMAS * self._minor[rows], "z": DISC_M},
            "bottom_scale": 1.0,
            "top_scale": 1.0,
            "color": shade_content(self._colour, alpha),
        }
        return {
            "id": self._names.at(self._name[rows]),
            "metadata": optional_message(
                has_age, {"key": repeat_text(b"age_s", int(has_age.sum())), "value": ages.at(np.arange(has_age.sum()))}
            ),
            "cylinders": RepeatedMessages(np.arange(len(rows) + 1), cylinder),
        }


def principal_axes(ee: Float, en: Float, nn: Float) -> tuple[Float, Float, Float]:
    """(P,) standard deviations along the major and the minor axis, and the angle of the major one from east, rad."""
    middle, half = (ee + nn) / 2, np.hypot((ee - nn) / 2, en)
    return np.sqrt(middle + half), np.sqrt(np.maximum(middle - half, 0.0)), np.arctan2(2 * en, ee - nn) / 2


# Content of scenes.

FRAME_ID = "global"
"""Name of the world frame in the OSI converters of these viewers."""
ALPHA = 0.5
"""Opacity of boxes: what is inside stays visible."""

Encode: TypeAlias = Callable[[Content, int], list[bytes]]
"""Makes messages of one type from their content, in K rows."""
Draw: TypeAlias = Callable[[Int, Int, Content], list[bytes]]
"""Makes K scenes of all entities, from the instants (K,) and the first entity of each instant (K + 1,)."""


def draw_scenes(encode: Encode, frame_id: str, time_ns: Int, start: Int, entities: Content) -> list[bytes]:
    """`Draw` in a frame of reference: messages that delete all on their topic and draw anew."""
    drawn: Content = {
        "timestamp": Instants(np.repeat(time_ns, np.diff(start))),
        "frame_id": repeat_text(frame_id, int(start[-1])),
        **entities,
    }
    deletion: Content = {"timestamp": Instants(time_ns), "type": 1}  # ALL
    content: Content = {
        "deletions": RepeatedMessages(np.arange(len(time_ns) + 1), deletion),
        "entities": RepeatedMessages(start, drawn),
    }
    return encode(content, len(time_ns))


def pose_content(x_m: Float, y_m: Float, z_m: Float, yaw_rad: Float) -> Content:
    """Places, and turns about the vertical as quaternions."""
    turn: Content = {"z": np.sin(yaw_rad / 2), "w": np.cos(yaw_rad / 2)}
    return {"position": {"x": x_m, "y": y_m, "z": z_m}, "orientation": turn}


def shade_content(colour: Rgb, alpha: float | Float) -> Content:
    """A colour."""
    red, green, blue = colour
    return {"r": red / 255, "g": green / 255, "b": blue / 255, "a": alpha}


def _pool_metadata(metadata: Sequence[Mapping[str, str]]) -> MessagePool:
    """The metadata of entities, to choose from."""
    pairs = [pair for each in metadata for pair in each.items()]
    keys, values = (TextPool.of([pair[k] for pair in pairs]).at(np.arange(len(pairs))) for k in (0, 1))
    return MessagePool(start_offsets(_count(metadata)), {"key": keys, "value": values})


def _count(groups: Sequence[Sized]) -> Int:
    return np.array([len(group) for group in groups], dtype=np.int64)


class BoxWriter:
    """Turns the fused lists of one run (values (1, P)) into scenes of boxes, many lists at once."""

    def __init__(self, scene: Scene, fused_tracks: FusedTracks, configuration: str, colour: Rgb, draw: Draw) -> None:
        self._fused, self._rows, self._draw = fused_tracks.fused, fused_tracks.listed_rows, draw
        names, self._name = fused_tracks.names_of(scene)
        self._names = TextPool.of(names)
        # Each pair of a name and a class has metadata, which a viewer shows for a selected box.
        keys, self._key = np.unique(self._name * len(CLASSES) + fused_tracks.class_of(scene), return_inverse=True)
        pairs = (divmod(key, len(CLASSES)) for key in keys.tolist())
        self._says = _pool_metadata(
            [{"configuration": configuration, "class": CLASSES[kind], "object": names[name]} for name, kind in pairs]
        )
        self._colour = shade_content(colour, ALPHA)

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
            yield from self._draw(available_ns[first:last], bounds - bounds[0], entities)

    def _cubes(self, rows: Int) -> Content:
        x, y, z, length, width, height, yaw = (
            getattr(self._fused, name)[0, rows]
            for name in ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad")
        )
        size: Content = {"x": length, "y": width, "z": height}
        return {"pose": pose_content(x, y, z, yaw), "size": size, "color": self._colour}


def draw_moving(moving: MovingEntities, draw: Draw) -> Iterator[bytes]:
    """A message for each frame, many at once."""
    looks = _Looks(moving.looks)
    for first, last in split_into_blocks(moving.start):
        bounds = moving.start[first : last + 1]
        entities = looks.content(moving, slice(bounds[0], bounds[-1]))
        yield from draw(moving.time_ns[first:last], bounds - bounds[0], entities)


class _Looks:
    """What entities look like, to choose from; elements of all looks are numbered, (E,)."""

    def __init__(self, looks: Sequence[Entity]) -> None:
        self._names = TextPool.of([look.name for look in looks])
        self._says = _pool_metadata([look.says for look in looks])
        self._first = {kind: start_offsets(_count([getattr(look, kind) for look in looks])) for kind in _ELEMENTS}
        self._lines = [line for look in looks for line in look.lines]
        self._texts = [text for look in looks for text in look.texts]
        self._ellipses = [ellipse for look in looks for ellipse in look.ellipses]
        points = np.array([point for line in self._lines for point in line.points], dtype=float).reshape(-1, 3)
        first = start_offsets(_count([line.points for line in self._lines]))
        self._points = MessagePool(first, dict(zip("xyz", points.T, strict=True)))
        self._words = TextPool.of([text.text for text in self._texts])

    def content(self, moving: MovingEntities, rows: slice) -> Content:
        """The entities of some rows (P,) as content of foxglove.SceneUpdate."""
        look = moving.look_ix[rows]
        (lines, line, of_line), (texts, text, of_text), (ellipses, ellipse, of_ellipse) = (
            self._list_elements(kind, look) for kind in _ELEMENTS
        )
        columns = [getattr(moving, name)[rows] for name in ("x_m", "y_m", "z_m", "yaw_rad")]
        above_m = _column([each.above_m for each in self._texts])
        x, y, z, _ = (column[of_text] for column in columns)
        for step in range(above_m.shape[1]):
            z = z + above_m[text, step]
        size = _column([each.size for each in self._ellipses])
        return {
            "id": self._names.at(look),
            "metadata": self._says.at(look),
            "lines": RepeatedMessages(lines, {
                "pose": pose_content(*(column[of_line] for column in columns)),
                "thickness": _column([[each.width] for each in self._lines])[line, 0], "scale_invariant": 1,
                "points": self._points.at(line), "color": _encode_colours(self._lines, line),
            }),
            "texts": RepeatedMessages(texts, {
                "pose": pose_content(x, y, z, np.zeros(len(x))), "billboard": 1,
                "font_size": _column([[each.size] for each in self._texts])[text, 0], "scale_invariant": 1,
                "color": _encode_colours(self._texts, text), "text": self._words.at(text),
            }),
            "cylinders": RepeatedMessages(ellipses, {
                "pose": pose_content(*(column[of_ellipse] for column in columns)),
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


def transform_content(parent: str, child: str, poses: Sequence[Pose], time_ns: Int) -> Content:
    """The poses of the frame `child` in the frame `parent`: content of foxglove.FrameTransform."""
    placed = pose_content(*np.array(poses).reshape(-1, 4).T)
    names = {"parent_frame_id": parent, "child_frame_id": child}
    return {
        "timestamp": Instants(time_ns),
        **{key: repeat_text(name, len(poses)) for key, name in names.items()},
        "translation": placed["position"],
        "rotation": placed["orientation"],
    }

"""Cameras of the 3-D views: place, target, and what they follow: the ego or one of the shown objects."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from types import MappingProxyType

import numpy as np
import pandas as pd
import pyarrow as pa

from copem_replay.core.tracks import Float, Int
from copem_replay.experiment.schema import Experiment
from copem_replay.pipeline.prepare import Replay
from copem_replay.pipeline.status import to_nanoseconds
from copem_replay.results.shown_objects import find_followed, interpolate_places
from copem_replay.viewer.sensors import locate_unit
from copem_replay.viewer.sink import (
    WORDS_COLOUR,
    RecordingSink,
    configuration_part,
    entity_names,
    short_ids,
    stack_float32,
    upright_turns,
)

EYES = ("world", "eyes")
BESIDE_ASPECTS = 1.25, 1.7
"""Width by height of three and of two views beside each other, at least."""
TOGETHER_M = 60.0
"""Farthest unit that is in one picture with what it sees: from farther away people are a few pixels."""
NEARBY_M = 100.0
"""Extent of the ways of several objects that a standing camera holds together."""
TURNED_RAD, DOWN_RAD = np.deg2rad((65.0, 65.0))
"""Direction of view on one object, right of the ego's heading and down."""
ABOVE_RAD = np.deg2rad(78.0)
"""Downward angle of the camera on the ego and on the units: distances and fields of view are hardly foreshortened."""
EYE_RAD, MARGIN_M = np.deg2rad(55.0), 2.5
"""The viewer's vertical field of view, and room around centres: half the length of a car."""
CLOSE_M = 20.0
"""Least distance from camera to target."""
LEAST_M, WIDE_M, WIDEST_M, AHEAD_M = 36.0, 60.0, 180.0, 20.0
"""Width in view around the ego: the least one, that without a story, the greatest; how far ahead the middle is then."""
SMOOTH_S, SOON_S = 1.0, 1.5
"""Time over which turns and widths are averaged, and how long before and after a story it is in view: no jerks."""
EDGE, ARROW_NS = 0.85, 200_000_000
"""Where arrows are, as a share of the way from the middle to the edge of the picture; how often they are drawn."""
INSIDE = 0.78
"""Where bodies of a story are at most, as such a share: the words beside and below them are in the picture, too."""
EDGE_WORDS = 0.4, 0.16
"""Width and height of words such as “61 → 144 m” by half the sides of a view of the overview at 1280 × 720."""
NAMED_FALSE, BESIDE_M = 3, 2.5
"""Most false entries that a picture names, the nearest ones; how far below the middle of its cross the words are."""
LEAN = np.tan(EYE_RAD / 2 + ABOVE_RAD - np.pi / 2)
"""By how much of its height a body leans downwards at the lower edge of a picture from above: more than any other."""


@dataclass(frozen=True)
class Camera:
    """Place and target of a camera, `(3,)` each, as seen from the entity `path`.

    A camera that follows has a `path` that moves with object `object_ix`: a view with that origin shows the same
    whenever it is first drawn. If `turns`, it turns with the object, too, and zooms. `at_m`: the target in the world,
    at the onset; `heading_rad`: what is up in the picture there. `aspect`: width by height of the view.
    """

    place_m: Float
    target_m: Float
    at_m: Float
    object_ix: int | None = None
    path: tuple[str, ...] = ("world",)
    turns: bool = False
    heading_rad: float = 0.0
    aspect: float = 1.5


def camera_on_ego(
    replay: Replay, experiment: Experiment, stories: Mapping[int, tuple[float, float]], aspect: float
) -> Camera:
    """A camera from above that moves and turns with the ego, which drives to the right in the picture.

    Without an ego or a carried unit to follow, the ways of the shown objects during their stories are in view, with the
    units around them, the longer side across; without objects the whole site. `stories`: first and last second of each
    shown object's axis, by index, the most telling one first. `aspect`: width by height of a view.
    """
    truth, followed_ix = replay.truth, find_followed(replay.scene, experiment)
    if followed_ix >= 0:
        onset_s = np.array([next(iter(stories.values()), (0.0, 0.0))[0]])
        ego_state = interpolate_places(replay.scene, replay.truth, experiment, np.array([followed_ix]), onset_s)[:, 0]
        if np.isnan(ego_state[0]):
            ego_state = _own_states(replay, followed_ix)[1][:, 0]
        ahead = np.array([np.cos(ego_state[3]), np.sin(ego_state[3]), 0.0])
        place = -LEAST_M / (2 * aspect * np.tan(EYE_RAD / 2)) * _look(np.pi / 2)
        at_m = ego_state[:3] + AHEAD_M * ahead
        path = (*EYES, "ego")
        up_rad = float(ego_state[3]) + np.pi / 2
        return Camera(np.round(place, 1), np.zeros(3), at_m, followed_ix, path, True, up_rad, aspect)
    ground_m = float(truth.z_m[0].mean()) if truth.z_m.size else 0.0
    ats = [(*unit.at[:2], ground_m) for unit in experiment.units.values() if unit.at is not None]
    units, place = np.array(ats).reshape(-1, 3).T, _story_places(replay, experiment, stories)
    if place.size:
        units = units[:, (np.hypot(*(units[:2, :, None] - place[:2, None])) <= TOGETHER_M).any(axis=1)]
    else:
        place = np.stack([truth.x_m[0], truth.y_m[0], truth.z_m[0]])
    place = np.concatenate([place, units], axis=1)
    if not place.size:
        return Camera(np.array([0.0, -8.0, 37.0]), np.zeros(3), np.zeros(3), heading_rad=np.pi / 2)
    middle = (place.min(axis=1) + place.max(axis=1))[:, None] / 2
    return camera_above(middle + (place - middle) / EDGE, _longest_way_rad(place) + np.pi / 2, aspect)


def _story_places(replay: Replay, experiment: Experiment, stories: Mapping[int, tuple[float, float]]) -> Float:
    """(3, K) places of shown objects during their stories: of the first one, and of others near enough to it."""
    place = np.empty((3, 0))
    for k, (first_s, last_s) in stories.items():
        time_s = np.arange(first_s, last_s + SMOOTH_S / 4, SMOOTH_S / 4)
        own = interpolate_places(replay.scene, replay.truth, experiment, np.full(len(time_s), k), time_s)[:3]
        both = np.concatenate([place, own[:, ~np.isnan(own[0])]], axis=1)
        if both.size and (not place.size or np.ptp(both[:2], axis=1).max() <= NEARBY_M):
            place = both
    return place


@dataclass(frozen=True)
class MovingPicture:
    """The picture of a camera that follows, at instants (K,): its middle, what is ahead in its frame, and its width.

    `scale`: how many times as wide as at least. `middle`: the picture's middle as seen from what it follows, (3, K)
    ahead, left and up. `seen`: by shown object where it is in that frame; NaN while it is absent.
    """

    eye: Camera
    elapsed_ns: Int  # (K,) since the log's start
    own: Float  # (3, K) on the ground at what it follows
    yaw_rad: Float  # (K,) of its frame
    scale: Float  # (K,)
    middle: Float
    seen: Mapping[int, Float]

    def frames_at(self, elapsed_ns: Int) -> Int:
        """(R,) the newest instant (K,) at other instants (R,), as the viewer shows it; the first before it."""
        rows: Int = np.maximum(np.searchsorted(self.elapsed_ns, elapsed_ns, side="right") - 1, 0)
        return rows

    def locate(self, place_m: Float, frame: Int) -> Float:
        """(3, R) ahead, left and up of what it follows at instants `frame` (R,), of places (3, R) in the world."""
        return _turn(place_m - self.own[:, frame], -self.yaw_rad[frame])


def _turn(place: Float, by_rad: Float) -> Float:
    """Places (3, K) turned to the left."""
    cos, sin = np.cos(by_rad), np.sin(by_rad)
    return np.stack([cos * place[0] - sin * place[1], sin * place[0] + cos * place[1], place[2]])


def follow_episodes(
    replay: Replay, experiment: Experiment, eye: Camera, stories: Mapping[int, tuple[float, float]],
    masts: Mapping[int, Collection[str]] = MappingProxyType({}),
) -> MovingPicture:  # fmt: skip
    """The picture of a camera that follows: each object during its story, together with the ego and units.

    What hides an object is between them. Stories for which the picture would be wider than `WIDEST_M` are left out, the
    first ones last. `stories`: as in `camera_on_ego`; `masts`: by object, units in the picture with it; these and the
    ego are, if they are as near as `TOGETHER_M`.
    """
    assert eye.object_ix is not None
    time_s, ego_states = _own_states(replay, eye.object_ix)
    rows, zeros, ego_ix = np.arange(len(time_s)), np.zeros(len(time_s)), find_followed(replay.scene, experiment)
    yaw_rad = _smooth(time_s, np.unwrap(ego_states[3])) if eye.turns else zeros
    elapsed_ns = to_nanoseconds(time_s)
    elapsed_ns[:1] = 0  # before what it follows comes, the camera waits where it will
    picture = MovingPicture(eye, elapsed_ns, ego_states[:3], yaw_rad, zeros, np.zeros((3, len(time_s))), {})

    def locate(object_ix: int) -> Float:
        number = np.full(len(time_s), object_ix)
        return picture.locate(interpolate_places(replay.scene, replay.truth, experiment, number, time_s)[:3], rows)

    object_places = {k: locate(k) for k in stories}
    held_places = [picture.middle]
    for k, (first_s, last_s) in stories.items():
        body = _hold_ends(object_places[k])
        others = [picture.locate(locate_unit(replay, experiment, name, time_s).T, rows) for name in masts.get(k, ())]
        others += [locate(ego_ix)] if ego_ix >= 0 else []
        near = [np.where(np.hypot(*(at - body)[:2]) <= TOGETHER_M, at, np.nan) for at in others]
        now = (time_s >= first_s - SOON_S) & (time_s <= last_s + SOON_S)
        story = [np.where(now, at, np.nan) for at in (body, *near)]
        fits = _fit_picture(eye, [*held_places, *story])[1] * LEAST_M <= WIDEST_M
        held_places += [np.where(fits, at, np.nan) for at in story]
    middle, scale = _fit_picture(eye, held_places)
    if eye.turns:
        idle = np.isnan(held_places[1:]).all(axis=(0, 1)) if stories else np.ones(len(time_s), dtype=np.bool_)
        middle[0, idle], scale[idle] = AHEAD_M, WIDE_M / LEAST_M
    middle, scale = np.stack([_smooth(time_s, axis) for axis in middle]), _smooth(time_s, scale)
    return replace(picture, scale=scale, middle=middle, seen=object_places)


def _hold_ends(place: Float) -> Float:
    """Places (3, K), where absent those next in time."""
    there, every = np.flatnonzero(~np.isnan(place[0])), np.arange(place.shape[1])
    return np.stack([np.interp(every, there, axis[there]) for axis in place]) if len(there) else place


def _fit_picture(eye: Camera, places: Sequence[Float]) -> tuple[Float, Float]:
    """The middle (3, K) of a picture that holds places (3, K) each, and its scale (K,); NaN: there is no place."""
    away_m, all_places = float(np.linalg.norm(eye.place_m)), np.stack(places, axis=1)
    towards = -eye.place_m / away_m
    _, right, up = _axes(towards)
    ground_up = np.array([up[0], up[1], 0.0]) / np.hypot(up[0], up[1])
    middle = np.zeros((3, all_places.shape[2]))
    for way in (right, ground_up):
        along = np.tensordot(way, all_places, 1)
        middle += way[:, None] * (np.nanmin(along, axis=0) + np.nanmax(along, axis=0)) / 2
    offsets = ((all_places - middle[:, None]) / INSIDE).reshape(3, -1)
    needed_m = np.nanmax(_fitting_distances(offsets, towards, eye.aspect).reshape(all_places.shape[1:]), axis=0)
    return middle, np.maximum(needed_m / away_m, 1.0)


def write_moving_origin(out: RecordingSink, replay: Replay, picture: MovingPicture) -> None:
    """Write the entity that a camera follows; if it turns, an arrow for each shown object that is out of the picture.

    The origin has the picture's scale. Arrows say how far an object is from the ego: “61 → 44 m”.
    """
    import rerun as rr

    target = stack_float32(*(picture.own + _turn(picture.middle, picture.yaw_rad)))
    turn = {"rotation_axis_angle": upright_turns(picture.yaw_rad)} if picture.eye.turns else {}
    origin = rr.Transform3D.columns(translation=target, scale=stack_float32(*[picture.scale] * 3), **turn)
    out.columns(picture.eye.path, picture.elapsed_ns, origin)
    if picture.seen and picture.eye.turns:
        _write_arrows(out, replay, picture)


def _own_states(replay: Replay, object_ix: int) -> tuple[Float, Float]:
    """Instants (K,) of an object's frames, in s, and its x, y, ground and heading (4, K) then."""
    truth = replay.truth
    rows = np.flatnonzero(truth.row_object_ix == object_ix)
    ground_m = truth.z_m[0, rows] - truth.height_m[0, rows] / 2
    states = np.stack([truth.x_m[0, rows], truth.y_m[0, rows], ground_m, truth.yaw_rad[0, rows]])
    return truth.row_captured_s[rows], states


def _smooth(time_s: Float, values: Float) -> Float:
    """(K,) the mean of `values (K,)` over `SMOOTH_S` around each instant; beyond the ends they stay as they are."""
    if len(time_s) < 2:
        return values
    area = np.concatenate([[0.0], np.cumsum((values[1:] + values[:-1]) / 2 * np.diff(time_s))])

    def until(at_s: Float) -> Float:
        inside = np.interp(at_s, time_s, area)
        before, after = np.minimum(at_s - time_s[0], 0), np.maximum(at_s - time_s[-1], 0)
        return np.asarray(inside + before * values[0] + after * values[-1])

    return (until(time_s + SMOOTH_S / 2) - until(time_s - SMOOTH_S / 2)) / SMOOTH_S


def _write_arrows(out: RecordingSink, replay: Replay, picture: MovingPicture) -> None:
    """Write for each object outside the picture a name with an arrow at its edge, on the ground; farther than
    `WIDEST_M` from the ego none, as these would cover nearer ones.
    """
    place = np.stack([*picture.seen.values()], axis=1)  # (3, M, K)
    distance_m = np.hypot(place[0], place[1])
    place = place - picture.middle[:, None]
    far_out = np.abs(_project(place / picture.scale, picture.eye)).max(axis=0)
    _, step = np.unique(picture.elapsed_ns // ARROW_NS, return_index=True)
    row, m = np.nonzero((far_out[:, step].T > 1.0) & (distance_m[:, step].T <= WIDEST_M))
    picked = m, step[row]
    spots, sides = _move_to_edge(place[:, *picked] / picture.scale[step[row]], picture.eye, row)
    ids = np.array(short_ids(replay.scene), dtype=object)[np.array([*picture.seen])[m]]
    labels = [f"{name} {side} {far:.0f} m" for name, side, far in zip(ids, sides, distance_m[picked], strict=True)]
    counts = np.bincount(row, minlength=len(step))
    _write_words(out, [*picture.eye.path, "arrows"], picture.elapsed_ns[step], spots, labels, counts, 1.5)


def _move_to_edge(place: Float, eye: Camera, row: Int) -> tuple[Float, Sequence[str]]:
    """Places (3, R) outside a camera's picture moved to its edge, on the ground; arrows (R,) that say which edge. `row`
    (R,): ascending numbers of instants; words of one instant are kept apart.
    """
    across, upward = _project(place, eye)
    far_out = np.maximum(np.abs(across), np.abs(upward))
    u, v = EDGE * across / far_out, EDGE * upward / far_out
    sides = np.where(np.abs(u) >= np.abs(v), np.where(u > 0, "→", "←"), np.where(v > 0, "↑", "↓"))
    _spread_words(u, v, row)
    towards, right, up = _axes(_look(np.pi / 2))
    half_height = np.tan(EYE_RAD / 2)
    ray = towards[:, None] + u * eye.aspect * half_height * right[:, None] + v * half_height * up[:, None]
    return eye.place_m[:, None] - eye.place_m[2] / ray[2] * ray, sides.tolist()


def _spread_words(u: Float, v: Float, row: Int) -> None:
    """Move places (R,) up or down a picture, towards its middle, until their words do not lie on each other."""
    bounds = np.flatnonzero(np.diff(row, prepend=-1, append=-1)).tolist()
    for first, end in pairwise(bounds):
        placed: list[int] = []
        for k in sorted(range(first, end), key=lambda k: -abs(v[k])):
            step = -np.copysign(EDGE_WORDS[1], v[k])
            while any(abs(u[k] - u[n]) < EDGE_WORDS[0] and abs(v[k] - v[n]) < 0.99 * EDGE_WORDS[1] for n in placed):
                v[k] += step
            placed.append(k)


def _write_words(
    out: RecordingSink, path: Sequence[str], elapsed_ns: Int, spots: Float, labels: Sequence[str], counts: Int,
    points: float,
) -> None:  # fmt: skip
    """Write words at spots (3, R) of the picture, `counts` of them at each of some instants."""
    import rerun as rr

    columns = rr.Points3D.columns(positions=stack_float32(*spots), labels=pa.array(labels, pa.string()))
    out.columns(path, elapsed_ns, columns.partition(counts))
    size = rr.Radius.ui_points(points)
    out.static(path, rr.Points3D.from_fields(colors=[WORDS_COLOUR], radii=size, show_labels=True))


def write_false_words(
    out: RecordingSink, name: str, picture: MovingPicture, elapsed_ns: Int, counts: Int, place_m: Float
) -> None:
    """Write where the nearest false entries of a configuration are: “false: 24 m ahead, 6 m left” of the ego.

    `place_m`: (3, R) places of all of them in the world, `counts` of them in each list, which is available from
    `elapsed_ns` on. For those outside the picture “false → 61 m” is at its edge, up to `WIDEST_M` from the ego.
    """
    row = np.repeat(np.arange(len(counts)), counts)
    frame = picture.frames_at(elapsed_ns[row])
    place = picture.locate(place_m, frame)
    ahead_m, left_m = place[:2]
    distance_m = np.hypot(ahead_m, left_m)
    order = np.lexsort((distance_m, row))
    order = order[(np.arange(len(row)) - np.searchsorted(row, row) < NAMED_FALSE) & (distance_m[order] <= WIDEST_M)]
    spots = (place - picture.middle[:, frame])[:, order] / picture.scale[frame[order]]
    spots[1] -= BESIDE_M / picture.scale[frame[order]]
    is_outside = np.abs(_project(spots, picture.eye)).max(axis=0) > 1.0
    labels = [
        f"false: {abs(ahead):.0f} m {'ahead' if ahead >= 0 else 'behind'}, {abs(left):.0f} m "
        f"{'left' if left >= 0 else 'right'}"
        for ahead, left in zip(ahead_m[order].tolist(), left_m[order].tolist(), strict=True)
    ]
    spots[:, is_outside], sides = _move_to_edge(spots[:, is_outside], picture.eye, row[order][is_outside])
    for k, side in zip(np.flatnonzero(is_outside).tolist(), sides, strict=True):
        labels[k] = f"false {side} {distance_m[order[k]]:.0f} m"
    sizes = np.bincount(row[order], minlength=len(counts))
    _write_words(out, [*picture.eye.path, "false", configuration_part(name)], elapsed_ns, spots, labels, sizes, 0.0)


def find_up_rad(picture: MovingPicture | None, eye: Camera, elapsed_ns: Int) -> Float:
    """(R,) the heading that is up in the picture at instants (R,); `picture`: of a turning camera."""
    if picture is None:
        return np.full(len(elapsed_ns), eye.heading_rad)
    return np.asarray(picture.yaw_rad[picture.frames_at(elapsed_ns)] + np.pi / 2)


def below_bodies(body: Mapping[str, Float], up_rad: Float) -> Float:
    """(3, …) places on the ground just below bodies (…) in a picture, where words do not cover them.

    `up_rad`: the heading that is up in the picture.
    """
    turned = body["yaw_rad"] - up_rad
    half_m = (np.abs(np.cos(turned)) * body["length_m"] + np.abs(np.sin(turned)) * body["width_m"]) / 2
    away_m, ground_m = half_m + LEAN * body["height_m"], body["z_m"] - body["height_m"] / 2
    return np.stack([body["x_m"] - np.cos(up_rad) * away_m, body["y_m"] - np.sin(up_rad) * away_m, ground_m])


def camera_following(
    replay: Replay, experiment: Experiment, table: pd.DataFrame, object_ix: int, aspect: float
) -> Camera:
    """A camera that follows an object of the table, from the left of the ego's way at the onset: it runs across."""
    scene, followed_ix = replay.scene, find_followed(replay.scene, experiment)
    onset_s = table["onset_s"][table["object_id"] == scene.object_ids[object_ix]].to_numpy(dtype=float)[:1]
    both = np.array([object_ix, max(followed_ix, 0)]), np.repeat(onset_s, 2)
    target, ego_place = interpolate_places(scene, replay.truth, experiment, *both).T
    up_rad = (float(ego_place[3]) if followed_ix >= 0 and not np.isnan(ego_place[0]) else 0.0) - TURNED_RAD
    place = np.round(-CLOSE_M * _look(up_rad, DOWN_RAD), 1)
    path = (*EYES, entity_names(scene)[object_ix])
    return Camera(place, np.zeros(3), np.nan_to_num(target[:3]), object_ix, path, False, up_rad, aspect)


def camera_above(places_m: Float, heading_rad: float, aspect: float = 1.5) -> Camera:
    """A camera that looks down on places (3, K), in a direction that is up in the picture; it follows nothing."""
    towards, right, _ = _axes(_look(heading_rad))
    forward = np.array([np.cos(heading_rad), np.sin(heading_rad), 0.0])
    middle = [(way @ places_m).min() / 2 + (way @ places_m).max() / 2 for way in (right, forward)]
    target = middle[0] * right + middle[1] * forward + [0.0, 0.0, places_m[2].mean()]
    away_m = max(float(_fitting_distances(places_m - target[:, None], towards, aspect).max()), CLOSE_M)
    place = np.round(target - away_m * towards, 1)
    return Camera(place, np.round(target, 1), target, heading_rad=heading_rad, aspect=aspect)


def _look(heading_rad: float, down_rad: float = ABOVE_RAD) -> Float:
    """(3,) the direction of view with a heading that is up in the picture, downwards by an angle."""
    towards = np.array([np.cos(heading_rad), np.sin(heading_rad), -np.tan(down_rad)])
    return np.asarray(towards / np.linalg.norm(towards))


def _axes(towards: Float) -> tuple[Float, Float, Float]:
    """(3,) each: a direction of view, and what is right and up in its picture."""
    right = np.array([towards[1], -towards[0], 0.0]) / np.hypot(*towards[:2])
    return towards, right, np.cross(right, towards)


def _project(place_m: Float, eye: Camera) -> Float:
    """(2, …) where places (3, …) relative to the target of a turning camera are in its picture, −1 … 1: across, up."""
    towards, right, up = (np.tensordot(axis, place_m, 1) for axis in _axes(_look(np.pi / 2)))
    depth_m = np.maximum(np.linalg.norm(eye.place_m) + towards, 1.0) * np.tan(EYE_RAD / 2)
    return np.stack([right / (depth_m * eye.aspect), up / depth_m])


def _fitting_distances(place_m: Float, towards: Float, aspect: float) -> Float:
    """(K,) least distance from the target from which each place (3, K), relative to it, is in the picture."""
    _, right, up = _axes(towards)
    beside = (np.abs(right @ place_m) + MARGIN_M) / (aspect * np.tan(EYE_RAD / 2))
    above = (np.abs(up @ place_m) + MARGIN_M) / np.tan(EYE_RAD / 2)
    needed: Float = np.maximum(beside, above) - towards @ place_m
    return needed


def _longest_way_rad(place_m: Float) -> float:
    """The direction in which places (3, K) are farthest apart, −90° to 90°."""
    east, north = place_m[:2] - place_m[:2].mean(axis=1, keepdims=True)
    return float(np.arctan2(2 * (east * north).sum(), (east**2 - north**2).sum()) / 2)

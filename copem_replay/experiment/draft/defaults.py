"""What an experiment on a recording could be: the ego, the measured objects, the place of a mast.

Guesses from what is in the log, to begin with; each says why.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.errors import RecordingError
from copem_replay.core.tracks import CLASSES, Bool, Float, Int, Scene, Tracks, class_indices
from copem_replay.experiment.draft.findings import Mast, Suggestion
from copem_replay.io.channel import schema_name
from copem_replay.io.log import BrokenIndexError, Log
from copem_replay.io.recording import Recording, foreign, read
from copem_replay.io.schemas.pose_schemas import ODOMETRY, is_pose

if TYPE_CHECKING:
    from copem_replay.io.schemas.description import Fields

RANGE_M = 50.0
"""Nearer than this to the ego an object is measured: the default of the onset `in_range`."""
MAST_M = 10.0
"""So far from the busiest place the mast stands (chosen: beside the lane, not on it)."""
_CELL_M = 10.0  # the busiest place is sought on a grid (chosen)
_MOVED_M = 10.0  # an object that moved less is parked, or nearly (chosen)
_MOSTLY = 0.75  # the share of a log that an ego is there (chosen: what records a log is there from beginning to end)
_ROWS = 100_000  # object states looked at for a place of the mast (chosen: a sample says it as well)
_DRIVEN = ("car", "van", "truck", "bus", "vehicle", "motorcycle")
_FRAMES = ("base_link", "base_footprint", "ego_vehicle", "ego", "vehicle")  # as drivers name the vehicle's own


def suggestion(log: Log, recording: Recording, fields: Fields | None = None) -> Suggestion:
    """Guess what an experiment on a recording could be."""
    ego, why, recording = _ego(log, recording, fields)
    scene, truth = recording.scene, recording.truth
    objects = truth.row_object_ix
    number = scene.ego_ix if ego is None or isinstance(ego, dict) else scene.object_number.get(ego, -1)
    classes, onset, rows = _measured(scene, truth, number)
    if not len(rows):
        rows = np.arange(len(objects))
    return Suggestion(ego, why, classes, onset, _masts(truth, rows, objects))


def _ego(log: Log, recording: Recording, fields: Fields | None) -> tuple[str | dict[str, str] | None, str, Recording]:
    """The ego as an experiment has it, why, and the recording with it."""
    scene = recording.scene
    if recording.around is not None and recording.around.ego is not None:
        found = _poses(log)
        if found:
            return {"topic": found[0]["topic"]}, "the only odometry of the log", recording
    if scene.ego_ix >= 0:
        ident = scene.object_ids[scene.ego_ix]
        return None, f"the log names its host vehicle: {ident} ({CLASSES[scene.object_class[scene.ego_ix]]})", recording
    host = recording.host_id
    none = "the log names no host vehicle" if host is None else f"the log's host vehicle {host} is no moving object"
    for place in _poses(log):
        from copem_replay.io.config import EgoTopic

        try:
            asked = EgoTopic.model_validate(place)
            again = read(log, name=scene.log, topic=recording.topic, fields=fields, ego=asked)
        except (RecordingError, BrokenIndexError):
            continue
        if again.scene.ego_ix >= 0:
            return place, f"{none}; these poses may be the ego's", again
    ident, why = _longest(scene, recording.truth)
    return ident, f"{none}; {why}", recording


def _poses(log: Log) -> list[dict[str, str]]:
    """Where the ego's poses may be, as `ego:` names it: odometry first, transforms last."""
    if not foreign(log):
        return []
    from copem_replay.io.encodings.raw_values import DefinitionError
    from copem_replay.io.messages import gathered
    from copem_replay.io.schemas.poses import poses_of

    found: list[tuple[int, dict[str, str]]] = []
    for channel in foreign(log):
        if not is_pose(channel) or channel.topic.endswith("tf_static"):
            continue
        if schema_name(channel) == ODOMETRY:
            found.append((0, {"topic": channel.topic}))
            continue
        try:
            messages = gathered(log, frozenset([channel.number]))
            times = np.array(messages.log_time_ns[channel.number], dtype=np.int64)
            poses = poses_of(channel, messages.payloads[channel.number], times)
        except (DefinitionError, KeyError, BrokenIndexError):
            continue
        if len(set(poses.stamp_ns.tolist())) < 2:  # a place, not a way
            continue
        frames = {name.lstrip("/") for name in poses.child}
        base = next((name for name in _FRAMES if name in frames), None)
        if frames == {""}:
            found.append((1, {"topic": channel.topic}))
        elif base is not None:
            found.append((2, {"topic": channel.topic, "frame": base}))
    return [place for _, place in sorted(found, key=lambda pair: pair[0])]


def _longest(scene: Scene, truth: Tracks) -> tuple[str, str]:
    """The vehicle that is there longest of those that drive, and why; "none" where nothing else would be measured.

    Nor is it taken where it is there for a part of the log only: what stands beside the road has recorded that.
    """
    objects, count = truth.row_object_ix, len(scene.object_ids)
    first, last = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(first, objects, truth.row_captured_s)
    np.maximum.at(last, objects, truth.row_captured_s)
    extent = np.zeros((2, count))
    for k, values in enumerate((truth.x_m[0], truth.y_m[0])):
        low, high = np.full(count, np.inf), np.full(count, -np.inf)
        np.minimum.at(low, objects, values)
        np.maximum.at(high, objects, values)
        extent[k] = high - low
    moved = np.hypot(*extent)
    drives = scene.moving & np.isin(scene.object_class, class_indices(_DRIVEN))
    if not drives.any():
        return "none", "there is no vehicle to be the ego"
    if scene.moving.sum() < 2:
        return "none", f"{scene.object_ids[int(drives.argmax())]}, the only one that moves, is measured"
    best = max(np.flatnonzero(drives), key=lambda k: (moved[k] >= _MOVED_M, last[k] - first[k], moved[k]))
    longest = (
        f"of the vehicles that drive, {scene.object_ids[best]} ({CLASSES[scene.object_class[best]]}) "
        f"is there longest, {first[best]:.1f} – {last[best]:.1f} s"
    )
    if last[best] - first[best] < _MOSTLY * scene.end_s:
        return "none", f"{longest} of {scene.end_s:.1f} s, and an ego is there nearly all the time"
    return scene.object_ids[best], longest


def _measured(scene: Scene, truth: Tracks, ego_ix: int) -> tuple[list[str] | None, str, Int]:
    """Who is measured, from when, and the rows of them: vulnerable road users near the ego, else vehicles, else all."""
    objects = truth.row_object_ix
    near = _near(truth, objects, ego_ix)
    others = scene.moving[objects] & (objects != ego_ix)
    kinds = scene.object_class[objects]
    groups: list[tuple[list[str] | None, Bool]] = [
        ([name], others & np.isin(kinds, class_indices((name,)))) for name in ("vru", "vehicles")
    ]
    groups.append((None, others))
    for onset, there in (("in_range", near), ("appears", np.ones_like(near))):
        for classes, which in groups:
            if (rows := np.flatnonzero(which & there)).size:
                return classes, onset, rows
    return None, "in_range", np.flatnonzero(others)


def _near(truth: Tracks, objects: Int, ego_ix: int) -> Bool:
    """(P,) whether a row is in range of the ego; without an ego all are."""
    if ego_ix < 0:
        return np.ones(len(objects), dtype=bool)
    x, y = np.full(len(truth.stamp_ns), np.nan), np.full(len(truth.stamp_ns), np.nan)
    mine = np.flatnonzero(objects == ego_ix)
    x[truth.frame_ix[mine]], y[truth.frame_ix[mine]] = truth.x_m[0, mine], truth.y_m[0, mine]
    away = np.hypot(truth.x_m[0] - x[truth.frame_ix], truth.y_m[0] - y[truth.frame_ix])
    return np.asarray(away <= RANGE_M)  # NaN, the ego is not there: no


def _masts(truth: Tracks, rows: Int, objects: Int) -> list[Mast]:
    """Two places that face each other across where most measured objects come by, the one farther from all first."""
    rows = rows[:: max(1, len(rows) // _ROWS)]
    x, y = truth.x_m[0, rows], truth.y_m[0, rows]
    cells = np.stack([np.floor(x / _CELL_M), np.floor(y / _CELL_M)], axis=1)
    visits = np.unique(np.column_stack([cells, objects[rows]]), axis=0)
    places, counts = np.unique(visits[:, :2], axis=0, return_counts=True)
    busiest = places[counts == counts.max()]
    middle = np.array([np.median(x), np.median(y)])
    inside = (cells == busiest[np.hypot(*((busiest + 0.5) * _CELL_M - middle).T).argmin()]).all(axis=1)
    centre = np.array([x[inside].mean(), y[inside].mean()])
    step = max(1, len(truth.x_m[0]) // _ROWS)
    everyone = np.stack([truth.x_m[0, ::step], truth.y_m[0, ::step]], axis=1)
    turns = np.deg2rad(np.arange(0, 360, 45))
    around = [centre + MAST_M * np.array([np.cos(t), np.sin(t)]) for t in turns]
    free = [float(np.hypot(*(everyone - place).T).min()) for place in around]
    best = int(np.argmax(np.round(free, 3)))
    return [_mast(centre, float(turns[(best + more) % 8])) for more in (0, 4)]


def _mast(centre: Float, turn: float) -> Mast:
    at = centre + MAST_M * np.array([np.cos(turn), np.sin(turn)])
    facing = round(np.rad2deg(turn)) - 180
    return Mast([round(float(v), 1) for v in at], facing + 360 if facing <= -180 else facing)

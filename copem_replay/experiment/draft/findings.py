"""The findings of a survey of a recording, as plain values in the order of the JSON; and the experiment they suggest.

Suggestions (the ego, the measured objects, the place of a mast) are guesses from the content of the log, with reasons.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from copem_replay.core.errors import RecordingError
from copem_replay.core.tracks import CLASSES, Bool, Float, Int, Scene, Tracks, class_indices
from copem_replay.io.channel import schema_name
from copem_replay.io.log import BrokenIndexError, Log
from copem_replay.io.recording import Recording, foreign_channels, read_log
from copem_replay.io.schemas.poses import ODOMETRY, is_pose, is_static

if TYPE_CHECKING:
    from copem_replay.io.schemas.description import Fields


Role = Literal["truth", "unit", "poses", "map", "unread"]


@dataclass(frozen=True)
class TopicFound:
    """A channel, and its role in a replay."""

    topic: str
    schema: str
    encoding: str
    messages: int
    role: Role


@dataclass(frozen=True)
class UnitFound:
    """The recorded lists of one unit. `problem`: why they cannot be read, None where they can."""

    topic: str
    lists: int = 0
    entries: int = 0
    rate_hz: float | None = None  # median
    covariances_said: bool = False  # whether by every entry
    captures_said: bool = False  # whether by every list
    velocities_said: bool = True  # whether by any entry
    problem: str | None = None
    delay_s: float | None = None  # by the best fit to the truth, of lists that do not state their capture
    delay_interval_s: list[float] | None = None  # 95 %
    delay: str | None = None  # the delay in words, or that it cannot be told; None: lists state their capture
    oddities: list[str] = field(default_factory=list)  # one line each
    middle_m: list[float] = field(default_factory=lambda: [0.0, 0.0])  # x, y: of the area in which it lists objects
    at_wgs84: list[float] | None = None  # of a station: latitude, longitude
    views: list[dict[str, list[float]]] = field(default_factory=list)  # where its sensors look, north ahead
    no_views: str = ""  # why what its sensors say is no view


@dataclass(frozen=True)
class EgoFound:
    """The ego vehicle that the log names: its size in its first frame, and when it is in the log."""

    id: str
    class_: str  # in JSON `class`
    size_m: list[float]  # length, width, height
    from_s: float
    to_s: float


@dataclass(frozen=True)
class Mast:
    """A place for a roadside unit, and the direction it looks in."""

    at: list[float]  # x, y in metres, as in the log
    yaw_deg: int


@dataclass(frozen=True)
class Suggestion:
    """An experiment to begin with.

    `ego`: value of the key, None: the host vehicle of the log. `classes`: measured classes, None: all that moves.
    `few`: a group of classes that is measured only together with all others, as fewer than `FEWEST_COUNTED` of it
    count: how many. `range_m`: who comes so near is measured; None: nobody comes near, and all are from when they
    appear. `again_after_s`: who was away for longer counts again; None: nobody was. `began`: how many cross, appear, or
    are there at the log's start. `masts`: two where most of the measured objects come by, the one with more room around
    it first. Without an ego distances are from the first unit whose lists are recorded, else from the first mast.
    """

    ego: str | dict[str, str] | None
    ego_why: str
    classes: list[str] | None
    few: dict[str, int]
    range_m: float | None
    again_after_s: float | None
    began: dict[str, int]
    masts: list[Mast]


@dataclass(frozen=True)
class TruthFound:
    """One list of true objects. `rate_hz` is the median; gaps are None where there is one frame only."""

    topic: str
    frames: int
    states: int
    start_ns: int
    span_s: float
    rate_hz: float | None
    longest_gap_s: float | None
    longest_gap_at_s: float | None
    gaps_inside_tracks: int
    x_m: list[float]  # extent of the centres of the boxes, from and to
    y_m: list[float]
    moving: dict[str, int]  # objects by class
    stationary: dict[str, int]
    ground: dict[str, int]  # lanes by kind, and areas by kind, that the recording has
    host_id: str | None
    ego: EgoFound | None
    missing: list[str]  # keys that a user may have to give
    damage: str | None
    notes: list[str]
    place: str  # on earth: projection and middle of the log, or why there is none
    vehicles: str  # ids of objects that move, as messages list them
    units: list[UnitFound]
    map: str | None  # why the map in the recording cannot be used, "": it can; None: there is none
    suggested: Suggestion


@dataclass(frozen=True)
class ProposalFound:
    """A channel that looks like a list of objects, by the names of its fields.

    `read`: value of the key, with the fields that were found. `missing`: needed keys without a field. `offers`: fields
    of the messages. `problem`: why the channel was not read. `truth`: the list read so, None where it was not.
    """

    topic: str
    schema: str
    read: dict[str, Any]
    missing: list[str]
    offers: list[str]
    problem: str | None = None
    truth: TruthFound | None = None


@dataclass(frozen=True)
class RecordingSurvey:
    """The survey of a recording.

    `readable`: whether a list of true objects could be read; if not, `reason` says why in a line. `topics`: the
    channels of the file. `truth`: an entry per topic that could be the truth; one, unless there is a choice to make,
    which `choice` describes. `damage`: of the file. `proposals`: where no schema is known, channels that could be read
    by naming fields. `units`: lists of units, where there is no truth to compare them with.
    """

    recording: str
    readable: bool = False
    reason: str | None = None
    choice: str | None = None
    damage: str | None = None
    topics: list[TopicFound] = field(default_factory=list)
    truth: list[TruthFound] = field(default_factory=list)
    log: str = ""
    proposals: list[ProposalFound] = field(default_factory=list)
    units: list[UnitFound] = field(default_factory=list)


def survey_as_json(survey: RecordingSurvey) -> dict[str, Any]:
    """The survey as plain data for JSON."""
    return asdict(survey, dict_factory=lambda items: {name.removesuffix("_"): value for name, value in items})


# Suggestions for an experiment.

RANGES_M = (40.0, 80.0, 160.0)
"""Distances within which objects are measured: the first at which anything counts, so that drives stay comparable."""
FEWEST_COUNTED = 5
"""With fewer objects that cross or appear, those of the log's start count, too; with fewer still, all classes."""
MAST_M = 10.0
"""Distance of the mast from the busiest place: beside the lane, not on it."""
CELL_M = 10.0
"""Cells of the grid on which the busiest place is sought: two or three lanes wide."""
_MOVED_M = 10.0
"""An object that moved less is parked, or nearly."""
AGAIN_AFTER_S = 10.0
"""Who was away for longer counts again: from there on a replay notes that its first episode alone counts."""
_MOSTLY = 0.75
"""The least share of a log for which an ego is there: the vehicle that records a log is there nearly throughout."""
_ROWS = 100_000
"""Object states that are looked at for the place of a mast, at most; more: slower, the place hardly moves."""
_DRIVEN = ("car", "van", "truck", "bus", "vehicle", "motorcycle")
_FRAMES = ("base_link", "base_footprint", "ego_vehicle", "ego", "vehicle")  # usual names of the vehicle's own frame


def suggest_experiment(
    log: Log, recording: Recording, units: Sequence[UnitFound], fields: Fields | None = None
) -> Suggestion:
    """Suggest an experiment on a recording. `units`: whose lists it has."""
    ego, why, recording = _suggest_ego(log, recording, fields)
    scene, truth = recording.scene, recording.truth
    objects = truth.row_object_ix
    number = scene.ego_ix if ego is None or isinstance(ego, dict) else scene.object_number.get(ego, -1)
    away_m = _measure_away(truth, number, next((unit.middle_m for unit in units if unit.problem is None), None))
    measurable = scene.moving & (np.arange(len(scene.moving)) != number)
    groups = {name: measurable & np.isin(scene.object_class, class_indices((name,))) for name in ("vru", "vehicles")}
    groups["all"] = measurable

    def ask(mask: Bool, range_m: float) -> tuple[list[Mast], dict[str, int], bool]:
        """Masts for some objects within a range, how these begin, and whether any comes back."""
        rows = np.flatnonzero(mask[objects] if away_m is None else mask[objects] & (away_m <= range_m))
        masts = _suggest_masts(truth, rows if len(rows) else np.arange(len(objects)), objects)
        near_m = np.hypot(truth.x_m[0] - masts[0].at[0], truth.y_m[0] - masts[0].at[1]) if away_m is None else away_m
        return masts, *_count_began(truth, near_m, mask, range_m)

    found = ((name, mask, range_m) for range_m in (*RANGES_M, np.inf) for name, mask in groups.items())
    name, range_m, (masts, began, returns) = next(
        ((name, range_m, asked) for name, mask, range_m in found if sum((asked := ask(mask, range_m))[1].values())),
        ("all", RANGES_M[0], ask(measurable, RANGES_M[0])),
    )
    too_few = dict[str, int]()
    if name != "all" and sum(began.values()) < FEWEST_COUNTED:
        of_all = ask(measurable, range_m)
        if sum(of_all[1].values()) > sum(began.values()):
            too_few, name, (masts, began, returns) = {name: sum(began.values())}, "all", of_all
    classes, within_m = None if name == "all" else [name], None if range_m == np.inf else range_m
    return Suggestion(ego, why, classes, too_few, within_m, AGAIN_AFTER_S if returns else None, began, masts)


def _measure_away(truth: Tracks, ego_ix: int, place_m: Sequence[float] | None) -> Float | None:
    """(P,) metres from the ego, NaN while it is absent, or from a place; None: there is neither."""
    if ego_ix < 0:
        return None if place_m is None else np.hypot(truth.x_m[0] - place_m[0], truth.y_m[0] - place_m[1])
    rows, frames = np.flatnonzero(truth.row_object_ix == ego_ix), np.full((2, len(truth.stamp_ns)), np.nan)
    frames[:, truth.frame_ix[rows]] = truth.x_m[0, rows], truth.y_m[0, rows]
    x, y = frames[:, truth.frame_ix]
    return np.asarray(np.hypot(truth.x_m[0] - x, truth.y_m[0] - y))


def _count_began(truth: Tracks, away_m: Float, measured: Bool, range_m: float) -> tuple[dict[str, int], bool]:
    """How many objects `measured (N,)` begin how within `range_m`, as `find_episodes` has it, and whether any comes
    back. `away_m (P,)` is NaN where nothing is asked. Who has no frame after its onset does not count.
    """
    objects, time_s, is_measured = truth.row_object_ix, truth.row_captured_s, ~np.isnan(away_m)
    first_s, last_s = np.full(len(measured), np.inf), np.full(len(measured), -np.inf)
    np.minimum.at(first_s, objects[is_measured], time_s[is_measured])
    np.maximum.at(last_s, objects[is_measured], time_s[is_measured])
    near_rows = np.flatnonzero((away_m <= range_m) & measured[objects] & (time_s < last_s[objects]))
    is_first = np.diff(objects[near_rows], prepend=-1) != 0
    returned = ~is_first & (np.diff(time_s[near_rows], prepend=-np.inf) > AGAIN_AFTER_S)
    onset_rows = near_rows[is_first | returned]
    at_once = time_s[onset_rows] <= first_s[objects[onset_rows]]
    at_once |= returned[is_first | returned] & (np.diff(truth.frame_ix, prepend=-2)[onset_rows] != 1)
    at_start = time_s[onset_rows] <= time_s[is_measured].min(initial=np.inf)
    groups = {"crossed": ~at_once, "appeared": at_once & ~at_start, "log_start": at_once & at_start}
    return {word: int(group.sum()) for word, group in groups.items()}, bool(returned.any())


def _suggest_ego(
    log: Log, recording: Recording, fields: Fields | None
) -> tuple[str | dict[str, str] | None, str, Recording]:
    """A value for `ego` (None: leave it out), the reason, and the recording read with it."""
    scene = recording.scene
    if recording.around is not None and recording.around.ego is not None:
        poses = _find_poses(log)
        if poses:
            return {"topic": poses[0]["topic"]}, "the only odometry of the log", recording
    if scene.ego_ix >= 0:
        ident = scene.object_ids[scene.ego_ix]
        return None, f"the log names its host vehicle: {ident} ({CLASSES[scene.object_class[scene.ego_ix]]})", recording
    host = recording.host_id
    no_host = "the log names no host vehicle" if host is None else f"the log's host vehicle {host} is no moving object"
    for place in _find_poses(log):
        from copem_replay.io.config import EgoTopic

        try:
            ego_topic = EgoTopic.model_validate(place)
            with_ego = read_log(log, name=scene.log, topic=recording.topic, fields=fields, ego=ego_topic)
        except (RecordingError, BrokenIndexError):
            continue
        if with_ego.scene.ego_ix >= 0:
            return place, f"{no_host}; these poses may be the ego's", with_ego
    ident, why = _find_longest_vehicle(scene, recording.truth)
    return ident, f"{no_host}; {why}", recording


def _find_poses(log: Log) -> list[dict[str, str]]:
    """Values of `ego` for the topics that may have its poses: odometry first, transforms last."""
    if not foreign_channels(log):
        return []
    from copem_replay.io.channel import DefinitionError
    from copem_replay.io.log import gather_messages
    from copem_replay.io.schemas.poses import decode_poses

    ranked: list[tuple[int, dict[str, str]]] = []
    for channel in foreign_channels(log):
        if not is_pose(channel) or is_static(channel):
            continue
        if schema_name(channel) == ODOMETRY:
            ranked.append((0, {"topic": channel.topic}))
            continue
        try:
            messages = gather_messages(log, frozenset([channel.number]))
            times = np.array(messages.log_time_ns[channel.number], dtype=np.int64)
            poses = decode_poses(channel, messages.payloads[channel.number], times)
        except (DefinitionError, KeyError, BrokenIndexError, RecordingError):
            continue
        if len(set(poses.stamp_ns.tolist())) < 2:  # a place, not a way
            continue
        frames = {name.lstrip("/") for name in poses.child}
        base_frame = next((name for name in _FRAMES if name in frames), None)
        if frames == {""}:
            ranked.append((1, {"topic": channel.topic}))
        elif base_frame is not None:
            ranked.append((2, {"topic": channel.topic, "frame": base_frame}))
    return [place for _, place in sorted(ranked, key=lambda pair: pair[0])]


def _find_longest_vehicle(scene: Scene, truth: Tracks) -> tuple[str, str]:
    """The driving vehicle that is in the log for longest, and why; "none" where no other object would be measured.
    "none" also where it is there for a part of the log only: that log was recorded from beside the road.
    """
    objects, count = truth.row_object_ix, len(scene.object_ids)
    first_values, last_values = np.full((3, count), np.inf), np.full((3, count), -np.inf)
    for k, values in enumerate((truth.row_captured_s, truth.x_m[0], truth.y_m[0])):
        np.minimum.at(first_values[k], objects, values)
        np.maximum.at(last_values[k], objects, values)
    duration_s, moved_m = last_values[0] - first_values[0], np.hypot(*(last_values - first_values)[1:])
    drives = scene.moving & np.isin(scene.object_class, class_indices(_DRIVEN))
    if not drives.any():
        return "none", "there is no vehicle to be the ego"
    if scene.moving.sum() < 2:
        return "none", f"{scene.object_ids[int(drives.argmax())]}, the only one that moves, is measured"
    best = max(np.flatnonzero(drives), key=lambda k: (moved_m[k] >= _MOVED_M, duration_s[k], moved_m[k]))
    longest = (
        f"of the vehicles that drive, {scene.object_ids[best]} ({CLASSES[scene.object_class[best]]}) "
        f"is there longest, {first_values[0, best]:.1f} – {last_values[0, best]:.1f} s"
    )
    if duration_s[best] < _MOSTLY * scene.end_s:
        return "none", f"{longest} of {scene.end_s:.1f} s, and an ego is there nearly all the time"
    return scene.object_ids[best], longest


def _suggest_masts(truth: Tracks, rows: Int, objects: Int) -> list[Mast]:
    """Two masts that face each other across the busiest place of measured objects, the one with more room first."""
    rows = rows[:: max(1, len(rows) // _ROWS)]
    x, y = truth.x_m[0, rows], truth.y_m[0, rows]
    cells = np.stack([np.floor(x / CELL_M), np.floor(y / CELL_M)], axis=1)
    visits = np.unique(np.column_stack([cells, objects[rows]]), axis=0)
    places, counts = np.unique(visits[:, :2], axis=0, return_counts=True)
    busiest = places[counts == counts.max()]
    middle = np.array([np.median(x), np.median(y)])
    inside = (cells == busiest[np.hypot(*((busiest + 0.5) * CELL_M - middle).T).argmin()]).all(axis=1)
    centre = np.array([x[inside].mean(), y[inside].mean()])
    step = max(1, len(truth.x_m[0]) // _ROWS)
    everyone = np.stack([truth.x_m[0, ::step], truth.y_m[0, ::step]], axis=1)
    turns = np.deg2rad(np.arange(0, 360, 45))
    mast_places = [centre + MAST_M * np.array([np.cos(t), np.sin(t)]) for t in turns]
    free_m = [float(np.hypot(*(everyone - place).T).min()) for place in mast_places]
    freest = int(np.argmax(np.round(free_m, 3)))
    return [Mast([round(float(v), 1) for v in mast_places[k]], 180 - -45 * k % 360) for k in (freest, (freest + 4) % 8)]

"""The survey of a recording: its topics, the truth in it, the lists of its units; and of several, their clocks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from copem_replay.core.errors import InputError, RecordingError
from copem_replay.core.frame import check_scale, write_degrees
from copem_replay.core.tracks import CLASSES, Bool, Float, Scene
from copem_replay.experiment.draft.findings import (
    CELL_M,
    EgoFound,
    ProposalFound,
    RecordingSurvey,
    Role,
    TopicFound,
    TruthFound,
    UnitFound,
    suggest_experiment,
)
from copem_replay.experiment.draft.frame_fit import FIXES, fit_fixes
from copem_replay.io.channel import Channel, schema_name
from copem_replay.io.findings import find_rule
from copem_replay.io.ground_truth import MAX_GAP_S
from copem_replay.io.log import Log
from copem_replay.io.open import Local, first_recording, label_files, name_log, open_log
from copem_replay.io.recording import (
    Recording,
    choose_topic,
    find_middle,
    foreign_channels,
    is_truth,
    moving_ids,
    read_log,
    truth_topics,
)
from copem_replay.io.schemas import osi_ground_truth as osi
from copem_replay.io.schemas.poses import is_pose
from copem_replay.io.schemas.registry import is_list, known_lists

if TYPE_CHECKING:  # they import much that a recording of the truth alone does not need
    from copem_replay.io.clock_offset import TimeOffset
    from copem_replay.io.recorded_lists import RecordedLists
    from copem_replay.io.schemas.description import Fields
    from copem_replay.io.short_tracks import ListPoints


GATE_M = 3.0
"""Distance within which an entry is about a true object: the default of `measure.match`."""
_OURS = "copem/"  # prefix of the topics that this project writes
_EGO_HINT = "give `ego: <id>` in the experiment, or `--ego <id>`"


def survey_recording(place: Local | str) -> RecordingSurvey:
    """The survey of a recording, equal for equal bytes. A bad recording raises nothing: `reason` says why."""
    place = Path(place) if isinstance(place, str) else place
    path = first_recording(place)
    names = [path] if isinstance(place, Path) else list(place.paths)
    survey = RecordingSurvey(recording=" + ".join(one.name or str(one) for one in names), log=str(place))
    try:
        log = open_log(place)
    except RecordingError as error:
        return replace(survey, reason=str(error))
    survey = replace(survey, damage=log.damage, topics=_survey_topics(log))
    try:
        topics = [choose_topic(log)[0]]
    except RecordingError as error:
        topics = list(truth_topics(log))
        if not topics:
            scene = make_empty_scene(log.path.stem, log.start_ns, log.end_ns)
            units = list(
                _survey_units(place, scene, [t.topic for t in survey.topics if t.role == "unit" and t.messages])
            )
            return replace(survey, reason=str(error), proposals=_list_proposals(log, survey.topics), units=units)
        survey = replace(survey, choice=str(error))
    truth, failures = [], []
    unit_topics = [t.topic for t in survey.topics if t.role == "unit"]
    for topic in topics:
        try:
            recording = read_log(log, name=name_log(path), topic=topic, unit_topics=unit_topics)
        except RecordingError as error:
            failures.append(str(error))
            continue
        truth.append(_survey_truth(log, recording, survey.topics))
    if not truth:
        return replace(survey, reason="; ".join(failures))
    damage = next((t.damage for t in truth if t.damage), survey.damage)
    return replace(survey, readable=True, truth=truth, damage=damage)


def _survey_topics(log: Log) -> list[TopicFound]:
    """The channels of a log, each with its role: truth, unit, poses, map or unread."""
    truths = truth_topics(log)
    lists, poses = set[int](), set[int]()
    if foreign_channels(log):
        lists = {c.number for c in log.channels if is_list(c)}
        poses = {c.number for c in log.channels if is_pose(c)}

    def role(channel: Channel) -> Role:
        if is_truth(channel) or (channel.topic in truths and channel.number in lists):
            return "truth"
        if channel.number in lists or (channel.schema == osi.SENSOR_DATA and channel.encoding == "protobuf"):
            return "unit"
        return "poses" if channel.number in poses else "map" if channel.schema == osi.EMBEDDED_MAP else "unread"

    return [TopicFound(c.topic, c.schema, c.encoding, c.messages, role(c)) for c in log.channels]


def _survey_units(
    place: Local, scene: Scene, topics: Sequence[str], recording: Recording | None = None
) -> Iterator[UnitFound]:
    """The lists of each unit, compared with the truth of `recording` (None: none); `problem`: they are unreadable."""
    if topics and recording is not None and recording.place_said is not None:
        with suppress(InputError):  # the line on its place says why
            scene = replace(scene, frame=recording.place_said.read()[0])
    for topic in dict.fromkeys(topics):
        from copem_replay.io.recorded_lists import read_unit_lists  # it takes time, and most recordings have no lists

        try:
            lists = read_unit_lists(place, topic, scene, None if recording is None else recording.around)
        except RecordingError as error:
            yield UnitFound(topic, problem="; ".join(error.within(first_recording(place), topic)))
            continue
        known = _compare_with_truth(recording, lists) if recording is not None and len(lists.tracks.stamp_ns) else {}
        yield _survey_unit(topic, lists, known | _survey_sensors(place, topic))


def _survey_sensors(place: Local, topic: str) -> dict[str, Any]:
    """Where the sensors of a station look, as fields of `UnitFound`."""
    from copem_replay.io.stations import read_station_views

    said = open_log(place).attempt(lambda log: read_station_views(log, topic))
    if said is None:
        return {}
    views = [{"range_m": list(range_m), "azimuth_deg": list(azimuth_deg)} for range_m, azimuth_deg in said.views]
    return {"at_wgs84": list(said.place_deg), "views": views, "no_views": said.why}


def _survey_unit(topic: str, recorded: RecordedLists, known: dict[str, Any]) -> UnitFound:
    """The lists of a unit: their own properties, and those by comparison with the truth (`known`)."""
    between_s = np.diff(np.unique(recorded.tracks.stamp_ns)) * 1e-9
    lists = len(recorded.tracks.stamp_ns)
    x_m, y_m = recorded.tracks.x_m[0], recorded.tracks.y_m[0]
    cells = np.unique(np.floor(np.stack([x_m, y_m], axis=1) / CELL_M), axis=0)
    return UnitFound(
        topic,
        lists=lists,
        entries=len(recorded.tracks.frame_ix),
        rate_hz=round(1.0 / float(np.median(between_s)), 3) if len(between_s) else None,
        covariances_said=bool(recorded.spread_said.all()),
        captures_said=bool(recorded.capture_said.all()),
        velocities_said=recorded.velocity_said or not len(recorded.tracks.frame_ix),
        problem=None if lists else "holds no list",
        middle_m=(CELL_M * (np.median(cells, axis=0) + 0.5)).tolist() if len(cells) else [0.0, 0.0],
        **known,
    )


def _compare_with_truth(recording: Recording, lists: RecordedLists) -> dict[str, Any]:
    """Delay (s) and oddities of the lists of a unit, as fields of `UnitFound`."""
    from copem_replay.io.recorded_units import (
        assign_truth_ids,
        delay_words,
        describe_oddities,
        estimate_delay,
        shift_captures,
    )

    scene, truth, found_fields, delay_s = recording.scene, recording.truth, dict[str, Any](), 0.0
    if not lists.capture_said.all():
        delay = estimate_delay(lists, scene, truth)
        found_fields["delay"] = delay_words(delay)
        if delay.untold is None:
            found_fields["delay_s"] = delay_s = round(max(delay.offset_s, 0.0), 3)
            found_fields["delay_interval_s"] = [round(delay.low_s, 3), round(delay.high_s, 3)]
    shifted = shift_captures(lists, scene, delay_s)
    matched = assign_truth_ids(shifted, scene, truth, gate_m=GATE_M, max_gap_s=MAX_GAP_S)
    return found_fields | {"oddities": list(describe_oddities(lists, matched.row_object_ix, scene))}


def _list_proposals(log: Log, topics: Sequence[TopicFound]) -> list[ProposalFound]:
    """Proposals of `read:` for channels of unknown schemas, with the truth where these can be read."""
    if not foreign_channels(log):
        return []
    from copem_replay.experiment.draft.fields import parse_fields, try_proposals

    return [
        proposal
        if recording is None
        else replace(proposal, truth=_survey_truth(log, recording, topics, parse_fields(proposal)))
        for proposal, recording in try_proposals(log, log.path.stem)
    ]


def _survey_truth(
    log: Log, recording: Recording, topics: Sequence[TopicFound], fields: Fields | None = None
) -> TruthFound:
    """One list of true objects, the units beside it, and the experiment they suggest."""
    scene, truth = recording.scene, recording.truth
    poses = [t.topic for t in topics if t.role == "poses" and t.messages]
    units = [t.topic for t in topics if t.role == "unit" and t.messages]
    units = [name for name in units if name != recording.topic and not name.startswith(_OURS)]
    between_s = np.diff(truth.stamp_ns) * 1e-9
    longest_ix = int(between_s.argmax()) if len(between_s) else 0
    inside_s = np.diff(truth.row_captured_s)[np.diff(truth.track_ix) == 0]
    found_units = list(_survey_units(recording.local, scene, units, recording))
    return TruthFound(
        topic=recording.topic,
        frames=len(truth.stamp_ns),
        states=len(truth.frame_ix),
        start_ns=scene.t0_ns,
        span_s=round(scene.end_s, 9),
        rate_hz=round(1.0 / float(np.median(between_s)), 3) if len(between_s) else None,
        longest_gap_s=round(float(between_s[longest_ix]), 9) if len(between_s) else None,
        longest_gap_at_s=round(float(truth.captured_s[longest_ix]), 9) if len(between_s) else None,
        gaps_inside_tracks=int((inside_s > MAX_GAP_S).sum()),
        x_m=_round_extent(truth.x_m[0]),
        y_m=_round_extent(truth.y_m[0]),
        moving=_count_by_class(scene, scene.moving),
        stationary=_count_by_class(scene, ~scene.moving),
        ground=_count_ground(recording),
        host_id=recording.host_id,
        ego=_describe_ego(recording),
        missing=_list_missing(recording, poses),
        damage=recording.damage,
        notes=list(recording.notes),
        place=_describe_place(log, recording),
        vehicles=moving_ids(scene, shown=6),
        units=found_units,
        map=_try_map(recording) if recording.together is None and any(t.role == "map" for t in topics) else None,
        suggested=suggest_experiment(log, recording, found_units, fields),
    )


def _try_map(recording: Recording) -> str:
    """Why the map in a recording cannot be used, "": it can."""
    from copem_replay.experiment.maps import MapFile, add_maps

    asked = MapFile.model_construct(file=str(recording.path), frame="same")
    return "; ".join(line for _, line in add_maps(recording, [asked])[1])


def _count_ground(recording: Recording) -> dict[str, int]:
    """How many lanes of each kind and areas of each kind a recording has, most first."""
    lanes = Counter(f"{lane.kind} lane" for lane in recording.lanes)
    areas = Counter(
        each.kind if each.kind in ("crosswalk", "junction") else f"{each.kind} area" for each in recording.scene.areas
    )
    return dict((lanes + areas).most_common())


def _describe_place(log: Log, recording: Recording) -> str:
    """Where on earth the recording says it is, or why that is not known; and what fixes beside its odometry say."""
    if recording.place_said is None:
        none = "none (the recording does not say where on earth it is)"
        return "; ".join([none, *_describe_fixes(log, recording)])
    try:
        frame, notes = recording.place_said.read()
        middle_m = find_middle(recording)
        notes += check_scale(frame, middle_m)
        where = f"{frame.proj}, {write_degrees(*frame.to_wgs84(middle_m)[0])} at the middle of the log"
    except InputError as error:
        return f"none ({error})"
    return "; ".join([where, *notes])


def _describe_fixes(log: Log, recording: Recording) -> list[str]:
    """What fixes beside the odometry say of the place, topic by topic, or why that cannot be told."""
    if not any(schema_name(channel) in FIXES for channel in log.channels):
        return []
    try:
        return [fit.words for fit in fit_fixes(log, recording)]
    except InputError as error:  # pyproj is not there, or a fix is none
        return [f"its fixes cannot be used: {error}"]


def _round_extent(values: Float) -> list[float]:
    """The extent of values, from and to, rounded to 0.1."""
    return [round(float(values.min()), 1), round(float(values.max()), 1)]


def _count_by_class(scene: Scene, which: Bool) -> dict[str, int]:
    counts = np.bincount(scene.object_class[which], minlength=len(CLASSES)).tolist()
    return {name: number for name, number in zip(CLASSES, counts, strict=True) if number}


def _describe_ego(recording: Recording) -> EgoFound | None:
    """The ego vehicle that the log names, its size (m), from when to when (s); None: it names none."""
    scene, truth = recording.scene, recording.truth
    if scene.ego_ix < 0:
        return None
    first = int(truth.start[scene.ego_ix])  # the track of an object has its number
    last = int(truth.start[scene.ego_ix + 1]) - 1
    return EgoFound(
        id=scene.object_ids[scene.ego_ix],
        class_=CLASSES[scene.object_class[scene.ego_ix]],
        size_m=[round(float(a[0, first]), 3) for a in (truth.length_m, truth.width_m, truth.height_m)],
        from_s=round(float(truth.row_captured_s[first]), 9),
        to_s=round(float(truth.row_captured_s[last]), 9),
    )


def _list_missing(recording: Recording, poses: Sequence[str]) -> list[str]:
    """A line for each key that a user may have to give. `poses`: topics that may have the ego's poses."""
    scene = recording.scene
    if scene.ego_ix >= 0:
        return []
    host = recording.host_id
    host_words = "the log names no host vehicle" if host is None else f"the host vehicle {host} is no moving object"
    host_words = find_rule(recording.notes, "two clocks") or host_words
    line = f"no ego vehicle: {host_words}; {_EGO_HINT}, of {moving_ids(scene, shown=6)}"
    if poses:
        line += f"; or `ego: {{topic: {poses[0]}}}` (poses are on {', '.join(poses)})"
    return [line]


# Clock offsets of several recordings of one drive, from the traffic that they have in common.


@dataclass(frozen=True)
class ClockFound:
    """The clock of a recording against the first one's: `offset`, and the two `lists` it is estimated from.

    `late`: those of the two that do not state their capture, so that the offset includes their delay.
    """

    path: Path
    lists: tuple[str, str]
    offset: TimeOffset
    late: tuple[str, ...] = ()

    def words(self) -> str:
        """`0.130 s (95 %: 0.120 … 0.140 s)`, the offset in words, and the drift; or why it cannot be told."""
        offset = self.offset
        if offset.untold is not None:
            return f"cannot be told: {offset.untold}"
        words = f"{offset.offset_s:.3f} s (95 %: {offset.low_s:.3f} … {offset.high_s:.3f} s)"
        if offset.unbiased:
            words += ", assuming no shift along the path"
        if offset.drift is not None:
            drift, low, high = (1e6 * value for value in offset.drift)
            words += f", drift {drift:.0f} µs/s (95 %: {low:.0f} … {high:.0f})"
        if self.late:
            do = "does" if len(self.late) == 1 else "do"
            words += f", the delay of {' and '.join(self.late)} included, which {do} not say when captured"
        return words

    def plain(self) -> dict[str, object]:
        """The findings as JSON: offset (s), drift (s/s), intervals; null where they cannot be told (`untold`)."""
        offset = self.offset
        is_told = offset.untold is None
        return {
            "lists": list(self.lists),
            "clock_offset_s": offset.offset_s if is_told else None,
            "interval_s": [offset.low_s, offset.high_s] if is_told else None,
            "drift": offset.drift[0] if is_told and offset.drift else None,
            "drift_interval": list(offset.drift[1:]) if is_told and offset.drift else None,
            "entries": offset.entries,
            "if_not_shifted": offset.unbiased,
            "untold": offset.untold,
        }


@dataclass(frozen=True)
class _TimedLists:
    name: str
    entries: ListPoints
    captures_said: bool = True  # also for the truth


def compare_clocks(paths: Sequence[Path]) -> list[ClockFound]:
    """The clock of each recording but the first. Raises RecordingError: not readable, or no object list."""
    t0_ns: int | None = None
    lists_of: list[list[_TimedLists]] = []
    for path, label in zip(paths, label_files(paths), strict=True):
        log = open_log(path)
        t0_ns = log.start_ns if t0_ns is None else t0_ns
        lists = list(_read_timed_lists(log, label, t0_ns))
        if not lists:
            raise RecordingError("no object list to tell its clock by", path=path)
        lists_of.append(lists)
    return [_find_best(path, lists_of[0], lists) for path, lists in zip(paths[1:], lists_of[1:], strict=True)]


def _find_best(path: Path, first: Sequence[_TimedLists], second: Sequence[_TimedLists]) -> ClockFound:
    """The offset with the narrowest interval, among the pairs of lists with the fewest unknown delays."""
    from copem_replay.io.clock_offset import estimate_time_offset

    clocks = [
        ClockFound(
            path,
            (a.name, b.name),
            estimate_time_offset(a.entries, b.entries),
            tuple(timed.name for timed in (a, b) if not timed.captures_said),
        )
        for a, b in product(first, second)
    ]
    return min(clocks, key=lambda c: (c.offset.untold is not None, len(c.late), c.offset.high_s - c.offset.low_s))


def _read_timed_lists(log: Log, label: str, t0_ns: int) -> Iterator[_TimedLists]:
    """The object lists of a recording, truths first, in seconds since `t0_ns`; unreadable ones are left out."""
    from copem_replay.io.recorded_lists import read_unit_lists
    from copem_replay.io.short_tracks import make_list_points

    for topic in truth_topics(log):
        try:
            truth = read_log(log, name=label, topic=topic).truth
        except RecordingError:
            continue
        yield _TimedLists(f"{label}:{topic}", make_list_points(truth, t0_ns))
    scene = make_empty_scene(label, t0_ns, log.end_ns)
    osi_topics = [c.topic for c in log.channels if c.schema == "osi3.SensorData" and c.messages]
    others = [c.topic for c in known_lists(log.channels) if c.messages and c.topic not in truth_topics(log)]
    for topic in dict.fromkeys([*osi_topics, *others]):
        try:
            lists = read_unit_lists(log.path, topic, scene, None)
        except RecordingError:
            continue
        if not topic.startswith(_OURS) and len(lists.tracks.frame_ix):
            entries = make_list_points(lists.tracks, t0_ns, lists.track_id)
            yield _TimedLists(f"{label}:{topic}", entries, bool(lists.capture_said.all()))


def make_empty_scene(name: str, t0_ns: int, end_ns: int) -> Scene:
    """A scene without objects, for a log without truth."""
    return Scene(name, t0_ns, end_ns, (), np.empty(0, dtype=np.int8), np.empty(0, dtype=bool))

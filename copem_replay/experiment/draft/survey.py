"""A look at a recording: its topics, the truth in it, the lists of its units, and the experiment to begin with."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from copem_replay.core.errors import RecordingError
from copem_replay.core.tracks import CLASSES, Bool, Float, Scene
from copem_replay.experiment.draft.defaults import suggestion
from copem_replay.experiment.draft.findings import (
    EgoFound,
    ProposalFound,
    Role,
    Survey,
    TopicFound,
    TruthFound,
    UnitFound,
)
from copem_replay.io.channel import Channel
from copem_replay.io.log import Log
from copem_replay.io.open import name_of, open_log
from copem_replay.io.plausibility import MAX_GAP_S
from copem_replay.io.recording import Recording, choose_topic, foreign, is_truth, moving_ids, read, truth_topics
from copem_replay.io.schemas import osi_ground_truth as osi
from copem_replay.io.schemas.pose_schemas import is_pose
from copem_replay.io.schemas.registry import is_list
from copem_replay.io.together import Local, first_of

if TYPE_CHECKING:  # it imports much that a recording of the truth alone does not need
    from copem_replay.io.recorded_osi import RecordedLists
    from copem_replay.io.schemas.description import Fields

GATE_M = 3.0
"""Farther from a true object an entry is about no object: the default of `measure.match`."""
_OURS = "copem/"  # what this project wrote beside a recording
_EGO_HINT = "give `ego: <id>` in the experiment, or `--ego <id>`"


def survey(place: Local | str) -> Survey:
    """Look at a recording: the same findings for the same bytes. A bad recording raises nothing."""
    place = Path(place) if isinstance(place, str) else place
    path = first_of(place)
    names = [path] if isinstance(place, Path) else list(place.paths)
    found = Survey(recording=" + ".join(one.name or str(one) for one in names), log=str(place))
    try:
        log = open_log(place)
    except RecordingError as error:
        return replace(found, reason=str(error))
    found = replace(found, damage=log.damage, topics=_topics(log))
    try:
        topics = [choose_topic(log)[0]]
    except RecordingError as error:
        topics = list(truth_topics(log))
        if not topics:
            units = list(_units_alone(log, place, found.topics))
            return replace(found, reason=str(error), proposals=_proposals(log, found.topics), units=units)
        found = replace(found, choice=str(error))
    truth, failures = [], []
    beside = [t.topic for t in found.topics if t.role == "unit"]
    for topic in topics:
        try:
            recording = read(log, name=name_of(path), topic=topic, beside=beside)
        except RecordingError as error:
            failures.append(str(error))
            continue
        truth.append(_truth(log, recording, found.topics))
    if not truth:
        return replace(found, reason="; ".join(failures))
    damage = next((t.damage for t in truth if t.damage), found.damage)
    return replace(found, readable=True, truth=truth, damage=damage)


def _topics(log: Log) -> list[TopicFound]:
    """The channels, and what each is to us."""
    truths = truth_topics(log)
    lists, poses = set[int](), set[int]()
    if foreign(log):
        lists = {c.number for c in log.channels if is_list(c)}
        poses = {c.number for c in log.channels if is_pose(c)}

    def role(channel: Channel) -> Role:
        if is_truth(channel) or (channel.topic in truths and channel.number in lists):
            return "truth"
        if channel.number in lists or (channel.schema == osi.SENSOR_DATA and channel.encoding == "protobuf"):
            return "unit"
        return "poses" if channel.number in poses else "unread"

    return [TopicFound(c.topic, c.schema, c.encoding, c.messages, role(c)) for c in log.channels]


def _units(recording: Recording, topics: Sequence[str]) -> Iterator[UnitFound]:
    """The lists of each unit, or what is wrong with them: `problem`."""
    for topic in dict.fromkeys(topics):
        from copem_replay.io.recorded_lists import lists_on  # it takes time, and most recordings have no lists

        try:
            found = lists_on(recording.local, topic, recording.scene, recording.around)
        except RecordingError as error:
            yield UnitFound(topic, problem="; ".join(error.within(recording.path, topic)))
            continue
        yield _unit(topic, found, _against_truth(recording, found) if len(found.tracks.stamp_ns) else {})


def _units_alone(log: Log, place: Local, topics: Sequence[TopicFound]) -> Iterator[UnitFound]:
    """The lists of each unit of a recording without truth, as far as they can be read without one."""
    from copem_replay.experiment.draft.clocks import without_objects
    from copem_replay.io.recorded_lists import lists_on

    scene = without_objects(log.path.stem, log.start_ns, log.end_ns)
    for topic in dict.fromkeys(t.topic for t in topics if t.role == "unit" and t.messages):
        try:
            yield _unit(topic, lists_on(place, topic, scene, None), {})
        except RecordingError as error:
            yield UnitFound(topic, problem="; ".join(error.within(log.path, topic)))


def _unit(topic: str, found: RecordedLists, known: dict[str, Any]) -> UnitFound:
    """What the lists say of themselves, and what is known of them by the truth."""
    between_s = np.diff(np.unique(found.tracks.stamp_ns)) * 1e-9
    lists = len(found.tracks.stamp_ns)
    return UnitFound(
        topic,
        lists=lists,
        entries=len(found.tracks.frame_ix),
        rate_hz=round(1.0 / float(np.median(between_s)), 3) if len(between_s) else None,
        covariances_said=bool(found.spread_said.all()),
        captures_said=bool(found.capture_said.all()),
        problem=None if lists else "holds no list",
        **known,
    )


def _against_truth(recording: Recording, found: RecordedLists) -> dict[str, Any]:
    """How late the lists of a unit are, and what is odd about them."""
    from copem_replay.io.list_checks import captured_before, delay_of, delay_words, odd_about
    from copem_replay.io.recorded_units import with_truth_ids

    scene, truth, known, delay_s = recording.scene, recording.truth, dict[str, Any](), 0.0
    if not found.capture_said.all():
        delay = delay_of(found, scene, truth)
        known["delay"] = delay_words(delay)
        if delay.untold is None:
            known["delay_s"] = delay_s = round(max(delay.offset_s, 0.0), 3)
            known["delay_interval_s"] = [round(delay.low_s, 3), round(delay.high_s, 3)]
    shifted = captured_before(found, scene, delay_s)
    told = with_truth_ids(shifted, scene, truth, gate_m=GATE_M, max_gap_s=MAX_GAP_S)
    return known | {"oddities": list(odd_about(found, told.row_object_ix, scene))}


def _proposals(log: Log, topics: Sequence[TopicFound]) -> list[ProposalFound]:
    """Lists by the names of their fields."""
    if not foreign(log):
        return []
    from copem_replay.experiment.draft.field_trial import fields_of, proposals

    return [
        found if recording is None else replace(found, truth=_truth(log, recording, topics, fields_of(found)))
        for found, recording in proposals(log, log.path.stem)
    ]


def _truth(log: Log, recording: Recording, topics: Sequence[TopicFound], fields: Fields | None = None) -> TruthFound:
    """One list of true objects, and what the other topics are to it."""
    scene, truth = recording.scene, recording.truth
    poses = [t.topic for t in topics if t.role == "poses" and t.messages]
    units = [t.topic for t in topics if t.role == "unit" and t.messages]
    units = [name for name in units if name != recording.topic and not name.startswith(_OURS)]
    between_s = np.diff(truth.stamp_ns) * 1e-9
    longest = int(between_s.argmax()) if len(between_s) else 0
    inside_s = np.diff(truth.row_captured_s)[np.diff(truth.track_ix) == 0]
    return TruthFound(
        topic=recording.topic,
        frames=len(truth.stamp_ns),
        states=len(truth.frame_ix),
        start_ns=scene.t0_ns,
        span_s=round(scene.end_s, 9),
        rate_hz=round(1.0 / float(np.median(between_s)), 3) if len(between_s) else None,
        longest_gap_s=round(float(between_s[longest]), 9) if len(between_s) else None,
        longest_gap_at_s=round(float(truth.captured_s[longest]), 9) if len(between_s) else None,
        gaps_inside_tracks=int((inside_s > MAX_GAP_S).sum()),
        x_m=_extent(truth.x_m[0]),
        y_m=_extent(truth.y_m[0]),
        moving=_by_class(scene, scene.moving),
        stationary=_by_class(scene, ~scene.moving),
        host_id=recording.host_id,
        ego=_ego(recording),
        missing=_missing(recording, poses),
        damage=recording.damage,
        notes=list(recording.notes),
        vehicles=moving_ids(scene, shown=6),
        units=list(_units(recording, units)),
        suggested=suggestion(log, recording, fields),
    )


def _extent(values: Float) -> list[float]:
    """From where to where the centres of the boxes lie."""
    return [round(float(values.min()), 1), round(float(values.max()), 1)]


def _by_class(scene: Scene, which: Bool) -> dict[str, int]:
    counts = np.bincount(scene.object_class[which], minlength=len(CLASSES)).tolist()
    return {name: number for name, number in zip(CLASSES, counts, strict=True) if number}


def _ego(recording: Recording) -> EgoFound | None:
    """Describe the ego vehicle the log names: its size at its first frame, and when it is there."""
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


def _missing(recording: Recording, poses: Sequence[str]) -> list[str]:
    """Say what a user may have to give; `poses`: topics that may have the ego's."""
    scene = recording.scene
    if scene.ego_ix >= 0:
        return []
    host = recording.host_id
    who = "the log names no host vehicle" if host is None else f"the host vehicle {host} is no moving object"
    line = f"no ego vehicle: {who}; {_EGO_HINT}, of {moving_ids(scene, shown=6)}"
    if poses:
        line += f"; or `ego: {{topic: {poses[0]}}}` (poses are on {', '.join(poses)})"
    return [line]

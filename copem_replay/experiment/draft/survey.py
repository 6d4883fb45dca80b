"""What is in a recording, as data (`survey`) and as lines of text (`describe`), and the experiment to begin with."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from copem_replay.core.errors import RecordingError
from copem_replay.core.text import counted, printable
from copem_replay.core.tracks import CLASSES, Bool, Float, Scene
from copem_replay.experiment.draft.defaults import suggestion
from copem_replay.experiment.draft.template import read_block, short
from copem_replay.io.channel import Channel
from copem_replay.io.log import Log
from copem_replay.io.open import name_of, open_log
from copem_replay.io.plausibility import MAX_GAP_S
from copem_replay.io.recording import Recording, choose_topic, foreign, is_truth, moving_ids, read_log, truth_topics
from copem_replay.io.schemas import osi_ground_truth as osi
from copem_replay.io.schemas.pose_schemas import is_pose
from copem_replay.io.schemas.registry import is_list

if TYPE_CHECKING:  # it imports much that a recording of the truth alone does not need
    from copem_replay.io.recorded_osi import RecordedLists
    from copem_replay.io.schemas.description import Fields

_ROLES = {
    "truth": "the truth",
    "unit": "lists of a unit, for `recorded: {topic: …}`",
    "poses": "poses",
    "unread": "not read",
}
_OURS = "copem/"  # what this project wrote beside a recording
_EGO_HINT = "give `ego: <id>` in the experiment, or `--ego <id>`"


def survey(path: Path | str) -> dict[str, Any]:
    """Look at a recording: plain data that JSON can hold, the same for the same bytes.

    `readable`: whether a list of true objects could be read; if not, `reason` says why in a line, and `topics` what
    the file holds all the same. `truth` has an entry per topic that could be the truth: one, unless there is a
    choice to make (then `choice` says so). `proposals`: where no list is known by name, what could be read by naming
    fields. A bad recording raises nothing.
    """
    found: dict[str, Any] = {
        "recording": Path(path).name or str(path),
        "readable": False,
        "reason": None,
        "choice": None,
    }
    # damage: of the file, what is wrong with it
    found |= {"damage": None, "topics": [], "truth": [], "log": str(path), "experiment": None}
    found["proposals"] = []
    try:
        log = open_log(Path(path))
    except RecordingError as error:
        return found | {"reason": str(error)}
    found |= {"damage": log.damage, "topics": _topics(log)}
    try:
        topics = [choose_topic(log)[0]]
    except RecordingError as error:
        topics = list(truth_topics(log))
        found["choice" if topics else "reason"] = str(error)
        if not topics:
            return found | {"proposals": _proposals(log, found["topics"])}
    failures = []
    beside = [t["topic"] for t in found["topics"] if t["role"] == "unit"]
    for topic in topics:
        try:
            recording = read_log(log, name=name_of(Path(path)), topic=topic, beside=beside)
        except RecordingError as error:
            failures.append(str(error))
            continue
        found["truth"].append(_truth(log, recording, found["topics"]))
    if failures and not found["truth"]:
        found["reason"] = "; ".join(failures)
    damage = next((t["damage"] for t in found["truth"] if t["damage"]), found["damage"])
    found |= {"readable": bool(found["truth"]), "damage": damage}
    return found | {"experiment": "\n".join(short(found)) + "\n" if found["readable"] else None}


def describe(survey: dict[str, Any]) -> list[str]:
    """Say in lines of plain text what `survey` found. Why it found no truth is left to `reason`."""
    lines: list[str] = [survey["recording"], *_topic_lines(survey)]
    for truth in survey["truth"]:
        lines += _truth_lines(truth)
    lines += [survey["choice"]] if survey["choice"] else []
    for proposal in survey["proposals"]:
        lines.append(f"{proposal['topic']} may be read as a list of objects, by the names of its fields:")
        lines += [f"  {line}" for line in read_block(proposal)]
    if survey["experiment"]:
        lines.append(f"experiment; with comments: copem-replay init {shlex.quote(survey['log'])} > experiment.yaml")
        lines += [f"  {line}" for line in survey["experiment"].splitlines()]
    return [printable(line) for line in lines]


def _topics(log: Log) -> list[dict[str, Any]]:
    """The channels, and what each is to us."""
    truths = truth_topics(log)
    lists, poses = set[int](), set[int]()
    if foreign(log):
        lists = {c.number for c in log.channels if is_list(c)}
        poses = {c.number for c in log.channels if is_pose(c)}

    def role(channel: Channel) -> str:
        if is_truth(channel) or (channel.topic in truths and channel.number in lists):
            return "truth"
        if channel.number in lists or (channel.schema == osi.SENSOR_DATA and channel.encoding == "protobuf"):
            return "unit"
        return "poses" if channel.number in poses else "unread"

    return [
        {
            "topic": channel.topic,
            "schema": channel.schema,
            "encoding": channel.encoding,
            "messages": channel.messages,
            "role": role(channel),
        }
        for channel in log.channels
    ]


def _units(log: Log, recording: Recording, topics: Sequence[str]) -> Iterator[dict[str, Any]]:
    """The lists of each unit, or what is wrong with them: `problem`."""
    osis = {c.topic for c in log.channels if c.schema == osi.SENSOR_DATA}
    for topic in dict.fromkeys(topics):
        said: dict[str, Any] = {"topic": topic, "lists": 0, "entries": 0}
        said |= {"covariances_said": False, "captures_said": False, "problem": None}
        try:
            found = _lists(recording, topic, of_osi=topic in osis)
        except RecordingError as error:
            yield said | {"problem": "; ".join(error.within(recording.path, topic))}
            continue
        said |= {"lists": len(found.tracks.stamp_ns), "entries": len(found.tracks.frame_ix)}
        said |= {"covariances_said": bool(found.spread_said.all()), "captures_said": bool(found.capture_said.all())}
        yield said | {"problem": None if said["lists"] else "holds no list"}


def _lists(recording: Recording, topic: str, *, of_osi: bool) -> RecordedLists:
    """As a recorded unit has them. Raises RecordingError."""
    if of_osi:
        from copem_replay.io.recorded_osi import read_recorded

        return read_recorded(recording.path, topic, recording.scene)
    from copem_replay.io.recorded_lists import read_listed

    found = read_listed(recording.path, topic, recording.scene, recording.around)
    if found is None:
        raise RecordingError("holds no list", path=recording.path, topic=topic)
    return found


def _proposals(log: Log, topics: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Lists by the names of their fields; `truth`: what is read so, as in a survey, null where not all was found."""
    if not foreign(log):
        return []
    from copem_replay.experiment.draft.field_trial import proposals
    from copem_replay.io.schemas.description import Fields

    made = []
    for proposal, recording in proposals(log, log.path.stem):
        truth = None
        if recording is not None:
            fields = Fields.model_validate({k: v for k, v in proposal["read"].items() if k != "topic"})
            truth = _truth(log, recording, topics, fields)
        made.append(proposal | {"truth": truth})
    return made


def _truth(
    log: Log, recording: Recording, topics: Sequence[dict[str, Any]], fields: Fields | None = None
) -> dict[str, Any]:
    """One list of true objects, and what the other topics are to it."""
    scene, truth = recording.scene, recording.truth
    poses = [t["topic"] for t in topics if t["role"] == "poses" and t["messages"]]
    units = [t["topic"] for t in topics if t["role"] == "unit" and t["messages"]]
    units = [name for name in units if name != recording.topic and not name.startswith(_OURS)]
    between_s = np.diff(truth.stamp_ns) * 1e-9
    longest = int(between_s.argmax()) if len(between_s) else 0
    inside_s = np.diff(truth.row_captured_s)[np.diff(truth.track_ix) == 0]
    return {
        "topic": recording.topic,
        "frames": len(truth.stamp_ns),
        "states": len(truth.frame_ix),
        "start_ns": scene.t0_ns,
        "span_s": round(scene.end_s, 9),
        "rate_hz": round(1.0 / float(np.median(between_s)), 3) if len(between_s) else None,
        "longest_gap_s": round(float(between_s[longest]), 9) if len(between_s) else None,
        "longest_gap_at_s": round(float(truth.captured_s[longest]), 9) if len(between_s) else None,
        "gaps_inside_tracks": int((inside_s > MAX_GAP_S).sum()),
        "x_m": _extent(truth.x_m[0]),
        "y_m": _extent(truth.y_m[0]),
        "moving": _by_class(scene, scene.moving),
        "stationary": _by_class(scene, ~scene.moving),
        "host_id": recording.host_id,
        "ego": _ego(recording),
        "missing": _missing(recording, poses),
        "damage": recording.damage,
        "notes": list(recording.notes),
        "vehicles": moving_ids(scene, shown=6),
        "units": list(_units(log, recording, units)),
        "suggested": suggestion(log, recording, fields),
    }


def _extent(values: Float) -> list[float]:
    """From where to where the centres of the boxes lie."""
    return [round(float(values.min()), 1), round(float(values.max()), 1)]


def _by_class(scene: Scene, which: Bool) -> dict[str, int]:
    counts = np.bincount(scene.object_class[which], minlength=len(CLASSES)).tolist()
    return {name: number for name, number in zip(CLASSES, counts, strict=True) if number}


def _ego(recording: Recording) -> dict[str, Any] | None:
    """Describe the ego vehicle the log names: its size at its first frame, and when it is there."""
    scene, truth = recording.scene, recording.truth
    if scene.ego_ix < 0:
        return None
    first, last = (int(truth.start[scene.ego_ix + k]) - k for k in (0, 1))
    return {
        "id": scene.object_ids[scene.ego_ix],
        "class": CLASSES[scene.object_class[scene.ego_ix]],
        "size_m": [round(float(a[0, first]), 3) for a in (truth.length_m, truth.width_m, truth.height_m)],
        "from_s": round(float(truth.row_captured_s[first]), 9),
        "to_s": round(float(truth.row_captured_s[last]), 9),
    }


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


def _topic_lines(survey: dict[str, Any]) -> list[str]:
    """Tabulate the topics."""
    rows = [("topic", "schema", "encoding", "messages", "")]
    rows += [
        (
            printable(t["topic"]),
            printable(t["schema"]) or "-",
            printable(t["encoding"]) or "-",
            str(t["messages"]),
            _said(t, survey),
        )
        for t in survey["topics"]
    ]
    a, b, c, d = (max(len(row[k]) for row in rows) for k in range(4))
    table = [f"  {w:<{a}}  {x:<{b}}  {y:<{c}}  {z:>{d}}  {role}".rstrip() for w, x, y, z, role in rows]
    return table if survey["topics"] else []


def _said(topic: dict[str, Any], survey: dict[str, Any]) -> str:
    """What a topic is, in words."""
    role = topic["role"]
    if role == "truth" and survey["choice"]:
        return "may be the truth: `read: {topic: …}`"
    if role == "truth" and survey["truth"] and topic["topic"] != survey["truth"][0]["topic"]:
        return "truth, too, but not taken"
    egos = [truth["suggested"]["ego"] for truth in survey["truth"]]
    if role == "poses" and any(isinstance(ego, dict) and ego["topic"] == topic["topic"] for ego in egos):
        return "poses, of the ego it seems"
    return _ROLES[role]


def _truth_lines(truth: dict[str, Any]) -> list[str]:
    """One list of true objects."""
    lines = [f"truth: {truth['topic']}"]
    span = f"  {counted(truth['frames'], 'frame')}, {truth['span_s']:.3f} s"
    if truth["rate_hz"] is not None:
        span += f", {truth['rate_hz']:.2f} Hz (median)"
        span += f", longest gap {truth['longest_gap_s']:.3f} s at {truth['longest_gap_at_s']:.3f} s"
    lines.append(span)
    (x0, x1), (y0, y1) = truth["x_m"], truth["y_m"]
    lines.append(f"  within x {x0:g} … {x1:g} m, y {y0:g} … {y1:g} m")
    if truth["gaps_inside_tracks"]:
        lines.append(f"  {counted(truth['gaps_inside_tracks'], 'gap')} above {MAX_GAP_S:g} s inside tracks")
    for kind in ("moving", "stationary"):
        objects = ", ".join(f"{number} {name}" for name, number in truth[kind].items())
        lines.append(f"  {kind}: {objects or 'none'}")
    if ego := truth["ego"]:
        size = " × ".join(f"{side:.2f}" for side in ego["size_m"])
        lines.append(f"  ego: {ego['id']} ({ego['class']}, {size} m), {ego['from_s']:.3f} – {ego['to_s']:.3f} s")
    for unit in truth["units"]:
        if unit["problem"]:
            lines.append(f"  unit {unit['topic']}: {unit['problem']}")
            continue
        unsaid = [] if unit["covariances_said"] else ["no covariances"]
        unsaid += [] if unit["captures_said"] else ["not when captured"]
        said = f"{counted(unit['lists'], 'list')}, {counted(unit['entries'], 'entry', 'entries')}"
        lines.append(f"  unit {unit['topic']}: {said}" + (f"; says {' and '.join(unsaid)}" if unsaid else ""))
    lines += [f"  missing: {line}" for line in truth["missing"]]
    return lines + [f"  note: {line}" for line in truth["notes"]]

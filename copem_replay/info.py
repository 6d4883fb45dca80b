"""What is in a recording, as data (`survey`) and as lines of text (`describe`)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from copem_replay import container
from copem_replay.container import Channel
from copem_replay.errors import RecordingError
from copem_replay.formats import osi
from copem_replay.read import Recording, choose_topic, is_truth, moving_ids, read_log, truth_topics
from copem_replay.repair import MAX_GAP_S
from copem_replay.tracks import CLASSES, Bool, Float, Scene
from copem_replay.wording import counted

_ROLES = {
    "truth": "the truth",
    "unit": "lists of a unit, for `recorded: {topic: …}`",
    "unread": "not read by this version",
}
_EGO_HINT = "give `ego: <id>` in the experiment, or `--ego <id>`"


def survey(path: Path | str) -> dict[str, Any]:
    """Look at a recording: plain data that JSON can hold, the same for the same bytes.

    `readable`: whether a list of true objects could be read; if not, `reason` says why in a line, and `topics` what
    the file holds all the same. `truth` has an entry per topic that could be the truth: one, unless there is a
    choice to make (then `choice` says so). A bad recording raises nothing.
    """
    found: dict[str, Any] = {"recording": Path(path).name, "readable": False, "reason": None, "choice": None}
    found |= {"damage": None, "topics": [], "truth": []}  # damage: of the file, what is wrong with it
    try:
        log = container.open_log(Path(path))
    except RecordingError as error:
        return found | {"reason": str(error)}
    found |= {"damage": log.damage, "topics": [_topic(c) for c in log.channels]}
    try:
        topics = [choose_topic(log)[0]]
    except RecordingError as error:
        topics = list(truth_topics(log))
        found["choice" if topics else "reason"] = str(error)
    failures = []
    for topic in topics:
        try:
            found["truth"].append(_truth(read_log(log, name=Path(path).stem, topic=topic)))
        except RecordingError as error:
            failures.append(str(error))
    if failures and not found["truth"]:
        found["reason"] = "; ".join(failures)
    damage = next((t["damage"] for t in found["truth"] if t["damage"]), found["damage"])
    return found | {"readable": bool(found["truth"]), "damage": damage}


def describe(survey: dict[str, Any]) -> list[str]:
    """Say in lines of plain text what `survey` found. Why it found no truth is left to `reason`."""
    lines: list[str] = [survey["recording"], *_topic_lines(survey["topics"])]
    for truth in survey["truth"]:
        lines += _truth_lines(truth)
    return lines + ([survey["choice"]] if survey["choice"] else [])


def _topic(channel: Channel) -> dict[str, Any]:
    role = "truth" if is_truth(channel) else "unit" if channel.schema == osi.SENSOR_DATA else "unread"
    return {
        "topic": channel.topic,
        "schema": channel.schema,
        "encoding": channel.encoding,
        "messages": channel.messages,
        "role": role,
    }


def _truth(recording: Recording) -> dict[str, Any]:
    """One list of true objects."""
    scene, truth = recording.scene, recording.truth
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
        "missing": _missing(recording),
        "damage": recording.damage,
        "notes": list(recording.notes),
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


def _missing(recording: Recording) -> list[str]:
    """Say what a user may have to give."""
    scene = recording.scene
    if scene.ego_ix >= 0:
        return []
    host = recording.host_id
    who = "the log names no host vehicle" if host is None else f"the host vehicle {host} is no moving object"
    return [f"no ego vehicle: {who}; {_EGO_HINT}, of {moving_ids(scene, shown=6)}"]


def _topic_lines(topics: Sequence[dict[str, Any]]) -> list[str]:
    """Tabulate the topics."""
    rows = [("topic", "schema", "encoding", "messages", "")]
    rows += [
        (t["topic"], t["schema"] or "-", t["encoding"] or "-", str(t["messages"]), _ROLES[t["role"]]) for t in topics
    ]
    a, b, c, d = (max(len(row[k]) for row in rows) for k in range(4))
    table = [f"  {w:<{a}}  {x:<{b}}  {y:<{c}}  {z:>{d}}  {role}".rstrip() for w, x, y, z, role in rows]
    return table if topics else []


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
    lines += [f"  missing: {line}" for line in truth["missing"]]
    return lines + [f"  note: {line}" for line in truth["notes"]]

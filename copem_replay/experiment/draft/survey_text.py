"""A survey of a recording in lines of plain text: topics, truth, units, and how to begin."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import Final

from copem_replay.core.errors import printable
from copem_replay.core.text import counted
from copem_replay.experiment.draft.findings import Role, Survey, TopicFound, TruthFound, UnitFound
from copem_replay.experiment.draft.template import read_block
from copem_replay.io.plausibility import MAX_GAP_S

_ROLES: Final[Mapping[Role, str]] = {
    "truth": "the truth",
    "unit": "lists of a unit, for `recorded: {topic: …}`",
    "poses": "poses",
    "unread": "not read",
}


def describe(survey: Survey, width: int | None = None) -> list[str]:
    """Say in lines of plain text what a look at a recording found. Why it found no truth is left to `reason`.

    `width`: of the terminal; a table of topics that is wider has two lines per topic.
    """
    lines: list[str] = [survey.recording, *_topic_lines(survey, width)]
    for truth in survey.truth:
        lines += _truth_lines(truth)
    lines += [line for unit in survey.units for line in _unit_lines(unit)]
    lines += [survey.choice] if survey.choice else []
    for proposal in survey.proposals:
        lines.append(f"{proposal.topic} may be read as a list of objects, by the names of its fields:")
        lines += [f"  {line}" for line in read_block(proposal)]
    if survey.readable:
        lines.append(f"experiment: copem-replay init {shlex.quote(survey.log)} > experiment.yaml")
    return [printable(line) for line in lines]


def _topic_lines(survey: Survey, width: int | None) -> list[str]:
    """Tabulate the topics."""
    rows = [("topic", "schema", "encoding", "messages", "")]
    rows += [
        (
            printable(t.topic),
            printable(t.schema) or "-",
            printable(t.encoding) or "-",
            str(t.messages),
            _said(t, survey),
        )
        for t in survey.topics
    ]
    a, b, c, d = (max(len(row[k]) for row in rows) for k in range(4))
    table = [f"  {w:<{a}}  {x:<{b}}  {y:<{c}}  {z:>{d}}  {role}".rstrip() for w, x, y, z, role in rows]
    if width is not None and max(map(len, table)) > width:
        table = [line for row in rows for line in (f"  {row[0]}", f"      {'  '.join(filter(None, row[1:]))}")]
    return table if survey.topics else []


def _said(topic: TopicFound, survey: Survey) -> str:
    """What a topic is, in words."""
    role = topic.role
    if role == "truth" and survey.choice:
        return "may be the truth: `read: {topic: …}`"
    if role == "truth" and survey.truth and topic.topic != survey.truth[0].topic:
        return "truth, too, but not taken"
    egos = [truth.suggested.ego for truth in survey.truth]
    if role == "poses" and any(isinstance(ego, dict) and ego["topic"] == topic.topic for ego in egos):
        return "poses, of the ego it seems"
    return _ROLES[role]


def _truth_lines(truth: TruthFound) -> list[str]:
    """One list of true objects."""
    lines = [f"truth: {truth.topic}"]
    span = f"  {counted(truth.frames, 'frame')}, {truth.span_s:.3f} s"
    if truth.rate_hz is not None:
        span += f", {truth.rate_hz:.2f} Hz (median)"
        span += f", longest gap {truth.longest_gap_s:.3f} s at {truth.longest_gap_at_s:.3f} s"
    lines.append(span)
    (x0, x1), (y0, y1) = truth.x_m, truth.y_m
    lines.append(f"  within x {x0:g} … {x1:g} m, y {y0:g} … {y1:g} m")
    if truth.gaps_inside_tracks:
        lines.append(f"  {counted(truth.gaps_inside_tracks, 'gap')} above {MAX_GAP_S:g} s inside tracks")
    for kind, counts in (("moving", truth.moving), ("stationary", truth.stationary)):
        objects = ", ".join(f"{number} {name}" for name, number in counts.items())
        lines.append(f"  {kind}: {objects or 'none'}")
    if ego := truth.ego:
        size = " × ".join(f"{side:.2f}" for side in ego.size_m)
        lines.append(f"  ego: {ego.id} ({ego.class_}, {size} m), {ego.from_s:.3f} – {ego.to_s:.3f} s")
    for unit in truth.units:
        lines += [f"  {line}" for line in _unit_lines(unit)]
    lines += [f"  missing: {line}" for line in truth.missing]
    return lines + [f"  note: {line}" for line in truth.notes]


def _unit_lines(unit: UnitFound) -> list[str]:
    """The lists of one unit."""
    if unit.problem:
        return [f"unit {unit.topic}: {unit.problem}"]
    unsaid = [] if unit.covariances_said else ["covariances"]
    unsaid += [] if unit.captures_said else ["captures"]
    said = f"{counted(unit.lists, 'list')}, {counted(unit.entries, 'entry', 'entries')}"
    said += f", {unit.rate_hz:.2f} Hz (median)" if unit.rate_hz is not None else ""
    lines = [f"unit {unit.topic}: {said}" + (f"; without {' and '.join(unsaid)}" if unsaid else "")]
    if unit.delay is not None:
        lines.append(f"  delay_s against the truth {'' if unit.delay_s is None else 'is '}{unit.delay}")
    return lines + [f"  {line}" for line in unit.oddities]

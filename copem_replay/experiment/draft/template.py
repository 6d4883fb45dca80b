"""The text of a draft: an experiment on a recording, from its survey; and the survey in plain text."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final

from copem_replay.core.errors import count_noun, escape_unprintable
from copem_replay.core.yaml import dump_on_one_line
from copem_replay.experiment.draft.findings import (
    FEWEST_COUNTED,
    RANGE_M,
    ProposalFound,
    RecordingSurvey,
    Role,
    Suggestion,
    TopicFound,
    TruthFound,
    UnitFound,
)
from copem_replay.io.ground_truth import MAX_GAP_S

_WORDS = ("null", "true", "false")
_UNIT = "[[0.5, 0.0], [0.0, 0.5]]"
_GENERIC = {"objects", "object", "sensordata", "detections", "tracks", "lists", "list", "markers", "data", "msg"}
_FUSED = {"fusion", "fused", "stack"}
"""Words in the topic of a stack's own output."""
_OTHERS = 6  # topics listed in comments, at most: a line each


def format_draft(survey: RecordingSurvey) -> str:
    """The experiment with a comment on each key; it runs unchanged."""
    truth = max(survey.truth, key=lambda truth: truth.states)
    guess = truth.suggested
    recorded, outputs = _name_recorded(truth)
    ego = guess.ego != "none"
    first = ["ego", "roadside"] if ego else ["roadside", "across"]
    lines = [
        f"# Replays {_format_comment(survey.recording)}, {truth.span_s:.1f} s: {_describe_objects(truth)}.",
        "# Written by `copem-replay init`, as a starting point.",
        "#",
        "#   copem-replay check experiment.yaml",
        "#   copem-replay run experiment.yaml && copem-replay view out/experiment",
        "version: 1",
        f"logs: [{quote_yaml(survey.log)}]   # relative to this file, or absolute; globs work",
        *_draft_read(survey, truth),
        *_draft_ego(truth, guess),
        "runs: 20   # each with its own draws, the same in all configurations; more make the intervals narrower",
        "seed: 1",
        "",
        "# Perception error models: is an object in a unit's list, and how far off? The first couple whose `when`",
        "# holds applies; where none holds, nothing is listed. These numbers are examples: yours belong here.",
        "pems:",
        *_ONBOARD * ego,
        *_ROADSIDE,
        "",
        "units:",
        *_draft_units(guess, recorded, truth.units, ego=ego),
        "",
        "configurations:",
        *_draft_configurations(first, [name for name, _ in recorded], ego=ego),
        *_draft_outputs(outputs, [name for name, _ in recorded]),
        "",
        *_draft_measure(guess, ego=ego),
        "show: {run: 0}   # the run that replay.mcap and replay.rrd show; {run: null} writes none",
    ]
    return "\n".join(lines) + "\n"


def format_proposed_draft(survey: RecordingSurvey) -> str | None:
    """The experiment on a list that is read by the names of its fields; None: no proposal is complete."""
    whole = [(truth, proposal) for proposal in survey.proposals if (truth := proposal.truth) is not None]
    if not whole:
        return None
    truth, best = max(whole, key=lambda one: one[0].states)
    return format_draft(replace(survey, truth=[truth], proposals=[best]))


def format_unfinished_draft(survey: RecordingSurvey) -> str:
    """`read:` of each proposal as comments, with its missing keys and the fields of its messages."""
    lines = []
    for proposal in survey.proposals:
        lines += [f"# {_format_comment(proposal.topic)} ({_format_comment(proposal.schema)}) may be a list of objects:"]
        lines += [f"# {line}" for line in format_read_block(proposal)]
        lines += [f"# its messages have: {_format_comment(', '.join(proposal.offers))}"]
        lines += [f"# {_format_comment(proposal.problem)}"] if proposal.problem else []
    return "\n".join(lines) + "\n" if lines else ""


def format_read_block(proposal: ProposalFound) -> list[str]:
    """The lines of `read:` as proposed."""
    lines = ["read:   # proposed from the names of its fields: look at each"]
    for key, value in proposal.read.items():
        lines.append(f"  {key}: {dump_on_one_line(value)}" + (f"   # {_ON_KEYS[key]}" if key in _ON_KEYS else ""))
    lines += [f"  # {key}: …   # needed, and not found: {_NEEDED.get(key, 'a path')}" for key in proposal.missing]
    return lines


_ON_KEYS = {
    "stamp": "without it: when it was logged",
    "class": "{path: …, map: {1: car}} where values are not names",
    "z_m": "of the centre of the box",
    "vx_mps": "along the axes of the frame; `velocity: object`: along the object",
}
_NEEDED = dict.fromkeys(("length_m", "width_m"), "a path, or one number for all")


_ONBOARD = [
    "  onboard:",
    "    - when: {range_m: [0, 80], azimuth_deg: [-60, 60]}   # far ahead",
    "      detection: {kind: visible_share}   # listed with the probability of its visible share; or constant, table",
    "      # variances in m² along and across the line of sight; left out: exact",
    "      error: {kind: gaussian, frame: line_of_sight, covariance_m2: [[0.5, 0.0], [0.0, 0.1]]}",
    "    - when: {range_m: [0, 30]}   # near, all around",
    "      detection: {kind: visible_share}",
    "      error: {kind: gaussian, frame: line_of_sight, covariance_m2: [[0.3, 0.0], [0.0, 0.1]]}",
]
_ROADSIDE = [
    "  roadside:",
    "    - when: {range_m: [0, 70], azimuth_deg: [-60, 60]}",
    "      detection: {kind: visible_share}",
    "      error: {kind: gaussian, frame: line_of_sight, covariance_m2: [[0.6, 0.0], [0.0, 0.3]]}",
]


def _describe_objects(truth: TruthFound) -> str:
    return ", ".join(f"{number} {name}" for name, number in truth.moving.items()) or "nothing that moves"


def _draft_read(survey: RecordingSurvey, truth: TruthFound) -> Iterator[str]:
    if survey.proposals:
        yield from format_read_block(survey.proposals[0])
    if not survey.choice:
        return
    others = [t.topic for t in survey.truth if t.topic != truth.topic]
    yield f"read: {{topic: {quote_yaml(truth.topic)}}}   # where the truth is"
    yield from (f"# read: {{topic: {quote_yaml(topic)}}}   # could be it, too" for topic in others[:_OTHERS])


def _draft_ego(truth: TruthFound, guess: Suggestion) -> Iterator[str]:
    """The lines of `ego:`: as in the log, or a guess with its reason."""
    ego, why = guess.ego, _format_comment(guess.ego_why)
    if ego is None:
        yield f"# ego: <id>   # left out: {why}"
    elif isinstance(ego, dict):
        yield f"ego:   # {why}"
        yield from (f"  {key}: {quote_yaml(value)}" for key, value in ego.items())
        yield "  # size_m: [4.5, 1.8, 1.5]   # its length, width, height: without, gaps and braking are unknown"
        yield "  # centre_from_rear_axle_m: 1.4   # from these poses, often the rear axle's, ahead to its centre"
    else:
        yield f"# {why}"
        yield f"ego: {quote_yaml(ego)}" + (
            "" if ego == "none" else "   # a guess; none: no ego, a mast judged by itself"
        )
        if ids := truth.vehicles:
            yield f"# ego: <id>   # of {_format_comment(ids)}"


def _draft_units(
    guess: Suggestion,
    recorded: Sequence[tuple[str, UnitFound]],
    lists: Sequence[UnitFound],
    *,
    ego: bool,
) -> Iterator[str]:
    if ego:
        yield "  ego: {on: ego, pem: onboard}   # on the roof, or at height_m; a list per frame, or rate_hz"
        yield "  # A mast where most measured objects come by: x, y in metres as in the log, yaw_deg from the x axis"
    else:
        yield "  # Two masts that face each other where most objects come by: x, y in metres as in the log"
    for name, mast in zip(("roadside", "across"), guess.masts[: 1 if ego else 2], strict=False):
        yield f"  {name}: {{at: {dump_on_one_line(mast.at)}, yaw_deg: {mast.yaw_deg}, height_m: 6.0, pem: roadside}}"
    if ego:
        yield "  # others: {on: {classes: [car, truck], penetration_rate: 0.3}, pem: onboard}   # 30 % of them (V2V)"
    if recorded:
        yield "  # Lists as they were recorded. `delay_s`, `covariance_m2`: for messages that don't say when they were"
        yield "  # captured, and how uncertain they are."
    for name, unit in recorded:
        yield from (f"  # {_format_comment(line)}" for line in unit.oddities)
        late = "" if unit.delay is None else f"   # delay_s {_format_comment(unit.delay)}"
        yield f"  {name}: {{recorded: {_format_recorded(unit)}}}{late}"
    for unit in lists:
        if unit.problem:
            yield f"  # {quote_yaml(unit.topic)} cannot be a unit: {_format_comment(unit.problem)}"


def _draft_configurations(first: Sequence[str], recorded: Sequence[str], *, ego: bool) -> Iterator[str]:
    """Configurations: the truth, one unit alone, both at once and late, and with a fusion without truth ids."""
    both = f"{{units: [{', '.join(first)}]"
    rows = [
        ("GT", "{units: truth}", "all that is there, at once, without error"),
        ("PEM", f"{{units: [{first[0]}]}}", "the vehicle on its own" if ego else "one mast on its own"),
        ("coPEM:0s", f"{both}, fusion: {{kind: ideal}}}}", "together"),
        ("coPEM:0.5s", f"{both}, fusion: {{kind: ideal}}, latency_s: 0.5}}", "the whole list late"),
        ("gnn:0.5s", f"{both}, fusion: {{kind: gnn}}, latency_s: 0.5}}", "a fusion without truth ids"),
    ]  # fmt: skip
    for name in recorded:
        rows.append((name, f"{{units: [{name}], fusion: {{kind: gnn}}}}", "as it was recorded"))
        if not (ego and name.startswith("ego")):  # else the ego twice, as recorded and as modelled
            rows.append((f"with {name}", f"{{units: [{first[0]}, {name}], fusion: {{kind: gnn}}}}", "and together"))
    if len(recorded) > 1:
        rows.append(("recorded", f"{{units: [{', '.join(recorded)}], fusion: {{kind: gnn}}}}", "all of them"))
    width = max(len(name) for name, _, _ in rows) + 1
    for name, value, what in rows:
        yield f"  {name + ':':<{width}} {value}   # {what}"


def _draft_outputs(outputs: Sequence[tuple[str, UnitFound]], recorded: Sequence[str]) -> Iterator[str]:
    """Configurations of a stack's recorded outputs, told by their topics: measured like a fusion."""
    for name, unit in outputs:
        yield "  # By its name a stack's own output, and its inputs; if it is not, use it as a unit"
        yield from (f"  # {_format_comment(line)}" for line in unit.oddities)
        late = "" if unit.delay is None else f"   # delay_s {_format_comment(unit.delay)}"
        yield f"  {name}: {{recorded: {_format_recorded(unit)}, inputs: [{', '.join(recorded)}]}}{late}"


def _draft_measure(guess: Suggestion, *, ego: bool) -> Iterator[str]:
    kinds = {"vru": "pedestrians, bicycles, motorcycles", "vehicles": "cars, trucks, …"}
    yield "measure:"
    if guess.classes:
        text = ", ".join(kinds[name] for name in guess.classes)
        yield f"  objects: {{classes: {dump_on_one_line(guess.classes)}}}   # {text}; or {{ids: [1, 2]}}; left out: all"
    else:
        yield "  # objects: {classes: [vru]}   # left out: all that moves but the ego"
    if guess.onset == "appears":
        yield f"  onset: {{kind: appears}}   # the clock starts; in_range: nobody is within {RANGE_M:g} m of the ego"
    else:
        yield (
            f"  onset: {{kind: in_range, range_m: {RANGE_M:g}}}   # the clock starts; or appears, starts_moving, "
            "line_of_sight"
        )
    yield _draft_began(guess)
    yield "  horizon_s: 5   # means are of min(time, 5 s)"
    if not ego:
        yield "  distance_to: roadside   # there is no ego: ranges and distances are from here"
    yield "  confirm: {hits: 1, of: 1}   # known when so many of the last lists hold it"


def _draft_began(guess: Suggestion) -> str:
    """The line of `began`: its default as a comment, or all three words, with the reason."""
    if guess.began is None:
        return "  began: [log_start, crossed, appeared]   # who counts: all, for nobody crosses into view"
    numbers = ", ".join(f"{number} {word}" for word, number in guess.began.items())
    if guess.began["crossed"] + guess.began["appeared"] < FEWEST_COUNTED:
        return f"  began: [log_start, crossed, appeared]   # who counts: all, for there are only {numbers}"
    return f"  # began: [crossed, appeared]   # who counts; left out: these ({numbers})"


def _name_recorded(truth: TruthFound) -> tuple[list[tuple[str, UnitFound]], list[tuple[str, UnitFound]]]:
    """The lists that could be read, by names made from their topics: those of units, and outputs of a stack."""
    named: dict[str, UnitFound] = {}
    taken = {"ego", "roadside", "across", "others", "default", "truth", "all", "gt", "pem", "copem", "gnn", "recorded"}
    for unit in truth.units:
        if unit.problem:
            continue
        words = [word for word in re.split(r"[^a-z0-9]+", unit.topic.lower()) if word]
        telling = [word for word in words if word not in _GENERIC and word[0].isalpha() and word not in _WORDS]
        stem = telling[-1] if telling else "lists"
        tries = [stem, *([f"{stem}_recorded"] if stem in taken else []), *(f"{stem}{k}" for k in range(2, 99))]
        name = next(name for name in tries if name not in taken and name not in named)
        named[name] = unit
    fused = {name for name, unit in named.items() if _FUSED & set(re.split(r"[^a-z0-9]+", unit.topic.lower()))}
    fused = fused if len(fused) < len(named) else set()
    return [one for one in named.items() if one[0] not in fused], [one for one in named.items() if one[0] in fused]


def _format_recorded(unit: UnitFound) -> str:
    parts = [f"topic: {quote_yaml(unit.topic)}"]
    parts += [] if unit.captures_said else [f"delay_s: {unit.delay_s or 0.0}"]
    parts += [] if unit.covariances_said else [f"covariance_m2: {_UNIT}"]
    return f"{{{', '.join(parts)}}}"


def quote_yaml(text: str) -> str:
    """Text as a YAML scalar; whole numbers are not quoted, as ids may be numbers."""
    return text if text.isascii() and text.isdecimal() and str(int(text)) == text else dump_on_one_line(text)


def _format_comment(text: str) -> str:
    """The text on one line, for a comment."""
    return "".join(c if c.isprintable() else " " for c in text)


# A survey as lines of plain text: topics, truth, units, and the next command.

_ROLES: Final[Mapping[Role, str]] = {
    "truth": "the truth",
    "unit": "lists of a unit, for `recorded: {topic: …}`",
    "poses": "poses",
    "unread": "not read",
}


def describe_survey(survey: RecordingSurvey, width: int | None = None) -> list[str]:
    """The findings of a survey as lines of plain text, without its `reason`.

    `width`: of the terminal; a table of topics that is wider has two lines per topic.
    """
    lines: list[str] = [survey.recording, *_topic_lines(survey, width)]
    for truth in survey.truth:
        lines += _truth_lines(truth)
    lines += [line for unit in survey.units for line in _unit_lines(unit)]
    lines += [survey.choice] if survey.choice else []
    for proposal in survey.proposals:
        lines.append(f"{proposal.topic} may be read as a list of objects, by the names of its fields:")
        lines += [f"  {line}" for line in format_read_block(proposal)]
    if survey.readable:
        lines.append(f"experiment: copem-replay init {shlex.quote(survey.log)} > experiment.yaml")
    return [escape_unprintable(line) for line in lines]


def _topic_lines(survey: RecordingSurvey, width: int | None) -> list[str]:
    """The table of topics."""
    rows = [("topic", "schema", "encoding", "messages", "")]
    rows += [
        (
            escape_unprintable(t.topic),
            escape_unprintable(t.schema) or "-",
            escape_unprintable(t.encoding) or "-",
            str(t.messages),
            _describe_topic(t, survey),
        )
        for t in survey.topics
    ]
    a, b, c, d = (max(len(row[k]) for row in rows) for k in range(4))
    table = [f"  {w:<{a}}  {x:<{b}}  {y:<{c}}  {z:>{d}}  {role}".rstrip() for w, x, y, z, role in rows]
    if width is not None and max(map(len, table)) > width:
        table = [line for row in rows for line in (f"  {row[0]}", f"      {'  '.join(filter(None, row[1:]))}")]
    return table if survey.topics else []


def _describe_topic(topic: TopicFound, survey: RecordingSurvey) -> str:
    """The role of a topic, in words."""
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
    """The lines on one list of true objects."""
    lines = [f"truth: {truth.topic}"]
    span = f"  {count_noun(truth.frames, 'frame')}, {truth.span_s:.3f} s"
    if truth.rate_hz is not None:
        span += f", {truth.rate_hz:.2f} Hz (median)"
        span += f", longest gap {truth.longest_gap_s:.3f} s at {truth.longest_gap_at_s:.3f} s"
    lines.append(span)
    (x0, x1), (y0, y1) = truth.x_m, truth.y_m
    lines.append(f"  within x {x0:g} … {x1:g} m, y {y0:g} … {y1:g} m")
    if truth.gaps_inside_tracks:
        lines.append(f"  {count_noun(truth.gaps_inside_tracks, 'gap')} above {MAX_GAP_S:g} s inside tracks")
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
    """The lines on the lists of one unit."""
    if unit.problem:
        return [f"unit {unit.topic}: {unit.problem}"]
    unsaid = [] if unit.covariances_said else ["covariances"]
    unsaid += [] if unit.captures_said else ["captures"]
    counts = f"{count_noun(unit.lists, 'list')}, {count_noun(unit.entries, 'entry', 'entries')}"
    counts += f", {unit.rate_hz:.2f} Hz (median)" if unit.rate_hz is not None else ""
    lines = [f"unit {unit.topic}: {counts}" + (f"; without {' and '.join(unsaid)}" if unsaid else "")]
    if unit.delay is not None:
        lines.append(f"  delay_s against the truth {'' if unit.delay_s is None else 'is '}{unit.delay}")
    return lines + [f"  {line}" for line in unit.oddities]

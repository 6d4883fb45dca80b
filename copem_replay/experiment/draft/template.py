"""The text of a draft: an experiment on a recording, from its survey; and the survey in plain text."""

from __future__ import annotations

import math
import re
import shlex
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

from copem_replay.core.errors import count_noun, escape_unprintable
from copem_replay.core.tracks import CLASSES
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
_KINDS = {"vru": "pedestrians, bicycles, motorcycles", "vehicles": "cars, trucks, …"}
_OTHERS = 6  # topics listed in comments, at most: a line each


@dataclass(frozen=True)
class _Drive:
    """A log of a draft: its survey, and the list of true objects that is taken."""

    survey: RecordingSurvey
    truth: TruthFound

    @property
    def guess(self) -> Suggestion:
        return self.truth.suggested

    @property
    def has_ego(self) -> bool:
        return self.guess.ego != "none"

    def find_unit(self, topic: str) -> UnitFound | None:
        """The lists on a topic; None: the log has none, or none that can be read."""
        return next((unit for unit in self.truth.units if unit.topic == topic and unit.problem is None), None)


def format_draft(*surveys: RecordingSurvey) -> str:
    """The experiment on one log or several, each surveyed, with a comment on each key; it runs unchanged."""
    drives = [_Drive(survey, max(survey.truth, key=lambda truth: truth.states)) for survey in surveys]
    drives, few = _widen_classes(drives)
    recorded, outputs = _name_recorded(drives)
    ego = any(drive.has_ego for drive in drives)
    first = ["ego", "roadside"] if ego else ["roadside", "across"]
    lines = [
        *_draft_head(drives, few),
        "version: 1",
        *(_draft_only_log(drives[0]) if len(drives) == 1 else _draft_logs(drives, first, recorded)),
        "runs: 20   # each with its own draws, the same in all configurations; more say nothing of other drives",
        "seed: 1",
        "",
        "# Perception error models: is an object in a unit's list, and how far off? The first couple whose `when`",
        "# holds applies; where none holds, nothing is listed. These numbers are examples: yours belong here.",
        "pems:",
        *_ONBOARD * ego,
        *_ROADSIDE,
        "",
        "units:",
        *_draft_units(drives, recorded, ego=ego),
        "",
        *_draft_links(drives),
        "",
        "configurations:",
        *_draft_configurations(first, [name for name, _ in recorded], ego=ego),
        *_draft_outputs(outputs, [name for name, _ in recorded]),
        "",
        *_draft_measure(_merge_measured(drives), few, ego=ego),
        *_draft_braking(drives, ego=ego),
        *_draft_gap(drives),
        "show: {run: 0}   # the run that replay.mcap and replay.rrd show; {run: null} writes none",
    ]
    return "\n".join(lines) + "\n"


def _widen_classes(drives: list[_Drive]) -> tuple[list[_Drive], tuple[str, str] | None]:
    """The drives, with all classes where too few of their own would count; then who these are, and their key."""
    merged = _merge_measured(drives)
    counted, of_all = _sum_began(merged).total(), sum(merged.began["all"].values())
    if merged.classes is None or merged.onset == "appears" or counted >= FEWEST_COUNTED or of_all <= counted:
        return drives, None
    wide = [replace(drive.guess, classes=None, masts=drive.guess.masts_of_all) for drive in drives]
    widened = [replace(drive, truth=replace(drive.truth, suggested=of)) for drive, of in zip(drives, wide, strict=True)]
    said = " and ".join(_KINDS[name] for name in merged.classes)
    return widened, (
        f"{said} only {counted}",
        f"objects: {{classes: {dump_on_one_line(merged.classes)}}}   # {said} alone",
    )


def _sum_began(guess: Suggestion) -> Counter[str]:
    """How many of the measured classes begin how."""
    began = Counter[str]()
    for name in guess.classes or ["all"]:
        began.update(guess.began[name])
    return began


def _counts_all(guess: Suggestion) -> bool:
    """Whether objects of the log's start count, too, for there are few others."""
    began = _sum_began(guess)
    return began["crossed"] + began["appeared"] < FEWEST_COUNTED


def _draft_head(drives: Sequence[_Drive], few: tuple[str, str] | None) -> Iterator[str]:
    of = _format_comment(drives[0].survey.recording) if len(drives) == 1 else f"{len(drives)} drives"
    span_s = sum(drive.truth.span_s for drive in drives)
    yield f"# Replays {of}, {span_s:.1f} s: {_describe_objects([drive.truth for drive in drives])}."
    if few is not None:
        yield f"# All classes are measured: of {few[0]} would count."
        yield "# What stands behind `#` below `measure:` measures them alone."
    yield "# Written by `copem-replay init`, as a starting point. A key behind a `#` can be used as it stands, without"
    yield "# the `#` (<id> stands for an object's)."
    yield "#"
    yield "#   copem-replay check experiment.yaml"
    yield "#   copem-replay run experiment.yaml && copem-replay view out/experiment"
    yield "#   copem-replay compare out/experiment   # what late lists, one unit alone, a real fusion cost"


def _draft_only_log(drive: _Drive) -> Iterator[str]:
    yield f"logs: [{quote_yaml(drive.survey.log)}]   # relative to this file, or absolute; globs work"
    yield from _draft_read(drive.survey, drive.truth)
    yield from _draft_ego(drive.truth, drive.guess)
    yield _draft_window(drive.truth)


def _draft_window(truth: TruthFound) -> str:
    return f"# window_s: [0, {math.ceil(10 * truth.span_s) / 10:.1f}]   # the part that is read; left out: all of it"


def _draft_logs(
    drives: Sequence[_Drive], first: Sequence[str], recorded: Sequence[tuple[str, UnitFound]]
) -> Iterator[str]:
    """`logs:`, an entry for each, with what is its own: the ego, how it is read, where the masts are, which units."""
    yield "logs:   # relative to this file, or absolute; keys of an entry replace those below, in this log only"
    for drive in drives:
        truth = drive.truth
        yield f"  - file: {quote_yaml(drive.survey.log)}   # {truth.span_s:.1f} s: {_describe_objects([truth])}"
        own = [*_draft_read(drive.survey, truth), *_draft_ego(truth, drive.guess), _draft_window(truth)]
        own += [
            f"# {quote_yaml(u.topic)} cannot be a unit: {_format_comment(u.problem)}" for u in truth.units if u.problem
        ]
        own.append(f"units: {{{', '.join(_draft_own_units(drive, first, recorded))}}}")
        if not drive.has_ego and first[0] == "ego":
            own.append("measure: {distance_to: roadside}   # there is no ego: ranges and distances are from here")
        yield from (f"    {line}" for line in own)


def _draft_own_units(drive: _Drive, first: Sequence[str], recorded: Sequence[tuple[str, UnitFound]]) -> Iterator[str]:
    """What is otherwise of the units in one log: the places of masts, and units that it lacks."""
    if first[0] == "ego" and not drive.has_ego:
        yield "ego: null"
    for name, mast in zip((name for name in first if name != "ego"), drive.guess.masts, strict=False):
        yield f"{name}: {{at: {dump_on_one_line(mast.at)}, yaw_deg: {mast.yaw_deg}}}"
    for name, everywhere in recorded:
        unit = drive.find_unit(everywhere.topic)
        if unit is None:
            yield f"{name}: null"
        elif _format_recorded(unit) != _format_recorded(everywhere):
            yield f"{name}: {{recorded: {_format_recorded(unit)}}}"


def _merge_measured(drives: Sequence[_Drive]) -> Suggestion:
    """What is measured in all logs alike: the classes that any of them suggests, from the instant that suits most."""
    guesses = [drive.guess for drive in drives]
    classes = None if any(guess.classes is None for guess in guesses) else [
        name for name in ("vru", "vehicles") if any(name in (guess.classes or ()) for guess in guesses)
    ]  # fmt: skip
    onset = "appears" if all(guess.onset == "appears" for guess in guesses) else "in_range"
    began = {
        name: {word: sum(guess.began[name][word] for guess in guesses) for word in words}
        for name, words in guesses[0].began.items()
    }
    return replace(guesses[0], classes=classes, onset=onset, began=began)


def take_proposal(survey: RecordingSurvey) -> RecordingSurvey | None:
    """The survey as it can be drafted: as it is where it is readable, else with the best list that is read by the names
    of its fields; None: no proposal is complete.
    """
    if survey.readable:
        return survey
    whole = [(truth, proposal) for proposal in survey.proposals if (truth := proposal.truth) is not None]
    if not whole:
        return None
    truth, best = max(whole, key=lambda one: one[0].states)
    return replace(survey, truth=[truth], proposals=[best])


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


_OF_PEM = [
    "    # memory: {detection: [{share: 0.8, correlation_s: 1.0}]}   # who is missed is missed for a while",
    "    # ghosts: [{in_list: 0.2, lasts_s: 1.0, where: {kind: field, range_m: [5, 60], azimuth_deg: [-60, 60]}}]",
]
_ONBOARD = [
    "  onboard:",
    "    couples:",
    "      - when: {range_m: [0, 80], azimuth_deg: [-60, 60]}   # far ahead",
    "        detection: {kind: visible_share}   # listed with the probability of its visible share; or constant, table",
    "        # variances in m² along and across the line of sight; left out: exact",
    "        error: {kind: gaussian, frame: line_of_sight, covariance_m2: [[0.5, 0.0], [0.0, 0.1]]}",
    "      - when: {range_m: [0, 30]}   # near, all around",
    "        detection: {kind: visible_share}",
    "        error: {kind: gaussian, frame: line_of_sight, covariance_m2: [[0.3, 0.0], [0.0, 0.1]]}",
    *_OF_PEM,
]
_ROADSIDE = [
    "  roadside:",
    "    couples:",
    "      - when: {range_m: [0, 70], azimuth_deg: [-60, 60]}",
    "        detection: {kind: visible_share}",
    "        error: {kind: gaussian, frame: line_of_sight, covariance_m2: [[0.6, 0.0], [0.0, 0.3]]}",
    *_OF_PEM,
]
_OF_UNIT = [
    "    # placed: {position_sigma_m: 0.2, yaw_sigma_deg: 0.5}   # it errs about its own pose",
    "    # clock: {offset_sigma_s: 0.02}   # its clock is off",
    "    # sends: {kind: cpm, interval_s: 0.1}   # which of its lists and objects it sends; left out: all",
]
_LATENCY = "latency: {kind: gamma, min_s: 0.02, mean_s: 0.06, shape: 2}"


def _describe_objects(truths: Sequence[TruthFound]) -> str:
    moving = Counter[str]()
    for truth in truths:
        moving.update(truth.moving)
    return ", ".join(f"{moving[name]} {name}" for name in CLASSES if moving[name]) or "nothing that moves"


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


def _draft_units(drives: Sequence[_Drive], recorded: Sequence[tuple[str, UnitFound]], *, ego: bool) -> Iterator[str]:
    if ego:
        yield "  ego:   # makes a list per frame, or `rate_hz`"
        yield "    on: ego   # on the roof, or at `height_m`"
        yield "    pem: onboard"
        yield "  # A mast where most measured objects come by: x, y in metres as in the log, yaw_deg from the x axis"
    else:
        yield "  # Two masts that face each other where most objects come by: x, y in metres as in the log"
    if len(drives) > 1:
        yield "  # (as in the first log: each log has its own above)"
    for name, mast in zip(("roadside", "across"), drives[0].guess.masts[: 1 if ego else 2], strict=False):
        yield f"  {name}:"
        yield f"    at: {dump_on_one_line(mast.at)}"
        yield f"    yaw_deg: {mast.yaw_deg}"
        yield "    height_m: 6.0"
        yield "    pem: roadside"
        yield from _OF_UNIT
    if ego:
        yield "  # others: {on: {classes: [car, truck], penetration_rate: 0.3}, pem: onboard}   # 30 % of them (V2V)"
    if recorded:
        yield "  # Lists as they were recorded. `delay_s`, `covariance_m2`: for messages that don't say when they were"
        yield "  # captured, and how uncertain they are."
    for name, unit in recorded:
        yield from (f"  # {_format_comment(line)}" for line in unit.oddities)
        late = "" if unit.delay is None else f"   # delay_s {_format_comment(unit.delay)}"
        yield f"  {name}:"
        yield f"    recorded: {_format_recorded(unit)}{late}"
        yield "    # at: [0.0, 0.0]   # where is it? x, y as in the log, or `on: ego`: without, no picture shows it"
    for unit in drives[0].truth.units if len(drives) == 1 else ():
        if unit.problem:
            yield f"  # {quote_yaml(unit.topic)} cannot be a unit: {_format_comment(unit.problem)}"


def _draft_links(drives: Sequence[_Drive]) -> Iterator[str]:
    """A link that no configuration uses yet; without an ego its reception cannot go by the way to it."""
    to_ego = all(drive.has_ego for drive in drives)
    yield "links:   # how lists travel: only a configuration with `link` uses it, such as the last one"
    yield f"  radio: {{{_LATENCY}, reception: " + (
        "{kind: shadowing, half_at_m: 150, exponent: 2.27, sigma_db: 3, blocked_db: 9}}"
        if to_ego
        else "{kind: constant, probability: 0.9}}"
    )


def _draft_configurations(first: Sequence[str], recorded: Sequence[str], *, ego: bool) -> Iterator[str]:
    """Configurations: the truth, all units by ideal and by a real fusion, one unit alone, and all of them late."""
    both, gnn = f"{{units: [{', '.join(first)}]", "fusion: {kind: gnn}"
    rows = [
        ("GT", "{units: truth}", "all that is there, at once, without error"),
        ("ideal", f"{both}, fusion: {{kind: ideal}}}}", "all units, fused by truth ids: the baseline of `compare`"),
        ("gnn", f"{both}, {gnn}}}", "a fusion without truth ids"),
        ("alone", f"{{units: [{first[0]}], {gnn}}}", "the vehicle on its own" if ego else "one mast on its own"),
        ("late", f"{both}, {gnn}, latency_s: 0.5}}", "all lists half a second late"),
    ]  # fmt: skip
    for name in recorded:
        rows.append((name, f"{{units: [{name}], {gnn}}}", "as it was recorded"))
        if not (ego and name.startswith("ego")):  # else the ego twice, as recorded and as modelled
            rows.append((f"with {name}", f"{{units: [{first[0]}, {name}], {gnn}}}", "and together"))
    if len(recorded) > 1:
        rows.append(("recorded", f"{{units: [{', '.join(recorded)}], {gnn}}}", "all of them"))
    link = "{ego: none, default: radio}" if ego else "radio"
    width = max(len(name) for name, _, _ in rows) + 1
    for name, value, what in rows:
        yield f"  {name + ':':<{width}} {value}   # {what}"
    yield f"  # radio: {both}, {gnn}, link: {link}}}   # the lists{' of the others' * ego} by radio"


def _draft_outputs(outputs: Sequence[tuple[str, UnitFound]], recorded: Sequence[str]) -> Iterator[str]:
    """Configurations of a stack's recorded outputs, told by their topics: measured like a fusion."""
    for name, unit in outputs:
        yield "  # Its name suggests a stack's own output, with these units as inputs; if it is not, make it a unit"
        yield from (f"  # {_format_comment(line)}" for line in unit.oddities)
        late = "" if unit.delay is None else f"   # delay_s {_format_comment(unit.delay)}"
        yield f"  {name}: {{recorded: {_format_recorded(unit)}, inputs: [{', '.join(recorded)}]}}{late}"


def _draft_measure(guess: Suggestion, few: tuple[str, str] | None, *, ego: bool) -> Iterator[str]:
    yield "measure:"
    if few is not None:
        yield f"  # {few[1]}"
        if not _counts_all(guess):
            yield "  # began: [log_start, crossed, appeared]   # with them"
    elif guess.classes:
        text = ", ".join(_KINDS[name] for name in guess.classes)
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


def _draft_braking(drives: Sequence[_Drive], *, ego: bool) -> Iterator[str]:
    """A driver, where each log has an ego of known size; without velocities in lists he is not asked when he brakes for
    nothing.
    """
    if not ego:
        return
    from copem_replay.metrics.braking.driver import R157  # a survey alone loads no models

    behind = "" if all(drive.has_ego and not isinstance(drive.guess.ego, dict) for drive in drives) else "# "
    silent = any(unit.problem is None and not unit.velocities_said for drive in drives for unit in drive.truth.units)
    yield f"{behind}braking:   # who brakes for what lists say: the careful and competent driver of UN R157" + (
        "; needs an ego and its size" if behind else ""
    )
    yield f"{behind}  driver: {dump_on_one_line(R157)}"
    if silent:
        yield f"{behind}  needless: null   # recorded lists state no velocity: braking for nothing cannot be told"


def _draft_gap(drives: Sequence[_Drive]) -> Iterator[str]:
    """`max_gap_s` where lists come so seldom that the default would leave holes between them; half a list to spare."""
    slowest_hz = min((rate for drive in drives if (rate := drive.truth.rate_hz) is not None), default=math.inf)
    gap_s = math.ceil(15 / slowest_hz) / 10
    if gap_s > MAX_GAP_S:
        yield f"max_gap_s: {gap_s:g}   # lists come every {1 / slowest_hz:.3g} s: over longer gaps nothing is known"


def _draft_began(guess: Suggestion) -> str:
    """The line of `began`: its default as a comment, or all three words, with the reason."""
    if guess.onset == "appears":
        return "  began: [log_start, crossed, appeared]   # who counts: all, for nobody crosses into view"
    began = _sum_began(guess)
    numbers = ", ".join(f"{number} {word}" for word, number in began.items())
    if _counts_all(guess):
        return f"  began: [log_start, crossed, appeared]   # who counts: all, for there are only {numbers}"
    return f"  # began: [crossed, appeared]   # who counts; left out: these ({numbers})"


_TAKEN = frozenset({
    "ego", "roadside", "across", "others", "default", "truth", "all", "gt", "ideal", "gnn", "alone", "late", "radio",
    "recorded",
})  # fmt: skip
"""Names that units and configurations of a draft have already."""


def _name_recorded(drives: Sequence[_Drive]) -> tuple[list[tuple[str, UnitFound]], list[tuple[str, UnitFound]]]:
    """The lists that could be read, by names made from their topics: those of units, and outputs of a stack.

    Of a topic that several logs have the lists of the first one. An output is the same in all logs, so what only some
    have is a unit.
    """
    by_topic: dict[str, UnitFound] = {}
    for drive in drives:
        for unit in drive.truth.units:
            if unit.problem is None:
                by_topic.setdefault(unit.topic, unit)
    named: dict[str, UnitFound] = {}
    for unit in by_topic.values():
        words = [word for word in re.split(r"[^a-z0-9]+", unit.topic.lower()) if word]
        telling = [word for word in words if word not in _GENERIC and word[0].isalpha() and word not in _WORDS]
        stem = telling[-1] if telling else "lists"
        tries = [stem, *([f"{stem}_recorded"] if stem in _TAKEN else []), *(f"{stem}{k}" for k in range(2, 99))]
        name = next(name for name in tries if name not in _TAKEN and name not in named)
        named[name] = unit
    fused = {
        name
        for name, unit in named.items()
        if _FUSED & set(re.split(r"[^a-z0-9]+", unit.topic.lower())) and all(d.find_unit(unit.topic) for d in drives)
    }
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
    lines.append(f"  place: {truth.place}")
    if truth.gaps_inside_tracks:
        lines.append(f"  {count_noun(truth.gaps_inside_tracks, 'gap')} above {MAX_GAP_S:g} s inside tracks")
    for kind, counts in (("moving", truth.moving), ("stationary", truth.stationary)):
        objects = ", ".join(f"{number} {name}" for name, number in counts.items())
        lines.append(f"  {kind}: {objects or 'none'}")
    if truth.ground:
        lines.append(f"  ground: {', '.join(count_noun(number, kind) for kind, number in truth.ground.items())}")
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

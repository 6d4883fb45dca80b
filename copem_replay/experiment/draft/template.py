"""The text of a draft: an experiment on a recording, from its survey; and the survey in plain text."""

from __future__ import annotations

import math
import re
import shlex
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

from copem_replay.core.errors import count_noun, escape_unprintable
from copem_replay.core.tracks import CLASSES
from copem_replay.core.yaml import dump_on_one_line
from copem_replay.experiment.draft.findings import (
    FEWEST_COUNTED,
    RANGES_M,
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
_MASTS = ("roadside", "across")
_OTHERS = 6  # topics listed in comments, at most: a line each


@dataclass(frozen=True)
class _Drive:
    """A log of a draft: its survey, the list of true objects that is taken, and the lists of its units by their names
    in the draft.
    """

    survey: RecordingSurvey
    truth: TruthFound
    lists: Mapping[str, UnitFound] = field(default_factory=dict)

    @property
    def guess(self) -> Suggestion:
        return self.truth.suggested

    @property
    def has_ego(self) -> bool:
        return self.guess.ego != "none"

    @property
    def units(self) -> list[str]:
        """The names of its units: recorded ones, else masts; and the ego's, as it is recorded or a modelled one."""
        masts = [] if self.lists else ["roadside"] if self.has_ego else ["roadside", "across"]
        return (
            ["ego"] * (self.has_ego and not any(name.startswith("ego") for name in self.lists)) + masts + [*self.lists]
        )

    @property
    def measured(self) -> dict[str, str]:
        """The text of the keys of `measure` that a log may set for itself."""
        suffix = "" if self.guess.again_after_s is None else f", again_after_s: {self.guess.again_after_s:g}"
        near = "appears" if self.guess.range_m is None else f"in_range, range_m: {self.guess.range_m:g}"
        return {
            "objects": f"{{classes: {dump_on_one_line(self.guess.classes)}}}",
            "onset": f"{{kind: {near}{suffix}}}",
            "distance_to": "ego" if self.has_ego else self.units[0],
        }


def format_draft(*surveys: RecordingSurvey) -> str:
    """The experiment on one log or several, each surveyed, with a comment on each key; it runs unchanged."""
    drives = [_Drive(survey, max(survey.truth, key=lambda truth: truth.states)) for survey in surveys]
    recorded, outputs = _name_recorded(drives)
    drives = [replace(drive, lists=_find_lists(drive, recorded)) for drive in drives]
    units = [name for name in ("ego", *_MASTS, *recorded) if any(name in drive.units for drive in drives)]
    lines = [
        *_draft_head(drives, units),
        "version: 1",
        *(_draft_only_log(drives[0]) if len(drives) == 1 else _draft_logs(drives, units, recorded)),
        "runs: 20   # each with its own draws, the same in all configurations; more say nothing of other drives",
        "seed: 1",
        "",
        "# Perception error models: is an object in a unit's list, and how far off? The first couple whose `when`",
        "# holds applies; where none holds, nothing is listed. These numbers are examples: yours belong here.",
        "pems:",
        *_ONBOARD * ("ego" in units),
        *_ROADSIDE,
        "",
        "units:",
        *_draft_units(drives, units, recorded),
        "",
        *_draft_links(drives),
        "",
        "configurations:",
        *_draft_configurations(units, list(recorded)),
        *_draft_outputs(outputs, list(recorded)),
        "",
        *_draft_measure(drives),
        *_draft_braking(drives),
        *_draft_gap(drives),
        "show: {run: 0}   # the run that replay.mcap and replay.rrd show; {run: null} writes none",
    ]
    return "\n".join(lines) + "\n"


def _sum_few(drives: Sequence[_Drive]) -> tuple[str, str] | None:
    """Who is measured only together with all others, and the key for them alone; None: not so in each log."""
    few = sum((Counter(drive.guess.few) for drive in drives), Counter[str]())
    if len(few) != 1 or not all(drive.guess.few for drive in drives):
        return None
    ((name, counted),) = few.items()
    return f"of {_KINDS[name]} only {counted} would count", f"objects: {{classes: [{name}]}}   # {_KINDS[name]} alone"


def _draft_head(drives: Sequence[_Drive], units: Sequence[str]) -> Iterator[str]:
    """The comment at the head of a draft: which drives, who is measured, and commands to go on with."""
    of = _format_comment(drives[0].survey.recording) if len(drives) == 1 else f"{len(drives)} drives"
    span_s = sum(drive.truth.span_s for drive in drives)
    yield f"# Replays {of}, {span_s:.1f} s: {_describe_objects([drive.truth for drive in drives])}."
    if (few := _sum_few(drives)) is not None:
        yield f"# All classes are measured: {few[0]}."
        yield "# What stands behind `#` below `measure:` measures them alone."
    if not any(count for drive in drives for count in drive.guess.began.values()):
        yield "# No object counts: beside the ego nothing moves for two frames or more."
    if "roadside" in units:
        yield f"# The mast{'s are examples' if 'across' in units else ' is an example'}, where most of them come by."
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


def _draft_logs(drives: Sequence[_Drive], units: Sequence[str], recorded: Mapping[str, UnitFound]) -> Iterator[str]:
    """The lines of `logs:`, an entry for each drive with its own keys: ego, how it is read, units, who counts."""
    yield "logs:   # relative to this file, or absolute; keys of an entry replace those below, in this log only"
    for drive in drives:
        truth = drive.truth
        yield f"  - file: {quote_yaml(drive.survey.log)}   # {truth.span_s:.1f} s: {_describe_objects([truth])}"
        own_keys = [*_draft_read(drive.survey, truth), *_draft_ego(truth, drive.guess), _draft_window(truth)]
        own_keys += _draft_unreadable(truth)
        changed = {
            "units": _draft_own_units(drive, units, recorded),
            "measure": [f"{key}: {of}" for key, of in drive.measured.items() if of != drives[0].measured[key]],
        }
        own_keys += [f"{key}: {{{', '.join(of)}}}" for key, of in changed.items() if of]
        if _sum_few(drives) is None and (few_words := _sum_few([drive])) is not None:
            own_keys.append(f"# all classes are measured here: {few_words[0]}")
        yield from (f"    {line}" for line in own_keys)


def _draft_own_units(drive: _Drive, units: Sequence[str], recorded: Mapping[str, UnitFound]) -> list[str]:
    """Lines `name: {…}` of units that differ in one log, by place or how they are read; `null`: the log lacks it."""
    masts, changes = iter(drive.guess.masts), {}
    for name in units:
        if name not in drive.units:
            changes[name] = "null"
        elif name in _MASTS:
            mast = next(masts)
            changes[name] = f"{{at: {dump_on_one_line(mast.at)}, yaw_deg: {mast.yaw_deg}}}"
        elif name in recorded:
            unit = drive.lists[name]
            keys = [] if drive.has_ego else [f"at: {dump_on_one_line(unit.middle_m)}"]
            of = _format_recorded(unit)
            keys += [f"recorded: {of}"] * (of != _format_recorded(recorded[name]))
            changes |= {name: f"{{{', '.join(keys)}}}"} if keys else {}
    return [f"{name}: {of}" for name, of in changes.items()]


def _draft_unreadable(truth: TruthFound) -> Iterator[str]:
    for unit in truth.units:
        if unit.problem:
            yield f"# {quote_yaml(unit.topic)} cannot be a unit: {_format_comment(unit.problem)}"


def take_proposal(survey: RecordingSurvey) -> RecordingSurvey | None:
    """The survey where it is readable, else with the best proposal by names of fields; None: none is complete."""
    if survey.readable:
        return survey
    complete = [(truth, proposal) for proposal in survey.proposals if (truth := proposal.truth) is not None]
    if not complete:
        return None
    truth, best = max(complete, key=lambda pair: pair[0].states)
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


def _describe_objects(truths: Sequence[TruthFound]) -> str:
    moving = sum((Counter(truth.moving) for truth in truths), Counter[str]())
    return ", ".join(f"{moving[name]} {name}" for name in CLASSES if moving[name]) or "nothing that moves"


def _draft_read(survey: RecordingSurvey, truth: TruthFound) -> Iterator[str]:
    if survey.proposals:
        yield from format_read_block(survey.proposals[0])
    if (why := truth.map) is not None:
        line = f"maps: [{{file: {quote_yaml(survey.log)}, frame: same}}]   # the map in the recording"
        yield f"# {line}, cannot be used: {_format_comment(why)}" if why else line
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
        yield f"ego: {quote_yaml(ego)}{'   # a guess; none: no ego, a mast judged by itself' * (ego != 'none')}"
        if ids := truth.vehicles:
            yield f"# ego: <id>   # of {_format_comment(ids)}"


def _draft_units(drives: Sequence[_Drive], units: Sequence[str], recorded: Mapping[str, UnitFound]) -> Iterator[str]:
    """The lines of `units:`: the ego's, masts as examples, and lists as they were recorded."""
    if "ego" in units:
        yield "  ego:   # makes a list per frame, or `rate_hz`"
        yield "    on: ego   # on the roof, or at `height_m`"
        yield "    pem: onboard"
    masts = [name for name in _MASTS if name in units]
    if masts:
        what = "Two masts, as examples, that face each other" if len(masts) > 1 else "A mast, as an example,"
        yield f"  # {what} where most measured objects come by: x, y in metres as in the log,"
        yield "  # yaw_deg from the x axis" + (" (as in one log: each has its own above)" if len(drives) > 1 else "")
    for name, mast in zip(masts, drives[0].guess.masts, strict=False):
        yield f"  {name}:"
        yield f"    at: {dump_on_one_line(mast.at)}"
        yield f"    yaw_deg: {mast.yaw_deg}"
        yield "    height_m: 6.0"
        yield "    pem: roadside"
        yield from _OF_UNIT
    if "ego" in units:
        yield "  # others: {on: {classes: [car, truck], penetration_rate: 0.3}, pem: onboard}   # 30 % of them (V2V)"
    if recorded:
        yield "  # Lists as they were recorded. `delay_s`, `covariance_m2`: for messages that don't say when they were"
        yield "  # captured, and how uncertain they are."
    for name, unit in recorded.items():
        yield from (f"  # {_format_comment(line)}" for line in unit.oddities)
        delay_comment = "" if unit.delay is None else f"   # delay_s {_format_comment(unit.delay)}"
        yield f"  {name}:"
        yield f"    recorded: {_format_recorded(unit)}{delay_comment}"
        place, what = dump_on_one_line(unit.middle_m), "where is it? x, y as in the log"
        if unit.views and unit.at_wgs84:
            yield f"    at_wgs84: {dump_on_one_line([*unit.at_wgs84, 0.0])}   # where it says it stands, north ahead"
            yield "    height_m: 6.0   # a guess"
            yield "    views:   # where its sensors look, as it says: what hides an object from it is known"
            yield from (f"      - {dump_on_one_line(view)}" for view in unit.views)
            continue
        if unit.no_views:
            yield f"    # views: left out: {unit.no_views}"
        if any(name in drive.lists and not drive.has_ego for drive in drives):
            yield f"    at: {place}   # a guess, the middle of what it lists: {what}"
        else:
            yield f"    # at: {place}   # {what}, or `on: ego`: without, no picture shows it"
    if not masts:
        place = f"at: {dump_on_one_line(drives[0].guess.masts[0].at)}, yaw_deg: {drives[0].guess.masts[0].yaw_deg}"
        yield f"  # mast: {{{place}, height_m: 6.0, pem: roadside}}   # a modelled one, for configurations that name it"
    if len(drives) == 1:
        yield from (f"  {line}" for line in _draft_unreadable(drives[0].truth))


def _draft_links(drives: Sequence[_Drive]) -> Iterator[str]:
    """A link that no configuration uses yet; without an ego its reception cannot go by the way to it."""
    reception = "{kind: constant, probability: 0.9}"
    if all(drive.has_ego for drive in drives):
        reception = "{kind: shadowing, half_at_m: 150, exponent: 2.27, sigma_db: 3, blocked_db: 9}"
    yield "links:   # how lists travel: only a configuration with `link` uses it, such as the last one"
    yield f"  radio: {{latency: {{kind: gamma, min_s: 0.02, mean_s: 0.06, shape: 2}}, reception: {reception}}}"


def _draft_configurations(units: Sequence[str], recorded: Sequence[str]) -> Iterator[str]:
    """The lines of `configurations:`: truth, all units by ideal and real fusion, each on its own, and all late."""
    start, gnn = f"{{units: [{', '.join(units)}]", "fusion: {kind: gnn}"
    ego = [name for name in units if name.startswith("ego")]
    others = [name for name in recorded if name not in ego]
    rows = [
        ("GT", "{units: truth}", "all that is there, at once, without error"),
        ("ideal", f"{start}, fusion: {{kind: ideal}}}}", "all units, fused by truth ids: the baseline of `compare`"),
    ]
    if len(units) > 1:
        rows.append(("gnn", f"{start}, {gnn}}}", "a fusion without truth ids"))
    if ego:
        rows.append(("alone", f"{{units: [{', '.join(ego)}], {gnn}}}", "the vehicle on its own"))
    elif "roadside" in units:
        rows.append(("alone", f"{{units: [roadside], {gnn}}}", "one mast on its own"))
    rows += [(name, f"{{units: [{name}], {gnn}}}", "as it was recorded") for name in others]
    if len(others) > 1 and {*others} != {*units}:
        rows.append(("recorded", f"{{units: [{', '.join(others)}], {gnn}}}", "all of them"))
    own = f", the ego's own, too: `latency_s: {{{ego[0]}: 0, default: 0.5}}` leaves it out" if ego else ""
    rows.append(("late", f"{start}, {gnn}, latency_s: 0.5}}", f"all lists half a second late{own}"))
    link = f"{{{', '.join(f'{name}: none' for name in ego)}, default: radio}}" if ego else "radio"
    width = max(len(name) for name, _, _ in rows) + 1
    for name, value, what in rows:
        yield f"  {name + ':':<{width}} {value}   # {what}"
    yield f"  # radio: {start}, {gnn}, link: {link}}}   # the lists{' of the others' * bool(ego)} by radio"


def _draft_outputs(outputs: Mapping[str, UnitFound], recorded: Sequence[str]) -> Iterator[str]:
    """Configurations of a stack's recorded outputs, told by their topics: measured like a fusion."""
    for name, unit in outputs.items():
        yield "  # Its name suggests a stack's own output, with these units as inputs; if it is not, make it a unit"
        yield from (f"  # {_format_comment(line)}" for line in unit.oddities)
        late = "" if unit.delay is None else f"   # delay_s {_format_comment(unit.delay)}"
        yield f"  {name}: {{recorded: {_format_recorded(unit)}, inputs: [{', '.join(recorded)}]}}{late}"


def _counts_all(guess: Suggestion) -> bool:
    """Whether objects of the log's start count, too: there are any, and few others."""
    others = guess.began["crossed"] + guess.began["appeared"]
    return guess.range_m is None or others < (FEWEST_COUNTED if guess.began["log_start"] else 1)


def _draft_measure(drives: Sequence[_Drive]) -> Iterator[str]:
    """The lines of `measure:`: who is measured, from when on, who counts, and up to when."""
    guess, keys, few_words = drives[0].guess, drives[0].measured, _sum_few(drives)
    began = sum((Counter(drive.guess.began) for drive in drives), Counter[str]())
    counts_all = any(_counts_all(drive.guess) for drive in drives)
    yield "measure:"
    if few_words is not None:
        yield f"  # {few_words[1]}"
        if not counts_all:
            yield "  # began: [log_start, crossed, appeared]   # with them"
    elif guess.classes:
        text = ", ".join(_KINDS[name] for name in guess.classes)
        yield f"  objects: {keys['objects']}   # {text}; or {{ids: [1, 2]}}; left out: all"
    else:
        yield "  # objects: {classes: [vru]}   # left out: all that moves but the ego"
    what = "or appears, starts_moving, line_of_sight"
    if guess.range_m is None:
        what = f"in_range: nobody is within {RANGES_M[-1]:g} m"
    elif guess.range_m > RANGES_M[0]:
        what = f"nobody comes nearer than {RANGES_M[RANGES_M.index(guess.range_m) - 1]:g} m"
    yield f"  onset: {keys['onset']}   # the clock starts; {what}"
    numbers = ", ".join(f"{began[word]} {word}" for word in ("crossed", "appeared", "log_start"))
    if guess.range_m is None:
        yield "  began: [log_start, crossed, appeared]   # who counts: all, for nobody crosses into view"
    elif counts_all:
        few_others = "there are only" if len(drives) == 1 else "in a log few others do:"
        yield f"  began: [log_start, crossed, appeared]   # who counts: all, for {few_others} {numbers}"
    else:
        yield f"  # began: [crossed, appeared]   # who counts; left out: these ({numbers})"
    yield "  horizon_s: 5   # means are of min(time, 5 s)"
    if keys["distance_to"] != "ego":
        yield f"  distance_to: {keys['distance_to']}   # there is no ego: ranges and distances are from here"
    yield "  confirm: {hits: 1, of: 1}   # known when so many of the last lists hold it"


def _draft_braking(drives: Sequence[_Drive]) -> Iterator[str]:
    """The lines of `braking:`, if a log has an ego, behind `#` without its size; no `needless` without velocities."""
    if not any(drive.has_ego for drive in drives):
        return
    from copem_replay.metrics.braking.driver import R157  # a survey alone loads no models

    comment_mark = "# " if any(isinstance(drive.guess.ego, dict) for drive in drives) else ""
    silent = any(unit.problem is None and not unit.velocities_said for drive in drives for unit in drive.truth.units)
    what = "the careful and competent driver of UN R157" + "; needs the size of the ego" * bool(comment_mark)
    yield f"{comment_mark}braking:   # who brakes for what lists say: {what}"
    yield f"{comment_mark}  driver: {dump_on_one_line(R157)}"
    if silent:
        yield f"{comment_mark}  needless: null   # recorded lists state no velocity: braking for nothing cannot be told"


def _draft_gap(drives: Sequence[_Drive]) -> Iterator[str]:
    """`max_gap_s` where lists come so seldom that the default would leave holes between them; half a list to spare."""
    slowest_hz = min((rate for drive in drives if (rate := drive.truth.rate_hz) is not None), default=math.inf)
    gap_s = math.ceil(15 / slowest_hz) / 10
    if gap_s > MAX_GAP_S:
        yield f"max_gap_s: {gap_s:g}   # lists come every {1 / slowest_hz:.3g} s: over longer gaps nothing is known"


_TAKEN = frozenset({
    "ego", "roadside", "across", "others", "default", "truth", "all", "gt", "ideal", "gnn", "alone", "late", "radio",
    "recorded", "mast",
})  # fmt: skip
"""Names that units and configurations of a draft have already."""


def _find_lists(drive: _Drive, recorded: Mapping[str, UnitFound]) -> dict[str, UnitFound]:
    """The lists of a log that can be read, by their names in the draft."""
    there = {unit.topic: unit for unit in drive.truth.units if unit.problem is None}
    return {name: there[of.topic] for name, of in recorded.items() if of.topic in there}


def _name_recorded(drives: Sequence[_Drive]) -> tuple[dict[str, UnitFound], dict[str, UnitFound]]:
    """The readable lists by names made from their topics: those of units, and the outputs of a stack. Of a topic that
    several logs have the lists of the first one. An output is the same in all logs, so what only some have is a unit.
    """
    by_topic: dict[str, UnitFound] = {}
    for drive in drives:
        for unit in drive.truth.units:
            if unit.problem is None:
                by_topic.setdefault(unit.topic, unit)
    named: dict[str, UnitFound] = {}
    for unit in by_topic.values():
        words = [word for word in re.split(r"[^a-z0-9]+", unit.topic.lower()) if word]
        specific_words = [word for word in words if word not in _GENERIC and word[0].isalpha() and word not in _WORDS]
        stem = specific_words[-1] if specific_words else "lists"
        tries = [stem, *([f"{stem}_recorded"] if stem in _TAKEN else []), *(f"{stem}{k}" for k in range(2, 99))]
        named[next(name for name in tries if name not in _TAKEN and name not in named)] = unit
    in_all_logs = {name for name in named if all(name in _find_lists(drive, named) for drive in drives)}
    outputs = {n for n in in_all_logs if _FUSED & {*re.split(r"[^a-z0-9]+", named[n].topic.lower())}}
    outputs = outputs if len(outputs) < len(named) else set()
    return {n: of for n, of in named.items() if n not in outputs}, {n: of for n, of in named.items() if n in outputs}


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
    "map": "a map, for `maps: [{file: …, frame: same}]`",
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
    """The lines of the table of topics; two a topic where it is wider than `width` (None: any)."""
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
    missing = [] if unit.covariances_said else ["covariances"]
    missing += [] if unit.captures_said else ["captures"]
    counts = f"{count_noun(unit.lists, 'list')}, {count_noun(unit.entries, 'entry', 'entries')}"
    counts += f", {unit.rate_hz:.2f} Hz (median)" if unit.rate_hz is not None else ""
    lines = [f"unit {unit.topic}: {counts}" + (f"; without {' and '.join(missing)}" if missing else "")]
    if unit.delay is not None:
        lines.append(f"  delay_s against the truth {'' if unit.delay_s is None else 'is '}{unit.delay}")
    return lines + [f"  {line}" for line in unit.oddities]

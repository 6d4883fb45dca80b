"""The experiment that would replay a recording, as text: from what a look at it found, to begin with."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace

from copem_replay.core.yaml import flow
from copem_replay.experiment.draft.findings import ProposalFound, Suggestion, Survey, TruthFound, UnitFound

_WORDS = ("null", "true", "false")
_UNIT = "[[0.5, 0.0], [0.0, 0.5]]"
_GENERIC = {"objects", "object", "sensordata", "detections", "tracks", "lists", "list", "markers", "data", "msg"}
_FUSED = {"fusion", "fused", "stack"}
"""Words in the topic of what a stack makes of the lists of others."""
_OTHERS = 6  # topics named in a comment (chosen)


def commented(survey: Survey) -> str:
    """The experiment with a word on each key; it runs as it is."""
    truth = max(survey.truth, key=lambda truth: truth.states)
    guess = truth.suggested
    recorded, outputs = _recorded(truth)
    ego = guess.ego != "none"
    first = ["ego", "roadside"] if ego else ["roadside", "across"]
    lines = [
        f"# Replays {_plain(survey.recording)}, {truth.span_s:.1f} s: {_objects(truth)}.",
        "# Written by `copem-replay init`, as a starting point.",
        "#",
        "#   copem-replay check experiment.yaml",
        "#   copem-replay run experiment.yaml && copem-replay view out/experiment",
        "version: 1",
        f"logs: [{quoted(survey.log)}]   # relative to this file, or absolute; globs work",
        *_read(survey, truth),
        *_ego(truth, guess),
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
        *_units(guess, recorded, truth.units, ego=ego),
        "",
        "configurations:",
        *_configurations(first, [name for name, _ in recorded], ego=ego),
        *_outputs(outputs, [name for name, _ in recorded]),
        "",
        *_measure(guess, ego=ego),
        "show: {run: 0}   # the run that replay.mcap and replay.rrd show; {run: null} writes none",
    ]
    return "\n".join(lines) + "\n"


def proposed(survey: Survey) -> str | None:
    """The experiment on a list that is read by the names of its fields; None: of no proposal all needed was found."""
    whole = [(truth, proposal) for proposal in survey.proposals if (truth := proposal.truth) is not None]
    if not whole:
        return None
    truth, best = max(whole, key=lambda one: one[0].states)
    return commented(replace(survey, truth=[truth], proposals=[best]))


def unfinished(survey: Survey) -> str:
    """`read:` of each proposal as comments, with what is missing and what the messages have."""
    lines = []
    for proposal in survey.proposals:
        lines += [f"# {_plain(proposal.topic)} ({_plain(proposal.schema)}) may be a list of objects:"]
        lines += [f"# {line}" for line in read_block(proposal)]
        lines += [f"# its messages have: {_plain(', '.join(proposal.offers))}"]
        lines += [f"# {_plain(proposal.problem)}"] if proposal.problem else []
    return "\n".join(lines) + "\n" if lines else ""


def read_block(proposal: ProposalFound) -> list[str]:
    """`read:` as it was proposed."""
    lines = ["read:   # proposed from the names of its fields: look at each"]
    for key, value in proposal.read.items():
        lines.append(f"  {key}: {flow(value)}" + (f"   # {_ON_KEYS[key]}" if key in _ON_KEYS else ""))
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


def _objects(truth: TruthFound) -> str:
    return ", ".join(f"{number} {name}" for name, number in truth.moving.items()) or "nothing that moves"


def _read(survey: Survey, truth: TruthFound) -> Iterator[str]:
    if survey.proposals:
        yield from read_block(survey.proposals[0])
    if not survey.choice:
        return
    others = [t.topic for t in survey.truth if t.topic != truth.topic]
    yield f"read: {{topic: {quoted(truth.topic)}}}   # where the truth is"
    yield from (f"# read: {{topic: {quoted(topic)}}}   # could be it, too" for topic in others[:_OTHERS])


def _ego(truth: TruthFound, guess: Suggestion) -> Iterator[str]:
    """Whose eyes: as the log says, or a guess that says so."""
    ego, why = guess.ego, _plain(guess.ego_why)
    if ego is None:
        yield f"# ego: <id>   # left out: {why}"
    elif isinstance(ego, dict):
        yield f"ego:   # {why}"
        yield from (f"  {key}: {quoted(value)}" for key, value in ego.items())
        yield "  # size_m: [4.5, 1.8, 1.5]   # its length, width, height: without, gaps and braking are unknown"
        yield "  # centre_from_rear_axle_m: 1.4   # from these poses, often the rear axle's, ahead to its centre"
    else:
        yield f"# {why}"
        yield f"ego: {quoted(ego)}" + ("" if ego == "none" else "   # a guess; none: no ego, a mast judged by itself")
        if ids := truth.vehicles:
            yield f"# ego: <id>   # of {_plain(ids)}"


def _units(
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
        yield f"  {name}: {{at: {flow(mast.at)}, yaw_deg: {mast.yaw_deg}, height_m: 6.0, pem: roadside}}"
    if ego:
        yield "  # others: {on: {classes: [car, truck], penetration_rate: 0.3}, pem: onboard}   # 30 % of them (V2V)"
    if recorded:
        yield "  # Lists as they were recorded. `delay_s`, `covariance_m2`: for messages that don't say when they were"
        yield "  # captured, and how uncertain they are."
    for name, unit in recorded:
        yield from (f"  # {_plain(line)}" for line in unit.oddities)
        late = "" if unit.delay is None else f"   # delay_s {_plain(unit.delay)}"
        yield f"  {name}: {{recorded: {_recorded_value(unit)}}}{late}"
    for unit in lists:
        if unit.problem:
            yield f"  # {quoted(unit.topic)} cannot be a unit: {_plain(unit.problem)}"


def _configurations(first: Sequence[str], recorded: Sequence[str], *, ego: bool) -> Iterator[str]:
    """Nobody errs, one alone, all together: at once, late, and through a fusion that sees no truth."""
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


def _outputs(outputs: Sequence[tuple[str, UnitFound]], recorded: Sequence[str]) -> Iterator[str]:
    """What a stack made of the lists, by the names of topics: measured like a fusion."""
    for name, unit in outputs:
        yield "  # By its name a stack's own output, and its inputs; if it is not, use it as a unit"
        yield from (f"  # {_plain(line)}" for line in unit.oddities)
        late = "" if unit.delay is None else f"   # delay_s {_plain(unit.delay)}"
        yield f"  {name}: {{recorded: {_recorded_value(unit)}, inputs: [{', '.join(recorded)}]}}{late}"


def _measure(guess: Suggestion, *, ego: bool) -> Iterator[str]:
    kinds = {"vru": "pedestrians, bicycles, motorcycles", "vehicles": "cars, trucks, …"}
    yield "measure:"
    if guess.classes:
        said = ", ".join(kinds[name] for name in guess.classes)
        yield f"  objects: {{classes: {flow(guess.classes)}}}   # {said}; or {{ids: [1, 2]}}; left out: all"
    else:
        yield "  # objects: {classes: [vru]}   # left out: all that moves but the ego"
    if guess.onset == "appears":
        yield "  onset: {kind: appears}   # the clock starts; no object comes within 50 m of the ego (in_range)"
    else:
        yield "  onset: {kind: in_range, range_m: 50}   # the clock starts; or appears, starts_moving, line_of_sight"
    if not ego:
        yield "  distance_to: roadside   # there is no ego: ranges and distances are from here"
    yield "  confirm: {hits: 1, of: 1}   # known when so many of the last lists hold it"


def _recorded(truth: TruthFound) -> tuple[list[tuple[str, UnitFound]], list[tuple[str, UnitFound]]]:
    """The lists that could be read, by names that say which: of units, and of what a stack made of them."""
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


def _recorded_value(unit: UnitFound) -> str:
    parts = [f"topic: {quoted(unit.topic)}"]
    parts += [] if unit.captures_said else [f"delay_s: {unit.delay_s or 0.0}"]
    parts += [] if unit.covariances_said else [f"covariance_m2: {_UNIT}"]
    return f"{{{', '.join(parts)}}}"


def quoted(text: str) -> str:
    """Text as YAML has it; ids may be numbers."""
    return text if text.isascii() and text.isdecimal() and str(int(text)) == text else flow(text)


def _plain(text: str) -> str:
    """One line for a comment."""
    return "".join(c if c.isprintable() else " " for c in text)

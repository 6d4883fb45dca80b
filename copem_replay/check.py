"""Everything that can be wrong with an experiment beyond the shape of its file: references, and the logs it names.

References are checked on the file's plain data, so that a typo elsewhere does not hide them.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from copem_replay.errors import RecordingError
from copem_replay.experiment import LONGEST_CHAIN, Carriers, Experiment
from copem_replay.experiment_file import Source, is_there, log_paths, parse
from copem_replay.plain_yaml import Key
from copem_replay.read import Recording, moving_ids, read

NO_EGO = "none"
"""`ego: none`: no ego in this study."""


@dataclass(frozen=True)
class Refused:
    """A log that cannot be replayed, and why. `key`: what the experiment asks of it in vain."""

    path: Path
    reason: str
    key: Key | None = None

    def said(self, source: Source | None) -> str:
        """The reason as a line: where it is, and what is wrong."""
        line = f"{self.path}: {self.reason}"
        return line if self.key is None or source is None else source.at(self.key, line)


def problems(source: Source) -> tuple[Experiment | None, list[str]]:
    """The experiment, or None where its shape is wrong, and all problems that show without a look at the logs."""
    experiment, found = parse(source)
    found += references(source)
    found += log_paths(source)[1]
    return experiment, sorted(found, key=lambda line: _line_number(line, source.path))


def _line_number(problem: str, path: Path) -> int:
    number = problem.removeprefix(f"{path}:").partition(":")[0]
    return int(number) if number.isdigit() else 0


def references(source: Source) -> Iterator[str]:
    """Names that nothing bears: PEMs, units, ids of units in latencies and in `distance_to`; a run that is not made."""
    data = source.data
    pems, units = _names(data.get("pems")), _names(data.get("units"))
    for name, unit in _items(data.get("units")):
        pem = unit.get("pem")
        if _is_name(pem) and str(pem) not in pems:
            yield source.at(("units", name, "pem"), _unknown("PEM", pem, pems))
    for name, configuration in _items(data.get("configurations")):
        yield from _configuration(source, ("configurations", name), configuration, units)
    measure = data.get("measure")
    if isinstance(measure, dict):
        place = measure.get("distance_to", "ego")
        if _is_name(place) and place != "ego" and str(place) not in units:
            yield source.at(("measure", "distance_to"), _unknown("unit", place, ["ego", *units]))
        onset = measure.get("onset")
        if isinstance(onset, dict) and onset.get("kind") == "line_of_sight_any" and not units:
            yield source.at(("measure", "onset"), "line_of_sight_any: there is no unit to see anything")
    yield from _braking(source, data)
    yield from _carried(source, data)
    yield from _sweep(source, data, units)
    show, runs = data.get("show"), data.get("runs", 1)
    run = show.get("run") if isinstance(show, dict) else None
    if isinstance(run, int) and isinstance(runs, int) and 1 <= runs <= run:
        yield source.at(("show", "run"), f"expected a run below {runs}, found {run}")


def _braking(source: Source, data: dict[str, Any]) -> Iterator[str]:
    """What braking and exact times need, and what they do not go with."""
    braking, measure = data.get("braking"), data.get("measure")
    measure = measure if isinstance(measure, dict) else {}
    confirm = measure.get("confirm")
    if measure.get("exact") is True and isinstance(confirm, dict):
        of = confirm.get("of", 1)
        if isinstance(of, int) and confirm.get("hits", 1) != 1 and of > LONGEST_CHAIN:
            message = f"exact: expected `of` at most {LONGEST_CHAIN} (2 to the power of `of` states), found {of}"
            yield source.at(("measure", "confirm", "of"), message)
    if data.get("ego") == NO_EGO:
        for key in (("braking",), ("measure", "conflict")):
            if (braking if key[0] == "braking" else measure.get("conflict")) is not None:
                yield source.at(key, f"{key[-1]}: there is no ego in this study (`ego: none`) to brake or collide")
    if not isinstance(braking, dict) or braking.get("brakes_for") != "conflict":
        return
    if measure.get("conflict") is None:
        yield source.at(
            ("braking", "brakes_for"),
            "brakes_for: conflict needs `measure.conflict`, such as `conflict: {horizon_s: 3}`",
        )
    if measure.get("exact") is True:
        yield source.at(
            ("measure", "exact"),
            "exact: perceived conflicts depend on sampled errors and have no closed form; use `brakes_for: object`",
        )


def _carried(source: Source, data: dict[str, Any]) -> Iterator[str]:
    """What units that only some runs have do not go with."""
    measure = data.get("measure")
    measure = measure if isinstance(measure, dict) else {}
    hits = measure["confirm"].get("hits", 1) if isinstance(measure.get("confirm"), dict) else 1
    for name, unit in _items(data.get("units")):
        if not isinstance(unit.get("on"), dict):
            continue
        if measure.get("distance_to") == name:
            yield source.at(
                ("measure", "distance_to"), f"unit {name!r} is carried by several objects; name a single one"
            )
        if isinstance(hits, int) and hits > 1 and measure.get("exact") is True:
            yield source.at(
                ("measure", "exact"),
                f"exact: unit {name!r} is only in some runs, and confirmation by several hits then has no closed "
                "form; confirm with one hit",
            )


def _sweep(source: Source, data: dict[str, Any], units: Sequence[str]) -> Iterator[str]:
    """Names and numbers of a sweep that there are not."""
    sweep = data.get("sweep")
    if not isinstance(sweep, dict):
        return
    named, configurations = sweep.get("configurations"), _names(data.get("configurations"))
    for k, name in enumerate(named if isinstance(named, list) else []):
        if _is_name(name) and str(name) not in configurations:
            yield source.at(("sweep", "configurations", k), _unknown("configuration", name, configurations))
    carried = [name for name, unit in _items(data.get("units")) if isinstance(unit.get("on"), dict)]
    if sweep.get("share") and not carried:
        yield source.at(("sweep", "share"), "share: no unit is `on: {classes, share}`")
    if sweep.get("rate_hz") and not units:
        yield source.at(("sweep", "rate_hz"), "rate_hz: the experiment has no units")
    others = sum(1 for _, unit in _items(data.get("units")) if unit.get("on") != "ego")
    counts = sweep.get("units")
    for k, count in enumerate(counts if isinstance(counts, list) else []):
        if isinstance(count, int) and count > others:
            yield source.at(
                ("sweep", "units", k), f"expected at most {others}, the units beside the ego's; found {count}"
            )


def _configuration(source: Source, key: Key, configuration: dict[str, Any], units: Sequence[str]) -> Iterator[str]:
    chosen = configuration.get("units")
    if chosen == "all" and not units:
        yield source.at((*key, "units"), "all: the experiment has no units")
    given: list[str] = []
    for k, unit in enumerate(chosen if isinstance(chosen, list) else []):
        if _is_name(unit) and str(unit) not in units:
            yield source.at((*key, "units", k), _unknown("unit", unit, units))
        elif str(unit) in given:
            yield source.at((*key, "units", k), f"unit {str(unit)!r} named twice")
        given.append(str(unit))
    latency = configuration.get("latency_s")
    for unit in latency if isinstance(latency, dict) else ():
        if unit not in [*units, "default", "truth"]:
            yield source.at((*key, "latency_s", unit), _unknown("unit", unit, [*units, "default"]))


def _items(mapping: object) -> Iterator[tuple[str, dict[str, Any]]]:
    for name, value in mapping.items() if isinstance(mapping, dict) else ():
        if isinstance(value, dict):
            yield name, value


def _names(mapping: object) -> list[str]:
    return [str(name) for name in mapping] if isinstance(mapping, dict) else []


def _is_name(value: object) -> bool:
    return isinstance(value, str | int) and not isinstance(value, bool)


def _unknown(what: str, name: object, known: Iterable[str]) -> str:
    names = list(dict.fromkeys(known))
    near = difflib.get_close_matches(str(name), names, n=1)
    hint = f"; did you mean {near[0]}?" if near else f"; there {'are ' + ', '.join(names) if names else 'are none'}"
    return f"no {what} is named {str(name)!r}{hint}"


def place_of(path: Path) -> Path:
    """Where a file is, whatever led there; its own name is kept, even if it is a link's."""
    return Path(os.path.realpath(path.parent)) / path.name


def log_names(paths: Sequence[Path]) -> list[str]:
    """A name per log: its file name, made unique by its folder where two are alike."""
    whole = [place_of(path).relative_to("/") for path in paths]
    bare = [path.with_suffix("") for path in whole]
    bare = [short if bare.count(short) == 1 else path for short, path in zip(bare, whole, strict=True)]
    depth = [1] * len(paths)
    while True:
        names = ["/".join(path.parts[-d:]) for path, d in zip(bare, depth, strict=True)]
        again = [names.count(name) > 1 and d < len(p.parts) for name, p, d in zip(names, bare, depth, strict=True)]
        if not any(again):
            return names
        depth = [d + twice for d, twice in zip(depth, again, strict=True)]


def read_logs(
    experiment: Experiment, paths: Mapping[Path, Key | None] | Iterable[Path], source: Source | None
) -> tuple[list[Recording], list[Refused]]:
    """The recordings that can be replayed, and what is wrong with those that cannot.

    `paths`: with where the experiment names each. A file that is named twice is read once.
    """
    keys = paths if isinstance(paths, Mapping) else dict.fromkeys(paths)
    recordings: dict[str, Recording] = {}
    refused: list[Refused] = []
    for path, key in keys.items():
        if not is_there(path):
            refused.append(Refused(path, "no such file", key))
        elif (place := os.path.realpath(path)) not in recordings:
            recording, wrong = _read(experiment, path)
            refused += wrong
            if recording is not None and not wrong:
                recordings[place] = recording
    # Named when it is known which there are: the experiment that is written with the results names only these.
    names = log_names([recording.path for recording in recordings.values()])
    return [replace(r, scene=replace(r.scene, log=n)) for r, n in zip(recordings.values(), names, strict=True)], refused


def _read(experiment: Experiment, path: Path) -> tuple[Recording | None, list[Refused]]:
    try:
        str(place_of(path)).encode()
    except UnicodeEncodeError:
        return None, [Refused(path, "its path is not UTF-8: results could not name it")]
    ego = None if experiment.ego in (None, NO_EGO) else experiment.ego
    wrong: list[Refused] = []
    try:
        recording = read(path, name=path.stem, ego=ego, topic=experiment.read.topic)
    except RecordingError as error:
        reasons = [line.removeprefix(f"{path}: ") for line in error.problems]
        if not reasons[0].startswith("ego: "):
            key = ("read", "topic") if "no true objects on topic" in reasons[0] else None
            return None, [Refused(path, reason, key) for reason in reasons]
        wrong.append(Refused(path, reasons[0].removeprefix("ego: "), ("ego",)))
        recording = read(path, name=path.stem, topic=experiment.read.topic)  # for what else is wrong
    if experiment.ego == NO_EGO:
        recording = replace(recording, scene=replace(recording.scene, ego_ix=-1))
    return recording, wrong + [Refused(path, reason, key) for key, reason in against_log(experiment, recording, wrong)]


def against_log(
    experiment: Experiment, recording: Recording, known: Sequence[Refused] = ()
) -> Iterator[tuple[Key, str]]:
    """Problems of an experiment with one log, beside `known` ones: no ego, carriers that are not in it."""
    scene = recording.scene
    none = scene.ego_ix < 0
    if none and experiment.ego is None:
        yield (
            ("ego",),
            f"no ego vehicle in this log{_host(recording)}; give `ego: <object id>` or --ego ID "
            f"({moving_ids(scene)}), or `ego: none` with `distance_to: <unit>`",
        )
    studied = not none or experiment.ego != NO_EGO  # an ego that is sought and not there is said once
    if not studied and experiment.measure.distance_to == "ego":
        yield ("measure", "distance_to"), "`ego: none` needs `distance_to: <unit>` to measure distances from"
    for name, unit in experiment.units.items():
        if unit.on == "ego":
            if not studied:
                yield ("units", name, "on"), "no ego in this study to carry the unit"
        elif isinstance(unit.on, Carriers):
            taken = [one for one in scene.object_ids if f"{name}:{one}" in experiment.units]
            if taken:
                yield ("units", f"{name}:{taken[0]}"), f"that is what {name} is called on object {taken[0]}"
        elif unit.on is not None and unit.on not in scene.object_number:
            yield ("units", name, "on"), f"no object {unit.on!r} in the log; there are {moving_ids(scene)}"
    if experiment.measure.onset.kind != "line_of_sight" or known:
        return
    if not studied:
        yield ("measure", "onset"), "line_of_sight is the ego's; without an ego use line_of_sight_any"
    elif not none:
        on_ego = ("ego", scene.object_ids[scene.ego_ix])
        if not any(unit.on in on_ego for unit in experiment.units.values()):
            yield ("measure", "onset"), "line_of_sight needs a unit on the ego; or use line_of_sight_any"


def across_logs(experiment: Experiment, recordings: Sequence[Recording], source: Source | None) -> Iterator[str]:
    """Problems with all logs together: measured ids that are in none of them, shown logs that do not exist."""

    def at(key: Key, message: str) -> str:
        return source.at(key, message) if source else message

    scenes = [recording.scene for recording in recordings]
    for k, wanted in enumerate(experiment.measure.objects.ids or () if scenes else ()):
        key = ("measure", "objects", "ids", k)
        there = [scene for scene in scenes if wanted in scene.object_number]
        if not there:
            yield at(key, f"no object {wanted!r} in any log; the first has {moving_ids(scenes[0])}")
        elif all(scene.object_number[wanted] == scene.ego_ix for scene in there):
            yield at(key, f"{wanted!r} is the ego vehicle, which is not measured")
    names = [scene.log for scene in scenes]
    for k, wanted in enumerate(experiment.show.logs if experiment.show else ()):
        if names and wanted not in ("first", "all", *names):
            yield at(("show", "logs", k), _unknown("log", wanted, ["first", "all", *names]))


def _host(recording: Recording) -> str:
    if recording.host_id is None:
        return " (host_vehicle_id is not set)"
    return f" (its host_vehicle_id {recording.host_id!r} is no moving object of it)"

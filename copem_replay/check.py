"""Everything that can be wrong with an experiment beyond the shape of its file: references, and the logs it names.

References are checked on the file's plain data, so that a typo elsewhere does not hide them.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from copem_replay.errors import RecordingError
from copem_replay.experiment import Experiment
from copem_replay.experiment_file import Key, Source, log_paths, parse
from copem_replay.read import Recording, read
from copem_replay.tracks import CLASSES, Scene

NO_EGO = "none"
"""`ego: none`: no ego in this study."""


def problems(source: Source) -> tuple[Experiment | None, list[str]]:
    """The experiment, or None where its shape is wrong, and all problems that can be seen without the logs' content."""
    experiment, found = parse(source)
    found += references(source)
    paths, missing = log_paths(source)
    found += missing
    found += [f"{source.path}: logs: {path}: no such file" for path in paths if not path.exists()]
    return experiment, sorted(found, key=lambda line: _line_number(line, source.path))


def _line_number(problem: str, path: Path) -> int:
    number = problem.removeprefix(f"{path}:").partition(":")[0]
    return int(number) if number.isdigit() else 0


def references(source: Source) -> Iterator[str]:
    """Names that nothing bears: PEMs, units, ids of units in latencies and in `distance_to`."""
    data = source.data
    pems, units = _names(data.get("pems")), _names(data.get("units"))
    for name, unit in _items(data.get("units")):
        pem = unit.get("pem")
        if isinstance(pem, str | int) and str(pem) not in pems:
            yield source.at(("units", name, "pem"), _unknown("PEM", pem, pems))
    for name, configuration in _items(data.get("configurations")):
        yield from _configuration(source, ("configurations", name), configuration, units)
    measure = data.get("measure")
    if isinstance(measure, dict):
        place = str(measure.get("distance_to", "ego"))
        if place != "ego" and place not in units:
            yield source.at(("measure", "distance_to"), _unknown("unit", place, ["ego", *units]))
        onset = measure.get("onset")
        if isinstance(onset, dict) and onset.get("kind") == "line_of_sight_any" and not units:
            yield source.at(("measure", "onset"), "line_of_sight_any: there is no unit to see anything")


def _configuration(source: Source, key: Key, configuration: dict[str, Any], units: Sequence[str]) -> Iterator[str]:
    chosen = configuration.get("units")
    if chosen == "all" and not units:
        yield source.at((*key, "units"), "all: the experiment has no units")
    named = chosen if isinstance(chosen, list) else []
    for k, unit in enumerate(named):
        if isinstance(unit, str | int) and str(unit) not in units:
            yield source.at((*key, "units", k), _unknown("unit", unit, units))
        elif unit in named[:k]:
            yield source.at((*key, "units", k), f"unit {unit!r} named twice")
    latency = configuration.get("latency_s")
    for unit in latency if isinstance(latency, dict) else ():
        if str(unit) not in [*units, "default", "truth"]:
            yield source.at((*key, "latency_s", unit), _unknown("unit", unit, [*units, "default"]))


def _items(mapping: object) -> Iterator[tuple[str, dict[str, Any]]]:
    for name, value in mapping.items() if isinstance(mapping, dict) else ():
        if isinstance(value, dict):
            yield name, value


def _names(mapping: object) -> list[str]:
    return [str(name) for name in mapping] if isinstance(mapping, dict) else []


def _unknown(what: str, name: object, known: Sequence[str]) -> str:
    near = difflib.get_close_matches(str(name), known, n=1)
    hint = f"; did you mean {near[0]}?" if near else f"; there {'are ' + ', '.join(known) if known else 'are none'}"
    return f"no {what} is named {str(name)!r}{hint}"


def log_names(paths: Sequence[Path]) -> list[str]:
    """A name per log: its file name, made unique by its folder where two are alike."""
    depth = [1] * len(paths)
    while True:
        names = ["/".join([*p.resolve().parts[-d:-1], p.stem]) for p, d in zip(paths, depth, strict=True)]
        again = [names.count(n) > 1 and depth[k] < len(paths[k].resolve().parts) for k, n in enumerate(names)]
        if not any(again):
            return names
        depth = [d + twice for d, twice in zip(depth, again, strict=True)]


def read_logs(
    experiment: Experiment, paths: Iterable[Path], source: Source | None
) -> tuple[list[Recording], list[tuple[Path, str]]]:
    """The recordings that can be replayed, and those that cannot with the reason, one line per problem."""
    unique = list(dict.fromkeys(paths))
    recordings: list[Recording] = []
    refused: list[tuple[Path, str]] = []
    for path, name in zip(unique, log_names(unique), strict=True):
        try:
            recording = read(
                path,
                name=name,
                ego=None if experiment.ego in (None, NO_EGO) else experiment.ego,
                topic=experiment.read.topic,
            )
        except RecordingError as error:
            refused += [(path, line) for line in error.problems]
            continue
        if experiment.ego == NO_EGO:
            recording = replace(recording, scene=replace(recording.scene, ego_ix=-1))
        wrong = list(against_log(experiment, recording, source))
        refused += [(path, line) for line in wrong]
        if not wrong:
            recordings.append(recording)
    return recordings, refused


def against_log(experiment: Experiment, recording: Recording, source: Source | None) -> Iterator[str]:
    """Problems of an experiment with one log: an ego that is missing, carriers that are not in it."""

    def at(key: Key, message: str) -> str:
        return source.at(key, f"{recording.path}: {message}") if source else f"{recording.path}: {message}"

    scene = recording.scene
    none = scene.ego_ix < 0
    if none and experiment.ego is None:
        yield at(
            ("ego",),
            f"no ego vehicle in this log{_host(recording)}; give `ego: <object id>` or --ego ID "
            f"({_some_objects(scene)}), or `ego: none` with `distance_to: <unit>`",
        )
        return
    if none and experiment.measure.distance_to == "ego":
        yield at(("measure", "distance_to"), "`ego: none` needs `distance_to: <unit>` to measure distances from")
    for name, unit in experiment.units.items():
        if unit.on == "ego":
            if none:
                yield at(("units", name, "on"), "no ego in this study to carry the unit")
        elif unit.on is not None and unit.on not in scene.object_number:
            yield at(("units", name, "on"), f"no object {unit.on!r} in the log; it has {_some_objects(scene)}")
    onset = experiment.measure.onset
    if onset.kind == "line_of_sight" and not none:
        on_ego = ("ego", scene.object_ids[scene.ego_ix])
        if not any(unit.on in on_ego for unit in experiment.units.values()):
            yield at(("measure", "onset"), "line_of_sight needs a unit on the ego; or use line_of_sight_any")
    if onset.kind == "line_of_sight" and none:
        yield at(("measure", "onset"), "line_of_sight is the ego's; without an ego use line_of_sight_any")


def across_logs(experiment: Experiment, recordings: Sequence[Recording], source: Source | None) -> Iterator[str]:
    """Problems with all logs together: measured ids that are in none of them, shown logs that do not exist."""

    def at(key: Key, message: str) -> str:
        return source.at(key, message) if source else message

    for k, wanted in enumerate(experiment.measure.objects.ids or ()):
        if recordings and not any(wanted in r.scene.object_number for r in recordings):
            known = _some_objects(recordings[0].scene)
            yield at(("measure", "objects", "ids", k), f"no object {wanted!r} in any log; the first has {known}")
    names = [r.scene.log for r in recordings]
    for k, wanted in enumerate(experiment.show.logs if experiment.show else ()):
        if names and wanted not in ("first", "all", *names):
            yield at(("show", "logs", k), _unknown("log", wanted, ["first", "all", *names]))
    if experiment.show and isinstance(experiment.show.run, int) and experiment.show.run >= experiment.runs:
        yield at(("show", "run"), f"expected a run below {experiment.runs}, found {experiment.show.run}")


def _host(recording: Recording) -> str:
    if recording.host_id is None:
        return " (host_vehicle_id is not set)"
    return f" (its host_vehicle_id {recording.host_id!r} is no object of it)"


def _some_objects(scene: Scene, most: int = 12) -> str:
    moving = [k for k in range(len(scene.object_ids)) if scene.moving[k]]
    text = ", ".join(f"{scene.object_ids[k]} ({CLASSES[scene.object_class[k]]})" for k in moving[:most])
    return text + (f", … {len(moving)} in all" if len(moving) > most else "")

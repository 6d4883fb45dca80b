"""Validation of an experiment beyond the shape of its file: references, its logs one by one, and all logs together."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from copem_replay.core.errors import (
    EgoError,
    InputError,
    RecordingError,
    RemoteFile,
    escape_unprintable,
    near_name_hint,
    unknown_name_message,
)
from copem_replay.core.site_map import make_area
from copem_replay.core.tracks import Scene
from copem_replay.core.yaml import Key
from copem_replay.experiment.cross_references import NO_EGO, check_references
from copem_replay.experiment.degrees import check_degrees, resolve_degrees, uses_degrees
from copem_replay.experiment.drive import SettingsError, apply_settings, resolve_for_log
from copem_replay.experiment.file import (
    ExperimentSource,
    Problem,
    describe_by_key,
    list_named_paths,
    log_paths,
    parse_experiment,
    place_exists,
    place_identity,
    relocate_settings,
    settings_places,
    source_folder,
)
from copem_replay.experiment.frame import find_frame, write_frame
from copem_replay.experiment.maps import add_maps, list_far_units
from copem_replay.experiment.schema import Experiment, LogSettings, output_unit
from copem_replay.io.config import TruthFields
from copem_replay.io.findings import find_rule
from copem_replay.io.open import (
    DriveRecordings,
    File,
    Local,
    Place,
    check_files_unchanged,
    fetch_place,
    first_recording,
    list_recordings,
    name_log,
    sha256_of,
)
from copem_replay.io.recorded_units import read_recorded_output, read_recorded_unit
from copem_replay.io.recording import KnownLog, Recording, find_middle, moving_ids, read_log
from copem_replay.metrics.config import AREA, NO_AREAS, parse_slices
from copem_replay.metrics.onset import Requires
from copem_replay.perception.config import Carriers
from copem_replay.perception.pem.model import AreaPlace
from copem_replay.perception.sensor_poses import find_enclosing_solid


def check_against_log(
    experiment: Experiment, recording: Recording, *, known: bool = False
) -> Iterator[tuple[Key, str]]:
    """Problems of an experiment with one log, by key: no ego, carriers that the log does not have, units in solids.

    `known`: whether there are other problems already, of which a problem of the onset may be a consequence.
    """
    scene = recording.scene
    no_ego = scene.ego_ix < 0
    if no_ego and experiment.ego is None:
        yield (
            ("ego",),
            f"no ego vehicle in this log{_describe_host(recording)}; give `ego: <object id>` or --ego ID "
            f"({moving_ids(scene)}), or `ego: none` with `distance_to: <unit>`",
        )
    if experiment.braking is not None and not no_ego and not scene.ego_sized:
        yield ("braking",), "the size of the ego is not known; give `ego: {topic: …, size_m: [length, width, height]}`"
    studied = not no_ego or experiment.ego != NO_EGO  # a missing ego is reported once
    if not studied and experiment.measure.distance_to == "ego":
        yield ("measure", "distance_to"), "`ego: none` needs `distance_to: <unit>` to measure distances from"
    condition = experiment.measure.objects.within
    if not studied and condition is not None and condition.of_ego:
        yield ("measure", "objects", "within"), "no ego in this study, and so no path of it; give `polygon_m`"
    known_areas = (*experiment.areas, *(name for area in scene.areas for name in (area.kind, area.name)))
    for key, areas in _list_named_areas(experiment):
        for k, name in enumerate(areas):
            if name not in known_areas:
                yield (*key, k), unknown_name_message("area", name, known_areas)
    known_lanes = [*(lane.kind for lane in recording.lanes), *(lane.id for lane in recording.lanes)]
    for k, name in enumerate((condition.lanes if condition is not None else None) or ()):
        if name not in known_lanes:
            yield ("measure", "objects", "within", "lanes", k), unknown_name_message("lane", name, known_lanes)
    for name, unit in experiment.units.items():
        if unit.on == "ego":
            if not studied:
                yield ("units", name, "on"), "no ego in this study to carry the unit"
        elif isinstance(unit.on, Carriers):
            taken = [one for one in scene.object_ids if f"{name}:{one}" in experiment.units]
            if taken:
                yield ("units", f"{name}:{taken[0]}"), f"this is the name of {name} on object {taken[0]}"
        elif unit.on is not None and unit.on not in scene.object_number:
            yield ("units", name, "on"), f"no object {unit.on!r} in the log; there are {moving_ids(scene)}"
    yield from _check_units_in_solids(experiment, recording)
    yield from _check_velocities(experiment, recording)
    onset = experiment.measure.onset
    if onset.requires is not Requires.UNIT_ON_EGO or known:
        return
    if not studied:
        yield ("measure", "onset"), f"{onset.kind} needs an ego; without one use line_of_sight_any"
    elif not no_ego:
        on_ego = ("ego", scene.object_ids[scene.ego_ix])
        if not any(unit.on in on_ego for unit in experiment.units.values()):
            yield ("measure", "onset"), f"{onset.kind} needs a unit on the ego; or use line_of_sight_any"


def _list_named_areas(experiment: Experiment) -> Iterator[tuple[Key, Sequence[str]]]:
    """Keys that name areas, and the names."""
    if (within := experiment.measure.objects.within) is not None:
        yield ("measure", "objects", "within", "areas"), within.areas or ()
    for name in sorted(experiment.pems.keys() & {unit.pem for unit in experiment.modelled.values()}):
        for k, ghosts in enumerate(experiment.pems[name].ghosts):
            if isinstance(ghosts.where, AreaPlace):
                yield ("pems", name, "ghosts", k, "where", "areas"), ghosts.where.areas


def _check_units_in_solids(experiment: Experiment, recording: Recording) -> Iterator[tuple[Key, str]]:
    for name, unit in experiment.units.items():
        enclosing = find_enclosing_solid(recording.scene, recording.truth, unit, experiment.obstacles)
        if enclosing is not None:
            solid, depth_m = enclosing
            yield (
                ("units", name, "at"),
                f"{name} stands {depth_m:.2g} m inside {solid.name} (z {solid.bottom_m:.4g} … {solid.top_m:.4g} m): it "
                "would look through it; expected a place beside it, or `height_m` above its top",
            )


def _check_velocities(experiment: Experiment, recording: Recording) -> Iterator[tuple[Key, str]]:
    """The key and line of a problem: lists without velocities, of which a fusion cannot say whether to brake."""
    needing_units = {
        unit
        for name, configuration in experiment.configurations.items()
        if not getattr(configuration.fusion, "remembers", False)
        for unit in (*experiment.units_of(configuration), output_unit(name))
    }
    silent = [name for name, of in recording.lists.items() if not of.velocity_said and len(of.tracks.frame_ix)]
    if experiment.needless is not None and (named := [name for name in silent if name in needing_units]):
        yield (
            ("braking", "needless"),
            f"the lists of {', '.join(named)} state no velocity, so all would stand in the way; expected a fusion that "
            "remembers (tracker), or `braking: {needless: null}`",
        )


def _describe_host(recording: Recording) -> str:
    if (apart := find_rule(recording.notes, "two clocks")) is not None:
        return f" ({apart})"
    if recording.host_id is None:
        return " (host_vehicle_id is not set)"
    return f" (its host_vehicle_id {recording.host_id!r} is no moving object of it)"


@dataclass(frozen=True)
class RefusedLog:
    """A log that cannot be replayed, and why. `key`: of the experiment, where the log lacks what the key asks for."""

    path: File
    reason: str
    key: Key | None = None

    def within(self, entry: int | None, settings: LogSettings | None) -> RefusedLog:
        """The refusal with the key in the entry of `logs`, where that entry sets the key."""
        key = self.key
        if settings is None or not key:
            return self
        setting = getattr(settings, str(key[0]), None) if key[0] in settings.model_fields_set else None
        is_set = key[1] in setting if key[0] in ("units", "measure") and setting is not None else setting is not None
        return replace(self, key=("logs", entry or 0, *key)) if is_set else self

    def said(self, source: ExperimentSource | None) -> str:
        """The reason in one line, with the place in the experiment file."""
        line = f"{self.path}: {self.reason}"
        return line if self.key is None or source is None else source.at(self.key, line)


def find_problems(source: ExperimentSource) -> tuple[Experiment | None, list[str]]:
    """The experiment, None where its shape is wrong, and all problems that need no log to be found."""
    experiment, problems = parse_experiment(source)
    if experiment is not None and (unfit := list(_unfit_settings(source, experiment))):
        experiment, problems = None, problems + unfit
    problems += check_references(source)
    problems += log_paths(source)[1]
    return experiment, sorted(problems, key=lambda problem: problem.line if isinstance(problem, Problem) else 0)


def _unfit_settings(source: ExperimentSource, experiment: Experiment) -> Iterator[str]:
    """Problems of the settings of single logs, once the experiment's keys are replaced by them."""
    for k, entry in enumerate(experiment.logs):
        if isinstance(entry, LogSettings):
            try:
                apply_settings(experiment, entry)
            except SettingsError as error:
                for key, message in describe_by_key(error.error, error.data, error.key):
                    yield source.at(("logs", k, *key), message)


def resolve_place(path: Path) -> Path:
    """The path of a file with links resolved, except that of its own name, which may be a link's."""
    if path.name in ("", ".."):  # folders named relative to the working folder
        return Path(os.path.realpath(path))
    return Path(os.path.realpath(path.parent)) / path.name


def log_names(paths: Sequence[File]) -> list[str]:
    """A name per log: the name of its file or folder, made unique by its folder where two are alike."""
    full = [(path.path if isinstance(path, RemoteFile) else resolve_place(path)).relative_to("/") for path in paths]
    stems = [
        path.parent / (path.stem if isinstance(of, RemoteFile) else name_log(Path("/", path)))
        for of, path in zip(paths, full, strict=True)
    ]
    count = Counter(stems)
    stems = [short if count[short] == 1 else path for short, path in zip(stems, full, strict=True)]
    depth = [1] * len(paths)
    while True:
        names = ["/".join(path.parts[-d:]) for path, d in zip(stems, depth, strict=True)]
        alike = Counter(names)
        clashes = [alike[name] > 1 and d < len(p.parts) for name, p, d in zip(names, stems, depth, strict=True)]
        if not any(clashes):
            return names
        depth = [d + clash for d, clash in zip(depth, clashes, strict=True)]


class LogCache(Protocol):
    """A store of logs as they are read, each with the experiment resolved for it. `read` reads the log once more."""

    def known(self, place: Place, experiment: Experiment, read: Callable[[], Recording]) -> KnownLog | None:
        """The cached facts of the log; None: it has to be read."""

    def kept(self, recording: Recording, experiment: Experiment, read: Callable[[], Recording]) -> KnownLog:
        """What stays in memory of a log that was read. Raises RecordingError where its files have changed since."""


def read_logs(
    experiment: Experiment,
    paths: Mapping[Place, Key | None] | Iterable[Place],
    source: ExperimentSource | None,
    survey: LogCache | None = None,
) -> tuple[list[KnownLog], list[RefusedLog]]:
    """The logs that can be replayed, without a `survey` all with their content, and the refused ones.

    `paths`: by place the key that names it, or the places alone. A file that is named twice is read once.
    """
    keys = paths if isinstance(paths, Mapping) else dict.fromkeys(paths)
    logs: dict[str, KnownLog] = {}
    refused: list[RefusedLog] = []
    names_by_place = _name_paths(source) if source is not None and isinstance(paths, Mapping) else {}
    settings_of = settings_by_place(experiment, source)
    for path, key in keys.items():
        if (missing := refuse_missing(path, key)) is not None:
            refused.append(missing)
        elif (place := place_identity(path)) not in logs:
            entry, settings = settings_of.get(place, (None, None))
            local = experiment if settings is None else apply_settings(experiment, settings)
            read, wrong = partial(_read_again, local, path), list[RefusedLog]()
            known = None if survey is None else survey.known(path, local, read)
            if known is None:
                known, wrong = recording, wrong = _read_recording(local, path)
                if recording is not None and not wrong and survey is not None:
                    known, wrong = _keep_recording(survey, recording, local, read)
            refused += [log.within(entry, settings) for log in wrong]
            if known is not None and not wrong:
                named = names_by_place.get(place, [])
                notes = [f"named more than once ({', '.join(named)}): replayed once"] if len(named) > 1 else []
                logs[place] = replace(known, notes=tuple(dict.fromkeys((*notes, *known.notes))))
    # Names are made unique among the logs that can be replayed: the experiment of the results lists only these.
    given = {place: settings.name for place, (_, settings) in settings_of.items() if settings.name is not None}
    return _rename_logs(logs, given), refused


def _keep_recording(
    survey: LogCache, recording: Recording, experiment: Experiment, reread: Callable[[], Recording]
) -> tuple[KnownLog | None, list[RefusedLog]]:
    """The part of a recording that stays in memory, or its refusals where its files have changed since."""
    try:
        return survey.kept(recording, experiment, reread), []
    except RecordingError as error:
        path = first_recording(recording.place)
        return None, [
            RefusedLog(path, line) for line in (error.problems if isinstance(path, RemoteFile) else error.within(path))
        ]


def refuse_missing(place: Place, key: Key | None) -> RefusedLog | None:
    """The refusal of a recording that does not exist or cannot be asked for; None: it exists."""
    for recording in list_recordings(place):
        try:
            if not place_exists(recording):
                return RefusedLog(recording, "no such file", key)
        except InputError as error:
            return RefusedLog(recording, error.problems[0].removeprefix(f"{recording}: "), key)
    return None


def _read_again(experiment: Experiment, place: Place) -> Recording:
    """A recording, read again. Raises InputError where it can no longer be read."""
    recording, wrong = _read_recording(experiment, place)
    if recording is None or wrong:
        raise InputError([log.said(None) for log in wrong])
    return recording


def _rename_logs(logs: Mapping[str, KnownLog], given: Mapping[str, str]) -> list[KnownLog]:
    """The logs, by place, with the names that are `given`, or made from their files."""
    unnamed = {place: log for place, log in logs.items() if place not in given}
    names = dict(given)
    names |= zip(unnamed, log_names([first_recording(log.place) for log in unnamed.values()]), strict=True)
    return [replace(log, scene=replace(log.scene, log=names[place])) for place, log in logs.items()]


def settings_by_place(experiment: Experiment, source: ExperimentSource | None) -> dict[str, tuple[int, LogSettings]]:
    """By the identity of the recording's place the number and settings of each entry of `logs` that is a mapping."""
    folder, listed = (Path(), None) if source is None else (source_folder(source), source.listed)
    return {
        place_identity(place): (k, entry)
        for k, entry in enumerate(experiment.logs)
        if isinstance(entry, LogSettings)
        for place in settings_places(experiment.logs, k, folder, listed)
    }


def bind_logs(experiment: Experiment, recordings: Sequence[KnownLog], source: ExperimentSource | None) -> Experiment:
    """The experiment with an entry of `logs` per recording, named and with settings, where any log has settings."""
    settings_of = settings_by_place(experiment, source)
    if not settings_of and not uses_degrees(experiment):
        return experiment
    logs = []
    for recording in recordings:
        _, settings = settings_of.get(place_identity(recording.place), (0, LogSettings(file=".")))
        changes: dict[str, Any] = {"name": recording.scene.log}
        if recording.scene.frame is not None and uses_degrees(apply_settings(experiment, settings)):
            changes["frame"] = write_frame(recording.scene.frame)  # the recording's own: written where it is needed
        logs.append(relocate_settings(settings, recording.place).model_copy(update=changes))
    return experiment.model_copy(update={"logs": tuple(logs)})


def _name_paths(source: ExperimentSource) -> dict[str, list[str]]:
    """By the identity of its place the keys or options that name each file: `logs[0]`, `--log`."""
    names: dict[str, list[str]] = {}
    for name, place in list_named_paths(source):
        if isinstance(place, RemoteFile) or place_exists(place):
            names.setdefault(place_identity(place), []).append(name)
    return names


def _read_recording(experiment: Experiment, place: Place) -> tuple[Recording | None, list[RefusedLog]]:
    """A recording (None: unreadable), and its refusals. A remote file is copied while it is read."""
    if not isinstance(place, RemoteFile):
        return _read_local_recording(experiment, place)
    if (place.there or {}).get("type") == "directory":
        return None, [
            RefusedLog(place, "expected a file, found a folder; a rosbag2 folder is read on this machine only")
        ]
    current_file = RemoteFile(place.url)  # its stamp, asked for just before the copy, identifies the content
    try:
        stamp = current_file.stamp
        with fetch_place(place) as local:
            recording, refusals = _read_local_recording(experiment, local)
            if recording is not None:
                recording = replace(recording, remote=current_file, sha256=sha256_of(local), stamps=None)
        if RemoteFile(place.url).stamp != stamp:
            return None, [RefusedLog(place, "it changed while it was copied; run the command again")]
    except InputError as error:
        return None, [RefusedLog(place, line.removeprefix(f"{place}: ")) for line in error.problems]
    return recording, [replace(one, path=place, reason=one.reason.replace(str(local), str(place))) for one in refusals]


def _read_local_recording(experiment: Experiment, place: Local) -> tuple[Recording | None, list[RefusedLog]]:
    """A recording (None: unreadable) with its lists, frame and maps, and all refusals by the experiment."""
    path = place if isinstance(place, Path) else place.paths[0]
    if experiment.read.definitions is not None:
        place = DriveRecordings((place,), (0.0,)) if isinstance(place, Path) else place
        place = replace(place, definitions=experiment.read.definitions)
    try:
        str(resolve_place(path)).encode()
    except UnicodeEncodeError:
        return None, [RefusedLog(path, "its path is not UTF-8: results could not name it")]
    ego = None if experiment.ego in (None, NO_EGO) else experiment.ego
    wrong: list[RefusedLog] = []
    fields = experiment.read if isinstance(experiment.read, TruthFields) else None
    unit_topics = {recorded.topic for recorded in (*experiment.recorded.values(), *experiment.outputs.values())}
    read = partial(
        read_log, place, name=name_log(path), topic=experiment.read.topic, fields=fields, unit_topics=unit_topics,
        window_s=experiment.window_s, max_gap_s=experiment.max_gap_s, classes=experiment.read.classes,
    )  # fmt: skip
    try:
        recording = read(ego=ego)
    except EgoError as error:
        wrong += [RefusedLog(path, escape_unprintable(reason), error.key) for reason in error.reasons]
        recording = read()  # without an ego, to find other problems
    except RecordingError as error:
        return None, [RefusedLog(path, line, error.key or None) for line in error.within(path)]
    if experiment.ego == NO_EGO:
        recording = replace(recording, scene=replace(recording.scene, ego_ix=-1))
    frame, no_frame_why, of_frame = None, "", list[str]()
    try:
        frame, no_frame_why, of_frame = find_frame(experiment.frame, experiment.maps, recording)
        recording = replace(recording, scene=replace(recording.scene, frame=frame))
    except InputError as error:
        wrong += [RefusedLog(path, line, ("frame",)) for line in error.problems]
    lists, notes = {}, list(recording.notes)
    for name, recorded in experiment.recorded.items():
        try:
            lists[name], list_notes = read_recorded_unit(
                recording, name, recorded, gate_m=experiment.measure.match.gate_m, max_gap_s=experiment.max_gap_s
            )
            notes += list_notes
        except RecordingError as error:
            key: Key = ("units", name, "recorded")
            wrong += [RefusedLog(path, line, key) for line in error.within(path)]
    for name, output in experiment.outputs.items():
        try:
            lists[output_unit(name)], list_notes = read_recorded_output(
                recording, name, output, gate_m=experiment.measure.match.gate_m, max_gap_s=experiment.max_gap_s
            )
            notes += list_notes
        except RecordingError as error:
            key = ("configurations", name, "recorded")
            wrong += [RefusedLog(path, line, key) for line in error.within(path)]
    try:
        check_files_unchanged(recording.stamps or ())
    except RecordingError as error:
        return None, [RefusedLog(path, line) for line in error.within(path)]
    scene = replace(recording.scene, tags={**recording.scene.tags, **experiment.tags})
    recording = replace(recording, scene=scene, lists=lists, notes=(*notes, *of_frame))
    degree_problems = [] if wrong else [*check_degrees(experiment, frame, no_frame_why, find_middle(recording))]
    experiment = resolve_degrees(experiment, frame)
    recording, disagreeing = add_maps(recording, experiment.maps, frame)
    standing_units = {name: unit.at for name, unit in experiment.units.items() if unit.at is not None}
    far_notes = list_far_units(recording, experiment.maps, standing_units) if standing_units and experiment.maps else ()
    recording = take_lanes(experiment, replace(recording, notes=(*recording.notes, *far_notes)))
    wrong += [RefusedLog(path, line, key) for key, line in (*degree_problems, *disagreeing)]
    return recording, wrong + [
        RefusedLog(path, reason, where) for where, reason in check_against_log(experiment, recording, known=bool(wrong))
    ]


def take_lanes(experiment: Experiment, recording: Recording) -> Recording:
    """A recording whose scene has the lanes that `measure.objects.within` of its experiment names."""
    within = experiment.measure.objects.within
    if within is None or within.lanes is None:
        return recording
    named = (lane for lane in recording.lanes if {lane.id, lane.kind} & {*within.lanes})
    areas = tuple(make_area(lane.id, lane.kind, lane.outline_m) for lane in named)
    return replace(recording, scene=replace(recording.scene, lanes=areas))


def _check_slices(experiment: Experiment, scenes: Sequence[Scene], at: Callable[[Key, str], str]) -> Iterator[str]:
    """Lines on tags that `measure.by` or a PEM names and no log has, and on areas where no log has any."""
    known = {name for scene in scenes for name in scene.tags}
    tags_named: list[tuple[Key, str]] = [
        (("measure", "by", k), name) for k, by in enumerate(parse_slices(experiment.measure.by)) for name in by.tags
    ]
    for pem, of in experiment.pems.items():
        tags_named += [
            (("pems", pem, k, "when", "tags"), n) for k, couple in enumerate(of.couples) for n in couple.when.tags or ()
        ]
    for k, entry in enumerate(parse_slices(experiment.measure.by)):
        if entry.names(AREA) and scenes and not (experiment.areas or any(scene.areas for scene in scenes)):
            yield at(("measure", "by", k), NO_AREAS)
    for key, name in tags_named if scenes else ():
        if name not in known:
            has = f"there are {', '.join(sorted(known))}" if known else "`logs: [{file: …, tags: {…}}]` gives tags"
            yield at(key, f"no log has the tag {name!r}{near_name_hint(name, known)}; {has}")


def check_across_logs(
    experiment: Experiment, recordings: Sequence[KnownLog], source: ExperimentSource | None
) -> Iterator[str]:
    """Problems with all logs together: ids or units that no log has, names of shown logs that do not exist."""

    def at(key: Key, message: str) -> str:
        return source.at(key, message) if source else message

    scenes = [recording.scene for recording in recordings]
    at_place_of, names = {place_identity(r.place): r.scene for r in recordings}, [scene.log for scene in scenes]
    count = Counter(names)
    for place, (entry, settings) in settings_by_place(experiment, source).items():
        if (scene := at_place_of.get(place)) is None:
            continue
        if count[scene.log] > 1:
            yield at(("logs", entry, "name"), f"expected a name of its own, found {scene.log!r} of another log, too")
        for n, wanted in enumerate(apply_settings(experiment, settings).measure.objects.ids or ()):
            if "objects" in settings.measure and wanted not in scene.object_number:
                of_id: Key = ("logs", entry, "measure", "objects", "ids", n)
                yield at(of_id, f"no object {wanted!r} in the log; there are {moving_ids(scene)}")
    yield from _check_slices(experiment, scenes, at)
    everywhere = bind_logs(experiment, recordings, source)
    kept = [resolve_for_log(everywhere, scene.log).configurations for scene in scenes]
    for name in experiment.configurations if scenes else ():
        if not any(name in configurations for configurations in kept):
            yield at(("configurations", name), "no log has any of its units")
    for k, wanted in enumerate(experiment.measure.objects.ids or () if scenes else ()):
        key: Key = ("measure", "objects", "ids", k)
        scenes_with_it = [scene for scene in scenes if wanted in scene.object_number]
        if not scenes_with_it:
            yield at(key, f"no object {wanted!r} in any log; the first has {moving_ids(scenes[0])}")
        elif all(scene.object_number[wanted] == scene.ego_ix for scene in scenes_with_it):
            yield at(key, f"{wanted!r} is the ego vehicle, which is not measured")
    for name, criterion in experiment.criteria.items():
        for k, pattern in enumerate(criterion.logs or () if names else ()):
            if not any(fnmatchcase(log, pattern) for log in names):
                yield at(("criteria", name, "logs", k), unknown_name_message("log", pattern, names))
    for k, wanted in enumerate(experiment.show.logs if experiment.show else ()):
        if names and wanted not in ("first", "all", *names):
            yield at(("show", "logs", k), unknown_name_message("log", wanted, ["first", "all", *names]))

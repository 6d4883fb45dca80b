"""Everything that can be wrong with an experiment beyond the shape of its file: references, and the logs it names."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Protocol

from copem_replay.core.errors import EgoError, InputError, RecordingError, printable
from copem_replay.core.remote import Remote
from copem_replay.core.text import unknown
from copem_replay.core.yaml import Key
from copem_replay.experiment.against_log import against_log
from copem_replay.experiment.cross_references import NO_EGO, references
from copem_replay.experiment.drive import SettingsError, of_log, with_settings
from copem_replay.experiment.file import (
    Problem,
    Source,
    at_place,
    folder_of,
    identity,
    is_there,
    log_paths,
    named_paths,
    parse,
    places_of,
)
from copem_replay.experiment.schema import Experiment, LogSettings, output_unit
from copem_replay.experiment.shape_problems import by_key
from copem_replay.io.checksum import check_unchanged, sha256_of
from copem_replay.io.config import ReadFields
from copem_replay.io.open import name_of
from copem_replay.io.recorded_output import recorded_output
from copem_replay.io.recorded_units import recorded_unit
from copem_replay.io.recording import Recording, moving_ids, read
from copem_replay.io.together import File, Local, Place, at_hand, first_of, paths_of


@dataclass(frozen=True)
class Refused:
    """A log that cannot be replayed, and why. `key`: what the experiment asks of it in vain."""

    path: File
    reason: str
    key: Key | None = None

    def within(self, entry: int | None, settings: LogSettings | None) -> Refused:
        """The same, where an entry of `logs` says what the experiment asks: its key there."""
        key = self.key
        if settings is None or not key:
            return self
        asked = getattr(settings, str(key[0]), None) if key[0] in settings.model_fields_set else None
        there = key[1] in asked if key[0] in ("units", "measure") and asked is not None else asked is not None
        return replace(self, key=("logs", entry or 0, *key)) if there else self

    def said(self, source: Source | None) -> str:
        """The reason as a line: where it is, and what is wrong."""
        line = f"{self.path}: {self.reason}"
        return line if self.key is None or source is None else source.at(self.key, line)


def problems(source: Source) -> tuple[Experiment | None, list[str]]:
    """The experiment, or None where its shape is wrong, and all problems that show without a look at the logs."""
    experiment, found = parse(source)
    if experiment is not None and (unfit := list(_unfit_settings(source, experiment))):
        experiment, found = None, found + unfit
    found += references(source)
    found += log_paths(source)[1]
    return experiment, sorted(found, key=lambda problem: problem.line if isinstance(problem, Problem) else 0)


def _unfit_settings(source: Source, experiment: Experiment) -> Iterator[str]:
    """What is wrong with the settings of single logs, once the keys of the experiment are in their place."""
    for k, entry in enumerate(experiment.logs):
        if isinstance(entry, LogSettings):
            try:
                with_settings(experiment, entry)
            except SettingsError as error:
                for key, message in by_key(Experiment, error.error, error.data, error.key):
                    yield source.at(("logs", k, *key), message)


def place_of(path: Path) -> Path:
    """Where a file is, whatever led there; its own name is kept, even if it is a link's."""
    if path.name in ("", ".."):  # folders that are named by where we are
        return Path(os.path.realpath(path))
    return Path(os.path.realpath(path.parent)) / path.name


def log_names(paths: Sequence[File]) -> list[str]:
    """A name per log: the name of its file or folder, made unique by its folder where two are alike."""
    whole = [(path.path if isinstance(path, Remote) else place_of(path)).relative_to("/") for path in paths]
    bare = [
        path.parent / (path.stem if isinstance(of, Remote) else name_of(Path("/", path)))
        for of, path in zip(paths, whole, strict=True)
    ]
    count = Counter(bare)
    bare = [short if count[short] == 1 else path for short, path in zip(bare, whole, strict=True)]
    depth = [1] * len(paths)
    while True:
        names = ["/".join(path.parts[-d:]) for path, d in zip(bare, depth, strict=True)]
        alike = Counter(names)
        again = [alike[name] > 1 and d < len(p.parts) for name, p, d in zip(names, bare, depth, strict=True)]
        if not any(again):
            return names
        depth = [d + twice for d, twice in zip(depth, again, strict=True)]


class Survey(Protocol):
    """What becomes of logs as they are read, each in the experiment resolved for it; `read`: it, once more."""

    def known(self, place: Place, experiment: Experiment, read: Callable[[], Recording]) -> Recording | None:
        """The recording as it is known from before; None: it has to be read."""

    def kept(self, recording: Recording, experiment: Experiment, read: Callable[[], Recording]) -> Recording:
        """What stays in memory of a recording. Raises RecordingError where its files are no longer what was read."""


def read_logs(
    experiment: Experiment,
    paths: Mapping[Place, Key | None] | Iterable[Place],
    source: Source | None,
    survey: Survey | None = None,
) -> tuple[list[Recording], list[Refused]]:
    """The recordings that can be replayed, and what is wrong with those that cannot.

    `paths`: with where the experiment names each. A file that is named twice is read once.
    """
    keys = paths if isinstance(paths, Mapping) else dict.fromkeys(paths)
    recordings: dict[str, Recording] = {}
    refused: list[Refused] = []
    names_of = _named(source) if source is not None and isinstance(paths, Mapping) else {}
    mine = settings_by_place(experiment, source)
    for path, key in keys.items():
        if (missing := gone(path, key)) is not None:
            refused.append(missing)
        elif (place := identity(path)) not in recordings:
            entry, settings = mine.get(place, (None, None))
            alone = experiment if settings is None else with_settings(experiment, settings)
            again, wrong = partial(_again, alone, path), list[Refused]()
            recording = None if survey is None else survey.known(path, alone, again)
            if recording is None:
                recording, wrong = _read(alone, path)
                if recording is not None and not wrong and survey is not None:
                    recording, wrong = _kept(survey, recording, alone, again)
            refused += [log.within(entry, settings) for log in wrong]
            if recording is not None and not wrong:
                named = names_of.get(place, [])
                said = [f"named more than once ({', '.join(named)}): replayed once"] if len(named) > 1 else []
                recordings[place] = replace(recording, notes=tuple(dict.fromkeys((*said, *recording.notes))))
    # Named when it is known which there are: the experiment that is written with the results names only these.
    given = {place: settings.name for place, (_, settings) in mine.items() if settings.name is not None}
    return _with_names(recordings, given), refused


def _kept(
    survey: Survey, recording: Recording, experiment: Experiment, again: Callable[[], Recording]
) -> tuple[Recording | None, list[Refused]]:
    """What stays in memory of a recording, or why it cannot be replayed: its files are others by now."""
    try:
        return survey.kept(recording, experiment, again), []
    except RecordingError as error:
        path = first_of(recording.place)
        return None, [
            Refused(path, line) for line in (error.problems if isinstance(path, Remote) else error.within(path))
        ]


def gone(place: Place, key: Key | None) -> Refused | None:
    """A recording that is not there, or that cannot be asked for."""
    for one in paths_of(place):
        try:
            if not is_there(one):
                return Refused(one, "no such file", key)
        except InputError as error:
            return Refused(one, error.problems[0].removeprefix(f"{one}: "), key)
    return None


def _again(experiment: Experiment, place: Place) -> Recording:
    """A recording that could be read before. Raises InputError where it no longer can."""
    recording, wrong = _read(experiment, place)
    if recording is None or wrong:
        raise InputError([log.said(None) for log in wrong])
    return recording


def _with_names(recordings: Mapping[str, Recording], given: Mapping[str, str]) -> list[Recording]:
    """The recordings, by where they lie, as logs of their own names, or of those that are `given`."""
    unnamed = {place: recording for place, recording in recordings.items() if place not in given}
    names = dict(given)
    names |= zip(unnamed, log_names([first_of(recording.place) for recording in unnamed.values()]), strict=True)
    return [replace(r, scene=replace(r.scene, log=names[place])) for place, r in recordings.items()]


def settings_by_place(experiment: Experiment, source: Source | None) -> dict[str, tuple[int, LogSettings]]:
    """The entries of `logs` that are mappings, and their numbers, by where the recordings lie."""
    folder, listed = (Path(), None) if source is None else (folder_of(source), source.listed)
    return {
        identity(place): (k, entry)
        for k, entry in enumerate(experiment.logs)
        if isinstance(entry, LogSettings)
        for place in places_of(entry, folder, listed)
    }


def bound(experiment: Experiment, recordings: Sequence[Recording], source: Source | None) -> Experiment:
    """The experiment whose entries of `logs` are these recordings, under their names, where any log has settings."""
    mine = settings_by_place(experiment, source)
    if not mine:
        return experiment
    logs = []
    for recording in recordings:
        _, settings = mine.get(identity(recording.place), (0, LogSettings(file=".")))
        logs.append(at_place(settings, recording.place).model_copy(update={"name": recording.scene.log}))
    return experiment.model_copy(update={"logs": tuple(logs)})


def _named(source: Source) -> dict[str, list[str]]:
    """By what each file is named in an experiment, or by options: `logs[0]`, `--log`."""
    names: dict[str, list[str]] = {}
    for name, place in named_paths(source):
        if isinstance(place, Remote) or is_there(place):
            names.setdefault(identity(place), []).append(name)
    return names


def _read(experiment: Experiment, place: Place) -> tuple[Recording | None, list[Refused]]:
    """A recording, and what is wrong with it. What lies elsewhere is on this machine only meanwhile."""
    if not isinstance(place, Remote):
        return _read_here(experiment, place)
    if (place.there or {}).get("type") == "directory":
        return None, [Refused(place, "expected a file, found a folder; a rosbag2 folder is read on this machine only")]
    now = Remote(place.url)  # what is known of it is found by what is said of it just before it is copied
    try:
        stamp = now.stamp
        with at_hand(place) as here:
            recording, wrong = _read_here(experiment, here)
            if recording is not None:
                recording = replace(recording, remote=now, sha256=sha256_of(here), stamps=None)
        if Remote(place.url).stamp != stamp:
            return None, [Refused(place, "it changed while it was copied; run the command again")]
    except InputError as error:
        return None, [Refused(place, line.removeprefix(f"{place}: ")) for line in error.problems]
    return recording, [replace(one, path=place, reason=one.reason.replace(str(here), str(place))) for one in wrong]


def _read_here(experiment: Experiment, place: Local) -> tuple[Recording | None, list[Refused]]:
    path = place if isinstance(place, Path) else place.paths[0]
    try:
        str(place_of(path)).encode()
    except UnicodeEncodeError:
        return None, [Refused(path, "its path is not UTF-8: results could not name it")]
    ego = None if experiment.ego in (None, NO_EGO) else experiment.ego
    wrong: list[Refused] = []
    fields = experiment.read if isinstance(experiment.read, ReadFields) else None
    beside = {asked.topic for asked in (*experiment.recorded.values(), *experiment.outputs.values())}
    how = partial(
        read, place, name=name_of(path), topic=experiment.read.topic, fields=fields, beside=beside,
        window_s=experiment.window_s,
    )  # fmt: skip
    try:
        recording = how(ego=ego)
    except EgoError as error:
        wrong += [Refused(path, printable(reason), error.key) for reason in error.reasons]
        recording = how()  # for what else is wrong
    except RecordingError as error:
        return None, [Refused(path, line, error.key or None) for line in error.within(path)]
    if experiment.ego == NO_EGO:
        recording = replace(recording, scene=replace(recording.scene, ego_ix=-1))
    lists, notes = {}, list(recording.notes)
    for name, asked in experiment.recorded.items():
        try:
            lists[name], said = recorded_unit(
                recording, name, asked, gate_m=experiment.measure.match.gate_m, max_gap_s=experiment.max_gap_s
            )
            notes += said
        except RecordingError as error:
            at = ("units", name, "recorded")
            wrong += [Refused(path, line, at) for line in error.within(path)]
    for name, output in experiment.outputs.items():
        try:
            lists[output_unit(name)], said = recorded_output(
                recording, name, output, gate_m=experiment.measure.match.gate_m, max_gap_s=experiment.max_gap_s
            )
            notes += said
        except RecordingError as error:
            at = ("configurations", name, "recorded")
            wrong += [Refused(path, line, at) for line in error.within(path)]
    try:
        check_unchanged(recording.stamps or ())
    except RecordingError as error:
        return None, [Refused(path, line) for line in error.within(path)]
    recording = replace(recording, lists=lists, notes=tuple(notes))
    return recording, wrong + [
        Refused(path, reason, key) for key, reason in against_log(experiment, recording, known=bool(wrong))
    ]


def across_logs(experiment: Experiment, recordings: Sequence[Recording], source: Source | None) -> Iterator[str]:
    """Problems with all logs together: measured ids that are in none of them, shown logs that do not exist."""

    def at(key: Key, message: str) -> str:
        return source.at(key, message) if source else message

    scenes = [recording.scene for recording in recordings]
    at_place_of, names = {identity(r.place): r.scene for r in recordings}, [scene.log for scene in scenes]
    count = Counter(names)
    for place, (entry, settings) in settings_by_place(experiment, source).items():
        if (scene := at_place_of.get(place)) is None:
            continue
        if count[scene.log] > 1:
            yield at(("logs", entry, "name"), f"expected a name of its own, found {scene.log!r} of another log, too")
        for n, wanted in enumerate(with_settings(experiment, settings).measure.objects.ids or ()):
            if "objects" in settings.measure and wanted not in scene.object_number:
                of_id: Key = ("logs", entry, "measure", "objects", "ids", n)
                yield at(of_id, f"no object {wanted!r} in the log; there are {moving_ids(scene)}")
    everywhere = bound(experiment, recordings, source)
    kept = [of_log(everywhere, scene.log).configurations for scene in scenes]
    for name in experiment.configurations if scenes else ():
        if not any(name in configurations for configurations in kept):
            yield at(("configurations", name), "no log has any of its units")
    for k, wanted in enumerate(experiment.measure.objects.ids or () if scenes else ()):
        key: Key = ("measure", "objects", "ids", k)
        there = [scene for scene in scenes if wanted in scene.object_number]
        if not there:
            yield at(key, f"no object {wanted!r} in any log; the first has {moving_ids(scenes[0])}")
        elif all(scene.object_number[wanted] == scene.ego_ix for scene in there):
            yield at(key, f"{wanted!r} is the ego vehicle, which is not measured")
    for k, wanted in enumerate(experiment.show.logs if experiment.show else ()):
        if names and wanted not in ("first", "all", *names):
            yield at(("show", "logs", k), unknown("log", wanted, ["first", "all", *names]))

"""Study: an experiment with its recordings, checked together; every function and command on both begins with it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

from copem_replay.core.errors import ExperimentError, InputError, is_url
from copem_replay.core.yaml import Key
from copem_replay.experiment.cross_references import NO_EGO, check_references
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.experiment.file import (
    ExperimentSource,
    log_paths,
    make_plain_source,
    place_identity,
    read_experiment_file,
    recording_address,
    replace_logs,
    resolve_entries,
)
from copem_replay.experiment.schema import Experiment, output_unit
from copem_replay.experiment.validate import (
    RefusedLog,
    bind_logs,
    check_across_logs,
    check_against_log,
    find_problems,
    log_names,
    read_logs,
    take_lanes,
)
from copem_replay.io.open import File, Place, first_recording, list_recordings
from copem_replay.io.recording import KnownLog, Recording

if TYPE_CHECKING:
    from copem_replay.pipeline.prepare import Replay
    from copem_replay.pipeline.study_log import LogSurvey


AnyPath: TypeAlias = str | PathLike[str]
AnyExperiment: TypeAlias = Experiment | Mapping[str, Any] | AnyPath
"""An experiment, its keys and values, or the path of its file."""
AnyRecordings: TypeAlias = Recording | AnyPath | Sequence[Recording] | Sequence[AnyPath]
"""Recordings, or their paths; one or several."""


class SurveyingCrew(Protocol):
    """Workers elsewhere that read and check logs (`extras/cluster`)."""

    def survey(
        self,
        experiment: Experiment,
        places: Mapping[Place, Key | None],
        source: ExperimentSource,
        *,
        skip_unreadable: bool,
    ) -> dict[str, list[RefusedLog]]:
        """Logs that cannot be replayed, by the identity of their place."""


@dataclass(frozen=True)
class LoadedStudy:
    """An experiment and the logs it replays. `skipped`: logs that were left out, each with the reason."""

    source: ExperimentSource
    experiment: Experiment
    logs: tuple[KnownLog, ...]
    skipped: tuple[tuple[File, str], ...] = ()
    survey: LogSurvey | None = None

    @property
    def recordings(self) -> tuple[Recording, ...]:
        """The logs whose content is in memory: all without a survey."""
        return tuple(log for log in self.logs if isinstance(log, Recording))


def load_experiment(experiment: AnyExperiment) -> Experiment:
    """Load an experiment from a YAML file, or from the same keys and values in a dict, and check it.

    `logs` then holds the paths of the recordings, globs resolved, relative to the working folder. Of a dict they are
    optional. Units are those of the file: `_m`, `_s`, `_deg` as the names of the keys say.

    Raises ExperimentError with all problems at once (`problems`: a line each, with file, line and key): an unreadable
    file, unknown keys, wrong values, undefined units or PEMs, `logs` that match no file.

    >>> experiment = cr.load_experiment("logs/tc016d.yaml")
    >>> experiment.runs, experiment.logs
    (500, ('logs/tc016d.mcap',))
    """
    source, object_given = load_source(experiment)
    checked, problems = _examine_source(source, object_given)
    if checked is None or problems:
        raise ExperimentError(problems)
    return checked.model_copy(update={"logs": resolve_entries(checked, source)})


def _name_on(data: Any) -> Any:
    """Plain data in which the key `on` has its name; YAML 1.1, which `yaml.safe_load` reads, takes it for True."""
    if isinstance(data, Mapping):
        return {"on" if key is True else key: _name_on(value) for key, value in data.items()}
    return [_name_on(value) for value in data] if isinstance(data, list) else data


def load_source(experiment: AnyExperiment) -> tuple[ExperimentSource, Experiment | None]:
    """Plain data of an experiment; and the experiment, if it is an object.

    An Experiment object is kept because its components may be of classes that no installed name leads to.
    """
    if isinstance(experiment, Experiment):
        return make_plain_source(experiment.as_written()), experiment
    if isinstance(experiment, Mapping):
        return make_plain_source(_name_on(experiment)), None
    return read_experiment_file(Path(experiment)), None


def _examine_source(source: ExperimentSource, loaded: Experiment | None) -> tuple[Experiment | None, list[str]]:
    """The experiment, None if its keys or types are wrong, and all problems that can be found without the logs."""
    if loaded is None:
        return find_problems(source)
    return loaded, [*check_references(source), *log_paths(source)[1]]


def make_study(
    experiment: AnyExperiment,
    recordings: AnyRecordings | None = None,
    survey: LogSurvey | None = None,
    crew: SurveyingCrew | None = None,
) -> LoadedStudy:
    """An experiment with its recordings: those it names (None), those at the paths, or Recordings as they are.

    Raises InputError with all problems of the experiment and of the recordings.
    """
    source, loaded = load_source(experiment)
    if recordings is None:
        return read_study(source, loaded, survey=survey, crew=crew)
    listed = [recordings] if isinstance(recordings, Recording | str | PathLike) else list(recordings)
    paths = tuple(
        entry if isinstance(entry, str) and is_url(entry) else str(Path(_place_of_recording(entry))) for entry in listed
    )
    if not paths:
        raise InputError("recordings: expected at least one, found none")
    source = replace_logs(source, paths, "recordings")
    objects = [entry for entry in listed if isinstance(entry, Recording)]
    if not objects:
        return read_study(source, loaded, survey=survey, crew=crew)
    if crew is not None:
        raise InputError("crew: expected paths of recordings, for its workers read them; found recordings")
    if len(objects) < len(listed):
        raise InputError("recordings: expected either recordings or paths, found both")
    return _check_recordings(source, loaded, objects)


def _place_of_recording(recording: Recording | AnyPath) -> AnyPath:
    return recording_address(first_recording(recording.place)) if isinstance(recording, Recording) else recording


def read_study(
    source: ExperimentSource,
    loaded: Experiment | None = None,
    *,
    skip_unreadable: bool = False,
    survey: LogSurvey | None = None,
    crew: SurveyingCrew | None = None,
) -> LoadedStudy:
    """Read the recordings of an experiment; a log that the survey knows from its parts is not read again.

    A crew surveys logs without parts. The survey also decides which recordings stay in memory.

    Raises InputError with all problems of the experiment and of the recordings.
    """
    experiment, problems = _examine_source(source, loaded)
    if experiment is None:
        raise ExperimentError(problems)
    places, refused_by_crew = log_paths(source)[0], dict[str, list[RefusedLog]]()
    if crew is not None and not problems:
        refused_by_crew = crew.survey(experiment, places, source, skip_unreadable=skip_unreadable)
    readable = {place: key for place, key in places.items() if place_identity(place) not in refused_by_crew}
    recordings, refused = read_logs(experiment, readable, source, survey)
    if refused_by_crew:
        refused += [log for logs in refused_by_crew.values() for log in logs]
        order = {path: k for k, place in enumerate(places) for path in list_recordings(place)}  # of the experiment
        refused = sorted(refused, key=lambda log: order[log.path])
    if not recordings and not refused and not problems:
        problems.append(source.at(("logs",), "expected at least one recording, found none"))
    if not skip_unreadable or not recordings:
        problems += [log.said(source) for log in refused]
    problems += check_across_logs(experiment, recordings, source)
    if problems:
        raise InputError(problems)
    experiment = bind_logs(experiment, recordings, source)
    return LoadedStudy(source, experiment, tuple(recordings), tuple((log.path, log.reason) for log in refused), survey)


def _check_recordings(
    source: ExperimentSource, loaded: Experiment | None, recordings: Sequence[Recording]
) -> LoadedStudy:
    """An experiment with Recording objects, checked against it. Raises InputError with all problems."""
    experiment, problems = _examine_source(source, loaded)
    if experiment is None:
        raise ExperimentError(problems)
    prepared = list[Recording]()
    for recording in recordings:
        local = resolve_for_log(bind_logs(experiment, [recording], source), recording.scene.log)
        problems += _describe_misread(local, recording)
        reasons = check_against_log(local, recording)
        problems += [source.at(key, f"{recording.path}: {reason}") for key, reason in reasons]
        prepared.append(take_lanes(local, recording))
    problems += check_across_logs(experiment, recordings, source)
    names = [recording.scene.log for recording in recordings]
    if len(set(names)) < len(names):
        names = log_names([first_recording(recording.place) for recording in recordings])
        problems += [f"recordings: expected each once, found {n} twice" for n in {*names} if names.count(n) > 1]
    if problems:
        raise InputError(problems)
    recordings = tuple(replace(r, scene=replace(r.scene, log=name)) for r, name in zip(prepared, names, strict=True))
    return LoadedStudy(source, bind_logs(experiment, recordings, source), recordings)


def _describe_misread(experiment: Experiment, recording: Recording) -> Iterator[str]:
    """Problems: ego, window, topic or lists with which a recording was read differ from the experiment's.

    The experiment is saved with the results, and has to read the recording in the same way again.
    """
    way_out = "read it with read_recordings(experiment), or say so in the experiment"
    scene, topic = recording.scene, experiment.read.topic
    actual = scene.object_ids[scene.ego_ix] if scene.ego_ix >= 0 else NO_EGO
    expected = experiment.ego if isinstance(experiment.ego, str) else None
    if experiment.ego is None and recording.around is None:  # the host vehicle, which moves
        host = scene.object_number.get(recording.host_id or "", -1)
        expected = scene.object_ids[host] if host >= 0 and scene.moving[host] else NO_EGO
    if expected is not None and expected != actual:
        yield f"{recording.path}: ego: expected {expected} as by the experiment, found {actual}; {way_out}"
    if (experiment.window_s is None) != (recording.window is None):
        cut = "all of it" if experiment.window_s is None else f"the window {list(experiment.window_s)} s"
        yield f"{recording.path}: window_s: expected {cut} as by the experiment, found another window; {way_out}"
    if topic is not None and topic != recording.topic:
        yield f"{recording.path}: read.topic: expected {topic} as in the experiment, found {recording.topic}; {way_out}"
    for name in experiment.recorded.keys() - recording.lists.keys():
        yield f"{recording.path}: expected the recorded lists of the unit {name}, found none; {way_out}"
    for name in experiment.outputs:
        if output_unit(name) not in recording.lists:
            yield f"{recording.path}: expected the recorded output {name}, found none; {way_out}"


def check_any_counted(study: LoadedStudy, replays: Sequence[Replay] = ()) -> None:
    """Raise ExperimentError where no object of any log counts (`measure.began`).

    `replays`: the prepared logs; of the others it is known from the survey.
    """
    from copem_replay.metrics.onset import check_counted

    numbers = [replay.episodes.count_began() for replay in replays]
    if len(study.recordings) < len(study.logs):
        from copem_replay.pipeline.study_log import StoredLog

        known = [log.said for log in study.logs if isinstance(log, StoredLog)]
        numbers += [said["facts"]["began"] for said in known if "facts" in said]
    numbers += study.survey.began if study.survey is not None else []
    try:
        check_counted(numbers, study.experiment.measure.began)
    except ExperimentError as error:
        raise ExperimentError([study.source.at(("measure", "began"), one) for one in error.problems]) from None


def prepare_study(study: LoadedStudy) -> tuple[list[Replay], list[str]]:
    """The recordings in memory, prepared for the replay, and notes on the memory that it takes.

    Raises ExperimentError: no object that counts, times without a closed form, runs that no memory holds.
    """
    from copem_replay.pipeline.cost import memory_notes
    from copem_replay.pipeline.prepare import prepare_log

    replays = [
        prepare_log(recording, resolve_for_log(study.experiment, recording.scene.log)) for recording in study.recordings
    ]
    check_any_counted(study, replays)
    key: tuple[str, ...] = ("measure", "exact")
    try:
        if study.experiment.measure.exact:
            from copem_replay.pipeline.closed_form import check_closed_form

            check_closed_form(replays, study.experiment)
            if study.survey is not None and study.survey.problems:
                raise ExperimentError(study.survey.problems)
        key = ("runs",)
        return replays, memory_notes(replays, study.experiment, study.survey.sizes if study.survey is not None else ())
    except ExperimentError as error:
        raise ExperimentError([study.source.at(key, problem) for problem in error.problems]) from None

"""An experiment and its recordings, checked together: what every function and every command begins with."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from copem_replay.core.errors import ExperimentError, InputError
from copem_replay.core.remote import is_url
from copem_replay.experiment.against_log import against_log
from copem_replay.experiment.cross_references import NO_EGO, references
from copem_replay.experiment.drive import of_log
from copem_replay.experiment.file import Source, address, entries_of, identity, load, log_paths, plain, with_logs
from copem_replay.experiment.schema import Experiment, output_unit
from copem_replay.experiment.validate import Refused, across_logs, bound, log_names, problems, read_logs
from copem_replay.io.recording import Recording
from copem_replay.io.together import File, first_of, paths_of

if TYPE_CHECKING:  # it imports what a look at an experiment does not need
    from copem_replay.pipeline.crew.crew import Crew
    from copem_replay.pipeline.log_survey import LogSurvey
    from copem_replay.pipeline.prepare import Replay

AnyPath: TypeAlias = str | PathLike[str]
AnyExperiment: TypeAlias = Experiment | Mapping[str, Any] | AnyPath
"""An experiment, its keys and values, or the path of its file."""
AnyRecordings: TypeAlias = Recording | AnyPath | Sequence[Recording] | Sequence[AnyPath]
"""Recordings, or their paths; one or several."""


@dataclass(frozen=True)
class Study:
    """An experiment and the recordings it replays. `skipped`: logs that are left out, each with the reason."""

    source: Source
    experiment: Experiment
    recordings: tuple[Recording, ...]
    skipped: tuple[tuple[File, str], ...] = ()
    survey: LogSurvey | None = None


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
    source, given = source_of(experiment)
    checked, found = _examined(source, given)
    if checked is None or found:
        raise ExperimentError(found)
    return checked.model_copy(update={"logs": entries_of(checked, source)})


def source_of(experiment: AnyExperiment) -> tuple[Source, Experiment | None]:
    """Plain data of an experiment; the experiment itself where it is given: no name need lead to its own classes."""
    if isinstance(experiment, Experiment):
        return plain(experiment.as_written()), experiment
    if isinstance(experiment, Mapping):
        return plain(experiment), None
    return load(Path(experiment)), None


def _examined(source: Source, given: Experiment | None) -> tuple[Experiment | None, list[str]]:
    """The experiment, None where its shape is wrong, and all problems that show without a look at the logs."""
    if given is None:
        return problems(source)
    return given, [*references(source), *log_paths(source)[1]]


def study_of(
    experiment: AnyExperiment,
    recordings: AnyRecordings | None = None,
    survey: LogSurvey | None = None,
    crew: Crew | None = None,
) -> Study:
    """An experiment with its recordings: those it names (None), those at some paths, or those that are read already.

    Raises InputError with all problems of the experiment and of the recordings.
    """
    source, given = source_of(experiment)
    if recordings is None:
        return read_study(source, given, survey=survey, crew=crew)
    listed = [recordings] if isinstance(recordings, Recording | str | PathLike) else list(recordings)
    paths = tuple(one if isinstance(one, str) and is_url(one) else str(Path(_path_of(one))) for one in listed)
    if not paths:
        raise InputError("recordings: expected at least one, found none")
    source = with_logs(source, paths, "recordings")
    read = [one for one in listed if isinstance(one, Recording)]
    if not read:
        return read_study(source, given, survey=survey, crew=crew)
    if crew is not None:
        raise InputError("crew: expected paths of recordings, for its workers read them; found recordings")
    if len(read) < len(listed):
        raise InputError("recordings: expected either recordings or paths, found both")
    return _study_with(source, given, read)


def _path_of(one: Recording | AnyPath) -> AnyPath:
    return address(first_of(one.place)) if isinstance(one, Recording) else one


def read_study(
    source: Source,
    given: Experiment | None = None,
    *,
    skip_unreadable: bool = False,
    survey: LogSurvey | None = None,
    crew: Crew | None = None,
) -> Study:
    """Read the recordings of an experiment, but those that are known to the survey, which says what stays in memory.

    A crew reads those that are not known before.

    Raises InputError with every problem of it and of them.
    """
    experiment, found = _examined(source, given)
    if experiment is None:
        raise ExperimentError(found)
    places, away = log_paths(source)[0], dict[str, list[Refused]]()
    if crew is not None and not found:
        away = crew.survey(experiment, places, source, skip_unreadable=skip_unreadable)
    here = {place: key for place, key in places.items() if identity(place) not in away}
    recordings, refused = read_logs(experiment, here, source, survey)
    if away:  # in the order of the experiment
        at = {path: k for k, place in enumerate(places) for path in paths_of(place)}
        refused = sorted([*refused, *(log for logs in away.values() for log in logs)], key=lambda log: at[log.path])
    if not recordings and not refused and not found:
        found.append(source.at(("logs",), "expected at least one recording, found none"))
    if not skip_unreadable or not recordings:
        found += [log.said(source) for log in refused]
    found += across_logs(experiment, recordings, source)
    if found:
        raise InputError(found)
    experiment = bound(experiment, recordings, source)
    return Study(source, experiment, tuple(recordings), tuple((log.path, log.reason) for log in refused), survey)


def _study_with(source: Source, given: Experiment | None, recordings: Sequence[Recording]) -> Study:
    """An experiment with recordings that are read already, checked against it."""
    experiment, found = _examined(source, given)
    if experiment is None:
        raise ExperimentError(found)
    for recording in recordings:
        alone = of_log(bound(experiment, [recording], source), recording.scene.log)
        found += _misread(alone, recording)
        found += [source.at(key, f"{recording.path}: {reason}") for key, reason in against_log(alone, recording)]
    found += across_logs(experiment, recordings, source)
    names = [recording.scene.log for recording in recordings]
    if len(set(names)) < len(names):
        names = log_names([first_of(recording.place) for recording in recordings])
        found += [f"recordings: expected each once, found {n} twice" for n in {*names} if names.count(n) > 1]
    if found:
        raise InputError(found)
    named = (replace(r, scene=replace(r.scene, log=name)) for r, name in zip(recordings, names, strict=True))
    recordings = tuple(named)
    return Study(source, bound(experiment, recordings, source), recordings)


def _misread(experiment: Experiment, recording: Recording) -> Iterator[str]:
    """How a recording was read otherwise than the experiment says: saved with the results, it has to read the same."""
    way_out = "read it with read_recordings(experiment), or say so in the experiment"
    scene, topic = recording.scene, experiment.read.topic
    found = scene.object_ids[scene.ego_ix] if scene.ego_ix >= 0 else NO_EGO
    expected = experiment.ego if isinstance(experiment.ego, str) else None
    if experiment.ego is None and recording.around is None:  # the host vehicle, which moves
        host = scene.object_number.get(recording.host_id or "", -1)
        expected = scene.object_ids[host] if host >= 0 and scene.moving[host] else NO_EGO
    if expected is not None and expected != found:
        yield f"{recording.path}: ego: expected {expected} as by the experiment, found {found}; {way_out}"
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


def prepared(study: Study) -> tuple[list[Replay], list[str]]:
    """The logs that were read made ready to be replayed, and what has to be said before any run.

    Raises ExperimentError for what cannot be done with them: times without a closed form, runs that no memory holds.
    """
    from copem_replay.pipeline.memory import memory_notes
    from copem_replay.pipeline.prepare import prepare

    read = [recording for recording in study.recordings if recording.survey is None]
    ready = [prepare(recording, of_log(study.experiment, recording.scene.log)) for recording in read]
    key: tuple[str, ...] = ("measure", "exact")
    try:
        if study.experiment.measure.exact:
            from copem_replay.pipeline.run import check_closed_form

            check_closed_form(ready, study.experiment)
            if study.survey is not None and study.survey.problems:
                raise ExperimentError(study.survey.problems)
        key = ("runs",)
        return ready, memory_notes(ready, study.experiment, study.survey.sizes if study.survey is not None else ())
    except ExperimentError as error:
        raise ExperimentError([study.source.at(key, problem) for problem in error.problems]) from None

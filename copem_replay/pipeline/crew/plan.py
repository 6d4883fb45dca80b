"""What a study still wants of its logs, cut into tasks.

A task is of one log and takes at most MOST_CELLS or MOST_ROWS: reading a log again costs little, and what a worker
that dies has to give up is little, too. Nothing of a piece depends on how tasks are cut.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from copem_replay.core.yaml import Key
from copem_replay.experiment.drive import of_log, with_settings
from copem_replay.experiment.file import Source, at_place, identity
from copem_replay.experiment.schema import Experiment, LogSettings
from copem_replay.experiment.validate import gone, log_names, settings_by_place
from copem_replay.io.together import Place, first_of
from copem_replay.pipeline.crew.task import LogTask, Task, Work
from copem_replay.pipeline.pieces import Pieces, ranges
from copem_replay.pipeline.recipe import fingerprint, key_of, recipe
from copem_replay.pipeline.study_log import StudyLog, survey_key
from copem_replay.pipeline.sweep import points

MOST_CELLS, MOST_ROWS = 50_000_000, 500_000
"""Row × run cells, and rows, of a task at most, but one piece (chosen: some seconds)."""
ROWS_AT_ONCE = {False: 250_000, True: 60_000}
"""Rows that a worker has in memory at most, but one piece, without accuracy and with it (chosen: 500 MB or less)."""
LEAST_S = 1.0
"""A task that takes less is not cut further (chosen)."""


def unsurveyed(
    experiment: Experiment, places: Mapping[Place, Key | None], source: Source, pieces: Pieces
) -> dict[str, Task]:
    """Surveys of the logs of which something is not known, by their identities."""
    there = {identity(place): place for place in places if gone(place, None) is None}
    mine = settings_by_place(experiment, source)
    named = {whose: settings.name for whose, (_, settings) in mine.items() if settings.name is not None}
    unnamed = [whose for whose in there if whose not in named]
    # As if all can be replayed: otherwise a log that was called by its folder, too, is looked at again.
    names = named | dict(zip(unnamed, log_names([first_of(there[whose]) for whose in unnamed]), strict=True))
    at = [experiment, *(point.experiment for point in points(experiment))]
    found = {}
    for whose, place in there.items():
        settings = mine[whose][1].model_copy(update={"name": names[whose]}) if whose in mine else None
        resolved = (one if settings is None else with_settings(one, settings) for one in at)
        if any(pieces.known(survey_key(place, one)) is None for one in resolved):
            found[whose] = Task(_log_task(experiment, names[whose], place, settings, pieces.address))
    return found


def missing(experiment: Experiment, logs: Sequence[StudyLog], pieces: Pieces, threads: int) -> list[Task]:
    """What has to be computed: log by log, so that a worker goes on with what it has, the largest first."""
    there = pieces.keys()
    works = {log.name: list(_missing(log, experiment, there)) for log in logs}
    whole_s = sum(Task(_NO_LOG, tuple(work)).about_s for work in works.values())
    most_s = max(whole_s / (4 * threads), LEAST_S)  # so that few logs keep many workers busy
    tasks = []
    for log in logs:
        if works[log.name]:
            entry = next((e for e in experiment.logs if isinstance(e, LogSettings) and e.name == log.name), None)
            of = _log_task(experiment, log.name, log.recording.place, entry, pieces.address)
            tasks += [Task(of, part) for part in _cut(works[log.name], most_s)]
    of_log = dict.fromkeys(works, 0.0)
    for task in tasks:
        of_log[task.log.name] += task.about_s
    return sorted(tasks, key=lambda task: (-of_log[task.log.name], task.log.name, -task.about_s))


def _missing(log: StudyLog, study: Experiment, there: Callable[[str], bool]) -> Iterator[Work]:
    for at, experiment in enumerate([study, *(point.experiment for point in points(study))]):
        alone, facts = of_log(experiment, log.name), log.facts(experiment)
        wanted: list[tuple[int, int] | None] = [None] if experiment.measure.exact else []
        for runs in [*wanted, *ranges(alone.runs, facts.episodes)]:
            keys = {name: key_of(recipe(alone, name, log.identity, runs)) for name in alone.configurations}
            names = [name for name, key in keys.items() if not there(key)]
            count = 1 if runs is None else runs[1] - runs[0]
            rows = max(facts.episodes * count, 1)
            some = max(ROWS_AT_ONCE[alone.measure.accuracy] // rows, 1)
            for k in range(0, len(names), some):
                part = names[k : k + some]
                yield Work(at, runs, {n: keys[n] for n in part}, rows * len(part), facts.listable * count)


def _cut(works: Sequence[Work], most_s: float) -> Iterator[tuple[Work, ...]]:
    """Neighbours together, up to the size of a task."""
    some: list[Work] = []
    for work in works:
        task = Task(_NO_LOG, (*some, work))
        cells = sum(one.cells for one in task.work)
        if some and (cells > MOST_CELLS or task.rows > MOST_ROWS or task.about_s > most_s):
            yield tuple(some)
            some = []
        some.append(work)
    if some:
        yield tuple(some)


_NO_LOG = LogTask("", Path(), "", "", "", ())


def _log_task(experiment: Experiment, name: str, place: Place, settings: LogSettings | None, address: str) -> LogTask:
    written = experiment.as_written()
    del written["logs"]
    if settings is not None:
        entry = at_place(settings, place).model_copy(update={"name": name})
        written["logs"] = [entry.model_dump(mode="json", by_alias=True)]
    made_by = tuple(sorted(fingerprint().items()))
    return LogTask(name, place, json.dumps(written), os.getcwd(), address, made_by)

"""The worker: it reads the log of a task, surveys it or computes and keeps its pieces, and answers with a receipt.

Text and paths are sent to it, keys of pieces come back. Rows, recordings and modules are never sent.
"""

from __future__ import annotations

import json
import os
import platform
import time
import traceback
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from threading import Lock

from pydantic import ValidationError

from copem_replay.core.errors import CopemError, ExperimentError, InputError
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import RefusedLog, read_logs
from copem_replay.io.open import Place
from copem_replay.pipeline.closed_form import check_exact, exact_table
from copem_replay.pipeline.cost import peak_bytes
from copem_replay.pipeline.pieces import PieceCache, recipe_key, take_fingerprint, write_recipe
from copem_replay.pipeline.replay import cut_blocks, replay_outcomes
from copem_replay.pipeline.study_log import STATES_HELD, StudyLog, file_stamps
from copem_replay.pipeline.sweep import list_points
from copem_replay.pipeline.tables import LogTables, log_tables

# Tasks and receipts.


@dataclass(frozen=True)
class LogTask:
    """A log as a worker finds it. `experiment`: the study's, with the settings of this log alone, as JSON."""

    name: str
    place: Place
    experiment: str
    folder: str  # the command's working directory, which paths are relative to
    pieces: str
    fingerprint: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Work:
    """Pieces of one range of runs; `runs` None: closed forms. `at`: index of the sweep point (0: the study itself)."""

    at: int
    runs: tuple[int, int] | None
    keys: Mapping[str, str]  # of the pieces, by configuration
    rows: int = 0
    cells: int = 0


@dataclass(frozen=True)
class Task:
    """What a worker is sent. Without `work` the log is surveyed: read, checked, and its facts are kept."""

    log: LogTask
    work: tuple[Work, ...] = ()

    @property
    def keys(self) -> list[str]:
        """Keys of its pieces."""
        return [key for work in self.work for key in work.keys.values()]

    @property
    def rows(self) -> int:
        """Rows of its pieces."""
        return sum(work.rows for work in self.work)

    @property
    def about_s(self) -> float:
        """About how long it takes (measured on one core: 10 M cells and 150 k rows a second)."""
        return sum(work.cells / 10e6 + work.rows / 150e3 for work in self.work)


@dataclass(frozen=True)
class Receipt:
    """What a worker answers. At most one of `refused`, `problems` and `failure` is set.

    `refused`: why the log cannot be replayed. `problems`: what else is wrong, a line each, at the `key` of the
    experiment. `failure`: the traceback of an internal error.
    """

    host: str
    seconds: float
    peak_bytes: int | None  # the most memory the worker has had so far, where its system says so
    refused: tuple[RefusedLog, ...] = ()
    problems: tuple[str, ...] = ()
    key: tuple[str, ...] = ()
    failure: str | None = None


@dataclass(frozen=True)
class _OpenStudy:
    """A log opened by a worker: the experiment at each point of the study, and the log made ready for it."""

    points: tuple[tuple[Experiment, StudyLog], ...] = ()
    refused: tuple[RefusedLog, ...] = ()
    replayed: bool = False

    @property
    def states(self) -> int:
        """Object states in memory: as each unit sees them, at each point that has units of its own."""
        logs = {id(log): (experiment, log) for experiment, log in self.points}.values()
        return sum(max(len(experiment.units), 1) * log.recording.object_states for experiment, log in logs)


def do_task(task: Task) -> Receipt:
    """Do a task. Errors are in the receipt: no exception has to be sent."""
    began_s, host = time.perf_counter(), platform.node()

    def receipt(**said: object) -> Receipt:
        return Receipt(host, time.perf_counter() - began_s, peak_bytes(), **said)  # type: ignore[arg-type]

    try:
        if other := describe_mismatch(dict(task.log.fingerprint)):
            return receipt(problems=(f"worker {host} {other}: results would not be the same bits",))
        try:
            os.chdir(task.log.folder)
        except OSError:
            return receipt(problems=(f"{task.log.folder}: not visible from worker {host}",))
        study = _get_study(task)
        if study.refused:
            return receipt(refused=study.refused)
        if not task.work and (problems := _survey_log(study)):
            return receipt(problems=problems, key=("measure", "exact"))
        for work in task.work:
            _compute_pieces(study, work, task.log)
        return receipt()
    except CopemError as error:
        return receipt(problems=error.problems)
    except ValidationError as error:  # the experiment is valid where the command runs
        why = error.errors()[0]["msg"]
        return receipt(problems=(f"worker {host}: the experiment cannot be read there: {why}",))
    except Exception:
        return receipt(failure=traceback.format_exc())


def describe_mismatch(expected: Mapping[str, str]) -> str | None:
    """In what this process differs from a fingerprint: `has numba 0.67.1, expected 0.68.1`; None: in nothing."""
    own = take_fingerprint()
    for name, version in expected.items():
        if own[name] != version:
            return f"has {name} {_shorten_version(own[name])}, expected {_shorten_version(version)}"
    return None


def _shorten_version(version: str) -> str:
    """A version whose digest is cut: enough to tell two from one another."""
    name, _, digest = version.partition(" ")
    return f"{name} ({digest[:8]})" if len(digest) == 40 else version


_lock = Lock()
_kept: dict[tuple[LogTask, str], _OpenStudy] = {}
"""Surveyed logs, by their files' stamps, and the one that is replayed; the last one used is last."""


def _get_study(task: Task) -> _OpenStudy:
    log_key = task.log, ""
    with suppress(CopemError):  # reading the log reports the error
        log_key = task.log, repr(file_stamps(task.log.place))
    with _lock:
        study = _kept.pop(log_key, None)
    if study is None or not task.work:  # a survey is asked for where facts are missing
        study = _open_study(task.log)
    with _lock:
        for replayed in [replayed for replayed, one in _kept.items() if one.replayed]:
            del _kept[replayed]
        while _kept and study.states + sum(one.states for one in _kept.values()) > STATES_HELD:
            del _kept[next(iter(_kept))]
        _kept[log_key] = replace(study, replayed=bool(task.work))
    return study


def _open_study(log: LogTask) -> _OpenStudy:
    experiment, pieces = _parse_experiment(log.experiment), _open_pieces(log.pieces, log.folder)
    recordings, refused = read_logs(resolve_for_log(experiment, log.name), [log.place], None)
    if refused:
        return _OpenStudy(refused=tuple(refused))
    recording = replace(recordings[0], scene=replace(recordings[0].scene, log=log.name))
    first = StudyLog(recording, experiment, pieces)
    points = [(experiment, first)]
    for point in list_points(experiment):
        study_log = first if point.same_units else StudyLog(recording, point.experiment, pieces)
        points.append((point.experiment, study_log))
    return _OpenStudy(tuple(points))


@lru_cache(maxsize=2)
def _parse_experiment(text: str) -> Experiment:
    return Experiment.model_validate(json.loads(text))


@lru_cache(maxsize=2)
def _open_pieces(address: str, folder: str) -> PieceCache:  # relative to the folder
    return PieceCache(address)


def _survey_log(study: _OpenStudy) -> tuple[str, ...]:
    """Keep the facts of a log. Returns the problems where exact times are asked for and have no closed form."""
    for experiment, log in study.points:
        try:
            check_exact([log.replay()], experiment)
        except ExperimentError as error:
            return error.problems
        log.facts(experiment)
    return ()


def _compute_pieces(study: _OpenStudy, work: Work, asked: LogTask) -> None:
    """Compute the pieces of one range of runs together, and keep them one by one."""
    experiment, log = study.points[work.at]
    alone, first = resolve_for_log(experiment, log.name), study.points[0][1]
    recipes = {name: write_recipe(alone, name, first.identity, work.runs) for name in work.keys}
    if any(recipe_key(recipes[name]) != key for name, key in work.keys.items()):
        other = "another content, or another file of an own component, than where the command runs"
        raise InputError(f"{asked.place}: on worker {platform.node()} it has {other}")
    of_work = alone.model_copy(update={"configurations": {name: alone.configurations[name] for name in work.keys}})
    if work.runs is None:
        tables = LogTables(log.name, exact_table(log.replay(), of_work))
    else:
        outcomes = [
            outcome
            for block in cut_blocks(log.replay(), of_work, 1, work.runs)
            for outcome in replay_outcomes(log.replay(), of_work, block)
        ]
        tables = log_tables(log.name, outcomes, list(work.keys), accuracy=of_work.measure.accuracy)
    for name, recipe in recipes.items():
        assert log.pieces is not None
        log.pieces.write(recipe, tables.of(name, way=of_work.has_way(name)))

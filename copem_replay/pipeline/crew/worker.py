"""What a worker does of a task: read the log, survey it or compute its pieces, and answer."""

from __future__ import annotations

import json
import os
import platform
import resource
import time
import traceback
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from threading import Lock

from pydantic import ValidationError

from copem_replay.core.errors import CopemError, ExperimentError, InputError
from copem_replay.experiment.drive import of_log
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import Refused, read_logs
from copem_replay.pipeline.blocks import blocks, outcomes
from copem_replay.pipeline.closed_form import check_exact, exact_table
from copem_replay.pipeline.crew.task import LogTask, Receipt, Task, Work
from copem_replay.pipeline.log_survey import STATES_HELD
from copem_replay.pipeline.log_tables import LogTables, log_tables
from copem_replay.pipeline.pieces import Pieces
from copem_replay.pipeline.recipe import fingerprint, key_of, recipe
from copem_replay.pipeline.study_log import StudyLog, stamps
from copem_replay.pipeline.sweep import points


@dataclass(frozen=True)
class _Study:
    """A log opened by a worker, and the experiment at each point of the study, with the log made ready for it."""

    at: tuple[tuple[Experiment, StudyLog], ...] = ()
    refused: tuple[Refused, ...] = ()
    replayed: bool = False

    @property
    def states(self) -> int:
        """Object states in memory: as each unit sees them, at each point that has units of its own."""
        mine = {id(log): (experiment, log) for experiment, log in self.at}.values()
        return sum(max(len(experiment.units), 1) * log.recording.object_states for experiment, log in mine)


def done(task: Task) -> Receipt:
    """Do a task. What goes wrong is in the receipt: nothing is raised that could not be sent."""
    began_s, host = time.perf_counter(), platform.node()

    def receipt(**said: object) -> Receipt:
        peak_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return Receipt(host, time.perf_counter() - began_s, peak_kib * 1024, **said)  # type: ignore[arg-type]

    try:
        if other := differs(dict(task.log.fingerprint)):
            return receipt(problems=(f"worker {host} {other}: results would not be the same bits",))
        try:
            os.chdir(task.log.folder)
        except OSError:
            return receipt(problems=(f"{task.log.folder}: not visible from worker {host}",))
        study = _opened(task)
        if study.refused:
            return receipt(refused=study.refused)
        if not task.work and (problems := _survey(study)):
            return receipt(problems=problems, key=("measure", "exact"))
        for work in task.work:
            _compute(study, work, task.log)
        return receipt()
    except CopemError as error:
        return receipt(problems=error.problems)
    except ValidationError as error:  # of an experiment that is right where the command runs
        why = error.errors()[0]["msg"]
        return receipt(problems=(f"worker {host}: the experiment cannot be read there: {why}",))
    except Exception:
        return receipt(failure=traceback.format_exc())


def differs(expected: Mapping[str, str]) -> str | None:
    """In what this process differs from a fingerprint: `has numba 0.67.1, expected 0.68.1`; None: in nothing."""
    mine = fingerprint()
    for name, there in expected.items():
        if mine[name] != there:
            return f"has {name} {_short(mine[name])}, expected {_short(there)}"
    return None


def _short(version: str) -> str:
    """A version whose digest is cut: enough to tell two from one another."""
    name, _, digest = version.partition(" ")
    return f"{name} ({digest[:8]})" if len(digest) == 40 else version


_lock = Lock()
_kept: dict[tuple[LogTask, str], _Study] = {}
"""Logs that were surveyed, while their files are as they were, and the one that is replayed, the last one last."""


def _opened(task: Task) -> _Study:
    log = task.log, ""
    with suppress(CopemError):  # that it cannot be read is said when it is
        log = task.log, repr(stamps(task.log.place))
    with _lock:
        study = _kept.pop(log, None)
    if study is None or not task.work:  # a survey is asked for because something is not known
        study = _open(task.log)
    with _lock:
        for known in [known for known, one in _kept.items() if one.replayed]:
            del _kept[known]
        while _kept and study.states + sum(one.states for one in _kept.values()) > STATES_HELD:
            del _kept[next(iter(_kept))]
        _kept[log] = replace(study, replayed=bool(task.work))
    return study


def _open(log: LogTask) -> _Study:
    experiment, pieces = _parsed(log.experiment), _pieces_at(log.pieces, log.folder)
    found, refused = read_logs(of_log(experiment, log.name), [log.place], None)
    if refused:
        return _Study(refused=tuple(refused))
    recording = replace(found[0], scene=replace(found[0].scene, log=log.name))
    first = StudyLog(recording, experiment, pieces)
    at = [(experiment, first)]
    for point in points(experiment):
        own = first if point.same_units else StudyLog(recording, point.experiment, pieces)
        at.append((point.experiment, own))
    return _Study(tuple(at))


@lru_cache(maxsize=2)
def _parsed(text: str) -> Experiment:
    return Experiment.model_validate(json.loads(text))


@lru_cache(maxsize=2)
def _pieces_at(address: str, folder: str) -> Pieces:  # relative to the folder
    return Pieces(address)


def _survey(study: _Study) -> tuple[str, ...]:
    """Keep what is known of a log. Returns what is wrong where exact times are asked for and there are none."""
    for experiment, log in study.at:
        try:
            check_exact([log.replay()], experiment)
        except ExperimentError as error:
            return error.problems
        log.facts(experiment)
    return ()


def _compute(study: _Study, work: Work, asked: LogTask) -> None:
    """The pieces of one range of runs: computed together, kept one by one."""
    experiment, log = study.at[work.at]
    alone, first = of_log(experiment, log.name), study.at[0][1]
    recipes = {name: recipe(alone, name, first.identity, work.runs) for name in work.keys}
    if any(key_of(recipes[name]) != key for name, key in work.keys.items()):
        other = "another content, or another file of an own component, than where the command runs"
        raise InputError(f"{asked.place}: on worker {platform.node()} it has {other}")
    mine = alone.model_copy(update={"configurations": {name: alone.configurations[name] for name in work.keys}})
    if work.runs is None:
        tables = LogTables(log.name, exact_table(log.replay(), mine))
    else:
        made = [
            one for block in blocks(log.replay(), mine, 1, work.runs) for one in outcomes(log.replay(), mine, block)
        ]
        tables = log_tables(log.name, made, list(work.keys), accuracy=mine.measure.accuracy)
    for name, made_by in recipes.items():
        assert log.pieces is not None
        log.pieces.write(made_by, tables.of(name, way=mine.has_way(name)))

"""`cr.run` and its result; and, for one recording, the fused tracks of one run and the observations of its units."""

from __future__ import annotations

import importlib
import os
import sys
import time
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from copem_replay.api.study import (
    AnyExperiment,
    AnyPath,
    AnyRecordings,
    LoadedStudy,
    make_study,
    prepare_study,
)
from copem_replay.core.errors import InputError
from copem_replay.core.extras import load_extra
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import CLASSES
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.io.recording import Recording
from copem_replay.pipeline.run import Progress, StudyTables
from copem_replay.results.read import Results

if TYPE_CHECKING:
    from copem_replay.pipeline.parts import PartCache
    from copem_replay.pipeline.prepare import Replay
    from copem_replay.results.write import Exporter


def list_exporters(viewer: str | None = None) -> Sequence[Exporter]:
    """How single runs are written; `viewer`: the address of a Rerun viewer that also gets them."""
    from copem_replay.results.write import MCAP
    from copem_replay.viewer.rrd import make_rrd_exporter

    return [MCAP, make_rrd_exporter(viewer)]


def run(
    experiment: AnyExperiment,
    recordings: AnyRecordings | None = None,
    jobs: int | None = None,
    progress: Progress | None = None,
    pieces: AnyPath | None = None,
    crew: Executor | None = None,
) -> Results:
    """Replay recordings through an experiment, and measure.

    `experiment`: an Experiment, its keys and values in a dict, or the path of its file. `recordings`: Recordings or
    paths, one or several; None: those the experiment names. `jobs`: workers; None: one per core. The result does not
    depend on it. `progress(done, total)` is called after each block of runs, with a crew after each log; None: in a
    notebook a line below the cell, from the second second on until the end, elsewhere nothing. `pieces`: a
    folder or a URL where what was computed is kept, and found by the next run (docs/guide/scale.md). `crew`: an
    executor of processes on this machine or on others, such as ProcessPoolExecutor or `Client.get_executor()` of Dask,
    in place of `jobs`; it needs `pieces` that all of them see, and recordings by their paths.

    Raises InputError, before any run, with all problems at once: of the experiment (ExperimentError), of recordings, of
    both together, times without a closed form, runs that no memory holds.

    >>> result = cr.run("logs/tc016d.yaml")
    >>> result.summary["ttd_median_s"].round(3).tolist()
    [0.0, 0.8, 0.0, 0.5, 1.0, 1.5]
    """
    from copem_replay.pipeline.parts import PartCache
    from copem_replay.pipeline.study_log import LogSurvey

    progress = progress or show_below_cell()
    cache = None if pieces is None else PartCache(str(pieces))
    if crew is None:
        study = make_study(experiment, recordings, LogSurvey(cache))
    elif cache is None:
        raise InputError("crew: expected `pieces`, too: a folder or a URL that all its workers see")
    else:
        workers = load_extra("workers", "executor")(crew, cache, progress)
        study = workers.read_study(lambda: make_study(experiment, recordings, LogSurvey(cache), workers))
    return Results(study=replay_study(study, prepare_study(study)[0], jobs, progress, cache), exporters=list_exporters)


SHOWN_AFTER_S = 2.0
"""Runs that are over sooner show no progress in a notebook."""


def show_below_cell() -> Progress | None:
    """Progress as a line below the cell of the notebook that this process is the kernel of; None: it is of none.

    The line is empty in the end: what a notebook keeps does not depend on how long a run took, but for that line.
    """
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    if getattr(shell, "kernel", None) is None:  # a terminal, or no IPython
        return None
    display = importlib.import_module("IPython.display").display
    begun_s = time.monotonic()
    shown: list[Any] = []

    def show(done: int, total: int) -> None:
        if not shown and (done == total or time.monotonic() - begun_s < SHOWN_AFTER_S):
            return
        words = {"text/plain": "" if done == total else f"replaying: {100 * done // total} %"}
        if shown:
            shown[0].update(words, raw=True)
        else:
            shown.append(display(words, raw=True, display_id=True))

    return show


def replay_study(
    study: LoadedStudy,
    ready: Sequence[Replay],
    jobs: int | None,
    progress: Progress | None,
    parts: PartCache | None = None,
) -> StudyTables:
    """Replay the prepared logs of a study (`ready`). `progress(done, total)` is called after each block of runs."""
    from copem_replay.pipeline.run import run_experiment

    return run_experiment(
        study.experiment, study.logs, jobs=count_workers(jobs), progress=progress, ready=ready, parts=parts
    )


def count_workers(jobs: int | None) -> int:
    """The number of workers: `jobs`, or one per core that this process may use. Raises InputError for less than 1."""
    if jobs is not None:
        if jobs < 1:
            raise InputError(f"jobs: expected at least 1, found {jobs}")
        return jobs
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def fused_tracks(experiment: AnyExperiment, recording: Recording | AnyPath, run: int = 0) -> dict[str, FusedTracks]:
    """The fused lists of each configuration in one run of one recording: the same lists that `run` measures.

    By the name of the configuration. `fused` holds the tracks, values (1, P) in metres, radians and m/s, and
    `to_dataframe()` gives a row per entry.

    Raises InputError as `run` does; ExperimentError where the recording is too long to be held at once.

    >>> fused = cr.fused_tracks("logs/tc016d.yaml", "logs/tc016d.mcap", run=3)["coPEM:1s"]
    >>> fused.to_dataframe()[["available_s", "object_id", "x_m"]].head(1)
       available_s object_id       x_m
    0          1.0         2  0.221615
    """
    from copem_replay.pipeline.one_run import replay_run

    study = make_study(experiment, recording)
    if not 0 <= run < study.experiment.runs:
        raise InputError(f"run: expected 0 … {study.experiment.runs - 1}, found {run}")
    log = study.recordings[0]
    replayed = replay_run(log, resolve_for_log(study.experiment, log.scene.log), run)
    return {name: replace(fused, scene=replayed.replay.scene) for name, fused in replayed.run_tracks.whole().items()}


def observations(experiment: AnyExperiment, recording: Recording | AnyPath) -> pd.DataFrame:
    """How each unit sees each measured object at each capture: what its detection model goes by. Nothing is drawn.

    A row per unit, object and capture: `captured_s`, `since_onset_s`, `range_m` (horizontal, to the centre of the box),
    `azimuth_rad` (from the heading of the unit), `bearing_rad` (from east), `visible_share` and `probability` (0 … 1).

    Raises InputError as `run` does.

    >>> seen = cr.observations("logs/tc016d.yaml", "logs/tc016d.mcap").query("unit == 'ego'")
    >>> seen.loc[seen["since_onset_s"].between(0.55, 0.75), "visible_share"].round(2).tolist()
    [0.18, 0.37]
    """
    from copem_replay.pipeline.prepare import prepare_log

    study = make_study(experiment, recording)
    replay = prepare_log(study.recordings[0], resolve_for_log(study.experiment, study.recordings[0].scene.log))
    observed, episodes = replay.rows_of(replay.episodes.object_ix), replay.episodes.firsts
    tracks, scene = observed.tracks, replay.scene
    onset_s = pd.Series(episodes.onset_s, index=episodes.object_ix).reindex(tracks.row_object_ix).to_numpy()
    return pd.DataFrame(
        {
            "unit": _label_numbers(tracks.units, tracks.row_unit_ix),
            "object_id": _label_numbers(scene.object_ids, tracks.row_object_ix),
            "object_class": _label_numbers(CLASSES, scene.object_class[tracks.row_object_ix]),
            "captured_s": tracks.row_captured_s,
            "since_onset_s": tracks.row_captured_s - onset_s,
            "range_m": observed.view.range_m,
            "azimuth_rad": observed.view.azimuth_rad,
            "bearing_rad": observed.view.bearing_rad,
            "visible_share": observed.view.visible_share,
            "probability": observed.probability,
        }
    )


def _label_numbers(names: Sequence[str], numbers: NDArray[np.integer[Any]]) -> list[str]:
    return [names[k] for k in numbers]

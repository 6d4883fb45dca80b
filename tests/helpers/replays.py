"""Single steps of a replay: what units list, what is sent and received, and what receivers issue, in some runs.

The last steps: the rows that a study gave, and what it gave, saved.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa

from copem_replay.api.run import list_exporters
from copem_replay.core.tracks import Int, TimeChunk
from copem_replay.experiment.schema import Experiment
from copem_replay.io.recording import Recording
from copem_replay.pipeline.expansion import RunGroup
from copem_replay.pipeline.prepare import Replay
from copem_replay.pipeline.receiver import ReceiverOutput, Receivers
from copem_replay.pipeline.run import StudyTables, run_experiment
from copem_replay.pipeline.world import Transmission, WorldChunk
from copem_replay.results.read import Results


def transmitted(replay: Replay, plan: Experiment, runs: Sequence[int] | Int = (0,), **how: bool) -> Transmission:
    """The lists of a log on their way, with all units in these runs."""
    units = replay.expand(plan)
    return Transmission(replay, units, RunGroup.of_all_units(units, np.asarray(runs)), **how)  # type: ignore[arg-type]


def world_of(replay: Replay, plan: Experiment, runs: Sequence[int] | Int = (0,)) -> WorldChunk:
    """A whole log as its units have it in these runs."""
    return transmitted(replay, plan, runs).world(TimeChunk(), -np.inf)


def outputs_of(replay: Replay, plan: Experiment, runs: Sequence[int] | Int = (0,)) -> dict[str, ReceiverOutput]:
    """By configuration what its receiver issues in the whole log."""
    lists = transmitted(replay, plan, runs)
    receivers, world = Receivers(lists), lists.world(TimeChunk(), -np.inf)
    return {name: receivers.fuse(world, name) for name in plan.configurations}


def study_rows(study: StudyTables) -> pd.DataFrame:
    """The rows of `detections.parquet`."""
    return study.frame(study.parts())


def study_accuracy(study: StudyTables) -> dict[str, pa.Table]:
    """The tables of accuracy by the names of their files; empty: it is not measured."""
    return {} if study.bands is None else study.accuracy_of(study.parts(), study_rows(study))


def save_run(
    folder: Path, plan: Experiment, recordings: Sequence[Recording], *, replays: bool = True, overwrite: bool = False
) -> Path:
    """The results folder of an experiment that is run; `replays`: with the files of the runs that are shown."""
    exporters = list_exporters if replays else lambda _: ()
    study = run_experiment(plan, recordings)
    return Results(study=study, exporters=exporters).save(folder, overwrite=overwrite)

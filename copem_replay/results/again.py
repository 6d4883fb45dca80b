"""One run of a results folder, computed again: a folder holds no lists, but what determines them."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import pandas as pd

from copem_replay.core.errors import InputError
from copem_replay.core.tracks import SAME_INSTANT_S
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.pipeline.one_run import ReplayedRun, replay_run
from copem_replay.pipeline.replay import replay_block
from copem_replay.results.read import Results


def replay_again(
    results: Results, log: str, run: int, configurations: Collection[str]
) -> tuple[ReplayedRun, pd.DataFrame]:
    """One run of these configurations and its rows of `detections.parquet`. Raises InputError if they differ."""
    alone = resolve_for_log(results.experiment, log)
    chosen = {name: configuration for name, configuration in alone.configurations.items() if name in configurations}
    experiment = alone.model_copy(update={"configurations": chosen, "sweep": None})
    replayed = replay_run(results.recording(log, experiment), experiment, run)
    (detections,) = results.each(log=log, every=True)
    rows = detections[(detections["run"] == run) & detections["configuration"].isin(list(chosen))].assign(log=log)
    again = replay_block(replayed.replay, replayed.experiment, np.array([run]))
    keys = ["configuration", "object_id", "episode"]
    times = [table.set_index(keys)["detection_s"].sort_index() for table in (rows, again)]
    same = times[0].index.equals(times[1].index) and np.allclose(
        times[0], times[1], rtol=0, atol=SAME_INSTANT_S, equal_nan=True
    )
    if not same:
        raise InputError(
            f"{results.place}: log {log}: run {run} comes out otherwise than in detections.parquet: another version, "
            "or another kind of processor, made it; run the experiment again with --overwrite"
        )
    return replayed, rows

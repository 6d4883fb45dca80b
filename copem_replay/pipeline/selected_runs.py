"""Which runs of which logs are written to MCAP and .rrd, under which names, and their fused tracks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from copem_replay.experiment.schema import Experiment
from copem_replay.io.recording import Recording
from copem_replay.pipeline.expansion import of_run
from copem_replay.pipeline.one_run import RunTracks
from copem_replay.pipeline.prepare import Replay, prepare

if TYPE_CHECKING:
    from copem_replay.pipeline.run import Result

STEM = "replay"
"""What the files are called; those of the second run on `replay_<as which it was asked for>`."""
_EQUAL_S = 1e-6
"""Times that differ by less are equal: instants are told apart to a microsecond."""


@dataclass(frozen=True)
class ShownRun:
    """One run that is shown: its number, why it is this one (empty: it was asked for by number), its files' stem."""

    run: int
    why: str
    stem: str


def shown_runs(experiment: Experiment, result: Result, log: str) -> tuple[ShownRun, ...]:
    """The runs of a log that are written to MCAP and .rrd, in the order of the experiment; none with `run: null`.

    `median` (of an even number the lower), `worst` and `best` go by the time to detection summed over all
    configurations and measured objects, never detected counting as the horizon; of equal runs it is the first. A log
    without rows has nothing to go by: its first run.
    """
    asked = experiment.show.asked() if experiment.show is not None else ()
    stems = [STEM if k == 0 else f"{STEM}_{one}" for k, one in enumerate(asked)]
    part = result.tables.rows(log)
    return tuple(
        ShownRun(one, "", stem) if isinstance(one, int) else ShownRun(*_ranked(part, result.horizon_s, one), stem)
        for one, stem in zip(asked, stems, strict=True)
    )


def _ranked(part: pd.DataFrame, horizon_s: float | None, which: str) -> tuple[int, str]:
    """The run that is `median`, `worst` or `best` among the rows of a log, and by what."""
    if not len(part):
        return 0, f"first, not {which}, as no measured object has an onset"
    time_s = part["time_to_detection_s"].fillna(horizon_s)
    total = np.rint(time_s.groupby(part["run"]).sum() / _EQUAL_S)
    ranked = np.sort(total.to_numpy())
    place = {"best": 0, "median": (len(ranked) - 1) // 2, "worst": -1}[which]
    equal = total.index[total == ranked[place]]
    over = (_counted(part[name].nunique(), what) for name, what in _SUMMED.items())
    why = f"{which} of {len(ranked)} by time to detection summed over {' and '.join(over)}"
    return int(equal[0]), why + (f", the first of {len(equal)} equal" if len(equal) > 1 else "")


_SUMMED = {"configuration": "configuration", "object_id": "object"}


def _counted(number: int, what: str) -> str:
    return f"{number} {what}{'s' if number != 1 else ''}"


def shown_logs(experiment: Experiment, result: Result) -> list[str]:
    """Names of the logs that are written to MCAP and .rrd."""
    names = [log.name for log in result.logs] or [replay.scene.log for replay in result.replays]
    if experiment.show is None or not experiment.show.asked():
        return []
    wanted = experiment.show.logs
    if "all" in wanted:
        return names
    return [name for k, name in enumerate(names) if name in wanted or (k == 0 and "first" in wanted)]


@dataclass(frozen=True)
class OneRun:
    """The fused tracks of one run of one log, and the replay and experiment with the units there were in it."""

    replay: Replay
    experiment: Experiment
    run_tracks: RunTracks


def one_run(recording: Recording, experiment: Experiment, run: int, replay: Replay | None = None) -> OneRun:
    """One run once more: the same draws give the same lists. `replay`: of this recording, where it is prepared."""
    alone = of_run(experiment, recording.scene, run)
    if replay is None or alone is not experiment:
        replay = prepare(recording, alone, onsets_of=experiment)
    return OneRun(replay, alone, RunTracks(replay, alone, run))

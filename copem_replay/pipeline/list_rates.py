"""How often the receiver of each configuration issues a fused list."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from copem_replay.communication.arrivals import fusion_schedule
from copem_replay.core.tracks import SAME_INSTANT_NS, Int
from copem_replay.experiment.schema import Experiment
from copem_replay.pipeline.prepare import Replay
from copem_replay.pipeline.receiver import WorldChunk, listen, seen_by_all

_TOLERANCE_S = SAME_INSTANT_NS * 1e-9


def list_rates(replay: Replay, experiment: Experiment) -> dict[str, tuple[int, float]]:
    """For each configuration how many intervals there are between fused lists issued while the log lasts, and the
    seconds they cover.

    Units that only some runs have are taken to be there. Where arrivals differ it is all runs together.
    """
    world = replay.lists_only(experiment)
    of_run = []
    for run in range(experiment.runs if world.experiment.arrivals_differ else 1):
        alone = np.array([run])
        of_run.append(_rates(replace(world, on_air=replay.on_air(experiment, alone)), alone))
    return {name: (sum(r[name][0] for r in of_run), sum(r[name][1] for r in of_run)) for name in of_run[0]}


def _rates(world: WorldChunk, run: Int) -> dict[str, tuple[int, float]]:
    """Of one run (1,)."""
    rates, seen = {}, seen_by_all(world, run, states="true")
    for name, configuration in world.experiment.configurations.items():
        heard = listen(seen, world, name)
        issue_s = fusion_schedule(heard, max_age_s=configuration.max_age_s).issue_s
        issue_s = issue_s[(issue_s >= -_TOLERANCE_S) & (issue_s <= world.scene.end_s + _TOLERANCE_S)]
        rates[name] = (len(issue_s) - 1, float(issue_s[-1] - issue_s[0])) if len(issue_s) > 1 else (0, 0.0)
    return rates

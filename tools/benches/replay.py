"""Visible shares, and the replay of the sample scenario."""

from __future__ import annotations

import os
from collections.abc import Iterator

import numpy as np

from benches import common
from copem_replay.perception.visibility import NO_STATICS, Flat, Observers, Surface, visible_shares
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.replay import replay_block
from copem_replay.pipeline.run import run_experiment


def visibility() -> Iterator[common.Line]:
    """Views per second at 1200 lists × 60 boxes × 21 units."""
    frames, count, units = 1200, 60, 21
    world, rng = common.boxes(frames, count), np.random.default_rng(1)
    place = np.empty((units, frames, 3))
    place[..., :2] = rng.uniform(-60, 60, (units, 1, 2))
    place[..., 2] = rng.choice([1.8, 5.0], (units, 1))
    observers = Observers(place, np.ones((units, frames), dtype=bool), np.full(units, -1))
    for model in (Flat(), Surface()):
        seconds = common.best(lambda model=model: visible_shares(world, NO_STATICS, observers, model), 3)
        yield {f"visibility_{model.kind}_views_per_s": round(units * frames * count / seconds)}


def paper() -> Iterator[common.Line]:
    """The six configurations × 500 runs of the sample scenario.

    Detections alone, against NumPy drawing as many uniforms × 3; and with measures, verdicts and summary, against the
    time that goes by in the scenario (after reading and compilation, workers as many as cores); most of the work is
    accuracy (RMSE, GOSPA, …).
    """
    experiment, recordings = common.loaded("tc016d")
    listed = experiment.model_copy(update={"braking": None})
    ready, runs = prepare_log(recordings[0], listed), np.arange(experiment.runs)
    rng = np.random.default_rng(1)
    cells = len(ready.measured.tracks.frame_ix) * experiment.runs
    ours = common.best(lambda: replay_block(ready, listed, runs))
    theirs = common.best(lambda: rng.random(3 * cells))
    count = experiment.runs * len(experiment.configurations)
    yield {"paper_draw_ratio": round(ours / theirs, 2), "seconds": round(ours, 4), "runs_per_s": round(count / ours)}
    variants = {
        "": {"exact": False},
        "_with_exact": {"exact": True},
        "_without_accuracy": {"exact": False, "accuracy": False},
    }
    took_s: dict[str, float] = {}
    for name, keys in variants.items():
        whole = experiment.model_copy(update={"measure": experiment.measure.model_copy(update=keys)})
        seconds = common.best(lambda whole=whole: run_experiment(whole, recordings, jobs=os.cpu_count() or 1))
        took_s[name] = seconds
        factor = round(count * recordings[0].scene.end_s / seconds)
        yield {f"paper{name}_realtime_factor": factor, "seconds": round(seconds, 3)}
    yield {"paper_accuracy_cost": round(took_s[""] / took_s["_without_accuracy"], 1)}

"""What is odd about a log and an experiment together: seen before any run, said by `check` and `run` alike."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from copem_replay.core.text import counted
from copem_replay.core.tracks import CLASSES, TRUTH, Bool
from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.config import At
from copem_replay.metrics.episodes import measured_objects
from copem_replay.perception.config import Carriers
from copem_replay.perception.observation import could_meet
from copem_replay.pipeline.log_replay import Replay

FAR_M = 2000.0
"""A place farther away from all objects is taken for a mistake (chosen: no sensor beside a road sees so far)."""


def oddities(replay: Replay, experiment: Experiment, met: Bool | None = None) -> Iterator[str]:
    """One line each.

    `met (U,)`: whether an object ever meets a condition of each modelled unit's PEM; None: as far as that can be told
    by range, azimuth and class.
    """
    if met is None:
        log, fleet = replay.scene, replay.fleet
        met = could_meet(log, replay.truth, fleet.experiment, replay.placed, replay.stretches)
    yield from replay.placed.notes
    yield from _far_away(replay, experiment)
    yield from _idle(replay, experiment, met)
    yield from _unmeasured(replay, experiment)
    for name, unit in experiment.units.items():
        if isinstance(unit.on, Carriers) and name not in replay.fleet.named:
            yield f"unit {name}: the log has nobody to carry it ({', '.join(unit.on.classes)})"
    end_s = replay.scene.end_s
    for name, configuration in experiment.configurations.items():
        units = experiment.units_of(configuration) or (TRUTH,)
        late = [unit for unit in units if configuration.latency_of(unit) > end_s]
        if late:
            yield f"configuration {name}: the latency of {', '.join(late)} is longer than the log"


def _far_away(replay: Replay, experiment: Experiment) -> Iterator[str]:
    """Units that stand where no object ever is."""
    x_m, y_m = replay.truth.x_m[0], replay.truth.y_m[0]
    if not len(x_m):
        return
    low, high = (np.array([edge(x_m), edge(y_m)]) for edge in (np.min, np.max))
    for name, unit in experiment.units.items():
        if unit.at is None:
            continue
        place = np.array(unit.at)
        away_m = float(np.hypot(*(place - np.clip(place, low, high))))
        if away_m > FAR_M:
            yield (
                f"unit {name}: its place [{place[0]:g}, {place[1]:g}] is {away_m / 1000:.3g} km away from all objects, "
                f"which are within x {low[0]:.0f} … {high[0]:.0f} m, y {low[1]:.0f} … {high[1]:.0f} m"
            )


def _idle(replay: Replay, experiment: Experiment, met: Bool) -> Iterator[str]:
    """Units that list nothing in any run: those of one fleet in one line."""
    fleet = replay.fleet
    modelled = dict(zip(fleet.experiment.modelled, met.tolist(), strict=True))
    of_name = list(zip(fleet.named, fleet.experiment.units, strict=True))
    for name, unit in experiment.modelled.items():
        members = [member for named, member in of_name if named == name]
        absent = [m for m in members if not replay.placed.poses[m].present.any()]
        unmet = [m for m in members if m not in absent and not modelled[m]]
        for which, what in (
            (absent, "makes no list, its carrier is never there"),
            (unmet, f"no object ever meets a condition of its PEM {unit.pem!r}"),
        ):
            if which:
                yield f"unit {name}{_on(which, members)}: {what}"


def _on(which: list[str], members: list[str]) -> str:
    """Of a fleet on how many carriers."""
    if len(members) == 1 and ":" not in members[0]:
        return ""
    return f", on {len(which)} of its {counted(len(members), 'carrier')}"


def _unmeasured(replay: Replay, experiment: Experiment) -> Iterator[str]:
    """Why there are no rows, or no verdicts."""
    scene, measure, looks = replay.scene, experiment.measure, replay.looks
    if not len(measured_objects(scene, measure)):
        others = np.arange(len(scene.object_class)) != scene.ego_ix
        there = sorted({CLASSES[k] for k in scene.object_class[others]}) or ["nobody"]
        wanted = measure.objects.classes or measure.objects.ids or ("moving objects but the ego",)
        beside = " beside the ego" if scene.ego_ix >= 0 else ""
        yield f"no rows: nothing to measure ({', '.join(wanted)}); the log has {', '.join(there)}{beside}"
    elif isinstance(measure.onset, At) and measure.onset.time_s > scene.end_s:
        yield f"no rows: the onset at {measure.onset.time_s:g} s lies after the log's end, {scene.end_s:g} s"
    elif not len(looks.object_ix):
        yield f"no rows: no measured object has an onset ({measure.onset.kind})"
    if experiment.braking is not None and len(looks.object_ix) and not replay.encounters:
        recorded = experiment.braking.ego == "recorded"
        yield (
            f"no verdict: the ego, not braking ({'as recorded' if recorded else 'at constant speed'}), stays more than "
            f"{experiment.braking.margin_m:g} m from all that is measured"
            + ("; `ego: constant_speed` asks what if nobody had braked" if recorded else "")
        )

"""Notes on what is odd about a log and an experiment together: before any run, from `check` and `run` alike."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.interpolation import wrap
from copem_replay.core.text import counted
from copem_replay.core.tracks import CLASSES, TRUTH, Bool, Scene, Tracks, class_indices
from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.experiment.drive import of_log, settings_notes
from copem_replay.experiment.schema import Experiment
from copem_replay.fusion.base import Ideal
from copem_replay.io.recording import Recording
from copem_replay.metrics.episodes import measured_objects
from copem_replay.metrics.within import in_words
from copem_replay.perception.config import Carriers
from copem_replay.perception.observation import worlds
from copem_replay.perception.pem.ghosts import Beside
from copem_replay.perception.pem.model import Pem
from copem_replay.perception.sensor_poses import UnitPoses
from copem_replay.pipeline.output_times import notes_on_outputs
from copem_replay.pipeline.sweep import without_points

if TYPE_CHECKING:
    from copem_replay.pipeline.prepare import Replay

FAR_M = 2000.0
"""A place farther away from all objects is taken for a mistake (chosen: no sensor beside a road sees so far)."""

_NAMED = 3  # of the logs of which the same is said, so many are named (chosen)
_ROWS = 500_000  # object states looked at in one piece (chosen: some ten MB)
_SAMPLE = 16  # one in so many is looked at first (chosen)


def notes_of(
    recordings: Sequence[Recording], ready: Sequence[Replay], experiment: Experiment, *, replayed: bool
) -> list[str]:
    """Notes on the recordings, and on them and the experiment together: after a replay, or before."""
    odd = {
        replay.scene.log: oddities(replay, of_log(experiment, replay.scene.log), replay.ever_met if replayed else None)
        for replay in ready
    }
    return study_notes(recordings, odd, experiment)


def study_notes(
    recordings: Sequence[Recording], oddities_of: Mapping[str, Iterable[str]], experiment: Experiment
) -> list[str]:
    """The same, with what is odd about each log."""
    notes = _by_log((recording.scene.log, note) for recording in recordings for note in recording.notes)
    notes += _by_log((log, note) for log, odd in oddities_of.items() for note in odd)
    notes += settings_notes(experiment)
    notes += without_points(experiment)
    notes += _remembered_in_vain(experiment)
    notes += notes_on_outputs(experiment)
    return notes


def _by_log(said: Iterable[tuple[str, str]]) -> list[str]:
    """A line for each log and what is said of it; one line for what is said of more than three."""
    pairs = list(dict.fromkeys(said))
    whose: dict[str, list[str]] = {}
    for log, note in pairs:
        whose.setdefault(note, []).append(log)
    lines = []
    for log, note in pairs:
        first, more = whose[note][:_NAMED], len(whose[note]) - _NAMED
        if more <= 0:
            lines.append(f"{log}: {note}")
        elif log == first[0]:
            lines.append(f"{', '.join(first)} and {counted(more, 'other log')}: {note}")
    return lines


def _remembered_in_vain(experiment: Experiment) -> Iterator[str]:
    """Quantities that a PEM remembers and that nothing of it draws."""
    for name, pem in experiment.pems.items():
        for quantity in pem.in_vain():
            what = f"a {quantity} error" if quantity in ("position", "yaw", "speed", "size") else f"{quantity} drawn"
            yield f"pems.{name}.memory.{quantity}: no couple has {what}, nothing to remember"


def same_instants(ready: Sequence[Replay]) -> bool:
    """Whether all runs have the same units, and lists at the same instants."""
    return all(replay.expanded.same_in_all_runs and not replay.expanded.arrivals_differ for replay in ready)


def oddities(replay: Replay, experiment: Experiment, met: Bool | None = None) -> Iterator[str]:
    """One line each.

    `met (U,)`: whether an object ever meets a condition of each modelled unit's PEM; None: as far as that can be told
    by range, azimuth and class.
    """
    if met is None:
        met = could_meet(replay)
    yield from replay.placed.notes
    yield from _far_away(replay, experiment)
    yield from _idle(replay, experiment, met)
    yield from _unmeasured(replay, experiment)
    for name, unit in experiment.units.items():
        if isinstance(unit.on, Carriers) and name not in replay.expanded.named:
            yield f"unit {name}: the log has no object to carry it ({', '.join(unit.on.classes)})"
    yield from _clocks(experiment)
    yield from _beside_no_object(replay, experiment)
    end_s = replay.scene.end_s
    for name, configuration in experiment.configurations.items():
        units = experiment.units_of(configuration) or (TRUTH,)
        late = [unit for unit in units if (experiment.delay_of(name, unit) or 0.0) > end_s]
        if late:
            yield f"configuration {name}: the latency of {', '.join(late)} is longer than the log"


def _clocks(experiment: Experiment) -> Iterator[str]:
    """Which configurations know the true captures although a unit's clock is off."""
    for name, configuration in experiment.configurations.items():
        off = [unit for unit in experiment.units_of(configuration) if experiment.units[unit].clock is not None]
        if off and isinstance(configuration.fusion, Ideal):
            yield f"configuration {name}: ideal fusion uses true captures, ignoring clock errors of {', '.join(off)}"


def _beside_no_object(replay: Replay, experiment: Experiment) -> Iterator[str]:
    """Ghosts beside objects that the log does not have."""
    there = set(replay.scene.object_class.tolist())
    for name, pem in experiment.pems.items():
        for n, sort in enumerate(pem.ghosts):
            if isinstance(sort.where, Beside) and not there & set(class_indices(sort.where.classes).tolist()):
                yield f"pems.{name}.ghosts[{n}].where: beside: no {' or '.join(sort.where.classes)} in this log"


def could_meet(replay: Replay) -> Bool:
    """(U,) whether an object ever has range, azimuth and class of a condition of each modelled unit's PEM.

    Without a look at what hides what: where nothing is met here, no replay meets anything. Piece by piece of the log.
    """
    experiment, scene = replay.expanded, replay.scene
    met = dict.fromkeys(experiment.modelled, False)
    _, bounds = replay.truth.by_frame
    pieces = -(-len(replay.truth.frame_ix) // _ROWS)
    inner = np.searchsorted(bounds, np.arange(1, pieces) * _ROWS)
    cuts = [-np.inf, *replay.truth.captured_s[np.unique(inner[inner < len(bounds) - 1])].tolist(), np.inf]
    for from_s, until_s in pairwise(cuts):
        if all(met.values()):
            break
        for names, world in worlds(scene, replay.truth, experiment, replay.placed, from_s, until_s):
            for name in names:
                if not met[name]:
                    pem = experiment.pems[str(experiment.units[name].pem)]
                    met[name] = _meets(pem, scene, world, replay.placed.poses[name], replay.placed.carrier_ix[name])
    return np.array(list(met.values()), dtype=bool)


def _meets(pem: Pem, scene: Scene, world: Tracks, at: UnitPoses, carrier_ix: int) -> bool:
    """Whether any object of a world is where a condition holds, at a list that the unit makes."""
    there = np.flatnonzero(at.present)
    order, bounds = world.by_frame
    if not len(there):
        return False
    rows = order[bounds[there[0]] : bounds[there[-1] + 1]]
    anyhow = [couple.when.model_copy(update={"visible_share": None}) for couple in pem.couples]
    for some in (rows[::_SAMPLE], rows):  # of what is met at all, much is
        frame = world.frame_ix[some]
        kept = at.present[frame] & (world.row_object_ix[some] != carrier_ix)
        some, frame = some[kept], frame[kept]
        dx_m, dy_m = world.x_m[0, some] - at.x_m[frame], world.y_m[0, some] - at.y_m[frame]
        bearing_rad, none = np.arctan2(dy_m, dx_m), np.zeros(len(some))
        view = ViewGeometry(
            np.hypot(dx_m, dy_m), wrap(bearing_rad - at.heading_rad[frame]), bearing_rad, none,
            scene.object_class[world.row_object_ix[some]], none, none, none, none, none,
        )  # fmt: skip
        if any(bool(condition.holds(view).any()) for condition in anyhow):
            return True
    return False


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
    expanded = replay.expanded
    modelled = dict(zip(expanded.modelled, met.tolist(), strict=True))
    of_name = list(zip(expanded.named, expanded.units, strict=True))
    for name, unit in experiment.modelled.items():
        members = [member for named, member in of_name if named == name]
        absent = [m for m in members if not replay.placed.poses[m].present.any()]
        unmet = [m for m in members if m not in absent and not modelled[m]]
        for which, what in (
            (absent, "makes no list, its carrier is never in the log"),
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
    scene, measure, episodes = replay.scene, experiment.measure, replay.episodes
    asked, outside = measure.objects.within, len(replay.outside_ix)
    if asked is not None and outside:
        of = counted(outside + len(episodes.object_ix), "object")
        yield f"objects.within: {outside} of {of} with an onset left out, {in_words(asked)}"
    if not len(measured_objects(scene, measure)):
        others = np.arange(len(scene.object_class)) != scene.ego_ix
        there = sorted({CLASSES[k] for k in scene.object_class[others]}) or ["no other object"]
        wanted = measure.objects.classes or measure.objects.ids or ("moving objects but the ego",)
        beside = " beside the ego" if scene.ego_ix >= 0 else ""
        yield f"no rows: nothing to measure ({', '.join(wanted)}); the log has {', '.join(there)}{beside}"
    elif (instant_s := measure.onset.instant_s) is not None and instant_s > scene.end_s:
        yield f"no rows: the onset at {instant_s:g} s lies after the log's end, {scene.end_s:g} s"
    elif not len(episodes.object_ix) and outside:
        yield "no rows: no object with an onset matters by `objects.within`"
    elif not len(episodes.object_ix):
        yield f"no rows: no measured object has an onset ({measure.onset.kind})"
    if experiment.braking is not None and len(episodes.object_ix) and not replay.encounters:
        recorded = experiment.braking.ego == "recorded"
        yield (
            f"no verdict: without braking ({'as recorded' if recorded else 'at constant speed'}) the ego stays "
            f"more than {experiment.braking.margin_m:g} m from all measured objects"
            + ("; `ego: constant_speed` assumes that it had not braked" if recorded else "")
        )

"""Objects shown, in viewers, stories, films and figures of single runs: those that tell configurations apart, and when.

An object is worth a look if configurations know it at different times while it is near the ego's path. What a
configuration is late everywhere tells nothing of one object: it is taken off first. An object that is in the log for
less than `OBSERVED_S` before or after its onset tells nothing either: how soon it could have been known is decided by
where the log is cut. It is listed as too short to judge.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import pandas as pd

from copem_replay.core.interpolation import interpolate_states
from copem_replay.core.tracks import SAME_INSTANT_S, TRUTH, Float, Int, Scene, Tracks
from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.onset import select_counted
from copem_replay.perception.sensor_poses import find_carrier

SHOWN_OBJECTS = 6
"""Most measured objects with words, lines, lanes and plots: more would cover each other and slow the viewer down."""
OBSERVED_S = 2.0
"""Least time from the log's start to the onset, and from the onset to the end of the episode."""
PATH_S, NEAR_M = 3.0, 10.0
"""How much of the ego's path is ahead of it, and the distance from it at which an object counts half."""
BEFORE_S, AFTER_S, LEAST_S = 0.5, 0.5, 2.0
"""Margins before the onset and after the last detection, and the shortest axis: longer ones make changes narrow."""
UNKNOWN_S = 10.0
"""Length after the onset, if no configuration detects the object; it ends earlier with the episode."""
_STEP_S = 0.25


@dataclass(frozen=True)
class ShownObjects:
    """Indices of the objects shown, the most telling one first, and ids of those that count, too short to judge.

    Where all that count are too short to judge, some of them are shown all the same.
    """

    object_ix: tuple[int, ...] = ()
    too_short: tuple[str, ...] = ()


def choose_shown_objects(scene: Scene, truth: Tracks, experiment: Experiment, table: pd.DataFrame) -> ShownObjects:
    """The objects with the largest product of difference in time and nearness to the ego's path, six at most.

    The difference is that of `measure_apart`; objects with equal products are in the order of nearness. Objects that
    do not count (`measure.began`) are left out, unless none does. `table`: rows of one run of one log, a row per object
    and configuration.
    """
    if not len(table):
        return ShownObjects()
    counted = select_counted(table, experiment.measure.began)
    episodes = measure_apart(experiment, counted if len(counted) else table)
    episodes["near"] = 1 / (1 + (_distance_to_path(scene, truth, experiment, episodes) / NEAR_M) ** 2)
    for name in ("apart_s", "apart_raw_s"):
        episodes[name] = (episodes[name] * episodes["near"]).round(6)  # rounding of times decides nothing
    judged = episodes[episodes["observed"]] if episodes["observed"].any() else episodes
    ranked = judged.sort_values(["apart_s", "apart_raw_s", "near"], ascending=False, kind="stable").index
    chosen = tuple(scene.object_number[name] for name in ranked[:SHOWN_OBJECTS])
    return ShownObjects(chosen, tuple(episodes.index[~episodes["observed"]].tolist()))


def is_observed(episodes: pd.DataFrame) -> pd.Series:
    """Whether episodes, given by `onset_s` and `ended_s`, are long enough to judge."""
    return np.minimum(episodes["onset_s"], episodes["ended_s"] - episodes["onset_s"]) >= OBSERVED_S - SAME_INSTANT_S


def measure_apart(experiment: Experiment, table: pd.DataFrame) -> pd.DataFrame:
    """By id of the objects of one run of one log: `apart_s`, how much later one configuration knows it than another,
    at most, without what it usually is later than that: by medians over the objects that are `observed` long enough.

    `apart_raw_s`: with it. One that never knows an object counts as knowing it at the end of the episode. Beside them
    `onset_s`, `ended_s`, and `last_s`, when the last one knows it.
    """
    rows = select_differing_rows(experiment, table)
    rows = rows.assign(after_s=rows["time_to_detection_s"].fillna(rows["ended_s"] - rows["onset_s"]))
    by_object = rows.groupby("object_id", sort=False)
    episodes = by_object[["onset_s", "ended_s"]].first()
    episodes["observed"] = observed = is_observed(episodes)
    after_s = rows.groupby(["object_id", "configuration"])["after_s"].first().unstack().loc[episodes.index]
    usual_s = after_s[observed | ~observed.any()].quantile(0.5, interpolation="lower")
    later_s = [after_s.sub(after_s[name], axis=0) - (usual_s - usual_s[name]).clip(lower=0.0) for name in after_s]
    episodes["apart_s"] = np.max([of.max(axis=1) for of in later_s], axis=0)
    episodes["apart_raw_s"] = after_s.max(axis=1) - after_s.min(axis=1)
    never_s = np.minimum(episodes["ended_s"], episodes["onset_s"] + UNKNOWN_S)
    return episodes.assign(last_s=by_object["detection_s"].max().fillna(never_s))


def select_differing_rows(experiment: Experiment, table: pd.DataFrame) -> pd.DataFrame:
    """The rows of configurations with units, of all if there is only one such: it differs from the truth alone."""
    truths = [name for name, asked in experiment.configurations.items() if asked.units == TRUTH]
    others = table[~table["configuration"].isin(truths)]
    return others if others["configuration"].nunique() > 1 else table


def find_opening_s(experiment: Experiment, by_object: Sequence[pd.DataFrame]) -> float | None:
    """The instant (s) at which a recording opens: some configurations know an object and others do not yet.

    It is early in the longest such time of the first object that has one, within its axis. Where all objects are known
    to all configurations at once, it is just before the first onset; None without an object. `by_object`: rows of each
    object, the most telling one first.
    """
    for rows in by_object:
        rows = select_differing_rows(experiment, rows)
        never_s = np.minimum(rows["ended_s"], rows["onset_s"] + UNKNOWN_S)
        times_s = np.sort(rows["detection_s"].fillna(never_s).to_numpy(dtype=float))
        waits_s = np.diff(times_s)
        if waits_s.max(initial=0.0) > SAME_INSTANT_S:
            k = int(waits_s.argmax())
            return float(times_s[k] + min(waits_s[k] / 2, AFTER_S))
    onsets_s = [float(rows["onset_s"].iloc[0]) for rows in by_object]
    return max(min(onsets_s) - BEFORE_S, 0.0) if onsets_s else None


def pick_evenly(
    ranked: Sequence[str], most: int, fixed: Sequence[str] = (), colours: Mapping[str, object] = MappingProxyType({})
) -> tuple[str, ...]:
    """`most` of the ranked names: `fixed`, and others evenly spaced with the first and the last.

    Instead of one with a colour that is taken, the nearest one with another, if there is any.
    """
    taken, last = {name: colours.get(name, name) for name in fixed}, len(ranked) - 1
    places = np.rint(np.linspace(0, last, min(most - len(taken), last + 1)))
    for place in sorted(places.tolist(), key=lambda place: min(place, last - place)):
        left = [(colours.get(name, name), abs(k - place), name) for k, name in enumerate(ranked) if name not in taken]
        colour, _, name = min(left, key=lambda option: (option[0] in taken.values(), option[1]))
        taken[name] = colour
    return (*fixed, *(name for name in ranked if name in taken))


def _distance_to_path(scene: Scene, truth: Tracks, experiment: Experiment, episodes: pd.DataFrame) -> Float:
    """(M,) least distance (m) of each object to the ego's path of the next `PATH_S`, from onset to last detection. 0
    without an ego; inf where the ego is not there.
    """
    ego_ix = find_followed(scene, experiment)
    if ego_ix < 0:
        return np.zeros(len(episodes))
    first_s, last_s = (episodes[name].to_numpy(dtype=float) for name in ("onset_s", "last_s"))
    steps = np.maximum(np.ceil((last_s - first_s) / _STEP_S), 0).astype(np.int64) + 1
    episode_ix = np.repeat(np.arange(len(steps)), steps)
    step_ix = np.arange(len(episode_ix)) - np.repeat(np.cumsum(steps) - steps, steps)
    time_s = np.minimum(first_s[episode_ix] + _STEP_S * step_ix, np.maximum(last_s, first_s)[episode_ix])
    numbers = episodes.index.map(scene.object_number).to_numpy(dtype=np.int64)
    place = interpolate_places(scene, truth, experiment, numbers[episode_ix], time_s)
    least_m = np.full(len(steps), np.inf)
    for ahead_s in np.arange(0.0, PATH_S + _STEP_S / 2, _STEP_S):
        ego_place = interpolate_places(scene, truth, experiment, np.full(len(episode_ix), ego_ix), time_s + ahead_s)
        distance = np.hypot(*(place - ego_place)[:2])
        np.minimum.at(least_m, episode_ix, np.where(np.isnan(distance), np.inf, distance))
    return least_m


def find_followed(scene: Scene, experiment: Experiment) -> int:
    """Index of the ego, without one of what carries the unit of `distance_to`; −1: there is neither."""
    unit = experiment.units.get(experiment.measure.distance_to)
    return scene.ego_ix if scene.ego_ix >= 0 or unit is None else find_carrier(scene, unit)


def interpolate_places(scene: Scene, truth: Tracks, experiment: Experiment, objects: Int, time_s: Float) -> Float:
    """(4, K) x, y, z and heading of objects (K,) at times (K,), in s; NaN while absent."""
    states, _ = interpolate_states(truth, objects, time_s, t0_ns=scene.t0_ns, max_gap_s=experiment.max_gap_s)
    return np.stack([states["x_m"], states["y_m"], states["z_m"], states["yaw_rad"]])


# Time axes of an object's lanes and curves.


def axis_s(episodes: pd.DataFrame, end_s: float) -> tuple[float, float]:
    """First and last second of an object's axis: 0.5 s before the onset to 0.5 s after the last detection.

    `episodes`: rows of one object and run, of all configurations.
    """
    onset_s = float(episodes["onset_s"].iloc[0])
    detected_s = episodes["detection_s"][episodes["detected"]]
    last_s = float(detected_s.max()) if len(detected_s) else min(float(episodes["ended_s"].max()), onset_s + UNKNOWN_S)
    first_s = max(min(onset_s, float(detected_s.min()) if len(detected_s) else onset_s) - BEFORE_S, 0.0)
    return first_s, min(max(last_s + AFTER_S, first_s + LEAST_S), max(end_s, first_s + AFTER_S))

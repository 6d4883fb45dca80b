"""The table of detections: one row per configuration × run × measured object, those never detected included.

time_to_detection_s: from the onset to the instant the list that confirmed the object was available; null when never.
distance_at_onset_m, distance_at_detection_m: true horizontal distance between the centres of object and ego then.
gap_at_detection_m: true horizontal distance between the boxes of object and ego at that instant.
A way of a detection (`Way`): when its list was captured, sent and received.
Source: Piazzoni et al. 2022 (distance at detection); docs/guide/metrics.md.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.interpolation import interpolate_states
from copem_replay.core.random import CounterRng, RandomKey, object_words
from copem_replay.core.tracks import CLASSES, SAME_INSTANT_S, Float, Int, Scene, Tracks
from copem_replay.metrics.areas import name_areas
from copem_replay.metrics.braking.driver import reaction_delays
from copem_replay.metrics.braking.encounter import Encounter
from copem_replay.metrics.braking.verdict import Verdicts, judge_braking
from copem_replay.metrics.config import MetricsSetup
from copem_replay.metrics.detection.by_truth_id import FirstDetections
from copem_replay.metrics.episodes import Episodes, Reference, locate_reference
from copem_replay.metrics.onset import began_texts
from copem_replay.metrics.survival import end_reason_texts
from copem_replay.perception.sight import SightTimes
from copem_replay.perception.visibility import rectangle_corners

if TYPE_CHECKING:
    import pandas as pd


def concatenate_columns(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Columns by name, the parts one beneath the other. All parts have the columns of the first."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def build_frame(columns: Mapping[str, Any]) -> pd.DataFrame:
    """Columns as a table; `braking_pass` is null where the episode is not in conflict."""
    import pandas as pd

    rows = dict(columns)
    if "braking_pass" in rows:
        rows["braking_pass"] = pd.arrays.BooleanArray(rows["braking_pass"], ~rows["conflict"])
    return pd.DataFrame(rows)


def first_episodes(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows of each object's first episode, as the plots of a single run draw them."""
    first = rows.groupby("object_id", sort=False)["episode"].transform("min") == rows["episode"]
    return rows if first.all() else rows[first]


@dataclass(frozen=True)
class Way:
    """The times of each detection's list on its way to the receiver. All (S | 1, M), NaN: there is none.

    `listed_s`: capture of the first list of any unit that has the object, whether it was sent and arrived or not.
    `sent_s`, `arrived_s`: of the list of the newest capture that contributed to the detection.
    """

    listed_s: Float
    sent_s: Float
    arrived_s: Float


WAY = tuple(Way.__dataclass_fields__)
"""Columns of `detections.parquet`, its last, where a configuration has a link, `issue_hz`, `ready` or `sends`."""


def first_listed_s(seen: Tracks, episodes: Episodes, units: Collection[str], *, count_earlier: bool) -> Float:
    """(S, M) capture of the first list of `units` that has the object of each episode; NaN: none."""
    parts = [_first_listed_s(seen, one, units, count_earlier=count_earlier) for _, one in episodes.passes]
    return episodes.join_passes(parts)


def _first_listed_s(perceived: Tracks, episodes: Episodes, units: Collection[str], *, count_earlier: bool) -> Float:
    """(S, M) capture (s) of the first list of any of `units` that holds the object during its episode; NaN: none."""
    episode_of = np.full(int(max(episodes.object_ix.max(initial=-1), perceived.object_ix.max(initial=-1))) + 2, -1)
    episode_of[episodes.object_ix] = np.arange(len(episodes.object_ix))
    episode, captured_s = episode_of[perceived.row_object_ix], perceived.entry_captured_s
    in_units = np.array([name in units for name in perceived.units], dtype=bool)[perceived.row_unit_ix]
    rows = np.flatnonzero(in_units & (episode >= 0) & np.isfinite(perceived.common_arrives_s)[perceived.frame_ix])
    is_during = captured_s[rows] <= episodes.ended_s[episode[rows]] + SAME_INSTANT_S
    from_s = episodes.counts_from_s(count_earlier=count_earlier)
    rows = rows[is_during & (captured_s[rows] >= from_s[episode[rows]])]
    first_s = np.full((len(perceived.valid), len(episodes.object_ix)), np.inf)
    for s, valid in enumerate(perceived.valid):
        listed = rows[valid[rows]]
        np.minimum.at(first_s[s], episode[listed], captured_s[listed])
    return np.where(np.isfinite(first_s), first_s, np.nan)


def find_informing_list(received: Tracks, known: FirstDetections) -> Int:
    """(S | 1, M) index of the list (F,) that made each object known; −1: none.

    Of the lists of that capture the last that the receiver had at the detection, of simultaneous ones that of the first
    unit.
    """
    list_ix, latest_s = np.full(known.detection_s.shape, -1), np.full(known.detection_s.shape, -np.inf)
    arrives_s = received.common_arrives_s
    for unit_ix in range(len(received.units)):
        frames = np.flatnonzero((received.frame_unit_ix == unit_ix) & np.isfinite(arrives_s))
        if not len(frames):
            continue
        frames = frames[np.argsort(received.captured_s[frames], kind="stable")]
        place = np.searchsorted(received.captured_s[frames], known.captured_s - SAME_INSTANT_S)
        frame = frames[np.minimum(place, len(frames) - 1)]
        matches = np.abs(received.captured_s[frame] - known.captured_s) <= SAME_INSTANT_S
        matches &= arrives_s[frame] <= known.detection_s + SAME_INSTANT_S
        later = arrives_s[frame] > latest_s + SAME_INSTANT_S
        is_first_unit = (known.first_unit_ix == unit_ix) & (arrives_s[frame] >= latest_s - SAME_INSTANT_S)
        list_ix = np.where(matches & (later | is_first_unit), frame, list_ix)
        latest_s = np.where(matches & (later | is_first_unit), arrives_s[frame], latest_s)
    return list_ix


def pick_list_times(list_ix: Int, time_s: Float) -> Float:
    """(S | 1, M) the times, of `time_s (F,)`, of the lists `list_ix (S | 1, M)`; NaN where that is −1."""
    return np.where(list_ix >= 0, time_s[list_ix] if len(time_s) else np.nan, np.nan)


T = TypeVar("T", bound=np.generic)


@dataclass(frozen=True)
class DetectionEvents:
    """Detections of one configuration, run by run: (S, M), or (1, M) where all runs agree.

    `units`: names of the units that `detections` counts. `conflict_known_s`: when a list first implied a collision,
    NaN: never. `way`: None where the configuration has neither a link nor `issue_hz`, `ready` or `sends`.
    """

    units: tuple[str, ...]
    detections: FirstDetections
    sight: SightTimes
    conflict_known_s: Float | None = None
    way: Way | None = None


def stack_events(blocks: Sequence[Mapping[str, DetectionEvents]], runs: Sequence[int]) -> dict[str, DetectionEvents]:
    """Events by configuration, with the runs of several blocks stacked in order."""
    return (
        {name: _stack_parts([block[name] for block in blocks], runs) for name in blocks[0]}
        if len(blocks) > 1
        else dict(blocks[0])
    )


def _stack_parts(parts: Sequence[Any], runs: Sequence[int]) -> Any:
    first: Any = parts[0]
    if isinstance(first, np.ndarray):
        return np.concatenate([np.broadcast_to(p, (n, p.shape[1])) for p, n in zip(parts, runs, strict=True)])
    if hasattr(first, "_fields"):
        return type(first)(*(_stack_parts(columns, runs) for columns in zip(*parts, strict=True)))
    if is_dataclass(first):
        columns = {f.name: _stack_parts([getattr(part, f.name) for part in parts], runs) for f in fields(first)}
        return replace(first, **columns)  # type: ignore[type-var]
    assert all(part == first for part in parts), f"{type(first).__name__} is not of all runs alike"
    return first


def build_detection_columns(
    scene: Scene,
    truth: Tracks,
    experiment: MetricsSetup,
    episodes: Episodes,
    encounters: Sequence[Encounter],
    runs: Int,
    events: Mapping[str, DetectionEvents],
) -> dict[str, Any]:
    """The columns of `detections.parquet` of one log and block of runs, by configuration, run and object."""
    delay_s = _reaction_delays(scene, experiment, episodes, runs)
    onset_m, _ = measure_distances(scene, truth, experiment, episodes.object_ix, episodes.onset_s)
    area = name_areas(scene, truth, episodes, experiment) if experiment.has_areas else None
    parts = []
    for name, event in events.items():
        columns = _configuration_columns(scene, truth, experiment, episodes, runs, name, event, onset_m, area)
        if delay_s is not None:
            columns |= _braking_columns(experiment, episodes, encounters, delay_s, event)
        if any(other.way is not None for other in events.values()):
            shape, absent = (len(runs), len(episodes.object_ix)), np.full((1, 1), np.nan)
            way = {name: absent if event.way is None else getattr(event.way, name) for name in WAY}
            columns |= {name: np.broadcast_to(values, shape).ravel() for name, values in way.items()}
        parts.append(columns)
    return concatenate_columns(parts)


def _configuration_columns(
    scene: Scene,
    truth: Tracks,
    experiment: MetricsSetup,
    episodes: Episodes,
    runs: Int,
    configuration: str,
    event: DetectionEvents,
    onset_m: Float,
    area: NDArray[np.object_] | None,
) -> dict[str, Any]:
    """Columns (S · M,) of one configuration: whether, when and how far away each object is detected in each run.
    `onset_m (M,)`: distances at the onset; `area (M,)`: the areas then, None: the study has none.
    """
    S, M = len(runs), len(episodes.object_ix)

    def flat(values: NDArray[T]) -> NDArray[T]:
        return np.broadcast_to(values, (S, M)).ravel()

    detections = event.detections
    detection_s = flat(detections.detection_s)
    distance_m, gap_m = measure_distances(scene, truth, experiment, flat(episodes.object_ix), detection_s)
    onset_s = flat(episodes.onset_s)
    names = np.array([*event.units, None], dtype=object)  # −1: none
    columns: dict[str, Any] = {
        "log": np.full(S * M, scene.log, dtype=object),
        "configuration": np.full(S * M, configuration, dtype=object),
        "run": np.repeat(runs, M),
        "object_id": np.array(scene.object_ids, dtype=object)[flat(episodes.object_ix)],
        "object_class": np.array(CLASSES, dtype=object)[scene.object_class[flat(episodes.object_ix)]],
        "episode": flat(episodes.number),
        "onset_s": onset_s,
        "distance_at_onset_m": flat(onset_m),
        "began": began_texts(flat(episodes.began)),
        **({} if area is None else {"area": flat(area)}),
        "detected": ~np.isnan(detection_s),
        "detection_s": detection_s,
        "captured_s": flat(detections.captured_s),
        **{name: flat(values) for name, values in event.sight._asdict().items()},
        "time_to_detection_s": detection_s - onset_s,
        "distance_at_detection_m": distance_m,
        "gap_at_detection_m": gap_m,
        "ended_s": flat(episodes.ended_s),
        "ended_by": end_reason_texts(flat(episodes.ended_by)),
        "first_unit": names[flat(detections.first_unit_ix)],
    }
    if event.conflict_known_s is not None:
        conflict_known_s = flat(event.conflict_known_s)
        conflict_distance_m, _ = measure_distances(scene, truth, experiment, flat(episodes.object_ix), conflict_known_s)
        columns |= {
            "conflict_detected": ~np.isnan(conflict_known_s),
            "conflict_detection_s": conflict_known_s,
            "time_to_conflict_detection_s": conflict_known_s - onset_s,
            "distance_at_conflict_detection_m": conflict_distance_m,
        }
    return columns


def _reaction_delays(scene: Scene, experiment: MetricsSetup, episodes: Episodes, runs: Int) -> Float | None:
    """(S, M) seconds the driver takes to react to each object, the same in every configuration. None without braking.

    The random number is addressed by the object and the stamp of its onset, not by the instant of detection.
    """
    if experiment.braking is None:
        return None
    no_unit = np.zeros(len(episodes.object_ix), dtype=np.int64)
    words = object_words([scene.object_ids[k] for k in episodes.object_ix])
    stamp_ns = scene.t0_ns + np.rint(episodes.onset_s * 1e9).astype(np.int64)
    uniform = CounterRng(experiment.seed, scene.log).uniform(
        "reaction", RandomKey(("",), no_unit, words, stamp_ns), runs
    )
    return reaction_delays(experiment.braking.driver.reaction, uniform.ravel()).reshape(uniform.shape)


def _braking_columns(
    experiment: MetricsSetup,
    episodes: Episodes,
    encounters: Sequence[Encounter],
    delay_s: Float,
    event: DetectionEvents,
) -> dict[str, Any]:
    """Columns (S · M,) of one configuration: braking and verdict of each episode in conflict; null for the others.
    `delay_s (S, M)`: reaction of the driver.
    """
    braking = experiment.braking
    assert braking is not None
    shape = delay_s.shape
    event_s = event.detections.detection_s if braking.brakes_for == "object" else event.conflict_known_s
    assert event_s is not None
    # Before its onset an object is no hazard yet.
    brake_s = np.maximum(np.broadcast_to(event_s, shape), episodes.onset_s) + delay_s
    in_conflict = np.zeros(shape, dtype=bool)
    numbers = {name: np.full(shape, np.nan) for name in Verdicts.__dataclass_fields__}
    for encounter in encounters:
        m = encounter.episode_ix
        in_conflict[:, m] = True
        verdicts = judge_braking(encounter, braking.driver, np.where(np.isnan(brake_s[:, m]), np.inf, brake_s[:, m]))
        for name, values in numbers.items():
            values[:, m] = getattr(verdicts, name)
    return {
        "conflict": in_conflict.ravel(),
        "brake_s": np.where(in_conflict, brake_s, np.nan).ravel(),
        "braking_pass": (numbers["min_distance_m"] > braking.margin_m).ravel(),  # null where not in conflict
        "min_distance_m": numbers["min_distance_m"].ravel(),
        "impact_s": numbers["impact_s"].ravel(),
        "impact_speed_mps": numbers["impact_speed_mps"].ravel(),
        "required_deceleration_mps2": numbers["required_mps2"].ravel(),
    }


def measure_distances(
    scene: Scene, truth: Tracks, experiment: MetricsSetup, object_ix: Int, time_s: Float
) -> tuple[Float, Float]:
    """Centre distance and gap (m) of objects (K,) at times (K,); NaN where the time is NaN, object or ego absent.

    Runs share objects and instants: each pair is computed once.
    """
    import pandas as pd

    distance_m, gap_m = np.full(len(time_s), np.nan), np.full(len(time_s), np.nan)
    timed = np.flatnonzero(~np.isnan(time_s))
    if not len(timed):
        return distance_m, gap_m
    # By hash: most rows share their pair with many others, and sorting them all took most of the time.
    number, times_s = pd.factorize(time_s[timed])
    pair_ix, pairs = pd.factorize(object_ix[timed] * len(times_s) + number)
    objects, pair_s = pairs // len(times_s), times_s[pairs % len(times_s)]
    ego = locate_reference(scene, truth, experiment, pair_s)
    state, present = interpolate_states(truth, objects, pair_s, t0_ns=scene.t0_ns, max_gap_s=experiment.max_gap_s)
    distance = np.where(present & ego.present, np.hypot(state["x_m"] - ego.x_m, state["y_m"] - ego.y_m), np.nan)
    distance_m[timed] = distance[pair_ix]
    if scene.ego_sized or experiment.measure.distance_to != "ego":
        gap_m[timed] = box_gap(state, ego, present & ego.present)[pair_ix]
    return distance_m, gap_m


def box_gap(state: Mapping[str, Float], ego: Reference, present: np.ndarray) -> Float:
    """(K,) horizontal distance (m) between the boxes, 0 where they touch; NaN where `present` is False."""
    import shapely

    gap = np.full(len(present), np.nan)
    rows = np.flatnonzero(present)
    box = shapely.polygons(
        rectangle_corners(*(state[n][rows] for n in ("x_m", "y_m", "yaw_rad", "length_m", "width_m")))
    )
    corners = rectangle_corners(*(getattr(ego, n)[rows] for n in ("x_m", "y_m", "heading_rad", "length_m", "width_m")))
    point = (ego.length_m[rows] == 0) & (ego.width_m[rows] == 0)
    other = np.where(point, shapely.points(ego.x_m[rows], ego.y_m[rows]), shapely.polygons(corners))
    gap[rows] = shapely.distance(box, other)
    return gap

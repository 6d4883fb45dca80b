"""Peers: the same work by the libraries that people have for it, in the same process, and whether the figures agree.

Stone Soup is among the packages of `bench`. norfair, filterpy, motmetrics and TrackEval ask for older versions of NumPy
and pandas than ours, and run with these all the same: they stand in a folder of their own,

    pip install --no-deps --target build/peers norfair==2.3.0 filterpy==1.4.5 motmetrics==1.4.0 trackeval==1.3.0
    pip install --no-deps --target build/peers mcap-ros2-support-fast==0.8.0 ros-parser lark
    PYTHONPATH=build/peers python tools/bench.py --table peers

What is not there has a line that says so.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from datetime import datetime, timedelta
from typing import Any

import numba as nb
import numpy as np

from benches import common
from benches.fusion import GATE, PERIOD_S, scene
from benches.reading import STATES, sum_decoded, write_tracked
from copem_replay.core.object_list import Inputs, ObjectLists
from copem_replay.core.tracks import CLASSES, TRUTH, Float, Scene, Tracks
from copem_replay.fusion.tracker import Tracker
from copem_replay.io.recording import read_log
from copem_replay.metrics.gospa import gospa, gospa_pairs
from copem_replay.metrics.matching import GHOST, MATCH, Matches, match_entries
from copem_replay.metrics.origin import GoesBack, OriginLists, Origins

_VAGUE_M2 = 1e6  # prior of a founding position: as good as none
_NEAR_M = 3.0  # of an object: farther entries are false


def peers() -> Iterator[common.Line]:
    """How many times as long as ours each peer takes for the same work, and what both found, a line for each.

    GOSPA and tracks: Stone Soup, norfair and filterpy; matches: motmetrics and TrackEval; ROS 2: readers of MCAP.
    """
    for bench in (
        gospa_vs_stonesoup, tracker_vs_stonesoup, tracker_vs_norfair, tracker_vs_filterpy, matches_vs_motmetrics,
        matches_vs_trackeval, reading_vs_mcap_ros2, reading_vs_mcap_ros2_support_fast,
    ):  # fmt: skip
        work, _, peer = bench.__name__.partition("_vs_")
        try:
            for line in bench():
                found = ", ".join(f"{key} {value}" for key, value in line.items() if key != bench.__name__)
                yield {"work": work, "peer": peer, "ratio": line[bench.__name__], "found": found}
        except ImportError as error:
            found = f"{error.name} is not installed: see tools/benches/peers.py"
            yield {"work": work, "peer": peer, "ratio": None, "found": found}


# ---------------------------------------------------------------------------------------------------------- Stone Soup


def gospa_vs_stonesoup(pairs: int = 200) -> Iterator[common.Line]:
    """GOSPA of 15 × 15 points, c = 5 m, p = 2, against Stone Soup's, states built before."""
    from stonesoup.metricgenerator.ospametric import GOSPAMetric
    from stonesoup.types.state import State

    rng = np.random.default_rng(0)
    truth = rng.uniform(0, 10 * math.sqrt(15), (pairs, 15, 2))
    output = truth + rng.normal(size=truth.shape)
    output[:, 12:] = rng.uniform(0, 10 * math.sqrt(15), (pairs, 3, 2))  # three are missed, three are about nobody
    at = datetime(2000, 1, 1)
    states = [[[State(point, timestamp=at) for point in points] for points in both] for both in (truth, output)]
    metric = GOSPAMetric(p=2, c=5)

    def theirs() -> list[float]:
        several = zip(*states, strict=True)
        return [metric.compute_gospa_metric(said, there)[0].value["distance"] for there, said in several]

    columns = [np.ascontiguousarray(points.transpose(2, 0, 1)) for points in (truth, output)]
    off = float(np.abs(_gospas(*columns, 5.0, 2.0) - theirs()).max())
    assert off < 1e-9, f"{off} m apart"
    seconds = common.best(lambda: _gospas(*columns, 5.0, 2.0), 20)
    yield {
        "gospa_vs_stonesoup": round(common.best(theirs, 3) / seconds),
        "gospa_per_s": round(pairs / seconds),
        "points": 15,
        "max_difference_m": off,
    }


@nb.njit(cache=True, nogil=True)
def _gospas(truth: Float, output: Float, cutoff_m: float, power: float) -> Float:
    """GOSPA (N,) of each of several pairs of lists, points (2, N, n)."""
    value_m, partner = np.empty(truth.shape[1]), np.empty(truth.shape[2], np.int64)
    alone = cutoff_m**power / 2
    for k in range(len(value_m)):
        cost, count = gospa_pairs(
            truth[0, k], truth[1, k], output[0, k], output[1, k], cutoff_m, power, partner
        )  # fmt: skip
        cost += alone * (truth.shape[2] + output.shape[2] - 2 * count)
        value_m[k] = cost ** (1 / power)
    return value_m


def tracker_vs_stonesoup(scenes: int = 3, count: int = 6) -> Iterator[common.Line]:
    """Tracks of 15 objects, lists of 20 units, against Stone Soup's two-dimensional assignment; and how good they are.

    Both have the same motion model, gate and knowledge of a new track's speed, hear list after list, and forget what
    was not heard of for long. Their assignments differ in what a pair costs (d, and d² + ln|S|), and ours merges what
    is one object twice; so tracks are alike, not equal. How good: at the last instant, mean of all scenes.
    """
    ours = Tracker(late="predict", gate=GATE, confirm_s=0.0)
    took: list[tuple[float, float]] = []
    said: list[tuple[float, ...]] = []
    for seed in range(scenes):
        told, truth = scene(15, 20, count, seed)
        feed = _stonesoup(told)
        found: list[Float] = []
        seconds = common.best(lambda told=told: ours.fuse(told), 20)
        took.append((seconds, common.best(lambda feed=feed, found=found: found.append(feed()), 1)))
        last = ours.fuse(told).of(0, count - 1)
        said.append(_quality(truth[-1], np.stack([last["x_m"], last["y_m"]], axis=1)) + _quality(truth[-1], found[-1]))
    seconds, peer_seconds = np.mean(took, axis=0) / count
    line: common.Line = {
        "tracker_vs_stonesoup": round(peer_seconds / seconds),
        "us_per_instant": round(seconds * 1e6, 1),
        "stonesoup_us_per_instant": round(peer_seconds * 1e6),
        "objects": 15,
        "units": 20,
    }
    names = ("tracks", "nearest_rmse_m", "gospa_m")
    keys = (*names, *(f"stonesoup_{name}" for name in names))
    yield line | {key: round(float(value), 2) for key, value in zip(keys, np.mean(said, axis=0), strict=True)}


def _stonesoup(told: Inputs) -> Callable[[], Float]:
    """Feeds Stone Soup's tracker all lists, made before, in order: where its tracks (n, 2) are in the end."""
    from stonesoup.dataassociator.neighbour import GNNWith2DAssignment
    from stonesoup.deleter.time import UpdateTimeDeleter
    from stonesoup.hypothesiser.distance import DistanceHypothesiser
    from stonesoup.initiator.simple import SinglePointMeasurementInitiator
    from stonesoup.measures import Mahalanobis
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.tracker.simple import MultiTargetTracker
    from stonesoup.types.detection import Detection
    from stonesoup.types.state import GaussianState
    from stonesoup.updater.kalman import KalmanUpdater

    settings, began = Tracker(), datetime(2000, 1, 1)
    axis = ConstantVelocity(settings.acceleration_psd_m2ps3)
    predictor = KalmanPredictor(CombinedLinearGaussianTransitionModel([axis, axis]))
    model = LinearGaussian(ndim_state=4, mapping=(0, 2), noise_covar=np.eye(2))
    updater = KalmanUpdater(model)
    gate = math.sqrt(-2 * math.log1p(-GATE))
    associator = GNNWith2DAssignment(DistanceHypothesiser(predictor, updater, Mahalanobis(), missed_distance=gate))
    spread = np.diag([_VAGUE_M2, settings.speed_sigma_mps**2] * 2)
    prior = GaussianState(np.zeros((4, 1)), spread, timestamp=began)
    lists = []
    for f, captured_s in enumerate(told.captured_s.tolist()):
        at, one = began + timedelta(seconds=captured_s), told.lists.of(0, f)
        places = np.stack([one["x_m"], one["y_m"]], axis=1)
        lists.append((at, {Detection(place, timestamp=at, measurement_model=model) for place in places}))

    def feed() -> Float:
        tracker = MultiTargetTracker(
            initiator=SinglePointMeasurementInitiator(prior, model),
            deleter=UpdateTimeDeleter(timedelta(seconds=1)),
            detector=lists,
            data_associator=associator,
            updater=updater,
        )
        for _ in tracker:
            pass
        return np.array([track.state_vector[[0, 2], 0] for track in tracker.tracks], dtype=float)

    return feed


def _quality(truth: Float, found: Float) -> tuple[float, ...]:
    """How many (m, 2) there are; RMS distance of each truth (n, 2) to the nearest, however many are left; GOSPA."""
    squared = ((truth[:, None] - found) ** 2).sum(axis=2).min(axis=1)
    return len(found), math.sqrt(squared.mean()), gospa(truth, found, cutoff_m=5.0, power=2.0).value_m


# ---------------------------------------------------------------------------------------------- norfair and filterpy


def tracker_vs_norfair(count: int = 100) -> Iterator[common.Line]:
    """Tracks of 15 objects by the lists of one unit, against norfair's by Euclidean distance; and how good they are.

    norfair hears of one sensor, of frames at one rate, and knows no covariances: its gate is a distance.
    """
    import norfair

    told, truth = scene(15, 1, count)
    frames = [
        [norfair.Detection(np.array([[x, y]])) for x, y in zip(one["x_m"].tolist(), one["y_m"].tolist(), strict=True)]
        for one in (told.lists.of(0, k) for k in range(count))
    ]

    def theirs() -> Float:
        tracker = norfair.Tracker(distance_function="euclidean", distance_threshold=5.0, initialization_delay=0)
        for frame in frames:
            tracks = tracker.update(frame)
        return np.array([track.estimate[0] for track in tracks])

    ours = Tracker(late="predict", gate=GATE, confirm_s=0.0)
    seconds, peer_seconds = (common.best(work, 5) / count for work in (lambda: ours.fuse(told), theirs))
    last = ours.fuse(told).of(0, count - 1)
    said = _quality(truth[-1], np.stack([last["x_m"], last["y_m"]], axis=1)) + _quality(truth[-1], theirs())
    names = ("tracks", "nearest_rmse_m", "gospa_m")
    yield {
        "tracker_vs_norfair": round(peer_seconds / seconds),
        "us_per_instant": round(seconds * 1e6, 1),
        "norfair_us_per_instant": round(peer_seconds * 1e6),
    } | {
        key: round(float(value), 2)
        for key, value in zip((*names, *(f"norfair_{name}" for name in names)), said, strict=True)
    }


def tracker_vs_filterpy(count: int = 100) -> Iterator[common.Line]:
    """The filter of one object against filterpy's, told the same lists, the same motion and the same prior."""
    from filterpy.kalman import KalmanFilter

    told, _ = scene(1, 1, count)
    ours, psd = Tracker(late="predict", gate=1.0 - 1e-9, confirm_s=0.0, forget_s=60.0), Tracker().acceleration_psd_m2ps3
    steps = [(at_s, told.lists.of(0, k)) for k, at_s in enumerate(told.captured_s.tolist())]

    def theirs() -> Float:
        kalman = KalmanFilter(dim_x=4, dim_z=2)
        kalman.H, kalman.R = np.eye(4)[[0, 2]], np.eye(2)
        kalman.x, kalman.P = np.zeros((4, 1)), np.diag([_VAGUE_M2, Tracker().speed_sigma_mps ** 2] * 2)
        heard_s = None
        for at_s, one in steps:
            if not len(one):
                continue
            if heard_s is not None:
                dt = at_s - heard_s
                axis = psd * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
                kalman.predict(F=np.kron(np.eye(2), [[1.0, dt], [0.0, 1.0]]), Q=np.kron(np.eye(2), axis))
            kalman.update(np.array([one["x_m"], one["y_m"]]))
            heard_s = at_s
        place: Float = kalman.x[[0, 2], 0]
        return place

    heard = max(k for k, (_, one) in enumerate(steps) if len(one))
    last = ours.fuse(told).of(0, heard)
    off_m = float(np.abs(theirs() - [last["x_m"][0], last["y_m"][0]]).max())
    assert off_m < 1e-3, f"{off_m} m apart"  # by a prior as good as none, and one that is none
    seconds, peer_seconds = (common.best(work, 5) / count for work in (lambda: ours.fuse(told), theirs))
    yield {
        "tracker_vs_filterpy": round(peer_seconds / seconds),
        "us_per_list": round(seconds * 1e6, 2),
        "filterpy_us_per_list": round(peer_seconds * 1e6, 1),
        "max_difference_m": off_m,
    }


# ------------------------------------------------------------------------------------------------------------- matches


def _tracked(count: int, objects: int = 15) -> tuple[ObjectLists, Float, Tracks, Scene]:
    """Lists of the tracker, by twenty units; where the objects are (count, objects, 2); the same as truth."""
    told, truth = scene(objects, 20, count)
    now_s, rows = np.arange(count) * PERIOD_S, count * objects
    stamps = np.rint(now_s * 1e9).astype(np.int64)
    zero, size = np.zeros((1, rows)), np.ones((1, rows))
    world = Tracks(
        units=(TRUTH,), start=np.arange(objects + 1) * count, unit_ix=np.zeros(objects, dtype=int),
        object_ix=np.arange(objects), frame_ix=np.tile(np.arange(count), objects), stamp_ns=stamps, captured_s=now_s,
        frame_unit_ix=np.zeros(count, dtype=int), arrives_s=now_s[None], valid=np.ones((1, rows), dtype=bool),
        x_m=truth[..., 0].T.reshape(1, -1), y_m=truth[..., 1].T.reshape(1, -1), z_m=zero, yaw_rad=zero, vx_mps=zero,
        vy_mps=zero, length_m=size, width_m=size, height_m=size,
    )  # fmt: skip
    car = np.full(objects, CLASSES.index("car"), np.int8)
    names = tuple(map(str, range(objects)))
    around = Scene("peer", 0, int(stamps[-1]), names, car, np.ones(objects, dtype=bool))
    return Tracker(late="predict", gate=GATE, confirm_s=0.0).fuse(told), truth, world, around


def _distances(lists: ObjectLists, truth: Float) -> list[Float]:
    """Of each list, (objects, entries), NaN beyond the gate."""
    found = []
    for k, places in enumerate(truth):
        one = lists.of(0, k)
        off = np.hypot(places[:, :1] - one["x_m"], places[:, 1:] - one["y_m"])
        found.append(np.where(off <= _NEAR_M, off, np.nan))
    return found


def _counted(matches: Matches, objects: int) -> tuple[int, int]:
    """Misses, of so many objects in all lists, and entries that are no match: ghosts and duplicates."""
    matched = int((matches.role == MATCH).sum())
    return objects - matched, len(matches.role) - matched


def matches_vs_motmetrics(count: int = 60) -> Iterator[common.Line]:
    """Misses and false entries of lists of fifteen objects, against motmetrics.

    It keeps pairs of the list before, by the places in both, where ours looks at one list alone: one pair may differ.
    """
    import motmetrics

    lists, truth, world, around = _tracked(count)
    distances = _distances(lists, truth)

    def theirs() -> tuple[int, int]:
        accumulator = motmetrics.MOTAccumulator(auto_id=True)
        for one in distances:
            accumulator.update(list(range(one.shape[0])), list(range(one.shape[1])), one)
        kinds = accumulator.mot_events["Type"].value_counts()
        return int(kinds.get("MISS", 0)), int(kinds.get("FP", 0))

    yield from _compare_matches("motmetrics", lists, truth, world, around, theirs)


def matches_vs_trackeval(count: int = 60) -> Iterator[common.Line]:
    """Misses and false entries of lists of fifteen objects, against TrackEval's CLEAR."""
    from trackeval.metrics import CLEAR

    lists, truth, world, around = _tracked(count)
    distances = _distances(lists, truth)
    near = [np.where(np.isnan(one), 0.0, 1.0 - one / (2 * _NEAR_M)) for one in distances]  # at the gate: one half
    data = {
        "num_tracker_dets": sum(one.shape[1] for one in near),
        "num_gt_dets": sum(one.shape[0] for one in near),
        "num_tracker_ids": max(one.shape[1] for one in near),
        "num_gt_ids": truth.shape[1],
        "num_timesteps": count,
        "gt_ids": [np.arange(one.shape[0]) for one in near],
        "tracker_ids": [np.arange(one.shape[1]) for one in near],
        "similarity_scores": near,
    }

    def theirs() -> tuple[int, int]:
        found = CLEAR({"PRINT_CONFIG": False}).eval_sequence(data)
        return int(found["CLR_FN"]), int(found["CLR_FP"])

    yield from _compare_matches("trackeval", lists, truth, world, around, theirs)


def _compare_matches(
    peer: str, lists: ObjectLists, truth: Float, world: Tracks, around: Scene, theirs: Callable[[], tuple[int, int]]
) -> Iterator[common.Line]:
    of = OriginLists(world, world, GoesBack.UNKNOWN, 1.0, np.zeros(1, dtype=bool), -1)
    anywhere = Origins(lists.entries, np.empty(0, dtype=np.int64), of.find_holdings(world.common_arrives_s))

    def ours() -> Matches:
        return match_entries(lists, world, around, anywhere, gate_m=_NEAR_M)

    objects = truth.shape[0] * truth.shape[1]
    (missed, false), (missed_there, false_there) = _counted(ours(), objects), theirs()
    seconds, peer_seconds = common.best(ours, 20), common.best(theirs, 3)
    yield {
        f"matches_vs_{peer}": round(peer_seconds / seconds),
        "entries_per_s": round(len(lists.entries) / seconds),
        "missed": missed,
        f"{peer}_missed": missed_there,
        "false": false,
        f"{peer}_false": false_there,
        "ghosts": int((ours().role == GHOST).sum()),
    }


# ------------------------------------------------------------------------------------------------------------- reading


def reading_vs_mcap_ros2() -> Iterator[common.Line]:
    """A recording of TrackedObjects read to tracks, against mcap-ros2-support, places touched."""
    from mcap_ros2.decoder import DecoderFactory

    yield from _compare_reading("reading_vs_mcap_ros2", DecoderFactory)


def reading_vs_mcap_ros2_support_fast() -> Iterator[common.Line]:
    """The same against mcap-ros2-support-fast."""
    from mcap_ros2_support_fast.decoder import DecoderFactory

    yield from _compare_reading("reading_vs_mcap_ros2_support_fast", DecoderFactory)


def _compare_reading(name: str, factory: Callable[[], Any]) -> Iterator[common.Line]:
    with common.scratch() as folder:
        path = write_tracked(folder / "tracked.mcap")
        truth = read_log(path, name="tracked").truth

        def theirs() -> float:
            return sum_decoded(path, factory())

        off = abs(theirs() - float(truth.x_m[truth.valid].sum()))
        assert off < 1e-3, f"{off} m apart"
        seconds, peer_seconds = common.best(lambda: read_log(path, name="tracked"), 3), common.best(theirs, 1)
    yield {name: round(peer_seconds / seconds, 1), "objects_per_s": round(STATES / seconds)}

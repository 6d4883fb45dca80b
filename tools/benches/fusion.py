"""Benchmarks of fusion, by time and by how good it is.

Objects and units but those of the crossing: objects on straight ways, one to 100 m², twenty units that capture at one
instant, ten times a second, and list each object with probability .8, its position ± 1 m per axis, nothing else of
use (one class, no velocity), and no clutter.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime, timedelta
from operator import call

import numba as nb
import numpy as np

from benches import common
from copem_replay.communication.arrivals import fusion_schedule
from copem_replay.core.object_list import COVARIANCES, Inputs, ObjectLists, entries_of
from copem_replay.core.tracks import CLASSES, Float, TimeChunk
from copem_replay.experiment.schema import Experiment
from copem_replay.fusion.gnn import Gnn
from copem_replay.fusion.ideal import fuse_ideal
from copem_replay.fusion.inputs import make_inputs
from copem_replay.fusion.interface import ListFusion
from copem_replay.fusion.tracker import Tracker
from copem_replay.io.recording import Recording
from copem_replay.metrics.gospa import gospa, gospa_pairs
from copem_replay.pipeline.expansion import RunGroup
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.receiver import remove_truth_ids
from copem_replay.pipeline.replay import cut_blocks
from copem_replay.pipeline.world import Transmission
from tests.oracles import gnn as gnn_oracle

PERIOD_S = 0.1
GATE = 0.999
_VAGUE_M2 = 1e6  # prior of a founding position: as good as none
MISSING = {"why": "stonesoup is not installed: pip install '.[bench]'"}


def scene(objects: int, units: int, count: int, seed: int = 0, common: float = 0.0) -> tuple[Inputs, Float]:
    """What `units` report in one run at `count` instants, at once; where the objects are (count, objects, 2).

    `common`: of the variance of the errors about an object, this share is one and the same for all units and instants.
    """
    rng = np.random.default_rng(seed)
    place, speed = rng.uniform(0, 10 * math.sqrt(objects), (objects, 2)), rng.normal(0, 2, (objects, 2))
    now_s = np.arange(count) * PERIOD_S
    truth = place + now_s[:, None, None] * speed
    seen = rng.random((count, units, objects)) < 0.8
    instant, unit, which = np.nonzero(seen)
    entries = entries_of(len(which))
    error = rng.normal(size=(len(which), 2))
    if common > 0:
        error = math.sqrt(1 - common) * error + math.sqrt(common) * rng.normal(size=(objects, 2))[which]
    entries["x_m"], entries["y_m"] = (truth[instant, which] + error).T
    for name, variance in zip(COVARIANCES, (1.0, 0.0, 1.0), strict=True):
        entries[name] = variance
    entries["length_m"], entries["width_m"], entries["height_m"] = 4.5, 1.9, 1.5
    entries["class_probability"][:, CLASSES.index("car")] = 1.0
    entries["existence"], entries["captured_s"], entries["unit_ix"] = 0.9, now_s[instant], unit
    start = np.concatenate([[0], np.cumsum(seen.sum(axis=2))])[None]
    number, captured_s = np.arange(count * units), np.repeat(now_s, units)
    told = Inputs(
        tuple(f"unit {u}" for u in range(units)), number % units, captured_s, captured_s, ObjectLists(start, entries),
        now_s, number.reshape(count, units), number, np.arange(count + 1) * units,
    )  # fmt: skip
    return told, truth


# -------------------------------------------------------------------------------------------------------- the crossing


def crossing(experiment: Experiment, recording: Recording) -> Iterator[common.Line]:
    """Fused lists per second in one thread and in two: two blocks of runs, cut as `run` cuts them.

    Only the fusion: what units list, and when it arrives, is there before.
    """
    ready = prepare_log(recording, experiment)
    cut = cut_blocks(ready, experiment, 2)[:2]
    lists = [Transmission(ready, experiment, RunGroup.of_all_units(ready.expanded, runs)) for runs in cut]
    told = [remove_truth_ids(each.world(TimeChunk(), -np.inf))[0] for each in lists]
    with ThreadPoolExecutor(2) as pool:
        for name in experiment.configurations:
            parts = [_fusing(name, *each) for each in zip(lists, told, strict=True)]
            work = [fused for fused, _ in parts]
            count = parts[0][1] * sum(map(len, cut))
            one = common.best(lambda work=work: list(map(call, work)), 2) / count
            two = common.best(lambda work=work: list(pool.map(call, work)), 2) / count
            yield {
                "fusion_lists_per_s": round(1 / one),
                "algorithm": name,
                "us_per_list": round(one * 1e6, 1),
                "lists_per_s_two_threads": round(1 / two),
            }


def _fusing(name: str, lists: Transmission, told: ObjectLists) -> tuple[Callable[[], object], int]:
    """Fuses one block of runs as one configuration does; how many lists each run gets."""
    world = lists.world(TimeChunk(), -np.inf)
    received = lists.receive(world.sent("sampled"), name)
    configuration = world.experiment.configurations[name]
    age_of_information_s, fusion = configuration.max_age_s, configuration.fusion
    count = len(fusion_schedule(received, max_age_s=age_of_information_s).issue_s)
    if isinstance(fusion, ListFusion):
        ready = make_inputs(received, told, max_age_s=age_of_information_s)
        return lambda: fusion.fuse(ready), count
    return lambda: fuse_ideal(received, max_age_s=age_of_information_s, without_object_ix=world.scene.ego_ix), count


# -------------------------------------------------------------------------------------------------- nearest neighbours


def gnn_vs_numpy(sizes: tuple[int, ...] = (15, 160)) -> Iterator[common.Line]:
    """Against the same algorithm in NumPy and SciPy, whose lists it has to give."""
    ours = Gnn(gate=GATE)
    for objects in sizes:
        told, _ = scene(objects, 20, max(150 // objects, 2))
        found, expected = ours.fuse(told), gnn_oracle.fuse(told, gate=GATE)
        assert found.start.tolist() == expected.start.tolist(), "lists of other lengths"
        off_m = max(float(np.abs(found.entries[c] - expected.entries[c]).max()) for c in ("x_m", "y_m"))
        assert off_m < 1e-9, f"{off_m} m apart"
        seconds = common.best(lambda told=told: ours.fuse(told), 20)
        ratio = common.best(lambda told=told: gnn_oracle.fuse(told, gate=GATE), 3) / seconds
        yield {
            "gnn_vs_numpy": round(ratio, 1),
            "objects": objects,
            "units": 20,
            "us_per_list": round(seconds / len(told.issue_s) * 1e6, 1),
            "max_dx_m": off_m,
        }


def gnn_growth() -> Iterator[common.Line]:
    """How the time of a fused list grows with objects, at one density, and with units."""
    ours = Gnn(gate=GATE)
    took: dict[tuple[int, int], float] = {}
    for objects, units in ((10, 20), (40, 5), (40, 10), (40, 20), (160, 20)):
        told, _ = scene(objects, units, max(2000 // objects, 10))
        took[objects, units] = common.best(lambda told=told: ours.fuse(told), 10) / len(told.issue_s) * 1e6
        yield {"gnn_us_per_list": round(took[objects, units], 1), "objects": objects, "units": units}
    yield {"gnn_growth": round(took[160, 20] / took[10, 20], 1), "bound_objects_squared": 256}
    # The first list of an instant meets nobody: 19 to be assigned, and 4.
    yield {"gnn_growth_with_units": round(took[40, 20] / took[40, 5], 2), "lists_to_assign": 4.75}


COMBINED: tuple[tuple[str, ListFusion], ...] = (
    ("gnn inverse_variance", Gnn(gate=GATE)),
    ("gnn covariance_intersection", Gnn(gate=GATE, combine="covariance_intersection")),
    ("gnn fast_covariance_intersection", Gnn(gate=GATE, combine="fast_covariance_intersection")),
    ("gnn inverse_covariance_intersection", Gnn(gate=GATE, combine="inverse_covariance_intersection")),
    ("gnn split_covariance_intersection", Gnn(gate=GATE, combine="split_covariance_intersection")),
    ("gnn cross_covariance", Gnn(gate=GATE, combine="cross_covariance")),
    ("gnn covariance_union", Gnn(gate=GATE, combine="covariance_union")),
    ("tracker", Tracker(confirm_s=0.0)),
    ("tracker errors_last_s 1", Tracker(confirm_s=0.0, errors_last_s=1.0)),
    ("tracker common_share 0.5", Tracker(confirm_s=0.0, common_share=0.5)),
)


def combining(objects: int = 15, units: int = 6, count: int = 100) -> Iterator[common.Line]:
    """Each way to combine, by time, and how true it is where half of every variance is common to all units.

    RMSE and NEES (2: honest) over the entries within 5 m of an object, all instants, of the one next to each.
    """
    told, truth = scene(objects, units, count, common=0.5)
    for name, fusion in COMBINED:
        found = fusion.fuse(told)
        seconds = common.best(lambda fusion=fusion: fusion.fuse(told), 5)
        error, cov = _next_to(truth, found)
        nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error).mean()
        yield {
            "combine": name,
            "us_per_list": round(seconds / count * 1e6, 1),
            "entries_per_object": round(len(found.entries) / (count * objects), 3),
            "rmse_m": round(math.sqrt((error**2).sum(axis=1).mean()), 3),
            "nees": round(float(nees), 2),
        }


def _next_to(truth: Float, found: ObjectLists) -> tuple[Float, Float]:
    """Errors (N, 2) and covariances (N, 2, 2) of the entry next to each object, where one is within 5 m."""
    errors, covariances = [np.empty((0, 2))], [np.empty((0, 2, 2))]
    for k, places in enumerate(truth):
        entries = found.of(0, k)
        if len(entries) == 0:
            continue
        off = np.stack([entries["x_m"], entries["y_m"]], axis=1)[None] - places[:, None]
        nearest = (off**2).sum(axis=2).argmin(axis=1)
        error = off[np.arange(len(places)), nearest]
        close = (error**2).sum(axis=1) <= 25.0
        cov = np.stack([entries[f"cov_{name}_m2"] for name in ("ee", "en", "en", "nn")], axis=1).reshape(-1, 2, 2)
        errors.append(error[close])
        covariances.append(cov[nearest][close])
    return np.concatenate(errors), np.concatenate(covariances)


# -------------------------------------------------------------------------------------------------------------- a peer


def gospa_vs_stonesoup(pairs: int = 200) -> Iterator[common.Line]:
    """GOSPA of 15 × 15 points, c = 5 m, p = 2, against Stone Soup's, states built before."""
    try:
        from stonesoup.metricgenerator.ospametric import GOSPAMetric
        from stonesoup.types.state import State
    except ImportError:
        yield {"gospa_vs_stonesoup": None} | MISSING
        return
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
        try:
            feed = _stonesoup(told)
        except ImportError:
            yield {"tracker_vs_stonesoup": None} | MISSING
            return
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


def fusion() -> Iterator[common.Line]:
    """Fused lists per second on the crossing, and how the time of one grows; see py."""
    experiment, recordings = common.loaded("crossing")
    yield from crossing(experiment, recordings[0])
    yield from gnn_growth()
    yield from combining()


def peers() -> Iterator[common.Line]:
    """Fusion and GOSPA against NumPy and SciPy, and against Stone Soup."""
    for bench in (gnn_vs_numpy, gospa_vs_stonesoup, tracker_vs_stonesoup):
        yield from bench()

"""Benchmarks of fusion, by time and by how good it is.

Objects and units but those of the crossing: objects on straight ways, one to 100 m², twenty units that capture at one
instant, ten times a second, and list each object with probability .8, its position ± 1 m per axis, nothing else of
use (one class, no velocity), and no clutter.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from operator import call

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
from copem_replay.pipeline.expansion import RunGroup
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.receiver import remove_truth_ids
from copem_replay.pipeline.replay import cut_blocks
from copem_replay.pipeline.world import Transmission
from tests.oracles import gnn as gnn_oracle

PERIOD_S = 0.1
GATE = 0.999


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


def fusion() -> Iterator[common.Line]:
    """Fused lists per second on the crossing, and how the time of one grows; peers: `peers.py`."""
    experiment, recordings = common.loaded("crossing")
    yield from crossing(experiment, recordings[0])
    yield from gnn_vs_numpy()
    yield from gnn_growth()
    yield from combining()

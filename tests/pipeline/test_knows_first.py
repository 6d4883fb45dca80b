"""Nobody knows an object sooner than ideal fusion of the same lists at the same instants, whatever the experiment.

Not even the adversaries: one lists every entry three times, one scatters copies around it, one lists all that it ever
heard as if it were new.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from osi3.osi_detectedobject_pb2 import DetectedMovingObject

import copem_replay as cr
from copem_replay.core.object_list import Entries
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import read_logs
from copem_replay.pipeline.one_run import tracks_of_run
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.run import run_experiment
from tests.helpers.recordings import PEDESTRIAN, Obj, Topic, pedestrian, write_recording
from tests.helpers.replays import study_rows
from tests.io.test_recorded_units import list_of

PLACE = "tests.pipeline.test_knows_first"


def newest(inbox: cr.Inbox) -> Entries:
    entries = np.concatenate([cr.entries_of(0), *(one.entries for one in inbox.newest)])
    entries["track_id"] = -1
    return entries


class Echo(cr.StepFusion):
    """Every entry three times."""

    def step(self, now_s: float, inbox: cr.Inbox, memory: Any) -> tuple[Entries, Any]:
        return np.repeat(newest(inbox), 3), memory


class Spray(cr.StepFusion):
    """Every entry with copies around it, all with the newest capture of all."""

    def step(self, now_s: float, inbox: cr.Inbox, memory: Any) -> tuple[Entries, Any]:
        copies = [newest(inbox) for _ in range(9)]
        for copy, (dx_m, dy_m) in zip(copies, np.ndindex(3, 3), strict=True):
            copy["x_m"] += 1.7 * (dx_m - 1)
            copy["y_m"] += 1.7 * (dy_m - 1)
        entries = np.concatenate(copies)
        entries["captured_s"] = max((one.captured_s for one in inbox.newest), default=0.0)
        return entries, memory


class Hold(cr.StepFusion):
    """All entries of the last three seconds, with the newest capture of all."""

    def step(self, now_s: float, inbox: cr.Inbox, memory: Any) -> tuple[Entries, Any]:
        kept = [(t, entries) for t, entries in memory or [] if now_s - t < 3] + [(now_s, newest(inbox))]
        entries = np.concatenate([one for _, one in kept])[: None if inbox.newest else 0]
        entries["captured_s"] = max((one.captured_s for one in inbox.newest), default=0.0)
        return entries, kept


OWN = {name.lower(): {"kind": f"{PLACE}:{name}"} for name in ("Echo", "Spray", "Hold")}
FUSIONS = {kind: {"kind": kind} for kind in ("gnn", "nms", "union")} | OWN


def people(rng: np.random.Generator) -> dict[int, Any]:
    """Who walks in groups of up to three, from when to when, from where and how fast."""
    walks: dict[int, Any] = {}
    for _ in range(rng.integers(2, 5)):
        x, y, vx, vy = (*rng.uniform(-15, 25, 2), *rng.uniform(-3, 3, 2))
        for _ in range(rng.integers(1, 4)):
            dx, dy = rng.uniform(-2.5, 2.5, 2)
            on = max(rng.uniform(-1, 2), 0)
            walks[len(walks) + 2] = (on, on + rng.uniform(1, 5), x + dx, y + dy, vx, vy)
    return walks


def seen_at(walks: dict[int, Any], t: float) -> list[Obj]:
    return [
        pedestrian(o, x + vx * t, y + vy * t, vx=vx, vy=vy)
        for o, (on, off, x, y, vx, vy) in walks.items() if on <= t <= off
    ]  # fmt: skip


def listed(rng: np.random.Generator, one: Obj, sigma_m: float) -> DetectedMovingObject:
    entry = DetectedMovingObject()
    assert one.id is not None
    assert one.x is not None
    entry.header.tracking_id.value = one.id
    entry.base.position.x, entry.base.position.y = np.array([one.x, one.y]) + rng.normal(0, sigma_m, 2)
    entry.candidate.add(type=PEDESTRIAN, probability=1.0)
    return entry


def drive(path: Path, rng: np.random.Generator, *, recorded: bool) -> Path:
    """Four seconds; perhaps two recorded units, and a stack that lists the truth before any of them."""
    walks, topics = people(rng), []
    frames = [(k / 10, [Obj(id=1, x=-30.0), *seen_at(walks, k / 10)]) for k in range(41)]
    for name, period_s, share, sigma_m in (("in0", 0.1, 0.6, 0.5), ("in1", 0.2, 0.6, 0.5), ("stack", 0.2, 1.0, 0.3)):
        times = np.arange(period_s, 4, period_s) if recorded else []
        of = [[listed(rng, o, sigma_m) for o in seen_at(walks, t) if rng.random() < share] for t in times]
        lists = [list_of(t + 0.06, *one, captured_s=t) for t, one in zip(times, of, strict=True)]
        topics += [Topic(name, "osi3.SensorData", lists)] if recorded else []
    return write_recording(path, frames, host=1, more=topics)


def draw_pem(rng: np.random.Generator) -> dict[str, Any]:
    detection = {"kind": "constant", "probability": float(rng.choice([0.1, 0.3, 0.6, 1.0]))}
    error = {"kind": "gaussian", "covariance_m2": [[float(rng.choice([0.05, 0.5, 2.0])), 0], [0, 0.3]]}
    pem: dict[str, Any] = {"couples": [{"detection": detection, "error": error}]}
    if rng.random() < 0.4:
        pem["memory"] = {"detection": [{"share": 0.8, "correlation_s": 1.0}]}
    if rng.random() < 0.4:
        pem["ghosts"] = [{"in_list": 1.0, "lasts_s": 1.0, "where": {"kind": "field", "range_m": [3, 40]}}]
    return pem


def draw_unit(rng: np.random.Generator, pem: str, *, sends: bool) -> dict[str, Any]:
    unit: dict[str, Any] = {"at": [*map(float, rng.uniform(-10, 15, 2))], "height_m": 6, "pem": pem}
    may = {
        "clock": {"offset_sigma_s": 0.08, "drift_sigma_ppm": 50}, "placed": {"position_sigma_m": 0.5},
        "rate_hz": float(rng.choice([4, 5, 10, 20])), "outages": {"down_share": 0.2, "lasts_s": 0.5},
    }  # fmt: skip
    unit |= {key: value for key, value in may.items() if rng.random() < 0.3}
    return unit | ({"sends": {"kind": "cpm", "interval_s": 0.1}} if sends and rng.random() < 0.3 else {})


def draw_receiver(rng: np.random.Generator) -> dict[str, Any]:
    receiver: dict[str, Any] = [{"link": "l"}, {"latency_s": float(rng.choice([0.1, 0.35]))}, {}][rng.integers(3)]
    if rng.random() < 0.4:
        receiver["issue_hz"] = float(rng.choice([2, 5, 10, 25]))
    if rng.random() < 0.3:
        receiver["max_age_s"] = float(rng.choice([0.2, 0.5, 2.0]))
    return receiver


def draw_experiment(path: Path, rng: np.random.Generator, *, recorded: bool, hub: bool = True) -> Experiment:
    hits, of = [(1, 1), (1, 1), (2, 2), (2, 3), (3, 5)][rng.integers(5)]
    pems = {f"p{k}": draw_pem(rng) for k in range(rng.integers(1, 4))}
    units = {f"u{k}": draw_unit(rng, f"p{k}", sends=True) for k in range(len(pems))}
    covariance = [[0.25, 0], [0, 0.25]]
    units |= {n: {"recorded": {"topic": n, "covariance_m2": covariance}} for n in ("in0", "in1") if recorded}
    gamma = {"kind": "gamma", "min_s": 0.01, "mean_s": float(rng.choice([0.05, 0.3])), "shape": 1.0}
    lost = {"kind": "constant", "probability": float(rng.choice([0.5, 0.8, 1.0]))}
    link = {"latency": gamma, "order": str(rng.choice(["kept", "free"])), "reception": lost}
    link |= {"channel": {"kbps": float(rng.choice([20, 200]))}} if rng.random() < 0.3 else {}
    if hub and len(pems) > 1 and rng.random() < 0.5:  # two of them are sensors of one mast
        fusion = {"kind": str(rng.choice(["ideal", "gnn", "union", "tracker"]))}
        for name in ("u0", "u1"):
            units[name] = {key: value for key, value in units[name].items() if key not in ("sends", "clock")}
        mast = draw_unit(rng, "", sends=True)
        own = {key: value for key, value in mast.items() if key not in ("at", "height_m", "pem")}
        units["mast"] = own | {"fuses": ["u0", "u1"], "fusion": fusion}
    heard = [name for name in units if "mast" not in units or name not in ("u0", "u1")]
    common = {"units": heard} | draw_receiver(rng)
    tracker = {"kind": "tracker", "late": str(rng.choice(["stale", "predict", "replay"]))}
    configurations = {"ideal": common} | {
        n: common | {"fusion": f} for n, f in (FUSIONS | {"tracker": tracker}).items()
    }
    if recorded:
        configurations["stack"] = {
            "recorded": {"topic": "stack", "covariance_m2": covariance},
            "inputs": ["in0", "in1"],
        }
    onset = {"kind": str(rng.choice(["in_range", "appears"]))} | ({"again_after_s": 0.6} if rng.random() < 0.25 else {})
    measure = {
        "onset": onset, "confirm": {"hits": hits, "of": of}, "count_earlier": bool(rng.random() < 0.3),
        "accuracy": False, "began": ["log_start", "appeared", "crossed"],
        "match": {"gate_m": float(rng.choice([1.0, 3.0, 6.0]))},
    }  # fmt: skip
    return Experiment.model_validate({
        "version": 1, "logs": [str(path)], "runs": 2, "seed": int(rng.integers(1, 99)), "pems": pems, "units": units,
        "links": {"l": link}, "configurations": configurations, "measure": measure,
    })  # fmt: skip


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), recorded=st.booleans())
def test_the_ideal_knows_first(tmp_path_factory: pytest.TempPathFactory, seed: int, recorded: bool) -> None:
    rng = np.random.default_rng(seed)
    path = drive(tmp_path_factory.mktemp("drawn") / "scene.mcap", rng, recorded=recorded)
    plan = draw_experiment(path, rng, recorded=recorded)
    recordings, refused = read_logs(plan, [path], None)
    assert not refused, refused
    rows = study_rows(run_experiment(plan, recordings))
    if rows.empty:  # nobody comes near
        return
    known = rows.set_index(["object_id", "episode", "run", "configuration"])["detection_s"].unstack().fillna(np.inf)
    for name in ("tracker", *FUSIONS):
        assert (known[name] >= known["ideal"] - 1e-9).all(), name
    np.testing.assert_allclose(known["echo"], known["union"], rtol=0, atol=1e-9)  # to list an entry again gains nothing
    if recorded and plan.measure.confirm.hits == 1:  # a stack's lists come at other instants than its ideal's
        assert (known["stack"] >= known["stack:ideal"] - 1e-9).all()


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), recorded=st.booleans())
def test_ideal_fusion_lists_what_the_lists_hold_that_arrive(
    tmp_path_factory: pytest.TempPathFactory, seed: int, recorded: bool
) -> None:
    """At the instant at which a list is taken in, every object of it is in the fused list."""
    rng = np.random.default_rng(seed)
    path = drive(tmp_path_factory.mktemp("drawn") / "scene.mcap", rng, recorded=recorded)
    plan = draw_experiment(path, rng, recorded=recorded)
    plan = plan.model_copy(update={"configurations": {"ideal": plan.configurations["ideal"]}})
    [log], _ = read_logs(plan, [path], None)
    tracks = tracks_of_run(prepare_log(log, plan), plan, 0)["ideal"]
    received, fused = tracks.received, tracks.fused
    held = {
        (int(o), int(k))
        for o, k in zip(fused.row_object_ix[fused.valid[0]], fused.frame_ix[fused.valid[0]], strict=True)
    }
    for p in np.flatnonzero(received.valid[0] & (received.row_object_ix >= 0)):
        object_ix, arrives_s = int(received.row_object_ix[p]), received.common_arrives_s[received.frame_ix[p]]
        if np.isfinite(arrives_s) and object_ix != log.scene.ego_ix:
            k = int(np.searchsorted(fused.common_arrives_s + 1e-6, arrives_s))
            assert (object_ix, k) in held


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_who_is_always_listed_is_confirmed_at_the_list_at_which_the_ideal_confirms(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    """People who stand far apart, detection that is certain: nothing but turns can make a difference."""
    rng = np.random.default_rng(seed)
    on_s = rng.uniform(-1, 2, 5).clip(0)
    frames = [
        (k / 10, [Obj(id=1, x=-30.0)] + [pedestrian(o + 2, 10.0 * o, 5.0) for o in range(5) if on_s[o] <= k / 10])
        for k in range(41)
    ]
    path = write_recording(tmp_path_factory.mktemp("drawn") / "scene.mcap", frames, host=1)
    plan = draw_experiment(path, rng, recorded=False, hub=False).model_dump(mode="json", exclude_unset=True)
    hits, of = [(2, 2), (2, 3), (3, 5)][rng.integers(3)]
    couple = {
        "detection": {"kind": "constant", "probability": 1.0},
        "error": {"kind": "gaussian", "covariance_m2": [[0.01, 0], [0, 0.01]]},
    }
    plan["pems"] = {name: {"couples": [couple]} for name in plan["pems"]}
    for unit in plan["units"].values():
        for key in ("sends", "outages", "placed", "clock"):  # a clock that is off moves what an entry states
            unit.pop(key, None)
        if "rate_hz" in unit:
            unit["phase_s"] = float(rng.choice([0, 0.03, 0.07]))
    plan["configurations"] = {name: plan["configurations"][name] for name in ("ideal", "gnn", "nms", "union")}
    plan["measure"] |= {"confirm": {"hits": hits, "of": of}}
    experiment = Experiment.model_validate(plan)
    recordings, refused = read_logs(experiment, [path], None)
    assert not refused, refused
    known = study_rows(run_experiment(experiment, recordings)).set_index(
        ["object_id", "episode", "run", "configuration"]
    )
    detection_s = known["detection_s"].unstack()
    for name in ("gnn", "nms", "union"):
        np.testing.assert_allclose(detection_s[name], detection_s["ideal"], rtol=0, atol=1e-9, err_msg=name)

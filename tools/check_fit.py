"""Hold what `copem-replay fit` estimates against what was put in, four ways.

A known perception error model is replayed on a recording, its lists are written to MCAP, and a copy of that without
truth ids and without the times of measurement is fitted. Printed: how often each declared number is inside its 95 %
interval, how wide that is, and what the fitted model gives on another recording beside the true one.

    python tools/check_fit.py --seeds 40            # known models, replayed and read back from MCAP
    python tools/check_fit.py rows --seeds 40       # intervals of ten cases, drawn at the rows of a fit
    python tools/check_fit.py logs --seeds 4000     # numbers over logs, drawn with known variances
    python tools/check_fit.py splits                # a recorded unit by six splits of its trials (../shared/data)
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer
from osi3.osi_sensordata_pb2 import SensorData

import copem_replay as cr
from copem_replay.core.tracks import CLASSES
from copem_replay.core.yaml import strip_comments
from copem_replay.experiment.file import make_plain_source
from copem_replay.extras.fitting.api import read_study_to_fit
from copem_replay.extras.fitting.detection import DetectionCouple, DetectionFit, fit_detection
from copem_replay.extras.fitting.errors import ErrorFit, fit_errors
from copem_replay.extras.fitting.estimate import Estimate, pool_logs
from copem_replay.extras.fitting.fit import FitOptions, ReplayChecks, build_pem, build_unit, fit_unit
from copem_replay.extras.fitting.replay_check import replay_check, simulate_lists
from copem_replay.extras.fitting.rows import FitLists, FitRows
from copem_replay.perception.pem.detection import TableDetection
from copem_replay.perception.pem.model import Pem

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))
DELAY_S = 0.12
TOPIC = "/rsu/lists"
PLACE = {"at": [12.4, 12.4], "yaw_deg": -135.0, "height_m": 6.0}
OBSTACLES = [
    {"polygon_m": [[14, 14], [60, 14], [60, 40], [14, 40]], "height_m": 14},
    {"polygon_m": [[-70, 14], [-14, 14], [-14, 60], [-26, 60], [-26, 26], [-70, 26]], "height_m": 12},
    {"polygon_m": [[14, -34], [50, -34], [50, -14], [14, -14]], "height_m": 9},
]


def known(
    *, near: float, far: float, variances_m2: tuple[float, float], lists: tuple[float, float],
    errors: tuple[float, float], ghosts: tuple[float, float], confused: float, ids_s: float,
) -> dict[str, Any]:  # fmt: skip
    """A PEM: detected with probability `near` … `far` from 0 to 70 m where all is visible. `lists`, `errors`: share and
    seconds of what lasts; `ghosts`: how many in a list, for how long.
    """
    along, across = variances_m2
    couple = {
        "when": {"range_m": [0, 70], "azimuth_deg": [-60, 60]},
        "detection": {
            "kind": "table", "range_m": [0, 70], "visible_share": [0, 1],
            "probability": [[0.2 * near, near], [0.1 * far, far]],
        },
        "error": {
            "kind": "gaussian", "frame": "line_of_sight", "covariance_m2": [[along, 0.0], [0.0, across]],
            "yaw_sigma_deg": 4.0, "speed_sigma_mps": 0.5, "size_sigma_m": 0.1,
        },
        "existence": {"kind": "scores", "real": [8, 2], "ghost": [2, 4]},
    }  # fmt: skip
    in_list, lasts_s = ghosts
    return {
        "couples": [couple],
        "memory": {
            "detection": [{"share": lists[0], "correlation_s": lists[1]}],
            "position": [{"share": errors[0], "correlation_s": errors[1]}],
        },
        "ghosts": [
            {"in_list": in_list, "lasts_s": lasts_s, "classes": {"pedestrian": 1.0},
             "where": {"kind": "field", "range_m": [5, 65], "azimuth_deg": [-60, 60]}},
        ],
        "classes": {"confusion": {"car": {"car": 1 - confused, "van": confused}}, "confidence": 0.8},
        "tracks": {"lasts_s": ids_s},
    }  # fmt: skip


KNOWN: dict[str, tuple[dict[str, Any], dict[str, float]]] = {
    "camera": (
        known(near=0.95, far=0.5, variances_m2=(0.3, 0.08), lists=(0.7, 1.0), errors=(0.7, 2.0), ghosts=(0.3, 1.0),
              confused=0.15, ids_s=10.0),
        {"down_share": 0.05, "lasts_s": 0.8},
    ),
    "radar": (
        known(near=0.8, far=0.65, variances_m2=(0.06, 0.25), lists=(0.4, 0.5), errors=(0.5, 0.8), ghosts=(0.6, 0.4),
              confused=0.3, ids_s=5.0),
        {"down_share": 0.1, "lasts_s": 0.5},
    ),
}  # fmt: skip
"""By name a PEM and the outages of its unit (all chosen)."""


def experiment_of(units: Mapping[str, Any], configurations: Mapping[str, Any], **more: Any) -> dict[str, Any]:
    """An experiment on the crossing. To the unit its ego is an object as any other."""
    return {
        "version": 1, "ego": "none", "units": dict(units), "obstacles": OBSTACLES,
        "configurations": dict(configurations),
        "measure": {
            "objects": {"classes": ["vru"]}, "onset": {"kind": "appears"}, "began": ["log_start", "appeared"],
            "distance_to": "rsu",
        },
    } | more  # fmt: skip


def write_lists(
    recording: cr.Recording, pem: Mapping[str, Any], outages: Mapping[str, float], seed: int, out: Path
) -> Path:
    """A recording with the lists of a unit of this PEM beside its truth, as if they had been recorded."""
    from copem_replay.results.write import MCAP

    unit = {"rsu": PLACE | {"pem": "rsu", "outages": dict(outages)}}
    fed = {"fed": {"units": ["rsu"], "latency_s": DELAY_S, "fusion": {"kind": "union"}}}
    result = cr.run(experiment_of(unit, fed, pems={"rsu": dict(pem)}, seed=seed), recording, jobs=1)
    with tempfile.TemporaryDirectory(dir=out.parent) as folder:
        place = Path(folder) / "results"
        replace(result, exporters=lambda _: [MCAP]).save(place)
        _without_answers(place / "replay.mcap", out)
    return out


def _without_answers(replayed: Path, out: Path) -> None:
    """A copy with the truth and the lists alone, without ids of the truth and times of measurement."""
    with replayed.open("rb") as source, out.open("wb") as target:
        writer = Writer(target)
        writer.start()
        channels: dict[str, int] = {}
        for schema, channel, message in make_reader(source).iter_messages():
            fused = channel.topic.endswith("/fed/objects") or channel.topic.endswith("/fed")
            if schema is None or not (
                schema.name == "osi3.GroundTruth" or (fused and schema.name == "osi3.SensorData")
            ):
                continue
            topic, data = channel.topic, message.data
            if schema.name == "osi3.SensorData":
                topic, data = TOPIC, _anonymous(data)
            if topic not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[topic] = writer.register_channel(topic, channel.message_encoding, number)
            writer.add_message(channels[topic], message.log_time, data, message.publish_time)
        writer.finish()


def _anonymous(payload: bytes) -> bytes:
    data = SensorData.FromString(payload)
    data.ClearField("last_measurement_time")
    for item in [*data.moving_object, *data.stationary_object]:
        item.header.ClearField("ground_truth_id")
    return bytes(data.SerializeToString(deterministic=True))


def fitted_to(path: Path) -> cr.FittedPem:
    """The unit's model as its recorded lists tell it."""
    unit = {"rsu": PLACE | {"recorded": {"topic": TOPIC}}}
    experiment = experiment_of(unit, {"recorded": {"units": ["rsu"]}}, logs=[str(path)])
    study = read_study_to_fit(make_plain_source(experiment), "rsu")
    how = FitOptions(truth="complete", other_gates=False)
    return cr.FittedPem(study.experiment, study.recordings, fit_unit(study.experiment, study.recordings, "rsu", how))


def fitted_unit(logs: Sequence[str], **how: Any) -> cr.FittedPem:
    """The model of the recorded roadside unit by some of its trials."""
    unit = {"at": [0, 0], "height_m": 5, "recorded": {"topic": "mcity.RSU.SensorData"}}
    plan = {
        "version": 1, "logs": list(logs), "ego": "none", "units": {"rsu": unit},
        "configurations": {"recorded": {"units": ["rsu"]}},
        "measure": {"onset": {"kind": "appears"}, "began": ["log_start", "appeared"], "distance_to": "rsu"},
    }  # fmt: skip
    return cr.fit(plan, "rsu", **how)


def declared(fitted: cr.FittedPem, pem: Mapping[str, Any], outages: Mapping[str, float]) -> dict[str, float]:
    """By the name of an estimate the number that was put in, of all that there is one for."""
    [couple], [ghosts], memory = pem["couples"], pem["ghosts"], pem["memory"]
    error, existence = couple["error"], couple["existence"]
    (along, _), (_, across) = error["covariance_m2"]
    found = {
        "delay_s": DELAY_S,
        "detection.memory.share": memory["detection"][0]["share"],
        "detection.memory.correlation_s": memory["detection"][0]["correlation_s"],
        "errors.yaw_sigma_deg": error["yaw_sigma_deg"],
        "errors.speed_sigma_mps": error["speed_sigma_mps"],
        "errors.size_sigma_m": error["size_sigma_m"],
        "errors.memory.position.0.share": memory["position"][0]["share"],
        "errors.memory.position.0.correlation_s": memory["position"][0]["correlation_s"],
        "ids_last_s": pem["tracks"]["lasts_s"],
        "ghosts.sorts.0.in_list": ghosts["in_list"],
        "ghosts.sorts.0.lasts_s": ghosts["lasts_s"],
        "list_times.down_share": outages["down_share"],
        "list_times.lasts_s": outages["lasts_s"],
    }  # fmt: skip
    found |= {f"existence.{k}.{n}": v for k in ("real", "ghost") for n, v in enumerate(existence[k])}
    for true, row in pem["classes"]["confusion"].items():
        found |= {f"classes.confusion.{true}.{name}": share for name, share in row.items()}
    for b in range(len(fitted.found.parts.errors.bins)):
        found |= {f"errors.bins.{b}.mean_m.{k}": 0.0 for k in range(2)}
        found |= {f"errors.bins.{b}.covariance_m2.{k}": v for k, v in enumerate((along, 0.0, across))}
    model = TableDetection.model_validate(couple["detection"])
    for c, one in enumerate(fitted.found.parts.detection.couples):
        if one.azimuth_deg is not None or one.classes is not None or len(one.visible_share) < 2:
            continue  # of an average over what is seen there is no such number
        for i, range_m in enumerate(one.range_m):
            for j, share in enumerate(one.visible_share):
                at = cr.ViewGeometry(*np.array([[range_m], [0], [0], [share], *[[0]] * 6], dtype=float))
                found[f"detection.couples.{c}.probability.{i}.{j}"] = float(model.probability(at)[0])
    return found


def inside(
    fitted: cr.FittedPem, pem: Mapping[str, Any], outages: Mapping[str, float]
) -> dict[str, tuple[Estimate, float]]:
    """By name the estimates of what was put in, and that; of an estimate that the data do not tell, nothing."""
    true, found = declared(fitted, pem, outages), fitted.estimates
    return {name: (found[name], value) for name, value in true.items() if name in found and found[name].why is None}


def elsewhere(fitted: cr.FittedPem, pem: Mapping[str, Any], outages: Mapping[str, float], other: cr.Recording) -> Any:
    """The summary of the true model and of the fitted one on another recording."""
    where = {"at": [190.0, 290.0], "yaw_deg": 45.0, "height_m": 6.0}
    unit = strip_comments(build_unit(fitted.found, fitted.experiment, "fitted")) | where
    data = {
        "version": 1, "runs": 50,
        "pems": {"known": dict(pem), "fitted": strip_comments(build_pem(fitted.found))},
        "units": {"known": where | {"pem": "known", "outages": dict(outages)}, "fitted": unit},
        "configurations": {name: {"units": [name]} for name in ("known", "fitted")},
        "measure": {
            "objects": {"classes": ["vehicles", "vru"]}, "accuracy": True,
            "onset": {"kind": "in_range", "range_m": 60}, "distance_to": "known",
        },
    }  # fmt: skip
    rows = cr.run(data, other, jobs=1).summary.set_index("configuration")
    return rows[["detected_share", "ttd_rmst_s", "position_rmse_m"]]


def coverage_lines(found: Sequence[Mapping[str, tuple[Estimate, float]]]) -> list[str]:
    """A line per number: how often it was told, how often its interval held it, and how wide that was on average."""
    by_name: dict[str, list[tuple[Estimate, float]]] = defaultdict(list)
    for one in found:
        for name, pair in one.items():
            by_name[name].append(pair)
    lines = [f"{'number':<44}{'true':>9}{'told':>6}{'inside':>8}{'mean':>10}{'width':>10}"]
    total, held = 0, 0
    for name, pairs in sorted(by_name.items()):
        count = sum(holds(*pair) for pair in pairs)
        total, held = total + len(pairs), held + count
        true = np.mean([value for _, value in pairs])
        mean = np.mean([estimate.value for estimate, _ in pairs])
        width = np.mean([estimate.high - estimate.low for estimate, _ in pairs])
        lines.append(f"{name:<44}{true:>9.3g}{len(pairs):>6}{count:>8}{mean:>10.3g}{width:>10.3g}")
    return [*lines, f"pooled: {held} of {total} inside, {held / max(total, 1):.3f}"]


def holds(estimate: Estimate, true: float) -> bool:
    """Whether the interval holds the number."""
    return estimate.low <= true <= estimate.high


# Cases drawn at the rows of a fit, by the dice of a replay: intervals of detection and errors, and the replay check.

PERIOD_S, LISTS_EACH, TOGETHER, PAUSE = 0.1, 80, 4, 20


@dataclass(frozen=True)
class Case:
    """A model, how many passes there are, and what a wrong fit of it would leave out (None: nothing)."""

    pem: dict[str, Any]
    passes: int = 24
    wrong: str | None = None
    tails: float | None = None


def _model(detection: Any, error: Any, memory: Any = None, when: Any = None) -> dict[str, Any]:
    couples = [{"when": when, "detection": detection, "error": error}] if when else [
        {"detection": detection, "error": error}
    ]  # fmt: skip
    return {"couples": couples} | ({"memory": memory} if memory else {})


def _table(near: float, far: float) -> dict[str, Any]:
    cells = [[0.2 * near, near], [0.1 * far, far]]
    return {"kind": "table", "range_m": [0, 70], "visible_share": [0, 1], "probability": cells}


def _error(along: float, across: float) -> dict[str, Any]:
    return {"kind": "gaussian", "frame": "line_of_sight", "covariance_m2": [[along, 0.0], [0.0, across]]}


def _either(first: Any, second: Any) -> dict[str, Any]:
    return {"couples": [*first["couples"], *second["couples"]]} | {k: v for k, v in first.items() if k != "couples"}


def _lasting(detection: tuple[float, float] | None, *position: tuple[float, Any]) -> dict[str, Any]:
    parts = [{"share": share, "correlation_s": tau_s} for share, tau_s in position]
    out = {"position": parts} if parts else {}
    return out if detection is None else out | {"detection": [{"share": detection[0], "correlation_s": detection[1]}]}


_CAR, _WALK = {"classes": ["car"]}, {"classes": ["pedestrian"]}
_FAIR, _SMALL = {"kind": "constant", "probability": 0.9}, {"kind": "constant", "probability": 0.27}
_FRONT, _BACK = {"azimuth_deg": [-90, 90]}, {"azimuth_deg": [90, -90]}
CASES: dict[str, Case] = {
    "camera": Case(_model(_table(0.95, 0.5), _error(0.3, 0.08), _lasting((0.7, 1.0), (0.7, 2.0))), 40, "memory"),
    "radar": Case(_model(_table(0.8, 0.65), _error(0.06, 0.25), _lasting((0.4, 0.5), (0.5, 0.8))), 40, "memory"),
    "no memory": Case(_model(_table(0.9, 0.6), _error(0.3, 0.1))),
    "bias only": Case(_model(_table(0.9, 0.6), _error(0.3, 0.1), _lasting(None, (0.6, "always"))), 24, "memory"),
    "strong class effect": Case(
        _either(_model(_FAIR, _error(0.4, 0.2), _lasting(None, (0.5, 0.5)), _CAR),
                _model(_FAIR, _error(0.04, 0.02), None, _WALK)), 40, "class"),
    "few passes": Case(_model(_table(0.9, 0.6), _error(0.3, 0.1), _lasting(None, (0.7, 1.0))), 4),
    "pedestrians .3": Case(_either(_model(_FAIR, _error(0.3, 0.1), None, _CAR),
                                   _model(_SMALL, _error(0.3, 0.1), None, _WALK)), 24, "class"),
    "by azimuth": Case(_either(_model(_FAIR, _error(0.3, 0.1), None, _FRONT),
                               _model(_SMALL, _error(0.3, 0.1), None, _BACK)), 24, "azimuth"),
    "misses of all": Case(
        _model({"kind": "constant", "probability": 0.6}, _error(0.3, 0.1),
               {"detection": [{"share": 0.7, "correlation_s": 5.0, "of": "unit"}]}), 48, "common"),
    "t3": Case(_model(_table(0.9, 0.6), _error(0.3, 0.1)), 24, "tails", tails=3.0),
}  # fmt: skip
"""By name the cases (all chosen)."""


def drawn_rows(case: Case, seed: int) -> tuple[FitRows, FitLists]:
    """Cars and pedestrians that pass by a unit at (0, 0), four at a time, as the case's model lists them."""
    P, m = case.passes, LISTS_EACH
    n, pass_ix = P * m, np.repeat(np.arange(case.passes), LISTS_EACH)
    rng = np.random.default_rng(seed)
    list_ix = (pass_ix // TOGETHER) * (m + PAUSE) + np.tile(np.arange(m), P)
    way = np.linspace(-1, 1, m) * rng.uniform(30, 55, (P, 1)) * np.where(np.arange(P) % 4 < 2, 1, -1)[:, None]
    aside = np.broadcast_to(rng.uniform(3, 15, (P, 1)), way.shape)
    x, y = way.ravel(), aside.ravel()
    wave = np.clip(0.8 + 0.8 * np.sin(rng.uniform(0, 6, (P, 1)) + np.arange(m) / 12), 0, 1).ravel()
    bearing, one, gone = np.arctan2(y, x), np.ones(n), np.full(n, np.nan)
    kind = np.array([CLASSES.index("car"), CLASSES.index("pedestrian")], dtype=np.int8)[pass_ix % 2]
    view = cr.ViewGeometry(np.hypot(x, y), bearing, bearing, wave, kind, one, one, one, 0 * one, 5 * one)
    L = int(list_ix.max()) + 1
    at_s, none = PERIOD_S * np.arange(L), np.full(n, -1)
    lists = FitLists(np.zeros(L, dtype=int), at_s, *np.zeros((3, L)), np.zeros(L, dtype=int))
    rows = FitRows(
        list=list_ix, log=0 * list_ix, object=pass_ix, pass_ix=pass_ix, captured_s=at_s[list_ix], view=view,
        state_m=np.stack([x, y], axis=1), listed=one > 0, along_m=gone, across_m=gone, east_m=gone, north_m=gone,
        yaw_rad=gone, speed_mps=gone, size_m=np.full((3, n), np.nan), class_ix=none, existence=gone, track_id=none,
        fold=pass_ix % 5,
    )  # fmt: skip
    run = np.array([seed])
    listed, along_m, across_m = (one[0] for one in simulate_lists(Pem.model_validate(case.pem), rows, lists, run, 0))
    if case.tails is not None:
        factor = np.sqrt((case.tails - 2) / rng.chisquare(case.tails, n))
        along_m, across_m = along_m * factor, across_m * factor
    along_m, across_m = (np.where(listed, error_m, np.nan) for error_m in (along_m, across_m))
    cos, sin = np.cos(bearing), np.sin(bearing)
    east_m, north_m = cos * along_m - sin * across_m, sin * along_m + cos * across_m
    found = {"listed": listed, "along_m": along_m, "across_m": across_m, "east_m": east_m, "north_m": north_m}
    return FitRows(**{**vars(rows), **found}), lists


def drawn_pairs(case: Case, detection: DetectionFit, errors: ErrorFit) -> Iterator[tuple[str, Estimate, float]]:
    """Kind, estimate and true number of all that there is a true number of."""
    for couple in detection.couples:
        for (i, range_m), (j, share) in product(enumerate(couple.range_m), enumerate(couple.visible_share)):
            true = _true_probability(case, couple, range_m, share)
            if true is not None:
                yield "probability", couple.probability[i][j], true
    held = case.pem.get("memory", {}).get("detection")
    if held and detection.memory is not None:
        yield "detection share", detection.memory.share, held[0]["share"]
        yield "detection τ", detection.memory.correlation_s, held[0]["correlation_s"]
    for one in errors.bins:
        kind = getattr(one.where, "of_class", None)
        of = [
            c["error"]["covariance_m2"]
            for c in case.pem["couples"]
            if kind in (None, *c.get("when", {}).get("classes", [kind]))
        ]
        (xx, _), (_, yy) = np.mean(of, axis=0)
        yield from (("mean", mean, 0.0) for mean in one.mean_m)
        yield from (("variance", one.covariance_m2[k], true) for k, true in ((0, xx), (2, yy)))
        yield "covariance", one.covariance_m2[1], 0.0
    parts = case.pem.get("memory", {}).get("position", [])
    for part in errors.memory.get("position", ()):
        always = isinstance(part.correlation_s, str)
        for true in (one for one in parts if (one["correlation_s"] == "always") == always):
            yield "constant share" if always else "drift share", part.share, true["share"]
            if not isinstance(part.correlation_s, str):
                yield "drift τ", part.correlation_s, true["correlation_s"]
    if case.tails is not None and getattr(errors.shape, "written", False):
        yield "degrees of freedom", errors.shape.degrees_of_freedom, case.tails


def _true_probability(case: Case, couple: DetectionCouple, range_m: float, share: float) -> float | None:
    """The true probability at a node; None where the fitted table averages over what it depends on."""
    models = []
    for one in case.pem["couples"]:
        when = one.get("when", {})
        if "classes" in when and couple.classes is not None and when["classes"] != list(couple.classes):
            continue
        if "azimuth_deg" in when and couple.azimuth_deg is not None:
            low, high = (np.clip(edge, -180, 180) for edge in couple.azimuth_deg)
            front = when["azimuth_deg"][0] < 0
            if (front and low >= 90) or (not front and high <= 90):
                continue
        models.append(one["detection"])
    if not models or any(one != models[0] for one in models):
        return None
    if models[0]["kind"] == "constant":
        return float(models[0]["probability"])
    if len(couple.visible_share) < 2 or len(couple.range_m) < 2:
        return None
    at = cr.ViewGeometry(*np.array([[range_m], [0], [0], [share], *[[0]] * 6], dtype=float))
    return float(TableDetection.model_validate(models[0]).probability(at)[0])


def fitted_pem(detection: DetectionFit, errors: ErrorFit, *, wrong: str | None = None) -> Pem:
    """The model that a fit writes; `wrong`: without what that word names."""
    couples = [
        {"when": one.when | error.where.when, "detection": one.model(), "error": errors.error_keys(error)}
        for one, error in product(detection.couples, errors.bins)
        if one.classes is None or error.where.of_class in (None, *one.classes)
    ]
    memory = errors.memory_keys() | detection.memory_keys()
    keys = {"couples": couples} | ({"memory": memory} if memory and wrong != "memory" else {})
    return Pem.model_validate(strip_comments(keys))


def refuses(pem: Pem, rows: FitRows, lists: FitLists) -> bool:
    """Whether the replay check refuses a model."""
    checks = replay_check(pem, rows, lists, runs=400)
    return ReplayChecks(False, checks, ()).fails


def wrong_fit(case: Case, rows: FitRows, lists: FitLists) -> tuple[DetectionFit, ErrorFit]:
    """The fit that leaves out what the case has, or takes it for memory of single objects."""
    view = rows.view
    if case.wrong == "class":
        rows = replace(rows, view=replace(view, class_ix=0 * view.class_ix))
    if case.wrong == "azimuth":
        rows = replace(rows, view=replace(view, azimuth_rad=0 * view.azimuth_rad))
    if case.wrong == "common":
        rows = replace(rows, list=np.arange(len(rows.list)))
    detection, errors = fit_detection(rows, intervals=False), fit_errors(rows)
    if case.wrong == "tails":
        errors = replace(errors, shape=replace(errors.shape, heavier=False))
    return detection, errors


def check_rows(seeds: int, names: Sequence[str], replays: int) -> list[str]:
    """A line per case and kind of number: how often its interval holds it, its median width, and the replay checks.

    `replays`: of how many recordings of each case the fit is replayed.
    """
    lines = [f"{'case':<21}{'number':<20}{'told':>6}{'inside':>8}{'share':>7}{'least':>7}{'width':>10}"]
    pooled: dict[str, list[bool]] = defaultdict(list)
    for name in names or CASES:
        case, found, refused, memories = CASES[name], defaultdict(list), np.zeros(2, dtype=int), 0
        for seed in range(seeds):
            rows, lists = drawn_rows(case, seed)
            detection, errors = fit_detection(rows), fit_errors(rows)
            for kind, estimate, true in drawn_pairs(case, detection, errors):
                if estimate.why is None:
                    found[kind].append((holds(estimate, true), estimate.high - estimate.low))
            memories += (detection.memory is not None) and "detection" not in case.pem.get("memory", {})
            if seed < replays:
                refused[0] += refuses(fitted_pem(detection, errors), rows, lists)
                if case.wrong is not None:
                    refused[1] += refuses(fitted_pem(*wrong_fit(case, rows, lists), wrong=case.wrong), rows, lists)
        for kind, pairs in found.items():
            held = [inside for inside, _ in pairs]
            pooled[kind] += held
            width = float(np.median([far for _, far in pairs]))
            lines.append(_coverage_line(name, kind, held) + f"{width:>10.3g}")
        lines.append(
            f"{name:<21}false memory of detection: {memories} of {seeds}; of {min(seeds, replays)} refused: "
            f"right model {refused[0]}, without {case.wrong} {refused[1]}"
        )
        print(lines[-1], file=sys.stderr, flush=True)
    return [*lines, *(_coverage_line("all", kind, held) for kind, held in pooled.items())]


def _coverage_line(name: str, kind: str, held: Sequence[bool]) -> str:
    """`least`: .92 less two standard errors of a share of .92."""
    n = len(held)
    least = 0.92 - 2 * np.sqrt(0.92 * 0.08 / n)
    return f"{name:<21}{kind:<20}{n:>6}{sum(held):>8}{np.mean(held):>7.3f}{least:>7.3f}"


# Numbers over logs.

LOGS, TAUS = (3, 4, 8, 20), (0.0, 0.1, 0.3, 1.0)
"""How many logs there are, and by how much (m) what they tell differs between them."""
PRECISION = {"equal": (0.3, 0.3), "unequal": (0.1, 0.6), "estimated": (0.1, 0.6)}
"""Standard deviations (m) of what the logs tell: evenly between these in their logarithm; `estimated`: their squares
are known by ten degrees of freedom each.
"""


def drawn_logs(logs: int, tau: float, precision: str, seed: int) -> dict[str, tuple[Estimate, float]]:
    """By kind the estimate and the true number of logs that tell 0 each, but for their variance and τ."""
    rng = np.random.default_rng([seed, logs])
    sigma = np.geomspace(*PRECISION[precision], logs)
    known = rng.chisquare(10, logs) / 10 if precision == "estimated" else 1.0
    found = pool_logs(tau * rng.normal(size=logs) + sigma * rng.normal(size=logs), known * sigma**2, logs)
    return {"mean": (found.mean, 0.0), "between": (found.between, tau)}


def check_logs(draws: int) -> list[str]:
    """A line per number of logs, τ, precision and kind: how often the interval holds, and its median width."""
    lines = [f"{'logs, τ, precision':<21}{'number':<20}{'told':>6}{'inside':>8}{'share':>7}{'least':>7}{'width':>10}"]
    for logs, tau, precision in product(LOGS, TAUS, PRECISION):
        found = [drawn_logs(logs, tau, precision, seed) for seed in range(draws)]
        for kind in found[0]:
            held = [holds(*one[kind]) for one in found]
            width = float(np.median([one[kind][0].high - one[kind][0].low for one in found]))
            lines.append(_coverage_line(f"{logs:>2}, {tau:g} m, {precision}", kind, held) + f"{width:>10.3g}")
    return lines


# A recorded unit by splits of its trials.

SPLITS = (
    ("3", "4", "5"),
    ("14", "15"),
    ("4", "14"),
    ("3", "5", "15"),
    ("3", "4", "5", "11_ped"),
    ("4", "5", "14", "15"),
)
"""Trials that are fitted (all chosen); a number of one split is held against that of the trials that it has not."""


def check_splits(shared: Path) -> list[str]:
    """A line per split and mean or variance: its interval, and whether it and that of the other trials overlap."""
    trials = ("3", "4", "5", "11_ped", "14", "15")
    lines = [f"{'fitted to':<18}{'number':<24}{'interval':<22}{'of the others':<22}"]
    for split in SPLITS:
        both = []
        for names in (split, tuple(one for one in trials if one not in split)):
            fitted = fitted_unit([str(shared / f"msight_trial{name}.mcap") for name in names])
            both.append(fitted.found.parts.errors)
        for k, axis in enumerate(("along", "across")):
            for what, of in (("mean", "mean_m"), ("variance", "covariance_m2")):
                pair = [getattr(errors.bins[-1], of)[k if of == "mean_m" else 2 * k] for errors in both]
                apart = pair[0].low > pair[1].high or pair[1].low > pair[0].high
                lines.append(
                    f"{' '.join(split):<18}{f'{what} {axis}':<24}{describe_interval(pair[0]):<22}"
                    f"{describe_interval(pair[1]):<22}{'apart' if apart else ''}"
                )
    return lines


def describe_interval(one: Estimate) -> str:
    """The limits of an estimate."""
    return f"{one.low:.3g} … {one.high:.3g}"


def main() -> None:
    """Print the table of each known model, of the cases that are drawn, of logs, or of the splits."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("what", nargs="?", choices=["models", "rows", "logs", "splits"], default="models")
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument(
        "--replays", type=int, default=20, help="of so many seeds of each case the fit is replayed [20]"
    )
    parser.add_argument("--models", nargs="*", choices=list(KNOWN), default=list(KNOWN))
    parser.add_argument("--cases", nargs="*", choices=list(CASES), default=list(CASES))
    options = parser.parse_args()
    if options.what == "rows":
        print(*check_rows(options.seeds, options.cases, options.replays), sep="\n")
        return
    if options.what == "logs":
        print(*check_logs(options.seeds), sep="\n")
        return
    if options.what == "splits":
        print(*check_splits(ROOT.parent / "shared/data"), sep="\n")
        return
    recording = ROOT / "logs/crossing.mcap"
    with tempfile.TemporaryDirectory() as folder:
        other = another(Path(folder))
        for name in options.models:
            found, off = [], []
            for seed in range(options.seeds):
                path = write_lists(recording, *KNOWN[name], seed, Path(folder) / f"{name}.mcap")
                fitted = fitted_to(path)
                found.append(inside(fitted, *KNOWN[name]))
                rows = elsewhere(fitted, *KNOWN[name], other)
                off.append(rows.loc["fitted"] - rows.loc["known"])
                off[-1][["ttd_rmst_s", "position_rmse_m"]] /= rows.loc["known", ["ttd_rmst_s", "position_rmse_m"]]
                print(f"{name} seed {seed}: {off[-1].round(3).to_dict()}", file=sys.stderr)
            print(f"\n{name}, {options.seeds} seeds", *coverage_lines(found), sep="\n")
            for column, limit in (("detected_share", 0.03), ("ttd_rmst_s", 0.1), ("position_rmse_m", 0.1)):
                each = np.array([one[column] for one in off])
                near = int((np.abs(each) <= limit).sum())
                print(f"elsewhere, {column}: median off {np.median(each):+.3f}, {near} of {len(each)} within {limit}")


def another(folder: Path) -> cr.Recording:
    """A recording of other traffic: a minute of the city."""
    from tools.make_logs import main as make_logs

    arguments, sys.argv = sys.argv, ["make_logs", "--long", "--minutes", "1", "--objects", "40", "--out", str(folder)]
    try:
        make_logs()
    finally:
        sys.argv = arguments
    return cr.read_recording(folder / "city.mcap")


if __name__ == "__main__":
    main()

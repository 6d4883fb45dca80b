"""Hold what `copem-replay fit` estimates against what was put in.

A known perception error model is replayed on a recording, its lists are written to MCAP, and a copy of that without
truth ids and without the times of measurement is fitted. Printed: how often each declared number is inside its 95 %
interval, how wide that is, and what the fitted model gives on another recording beside the true one.

    python tools/check_fit.py --seeds 40
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer
from osi3.osi_sensordata_pb2 import SensorData

import copem_replay as cr
from copem_replay.api.fit import read_study_to_fit
from copem_replay.core.yaml import strip_comments
from copem_replay.experiment.file import make_plain_source
from copem_replay.fitting.estimate import Estimate
from copem_replay.fitting.fit import FitOptions, build_pem, build_unit, fit_unit
from copem_replay.perception.pem.detection import TableDetection

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
        "measure": {"objects": {"classes": ["vru"]}, "onset": {"kind": "appears"}, "distance_to": "rsu"},
    } | more  # fmt: skip


def write_lists(
    recording: cr.Recording, pem: Mapping[str, Any], outages: Mapping[str, float], seed: int, out: Path
) -> Path:
    """A recording with the lists of a unit of this PEM beside its truth, as if they had been recorded."""
    from copem_replay.results.write import MCAP, write_results

    unit = {"rsu": PLACE | {"pem": "rsu", "outages": dict(outages)}}
    fed = {"fed": {"units": ["rsu"], "latency_s": DELAY_S, "fusion": {"kind": "union"}}}
    result = cr.run(experiment_of(unit, fed, pems={"rsu": dict(pem)}, seed=seed), recording, jobs=1)
    with tempfile.TemporaryDirectory(dir=out.parent) as folder:
        place = Path(folder) / "results"
        write_results(place, result.experiment, result.recordings, result.replayed, exporters=[MCAP])
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
        "measure": {"onset": {"kind": "appears"}, "distance_to": "rsu"},
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


def main() -> None:
    """Print the table of each known model."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--models", nargs="*", choices=list(KNOWN), default=list(KNOWN))
    options = parser.parse_args()
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

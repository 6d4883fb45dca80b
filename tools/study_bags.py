"""The bags of docs/guide/study.md: `logs/crossing.mcap` as a vehicle and a roadside unit would have recorded it.

    python tools/make_logs.py --bags --out out/bags

`ego.mcap` has the truth, the vehicle's own lists, and the output of its stack, a tracker that hears the roadside unit
by radio. `rsu.mcap` has the unit's lists alone, by a clock that is ahead, at a rate of its own. Every list comes from a
perception error model whose errors last. What is put in here is what the study has to find out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from osi3.osi_groundtruth_pb2 import GroundTruth
from osi3.osi_sensordata_pb2 import SensorData

import copem_replay as cr
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.io.open import open_log
from copem_replay.io.write.osi import NANOS_PER_SECOND, OsiTrace, SensorDataWriter, write_osi_trace

CROSSING: Final = Path(__file__).resolve().parents[1] / "logs" / "crossing.mcap"

CLOCK_AHEAD_S: Final = 0.13  # the roadside unit's clock against the vehicle's
EGO_DELAY_S: Final = 0.07  # the vehicle's lists are stamped when they are sent, and do not say when they were captured
RSU_DELAY_S: Final = 0.09  # the roadside unit's say both
STACK_STEP_S: Final = 0.1  # the stack publishes so often, the newest list of its tracker
STACK_AGE_S: Final = 0.025  # whose states are on average so much older: 0.03 s, 0.005 s where the unit's came since
STACK_LATENCY_S: Final = 0.04  # and are logged so long after it
RADIO_S: Final = 0.1  # in neither bag: how long the roadside unit's lists take to the vehicle

_MEMORY: Final = {
    "detection": [{"share": 0.8, "correlation_s": 1.0}],
    "position": [{"share": 0.6, "correlation_s": 2.0}, {"share": 0.2, "correlation_s": "always"}],
    "speed": [{"share": 0.6, "correlation_s": 2.0}],
}


def _couple(range_m: list[float], ahead_deg: float, across_m2: list[list[float]], detection: Any) -> dict[str, Any]:
    error = {"kind": "gaussian", "frame": "line_of_sight", "covariance_m2": across_m2, "speed_sigma_mps": 0.4}
    when = {"range_m": range_m, "azimuth_deg": [-ahead_deg, ahead_deg]}
    return {"when": when, "detection": detection, "error": error}


def _ghosts(in_list: float) -> list[dict[str, Any]]:
    where = {"kind": "field", "range_m": [3, 50], "azimuth_deg": [-60, 60]}
    return [{"in_list": in_list, "lasts_s": 1.0, "where": where, "classes": {"pedestrian": 1.0}, "existence": 0.5}]


_SEEN: Final = {"kind": "visible_share"}
_CAMERA: Final = {
    "kind": "table", "range_m": [0, 40, 70], "visible_share": [0.1, 0.5, 1],
    "probability": [[0.0, 0.6, 0.9], [0.0, 0.3, 0.6], [0.0, 0.0, 0.1]],
}  # fmt: skip
PLAN: Final[dict[str, Any]] = {
    "version": 1,
    "runs": 1,
    "seed": 17,
    "pems": {
        "onboard": {
            "couples": [
                _couple([0, 80], 60, [[0.5, 0.0], [0.0, 0.1]], _SEEN),
                _couple([0, 30], 180, [[0.3, 0.0], [0.0, 0.1]], _SEEN),
            ],
            "memory": _MEMORY,
            "ghosts": _ghosts(0.05),
            "tracks": {"lasts_s": 30},
        },
        "camera": {
            "couples": [_couple([0, 70], 60, [[0.6, 0.0], [0.0, 0.3]], _CAMERA)],
            "memory": _MEMORY,
            "ghosts": _ghosts(0.1),
            "tracks": {"lasts_s": 30},
        },
    },
    "units": {
        "ego": {"on": "ego", "height_m": 1.6, "pem": "onboard"},
        "rsu": {"at": [12.4, 12.4], "yaw_deg": -135, "height_m": 6.0, "pem": "camera", "rate_hz": 8, "phase_s": 0.03},
    },
    "obstacles": [
        {"polygon_m": [[14, 14], [60, 14], [60, 40], [14, 40]], "height_m": 14},
        {"polygon_m": [[-70, 14], [-14, 14], [-14, 60], [-26, 60], [-26, 26], [-70, 26]], "height_m": 12},
        {"polygon_m": [[14, -34], [50, -34], [50, -14], [14, -14]], "height_m": 9},
    ],
    "configurations": {
        "ego": {"units": ["ego"], "fusion": {"kind": "union"}},
        "rsu": {"units": ["rsu"], "fusion": {"kind": "union"}},
        "stack": {
            "units": ["ego", "rsu"],
            "latency_s": {"ego": EGO_DELAY_S, "rsu": RSU_DELAY_S + RADIO_S},
            "fusion": {"kind": "tracker"},
        },
    },
}


def bags(clock_ahead_s: float = CLOCK_AHEAD_S) -> dict[str, OsiTrace]:
    """Return both bags by the names of their files."""
    fused = cr.fused_tracks(PLAN, CROSSING)
    ahead_ns, steps = _ns(clock_ahead_s), (int(_END_S / STACK_STEP_S) + 1)
    ego = [
        *_truth(),
        *_lists("ego/objects", fused["ego"], late_ns=_ns(EGO_DELAY_S), says_capture=False),
        *_lists("stack/objects", fused["stack"], at_s=np.arange(1, steps) * STACK_STEP_S, says_capture=False),
    ]
    rsu = _lists("rsu/objects", fused["rsu"], late_ns=_ns(RSU_DELAY_S), ahead_ns=ahead_ns)
    about = OsiTrace(
        source="synthetic (tools/study_bags.py)",
        description="",
        topics={
            "ground_truth": "osi3.GroundTruth, 10 Hz: all road users",
            "ego/objects": "osi3.SensorData, 10 Hz: what the vehicle itself perceives",
            "stack/objects": "osi3.SensorData, 10 Hz: what its stack makes of that and of what the unit sends",
            "rsu/objects": "osi3.SensorData, 8 Hz: what the roadside unit perceives",
        },
        messages=(),
        logged_after_ns={"stack/objects": _ns(STACK_LATENCY_S)},
    )
    return {
        "ego": replace(about, description="The vehicle's bag.", messages=_in_order(ego)),
        "rsu": replace(about, description="The roadside unit's bag, by its own clock.", messages=_in_order(rsu)),
    }


def write_bags(folder: Path, clock_ahead_s: float = CLOCK_AHEAD_S) -> None:
    """Write both bags; the folder is made where there is none."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, bag in bags(clock_ahead_s).items():
        write_osi_trace(bag, folder / f"{name}.mcap")


_END_S: Final = 60.0


def _truth() -> Iterator[tuple[str, GroundTruth]]:
    log = open_log(CROSSING)
    for message in log.messages({c.number for c in log.channels}):
        yield "ground_truth", GroundTruth.FromString(message.data)


def _lists(
    topic: str,
    tracks: FusedTracks,
    *,
    at_s: np.ndarray | None = None,
    late_ns: int = 0,
    ahead_ns: int = 0,
    says_capture: bool = True,
) -> Iterator[tuple[str, SensorData]]:
    """The lists as messages, stamped `late_ns` after they were made; `at_s`: the newest at each of these instants."""
    assert tracks.scene is not None
    writer = SensorDataWriter(tracks.scene, tracks, {name: k + 1 for k, name in enumerate(tracks.received.units)})
    made_ns = np.rint(tracks.fused.arrives_s[0] * NANOS_PER_SECOND).astype(np.int64)
    which, stamps_ns = np.arange(len(made_ns)), made_ns + late_ns
    if at_s is not None:
        stamps_ns = np.rint(at_s * NANOS_PER_SECOND).astype(np.int64)
        which = np.searchsorted(made_ns, stamps_ns, side="right") - 1
    lists = list(writer.messages(made_ns))
    for frame, stamp_ns in zip(which.tolist(), (stamps_ns + ahead_ns).tolist(), strict=True):
        if frame < 0:
            continue
        message = SensorData.FromString(lists[frame])
        message.timestamp.seconds, message.timestamp.nanos = divmod(stamp_ns, NANOS_PER_SECOND)
        message.ClearField("last_measurement_time")
        if says_capture:
            captured_ns = int(made_ns[frame]) + ahead_ns
            message.last_measurement_time.seconds, message.last_measurement_time.nanos = divmod(captured_ns, 10**9)
        for item in [*message.moving_object, *message.stationary_object]:
            item.header.ClearField("ground_truth_id")  # no unit knows it
            item.header.ClearField("sensor_id")
        yield topic, message


def _in_order(messages: Any) -> list[tuple[str, Any]]:
    return sorted(messages, key=lambda one: (one[1].timestamp.seconds, one[1].timestamp.nanos, one[0]))


def _ns(seconds: float) -> int:
    return round(seconds * NANOS_PER_SECOND)

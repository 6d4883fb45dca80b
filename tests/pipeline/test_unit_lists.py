"""Lists of units in replay.mcap: another fusion is given what ours got, and ours then gives the same again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from mcap.reader import make_reader
from osi3.osi_sensordata_pb2 import SensorData

import copem_replay as cr
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import VALUES
from copem_replay.experiment.schema import Experiment

ROOT = Path(__file__).parents[2]
GAUSSIAN = {"kind": "gaussian", "covariance_m2": [[0.2, 0.05], [0.05, 0.1]], "yaw_sigma_deg": 2, "speed_sigma_mps": 0.3}
PEM: dict[str, Any] = {
    "couples": [
        {"when": {"range_m": [2, 60], "azimuth_deg": [-60, 60]}, "detection": {"kind": "visible_share"},
         "error": GAUSSIAN, "existence": {"kind": "scores", "real": [8, 2], "ghost": [2, 4]}},
        {"when": {"range_m": [5, 30]}, "detection": {"kind": "constant", "probability": 0.9}, "error": GAUSSIAN},
    ],
    "ghosts": [{"in_list": 0.5, "lasts_s": 0.5, "where": {"kind": "places", "at_m": [[-60, 20]], "spread_m": 3.0}}],
    "tracks": {"lasts_s": 1.0},
}  # fmt: skip
UNITS = {
    "car": {"on": "ego", "height_m": 1.8, "pem": "any"},
    "mast": {"at": [0.0, 9.0], "yaw_deg": -90.0, "height_m": 5.0, "rate_hz": 5.0, "pem": "any"},
}
GNN = {"units": ["car", "mast"], "fusion": {"kind": "gnn"}}


def run(folder: Path, log: Path, units: dict[str, Any], **more: Any) -> dict[str, Any]:
    pems = {"pems": {"any": PEM}} if any("pem" in unit for unit in units.values()) else {}
    data = {"version": 1, "logs": [str(log)], "runs": 1, "units": units, "configurations": {"gnn": GNN}, **pems, **more}
    cr.run(data, out=folder)
    return data

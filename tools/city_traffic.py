"""The long drive's city with houses, masts and connected cars, for pictures: 80 road users at all times.

The recording is that of `tools/city.py`; the experiment asks when an ego that drives through it knows of what is 35 m
away, alone and with others' help. Houses stand at the corners of the blocks, but not in the ego's way.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from city import EGO_RADIUS_M, MIDDLE_M, SPACING_M, STREETS
from copem_replay.io.write.osi import write_osi_trace
from make_logs import long_drive

MINUTES, OBJECTS = 0.5, 80
HOUSE_M, KERB_M, BESIDE_M = 26.0, 11.0, 8.0
"""Sides of a house, from the middle of the street to its wall, and the room that the ego needs."""


def write(folder: Path) -> Path:
    """Write the recording into a folder; its path."""
    path = folder / "city.mcap"
    write_osi_trace(long_drive(MINUTES, OBJECTS), path)
    return path


def experiment(path: Path) -> dict[str, Any]:
    """The experiment with the recording at `path`, as in a file."""
    error = {"kind": "gaussian", "frame": "line_of_sight", "covariance_m2": [[0.5, 0.0], [0.0, 0.2]]}
    seen = {"detection": {"kind": "visible_share"}, "error": error}
    masts = {
        f"mast{k + 1}": {"at": list(at), "yaw_deg": yaw, "height_m": 6.0, "ground_z_m": 0.0, "pem": "roadside"}
        for k, (at, yaw) in enumerate([((308.0, 308.0), -135.0), ((208.0, 308.0), -45.0)])
    }
    late = {"kind": "ideal"}
    helped = ["ego", *masts]
    return {
        "version": 1,
        "logs": [str(path)],
        "runs": 4,
        "pems": {
            "onboard": [{"when": {"range_m": [0, 70], "azimuth_deg": [-40, 40]}} | seen],
            "roadside": [{"when": {"range_m": [0, 45]}} | seen],
            "connected": [{"when": {"range_m": [0, 40]}} | seen],
        },
        "units": {
            "ego": {"on": "ego", "height_m": 1.6, "pem": "onboard"},
            **masts,
            "cars": {"on": {"classes": ["car"], "penetration_rate": 0.2}, "height_m": 1.6, "pem": "connected"},
        },
        "obstacles": houses(),
        "configurations": {
            "GT": {"units": "truth"},
            "ego": {"units": ["ego"], "latency_s": 0.1},
            "masts": {"units": helped, "latency_s": 0.2, "fusion": late},
            "masts 1 s late": {"units": helped, "latency_s": 1.0, "fusion": late},
            "masts and cars": {"units": "all", "latency_s": 0.3, "fusion": late},
        },
        "measure": {
            "objects": {"classes": ["pedestrian", "car"]},
            "onset": {"kind": "in_range", "range_m": 35},
            "accuracy": False,
        },
        "show": {"run": "median"},
    }


def houses() -> list[dict[str, Any]]:
    """Four in every block, those left out that the ego would touch."""
    found = []
    blocks = [(SPACING_M * i, SPACING_M * j) for i in range(STREETS - 1) for j in range(STREETS - 1)]
    for x, y in blocks:
        near, far = KERB_M, SPACING_M - KERB_M - HOUSE_M
        for dx, dy in ((near, near), (far, near), (far, far), (near, far)):
            at = (x + dx, y + dy)
            corners = [[at[0] + a * HOUSE_M, at[1] + b * HOUSE_M] for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]
            away = [math.hypot(cx - MIDDLE_M, cy - MIDDLE_M) - EGO_RADIUS_M for cx, cy in corners]
            if min(away) > BESIDE_M or max(away) < -BESIDE_M:
                found.append({"polygon_m": corners, "height_m": 9.0, "ground_z_m": 0.0})
    return found

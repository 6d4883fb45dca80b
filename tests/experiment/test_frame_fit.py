"""Turn and offset that fixes beside an odometry say: against the frame that the fixes were made with."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from copem_replay.cli.main import app
from copem_replay.core.frame import Frame
from copem_replay.experiment.draft.frame_fit import FIXES, FrameFit, fit_fixes, fit_frame
from copem_replay.io.open import open_log
from copem_replay.io.recording import read_log
from tests.helpers import ros2
from tests.helpers.recordings import Obj, Topic, ns, write_recording

TRUE = Frame("EPSG:25832", (691_000.0, 5_334_000.0), math.radians(-100.0))
TIMES_S = [0.05 + 0.2 * k for k in range(20)]


def way(t_s: float) -> tuple[float, float]:
    return 12.0 * t_s, 3.0 + 2.0 * t_s


def fixes(kind: str, speed: float = 1.0) -> Topic:
    """A topic of fixes on the ego's way, two of them without a fix."""
    messages: list[tuple[float, Any]] = []
    for t_s in TIMES_S:
        lat, lon = TRUE.to_wgs84([way(t_s * speed)])[0].tolist()
        if kind.startswith("foxglove"):
            messages.append((t_s, {"timestamp": {"sec": int(t_s), "nsec": round(t_s % 1 * 1e9)},
                                   "latitude": lat, "longitude": lon}))  # fmt: skip
        elif kind.startswith("geographic"):
            stamp = {"sec": int(t_s), "nanosec": round(t_s % 1 * 1e9)}
            place = {"latitude": lat, "longitude": lon, "altitude": 500.0}
            messages.append((t_s, {"header": {"stamp": stamp}, "pose": {"position": place}}))
        else:
            status = ros2.made("sensor_msgs/msg/NavSatStatus", status=0)
            where = {"latitude": lat, "longitude": lon, "status": status}
            messages.append((t_s, ros2.made(kind, header=ros2.header(t_s, "gps"), **where)))
    if kind.startswith(("foxglove", "geographic")):
        return Topic("/gps", kind, [(ns(t_s), json.dumps(one).encode()) for t_s, one in messages], "json")
    none = ros2.made("sensor_msgs/msg/NavSatStatus", status=-1)
    messages.append((1.0, ros2.made(kind, header=ros2.header(1.0, "gps"), latitude=10.0, status=none)))
    messages.append((1.1, ros2.made(kind, header=ros2.header(1.1, "gps"), latitude=math.nan)))
    return ros2.topic("/gps", kind, sorted(messages, key=lambda one: one[0]))


def drive(folder: Path, *more: Topic, speed: float = 1.0) -> Path:
    frames = [(0.1 * k, [Obj(1, *way(0.1 * k * speed), vx=12.0), Obj(2, 9.0, 9.0)]) for k in range(41)]
    return write_recording(folder / "drive.mcap", frames, host=1, more=more)


@pytest.mark.parametrize(
    "kind", ["sensor_msgs/msg/NavSatFix", "foxglove.LocationFix", "geographic_msgs/msg/GeoPoseStamped"]
)
def test_the_frame_of_the_fixes_is_found(tmp_path: Path, kind: str) -> None:
    """UTM's scale there is 1.00005: the middle of 50 m is 1 cm nearer than in the local projection."""
    path = drive(tmp_path, fixes(kind))
    (fit,) = fit_fixes(open_log(path), read_log(path, name="drive"))
    assert (fit.topic, fit.fixes) == ("/gps", len(TIMES_S))
    corners = [(0.0, 0.0), (48.0, 11.0), (9.0, 9.0)]
    assert fit.frame.take(TRUE, corners) == pytest.approx(np.array(corners), abs=0.02)
    assert fit.residual_m < 0.003
    said = CliRunner().invoke(app, ["info", str(path)]).output
    lat, lon = TRUE.to_wgs84([way(0.05)])[0]
    assert "not say where on earth it is); 20 fixes of /gps, over 46 m that the ego gets around fit `frame: " in said
    assert f"{{proj: {{at_wgs84: [{lat:.7f}, {lon:.7f}]}}, offset_m: [" in said
    assert "not applied" in said


def test_fixes_without_pyproj_are_not_passed_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyproj", None)
    speed = 1.3  # a place of its own: projections that were made before stay
    path = drive(tmp_path, fixes("foxglove.LocationFix", speed), speed=speed)
    said = CliRunner().invoke(app, ["info", str(path)]).output
    assert "; its fixes cannot be used: places on earth need pyproj: `pip install 'copem-replay[maps]'`" in said


def test_a_car_that_stands_tells_no_turn(tmp_path: Path) -> None:
    path = drive(tmp_path, fixes("foxglove.LocationFix", speed=0.2), speed=0.2)
    said = CliRunner().invoke(app, ["info", str(path)]).output
    assert "20 fixes of /gps, over 9 m that the ego gets around: turn not determined, expected 20 m or more" in said


def test_the_interval_holds_the_true_turn() -> None:
    """Of 200 fits with 1 m of independent error 95 % hold it: by the binomial law 180 to 199 do."""
    rng, at_m = np.random.default_rng(1), np.array([way(t_s) for t_s in TIMES_S])
    turned = Frame("EPSG:25832", (500_000.0, 5_334_000.0), math.radians(20.0))  # on the meridian: grid north is true
    holds = 0
    for _ in range(200):
        noisy = turned.project(at_m) + rng.normal(size=at_m.shape)
        fit = fit_frame("/gps", Frame("EPSG:25832").to_wgs84(noisy), at_m)
        holds += abs(math.degrees(fit.frame.yaw_rad) - 20.0) <= fit.turn_deg
    assert 180 <= holds <= 199


def test_words() -> None:
    frame = Frame("", (1.0, -2.0), math.radians(90.0))
    assert FrameFit("/gps", (48.0, 11.0), frame, 1200, 0.5, 300.0, 0.123).words == (
        "1,200 fixes of /gps, over 300 m that the ego gets around fit `frame: {proj: {at_wgs84: [48.0000000, "
        "11.0000000]}, offset_m: [1.00, -2.00], yaw_deg: 90.000}`: residual 0.50 m, turn ± 0.12° (95 %); not applied"
    )
    assert "geographic_msgs/msg/GeoPoseStamped" in FIXES

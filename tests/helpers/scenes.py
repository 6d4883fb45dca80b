"""Scenes one can compute in the head. Each is told in words; the numbers in the tests follow from the words alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from copem_replay.core.tracks import CLASSES, TRUTH, Scene, Tracks
from copem_replay.experiment.schema import Experiment
from copem_replay.io.recording import Recording

SIZES = {"car": (4.0, 2.0, 1.5), "pedestrian": (0.5, 0.5, 1.8), "truck": (8.0, 2.5, 3.5), "other": (1.0, 1.0, 4.0)}
T0_NS = 1_700_000_000_000_000_000  # recordings have absolute stamps; floats of them would lose microseconds


@dataclass(frozen=True)
class Thing:
    """An object: `at(t)` its x and y at t seconds, `there(t)` whether the log has it then."""

    name: str
    kind: str
    at: Callable[[float], tuple[float, float]]
    there: Callable[[float], bool] = lambda t: True
    yaw_rad: float = 0.0
    size_m: tuple[float, float, float] | None = None
    moving: bool = True


def standing(x_m: float, y_m: float) -> Callable[[float], tuple[float, float]]:
    return lambda t: (x_m, y_m)


def driving(x_m: float, y_m: float, vx_mps: float, vy_mps: float = 0.0) -> Callable[[float], tuple[float, float]]:
    return lambda t: (x_m + vx_mps * t, y_m + vy_mps * t)


def recording(things: Sequence[Thing], *, until_s: float, rate_hz: float = 10.0, ego: str | None = "ego",
              log: str = "scene", from_s: float = 0.0) -> Recording:  # fmt: skip
    """A log of `things`, frame by frame from `from_s` to `until_s`; velocities by a step of 1 ms."""
    ticks = np.arange(round(from_s * rate_hz), round(until_s * rate_hz) + 1)
    stamps = T0_NS + np.rint(ticks * 1e9 / rate_hz).astype(np.int64)
    rows: list[tuple[float, ...]] = []
    frames: list[int] = []
    start = [0]
    for thing in things:
        for k, tick in enumerate(ticks):
            t = float(tick / rate_hz)
            if thing.there(t):
                (x, y), (x1, y1) = thing.at(t), thing.at(t + 1e-3)
                length, width, height = thing.size_m or SIZES[thing.kind]
                rows.append((x, y, height / 2, thing.yaw_rad, (x1 - x) * 1e3, (y1 - y) * 1e3, length, width, height))
                frames.append(k)
        start.append(len(rows))
    captured_s = (stamps - stamps[0]) * 1e-9
    names = ("x_m", "y_m", "z_m", "yaw_rad", "vx_mps", "vy_mps", "length_m", "width_m", "height_m")
    truth = Tracks(
        units=(TRUTH,),
        start=np.array(start),
        unit_ix=np.zeros(len(things), dtype=int),
        object_ix=np.arange(len(things)),
        frame_ix=np.array(frames, dtype=int),
        stamp_ns=stamps,
        captured_s=captured_s,
        frame_unit_ix=np.zeros(len(stamps), dtype=int),
        arrives_s=captured_s[None],
        valid=np.ones((1, len(rows)), dtype=bool),
        **{name: column[None] for name, column in zip(names, np.array(rows).T, strict=True)},
    )
    ids = tuple(thing.name for thing in things)
    scene = Scene(
        log=log,
        t0_ns=int(stamps[0]),
        end_ns=int(stamps[-1]),
        object_ids=ids,
        object_class=np.array([CLASSES.index(thing.kind) for thing in things], dtype=np.int8),
        moving=np.array([thing.moving for thing in things]),
        ego_ix=ids.index(ego) if ego in ids else -1,
    )
    return Recording(scene=scene, truth=truth, path=Path("scene.mcap"), topic="truth", notes=(), host_id=ego)


SEES_60_M = [{"when": {"range_m": [0, 60]}, "detection": {"kind": "constant", "probability": 1.0}}]
SEES_ALL = [{"detection": {"kind": "constant", "probability": 1.0}}]
EGO_UNIT = {"on": "ego", "height_m": 1.8, "pem": "sure"}


def experiment(**changes: Any) -> Experiment:
    """An experiment of one run: GT, and one unit on the ego that surely sees to 60 m; `changes` replace keys.

    All episodes count, however they began, unless `measure` says so.
    """
    data: dict[str, Any] = {
        "version": 1,
        "logs": ["scene.mcap"],
        "seed": 7,
        "pems": {"sure": SEES_60_M, "all": SEES_ALL},
        "units": {"ego": EGO_UNIT},
        "configurations": {"GT": {"units": "truth"}, "PEM": {"units": ["ego"]}},
        "measure": {"onset": {"kind": "in_range", "range_m": 80}},
    }
    data |= changes
    measure = {"began": ["log_start", "crossed", "appeared"]} | data["measure"]
    return Experiment.model_validate(data | {"measure": measure})


def oncoming_car() -> Recording:
    """The ego stands at the origin; another car, 100 m ahead, drives towards it at 10 m/s, 10 Hz, 8 s.

    It is 80 m away at 2 s, 60 m at 4 s, 50 m at 5 s.
    """
    return recording(
        [Thing("ego", "car", standing(0, 0)), Thing("other", "car", driving(100, 0, -10), yaw_rad=np.pi)],
        until_s=8.0,
    )


def passing_by() -> Recording:
    """As before, but the other car is in the log from 1 s to 3 s only: at 70 m it leaves, never seen."""
    other = Thing("other", "car", driving(100, 0, -10), there=lambda t: 0.99 < t < 3.01, yaw_rad=np.pi)
    return recording([Thing("ego", "car", standing(0, 0)), other], until_s=8.0)


def ego_leaves() -> Recording:
    """As `oncoming_car`, but the ego's track ends at 3 s."""
    return recording(
        [
            Thing("ego", "car", standing(0, 0), there=lambda t: t < 3.01),
            Thing("other", "car", driving(100, 0, -10), yaw_rad=np.pi),
        ],
        until_s=8.0,
    )


def behind_a_wall() -> Recording:
    """The ego stands at the origin. 20 m ahead a pedestrian walks to the left at 1 m/s, from the ego's line at 0 s.

    A wall, 10 m ahead, thin, 4 m high, from 5 m right to 1 m left of the line, hides him while he is entirely within
    2 m left of the line, seen past its left end at twice the distance: until 1.75 s his box (0.5 m) is hidden wholly.
    """
    return recording(
        [
            Thing("ego", "car", standing(0, 0)),
            Thing("walker", "pedestrian", driving(20, 0, 0, 1.0)),
            Thing("wall", "other", standing(10, -2), size_m=(0.1, 6.0, 4.0), moving=False),
        ],
        until_s=5.0,
    )


def come_and_go(gap_s: float) -> Recording:
    """The ego stands; a pedestrian stands 10 m ahead, and is missing from the log for `gap_s` after 1 s."""
    there: Callable[[float], bool] = lambda t: t < 1.01 or t > 0.99 + gap_s  # noqa: E731
    return recording(
        [Thing("ego", "car", standing(0, 0)), Thing("walker", "pedestrian", standing(10, 0), there=there)], until_s=3.0
    )


def convoy() -> Recording:
    """Three cars in a row, 10 m apart, all driving at 10 m/s along x: the ego, the middle one, the first one.

    The middle one hides the first one from the ego (all as high and as wide as each other, seen from 1 m above ground).
    """
    return recording(
        [
            Thing("ego", "car", driving(0, 0, 10)),
            Thing("middle", "car", driving(10, 0, 10)),
            Thing("first", "car", driving(20, 0, 10)),
        ],
        until_s=2.0,
    )

"""When do the receiver's fused tracks imply a collision? A plain oracle in Shapely, and scenes for the head.

The ego of the worked scenes is 4 m × 2 m, a pedestrian 0.5 m × 0.5 m. With a margin of 0.5 m the corridor of an ego
that drives along y = 0 reaches 1.5 m to either side and 2.5 m ahead of its centre, and so much farther as it drives
within the horizon; a pedestrian is beside it unless |y| ≤ 1.75 m.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import shapely
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from numba import njit
from pyarrow import parquet

from copem_replay.cli import main as cli
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import Float
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import find_problems
from copem_replay.io.recording import Recording
from copem_replay.metrics.braking.encounter import EgoPath
from copem_replay.metrics.config import Conflict
from copem_replay.metrics.detection.conflict import build_corridors, will_enter
from copem_replay.pipeline.one_run import tracks_of_run
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.replay import replay_block
from copem_replay.pipeline.run import run_experiment
from tests.helpers import scenes
from tests.helpers.drawn import examples
from tests.helpers.experiments import changed, source_of
from tests.helpers.recordings import Obj, pedestrian, write_recording
from tests.helpers.replays import study_rows
from tests.helpers.scenes import EGO_UNIT, Thing, driving, experiment, recording, standing

will_enter = njit(will_enter)  # as kernels call it

SOME = settings(
    max_examples=30, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)  # an example replays a log
COLUMNS = [
    "conflict_detected",
    "conflict_detection_s",
    "time_to_conflict_detection_s",
    "distance_at_conflict_detection_m",
]
GT_ONLY = {"GT": {"units": "truth"}}
FROM_THE_START = {"kind": "appears"}


def plan(*, horizon_s: float = 3.0, margin_m: float = 0.5, measure: dict[str, Any] | None = None,
         **changes: Any) -> Experiment:  # fmt: skip
    """An experiment of `scenes.experiment` that looks for conflicts, from each object's first frame on."""
    wanted = {"onset": FROM_THE_START, "conflict": {"horizon_s": horizon_s, "margin_m": margin_m}}
    return experiment(measure=wanted | (measure or {}), **({"configurations": GT_ONLY} | changes))


def rows(log: Recording, wanted: Experiment) -> pd.DataFrame:
    """The rows of `detections.parquet`, by configuration, run and object."""
    return study_rows(run_experiment(wanted, [log])).set_index(["configuration", "run", "object_id"]).sort_index()


def event(log: Recording, wanted: Experiment, configuration: str = "GT", thing: str = "walker") -> float:
    """When a conflict with an object is detected in the first run; NaN: never."""
    return float(rows(log, wanted).loc[(configuration, 0, thing), "conflict_detection_s"])


def with_columns(log: Recording, thing: str, **columns: Callable[[Float], Float]) -> Recording:
    """A log whose truth says something else of one object: columns as functions of its frames' times."""
    truth = log.truth
    track = log.scene.object_number[thing]
    mine = slice(int(truth.start[track]), int(truth.start[track + 1]))
    changed_columns = {}
    for name, of_time in columns.items():
        column = getattr(truth, name).copy()
        column[0, mine] = of_time(truth.row_captured_s[mine])
        changed_columns[name] = column
    return replace(log, truth=replace(truth, **changed_columns))


def heading_along(log: Recording) -> Recording:
    """The log with everything that moves heading where it goes."""
    truth = log.truth
    moves = np.hypot(truth.vx_mps, truth.vy_mps) > 0.1
    yaw = np.where(moves, np.arctan2(truth.vy_mps, truth.vx_mps), truth.yaw_rad)
    for first, last in pairwise(truth.start):  # who stops keeps his heading
        for k in range(first + 1, last):
            if not moves[0, k] and moves[0, first:k].any():
                yaw[0, k] = yaw[0, k - 1]
    return replace(log, truth=replace(truth, yaw_rad=yaw))


# The oracle -------------------------------------------------------------------------------------------------


def boxes(x_m: Any, y_m: Any, yaw_rad: Any, length_m: Any, width_m: Any) -> np.ndarray:
    """Rectangles as Shapely polygons."""
    x, y, yaw, length, width = np.broadcast_arrays(*map(np.atleast_1d, (x_m, y_m, yaw_rad, length_m, width_m)))
    ahead = np.stack([np.cos(yaw), np.sin(yaw)], axis=1) * length[:, None] / 2
    left = np.stack([-np.sin(yaw), np.cos(yaw)], axis=1) * width[:, None] / 2
    centre = np.stack([x, y], axis=1)
    corners = [centre + ahead + left, centre - ahead + left, centre - ahead - left, centre + ahead - left]
    return shapely.polygons(np.stack(corners, axis=1))


@dataclass(frozen=True)
class Corridor:
    """What the ego sweeps within the horizon, by the words alone: its box every 10 cm of its way, to be inflated."""

    x_m: Float
    y_m: Float
    yaw_rad: Float
    size_m: tuple[float, float]

    def boxes(self, margin_m: float) -> np.ndarray:
        return boxes(
            self.x_m, self.y_m, self.yaw_rad, self.size_m[0] + 2 * margin_m, self.size_m[1] + 2 * margin_m
        )  # fmt: skip


def corridor_of(log: Recording, now_s: float, horizon_s: float, max_gap_s: float = 0.5) -> Corridor:
    """The corridor at an instant; empty where the ego is not in the log."""
    truth = log.truth
    track = log.scene.ego_ix
    mine = slice(int(truth.start[track]), int(truth.start[track + 1]))
    time_s = truth.row_captured_s[mine]
    x, y, vx, vy = (getattr(truth, name)[0, mine] for name in ("x_m", "y_m", "vx_mps", "vy_mps"))
    yaw = np.unwrap(truth.yaw_rad[0, mine])
    size = (float(truth.length_m[0, mine][0]), float(truth.width_m[0, mine][0]))
    before, after = time_s[time_s <= now_s + 1e-9], time_s[time_s >= now_s - 1e-9]
    if not len(before) or not len(after) or after[0] - before[-1] > max_gap_s + 1e-9:
        return Corridor(np.empty(0), np.empty(0), np.empty(0), size)
    way = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    along, speed = np.interp(now_s, time_s, way), np.interp(now_s, time_s, np.hypot(vx, vy))
    places = np.linspace(along, along + speed * horizon_s, 1 + math.ceil(speed * horizon_s / 0.1))
    known, first = np.unique(way, return_index=True)  # a place where it stood counts once
    beyond = np.maximum(places - way[-1], 0.0)
    ahead_x, ahead_y = 0.0, 0.0
    if len(known) > 1:  # straight on: as it drove last
        step = known[-1] - known[-2]
        ahead_x, ahead_y = (x[first[-1]] - x[first[-2]]) / step, (y[first[-1]] - y[first[-2]]) / step
    return Corridor(
        np.interp(places, known, x[first]) + beyond * ahead_x,
        np.interp(places, known, y[first]) + beyond * ahead_y,
        np.interp(places, known, yaw[first]),
        size,
    )


def swept(x_m: float, y_m: float, yaw_rad: float, vx_mps: float, vy_mps: float, length_m: float, width_m: float,
          horizon_s: float) -> shapely.Geometry:  # fmt: skip
    """What a box sweeps that moves on straight without turning: the hull of its ends."""
    ends = boxes([x_m, x_m + vx_mps * horizon_s], [y_m, y_m + vy_mps * horizon_s], yaw_rad, length_m, width_m)
    return shapely.convex_hull(shapely.union_all(ends))


def heard_at(fused_tracks: FusedTracks, object_ix: int, issue_s: float, s: int, max_age_s: float) -> float | None:
    """Newest capture of the object in the units' newest lists at an instant; None: in none of them."""
    received, newest = fused_tracks.received, None
    for unit in range(len(received.units)):
        came = [
            f
            for f in range(len(received.stamp_ns))
            if received.frame_unit_ix[f] == unit and received.arrives_s[0, f] <= issue_s + 1e-9
        ]
        if not came:
            continue
        frame = max(came, key=lambda f: received.captured_s[f])
        if issue_s > received.arrives_s[0, frame] + max_age_s + 1e-9:
            continue
        mine = (received.frame_ix == frame) & (received.row_object_ix == object_ix) & (received.row_unit_ix == unit)
        if received.valid[s, mine].any():
            newest = max(newest or -np.inf, float(received.captured_s[frame]))
    return newest


def expected_event(
    log: Recording, wanted: Experiment, fused_tracks: FusedTracks, row: pd.Series, object_ix: int, margin_m: float,
    known: dict[tuple[float, float], np.ndarray],
) -> float:  # fmt: skip
    """When the conflict is detected, list by list; NaN: never. `known`: corridors by instant and margin, kept."""
    assert wanted.measure.conflict is not None
    horizon_s, confirm = wanted.measure.conflict.horizon_s, wanted.measure.confirm
    fused = fused_tracks.fused
    implied = [False] * len(fused.stamp_ns)
    for p in np.flatnonzero((fused.row_object_ix == object_ix) & fused.valid[0]):
        k = int(fused.frame_ix[p])
        now_s = float(fused.arrives_s[0, k])
        newest = heard_at(fused_tracks, object_ix, now_s, 0, max_age_s=1.0)
        assert newest is not None, "listed, and nobody said so"
        if newest < row["onset_s"] - 1e-9 and not wanted.measure.count_earlier:
            continue
        if now_s > row["ended_s"] + 1e-9:
            continue
        if (now_s, margin_m) not in known:
            known[now_s, margin_m] = corridor_of(log, now_s, horizon_s).boxes(margin_m)
        names = ("x_m", "y_m", "yaw_rad", "vx_mps", "vy_mps", "length_m", "width_m")
        way = swept(*(float(getattr(fused, name)[0, p]) for name in names), horizon_s)
        implied[k] = bool(shapely.intersects(way, known[now_s, margin_m]).any())
    for k in range(len(implied)):
        if implied[k] and sum(implied[max(k - confirm.of + 1, 0) : k + 1]) >= confirm.hits:
            return float(fused.arrives_s[0, k])
    return math.nan


@dataclass(frozen=True)
class Drawn:
    """A random log, and by how much its corridors may be off: straight pieces of 2 m do not follow a bend exactly."""

    log: Recording = field(repr=False)
    tolerance_m: float
    told: str


Motion = Callable[[float], tuple[float, float]]


def turned(angle: float, x: float, y: float) -> tuple[float, float]:
    return math.cos(angle) * x - math.sin(angle) * y, math.sin(angle) * x + math.cos(angle) * y


@st.composite
def drives(draw: st.DrawFn) -> tuple[Motion, float, float, str]:
    """How the ego drives for 3 s: its motion, its heading at the start, the tolerance of its corridors, in words."""
    heading, x0, y0 = draw(st.floats(-math.pi, math.pi)), draw(st.floats(-4e3, 4e3)), draw(st.floats(-4e3, 4e3))
    kind = draw(st.sampled_from(["straight", "left", "right", "stands", "brakes", "sets off"]))
    speed, radius = draw(st.floats(2, 15)), draw(st.floats(12, 60))

    def along(t: float) -> float:
        stop = {"stands": 0.0, "brakes": 2.0}.get(kind)
        if stop is not None:
            t = min(t, stop)
            return speed * t - speed * t * t / 4
        return speed * max(t - 1.0, 0.0) if kind == "sets off" else speed * t

    def at(t: float) -> tuple[float, float]:
        way, side = along(t), {"left": 1, "right": -1}.get(kind, 0)
        x, y = way, 0.0
        if side:  # from 2.5 s on straight: no doubt about how it goes on beyond its last frame
            bend = min(way, along(2.5)) / radius
            on_x, on_y = turned(bend, max(way - along(2.5), 0.0), 0.0)
            x, y = radius * math.sin(bend) + on_x, side * (radius * (1 - math.cos(bend)) + on_y)
        east, north = turned(heading, x, y)
        return x0 + east, y0 + north

    # Half a piece turns by 1 m / radius: by so much, on half a diagonal, its corners are off; its middle by less.
    tolerance_m = (math.hypot(2.5, 1.5) + 1.0) / radius if kind in ("left", "right") else 1e-6
    return at, heading, tolerance_m, f"{kind}: {heading=} {x0=} {y0=} {speed=} {radius=}"


@st.composite
def others(draw: st.DrawFn, ego: Motion, heading: float, number: int) -> tuple[Thing, str]:
    """An object near where the ego will be, crossing, oncoming, parked, walking away, or turning; and that in words."""
    kind = draw(st.sampled_from(["crossing", "oncoming", "parked", "away", "turning"]))
    then_s, beside = draw(st.floats(0, 5)), draw(st.floats(-5, 5))
    speed, angle = draw(st.floats(0.5, 8)), draw(st.floats(-math.pi, math.pi))
    (x, y), (x1, y1) = ego(then_s), ego(then_s + 1e-3)
    way = math.atan2(y1 - y, x1 - x) if (x, y) != (x1, y1) else heading
    east, north = turned(way, 0.0, beside)
    x, y = x + east, y + north
    toward = {"oncoming": way + math.pi, "away": way + math.copysign(math.pi / 2, beside)}.get(kind, angle)

    def at(t: float) -> tuple[float, float]:
        if kind == "parked":
            return x, y
        if kind == "turning":
            turn = speed * t / 6.0
            east, north = turned(toward, 6 * math.sin(turn), 6 * (1 - math.cos(turn)))
            return x + east, y + north
        elapsed = t - then_s if kind == "crossing" else t
        east, north = turned(toward, speed * elapsed, 0.0)
        return x + east, y + north

    name = draw(st.sampled_from(["pedestrian", "car", "truck"]))
    from_s = draw(st.sampled_from([0.0, 0.0, 0.7]))
    gap = draw(st.sampled_from([0.0, 0.0, 0.3, 0.9]))
    there: Callable[[float], bool] = lambda t: t >= from_s - 1e-9 and not 1.15 < t < 1.15 + gap  # noqa: E731
    told = f"{kind} {name}: {then_s=} {beside=} {speed=} {angle=} {from_s=} {gap=}"
    return Thing(f"o{number}", name, at, there, yaw_rad=toward), told


@st.composite
def logs(draw: st.DrawFn) -> Drawn:
    ego, heading, tolerance_m, told = draw(drives())
    things = [Thing("ego", "car", ego, yaw_rad=heading)]
    for k in range(draw(st.integers(1, 3))):
        thing, more = draw(others(ego, heading, k))
        things.append(thing)
        told += f"; {more}"
    return Drawn(heading_along(recording(things, until_s=3.0)), tolerance_m, told)


class TestOracle:
    @given(
        place=st.tuples(st.floats(-15, 15), st.floats(-15, 15)),
        yaws=st.tuples(st.floats(-7, 7), st.floats(-7, 7)),
        velocity=st.tuples(st.floats(-8, 8), st.floats(-8, 8)) | st.just((0.0, 0.0)) | st.just((3.0, 0.0)),
        size=st.tuples(st.floats(0.05, 8), st.floats(0.05, 3)),
        piece=st.tuples(st.floats(0.5, 9), st.floats(0.5, 4)),
        horizon_s=st.floats(0.01, 5),
        far_m=st.sampled_from([0.0, 5e5]),
    )
    @example((3.0, 0.0), (0.0, 0.0), (0.0, 0.0), (2.0, 2.0), (3.9, 2.0), 3.0, 0.0)
    @example((3.0, 0.0), (0.0, 0.0), (-0.34, 0.0), (2.0, 2.0), (2.0, 2.0), 3.0, 0.0)
    @settings(max_examples=examples(300), deadline=None)
    def test_box_moved_in_fine_steps(
        self,
        place: tuple[float, float],
        yaws: tuple[float, float],
        velocity: tuple[float, float],
        size: tuple[float, float],
        piece: tuple[float, float],
        horizon_s: float,
        far_m: float,
    ) -> None:
        time_s = np.linspace(0, horizon_s, 201)
        moved = boxes(place[0] + velocity[0] * time_s, place[1] + velocity[1] * time_s, yaws[0], *size)
        standing_there = boxes(0.0, 0.0, yaws[1], *piece)[0]
        near_m = float(shapely.distance(moved, standing_there).min())
        other = np.array([far_m, -far_m, yaws[1], *piece])
        found = will_enter(place[0] + far_m, place[1] - far_m, yaws[0], *velocity, *size, other, horizon_s)
        # Between two steps it moves less than this; and rounding.
        step_m = math.hypot(*velocity) * horizon_s / 200 + 1e-6
        smaller = boxes(0.0, 0.0, yaws[1], piece[0] - 2e-6, piece[1] - 2e-6)[0]
        if shapely.intersects(moved, smaller).any():
            assert found
        if near_m > step_m:
            assert not found

    @pytest.mark.parametrize(("y_m", "expected"), [(2.0, True), (2.001, False)])
    def test_boxes_that_stand_side_by_side_meet_where_they_touch(self, y_m: float, expected: bool) -> None:
        assert will_enter(0.0, y_m, 0.0, 0.0, 0.0, 4.0, 2.0, np.array([0.0, 0.0, 0.0, 4.0, 2.0]), 3.0) is expected

    @given(drawn=logs(), horizon_s=st.floats(0.1, 4), margin_m=st.floats(0, 1.5))
    @settings(max_examples=examples(60), suppress_health_check=[HealthCheck.too_slow])  # an example replays a log
    def test_corridor_is_what_the_ego_sweeps(self, drawn: Drawn, horizon_s: float, margin_m: float) -> None:
        ready = prepare_log(drawn.log, plan())
        now_s = np.array([-0.1, 0.0, 0.33, 1.2, 2.0, 2.95, 3.0, 3.1])
        ego = EgoPath(ready.scene, ready.truth, 0.5)
        pieces, bounds = build_corridors(ego, now_s, Conflict(horizon_s=horizon_s, margin_m=margin_m))
        for k, now in enumerate(now_s):
            found = shapely.union_all(boxes(*pieces[bounds[k] : bounds[k + 1]].T))
            exact = corridor_of(drawn.log, now, horizon_s)
            assert found.is_empty == (len(exact.x_m) == 0) == (not 0 <= now <= 3), "none without the ego"
            most = shapely.union_all(exact.boxes(margin_m + drawn.tolerance_m))
            least = shapely.union_all(exact.boxes(margin_m - drawn.tolerance_m))
            # Both cover the way with pieces of their own: what differs is thinner than that shows.
            assert shapely.difference(found, most).area < 1e-5, f"too large at {now} s"
            assert shapely.difference(least, found).area < 1e-5, f"too small at {now} s"

    @given(
        drawn=logs(),
        horizon_s=st.sampled_from([0.5, 1.5, 3.0]),
        margin_m=st.sampled_from([0.5, 1.0]),
        confirm=st.sampled_from([{}, {}, {"hits": 2, "of": 3}, {"hits": 2, "of": 2}]),
        onset=st.sampled_from([FROM_THE_START, {"kind": "in_range", "range_m": 15}, {"kind": "at", "time_s": 0.77}]),
        count_earlier=st.booleans(),
        latency_s=st.sampled_from([0.0, 0.33]),
        rate_hz=st.sampled_from([None, 3.7, 20.0]),
        combine=st.sampled_from(["samples", "posterior"]),
    )
    @SOME
    def test_events_list_by_list(
        self,
        drawn: Drawn,
        horizon_s: float,
        margin_m: float,
        confirm: dict[str, int],
        onset: dict[str, Any],
        count_earlier: bool,
        latency_s: float,
        rate_hz: float | None,
        combine: str,
    ) -> None:
        wanted = plan(
            horizon_s=horizon_s,
            margin_m=margin_m,
            runs=2,
            pems=NOISY,
            units={
                "ego": {"on": "ego", "height_m": 1.8, "pem": "noisy", "rate_hz": rate_hz},
                "rsu": {"on": "o0", "height_m": 5.0, "pem": "sure"},
            },
            configurations={
                "GT": {"units": "truth", "latency_s": latency_s},
                "PEM": {"units": ["ego"], "latency_s": latency_s, "fusion": {"kind": "ideal", "combine": combine}},
                "two": {"units": "all", "latency_s": {"rsu": latency_s}},
            },
            measure={"onset": onset, "confirm": confirm, "count_earlier": count_earlier},
        )
        ready = prepare_log(drawn.log, wanted)
        known: dict[tuple[float, float], np.ndarray] = {}
        table = replay_block(ready, wanted, np.arange(2))
        for number in range(2):
            run_tracks = tracks_of_run(ready, wanted, number)
            for _, row in table[table["run"] == number].iterrows():
                object_ix = drawn.log.scene.object_number[row["object_id"]]
                early, late = (
                    expected_event(drawn.log, wanted, run_tracks[row["configuration"]], row, object_ix, margin, known)
                    for margin in (margin_m + drawn.tolerance_m, margin_m - drawn.tolerance_m)
                )
                found = row["conflict_detection_s"]
                if not math.isnan(late):
                    assert row["conflict_detected"]
                    assert found <= late + 1e-9
                if row["conflict_detected"]:
                    assert early - 1e-9 <= found


NOISY = {
    "noisy": [
        {
            "when": {"range_m": [0, 60]},
            "detection": {"kind": "constant", "probability": 0.6},
            "error": {
                "kind": "gaussian",
                "covariance_m2": [[0.6, 0.2], [0.2, 0.9]],
                "yaw_sigma_deg": 5,
                "size_sigma_m": 0.2,
                "speed_sigma_mps": 0.4,
            },
        }
    ],
    "sure": scenes.SEES_60_M,
}


# Scenes in the head -----------------------------------------------------------------------------------------


def crossing(x_m: float, from_y_m: float, *, until_s: float = 7.0, speed_mps: float = 10.0) -> Recording:
    """The ego drives along y = 0 at 10 m/s from the origin. A pedestrian at x walks north at 1 m/s, from y at 0 s."""
    walker = Thing("walker", "pedestrian", driving(x_m, from_y_m, 0.0, 1.0))
    return recording([Thing("ego", "car", driving(0, 0, speed_mps)), walker], until_s=until_s)


class TestCrossing:
    """He is implied when the corridor's front has reached him, at (x − 0.25 − 2 − margin − 10 h) / 10 s, and when he
    will have reached its side, at |y| − 1.25 − margin − h s: at the first list from the later one on."""

    @pytest.mark.parametrize(
        ("x_m", "from_y_m", "horizon_s", "margin_m", "expected_s"),
        [
            (45.0, -6.0, 3.0, 0.5, 1.3),  # front 1.225, side 1.25
            (20.0, -6.0, 3.0, 0.5, 1.3),  # in front from the start, side 1.25
            (35.0, -6.0, 2.0, 0.5, 2.3),  # side 2.25; front 1.225
            (60.0, -6.0, 1.0, 0.5, 4.8),  # side 3.25; front 4.725
            (45.0, -6.0, 3.0, 0.0, 1.8),  # side 1.75, front 1.275
            (45.0, -6.0, 3.0, 1.0, 1.2),  # side 0.75, front 1.175
            (30.0, -3.0, 3.0, 0.5, 0.0),  # 3 m beside and walking: within three seconds he is in the way
            (30.0, -3.0, 1.0, 0.5, 1.8),  # front 1.725, side 0.25
            (20.0, -6.0, 1.0, 0.5, None),  # side 3.25; the rear of the corridor has passed him at 2.275
            (20.0, 3.0, 3.0, 0.5, None),  # on the left, and walking away to the left
            (60.0, -20.0, 3.0, 0.5, None),  # side 15.25
        ],
    )
    def test_when(
        self, x_m: float, from_y_m: float, horizon_s: float, margin_m: float, expected_s: float | None
    ) -> None:
        found = rows(crossing(x_m, from_y_m), plan(horizon_s=horizon_s, margin_m=margin_m)).loc[("GT", 0, "walker")]
        if expected_s is None:
            assert not found["conflict_detected"]
            assert found[COLUMNS[1:]].isna().all()
            return
        assert found["conflict_detected"]
        assert found["conflict_detection_s"] == pytest.approx(expected_s, abs=1e-9)
        assert found["time_to_conflict_detection_s"] == pytest.approx(expected_s - found["onset_s"], abs=1e-9)
        distance_m = math.hypot(x_m - 10 * expected_s, from_y_m + expected_s)
        assert found["distance_at_conflict_detection_m"] == pytest.approx(distance_m)

    def test_he_starts_to_walk(self) -> None:
        """3 m beside, 30 m ahead, he stands until 1 s."""
        walker = Thing("walker", "pedestrian", lambda t: (30.0, -3.0 + max(t - 1.0, 0.0)))
        log = recording([Thing("ego", "car", driving(0, 0, 10)), walker], until_s=4.0)
        assert event(log, plan()) == pytest.approx(1.0)
        assert event(log, plan(horizon_s=1.0)) == pytest.approx(1.8), "front 1.725, side 1.25"

    @pytest.mark.parametrize(("y_m", "expected_s"), [(1.76, math.nan), (-1.76, math.nan), (1.74, 0.9), (-1.74, 0.9)])
    @pytest.mark.parametrize("turn", [0.0, math.pi / 2, math.pi])
    def test_parallel(self, y_m: float, expected_s: float, turn: float) -> None:
        """He walks along the lane, towards the ego, at 1 m/s, from 45 m ahead. Just beside the corridor never is in it;
        just within, he will be when 44.75 − t − 3 ≤ 10 t + 32.5: from 0.84 s on."""
        walker = Thing("walker", "pedestrian", driving(45, y_m, -1.0), yaw_rad=turn)
        log = recording([Thing("ego", "car", driving(0, 0, 10)), walker], until_s=4.0)
        assert event(log, plan()) == pytest.approx(expected_s, nan_ok=True)

    @pytest.mark.parametrize("latency_s", [0.05, 0.1, 0.35, 0.8])
    def test_latency_moves_it_by_exactly_itself(self, latency_s: float) -> None:
        late = {"late": {"units": "truth", "latency_s": latency_s}, "PEM": {"units": ["ego"], "latency_s": latency_s}}
        found = rows(crossing(20, -6), plan(configurations=GT_ONLY | late))["conflict_detection_s"]
        assert found["GT", 0, "walker"] == pytest.approx(1.3, abs=1e-12)
        assert found["late", 0, "walker"] == pytest.approx(1.3 + latency_s, abs=1e-12)
        assert found["PEM", 0, "walker"] == pytest.approx(1.3 + latency_s, abs=1e-12)

    def test_latency_may_be_too_much(self) -> None:
        """Implied at 1.3 s; at 2.275 s the corridor's rear has passed him: a list one second late says nothing."""
        late = {"late": {"units": "truth", "latency_s": 0.9}, "too late": {"units": "truth", "latency_s": 1.0}}
        found = rows(crossing(20, -6), plan(configurations=late))["conflict_detection_s"]
        assert found["late", 0, "walker"] == pytest.approx(2.2)
        assert math.isnan(found["too late", 0, "walker"])

    def test_exact_units_know_what_the_truth_does(self) -> None:
        configurations = {
            "GT": {"units": "truth"},
            "PEM": {"units": ["ego"]},
            "posterior": {"units": ["ego"], "fusion": {"kind": "ideal", "combine": "posterior"}},
        }
        wanted = plan(configurations=configurations, units={"ego": EGO_UNIT | {"pem": "all"}})
        found = rows(crossing(45, -6), wanted)[COLUMNS]
        for name in ("PEM", "posterior"):
            pd.testing.assert_frame_equal(found.loc[[name]].droplevel(0), found.loc[["GT"]].droplevel(0))

    def test_unit_that_does_not_see_him_yet(self) -> None:
        """He stands 80 m ahead and is listed from 35 m on: what nobody lists implies nothing."""
        log = recording(
            [Thing("ego", "car", driving(0, 0, 10)), Thing("walker", "pedestrian", standing(80, 0))], until_s=6.0
        )
        short = {"short": [{"when": {"range_m": [0, 35]}, "detection": {"kind": "constant", "probability": 1.0}}]}
        configurations = {"GT": {"units": "truth"}, "PEM": {"units": ["ego"]}}
        wanted = plan(configurations=configurations, pems=short, units={"ego": EGO_UNIT | {"pem": "short"}})
        found = rows(log, wanted)["conflict_detection_s"]
        assert found["GT", 0, "walker"] == pytest.approx(4.8), "10 t + 32.5 ≥ 79.75 from 4.725 s on"
        assert found["PEM", 0, "walker"] == pytest.approx(4.8)
        later = plan(horizon_s=6.0, configurations=configurations, pems=short, units=wanted_units("short"))
        found = rows(log, later)["conflict_detection_s"]
        assert found["GT", 0, "walker"] == pytest.approx(1.8), "10 t + 62.5 ≥ 79.75 from 1.725 s on"
        assert found["PEM", 0, "walker"] == pytest.approx(4.5), "35 m away"


def wanted_units(pem: str) -> dict[str, Any]:
    return {"ego": EGO_UNIT | {"pem": pem}}


class TestOtherWays:
    def test_standing_ego(self) -> None:
        """Its corridor is its own box and the margin: (100 − 10 t − 2 − 2.5) / 10 ≤ 3 from 6.55 s on."""
        assert event(scenes.oncoming_car(), plan(), thing="other") == pytest.approx(6.6)
        assert event(scenes.oncoming_car(), plan(horizon_s=4.0), thing="other") == pytest.approx(5.6)
        assert event(scenes.oncoming_car(), plan(margin_m=1.3), thing="other") == pytest.approx(6.5), "6.47 s"

    def test_walking_away_from_a_standing_ego(self) -> None:
        walker = Thing("walker", "pedestrian", driving(0, 1.8, 0.0, 1.0))
        log = recording([Thing("ego", "car", standing(0, 0)), walker], until_s=3.0)
        assert math.isnan(event(log, plan(horizon_s=60.0)))

    def test_ways_are_compared_not_times(self) -> None:
        """He crosses 25 m ahead within 2 s; the ego will be there only in 2.25 s. It is a conflict all the same."""
        walker = Thing("walker", "pedestrian", driving(25, -1.9, 0.0, 4.0))
        log = recording([Thing("ego", "car", driving(0, 0, 10)), walker], until_s=1.0)
        assert event(log, plan()) == 0.0

    def test_convoy(self) -> None:
        """10 m ahead drives the middle one: the ego's way and its own overlap at once."""
        found = rows(scenes.convoy(), plan())["conflict_detection_s"]
        assert found["GT", 0, "middle"] == found["GT", 0, "first"] == 0.0

    def test_round_the_bend(self) -> None:
        """The ego turns left on a radius of 20 m. Who stands on the circle 42.25 m ahead is in its way when it has come
        9.5 m, for 32.5 m and half a pedestrian are left, at 0.95 s; who stands straight ahead never is."""
        circle: Motion = lambda t: (20 * math.sin(t / 2), 20 - 20 * math.cos(t / 2))  # noqa: E731
        on_it = 42.25 / 20
        things = [
            Thing("ego", "car", circle),
            Thing("on it", "pedestrian", standing(20 * math.sin(on_it), 20 - 20 * math.cos(on_it))),
            Thing("ahead", "pedestrian", standing(35, 0)),
            Thing("centre", "pedestrian", standing(0, 20)),
        ]
        found = rows(heading_along(recording(things, until_s=6.0)), plan())["conflict_detection_s"]
        assert found["GT", 0, "on it"] == pytest.approx(1.0)
        assert math.isnan(found["GT", 0, "ahead"])
        assert math.isnan(found["GT", 0, "centre"])

    def test_beyond_the_end_of_its_path(self) -> None:
        """The log ends at 2 s, 20 m on; who stands 45 m ahead is in the corridor from 1.225 s on all the same."""
        log = recording(
            [Thing("ego", "car", driving(0, 0, 10)), Thing("walker", "pedestrian", standing(45, 0))], until_s=2.0
        )
        assert event(log, plan()) == pytest.approx(1.3)

    def test_braking_ego(self) -> None:
        """From 10 m/s it brakes with 2 m/s². Its corridor goes to 10 t − t² + 3 (10 − 2 t) + 2.5 = 32.5 + 4 t − t².

        That is largest at 2 s, 36.5 m: who stands at 36.85 m (less 0.25) never is in its way, who stands at 36.25 m is
        from 1.3 s on (36.01 ≥ 36; at 1.2 s it is 35.86), though it stops at 25 m.
        """
        brakes: Motion = lambda t: (10 * min(t, 5) - min(t, 5) ** 2, 0.0)  # noqa: E731
        things = [
            Thing("ego", "car", brakes),
            Thing("far", "pedestrian", standing(36.85, 0)),
            Thing("near", "pedestrian", standing(36.25, 0)),
        ]
        found = rows(recording(things, until_s=7.0), plan())["conflict_detection_s"]
        assert math.isnan(found["GT", 0, "far"])
        assert found["GT", 0, "near"] == pytest.approx(1.3)

    @given(angle=st.floats(-math.pi, math.pi), x_m=st.floats(-1e5, 1e5), y_m=st.floats(-1e5, 1e5))
    @settings(max_examples=15, deadline=None)  # an example replays a log
    def test_wherever_the_scene_is(self, angle: float, x_m: float, y_m: float) -> None:
        def placed(of: Motion) -> Motion:
            def at(t: float) -> tuple[float, float]:
                east, north = turned(angle, *of(t))
                return x_m + east, y_m + north

            return at

        things = [
            Thing("ego", "car", placed(driving(0, 0, 10)), yaw_rad=angle),
            Thing("walker", "pedestrian", placed(driving(45, -6, 0, 1)), yaw_rad=angle),
            Thing("beside", "pedestrian", placed(driving(45, -1.77, 2)), yaw_rad=angle),
        ]
        found = rows(recording(things, until_s=3.0), plan())["conflict_detection_s"]
        assert found["GT", 0, "walker"] == pytest.approx(1.3)
        assert math.isnan(found["GT", 0, "beside"])

    @given(drawn=logs(), more=st.floats(0, 2))
    @SOME
    def test_wider_is_never_later(self, drawn: Drawn, more: float) -> None:
        narrow, wide = (rows(drawn.log, plan(margin_m=0.3 + extra)) for extra in (0.0, more))
        late = wide["conflict_detection_s"] - narrow["conflict_detection_s"]
        assert (wide["conflict_detected"] | ~narrow["conflict_detected"]).all()
        assert not (late > 0).any()


# An ego as it is recorded: not always there, not always smooth ----------------------------------------------


class TestRecordedEgo:
    def test_it_leaves(self) -> None:
        """It is in the log until 3 s: who would be implied at 6.6 s is no longer looked at."""
        found = rows(scenes.ego_leaves(), plan()).loc[("GT", 0, "other")]
        assert found["ended_by"] == "ego_left"
        assert not found["conflict_detected"]
        found = rows(scenes.ego_leaves(), plan(horizon_s=7.0)).loc[("GT", 0, "other")]
        assert found["conflict_detection_s"] == pytest.approx(2.6), "(100 − 10 t − 4.5) / 10 ≤ 7 from 2.55 s on"

    @pytest.mark.parametrize(("gap_s", "expected_s"), [(0.4, 1.3), (1.0, 2.1)])
    def test_it_is_missing_for_a_while(self, gap_s: float, expected_s: float) -> None:
        """Missing after 1.1 s. A short gap is bridged; in a long one it has no corridor, at its end again."""
        there: Callable[[float], bool] = lambda t: t < 1.11 or t > 1.09 + gap_s  # noqa: E731
        ego = Thing("ego", "car", driving(0, 0, 10), there)
        log = recording([ego, Thing("walker", "pedestrian", driving(45, -6, 0, 1))], until_s=4.0)
        assert event(log, plan()) == pytest.approx(expected_s)

    def test_it_comes_later(self) -> None:
        """The onset waits for it, and so does everything else."""
        ego = Thing("ego", "car", driving(0, 0, 10), lambda t: t > 1.99)
        log = recording([ego, Thing("walker", "pedestrian", standing(45, 0))], until_s=4.0)
        found = rows(log, plan()).loc[("GT", 0, "walker")]
        assert found["onset_s"] == found["conflict_detection_s"] == pytest.approx(2.0)
        assert found["time_to_conflict_detection_s"] == 0

    @pytest.mark.parametrize("latency_s", [0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 0.9])
    @pytest.mark.parametrize("until_s", [0.9, 1.2, 3.0, 3.3])
    @pytest.mark.parametrize("y_m", [6.0, -40.0])
    def test_a_list_that_arrives_at_its_last_frame(self, until_s: float, latency_s: float, y_m: float) -> None:
        """Capture and latency may add up to a trifle after the ego's last frame: who is beside it is still beside."""
        things = [Thing("ego", "car", driving(0, 0, 10)), Thing("walker", "pedestrian", driving(10, y_m, 10))]
        wanted = plan(configurations={"late": {"units": "truth", "latency_s": latency_s}})
        assert math.isnan(event(recording(things, until_s=until_s), wanted, "late"))

    @pytest.mark.parametrize("latency_s", [0.1, 0.2])
    def test_at_its_last_frame_it_still_has_a_corridor(self, latency_s: float) -> None:
        """He is in the way from the last capture on that arrives in time: 2.9 and 0.1 s are 3.0000000000000004 s."""
        walker = Thing("walker", "pedestrian", lambda t: (40.0, 0.0 if t > 2.99 - latency_s else -40.0))
        log = recording([Thing("ego", "car", driving(0, 0, 10)), walker], until_s=3.0)
        wanted = plan(configurations={"late": {"units": "truth", "latency_s": latency_s}})
        assert event(log, wanted, "late") == pytest.approx(3.0)

    def test_waiting_with_a_jitter(self) -> None:
        """It waits; its recorded place jitters by 1 cm and its speed is said to be 2 cm/s. Who stands 2.3 m beside its
        centre line, 0.55 m from the corridor, is in nobody's way."""
        ego = Thing("ego", "car", lambda t: (0.0, 0.01 * (round(t * 10) % 2)))
        log = recording([ego, Thing("walker", "pedestrian", standing(0, -2.3))], until_s=3.0)
        log = with_columns(log, "ego", vx_mps=lambda t: 0 * t + 0.02, vy_mps=lambda t: 0 * t)
        assert math.isnan(event(log, plan()))

    def test_a_halt_with_a_jitter_is_no_way(self) -> None:
        """10 m on it halts for two seconds, its place jittering by 6 cm. Before that its corridor reaches 10 t + 32.5 m
        all the same: a pedestrian 35 m ahead (less half of himself) is in it from 0.25 s on."""

        def halts(t: float) -> tuple[float, float]:
            if 1 <= t < 3:
                return 10.0, 0.06 * (round(t * 10) % 2)
            return 10 * min(t, 1) + 10 * max(t - 3, 0.0), 0.0

        ego, walker = Thing("ego", "car", halts), Thing("walker", "pedestrian", standing(35.25, 0))
        assert event(recording([ego, walker], until_s=4.0), plan()) == pytest.approx(0.3)

    def test_on_a_slant(self) -> None:
        """It drives 10 m/s ahead and 2 m/s to the left, heading straight ahead: all it sweeps is in its corridor."""
        log = recording([Thing("ego", "car", driving(0, 0, 10, 2))], until_s=4.0)
        ready = prepare_log(log, plan())
        pieces, _ = build_corridors(EgoPath(ready.scene, ready.truth, 0.5), np.array([0.5]), Conflict())
        found = shapely.union_all(boxes(*pieces.T))
        swept_there = shapely.union_all(corridor_of(log, 0.5, 3.0).boxes(0.5 - 1e-6))
        assert shapely.difference(swept_there, found).area < 1e-9
        # Straight pieces of 2 m, heading ahead, stick out by less than 0.4 m.
        assert shapely.difference(found, shapely.buffer(swept_there, 0.4)).area < 1e-9

    def test_straight_on_in_a_bend(self) -> None:
        """It turns along a circle of 16 m at 3 m/s, just less than 10 cm from frame to frame, and leaves after 4.5 m,
        at (4.4409, 0.6287), heading 0.28125 rad: so its corridor heads."""

        def turns(t: float) -> tuple[float, float]:
            return 16 * math.sin(3 * t / 16), 16 - 16 * math.cos(3 * t / 16)

        ego = Thing("ego", "car", turns, there=lambda t: t < 1.51)
        log = recording([ego, Thing("walker", "pedestrian", standing(9, 9))], until_s=2.0, rate_hz=30.0)
        log = with_columns(log, "ego", yaw_rad=lambda t: 3 * t / 16)
        ready = prepare_log(log, plan())
        pieces, _ = build_corridors(EgoPath(ready.scene, ready.truth, 0.5), np.array([1.5]), Conflict())
        x, y, yaw = pieces.T[:3]
        np.testing.assert_allclose(yaw, 0.28125, atol=1e-6)
        np.testing.assert_allclose(y - 0.6287, (x - 4.4409) * math.tan(0.28125), atol=1e-3)

    def test_stopping_with_a_jitter(self) -> None:
        """It stops after 10 m; long after, its recorded place moves 2 µm to the left. "Straight on" is still ahead: who
        stands 12 m to the left of where it stops is in nobody's way, who stands 15 m ahead of there is."""

        def stops(t: float) -> tuple[float, float]:
            return 10 * min(t, 2) - 2.5 * min(t, 2) ** 2, 2e-6 if t > 2.85 else 0.0

        things = [
            Thing("ego", "car", stops),
            Thing("aside", "pedestrian", standing(10, 12)),
            Thing("ahead", "pedestrian", standing(25, 0)),
        ]
        found = rows(with_columns(recording(things, until_s=3.0), "ego", vy_mps=lambda t: 0 * t), plan())
        assert math.isnan(found.loc[("GT", 0, "aside"), "conflict_detection_s"])
        assert found.loc[("GT", 0, "ahead"), "conflict_detection_s"] == 0.0

    def test_turning_back(self) -> None:
        """It drives 10 m, stops, and reverses, ever so slightly aside. Who stands 0.55 m clear of its side is in
        nobody's way, who stands where its front turns back is."""

        def back_and_forth(t: float) -> tuple[float, float]:
            return 10 * t - 2.5 * t * t, 0.01 * max(t - 2, 0.0)

        things = [
            Thing("ego", "car", back_and_forth),
            Thing("front", "pedestrian", standing(12.0, 0.0)),
            Thing("beside", "pedestrian", standing(9.0, 2.3)),
        ]
        found = rows(recording(things, until_s=4.0), plan())["conflict_detection_s"]
        assert math.isnan(found["GT", 0, "beside"])
        assert found["GT", 0, "front"] == 0.0

    def test_reversing(self) -> None:
        """It reverses at 2 m/s, heading east: its way is behind it, 2.5 + 6 m, also where the recording ends."""
        things = [
            Thing("ego", "car", driving(0, 0, -2)),
            Thing("behind", "pedestrian", standing(-11.05, 0)),
            Thing("ahead", "pedestrian", standing(2.8, 0)),
        ]
        found = rows(recording(things, until_s=2.0), plan())["conflict_detection_s"]
        assert found["GT", 0, "behind"] == pytest.approx(1.2), "10.8 ≤ 2 t + 8.5"
        assert math.isnan(found["GT", 0, "ahead"])

    def test_creeping(self) -> None:
        """1 cm from frame to frame, 0.1 m/s: 2.5 + 0.3 m ahead and 0.1 m/s on, wherever the places of its path are."""
        walker = Thing("walker", "pedestrian", standing(3.205, 0))
        log = recording([Thing("ego", "car", driving(0, 0, 0.1)), walker], until_s=4.0)
        assert event(log, plan()) == pytest.approx(1.6), "2.955 ≤ 0.1 t + 2.8 from 1.55 s on"

    def test_one_frame(self) -> None:
        """It is in a single frame, at 10 m and 10 m/s: that is enough to know where it is heading."""
        ego = Thing("ego", "car", driving(0, 0, 10), lambda t: 0.95 < t < 1.05)
        things = [ego, *(Thing(f"at {x}", "pedestrian", standing(x, 0)) for x in (42, 43))]
        found = rows(recording(things, until_s=2.0), plan())["conflict_detection_s"]
        assert found["GT", 0, "at 42"] == pytest.approx(1.0), "41.75 ≤ 10 + 32.5"
        assert math.isnan(found["GT", 0, "at 43"])

    def test_horizon_beyond_all_logs(self) -> None:
        """A slip of seconds for milliseconds is answered, not run out of memory on."""
        log = recording(
            [Thing("ego", "car", driving(0, 0, 10)), Thing("walker", "pedestrian", standing(45, 0))], until_s=1.0
        )
        assert event(log, plan(horizon_s=3000.0)) == 0.0


# Onset, stale lists, confirmation ---------------------------------------------------------------------------


class TestOnset:
    def two_rates(self, **measure: Any) -> pd.DataFrame:
        """A pedestrian stands in the standing ego's corridor throughout.

        A slow unit sees him at 0, 0.5, 1.0 … s; a quick one that sees nobody has the receiver issue lists at 10 Hz.
        """
        log = recording(
            [Thing("ego", "car", standing(0, 0)), Thing("walker", "pedestrian", standing(1, 0))], until_s=2.0
        )
        blind = [{"detection": {"kind": "constant", "probability": 0.0}}]
        wanted = plan(
            pems={"all": scenes.SEES_ALL, "blind": blind},
            units={
                "slow": {"at": [0, -10], "height_m": 5.0, "pem": "all", "rate_hz": 2.0},
                "quick": {"at": [0, 10], "height_m": 5.0, "pem": "blind", "rate_hz": 10.0},
            },
            configurations={"both": {"units": "all"}, "late": {"units": "all", "latency_s": {"slow": 0.25}}},
            measure={"onset": {"kind": "at", "time_s": 0.6}} | measure,
        )
        return rows(log, wanted).droplevel([1, 2])

    def test_what_was_captured_before_it_does_not_count(self) -> None:
        """The lists at 0.6 … 0.9 s hold him as he was at 0.5 s."""
        found = self.two_rates()
        assert found["conflict_detection_s"]["both"] == pytest.approx(1.0)
        assert found["time_to_conflict_detection_s"]["both"] == pytest.approx(0.4)
        assert found["conflict_detection_s"]["late"] == pytest.approx(1.25)

    def test_unless_asked_for(self) -> None:
        found = self.two_rates(count_earlier=True)
        assert found["conflict_detection_s"]["both"] == 0.0
        assert found["time_to_conflict_detection_s"]["both"] == pytest.approx(-0.6)
        assert found["conflict_detection_s"]["late"] == pytest.approx(0.25)

    @pytest.mark.parametrize("order", [["slow", "quick"], ["quick", "slow"]])
    def test_a_fresh_capture_makes_a_list_count_whoever_contributes_to_it(self, order: list[str]) -> None:
        """Two units that see him: the slow one's list is old, the quick one's list of 0.6 s is not."""
        log = recording(
            [Thing("ego", "car", standing(0, 0)), Thing("walker", "pedestrian", standing(1, 0))], until_s=2.0
        )
        units = {
            "slow": {"at": [0, -10], "height_m": 5.0, "pem": "all", "rate_hz": 2.0},
            "quick": {"at": [0, 10], "height_m": 5.0, "pem": "all", "rate_hz": 10.0},
        }
        wanted = plan(
            units={name: units[name] for name in order},
            configurations={"both": {"units": "all"}},
            measure={"onset": {"kind": "at", "time_s": 0.57}},
        )
        assert event(log, wanted, "both") == pytest.approx(0.6)

    @pytest.mark.parametrize(("onset_s", "expected_s"), [(0.65, 1.0), (0.7, 1.0), (0.75, math.nan), (0.0, 0.3)])
    @pytest.mark.parametrize("until_s", [1.0, 2.0])
    def test_a_list_that_arrives_after_he_left_is_too_late(
        self, onset_s: float, expected_s: float, until_s: float
    ) -> None:
        """He stands in the way and is in the log until 1 s; lists are 0.3 s late: the last that counts shows 0.7 s."""
        walker = Thing("walker", "pedestrian", standing(1, 0), lambda t: t < 1.01)
        log = recording([Thing("ego", "car", standing(0, 0)), walker], until_s=until_s)
        late = {"late": {"units": "truth", "latency_s": 0.3}}
        wanted = plan(configurations=late, measure={"onset": {"kind": "at", "time_s": onset_s}})
        assert event(log, wanted, "late") == pytest.approx(expected_s, nan_ok=True)

    def test_confirmation_counts_fused_lists(self) -> None:
        """Lists at 0.0, 0.1, 0.2 … hold him, by the one capture at 0 s."""
        onset = {"onset": FROM_THE_START}
        for hits, of, expected_s in [(1, 1, 0.0), (2, 2, 0.1), (2, 5, 0.1), (3, 3, 0.2), (8, 8, 0.7)]:
            found = self.two_rates(confirm={"hits": hits, "of": of}, **onset)
            assert found["conflict_detection_s"]["both"] == pytest.approx(expected_s)
        # One that counts begins at 1.0 s.
        found = self.two_rates(confirm={"hits": 3, "of": 4})
        assert found["conflict_detection_s"]["both"] == pytest.approx(1.2)

    def test_his_gap(self) -> None:
        """He stands in the way and is missing from 0.1 s to 1.1 s (not bridged); he is looked at from 0.5 s on."""
        there: Callable[[float], bool] = lambda t: t < 0.05 or t > 1.05  # noqa: E731
        walker = Thing("walker", "pedestrian", standing(1, 0), there)
        log = recording([Thing("ego", "car", standing(0, 0)), walker], until_s=2.0)
        wanted = plan(measure={"onset": {"kind": "at", "time_s": 0.5}})
        assert event(log, wanted) == pytest.approx(1.1)
        assert event(log, plan()) == 0.0

    def test_known_by_an_old_list_in_his_gap(self) -> None:
        """A list that is 0.3 s late implies it while the truth has a gap: there is no distance then."""
        there: Callable[[float], bool] = lambda t: t < 0.05 or t > 1.05  # noqa: E731
        walker = Thing("walker", "pedestrian", standing(1, 0), there)
        log = recording([Thing("ego", "car", standing(0, 0)), walker], until_s=2.0)
        late = {"late": {"units": "truth", "latency_s": 0.3}}
        found = rows(log, plan(configurations=late)).loc[("late", 0, "walker")]
        assert found["conflict_detected"]
        assert found["conflict_detection_s"] == pytest.approx(0.3)
        assert math.isnan(found["distance_at_conflict_detection_m"])

    @given(
        says=st.lists(st.sampled_from("asx"), min_size=21, max_size=21),
        hits=st.integers(1, 4),
        more=st.integers(0, 3),
        onset=st.integers(0, 12),
        count_earlier=st.booleans(),
    )
    @settings(max_examples=examples(60), deadline=None)  # an example replays a log
    def test_hits_of_the_last_lists(
        self, says: list[str], hits: int, more: int, onset: int, count_earlier: bool
    ) -> None:
        """3 m beside the standing ego he seems to approach (a) or to stand (s), or is missing (x), frame by frame."""
        says[0] = says[20] = "s"  # he is there from the first to the last frame
        walker = Thing("walker", "pedestrian", standing(0, -3), lambda t: says[round(t * 10)] != "x")
        log = recording([Thing("ego", "car", standing(0, 0)), walker], until_s=2.0)
        approach = np.array([float(said == "a") for said in says])
        log = with_columns(log, "walker", vy_mps=lambda t: approach[np.rint(t * 10).astype(int)])
        wanted = plan(
            max_gap_s=0.05,
            measure={
                "onset": {"kind": "at", "time_s": onset / 10},
                "confirm": {"hits": hits, "of": hits + more},
                "count_earlier": count_earlier,
            },
        )
        counts = [said == "a" and (count_earlier or k >= onset) for k, said in enumerate(says)]
        first = (k for k in range(21) if counts[k] and sum(counts[max(k - hits - more + 1, 0) : k + 1]) >= hits)
        k = next(first, None)
        assert event(log, wanted) == pytest.approx(math.nan if k is None else k / 10, nan_ok=True, abs=1e-9)


# Errors and runs --------------------------------------------------------------------------------------------

ERRORS = {
    "off": [
        {
            "detection": {"kind": "constant", "probability": 1.0},
            "error": {"kind": "gaussian", "covariance_m2": [[0.0, 0.0], [0.0, 0.0]], "mean_m": [0.0, 1.0]},
        }
    ],
    "noisy": [
        {
            "detection": {"kind": "constant", "probability": 0.7},
            "error": {"kind": "gaussian", "covariance_m2": [[1.0, 0.0], [0.0, 1.0]], "speed_sigma_mps": 0.3},
        }
    ],
    "sure": scenes.SEES_ALL,
}
TWO_UNITS = {
    "ego": {"on": "ego", "height_m": 1.8, "pem": "noisy"},
    "rsu": {"at": [45, -12], "height_m": 5.0, "pem": "noisy", "rate_hz": 7.3},
}
POSTERIOR = {"kind": "ideal", "combine": "posterior"}
FOUR = {
    "GT": {"units": "truth"},
    "PEM": {"units": ["ego"]},
    "two": {"units": "all", "latency_s": {"rsu": 0.2}},
    "drawn": {"units": "all", "fusion": POSTERIOR},
}


class TestErrors:
    @pytest.mark.parametrize("combine", ["samples", "posterior"])
    def test_a_constant_error_moves_it_by_what_he_seems_nearer(self, combine: str) -> None:
        """Seen 1 m nearer to the lane, he is implied 1 s earlier: at 0.25 s instead of 1.25 s."""
        configurations = {"PEM": {"units": ["ego"], "fusion": {"kind": "ideal", "combine": combine}}}
        wanted = plan(pems=ERRORS, units=wanted_units("off"), configurations=configurations)
        assert event(crossing(20, -6), wanted, "PEM") == pytest.approx(0.3)

    @pytest.mark.parametrize("combine", ["samples", "posterior"])
    def test_an_exact_unit_outweighs_a_noisy_one(self, combine: str) -> None:
        units = {"ego": EGO_UNIT | {"pem": "noisy"}, "rsu": {"at": [45, -12], "height_m": 5.0, "pem": "sure"}}
        configurations = {"two": {"units": "all", "fusion": {"kind": "ideal", "combine": combine}}}
        wanted = plan(pems=ERRORS, units=units, configurations=configurations, runs=5)
        found = rows(crossing(20, -6), wanted)["conflict_detection_s"]
        np.testing.assert_allclose(found, 1.3)

    def test_earlier_or_later(self) -> None:
        wanted = plan(pems=ERRORS, units=TWO_UNITS, configurations=FOUR, runs=200)
        found = rows(crossing(45, -6), wanted)
        assert (found.loc["GT", "conflict_detection_s"] - 1.3).abs().max() < 1e-9, "the truth has no errors"
        for name in ("PEM", "two", "drawn"):
            event_s = found.loc[name, "conflict_detection_s"]
            assert (event_s < 1.25).any()
            assert (event_s > 1.35).any()
            assert (event_s >= found.loc[name, "detection_s"] - 1e-9).all()

    @pytest.mark.parametrize("combine", ["samples", "posterior"])
    def test_how_often_at_once(self, combine: str) -> None:
        """He stands one standard deviation, 1 m, beside the corridor: 15.87 % of the first lists imply a conflict."""
        walker = Thing("walker", "pedestrian", standing(15, -2.75))
        log = recording([Thing("ego", "car", driving(0, 0, 10)), walker], until_s=0.5)
        error = {"kind": "gaussian", "covariance_m2": [[1.0, 0.0], [0.0, 1.0]]}
        one = {"one": [{"detection": {"kind": "constant", "probability": 1.0}, "error": error}]}
        configurations = {"PEM": {"units": ["ego"], "fusion": {"kind": "ideal", "combine": combine}}}
        wanted = plan(pems=one, units=wanted_units("one"), configurations=configurations, runs=2000)
        at_once = (rows(log, wanted)["conflict_detection_s"] < 1e-9).mean()
        assert 0.126 < at_once < 0.192, "4 standard deviations of a share of 2000"

    def test_a_wrong_speed_is_believed(self) -> None:
        """Speed errors of a standing pedestrian go along his heading: north, towards the lane. Without them, never."""
        walker = Thing("walker", "pedestrian", standing(20, -4), yaw_rad=math.pi / 2)
        log = recording([Thing("ego", "car", driving(0, 0, 10)), walker], until_s=1.5)
        fast = [
            {
                "detection": {"kind": "constant", "probability": 1.0},
                "error": {"kind": "gaussian", "covariance_m2": [[0, 0], [0, 0]], "speed_sigma_mps": 0.75},
            }
        ]
        wanted = plan(pems={"fast": fast}, units=wanted_units("fast"), configurations={"PEM": {"units": ["ego"]}},
                      runs=400)  # fmt: skip
        found = rows(log, wanted)["conflict_detection_s"]
        # 2.25 m within 3 s is one standard deviation: 15.87 % at each list, and of 400 between 9 and 23 % (4 σ).
        at_once = (found < 1e-9).mean()
        assert 0.09 < at_once < 0.23
        assert math.isnan(event(log, plan()))

    @given(
        log=logs(),
        onset=st.sampled_from([FROM_THE_START, {"kind": "in_range", "range_m": 25}, {"kind": "at", "time_s": 1.03}]),
        latency_s=st.sampled_from([0.0, 0.05, 0.35]),
        combine=st.sampled_from(["samples", "posterior"]),
    )
    @SOME
    def test_never_before_he_was_known(self, log: Drawn, onset: dict[str, Any], latency_s: float, combine: str) -> None:
        configurations = {
            "GT": {"units": "truth", "latency_s": latency_s},
            "all": {"units": "all", "latency_s": latency_s, "fusion": {"kind": "ideal", "combine": combine}},
        }
        for count_earlier in (False, True):
            wanted = plan(
                pems=ERRORS,
                units=TWO_UNITS,
                configurations=configurations,
                runs=5,
                measure={"onset": onset, "count_earlier": count_earlier},
            )
            found = study_rows(run_experiment(wanted, [log.log]))
            known = found[found["conflict_detected"]]
            assert known["detected"].all()
            assert (known["conflict_detection_s"] >= known["detection_s"] - 1e-9).all()
            assert (known["conflict_detection_s"] <= known["ended_s"] + 1e-6).all()
            if not count_earlier:
                assert (known["conflict_detection_s"] >= known["onset_s"] + latency_s - 1e-9).all()
            np.testing.assert_allclose(
                known["time_to_conflict_detection_s"], known["conflict_detection_s"] - known["onset_s"]
            )
            never = found[~found["conflict_detected"]]
            assert never[COLUMNS[1:]].isna().all(axis=None)
            assert not known[COLUMNS[1:3]].isna().any(axis=None)


class TestRuns:
    LOG = crossing(45, -6, until_s=3.0)
    WANTED = plan(
        pems=ERRORS, units=TWO_UNITS, configurations=FOUR, runs=12,
        measure={"confirm": {"hits": 2, "of": 3}, "onset": {"kind": "at", "time_s": 0.25}},
        braking={"driver": {"kind": "constant_deceleration", "a_max_mps2": 6.0,
                            "reaction": {"kind": "gamma", "shape": 1.4, "mean_s": 0.3}}, "brakes_for": "conflict"},
    )  # fmt: skip

    def test_alone_in_blocks_or_together(self) -> None:
        ready = prepare_log(self.LOG, self.WANTED)
        key = ["configuration", "run", "object_id"]
        together = replay_block(ready, self.WANTED, np.arange(12)).sort_values(key, ignore_index=True)
        for blocks in ([[k] for k in range(12)], [[0, 1, 2, 3, 4], [5], [6, 7, 8, 9, 10, 11]], [[11, 3], [*range(3)],
                       [10, 9, 8, 7, 6, 5, 4]]):  # fmt: skip
            parts = [replay_block(ready, self.WANTED, np.array(block)) for block in blocks]
            apart = pd.concat(parts, ignore_index=True).sort_values(key, ignore_index=True)
            pd.testing.assert_frame_equal(apart, together, check_exact=True)

    def test_whatever_the_number_of_workers_and_of_runs(self) -> None:
        one, two = (study_rows(run_experiment(self.WANTED, [self.LOG], jobs=jobs)) for jobs in (1, 2))
        pd.testing.assert_frame_equal(one, two, check_exact=True)
        fewer = study_rows(run_experiment(self.WANTED.model_copy(update={"runs": 5}), [self.LOG]))
        first = one[one["run"] < 5].reset_index(drop=True)
        pd.testing.assert_frame_equal(fewer, first, check_exact=True)

    @pytest.mark.parametrize("kept", [["GT"], ["PEM"], ["two"], ["drawn"], ["drawn", "PEM"], ["two", "drawn", "GT"]])
    def test_configurations_do_not_disturb_one_another(self, kept: list[str]) -> None:
        everything = study_rows(run_experiment(self.WANTED, [self.LOG])).set_index(
            ["configuration", "run", "object_id"]
        )
        fewer = self.WANTED.model_copy(
            update={"configurations": {name: self.WANTED.configurations[name] for name in kept}}
        )
        alone = study_rows(run_experiment(fewer, [self.LOG])).set_index(["configuration", "run", "object_id"])
        for name in kept:
            pd.testing.assert_frame_equal(alone.loc[[name]], everything.loc[[name]], check_exact=True)

    def test_another_object_does_not_disturb(self) -> None:
        walkers = [Thing(f"w{k}", "pedestrian", driving(45 + 3 * k, -6 - k, 0, 1)) for k in range(3)]
        ego = Thing("ego", "car", driving(0, 0, 10))
        alone = rows(recording([ego, walkers[1]], until_s=3.0), self.WANTED)
        together = rows(recording([ego, *walkers], until_s=3.0), self.WANTED)
        for name in FOUR:
            for number in range(12):
                pd.testing.assert_series_equal(
                    alone.loc[(name, number, "w1"), COLUMNS], together.loc[(name, number, "w1"), COLUMNS]
                )

    def test_detections_are_what_they_are_without_conflicts(self) -> None:
        without = experiment(
            pems=ERRORS, units=TWO_UNITS, configurations=FOUR, runs=12,
            measure={"confirm": {"hits": 2, "of": 3}, "onset": {"kind": "at", "time_s": 0.25}},
        )  # fmt: skip
        plain = study_rows(run_experiment(without, [self.LOG]))
        assert not set(COLUMNS) & set(plain.columns)
        pd.testing.assert_frame_equal(
            study_rows(run_experiment(self.WANTED, [self.LOG]))[plain.columns], plain, check_exact=True
        )

    def test_summary(self) -> None:
        """Implied at 1.3 s, 32.3 m away, and at 2.3 s, 22.5 m away, and never."""
        things = [
            Thing("ego", "car", driving(0, 0, 10)),
            Thing("first", "pedestrian", driving(45, -6, 0, 1)),
            Thing("second", "pedestrian", driving(45, -7, 0, 1)),
            Thing("third", "pedestrian", standing(45, -7)),
        ]
        result = run_experiment(plan(measure={"horizon_s": 2.8}), [recording(things, until_s=3.0)])
        found = result.summary.set_index("configuration").loc["GT"]
        assert found["detected_share"] == 1
        assert found["conflict_detected_share"] == pytest.approx(2 / 3)
        assert found["conflict_ttd_median_s"] == pytest.approx(2.3)
        assert pd.isna(found["conflict_ttd_p95_s"])
        assert found["conflict_ttd_rmst_s"] == pytest.approx((1.3 + 2.3 + 2.8) / 3)
        assert found["conflict_dad_median_m"] == pytest.approx(math.hypot(22.0, 4.7))

    def test_nothing_is_looked_at(self) -> None:
        wanted = plan(
            pems=ERRORS, units=TWO_UNITS, configurations=FOUR, runs=3, measure={"objects": {"classes": ["bus"]}},
            braking=BRAKING | {"brakes_for": "conflict"},
        )  # fmt: skip
        result = run_experiment(wanted, [self.LOG])
        assert len(study_rows(result)) == 0
        assert set(COLUMNS) <= set(study_rows(result).columns)
        assert result.summary["n"].tolist() == [0, 0, 0, 0]

    def test_one_log_of_two_has_nobody(self) -> None:
        empty = recording([Thing("ego", "car", driving(0, 0, 10))], until_s=1.0, log="empty")
        found = study_rows(run_experiment(plan(pems=ERRORS, units=TWO_UNITS, configurations=FOUR), [empty, self.LOG]))
        assert len(found) == 4
        assert found["conflict_detected"].dtype == bool
        assert found["conflict_detection_s"].dtype == float

    def test_never_listed(self) -> None:
        blind = {"blind": [{"detection": {"kind": "constant", "probability": 0.0}}]}
        wanted = plan(pems=blind, units=wanted_units("blind"), configurations={"PEM": {"units": ["ego"]}}, runs=3)
        found = rows(self.LOG, wanted)
        assert not found["conflict_detected"].any()
        assert found[COLUMNS[1:]].isna().all(axis=None)

    def test_no_list_is_ever_made(self) -> None:
        units = {"ego": EGO_UNIT | {"rate_hz": 1.0, "phase_s": 50.0}}
        found = rows(self.LOG, plan(units=units, configurations={"PEM": {"units": ["ego"]}} | GT_ONLY))
        assert not found.loc[("PEM", 0, "walker"), "conflict_detected"]
        assert found.loc[("GT", 0, "walker"), "conflict_detection_s"] == pytest.approx(1.3)

    def test_without_any_unit(self) -> None:
        assert event(self.LOG, plan(units={}, pems={})) == pytest.approx(1.3)

    def test_parked_ones_when_named(self) -> None:
        """A parked car that reaches into the lane is in the way, one at the kerb is not."""
        things = [
            Thing("ego", "car", driving(0, 0, 10)),
            Thing("kerb", "car", standing(45, -2.6), moving=False),
            Thing("lane", "car", standing(45, -2.4), moving=False),
        ]
        found = rows(recording(things, until_s=3.0), plan(measure={"objects": {"classes": ["car"]}}))
        assert math.isnan(found.loc[("GT", 0, "kerb"), "conflict_detection_s"])
        assert found.loc[("GT", 0, "lane"), "conflict_detection_s"] == pytest.approx(1.1), "43 ≤ 10 t + 32.5"

    def test_latency_beyond_the_log(self) -> None:
        found = rows(self.LOG, plan(configurations={"late": {"units": "truth", "latency_s": 100.0}}))
        assert not found["conflict_detected"].any()


# Braking for conflicts --------------------------------------------------------------------------------------

BRAKING: dict[str, Any] = {
    "driver": {"kind": "constant_deceleration", "a_max_mps2": 5.0, "reaction": {"kind": "constant", "delay_s": 0.5}}
}


class TestBraking:
    """At 10 m/s it stops within 10 m, and 0.5 s of reaction cost 5 m.

    A pedestrian 45 m ahead, in sight from the start, walks from y = −6 m at 1 m/s: he is in the lane (|y| = 1.25)
    at 4.75 s, when the ego that does not brake has just passed (47.25 m at 4.725 s); it comes within the margin.
    """

    def braked(self, brakes_for: str | None, **changes: Any) -> pd.Series:
        braking = BRAKING | ({} if brakes_for is None else {"brakes_for": brakes_for})
        return rows(crossing(45, -6), plan(braking=braking, **changes)).loc[("GT", 0, "walker")]

    def test_brakes_from_the_conflict_on(self) -> None:
        found = self.braked("conflict")
        assert found["conflict"]
        assert found["detection_s"] == 0
        assert found["conflict_detection_s"] == pytest.approx(1.3)
        assert found["brake_s"] == pytest.approx(1.8)
        assert found["braking_pass"]
        # It stands at 18 + 10 = 28 m, its front at 30 m; he crosses at 45 m, his near side at 44.75 m.
        assert found["min_distance_m"] == pytest.approx(14.75, abs=1e-3)

    @pytest.mark.parametrize("brakes_for", [None, "object"])
    def test_or_from_the_detection_on(self, brakes_for: str | None) -> None:
        found = self.braked(brakes_for)
        assert found["conflict_detection_s"] == pytest.approx(1.3)
        assert found["brake_s"] == pytest.approx(0.5)
        assert found["min_distance_m"] == pytest.approx(27.75, abs=1e-3), "it stands at 5 + 10 m, its front at 17 m"

    def test_what_is_foreseen_before_the_onset_is_no_hazard_yet(self) -> None:
        onset = {"onset": {"kind": "at", "time_s": 2.05}, "count_earlier": True}
        found = self.braked("conflict", measure=onset)
        assert found["conflict_detection_s"] == pytest.approx(1.3)
        assert found["time_to_conflict_detection_s"] == pytest.approx(-0.75)
        assert found["brake_s"] == pytest.approx(2.55)

    def test_who_never_foresees_it_never_brakes(self) -> None:
        """With a horizon of 1 ms and no margin, he is a conflict to nobody until the boxes touch, and they don't."""
        found = self.braked("conflict", horizon_s=0.001, margin_m=0.0)
        assert found["detected"]
        assert not found["conflict_detected"]
        assert found["conflict"], "by the truth it comes within the margin"
        assert math.isnan(found["brake_s"])
        assert not found["braking_pass"]

    def test_the_reaction_is_the_same_whatever_it_brakes_for(self) -> None:
        gamma = {"kind": "constant_deceleration", "a_max_mps2": 5.0,
                 "reaction": {"kind": "gamma", "shape": 1.4, "mean_s": 0.3}}  # fmt: skip
        by_object, by_conflict = (
            rows(crossing(45, -6), plan(braking={"driver": gamma, "brakes_for": what}, runs=6))
            for what in ("object", "conflict")
        )
        np.testing.assert_allclose(
            by_object["brake_s"] - by_object["detection_s"],
            by_conflict["brake_s"] - by_conflict["conflict_detection_s"],
        )

    def test_configuration_by_configuration(self) -> None:
        wanted = plan(
            pems=ERRORS, units=TWO_UNITS, configurations=FOUR, runs=10, braking=BRAKING | {"brakes_for": "conflict"}
        )  # fmt: skip
        found = rows(crossing(45, -6), wanted)
        assert found["conflict"].all()
        np.testing.assert_allclose(found["brake_s"], found["conflict_detection_s"] + 0.5)
        assert found.groupby(level=0)["brake_s"].nunique()["PEM"] > 1


# The file and the command -----------------------------------------------------------------------------------

BRAKES = "driver: {kind: constant_deceleration, a_max_mps2: 5.0}"


class TestFile:
    def said(self, folder: Path, *changes: str) -> list[str]:
        (folder / "drive.mcap").touch()
        source = source_of(folder, changed(*changes))
        return [line.removeprefix(f"{source.path}:") for line in find_problems(source)[1]]

    @pytest.mark.parametrize(
        "measure", ["measure: {}", "measure: {conflict: null}", "measure: {onset: {kind: appears}}"]
    )
    def test_brakes_for_conflict_needs_to_know_what_one_is(self, tmp_path: Path, measure: str) -> None:
        found = self.said(tmp_path, measure, f"braking: {{{BRAKES}, brakes_for: conflict}}")
        assert len(found) == 1
        assert found[0].startswith("19: braking.brakes_for: ")
        assert "brakes_for" in found[0]
        assert "measure.conflict" in found[0]

    @pytest.mark.parametrize("given_as", ["{}", "{horizon_s: 3}", "{margin_m: 0.5}", "{horizon_s: 3.0, margin_m: 0.5}"])
    def test_the_defaults(self, tmp_path: Path, given_as: str) -> None:
        (tmp_path / "drive.mcap").touch()
        text = changed(f"measure: {{conflict: {given_as}}}", f"braking: {{{BRAKES}, brakes_for: conflict}}")
        read, found = find_problems(source_of(tmp_path, text))
        assert found == []
        assert read is not None
        assert read.measure.conflict == Conflict(horizon_s=3.0, margin_m=0.5)
        assert read.braking is not None
        assert read.braking.brakes_for == "conflict"

    @pytest.mark.parametrize(
        ("given_as", "key"),
        [
            ("{horizon_s: 0}", "measure.conflict.horizon_s"),
            ("{horizon_s: -1}", "measure.conflict.horizon_s"),
            ("{margin_m: -0.1}", "measure.conflict.margin_m"),
            ("{horizon_s: three}", "measure.conflict.horizon_s"),
            ("{horizon: 3}", "measure.conflict.horizon"),
            ("true", "measure.conflict"),
        ],
    )
    def test_what_is_wrong_is_said(self, tmp_path: Path, given_as: str, key: str) -> None:
        found = self.said(tmp_path, f"measure: {{conflict: {given_as}}}")
        assert len(found) == 1
        assert found[0].startswith(f"17: {key}: ")

    def test_without_braking_for_them_conflicts_need_no_braking(self, tmp_path: Path) -> None:
        assert self.said(tmp_path, "measure: {conflict: {}}") == []
        assert self.said(tmp_path, "measure: {}", f"braking: {{{BRAKES}}}") == []


class TestCommand:
    """The ego (1) drives at 10 m/s; a pedestrian (2) walks from y = −6 m at 1 m/s, 45 m ahead; one (3) stands aside."""

    @pytest.fixture
    def here(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
        frames = [
            (
                0.1 * k,
                [
                    Obj(id=1, x=float(k), vx=10.0),
                    pedestrian(2, 45.0, -6.0 + 0.1 * k, vx=0.0, vy=1.0, width=0.5),
                    pedestrian(3, 30.0, -6.0, vx=0.0),
                ],
            )
            for k in range(31)
        ]
        write_recording(tmp_path / "drive.mcap", frames, host=1)
        monkeypatch.chdir(tmp_path)
        return tmp_path

    def called(self, monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
        monkeypatch.setattr(sys, "argv", ["copem-replay", *arguments])
        return cli._run_to_exit_code()

    def test_results(self, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        text = changed(
            "runs: 4", "measure: {onset: {kind: appears}, began: [log_start, appeared], conflict: {}}",
            f"braking: {{{BRAKES}, brakes_for: conflict}}",
        )  # fmt: skip
        (here / "e.yaml").write_text(text, encoding="utf-8")
        assert self.called(monkeypatch, "check", "e.yaml") == 0
        assert self.called(monkeypatch, "run", "e.yaml", "--out", "out", "--jobs", "1") == 0
        table = parquet.read_table(here / "out" / "detections.parquet")
        found = table.to_pandas().set_index(["configuration", "run", "object_id"])
        for name in COLUMNS[1:]:
            assert not np.isnan(table[name].drop_null().to_numpy()).any(), "what does not exist is null"
            assert table[name].null_count == (~found["conflict_detected"]).sum()
        assert found["conflict_detected"].dtype == bool
        for number in range(4):
            assert found.loc[("GT", number, "2"), "conflict_detection_s"] == pytest.approx(1.3)
            assert found.loc[("GT", number, "2"), "distance_at_conflict_detection_m"] == pytest.approx(
                math.hypot(32.0, 4.7)
            )
            assert not found.loc[("GT", number, "3"), "conflict_detected"]
        # As it was written, the experiment gives the same again.
        assert self.called(monkeypatch, "run", "out/experiment.yaml", "--out", "again", "--jobs", "2") == 0
        again, first = (here / name / "detections.parquet" for name in ("again", "out"))
        assert again.read_bytes() == first.read_bytes()

    def test_check_refuses(
        self, here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        (here / "e.yaml").write_text(changed(f"braking: {{{BRAKES}, brakes_for: conflict}}"), encoding="utf-8")
        for command in (["check", "e.yaml"], ["run", "e.yaml", "--out", "out"]):
            assert self.called(monkeypatch, *command) == 2
            said = capsys.readouterr().err.splitlines()
            assert len(said) == 1
            assert said[0].startswith("e.yaml:19: braking.brakes_for: ")
            assert "measure.conflict" in said[0]
        assert not (here / "out").exists()

    @pytest.mark.parametrize("how", ["file", "option"])
    def test_there_is_no_ego_to_collide(
        self, how: str, here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        text = changed(
            "  ego: {on: ego, height_m: 1.8, pem: onboard}", "  PEM: {units: [mast]}",
            "measure: {onset: {kind: appears}, began: [log_start, appeared], conflict: {}, distance_to: mast}",
        ).replace("  ego: {on: ego, height_m: 1.8, pem: onboard}\n", "")  # fmt: skip
        if how == "file":
            text += "ego: none\n"
        (here / "e.yaml").write_text(text, encoding="utf-8")
        option = ["--ego", "none"] if how == "option" else []
        assert self.called(monkeypatch, "run", "e.yaml", *option, "--out", "out") == 2
        said = capsys.readouterr().err
        assert "conflict" in said
        assert "ego" in said

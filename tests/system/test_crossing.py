"""The crossing: its traffic is what it claims to be, and its experiment tells the configurations apart.

The recording is decoded here with osi3 alone, and who touches or hides whom is worked out with Shapely. Only the last
section replays it.
"""

from __future__ import annotations

import importlib
import math
import re
import subprocess
import sys
from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import pytest
import shapely
from mcap.reader import make_reader
from osi3.osi_groundtruth_pb2 import GroundTruth
from osi3.osi_lane_pb2 import LaneBoundary
from osi3.osi_object_pb2 import MovingObject
from ruamel.yaml import YAML
from shapely import LineString, Point, Polygon, affinity

import copem_replay as cr
from copem_replay.experiment.file import log_paths, read_experiment_file
from copem_replay.experiment.validate import check_across_logs, find_problems, read_logs
from copem_replay.extras.maps.registry import read_map
from copem_replay.io.write.osi import write_osi_trace
from copem_replay.pipeline.run import run_experiment
from tests.helpers.replays import study_rows

ROOT = Path(__file__).resolve().parents[2]
LOG = ROOT / "logs" / "crossing.mcap"
EXPERIMENT = ROOT / "logs" / "crossing_units.yaml"
FRAME_S = 0.1

EGO, TRUCK_AHEAD, PARKED_VAN, BUS, TRUCK_ONCOMING, CYCLIST = 1, 3, 8, 10, 12, 15
SECOND_CAR, WAITING_VAN, GETS_ON, GETS_OFF, CHILD = 32, 33, 51, 52, 53
APPEAR_IN_SIGHT = {GETS_OFF, CHILD, 54, 55, 56}
LEAVE_IN_SIGHT = {GETS_ON, GETS_OFF, CHILD, 54, 56}
EAST, NORTH, WEST, SOUTH = 0, 90, 180, -90

Kind = MovingObject.VehicleClassification
VEHICLES = {
    Kind.TYPE_MEDIUM_CAR: "car",
    Kind.TYPE_LUXURY_CAR: "car",
    Kind.TYPE_COMPACT_CAR: "car",
    Kind.TYPE_DELIVERY_VAN: "van",
    Kind.TYPE_HEAVY_TRUCK: "truck",
    Kind.TYPE_BUS: "bus",
    Kind.TYPE_BICYCLE: "bicycle",
}


class State(NamedTuple):
    """An object in one frame."""

    kind: str
    size_m: tuple[float, float, float]
    x_m: float
    y_m: float
    yaw_rad: float
    velocity_mps: tuple[float, float]

    @property
    def speed_mps(self) -> float:
        return math.hypot(*self.velocity_mps)

    @property
    def footprint(self) -> Polygon:
        length, width, _ = self.size_m
        box = shapely.box(-length / 2, -width / 2, length / 2, width / 2)
        turned = affinity.rotate(box, self.yaw_rad, origin=(0, 0), use_radians=True)
        return affinity.translate(turned, self.x_m, self.y_m)

    def front(self, heading_deg: int) -> float:
        """How far the front is beyond the centre of the crossing, along a heading."""
        heading = math.radians(heading_deg)
        return self.x_m * math.cos(heading) + self.y_m * math.sin(heading) + self.size_m[0] / 2


Scene = dict[int, State]


def _state(osi: Any) -> State:
    base = osi.base
    if isinstance(osi, MovingObject):
        vehicle = osi.type == MovingObject.TYPE_VEHICLE
        kind = VEHICLES[osi.vehicle_classification.type] if vehicle else "pedestrian"
        velocity = (base.velocity.x, base.velocity.y)
    else:
        kind, velocity = "stationary", (0.0, 0.0)
    size = (base.dimension.length, base.dimension.width, base.dimension.height)
    assert base.position.z == size[2] / 2
    return State(kind, size, base.position.x, base.position.y, base.orientation.yaw, velocity)


@pytest.fixture(scope="module")
def messages() -> list[GroundTruth]:
    with LOG.open("rb") as stream:
        return [GroundTruth.FromString(message.data) for *_, message in make_reader(stream).iter_messages()]


@pytest.fixture(scope="module")
def scenes(messages: list[GroundTruth]) -> list[Scene]:
    return [{osi.id.value: _state(osi) for osi in message.moving_object} for message in messages]


@pytest.fixture(scope="module")
def furniture(messages: list[GroundTruth]) -> Scene:
    return {osi.id.value: _state(osi) for osi in messages[0].stationary_object}


@pytest.fixture(scope="module")
def stays(scenes: list[Scene]) -> dict[int, list[int]]:
    """Frames in which each object is there."""
    frames: dict[int, list[int]] = {}
    for frame, scene in enumerate(scenes):
        for key in scene:
            frames.setdefault(key, []).append(frame)
    return frames


@pytest.fixture(scope="module")
def experiment() -> dict[str, Any]:
    return YAML(typ="safe").load(EXPERIMENT.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def houses(experiment: dict[str, Any]) -> list[Polygon]:
    return [Polygon(obstacle["polygon_m"]) for obstacle in experiment["obstacles"]]


# The file ---------------------------------------------------------------------------------------------------


def test_the_committed_log_is_what_the_tool_makes(tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "tools"))
        make_logs = importlib.import_module("make_logs")
        write_osi_trace(make_logs.recipes()["crossing"](), tmp_path / LOG.name)
    assert (tmp_path / LOG.name).read_bytes() == LOG.read_bytes(), "run python tools/make_logs.py crossing"


def test_it_is_small_and_lasts_a_minute(messages: list[GroundTruth]) -> None:
    assert LOG.stat().st_size < 1_500_000
    stamps_ns = [message.timestamp.seconds * 10**9 + message.timestamp.nanos for message in messages]
    assert stamps_ns == [frame * 10**8 for frame in range(601)]


# Who is there -----------------------------------------------------------------------------------------------


def test_who_is_there(scenes: list[Scene]) -> None:
    kinds = {key: state.kind for scene in scenes for key, state in scene.items()}
    assert Counter(kinds.values()) == {"car": 14, "van": 3, "truck": 2, "bus": 1, "bicycle": 5, "pedestrian": 17}
    assert min(len(scene) for scene in scenes) >= 20
    for one, other in pairwise(scenes):
        assert all(one[key].size_m == other[key].size_m for key in one.keys() & other.keys())


def test_the_road_is_in_the_first_message(messages: list[GroundTruth], scenes: list[Scene], furniture: Scene) -> None:
    """No kerb runs through a vehicle or through what stands, and crosswalks join kerbs. Who crosses at a crosswalk is
    between its lines.
    """
    assert not any(message.lane_boundary for message in messages[1:])
    lines: dict[int, list[LineString]] = {}
    for osi in messages[0].lane_boundary:
        points = [(point.position.x, point.position.y) for point in osi.boundary_line]
        lines.setdefault(osi.classification.type, []).append(LineString(points))
    kerbs = shapely.union_all(lines[LaneBoundary.Classification.TYPE_CURB])
    across = [line for line in lines[LaneBoundary.Classification.TYPE_DASHED_LINE] if line.length == 12.4]
    assert (len(lines[LaneBoundary.Classification.TYPE_CURB]), len(across)) == (4, 8)
    assert all(kerbs.distance(Point(end)) < 0.2 for line in across for end in line.coords)
    crosswalks = shapely.union_all([one.union(other).envelope for one in across for other in across
                                    if one.distance(other) == pytest.approx(3.2)])  # fmt: skip
    walkers = range(40, 51)
    for scene in [*scenes[::5], furniture]:
        for key, state in scene.items():
            if state.kind != "pedestrian":
                assert kerbs.disjoint(state.footprint), key
            elif key in walkers and min(abs(state.x_m), abs(state.y_m)) < 6:
                assert crosswalks.contains(state.footprint), key


def test_the_ego_is_the_host_from_begin_to_end(messages: list[GroundTruth], stays: dict[int, list[int]]) -> None:
    assert {message.host_vehicle_id.value for message in messages} == {EGO}
    assert len(stays[EGO]) == 601


def test_nobody_is_interrupted_and_many_come_late_or_leave_early(stays: dict[int, list[int]]) -> None:
    for frames in stays.values():
        assert frames == list(range(frames[0], frames[-1] + 1))
    assert sum(frames[0] > 0 for frames in stays.values()) >= 15
    assert sum(frames[-1] < 600 for frames in stays.values()) >= 12


def test_they_come_and_leave_at_the_edge_or_in_sight(scenes: list[Scene], stays: dict[int, list[int]]) -> None:
    def at_the_edge(frame: int, key: int) -> bool:
        return max(abs(scenes[frame][key].x_m), abs(scenes[frame][key].y_m)) > 118

    appear = {key for key, frames in stays.items() if frames[0] > 0 and not at_the_edge(frames[0], key)}
    leave = {key for key, frames in stays.items() if frames[-1] < 600 and not at_the_edge(frames[-1], key)}
    walk_in = {48, 49, 50}  # on sidewalks that the recording shows from 60 or 75 m on
    assert appear == APPEAR_IN_SIGHT | walk_in
    assert leave == LEAVE_IN_SIGHT


def test_the_street_furniture_never_changes(messages: list[GroundTruth], furniture: Scene) -> None:
    assert len(furniture) == 7
    for message in messages:
        assert {osi.id.value: _state(osi) for osi in message.stationary_object} == furniture


# How they move ----------------------------------------------------------------------------------------------


def test_nothing_overlaps_anything_in_any_frame(scenes: list[Scene], furniture: Scene, houses: list[Polygon]) -> None:
    still = [*(state.footprint for state in furniture.values()), *houses]
    assert len(houses) == 3
    for frame, scene in enumerate(scenes):
        boxes = [*(state.footprint for state in scene.values()), *still]
        pairs = shapely.STRtree(boxes).query(boxes, predicate="intersects")
        names = [*scene, *furniture, *(f"house {k}" for k in range(len(houses)))]
        met = [(names[a], names[b]) for a, b in pairs.T if a < b]
        assert met == [], f"at {frame * FRAME_S:.1f} s"


def test_speeds_are_those_of_the_positions(scenes: list[Scene]) -> None:
    for before, after in pairwise(scenes):
        for key in before.keys() & after.keys():
            way_m = math.dist((before[key].x_m, before[key].y_m), (after[key].x_m, after[key].y_m))
            mean_mps = (before[key].speed_mps + after[key].speed_mps) / 2
            # positions and speeds lie on a grid of 2⁻¹⁰ m
            assert way_m / FRAME_S == pytest.approx(mean_mps, abs=0.03)


def test_nobody_is_faster_or_brakes_harder_than_one_can(scenes: list[Scene]) -> None:
    fastest_mps = {"pedestrian": 3.1, "bicycle": 6, "car": 14, "van": 14, "truck": 14, "bus": 14}
    for before, after in pairwise(scenes):
        for key in before.keys() & after.keys():
            assert after[key].speed_mps <= fastest_mps[after[key].kind]
            change_mps2 = (after[key].speed_mps - before[key].speed_mps) / FRAME_S
            assert -5.1 <= change_mps2 <= 1.6  # the last 0.05 m/s are cut off


def test_they_look_where_they_go_and_turn_smoothly(scenes: list[Scene]) -> None:
    for scene in scenes:
        for state in scene.values():
            east, north = state.velocity_mps
            assert east * math.sin(state.yaw_rad) == pytest.approx(north * math.cos(state.yaw_rad), abs=1e-6)
            assert east * math.cos(state.yaw_rad) + north * math.sin(state.yaw_rad) >= 0
    for before, after in pairwise(scenes):
        for key in before.keys() & after.keys():
            turned_rad = abs(math.remainder(after[key].yaw_rad - before[key].yaw_rad, math.tau))
            sideways_mps2 = turned_rad / FRAME_S * (before[key].speed_mps + after[key].speed_mps) / 2
            assert sideways_mps2 < 2.5


@pytest.mark.parametrize("heading", [EAST, NORTH, WEST, SOUTH])
def test_nobody_drives_over_the_stop_line_at_red(scenes: list[Scene], heading: int) -> None:
    along_east = heading in (EAST, WEST)
    green_s = [(0, 4), (32, 50)] if along_east else [(9, 26), (56, 61)]
    yellow_s = 2.0
    passed = 0
    for frame, (before, after) in enumerate(pairwise(scenes)):
        for key in before.keys() & after.keys():
            state = before[key]
            off_course = math.remainder(state.yaw_rad - math.radians(heading), math.tau)
            if state.kind == "pedestrian" or abs(off_course) > 0.01:
                continue
            if state.front(heading) < -12 <= after[key].front(heading):
                passed += 1
                assert any(start <= frame * FRAME_S <= end + yellow_s for start, end in green_s), (key, frame)
    assert passed >= 2


def test_on_the_crosswalks_one_walks_at_green(scenes: list[Scene]) -> None:
    def on(state: State, along_east: bool) -> bool:
        along_m, beside_m = (state.x_m, state.y_m) if along_east else (state.y_m, state.x_m)
        return state.kind == "pedestrian" and abs(along_m) < 5.6 and 8 < abs(beside_m) < 12

    walkers: dict[bool, set[int]] = {True: set(), False: set()}
    for frame, scene in enumerate(scenes):
        for key, state in scene.items():
            for along_east, green_s in ((True, [(0, 7), (32, 52)]), (False, [(9, 27), (56, 61)])):
                if on(state, along_east):
                    walkers[along_east].add(key)
                    assert any(start <= frame * FRAME_S <= end for start, end in green_s), (key, frame)
    assert len(walkers[True]) >= 4
    assert len(walkers[False]) >= 4


# What makes it interesting ----------------------------------------------------------------------------------


def hidden_by(scene: Scene, key: int) -> set[int]:
    """Which road users are, on the ground, between the ego's centre and another's."""
    ego, other = scene[EGO], scene[key]
    sight = LineString([(ego.x_m, ego.y_m), (other.x_m, other.y_m)])
    return {k for k, state in scene.items() if k not in (EGO, key) and state.footprint.intersects(sight)}


def test_the_ego_waits_behind_the_truck_and_turns_left(scenes: list[Scene]) -> None:
    waits = [frame for frame, scene in enumerate(scenes) if scene[EGO].speed_mps == 0]
    assert waits[-1] - waits[0] > 120
    for frame in waits:
        ego, truck = scenes[frame][EGO], scenes[frame][TRUCK_AHEAD]
        assert 1 < ego.footprint.distance(truck.footprint) < 3
    assert scenes[0][EGO].yaw_rad == 0
    assert scenes[0][EGO].x_m < -100
    assert scenes[-1][EGO].yaw_rad == pytest.approx(math.pi / 2, abs=1e-3)
    assert scenes[-1][EGO].y_m > 100


def test_who_gets_off_the_bus_steps_out_right_before_the_ego(scenes: list[Scene], stays: dict[int, list[int]]) -> None:
    first_seen = next(f for f in stays[GETS_OFF] if not hidden_by(scenes[f], GETS_OFF))
    behind = {key for f in range(stays[GETS_OFF][0], first_seen) for key in hidden_by(scenes[f], GETS_OFF)}
    assert BUS in behind
    assert first_seen * FRAME_S > stays[GETS_OFF][0] * FRAME_S + 8
    ego, walker = scenes[first_seen][EGO], scenes[first_seen][GETS_OFF]
    assert ego.footprint.distance(walker.footprint) < 6
    ahead = [scenes[f][GETS_OFF] for f in stays[GETS_OFF] if abs(scenes[f][GETS_OFF].y_m - ego.y_m) < 1]
    assert all(ego.footprint.distance(state.footprint) < 1.5 for state in ahead)  # between ego and truck


def test_the_oncoming_truck_hides_the_cyclist_while_the_ego_turns(scenes: list[Scene]) -> None:
    hides = [f for f, scene in enumerate(scenes) if {CYCLIST, TRUCK_ONCOMING} <= scene.keys()]
    hides = [f for f in hides if TRUCK_ONCOMING in hidden_by(scenes[f], CYCLIST)]
    assert len(hides) >= 10
    near_m = min(scenes[f][EGO].footprint.distance(scenes[f][CYCLIST].footprint) for f in range(350, 450))
    assert near_m < 10


def test_the_child_is_hidden_until_the_ego_is_near_and_the_ego_brakes(
    scenes: list[Scene], stays: dict[int, list[int]]
) -> None:
    first_seen = next(f for f in stays[CHILD] if not hidden_by(scenes[f], CHILD))
    assert (first_seen - stays[CHILD][0]) * FRAME_S >= 1
    assert {WAITING_VAN} <= hidden_by(scenes[first_seen - 1], CHILD) | hidden_by(scenes[first_seen - 2], CHILD)
    ego, child = scenes[first_seen][EGO], scenes[first_seen][CHILD]
    assert ego.footprint.distance(child.footprint) < 15
    least_mps2 = min(
        (scenes[f + 1][EGO].speed_mps - scenes[f][EGO].speed_mps) / FRAME_S for f in range(first_seen, first_seen + 20)
    )
    assert least_mps2 < -3


def test_the_van_is_parked_and_the_bus_stops(scenes: list[Scene], stays: dict[int, list[int]]) -> None:
    assert {scene[PARKED_VAN].speed_mps for scene in scenes} == {0.0}
    stands = [f for f in stays[BUS] if scenes[f][BUS].speed_mps == 0]
    assert (stands[-1] - stands[0]) * FRAME_S > 15
    assert stands[0] < stays[GETS_ON][-1] < stands[-1]
    assert stands[0] < stays[GETS_OFF][0] < stands[-1]
    for key, frame in ((GETS_ON, stays[GETS_ON][-1]), (GETS_OFF, stays[GETS_OFF][0])):
        assert scenes[frame][BUS].footprint.distance(scenes[frame][key].footprint) < 1.2


# The experiment ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def table() -> pd.DataFrame:
    source = read_experiment_file(EXPERIMENT)
    source.data["runs"] = 10
    source.data["measure"]["accuracy"] = False
    checked, found = find_problems(source)
    assert found == []
    assert checked is not None
    paths, _ = log_paths(source)
    recordings, refused = read_logs(checked, paths, source)
    assert refused == []
    assert list(check_across_logs(checked, recordings, source)) == []
    assert [note for recording in recordings for note in recording.notes] == []
    result = run_experiment(checked, recordings, jobs=2)
    assert list(result.notes) == []
    assert list(result.summary["configuration"]) == list(checked.configurations)
    return study_rows(result)


def test_masts_carry_the_roadside_units_and_vehicles_the_others(
    experiment: dict[str, Any], scenes: list[Scene], furniture: Scene
) -> None:
    masts = {(state.x_m, state.y_m): state.size_m[2] for state in furniture.values()}
    units = experiment["units"]
    roadside = [unit for unit in units.values() if "at" in unit]
    assert len(roadside) == 3
    for unit in roadside:
        assert 5 <= unit["height_m"] <= masts[tuple(unit["at"])]
    kinds = {key: state.kind for scene in scenes for key, state in scene.items()}
    assert {kinds[unit["on"]] for unit in units.values() if unit.get("on", "ego") != "ego"} == {"bus", "car"}


def test_one_house_is_not_convex(houses: list[Polygon]) -> None:
    assert [house.convex_hull.area > house.area + 100 for house in houses] == [False, True, False]


def test_the_garden_wall_hides_one_pedestrian(scenes: list[Scene], furniture: Scene) -> None:
    """In closed form: pedestrian 50 is known 4.77 s later by the ego alone, .07 s with the masts, nobody else."""
    data = YAML(typ="safe").load((ROOT / "logs/crossing_wall.yaml").read_text(encoding="utf-8"))
    wall = Polygon(data["obstacles"][-1]["polygon_m"])
    touched = {k for scene in [*scenes, furniture] for k, state in scene.items() if state.footprint.intersects(wall)}
    assert touched == set()
    assert wall.bounds[0] - 6.2 == pytest.approx(4.1), "metres from the kerb"

    def unknown_s(obstacles: list[Any]) -> dict[tuple[str, str], float]:
        given = data | {"logs": [str(LOG)], "obstacles": obstacles, "measure": data["measure"] | {"accuracy": False}}
        exact = cr.run(cr.load_experiment(given), [LOG], jobs=1).exact
        found = {}
        for key, rows in exact.groupby(["configuration", "object_id"]):
            known = rows.dropna(subset=["detection_s"])
            instants = [rows["onset_s"].iloc[0], *known["detection_s"], rows["ended_s"].iloc[0]]
            left = [1, *(1 - known["incidence"])]
            found[key] = sum(s * (b - a) for s, (a, b) in zip(left, pairwise(instants), strict=True))
        return found

    walled, free = unknown_s(data["obstacles"]), unknown_s(data["obstacles"][:-1])
    later_s = {key: walled[key] - free[key] for key in free if walled[key] != free[key]}
    assert later_s == pytest.approx({("onboard", "50"): 4.768, ("roadside", "50"): 0.068}, abs=1e-3)


@pytest.mark.parametrize(
    ("gone", "configuration", "later_s"),
    [("garden_wall", "onboard", {"50": 4.8}), ("kiosk", "roadside", {"45": 0.3, "49": 1.0})],
    ids=["wall", "house"],
)
def test_what_stands_on_the_map_hides(tmp_path: Path, gone: str, configuration: str, later_s: dict[str, float]) -> None:
    """Pedestrian 50 is known 4.77 s later by the ego alone, as in `crossing_wall.yaml`; nobody else without the wall.

    Without the kiosk the masts know pedestrians 45 and 49 sooner, more likely than not by so much.
    """
    drawn = (ROOT / "logs/crossing.xodr").read_text(encoding="utf-8")
    without = re.sub(rf'<object id="{gone}".*?</object>', "", drawn, flags=re.DOTALL)
    data = YAML(typ="safe").load((ROOT / "logs/crossing_map.yaml").read_text(encoding="utf-8"))
    latest_s = []
    for text in (drawn, without):
        (tmp_path / "crossing.xodr").write_text(text, encoding="utf-8")
        measure = data["measure"] | {"accuracy": False}
        entry = data["maps"][0] | {"file": str(tmp_path / "crossing.xodr")}
        given = data | {"logs": [str(LOG)], "maps": [entry], "measure": measure}
        exact = cr.run(cr.load_experiment(given), [LOG], jobs=1).exact
        alone = exact[(exact["configuration"] == configuration) & exact["detection_s"].notna()]
        latest_s.append(alone[alone["incidence"] >= 0.5].groupby("object_id")["detection_s"].min())
    late_s = latest_s[0] - latest_s[1]
    assert late_s[late_s != 0].to_dict() == pytest.approx(later_s, abs=0.2)


def test_nobody_walks_through_what_stands_on_the_map(scenes: list[Scene], furniture: Scene) -> None:
    standing = [Polygon(solid.rings_m[0]) for solid in read_map(ROOT / "logs/crossing.xodr").solids]
    assert len(standing) == 5
    for scene in (*scenes, furniture):
        assert not any(state.footprint.intersects(solid) for state in scene.values() for solid in standing)


def test_the_map_of_the_crossing_is_what_its_script_writes(tmp_path: Path) -> None:
    subprocess.run([sys.executable, ROOT / "tools/crossing_map.py", "--out", tmp_path], check=True)
    assert (tmp_path / "crossing.xodr").read_bytes() == (ROOT / "logs/crossing.xodr").read_bytes()


def test_everybody_within_50_m_of_the_ego_is_looked_at(table: pd.DataFrame, scenes: list[Scene]) -> None:
    onsets: dict[str, int] = {}
    for frame, scene in enumerate(scenes):
        for key, state in scene.items():
            apart_m = math.dist((state.x_m, state.y_m), (scene[EGO].x_m, scene[EGO].y_m))
            if state.kind in ("pedestrian", "bicycle") and apart_m <= 50:
                onsets.setdefault(str(key), frame)
    assert len(onsets) >= 20
    for _, part in table.groupby(["configuration", "run"]):
        assert sorted(part["object_id"]) == sorted(onsets)
    for row in table.itertuples():
        assert row.onset_s == pytest.approx(onsets[row.object_id] * FRAME_S, abs=1e-9)


def test_the_configurations_differ(table: pd.DataFrame) -> None:
    known = table.groupby("configuration")["detected"].mean()
    assert known["GT"] == 1
    assert known["onboard"] < known["V2V:0.1s"] < known["all:0.1s"]
    assert known["roadside:0.1s"] > known["V2V:0.1s"]
    horizon_s = (table["ended_s"] - table["onset_s"]).max()
    mean_s = table["time_to_detection_s"].fillna(horizon_s).groupby(table["configuration"]).mean()
    assert mean_s["GT"] < mean_s["all:0.1s"] < mean_s["roadside:0.1s"] < mean_s["V2V:0.1s"] < mean_s["onboard"]
    assert mean_s["all:0.1s"] < mean_s["all:mixed"] < mean_s["all:0.5s"]
    for name in ("roadside", "V2V", "all"):
        assert mean_s[f"{name}:0.1s"] < mean_s[f"{name}:0.5s"]


def test_more_units_never_know_later(table: pd.DataFrame) -> None:
    late_s = table["time_to_detection_s"].fillna(math.inf)
    by = late_s.set_axis(pd.MultiIndex.from_frame(table[["configuration", "run", "object_id"]])).unstack(0)
    for name in ("0.1s", "0.5s"):
        assert (by[f"all:{name}"] <= by[f"roadside:{name}"] + 1e-9).all()
        assert (by[f"all:{name}"] <= by[f"V2V:{name}"] + 1e-9).all()
    assert (by["all:mixed"] <= by["onboard"] + 1e-9).all()


def test_others_know_long_before_the_ego_of_who_gets_off_the_bus(table: pd.DataFrame) -> None:
    part = table[table["object_id"] == str(GETS_OFF)]
    median_s = part.groupby("configuration")["time_to_detection_s"].median()
    assert median_s["onboard"] > 8
    assert median_s["V2V:0.5s"] < 1.5
    assert median_s["roadside:0.5s"] < 1.5


def test_behind_the_van_hardly_anybody_sees_the_child(table: pd.DataFrame) -> None:
    part = table[table["object_id"] == str(CHILD)]
    assert (part.groupby("configuration")["time_to_detection_s"].median().drop("GT") > 1).all()


# What fusions make of it --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fused() -> pd.DataFrame:
    """The summary of crossing.yaml, of two runs, by configuration."""
    source = read_experiment_file(ROOT / "logs" / "crossing.yaml")
    source.data["runs"] = 2
    checked, found = find_problems(source)
    assert found == []
    assert checked is not None
    assert len(checked.shown()) == 4
    recordings, refused = read_logs(checked, log_paths(source)[0], source)
    assert refused == []
    result = run_experiment(checked, recordings, jobs=2)
    assert list(result.notes) == []
    assert list(result.summary["configuration"]) == list(checked.configurations)
    return result.summary.set_index("configuration")


def test_the_fusions_hear_the_same_units(fused: pd.DataFrame) -> None:
    assert (fused["detected_share"] == 1).all()
    assert fused["list_rate_hz"].groupby(fused.index.str.endswith(":mixed")).nunique().tolist() == [1, 1]


def test_the_better_a_fusion_the_fewer_duplicates(fused: pd.DataFrame) -> None:
    """Nobody but ideal fusion knows what belongs together."""
    for late in ("", ":mixed"):
        names = [f"{name}{late}" for name in ("union", "nms:centre", "gnn", "ideal")]
        for figure in ("duplicates_per_min", "gospa_m", "gospa_false_m"):
            found = fused.loc[names, figure].tolist()
            assert found == sorted(found, reverse=True), (late, figure)
        alike = fused[fused.index.str.endswith(":mixed") == bool(late)]
        assert alike["false_positives_per_min"].idxmin() == f"ideal{late}"


def test_trackers_remember_and_so_miss_less(fused: pd.DataFrame) -> None:
    for late in ("", ":mixed"):
        for kind in ("stale", "predict", "replay"):
            tracker = fused.loc[f"tracker:{kind}{late}"]
            assert tracker["gospa_missed_m"] < fused.loc[f"ideal{late}", "gospa_missed_m"]
            assert tracker["position_rmse_m"] < fused.loc[f"ideal{late}", "position_rmse_m"]
            assert tracker["identity_switches"] > 0
    others = fused[~fused.index.str.startswith("tracker")]
    assert others["identity_switches"].isna().all()


def test_late_lists_taken_for_new_ones_harm(fused: pd.DataFrame) -> None:
    stale = fused.loc["tracker:stale:mixed", "position_rmse_m"]
    assert fused.loc["tracker:predict:mixed", "position_rmse_m"] < stale
    assert fused.loc["tracker:replay:mixed", "position_rmse_m"] < stale


def test_covariance_intersection_claims_less(fused: pd.DataFrame) -> None:
    """What it claims is larger, so that errors are smaller in its terms."""
    assert fused.loc["gnn:CI", "nees"] < fused.loc["gnn", "nees"]
    assert fused.loc["gnn:CI:mixed", "nees"] < fused.loc["gnn:mixed", "nees"]

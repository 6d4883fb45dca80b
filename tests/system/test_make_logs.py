"""The sample recordings: the same on every make, and their scene is the one that the experiment describes.

They are decoded here with osi3 alone, and what hides what is worked out with Shapely: none of the package is
involved.
"""

from __future__ import annotations

import dataclasses
import importlib
import math
import subprocess
import sys
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import google.protobuf
import osi3
import pytest
import shapely
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.reader import make_reader
from osi3.osi_groundtruth_pb2 import GroundTruth
from osi3.osi_lane_pb2 import LaneBoundary
from osi3.osi_object_pb2 import MovingObject
from osi3.osi_sensordata_pb2 import SensorData
from ruamel.yaml import YAML
from shapely import LineString, Point, Polygon, affinity

from copem_replay.io.write.osi import write_osi_trace

ROOT = Path(__file__).resolve().parents[2]
LOG = ROOT / "logs" / "tc016d.mcap"
EXPERIMENT = ROOT / "logs" / "tc016d.yaml"

EGO, PEDESTRIAN, TRUCK, SHELTER = 1, 2, 3, 9
ONSET = 30  # frame of the first step, 3.0 s
MEET = 50  # first frame in which the ego, not braking, touches him
FRAME_S = 0.1


class Body(NamedTuple):
    """The box of an object in one frame, and how it moves."""

    footprint: Polygon
    height_m: float
    x_m: float
    y_m: float
    speed_mps: float


Scene = dict[int, Body]


@pytest.fixture(scope="module")
def make_logs() -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "tools"))
        yield importlib.import_module("make_logs")


@pytest.fixture(scope="module")
def messages() -> list[GroundTruth]:
    with LOG.open("rb") as stream:
        return [GroundTruth.FromString(message.data) for _, _, message in make_reader(stream).iter_messages()]


@pytest.fixture(scope="module")
def scenes(messages: list[GroundTruth]) -> list[Scene]:
    return [
        {osi.id.value: _body(osi) for osi in [*message.moving_object, *message.stationary_object]}
        for message in messages
    ]


def _body(osi: Any) -> Body:
    base = osi.base
    length_m, width_m = base.dimension.length, base.dimension.width
    box = shapely.box(-length_m / 2, -width_m / 2, length_m / 2, width_m / 2)
    turned = affinity.rotate(box, base.orientation.yaw, origin=(0, 0), use_radians=True)
    footprint = affinity.translate(turned, base.position.x, base.position.y)
    moves = isinstance(osi, MovingObject)
    speed_mps = math.hypot(base.velocity.x, base.velocity.y) if moves else 0.0
    return Body(footprint, base.dimension.height, base.position.x, base.position.y, speed_mps)


# The files --------------------------------------------------------------------------------------------------


def test_two_makes_give_the_same_bytes(make_logs: Any, tmp_path: Path) -> None:
    first, second = tmp_path / "first.mcap", tmp_path / "second.mcap"
    write_osi_trace(make_logs.tc016d(), first)
    write_osi_trace(make_logs.tc016d(), second)
    assert first.read_bytes() == second.read_bytes()
    assert sorted(tmp_path.iterdir()) == [first, second]


def test_the_committed_log_is_what_the_tool_makes(tmp_path: Path) -> None:
    tool = [sys.executable, str(ROOT / "tools" / "make_logs.py")]
    subprocess.run([*tool, "tc016d", "--out", str(tmp_path)], check=True)
    assert (tmp_path / LOG.name).read_bytes() == LOG.read_bytes(), "run python tools/make_logs.py tc016d"


@pytest.mark.long
def test_two_makes_of_the_bags_give_the_same_bytes(tmp_path: Path) -> None:
    """The stack's lists are logged after their stamps, the unit's have another clock."""
    tool = [sys.executable, str(ROOT / "tools" / "make_logs.py"), "--bags", "--out"]
    for name in ("first", "second"):
        subprocess.run([*tool, str(tmp_path / name)], check=True)
    assert sorted(path.name for path in (tmp_path / "first").iterdir()) == ["ego.mcap", "rsu.mcap"]
    late_ns: dict[str, set[int]] = {}
    for name in ("ego.mcap", "rsu.mcap"):
        assert (tmp_path / "first" / name).read_bytes() == (tmp_path / "second" / name).read_bytes()
        with (tmp_path / "first" / name).open("rb") as stream:
            for _, channel, message in make_reader(stream).iter_messages():
                late_ns.setdefault(channel.topic, set()).add(message.log_time - message.publish_time)
    assert late_ns == {"ground_truth": {0}, "ego/objects": {0}, "stack/objects": {40_000_000}, "rsu/objects": {0}}
    with (tmp_path / "first/rsu.mcap").open("rb") as stream:
        first = SensorData.FromString(next(iter(make_reader(stream).iter_messages()))[2].data)
    stamp_s, captured_s = (t.seconds + t.nanos * 1e-9 for t in (first.timestamp, first.last_measurement_time))
    assert captured_s == pytest.approx(0.03 + 0.13)
    assert stamp_s - captured_s == pytest.approx(0.09)


def test_a_failed_make_leaves_no_file(make_logs: Any, tmp_path: Path) -> None:
    recording = make_logs.tc016d()
    broken = dataclasses.replace(recording, topics={})
    with pytest.raises(KeyError):
        write_osi_trace(broken, tmp_path / "broken.mcap")
    assert not list(tmp_path.iterdir())


def test_an_unknown_name_is_refused() -> None:
    tool = [sys.executable, str(ROOT / "tools" / "make_logs.py"), "tc017"]
    done = subprocess.run(tool, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "no recipe for tc017; there are: tc016d" in done.stderr


def test_the_log_is_an_osi_trace() -> None:
    with LOG.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().library == "copem_replay"
        records = [record for record in reader.iter_metadata() if record.name == "net.asam.osi.trace"]
        assert len(records) == 1
        versions = {key: value for key, value in records[0].metadata.items() if "version" in key}
        assert versions == {
            "version": osi3.__version__,
            "min_osi_version": osi3.__version__,
            "max_osi_version": osi3.__version__,
            "min_protobuf_version": google.protobuf.__version__,
            "max_protobuf_version": google.protobuf.__version__,
        }
        summary = reader.get_summary()
        assert summary is not None
        (channel,) = summary.channels.values()
        (schema,) = summary.schemas.values()
        assert {index.compression for index in summary.chunk_indexes} == {"zstd"}
    assert (channel.topic, channel.message_encoding) == ("ground_truth", "protobuf")
    prefix = "net.asam.osi.trace.channel."
    assert {key.removeprefix(prefix) for key in channel.metadata} == {
        "osi_version",
        "protobuf_version",
        "description",
    }
    assert (schema.name, schema.encoding) == ("osi3.GroundTruth", "protobuf")
    files = FileDescriptorSet.FromString(schema.data).file
    names = {file.name for file in files}
    assert {name for file in files for name in file.dependency} <= names


def test_stamps_are_those_of_the_messages(messages: list[GroundTruth]) -> None:
    with LOG.open("rb") as stream:
        times_ns = [(record.log_time, record.publish_time) for *_, record in make_reader(stream).iter_messages()]
    stamps_ns = [message.timestamp.seconds * 10**9 + message.timestamp.nanos for message in messages]
    assert stamps_ns == [frame * 10**8 for frame in range(81)]
    assert times_ns == [(stamp_ns, stamp_ns) for stamp_ns in stamps_ns]


# tc016d: who is there and how they move ---------------------------------------------------------------------


def test_who_is_there(messages: list[GroundTruth]) -> None:
    sizes_m = {
        EGO: (4.6, 1.9, 1.5),
        PEDESTRIAN: (0.5, 0.5, 1.8),
        TRUCK: (8.0, 2.5, 3.5),
        SHELTER: (4.0, 1.6, 2.5),
    }
    for message in messages:
        assert message.host_vehicle_id.value == EGO
        moving = {osi.id.value: osi for osi in message.moving_object}
        stationary = {osi.id.value: osi for osi in message.stationary_object}
        assert sorted(moving) == [1, 2, 3, 4, 5, 6, 7, 8]
        assert sorted(stationary) == [SHELTER]
        assert moving[TRUCK].vehicle_classification.type == MovingObject.VehicleClassification.TYPE_HEAVY_TRUCK
        pedestrians = [key for key, osi in moving.items() if osi.type == MovingObject.TYPE_PEDESTRIAN]
        assert pedestrians == [PEDESTRIAN, 8]
        for key, osi in {**moving, **stationary}.items():
            dimension = osi.base.dimension
            assert osi.base.position.z == dimension.height / 2
            if key in sizes_m:
                assert (dimension.length, dimension.width, dimension.height) == sizes_m[key]


def test_the_road_is_in_the_first_message(messages: list[GroundTruth], scenes: list[Scene]) -> None:
    """Kerbs have all traffic between them and the shelter outside; he walks along the crosswalk, clear of the truck."""
    lines = [
        (osi.classification.type, LineString([(p.position.x, p.position.y) for p in osi.boundary_line]))
        for osi in messages[0].lane_boundary
    ]
    assert not any(message.lane_boundary for message in messages[1:])
    one, other = (line for kind, line in lines if kind == LaneBoundary.Classification.TYPE_CURB)
    street = Polygon([*one.coords, *reversed(other.coords)])
    west, east = sorted((line for _, line in lines if line.bounds[0] == line.bounds[2]), key=lambda line: line.bounds)
    crosswalk = Polygon([*west.coords, *reversed(east.coords)])
    assert [line.length for line in (west, east)] == pytest.approx([other.distance(one)] * 2)
    for scene in scenes:
        assert street.disjoint(scene[SHELTER].footprint)
        assert all(street.contains(scene[key].footprint) for key in range(1, 8) if abs(scene[key].x_m) < 80)
        assert crosswalk.contains(scene[PEDESTRIAN].footprint)
        assert crosswalk.disjoint(scene[TRUCK].footprint)


def test_the_ego_drives_straight_on_at_10_mps(scenes: list[Scene]) -> None:
    for frame, scene in enumerate(scenes):
        assert scene[EGO].x_m == pytest.approx(-52.3 + 10 * frame * FRAME_S, abs=1e-9)
        assert scene[EGO].y_m == 0.0
        assert scene[EGO].speed_mps == 10.0


def test_the_pedestrian_starts_when_the_front_is_20_m_away(scenes: list[Scene]) -> None:
    for frame, scene in enumerate(scenes):
        steps_s = max(0, frame - ONSET) * FRAME_S
        assert scene[PEDESTRIAN].x_m == 0.0
        assert scene[PEDESTRIAN].y_m == pytest.approx(-3.0 + steps_s, abs=1e-9)
        assert scene[PEDESTRIAN].speed_mps == (1.0 if frame >= ONSET else 0.0)
    front_m = scenes[ONSET][EGO].footprint.bounds[2]
    distance_m = scenes[ONSET][PEDESTRIAN].x_m - front_m
    assert distance_m == pytest.approx(20.0, abs=1e-9)
    assert distance_m < 20.0, "rounding must not put him beyond the 20 m"


def test_the_truck_stands_2_12_m_from_the_line_and_half_a_metre_before_him(scenes: list[Scene]) -> None:
    for scene in scenes:
        _, _, front_m, road_side_m = scene[TRUCK].footprint.bounds
        assert scene[EGO].y_m - road_side_m == pytest.approx(2.12, abs=1e-9)
        assert scene[PEDESTRIAN].footprint.bounds[0] - front_m == pytest.approx(0.5, abs=1e-9)
        assert scene[TRUCK].speed_mps == 0.0


def test_nobody_touches_anybody_but_the_ego_the_pedestrian(scenes: list[Scene]) -> None:
    met = [
        (frame, one, other)
        for frame, scene in enumerate(scenes)
        for one, other in combinations(sorted(scene), 2)
        if scene[one].footprint.intersects(scene[other].footprint)
    ]
    assert {(one, other) for _, one, other in met} == {(EGO, PEDESTRIAN)}
    assert [frame for frame, *_ in met] == [50, 51, 52, 53, 54]  # two seconds after the onset


def test_speeds_are_those_of_the_positions(scenes: list[Scene]) -> None:
    for frame, (before, after) in enumerate(pairwise(scenes)):
        for key in before:
            if (frame + 1, key) == (ONSET, PEDESTRIAN):
                continue  # he is at full speed in the frame in which he still stands
            way_m = math.hypot(after[key].x_m - before[key].x_m, after[key].y_m - before[key].y_m)
            mean_mps = (before[key].speed_mps + after[key].speed_mps) / 2
            assert way_m == pytest.approx(mean_mps * FRAME_S, abs=1e-9)


def test_the_other_pedestrian_never_moves(scenes: list[Scene]) -> None:
    assert {scene[8].speed_mps for scene in scenes} == {0.0}


# tc016d: who sees him ---------------------------------------------------------------------------------------


def visible_shares(eye: tuple[float, float, float], target: Body, others: list[Body]) -> tuple[float, float]:
    """Visible share of a target as (flat, surface).

    Between two neighbouring corner bearings the same faces are in front, so that one ray decides for the flat
    share, exactly; for the surface the column on each of a few rays is taken.
    """
    at = Point(eye[:2])
    facing = math.atan2(target.y_m - eye[1], target.x_m - eye[0])

    def bearings(body: Body) -> list[float]:
        corners = body.footprint.exterior.coords[:-1]
        raw = [math.atan2(y - eye[1], x - eye[0]) - facing for x, y in corners]
        return [math.remainder(angle, math.tau) for angle in raw]

    low, high = min(bearings(target)), max(bearings(target))
    others = [
        body
        for body in others
        if body.footprint.intersection(target.footprint).area < 1e-9 and not body.footprint.contains(at)
    ]
    cuts = [angle for body in [target, *others] for angle in bearings(body) if low < angle < high]
    flat = surface = 0.0
    for start, end in pairwise(sorted({low, high, *cuts})):
        for part in range(4):
            angle = facing + start + (part + 0.5) * (end - start) / 4
            ray = LineString([at, (eye[0] + 200 * math.cos(angle), eye[1] + 200 * math.sin(angle))])
            face_m = at.distance(ray.intersection(target.footprint))
            covered_m = 0.0
            hidden = False
            for body in others:
                if ray.disjoint(body.footprint) or at.distance(body.footprint) >= face_m:
                    continue
                distances_m = [at.distance(Point(end)) for end in ray.intersection(body.footprint).coords]
                if min(distances_m) < face_m:
                    hidden = True
                    edge_m = max(distances_m) if body.height_m < eye[2] else min(distances_m)
                    covered_m = max(covered_m, eye[2] - (eye[2] - body.height_m) * face_m / min(edge_m, face_m))
            weight = (end - start) / 4 / (high - low)
            flat += weight * (not hidden)
            surface += weight * (1 - min(covered_m / target.height_m, 1.0))
    return flat, surface


def seen_by_the_ego(scene: Scene, hiding: list[int]) -> tuple[float, float]:
    ego = scene[EGO]
    return visible_shares((ego.x_m, ego.y_m, 1.8), scene[PEDESTRIAN], [scene[key] for key in hiding])


def test_the_oracle_on_a_scene_to_compute_in_the_head() -> None:
    target = Body(shapely.box(10, -1, 12, 1), 2.0, 11.0, 0.0, 0.0)
    wall = Body(shapely.box(4, 0, 5, 9), 1.0, 4.5, 4.5, 0.0)
    flat, surface = visible_shares((0, 0, 2.0), target, [wall])
    assert flat == pytest.approx(0.5)  # all that is to the left of the axis is behind the wall
    assert surface == pytest.approx(1.0)  # … but the eye looks over it: 2 − (2 − 1) · 10 / 5 = 0, down to his feet
    flat, surface = visible_shares((0, 0, 3.0), target, [wall._replace(height_m=2.0)])
    assert (flat, surface) == pytest.approx((0.5, 0.75))  # covered up to 3 − (3 − 2) · 10 / 5 = 1 of 2 m


def test_the_ego_sees_him_from_0_6_s_after_his_first_step(scenes: list[Scene]) -> None:
    others = [key for key in scenes[0] if key not in (EGO, PEDESTRIAN)]
    table = [seen_by_the_ego(scene, others) for scene in scenes]
    assert table[: ONSET + 6] == [(0.0, 0.0)] * (ONSET + 6)
    flat = [round(flat, 2) for flat, _ in table[ONSET + 6 : ONSET + 12]]
    assert flat == [0.18, 0.37, 0.56, 0.75, 0.93, 1.0]
    surface = [round(surface, 2) for _, surface in table[ONSET + 6 : ONSET + 12]]
    assert surface == flat  # the truck is higher than the eye and than the pedestrian
    assert table[ONSET + 11 :] == [(pytest.approx(1.0), pytest.approx(1.0))] * (81 - ONSET - 11)


def test_only_the_truck_hides_him_from_the_ego(scenes: list[Scene]) -> None:
    others = [key for key in scenes[0] if key not in (EGO, PEDESTRIAN, TRUCK)]
    for scene in scenes[ONSET:]:
        assert seen_by_the_ego(scene, others) == pytest.approx((1.0, 1.0))


def test_the_roadside_units_see_nearly_all_of_him(make_logs: Any, scenes: list[Scene]) -> None:
    units = make_logs.tc016d_units()
    assert len(units) == 20
    for unit in units:
        (x_m, y_m), height_m = unit["at"], unit["height_m"]
        assert math.hypot(x_m, y_m) <= 60
        assert 4 <= height_m <= 6
        to_the_crossing_deg = math.degrees(math.atan2(-y_m, -x_m))
        assert unit["yaw_deg"] == pytest.approx(to_the_crossing_deg, abs=0.1)
        least = []
        for scene in scenes:
            others = [body for key, body in scene.items() if key != PEDESTRIAN]
            assert not any(body.footprint.contains(Point(x_m, y_m)) for body in others)
            least.append(min(visible_shares((x_m, y_m, height_m), scene[PEDESTRIAN], others)))
        assert min(least[:MEET]) > 0.95, unit
        # Where the ego ran through him, it hides him from some as it drives away, for four frames at most.
        assert sum(share <= 0.95 for share in least[MEET:]) <= 4, unit


def test_the_experiment_has_these_units(make_logs: Any) -> None:
    experiment = YAML(typ="safe").load(EXPERIMENT.read_text(encoding="utf-8"))
    units = {f"rspu{k:02d}": unit | {"pem": "roadside"} for k, unit in enumerate(make_logs.tc016d_units(), 1)}
    assert experiment["logs"] == [LOG.name]
    assert experiment["units"] == {"ego": {"on": "ego", "height_m": 1.8, "pem": "onboard"}} | units

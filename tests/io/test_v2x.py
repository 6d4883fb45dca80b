"""CPM and SDSM as lists of a unit: values by hand, places by PROJ's geodesics, and what is wrong with messages."""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from osi3.osi_groundtruth_pb2 import GroundTruth
from pyproj import Geod, Transformer

import copem_replay as cr
from copem_replay.cli.main import main
from copem_replay.core.frame import Frame, make_local_proj
from copem_replay.core.tracks import CLASSES
from copem_replay.core.yaml import dump_yaml
from copem_replay.io.encodings.cdr import CdrDefinition
from copem_replay.io.open import DriveRecordings, open_log
from copem_replay.io.recorded_lists import RecordedLists, read_unit_lists
from copem_replay.io.recording import read_log
from copem_replay.io.schemas.object_lists import DecodedLists, decode_lists
from copem_replay.io.schemas.registry import SCHEMAS
from copem_replay.io.schemas.v2x import convert_its_time
from copem_replay.io.stations import read_station_views
from tests.helpers.messages import classes, ids, serialised, values
from tests.helpers.recordings import Obj, Topic, ns, write_mcap, write_recording
from tests.helpers.v2x import (
    CPM,
    CPM_TEXT,
    SDSM,
    SDSM_TEXT,
    cartesian,
    cpm_message,
    cpm_object,
    kind,
    measured,
    polar,
    sdsm_message,
    sdsm_object,
    sector,
    sectors,
    shaped,
    value,
)  # fmt: skip

T0_S = datetime(2026, 11, 28, 12, 34, 56, tzinfo=UTC).timestamp()
LAT, LON = 48.0, 11.0
HERE = Frame(make_local_proj(LAT, LON))  # metres east and north of the station
VARIANCE_M2 = (0.5 / 1.959964) ** 2  # 0.5 m with 95 %


def its_ms(t_s: float) -> int:
    """ms since 2004 with the five leap seconds since, of seconds after T0_S."""
    return round((T0_S + t_s - 1_072_915_200 + 5) * 1000)


def decoded(name: str, text: str, *messages: dict[str, Any]) -> DecodedLists:
    text = text.replace("p/", f"{name.split('/')[0]}/")
    definition = CdrDefinition(name, "ros2msg", text.encode())
    payloads = [serialised(text, message, name=name) for message in messages]
    made = SCHEMAS[name].description(definition.offers())
    return decode_lists(definition, made, payloads, np.arange(len(payloads), dtype=np.int64))


def decoded_cpm(*objects: dict[str, Any]) -> DecodedLists:
    return decoded(CPM, CPM_TEXT, cpm_message(its_ms(0), LAT, LON, *objects))


# ------------------------------------------------------------------------------------------------ fields


@pytest.mark.parametrize(
    ("utc", "its"),
    [
        ("2004-01-01T00:00:00", 0),
        ("2007-01-01T00:00:00", 94_694_401_000),  # the example of TS 102 894-2
        ("2005-12-31T23:59:59", 63_158_399_000),
        ("2006-01-01T00:00:00", 63_158_401_000),
        ("2026-11-28T12:34:56", 722_954_101_000),
    ],
)
def test_its_time_counts_leap_seconds(utc: str, its: int) -> None:
    assert convert_its_time(np.array([float(its)]))[0] == datetime.fromisoformat(utc + "+00:00").timestamp() * 1000


def test_a_cpm_in_metres() -> None:
    found = decoded_cpm(cpm_object(3, 1000, -2550), cpm_object(4, 5, 0, velocity=polar(1000, 300)))
    assert ids(found) == ["7/3", "7/4"]
    assert classes(found) == ["car", "car"]
    assert values(found, "x_m") == [10.0, 0.05]
    assert values(found, "y_m") == [-25.5, 0.0]
    assert values(found, "yaw_rad") == [math.pi / 2] * 2
    assert values(found, "vx_mps") == [0.0, 10 * math.cos(math.pi / 6)]
    assert values(found, "vy_mps") == [10.0, 5.0]
    sides = [values(found, f"{side}_m")[0] for side in ("length", "width", "height")]
    assert sides == [4.5, 1.8, 1.5]
    assert found.covariance_m2 == pytest.approx(np.array([[VARIANCE_M2, 0, VARIANCE_M2]] * 2), rel=1e-5)
    assert found.columns.stamp_ns.tolist() == [ns(T0_S)]
    assert found.station is not None
    assert found.station.place.tolist() == [[LAT, LON]]
    assert found.station.after_s.tolist() == [-0.05, -0.05]


def test_what_a_cpm_does_not_know_is_no_number() -> None:
    nowhere = {"x_coordinate": measured(131071, 4096), "y_coordinate": measured(0, 4095)}
    found = decoded_cpm(
        cpm_object(1, 0, 0, position=nowhere, velocity=cartesian(16383, 0), angles={"z_angle": measured(3601)},
                   object_dimension_x=measured(256), object_dimension_y=measured(255)),
        cpm_object(2, 0, 0, velocity_is_present=False, angles_is_present=False, object_dimension_z_is_present=False,
                   velocity=cartesian(100, 100)),
        cpm_object(3, 0, 0, velocity=polar(16383, 0)),
    )  # fmt: skip
    assert values(found, "x_m") == [None, 0, 0]
    assert values(found, "vx_mps") == [None] * 3
    assert values(found, "vy_mps") == [0, None, None]
    assert values(found, "length_m") == [None, 4.5, 4.5]
    assert values(found, "width_m") == [None, 1.8, 1.8]
    assert values(found, "height_m") == [1.5, None, 1.5]
    assert np.isnan(found.covariance_m2[0, [0, 2]]).all()
    assert values(found, "yaw_rad") == [0, 0, math.pi / 2]
    assert any("2 object states that do" in note and "heading" in note for note in found.columns.notes)


@pytest.mark.parametrize(
    ("of", "name"),
    [
        (kind(0), "vehicle"), (kind(1), "pedestrian"), (kind(2), "bicycle"), (kind(3), "motorcycle"), (kind(6), "bus"),
        (kind(7), "van"), (kind(8), "truck"), (kind(9), "trailer"), (kind(13), "animal"),
        (kind(choice=1, vru=0), "pedestrian"), (kind(choice=1, vru=1), "bicycle"),
        (kind(choice=1, vru=2), "motorcycle"),
        (kind(choice=1, vru=3), "animal"), (kind(choice=2), "other"), (kind(5, choice=3), "other"),
    ],
)  # fmt: skip
def test_classes_of_a_cpm(of: dict[str, Any], name: str) -> None:
    assert classes(decoded_cpm(cpm_object(1, 0, 0, classification={"array": [of]}))) == [name]


def test_confidence_of_classes() -> None:
    both = {"array": [kind(5, confidence=60), kind(8, confidence=20)]}
    unsaid = {"array": [kind(5, confidence=101)]}
    found = decoded_cpm(cpm_object(1, 0, 0, classification=both), cpm_object(2, 0, 0, classification=unsaid))
    assert found.probability[:, [CLASSES.index("car"), CLASSES.index("truck")]].tolist() == [
        pytest.approx([0.75, 0.25]), [1.0, 0.0],
    ]  # fmt: skip


@pytest.mark.parametrize(("package", "per"), [("carma", 1.0), ("j3224", 10.0)])
def test_an_sdsm_in_metres(package: str, per: float) -> None:
    heading = {"heading": {"heading": 30.0 if per == 1 else 2400}}  # clockwise from north
    message = sdsm_message(
        LAT, LON, sdsm_object(3, -2.5, 10, per=per, **heading), sdsm_object(4, 0, 0, per=per), per=per
    )
    found = decoded(SDSM[package], SDSM_TEXT[package], message)
    assert ids(found) == ["000102ff/3", "000102ff/4"]  # the source, and the object's number there
    assert classes(found) == ["car", "car"]
    assert values(found, "x_m") == [10.0, 0.0]
    assert values(found, "y_m") == [-2.5, 0.0]
    assert values(found, "yaw_rad") == [math.radians(60), math.radians(90)]
    assert values(found, "vx_mps") == [5.0, pytest.approx(0, abs=1e-9)]
    sides = [values(found, f"{side}_m")[0] for side in ("length", "width", "height")]
    assert sides == [4.5, 1.8, 1.5]
    assert found.covariance_m2[0] == pytest.approx([VARIANCE_M2, 0, VARIANCE_M2], rel=1e-5)
    assert found.columns.stamp_ns.tolist() == [ns(T0_S) + 789_000_000]
    assert found.station is not None
    assert found.station.place[0] == pytest.approx([LAT, LON])
    assert found.station.after_s == pytest.approx([-0.05, -0.05])  # before, whatever its sign


def test_what_an_sdsm_does_not_know() -> None:
    unknown = {
        "heading": {"heading": 28800}, "speed": {"speed": 8191}, "pos_confidence": {"pos": {"confidence": 0}},
        "obj_type": {"object_type": 2}, "measurement_time": {"measurement_time_offset": 50},
    }  # fmt: skip
    person = sdsm_object(1, 0, 0, per=10, **unknown) | {"presence_vector": 0}
    message = sdsm_message(LAT, LON, person, per=10)
    message["sdsm_time_stamp"]["presence_vector"] = 31  # no second
    found = decoded(SDSM["j3224"], SDSM_TEXT["j3224"], message)
    assert classes(found) == ["pedestrian"]
    for name in ("vx_mps", "vy_mps", "length_m", "width_m", "height_m"):
        assert values(found, name) == [None]
    assert np.isnan(found.covariance_m2[0, [0, 2]]).all()
    assert not found.columns.stamped.any()
    assert found.station is not None
    assert found.station.after_s.tolist() == [-0.05]
    flagged = sdsm_object(
        1, 0, 0, heading={"heading": 0.0, "unavailable": True}, speed={"speed": 3.0, "unavailable": True}
    )
    found = decoded(SDSM["carma"], SDSM_TEXT["carma"], sdsm_message(LAT, LON, flagged))
    assert values(found, "vx_mps") == [None]
    assert any("heading" in note for note in found.columns.notes)


def test_a_day_of_an_sdsm_has_a_zone() -> None:
    message = sdsm_message(LAT, LON)
    message["sdsm_time_stamp"] |= {"presence_vector": 127, "offset": {"offset_minute": 60}, "hour": {"hour": 13}}
    found = decoded(SDSM["carma"], SDSM_TEXT["carma"], message)
    assert found.columns.stamp_ns.tolist() == [ns(T0_S) + 789_000_000]


# ------------------------------------------------------------------------------------------------ in a log


def topic_of(*messages: tuple[float, dict[str, Any]]) -> Topic:
    """CPM, logged so many seconds after T0_S."""
    text = CPM_TEXT.replace("p/", "etsi_its_cpm_ts_msgs/")
    payloads = [(ns(T0_S + t_s), serialised(text, message, name=CPM)) for t_s, message in messages]
    return Topic("cpm", CPM, payloads, "cdr", definition=("ros2msg", text.encode()))


def drive(path: Path, *messages: tuple[float, dict[str, Any]]) -> Path:
    """The ego at rest, and a car that drives north at 10 m/s, 20 m east of the station; 2 s at 10 Hz."""
    frames = [
        (T0_S + k / 10, [Obj(id=1, x=-30.0), Obj(id=2, x=20.0, y=k - 10.0, yaw=math.pi / 2, vx=0.0, vy=10.0)])
        for k in range(21)
    ]
    return write_recording(path, frames, host=1, more=[topic_of(*messages)])


def seen(t_s: float, late_s: float = 0.02, *, clock_s: float = 0.0, **changes: Any) -> tuple[float, dict[str, Any]]:
    """A message of `t_s` about the car as it was 50 ms before, logged `late_s` later."""
    there = cpm_object(3, 2000, round(100 * (10 * (t_s - 0.05) - 10)), **changes)
    return t_s + late_s, cpm_message(its_ms(t_s + clock_s), LAT, LON, there)


def lists_of(path: Path, frame: Frame | None = HERE) -> RecordedLists:
    recording = read_log(path, name="log", unit_topics=["cpm"])
    return read_unit_lists(path, "cpm", replace(recording.scene, frame=frame), recording.around)


def test_captures_arrivals_and_places(tmp_path: Path) -> None:
    found = lists_of(drive(tmp_path / "a.mcap", seen(0.5), seen(1.0, 0.3)))
    assert found.tracks.captured_s == pytest.approx([0.45, 0.95])
    assert found.tracks.common_arrives_s == pytest.approx([0.52, 1.3])
    assert found.tracks.x_m[0] == pytest.approx([20, 20], abs=1e-6)
    assert found.tracks.y_m[0] == pytest.approx([-5.5, -0.5], abs=0.006)
    assert found.capture_said.all()
    assert found.spread_said.all()
    assert not found.notes


def test_places_and_headings_by_geodesics(tmp_path: Path) -> None:
    station, turned = (48.137, 11.575), math.radians(20)  # 2.6° from the meridian of zone 32
    objects = [
        cpm_object(k, round(60 * 100 * math.sin(a)), round(60 * 100 * math.cos(a))) for k, a in enumerate((0.3, 2.0))
    ]
    path = drive(tmp_path / "a.mcap", (0.6, cpm_message(its_ms(0.5), *station, *objects)))
    found = lists_of(path, Frame("EPSG:25832", (690_000.0, 5_333_000.0), turned))
    to_utm, geod = Transformer.from_crs("EPSG:4326", "EPSG:25832", always_xy=True), Geod(ellps="WGS84")
    for row, azimuth in enumerate((0.3, 2.0)):
        lon, lat, _ = geod.fwd(station[1], station[0], math.degrees(azimuth), 60.0)
        ahead = geod.fwd(lon, lat, 0.0, 1.0)  # a metre to true north
        (east, north), (east2, north2) = to_utm.transform(lon, lat), to_utm.transform(*ahead[:2])
        expected = complex(east - 690_000, north - 5_333_000) * complex(math.cos(turned), -math.sin(turned))
        assert complex(found.tracks.x_m[0, row], found.tracks.y_m[0, row]) == pytest.approx(expected, abs=0.01)
        heading = math.atan2(north2 - north, east2 - east) - turned
        assert found.tracks.yaw_rad[0, row] == pytest.approx(heading, abs=1e-4)
        speed = complex(found.tracks.vx_mps[0, row], found.tracks.vy_mps[0, row])
        assert speed == pytest.approx(10 * complex(math.cos(heading), math.sin(heading)), abs=1e-3)


def test_objects_measured_at_other_times_are_moved(tmp_path: Path) -> None:
    later, earlier = cpm_object(1, 0, 0), cpm_object(2, 0, 0, measurement_delta_time=value(-250))
    third = cpm_object(3, 0, 0)
    path = drive(tmp_path / "a.mcap", (1.0, cpm_message(its_ms(1.0), LAT, LON, later, earlier, third)))
    found = lists_of(path)
    assert found.tracks.captured_s == pytest.approx([0.95])
    assert found.tracks.y_m[0] == pytest.approx([0, 2, 0], abs=1e-6)  # 0.2 s at 10 m/s
    assert found.notes == (
        "1 object state measured up to 0.200 s from others of its list: moved to them along its velocity",
    )


def test_a_list_without_objects_is_a_list(tmp_path: Path) -> None:
    found = lists_of(drive(tmp_path / "a.mcap", seen(0.5), (0.7, cpm_message(its_ms(0.6), LAT, LON))))
    assert len(found.tracks.stamp_ns) == 2
    assert found.tracks.frame_ix.tolist() == [0]
    assert found.tracks.captured_s == pytest.approx([0.45, 0.6])


def test_a_clock_without_leap_seconds_is_not_taken(tmp_path: Path) -> None:
    found = lists_of(drive(tmp_path / "a.mcap", *(seen(t, clock_s=-5) for t in (0.5, 1.0))))
    assert found.notes == (
        "2 messages logged 5.020 s after its reference time (leap seconds counted), of another clock: the time of "
        "logging taken, and `delay_s`",
    )
    assert not found.capture_said.any()
    assert found.tracks.captured_s == pytest.approx([0.47, 0.97])


def nowhere(t_s: float) -> tuple[float, dict[str, Any]]:
    return t_s, cpm_message(its_ms(t_s), 90.0000001, 180.0000001, cpm_object(1, 0, 0))


def test_messages_without_a_station_are_skipped(tmp_path: Path) -> None:
    found = lists_of(drive(tmp_path / "a.mcap", seen(0.5), nowhere(0.7)))
    assert found.notes == ("1 message without the reference position of its station: skipped",)
    assert found.tracks.captured_s == pytest.approx([0.45])


def test_several_stations_on_a_topic_are_said(tmp_path: Path) -> None:
    other = cpm_message(its_ms(0.7), LAT, LON, cpm_object(3, 0, 0), station=8)
    found = lists_of(drive(tmp_path / "a.mcap", seen(0.5), (0.72, other)))
    assert found.notes == ("1 station beside the first sends on this topic: all are taken as one unit",)
    assert len(np.unique(found.track_id)) == 2  # the same number, of another station


def test_messages_older_than_the_log_are_skipped(tmp_path: Path) -> None:
    found = lists_of(drive(tmp_path / "a.mcap", seen(-2.0), seen(0.5), seen(0.7)))
    assert found.notes == ("1 message captured more than a second before the log begins: skipped",)
    assert found.tracks.captured_s == pytest.approx([0.45, 0.65])


def check(folder: Path, plan: str, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "experiment.yaml").write_text(plan)
    monkeypatch.setattr("sys.argv", ["copem-replay", "check", str(folder / "experiment.yaml")])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2


@pytest.mark.parametrize(
    ("messages", "frame", "line"),
    [
        ([seen(0.5)], None, "its positions are relative to stations on earth, and the log does not say where it is: "
         "give `frame: {proj: …}` (docs/guide/place.md)"),
        ([nowhere(0.5), nowhere(0.6)], HERE, "none of its 2 messages has the reference position of its station"),
        ([seen(-9.0), seen(-8.0)], HERE, "all of its 2 messages are older than the log, the last one by 8.05 s"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    messages: Any,
    frame: Frame | None,
    line: str,
) -> None:
    path = drive(tmp_path / "a.mcap", *messages)
    plan: dict[str, Any] = {
        "version": 1, "logs": [str(path)], "units": {"rsu": {"recorded": {"topic": "cpm"}, "at": [0, 0]}},
        "configurations": {"GT": {"units": "truth"}, "one": {"units": ["rsu"], "fusion": {"kind": "gnn"}}},
    }  # fmt: skip
    check(tmp_path, dump_yaml(plan | ({"frame": {"proj": frame.proj}} if frame else {})), monkeypatch)
    told = capsys.readouterr().err.strip().splitlines()
    assert [one for one in told if line in one] == told


def test_a_cpm_is_no_truth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    ros2 = topic_of(seen(0.5))
    path = write_mcap(tmp_path / "a.mcap", [ros2])
    check(
        tmp_path,
        f"version: 1\nlogs: [{path}]\nread: {{topic: cpm}}\nconfigurations: {{GT: {{units: truth}}}}\n",
        monkeypatch,
    )
    assert "its positions are relative to stations; lists of a unit they can be" in capsys.readouterr().err


# ------------------------------------------------------------------------------------------------ definitions


@pytest.fixture
def silent(tmp_path: Path) -> Path:
    """A recording whose recorder lacked the package of CPM."""
    path = drive(tmp_path / "a.mcap", *(seen(t / 10) for t in range(5, 15)))
    truth = next(iter(open_log(path).channels))
    topic = replace(topic_of(*(seen(t / 10) for t in range(5, 15))), definition=("ros2msg", b""))
    messages = [(t, data) for _, t, data in open_log(path).payloads(frozenset({truth.number}))]
    osi = Topic(truth.topic, truth.schema, messages, definition=("protobuf", truth.schema_data))
    return write_mcap(tmp_path / "silent.mcap", [osi, topic])


def write_package(folder: Path) -> Path:
    """The package of CPM, a file for each type."""
    (folder / "etsi_its_cpm_ts_msgs" / "msg").mkdir(parents=True)
    first, *others = CPM_TEXT.split("=" * 80 + "\n")
    for text in (f"MSG: p/CollectivePerceptionMessage\n{first}", *others):
        name, _, fields = text.partition("\n")
        (folder / "etsi_its_cpm_ts_msgs" / "msg" / f"{name.rpartition('/')[2]}.msg").write_text(fields)
    return folder


PLAN = """\
version: 1
logs: [silent.mcap]
read: {definitions: DEFINITIONS}
frame: {proj: {at_wgs84: [48.0, 11.0]}}
units: {rsu: {recorded: {topic: cpm}, at: [0, 0]}}
configurations: {GT: {units: truth}, one: {units: [rsu], fusion: {kind: gnn}}}
measure: {onset: {kind: appears}, began: [log_start, appeared]}
show: {run: 0}
"""


def test_definitions_are_read_from_a_folder(silent: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_package(silent.parent / "ws")
    monkeypatch.chdir(silent.parent)
    Path("experiment.yaml").write_text(PLAN.replace("DEFINITIONS", "ws"))
    monkeypatch.setattr("sys.argv", ["copem-replay", "run", "experiment.yaml"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert not ended.value.code
    copied = next(c for c in open_log(Path("out/experiment/replay.mcap")).channels if c.topic == "cpm")
    assert b"ManagementContainer management_container" in copied.schema_data  # the copy can be read without it
    found = lists_of(silent.parent / "a.mcap")
    here = DriveRecordings((silent,), (0.0,), definitions=str(folder))
    again = read_unit_lists(here, "cpm", replace(read_log(here, name="log").scene, frame=HERE), None)
    assert again.tracks.y_m.tolist() == found.tracks.y_m.tolist()


@pytest.mark.parametrize(
    ("files", "line"),
    [
        ({}, "/ws: expected definitions of messages in a folder, `package/msg/Type.msg`, found none ("),
        ({"p/msg/A.msg": "uint8 uint8 uint8\n%"}, "A.msg: expected definitions of messages in a folder, "
         "`package/msg/Type.msg`, found none ("),
        ({"etsi_its_cpm_ts_msgs/msg/CollectivePerceptionMessage.msg": "Lost header"}, "found none ("),
    ],
)  # fmt: skip
def test_a_folder_without_definitions_is_one_line(
    silent: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], files: dict[str, str], line: str
) -> None:
    for name, text in files.items():
        path = silent.parent / "ws" / name
        path.parent.mkdir(parents=True)
        path.write_text(text)
    monkeypatch.chdir(silent.parent)
    check(silent.parent, PLAN.replace("DEFINITIONS", "ws"), monkeypatch)
    (told,) = capsys.readouterr().err.strip().splitlines()
    assert line in told


def test_without_a_folder_the_line_names_the_key(
    silent: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(silent.parent)
    check(silent.parent, PLAN.replace("read: {definitions: DEFINITIONS}\n", ""), monkeypatch)
    assert "`read: {definitions: FOLDER}` names a folder that has it" in capsys.readouterr().err


# ------------------------------------------------------------------------------------------------ sensors


def looking(path: Path, *sensors: dict[str, Any], lat: tuple[float, ...] = (LAT,), late_s: float = 1.6) -> Path:
    """`drive` on earth, with messages of a station and its sensors, the car in those from `late_s` on."""
    messages = [
        (t_s, cpm_message(its_ms(t_s), lat[k % len(lat)], LON, *about, sensors=list(sensors)))
        for k, t_s in enumerate(np.arange(5, 19) / 10)
        for about in [[cpm_object(3, 2000, round(100 * (10 * (t_s - 0.05) - 10)))] if t_s > late_s else []]
    ]
    truth = next(iter(open_log(drive(path.with_suffix(".bare.mcap"), *messages)).channels))
    here = []
    for _, log_ns, data in open_log(path.with_suffix(".bare.mcap")).payloads(frozenset({truth.number})):
        message = GroundTruth.FromString(data)
        message.proj_string = HERE.proj
        here.append((log_ns, message.SerializeToString(deterministic=True)))
    return write_mcap(path, [Topic("truth", "osi3.GroundTruth", here), topic_of(*messages)])


@pytest.mark.parametrize(
    ("sensor", "views"),
    [
        (sector(800, 450, 800), [((0, 80), (-80, -45))]),  # north-east
        (sector(800, 3500, 100), [((0, 80), (-10, -350))]),  # 20° through north
        (sectors((500, 100, 450), (300, 3300, 300)), [((0, 30), (240, -60)), ((0, 50), (-80, -45))]),  # from east
        (shaped(1, circular={"radius": value(300)}), [((0, 30), (-360, 0))]),
    ],
)
def test_sensors_of_a_cpm_are_views(tmp_path: Path, sensor: dict[str, Any], views: Any) -> None:
    path = looking(tmp_path / "a.mcap", sensor)
    said = read_station_views(open_log(path), "cpm")
    assert said is not None
    assert (said.place_deg, said.why) == ((LAT, LON), "")
    assert sorted(said.views) == sorted(views)


@pytest.mark.parametrize(
    ("sensors", "lat", "why"),
    [
        ([sector(800, 450, 800, east_cm=1500)], (LAT,), "a sensor is 15 m from its station; expected a unit for each"),
        ([sector(800, 450, 3601)], (LAT,), "a sensor does not state its angles"),
        ([sector(800, 450, 800), shaped(2)], (LAT,), "a sensor's region is neither a sector nor a circle"),
        ([sector(800, 450, 800)], (LAT, LAT + 1e-4), "its messages are from several places; expected a station that"),
    ],
)
def test_sensors_that_are_no_views_say_why(
    tmp_path: Path, sensors: list[dict[str, Any]], lat: tuple[float, ...], why: str
) -> None:
    draft = cr.draft_experiment(looking(tmp_path / "a.mcap", *sensors, lat=lat))
    assert f"    # views: left out: {why}" in draft
    assert "    views:" not in draft


def test_a_vehicle_has_no_views_and_without_sensors_there_is_nothing_to_say(tmp_path: Path) -> None:
    assert read_station_views(open_log(drive(tmp_path / "none.mcap", seen(0.5))), "cpm") is None
    assert "views:" not in cr.draft_experiment(looking(tmp_path / "bare.mcap"))
    time_s, message = seen(0.5)
    containers = message["payload"]["cpm_containers"]["value"]["array"]
    containers.append({"container_data_sensor_information_container": {"array": [sector(800, 450, 800)]}})
    said = read_station_views(open_log(drive(tmp_path / "a.mcap", (time_s, message))), "cpm")
    assert said is not None
    assert (said.views, said.why) == ((), "its station is a vehicle; expected one that stands")


def test_a_draft_has_the_views_and_knows_when_the_car_is_in_sight(tmp_path: Path) -> None:
    """The car is 20 m east: in the sector from 45° to 80° once it is 3.5 m north, from 1.353 s on."""
    path = looking(tmp_path / "a.mcap", sector(800, 450, 800))
    draft = cr.draft_experiment(path)
    assert "      - {range_m: [0.0, 80.0], azimuth_deg: [-80.0, -45.0]}" in draft
    (tmp_path / "a.yaml").write_text(draft)
    rows = cr.run(tmp_path / "a.yaml").detections.query("configuration == 'cpm' and object_id == '2' and run == 0")
    (row,) = rows.to_dict("records")
    assert row["in_sight_s"] == pytest.approx(1.4)
    assert row["out_of_view_s"] == pytest.approx(1.4)
    assert row["hidden_s"] == 0

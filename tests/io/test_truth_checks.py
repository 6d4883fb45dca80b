"""The truth against the paths of its objects, in scenes one can compute in the head."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from copem_replay.core.errors import RecordingError
from copem_replay.io.recording import Recording, read_log
from tests.helpers.recordings import Obj, pedestrian, write_mcap, write_recording
from tests.helpers.ros2 import made, odometry, pose, topic
from tests.io.test_world_frame import fields, json_topic, own

TIMES = [k / 10 for k in range(40)]


def read(path: Path, objects: list[list[Obj]]) -> Recording:
    return read_log(write_recording(path / "a.mcap", list(zip(TIMES, objects, strict=False))), name="log")


def ways(recording: Recording) -> dict[str, list[float]]:
    of = recording.truth.row_object_ix
    return {name: recording.truth.x_m[0, of == k].tolist() for k, name in enumerate(recording.scene.object_ids)}


def test_who_jumps_away_and_back_is_not_there(tmp_path: Path) -> None:
    objects = [[pedestrian(7, t + 40 * (1.95 < t < 2.95), vx=1.0)] for t in TIMES]
    recording = read(tmp_path, objects)
    assert ways(recording) == {"7": [t for t in TIMES if not 1.95 < t < 2.95]}
    assert recording.notes == (
        "object 7 jumps by 40.1 m at 2.000 s: its track is cut there, 25% of its states are another object's or none",
    )


def test_who_does_not_come_back_is_another(tmp_path: Path) -> None:
    recording = read(tmp_path, [[Obj(id=7, x=10 * t + 30 * (t > 2.45), vx=10.0)] for t in TIMES])
    assert {name: len(way) for name, way in ways(recording).items()} == {"7": 25, "7/2": 15}


def test_a_single_place_that_is_wrong_is_left_out(tmp_path: Path) -> None:
    recording = read(tmp_path, [[Obj(id=7, x=8 * t, y=25.0 * (k == 9), vx=8.0)] for k, t in enumerate(TIMES)])
    assert ways(recording) == {"7": [8 * t for k, t in enumerate(TIMES) if k != 9]}


def test_hard_braking_a_gap_and_jitter_are_no_jumps(tmp_path: Path) -> None:
    braking = [25 * t - 0.5 * 10 * t * t if t < 2.5 else 31.25 for t in TIMES]
    objects = [
        [Obj(id=1, x=x, vx=1.0), Obj(id=3, x=0, y=50 + 0.8 * (k % 2), vx=0.1)]
        + ([Obj(id=2, x=20 * t, y=9, vx=20.0)] if not 1 < t < 3 else [])
        for k, (t, x) in enumerate(zip(TIMES, braking, strict=True))
    ]
    assert not [n for n in read(tmp_path, objects).notes if "jump" in n]


def test_an_id_that_comes_back_as_another_class(tmp_path: Path) -> None:
    objects = [[Obj(id=5, x=t, vx=1)] if t < 1.5 else [pedestrian(5, t, vx=1)] if t > 2.5 else [] for t in TIMES]
    recording = read(tmp_path, objects)
    assert sorted(ways(recording)) == ["5", "5/2"]
    assert len(set(recording.scene.object_class.tolist())) == 2


def test_velocities_across_the_path_are_those_of_the_path(tmp_path: Path) -> None:
    """It drives north at 5 m/s and says that it drives west."""
    recording = read(tmp_path, [[Obj(id=4, y=5 * t, yaw=math.pi / 2, vx=-5.0, vy=0.0)] for t in TIMES])
    assert recording.truth.vx_mps[0] == pytest.approx(0)
    assert recording.truth.vy_mps[0] == pytest.approx(5)
    assert "object 4: its velocity points across its path in 100% of the states in which it moves" in recording.notes[0]


def test_headings_that_flip_or_point_across(tmp_path: Path) -> None:
    flips = [Obj(id=1, x=9 * t, yaw=math.pi * (k % 4 == 0), vx=9.0) for k, t in enumerate(TIMES)]
    across = [Obj(id=2, x=9 * t, y=9, yaw=math.pi / 2, vx=9.0) for t in TIMES]
    backs = [Obj(id=3, x=-2 * t, y=19, yaw=0, vx=-2.0) for t in TIMES]  # a car that reverses is none of it
    notes = read(tmp_path, [list(row) for row in zip(flips, across, backs, strict=True)]).notes
    assert [note.partition(" in ")[0] for note in notes] == [
        "object 2: its heading points across its path",
        "object 1: its heading turns by half a turn at once",
    ]


def test_headings_in_degrees_are_refused_with_what_mends_it(tmp_path: Path) -> None:
    lists = []
    for t in TIMES:
        message = own(t)
        message["boxes"][0] |= {"pos": [5.0, 3 * t, 0.9]}
        lists.append((t, message))
    path = write_mcap(tmp_path / "a.mcap", [json_topic("/boxes", lists)])
    with pytest.raises(RecordingError, match=r"headings are in degrees.*yaw_rad: \{degrees: …\}"):
        read_log(path, name="log", topic="/boxes", fields=fields(yaw_rad="rot"))
    read_log(path, name="log", topic="/boxes", fields=fields())


def marked(name: str, t: float, x: float, y: float, frame: str, ident: int = 1, length: float = 4.0) -> object:
    from tests.helpers.ros2 import header

    size = made("geometry_msgs/msg/Vector3", x=length, y=2.0, z=1.5)
    return made(
        "visualization_msgs/msg/Marker", header=header(t, frame), ns=name, id=ident, type=1, pose=pose(x, y), scale=size
    )


def boxes(*lists: tuple[float, list[object]]) -> object:
    kind = "visualization_msgs/msg/MarkerArray"
    return topic("/boxes", kind, [(t, made(kind, markers=markers)) for t, markers in lists])


def test_an_ego_that_is_listed_too_gives_its_size_and_is_not_measured(tmp_path: Path) -> None:
    lists = [
        (t, [marked("car", t, 10 * t + 1.4, 0, "map", length=5.1), marked("truck", t, 50, 4, "map")]) for t in TIMES
    ]
    odom = topic("/odom", "nav_msgs/msg/Odometry", [(t, odometry(t, 10 * t, 0.0)) for t in TIMES])
    recording = read_log(write_mcap(tmp_path / "a.mcap", [boxes(*lists), odom]), name="log")
    assert recording.scene.object_ids == ("car/1", "truck/1")
    assert recording.scene.object_ids[recording.scene.ego_ix] == "car/1"
    assert recording.scene.ego_sized
    assert "object car/1 is where /odom says, in all lists that it is in: it is the ego, which it gives the size" in (
        recording.notes
    )


def test_a_frame_without_a_name_is_that_of_the_ego(tmp_path: Path) -> None:
    lists = [(t, [marked("truck", t, 50, 4, "")]) for t in TIMES]
    odom = topic("/odom", "nav_msgs/msg/Odometry", [(t, odometry(t, 10 * t, 0.0)) for t in TIMES])
    recording = read_log(write_mcap(tmp_path / "a.mcap", [boxes(*lists), odom]), name="log")
    assert "40 object states in no named frame: taken as in map" in recording.notes


def test_ids_that_are_places_in_the_list(tmp_path: Path) -> None:
    """The nearer car leaves after 2 s: the farther one takes its place, and its id."""
    lists = []
    for t in TIMES:
        cars = [0.0, 30.0, 60.0] if t < 2 else [30.0, 60.0]
        lists.append((t, [marked("car", t, x, 0, "map", ident=k) for k, x in enumerate(cars)]))
    recording = read_log(write_mcap(tmp_path / "a.mcap", [boxes(*lists)]), name="log")
    assert "2 objects jump: ids look like places in the list, which no object keeps" in recording.notes

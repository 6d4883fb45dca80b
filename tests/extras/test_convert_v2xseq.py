"""The converter of V2X-Seq: two sequences of a few frames, all expected values by hand."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from tests.extras.conversions import Runner, convert, run

__all__ = ["run"]

T0_US = 1_626_155_123_671_001
LEFT = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]  # 90° counter-clockwise
STRAIGHT = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
PLACE = ("x_m", "y_m", "z_m", "yaw_rad")
SIZE = ("length_m", "width_m", "height_m")


def label(track: Any, x: float, y: float, **more: Any) -> dict[str, Any]:
    row = {"type": "Car", "3d_dimensions": {"h": 1.6, "w": 1.9, "l": 4.5}, "3d_location": {"x": x, "y": y, "z": -1.0}}
    return {**row, "rotation": 0.0, "track_id": track, "from_side": "veh", "occluded_state": 0} | more


def put(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))


def write(folder: Path) -> Path:
    """Sequence 0000 has two frames, 0001 one. The lidar is 0.5 m ahead of the NovAtel: at (100, 200), facing north."""
    frames = {"000010": ("0000", 0), "000011": ("0000", 100_000), "000020": ("0001", 900_000)}
    side = [
        {"frame_id": frame, "sequence_id": sequence, "pointcloud_timestamp": str(T0_US + us)}
        for frame, (sequence, us) in frames.items()
    ]
    put(folder / "vehicle-side/data_info.json", side)
    pairs = [
        {"vehicle_frame": frame, "infrastructure_frame": "7", "vehicle_sequence": sequence, "system_error_offset": {}}
        for frame, (sequence, _) in reversed(frames.items())
    ]
    put(folder / "cooperative/data_info.json", pairs)
    for k, frame in enumerate(frames):
        calib = folder / "vehicle-side/calib"
        in_novatel = {"transform": {"rotation": STRAIGHT, "translation": [[0.5], [0.0], [1.2]]}}
        put(calib / "lidar_to_novatel" / f"{frame}.json", in_novatel)
        put(calib / "novatel_to_world" / f"{frame}.json", {"rotation": LEFT, "translation": [[100], [200 + k], [40]]})
        put(folder / f"cooperative/label/{frame}.json", [label("0007", 10, 1), label("0042", 20, 0, type="Cyclist")])
    put(
        folder / "infrastructure-side/calib/virtuallidar_to_world/7.json",
        {"rotation": STRAIGHT, "translation": [[9], [8], [47]]},
    )
    return folder


def test_from_the_lidar_to_the_world(run: Runner) -> None:
    found = run("v2xseq", write(run.folder / "set"), "--only", "0000")
    assert found.stamps_ns == [1000 * T0_US, 1000 * (T0_US + 100_000)]
    assert found.recording.host_id == "1"
    # 10.5 m ahead of the NovAtel is 10.5 m north of it, 1 m to the left is 1 m west.
    rows = found.values(found.id_of("0007"), *PLACE, *SIZE)
    assert rows[0] == pytest.approx([99, 210.5, 40.2, math.pi / 2, 4.5, 1.9, 1.6])
    assert rows[1][1] == pytest.approx(211.5)
    # The lidar is at (100, 200.5, 41.2), on the roof of a car of 1.5 m.
    assert found.values("1", *PLACE, *SIZE)[0] == pytest.approx([100, 200.5, 40.45, math.pi / 2, 4.9, 1.9, 1.5])
    assert found.class_of(found.id_of("0042")) == "bicycle"
    assert "the roadside lidar, for a unit: at: [9.00, 8.00], height_m: 47.00, yaw_deg: 0.0" in found.printed


def test_rotations_of_labels_and_of_the_vehicle_add_up(run: Runner) -> None:
    folder = write(run.folder / "set")
    put(
        folder / "cooperative/label/000020.json",
        [label(7, 0, 0, rotation=-1.0), label(7, 1, 0), label(8, 5, 5, type="Zorb")],
    )
    found = run("v2xseq", folder, "--only", "0001", "--ego-size-m", "5", "2", "1.4")
    assert found.values(found.id_of("7"), "yaw_rad")[0][0] == pytest.approx(math.pi / 2 - 1)
    assert found.values("1", "z_m", "length_m")[0] == pytest.approx([40.5, 5])
    assert "1 label of an object that the frame has already: skipped" in found.printed
    assert "1 object state of the class name 'Zorb', which says nothing: taken as other; " in found.printed


@pytest.mark.parametrize("none", [math.nan, math.inf, -math.inf, 1e308])
def test_a_number_of_a_label_that_is_none_is_left_out_or_completed(run: Runner, none: float) -> None:
    sound = label(7, 0, 0)
    odd = [label(8, none, 0), label(9, 0, none), label(10, 5, 5, rotation=none)]
    unsized = label(11, 9, 9, **{"3d_dimensions": {"h": 1.6, "w": 1.9, "l": none}})
    folder = write(run.folder / "set")
    put(folder / "cooperative/label/000020.json", [sound, *odd, unsized])
    found = run("v2xseq", folder, "--only", "0001")
    assert "note: 3 object states with a number that is none: skipped\n" in found.printed
    assert {found.names[ident] for ident in found.recording.scene.object_ids} >= {"7", "11"}
    assert len(found.recording.scene.object_ids) == 3
    assert found.values(found.id_of("11"), "length_m") == [[4.5]]


def test_a_missing_file_of_labels_is_a_gap(run: Runner) -> None:
    folder = write(run.folder / "set")
    (folder / "cooperative/label/000010.json").unlink()
    found = run("v2xseq", folder, "--only", "0000")
    assert found.stamps_ns == [1000 * (T0_US + 100_000)]
    assert "note: 1 frame without its file of labels: a gap\n" in found.printed


def test_each_sequence_is_a_recording(run: Runner) -> None:
    assert convert("v2xseq", write(run.folder / "set"), "--out", run.folder / "out") == 0
    assert sorted(path.name for path in (run.folder / "out").iterdir()) == ["0000.mcap", "0001.mcap"]


@pytest.mark.parametrize(
    ("file", "change", "said"),
    [
        ("cooperative/data_info.json", None, "cooperative/data_info.json: no such file; V2X-Seq has one"),
        ("vehicle-side/data_info.json", "[{", "data_info.json: expected JSON, found something else or its end"),
        ("vehicle-side/data_info.json", "[]", "row 1: expected a frame of vehicle-side/data_info.json, found '000020'"),
        ("cooperative/data_info.json", "[]", "data_info.json: expected pairs of frames, found none"),
        ("cooperative/data_info.json", "{}", "data_info.json: expected a list, found {}"),
        ("cooperative/data_info.json", "[{}]", "row 1: expected vehicle_frame, found nothing"),
        ("cooperative/data_info.json", '[{"vehicle_frame": "../x"}]', "row 1: expected vehicle_frame, found '../x'"),
        (
            "cooperative/data_info.json",
            '[{"cooperative_label_path": "x"}]',
            "expected V2X-Seq, found DAIR-V2X-C, whose",
        ),
        ("vehicle-side/calib/novatel_to_world/000010.json", None, "000010.json: no such file"),
        ("cooperative/label/000010.json", "[{}]", "label 1: expected a track_id, found nothing: V2X-Seq has them"),
        (
            "cooperative/label/000010.json",
            '[{"track_id": "1"}]',
            "label 1: 3d_location: expected x, y, z, found nothing",
        ),
        ("vehicle-side/calib/novatel_to_world/000010.json", "{}", "rotation: expected 9 numbers, found nothing"),
        ("vehicle-side/calib/novatel_to_world/000010.json", "[]", "rotation: expected 9 numbers, found nothing"),
        (
            "vehicle-side/calib/lidar_to_novatel/000010.json",
            '{"rotation": [1, 1, 1, 1, 1, 1, 1, 1, 1], "translation": [0, 0, 0]}',
            "rotation: expected a rotation, found another matrix",
        ),
    ],
)
def test_a_file_that_is_none_is_one_line(run: Runner, file: str, change: str | None, said: str) -> None:
    path = write(run.folder / "set") / file
    path.unlink() if change is None else path.write_text(change)
    assert said in run.refused("v2xseq", run.folder / "set", "--only", "0000")


def test_wrong_folders_are_one_line(run: Runner) -> None:
    folder = write(run.folder / "set")
    assert "expected the folder of V2X-Seq, found a file" in run.refused(
        "v2xseq", folder / "cooperative/data_info.json"
    )
    assert "expected a folder for the recordings of one" in run.refused("v2xseq", folder)
    assert "vehicle-side/data_info.json: no such file" in run.refused("v2xseq", folder / "cooperative")

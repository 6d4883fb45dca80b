"""The converter of OPV2V and data sets of its layout: a few frames of a few agents, all expected values by hand."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.extras.conversions import Runner, convert, run

__all__ = ["run"]

PLACE = ("x_m", "y_m", "z_m", "yaw_rad")
SIZE = ("length_m", "width_m", "height_m")


def label(x: float, y: float, yaw: float = 0.0, **more: Any) -> dict[str, Any]:
    """A car on the ground at z = 0, whose box is 0.7 m up and 0.1 m ahead."""
    return {
        "angle": [0.0, yaw, 0.0], "center": [0.1, 0.0, 0.7], "extent": [2.4, 1.0, 0.75], "location": [x, y, 0.0],
        "speed": 36.0,
    } | more  # fmt: skip


def frame(x: float, y: float, yaw: float, vehicles: dict[Any, Any], **more: Any) -> dict[str, Any]:
    """Cameras and plans stand beside what is used, as in the data set."""
    return {
        "camera0": {"cords": [0.0] * 6, "intrinsic": [[1.0, 0.0], [0.0, 1.0]]},
        "ego_speed": 18.0,
        "lidar_pose": [x, y, 1.9, 0.0, yaw, 0.0],
        "plan_trajectory": [[1.0, 2.0, 3.0]],
        "true_ego_pos": [x, y, 0.0, 0.0, yaw, 0.0],
        "vehicles": vehicles,
    } | more


def write(folder: Path, frames: dict[str, dict[int, dict[str, Any]]], **protocol: Any) -> Path:
    for agent, of in frames.items():
        (folder / agent).mkdir(parents=True)
        for number, data in of.items():
            (folder / agent / f"{number:06d}.yaml").write_text(yaml.safe_dump(data))
            (folder / agent / f"{number:06d}.pcd").write_text("")
    if protocol:
        (folder / "data_protocol.yaml").write_text(yaml.safe_dump(protocol))
    return folder


def scenario() -> dict[str, dict[int, dict[str, Any]]]:
    """641 and 650 see each other and a third, 700; the roadside unit −1 sees a walker."""
    return {
        "-1": {68: frame(5, 5, 90, {900: label(9, 9, extent=[0.2, 0.3, 0.9], bp_id="walker.pedestrian.0001")})},
        "641": {
            68: frame(10, 20, 0, {650: label(30, 20, 180), 700: label(40, 25, 90)}),
            70: frame(11, 20, 0, {700: label(40, 26, 90)}),
        },
        "650": {
            68: frame(30, 20, 180, {641: label(10, 20), 700: label(40, 25.7, 90)}),
            70: frame(29, 20, 180, {}),
        },
    }


def test_axes_of_carla_are_mirrored(run: Runner) -> None:
    found = run("opv2v", write(run.folder / "s", scenario()))
    assert found.stamps_ns == [0, 100_000_000]
    assert found.recording.host_id == "641"
    # 700 is 40 m east and 25 m to the right; it faces the right, with the clock: south. Its box is 0.1 m ahead.
    rows = found.values("700", *PLACE, *SIZE)
    assert rows[0] == pytest.approx([40, -25.1, 0.7, -math.pi / 2, 4.8, 2.0, 1.5])
    assert rows[1] == pytest.approx([40, -26.1, 0.7, -math.pi / 2, 4.8, 2.0, 1.5])
    # An agent has the size that others label, at its own pose: 650 in its second frame, which nobody labels.
    assert [abs(v) for v in found.values("650", *PLACE)[1]] == pytest.approx([28.9, 20, 0.7, math.pi])
    assert found.values("641", *PLACE, *SIZE)[1] == pytest.approx([11.1, -20, 0.7, 0, 4.8, 2.0, 1.5])
    assert [found.class_of(ident) for ident in ("641", "700", "900")] == ["vehicle", "vehicle", "pedestrian"]
    assert sorted(found.recording.scene.object_ids) == ["641", "650", "700", "900"]
    for note in (
        "axes: CARLA's, y to the right and yaw with the clock: y and yaw change sign (--axes right: as they are)",
        "time: numbers of frames times 0.05 s, from the first",
        "agent -1: infrastructure, no object; its lidar, for a unit: at: [5.00, -5.00], height_m: 1.90, yaw_deg: -90.0",
        "agent 641: an object, of the size that others label",
        "1 label more than 0.5 m from that of another agent for the same object: skipped",
    ):
        assert f"note: {note}\n" in found.printed


def test_the_centre_of_a_box_is_turned_with_it(run: Runner) -> None:
    """The nose of a car that faces the right (south) rises by 30°: of 2 m ahead, 1.73 m are south and 1 m up."""
    tilted = label(0, 0, angle=[0.0, 90.0, 30.0], center=[2.0, 0.0, 0.0])
    found = run("opv2v", write(run.folder / "s", {"1": {0: frame(50, 0, 0, {5: tilted})}}))
    assert found.values("5", *PLACE)[0] == pytest.approx([0, -math.sqrt(3), 1.0, -math.pi / 2])


def test_matrices_and_classes_of_real_recordings_are_not_mirrored(run: Runner) -> None:
    """CooperScene: poses as matrices, an agent 2 whose car others label as 31. The lidar is 0.2 m above its roof."""
    north = [[0.0, -1.0, 0.0, 10.0], [1.0, 0.0, 0.0, 20.0], [0.0, 0.0, 1.0, 1.7], [0.0, 0.0, 0.0, 1.0]]
    flat = {"center": [0, 0, 0]}
    seen = label(10.0, 19.5, 90, location=[10.0, 19.5, 0.75], **flat)
    mast = {"lidar_pose": [[1.0, 0, 0, -3.0], [0, 1.0, 0, 4.0], [0, 0, 1.0, 6.0], [0, 0, 0, 1.0]], "ego_speed": 0}
    agents = {
        "0": {85380: mast | {"vehicles": {31: seen, 32: label(1, 2, obj_type="ScooterRider", **flat)}}},
        "2": {85380: {"lidar_pose": north, "vehicles": {2: label(7, 7, **flat)}}},
    }
    found = run("opv2v", write(run.folder / "s", agents), "--infrastructure", "0")
    assert found.values("31", *PLACE)[0] == pytest.approx([10, 19.5, 0.75, math.pi / 2])
    assert found.recording.host_id == "31"
    assert sorted(found.recording.scene.object_ids) == ["2", "31", "32"]  # object 2 is not agent 2
    assert found.class_of("32") == "bicycle"
    assert "agent 2 (object 31): an object, of the size that others label" in found.printed
    assert (
        "agent 0: infrastructure, no object; its lidar, for a unit: at: [-3.00, 4.00], height_m: 6.00" in found.printed
    )
    mirrored = run("opv2v", run.folder / "s", "--infrastructure", "0", "--axes", "left")
    assert mirrored.values("31", "y_m", "yaw_rad")[0] == pytest.approx([-19.5, -math.pi / 2])


def test_an_agent_that_nobody_labels_has_the_size_of_a_car(run: Runner) -> None:
    found = run("opv2v", write(run.folder / "s", {"7": {0: frame(1, 2, 0, {7: label(90, 2)})}}))
    (ident,) = [ident for ident, name in found.names.items() if name == "agent 7"]
    assert found.values(ident, *PLACE, *SIZE)[0] == pytest.approx([1, -2, 0.75, 0, 4.5, 1.8, 1.5])
    assert found.recording.host_id == ident
    assert "agent 7: an object of 4.5×1.8×1.5 m, as no other labels it" in found.printed


@pytest.mark.parametrize(
    ("numbers", "protocol", "options", "stamps_ms"),
    [
        ([68, 70, 74], {}, [], [0, 100, 300]),
        ([68, 70, 74], {"world": {"fixed_delta_seconds": 0.02}}, [], [0, 40, 120]),
        ([68, 70, 74], {"world": {"fixed_delta_seconds": 0.02}}, ["--rate-hz", "5"], [0, 200, 600]),
        ([3], {"world": None}, [], [0]),
    ],
)
def test_times_of_frames(
    run: Runner, numbers: list[int], protocol: dict[str, Any], options: list[str], stamps_ms: list[int]
) -> None:
    source = write(run.folder / "s", {"1": {k: frame(0, 0, 0, {}) for k in numbers}}, **protocol)
    assert run("opv2v", source, *options).stamps_ns == [1_000_000 * stamp for stamp in stamps_ms]


def test_a_folder_of_scenarios_and_one_of_them(run: Runner) -> None:
    for name in ("2021_a", "2021_b"):
        write(run.folder / "train" / name, {"1": {0: frame(0, 0, 0, {})}})
    assert convert("opv2v", run.folder / "train", "--out", run.folder / "out") == 0
    run.capsys.readouterr()
    assert sorted(path.name for path in (run.folder / "out").iterdir()) == ["2021_a.mcap", "2021_b.mcap"]
    one = run.folder / "one.mcap"
    assert convert("opv2v", run.folder / "train", "--only", "2021_b", "--out", one) == 0
    assert one.read_bytes() != (run.folder / "out/2021_a.mcap").read_bytes()
    assert one.read_bytes() == (run.folder / "out/2021_b.mcap").read_bytes()


def test_the_host_is_asked_for(run: Runner) -> None:
    source = write(run.folder / "s", scenario())
    assert run("opv2v", source, "--host", "650").recording.host_id == "650"
    assert "no agent is named '651'; did you mean 6" in run.refused("opv2v", source, "--host", "651")
    assert "--host: expected a vehicle, found infrastructure: -1" in run.refused("opv2v", source, "--host=-1")


def test_wrong_folders_are_one_line(run: Runner) -> None:
    source = write(run.folder / "s", scenario())
    agent, file = source / "641", source / "641/000068.yaml"
    assert "expected a scenario with a folder for each agent, found the folder of one agent" in run.refused(
        "opv2v", agent
    )
    assert "expected the folder of a scenario or of several, found a file" in run.refused("opv2v", file)
    (run.folder / "empty").mkdir()
    assert "expected scenarios, AGENT/000000.yaml in each, found none" in run.refused("opv2v", run.folder / "empty")
    assert "--axes: expected left or right, found 'up'" in run.refused("opv2v", source, "--axes", "up")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "000068.yaml: expected vehicles, objects, lidar_pose, true_ego_pos, found none of them"),
        ("vehicles: {}", "000068.yaml: expected true_ego_pos or lidar_pose, found vehicles"),
        ("lidar_pose: [1, 2]\nvehicles: {}", "lidar_pose: expected 6 numbers, found [1, 2]"),
        ("lidar_pose: [0, 0, 0, 0, 0, .nan]\nvehicles: {}", "lidar_pose: expected a number, found nan"),
        ("lidar_pose: [0, 0, 0, 0, 0, 0]", "vehicles: expected an object of objects, found nothing"),
        ("lidar_pose: [0, 0, 0, 0, 0, 0]\nvehicles: [1]", "vehicles: expected an object of objects, found [1]"),
        ("lidar_pose: [0, 0, 0, 0, 0, 0]\nvehicles: {4: 1}", "vehicle 4: expected location, center, angle and extent"),
        ("lidar_pose: [0, 0, 0, 0, 0, 0]\nvehicles: {4: {}}", "vehicle 4: location: expected 3 numbers, found nothing"),
        ("camera: [\nvehicles:\n  4: {location: [1,\n", "000068.yaml:"),
        ("lidar_pose: [0, 0, 1e99, 0, 0, 0]\nvehicles: {}", "expected numbers of at most 1e+08, found 1e+99"),
        ("true_ego_pos: !!python/tuple [1]\nvehicles: {}", "000068.yaml"),
    ],
)
def test_a_file_that_is_none_is_one_line(run: Runner, text: str, said: str) -> None:
    source = write(run.folder / "s", scenario())
    (source / "641/000068.yaml").write_text(text)
    assert said in run.refused("opv2v", source)


def test_a_scenario_that_cannot_be_read_leaves_the_others(run: Runner, capsys: pytest.CaptureFixture[str]) -> None:
    for name in "abc":
        write(run.folder / "all" / name, scenario())
    (run.folder / "all/b/641/000068.yaml").write_text("lidar_pose: [")
    out = run.folder / "out"
    words = ["opv2v", run.folder / "all", "--out", out]
    assert convert(*words) == 2
    printed = capsys.readouterr()
    first, last = printed.err.splitlines()
    assert first.startswith(f"{run.folder / 'all/b/641/000068.yaml'}:1: ")
    assert last == "1 of 3 scenarios not converted"
    assert [line.split(":")[0] for line in printed.out.splitlines()[:2]] == [str(out / f"{name}.mcap") for name in "ac"]
    assert "(2 recordings)" in printed.out, "notes count over all recordings"
    # The same again is refused before anything is read, and done with --overwrite, to the same bytes.
    before = (out / "a.mcap").read_bytes()
    assert convert(*words) == 2
    assert (
        capsys.readouterr().err
        == f"{out / 'a.mcap'}: is there already, and 1 other; give another name, or --overwrite\n"
    )
    assert convert(*words, "--overwrite") == 2
    assert (out / "a.mcap").read_bytes() == before
    # Where nothing can be written, that is said once.
    place = run.file("place", "") / "out"
    assert convert("opv2v", run.folder / "all", "--out", place) == 2
    assert capsys.readouterr().err.splitlines()[-1] == f"{place}: cannot be written: {place.parent} is a file"

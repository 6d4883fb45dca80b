"""Images and points of the recording itself, behind the boxes: every one where and when it was taken.

The ego drives east at 10 m/s, from the origin. A camera, 1 m ahead of its middle and 1.5 m high, sees a bus: its back,
54 m east of the origin, is painted in the image where it has to be. A lidar at the same place has four points on it.
All are stamped every 0.1 s and logged 30 to 50 ms later; transforms are logged later still.
"""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap_protobuf.schema import build_file_descriptor_set
from osi3.osi_groundtruth_pb2 import GroundTruth
from PIL import Image

import copem_replay as cr
from copem_replay.core.errors import InputError, RecordingError
from copem_replay.results.read import open_results
from copem_replay.viewer import write_with_recording
from tests.helpers.experiments import changed
from tests.helpers.recordings import Obj, Topic, ns, truth_topic, write_mcap
from tests.helpers.ros2 import header, made, topic, transform
from tests.viewer.test_rrd import rows, static

T0_S, FRAMES = 1_600_000_000.25, 20
FOCAL, MIDDLE = 400.0, (320.0, 240.0)
BUS = {"id": 2, "x": 60.0, "y": 4.0, "z": 1.5, "length": 12.0, "width": 2.5, "height": 3.0}
OPTICAL = (-0.5, 0.5, -0.5, 0.5)
"""Turns an image's right, down and ahead into right, down and ahead of a vehicle that faces east."""


def corners_px(ego_x_m: float) -> np.ndarray:
    """Left, top, right and bottom of the back of the bus in the image, by the pinhole's rule."""
    ahead_m = 54.0 - ego_x_m - 1.0
    across = np.array([-(4.0 + 1.25), -(3.0 - 1.5), -(4.0 - 1.25), 1.5])
    return np.array([*MIDDLE, *MIDDLE]) + FOCAL * across / ahead_m


def image(ego_x_m: float) -> bytes:
    left, top, right, bottom = corners_px(ego_x_m).round().astype(int)
    pixels = np.full((480, 640, 3), 60, dtype=np.uint8)
    pixels[top:bottom, left:right] = (20, 160, 220)
    content = io.BytesIO()
    Image.fromarray(pixels).save(content, "PNG")
    return content.getvalue()


def points(ego_x_m: float) -> np.ndarray:
    """(4, 3) places on the back of the bus, as the lidar has them."""
    return np.array([[53.0 - ego_x_m, y, z] for y in (3.0, 5.0) for z in (-1.0, 1.0)], dtype=np.float32)


def sensors(*, moves: bool = True, calibrated: bool = True) -> list[Topic]:
    """The topics of the sensors; `moves`: transforms say where the vehicle is, too."""
    fields = [
        made("sensor_msgs/msg/PointField", name=n, offset=4 * k, datatype=7, count=1) for k, n in enumerate("xyz")
    ]
    matrix = np.array([FOCAL, 0, MIDDLE[0], 0, FOCAL, MIDDLE[1], 0, 0, 1])
    seen: dict[str, list[tuple[float, Any]]] = {name: [] for name in ("image", "info", "cloud", "tf", "scan")}
    for k in range(FRAMES):
        t_s, cloud = T0_S + 0.1 * k, points(k)
        at = {"image": header(t_s, "cam"), "cloud": header(t_s, "lidar")}
        pixels = np.frombuffer(image(k), np.uint8)
        seen["image"].append(
            (t_s + 0.03, made("sensor_msgs/msg/CompressedImage", header=at["image"], format="png", data=pixels))
        )
        info = {"width": 640, "height": 480, "k": matrix, "d": np.zeros(5), "r": np.eye(3).ravel(), "p": np.zeros(12)}
        seen["info"].append((t_s + 0.03, made("sensor_msgs/msg/CameraInfo", header=at["image"], **info)))
        shape = {"height": 1, "width": 4, "point_step": 12, "row_step": 48, "is_dense": True, "fields": fields}
        data = np.frombuffer(cloud.tobytes(), np.uint8)
        seen["cloud"].append((t_s + 0.04, made("sensor_msgs/msg/PointCloud2", header=at["cloud"], data=data, **shape)))
        where = made("tf2_msgs/msg/TFMessage", transforms=[transform(t_s, "map", "base_link", k, 0.0)])
        seen["tf"].append((t_s + 0.06, where))
        seen["scan"].append((t_s, made("sensor_msgs/msg/LaserScan", header=at["cloud"])))
    fixed = [transform(T0_S, "base_link", name, 1.0, 0.0) for name in ("cam", "lidar")]
    for one in fixed:
        one.transform.translation.z = 1.5
    for name, value in zip("xyzw", OPTICAL, strict=True):
        setattr(fixed[0].transform.rotation, name, value)
    kinds = {
        "/cam/image": ("sensor_msgs/msg/CompressedImage", "image"), "/points": ("sensor_msgs/msg/PointCloud2", "cloud"),
        "/scan": ("sensor_msgs/msg/LaserScan", "scan"), "/tf": ("tf2_msgs/msg/TFMessage", "tf"),
        "/cam/camera_info": ("sensor_msgs/msg/CameraInfo", "info"),
    }  # fmt: skip
    kept = {"/tf": moves, "/cam/camera_info": calibrated}
    found = [topic(name, kind, seen[what]) for name, (kind, what) in kinds.items() if kept.get(name, True)]
    return [
        *found,
        topic("/tf_static", "tf2_msgs/msg/TFMessage", [(T0_S, made("tf2_msgs/msg/TFMessage", transforms=fixed))]),
    ]


def recorded(path: Path, more: list[Topic], *, stamped_s: float = T0_S) -> Path:
    """A recording of the drive with `more` topics; `stamped_s`: the first stamp of its truth, logged at `T0_S`."""
    frames = [
        (stamped_s + 0.1 * k, [Obj(id=1, x=k, vx=10.0), Obj(**BUS), Obj(id=3, x=60.0, y=-3.0)]) for k in range(FRAMES)
    ]
    truth = truth_topic(frames, host=1, log_s=[T0_S + 0.1 * k for k in range(FRAMES)])
    definition = ("protobuf", build_file_descriptor_set(GroundTruth).SerializeToString())
    return write_mcap(path, [Topic(truth.name, truth.schema, truth.messages, definition=definition), *more])


def replayed(folder: Path, more: list[Topic], **truth: float) -> Path:
    """The results of an experiment on it, which show the recording."""
    recorded(folder / "drive.mcap", more, **truth)
    (folder / "e.yaml").write_text(changed("runs: 1", "show: {run: 0, with_recording: true}"))
    return cr.run(folder / "e.yaml").save(folder / "r")


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return replayed(tmp_path_factory.mktemp("recorded"), sensors())


def notes_of(results: Path) -> list[str]:
    return [note for note in open_results(results).provenance.data["notes"] if "Rerun" in note or "boxes" in note]


def check_times(found: list[dict[str, Any]], t0_s: float = T0_S) -> None:
    """As stamped, to the nanosecond, on both time lines."""
    expected = [ns(T0_S + 0.1 * k) - ns(T0_S) for k in range(FRAMES)]
    assert [row["elapsed"] for row in found] == expected
    assert [row["time"] for row in found] == [ns(t0_s) + elapsed_ns for elapsed_ns in expected]


def test_images_are_those_of_the_recording_when_they_were_taken(results: Path) -> None:
    found = [row for row in rows(results / "replay.rrd", "/recorded/cam/image") if "EncodedImage:blob" in row]
    check_times(found)
    assert [bytes(row["EncodedImage:blob"][0]) for row in found] == [image(k) for k in range(FRAMES)]


def test_points_are_those_of_the_recording(results: Path) -> None:
    found = [row for row in rows(results / "replay.rrd", "/recorded/points") if "Points3D:positions" in row]
    check_times(found)
    for k, row in enumerate(found):
        assert row["Points3D:positions"] == points(k).tolist()


def poses(results: Path, entity: str) -> list[dict[str, Any]]:
    return [row for row in rows(results / "replay.rrd", entity) if "Transform3D:translation" in row]


@pytest.mark.parametrize("moves", [True, False], ids=["transforms", "truth"])
def test_boxes_of_the_truth_fall_on_what_the_camera_saw(
    results: Path,
    tmp_path: Path,
    moves: bool,  # as the transforms, and as the truth have the ego
) -> None:
    place = results if moves else replayed(tmp_path, sensors(moves=False))
    found = poses(place, "/recorded/cam/image")
    check_times(found)
    camera = static(place / "replay.rrd", "/recorded/cam/image")
    matrix = np.reshape(camera["Pinhole:image_from_camera"][0], (3, 3)).T
    boxes = rows(place / "replay.rrd", "/world/truth/boxes")
    for k in (0, 7, FRAMES - 1):
        np.testing.assert_allclose(found[k]["Transform3D:quaternion"][0], OPTICAL, atol=1e-6)
        places, sizes = (boxes[k][f"Boxes3D:{of}"] for of in ("centers", "half_sizes"))
        bus = next(n for n, half in enumerate(sizes) if half[0] == 6.0)
        back = np.array(places[bus])[:, None] + np.array(sizes[bus])[:, None] * [[-1, -1], [1, -1], [1, -1]]
        ahead, left, up = back - np.array(found[k]["Transform3D:translation"][0])[:, None]
        u, v, w = matrix @ np.stack([-left, -up, ahead])
        np.testing.assert_allclose([(u / w)[0], (v / w)[0], (u / w)[1], (v / w)[1]], corners_px(k), atol=0.01)


def test_what_rerun_cannot_draw_or_place_is_said(results: Path, tmp_path: Path) -> None:
    assert notes_of(results) == ["drive: Rerun's reader of MCAP does not draw: /scan (sensor_msgs/msg/LaserScan)"]
    bare = replayed(tmp_path, sensors(calibrated=False))
    assert notes_of(bare)[1:] == ["drive: no boxes on, for want of a calibration or of transforms: /cam/image"]
    assert poses(bare, "/recorded/cam/image") == []
    assert len(poses(bare, "/recorded/points")) == FRAMES


def test_without_sensors_there_is_a_note_and_no_page(tmp_path: Path) -> None:
    bare = replayed(tmp_path, [])
    assert notes_of(bare) == ["drive: it has no images and no points that Rerun's reader of MCAP draws"]


def test_names_of_topics_are_those_of_entities(tmp_path: Path) -> None:
    names = {"/cam/image": "/cam 1/im-age.2", "/points": "//plain//points"}
    place = replayed(tmp_path, [replace(one, name=names.get(one.name, one.name)) for one in sensors()])
    for entity in (r"/recorded/cam\ 1/im-age.2", "/recorded/plain/points"):
        assert len(poses(place, entity)) == FRAMES


def test_a_truth_of_another_clock(tmp_path: Path) -> None:
    """Its first stamp, 5 s, was logged at the time of the first image's stamp."""
    place = replayed(tmp_path, sensors(), stamped_s=5.0)
    found = [row for row in rows(place / "replay.rrd", "/recorded/cam/image") if "EncodedImage:blob" in row]
    check_times(found, 5.0)


def test_the_run_that_results_show_is_written_anew(results: Path, tmp_path: Path) -> None:
    path, notes = write_with_recording(tmp_path, open_results(results), results.parent / "drive.mcap")
    assert (path, notes) == (tmp_path / "replay.rrd", [note.partition(": ")[2] for note in notes_of(results)])
    assert len(poses(tmp_path, "/recorded/cam/image")) == FRAMES
    for entity in ("/world/PEM/boxes", "/recorded/points"):
        assert rows(path, entity) == rows(results / "replay.rrd", entity)


def test_another_recording_is_refused(results: Path, tmp_path: Path) -> None:
    other = recorded(tmp_path / "other.mcap", [])
    line = r"other.mcap: expected a recording of .*: drive \(SHA-256 [0-9a-f]{12}…\); found SHA-256 [0-9a-f]{12}…$"
    with pytest.raises(InputError, match=line):
        cr.view(results, with_recording=other)
    with pytest.raises(RecordingError, match=r"nowhere\.mcap: cannot be opened: No such file"):
        cr.view(results, with_recording=tmp_path / "nowhere.mcap")

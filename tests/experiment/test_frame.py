"""Logs on earth: who says where they are, degrees of experiments as metres, what is refused, and GeoJSON."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
import yaml
from osi3.osi_groundtruth_pb2 import GroundTruth
from typer.testing import CliRunner

import copem_replay as cr
from copem_replay.api.study import read_study
from copem_replay.cli.main import app
from copem_replay.core.errors import InputError
from copem_replay.core.frame import Frame
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.experiment.file import read_experiment_file
from tests.helpers.recordings import Obj, Topic, truth_topic, write_mcap

LOCAL = Frame("EPSG:25832", (691_000.0, 5_334_000.0), math.radians(20))
FRAME = {"proj": "EPSG:25832", "offset_m": [691_000.0, 5_334_000.0], "yaw_deg": 20}
CARS = ((2, 70.0, 2.0), (3, 60.0, 5.0))
MAST, HOUSE = (-10.0, 30.0), [(20.0, 10.0), (26.0, 10.0), (26.0, 14.0), (20.0, 14.0)]


def degrees(*places_m: tuple[float, float]) -> list[list[float]]:
    return LOCAL.to_wgs84(places_m).tolist()


def write_drive(folder: Path, *places: tuple[str, float, float, float]) -> None:
    """Two cars drive past for three seconds; `places`: projection, offset and yaw of the messages in turn."""
    frames = [
        (0.1 * k, [Obj(id=1, x=0.0, y=-2.0), *(Obj(id=i, x=x - k, y=y, vx=-10.0) for i, x, y in CARS)])
        for k in range(31)
    ]
    messages = []
    for k, (log_ns, payload) in enumerate(truth_topic(frames, host=1).messages):
        message = GroundTruth.FromString(payload)
        if places:
            message.proj_string, x, y, yaw = places[min(k, len(places) - 1)]
            message.proj_frame_offset.position.x, message.proj_frame_offset.position.y = x, y
            message.proj_frame_offset.yaw = yaw
        messages.append((log_ns, message.SerializeToString()))
    write_mcap(folder / "drive.mcap", [Topic("truth", "osi3.GroundTruth", messages)])


SAID = ("EPSG:25832", 691_000.0, 5_334_000.0, math.radians(20))
MEASURE = {"onset": {"kind": "in_range", "range_m": 200}, "horizon_s": 2, "began": ["log_start", "crossed"]}
UNIT = {"height_m": 3, "pem": "camera"}


def experiment(folder: Path, **keys: Any) -> Path:
    data: dict[str, Any] = {
        "version": 1, "logs": ["drive.mcap"], "runs": 4,
        "pems": {"camera": [{"when": {"range_m": [0, 60], "azimuth_deg": [-90, 90]},
                             "detection": {"kind": "visible_share"},
                             "error": {"kind": "gaussian", "covariance_m2": [[1.0, 0.0], [0.0, 1.0]]}}]},
        "units": {"mast": {"at": list(MAST), "yaw_deg": -30, **UNIT}},
        "configurations": {"PEM": {"units": ["mast"]}},
        "measure": MEASURE,
        **keys,
    }  # fmt: skip
    (folder / "experiment.yaml").write_text(yaml.safe_dump(data, sort_keys=False))
    return folder / "experiment.yaml"


def replayed(path: Path, out: Path) -> cr.Results:
    """The results folder that the command writes, read back."""
    done = CliRunner().invoke(app, ["run", str(path), "--out", str(out)])
    assert done.exit_code == 0, done.output
    return cr.load_results(out)


def in_degrees(**unit: Any) -> dict[str, Any]:
    (lat, lon) = degrees(MAST)[0]
    heading = LOCAL.heading_of_yaw(-30, lat, lon)
    within = {"polygon_wgs84": degrees((-50, -50), (200, -50), (200, 50), (-50, 50))}
    return {
        "units": {"mast": {"at_wgs84": [lat, lon, heading], **UNIT, **unit}},
        "obstacles": [{"polygon_wgs84": degrees(*HOUSE), "height_m": 6}],
        "areas": {"yard": {"polygon_wgs84": degrees((0, 0), (9, 0), (9, 9))}},
        "measure": {**MEASURE, "objects": {"within": within}},
    }


def resolved(path: Path) -> cr.Experiment:
    study = read_study(read_experiment_file(path))
    return resolve_for_log(study.experiment, study.recordings[0].scene.log)


def problems(path: Path) -> list[str]:
    with pytest.raises(InputError) as refused:
        read_study(read_experiment_file(path))
    return [line.partition("experiment.yaml:")[2] for line in refused.value.problems]


def check_resolved(found: cr.Experiment) -> None:
    unit = found.units["mast"]
    assert unit.at == pytest.approx(MAST, abs=1e-6)
    assert math.cos(math.radians(unit.yaw_deg + 30)) == pytest.approx(1)
    assert np.array(found.obstacles[0].polygon_m) == pytest.approx(np.array(HOUSE), abs=1e-6)
    assert np.array(found.areas["yard"].polygon_m) == pytest.approx(np.array([(0, 0), (9, 0), (9, 9)]), abs=1e-6)
    assert found.measure.objects.within is not None
    assert np.array(found.measure.objects.within.polygon_m)[2] == pytest.approx((200, 50), abs=1e-6)


@pytest.mark.parametrize("where", ["experiment", "entry", "recording"])
def test_degrees_become_metres_of_the_log(tmp_path: Path, where: str) -> None:
    write_drive(tmp_path, *([SAID] if where == "recording" else []))
    keys = in_degrees()
    if where == "experiment":
        keys["frame"] = FRAME
    if where == "entry":
        keys["logs"] = [{"file": "drive.mcap", "frame": FRAME}]
    check_resolved(resolved(experiment(tmp_path, **keys)))


def test_a_run_in_degrees_is_that_in_metres(tmp_path: Path) -> None:
    """And what its results folder holds runs again, and gives the same."""
    write_drive(tmp_path, SAID)
    metres = replayed(experiment(tmp_path), tmp_path / "metres")
    keys = in_degrees()
    keys.pop("obstacles"), keys.pop("measure"), keys.pop("areas")
    path = experiment(tmp_path, **keys)
    in_wgs84 = replayed(path, tmp_path / "degrees")
    columns = ["configuration", "n", "detected_share", "ttd_rmst_s", "dad_median_m"]
    assert in_wgs84.summary[columns].equals(metres.summary[columns])
    replayed(tmp_path / "degrees" / "experiment.yaml", tmp_path / "again")
    assert (tmp_path / "again" / "summary.csv").read_bytes() == (tmp_path / "degrees" / "summary.csv").read_bytes()


def test_what_is_written_stays_as_it_was_written(tmp_path: Path) -> None:
    write_drive(tmp_path, SAID)
    found = read_study(read_experiment_file(experiment(tmp_path, **in_degrees()))).experiment
    assert found.units["mast"].at is None
    assert found.as_written()["units"]["mast"]["at_wgs84"][:2] == pytest.approx(degrees(MAST)[0])


def test_words_for_projections(tmp_path: Path) -> None:
    """A frame at a place has its origin there, north up."""
    write_drive(tmp_path)
    unit = {"mast": {"at_wgs84": [48.1, 11.5, 0], **UNIT}}
    found = resolved(experiment(tmp_path, units=unit, frame={"proj": {"at_wgs84": [48.1, 11.5]}}))
    assert found.units["mast"].at == pytest.approx((0, 0), abs=1e-6)
    assert found.units["mast"].yaw_deg == pytest.approx(90)
    for proj, place in (({"mgrs": "32UPU"}, [48.0, 11.0]), ({"argoverse2": "MIA"}, [25.77, -80.196])):
        offset = [round(x) for x in cr_frame(proj).from_wgs84(place)[0]]
        units = {"mast": {"at_wgs84": place, **UNIT}}
        found = resolved(experiment(tmp_path, units=units, frame={"proj": proj, "offset_m": offset}))
        assert found.units["mast"].at == pytest.approx((0, 0), abs=0.71)


def cr_frame(proj: dict[str, str]) -> Frame:
    from copem_replay.experiment.frame import FrameOfLog

    return FrameOfLog.model_validate({"proj": proj}).frame


@pytest.mark.parametrize(
    ("keys", "line"),
    [
        ({"units": {"mast": {"at_wgs84": [48.1, 11.5], **UNIT}}},
         "drive.mcap: the recording does not say where it is; write `frame: {proj: …}`"),
        ({"units": {"mast": {"at_wgs84": [11.5, 48.1], **UNIT}}, "frame": FRAME},
         "km from the log: latitude first, then longitude?"),
        ({"units": {"mast": {"at_wgs84": [148.1, 11.5], **UNIT}}},
         "expected latitude (-84 … 84) and longitude (-180 … 180) in degrees, found [148.1, 11.5]"),
        ({"units": {"mast": {"at_wgs84": [48.1, 11.5, 3], "yaw_deg": 3, **UNIT}}},
         "the heading is the third number of at_wgs84; expected one of both"),
        ({"units": {"mast": {"at_wgs84": [48.1, 11.5], "at": [1, 2], **UNIT}}}, "units.mast: expected one of"),
        ({"obstacles": [{"polygon_wgs84": [[48, 11], [48.1, 11], [48, 11.1]], "polygon_m": [[0, 0], [1, 0], [1, 1]],
                         "height_m": 2}]}, "expected one of polygon_m and polygon_wgs84, found both"),
        ({"obstacles": [{"height_m": 2}]}, "expected one of polygon_m and polygon_wgs84, found none"),
        ({"obstacles": [{"polygon_wgs84": [[48, 11], [48.1, 11.1], [48.1, 11], [48, 11.1]], "height_m": 2}]},
         "polygon_wgs84: expected the corners in order around an area"),
        ({"frame": {"proj": "EPSG:4326"}}, "frame.proj: 'EPSG:4326': expected a projection to metres east and north"),
        ({"frame": {"proj": {"mgrs": "54SUE", "argoverse2": "PIT"}}},
         "frame.proj: expected one of at_wgs84, mgrs, argoverse2, found mgrs and argoverse2"),
        ({"frame": "+proj=utm +zone=33"},
         "frame: expected keys and values such as `frame: {proj: \"+proj=utm +zone=33\"}`, found '+proj=utm +zone=33'"),
        ({"frame": 25833}, "frame: expected keys and values such as `frame: {proj: \"EPSG:25833\"}`, found 25833"),
        ({"frame": "same"}, "frame: expected keys and values such as `frame: {proj: \"EPSG:25833\"}`, found 'same'"),
        ({"frame": {"proj": {"mgrs": "54SAE"}}}, "zone 54 has columns STUVWXYZ"),
        ({"frame": {"proj": {"argoverse2": "NYC"}}}, "expected a city of Argoverse 2 (ATX, DTW, MIA, PAO, PIT, WDC)"),
        ({"frame": {"proj": "EPSG:3857", "offset_m": [1288523, 6129677]}}, "one that is 1.50 times as large there"),
    ],
)  # fmt: skip
def test_refused(tmp_path: Path, keys: dict[str, Any], line: str) -> None:
    write_drive(tmp_path)
    (found,) = problems(experiment(tmp_path, **keys))
    assert line in found


def test_a_recording_that_changes_its_place(tmp_path: Path) -> None:
    write_drive(tmp_path, SAID, SAID, ("EPSG:25833", *SAID[1:]))
    (line,) = problems(experiment(tmp_path, units={"mast": {"at_wgs84": degrees(MAST)[0], **UNIT}}))
    assert "proj_string is 'EPSG:25832' first and 'EPSG:25833' at 0.200 s: expected one of all messages" in line
    # without degrees it is only said, and an experiment that gives the frame is not asked
    (recording,) = cr.read_recordings(str(experiment(tmp_path)))
    assert [note for note in recording.notes if "expected one of all messages" in note]
    assert resolved(experiment(tmp_path, **in_degrees(), frame=FRAME)).units["mast"].at is not None


def test_two_that_disagree(tmp_path: Path) -> None:
    """The experiment is taken, and says how far away the recording's own place is: 3 m east, 4 m north."""
    write_drive(tmp_path, ("EPSG:25832", 691_003.0, 5_334_004.0, 0.0))
    frame = {**FRAME, "yaw_deg": 0}
    (recording,) = cr.read_recordings(str(experiment(tmp_path, frame=frame)))
    assert (
        "place: the recording puts the middle of the log 5 m from where frame does, which is taken" in recording.notes
    )
    assert recording.scene.frame == Frame("EPSG:25832", (691_000.0, 5_334_000.0), 0.0)


XODR = """<OpenDRIVE><header><geoReference><![CDATA[EPSG:25832]]></geoReference>{offset}</header>
<road id="7" length="200" junction="-1"><planView>
<geometry s="0" x="{x}" y="{y}" hdg="0" length="200"><line/></geometry></planView><lanes><laneSection s="0">
<right><lane id="-1" type="driving"><width sOffset="0" a="8" b="0" c="0" d="0"/></lane></right>
</laneSection></lanes></road></OpenDRIVE>"""


@pytest.mark.extras
def test_a_map_by_its_own_reference(tmp_path: Path) -> None:
    """A map in projected metres comes to the log; one with the log's metres tells where the log is."""
    write_drive(tmp_path)
    frame = {"proj": "EPSG:25832", "offset_m": [691_000, 5_334_000]}
    (tmp_path / "far.xodr").write_text(XODR.format(offset="", x=690_950, y=5_334_000))
    keys: dict[str, Any] = {"maps": [{"file": "far.xodr", "agreement": "ignore"}], "frame": frame}
    (recording,) = cr.read_recordings(str(experiment(tmp_path, **keys)))
    assert np.concatenate(recording.lane_boundaries)[0] == pytest.approx([-50, 0, 0], abs=1e-6)
    (line,) = problems(experiment(tmp_path, maps=keys["maps"]))
    assert "its places are metres of 'EPSG:25832', and the log does not say where it is" in line
    offset = '<offset x="691000" y="5334000" z="0" hdg="0"/>'
    (tmp_path / "same.xodr").write_text(XODR.format(offset=offset, x=-51, y=0))
    same = [{"file": "same.xodr", "frame": "same", "offset_m": [1, 0], "agreement": "ignore"}]
    (recording,) = cr.read_recordings(str(experiment(tmp_path, maps=same)))
    assert np.concatenate(recording.lane_boundaries)[0] == pytest.approx([-50, 0, 0], abs=1e-6)
    assert recording.scene.frame == Frame("EPSG:25832", (690_999.0, 5_334_000.0), 0.0)


def test_info_prints_the_place(tmp_path: Path) -> None:
    write_drive(tmp_path, ("EPSG:25832", 691_000.0, 5_334_000.0, 0.0))
    printed = CliRunner().invoke(app, ["info", str(tmp_path / "drive.mcap")]).output
    lat, lon = Frame("EPSG:25832", (691_000.0, 5_334_000.0)).to_wgs84(
        np.median([at for k in range(31) for at in ((0, -2), (70 - k, 2), (60 - k, 5))], axis=0)
    )[0]  # fmt: skip
    assert f"place: EPSG:25832, {lat:.5f} N {lon:.5f} E at the middle of the log" in printed
    write_drive(tmp_path, ("+proj=utm +lat_0=48 +lon_0=11", 0.0, 0.0, 0.0))
    printed = CliRunner().invoke(app, ["info", str(tmp_path / "drive.mcap")]).output
    assert "place: none ('+proj=utm +lat_0=48 +lon_0=11' names no zone of UTM" in printed
    write_drive(tmp_path)
    printed = CliRunner().invoke(app, ["info", str(tmp_path / "drive.mcap")]).output
    assert "place: none (the recording does not say where on earth it is)" in printed


@pytest.mark.extras
def test_a_map_in_degrees_beside_a_recording_with_a_place(tmp_path: Path) -> None:
    write_drive(tmp_path, SAID)
    ring = [[lon, lat] for lat, lon in degrees(*HOUSE, HOUSE[0])]
    feature = {
        "type": "Feature",
        "properties": {"building": "yes"},
        "geometry": {"type": "Polygon", "coordinates": [ring]},
    }
    (tmp_path / "site.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    (recording,) = cr.read_recordings(str(experiment(tmp_path, maps=[{"file": "site.geojson"}])))
    (solid,) = recording.scene.solids
    assert shapely.Polygon(solid.corners_m).symmetric_difference(shapely.Polygon(HOUSE)).area < 1e-4
    printed = CliRunner().invoke(app, ["info", str(tmp_path / "drive.mcap"), "--map", str(tmp_path / "site.geojson")])
    assert "1 solid; placed by what the recording says" in printed.output


@pytest.mark.extras
def test_geojson(tmp_path: Path) -> None:
    """Read back with shapely: the mast and its field, paths from onset to end, the house; rings against the clock."""
    write_drive(tmp_path, SAID)
    keys = in_degrees()
    keys.pop("measure")
    found = replayed(experiment(tmp_path, **keys), tmp_path / "out")
    done = CliRunner().invoke(app, ["export", str(tmp_path / "out"), "--geojson"])
    assert done.exit_code == 0, done.output
    again = CliRunner().invoke(app, ["export", str(tmp_path / "out"), "--geojson"])
    assert again.exit_code == 0, "an earlier export is replaced, though it could be read as a map"
    files = {path.stem: json.loads(path.read_text()) for path in (tmp_path / "out" / "geojson").iterdir()}
    assert sorted(files) == ["episodes", "site", "units"]
    point, field = files["units"]["features"]
    assert point["geometry"]["coordinates"] == pytest.approx(degrees(MAST)[0][::-1], abs=1e-9)
    heading = LOCAL.heading_of_yaw(-30, *degrees(MAST)[0])
    assert point["properties"]["heading_deg_from_true_north"] == pytest.approx(heading, abs=1e-5)
    outline = LOCAL.from_wgs84(np.array(field["geometry"]["coordinates"][0])[:, ::-1])
    assert shapely.Polygon(outline).area == pytest.approx(math.pi / 2 * 60**2, rel=1e-2)  # half a disk of 60 m
    (house,) = files["site"]["features"]
    shape = shapely.geometry.shape(house["geometry"])
    assert shape.exterior.is_ccw
    assert LOCAL.from_wgs84(np.array(shape.exterior.coords)[:, ::-1])[:, 0].max() == pytest.approx(26, abs=1e-3)
    rows = found.known.set_index("object_id")
    assert len(files["episodes"]["features"]) == len(set(rows.index))
    for feature in files["episodes"]["features"]:
        said, line = feature["properties"], np.array(feature["geometry"]["coordinates"])
        row = rows.loc[[said["object_id"]]]
        ends = LOCAL.from_wgs84(line[:, ::-1])
        first_x = {"2": 70.0, "3": 60.0}[said["object_id"]]
        assert ends[[0, -1], 0] == pytest.approx(
            [first_x - 10 * said["onset_s"], first_x - 10 * said["ended_s"]], abs=1e-3
        )
        weight = row["runs"] / row["runs"].sum()
        assert said["detected_share PEM"] == pytest.approx(weight[row["time_to_detection_s"].notna()].sum())


@pytest.mark.extras
def test_geojson_needs_a_place(tmp_path: Path) -> None:
    write_drive(tmp_path)
    replayed(experiment(tmp_path), tmp_path / "out")
    done = CliRunner().invoke(app, ["export", str(tmp_path / "out"), "--geojson"])
    assert isinstance(done.exception, InputError)
    assert (
        done.exception.problems[1] == "drive: left out: it is not known where it is on earth; write `frame: {proj: …}`"
    )
    assert not (tmp_path / "out" / "geojson").exists()

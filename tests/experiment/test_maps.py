"""Maps of an experiment: what they add to a recording, what is said of them, and what is refused."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import shapely
import yaml
from mcap.reader import make_reader
from typer.testing import CliRunner

import copem_replay as cr
from copem_replay.api.study import read_study
from copem_replay.cli.main import app
from copem_replay.core.errors import InputError
from copem_replay.core.frame import Frame, make_local_proj
from copem_replay.experiment.file import read_experiment_file
from copem_replay.experiment.maps import MapFile, add_maps
from copem_replay.io.recording import Recording
from tests.helpers.experiments import changed
from tests.helpers.recordings import Obj, Topic, ground_truth, write_mcap, write_recording
from tests.helpers.roads import add_marking, two_lanes

pytestmark = pytest.mark.extras  # maps are read by one

ROAD = """<OpenDRIVE><header/><road id="7" length="200" junction="-1"><planView>
<geometry s="0" x="-50" y="0" hdg="0" length="200"><line/></geometry></planView><lanes><laneSection s="0">
<left><lane id="1" type="driving"><width sOffset="0" a="4" b="0" c="0" d="0"/></lane></left>
<right><lane id="-1" type="driving"><width sOffset="0" a="4" b="0" c="0" d="0"/></lane></right></laneSection></lanes>
<objects><object id="1" type="building" s="80" t="14" zOffset="0" hdg="0" length="10" width="6" height="8"/>
<object id="2" type="building" s="190" t="900" zOffset="0" hdg="0" length="10" width="6" height="8"/>
<object id="3" type="crosswalk" s="100" t="0" zOffset="0" hdg="0" length="4" width="8"/></objects>
</road></OpenDRIVE>"""

HOUSE = """version: 1
logs: [drive.mcap]
runs: 4
pems:
  onboard: [{detection: {kind: visible_share}, error: {kind: gaussian, covariance_m2: [[1.0, 0.0], [0.0, 1.0]]}}]
units: {mast: {at: [-10, 30], height_m: 3, pem: onboard}}
configurations: {PEM: {units: [mast]}}
measure: {onset: {kind: in_range, range_m: 200}, distance_to: mast, horizon_s: 2, began: [log_start, crossed]}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Four cars drive west on the northern lane, 31 frames each; their map lies beside."""
    cars = [(70.0 + 10 * n, 2.0) for n in range(4)]
    frames = [
        (0.1 * k, [Obj(id=1, x=0.0, y=-2.0), *(Obj(id=2 + n, x=x - k, y=y, vx=-10.0, yaw=math.pi)
                                                for n, (x, y) in enumerate(cars))])
        for k in range(31)
    ]  # fmt: skip
    write_recording(tmp_path / "drive.mcap", frames, host=1)
    (tmp_path / "town.xodr").write_text(ROAD)
    return tmp_path


def read(folder: Path, *lines: str) -> Recording:
    (folder / "experiment.yaml").write_text(changed(*lines))
    return read_study(read_experiment_file(folder / "experiment.yaml")).recordings[0]


def test_lanes_areas_and_solids_of_a_map(folder: Path) -> None:
    recording = read(folder, "maps: [{file: town.xodr, frame: same}]")
    assert len(recording.lane_boundaries) == 4  # three borders, of which two lanes share one, and a crosswalk
    assert [(area.name, area.kind) for area in recording.scene.areas] == [("road 7 object 3", "crosswalk")]
    (solid,) = recording.scene.solids
    assert solid.corners_m == ((35, 17), (25, 17), (25, 11), (35, 11))
    assert recording.notes[-3:] == (
        "maps[0] town.xodr: agreement with the traffic 1.00: 124 of 124 states of moving vehicles are in a lane of "
        "their heading",
        "maps[0] town.xodr: 1 solid of the map may hide",
        "maps[0] town.xodr: 1 solid beyond 200 m of every object: left out",
    )


def test_a_map_is_moved_and_parts_of_it_left_out(folder: Path) -> None:
    recording = read(folder, "maps: [{file: town.xodr, frame: same, offset_m: [1, -1], lanes: false, solids: false}]")
    assert (recording.lane_boundaries, recording.scene.solids) == ((), ())
    assert recording.scene.areas[0].rings_m[0][0] == (53, 3)


@pytest.mark.parametrize(("entry", "says"), [
    ("{file: town.xodr, frame: same, offset_m: [0, -4]}", "found 0%: is the map in the frame of the log?"),
    ("{file: towm.xodr, frame: same}", "towm.xodr: no such file"),
    ("{file: town.xodr}", "its places are metres: expected `frame: same`"),
    ("{file: experiment.yaml, frame: same}", "expected a map of OpenDRIVE, Lanelet2, OpenStreetMap, Overpass, GeoJSON"),
])  # fmt: skip
def test_maps_that_are_refused(folder: Path, entry: str, says: str) -> None:
    with pytest.raises(InputError, match=says):
        read(folder, f"maps: [{entry}]")


def test_a_map_that_does_not_agree_is_taken_where_asked(folder: Path) -> None:
    recording = read(folder, "maps: [{file: town.xodr, frame: same, offset_m: [0, -4], agreement: ignore}]")
    assert "0.00: 0 of 124 states" in recording.notes[-3]


def test_a_house_of_the_map_hides(folder: Path) -> None:
    """From the mast at (−10, 30) the house at x 25 … 35, y 11 … 17 is before cars at (70, 2) and (80, 2)."""
    seen_s = []
    for solids in ("true", "false"):
        (folder / "experiment.yaml").write_text(f"{HOUSE}maps: [{{file: town.xodr, frame: same, solids: {solids}}}]\n")
        seen_s.append(cr.run(folder / "experiment.yaml").detections["detection_s"].mean())
    assert seen_s[0] > seen_s[1]


def test_results_name_the_map_from_their_folder(folder: Path) -> None:
    (folder / "experiment.yaml").write_text(changed("maps: [{file: town.xodr, frame: same}]"))
    cr.run(folder / "experiment.yaml").save(folder / "out")
    written = yaml.safe_load((folder / "out/experiment.yaml").read_text())
    assert (folder / "out" / written["maps"][0]["file"]).resolve() == folder / "town.xodr"
    shutil.rmtree(folder / "out")


def test_info_says_how_a_map_agrees_and_moves_nothing(folder: Path) -> None:
    """The map lies 3 m too far south: the middle of the lane that goes west is at y = −1, the cars are at 2."""
    (folder / "off.xodr").write_text(ROAD.replace('y="0"', 'y="-3"'))
    result = CliRunner().invoke(app, ["info", str(folder / "drive.mcap"), "--map", str(folder / "off.xodr")])
    assert result.exit_code == 0
    assert "map off.xodr: 2 lanes, 1 area, 2 solids; taken as in the frame of the log" in result.output
    assert "agreement with the traffic 0.00: 0 of 124 states" in result.output
    assert "best agreement with the map moved by [0, 3] m (east, north)" in result.output
    assert "not determined along 0°" in result.output  # a straight street: the map could lie anywhere along it


def test_info_says_that_a_map_is_elsewhere(folder: Path) -> None:
    (folder / "off.xodr").write_text(ROAD.replace('y="0"', 'y="4000"'))
    result = CliRunner().invoke(app, ["info", str(folder / "drive.mcap"), "--map", str(folder / "off.xodr")])
    assert "its middle is 4 km from the traffic's: not in the same frame" in result.output


def test_info_refuses_a_map_beside_json(folder: Path) -> None:
    result = CliRunner().invoke(app, ["info", str(folder / "drive.mcap"), "--json", "--map", str(folder / "town.xodr")])
    assert "--map: expected neither --json nor --together beside it" in str(result.exception)


GULF_OF_GUINEA = Frame(make_local_proj(0.0, 0.0))


def houses(*boxes: tuple[float, float, float, float], **properties: object) -> str:
    rings = [
        [[x / 111_319.49079327358, y / 110_574.2758215944] for x, y in shapely.box(*box).exterior.coords]
        for box in boxes
    ]
    return json.dumps({"type": "FeatureCollection", "copyright": "© the city", "features": [
        {"type": "Feature", "properties": {"building": "yes", **properties},
         "geometry": {"type": "Polygon", "coordinates": [ring]}} for ring in rings]})  # fmt: skip


def placed(folder: Path, text: str, **keys: object) -> tuple[Recording, list[str]]:
    """The recording with a map in degrees, and its problems."""
    (folder / "site.geojson").write_text(text)
    maps = [MapFile.model_validate({"file": str(folder / "site.geojson"), **keys})]
    recording, problems = add_maps(read(folder), maps, GULF_OF_GUINEA)
    return recording, [line for _, line in problems]


def test_houses_in_degrees_stand_on_the_ground_of_the_log(folder: Path) -> None:
    recording, problems = placed(folder, houses((25, 11, 35, 17), (900, 0, 910, 10)), heights_m={"building": 6})
    (solid,) = recording.scene.solids
    assert problems == []
    assert shapely.Polygon(solid.corners_m).symmetric_difference(shapely.box(25, 11, 35, 17)).area < 1e-4
    assert (solid.bottom_m, solid.height_m, solid.on_ground) == (0, 6, True)
    assert recording.notes[-4:] == (
        "maps[0] site.geojson: © the city",
        "maps[0] site.geojson: 2 × height of building not said: 6 m taken",
        "maps[0] site.geojson: 1 solid of the map may hide",
        "maps[0] site.geojson: 1 solid beyond 200 m of every object: left out",
    )


def test_what_is_beyond_changes_nothing_of_nearer_solids(folder: Path) -> None:
    near, far = (25, 11, 35, 17), (900, 0, 910, 10)
    one, two = (placed(folder, houses(*boxes))[0].scene.solids for boxes in ([near], [near, far]))
    assert one[0].corners_m == pytest.approx(np.array(two[0].corners_m), abs=1e-9)
    assert len(placed(folder, houses(near, far), within_m=2000)[0].scene.solids) == 2


def test_only_kinds_that_are_listed_hide(folder: Path) -> None:
    assert len(placed(folder, houses((25, 11, 35, 17)), solids=["building"])[0].scene.solids) == 1
    assert placed(folder, houses((25, 11, 35, 17)), solids=["hedge", "wall"])[0].scene.solids == ()


def test_no_solid_near_the_log_is_refused(folder: Path) -> None:
    problems = placed(folder, houses((25_000, 0, 25_010, 10)))[1]
    assert problems == ["site.geojson: 0 of 1 solid within 200 m of the log; nearest 24.9 km: is the frame right?"]


@pytest.mark.parametrize(
    ("x_m", "share"), [((55.0, 71.0), 0.16), ((60.0, 61.4), 0.04), ((60.0, 60.4), None)], ids=["in", "some", "few"]
)
def test_houses_that_traffic_drives_through(folder: Path, x_m: tuple[float, float], share: float | None) -> None:
    """By hand: 124 states a metre apart at y = 2 m; ends of the house lie between them."""
    box = (x_m[0] + 0.5, 0.0, x_m[1] + 0.5, 9.0)
    at_m = [70 + 10 * n - k for n in range(4) for k in range(31)]
    inside = sum(box[0] < x < box[2] for x in at_m)
    told = f"{inside} of 124 states of moving vehicles are inside a solid ({inside / 124:.0%})"
    recording, problems = placed(folder, houses(box))
    ignored = placed(folder, houses(box), agreement="ignore")[1]
    assert any(told in note for note in recording.notes) == (share is not None)
    assert (len(problems), ignored) == (int((share or 0) > 0.1), [])
    for line in problems:
        assert line.startswith("site.geojson: expected at most 10% of the states of moving vehicles inside its solids")


def test_a_map_that_the_projection_does_not_reach(folder: Path) -> None:
    far = houses((0, 0, 10, 10)).replace("[0.0, 0.0]", "[95.0, 0.0]")
    (line,) = placed(folder, far)[1]
    assert line.endswith("expected a place that this projection has, found 0.00000 N 95.00000 E")


def test_too_many_parts_are_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("copem_replay.experiment.maps._MOST_PARTS", 1)
    (line,) = placed(folder, houses((25, 11, 35, 17), (25, 21, 35, 27)))[1]
    assert line.startswith("expected solids of at most 1 convex parts, found 2: take a smaller `within_m`")


def test_degrees_need_a_place_on_earth(folder: Path) -> None:
    (folder / "site.geojson").write_text(houses((25, 11, 35, 17)))
    with pytest.raises(InputError, match="are degrees, and the log does not say where it is: expected"):
        read(folder, "maps: [{file: site.geojson}]")
    with pytest.raises(InputError, match="its places are degrees, not metres of the log: no `frame: same`"):
        read(folder, "maps: [{file: site.geojson, frame: same}]")


def test_a_mast_that_nobody_comes_near_is_noted(folder: Path) -> None:
    """The cars end at x = 40 m, y = 2 m at the nearest, and another stands at (0, −2)."""
    drive = HOUSE.replace("[-10, 30]", "[0, 248]").replace("range_m: 200", "range_m: 400")
    (folder / "experiment.yaml").write_text(drive + "maps: [{file: town.xodr, frame: same}]\n")
    notes = read_study(read_experiment_file(folder / "experiment.yaml")).recordings[0].notes
    far_m = min(math.hypot(0, 250), math.hypot(40, 246))
    assert (
        f"units.mast: {far_m:.0f} m from every object; solids of maps near it are left out (`within_m: 200`)" in notes
    )
    assert not any("units.mast" in note for note in read(folder, "maps: [{file: town.xodr, frame: same}]").notes)


def test_a_unit_in_a_house_of_the_map_is_refused(folder: Path) -> None:
    (folder / "experiment.yaml").write_text(
        HOUSE.replace("[-10, 30]", "[30, 14]") + "maps: [{file: town.xodr, frame: same}]\n"
    )
    with pytest.raises(InputError, match="road 7 object 1"):
        read_study(read_experiment_file(folder / "experiment.yaml"))


def test_lanes_and_crosswalks_that_the_recording_has(folder: Path) -> None:
    """The northern lane, on which the cars drive west, is stored towards the east: held against their headings."""
    recording = read(with_road(folder))
    assert [(lane.id, lane.kind) for lane in recording.lanes] == [("8", "driving"), ("9", "driving")]
    assert [(area.name, area.kind) for area in recording.scene.areas] == [("crosswalk 40", "crosswalk")]
    assert len(recording.lane_boundaries) == 4  # three borders and the crosswalk
    assert recording.notes[-1] == (
        "lanes of the recording: agreement with the traffic 1.00: 124 of 124 states of moving vehicles are in a lane "
        "of their heading"
    )


def test_only_objects_in_lanes_of_the_recording_and_groups_by_its_areas(folder: Path) -> None:
    """Cars are in the northern lane 60 m ahead, where two of four come to; one stands on the crosswalk at (30, 1)."""
    with_road(folder, parked=True)
    counted = {}
    for within in ("lanes: [9]", "lanes: [8]", "areas: [crosswalk]"):
        (folder / "experiment.yaml").write_text(
            changed(f"measure: {{onset: {{kind: in_range, range_m: 60}}, horizon_s: 2, by: [area], "
                    f"began: [log_start, crossed], objects: {{within: {{{within}}}}}}}")
        )  # fmt: skip
        results = cr.run(folder / "experiment.yaml")
        again = cr.run(folder / "experiment.yaml", cr.read_recordings(folder / "experiment.yaml"))
        assert again.tally.equals(results.tally)
        counted[within] = {key: set(rows["area"].fillna("")) for key, rows in results.tally.groupby("object_id")}
    assert counted == {
        "lanes: [9]": {"2": {""}, "3": {""}, "9": {"crosswalk"}},
        "lanes: [8]": {},
        "areas: [crosswalk]": {"9": {"crosswalk"}},
    }


def with_road(folder: Path, *, parked: bool = False) -> Path:
    """The drive of `folder` with two lanes of 4 m, 8 to the south and 9 to the north of y = 0, and a crosswalk."""
    road, car = two_lanes(-20, 120), ground_truth(None, [Obj(id=9, x=30.0, y=1.0)] * parked)
    add_marking(road)
    with (folder / "drive.mcap").open("rb") as file:
        found = [(message.log_time, message.data) for *_, message in make_reader(file).iter_messages()]
    first = car.SerializeToString() + road.SerializeToString()
    messages = [(log_ns, data + first * (k == 0)) for k, (log_ns, data) in enumerate(found)]
    write_mcap(folder / "drive.mcap", [Topic("truth", "osi3.GroundTruth", messages)])
    return folder

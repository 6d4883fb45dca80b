"""`copem-replay init`: whatever the recording, the experiment it writes passes `check` and runs; that of `info` too."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from osi3.osi_sensordata_pb2 import SensorData

import copem_replay as cr
from copem_replay.cli import main as cli
from copem_replay.core import yaml as plain_yaml
from copem_replay.experiment.draft.findings import Mast
from copem_replay.experiment.draft.survey import survey_recording
from copem_replay.experiment.draft.template import format_draft, quote_yaml
from copem_replay.results.compare import compare_folders
from copem_replay.results.decision import decide_compared
from tests.helpers.experiments import drive
from tests.helpers.recordings import SHARED, Obj, Topic, ns, pedestrian, truth_topic, write_mcap, write_recording

Frames = list[tuple[float, list[Obj]]]


class Ended(NamedTuple):
    code: int
    out: str
    err: list[str]


Call = Callable[..., Ended]


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Call:
    """Run a command in this process, from `tmp_path`."""
    monkeypatch.chdir(tmp_path)

    def called(*arguments: str | Path) -> Ended:
        monkeypatch.setattr(sys, "argv", ["copem-replay", *map(str, arguments)])
        capsys.readouterr()
        code = cli._run_to_exit_code()
        out, err = capsys.readouterr()
        return Ended(code, out, err.splitlines())

    return called


@pytest.fixture
def replayed(call: Call, tmp_path: Path) -> Callable[[str | Path], dict[str, Any]]:
    """Init, check and run a recording; gives the experiment as data."""

    def through(log: str | Path) -> dict[str, Any]:
        made = call("init", log)
        assert (made.code, made.err) == (0, [])
        (tmp_path / "begun.yaml").write_text(made.out, encoding="utf-8")
        checked = call("check", "begun.yaml")
        assert checked.code == 0
        run = call("run", "begun.yaml", "--runs", "2", "--jobs", "1", "--overwrite")
        assert run.code == 0, run.err
        said = [line for line in checked.err if not line.startswith("and ")]  # how many more notes there are
        assert [line for line in said if line not in run.err] == [], "check says nothing that run does not"
        data, _lines, problems = plain_yaml.parse_yaml(made.out)
        assert problems == []
        return data  # type: ignore[no-any-return]

    return through


def street(*, walkers: int = 1, seconds: int = 4, far_m: float = 0.0) -> Frames:
    """Car 1 drives at 10 m/s for the whole time, car 2 for half of it, car 3 stands; pedestrians, 7 and on, stand
    aside at one place.
    """
    frames: Frames = []
    for k in range(seconds * 10 + 1):
        t = k / 10
        objects = [
            Obj(id=1, x=10 * t, vx=10),
            Obj(id=3, x=20, y=9),
            *(pedestrian(7 + k, 30, 6 + far_m) for k in range(walkers)),
        ]
        frames.append((t, [*objects, *([Obj(id=2, x=40 - 12 * t, y=-4, vx=-12)] if t < seconds / 2 else [])]))
    return frames


def test_the_host_of_the_log_is_the_ego(tmp_path: Path, replayed: Callable[..., Any]) -> None:
    write_recording(tmp_path / "log.mcap", street(walkers=5), host=2)
    experiment = replayed("log.mcap")
    assert "ego" not in experiment
    assert experiment["logs"] == ["log.mcap"]
    assert experiment["units"]["ego"]["on"] == "ego"
    assert list(experiment["configurations"]) == ["GT", "ideal", "gnn", "alone", "late"]
    assert experiment["measure"]["objects"] == {"classes": ["vru"]}
    assert "# ego: <id>   # left out: the log names its host vehicle: 2 (car)" in format_draft(
        survey_recording("log.mcap")
    )


@pytest.mark.parametrize(("walkers", "widened"), [(1, True), (4, True), (5, False)])
def test_all_classes_are_measured_where_few_pedestrians_count(
    tmp_path: Path, replayed: Callable[..., Any], walkers: int, widened: bool
) -> None:
    write_recording(tmp_path / "log.mcap", street(walkers=walkers), host=2)
    measure = replayed("log.mcap")["measure"]
    text = format_draft(survey_recording("log.mcap"))
    said = f"# All classes are measured: of pedestrians, bicycles, motorcycles only {walkers} would count."
    back = "  # objects: {classes: [vru]}   # pedestrians, bicycles, motorcycles alone"
    assert (text.splitlines()[1] == said, back in text, "objects" not in measure) == (widened,) * 3


def test_the_lines_behind_a_comment_measure_pedestrians_alone(tmp_path: Path, replayed: Callable[..., Any]) -> None:
    """Six cars cross, two pedestrians are there at the start, and count with the second line."""
    frames: Frames = []
    for k in range(41):
        cars = [Obj(id=2 + c, x=60.0 + 8 * c - 2 * k, y=4.0, vx=-20) for c in range(6)]
        frames.append((k / 10, [Obj(id=1, x=float(k), vx=10), *cars, pedestrian(20, 30, 6), pedestrian(21, 32, 6)]))
    write_recording(tmp_path / "log.mcap", frames, host=1)
    assert {"objects", "began"}.isdisjoint(replayed("log.mcap")["measure"])
    text = format_draft(survey_recording("log.mcap"))
    alone = text.replace("  # objects: {classes: [vru]}", "  objects: {classes: [vru]}")
    alone = alone.replace("  # began: [log_start, crossed, appeared]", "  began: [log_start, crossed, appeared]")
    counted = []
    for name, asked in (("all.yaml", text), ("alone.yaml", alone)):
        Path(name).write_text(asked, encoding="utf-8")
        counted.append(set(cr.run(name).known["object_id"]))
    assert counted == [{"2", "3", "4", "5", "6", "7"}, {"20", "21"}]


@pytest.mark.parametrize(("rate_hz", "line"), [(10.0, None), (2.0, "max_gap_s: 0.8 "), (1.0, "max_gap_s: 1.5 ")])
def test_the_longest_gap_is_that_of_the_recording(
    tmp_path: Path, replayed: Callable[..., Any], rate_hz: float, line: str | None
) -> None:
    """Half a list to spare: of lists every 0.5 s a gap of 0.75 s, to whole tenths of a second."""
    frames = [(t / rate_hz, [Obj(1, 6.0 * t / rate_hz, 0.0), pedestrian(7, 30.0, 3.0)]) for t in range(12)]
    made = replayed(write_recording(tmp_path / "a.mcap", frames, host=1))
    assert made.get("max_gap_s") == (None if line is None else float(line.split()[1]))


def test_the_mast_stands_beside_whom_it_looks_at(tmp_path: Path) -> None:
    """Pedestrian 7 is at (30, 6), all drive along y = 0 and −4: 10 m to his north-east nobody else is nearer."""
    write_recording(tmp_path / "log.mcap", street(walkers=5), host=1)
    (truth,) = survey_recording(tmp_path / "log.mcap").truth
    first, second = truth.suggested.masts
    assert first == Mast(at=[37.1, 13.1], yaw_deg=-135)
    assert second == Mast(at=[22.9, -1.1], yaw_deg=45)


def test_without_a_host_whoever_drives_longest_and_it_is_said(tmp_path: Path, replayed: Callable[..., Any]) -> None:
    """Car 3 is there as long as car 1, but stands."""
    write_recording(tmp_path / "log.mcap", street())
    assert replayed("log.mcap")["ego"] == 1
    lines = format_draft(survey_recording("log.mcap")).splitlines()
    at = next(k for k, line in enumerate(lines) if line.startswith("ego: "))
    assert lines[at - 1 : at + 2] == [
        "# the log names no host vehicle; of the vehicles that drive, 1 (car) is there longest, 0.0 – 4.0 s",
        "ego: 1   # a guess; none: no ego, a mast judged by itself",
        "# ego: <id>   # of 1 (car), 3 (car), 2 (car), 7 (pedestrian)",
    ]


def test_a_host_that_is_nobody(tmp_path: Path, replayed: Callable[..., Any]) -> None:
    write_recording(tmp_path / "log.mcap", street(), host=9)
    assert replayed("log.mcap")["ego"] == 1
    assert "# the log's host vehicle 9 is no moving object; of the" in format_draft(survey_recording("log.mcap"))


def test_the_only_one_that_moves_is_measured_not_the_ego(tmp_path: Path, replayed: Callable[..., Any]) -> None:
    write_recording(tmp_path / "log.mcap", [(k / 10, [Obj(id=1, x=k, vx=10)]) for k in range(30)])
    experiment = replayed("log.mcap")
    assert experiment["ego"] == "none"
    assert list(experiment["units"]) == ["roadside", "across"]
    assert experiment["measure"]["distance_to"] == "roadside"
    assert experiment["measure"]["objects"] == {"classes": ["vehicles"]}


@pytest.mark.parametrize(("last_s", "ego"), [(4.4, "none"), (4.6, 1)])
def test_a_roadside_unit_has_no_ego(tmp_path: Path, replayed: Callable[..., Any], last_s: float, ego: Any) -> None:
    """Cars come by, each for two of six seconds; car 1 for three quarters of them, or for a little less."""
    frames: Frames = []
    for k in range(61):
        t = k / 10
        there = [Obj(id=n, x=12 * (t - 2 * n), y=4.0 * n, vx=12) for n in (2, 3, 4) if 0 <= t - 2 * (n - 2) <= 2]
        frames.append((t, [pedestrian(7, 30, 6), *there, *([Obj(id=1, x=9 * t, vx=9)] if t <= last_s else [])]))
    write_recording(tmp_path / "log.mcap", frames)
    assert replayed("log.mcap")["ego"] == ego
    text = format_draft(survey_recording("log.mcap"))
    assert ("1 (car) is there longest, 0.0 – 4.4 s of 6.0 s, and an ego is there nearly" in text) == (ego == "none")
    assert "# ego: <id>   # of 2 (car), 1 (car), 3 (car), 4 (car), 7 (pedestrian)" in text


def test_no_vehicle_no_ego(tmp_path: Path, replayed: Callable[..., Any]) -> None:
    frames = [(k / 10, [pedestrian(7, k / 10), pedestrian(8, 5)]) for k in range(30)]
    write_recording(tmp_path / "log.mcap", frames)
    assert replayed("log.mcap")["ego"] == "none"


def test_nobody_near_is_measured_when_he_appears(tmp_path: Path, replayed: Callable[..., Any]) -> None:
    frames = [(t, [o for o in objects if o.id in (1, 7)]) for t, objects in street(far_m=500)]
    write_recording(tmp_path / "log.mcap", frames, host=1)
    assert replayed("log.mcap")["measure"]["onset"] == {"kind": "appears"}


def test_vehicles_where_no_pedestrian_comes_near(tmp_path: Path, replayed: Callable[..., Any]) -> None:
    write_recording(tmp_path / "log.mcap", street(far_m=500), host=1)
    assert replayed("log.mcap")["measure"]["objects"] == {"classes": ["vehicles"]}


@pytest.mark.parametrize(
    "frames",
    [
        [(0.0, [Obj(id=1)])],
        [(k / 10, [Obj(id=1, x=k)]) for k in range(9)],
        [(k / 10, [Obj(id=1, x=k), Obj(id=2, x=3, stationary=True)]) for k in range(9)],
    ],
    ids=["one frame", "only the ego", "nothing else moves"],
)
@pytest.mark.parametrize("host", [1, None])
def test_nothing_to_measure_runs_all_the_same(
    tmp_path: Path, replayed: Callable[..., Any], frames: Frames, host: int | None
) -> None:
    write_recording(tmp_path / "log.mcap", frames, host=host)
    replayed("log.mcap")
    said = "# No object counts: beside the ego nothing moves for two frames or more." in format_draft(
        survey_recording("log.mcap")
    )
    assert said == (host == 1 or len(frames) == 1), "without a host the only one that moves is measured"


def test_of_several_truths_the_fullest_and_the_others_are_named(tmp_path: Path, replayed: Callable[..., Any]) -> None:
    write_recording(tmp_path / "log.mcap", street()[:3], host=1, more=[truth_topic(street(), name="full", host=1)])
    assert replayed("log.mcap")["read"] == {"topic": "full"}
    assert "# read: {topic: truth}   # could be it, too" in format_draft(survey_recording("log.mcap"))


def unit(name: str, *, covariance: bool = False, captured: bool = False, velocity: bool = False) -> Topic:
    """Pedestrian 7 as a unit lists him, ten times a second."""
    messages = []
    for k in range(41):
        data = SensorData()
        data.timestamp.seconds, data.timestamp.nanos = divmod(ns(k / 10), 10**9)
        if captured:
            data.last_measurement_time.CopyFrom(data.timestamp)
        item = data.moving_object.add()
        item.header.tracking_id.value = 1
        item.base.position.x, item.base.position.y = 30.2, 6.1
        item.base.dimension.length = item.base.dimension.width = 0.6
        if velocity:
            item.base.velocity.x = item.base.velocity.y = 0.0
        if covariance:
            item.base_rmse.position.x = item.base_rmse.position.y = 0.3
        messages.append((ns(k / 10), data.SerializeToString()))
    return Topic(name, "osi3.SensorData", messages)


def test_lists_of_the_log_become_units(tmp_path: Path, replayed: Callable[..., Any]) -> None:
    """Named by what their topics say; what their messages don't say is to be filled in; what cannot be read is said."""
    more = [
        unit("mcity.RSU.SensorData"),
        unit("/obu/front objects", covariance=True, captured=True),
        unit("ego/objects", covariance=True, captured=True),
        Topic("broken", "osi3.SensorData", [(0, b"\xff\xff")]),
        Topic("silent", "osi3.SensorData", []),
    ]
    write_recording(tmp_path / "log.mcap", street(), host=1, more=more)
    experiment = replayed("log.mcap")
    recorded = {name: u["recorded"] for name, u in experiment["units"].items() if "recorded" in u}
    assert recorded == {
        "rsu": {"topic": "mcity.RSU.SensorData", "delay_s": 0.0, "covariance_m2": [[0.5, 0.0], [0.0, 0.5]]},
        "front": {"topic": "/obu/front objects"},
        "ego_recorded": {"topic": "ego/objects"},
    }
    assert list(experiment["units"]) == list(recorded), "no modelled ego or mast beside what is recorded"
    units = {name: made["units"] for name, made in experiment["configurations"].items() if name != "GT"}
    every = ["rsu", "front", "ego_recorded"]
    assert units == {
        "ideal": every, "gnn": every, "alone": ["ego_recorded"], "rsu": ["rsu"], "front": ["front"],
        "recorded": ["rsu", "front"], "late": every,
    }  # fmt: skip
    draft = format_draft(survey_recording("log.mcap"))
    assert "  # broken cannot be a unit: " in draft
    assert draft.count("    # at: [35.0, 5.0]   # where is it? ") == 3, "of each recorded unit"


def test_a_recorded_roadside_unit_is_asked_as_it_is(tmp_path: Path, replayed: Callable[..., Any]) -> None:
    """A car alone swings 70 m to both sides of the unit, which lists around (35, 5): within 40 m around 10, 30, 50 and
    70 s, and away for 12 s in between. It counts four times, from the unit, which is held against its own ideal.
    """
    frames = [(k / 5, [Obj(id=1, x=35 + 70 * np.cos(np.pi * k / 100), y=5.0)]) for k in range(401)]
    write_recording(tmp_path / "log.mcap", frames, more=[unit("mcity.RSU.SensorData")])
    experiment = replayed("log.mcap")
    assert {name: made["at"] for name, made in experiment["units"].items()} == {"rsu": [35.0, 5.0]}
    units = {name: made["units"] for name, made in experiment["configurations"].items()}
    assert units == {"GT": "truth", "ideal": ["rsu"], "rsu": ["rsu"], "late": ["rsu"]}
    measure = experiment["measure"]
    assert measure["distance_to"] == "rsu"
    assert measure["onset"] == {"kind": "in_range", "range_m": 40, "again_after_s": 10}
    assert "left out: these (4 crossed, 0 appeared, 0 log_start)" in format_draft(survey_recording("log.mcap"))
    known = cr.load_results("out/begun").known
    assert known[(known["configuration"] == "rsu") & (known["run"] == 0)]["began"].tolist() == ["crossed"] * 4


@pytest.mark.parametrize(("away_m", "onset"), [(30, 40), (60, 80), (100, 160), (170, None)])
def test_the_radius_is_the_first_at_which_anything_counts(
    tmp_path: Path, replayed: Callable[..., Any], away_m: float, onset: float | None
) -> None:
    """A pedestrian follows the ego at a distance; in the last frame alone he is at 5 m, from which nothing follows."""
    frames = [(k / 10, [Obj(id=1, x=k, vx=10), pedestrian(7, k + away_m if k < 20 else 25)]) for k in range(21)]
    write_recording(tmp_path / "log.mcap", frames, host=1)
    expected = {"kind": "appears"} if onset is None else {"kind": "in_range", "range_m": onset}
    assert replayed("log.mcap")["measure"]["onset"] == expected
    assert len(set(cr.load_results("out/begun").known["object_id"])) == 1


def test_topics_without_a_name(tmp_path: Path, replayed: Callable[..., Any]) -> None:
    """Of a unit's lists, of one of two truths, of the poses of an ego."""
    write_recording(tmp_path / "unit.mcap", street(), more=[unit("")])
    recorded = [unit["recorded"]["topic"] for unit in replayed("unit.mcap")["units"].values() if "recorded" in unit]
    assert recorded == [""]
    write_mcap(tmp_path / "truths.mcap", [truth_topic(street(), name=""), truth_topic(street()[:3], name="b")])
    assert replayed("truths.mcap")["read"]["topic"] == ""
    write_recording(tmp_path / "ego.mcap", street(), more=[poses("")])
    assert replayed("ego.mcap")["ego"]["topic"] == ""


def test_what_a_stack_made_of_lists_is_no_unit_beside_them(tmp_path: Path, replayed: Callable[..., Any]) -> None:
    output = unit("/fusion/objects", covariance=True, captured=True)
    write_recording(tmp_path / "log.mcap", street(), host=1, more=[unit("rsu"), output])
    experiment = replayed("log.mcap")
    assert list(experiment["units"]) == ["ego", "rsu"]
    assert experiment["configurations"]["fusion"] == {"recorded": {"topic": "/fusion/objects"}, "inputs": ["rsu"]}
    write_recording(tmp_path / "log.mcap", street(), host=1, more=[output])  # of nothing else: who knows
    assert replayed("log.mcap")["units"]["fusion"] == {"recorded": {"topic": "/fusion/objects"}}


# What other writers have, as JSON: no definition is needed to write it


def scene_update(name: str, frame: str = "map", *, classes: bool = True) -> Topic:
    """Pedestrian 7 stands at (30, 6), car 2 comes along y = −4."""
    messages = []
    for k in range(41):
        entities = [
            _entity("7", k, frame, "pedestrian" if classes else None, (30, 6, 0.9), (0.6, 0.6, 1.8)),
            _entity("2", k, frame, "car" if classes else None, (40 - 0.8 * k, -4, 0.75), (4.5, 1.8, 1.5)),
        ]
        messages.append((ns(k / 10), json.dumps({"entities": entities}).encode()))
    return Topic(name, "foxglove.SceneUpdate", messages, "json")


def _stamp(k: int) -> dict[str, int]:
    return {"sec": k // 10, "nsec": k % 10 * 10**8}


def _xyz(values: tuple[float, ...]) -> dict[str, float]:
    return dict(zip("xyz", values, strict=True))


_UPRIGHT = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}


def _entity(
    name: str, k: int, frame: str, kind: str | None, at: tuple[float, ...], size: tuple[float, ...]
) -> dict[str, Any]:
    cube = {"pose": {"position": _xyz(at), "orientation": _UPRIGHT}, "size": _xyz(size)}
    metadata = [{"key": "class", "value": kind}] if kind else []
    return {"id": name, "timestamp": _stamp(k), "frame_id": frame, "metadata": metadata, "cubes": [cube]}


def poses(name: str) -> Topic:
    """Along x at 10 m/s."""
    messages = []
    for k in range(41):
        pose = {"position": _xyz((float(k), 0.0, 0.0)), "orientation": _UPRIGHT}
        messages.append((ns(k / 10), json.dumps({"timestamp": _stamp(k), "frame_id": "map", "pose": pose}).encode()))
    return Topic(name, "foxglove.PoseInFrame", messages, "json")


def transforms(name: str, *children: str) -> Topic:
    messages = []
    for k in range(41):
        for child in children:
            said = {"timestamp": _stamp(k), "parent_frame_id": "map", "child_frame_id": child}
            said |= {"translation": _xyz((float(k), 0.0, 0.0)), "rotation": _UPRIGHT}
            messages.append((ns(k / 10), json.dumps(said).encode()))
    return Topic(name, "foxglove.FrameTransform", messages, "json")


def test_poses_may_be_the_egos(tmp_path: Path, replayed: Callable[..., Any], call: Call) -> None:
    write_mcap(tmp_path / "log.mcap", [scene_update("/objects"), poses("/pose")])
    experiment = replayed("log.mcap")
    assert experiment["ego"] == {"topic": "/pose"}
    assert "objects" not in experiment["measure"], "all, for there is one pedestrian"
    text = format_draft(survey_recording("log.mcap"))
    assert "ego:   # the log names no host vehicle; these poses may be the ego's\n  topic: /pose\n  # size_m: " in text
    shown = call("info", "log.mcap").out
    assert "the truth\n" in shown
    assert "poses, of the ego it seems\n" in shown
    assert "; or `ego: {topic: /pose}` (poses are on /pose)" in shown


def test_transforms_by_the_frame_of_the_vehicle(tmp_path: Path, replayed: Callable[..., Any]) -> None:
    write_mcap(tmp_path / "log.mcap", [scene_update("/objects"), transforms("/tf", "lidar", "base_link")])
    assert replayed("log.mcap")["ego"] == {"topic": "/tf", "frame": "base_link"}


def test_transforms_of_nothing_known_leave_the_ego_to_the_objects(tmp_path: Path, replayed: Callable[..., Any]) -> None:
    write_mcap(tmp_path / "log.mcap", [scene_update("/objects"), transforms("/tf", "lidar", "camera")])
    assert replayed("log.mcap")["ego"] == 2


def test_one_of_two_scenes(tmp_path: Path, replayed: Callable[..., Any], call: Call) -> None:
    """Either may be the truth; the other one's lists can be a unit's then."""
    write_mcap(tmp_path / "log.mcap", [scene_update("/a"), scene_update("/b"), poses("/pose")])
    assert replayed("log.mcap")["read"] == {"topic": "/a"}
    assert call("info", "log.mcap").out.count("may be the truth: `read: {topic: …}`") == 2


def test_lists_beside_the_truth_of_another_format(tmp_path: Path, replayed: Callable[..., Any]) -> None:
    write_recording(tmp_path / "log.mcap", street(), host=1, more=[scene_update("/radar/objects")])
    experiment = replayed("log.mcap")
    assert experiment["units"]["radar"]["recorded"]["topic"] == "/radar/objects"


def test_own_results_are_no_units(tmp_path: Path, call: Call, replayed: Callable[..., Any]) -> None:
    drive(tmp_path / "drive.mcap")
    (tmp_path / "e.yaml").write_text(call("init", "drive.mcap").out, encoding="utf-8")
    assert call("run", "e.yaml", "--runs", "2", "--jobs", "1").code == 0
    assert list(replayed("out/e/replay.mcap")["units"]) == ["ego", "roadside"]


@pytest.mark.parametrize(
    "name", ["a b.mcap", "q\"'s\\.mcap", "[x]*.mcap", "ünd: #1.mcap", "2.5", "new\nline.mcap", "null"]
)
def test_file_names_of_any_kind(tmp_path: Path, replayed: Callable[..., Any], name: str) -> None:
    drive(tmp_path / name)
    assert replayed(name)["logs"] == [name]


@pytest.mark.parametrize("name", ["a b", "q\"'s", "{x}, [y]", "ünd: #1", "2.5", "new\nline", "null", "-"])
def test_topics_of_any_kind(tmp_path: Path, replayed: Callable[..., Any], name: str) -> None:
    more = [truth_topic(street()[:2], name="other"), unit(f"{name}/unit")]
    write_recording(tmp_path / "log.mcap", street(), topic=name, host=1, more=more)
    assert replayed("log.mcap")["read"] == {"topic": name}


def test_paths_are_as_given(tmp_path: Path, replayed: Callable[..., Any]) -> None:
    drive(tmp_path / "sub" / "drive.mcap")
    for log in ("sub/drive.mcap", "sub/../sub/drive.mcap", str(tmp_path / "sub" / "drive.mcap")):
        assert replayed(log)["logs"] == [log]


def test_a_damaged_log_as_far_as_it_goes(tmp_path: Path, replayed: Callable[..., Any]) -> None:
    write_recording(tmp_path / "log.mcap", street(), host=1, chunk_size=1, finish=False)
    replayed("log.mcap")


def test_what_cannot_be_replayed_is_one_line(tmp_path: Path, call: Call) -> None:
    (tmp_path / "empty.mcap").touch()
    write_mcap(tmp_path / "poses.mcap", [poses("/pose")])
    write_recording(tmp_path / "nothing.mcap", [(0.0, [])])
    (tmp_path / "e.yaml").write_text("version: 1\n")
    for name in ("none.mcap", "empty.mcap", "poses.mcap", "nothing.mcap", "e.yaml", "."):
        ended = call("init", name)
        assert (ended.code, ended.out) == (2, "")
        (line,) = ended.err
        assert line.startswith(f"{name}: ")
        shown = call("info", name)
        assert shown.code == 2
        assert "experiment" not in shown.out


def test_usage(call: Call, tmp_path: Path) -> None:
    drive(tmp_path / "drive.mcap")
    ended = call("init")
    assert (ended.code, ended.out) == (2, "")
    assert "Missing argument 'LOG'." in ended.err[0]
    assert call("init", "--help").out.startswith("Usage: copem-replay init ")
    assert call("init", "drive.mcap").out == call("init", "drive.mcap").out


# ------------------------------------------------------------------------------------------- several drives at once

Drafts = Callable[..., dict[str, Any]]


@pytest.fixture
def replayed_together(call: Call, tmp_path: Path) -> Drafts:
    """Init, check, run and compare recordings of a drive each; gives the experiment as data."""

    def through(*logs: str) -> dict[str, Any]:
        made = call("init", *logs)
        assert (made.code, made.err) == (0, [])
        (tmp_path / "begun.yaml").write_text(made.out, encoding="utf-8")
        assert call("check", "begun.yaml").code == 0
        run = call("run", "begun.yaml", "--runs", "2", "--jobs", "1", "--overwrite")
        assert run.code == 0, run.err
        assert call("compare", "out/begun").code == 0
        data, _lines, problems = plain_yaml.parse_yaml(made.out)
        assert problems == []
        return data  # type: ignore[no-any-return]

    return through


def passing() -> Frames:
    """Cars 2, 3 and 4 come by, each for two of six seconds: nobody is there long enough to be an ego."""
    return [
        (t, [Obj(id=n, x=12 * (t - 2 * n), y=4.0 * n, vx=12) for n in (2, 3, 4) if 0 <= t - 2 * (n - 2) <= 2])
        for t in (k / 10 for k in range(61))
    ]


def test_several_drives_have_each_its_ego_and_mast(tmp_path: Path, replayed_together: Drafts) -> None:
    write_recording(tmp_path / "host.mcap", street(walkers=5), host=2)
    moved = [(t, [Obj(**vars(o) | {"x": o.x + 1000}) for o in objects]) for t, objects in street(walkers=5)]
    write_recording(tmp_path / "guess.mcap", moved)
    draft = replayed_together("host.mcap", "guess.mcap")
    # As the single drafts: the mast 10 m to the north-east of the pedestrian at (30, 6), or 1 km farther east.
    first, second = draft["logs"]
    assert first == {"file": "host.mcap", "units": {"roadside": {"at": [37.1, 13.1], "yaw_deg": -135}}}
    assert second == {
        "file": "guess.mcap", "ego": 1, "units": {"roadside": {"at": [1037.1, 13.1], "yaw_deg": -135}},
    }  # fmt: skip
    assert "ego" not in draft
    assert draft["units"]["roadside"]["at"] == [37.1, 13.1]


def test_a_drive_without_ego_beside_one_that_has_one(tmp_path: Path, replayed_together: Drafts) -> None:
    write_recording(tmp_path / "street.mcap", street(), host=1)
    write_recording(tmp_path / "site.mcap", passing())
    draft = replayed_together("street.mcap", "site.mcap")
    street_log, site = draft["logs"]
    assert "ego" not in street_log
    assert (site["ego"], site["units"]["ego"], street_log["units"]["across"]) == ("none", None, None)
    assert list(draft["units"]) == ["ego", "roadside", "across"]
    assert "distance_to" not in draft["measure"]
    assert site["measure"] == {"objects": {"classes": ["vehicles"]}, "distance_to": "roadside"}
    assert "objects" not in draft["measure"], "of the street all classes, as there is one pedestrian"
    assert "driver" in draft["braking"], "of the street's ego"
    assert draft["links"]["radio"]["reception"]["kind"] == "constant"  # without an ego no distance to it is known


def test_what_the_draft_of_one_log_counts_counts_in_the_study(tmp_path: Path, call: Call) -> None:
    """The street has five pedestrians and an ego; the site three cars, no ego and a recorded unit. Hours of driving are
    the street's.
    """
    write_recording(tmp_path / "street.mcap", street(walkers=5), host=1)
    write_recording(tmp_path / "site.mcap", passing(), more=[unit("rsu", velocity=True)])
    found = []
    for logs in (("street.mcap",), ("site.mcap",), ("street.mcap", "site.mcap")):
        (tmp_path / "e.yaml").write_text(call("init", *logs).out.replace("runs: 20", "runs: 1"))
        found.append(cr.run("e.yaml"))
    counted = [set(zip(results.known["log"], results.known["object_id"], strict=True)) for results in found]
    assert counted[0] == {("street", str(k)) for k in range(7, 12)}
    assert counted[1] == {("site", str(k)) for k in (2, 3, 4)}
    assert counted[2] == counted[0] | counted[1]
    both = found[2].known.groupby("configuration")["log"].agg(set).to_dict()
    everywhere = {"street", "site"}
    assert both == {
        "GT": everywhere, "ideal": everywhere, "gnn": everywhere, "alone": {"street"}, "rsu": {"site"},
        "late": everywhere,
    }  # fmt: skip
    of_study, of_street = (found[k].summary.set_index("configuration").loc["ideal"] for k in (2, 0))
    assert of_study["driving_h"] == of_street["driving_h"]
    apart = compare_folders([found[2]], configurations=["alone", "rsu"], baseline="alone")
    assert decide_compared(apart).sentence == "There is no answer: no log has both alone and another configuration."


def test_drives_without_an_ego_have_two_masts_each(tmp_path: Path, replayed_together: Drafts) -> None:
    for name in ("a.mcap", "b.mcap"):
        write_recording(tmp_path / name, passing())
    draft = replayed_together("a.mcap", "b.mcap")
    assert [list(log["units"]) for log in draft["logs"]] == [["roadside", "across"]] * 2
    assert [log["ego"] for log in draft["logs"]] == ["none", "none"]
    assert "measure" not in draft["logs"][0]
    assert draft["measure"]["distance_to"] == "roadside"


def test_units_that_only_some_drives_have(tmp_path: Path, replayed_together: Drafts) -> None:
    """Both have lists on `radar`, one has them on `lidar`, too; a stack's output that one lacks is a unit."""
    lists = [unit("radar/objects"), unit("lidar/objects"), unit("fusion/objects")]
    write_recording(tmp_path / "a.mcap", street(), host=1, more=lists[:1])
    write_recording(tmp_path / "b.mcap", street(), host=1, more=lists)
    draft = replayed_together("a.mcap", "b.mcap")
    assert [name for name, made in draft["units"].items() if "recorded" in made] == ["radar", "lidar", "fusion"]
    assert [log.get("units") for log in draft["logs"]] == [{"lidar": None, "fusion": None}, None]
    assert draft["configurations"]["recorded"]["units"] == ["radar", "lidar", "fusion"]
    both = replayed_together("b.mcap", "a.mcap")
    assert [log.get("units") for log in both["logs"]] == [None, {"lidar": None, "fusion": None}]


def test_drives_of_different_formats(tmp_path: Path, replayed_together: Drafts) -> None:
    write_recording(tmp_path / "osi.mcap", street(), host=1)
    write_mcap(tmp_path / "scene.mcap", [scene_update("/a"), scene_update("/b"), poses("/pose")])
    first, second = replayed_together("osi.mcap", "scene.mcap")["logs"]
    assert "read" not in first
    assert second["read"] == {"topic": "/a"}
    assert second["ego"] == {"topic": "/pose"}


def test_drives_of_one_name_in_two_folders(tmp_path: Path, replayed_together: Drafts, call: Call) -> None:
    for folder in ("monday", "tuesday"):
        (tmp_path / folder).mkdir()
        write_recording(tmp_path / folder / "drive.mcap", street(), host=1)
    replayed_together("monday/drive.mcap", "tuesday/drive.mcap")
    assert call("check", "begun.yaml").out.endswith("no problem found; logs: monday/drive, tuesday/drive\n")


def test_a_recording_given_twice(tmp_path: Path, call: Call) -> None:
    drive(tmp_path / "drive.mcap")
    (tmp_path / "link.mcap").symlink_to("drive.mcap")
    twice = "expected each recording once, found it twice"
    for other, said in (("drive.mcap", ""), ("./link.mcap", ", as drive.mcap, too")):
        ended = call("init", "drive.mcap", other)
        assert (ended.code, ended.out) == (2, "")
        assert ended.err == [f"{Path(other)}: {twice}{said}"]


def test_of_several_every_one_that_cannot_be_read_is_said_and_nothing_is_written(tmp_path: Path, call: Call) -> None:
    drive(tmp_path / "drive.mcap")
    (tmp_path / "empty.mcap").touch()
    write_mcap(tmp_path / "poses.mcap", [poses("/pose")])
    ended = call("init", "drive.mcap", "none.mcap", "empty.mcap", "poses.mcap")
    assert (ended.code, ended.out) == (2, "")
    assert [line.split(":")[0] for line in ended.err] == ["none.mcap", "empty.mcap", "poses.mcap"]
    assert ended.err[0] == "none.mcap: no such file"


# ----------------------------------------------------------------------------------- what stands there as a comment

EXAMPLES = ("memory", "ghosts", "placed", "clock", "sends", "radio", "window_s", "others", "mast")


def uncommented(text: str) -> list[tuple[str, str]]:
    """The draft once for each example in a comment, with that line alone made a key."""
    lines = text.splitlines()
    found = []
    for k, line in enumerate(lines):
        name = line.lstrip().removeprefix("# ").partition(":")[0]
        if line.lstrip().startswith("# ") and name in EXAMPLES:
            one = line.replace("# ", "", 1)
            found.append((name, "\n".join([*lines[:k], one, *lines[k + 1 :]]) + "\n"))
    return found


def check_each_alone(call: Call, tmp_path: Path, *logs: str | Path) -> list[str]:
    """Check the draft with each example; the names of these."""
    made = call("init", *logs)
    assert made.code == 0
    plain, _, _ = plain_yaml.parse_yaml(made.out)
    names = []
    for name, text in uncommented(made.out):
        changed, _, problems = plain_yaml.parse_yaml(text)
        assert problems == []
        assert changed != plain, name
        (tmp_path / "e.yaml").write_text(text, encoding="utf-8")
        checked = call("check", "e.yaml")
        assert (checked.code, "\ne.yaml: no problem found;" in checked.out) == (0, True), (name, checked.err)
        assert not [line for line in checked.err if "no list of" in line], name
        names.append(name)
    return names


def test_every_example_in_a_comment_holds_as_it_stands(tmp_path: Path, call: Call) -> None:
    write_recording(tmp_path / "ego.mcap", street(), host=1)
    write_recording(tmp_path / "site.mcap", passing())
    of_pem, of_unit = ["memory", "ghosts"], ["placed", "clock", "sends"]
    ego = ["window_s", *of_pem, *of_pem, *of_unit, "others", "radio"]
    assert check_each_alone(call, tmp_path, "ego.mcap") == ego
    assert check_each_alone(call, tmp_path, "site.mcap") == ["window_s", *of_pem, *of_unit, *of_unit, "radio"]
    assert check_each_alone(call, tmp_path, "ego.mcap", "site.mcap") == ["window_s", *ego[:-2], *of_unit, *ego[-2:]]
    write_recording(tmp_path / "unit.mcap", passing(), more=[unit("rsu")])
    assert check_each_alone(call, tmp_path, "unit.mcap") == ["window_s", *of_pem, "mast", "radio"]


OF_EACH_SOURCE = {path.stem.split("_")[0]: path for path in sorted(SHARED.glob("*.mcap"), reverse=True)}


@pytest.mark.long
@pytest.mark.parametrize("path", OF_EACH_SOURCE.values() or [None], ids=lambda p: p.stem if p else "absent")
def test_every_example_holds_on_real_recordings(tmp_path: Path, call: Call, path: Path | None) -> None:
    if path is None:
        pytest.skip(f"{SHARED} has no recordings")
    of_mast = {"mast"} if survey_recording(path).truth[0].units else {"placed", "clock", "sends"}
    assert set(check_each_alone(call, tmp_path, path)) >= {"memory", "ghosts", "radio", "window_s", *of_mast}


def test_the_first_configuration_beside_the_ideal_is_a_real_fusion(
    tmp_path: Path, replayed: Callable[..., Any]
) -> None:
    """With ghosts it shows some, which the ideal does not."""
    write_recording(tmp_path / "log.mcap", street(), host=1)
    configurations = replayed("log.mcap")["configurations"]
    assert [configurations[name]["fusion"]["kind"] for name in list(configurations)[1:3]] == ["ideal", "gnn"]
    assert configurations["ideal"]["units"] == configurations["gnn"]["units"] == ["ego", "roadside"]


@given(st.text(st.characters(exclude_categories=["Cs"])))
def test_quoted_text_reads_as_the_same_text(text: str) -> None:
    data, _lines, problems = plain_yaml.parse_yaml(f"a: [{quote_yaml(text)}]\nb: {quote_yaml(text)}   # c\n")
    assert problems == []
    for value in (data["a"][0], data["b"]):
        assert (value if isinstance(value, str) else str(value)) == text


@pytest.mark.long
@pytest.mark.parametrize("path", sorted(SHARED.glob("*.mcap")) or [None], ids=lambda p: p.stem if p else "absent")
def test_real_recordings(replayed: Callable[..., Any], path: Path | None) -> None:
    if path is None:
        pytest.skip(f"{SHARED} is not there")
    found = survey_recording(path)
    place = np.array([mast.at for mast in found.truth[0].suggested.masts])
    (x0, x1), (y0, y1) = found.truth[0].x_m, found.truth[0].y_m
    assert ((place >= [x0 - 10, y0 - 10]) & (place <= [x1 + 10, y1 + 10])).all()
    if path.stat().st_size < 300_000:  # the others take a while: the same commands by hand
        replayed(path)

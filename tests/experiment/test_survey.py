"""What `info` says of a recording, as data and as lines."""

import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from osi3.osi_groundtruth_pb2 import GroundTruth
from typer.testing import CliRunner

from copem_replay.cli.main import app
from copem_replay.experiment.draft.findings import survey_as_json
from copem_replay.experiment.draft.survey import survey_recording
from copem_replay.experiment.draft.template import describe_survey
from tests.helpers.recordings import SHARED, Obj, Topic, pedestrian, truth_topic, write_mcap, write_recording
from tests.helpers.roads import add_marking, two_lanes

# A car at 10 m/s for 1.5 s, a pedestrian who is there at 0, 0.25 and 1.5 s, a cone; no list at 1 s.
CONE = Obj(id=9, x=5, y=3, z=0.35, length=0.4, width=0.4, height=0.7, stationary=True)
FRAMES = [
    (t, [Obj(id=4, x=10 * t, vx=10, length=4.5), CONE, *([pedestrian(7, 30)] if t in (0, 0.25, 1.5) else [])])
    for t in (0, 0.25, 0.5, 0.75, 1.25, 1.5)
]
RSU = Topic("rsu", "osi3.SensorData", [(0, b""), (250_000_000, b"")])
ODOMETRY = Topic("/odom", "nav_msgs/msg/Odometry", [(0, b"x")], "cdr")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "log.mcap"


def test_lanes_and_crosswalks_of_a_recording_are_counted(path):
    topic = truth_topic(FRAMES, host=4)
    (at_ns, first), *later = topic.messages
    message = GroundTruth.FromString(first)
    for road in (two_lanes(), add_marking(GroundTruth())):
        message.MergeFrom(road)
    write_mcap(path, [replace(topic, messages=[(at_ns, message.SerializeToString()), *later])])
    survey = survey_recording(path)
    assert survey.truth[0].ground == {"driving lane": 2, "crosswalk": 1}
    assert "  ground: 2 driving lanes, 1 crosswalk" in describe_survey(survey)


def test_survey(path):
    write_recording(path, FRAMES, host=4, more=[RSU, ODOMETRY])
    found = survey_as_json(survey_recording(path))
    assert found == {
        "recording": "log.mcap",
        "readable": True,
        "reason": None,
        "choice": None,
        "damage": None,
        "topics": [
            {
                "topic": "truth",
                "schema": "osi3.GroundTruth",
                "encoding": "protobuf",
                "messages": 6,
                "role": "truth",
            },
            {"topic": "rsu", "schema": "osi3.SensorData", "encoding": "protobuf", "messages": 2, "role": "unit"},
            {
                "topic": "/odom",
                "schema": "nav_msgs/msg/Odometry",
                "encoding": "cdr",
                "messages": 1,
                "role": "poses",
            },
        ],
        "proposals": [],
        "truth": [
            {
                "topic": "truth",
                "frames": 6,
                "states": 15,
                "start_ns": 0,
                "span_s": 1.5,
                "rate_hz": 4.0,
                "longest_gap_s": 0.5,
                "longest_gap_at_s": 0.75,
                "x_m": [0.0, 30.0],
                "y_m": [0.0, 3.0],
                "gaps_inside_tracks": 1,
                "moving": {"pedestrian": 1, "car": 1},
                "stationary": {"other": 1},
                "ground": {},
                "host_id": "4",
                "ego": {"id": "4", "class": "car", "size_m": [4.5, 2.0, 1.5], "from_s": 0.0, "to_s": 1.5},
                "missing": [],
                "damage": None,
                "notes": ["1 message of nav_msgs/msg/Odometry not read"],
                "place": "none (the recording does not say where on earth it is)",
                "vehicles": "4 (car), 7 (pedestrian)",
                "units": [
                    {
                        "topic": "rsu",
                        "lists": 2,
                        "entries": 0,
                        "rate_hz": 4.0,
                        "covariances_said": True,
                        "captures_said": False,
                        "velocities_said": True,
                        "problem": None,
                        "delay_s": None,
                        "delay_interval_s": None,
                        "delay": "cannot be told: nothing in them can be followed from list to list",
                        "oddities": [],
                        "middle_m": [0.0, 0.0],
                        "at_wgs84": None,
                        "views": [],
                        "no_views": "",
                    }
                ],
                "map": None,
                "suggested": {
                    "ego": None,
                    "ego_why": "the log names its host vehicle: 4 (car)",
                    "classes": ["vru"],
                    "few": {},
                    "range_m": 40.0,
                    "again_after_s": None,
                    "began": {"crossed": 0, "appeared": 0, "log_start": 1},
                    "masts": [
                        {"at": [40.0, 0.0], "yaw_deg": 180},
                        {"at": [20.0, 0.0], "yaw_deg": 0},
                    ],
                },
            }
        ],
        "log": str(path),
        "units": [],
    }
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert survey_as_json(survey_recording(path)) == found


def test_describe(path):
    write_recording(path, FRAMES, host=4, more=[RSU, ODOMETRY])
    assert describe_survey(survey_recording(path)) == [
        "log.mcap",
        "  topic  schema                 encoding  messages",
        "  truth  osi3.GroundTruth       protobuf         6  the truth",
        "  rsu    osi3.SensorData        protobuf         2  lists of a unit, for `recorded: {topic: …}`",
        "  /odom  nav_msgs/msg/Odometry  cdr              1  poses",
        "truth: truth",
        "  6 frames, 1.500 s, 4.00 Hz (median), longest gap 0.500 s at 0.750 s",
        "  within x 0 … 30 m, y 0 … 3 m",
        "  place: none (the recording does not say where on earth it is)",
        "  1 gap above 0.5 s inside tracks",
        "  moving: 1 pedestrian, 1 car",
        "  stationary: 1 other",
        "  ego: 4 (car, 4.50 × 2.00 × 1.50 m), 0.000 – 1.500 s",
        "  unit rsu: 2 lists, 0 entries, 4.00 Hz (median); without captures",
        "    delay_s against the truth cannot be told: nothing in them can be followed from list to list",
        "  note: 1 message of nav_msgs/msg/Odometry not read",
        f"experiment: copem-replay init {path} > experiment.yaml",
    ]


def test_no_ego_says_how_to_give_one(path):
    write_recording(path, FRAMES)
    (truth,) = survey_recording(path).truth
    assert (truth.ego, truth.host_id) == (None, None)
    assert truth.missing == [
        "no ego vehicle: the log names no host vehicle; "
        "give `ego: <id>` in the experiment, or `--ego <id>`, of 4 (car), 7 (pedestrian)"
    ]
    assert f"  missing: {truth.missing[0]}" in describe_survey(survey_recording(path))


def test_a_host_that_is_nobody(path):
    write_recording(path, FRAMES, host=114)
    (truth,) = survey_recording(path).truth
    assert (truth.ego, truth.host_id) == (None, "114")
    assert truth.missing[0].startswith("no ego vehicle: the host vehicle 114 is no moving object; give `ego: <id>`")


def test_one_frame_has_neither_rate_nor_gap(path):
    write_recording(path, FRAMES[:1], host=4)
    (truth,) = survey_recording(path).truth
    assert (truth.rate_hz, truth.longest_gap_s, truth.longest_gap_at_s) == (None, None, None)
    assert "  1 frame, 0.000 s" in describe_survey(survey_recording(path))


def test_a_choice_between_truths_shows_them_all(path):
    write_recording(path, FRAMES, more=[truth_topic(FRAMES[:2], name="other")])
    found = survey_recording(path)
    assert found.readable
    assert [(t.topic, t.frames) for t in found.truth] == [("truth", 6), ("other", 2)]
    lines = describe_survey(found)
    assert "truth: other" in lines
    assert found.choice in lines
    assert found.choice.endswith("choose one with `read: {topic: …}` in the experiment")


def test_several_truths_and_none_usable(path):
    empty = [(0.0, [])]
    write_recording(path, empty, more=[truth_topic(empty, name="other")])
    found = survey_recording(path)
    assert not found.readable
    assert found.reason == (
        f"{path}: truth: no usable object in 1 message; {path}: other: no usable object in 1 message"
    )


def test_sensor_views_beside_a_ground_truth_are_not_looked_into(path):
    write_recording(path, FRAMES, more=[truth_topic(FRAMES, name="view", schema="osi3.SensorView")])
    assert [t.topic for t in survey_recording(path).truth] == ["truth"]


def test_no_truth_says_what_there_is(path):
    write_mcap(path, [ODOMETRY, RSU])
    found = survey_recording(path)
    assert not found.readable
    reason = found.reason
    assert reason == (
        f"{path}: no list of true objects; it holds nav_msgs/msg/Odometry (cdr) on /odom, osi3.SensorData on rsu; "
        "beside a recording that has one its lists replay by `together: [THAT, THIS]`; "
        "`read: {topic: …, objects: …, id: …}` names the fields of any list (docs/guide/recordings.md)"
    )
    assert describe_survey(found) == [
        "log.mcap",
        "  topic  schema                 encoding  messages",
        "  /odom  nav_msgs/msg/Odometry  cdr              1  poses",
        "  rsu    osi3.SensorData        protobuf         2  lists of a unit, for `recorded: {topic: …}`",
        "unit rsu: 2 lists, 0 entries, 4.00 Hz (median); without captures",
    ]


def test_info_of_a_bag_of_lists_alone_is_no_error(path):
    write_mcap(path, [RSU])
    ended = CliRunner().invoke(app, ["info", str(path)], standalone_mode=False)
    assert ended.return_value == 0
    assert "unit rsu: 2 lists" in ended.output
    write_mcap(path, [Topic("rsu", "osi3.SensorData", [(0, b"\xff")])])
    ended = CliRunner().invoke(app, ["info", str(path)], standalone_mode=False)
    assert ended.return_value == 2
    assert "unit rsu: none of its 1 messages can be decoded" in ended.output


def test_every_topic_has_a_role(path):
    """Unit lists of what this project wrote are not looked into; nor is a GroundTruth's SensorView."""
    more = [
        RSU,
        ODOMETRY,
        truth_topic(FRAMES, name="view", schema="osi3.SensorView"),
        Topic("copem/PEM/objects", "osi3.SensorData", [(0, b"\xff")]),
        Topic("copem/PEM/scene", "foxglove.SceneUpdate", [(0, b"")]),
        Topic("/tf", "tf2_msgs/TFMessage", [(0, b"")], "cdr"),
        Topic("/tracks", "autoware_perception_msgs/msg/TrackedObjects", [(0, b"")], "cdr"),
        Topic("/camera", "sensor_msgs/msg/Image", [(0, b"")], "cdr"),
    ]
    write_recording(path, FRAMES, host=4, more=more)
    found = survey_recording(path)
    assert {t.topic: t.role for t in found.topics} == {
        "truth": "truth",
        "view": "truth",
        "rsu": "unit",
        "copem/PEM/objects": "unit",
        "copem/PEM/scene": "unit",
        "/tracks": "unit",
        "/odom": "poses",
        "/tf": "poses",
        "/camera": "unread",
    }
    (truth,) = found.truth
    assert [(u.topic, u.problem is None) for u in truth.units] == [("rsu", True), ("/tracks", False)]
    lines = describe_survey(found)
    assert [line.split("  ")[-1] for line in lines[2:4]] == ["the truth", "lists of a unit, for `recorded: {topic: …}`"]
    assert any(line.startswith("  view ") and line.endswith("truth, too, but not taken") for line in lines)
    assert any(line.startswith("  unit /tracks: ") for line in lines)
    assert "  note: 1 message of sensor_msgs/msg/Image not read" in lines


def test_truth_without_usable_objects(path):
    write_recording(path, [(0, [Obj(x=None)])])
    found = survey_recording(path)
    assert not found.readable
    assert found.reason.startswith(f"{path}: truth: no usable object in 1 message; 1 object state without a pos")
    assert found.topics[0].role == "truth"


FOLDER = "expected a recording, found a folder without metadata.yaml"


def test_files_that_are_none(path, tmp_path):
    for where, why in ((path, "no such file"), (tmp_path, FOLDER)):
        found = survey_recording(where)
        assert (found.readable, found.topics, found.truth) == (False, [], [])
        assert found.reason == f"{where}: {why}"
        assert describe_survey(found) == [where.name]


def test_damage_is_said_once(path):
    write_recording(path, FRAMES, host=4, chunk_size=1, finish=False)
    found = survey_recording(path)
    assert found.readable
    assert found.damage == "damaged after 1.500 s: 6 messages read (the file ends too early)"
    assert [line for line in describe_survey(found) if "damaged" in line] == [f"  note: {found.damage}"]


def test_survey_is_quick_and_light(path):
    """In a fresh process, imports included; the heavy libraries stay out."""
    frames = [(k / 10, [Obj(id=i, x=i * 9 + k, vx=10) for i in range(30)]) for k in range(300)]
    write_recording(path, frames, host=0)
    code = (
        "import sys; from copem_replay.experiment.draft.survey import survey_recording; "
        "from copem_replay.experiment.draft.template import describe_survey; "
        "describe_survey(survey_recording(sys.argv[1]));"
        "print([m for m in ('pandas', 'numba', 'scipy', 'pydantic', 'shapely', 'rerun') if m in sys.modules])"
    )
    began = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True)
    assert time.perf_counter() - began < 5  # 0.3 s on an idle machine; a second is what is promised
    assert done.stdout == "[]\n"


@pytest.mark.parametrize("path", sorted(SHARED.glob("*.mcap")) or [None], ids=lambda p: p.stem if p else "absent")
def test_real_recordings_fit_a_screen(path):
    if path is None:
        pytest.skip("shared/data with recordings is not beside the project")
    found = survey_recording(path)
    assert found.readable
    json.dumps(survey_as_json(found), allow_nan=False)
    assert "unread" not in [t.role for t in found.topics if "Map" not in t.schema]
    assert len(describe_survey(found)) <= 30

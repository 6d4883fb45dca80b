"""Several recordings of one drive as one log. The oracle: the same messages in one file, by one clock."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType
from pandas.testing import assert_frame_equal
from typer.testing import CliRunner

import copem_replay as cr
from copem_replay.cli.main import app
from copem_replay.experiment.draft.survey import ClockFound, compare_clocks
from copem_replay.io.clock_offset import TimeOffset
from copem_replay.io.findings import X, Y
from copem_replay.io.frames import read_decoded_lists, read_log_context, transform_to_world
from copem_replay.io.log import Log
from copem_replay.io.open import DriveRecordings, label_files, open_log
from copem_replay.io.recorded_lists import read_recorded
from copem_replay.io.recording import read_log
from copem_replay.io.window import Window
from copem_replay.io.write.source import open_source
from tests.experiment.test_validate import against_logs, without_logs
from tests.helpers.experiments import changed
from tests.helpers.recordings import Obj, Topic, ns, truth_topic, write_mcap
from tests.helpers.ros2 import made, topic, transform
from tests.io.test_recorded_units import car, list_of
from tests.io.test_world_frame import json_topic

AHEAD_S = 0.375
FRAMES = [(10 + 0.1 * k, [Obj(id=1), Obj(id=2, x=70.0 - k, vx=-10.0)]) for k in range(40)]


def rsu(ahead_s: float, name: str = "objects") -> Topic:
    lists = [list_of(10.05 + 0.1 * k + ahead_s, car(69.5 - k, vx=-10.0)) for k in range(38)]
    return Topic(name, "osi3.SensorData", lists)


def ego_topics() -> list[Topic]:
    """The truth, and a topic of the ego's that has the name of the unit's."""
    own = [list_of(10 + 0.2 * k, car(70.0 - 2 * k, y=0.5, vx=-10.0)) for k in range(20)]
    return [truth_topic(FRAMES, name="truth", host=1), Topic("objects", "osi3.SensorData", own)]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_mcap(tmp_path / "ego.mcap", ego_topics())
    write_mcap(tmp_path / "rsu.mcap", [rsu(AHEAD_S)])
    truth, own = ego_topics()
    both = [truth, Topic("ego:objects", own.schema, own.messages), rsu(0.0, "rsu:objects")]
    write_mcap(tmp_path / "drive.mcap", both)
    return tmp_path


def place(folder: Path, ahead_s: float = AHEAD_S) -> DriveRecordings:
    return DriveRecordings((folder / "ego.mcap", folder / "rsu.mcap"), (0.0, ahead_s))


PLAN: dict[str, Any] = {
    "version": 1,
    "runs": 1,
    "units": {
        name: {"recorded": {"topic": f"{name}:objects", "covariance_m2": [[0.2, 0], [0, 0.2]]}}
        for name in ("ego", "rsu")
    },
    "configurations": {"both": {"units": ["ego", "rsu"], "fusion": {"kind": "gnn"}}},
    "measure": {"onset": {"kind": "appears"}, "began": ["log_start", "appeared"]},
}


def plan(folder: Path, entry: Any) -> dict[str, Any]:
    return PLAN | {"logs": [entry]}


def joint(folder: Path, ahead_s: float = AHEAD_S) -> dict[str, Any]:
    paths = [str(folder / "ego.mcap"), str(folder / "rsu.mcap")]
    return {"together": paths, "clock_offset_s": {paths[1]: ahead_s}, "name": "drive"}


def test_clock_offsets_are_rounded_to_a_nanosecond() -> None:
    """1.001 · 1e9 is 1 000 999 999.999 999 9 in binary."""
    assert DriveRecordings((Path("a.mcap"), Path("b.mcap")), (0.0, 1.001)).ahead_ns == (0, 1_001_000_000)


def test_messages_come_in_order_of_time_and_topics_are_told_apart(folder: Path) -> None:
    log = open_log(place(folder))
    assert {c.topic for c in log.channels} == {"truth", "ego:objects", "rsu:objects"}
    one = open_log(folder / "drive.mcap")
    topics = [{c.number: c.topic for c in each.channels} for each in (log, one)]
    found, expected = (
        sorted((t, of[n]) for n, t, _ in each.payloads(frozenset(of)))
        for each, of in zip((log, one), topics, strict=True)
    )
    assert found == expected
    times = [t for _, t, _ in log.payloads(frozenset(topics[0]))]
    assert times == sorted(times)


def test_lists_are_by_the_first_clock(folder: Path) -> None:
    recording = read_log(place(folder), name="drive")
    assert recording.path == folder / "ego.mcap"
    found, expected = (
        read_recorded(at, "rsu:objects", recording.scene).tracks for at in (place(folder), folder / "drive.mcap")
    )
    assert np.array_equal(found.stamp_ns, expected.stamp_ns)
    assert np.array_equal(found.arrives_s, expected.arrives_s)


@pytest.mark.parametrize("window_s", [None, [1, 3]])
def test_a_drive_comes_out_as_from_one_file(folder: Path, window_s: list[float] | None) -> None:
    whole = plan(folder, {"file": str(folder / "drive.mcap"), "name": "drive"}) | {"window_s": window_s}
    expected = cr.run(whole, jobs=1).detections
    assert len(expected)
    found = cr.run(plan(folder, joint(folder)) | {"window_s": window_s}, jobs=1).detections
    assert_frame_equal(found, expected)


def test_what_is_written_is_one_file_that_replays_as_the_drive_did(folder: Path) -> None:
    result = cr.run(plan(folder, joint(folder)), jobs=1)
    result.save(folder / "out")
    again = cr.run(plan(folder, {"file": str(folder / "out/replay.mcap"), "name": "drive"}), jobs=1)
    assert_frame_equal(again.detections, result.detections)
    saved = cr.run(folder / "out/experiment.yaml", jobs=1)
    assert_frame_equal(saved.detections, result.detections)
    written = open_log(folder / "out/replay.mcap")
    assert {c.ahead_ns for c in written.channels if c.topic == "rsu:objects"} == {ns(AHEAD_S)}
    times = [t for _, t, _ in written.payloads(frozenset(c.number for c in written.channels))]
    assert times == sorted(times)


def test_nothing_is_moved_unasked(folder: Path) -> None:
    recording = read_log(place(folder, 0.0), name="drive")
    found = read_recorded(place(folder, 0.0), "rsu:objects", recording.scene).tracks
    assert found.stamp_ns[0] == ns(10.05 + AHEAD_S)


def test_a_window_is_by_the_first_clock(folder: Path) -> None:
    log = open_log(place(folder)).within(Window(ns(11), ns(12)))
    times = [t for _, t, _ in log.payloads(frozenset(c.number for c in log.channels))]
    assert ns(11) <= min(times)
    assert max(times) <= ns(12)
    assert len(times) == 11 + 6 + 10  # truth, the ego's lists, the unit's


def test_labels_are_as_long_as_they_need_to_be(tmp_path: Path) -> None:
    assert label_files([tmp_path / "ego.mcap", tmp_path / "rsu.mcap"]) == ["ego", "rsu"]
    assert label_files([tmp_path / "a/x.mcap", tmp_path / "b/x.mcap"]) == ["a/x", "b/x"]


def traffic(folder: Path, ahead_s: float, *, captured: bool = False, truth: bool = True) -> tuple[Path, Path]:
    """Two cars at varying speeds by the truth, and by a unit with errors of half a metre and a clock of its own.

    `captured`: the unit says when its lists were captured; the vehicle's bag has them, too, 0.2 s late and unsaid.
    """
    rng = np.random.default_rng(2)

    def along(t: float) -> tuple[float, float]:
        return 8 * t - 4 * np.cos(t), 8 + 4 * np.sin(t)

    frames, lists, late = [], [], []
    for k in range(400):
        x, v = along(0.05 * k)
        frames.append((100 + 0.05 * k, [Obj(id=1, x=x, vx=v), Obj(id=2, x=-x, y=9, vx=-v)]))
    for k in range(3, 180):
        x, v = along(0.1 * k)
        east, north = rng.normal(0, 0.5, (2, 2))
        entries = car(x + east[0], north[0], vx=v), car(-x + east[1], 9 + north[1], vx=-v, track=1)
        stamp_s = 100 + 0.1 * k + ahead_s
        lists.append(list_of(stamp_s, *entries, captured_s=stamp_s if captured else None))
        late.append(list_of(stamp_s - ahead_s + 0.2, *entries))
    topics = [truth_topic(frames, name="truth", host=1)] if truth else []
    ego = write_mcap(folder / "ego.mcap", [*topics, *[Topic("stack", "osi3.SensorData", late)] * captured])
    return ego, write_mcap(folder / "rsu.mcap", [Topic("objects", "osi3.SensorData", lists)])


class TestClocks:
    def test_info_tells_the_offset_and_init_writes_it(self, tmp_path: Path) -> None:
        logs = [str(path) for path in traffic(tmp_path, -0.4)]
        (found,) = compare_clocks([Path(log) for log in logs])
        assert found.lists == ("ego:truth", "rsu:objects")
        assert found.offset.low_s < -0.4 < found.offset.high_s
        assert found.offset.offset_s == pytest.approx(-0.4, abs=0.02)
        told = CliRunner().invoke(app, ["info", *logs, "--together"], standalone_mode=False)
        assert told.return_value == 0
        assert f"clock_offset_s against {logs[0]}: {found.words()}" in told.output.replace("\n", " ")
        (plain,) = json.loads(CliRunner().invoke(app, ["info", *logs, "--together", "--json"]).output)
        assert (plain["recording"], plain["against"], plain["lists"]) == (logs[1], logs[0], list(found.lists))
        assert plain["clock_offset_s"] == found.offset.offset_s
        assert plain["interval_s"] == [found.offset.low_s, found.offset.high_s]
        assert (plain["drift"], plain["entries"], plain["untold"]) == (None, found.offset.entries, None)
        drafted = CliRunner().invoke(app, ["init", *logs, "--together"], standalone_mode=False).output
        assert f"{round(found.offset.offset_s, 3)}   # {found.words()}" in drafted
        (tmp_path / "experiment.yaml").write_text(drafted)
        (study,) = cr.load_experiment(tmp_path / "experiment.yaml").logs
        assert not isinstance(study, str)
        assert study.together == tuple(logs)

    def test_lists_of_an_unknown_delay_come_last_however_narrow_their_interval(self, tmp_path: Path) -> None:
        (found,) = compare_clocks(traffic(tmp_path, 0.3, captured=True))
        assert found.lists == ("ego:truth", "rsu:objects")
        assert found.offset.offset_s == pytest.approx(0.3, abs=0.03)
        assert "included" not in found.words()

    def test_a_delay_that_is_in_the_offset_is_said(self, tmp_path: Path) -> None:
        (found,) = compare_clocks(traffic(tmp_path, 0.3, captured=True, truth=False))
        assert found.offset.offset_s == pytest.approx(0.3 - 0.2, abs=0.01)
        assert found.words().endswith(", the delay of ego:stack included, which does not say when captured")

    def test_one_recording_has_nothing_to_be_ahead_of(self, folder: Path) -> None:
        found = CliRunner().invoke(app, ["info", str(folder / "ego.mcap"), "--together"], standalone_mode=False)
        assert isinstance(found.exception, cr.InputError)
        assert str(found.exception) == "--together: expected several recordings of one drive, found 1"

    def test_what_cannot_be_told_is_said(self, folder: Path) -> None:
        write_mcap(folder / "rsu.mcap", [Topic("objects", "osi3.SensorData", rsu(0.0).messages[:3])])
        (found,) = compare_clocks([folder / "ego.mcap", folder / "rsu.mcap"])
        assert found.words().startswith("cannot be told: ")
        assert found.words().endswith(found.plain()["untold"])
        assert found.plain()["clock_offset_s"] is found.plain()["interval_s"] is None

    def test_the_drift_is_in_the_json_with_its_interval(self) -> None:
        offset = TimeOffset(0.1, 0.05, 0.15, 40, (1e-4, 5e-5, 2e-4))
        plain = ClockFound(Path("b.mcap"), ("a:x", "b:y"), offset).plain()
        assert (plain["drift"], plain["drift_interval"]) == (1e-4, [5e-5, 2e-4])


class TestRefused:
    @pytest.mark.parametrize(
        ("entry", "expected"),
        [
            ("{together: [ego.mcap]}", "2: logs[0].together: expected at least 2 in the list, found ['ego.mcap']"),
            (
                "{together: [ego.mcap, rsu.mcap], file: ego.mcap}",
                "2: logs[0]: expected one of `file: <recording>` and `together: [<recording>, <recording>]`",
            ),
            (
                "{together: [ego.mcap, ego.mcap]}",
                "2: logs[0]: together: expected each recording once, found 'ego.mcap' twice",
            ),
            (
                "{together: [ego.mcap, rsu.mcap], clock_offset_s: {mast.mcap: 1}}",
                "2: logs[0]: clock_offset_s: expected a recording of `together` (rsu.mcap), found 'mast.mcap'",
            ),
            (
                "{together: [ego.mcap, rsu.mcap], clock_offset_s: {ego.mcap: 1}}",
                "2: logs[0]: clock_offset_s: 'ego.mcap' is the first, by whose clock the others are ahead",
            ),
        ],
    )
    def test_by_its_shape(self, folder: Path, entry: str, expected: str) -> None:
        assert without_logs(folder, changed(f"logs: [{entry}]")) == [expected]

    def test_an_offset_beyond_the_overlap(self, folder: Path) -> None:
        entry = "{together: [ego.mcap, rsu.mcap], clock_offset_s: {rsu.mcap: 60}}"
        assert against_logs(folder, changed(f"logs: [{entry}]")) == [
            "2: logs[0].clock_offset_s: ego.mcap: rsu.mcap: with 60 s the offset is beyond the overlap: expected a "
            "time in common with ego.mcap, found 55.875 s between them"
        ]

    def test_files_that_do_not_overlap(self, folder: Path) -> None:
        write_mcap(folder / "rsu.mcap", [rsu(100.0)])
        assert against_logs(folder, changed("logs: [{together: [ego.mcap, rsu.mcap]}]")) == [
            "2: logs[0].together: ego.mcap: rsu.mcap: expected a time in common with ego.mcap, found 96.150 s between "
            "them"
        ]

    def test_a_file_that_is_not_there(self, folder: Path) -> None:
        assert against_logs(folder, changed("logs: [{together: [ego.mcap, gone.mcap]}]")) == [
            "2: logs[0]: gone.mcap: no such file"
        ]

    def test_two_truths(self, folder: Path) -> None:
        write_mcap(folder / "rsu.mcap", [truth_topic(FRAMES, name="truth")])
        entry = "{together: [ego.mcap, rsu.mcap]}"
        (line,) = against_logs(folder, changed(f"logs: [{entry}]"))
        assert line.startswith(
            "2: logs[0].together: ego.mcap: true objects on several topics, ego:truth (osi3.GroundTruth), rsu:truth"
        )
        assert line.endswith("choose one with `read: {topic: …}` in the experiment")
        chosen = entry.replace("}", ", read: {topic: 'rsu:truth'}, ego: 1}")
        assert against_logs(folder, changed(f"logs: [{chosen}]")) == []


class TestFrames:
    """Two ROS 2 bags whose transforms have the same names: a car that drives, and a mast that looks back."""

    @staticmethod
    def bags(folder: Path) -> tuple[Path, Path]:
        def bag(name: str, place: Callable[[float], tuple[float, float, float]]) -> Path:
            kind = "tf2_msgs/msg/TFMessage"
            times = [0.1 * k for k in range(11)]
            moving = [(t, made(kind, transforms=[transform(t, "map", "base_link", *place(t))])) for t in times]
            lidar = made(kind, transforms=[transform(0.0, "base_link", "lidar", 2.0, 0.0)])
            boxes = [(t, cubes(t)) for t in times]
            return write_mcap(
                folder / f"{name}.mcap",
                [
                    topic("/tf", kind, moving),
                    topic("/tf_static", kind, [(0.0, lidar)]),
                    json_topic("/scene", boxes, schema="foxglove.SceneUpdate"),
                ],
            )

        return bag("ego", lambda t: (10 * t, 0.0, 0.0)), bag("mast", lambda t: (50.0, 20.0, 180.0))

    def test_each_list_goes_by_the_transforms_of_its_own_bag(self, tmp_path: Path) -> None:
        log = open_log(DriveRecordings(self.bags(tmp_path), (0.0, 0.0)))
        assert self.places(log) == {"ego:/scene": (10 * 0.5 + 2 + 5, 0.0), "mast:/scene": (50.0 - 2 - 5, 20.0)}

    def test_a_frame_that_one_bag_alone_places_is_known_to_both(self, tmp_path: Path) -> None:
        """The mount of a lidar in the bag of the lidar, where the car is in the other."""
        ego, mast = self.bags(tmp_path)
        kind = "tf2_msgs/msg/TFMessage"
        mount = made(kind, transforms=[transform(0.0, "base_link", "lidar", 3.0, 0.0)])
        boxes = json_topic("/scene", [(0.1 * k, cubes(0.1 * k)) for k in range(11)], schema="foxglove.SceneUpdate")
        write_mcap(mast, [topic("/tf_static", kind, [(0.0, mount)]), boxes])
        places = self.places(open_log(DriveRecordings((ego, mast), (0.0, 0.0))))
        assert places == {"ego:/scene": (10 * 0.5 + 2 + 5, 0.0), "mast:/scene": (10 * 0.5 + 3 + 5, 0.0)}

    @staticmethod
    def places(log: Log) -> dict[str, tuple[float, float]]:
        """Where the box of each list is after half a second."""
        around = read_log_context(log, None, seek_ego=False)
        found = {}
        for channel in log.channels:
            if channel.schema == "foxglove.SceneUpdate":
                lists = transform_to_world(
                    read_decoded_lists(log, [channel], None, {}), around, log.path, channel.topic
                )
                at = lists.columns.values[5]
                found[channel.topic] = (round(float(at[X]), 6), round(float(at[Y]), 6))
        return found


def cubes(t_s: float) -> dict[str, Any]:
    """A car 5 m ahead of a lidar."""
    at = {"sec": ns(t_s) // 10**9, "nsec": ns(t_s) % 10**9}
    placed = {"position": {"x": 5, "y": 0, "z": 1}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}
    cube = {"pose": placed, "size": {"x": 4, "y": 2, "z": 1.5}}
    metadata = [{"key": "category", "value": "vehicle.car"}]
    entity = {"id": "c1", "timestamp": at, "frame_id": "lidar", "cubes": [cube], "metadata": metadata}
    return {"deletions": [], "entities": [entity]}


def test_both_files_are_hit(folder: Path) -> None:
    """Neither index can be used: what is left of both is read, and copied in order of time."""
    for name, topics in (("ego.mcap", ego_topics()), ("rsu.mcap", [rsu(AHEAD_S)])):
        write_mcap(folder / name, topics, chunk_size=1, compression=CompressionType.NONE)
        data = bytearray((folder / name).read_bytes())
        with (folder / name).open("rb") as file:
            chunk = make_reader(file).get_summary().chunk_indexes[-1]  # type: ignore[union-attr]
        data[chunk.chunk_start_offset + chunk.chunk_length - 20] ^= 0x10
        (folder / name).write_bytes(data)
    source = open_source(place(folder))
    copied = list(source.messages({number: number for number in source.channels}))
    assert len(copied) == 40 + 20 + 38 - 2
    assert [m.log_time for m in copied] == sorted(m.log_time for m in copied)
    assert source.damage == "damaged: its messages are copied as far as they can be read"
    assert len(read_recorded(place(folder), "rsu:objects", read_log(place(folder), name="drive").scene).logged_ns) == 37

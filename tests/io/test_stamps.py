"""Time stamps against times of logging: not set, of another clock, falling; what is sent once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from copem_replay.core.errors import RecordingError
from copem_replay.io.recorded_units import read_as_recorded
from copem_replay.io.recording import read_log
from copem_replay.io.stamps import find_runs, settle_stamps
from tests.helpers.recordings import Obj, Topic, ground_truth, ns, write_mcap, write_recording
from tests.helpers.ros2 import odometry, topic
from tests.io.test_findings import markers
from tests.io.test_recorded_units import car, list_of

WALL = Obj(id=9, x=20, y=9, stationary=True, length=8, width=1, height=3)


def settled(stamps_s: list[float | None], logged_s: list[float]) -> tuple[list[float], list[str]]:
    stamped = np.array([s is not None for s in stamps_s])
    stamp_ns, logged_ns = (np.array([ns(s or 0) for s in times], dtype=np.int64) for times in (stamps_s, logged_s))
    found, _, kept, findings = settle_stamps(np.where(stamped, stamp_ns, logged_ns), stamped, logged_ns)
    return (found[kept] / 1e9).tolist(), [f.rule for f in findings]


def test_zeros_before_the_clock_came_are_none() -> None:
    logged = [100 + k / 10 for k in range(8)]
    assert settled([0, 0, 0, *logged[3:]], logged) == (logged, ["stamp zero"])
    assert settled([0] * 8, logged) == (logged, ["stamp zero"])


def test_a_simulation_that_starts_at_0_keeps_it() -> None:
    stamps: list[float | None] = [0.0, 0.1, 0.2, 0.3]
    assert settled(stamps, [1.7e9 + k / 10 for k in range(4)]) == (stamps, [])


def test_what_has_no_stamp_goes_by_the_clock_of_the_others() -> None:
    """A simulation that was logged at 1000 s and stamped from 5 s on."""
    logged = [1000 + k / 10 for k in range(6)]
    assert settled([5.0, 5.1, None, 5.3, 5.4, 5.5], logged)[0] == pytest.approx([5, 5.1, 5.2, 5.3, 5.4, 5.5])


def test_one_stamp_of_another_clock_is_none() -> None:
    logged = [50 + k / 10 for k in range(6)]
    for place in range(6):
        for odd in (2.0e9, 1.0):
            stamps: list[float | None] = [*logged]
            stamps[place] = odd
            assert settled(stamps, logged) == (logged, ["stamp odd"]), (place, odd)


def test_a_clock_that_is_set_leaves_the_larger_part() -> None:
    logged = [7 + k / 10 for k in range(10)]
    assert settled([7.0, 7.1, *(1.7e9 + k / 10 for k in range(2, 10))], logged)[0] == pytest.approx(
        [1.7e9 + k / 10 for k in range(10)]
    )


def test_a_pause_and_a_message_that_is_logged_late_are_none_of_this() -> None:
    stamps: list[float | None] = [0, 0.1, 0.2, 9.0, 9.1]
    assert settled(stamps, [0, 0.1, 0.2, 9.0, 9.1]) == (stamps, [])
    steady: list[float | None] = [0, 0.1, 0.2, 0.3, 0.4]
    assert settled(steady, [0, 0.1, 3.2, 3.3, 3.4]) == (steady, [])


@given(st.lists(st.integers(0, 900), min_size=1, max_size=30), st.integers(0, 10**10))
def test_stamps_that_rise_with_log_time_are_as_they_were(latencies_ms: list[int], start_ns: int) -> None:
    """Whatever the latency, up to the second that two clocks may be apart."""
    stamp_ns = start_ns + 1 + np.arange(len(latencies_ms)) * 10**8
    logged_ns = np.maximum.accumulate(stamp_ns + np.array(latencies_ms) * 10**6)
    found, stated, kept, findings = settle_stamps(stamp_ns, np.ones(len(stamp_ns), dtype=bool), logged_ns)
    assert (found == stamp_ns).all()
    assert stated.all()
    assert kept.all()
    assert not findings
    assert not find_runs(stamp_ns, logged_ns).any()


def run_of(start_s: float, log_s: float, y: float) -> list[tuple[int, bytes]]:
    times = [k / 10 for k in range(20)]
    return [(ns(log_s + t), ground_truth(start_s + t, [Obj(x=t, y=y)]).SerializeToString()) for t in times]


def test_two_runs_are_refused_with_their_windows_and_each_can_be_read(tmp_path: Path) -> None:
    messages = [*run_of(5, 100, 0), *run_of(5.05, 103, 40)]
    path = write_mcap(tmp_path / "a.mcap", [Topic("truth", "osi3.GroundTruth", messages)])
    with pytest.raises(RecordingError, match=r"2 runs.*window_s: \[0, 1.9\].*window_s: \[3, 4.9\]"):
        read_log(path, name="log")
    for window, y in (((0, 1.9), 0), ((3, 4.9), 40)):
        truth = read_log(path, name="log", window_s=window).truth
        assert len(truth.stamp_ns) == 20
        assert (truth.y_m == y).all()


def test_a_trace_of_two_runs_is_refused_and_each_can_be_read(tmp_path: Path) -> None:
    """It has no log times: the second run is taken as logged 2 s after the first."""
    payloads = [payload for _, payload in (*run_of(5, 0, 0), *run_of(5.05, 0, 40))]
    path = tmp_path / "a.osi"
    path.write_bytes(b"".join(len(payload).to_bytes(4, "little") + payload for payload in payloads))
    with pytest.raises(RecordingError, match=r"2 runs.*window_s: \[0, 1.9\].*window_s: \[3.9, 5.8\]"):
        read_log(path, name="log")
    for window, y in (((0, 1.9), 0), ((3.9, 5.8), 40)):
        truth = read_log(path, name="log", window_s=window).truth
        assert len(truth.stamp_ns) == 20
        assert (truth.y_m == y).all()


def test_one_late_message_of_a_trace_is_no_reset(tmp_path: Path) -> None:
    payloads = [payload for _, payload in run_of(5, 0, 0)]
    payloads.insert(18, payloads.pop(2))
    path = tmp_path / "a.osi"
    path.write_bytes(b"".join(len(payload).to_bytes(4, "little") + payload for payload in payloads))
    recording = read_log(path, name="log")
    assert recording.truth.captured_s.tolist() == pytest.approx([k / 10 for k in range(20)])


@pytest.mark.parametrize("osi", [True, False])
def test_lists_of_a_unit_of_two_runs_are_refused(tmp_path: Path, osi: bool) -> None:
    times, kind = [k / 10 for k in range(20)], "visualization_msgs/msg/MarkerArray"
    logged = [*((5 + t, 100 + t) for t in times), *((5.05 + t, 103 + t) for t in times)]
    if osi:
        sent = [(ns(log_s), list_of(t, car(t, vx=1.0))[1]) for t, log_s in logged]
        unit = Topic("unit", "osi3.SensorData", sent)
    else:
        unit = topic("unit", kind, [(log_s, markers(t)) for t, log_s in logged])
    truth = Topic("truth", "osi3.GroundTruth", [*run_of(5, 100, 0), *run_of(8, 103, 0)])
    recording = read_log(write_mcap(tmp_path / "a.mcap", [truth, unit]), name="log")
    with pytest.raises(RecordingError, match=r"unit: time goes back once, so it holds 2 runs"):
        read_as_recorded(recording, "unit")
    first = read_log(recording.path, name="log", window_s=(0, 1.95))
    assert len(read_as_recorded(first, "unit").tracks.stamp_ns) == 20


def test_what_is_played_twice_is_one_run(tmp_path: Path) -> None:
    path = write_mcap(
        tmp_path / "a.mcap", [Topic("truth", "osi3.GroundTruth", [*run_of(5, 100, 0), *run_of(5, 103, 0)])]
    )
    recording = read_log(path, name="log")
    assert len(recording.truth.stamp_ns) == 20
    assert "20 messages with the time stamp of another: the first kept" in recording.notes


def test_the_odometry_of_the_run_before_is_none_of_the_window(tmp_path: Path) -> None:
    """It lies in the margin in which poses are read, and its stamps in the window's."""
    kind = "visualization_msgs/msg/MarkerArray"
    boxes, poses = [], []
    for log_s, x in ((0.0, 0.0), (1.0, 500.0)):
        for k in range(10):
            boxes.append((log_s + k / 10, markers(10 + 2 * (x == 0) + k / 10)))
            poses.append((log_s + k / 10, odometry(10 + 2 * (x == 0) + k / 10, x + k, 0.0)))
    path = write_mcap(
        tmp_path / "a.mcap", [topic("/boxes", kind, boxes), topic("/odom", "nav_msgs/msg/Odometry", poses)]
    )
    recording = read_log(path, name="log", window_s=(1.0, None))
    ego = recording.truth.row_object_ix == recording.scene.ego_ix
    assert recording.truth.x_m[0, ego].min() == 500


def test_lists_and_poses_of_two_clocks(tmp_path: Path) -> None:
    kind, times = "visualization_msgs/msg/MarkerArray", [k / 10 for k in range(5)]
    odom = topic("/odom", "nav_msgs/msg/Odometry", [(t, odometry(1000 + t, t, 0.0)) for t in times])
    path = write_mcap(tmp_path / "a.mcap", [topic("/boxes", kind, [(t, markers(1 + t)) for t in times]), odom])
    recording = read_log(path, name="log")
    line = "poses on /odom are from 1000 to 1000.4 s, the lists from 1 to 1.4 s: 998.6 s apart, of two clocks"
    assert line in recording.notes
    assert recording.scene.ego_ix == -1


# What is sent once.


@pytest.mark.parametrize("window", [None, (0.2, None), (0.25, 0.45)])
def test_a_wall_that_is_sent_once_stands(tmp_path: Path, window: tuple[float, float | None] | None) -> None:
    frames = [(k / 10, [Obj(id=1, x=k)]) for k in range(6)]
    once = write_recording(tmp_path / "once.mcap", [(t, [*o, WALL] if t == 0 else o) for t, o in frames])
    always = write_recording(tmp_path / "always.mcap", [(t, [*o, WALL]) for t, o in frames])
    one, other = (read_log(path, name="log", window_s=window) for path in (once, always))
    assert one.scene.object_ids == other.scene.object_ids == ("1", "9")
    assert one.truth.x_m.tolist() == other.truth.x_m.tolist()
    assert one.truth.frame_ix.tolist() == other.truth.frame_ix.tolist()
    assert [n.split(" of ")[1] for n in one.notes if "stands" in n] == ["what stands, not sent again: where it was"]


def test_what_the_others_are_sent_without_is_gone(tmp_path: Path) -> None:
    cone = Obj(id=8, x=3, stationary=True)
    sent = [[WALL, cone], [], [WALL], []]
    path = write_recording(tmp_path / "a.mcap", [(k / 10, [Obj(id=1), *o]) for k, o in enumerate(sent)])
    recording = read_log(path, name="log")
    frames = {n: recording.truth.frame_ix[recording.truth.row_object_ix == k].tolist()
              for k, n in enumerate(recording.scene.object_ids)}  # fmt: skip
    assert frames == {"1": [0, 1, 2, 3], "9": [0, 1, 2, 3], "8": [0, 1]}

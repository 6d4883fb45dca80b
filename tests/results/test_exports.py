"""Replays beside the tables: of times before 0, and of exports that fail, which cost no table."""

from __future__ import annotations

import errno
import json
import math
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from mcap.reader import make_reader
from osi3.osi_sensordata_pb2 import SensorData

from copem_replay.core.errors import OutputError, RecordingError
from copem_replay.io.write import mcap
from copem_replay.viewer import rrd
from tests.cli.test_api import cr
from tests.helpers.experiments import changed, drive
from tests.helpers.recordings import Obj, write_recording
from tests.system.test_cli import Call, call, run_in

__all__ = ["call"]  # a fixture

TABLES = ("detections", "tally", "accuracy", "instants", "lists", "thresholds")
SURE = changed("show: {run: 0}", "pems: {onboard: [{detection: {kind: constant, probability: 1}}]}")
SURE = (
    "\n".join(line for line in SURE.splitlines() if not line.startswith(("  onboard", "    - when", "      "))) + "\n"
)
"""Nothing is drawn: draws go by the stamps of captures, which are others in a recording that is moved in time."""


def warmed_up(path: Path, start_s: float, logged_from_s: float) -> Path:
    """31 frames of 0.1 s from some stamp on, as a simulation has them; logged from another time on."""
    path.parent.mkdir()
    frames = [
        (
            start_s + 0.1 * k,
            [Obj(id=1), Obj(id=2, x=70.0 - k, vx=-10.0, yaw=math.pi), Obj(id=3, y=30.0, stationary=True)],
        )
        for k in range(31)
    ]
    return write_recording(path, frames, host=1, log_s=[logged_from_s + 0.1 * k for k in range(31)])


@pytest.fixture
def both(tmp_path: Path, call: Call) -> Path:
    """`before`: results of a recording whose stamps begin at −2 s; `zero`: the same one, whose stamps begin at 0."""
    (tmp_path / "e.yaml").write_text(SURE)
    for name, start_s in (("before", -2.0), ("zero", 0.0)):
        warmed_up(tmp_path / name / "drive.mcap", start_s, 0.0)
        ended = call("run", "e.yaml", "--log", f"{name}/drive.mcap", "--out", f"out/{name}")
        assert ended.code == 0
        assert ended.lines == [
            "note: drive: times before 0 cannot be written: the messages of replay.mcap that are added to the "
            "recording's are logged 2 s later; their stamps are as they were"
        ] * (name == "before")
    return tmp_path / "out"


def messages(path: Path) -> list[tuple[str, int, int, bytes]]:
    with path.open("rb") as file:
        read = make_reader(file, validate_crcs=True).iter_messages()
        return [(channel.topic, m.log_time, m.publish_time, m.data) for _, channel, m in read]


class TestTimesBeforeZero:
    def test_the_tables_are_those_of_the_recording_moved_to_zero(self, both: Path) -> None:
        for name in TABLES:
            one, other = (pd.read_parquet(both / at / f"{name}.parquet") for at in ("before", "zero"))
            assert len(one) > 0, name
            pd.testing.assert_frame_equal(one, other, check_exact=True)
        for name in ("summary", "bands"):
            assert (both / f"before/{name}.csv").read_bytes() == (both / f"zero/{name}.csv").read_bytes()
        files = [json.loads((both / at / "provenance.json").read_text())["files"] for at in ("before", "zero")]
        assert files[0] == files[1]
        assert {"replay.mcap", "replay.rrd"} <= set(files[0])

    def test_replay_mcap_is_that_of_zero_but_for_what_is_in_messages(self, both: Path) -> None:
        one, other = (messages(both / at / "replay.mcap") for at in ("before", "zero"))
        assert [m[:3] for m in one] == [m[:3] for m in other], "logged at the same times"
        assert min(m[1] for m in one if m[0].startswith("copem/")) == 0
        assert [m for m in one if not m[0].startswith("copem/")] == messages(both / "../before/drive.mcap")
        stamps = []
        for read in (one, other):
            lists = [SensorData.FromString(m[3]) for m in read if m[0] == "copem/coPEM/objects"]
            stamps.append([one.timestamp.seconds * 10**9 + one.timestamp.nanos for one in lists])
        assert len(stamps[0]) == 31
        assert np.array_equal(np.array(stamps[0]) + 2 * 10**9, stamps[1])

    def test_replay_mcap_reads_back_as_it_was_and_replays(self, both: Path) -> None:
        lists, truths = [], []
        for at in ("before", "zero"):
            recording = cr.read_recording(both / at / "replay.mcap")
            truths.append(recording.truth.x_m)
            lists.append(cr.read_lists(both / at / "replay.mcap", "copem/coPEM/objects", recording.scene))
        assert np.array_equal(*truths)
        assert np.array_equal(lists[0].x_m, lists[1].x_m, equal_nan=True)
        assert np.array_equal(lists[0].captured_s, lists[1].captured_s)
        assert np.array_equal(lists[0].arrives_s, lists[1].arrives_s)
        again = cr.run("e.yaml", both / "before/replay.mcap").detections
        first = pd.read_parquet(both / "before/detections.parquet")
        pd.testing.assert_frame_equal(again.drop(columns="log"), first.drop(columns="log"), check_dtype=False)

    def test_replay_rrd_has_both_timelines(self, both: Path) -> None:
        from rerun.chunk import RrdReader

        times: dict[str, list[dict[str, list[int]]]] = {"elapsed": [], "time": []}
        for at in ("before", "zero"):
            chunks = [chunk.to_record_batch() for chunk in RrdReader(both / at / "replay.rrd").stream()]
            for name, found in times.items():
                found.append({})
                for batch in (batch for batch in chunks if name in batch.schema.names):
                    path = batch.schema.metadata[b"rerun:entity_path"].decode()
                    found[-1].setdefault(path, []).extend(batch.column(name).cast("int64").to_pylist())
        before, zero = times["elapsed"]
        assert {path: sorted(each) for path, each in before.items()} == {
            path: sorted(each) for path, each in zero.items()
        }
        assert len(before) > 10
        assert min(min(each) for each in times["time"][0].values()) == -2 * 10**9
        assert min(min(each) for each in times["time"][1].values()) == 0


class Failure:
    """An exporter that fails, and what is said of it."""

    def __init__(self, error: Exception, reason: str) -> None:
        self.error, self.reason = error, reason

    def __call__(self, path: Path, *_: Any, **__: Any) -> list[str]:
        path.write_text("half")
        raise self.error


FAILURES = [
    Failure(OSError(errno.ENOSPC, "No space left on device"), "No space left on device"),
    Failure(OutputError("nothing listens"), "nothing listens"),
    Failure(RecordingError("cannot be read: gone", path=Path("drive.mcap")), "drive.mcap: cannot be read: gone"),
    Failure(MemoryError(), "not enough memory"),
    Failure(
        ValueError("oops\nand more"), "internal error, please report it: ValueError: oops and more, in test_exports.py,"
    ),
]


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an experiment, its recording and its results, with both exports."""
    folder = tmp_path_factory.mktemp("shown")
    run_in(folder, changed("show: {run: 0}"))
    return folder


@pytest.mark.parametrize("failure", FAILURES, ids=[type(one.error).__name__ for one in FAILURES])
@pytest.mark.parametrize("kind", ["mcap", "rrd"])
class TestExportsThatFail:
    """The tables are there, the other export is, and neither half a file nor an empty folder."""

    def fails(self, monkeypatch: pytest.MonkeyPatch, kind: str, failure: Failure) -> None:
        where: tuple[Any, str] = (mcap, "write_mcap") if kind == "mcap" else (rrd, "write_rrd")
        monkeypatch.setattr(*where, failure)

    def test_of_one_log(
        self, shown: Path, tmp_path: Path, call: Call, monkeypatch: pytest.MonkeyPatch, kind: str, failure: Failure
    ) -> None:
        shutil.copytree(shown, tmp_path, dirs_exist_ok=True)
        whole = {path.name: path.read_bytes() for path in (tmp_path / "out/e").iterdir()}
        self.fails(monkeypatch, kind, failure)
        ended = call("run", "e.yaml", "--overwrite")
        assert ended.code == 1
        (line,) = ended.lines
        assert line.startswith(f"out/e/replay.{kind}: not written ({failure.reason}")
        assert line.endswith("); all other results are there")
        assert ended.out.count("95 % by") == 1, "the table"
        found = {path.name: path.read_bytes() for path in (tmp_path / "out/e").iterdir()}
        sealed = {"made.jsonl"} if kind == "rrd" else set()
        assert found.keys() == whole.keys() - {f"replay.{kind}"} - sealed
        same = found.keys() - {"replay.rrd", "provenance.json", "made.jsonl"}
        assert {name: found[name] for name in same} == {name: whole[name] for name in same}
        assert json.loads(found["provenance.json"])["files"] == sorted(found.keys() - {"made.jsonl"})
        assert os.listdir(tmp_path / "out") == ["e"]
        if failure is FAILURES[0]:  # the folder is the same after each
            assert call("report", "out/e").code == 0

    def test_of_several_logs_saved(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, failure: Failure
    ) -> None:
        monkeypatch.chdir(tmp_path)
        for name in "ab":
            drive(tmp_path / f"{name}.mcap")
        (tmp_path / "e.yaml").write_text(changed("logs: [a.mcap, b.mcap]", "show: {run: 0, logs: [all]}"))
        result = cr.run("e.yaml")
        self.fails(monkeypatch, kind, failure)
        with pytest.raises(OutputError) as raised:
            result.save("out")
        assert len(raised.value.problems) == 2
        assert raised.value.problems[1].startswith(f"out/replay/b.{kind}: not written ({failure.reason}")
        assert result.folder == Path("out")
        assert len(cr.load_results("out").detections) == len(result.detections)
        other = {"mcap": "rrd", "rrd": "mcap"}[kind]
        assert sorted(os.listdir("out/replay")) == [f"a.{other}", f"b.{other}"]


def test_where_no_export_is_written_no_folder_is_left_for_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in "ab":
        drive(tmp_path / f"{name}.mcap")
    (tmp_path / "e.yaml").write_text(changed("logs: [a.mcap, b.mcap]", "show: {run: 0, logs: [all]}"))
    result = cr.run("e.yaml")
    failing: Callable[..., Any] = FAILURES[0]
    monkeypatch.setattr(mcap, "write_mcap", failing)
    monkeypatch.setattr(rrd, "write_rrd", failing)
    with pytest.raises(OutputError):
        result.save("out")
    assert not Path("out/replay").exists()
    assert json.loads(Path("out/provenance.json").read_text())["files"] == sorted(os.listdir("out"))

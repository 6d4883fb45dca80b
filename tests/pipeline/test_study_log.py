"""Rows and digests are of one content: recordings that are replaced, grow or change, at every moment of a run."""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from mcap.writer import CompressionType

from copem_replay.core.errors import RecordingError, RemoteFile
from copem_replay.experiment import validate
from copem_replay.io import open as checksum
from copem_replay.io import recording
from copem_replay.pipeline import run as gather
from copem_replay.pipeline import study_log
from copem_replay.pipeline import study_log as log_survey
from tests.cli.test_api import cr
from tests.extras.test_crew import Shuffled
from tests.helpers.experiments import changed
from tests.helpers.object_storage import Bucket
from tests.helpers.recordings import Obj, write_recording
from tests.system.test_cli import Call, call

__all__ = ["call"]  # a fixture

WHEN_S = 1_700_000_000
MEASURE = "measure: {onset: {kind: in_range, range_m: 60}, horizon_s: 1}"
SHOWN = changed("show: {run: 0}", MEASURE)


def approach(path: Path, from_m: float) -> Path:
    """A car that drives towards the ego from so far away; the file has the same size from wherever. Of one old time."""
    frames = [(0.1 * k, [Obj(id=1, x=-0.5), Obj(id=2, x=from_m - k, vx=-10.0, yaw=math.pi)]) for k in range(31)]
    write_recording(path, frames, host=1, compression=CompressionType.NONE)
    os.utime(path, (WHEN_S, WHEN_S))
    return path


def in_place(path: Path, other: Path) -> None:
    """`rsync -t --inplace`: the same file with another content, of the same size and time."""
    path.write_bytes(other.read_bytes())
    os.utime(path, (WHEN_S, WHEN_S))


def by_name(path: Path, other: Path) -> None:
    """`mv`, `tar`: another file of the same size and time under the name."""
    shutil.copy2(other, other.with_suffix(".copy"))
    os.replace(other.with_suffix(".copy"), path)


def grown(path: Path, _: Path) -> None:
    """A recorder that goes on."""
    with path.open("ab") as file:
        file.write(b"\0" * 40)


REPLACED = pytest.mark.parametrize("replaced", [in_place, by_name], ids=lambda one: one.__name__)
CHANGED = pytest.mark.parametrize("happens", [in_place, by_name, grown], ids=lambda one: one.__name__)
Change = Callable[[Path, Path], None]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    approach(tmp_path / "drive.mcap", 70.0)
    approach(tmp_path / "other.mcap", 75.0)
    (tmp_path / "e.yaml").write_text(changed(MEASURE))
    one, two = (os.stat(tmp_path / f"{name}.mcap") for name in ("drive", "other"))
    assert (one.st_size, one.st_mtime_ns) == (two.st_size, two.st_mtime_ns)
    return tmp_path


def sha256(path: str | Path) -> str:
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def said(folder: str) -> tuple[list[str], list[str]]:
    """SHA-256 of the logs as results have them, in both places."""
    provenance = json.loads(Path(folder, "provenance.json").read_text())
    return [log["sha256"] for log in provenance["logs"]], pd.read_csv(f"{folder}/logs.csv")["sha256"].tolist()


def rows(folder: str) -> bytes:
    return Path(folder, "detections.parquet").read_bytes()


class TestReplaced:
    """By a recording of the same size and time of change."""

    @REPLACED
    def test_gives_the_rows_of_the_new_one_with_pieces(self, here: Path, call: Call, replaced: Change) -> None:
        assert call("run", "e.yaml", "--out", "old", "--pieces", "kept").code == 0
        replaced(here / "drive.mcap", here / "other.mcap")
        assert call("run", "e.yaml", "--out", "new", "--pieces", "kept").lines == [
            "pieces: 3 computed, 0 found in kept"
        ]
        assert call("run", "e.yaml", "--out", "plain").code == 0
        assert rows("new") == rows("plain") != rows("old")
        assert said("new") == said("plain") == ([sha256("other.mcap")],) * 2
        assert said("old") != said("new")

    @REPLACED
    def test_is_read_again_by_a_worker(self, here: Path, replaced: Change) -> None:
        cr.run("e.yaml", pieces="kept", crew=Shuffled()).save("old")
        replaced(here / "drive.mcap", here / "other.mcap")
        cr.run("e.yaml", pieces="kept", crew=Shuffled()).save("new")
        cr.run("e.yaml").save("plain")
        assert rows("new") == rows("plain") != rows("old")
        assert said("new") == ([sha256("other.mcap")],) * 2

    @REPLACED
    def test_where_nothing_but_the_content_tells_it_is_refused_and_forgotten(
        self, here: Path, call: Call, replaced: Change, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """A file system whose times and numbers of files stay as they are."""
        of = checksum.FileStamp.of
        monkeypatch.setattr(checksum.FileStamp, "of", lambda path: of(path)._replace(ctime_ns=0, inode=0))
        assert call("run", "e.yaml", "--out", "old", "--pieces", "kept").code == 0
        old = sha256("drive.mcap")
        replaced(here / "drive.mcap", here / "other.mcap")
        new = sha256("drive.mcap")
        next(Path("kept/parts").rglob("*.arrows")).unlink()  # which has to be computed
        line = (
            f"drive.mcap: expected the content that it had when it was read before, SHA-256 {old[:12]}…, found "
            f"{new[:12]}…; run the command again, and it is replayed as it is now"
        )
        assert call("run", "e.yaml", "--out", "new", "--pieces", "kept") == (2, "", [line])
        assert not Path("new").exists()
        assert call("run", "e.yaml", "--out", "new", "--pieces", "kept").code == 0
        assert call("run", "e.yaml", "--out", "plain").code == 0
        assert rows("new") == rows("plain")
        assert said("new") == ([new],) * 2

    @REPLACED
    def test_during_the_replay_the_digest_is_of_what_was_replayed(
        self, here: Path, call: Call, replaced: Change, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """And what would copy the other content is not written; the tables are there."""
        assert call("run", "e.yaml", "--out", "plain").code == 0
        (here / "e.yaml").write_text(SHOWN)
        old, outcomes = sha256("drive.mcap"), gather.replay_outcomes
        one_at_a_time = threading.Lock()  # blocks are replayed by several threads

        def meanwhile(*a: Any) -> Any:
            with one_at_a_time:
                replaced(here / "drive.mcap", here / "other.mcap")
            return outcomes(*a)

        monkeypatch.setattr(gather, "replay_outcomes", meanwhile)
        ended = call("run", "e.yaml", "--out", "out")
        assert ended.code == 1
        assert ended.lines == [
            "out/replay.mcap: not written (drive.mcap: it is no longer what was replayed); all other results are there"
        ]
        assert rows("out") == rows("plain")
        assert said("out") == ([old],) * 2
        assert not Path("out/replay.mcap").exists()
        assert Path("out/replay.rrd").exists()

    @REPLACED
    def test_between_two_readings_of_a_log_that_does_not_stay_in_memory(
        self, here: Path, call: Call, replaced: Change, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        shutil.copy2(here / "drive.mcap", here / "first.mcap")
        (here / "e.yaml").write_text(changed("logs: [first.mcap, drive.mcap]"))
        monkeypatch.setattr(log_survey, "STATES_HELD", 0)
        dropped = study_log.drop_content

        def meanwhile(*a: Any) -> Any:
            left = dropped(*a)
            replaced(here / "drive.mcap", here / "other.mcap")
            return left

        monkeypatch.setattr(study_log, "drop_content", meanwhile)
        ended = call("run", "e.yaml", "--out", "out")
        assert (ended.code, len(ended.lines)) == (2, 1)
        assert ended.lines[0].startswith("drive.mcap: expected the content that it had when it was read before, ")
        assert not Path("out").exists()


def test_a_stamp_tells_times_a_nanosecond_apart(tmp_path: Path) -> None:
    (path := tmp_path / "a").write_bytes(b"x")
    os.utime(path, ns=(0, 1_700_000_000_000_000_001))
    before = checksum.FileStamp.of(path)
    os.utime(path, ns=(0, 1_700_000_000_000_000_002))
    assert (before.mtime_ns, checksum.FileStamp.of(path).mtime_ns - before.mtime_ns) == (1_700_000_000_000_000_001, 1)


class TestWhileItIsRead:
    """One line, exit code 2, no results: else rows could be of another content than the digest."""

    def refused(self, here: Path, call: Call, happens: Change, *command: str) -> None:
        size = (here / "drive.mcap").stat().st_size
        ended = call(*command)
        found = (
            f"{size} bytes then, {size + 40} now"
            if happens is grown
            else "of the same size, but written or replaced since"
        )
        line = f"it has changed since it began to be read ({found}); wait until nothing writes it, then read it again"
        assert ended.code == 2
        assert len(ended.lines) == 1
        assert ended.lines[0].endswith(f"drive.mcap: {line}")
        assert not Path("out").exists()

    @CHANGED
    @pytest.mark.parametrize("command", ["run", "check"])
    def test_after_it_was_opened(
        self, here: Path, call: Call, happens: Change, command: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        opened = recording.open_log

        def meanwhile(at: Any) -> Any:
            log = opened(at)
            happens(here / "drive.mcap", here / "other.mcap")
            return log

        monkeypatch.setattr(recording, "open_log", meanwhile)
        self.refused(here, call, happens, command, "e.yaml")

    @CHANGED
    def test_between_the_truth_and_the_lists_of_units(
        self, here: Path, call: Call, happens: Change, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        read = validate.read_log

        def meanwhile(*a: Any, **k: Any) -> Any:
            found = read(*a, **k)
            happens(here / "drive.mcap", here / "other.mcap")
            return found

        monkeypatch.setattr(validate, "read_log", meanwhile)
        self.refused(here, call, happens, "run", "e.yaml")

    @CHANGED
    @pytest.mark.parametrize("skipped", [False, True])
    def test_before_its_digest_is_taken(
        self, here: Path, call: Call, happens: Change, skipped: bool, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        digest = study_log.sha256_of

        def meanwhile(at: Path) -> str:
            if at.name == "drive.mcap":
                happens(here / "drive.mcap", here / "other.mcap")
            return digest(at)

        monkeypatch.setattr(study_log, "sha256_of", meanwhile)
        if not skipped:
            self.refused(here, call, happens, "run", "e.yaml")
            return
        ended = call("run", "e.yaml", "--log", "drive.mcap", "--log", "other.mcap", "--skip-unreadable", "--out", "out")
        assert ended.code == 1
        assert "drive.mcap: skipped: it has changed since it began to be read" in "\n".join(ended.lines)
        assert said("out")[0] == [sha256("other.mcap")]

    @CHANGED
    def test_a_recording_in_memory_is_not_saved_under_another_digest(self, here: Path, happens: Change) -> None:
        read = cr.read_recording("drive.mcap")
        result = cr.run("e.yaml", read)
        happens(here / "drive.mcap", here / "other.mcap")
        with pytest.raises(RecordingError, match=r"drive\.mcap: it has changed since it began to be read"):
            result.save("out")
        assert not Path("out").exists()

    def test_damage_that_only_comes_of_it_is_said_as_what_it_is(
        self, here: Path, call: Call, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        opened = recording.open_log

        def meanwhile(at: Any) -> Any:
            log = opened(at)
            at.write_bytes(b"")
            return log

        monkeypatch.setattr(recording, "open_log", meanwhile)
        ended = call("run", "e.yaml")
        assert (ended.code, len(ended.lines)) == (2, 1)
        assert "it has changed since it began to be read" in ended.lines[0]


def test_a_log_that_is_gone_after_it_was_read_is_not_needed(here: Path, call: Call, monkeypatch: Any) -> None:
    old, outcomes = sha256("drive.mcap"), gather.replay_outcomes
    monkeypatch.setattr(
        gather, "replay_outcomes", lambda *a: [(here / "drive.mcap").unlink(missing_ok=True), outcomes(*a)][1]
    )
    assert call("run", "e.yaml", "--out", "out").code == 0
    assert said("out") == ([old],) * 2


class TestUnderAUrl:
    def test_that_changes_while_it_is_copied(self, here: Path, bucket: Bucket, monkeypatch: pytest.MonkeyPatch) -> None:
        url = bucket.put(here / "drive.mcap", "drive.mcap")
        fetch = RemoteFile.fetch

        def meanwhile(log: RemoteFile, to: str) -> None:
            fetch(log, to)
            bucket.put(here / "other.mcap", "drive.mcap")

        monkeypatch.setattr(RemoteFile, "fetch", meanwhile)
        with pytest.raises(Exception, match=r"drive\.mcap: it changed while it was copied; run the command again"):
            cr.run("e.yaml", url, pieces="kept")
        assert not list(Path("kept/logs").iterdir())

    def test_that_is_another_when_it_is_copied_for_the_replay(
        self, here: Path, bucket: Bucket, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        url, old = bucket.put(here / "drive.mcap", "drive.mcap"), sha256("drive.mcap")
        (here / "e.yaml").write_text(SHOWN)
        result = cr.run("e.yaml", url)
        bucket.put(here / "other.mcap", "drive.mcap")
        with pytest.raises(Exception, match=r"replay\.mcap: not written \(.*drive\.mcap: it is no longer what was re"):
            result.save("out")
        assert said("out") == ([old],) * 2

    def test_a_time_that_its_writer_says_tells_nothing(self) -> None:
        assert RemoteFile("sftp://host/a.mcap", {"size": 7, "mtime": WHEN_S}).stamp is None
        assert RemoteFile("s3://bucket/a.mcap", {"size": 7, "ETag": "x"}).stamp == (7, "x")

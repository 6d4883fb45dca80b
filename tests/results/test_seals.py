"""Results know their bytes: one flipped bit anywhere in a folder, and every reader refuses, or says what it said.

Who reads the recordings of results goes through their digest: replaced or gone, they are refused with both ways out.
"""

from __future__ import annotations

import gc
import hashlib
import json
import math
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

import copem_replay as cr
from copem_replay.core.errors import InputError
from copem_replay.results.provenance import read_provenance
from copem_replay.results.read import open_results
from copem_replay.results.seals import check_sealed
from copem_replay.results.verdicts import write_verdicts
from tests.helpers.compare_folders import flip, places, unseal
from tests.helpers.experiments import changed, drive
from tests.helpers.recordings import Obj, write_recording
from tests.system.test_cli import Call, call, run_in

pytestmark = pytest.mark.extras  # readers that are extras are asked, too

__all__ = ["call", "run_in"]  # fixtures

PLAN = changed(
    "measure: {onset: {kind: in_range, range_m: 60}, horizon_s: 2, exact: true, by: [class],"
    " began: [log_start, crossed, appeared]}",
    "sweep: {latency_s: [0.1, 0.5]}",
    "criteria: {soon: {metric: detected_share, at_least: 0.1, population: these_logs, configurations: [PEM]}}",
    "show: {run: 0}",
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results with every kind of file, as `run` leaves them."""
    here = tmp_path_factory.mktemp("made")
    drive(here / "drive.mcap")
    (here / "e.yaml").write_text(PLAN)
    out = cr.run(here / "e.yaml", jobs=1).save(here / "out")
    write_verdicts(cr.judge(out), out / "verdicts.jsonl")
    return out


@pytest.fixture
def folder(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of them beside their recording, in which the test may damage what it likes."""
    shutil.copytree(made.parent, tmp_path / "copy")
    monkeypatch.chdir(tmp_path / "copy")
    return Path("out")


SEALED = (
    "experiment.yaml", "detections.parquet", "tally.parquet", "summary.csv", "summary_by.csv", "exact.parquet",
    "sweep.csv", "accuracy.parquet", "false_tracks.parquet", "instants.parquet", "lists.parquet", "thresholds.parquet",
    "bands.csv", "logs.csv",
    "read.csv", "replay.mcap",
)  # fmt: skip
READERS: dict[str, tuple[str, ...]] = {
    "compare": ("compare", "out"),
    "compare by": ("compare", "out", "--by", "class", "--out", "table.csv"),
    "compare in the viewer": ("compare", "out", "--rrd", "one.rrd"),
    "report": ("report", "out", "--out", "report.html"),
    "plot": ("plot", "out", "--out", "figures"),
    "verdict": ("verdict", "out", "--jsonl", "verdicts.jsonl"),
    "why": ("why", "out", "--causes", "--out", "why"),
    "film": ("film", "out", "--out", "film.gif"),
    "export": ("export", "out", "--trackeval", "--out", "boxes"),
    "history": ("history", "out", "--out", "history.html"),
}
"""The commands that read a results folder, all their outputs beside it."""


def said_by(call: Call, words: tuple[str, ...]) -> tuple[int, list[str], list[str], dict[str, bytes]]:
    """Exit code, what is printed, and what is written but recordings for Rerun, whose bytes are others each time."""
    ended = call(*words)
    written = {
        str(path): path.read_bytes()
        for path in sorted(Path().rglob("*"))
        if path.is_file() and path.suffix not in (".rrd", ".mcap") and "out" not in path.parts and path.name != "e.yaml"
    }
    for path in written:
        Path(path).unlink()
    return ended.code, ended.out, ended.lines, written


def test_every_file_is_sealed_and_two_runs_have_the_same_provenance(made: Path, tmp_path: Path) -> None:
    seals = read_provenance(made / "provenance.json").seals
    assert sorted(seals) == sorted(SEALED)
    rerun = hashlib.sha256((made / "replay.rrd").read_bytes()).hexdigest()
    assert (made / "made.jsonl").read_text().splitlines()[0] == f'{{"replay.rrd": "{rerun}"}}'
    assert {path.name for path in made.iterdir()} - {*SEALED} == {
        "provenance.json", "replay.rrd", "verdicts.jsonl", "made.jsonl",
    }  # fmt: skip
    (tmp_path / "out").mkdir()
    for name in ("drive.mcap", "e.yaml"):
        shutil.copy(made.parent / name, tmp_path)
    again = cr.run(tmp_path / "e.yaml", jobs=2).save(tmp_path / "out")
    assert (again / "provenance.json").read_bytes() == (made / "provenance.json").read_bytes()


@pytest.mark.parametrize("asked", ["out", "out/replay.rrd"])
def test_the_viewer_opens_the_recording_that_was_written_alone(
    call: Call, folder: Path, asked: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = list[list[Path]]()
    monkeypatch.setattr("copem_replay.viewer.open.open_viewer", lambda files, _: opened.append(files) or 0)
    content = (folder / "replay.rrd").read_bytes()
    for bit in places(folder / "replay.rrd", 5):
        flip(folder / "replay.rrd", bit)
        ended = call("view", asked)
        assert (ended.code, len(ended.lines)) == (2, 1)
        assert ended.lines[0].startswith("out/replay.rrd: expected the file that was written, SHA-256 ")
        (folder / "replay.rrd").write_bytes(content)
    assert opened == []
    assert call("view", asked).code == 0
    (folder / "replay.rrd").rename("elsewhere.rrd")  # a file of nobody's results has no seal
    (folder / "mine.rrd").write_bytes(content)
    assert [call("view", name).code for name in ("elsewhere.rrd", "out/mine.rrd")] == [0, 0]
    assert [file.name for (file,) in opened] == ["replay.rrd", "elsewhere.rrd", "mine.rrd"]


@pytest.mark.parametrize("reader", READERS)
def test_no_reader_takes_a_flipped_bit_for_a_number(
    call: Call, folder: Path, reader: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = {"provenance.json"}

    def watched(place: Path, name: str, seals: dict[str, str]) -> None:
        read.add(name)
        check_sealed(place, name, seals)

    monkeypatch.setattr("copem_replay.results.read.check_sealed", watched)
    right = said_by(call, READERS[reader])
    assert right[0] == 0
    assert ({"summary.csv"} if reader == "history" else {"detections.parquet", "experiment.yaml"}) <= read
    for name in sorted(read):
        content = (folder / name).read_bytes()
        flip(folder / name, places(folder / name, 5)[3])
        code, _, lines, written = said_by(call, READERS[reader])
        (folder / name).write_bytes(content)
        assert (code, written) == (2, {}), (name, lines)
        assert re.match(rf"{folder}/{name}: expected .*, found .*; ", lines[-1])
        assert all(line.startswith("note: ") for line in lines[:-1])
    for name in {*SEALED} - read:
        flip(folder / name, places(folder / name, 5)[3])
    assert said_by(call, READERS[reader]) == right, "what is not read changes nothing"


@pytest.mark.parametrize("name", [name for name in SEALED if name != "replay.mcap"])
def test_a_bit_anywhere_in_a_file_is_found(folder: Path, name: str) -> None:
    content = (folder / name).read_bytes()
    for bit in places(folder / name, 40):
        flip(folder / name, bit)
        with pytest.raises(InputError, match=rf"^out/{name}: expected the file that was written, SHA-256 "):
            read_all(folder, name)
        (folder / name).write_bytes(content)
    read_all(folder, name)


def read_all(folder: Path, name: str) -> object:
    """What results have of one file."""
    results = open_results(folder)
    if name == "experiment.yaml":
        return results.experiment
    return results.log_rows(name) if name.endswith(".parquet") else results.frame(name)


def test_a_bit_anywhere_in_the_provenance_is_found_or_changes_nothing(folder: Path) -> None:
    file = folder / "provenance.json"
    right, content = read_provenance(file), file.read_bytes()
    unsealed, refused = 0, list[str]()
    for bit in range(0, 8 * len(content), 5):
        flip(file, bit)
        try:
            found = read_provenance(file)
        except InputError as error:
            refused.append(str(error))
        else:  # the key of the seals itself: as if an older version had written it
            assert {**vars(found), "seals": 0, "data": 0} == {**vars(right), "seals": 0, "data": 0}
            unsealed += 1
        file.write_bytes(content)
    assert unsealed <= 8 * len("sha256")
    assert all(line.startswith((f"{file}: expected ", f"{folder}: expected results of format 6")) for line in refused)


@pytest.mark.parametrize("name", ["provenance.json", "detections.parquet"])
def test_the_viewer_does_not_open_on_a_flipped_bit(folder: Path, name: str) -> None:
    flip(folder / name, places(folder / name, 5)[3])
    with pytest.raises(InputError, match=rf"^out/{name}: expected .*, found .*; "):
        cr.view(folder, object_id="2")


def test_what_a_user_may_do_in_the_folder_is_no_damage(call: Call, folder: Path) -> None:
    right = said_by(call, READERS["compare"])
    (folder / "notes.txt").write_text("mine")
    for name in ("replay.rrd", "replay.mcap", "summary_by.csv", "sweep.csv", "exact.parquet"):
        (folder / name).unlink()
    (folder / "provenance.json").write_text(json.dumps(json.loads((folder / "provenance.json").read_text())))
    assert said_by(call, READERS["compare"]) == right
    assert cr.load_results(folder).sweep is None


def test_a_table_of_other_results_is_refused(folder: Path) -> None:
    said = json.loads((folder / "provenance.json").read_text())
    cr.run(changed_plan(folder), jobs=1).save("other")
    shutil.copy("other/accuracy.parquet", folder)
    with pytest.raises(InputError, match=r"accuracy.parquet: expected the file that was written"):
        cr.compare(folder)
    (folder / "accuracy.parquet").unlink()
    assert "accuracy.parquet" in said["files"]
    shutil.copy(folder / "bands.csv", "other/sweep.csv")
    with pytest.raises(InputError, match=r"sweep.csv: expected no such file among these results, found one; give it"):
        cr.load_results("other")


def changed_plan(folder: Path) -> str:
    text = (folder.parent / "e.yaml").read_text()
    kept = [line for line in text.splitlines() if not line.startswith("sweep")]
    (folder.parent / "other.yaml").write_text("\n".join(kept).replace("seed: 1", "seed: 2"))
    return "other.yaml"


def test_a_log_of_a_large_table_that_is_gone_is_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("copem_replay.results.write.MANY_ROWS", 3)
    many = cr.run("e.yaml", jobs=1).save("many")
    assert len(cr.load_results(many).detections) > 0
    (many / "detections.parquet/drive.parquet").unlink()
    with pytest.raises(InputError, match=r"detections.parquet/drive.parquet: expected a file of the results, found No"):
        cr.load_results(many)


def test_results_of_an_older_version_are_read(folder: Path) -> None:
    unseal(folder)
    assert read_provenance(folder / "provenance.json").seals == {}
    assert len(cr.load_results(folder).detections) > 0


# What a run gives is a folder, too.


def test_what_a_run_gives_is_what_its_folder_gives(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran, again, saved = cr.run("e.yaml", jobs=1), cr.run("e.yaml", jobs=1), cr.load_results(folder)
    for names in (("summary", "detections"), ("summary", "detections", "tally", "exact", "sweep", "accuracy", "bands")):
        for name in names:  # those of the scratch folder, later those of the folder it was saved to
            pd.testing.assert_frame_equal(getattr(ran, name), getattr(saved, name), check_exact=True)
        assert ran.source.data["seed"] == saved.source.data["seed"]
        ran.save("first", overwrite=True)
        ran.save("first", overwrite=True)
    monkeypatch.chdir("first")
    assert len(ran.frame("tally.parquet")) == len(saved.tally)
    assert cr.compare(ran).table.equals(cr.compare(again).table)


def test_a_scratch_folder_goes_with_its_results(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    ran = cr.run("e.yaml", jobs=1)
    assert not list(tmp_path.glob("copem-replay-*"))
    assert len(ran.summary) == 3
    assert len(list(tmp_path.glob("copem-replay-*"))) == 1
    del ran
    gc.collect()
    assert not list(tmp_path.glob("copem-replay-*"))


# Who reads a log.


def replaced(log: Path) -> None:
    """Another drive takes the name of the log: what `why` says of it would be plausible."""
    frames = [
        (0.1 * k, [Obj(id=1), Obj(id=2, x=62.0 - k, vx=-10.0, yaw=math.pi), Obj(id=3, y=30.0, stationary=True)])
        for k in range(31)
    ]
    write_recording(log, frames, host=1)


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (replaced, "drive.mcap: expected the log that was replayed, SHA-256 "),
        (Path.unlink, "drive.mcap: cannot be opened: No such file or directory"),
    ],
)
@pytest.mark.parametrize("reader", ["why", "film", "export", "compare in the viewer", "plot", "geojson", "report"])
def test_a_log_that_is_not_the_one_is_explained_by_nobody(
    call: Call, folder: Path, reader: str, change: Callable[[Path], None], found: str
) -> None:
    out = "put the log back (a link to it does), or run the experiment again"
    change(Path("drive.mcap"))
    words = READERS.get(reader, ("export", "out", "--geojson", "--out", "geo"))
    code, _, lines, written = said_by(call, words)
    if reader == "report":  # which is of the tables; a page is the same wherever its folder lies
        page = written["report.html"].decode()
        assert code == 0
        assert page.count("the recording is not there as it was") > 0
        return
    said = [line for line in lines if found in line]
    assert said
    assert all(line.endswith(out) for line in said)
    if reader == "plot":
        assert not [name for name in written if "late_paths" in name or "runs" in name]
    else:
        assert (code, written) == (2, {})


def test_a_link_to_the_log_is_a_way_out(call: Call, folder: Path) -> None:
    right = said_by(call, READERS["why"])
    Path("elsewhere").mkdir()
    Path("drive.mcap").rename("elsewhere/drive.mcap")
    Path("drive.mcap").symlink_to("elsewhere/drive.mcap")
    assert said_by(call, READERS["why"]) == right
    assert right[0] == 0


def test_results_are_explained_in_python(folder: Path) -> None:
    of_folder = cr.why(folder, parts=["causes"])
    of_results = cr.why(cr.load_results(folder), parts=["causes"])
    of_experiment = cr.why("e.yaml", parts=["causes"])
    for one in (of_folder, of_results):
        assert one.causes is not None
        assert one.causes.equals(of_experiment.causes)
    with pytest.raises(InputError, match="expected its own recordings, found others"):
        cr.why(folder, "drive.mcap")

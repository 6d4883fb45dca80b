"""What is odd about a log and an experiment is said by `check` in the words of `run`, and before it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest

from copem_replay.core.errors import ExperimentError
from copem_replay.experiment.file import log_paths
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import find_problems, read_logs
from copem_replay.io.recording import Recording
from copem_replay.pipeline import cost as memory
from copem_replay.pipeline import notes
from copem_replay.pipeline.notes import list_notes
from copem_replay.pipeline.prepare import Replay, prepare_log
from copem_replay.pipeline.run import run_experiment
from tests.helpers import scenes
from tests.helpers.experiments import TEXT, changed, drive, source_of
from tests.helpers.recordings import Obj, write_recording
from tests.helpers.scenes import Thing, experiment, standing

MAST = "  mast: {{at: {at}, yaw_deg: {yaw}, height_m: 5.0, pem: onboard}}"


def made(folder: Path, text: str) -> tuple[Experiment, list[Recording], list[Replay]]:
    source = source_of(folder, text)
    experiment, found = find_problems(source)
    assert experiment is not None, found
    recordings, refused = read_logs(experiment, log_paths(source)[0], source)
    assert (found, refused) == ([], [])
    return experiment, recordings, [prepare_log(recording, experiment) for recording in recordings]


def before(folder: Path, text: str) -> list[str]:
    experiment, recordings, ready = made(folder, text)
    return list_notes(recordings, ready, experiment, replayed=False)


def after(folder: Path, text: str) -> list[str]:
    experiment, recordings, _ = made(folder, text)
    return [note for note in run_experiment(experiment, recordings).notes if not note.startswith("no interval")]


@pytest.fixture
def here(tmp_path: Path) -> Path:
    drive(tmp_path / "drive.mcap")
    return tmp_path


def couple(when: str) -> str:
    return f"    - when: {when}"


UNMET = "no object ever meets a condition of its PEM 'onboard'"
BOTH = [f"drive: unit ego: {UNMET}", f"drive: unit mast: {UNMET}"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (TEXT.splitlines()[0], []),
        ("  coPEM: {units: all, latency_s: 3.01}",
         ["drive: configuration coPEM: the latency of ego, mast is longer than the log"]),
        ("  coPEM: {units: all, latency_s: {mast: 4}}",
         ["drive: configuration coPEM: the latency of mast is longer than the log"]),
        ("measure: {onset: {kind: at, time_s: 99}}",
         ["drive: no rows: the onset at 99 s lies after the log's end, 3 s"]),
        ("measure: {objects: {classes: [truck]}}",
         ["drive: no rows: nothing to measure (truck); the log has car, other beside the ego"]),
        # From the ego the parked car is 30 m away at 90°, the other one 40 to 70 m at 0°.
        (couple("{range_m: [0, 20]}"), BOTH[:1]),  # the mast, at (12, −4.5), has the ego 12.8 m away
        (couple("{range_m: [0, 5]}"), BOTH),
        (couple("{range_m: [71, 1000]}"), BOTH),
        (couple("{azimuth_deg: [-170, -160]}"), BOTH),
        (couple("{azimuth_deg: [-0.001, 0.001], range_m: [0, 39]}"), BOTH),  # degrees that were radians
        (couple("{classes: [pedestrian]}"), BOTH),
        (couple("{classes: [car]}"), []),
        (MAST.format(at="[12.0, 5000.0]", yaw=0).replace("pem:", "ground_z_m: 0, pem:"),
         ["drive: unit mast: its place [12, 5000] is 4.97 km away from all objects, which are within x 0 … 70 m, "
          "y 0 … 30 m", f"drive: unit mast: {UNMET}"]),
        (MAST.format(at="[500000.0, 0.0]", yaw=0),
         ["drive: unit mast: ground taken from the nearest object, 499930 m away (give ground_z_m)",
          "drive: unit mast: its place [500000, 0] is 500 km away from all objects, which are within x 0 … 70 m, "
          "y 0 … 30 m", f"drive: unit mast: {UNMET}"]),
        (MAST.format(at="[1900.0, 0.0]", yaw=0).replace("pem:", "ground_z_m: 0, rate_hz: 5, pem:"),
         [f"drive: unit mast: {UNMET}"]),
    ],
)  # fmt: skip
def test_check_says_it_as_run_does(here: Path, change: str, said: list[str]) -> None:
    assert before(here, changed(change)) == said
    assert after(here, changed(change)) == said


HOUSES = """obstacles:
- {polygon_m: [[38, -3], [48, -3], [48, 3], [38, 3]], height_m: 9}
- {polygon_m: [[-9, 29], [9, 40], [-9, 40]], height_m: 9}"""


def test_objects_in_obstacles_are_said_in_one_note(here: Path) -> None:
    """The other car comes from x = 70 to 40 m in 3 s: its centre is in the first from 47 m on, 8 frames of .1 s.

    The parked car, at (0, 30), is not in the second, a triangle, but in the box around it, all along.
    """
    said = ["drive: obstacle 0: object 2 is inside it for 0.8 s: hidden there"]
    assert before(here, changed(HOUSES)) == said == after(here, changed(HOUSES))
    both = HOUSES.replace("[9, 40]", "[9, 29], [9, 40]")
    said = [f"{said[0]}; obstacle 1: object 3 is inside it for 3.1 s: hidden there"]
    assert before(here, changed(both)) == said == after(here, changed(both))
    low = HOUSES.replace("height_m: 9", "height_m: 0.7")
    assert before(here, changed(low)) == [], "a car's centre, at .75 m, is above it"


def test_what_is_said_of_many_logs_is_one_line(here: Path) -> None:
    """Of four names of a drive, and of three: there each has its line."""
    for name in "ace":
        (here / f"{name}.mcap").hardlink_to(here / "drive.mcap")
    text = changed("logs: ['*.mcap']", couple("{range_m: [0, 5]}"))
    said = [f"a, c, drive and 1 other log: unit {unit}: {UNMET}" for unit in ("ego", "mast")]
    assert before(here, text) == after(here, text) == said
    (here / "e.mcap").unlink()
    each = [f"{log}: unit {unit}: {UNMET}" for log in ("a", "c", "drive") for unit in ("ego", "mast")]
    assert before(here, text) == after(here, text) == each


@pytest.mark.parametrize("rows", [1, 7, 1000])
@pytest.mark.parametrize("sample", [1, 5, 1000])
@pytest.mark.parametrize("rate", ["", ", rate_hz: 10"])
@pytest.mark.parametrize(
    ("when", "unmet"),
    [
        ("{range_m: [69.9, 71], azimuth_deg: [-1, 1]}", "mast"),  # the oncoming car in the first frame
        ("{range_m: [39.9, 40.5], azimuth_deg: [-1, 1]}", "mast"),  # in the last one
        ("{range_m: [54.9, 55.1], azimuth_deg: [-1, 1]}", "mast"),  # in the middle
        ("{range_m: [12, 13], azimuth_deg: [159, 160]}", "ego"),  # the ego itself, from the mast
        ("{range_m: [29.9, 30.1], azimuth_deg: [90, 90]}", "mast"),
    ],
)
def test_a_single_encounter_is_found_wherever_it_is(
    here: Path, monkeypatch: pytest.MonkeyPatch, rows: int, sample: int, rate: str, when: str, unmet: str
) -> None:
    monkeypatch.setattr(notes, "_ROWS", rows)
    monkeypatch.setattr(notes, "_SAMPLE", sample)
    ego = f"  ego: {{on: ego, height_m: 1.8, pem: onboard{rate}}}"
    assert before(here, changed(couple(when), ego)) == [f"drive: unit {unmet}: {UNMET}"]


def test_what_only_a_replay_can_tell_is_said_by_run_alone(here: Path) -> None:
    """Behind an obstacle nothing has a visible share: who hides whom is not looked at before."""
    wall = "obstacles: [{polygon_m: [[3, -9], [4, -9], [4, 9], [3, 9]], height_m: 50}]"
    text = changed(couple("{visible_share: [0.1, 1], azimuth_deg: [-45, 45]}"), "  mast: {on: 3, pem: onboard}", wall)
    assert f"drive: unit ego: {UNMET}" not in before(here, text)
    assert f"drive: unit ego: {UNMET}" in after(here, text)


def fleet(folder: Path, *, far: int) -> str:
    """An ego, three cars around it, and `far` cars a kilometre away and from each other."""
    cars = [Obj(id=2 + k, x=10.0 * k, y=10.0) for k in range(3)]
    cars += [Obj(id=10 + k, x=1000.0 * (k + 1), y=500.0) for k in range(far)]
    write_recording(folder / "drive.mcap", [(k / 10, [Obj(id=1), *cars]) for k in range(5)], host=1)
    return changed(
        "  mast: {on: {classes: [car], penetration_rate: 0.5}, pem: onboard}",
        "measure: {onset: {kind: appears}, began: [log_start], horizon_s: 0.4}",
    ).replace(", latency_s: 0.5", "")


@pytest.mark.parametrize("rate", ["", ", rate_hz: 7"])
def test_a_fleet_is_said_in_one_line(tmp_path: Path, rate: str) -> None:
    text = fleet(tmp_path, far=17).replace("pem: onboard}\nconf", f"pem: onboard{rate}}}\nconf")
    expected = [f"drive: unit mast, on 17 of its 20 carriers: {UNMET}"]
    assert before(tmp_path, text) == expected
    assert after(tmp_path, text) == expected


def test_a_fleet_of_one(tmp_path: Path) -> None:
    frames = [(k / 10, [Obj(id=1), Obj(id=2, x=300.0)]) for k in range(5)]
    write_recording(tmp_path / "drive.mcap", frames, host=1)
    text = changed(
        "  mast: {on: {classes: [car], penetration_rate: 1}, pem: onboard}",
        "measure: {onset: {kind: appears}, began: [log_start], horizon_s: 0.4}",
    )
    assert before(tmp_path, text)[1] == f"drive: unit mast, on 1 of its 1 carrier: {UNMET}"


def test_a_log_that_is_named_twice(here: Path) -> None:
    drive(here / "other.mcap")
    (here / "link.mcap").symlink_to("drive.mcap")
    text = changed("logs: ['d*.mcap', other.mcap, drive.mcap, link.mcap]")
    expected = ["drive: named more than once (logs[0], logs[2], logs[3]): replayed once"]
    assert before(here, text) == expected
    assert after(here, text) == expected


def test_notes_of_the_recording_are_among_them(tmp_path: Path) -> None:
    frames = [(k / 10, [Obj(id=1), Obj(id=2, x=30.0, vx=None)]) for k in range(5)]
    write_recording(tmp_path / "drive.mcap", frames, host=1)
    found = before(tmp_path, TEXT)
    assert found
    assert found == after(tmp_path, TEXT)[: len(found)]


def raises_no_such_file() -> None:
    raise FileNotFoundError("/proc/meminfo")


def with_free(monkeypatch: pytest.MonkeyPatch, free: int | None) -> None:
    monkeypatch.setattr(memory, "free_bytes", lambda: free)


class TestMemory:
    """One object has an onset: in three configurations three rows a run, of 1000 bytes, or 250 at least, 400 with
    accuracy; and 31 views of 400 bytes by each of two units, whatever the number of runs."""

    VIEWS = 31 * 2 * 400

    def rows(self, here: Path) -> tuple[Experiment, list[Replay]]:
        experiment, _, ready = made(here, changed("runs: 1000000", "measure: {accuracy: false}"))
        assert [len(replay.episodes.object_ix) for replay in ready] == [1]
        return experiment, ready

    def test_enough(self, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        experiment, ready = self.rows(here)
        for free in (None, 3_000_000_000 + self.VIEWS):
            with_free(monkeypatch, free)
            assert memory.memory_notes(ready, experiment) == []

    def test_perhaps_not(self, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        experiment, ready = self.rows(here)
        for free in (2_999_999_999 + self.VIEWS, 750_000_000):
            with_free(monkeypatch, free)
            (said,) = memory.memory_notes(ready, experiment)
            assert said == f"1000000 runs of 3 rows each may take 3 GB, and {free / 1e9:.3g} GB are free"

    def test_certainly_not(self, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        experiment, ready = self.rows(here)
        with_free(monkeypatch, 749_999_999)
        said = "^1000000 runs of 3 rows each take at least 0.75 GB, and 0.75 GB are free; take 249999 or fewer$"
        with pytest.raises(ExperimentError, match=said):
            memory.memory_notes(ready, experiment)

    def test_by_units(self, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """3000 masts: 3002 units look at one object at 31 frames, in a single run."""
        masts = "".join(f"  m{k}: {{at: [{k}, 9], height_m: 5.0, pem: onboard}}\n" for k in range(3000))
        text = changed("runs: 1").replace("configurations:", f"{masts}configurations:")
        experiment, _, ready = made(here, text)
        with_free(monkeypatch, 31 * 3002 * 400)
        (said,) = memory.memory_notes(ready, experiment)
        assert said == "1 runs of 3 rows each may take 0.0372 GB, and 0.0372 GB are free"
        with_free(monkeypatch, 31 * 3002 * 400 + 3000)
        assert memory.memory_notes(ready, experiment) == []

    def test_run_refuses_before_it_begins(self, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        experiment, recordings, _ = made(here, changed("runs: 1000000000"))
        with pytest.raises(ExperimentError, match=r"1000000000 runs of 3 rows each take at least 1\.2e\+03 GB"):
            run_experiment(experiment, recordings)

    def test_what_is_free(self, monkeypatch: pytest.MonkeyPatch) -> None:
        files: dict[str, Any] = {}
        monkeypatch.setattr(memory, "_read_text", lambda path: files.get(path, ""))
        monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(total=9 * 1024, available=6 * 1024))
        monkeypatch.setattr(psutil, "swap_memory", lambda: SimpleNamespace(total=9 * 1024, free=1024))
        assert memory.free_bytes() == 7 * 1024
        group = "/sys/fs/cgroup/memory."
        files |= {f"{group}max": "5000\n", f"{group}current": "4000\n", f"{group}stat": "anon 3500\nfile 400\n"}
        assert memory.free_bytes() == 1400
        files[f"{group}max"] = "max\n"
        assert memory.free_bytes() == 7 * 1024
        monkeypatch.setattr(psutil, "virtual_memory", raises_no_such_file)
        assert memory.free_bytes() is None

    def test_without_what_unix_says(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Elsewhere the peak is what the system says, if it does."""
        monkeypatch.setattr(memory, "resource", None)
        assert memory.free_bytes() is not None
        for told, peak in ((SimpleNamespace(rss=5, peak_wset=7), 7), (SimpleNamespace(rss=5), None)):
            monkeypatch.setattr(psutil, "Process", lambda told=told: SimpleNamespace(memory_info=lambda: told))
            assert memory.peak_bytes() == peak


# ------------------------------------------------------------------------------- what is seen by nobody, or by nothing


SURE = {"detection": {"kind": "constant", "probability": 1.0}}
MEASURED = {"onset": {"kind": "appears"}, "began": ["log_start", "appeared"], "horizon_s": 1.0}
NEAR = {"kind": "field", "range_m": [5, 30]}


def street(**changes: Any) -> list[str]:
    """Notes on a car, a truck and a pedestrian some 50 m from a mast, with the ego 100 m from it."""
    things = [
        Thing("ego", "car", standing(100, 0)),
        Thing("a", "car", standing(50, 0)),
        Thing("b", "truck", standing(60, 0)),
        Thing("c", "pedestrian", standing(55, 5)),
    ]
    mast = {"at": [0, 0], "height_m": 5, "pem": "eye"}
    data: dict[str, Any] = {
        "pems": {"eye": [SURE], "haunted": {"couples": [SURE], "ghosts": [{"in_list": 0.5, "where": NEAR}]}},
        "units": {"mast": mast, "ego": {"on": "ego", "pem": "eye"}},
        "configurations": {"ideal": {"units": "all"}, "gnn": {"units": "all", "fusion": {"kind": "gnn"}}},
        "measure": MEASURED,
    }
    plan = experiment(**(data | changes))
    recording = scenes.recording(things, until_s=1.0)
    found = list_notes([recording], [prepare_log(recording, plan)], plan, replayed=False)
    assert [note for note in run_experiment(plan, [recording]).notes if not note.startswith("no interval")] == found
    return found


HAUNTED = {
    "mast": {"at": [0, 0], "height_m": 5, "pem": "haunted"}, "ego": {"on": "ego", "pem": "eye"},
    "mast2": {"at": [9, 9], "height_m": 5, "pem": "haunted"},
}  # fmt: skip


def test_ideal_fusion_shows_no_ghosts_and_is_said_not_to() -> None:
    said = "scene: configuration ideal: ideal fusion uses truth ids, ignoring ghosts of mast, mast2"
    assert street(units=HAUNTED) == [said]
    assert street(units=HAUNTED, configurations={"gnn": {"units": "all", "fusion": {"kind": "gnn"}}}) == []
    assert street(units=HAUNTED, configurations={"ego": {"units": ["ego"]}}) == []
    assert street() == []


TABLE = {"kind": "table", "distance_m": [0, 99, 99.1], "probability": [1, 1, 0]}  # the ego is 100 m from the mast


@pytest.mark.parametrize(
    ("reception", "lost"),
    [
        ({"kind": "constant", "probability": 0.0}, {"mast": "0", "ego": "0"}),
        ({"kind": "constant", "probability": 0.0005}, {"mast": "at most 0.0005", "ego": "at most 0.0005"}),
        ({"kind": "constant", "probability": 0.002}, {}),
        ({"kind": "gilbert_elliott", "bad_share": 1.0, "bad_lasts_s": 1.0}, {"mast": "0", "ego": "0"}),
        ({"kind": "gilbert_elliott", "bad_share": 0.999, "bad_lasts_s": 1.0}, {}),  # now and then it is good
        (
            {"kind": "gilbert_elliott", "bad_share": 0.5, "bad_lasts_s": 1.0, "good_loss": 1.0},
            {"mast": "0", "ego": "0"},
        ),
        ({"kind": "gilbert_elliott", "bad_share": 0.5, "bad_lasts_s": 1.0, "good_loss": 1.0, "bad_loss": 0.9}, {}),
        (TABLE, {"mast": "0"}),  # the ego's own lists have no way to go
        (TABLE | {"distance_m": [0, 101, 102]}, {}),
        # 10 · 2 · lg(1 / 100) = −40 dB of 10 dB: Φ(−4) = 3.2e-5.
        ({"kind": "shadowing", "half_at_m": 1, "exponent": 2.0, "sigma_db": 10}, {"mast": "at most 3e-05"}),
    ],
)
def test_a_link_that_loses_everything_is_said(reception: dict[str, Any], lost: dict[str, str]) -> None:
    both = {"units": "all", "link": "radio"}
    found = street(
        links={"radio": {"reception": reception}},
        configurations={"one": both, "other": both | {"fusion": {"kind": "gnn"}}, "wired": {"units": "all"}},
    )
    assert found == [
        f"scene: links.radio: no list of {unit} arrives, its reception is {best}" for unit, best in lost.items()
    ]


def test_only_the_units_that_send_by_it_are_lost() -> None:
    dead = {"kind": "radio", "reception": {"kind": "constant", "probability": 0.0}}
    own = {"one": {"units": "all", "link": {"mast": "radio"}}, "truth": {"units": "truth", "link": dead}}
    assert street(links={"radio": dead, "unused": dead}, configurations=own) == [
        "scene: links.radio: no list of mast arrives, its reception is 0",
        "scene: configurations.truth.link: no list of truth arrives, its reception is 0",
    ]


@pytest.mark.parametrize(
    ("classes", "said"),
    [
        (
            ["vru", "vehicle"],
            ["measure.objects.classes: no object is a 'vehicle'; `vehicles` would select 1 car, 1 truck"],
        ),
        (["car", "vehicle"], ["measure.objects.classes: no object is a 'vehicle'; `vehicles` would select 1 truck"]),
        (["vehicles", "vehicle"], []),
        (["car"], []),
        (None, []),
    ],
)
def test_a_class_that_is_named_like_its_group(classes: list[str] | None, said: list[str]) -> None:
    assert street(measure=MEASURED | {"objects": {"classes": classes}}) == said

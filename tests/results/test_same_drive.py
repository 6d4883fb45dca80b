"""Two versions on one drive: bags that differ in all but the truth are paired, and what differs is listed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from copem_replay.core.errors import InputError
from copem_replay.core.tracks import Solid
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import read_logs
from copem_replay.io.ground_truth import truth_digest
from copem_replay.results.compare.compare import Comparison, compare_folders
from copem_replay.viewer.side_by_side import write_side_by_side
from tests.helpers.recordings import Obj, Topic, truth_topic, write_mcap
from tests.helpers.replays import save_run
from tests.helpers.scenes import Thing, driving, recording, standing
from tests.io.test_recorded_units import car, list_of

COVARIANCE = [[0.25, 0.0], [0.0, 0.25]]
PEM = {"ego": {"on": "ego", "height_m": 1.5, "pem": "half"}}
HALF = {"half": [{"detection": {"kind": "constant", "probability": 0.5}}]}


class TestDigest:
    THINGS = (Thing("ego", "car", driving(0, 0, 5)), Thing("b", "car", standing(30, 2)))

    def digest(self, things: Sequence[Thing] = THINGS, *, until_s: float = 2.0, ego: str = "ego") -> str:
        log = recording(things, until_s=until_s, ego=ego)
        return truth_digest(log.scene, log.truth)

    def test_of_the_same_truth_however_it_is_ordered_and_named(self) -> None:
        log = recording(self.THINGS, until_s=2.0, log="another")
        assert self.digest() == self.digest(self.THINGS[::-1]) == truth_digest(log.scene, log.truth)

    def test_of_another_one(self) -> None:
        ego, other = self.THINGS
        found = [
            self.digest(), self.digest(until_s=1.9), self.digest(ego="b"),
            self.digest((ego, replace(other, at=standing(30, 2 + 1e-9)))),
            self.digest((ego, replace(other, kind="truck"))),
            self.digest((ego, replace(other, name="c"))), self.digest((ego, replace(other, moving=False))),
            self.digest((ego, replace(other, there=lambda t: t < 1))),
        ]  # fmt: skip
        log = recording(self.THINGS, until_s=2.0)
        for height_m in (3.0, 4.0):
            solid = Solid("object 9", ((9.0, 9.0), (12.0, 9.0), (9.0, 12.0)), 0.0, height_m)
            found.append(truth_digest(replace(log.scene, solids=(solid,)), log.truth))
        assert len(set(found)) == len(found)


def bag(path: Path, lists_s: Sequence[float], topic: str = "stack", *, x_m: float = 30.0, truth: str = "truth") -> Path:
    """2 s of the ego, 1, and another car, 2, at `x_m`; the stack lists it at some instants."""
    frames = [(k / 10, [Obj(id=1, x=0.0), Obj(id=2, x=x_m)]) for k in range(21)]
    stack = Topic(topic, "osi3.SensorData", [list_of(t, car(x_m)) for t in lists_s])
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_mcap(path, [truth_topic(frames, host=1, name=truth), stack])


def results(folder: Path, path: Path, topic: str = "stack", **changes: Any) -> Path:
    recorded = {"topic": topic, "covariance_m2": COVARIANCE}
    experiment = Experiment.model_validate({
        "version": 1, "logs": [str(path)], "measure": {"onset": {"kind": "appears"}, "began": ["log_start"]}, "runs": 3,
        "configurations": {"GT": {"units": "truth"}, "stack": {"recorded": recorded}},
    } | changes)  # fmt: skip
    recordings, refused = read_logs(experiment, [path], None)
    assert not refused
    save_run(folder, experiment, recordings, replays=False)
    return folder


def times(comparison: Comparison) -> dict[str, float]:
    rows = comparison.overall[comparison.overall["metric"] == "ttd_rmst_s"]
    return dict(zip(rows["configuration"], rows["difference"], strict=True))


def test_two_bags_of_one_drive(tmp_path: Path) -> None:
    """The second version knows the car at .4 s, the first at .7 s; it lists on another topic, and more often."""
    one = results(tmp_path / "one", bag(tmp_path / "1" / "drive.mcap", [0.7, 1.2, 1.7]))
    lists_s = [0.4 + 0.1 * k for k in range(10)]
    two = results(tmp_path / "two", bag(tmp_path / "2" / "drive.mcap", lists_s, "fused"), "fused")
    comparison = compare_folders([one, two], baseline="one:stack", configurations=["two:stack"])
    assert times(comparison) == {"two:stack": pytest.approx(-0.3)}
    assert comparison.notes[0] == (
        f"{two} differs from {one} in the recording of log drive (same truth); configurations.stack.recorded.topic "
        "(stack, fused); list_rate_hz of stack (2, 10)"
    )
    with pytest.raises(InputError, match=r"log drive: expected the recording of .*, found another of the same drive"):
        write_side_by_side(tmp_path / "x.rrd", [one, two], configurations=["two:stack"], baseline="one:stack")


def test_the_same_folder_again_differs_in_nothing(tmp_path: Path) -> None:
    path = bag(tmp_path / "drive.mcap", [0.7])
    folders = [results(tmp_path / name, path) for name in ("one", "two")]
    assert not any("differs" in note for note in compare_folders(folders, baseline="one:stack").notes)


class TestOtherNames:
    def two(self, tmp_path: Path, **changes: Any) -> list[Path]:
        paths = [bag(tmp_path / f"{name}.mcap", [time_s]) for name, time_s in (("v1", 0.7), ("v2", 0.4))]
        return [results(tmp_path / name, path, **changes) for name, path in zip(("one", "two"), paths, strict=True)]

    def test_pair_where_nothing_is_drawn(self, tmp_path: Path) -> None:
        comparison = compare_folders(self.two(tmp_path), baseline="one:stack")
        assert times(comparison)["two:stack"] == pytest.approx(-0.3)
        assert "the name of log v1 (v2); the recording of log v1 (same truth)" in comparison.notes[0]
        assert set(comparison.table["log"]) == {"all"}

    def test_what_is_drawn_is_refused(self, tmp_path: Path) -> None:
        stack = {"recorded": {"topic": "stack", "covariance_m2": COVARIANCE}}
        configurations = {"stack": stack, "PEM": {"units": ["ego"]}}
        folders = self.two(tmp_path, units=PEM, pems=HALF, configurations=configurations)
        with pytest.raises(InputError) as caught:
            compare_folders(folders, baseline="one:stack")
        assert caught.value.problems == (
            f"{folders[1]}: log v2: expected the name v1 as in {folders[0]}, for what is drawn depends on it; run it "
            "again with `logs: [{file: …, name: v1}]`",
        )
        # Of what is not drawn, and within one folder, nothing depends on the name.
        assert times(compare_folders(folders, baseline="one:stack", configurations=["two:stack"]))
        assert times(compare_folders(folders, baseline="one:stack", configurations=["one:PEM"]))

    def test_a_driver_who_is_drawn_is_refused(self, tmp_path: Path) -> None:
        gamma = {"kind": "gamma", "shape": 2.0, "mean_s": 0.5}
        braking = {"driver": {"kind": "constant_deceleration", "a_max_mps2": 8.0, "reaction": gamma}}
        folders = self.two(tmp_path, braking=braking)
        with pytest.raises(InputError, match="expected the name v1"):
            compare_folders(folders, baseline="one:stack", configurations=["two:stack"])


def test_another_drive_is_refused(tmp_path: Path) -> None:
    one = results(tmp_path / "one", bag(tmp_path / "1" / "drive.mcap", [0.7]))
    two = results(tmp_path / "two", bag(tmp_path / "2" / "drive.mcap", [0.7], x_m=30.1))
    with pytest.raises(InputError) as caught:
        compare_folders([one, two], baseline="one:stack")
    assert caught.value.problems == (
        f"{two}: expected the logs of {one}, found drive missing and drive of another truth",
    )


def test_a_truth_of_another_topic_is_the_same(tmp_path: Path) -> None:
    one = results(tmp_path / "one", bag(tmp_path / "1" / "drive.mcap", [0.7]))
    two = results(tmp_path / "two", bag(tmp_path / "2" / "drive.mcap", [0.7], truth="objects"), ego="1")
    comparison = compare_folders([one, two], baseline="one:stack")
    assert "the topic of its truth (truth, objects)" in comparison.notes[0]
    assert times(comparison)["two:stack"] == 0

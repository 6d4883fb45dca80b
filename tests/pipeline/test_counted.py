"""Which objects count for times, shares and distances, by hand: all rows are written, and `measure.began` chooses.

The ego stands at the origin. Within 50 m of it is `near` from the log's start on; `enters`, which comes at 10 m/s from
80 m, from 3 s on; `pops` and `goes` appear there at 2 s, and `goes` is gone after one frame. All is known after 0.5 s.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import pandas as pd
import pytest

from copem_replay.experiment.schema import Experiment
from copem_replay.io.recording import Recording
from copem_replay.metrics.metric import RowMetric
from copem_replay.metrics.onset import BEGAN
from copem_replay.metrics.summary import describe_began
from copem_replay.pipeline.run import StudyTables, run_experiment
from tests.helpers.experiments import changed, drive
from tests.helpers.replays import study_rows
from tests.helpers.scenes import Thing, driving, experiment, recording, standing
from tests.system.test_cli import Call, call, here

__all__ = ["call", "here"]

ONSET = {"kind": "in_range", "range_m": 50}
LATE = {
    "GT": {"units": "truth"},
    "late": {"units": "truth", "latency_s": 0.5},
}


class Rows(RowMetric):
    help: ClassVar[str] = "how many rows there are"
    better: ClassVar[Literal[-1, 0, 1]] = 0

    def statistics(self, rows: pd.DataFrame) -> Mapping[str, np.ndarray]:
        return {"n": np.ones(len(rows))}

    def value(self, sums: Mapping[str, float]) -> float | None:
        return sums["n"]


def scene() -> Recording:
    things = [
        Thing("ego", "car", standing(0, 0)),
        Thing("near", "car", standing(30, 0)),
        Thing("enters", "car", driving(80, 0, -10)),
        Thing("pops", "car", standing(20, 20), there=lambda t: t > 1.99),
        Thing("goes", "car", standing(20, -20), there=lambda t: 1.99 < t < 2.11),
    ]
    return recording(things, until_s=12.0)


def plan(*began: str, **measure: Any) -> Experiment:
    of = {"began": list(began)} if began else {"began": ["crossed", "appeared"]}
    return experiment(configurations=LATE, measure={"onset": ONSET} | of | measure)


def replayed(*began: str, **measure: Any) -> StudyTables:
    return run_experiment(plan(*began, **measure), [scene()])


def of(result: StudyTables, configuration: str) -> pd.Series:
    return result.summary.set_index("configuration").loc[configuration]


def test_every_row_says_how_it_began_and_all_are_written() -> None:
    table = study_rows(replayed())
    assert table.groupby("object_id")["began"].unique().explode().to_dict() == {
        "near": "log_start", "enters": "crossed", "pops": "appeared", "goes": "appeared",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("began", "n", "detected"),
    [
        (("crossed", "appeared"), 3, 2 / 3),  # `goes` leaves before the list comes
        (("crossed",), 1, 1.0),
        (("appeared",), 2, 1 / 2),
        (("log_start", "crossed"), 2, 1.0),
        (BEGAN, 4, 3 / 4),
    ],
)
def test_what_counts(began: tuple[str, ...], n: int, detected: float) -> None:
    result = replayed(*began)
    assert of(result, "late")["n"] == n
    assert of(result, "late")["detected_share"] == pytest.approx(detected)
    assert of(result, "GT")["detected_share"] == 1


def test_accuracy_and_ghosts_are_of_all_objects() -> None:
    columns = ["matched_share", "position_rmse_m", "gospa_m", "false_positives_per_min"]
    first, second = (of(replayed(*began), "late") for began in (("crossed",), BEGAN))
    same = [name for name in columns if name in first]
    assert same
    assert first[same].to_dict() == pytest.approx(second[same].to_dict(), nan_ok=True)


def test_exact_times_count_alike() -> None:
    for began in (("crossed",), ("appeared",), BEGAN):
        row = of(replayed(*began, exact=True), "late")
        assert row["detected_share_exact"] == pytest.approx(row["detected_share"])
        assert row["ttd_rmst_s_exact"] == pytest.approx(row["ttd_rmst_s"])


def test_another_choice_finds_all_pieces(here: Path, call: Call) -> None:
    drive(here / "drive.mcap")
    kept = []
    for words in ("crossed", "crossed, log_start"):
        (here / "e.yaml").write_text(changed(f"measure: {{onset: {{kind: in_range, range_m: 60}}, began: [{words}]}}"))
        ended = call("run", "e.yaml", "--pieces", "kept", "--overwrite", "--jobs", "1")
        assert "pieces: 0 computed, 3 found in kept" in ended.lines or not kept, ended.lines
        kept.append((here / "out/e/detections.parquet").read_bytes())
    assert kept[0] == kept[1]


def test_the_line_on_groups() -> None:
    """Late by 0.5 s, up to the horizon of 5 s, which `near` (12 s), `enters` (9 s) and `pops` (10 s) are followed."""
    result = replayed(horizon_s=5.0)
    line = describe_began(result.tally, "late", 5.0, ("crossed", "appeared"))
    assert line == (
        "objects by how they began, and their ttd_rmst_s in late: 1 crossed 0.5 s, 2 appeared 2.75 s, 1 log_start "
        "0.5 s; counted: crossed, appeared; on annotated drives `appeared` may be where annotation began"
    )
    crossed = result.tally[result.tally["began"] == "crossed"]
    assert describe_began(crossed, "GT", 5.0, ("crossed",)).endswith("0 log_start; counted: crossed")


def test_who_is_there_for_one_frame_is_left_out_and_counted() -> None:
    """Nothing can be told of it: it is known at its onset, or it is gone."""
    blink = Thing("blinks", "car", standing(25, 0), there=lambda t: 2.99 < t < 3.01)
    things = [Thing("ego", "car", standing(0, 0)), Thing("enters", "car", driving(80, 0, -10)), blink]
    result = run_experiment(plan(), [recording(things, until_s=12.0)])
    assert of(result, "late")[["n", "detected_share", "unknown_s"]].tolist() == [1, 1.0, pytest.approx(0.5)]
    assert set(study_rows(result)["object_id"]) == {"enters", "blinks"}
    line = describe_began(result.tally, "late", 5.0, ("crossed", "appeared"))
    assert "1 crossed 0.5 s, 0 appeared, 0 log_start;" in line
    assert "; left out, with no frame after the onset: 1;" in line


def test_own_metrics_are_of_what_counts() -> None:
    own = {"metrics": [{"kind": f"{__name__}:Rows", "name": "rows"}]}
    assert [of(replayed(*began, **own), "GT")["rows"] for began in (("crossed",), BEGAN)] == [1, 4]


def test_nothing_that_counts_ends_before_the_replay(here: Path, call: Call) -> None:
    """The car is within 80 m from the log's start on."""
    drive(here / "drive.mcap")
    (here / "e.yaml").write_text(changed("measure: {onset: {kind: in_range, range_m: 80}}"))
    for command in ("check", "run"):
        ended = call(command, "e.yaml")
        assert ended.code == 2
        assert ended.lines[-1] == (
            "e.yaml:17: measure.began: expected objects that count (crossed, appeared), found none: of 1 object with "
            "an onset 1 log_start, 0 appeared, 0 crossed; `measure: {began: [log_start, crossed, appeared]}` counts all"
        )
    assert not (here / "out").exists()
    assert call("run", "e.yaml", "--pieces", "kept").code == 2


def test_a_log_where_nothing_counts_is_said(here: Path, call: Call) -> None:
    for name in ("a", "b"):
        drive(here / f"{name}.mcap")
    logs = "logs: [a.mcap, {file: b.mcap, measure: {onset: {kind: in_range, range_m: 80}}}]"
    (here / "e.yaml").write_text(changed(logs))
    said = "b: no object counts: 1 log_start, 0 appeared, 0 crossed; `measure.began` has crossed, appeared"
    for command in ("check", "run"):
        ended = call(command, "e.yaml")
        assert ended.code == 0
        assert sum(said in line for line in ended.lines) == 1, ended.lines


def test_check_says_the_numbers_at_three_ranges(here: Path, call: Call) -> None:
    """70 − 10 t ahead for 3 s: it never comes within 30 m, is within 40 m at 3 s and within 50 m at 2 s."""
    drive(here / "drive.mcap")
    (here / "e.yaml").write_text(changed())
    assert [line for line in call("check", "e.yaml").out.splitlines() if line.startswith("within")] == [
        "within 30 m: 0 objects count",
        "within 40 m: 1 object counts: 1 crossed",
        "within 50 m: 1 object counts: 1 crossed",
        "within 60 m: 1 object counts: 1 crossed (chosen)",
    ]


def test_an_oracle_of_how_objects_began() -> None:
    """Against the words alone, over random stays and ways."""
    rng = np.random.default_rng(4)
    for _ in range(20):
        since_s, ego_s = rng.integers(0, 30, 6) / 10, float(rng.integers(0, 12) / 10)
        places = rng.uniform(20, 80, 6)
        speeds = rng.uniform(-12, 12, 6)
        things = [Thing("ego", "car", standing(0, 0), there=lambda t, s=ego_s: t > s - 0.01)]
        things += [
            Thing(f"o{k}", "car", driving(places[k], 0, speeds[k]), there=lambda t, s=since_s[k]: t > s - 0.01)
            for k in range(6)
        ]
        log = recording(things, until_s=4.0)
        expected = {}
        for k in range(6):
            times = [t / 10 for t in range(41) if t / 10 > max(since_s[k], ego_s) - 0.01]
            near = [abs(places[k] + speeds[k] * t) <= 50 for t in times]
            if any(near):
                first = times[0] < ego_s + 0.01
                expected[f"o{k}"] = "crossed" if not near[0] else "log_start" if first else "appeared"
        table = study_rows(run_experiment(plan(), [log]))
        found = dict(zip(table["object_id"], table["began"], strict=True))
        assert found == expected

"""When what is known was first listed, and when the list that made it known was sent and arrived."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from copem_replay.core.tracks import Tracks
from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.detection.by_truth_id import FirstDetections
from copem_replay.metrics.detections_table import WAY, find_informing_list
from copem_replay.pipeline import prepare as chunking
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.run import run_experiment
from copem_replay.report.figures.latency_breakdown import mean_stages
from tests.helpers import scenes
from tests.helpers.replays import study_rows, transmitted, world_of
from tests.helpers.scenes import EGO_UNIT, experiment
from tests.pipeline import test_recorded_output as recorded_outputs
from tests.pipeline.test_links import BURSTS, GAMMA, plan, traffic

TIMES = ("onset_s", "in_sight_s", "listed_s", "captured_s", "sent_s", "arrived_s", "detection_s")


def of_oncoming(
    unit: dict[str, Any], configuration: dict[str, Any], **changes: Any
) -> tuple[list[float], dict[str, float]]:
    """The oncoming car's times, and what stages the report makes of them. 80 m away at 2 s, it is within range, and
    listed, from 4 s on."""
    data: dict[str, Any] = {
        "units": {"ego": EGO_UNIT | unit}, "links": {"v2x": {"latency": 0.05}},
        "configurations": {"it": {"units": ["ego"], **configuration}},
    }  # fmt: skip
    some = experiment(**(data | changes))
    table = study_rows(run_experiment(some, [scenes.oncoming_car()]))
    return table[list(TIMES)].iloc[0].round(9).tolist(), mean_stages(table, some, "it")


@pytest.mark.parametrize(
    ("unit", "configuration", "times", "expected"),
    [
        ({"ready": 0.03}, {"link": "v2x", "latency_s": 0.02}, [4.0, 4.0, 4.03, 4.1, 4.1],
         {"in sight": 0.0, "processing": 0.03, "transport": 0.07, "fusion": 0.0}),
        # The list of 4.0 s is there at 4.1 s; at the tick, 4.25 s, the newest that is there is that of 4.1 s.
        ({"ready": 0.03}, {"link": "v2x", "latency_s": 0.02, "issue_hz": 4}, [4.0, 4.1, 4.13, 4.2, 4.25],
         {"in sight": 0.0, "listed": 0.1, "processing": 0.03, "transport": 0.07, "fusion": 0.05}),
        # Messages go at 3.9 and 4.2 s: what is listed at 4.0 and 4.1 s is not sent.
        ({"sends": {"interval_s": 0.3}}, {}, [4.0, 4.2, 4.2, 4.2, 4.2],
         {"in sight": 0.0, "listed": 0.2, "transport": 0.0, "fusion": 0.0}),
        ({"ready": 0.03, "sends": {"interval_s": 0.3}}, {"link": "v2x"}, [4.0, 4.2, 4.23, 4.28, 4.28],
         {"in sight": 0.0, "listed": 0.2, "processing": 0.03, "transport": 0.05, "fusion": 0.0}),
        ({"ready": 0.03}, {"link": "v2x", "fusion": {"kind": "gnn"}}, [4.0, 4.0, 4.03, 4.08, 4.08],
         {"in sight": 0.0, "processing": 0.03, "transport": 0.05, "fusion": 0.0}),
    ],
)  # fmt: skip
def test_by_hand(
    unit: dict[str, Any], configuration: dict[str, Any], times: list[float], expected: dict[str, float]
) -> None:
    found, means = of_oncoming(unit, configuration)
    assert found == [2.0, 4.0, *times]
    assert means == {"out of range or view": 2.0, "hidden": 0.0} | expected
    assert sum(means.values()) == pytest.approx(times[-1] - 2.0, abs=1e-9)


def test_of_lists_that_confirm_it_is_the_last() -> None:
    """The second of two lists, which the first is listed before."""
    confirm = {"onset": {"kind": "in_range", "range_m": 80}, "confirm": {"hits": 2, "of": 2}}
    found, means = of_oncoming({}, {"link": "v2x"}, measure=confirm)
    assert found == [2.0, 4.0, 4.0, 4.1, 4.1, 4.15, 4.15]
    of_sight = {"out of range or view": 2.0, "hidden": 0.0, "in sight": 0.0}
    assert means == of_sight | {"listed": 0.1, "transport": 0.05, "fusion": 0.0}


def test_without_link_ready_or_sends_there_are_no_such_columns() -> None:
    table = study_rows(run_experiment(experiment(), [scenes.oncoming_car()]))
    assert not set(WAY) & set(table)
    linked = {"GT": {"units": "truth"}, "PEM": {"units": ["ego"], "link": "v2x"}}
    beside = study_rows(run_experiment(experiment(configurations=linked, links={"v2x": {}}), [scenes.oncoming_car()]))
    assert tuple(beside)[-3:] == WAY
    assert beside[list(WAY)].isna().all(axis=1).tolist() == [True, False]
    pd.testing.assert_frame_equal(beside.drop(columns=list(WAY)), table)


READY = {"at": [30.0, 8], "height_m": 5, "pem": "half", "ready": GAMMA}
BY_RADIO: dict[str, Any] = {"latency": GAMMA, **BURSTS}


def drawn(**changes: Any) -> Experiment:
    """Three units, of which one takes a drawn time for each list, by a link that loses lists in bursts."""
    units = plan(None).as_written()["units"] | {"east": READY}
    data: dict[str, Any] = {"units": units, "links": {"v2x": BY_RADIO}}
    return plan("v2x", **(data | changes))


def plainly(some: Experiment, name: str, one: int) -> dict[str, list[float]]:
    """By object the times of `WAY`, list by list; NaN: none."""
    replay = prepare_log(traffic(), some)
    seen, received = world_of(replay, some, [one]).sent("true"), transmitted(replay, some, [one]).received(name)
    sent_s, arrives_s, captured_s = seen.common_arrives_s, received.common_arrives_s, seen.captured_s
    holds = {
        (int(f), int(o)) for f, o, there in zip(seen.frame_ix, seen.row_object_ix, seen.valid[0], strict=True) if there
    }
    in_use, newest = [], dict.fromkeys(range(len(seen.units)), -np.inf)
    for f in sorted(np.flatnonzero(np.isfinite(arrives_s)), key=lambda f: arrives_s[f]):
        unit = int(seen.frame_unit_ix[f])
        if captured_s[f] > newest[unit]:
            newest[unit] = captured_s[f]
            in_use.append(int(f))
    found = {}
    episodes = replay.episodes
    for o, onset_s, ended_s in zip(episodes.object_ix, episodes.onset_s, episodes.ended_s, strict=True):
        having = [
            f for f in range(len(captured_s)) if (f, o) in holds and onset_s - 1e-6 <= captured_s[f] <= ended_s + 1e-6
        ]
        knowing = [f for f in in_use if f in having and arrives_s[f] <= ended_s + 1e-6]
        listed_s = min((captured_s[f] for f in having), default=np.nan)
        told = [sent_s[knowing[0]], arrives_s[knowing[0]]] if knowing else [np.nan, np.nan]
        found[replay.scene.object_ids[o]] = [listed_s, *told]
    return found


def test_drawn_times_are_those_of_the_list_that_told() -> None:
    some = drawn(runs=6, measure={"onset": {"kind": "in_range", "range_m": 60}, "accuracy": False})
    table = study_rows(run_experiment(some, [traffic()]))
    of_ideal = table[table["configuration"] == "coop"]
    for one in range(6):
        rows = of_ideal[of_ideal["run"] == one].set_index("object_id")
        for name, times in plainly(some, "coop", one).items():
            np.testing.assert_array_equal(rows.loc[name, list(WAY)].to_numpy(dtype=float), times)
    assert (of_ideal["captured_s"] > of_ideal["listed_s"] + 0.05).any(), "some are lost"
    late_s = (of_ideal["sent_s"] - of_ideal["captured_s"])[of_ideal["first_unit"] == "east"]
    assert late_s.min() > 0.02
    assert late_s.nunique() == len(late_s)


def test_stages_add_up_to_the_time_to_detection() -> None:
    """Whatever the fusion, what is sent, and whether there is anything to be drawn; and the order of times is that."""
    units = plan(None).as_written()["units"] | {"east": READY | {"sends": {"kind": "cpm", "interval_s": 0.3}}}
    both = {"units": "all", "link": "v2x", "issue_hz": 7}
    configurations: dict[str, Any] = {
        "gnn": {**both, "fusion": {"kind": "gnn"}}, "tracker": {**both, "fusion": {"kind": "tracker"}},
        "ideal": {"units": "all", "link": {"default": "v2x", "ego": "none"}},
        "GT": {"units": "truth", "link": "v2x"}, "wired": {"units": ["ego"]}, "ready": {"units": ["east"]},
    }  # fmt: skip
    some = drawn(units=units, configurations=configurations)
    table = study_rows(run_experiment(some, [traffic()]))
    for name, rows in table[table["detected"]].groupby("configuration"):
        assert len(rows) > 5, name
        means = mean_stages(rows, some, str(name))
        assert sum(means.values()) == pytest.approx(rows["time_to_detection_s"].mean(), abs=1e-8), name
        assert min(means.values()) >= 0, name
        if name != "wired":
            told = rows[["captured_s", "sent_s", "arrived_s", "detection_s"]].to_numpy()
            assert (np.diff(told, axis=1) >= -1e-6).all(), name
            assert means["listed"] > 0, name
            assert ("processing" in means) == (rows["first_unit"] == "east").any(), name


def test_the_same_in_time_chunks_and_by_any_number_of_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    some = drawn(units=plan(None).as_written()["units"] | {"east": READY | {"sends": {"kind": "cpm"}}})
    whole = study_rows(run_experiment(some, [traffic()]))
    assert whole[list(WAY)].notna().any().all()
    assert study_rows(run_experiment(some, [traffic()], jobs=2)).equals(whole)
    monkeypatch.setattr(chunking, "ROWS_AT_ONCE", 1)
    monkeypatch.setattr(chunking, "ROWS_A_CHUNK", 200)
    assert study_rows(run_experiment(some, [traffic()])).equals(whole)


def test_what_is_listed_and_never_arrives() -> None:
    """It is listed at 4 s, and all is lost."""
    lost = {"v2x": {"reception": {"kind": "constant", "probability": 0.0}}}
    found, means = of_oncoming({}, {"link": "v2x"}, links=lost)
    assert found[2] == 4.0
    assert np.isnan(found[3:]).all()
    assert means == {}


def test_recorded_lists_are_sent_when_they_are_stamped(tmp_path: Path) -> None:
    """Of .25 s, stamped .05 s later, .1 s on its way; it is not known when the car was in sight."""
    lists = [recorded_outputs.list_of(t, recorded_outputs.car(30)) for t in (0.3, 0.5)]
    path = recorded_outputs.drive(tmp_path / "drive.mcap", lists, lists)
    configurations = recorded_outputs.plan(path).as_written()["configurations"]
    configurations["rsu"] = {"units": ["rsu"], "link": "v2x"}
    some = recorded_outputs.plan(path, configurations=configurations, links={"v2x": {"latency": 0.1}})
    table = study_rows(recorded_outputs.replayed(some)[1])
    rows = table[table["object_id"] == "2"].set_index("configuration")
    assert rows.loc["rsu", list(TIMES)].isna().tolist() == [False, True] + [False] * 5
    times = rows.loc["rsu", [*WAY, "detection_s"]].astype(float).round(9).tolist()
    assert times == [0.25, 0.3, 0.4, 0.4]
    assert rows.loc["stack", list(WAY)].isna().all()
    expected = {"until captured": 0.25, "processing": 0.05, "transport": 0.1, "fusion": 0.0}
    assert mean_stages(rows.loc[["rsu"]], some, "rsu") == expected


def test_of_units_that_listed_it_together() -> None:
    """Both made lists at 1 s. The last that was there told; of two at once that of the unit that listed it first."""

    def told(at_s: tuple[float, float], detection_s: float, first_unit_ix: int, captured_s: float = 1.0) -> int:
        one = np.array([[detection_s]]), np.array([[captured_s]]), np.array([[first_unit_ix]])
        received = Tracks(
            ("a", "b"), np.zeros(1, dtype=int), *(np.zeros(0, dtype=int),) * 3, np.array([0, 0]), np.array([1.0, 1.0]),
            np.array([0, 1]), np.array([at_s]), np.zeros((1, 0), dtype=bool), *(np.zeros((1, 0)),) * 9,
        )  # fmt: skip
        return int(find_informing_list(received, FirstDetections(*one))[0, 0])

    assert told((1.1, 1.2), 1.2, 0) == 1
    assert told((1.1, 1.2), 1.1, 1) == 0
    assert [told((1.1, 1.1), 1.1, unit_ix) for unit_ix in (0, 1)] == [0, 1]
    assert told((1.1, 1.2), 1.05, 0) == told((1.1, np.inf), 1.2, 1, captured_s=0.9) == -1
    assert told((np.inf, 1.2), 1.3, 0) == 1
    assert told((1.1, 1.2), np.nan, -1, np.nan) == -1

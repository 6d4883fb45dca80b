"""What the contract calls always true, over random logs and experiments."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from copem_replay.core.interpolation import interpolate_states
from copem_replay.io.recording import Recording
from copem_replay.pipeline.one_run import tracks_of_run
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.run import run_experiment
from tests.helpers.replays import study_rows
from tests.helpers.scenes import Thing, driving, experiment, recording

MANY = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])  # each replays a log


@st.composite
def logs(draw: st.DrawFn) -> Recording:
    """An ego and one to four others, each in the log for a stretch of its own, perhaps with a gap."""
    things = [Thing("ego", "car", driving(0, 0, draw(st.floats(0, 15))))]
    for k in range(draw(st.integers(1, 4))):
        first, length = draw(st.integers(0, 20)), draw(st.integers(1, 30))
        gap = draw(st.sampled_from([0, 3, 9]))

        def there(t: float, first: int = first, length: int = length, gap: int = gap) -> bool:
            tick = round(t * 10) - first
            return 0 <= tick <= length and not (5 < tick < 5 + gap)

        speed = draw(st.floats(-10, 10))
        things.append(Thing(f"o{k}", "pedestrian", driving(20 + 8 * k, 3.0 * k, speed, 0.5), there))
    return recording(things, until_s=3.0)


onsets = st.sampled_from(
    [
        {"kind": "appears"},
        {"kind": "in_range", "range_m": 30},
        {"kind": "starts_moving", "speed_mps": 1.0, "within_m": 40},
        {"kind": "line_of_sight", "visible_share": 0.3},
        {"kind": "line_of_sight_any", "visible_share": 0.3},
        {"kind": "at", "time_s": 0.77},
    ]
)
latencies = st.sampled_from([0.0, 0.05, 0.35, 1.0])
confirms = st.sampled_from([{"hits": 1, "of": 1}, {"hits": 2, "of": 3}, {"hits": 2, "of": 2}, {"hits": 3, "of": 5}])
rates = st.sampled_from([None, 10.0, 20.0, 4.0, 7.3])
PEMS = {"p": [{"detection": {"kind": "constant", "probability": 0.3}}]}


def units(ego_rate: float | None, other_rate: float | None) -> dict[str, Any]:
    return {
        "ego": {"on": "ego", "height_m": 1.8, "pem": "p", "rate_hz": ego_rate},
        "v2v": {"on": "o0", "height_m": 1.5, "pem": "p", "rate_hz": other_rate},
        "rsu": {"at": [25, -6], "height_m": 5.0, "pem": "p", "rate_hz": other_rate},
    }


def by_row(table: pd.DataFrame, configuration: str) -> pd.DataFrame:
    return table[table["configuration"] == configuration].set_index(["run", "object_id"])


@given(log=logs(), onset=onsets, confirm=confirms, ego_rate=rates, other_rate=rates, latency=latencies)
@MANY
def test_what_one_unit_detects_its_company_detects_too_and_not_later(
    log: Recording, onset: Any, confirm: Any, ego_rate: Any, other_rate: Any, latency: float
) -> None:
    plan = experiment(
        runs=8,
        pems=PEMS,
        units=units(ego_rate, other_rate),
        configurations={
            "PEM": {"units": ["ego"], "latency_s": latency},
            "two": {"units": ["ego", "rsu"], "latency_s": latency},
            "all": {"units": "all", "latency_s": latency},
        },
        measure={"onset": onset, "confirm": confirm},
    )
    table = study_rows(run_experiment(plan, [log]))
    alone = by_row(table, "PEM")
    for name in ("two", "all"):
        together = by_row(table, name)
        assert (together["detected"] | ~alone["detected"]).all()
        late = together["detection_s"] - alone["detection_s"]
        assert not (late[alone["detected"]] > 1e-9).any()


@given(onset=onsets, confirm=confirms, ego_rate=rates, other_rate=rates, late=latencies, later=latencies)
@example({"kind": "in_range", "range_m": 30}, {"hits": 1, "of": 1}, None, None, 0.05, 0.0)
@MANY
def test_where_nothing_can_be_confused_union_detects_as_ideal_does(
    onset: Any, confirm: Any, ego_rate: Any, other_rate: Any, late: float, later: float
) -> None:
    """By match and by truth id alike, confirmations included, whatever the units' rates and latencies."""
    things = [Thing("ego", "car", driving(0, 0, 5))]
    things += [Thing(f"o{k}", "pedestrian", driving(20 + 15 * k, 9.0 * k, 1.0, 0.5)) for k in range(3)]
    latency = {"ego": late, "default": later}
    plan = experiment(
        runs=8,
        pems=PEMS,
        units=units(ego_rate, other_rate),
        configurations={
            "ideal": {"units": "all", "latency_s": latency},
            "union": {"units": "all", "latency_s": latency, "fusion": {"kind": "union"}},
        },
        measure={"onset": onset, "confirm": confirm},
    )
    table = study_rows(run_experiment(plan, [recording(things, until_s=3.0)]))
    ideal, union = by_row(table, "ideal"), by_row(table, "union")
    pd.testing.assert_series_equal(ideal["detection_s"], union["detection_s"])


@given(log=logs(), onset=onsets, latency=latencies, ego_rate=rates)
@MANY
def test_latency_moves_every_detection_by_exactly_itself_or_past_the_end(
    log: Recording, onset: Any, latency: float, ego_rate: Any
) -> None:
    plan = experiment(
        runs=8,
        pems=PEMS,
        units=units(ego_rate, None),
        configurations={
            "now": {"units": "all"},
            "late": {"units": "all", "latency_s": latency},
            "GT": {"units": "truth"},
            "lateGT": {"units": "truth", "latency_s": latency},
        },
        measure={"onset": onset},
    )
    table = study_rows(run_experiment(plan, [log]))
    for name in ("now", "GT"):
        now, late = by_row(table, name), by_row(table, "late" + name.removeprefix("now"))
        expected = (now["detection_s"] + latency).where(now["detection_s"] + latency <= now["ended_s"] + 1e-6)
        np.testing.assert_allclose(late["detection_s"], expected, atol=1e-9)
        assert (late["detected"] == expected.notna()).all()
        kept = late["detected"]
        np.testing.assert_allclose(late["captured_s"][kept], now["captured_s"][kept], atol=1e-9)


@given(log=logs(), onset=onsets, confirm=confirms)
@MANY
def test_the_truth_detects_at_the_first_list_from_the_onset_on(log: Recording, onset: Any, confirm: Any) -> None:
    plan = experiment(
        pems=PEMS,
        units=units(None, None),
        configurations={"GT": {"units": "truth"}},
        measure={"onset": onset, "confirm": confirm},
    )
    table = study_rows(run_experiment(plan, [log]))
    truth = log.truth
    for found in table.itertuples():
        track = log.scene.object_number[found.object_id]
        frames = truth.captured_s[truth.frame_ix[truth.start[track] : truth.start[track + 1]]]
        # The frames that list the object: its own, and those of gaps that are bridged (all but the long one).
        instants = [
            t
            for t in truth.captured_s
            if t >= found.onset_s - 1e-9
            and frames[0] - 1e-9 <= t <= found.ended_s + 1e-9
            and np.min(frames[frames >= t - 1e-9]) - np.max(frames[frames <= t + 1e-9]) <= 0.5 + 1e-9
        ]
        hits, of = confirm["hits"], confirm["of"]
        ticks = [round(t * 10) for t in instants]
        # The hits-th of them within `of` consecutive frames.
        ends = [k for k in range(hits - 1, len(ticks)) if ticks[k] - ticks[k - hits + 1] < of]
        assert found.detected == bool(ends)
        if ends:
            assert found.detection_s == pytest.approx(instants[ends[0]])


@given(log=logs())
@settings(max_examples=10, deadline=None)  # each replays a log
def test_the_truth_is_believed_without_error(log: Recording) -> None:
    plan = experiment(configurations={"GT": {"units": "truth"}})
    ready = prepare_log(log, plan)
    fused = tracks_of_run(ready, plan, 0)["GT"].fused
    at, there = interpolate_states(
        log.truth, fused.row_object_ix, fused.captured_s[fused.frame_ix], t0_ns=log.scene.t0_ns, max_gap_s=0.5
    )
    assert there.all()
    for name in ("x_m", "y_m", "z_m", "vx_mps", "vy_mps", "length_m", "width_m", "height_m"):
        np.testing.assert_array_equal(getattr(fused, name)[0], at[name])
    np.testing.assert_allclose(fused.yaw_rad[0], at["yaw_rad"], atol=1e-15)
    assert not np.any(fused.row_object_ix == log.scene.ego_ix), "the receiver does not list itself"


@pytest.mark.parametrize("count", [1, 2, 3, 5, 21])
def test_identical_units_divide_the_variance(count: int) -> None:
    variance = 0.8
    pems = {
        "p": [
            {
                "detection": {"kind": "constant", "probability": 1.0},
                "error": {"kind": "gaussian", "covariance_m2": [[variance, 0], [0, variance]]},
            }
        ]
    }
    masts = {f"rsu{k}": {"at": [5.0 * k, -10], "height_m": 5.0, "pem": "p"} for k in range(count)}
    plan = experiment(pems=pems, units=masts, configurations={"all": {"units": "all"}})
    log = recording([Thing("ego", "car", driving(0, 0, 5)), Thing("o", "pedestrian", driving(20, 5, 0, 1))], until_s=2)
    fused = tracks_of_run(prepare_log(log, plan), plan, 0)["all"].fused
    np.testing.assert_allclose(fused.cov_ee_m2, variance / count)
    np.testing.assert_allclose(fused.cov_nn_m2, variance / count)
    np.testing.assert_allclose(fused.cov_en_m2, 0, atol=1e-12)


@given(log=logs(), latency=latencies)
@settings(max_examples=15, deadline=None)  # each replays a log
def test_no_list_before_the_first_capture_plus_latency(log: Recording, latency: float) -> None:
    plan = experiment(
        pems=PEMS, units=units(None, None), configurations={"all": {"units": "all", "latency_s": latency}}
    )
    fused = tracks_of_run(prepare_log(log, plan), plan, 0)["all"].fused
    assert fused.arrives_s[0, 0] == pytest.approx(latency)
    np.testing.assert_allclose(fused.arrives_s[0] - fused.captured_s, latency, atol=1e-9)

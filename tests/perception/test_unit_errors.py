"""What a unit gets wrong beside its PEM: outages, its clock, its own pose."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from copem_replay.core.object_list import ObjectLists, entries_of
from copem_replay.core.tracks import Bool
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import find_problems
from copem_replay.io.recording import Recording
from copem_replay.perception.perceive import clock_errors_s, lists_not_made
from copem_replay.pipeline.prepare import Replay, prepare_log
from copem_replay.pipeline.receiver import StatedCaptures
from copem_replay.pipeline.run import run_experiment
from tests.helpers import scenes
from tests.helpers.experiments import changed, drive, source_of
from tests.helpers.replays import study_accuracy, study_rows, world_of
from tests.helpers.scenes import Thing, driving, experiment, standing

EGO = Thing("ego", "car", standing(0, 20))
LISTS = {"at": [0.0, 0.0], "height_m": 5.0, "pem": "all"}


def unit(**errors: Any) -> dict[str, Any]:
    return LISTS | errors


def alone(until_s: float = 30.0) -> Recording:
    """A car that stands 50 m to the east of the origin."""
    return scenes.recording([EGO, Thing("car", "car", standing(50, 0))], until_s=until_s)


def ready(recording: Recording, plan: Experiment) -> Replay:
    return prepare_log(recording, plan)


def down(plan: Experiment, recording: Recording, runs: int) -> Bool:
    """(S, F) lists of the one unit that are not made."""
    replay = ready(recording, plan)
    tracks = replay.no_rows.tracks
    found = lists_not_made(replay.scene, tracks, replay.expanded, np.arange(runs))
    assert found is not None
    return found


class TestOutages:
    PLAN = experiment(
        runs=3, units={"mast": unit(rate_hz=50.0, outages={"down_share": 0.2, "lasts_s": 0.5})},
        configurations={"PEM": {"units": ["mast"]}, "gnn": {"units": ["mast"], "fusion": {"kind": "gnn"}}},
        measure={"onset": {"kind": "appears"}},
    )  # fmt: skip

    def test_share_and_mean_duration(self) -> None:
        found = down(self.PLAN, alone(100.0), 100)
        # 100 runs of 100 s, renewals 0.4 s apart: 25 000 independent numbers.
        assert abs(found.mean() - 0.2) < 4 * math.sqrt(0.2 * 0.8 / 25_000 * 2)
        lengths = [np.diff(np.flatnonzero(np.diff(np.pad(row, 1).astype(int))))[::2] for row in found]
        whole = np.concatenate([one[1:-1] for one in lengths]) * 0.02  # those at the ends are cut off
        # An outage is exponential, of 0.5 s; seen at 50 Hz it is a geometric number of lists, on average as long as one
        # more list period's part: E = T / (1 - e^(-T/0.5)).
        expected_s = 0.02 / (1 - math.exp(-0.02 / 0.5))
        assert abs(whole.mean() - expected_s) < 4 * whole.std() / math.sqrt(len(whole))
        assert stats.kstest(whole - 0.01, stats.expon(scale=0.5).cdf).statistic < 0.04

    def test_no_list_instead_of_an_empty_one(self) -> None:
        plan = self.PLAN
        replay = ready(alone(10.0), plan)
        [missing] = down(plan, alone(10.0), 1)
        assert 0 < missing.sum() < len(missing)
        seen = world_of(replay, plan).listed("sampled")
        assert (np.isinf(seen.arrives_s[0]) == missing).all()
        assert (seen.valid[0] == ~missing[seen.frame_ix]).all()

    def test_the_receiver_issues_nothing_meanwhile(self) -> None:
        outages = {"down_share": 0.5, "lasts_s": 2.0}
        plan = self.PLAN.model_copy(update={"units": experiment(units={"mast": unit(outages=outages)}).units})
        result = run_experiment(plan, [alone(10.0)])
        rates = result.summary["list_rate_hz"]
        assert (rates < 9.9).all()
        assert study_accuracy(result)
        instants, lists = (study_accuracy(result)[name].to_pandas() for name in ("instants.parquet", "lists.parquet"))
        assert instants["run"].tolist() == lists["run"].tolist()  # each run has its own
        assert instants["available_s"].map(len).tolist() == lists["lists"].tolist()

    def test_units_are_down_each_by_itself(self) -> None:
        off = {"down_share": 0.5, "lasts_s": 0.5}
        plan = experiment(
            units={"a": unit(outages=off), "b": unit(outages=off)}, configurations={"PEM": {"units": "all"}}
        )
        found = down(plan, alone(60.0), 50).reshape(50, 2, -1)
        both = (found[:, 0] & found[:, 1]).mean()
        assert abs(both - 0.25) < 0.03

    def test_none_is_today(self) -> None:
        plan = self.PLAN
        without = plan.model_copy(update={"units": experiment(units={"mast": unit(rate_hz=50.0)}).units})
        never = experiment(units={"mast": unit(rate_hz=50.0, outages={"down_share": 0.0, "lasts_s": 0.5})}).units
        result = run_experiment(without, [alone(4.0)])
        other = run_experiment(plan.model_copy(update={"units": never}), [alone(4.0)])
        assert study_rows(result).equals(study_rows(other))
        assert result.summary.equals(other.summary)


class TestClock:
    def test_stated_captures_go_back_to_true_ones(self) -> None:
        # Lists 0 to 2 of a unit 0.25 s ahead, clipped at an arrival 0.1 s after capture; 3 and 4 of one on time.
        captured_s = np.array([0.0, 0.1, 0.2, 0.1, 0.2])
        arrives_s = captured_s + 0.1
        stated = StatedCaptures(
            np.minimum(captured_s + 0.25 * np.array([1, 1, 1, 0, 0]), arrives_s), captured_s, arrives_s
        )
        assert stated.stated_s.round(9).tolist() == [0.1, 0.2, 0.3, 0.1, 0.2]
        assert stated.ahead_s == pytest.approx(0.1)
        fused = ObjectLists(np.array([[0, 1, 3, 4]]), entries_of(4))
        fused.entries["captured_s"] = [0.1, 0.1, 0.2, 0.3]
        # At 0.1 s list 3, captured then, is still on its way: what is stated as 0.1 s is list 0. At 0.2 s it has come.
        true = stated.true_lists(fused, np.array([0.1, 0.2, 0.3])).entries["captured_s"]
        assert true.round(9).tolist() == [0.0, 0.1, 0.1, 0.2]

    def test_what_tells_of_no_stated_capture_is_taken_at_its_word(self) -> None:
        stated = StatedCaptures(np.array([0.3]), np.array([0.2]), np.array([0.4]))
        fused = ObjectLists(np.array([[0, 1]]), entries_of(1))
        fused.entries["captured_s"] = 0.25
        assert stated.true_lists(fused, np.array([0.4])).entries["captured_s"].tolist() == [0.25]

    def test_offset_and_drift(self) -> None:
        plan = experiment(
            units={"mast": unit(clock={"offset_sigma_s": 0.02, "drift_sigma_ppm": 1000.0}), "sure": unit()},
            configurations={"PEM": {"units": "all"}},
        )
        scene, captured_s = ready(alone(1.0), plan).scene, np.array([0.0, 100.0, 100.0])
        of = [
            clock_errors_s(scene, ("mast", "sure"), plan, captured_s, np.array([0, 0, 1]), run) for run in range(1000)
        ]
        found = np.array(of)
        assert (found[:, 2] == 0).all()
        assert found[:, 0].std() == pytest.approx(0.02, rel=0.1)
        drift_s = found[:, 1] - found[:, 0]
        assert drift_s.std() == pytest.approx(0.1, rel=0.1)  # 1000 ppm of 100 s
        assert abs(np.corrcoef(found[:, 0], drift_s)[0, 1]) < 0.1  # independent: 3 standard errors
        assert clock_errors_s(scene, ("sure",), plan, captured_s, np.zeros(3, dtype=int), 0) is None

    def test_a_clock_error_is_an_error_of_position_and_no_other_time(self) -> None:
        """A car drives at 10 m/s past a unit that sees all of it; offset o shifts what its entries tell of by 10 o."""
        recording = scenes.recording([EGO, Thing("car", "car", driving(50, 0, -10))], until_s=6.0)
        changes: dict[str, Any] = {
            "seed": 5,  # one in which the clock is fast: nothing is told of before the log
            "configurations": {"late": {"units": ["mast"], "latency_s": 0.5, "fusion": {"kind": "union"}}},
            "measure": {"onset": {"kind": "appears"}, "match": {"gate_m": 20.0}},
        }
        off = experiment(units={"mast": unit(clock={"offset_sigma_s": 0.05})}, **changes)
        clocks, exact = (
            run_experiment(off, [recording]),
            run_experiment(experiment(units={"mast": unit()}, **changes), [recording]),
        )
        [error_s] = np.unique(
            clock_errors_s(clocks.logs[0].replay().scene, ("mast",), off, np.zeros(1), np.zeros(1, dtype=int), 0)  # type: ignore[arg-type]
        )
        assert error_s > 0.005
        assert study_rows(exact)["position_rmse_captured_m"].item() < 1e-6
        assert study_rows(clocks)["position_rmse_captured_m"].item() == pytest.approx(10 * error_s, rel=1e-3)
        for column in ("detection_s", "captured_s", "age_of_information_s"):
            assert study_rows(clocks)[column].item() == pytest.approx(study_rows(exact)[column].item(), abs=1e-9), (
                column
            )

    SIGMA_S = 0.05

    @staticmethod
    def early_and_late() -> Recording:
        """Cars and people, to 15 m/s: five from the first frame on, five who appear later, some leave."""
        things = [EGO]
        for k in range(5):
            things += [
                Thing(f"first {k}", "car", driving(-40 + 30 * k, 10 + 9 * k, 3 * k + 3, -2.0)),
                Thing(
                    f"later {k}", "pedestrian", driving(-40 + 30 * k, -10 - 9 * k, -1.5, 15 - 3 * k),
                    there=lambda t, k=k: 0.35 + 0.3 * k < t < 2.55 + 0.1 * k,  # type: ignore[misc]
                ),
            ]  # fmt: skip
        return scenes.recording(things, until_s=4.0)

    def compared(self, fusion: str, **changes: Any) -> tuple[Any, Any]:
        """The rows of an exact clock, and of one that is off, in 60 runs."""
        of: dict[str, Any] = {
            "runs": 60, "measure": {"onset": {"kind": "appears"}},
            "configurations": {"late": {"units": ["mast"], "latency_s": 0.2, "fusion": {"kind": fusion}}},
        } | changes  # fmt: skip
        exact = run_experiment(experiment(units={"mast": unit()}, **of), [self.early_and_late()])
        off = run_experiment(
            experiment(units={"mast": unit(clock={"offset_sigma_s": self.SIGMA_S})}, **of), [self.early_and_late()]
        )
        return exact, off

    @pytest.mark.parametrize("fusion", ["union", "gnn"])
    def test_a_clock_error_costs_no_time_that_is_not_there(self, fusion: str) -> None:
        """The unit sees all: who is there is listed, whatever the clock says, and known when the list arrives."""
        exact, off = self.compared(fusion)
        keys = ["object_id", "run"]
        both = study_rows(exact).merge(study_rows(off), on=keys, suffixes=("", "_off"))
        assert len(both) == 60 * 10
        late_s = both["detection_s_off"] - both["detection_s"]
        assert not late_s.isna().any()
        first = both["object_id"].str.startswith("first")
        # 1 µs: what is one instant. An entry about nobody would cost the next list, 0.1 s, in every other run.
        assert abs(late_s[first].mean()) <= 1e-6
        assert abs(late_s[~first].mean()) <= 1e-6

    def test_what_a_fast_clock_tells_of_who_has_left_is_stale_and_not_false(self) -> None:
        """Lists that are on their way when an object leaves tell of it, whatever the clock says."""
        exact, off = self.compared(
            "union", measure={"onset": {"kind": "appears"}, "objects": {"classes": ["pedestrian"]}}
        )
        for name, some in (("false_positives_per_min", False), ("stale_false_positives_per_min", True)):
            [rate], [rate_off] = exact.summary[name], off.summary[name]
            assert (rate > 0) == some
            assert rate_off == pytest.approx(rate, rel=1e-12), name

    def test_an_offset_of_nothing_changes_no_bit(self) -> None:
        of: dict[str, Any] = {
            "runs": 3, "measure": {"onset": {"kind": "appears"}},
            "configurations": {"late": {"units": ["mast"], "latency_s": 0.2, "fusion": {"kind": "gnn"}}},
        }  # fmt: skip
        without, nothing = (
            run_experiment(experiment(units={"mast": unit(**clock)}, **of), [self.early_and_late()])
            for clock in ({}, {"clock": {"offset_sigma_s": 0.0}})
        )
        assert study_rows(without).equals(study_rows(nothing))
        assert without.summary.equals(nothing.summary)

    def test_ideal_fusion_does_not_know_of_it_and_is_said_not_to(self) -> None:
        plan = experiment(
            units={"mast": unit(clock={"offset_sigma_s": 0.05})}, configurations={"PEM": {"units": "all"}}
        )
        result = run_experiment(plan, [alone(2.0)])
        without = run_experiment(
            experiment(units={"mast": unit()}, configurations={"PEM": {"units": "all"}}), [alone(2.0)]
        )
        assert study_rows(result).equals(study_rows(without))
        assert (
            "scene: configuration PEM: ideal fusion uses true captures, ignoring clock errors of mast" in result.notes
        )


class TestPlaced:
    @staticmethod
    def listed(placed: dict[str, Any], runs: int, things: list[Thing] | None = None, until_s: float = 0.0) -> Any:
        """What a unit at the origin lists of a car 50 m to the east, or others, and the truth."""
        plan = experiment(units={"mast": unit(placed=placed)}, configurations={"PEM": {"units": "all"}})
        recording = scenes.recording([EGO, *(things or [Thing("car", "car", standing(50, 0))])], until_s=until_s)
        replay = ready(recording, plan)
        world = world_of(replay, plan, np.arange(runs))
        seen = world.listed("sampled")
        return seen, world.observations.tracks, replay.scene

    def test_one_degree_at_fifty_metres(self) -> None:
        seen, _, scene = self.listed({"yaw_sigma_deg": 1.0, "stated": True}, 4000)
        [car] = np.flatnonzero(seen.row_object_ix == scene.object_number["car"])
        assert 50 * math.pi / 180 == pytest.approx(0.8727, abs=5e-5)
        assert seen.y_m[:, car].std() == pytest.approx(0.8727, rel=0.05)
        assert seen.cov_nn_m2[0, car] == pytest.approx(0.8727**2, abs=1e-4)
        assert seen.cov_ee_m2[0, car] == 0
        assert seen.yaw_var_rad2[0, car] == pytest.approx(math.radians(1) ** 2)
        # Turned about the unit: as far from it as before, and pointing the same way from there.
        assert np.allclose(np.hypot(seen.x_m[:, car], seen.y_m[:, car]), 50, atol=1e-9)
        assert np.allclose(seen.yaw_rad[:, car], np.arctan2(seen.y_m[:, car], seen.x_m[:, car]), atol=1e-12)

    def test_position_and_covariance_that_is_not_stated(self) -> None:
        seen, true, _ = self.listed({"position_sigma_m": 0.3}, 4000)
        off = seen.x_m - true.x_m
        assert off.std() == pytest.approx(0.3, rel=0.05)
        assert (np.ptp(off, axis=1) < 1e-9).all()  # the same for the ego and the car
        assert not seen.cov_ee_m2.any()

    def test_the_velocity_turns_with_it(self) -> None:
        seen, true, _ = self.listed({"yaw_sigma_deg": 10.0}, 50, [Thing("car", "car", driving(50, 0, 8, 6))])
        turn = np.arctan2(seen.vy_mps, seen.vx_mps) - np.arctan2(true.vy_mps, true.vx_mps)
        moving = np.hypot(true.vx_mps[0], true.vy_mps[0]) > 1
        assert np.allclose(turn[:, moving], (seen.yaw_rad - true.yaw_rad)[:, moving])
        assert np.allclose(np.hypot(seen.vx_mps, seen.vy_mps), np.hypot(true.vx_mps, true.vy_mps))

    def test_how_long_it_lasts(self) -> None:
        parts = [{"share": 0.25, "correlation_s": "always"}, {"share": 0.75, "correlation_s": 1.0}]
        seen, true, scene = self.listed({"position_sigma_m": 1.0, "memory": parts}, 3000, until_s=1.0)
        rows = np.flatnonzero(seen.row_object_ix == scene.object_number["car"])
        off = (seen.x_m - true.x_m)[:, rows]  # lists 0.1 s apart
        for lists in (1, 5, 10):
            expected = 0.25 + 0.75 * math.exp(-lists / 10)
            assert np.corrcoef(off[:, 0], off[:, lists])[0, 1] == pytest.approx(expected, abs=4 / math.sqrt(3000))

    def test_who_is_seen_follows_the_true_pose(self) -> None:
        """At 59 m of 60 m that the unit sees: it lists the car in every run, wherever it takes itself to be."""
        plan = experiment(units={"mast": unit(pem="sure", placed={"position_sigma_m": 5.0})})
        replay = ready(scenes.recording([EGO, Thing("car", "car", standing(59, 0))], until_s=0), plan)
        assert world_of(replay, plan, np.arange(50)).listed("sampled").valid.all()


RECORDED = "  lists: {recorded: {topic: objects}, %s}"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("placed: {yaw_sigma_deg: 1}", "placed: a recorded unit is where its lists say"),
        ("clock: {offset_sigma_s: 1}", "clock: a recorded unit captures when its lists say"),
        ("outages: {down_share: 0.1, lasts_s: 1}", "outages: a recorded unit makes the lists that are recorded"),
    ],
)  # fmt: skip
def test_not_of_recorded_units(tmp_path: Path, text: str, said: str) -> None:
    whole = changed("configurations: {GT: {units: truth}}").replace(
        "configurations:", RECORDED % text + "\nconfigurations:"
    )
    lines = [line for line in whole.splitlines() if not line.startswith(("  PEM:", "  coPEM:", "  GT:"))]
    _, found = find_problems(source_of(tmp_path, "\n".join(lines)))
    assert [line.partition(": ")[2] for line in found] == [f"units.lists.{said}; only for units with a pem"]


@pytest.mark.parametrize(
    ("key", "text", "said"),
    [
        (
            "outages",
            "{down_share: 1.2, lasts_s: 1}",
            "units.mast.outages.down_share: expected at most 0.999, found 1.2",
        ),
        ("outages", "{down_share: 0.2}", "units.mast.outages.lasts_s: missing"),
        ("clock", "{offset_s: 0.2}", "units.mast.clock.offset_s: unknown key; did you mean offset_sigma_s?"),
        ("placed", "{yaw_sigma_deg: -1}", "units.mast.placed.yaw_sigma_deg: expected at least 0, found -1"),
        (
            "placed",
            "{memory: [{share: 0.7, correlation_s: 1}, {share: 0.5, correlation_s: 2}]}",
            "units.mast.placed.memory: shares sum to 1.2, expected at most 1",
        ),
        (
            "placed",
            "{memory: [{share: 0.7, correlation_s: 1, of: object}]}",
            "units.mast.placed.memory: of: object: a pose is of no object; expected unit or all",
        ),
    ],
)
def test_problems(tmp_path: Path, key: str, text: str, said: str) -> None:
    whole = changed().replace("height_m: 5.0,", f"height_m: 5.0, {key}: {text},")
    _, found = find_problems(source_of(tmp_path, whole))
    assert [line.partition(": ")[2] for line in found] == [said]


def test_a_posterior_has_no_memory(tmp_path: Path) -> None:
    whole = changed().replace("height_m: 5.0,", "height_m: 5.0, placed: {yaw_sigma_deg: 1},")
    whole = whole.replace("latency_s: 0.5}", "latency_s: 0.5, fusion: {kind: ideal, combine: posterior}}")
    _, found = find_problems(source_of(tmp_path, whole))
    said = "configurations.coPEM.fusion.combine: posterior draws anew at each instant and has no memory; use samples"
    assert [line.partition(": ")[2] for line in found] == [said]


def test_outages_have_no_closed_form(tmp_path: Path) -> None:
    whole = changed("measure: {exact: true}").replace(
        "height_m: 5.0,", "height_m: 5.0, outages: {down_share: 0.1, lasts_s: 1},"
    )
    _, found = find_problems(source_of(tmp_path, whole))
    said = (
        "measure.exact: unit 'mast' has outages, in which all objects miss all lists together: that has no closed form"
    )
    assert [line.partition(": ")[2] for line in found] == [said]
    drive(tmp_path / "drive.mcap")

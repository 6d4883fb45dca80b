"""The tables of how good lists were: each says the same as the others, and as the summary."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

from copem_replay.io.recording import Recording
from copem_replay.pipeline import replay as blocks_module
from copem_replay.pipeline.one_run import tracks_of_run
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.run import StudyTables, run_experiment
from copem_replay.pipeline.scoring import DISTANCE_EDGES_M, EXISTENCE_THRESHOLDS
from tests.helpers.replays import study_accuracy, study_rows
from tests.helpers.scenes import EGO_UNIT, Thing, driving, experiment, recording, standing

KEYS = ["log", "configuration", "run", "object_id"]
NAMES = ("GT", "ideal", "union", "gnn", "tracker")
HALF = 1 / 2048
"""Metres: what is kept of each list and object is rounded to twice that, errors in m, parts of GOSPA in m²."""
APPEARS: dict[str, Any] = {"onset": {"kind": "appears"}}


def pems(probability: float = 1.0, sigma_m: float = 0.0, **more: Any) -> Any:
    couple: dict[str, Any] = {"detection": {"kind": "constant", "probability": probability}} | more
    if sigma_m:
        couple["error"] = {"kind": "gaussian", "covariance_m2": [[sigma_m**2, 0.0], [0.0, sigma_m**2]]}
    return {"p": [couple]}


def configurations(*names: str, **more: Any) -> dict[str, Any]:
    ours = {name: {"units": "all", "fusion": {"kind": name}} | more for name in names}
    return {"GT": {"units": "truth"}, "ideal": {"units": "all"} | more} | ours


UNITS = {"ego": EGO_UNIT | {"pem": "p"}, "mast": {"at": [30, 10], "height_m": 5.0, "pem": "q"}}


def street(name: str, speed_mps: float) -> Recording:
    """The ego drives; a car comes towards it and leaves, one stands, a pedestrian appears after 0.7 s. 2 s."""
    things = [
        Thing("ego", "car", driving(0, 0, 4)), Thing("in", "car", driving(60, 5, -speed_mps), lambda t: t < 1.55),
        Thing("parked", "car", standing(22, -6)), Thing("late", "pedestrian", driving(14, 6, 0, -1), lambda t: t > 0.6),
    ]  # fmt: skip
    return recording(things, until_s=2.0, log=name)


@pytest.fixture(scope="module")
def result() -> StudyTables:
    """Everything that can happen to a list: misses, errors, stale entries, who is looked at from some instant on."""
    plan = experiment(
        runs=5,
        pems={"p": pems(0.6, 0.8)["p"], "q": pems(0.7, 0.3, existence=0.6)["p"]},
        units=UNITS,
        configurations=configurations(*NAMES[2:], latency_s={"mast": 0.35}),
        measure={"onset": {"kind": "in_range", "range_m": 50}},
    )
    return run_experiment(plan, [street("one", 10), street("two", 25)], jobs=2)


def tables(of: StudyTables) -> dict[str, pa.Table]:
    assert study_accuracy(of)
    return study_accuracy(of)


def rows(of: StudyTables, configuration: str, name: str = "accuracy") -> pd.DataFrame:
    table = of.bands if name == "bands" else tables(of)[f"{name}.parquet"].to_pandas()
    return table[table["configuration"] == configuration]


def figures(of: StudyTables, configuration: str) -> pd.Series:
    return of.summary.set_index("configuration").loc[configuration]


def values(column: pd.Series) -> Any:
    """Of all lists of all rows; NaN: none."""
    return np.concatenate([np.asarray(one, dtype=float) for one in column])


class TestTheSame:
    def test_rows_are_those_of_detections(self, result: StudyTables) -> None:
        for name in ("accuracy", "detections"):
            table = study_rows(result) if name == "detections" else tables(result)["accuracy.parquet"].to_pandas()
            expected = [
                (log, c, s, o)
                for log in ("one", "two")
                for c in NAMES
                for s in range(5)
                for o in ("in", "parked", "late")
            ]
            assert list(table[KEYS].itertuples(index=False, name=None)) == expected

    def test_lists_of_a_stay(self, result: StudyTables) -> None:
        """From the first instant the object is in the log, whatever its onset, to the end of the look."""
        instants = tables(result)["instants.parquet"]
        available_s = instants.to_pandas().set_index(["log", "configuration"])["available_s"]
        since_s = {"in": 0.0, "parked": 0.0, "late": 0.7}
        ended_s = study_rows(result)["ended_s"]
        for name in NAMES:
            for one in rows(result, name).itertuples():
                times_s = available_s[one.log, name]
                first, last = one.first_list, one.first_list + len(one.error_m)
                until_s = ended_s[one.Index]
                assert (times_s[first:last] > since_s[one.object_id] - 1e-6).all()
                assert (times_s[first:last] < until_s + 1e-6).all()
                assert last == len(times_s) or times_s[last] > until_s
                assert first == 0 or times_s[first - 1] < since_s[one.object_id]
                onset_s = study_rows(result)["onset_s"][one.Index]
                looked = ~np.isnan(np.asarray(one.gospa_m2, dtype=float))
                assert (looked == (times_s[first:last] > onset_s - 1e-6)).all()

    def test_errors_and_gospa_are_those_of_the_summary(self, result: StudyTables) -> None:
        for name in NAMES:
            found, table = figures(result, name), rows(result, name)
            error_m = values(table["error_m"])
            assert np.sqrt(np.nanmean(error_m**2)) == pytest.approx(found["position_rmse_m"], abs=HALF)
            looked = {
                (one.log, one.run, one.first_list + k)
                for one in table.itertuples()
                for k in np.flatnonzero(~np.isnan(np.asarray(one.gospa_m2, dtype=float)))
            }
            square_m2 = np.nansum(values(table["gospa_m2"])) / len(looked)
            assert square_m2 == pytest.approx(found["gospa_m"] ** 2, abs=3 * HALF), "three objects"
            parts = [found[f"gospa_{part}_m"] for part in ("localisation", "missed", "false")]
            assert np.hypot(np.hypot(*parts[:2]), parts[2]) == pytest.approx(found["gospa_m"])
            assert len(looked) > 100

    def test_columns_of_detections(self, result: StudyTables) -> None:
        for name in NAMES:
            table = study_rows(result)[study_rows(result)["configuration"] == name]
            errors = [np.asarray(one, dtype=float) for one in rows(result, name)["error_m"]]
            count = np.array([np.count_nonzero(~np.isnan(one)) for one in errors])
            assert table["matched_lists"].tolist() == count.tolist()
            rmse_m = [np.sqrt(np.nanmean(one**2)) if n else np.nan for one, n in zip(errors, count, strict=True)]
            np.testing.assert_allclose(table["position_rmse_m"], rmse_m, atol=HALF)
            assert table["longest_gap_s"].mean() == pytest.approx(figures(result, name)["longest_gap_s"])
            assert table["identity_switches"].isna().all() == (name != "tracker")
            bias_m = (table["bias_east_m"].fillna(0) * count).sum() / count.sum()
            assert bias_m == pytest.approx(figures(result, name)["bias_east_m"])

    def test_ghosts(self, result: StudyTables) -> None:
        some = 0
        for name in NAMES:
            table, found = rows(result, name, "lists"), figures(result, name)
            assert table["ghosts"].tolist() == [counts[0] for counts in table["ghosts_at"]]
            tracks = rows(result, name, "false_tracks").groupby(["log", "run"])["entries"].sum()
            of_runs = table.set_index(["log", "run"])["ghosts"]
            assert tracks.reindex(of_runs.index, fill_value=0).tolist() == of_runs.tolist(), "those of the list"
            assert table["stale_ghosts"].sum() / table["minutes"].sum() == pytest.approx(
                found["stale_false_positives_per_min"]
            )
            assert all((np.diff(counts) <= 0).all() for counts in table["ghosts_at"])
            assert all(tuple(existence) == EXISTENCE_THRESHOLDS for existence in table["existence"])
            assert table["ghosts"].sum() / table["minutes"].sum() == pytest.approx(found["false_positives_per_min"])
            assert table["duplicates"].sum() / table["minutes"].sum() == pytest.approx(found["duplicates_per_min"])
            assert list(zip(table["log"], table["run"], strict=True)) == [
                (g, s) for g in ("one", "two") for s in range(5)
            ]
            # In most lists somebody is looked at, to whom the ghosts of the list are put down.
            assert rows(result, name)["ghosts"].sum() <= table["ghosts"].sum()
            some += table["ghosts"].sum()
        assert some > 100

    def test_thresholds(self, result: StudyTables) -> None:
        """By match, for ideal fusion and the truth too, which are detected by truth id and so at least as soon."""
        for name in NAMES:
            steps = rows(result, name, "thresholds")
            first = steps.groupby(KEYS, sort=False)["detection_s"].first()
            detection_s = study_rows(result)[study_rows(result)["configuration"] == name].set_index(KEYS)["detection_s"]
            if name in ("GT", "ideal"):
                assert (first >= detection_s[first.index] - 1e-9).all()
                assert set(steps["existence"]) == {1.0}
            else:
                pd.testing.assert_series_equal(first, detection_s.dropna(), check_exact=True)
            for _, part in steps.groupby(KEYS):
                assert (np.diff(part["existence"]) > 0).all()
                assert (np.diff(part["detection_s"]) > 0).all()
        assert len(rows(result, "union", "thresholds")) > rows(result, "union", "thresholds").groupby(KEYS).ngroups

    def test_bands_add_up(self, result: StudyTables) -> None:
        for name in NAMES:
            table, of_lists, bands = rows(result, name), rows(result, name, "lists"), rows(result, name, "bands")
            pairs = np.count_nonzero(~np.isnan(values(table["error_m"])))
            looked = np.count_nonzero(~np.isnan(values(table["gospa_m2"])))
            for by in ("distance_m", "time_s"):
                of = bands[bands["by"] == by]
                assert (of["log"] == "all").all() if by == "distance_m" else set(of["log"]) == {"one", "two"}
                assert (of["pairs"].sum(), of["looked"].sum()) == (pairs, looked)
                assert of["ghosts"].sum() == of_lists["ghosts"].sum()
                square_m2 = (of["pairs"] * of["position_rmse_m"].fillna(0) ** 2).sum()
                assert square_m2 / pairs == pytest.approx(figures(result, name)["position_rmse_m"] ** 2, abs=1e-12)
                nees = (of["pairs"] * of["nees"].fillna(0)).sum() / pairs
                assert nees == pytest.approx(figures(result, name)["nees"])
            edges = bands[bands["by"] == "distance_m"][["from", "to"]].to_numpy()
            assert set(edges.ravel()) <= set(DISTANCE_EDGES_M)
            of = bands[bands["by"] == "existence"]
            off = (of["entries"] * (of["with_object_share"] - of["existence"]).abs()).sum() / of["entries"].sum()
            assert off == pytest.approx(figures(result, name)["existence_ece"])
            ghosts = (of["entries"] * (1 - of["with_object_share"])).sum()
            # What is about nobody is a ghost, or somebody has come to where it is.
            false = of_lists["ghosts"].sum()
            assert round(ghosts) == false if name in ("GT", "tracker") else round(ghosts) >= false


class TestWhatIsThere:
    def test_not_asked_for(self) -> None:
        plan = experiment(units={"ego": UNITS["ego"]}, pems=pems(), configurations=configurations("gnn"),
                          measure=APPEARS | {"accuracy": False})  # fmt: skip
        result = run_experiment(plan, [street("one", 10)])
        assert not study_accuracy(result)
        assert "position_rmse_m" not in result.summary
        assert "matched_lists" not in study_rows(result)
        assert study_rows(result)["detected"].all()

    def test_fleets(self) -> None:
        """Each run has other units, so other instants, which are told by run; whatever the blocks."""
        fleet = {"ego": UNITS["ego"], "obu": {"on": {"classes": ["car"], "penetration_rate": 0.5}, "pem": "p"}}
        late = configurations("union", "gnn", latency_s={"ego": 0.0, "default": 0.13})
        plan = experiment(units=fleet, pems=pems(0.8, 0.5), runs=8, measure=APPEARS, configurations=late)
        result = run_experiment(plan, [street("one", 10)])
        assert len(set(rows(result, "union", "lists")["lists"])) > 1
        for name in ("GT", "ideal", "union", "gnn"):
            table, found = study_rows(result)[study_rows(result)["configuration"] == name], figures(result, name)
            square_m2 = (table["matched_lists"] * table["position_rmse_m"].fillna(0) ** 2).sum()
            rmse_m = np.sqrt(square_m2 / table["matched_lists"].sum())
            assert rmse_m == pytest.approx(found["position_rmse_m"])
            lists = rows(result, name, "lists")
            assert lists["ghosts"].sum() / lists["minutes"].sum() == pytest.approx(found["false_positives_per_min"])
            assert lists["run"].tolist() == list(range(8))
            instants = rows(result, name, "instants")
            assert instants["run"].tolist() == list(range(8))
            late = instants["available_s"].map(
                lambda of: sum(t > 1e-6 + result.logs[0].replay().scene.end_s for t in of)
            )
            assert (instants["available_s"].map(len) - late).tolist() == lists["lists"].tolist()
            errors = rows(result, name)
            pd.testing.assert_frame_equal(
                errors[["run", "object_id"]].reset_index(drop=True), table[["run", "object_id"]].reset_index(drop=True)
            )
            of_row = [np.array(row, dtype=float) for row in errors["error_m"]]
            square_m2 = np.array([np.nansum(row**2) for row in of_row])
            pairs = np.array([np.isfinite(row).sum() for row in of_row])
            assert pairs.tolist() == (table["matched_lists"] - table["unplaced_lists"]).tolist()
            np.testing.assert_allclose(square_m2, pairs * table["position_rmse_m"].fillna(0) ** 2, rtol=2e-3, atol=1e-4)
            first = rows(result, name, "thresholds").groupby(KEYS, sort=False)["detection_s"].first()
            if name in ("union", "gnn"):
                pd.testing.assert_series_equal(first, table.set_index(KEYS)["detection_s"].dropna(), check_exact=True)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(blocks_module, "BLOCK_BYTES", 1)
            other = run_experiment(plan, [street("one", 10)], jobs=2)
        pd.testing.assert_frame_equal(result.summary, other.summary, check_exact=True)
        for name, table in tables(result).items():
            assert table.equals(tables(other)[name]), name
        pd.testing.assert_frame_equal(study_rows(result), study_rows(other), check_exact=True)
        assert result.bands is not None
        assert result.bands.equals(other.bands)


def still(*others: Thing) -> Recording:
    """The ego and a pedestrian stand, 20 m apart; and `others`; 2 s."""
    return recording([Thing("ego", "car", standing(0, 0)), Thing("a", "pedestrian", standing(20, 5)), *others],
                     until_s=2.0)  # fmt: skip


class TestInTheHead:
    @pytest.mark.parametrize("kind", ["union", "nms", "gnn", "tracker"])
    def test_one_exact_unit_gives_the_truth(self, kind: str) -> None:
        """All but the tracker know when ideal fusion does; a track is confirmed by a second list, 0.1 s later."""
        others = [Thing("car", "car", driving(60, -6, -10), yaw_rad=np.pi), Thing("b", "pedestrian", driving(9, 9, 1))]
        plan = experiment(
            units={"ego": UNITS["ego"]}, pems=pems(), configurations=configurations(kind), measure=APPEARS
        )
        result = run_experiment(plan, [still(*others)])
        late_s = 0.1 if kind == "tracker" else 0.0
        assert study_rows(result)["detection_s"].tolist() == [0.0] * 6 + [pytest.approx(late_s)] * 3
        for figure in (
            "position_rmse_m",
            "position_rmse_captured_m",
            "false_positives_per_min",
            "duplicates_per_min",
            "age_of_information_s",
        ):
            assert figures(result, kind)[figure] == pytest.approx(0, abs=1e-6), figure

    @pytest.mark.parametrize(("sigma_m", "said"), [(0.5, False), (2.0, True)])
    def test_what_the_gate_cuts_off_is_said(self, sigma_m: float, said: bool) -> None:
        plan = experiment(units={"ego": UNITS["ego"]}, pems=pems(sigma_m=sigma_m), measure=APPEARS,
                          configurations=configurations("union"))  # fmt: skip
        result = run_experiment(plan, [still()])
        found = [note for note in result.notes if "expected beyond the gate of 3 m" in note]
        assert len(found) == said
        if said:
            assert "ideal 32 %, union 32 %;" in found[0], "e^(−9/8), of the truth none"
            assert figures(result, "union")["nees_expected"] == pytest.approx(0.9184, abs=1e-4)

    def test_two_units_list_it_twice(self) -> None:
        plan = experiment(units=UNITS, pems=pems() | {"q": pems()["p"]}, measure=APPEARS,
                          configurations=configurations("union", "nms", "gnn"))  # fmt: skip
        result = run_experiment(plan, [still()])
        assert rows(result, "union", "lists")[["lists", "duplicates", "ghosts"]].to_numpy().tolist() == [[21, 21, 0]]
        for kind in ("nms", "gnn"):
            assert rows(result, kind, "lists")[["lists", "duplicates", "ghosts"]].to_numpy().tolist() == [[21, 0, 0]]
        assert set(study_rows(result)["matched_lists"]) == {21}

    def test_an_entry_is_about_its_object_within_the_gate_and_that_of_ideal_fusion_anywhere(self) -> None:
        """By hand: the first list from the onset on in which the place is at most 3 m off."""
        measure: Any = {"onset": {"kind": "at", "time_s": 0.5}}
        common: Any = {"pems": pems(1.0, 2.5), "runs": 30, "configurations": configurations("union")}
        common["units"] = {"ego": UNITS["ego"]}
        plan = experiment(measure=measure, **common)
        by_id = study_rows(run_experiment(plan, [still()])).set_index("configuration")
        assert set(by_id.loc["ideal", "detection_s"]) == {0.5}
        expected_s = []
        for k in range(30):
            fused = tracks_of_run(prepare_log(still(), plan), plan, k)["ideal"].fused
            times_s = fused.captured_s[fused.frame_ix]
            near = np.hypot(fused.x_m[0] - 20, fused.y_m[0] - 5) <= 3.0
            expected_s.append(times_s[near & (times_s > 0.49)].min())
        np.testing.assert_allclose(by_id.loc["union", "detection_s"], expected_s)
        assert 5 < np.count_nonzero(np.array(expected_s) > 0.51) < 30

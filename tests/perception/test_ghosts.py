"""Ghosts (invariant 9): how many, for how long, where, and what they leave as it is."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd
import pytest
import shapely
from scipy import stats

from copem_replay.core.site_map import make_area
from copem_replay.core.tracks import CLASSES, Float
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import find_problems
from copem_replay.io.recording import Recording
from copem_replay.perception.ghosts import GhostRows, draw_ghosts, make_ghost_draws
from copem_replay.perception.perceive import EntryClaims, add_states, draw_claims
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.run import run_experiment
from copem_replay.pipeline.sweep import list_points
from tests.helpers import scenes
from tests.helpers.experiments import changed, source_of
from tests.helpers.replays import study_accuracy, study_rows, world_of
from tests.helpers.scenes import SEES_60_M, Thing, driving, experiment, standing

FIELD = {"kind": "field", "range_m": [3, 60], "azimuth_deg": [-60, 60]}
GNN = {"units": "all", "fusion": {"kind": "gnn"}}


def plan_of(*sorts: dict[str, Any], units: dict[str, Any] | None = None, **changes: Any) -> Experiment:
    """A mast at the origin that looks east, with ghosts."""
    mast = {"at": [0.0, 0.0], "height_m": 5.0, "pem": "eyes", "rate_hz": changes.pop("rate_hz", 10.0)}
    return experiment(
        pems={"eyes": {"couples": SEES_60_M, "ghosts": list(sorts)} | changes.pop("pem", {})},
        units=units or {"mast": mast},
        configurations={"GT": {"units": "truth"}, "ideal": {"units": "all"}, "gnn": GNN},
        **changes,
    )


def scene_of(*things: Thing, until_s: float = 60.0) -> Recording:
    ego = Thing("ego", "car", standing(30, 10))
    return scenes.recording([ego, *things], until_s=until_s)


def found(plan: Experiment, recording: Recording, runs: int) -> list[GhostRows]:
    """By run the ghosts in all lists."""
    replay = prepare_log(recording, plan)
    world = world_of(replay, plan)
    made = [
        draw_ghosts(replay.scene, world.observations, replay.expanded, replay.placed, k, (-np.inf, np.inf))
        for k in range(runs)
    ]
    return [one for one in made if one is not None]


def counts(rows: GhostRows, unit: int = 0) -> Any:
    """(F,) how many ghosts there are in each list of a unit."""
    tracks = rows.observations.tracks
    of = np.bincount(tracks.frame_ix, minlength=len(tracks.stamp_ns))
    return of[tracks.frame_unit_ix == unit]


def assert_poisson(count: Any, mean: float) -> None:
    """χ² of independent counts."""
    top = int(stats.poisson.ppf(1 - 5 / len(count), mean))
    expected = len(count) * np.append(stats.poisson.pmf(np.arange(top), mean), stats.poisson.sf(top - 1, mean))
    assert stats.chisquare(np.bincount(np.minimum(count, top), minlength=top + 1), expected).pvalue > 1e-3


class TestCounts:
    @pytest.mark.parametrize("rate_hz", [5.0, 50.0])
    def test_poisson_and_exponential_at_any_list_rate(self, rate_hz: float) -> None:
        made = found(plan_of({"in_list": 0.8, "lasts_s": 0.7, "where": FIELD}, rate_hz=rate_hz), scene_of(), 40)
        every = np.concatenate([counts(rows)[:: round(5 * rate_hz)] for rows in made])  # 5 s apart: e^-7 in common
        assert len(every) == 40 * 13
        assert_poisson(every, 0.8)
        # A life in which there is a list goes on from there as if it began anew: P(more than k lists, given one) is
        # e^(-k T / τ). Those at the ends of the log are cut.
        lists = np.concatenate([np.diff(rows.observations.tracks.start) for rows in made])
        n = np.arange(0, round(2 * rate_hz))
        expected = np.exp(-n / rate_hz / 0.7)
        assert len(lists) > 1000
        assert abs(np.array([(lists > k).mean() for k in n]) - expected).max() < 1.63 / math.sqrt(len(lists)) + 0.01

    def test_a_faster_unit_sees_the_same_ghosts(self) -> None:
        slow, fast = (
            found(plan_of({"in_list": 0.8, "lasts_s": 0.7, "where": FIELD}, rate_hz=rate), scene_of(until_s=20), 1)[0]
            for rate in (5.0, 50.0)
        )
        assert (counts(fast)[::10] == counts(slow)).all()
        both = np.isin(
            fast.observations.tracks.stamp_ns[fast.observations.tracks.frame_ix], slow.observations.tracks.stamp_ns
        )
        assert (
            np.sort(fast.observations.tracks.x_m[0, both]).tolist() == np.sort(slow.observations.tracks.x_m[0]).tolist()
        )

    def test_others_in_every_list(self) -> None:
        made = found(plan_of({"in_list": 1.5, "lasts_s": 0, "where": FIELD}), scene_of(), 4)
        assert_poisson(np.concatenate([counts(rows) for rows in made]), 1.5)
        assert all((np.diff(rows.observations.tracks.start) == 1).all() for rows in made)
        assert len(np.unique(made[0].observations.tracks.x_m)) == made[0].observations.tracks.x_m.size

    def test_units_have_each_their_own(self) -> None:
        mast = {"at": [0.0, 0.0], "height_m": 5.0, "pem": "eyes"}
        plan = plan_of({"in_list": 2.0, "lasts_s": 0.2, "where": FIELD}, units={"a": mast, "b": mast})
        made = found(plan, scene_of(), 20)
        a, b = (np.concatenate([counts(rows, unit)[::20] for rows in made]) for unit in (0, 1))
        assert abs(np.corrcoef(a, b)[0, 1]) < 4 / math.sqrt(len(a))
        assert a.mean() == pytest.approx(2.0, abs=4 * math.sqrt(2 / len(a)))

    def test_none(self) -> None:
        [rows] = found(plan_of({"in_list": 0, "lasts_s": 1, "where": FIELD}), scene_of(until_s=2), 1)
        assert len(rows.words) == 0


class TestPlaces:
    def test_a_field_has_equally_many_by_area(self) -> None:
        view = np.concatenate([
            np.stack([rows.observations.view.range_m, rows.observations.view.azimuth_rad])
            for rows in found(plan_of({"in_list": 2, "lasts_s": 0, "where": FIELD}), scene_of(until_s=30), 4)
        ], axis=1)  # fmt: skip
        range_m, azimuth_rad = view
        assert stats.kstest((range_m**2 - 9) / (3600 - 9), "uniform").pvalue > 1e-3
        assert stats.kstest((azimuth_rad + math.pi / 3) / (2 * math.pi / 3), "uniform").pvalue > 1e-3

    def test_a_field_moves_with_the_unit(self) -> None:
        ego = {"on": "ego", "height_m": 1.8, "pem": "eyes"}
        recording = scenes.recording([Thing("ego", "car", driving(0, 0, 10))], until_s=10.0)
        plan = plan_of({"in_list": 1.0, "lasts_s": 5.0, "where": FIELD}, units={"ego": ego})
        [rows] = found(plan, recording, 1)
        tracks = rows.observations.tracks
        first = tracks.start[np.argmax(np.diff(tracks.start))]
        assert tracks.x_m[0, first + 5] - tracks.x_m[0, first] == pytest.approx(5.0)
        assert rows.observations.view.range_m[first + 5] == pytest.approx(rows.observations.view.range_m[first])

    def test_places_of_the_world(self) -> None:
        where = {"kind": "places", "at_m": [[12, 3], [-4, 7]], "spread_m": 0.5}
        made = found(plan_of({"in_list": 2, "lasts_s": 0, "where": where}), scene_of(until_s=30), 4)
        x_m = np.concatenate([rows.observations.tracks.x_m[0] for rows in made])
        y_m = np.concatenate([rows.observations.tracks.y_m[0] for rows in made])
        east = x_m > 4
        assert east.mean() == pytest.approx(0.5, abs=0.04)
        assert stats.kstest((x_m[east] - 12) / 0.5, "norm").pvalue > 1e-3
        assert stats.kstest((y_m[~east] - 7) / 0.5, "norm").pvalue > 1e-3

    def test_areas_of_the_world(self) -> None:
        """Uniform over their union: an own triangle, a strip, and crosswalks of a map, of which one has a hole."""
        square = np.array([[20.0, 0], [30, 0], [30, 10], [20, 10]])
        walks = (
            make_area("crosswalk 7", "crosswalk", square, square / 2 + [12.5, 2.5]),
            make_area("own", "crosswalk", square + 500),  # an own area has this name
            make_area("lot", "parking", square + 200),
        )
        plan = plan_of(
            {"in_list": 4, "where": {"kind": "area", "areas": ["own", "strip", "crosswalk"]}},
            areas={
                "own": {"polygon_m": [[0, 0], [12, 0], [0, 20]]},
                "strip": {"along_m": [[-20, 5], [6, 5]], "width_m": 4},
                "other": {"polygon_m": [[90, 0], [99, 0], [90, 9]]},
            },
        )
        recording = scene_of(until_s=30)
        recording = replace(recording, scene=replace(recording.scene, areas=walks))
        made = found(plan, recording, 4)
        x_m, y_m = (np.concatenate([getattr(rows.observations.tracks, n)[0] for rows in made]) for n in ("x_m", "y_m"))
        own, strip = shapely.Polygon([(0, 0), (12, 0), (0, 20)]), shapely.box(-20, 3, 6, 7)
        ring = shapely.Polygon(square, [square / 2 + [12.5, 2.5]])
        parts = [
            own & strip,
            own - strip,
            strip - own,
            ring & shapely.box(20, 0, 30, 5),
            ring - shapely.box(20, 0, 30, 5),
        ]
        apart = shapely.box(500, 500, 540, 540)  # "crosswalk" is also the kind of that area
        parts = [part.buffer(1e-9) for part in (*parts, apart & shapely.box(520, 500, 530, 510))]
        counted = [int(shapely.contains_xy(part, x_m, y_m).sum()) for part in parts]
        assert sum(counted) == len(x_m) > 4000
        sizes = np.array([part.area for part in parts])
        assert stats.chisquare(counted, len(x_m) * sizes / sizes.sum()).pvalue > 1e-3

    def test_beside_objects_that_the_unit_could_list(self) -> None:
        """A truck drives away and is seen up to 60 m; another class and one too far have none beside them."""
        where = {"kind": "beside", "classes": ["truck"], "within_m": 3}
        recording = scene_of(
            Thing("truck", "truck", driving(10, 0, 10)), Thing("far", "truck", standing(90, 0)), until_s=9.0
        )
        made = found(plan_of({"in_list": 0.5, "lasts_s": 0.3, "where": where}), recording, 60)
        near = np.array([counts(rows)[:51] for rows in made])  # 60 m away at 5 s
        assert near.mean() == pytest.approx(0.5, abs=4 * math.sqrt(0.5 / (60 * 8)))
        assert not any(counts(rows)[51:].any() for rows in made)
        for rows in made:
            tracks = rows.observations.tracks
            off_m = tracks.x_m[0] - (10 + 10 * tracks.row_captured_s)
            assert (np.abs(off_m) <= 4 + 3 + 1e-9).all()
            assert (np.abs(tracks.y_m[0]) <= 1.25 + 3 + 1e-9).all()

    def test_beside_what_the_unit_itself_could_list(self) -> None:
        """Two masts 200 m apart, each with a truck: the ghosts of each are beside its own."""
        where = {"kind": "beside", "classes": ["truck"], "within_m": 3}
        masts = {
            name: {"at": [x_m, 0.0], "height_m": 5.0, "pem": "eyes", "rate_hz": 10.0}
            for name, x_m in (("west", 0.0), ("zeal", 200.0))
        }
        trucks = [Thing(f"truck{x_m:.0f}", "truck", standing(x_m + 30, 0)) for x_m in (0.0, 200.0)]
        plan = plan_of({"in_list": 1, "lasts_s": 0.3, "where": where}, units=masts)
        for rows in found(plan, scene_of(*trucks, until_s=5), 4):
            tracks = rows.observations.tracks
            of_unit = tracks.row_unit_ix
            assert set(of_unit) == {0, 1}
            assert (np.abs(tracks.x_m[0] - (30 + 200 * of_unit)) <= 4 + 3 + 1e-9).all()

    def test_beside_objects_they_stand_on_the_same_ground(self) -> None:
        """A truck of 3.5 m: cars of 1.6 m beside it have their centre .8 m above the ground, as has its lower edge."""
        where = {"kind": "beside", "classes": ["truck"], "within_m": 3}
        sort = {"in_list": 2, "where": where, "classes": {"car": 1.0}}
        [rows] = found(plan_of(sort), scene_of(Thing("truck", "truck", standing(30, 0)), until_s=3), 1)
        assert rows.observations.tracks.z_m.size > 10
        assert rows.observations.tracks.z_m[0] == pytest.approx(rows.observations.tracks.height_m[0] / 2)
        assert set(rows.observations.tracks.height_m[0]) == {1.6}

    def test_classes_have_their_sizes(self) -> None:
        shares = {"pedestrian": 0.7, "car": 0.3}
        made = found(plan_of({"in_list": 2, "where": FIELD, "classes": shares}), scene_of(until_s=30), 4)
        class_ix = np.concatenate([rows.observations.view.class_ix for rows in made])
        assert (class_ix == CLASSES.index("pedestrian")).mean() == pytest.approx(0.7, abs=0.04)
        assert set(class_ix) == {CLASSES.index(name) for name in shares}
        tracks = made[0].observations.tracks
        of_cars = made[0].observations.view.class_ix == CLASSES.index("car")
        assert (tracks.length_m[0, of_cars] == 4.5).all()
        assert np.allclose(tracks.z_m[0], tracks.height_m[0] / 2)  # on the ground


def comparable(table: pd.DataFrame, *names: str) -> pd.DataFrame:
    return table[table["configuration"].isin(names)].reset_index(drop=True)


class TestWhatTheyLeave:
    RECORDING = scene_of(
        Thing("car", "car", driving(55, 0, -8)), Thing("child", "pedestrian", driving(20, -8, 0, 1)), until_s=6
    )
    NOISE: ClassVar = [{
        "when": {"range_m": [0, 60]}, "detection": {"kind": "constant", "probability": 0.6},
        "error": {"kind": "gaussian", "covariance_m2": [[0.2, 0], [0, 0.2]]},
    }]  # fmt: skip

    def both(self) -> tuple[Any, Any]:
        with_ghosts = plan_of(
            {"in_list": 1.0, "lasts_s": 0.7, "where": FIELD}, runs=5, pem={"couples": self.NOISE},
        )  # fmt: skip
        without = with_ghosts.model_copy(
            update={"pems": {"eyes": with_ghosts.pems["eyes"].model_copy(update={"ghosts": ()})}}
        )
        return run_experiment(with_ghosts, [self.RECORDING]), run_experiment(without, [self.RECORDING])

    def test_ideal_fusion_and_the_truth_do_not_know_of_them(self) -> None:
        ghosts, none = self.both()
        for mine, theirs in ((study_rows(ghosts), study_rows(none)), (ghosts.summary, none.summary)):
            pd.testing.assert_frame_equal(
                comparable(mine, "GT", "ideal"), comparable(theirs, "GT", "ideal"), check_exact=True
            )
        assert study_accuracy(ghosts)
        assert study_accuracy(none)
        mine, theirs = (study_accuracy(one)["accuracy.parquet"].to_pandas() for one in (ghosts, none))
        pd.testing.assert_frame_equal(
            comparable(mine, "GT", "ideal"), comparable(theirs, "GT", "ideal"), check_exact=True
        )
        mine, theirs = (one.summary.set_index("configuration")["false_positives_per_min"] for one in (ghosts, none))
        assert mine["gnn"] > 10
        assert mine["ideal"] == theirs["gnn"] == 0

    def test_a_run_alone_is_the_same_run(self) -> None:
        plan = plan_of({"in_list": 1.0, "lasts_s": 0.7, "where": FIELD}, runs=4, pem={"couples": self.NOISE})
        one, two = run_experiment(plan, [self.RECORDING], jobs=1), run_experiment(plan, [self.RECORDING], jobs=2)
        pd.testing.assert_frame_equal(study_rows(one), study_rows(two), check_exact=True)
        fewer = run_experiment(plan.model_copy(update={"runs": 2}), [self.RECORDING])
        first = study_rows(one)[study_rows(one)["run"] < 2].reset_index(drop=True)
        pd.testing.assert_frame_equal(first, study_rows(fewer).reset_index(drop=True), check_exact=True)


class TestEachBirthIsAnother:
    """Ghosts that are others in every list share nothing that lasts: no id, and no number of a memory."""

    MAST: ClassVar = {"at": [0.0, 0.0], "height_m": 5.0, "pem": "eyes"}
    PLAN = plan_of(
        {"in_list": 5.0, "lasts_s": 0, "where": FIELD},
        {"in_list": 1.0, "lasts_s": 0, "where": {"kind": "beside", "classes": ["truck"], "within_m": 3}},
        units={"a": MAST, "b": MAST},
        pem={
            "couples": [SEES_60_M[0] | {"existence": {"kind": "scores", "real": [8, 2], "ghost": [2, 4]}}],
            "tracks": {"lasts_s": 20.0}, "memory": {"existence": [{"share": 1.0, "correlation_s": "always"}]},
        },
    )  # fmt: skip
    RECORDING = scene_of(Thing("t", "truck", driving(10, 0, 1)), Thing("u", "truck", standing(20, -9)), until_s=20.0)

    @staticmethod
    def claimed(rows: GhostRows, run_number: int) -> EntryClaims:
        replay = prepare_log(TestEachBirthIsAnother.RECORDING, TestEachBirthIsAnother.PLAN)
        drawn = make_ghost_draws(replay.scene, rows, replay.expanded, run_number)
        return draw_claims(rows.observations, replay.expanded, drawn, rows.sort)

    def test_equal_sorts_that_last_share_no_address(self) -> None:
        """Else what lasts of one of them would be that of another."""
        sort = {"in_list": 1, "lasts_s": 0.5, "where": {"kind": "field", "range_m": [5, 60]}}
        [rows] = found(plan_of(sort, sort), scene_of(), 1)
        first, second = (set(rows.words[rows.sort == k].tolist()) for k in (0, 1))
        assert min(len(first), len(second)) > 60
        assert first & second == set()

    def test_ids_and_scores(self) -> None:
        made = found(self.PLAN, self.RECORDING, 3)
        of_runs = [self.claimed(rows, k) for k, rows in enumerate(made)]
        ids = np.concatenate([one.track_id for one in of_runs])
        assert len(ids) > 3 * 2 * 201 * 6
        assert (ids >= 0).all()
        assert len(np.unique(ids)) == len(ids), "of all lists, hosts, sorts, units and runs"
        for rows, one in zip(made, of_runs, strict=True):
            # Of one run the words differ in each unit: two units draw by the same words, but not the same numbers.
            for unit in (0, 1):
                words = rows.words[rows.observations.tracks.row_unit_ix == unit]
                assert len(np.unique(words)) == len(words)
            assert len(np.unique(one.existence)) > 0.99 * len(one.existence)
            assert one.existence.mean() == pytest.approx(2 / 6, abs=0.02)

    def test_they_are_the_same_in_a_part_of_the_log(self) -> None:
        [whole, *_], replay = found(self.PLAN, self.RECORDING, 1), prepare_log(self.RECORDING, self.PLAN)
        world = world_of(replay, self.PLAN)
        part = draw_ghosts(replay.scene, world.observations, replay.expanded, replay.placed, 0, (3.05, 5.05))
        assert part is not None
        captured_s = whole.observations.tracks.row_captured_s
        there = np.flatnonzero((captured_s > 3.05) & (captured_s < 5.05))
        assert part.words.tolist() == whole.words[there].tolist()
        assert part.observations.tracks.x_m[0].tolist() == whole.observations.tracks.x_m[0, there].tolist()
        assert self.claimed(part, 0).track_id.tolist() == self.claimed(whole, 0).track_id[there].tolist()


def test_errors_of_the_couple_that_applies() -> None:
    """In the near half ghosts are off by 1 m, in the far half by 3 m, as objects are there."""
    couples = [
        {
            "when": {"range_m": [0, 30]}, "detection": {"kind": "constant", "probability": 1.0},
            "error": {"kind": "gaussian", "covariance_m2": [[1.0, 0], [0, 1.0]]},
        },
        {
            "detection": {"kind": "constant", "probability": 1.0},
            "error": {"kind": "gaussian", "covariance_m2": [[9.0, 0], [0, 9.0]]},
        },
    ]  # fmt: skip
    plan = plan_of({"in_list": 5.0, "where": FIELD}, pem={"couples": couples})
    replay = prepare_log(scene_of(until_s=30), plan)
    [rows] = found(plan, scene_of(until_s=30), 1)
    drawn = make_ghost_draws(replay.scene, rows, replay.expanded, 0)
    listed = add_states(replay.scene, rows.observations.tracks, rows.observations, replay.expanded, drawn)
    off_m: Float = listed.x_m[0] - rows.observations.tracks.x_m[0]
    near = rows.observations.view.range_m < 30
    assert off_m[near].std() == pytest.approx(1.0, rel=0.15)
    assert off_m[~near].std() == pytest.approx(3.0, rel=0.1)
    assert listed.cov_ee_m2 is not None
    assert (listed.cov_ee_m2[0] == np.where(near, 1.0, 9.0)).all()


class TestSweep:
    PLAN: ClassVar = {"in_list": 0.2, "lasts_s": 0.7, "where": FIELD, "classes": {"car": 1.0}}

    def test_of_the_first_sort_only_and_of_fusions_that_hear_of_them(self) -> None:
        others = {"in_list": 0.1, "where": FIELD}
        plan = plan_of(self.PLAN, others, sweep={"ghosts_in_list": [0, 0.5]})
        swept = list(list_points(plan))
        assert [(point.sweep, point.value, list(point.experiment.configurations)) for point in swept] == [
            ("ghosts_in_list", 0.0, ["gnn"]), ("ghosts_in_list", 0.5, ["gnn"]),
        ]  # fmt: skip
        assert [[sort.in_list for sort in point.experiment.pems["eyes"].ghosts] for point in swept] == [
            [0.0, 0.1], [0.5, 0.1],
        ]  # fmt: skip

    def test_rows_are_those_of_an_experiment_with_so_many(self) -> None:
        recording = scene_of(Thing("car", "car", driving(55, 0, -8)), until_s=5)
        changes: dict[str, Any] = {"runs": 3, "pem": {"couples": TestWhatTheyLeave.NOISE}}
        swept = run_experiment(plan_of(self.PLAN, sweep={"ghosts_in_list": [0, 3]}, **changes), [recording]).sweep
        assert swept is not None
        assert swept[["sweep", "value"]].values.tolist() == [["ghosts_in_list", 0.0], ["ghosts_in_list", 3.0]]
        alone = run_experiment(plan_of(self.PLAN | {"in_list": 3.0}, **changes), [recording]).summary.set_index(
            "configuration"
        )
        for column in ("detected_share", "ttd_rmst_s", "list_rate_hz"):
            assert swept[column].iloc[1] == alone[column]["gnn"], column

    def test_without_any(self, tmp_path: Path) -> None:
        _, said = find_problems(source_of(tmp_path, changed("sweep: {ghosts_in_list: [0, 1]}")))
        assert [line.partition(": ")[2] for line in said] == ["sweep.ghosts_in_list: no PEM has `ghosts: […]`"]

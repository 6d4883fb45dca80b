"""Only what matters: polygons, the ego's way and conflicts by hand, conflicts against a plain oracle, too."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import pandas as pd
import pytest
import shapely
from pydantic import ValidationError

from copem_replay.core.errors import ExperimentError
from copem_replay.core.site_map import Lane
from copem_replay.core.tracks import Area, Float
from copem_replay.experiment.schema import Experiment
from copem_replay.experiment.validate import check_against_log, take_lanes
from copem_replay.io.recording import Recording
from copem_replay.metrics.detection.conflict import keep_episodes_within
from copem_replay.metrics.episodes import find_episodes
from copem_replay.perception.visibility import NO_STATICS
from copem_replay.pipeline.notes import list_oddities
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.run import run_experiment
from tests.helpers import scenes
from tests.helpers.replays import study_rows
from tests.helpers.scenes import Thing, driving, experiment, recording, standing
from tests.metrics.test_conflict import corridor_of, swept

APPEARS = {"onset": {"kind": "appears"}}


def passing() -> Recording:
    """The ego drives 40 m east in 4 s; a car is parked 3 m beside its way, one 10 m behind its start, one 12 m aside.

    A pedestrian, 40 m ahead and 20 m right of the way, walks towards it at 4 m/s: he is 4 m from it when the log ends.
    """
    return recording(
        [
            Thing("ego", "car", driving(0, 0, 10)), Thing("parked", "car", standing(20, 3)),
            Thing("behind", "car", standing(-10, 0)), Thing("aside", "car", standing(20, 12)),
            Thing("walker", "pedestrian", driving(40, -20, 0, 4)),
        ],
        until_s=4.0,
    )  # fmt: skip


def kept(log: Recording, within: Any, areas: Any = None, **measure: Any) -> set[str]:
    wanted = experiment(measure=APPEARS | {"objects": {"within": within}} | measure, areas=areas or {})
    every = find_episodes(log.scene, log.truth, NO_STATICS, wanted)
    found, outside_ix = keep_episodes_within(log.scene, log.truth, every, wanted)
    assert sorted([*found.object_ix, *outside_ix]) == sorted(every.object_ix)
    return {log.scene.object_ids[k] for k in found.object_ix}


def line(*points: tuple[float, float]) -> Float:
    return np.array([(x, y, 0.0) for x, y in points])


class TestAreas:
    """At the onset: parked at (20, 3), behind at (−10, 0), aside at (20, 12), walker at (40, −20)."""

    OWN: ClassVar = {
        "square": {"polygon_m": [[19, 2], [21, 2], [21, 13], [19, 13]]},
        "kerb": {"along_m": [[-11, 0], [-9, 0], [-9, 5]], "width_m": 0.2},
    }

    @pytest.mark.parametrize(
        ("names", "expected"),
        [
            (["square"], {"parked", "aside"}),
            (["kerb"], {"behind"}),
            (["square", "kerb"], {"parked", "aside", "behind"}),
        ],
    )
    def test_of_ones_own(self, names: list[str], expected: set[str]) -> None:
        assert kept(passing(), {"areas": names}, self.OWN) == expected

    @pytest.mark.parametrize(
        ("name", "expected"), [("crosswalk", {"parked", "walker"}), ("north", {"parked"}), ("south", {"walker"})]
    )
    def test_of_a_map_by_name_and_by_kind(self, name: str, expected: set[str]) -> None:
        log = passing()
        rings = {"north": ((15, 0), (25, 0), (25, 5), (15, 5)), "south": ((35, -25), (45, -25), (45, -15), (35, -15))}
        hole = ((19.5, 11.5), (20.5, 11.5), (20.5, 12.5), (19.5, 12.5))
        around = Area("ring", "junction", (((15, 8), (25, 8), (25, 15), (15, 15)), hole))
        areas = (*(Area(name, "crosswalk", (ring,)) for name, ring in rings.items()), around)
        log = replace(log, scene=replace(log.scene, areas=areas))
        assert kept(log, {"areas": [name]}) == expected
        assert kept(log, {"areas": ["junction"]}) == set()  # he stands in its hole

    def test_an_area_of_ones_own_comes_before_one_of_a_map(self) -> None:
        log = passing()
        log = replace(log, scene=replace(log.scene, areas=(Area("kerb", "crosswalk", (((19, 2), (21, 2), (21, 4)),)),)))
        assert kept(log, {"areas": ["kerb"]}, self.OWN) == {"behind"}

    def test_an_unknown_area_is_refused_with_the_nearest(self) -> None:
        wanted = experiment(measure={"objects": {"within": {"areas": ["kerb", "sqare"]}}}, areas=self.OWN)
        problems = dict(check_against_log(wanted, passing()))
        key = ("measure", "objects", "within", "areas", 1)
        assert problems[key] == "no area is named 'sqare'; did you mean square?"
        assert ("measure", "objects", "within", "areas", 0) not in problems

    def test_so_is_one_that_ghosts_are_in(self) -> None:
        ghosts = [{"in_list": 1, "where": {"kind": "area", "areas": ["kerb", "sqare"]}}]
        plain = experiment(areas=self.OWN)
        [name] = {str(unit.pem) for unit in plain.modelled.values()}
        couples = plain.pems[name].model_dump(mode="json")
        wanted = experiment(areas=self.OWN, pems={name: {"couples": couples, "ghosts": ghosts}})
        problems = dict(check_against_log(wanted, passing()))
        assert problems[("pems", name, "ghosts", 0, "where", "areas", 1)] == (
            "no area is named 'sqare'; did you mean square?"
        )

    def test_lanes_by_id_and_by_kind(self) -> None:
        """A border counts; a lane that is driven both ways is one."""
        log = passing()
        street = Lane("38109167", "driving", line((-50, 3), (50, 3)), line((-50, 0), (50, 0)))
        path = Lane("7", "bicycle", line((10, 14), (30, 14)), line((10, 11), (30, 11)))
        log = replace(log, lanes=(street, street.turned(), path))
        for names, expected in (
            ([38109167], {"parked", "behind"}),
            (["bicycle"], {"aside"}),
            (["driving", "7"], {"parked", "behind", "aside"}),
        ):
            wanted = experiment(measure=APPEARS | {"objects": {"within": {"lanes": names}}})
            assert kept(take_lanes(wanted, log), {"lanes": names}) == expected
        assert take_lanes(experiment(), log) is log

    @pytest.mark.parametrize(
        ("name", "says"),
        [
            ("drivng", "no lane is named 'drivng'; did you mean driving?"),
            (3810916, "no lane is named '3810916'; did you mean 38109167?"),
            ("parking", "no lane is named 'parking'; there are driving, 38109167"),
        ],
    )
    def test_an_unknown_lane_is_refused_with_the_nearest(self, name: str | int, says: str) -> None:
        log = replace(passing(), lanes=(Lane("38109167", "driving", line((0, 3), (50, 3)), line((0, 0), (50, 0))),))
        wanted = experiment(measure={"objects": {"within": {"lanes": ["driving", name]}}})
        problems = dict(check_against_log(wanted, log))
        assert problems["measure", "objects", "within", "lanes", 1] == says
        assert ("measure", "objects", "within", "lanes", 0) not in problems

    @pytest.mark.parametrize(
        "area", [{}, {"polygon_m": [[0, 0], [1, 0], [1, 1]], "width_m": 2}, {"along_m": [[0, 0], [1, 0]]},
                 {"polygon_m": [[0, 0], [1, 1], [1, 0], [0, 1]]}, {"along_m": [[0, 0]], "width_m": 1}],
    )  # fmt: skip
    def test_areas_that_are_none(self, area: dict[str, Any]) -> None:
        with pytest.raises(ValidationError):
            experiment(areas={"a": area})


class TestByHand:
    @pytest.mark.parametrize(
        ("corridor_m", "expected"),
        [
            (2.99, set()), (3.0, {"parked"}), (9.99, {"parked"}), (10.0, {"parked", "behind"}),
            (12.0, {"parked", "behind", "aside"}), (20.0, {"parked", "behind", "aside", "walker"}),
        ],
    )  # fmt: skip
    def test_beside_the_way(self, corridor_m: float, expected: set[str]) -> None:
        """To the way as driven: it begins at x = 0 and ends at 40; the pedestrian appears 20 m beside it."""
        assert kept(passing(), {"corridor_m": corridor_m}) == expected

    @pytest.mark.parametrize(
        ("corridor_m", "expected"),
        [(4.99, set()), (5.0, {"here"}), (7.07, {"here"}), (7.08, {"here", "gone"}), (10.44, {"here", "gone"}),
         (10.45, {"here", "gone", "parked"})],
    )  # fmt: skip
    def test_only_the_way_ahead_until_the_object_is_gone(self, corridor_m: float, expected: set[str]) -> None:
        """At the onset, 3 s, the ego is at x = 30, √109 m past the parked car. Of two at (40, 5) one leaves at 3.5 s:
        until then the ego comes to x = 35, √50 m from there."""
        log = recording(
            [
                Thing("ego", "car", driving(0, 0, 10)), Thing("parked", "car", standing(20, 3)),
                Thing("here", "car", standing(40, 5)), Thing("gone", "car", standing(40, 5), lambda t: t < 3.55),
            ],
            until_s=4.0,
        )  # fmt: skip
        assert kept(log, {"corridor_m": corridor_m}, onset={"kind": "at", "time_s": 3.0}) == expected

    def test_an_ego_that_stands(self) -> None:
        log = recording([Thing("ego", "car", standing(0, 0)), Thing("a", "car", standing(3, 4))], until_s=1.0)
        assert kept(log, {"corridor_m": 5.0}) == {"a"}
        assert kept(log, {"corridor_m": 4.9}) == set()

    @pytest.mark.parametrize(
        ("polygon_m", "expected"),
        [
            ([[-1, -1], [30, -1], [30, 3], [-1, 3]], {"parked"}),  # on its edge
            ([[-20, -30], [50, -30], [50, 30], [-20, 30]], {"parked", "behind", "aside", "walker"}),
            ([[39, -4.5], [41, -4.5], [41, -3.5], [39, -3.5]], set()),  # where the pedestrian only is at last
        ],
    )
    def test_in_a_polygon_at_the_onset(self, polygon_m: Any, expected: set[str]) -> None:
        assert kept(passing(), {"polygon_m": polygon_m}) == expected

    def test_it_is_the_onset_that_decides(self) -> None:
        """The oncoming car appears 100 m away and comes into range, of 80 m, at 2 s."""
        far, near = ([[x - 5, -5], [x + 5, -5], [x + 5, 5], [x - 5, 5]] for x in (100, 80))
        in_range = {"onset": {"kind": "in_range", "range_m": 80}}
        assert kept(scenes.oncoming_car(), {"polygon_m": far}, **in_range) == set()
        assert kept(scenes.oncoming_car(), {"polygon_m": near}, **in_range) == {"other"}

    @pytest.mark.parametrize(
        ("conflict_s", "margin_m", "expected"),
        [(1.0, 0.5, {"walker"}), (0.5, 0.5, set()), (0.5, 0.9, {"walker"}), (0.01, 2.5, {"parked"})],
    )
    def test_on_the_way_soon(self, conflict_s: float, margin_m: float, expected: set[str]) -> None:
        """His box (.5 m) is .25 m ahead of him, the ego's corridor 1 m wide on each side and the margin.

        At the last frame he is 4 m from the line: .5 s bring him to 2 m, 1.75 m from it, which a margin of .9 m reaches
        and one of .5 m does not. The parked car's side is 2 m beside the line.
        """
        got = kept(passing(), {"conflict_s": conflict_s}, conflict={"margin_m": margin_m})
        assert got - {"behind"} == expected

    def test_until_the_end_of_the_episode_only(self) -> None:
        """A pedestrian who is gone before he is near the way is in no conflict, nor one before his onset."""
        walker = Thing("walker", "pedestrian", driving(40, -20, 0, 4), there=lambda t: t < 3.01)
        log = recording([Thing("ego", "car", driving(0, 0, 10)), walker], until_s=4.0)
        assert kept(log, {"conflict_s": 1.0}) == set()
        away = Thing("away", "pedestrian", driving(15, 0, 0, 5), size_m=(0.5, 0.5, 1.8))
        log = recording([Thing("ego", "car", driving(0, 0, 10)), away], until_s=4.0)
        assert kept(log, {"conflict_s": 1.0}) == {"away"}
        assert kept(log, {"conflict_s": 1.0}, onset={"kind": "at", "time_s": 2.0}) == set()


@pytest.mark.parametrize("seed", range(6))
def test_conflicts_as_the_words_have_them(seed: int) -> None:
    """Frame by frame the hull of what an object sweeps against the ego's boxes along its way."""
    rng = np.random.default_rng(seed)
    things = [Thing("ego", "car", driving(0, 0, float(rng.uniform(2, 12))))]
    for k in range(8):
        place, speed = rng.uniform(-15, 40, 2), rng.normal(0, 5, 2)
        things.append(Thing(f"o{k}", "car", driving(*place.tolist(), *speed.tolist()), yaw_rad=rng.uniform(-3, 3)))
    log, horizon_s = recording(things, until_s=2.0, rate_hz=5.0), float(rng.uniform(0.3, 3))
    found = kept(log, {"conflict_s": horizon_s})

    def expected(margin_m: float) -> set[str]:
        return {thing.name for k, thing in enumerate(things) if k and _meets(log, k, horizon_s, margin_m)}

    assert expected(0.47) <= found <= expected(0.53)


def _meets(log: Recording, track: int, horizon_s: float, margin_m: float) -> bool:
    truth = log.truth
    for p in range(truth.start[track], truth.start[track + 1]):
        corridor = shapely.union_all(corridor_of(log, truth.row_captured_s[p], horizon_s).boxes(margin_m))
        names = ("x_m", "y_m", "yaw_rad", "vx_mps", "vy_mps", "length_m", "width_m")
        if swept(*(float(getattr(truth, name)[0, p]) for name in names), horizon_s).intersects(corridor):
            return True
    return False


class TestInARun:
    def test_what_is_left_changes_in_nothing(self) -> None:
        """Rows of the others are those without it, bit for bit; what is left out is counted, and no ghost."""
        sees = [{"detection": {"kind": "constant", "probability": 0.5}, "error": {
            "kind": "gaussian", "covariance_m2": [[0.2, 0], [0, 0.2]]}}]  # fmt: skip
        more: dict[str, Any] = {
            "pems": {"sure": sees}, "runs": 5,
            "configurations": {"PEM": {"units": ["ego"]}, "union": {"units": ["ego"], "fusion": {"kind": "union"}}},
        }  # fmt: skip
        every = experiment(measure=APPEARS, **more)
        some = experiment(measure=APPEARS | {"objects": {"within": {"corridor_m": 5}}}, **more)
        whole, part = (run_experiment(plan, [passing()]) for plan in (every, some))
        mine = study_rows(whole)[study_rows(whole)["object_id"] == "parked"].reset_index(drop=True)
        pd.testing.assert_frame_equal(mine, study_rows(part), check_exact=True)
        ghosts = [of.summary["false_positives_per_min"].tolist() for of in (whole, part)]
        assert ghosts[0] == ghosts[1]
        said = "objects.within: 3 of 4 objects with an onset left out, more than 5 m beside the ego's way ahead"
        assert f"scene: {said}" in part.notes
        assert not any("within" in note for note in whole.notes)

    def test_nobody_is_left(self) -> None:
        replay = prepare_log(
            passing(), wanted := experiment(measure=APPEARS | {"objects": {"within": {"corridor_m": 1}}})
        )
        said = list(list_oddities(replay, wanted))
        assert "no rows: `objects.within` keeps no object with an onset" in said
        assert "objects.within: 4 of 4 objects with an onset left out, more than 1 m beside the ego's way ahead" in said

    @pytest.mark.parametrize("within", [{"corridor_m": 5.0}, {"conflict_s": 2.0}])
    def test_without_an_ego(self, within: Any) -> None:
        log = recording([Thing("a", "car", standing(3, 4))], until_s=1.0, ego=None)
        units = {"mast": {"at": [0, 0], "height_m": 5, "pem": "sure"}}
        plan = {"ego": "none", "units": units, "configurations": {"PEM": {"units": ["mast"]}}}
        wanted = experiment(**plan, measure=APPEARS | {"objects": {"within": within}, "distance_to": "mast"})
        problems = dict(check_against_log(wanted, log))
        assert problems[("measure", "objects", "within")].startswith("no ego in this study, and so no path of it")
        with pytest.raises(ExperimentError, match=r"scene: measure\.objects\.within: no ego in this study"):
            prepare_log(log, wanted)

    def test_ghosts_where_nothing_is_annotated(self) -> None:
        """Two parked cars that only a recorded list would name are absent here, so the PEM's errors make the ghosts."""
        wide = [{"detection": {"kind": "constant", "probability": 1.0}, "error": {
            "kind": "gaussian", "covariance_m2": [[25.0, 0], [0, 25.0]]}}]  # fmt: skip
        union = {"union": {"units": ["ego"], "fusion": {"kind": "union"}}}
        plans = [experiment(measure=APPEARS | area, pems={"sure": wide}, runs=20, configurations=union)
                 for area in ({}, {"annotated": {"range_m": 1000.0}}, {"annotated": {"range_m": 12.0}})]  # fmt: skip
        whole, same, near = (run_experiment(plan, [passing()]) for plan in plans)
        pd.testing.assert_frame_equal(whole.summary, same.summary, check_exact=True)
        fewer = [of.summary["false_positives_per_min"][0] for of in (whole, near)]
        assert 0 < fewer[1] < fewer[0] / 2
        assert near.summary["gospa_false_m"][0] < whole.summary["gospa_false_m"][0]
        pd.testing.assert_frame_equal(
            *(
                study_rows(of)[["object_id", "run", "detection_s", "matched_lists", "position_rmse_m"]]
                for of in (whole, near)
            )
        )
        assert any("entries at no object where the truth is not annotated, no ghosts" in note for note in near.notes)


@pytest.mark.parametrize(
    ("measure", "said"),
    [
        (
            {"objects": {"within": {}}},
            "expected one of polygon_m, polygon_wgs84, corridor_m, conflict_s, areas, lanes, found none",
        ),
        ({"objects": {"within": {"corridor_m": 1.0, "conflict_s": 2.0}}}, "found corridor_m and conflict_s"),
        ({"objects": {"within": {"polygon_m": [[0, 0], [1, 1], [1, 0], [0, 1]]}}}, "edges that cross or overlap"),
        ({"annotated": {}}, "expected one of polygon_m, polygon_wgs84, range_m, found none"),
        (
            {"annotated": {"polygon_m": [[0, 0], [1, 1], [2, 2]]}},
            "polygon_m: expected the corners in order around an area",
        ),
    ],
)
def test_refused(measure: Any, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        experiment(measure=measure)


def test_left_out_they_are_not_written() -> None:
    """Results of before stay comparable: keys that say nothing are not there."""
    written = experiment().as_written()["measure"]
    assert "annotated" not in written
    assert "within" not in written["objects"]
    area = {"annotated": {"range_m": 50.0}, "objects": {"within": {"conflict_s": 3.0}}}
    assert Experiment.model_validate(experiment(measure=area).as_written()).measure == experiment(measure=area).measure

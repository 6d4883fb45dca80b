"""A visibility of a user's own: from the experiment to detections, results and schema."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from copem_replay.core.errors import InputError
from copem_replay.core.tracks import Float, Int, Tracks
from copem_replay.experiment.schema import Experiment
from copem_replay.perception.sensor_poses import compute_unit_poses, make_observers
from copem_replay.perception.visibility import Flat, Observers, Statics, VisibilityModel, find_blockers
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.run import run_experiment
from tests.helpers import scenes
from tests.helpers.replays import study_rows
from tests.helpers.report_pages import TEXT, replayed
from tests.helpers.scenes import experiment

HERE = "tests.perception.test_own_visibility"
SEES_HALF = {"sure": [{"when": {"visible_share": [0.5, 1]}, "detection": {"kind": "constant", "probability": 1.0}}]}


class Fog(VisibilityModel):
    """All of an object shows up to a range, nothing of it farther away."""

    reach_m: float = 45.0

    def shares(self, world: Tracks, static: Statics, observers: Observers) -> Float:
        place_m = observers.place_m[:, world.frame_ix]
        away_m = np.hypot(world.x_m[0] - place_m[..., 0], world.y_m[0] - place_m[..., 1])
        return (away_m <= self.reach_m + 1e-9).astype(float)


class Wrong(VisibilityModel):
    how: str

    def shares(self, world: Tracks, static: Statics, observers: Observers) -> Float:
        shares = np.full((len(observers.carrier_ix), len(world.frame_ix)), 50.0 if self.how == "percent" else 0.5)
        return shares[0] if self.how == "flat" else shares

    def hidden_by(self, world: Tracks, static: Statics, observers: Observers) -> Int:
        return np.full((len(observers.carrier_ix), len(world.frame_ix)), -2 if self.how == "no such obstacle" else -1)


def foggy(**changes: Any) -> Experiment:
    return experiment(visibility={"kind": f"{HERE}:Fog"}, pems=SEES_HALF, **changes)


def test_it_decides_what_is_detected_and_in_sight() -> None:
    """The other car is 80 m away at 2 s and comes at 10 m/s: at 5.5 s it is 45 m away."""
    table = study_rows(run_experiment(foggy(), [scenes.oncoming_car()])).set_index("configuration")
    assert table.loc["PEM", ["onset_s", "detection_s", "in_sight_s"]].tolist() == pytest.approx([2.0, 5.5, 5.5])


def test_it_decides_when_the_clock_starts() -> None:
    plan = foggy(measure={"onset": {"kind": "line_of_sight", "visible_share": 0.5}})
    assert study_rows(run_experiment(plan, [scenes.oncoming_car()]))["onset_s"].tolist() == pytest.approx([5.5, 5.5])


def test_what_hides_is_nothing_unless_it_says_so() -> None:
    log, plan = scenes.behind_a_wall(), experiment(pems=SEES_HALF)
    ready = prepare_log(log, plan)
    at = compute_unit_poses(log.scene, plan.units["ego"], log.truth, None)
    watching = make_observers([at], np.array([log.scene.ego_ix]))
    [none] = find_blockers(log.truth, ready.placed.static, watching, Fog(kind="fog"))
    [some] = find_blockers(log.truth, ready.placed.static, watching, Flat())
    assert set(none.tolist()) == {-1}
    assert (some != -1).any()


def test_it_is_in_the_results(tmp_path: Path) -> None:
    folder = replayed(tmp_path, TEXT + f"visibility: {{kind: '{HERE}:Fog', reach_m: 30.0}}\n")
    assert f"{HERE}:Fog" in (folder / "experiment.yaml").read_text(encoding="utf-8")
    provenance = json.loads((folder / "provenance.json").read_text(encoding="utf-8"))
    assert provenance["visibility"] == f"{HERE}:Fog (reach_m: 30.0)"


def test_it_is_in_the_schema() -> None:
    found = Experiment.model_json_schema()["properties"]["visibility"]
    word, own = found["anyOf"]
    assert word["enum"] == ["surface", "flat"]
    assert own["properties"]["kind"]["pattern"] == ":"
    assert found["default"] == "surface"


@pytest.mark.parametrize("written", ["surface", "flat", {"kind": f"{HERE}:Fog", "reach_m": 20.0}])
def test_written_and_read_back_it_is_the_same(written: Any) -> None:
    plan = experiment(visibility=written)
    assert plan.as_written()["visibility"] == written
    assert Experiment.model_validate(plan.as_written()) == plan


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ("percent", r"shares: expected 0 … 1, found 50\.0"),
        ("flat", r"shares: expected shape \(1, 162\), found \(162,\)"),
    ],
)
def test_what_it_gives_is_checked(how: str, said: str) -> None:
    plan = experiment(visibility={"kind": f"{HERE}:Wrong", "how": how})
    with pytest.raises(InputError, match=rf"^visibility: {HERE}:Wrong: {said} \(.*test_own_visibility\.py:\d+\)$"):
        run_experiment(plan, [scenes.oncoming_car()])


def test_a_body_that_is_not_there_cannot_hide() -> None:
    log = scenes.oncoming_car()
    at = compute_unit_poses(log.scene, experiment().units["ego"], log.truth, None)
    watching = make_observers([at], np.array([log.scene.ego_ix]))
    static = prepare_log(log, experiment()).placed.static
    with pytest.raises(InputError, match=r"hidden_by: expected whole numbers -1 … 161 of shape \(1, 162\), found"):
        find_blockers(log.truth, static, watching, Wrong(kind=f"{HERE}:Wrong", how="no such obstacle"))


@pytest.mark.parametrize(
    ("written", "said"),
    [
        ("curved", "should be 'surface' or 'flat'"),
        ({"kind": "curved"}, "kind: expected package.module:Class; found 'curved'"),
        ({"kind": f"{HERE}:Any"}, "is no kind of copem_replay.perception.visibility.VisibilityModel"),
    ],
)
def test_what_is_no_visibility_is_refused(written: Any, said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        experiment(visibility=written)

"""Onsets as components: one that is written here is used, shown, described and checked like the built-in ones."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pandas as pd
import pytest

from copem_replay.core import components
from copem_replay.core.errors import InputError
from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.episodes import find_episodes
from copem_replay.metrics.onset import ONSETS, LineOfSightAny, Onset, OnsetView, Requires
from copem_replay.perception.visibility import NO_STATICS
from copem_replay.report.figures.selection import Selection
from copem_replay.report.figures.single_runs import runs_figure
from copem_replay.report.html.page import build_page
from copem_replay.report.html.study import load_study
from copem_replay.results.read import read_results
from tests.experiment.test_validate import against_logs, drive, without_logs
from tests.helpers import experiments, scenes
from tests.helpers.report_pages import Page, changed, replayed

AT = "onset: {kind: at, time_s: 0.5}"


class InLane(Onset):
    """The object is near the ego and within 10 m of the axis y = 0."""

    reach_m: float

    def holds(self, view: OnsetView) -> np.ndarray:
        return (view.distance_m("centre") <= self.reach_m + 1e-6) & (np.abs(view.tracks.y_m[0]) <= 10.0)

    def label(self, object_class: str) -> str:
        return f"{object_class} in lane"

    def described(self, near: str) -> str:
        return f"when it is in the lane, {self.reach_m:g} m from {near}"


class Bare(Onset):
    """What an own onset has to have, and nothing else. As many seconds after the log's start as there are tenths."""

    after_s: float

    def holds(self, view: OnsetView) -> np.ndarray:
        return (view.time_s >= self.after_s) & (view.speed_mps < 1.0)


class Seen(Onset):
    requires: ClassVar[Requires] = Requires.UNIT

    def holds(self, view: OnsetView) -> np.ndarray:
        return view.visible_share("any") > 0


class SeenByEgo(Onset):
    requires: ClassVar[Requires] = Requires.UNIT_ON_EGO

    def holds(self, view: OnsetView) -> np.ndarray:
        return view.visible_share("ego") > 0


class Shares(Onset):
    def holds(self, view: OnsetView) -> np.ndarray:
        return view.speed_mps


class TooFew(Onset):
    def holds(self, view: OnsetView) -> np.ndarray:
        return np.ones(1, dtype=bool)


class Fails(Onset):
    def holds(self, view: OnsetView) -> np.ndarray:
        return view.no_such_thing  # type: ignore[attr-defined, no-any-return]


def own(name: str, **keys: Any) -> str:
    """The line of an experiment that asks for an onset of this file."""
    said = "".join(f", {key}: {value}" for key, value in keys.items())
    return f"onset: {{kind: '{__name__}:{name}'{said}}}"


def test_an_own_onset_is_in_detections_report_and_figure(tmp_path: Path) -> None:
    """The ego is 30 − 10 t from the pedestrian in its way: 20 m at 1 s. The other one, 30 m aside, has no onset."""
    folder = replayed(tmp_path, changed((AT, own("InLane", reach_m=20))))
    table = pd.read_parquet(folder / "detections.parquet")
    assert set(table["object_id"]) == {"2"}
    assert table["onset_s"].to_numpy() == pytest.approx(1.0)
    assert set(table["began"]) == {"crossed"}
    words = Page(build_page(load_study(folder))).words
    assert "The clock of an object starts when it is in the lane, 20 m from the ego." in words
    figure = runs_figure(read_results(folder), Selection(["late"]))
    assert any("pedestrian in lane" in text.get_text() for axes in figure.axes for text in axes.texts)


def test_an_own_onset_needs_nothing_but_its_condition(tmp_path: Path) -> None:
    folder = replayed(tmp_path, changed((AT, own("Bare", after_s=0.75))))
    table = pd.read_parquet(folder / "detections.parquet")
    assert set(table["object_id"]) == {"2", "3"}
    assert table["onset_s"].to_numpy() == pytest.approx(0.8), "the first frame from 0.75 s on"
    assert "The clock of an object starts at its onset “Bare”." in Page(build_page(load_study(folder))).words


def test_the_schema_has_built_in_and_installed_onsets(monkeypatch: pytest.MonkeyPatch) -> None:
    def entry_points(group: str) -> list[EntryPoint]:
        return [EntryPoint("in_lane", f"{__name__}:InLane", group)] if group == "copem_replay.onset" else []

    monkeypatch.setattr(components, "entry_points", entry_points)
    onset = Experiment.model_json_schema()["$defs"]["Measure"]["properties"]["onset"]
    kinds = {one["properties"]["kind"].get("const"): set(one["properties"]) for one in onset["anyOf"]}
    assert list(kinds) == [*ONSETS, "in_lane", None]
    assert kinds["in_lane"] == {"kind", "reach_m", "again_after_s"}
    assert kinds["starts_moving"] == {"kind", "speed_mps", "within_m", "from", "again_after_s"}
    assert onset["default"] == {"kind": "in_range", "range_m": 50.0}


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("Shares", r"holds\(view\): expected true or false of shape \(\d+,\), found float64 \(\d+,\) \(.*test_onset"),
        ("TooFew", r"holds\(view\): expected true or false of shape \(\d+,\), found bool \(1,\) \(.*test_onset"),
        ("Fails", r"AttributeError: .*no_such_thing.* \(.*test_onset\.py:\d+\)$"),
    ],
)
def test_an_own_onset_that_fails_is_named(name: str, said: str) -> None:
    log = scenes.oncoming_car()
    plan = scenes.experiment(measure={"onset": {"kind": f"{__name__}:{name}"}})
    with pytest.raises(InputError, match=rf"^measure\.onset: {__name__}:{name}: {said}"):
        find_episodes(log.scene, log.truth, NO_STATICS, plan)


def test_what_an_own_onset_requires_is_checked(tmp_path: Path) -> None:
    """As for the built-in ones: without a look at the logs where any unit will do, else log by log."""
    seen, by_ego = own("Seen"), own("SeenByEgo")
    recorded = experiments.changed("  ego: {on: ego, recorded: {topic: a}}", "  mast: {recorded: {topic: b}}")
    recorded = recorded.replace("units: all", "units: [mast]")
    line = f"measure: {{{seen}}}"
    there = "\n".join(line if old.startswith("measure:") else old for old in recorded.splitlines()) + "\n"
    assert without_logs(tmp_path, there) == [f"17: measure.onset: {__name__}:Seen: there is no unit to see anything"]
    assert without_logs(tmp_path, there.replace(seen, by_ego)) == []
    drive(tmp_path / "drive.mcap")
    elsewhere = experiments.changed("  ego: {on: 2, height_m: 1, pem: onboard}", f"measure: {{{by_ego}}}")
    assert against_logs(tmp_path, elsewhere) == [
        f"17: measure.onset: drive.mcap: {__name__}:SeenByEgo needs a unit on the ego; or use line_of_sight_any"
    ]
    assert against_logs(tmp_path, elsewhere.replace(by_ego, seen)) == []


def test_what_it_requires_is_a_property_of_the_class() -> None:
    for given in ("unit", 5):
        with pytest.raises(TypeError, match="requires: expected a property of the class"):
            type("Wrong", (Onset,), {"requires": given, "__module__": __name__})


def test_a_share_is_reached_in_spite_of_rounding() -> None:
    """`visible_share: 1.0` comes where all is seen: a sum of parts may end at 1 − 1e-16."""
    onset = LineOfSightAny(visible_share=1.0)
    shares = np.array([1.0, 1 - 1e-12, 0.999])
    view: Any = SimpleNamespace(visible_share=lambda by: shares)
    assert onset.holds(view).tolist() == [True, True, False]

"""The trade-off: marks by the tables, and a line that leads to what another replay finds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes

import copem_replay as cr
from copem_replay.report.figures.trade_off import no_trade_off, trade_off_figure
from copem_replay.results.read import Results
from tests.helpers.recordings import Obj, pedestrian, write_recording
from tests.helpers.scenes import experiment

SCORES = {"kind": "scores", "real": [6, 3], "ghost": [4, 4]}
SURE = [{"detection": {"kind": "constant", "probability": 0.5}, "existence": SCORES}]
AHEAD = {
    "in_list": 2, "lasts_s": 1, "where": {"kind": "field", "range_m": [5, 20], "azimuth_deg": [-3, 3]},
    "classes": {"pedestrian": 1}, "existence": SCORES,
}  # fmt: skip
AFTER = {"kind": "constant", "delay_s": 0.25}
AT_LEAST = (0.3, 0.5, 0.7)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Results:
    """The ego drives past ten pedestrians; `union` lists all entries, `.5` those of that existence or more."""
    folder = tmp_path_factory.mktemp("trade_off")
    walkers = [pedestrian(id=2 + k, x=50.0 + 10 * k, y=8.0) for k in range(10)]
    frames = [(0.1 * t, [Obj(id=1, x=1.0 * t, vx=10), *walkers]) for t in range(81)]
    log = write_recording(folder / "drive.mcap", frames, host=1)
    union = {"units": ["b"], "fusion": {"kind": "union"}}
    asked = experiment(
        logs=[str(log)], runs=8, pems={"sure": SURE, "ghostly": {"couples": SURE, "ghosts": [AHEAD]}},
        units={"a": {"on": "ego", "pem": "sure"}, "b": {"on": "ego", "pem": "ghostly"}},
        configurations={
            "GT": {"units": "truth"}, "alone": union | {"units": ["a"]}, "union": union,
            **{f"{at}": union | {"fusion": {"kind": "union", "min_existence": at}} for at in AT_LEAST},
        },
        braking={"driver": {"kind": "constant_deceleration", "a_max_mps2": 8.0, "reaction": AFTER}},
        show={"run": None},
    )  # fmt: skip
    return cr.run(asked)


@pytest.fixture(scope="module")
def axes(results: Results) -> Axes:
    return trade_off_figure(results).axes[0]


def place_of(axes: Axes, name: str) -> tuple[float, float]:
    (mark,) = (mark for mark in axes.collections if mark.get_label() == name)
    return tuple(np.asarray(mark.get_offsets())[0])


def test_marks_are_the_figures_of_the_tables(results: Results, axes: Axes) -> None:
    assert {mark.get_label() for mark in axes.collections} == {"alone", "union", *map(str, AT_LEAST)}, (
        "the truth is none"
    )
    share = results.summary.set_index("configuration")["needless_brake_share"]
    compared = cr.compare(results, configurations=["union", "0.5"], baseline="alone").overall
    later_s = compared[compared["metric"] == "ttd_rmst_s"].set_index("configuration")["difference"]
    assert place_of(axes, "alone") == pytest.approx((0.0, 100 * share["alone"]))
    for name in ("union", "0.5"):
        assert place_of(axes, name) == pytest.approx((-later_s[name], 100 * share[name]))
    assert share["union"] > 0.1


@pytest.mark.parametrize("at", AT_LEAST)
def test_the_line_leads_to_what_a_replay_of_fewer_entries_finds(axes: Axes, at: float) -> None:
    """The fusion itself leaves entries out there."""
    begin = place_of(axes, "union")
    (line,) = (line for line in axes.lines if np.allclose(np.asarray(line.get_xydata())[0], begin, atol=1e-9))
    apart = np.abs(np.asarray(line.get_xydata()) - place_of(axes, str(at)))
    assert apart.max(axis=1).min() < 1e-9
    assert not np.allclose(place_of(axes, str(at)), begin)


def test_where_nobody_brakes_for_nothing_there_is_none(tmp_path: Path) -> None:
    frames = [(0.1 * t, [Obj(id=1, x=1.0 * t, vx=10), pedestrian(id=2, x=60.0, y=30.0)]) for t in range(31)]
    log = write_recording(tmp_path / "drive.mcap", frames, host=1)
    found = cr.run(
        experiment(logs=[str(log)], units={"a": {"on": "ego", "pem": "sure"}}, pems={"sure": SURE},
                   configurations={"a": {"units": ["a"]}, "b": {"units": ["a"]}})
    )  # fmt: skip
    assert no_trade_off(found, ["a", "b"]) == ""

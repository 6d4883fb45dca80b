"""When somebody had the object in sight: by hand, in a scene where a wall of a lorry hides it until it is gone.

The ego (1) stands at the origin. A pedestrian (2) stands 20 m ahead, a lorry (3) 10 m ahead until 1.0 s, its last
frame: from 1.1 s on nothing hides him. A mast beside sees him all the time. 10 Hz, 2 s.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from copem_replay.experiment.schema import Experiment
from copem_replay.io.recording import read_log
from copem_replay.perception.observation import observe_objects
from copem_replay.perception.sight import (
    HIDDEN,
    IN_SIGHT,
    NO_UNIT,
    OUT_OF_VIEW,
    SightSpans,
    find_sight_changes,
    join_sight_changes,
    measure_sight,
)
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.run import run_experiment
from tests.helpers.recordings import Obj, pedestrian, write_recording
from tests.helpers.replays import study_rows
from tests.helpers.scenes import Thing, driving, experiment, recording

EXPERIMENT = {
    "version": 1,
    "logs": ["drive.mcap"],
    "pems": {
        "eyes": [{"detection": {"kind": "visible_share"}}],
        "psychic": [{"detection": {"kind": "constant", "probability": 1.0}}],
        "blind": [{"when": {"classes": ["animal"]}, "detection": {"kind": "constant", "probability": 1.0}}],
    },
    "units": {
        "ego": {"on": "ego", "height_m": 1.8, "pem": "eyes"},
        "guess": {"on": "ego", "height_m": 1.8, "pem": "psychic"},
        "blind": {"at": [20.0, 20.0], "height_m": 5.0, "ground_z_m": 0.0, "pem": "blind"},
    },
    "configurations": {
        "GT": {"units": "truth"},
        "alone": {"units": ["ego"], "latency_s": 0.3},
        "guess": {"units": ["guess"]},
        "both": {"units": ["ego", "blind"]},
        "animals": {"units": ["blind"]},
    },
    "measure": {"objects": {"classes": ["pedestrian"]}, "onset": {"kind": "at", "time_s": 0.5}},
    "show": None,
}


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    lorry = Obj(id=3, x=10.0, length=2.0, width=12.0, height=4.0, z=2.0)
    frames = [
        (0.1 * k, [Obj(id=1, x=0.0), pedestrian(2, 20.0), *([lorry] if k <= 10 else [])]) for k in range(21)
    ]  # fmt: skip
    return write_recording(tmp_path_factory.mktemp("logs") / "drive.mcap", frames, host=1)


def test_in_sight_is_when_the_first_list_may_have_it(log: Path) -> None:
    """The onset is at 0.5 s, the lorry hides him until 1.1 s; a mast for animals alone has him out of its view."""
    result = run_experiment(Experiment.model_validate(EXPERIMENT), [read_log(log, name="drive")])
    rows = study_rows(result).set_index("configuration")
    names = ["in_sight_s", "out_of_view_s", "hidden_s", "captured_s", "detection_s"]
    found = {name: rows.loc[name, names].tolist() for name in rows.index}
    assert np.isnan(found["GT"][:3]).all(), "the truth needs no sight"
    assert found["alone"] == pytest.approx([1.1, 0, 0.6, 1.1, 1.4]), "the latency does not change what is in sight"
    assert found["guess"] == pytest.approx([1.1, 0, 0, 0.5, 0.5]), "listed while hidden"
    assert found["both"] == pytest.approx([1.1, 0, 0.6, 1.1, 1.1]), "the mast for animals shows nobody a pedestrian"
    assert found["animals"][1:3] == pytest.approx([1.5, 0])
    assert np.isnan([found["animals"][k] for k in (0, 3, 4)]).all(), "never in view, until the end at 2.0 s"


def test_what_is_never_in_sight_is_null(log: Path) -> None:
    measure = EXPERIMENT["measure"] | {"onset": {"kind": "at", "time_s": 0.0}}  # type: ignore[operator]
    wall = [{"polygon_m": [[12.0, -9.0], [13.0, -9.0], [13.0, 9.0], [12.0, 9.0]], "height_m": 9.0, "ground_z_m": 0.0}]
    chosen = Experiment.model_validate(EXPERIMENT | {"measure": measure, "obstacles": wall})
    rows = study_rows(run_experiment(chosen, [read_log(log, name="drive")])).set_index("configuration")
    assert np.isnan(rows.loc["alone", "in_sight_s"])
    assert rows.loc["alone", ["out_of_view_s", "hidden_s"]].tolist() == pytest.approx([0.0, 2.0])


def test_only_units_that_are_there_in_a_run_have_it_in_sight() -> None:
    units = {name: {"at": [0.0, 0.0], "height_m": 1.0, "pem": "eyes"} for name in "abc"}
    recorded = {"rsu": {"recorded": {"topic": "rsu"}}}
    chosen = Experiment.model_validate(
        EXPERIMENT
        | {
            "units": {"a": units["a"], **recorded, "b": units["b"], "c": units["c"]},
            "configurations": {
                "ab": {"units": ["a", "b"]},
                "c": {"units": ["c"]},
                "rsu": {"units": ["a", "rsu"]},
                "GT": {"units": "truth"},
            },
        }
    )
    # Units a, b, c; two episodes with their onset at 0 s. a sees the first at 3 s, the second at 1 s.
    inf, nan = np.inf, np.nan
    spans = SightSpans(*map(np.array, zip(*[
        (0, 0, 0.0, 2.5, OUT_OF_VIEW), (0, 0, 2.5, 3.0, HIDDEN), (0, 0, 3.0, inf, IN_SIGHT),
        (0, 1, 1.0, inf, IN_SIGHT),
        (1, 0, 0.0, 2.0, HIDDEN), (1, 0, 2.0, inf, IN_SIGHT),
        (1, 1, 0.0, 4.0, HIDDEN), (1, 1, 4.0, inf, OUT_OF_VIEW),
    ], strict=True)))  # fmt: skip
    equipped = np.array([[True, True, True, True], [True, False, False, True], [False, True, True, True]])

    def of(name: str, there: np.ndarray, until_s: list[float]) -> list[list[list[float]]]:
        units = chosen.units_of(chosen.configurations[name])
        names = None if chosen.configurations[name].units == "truth" else units
        found = measure_sight(spans, chosen, names, there, np.array([until_s]))
        return [np.round(values, 9).tolist() for values in found]

    same = [pytest.approx(row, nan_ok=True) for row in [[nan, nan]] * 3]
    every = equipped[:1]
    assert of("ab", every, [9.0, 9.0]) == [[[2.0, 1.0]], [[0.0, 0.0]], [[2.0, 1.0]]]
    assert of("ab", every, [1.5, 0.5]) == [[[2.0, 1.0]], [[0.0, 0.0]], [[1.5, 0.5]]], "until it is listed"
    assert of("ab", equipped, [5.0, 5.0]) == [
        [[2.0, 1.0], [3.0, 1.0], pytest.approx([2.0, nan], nan_ok=True)],
        [[0.0, 0.0], [2.5, 0.0], [0.0, 1.0]],
        [[2.0, 1.0], [0.5, 0.0], [2.0, 4.0]],
    ]
    assert of("c", every, [5.0, 5.0])[0] == [pytest.approx([nan, nan], nan_ok=True)]
    assert of("c", every, [5.0, 5.0])[1:] == [[[0.0, 0.0]]] * 2, "no list of it: no unit there"
    for name in ("rsu", "GT"):
        assert [row for (row,) in of(name, every, [5.0, 5.0])] == same, (
            "recorded units don't tell what they had in sight"
        )
    assert NO_UNIT not in spans.state


def test_what_nothing_reads_is_not_computed_and_nothing_else_changes() -> None:
    """Against the same with all shares: what is listed, first sights, and the rows of single objects."""
    turn = np.random.default_rng(5)
    things = [Thing("ego", "car", driving(0, 0, 3, 0))]
    for k in range(40):
        x, y, vx, vy = turn.normal(0, [25, 25, 5, 5])
        things.append(Thing(str(k), "car" if k % 3 else "pedestrian", driving(x, y, vx, vy), yaw_rad=float(k)))
    pole = {"at": [9, 9], "height_m": 3.0, "ground_z_m": 0.0, "rate_hz": 5, "phase_s": 0.05, "pem": "ahead"}
    when = {"range_m": [0, 30], "azimuth_deg": [-60, 60], "visible_share": [0.2, 1.0]}
    ahead = [{"when": when, "detection": {"kind": "visible_share"}, "existence": "visible_share"}]
    log = recording(things, until_s=3.0)
    onset = {"kind": "in_range", "range_m": 25, "again_after_s": 0.5}
    units = {"ego": {"on": "ego", "height_m": 1.8, "pem": "ahead"}, "pole": pole}
    replay = prepare_log(log, experiment(pems={"ahead": ahead}, units=units, measure={"onset": onset}))
    found = replay.observe(replay.chunks[0])
    every = observe_objects(replay.scene, replay.truth, replay.expanded, replay.placed)
    for name in ("couple_ix", "probability", "existence"):
        assert np.array_equal(getattr(found, name), getattr(every, name)), name
    changes = [find_sight_changes(every, replay.expanded, replay.scene.tags, replay.episodes.number_rows(every.tracks))]
    spans = join_sight_changes(changes, replay.episodes.onset_s)
    for name in SightSpans.__dataclass_fields__:
        assert np.array_equal(getattr(replay.sight_spans, name), getattr(spans, name)), name
    assert np.bincount(spans.state, minlength=4)[[OUT_OF_VIEW, HIDDEN, IN_SIGHT]].min() > 1
    known = ~np.isnan(found.view.visible_share)
    assert np.array_equal(found.view.visible_share[known], every.view.visible_share[known])
    assert 0.1 < known.mean() < 0.7
    assert known[found.tracks.row_object_ix == replay.scene.ego_ix].all(), "links ask how much of the ego shows"
    some = np.array([2, 7, 11])
    asked, them = replay.rows_of(some), every.of_objects(some)
    assert np.array_equal(asked.view.visible_share, them.view.visible_share)
    assert np.array_equal(asked.tracks.row_object_ix, them.tracks.row_object_ix)
    assert np.array_equal(asked.probability, them.probability)

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
from copem_replay.metrics.episodes import earliest_sight_s, first_sights
from copem_replay.perception.observation import observe_objects
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


def test_in_sight_is_when_the_first_list_shows_it_whatever_is_made_of_it(log: Path) -> None:
    result = run_experiment(Experiment.model_validate(EXPERIMENT), [read_log(log, name="drive")])
    rows = study_rows(result).set_index("configuration")
    found = {name: rows.loc[name, ["in_sight_s", "captured_s", "detection_s"]].tolist() for name in rows.index}
    assert np.isnan(found["GT"][0]), "the truth needs no sight"
    assert found["alone"] == pytest.approx([1.1, 1.1, 1.4]), "the latency does not change what is in sight"
    assert found["guess"] == pytest.approx([1.1, 0.5, 0.5]), "listed while hidden"
    assert found["both"] == pytest.approx([0.5, 1.1, 1.1]), "in sight of a unit that never lists it"


def test_what_is_never_in_sight_is_null(log: Path) -> None:
    measure = EXPERIMENT["measure"] | {"onset": {"kind": "at", "time_s": 0.0}}  # type: ignore[operator]
    wall = [{"polygon_m": [[12.0, -9.0], [13.0, -9.0], [13.0, 9.0], [12.0, 9.0]], "height_m": 9.0, "ground_z_m": 0.0}]
    chosen = Experiment.model_validate(EXPERIMENT | {"measure": measure, "obstacles": wall})
    rows = study_rows(run_experiment(chosen, [read_log(log, name="drive")])).set_index("configuration")
    assert np.isnan(rows.loc["alone", "in_sight_s"])
    assert rows.loc["both", "in_sight_s"] == 0.0


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
    first_s = np.array([[3.0, 1.0], [2.0, np.inf], [np.inf, np.inf]])  # a, b, c; two looks
    equipped = np.array([[True, True, True, True], [True, False, False, True], [False, True, True, True]])

    def of(name: str, there: np.ndarray | None) -> list[list[float]]:
        found = earliest_sight_s(first_s, chosen, chosen.units_of(chosen.configurations[name]), there)
        return [[float(v) for v in row] for row in found]

    nan = pytest.approx(np.nan, nan_ok=True)
    assert of("ab", None) == [[2.0, 1.0]]
    assert of("ab", equipped) == [[2.0, 1.0], [3.0, 1.0], [2.0, nan]]
    assert of("c", None) == [[nan, nan]]
    assert of("rsu", None) == [[nan, nan]], "recorded units don't tell what they had in sight"
    assert of("GT", equipped) == [[nan, nan]]


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
    assert np.array_equal(replay.first_sights_s, first_sights(every, replay.episodes))
    assert np.isfinite(replay.first_sights_s).sum() > 20
    known = ~np.isnan(found.view.visible_share)
    assert np.array_equal(found.view.visible_share[known], every.view.visible_share[known])
    assert 0.1 < known.mean() < 0.7
    assert known[found.tracks.row_object_ix == replay.scene.ego_ix].all(), "links ask how much of the ego shows"
    some = np.array([2, 7, 11])
    asked, them = replay.rows_of(some), every.of_objects(some)
    assert np.array_equal(asked.view.visible_share, them.view.visible_share)
    assert np.array_equal(asked.tracks.row_object_ix, them.tracks.row_object_ix)
    assert np.array_equal(asked.probability, them.probability)

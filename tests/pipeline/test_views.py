"""Views of recorded units: a unit that is replayed from what it sent is known to see what it saw as a modelled one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import copem_replay as cr
from copem_replay.cli.main import main
from copem_replay.core.yaml import dump_yaml
from copem_replay.perception.sight import HIDDEN, IN_SIGHT, OUT_OF_VIEW
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.sight import compute_sight

ROOT = Path(__file__).parents[2]
VIEWS: list[dict[str, Any]] = [{"range_m": [0, 70], "azimuth_deg": [-60, 60]}, {"range_m": [0, 15]}]
PLACES: dict[str, dict[str, Any]] = {
    "rsu": {"at": [12.4, 12.4], "yaw_deg": -135, "height_m": 6.0, "ground_z_m": 0.0},
    "bus": {"on": "10", "height_m": 2.8},
}
SEEN = ["in_sight_s", "out_of_view_s", "hidden_s"]
CONFIGURATIONS = {name: {"units": [name]} for name in PLACES} | {"both": {"units": [*PLACES]}}


def experiment(units: dict[str, Any], **more: Any) -> dict[str, Any]:
    wall = {"polygon_m": [[14, -34], [50, -34], [50, -14], [14, -14]], "height_m": 9}
    return {
        "version": 1, "logs": [str(ROOT / "logs/crossing.mcap")], "runs": 1, "window_s": [0, 20], "units": units,
        "obstacles": [wall], "configurations": CONFIGURATIONS,
        "measure": {"onset": {"kind": "appears"}, "began": ["log_start", "crossed", "appeared"]},
    } | more  # fmt: skip


def modelled() -> dict[str, Any]:
    couples = [{"when": when, "detection": {"kind": "visible_share"}} for when in VIEWS]
    return experiment({name: at | {"pem": "eyes"} for name, at in PLACES.items()}, pems={"eyes": couples})


def recorded(path: Path, views: Any = VIEWS) -> dict[str, Any]:
    said = {} if views is None else {"views": views}
    exact = {"covariance_m2": [[0.01, 0], [0, 0.01]]}
    units = {
        name: at | said | {"recorded": {"topic": f"copem/units/{name}/objects"} | exact} for name, at in PLACES.items()
    }
    return experiment(units, logs=[str(path)], window_s=None)


@pytest.fixture(scope="module")
def sent(tmp_path_factory: pytest.TempPathFactory) -> tuple[pd.DataFrame, Path]:
    """The rows of the modelled units, and the recording with what they sent."""
    results, folder = cr.run(modelled()), tmp_path_factory.mktemp("views")
    results.save(folder / "r")
    return results.detections, folder / "r/replay.mcap"


def rows_of(table: pd.DataFrame) -> pd.DataFrame:
    return table.set_index(["configuration", "object_id", "episode"]).sort_index()


def test_they_see_what_they_saw(sent: tuple[pd.DataFrame, Path]) -> None:
    before, after = (rows_of(table) for table in (sent[0], cr.run(recorded(sent[1])).detections))
    assert len(before) > 20
    pd.testing.assert_frame_equal(before[["onset_s", *SEEN]], after[["onset_s", *SEEN]], atol=1e-6)
    assert (before[SEEN] > 0).sum().min() >= 5


def test_without_views_nothing_is_known_of_it(sent: tuple[pd.DataFrame, Path]) -> None:
    table = cr.run(recorded(sent[1], views=None)).detections
    assert table[SEEN].isna().all(axis=None)


def test_lanes_see_the_same(sent: tuple[pd.DataFrame, Path]) -> None:
    found = []
    for data in (modelled(), recorded(sent[1])):
        asked = cr.Experiment.model_validate(data)
        (recording,) = cr.read_recordings(asked)
        replay = prepare_log(recording, asked)
        found.append(compute_sight(replay, replay.expanded, replay.episodes.object_ix.tolist()))
    before, after = found
    assert np.array_equal(before.state, after.state)
    assert np.array_equal(before.body_ix, after.body_ix)
    assert np.bincount(before.state.ravel(), minlength=5)[[OUT_OF_VIEW, HIDDEN, IN_SIGHT]].min() > 50


@pytest.mark.extras
def test_what_hides_is_told_and_the_rest_is_as_recorded(sent: tuple[pd.DataFrame, Path]) -> None:
    """Without latency an object is known when it is listed: what the columns have until then is what causes have."""
    data = recorded(sent[1])
    explained = cr.why(data, configurations=["rsu"], parts=["causes"])
    assert explained.causes is not None
    causes = explained.causes.set_index("cause")["added_s"]
    rows = cr.run(data).detections.query("configuration == 'rsu' and ended_s > onset_s")
    unknown_s = rows["time_to_detection_s"].fillna(rows["ended_s"] - rows["onset_s"])
    hidden_s, out_s = rows["hidden_s"].mean(), rows["out_of_view_s"].mean()
    expected = {"hidden": hidden_s, "range": out_s, "recorded": unknown_s.mean() - hidden_s - out_s}
    assert causes.to_dict() == pytest.approx(expected)
    assert min(hidden_s, out_s) > 0.01


@pytest.mark.parametrize(
    ("unit", "line"),
    [
        ({"recorded": {"topic": "t"}}, "views: where from? expected `on: <object>`, or `at: [x, y]` with `height_m`"),
        ({"recorded": {"topic": "t"}, "at": [1, 2]}, "views: where from?"),
        ({"pem": "eyes", "on": "ego"}, "views: only for a recorded unit; a PEM says by its conditions where its unit"),
        ({"recorded": {"topic": "t"}, "on": "ego", "views": []}, "views: "),
        ({"recorded": {"topic": "t"}, "on": "ego", "views": [{"range_m": [9, 1]}]}, "expected [from, to]"),
    ],
)
def test_views_that_cannot_be(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, unit: dict[str, Any], line: str
) -> None:
    data = modelled() | {"units": {"rsu": {"views": VIEWS} | unit}, "configurations": {"one": {"units": ["rsu"]}}}
    (tmp_path / "a.yaml").write_text(dump_yaml(data))
    monkeypatch.setattr("sys.argv", ["copem-replay", "check", str(tmp_path / "a.yaml")])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert line in capsys.readouterr().err

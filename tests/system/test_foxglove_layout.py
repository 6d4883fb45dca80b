"""Layouts for Foxglove and Lichtblick: what they name is in the replay, and every scene has a panel that shows it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from copem_replay.core.errors import InputError
from copem_replay.experiment.file import load, log_paths
from copem_replay.experiment.validate import problems, read_logs
from copem_replay.pipeline.run import run
from copem_replay.results.write import write_results
from copem_replay.viewer.export import EXPORTERS
from tests.io.test_write_ros2 import EXPERIMENT, drive

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tools"))

from foxglove_layout import _split, layout_of  # noqa: E402

KEPT = ROOT / "logs/tc016d.foxglove.json"


@pytest.fixture(scope="module")
def replay(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample experiment's replay.mcap: of its first run, as five hundred would have it."""
    source = load(ROOT / "logs/tc016d.yaml")
    experiment, wrong = problems(source)
    assert experiment is not None, wrong
    once = experiment.model_copy(update={"runs": 1})
    recordings, _ = read_logs(once, log_paths(source)[0], source)
    folder = tmp_path_factory.mktemp("layout") / "tc016d"
    write_results(folder, once, recordings, run(once, recordings), exporters=EXPORTERS)
    return folder / "replay.mcap"


def leaves(part: Any) -> list[tuple[str, float, float]]:
    """Panels of a layout with the share of its width and height that each has."""
    if isinstance(part, str):
        return [(part, 1.0, 1.0)]
    assert set(part) == {"first", "second", "direction", "splitPercentage"}
    assert part["direction"] in ("row", "column")
    sides = []
    for side, share in (("first", part["splitPercentage"] / 100), ("second", 1 - part["splitPercentage"] / 100)):
        wide, high = (share, 1.0) if part["direction"] == "row" else (1.0, share)
        sides += [(panel, wide * w, high * h) for panel, w, h in leaves(part[side])]
    return sides


def test_a_panel_for_every_scene(replay: Path) -> None:
    layout = layout_of(replay)
    with replay.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    scenes = {c.topic for c in summary.channels.values() if summary.schemas[c.schema_id].name == "foxglove.SceneUpdate"}
    assert len(scenes) == 6
    panels = layout["configById"]
    assert all(panel.startswith("3D!") for panel in panels)
    seen = {}
    for panel, config in panels.items():
        assert set(config["topics"]) == scenes, "what it names is there, and what it does not show is switched off"
        (topic,) = (topic for topic, says in config["topics"].items() if says["visible"])
        assert topic == f"copem/{config['foxglovePanelTitle']}/scene"
        assert config["foxglovePanelTitle"] == config["lichtblickPanelTitle"]
        assert config["followTf"] == "global", "the frame of reference of the scenes"
        assert config["scene"]["syncCamera"] is True
        seen[topic] = panel
    assert set(seen) == scenes
    placed = leaves(layout["layout"])
    assert sorted(panel for panel, *_ in placed) == sorted(panels)
    for _, wide, high in placed:
        assert (wide, high) == pytest.approx((1 / 3, 1 / 2), abs=1e-4)
    # In the order of the experiment, row by row.
    titles = [panels[panel]["foxglovePanelTitle"] for panel, *_ in placed]
    assert titles == ["GT", "PEM", "coPEM:0s", "coPEM:0.5s", "coPEM:1s", "coPEM:1.5s"]


def test_the_sample_layout_is_what_the_tool_makes(replay: Path, tmp_path: Path) -> None:
    out = tmp_path / "new" / "layout.json"
    command = [sys.executable, str(ROOT / "tools/foxglove_layout.py"), str(replay), str(out)]
    subprocess.run(command, check=True)
    assert out.read_bytes() == KEPT.read_bytes()
    assert json.loads(KEPT.read_text(encoding="utf-8")) == layout_of(replay)


def test_the_camera_looks_at_what_is_there(replay: Path) -> None:
    """The pedestrian crosses at the origin of the sample scene; the car ends there."""
    (camera,) = {json.dumps(config["cameraState"]) for config in layout_of(replay)["configById"].values()}
    x, y, _ = json.loads(camera)["targetOffset"]
    assert abs(x) < 15
    assert abs(y) < 10


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5])
def test_parts_of_a_split_are_alike(count: int) -> None:
    found = leaves(_split("row", [str(k) for k in range(count)]))
    assert [panel for panel, *_ in found] == [str(k) for k in range(count)]
    assert [wide for _, wide, _ in found] == pytest.approx([1 / count] * count, abs=1e-4)


def test_what_has_no_scene_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"tc016d.mcap: expected topics copem/<configuration>/scene"):
        layout_of(ROOT / "logs/tc016d.mcap")
    with pytest.raises(InputError, match=r"none.mcap: cannot be read"):
        layout_of(tmp_path / "none.mcap")
    (tmp_path / "text.mcap").write_text("no recording")
    with pytest.raises(InputError, match=r"text.mcap: cannot be read"):
        layout_of(tmp_path / "text.mcap")


def test_a_replay_of_a_ros_2_recording(tmp_path: Path) -> None:
    """Scenes in CDR, in the frame of reference of the recording."""
    drive(tmp_path / "drive.mcap", "square")
    (tmp_path / "e.yaml").write_text(EXPERIMENT)
    source = load(tmp_path / "e.yaml")
    experiment, wrong = problems(source)
    assert experiment is not None, wrong
    recordings, _ = read_logs(experiment, log_paths(source)[0], source)
    write_results(tmp_path / "out", experiment, recordings, run(experiment, recordings), exporters=EXPORTERS)
    panels = layout_of(tmp_path / "out/replay.mcap")["configById"].values()
    assert [panel["foxglovePanelTitle"] for panel in panels] == ["GT", "PEM", "coPEM", "gnn"]
    assert {panel["followTf"] for panel in panels} == {"square"}

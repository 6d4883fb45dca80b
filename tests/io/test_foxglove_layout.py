"""Layouts for Foxglove and Lichtblick: what they name is in the replay, and every scene has a panel that shows it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

import copem_replay as cr
from copem_replay.cli import main as cli
from copem_replay.cli.results import layout
from copem_replay.core.errors import InputError
from copem_replay.experiment.file import log_paths, read_experiment_file
from copem_replay.experiment.validate import find_problems, read_logs
from copem_replay.io.write.foxglove_layout import build_layout, split_panels
from copem_replay.pipeline.run import run_experiment
from copem_replay.results.folder import read_made_names
from copem_replay.results.write import write_results
from copem_replay.viewer.rrd import EXPORTERS
from tests.helpers import experiments
from tests.io.test_write_ros2 import EXPERIMENT, drive

ROOT = Path(__file__).parents[2]
KEPT = ROOT / "logs/tc016d.foxglove.json"


@pytest.fixture(scope="module")
def replay(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample experiment's replay.mcap: of its first run, as five hundred would have it."""
    source = read_experiment_file(ROOT / "logs/tc016d.yaml")
    experiment, wrong = find_problems(source)
    assert experiment is not None, wrong
    once = experiment.model_copy(update={"runs": 1})
    recordings, _ = read_logs(once, log_paths(source)[0], source)
    folder = tmp_path_factory.mktemp("layout") / "tc016d"
    write_results(folder, once, recordings, run_experiment(once, recordings), exporters=EXPORTERS)
    return folder / "replay.mcap"


def test_results_of_several_logs_have_a_layout_each(tmp_path: Path) -> None:
    for name in ("drive.mcap", "again.mcap"):
        experiments.drive(tmp_path / name)
    (tmp_path / "e.yaml").write_text(
        experiments.changed("logs: [drive.mcap, again.mcap]", "show: {run: 0, logs: [all]}")
    )
    folder = cr.run(tmp_path / "e.yaml").save(tmp_path / "r")
    assert layout(folder) == 0
    written = {path.name: json.loads(path.read_text()) for path in (folder / "replay").glob("*.foxglove.json")}
    assert sorted(written) == ["again.foxglove.json", "drive.foxglove.json"]
    assert written["drive.foxglove.json"] == build_layout(folder / "replay/drive.mcap")
    assert {"replay/again.foxglove.json", "replay/drive.foxglove.json"} <= read_made_names(folder)
    with pytest.raises(
        InputError, match=r"--out: expected one replay, found 2 of several logs; name one: .*again\.mcap"
    ):
        layout(folder, out=tmp_path / "x.json")
    assert layout(folder / "replay/drive.mcap", out=tmp_path / "x.json") == 0
    (folder / "replay/drive.mcap").rename(tmp_path / "drive.mcap")
    (folder / "replay/again.mcap").unlink()
    with pytest.raises(InputError, match=r"replay\.mcap: cannot be read"):
        layout(folder)


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


def topics_in(replay: Path) -> set[str]:
    with replay.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return {c.topic for c in summary.channels.values()}


def panels_of(layout: dict[str, Any], kind: str) -> dict[str, Any]:
    return {panel: config for panel, config in layout["configById"].items() if panel.startswith(kind)}


NAMES = ["GT", "PEM", "coPEM:0s", "coPEM:0.5s", "coPEM:1s", "coPEM:1.5s"]


def test_a_panel_for_every_scene(replay: Path) -> None:
    layout = build_layout(replay)
    scenes = panels_of(layout, "3D!")
    assert [config["foxglovePanelTitle"] for config in scenes.values()] == NAMES, "in the order of the experiment"
    for config in scenes.values():
        name = config["foxglovePanelTitle"]
        assert name == config["lichtblickPanelTitle"]
        assert set(config["topics"]) <= topics_in(replay)
        shown = {topic for topic, says in config["topics"].items() if says["visible"]}
        own = {f"copem/{name}/scene", f"copem/{name}/uncertainty"}
        assert shown == {"copem/truth/scene", "copem/truth/static"} | own
        assert (config["followTf"], config["followMode"]) == ("copem_ego", "follow-position")
        assert config["scene"]["syncCamera"] is True
    placed = leaves(layout["layout"])
    assert sorted(panel for panel, *_ in placed) == sorted(layout["configById"])
    for panel, wide, high in placed:
        expected = (1 / 3, 0.72 / 2) if panel.startswith("3D!") else (1 / 2, 0.28)
        assert (wide, high) == pytest.approx(expected, abs=1e-4)


def test_lanes_and_curves_name_what_is_in_the_statuses(replay: Path) -> None:
    layout = build_layout(replay)
    (lanes,) = panels_of(layout, "StateTransitions!").values()
    (curves,) = panels_of(layout, "Plot!").values()
    asked = [f'copem/{name}/status.objects[:]{{id=="2"}}' for name in NAMES]
    assert [path["value"] for path in lanes["paths"]] == [f"{path}.status" for path in asked]
    assert [path["value"] for path in curves["paths"]] == [f"{path}.age_s" for path in asked]
    assert {path.partition(".objects")[0] for path in asked} <= topics_in(replay)


def test_two_compared_are_over_each_other_and_alone(replay: Path) -> None:
    layout = build_layout(replay, ["PEM", "coPEM:1s"])
    titles = [config["foxglovePanelTitle"] for config in panels_of(layout, "3D!").values()]
    assert titles == ["PEM and coPEM:1s", "PEM", "coPEM:1s"]
    both = layout["configById"]["3D!0"]["topics"]
    shown = {topic for topic, says in both.items() if says["visible"] and "truth" not in topic}
    assert shown == {f"copem/{name}/{kind}" for name in ("PEM", "coPEM:1s") for kind in ("scene", "uncertainty")}
    (lanes,) = panels_of(layout, "StateTransitions!").values()
    assert [path["label"] for path in lanes["paths"]] == ["PEM: 2", "coPEM:1s: 2"]
    with pytest.raises(InputError, match="no configuration is named 'PME'; did you mean PEM"):
        build_layout(replay, ["PME"])


def test_the_sample_layout_is_what_the_command_makes(
    replay: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new" / "layout.json"
    monkeypatch.setattr("sys.argv", ["copem-replay", "layout", str(replay.parent), "--out", str(out)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert (ended.value.code, capsys.readouterr().out) == (0, f"layout in {out}\n")
    assert out.read_bytes() == KEPT.read_bytes()
    assert json.loads(KEPT.read_text(encoding="utf-8")) == build_layout(replay)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5])
def test_parts_of_a_split_are_alike(count: int) -> None:
    found = leaves(split_panels("row", [str(k) for k in range(count)]))
    assert [panel for panel, *_ in found] == [str(k) for k in range(count)]
    assert [wide for _, wide, _ in found] == pytest.approx([1 / count] * count, abs=1e-4)


def test_what_has_no_scene_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"tc016d.mcap: expected topics copem/<configuration>/scene"):
        build_layout(ROOT / "logs/tc016d.mcap")
    with pytest.raises(InputError, match=r"none.mcap: cannot be read"):
        build_layout(tmp_path / "none.mcap")
    (tmp_path / "text.mcap").write_text("no recording")
    with pytest.raises(InputError, match=r"text.mcap: cannot be read"):
        build_layout(tmp_path / "text.mcap")


def test_a_damaged_replay_is_refused(replay: Path, tmp_path: Path) -> None:
    damaged, data = tmp_path / "damaged.mcap", bytearray(replay.read_bytes())
    damaged.write_bytes(data[:5])
    with pytest.raises(InputError, match=r"damaged.mcap: cannot be read"):
        build_layout(damaged)
    chunk = data.index(b"zstd")  # the compression of the first one, behind which its data begin
    data[chunk + 20 : chunk + 40] = bytes(20)
    damaged.write_bytes(data)
    with pytest.raises(InputError, match=r"damaged.mcap: cannot be read: decompression error"):
        build_layout(damaged)


def test_a_replay_of_a_ros_2_recording(tmp_path: Path) -> None:
    """Scenes in CDR, in the frame of reference of the recording."""
    drive(tmp_path / "drive.mcap", "square")
    (tmp_path / "e.yaml").write_text(EXPERIMENT)
    source = read_experiment_file(tmp_path / "e.yaml")
    experiment, wrong = find_problems(source)
    assert experiment is not None, wrong
    recordings, _ = read_logs(experiment, log_paths(source)[0], source)
    write_results(tmp_path / "out", experiment, recordings, run_experiment(experiment, recordings), exporters=EXPORTERS)
    layout = build_layout(tmp_path / "out/replay.mcap")
    panels = panels_of(layout, "3D!").values()
    assert [panel["foxglovePanelTitle"] for panel in panels] == ["GT", "PEM", "coPEM", "gnn"]
    assert {panel["followTf"] for panel in panels} == {"copem_ego"}
    assert len(panels_of(layout, "StateTransitions!")) == 1

"""Layouts for Foxglove and Lichtblick: what they name is in the replay, and every scene has a panel that shows it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

import copem_replay as cr
from copem_replay.cli import main as cli
from copem_replay.core.colours import configuration_colours
from copem_replay.core.errors import InputError
from copem_replay.experiment.file import log_paths, read_experiment_file
from copem_replay.experiment.validate import find_problems, read_logs
from copem_replay.extras.layout.command import layout
from copem_replay.extras.layout.layout import build_layout, quote_topic, split_panels
from copem_replay.results.folder import read_made
from tests.helpers import experiments
from tests.helpers.replays import save_run
from tests.io.test_write_ros2 import EXPERIMENT, drive
from tests.oracles import message_path

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
    save_run(folder, once, recordings)
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
    assert {"replay/again.foxglove.json", "replay/drive.foxglove.json"} <= read_made(folder).keys()
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


def paths_of(layout: dict[str, Any]) -> list[str]:
    return [path["value"] for kind in ("StateTransitions!", "Plot!") for panel in panels_of(layout, kind).values()
            for path in panel["paths"]]  # fmt: skip


def statuses_in(replay: Path) -> dict[str, list[Any]]:
    """The messages of the statuses by topic."""
    found: dict[str, list[Any]] = {}
    with replay.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            if channel.topic.endswith("/status") and channel.message_encoding == "json":
                found.setdefault(channel.topic, []).append(json.loads(message.data))
    return found


def test_paths_lead_to_what_is_in_the_statuses(replay: Path) -> None:
    """By the grammar of the viewers each path names a topic, and in each of its messages one object's value."""
    layout, statuses = build_layout(replay), statuses_in(replay)
    paths = paths_of(layout)
    assert len(paths) == 2 * len(NAMES), "one object, known at different times"
    for path, name in zip(paths, [*NAMES, *NAMES], strict=True):
        topic, parts = message_path.parse(path)
        assert topic == f"copem/{name}/status"
        values = [message_path.pick(message, parts) for message in statuses[topic]]
        key = "status" if path.endswith(".status") else "age_s"
        expected = [[one[key] for one in message["objects"] if one["id"] == "2"] for message in statuses[topic]]
        assert values == expected
        assert all(len(value) == 1 for value in values)


def test_curves_have_the_colours_of_their_configurations(replay: Path) -> None:
    (curves,) = panels_of(build_layout(replay, ["coPEM:1s", "PEM"]), "Plot!").values()
    every = configuration_colours(NAMES, ["GT"])
    hexed = {name: "#" + bytes(colour).hex() for name, colour in every.items()}
    shown = [(path["label"], path["color"]) for path in curves["paths"]]
    assert shown == [(name, hexed[name]) for name in ("coPEM:1s", "PEM")]


@pytest.mark.parametrize(
    ("topic", "quoted"),
    [("copem/coPEM:0.5s/status", '"copem/coPEM:0.5s/status"'), ('a "b" \\ c', r'"a \"b\" \\ c"')],
)
def test_topics_in_quotes(topic: str, quoted: str) -> None:
    assert quote_topic(topic) == quoted
    assert message_path.parse(f"{quoted}.objects[:]") == (topic, ["objects", slice(0, None)])


def test_a_bare_topic_with_a_colon_is_no_path() -> None:
    """Why they are quoted: of `copem/coPEM:0s/status.objects` the grammar reads `copem/coPEM` only."""
    with pytest.raises(ValueError, match="at 11"):
        message_path.parse("copem/coPEM:0s/status.objects")


def test_objects_whose_names_need_care(tmp_path: Path) -> None:
    """Names in letters of all languages, with quotes and with spaces: each path parses and finds its object."""
    names = ['say "hi"', "Fußgänger 2", "it's"]
    statuses = {"objects": [{"id": name, "status": "known", "age_s": 0.1} for name in names]}
    contents = {"scene": {}, "status": statuses, "detail": {"events": [{"object": name} for name in names]}}
    with (tmp_path / "replay.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        for kind, content in contents.items():
            channel = writer.register_channel(f"copem/with radio: 0 %/{kind}", "json", 0)
            writer.add_message(channel, 10**9, json.dumps(content).encode(), 10**9)
        writer.finish()
    layout = build_layout(tmp_path / "replay.mcap")
    told = []
    for path in paths_of(layout):
        topic, parts = message_path.parse(path)
        assert topic == "copem/with radio: 0 %/status"
        assert len(message_path.pick(statuses, parts)) == 1
        told += [part[1] for part in parts if isinstance(part, tuple)]
    assert sorted(told) == sorted(2 * names)
    placed = leaves(layout["layout"])
    assert sorted(panel for panel, *_ in placed) == sorted(layout["configById"])
    assert [wide for panel, wide, _ in placed if panel.startswith("Plot!")] == pytest.approx([1 / 3] * 3, abs=1e-4)


def test_two_compared_are_over_each_other_and_alone(replay: Path) -> None:
    layout = build_layout(replay, ["PEM", "coPEM:1s"])
    titles = [config["foxglovePanelTitle"] for config in panels_of(layout, "3D!").values()]
    assert titles == ["PEM and coPEM:1s", "PEM", "coPEM:1s"]
    both = layout["configById"]["3D!0"]["topics"]
    shown = {topic for topic, says in both.items() if says["visible"] and "truth" not in topic}
    assert shown == {f"copem/{name}/{kind}" for name in ("PEM", "coPEM:1s") for kind in ("scene", "uncertainty")}
    (lanes,) = panels_of(layout, "StateTransitions!").values()
    assert [path["label"] for path in lanes["paths"]] == ["PEM", "coPEM:1s"]
    assert lanes["foxglovePanelTitle"] == "2: known"
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
    save_run(tmp_path / "out", experiment, recordings)
    layout = build_layout(tmp_path / "out/replay.mcap")
    panels = panels_of(layout, "3D!").values()
    assert [panel["foxglovePanelTitle"] for panel in panels] == ["GT", "PEM", "coPEM", "gnn"]
    assert {panel["followTf"] for panel in panels} == {"copem_ego"}
    objects = {message_path.parse(path)[1][2][1] for path in paths_of(layout)}
    assert len(objects) == len(panels_of(layout, "StateTransitions!")) == len(panels_of(layout, "Plot!")) == 3

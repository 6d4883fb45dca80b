"""No output replaces what no command may replace: every command, each of its options, each kind of file."""

from __future__ import annotations

import ast
import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.models import ArgumentInfo

from copem_replay.cli import guard
from copem_replay.cli.main import app
from copem_replay.core.errors import OutputError
from copem_replay.core.extras import has_extra
from copem_replay.results.outputs import made_file, made_files
from copem_replay.viewer.open import list_rrd_files
from tests.helpers.experiments import changed
from tests.system.test_cli import Call, call, here, made_once, ran

__all__ = ["call", "here", "made_once", "ran"]  # fixtures

PACKAGE = Path(__file__).parents[2] / "copem_replay"


def list_commands() -> Iterator[tuple[list[str], Callable[..., Any]]]:
    """Every command of the program by its words, those of groups, too."""
    for group, words in [(app, []), *((g.typer_instance, [str(g.name)]) for g in app.registered_groups)]:
        assert group is not None
        for info in group.registered_commands:
            assert info.callback is not None
            yield [*words, info.name or info.callback.__name__], info.callback


OUTPUTS = [
    pytest.param(words, command, name, id="-".join([*words, name]))
    for words, command in list_commands()
    for name in guard.list_outputs(command)
]
FILES = (
    "drive.mcap", "drive.osi", "bag/metadata.yaml", "bag/bag_0.db3", "e.yaml", "e.txt", "e.json", "criteria.yml",
    "link", "out/e/provenance.json", "out/e/made.jsonl", "out/e/experiment.yaml", "out/e/summary.csv",
    "out/e/detections.parquet", "out/e/replay.mcap",
    *(("site.xodr", "site.osm", "site.geojson", "site.json") if has_extra("reader", "map") else ()),
)  # fmt: skip


@pytest.fixture
def protected(ran: Path) -> Path:
    """The working folder with files of all kinds that no command replaces."""
    here = ran.parents[1]
    for name, content in {
        "drive.osi": b"\x05\0\0\0hello",
        "bag/metadata.yaml": b"rosbag2_bagfile_information: {}\n",
        "bag/bag_0.db3": b"SQLite format 3\0 and more",
        "e.txt": b"# mine\nversion: 1\nconfigurations: {}\n",
        "e.json": b'{"version": 1, "units": {}}',
        "criteria.yml": b"criteria: {}\n",
        "site.xodr": b"<?xml version='1.0'?><OpenDRIVE><road/></OpenDRIVE>",
        "site.osm": b"<osm version='0.6'></osm>",
        "site.geojson": b'{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {}}]}',
        "site.json": b'{"lane_segments": {}}',
        "out/e/made.jsonl": b'"report.html"\n',
    }.items():
        (here / name).parent.mkdir(exist_ok=True)
        (here / name).write_bytes(content)
    (here / "link").symlink_to("e.yaml")
    return here


def content_of(folder: Path) -> dict[str, bytes | str]:
    paths = sorted(path for path in folder.rglob("*") if not path.is_dir() or path.is_symlink())
    return {str(p.relative_to(folder)): os.readlink(p) if p.is_symlink() else p.read_bytes() for p in paths}


def arguments_of(words: list[str], command: Callable[..., Any]) -> list[str]:
    """A call of a command without its output, as far as it needs one to be taken for a call."""
    told = list(words)
    for name, (info, _) in guard._list_parameters(command).items():
        if isinstance(info, ArgumentInfo):
            told += ["e.yaml" if name == "experiment" else "out/e"]
    told += ["--criterion", "known", "--free", "seed"] * (words == ["require"])
    return told + ["--unit", "ego"] * (words == ["fit"]) + ["--overwrite"] * (words[0] == "convert")


@pytest.mark.extras
def test_there_are_the_options_that_are_known_to_be_there() -> None:
    flags = {name for _, command in list_commands() for name in guard.list_outputs(command)}
    assert flags == {"out", "junit", "markdown", "jsonl", "rrd", "pieces"}
    assert len(OUTPUTS) == 25


@pytest.mark.parametrize(("words", "command", "name"), OUTPUTS)
def test_no_option_replaces_what_no_command_may_replace(
    protected: Path, call: Call, words: list[str], command: Callable[..., Any], name: str
) -> None:
    before = content_of(protected)
    for file in FILES:
        ended = call(*arguments_of(words, command), f"--{name}", file)
        assert (ended.code, len(ended.lines)) == (2, 1), (file, ended)
        assert file in ended.lines[0], file
        assert content_of(protected) == before, file


@pytest.mark.parametrize(("words", "command", "name"), OUTPUTS)
def test_a_folder_of_a_recording_is_no_output(
    protected: Path, call: Call, words: list[str], command: Callable[..., Any], name: str
) -> None:
    before = content_of(protected)
    ended = call(*arguments_of(words, command), f"--{name}", "bag")
    assert (ended.code, len(ended.lines)) == (2, 1), ended
    assert content_of(protected) == before


@pytest.mark.extras
def test_an_input_of_any_kind_is_no_output(ran: Path, call: Call) -> None:
    here = ran.parents[1]
    (here / "criteria").write_text("criteria: {a: {metric: detected_share, at_least: 0}}\n")
    (here / "t.csv").write_text("time_s,id\n")
    for words, option in (
        (["verdict", "out/e", "--criteria", "criteria", "--junit", "criteria"], "--junit"),
        (["verdict", "out/e", "--criteria", "criteria", "--markdown", "./criteria"], "--markdown"),
        (["convert", "csv", "--out", "t.csv", "--overwrite", "t.csv"], "--out"),
    ):
        before = content_of(here)
        ended = call(*words)
        line = f"{option}: expected another name, found that of an input of this command: "
        assert (ended.code, ended.lines) == (2, [f"{line}{Path(words[3 if words[0] == 'convert' else -1])}"])
        assert content_of(here) == before


@pytest.mark.parametrize(
    ("words", "first", "second"),
    [
        (["verdict", "out/e", "--junit", "a", "--markdown", "x/../a"], "--junit", "--markdown"),
        (["verdict", "out/e", "--junit", "out/e/verdicts.jsonl"], "--jsonl", "--junit"),
        (["compare", "out/e", "--out", "c.csv", "--rrd", "c.csv"], "--out", "--rrd"),
        (["run", "e.yaml", "--pieces", "out/e", "--overwrite"], "--out", "--pieces"),
    ],
)
def test_two_outputs_of_one_name(ran: Path, call: Call, words: list[str], first: str, second: str) -> None:
    (ran.parents[1] / "x").mkdir()
    before = content_of(ran.parents[1])
    ended = call(*words)
    assert ended.code == 2
    assert ended.lines[0].startswith(f"{second}: expected another name than that of {first}, found ")
    assert content_of(ran.parents[1]) == before


@pytest.mark.parametrize(("words", "command", "name"), OUTPUTS)
def test_the_folder_above_is_a_file(
    ran: Path, call: Call, words: list[str], command: Callable[..., Any], name: str
) -> None:
    before = content_of(ran.parents[1])
    ended = call(*arguments_of(words, command), f"--{name}", "e.yaml/more/x")
    assert ended == (2, "", [f"e.yaml/more/x: cannot be written: {ran.parents[1]}/e.yaml is a file"])
    assert content_of(ran.parents[1]) == before


@pytest.mark.extras
def test_a_command_replaces_its_own_earlier_output(here: Path, call: Call) -> None:
    (here / "e.yaml").write_text(changed("show: {run: 0}", "criteria: {known: {metric: detected_share, at_least: 0}}"))
    (here / "t.csv").write_text(
        "time_s,id,class,x_m,y_m,yaw_deg,length_m,width_m\n0,1,car,0,0,0,4,2\n0.1,1,car,1,0,0,4,2\n"
    )
    commands = [
        ["run", "e.yaml", "--overwrite", "--pieces", "pieces"],
        ["run", "out/e/experiment.yaml", "--overwrite", "--out", "out/e"],
        ["verdict", "out/e", "--junit", "v.xml", "--markdown", "v.md"],
        ["verdict", "out/e", "--jsonl", "v.jsonl"],
        ["compare", "out/e", "--baseline", "PEM", "--out", "out/e/c.csv", "--rrd", "c.rrd"],
        ["compare", "out/e", "--baseline", "PEM", "--out", "c.md"],
        ["report", "out/e"],
        ["report", "out/e", "--out", "more/page.html"],
        ["layout", "out/e"],
        ["layout", "out/e", "--out", "layout.json"],
        ["history", "out/e"],
        ["why", "out/e", "--causes"],
        ["require", "e.yaml", "--criterion", "known", "--free", "configurations.coPEM.latency_s=0:1:0.5"],
        ["convert", "csv", "t.csv", "--out", "t.mcap", "--overwrite"],
    ]
    for command in commands:
        for _ in range(2):
            ended = call(*command)
            assert ended.code in (0, 1), (command, ended)  # 1: a verdict


@pytest.mark.parametrize("file", FILES)
def test_the_functions_of_the_api_do_not_either(protected: Path, monkeypatch: pytest.MonkeyPatch, file: str) -> None:
    """They write by these two alone."""
    monkeypatch.chdir(protected)
    before = content_of(protected)
    path = Path(file)
    with pytest.raises(OutputError), made_file(path) as scratch:
        scratch.write_text("new")
    with pytest.raises(OutputError), made_files(path.parent, [path.name], Path("out/e")) as scratch:
        (scratch / path.name).write_text("new")
    assert content_of(protected) == before


def test_nothing_is_written_past_the_gate() -> None:
    """Who else writes complete files: what goes into places that the gate has let through, kept parts, samples."""
    writers = {
        str(path.relative_to(PACKAGE))
        for path in PACKAGE.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Name) and node.id in ("atomic_file", "atomic_files")
    }
    past = {"pipeline/parts.py", "viewer/sink.py", "io/write/osi.py", "io/write/mcap.py", "cli/inspect.py"}
    assert writers == {"results/outputs.py", *past}


@pytest.mark.extras
def test_leftovers_of_renamed_logs_go_with_the_old_results(here: Path, call: Call) -> None:
    from copem_replay.extras.layout.layout import list_replays

    (here / "a").mkdir()
    shutil.copy(here / "drive.mcap", here / "b.mcap")
    shutil.move(here / "drive.mcap", here / "a.mcap")
    (here / "e.yaml").write_text(changed("show: {logs: [all], run: 0}"))
    assert call("run", "e.yaml", "--log", "a.mcap", "--log", "b.mcap").code == 0
    (here / "out/e/replay/.a.foxglove.json.abcd1234.tmp.json").write_text("half")
    for suffix in ("rrd", "mcap"):
        (here / f"out/e/replay/.a.{suffix}.abcd1234.tmp.{suffix}").write_text("half")
    assert {path.name for path in list_rrd_files(here / "out/e")} == {"a.rrd", "b.rrd"}
    assert {path.name for path in list_replays(here / "out/e")} == {"a.mcap", "b.mcap"}
    left = here / "out/e/replay/.a.rrd.abcd1234.tmp"
    (left / "new").mkdir(parents=True)
    (left / "files.json").write_text(json.dumps({"files": ["a.rrd"]}))
    (left / "new/a.rrd").write_text("half")
    os.rename(here / "a.mcap", here / "c.mcap")
    ended = call("run", "e.yaml", "--log", "c.mcap", "--log", "b.mcap", "--overwrite")
    assert [line for line in ended.lines if "interval" not in line] == []
    names = {path.name for path in (here / "out/e/replay").iterdir()}
    assert names == {"b.mcap", "b.rrd", "c.mcap", "c.rrd"}
    assert os.listdir(here / "out") == ["e"]

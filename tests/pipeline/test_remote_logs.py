"""Logs under URLs: fetched when they have to be read, and nothing that lets us in gets into results."""

from __future__ import annotations

import json
import shlex
import socket
import sys
import tempfile
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from fsspec.config import conf as fsspec_settings

from copem_replay.cli import main as cli
from copem_replay.core import waiting
from copem_replay.core.errors import CopemError, RemoteFile, hide_credentials, strip_credentials
from copem_replay.experiment import validate
from tests.cli.test_api import cr
from tests.helpers.experiments import changed, drive
from tests.helpers.object_storage import Bucket
from tests.pipeline.test_parts import replayed, study

OF_A_PLACE = {"experiment.yaml", "logs.csv"}
"""What says where the logs lie."""


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "scratch"))
    (tmp_path / "scratch").mkdir()
    for name in ("drives/1/a", "drives/b"):
        drive(tmp_path / f"{name}.mcap")
    return tmp_path


@pytest.fixture
def drives(here: Path, bucket: Bucket) -> Bucket:
    """The same drives in a bucket."""
    for path in here.glob("drives/**/*.mcap"):
        bucket.put(path, path.relative_to(here).as_posix())
    bucket.fs.pipe_file(f"{bucket.url}/drives/notes.txt", b"no drive")
    return bucket


def ran(command: str, capsys: pytest.CaptureFixture[str]) -> tuple[object, list[str]]:
    """Exit code of a command, and what it says on stderr."""
    argv, sys.argv = sys.argv, shlex.split(command)
    try:
        code = cli._run_to_exit_code()
    finally:
        sys.argv = argv
    return code, capsys.readouterr().err.splitlines()


def but_places(files: dict[str, bytes]) -> dict[str, bytes]:
    """All but what says where files are, and the seals of that."""
    said = json.loads(files["provenance.json"])
    for name in (*OF_A_PLACE, "provenance.json"):
        del said["sha256"][name]
    kept = {name: content for name, content in files.items() if name not in OF_A_PLACE}
    return kept | {"provenance.json": json.dumps(said).encode()}


@pytest.mark.parametrize("show", ["null", "{run: worst, logs: [b]}"])
def test_the_same_bytes_from_object_storage_and_nothing_is_fetched_again(
    show: str, here: Path, drives: Bucket, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = study("logs: [drives/**/*.mcap]", f"show: {show}")
    plain, computed, _ = replayed(text, "plain")
    remote = text.replace("drives/**", f"{drives.url}/drives/**")
    kept, there = f"{drives.url}/study.pieces", []

    def fetch(log: RemoteFile, to: str, whole: Any = RemoteFile.fetch) -> None:
        there.append(sorted(path.name for path in here.glob("scratch/*/*")))
        whole(log, to)

    monkeypatch.setattr(RemoteFile, "fetch", fetch)
    first, mine, found = replayed(remote, "first", kept)
    assert (mine, found) == (computed, 0)
    assert but_places(first) == but_places(plain)
    assert there[:2] == [[], []], "one copy at a time, and none is left"
    assert not any(here.glob("scratch/*"))
    before = len(drives.requests())
    again, mine, found = replayed(remote, "first", kept)
    assert (mine, found, again) == (0, computed, first)
    asked = drives.requests()[before:]
    fetched = [path for method, path in asked if method == "GET" and path.endswith(".mcap")]
    assert {Path(path).name for path in fetched} == ({"b.mcap"} if show != "null" else set())
    assert {method for method, _ in asked} <= {"GET", "HEAD"}, "nothing is written"
    written = first["experiment.yaml"].decode(), first["logs.csv"].decode()
    assert all(f"{drives.url}/drives/1/a.mcap" in of and f"{drives.url}/drives/b.mcap" in of for of in written)
    assert Path("first/experiment.yaml").read_text() == written[0]
    rerun = cr.run("first/experiment.yaml", pieces=kept)
    rerun.save("rerun")
    assert Path("rerun/summary.csv").read_bytes() == plain["summary.csv"]


def test_another_content_is_read_again(here: Path, drives: Bucket) -> None:
    text = study(f"logs: ['{drives.url}/drives/b.mcap', {{file: '{drives.url}/drives/1/*.mcap', name: one}}]", runs=3)
    _, computed, _ = replayed(text, "out")
    assert replayed(text, "out")[1:] == (0, computed)
    drive(here / "other.mcap", first=7, host=7)
    drives.put(here / "other.mcap", "drives/b.mcap")
    assert replayed(text, "out")[1:] == (computed // 2, computed // 2)


def test_a_damaged_part_is_computed_again(here: Path, drives: Bucket, capsys: pytest.CaptureFixture[str]) -> None:
    kept = f"{drives.url}/kept"
    Path("e.yaml").write_text(study(f"logs: ['{drives.url}/drives/b.mcap']", runs=3))
    command = f"copem-replay run e.yaml --overwrite --pieces {kept}"
    assert ran(command, capsys)[1][-1] == f"pieces: 3 computed, 0 found in {kept}"
    path = drives.fs.find(f"{kept}/parts")[0]
    drives.fs.pipe_file(path, drives.fs.cat_file(path)[:-100])
    damaged, counted = ran(command, capsys)[1]
    assert damaged.startswith(f"note: s3://{path}: damaged, computed again (")
    assert counted == f"pieces: 1 computed, 2 found in {kept}"


@pytest.fixture
def server(here: Path) -> Iterator[str]:
    """A web server of this folder."""

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            """Say nothing."""

    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(here))) as served:
        thread = threading.Thread(target=served.serve_forever)
        thread.start()
        yield f"127.0.0.1:{served.server_address[1]}"
        served.shutdown()
        thread.join()


def test_no_user_and_no_query_of_a_url_gets_anywhere(
    here: Path, server: str, capsys: pytest.CaptureFixture[str]
) -> None:
    url = f"http://{server}/drives/b.mcap"
    Path("e.yaml").write_text(changed(f"logs: ['{url}?token=secret']", "show: {run: worst}"))
    code, said = ran("copem-replay run e.yaml --out out --pieces kept", capsys)
    assert (code, said) == (0, ["pieces: 3 computed, 0 found in kept"])
    code, said = ran("copem-replay run e.yaml --out out --pieces kept --overwrite", capsys)
    assert (code, said) == (0, ["pieces: 0 computed, 3 found in kept"])
    absent = f"http://nobody:secret@{server}/drives/c.mcap?token=secret"
    code, (line,) = ran(f"copem-replay run e.yaml --out none --log '{absent}'", capsys)
    assert code == 2
    assert line.startswith(f"http://{server}/drives/c.mcap: 404")
    assert "secret" not in line
    results = [path for folder in ("out", "kept") for path in Path(folder).rglob("*") if path.is_file()]
    assert len(results) > 10
    assert [path for path in results if b"secret" in path.read_bytes()] == []
    assert url in Path("out/experiment.yaml").read_text()


@pytest.mark.parametrize(
    ("logs", "said"),
    [
        ("[s3://there-is-none/*.mcap]", "e.yaml:2: logs[0]: no file matches 's3://there-is-none/*.mcap'"),
        ("[s3://there-is-none/a.mcap]", "e.yaml:2: logs[0]: s3://there-is-none/a.mcap: no such file"),
        ("['BUCKET/drives/c.mcap']", "e.yaml:2: logs[0]: BUCKET/drives/c.mcap: no such file"),
        ("['BUCKET/drives/1']", "BUCKET/drives/1: expected a file, found a folder; a rosbag2 folder is read"),
        ("['BUCKET/drives/notes.txt']", "BUCKET/drives/notes.txt: text, which is not read;"),
        ("[drives://b/a.mcap]", "e.yaml:2: logs[0]: drives://b/a.mcap: expected a protocol of s3, s3a, gs,"),
        ("['https://nobody@there/*.mcap']", "e.yaml:2: logs[0]: https://there/*.mcap: a web server lists nothing;"),
        ("['http://127.0.0.1:1/a.mcap']", "e.yaml:2: logs[0]: http://127.0.0.1:1/a.mcap: Cannot connect to host"),
        ("[{together: [drives/b.mcap, s3://x/a.mcap]}]",
         "e.yaml:2: logs[0].together: expected recordings on this machine, found s3://x/a.mcap"),
    ],
)  # fmt: skip
def test_what_cannot_be_had_is_said_in_one_line(
    logs: str, said: str, here: Path, drives: Bucket, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("e.yaml").write_text(changed(f"logs: {logs.replace('BUCKET', drives.url)}"))
    code, lines = ran("copem-replay run e.yaml", capsys)
    assert code == 2
    assert len(lines) == 1
    assert lines[0].startswith(said.replace("BUCKET", drives.url))


@pytest.mark.parametrize(
    "url",
    [
        "file:///etc/passwd::https://there/a.mcap", "simplecache::file:///etc/passwd", "zip://a.mcap::file:///a.zip",
        "zip:///etc/passwd", "reference://a.mcap", "local:///etc/passwd", "github://a:b@/c", "dask://x/a.mcap",
        "https://there/a.mcap::reference://", "s3://bucket/a::b.mcap",
    ],
)  # fmt: skip
def test_protocols_that_open_what_is_here_or_what_a_file_names_are_refused(
    url: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("e.yaml").write_text(changed(f"logs: ['{url}']"))
    code, (line,) = ran("copem-replay check e.yaml", capsys)
    assert code == 2
    assert "URLs within a URL" in line or ": expected a protocol of s3, s3a, gs, gcs, az, " in line
    code, (line,) = ran(f"copem-replay run e.yaml --pieces {url}", capsys)
    assert code == 2
    assert "URLs within a URL" in line or ": expected a protocol of s3, s3a, gs, gcs, az, " in line


SIGNED = "https://nobody:secret@there:443/drives/b.mcap?X-Signature=secret&token=secret#secret"


@pytest.mark.parametrize(
    "command",
    [
        "info '{}'", "init '{}'", "info --json '{}'", "info --together drives/b.mcap '{}'", "check '{}'", "run '{}'",
        "report '{}'", "compare '{}'", "plot '{}'", "view '{}'", "layout '{}'", "convert csv '{}' out.mcap",
        "fit '{}' --from '{}'", "run e.yaml --out '{}/secret'",
    ],
)  # fmt: skip
def test_no_command_says_who_may_read_a_url(command: str, here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("e.yaml").write_text("version: 1\n")
    code, lines = ran(f"copem-replay {command.replace('{}', SIGNED)}", capsys)
    assert code == 2
    assert lines
    assert not any("secret" in line.replace("/secret: ", "") or "nobody" in line for line in lines), lines


@pytest.mark.parametrize("command", ["info", "init"])
def test_a_recording_under_a_url_is_fetched_before_it_is_looked_at(
    command: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert ran(f"copem-replay {command} '{SIGNED}'", capsys) == (2, [
        "https://there:443/drives/b.mcap: expected a recording on this machine, found a URL; fetch it first "
        "(`run`, `check` and `--log` take URLs)"
    ])  # fmt: skip
    assert ran(f"copem-replay {command} file://{here}/drives/b.mcap", capsys)[0] == 0


@pytest.mark.parametrize(
    ("url", "said"),
    [
        (SIGNED, "https://there:443/drives/b.mcap"),
        ("s3://bucket/a@b.mcap", "s3://bucket/a@b.mcap"),
        ("https://there:80/a@b.mcap", "https://there:80/a@b.mcap"),
        ("https://nobody:sec/ret@there/a.mcap", "https://there/a.mcap"),
        ("zip://x::https://a:secret@there/y.zip?z=secret", "zip://x::https://there/y.zip"),
        ("https://there/a.mcap#secret", "https://there/a.mcap"),
    ],
)
def test_a_url_as_it_is_said(url: str, said: str) -> None:
    assert strip_credentials(url) == said
    assert hide_credentials(f"x: '{url}', and so on") == f"x: '{said}', and so on"
    assert CopemError(f"{url}: not there").problems == (f"{said}: not there",)


@pytest.mark.parametrize("text", ["rsu:/objects#1?", "a: /objects?", "C:/a@b", "1:/2@3", "ego:/x@y"])
def test_what_is_no_url_is_said_as_it_is(text: str) -> None:
    assert hide_credentials(text) == text


@pytest.fixture
def silent(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A server that takes what it is sent and never answers; it is given up sooner than others."""
    monkeypatch.setattr(waiting, "IDLE_LIMIT_S", 0.4)
    monkeypatch.setattr(waiting, "TOLD_AFTER_S", 0.1)
    with socket.create_server(("127.0.0.1", 0)) as served:
        yield f"127.0.0.1:{served.getsockname()[1]}"


@pytest.mark.parametrize("protocol", ["http", "s3"])
@pytest.mark.parametrize("name", ["a.mcap", "*.mcap"])
def test_a_server_that_never_answers_is_given_up(
    protocol: str, name: str, here: Path, silent: str, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    if (protocol, name) == ("http", "*.mcap"):
        pytest.skip("a web server lists nothing")
    monkeypatch.setitem(fsspec_settings, "s3", {"endpoint_url": f"http://{silent}", "anon": True})
    told: list[str] = []
    waiting.tell_waits(told.append)
    url = f"http://{silent}/{name}" if protocol == "http" else f"s3://nobody/{name}"
    Path("e.yaml").write_text(changed(f"logs: ['{url}']"))
    code, (line,) = ran("copem-replay run e.yaml", capsys)
    assert code == 2
    assert line == f"e.yaml:2: logs[0]: {url}: no byte came for 0.4 s; is it reachable from here?"
    assert set(told) == {f"{url}: waiting, no byte for 0.1 s; given up after 0.4 s"}


def test_a_server_that_stops_in_the_middle_is_given_up(
    here: Path, silent: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """It says how long the recording is, and sends half of it."""

    class Half(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            """Say nothing."""

        def copyfile(self, source: Any, outputfile: Any) -> None:
            outputfile.write(source.read()[:1000])
            outputfile.flush()
            ended.wait(20)

    ended = threading.Event()
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Half, directory=str(here))) as served:
        thread = threading.Thread(target=served.serve_forever)
        thread.start()
        url = f"http://127.0.0.1:{served.server_address[1]}/drives/b.mcap"
        Path("e.yaml").write_text(changed(f"logs: ['{url}']"))
        code, (*_, line) = ran("copem-replay run e.yaml", capsys)  # before it, maybe, that one waits
        ended.set()
        served.shutdown()
        thread.join()
    assert code == 2
    assert line.endswith(f"{url}: no byte came for 0.4 s; is it reachable from here?")


def test_a_slow_server_is_waited_for_as_long_as_bytes_come(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(waiting, "IDLE_LIMIT_S", 0.3)
    pause = threading.Event()

    def ask(received: Any) -> str:
        for _ in range(8):
            pause.wait(0.1)
            received()
        return "all"

    assert waiting.await_server("there", ask) == "all"


def test_what_cannot_be_read_is_left_out_when_that_is_asked_for(
    here: Path, drives: Bucket, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("e.yaml").write_text(changed(f"logs: ['{drives.url}/drives/**', http://127.0.0.1:1/c.mcap]"))
    code, lines = ran("copem-replay run e.yaml --out out --skip-unreadable", capsys)
    assert code == 1
    assert [line.partition(": skipped: ")[0] for line in lines if "skipped" in line] == [
        f"note: {drives.url}/drives/notes.txt", "note: http://127.0.0.1:1/c.mcap",
    ]  # fmt: skip
    rows = Path("out/logs.csv").read_text().splitlines()
    assert [row.split(",")[1] for row in rows[1:]] == [
        f"{drives.url}/drives/1/a.mcap", f"{drives.url}/drives/b.mcap", f"{drives.url}/drives/notes.txt",
        "http://127.0.0.1:1/c.mcap",
    ]  # fmt: skip


def test_a_run_is_drawn_from_the_log_where_it_lies(here: Path, drives: Bucket) -> None:
    Path("e.yaml").write_text(changed(f"logs: ['{drives.url}/drives/b.mcap']"))
    cr.run("e.yaml").save("out")
    results = cr.load_results("out")
    assert results.recording("b", results.experiment).scene.log == "b"
    drive(here / "other.mcap", first=7, host=7)
    drives.put(here / "other.mcap", "drives/b.mcap")
    with pytest.raises(cr.RecordingError, match=rf"^{drives.url}/drives/b.mcap: expected the log that was replayed"):
        cr.load_results("out").recording("b", results.experiment)


def test_two_hundred_names_are_replayed_with_few_words_and_found_again_unread(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for k in range(200):
        (here / f"name{k}.mcap").hardlink_to(here / "drives/b.mcap")
    text = changed(
        "logs: ['name*.mcap']", "measure: {accuracy: false, horizon_s: 1}", "configurations: {PEM: {units: [ego]}}"
    )
    Path("e.yaml").write_text(
        "".join(line for line in text.splitlines(True) if not line.startswith(("  GT", "  PEM", "  co")))
    )
    command = "copem-replay run e.yaml --overwrite --out out --pieces kept"
    code, said = ran(command, capsys)
    assert (code, said[-1]) == (0, "pieces: 200 computed, 0 found in kept")
    assert len(said) <= 2
    monkeypatch.setattr(validate, "read_log", lambda *_, **__: pytest.fail("a log was read"))
    files = {path.name: path.read_bytes() for path in Path("out").iterdir()}
    assert ran(command, capsys)[1][-1] == "pieces: 0 computed, 200 found in kept"
    assert {path.name: path.read_bytes() for path in Path("out").iterdir()} == files

"""`view`: when recordings open, and the server of `view --web`: what it has, from where, and how it ends.

The small experiment's car is 60 m away 1 s after the log starts, its onset; so its recording opens at 0.5 s.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import urllib.error
import urllib.request
import warnings
from collections.abc import Iterator
from http.client import HTTPConnection, HTTPMessage
from pathlib import Path

import psutil
import pytest

import copem_replay as cr
from copem_replay.viewer.open import (
    PAGE,
    POLICY,
    TYPES,
    RecordingIdentity,
    Server,
    Sought,
    ViewerSite,
    list_rrd_files,
    opening_page,
    opening_s,
    read_identities,
    set_time,
)
from tests.helpers.experiments import changed, drive

COMMAND = Path(sys.executable).with_name("copem-replay")


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("web")
    drive(place / "drive.mcap")
    (place / "e.yaml").write_text(changed("show: {run: [0, worst]}"))
    return cr.run(place / "e.yaml").save(place / "r")


def got(url: str) -> tuple[bytes, HTTPMessage]:
    with urllib.request.build_opener(urllib.request.ProxyHandler({})).open(url, timeout=60) as answer:
        return answer.read(), answer.headers


def asked(server: Server, hosts: list[str], path: str) -> tuple[int, bytes]:
    """Status and content of an answer to a request with these `Host` lines; `{port}` is the server's."""
    port = server.socket.getsockname()[1]
    connection = HTTPConnection("127.0.0.1", port, timeout=60)
    connection.putrequest("GET", path, skip_host=True)
    for host in hosts:
        connection.putheader("Host", host.format(port=port))
    connection.endheaders()
    answer = connection.getresponse()
    try:
        return answer.status, answer.read()
    finally:
        connection.close()


class TestOpening:
    def test_some_know_an_object_and_others_do_not_yet(self, results: Path) -> None:
        files = list_rrd_files(results)
        assert [path.name for path in files] == ["replay.rrd", "replay_worst.rrd"]
        table = cr.load_results(results).detections
        for path, run in zip(files, cr.load_results(results).provenance.data["runs_shown"]["drive"], strict=True):
            known_s = table.loc[table["run"] == run["run"], "detection_s"].fillna(3.0)
            assert known_s.nunique() > 1
            assert known_s.min() < opening_s(results, [path])[path] < known_s.max()

    def test_of_several_logs_each_at_its_own(self, tmp_path: Path) -> None:
        drive(tmp_path / "drive.mcap")
        drive(tmp_path / "again.mcap")
        (tmp_path / "e.yaml").write_text(changed("logs: [drive.mcap, again.mcap]", "show: {run: 0, logs: [all]}"))
        folder = cr.run(tmp_path / "e.yaml").save(tmp_path / "r")
        files = list_rrd_files(folder)
        assert [path.relative_to(folder.absolute()).as_posix() for path in files] == [
            "replay/again.rrd",
            "replay/drive.rrd",
        ]
        assert opening_s(folder, files).keys() == set(files)
        assert opening_s(folder, files, Sought("2", "again")).keys() == {files[0]}

    def test_of_several_logs_one_is_shown(self, tmp_path: Path) -> None:
        drive(tmp_path / "drive.mcap")
        drive(tmp_path / "again.mcap")
        (tmp_path / "e.yaml").write_text(changed("logs: [drive.mcap, again.mcap]", "show: {run: 0}"))
        folder = cr.run(tmp_path / "e.yaml").save(tmp_path / "r")
        (file,) = list_rrd_files(folder)
        assert file == folder.absolute() / "replay/drive.rrd"
        assert opening_s(folder, [file], Sought("2")) == {file: pytest.approx(0.5)}

    def test_at_an_object(self, results: Path) -> None:
        """Its onset is at 1 s, as that of all others; of an object that is nowhere there is no instant."""
        files = list_rrd_files(results)
        assert opening_s(results, files, Sought("2")) == {path: pytest.approx(0.5) for path in files}
        assert opening_s(results, files, Sought("2", "elsewhere")) == {}
        assert opening_s(results, files, Sought("none")) == {}

    def test_what_is_no_recording_opens_at_its_beginning(self, results: Path, tmp_path: Path) -> None:
        (tmp_path / "replay.rrd").write_bytes((results / "replay.rrd").read_bytes()[:-100])
        (tmp_path / "replay_1.rrd").write_bytes(b"no recording")
        assert opening_s(tmp_path, list_rrd_files(tmp_path)) == {}

    def test_each_recording_has_an_identity(self, results: Path, tmp_path: Path) -> None:
        found = read_identities(list_rrd_files(results))
        assert len({identity.recording for identity in found.values()}) == 2
        (tmp_path / "x.rrd").write_bytes(b"no recording")
        assert read_identities([tmp_path / "x.rrd"]) == {}

    def test_a_recording_that_was_cut_off_has_none(self, results: Path, tmp_path: Path) -> None:
        (tmp_path / "cut.rrd").write_bytes((results / "replay.rrd").read_bytes()[:-100])
        with warnings.catch_warnings(action="error"):
            assert read_identities([tmp_path / "cut.rrd"]) == {}


class TestRequest:
    def test_bytes_as_written_by_hand(self) -> None:
        # 2.5 s are 2 500 000 000 ns = 0x9502F900: in groups of seven bits, the lowest first, 00 72 0B 28 09.
        store = b"\x0a\x10" + rb"Recording:a\:b:r"
        time = b"\x12\x09\x0a\x07elapsed" + b"\x1a\x06\x08\x80\xf2\x8b\xa8\x09"
        inner = store + time + b"\x28\x01"
        assert len(inner) == 39
        assert set_time(RecordingIdentity("a:b", "r"), 2.5) == b"\x32\x27" + inner

    def test_long_names_have_their_length_in_two_bytes(self) -> None:
        inner = set_time(RecordingIdentity("a", "r" * 200), 0.0)
        assert inner[3:7] == b"\x0a" + bytes([212 & 127 | 128, 212 >> 7]) + b"R"


class TestServer:
    @pytest.fixture
    def server(self, tmp_path: Path) -> Iterator[Server]:
        (tmp_path / "a b.rrd").write_bytes(b"\x00recording" * 100_000)
        (tmp_path / "secret").write_text("secret")
        assets = dict.fromkeys(TYPES, b"viewer") | {PAGE: opening_page(b"<html><head></head></html>", ["a b.rrd"], [])}
        with Server(ViewerSite(assets, {"a b.rrd": tmp_path / "a b.rrd", "gone.rrd": tmp_path / "gone.rrd"})) as server:
            thread = threading.Thread(target=server.serve_forever)
            thread.start()
            yield server
            server.shutdown()
            thread.join()

    def test_on_this_machine_alone(self, server: Server) -> None:
        host, port = server.socket.getsockname()
        assert host == "127.0.0.1"
        assert server.url == f"http://127.0.0.1:{port}/"

    def test_page_viewer_and_recording(self, server: Server) -> None:
        page, headers = got(server.url)
        assert b'"a%20b.rrd"' in page
        assert headers["Content-Type"] == "text/html; charset=utf-8"
        assert headers["Content-Security-Policy"] == POLICY
        assert "frame-ancestors 'none'" in POLICY
        assert got(f"{server.url}re_viewer_bg.wasm")[1]["Content-Type"] == "application/wasm"
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert got(f"{server.url}a%20b.rrd")[0] == b"\x00recording" * 100_000

    @pytest.mark.parametrize("name", ["secret", "../secret", "%2e%2e/secret", "gone.rrd", "re_viewer_bg"])
    def test_nothing_else(self, server: Server, name: str) -> None:
        with pytest.raises(urllib.error.HTTPError) as refused:
            got(server.url + name)
        assert refused.value.code == 404
        assert refused.value.headers["X-Content-Type-Options"] == "nosniff"
        refused.value.close()

    @pytest.mark.parametrize("name", ["", "a%20b.rrd", "re_viewer.js"])
    @pytest.mark.parametrize(
        "hosts",
        [["evil.example"], ["evil.example:{port}"], ["127.0.0.1.evil.example"], ["localhost@evil.example"], [""], [],
         ["0.0.0.0:{port}"], ["localhost:{port}", "evil.example"], ["localhost."]],
    )  # fmt: skip
    def test_under_another_name_nothing(self, server: Server, hosts: list[str], name: str) -> None:
        """A page elsewhere whose name leads to 127.0.0.1 (DNS rebinding) reads no recording."""
        status, body = asked(server, hosts, f"/{name}")
        assert status == 421
        assert b"recording" not in body
        assert b"viewer" not in body

    @pytest.mark.parametrize("host", ["127.0.0.1:{port}", "localhost:{port}", "LOCALHOST:9000", "localhost"])
    def test_under_its_own_names_and_forwarded_to_any_port(self, server: Server, host: str) -> None:
        status, body = asked(server, [host], "/a%20b.rrd")
        assert status == 200
        assert body == b"\x00recording" * 100_000

    def test_the_policy_names_no_other_place(self) -> None:
        assert "http" not in POLICY
        assert "*" not in POLICY

    def test_links_to_elsewhere_are_left_out(self) -> None:
        page = b'<head><link rel="icon" href="favicon.ico" />\n<link\n href="https://fonts.example/css"\n rel="x"/>'
        opened = opening_page(page, [], [b"\x01\x02"])
        assert b"fonts" not in opened
        assert b'href="favicon.ico"' in opened
        assert b"[[1, 2]]" in opened


def test_the_command_serves_until_interrupted(results: Path) -> None:
    words = [COMMAND, "view", results, "--web"]
    # A shell that starts it in the background has it ignore interrupts; a terminal does not.
    process = subprocess.Popen(
        words,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        url = line.removeprefix("viewer at ").removesuffix(" (Ctrl-C ends it)\n")
        assert url.startswith("http://127.0.0.1:"), line
        page, _ = got(url)
        assert b'"replay_worst.rrd", "replay.rrd"' in page, "the viewer shows what it opened last"
        assert b"https://fonts" not in page
        assert got(f"{url}re_viewer_bg.wasm")[0].startswith(b"\x00asm")
        for name in ("replay.rrd", "replay_worst.rrd"):
            assert got(url + name)[0] == (results / name).read_bytes()
        told = psutil.Process(process.pid)
        assert told.children() == [], "the program that had the viewer's files has ended"
        listening = [one.laddr for one in told.net_connections("inet") if one.status == psutil.CONN_LISTEN]
        assert [(place.ip, f"http://127.0.0.1:{place.port}/") for place in listening] == [("127.0.0.1", url)]
        process.send_signal(signal.SIGINT)
        assert process.communicate(timeout=60) == ("", "")
        assert process.returncode == 0
    finally:
        process.kill()
        process.communicate()

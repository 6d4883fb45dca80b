"""Open the recordings of a results folder in a viewer, here or in a browser, when something differs.

A layout in a recording cannot hold the instant at which it opens (Rerun 0.41), and addresses with an instant (`#when=`)
are for servers only. So it is set from outside: by `seek_recordings` in the viewer on this machine, by a script in the
page for a browser.
"""

from __future__ import annotations

import json
import re
import shutil
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import quote, unquote, urlsplit

from copem_replay.core.errors import OutputError
from copem_replay.core.files import is_temporary, portable_name
from copem_replay.metrics.detections_table import first_episodes
from copem_replay.results.read import Results, open_results
from copem_replay.results.shown_objects import BEFORE_S
from copem_replay.viewer.sink import ELAPSED, OPENS

HOST = "127.0.0.1"
READY_S, AGAIN_S = 60.0, 0.2
"""Time for a viewer to load a recording, and the interval of asking it: after that it opens at its beginning."""
_PATTERNS = ("replay.rrd", "replay.*.rrd", "replay/**/*.rrd", "replay_*.rrd", "replay_*/**/*.rrd")
_OWN_HOSTS = re.compile(r"(127\.0\.0\.1|localhost)(:\d{1,5})?", re.IGNORECASE)
"""What browsers call this server, of any port, as it may be forwarded. Other names that lead here are of others."""
_FURTHER_FILE = re.compile(r"\.configurations_\d+(-\d+)?$")


def list_rrd_files(folder: Path) -> list[Path]:
    """Absolute paths of the recordings in a results folder, each once, the first shown run first."""
    place = folder.absolute()  # so that no path looks like an option
    # A recording comes before its further configurations: `replay.rrd`, then `replay.configurations_8-14.rrd`.
    found = (
        path for pattern in _PATTERNS for path in sorted(place.glob(pattern), key=lambda path: path.with_suffix(""))
    )
    return list(dict.fromkeys(path for path in found if path.is_file() and not is_temporary(path.name)))


@dataclass(frozen=True)
class Sought:
    """An object that recordings open at, and its log; None: any log."""

    object_id: str
    log: str | None = None


def opening_s(
    folder: Path, files: Sequence[Path], sought: Sought | None = None, results: Path | None = None
) -> dict[Path, float]:
    """The instant at which each recording opens, in seconds since its log starts, as it says itself.

    With an object `sought` just before its onset, where the results say that the recording has it. A recording without
    an instant is left out: it opens at its beginning. `results`: where results are if not in the folder of the files.
    """
    return _read_opening_s(files) if sought is None else _find_onsets_s(folder, files, sought, results or folder)


def _read_opening_s(files: Sequence[Path]) -> dict[Path, float]:
    """By recording the instant (s) at which it should open; one that says none, or is unreadable, is left out."""
    from rerun.chunk import RrdReader

    instants_s = {}
    for path in files:
        try:
            with warnings.catch_warnings(action="ignore"):  # a file was cut off
                for chunk in RrdReader(str(path)).store().stream().filter(content="/__properties/replay"):
                    batch = chunk.to_record_batch()
                    if OPENS in batch.schema.names:
                        instants_s[path] = float(batch.column(OPENS).to_pylist()[0][0])
        except (OSError, RuntimeError, ValueError):
            continue
    return instants_s


def _find_onsets_s(folder: Path, files: Sequence[Path], sought: Sought, place: Path) -> dict[Path, float]:
    """By recording with the sought object, the instant (s) just before its onset; empty: results of an old version."""
    instants_s = {}
    try:
        results = open_results(place)
        runs = _map_runs(results)
        for path in files:
            stem = _FURTHER_FILE.sub("", path.relative_to(folder.absolute()).with_suffix("").as_posix())
            if stem not in runs or sought.log not in (None, runs[stem][0]):
                continue
            log, run = runs[stem]
            (rows,) = results.each(log=log, every=True)
            run_rows = first_episodes(rows[rows["run"] == run])
            onset_s = run_rows.loc[run_rows["object_id"] == sought.object_id, "onset_s"]
            if len(onset_s):
                instants_s[path] = max(0.0, float(onset_s.min()) - BEFORE_S)
    except (KeyError, TypeError, AttributeError, ValueError, OverflowError):
        return {}  # of an older version
    return instants_s


def _map_runs(results: Results) -> dict[str, tuple[str, int]]:
    """Log and run of each recording, by its path in the folder without suffix."""
    shown = results.provenance.data["runs_shown"]
    several = len(results.provenance.logs) > 1
    return {
        (f"{shown_run['file']}/{portable_name(log)}" if several else shown_run["file"]): (log, int(shown_run["run"]))
        for log, runs in shown.items()
        for shown_run in runs
    }


@dataclass(frozen=True)
class RecordingIdentity:
    """Application id and recording id, by which a viewer distinguishes recordings."""

    application: str
    recording: str


def read_identities(files: Sequence[Path]) -> dict[Path, RecordingIdentity]:
    """The identity of each recording; other files are left out."""
    from rerun.chunk import RrdReader

    identities = {}
    for path in files:
        try:
            with warnings.catch_warnings(action="ignore"):  # a file was cut off: it has no identity
                (entry,) = RrdReader(str(path)).recordings()
        except (OSError, RuntimeError, ValueError):
            continue
        identities[path] = RecordingIdentity(entry.application_id, entry.recording_id)
    return identities


def open_viewer(files: Sequence[Path], instants_s: Mapping[Path, float]) -> int:
    """Open recordings in the viewer on this machine, at their instants, and wait for its end. Returns its exit code."""
    identities = read_identities(list(instants_s))
    port = find_free_port()
    # `-m rerun` is there in every environment with rerun-sdk, whatever the PATH. The viewer shows what it opened last.
    command = [sys.executable, "-m", "rerun", "--bind", HOST, "--port", str(port), *map(str, reversed(files))]
    with subprocess.Popen(command) as process:
        try:
            instants_by_id = {identity.recording: instants_s[path] for path, identity in identities.items()}
            seek_recordings(f"rerun+http://{HOST}:{port}/proxy", instants_by_id, lambda: process.poll() is None)
            return process.wait()
        except BaseException:  # an interrupt, which the terminal sends to the viewer, too
            process.terminate()
            raise


def seek_recordings(url: str, instants_s: Mapping[str, float], alive: Callable[[], bool]) -> None:
    """Set the instant of each recording, by its id, once the viewer at `url` has loaded it.

    It gives up when the viewer ends (`alive`) or `READY_S` have passed: recordings left then open at their beginning.
    """
    waiting, until = dict(instants_s), time.monotonic() + READY_S
    while waiting and alive() and time.monotonic() < until:
        for name in _set_instants(url, waiting):
            del waiting[name]
        if waiting:
            time.sleep(AGAIN_S)


def _set_instants(url: str, instants_s: Mapping[str, float]) -> set[str]:
    """Set the time of those recordings that the viewer has loaded (`instants_s`: by id). Returns their ids."""
    from rerun.experimental import ViewerClient

    names: set[str] = set()
    try:
        client = ViewerClient.connect(url)
        state = client.get_state()
        for recording in [] if state.loading else state.recordings:
            name = recording.store_id.rpartition(":")[2]  # the part before differs between viewers
            if name in instants_s and recording.timelines:
                client.set_time(ELAPSED, duration=instants_s[name], play_state="paused", recording=recording.store_id)
                names.add(name)
    except (OSError, RuntimeError, ValueError):  # no answer yet, or no such recording yet
        pass
    return names


def find_free_port() -> int:
    """A port of this machine on which nothing listens."""
    with socket.socket() as any_port:
        any_port.bind((HOST, 0))
        return int(any_port.getsockname()[1])


# Web viewer and recordings, served by this process on one port of 127.0.0.1, without requests to the internet.
#
# The files of the web viewer come from rerun-sdk, whose own server is started to fetch them: there is no other way to
# get them. Serving them here puts viewer and recordings on one port, which can be forwarded as one. It also allows a
# policy that keeps the browser from contacting other hosts, as the viewer does by default: for fonts, for its newest
# version, for usage statistics.

PAGE = "index.html"
TYPES = {
    PAGE: "text/html; charset=utf-8",
    "re_viewer.js": "text/javascript",
    "re_viewer_bg.wasm": "application/wasm",
    "favicon.ico": "image/x-icon",
}
"""The files of the web viewer, with their media types."""
POLICY = (
    "default-src 'none'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'; style-src 'unsafe-inline'; "
    "connect-src 'self'; img-src 'self' data: blob:; worker-src 'self' blob:; frame-ancestors 'none'"
)
"""Content-Security-Policy: the page loads from this server only, and is in no other page."""
_ELSEWHERE = re.compile(rb'<link\s[^>]*href="https?://[^>]*>')
# A script that opens the recordings from the page's own address, and moves each to its instant once it is loaded. What
# shows until then is ours, but for words of the viewer on why it does not load.
_OPEN = """<script>
const recordings = %s, requests = %s, tries = %d;
const cover = document.createElement("div");
cover.id = "cover";
cover.setAttribute("role", "status");
cover.style.cssText = "position: fixed; inset: 0; z-index: 9; display: grid; place-content: center; " +
  "background: #0d1011; color: #e8e8e8; font: 16px system-ui, sans-serif; white-space: pre-line; text-align: center";
document.documentElement.append(cover);
const say = (words) => (cover.textContent = `copem-replay view\\n${words}`);
say("loading the viewer …");
const page = new URLSearchParams(location.search);
if (!page.has("url")) {
  for (const name of recordings) page.append("url", new URL(name, location.origin).href);
  if (!page.has("theme")) page.set("theme", "dark");
  page.set("persist", "false");
  page.set("hide_welcome_screen", "");
  history.replaceState(null, "", "?" + page);
}
// Whether a `GetStateResponse` has recordings (field 3) and loads nothing more (field 7): before that, eyes go astray.
function loading(state) {
  const found = new Set();
  for (let at = 0; at < state.length; ) {
    found.add(state[at++] >> 3);
    let size = 0;
    for (let shift = 0, more = true; more; shift += 7) {
      size |= (state[at] & 127) << shift;
      more = state[at++] > 127;
    }
    at += size;
  }
  return found.has(7) || !found.has(3);
}
addEventListener("load", async () => {
  const wait = () => new Promise((done) => setTimeout(done, 200));
  for (let left = tries; !window._handle || loading(window._handle.viewer_state()); left--) {
    const told = document.getElementById("center_text"), percent = document.getElementById("status");
    const names = recordings.map(decodeURIComponent).join(", ");
    say(window._handle ? `loading ${names} …` : `loading the viewer … ${percent?.textContent || ""}`);
    if (left < 0 || (told.classList.contains("visible") && !percent)) cover.remove();
    await wait();
  }
  for (const request of requests) {
    for (let left = tries; left > 0; left--) {
      try {
        await window._handle.viewer_control(new Uint8Array(request));
        break;
      } catch (error) {
        await wait();
      }
    }
  }
  for (let left = tries, size = 0, before = -1; left > 0 && size !== before; left--) {
    await wait();
    [before, size] = [size, window._handle.viewer_state().length];
  }
  cover.remove();
  document.documentElement.dataset.opened = "";
});
</script>"""


@dataclass(frozen=True)
class ViewerSite:
    """The served content: files of the viewer, and paths of recordings, by their names in addresses."""

    assets: Mapping[str, bytes]
    recordings: Mapping[str, Path]


def serve_recordings(folder: Path, files: Sequence[Path], instants_s: Mapping[Path, float] | None = None) -> Server:
    """A server, on a free port of 127.0.0.1, of the web viewer with the recordings of a results folder open in it.

    `instants_s`: at which each opens; None: as `opening_s` has them.

    The caller closes it. Raises OutputError if the files of the viewer cannot be had.
    """
    by_name = {path.relative_to(folder.absolute()).as_posix(): path for path in files}
    instants_s = opening_s(folder, files) if instants_s is None else instants_s
    identities = read_identities(files)
    requests = [set_time(identities[path], at_s) for path, at_s in instants_s.items() if path in identities]
    assets = viewer_files()
    last_shown = list(reversed(by_name))  # the viewer shows what it opened last
    assets[PAGE] = opening_page(assets[PAGE], last_shown, requests)
    return Server(ViewerSite(assets, by_name))


def opening_page(page: bytes, names: Sequence[str], requests: Sequence[bytes]) -> bytes:
    """The viewer's page with a script that opens recordings by name at their instants, and without outside links."""
    values = json.dumps([quote(name) for name in names]), json.dumps([list(request) for request in requests])
    script = _OPEN % (*values, round(READY_S / AGAIN_S))
    return _ELSEWHERE.sub(b"", page).replace(b"<head>", b"<head>" + script.encode(), 1)


def set_time(identity: RecordingIdentity, at_s: float) -> bytes:
    """A request to the viewer's control interface: move the time cursor of a recording, paused.

    It is a `ViewerControlRequest` with `set_time_cursor`, of rerun/v1alpha1/viewer_control.proto in Rerun 0.41.
    """
    application = identity.application.replace("\\", "\\\\").replace(":", "\\:")
    store = f"Recording:{application}:{identity.recording}"
    paused = b"\x28\x01"
    time_ns = b"\x08" + _encode_varint(round(at_s * 1e9))
    inner = (
        _encode_field(1, store.encode())
        + _encode_field(2, _encode_field(1, ELAPSED.encode()))
        + _encode_field(3, time_ns)
        + paused
    )
    return _encode_field(6, inner)


def _encode_field(number: int, content: bytes) -> bytes:
    """A field of a protobuf message whose type is text or a message."""
    return bytes([number << 3 | 2]) + _encode_varint(len(content)) + content


def _encode_varint(value: int) -> bytes:
    more = value >> 7
    return bytes([value & 0x7F | (0x80 if more else 0)]) + (_encode_varint(more) if more else b"")


def viewer_files() -> dict[str, bytes]:
    """The files of the web viewer, by name, from rerun-sdk. Raises OutputError."""
    with _rerun_serving() as url:
        return {name: _fetch(f"{url}/{name}") for name in TYPES}


@contextmanager
def _rerun_serving() -> Iterator[str]:
    """The address of Rerun's own web viewer, which runs as long as the context. Raises OutputError: it cannot start."""
    spec = find_spec("rerun_cli")
    program = shutil.which("rerun", path=str(Path(spec.origin).parent)) if spec and spec.origin else None
    if program is None:
        raise OutputError("--web: no web viewer, rerun-sdk has no program here; pip install rerun-sdk")
    port = find_free_port()
    url = f"http://{HOST}:{port}"
    command = [program, "--serve-web", "--bind", HOST, "--web-viewer-port", str(port), f"{url}/nothing.rrd"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        until = time.monotonic() + READY_S
        while not _is_answering(url):
            if process.poll() is not None or time.monotonic() > until:
                raise OutputError(f"--web: the web viewer of rerun-sdk did not start: {' '.join(command)}")
            time.sleep(AGAIN_S / 4)
        yield url
    finally:
        process.kill()
        process.wait()


def _is_answering(url: str) -> bool:
    try:
        return bool(_fetch(f"{url}/favicon.ico"))
    except OSError:
        return False


def _fetch(url: str) -> bytes:
    open_here = urllib.request.build_opener(urllib.request.ProxyHandler({}))  # 127.0.0.1, so never by a proxy
    with open_here.open(url, timeout=READY_S) as answer:
        content: bytes = answer.read()
    return content


class Server(ThreadingHTTPServer):
    """Serves a site on a free port of 127.0.0.1, at `url`."""

    daemon_threads = True  # a browser that is still loading does not delay the end

    def __init__(self, site: ViewerSite) -> None:
        super().__init__((HOST, 0), _Handler)
        self.site = site
        self.url = f"http://{HOST}:{self.server_address[1]}/"

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore errors: a browser may close its connection while it loads."""


class _Handler(BaseHTTPRequestHandler):
    server: Server

    def do_GET(self) -> None:
        self._answer(body=True)

    def do_HEAD(self) -> None:
        self._answer(body=False)

    def log_message(self, *_: object) -> None:
        """Print no requests: the terminal shows only the address."""

    def _answer(self, *, body: bool) -> None:
        """Answer a request for an asset or a recording, with its `body` or headers alone; 421: foreign host."""
        hosts = self.headers.get_all("Host", [])
        if len(hosts) != 1 or not _OWN_HOSTS.fullmatch(hosts[0].strip()):
            self.send_error(421)
            return
        name = unquote(urlsplit(self.path).path).strip("/") or PAGE
        site = self.server.site
        if name in site.assets:
            self._begin(TYPES[name], len(site.assets[name]))
            if body:
                self.wfile.write(site.assets[name])
        elif name in site.recordings and site.recordings[name].is_file():
            with site.recordings[name].open("rb") as file:
                self._begin("application/octet-stream", site.recordings[name].stat().st_size)
                if body:
                    shutil.copyfileobj(file, self.wfile)
        else:
            self.send_error(404)

    def _begin(self, kind: str, size: int) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(size))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()

    def end_headers(self) -> None:
        """End the headers of any answer, also of errors."""
        self.send_header("Content-Security-Policy", POLICY)
        self.send_header("X-Content-Type-Options", "nosniff")
        super().end_headers()

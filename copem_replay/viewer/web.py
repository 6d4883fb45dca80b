"""The web viewer and recordings, served by this program on 127.0.0.1: one port, and nothing asked of the internet.

The viewer's files come from rerun-sdk, which only gives them out by serving them: it is started for as long as that
takes. Serving them here puts viewer and recordings on one port, so that one forwarded port shows them elsewhere. And it
allows a policy that keeps the browser from asking other hosts for anything, as the viewer would by itself: fonts, its
newest version, what it is used for.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import quote, unquote, urlsplit

from copem_replay.core.errors import OutputError
from copem_replay.viewer.opening import AGAIN_S, HOST, READY_S, Identity, free_port, identities, opening_s
from copem_replay.viewer.sink import ELAPSED

PAGE = "index.html"
TYPES = {
    PAGE: "text/html; charset=utf-8",
    "re_viewer.js": "text/javascript",
    "re_viewer_bg.wasm": "application/wasm",
    "favicon.ico": "image/x-icon",
}
"""The files of the web viewer, and what they are."""
POLICY = (
    "default-src 'none'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'; style-src 'unsafe-inline'; "
    "connect-src 'self'; img-src 'self' data: blob:; worker-src 'self' blob:"
)
"""What the page may load: what this server has, and nothing else."""
_ELSEWHERE = re.compile(rb'<link\s[^>]*href="https?://[^>]*>')
# Opens the recordings from wherever the page came from, then moves each to its instant once the viewer has it.
_OPEN = """<script>
const recordings = %s, requests = %s;
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
  while (!window._handle || loading(window._handle.viewer_state())) await wait();
  for (const request of requests) {
    for (let left = %d; left > 0; left--) {
      try {
        await window._handle.viewer_control(new Uint8Array(request));
        break;
      } catch (error) {
        await wait();
      }
    }
  }
  document.documentElement.dataset.opened = "";
});
</script>"""


@dataclass(frozen=True)
class Site:
    """What is served: files of the viewer by their names, and recordings by theirs."""

    assets: Mapping[str, bytes]
    recordings: Mapping[str, Path]


def serve(folder: Path, files: Sequence[Path]) -> Server:
    """A server on 127.0.0.1, on a free port, of the web viewer with the recordings of a results folder open in it.

    Close it when it is no longer needed. Raises OutputError where the viewer cannot be served.
    """
    named = {path.relative_to(folder.absolute()).as_posix(): path for path in files}
    instants, known = opening_s(folder, files), identities(files)
    requests = [set_time(known[path], at_s) for path, at_s in instants.items() if path in known]
    assets = viewer_files()
    last_shown = list(reversed(named))  # the viewer shows what it opened last
    assets[PAGE] = opening_page(assets[PAGE], last_shown, requests)
    return Server(Site(assets, named))


def opening_page(page: bytes, names: Sequence[str], requests: Sequence[bytes]) -> bytes:
    """The viewer's page, so that it opens recordings by name at their instants, and links to nothing elsewhere."""
    values = json.dumps([quote(name) for name in names]), json.dumps([list(request) for request in requests])
    script = _OPEN % (*values, round(READY_S / AGAIN_S))
    return _ELSEWHERE.sub(b"", page).replace(b"<head>", b"<head>" + script.encode(), 1)


def set_time(identity: Identity, at_s: float) -> bytes:
    """What the viewer's control interface takes: move the cursor of a recording, paused.

    A `ViewerControlRequest` with `set_time_cursor`, of rerun/v1alpha1/viewer_control.proto in Rerun 0.41.
    """
    application = identity.application.replace("\\", "\\\\").replace(":", "\\:")
    store = f"Recording:{application}:{identity.recording}"
    paused = b"\x28\x01"
    time_ns = b"\x08" + _varint(round(at_s * 1e9))
    inner = _field(1, store.encode()) + _field(2, _field(1, ELAPSED.encode())) + _field(3, time_ns) + paused
    return _field(6, inner)


def _field(number: int, content: bytes) -> bytes:
    """A field of a protobuf message that is text or a message itself."""
    return bytes([number << 3 | 2]) + _varint(len(content)) + content


def _varint(value: int) -> bytes:
    more = value >> 7
    return bytes([value & 0x7F | (0x80 if more else 0)]) + (_varint(more) if more else b"")


def viewer_files() -> dict[str, bytes]:
    """The files of the web viewer, by name, from rerun-sdk. Raises OutputError."""
    with _rerun_serving() as url:
        return {name: _got(f"{url}/{name}") for name in TYPES}


@contextmanager
def _rerun_serving() -> Iterator[str]:
    """The address of Rerun's own server. It opens no second port when it has something to show."""
    spec = find_spec("rerun_cli")
    where = shutil.which("rerun", path=str(Path(spec.origin).parent)) if spec and spec.origin else None
    if where is None:
        raise OutputError("--web: no web viewer, rerun-sdk has no program here; pip install rerun-sdk")
    port = free_port()
    url = f"http://{HOST}:{port}"
    words = [where, "--serve-web", "--bind", HOST, "--web-viewer-port", str(port), f"{url}/nothing.rrd"]
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        until = time.monotonic() + READY_S
        while not _answers(url):
            if process.poll() is not None or time.monotonic() > until:
                raise OutputError(f"--web: the web viewer of rerun-sdk did not start: {' '.join(words)}")
            time.sleep(AGAIN_S / 4)
        yield url
    finally:
        process.kill()
        process.wait()


def _answers(url: str) -> bool:
    try:
        return bool(_got(f"{url}/favicon.ico"))
    except OSError:
        return False


def _got(url: str) -> bytes:
    open_here = urllib.request.build_opener(urllib.request.ProxyHandler({}))  # of this machine, whatever the proxy
    with open_here.open(url, timeout=READY_S) as answer:
        content: bytes = answer.read()
    return content


class Server(ThreadingHTTPServer):
    """Serves a site on a free port of 127.0.0.1; `url` is where."""

    daemon_threads = True  # a browser that is still loading does not hold up the end

    def __init__(self, site: Site) -> None:
        super().__init__((HOST, 0), _Handler)
        self.site = site
        self.url = f"http://{HOST}:{self.server_address[1]}/"

    def handle_error(self, request: object, client_address: object) -> None:
        """A browser that goes while it loads is no error of ours."""


class _Handler(BaseHTTPRequestHandler):
    server: Server

    def do_GET(self) -> None:
        self._answer(body=True)

    def do_HEAD(self) -> None:
        self._answer(body=False)

    def log_message(self, *_: object) -> None:
        """Nothing: the terminal is for the address."""

    def _answer(self, *, body: bool) -> None:
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
        self.send_header("Content-Security-Policy", POLICY)
        self.send_header("Cache-Control", "no-store")
        self.end_headers()

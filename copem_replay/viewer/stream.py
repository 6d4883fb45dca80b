"""Where a recording goes: into a file, little of it held in memory, and to a viewer that runs."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from copem_replay.core.errors import InputError, OutputError
from copem_replay.core.files import atomic_file

if TYPE_CHECKING:  # a second to import: only where something is written
    import rerun as rr

VIEWER = "rerun+http://127.0.0.1:9876/proxy"
"""Where a Rerun viewer listens by default."""
ANSWERS_S, TAKES_S = 2.0, 60.0
"""How long a viewer may take to answer, and to take a piece of the recording (chosen)."""
_PIECE = 1 << 20


@contextmanager
def file_stream(path: Path, application_id: str, recording_id: str) -> Iterator[rr.RecordingStream]:
    """A stream into a file that is complete under its name in the end, or not there. Raises OutputError.

    Rerun writes into a pipe, and what comes out of it is written here. By itself it would wait for ever on a full disk,
    or leave half a file and say nothing; and what it keeps in memory it can only give as several files.
    """
    import rerun as rr

    with atomic_file(path) as scratch:
        out, into = os.pipe()
        pump = _Pump(out, scratch)
        rec = rr.RecordingStream(application_id, recording_id=recording_id, send_properties=False)
        try:
            if not rr.is_enabled(rec):
                raise OutputError(f"{path}: not written, Rerun is switched off (RERUN=off in the environment?)")
            rec.save(f"/dev/fd/{into}")
            yield rec
        finally:
            rec.disconnect()  # with it the file has its end
            os.close(into)
            pump.join()
        if pump.error is not None:
            raise pump.error


class _Pump(Thread):
    """Writes what comes out of a pipe; when that fails, reads on, so that the writer does not wait."""

    def __init__(self, out: int, path: Path) -> None:
        super().__init__()
        self.error: OSError | None = None
        self._out, self._path = out, path
        self.start()

    def run(self) -> None:
        try:
            with self._path.open("wb") as file:
                while piece := os.read(self._out, _PIECE):
                    file.write(piece)
        except OSError as error:
            self.error = error
        while os.read(self._out, _PIECE):
            pass
        os.close(self._out)


class Live:
    """A stream to a viewer that runs. It may go at any time: then it gets no more."""

    def __init__(self, url: str, application_id: str, recording_id: str) -> None:
        import rerun as rr

        self.url, self.gone = url, False
        self._rec = rr.RecordingStream(application_id, recording_id=recording_id, send_properties=False)
        self._rec.connect_grpc(url)

    def send(self, what: Callable[[rr.RecordingStream], None]) -> None:
        """Send something, and wait until the viewer has it."""
        if self.gone:
            return
        try:
            what(self._rec)
            self._rec.flush(timeout_sec=TAKES_S)
        except RuntimeError:  # Rerun's word for a connection that broke
            self.gone = True

    def close(self) -> None:
        """Nothing more will come."""
        with suppress(RuntimeError):
            self._rec.disconnect()


def check_viewer(url: str) -> None:
    """Whether something listens where a viewer should. Raises InputError."""
    try:
        place = urlsplit(url)
        host, port = place.hostname, place.port
    except ValueError:
        host = port = None
    if not url.startswith(("rerun+http://", "rerun://", "rerun+https://")) or not host or place.path != "/proxy":
        raise InputError(f"--viewer: expected an address such as {VIEWER}, found {url!r}")
    try:
        socket.create_connection((host, port or 443), timeout=ANSWERS_S).close()
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"--live: no viewer at {url} ({reason}); start one first: python -m rerun") from None

"""A file of rosbag2's SQLite storage, `.db3`, as a recording: read through rosbags, with or without its folder."""

from __future__ import annotations

from collections.abc import Iterator, Set
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final
from urllib.parse import quote

from mcap.records import Message

from copem_replay.core.errors import RecordingError
from copem_replay.io.channel import Channel
from copem_replay.io.log import Log
from copem_replay.io.window import is_kept

if TYPE_CHECKING:
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

DB3: Final = ".db3"
_FORMATS: Final = {"NONE": "ros2msg", "MSG": "ros2msg", "IDL": "ros2idl"}
_LAST_NS: Final = 2**63 - 2
"""The largest time that SQLite holds, less what its reader adds."""


@dataclass(frozen=True)
class SqliteLog(Log):
    """The log of a file of SQLite."""

    def messages(self, numbers: Set[int], *, sort: bool = False) -> Iterator[Message]:
        """Messages of these channels in order of log time. Raises RecordingError: the file is damaged."""
        spans = self.spans(numbers)
        if not spans:
            return
        first_ns = min(max(min(first for first, _ in spans.values()), 0), _LAST_NS)
        last_ns = min(max(last for _, last in spans.values()), _LAST_NS)
        with _open_reader(self.path) as reader:
            chosen = [connection for connection in reader.connections if connection.id in spans]
            for connection, time_ns, data in reader.messages(chosen, first_ns, last_ns + 1):
                if is_kept(spans, connection.id, time_ns):
                    yield Message(connection.id, time_ns, data, time_ns, 0)


def open_sqlite(path: Path) -> SqliteLog:
    """The log of a file of SQLite. Raises RecordingError: none of rosbag2, or damaged."""
    with _open_reader(path) as reader:
        span, connections = reader.metadata, reader.connections
        channels = [
            Channel(
                number=c.id, topic=c.topic, schema=c.msgtype, encoding=getattr(c.ext, "serialization_format", ""),
                messages=c.msgcount, schema_encoding=_FORMATS[c.msgdef.format.name],
                schema_data=c.msgdef.data.encode(),
            )
            for c in connections
        ]  # fmt: skip
    ahead = Path(f"{path}-wal")
    lost = ahead.is_file() and ahead.stat().st_size > 0
    note = f"{ahead.name} beside it is not read: its recorder did not end; `ros2 bag reindex` takes it in"
    notes, end_ns = (note,) * lost, span.end_time - 1
    return SqliteLog(path, tuple(channels), indexed=False, start_ns=span.start_time, end_ns=end_ns, notes=notes)


@contextmanager
def _open_reader(path: Path) -> Iterator[Sqlite3Reader]:
    """Rosbags' reader of a file, closed at the end. Raises RecordingError: damaged, or no file of rosbag2."""
    import apsw
    from rosbags.rosbag2 import ReaderError
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

    reader = Sqlite3Reader(Path(quote(str(path))))  # which makes a URL of it
    try:
        reader.open()
        yield reader
    except (apsw.Error, ReaderError) as error:
        why = str(error).replace(quote(str(path)), path.name)
        raise RecordingError(f"of SQLite, but damaged or none of rosbag2 ({why})", path=path) from None
    finally:
        if reader.dbconn is not None:
            reader.close()

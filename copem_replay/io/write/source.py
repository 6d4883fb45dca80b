"""Copying a recording into replay.mcap, from any container: an MCAP file, a folder of them, an OSI trace, several.

Every channel, message, metadata record and attachment is copied as it was; a window restricts messages only. Those
that several files share are kept once. A sound file is read in order of log time through its index; a damaged one from
its start as far as it goes, and sorted.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Attachment, Header, McapRecord, Message, Metadata
from mcap.writer import Writer

from copem_replay.io.channel import AHEAD, PART, Channel
from copem_replay.io.containers.mcap_records import (
    DAMAGE,
    MAGIC,
    RecordsFromStart,
    drop_traceback,
    parse_record,
    read_record_at,
    read_summary,
    renumber_message,
)
from copem_replay.io.containers.osi_trace import TraceLog
from copem_replay.io.containers.rosbag2 import BagLog
from copem_replay.io.containers.sqlite import SqliteLog
from copem_replay.io.log import BrokenIndexError, Log, open_file
from copem_replay.io.open import JoinedLog, Local, open_log
from copem_replay.io.schemas.osi_ground_truth import load_message_class
from copem_replay.io.window import Window
from copem_replay.io.write.osi import OSI_VERSION

OSI_CHANNEL = "net.asam.osi.trace.channel."
"""Keys in the metadata of a channel of OSI begin so."""


class Catalogue:
    """Schemas, channels and attachments of a file that is being written: equal ones are written once."""

    def __init__(self, writer: Writer) -> None:
        self.writer = writer
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._channels: dict[tuple[object, ...], int] = {}
        self._attached: set[tuple[object, ...]] = set()

    def schema(self, name: str, encoding: str, data: bytes) -> int:
        """The number of a schema, which is written if it is new."""
        if (name, encoding, data) not in self._schemas:
            self._schemas[name, encoding, data] = self.writer.register_schema(name, encoding, data)
        return self._schemas[name, encoding, data]

    def channel(self, topic: str, encoding: str, schema: int, metadata: dict[str, str]) -> int:
        """The number of a channel, which is written if it is new."""
        ordered = dict(sorted(metadata.items()))
        key = (topic, encoding, schema, tuple(ordered.items()))
        if key not in self._channels:
            self._channels[key] = self.writer.register_channel(topic, encoding, schema, ordered)
        return self._channels[key]

    def attach(self, a: Attachment) -> None:
        """Write an attachment if it is new."""
        key = (a.create_time, a.log_time, a.name, a.media_type, a.data)
        if key not in self._attached:
            self._attached.add(key)
            self.writer.add_attachment(*key)


class RecordingSource:
    """A recording to be copied: its channels, with the topics of their own files, and its metadata records.

    `damage`: a note that not all of it can be copied, None: all can. Files with an index are read once for that.
    """

    def __init__(self, log: Log) -> None:
        self._log, records = log.attempt(_read_through)
        opened = self._log
        damaged = opened is not log or not opened.complete
        self.damage = "damaged: its messages are copied as far as they can be read" if damaged else None
        recordings = [part.log for part in opened.parts] if isinstance(opened, JoinedLog) else [opened]
        profiles = {_find_profile(records[next(_list_files(recording)).path]) for recording in recordings}
        self.profile = profiles.pop() if len(profiles) == 1 else ""
        self.metadata: dict[str, dict[str, str]] = {}
        for record in (record for of_file in records.values() for record in of_file):
            if isinstance(record, Metadata):  # merged with others of its name: rosbag2 writes one name several times
                self.metadata.setdefault(record.name, {}).update(record.metadata)
        self._attachments = [a for of_file in records.values() for a in of_file if isinstance(a, Attachment)]
        self._topics = {channel.number: channel.topic for channel in opened.channels}
        self.channels = dict(_list_channels(opened))

    def register(self, catalogue: Catalogue, left_out: Collection[str] = ()) -> dict[int, int]:
        """Put schemas, channels and attachments into the output, but topics `left_out`. Returns new numbers by old."""
        numbers: dict[int, int] = {}
        for number, c in self.channels.items():
            if c.topic not in left_out:
                named = c.schema or c.schema_encoding or c.schema_data
                schema = catalogue.schema(c.schema, c.schema_encoding, c.schema_data) if named else 0
                numbers[number] = catalogue.channel(self._topics[number], c.encoding, schema, dict(c.metadata))
        for attachment in self._attachments:
            catalogue.attach(attachment)
        return numbers

    def messages(self, numbers: Mapping[int, int]) -> Iterator[Message]:
        """The messages in order of log time, with the channel numbers of the output."""
        return (renumber_message(message, numbers) for message in self._log.messages(numbers.keys(), sort=True))


def open_source(path: Local, window: Window | None = None) -> RecordingSource:
    """The recording to be copied, or a window of it. Raises RecordingError: nothing can be read."""
    return RecordingSource(open_log(path).within(window))


def _read_through(log: Log) -> tuple[Log, dict[Path, list[McapRecord]]]:
    """The log, and the records of each file besides messages. Raises BrokenIndexError."""
    records = {file.path: _read_records(file) for file in _list_files(log)}
    if any(file.indexed for file in _list_files(log)):
        for _message in log.messages({c.number for c in log.channels}):
            pass
    return log, records


def _list_files(log: Log) -> Iterator[Log]:
    """The log of each file of a recording, or of several."""
    if isinstance(log, BagLog | JoinedLog):
        for part in log.parts:
            yield from _list_files(part.log)
    else:
        yield log


def _read_records(log: Log) -> list[McapRecord]:
    """The header, metadata and attachments of a file; none of other formats than MCAP. Raises BrokenIndexError."""
    if isinstance(log, TraceLog | SqliteLog):
        return []
    with open_file(log.path) as file:
        if not log.indexed:
            return [r for r in RecordsFromStart(file) if isinstance(r, Header | Metadata | Attachment)]
        try:
            if (summary := read_summary(file)) is None:
                raise ValueError("the index is gone")
            places = [
                (len(MAGIC), Opcode.HEADER),
                *((index.offset, Opcode.METADATA) for index in summary.metadata_indexes),
                *((index.offset, Opcode.ATTACHMENT) for index in summary.attachment_indexes),
            ]
            records = [parse_record(opcode, read_record_at(file, offset, opcode)) for offset, opcode in places]
        except DAMAGE as error:
            raise BrokenIndexError(log.path) from drop_traceback(error)
    return [record for record in records if record is not None]


def _find_profile(records: list[McapRecord]) -> str:
    return next((record.profile for record in records if isinstance(record, Header)), "")


def _list_channels(log: Log) -> Iterator[tuple[int, Channel]]:
    """Number in the log and channel, with the topic of its own file and the metadata of the copy."""
    if isinstance(log, JoinedLog):
        joint = {channel.number: channel for channel in log.channels}
        for part in log.parts:
            for theirs, c in _list_channels(part.log):
                labelled = joint[part.numbers[theirs]]
                labels = ({AHEAD: str(labelled.ahead_ns)} if labelled.ahead_ns else {}) | {PART: labelled.part}
                yield labelled.number, replace(c, metadata={**c.metadata, **labels})
        return
    for c in log.channels:
        yield c.number, _describe_trace(log, c) if isinstance(log, TraceLog) else c


def _describe_trace(log: TraceLog, channel: Channel) -> Channel:
    """The channel of a trace, with the definition and the metadata that OSI has for channels."""
    from mcap_protobuf.schema import build_file_descriptor_set

    metadata = {
        f"{OSI_CHANNEL}description": f"the trace {log.path.name}",
        f"{OSI_CHANNEL}osi_version": log.osi_version or OSI_VERSION,
        f"{OSI_CHANNEL}protobuf_version": version("protobuf"),
    }
    definition = build_file_descriptor_set(load_message_class(channel.schema)).SerializeToString(deterministic=True)
    return replace(channel, schema_encoding="protobuf", schema_data=definition, metadata=metadata)

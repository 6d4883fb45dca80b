"""The original recording on its way into the output: every channel, message, metadata record and attachment as it was.

A sound file comes in order of log time through its index; a damaged one is read from its start as far as it goes, and
sorted.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, Message, Metadata, Schema
from mcap.writer import Writer

from copem_replay.chunks import DAMAGE, MAGIC, parsed, record_at
from copem_replay.container import open_file, open_log
from copem_replay.indexed import in_order, summary_of
from copem_replay.salvage import FromStart


class Catalogue:
    """Schemas and channels of a file being written: what is the same twice is written once."""

    def __init__(self, writer: Writer) -> None:
        self.writer = writer
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._channels: dict[tuple[object, ...], int] = {}

    def schema(self, name: str, encoding: str, data: bytes) -> int:
        """The number of a schema."""
        if (name, encoding, data) not in self._schemas:
            self._schemas[name, encoding, data] = self.writer.register_schema(name, encoding, data)
        return self._schemas[name, encoding, data]

    def channel(self, topic: str, encoding: str, schema: int, metadata: dict[str, str]) -> int:
        """The number of a channel."""
        ordered = dict(sorted(metadata.items()))
        key = (topic, encoding, schema, tuple(ordered.items()))
        if key not in self._channels:
            self._channels[key] = self.writer.register_channel(topic, encoding, schema, ordered)
        return self._channels[key]


class Original:
    """What is in a recording besides its messages, and its messages on demand.

    `damage` says that not all of it can be copied, None where all can. Raises RecordingError where nothing can be read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.damage: str | None = None
        self.profile = ""
        self.metadata: dict[str, dict[str, str]] = {}
        self.channels: dict[int, Channel] = {}
        self._schemas: dict[int, Schema] = {}
        self._attachments: list[Attachment] = []
        self._salvaged: list[Message] | None = None
        log = open_log(path)
        if not log.indexed or not self._look_up():
            self._salvage()
            if not log.complete or log.indexed:
                self.damage = "damaged: its messages are copied as far as they can be read"

    def _look_up(self) -> bool:
        """Whether the file can be copied through its index: all of it is read once, for only that tells."""
        try:
            with open_file(self._path) as file:
                summary = summary_of(file)
                if summary is None:
                    return False
                header = parsed(Opcode.HEADER, record_at(file, len(MAGIC), Opcode.HEADER))
                metadata = [
                    parsed(Opcode.METADATA, record_at(file, index.offset, Opcode.METADATA))
                    for index in summary.metadata_indexes
                ]
                attachments = [
                    parsed(Opcode.ATTACHMENT, record_at(file, index.offset, Opcode.ATTACHMENT))
                    for index in summary.attachment_indexes
                ]
                for _message in in_order(file, summary, summary.channels.keys()):
                    pass
        except DAMAGE:
            return False
        self.profile = header.profile if isinstance(header, Header) else ""
        self.metadata = {}
        for record in metadata:  # rosbag2 writes one name several times
            if isinstance(record, Metadata):
                self.metadata.setdefault(record.name, {}).update(record.metadata)
        self._attachments = [record for record in attachments if isinstance(record, Attachment)]
        self._schemas, self.channels = dict(summary.schemas), dict(summary.channels)
        return True

    def _salvage(self) -> None:
        self._salvaged, self._attachments = [], []
        with open_file(self._path) as file:
            stream = FromStart(file)
            for record in stream:
                if isinstance(record, Header):
                    self.profile = record.profile
                elif isinstance(record, Metadata):
                    self.metadata.setdefault(record.name, dict(record.metadata))
                elif isinstance(record, Attachment):
                    self._attachments.append(record)
                elif isinstance(record, Message):
                    self._salvaged.append(record)
        self._schemas, self.channels = stream.schemas, stream.channels
        self._salvaged.sort(key=lambda m: m.log_time)

    def register(self, catalogue: Catalogue, without: Collection[str] = ()) -> dict[int, int]:
        """Schemas, channels and attachments put into the output. Returns the new number of each channel.

        Channels of the topics `without` are left out, with their messages.
        """
        numbers: dict[int, int] = {}
        for number, channel in sorted(self.channels.items()):
            if channel.topic in without:
                continue
            schema = self._schemas.get(channel.schema_id)
            schema_id = catalogue.schema(schema.name, schema.encoding, schema.data) if schema else 0
            numbers[number] = catalogue.channel(
                channel.topic, channel.message_encoding, schema_id, dict(channel.metadata)
            )
        for a in self._attachments:
            catalogue.writer.add_attachment(a.create_time, a.log_time, a.name, a.media_type, a.data)
        return numbers

    def messages(self, numbers: dict[int, int]) -> Iterator[Message]:
        """All messages in order of log time, with the channel numbers of the output."""
        if self._salvaged is not None:
            yield from (_moved(m, numbers) for m in self._salvaged if m.channel_id in numbers)
            return
        with open_file(self._path) as file:
            summary = summary_of(file)
            for message in in_order(file, summary, numbers.keys()) if summary is not None else ():
                yield _moved(message, numbers)


def _moved(message: Message, numbers: dict[int, int]) -> Message:
    return Message(numbers[message.channel_id], message.log_time, message.data, message.publish_time, message.sequence)

"""The original recording on its way into the output: every channel, message, metadata record and attachment as it was.

A sound file comes in order of log time through its index; a damaged one is read from its start as far as it goes, and
sorted.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from mcap.reader import SeekingReader
from mcap.records import Attachment, Channel, Header, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from copem_replay.container import DAMAGE, open_file, open_log

_RECORD_LIMIT_BYTES = 1 << 30


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
    """What is in a recording besides its messages, and its messages on demand."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._indexed = open_log(path).indexed
        self.profile = ""
        self.metadata: dict[str, dict[str, str]] = {}
        self.channels: dict[int, Channel] = {}
        self._schemas: dict[int, Schema] = {}
        self._attachments: list[Attachment] = []
        if self._indexed:
            self._look_up()
        else:
            self._messages = self._salvage()

    def _look_up(self) -> None:
        with open_file(self._path) as file:
            reader = SeekingReader(file, record_size_limit=_RECORD_LIMIT_BYTES)
            self.profile = reader.get_header().profile
            summary = reader.get_summary()
            assert summary is not None  # indexed
            self._schemas, self.channels = dict(summary.schemas), dict(summary.channels)
            self.metadata = {record.name: dict(record.metadata) for record in reader.iter_metadata()}
            self._attachments = list(reader.iter_attachments())

    def _salvage(self) -> list[Message]:
        messages: list[Message] = []
        with open_file(self._path) as file:
            try:
                for record in StreamReader(file, record_size_limit=_RECORD_LIMIT_BYTES).records:
                    if isinstance(record, Header):
                        self.profile = record.profile
                    elif isinstance(record, Schema):
                        self._schemas.setdefault(record.id, record)
                    elif isinstance(record, Channel):
                        self.channels.setdefault(record.id, record)
                    elif isinstance(record, Metadata):
                        self.metadata.setdefault(record.name, dict(record.metadata))
                    elif isinstance(record, Attachment):
                        self._attachments.append(record)
                    elif isinstance(record, Message):
                        messages.append(record)
            except DAMAGE:
                pass  # as far as it goes; the reader of the truth has said so
        return sorted(messages, key=lambda m: m.log_time)

    def register(self, catalogue: Catalogue) -> dict[int, int]:
        """Schemas, channels and attachments put into the output. Returns the new number of each channel."""
        numbers: dict[int, int] = {}
        for number, channel in sorted(self.channels.items()):
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
        if not self._indexed:
            for message in self._messages:
                if message.channel_id in numbers:
                    yield _moved(message, numbers)
            return
        with open_file(self._path) as file:
            reader = SeekingReader(file, record_size_limit=_RECORD_LIMIT_BYTES)
            for _schema, _channel, message in reader.iter_messages():
                yield _moved(message, numbers)


def _moved(message: Message, numbers: dict[int, int]) -> Message:
    return Message(numbers[message.channel_id], message.log_time, message.data, message.publish_time, message.sequence)

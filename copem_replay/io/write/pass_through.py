"""An MCAP file on its way into the output: every channel, message, metadata record and attachment as it was.

Of a window only what is read of it is copied, channels, records and attachments wholly.

A sound file comes in order of log time through its index; a damaged one is read from its start as far as it goes, and
sorted.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, Message, Metadata, Schema
from mcap.writer import Writer

from copem_replay.io.containers.mcap_indexed import in_order, renumbered, summary_of
from copem_replay.io.containers.mcap_records import DAMAGE, MAGIC, parsed, record_at
from copem_replay.io.containers.mcap_recovery import FromStart
from copem_replay.io.log import Log, open_file
from copem_replay.io.window import kept


class Catalogue:
    """Schemas and channels of a file being written: what is the same twice is written once."""

    def __init__(self, writer: Writer) -> None:
        self.writer = writer
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._channels: dict[tuple[object, ...], int] = {}
        self._attached: set[tuple[object, ...]] = set()

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

    def attach(self, a: Attachment) -> None:
        """An attachment."""
        key = (a.create_time, a.log_time, a.name, a.media_type, a.data)
        if key not in self._attached:
            self._attached.add(key)
            self.writer.add_attachment(*key)


class Original:
    """What is in a file besides its messages, and its messages on demand.

    `damage` says that not all of it can be copied, None where all can.
    """

    def __init__(self, log: Log) -> None:
        self._log = log
        self.damage: str | None = None
        self.profile = ""
        self.metadata: dict[str, dict[str, str]] = {}
        self.channels: dict[int, Channel] = {}
        self.attachments: list[Attachment] = []
        self.start_ns = log.start_ns
        self._schemas: dict[int, Schema] = {}
        self._by_index = log.indexed and self._look_up()
        if not self._by_index:
            self._salvage()
            if not log.complete or log.indexed:
                self.damage = "damaged: its messages are copied as far as they can be read"

    def _look_up(self) -> bool:
        """Whether the file can be copied through its index: all that is copied is read once, for only that tells."""
        try:
            with open_file(self._log.path) as file:
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
                for _message in in_order(file, summary, self._log.spans(summary.channels.keys())):
                    pass
        except DAMAGE:
            return False
        self.profile = header.profile if isinstance(header, Header) else ""
        for record in metadata:
            if isinstance(record, Metadata):
                self._keep(record)
        self.attachments = [record for record in attachments if isinstance(record, Attachment)]
        self._schemas, self.channels = dict(summary.schemas), dict(summary.channels)
        return True

    def _salvage(self) -> None:
        with open_file(self._log.path) as file:
            stream = FromStart(file)
            for record in stream:
                if isinstance(record, Header):
                    self.profile = record.profile
                elif isinstance(record, Metadata):
                    self._keep(record)
                elif isinstance(record, Attachment):
                    self.attachments.append(record)
        self._schemas, self.channels = stream.schemas, stream.channels

    def _keep(self, record: Metadata) -> None:
        """Keep a metadata record, with what others of its name say: rosbag2 writes one name several times."""
        self.metadata.setdefault(record.name, {}).update(record.metadata)

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
        for attachment in self.attachments:
            catalogue.attach(attachment)
        return numbers

    def messages(self, numbers: Mapping[int, int]) -> Iterator[Message]:
        """The messages in order of log time, with the channel numbers of the output."""
        spans = self._log.spans(numbers.keys())
        with open_file(self._log.path) as file:
            if self._by_index and (summary := summary_of(file)) is not None:
                found = in_order(file, summary, spans)
            else:
                there = (r for r in FromStart(file) if isinstance(r, Message) and kept(spans, r.channel_id, r.log_time))
                found = iter(sorted(there, key=lambda message: message.log_time))
            for message in found:
                yield renumbered(message, numbers)

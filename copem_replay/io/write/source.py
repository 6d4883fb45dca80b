"""Copying a recording into replay.mcap, from any container: an MCAP file, a folder of them, an OSI trace.

The files of a folder are merged: schemas, channels, records and attachments that several of them share are kept once.
A trace becomes one channel. Of several recordings of a drive, topics are labelled and log times are by the first clock.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import partial
from importlib.metadata import version
from typing import Protocol, cast

from mcap.records import Channel, Message

from copem_replay.io.channel import AHEAD, PART
from copem_replay.io.containers.mcap_records import renumber_message
from copem_replay.io.containers.osi_trace import TraceLog
from copem_replay.io.containers.rosbag2 import BagLog, merge_streams
from copem_replay.io.log import Log
from copem_replay.io.open import (
    JoinedLog,
    JoinedRecording,
    Local,
    label_topic,
    move_to_first_clock,
    open_log,
    recording_label,
)
from copem_replay.io.schemas.osi_ground_truth import load_message_class
from copem_replay.io.window import Window
from copem_replay.io.write.message_family import OSI_CHANNEL, Catalogue, OriginalMcap, osi_version


class RecordingSource(Protocol):
    """A recording to be copied: its channels and metadata, and its messages on demand.

    `damage`: a note that not all of it can be copied, None: all can.
    """

    profile: str
    metadata: dict[str, dict[str, str]]
    channels: dict[int, Channel]
    damage: str | None

    def register(self, catalogue: Catalogue, without: Collection[str] = ()) -> dict[int, int]:
        """Put schemas, channels and attachments into the output, except the topics `without`.

        Returns the new number of each channel by its number here.
        """

    def messages(self, numbers: Mapping[int, int]) -> Iterator[Message]:
        """The messages in order of log time, with the channel numbers of the output."""


def open_source(path: Local, window: Window | None = None) -> RecordingSource:
    """The recording to be copied, or a window of it. Raises RecordingError: nothing can be read."""
    return _make_source(open_log(path).within(window))


def _make_source(log: Log) -> RecordingSource:
    if isinstance(log, JoinedLog):
        return _JoinedSource(log)
    if isinstance(log, BagLog):
        return _BagSource(log)
    return _TraceSource(log) if isinstance(log, TraceLog) else OriginalMcap(log)


class _NumberedFiles:
    """The channels and records of several files, with channels numbered consecutively."""

    def __init__(self, files: Sequence[RecordingSource]) -> None:
        self.metadata: dict[str, dict[str, str]] = {}
        for file in files:
            for name, record in file.metadata.items():
                self.metadata.setdefault(name, {}).update(record)
        every = [(k, number, c) for k, file in enumerate(files) for number, c in file.channels.items()]
        self._place = {place: (k, number) for place, (k, number, _) in enumerate(every)}
        self.channels = {place: channel for place, (_, _, channel) in enumerate(every)}
        self._count = len(files)

    def numbered_through(self, numbers: Sequence[dict[int, int]]) -> dict[int, int]:
        """The output's number by this numbering, from the output's numbers by each file's own numbering."""
        return {place: numbers[k][n] for place, (k, n) in self._place.items() if n in numbers[k]}

    def by_file(self, numbers: Mapping[int, int]) -> list[dict[int, int]]:
        """For each file the output's number by the file's own, from those by this numbering."""
        result: list[dict[int, int]] = [{} for _ in range(self._count)]
        for place, number in numbers.items():
            k, number_in_file = self._place[place]
            result[k][number_in_file] = number
        return result


class _BagSource:
    def __init__(self, bag: BagLog) -> None:
        self._files = [OriginalMcap(part.log) for part in bag.parts]
        self._several = _NumberedFiles(self._files)
        self.profile = self._files[0].profile
        self.metadata, self.channels = self._several.metadata, self._several.channels
        whole = not bag.lost and not any(file.damage for file in self._files)
        self.damage = None if whole else "damaged: its messages are copied as far as they can be read"

    def register(self, catalogue: Catalogue, without: Collection[str] = ()) -> dict[int, int]:
        return self._several.numbered_through([file.register(catalogue, without) for file in self._files])

    def messages(self, numbers: Mapping[int, int]) -> Iterator[Message]:
        each = zip(self._files, self._several.by_file(numbers), strict=True)
        return merge_streams(
            [
                (file.start_ns, partial(file.messages, numbers_in_file))
                for file, numbers_in_file in each
                if numbers_in_file
            ]
        )


class _LabelledCatalogue:
    """A catalogue for one recording of several: it labels shared topics and adds clock and recording to channels."""

    def __init__(self, catalogue: Catalogue, part: JoinedRecording, several: Collection[str]) -> None:
        self._catalogue, self._part, self._several = catalogue, part, several
        self.schema, self.attach = catalogue.schema, catalogue.attach

    def channel(self, topic: str, encoding: str, schema: int, metadata: dict[str, str]) -> int:
        ahead_ns = self._part.ahead_ns + int(metadata.get(AHEAD, "0"))
        labels = metadata | ({AHEAD: str(ahead_ns)} if ahead_ns else {})
        labels |= {PART: recording_label(self._part.label, metadata.get(PART, ""))}
        topic = label_topic(topic, self._part.label) if topic in self._several else topic
        return self._catalogue.channel(topic, encoding, schema, labels)


class _JoinedSource:
    def __init__(self, log: JoinedLog) -> None:
        self._parts = log.parts
        self._files = [_make_source(part.log) for part in log.parts]
        profiles = {file.profile for file in self._files}
        self.profile = profiles.pop() if len(profiles) == 1 else ""
        self._all = _NumberedFiles(self._files)
        self.metadata, self.channels = self._all.metadata, self._all.channels
        counts = Counter(topic for file in self._files for topic in {c.topic for c in file.channels.values()})
        self._shared = {topic for topic, count in counts.items() if count > 1}
        self.damage = next((file.damage for file in self._files if file.damage), None)

    def register(self, catalogue: Catalogue, without: Collection[str] = ()) -> dict[int, int]:
        numbers = [
            file.register(cast("Catalogue", _LabelledCatalogue(catalogue, part, self._shared)), without)
            for file, part in zip(self._files, self._parts, strict=True)
        ]
        return self._all.numbered_through(numbers)

    def messages(self, numbers: Mapping[int, int]) -> Iterator[Message]:
        each = zip(self._files, self._parts, self._all.by_file(numbers), strict=True)
        return merge_streams(
            [
                (part.log.start_ns - part.ahead_ns, partial(_move_messages, file, numbers_in_file, part.ahead_ns))
                for file, part, numbers_in_file in each
                if numbers_in_file
            ]
        )


def _move_messages(file: RecordingSource, numbers: Mapping[int, int], ahead_ns: int) -> Iterator[Message]:
    return (move_to_first_clock(message, message.channel_id, ahead_ns) for message in file.messages(numbers))


class _TraceSource:
    profile = ""

    def __init__(self, trace: TraceLog) -> None:
        self._trace = trace
        (self._channel,) = trace.channels
        self.metadata: dict[str, dict[str, str]] = {}
        self.damage = None if trace.complete else "damaged: its messages are copied as far as they can be read"
        about = {
            f"{OSI_CHANNEL}description": f"the trace {trace.path.name}",
            f"{OSI_CHANNEL}osi_version": trace.osi_version or osi_version(),
            f"{OSI_CHANNEL}protobuf_version": version("protobuf"),
        }
        number, topic = self._channel.number, self._channel.topic
        self.channels = {number: Channel(number, topic, self._channel.encoding, about, number)}

    def register(self, catalogue: Catalogue, without: Collection[str] = ()) -> dict[int, int]:
        from mcap_protobuf.schema import build_file_descriptor_set

        definition = build_file_descriptor_set(load_message_class(self._channel.schema)).SerializeToString(
            deterministic=True
        )
        schema = catalogue.schema(self._channel.schema, "protobuf", definition)
        return {
            number: catalogue.channel(channel.topic, channel.message_encoding, schema, channel.metadata)
            for number, channel in self.channels.items()
            if channel.topic not in without
        }

    def messages(self, numbers: Mapping[int, int]) -> Iterator[Message]:
        return (renumber_message(message, numbers) for message in self._trace.messages(numbers.keys()))

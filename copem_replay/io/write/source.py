"""A recording on its way into the output, whatever its container: an MCAP file, a folder of them, an OSI trace.

The files of a folder are merged: what several of them have alike (schemas, channels, records, attachments) is kept
once. A trace becomes a channel.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import partial
from importlib.metadata import version
from typing import Protocol, cast

from mcap.records import Channel, Message

from copem_replay.io.containers.in_order import merged
from copem_replay.io.containers.joined import Joined, JoinedPart, moved_back, named, part_of
from copem_replay.io.containers.mcap_indexed import renumbered
from copem_replay.io.containers.osi_trace import Trace, message_class
from copem_replay.io.containers.rosbag2 import Bag
from copem_replay.io.log import Log
from copem_replay.io.open import open_log
from copem_replay.io.together import AHEAD, PART, Local
from copem_replay.io.window import Window
from copem_replay.io.write.message_family import OSI_CHANNEL, osi_version
from copem_replay.io.write.pass_through import Catalogue, Original


class Source(Protocol):
    """What is in a recording besides its messages, and its messages on demand: see `Original`."""

    profile: str
    metadata: dict[str, dict[str, str]]
    channels: dict[int, Channel]
    damage: str | None

    def register(self, catalogue: Catalogue, without: Collection[str] = ()) -> dict[int, int]:
        """Put schemas, channels and attachments into the output, but for some topics."""

    def messages(self, numbers: Mapping[int, int]) -> Iterator[Message]:
        """The messages in order of log time, with the channel numbers of the output."""


def source_of(path: Local, window: Window | None = None) -> Source:
    """What can be copied of a recording, or of a window of it. Raises RecordingError where nothing can be read."""
    return _source(open_log(path).within(window))


def _source(log: Log) -> Source:
    if isinstance(log, Joined):
        return _OfJoined(log)
    if isinstance(log, Bag):
        return _OfBag(log)
    return _OfTrace(log) if isinstance(log, Trace) else Original(log)


class _Several:
    """The channels and records of several files, numbered through; whose number is whose."""

    def __init__(self, files: Sequence[Source]) -> None:
        self.metadata: dict[str, dict[str, str]] = {}
        for file in files:
            for name, record in file.metadata.items():
                self.metadata.setdefault(name, {}).update(record)
        every = [(k, number, c) for k, file in enumerate(files) for number, c in file.channels.items()]
        self._place = {place: (k, number) for place, (k, number, _) in enumerate(every)}
        self.channels = {place: channel for place, (_, _, channel) in enumerate(every)}
        self._count = len(files)

    def numbered_through(self, numbers: Sequence[dict[int, int]]) -> dict[int, int]:
        """By channel its number in the output, from those of each file."""
        return {place: numbers[k][n] for place, (k, n) in self._place.items() if n in numbers[k]}

    def by_file(self, numbers: Mapping[int, int]) -> list[dict[int, int]]:
        """The same file by file, by the file's own numbers."""
        result: list[dict[int, int]] = [{} for _ in range(self._count)]
        for place, number in numbers.items():
            k, theirs = self._place[place]
            result[k][theirs] = number
        return result


class _OfBag:
    def __init__(self, bag: Bag) -> None:
        self._files = [Original(part.log) for part in bag.parts]
        self._several = _Several(self._files)
        self.profile = self._files[0].profile
        self.metadata, self.channels = self._several.metadata, self._several.channels
        whole = not bag.lost and not any(file.damage for file in self._files)
        self.damage = None if whole else "damaged: its messages are copied as far as they can be read"

    def register(self, catalogue: Catalogue, without: Collection[str] = ()) -> dict[int, int]:
        return self._several.numbered_through([file.register(catalogue, without) for file in self._files])

    def messages(self, numbers: Mapping[int, int]) -> Iterator[Message]:
        each = zip(self._files, self._several.by_file(numbers), strict=True)
        return merged([(file.start_ns, partial(file.messages, mine)) for file, mine in each if mine])


class _Named:
    """A catalogue into which a recording of several puts its channels: topics told apart, the clock said."""

    def __init__(self, catalogue: Catalogue, part: JoinedPart, several: Collection[str]) -> None:
        self._catalogue, self._part, self._several = catalogue, part, several
        self.schema, self.attach = catalogue.schema, catalogue.attach

    def channel(self, topic: str, encoding: str, schema: int, metadata: dict[str, str]) -> int:
        ahead_ns = self._part.ahead_ns + int(metadata.get(AHEAD, "0"))
        said = metadata | ({AHEAD: str(ahead_ns)} if ahead_ns else {})
        said |= {PART: part_of(self._part.label, metadata.get(PART, ""))}
        topic = named(topic, self._part.label) if topic in self._several else topic
        return self._catalogue.channel(topic, encoding, schema, said)


class _OfJoined:
    def __init__(self, log: Joined) -> None:
        self._parts = log.parts
        self._files = [_source(part.log) for part in log.parts]
        profiles = {file.profile for file in self._files}
        self.profile = profiles.pop() if len(profiles) == 1 else ""
        self._all = _Several(self._files)
        self.metadata, self.channels = self._all.metadata, self._all.channels
        counts = Counter(topic for file in self._files for topic in {c.topic for c in file.channels.values()})
        self._shared = {topic for topic, count in counts.items() if count > 1}
        self.damage = next((file.damage for file in self._files if file.damage), None)

    def register(self, catalogue: Catalogue, without: Collection[str] = ()) -> dict[int, int]:
        numbers = [
            file.register(cast("Catalogue", _Named(catalogue, part, self._shared)), without)
            for file, part in zip(self._files, self._parts, strict=True)
        ]
        return self._all.numbered_through(numbers)

    def messages(self, numbers: Mapping[int, int]) -> Iterator[Message]:
        each = zip(self._files, self._parts, self._all.by_file(numbers), strict=True)
        return merged(
            [
                (part.log.start_ns - part.ahead_ns, partial(_moved, file, mine, part.ahead_ns))
                for file, part, mine in each
                if mine
            ]
        )


def _moved(file: Source, numbers: Mapping[int, int], ahead_ns: int) -> Iterator[Message]:
    return (moved_back(message, message.channel_id, ahead_ns) for message in file.messages(numbers))


class _OfTrace:
    profile = ""

    def __init__(self, trace: Trace) -> None:
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

        of = build_file_descriptor_set(message_class(self._channel.schema)).SerializeToString(deterministic=True)
        schema = catalogue.schema(self._channel.schema, "protobuf", of)
        return {
            number: catalogue.channel(channel.topic, channel.message_encoding, schema, channel.metadata)
            for number, channel in self.channels.items()
            if channel.topic not in without
        }

    def messages(self, numbers: Mapping[int, int]) -> Iterator[Message]:
        return (renumbered(message, numbers) for message in self._trace.messages(numbers.keys()))

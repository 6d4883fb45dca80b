"""A channel of a recording, in any container: topic, schema, encoding and number of messages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

LAST_NS = 4_000_000_000 * 10**9
"""Latest time that is taken for one, Unix time of 2096: differences of such times still fit 64 bits."""

ENCODINGS: Final = ("cdr", "protobuf", "json")
"""Encodings of messages that are read, of any schema."""

AHEAD: Final = "copem_replay:clock_ahead_ns"
"""Key in a channel's metadata: how many ns the clock of its stamps is ahead of that of the log times."""
PART: Final = "copem_replay:recording"
"""Key in the metadata of a channel in a file that was written from several recordings: the one it comes from."""


@dataclass(frozen=True)
class Channel:
    """A channel. Two channels may share a topic: everything is keyed by `number`."""

    number: int
    topic: str
    schema: str  # name of the schema, "" without one
    encoding: str  # of the messages
    messages: int  # that can be read
    expected: int | None = None  # messages that the index of a damaged file promises, where that is known
    schema_encoding: str = ""
    schema_data: bytes = field(default=b"", repr=False)
    ahead_ns: int = 0  # how far the clock of the stamps in its messages is ahead of that of the log times
    part: str = ""  # the recording it comes from, of several of one drive
    metadata: Mapping[str, str] = field(default_factory=dict, repr=False, compare=False)


class DefinitionError(ValueError):
    """A definition of messages that cannot be used, and why."""


def schema_name(channel: Channel) -> str:
    """The schema as tables name it; ROS 2 types that are written without `/msg` get it."""
    name = channel.schema
    return name.replace("/", "/msg/") if channel.encoding == "cdr" and name.count("/") == 1 else name

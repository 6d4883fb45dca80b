"""Channels of recordings, whatever container they are in."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

ENCODINGS: Final = ("cdr", "protobuf", "json")
"""Encodings of messages that are read, whatever their schema."""


@dataclass(frozen=True)
class Channel:
    """One channel. Two may share a topic: everything is keyed by `number`."""

    number: int
    topic: str
    schema: str  # name of the schema, "" without one
    encoding: str  # of the messages
    messages: int  # that can be read
    expected: int | None = None  # of a damaged file: how many its index promises, where that is known
    schema_encoding: str = ""
    schema_data: bytes = field(default=b"", repr=False)
    ahead_ns: int = 0  # how far stamps in its messages are ahead of the times they were logged at, by another clock
    part: str = ""  # which of several recordings of one drive it is of


def schema_name(channel: Channel) -> str:
    """The schema as tables name it: ROS 2 types may be written without their `/msg`."""
    name = channel.schema
    return name.replace("/", "/msg/") if channel.encoding == "cdr" and name.count("/") == 1 else name

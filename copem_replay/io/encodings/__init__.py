"""Decoding messages into columns, by their encoding: `make_definition`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from mcap.records import Schema

from copem_replay.io.channel import ENCODINGS, Channel

if TYPE_CHECKING:
    from copem_replay.io.encodings.columns import Definition


def make_definition(channel: Channel, samples: Sequence[bytes]) -> Definition:
    """The definition of a channel's messages; JSON has no other than `samples`. Raises DefinitionError."""
    # Loaded where one is needed: most recordings have one encoding, and two of them bring Numba.
    from copem_replay.io.channel import DefinitionError
    from copem_replay.io.encodings.cdr import CdrDefinition
    from copem_replay.io.encodings.json import JsonDefinition
    from copem_replay.io.encodings.protobuf import ProtobufDefinition

    if channel.encoding == "cdr":
        return CdrDefinition(channel.schema, channel.schema_encoding, channel.schema_data)
    if channel.encoding == "protobuf":
        schema: Any = Schema(id=1, name=channel.schema, encoding=channel.schema_encoding, data=channel.schema_data)
        return ProtobufDefinition(channel.schema, schema)
    if channel.encoding == "json":
        return JsonDefinition(samples)
    raise DefinitionError(
        f"messages are encoded as {channel.encoding or 'nothing that is said'}; read are {', '.join(ENCODINGS)}"
    )

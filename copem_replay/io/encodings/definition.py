"""How messages of a channel are taken apart, by their encoding."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mcap.records import Schema

from copem_replay.io.channel import ENCODINGS, Channel
from copem_replay.io.encodings.cdr import CdrDefinition
from copem_replay.io.encodings.columns import Definition
from copem_replay.io.encodings.json import JsonDefinition
from copem_replay.io.encodings.protobuf import ProtobufDefinition
from copem_replay.io.encodings.raw_values import DefinitionError


def definition_of(channel: Channel, samples: Sequence[bytes]) -> Definition:
    """How messages of the channel are taken apart; `samples` where only they tell. Raises DefinitionError."""
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

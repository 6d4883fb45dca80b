"""Which messages this version knows by their schemas, and how messages of any schema are taken apart."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any

from mcap.records import Schema

from copem_replay.io.encodings.cdr import CdrDefinition
from copem_replay.io.encodings.columns import Definition
from copem_replay.io.encodings.json import JsonDefinition
from copem_replay.io.encodings.protobuf import ProtobufDefinition
from copem_replay.io.encodings.raw_values import DefinitionError
from copem_replay.io.log import Channel
from copem_replay.io.schemas import foxglove as scene_update
from copem_replay.io.schemas import ros2 as ros2_lists

if TYPE_CHECKING:
    from copem_replay.io.schemas.object_lists import Description

_ENCODINGS = ("cdr", "protobuf", "json")
LISTS = (*ros2_lists.DESCRIPTIONS, *scene_update.SCHEMAS)
"""Schemas of object lists beside those of OSI."""


def schema_name(channel: Channel) -> str:
    """The schema as it is known: ROS 2 types may be written without their `/msg`."""
    name = channel.schema
    return name.replace("/", "/msg/") if channel.encoding == "cdr" and name.count("/") == 1 else name


def is_list(channel: Channel) -> bool:
    """Whether the channel holds object lists of a schema that is known."""
    return schema_name(channel) in LISTS and channel.encoding in _ENCODINGS


def names_objects(channel: Channel) -> bool:
    """Whether its objects have ids, so that it can be the truth."""
    return is_list(channel) and not schema_name(channel).endswith("/DetectedObjects")


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
        f"messages are encoded as {channel.encoding or 'nothing that is said'}; read are {', '.join(_ENCODINGS)}"
    )


def description_of(channel: Channel, offers: Collection[str]) -> Description:
    """Where messages of a schema that is known have what."""
    name = schema_name(channel)
    made: Description = (
        scene_update.description(offers) if name in scene_update.SCHEMAS else ros2_lists.DESCRIPTIONS[name](offers)
    )
    return made

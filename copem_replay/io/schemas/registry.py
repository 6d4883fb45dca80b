"""The registry of schemas of object lists, beside those of OSI: which function describes each schema.

A format is a function that gives its `Description`, and a row here for each of its schemas. Rows of other packages are
entry points of the group `copem_replay.list_schema`: the name is that of the schema, the value a `ListSchema`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Final

from copem_replay.core.errors import FAILURES, InputError, describe_failure, is_own
from copem_replay.io.channel import ENCODINGS, Channel, schema_name

DETAIL_SCHEMA = "copem_replay.ListDetail"
"""What `replay.mcap` says beside osi3.SensorData, as JSON."""
STRING = "std_msgs/msg/String"
"""The message of ROS 2 that holds such JSON."""

if TYPE_CHECKING:
    from copem_replay.io.schemas.description import Description


@dataclass(frozen=True)
class ListSchema:
    """A schema of object lists.

    `name`: that of the schema; ROS 2 types with their `/msg/`. `describe`: `package.module:function`, imported when a
    recording has such lists. The function takes the paths that the messages offer, since definitions differ between
    releases, and returns a `Description`. `has_ids`: whether an object keeps its id from list to list, in places
    of the log, so that the lists can be the truth. `stays`: whether what a message holds may stay until another
    removes it.
    """

    name: str
    describe: str
    has_ids: bool = True
    stays: bool = False

    def description(self, offers: Collection[str]) -> Description:
        """The description of messages with these paths. Raises InputError: another package's function fails."""
        from copem_replay.io.schemas.description import Description

        module, _, name = self.describe.partition(":")
        where = f"schema {self.name}: "
        try:
            describe = getattr(import_module(module), name)
        except FAILURES as error:  # whatever a module of another package raises
            raise InputError(f"{where}{self.describe} cannot be imported: {describe_failure(error)}") from error
        try:
            result = describe(offers)
        except FAILURES as error:
            if is_own(describe):
                raise InputError(f"{where}{self.describe}: {describe_failure(error)}") from error
            raise
        if not isinstance(result, Description):
            raise InputError(f"{where}expected {self.describe} to give a Description, found {type(result).__name__}")
        return result


_FORMATS: Final = "copem_replay.io.schemas.formats"
_V2X: Final = "copem_replay.io.schemas.v2x"
_IKA: Final = ("perception_msgs", "ika_perception_msgs")
_AUTOWARE: Final = ("autoware_perception_msgs", "autoware_auto_perception_msgs")
_ROWS: Final = (
    *(ListSchema(f"{package}/msg/TrackedObjects", f"{_FORMATS}:autoware") for package in _AUTOWARE),
    *(ListSchema(f"{package}/msg/PredictedObjects", f"{_FORMATS}:autoware") for package in _AUTOWARE),
    *(ListSchema(f"{package}/msg/DetectedObjects", f"{_FORMATS}:autoware", has_ids=False) for package in _AUTOWARE),
    ListSchema("vision_msgs/msg/Detection3DArray", f"{_FORMATS}:detection3d"),
    ListSchema("derived_object_msgs/msg/ObjectArray", f"{_FORMATS}:derived"),
    ListSchema("visualization_msgs/msg/MarkerArray", f"{_FORMATS}:markers", stays=True),
    ListSchema("foxglove.SceneUpdate", f"{_FORMATS}:description", stays=True),
    ListSchema("foxglove_msgs/msg/SceneUpdate", f"{_FORMATS}:description", stays=True),
    *(ListSchema(f"{package}/msg/ObjectList", f"{_FORMATS}:perception") for package in _IKA),
    ListSchema("etsi_its_cpm_ts_msgs/msg/CollectivePerceptionMessage", f"{_V2X}:cpm", has_ids=False),
    ListSchema("carma_v2x_msgs/msg/SensorDataSharingMessage", f"{_V2X}:sdsm", has_ids=False),
    ListSchema("j3224_v2x_msgs/msg/SensorDataSharingMessage", f"{_V2X}:sdsm_integers", has_ids=False),
)
SCHEMAS: Final = {schema.name: schema for schema in _ROWS}
GROUP: Final = "copem_replay.list_schema"


def list_schema(channel: Channel) -> ListSchema | None:
    """The row of a channel's schema; None: its schema is not known.

    Raises InputError: the row of another package cannot be imported, or is no `ListSchema`.
    """
    if channel.encoding not in ENCODINGS:
        return None
    name = schema_name(channel)
    return SCHEMAS.get(name) or _load_installed(name)


def is_list(channel: Channel) -> bool:
    """Whether the channel holds object lists of a schema in the registry."""
    return list_schema(channel) is not None


def names_objects(channel: Channel) -> bool:
    """Whether the objects on the channel have ids, so that it can be the truth."""
    schema = list_schema(channel)
    return schema is not None and schema.has_ids


def may_stay(channel: Channel) -> bool:
    """Whether what a message of the channel holds may stay until another removes it."""
    schema = list_schema(channel)
    return schema is not None and schema.stays


def known_lists(channels: Iterable[Channel]) -> list[Channel]:
    """Channels with messages of a schema in the registry, which OSI's are not in."""
    return [c for c in channels if c.messages and is_list(c)]


def describe_channel(channel: Channel, offers: Collection[str]) -> Description:
    """The description of a channel's messages, which offer the paths `offers`. Raises KeyError: a schema not known."""
    schema = list_schema(channel)
    if schema is None:
        raise KeyError(channel.schema)
    return schema.description(offers)


@cache
def _load_installed(name: str) -> ListSchema | None:
    """The row of another package for a schema; None: no package has one. Raises InputError: it cannot be loaded."""
    from importlib.metadata import entry_points  # takes time, and few recordings have schemas that no row names

    entry = next(iter(entry_points(group=GROUP, name=name)), None)
    if entry is None:
        return None
    try:
        schema = entry.load()
    except FAILURES as error:  # whatever a module of another package raises
        raise InputError(f"schema {name}: {entry.value} cannot be imported: {describe_failure(error)}") from error
    if not isinstance(schema, ListSchema):
        raise InputError(f"schema {name}: expected {entry.value} to be a ListSchema, found {type(schema).__name__}")
    return schema

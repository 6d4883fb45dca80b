"""The schemas of object lists that are known by name, beside those of OSI: one row each.

A format is a function that describes where its messages have what, and its rows here. Rows of other packages are entry
points of the group `copem_replay.list_schema`: the name is that of the schema, the value a `ListSchema`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Final

from copem_replay.core.errors import InputError
from copem_replay.core.own_code import FAILURES, failed, is_own
from copem_replay.io.channel import ENCODINGS, Channel, schema_name

if TYPE_CHECKING:  # pydantic takes longer to import than a look at a recording of OSI
    from copem_replay.io.schemas.description import Description


@dataclass(frozen=True)
class ListSchema:
    """A schema of object lists.

    `name`: of the schema; ROS 2 types with their `/msg/`. `describe`: `package.module:function`, imported when a
    recording has such lists; takes the paths that its messages offer, for definitions differ between releases, and
    returns a `Description`. `has_ids`: whether an object keeps its id from list to list, so that the lists can be the
    truth.
    """

    name: str
    describe: str
    has_ids: bool = True

    def description(self, offers: Collection[str]) -> Description:
        """Where messages that offer these paths have what.

        Raises InputError: the function of another package cannot be imported, fails or gives something else.
        """
        from copem_replay.io.schemas.description import Description

        module, _, name = self.describe.partition(":")
        where = f"schema {self.name}: "
        try:
            describe = getattr(import_module(module), name)
        except FAILURES as error:  # whatever a module of another package raises
            raise InputError(f"{where}{self.describe} cannot be imported: {failed(error)}") from error
        try:
            made = describe(offers)
        except FAILURES as error:
            if is_own(describe):
                raise InputError(f"{where}{self.describe}: {failed(error)}") from error
            raise
        if not isinstance(made, Description):
            raise InputError(f"{where}expected {self.describe} to give a Description, found {type(made).__name__}")
        return made


_ROS2: Final = "copem_replay.io.schemas.ros2"
_FOXGLOVE: Final = "copem_replay.io.schemas.foxglove"
_AUTOWARE: Final = ("autoware_perception_msgs", "autoware_auto_perception_msgs")
_ROWS: Final = (
    *(ListSchema(f"{package}/msg/TrackedObjects", f"{_ROS2}:autoware") for package in _AUTOWARE),
    *(ListSchema(f"{package}/msg/PredictedObjects", f"{_ROS2}:autoware") for package in _AUTOWARE),
    *(ListSchema(f"{package}/msg/DetectedObjects", f"{_ROS2}:autoware", has_ids=False) for package in _AUTOWARE),
    ListSchema("vision_msgs/msg/Detection3DArray", f"{_ROS2}:detection3d"),
    ListSchema("derived_object_msgs/msg/ObjectArray", f"{_ROS2}:derived"),
    ListSchema("visualization_msgs/msg/MarkerArray", f"{_ROS2}:markers"),
    ListSchema("foxglove.SceneUpdate", f"{_FOXGLOVE}:description"),
    ListSchema("foxglove_msgs/msg/SceneUpdate", f"{_FOXGLOVE}:description"),
)
SCHEMAS: Final = {schema.name: schema for schema in _ROWS}
GROUP: Final = "copem_replay.list_schema"


def list_schema(channel: Channel) -> ListSchema | None:
    """The row of a channel's schema, None where there is none.

    Raises InputError: the row of another package cannot be imported, or is no row.
    """
    if channel.encoding not in ENCODINGS:
        return None
    name = schema_name(channel)
    return SCHEMAS.get(name) or _installed(name)


def is_list(channel: Channel) -> bool:
    """Whether the channel holds object lists of a schema that is known."""
    return list_schema(channel) is not None


def names_objects(channel: Channel) -> bool:
    """Whether its objects have ids, so that it can be the truth."""
    schema = list_schema(channel)
    return schema is not None and schema.has_ids


def known_lists(channels: Iterable[Channel]) -> list[Channel]:
    """Channels with object lists, other than OSI's, of a schema that is known."""
    return [c for c in channels if c.messages and is_list(c)]


def description_of(channel: Channel, offers: Collection[str]) -> Description:
    """Where messages of a schema that is known have what; `offers`: the paths they have. Raises KeyError."""
    schema = list_schema(channel)
    if schema is None:
        raise KeyError(channel.schema)
    return schema.description(offers)


@cache
def _installed(name: str) -> ListSchema | None:
    """The row that another package has for a schema."""
    from importlib.metadata import entry_points  # takes time, and few recordings have schemas that no row names

    entry = next(iter(entry_points(group=GROUP, name=name)), None)
    if entry is None:
        return None
    try:
        schema = entry.load()
    except FAILURES as error:  # whatever a module of another package raises
        raise InputError(f"schema {name}: {entry.value} cannot be imported: {failed(error)}") from error
    if not isinstance(schema, ListSchema):
        raise InputError(f"schema {name}: expected {entry.value} to be a ListSchema, found {type(schema).__name__}")
    return schema

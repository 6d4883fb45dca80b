"""Messages for the tests of formats: ROS 2 ones serialised by rosbags, and what was read of them in short."""

import math
from functools import cache
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from copem_replay.core.tracks import CLASSES, VALUES
from copem_replay.io.encodings.cdr import CdrDefinition
from copem_replay.io.encodings.columns import DistinctTexts
from copem_replay.io.schemas.object_lists import DecodedLists

SEPARATOR = "=" * 80 + "\n"


def defined(text: str, name: str = "p/msg/A", encoding: str = "ros2msg") -> CdrDefinition:
    return CdrDefinition(name, encoding, text.encode())


@cache
def store_of(text: str, name: str) -> Any:
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, name))
    return store


def serialised(text: str, message: dict[str, Any], *, little: bool = True, name: str = "p/msg/A") -> bytes:
    """By rosbags; fields that the message lacks are 0, or empty."""
    store = store_of(text, name)

    def made(name: str, value: dict[str, Any]) -> Any:
        fields = store.get_msgdef(name).fields
        return store.types[name](**{f: filled(node, value.get(f, 0)) for f, node in fields})

    def filled(node: Any, value: Any) -> Any:
        kind, detail = int(node[0]), node[1]
        if kind == 1:
            return value
        if kind == 2:
            return made(detail, value or {})
        item, value = detail[0], [] if isinstance(value, int) else value
        if int(item[0]) == 1 and item[1][0] != "string":
            return np.array(value, dtype={"byte": "u1", "char": "u1"}.get(item[1][0], item[1][0]))
        return [filled(item, v) for v in value]

    return bytes(store.serialize_cdr(made(name, message), name, little_endian=little))


def texts(column: DistinctTexts) -> list[str | None]:
    return [column.words[k] if k >= 0 else None for k in column.code]


def values(found: DecodedLists, name: str) -> list[Any]:
    column = found.columns.values[:, VALUES.index(name)]
    return [None if math.isnan(v) else pytest.approx(v) for v in column]


def classes(found: DecodedLists) -> list[str]:
    return [CLASSES[k] for k in found.columns.class_ix]


def ids(found: DecodedLists) -> list[str]:
    return [found.columns.object_ids[k] for k in found.columns.object_ix]


def quaternion(yaw: float, scale: float = 1.0) -> dict[str, float]:
    return {"x": 0.0, "y": 0.0, "z": scale * math.sin(yaw / 2), "w": scale * math.cos(yaw / 2)}

"""ASAM OSI's name for a fused list, osi3.SensorData, and its numbers for objects: what reading and writing share."""

from __future__ import annotations

from typing import Any

SCHEMA = "osi3.SensorData"
OSI_VERSION = (3, 8, 0)


def osi_id(object_id: str) -> int:
    """The number OSI has for an object: its id where that is a number, else a stable hash of it."""
    number = object_id.removeprefix("stationary:")
    if number.isdigit() and int(number) < 2**64:
        return int(number)
    from copem_replay.core.random import object_words  # compiled: a look at lists whose ids are numbers does without

    return int(object_words([object_id])[0])


def message_class() -> Any:
    """The SensorData class, imported when first needed."""
    from osi3.osi_sensordata_pb2 import SensorData

    return SensorData

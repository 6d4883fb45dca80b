"""What of a recording is read, and how: keys of the experiment file."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from copem_replay.core.components import Covariance, Frozen, Number, Positive, Share
from copem_replay.io.schemas.object_lists import Fields

Latency = Annotated[float, Field(strict=True, ge=0, le=86_400)]
"""Seconds, a day at most (chosen: more is a mistake, and a stamp in nanoseconds has an end)."""


class Recorded(Frozen):
    """Lists as they were recorded in the log, on a topic of osi3.SensorData, instead of a PEM.

    `delay_s`: how long before its stamp a list was captured, where its messages don't say; `covariance_m2` of its
    positions and `existence` of its entries likewise.
    """

    topic: Annotated[str, Field(min_length=1)]
    delay_s: Latency = 0.0
    covariance_m2: Covariance | None = None
    existence: Share = 0.9


class Read(Frozen):
    """How the truth is found in a recording that holds several object lists."""

    topic: str | None = None


class ReadFields(Fields):
    """How the truth is read from a topic of a schema that is not known by name: which of its fields are what."""

    topic: Annotated[str, Field(min_length=1)]


class EgoTopic(Frozen):
    """An ego that is no object of any list: its poses are on a topic (odometry, stamped poses, transforms).

    `size_m`: length, width, height. `centre_from_rear_axle_m`: how far ahead of its poses, which are on the ground, the
    centre of its box is. `frame`: whose poses, where the topic has those of several.
    """

    topic: Annotated[str, Field(min_length=1)]
    size_m: tuple[Positive, Positive, Positive] | None = None
    centre_from_rear_axle_m: Number | None = None
    frame: str | None = None

"""What of a recording is read, and how: keys of the experiment file."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Discriminator, Field, Tag

from copem_replay.core.components import Covariance, Either, Frozen, Id, Latency, NotNegative, Number, Positive, Share
from copem_replay.io.schemas.object_lists import Fields


class Recorded(Frozen):
    """Lists as they were recorded in the log, on a topic of osi3.SensorData, instead of a PEM.

    `delay_s`: how long before its stamp a list was captured, where its messages don't say; `covariance_m2` of its
    positions and `existence` of its entries likewise.
    """

    topic: Annotated[str, Field(min_length=1)]
    delay_s: Latency = 0.0
    covariance_m2: Covariance | None = None
    existence: Share = 0.9


class RecordedOutput(Recorded):
    """The fused lists of a stack as they were recorded, in the place of units and a fusion.

    `delay_s`: how long before the stamp of a list its states were so, where its messages don't say; with
    `tells_of: available` the stack predicts them to the instant its list is available.
    """

    tells_of: Literal["stamp", "available"] = "stamp"


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


def _how_read(value: object) -> str:
    named = isinstance(value, ReadFields) or (isinstance(value, dict) and len(value.keys() - {"topic"}) > 0)
    return "fields" if named else "topic"


HowRead = Annotated[Annotated[Read, Tag("topic")] | Annotated[ReadFields, Tag("fields")], Discriminator(_how_read)]


Ego = Either[Id, EgoTopic]


def _in_order(window_s: tuple[float | None, float | None]) -> tuple[float | None, float | None]:
    from_s, to_s = window_s
    if from_s is not None and to_s is not None and from_s > to_s:
        raise ValueError(f"expected [from, to], found one that ends ({to_s:g} s) before it begins ({from_s:g} s)")
    return window_s


WindowOf = Annotated[tuple[NotNegative | None, NotNegative | None], AfterValidator(_in_order)]

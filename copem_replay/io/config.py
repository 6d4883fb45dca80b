"""Keys of an experiment that say what is read of a recording: truth, ego, recorded units, window."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Discriminator, Field, Tag

from copem_replay.core.components import (
    Covariance,
    Either,
    FileBeside,
    Frozen,
    Id,
    Latency,
    NotNegative,
    Number,
    Positive,
    Share,
)
from copem_replay.core.tracks import CLASSES
from copem_replay.io.schemas.object_lists import Fields


class RecordedTopic(Frozen):
    """The lists of a unit as they were recorded in the log on a topic, instead of a PEM.

    Used where the messages state none: `delay_s`, the time from the capture of a list to its stamp; `covariance_m2` of
    its positions; `existence` of its entries.
    """

    topic: str
    delay_s: Latency = 0.0
    covariance_m2: Covariance | None = None
    existence: Share = 0.9


class RecordedOutput(RecordedTopic):
    """The fused lists of a stack as they were recorded, instead of units and a fusion.

    `delay_s`: the age of a list's states at its stamp, where its messages state none; with `tells_of: available` the
    stack predicts the states to the instant at which its list is available.
    """

    tells_of: Literal["stamp", "available"] = "stamp"


def _check_class(name: str) -> str:
    if name not in CLASSES:
        raise ValueError(f"expected one of {', '.join(CLASSES)}, found {name!r}")
    return name


ClassName = Annotated[str, AfterValidator(_check_class)]


class TruthTopic(Frozen):
    """The topic of the truth in a recording that holds several object lists.

    `classes`: the class that a name of one stands for, beside those that are known: `{Barrowlist: bicycle}`.
    `definitions`: a folder of packages of ROS 2 with the messages whose definitions the recorder left out.
    """

    topic: str | None = None
    classes: dict[Id, ClassName] = Field(default_factory=dict)
    definitions: FileBeside | None = None


class TruthFields(Fields):
    """The truth on a topic whose schema is not known by name: which of its fields hold what."""

    topic: str
    classes: dict[Id, ClassName] = Field(default_factory=dict)
    definitions: FileBeside | None = None


class EgoTopic(Frozen):
    """An ego that is no object of any list: its poses are on a topic (odometry, stamped poses, transforms).

    `size_m`: length, width, height. `centre_from_rear_axle_m`: the distance from its poses, which are on the ground,
    forward to the centre of its box. `frame`: the frame of the ego, where the topic has poses of several.
    """

    topic: str
    size_m: tuple[Positive, Positive, Positive] | None = None
    centre_from_rear_axle_m: Number | None = None
    frame: str | None = None


def _truth_key_form(value: object) -> str:
    named = isinstance(value, TruthFields) or (
        isinstance(value, dict) and not value.keys() <= TruthTopic.model_fields.keys()
    )
    return "fields" if named else "topic"


HowRead = Annotated[
    Annotated[TruthTopic, Tag("topic")] | Annotated[TruthFields, Tag("fields")], Discriminator(_truth_key_form)
]


Ego = Either[Id, EgoTopic]


def _check_window_order(window_s: tuple[float | None, float | None]) -> tuple[float | None, float | None]:
    from_s, to_s = window_s
    if from_s is not None and to_s is not None and from_s > to_s:
        raise ValueError(f"expected [from, to], found one that ends ({to_s:g} s) before it begins ({from_s:g} s)")
    return window_s


WindowOf = Annotated[tuple[NotNegative | None, NotNegative | None], AfterValidator(_check_window_order)]

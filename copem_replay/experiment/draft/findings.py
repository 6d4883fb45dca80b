"""What a look at a recording finds: plain values, in the order in which JSON has them."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any, Literal

Role = Literal["truth", "unit", "poses", "unread"]


@dataclass(frozen=True)
class TopicFound:
    """A channel, and what it is to a replay."""

    topic: str
    schema: str
    encoding: str
    messages: int
    role: Role


@dataclass(frozen=True)
class UnitFound:
    """The recorded lists of one unit. `problem`: why they cannot be read, None where they can."""

    topic: str
    lists: int = 0
    entries: int = 0
    rate_hz: float | None = None  # median
    covariances_said: bool = False  # by every entry
    captures_said: bool = False  # by every list
    problem: str | None = None
    delay_s: float | None = None  # as entries fit the truth best, of lists that do not say when they were captured
    delay_interval_s: list[float] | None = None  # 95 %
    delay: str | None = None  # the same in words, or that it cannot be told; None: lists say it
    oddities: list[str] = field(default_factory=list)  # one line each


@dataclass(frozen=True)
class EgoFound:
    """The ego vehicle that the log names: its size in its first frame, and from when to when it is there."""

    id: str
    class_: str  # in JSON `class`
    size_m: list[float]  # length, width, height
    from_s: float
    to_s: float


@dataclass(frozen=True)
class Mast:
    """A place to look on from, and the direction to look in."""

    at: list[float]  # x, y in metres, as in the log
    yaw_deg: int


@dataclass(frozen=True)
class Suggestion:
    """An experiment to begin with.

    `ego`: as the experiment has it, None: the host vehicle of the log. `classes`: those that are measured, None: all
    that moves. `masts`: two, the one with more room around it first.
    """

    ego: str | dict[str, str] | None
    ego_why: str
    classes: list[str] | None
    onset: str
    masts: list[Mast]


@dataclass(frozen=True)
class TruthFound:
    """One list of true objects. `rate_hz` is the median; gaps are None where there is one frame only."""

    topic: str
    frames: int
    states: int
    start_ns: int
    span_s: float
    rate_hz: float | None
    longest_gap_s: float | None
    longest_gap_at_s: float | None
    gaps_inside_tracks: int
    x_m: list[float]  # from where to where the centres of the boxes lie
    y_m: list[float]
    moving: dict[str, int]  # objects by class
    stationary: dict[str, int]
    host_id: str | None
    ego: EgoFound | None
    missing: list[str]  # what a user may have to give
    damage: str | None
    notes: list[str]
    vehicles: str  # ids of objects that move, as messages list them
    units: list[UnitFound]
    suggested: Suggestion


@dataclass(frozen=True)
class ProposalFound:
    """A channel that looks like a list of objects, by the names of its fields.

    `read`: as an experiment has it, of what was found. `missing`: needed keys that were not found. `offers`: fields of
    the messages. `problem`: why it was not read. `truth`: what is read so, None where not all was found.
    """

    topic: str
    schema: str
    read: dict[str, Any]
    missing: list[str]
    offers: list[str]
    problem: str | None = None
    truth: TruthFound | None = None


@dataclass(frozen=True)
class Survey:
    """A recording that was looked at.

    `readable`: whether a list of true objects could be read; if not, `reason` says why in a line, and `topics` what
    the file holds all the same. `truth` has an entry per topic that could be the truth: one, unless there is a choice
    to make (then `choice` says so). `damage`: what is wrong with the file. `proposals`: where no list is known by
    name, what could be read by naming fields. `units`: lists of units, where there is no truth to hold them against.
    """

    recording: str
    readable: bool = False
    reason: str | None = None
    choice: str | None = None
    damage: str | None = None
    topics: list[TopicFound] = field(default_factory=list)
    truth: list[TruthFound] = field(default_factory=list)
    log: str = ""
    proposals: list[ProposalFound] = field(default_factory=list)
    units: list[UnitFound] = field(default_factory=list)


def as_json(survey: Survey) -> dict[str, Any]:
    """Plain data that JSON can hold, the same for the same recording."""
    return asdict(survey, dict_factory=lambda items: {name.removesuffix("_"): value for name, value in items})

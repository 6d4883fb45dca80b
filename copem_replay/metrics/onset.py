"""Onsets, as components: the condition that starts the clock of a measured object; and how each episode began.

An own onset derives from `Onset` and answers `holds`; the experiment names it with `kind: package.module:Class`. The
meanings of the built-in ones: docs/guide/metrics.md.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self, get_args

import numpy as np
from pydantic import Field, model_validator
from pydantic.json_schema import SkipJsonSchema

from copem_replay.core.components import (
    Component,
    NotNegative,
    Positive,
    Share,
    ask_component,
    wrong_answer_error,
)
from copem_replay.core.errors import ExperimentError, count_noun
from copem_replay.core.tracks import SAME_INSTANT_S, Bool, Float, Int, Tracks

if TYPE_CHECKING:
    import pandas as pd

_TOLERANCE_M = 1e-6
"""Far below any distance that matters, far above the rounding of coordinates."""


# How an episode began, and which episodes count.

Began = Literal["log_start", "appeared", "crossed"]
"""`log_start`: the condition held at the first instant at which it could be asked of any object; `appeared`: at the
object's own first frame, later; `crossed`: it came true while the object was followed."""
BEGAN: tuple[Began, ...] = get_args(Began)
"""`Episodes.began` holds positions in this tuple."""
LOG_START, APPEARED, CROSSED = range(len(BEGAN))


def began_texts(position: Int) -> np.ndarray:
    """(n,) words for positions (n,) in `BEGAN`."""
    return np.array(BEGAN, dtype=object)[position]


COUNTS_BY = ("began", "onset_s", "ended_s")
"""The columns that say whether a row counts."""


def has_frame_after(rows: pd.DataFrame) -> Bool:
    """(n,) whether the object has a frame after its onset: nothing can be measured of an episode of one frame."""
    after: Bool = (rows["ended_s"] - rows["onset_s"]).to_numpy(dtype=float) > SAME_INSTANT_S
    return after


def is_counted(rows: pd.DataFrame, words: Sequence[str]) -> Bool:
    """Mask (n,) of the rows that count for times, shares and distances at detection; all else is measured of all rows.

    They began in one of the ways `words` (`measure.began`), and have a frame after the onset. `rows`: a table with the
    columns `COUNTS_BY`.
    """
    counted: Bool = rows["began"].isin(words).to_numpy(dtype=bool) & has_frame_after(rows)
    return counted


def select_counted(rows: pd.DataFrame, words: Sequence[str]) -> pd.DataFrame:
    """The rows that count, of a table with the columns `COUNTS_BY`."""
    counted = is_counted(rows, words)
    return rows if counted.all() else rows[counted]


# How many episodes of a log began in each of the ways `BEGAN`, as `Episodes.count_began` gives them.

COUNT_ALL = "measure: {began: [log_start, crossed, appeared]}"
"""The line with which all episodes count."""


def count_counted(numbers: Sequence[int], words: Sequence[str]) -> int:
    """The number of episodes that count by `measure.began`."""
    return sum(number for word, number in zip(BEGAN, numbers, strict=True) if word in words)


def describe_numbers(numbers: Sequence[int]) -> str:
    """The numbers of episodes by how they began: `5 log_start, 2 appeared, 9 crossed`."""
    return ", ".join(f"{number} {word}" for word, number in zip(BEGAN, numbers, strict=True))


def check_counted(by_log: Sequence[Sequence[int]], words: Sequence[str]) -> None:
    """Raises ExperimentError where objects have an onset, but none counts by `measure.began` in any log."""
    total = np.sum(by_log, axis=0).tolist() if by_log else []
    if sum(total) and not count_counted(total, words):
        raise ExperimentError(
            f"expected objects that count ({', '.join(words)}), found none: of {count_noun(sum(total), 'object')} with "
            f"an onset {describe_numbers(total)}; `{COUNT_ALL}` counts all"
        )


class Requires(Enum):
    """What an onset needs of the experiment beside the truth."""

    NOTHING = "nothing"
    UNIT = "a modelled unit"
    UNIT_ON_EGO = "a unit on the ego"


@dataclass(frozen=True)
class OnsetView:
    """What an onset's condition reads. Rows (P,): each measured object at the truth's own frames, object after object.

    `tracks`: the states, one object a track. `distance_m("centre" | "front") (P,)`: metres to the place that
    `measure.distance_to` names, from its centre or along its heading from its front; infinite where it is absent.
    `visible_share("ego" | "any") (P,)`: the largest share, 0 … 1, that any unit (of the ego) sees.
    """

    tracks: Tracks
    distance_m: Callable[[Literal["centre", "front"]], Float]
    visible_share: Callable[[Literal["ego", "any"]], Float]

    @property
    def time_s(self) -> Float:
        """(P,) seconds since the log's start."""
        return self.tracks.row_captured_s

    @property
    def speed_mps(self) -> Float:
        """(P,) speed over ground."""
        speed: Float = np.hypot(self.tracks.vx_mps[0], self.tracks.vy_mps[0])
        return speed


AgainAfter = Annotated[Positive | None, Field(exclude_if=lambda value: value is None)]


class Onset(Component, ABC):
    """Base of onsets. The onset of an object is the first frame, with the ego in the log, at which `holds`.

    `again_after_s`: who was out of the condition for longer has a new episode on coming back; None: only the first.

    >>> class Fast(cr.Onset):
    ...     def holds(self, view):
    ...         return view.speed_mps > 15.0
    >>> Fast(kind="my_package.onsets:Fast").label("car")
    'Fast'
    """

    again_after_s: AgainAfter = None
    requires: ClassVar[Requires] = Requires.NOTHING
    """What the experiment needs for this onset; `check` says where it lacks. A property of the class, no field."""

    @classmethod
    def __pydantic_init_subclass__(cls, **given: Any) -> None:
        super().__pydantic_init_subclass__(**given)
        if "requires" in cls.model_fields or not isinstance(cls.requires, Requires):
            raise TypeError("requires: expected a property of the class, `requires: ClassVar[Requires]`")

    @property
    def instant_s(self) -> float | None:
        """Seconds since the log's start where the onset is an instant, which may lie between two frames; else None."""
        return None

    @abstractmethod
    def holds(self, view: OnsetView) -> Bool:
        """(P,) whether the condition holds, row by row. May not draw random numbers."""

    def label(self, object_class: str) -> str:
        """Two or three words for figures, such as `starts to move`, of an object of a class."""
        return self.kind.rpartition(":")[2]

    def described(self, near: str) -> str:
        """A clause for the report: when the clock of an object starts. `near`: where distances are measured from."""
        return f"at its onset “{self.label('object')}”"


def evaluate_onset(onset: Onset, view: OnsetView) -> Bool:
    """(P,) where an onset's condition holds, checked. Raises InputError when an own onset fails."""
    where = "measure.onset"
    holding = ask_component(onset, where, lambda: np.asarray(onset.holds(view)))
    expected = view.time_s.shape
    if holding.shape != expected or holding.dtype != np.bool_:
        answer = f"{holding.dtype} {holding.shape}"
        raise wrong_answer_error(
            onset, where, f"holds(view): expected true or false of shape {expected}, found {answer}", "holds"
        )
    return holding


class StartsMoving(Onset):
    """The object moves, within a distance of the ego's centre, or ahead of its front along its heading."""

    kind: Literal["starts_moving"] = "starts_moving"
    speed_mps: Positive = 0.3
    within_m: Positive | None = None
    from_: Annotated[Literal["centre", "front"], Field(alias="from")] = "centre"

    def holds(self, view: OnsetView) -> Bool:
        """(P,) whether the speed is reached, near enough."""
        moving: Bool = view.speed_mps >= self.speed_mps - 1e-9
        if self.within_m is None:
            return moving
        return moving & (view.distance_m(self.from_) <= self.within_m + _TOLERANCE_M)

    def label(self, object_class: str) -> str:
        """`walking starts` of a pedestrian, else `starts to move`."""
        return "walking starts" if object_class == "pedestrian" else "starts to move"

    def described(self, near: str) -> str:
        """The speed, and the distance if there is one."""
        within = ""
        if self.within_m is not None:
            within = f" within {self.within_m:g} m of {near}{'’s front' if self.from_ == 'front' else ''}"
        return f"when it moves at {self.speed_mps:g} m/s or more{within}"


class Appears(Onset):
    """The object is in the log."""

    kind: Literal["appears"] = "appears"

    def holds(self, view: OnsetView) -> Bool:
        """(P,) true."""
        return np.ones(len(view.time_s), dtype=bool)

    def label(self, object_class: str) -> str:
        """`appears`."""
        return "appears"

    def described(self, near: str) -> str:
        """That it appears."""
        return "when it appears in the log"


class InRange(Onset):
    """The distance to the ego is within the range."""

    kind: Literal["in_range"] = "in_range"
    range_m: Positive = 50.0

    def holds(self, view: OnsetView) -> Bool:
        """(P,) whether the centre is near enough."""
        return view.distance_m("centre") <= self.range_m + _TOLERANCE_M

    def label(self, object_class: str) -> str:
        """The range in metres."""
        return f"within {self.range_m:g} m"

    def described(self, near: str) -> str:
        """The range, and the place it is measured from."""
        return f"when it comes within {self.range_m:g} m of {near}"


class _InSight(Onset):
    visible_share: Annotated[Share, Field(gt=0)] = 0.1

    seen_by: ClassVar[Literal["ego", "any"]]

    def holds(self, view: OnsetView) -> Bool:
        return view.visible_share(self.seen_by) >= self.visible_share - 1e-9

    def label(self, object_class: str) -> str:
        return "in sight"

    def described(self, near: str) -> str:
        observer = "any unit" if self.seen_by == "any" else "a unit of the ego"
        return f"when {observer} sees {100 * self.visible_share:g} % of it"


class LineOfSightAny(_InSight):
    """Any unit sees at least this share of the object. Units that only some runs have do not count."""

    kind: Literal["line_of_sight_any"] = "line_of_sight_any"

    requires: ClassVar[Requires] = Requires.UNIT
    seen_by: ClassVar[Literal["ego", "any"]] = "any"


class LineOfSight(_InSight):
    """The ego's units see at least this share of the object."""

    kind: Literal["line_of_sight"] = "line_of_sight"

    requires: ClassVar[Requires] = Requires.UNIT_ON_EGO
    seen_by: ClassVar[Literal["ego", "any"]] = "ego"


class At(Onset):
    """An instant of the log, the same for all objects that are then in it."""

    kind: Literal["at"] = "at"
    time_s: NotNegative
    again_after_s: SkipJsonSchema[AgainAfter] = None  # refused

    @model_validator(mode="after")
    def _once(self) -> Self:
        if self.again_after_s is not None:
            raise ValueError("again_after_s: `at` is one instant, to which nobody comes back; leave it out")
        return self

    @property
    def instant_s(self) -> float:
        """The instant, `time_s`."""
        return self.time_s

    def holds(self, view: OnsetView) -> Bool:
        """(P,) true from the instant on."""
        return view.time_s >= self.time_s

    def label(self, object_class: str) -> str:
        """`clock starts`."""
        return "clock starts"

    def described(self, near: str) -> str:
        """The instant in seconds since the log's start."""
        return f"{self.time_s:g} s after the log’s start"


ONSETS = {
    "starts_moving": "copem_replay.metrics.onset:StartsMoving",
    "appears": "copem_replay.metrics.onset:Appears",
    "in_range": "copem_replay.metrics.onset:InRange",
    "line_of_sight": "copem_replay.metrics.onset:LineOfSight",
    "line_of_sight_any": "copem_replay.metrics.onset:LineOfSightAny",
    "at": "copem_replay.metrics.onset:At",
}
"""Built-in names of `measure: {onset: {kind: …}}`."""

"""What is read is checked here, by one table of findings for the truth, the lists of units, and poses.

`RULES` has a row for each finding: what is counted, and what is wrong and done about it. A `Finding` is its line, with
the rule, the number, and an example. Numbers that are none (NaN, infinite, beyond `MOST`) are unknown everywhere:
what cannot be without them is left out and counted, what can be is completed, and never taken for 0 without a word.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.errors import count_noun, escape_unprintable
from copem_replay.core.tracks import CLASSES, VALUES, Bool, Float, Int

FARTHEST_M = 1e7
"""A larger coordinate is no position: UTM northings end at 1e7."""
FASTEST_MPS = 100.0
"""A higher velocity is an error of the recording: no road user drives 360 km/h."""
LONGEST_M = 1000.0
"""A longer, wider or higher object is an error of the recording: no wall, train or building is."""
_WIDEST_M2 = 1e8
"""A larger variance of a position (10 km) says that nothing is known: drivers write 1e9, or the largest number."""
MOST_RAD = 1e4
"""A larger angle is none: at the latest then its fraction of a turn means nothing."""

X, Y, Z, YAW, VX, VY, LENGTH, WIDTH, HEIGHT = range(len(VALUES))
"""Columns of states, in the order of `tracks.VALUES`."""
_MOST = np.array([FARTHEST_M] * 3 + [MOST_RAD] + [np.finfo(float).max] * 2 + [LONGEST_M] * 3)
"""The largest number of each column that is one. Of velocities any is: those above `FASTEST_MPS` are told apart."""

# The table of findings.


@dataclass(frozen=True)
class Rule:
    """A row of the table. `noun`: what is counted; `words`: what is wrong, and what is done.

    `changes`: whether figures may depend on it; False: it is only said.
    """

    noun: str
    words: str
    changes: bool = True
    before: str = ""  # words before the number


_STATE = "object state"
RULES: Final = {
    # Numbers that are none.
    "position": Rule(_STATE, "without a position, or with one that is no number: skipped"),
    "far": Rule(_STATE, f"farther than {FARTHEST_M:g} m from the origin: skipped"),
    "yaw": Rule(_STATE, "whose yaw is no number: skipped"),
    "yaw unset": Rule(_STATE, "without orientation: yaw 0 taken"),
    "zero unset": Rule(_STATE, "with a number left out, as some writers do where it is 0: 0 taken", changes=False),
    "yaw unsaid": Rule(_STATE, "that does not say its heading: as written"),
    "no z": Rule(_STATE, "whose height above ground is said by none: z = 0 taken", changes=False),
    "no yaw": Rule(_STATE, "whose yaw is said by none: 0 taken"),
    "velocity": Rule(_STATE, "whose velocity is not given, unlike that of others: 0 taken"),
    "fast": Rule(_STATE, f"whose velocity exceeds {FASTEST_MPS:g} m/s: 0 taken"),
    "covariance": Rule(_STATE, "without a covariance, or with one that is none: taken as not said"),
    "existence": Rule(_STATE, "without an existence, or with one that is no probability: taken as not said"),
    "class share": Rule(_STATE, "whose probability of a class is none: taken as barely said"),
    "pose": Rule("pose", "whose numbers are none: skipped"),
    "pose velocity": Rule("pose", "whose velocity is none: taken as not said"),
    "no ground truth": Rule("message", "without global_ground_truth: skipped"),
    "polygon": Rule("stationary object", "whose base_polygon is no simple polygon: its box taken"),
    "prism": Rule("stationary object", "with a base_polygon: hides as that prism, and is no object", changes=False),
    "border point": Rule("point", "of borders of lanes with a number that is none: left out", changes=False),
    "undecoded": Rule("message", "cannot be decoded: skipped"),
    "cube": Rule("cube", "beside a larger one of the same entity: left out", changes=False),
    "stays unsaid": Rule("state", "in between that no message repeats: not taken, a list holds what its message says"),
    # Time.
    "stamp absent": Rule("message", "without timestamp: the time of logging taken"),
    "stamp zero": Rule("message", "with a time stamp of 0, which is none: the time of logging taken"),
    "stamp odd": Rule("message", "stamped by another clock than those before and after: the time of logging taken"),
    "stamp impossible": Rule("message", "with an impossible time stamp: the time of logging taken"),
    "stamp lost": Rule("message", "without timestamp, and logged at another time: skipped"),
    "two clocks": Rule(
        "",
        "poses on {topic} are from {first:.10g} to {last:.10g} s, the lists from {start:.10g} to {end:.10g} s: "
        "{apart:.6g} s apart, of two clocks",
    ),
    "late": Rule("message", "stamped earlier than the one before: sorted by time", changes=False),
    "again": Rule("message", "with the time stamp of another: the first kept"),
    # Lists of stations.
    "no station": Rule("message", "without the reference position of its station: skipped"),
    "stations": Rule("station", "beside the first sends on this topic: all are taken as one unit"),
    "older": Rule("message", "captured more than a second before the log begins: skipped"),
    "station clock": Rule(
        "message",
        "logged {apart:.3f} s after its reference time (leap seconds counted), of another clock: the time of logging "
        "taken, and `delay_s`",
    ),
    "measured apart": Rule(
        _STATE, "measured up to {most:.3f} s from others of its list: moved to them along its velocity", changes=False
    ),
    # Objects.
    "twice": Rule(_STATE, "of an id twice in a message: the first kept"),
    "class changes": Rule("object", "of changing class: the most frequent taken", changes=False),
    "class name": Rule(
        "object state",
        "with a class name that says nothing ({which}): read as other; "
        "`read: {{classes: {{NAME: car}}}}` says what it is",
    ),
    "class other": Rule("object state", "of a class that is no road user's ({which}): read as other", changes=False),
    "class unsaid": Rule(_STATE, "whose class, or kind of vehicle, is not said: taken as unknown"),
    "no id": Rule(_STATE, "without an id: skipped"),
    "stands": Rule(_STATE, "of what stands, not sent again: where it was"),
    "jump": Rule(
        "",
        "object {id} jumps by {far:.3g} m at {at:.3f} s: its track is cut there, {share:.0%} of its states are "
        "another object's or none",
    ),
    "places": Rule("object", "jump: ids look like places in the list, which no object keeps"),
    "twist": Rule(
        "",
        "object {id}: its velocity points across its path in {share:.0%} of the states in which it moves, first at "
        "{at:.3f} s (along the map, where the schema says along the object?): taken from the positions",
    ),
    "heading": Rule(
        "",
        "object {id}: its heading points across its path in {share:.0%} of the states in which it moves, first at "
        "{at:.3f} s: as it is",
    ),
    "flip": Rule(
        "",
        "object {id}: its heading turns by half a turn at once in {share:.0%} of its states, first at "
        "{at:.3f} s: as it is",
    ),
    "frameless": Rule(_STATE, "in no named frame: taken as in {frame}"),
    "ego listed": Rule(
        "", "object {id} is where {topic} says, in all lists that it is in: it is the ego, which it gives the size"
    ),
    # Sizes.
    "size negative": Rule(_STATE, "with a negative size: its amount taken"),
    "size lost": Rule(_STATE, "whose size is none: that of the same object at other times taken"),
    "size unknown": Rule(_STATE, "without a size, or with one that is none: that of its class taken"),
    # Velocities of the truth.
    "velocity unset": Rule(_STATE, "is not given: derived from the positions", changes=False, before="velocity of "),
    "velocity frozen": Rule(_STATE, "is 0 though the object moves: derived from the positions", before="velocity of "),
    "velocity fast": Rule(_STATE, f"exceeds {FASTEST_MPS:g} m/s: derived from the positions", before="velocity of "),
    "height": Rule("", "height implausible or missing: {which}"),
    "flat": Rule("", "every box is centred on z = 0: stood on z = 0"),
    "height is width": Rule("", "the height of every moving object equals its width, a known defect of exporters"),
    "velocity alone": Rule(_STATE, "cannot be derived (no neighbour): 0 taken", before="velocity of "),
}
"""All findings on what is read, of truth, lists and poses alike, in the order in which they are looked for."""


class Finding(str):
    """A line on what was read. `rule`: its row in `RULES`, "": none; `number`: how many things it is about."""

    rule: str
    number: int

    def __new__(cls, line: str, rule: str = "", number: int = 0) -> Self:
        """A line, by a rule, about so many things."""
        made = super().__new__(cls, line)
        made.rule, made.number = rule, number
        return made

    @property
    def changes(self) -> bool:
        """Whether figures may depend on it."""
        return self.rule in RULES and RULES[self.rule].changes

    def as_json(self) -> list[str | int]:
        """As plain data, of which `Finding(*data)` makes the same."""
        return [str(self), self.rule, self.number]

    def within(self, label: str) -> Finding:
        """The same, of what `label` names: `unit rsu: …`."""
        return Finding(f"{label}: {self}", self.rule, self.number)


def as_finding(line: str) -> Finding:
    """A line as a finding, on one line that can be printed."""
    if isinstance(line, Finding):
        return Finding(escape_unprintable(line), line.rule, line.number)
    return Finding(escape_unprintable(line))


def find_rule(notes: Iterable[str], rule: str) -> str | None:
    """The first finding of a rule among notes; None: there is none."""
    return next((note for note in notes if isinstance(note, Finding) and note.rule == rule), None)


def find(rule: str, count: int, *, noun: str = "", **words: Any) -> Iterator[Finding]:
    """The finding of a rule about `count` things; none of nothing. `words`: what its row leaves open."""
    if count:
        row = RULES[rule]
        counted = f"{row.before}{count_noun(count, noun or row.noun)} " if noun or row.noun else ""
        line = counted + row.words.format(**words)
        yield Finding(line, rule, count)


# States (P, V) whose numbers may be none.


@np.errstate(invalid="ignore", over="ignore")
def sift_states(values: Float, was_usable: Bool, findings: list[str]) -> tuple[Float, Bool]:
    """States (P, V) with NaN for every number that is none, and which of those `was_usable` so far can be used.

    A state needs a position and a yaw; what no state of all has, the format lacks: 0 then.
    """
    not_number = ~(np.abs(values) <= _MOST)
    if not not_number.any():
        return values, was_usable
    far = (np.abs(values[:, : Z + 1]) > FARTHEST_M).any(axis=1) & np.isfinite(values[:, : Z + 1]).all(axis=1)
    values = np.where(not_number, np.nan, values)
    for column, rule in ((Z, "no z"), (YAW, "no yaw")):
        if was_usable.any() and np.isnan(values[was_usable, column]).all():
            values[:, column] = 0.0
            findings += find(rule, int(was_usable.sum()))
    usable = was_usable.copy()
    nowhere = np.isnan(values[:, : Z + 1]).any(axis=1)
    for rule, rows in (("position", nowhere & ~far), ("far", far), ("yaw", np.isnan(values[:, YAW]))):
        findings += find(rule, int((usable & rows).sum()))
        usable &= ~rows
    return values, usable


# Sizes: those of a class where none is said.

BODIES_M = {
    "pedestrian": (0.5, 0.6, 1.75, 0.8),
    "bicycle": (1.8, 0.6, 1.7, 0.8),
    "motorcycle": (2.1, 0.8, 1.6, 0.8),
    "car": (4.5, 1.8, 1.5, 1.0),
    "van": (5.2, 2.0, 2.0, 1.4),
    "truck": (8.0, 2.5, 3.2, 1.5),
    "bus": (12.0, 2.55, 3.0, 2.0),
    "trailer": (8.0, 2.5, 3.0, 0.5),
    "animal": (1.0, 0.4, 0.7, 0.2),
    "other": (0.5, 0.5, 1.0, 0.05),
    "vehicle": (4.5, 1.8, 1.5, 0.5),
}
"""The typical length, width and height of each class, and the least plausible height, in m, rounded from real ones."""
TYPICAL_M = np.array([BODIES_M[name][:3] for name in CLASSES])
LEAST_HEIGHT_M = np.array([BODIES_M[name][3] for name in CLASSES])


@np.errstate(invalid="ignore", over="ignore")
def complete_sizes(values: Float, class_ix: NDArray[Any], object_ix: Int | None, findings: list[str]) -> Float:
    """States (P, V) with a size each. A negative one is its amount.

    One that is none is the median of the object's other ones (`object_ix (P,)`; None: objects are not known), else the
    typical one of its class `class_ix (P,)`. A height of an object that never states one is 0: `correct_heights`.
    """
    sizes = values[:, LENGTH:]
    if ((sizes > 0) & (sizes <= LONGEST_M)).all():
        return values
    sizes = np.abs(sizes)
    findings += find("size negative", int((values[:, LENGTH:] < 0).any(axis=1).sum()))
    plausible = (sizes > 0) & (sizes <= LONGEST_M)
    if object_ix is not None:
        plausible[:, 2] |= sizes[:, 2] == 0.0  # a height of 0 is told of with those that are implausible
    filled = np.where(plausible, sizes, np.nan)
    if object_ix is not None and not plausible.all():
        for number in np.unique(object_ix[~plausible.all(axis=1)]):
            rows = np.flatnonzero(object_ix == number)
            own = plausible[rows]
            for column in np.flatnonzero(own.any(axis=0) & ~own.all(axis=0)):
                filled[rows[~own[:, column]], column] = np.median(sizes[rows[own[:, column]], column])
    findings += find("size lost", int((~plausible & ~np.isnan(filled)).any(axis=1).sum()))
    unknown = np.isnan(filled)
    if object_ix is not None:
        filled[unknown[:, 2], 2] = 0.0
        unknown[:, 2] = False
    findings += find("size unknown", int(unknown.any(axis=1).sum()))
    filled = np.where(unknown, TYPICAL_M[class_ix], filled)
    return np.concatenate([values[:, :LENGTH], filled], axis=1)


# Entries of units' lists.


@np.errstate(invalid="ignore", over="ignore")
def complete_entries(values: Float, findings: list[str]) -> Float:
    """Sifted states (K, V) of entries as lists need them, without NaN: unknown velocities are 0."""
    values = values.copy()
    speed = np.hypot(values[:, VX], values[:, VY])
    unknown, fast = np.isnan(speed), speed > FASTEST_MPS
    if not unknown.all():
        findings += find("velocity", int(unknown.sum()))
    findings += find("fast", int(fast.sum()))
    values[unknown | fast, VX : VY + 1] = 0.0
    return values


@np.errstate(invalid="ignore", over="ignore")
def sift_covariances(covariance_m2: Float, findings: list[str]) -> tuple[Float, Bool]:
    """Covariances (P, 3) ee, en, nn, 0 where nothing is said, and (P,) whether each is said.

    0, and a variance of −1 as in ROS, say nothing; one that is no number, or not positive definite, is none.
    """
    ee, en, nn = covariance_m2.T
    said = (ee > 0) & (nn > 0) & (ee <= _WIDEST_M2) & (nn <= _WIDEST_M2) & (en * en < ee * nn)
    if said.any():  # else the format has none, and the experiment has to give it
        findings += find("covariance", int((~said).sum()))
    return np.where(said[:, None], covariance_m2, 0.0), said


MOST_SHARE = 100.0
"""Writers are known that state probabilities of classes in percent: a larger one is none."""


def sift_shares(share: Float, rule: str, findings: list[str], most: float = 1.0) -> Float:
    """Probabilities (P,) up to `most`, NaN where what is stated is none."""
    with np.errstate(invalid="ignore"):
        good = (share >= -_ROUNDING) & (share <= most + _ROUNDING)
    findings += find(rule, 0 if np.isnan(share).all() else int((~good).sum()))
    return np.clip(np.where(good, share, np.nan), 0.0, most)


_ROUNDING = 1e-3
"""A probability as little above 1 is 1: numbers of 16 bits, sums of shares."""

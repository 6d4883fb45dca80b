"""Object lists without truth: the input and output of fusions.

An *entry* is one object in one list, as a receiver has it: never with a truth id. Lists are NumPy arrays of the record
type `ENTRY`, so `entries["x_m"]` is a column and `entries[mask]` a shorter list. Letters: S runs, F lists of units,
K instants at which the receiver issues a fused list, U units, N entries of all lists together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.compiled import borrowing, kernel
from copem_replay.core.tracks import CLASSES, Float, Int

ENTRY = np.dtype(
    [
        ("x_m", "f8"),  # centre of the box, east, in the log's world frame
        ("y_m", "f8"),
        ("z_m", "f8"),
        ("yaw_rad", "f8"),
        ("vx_mps", "f8"),
        ("vy_mps", "f8"),
        ("length_m", "f8"),
        ("width_m", "f8"),
        ("height_m", "f8"),
        ("cov_ee_m2", "f8"),  # position covariance, easting and northing: positive definite
        ("cov_en_m2", "f8"),
        ("cov_nn_m2", "f8"),
        ("existence", "f8"),  # probability that there is an object, as the list claims
        ("class_probability", "f8", (len(CLASSES),)),  # by index into CLASSES
        ("captured_s", "f8"),  # in a unit's list: the list's; in a fused one: the newest that contributed
        ("unit_ix", "i8"),  # in a unit's list: that unit; in a fused one: the first contributor, −1: not stated
        ("track_id", "i8"),  # the track id that the list states, −1: none
    ]
)
"""One entry of an object list."""

NUMBERS = (ENTRY.itemsize - 2 * 8) // 8
"""So many numbers an entry begins with; two integers follow: `unit_ix`, `track_id`."""

COVARIANCES = ("cov_ee_m2", "cov_en_m2", "cov_nn_m2")

Entries = NDArray[Any]
"""(N,) of ENTRY."""

TellsOf = Literal["capture", "now"]
"""The instant that an entry tells of: its newest capture, or the instant its list is available."""


def take_entries(entries: Entries, rows: Int) -> Entries:
    """The entries at these rows. Copied as words of memory: several times as fast as field by field."""
    return _view_as_words(entries)[rows].view(ENTRY)[:, 0]


def join_entries(parts: Sequence[Entries]) -> Entries:
    """All entries one after the other, copied as `take_entries` does."""
    return np.concatenate([_view_as_words(entries_of(0)), *map(_view_as_words, parts)]).view(ENTRY)[:, 0]


def view_as_numbers(entries: Entries) -> Float:
    """Entries as rows of numbers (N, V), x and y first; only the first `NUMBERS` are numbers, integers follow."""
    return _view_as_words(entries).view(np.float64)


def _view_as_words(entries: Entries) -> Int:
    words: Int = np.ascontiguousarray(entries).view(np.int64).reshape(len(entries), ENTRY.itemsize // 8)
    return words


def entries_of(count: int) -> Entries:
    """Make a list of `count` entries that hold zeros, no unit and no track: a NumPy array (N,) with named columns.

    Metres, radians, m/s, m²; `existence` and `class_probability` are probabilities; `captured_s` is in seconds since
    the log's start.

    >>> entries = cr.entries_of(2)
    >>> entries["x_m"] = [10.0, 20.0]
    >>> entries[entries["x_m"] > 15]["track_id"]
    array([-1])
    """
    entries = np.zeros(count, dtype=ENTRY)
    entries["unit_ix"] = entries["track_id"] = -1
    return entries


@dataclass(frozen=True)
class ObjectLists:
    """Lists of S runs: list k of run s is `entries[start[s, k] : start[s, k + 1]]`, in no order that means anything.

    `start (S, K + 1)`, `entries (N,)`.

    >>> lists = cr.ObjectLists(np.array([[0, 2, 3]]), cr.entries_of(3))
    >>> len(lists.of(run=0, number=1))
    1
    """

    start: Int
    entries: Entries

    def of(self, run: int, number: int) -> Entries:
        """One list."""
        one: Entries = self.entries[self.start[run, number] : self.start[run, number + 1]]
        return one

    @property
    def longest(self) -> int:
        """The number of entries in the longest list."""
        return int(np.diff(self.start, axis=1).max(initial=0))


@dataclass(frozen=True)
class Inputs:
    """All lists of all units, the instants at which the receiver has each, and those at which it issues fused lists.

    List f is the same capture of the same unit in all runs; what is in it differs from run to run. Entries of one list
    are in a random order that is the same however the recording was ordered. Times are seconds since the log's start.
    `ListFusion.fuse` takes them.

    An entry of a unit that fuses others may be older than its list: `captured_s` of the entry says so.

    For a unit with partial messages `newest` names a list that is not among those that `arrived`: the newest entry of
    each of its objects, each with its own `captured_s`.

    >>> none = np.zeros(0, dtype=int)
    >>> lists = cr.ObjectLists(np.array([[0]]), cr.entries_of(0))
    >>> inputs = cr.Inputs(("ego",), none, none, none, lists, np.array([0.0]), np.array([[-1]]), none, np.array([0, 0]))
    >>> inputs.newest[0].tolist()
    [-1]
    """

    units: tuple[str, ...]  # U
    unit_ix: Int  # (F,) the unit of each list
    captured_s: Float  # (F,)
    arrives_s: Float  # (F,) inf: never
    lists: ObjectLists  # of the units: F lists in each of S runs
    issue_s: Float  # (K,) ascending
    newest: Int  # (K, U) each unit's newest list that has arrived and is not too old; −1: none
    arrived: Int  # (A,) lists in order of arrival; lists that never arrive are not among them
    arrived_start: Int  # (K + 1,) `arrived[arrived_start[k] : arrived_start[k + 1]]` arrive at instant k
    keeps_s: Float | None = None  # (U,) for how long an object that a unit's messages leave out may be there; None: 0


# The classes of entries.

_OTHER = CLASSES.index("other")


@borrowing
def most_probable_class(probability: Float) -> int:
    """Index of the largest of the probabilities `(C,)`, the first of equals; `other` where all are 0."""
    best = 0
    for c in range(1, len(probability)):
        if probability[c] > probability[best]:
            best = c
    return best if probability[best] > 0 else _OTHER


@kernel
def most_probable_classes(probability: Float) -> Int:
    """(N,) `most_probable_class` of each row of `probability (N, C)`."""
    best = np.empty(len(probability), np.int64)
    for i in range(len(probability)):
        best[i] = most_probable_class(probability[i])
    return best

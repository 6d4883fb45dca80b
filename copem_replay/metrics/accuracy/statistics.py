"""Accuracy of fused lists: definitions, and statistics that add up over runs, episodes and logs.

Statistics count once per fused list, at the instant it is available, in the lists at which there is a place to measure
distances from (the ego); they are not weighted by time. *Match*, *duplicate* and *ghost* are defined in
`metrics/matching.py`. An episode's *stay*: the lists from the first instant that object and ego share to the end of the
episode, except in gaps of the truth. An object is *looked at* in the lists of its stay from the onset on.

There are matches of two kinds, by the same rules: at the instant the entry *tells of*, for what it states of an object,
and *now*, at the instant the list is available, for what the list is worth. *Pairs* are matches of the first kind.

Over the pairs of the stay, a gap of the truth at the list's instant included; an episode without pairs has no value and
no part in means:

- position error (m): to the truth at the list's instant, so latency counts in full, whatever the gate; *at its
  instant*: to the truth at the instant the entry tells of. Bias (m): entry minus truth, east and north. Velocity error
  (m/s): length of the difference. RMSE: root mean square. Where the truth has a gap at the list's instant the pair is
  not *placed*: it has neither position error nor bias nor velocity error, but all else.
- age (s): available minus captured.
- NEES (1): eᵀ P⁻¹ e of the position at the entry's instant, P as claimed, its eigenvalues at least 1e-9 m². The gate
  lets no larger errors through, so where P is true the mean is `nees_expected`, 2 or less
  (`metrics/accuracy/kernel.py`), and the share `beyond_gate` of such errors makes no pair. Its 95 % band is for as many
  independent samples as there are rows, run × object, with a pair, for lists are not independent.
- identity switches (1): pairs of another track than the object's last pair that named a track.

Over an episode, by matches now; an object that is never matched has the worst value:

- longest time unknown (MTL, s): from onset to end it is known from a list with a match to the next list without one.
  The last list of the stay before the onset says whether it was known at the onset; before the first list it is
  unknown. Never matched: the whole episode.
- missed (1): lists looked at that hold no match. Duplicates (1): in lists looked at.

Over all lists:

- ghosts (1): about nobody, neither at the instant they tell of nor now, of measured classes. Each goes to the nearest
  object looked at, if there is one. *Stale* entries are about somebody then, and at nobody now; they are no ghosts.
- GOSPA (m, α = 2, cut-off c, power p): of what is looked at in a list against the entries that belong to it, and those
  at nobody now, stale or not; entries of what is not looked at now (an unmeasured object, the ego) are left out. Pairs
  are the best ones by distance, not those of the match. dᵖ, and cᵖ/2 of a miss, are the object's part, cᵖ/2 of a false
  entry is the part of the nearest one looked at. Mean of GOSPAᵖ over the lists in which something is looked at, to the
  power 1/p. Never matched: cᵖ/2 in each list.
- where the truth is not annotated an entry that is at no object now is no ghost, and in no GOSPA, OSPA or ghost count;
  one at no object at the instant it tells of does not count for the existence.
- OSPA (m): of the same two sets; mean over the same lists.
- existence: calibrated when a share p of the entries with existence p is about an object, at the instant they tell of.
  In ten bins of equal width, over the entries of measured classes, duplicates being of an object too. Expected
  calibration error: mean over the entries of their bin's |share − mean existence|.

Sources: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", Wiley 2001,
5.4 (NEES); M. P. Naeini, G. F. Cooper, M. Hauskrecht, "Obtaining well calibrated probabilities using Bayesian binning",
AAAI 2015 (expected calibration error); GOSPA and OSPA: `metrics/gospa.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.tracks import Int
from copem_replay.metrics.accuracy.kernel import Records

EXISTENCE_BINS = 10
"""Bins of equal width, as many as in Naeini et al. 2015."""

_LISTS = [("looked", "i8"), ("missed", "i8"), ("ghosts", "i8")]
_PAIRS = [
    ("pairs", "i8"),
    ("placed", "i8"),  # of these, where the object is there when the list is available: of them the next three
    ("square_m2", "f8"),
    ("east_m", "f8"),
    ("north_m", "f8"),
    ("nees", "f8"),
    ("nees_expected", "f8"),
]
BAND = np.dtype(_LISTS + _PAIRS)
"""Sums of one band: lists looked at, of these missed, ghosts; pairs, Σ e², Σ of the errors east and north, Σ NEES."""

OBJECT = np.dtype(
    [
        *_LISTS,
        *_PAIRS,
        ("nees_square_expected", "f8"),
        ("beyond_gate", "f8"),
        ("square_then_m2", "f8"),  # at the instants the entries tell of
        ("velocity_square_m2ps2", "f8"),  # of placed ones
        ("age_of_information_s", "f8"),
        ("tracked", "i8"),  # pairs whose entry names a track
        ("switches", "i8"),
        ("duplicates", "i8"),
        ("longest_gap_s", "f8"),
        ("gospa_localisation", "f8"),  # m to the power p, as the next two
        ("gospa_missed", "f8"),
        ("gospa_false", "f8"),
    ]
)
"""Sums of one episode: those of `BAND`, and further ones (`longest_gap_s`: the longest)."""

RUN = np.dtype(
    [
        ("lists", "i8"),  # at which there is a place to measure from
        ("time_s", "f8"),  # from the first of them to the last, but between neighbours only
        ("ospa_m", "f8"),
        ("ghosts", "i8"),
        ("stale_ghosts", "i8"),
        ("duplicates", "i8"),  # of measured objects, looked at or not
        ("lists_looked", "i8"),  # in which something is looked at
        ("unannotated", "i8"),  # entries of measured classes that would be ghosts where the truth is annotated
    ]
)
"""Sums of one run."""

EXISTENCE = np.dtype([("entries", "i8"), ("existence", "f8"), ("with_object", "i8")])
"""Sums of one bin of existence."""


@dataclass(frozen=True)
class AccuracySettings:
    """Parameters of accuracy. A band includes its lower edge, not its upper one; a value may be in no band.

    `distance_edges_m`: from the reference to the true object, or to the ghost; `time_edges_s`: of the log.
    """

    cutoff_m: float  # of GOSPA
    gate_m: float  # of the matches
    power: float = 2.0
    distance_edges_m: tuple[float, ...] = ()
    time_edges_s: tuple[float, ...] = ()
    existence_thresholds: tuple[float, ...] = ()
    annotated_m: tuple[tuple[float, float], ...] = ()  # corners of the annotated area; none: everywhere
    annotated_range_m: float = np.inf  # radius of the annotated area around the reference


@dataclass(frozen=True)
class Accuracy:
    """Statistics of S runs, not summed over runs: blocks of any size give the same total."""

    settings: AccuracySettings
    first_list: Int  # (M,) of the stay: its lists are first_list … first_list + count − 1
    count: Int  # (M,)
    error_m: NDArray[np.float32]  # (S, L) episode after episode, L = Σ count: position error; NaN: no placed pair
    gospa: NDArray[np.float32]  # (S, L) the object's part of GOSPAᵖ; NaN: not looked at
    by_object: Records  # (S, M) of OBJECT
    by_run: Records  # (S,) of RUN
    ghosts_at: Int  # (S, T) ghosts of at least each of the existence thresholds
    by_distance: Records  # (S, bands) of BAND
    by_time: Records  # (S, bands) of BAND
    by_existence: Records  # (S, EXISTENCE_BINS) of EXISTENCE

    def of_run(self, s: int) -> Accuracy:
        """The statistics of run s, with S = 1."""
        columns: dict[str, Any] = {name: getattr(self, name)[s : s + 1] for name in _PER_RUN}
        return replace(self, **columns)


_PER_RUN = tuple(f.name for f in fields(Accuracy) if f.name not in ("settings", "first_list", "count"))


def repeat_for_runs(accuracy: Accuracy, runs: int) -> Accuracy:
    """The statistics of `runs` equal runs, from those of one."""
    if len(accuracy.by_run) == runs:
        return accuracy
    columns: dict[str, Any] = {
        name: np.broadcast_to(getattr(accuracy, name), (runs, *getattr(accuracy, name).shape[1:])) for name in _PER_RUN
    }
    return replace(accuracy, **columns)


@dataclass(frozen=True)
class AccuracyTotal:
    """Sums over runs and episodes; totals of several logs add up."""

    settings: AccuracySettings
    rows: int  # episodes × runs
    matched_rows: int  # with a pair at least
    tracked_rows: int  # with a pair at least whose entry names a track
    episodes: Any  # one OBJECT
    runs: Any  # one RUN
    ghosts_at: Int  # (T,)
    by_distance: Records  # (bands,) of BAND
    by_time: Records  # (bands,) of BAND
    by_existence: Records  # (EXISTENCE_BINS,) of EXISTENCE

    def __add__(self, other: AccuracyTotal) -> AccuracyTotal:
        if self.settings != other.settings:
            raise ValueError("Total: expected the same settings")
        sums: dict[str, Any] = {}
        for name in (f.name for f in fields(AccuracyTotal) if f.name != "settings"):
            mine, others = getattr(self, name), getattr(other, name)
            records = getattr(getattr(mine, "dtype", None), "names", None)
            sums[name] = _sum_pairwise(np.stack([mine, others])) if records else mine + others
        return replace(self, **sums)


def sum_accuracy(parts: Sequence[Accuracy]) -> AccuracyTotal:
    """Sums over episodes and all runs, in the order of `parts`: equal to the last bit for parts of any size.

    Runs add up pairwise, as the leaves of a tree: two neighbours, then two neighbouring pairs, … So the sum of runs
    that begin at a multiple of a power of two, at most as many as that power, is a part of the sum of all
    (`join_totals`).
    """

    def all_runs(name: str) -> Any:
        return np.concatenate([getattr(part, name) for part in parts])

    episodes = all_runs("by_object")
    return AccuracyTotal(
        parts[0].settings,
        episodes.size,
        int((episodes["pairs"] > 0).sum()),
        int((episodes["tracked"] > 0).sum()),
        _sum_pairwise(_sum_pairwise(episodes.T)),
        _sum_pairwise(all_runs("by_run")),
        all_runs("ghosts_at").sum(axis=0),
        *(_sum_pairwise(all_runs(name)) for name in ("by_distance", "by_time", "by_existence")),
    )


def join_totals(parts: Sequence[tuple[int, AccuracyTotal]]) -> AccuracyTotal:
    """The total over all runs, equal to that of `sum_accuracy`, from parts (number of runs, total) of neighbouring
    runs.

    The number of runs of each part but the last is a power of two, and the part begins at a multiple of it.
    """
    nodes: list[tuple[int, AccuracyTotal]] = []
    for node in parts:
        nodes.append(node)
        while len(nodes) > 1 and nodes[-1][0] == nodes[-2][0]:
            (size, last), (_, before) = nodes.pop(), nodes.pop()
            nodes.append((2 * size, before + last))
    _, result = nodes.pop()
    while nodes:  # a node without a neighbour of its size is passed up
        result = nodes.pop()[1] + result
    return result


def _sum_pairwise(records: Records) -> Records:
    """Pairwise sums over the first axis, field by field."""
    sums: Records = np.zeros(records.shape[1:], dtype=records.dtype)
    for name in records.dtype.names or () if len(records) else ():
        values = records[name]
        while len(values) > 1:
            pairs = values[::2].copy()
            pairs[: len(values) // 2] += values[1::2]
            values = pairs
        sums[name] = values[0]
    return sums

"""Fusions as components: the base classes, the check of their answers, and the recorded output of a stack as a fusion.

All fusions but the ideal one see lists without truth, and only those that have arrived.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self, get_args

import numpy as np
from pydantic import Field, model_validator

from copem_replay.core.compiled import kernel
from copem_replay.core.components import Component, Frozen, GivenError, Positive, ask_component, wrong_answer_error
from copem_replay.core.object_list import (
    COVARIANCES,
    ENTRY,
    NUMBERS,
    Entries,
    Inputs,
    ObjectLists,
    TellsOf,
    view_as_numbers,
)
from copem_replay.core.tracks import SAME_INSTANT_S, Bool, Float, Int


class Fusion(Component, ABC):
    """Base of everything that `fusion:` may name."""


class ConstantVelocity(Frozen):
    """What ideal fusion remembers: a constant-velocity Kalman filter per object, with the motion model of `tracker`."""

    kind: Literal["constant_velocity"] = "constant_velocity"
    acceleration_psd_m2ps3: Positive = 1.0
    speed_sigma_mps: Positive = 3.0


class IdealFusion(Fusion):
    """The paper's Ideal Fusion Model: matching by truth id, inverse-variance combination (fusion/ideal.py).

    `combine: samples` weighs the units' sampled errors (with random numbers common to all configurations), `combine:
    posterior` draws once from N(μ, Σ); both have the same distribution. `memory`: it lists the same objects, each as
    all entries so far have it, at the instant of the list (fusion/ideal_memory.py); None: nothing is remembered.
    """

    kind: Literal["ideal"] = "ideal"
    combine: Literal["samples", "posterior"] = "samples"
    memory: ConstantVelocity | None = Field(default=None, exclude_if=lambda value: value is None)

    @model_validator(mode="after")
    def _samples(self) -> Self:
        if self.memory is not None and self.combine == "posterior":
            raise ValueError("memory: expected combine: samples, for a filter takes in sampled errors")
        return self

    @property
    def tells_of(self) -> TellsOf:
        """Whether an entry shows the object at its newest capture, or, with memory, at the instant of the list."""
        return "capture" if self.memory is None else "now"


class ListFusion(Fusion):
    """Base of fusions without truth ids: they fuse all runs and instants at once.

    >>> class Nothing(cr.ListFusion):
    ...     def fuse(self, reports):
    ...         shape = (len(reports.lists.start), len(reports.issue_s) + 1)
    ...         return cr.ObjectLists(np.zeros(shape, dtype=np.int64), cr.entries_of(0))
    >>> Nothing(kind="my_package.fusions:Nothing").resumable
    False
    """

    resumable: ClassVar[bool] = False
    """Whether `resume` gives, chunk after chunk of the instants, the very lists of `fuse`; if not, all instants are
    handed over at once. A class that overrides `fuse` has to declare it anew."""

    remembers: ClassVar[bool] = False
    """Whether a list depends on lists before those in use, as a tracker's: `compare` then holds accuracy against ideal
    fusion with memory, where there is one."""

    tells_of: ClassVar[TellsOf] = "capture"
    """Whether an entry shows the object as it was at its newest capture, or brought to the instant of the list (`now`).
    What an entry is about is asked of the truth at that instant. A property of the class: never of a configuration, nor
    of an entry, which could then claim the instant that suits it."""

    def __init_subclass__(cls, **given: Any) -> None:
        super().__init_subclass__(**given)
        if "fuse" in vars(cls) and "resumable" not in vars(cls):
            cls.resumable = False

    @classmethod
    def __pydantic_init_subclass__(cls, **given: Any) -> None:
        super().__pydantic_init_subclass__(**given)
        if "tells_of" in cls.model_fields:
            raise TypeError("tells_of: expected a property of the class, `tells_of: ClassVar[TellsOf]`, found a field")
        if cls.tells_of not in get_args(TellsOf):
            raise TypeError(f"tells_of: expected {' or '.join(get_args(TellsOf))}, found {cls.tells_of!r}")

    @property
    def looks_back_s(self) -> float:
        """Seconds that lists of an earlier time chunk stay needed, beside those in `newest`.

        A list is needed if it was captured at most so long before the newest capture that had arrived by the chunk's
        begin. The time counts from that capture, not from the chunk's first instant, since all lists may come late.
        """
        return 0.0

    @abstractmethod
    def fuse(self, inputs: Inputs) -> ObjectLists:
        """One fused list per instant and run, `start (S, K + 1)`.

        The list of instant k may depend on nothing that arrives later, nor on other runs, nor on the order of
        entries or units. Of its entries `captured_s` is the newest capture that contributed, that of a list that has
        arrived, `unit_ix` a unit that did, chosen by what entries say (−1: not said), `track_id` an identity over time
        (−1: the algorithm keeps none).
        """

    def resume(self, inputs: Inputs, memory: Any) -> tuple[ObjectLists, Any]:
        """The lists of the next time chunk of instants, and what is to be remembered for the one after it.

        Time chunks are consecutive, and lists of units have the same numbers in all. `memory`: what the last call gave,
        None at first; each is handed over once. As it stands here a fusion without memory is resumed: the list of an
        instant depends on the lists in `newest` and `arrived` alone.
        """
        return self.fuse(inputs), None


@dataclass(frozen=True)
class UnitList:
    """One list of one unit, its entries in no order that means anything."""

    unit: str
    captured_s: float
    arrives_s: float
    entries: Entries


@dataclass(frozen=True)
class Inbox:
    """The lists that the receiver has at one instant.

    `newest`: each unit's newest list, if it is not older than `max_age_s` (in the order of the experiment's units).
    `arrived`: the lists that arrive at this very instant, in order of capture; old ones that come late are among them.

    >>> cr.Inbox(newest=(), arrived=()).newest
    ()
    """

    newest: tuple[UnitList, ...]
    arrived: tuple[UnitList, ...]


class StepFusion(ListFusion):
    """Base of fusions in plain Python: one instant at a time. Derive your own from this.

    >>> class Newest(cr.StepFusion):
    ...     def step(self, now_s, inbox, memory):
    ...         return np.concatenate([cr.entries_of(0), *(one.entries for one in inbox.newest[:1])]), memory
    >>> Newest(kind="my_package.fusions:Newest").step(0.0, cr.Inbox((), ()), None)[0].shape
    (0,)
    """

    resumable: ClassVar[bool] = True

    @abstractmethod
    def step(self, now_s: float, inbox: Inbox, memory: Any) -> tuple[Entries, Any]:
        """The fused list of this instant, and what is to be remembered until the next (`memory`: None at first)."""

    def fuse(self, inputs: Inputs) -> ObjectLists:
        """Every run by itself, instant after instant."""
        return self.resume(inputs, None)[0]

    def resume(self, inputs: Inputs, memory: Any) -> tuple[ObjectLists, Any]:
        """The lists at the next instants, and each run's memory after them. GivenError: a step gives no such pair."""
        runs, instants = len(inputs.lists.start), len(inputs.issue_s)
        start = np.zeros((runs, instants + 1), dtype=np.int64)
        entry_parts: list[Entries] = []
        entry_count = 0
        memories = [None] * runs if memory is None else list(memory)
        for s in range(runs):
            start[s, 0] = entry_count
            for k in range(instants):
                answer = self.step(float(inputs.issue_s[k]), make_inbox(inputs, s, k), memories[s])
                if not isinstance(answer, tuple) or len(answer) != 2:
                    raise GivenError("step", f"expected a list and a memory, found {type(answer).__name__}")
                entries, memories[s] = answer
                if not isinstance(entries, np.ndarray) or entries.dtype != ENTRY or entries.ndim != 1:
                    found = entries.dtype.name if isinstance(entries, np.ndarray) else type(entries).__name__
                    raise GivenError("step", f"expected a list (an array of ENTRY) and a memory, found {found}")
                entry_parts.append(entries)
                entry_count += len(entries)
                start[s, k + 1] = entry_count
        return ObjectLists(start, np.concatenate([inputs.lists.entries[:0], *entry_parts])), memories


def ask_fusion(fusion: ListFusion, inputs: Inputs, where: str) -> ObjectLists:
    """The lists that a fusion gives, checked. Raises InputError, naming `where` it stands, for others."""
    return _check_lists(ask_component(fusion, where, lambda: fusion.fuse(inputs)), fusion, inputs, where)


def ask_resumed_fusion(fusion: ListFusion, inputs: Inputs, memory: Any, where: str) -> tuple[ObjectLists, Any]:
    """The lists that a `resumable` fusion gives for the next time chunk, checked as by `ask_fusion`, and its memory."""
    answer = ask_component(fusion, where, lambda: fusion.resume(inputs, memory))
    if problem := pair_problem(answer):
        raise wrong_answer_error(fusion, where, problem, "resume")
    lists, memory = answer
    return _check_lists(lists, fusion, inputs, where), memory


def _check_lists(answer: ObjectLists, fusion: ListFusion, inputs: Inputs, where: str) -> ObjectLists:
    """The lists found. Raises InputError where their form or content is wrong."""
    problem = form_problem(answer, inputs) or content_problem(answer, inputs)
    if problem is not None:
        raise wrong_answer_error(fusion, where, problem, "step", "fuse", "resume")
    return answer


def pair_problem(answer: object) -> str | None:
    """The problem with the form of the answer of `resume`; None: it is a pair."""
    if isinstance(answer, tuple) and len(answer) == 2:
        return None
    return f"resume: expected ObjectLists and a memory, found {type(answer).__name__}"


def form_problem(answer: object, inputs: Inputs) -> str | None:
    """The problem with the form of the lists that a fusion returned; None: there is none."""
    shape = (len(inputs.lists.start), len(inputs.issue_s) + 1)
    if not isinstance(answer, ObjectLists):
        return f"fuse: expected Lists, found {type(answer).__name__}"
    if answer.start.shape != shape or answer.entries.dtype != ENTRY:
        return (
            f"fuse: expected lists of ENTRY with start {shape}, found {answer.entries.dtype.name} with start "
            f"{answer.start.shape}"
        )
    begin, end = np.append(answer.start[:, 0], len(answer.entries)), np.append(0, answer.start[:, -1])
    if answer.start.dtype != np.int64 or (begin != end).any() or (np.diff(answer.start) < 0).any():
        expected = f"expected start of whole numbers from 0 to {len(answer.entries)}, list after list, run after run"
        return f"{expected}, found {answer.start.tolist()}"
    return None


def content_problem(answer: ObjectLists, inputs: Inputs) -> str | None:
    """The problem with the entries of lists in a valid form; None: there is none."""
    if not np.isfinite(view_as_numbers(answer.entries)[:, :NUMBERS]).all():
        name = next(each for each in ENTRY.names or () if not np.isfinite(answer.entries[each]).all())
        return f"{name}: expected numbers, found NaN or infinity"
    existence = answer.entries["existence"]
    if ((existence < -1e-9) | (existence > 1 + 1e-9)).any():
        return f"existence: expected probabilities, found {existence.min():g} … {existence.max():g}"
    ee, en, nn = (answer.entries[name] for name in COVARIANCES)
    if ((ee <= 0) | (nn <= 0) | (ee * nn - en * en <= 0)).any():
        return "cov_*_m2: expected positive definite covariances"
    if not (arrived := _has_arrived(answer, inputs)).all():
        wrong = float(answer.entries["captured_s"][np.argmin(arrived)])
        return f"captured_s: expected the capture of a list that has arrived, found {wrong:.9g} s"
    if _has_track_twice(answer):
        return "track_id: expected each once in a list, found one twice (−1: no track is kept)"
    unit_ix = answer.entries["unit_ix"]
    if ((unit_ix < -1) | (unit_ix >= len(inputs.units))).any():
        return f"unit_ix: expected −1 … {len(inputs.units) - 1}, found {unit_ix.min()} … {unit_ix.max()}"
    return None


def _has_track_twice(answer: ObjectLists) -> bool:
    """Whether a list has two entries of one track."""
    tracked = np.flatnonzero(answer.entries["track_id"] >= 0)
    if not len(tracked):
        return False
    track_id = answer.entries["track_id"][tracked]
    of_list = np.repeat(np.arange(answer.start[:, 1:].size), np.diff(answer.start, axis=1).ravel())[tracked]
    order = np.lexsort((track_id, of_list))
    return bool(((np.diff(of_list[order]) == 0) & (np.diff(track_id[order]) == 0)).any())


def _has_arrived(answer: ObjectLists, inputs: Inputs) -> Bool:
    """(N,) whether a list, or an entry, of the capture that each entry states has arrived when its list is issued."""
    lengths, entry_s = np.diff(inputs.lists.start), inputs.lists.entries["captured_s"]
    older_entries = np.flatnonzero(entry_s != np.repeat(np.tile(inputs.captured_s, len(lengths)), lengths.ravel()))
    frame = np.repeat(np.tile(np.arange(len(inputs.captured_s)), len(lengths)), lengths.ravel())[older_entries]
    captured_s, capture_ix = np.unique(np.append(inputs.captured_s, entry_s[older_entries]), return_inverse=True)
    first_s = np.full(len(captured_s), np.inf)
    np.minimum.at(first_s, capture_ix, np.append(inputs.arrives_s, inputs.arrives_s[frame]))
    has_arrived: Bool = np.zeros(len(answer.entries), dtype=bool)
    if len(captured_s):
        entry_s = np.ascontiguousarray(answer.entries["captured_s"])
        _mark_arrived(answer.start, entry_s, inputs.issue_s, captured_s, first_s, SAME_INSTANT_S, has_arrived)
    return has_arrived


@kernel
def _mark_arrived(
    start: Int, entry_s: Float, issue_s: Float, captured_s: Float, first_s: Float, tolerance_s: float, arrived: Bool
) -> None:
    """Sets `arrived (N,)` where a list of the stated capture has arrived; captures (C,) ascend, `first_s`: arrival."""
    for s in range(len(start)):
        f = 0
        for k in range(len(issue_s)):
            for i in range(start[s, k], start[s, k + 1]):
                from_s = entry_s[i] - tolerance_s
                # Entries of one list were mostly captured together, so the last place is tried first.
                if captured_s[f] < from_s or (f > 0 and captured_s[f - 1] >= from_s):
                    f = np.searchsorted(captured_s, from_s)
                q = f
                while q < len(captured_s) and captured_s[q] <= entry_s[i] + tolerance_s and not arrived[i]:
                    arrived[i] = first_s[q] <= issue_s[k] + tolerance_s
                    q += 1
                f = min(f, len(captured_s) - 1)


def make_inbox(inputs: Inputs, run: int, instant: int) -> Inbox:
    """The lists that the receiver has at one instant of one run."""

    def unit_list(f: int) -> UnitList:
        entries = inputs.lists.of(run, f).copy()  # a caller that changes it changes a copy
        return UnitList(
            inputs.units[inputs.unit_ix[f]], float(inputs.captured_s[f]), float(inputs.arrives_s[f]), entries
        )

    newest = [int(f) for f in inputs.newest[instant] if f >= 0]
    arrived = inputs.arrived[inputs.arrived_start[instant] : inputs.arrived_start[instant + 1]]
    in_order = arrived[np.lexsort((inputs.unit_ix[arrived], inputs.captured_s[arrived]))]
    return Inbox(tuple(map(unit_list, newest)), tuple(unit_list(int(f)) for f in in_order))


class RecordedFusion(ListFusion):
    """Nothing is fused: the list that arrives at an instant is the fused list. Its states are of their stamp.

    An experiment does not name it: `recorded:` of a configuration stands for it.
    """

    resumable: ClassVar[bool] = True

    kind: Literal["recorded"] = "recorded"

    def fuse(self, inputs: Inputs) -> ObjectLists:
        """At each instant the newest list that arrives; `unit_ix` is −1, as no unit contributes."""
        newest = np.array([_newest_list(inputs, k) for k in range(len(inputs.issue_s))], dtype=np.int64)
        begin = inputs.lists.start
        lengths = (begin[:, 1:] - begin[:, :-1])[:, newest]
        ends = np.cumsum(lengths.ravel()).reshape(lengths.shape)
        start = np.concatenate([np.append(0, ends[:-1, -1:].ravel())[:, None], ends], axis=1)
        first = np.repeat(begin[:, :-1][:, newest].ravel() - (ends - lengths).ravel(), lengths.ravel())
        entries = inputs.lists.entries[first + np.arange(len(first))]
        entries["unit_ix"] = -1
        _drop_repeated_tracks(entries, np.repeat(np.arange(lengths.size), lengths.ravel()))
        return ObjectLists(start, entries)


class PredictedFusion(RecordedFusion):
    """The recorded output of a stack that brings its states to the instant at which its list is available."""

    resumable: ClassVar[bool] = True
    tells_of: ClassVar[TellsOf] = "now"


def _newest_list(inputs: Inputs, instant: int) -> int:
    """The list with the last capture among those that arrive at an instant."""
    arrived = inputs.arrived[inputs.arrived_start[instant] : inputs.arrived_start[instant + 1]]
    return int(arrived[np.argmax(inputs.captured_s[arrived])])


def _drop_repeated_tracks(entries: Entries, of_list: Int) -> None:
    """Set ids that a list has twice to −1, in place: it is not known which entry is the track."""
    tracked = np.flatnonzero(entries["track_id"] >= 0)
    keys = np.stack([of_list[tracked], entries["track_id"][tracked]])
    _, back, count = np.unique(keys, axis=1, return_inverse=True, return_counts=True)
    entries["track_id"][tracked[count[back.ravel()] > 1]] = -1

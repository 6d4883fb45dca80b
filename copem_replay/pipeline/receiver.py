"""The receiver: what it makes of the lists that arrive, configuration by configuration (f of the paper's coPEM).

It goes by the true captures: a list's age, which of a unit's lists is its newest, when it arrives, and whether an entry
was captured since the onset. Only a fusion is told of stated captures, where a unit's clock is off: of which instant an
entry tells is what is stated, as a clock error is an error.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from copem_replay.communication.arrivals import FusionSchedule, SentEntries, fusion_schedule, keep_entries
from copem_replay.core.compiled import borrowing_kernel
from copem_replay.core.fused_tracks import EntrySources, FusedTracks, find_newest_and_first
from copem_replay.core.interpolation import AROUND_S
from copem_replay.core.object_list import COVARIANCES, ENTRY, Entries, ObjectLists, TellsOf
from copem_replay.core.random import CounterRng, RandomKey
from copem_replay.core.tracks import (
    NO_CAPTURE_NS,
    SAME_INSTANT_S,
    TRUTH,
    VALUES,
    Bool,
    Float,
    Int,
    Scene,
    TimeChunk,
    Tracks,
    UnitFaults,
)
from copem_replay.experiment.schema import Configuration
from copem_replay.fusion.ideal import (
    draw_posterior,
    find_lists_beside_newest,
    floor_covariances,
    fuse_ideal,
    keep_by_object,
)
from copem_replay.fusion.ideal_memory import remember_states
from copem_replay.fusion.inputs import add_kept_entries, make_entry_lists, make_inputs
from copem_replay.fusion.interface import (
    IdealFusion,
    ListFusion,
    RecordedFusion,
    ask_fusion,
    ask_resumed_fusion,
)
from copem_replay.metrics.matching import DUPLICATE, MATCH, Matches
from copem_replay.metrics.origin import (
    GoesBack,
    OriginLists,
    Origins,
    find_earliest_origin_s,
    find_longest_way_s,
)
from copem_replay.perception.perceive import clock_errors_s
from copem_replay.pipeline.expansion import ExpandedExperiment
from copem_replay.pipeline.world import States, Transmission, WorldChunk

# Tracks with truth ids ↔ lists without: every fusion is measured, written and shown alike.


class ListsWithIds(NamedTuple):
    """Lists, and the truth ids of their entries (N,); empty: they have none."""

    lists: ObjectLists
    object_ix: Int


def convert_to_lists(fused_tracks: FusedTracks, scene: Scene) -> ListsWithIds:
    """Fused tracks of ideal fusion, or of the truth itself, as lists: existence is 1 and the class is certain.

    No entry has a track id (−1): truth ids are no tracks, and such fusion confuses no two objects.
    """
    fused = fused_tracks.fused
    order, bounds = fused.by_frame
    start = np.zeros((len(fused.valid), len(bounds)), dtype=np.int64)
    entries = np.empty(int(fused.valid.sum()), dtype=ENTRY)
    object_ix = np.empty(len(entries), dtype=np.int64)
    states = np.stack(np.broadcast_arrays(*(getattr(fused, name) for name in VALUES), *floor_covariances(fused)))
    words = entries.view(np.float64).reshape(len(entries), ENTRY.itemsize // 8)
    ids = entries.view(np.int64).reshape(words.shape)
    _fill_words(
        fused.valid,
        order,
        bounds,
        states,
        scene.object_class[fused.row_object_ix],
        fused_tracks.sources,
        start,
        words,
        ids,
        fused.row_object_ix,
        object_ix,
    )
    return ListsWithIds(ObjectLists(start, entries), object_ix)


_CAPTURED = ENTRY.itemsize // 8 - 3
_UNIT, _TRACK = _CAPTURED + 1, _CAPTURED + 2
_EXISTENCE = len(VALUES) + len(COVARIANCES)
_CLASS = _EXISTENCE + 1
"""Places in an entry, in words of eight bytes; states and covariances stand before them."""


@borrowing_kernel
def _fill_words(
    valid: Bool, order: Int, bounds: Int, states: Float, classes: NDArray[np.int8], source: EntrySources,
    start: Int, words: Float, ids: Int, row_object_ix: Int, object_ix: Int,
) -> None:  # fmt: skip
    """Fills `words` and `ids` (the same memory as numbers and integers), `object_ix` and `start`, by run and list."""
    n = 0
    for s in range(valid.shape[0]):
        start[s, 0] = n
        for f in range(len(bounds) - 1):
            for p in order[bounds[f] : bounds[f + 1]]:
                if not valid[s, p]:
                    continue
                for v in range(_EXISTENCE):
                    words[n, v] = states[v, s if states.shape[1] > 1 else 0, p]
                words[n, _EXISTENCE] = 1.0
                words[n, _CLASS:_CAPTURED] = 0.0
                words[n, _CLASS + classes[p]] = 1.0
                words[n, _CAPTURED], ids[n, _UNIT] = find_newest_and_first(source, s, p)
                ids[n, _TRACK], object_ix[n] = -1, row_object_ix[p]
                n += 1
            start[s, f + 1] = n


@dataclass(frozen=True)
class FusedOnce:
    """The ideal fusion of lists of the same captures, shared by configurations that differ in latency."""

    sent: Tracks
    captures: bytes
    fused_tracks: FusedTracks

    @cached_property
    def _lists(self) -> ListsWithIds:
        assert self.fused_tracks.scene is not None
        return convert_to_lists(self.fused_tracks, self.fused_tracks.scene)

    def lists_arriving(self, received: Tracks) -> ListsWithIds | None:
        """The fused lists, for the same inputs at other arrival times; None: the first unit of an entry may differ.
        Which list of two arrived first stays the same where all are later by one latency.
        """
        one_s, other_s = self.fused_tracks.received.common_arrives_s, received.common_arrives_s
        arrive = np.isfinite(one_s)
        if not np.array_equal(arrive, np.isfinite(other_s)) or not arrive.any():
            return None
        later_s, instants_s = other_s[arrive] - one_s[arrive], np.unique(one_s[arrive])
        # Neither does rounding decide which two arrive together.
        before, after = (np.searchsorted(instants_s, instants_s + SAME_INSTANT_S + side_s) for side_s in (-1e-9, 1e-9))
        same_order = np.ptp(later_s) < 1e-10 and np.array_equal(before, after)
        return self._lists if same_order else None


def convert_to_tracks(output: ReceiverOutput, run: int, matches: Matches) -> FusedTracks:
    """The lists of one run as tracks, one per matched object, else per identity of the fusion, else per entry."""
    lists, received, issue_s, newest = output.lists, output.received, output.instants.issue_s, output.instants.newest
    first, last = int(lists.start[run, 0]), int(lists.start[run, -1])
    entries = lists.entries[first:last]
    frame = np.repeat(np.arange(len(issue_s)), np.diff(lists.start[run]))
    object_ix = np.where(matches.role[first:last] == MATCH, matches.object_ix[first:last], -1)
    untracked = (object_ix < 0) & (entries["track_id"] < 0)
    identity = np.where(object_ix >= 0, 0, np.where(untracked, np.arange(len(entries)), entries["track_id"]))
    order = np.lexsort((frame, identity, untracked, object_ix))
    new = np.ones(len(order), dtype=bool)
    for key in (object_ix, untracked, identity):
        new[1:] &= key[order][1:] == key[order][:-1]
    new[1:] = ~new[1:]
    start = np.append(np.flatnonzero(new), len(order))
    stamps = np.where(newest >= 0, received.stamp_ns[newest], NO_CAPTURE_NS).max(axis=1, initial=NO_CAPTURE_NS)
    captured = np.where(newest >= 0, received.captured_s[newest], -np.inf).max(axis=1, initial=-np.inf)
    captures = stamps, captured, issue_s
    fused = make_entry_tracks("fused", entries[order], start, object_ix[order][start[:-1]], frame[order], captures)
    zeros = np.zeros(len(order) + 1, dtype=np.int64)
    stated_s = None if output.stated is None else output.told.entries["captured_s"][first:last][order]
    second_of = np.where(matches.role[first:last] == DUPLICATE, matches.object_ix[first:last], -1)[order]
    return FusedTracks(fused, received, zeros[:0], zeros, None, entries[order], stated_s=stated_s, second_of=second_of)


def make_entry_tracks(
    unit: str, entries: Entries, start: Int, object_ix: Int, frame_ix: Int, times: tuple[Int, Float, Float]
) -> Tracks:
    """Entries (P,) as tracks (E,) of one run; `times`: captures of lists (F,) in ns and in s, and arrivals in s."""
    return Tracks(
        units=(unit,), start=start, unit_ix=np.zeros(len(object_ix), dtype=np.int64), object_ix=object_ix,
        frame_ix=frame_ix, stamp_ns=times[0], captured_s=times[1],
        frame_unit_ix=np.zeros(len(times[0]), dtype=np.int64), arrives_s=times[2][None],
        valid=np.ones((1, len(frame_ix)), dtype=bool),
        **{name: entries[name][None] for name in (*VALUES, *COVARIANCES)},
    )  # fmt: skip


# Stated captures: when lists were captured, as fusions are told of it.


@dataclass(frozen=True)
class StatedCaptures:
    """Stated and true captures of the lists (F,) of one run; seconds since the log's start.

    `older (3, E)`: the same three of entries that are older than their lists.
    """

    stated_s: Float
    captured_s: Float
    arrives_s: Float
    older: Float = field(default_factory=lambda: np.empty((3, 0)))

    @cached_property
    def told(self) -> Float:
        """(3, F + E) stated captures, true captures and arrivals, of all captures that entries may name."""
        return np.concatenate([[self.stated_s, self.captured_s, self.arrives_s], self.older], axis=1)

    @property
    def ahead_s(self) -> float:
        """The largest lead of a stated capture over the true one; 0 where none is ahead."""
        return float((self.stated_s - self.captured_s).max(initial=0.0))

    def captured_between_s(self, stated_s: Float) -> tuple[Float, Float]:
        """The earliest and the latest true capture (K,) of the lists that state each instant (K,), one at least."""
        told_s, captured_s, _ = self.told[:, np.lexsort((self.told[1], self.told[0]))]
        first, after = (np.searchsorted(told_s, stated_s, side=side) for side in ("left", "right"))
        return captured_s[first], captured_s[after - 1]

    def as_told(self, lists: ObjectLists) -> ObjectLists:
        """The units' lists, one run of F, with stated captures."""
        entries = lists.entries.copy()
        lengths = np.diff(lists.start[0])
        age_s = np.repeat(self.captured_s, lengths) - entries["captured_s"]
        entries["captured_s"] = np.repeat(self.stated_s, lengths) - age_s
        return replace(lists, entries=entries)

    def true_lists(self, fused: ObjectLists, issue_s: Float) -> ObjectLists:
        """Fused lists, one run of K available at `issue_s`, with true captures in their entries."""
        entries = fused.entries.copy()
        entries["captured_s"] = self._true_s(entries["captured_s"], np.repeat(issue_s, np.diff(fused.start[0])))
        return replace(fused, entries=entries)

    def _true_s(self, told_s: Float, issue_s: Float) -> Float:
        """The true captures (N,) of entries that tell of stated ones: of lists with this claim the last that had
        arrived. An entry that tells of no list's stated capture is taken at its word.
        """
        stated_s, captured_s, arrives_s = self.told[:, np.lexsort((self.told[1], self.told[0]))]
        place: Int = np.searchsorted(stated_s, told_s + SAME_INSTANT_S, side="right") - 1
        while True:
            is_stated = (place >= 0) & (stated_s[np.maximum(place, 0)] >= told_s - SAME_INSTANT_S)
            is_too_early = is_stated & (arrives_s[np.maximum(place, 0)] > issue_s + SAME_INSTANT_S)
            if not is_too_early.any():
                return np.where(is_stated, captured_s[np.maximum(place, 0)], told_s)
            place = np.where(is_too_early, place - 1, place)


def state_captures(scene: Scene, received: Tracks, experiment: ExpandedExperiment, run: int) -> StatedCaptures | None:
    """The captures that units state to a receiver, none after the list's arrival; None: they state the truth."""
    error_s = clock_errors_s(scene, received.units, experiment, received.captured_s, received.frame_unit_ix, run)
    if error_s is None:
        return None
    arrives_s = received.common_arrives_s
    stated_s = np.minimum(received.captured_s + error_s, arrives_s)
    older, age_s = received.frame_ix[:0], np.empty(0)
    if received.entry_age_s is not None:
        older, age_s = received.frame_ix, received.entry_age_s[0]
    of_entries = np.stack([stated_s[older] - age_s, received.captured_s[older] - age_s, arrives_s[older]])
    return StatedCaptures(stated_s, received.captured_s, arrives_s, of_entries)


@dataclass(frozen=True)
class ReceiverOutput:
    """What one configuration's receiver issues in the runs (S,) at its instants, `instants`.

    `received`: the lists that reach it; `sent`: these before links delay or lose them. `fused_tracks`: of ideal fusion
    and the truth, which have truth ids, else None. `fused`: what another fusion gave, else None; one run where all runs
    agree. `tells_of`: of which instant entries tell. `whole`: the instants are those of the whole log, not of a time
    chunk. `fused_once`: what `fused_tracks` are of. `stated`: the captures that a fusion is told of, in one run; None:
    the true ones. `faults`: ghosts and lists that outages leave out, in one run; None: units have neither.
    `origin`: the lists that entries may go back to.
    """

    received: Tracks
    sent: Tracks
    instants: FusionSchedule
    origin: OriginLists
    scene: Scene
    fused_tracks: FusedTracks | None = None
    fused: ObjectLists | None = None
    tells_of: TellsOf = "capture"
    whole: bool = True
    stated: StatedCaptures | None = None
    faults: UnitFaults | None = None
    fused_once: FusedOnce | None = None

    @cached_property
    def lists(self) -> ObjectLists:
        """The fused lists without truth ids, with true captures in their entries."""
        return self.told if self.stated is None else self.stated.true_lists(self.told, self.instants.issue_s)

    @property
    def told(self) -> ObjectLists:
        """The fused lists without truth ids, with the captures that units stated to the fusion."""
        return self._lists_with_ids.lists

    @cached_property
    def origins(self) -> Origins:
        """The lists that the entries of the fused lists go back to."""
        holdings = self.origin.find_holdings(self.instants.issue_s)
        return Origins(self.lists.entries, self._lists_with_ids.object_ix, holdings)

    @cached_property
    def _lists_with_ids(self) -> ListsWithIds:
        if self.fused is not None:
            return ListsWithIds(self.fused, np.empty(0, dtype=np.int64))
        assert self.fused_tracks is not None
        shared = None if self.fused_once is None else self.fused_once.lists_arriving(self.received)
        return shared or convert_to_lists(self.fused_tracks, self.scene)

    def tracks_by_run(self, matches: Matches | None) -> Iterator[tuple[int, FusedTracks]]:
        """The fused tracks, and the first of the runs that they are of: of all, or where they have no truth ids of one.

        `matches`: of the fused lists; None: no list is without truth ids.
        """
        if self.fused_tracks is not None:
            yield 0, self.fused_tracks
            return
        assert matches is not None
        for s in range(len(self.lists.start)):
            yield s, convert_to_tracks(self, s, matches)


def states_needed(configuration: Configuration) -> States | None:
    """The states that must be drawn for a configuration's fused states; None, for the truth: none."""
    if configuration.units == TRUTH:
        return None
    fusion = configuration.fusion
    return "expected" if isinstance(fusion, IdealFusion) and fusion.combine == "posterior" else "sampled"


class Receivers:
    """The receivers of the configurations `names`, None: of all, with their memory.

    Time chunks of one log are received one after the other, in order of time.
    """

    def __init__(self, lists: Transmission, names: Collection[str] | None = None) -> None:
        self._lists, self._memory = lists, dict[str, Any]()
        self._last_fused: FusedOnce | None = None
        self._schedules = {
            name: fusion_schedule(lists.received(name), max_age_s=configuration.max_age_s)
            for name, configuration in lists.experiment.configurations.items()
            if names is None or name in names
        }

    def worlds(self) -> Iterator[WorldChunk]:
        """The log as units perceive it, chunk by chunk, each with the earlier captures that the receivers need."""
        lists, chunks = self._lists, self._lists.log.chunks
        reach = None
        if len(chunks) > 1:
            received = {name: lists.received(name) for name in self._schedules}
            stated = {name: self._state_captures(of) for name, of in received.items()}
            reach = Reach(lists.experiment, received, stated)
        for chunk in chunks:
            self._last_fused = None  # of the chunk before, which is dropped
            yield lists.world(chunk, chunk.from_s if reach is None else reach.earliest_s(chunk))

    def schedule(self, name: str) -> FusionSchedule:
        """All instants of a configuration's receiver, and the lists that it then has."""
        return self._schedules[name]

    def issue_s(self, name: str) -> Float:
        """(K,) all instants of a configuration's receiver."""
        return self._schedules[name].issue_s

    def fuse(self, world: WorldChunk, name: str) -> ReceiverOutput:
        """What a configuration's receiver makes of the lists that reach it. InputError: a user's fusion fails."""
        configuration = world.experiment.configurations[name]
        states = states_needed(configuration)
        sent = world.truth if states is None else world.sent(states)
        received = self._lists.receive(sent, name)
        output = ReceiverOutput(
            received=received,
            sent=sent,
            instants=self._schedules[name].between(world.chunk.from_s, world.chunk.until_s),
            origin=self._find_origin(world, name, received, sent),
            scene=world.scene,
            whole=len(world.log.chunks) == 1,
            faults=None if states is None else self._find_faults(world, name, received, sent),
        )
        if isinstance(configuration.fusion, ListFusion):
            return self._fuse_lists(world, name, configuration.fusion, output)
        return self._fuse_by_truth_id(world, name, output)

    # The steps around a fusion: ghosts and lists that are not made, the lists that entries go back to, stated captures,
    # entries that partial messages leave out, what lists of equal captures share.

    def _find_faults(self, world: WorldChunk, name: str, received: Tracks, sent: Tracks) -> UnitFaults | None:
        """Rows of ghosts, and which lists outages leave out, in one run; None: no unit has ghosts or outages. Only
        ghosts that are fused, and that came in since the last list before the chunk.
        """
        configuration = world.experiment.configurations[name]
        ghosts = None if states_needed(configuration) == "expected" else world.ghosts
        if ghosts is None and not world.experiment.outages:
            return None
        not_made = np.isinf(sent.common_arrives_s)
        if world.sending is not None:
            not_made &= world.sending.lists  # a list that is held back is made
        if ghosts is None or isinstance(configuration.fusion, IdealFusion):  # which leaves ghosts out
            return UnitFaults(np.arange(0), not_made)
        rows = len(world.observations.tracks.frame_ix) + np.arange(len(ghosts.words))
        earlier_s = self.issue_s(name)[: np.searchsorted(self.issue_s(name), world.chunk.from_s)]
        came_s = received.common_arrives_s[received.frame_ix[rows]] - SAME_INSTANT_S
        return UnitFaults(rows[came_s > earlier_s.max(initial=-np.inf)], not_made)

    def _find_origin(self, world: WorldChunk, name: str, received: Tracks, sent: Tracks) -> OriginLists:
        """The lists that entries of a configuration may go back to: those received, or of a stack its inputs."""
        configuration = world.experiment.configurations[name]
        age_s, partial = configuration.max_age_s, _mark_partial(world.experiment, received)
        if not isinstance(configuration.fusion, RecordedFusion):
            return OriginLists(received, sent, GoesBack.TO_NEWEST, age_s, partial, world.scene.ego_ix)
        if configuration.inputs is None:
            return OriginLists(received, sent, GoesBack.UNKNOWN, age_s, partial, -1)
        inputs = self._lists.log.recorded_lists
        of_input = np.isin(np.array(inputs.units), list(configuration.inputs))[inputs.frame_unit_ix]
        arrives_s = np.where(of_input, self._lists.lists.common_arrives_s, np.inf)
        issue_s = np.append(self.issue_s(name), np.inf)  # they are taken in when the stack issues its next list
        taken_s = issue_s[np.searchsorted(issue_s, arrives_s - SAME_INSTANT_S)]
        return OriginLists(replace(inputs, arrives_s=taken_s[None]), inputs, GoesBack.TO_ALL, age_s, partial, -1)

    def _fuse_lists(self, world: WorldChunk, name: str, fusion: ListFusion, output: ReceiverOutput) -> ReceiverOutput:
        """The output with lists fused without truth ids, by the captures that units state, and their origin."""
        received, instants, max_age_s = output.received, output.instants, output.origin.max_age_s
        lists, object_of, _ = remove_truth_ids(world)
        captures, captured_s = self._state_captures(received), None
        if captures is not None:
            lists, captured_s = captures.as_told(lists), captures.stated_s
        inputs = make_inputs(received, lists, max_age_s=max_age_s, instants=instants, captured_s=captured_s)
        if (partial := output.origin.partial).any():
            sent = SentEntries(lists.start[0], object_of)
            cached = keep_entries(received, sent, partial, self._schedules[name], instants, max_age_s=max_age_s)
            inputs = add_kept_entries(inputs, cached, partial, max_age_s)
        where = f"configurations.{name}.fusion"
        if fusion.resumable:
            fused, self._memory[name] = ask_resumed_fusion(fusion, inputs, self._memory.get(name), where)
        else:  # a log with such a fusion is one time chunk
            fused = ask_fusion(fusion, inputs, where)
        return self._reach_origin(world, replace(output, fused=fused, tells_of=fusion.tells_of, stated=captures))

    def _reach_origin(self, world: WorldChunk, output: ReceiverOutput) -> ReceiverOutput:
        """The output, its origin reaching back to the lists of its oldest entries: a track may coast for long."""
        origin, captured_s = output.origin, output.lists.entries["captured_s"]
        if origin.goes_back != GoesBack.TO_NEWEST or np.isneginf(world.earliest_s) or not len(captured_s):
            return output
        earliest_s = find_earliest_origin_s(origin.lists, captured_s.min()[None], origin.max_age_s, origin.partial)[0]
        if earliest_s >= world.earliest_s:
            return output
        rows = self._lists.world(world.chunk, float(earliest_s) - SAME_INSTANT_S).sent("sampled")
        return replace(output, origin=replace(origin, rows=rows))

    def _state_captures(self, received: Tracks) -> StatedCaptures | None:
        """What a fusion is told of captures, in a group of one run; None: the truth."""
        experiment, runs = self._lists.experiment, self._lists.group.runs
        return (
            state_captures(self._lists.log.scene, received, experiment, int(runs[0])) if experiment.runs_apart else None
        )

    def _fuse_by_truth_id(self, world: WorldChunk, name: str, output: ReceiverOutput) -> ReceiverOutput:
        """The output with its tracks by truth id: of ideal fusion or the truth; expected states are drawn."""
        fusion, received = world.experiment.configurations[name].fusion, output.received
        fused_once = self._fuse_once(name, output)
        fused_tracks = fused_once.fused_tracks.arriving(received, output.instants.issue_s)
        if output.sent is not world.truth and world.recorded is None:
            fused_tracks = replace(fused_tracks, view=world.observations.view)
        if isinstance(fusion, IdealFusion) and fusion.memory is not None:
            fused = remember_states(received, fused_tracks.fused, fusion.memory)
            return replace(output, fused_tracks=replace(fused_tracks, fused=fused), tells_of=fusion.tells_of)
        if states_needed(world.experiment.configurations[name]) == "expected":
            fused_tracks = draw_posterior(fused_tracks, world.scene, world.experiment.seed, world.group.runs)
            return replace(output, fused_tracks=fused_tracks)
        return replace(output, fused_tracks=fused_tracks, fused_once=fused_once)

    def _fuse_once(self, name: str, output: ReceiverOutput) -> FusedOnce:
        """Ideal fusion of the lists, without latency: cached, as a sweep asks for equal captures at many of them."""
        received, instants, max_age_s = output.received, output.instants, output.origin.max_age_s
        partial, kept = output.origin.partial, None
        if partial.any():
            kept = keep_by_object(received, partial, self._schedules[name], instants, max_age_s=max_age_s)
        beside_newest = find_lists_beside_newest(received, instants, kept)
        chosen = (instants.newest, *beside_newest, *(() if kept is None else [kept.entry]))
        captures, last_fused = b"".join(part.tobytes() for part in chosen), self._last_fused
        if last_fused is None or last_fused.sent is not output.sent or last_fused.captures != captures:
            ego = output.scene.ego_ix
            fused = fuse_ideal(received, max_age_s=max_age_s, without_object_ix=ego, instants=instants, cached=kept)
            self._last_fused = last_fused = FusedOnce(output.sent, captures, replace(fused, scene=output.scene))
        return last_fused


def _mark_partial(experiment: ExpandedExperiment, received: Tracks) -> Bool:
    """Mask (U,) of the received units that send partial lists: they leave objects out of their messages."""
    partial = set(experiment.partial)
    return np.array([unit in partial for unit in received.units], dtype=bool)


class Reach:
    """The earliest captures that receivers need in a time chunk: of lists that arrive, are cached, or looked back to.

    `received`: by configuration the lists that reach its receiver, whatever is in them. `stated`: the captures that
    their units state, None where these are true.
    """

    def __init__(
        self,
        experiment: ExpandedExperiment,
        received: Mapping[str, Tracks],
        stated: Mapping[str, StatedCaptures | None] | None = None,
    ) -> None:
        self._oldest: list[tuple[Float, Float]] = []  # instants, and the oldest capture that each needs
        self._again: list[tuple[Float, Float]] = []
        for name, lists in received.items():
            configuration = experiment.configurations[name]
            schedule = fusion_schedule(lists, max_age_s=configuration.max_age_s)
            if not len(schedule.issue_s):
                continue
            # The lists that arrive at an instant, and those that are fused beside them.
            oldest_s = np.minimum.reduceat(lists.captured_s[schedule.arrived], schedule.arrived_start[:-1])
            used_s = np.where(schedule.newest >= 0, lists.captured_s[schedule.newest], np.inf).min(axis=1)
            max_age_s, partial = configuration.max_age_s, _mark_partial(experiment, lists)
            if partial.any():  # entries are kept for max_age_s after a message that leaves them out
                used_s = np.minimum(used_s, schedule.issue_s - max_age_s - find_longest_way_s(lists))
            if isinstance(configuration.fusion, ListFusion):  # ideal fusion has truth ids
                used_s = np.minimum(used_s, find_earliest_origin_s(lists, used_s, max_age_s, partial))
            self._oldest.append((schedule.issue_s, np.minimum(oldest_s, used_s)))
            fusion = configuration.fusion
            if isinstance(fusion, ListFusion) and fusion.looks_back_s > 0:
                arrives_s, captured_s = lists.common_arrives_s[schedule.arrived], lists.captured_s[schedule.arrived]
                ahead_s = 0.0
                if stated is not None and (claim := stated[name]) is not None:  # it looks back in stated captures
                    captured_s, ahead_s = claim.stated_s[schedule.arrived], claim.ahead_s
                newest_s = np.maximum.accumulate(captured_s)
                self._again.append((arrives_s, newest_s - ahead_s - fusion.looks_back_s - AROUND_S))

    def earliest_s(self, chunk: TimeChunk) -> float:
        """The earliest capture that a time chunk needs."""
        earliest_s = chunk.from_s
        for issue_s, oldest_s in self._oldest:
            first, after = np.searchsorted(issue_s, (chunk.from_s, chunk.until_s))
            earliest_s = min(earliest_s, float(oldest_s[first:after].min(initial=np.inf)) - AROUND_S)
        for arrives_s, needed_s in self._again:
            arrived = int(np.searchsorted(arrives_s, chunk.from_s))
            if arrived:
                earliest_s = min(earliest_s, float(needed_s[arrived - 1]))
        return earliest_s


def remove_truth_ids(world: WorldChunk) -> tuple[ObjectLists, Int, Int]:
    """The units' lists as a real fusion gets them: without truth ids, the entries of each list in a random order.

    Second, (N,): entries with one number are one object to their unit; empty where no unit sends partial messages.
    Third, (N,): the row of each entry.
    """
    experiment, tracks = world.experiment, world.sent("sampled")
    rng, ego = CounterRng(experiment.seed, world.scene.log), world.scene.ego_ix
    words, (claims, object_of) = world.words, world.claims
    random_key = RandomKey(tracks.units, tracks.row_unit_ix, words, tracks.stamp_ns[tracks.frame_ix])
    drawn = rng.uniform("order in the list", random_key, world.group.runs)
    lists, entry_rows = make_entry_lists(tracks, claims, drawn, without_object_ix=ego)
    if not experiment.partial:
        return lists, np.empty(0, dtype=np.int64), entry_rows
    pairs = np.stack([tracks.row_unit_ix[entry_rows].astype(np.uint64), object_of[entry_rows]])
    return lists, np.unique(pairs, axis=1, return_inverse=True)[1].ravel(), entry_rows

"""The receiver: what it makes of the lists that arrive, configuration by configuration (f of the paper's coPEM).

It goes by the true captures: a list's age, which of a unit's lists is its newest, when it arrives, and whether an entry
was captured since the onset. Only a fusion is told of stated captures, where a unit's clock is off: of which instant an
entry tells is what is stated, as a clock error is an error.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from copem_replay.communication.arrivals import FusionSchedule, KeptEntries, SentEntries, fusion_schedule, keep_entries
from copem_replay.communication.link import delay_until_ready, sample_arrivals, transmit
from copem_replay.core.compiled import borrowing
from copem_replay.core.fused_tracks import EntrySources, FusedTracks, find_newest_and_first
from copem_replay.core.object_list import COVARIANCES, ENTRY, ObjectLists, TellsOf
from copem_replay.core.random import CounterRng, RandomKey, object_words
from copem_replay.core.tracks import (
    NO_CAPTURE_NS,
    SAME_INSTANT_S,
    TRUTH,
    VALUES,
    WHOLE,
    Bool,
    Float,
    Int,
    Scene,
    Tracks,
    UnitFaults,
    append_tracks,
    join_tracks,
)
from copem_replay.experiment.schema import Configuration
from copem_replay.fusion.ideal import (
    draw_posterior,
    find_lists_beside_newest,
    floor_covariances,
    fuse_ideal,
    keep_by_object,
)
from copem_replay.fusion.inputs import EntryClaims, RowEntries, add_kept_entries, listed_rows, make_inputs
from copem_replay.fusion.interface import IdealFusion, ListFusion, ask_fusion, ask_resumed_fusion
from copem_replay.metrics.matching import MATCH, Matches
from copem_replay.perception.ghosts import GhostRows, draw_ghosts, make_ghost_draws
from copem_replay.perception.perceive import add_states, clock_errors_s, remove_outages
from copem_replay.pipeline.world import States, WorldChunk, claim_rows, perceive_modelled

if TYPE_CHECKING:
    from copem_replay.pipeline.expansion import ExpandedExperiment


# Tracks with truth ids ↔ lists without: every fusion is measured, written and shown alike.


def convert_to_lists(fused_tracks: FusedTracks, scene: Scene) -> ObjectLists:
    """Fused tracks of ideal fusion, or of the truth itself, as lists: existence is 1 and the class is certain.

    No entry has a track id (−1): truth ids are no tracks, and such fusion confuses no two objects.
    """
    fused = fused_tracks.fused
    order, bounds = fused.by_frame
    start = np.zeros((len(fused.valid), len(bounds)), dtype=np.int64)
    entries = np.empty(int(fused.valid.sum()), dtype=ENTRY)
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
    )
    return ObjectLists(start, entries)


_CAPTURED = ENTRY.itemsize // 8 - 3
_UNIT, _TRACK = _CAPTURED + 1, _CAPTURED + 2
_EXISTENCE = len(VALUES) + len(COVARIANCES)
_CLASS = _EXISTENCE + 1
"""Places in an entry, in words of eight bytes; states and covariances stand before them."""


@borrowing
def _fill_words(
    valid: Bool, order: Int, bounds: Int, states: Float, classes: NDArray[np.int8], source: EntrySources,
    start: Int, words: Float, ids: Int,
) -> None:  # fmt: skip
    # Fills `words` (N, words of an entry) and `ids`, integers over the same memory, run by run and list by list, and
    # `start`. `states` are (12, S | 1, P).
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
                ids[n, _TRACK] = -1
                n += 1
            start[s, f + 1] = n


def convert_to_tracks(
    lists: ObjectLists, run: int, matches: Matches, received: Tracks, issue_s: Float, newest: Int,
    stated_s: Float | None = None,
) -> FusedTracks:  # fmt: skip
    """The lists of one run as tracks: one of each matched object, one of each identity else, one of each entry else.

    `issue_s (K,)`: the receiver's instants. `newest (K, U)`: the newest list of each unit then, −1: none. `stated_s
    (N,)`: captures of all entries as the fusion was told of them; None: the true ones.
    """
    first, last = int(lists.start[run, 0]), int(lists.start[run, -1])
    entries = lists.entries[first:last]
    frame = np.repeat(np.arange(len(issue_s)), np.diff(lists.start[run]))
    object_ix = np.where(matches.role[first:last] == MATCH, matches.object_ix[first:last], -1)
    alone = (object_ix < 0) & (entries["track_id"] < 0)
    identity = np.where(object_ix >= 0, 0, np.where(alone, np.arange(len(entries)), entries["track_id"]))
    order = np.lexsort((frame, identity, alone, object_ix))
    new = np.ones(len(order), dtype=bool)
    for key in (object_ix, alone, identity):
        new[1:] &= key[order][1:] == key[order][:-1]
    new[1:] = ~new[1:]
    start = np.append(np.flatnonzero(new), len(order))
    stamps = np.where(newest >= 0, received.stamp_ns[newest], NO_CAPTURE_NS).max(axis=1, initial=NO_CAPTURE_NS)
    captured = np.where(newest >= 0, received.captured_s[newest], -np.inf).max(axis=1, initial=-np.inf)
    fused = Tracks(
        units=("fused",),
        start=start,
        unit_ix=np.zeros(len(start) - 1, dtype=np.int64),
        object_ix=object_ix[order][start[:-1]],
        frame_ix=frame[order],
        stamp_ns=stamps,
        captured_s=captured,
        frame_unit_ix=np.zeros(len(issue_s), dtype=np.int64),
        arrives_s=issue_s[None],
        valid=np.ones((1, len(order)), dtype=bool),
        **{name: entries[name][order][None] for name in (*VALUES, *COVARIANCES)},
    )
    none = np.zeros(len(order) + 1, dtype=np.int64)
    stated_s = None if stated_s is None else stated_s[first:last][order]
    return FusedTracks(fused, received, none[:0], none, None, entries[order], stated_s=stated_s)


# Stated captures: when lists were captured, as fusions are told of it.


@dataclass(frozen=True)
class StatedCaptures:
    """Captures of the lists (F,) of one run, as units state them and as they are; seconds since the log's start."""

    stated_s: Float
    captured_s: Float
    arrives_s: Float

    @property
    def ahead_s(self) -> float:
        """How far a stated capture is ahead of the true one, at most; 0 where none is."""
        return float((self.stated_s - self.captured_s).max(initial=0.0))

    def captured_between_s(self, stated_s: Float) -> tuple[Float, Float]:
        """The earliest and the latest true capture (K,) of the lists that state each instant (K,), one at least."""
        order = np.lexsort((self.captured_s, self.stated_s))
        first, after = (np.searchsorted(self.stated_s[order], stated_s, side=side) for side in ("left", "right"))
        captured_s = self.captured_s[order]
        return captured_s[first], captured_s[after - 1]

    def as_told(self, lists: ObjectLists) -> ObjectLists:
        """The units' lists, one run of F, with stated captures."""
        entries = lists.entries.copy()
        entries["captured_s"] = np.repeat(self.stated_s, np.diff(lists.start[0]))
        return replace(lists, entries=entries)

    def true_lists(self, fused: ObjectLists, issue_s: Float) -> ObjectLists:
        """Fused lists, one run of K available at `issue_s`, whose entries go back to true captures."""
        entries = fused.entries.copy()
        entries["captured_s"] = self._true_s(entries["captured_s"], np.repeat(issue_s, np.diff(fused.start[0])))
        return replace(fused, entries=entries)

    def _true_s(self, told_s: Float, issue_s: Float) -> Float:
        """The true captures (N,) of entries that tell of stated ones: of those that had arrived, the last.

        An entry that tells of no list's stated capture is taken at its word.
        """
        order = np.lexsort((self.captured_s, self.stated_s))
        stated_s, arrives_s = self.stated_s[order], self.arrives_s[order]
        place: Int = np.searchsorted(stated_s, told_s + SAME_INSTANT_S, side="right") - 1
        while True:
            stated = (place >= 0) & (stated_s[np.maximum(place, 0)] >= told_s - SAME_INSTANT_S)
            early = stated & (arrives_s[np.maximum(place, 0)] > issue_s + SAME_INSTANT_S)
            if not early.any():
                return np.where(stated, self.captured_s[order][np.maximum(place, 0)], told_s)
            place = np.where(early, place - 1, place)


def state_captures(scene: Scene, received: Tracks, experiment: ExpandedExperiment, run: int) -> StatedCaptures | None:
    """What a receiver is told of the captures of the lists it hears, none after its arrival; None: the truth."""
    error_s = clock_errors_s(scene, received.units, experiment, received.captured_s, received.frame_unit_ix, run)
    if error_s is None:
        return None
    arrives_s = received.common_arrives_s
    return StatedCaptures(np.minimum(received.captured_s + error_s, arrives_s), received.captured_s, arrives_s)


@dataclass(frozen=True)
class ReceiverOutput:
    """What one configuration's receiver issues in the runs (S,) at its instants, `instants`.

    `received`: the lists that reach it; `sent`: these before links delay or lose them. `fused_tracks`: of ideal fusion
    and the truth, which have truth ids, else None. `fused`: what another fusion gave, else None; one run where all runs
    agree. `tells_of`: of which instant entries tell. `whole`: the instants are those of the whole log, not of a time
    chunk. `stated`: the captures that a fusion is told of, in one run; None: the true ones. `faults`: ghosts and lists
    that outages leave out, in one run; None: units have neither.
    """

    received: Tracks
    sent: Tracks
    instants: FusionSchedule
    fused_tracks: FusedTracks | None
    scene: Scene
    fused: ObjectLists | None
    tells_of: TellsOf = "capture"
    whole: bool = True
    stated: StatedCaptures | None = None
    faults: UnitFaults | None = None

    @cached_property
    def lists(self) -> ObjectLists:
        """The fused lists without truth ids; their entries go back to true captures."""
        return self.told if self.stated is None else self.stated.true_lists(self.told, self.instants.issue_s)

    @cached_property
    def told(self) -> ObjectLists:
        """The fused lists without truth ids; their entries have the captures that the fusion was told of."""
        if self.fused is not None:
            return self.fused
        assert self.fused_tracks is not None
        return convert_to_lists(self.fused_tracks, self.scene)

    @property
    def captures_told_s(self) -> Float:
        """(F,) the captures of the lists that were received, as fusion was told of them."""
        return self.received.captured_s if self.stated is None else self.stated.stated_s


def perceive_all_units(
    world: WorldChunk,
    runs: Int,
    *,
    states: States,
    equipped: Bool | None = None,
    ghosts: GhostRows | None = None,
) -> Tracks:
    """What every unit lists in the runs (S,), whatever its lists come from. `equipped (S, U)` as in `perceive`.

    One run at a time where lists differ from run to run (outages, a drawn `ready`), or with `ghosts`: rows without an
    object, which come after those of objects and before those of recorded units.
    """
    experiment = world.experiment
    if world.perceived is not None:
        seen = world.perceived.seen(world, int(runs[0]), states)
    else:
        seen = perceive_modelled(world, runs, states, equipped)
    if ghosts is not None:
        drawn = make_ghost_draws(world.scene, ghosts, experiment, int(runs[0]))
        seen = append_tracks(
            seen, add_states(world.scene, ghosts.observations.tracks, ghosts.observations, experiment, drawn)
        )
    seen = remove_outages(world.scene, seen, experiment, runs)
    seen = delay_until_ready(seen, experiment.ready, CounterRng(experiment.seed, world.scene.log), runs)
    if world.on_air is not None and (sent := world.on_air.sent) is not None:
        words = object_words(world.scene.object_ids)[world.observations.tracks.row_object_ix]
        seen = sent.of(seen, words if ghosts is None else np.concatenate([words, ghosts.words]))
    if world.recorded is None:
        return seen
    recorded = world.recorded.tracks
    recorded = replace(recorded, valid=np.broadcast_to(recorded.valid, (len(runs), len(recorded.frame_ix))))
    both = join_tracks((*seen.units, *recorded.units), [seen, recorded])
    # In the experiment's order: it decides between lists that arrive together.
    names = tuple(experiment.units)
    place = np.array([names.index(name) for name in both.units])
    return replace(both, units=names, unit_ix=place[both.unit_ix], frame_unit_ix=place[both.frame_unit_ix])


def receive_lists(
    seen: Tracks,
    world: WorldChunk,
    name: str,
    present: Bool | None = None,
    *,
    ticks: bool = True,
) -> Tracks:
    """What reaches the receiver of the configuration `name`: the lists of its units, late; those of the others never.

    `present (U,)`: which units there are, None: all. Rows are not copied: configurations share them and their draws.
    `ticks=False`: arrivals as links give them, not at the receiver's next instant (`issue_hz`). Raises InputError where
    a link of the user's own fails.
    """
    experiment, scene, on_air = world.experiment, world.scene, world.on_air
    configuration, links = experiment.configurations[name], experiment.links_of(name)
    of_truth = configuration.units == TRUTH
    lists = world.truth if of_truth else seen
    air = None if on_air is None else on_air.of(lists, scene, experiment.seed)
    received = None if of_truth else set(experiment.units_of(configuration))
    if received is not None and present is not None:
        received &= {unit for unit, here in zip(seen.units, present, strict=True) if here}
    arriving = transmit(lists, links, received, air=air)
    return sample_arrivals(arriving, configuration.issue_hz) if ticks else arriving


def has_truth_ids(configuration: Configuration) -> bool:
    """Whether a configuration's fused tracks have truth ids: the truth itself, and ideal fusion."""
    computed = configuration.recorded is None  # not the output of a stack
    return computed and (configuration.units == TRUTH or isinstance(configuration.fusion, IdealFusion))


class Receivers:
    """The receivers of all configurations, of the units that are `present (U,)`, and what they remember.

    Time chunks of one log are received one after the other, in order of time.
    """

    def __init__(self, runs: Int, present: Bool | None) -> None:
        self._runs, self._present = runs, present
        self._schedules: dict[str, FusionSchedule] = {}
        self._memory: dict[str, Any] = {}

    def issue_s(self, name: str) -> Float:
        """(K,) all instants of a configuration's receiver, once `receive` has reached the configuration."""
        return self._schedules[name].issue_s

    def receive(self, world: WorldChunk) -> Iterator[tuple[str, ReceiverOutput]]:
        """What each configuration's receiver issues in the runs (S,), in the time chunk.

        Raises InputError where a fusion of the user's own fails.
        """
        shared = _SharedLists(world, self._runs)
        for name, configuration in world.experiment.configurations.items():
            yield name, self._receive_configuration(shared, name, configuration)

    def _receive_configuration(self, shared: _SharedLists, name: str, configuration: Configuration) -> ReceiverOutput:
        world, fusion, of_truth = shared.world, configuration.fusion, configuration.units == TRUTH
        posterior = isinstance(fusion, IdealFusion) and fusion.combine == "posterior" and not of_truth
        states: States = "expected" if posterior else "sampled"
        seen = shared.seen(states)
        received = receive_lists(seen, world, name, self._present)
        if name not in self._schedules:
            self._schedules[name] = fusion_schedule(received, max_age_s=configuration.max_age_s)
        faults = None if of_truth else _find_faults(world, seen, None if posterior else shared.ghosts)
        if isinstance(fusion, IdealFusion) and faults is not None:
            faults = replace(faults, ghosts=faults.ghosts[:0])  # ideal fusion leaves ghosts out
        output = ReceiverOutput(
            received=received, sent=world.truth if of_truth else seen,
            instants=self._schedules[name].between(world.chunk.from_s, world.chunk.until_s),
            fused_tracks=None, scene=world.scene, fused=None, whole=world.chunk == WHOLE, faults=faults,
        )  # fmt: skip
        if isinstance(fusion, ListFusion):
            return self._fuse_lists(shared, name, fusion, output)
        fused_tracks = self._fuse_by_truth_id(shared, name, states, output)
        if posterior:
            fused_tracks = draw_posterior(fused_tracks, world.scene, world.experiment.seed, self._runs)
        return replace(output, fused_tracks=fused_tracks)

    def _fuse_lists(
        self, shared: _SharedLists, name: str, fusion: ListFusion, output: ReceiverOutput
    ) -> ReceiverOutput:
        """Fusion of lists without truth ids, told of the captures that units state."""
        experiment, received, instants = shared.world.experiment, output.received, output.instants
        max_age_s = experiment.configurations[name].max_age_s
        lists, same = shared.without_truth_ids
        stated = None
        if experiment.runs_apart:  # then the block has one run
            stated = state_captures(shared.world.scene, received, experiment, int(self._runs[0]))
        if stated is not None:
            lists = stated.as_told(lists)
        captured_s = None if stated is None else stated.stated_s
        inputs = make_inputs(received, lists, max_age_s=max_age_s, instants=instants, captured_s=captured_s)
        partial = _mark_partial(experiment, received)
        if partial.any():
            sent = SentEntries(lists.start[0], same)
            kept = keep_entries(received, sent, partial, self._schedules[name], instants, max_age_s=max_age_s)
            inputs = add_kept_entries(inputs, kept, partial, max_age_s)
        where = f"configurations.{name}.fusion"
        if fusion.resumable:
            fused, self._memory[name] = ask_resumed_fusion(fusion, inputs, self._memory.get(name), where)
        else:  # a log with such a fusion is one time chunk
            fused = ask_fusion(fusion, inputs, where)
        return replace(output, fused=fused, tells_of=fusion.tells_of, stated=stated)

    def _fuse_by_truth_id(self, shared: _SharedLists, name: str, states: States, output: ReceiverOutput) -> FusedTracks:
        """Ideal fusion, or the truth itself, at the instants of the configuration."""
        world, configuration = shared.world, shared.world.experiment.configurations[name]
        received, instants, of_truth, kept = output.received, output.instants, configuration.units == TRUTH, None
        partial = _mark_partial(world.experiment, received)
        if partial.any():
            kept = keep_by_object(received, partial, self._schedules[name], instants, max_age_s=configuration.max_age_s)
        fused_tracks = shared.fuse_ideal(
            received, instants, kept, states, of_truth=of_truth, max_age_s=configuration.max_age_s
        )
        fused_tracks = fused_tracks.arriving(received, instants.issue_s)
        if not of_truth and world.recorded is None:
            fused_tracks = replace(fused_tracks, view=world.observations.view)
        return fused_tracks


class _SharedLists:
    """What the configurations of a time chunk share in the runs (S,); each is made when it is first needed."""

    def __init__(self, world: WorldChunk, runs: Int) -> None:
        self.world, self._runs = world, runs
        self.ghosts = draw_shown_ghosts(world, runs)
        self._seen: dict[States, Tracks] = {}
        self._last_fused: tuple[tuple[bool, States, bytes, bytes], FusedTracks] | None = None

    def seen(self, states: States) -> Tracks:
        """What all units list; ghosts only among `sampled` states."""
        if states not in self._seen:
            ghosts = self.ghosts if states == "sampled" else None
            self._seen[states] = perceive_all_units(self.world, self._runs, states=states, ghosts=ghosts)
        return self._seen[states]

    @cached_property
    def without_truth_ids(self) -> tuple[ObjectLists, Int]:
        """What `remove_truth_ids` gives: the units' lists, and which entries a partial unit takes for one object."""
        return remove_truth_ids(self.world, self.seen("sampled"), self._runs, self.ghosts)

    def fuse_ideal(
        self, received: Tracks, instants: FusionSchedule, kept: KeptEntries | None, states: States, *,
        of_truth: bool, max_age_s: float,
    ) -> FusedTracks:  # fmt: skip
        """Ideal fusion of what is received: later lists of the same captures, as in a sweep, are fused once."""
        entries = b"" if kept is None else kept.entry.tobytes()
        beside = b"".join(part.tobytes() for part in find_lists_beside_newest(received, instants, kept))
        made_of = (of_truth, states, instants.newest.tobytes(), beside + entries)
        if self._last_fused is None or self._last_fused[0] != made_of:
            weighed = None
            if self.world.perceived is not None and not of_truth:
                weighed = self.world.perceived.weighed(self.world, states, received)
            fused_tracks = fuse_ideal(
                received,
                max_age_s=max_age_s,
                without_object_ix=self.world.scene.ego_ix,
                instants=instants,
                kept=kept,
                weighed=weighed,
            )
            self._last_fused = made_of, fused_tracks
        return self._last_fused[1]


def _mark_partial(experiment: ExpandedExperiment, received: Tracks) -> Bool:
    """(U,) which of the units that are received leave objects out of their messages."""
    partial = set(experiment.partial)
    return np.array([unit in partial for unit in received.units], dtype=bool)


def draw_shown_ghosts(world: WorldChunk, runs: Int) -> GhostRows | None:
    """Ghosts of the units, where a block has one run and there is a fusion without truth ids."""
    if not world.experiment.runs_apart or world.placed is None:
        return None
    between_s = world.earliest_s, world.chunk.until_s
    return draw_ghosts(world.scene, world.observations, world.experiment, world.placed, int(runs[0]), between_s)


def run_receivers(world: WorldChunk, runs: Int, present: Bool | None) -> Iterator[tuple[str, ReceiverOutput]]:
    """What each configuration's receiver issues in a whole log."""
    return Receivers(runs, present).receive(world)


def _find_faults(world: WorldChunk, seen: Tracks, ghosts: GhostRows | None) -> UnitFaults | None:
    """Rows of ghosts and lists that outages leave out, in one run; None: no unit has ghosts or outages."""
    if ghosts is None and not world.experiment.outages:
        return None
    first = len(world.observations.tracks.frame_ix)
    rows = np.arange(first, first + (0 if ghosts is None else len(ghosts.words)))
    not_made = np.isinf(seen.common_arrives_s)
    if world.on_air is not None and (sent := world.on_air.sent) is not None:
        not_made[: len(sent.lists)] &= sent.lists  # a list that is held back is made
    return UnitFaults(rows, not_made)


def remove_truth_ids(
    world: WorldChunk, seen: Tracks, runs: Int, ghosts: GhostRows | None = None
) -> tuple[ObjectLists, Int]:
    """The units' lists as a real fusion sees them: without truth ids, the entries of each in a random order.

    Second, (N,): entries with one number are one object to their unit; empty where no unit sends partial messages.
    """
    experiment, rng, ego = world.experiment, CounterRng(world.experiment.seed, world.scene.log), world.scene.ego_ix
    none = np.empty(0, dtype=np.int64)
    as_perceived = not (experiment.sends or experiment.outages or experiment.draws_claims)
    if world.perceived is not None and world.recorded is None and as_perceived:
        s, of_rows, random_key = world.perceived.entries(
            world, int(runs[0]), lambda every: _make_entry_rows(world, every)
        )
        drawn = rng.uniform("order in the list", random_key, runs)
        return of_rows.lists(seen, drawn, s, without_object_ix=ego), none
    rows, recorded = claim_rows(world, runs, ghosts), world.recorded
    words, same = rows.words, rows.same
    claims = EntryClaims(rows.claims.existence, rows.claims.class_probability, rows.claims.track_id)
    if recorded is not None:
        words = np.concatenate([words, np.arange(len(recorded.existence), dtype=np.uint64)])
        same = np.concatenate([same, words[len(same) :]])
        claims = EntryClaims(
            np.concatenate([claims.existence, recorded.existence]),
            np.concatenate([claims.class_probability, recorded.class_probability]),
            np.concatenate([claims.track_id, recorded.track_id]),
        )
    random_key = RandomKey(seen.units, seen.row_unit_ix, words, seen.stamp_ns[seen.frame_ix])
    drawn = rng.uniform("order in the list", random_key, runs)
    lists = RowEntries(seen, claims).lists(seen, drawn, without_object_ix=ego)
    if not experiment.partial:
        return lists, none
    picked = listed_rows(seen, drawn, without_object_ix=ego)[1]
    pairs = np.stack([seen.row_unit_ix[picked].astype(np.uint64), same[picked]])
    return lists, np.unique(pairs, axis=1, return_inverse=True)[1].ravel()


def _make_entry_rows(world: WorldChunk, seen: Tracks) -> tuple[RowEntries, RandomKey]:
    """Rows as entries, and their random key, where only presence and states are drawn, not claims."""
    rows = claim_rows(world, np.empty(0, dtype=np.int64), None)
    claims = EntryClaims(rows.claims.existence, rows.claims.class_probability, rows.claims.track_id)
    return RowEntries(seen, claims), RandomKey(seen.units, seen.row_unit_ix, rows.words, seen.stamp_ns[seen.frame_ix])

"""The world in some runs of a log: what units perceive and send of it, and when each receiver gets it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

from copem_replay.communication.link import LinkInput, delay_until_ready, sample_arrivals, transmit
from copem_replay.communication.radio import Radio
from copem_replay.communication.sends import LastSent, ListedObjects
from copem_replay.core.errors import ExperimentError
from copem_replay.core.lasting import ListStamps
from copem_replay.core.memory import UnitDraws
from copem_replay.core.random import CounterRng, RandomKey, Words, object_words, stable_hash
from copem_replay.core.tracks import (
    CLASSES,
    TRUTH,
    Bool,
    Float,
    Int,
    Scene,
    TimeChunk,
    Tracks,
    append_tracks,
    class_indices,
)
from copem_replay.experiment.schema import Experiment
from copem_replay.io.recorded_units import RecordedUnits
from copem_replay.perception.ghosts import GhostRows, draw_ghosts, make_ghost_draws
from copem_replay.perception.observation import Observations
from copem_replay.perception.perceive import (
    EntryClaims,
    add_states,
    draw_claims,
    make_draws,
    perceive,
    remove_outages,
)
from copem_replay.pipeline.expansion import ExpandedExperiment, RunGroup
from copem_replay.pipeline.prepare import Replay

States = Literal["true", "expected", "sampled"]
"""What is drawn of rows: which are listed alone, their mean errors as well, or their errors."""


@dataclass
class WorldChunk:
    """A log, or a time chunk of one, in the runs (S,) of a group, as the units of an experiment perceive it.

    `observations`: rows of the modelled units. Includes earlier captures that the chunk needs, back to `earliest_s`.
    `complete`: with the rows of all objects and with ghosts, else only of objects with an episode. `sending`: what
    units send of their lists, set once it is known; None: all. `claiming`: ghosts and claims are drawn also where no
    fusion needs them, in one run. What is drawn is kept for all configurations.
    """

    log: Replay
    experiment: ExpandedExperiment
    group: RunGroup
    chunk: TimeChunk
    observations: Observations
    earliest_s: float = -np.inf
    complete: bool = True
    sending: SentObjects | None = None
    claiming: bool = False
    _listed: dict[States, Tracks] = field(default_factory=dict)
    _sent: dict[States, Tracks] = field(default_factory=dict)

    @property
    def scene(self) -> Scene:
        """The scene of the log."""
        return self.log.scene

    @cached_property
    def truth(self) -> Tracks:
        """The world at its own frames, which the truth lists."""
        return self.log.truth.captured_between(self.earliest_s, self.chunk.until_s)

    @cached_property
    def recorded(self) -> RecordedUnits | None:
        """The lists of the recorded units."""
        recorded = self.log.recorded
        return None if recorded is None else recorded.captured_between(self.earliest_s, self.chunk.until_s)

    @cached_property
    def ghosts(self) -> GhostRows | None:
        """Ghosts of the units, where the group has one run and there is a fusion without truth ids."""
        if not self.complete or not (self.claiming or self.experiment.runs_apart):
            return None
        between_s, run = (self.earliest_s, self.chunk.until_s), int(self.group.runs[0])
        return draw_ghosts(self.scene, self.observations, self.experiment, self.log.placed, run, between_s)

    def listed(self, states: States) -> Tracks:
        """All rows of all units' lists: of objects, of ghosts (unless states are expected), of recorded units."""
        if states not in self._listed:
            scene, experiment, runs = self.scene, self.experiment, self.group.runs
            equipped = self.group.listing
            modelled = [k for k, unit in enumerate(experiment.units.values()) if unit.pem is not None]
            present = None if equipped.all() else equipped[:, modelled]
            tracks = perceive(scene, self.observations, experiment, runs, states=states, equipped=present)
            if states != "expected" and (ghosts := self.ghosts) is not None:
                drawn, true = make_ghost_draws(scene, ghosts, experiment, int(runs[0])), ghosts.observations.tracks
                tracks = append_tracks(tracks, add_states(scene, true, ghosts.observations, experiment, drawn))
            tracks = remove_outages(scene, self.log.add_recorded(tracks, self.recorded), experiment, runs)
            rng = CounterRng(experiment.seed, scene.log)
            self._listed[states] = delay_until_ready(tracks, experiment.ready, rng, runs)
        return self._listed[states]

    def sent(self, states: States) -> Tracks:
        """The listed rows that units send."""
        if self.sending is None:
            return self.listed(states)
        if states not in self._sent:
            self._sent[states] = self.sending.of(self.listed(states), self.words)
        return self._sent[states]

    def sightings(self, states: States) -> Tracks:
        """The rows that are listed in the chunk itself, at least those of objects with an episode.

        Those of time chunks are held until the last one: without states.
        """
        tracks, log = self.listed(states), self.log
        if len(log.chunks) == 1:
            return tracks
        in_chunk = tracks.valid.any(axis=0) & (tracks.row_captured_s >= self.chunk.from_s)
        rows = np.flatnonzero(in_chunk & np.isin(tracks.row_object_ix, log.episodes.object_ix))
        return tracks.take_rows(rows, states=False)

    @cached_property
    def words(self) -> Words:
        """The address word of each row's object or ghost; of rows of recorded units a number."""
        words = object_words(self.scene.object_ids)[self.observations.tracks.row_object_ix]
        numbers = np.arange(0 if self.recorded is None else len(self.recorded.existence), dtype=np.uint64)
        if self.recorded is not None and self.experiment.fusing:  # one object is one to a unit that fuses
            of, fusing = self.recorded.tracks, self.experiment.fusing
            is_known = np.isin(np.array(of.units), list(fusing))[of.row_unit_ix] & (of.row_object_ix >= 0)
            numbers = np.where(is_known, object_words(self.scene.object_ids)[of.row_object_ix], numbers)
        return np.concatenate([words, *([] if self.ghosts is None else [self.ghosts.words]), numbers])

    @cached_property
    def claims(self) -> ClaimedRows:
        """Existence, class and id that units claim of their rows; the same in all runs where nothing is drawn."""
        observations, experiment, ghosts = self.observations, self.experiment, self.ghosts
        existence, class_ix = observations.existence, observations.view.class_ix
        claims = EntryClaims(existence, np.eye(len(CLASSES))[class_ix], np.full(len(existence), -1))
        if (self.claiming or experiment.runs_apart) and experiment.draws_claims:  # else no receiver needs it
            drawn = make_draws(self.scene, observations, experiment, self.group.runs)
            claims = draw_claims(observations, experiment, drawn)
        if ghosts is not None:
            drawn = make_ghost_draws(self.scene, ghosts, experiment, int(self.group.runs[0]))
            of_ghosts = draw_claims(ghosts.observations, experiment, drawn, ghosts.sort)
            claims = claims.followed_by(of_ghosts)
        if (recorded := self.recorded) is not None:
            given = EntryClaims(recorded.existence, recorded.class_probability, recorded.track_id)
            claims = claims.followed_by(given)
        # A unit with track ids takes entries of one id for one object.
        identity_words = np.where(claims.track_id >= 0, claims.track_id.astype(np.uint64), self.words)
        return ClaimedRows(claims, identity_words)


# Transmission: when what is sent reaches each receiver.


class Transmission:
    """The lists (F,) of all units of a log on their way to each receiver, in the runs (S,) of a group.

    Where arrivals are drawn the group has one run. `complete`: whether all rows of lists are asked for, else only those
    of objects with an episode. `states`: what is drawn of them in any case. Raises ExperimentError where a link asks
    for what is not known.
    """

    def __init__(
        self, log: Replay, experiment: Experiment, group: RunGroup, *, complete: bool = True, states: States = "true"
    ) -> None:
        self.log, self.experiment, self.group = log, log.expand(experiment), group
        self.states: States = "sampled" if self.experiment.sends else states  # what is sent depends on errors
        self._complete = complete
        self._whole: WorldChunk | None = None
        self._arriving: tuple[str, Tracks] | None = None
        self._path = self._objects = self._sending = None
        if self.experiment.arrivals_differ:
            if asks_for_path(self.experiment, log.scene):
                self._path = log.paths
            if self.experiment.sends:
                self._sending = select_sent_objects(self.experiment, self._own_chunks())
            if has_channel(self.experiment):
                self._objects = self._count_objects()
        never = TimeChunk(np.inf, np.inf)
        self._lists = WorldChunk(log, self.experiment, group, never, log.no_rows, np.inf, False, self._sending)

    def world(self, chunk: TimeChunk, earliest_s: float) -> WorldChunk:
        """A time chunk with captures back to `earliest_s`; cached where it is the whole log."""
        log, world = self.log, self._whole
        if world is None:
            observations = log.observe_listable(chunk, earliest_s, complete=self._complete)
            world = WorldChunk(log, self.experiment, self.group, chunk, observations, earliest_s, self._complete)
            self._whole = world if len(log.chunks) == 1 else None
        world.sending = self._sending
        return world

    @property
    def lists(self) -> Tracks:
        """The lists of all units as they are sent, without rows."""
        return self._lists.sent("true")

    @property
    def truth(self) -> Tracks:
        """The lists of the truth, without rows."""
        return self._lists.truth

    def send(self, sightings: Tracks) -> Tracks:
        """The sent rows of objects, out of the listed ones."""
        if self._sending is None:
            return sightings
        words = object_words(self.log.scene.object_ids)[sightings.row_object_ix]
        if self._whole is not None and self.experiment.fusing:  # all rows of a log in one time chunk
            words = self._whole.words
        return self._sending.of(sightings, words)

    def arriving(self, name: str) -> Tracks:
        """The lists that reach the receiver of a configuration, with the arrival on their links; others never arrive.

        Those of the last configuration are cached. Raises InputError where a link of the user's own fails.
        """
        if self._arriving is None or self._arriving[0] != name:
            self._arriving = name, self._transmit(name)
        return self._arriving[1]

    def _transmit(self, name: str) -> Tracks:
        experiment, lists, heard = self.experiment, self.lists, None
        if experiment.configurations[name].units == TRUTH:
            lists = self.truth
        else:
            there = {unit for unit, sends in zip(lists.units, self.group.sending, strict=True) if sends}
            heard = there.intersection(experiment.units_of(experiment.configurations[name]))
        air = self._link_input(lists) if experiment.arrivals_differ else None
        return transmit(lists, experiment.links_of(name), heard, air=air)

    def received(self, name: str) -> Tracks:
        """The lists that reach the receiver of a configuration, with the instant it takes each in (`issue_hz`)."""
        return sample_arrivals(self.arriving(name), self.experiment.configurations[name].issue_hz)

    def receive(self, rows: Tracks, name: str) -> Tracks:
        """Rows in the lists that reach the receiver of a configuration; configurations share them and their draws."""
        return replace(rows, arrives_s=self.received(name).arrives_s)

    def _own_chunks(self) -> Iterator[WorldChunk]:
        return (self.world(chunk, chunk.from_s) for chunk in self.log.chunks)

    def _count_objects(self) -> Int:
        """(F,) how many entries each list of one run has, ghosts among them."""
        states: States = "true" if self.states == "expected" else self.states
        sent = (world.sent(states) for world in self._own_chunks())
        counts: Int = np.sum([np.bincount(s.frame_ix[s.valid[0]], minlength=len(s.stamp_ns)) for s in sent], axis=0)
        return counts

    def _link_input(self, lists: Tracks) -> LinkInput:
        """The input of links of these lists; the truth's lists have no path and no length."""
        scene, of_truth, F = self.log.scene, lists.units == (TRUTH,), len(lists.stamp_ns)
        # The address of a draw: sender, receiver and capture.
        word = object_words([scene.object_ids[scene.ego_ix]])[0] if scene.ego_ix >= 0 else stable_hash("everyone")
        random_key = RandomKey(lists.units, lists.frame_unit_ix, np.full(F, word, dtype=np.uint64), lists.stamp_ns)
        stamps = ListStamps(lists.stamp_ns, lists.frame_unit_ix, np.arange(F))
        draws = UnitDraws(CounterRng(self.experiment.seed, scene.log), random_key, stamps, self.group.runs)
        path, objects = (None, None) if of_truth else (self._path, self._objects)
        return LinkInput(draws, path, objects, self.log.kept_draws)


def asks_for_path(experiment: ExpandedExperiment, scene: Scene) -> bool:
    """Whether a link depends on the path to the receiver. Raises ExperimentError where the path is not known."""
    by_path = False
    for name, configuration in experiment.configurations.items():
        for unit_links in experiment.links_of(name):
            if not (isinstance(unit_links.link, Radio) and unit_links.link.loses and unit_links.link.reception.by_path):
                continue
            by_path, where = True, f"{scene.log}: {unit_links.where}.reception: {unit_links.link.reception.kind}"
            if scene.ego_ix < 0:
                raise ExperimentError(
                    f"{where}: the distance to a receiver is unknown, for the log has no ego; use constant"
                )
            units = experiment.units_of(configuration) if unit_links.units is None else unit_links.units
            sensing = () if configuration.units == TRUTH else experiment.list_sensing(units)
            far = [TRUTH] if configuration.units == TRUTH else sorted(experiment.recorded.keys() & set(sensing))
            if far:
                source = "of the truth" if far == [TRUTH] else f"of unit {far[0]}, whose lists are recorded,"
                raise ExperimentError(f"{where}: the distance {source} to a receiver is not known; use constant")
    return by_path


def has_channel(experiment: ExpandedExperiment) -> bool:
    """Whether a link depends on the length of lists. Raises ExperimentError for the truth, which no unit sends."""
    queues = False
    for name, configuration in experiment.configurations.items():
        for unit_links in experiment.links_of(name):
            if isinstance(unit_links.link, Radio) and unit_links.link.channel is not None:
                queues = True
                if configuration.units == TRUTH:
                    raise ExperimentError(f"configurations.{name}.link: the truth is sent by no unit; use no `channel`")
    return queues


# Sends: what units send of what they list in one run, decided list by list over the whole log by what they list
# themselves, with errors and false positives.

_VRU = class_indices(("vru",))


class ClaimedRows(NamedTuple):
    """The claims of units about rows (P,), as `WorldChunk.listed` has them; `same`: equal for one object."""

    claims: EntryClaims
    same: Words


@dataclass(frozen=True)
class SentObjects:
    """The sent objects of one run: `lists (F,)` not held back, and `keys` of the rows of `partial (U,)` units."""

    lists: Bool
    partial: Bool
    keys: Words

    def of(self, tracks: Tracks, words: Words) -> Tracks:
        """The rows that are sent; `words`: those of their objects."""
        left_out = self.partial[tracks.row_unit_ix] & ~np.isin(_key_rows(tracks.frame_ix, words), self.keys)
        arrives_s = np.where(self.lists, tracks.common_arrives_s, np.inf)
        return replace(tracks, valid=tracks.valid & ~left_out & self.lists[tracks.frame_ix], arrives_s=arrives_s[None])


def _key_rows(frame_ix: Int, words: Words) -> Words:
    """(P,) a number for each row: never equal within a list, and practically never between lists."""
    mixed: Words = frame_ix.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)  # an odd factor: one to one
    return words ^ mixed


def select_sent_objects(experiment: ExpandedExperiment, chunks: Iterable[WorldChunk]) -> SentObjects:
    """Select the objects that units send in one run, chunk after chunk; lists have the same numbers in all chunks."""
    units = list(experiment.units)
    last = LastSent([experiment.sends.get(name) for name in units])
    sending = np.array([name in experiment.sends for name in units], dtype=bool)
    partial = np.array([name in experiment.partial for name in units], dtype=bool)
    slots: dict[tuple[int, int], int] = {}
    lists, keys = np.zeros(0, dtype=bool), [np.zeros(0, dtype=np.uint64)]
    for world in chunks:
        chunk, tracks, (claims, object_of) = world.chunk, world.listed("sampled"), world.claims
        if not len(lists):
            lists = np.ones(len(tracks.stamp_ns), dtype=bool)
        frames = np.flatnonzero(
            sending[tracks.frame_unit_ix] & np.isfinite(tracks.common_arrives_s)
            & (tracks.captured_s >= chunk.from_s) & (tracks.captured_s < chunk.until_s)
        )  # fmt: skip
        frames = frames[np.argsort(tracks.captured_s[frames], kind="stable")]
        order, bounds = tracks.by_frame
        counts = np.diff(bounds)[frames]
        begin = np.cumsum(counts) - counts
        listed = order[np.repeat(bounds[frames] - begin, counts) + np.arange(counts.sum())]
        valid = tracks.valid[0, listed]
        start = np.append(0, np.cumsum(valid))[np.append(begin, len(listed))]
        listed = listed[valid]
        pairs, pair_ix = np.unique(
            np.stack([tracks.row_unit_ix[listed].astype(np.uint64), object_of[listed]]), axis=1, return_inverse=True
        )
        slot = np.array([slots.setdefault((u, w), len(slots)) for u, w in pairs.T.tolist()], dtype=np.int64)
        sent, included = last.choose(
            ListedObjects(
                start, tracks.frame_unit_ix[frames], tracks.captured_s[frames], slot[pair_ix.ravel()],
                world.words[listed], np.isin(claims.class_probability[listed].argmax(axis=1), _VRU),
                _sampled_states(tracks, listed), claims.existence[listed],
            )
        )  # fmt: skip
        lists[frames[~sent]] = False
        keys.append(_key_rows(tracks.frame_ix[listed[included]], world.words[listed[included]]))
    return SentObjects(lists, partial, np.sort(np.concatenate(keys)))


def _sampled_states(seen: Tracks, rows: Int) -> Float:
    """(R, 4) x, y, speed and heading in one run."""
    vx_mps, vy_mps = seen.vx_mps[0, rows], seen.vy_mps[0, rows]
    return np.stack([seen.x_m[0, rows], seen.y_m[0, rows], np.hypot(vx_mps, vy_mps), seen.yaw_rad[0, rows]], axis=1)

"""The receiver: what it makes of the lists that arrive, configuration by configuration (f of the paper's coPEM)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from copem_replay.communication.arrivals import FusionSchedule, fusion_schedule
from copem_replay.communication.kept import Sent, kept_entries
from copem_replay.communication.link import taken_in, transmit
from copem_replay.communication.ready import when_ready
from copem_replay.core.followed import followed_by
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.object_list import ObjectLists, TellsOf
from copem_replay.core.random import CounterRng, RandomKey, object_words
from copem_replay.core.time_chunk import WHOLE, TimeChunk
from copem_replay.core.tracks import TRUTH, Bool, Float, Int, Scene, Tracks, joined
from copem_replay.core.unit_faults import UnitFaults
from copem_replay.experiment.schema import Configuration
from copem_replay.fusion.base import Ideal, ListFusion, fused_by, resumed_by
from copem_replay.fusion.ideal import beside_newest, draw_posterior, fuse, kept_by_object
from copem_replay.fusion.inputs import Claims, RowEntries, inputs, listed_rows, with_kept
from copem_replay.perception.ghosts import GhostRows, ghost_draws, ghosts_in
from copem_replay.perception.observation import Observations
from copem_replay.perception.outages import without_outages
from copem_replay.perception.perceive import with_states
from copem_replay.pipeline.conversions import as_lists
from copem_replay.pipeline.expansion import ExpandedExperiment
from copem_replay.pipeline.perceived import Perceived, States, perceived
from copem_replay.pipeline.sent import claimed_rows
from copem_replay.pipeline.stated_captures import StatedCaptures, stated_captures

if TYPE_CHECKING:
    from copem_replay.io.recorded_units import RecordedUnits
    from copem_replay.perception.sensor_poses import SensorPoses
    from copem_replay.pipeline.on_air import OnAir


@dataclass(frozen=True)
class WorldChunk:
    """One log, or a time chunk of one, as the units of an experiment have it: what of it is the same in all runs.

    `truth` at its own frames; `found`: rows of the modelled units, `recorded` those of the others. `experiment` has a
    unit per carrier. What was captured before the time chunk and is needed in it is there, too, since `earliest_s`.
    `placed`: where the units are, for their ghosts. `on_air`: the input of drawn links. `perceived`: of all
    runs of a block that go one by one, None: each run is perceived by itself.
    """

    scene: Scene
    truth: Tracks
    found: Observations
    recorded: RecordedUnits | None
    experiment: ExpandedExperiment
    chunk: TimeChunk = WHOLE
    placed: SensorPoses | None = None
    earliest_s: float = -np.inf
    on_air: OnAir | None = None
    perceived: Perceived | None = None


@dataclass(frozen=True)
class ReceiverOutput:
    """What one configuration's receiver issues in the runs (S,) at its instants, `at`.

    `fused_tracks`: of ideal fusion and the truth, which know the objects; else None. `lists` are the same without
    truth ids, or what another fusion gave; one run where all runs agree. `tells_of`: of which instant entries tell;
    `whole`: the instants are those of the whole log, not of a time chunk. `stated`: what a fusion was told of captures,
    in one run; None: the truth. `faults`: what of the lists is false or missing in it, where units have such. `sent`:
    `heard` before it went by links.
    """

    heard: Tracks
    sent: Tracks
    at: FusionSchedule
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
        return self.told if self.stated is None else self.stated.true_lists(self.told, self.at.issue_s)

    @cached_property
    def told(self) -> ObjectLists:
        """The same with the captures that their entries tell of."""
        if self.fused is not None:
            return self.fused
        assert self.fused_tracks is not None
        return as_lists(self.fused_tracks, self.scene)

    @property
    def captures_told_s(self) -> Float:
        """(F,) the captures of the lists that were heard, as fusion was told of them."""
        return self.heard.captured_s if self.stated is None else self.stated.stated_s


def seen_by_all(
    world: WorldChunk,
    runs: Int,
    *,
    states: States,
    equipped: Bool | None = None,
    ghosts: GhostRows | None = None,
) -> Tracks:
    """What every unit lists in the runs (S,), whatever its lists come from. `equipped (S, U)` as in `perceive`.

    Where units have outages, or `ready` is drawn, lists differ from run to run: they are asked for one run at a time.
    So it is with `ghosts`, rows without an object: they come after those of objects, and before what is recorded.
    """
    experiment = world.experiment
    if world.perceived is not None:
        seen = world.perceived.seen(world, int(runs[0]), states)
    else:
        seen = perceived(world, runs, states, equipped)
    if ghosts is not None:
        drawn = ghost_draws(world.scene, ghosts, experiment, int(runs[0]))
        seen = followed_by(seen, with_states(world.scene, ghosts.found.tracks, ghosts.found, experiment, drawn))
    seen = without_outages(world.scene, seen, experiment, runs)
    seen = when_ready(seen, experiment.ready, CounterRng(experiment.seed, world.scene.log), runs)
    if world.on_air is not None and (sent := world.on_air.sent) is not None:
        words = object_words(world.scene.object_ids)[world.found.tracks.row_object_ix]
        seen = sent.of(seen, words if ghosts is None else np.concatenate([words, ghosts.words]))
    if world.recorded is None:
        return seen
    recorded = world.recorded.tracks
    recorded = replace(recorded, valid=np.broadcast_to(recorded.valid, (len(runs), len(recorded.frame_ix))))
    both = joined((*seen.units, *recorded.units), [seen, recorded])
    # In the experiment's order: it decides between lists that arrive together.
    names = tuple(experiment.units)
    place = np.array([names.index(name) for name in both.units])
    return replace(both, units=names, unit_ix=place[both.unit_ix], frame_unit_ix=place[both.frame_unit_ix])


def listen(
    seen: Tracks,
    world: WorldChunk,
    name: str,
    there: Bool | None = None,
    *,
    ticks: bool = True,
) -> Tracks:
    """What reaches the receiver of the configuration `name`: the lists of its units, late; those of the others never.

    `there (U,)`: which units there are, None: all. Nothing is copied: configurations share the rows, and what was drawn
    for them. `ticks=False`: when lists arrive, not when they are taken in (`issue_hz`). Raises InputError where
    a link of the user's own fails.
    """
    experiment, scene, on_air = world.experiment, world.scene, world.on_air
    configuration, links = experiment.configurations[name], experiment.links_of(name)
    of_truth = configuration.units == TRUTH
    lists = world.truth if of_truth else seen
    air = None if on_air is None else on_air.of(lists, scene, experiment.seed)
    heard = None if of_truth else set(experiment.units_of(configuration))
    if heard is not None and there is not None:
        heard &= {name for name, present in zip(seen.units, there, strict=True) if present}
    arriving = transmit(lists, links, heard, air=air)
    return taken_in(arriving, configuration.issue_hz) if ticks else arriving


def by_truth(configuration: Configuration) -> bool:
    """Whether a configuration's fused tracks have truth ids: the truth itself, and ideal fusion."""
    made = configuration.recorded is None  # not a stack's own output
    return made and (configuration.units == TRUTH or isinstance(configuration.fusion, Ideal))


class Receivers:
    """The receivers of all configurations, of the units that are `there (U,)`, and what they remember.

    Time chunks of one log are received one after the other, in order of time.
    """

    def __init__(self, runs: Int, there: Bool | None) -> None:
        self._runs, self._there = runs, there
        self._schedules: dict[str, FusionSchedule] = {}
        self._memory: dict[str, Any] = {}

    def issue_s(self, name: str) -> Float:
        """(K,) all instants of a configuration's receiver, when it has been heard of."""
        return self._schedules[name].issue_s

    def receive(self, world: WorldChunk) -> Iterator[tuple[str, ReceiverOutput]]:
        """What each configuration's receiver issues in the runs (S,), in the time chunk.

        Raises InputError where a fusion of the user's own fails.
        """
        experiment = world.experiment
        seen: dict[States, Tracks] = {}  # each is made when first needed
        without_truth: list[tuple[ObjectLists, Int]] = []
        leave_out = set(experiment.partial)
        last: tuple[tuple[bool, States, bytes, bytes], FusedTracks] | None = None

        ghosts = ghosts_of(world, self._runs)

        def seen_in(states: States) -> Tracks:
            if states not in seen:
                false = ghosts if states == "sampled" else None
                seen[states] = seen_by_all(world, self._runs, states=states, ghosts=false)
            return seen[states]

        for name, configuration in experiment.configurations.items():
            fusion, of_truth = configuration.fusion, configuration.units == TRUTH
            max_age_s = configuration.max_age_s
            posterior = isinstance(fusion, Ideal) and fusion.combine == "posterior" and not of_truth
            states: States = "expected" if posterior else "sampled"
            sent = world.truth if of_truth else seen_in(states)
            heard = listen(seen_in(states), world, name, self._there)
            if name not in self._schedules:
                self._schedules[name] = fusion_schedule(heard, max_age_s=max_age_s)
            partial = np.array([unit in leave_out for unit in heard.units], dtype=bool)
            faults = None if of_truth else _faults(world, seen_in(states), None if posterior else ghosts)
            if isinstance(fusion, Ideal) and faults is not None:
                faults = replace(faults, ghosts=faults.ghosts[:0])  # it knows them for what they are
            schedule = self._schedules[name]
            at = schedule.between(world.chunk.from_s, world.chunk.until_s)
            whole = world.chunk == WHOLE
            if isinstance(fusion, ListFusion):
                if not without_truth:
                    without_truth.append(_without_truth(world, seen_in("sampled"), self._runs, ghosts))
                stated, (lists, same) = None, without_truth[0]
                if experiment.runs_apart:  # then the block has one
                    stated = stated_captures(world.scene, heard, experiment, int(self._runs[0]))
                if stated is not None:
                    lists = stated.as_told(lists)
                captured_s = None if stated is None else stated.stated_s
                told = inputs(heard, lists, max_age_s=max_age_s, at=at, captured_s=captured_s)
                if partial.any():
                    kept = kept_entries(heard, Sent(lists.start[0], same), partial, schedule, at, max_age_s=max_age_s)
                    told = with_kept(told, kept, partial, max_age_s)
                where = f"configurations.{name}.fusion"
                if fusion.resumable:
                    fused, self._memory[name] = resumed_by(fusion, told, self._memory.get(name), where)
                else:  # such a log is one time chunk
                    fused = fused_by(fusion, told, where)
                tells_of = fusion.tells_of
                yield name, ReceiverOutput(heard, sent, at, None, world.scene, fused, tells_of, whole, stated, faults)
                continue
            # Later lists of the same captures, as in a sweep of latencies, are fused once.
            of_partial = None
            if partial.any():
                of_partial = kept_by_object(heard, partial, schedule, at, max_age_s=max_age_s)
            known = b"" if of_partial is None else of_partial.entry.tobytes()
            beside = b"".join(part.tobytes() for part in beside_newest(heard, at, of_partial))
            made_of = (of_truth, states, at.newest.tobytes(), beside + known)
            if last is None or last[0] != made_of:
                ego = world.scene.ego_ix
                weighed = None
                if world.perceived is not None and not of_truth:
                    weighed = world.perceived.weighed(world, states, heard)
                made = fuse(heard, max_age_s=max_age_s, without_object_ix=ego, at=at, kept=of_partial, weighed=weighed)
                last = made_of, made
            fused_tracks = last[1].arriving(heard, at.issue_s)
            if not of_truth and world.recorded is None:
                fused_tracks = replace(fused_tracks, view=world.found.view)
            if posterior:
                fused_tracks = draw_posterior(fused_tracks, world.scene, experiment.seed, self._runs)
            yield name, ReceiverOutput(heard, sent, at, fused_tracks, world.scene, None, whole=whole, faults=faults)


def ghosts_of(world: WorldChunk, runs: Int) -> GhostRows | None:
    """Ghosts of the units, where a block has one run and there is a fusion without truth ids."""
    if not world.experiment.runs_apart or world.placed is None:
        return None
    between_s = world.earliest_s, world.chunk.until_s
    return ghosts_in(world.scene, world.found, world.experiment, world.placed, int(runs[0]), between_s)


def receive(world: WorldChunk, runs: Int, there: Bool | None) -> Iterator[tuple[str, ReceiverOutput]]:
    """What each configuration's receiver issues in a whole log."""
    return Receivers(runs, there).receive(world)


def _faults(world: WorldChunk, seen: Tracks, ghosts: GhostRows | None) -> UnitFaults | None:
    """What of the lists of one run is false or missing; None: no unit has such."""
    if ghosts is None and not world.experiment.outages:
        return None
    first = len(world.found.tracks.frame_ix)
    rows = np.arange(first, first + (0 if ghosts is None else len(ghosts.words)))
    not_made = np.isinf(seen.common_arrives_s)
    if world.on_air is not None and (sent := world.on_air.sent) is not None:
        not_made[: len(sent.lists)] &= sent.lists  # what is held back is made
    return UnitFaults(rows, not_made)


def _without_truth(
    world: WorldChunk, seen: Tracks, runs: Int, ghosts: GhostRows | None = None
) -> tuple[ObjectLists, Int]:
    """The units' lists as a real fusion sees them: no truth ids, and in no order that means anything.

    And for units whose messages are partial which entries (N,) each takes for one object.
    """
    experiment, rng, ego = world.experiment, CounterRng(world.experiment.seed, world.scene.log), world.scene.ego_ix
    none = np.empty(0, dtype=np.int64)
    as_perceived = not (experiment.sends or experiment.outages or experiment.draws_claims)
    if world.perceived is not None and world.recorded is None and as_perceived:
        s, of_rows, random_key = world.perceived.entries(world, int(runs[0]), lambda every: _entries(world, every))
        drawn = rng.uniform("order in the list", random_key, runs)
        return of_rows.lists(seen, drawn, s, without_object_ix=ego), none
    rows, recorded = claimed_rows(world, runs, ghosts), world.recorded
    words, same = rows.words, rows.same
    claims = Claims(rows.claims.existence, rows.claims.class_probability, rows.claims.track_id)
    if recorded is not None:
        words = np.concatenate([words, np.arange(len(recorded.existence), dtype=np.uint64)])
        same = np.concatenate([same, words[len(same) :]])
        claims = Claims(
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
    of = np.stack([seen.row_unit_ix[picked].astype(np.uint64), same[picked]])
    return lists, np.unique(of, axis=1, return_inverse=True)[1].ravel()


def _entries(world: WorldChunk, seen: Tracks) -> tuple[RowEntries, RandomKey]:
    """Rows of lists of which nothing is drawn but which there are and their states; and their units."""
    rows = claimed_rows(world, np.empty(0, dtype=np.int64), None)
    claims = Claims(rows.claims.existence, rows.claims.class_probability, rows.claims.track_id)
    return RowEntries(seen, claims), RandomKey(seen.units, seen.row_unit_ix, rows.words, seen.stamp_ns[seen.frame_ix])

"""The world of a time chunk: what units perceive, put on air and send of it, drawn once for all configurations."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from copem_replay.communication.link import KeptDraws, LinkInput
from copem_replay.communication.radio import Radio
from copem_replay.communication.reception import RadioPath
from copem_replay.communication.sends import LastSent, ListedObjects
from copem_replay.core.errors import ExperimentError
from copem_replay.core.lasting import ListStamps
from copem_replay.core.memory import UnitDraws
from copem_replay.core.random import CounterRng, RandomKey, Words, object_words, stable_hash
from copem_replay.core.tracks import CLASSES, TRUTH, WHOLE, Bool, Float, Int, Scene, TimeChunk, Tracks, class_indices
from copem_replay.fusion.ideal import WeightedRows
from copem_replay.perception.ghosts import GhostRows, make_ghost_draws
from copem_replay.perception.observation import Observations
from copem_replay.perception.perceive import DrawnClaims, draw_claims, make_draws, perceive
from copem_replay.pipeline.expansion import ExpandedExperiment

if TYPE_CHECKING:
    from copem_replay.fusion.inputs import RowEntries
    from copem_replay.io.recorded_units import RecordedUnits
    from copem_replay.perception.sensor_poses import SensorPoses


# Perceived: what modelled units list in all runs of a block, drawn at once; runs replayed one by one have views.

States = Literal["true", "expected", "sampled"]


def perceive_modelled(world: WorldChunk, runs: Int, states: States, equipped: Bool | None) -> Tracks:
    """What the modelled units list in the runs (S,); `equipped (S, U)`: which of all units there are, None: all."""
    if equipped is not None:
        equipped = equipped[:, [k for k, unit in enumerate(world.experiment.units.values()) if unit.recorded is None]]
    return perceive(world.scene, world.observations, world.experiment, runs, states=states, equipped=equipped)


class Perceived:
    """What modelled units list in runs (S,) with the same units, `equipped (1, U)`; drawn when it is first needed."""

    def __init__(self, runs: Int, equipped: Bool | None) -> None:
        self._number = {run: s for s, run in enumerate(runs.tolist())}
        self._runs, self._equipped = runs, equipped
        self._seen: list[tuple[Observations, States, Tracks]] = []
        self._entries: tuple[Observations, RowEntries, RandomKey] | None = None
        self._weighed: tuple[Tracks, WeightedRows] | None = None
        self._on_air: tuple[int, OnAir | None] | None = None

    def seen(self, world: WorldChunk, run: int, states: States) -> Tracks:
        """What the modelled units list in one of the runs, of the rows of the chunk."""
        return self._all(world, states).take_run(self._number[run])

    def entries(
        self, world: WorldChunk, run: int, compute: Callable[[Tracks], tuple[RowEntries, RandomKey]]
    ) -> tuple[int, RowEntries, RandomKey]:
        """The index of the run, and rows as entries with their key: `compute` of what all runs list with errors."""
        if self._entries is None or self._entries[0] is not world.observations:
            self._entries = world.observations, *compute(self._all(world, "sampled"))
        return self._number[run], *self._entries[1:]

    def weighed(self, world: WorldChunk, states: States, received: Tracks) -> WeightedRows | None:
        """The weights of ideal fusion in all runs, if it hears what is listed in all; None: it hears other lists."""
        listed = self._all(world, states)
        if not WeightedRows.alike(listed, received):
            return None
        if self._weighed is None or self._weighed[0] is not listed:
            self._weighed = listed, WeightedRows.of(listed)
        return self._weighed[1]

    def on_air(self, run: int, compute: Callable[[], OnAir | None]) -> OnAir | None:
        """The input of drawn links in one of the runs, computed once for the calls before the next run."""
        if self._on_air is None or self._on_air[0] != run:
            self._on_air = run, compute()
        return self._on_air[1]

    def _all(self, world: WorldChunk, states: States) -> Tracks:
        for observations, kind, seen in self._seen:
            if observations is world.observations and kind == states:
                return seen
        seen = perceive_modelled(world, self._runs, states, self._equipped)
        self._seen.append((world.observations, states, seen))
        return seen


@dataclass(frozen=True)
class WorldChunk:
    """A log, or a time chunk of one, as the units of an experiment have it: what is the same in all runs.

    `truth` at its own frames; `observations`: rows of the modelled units; `recorded`: lists of the recorded ones.
    Includes earlier captures that the chunk needs, back to `earliest_s`. `placed`: where units are, for their ghosts.
    `on_air`: the input of drawn links. `perceived`: what units list in all runs of a block that are replayed one by
    one; None: each call perceives anew.
    """

    scene: Scene
    truth: Tracks
    observations: Observations
    recorded: RecordedUnits | None
    experiment: ExpandedExperiment
    chunk: TimeChunk = WHOLE
    placed: SensorPoses | None = None
    earliest_s: float = -np.inf
    on_air: OnAir | None = None
    perceived: Perceived | None = None


# On air: the input of drawn links: one run's draws, the path to the ego, and the length of lists.


@dataclass(frozen=True)
class OnAir:
    """The lists (F,) of all units in one run, on air: the path of each to the ego, and how many `objects` it has.

    Both None where no link asks for them. `sent`: what units send of their lists; None: all. `kept`: draws of links for
    lists of this log.
    """

    run: int
    path: RadioPath | None
    objects: Int | None
    sent: SentObjects | None = None
    kept: KeptDraws = field(default_factory=KeptDraws)

    def of(self, lists: Tracks, scene: Scene, seed: int) -> LinkInput:
        """The input of links of these lists; the truth's lists have no path and no length."""
        of_units = lists.units != (TRUTH,)
        F = len(lists.stamp_ns)
        # The address of a draw: sender, receiver and capture.
        word = object_words([scene.object_ids[scene.ego_ix]])[0] if scene.ego_ix >= 0 else stable_hash("everyone")
        random_key = RandomKey(lists.units, lists.frame_unit_ix, np.full(F, word, dtype=np.uint64), lists.stamp_ns)
        stamps = ListStamps(lists.stamp_ns, lists.frame_unit_ix, np.arange(F))
        draws = UnitDraws(CounterRng(seed, scene.log), random_key, stamps, np.array([self.run]))
        return LinkInput(draws, self.path if of_units else None, self.objects if of_units else None, self.kept)


def asks_for_path(experiment: ExpandedExperiment, scene: Scene) -> bool:
    """Whether a link depends on the path to the receiver. Raises ExperimentError where the path is not known."""
    asked = False
    for name, configuration in experiment.configurations.items():
        for unit_links in experiment.links_of(name):
            if not (isinstance(unit_links.link, Radio) and unit_links.link.loses and unit_links.link.reception.by_path):
                continue
            asked, where = True, f"{scene.log}: {unit_links.where}.reception: {unit_links.link.reception.kind}"
            if scene.ego_ix < 0:
                raise ExperimentError(
                    f"{where}: the distance to a receiver is unknown, for the log has no ego; use constant"
                )
            units = experiment.units_of(configuration) if unit_links.units is None else unit_links.units
            far = [TRUTH] if configuration.units == TRUTH else sorted(experiment.recorded.keys() & set(units))
            if far:
                source = "of the truth" if far == [TRUTH] else f"of unit {far[0]}, whose lists are recorded,"
                raise ExperimentError(f"{where}: the distance {source} to a receiver is not known; use constant")
    return asked


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


def find_radio_paths(of_ego: Observations, scene: Scene, experiment: ExpandedExperiment, lists: Tracks) -> RadioPath:
    """The path of each list (F,) of all units to the ego. `of_ego`: the ego's observation rows.

    `lists`: those of all units, the modelled ones' first. A list aboard the ego has distance 0, one of a recorded unit
    NaN, one without an observation of the ego ∞.
    """
    F = len(lists.stamp_ns)
    distance_m: Float = np.full(F, np.inf)
    visible_share: Float = np.zeros(F)
    distance_m[of_ego.tracks.frame_ix] = of_ego.view.range_m
    visible_share[of_ego.tracks.frame_ix] = of_ego.view.visible_share
    ego = scene.object_ids[scene.ego_ix]
    aboard = [name for name, unit in experiment.modelled.items() if unit.on in ("ego", ego)]
    is_aboard = np.array([name in aboard for name in lists.units], dtype=bool)[lists.frame_unit_ix]
    is_recorded = np.array([name in experiment.recorded for name in lists.units], dtype=bool)[lists.frame_unit_ix]
    distance_m[is_aboard], visible_share[is_aboard] = 0.0, 1.0
    distance_m[is_recorded] = visible_share[is_recorded] = np.nan
    return RadioPath(distance_m, visible_share)


# Sends: what units send of what they list in one run, decided list by list over the whole log by what they list
# themselves, with errors and false positives.

_VRU = class_indices(("vru",))


@dataclass(frozen=True)
class ClaimedRows:
    """What the modelled units claim of their rows (P,), ghosts last, in one run.

    `words`: the word of the object or ghost. `same`: equal for rows that the unit takes for one object; no index.
    """

    words: Words
    claims: DrawnClaims
    same: Words


def claim_rows(world: WorldChunk, runs: Int, ghosts: GhostRows | None) -> ClaimedRows:
    """The claims of the rows of a time chunk, the same in all runs where no claim is drawn."""
    observations, experiment = world.observations, world.experiment
    words = object_words(world.scene.object_ids)[observations.tracks.row_object_ix]
    claims = DrawnClaims(
        observations.existence, np.eye(len(CLASSES))[observations.view.class_ix], np.full(len(words), -1)
    )
    if experiment.runs_apart and experiment.draws_claims:  # else no receiver needs it
        claims = draw_claims(observations, experiment, make_draws(world.scene, observations, experiment, runs))
    same = words
    if ghosts is not None:
        drawn = make_ghost_draws(world.scene, ghosts, experiment, int(runs[0]))
        of_ghosts = draw_claims(ghosts.observations, experiment, drawn, ghosts.sort)
        claims = DrawnClaims(
            np.concatenate([claims.existence, of_ghosts.existence]),
            np.concatenate([claims.class_probability, of_ghosts.class_probability]),
            np.concatenate([claims.track_id, of_ghosts.track_id]),
        )
        words = np.concatenate([words, ghosts.words])
        same = words
    # A unit with track ids takes entries of one id for one object.
    same = np.where(claims.track_id >= 0, claims.track_id.astype(np.uint64), same)
    return ClaimedRows(words, claims, same)


@dataclass(frozen=True)
class SentObjects:
    """What units send in one run: `lists (F,)` not held back, and `keys` of the rows that `partial (U,)` units send."""

    lists: Bool
    partial: Bool
    keys: Words

    def of(self, seen: Tracks, words: Words) -> Tracks:
        """The rows of the modelled units that are sent; `words (P,)`: the words of their objects."""
        left_out = self.partial[seen.row_unit_ix] & ~np.isin(_key_rows(seen.frame_ix, words), self.keys)
        arrives_s = np.where(self.lists, seen.common_arrives_s, np.inf)
        return replace(seen, valid=seen.valid & ~left_out & self.lists[seen.frame_ix], arrives_s=arrives_s[None])


def _key_rows(frame_ix: Int, words: Words) -> Words:
    """(P,) a number for each row: never equal within a list, and practically never between lists."""
    return words ^ _mix_bits(frame_ix.astype(np.uint64))


def _mix_bits(numbers: Words) -> Words:
    result: Words = numbers * np.uint64(0x9E3779B97F4A7C15)  # an odd factor: one to one
    return result


def select_sent_objects(
    experiment: ExpandedExperiment, chunks: Iterable[tuple[WorldChunk, Tracks, ClaimedRows]]
) -> SentObjects:
    """What units send of the lists of one run. `chunks`: what they list, with errors, and claim, chunk after chunk.

    Lists have the same numbers in all chunks.
    """
    units = list(experiment.modelled)
    last = LastSent([experiment.sends.get(name) for name in units])
    sending = np.array([name in experiment.sends for name in units], dtype=bool)
    partial = np.array([name in experiment.partial for name in units], dtype=bool)
    slots: dict[tuple[int, int], int] = {}
    lists, keys = np.zeros(0, dtype=bool), [np.zeros(0, dtype=np.uint64)]
    for world, seen, rows in chunks:
        if not len(lists):
            lists = np.ones(len(seen.stamp_ns), dtype=bool)
        chunk = world.chunk
        frames = np.flatnonzero(
            sending[seen.frame_unit_ix] & np.isfinite(seen.common_arrives_s)
            & (seen.captured_s >= chunk.from_s) & (seen.captured_s < chunk.until_s)
        )  # fmt: skip
        frames = frames[np.argsort(seen.captured_s[frames], kind="stable")]
        order, bounds = seen.by_frame
        counts = np.diff(bounds)[frames]
        begin = np.cumsum(counts) - counts
        listed = order[np.repeat(bounds[frames] - begin, counts) + np.arange(counts.sum())]
        valid = seen.valid[0, listed]
        start = np.append(0, np.cumsum(valid))[np.append(begin, len(listed))]
        listed = listed[valid]
        pairs, which = np.unique(
            np.stack([seen.row_unit_ix[listed].astype(np.uint64), rows.same[listed]]), axis=1, return_inverse=True
        )
        slot = np.array([slots.setdefault((u, w), len(slots)) for u, w in pairs.T.tolist()], dtype=np.int64)
        sent, included = last.choose(
            ListedObjects(
                start, seen.frame_unit_ix[frames], seen.captured_s[frames], slot[which.ravel()], rows.words[listed],
                np.isin(rows.claims.class_probability[listed].argmax(axis=1), _VRU), _sampled_states(seen, listed),
                rows.claims.existence[listed],
            )
        )  # fmt: skip
        lists[frames[~sent]] = False
        keys.append(_key_rows(seen.frame_ix[listed[included]], rows.words[listed[included]]))
    return SentObjects(lists, partial, np.sort(np.concatenate(keys)))


def _sampled_states(seen: Tracks, rows: Int) -> Float:
    """(R, 4) x, y, speed and heading in one run."""
    vx_mps, vy_mps = seen.vx_mps[0, rows], seen.vy_mps[0, rows]
    return np.stack([seen.x_m[0, rows], seen.y_m[0, rows], np.hypot(vx_mps, vy_mps), seen.yaw_rad[0, rows]], axis=1)

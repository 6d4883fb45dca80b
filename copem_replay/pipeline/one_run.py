"""One run of one log: which runs are shown, their fused tracks by configuration, and curves of visible share."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd

from copem_replay.core.errors import ExperimentError, count_noun
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.object_list import Entries
from copem_replay.core.tracks import SAME_INSTANT_S, TRUTH, Bool, Float, Int, TimeChunk, Tracks
from copem_replay.experiment.schema import Experiment
from copem_replay.fusion.interface import ListFusion
from copem_replay.io.encodings.column_bytes import expand_ranges
from copem_replay.io.recording import Recording
from copem_replay.io.write.detail import ReadyLists
from copem_replay.metrics.onset import select_counted
from copem_replay.perception.observation import Observations
from copem_replay.perception.sensor_poses import couple_polygons, find_carrier
from copem_replay.pipeline.chain import fuse_members
from copem_replay.pipeline.expansion import RunGroup, group_runs, resolve_for_run
from copem_replay.pipeline.prepare import ROWS_HELD, Replay, observation_rows, prepare_log
from copem_replay.pipeline.receiver import (
    Receivers,
    StatedCaptures,
    make_entry_tracks,
    remove_truth_ids,
    state_captures,
    states_needed,
)
from copem_replay.pipeline.scoring import match_run
from copem_replay.pipeline.world import Transmission, WorldChunk

if TYPE_CHECKING:
    from copem_replay.pipeline.run import StudyTables


@dataclass(frozen=True)
class RunTracks:
    """The receiver's fused tracks in one run, by configuration, chunk after chunk.

    Can be iterated several times: the tracks of a log in one time chunk are kept, those of a longer one computed anew.
    """

    replay: Replay
    experiment: Experiment
    run: int

    def __iter__(self) -> Iterator[dict[str, FusedTracks]]:
        for chunk in self.chunks():
            yield chunk.fused

    def chunks(self) -> Iterator[RunChunk]:
        """Pairs of the fused tracks of a time chunk and the unit lists that they are made of."""
        if len(self.replay.chunks) == 1:
            yield self._all
        else:
            yield from self._compute()

    def whole(self) -> dict[str, FusedTracks]:
        """The tracks of the whole log. Raises ExperimentError where the log is too long for that."""
        replay = self.replay
        if len(replay.chunks) == 1:
            return self._all.fused
        if observation_rows(replay.scene, replay.truth, replay.expanded) > ROWS_HELD:
            raise ExperimentError(f"{replay.scene.log}: too long to be held at once; take a window of it")
        return replace(self, replay=replace(replay, chunks=(TimeChunk(),))).whole()

    @cached_property
    def _all(self) -> RunChunk:
        return next(self._compute())

    def _compute(self) -> Iterator[RunChunk]:
        """By chunk: the fused tracks of this run by configuration, and a function that gives its units' lists."""
        replay, measure = self.replay, self.experiment.measure
        units = replay.expand(self.experiment)
        [group] = group_runs(units, replay.scene.log, np.array([self.run]))
        lists = Transmission(fuse_members(replay, units, group), units, group)
        receivers = Receivers(lists)
        for world in receivers.worlds():
            truth_cache, result, arriving = replay.truth_cache_of(world.chunk), {}, dict[str, Tracks]()
            for name in units.configurations:
                output = receivers.fuse(world, name)
                arriving[name] = lists.arriving(name)
                matches = match_run(truth_cache, output, measure) if output.fused_tracks is None else None
                [(_, fused_tracks)] = output.tracks_by_run(matches)
                if output.faults is not None:
                    fused_tracks = replace(fused_tracks, faults=output.faults)
                if units.sends and (states := states_needed(units.configurations[name])) is not None:
                    left_out = world.listed(states).valid[0] & ~output.sent.valid[0]
                    fused_tracks = replace(fused_tracks, left_out=left_out)
                if linked := units.linked(name):
                    fused_tracks = replace(fused_tracks, by_link=_is_sent_by_link(output.sent, linked, group))
                result[name] = fused_tracks
            yield RunChunk(result, partial(collect_unit_lists, world, lists, arriving))


class RunChunk(NamedTuple):
    """The fused tracks of a run in one time chunk, by configuration, and the source of its units' lists."""

    fused: dict[str, FusedTracks]
    unit_lists: Callable[[], list[ReadyLists]]


def collect_unit_lists(world: WorldChunk, sent: Transmission, arriving: Mapping[str, Tracks]) -> list[ReadyLists]:
    """The lists that modelled units have ready to send in a time chunk of one run, in the form that fusions get.

    `arriving`: by configuration the lists by when they reach its receiver.
    """
    chunk, experiment, all_lists = world.chunk, world.experiment, sent.lists
    ready_s = all_lists.common_arrives_s
    ready = np.isfinite(ready_s) & (ready_s >= chunk.from_s) & (ready_s < chunk.until_s)
    earliest_s = float(all_lists.captured_s[ready].min(initial=np.inf)) - SAME_INSTANT_S
    if earliest_s < world.earliest_s:
        world = sent.world(chunk, earliest_s)
    if experiment.draws_claims and not experiment.runs_apart:
        world = replace(world, claiming=True, _listed={}, _sent={})
    entries, _, rows = remove_truth_ids(world)
    captures = state_captures(world.scene, all_lists, experiment, int(world.group.runs[0]))
    result = []
    for name, sends in zip(all_lists.units, world.group.sending, strict=True):
        if name not in experiment.recorded and sends:
            frames = np.flatnonzero(ready & (all_lists.frame_unit_ix == all_lists.units.index(name)))
            frames = frames[np.argsort(ready_s[frames], kind="stable")]
            start, places = expand_ranges(entries.start[0], frames)
            lists = _make_unit_tracks(world, name, frames, start, entries.entries[places], rows[places], captures)
            heard = (c for c, of in experiment.configurations.items() if name in experiment.units_of(of))
            arrives_s = {c: arriving[c].common_arrives_s[frames] for c in heard}
            fields, posed = _find_fields(world, name, all_lists.stamp_ns[frames])
            true_ns = None if captures is None else all_lists.stamp_ns[frames]
            has_ids = _states_ids(experiment, name)
            result.append(ReadyLists(name, lists, true_ns, arrives_s, fields, posed, has_ids))
    return result


def _states_ids(experiment: Experiment, name: str) -> bool:
    """Whether the entries of a unit have track ids: those of its PEM, or of its fusion."""
    unit = experiment.units[name]
    if unit.pem is not None:
        return experiment.pems[unit.pem].tracks is not None
    return isinstance(unit.fusion, ListFusion) and unit.fusion.remembers


def _find_fields(world: WorldChunk, name: str, stamp_ns: Int) -> tuple[list[Float], Float]:
    """Polygons of the field of view of a unit, and its poses (4, F) at captures; of one that fuses there are none."""
    pem = world.experiment.units[name].pem
    if pem is None:
        return [], np.empty((4, len(stamp_ns)))
    poses = world.log.placed.poses[name]
    at = np.searchsorted(world.log.placed.stamps_ns[name], stamp_ns)
    posed = np.stack([poses.x_m, poses.y_m, poses.ground_m, poses.heading_rad])[:, at]
    return couple_polygons(world.experiment.pems[pem].couples), posed


def _make_unit_tracks(
    world: WorldChunk, name: str, frames: Int, start: Int, entries: Entries, rows: Int, stated: StatedCaptures | None
) -> FusedTracks:
    """The entries (P,) of a unit's lists as tracks of one entry each; `rows (P,)`: their rows in what units send."""
    sent, frame_ix, claims = world.sent("sampled"), np.repeat(np.arange(len(frames)), np.diff(start)), entries.copy()
    captured_s = (sent.captured_s if stated is None else stated.stated_s)[frames]
    age_s = 0.0 if sent.entry_age_s is None else sent.entry_age_s[0, rows]
    claims["unit_ix"], claims["captured_s"] = 0, captured_s[frame_ix] - age_s
    stamps = world.scene.t0_ns + np.rint(captured_s * 1e9).astype(np.int64), captured_s, sent.common_arrives_s[frames]
    tracks = make_entry_tracks(name, claims, np.arange(len(rows) + 1), sent.row_object_ix[rows], frame_ix, stamps)
    extra: dict[str, Any] = {of: getattr(sent, of) for of in ("yaw_var_rad2", "size_var_m2", "speed_var_m2ps2")}
    extra = {of: None if column is None else column[:, rows] for of, column in extra.items()}
    zeros = np.zeros(len(rows) + 1, dtype=np.int64)
    return FusedTracks(replace(tracks, **extra), tracks, zeros[:0], zeros, said=claims)


def _is_sent_by_link(sent: Tracks, linked: list[str], group: RunGroup) -> Bool:
    """(F,) which lists a unit that is there in this run sends by a link."""
    sending = np.array([name in linked for name in sent.units])
    if sent.units != (TRUTH,):
        sending &= group.sending
    sent_by_link: Bool = sending[sent.frame_unit_ix] & np.isfinite(sent.common_arrives_s)
    return sent_by_link


def tracks_of_run(replay: Replay, experiment: Experiment, run: int) -> dict[str, FusedTracks]:
    """The receiver's fused tracks in one run of a log that is not long."""
    return RunTracks(replay, experiment, run).whole()


# Shown runs: which runs of which logs are written to MCAP and .rrd, and under which names.

STEM = "replay"
"""The stem of the first run's files; those of further runs are `replay_<number, median, worst or best>`."""


@dataclass(frozen=True)
class ShownRun:
    """A run that is shown: its number, the reason (empty: asked for by number), and the stem of its files."""

    run: int
    why: str
    stem: str


def select_shown_runs(study: StudyTables, log: str) -> tuple[ShownRun, ...]:
    """The runs of a log that are written to MCAP and .rrd, in the order of the experiment; none with `run: null`.

    `median` (of an even number the lower), `worst` and `best` go by the time to detection summed over all
    configurations and the measured objects that count (`measure.began`; all where none does), each up to the horizon,
    which never detected counts as; of equal runs the first is taken. Of a log without rows it is the first run.
    """
    experiment = study.experiment
    choices = experiment.show.asked() if experiment.show is not None else ()
    rows = _rows_that_count(study, log) if any(isinstance(one, str) for one in choices) else pd.DataFrame()
    return tuple(
        ShownRun(one, "", stem) if isinstance(one, int) else ShownRun(*_rank_run(rows, study.horizon_s, one), stem)
        for one, stem in zip(choices, list_stems(experiment), strict=True)
    )


def _rows_that_count(study: StudyTables, log: str) -> pd.DataFrame:
    """The rows of a log that count; all where none does."""
    rows = study.rows(log)
    counted = select_counted(rows, study.experiment.measure.began)
    return counted if len(counted) else rows


def list_stems(experiment: Experiment) -> list[str]:
    """The stems of the files of the runs that are shown."""
    asked = experiment.show.asked() if experiment.show is not None else ()
    return [STEM if k == 0 else f"{STEM}_{one}" for k, one in enumerate(asked)]


def _rank_run(rows: pd.DataFrame, horizon_s: float, rank: str) -> tuple[int, str]:
    """The run with `median`, `worst` or `best` summed time to detection among a log's rows, and a phrase on why."""
    if not len(rows):
        return 0, f"first, not {rank}, as no measured object has an onset"
    time_s = rows["time_to_detection_s"].fillna(horizon_s).clip(upper=horizon_s)
    total = np.rint(time_s.groupby(rows["run"]).sum() / SAME_INSTANT_S)
    ranked = np.sort(total.to_numpy())
    position = {"best": 0, "median": (len(ranked) - 1) // 2, "worst": -1}[rank]
    equal = total.index[total == ranked[position]]
    configurations = count_noun(rows["configuration"].nunique(), "configuration")
    over = f"{configurations} and {count_noun(rows['object_id'].nunique(), 'object')}"
    why = f"{rank} of {len(ranked)} by time to detection summed over {over}"
    return int(equal[0]), why + (f", the first of {len(equal)} equal" if len(equal) > 1 else "")


def choose_logs(experiment: Experiment, names: Sequence[str]) -> list[str]:
    """The shown logs, out of the names of all."""
    if experiment.show is None or not experiment.show.asked():
        return []
    asked = experiment.show.logs
    if "all" in asked:
        return list(names)
    return [name for k, name in enumerate(names) if name in asked or (k == 0 and "first" in asked)]


@dataclass(frozen=True)
class ReplayedRun:
    """The fused tracks of one run of one log, with the replay and the experiment of the units in that run."""

    replay: Replay
    experiment: Experiment
    run_tracks: RunTracks


def replay_run(recording: Recording, experiment: Experiment, run: int, replay: Replay | None = None) -> ReplayedRun:
    """One run again, with the same draws and lists. `replay`: the prepared log; None: it is prepared here."""
    alone = resolve_for_run(experiment, recording.scene, run)
    if replay is None or alone is not experiment:
        replay = prepare_log(recording, alone, onsets_of=experiment)
    return ReplayedRun(replay, alone, RunTracks(replay, alone, run))


# Curves: the visible share of an object over time, from the ego's units and from all.

BY_EGO, BY_ANY = "ego", "any unit"
"""Names of curves: the best share of the ego's units, and of all."""


@dataclass(frozen=True)
class Curve:
    """Visible share of one object at instants (K,); NaN where no unit has a list of it."""

    elapsed_ns: Int
    share: Float


def share_curves(replay: Replay, observations: Observations, object_ix: int) -> dict[str, Curve]:
    """The visible-share curves of an object by name, of units that have a list. `observations`: its rows, at least."""
    scene, experiment, tracks = replay.scene, replay.expanded, observations.tracks
    stamps, newest = _newest_lists(tracks, experiment.max_gap_s)
    carriers = np.array([find_carrier(scene, unit) for unit in experiment.modelled.values()], dtype=np.int64)
    is_ego = (carriers == scene.ego_ix) & (scene.ego_ix >= 0)
    share = np.full(len(tracks.stamp_ns) + 1, np.nan)  # one more: what −1 points at
    rows = np.flatnonzero(tracks.row_object_ix == object_ix)
    share[tracks.frame_ix[rows]] = observations.view.visible_share[rows]
    # NaN of a unit without a list of the object does not count: the best of the others does.
    return {
        name: Curve(stamps - scene.t0_ns, np.fmax.reduce(share[newest[units]], axis=0))
        for name, units in ((BY_EGO, is_ego), (BY_ANY, np.ones_like(is_ego)))
        if units.any()
    }


def _newest_lists(tracks: Tracks, max_gap_s: float) -> tuple[Int, Int]:
    """All capture instants (K,), and the newest list of each unit then (U, K); −1: none in the last `max_gap_s`."""
    stamps = np.unique(tracks.stamp_ns)
    newest = np.full((len(tracks.units), len(stamps)), -1)
    for unit in range(len(tracks.units)):
        frames = np.flatnonzero(tracks.frame_unit_ix == unit)  # in order of capture
        position = np.searchsorted(tracks.stamp_ns[frames], stamps, side="right") - 1
        recent = position >= 0
        recent[recent] = stamps[recent] - tracks.stamp_ns[frames[position[recent]]] <= max_gap_s * 1e9
        newest[unit, recent] = frames[position[recent]]
    return stamps, newest

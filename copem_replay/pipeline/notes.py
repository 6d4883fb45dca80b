"""Notes on what is odd about a log and an experiment together: before any run, alike in `check` and `run`.

Beside them the facts that results need of a log in addition to its rows: with these a log whose pieces are all kept is
not read.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Self, TypeGuard

import numpy as np

from copem_replay.communication.arrivals import receiver_instants
from copem_replay.communication.radio import Radio
from copem_replay.communication.reception import RadioPath, ReceptionModel, ask_reception_probability
from copem_replay.core.errors import count_noun
from copem_replay.core.frame import Frame
from copem_replay.core.interpolation import wrap_angles
from copem_replay.core.tracks import (
    CLASS_GROUPS,
    CLASSES,
    SAME_INSTANT_S,
    TRUTH,
    Area,
    Bool,
    Float,
    Scene,
    Solid,
    Tracks,
    class_indices,
)
from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.experiment.drive import resolve_for_log, settings_notes
from copem_replay.experiment.schema import Experiment, output_unit
from copem_replay.fusion.interface import IdealFusion
from copem_replay.fusion.tracker import Tracker
from copem_replay.io.findings import as_finding
from copem_replay.io.recording import KnownLog, Recording
from copem_replay.metrics.detection.conflict import describe_excluded
from copem_replay.metrics.episodes import AGAIN_AFTER_S, measured_objects
from copem_replay.metrics.metric import LinkTimes, OutputTimes, link_times
from copem_replay.metrics.onset import BEGAN, InRange, Onset, count_counted, describe_numbers
from copem_replay.perception.config import Carriers
from copem_replay.perception.observation import interpolate_worlds
from copem_replay.perception.pem.condition import may_apply
from copem_replay.perception.pem.model import ObjectSidePlace, Pem
from copem_replay.perception.sensor_poses import UnitPoses
from copem_replay.pipeline.chain import fuse_members
from copem_replay.pipeline.expansion import ExpandedExperiment, RunGroup, find_facts
from copem_replay.pipeline.sweep import describe_unswept
from copem_replay.pipeline.world import Transmission, asks_for_path, has_channel

if TYPE_CHECKING:
    from copem_replay.pipeline.prepare import Replay


# List rates: how often each receiver issues a fused list, and what its links do to the lists it is sent.


@dataclass(frozen=True)
class ListRate:
    """The fused lists of one configuration: number of intervals, the seconds these cover, and what its links do."""

    intervals: int
    covered_s: float
    links: LinkTimes | None

    @property
    def rate_hz(self) -> float | None:
        """Fused lists per second; None: there are fewer than two."""
        return self.intervals / self.covered_s if self.covered_s > 0 else None

    @classmethod
    def read(cls, data: dict[str, Any]) -> Self:
        """From plain data, as `LogFacts.as_json` gives it."""
        links = data["links"]
        if links is not None:
            links = LinkTimes(**links | {name: np.array(links[name]) for name in ("from_s", "to_s")})
        return cls(data["intervals"], data["covered_s"], links)


def measure_list_rates(replay: Replay, experiment: Experiment) -> dict[str, ListRate]:
    """By configuration the lists of all runs, or of the one that stands for all.

    Units that only some runs have count as there in all.
    """
    units, rates = replay.expand(experiment), dict[str, list[ListRate]]()
    for run in range(experiment.runs if units.arrivals_differ else 1):
        group = RunGroup.of_all_units(units, np.array([run]))
        entries = bool(units.sends) or has_channel(units)  # what is sent when depends on what is listed
        lists = Transmission(fuse_members(replay, units, group, entries=entries), units, group)
        for name in units.configurations:
            rates.setdefault(name, []).append(_measure_rate(lists, name))
    return {name: join_list_rates(runs) for name, runs in rates.items()}


def _measure_rate(lists: Transmission, name: str) -> ListRate:
    """The list rate of one configuration in one run: intervals, the time they cover (s), and times on links."""
    units, end_s = lists.experiment, lists.log.scene.end_s
    received = lists.received(name)
    issue_s = receiver_instants(received)
    issue_s = issue_s[(issue_s >= -SAME_INSTANT_S) & (issue_s <= end_s + SAME_INSTANT_S)]
    covered_s = float(issue_s[-1] - issue_s[0]) if len(issue_s) > 1 else 0.0
    links = None
    if linked := units.linked(name):
        sent = lists.truth if units.configurations[name].units == TRUTH else lists.lists
        links = link_times(sent, lists.arriving(name), received, linked, end_s)
    return ListRate(max(len(issue_s) - 1, 0), covered_s, links)


def join_list_rates(times: Iterable[ListRate]) -> ListRate:
    """The sum over runs and logs of one configuration."""
    rates = list(times)
    links = [one.links for one in rates if one.links is not None]
    added = sum(links[1:], links[0]) if links else None
    return ListRate(sum(one.intervals for one in rates), sum(one.covered_s for one in rates), added)


# Output times: how old the recorded outputs of stacks are when they are available, as the recordings tell.


def sum_output_times(recording: Recording, experiment: Experiment, name: str) -> OutputTimes:
    """The sums over the lists of one recorded output that a log has."""
    lists = recording.lists[output_unit(name)]
    available_s, captured_s = lists.tracks.common_arrives_s, lists.tracks.captured_s
    while_it_lasts = (available_s >= -SAME_INSTANT_S) & (available_s <= recording.scene.end_s + SAME_INSTANT_S)
    delay_s = np.where(lists.capture_said, 0.0, experiment.outputs[name].delay_s)[while_it_lasts]
    has_capture = (lists.capture_said | lists.stamped)[while_it_lasts]
    # Rounded to a nanosecond, as stamps are: 0.7 − 0.57 − 0.13 is not 0.
    latency_s = np.round((available_s - captured_s)[while_it_lasts] - delay_s, 9)
    age_s = available_s[while_it_lasts] - _newest_input_s(recording, experiment, name, available_s[while_it_lasts])
    has_age = np.isfinite(age_s)
    return OutputTimes(
        float(latency_s[has_capture].sum()), int(has_capture.sum()), float(delay_s.sum()), len(delay_s),
        float(age_s[has_age].sum()), int(has_age.sum()),
    )  # fmt: skip


def _newest_input_s(recording: Recording, experiment: Experiment, name: str, instants_s: np.ndarray) -> np.ndarray:
    """(K,) the newest capture of any input that has arrived by each instant; −inf: there is none."""
    newest_s = np.full(len(instants_s), -np.inf)
    for unit in experiment.configurations[name].inputs or ():
        if unit not in recording.lists:  # the log lacks this input
            continue
        lists = recording.lists[unit].tracks
        order = np.argsort(lists.common_arrives_s, kind="stable")
        so_far_s = np.append(-np.inf, np.maximum.accumulate(lists.captured_s[order]))
        arrived = np.searchsorted(lists.common_arrives_s[order], instants_s + SAME_INSTANT_S, side="right")
        newest_s = np.maximum(newest_s, so_far_s[arrived])
    return newest_s


def notes_on_output_regret(experiment: Experiment) -> Iterator[str]:
    """A note on the baseline of the regret of each recorded output."""
    facts = find_facts(experiment)
    for name in experiment.outputs:
        inputs = experiment.configurations[name].inputs
        if inputs is None:
            yield f"configuration {name}: no regret: it has no `inputs`, so the ideal fusion of its inputs is not known"
            continue
        ideal = facts[name].ideal
        yield f"configuration {name}: its regret is the difference to {ideal}, ideal fusion of {', '.join(inputs)}"


# Notes.

FAR_M = 2000.0
"""A place farther away from all objects is taken for a mistake: no sensor beside a road sees so far."""

_NAMED = 3
"""Logs that are named where several have the same note: more would fill the terminal."""
_ROWS = 500_000
"""Object states that are examined at once: some ten MB."""
_SAMPLE = 16
"""One row in so many is examined first: a condition that is met at all is mostly met by many rows."""


def list_notes(
    recordings: Sequence[KnownLog], ready: Sequence[Replay], experiment: Experiment, *, replayed: bool
) -> list[str]:
    """Notes on the recordings and on the experiment over them. `replayed`: whether conditions are known to be met."""
    odd = {
        replay.scene.log: list_oddities(
            replay, resolve_for_log(experiment, replay.scene.log), replay.ever_met if replayed else None
        )
        for replay in ready
    }
    return study_notes(recordings, odd, experiment)


def study_notes(
    recordings: Sequence[KnownLog], oddities_of: Mapping[str, Iterable[str]], experiment: Experiment
) -> list[str]:
    """Notes on the recordings and on the experiment over them; `oddities_of`: the lines of `list_oddities` by log.

    What changes figures comes first: what was mended or left out of a recording, then what is odd about the experiment.
    """
    of_logs = [(recording.scene.log, as_finding(note)) for recording in recordings for note in recording.notes]
    notes = _group_by_log((log, str(note)) for log, note in of_logs if note.changes)
    notes += _group_by_log((log, note) for log, odd in oddities_of.items() for note in odd)
    notes += _group_by_log((log, str(note)) for log, note in of_logs if not note.changes)
    notes += settings_notes(experiment)
    notes += describe_unswept(experiment)
    notes += _find_unused_memory(experiment)
    notes += notes_on_output_regret(experiment)
    notes += _find_empty_classes(recordings, experiment)
    return notes


def _group_by_log(notes: Iterable[tuple[str, str]]) -> list[str]:
    """A line for each (log, note); a note that more than `_NAMED` logs share is a single line."""
    pairs = list(dict.fromkeys(notes))
    logs_of: dict[str, list[str]] = {}
    for log, note in pairs:
        logs_of.setdefault(note, []).append(log)
    lines = []
    for log, note in pairs:
        first, more = logs_of[note][:_NAMED], len(logs_of[note]) - _NAMED
        if more <= 0:
            lines.append(f"{log}: {note}")
        elif log == first[0]:
            lines.append(f"{', '.join(first)} and {count_noun(more, 'other log')}: {note}")
    return lines


def _find_empty_classes(recordings: Sequence[KnownLog], experiment: Experiment) -> Iterator[str]:
    """Notes on a measured class, such as `vehicle`, that no object has while its group, `vehicles`, has some."""
    selects, others = Counter[str](), Counter[str]()  # by class, all logs together: the measured objects, and the rest
    class_names: dict[str, None] = {}
    for recording in recordings:
        scene = recording.scene
        classes = resolve_for_log(experiment, scene.log).measure.objects.classes or ()
        class_names |= dict.fromkeys(classes)
        object_classes = scene.object_class[np.arange(len(scene.object_class)) != scene.ego_ix]
        measured = np.isin(object_classes, class_indices(classes))
        selects.update(CLASSES[k] for k in object_classes[measured])
        others.update(CLASSES[k] for k in object_classes[~measured])
    for group, members in CLASS_GROUPS.items():
        name, more = group.removesuffix("s"), ", ".join(f"{others[one]} {one}" for one in members if others[one])
        if name in class_names and name in CLASSES and not selects[name] and more:
            yield f"measure.objects.classes: no object is a {name!r}; `{group}` would select {more}"


def _find_unused_memory(experiment: Experiment) -> Iterator[str]:
    """Quantities in the memory of a PEM that none of its couples draws."""
    for name, pem in experiment.pems.items():
        for quantity in pem.in_vain():
            what = f"a {quantity} error" if quantity in ("position", "yaw", "speed", "size") else f"{quantity} drawn"
            yield f"pems.{name}.memory.{quantity}: no couple has {what}, nothing to remember"


def list_oddities(replay: Replay, experiment: Experiment, met: Bool | None = None) -> Iterator[str]:
    """The oddities of a log in an experiment, one line each.

    `met (U,)`: whether an object ever meets a condition of each modelled unit's PEM; None: judged by range, azimuth and
    class alone.
    """
    if met is None:
        met = could_meet(replay)
    yield from replay.placed.notes
    yield from _find_far_units(replay, experiment)
    yield from _find_idle_units(replay, experiment, met)
    yield from _explain_unmeasured(replay, experiment)
    for name, unit in experiment.units.items():
        if isinstance(unit.on, Carriers) and name not in replay.expanded.named:
            yield f"unit {name}: the log has no object to carry it ({', '.join(unit.on.classes)})"
    yield from _find_dead_links(replay, experiment)
    yield from _find_missing_hosts(replay, experiment)
    end_s = replay.scene.end_s
    for name, configuration in experiment.configurations.items():
        units = experiment.units_of(configuration) or (TRUTH,)
        late = [unit for unit in units if (experiment.delay_of(name, unit) or 0.0) > end_s]
        if late:
            yield f"configuration {name}: the latency of {', '.join(late)} is longer than the log"
    yield from _find_ignored_errors(experiment)


def _find_ignored_errors(experiment: Experiment) -> Iterator[str]:
    """Notes on configurations whose fusion ignores errors of units (ideal fusion: clocks, ghosts), or takes dependent
    errors as independent (a tracker on a tracker's lists).
    """
    for name, configuration in experiment.configurations.items():
        fusion, unit_names = configuration.fusion, experiment.units_of(configuration)
        for unit in unit_names:
            if _is_tracker(experiment.units[unit].fusion) and _is_tracker(fusion) and not fusion.common_share:
                yield (
                    f"configuration {name}: the errors of {unit}'s lists, which a tracker makes, hang together; its "
                    "own tracker takes them as independent (`common_share` says what is common)"
                )
        if not isinstance(fusion, IdealFusion):
            continue
        units = {unit: experiment.units[unit] for unit in (*unit_names, *experiment.list_sensing(unit_names))}
        off = [unit for unit, made in units.items() if made.clock is not None]
        if off:
            yield f"configuration {name}: ideal fusion uses true captures, ignoring clock errors of {', '.join(off)}"
        ghostly = [unit for unit, made in units.items() if made.pem is not None and experiment.pems[made.pem].ghosts]
        if ghostly:
            yield f"configuration {name}: ideal fusion uses truth ids, ignoring ghosts of {', '.join(ghostly)}"


def _is_tracker(fusion: object) -> TypeGuard[Tracker]:
    return isinstance(fusion, Tracker)


_LOST = 0.001
"""With a reception below this at every list of a unit its link is as good as down: hardly one of 1000 lists arrives."""
_DRAWS = (1e-9, 0.5, 1 - 1e-9)
"""Numbers that a reception model is handed in place of drawn ones: both ends, one of them the best, and the middle."""


def _find_dead_links(replay: Replay, experiment: Experiment) -> Iterator[str]:
    """Notes on links by which no list of a unit can arrive, whatever is drawn."""
    units = replay.expand(experiment)
    best_reception: dict[tuple[str, str], float] = {}
    for name, configuration in units.configurations.items():
        members = units.units_of(configuration) or (TRUTH,)
        for hop in units.links_of(name):
            if isinstance(hop.link, Radio) and hop.link.loses:
                senders = [unit for unit in members if hop.units is None or unit in hop.units]
                for sender, best in _find_best_receptions(replay, units, hop.link.reception, senders, hop.where):
                    best_reception[hop.where, sender] = max(best, best_reception.get((hop.where, sender), 0.0))
    for (where, sender), best in best_reception.items():
        if best < _LOST:
            yield f"{where}: no list of {sender} arrives, its reception is {'at most ' * (best > 0)}{best:.1g}"


def _find_best_receptions(
    replay: Replay, units: ExpandedExperiment, reception: ReceptionModel, senders: Sequence[str], where: str
) -> Iterator[tuple[str, float]]:
    """The name in the experiment of each sending unit, and the highest reception probability of any of its lists."""
    named = dict(zip(units.units, units.named, strict=True))
    if not reception.by_path:
        best = _ask_best_reception(reception, RadioPath(np.full(1, np.nan), np.full(1, np.nan)), where)
        yield from ((named.get(sender, sender), float(best[0])) for sender in senders)
    elif asks_for_path(units, replay.scene):
        best = _ask_best_reception(reception, replay.paths, where)
        for sender in senders:
            lists = replay.senders == next(iter(units.list_sensing([sender])))  # a hub is where its first member is
            if lists.any():
                yield named.get(sender, sender), float(best[lists].max())


def _ask_best_reception(reception: ReceptionModel, path: RadioPath, where: str) -> Float:
    """(F,) the highest reception of each list, whatever is drawn."""
    lists = len(path.distance_m)

    def give(drawn: float, name: str, *, lasts_s: float | None = None) -> Float:
        return np.full((1, lists), drawn)

    asked = [ask_reception_probability(reception, path, partial(give, drawn), f"{where}.reception") for drawn in _DRAWS]
    best: Float = np.max(asked, axis=0)
    return best


def _find_missing_hosts(replay: Replay, experiment: Experiment) -> Iterator[str]:
    """Ghosts beside objects that the log does not have."""
    classes = set(replay.scene.object_class.tolist())
    for name, pem in experiment.pems.items():
        for n, sort in enumerate(pem.ghosts):
            if isinstance(sort.where, ObjectSidePlace) and not classes & set(
                class_indices(sort.where.classes).tolist()
            ):
                yield f"pems.{name}.ghosts[{n}].where: beside: no {' or '.join(sort.where.classes)} in this log"


def could_meet(replay: Replay) -> Bool:
    """(U,) whether any object ever has range, azimuth and class of a condition of each modelled unit's PEM.

    Visibility is left out: where no condition is met here, no replay meets one.
    """
    experiment, scene = replay.expanded, replay.scene
    met = dict.fromkeys(experiment.modelled, False)
    _, bounds = replay.truth.by_frame
    pieces = -(-len(replay.truth.frame_ix) // _ROWS)
    inner = np.searchsorted(bounds, np.arange(1, pieces) * _ROWS)
    cuts = [-np.inf, *replay.truth.captured_s[np.unique(inner[inner < len(bounds) - 1])].tolist(), np.inf]
    for from_s, until_s in pairwise(cuts):
        if all(met.values()):
            break
        for names, world in interpolate_worlds(scene, replay.truth, experiment, replay.placed, from_s, until_s):
            for name in names:
                if not met[name]:
                    pem = experiment.pems[str(experiment.units[name].pem)]
                    met[name] = _meets(pem, scene, world, replay.placed.poses[name], replay.placed.carrier_ix[name])
    return np.array(list(met.values()), dtype=bool)


def _meets(pem: Pem, scene: Scene, world: Tracks, poses: UnitPoses, carrier_ix: int) -> bool:
    """Whether any object is ever where a couple of the PEM applies, at an instant at which the unit makes a list."""
    lists = np.flatnonzero(poses.present)
    order, bounds = world.by_frame
    if not len(lists):
        return False
    rows = order[bounds[lists[0]] : bounds[lists[-1] + 1]]
    for examined in (rows[::_SAMPLE], rows):
        frame = world.frame_ix[examined]
        is_seen = poses.present[frame] & (world.row_object_ix[examined] != carrier_ix)
        examined, frame = examined[is_seen], frame[is_seen]
        dx_m, dy_m = world.x_m[0, examined] - poses.x_m[frame], world.y_m[0, examined] - poses.y_m[frame]
        bearing_rad, zeros = np.arctan2(dy_m, dx_m), np.zeros(len(examined))
        view = ViewGeometry(
            np.hypot(dx_m, dy_m), wrap_angles(bearing_rad - poses.heading_rad[frame]), bearing_rad, zeros,
            scene.object_class[world.row_object_ix[examined]], zeros, zeros, zeros, zeros, zeros,
        )  # fmt: skip
        if may_apply(pem.couples, view, scene.tags).any():
            return True
    return False


def _find_far_units(replay: Replay, experiment: Experiment) -> Iterator[str]:
    """Notes on units whose place is farther than `FAR_M` from all objects: probably a wrong coordinate."""
    x_m, y_m = replay.truth.x_m[0], replay.truth.y_m[0]
    if not len(x_m):
        return
    low, high = (np.array([edge(x_m), edge(y_m)]) for edge in (np.min, np.max))
    for name, unit in experiment.units.items():
        if unit.at is None:
            continue
        place = np.array(unit.at)
        away_m = float(np.hypot(*(place - np.clip(place, low, high))))
        if away_m > FAR_M:
            yield (
                f"unit {name}: its place [{place[0]:g}, {place[1]:g}] is {away_m / 1000:.3g} km away from all objects, "
                f"which are within x {low[0]:.0f} … {high[0]:.0f} m, y {low[1]:.0f} … {high[1]:.0f} m"
            )


def _find_idle_units(replay: Replay, experiment: Experiment, met: Bool) -> Iterator[str]:
    """Notes on units that list nothing in any run, a line a fleet; `met`: by unit whether its PEM ever applies."""
    expanded = replay.expanded
    modelled = dict(zip(expanded.modelled, met.tolist(), strict=True))
    of_name = list(zip(expanded.named, expanded.units, strict=True))
    for name, unit in experiment.modelled.items():
        members = [member for named, member in of_name if named == name]
        absent = [m for m in members if not replay.placed.poses[m].present.any()]
        unmet = [m for m in members if m not in absent and not modelled[m]]
        for unit_names, reason in (
            (absent, "makes no list, its carrier is never in the log"),
            (unmet, f"no object ever meets a condition of its PEM {unit.pem!r}"),
        ):
            if unit_names:
                yield f"unit {name}{_count_carriers(unit_names, members)}: {reason}"


def _count_carriers(unit_names: list[str], members: list[str]) -> str:
    """On how many of its carriers a fleet is; empty for a single unit."""
    if len(members) == 1 and ":" not in members[0]:
        return ""
    return f", on {len(unit_names)} of its {count_noun(len(members), 'carrier')}"


def _explain_unmeasured(replay: Replay, experiment: Experiment) -> Iterator[str]:
    """Notes on why a log gives no rows or no verdicts, and on objects left out or returning."""
    scene, measure, episodes = replay.scene, experiment.measure, replay.episodes
    within, outside = measure.objects.within, len(replay.outside_ix)
    if within is not None and outside:
        with_onset = count_noun(outside + len(episodes.object_ix), "object")
        yield f"objects.within: {outside} of {with_onset} with an onset left out, {describe_excluded(within)}"
    if not len(measured_objects(scene, measure)):
        others = np.arange(len(scene.object_class)) != scene.ego_ix
        logged = sorted({CLASSES[k] for k in scene.object_class[others]}) or ["no other object"]
        names = measure.objects.classes or measure.objects.ids or ("moving objects but the ego",)
        suffix = " beside the ego" if scene.ego_ix >= 0 else ""
        yield f"no rows: nothing to measure ({', '.join(names)}); the log has {', '.join(logged)}{suffix}"
    elif (instant_s := measure.onset.instant_s) is not None and instant_s > scene.end_s:
        yield f"no rows: the onset at {instant_s:g} s lies after the log's end, {scene.end_s:g} s"
    elif not len(episodes.object_ix) and outside:
        yield "no rows: `objects.within` keeps no object with an onset"
    elif not len(episodes.object_ix):
        yield f"no rows: no measured object has an onset ({measure.onset.kind})"
    elif not count_counted(numbers := episodes.count_began(), measure.began):
        yield f"no object counts: {describe_numbers(numbers)}; `measure.began` has {', '.join(measure.began)}"
    yield from _find_returns(replay)
    braking = experiment.braking if replay.scene.ego_ix >= 0 else None
    if braking is not None and len(episodes.object_ix) and not replay.encounters:
        recorded = braking.ego == "recorded"
        yield (
            f"no verdict: without braking ({'as recorded' if recorded else 'at constant speed'}) the ego stays "
            f"more than {braking.margin_m:g} m from all measured objects"
            + ("; `ego: constant_speed` assumes that it had not braked" if recorded else "")
        )


def _find_returns(replay: Replay) -> Iterator[str]:
    """A note on objects that come back to the condition, if only their first episode counts; else none."""
    returning = np.flatnonzero(replay.episodes.returns)
    if not len(returning):
        return
    most, number = returning[np.argmax(replay.episodes.returns[returning])], int(replay.episodes.returns.max())
    others = f", {count_noun(len(returning) - 1, 'other object')} too" if len(returning) > 1 else ""
    yield (
        f"object {replay.scene.object_ids[replay.episodes.object_ix[most]]} comes back {count_noun(number, 'time')} "
        f"after more than {AGAIN_AFTER_S:g} s{others}; only the first episode counts (`onset: {{again_after_s: "
        f"{AGAIN_AFTER_S:g}}}` counts each)"
    )


# How many episodes began how, with other onsets.

RANGES_M = (30.0, 40.0, 50.0)
"""Ranges for which `check` says how many objects begin how: those that studies use."""


def list_began(ready: Sequence[Replay], experiment: Experiment) -> list[str]:
    """Lines of `check`: how many objects of all logs begin in each way, with `in_range` at each of `RANGES_M`."""
    onset = experiment.measure.onset
    onsets: dict[str, Onset] = {f"within {range_m:g} m": InRange(range_m=range_m) for range_m in RANGES_M}
    if not isinstance(onset, InRange):
        onsets = {onset.kind: onset}
    elif onset.range_m not in RANGES_M:
        onsets[f"within {onset.range_m:g} m"] = onset
    lines = []
    for label, candidate in onsets.items():
        total = np.zeros(len(BEGAN), dtype=np.int64)
        for replay in ready:
            local = resolve_for_log(experiment, replay.scene.log)
            measure = local.measure.model_copy(update={"onset": candidate})
            measured = local.model_copy(update={"measure": measure})
            is_same = candidate == local.measure.onset
            total += (replay.episodes if is_same else replay.find_episodes_of(measured)).count_began()
        mark = " (chosen)" if candidate == onset and len(onsets) > 1 else ""
        lines.append(f"{label}: {_describe_counted(total.tolist(), experiment.measure.began)}{mark}")
    return lines


def _describe_counted(numbers: Sequence[int], words: Sequence[str]) -> str:
    """`18 objects count: 14 crossed, 4 appeared; not 1 log_start`."""
    counted = count_counted(numbers, words)
    parts: tuple[list[str], list[str]] = [], []
    for word, number in zip(BEGAN, numbers, strict=True):
        if number:
            parts[word not in words].append(f"{number} {word}")
    of, left = (", ".join(part) for part in parts)
    return f"{count_noun(counted, 'object')} count{'s' * (counted == 1)}{of and f': {of}'}{left and f'; not {left}'}"


# Facts of a log, and its scene, as plain data.


@dataclass(frozen=True)
class LogFacts:
    """The facts of one log in one experiment that results state beside its rows. `times`: as of `measure_list_rates`.

    `episodes`: rows of a run and configuration; `began`: how many began in each of the ways `BEGAN`. `same_instants`:
    whether all runs have the same units, and lists at the same instants. `listable`: observation rows, by which the
    time of a run is estimated.
    """

    episodes: int
    began: tuple[int, ...]
    same_instants: bool
    oddities: tuple[str, ...]
    times: dict[str, ListRate]
    outputs: dict[str, OutputTimes]
    listable: int

    @classmethod
    def of(cls, recording: Recording, replay: Replay, experiment: Experiment) -> Self:
        """The facts of a prepared log; `experiment`: resolved for it."""
        return cls(
            len(replay.episodes.object_ix),
            replay.episodes.count_began(),
            replay.expanded.same_in_all_runs and not replay.expanded.arrivals_differ,
            tuple(list_oddities(replay, experiment, replay.ever_met)),
            measure_list_rates(replay, experiment),
            {name: sum_output_times(recording, experiment, name) for name in experiment.outputs},
            replay.rows_kept,
        )

    @classmethod
    def read(cls, data: dict[str, Any]) -> Self:
        """From plain data, as `as_json` gives it."""
        return cls(
            data["episodes"],
            tuple(data["began"]),
            data["same_instants"],
            tuple(data["oddities"]),
            {name: ListRate.read(times) for name, times in data["times"].items()},
            {name: OutputTimes(**sums) for name, sums in data["outputs"].items()},
            data["listable"],
        )

    def as_json(self) -> dict[str, Any]:
        """Plain data for JSON."""
        data = asdict(self)
        for times in data["times"].values():
            if times["links"] is not None:
                times["links"] |= {name: times["links"][name].tolist() for name in ("from_s", "to_s")}
        return data


def scene_as_json(scene: Scene) -> dict[str, Any]:
    """A scene as plain data for JSON."""
    values = {f.name: getattr(scene, f.name) for f in fields(Scene)}
    values |= {"frame": scene.frame and asdict(scene.frame)}
    return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in values.items()}


def scene_from_json(data: dict[str, Any]) -> Scene:
    """The scene from the plain data of `scene_as_json`."""
    return Scene(
        **data
        | {
            "object_ids": tuple(data["object_ids"]),
            "object_class": np.array(data["object_class"], dtype=np.int8),
            "moving": np.array(data["moving"], dtype=bool),
            "solids": tuple(
                Solid(name, _read_ring(corners), bottom_m, height_m, on_ground, tuple(map(_read_ring, holes)))
                for name, corners, bottom_m, height_m, on_ground, holes in data["solids"]
            ),
            **{
                key: tuple(Area(name, kind, tuple(map(_read_ring, rings))) for name, kind, rings in data[key])
                for key in ("areas", "lanes")
            },
            "frame": (said := data["frame"]) and Frame(said["proj"], (*said["offset_m"],), said["yaw_rad"]),
        }
    )


def _read_ring(corners: Sequence[Sequence[float]]) -> tuple[tuple[float, float], ...]:
    return tuple((x, y) for x, y in corners)

"""Causes: where the time goes until an object is known, cause by cause, on the same draws.

Until an object is listed, the time in which it is out of range or view, and that in which it is hidden, are those of
the lanes of viewers: states of units at the frames of the truth. Other causes come back one by one, in the order in
which they act (a chain); what each adds of the remaining time is its share, so that shares sum to the mean time
unknown. Beside it stands what would be gained if only that cause were gone, which does not sum. Definitions:
docs/guide/why.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from typing import Any, Literal

import numpy as np
import pandas as pd

from copem_replay.communication.latency import ConstantLatency
from copem_replay.communication.link import ConstantLink, LinkModel
from copem_replay.communication.radio import Radio
from copem_replay.communication.reception import ConstantReception
from copem_replay.core.errors import ExperimentError, is_own, unknown_name_message
from copem_replay.core.tracks import TRUTH, Float, Tracks
from copem_replay.core.view_geometry import ViewGeometry
from copem_replay.experiment.schema import Experiment
from copem_replay.fusion.interface import IdealFusion
from copem_replay.io.recording import Recording
from copem_replay.metrics.config import Confirm
from copem_replay.metrics.onset import select_counted
from copem_replay.metrics.survival import compute_unknown_s
from copem_replay.perception.pem.condition import Couple
from copem_replay.perception.pem.detection import DetectionModel
from copem_replay.perception.pem.model import Pem
from copem_replay.perception.sight import measure_sight
from copem_replay.perception.visibility import Observers, Statics, VisibilityModel
from copem_replay.pipeline.expansion import expand_experiment
from copem_replay.pipeline.prepare import ROWS_AT_ONCE, Replay, prepare_log
from copem_replay.pipeline.replay import cut_blocks, replay_block

# What it is that is gone: an experiment of one configuration, without a cause.


class _Clear(VisibilityModel):
    """Nothing hides anything."""

    kind: Literal["clear"] = "clear"

    def shares(self, world: Tracks, static: Statics, observers: Observers) -> Float:
        return np.ones((len(observers.carrier_ix), len(world.frame_ix)))


class _Sure(DetectionModel):
    """Listed wherever a model lists with any probability: where it never does is a limit of the sensor, and stays."""

    kind: Literal["sure"] = "sure"
    of: DetectionModel

    def probability(self, view: ViewGeometry) -> Float:
        return (self.of.probability(view) > 0).astype(float)


def _change_units(experiment: Experiment, **values: Any) -> Experiment:
    changed = {name: unit.model_copy(update=values) for name, unit in experiment.units.items()}
    return experiment.model_copy(update={"units": changed})


def change_pems(experiment: Experiment, change: Callable[[Pem], Pem]) -> Experiment:
    """The experiment with all its PEMs changed."""
    return experiment.model_copy(update={"pems": {name: change(pem) for name, pem in experiment.pems.items()}})


def change_couples(change: Callable[[Couple], Couple]) -> Callable[[Pem], Pem]:
    """A change of PEMs that applies `change` to all their couples."""
    return lambda pem: pem.model_copy(update={"couples": tuple(map(change, pem.couples))})


def _change_links(experiment: Experiment, change: Callable[[Radio], Radio]) -> Experiment:
    """The links of the configuration, named or its own, those of the user's own as they are."""

    def changed(link: LinkModel) -> LinkModel:
        return change(link) if isinstance(link, Radio) else link

    links = {name: changed(link) for name, link in experiment.links.items()}
    (name, one), *_ = experiment.configurations.items()
    own = changed(one.link) if isinstance(one.link, LinkModel) else one.link
    configurations = {name: one.model_copy(update={"link": own})}
    return experiment.model_copy(update={"links": links, "configurations": configurations})


def _change_configuration(experiment: Experiment, **values: Any) -> Experiment:
    (name, one), *_ = experiment.configurations.items()
    return experiment.model_copy(update={"configurations": {name: one.model_copy(update=values)}})


def _change_measure(experiment: Experiment, **values: Any) -> Experiment:
    return experiment.model_copy(update={"measure": experiment.measure.model_copy(update=values)})


def _show_all(experiment: Experiment) -> Experiment:
    return experiment.model_copy(update={"visibility": _Clear()})


def _list_all_frames(experiment: Experiment) -> Experiment:
    return _change_units(experiment, rate_hz=None, phase_s=0.0)


def _widen(pem: Pem) -> Pem:
    # Conditions that are dropped in place would let the first couple take what is of later ones: copies follow all.
    wider = []
    for couple in pem.couples:
        if couple.when.range_m is None and couple.when.azimuth_deg is None:
            continue
        when = couple.when.model_copy(update={"range_m": None, "azimuth_deg": None})
        wider.append(couple.model_copy(update={"when": when}))
    return pem.model_copy(update={"couples": (*pem.couples, *wider)}) if wider else pem


def _list_whatever_shows(couple: Couple) -> Couple:
    return couple.model_copy(update={"detection": _Sure(of=couple.detection)})


def _without_detection(memory: Any) -> Any:
    return None if memory is None else {name: parts for name, parts in memory.items() if name != "detection"}


def _forget(pem: Pem) -> Pem:
    couples = [one.model_copy(update={"memory": _without_detection(one.memory)}) for one in pem.couples]
    return pem.model_copy(update={"couples": tuple(couples), "memory": _without_detection(pem.memory)})


def _send_at_once(experiment: Experiment) -> Experiment:
    def change(link: Radio) -> Radio:
        memory = {name: parts for name, parts in link.memory.items() if name != "latency"}
        return link.model_copy(update={"latency": ConstantLatency(), "memory": memory})

    return _change_configuration(_change_links(experiment, change), latency_s=0.0)


def _lose_nothing(experiment: Experiment) -> Experiment:
    def change(link: Radio) -> Radio:
        memory = {name: parts for name, parts in link.memory.items() if name == "latency"}
        return link.model_copy(update={"reception": ConstantReception(), "memory": memory})

    return _change_links(experiment, change)


def _widen_channel(experiment: Experiment) -> Experiment:
    return _change_links(experiment, lambda link: link.model_copy(update={"channel": None}))


@dataclass(frozen=True)
class Cause:
    """Something that makes an object known later; `remove`: an experiment without it, of one configuration."""

    name: str
    group: str
    words: str
    remove: Callable[[Experiment], Experiment]


CAUSES = (
    Cause("range", "sensor", "out of range or view", lambda e: change_pems(e, _widen)),
    Cause("hidden", "line of sight", "hidden by other bodies", _show_all),
    Cause("rate", "unit", "between two lists of a unit", _list_all_frames),
    Cause("outages", "unit", "outages of units", lambda e: _change_units(e, outages=None)),
    Cause("missed", "sensor", "missed in sight", lambda e: change_pems(e, change_couples(_list_whatever_shows))),
    Cause("memory", "sensor", "missed in list after list", lambda e: change_pems(e, _forget)),
    Cause("processing", "unit", "processing of units", lambda e: _change_units(e, ready=None)),
    Cause("sends", "radio", "left out by the sending rule", lambda e: _change_units(e, sends=None)),
    Cause("queue", "radio", "waiting for the channel", _widen_channel),
    Cause("latency", "radio", "latency", _send_at_once),
    Cause("loss", "radio", "lists lost", _lose_nothing),
    Cause("ticks", "fusion", "waiting for the next fused list", lambda e: _change_configuration(e, issue_hz=None)),
    Cause("fusion", "fusion", "fusion: association and its own confirmation",
          lambda e: _change_units(_change_configuration(e, fusion=IdealFusion()), fusion=None)),
    Cause("confirmation", "fusion", "confirmation by several lists", lambda e: _change_measure(e, confirm=Confirm())),
    Cause("pose", "unit", "errors of pose and clock", lambda e: _change_units(e, placed=None, clock=None)),
    Cause("ghosts", "fusion", "ghosts", lambda e: change_pems(e, lambda pem: pem.model_copy(update={"ghosts": ()}))),
)  # fmt: skip
"""The causes in the order in which they act."""
_SIGHT = ("range", "hidden")
"""The causes whose time is added up from the states of units."""
_BEFORE_LISTED = ("rate", "outages", "missed", "memory")
"""Causes whose time is before the object is listed: what of it is `_SIGHT` is not theirs."""
NO_UNIT = "no unit there"
"""What is left without any cause: there is no unit, or it does not list its own carrier."""
RECORDED = "recorded"
"""What is left of a configuration with recorded units: what these list, and when, is as it was recorded."""
LEFT = {
    NO_UNIT: Cause(NO_UNIT, NO_UNIT, NO_UNIT, lambda e: e),
    RECORDED: Cause(RECORDED, RECORDED, "as it was recorded", lambda e: e),
}
"""What is left without any cause."""
_ORDER = (*LEFT.values(), *CAUSES)
_OF_RECORDED = ("latency", "loss", "queue", "ticks", "fusion", "confirmation")
"""Causes of a configuration with recorded units: what these would list otherwise is not known."""


# The question: of one configuration, over the logs.


def select_configuration(experiment: Experiment, name: str) -> Experiment:
    """The experiment reduced to one configuration, its units and all that a time of detection depends on.

    Raises ExperimentError: there is none of this name, or it is the truth, a stack's recorded output, or its times may
    begin before the onset.
    """
    if name not in experiment.configurations:
        raise ExperimentError(unknown_name_message("configuration", name, experiment.configurations))
    conf = experiment.configurations[name]
    if conf.units == TRUTH or conf.recorded is not None:
        what = (
            "is the truth, which is never late" if conf.recorded is None else "is recorded: what made it is not known"
        )
        raise ExperimentError(f"configuration {name}: {what}; choose one with units")
    if experiment.measure.count_earlier:
        raise ExperimentError(
            "measure.count_earlier: times may be negative then, which no cause explains; leave it out"
        )
    own = experiment.units_of(conf)
    units = {unit: experiment.units[unit] for unit in (*own, *experiment.list_sensing(own))}
    links = [conf.link_of(unit) for unit in own]
    measure = experiment.measure
    if measure.distance_to not in ("ego", *units):  # distances are from somewhere, though no time depends on it
        modelled = [unit for unit, its in units.items() if its.pem is not None]
        if modelled:
            measure = measure.model_copy(update={"distance_to": modelled[0]})
        else:
            units[measure.distance_to] = experiment.units[measure.distance_to]
    changes = {
        "configurations": {name: conf}, "units": units, "measure": measure,
        "pems": _keep(experiment.pems, {unit.pem for unit in units.values()}),
        "links": _keep(experiment.links, {link for link in links if isinstance(link, str)}),
    }  # fmt: skip
    return measure_times_only(experiment.model_copy(update=changes))


def measure_times_only(experiment: Experiment) -> Experiment:
    """The experiment without all that no time of detection depends on."""
    nothing: dict[str, Any] = {"sweep": None, "show": None, "criteria": {}, "braking": None}
    measure = {"accuracy": False, "exact": False, "by": (), "metrics": (), "conflict": None}
    return experiment.model_copy(update=nothing | {"measure": experiment.measure.model_copy(update=measure)})


def _keep(named: Mapping[str, Any], names: Container[Any]) -> dict[str, Any]:
    return {name: one for name, one in named.items() if name in names}


def list_causes(experiment: Experiment) -> list[Cause]:
    """The causes that act in an experiment of one configuration: those whose removal changes it.

    Raises ExperimentError for a link of the user's own, whose latency and losses cannot be told apart, and for a
    visibility of the user's own, which may hide by more than bodies.
    """
    (name, one), *_ = experiment.configurations.items()
    for unit in experiment.units_of(one):
        link = one.link_of(unit)
        model = experiment.links[link] if isinstance(link, str) else link
        if model is not None and not isinstance(model, Radio | ConstantLink):
            kind = f"{type(model).__module__}:{type(model).__qualname__}"
            raise ExperimentError(f"configuration {name}: {kind} is a link whose latency and losses are not told apart")
    acting = [cause for cause in CAUSES if cause.remove(experiment) != experiment]
    if experiment.recorded:
        return [cause for cause in acting if cause.name in _OF_RECORDED]
    if is_own(own := type(experiment.visibility)):
        raise ExperimentError(
            f"visibility: {own.__module__}:{own.__qualname__} is your own: what bodies hide is not told apart from "
            "what else it says; use `surface` or `flat`"
        )
    return acting


# Replays on the same draws: units, seed and log keep their names, by which draws are addressed.


def replay_rows(replay: Replay, experiment: Experiment) -> pd.DataFrame:
    """The rows that count, of all runs, with `unknown_s` beside the columns of `detections.parquet`."""
    blocks = [replay_block(replay, experiment, runs) for runs in cut_blocks(replay, experiment, 1)]
    rows = select_counted(pd.concat(blocks, ignore_index=True), experiment.measure.began)
    length_s = (rows["ended_s"] - rows["onset_s"]).to_numpy(dtype=float)
    return rows.assign(unknown_s=compute_unknown_s(rows["time_to_detection_s"].to_numpy(dtype=float), length_s))


class Counterfactuals:
    """The time unknown of one configuration of one log, in replays without some causes.

    Onsets and episodes are those of the experiment as it is, and so is the geometry of the radio: bodies that hide
    nothing from sensors are still between a unit and the ego. `beside`: those of another configuration of the log,
    whose replays are used again where both are the same without some causes.
    """

    def __init__(
        self, recording: Recording, experiment: Experiment, name: str, before: Counterfactuals | None = None
    ) -> None:
        self._recording, self.only = recording, select_configuration(experiment, name)
        self._whole: Replay = prepare_log(recording, experiment) if before is None else before._whole
        self._found: dict[str, Float] = {} if before is None else before._found
        self._ready: dict[str, Replay] = {} if before is None else before._ready

    @cached_property
    def replay(self) -> Replay:
        """The unchanged log, prepared."""
        return self._find_ready(self.only)

    @cached_property
    def rows(self) -> pd.DataFrame:
        """The rows that count, unchanged: log, run, object, `unknown_s` and the columns of `detections.parquet`."""
        return replay_rows(self.replay, self.only)

    def unknown_s(self, gone: Sequence[Cause]) -> Float:
        """(n,) seconds unknown of rows that count, without the causes `gone`; each set of these is replayed once."""
        experiment = reduce(lambda changed, cause: cause.remove(changed), gone, self.only)
        (configuration,) = experiment.configurations.values()
        key = experiment.model_copy(update={"configurations": {"": configuration}}).model_dump_json()
        if key not in self._found:
            rows = self.rows if experiment == self.only else replay_rows(self._find_ready(experiment), experiment)
            same = rows[["run", "object_id", "onset_s"]].reset_index(drop=True)
            if not same.equals(self.rows[["run", "object_id", "onset_s"]].reset_index(drop=True)):
                raise AssertionError("expected the same episodes in every replay")
            self._found[key] = rows["unknown_s"].to_numpy(dtype=float)
        return self._found[key]

    def sight_s(self, removed: Sequence[Cause], after_s: Float) -> dict[str, Float]:
        """By cause of `_SIGHT` seconds (n,) of the first `after_s` (n,) after the onset of each row that counts.
        `removed`: all other causes, so that units list every frame of the truth.
        """
        experiment, rows = reduce(lambda changed, cause: cause.remove(changed), removed, self.only), self.rows
        ready = self._find_ready(experiment)
        expanded, episodes = ready.expand(experiment), ready.episodes
        (configuration,) = expanded.configurations.values()
        ids = [ready.scene.object_ids[k] for k in episodes.object_ix]
        places = {key: place for place, key in enumerate(zip(ids, episodes.number.tolist(), strict=True))}
        place = np.array([places[key] for key in zip(rows["object_id"], rows["episode"], strict=True)], dtype=np.int64)
        runs, run = np.unique(rows["run"], return_inverse=True)
        until_s = np.zeros((len(runs), len(ids)))
        until_s[run, place] = rows["onset_s"] + after_s
        equipped = expanded.equipped(ready.scene.log, runs)
        present = np.ones((1, len(expanded.units)), dtype=bool) if equipped is None else equipped
        found = measure_sight(
            ready.sight_spans, ready.sighted, expanded.list_sensing(expanded.units_of(configuration)), present, until_s
        )
        seconds = {"range": found.out_of_view_s, "hidden": found.hidden_s}  # NaN: a unit does not say where it looks
        return {name: np.broadcast_to(np.nan_to_num(of), until_s.shape)[run, place] for name, of in seconds.items()}

    def _find_ready(self, experiment: Experiment) -> Replay:
        """The log made ready for an experiment; what is observed is kept while there is room for it."""
        key = experiment.model_dump_json(exclude={"configurations", "links"})
        if key in self._ready:
            return self._ready[key]
        ready = self._prepare(experiment)
        if len(ready.chunks) == 1 and sum(one.rows_kept for one in (*self._ready.values(), ready)) <= ROWS_AT_ONCE:
            self._ready[key] = ready
        return ready

    def _prepare(self, experiment: Experiment) -> Replay:
        """The log prepared for an experiment without some causes; parts that these do not change are reused."""
        unblocked = experiment.visibility != self.only.visibility
        if experiment.units != self.only.units or experiment == self.only:
            blocked = experiment.model_copy(update={"visibility": self.only.visibility})
            base = prepare_log(self._recording, blocked)
            base = replace(base, episodes=self._whole.episodes, outside_ix=self._whole.outside_ix)
        else:
            base = self.replay
            if experiment.pems == self.only.pems and not unblocked:
                return base
        return replace(
            base, expanded=expand_experiment(experiment, base.scene), paths_of=base if unblocked else base.paths_of
        )


@dataclass(frozen=True)
class CauseShares:
    """Seconds of rows (n,) of a cause: `added_s` in the chain, `gained_s` if only it were gone (None: it cannot be)."""

    cause: Cause
    added_s: Float
    gained_s: Float | None


def share_lateness(replays: Counterfactuals) -> list[CauseShares]:
    """What each acting cause adds to the time unknown of every row; the rows of `added_s` sum to it."""
    causes, recorded = list_causes(replays.only), bool(replays.only.recorded)
    chain, as_is = [cause for cause in causes if cause.name not in _SIGHT], replays.unknown_s(())

    known = replays.unknown_s(chain)
    sight = replays.sight_s(chain, known)
    added = {RECORDED if recorded else NO_UNIT: known - sum(sight.values())}
    for k, cause in enumerate(chain):
        later = replays.unknown_s(chain[k + 1 :])
        then = replays.sight_s(chain, later) if cause.name in _BEFORE_LISTED else sight
        added[cause.name] = later - known - sum(then[name] - sight[name] for name in _SIGHT)
        known, sight = later, then
    added |= {name: of for name, of in sight.items() if of.any() or any(cause.name == name for cause in causes)}
    gained = {cause.name: as_is - replays.unknown_s([cause]) for cause in causes}
    return [CauseShares(one, added[one.name], gained.get(one.name)) for one in _ORDER if one.name in added]


def tabulate_causes(of_logs: Sequence[tuple[Counterfactuals, list[CauseShares]]]) -> pd.DataFrame:
    """The rows of `why.csv`: of each cause the mean seconds over the rows of all logs, in the chain's order.

    `error_s`: the standard error of `added_s` over the runs, of these recordings.
    """
    rows = pd.concat([replays.rows for replays, _ in of_logs], ignore_index=True)
    names = dict.fromkeys(name_cause(one) for _, shares in of_logs for one in shares)
    order = [cause.name for cause in _ORDER]
    table = []
    for name in sorted(names, key=order.index):
        shares_of_logs = [_find(shares, name) for _, shares in of_logs]
        counts = [len(replays.rows) for replays, _ in of_logs]
        added = np.concatenate(
            [np.zeros(n) if one is None else one.added_s for one, n in zip(shares_of_logs, counts, strict=True)]
        )
        gains = [np.zeros(n) if one is None else one.gained_s for one, n in zip(shares_of_logs, counts, strict=True)]
        known = [gain for gain in gains if gain is not None]
        cause = next(one.cause for one in shares_of_logs if one is not None)
        by_run = pd.Series(added).groupby(rows["run"].to_numpy()).mean()
        table.append({
            "cause": name, "group": cause.group,
            "added_s": added.mean(),
            "error_s": by_run.std(ddof=1) / math.sqrt(len(by_run)) if len(by_run) > 1 else math.nan,
            "gained_s": np.concatenate(known).mean() if len(known) == len(gains) else math.nan,
            "later_share": float((added < -1e-9).mean()),
        })  # fmt: skip
    return pd.DataFrame(table)


def name_cause(share: CauseShares) -> str:
    """The name of the cause of a share."""
    return share.cause.name


def describe_cause(name: str) -> str:
    """A cause in the words of pages and terminals."""
    return next((cause.words for cause in _ORDER if cause.name == name), name)


def _find(shares: Sequence[CauseShares], name: str) -> CauseShares | None:
    return next((one for one in shares if name_cause(one) == name), None)

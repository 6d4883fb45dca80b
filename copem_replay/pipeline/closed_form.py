"""Exact detection times: their distribution in closed form, without a single draw.

Lists are independent given the truth, and with ideal fusion an object is known when any list that has arrived holds
it: P(T > t) = Π (1 − p) over all lists that have arrived by t. Where detection lasts, lists that go by one number are
not independent, and a filter gives the factors (metrics/lasting_survival.py). Confirmation by k of n is a Markov
chain over the last n − 1 capture instants where all units capture together and their lists arrive together, in the
order of their captures; elsewhere it has no such form, and is refused. Both are worked out in
metrics/log_survival.py. With the distribution of the reaction follow the probabilities to pass and to fail.
docs/guide/metrics.md has the definitions.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from copem_replay.core.errors import ExperimentError
from copem_replay.core.tracks import CLASSES, SAME_INSTANT_NS, TRUTH, Float, Int, Tracks
from copem_replay.experiment.drive import of_log
from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.braking.driver import Reaction
from copem_replay.metrics.braking.verdict import fail_probability, pass_probability
from copem_replay.metrics.detection.by_truth_id import capture_instants
from copem_replay.metrics.detections_table import distances
from copem_replay.metrics.end_reason import texts_of
from copem_replay.metrics.lasting_survival import Lasting
from copem_replay.metrics.log_survival import FirstKnown, confirmed, first_of
from copem_replay.pipeline.exact_links import exactly_heard
from copem_replay.pipeline.expansion import ExpandedExperiment
from copem_replay.pipeline.lasting_detection import check_lasting, lasting
from copem_replay.pipeline.prepare import Replay
from copem_replay.pipeline.receiver import by_truth

_TOLERANCE_S = SAME_INSTANT_NS * 1e-9


def exact_table(replay: Replay, experiment: Experiment) -> pd.DataFrame:
    """The rows of `exact.parquet` of one log: per configuration and object, how probable each time of detection is.

    Raises ExperimentError for a configuration that has no closed form.
    """
    braking = experiment.braking
    if braking is not None and braking.brakes_for == "conflict":
        raise ExperimentError(
            f"{replay.scene.log}: exact: perceived conflicts depend on sampled errors, and `brakes_for: "
            "conflict` has no closed form; use `brakes_for: object`, or leave `exact` out"
        )
    _check_truth_ids(experiment)
    parts = []
    for name in experiment.configurations:
        columns = _columns(replay, experiment, name, distributions(replay, experiment, name))
        if braking is not None:
            columns |= _passing(replay, columns, braking.driver.reaction)
        parts.append(pd.DataFrame(columns).drop(columns="episode"))
    return pd.concat(parts, ignore_index=True)


def _check_truth_ids(experiment: Experiment) -> None:
    """Raises ExperimentError for a configuration of which it is not known how probable its detections are."""
    for name, configuration in experiment.configurations.items():
        recorded = set(experiment.units_of(configuration)) & experiment.recorded.keys()
        if configuration.recorded is not None:
            why = "it is recorded, and nothing says how probable its lists were"
        elif not by_truth(configuration) or experiment.measure.match.always:
            why = "what is matched with the truth depends on sampled errors"
        elif recorded:
            why = f"unit {min(recorded)} is recorded, and nothing says how probable its lists were"
        elif off := [n for n in experiment.units_of(configuration) if experiment.units[n].outages is not None]:
            why = f"unit {off[0]} has outages, in which all objects miss all lists together"
        elif off := [n for n in experiment.units_of(configuration) if experiment.units[n].sends is not None]:
            why = f"unit {off[0]} has `sends` rules that depend on earlier messages"
        else:
            continue
        raise ExperimentError(f"exact: configuration {name}: {why}, which has no closed form; leave `exact` out")


def check_exact(ready: Sequence[Replay], experiment: Experiment) -> None:
    """Raises ExperimentError for a configuration that has no closed form."""
    if not experiment.measure.exact:
        return
    _check_truth_ids(experiment)
    hits = experiment.measure.confirm.hits
    for replay in ready:
        units = replay.expanded.with_(of_log(experiment, replay.scene.log))
        for name in units.configurations:
            lasts = check_lasting(units, name, hits)
            if hits == 1 and not lasts and not units.arrivals_differ:
                continue
            heard, received = exactly_heard(replay, units, name, hits)
            if hits > 1:
                _shared_instants(replay, heard, name)
            else:
                _lasting(replay, units, name, heard, received)


def distributions(replay: Replay, experiment: Experiment, name: str) -> list[FirstKnown]:
    """For each episode when it is first known."""
    units, episodes, confirm = replay.expanded.with_(experiment), replay.episodes, experiment.measure.confirm
    configuration = units.configurations[name]
    heard, received = exactly_heard(replay, units, name, confirm.hits)
    # A model of the user's own may be above 1 by rounding.
    listed = (
        np.ones(len(heard.frame_ix)) if configuration.units == TRUTH else np.minimum(replay.measured.probability, 1)
    )
    if (received < 1).any():
        listed = listed * received[heard.frame_ix]
    instants = _shared_instants(replay, heard, name) if confirm.hits > 1 else None
    lasts = None if instants is not None else _lasting(replay, units, name, heard, received)
    arrives_s = heard.common_arrives_s[heard.frame_ix]
    by_object = np.argsort(heard.row_object_ix, kind="stable")
    first, last = (
        np.searchsorted(heard.row_object_ix[by_object], episodes.object_ix, side) for side in ("left", "right")
    )
    result = []
    for m in range(len(episodes.object_ix)):
        rows = by_object[first[m] : last[m]]
        counts = arrives_s[rows] <= episodes.ended_s[m] + _TOLERANCE_S
        if not experiment.measure.count_earlier:
            counts &= heard.row_captured_s[rows] >= episodes.onset_s[m] - _TOLERANCE_S
        rows = rows[counts]
        if instants is None:
            share = replay.expanded.share if configuration.units != TRUTH else np.ones(1)
            of_rows = None if lasts is None else lasts.take(rows)
            result.append(first_of(arrives_s[rows], listed[rows], heard.row_unit_ix[rows], share, of_rows))
        else:
            instant = instants[heard.frame_ix[rows]]
            result.append(confirmed(instant, arrives_s[rows], listed[rows], confirm.hits, confirm.of))
    return result


def _lasting(
    replay: Replay, experiment: ExpandedExperiment, name: str, heard: Tracks, received: Float
) -> Lasting | None:
    """How detection lasts. Raises ExperimentError where lists, `received (F,)` with a probability, are lost, too."""
    lasts = lasting(replay, experiment, name, heard)
    if lasts is not None and (received < 1).any():
        raise ExperimentError(
            f"exact: configuration {name}: detection lasts and lists are lost, and both together have no closed form "
            "here; leave one of them, or leave exact out"
        )
    return lasts


def _shared_instants(replay: Replay, heard: Tracks, name: str) -> Int:
    """(F,) the capture instant of each list. Raises ExperimentError unless all units share all of them."""
    came = np.isfinite(heard.common_arrives_s)
    if heard.units != (TRUTH,) and (replay.expanded.share[heard.frame_unit_ix[came]] < 1).any():
        raise ExperimentError(
            f"{replay.scene.log}: exact: configuration {name}: some units are only in some runs, and "
            "confirmation by several hits then has no closed form; confirm with one hit, or leave `exact` out"
        )
    instants = capture_instants(heard)
    of_all = np.unique(instants[came])
    for unit in np.unique(heard.frame_unit_ix[came]):
        mine = came & (heard.frame_unit_ix == unit)
        if not np.array_equal(np.unique(instants[mine]), of_all):
            raise ExperimentError(
                f"{replay.scene.log}: exact: configuration {name}: unit {heard.units[unit]} does not list at "
                "every instant at which another does, and confirmation over such lists has no closed form; give all "
                "units one rate_hz and phase_s, confirm with one hit, or leave `exact` out"
            )
    latest_s = -np.inf
    for instant in of_all:
        arrivals = heard.common_arrives_s[came & (instants == instant)]
        if np.ptp(arrivals) > _TOLERANCE_S:
            how = f"lists captured together arrive up to {np.ptp(arrivals):g} s apart"
        elif arrivals.min() < latest_s - _TOLERANCE_S:
            how = f"lists arrive up to {latest_s - arrivals.min():g} s after lists captured later"
        else:
            latest_s = max(latest_s, arrivals.max())
            continue
        raise ExperimentError(
            f"{replay.scene.log}: exact: configuration {name}: {how}, and confirmation over such lists has no closed "
            "form; give all units one latency, confirm with one hit, or leave `exact` out"
        )
    return instants


def _columns(replay: Replay, experiment: Experiment, name: str, distributions: list[FirstKnown]) -> dict[str, Any]:
    """Columns of one configuration: a row per episode and instant, and one, without instant, for never."""
    scene, episodes = replay.scene, replay.episodes
    episode = np.repeat(np.arange(len(distributions)), [len(of.time_s) + 1 for of in distributions])

    def rows(pieces: Iterable[Float]) -> Float:
        return np.concatenate([np.empty(0), *pieces])

    def of_never(values: Iterable[float]) -> Float:
        return rows(np.append(np.full(len(of.time_s), np.nan), v) for of, v in zip(distributions, values, strict=True))

    detection_s = rows(np.append(of.time_s, np.nan) for of in distributions)
    object_ix = episodes.object_ix[episode]
    distance_m, gap_m = distances(scene, replay.truth, experiment, object_ix, detection_s)
    return {
        "log": scene.log,
        "configuration": name,
        "episode": episode,
        "object_id": np.array(scene.object_ids, dtype=object)[object_ix],
        "object_class": np.array(CLASSES, dtype=object)[scene.object_class[object_ix]],
        "onset_s": episodes.onset_s[episode],
        "detection_s": detection_s,
        "probability": rows(np.append(of.probability, np.exp(of.log_never)) for of in distributions),
        "incidence": rows(np.append(np.minimum(np.cumsum(of.probability), 1), np.nan) for of in distributions),
        "miss_log10": of_never(_log10(of.log_never) for of in distributions),
        "miss_per_logit": of_never(of.per_logit for of in distributions),
        "miss_log10_half_odds": of_never(_log10(of.log_never_half) for of in distributions),
        "time_to_detection_s": detection_s - episodes.onset_s[episode],
        "distance_at_detection_m": distance_m,
        "gap_at_detection_m": gap_m,
        "ended_s": episodes.ended_s[episode],
        "ended_by": texts_of(episodes.ended_by[episode]),
    }


def _log10(log: float) -> float:
    """Of a natural logarithm; NaN where that is −inf, as detection is certain."""
    return log / math.log(10) if log > -np.inf else np.nan


def _passing(replay: Replay, columns: Mapping[str, Any], reaction: Reaction) -> dict[str, Any]:
    """Whether each row's episode is in conflict, and the probabilities to pass and to fail if it is detected then."""
    episode = columns["episode"]
    detection_s = columns["detection_s"]
    known_s = np.where(np.isnan(detection_s), np.inf, np.maximum(detection_s, replay.episodes.onset_s[episode]))
    passes, fails = np.full(len(episode), np.nan), np.full(len(episode), np.nan)
    for number, between in replay.passing_s.items():
        rows = np.flatnonzero(episode == number)
        passes[rows] = pass_probability(between, known_s[rows], reaction)
        fails[rows] = fail_probability(between, known_s[rows], reaction)
    return {"conflict": ~np.isnan(passes), "pass_probability": passes, "fail_probability": fails}

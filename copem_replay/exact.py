"""Exact detection times: their distribution in closed form, without a single draw.

Lists are independent given the truth, and with ideal fusion an object is known when any list that has arrived holds it:
P(T > t) = Π (1 − p) over all lists that have arrived by t. Confirmation by k of n is a Markov chain over the last n − 1
capture instants where all units capture together and their lists arrive together; elsewhere it has no such form, and is
refused. With the reaction's distribution follows the probability to pass. docs/measures.md has the definitions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from copem_replay.believe import by_truth, listen
from copem_replay.braking.driver import Reaction
from copem_replay.braking.verdict import pass_probability
from copem_replay.detect import capture_instants
from copem_replay.errors import ExperimentError
from copem_replay.experiment import Experiment
from copem_replay.fleet import fleet_of
from copem_replay.measure import distances
from copem_replay.onset import ENDED_BY
from copem_replay.replay import Replay
from copem_replay.tracks import CLASSES, SAME_INSTANT_NS, TRUTH, Float, Int, Tracks

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
        parts.append(pd.DataFrame(columns).drop(columns="look"))
    return pd.concat(parts, ignore_index=True)


def _check_truth_ids(experiment: Experiment) -> None:
    """Raises ExperimentError for a configuration of which it is not known how probable its detections are."""
    for name, configuration in experiment.configurations.items():
        recorded = set(experiment.units_of(configuration)) & experiment.recorded.keys()
        if not by_truth(configuration) or experiment.measure.match.always:
            why = "what is matched with the truth depends on sampled errors"
        elif recorded:
            why = f"unit {min(recorded)} is recorded, and nothing says how probable its lists were"
        else:
            continue
        raise ExperimentError(f"exact: configuration {name}: {why}, which has no closed form; leave `exact` out")


def check_exact(ready: Sequence[Replay], experiment: Experiment) -> None:
    """Raises ExperimentError for a configuration that has no closed form."""
    if not experiment.measure.exact:
        return
    _check_truth_ids(experiment)
    if experiment.measure.confirm.hits == 1:
        return
    for replay in ready:
        units = fleet_of(experiment, replay.scene).experiment
        for name, configuration in units.configurations.items():
            _shared_instants(replay, listen(replay.measured.tracks, replay.truth, units, configuration), name)


def distributions(replay: Replay, experiment: Experiment, name: str) -> list[tuple[Float, Float]]:
    """For each look the instants (K,) at which it may be detected, and how probably (K,) at each."""
    experiment = fleet_of(experiment, replay.scene).experiment
    configuration, looks, confirm = experiment.configurations[name], replay.looks, experiment.measure.confirm
    heard = listen(replay.measured.tracks, replay.truth, experiment, configuration)
    listed = np.ones(len(heard.frame_ix)) if configuration.units == TRUTH else replay.measured.probability
    instants = _shared_instants(replay, heard, name) if confirm.hits > 1 else None
    arrives_s = heard.arrives_s[0, heard.frame_ix]
    by_object = np.argsort(heard.row_object_ix, kind="stable")
    first, last = (np.searchsorted(heard.row_object_ix[by_object], looks.object_ix, side) for side in ("left", "right"))
    result = []
    for m in range(len(looks.object_ix)):
        rows = by_object[first[m] : last[m]]
        counts = arrives_s[rows] <= looks.ended_s[m] + _TOLERANCE_S
        if not experiment.measure.count_earlier:
            counts &= heard.row_captured_s[rows] >= looks.onset_s[m] - _TOLERANCE_S
        rows = rows[counts]
        if instants is None:
            share = replay.fleet.share if configuration.units != TRUTH else np.ones(1)
            result.append(_first_of(arrives_s[rows], listed[rows], heard.row_unit_ix[rows], share))
        else:
            instant = instants[heard.frame_ix[rows]]
            result.append(_confirmed(instant, arrives_s[rows], listed[rows], confirm.hits, confirm.of))
    return result


def _first_of(arrives_s: Float, listed: Float, unit_ix: Int, share: Float) -> tuple[Float, Float]:
    """Instants (K,) and the probability (K,) that the object is first listed then; rows (P,) of one object.

    A unit that is there with probability q < 1, `share (U,)`, misses it with (1 − q) + q Π (1 − p).
    """
    sure = share[unit_ix] == 1
    time_s, _ = _by_instant(arrives_s, listed)
    instant = np.searchsorted(time_s, arrives_s + _TOLERANCE_S, side="right") - 1
    unknown = _missed_by(instant[sure], listed[sure], len(time_s))
    for unit in np.unique(unit_ix[~sure]):
        mine = unit_ix == unit
        unknown *= (1 - share[unit]) + share[unit] * _missed_by(instant[mine], listed[mine], len(time_s))
    return time_s, np.concatenate([[1.0], unknown])[:-1] - unknown


def _missed_by(instant: Int, listed: Float, count: int) -> Float:
    """(K,) probability that no list up to each instant holds the object; rows (P,) of lists that arrive then."""
    missed = np.ones(count)
    np.multiply.at(missed, instant, 1 - listed)
    result: Float = np.cumprod(missed, dtype=np.float64)
    return result


def _by_instant(arrives_s: Float, listed: Float) -> tuple[Float, Float]:
    """Instants (K,) of arrival, and the probability (K,) that no list that arrives then holds the object."""
    order = np.argsort(arrives_s, kind="stable")
    ordered = arrives_s[order]
    start = np.flatnonzero(np.diff(ordered, prepend=-np.inf) > _TOLERANCE_S)
    if not len(start):
        return np.empty(0), np.empty(0)
    return ordered[start], np.multiply.reduceat(1 - listed[order], start)


def _confirmed(instant: Int, arrives_s: Float, listed: Float, hits: int, of: int) -> tuple[Float, Float]:
    """Instants (K,) and the probability (K,) that then for the first time `hits` of the last `of` captures hold it.

    `instant (P,)`: number of the capture instant of each row. A state says which of the last n − 1 captures did.
    """
    time_s, missed = _by_instant(arrives_s, listed)
    number = np.sort(np.unique(instant))
    assert len(number) == len(time_s)  # what is captured together arrives together
    states = np.arange(1 << (of - 1))
    held = np.array([int(state).bit_count() for state in states])
    after = (states << 1) & (len(states) - 1)
    mass = np.zeros(len(states))
    mass[0] = 1.0
    probability = np.zeros(len(time_s))

    def moved_on(kept: Float, state: Int) -> Float:
        result: Float = np.bincount(state, weights=kept, minlength=len(states)).astype(float)
        return result

    for k in range(len(time_s)):
        for _ in range(min(int(number[k] - number[k - 1]) - 1, of) if k else 0):  # captures without the object
            mass = moved_on(mass, after)
        done = held + 1 >= hits
        probability[k] = mass[done].sum() * (1 - missed[k])
        not_yet = np.where(done, 0.0, mass) * (1 - missed[k])
        mass = moved_on(not_yet, after | 1) + moved_on(mass * missed[k], after)
    return time_s, probability


def _shared_instants(replay: Replay, heard: Tracks, name: str) -> Int:
    """(F,) the capture instant of each list. Raises ExperimentError unless all units share all of them."""
    came = np.isfinite(heard.arrives_s[0])
    if heard.units != (TRUTH,) and (replay.fleet.share[heard.frame_unit_ix[came]] < 1).any():
        raise ExperimentError(
            f"{replay.scene.log}: exact: configuration {name}: some units are only in some runs, and "
            "confirmation by several hits then has no closed form; confirm with one hit, or leave `exact` out"
        )
    instants = capture_instants(heard)
    everyone = np.unique(instants[came])
    for unit in np.unique(heard.frame_unit_ix[came]):
        mine = came & (heard.frame_unit_ix == unit)
        if not np.array_equal(np.unique(instants[mine]), everyone):
            raise ExperimentError(
                f"{replay.scene.log}: exact: configuration {name}: unit {heard.units[unit]} does not list at "
                "every instant at which another does, and confirmation over such lists has no closed form; give all "
                "units one rate_hz and phase_s, confirm with one hit, or leave `exact` out"
            )
    for instant in everyone:
        arrivals = heard.arrives_s[0, came & (instants == instant)]
        if np.ptp(arrivals) > _TOLERANCE_S:
            raise ExperimentError(
                f"{replay.scene.log}: exact: configuration {name}: lists captured together arrive up to "
                f"{np.ptp(arrivals):g} s apart, and confirmation over such lists has no closed form; give all units "
                "one latency, confirm with one hit, or leave `exact` out"
            )
    return instants


def _columns(
    replay: Replay, experiment: Experiment, name: str, distributions: list[tuple[Float, Float]]
) -> dict[str, Any]:
    """Columns of one configuration: a row per look and instant, and for each look one, without instant, for never."""
    scene, looks = replay.scene, replay.looks
    look = np.repeat(np.arange(len(distributions)), [len(time_s) + 1 for time_s, _ in distributions])
    detection_s = np.concatenate([np.empty(0), *(np.append(time_s, np.nan) for time_s, _ in distributions)])
    incidence = np.concatenate([np.empty(0), *(np.append(np.cumsum(p), np.nan) for _, p in distributions)])
    probability = np.concatenate([np.empty(0), *(np.append(p, max(0.0, 1 - p.sum())) for _, p in distributions)])
    object_ix = looks.object_ix[look]
    distance_m, gap_m = distances(scene, replay.truth, experiment, object_ix, detection_s)
    return {
        "log": scene.log,
        "configuration": name,
        "look": look,
        "object_id": np.array(scene.object_ids, dtype=object)[object_ix],
        "object_class": np.array(CLASSES, dtype=object)[scene.object_class[object_ix]],
        "onset_s": looks.onset_s[look],
        "detection_s": detection_s,
        "probability": probability,
        "incidence": incidence,
        "time_to_detection_s": detection_s - looks.onset_s[look],
        "distance_at_detection_m": distance_m,
        "gap_at_detection_m": gap_m,
        "ended_s": looks.ended_s[look],
        "ended_by": np.array(ENDED_BY, dtype=object)[looks.ended_by[look]],
    }


def _passing(replay: Replay, columns: Mapping[str, Any], reaction: Reaction) -> dict[str, Any]:
    """Whether each row's look is in conflict, and the probability to pass if it is detected then."""
    look = columns["look"]
    detection_s = columns["detection_s"]
    known_s = np.where(np.isnan(detection_s), np.inf, np.maximum(detection_s, replay.looks.onset_s[look]))
    probability = np.full(len(look), np.nan)
    for number, between in replay.passing_s.items():
        rows = np.flatnonzero(look == number)
        probability[rows] = pass_probability(between, known_s[rows], reaction)
    return {"conflict": ~np.isnan(probability), "pass_probability": probability}

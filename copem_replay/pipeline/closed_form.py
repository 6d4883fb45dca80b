"""Exact detection times: their distribution in closed form, without a single draw.

Lists are independent given the truth, and with ideal fusion an object is known when any list that has arrived holds
it: P(T > t) = Π (1 − p) over all lists that have arrived by t. Where detection lasts, lists that share a held number
are not independent, and a filter gives the factors. Confirmation by k of n is a Markov chain over the last n − 1
capture instants where all units capture together and their lists arrive together, in the order of their captures;
elsewhere it has no such form, and is refused. Both are worked out in `metrics/exact_survival.py`. The probabilities to
pass and to fail follow with the distribution of the reaction. Definitions: docs/guide/metrics.md.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from copem_replay.communication.link import UnitLinks, delay_until_ready, sample_arrivals, transmit
from copem_replay.communication.radio import Radio
from copem_replay.communication.reception import ConstantReception, RadioPath, ask_reception_probability
from copem_replay.core.errors import ExperimentError, count_noun
from copem_replay.core.memory import MemoryPart
from copem_replay.core.random import CounterRng
from copem_replay.core.tracks import CLASSES, SAME_INSTANT_S, TRUTH, Float, Int, Tracks
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.braking.driver import Reaction
from copem_replay.metrics.braking.verdict import fail_probability, pass_probability
from copem_replay.metrics.detection.turns import number_turns
from copem_replay.metrics.detections_table import measure_distances
from copem_replay.metrics.exact_survival import FirstKnown, LastingDetection, first_confirmed, first_known
from copem_replay.metrics.onset import began_texts
from copem_replay.metrics.survival import end_reason_texts
from copem_replay.perception.observation import rows_by_unit
from copem_replay.perception.pem.model import Pem
from copem_replay.pipeline.expansion import ExpandedExperiment, find_facts
from copem_replay.pipeline.prepare import Replay
from copem_replay.pipeline.sweep import list_points

if TYPE_CHECKING:
    import pandas as pd

# Detection that lasts: which units share a held number, and whether that has a closed form.


def find_lasting_detection(
    replay: Replay, experiment: ExpandedExperiment, name: str, received: Tracks
) -> LastingDetection | None:
    """How the detection of each row (P,) lasts, of all lists that a configuration receives; None: no detection lasts.

    Raises ExperimentError where detection lasts in a way that has no closed form.
    """
    of_unit = _find_processes(experiment, name, 1)
    if not of_unit:
        return None
    observations = replay.measured
    P, keys = len(observations.probability), list(dict.fromkeys(key for key, _ in of_unit.values()))
    process, share, tau_s = np.full(P, -1), np.zeros(P), np.full(P, np.inf)
    for (unit, settings), rows in zip(experiment.modelled.items(), rows_by_unit(observations.tracks), strict=True):
        if unit not in of_unit:
            continue
        key, time_s = of_unit[unit]
        pem = experiment.pems[str(settings.pem)]
        by_couple = np.array(
            [*(sum(part.share for part in _list_lasting_parts(pem, c)) for c in range(len(pem.couples))), 0.0]
        )
        process[rows], share[rows], tau_s[rows] = keys.index(key), by_couple[observations.couple_ix[rows]], time_s
    for number in range(len(keys)):
        units = [unit for unit, (key, _) in of_unit.items() if keys.index(key) == number]
        _check_order(replay, experiment, name, received, units)
    return LastingDetection(process, share, tau_s, received.row_captured_s)


def _find_processes(experiment: ExpandedExperiment, name: str, hits: int) -> dict[str, tuple[str, float]]:
    """By unit with lasting detection: the key of the random number it uses, and its correlation time (s). Raises
    ExperimentError: the exact distribution then has no closed form.
    """
    configuration = experiment.configurations[name]
    processes: dict[str, tuple[str, float]] = {}
    for unit in () if configuration.units == TRUTH else experiment.units_of(configuration):
        settings = experiment.units[unit]
        if settings.pem is None:
            continue
        part = _find_lasting_part(experiment.pems[settings.pem], name, unit)
        if part is None:
            continue
        if hits > 1:
            why = f"detection of unit {unit} lasts, and confirmation by several hits then has no closed form"
            raise _refuse_lasting(name, f"{why}; confirm with one hit")
        tau_s = np.inf if isinstance(part.correlation_s, str) else part.correlation_s
        key = f"{part.of} {unit}" if part.of in ("pair", "unit") else part.of
        for other, (number_key, other_s) in processes.items():
            if number_key == key and other_s != tau_s:
                shared = f"units {other} and {unit} have the numbers of `of: {part.of}` in common"
                why = f"{shared} with two correlation times, which has no closed form; give them one"
                raise _refuse_lasting(name, why)
        processes[unit] = key, tau_s
        if part.of in ("object", "all") and experiment.share[list(experiment.units).index(unit)] < 1:
            why = f"detection of `of: {part.of}` that lasts then has no closed form"
            raise _refuse_lasting(name, f"unit {unit} is only in some runs, and {why}")
    return processes


def _find_lasting_part(pem: Pem, name: str, unit: str) -> MemoryPart | None:
    """The one lasting part of a unit's detection; None: nothing lasts. Raises ExperimentError: no closed form."""
    by_couple = [parts for c in range(len(pem.couples)) if (parts := _list_lasting_parts(pem, c))]
    if not by_couple:
        return None
    longest_parts = max(by_couple, key=len)
    if len(longest_parts) > 1:
        count = f"{_count_in_words(len(longest_parts))} lasting parts"
        why = f"detection of unit {unit} has {count}, which has no closed form here; leave one"
        raise _refuse_lasting(name, why)
    [first, *others] = [parts[0] for parts in by_couple]
    if any((part.correlation_s, part.of, part.path) != (first.correlation_s, first.of, first.path) for part in others):
        why = f"detection of unit {unit} lasts otherwise from couple to couple, which has no closed form"
        raise _refuse_lasting(name, f"{why}; give all one correlation_s and `of`")
    if first.path not in (None, "held") and first.correlation_s != "always":
        raise _refuse_lasting(
            name, f"detection of unit {unit} {first.path}, which has no closed form; use `path: held`"
        )
    return first


def _list_lasting_parts(pem: Pem, couple: int) -> list[MemoryPart]:
    return [part for part in pem.memory_of(couple).get("detection", ()) if part.share > 0]


def _count_in_words(count: int) -> str:
    return {2: "two", 3: "three"}.get(count, str(count))


def _check_order(replay: Replay, experiment: ExpandedExperiment, name: str, received: Tracks, units: list[str]) -> None:
    """Raises ExperimentError unless lists that share a held number arrive as they were captured."""
    ixs = [list(experiment.units).index(unit) for unit in units]
    frames = np.flatnonzero(np.isin(received.frame_unit_ix, ixs) & np.isfinite(received.common_arrives_s))
    arrives_s: Float = received.common_arrives_s[frames[np.argsort(received.captured_s[frames], kind="stable")]]
    late: Int = np.flatnonzero(arrives_s < np.maximum.accumulate(arrives_s) - SAME_INSTANT_S)
    if len(late):
        senders = f"unit {units[0]}" if len(units) == 1 else f"the {count_noun(len(units), 'unit')} {', '.join(units)}"
        order = f"lists of {senders} arrive in another order than they were captured in"
        why = f"{order}, and detection that lasts then has no closed form; give them one constant latency"
        raise _refuse_lasting(name, why, replay.scene.log)


def _refuse_lasting(name: str, why: str, log: str = "") -> ExperimentError:
    return ExperimentError(f"{log + ': ' if log else ''}exact: configuration {name}: {why}, or leave exact out")


# Links: when lists arrive, and how probably, without a draw.


def receive_without_loss(replay: Replay, experiment: ExpandedExperiment, name: str, hits: int) -> tuple[Tracks, Float]:
    """The lists that reach a configuration's receiver if none is lost, and the probability (F,) that each is not lost.

    `hits`: how many confirm an object. Raises ExperimentError where drawn arrivals have no closed form.
    """
    configuration, units = experiment.configurations[name], set(experiment.units_of(experiment.configurations[name]))
    for unit in sorted(units & experiment.ready.keys()):
        if experiment.ready[unit].fixed_s is None:
            why = "`ready` is drawn, and then lists have no common instants; make it constant"
            raise _refuse_link(name, f"unit {unit}: {why}")
    of_truth = configuration.units == TRUTH
    lists = replay.truth if of_truth else replay.measured.tracks
    if not of_truth:
        rng = CounterRng(experiment.seed, replay.scene.log)
        lists = delay_until_ready(lists, experiment.ready, rng, np.zeros(1, dtype=np.int64))
    reception = np.ones(len(lists.stamp_ns))
    lossless: list[UnitLinks] = []
    for unit_links in experiment.links_of(name):
        if unit_links.link.drawn:
            assert isinstance(unit_links.link, Radio)  # links of the user's own are not drawn
            _check_link(unit_links, unit_links.link, name, hits)
            share = _reception_probability(replay, lists, unit_links, unit_links.link, name)
            if unit_links.units is not None:
                concerned = np.array([unit in unit_links.units for unit in lists.units], dtype=bool)[
                    lists.frame_unit_ix
                ]
                share = np.where(concerned, share, 1.0)
            reception *= share
            unit_links = replace(unit_links, link=unit_links.link.model_copy(update={"reception": ConstantReception()}))
        lossless.append(unit_links)
    return sample_arrivals(transmit(lists, lossless, None if of_truth else units), configuration.issue_hz), reception


def _check_link(unit_links: UnitLinks, link: Radio, name: str, hits: int) -> None:
    """Raise ExperimentError where a link makes lists depend on each other or on draws: there is no closed form."""
    label = f"link {unit_links.where.removeprefix('links.')}"
    if link.latency.fixed_s is None:
        raise _refuse_link(
            name, f"{label}: latency is drawn, and then lists have no common instants; use a constant one"
        )
    if link.channel is not None:
        raise _refuse_link(name, f"{label}: lists queue, each as long as the lists before it are; use no `channel`")
    if link.memory.get("reception"):
        raise _refuse_link(name, f"{label}: losses last, and lists are then lost together; use no `memory`")
    if hits > 1:
        why = "a lost list is no capture to the receiver, and confirmation by several hits then has no closed form"
        raise _refuse_link(name, f"{label}: {why}; confirm with one hit")


def _reception_probability(replay: Replay, seen: Tracks, unit_links: UnitLinks, link: Radio, name: str) -> Float:
    """(F,) the probability that each list arrives. Raises ExperimentError for losses in bursts."""
    F = len(seen.stamp_ns)
    path = replay.paths if link.reception.by_path else None
    no_path = np.full(F, np.nan)
    path = RadioPath(no_path, no_path) if path is None else RadioPath(path.distance_m[:F], path.visible_share[:F])

    noises: list[str] = []

    def noise(name: str, *, lasts_s: float | None = None) -> Float:
        noises.append(name)
        return np.full((1, F), 0.5)

    share = ask_reception_probability(link.reception, path, noise, f"{unit_links.where}.reception")
    if noises:
        why = "losses come in bursts, and lists are then lost together; use a constant reception"
        raise _refuse_link(name, f"link {unit_links.where.removeprefix('links.')}: {why}")
    return share


def _refuse_link(name: str, why: str) -> ExperimentError:
    return ExperimentError(f"exact: configuration {name}: {why}, or leave exact out")


# The distributions and the table.


def exact_table(replay: Replay, experiment: Experiment) -> pd.DataFrame:
    """The rows of `exact.parquet` of one log: the probability of each time of detection, by configuration and object.

    Raises ExperimentError for a configuration that has no closed form.
    """
    import pandas as pd

    braking = experiment.braking
    if braking is not None and braking.brakes_for == "conflict":
        raise ExperimentError(
            f"{replay.scene.log}: exact: perceived conflicts depend on sampled errors, and `brakes_for: "
            "conflict` has no closed form; use `brakes_for: object`, or leave `exact` out"
        )
    _check_known_probabilities(experiment)
    parts = []
    for name in experiment.configurations:
        columns = _exact_columns(replay, experiment, name, compute_distributions(replay, experiment, name))
        if braking is not None:
            columns |= _verdict_columns(replay, columns, braking.driver.reaction)
        parts.append(pd.DataFrame(columns).drop(columns="episode_ix"))
    return pd.concat(parts, ignore_index=True)


def _check_known_probabilities(experiment: Experiment) -> None:
    """Raises ExperimentError for a configuration whose probabilities of detection have no closed form."""
    facts = find_facts(experiment)
    for name, configuration in experiment.configurations.items():
        recorded = set(experiment.units_of(configuration)) & experiment.recorded.keys()
        if facts[name].recorded:
            why = "it is recorded, and nothing says how probable its lists were"
        elif not facts[name].by_truth_id:
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
    """Raises ExperimentError where exact times are asked for of a configuration that has no closed form."""
    if not experiment.measure.exact:
        return
    _check_known_probabilities(experiment)
    hits = experiment.measure.confirm.hits
    for replay in ready:
        units = replay.expand(resolve_for_log(experiment, replay.scene.log))
        for name in units.configurations:
            lasts = bool(_find_processes(units, name, hits))
            if hits == 1 and not lasts and not units.arrivals_differ:
                continue
            received, reception = receive_without_loss(replay, units, name, hits)
            if hits > 1:
                _number_shared_instants(replay, received, name)
            else:
                _find_lasting(replay, units, name, received, reception)


def compute_distributions(replay: Replay, experiment: Experiment, name: str) -> list[FirstKnown]:
    """For each episode the distribution of the instant at which its object is first known."""
    units, episodes, confirm = replay.expand(experiment), replay.episodes, experiment.measure.confirm
    configuration = units.configurations[name]
    received, reception = receive_without_loss(replay, units, name, confirm.hits)
    # A model of the user's own may be above 1 by rounding.
    listed = (
        np.ones(len(received.frame_ix)) if configuration.units == TRUTH else np.minimum(replay.measured.probability, 1)
    )
    if (reception < 1).any():
        listed = listed * reception[received.frame_ix]
    instants = _number_shared_instants(replay, received, name) if confirm.hits > 1 else None
    lasting = None if instants is not None else _find_lasting(replay, units, name, received, reception)
    arrives_s = received.common_arrives_s[received.frame_ix]
    by_object = np.argsort(received.row_object_ix, kind="stable")
    first, last = (
        np.searchsorted(received.row_object_ix[by_object], episodes.object_ix, side) for side in ("left", "right")
    )
    from_s = episodes.counts_from_s(count_earlier=experiment.measure.count_earlier)
    result = []
    for m in range(len(episodes.object_ix)):
        rows = by_object[first[m] : last[m]]
        counts = arrives_s[rows] <= episodes.ended_s[m] + SAME_INSTANT_S
        counts &= received.row_captured_s[rows] >= from_s[m]
        rows = rows[counts]
        if instants is None:
            share = replay.expanded.share if configuration.units != TRUTH else np.ones(1)
            lasting_rows = None if lasting is None else lasting.take(rows)
            result.append(first_known(arrives_s[rows], listed[rows], received.row_unit_ix[rows], share, lasting_rows))
        else:
            instant = instants[received.frame_ix[rows]]
            result.append(first_confirmed(instant, arrives_s[rows], listed[rows], confirm.hits, confirm.of))
    return result


def _find_lasting(
    replay: Replay, experiment: ExpandedExperiment, name: str, received: Tracks, reception: Float
) -> LastingDetection | None:
    """How detection lasts. Raises ExperimentError if lists are lost, too: by `reception (F,)`, probabilities."""
    lasting = find_lasting_detection(replay, experiment, name, received)
    if lasting is not None and (reception < 1).any():
        raise ExperimentError(
            f"exact: configuration {name}: detection lasts and lists are lost, and both together have no closed form "
            "here; leave one of them, or leave exact out"
        )
    return lasting


def _number_shared_instants(replay: Replay, received: Tracks, name: str) -> Int:
    """(F,) the capture instant of each list, numbered. Raises ExperimentError unless all units share all of them."""
    arrived = np.isfinite(received.common_arrives_s)
    if received.units != (TRUTH,) and (replay.expanded.share[received.frame_unit_ix[arrived]] < 1).any():
        raise ExperimentError(
            f"{replay.scene.log}: exact: configuration {name}: some units are only in some runs, and "
            "confirmation by several hits then has no closed form; confirm with one hit, or leave `exact` out"
        )
    instants = number_turns(received).list_instant
    instants_of_all = np.unique(instants[arrived])
    for unit in np.unique(received.frame_unit_ix[arrived]):
        of_unit = arrived & (received.frame_unit_ix == unit)
        if not np.array_equal(np.unique(instants[of_unit]), instants_of_all):
            raise ExperimentError(
                f"{replay.scene.log}: exact: configuration {name}: unit {received.units[unit]} does not list at "
                "every instant at which another does, and confirmation over such lists has no closed form; give all "
                "units one rate_hz and phase_s, confirm with one hit, or leave `exact` out"
            )
    for instant in instants_of_all:
        arrivals = received.common_arrives_s[arrived & (instants == instant)]
        if np.ptp(arrivals) > SAME_INSTANT_S:
            raise ExperimentError(
                f"{replay.scene.log}: exact: configuration {name}: lists that count as one hit arrive up to "
                f"{np.ptp(arrivals):g} s apart, and confirmation over such lists has no closed form; give all units "
                "one latency, confirm with one hit, or leave `exact` out"
            )
    return instants


def _exact_columns(
    replay: Replay, experiment: Experiment, name: str, distributions: list[FirstKnown]
) -> dict[str, Any]:
    """Columns of one configuration: for each episode a row by instant of detection, and a last one for never."""
    scene, episodes = replay.scene, replay.episodes
    episode = np.repeat(np.arange(len(distributions)), [len(d.time_s) + 1 for d in distributions])

    def rows(pieces: Iterable[Float]) -> Float:
        return np.concatenate([np.empty(0), *pieces])

    def of_never(values: Iterable[float]) -> Float:
        return rows(np.append(np.full(len(d.time_s), np.nan), v) for d, v in zip(distributions, values, strict=True))

    detection_s = rows(np.append(d.time_s, np.nan) for d in distributions)
    object_ix = episodes.object_ix[episode]
    distance_m, gap_m = measure_distances(scene, replay.truth, experiment, object_ix, detection_s)
    return {
        "log": scene.log,
        "configuration": name,
        "episode_ix": episode,
        "object_id": np.array(scene.object_ids, dtype=object)[object_ix],
        "object_class": np.array(CLASSES, dtype=object)[scene.object_class[object_ix]],
        "episode": episodes.number[episode],
        "onset_s": episodes.onset_s[episode],
        "began": began_texts(episodes.began[episode]),
        "detection_s": detection_s,
        "probability": rows(np.append(d.probability, np.exp(d.log_never)) for d in distributions),
        "incidence": rows(np.append(np.minimum(np.cumsum(d.probability), 1), np.nan) for d in distributions),
        "miss_log10": of_never(_log10(d.log_never) for d in distributions),
        "miss_per_logit": of_never(d.per_logit for d in distributions),
        "miss_log10_half_odds": of_never(_log10(d.log_never_half) for d in distributions),
        "time_to_detection_s": detection_s - episodes.onset_s[episode],
        "distance_at_detection_m": distance_m,
        "gap_at_detection_m": gap_m,
        "ended_s": episodes.ended_s[episode],
        "ended_by": end_reason_texts(episodes.ended_by[episode]),
    }


def _log10(log: float) -> float:
    """log10 of what has the natural logarithm `log`; NaN where that is −inf, as detection is certain."""
    return log / math.log(10) if log > -np.inf else np.nan


def _verdict_columns(replay: Replay, columns: Mapping[str, Any], reaction: Reaction) -> dict[str, Any]:
    """Whether each row's episode is in conflict, and the probabilities to pass and to fail if it is detected then."""
    episode = columns["episode_ix"]
    detection_s = columns["detection_s"]
    known_s = np.where(np.isnan(detection_s), np.inf, np.maximum(detection_s, replay.episodes.onset_s[episode]))
    passes, fails = np.full(len(episode), np.nan), np.full(len(episode), np.nan)
    for number, between in replay.passing_s.items():
        rows = np.flatnonzero(episode == number)
        passes[rows] = pass_probability(between, known_s[rows], reaction)
        fails[rows] = fail_probability(between, known_s[rows], reaction)
    return {"conflict": ~np.isnan(passes), "pass_probability": passes, "fail_probability": fails}


def check_closed_form(ready: Sequence[Replay], experiment: Experiment) -> None:
    """Raises ExperimentError where exact times are asked for, also along a sweep, and have no closed form."""
    check_exact(ready, experiment)
    for point in list_points(experiment):
        if point.same_units:
            check_exact(ready, point.experiment)
